"""Export to other formats: the original software's npz files, and Minari."""

from __future__ import annotations

import importlib.util
import io
import os
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.datasets.npz import FILE_SUFFIX, unplayed_frames
from navrep_data.datasets.tools._pieces import Given, Progress
from navrep_data.datasets.tools.minari_process import write_apart
from navrep_data.errors import ConfigError, MissingExtraError, did_you_mean
from navrep_data.io import atomic_write_bytes, new_folder
from navrep_data.observations import metres_from_millimetres
from navrep_data.schema import ACTION_SIZE, N_RAYS, Event

Arrays = dict[str, npt.NDArray[Any]]
FORMATS = ("npz", "minari")
MIN_DIGITS = 3
"""Digits of the number in the name of an npz file; more where there are more sequences."""
# What Minari calls a dataset: (namespace/)name-vN; also a relative path, so nothing that could lead elsewhere.
_MINARI_ID = re.compile(r"([A-Za-z0-9][\w-]*/)*[A-Za-z0-9][\w-]*-v\d{1,6}")


@dataclass(frozen=True)
class ExportResult:
    """What :func:`export` wrote.

    Attributes
    ----------
    root : str
        The new folder.
    format : str
        ``"npz"`` or ``"minari"``.
    files, bytes : int
        In it.
    episodes, rows : int
        Exported.
    skipped : int
        Episodes left out: Minari has no place for those without an action.
    dataset_id : str
        Name for ``minari.load_dataset``, empty for npz.
    """

    root: str
    format: str
    files: int
    bytes: int
    episodes: int
    rows: int
    skipped: int = 0
    dataset_id: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)


def export(
    root: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    format: str,
    dataset_id: str | None = None,
    progress: Progress | None = None,
) -> ExportResult:
    """Write a dataset in another format.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    out : path-like
        New folder.
    format : {"npz", "minari"}
        ``"npz"``: a file per sequence, as the original software writes them. ``"minari"``: a folder to give to Minari
        as MINARI_DATASETS_PATH (needs ``pip install 'navrep-data[minari]'``).
    dataset_id : str, optional
        Minari's name, ``navrep-data/<env>-v0`` by default.
    progress : callable, optional
        Called with (sequences done, sequences in all).

    Returns
    -------
    ExportResult
        What was written.

    Raises
    ------
    ConfigError
        If the format or name is unknown, or the format cannot hold these scans.
    MissingExtraError
        If Minari is not installed.
    FolderInUseError
        If `out` holds something.
    DiskSpaceError, FolderNotWritableError
        If it cannot be written.
    DatasetNotFoundError, DatasetError, CorruptDataError
        If the dataset cannot be read.

    Notes
    -----
    npz: rows stay rows, each with the action and reward that *led to* it. What came in by ``import_npz`` goes out as it
    was, array for array (robot states and actions that were float32 as float64; ranges that were NaN, negative or
    infinite as the import cleaned them). Generated rows have zeros on each episode's first row, which the original does
    not keep; importing the files again gives the same observations, actions, rewards and episodes.

    Minari: an episode of T actions has T + 1 observations (`scan` in metres, `robot_state`); columns that are not
    observed are infos. Episodes are of their split: ``metadata["split"]`` of each.
    """
    if format not in FORMATS:
        raise ConfigError(f"Unknown format {format!r}; expected {' or '.join(FORMATS)}.{did_you_mean(format, FORMATS)}")
    if dataset_id is not None and format != "minari":
        raise ConfigError(f"The name {dataset_id!r} is for Minari; leave it out with format {format}.")
    given = Given(root)
    write = _npz_files if format == "npz" else _minari_files(given, dataset_id)
    with new_folder(out, what="export", apart_from=[given.root]) as part:
        counts = write(part, given, progress)
        files = [path for path in part.rglob("*") if path.is_file()]
        size = sum(path.stat().st_size for path in files)
    given.folder.close()
    return ExportResult(str(out), format, len(files), size, **counts)


# -- the original's npz


def original_arrays(columns: Arrays) -> Arrays:
    """Return one sequence as the original software would store it.

    Parameters
    ----------
    columns : dict of str to ndarray
        All columns of a sequence of N rows.

    Returns
    -------
    dict of str to ndarray
        ``scans`` (N, 1080) float32 [m], ``robotstates`` (N, 5), ``actions`` (N, 3), ``rewards`` (N,) float64, ``dones``
        (N,) bool.
    """
    scan, dones = columns["scan"], columns["is_last"].copy()
    if "leading_action" in columns:
        actions, rewards = columns["leading_action"], columns["leading_reward"]
        # The import found such an episode's end by the odd frame that follows it; that frame alone was marked as done.
        odd = unplayed_frames(columns["is_first"] & columns["is_last"], actions, rewards)
        dones[:-1] &= ~((columns["event"][:-1] == Event.STUCK) & odd[1:])
    else:
        actions, rewards = np.zeros((len(dones), ACTION_SIZE)), np.zeros(len(dones))
        led = np.flatnonzero(~columns["is_first"])
        actions[led], rewards[led] = columns["action"][led - 1], columns["reward"][led - 1]
    return {
        "scans": metres_from_millimetres(scan) if scan.dtype == np.uint16 else scan,
        "robotstates": columns.get("source_robot_state", columns["robot_state"]).astype(np.float64),
        "actions": actions,
        "rewards": rewards,
        "dones": dones,
    }


def _npz_files(part: Path, given: Given, progress: Progress | None) -> dict[str, Any]:
    if given.manifest.sensor.n_rays != N_RAYS:
        raise ConfigError(
            f"{given.root} has scans of {given.manifest.sensor.n_rays} rays, the original's files hold {N_RAYS}; "
            "export to minari instead."
        )
    pieces = given.pieces()
    # files are imported in the order of their names
    digits = max(MIN_DIGITS, len(str(max(shard.sequences[-1][1] for shard in given.manifest.shards) - 1)))
    for k, piece in enumerate(pieces):
        columns = piece.columns()
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **original_arrays(columns))  # type: ignore[arg-type]
        atomic_write_bytes(part / f"{int(columns['sequence'][0]):0{digits}}_{FILE_SUFFIX}", buffer.getvalue())
        if progress is not None:
            progress(k + 1, len(pieces))
    return {"episodes": len(given.folder.episodes), "rows": given.manifest.rows}


# -- Minari


def _minari_files(given: Given, dataset_id: str | None) -> Callable[..., dict[str, Any]]:
    """Return what writes a Minari dataset, after checks that need no data."""
    m = given.manifest
    name = dataset_id or f"navrep-data/{re.sub(r'[^A-Za-z0-9_-]', '-', m.env)}-v0"
    if not _MINARI_ID.fullmatch(name):
        raise ConfigError(f"{name!r} is no name for Minari; expected namespace/name-v0 of letters, digits, - and _.")
    if importlib.util.find_spec("minari") is None:
        raise MissingExtraError("Minari is not installed; get it: pip install 'navrep-data[minari]'")

    def write(part: Path, given: Given, progress: Progress | None) -> dict[str, Any]:
        # both absolute: Minari joins what it is given once more, and another process does it
        return write_apart(given.root.resolve(), part.resolve(), name, progress)

    return write
