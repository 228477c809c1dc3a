"""ROS bags, read through the ``rosbags`` library: which topics, where the robot was, when scans came.

Times are those at which messages were recorded: one clock for all topics, which stamps in headers are not.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetError,
    DatasetNotFoundError,
    MissingExtraError,
    NavrepDataError,
    did_you_mean,
)
from navrep_data.observations import Lidar

SCAN_TYPE, ODOMETRY_TYPE = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
GOAL_TYPE = "geometry_msgs/msg/PoseStamped"
NO_TOPIC = "none"
# What the original's recorded data were read from, where a bag has several.
USUAL_SCAN_TOPIC = "/combined_scan"
MAX_RAYS = 100_000
# Goals nearer to each other than this are one goal, published again [m].
SAME_GOAL = 1e-3
_LISTED = 12

_PlainPath: Any = type(Path())
Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Topics:
    """The topics of a bag that are used; `goal` is None where there is none."""

    scan: str
    odometry: str
    goal: str | None


@dataclass(frozen=True)
class Tracks:
    """Everything in a bag but the ranges.

    Attributes
    ----------
    scan_times : ndarray of shape (S,), int64
        When each scan was recorded [ns], ascending.
    lidar : Lidar
        The scanner, in its place on the robot.
    times : ndarray of shape (N,), int64
        When each odometry message was recorded [ns], ascending.
    pose : ndarray of shape (N, 3)
        x, y [m], theta [rad] in the odometry's frame.
    twist : ndarray of shape (N, 3)
        vx, vy [m/s], omega [rad/s] along the robot's axes.
    goal_times : ndarray of shape (G,), int64
        When each new goal came [ns]; goals that were only published again are left out.
    goals : ndarray of shape (G, 2)
        x, y [m], in the odometry's frame.
    """

    scan_times: Ints
    lidar: Lidar
    times: Ints
    pose: Floats
    twist: Floats
    goal_times: Ints
    goals: Floats


class _SizedFile(io.BufferedReader):
    """A file that is never asked for more bytes than are left: memory is set aside for whatever a header claims."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(self._size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


