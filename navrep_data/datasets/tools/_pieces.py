"""Runs of rows of existing datasets, and a new dataset made out of them."""

from __future__ import annotations

import functools
import itertools
import os
import platform
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data._version import __version__
from navrep_data.errors import ConfigError, CorruptDataError, DatasetError, DatasetMismatchError
from navrep_data.schema import COLUMNS
from navrep_data.shards import (
    MAX_SHARD_BYTES,
    SPLITS,
    DatasetFolder,
    DatasetWriter,
    FileEntry,
    Manifest,
    SequenceSource,
    ShardEntry,
    Worlds,
    check_file,
    dataset_record,
    estimate_bytes,
    take_episodes,
)

Arrays = dict[str, npt.NDArray[Any]]
Progress = Callable[[int, int], None]
TARGET_SHARD_ROWS = 20_000
"""Rows per shard that tools aim at: as many as ``generate`` puts there."""
FOLLOWED_RULE = "each sequence is in the split of the sequence it came from"


@dataclass(frozen=True)
class Piece:
    """Whole consecutive episodes of one sequence, which become a sequence.

    Attributes
    ----------
    given : Given
        The dataset that holds them.
    shard : int
        Position of the shard in its manifest.
    start, stop : int
        Rows of the shard.
    episodes : tuple of int
        First episode and the one after the last, counted within the shard.
    split : str
        Split of the sequence there.
    source : SequenceSource
        Where the rows came from in the first place; `dataset` counts in the records of `given`.
    """

    given: Given
    shard: int
    start: int
    stop: int
    episodes: tuple[int, int]
    split: str
    source: SequenceSource

    def columns(self) -> Arrays:
        """Return all columns as they are stored."""
        given = self.given
        given.check(self.shard)
        return {name: given.folder.read(name, self.shard, self.start, self.stop) for name in given.manifest.columns}

    def read(self, number: int, max_humans: int) -> tuple[Arrays, Arrays | None]:
        """Return columns and worlds, as those of sequence `number` with `max_humans` slots."""
        columns = self.columns()
        columns["sequence"][:] = number
        first_episode = columns["episode"][0]
        columns["episode"] -= first_episode
        if "humans" in columns:
            missing = max_humans - columns["humans"].shape[1]
            columns["humans"] = np.pad(columns["humans"], ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)
        worlds = self.given.worlds(self.shard)
        if worlds is None:
            return columns, None
        part = take_episodes(worlds.arrays, *self.episodes)
        part["sequence"][:] = number
        part["episode"] -= first_episode
        part["row"] -= self.start
        return columns, part


class Given:
    """A dataset that a tool reads.

    Parameters
    ----------
    root : path-like
        Dataset folder: complete, or a part of a complete one.

    Attributes
    ----------
    root : pathlib.Path
        Its folder.
    folder : DatasetFolder
        Opened.
    manifest : Manifest
        Its manifest.
    records : tuple of dict
        What its sequences came from in the first place: itself, unless it was made out of others.

    Raises
    ------
    DatasetError
        If its generation has not ended.
    DatasetNotFoundError, SchemaVersionError, CorruptDataError
        If there is no dataset that can be read.
    """

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = Path(root)
        self.folder = DatasetFolder(self.root)
        self.manifest = self.folder.manifest
        if not (self.manifest.complete or self.manifest.partial):
            raise DatasetError(f"{root} is not finished; run its generate command again, then use it.")
        self.records = self.manifest.source or (_record(self.folder),)
        # one shard's worlds are read episode by episode
        self.worlds = functools.lru_cache(maxsize=1)(self._worlds)
        self._checked: set[int] = set()

    def check(self, shard: int) -> None:
        """Raise CorruptDataError unless the shard and its worlds have the bytes that the manifest says.

        Their content gets new hashes; without this, damage would get a right one.
        """
        if shard in self._checked:
            return
        entry = self.manifest.shards[shard]
        listed: list[FileEntry | ShardEntry] = [entry, *([entry.worlds] if entry.worlds else [])]
        for one in listed:
            if bad := check_file(self.root, one):
                raise CorruptDataError(f"{self.root / one.file} {bad}.")
        self._checked.add(shard)

    def _worlds(self, shard: int) -> Worlds | None:
        return self.folder.worlds(shard)

    def pieces(self, keep: npt.NDArray[np.bool_] | None = None) -> list[Piece]:
        """Return the longest runs of consecutive episodes to keep, none across two sequences; all by default.

        Parameters
        ----------
        keep : ndarray of shape (episodes,), bool, optional
            For each episode of ``folder.episodes``.
        """
        e = self.folder.episodes
        keep = np.ones(len(e), bool) if keep is None else keep
        new = np.append(True, np.diff(e.sequence) != 0)[: len(e)]
        begins = keep & (new | ~np.append(False, keep[:-1]))
        ends = keep & (np.append(new[1:], True) | ~np.append(keep[1:], False))
        first_of_sequence = np.maximum.accumulate(np.where(new, np.arange(len(e)), 0))
        # episodes are in the order of their sequences, as those of each shard are
        by_shard = np.argsort(e.shard, kind="stable")
        in_shard = np.empty(len(e), np.int64)
        in_shard[by_shard] = np.arange(len(e)) - np.searchsorted(e.shard[by_shard], e.shard[by_shard], side="left")
        result = []
        for i, j in zip(np.flatnonzero(begins).tolist(), np.flatnonzero(ends).tolist(), strict=True):
            sequence, shard = int(e.sequence[i]), int(e.shard[i])
            row = int(e.start[i] - e.start[first_of_sequence[i]])
            episodes = (int(in_shard[i]), int(in_shard[j]) + 1)
            start, stop = int(e.start[i]), int(e.start[j] + e.length[j])
            split = SPLITS[e.split[i]]
            result.append(Piece(self, shard, start, stop, episodes, split, self._source(shard, sequence, row)))
        return result

    def _source(self, shard: int, sequence: int, row: int) -> SequenceSource:
        entry = self.manifest.shards[shard]
        k = entry.position(sequence)
        assert k is not None
        if not entry.source:
            return SequenceSource(0, sequence, row, entry.sequence_hashes[k])
        known = entry.source[k]
        return known._replace(row=known.row + row)


