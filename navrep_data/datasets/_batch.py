"""From stored rows to batches of tensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from navrep_data.datasets import _kernels
from navrep_data.datasets._buffers import BufferPool
from navrep_data.datasets._index import Ints
from navrep_data.datasets._rows import ranges
from navrep_data.errors import ConfigError, UnknownNameError, did_you_mean
from navrep_data.observations import fill_blind, scan_to_rings

Array = npt.NDArray[Any]
Lidar = Literal["rings", "1d"]
LIDAR_FIELDS: dict[str | None, tuple[str, ...]] = {"rings": ("rings",), "1d": ("scan",), None: ()}
STEP_FIELDS = ("robot_state", "action", "action_valid", "reward", "is_first", "is_last", "is_terminal")
"""Fields of a default window besides the lidar and ``mask``."""
STORED_FIELDS = (
    *("reward", "is_first", "is_last", "is_terminal", "event", "sequence", "episode", "step"),
    *("robot_pose", "robot_radius", "humans", "scan_label", "contact", "leading_reward"),
)
"""Fields handed out as stored."""
FIELDS = ("rings", "scan", "robot_state", "goal_valid", "action", "action_valid", *STORED_FIELDS)
"""Every field that can be asked for."""
OBSERVATION_FIELDS = frozenset({"rings", "scan", "robot_state", "goal_valid", "humans", "scan_label", "robot_pose"})
"""Fields that ``targets=True`` hands out as ``next_*`` too."""


@dataclass(frozen=True)
class BatchSpec:
    """What a batch holds and what it is made from.

    Attributes
    ----------
    window : int
        Rows per window.
    fields : tuple of str
        Output fields, without ``next_*`` and ``mask``.
    leading : bool
        Whether ``action`` is the one that led to a row.
    targets : bool
        Whether ``next_*`` are added.
    blank : bool
        Whether frames at ``is_last`` are zeroed (windows across episodes).
    normalized : bool
        Whether scans are divided by `range_max`.
    invalid : float
        What a stored 0 of a scan becomes [m].
    fill : bool
        Whether those become what :func:`navrep_data.observations.fill_blind` shows models instead.
    range_max : float
        The sensor's range [m].
    columns : frozenset of str
        Columns that the dataset has.
    """

    window: int
    fields: tuple[str, ...]
    leading: bool
    targets: bool
    blank: bool
    normalized: bool
    invalid: float
    fill: bool
    range_max: float
    columns: frozenset[str]

    @property
    def stored_rings(self) -> bool:
        """Whether rings are read rather than computed from the scan."""
        return "rings" in self.columns

    @property
    def stored_leading(self) -> bool:
        """Whether the leading action is stored (imports)."""
        return "leading_action" in self.columns

    def needed(self) -> tuple[str, ...]:
        """Return the columns to read."""
        made_from: dict[str, tuple[str, ...]] = {
            "rings": ("rings",) if self.stored_rings else ("scan",),
            "goal_valid": ("robot_state",),
            "action": ("action",),
            "action_valid": ("is_last",),
        }
        if self.leading:
            made_from["action"] = ("leading_action",) if self.stored_leading else ("action", "is_first")
            made_from["action_valid"] = ("is_first", "leading_action") if self.stored_leading else ("is_first",)
        names = [column for field in self.fields for column in made_from.get(field, (field,))]
        if self.blank:
            names.append("is_last")
        return tuple(dict.fromkeys(names))

    @property
    def rows_before(self) -> int:
        """Rows before a window that are needed as well."""
        return int(self.leading and not self.stored_leading and "action" in self.fields)


def choose_fields(lidar: str | None, fields: Any, default: tuple[str, ...], columns: frozenset[str]) -> tuple[str, ...]:
    """Return the output fields: the lidar's and `fields`, or `default` if that is None.

    Raises
    ------
    ConfigError
        For an unknown lidar, or a field that the dataset lacks.
    UnknownNameError
        For a name that is no field.
    """
    if lidar not in LIDAR_FIELDS:
        raise ConfigError(f"lidar is {lidar!r}, expected 'rings', '1d' or None.")
    if isinstance(fields, str):
        raise ConfigError(f"fields is the string {fields!r}, expected a list of names such as ['{fields}'].")
    if fields is None:
        fields = default + (("goal_valid",) if "leading_action" in columns and "robot_state" in default else ())
    chosen = tuple(dict.fromkeys((*LIDAR_FIELDS[lidar], *(name for name in fields if name != "mask"))))
    for name in chosen:
        if name not in FIELDS:
            raise UnknownNameError(
                f"Unknown field {name!r}.{did_you_mean(name, FIELDS)} Expected some of: {', '.join(FIELDS)}."
            )
        if name in STORED_FIELDS and name not in columns:
            raise ConfigError(
                f"This dataset has no column {name!r}; leave it out of fields. It has: {', '.join(sorted(columns))}."
            )
    return chosen


class Assembler:
    """Turns stored rows into tensors.

    Parameters
    ----------
    spec : BatchSpec
        What to make.
    """

    def __init__(self, spec: BatchSpec) -> None:
        self.spec = spec
        self.pool = BufferPool()

    def __call__(self, rows: Mapping[str, Array], start: Ints, count: Ints, after: Ints) -> dict[str, torch.Tensor]:
        """Return the batch of all windows.

        Parameters
        ----------
        rows : mapping of str to ndarray of shape (R, ...)
            Stored rows of the columns in ``spec.needed()``.
        start : ndarray of shape (B,), int64
            First row of each window in `rows`.
        count : ndarray of shape (B,), int64
            Real rows of each window, 1 to W.
        after : ndarray of shape (B,), int64
            1 where the row past the window may serve as a target.
        """
        spec = self.spec
        batch = {name: self._field(name, rows, start, count) for name in spec.fields}
        real = np.arange(spec.window) < count[:, None]
        if spec.targets:
            successors = count - 1 + after
            for name in spec.fields:
                if name in OBSERVATION_FIELDS:
                    batch[f"next_{name}"] = self._field(name, rows, start + 1, successors)
            batch["next_mask"] = np.arange(spec.window) < successors[:, None]
        if spec.blank:
            last = self._stored(rows["is_last"], start, count)
            for name in ("rings", "scan", "next_rings", "next_scan"):
                if name in batch:
                    batch[name][last] = 0.0
        batch["mask"] = real
        return {name: torch.from_numpy(array) for name, array in batch.items()}

    def _field(self, name: str, rows: Mapping[str, Array], start: Ints, count: Ints) -> Array:
        if name == "scan":
            return self._scan(rows["scan"], start, count)
        if name == "rings":
            return self._rings(rows, start, count)
        if name in ("robot_state", "goal_valid"):
            state = self._stored(rows["robot_state"], start, count)
            if name == "goal_valid":
                return ~np.isnan(state[..., :2]).any(-1) & (np.arange(self.spec.window) < count[:, None])
            return np.nan_to_num(state, copy=False, nan=0.0)
        if name == "action":
            return self._action(rows, start, count)
        if name == "action_valid":
            return self._action_valid(rows, start, count)
        stored = self._stored(rows[name], start, count)
        if name == "humans":  # a row that does not exist has no humans, rather than humans at the robot's feet
            stored[np.arange(self.spec.window) >= count[:, None]] = np.nan
        return stored.astype(np.float32) if stored.dtype == np.float64 else stored

    def _scan(self, scans: Array, start: Ints, count: Ints) -> Array:
        spec = self.spec
        out = self.pool.empty((len(start), spec.window, scans.shape[1]), np.float32)
        kernel = _kernels.millimetre_windows if scans.dtype == np.uint16 else _kernels.metre_windows
        scale = np.float32(spec.range_max if spec.normalized else 1.0)
        if spec.fill:
            kernel(scans, start, count, np.float32(0.0), np.float32(1.0), out)
            real = np.arange(spec.window) < count[:, None]  # rows that do not exist stay 0
            if (out[real] == 0.0).any():
                out[real] = fill_blind(out[real])
            if spec.normalized:
                out /= scale
            return out
        kernel(scans, start, count, np.float32(spec.invalid), scale, out)
        return out

    def _rings(self, rows: Mapping[str, Array], start: Ints, count: Ints) -> Array:
        if self.spec.stored_rings:
            rings = rows["rings"]
        else:
            rings = scan_to_rings(rows["scan"][ranges(start, count)])
            start = np.cumsum(count) - count
        out = self.pool.empty((len(start), self.spec.window, *rings.shape[1:]), np.float32)
        cells = rings.shape[1] * rings.shape[2]
        _kernels.ring_windows(rings.reshape(-1, cells), start, count, out.reshape(*out.shape[:2], cells))
        return out

    def _stored(self, rows: Array, start: Ints, count: Ints) -> Array:
        out = self.pool.empty((len(start), self.spec.window, *rows.shape[1:]), rows.dtype)
        width = rows.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64))
        flat = np.ascontiguousarray(rows).reshape(-1).view(np.uint8)
        _kernels.byte_windows(flat, width, start, count, out.reshape(len(start), -1).view(np.uint8))
        return out

    def _action(self, rows: Mapping[str, Array], start: Ints, count: Ints) -> Array:
        if not self.spec.leading:
            return self._stored(rows["action"], start, count)
        if self.spec.stored_leading:
            return self._stored(rows["leading_action"], start, count).astype(np.float32, copy=False)
        actions = rows["action"]
        out = np.empty((len(start), self.spec.window, actions.shape[1]), np.float32)
        _kernels.leading_windows(actions, rows["is_first"], start, count, out)
        return out

    def _action_valid(self, rows: Mapping[str, Array], start: Ints, count: Ints) -> Array:
        real = np.arange(self.spec.window) < count[:, None]
        if not self.spec.leading:
            return real & ~self._stored(rows["is_last"], start, count)
        known = ~self._stored(rows["is_first"], start, count)
        if self.spec.stored_leading:
            # The original stores no episode's first observation, so an action did lead to a first row, unless
            # it is one of its rows from an episode that was never played: those have a zero action.
            known |= self._stored(rows["leading_action"], start, count).any(-1)
        return real & known
