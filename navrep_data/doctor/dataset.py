"""What is wrong with a dataset though every byte is as written: leaks between splits, sensors and resets that disagree.

``verify`` proves that files are whole and fit their schema. What is looked for here are mistakes of whoever made the
data: rows that are in two splits, scans that are frozen or of another sensor, clocks and poses that do not fit the
velocities, episodes that do not start where they say.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from navrep_data.schema import Event
from navrep_data.shards import DatasetFolder, EpisodeWorld, Manifest, verify

Array = NDArray[Any]
Severity = Literal["problem", "note"]

MIN_EPISODE_ROWS = 3
"""Shorter episodes say too little to be counted as doubled."""
PLACE_TOLERANCE = 0.02
"""Metres by which two ways to the same place may differ: poses are float32, humans and goals are rounded."""
TURN_TOLERANCE = 0.01
"""Radians by which headings may differ."""
SLACK = 0.1
"""Metres that a robot may move or its goal may shift beyond its speed in one step, before it counts as a jump."""
CLOCK_RATIO = (0.8, 1.25)
"""Bounds of distance moved over speed times dt, in the median over all rows of a sequence that move."""
MIN_SPEED = 0.1
FROZEN_SHARE = 0.5
"""Share of the moving rows whose scan is that of the row before, to the last bit."""
MAX_FINDINGS = 20
_MIN_ROWS = 20
_CONTENT = ("scan", "robot_state", "action")


@dataclass(frozen=True)
class DatasetFinding:
    """Something about a dataset that deserves a look.

    Attributes
    ----------
    check : str
        ``verify``, ``duplicates``, ``sensor``, ``reset``, ``goal`` or ``motion``.
    severity : {"problem", "note"}
        Notes stop nothing.
    where : str
        File, or sequence and episode.
    what : str
        One line: what was seen, what was expected.
    """

    check: str
    severity: Severity
    where: str
    what: str


@dataclass
class DatasetReport:
    """What :func:`check_dataset` found.

    Attributes
    ----------
    findings : list of DatasetFinding
        At most 20 per check.
    sequences, episodes, rows : int
        What was looked at.
    skipped : list of str
        Checks that this dataset has no columns for, and why.
    """

    findings: list[DatasetFinding] = field(default_factory=list)
    sequences: int = 0
    episodes: int = 0
    rows: int = 0
    skipped: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether no problem was found."""
        return not any(f.severity == "problem" for f in self.findings)


@dataclass
class _Sequence:
    """One sequence: its columns, its episodes as [start, stop) rows, the worlds of these."""

    number: int
    columns: dict[str, Array]
    starts: NDArray[np.int64]
    stops: NDArray[np.int64]
    worlds: list[EpisodeWorld | None]


def check_dataset(root: Path | str, *, progress: Callable[[int, int], None] | None = None) -> DatasetReport:
    """Check a dataset: all that ``verify`` does, and what it means beyond its bytes.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    progress : callable, optional
        Called with (sequences done, sequences in all).

    Returns
    -------
    DatasetReport

    Raises
    ------
    DatasetNotFoundError, SchemaVersionError, CorruptDataError
        As :func:`navrep_data.shards.verify`.

    Notes
    -----
    Episodes are compared by a hash over scans, robot states and actions, wherever they stand. Where poses are known,
    the goal of each row is computed in the world frame and must stay in place; elsewhere its distance may not change
    faster than the robot moves.
    """
    verified = verify(root)
    report = DatasetReport([DatasetFinding("verify", "problem", p.file, p.what) for p in verified.problems])
    damaged = {problem.file for problem in verified.problems}  # there is no telling what their rows mean
    manifest = Manifest.read(root)
    add = _Collector(report)
    add.all("sensor", "manifest.json", _contract(manifest))
    if "robot_pose" not in manifest.columns:
        report.skipped.append("poses, resets and clock: there is no column robot_pose")
    seen: dict[bytes, tuple[str | None, str]] = {}
    with DatasetFolder(root) as folder:
        done, posed = 0, False
        for index, entry in enumerate(manifest.shards):
            if damaged & {entry.file, entry.worlds.file if entry.worlds else ""}:
                continue
            for sequence in _sequences(folder, index):
                report.sequences += 1
                report.episodes += len(sequence.starts)
                report.rows += int(sequence.stops[-1])
                _check_duplicates(sequence, manifest.split_of(sequence.number), seen, add)
                posed |= _check_sequence(sequence, manifest, add)
                done += 1
                if progress is not None:
                    progress(done, manifest.sequences)
        if report.sequences and not posed and not report.skipped:
            report.skipped.append("poses, resets and clock: the poses are unknown (NaN), as in imports")
    add.finish()
    return report


