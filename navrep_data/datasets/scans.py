"""Single frames, for training V."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from navrep_data.datasets._windows import (
    Batch,
    DatasetFolder,
    Invalid,
    Lidar,
    ScanUnit,
    Split,
    WindowDataset,
    cut,
    make_spec,
    select_episodes,
)


class ScanDataset(WindowDataset):
    """Every stored frame by itself, in stored order.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    lidar : {"rings", "1d"}
        ``rings``: field `rings`, (64, 64) float32, 0 free, 0.5 unknown, 1 occupied. ``1d``: field `scan`,
        (n_rays,) float32.
    split : {"train", "val", "test"} or None
        Part of the dataset, None for all.
    fields : iterable of str
        More fields; see :class:`SequenceDataset` for their names.
    scan_unit, invalid, preload
        As in :class:`SequenceDataset`.

    Raises
    ------
    DatasetNotFoundError
        If there is no dataset in `root`.
    ConfigError, UnknownNameError
        If an argument cannot be used.

    Notes
    -----
    Random frames from disk decode a whole chunk of rows for each; for many epochs use ``preload=True``, or
    :class:`StreamingSequenceDataset` with ``window=1``. The original zeroes range bin 0 of rings before V;
    models do that.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        lidar: Lidar = "rings",
        *,
        split: Split | None = None,
        fields: Iterable[str] = (),
        scan_unit: ScanUnit = "metres",
        invalid: Invalid = "zero",
        preload: bool = False,
    ) -> None:
        folder = DatasetFolder(Path(root))
        spec = make_spec(
            folder,
            window=1,
            lidar=lidar,
            fields=fields,
            default=(),
            action="taken",
            targets=False,
            blank=False,
            scan_unit=scan_unit,
            invalid=invalid,
        )
        episodes = select_episodes(folder, split)
        super().__init__(root, folder, episodes, cut(episodes, 1, 1, across=False), spec, preload)

    def _finish(self, batch: Batch) -> Batch:
        return {name: value[:, 0] for name, value in batch.items() if name != "mask"}
