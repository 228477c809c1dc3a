"""Recordings of real robots, from ROS 1 and ROS 2 bags, turned into a dataset."""

from __future__ import annotations

import math
import os
import platform
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data._version import __version__
from navrep_data.datasets._bag import NO_TOPIC, Bag
from navrep_data.datasets._bag_scans import Adapters
from navrep_data.datasets._bag_types import Reading, Topics, Tracks
from navrep_data.datasets.npz import MAX_ROWS_PER_SHARD, MAX_SEQUENCES_PER_SHARD, align, exact
from navrep_data.errors import ConfigError, DatasetError, check_whole, one_line
from navrep_data.io import new_folder, sha256_bytes, sha256_file
from navrep_data.observations import scan_to_rings
from navrep_data.observations.blind import declaration, runs_of
from navrep_data.schema import COLUMNS, DT, MAX_COORDINATE, RANGE_MAX, SIMULATED_COLUMNS, SensorContract
from navrep_data.shards import DatasetWriter, Manifest, split_of

Arrays = dict[str, npt.NDArray[Any]]
Ints = npt.NDArray[np.int64]

# The original's rules for recorded data (tools/data_extraction.py).
STEP_REWARD, GOAL_REWARD = -0.01, 100.0
GOAL_RADIUS = 0.5
# A row is its nearest scan's; where scans are further apart than this, in steps, time is torn [steps].
LARGEST_GAP = 1.5
# Drivers are late now and then, not by half.
_SLOW = 1.05
MAX_LENGTH = 100_000
_COLUMNS = tuple(name for name in COLUMNS if name not in SIMULATED_COLUMNS)
_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class _Piece:
    """The rows of one sequence, without scans; `scans` are their numbers in the bag."""

    arrays: Arrays
    pose: npt.NDArray[np.float64]
    scans: Ints

    def columns(self, number: int, scan: npt.NDArray[np.float32], rings: bool) -> Arrays:
        columns = align(self.arrays, number, timeout_rows=None)
        columns["robot_pose"] = self.pose.astype(np.float32)
        columns["scan"] = scan
        if rings:
            columns["rings"] = scan_to_rings(scan)
        return columns


@dataclass(frozen=True)
class _Recording:
    """One bag: what it is, and its sequences."""

    path: Path
    topics: Topics
    tracks: Tracks
    pieces: list[_Piece]


