"""What a manifest lists: files, shards, and which sequence is in which split."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from navrep_data.shards.source import SequenceSource

SPLITS = ("train", "val", "test")
SPLIT_RULE = "sequence % 10 == 1: val; sequence % 10 == 2: test; all others: train"

Ranges = tuple[tuple[int, int], ...]


def shard_file(index: int) -> str:
    """Return the name of shard `index` inside the dataset folder."""
    return f"data/shard-{index:05d}.h5"


def worlds_file(index: int) -> str:
    """Return the name of the worlds file of shard `index` inside the dataset folder."""
    return f"worlds/shard-{index:05d}.npz"


@dataclass(frozen=True)
class FileEntry:
    """A file that belongs to a dataset.

    Attributes
    ----------
    file : str
        Relative POSIX path.
    sha256 : str
        Its hash.
    bytes : int
        Its size.
    """

    file: str
    sha256: str
    bytes: int


@dataclass(frozen=True)
class ShardEntry:
    """A shard as the manifest lists it.

    Attributes
    ----------
    file, sha256, bytes
        As in :class:`FileEntry`.
    rows : int
        Number of rows.
    sequences : tuple of int
        First sequence, and the one after the last.
    worlds : FileEntry or None
        The worlds file beside it.
    statistics : dict
        See :mod:`navrep_data.shards.statistics`.
    sequence_hashes : tuple of str
        Content hash per sequence.
    source : tuple of SequenceSource
        Where each sequence came from, in datasets made out of others; empty elsewhere.
    """

    file: str
    sha256: str
    bytes: int
    rows: int
    sequences: tuple[int, int]
    worlds: FileEntry | None
    statistics: dict[str, Any] = field(repr=False)
    sequence_hashes: tuple[str, ...] = field(repr=False)
    source: tuple[SequenceSource, ...] = field(default=(), repr=False)


def split_of(sequence: int) -> str:
    """Return the split of a sequence by the default rule (:data:`SPLIT_RULE`)."""
    return {1: "val", 2: "test"}.get(sequence % 10, "train")


def ranges_of(sequences: Iterable[int]) -> Ranges:
    """Return ascending indices as [start, stop) ranges."""
    result: list[tuple[int, int]] = []
    for k in sequences:
        if result and result[-1][1] == k:
            result[-1] = (result[-1][0], k + 1)
        else:
            result.append((k, k + 1))
    return tuple(result)


def default_splits(n: int) -> dict[str, Ranges]:
    """Return the default split of sequences 0 to n - 1.

    Parameters
    ----------
    n : int
        Number of sequences.

    Returns
    -------
    dict of str to tuple of (start, stop)
        Ranges of sequence indices for train (80 %), val (10 %) and test (10 %).

    Notes
    -----
    Three sequences already have all three splits, and extending a dataset never moves a sequence to another
    one.
    """
    return {name: ranges_of(k for k in range(n) if split_of(k) == name) for name in SPLITS}
