"""Counts, means and ranges per column, and outcomes per event: of one shard, and merged over shards.

Notes
-----
Sums of integer columns are exact (integers below 2**53 in float64), so they do not depend on the order of
summation. NaN, padding slots, invalid rays (0), and the meaningless action and reward of each episode's last
row do not count.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.schema import COLUMNS, EVENT_NAMES, SCAN_SCALE
from navrep_data.shards._layout import VECTOR_COLUMNS
from navrep_data.shards._sums import count_bytes, count_cells, sum_rays

# 512 KiB of float64 stay in the cache.
_BLOCK_ITEMS = 65536
_MEANINGLESS_ON_LAST_ROW = ("action", "reward")

_MOMENT_KEYS = ("count", "mean", "std", "min", "max")
_OUTCOME_KEYS = ("episodes", "share", "steps", "mean_length", "min_length", "max_length")

Floats = npt.NDArray[np.float64]


@dataclass
class Moments:
    """Running count, sum, sum of squares, least and largest of C components.

    Attributes
    ----------
    count, total, squares, low, high : ndarray of shape (C,), float64
        The sums so far.
    """

    count: Floats
    total: Floats
    squares: Floats
    low: Floats
    high: Floats

    @classmethod
    def empty(cls, components: int) -> Moments:
        """Return the moments of nothing."""
        zeros = np.zeros(components)
        return cls(zeros, zeros.copy(), zeros.copy(), np.full(components, np.inf), np.full(components, -np.inf))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Moments:
        """Return what :meth:`to_dict` wrote (count, mean, std) as sums again."""

        def column(key: str, missing: float) -> Floats:
            given = values[key] if isinstance(values[key], list) else [values[key]]
            return np.array([missing if v is None else v for v in given], np.float64)

        count, mean, std = column("count", 0.0), column("mean", 0.0), column("std", 0.0)
        squares = (std * std + mean * mean) * count
        return cls(count, mean * count, squares, column("min", np.inf), column("max", -np.inf))

    def add(self, other: Moments) -> None:
        """Add the values behind `other`."""
        self.count = self.count + other.count
        self.total = self.total + other.total
        self.squares = self.squares + other.squares
        self.low = np.minimum(self.low, other.low)
        self.high = np.maximum(self.high, other.high)

    def to_dict(self, scale: float = 1.0) -> dict[str, Any]:
        """Return count, mean, std, min, max: numbers or lists of them, None where count is 0."""
        result: dict[str, list[Any]] = {"count": [], "mean": [], "std": [], "min": [], "max": []}
        for count, total, squares, low, high in zip(
            self.count, self.total, self.squares, self.low, self.high, strict=True
        ):
            result["count"].append(int(count))
            if not count:
                for key in ("mean", "std", "min", "max"):
                    result[key].append(None)
                continue
            mean = float(total / count)
            # Rounding can leave a tiny negative variance, or a tiny positive one where all values are equal.
            variance = 0.0 if low == high else max(0.0, float(squares / count) - mean * mean)
            result["mean"].append(mean * scale)
            result["std"].append(math.sqrt(variance) * scale)
            result["min"].append(float(low) * scale)
            result["max"].append(float(high) * scale)
        if len(self.count) == 1:
            return {key: values[0] for key, values in result.items()}
        return dict(result)


def _scan_moments(scan: npt.NDArray[Any]) -> Moments:
    """Return the moments of the valid rays (> 0), in the stored unit."""
    rays = scan.reshape(-1)
    if rays.dtype == np.uint16:
        return _whole_moments(sum_rays(rays))
    sums = Moments.empty(1)
    # One buffer for all blocks: fresh large arrays cost more in page faults than the sums themselves.
    buffer = np.empty(min(_BLOCK_ITEMS, rays.size))
    for start in range(0, rays.size, _BLOCK_ITEMS):
        block = rays[start : start + _BLOCK_ITEMS]
        block = block[block > 0]  # also drops NaN
        if not block.size:
            continue
        wide = buffer[: block.size]
        wide[:] = block
        part = [block.size, np.einsum("i->", wide), np.einsum("i,i->", wide, wide), block.min(), block.max()]
        sums.add(Moments(*(np.array([v], np.float64) for v in part)))
    return sums


def _rings_moments(rings: npt.NDArray[Any]) -> Moments:
    """Return the moments of cells 0/1/2 from their counts."""
    known, twos = count_cells(np.ascontiguousarray(rings).reshape(-1))
    ones = known - twos
    low = 0 if known < rings.size else 1 if ones else 2
    return _whole_moments((rings.size, ones + 2 * twos, ones + 4 * twos, low, 2 if twos else min(ones, 1)))


def _label_moments(labels: npt.NDArray[Any]) -> Moments:
    """Return the moments of labels of 8 bits from their counts."""
    counts = count_bytes(np.ascontiguousarray(labels).reshape(-1))
    values, there = np.arange(len(counts)), np.flatnonzero(counts)
    squares = int((counts * values * values).sum())
    return _whole_moments((labels.size, int((counts * values).sum()), squares, int(there[0]), int(there[-1])))


def _whole_moments(sums: tuple[int, int, int, int, int]) -> Moments:
    """Return the moments of one component whose count, total, squares, least and largest are whole numbers."""
    count, total, squares, low, high = sums
    if not count:
        return Moments.empty(1)
    return Moments(*(np.array([v], np.float64) for v in (count, total, squares, low, high)))


def _plain_moments(values: npt.NDArray[Any], components: int, may_be_nan: bool) -> Moments:
    """Return the moments of `values`, whose last axis holds `components` quantities."""
    # (components, n): reducing long rows is several times faster than reducing six columns.
    wide = np.ascontiguousarray(values.reshape(-1, components).T, np.float64)
    if not wide.shape[1]:
        return Moments.empty(components)
    count = np.full(components, float(wide.shape[1]))
    low_source = high_source = wide
    if may_be_nan:
        known = ~np.isnan(wide)
        if not known.all():
            count = known.sum(axis=1).astype(np.float64)
            low_source, high_source = np.where(known, wide, np.inf), np.where(known, wide, -np.inf)
            wide = np.where(known, wide, 0.0)
    squares = np.einsum("ij,ij->i", wide, wide)
    return Moments(count, wide.sum(axis=1), squares, low_source.min(axis=1), high_source.max(axis=1))


def column_moments(name: str, values: npt.NDArray[Any], is_last: npt.NDArray[np.bool_]) -> Moments:
    """Return the moments of one column of one sequence.

    Parameters
    ----------
    name : str
        Column name.
    values : ndarray of shape (rows, ...)
        As stored.
    is_last : ndarray of shape (rows,), bool
        Rows whose action and reward mean nothing.
    """
    if name == "scan":
        return _scan_moments(values)
    if name == "rings":
        return _rings_moments(values)
    if name == "scan_label":
        return _label_moments(values)
    components = values.shape[-1] if name in VECTOR_COLUMNS else 1
    if name in _MEANINGLESS_ON_LAST_ROW:
        values = values[~is_last]
    elif name == "humans":  # padding is most of it: drop it first
        values = values.reshape(-1, components)
        values = values[~np.isnan(values[:, 0])]
    return _plain_moments(values, components, COLUMNS[name].may_be_nan)


@dataclass
class ShardStatistics:
    """Statistics of the sequences of one shard, filled one sequence at a time.

    Attributes
    ----------
    scan_scale : float
        Metres per stored unit of a scan.
    """

    scan_scale: float
    columns: dict[str, Moments] = field(default_factory=dict)
    outcomes: dict[str, Moments] = field(default_factory=dict)
    humans: Moments = field(default_factory=lambda: Moments.empty(1))

    def add(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Add one sequence, given by all of its columns in the schema's order."""
        is_last = columns["is_last"]
        for name, values in columns.items():
            moments = column_moments(name, values, is_last)
            if name in self.columns:
                self.columns[name].add(moments)
            else:
                self.columns[name] = moments
        ends = np.flatnonzero(is_last)
        steps = np.diff(ends, prepend=-1) - 1  # T actions = T + 1 rows
        events = columns["event"][ends]
        for event in np.unique(events):
            part = _plain_moments(steps[events == event], 1, False)
            self.outcomes.setdefault(EVENT_NAMES[int(event)], Moments.empty(1)).add(part)
        if "humans" in columns:
            starts = np.flatnonzero(columns["is_first"])
            count = (~np.isnan(columns["humans"][starts, :, 0])).sum(axis=1)
            self.humans.add(_plain_moments(count, 1, False))

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values: ``columns``, ``outcomes``, ``humans_per_episode``."""
        columns = {
            name: moments.to_dict(self.scan_scale if name == "scan" else 1.0) for name, moments in self.columns.items()
        }
        return {
            "columns": columns,
            "outcomes": _outcomes_dict(self.outcomes),
            "humans_per_episode": self.humans.to_dict(),
        }


def _outcomes_dict(outcomes: Mapping[str, Moments]) -> dict[str, Any]:
    """Return episodes, share and lengths [steps] per event that happened."""
    episodes = sum(int(m.count[0]) for m in outcomes.values())
    result = {}
    for name in EVENT_NAMES:
        if name in outcomes:
            m = outcomes[name]
            result[name] = {
                "episodes": int(m.count[0]),
                "share": float(m.count[0] / episodes),
                "steps": int(m.total[0]),
                "mean_length": float(m.total[0] / m.count[0]),
                "min_length": int(m.low[0]),
                "max_length": int(m.high[0]),
            }
    return result


def _outcome_moments(values: Mapping[str, Any]) -> Moments:
    parts = [values["episodes"], values["steps"], 0, values["min_length"], values["max_length"]]
    return Moments(*(np.array([v], np.float64) for v in parts))


def merge_statistics(parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Merge the statistics of shards, in the order given.

    Parameters
    ----------
    parts : iterable of dict
        The statistics of each shard, as its manifest entry has them, in shard order.

    Returns
    -------
    dict
        The same structure over all of them; empty if there are none.
    """
    merged = ShardStatistics(1.0)
    seen = False
    for part in parts:
        seen = True
        for name, values in part["columns"].items():
            moments = Moments.from_dict(values)
            merged.columns.setdefault(name, Moments.empty(len(moments.count))).add(moments)
        for name, values in part["outcomes"].items():
            merged.outcomes.setdefault(name, Moments.empty(1)).add(_outcome_moments(values))
        merged.humans.add(Moments.from_dict(part["humans_per_episode"]))
    return merged.to_dict() if seen else {}