def import_rosbag(
    source: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    scan_topic: str | None = None,
    odometry_topic: str | None = None,
    goal_topic: str | None = None,
    env: str = "rosbag",
    dt: float = DT,
    length: int = 1000,
    range_max: float | None = None,
    mount: Sequence[float] = (0.0, 0.0, 0.0),
    goal_radius: float = GOAL_RADIUS,
    assume_same_frame: bool = False,
    invalid_is_free: bool = False,
    rings: bool = True,
    progress: Callable[[int, int], None] | None = None,
    note: Callable[[str], None] | None = None,
) -> Manifest:
    """Turn ROS bags with a laser scan, odometry and perhaps goals into a dataset.

    Parameters
    ----------
    source : path-like or iterable of path-like
        ROS 1 ``.bag`` files, folders of ROS 2 bags (without their metadata.yaml, if need be), ``.mcap``, ``.db3``.
    out : path-like
        New dataset folder.
    scan_topic, odometry_topic : str, optional
        Topics of ``sensor_msgs/LaserScan`` and ``nav_msgs/Odometry``; needed where a bag has several (of scans,
        ``/combined_scan`` is taken by itself).
    goal_topic : str, optional
        Topic of ``geometry_msgs/PoseStamped``; by default the one with "goal" in its name, if any. ``"none"``: goals
        are unknown.
    env : str
        Name of the environment, for the manifest.
    dt : float
        Time between rows [s].
    length : int
        Most rows of a sequence.
    range_max : float, optional
        Of the new scans [m], 25 by default; what is further away counts as free. Where the recorded scans' own
        range_max is 0 or NaN it has to be given, and says from which range on the scanner hit nothing.
    mount : sequence of float
        x, y [m] and yaw [rad] of the scanner on the robot, robot frame.
    goal_radius : float
        A goal is reached nearer than this [m].
    assume_same_frame : bool
        Take goals and odometry as given in one frame although their frame ids differ, and leave ``/tf`` alone.
    invalid_is_free : bool
        Whether NaN, 0 and ranges below range_min mean that nothing was hit, as with drivers that report no return so.
        Otherwise they say nothing (:mod:`navrep_data.observations.blind`).
    rings : bool
        Store rings too (else they are computed when read).
    progress : callable, optional
        Called with (sequences done, sequences in all).
    note : callable, optional
        Called with each line about what was left out or read in another way than usual; by default they go to stderr.

    Returns
    -------
    Manifest
        Of the new dataset; ``config["blind_rays"]`` are those that are 0 in every scan of a bag.

    Raises
    ------
    MissingExtraError
        If rosbags is not installed: ``pip install 'navrep-data[ros]'``.
    DatasetNotFoundError
        If there is no such bag.
    ConfigError
        If a setting cannot be used, or a topic or range_max has to be given.
    DatasetError
        If a bag lacks scans or odometry, they are too rare for `dt`, no transform joins the frames of goals and
        odometry, or nothing is left.
    CorruptDataError
        If a bag is damaged; the message names the command that mends it.
    FolderInUseError
        If `out` holds something.

    Notes
    -----
    Source: navrep/tools/data_extraction.py: the action that led to a row is the odometry's twist, reward is -0.01 per
    row and 100 on arrival, an unknown goal is NaN. As in :func:`import_npz`, ``action`` and ``reward`` of a row are
    those that led to the next. Differences: rows are `dt` apart by the stamps in headers (by the time of recording
    where scans or odometry have none, or stamps of two clocks), each with the nearest scan and odometry; the scan is
    seen from the robot's centre with the usual 1080 rays (:class:`ScanAdapter`), each by its own description, 0 where
    nobody saw anything; poses are kept, less a whole number of metres where they lie beyond 16 km, as `note` tells and
    ``origins`` of the manifest. Goals in another frame are taken to the odometry's by ``/tf`` and
    ``/tf_static`` as of when they came.

    An episode ends where its goal is reached (``goal``), or another goal comes, the sequence is full, or scans or
    odometry pause (``cut``; after a pause a new sequence begins). A goal that was reached is not known any more.
    """
    paths = [Path(source)] if isinstance(source, str | os.PathLike) else [Path(item) for item in source]
    reach, range_max = range_max, RANGE_MAX if range_max is None else range_max
    _check(paths, dt, range_max, mount, goal_radius)
    length = check_whole("length", length, 2, MAX_LENGTH)
    reading = Reading(mount, reach, invalid_is_free, assume_same_frame)
    tell = _print if note is None else note

    def say(line: str) -> None:
        tell(one_line(line))  # names and errors of other libraries are quoted

    recordings = []
    for path in paths:
        with Bag(path, scan_topic, odometry_topic, goal_topic, say) as bag:
            tracks = bag.tracks(reading)
            topics = bag.topics
        _check_rates(path, topics, tracks, dt)
        recordings.append(_Recording(path, topics, tracks, list(_pieces(tracks, dt, length, goal_radius))))
    if not any(r.pieces for r in recordings):
        raise DatasetError(
            f"Nothing is left of {paths[0]}: its scans and odometry were never recorded at the same time; expected two "
            "rows at least."
        )
    recordings, origin = near_zero(recordings, say)
    with new_folder(out, what="an import") as part:
        sensor = SensorContract(range_max=float(range_max), dt=float(dt))
        blind = _blind_rays(recordings, sensor, say)
        command = _command(
            len(paths), env, sensor, length, goal_radius, reading,
            {"--scan-topic": scan_topic, "--odometry-topic": odometry_topic, "--goal-topic": goal_topic},
        )  # fmt: skip
        manifest = _plan(recordings, env, sensor, length, rings, goal_radius, blind, command)
        if origin is not None:
            manifest = replace(manifest, origins={"recording": origin})
        return _write(part, manifest, recordings, rings, progress)


def _print(line: str) -> None:
    print(line, file=sys.stderr)


def _blind_rays(
    recordings: Sequence[_Recording], sensor: SensorContract, say: Callable[[str], None]
) -> list[list[int]]:
    """Return the rays that are blind in every scan of a bag, as pairs [first, last], and say so once."""
    blind = np.zeros(sensor.n_rays, np.bool_)
    for r in recordings:
        blind |= r.tracks.book.never_seen(sensor)
    if blind.any():
        say(declaration(blind, sensor))
    return [[a, b] for a, b in runs_of(blind)]


