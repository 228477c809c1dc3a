"""ROS bags, read through the ``rosbags`` library: which topics, where the robot was, when scans came.

Only topics that are used are decoded, by the definitions of ROS itself, which never changed for them: what others
hold, and how it is defined, does not matter.
"""

from __future__ import annotations

import contextlib
import heapq
import importlib
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from navrep_data.datasets._bag_clock import SECOND, Clock, choose_clock
from navrep_data.datasets._bag_frames import TF_TOPICS, TF_TYPES, Frames, mounting, yaw_of
from navrep_data.datasets._bag_repair import explained, open_readers
from navrep_data.datasets._bag_scans import ScannerBook
from navrep_data.datasets._bag_types import Reading, Topics, Tracks
from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetError,
    DatasetNotFoundError,
    MissingExtraError,
    did_you_mean,
)
from navrep_data.observations import Lidar

SCAN_TYPE, ODOMETRY_TYPE = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
GOAL_TYPE, TF_TYPE = "geometry_msgs/msg/PoseStamped", TF_TYPES[0]
NO_TOPIC = "none"
# What the original's recorded data were read from, where a bag has several.
USUAL_SCAN_TOPIC = "/combined_scan"
# Goals nearer to each other than this are one goal, published again [m].
SAME_GOAL = 1e-3
# Times that leave room for differences in int64 [ns]: the year 2116.
LATEST = 1 << 62
_LISTED = 12

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Note = Callable[[str], None]


class _Topic(NamedTuple):
    """A topic of a bag: its type, its messages, its connections by reader."""

    msgtype: str
    messages: int
    connections: dict[int, list[Any]]