class _Collector:
    """Puts findings into a report, a bounded number per check."""

    def __init__(self, report: DatasetReport) -> None:
        self.report = report
        self._counts: dict[str, int] = {}

    def __call__(self, check: str, severity: Severity, where: str, what: str) -> None:
        count = self._counts[check] = self._counts.get(check, 0) + 1
        if count <= MAX_FINDINGS:
            self.report.findings.append(DatasetFinding(check, severity, where, what))

    def all(self, check: str, where: str, problems: Iterator[str]) -> None:
        for what in problems:
            self(check, "problem", where, what)

    def finish(self) -> None:
        for check, count in self._counts.items():
            if count > MAX_FINDINGS:
                rest = count - MAX_FINDINGS
                self.report.findings.append(DatasetFinding(check, "note", "", f"and {rest:,} more of this kind"))


def _sequences(folder: DatasetFolder, index: int) -> Iterator[_Sequence]:
    """Yield the sequences of a shard, one in memory at a time."""
    shard, worlds = folder.shard(index), folder.worlds(index)
    numbers = shard.read("sequence", 0, shard.rows)
    firsts = shard.read("is_first", 0, shard.rows)
    at = {} if worlds is None else {int(row): k for k, row in enumerate(worlds.arrays["row"])}
    cuts = np.flatnonzero(np.diff(numbers)) + 1
    for low, high in zip([0, *cuts.tolist()], [*cuts.tolist(), shard.rows], strict=True):
        if high <= low:
            continue
        names = [n for n in (*_CONTENT, "robot_pose", "event") if n in shard.columns]
        columns = {name: shard.read(name, low, high) for name in names}
        starts = np.flatnonzero(firsts[low:high])
        starts = starts if len(starts) and starts[0] == 0 else np.concatenate([[0], starts])
        found = [None if worlds is None or low + s not in at else worlds.episode(at[low + s]) for s in starts.tolist()]
        yield _Sequence(int(numbers[low]), columns, starts, np.append(starts[1:], high - low), found)


def _contract(manifest: Manifest) -> Iterator[str]:
    """Yield what cannot be true of the sensor."""
    sensor = manifest.sensor
    if not 0.0 < sensor.dt <= 10.0:
        yield f"dt is {sensor.dt:g} s, expected a step of a robot: more than 0 and at most 10 s"
    span = (sensor.n_rays - 1) * abs(sensor.angle_increment)
    if not 0.0 < span < 2.0 * np.pi + 1e-6:
        yield f"{sensor.n_rays} rays of {sensor.angle_increment:g} rad span {span:g} rad, expected a full turn at most"
    config = manifest.config.get("dt")
    if isinstance(config, int | float) and config != sensor.dt:
        yield f"dt is {sensor.dt:g} s in the sensor and {config:g} s in the configuration"


