"""Windows of consecutive frames, for training M, the joint model and the transformer."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, Literal, Self

from navrep_data.datasets._batch import STEP_FIELDS
from navrep_data.datasets._windows import (
    DatasetFolder,
    Invalid,
    Lidar,
    ScanUnit,
    Split,
    WindowDataset,
    check_rows,
    cut,
    make_spec,
    open_folder,
    select_episodes,
)


class SequenceDataset(WindowDataset):
    """Windows of W consecutive rows, as dictionaries of tensors.

    Parameters
    ----------
    root : path-like or DatasetFolder
        Dataset folder, as written by ``navrep-data generate`` or :func:`import_npz`.
    lidar : {"rings", "1d"} or None
        ``rings``: field `rings`, (W, 64, 64) float32, 0 free, 0.5 unknown, 1 occupied, computed from the
        stored scan where the dataset has no rings. ``1d``: field `scan`, (W, n_rays) float32. None: no lidar
        field.
    window : int
        W, rows per window.
    stride : int, optional
        Rows between the starts of two windows; W by default.
    split : {"train", "val", "test"} or None
        Part of the dataset (by sequence), None for all.
    fields : iterable of str, optional
        Fields besides the lidar's and `mask`. Default: ``robot_state`` (W, 5), ``action`` (W, 3),
        ``action_valid`` (W,) bool, ``reward`` (W,), ``is_first``, ``is_last``, ``is_terminal`` (W,) bool, and
        for imports ``goal_valid`` (W,) bool. On request: ``humans`` (W, H, 6) with NaN where there is nobody,
        ``robot_pose`` (W, 3) and ``robot_radius`` (W,) (NaN in imports), ``event``, ``sequence``,
        ``episode``, ``step``, ``rings`` or ``scan`` beside the other lidar.
    action : {"taken", "leading"}
        ``taken``: the action chosen at a row; ``action_valid`` is False on the last row of an episode.
        ``leading``: the action that led to a row, what the original's models are fed; zero and not
        ``action_valid`` at ``is_first``.
    targets : bool
        Add ``next_*``, the row after each row, for the fields that are observed (lidar, ``robot_state``,
        ``goal_valid``, ``humans``, ``robot_pose``), and ``next_mask``; see Notes.
    across_episodes : bool
        Cut windows by the original's rule; see Notes.
    scan_unit : {"metres", "normalized"}
        Scans in metres, or divided by the sensor's range_max without clipping. Metres by default: that is
        what the word scan means everywhere in this package, and the released models differ in what they
        divide by.
    invalid : {"zero", "near", "range_max"}
        What a ray that nobody saw (stored as 0) becomes. Zero by default: it stays recognisable, and so
        ``scan_to_rings(scan)`` equals the stored rings. ``near``: what models that read ranges are shown, in training
        and on a robot (:func:`navrep_data.observations.fill_blind`), since they would take 0 for a wall.
        ``range_max``: free.
    preload : bool
        Decode everything once and hold it in memory as stored (2.2 kB per row for scans, 4.1 kB for rings).
        Forked workers share it; spawned workers load their own.

    Raises
    ------
    DatasetNotFoundError
        If there is no dataset in `root`.
    ConfigError, UnknownNameError
        If an argument cannot be used.
    CorruptDataError
        If a shard is damaged (raised when it is read).

    Notes
    -----
    Default rule: windows start at episode start + k * stride and never reach into another episode. Rows past
    the end of an episode are zero and ``mask`` (W,) bool is False there. ``next_mask`` is False, and
    ``next_*`` zero, on the last row of an episode, which has no successor; so a window that holds only that
    row has no target at all.

    ``across_episodes=True`` is the rule by which the original trains its joint model and transformer
    (navrep/tools/wdataset.py): each sequence is cut at ``1 + k * stride`` into whole windows, whatever
    episodes lie in them, and W + 1 rows are read (what is left at the end of a sequence is dropped; all masks
    are True). Where ``is_last`` holds at row t, the frame of row t and the target frame ``next_*`` of row t
    are zero; states, goals and actions are not. The original feeds its models only ``robot_state[..., :2]``,
    the goal; here the whole state is handed out and the model picks. Three differences: the original cuts
    through all files put end to end; its rows lack the first observation of every episode, ours have it
    (imports of its files lack it too); and where an import's robot was stuck, the last frame before it gave
    up is blanked as well as the odd frame after it (see :func:`import_npz`).

    No field of a default batch holds NaN: an unknown goal (imports) becomes 0 with ``goal_valid`` False.

    Batches are faster than windows: ``DataLoader(dataset, batch_size=64)`` fetches them whole but stacks them
    once more; ``DataLoader(dataset, sampler=BatchSampler(RandomSampler(dataset), 64, False),
    batch_size=None)`` does not.

    Examples
    --------
    >>> from torch.utils.data import DataLoader
    >>> dataset = SequenceDataset("data/soadrl", lidar="rings", window=32, split="train")  # doctest: +SKIP
    >>> for batch in DataLoader(dataset, batch_size=64, shuffle=True):  # doctest: +SKIP
    ...     batch["rings"].shape
    torch.Size([64, 32, 64, 64])
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
        preload: bool = False,
    ) -> None:
        window = check_rows("window", window)
        stride = window if stride is None else check_rows("stride", stride)
        folder = open_folder(root)
        spec = make_spec(
            folder,
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
        episodes = select_episodes(folder, split)
        super().__init__(folder, episodes, cut(episodes, window, stride, across_episodes), spec, preload)

    @classmethod
    def from_hub(
        cls,
        repo: str,
        lidar: Lidar | None = "rings",
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
        lidar : {"rings", "1d"} or None
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
