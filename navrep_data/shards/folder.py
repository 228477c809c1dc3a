"""A dataset folder: its manifest, its shards opened on demand, and an index of its episodes."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.errors import ConfigError, CorruptDataError, did_you_mean
from navrep_data.io import safe_join
from navrep_data.shards.entries import SPLITS
from navrep_data.shards.manifest import Manifest
from navrep_data.shards.reader import Shard
from navrep_data.shards.worlds import Worlds, read_worlds

MAX_OPEN_SHARDS = 128
"""Shards kept open: per shard one file handle, its chunk table, its last decoded chunks and its narrow
columns, about 70 bytes per row. Opening one costs milliseconds, so random access needs most of a dataset
open."""

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Episodes:
    """Every episode of a dataset, in order: arrays of equal length.

    Attributes
    ----------
    sequence, episode : ndarray of shape (E,), int64
        Indices as in the columns.
    shard : ndarray of shape (E,), int64
        Position of its shard in ``manifest.shards``.
    start, length : ndarray of shape (E,), int64
        First row within that shard, and number of rows (T actions = T + 1 rows).
    event : ndarray of shape (E,), uint8
        Why it ended.
    split : ndarray of shape (E,), int8
        Position in :data:`SPLITS`, -1 where in none.
    """

    sequence: Ints
    episode: Ints
    shard: Ints
    start: Ints
    length: Ints
    event: npt.NDArray[np.uint8]
    split: npt.NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.sequence)

    def in_split(self, split: str | None) -> Ints:
        """Return the positions of the episodes of a split, of all episodes for None.

        Raises
        ------
        ConfigError
            If there is no such split.
        """
        if split is None:
            return np.arange(len(self))
        if split not in SPLITS:
            raise ConfigError(f"Unknown split {split!r}; expected {', '.join(SPLITS)}.{did_you_mean(split, SPLITS)}")
        return np.flatnonzero(self.split == SPLITS.index(split))


class DatasetFolder:
    """A dataset on disk, for reading.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    max_open : int
        Shards kept open at a time.

    Attributes
    ----------
    manifest : Manifest
        Its checked manifest.

    Raises
    ------
    DatasetNotFoundError, SchemaVersionError, CorruptDataError
        See :meth:`Manifest.read`.

    Notes
    -----
    Can be pickled and forked: shards are opened again on demand.
    """

    def __init__(self, root: Path | str, *, max_open: int = MAX_OPEN_SHARDS) -> None:
        self.root = Path(root)
        self.manifest = Manifest.read(self.root)
        self._max_open = max(1, max_open)
        self._open: OrderedDict[int, Shard] = OrderedDict()
        self._lock, self._pid = threading.Lock(), os.getpid()
        self._episodes: Episodes | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": OrderedDict(), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock, self._pid = threading.Lock(), os.getpid()

    def __enter__(self) -> DatasetFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all shards; reading opens them again."""
        with self._lock:
            while self._open:
                self._open.popitem()[1].close()

    def shard(self, index: int) -> Shard:
        """Return shard `index` (position in ``manifest.shards``), opened if it was not."""
        if self._pid != os.getpid():  # forked, perhaps while another thread held the lock
            self._lock, self._pid = threading.Lock(), os.getpid()
        with self._lock:
            shard = self._open.get(index)
            if shard is not None:
                self._open.move_to_end(index)
                return shard
        entry = self.manifest.shards[index]
        shard = Shard(safe_join(self.root, entry.file), entry)
        manifest = self.manifest
        if tuple(shard.columns) != manifest.columns or shard.sensor != manifest.sensor:
            raise CorruptDataError(
                f"{shard.path} has other columns or another sensor than the manifest says. "
                f"Run `navrep-data verify {self.root}`, then run the generate command again."
            )
        with self._lock:
            # A shard that falls out is closed when its last user lets go of it, not under a reader's hands.
            self._open[index] = shard
            self._open.move_to_end(index)
            while len(self._open) > self._max_open:
                self._open.popitem(last=False)
        return shard

    def read(self, column: str, shard: int, start: int, stop: int) -> npt.NDArray[Any]:
        """Return rows [start, stop) of `column` in shard `shard`; see :meth:`Shard.read`."""
        return self.shard(shard).read(column, start, stop)

    def worlds(self, shard: int) -> Worlds | None:
        """Return the worlds beside shard `shard`, None if there are none."""
        entry = self.manifest.shards[shard].worlds
        return None if entry is None else read_worlds(safe_join(self.root, entry.file))

    @property
    def episodes(self) -> Episodes:
        """The index of all episodes, built once from the shards' narrow columns."""
        if self._episodes is None:
            self._episodes = self._index()
        return self._episodes

    def _index(self) -> Episodes:
        parts: list[list[npt.NDArray[Any]]] = []
        for k in range(len(self.manifest.shards)):
            shard = self.shard(k)
            first = np.flatnonzero(shard.read("is_first", 0, shard.rows))
            if not len(first) or first[0] != 0:
                raise CorruptDataError(
                    f"{shard.path} does not start with an episode's first row; run `navrep-data verify {self.root}`."
                )
            stop = np.append(first[1:], shard.rows)
            parts.append(
                [
                    shard.read_rows("sequence", first).astype(np.int64),
                    shard.read_rows("episode", first).astype(np.int64),
                    np.full(len(first), k, np.int64),
                    first,
                    stop - first,
                    shard.read_rows("event", stop - 1),
                ]
            )
        if not parts:
            none = np.empty(0, np.int64)
            return Episodes(none, none, none, none, none, none.astype(np.uint8), none.astype(np.int8))
        sequence, episode, where, start, length, event = (np.concatenate(c) for c in zip(*parts, strict=True))
        split = np.full(len(sequence), -1, np.int8)
        for code, name in enumerate(SPLITS):
            ranges = np.array(sorted(self.manifest.splits.get(name, ())), np.int64).reshape(-1, 2)
            if len(ranges):
                at = np.searchsorted(ranges[:, 0], sequence, side="right") - 1
                split[(at >= 0) & (sequence < ranges[np.maximum(at, 0), 1])] = code
        return Episodes(sequence, episode, where, start, length, event, split)


def info(root: Path | str) -> dict[str, Any]:
    """Return what ``navrep-data info --json`` prints about the dataset in `root`.

    Parameters
    ----------
    root : path-like
        Dataset folder.

    Returns
    -------
    dict
        JSON values: env, physics, seed, sequences, rows, shards, bytes, bytes_per_row, columns, splits
        (sequences per split), outcomes, versions, complete and others.
    """
    m = Manifest.read(root)
    return {
        "root": str(root),
        "format_version": m.format_version,
        "env": m.env,
        "physics": m.physics,
        "seed": m.seed,
        "complete": m.complete,
        "planned": m.planned,
        "sequences": m.sequences,
        "length": m.length,
        "rows": m.rows,
        "shards": len(m.shards),
        "bytes": m.bytes,
        "bytes_per_row": round(m.bytes / m.rows, 1) if m.rows else None,
        "scan_dtype": m.scan_dtype,
        "columns": list(m.columns),
        "splits": {name: sum(b - a for a, b in ranges) for name, ranges in m.splits.items()},
        "outcomes": m.statistics.get("outcomes", {}),
        "policy": m.policy,
        "versions": m.versions,
    }