def _check_duplicates(
    sequence: _Sequence, split: str | None, seen: dict[bytes, tuple[str | None, str]], add: _Collector
) -> None:
    for k, (start, stop) in enumerate(zip(sequence.starts.tolist(), sequence.stops.tolist(), strict=True)):
        if stop - start < MIN_EPISODE_ROWS:
            continue
        digest = hashlib.sha256()
        for name in _CONTENT:
            digest.update(np.ascontiguousarray(sequence.columns[name][start:stop]).view(np.uint8).data)
        where = f"sequence {sequence.number} episode {k}"
        other = seen.setdefault(digest.digest(), (split, where))
        if other[1] == where:
            continue
        if other[0] != split:
            what = f"the same rows as {other[1]}: one is in split {split}, the other in {other[0]}"
            add("duplicates", "problem", where, what)
        else:
            add("duplicates", "note", where, f"the same rows as {other[1]}")


def _check_sequence(sequence: _Sequence, manifest: Manifest, add: _Collector) -> bool:
    """Check scans, goals, motion and resets of one sequence; return whether its poses are known."""
    where = f"sequence {sequence.number}"
    inner = np.ones(len(sequence.columns["scan"]) - 1, bool)  # from a row to the next one of the same episode
    inner[sequence.starts[1:] - 1] = False
    state = sequence.columns["robot_state"].astype(np.float64)
    speed = np.hypot(state[:, 2], state[:, 3])
    add.all("sensor", where, _scans(sequence.columns["scan"], speed, inner, declared_blind(manifest)))
    pose = sequence.columns.get("robot_pose")
    posed = pose is not None and bool(np.isfinite(pose).all())
    if pose is None or not posed:
        add.all("goal", where, _distances(state, speed, inner, manifest.sensor.dt))
        return False
    wide = pose.astype(np.float64)
    add.all("motion", where, _motion(wide, speed, inner, manifest.sensor.dt))
    _check_goals(sequence, wide, state, add)
    _check_resets(sequence, wide, add)
    return True


def declared_blind(manifest: Manifest) -> NDArray[np.bool_]:
    """Return which rays nobody sees, as the dataset or one that it was made from says, shape (n_rays,), bool.

    Notes
    -----
    ``config["blind_rays"]`` of a manifest: pairs [first, last] of ray numbers. ``import-rosbag`` writes it.
    """
    blind = np.zeros(manifest.sensor.n_rays, np.bool_)
    for config in (manifest.config, *(record.get("config") for record in manifest.source)):
        pairs = config.get("blind_rays") if isinstance(config, dict) else None
        for pair in pairs if isinstance(pairs, list | tuple) else ():
            if isinstance(pair, list | tuple) and len(pair) == 2 and all(type(k) is int and k >= 0 for k in pair):
                blind[pair[0] : pair[1] + 1] = True
    return blind


def _scans(scan: Array, speed: Array, inner: Array, blind: NDArray[np.bool_]) -> Iterator[str]:
    """Yield what no working lidar would do."""
    if len(scan) < _MIN_ROWS:
        return
    unseen = (scan == 0).all(axis=0)
    dead = int((unseen & ~blind).sum())
    if dead:
        beside = f", beside {int((unseen & blind).sum())} that are declared blind" if blind.any() else ""
        yield f"{dead} of {scan.shape[1]} rays are invalid (0) on every row{beside}"
    moving = inner & (speed[1:] > MIN_SPEED)
    if moving.sum() < _MIN_ROWS:
        return
    frozen = (scan[1:] == scan[:-1]).all(axis=1)[moving].mean()
    if frozen > FROZEN_SHARE:
        yield f"{frozen:.0%} of the rows that move have the scan of the row before, to the last bit"


def _distances(state: Array, speed: Array, inner: Array, dt: float) -> Iterator[str]:
    """Yield goals that come or go faster than the robot moves; NaN goals are unknown."""
    distance = np.hypot(state[:, 0], state[:, 1])
    allowed = np.maximum(speed[1:], speed[:-1]) * dt + SLACK
    jumps = np.flatnonzero(inner & (np.abs(np.diff(distance)) > allowed))
    if len(jumps):
        k = int(jumps[0])
        yield (
            f"the goal's distance changes by {abs(distance[k + 1] - distance[k]):.2f} m at row {k + 1} within an "
            f"episode, expected at most {allowed[k]:.2f} m ({len(jumps)} rows)"
        )