def _record(folder: DatasetFolder) -> dict[str, Any]:
    """Return what a manifest says of a dataset that it was made out of."""
    m = folder.manifest
    return {
        **dataset_record(folder),
        "split_rule": m.split_rule,
        "policy": m.policy,
        "versions": m.versions,
        "command": m.command,
        "config": m.config,
        "inputs": dict(m.inputs),
        "origins": {name: list(place) for name, place in m.origins.items()},
    }


def check_sources(pieces: Sequence[Piece]) -> None:
    """Make sure that no row comes twice, and no sequence's rows get into two splits.

    Raises
    ------
    DatasetMismatchError
        Naming the datasets.
    """
    held: dict[str, list[Piece]] = {}
    for piece in pieces:
        held.setdefault(piece.source.content_hash, []).append(piece)
    for same in held.values():
        same.sort(key=lambda p: p.source.row)
        for a, b in itertools.pairwise(same):
            what = f"sequence {a.source.sequence} (content {a.source.content_hash[:12]}...)"
            if a.split != b.split:
                raise DatasetMismatchError(
                    f"{what} is in split {a.split} in {a.given.root} and in {b.split} in {b.given.root}; "
                    "expected one split, or training would see what it is tested on. Split after merging."
                )
            if a.source.row + a.stop - a.start > b.source.row:
                raise DatasetMismatchError(
                    f"Row {b.source.row} of {what} is both in {a.given.root} and in {b.given.root}; "
                    "expected datasets that have nothing in common. Leave one out."
                )


def write_dataset(
    root: Path,
    pieces: Sequence[Piece],
    *,
    command: str,
    splits: Sequence[str] | None = None,
    split_rule: str | None = None,
    progress: Progress | None = None,
) -> Manifest:
    """Write the dataset that consists of `pieces`, in their order.

    Parameters
    ----------
    root : pathlib.Path
        Empty folder.
    pieces : sequence of Piece
        At least one; their datasets agree in environment, sensor and columns.
    command : str
        For the manifest.
    splits : sequence of str, optional
        Split of each piece; that of its sequence by default.
    split_rule : str, optional
        In words; goes with `splits`.
    progress : callable, optional
        Called with (sequences done, sequences in all).

    Raises
    ------
    CorruptDataError
        If a file that is read is damaged.
    DiskSpaceError, FolderNotWritableError
        If it cannot be written.
    """
    given = list(dict.fromkeys(piece.given for piece in pieces))
    records = _joined_records(given)
    manifest = _plan(given, pieces, tuple(records.values()), command)
    # position of each record in the new manifest, by its hash
    number = {content: k for k, content in enumerate(records)}
    chosen = [piece.split for piece in pieces] if splits is None else splits
    writer = DatasetWriter(root, replace(manifest, split_rule=split_rule or _followed_rule(given)))
    for k, (piece, split) in enumerate(zip(pieces, chosen, strict=True)):
        record = piece.given.records[piece.source.dataset]
        source = piece.source._replace(dataset=number[record["content_hash"]])
        writer.append(k, split, *piece.read(k, manifest.max_humans), source=source)
        if progress is not None:
            progress(k + 1, len(pieces))
    for one in given:
        one.folder.close()
    return writer.finish()


