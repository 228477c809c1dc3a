"""Sequences recorded by the original software, turned into a dataset."""

from __future__ import annotations

import math
import os
import platform
import shlex
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data._version import __version__
from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetError,
    DatasetNotFoundError,
)
from navrep_data.io import new_folder, raise_refusal, sha256_file
from navrep_data.io.npz import PLAIN_METHODS
from navrep_data.observations import scan_to_rings
from navrep_data.observations.blind import declaration, runs_of
from navrep_data.schema import (
    ACTION_SIZE,
    COLUMNS,
    DT,
    N_RAYS,
    RANGE_MAX,
    ROBOT_STATE_SIZE,
    SIMULATED_COLUMNS,
    Event,
    SensorContract,
)
from navrep_data.shards import DatasetWriter, Manifest, split_of

Arrays = dict[str, npt.NDArray[Any]]

FILE_SUFFIX = "scans_robotstates_actions_rewards_dones.npz"
# 100 times the original's sequences; its scans take 432 MB in memory.
MAX_ROWS = 100_000
MAX_FILE_BYTES = 1 << 30
"""Largest file that is opened: :data:`MAX_ROWS` rows as float64 take half of it."""
# Headers of the five arrays have 128 bytes each.
MAX_HEADER = 4096
MAX_SEQUENCES_PER_SHARD = 100
# Shards are made in memory; float32 scans and rings take about 3.5 kB per row.
MAX_ROWS_PER_SHARD = 100_000
GOAL_REWARD = 100.0
COLLISION_REWARD = -25.0
# The original's clock passes 35 s on the 176th step (accumulated 0.2 s in floating point).
TIMEOUT_ROWS = 176