def _motion(pose: Array, speed: Array, inner: Array, dt: float) -> Iterator[str]:
    """Yield poses that do not follow from velocities."""
    moved = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    reach = np.maximum(speed[1:], speed[:-1]) * dt + SLACK
    jumps = np.flatnonzero(inner & (moved > reach))
    if len(jumps):
        k = int(jumps[0])
        yield (
            f"the robot jumps by {moved[k]:.2f} m at row {k + 1} within an episode, expected at most {reach[k]:.2f} m: "
            f"a reset without is_first? ({len(jumps)} rows)"
        )
    steady = inner & (np.minimum(speed[1:], speed[:-1]) > MIN_SPEED)
    if steady.sum() < _MIN_ROWS:
        return
    ratio = float(np.median(moved[steady] / (speed[1:][steady] * dt)))
    if not CLOCK_RATIO[0] <= ratio <= CLOCK_RATIO[1]:
        yield f"the robot moves {ratio:.2f} times as far as its velocity and dt = {dt:g} s say: another clock or unit?"


def _check_goals(sequence: _Sequence, pose: Array, state: Array, add: _Collector) -> None:
    """Compare the goals of all rows of an episode, in the world frame, with its first one."""
    goals = _goals(pose, state)
    for k, (start, stop) in enumerate(zip(sequence.starts.tolist(), sequence.stops.tolist(), strict=True)):
        off = np.hypot(*(goals[start:stop] - goals[start]).T)
        bad = np.flatnonzero(off > PLACE_TOLERANCE + _rounding(state[start:stop]))
        if len(bad):
            what = f"the goal jumps by {off[bad[0]]:.2f} m at row {start + int(bad[0])}: one goal per episode expected"
            add("goal", "problem", f"sequence {sequence.number} episode {k}", what)
        world = sequence.worlds[k]
        if world is not None:
            away = float(np.hypot(*(goals[start] - world.robot_goal)))
            if away > PLACE_TOLERANCE + _rounding(state[start : start + 1])[0]:
                what = f"robot_state points {away:.2f} m beside the goal of its worlds file"
                add("goal", "problem", f"sequence {sequence.number} episode {k}", what)
        if sequence.columns["event"][stop - 1] == Event.GOAL:
            first, last = np.hypot(*state[start, :2]), np.hypot(*state[stop - 1, :2])
            if last > max(first, 1.0):
                what = f"ends as 'goal' {last:.2f} m away from it, further than it started"
                add("goal", "problem", f"sequence {sequence.number} episode {k}", what)


def _goals(pose: Array, state: Array) -> Array:
    """Return the goals [m] of rows in the world frame."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = state[:, 0], state[:, 1]
    return np.stack([pose[:, 0] + c * x - s * y, pose[:, 1] + s * x + c * y], axis=1)


def _rounding(state: Array) -> Array:
    """Return how far a goal may seem to move for the rounding of headings to float32, which grows with its distance."""
    found: Array = np.hypot(state[:, 0], state[:, 1]) * 1e-4
    return found


def _check_resets(sequence: _Sequence, pose: Array, add: _Collector) -> None:
    """Compare each episode's first pose with where its world says that it starts."""
    for k, (start, world) in enumerate(zip(sequence.starts.tolist(), sequence.worlds, strict=True)):
        if world is None:
            continue
        away = float(np.hypot(*(pose[start, :2] - world.robot_start[:2])))
        turn = abs((float(pose[start, 2] - world.robot_start[2]) + np.pi) % (2.0 * np.pi) - np.pi)
        if away > PLACE_TOLERANCE or turn > TURN_TOLERANCE:
            what = f"starts {away:.2f} m and {turn:.2f} rad from the start of its worlds file: the reset is out of line"
            add("reset", "problem", f"sequence {sequence.number} episode {k}", what)
