"""What a manifest lists: files, shards, and which sequence is in which split."""

from __future__ import annotations

import itertools
import re
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from navrep_data.errors import SchemaVersionError
from navrep_data.schema import FORMAT_VERSION, OLDEST_FORMAT

SPLITS = ("train", "val", "test")
SPLIT_RULE = "sequence % 10 == 1: val; sequence % 10 == 2: test; all others: train"

# Of each ten sequences that follow each other, those of each split.
_PERIOD = 10
_MEMBERS = {"train": (0, 3, 4, 5, 6, 7, 8, 9), "val": (1,), "test": (2,)}
_SPLIT_OF = {k: name for name, members in _MEMBERS.items() for k in members}

Ranges = tuple[tuple[int, int], ...]

INDEX_FILE = "index.json"
_SHARD = r"(?:train|val|test)-[0-9]{5,10}"
# Names that the format gives to files, apart from those of which a folder has one.
EXTRA_NAME = re.compile(rf"media/[A-Za-z0-9][\w.-]{{0,99}}\.(?:png|gif)|{re.escape(INDEX_FILE)}")
SHARD_NAMES = {split: re.compile(rf"data/{split}-[0-9]{{5,10}}\.h5") for split in SPLITS}
FILE_NAME = re.compile(rf"data/{_SHARD}\.h5|worlds/{_SHARD}\.npz|{EXTRA_NAME.pattern}")


def shard_file(split: str, index: int) -> str:
    """Return the name of shard `index` of a split inside the dataset folder."""
    return f"data/{split}-{index:05d}.h5"


def worlds_file(shard: str) -> str:
    """Return the name of the worlds file beside the shard with this name."""
    return f"worlds/{shard.removeprefix('data/').removesuffix('.h5')}.npz"


def shard_pattern(split: str) -> str:
    """Return a pattern of the shell for all shards of a split."""
    return f"data/{split}-*.h5"


class SequenceSource(NamedTuple):
    """Where a sequence came from.

    Attributes
    ----------
    dataset : int
        Position in the manifest's `source`.
    sequence : int
        Its number there.
    row : int
        Its first row, counted from the first row of that sequence.
    content_hash : str
        The whole sequence's :func:`navrep_data.shards.sequence_hash` there.
    """

    dataset: int
    sequence: int
    row: int
    content_hash: str


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
    split : str
        The split that all its sequences belong to.
    sequences : tuple of (start, stop)
        Numbers of its sequences, ascending, as ranges [start, stop).
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
    split: str
    sequences: Ranges
    worlds: FileEntry | None
    statistics: dict[str, Any] = field(repr=False)
    sequence_hashes: tuple[str, ...] = field(repr=False)
    source: tuple[SequenceSource, ...] = field(default=(), repr=False)

    @property
    def order(self) -> tuple[int, int]:
        """Where it comes in a dataset: by split, then by its first sequence."""
        return SPLITS.index(self.split), self.sequences[0][0]

    @property
    def count(self) -> int:
        """Number of its sequences."""
        return count_of(self.sequences)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of its sequences, ascending."""
        return tuple(numbers_of(self.sequences))

    def position(self, sequence: int) -> int | None:
        """Return how many of its sequences come before `sequence`, None where it is not one of them."""
        before = 0
        for start, stop in self.sequences:
            if start <= sequence < stop:
                return before + sequence - start
            before += stop - start
        return None


def split_of(sequence: int) -> str:
    """Return the split of a sequence by the default rule (:data:`SPLIT_RULE`)."""
    return _SPLIT_OF[sequence % _PERIOD]


def count_in_split(split: str, n: int) -> int:
    """Return how many of the sequences 0 to n - 1 are in a split by the default rule."""
    whole, rest = divmod(n, _PERIOD)
    return whole * len(_MEMBERS[split]) + bisect_left(_MEMBERS[split], rest)


def nth_of_split(split: str, k: int) -> int:
    """Return the number of the k-th sequence (from 0) of a split by the default rule."""
    period, at = divmod(k, len(_MEMBERS[split]))
    return period * _PERIOD + _MEMBERS[split][at]


def count_of(ranges: Ranges) -> int:
    """Return how many numbers are in [start, stop) ranges."""
    return sum(stop - start for start, stop in ranges)


def numbers_of(ranges: Ranges) -> Iterator[int]:
    """Yield the numbers in [start, stop) ranges."""
    return itertools.chain.from_iterable(range(start, stop) for start, stop in ranges)


def ranges_of(sequences: Iterable[int]) -> Ranges:
    """Return ascending indices as [start, stop) ranges."""
    result: list[tuple[int, int]] = []
    for k in sequences:
        if result and result[-1][1] == k:
            result[-1] = (result[-1][0], k + 1)
        else:
            result.append((k, k + 1))
    return tuple(result)


def check_version(where: str, version: float) -> None:
    """Refuse what is of another format version than this package reads.

    Raises
    ------
    SchemaVersionError
        Saying what to do.
    """
    if version > FORMAT_VERSION:
        raise SchemaVersionError(
            f"{where} has format version {version:g}; this package reads versions {OLDEST_FORMAT} to {FORMAT_VERSION}. "
            "Upgrade it: pip install -U navrep-data"
        )
    if version < OLDEST_FORMAT:
        raise SchemaVersionError(
            f"{where} has format version {version:g}, which was never released; expected {OLDEST_FORMAT} or newer: "
            "generate or import it again into a new folder."
        )