def near_zero(
    recordings: Sequence[_Recording], say: Callable[[str], None]
) -> tuple[list[_Recording], tuple[float, float] | None]:
    """Return recordings with poses that float32 can store to the millimetre, and what was taken from x and y [m].

    Poses beyond 16 km, as of odometry in UTM coordinates, are shifted by whole metres, all bags by the same.
    """
    poses = [piece.pose for r in recordings for piece in r.pieces]
    if all(np.abs(pose[:, :2]).max() <= MAX_COORDINATE for pose in poses):
        return list(recordings), None
    x, y = (float(v) for v in np.rint(poses[0][0, :2]))
    say(
        f"poses lie beyond {MAX_COORDINATE:.0f} m of 0, where float32 loses millimetres: they are stored less "
        f"({x:.0f}, {y:.0f}) m, which the manifest holds under origins"
    )
    shift = np.array([x, y, 0.0])
    return [replace(r, pieces=[replace(p, pose=p.pose - shift) for p in r.pieces]) for r in recordings], (x, y)


def _check(paths: Sequence[Path], dt: float, range_max: float, mount: Sequence[float], radius: float) -> None:
    if not paths:
        raise ConfigError("No bag was given; expected ROS 1 .bag files or folders of ROS 2 bags.")
    if not all(math.isfinite(v) and v > 0 for v in (dt, range_max, radius)):
        raise ConfigError(f"dt is {dt} s, range_max {range_max} m, goal_radius {radius} m; expected positive numbers.")
    if len(mount) != 3:
        raise ConfigError(f"mount has {len(mount)} numbers; expected x, y [m] and yaw [rad] of the scanner.")


def _check_rates(path: Path, topics: Topics, tracks: Tracks, dt: float) -> None:
    for topic, times in ((topics.scan, tracks.scan_times), (topics.odometry, tracks.times)):
        period = float(np.median(np.diff(times))) / _NANOSECONDS if len(times) > 1 else math.inf
        if period > _SLOW * dt:
            raise DatasetError(
                f"{path}: messages on {topic} come every {period:.3g} s, expected at least every {dt:g} s; "
                "give a larger dt (--dt), or use another topic."
            )


def _nearest(times: Ints, at: Ints) -> Ints:
    """Return the position of the time nearest to each of `at`."""
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1) if len(times) > 1 else np.zeros(len(at), np.int64)
    before = np.maximum(after - 1, 0)
    return np.where(at - times[before] <= times[after] - at, before, after)


def _pieces(tracks: Tracks, dt: float, length: int, radius: float) -> Iterator[_Piece]:
    """Yield the sequences of a bag."""
    t, step = tracks.scan_times, dt * _NANOSECONDS
    torn = np.flatnonzero(np.diff(t) > LARGEST_GAP * step) + 1
    goals = _Goals(tracks, radius)
    for first, stop in zip(np.append(0, torn).tolist(), np.append(torn, len(t)).tolist(), strict=True):
        count = int((t[stop - 1] - t[first]) / step + 1e-6) + 1
        grid = t[first] + np.rint(np.arange(count) * step).astype(np.int64)
        scans, odometry = _nearest(t, grid), _nearest(tracks.times, grid)
        known = np.abs(tracks.times[odometry] - grid) <= 0.5 * step
        edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
        for a, b in edges.reshape(-1, 2).tolist():
            for low in range(a, b, length):
                rows = slice(low, min(low + length, b))
                if rows.stop - rows.start > 1:
                    yield _piece(tracks, goals, grid[rows], tracks.scan_numbers[scans[rows]], odometry[rows])


class _Goals:
    """The goal in each row, as time goes on."""

    def __init__(self, tracks: Tracks, radius: float) -> None:
        self.tracks, self.radius = tracks, radius
        self.came, self.reached = 0, 0  # goals so far, and those of them that are over

    def next(self, time: int, position: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64] | None, bool, bool]:
        """Return the goal of a row (None if unknown), whether it is new, and whether it is reached."""
        came = int(np.searchsorted(self.tracks.goal_times, time, side="right"))
        new, self.came = came != self.came, came
        if came == 0 or self.reached == came:
            return None, new, False
        goal = self.tracks.goals[came - 1]
        arrived = math.dist(goal, position) < self.radius
        if arrived:
            self.reached = came
        return goal, new, arrived


def _piece(tracks: Tracks, goals: _Goals, times: Ints, scans: Ints, odometry: Ints) -> _Piece:
    """Return the rows of one sequence in the original's arrays."""
    pose, twist = tracks.pose[odometry], tracks.twist[odometry]
    n = len(times)
    offset = np.full((n, 2), np.nan)
    rewards, dones = np.full(n, STEP_REWARD), np.zeros(n, bool)
    for k in range(n):
        goal, new, arrived = goals.next(int(times[k]), pose[k, :2])
        if new and k > 0:
            dones[k - 1] = True
        if goal is not None:
            offset[k] = goal - pose[k, :2]
        if arrived:
            rewards[k], dones[k] = GOAL_REWARD, True
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    ahead = np.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]], axis=1)
    arrays = {"robotstates": np.hstack([ahead, twist]), "actions": twist, "rewards": rewards, "dones": dones}
    return _Piece(arrays, np.column_stack([pose[:, :2], pose[:, 2] % (2.0 * math.pi)]), scans)


