"""Where stored rows come from: the shards on disk, or memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.datasets._buffers import BufferPool
from navrep_data.datasets._index import Ints, SequenceTable, WindowTable
from navrep_data.errors import ConfigError
from navrep_data.schema import COLUMNS
from navrep_data.shards import DatasetFolder, Episodes

Array = npt.NDArray[Any]
# Decoded at a time while filling memory: a few chunks, which malloc and the cache keep at hand.
PIECE_BYTES = 256 << 10


def select_episodes(folder: DatasetFolder, split: str | None) -> Episodes:
    """Return the episodes of `split` (all for None) in their order.

    Raises
    ------
    ConfigError
        If there is no such split, or nothing in it.
    """
    episodes = folder.episodes
    inside = episodes.in_split(split)
    if len(inside) == 0:
        what = "no rows" if split is None else f"nothing in split {split!r}"
        raise ConfigError(f"{folder.root} has {what}. Generate more sequences, or choose another split.")
    return Episodes(*(getattr(episodes, field.name)[inside] for field in dataclasses.fields(episodes)))


def ranges(first: Ints, size: Ints) -> Ints:
    """Return ``first[i], ..., first[i] + size[i] - 1`` for all i, one after the other."""
    end = np.cumsum(size)
    return np.arange(end[-1] if len(end) else 0) + np.repeat(first - end + size, size)


class DiskRows:
    """Reads the rows of a few windows from the shards.

    Parameters
    ----------
    folder : DatasetFolder
        Open dataset.
    columns : sequence of str
        Columns to read.
    before : int
        Rows before a window that are needed too (where its episode has some).
    targets : bool
        Whether the row after a window is needed too.
    """

    def __init__(self, folder: DatasetFolder, columns: Sequence[str], before: int, targets: bool) -> None:
        self.folder = folder
        self.columns = tuple(columns)
        self.before = before
        self.targets = targets
        self._pool = BufferPool(keep=2 * len(self.columns))

    def fetch(self, table: WindowTable, index: Ints) -> tuple[dict[str, Array], Ints]:
        """Return the rows of the windows `index`, and where each window starts in them."""
        lead = np.minimum(self.before, table.step[index])
        size = lead + table.count[index] + (table.after[index] if self.targets else 0)
        shard, first = table.shard[index], table.start[index] - lead
        # Rows are laid out in the order of the files, so that neighbours find their chunk decoded.
        order = np.lexsort((first, shard))
        shard, first, size = shard[order], first[order], size[order]
        end = np.cumsum(size)
        at = end - size
        rows = {
            name: self._pool.empty((int(end[-1]), *shape), dtype) for name, (dtype, shape) in self._layouts().items()
        }
        for mine in np.split(np.arange(len(order)), np.flatnonzero(np.diff(shard)) + 1):
            source = self.folder.shard(int(shard[mine[0]]))
            numbers = ranges(first[mine], size[mine])
            for column, out in rows.items():
                if COLUMNS[column].wide:
                    for i in mine:
                        out[at[i] : end[i]] = source.read(column, int(first[i]), int(first[i] + size[i]))
                else:
                    out[at[mine[0]] : end[mine[-1]]] = source.read_rows(column, numbers)
        start = np.empty(len(order), np.int64)
        start[order] = at
        return rows, start + lead

    def _layouts(self) -> dict[str, tuple[np.dtype[Any], tuple[int, ...]]]:
        """Return dtype and shape per row of the columns; all shards of a dataset have the same."""
        layouts = self.folder.shard(0).columns
        return {name: (layouts[name].dtype, layouts[name].row_shape) for name in self.columns}


class LoadedRows:
    """Holds whole sequences in memory, as stored.

    Parameters
    ----------
    folder : DatasetFolder
        Open dataset.
    columns : sequence of str
        Columns to hold.
    sequences : SequenceTable
        Which sequences.
    pool : BufferPool, optional
        Where to take the memory from, for rows that are dropped again soon.
    """

    def __init__(
        self,
        folder: DatasetFolder,
        columns: Sequence[str],
        sequences: SequenceTable,
        pool: BufferPool | None = None,
    ) -> None:
        ends = np.cumsum(sequences.rows)
        self._ids = sequences.sequence
        self._shift = ends - sequences.rows - sequences.start
        self.rows: dict[str, Array] = {}
        layouts = folder.shard(int(sequences.shard[0])).columns
        for column in columns:
            layout = layouts[column]
            out = (pool.empty if pool else np.empty)((int(ends[-1]), *layout.row_shape), layout.dtype)
            step = max(1, PIECE_BYTES // layout.row_bytes)
            for s in range(len(sequences)):
                at, stop = int(ends[s] - sequences.rows[s]), int(ends[s])
                shard, offset = folder.shard(int(sequences.shard[s])), int(sequences.start[s]) - at
                for first in range(at, stop, step):
                    last = min(first + step, stop)
                    out[first:last] = shard.read(column, first + offset, last + offset)
            self.rows[column] = out

    def locate(self, table: WindowTable) -> Ints:
        """Return the first row, in memory, of every window of `table`."""
        return np.asarray(table.start + self._shift[np.searchsorted(self._ids, table.sequence)])