def scan_scale(dtype: np.dtype[Any]) -> float:
    """Return the metres per stored unit of a scan of `dtype`."""
    return SCAN_SCALE if dtype.kind == "u" else 1.0


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_regular(values: Mapping[str, Any]) -> bool:
    """Return whether these are the moments of one quantity or, in lists of one length, of several; None: of nothing."""
    given = [values[key] for key in _MOMENT_KEYS]
    if not all(isinstance(v, list) for v in given):
        given = [[v] for v in given]
    counts, others = given[0], given[1:]
    return all(map(_is_number, counts)) and all(
        len(v) == len(counts) and all(x is None or _is_number(x) for x in v) for v in others
    )


def check_statistics(values: Any, columns: Sequence[str]) -> str:
    """Return what is wrong with statistics from a manifest, or an empty string.

    Parameters
    ----------
    values : object
        Parsed JSON.
    columns : sequence of str
        The columns that must be there.
    """
    try:
        if not isinstance(values, dict) or list(values["columns"]) != list(columns):
            return "does not cover the dataset's columns"
        if not all(map(_is_regular, [*values["columns"].values(), values["humans_per_episode"]])):
            return "holds something else than numbers, or lists of different lengths"
        if not all(_is_number(outcome[key]) for outcome in values["outcomes"].values() for key in _OUTCOME_KEYS):
            return "holds outcomes that are no numbers"
        merged = merge_statistics([values])
        if any(name not in EVENT_NAMES for name in values["outcomes"]) or not merged:
            return "names an unknown event"
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, ZeroDivisionError) as error:
        return f"is not as written ({type(error).__name__}: {error})"
    return ""