class Bag:
    """An open bag: a ROS 1 file, or a ROS 2 bag (its folder, or one .mcap or .db3 file).

    Parameters
    ----------
    path : pathlib.Path
        The bag.
    scan, odometry, goal : str, optional
        Topics; chosen where only one fits. ``"none"`` as `goal` for none.
    note : callable
        Called with lines about what was left out or read in another way than usual.

    Attributes
    ----------
    topics : Topics
        Those that are used.
    """

    def __init__(self, path: Path, scan: str | None, odometry: str | None, goal: str | None, note: Note) -> None:
        self.path, self._note = path, note
        self._stack = contextlib.ExitStack()
        try:
            self._readers = self._open()
            with explained(path):
                self._there = self._list_topics()
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

    def _open(self) -> list[Any]:
        try:
            importlib.import_module("rosbags.highlevel")
            ros1, ros2 = importlib.import_module("rosbags.rosbag1"), importlib.import_module("rosbags.rosbag2")
            types = importlib.import_module("rosbags.typesys")
        except ImportError:
            raise MissingExtraError("rosbags is not installed; get it: pip install 'navrep-data[ros]'") from None
        if not self.path.exists():
            raise DatasetNotFoundError(f"There is no {self.path}; expected a ROS 1 .bag or the folder of a ROS 2 bag.")
        readers, is_ros1 = open_readers(self.path, ros1, ros2, self._stack, self._note)
        store = types.get_typestore(types.Stores.ROS1_NOETIC if is_ros1 else types.Stores.ROS2_HUMBLE)
        if TF_TYPE not in store.fielddefs:  # no part of ROS 1's common messages
            store.register(types.get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", TF_TYPE))
        self._deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        return readers

    # -- topics

    def _list_topics(self) -> dict[str, _Topic]:
        found: dict[str, _Topic] = {}
        for k, reader in enumerate(self._readers):
            for connection in reader.connections:
                if not connection.msgcount:
                    continue
                so_far = found.get(connection.topic, _Topic(connection.msgtype, 0, {}))
                kind = so_far.msgtype
                if kind != connection.msgtype:
                    kind = f"{kind} and {connection.msgtype}"
                so_far.connections.setdefault(k, []).append(connection)
                messages = so_far.messages + connection.msgcount
                found[connection.topic] = _Topic(kind, messages, so_far.connections)
        return found

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

    def _messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield time of recording [ns] and raw message of a topic, in the order of that time."""
        of_reader = self._there[topic].connections
        with explained(self.path):
            parts = [self._readers[k].messages(connections=of_reader[k]) for k in of_reader]
            for _, time, raw in parts[0] if len(parts) == 1 else heapq.merge(*parts, key=lambda message: message[1]):
                if not -LATEST < time < LATEST:
                    raise CorruptDataError(
                        f"{self.path}: a message on {topic} was recorded at {time} ns, expected nanoseconds since "
                        "1970: the bag is damaged or its clock was."
                    )
                yield time, raw

    def _decode(self, raw: bytes, kind: str) -> Any:
        with explained(self.path):
            return self._deserialize(raw, kind)

    def tracks(self, reading: Reading) -> Tracks:
        """Return where the robot was, where it should go, and when scans came.

        Raises
        ------
        ConfigError
            If the scans do not say how far the scanner sees, and nobody else does.
        DatasetError
            If goals are in a frame that nothing joins with the odometry's, or nothing usable is there.
        CorruptDataError
            If the bag is damaged.
        """
        book = ScannerBook(f"{self.path}: {self.topics.scan}", reading.mount, reading.reach, reading.invalid_is_free)
        scans: list[tuple[int, int]] = []
        scanner = ""
        for time, raw in self._messages(self.topics.scan):
            scan = self._decode(raw, SCAN_TYPE)
            scanner = scanner or str(scan.header.frame_id)
            book.add(scan)
            scans.append((time, _stamp(scan.header)))
        lidar, fits = book.finish(self._note)
        numbers = np.flatnonzero(fits)
        recorded, stamped = np.array(scans, np.int64)[numbers].T
        frame, base, odometry_times, states = self._odometry()
        clock = choose_clock((recorded, stamped), (odometry_times[:, 0], odometry_times[:, 1]))
        if not clock.stamps:
            self._note(
                f"{self.path}: headers' stamps are not used ({clock.why_not}); rows follow the time of recording"
            )
        scan_times, numbers = _in_order(clock.times(recorded, stamped), numbers)
        times, states = _in_order(clock.times(odometry_times[:, 0], odometry_times[:, 1]), states)
        self._check_mount(scanner, base, clock, reading)
        goal_times, goals = self._goals(frame, clock, reading.assume_same_frame)
        return Tracks(
            scan_times, numbers, lidar, book, clock, times, states[:, :3], states[:, 3:], goal_times, goals
        )  # fmt: skip

    def _odometry(self) -> tuple[str, str, Ints, Floats]:
        """Return the frame, the robot's own, times (N, 2) of recording and stamping [ns], and states (N, 6)."""
        frame = base = ""
        rows: list[tuple[float, ...]] = []
        times: list[tuple[int, int]] = []
        count = turned = 0
        for time, raw in self._messages(self.topics.odometry):
            odometry = self._decode(raw, ODOMETRY_TYPE)
            frame, base = frame or str(odometry.header.frame_id), base or str(odometry.child_frame_id)
            p, yaw = odometry.pose.pose.position, yaw_of(odometry.pose.pose.orientation)
            v, w = odometry.twist.twist.linear, odometry.twist.twist.angular
            row = (p.x, p.y, math.nan if yaw is None else yaw, v.x, v.y, w.z)
            count, turned = count + 1, turned + (yaw is None)
            if all(map(math.isfinite, row)):
                rows.append(row)
                times.append((time, _stamp(odometry.header)))
        lacks = f", {turned} of them without an orientation (a quaternion of zeros)" if turned else ""
        if not rows:
            raise DatasetError(
                f"{self.path}: no message on {self.topics.odometry} has finite numbers{lacks}; use another."
            )
        if len(rows) < count:
            self._note(
                f"{self.path}: left out {count - len(rows)} of {count} messages on {self.topics.odometry} with numbers "
                f"that are not finite{lacks}"
            )
        return frame, base, np.array(times, np.int64), np.array(rows, np.float64)

    def _goals(self, frame: str, clock: Clock, assume_same_frame: bool) -> tuple[Ints, Floats]:
        times: list[int] = []
        goals: list[tuple[float, float]] = []
        last: tuple[str, float, float] | None = None
        frames: Frames | None = None
        moved: set[str] = set()
        for recorded, raw in self._messages(self.topics.goal) if self.topics.goal else ():
            goal = self._decode(raw, GOAL_TYPE)
            seen, place = str(goal.header.frame_id), goal.pose.position
            point = (float(place.x), float(place.y))
            again = last is not None and last[0] == seen and math.dist(last[1:], point) < SAME_GOAL
            if not all(map(math.isfinite, point)) or again:
                continue
            last = (seen, *point)
            time = clock.time(recorded, _stamp(goal.header))
            if seen and frame and seen.strip("/") != frame.strip("/") and not assume_same_frame:
                frames = self._frames(clock) if frames is None else frames
                matrix = frames.transform(seen, frame, time)
                if matrix is None:
                    raise DatasetError(self._apart(seen, frame, frames))
                x, y = (matrix @ [*point, float(place.z), 1.0])[:2]
                point = (float(x), float(y))
                moved.add(seen)
                if not all(map(math.isfinite, point)):
                    continue
            times.append(time)
            goals.append(point)
        if moved:
            self._note(
                f"{self.path}: goals are in frame {', '.join(sorted(moved))}, odometry in {frame}: taken over by /tf "
                "as of when each goal came"
            )
        order, places = _in_order(np.array(times, np.int64), np.array(goals, np.float64).reshape(-1, 2))
        return order, places

    def _apart(self, seen: str, frame: str, frames: Frames) -> str:
        has = f"those in the bag do not join them ({len(frames)} frames)" if len(frames) else "the bag has none"
        return (
            f"{self.path}: goals on {self.topics.goal} are in frame {seen!r}, odometry on {self.topics.odometry} in "
            f"{frame!r}; choose an odometry in the goals' frame, or record /tf and /tf_static ({has}), or --goal-topic "
            "none, or --assume-same-frame if they coincide."
        )

    def _check_mount(self, scanner: str, base: str, clock: Clock, reading: Reading) -> None:
        """Say so if the bag knows the scanner to be in another place than it is taken to be."""
        matrix = self._frames(clock, ["/tf_static"]).transform(scanner, base, 0) if scanner and base else None
        seen = None if matrix is None else mounting(matrix, reading.mount)
        if seen:
            self._note(f"{self.path}: /tf_static has the scanner {scanner} on {base} at {seen} if that is right")

    def _frames(self, clock: Clock, topics: Iterable[str] = TF_TOPICS) -> Frames:
        """Return the frames of the bag's transforms."""
        frames = Frames()
        for topic in topics:
            static = TF_TOPICS[topic]
            if topic not in self._there or self._there[topic].msgtype not in TF_TYPES:
                continue
            for recorded, raw in self._messages(topic):
                for transform in self._decode(raw, TF_TYPE).transforms:
                    frames.add(transform, clock.time(recorded, _stamp(transform.header)), static)
        return frames

    def scans(self, wanted: Ints, book: ScannerBook) -> Iterator[tuple[Lidar, npt.NDArray[np.float32]]]:
        """Yield scanner and ranges [m] of the scans of these numbers, in the order given.

        Raises
        ------
        CorruptDataError
            If there is no such scan: the bag was changed while it was read.
        """
        left = Counter(wanted.tolist())
        messages = enumerate(self._messages(self.topics.scan))
        kept: dict[int, tuple[Lidar, npt.NDArray[np.float32]]] = {}
        for k in wanted.tolist():
            while k not in kept:
                number, (_, raw) = next(messages, (-1, (0, b"")))
                if number < 0:
                    raise CorruptDataError(f"{self.path} ends before scan {k}: it was changed while it was read.")
                if left[number]:  # stamps may say another order than that of recording
                    scan = self._decode(raw, SCAN_TYPE)
                    lidar = book.lidar(scan)
                    if lidar is None:
                        raise CorruptDataError(f"{self.path}: scan {number} was changed while it was read.")
                    kept[number] = lidar, np.asarray(scan.ranges, np.float32)
            yield kept[k]
            left[k] -= 1
            if not left[k]:
                del kept[k]


def _stamp(header: Any) -> int:
    """Return the stamp of a header [ns]."""
    return int(header.stamp.sec) * SECOND + int(header.stamp.nanosec)


def _in_order(times: Ints, values: npt.NDArray[Any]) -> tuple[Ints, npt.NDArray[Any]]:
    order = np.argsort(times, kind="stable")
    return times[order], values[order]