def _joined_records(given: Iterable[Given]) -> dict[str, dict[str, Any]]:
    """Return the records of all datasets by content hash, each once."""
    return {record["content_hash"]: record for one in given for record in one.records}


def _followed_rule(given: Sequence[Given]) -> str:
    """Return the rule in words; what already follows a rule is not told twice."""
    before = f"{FOLLOWED_RULE} ("
    rules = {one.manifest.split_rule for one in given}
    rules = {rule[len(before) : -1] if rule.startswith(before) else rule for rule in rules}
    return f"{before}{rules.pop()})" if len(rules) == 1 else FOLLOWED_RULE


def _plan(
    given: Sequence[Given], pieces: Sequence[Piece], records: tuple[dict[str, Any], ...], command: str
) -> Manifest:
    """Return the manifest of the new dataset without shards."""
    all_m = [one.manifest for one in given]
    m = all_m[0]
    same = {key for key in m.config if all(key in o.config and o.config[key] == m.config[key] for o in all_m)}
    length, max_humans = max(o.length for o in all_m), max(o.max_humans for o in all_m)
    return replace(
        m,
        length=length,
        max_humans=max_humans,
        planned=len(pieces),
        shard_size=_shard_size(m, [p.stop - p.start for p in pieces], max_humans),
        config={key: value for key, value in m.config.items() if key in same},
        inputs={k: v for k, v in m.inputs.items() if all(o.inputs.get(k) == v for o in all_m)},
        origins={k: v for k, v in m.origins.items() if all(o.origins.get(k) == v for o in all_m)},
        policy=m.policy if all(o.policy == m.policy for o in all_m) else {"name": "several"},
        versions={"navrep-data": __version__, "numpy": np.__version__, "python": platform.python_version()},
        license=m.license if all(o.license == m.license for o in all_m) else None,
        command=command,
        source=records,
    )


def _shard_size(m: Manifest, rows: Sequence[int], max_humans: int) -> int:
    """Return the sequences per shard: about :data:`TARGET_SHARD_ROWS` rows, none too large to be made in memory."""

    def largest(size: int) -> int:
        return max(sum(rows[k : k + size]) for k in range(0, len(rows), size))

    width: dict[str, Any] = {"n_rays": m.sensor.n_rays, "scan_dtype": m.scan_dtype, "max_humans": max_humans}
    size = max(1, TARGET_SHARD_ROWS * len(rows) // sum(rows))
    while size > 1 and estimate_bytes(m.columns, largest(size), **width) > MAX_SHARD_BYTES:
        size //= 2
    return size


def check_alike(given: Sequence[Given]) -> None:
    """Make sure that datasets can be one: the same environment, physics, sensor, columns and scan dtype.

    Raises
    ------
    DatasetMismatchError
        Naming the first thing that differs, and both datasets.
    """
    first = given[0]
    for other in given[1:]:
        for what, a, b in zip(_KINDS, _kind(first), _kind(other), strict=True):
            if a != b:
                raise DatasetMismatchError(
                    f"{first.root} has {what} {a}, {other.root} has {b}; expected datasets of one kind. Leave one out."
                )


_KINDS = ("environment", "physics", "sensor", "columns", "scan dtype", "worlds files")


def _kind(one: Given) -> tuple[str, ...]:
    m = one.manifest
    sensor = ", ".join(f"{name}={value:g}" for name, value in m.sensor.to_dict().items())
    worlds = "on all shards" if all(s.worlds for s in m.shards) else "not on all shards"
    return m.env, m.physics, sensor, ", ".join(c for c in COLUMNS if c in m.columns), m.scan_dtype, worlds


def check_not_empty(pieces: Sequence[Piece], why: str) -> None:
    """Raise ConfigError with the reason if there is nothing left."""
    if not pieces:
        raise ConfigError(f"Nothing is left: {why}")