class _BagPath(_PlainPath):  # type: ignore[misc]
    """A path that opens such files; rosbags takes any path that has the methods of one."""

    def open(self, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        return _SizedFile(self) if mode == "rb" else super().open(mode, *arguments, **named)


class Bag:
    """An open bag: a ROS 1 file, or a ROS 2 bag (its folder, or one .mcap or .db3 file).

    Parameters
    ----------
    path : pathlib.Path
        The bag.
    scan, odometry, goal : str, optional
        Topics; chosen where only one fits. ``"none"`` as `goal` for none.

    Attributes
    ----------
    topics : Topics
        Those that are used.
    """

    def __init__(self, path: Path, scan: str | None, odometry: str | None, goal: str | None) -> None:
        self.path = path
        self._stack = contextlib.ExitStack()
        self._reader = self._open()
        try:
            with self._explained():
                self._there = {n: t for n, t in self._reader.topics.items() if t.msgcount}
            self.topics = Topics(
                self._choose(scan, SCAN_TYPE, "--scan-topic", USUAL_SCAN_TOPIC),
                self._choose(odometry, ODOMETRY_TYPE, "--odometry-topic", ""),
                self._choose_goal(goal),
            )
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _open(self) -> Any:
        try:
            highlevel, types = importlib.import_module("rosbags.highlevel"), importlib.import_module("rosbags.typesys")
        except ImportError:
            raise MissingExtraError("rosbags is not installed; get it: pip install 'navrep-data[ros]'") from None
        if not self.path.exists():
            raise DatasetNotFoundError(f"There is no {self.path}; expected a ROS 1 .bag or the folder of a ROS 2 bag.")
        with self._explained():
            # bags of older ROS 2 do not say what their messages look like; those used here never changed
            store = types.get_typestore(types.Stores.ROS2_HUMBLE)
            return self._stack.enter_context(highlevel.AnyReader([_BagPath(self.path)], default_typestore=store))

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except NavrepDataError:
            raise
        except Exception as error:  # damaged bags make the library raise nearly anything
            reason = str(error).strip().rstrip(".") or type(error).__name__
            raise CorruptDataError(f"{self.path} cannot be read as a ROS bag ({reason}); get it again.") from error

    # -- topics

    def _list(self) -> str:
        names = sorted(self._there)
        rest = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
        return (", ".join(f"{n} ({self._there[n].msgtype})" for n in names[:_LISTED]) or "nothing") + rest

    def _choose(self, asked: str | None, kind: str, option: str, usual: str) -> str:
        fitting = sorted(name for name, topic in self._there.items() if topic.msgtype == kind)
        if asked is not None:
            if asked not in self._there:
                raise ConfigError(
                    f"{self.path} has no topic {asked!r}; it has {self._list()}.{did_you_mean(asked, self._there)}"
                )
            if asked not in fitting:
                raise ConfigError(f"Topic {asked} holds {self._there[asked].msgtype}, expected {kind}: {option}.")
            return asked
        if not fitting:
            raise DatasetError(f"{self.path} holds no {kind}; expected one such topic. It has {self._list()}.")
        if len(fitting) > 1 and usual not in fitting:
            raise ConfigError(f"{self.path} has {len(fitting)} topics of {kind}: choose with {option}: {fitting}.")
        return fitting[0] if len(fitting) == 1 else usual

    def _choose_goal(self, asked: str | None) -> str | None:
        if asked == NO_TOPIC:
            return None
        # poses are published for many purposes; only a name tells that one is a goal
        named = [n for n, t in self._there.items() if t.msgtype == GOAL_TYPE and "goal" in n.lower()]
        if asked is None and not named:
            return None
        return self._choose(asked or (named[0] if len(named) == 1 else None), GOAL_TYPE, "--goal-topic", "")

    # -- messages

    def _messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield time [ns] and raw message of a topic, in the order of time."""
        with self._explained():
            for connection, time, raw in self._reader.messages(self._there[topic].connections):
                yield time, (raw, connection.msgtype)

    def _decode(self, message: Any) -> Any:
        with self._explained():
            return self._reader.deserialize(*message)

    def tracks(self, mount: Sequence[float], assume_same_frame: bool) -> Tracks:
        """Return where the robot was, where it should go, and when scans came.

        Parameters
        ----------
        mount : sequence of float
            x, y [m] and yaw [rad] of the scanner, robot frame.
        assume_same_frame : bool
            Whether goals and odometry are in one frame although their names differ.

        Raises
        ------
        DatasetError
            If frames differ, or nothing usable is there.
        CorruptDataError
            If the bag is damaged.
        """
        first: Any = None
        scan_times = []
        for time, message in self._messages(self.topics.scan):
            first = message if first is None else first
            scan_times.append(time)
        frame, times, states = self._odometry()
        goal_times, goals = self._goals(frame, assume_same_frame)
        return Tracks(
            np.array(scan_times, np.int64), self._lidar(self._decode(first), mount), times, states[:, :3],
            states[:, 3:], goal_times, goals,
        )  # fmt: skip

    def _odometry(self) -> tuple[str, Ints, Floats]:
        frame = ""
        rows: list[tuple[float, ...]] = []
        times: list[int] = []
        for time, message in self._messages(self.topics.odometry):
            odometry = self._decode(message)
            frame = frame or str(odometry.header.frame_id)
            p, q = odometry.pose.pose.position, odometry.pose.pose.orientation
            v, w = odometry.twist.twist.linear, odometry.twist.twist.angular
            yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
            row = (p.x, p.y, yaw, v.x, v.y, w.z)
            if all(map(math.isfinite, row)):
                rows.append(row)
                times.append(time)
        if not rows:
            raise DatasetError(f"{self.path}: no message on {self.topics.odometry} has finite numbers; use another.")
        return frame, np.array(times, np.int64), np.array(rows, np.float64)

    def _goals(self, frame: str, assume_same_frame: bool) -> tuple[Ints, Floats]:
        times: list[int] = []
        goals: list[tuple[float, float]] = []
        for time, message in self._messages(self.topics.goal) if self.topics.goal else ():
            goal = self._decode(message)
            seen, point = str(goal.header.frame_id), (float(goal.pose.position.x), float(goal.pose.position.y))
            if seen and frame and seen.strip("/") != frame.strip("/") and not assume_same_frame:
                raise DatasetError(
                    f"{self.path}: goals on {self.topics.goal} are in frame {seen!r}, odometry on "
                    f"{self.topics.odometry} in {frame!r}; choose an odometry in the goals' frame, or --goal-topic "
                    "none, or --assume-same-frame if they coincide."
                )
            if all(map(math.isfinite, point)) and not (goals and math.dist(goals[-1], point) < SAME_GOAL):
                times.append(time)
                goals.append(point)
        return np.array(times, np.int64), np.array(goals, np.float64).reshape(-1, 2)

    def _lidar(self, scan: Any, mount: Sequence[float]) -> Lidar:
        if not 1 <= len(scan.ranges) <= MAX_RAYS:
            raise DatasetError(f"{self.path}: a scan has {len(scan.ranges):,} ranges; expected 1 to {MAX_RAYS:,}.")
        x, y, yaw = mount
        return Lidar(
            len(scan.ranges), float(scan.angle_min), float(scan.angle_increment), float(scan.range_min),
            float(scan.range_max), x, y, yaw,
        )  # fmt: skip

    def ranges(self, wanted: Ints, lidar: Lidar) -> Iterator[npt.NDArray[np.float32]]:
        """Yield the ranges [m] of the scans at the positions `wanted`, which never go down.

        Raises
        ------
        DatasetError
            If a scan's rays are not those of `lidar`.
        """
        messages = enumerate(self._messages(self.topics.scan))
        at, ranges = -1, np.empty(0, np.float32)
        for k in wanted.tolist():
            if k != at:
                found = next((item for item in messages if item[0] == k), None)
                if found is None:
                    raise CorruptDataError(f"{self.path} ends before scan {k}: it was changed while it was read.")
                at, (_, message) = found
                scan = self._decode(message)
                seen = self._lidar(scan, (lidar.x, lidar.y, lidar.yaw))
                if seen != lidar:
                    raise DatasetError(
                        f"{self.path}: scan {k} on {self.topics.scan} has other rays than the first ({seen}, {lidar}); "
                        "expected one scanner with one setting per bag."
                    )
                ranges = np.asarray(scan.ranges, np.float32)
            yield ranges
