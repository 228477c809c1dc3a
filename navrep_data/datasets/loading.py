"""A DataLoader that asks datasets for whole batches."""

from __future__ import annotations

from typing import Any

import torch
from torch.utils.data import BatchSampler, DataLoader, RandomSampler, SequentialSampler

from navrep_data.datasets._windows import WindowDataset
from navrep_data.errors import check_whole

_MAX_SEED = 2**64 - 1  # of torch's generators


def make_loader(
    dataset: WindowDataset,
    batch_size: int,
    *,
    shuffle: bool = True,
    seed: int = 0,
    drop_last: bool = False,
    num_workers: int = 0,
    **options: Any,
) -> DataLoader[Any]:
    """Return a DataLoader that reads each batch in one go.

    Parameters
    ----------
    dataset : ScanDataset or SequenceDataset
        What to read.
    batch_size : int
        Windows (or frames) per batch.
    shuffle : bool
        Whether the order is random, a new one each epoch.
    seed : int
        Start of that randomness, from 0 to 2^64 - 1.
    drop_last : bool
        Whether to leave out a smaller last batch.
    num_workers : int
        Worker processes.
    **options
        Passed on to :class:`torch.utils.data.DataLoader` (``pin_memory``, ``persistent_workers``, ...).

    Returns
    -------
    torch.utils.data.DataLoader
        Yields dictionaries of tensors, as ``DataLoader(dataset, batch_size=...)`` does; it spares stacking every
        window once more, which makes preloaded data two to three times faster.

    Raises
    ------
    ConfigError
        If `batch_size`, `seed` or `num_workers` is no whole number, or out of range.
    """
    size, workers = check_whole("batch_size", batch_size, 1), check_whole("num_workers", num_workers, 0)
    seed = check_whole("seed", seed, 0, _MAX_SEED)
    generator = torch.Generator(device="cpu").manual_seed(seed)
    order: Any = RandomSampler(dataset, generator=generator) if shuffle else SequentialSampler(dataset)
    batches = BatchSampler(order, size, drop_last)
    # which workers are seeded from; by default it draws from the global one
    options.setdefault("generator", torch.Generator(device="cpu").manual_seed(seed))
    return DataLoader(dataset, batch_size=None, sampler=batches, num_workers=workers, **options)
