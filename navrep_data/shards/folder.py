"""A dataset folder: its manifest, its shards opened on demand, and an index of its episodes."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.errors import ConfigError, CorruptDataError, did_you_mean
from navrep_data.io import safe_join
from navrep_data.shards.content import content_hash
from navrep_data.shards.entries import SPLITS, ShardEntry, count_of
from navrep_data.shards.manifest import Manifest
from navrep_data.shards.origin import Origin, read_origin
from navrep_data.shards.reader import Shard
from navrep_data.shards.worlds import Worlds, read_worlds

MAX_OPEN_SHARDS = 128
"""Shards kept open: per shard one file handle, its chunk table, its last decoded chunks and its narrow
columns, about 70 bytes per row. Opening one costs milliseconds, so random access needs most of a dataset
open."""

Ints = npt.NDArray[np.int64]
ShardIndex = tuple[Ints, Ints, Ints, npt.NDArray[np.uint8]]
"""Of the episodes of one shard: sequence, episode, first row, event."""


@dataclass(frozen=True)
class Episodes:
    """Every episode of a dataset, in the order of their sequences: arrays of equal length.

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
        Position in :data:`SPLITS`.
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
    manifest : Manifest, optional
        Instead of the one in the folder: with some of its shards only.
    origin : Origin, optional
        Where it came from; by default as written in the folder.

    Attributes
    ----------
    manifest : Manifest
        Its checked manifest.
    origin : Origin or None
        The Hub repository and commit it came from, if it did.

    Raises
    ------
    DatasetNotFoundError, SchemaVersionError, CorruptDataError
        See :meth:`Manifest.read`.

    Notes
    -----
    Can be pickled and forked: shards are opened again on demand.
    """

    def __init__(
        self,
        root: Path | str,
        *,
        max_open: int = MAX_OPEN_SHARDS,
        manifest: Manifest | None = None,
        origin: Origin | None = None,
    ) -> None:
        self.root = Path(root)
        self.manifest = Manifest.read(self.root) if manifest is None else manifest
        self.origin = read_origin(self.root) if origin is None else origin
        # shards are opened when they are read, perhaps by a worker or from another working folder
        self.root = self.root.absolute()
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
        shard = self._open_shard(self.manifest.shards[index])
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

    def _open_shard(self, entry: ShardEntry) -> Shard:
        """Open a shard of the manifest; where shards are fetched on demand, this is where."""
        return Shard(safe_join(self.root, entry.file), entry)

    def expect(self, shards: Iterable[int]) -> None:
        """Take note of which shards will be read next, in this order; folders that fetch on demand use it."""

    @property
    def provenance(self) -> dict[str, Any]:
        """What a checkpoint records of the dataset it was trained on: see :func:`dataset_record`."""
        return dataset_record(self)

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

    def _index_shard(self, k: int) -> ShardIndex:
        """Return the index of the episodes of shard `k`, from its narrow columns."""
        shard = self.shard(k)
        first = np.flatnonzero(shard.read("is_first", 0, shard.rows))
        if not len(first) or first[0] != 0:
            raise CorruptDataError(
                f"{shard.path} does not start with an episode's first row; run `navrep-data verify {self.root}`."
            )
        stop = np.append(first[1:], shard.rows)
        return (
            shard.read_rows("sequence", first).astype(np.int64),
            shard.read_rows("episode", first).astype(np.int64),
            first,
            shard.read_rows("event", stop - 1),
        )

    def _index(self) -> Episodes:
        return join_index(self.manifest, [self._index_shard(k) for k in range(len(self.manifest.shards))])


def join_index(manifest: Manifest, parts: Sequence[ShardIndex]) -> Episodes:
    """Return the episodes of all shards: per shard sequence, episode, first row and event of each episode."""
    if not parts:
        none = np.empty(0, np.int64)
        return Episodes(none, none, none, none, none, none.astype(np.uint8), none.astype(np.int8))
    where = np.concatenate([np.full(len(part[0]), k, np.int64) for k, part in enumerate(parts)])
    length = np.concatenate(
        [np.diff(np.append(part[2], entry.rows)) for part, entry in zip(parts, manifest.shards, strict=True)]
    )
    sequence, episode, start, event = (np.concatenate(column) for column in zip(*parts, strict=True))
    split = np.array([SPLITS.index(entry.split) for entry in manifest.shards], np.int8)[where]
    order = np.argsort(sequence, kind="stable")
    return Episodes(*(column[order] for column in (sequence, episode, where, start, length, event, split)))


def dataset_record(dataset: DatasetFolder | Path | str) -> dict[str, Any]:
    """Return what identifies a dataset wherever it lies: for the checkpoint of what was trained on it.

    Parameters
    ----------
    dataset : DatasetFolder or path-like
        An open dataset, or its folder.

    Returns
    -------
    dict
        JSON values: ``name`` (environment, physics, seed), ``repo`` and ``revision`` (Hub repository and commit, None
        where it did not come from there), ``content_hash`` (:func:`content_hash` of its rows), ``sequences``, ``rows``
        and ``partial`` (whether it is a part of a larger one).
    """
    folder = dataset if isinstance(dataset, DatasetFolder) else DatasetFolder(dataset)
    m, origin = folder.manifest, folder.origin
    return {
        "name": f"{m.env}, {m.physics} physics, seed {m.seed}",
        "repo": origin.repo if origin else None,
        "revision": origin.commit if origin else None,
        "content_hash": content_hash(m),
        "sequences": m.sequences,
        "rows": m.rows,
        "partial": not m.complete,
    }


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
        (sequences per split), outcomes, versions, complete, content_hash, license, partial (what the whole has, where
        this is a part), source (the datasets it was made out of), origin (Hub repository and commit) and
        others.
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
        "splits": {name: count_of(ranges) for name, ranges in m.splits.items()},
        "outcomes": m.statistics.get("outcomes", {}),
        "policy": m.policy,
        "versions": m.versions,
        "license": m.license,
        "content_hash": content_hash(m),
        "partial": m.partial,
        "source": list(m.source) or None,
        "origin": origin.to_dict() if (origin := read_origin(root)) else None,
    }
