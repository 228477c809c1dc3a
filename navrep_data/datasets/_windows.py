"""What all map-style datasets share: an index of windows, a source of rows, batches."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch.utils.data import Dataset

from navrep_data.datasets._batch import Assembler, BatchSpec, Lidar, choose_fields
from navrep_data.datasets._index import Ints, WindowTable, across_episodes, sequences_of, within_episodes
from navrep_data.datasets._rows import DiskRows, LoadedRows, select_episodes
from navrep_data.errors import ConfigError, check_whole, one_line, whole_number
from navrep_data.shards import DatasetFolder, Episodes

Batch = dict[str, torch.Tensor]
Split = Literal["train", "val", "test"]
ScanUnit = Literal["metres", "normalized"]
Invalid = Literal["zero", "near", "range_max"]


def check_choice(name: str, value: Any, choices: Sequence[Any]) -> None:
    """Raise ConfigError unless `value` is one of `choices`."""
    if value not in choices:
        raise ConfigError(f"{name} is {value!r}, expected {' or '.join(repr(c) for c in choices)}.")


def check_rows(name: str, value: Any) -> int:
    """Return `value` as int, or raise ConfigError unless it is a number of rows of at least 1."""
    return check_whole(name, value, 1)


def open_folder(root: str | os.PathLike[str] | DatasetFolder) -> DatasetFolder:
    """Return `root` opened, itself if it is open already."""
    return root if isinstance(root, DatasetFolder) else DatasetFolder(Path(root))


def make_spec(
    folder: DatasetFolder,
    *,
    window: int,
    lidar: str | None,
    fields: Iterable[str] | None,
    default: tuple[str, ...],
    action: str,
    targets: bool,
    blank: bool,
    scan_unit: str,
    invalid: str,
) -> BatchSpec:
    """Check the arguments that all datasets share against the dataset and return what a batch is to hold."""
    check_choice("action", action, ("taken", "leading"))
    check_choice("scan_unit", scan_unit, ("metres", "normalized"))
    check_choice("invalid", invalid, ("zero", "near", "range_max"))
    columns = frozenset(folder.manifest.columns)
    range_max = float(folder.manifest.sensor.range_max)
    return BatchSpec(
        window=window,
        fields=choose_fields(lidar, fields, default, columns),
        leading=action == "leading",
        targets=targets,
        blank=blank,
        normalized=scan_unit == "normalized",
        invalid=range_max if invalid == "range_max" else 0.0,
        fill=invalid == "near",
        range_max=range_max,
        columns=columns,
    )


def cut(episodes: Episodes, window: int, stride: int, across: bool) -> WindowTable:
    """Return the windows of `episodes`.

    Raises
    ------
    ConfigError
        If there are none.
    """
    table = (across_episodes if across else within_episodes)(episodes, window, stride)
    if len(table) == 0:
        longest = int(sequences_of(episodes).rows.max())
        raise ConfigError(
            f"No window of {window} + 1 rows fits into the longest sequence, {longest} rows less the first; "
            "expected shorter windows with across_episodes=True. Lower window, or set across_episodes=False."
        )
    return table


class WindowDataset(Dataset[Batch]):
    """Random access to windows; the public classes only choose what a window is."""

    def __init__(
        self,
        folder: DatasetFolder,
        episodes: Episodes,
        table: WindowTable,
        spec: BatchSpec,
        preload: bool,
    ) -> None:
        self.root = folder.root
        self.spec = spec
        self.table = table
        self.preload = preload
        self._folder = folder
        self._sequences = sequences_of(episodes)
        self._assemble = Assembler(spec)
        self._disk = DiskRows(folder, spec.needed(), spec.rows_before, spec.targets)
        self._loaded: tuple[LoadedRows, Ints] | None = None
        if preload:
            self._load()

    def _load(self) -> tuple[LoadedRows, Ints]:
        if self._loaded is None:
            loaded = LoadedRows(self._folder, self.spec.needed(), self._sequences)
            self._loaded = (loaded, loaded.locate(self.table))
        return self._loaded

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.table)

    def __getstate__(self) -> dict[str, Any]:
        # Memory is shared with forked workers for free; sending it through a pickle would copy it, so a
        # spawned one loads.
        return {**self.__dict__, "_loaded": None}

    def batch(self, indices: Sequence[int] | np.ndarray[Any, Any] | torch.Tensor) -> Batch:
        """Return several windows stacked, much faster than one by one.

        Parameters
        ----------
        indices : sequence of int, shape (B,)
            Which windows; negative ones count from the end.

        Returns
        -------
        dict of str to torch.Tensor
            The fields of one window, each with a leading axis of length B.

        Raises
        ------
        IndexError
            If an index is out of range or not a whole number.
        """
        index = np.asarray(indices)
        if index.ndim != 1 or len(index) == 0 or index.dtype.kind not in "iu":
            raise IndexError(
                f"indices has shape {index.shape} and dtype {index.dtype}, expected a non-empty 1-D list of int."
            )
        n = len(self.table)
        index = index.astype(np.int64)
        if index.min() < -n or index.max() >= n:
            raise IndexError(
                f"index {index.min() if index.min() < -n else index.max()} is out of range for {n} windows."
            )
        index %= n
        table = self.table
        rows: Mapping[str, Any]
        if self.preload:
            loaded, starts = self._load()
            rows, start = loaded.rows, starts[index]
        else:
            rows, start = self._disk.fetch(table, index)
        return self._finish(self._assemble(rows, start, table.count[index], table.after[index]))

    def _finish(self, batch: Batch) -> Batch:
        return batch

    def __getitem__(self, index: int | Sequence[int]) -> Batch:
        """Return one window, or a batch for a list of indices (from a batch sampler)."""
        number = whole_number(index)
        if number is None:
            return self.batch(index)  # type: ignore[arg-type]
        return {name: value[0] for name, value in self.batch([number]).items()}

    def __getitems__(self, indices: Sequence[int]) -> list[Batch]:
        """Return several windows as a list; ``DataLoader`` calls this once per batch."""
        batch = self.batch(indices)
        return [{name: value[i] for name, value in batch.items()} for i in range(len(indices))]

    def info(self, index: int) -> dict[str, int]:
        """Return where window `index` lies.

        Returns
        -------
        dict
            ``sequence``, ``episode``, ``step`` (of the first row), ``rows`` (without padding), ``shard`` and
            ``row`` in it.
        """
        n, number = len(self.table), whole_number(index)
        if number is None or not -n <= number < n:
            raise IndexError(f"index {one_line(repr(index))} is out of range for {n} windows.")
        t = self.table
        names = {
            "sequence": t.sequence,
            "episode": t.episode,
            "step": t.step,
            "rows": t.count,
            "shard": t.shard,
            "row": t.start,
        }
        return {name: int(values[number]) for name, values in names.items()}

    @property
    def provenance(self) -> dict[str, Any]:
        """What a checkpoint records of the dataset it was trained on, see :func:`navrep_data.shards.dataset_record`."""
        return self._folder.provenance

    def close(self) -> None:
        """Close the open files; the next access opens them again."""
        self._folder.close()


__all__ = [
    "Batch",
    "DatasetFolder",
    "Invalid",
    "Lidar",
    "ScanUnit",
    "Split",
    "WindowDataset",
    "cut",
    "make_spec",
    "open_folder",
    "select_episodes",
]
