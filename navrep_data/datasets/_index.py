"""Which rows belong to which window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from navrep_data.shards import Episodes

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class WindowTable:
    """Where each window lies; all arrays have shape (windows,), int64.

    Attributes
    ----------
    shard : ndarray
        Index of the shard in the manifest.
    sequence : ndarray
        Sequence index in the dataset.
    episode : ndarray
        Episode, within the sequence, of the window's first row.
    step : ndarray
        Rows before the window in its episode (in its sequence where windows cross episodes).
    start : ndarray
        First row in the shard.
    count : ndarray
        Number of real rows; the rest of the window is padding.
    after : ndarray
        1 where one more row follows in the same episode (sequence), for ``targets``.
    """

    shard: Ints
    sequence: Ints
    episode: Ints
    step: Ints
    start: Ints
    count: Ints
    after: Ints

    def __len__(self) -> int:
        return len(self.start)


@dataclass(frozen=True)
class SequenceTable:
    """Where each sequence lies; all arrays have shape (sequences,), int64, in ascending order of `sequence`.

    Attributes
    ----------
    sequence : ndarray
        Sequence index in the dataset.
    shard : ndarray
        Index of its shard in the manifest.
    start : ndarray
        First row in the shard.
    rows : ndarray
        Number of rows.
    """

    sequence: Ints
    shard: Ints
    start: Ints
    rows: Ints

    def __len__(self) -> int:
        return len(self.sequence)


def sequences_of(episodes: Episodes) -> SequenceTable:
    """Return the sequences that the rows of an episode table (ordered by sequence) make up."""
    sequence, first = np.unique(episodes.sequence, return_index=True)
    length = episodes.length
    return SequenceTable(
        sequence=sequence,
        shard=episodes.shard[first],
        start=episodes.start[first],
        rows=np.add.reduceat(length, first) if len(first) else np.zeros(0, np.int64),
    )


def _owners(per_owner: Ints) -> tuple[Ints, Ints]:
    """Return, for `per_owner` windows each, the owner of every window and the window's rank at its owner."""
    owner = np.repeat(np.arange(len(per_owner)), per_owner)
    before = np.cumsum(per_owner) - per_owner
    return owner, np.arange(len(owner)) - before[owner]


def within_episodes(episodes: Episodes, window: int, stride: int) -> WindowTable:
    """Cut every episode into windows at ``k * stride``; the last ones may be short.

    Parameters
    ----------
    episodes : Episodes
        Of a dataset, or some of them, in their order.
    window, stride : int
        Rows per window, rows between the starts of two windows.
    """
    length = episodes.length
    owner, rank = _owners(-(-length // stride))
    step = rank * stride
    count = np.minimum(window, length[owner] - step)
    return WindowTable(
        shard=episodes.shard[owner],
        sequence=episodes.sequence[owner],
        episode=episodes.episode[owner],
        step=step,
        start=episodes.start[owner] + step,
        count=count,
        after=(step + count < length[owner]).astype(np.int64),
    )


def across_episodes(episodes: Episodes, window: int, stride: int) -> WindowTable:
    """Cut every sequence into whole windows at ``1 + k * stride``, each with one more row after it.

    Notes
    -----
    navrep/tools/wdataset.py does so through all files put end to end; here every sequence is cut by itself,
    so no window joins two sequences.
    """
    sequences = sequences_of(episodes)
    owner, rank = _owners(np.maximum((sequences.rows - window - 2) // stride + 1, 0))
    step = 1 + rank * stride
    start = sequences.start[owner] + step
    # The episode of the first row: the last one of the table that starts at or before it.
    ends = np.cumsum(episodes.length)
    rows_before = np.cumsum(sequences.rows) - sequences.rows
    at = np.searchsorted(ends, rows_before[owner] + step, side="right")
    return WindowTable(
        shard=sequences.shard[owner],
        sequence=sequences.sequence[owner],
        episode=episodes.episode[at],
        step=step,
        start=start,
        count=np.full(len(owner), window, np.int64),
        after=np.ones(len(owner), np.int64),
    )
