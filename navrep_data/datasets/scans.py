"""Single frames, for training V."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, Self

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
    open_folder,
    select_episodes,
)


class ScanDataset(WindowDataset):
    """Every stored frame by itself, in stored order.

    Parameters
    ----------
    root : path-like or DatasetFolder
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
        root: str | os.PathLike[str] | DatasetFolder,
        lidar: Lidar = "rings",
        *,
        split: Split | None = None,
        fields: Iterable[str] = (),
        scan_unit: ScanUnit = "metres",
        invalid: Invalid = "zero",
        preload: bool = False,
    ) -> None:
        folder = open_folder(root)
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
        super().__init__(folder, episodes, cut(episodes, 1, 1, across=False), spec, preload)

    @classmethod
    def from_hub(
        cls,
        repo: str,
        lidar: Lidar = "rings",
        *,
        revision: str | None = None,
        token: str | bool | None = None,
        **options: Any,
    ) -> Self:
        """Open a dataset of the Hugging Face Hub, brought into huggingface_hub's cache whole and checked.

        Parameters
        ----------
        repo : str
            ``user/name``.
        lidar : {"rings", "1d"}
            As for the class.
        revision : str, optional
            Branch, tag or commit; ``main`` by default. Give a commit and the data never change.
        token : str or bool, optional
            As huggingface_hub takes it; by default the one that is logged in.
        **options
            As for the class. Only shards that hold something of `split` are brought.

        Raises
        ------
        DatasetNotFoundError, CorruptDataError, HubError, OfflineError
            If there is no such dataset, a file does not have its SHA-256, or it cannot be had. Offline, a dataset that
            is in the cache opens.
        """
        from navrep_data.datasets._hub_open import open_whole

        folder = open_whole(repo, revision=revision, split=options.get("split"), token=token)
        return cls(folder, lidar, **options)

    def _finish(self, batch: Batch) -> Batch:
        return {name: value[:, 0] for name, value in batch.items() if name != "mask"}
