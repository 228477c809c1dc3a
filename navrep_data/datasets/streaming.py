"""Windows in a shuffled stream that reads each shard in pieces, for datasets that do not fit into memory."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal, Self

import numpy as np
import torch
import torch.distributed
from torch.utils.data import IterableDataset, get_worker_info

from navrep_data.datasets._batch import STEP_FIELDS, Assembler
from navrep_data.datasets._buffers import BufferPool
from navrep_data.datasets._index import Ints, SequenceTable, WindowTable, sequences_of
from navrep_data.datasets._rows import LoadedRows, select_episodes
from navrep_data.datasets._windows import (
    Batch,
    DatasetFolder,
    Invalid,
    Lidar,
    ScanUnit,
    Split,
    check_rows,
    cut,
    make_spec,
    open_folder,
)
from navrep_data.errors import ConfigError, check_whole

# Windows converted at a time when handing out single ones.
_CONVERT = 32


def _rank_and_world(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """Return rank and number of ranks: given, or of torch.distributed, or of the environment, or (0, 1)."""
    if (rank is None) != (world_size is None):
        raise ConfigError(f"rank is {rank} and world_size is {world_size}, expected both or neither.")
    if rank is None or world_size is None:
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            rank, world_size = torch.distributed.get_rank(), torch.distributed.get_world_size()
        else:
            given = os.environ.get("RANK", "0"), os.environ.get("WORLD_SIZE", "1")
            if not all(text.isdecimal() for text in given):
                raise ConfigError(
                    f"RANK is {given[0]!r} and WORLD_SIZE {given[1]!r} in the environment, expected numbers."
                )
            rank, world_size = int(given[0]), int(given[1])
    world_size = check_whole("world_size", world_size, 1)
    return check_whole("rank", rank, 0, world_size - 1), world_size


def _share(first: int, stop: int, part: int, parts: int) -> tuple[int, int]:
    """Return part `part` of `parts` of the range; sizes differ by at most one."""
    size = stop - first
    return first + size * part // parts, first + size * (part + 1) // parts


class StreamingSequenceDataset(IterableDataset[Batch]):
    """The windows of :class:`SequenceDataset` in a shuffled order that reads the disk in sequence.

    Parameters
    ----------
    root, lidar, window, stride, split, fields, action, targets, across_episodes, scan_unit, invalid
        As in :class:`SequenceDataset`.
    batch_size : int, optional
        Hand out batches of this many windows (the last one of an epoch may be smaller) instead of single
        windows; use ``DataLoader(dataset, batch_size=None)`` then. Faster, as nothing is stacked twice.
    shuffle : bool
        Shuffle shards, the sequences in them, and windows within the buffer; else stored order.
    buffer_sequences : int
        Sequences decoded and shuffled together: the memory bound, about 2.2 MB (scans) or 4.2 MB (rings) each
        for sequences of 1000 rows.
    seed : int
        Order = f(seed, epoch, world_size, rank, worker).
    rank, world_size : int, optional
        This process among those that share an epoch; by default from ``torch.distributed`` if initialised,
        else from the environment (``RANK``, ``WORLD_SIZE``), else alone. Read once, here.

    Raises
    ------
    DatasetNotFoundError
        If there is no dataset in `root`.
    ConfigError, UnknownNameError
        If an argument cannot be used.

    Notes
    -----
    One epoch: the shards are put in random order, the sequences within each too; that list of windows is cut
    into equal parts, one per rank, and again one per DataLoader worker; each consumer walks through its part,
    `buffer_sequences` at a time, windows shuffled within. So every window comes exactly once per epoch over
    all ranks and workers, parts differ by at most one window, and each sequence is decoded once, or twice
    where a cut falls into it.

    Call :meth:`set_epoch` before every epoch, or all epochs have the same order. It reaches persistent
    workers too.

    Resume: :meth:`state_dict` and :meth:`load_state_dict`, exact to the window; see there for how with
    workers.
    """

    def __init__(
        self,
        root: str | os.PathLike[str] | DatasetFolder,
        lidar: Lidar | None = "rings",
        *,
        window: int = 32,
        stride: int | None = None,
        split: Split | None = None,
        fields: Iterable[str] | None = None,
        action: Literal["taken", "leading"] = "taken",
        targets: bool = False,
        across_episodes: bool = False,
        scan_unit: ScanUnit = "metres",
        invalid: Invalid = "zero",
        batch_size: int | None = None,
        shuffle: bool = True,
        buffer_sequences: int = 16,
        seed: int = 0,
        rank: int | None = None,
        world_size: int | None = None,
    ) -> None:
        window = check_rows("window", window)
        stride = window if stride is None else check_rows("stride", stride)
        self.batch_size = None if batch_size is None else check_rows("batch_size", batch_size)
        self.buffer_sequences = check_rows("buffer_sequences", buffer_sequences)
        self.shuffle = bool(shuffle)
        self.seed = check_whole("seed", seed, 0)
        self.rank, self.world_size = _rank_and_world(rank, world_size)
        self._folder = open_folder(root)
        self.spec = make_spec(
            self._folder,
            window=window,
            lidar=lidar,
            fields=fields,
            default=STEP_FIELDS,
            action=action,
            targets=targets,
            blank=across_episodes,
            scan_unit=scan_unit,
            invalid=invalid,
        )
        episodes = select_episodes(self._folder, split)
        self.table = cut(episodes, window, stride, across_episodes)
        self._sequences = sequences_of(episodes)
        self._assemble = Assembler(self.spec)
        self._pool = BufferPool(keep=2 * len(self.spec.needed()))
        # In shared memory, so that set_epoch in the main process reaches workers that live for several
        # epochs.
        self._epoch = torch.zeros(1, dtype=torch.int64)
        self._epoch.share_memory_()  # type: ignore[no-untyped-call]
        self._resume: dict[str, Any] | None = None
        self._position = 0
        self._worker = (0, 1)

    @classmethod
    def from_hub(
        cls,
        repo: str,
        lidar: Lidar | None = "rings",
        *,
        revision: str | None = None,
        token: str | bool | None = None,
        cache_bytes: int = 8 << 30,
        prefetch: int = 2,
        **options: Any,
    ) -> Self:
        """Stream a dataset straight from the Hugging Face Hub: only the shards that are read come, each checked.

        Parameters
        ----------
        repo : str
            ``user/name``.
        lidar : {"rings", "1d"} or None
            As for the class.
        revision : str, optional
            Branch, tag or commit; ``main`` by default.
        token : str or bool, optional
            As huggingface_hub takes it; by default the one that is logged in.
        cache_bytes : int
            Bound on the disk space of the shards kept (in ``NAVREP_DATA_HOME`` or the user's cache folder), shared by
            all processes; those used longest ago go first.
        prefetch : int
            Shards fetched ahead of the one that is read, per process, as the cache allows.
        **options
            As for the class.

        Raises
        ------
        ConfigError
            If the cache cannot hold the shards of ``buffer_sequences`` sequences.
        DatasetNotFoundError, CorruptDataError, HubError, OfflineError
            If there is no such dataset, a file does not have its SHA-256, or it cannot be had.

        Notes
        -----
        Opening reads the manifest and the index of episodes that ``navrep-data push`` adds, no shard. A dataset that
        came to the Hub in another way has no index: then every shard comes once before the first window.
        """
        from navrep_data.datasets._hub_open import check_room, open_stream

        folder = open_stream(repo, revision=revision, token=token, cache_bytes=cache_bytes, ahead=prefetch)
        dataset = cls(folder, lidar, **options)
        check_room(folder, dataset.buffer_sequences, folder.manifest.shards)
        return dataset

    @property
    def epoch(self) -> int:
        """The epoch whose order is used."""
        return int(self._epoch[0])

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the next epoch; forget a position to resume from if it is in another one."""
        epoch = check_whole("epoch", epoch, 0)
        self._epoch[0] = epoch
        if self._resume is not None and self._resume["epoch"] != epoch:
            self._resume = None
        self._position = 0

    @property
    def windows_per_epoch(self) -> int:
        """Number of windows that this rank gets per epoch."""
        first, stop = _share(0, len(self.table), self.rank, self.world_size)
        return stop - first

    @property
    def provenance(self) -> dict[str, Any]:
        """What a checkpoint records of the dataset it was trained on, see :func:`navrep_data.shards.dataset_record`."""
        return self._folder.provenance

    def close(self) -> None:
        """Close the open files; the next access opens them again."""
        self._folder.close()

    # ---- order ----

    def _sequence_order(self, epoch: int) -> Ints:
        """Return the positions in the sequence table in this epoch's order, the same for all consumers."""
        shard = self._sequences.shard
        if not self.shuffle:
            return np.arange(len(shard))
        draw = np.random.default_rng([self.seed, epoch])
        names, owner = np.unique(shard, return_inverse=True)
        place = draw.permutation(len(names))[owner]
        return np.lexsort((draw.random(len(shard)), place))

    def _blocks(self, epoch: int, worker: int, workers: int) -> Iterator[tuple[Ints, Ints]]:
        """Yield, for one consumer, (positions of sequences to decode, windows in the order to hand out)."""
        order = self._sequence_order(epoch)
        at = np.searchsorted(self._sequences.sequence, self.table.sequence)
        # The table is ordered by sequence: windows of sequence s are first_window[s] : first_window[s + 1].
        first_window = np.searchsorted(at, np.arange(len(self._sequences) + 1))
        sizes = np.diff(first_window)[order]
        ends = np.cumsum(sizes)
        first, stop = _share(0, len(self.table), self.rank, self.world_size)
        first, stop = _share(first, stop, worker, workers)
        if first == stop:
            return
        mine = np.arange(np.searchsorted(ends, first, side="right"), np.searchsorted(ends, stop, side="left") + 1)
        mine = mine[sizes[mine] > 0]
        self._folder.expect(self._sequences.shard[order[mine]])
        for number, k in enumerate(range(0, len(mine), self.buffer_sequences)):
            block = mine[k : k + self.buffer_sequences]
            windows = []
            for s in block:
                begin = ends[s] - sizes[s]
                low, high = max(first - begin, 0), min(stop - begin, sizes[s])
                windows.append(first_window[order[s]] + np.arange(low, high))
            chosen = np.concatenate(windows)
            if self.shuffle:
                consumer = [self.seed, epoch, self.world_size, self.rank, workers, worker, number]
                chosen = np.random.default_rng(consumer).permutation(chosen)
            yield order[block], chosen

    # ---- iteration ----

    def __iter__(self) -> Iterator[Batch]:
        """Iterate over this consumer's share of the epoch, from the resumed position if there is one."""
        info = get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        epoch, skip = self.epoch, 0
        resume = self._resume
        if resume is not None and resume["epoch"] == epoch:
            if resume["workers"] != workers:
                raise ConfigError(
                    f"The state to resume from is of {resume['workers']} consumers (DataLoader workers, "
                    f"1 without), this loader has {workers}. Use the same num_workers until the epoch ends."
                )
            # The new loader asks its worker 0 first; the old one would have asked another one next.
            worker = (worker + resume["next_worker"]) % workers
            skip = resume["positions"][worker]
        self._worker = (worker, workers)
        self._position = skip
        try:
            yield from self._hand_out(self._batches(epoch, worker, workers, skip))
        finally:
            self._folder.expect(())
        self._resume = None
        self._position = 0

    def _batches(self, epoch: int, worker: int, workers: int, skip: int) -> Iterator[Batch]:
        """Yield this consumer's windows after the first `skip`, in batches of up to ``batch_size``."""
        size = self.batch_size or _CONVERT
        for sequences, windows in self._blocks(epoch, worker, workers):
            if skip >= len(windows):
                skip -= len(windows)
                continue
            windows, skip = windows[skip:], 0
            loaded = self._take(sequences)
            for k in range(0, len(windows), size):
                index = windows[k : k + size]
                table = WindowTable(
                    *(getattr(self.table, field.name)[index] for field in dataclasses.fields(self.table))
                )
                yield self._assemble(loaded.rows, loaded.locate(table), table.count, table.after)
            del loaded  # before the next block is decoded, so that it can have the memory

    def _take(self, positions: Ints) -> LoadedRows:
        positions = np.sort(positions)
        s = self._sequences
        part = SequenceTable(s.sequence[positions], s.shard[positions], s.start[positions], s.rows[positions])
        return LoadedRows(self._folder, self.spec.needed(), part, self._pool)

    def _hand_out(self, pieces: Iterator[Batch]) -> Iterator[Batch]:
        """Yield single windows, or batches of ``batch_size`` (the last may be smaller), counting them."""
        pending: Batch | None = None
        for piece in pieces:
            if self.batch_size is None:
                for i in range(_length(piece)):
                    self._position += 1
                    yield {name: value[i] for name, value in piece.items()}
                continue
            pending = piece if pending is None else {name: torch.cat([pending[name], piece[name]]) for name in piece}
            # Both parts are at most batch_size long, so at most one batch is complete.
            if _length(pending) >= self.batch_size:
                full = {name: value[: self.batch_size] for name, value in pending.items()}
                rest = {name: value[self.batch_size :] for name, value in pending.items()}
                pending = rest if _length(rest) else None
                self._position += self.batch_size
                yield full
        if pending is not None:
            self._position += _length(pending)
            yield pending

    # ---- resume ----

    def _identity(self) -> dict[str, Any]:
        """Return what the order depends on besides the epoch and the workers."""
        return {
            "windows": len(self.table),
            "window": self.spec.window,
            "seed": self.seed,
            "shuffle": self.shuffle,
            "buffer_sequences": self.buffer_sequences,
            "rank": self.rank,
            "world_size": self.world_size,
        }

    def state_dict(
        self, batches: int | None = None, *, num_workers: int = 0, batch_size: int | None = None
    ) -> dict[str, Any]:
        """Return where in the epoch this rank is, as plain JSON values.

        Parameters
        ----------
        batches : int, optional
            Batches received from the DataLoader since this epoch started (or was resumed). Needed with
            ``num_workers > 0``, where only the workers' copies of this object move. None: ask this object,
            which is right when it is iterated in this very process (``num_workers=0``), and inside a worker
            (torchdata's StatefulDataLoader calls it there).
        num_workers : int
            Of the DataLoader.
        batch_size : int, optional
            Of the DataLoader, with ``drop_last=False`` and ``in_order=True``; by default this object's own
            ``batch_size``.

        Raises
        ------
        ConfigError
            If a number is no whole one or out of range, or `batches` is given without any batch size.
        """
        if batches is None:
            worker, workers = self._worker
            positions, next_worker = [0] * workers, 0
            positions[worker] = self._position
            if self._position == 0 and self._resume is not None:
                positions, next_worker = list(self._resume["positions"]), self._resume["next_worker"]
        else:
            size = self.batch_size if batch_size is None else check_rows("batch_size", batch_size)
            if size is None:
                raise ConfigError("batches is given without batch_size, expected both: give the DataLoader's.")
            workers = max(check_whole("num_workers", num_workers, 0), 1)
            positions, next_worker = self._count(check_whole("batches", batches, 0), workers, size)
        state = {"positions": positions, "workers": len(positions), "next_worker": next_worker}
        return {"version": 1, "epoch": self.epoch, **self._identity(), **state}

    def _count(self, batches: int, workers: int, batch_size: int) -> tuple[list[int], int]:
        """Return the positions of all workers after `batches` batches, and which one comes next."""
        positions, worker = [0] * workers, 0
        if self._resume is not None and self._resume["workers"] == workers:
            positions, worker = list(self._resume["positions"]), self._resume["next_worker"]
        first, stop = _share(0, len(self.table), self.rank, self.world_size)
        sizes = [b - a for a, b in (_share(first, stop, w, workers) for w in range(workers))]
        while batches and positions != sizes:
            # The DataLoader asks its workers in turn and passes over those that have nothing left.
            if positions[worker] < sizes[worker]:
                positions[worker] = min(positions[worker] + batch_size, sizes[worker])
                batches -= 1
            worker = (worker + 1) % workers
        return positions, worker

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken, at the next iteration; call it before the DataLoader is iterated.

        Parameters
        ----------
        state : mapping
            From :meth:`state_dict`. The rest of the epoch then has exactly the windows that had not been
            handed out, in the order in which they would have come, given the same number of workers.

        Raises
        ------
        ConfigError
            If the state belongs to another dataset, seed, rank or other settings.
        """
        mine = {"version": 1, **self._identity()}
        for name, value in mine.items():
            if state.get(name) != value:
                raise ConfigError(
                    f"The state to resume from has {name} {state.get(name)!r}, this dataset has {value!r}. "
                    "Use the same dataset and arguments, or start a new epoch."
                )
        positions, workers = state.get("positions"), state.get("workers")
        if not isinstance(positions, list) or len(positions) != workers:
            raise ConfigError(
                f"The state to resume from has positions {positions!r}, expected one per worker ({workers})."
            )
        self._epoch[0] = int(state["epoch"])
        self._resume = {name: state[name] for name in ("epoch", "positions", "workers", "next_worker")}
        self._worker, self._position = (0, 1), 0


def _length(batch: Batch) -> int:
    """Return the number of windows of a batch."""
    return len(batch["mask"])
