"""Bags that tests write themselves, ROS 1 and ROS 2."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

KINDS = ("ros1", "ros2", "mcap")
RAYS = 360
SECOND = 1_000_000_000
START = 1_600_000_000 * SECOND
SCAN, ODOMETRY, GOAL = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
TF = "tf2_msgs/msg/TFMessage"


class Recorder:
    """Writes a bag, one message after the other; `late` says how long after its stamp each is recorded [s]."""

    def __init__(self, path: Path, kind: str, late=None) -> None:
        self.late = late
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        self.path = path.with_suffix(".bag") if self.ros1 else path
        if self.ros1:
            self.writer = rosbag1.Writer(self.path)
        else:
            plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
            self.writer = rosbag2.Writer(self.path, version=9, storage_plugin=plugin)
        self.connections = {}
        self.sequence = 0

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *_):
        self.writer.close()

    def header(self, frame, seconds=None):
        types = self.store.types
        stamped = 0 if self.late is None or seconds is None else START + round(seconds * SECOND)
        stamp = types["builtin_interfaces/msg/Time"](sec=stamped // SECOND, nanosec=stamped % SECOND)
        extra = {"seq": 0} if self.ros1 else {}
        return types["std_msgs/msg/Header"](**extra, stamp=stamp, frame_id=frame)

    def write(self, topic, kind, seconds, message):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        time = START + round((seconds + (self.late(topic, seconds) if self.late else 0.0)) * SECOND)
        self.writer.write(self.connections[topic], time, serialize(message, kind))

    def scan(self, seconds, ranges, topic="/scan", **changes):
        settings = {
            "angle_min": -math.pi, "angle_max": math.pi, "angle_increment": 2 * math.pi / max(len(ranges), 1),
            "time_increment": 0.0, "scan_time": 0.1, "range_min": 0.05, "range_max": 30.0, **changes,
        }  # fmt: skip
        kind = self.store.types[SCAN]
        values = np.asarray(ranges, np.float32)
        self.write(
            topic, SCAN, seconds, kind(self.header("laser", seconds), **settings, ranges=values, intensities=values[:0])
        )

    def pose(self, x, y, theta=0.0, length=1.0):
        t = self.store.types
        return t["geometry_msgs/msg/Pose"](
            t["geometry_msgs/msg/Point"](x, y, 0.0),
            t["geometry_msgs/msg/Quaternion"](0.0, 0.0, length * math.sin(theta / 2), length * math.cos(theta / 2)),
        )

    def odometry(self, seconds, x, y, theta, v=(0.0, 0.0, 0.0), frame="odom", topic="/odom", length=1.0):
        t = self.store.types
        vector, cov = t["geometry_msgs/msg/Vector3"], np.zeros(36)
        twist = t["geometry_msgs/msg/Twist"](vector(v[0], v[1], 0.0), vector(0.0, 0.0, v[2]))
        message = t[ODOMETRY](
            self.header(frame, seconds), "base_link",
            t["geometry_msgs/msg/PoseWithCovariance"](self.pose(x, y, theta, length), cov),
            t["geometry_msgs/msg/TwistWithCovariance"](twist, cov),
        )  # fmt: skip
        self.write(topic, ODOMETRY, seconds, message)

    def goal(self, seconds, x, y, frame="odom", topic="/move_base_simple/goal"):
        self.write(topic, GOAL, seconds, self.store.types[GOAL](self.header(frame, seconds), self.pose(x, y)))

    def transform(self, seconds, parent, child, x, y, theta, topic="/tf"):
        t = self.store.types
        pose = self.pose(x, y, theta)
        moved = t["geometry_msgs/msg/Transform"](t["geometry_msgs/msg/Vector3"](x, y, 0.0), pose.orientation)
        message = t["geometry_msgs/msg/TransformStamped"](self.header(parent, seconds), child, moved)
        self.write(topic, TF, seconds, self.store.types[TF]([message]))


def drive(t):
    """Where the robot is at time t [s]: along x at 0.5 m/s, turned left by 90 degrees, as if driving sideways."""
    return 0.5 * t, 1.0, math.pi / 2


def record(path, kind, seconds=8.0, goals=((0.35, 2.0, 1.0),), pause=None, scan_period=0.1, odometry_period=0.05):
    """A robot that drives past; ray k of scan j has range 1 + 0.01 k + 0.001 j."""
    events = [(k * scan_period, "scan", k) for k in range(round(seconds / scan_period) + 1)]
    events += [(k * odometry_period, "odometry", k) for k in range(round(seconds / odometry_period) + 1)]
    events += [(t, "goal", (x, y)) for t, x, y in goals]
    with Recorder(path, kind) as bag:
        for t, what, value in sorted(events, key=lambda e: (e[0], e[1])):
            if pause and pause[0] < t < pause[1] and what == pause[2]:
                continue
            if what == "scan":
                bag.scan(t, 1 + 0.01 * np.arange(RAYS) + 0.001 * value)
            elif what == "odometry":
                bag.odometry(t, *drive(t), v=(0.0, -0.5, 0.01 * value))
            else:
                bag.goal(t, *value)
    return bag.path


def record_by_tf(path, kind):
    """A robot with stamps in its headers, whose goal is in another frame: every part of a bag is read."""
    with Recorder(path, kind, late=lambda *_: 0.0) as bag:
        bag.transform(0.0, "map", "world", 1.0, 0.0, 0.5, topic="/tf_static")
        for k in range(9):
            bag.transform(0.1 * k, "world", "odom", 0.1 * k, 0.0, 0.0)
            bag.scan(0.1 * k, 1 + 0.01 * np.arange(RAYS))
            bag.odometry(0.1 * k, *drive(0.1 * k))
            if k == 2:
                bag.goal(0.2, 2.0, 1.0, frame="map")
    return bag.path