Dtypes = frozenset[np.dtype[Any]]
_FLOATS: Dtypes = frozenset({np.dtype("f4"), np.dtype("f8")})
# The original's simulators write bool; its tool for bags (navrep/tools/data_extraction.py) whole numbers, and float64
# scans.
_FLAGS: Dtypes = frozenset(map(np.dtype, ("?", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")))
_EXPECTED: dict[str, tuple[tuple[int, ...], Dtypes]] = {
    "scans": ((N_RAYS,), _FLOATS),
    "robotstates": ((ROBOT_STATE_SIZE,), _FLOATS),
    "actions": ((ACTION_SIZE,), _FLOATS),
    "rewards": ((), _FLOATS),
    "dones": ((), _FLAGS),
}
_COLUMNS = tuple(name for name in COLUMNS if name not in SIMULATED_COLUMNS)


def _array(archive: zipfile.ZipFile, name: str, path: Path, read: bool) -> tuple[int, npt.NDArray[Any] | None]:
    """Return the number of rows of one array, and its content if `read`; nothing is ever unpickled."""
    shape, dtypes = _EXPECTED[name]
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        has = ", ".join(archive.namelist()[:8])
        raise CorruptDataError(
            f"{path} has no array {name!r} (it has: {has}); expected {', '.join(_EXPECTED)}."
        ) from None
    if info.compress_type not in PLAIN_METHODS:
        raise CorruptDataError(f"{path}: array {name!r} is packed by method {info.compress_type}, expected deflate.")
    with archive.open(info) as handle:
        version = np.lib.format.read_magic(handle)
        if version != (1, 0):
            raise CorruptDataError(f"{path}: array {name!r} has npy version {version}, expected (1, 0).")
        seen, fortran, dtype = np.lib.format.read_array_header_1_0(handle, max_header_size=MAX_HEADER)
        if dtype.hasobject:
            raise CorruptDataError(
                f"{path}: array {name!r} holds pickled objects, which are never loaded; expected numbers."
            )
        if len(seen) != 1 + len(shape) or seen[1:] != shape or dtype not in dtypes or fortran:
            wanted = "bool or 0 and 1 as integers" if name == "dones" else " or ".join(sorted(str(d) for d in dtypes))
            raise CorruptDataError(f"{path}: array {name!r} is {dtype} {seen}, expected {wanted} {('rows', *shape)}.")
        if not 1 <= seen[0] <= MAX_ROWS:
            raise DatasetError(f"{path}: array {name!r} has {seen[0]:,} rows, expected 1 to {MAX_ROWS:,} per file.")
        size = math.prod(seen) * dtype.itemsize
        if not 0 < info.file_size - size <= MAX_HEADER:
            raise CorruptDataError(
                f"{path}: array {name!r} has {info.file_size:,} bytes, expected {size:,} and a header."
            )
        if not read:
            return seen[0], None
        data = handle.read(size)
        if len(data) != size:
            raise CorruptDataError(
                f"{path}: array {name!r} ends after {len(data):,} of {size:,} bytes. Write or copy the file again."
            )
        handle.read(1)  # reaching the end makes zipfile check the CRC
        return seen[0], np.frombuffer(data, dtype).reshape(seen)


def _load(path: Path, read: bool = True) -> tuple[int, Arrays]:
    """Return the number of rows of one file, and its arrays if `read`."""
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise DatasetError(f"{path} has {size:,} bytes, expected at most {MAX_FILE_BYTES:,} per file.")
    try:
        with zipfile.ZipFile(path) as archive:
            found = {name: _array(archive, name, path, read) for name in _EXPECTED}
    except DatasetError:
        raise
    except Exception as error:  # damaged archives raise a dozen kinds, struct.error and zlib.error among them
        raise_refusal(error, path)
        raise CorruptDataError(
            f"{path} cannot be read as npz ({error}). Expected a file of the original software: "
            "is it written or copied completely?"
        ) from error
    rows = {count for count, _ in found.values()}
    if len(rows) != 1:
        counts = ", ".join(f"{name} {count}" for name, (count, _) in found.items())
        raise CorruptDataError(f"{path}: arrays differ in length ({counts}), expected the same number of rows in all.")
    return rows.pop(), {name: array for name, (_, array) in found.items() if array is not None}


def _find(source: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Return the files to import, in order."""
    items = [Path(source)] if isinstance(source, str | os.PathLike) else [Path(item) for item in source]
    found = [sorted(path.glob(f"*{FILE_SUFFIX}")) if path.is_dir() else [path] for path in items]
    files = [path for paths in found for path in paths]
    missing = [path for path in files if not path.is_file()]
    if missing or not all(found) or not files:
        empty = next((path for path, paths in zip(items, found, strict=True) if not paths), source)
        seen = f"There is no file {missing[0]}" if missing else f"There is nothing to import in {empty}"
        raise DatasetNotFoundError(f"{seen}; expected files named NNN_{FILE_SUFFIX}, or a folder of them.")
    return files


def _clean_scans(scans: npt.NDArray[Any], range_max: float, path: Path) -> npt.NDArray[np.float32]:
    """Return ranges in [0, range_max] [m] with 0 where nobody saw anything (NaN, negative)."""
    with np.errstate(over="ignore"):  # farther than any float32: as inf, nothing was hit
        scans = scans.astype(np.float32, copy=False)
    scans = np.where(np.isposinf(scans), np.float32(range_max), scans)
    scans = np.where(np.isnan(scans) | (scans < 0), np.float32(0.0), scans)
    if scans.max() > np.float32(range_max):
        raise ConfigError(
            f"{path} holds ranges up to {scans.max():.2f} m, expected at most {range_max:g} m. "
            "Pass the sensor's range_max (--range-max)."
        )
    return scans


def unplayed_frames(dones: npt.NDArray[Any], actions: npt.NDArray[Any], rewards: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return which rows are frames of episodes that were never played: done, with zero action and reward.

    Parameters
    ----------
    dones, actions, rewards : ndarray of shape (N,), (N, 3), (N,)
        As the original stores them.
    """
    unplayed: npt.NDArray[np.bool_] = dones & (actions == 0).all(1) & (rewards == 0)
    return unplayed


def align(arrays: Arrays, sequence: int, timeout_rows: int | None = TIMEOUT_ROWS) -> Arrays:
    """Turn rows of the original into rows of this package, without scans and rings.

    Parameters
    ----------
    arrays : dict
        ``robotstates`` (N, 5), ``actions`` (N, 3), ``rewards`` (N,), ``dones`` (N,) as the original stores
        them.
    sequence : int
        Index of the sequence in the dataset.
    timeout_rows : int, optional
        Rows after which an episode has run out of time; None where there is no such limit.

    Returns
    -------
    dict
        All columns of a shard but scan, rings and humans, N rows.

    Notes
    -----
    Rows stay in place; only actions and rewards move. See :func:`import_npz` for the rules.
    """
    actions, rewards, dones = arrays["actions"], arrays["rewards"], arrays["dones"]
    n = len(dones)
    # A frame of an episode that was never played stands where the robot was stuck; the row before it is the
    # real end.
    unplayed = unplayed_frames(dones, actions, rewards)
    ended = dones.copy()
    ended[-1] = True
    given_up = np.zeros(n, bool)
    given_up[:-1] = unplayed[1:] & ~ended[:-1]
    is_last = ended | given_up
    is_first = np.concatenate([[True], is_last[:-1]])
    episode = np.cumsum(is_first) - 1
    step = np.arange(n) - np.flatnonzero(is_first)[episode]

    event = np.zeros(n, np.uint8)
    event[is_last] = Event.CUT
    if timeout_rows is not None:
        event[dones & (step + 1 == timeout_rows)] = Event.TIMEOUT
    event[dones & (rewards == GOAL_REWARD)] = Event.GOAL
    event[dones & (rewards == COLLISION_REWARD)] = Event.COLLISION_OBSTACLE
    event[given_up] = Event.STUCK

    action, reward = np.zeros((n, ACTION_SIZE), np.float32), np.zeros(n, np.float32)
    goes_on = np.flatnonzero(~is_last)
    action[goes_on], reward[goes_on] = actions[goes_on + 1], rewards[goes_on + 1]
    columns = {
        "robot_state": arrays["robotstates"],
        "action": action,
        "reward": reward,
        "is_first": is_first,
        "is_last": is_last,
        "is_terminal": np.isin(event, [e for e in Event if e.terminal]),
        "event": event,
        "sequence": np.full(n, sequence),
        "episode": episode,
        "step": step,
        "robot_pose": np.full((n, 3), np.nan),
        "robot_radius": np.full(n, np.nan),
        "leading_action": actions,
        "leading_reward": rewards,
        "source_robot_state": arrays["robotstates"],
    }
    return {name: np.ascontiguousarray(values, COLUMNS[name].dtype) for name, values in columns.items()}


def _sequence(path: Path, sequence: int, range_max: float, rings: bool) -> Arrays:
    """Return all columns of one file."""
    _, arrays = _load(path)
    for name in ("actions", "rewards"):
        if not np.isfinite(arrays[name]).all():
            raise CorruptDataError(f"{path}: array {name!r} holds NaN or inf, expected finite numbers.")
    states = arrays["robotstates"]
    if np.isinf(states).any() or np.isnan(states[:, 2:]).any():
        raise CorruptDataError(f"{path}: array 'robotstates' holds inf or NaN velocities, expected NaN in goals only.")
    dones = arrays["dones"]
    if dones.dtype != np.bool_ and not np.isin(dones, (0, 1)).all():
        raise CorruptDataError(f"{path}: array 'dones' holds {dones.max()} and {dones.min()}, expected 0 and 1 only.")
    columns = align({**arrays, "dones": dones.astype(np.bool_)}, sequence)
    columns["scan"] = _clean_scans(arrays["scans"], range_max, path)
    if rings:
        columns["rings"] = scan_to_rings(columns["scan"])
    return columns


def import_npz(
    source: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    env: str = "imported",
    range_max: float = RANGE_MAX,
    dt: float = DT,
    rings: bool = True,
    progress: Callable[[int, int], None] | None = None,
    report: Callable[[str], None] | None = None,
) -> Manifest:
    """Turn sequences recorded by the original software into a dataset.

    Parameters
    ----------
    source : path-like or iterable of path-like
        Folder of ``NNN_scans_robotstates_actions_rewards_dones.npz`` files, one such file, or several of either. Each
        file becomes a sequence, in the order given (folders: by name).
    out : path-like
        New dataset folder; must not exist, or be empty.
    env : str
        Name of the environment, for the manifest.
    range_max : float
        Range of the sensor [m].
    dt : float
        Time between rows [s].
    rings : bool
        Store rings too (else they are computed when read).
    progress : callable, optional
        Called with (files done, files) after each file.
    report : callable, optional
        Receives a line that says which rays no scan has seen anything with, if there are any.

    Returns
    -------
    Manifest
        Of the new dataset; ``config["blind_rays"]`` are those that are 0 in every scan, as [first, last].

    Raises
    ------
    DatasetNotFoundError
        If there is nothing to import.
    FolderInUseError
        If `out` holds something.
    CorruptDataError, DatasetError
        If a file is damaged, too large, holds pickled objects, or arrays of other names, shapes or dtypes.
    ConfigError
        If a range exceeds `range_max`.

    Notes
    -----
    Source: navrep/scripts/make_vae_dataset.py, and navrep/tools/data_extraction.py, whose scans are float64 and whose
    ``dones`` are whole numbers. A row of the original holds the action and reward that *led
    to* it and no episode's first observation. Here ``action`` and ``reward`` of a row are those of the next
    row of its episode, and 0 on its last row; the original's stay in ``leading_action`` and
    ``leading_reward``. Scans are float32 in metres; NaN and negative ranges become 0 (nobody saw), +inf becomes
    `range_max`. Poses, radii and humans are not in the source.

    Where its robot is stuck, the original ends the episode with one frame of another episode that is never
    played (done, zero action, zero reward). The row before becomes the last one of the played episode
    (``stuck``), the odd frame an episode of one row (``cut``). So the original's ``dones`` are ``is_last &
    (event != stuck)``.

    Events follow from rewards: 100 goal, -25 ``collision_obstacle`` (the source does not tell humans from
    obstacles), done on row 176 ``timeout``, anything else ``cut``.
    """
    files = _find(source)
    if not (math.isfinite(range_max) and range_max > 0 and math.isfinite(dt) and dt > 0):
        raise ConfigError(f"range_max is {range_max} m and dt {dt} s, expected positive numbers.")
    with new_folder(out, what="an import") as part:
        lengths = [_load(path, read=False)[0] for path in files]
        sensor = SensorContract(range_max=float(range_max), dt=float(dt))
        blind = _never_seen(files, sensor)
        if blind.any() and report is not None:
            report(declaration(blind, sensor))
        manifest = _plan(files, lengths, env, sensor, rings, runs_of(blind))
        return _write(part, manifest, files, range_max, rings, progress)


def _never_seen(files: Sequence[Path], sensor: SensorContract) -> npt.NDArray[np.bool_]:
    """Return which rays are 0 in every scan of all files, (n_rays,); reads on only while there may be such."""
    blind = np.ones(sensor.n_rays, np.bool_)
    for path in files:
        blind &= (_clean_scans(_load(path)[1]["scans"], sensor.range_max, path) == 0.0).all(axis=0)
        if not blind.any():
            break
    return blind


def _plan(
    files: Sequence[Path], lengths: Sequence[int], env: str, sensor: SensorContract, rings: bool,
    blind: list[tuple[int, int]],
) -> Manifest:  # fmt: skip
    """Return the manifest of the dataset before any shard is written."""
    config: dict[str, Any] = {
        "source": [{"file": path.name, "sha256": sha256_file(path)} for path in files],
        "collision_events": "the source does not tell humans from obstacles: all are collision_obstacle",
    }
    if blind:
        config["blind_rays"] = [list(run) for run in blind]
    return Manifest(
        env=env,
        physics="imported",
        seed=0,
        length=max(lengths),
        planned=len(files),
        shard_size=max(1, min(MAX_SEQUENCES_PER_SHARD, MAX_ROWS_PER_SHARD // max(lengths))),
        scan_dtype="float32",
        columns=tuple(name for name in _COLUMNS if rings or name != "rings"),
        max_humans=0,
        sensor=sensor,
        config=config,
        policy={"name": "unknown"},
        versions={"navrep-data": __version__, "numpy": np.__version__, "python": platform.python_version()},
        command=shlex.join(
            ["navrep-data", "import-npz", "DIR" if len(files) > 1 else files[0].name, "--out", "OUT", "--env", env]
        )
        + f" --range-max {exact(sensor.range_max)}",
    )


def exact(value: float) -> str:
    """Return a number as a command line on a card says it: the shortest text that reads back as the same number."""
    return repr(float(value)).removesuffix(".0")


def _write(
    root: Path,
    manifest: Manifest,
    files: Sequence[Path],
    range_max: float,
    rings: bool,
    progress: Callable[[int, int], None] | None,
) -> Manifest:
    """Write all shards, the card and the manifest."""
    writer = DatasetWriter(root, manifest)
    for number, file in enumerate(files):
        writer.append(number, split_of(number), _sequence(file, number, range_max, rings))
        if progress is not None:
            progress(number + 1, len(files))
    return writer.finish()