def _hash(path: Path) -> str:
    """Return the SHA-256 of a bag; of a folder, over names and hashes of its files."""
    if path.is_file():
        return sha256_file(path)
    files = sorted(p for p in path.rglob("*") if p.is_file())
    return sha256_bytes("".join(f"{p.relative_to(path).as_posix()} {sha256_file(p)}\n" for p in files).encode())


def _command(
    n: int,
    env: str,
    sensor: SensorContract,
    length: int,
    radius: float,
    reading: Reading,
    topics: dict[str, str | None],
) -> str:
    """Return the command line that makes the same dataset: for the card."""
    words = ["navrep-data", "import-rosbag", *["BAG"] * n, "--out", "OUT", "--env", env]
    words += ["--dt", exact(sensor.dt), "--length", str(length), "--range-max", exact(sensor.range_max)]
    words += [word for flag, topic in topics.items() if topic is not None for word in (flag, topic)]
    if any(reading.mount):
        words += ["--mount", ",".join(map(exact, reading.mount))]
    words += ["--goal-radius", exact(radius)]
    words += ["--assume-same-frame"] if reading.assume_same_frame else []
    words += ["--invalid-is-free"] if reading.invalid_is_free else []
    return shlex.join(words)


def _plan(
    recordings: Sequence[_Recording], env: str, sensor: SensorContract, length: int, rings: bool, radius: float,
    blind: list[list[int]], command: str,
) -> Manifest:  # fmt: skip
    """Return the manifest of the dataset before any shard is written."""
    config = {
        "source": [
            {
                "file": r.path.name,
                "sha256": _hash(r.path),
                **asdict(r.topics),
                "clock": "stamps" if r.tracks.clock.stamps else "recording",
            }
            for r in recordings
        ],
        # a scanner without a limit has an infinite range_max, which JSON does not have
        "lidars": [{k: v if math.isfinite(v) else None for k, v in asdict(r.tracks.lidar).items()} for r in recordings],
        "blind_rays": blind,
        "goal_radius": radius,
    }
    return Manifest(
        env=env,
        physics="recorded",
        seed=0,
        length=length,
        planned=sum(len(r.pieces) for r in recordings),
        shard_size=max(1, min(MAX_SEQUENCES_PER_SHARD, MAX_ROWS_PER_SHARD // length)),
        scan_dtype="float32",
        columns=tuple(name for name in _COLUMNS if rings or name != "rings"),
        max_humans=0,
        sensor=sensor,
        config=config,
        policy={"name": "unknown"},
        versions={"navrep-data": __version__, "numpy": np.__version__, "python": platform.python_version()},
        command=command,
    )


def _sequences(recordings: Sequence[_Recording], sensor: SensorContract, rings: bool) -> Iterator[Arrays]:
    """Yield the columns of all sequences, in order."""
    number = 0
    adapt = Adapters(sensor)
    for r in recordings:
        if not r.pieces:
            continue
        with Bag(r.path, r.topics.scan, r.topics.odometry, r.topics.goal or NO_TOPIC, lambda _: None) as bag:
            seen = bag.scans(np.concatenate([p.scans for p in r.pieces]), r.tracks.book)
            for piece in r.pieces:
                scan = np.stack([adapt(*next(seen)) for _ in piece.scans])
                yield piece.columns(number, scan, rings)
                number += 1


def _write(
    root: Path,
    manifest: Manifest,
    recordings: Sequence[_Recording],
    rings: bool,
    progress: Callable[[int, int], None] | None,
) -> Manifest:
    """Write all shards, the card and the manifest."""
    writer = DatasetWriter(root, manifest)
    for number, columns in enumerate(_sequences(recordings, manifest.sensor, rings)):
        writer.append(number, split_of(number), columns)
        if progress is not None:
            progress(number + 1, manifest.planned)
    return writer.finish()


def parse_mount(text: str) -> tuple[float, ...]:
    """Return the numbers in ``x,y,yaw``.

    Raises
    ------
    ConfigError
        If there are not three.
    """
    try:
        x, y, yaw = map(float, text.split(","))
    except ValueError:
        raise ConfigError(f"--mount is {text!r}; expected x,y,yaw as in 0.25,0,0 [m, m, rad].") from None
    return x, y, yaw
