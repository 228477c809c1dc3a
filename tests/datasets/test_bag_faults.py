"""Bags as robots really record them: what is read of them, what is said about it, how cut ones are mended."""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest

from navrep_data.datasets import import_rosbag
from navrep_data.doctor import check_dataset
from navrep_data.errors import LONGEST_MESSAGE, ConfigError, CorruptDataError, DatasetError, FileAccessError
from navrep_data.shards import DatasetFolder

pytest.importorskip("rosbags")

from bag_files import KINDS, RAYS, Recorder, record


def rows_of(root, *names):
    with DatasetFolder(root) as folder:
        return [
            np.concatenate([s.read(n, 0, s.rows) for s in map(folder.shard, range(len(folder.manifest.shards)))])
            for n in names
        ]


def drive_along(bag, n=25, scan=lambda k: np.full(RAYS, 3.0), **odometry):
    """Write scans every 0.1 s and odometry every 0.05 s of a robot that goes along x at 0.5 m/s."""
    for k in range(2 * n):
        if k % 2 == 0:
            values = scan(k // 2)
            settings, values = values if isinstance(values, tuple) else ({}, values)
            bag.scan(0.05 * k, values, **settings)
        bag.odometry(
            0.05 * k, 0.025 * k, 0.0, odometry.get("theta", 0.0), v=(0.5, 0.0, 0.0), length=odometry.get("length", 1.0)
        )


def read(bag, out, **settings):
    """Import, and return the manifest and what was said."""
    said = []
    manifest = import_rosbag(
        bag.path if isinstance(bag, Recorder) else bag, out, note=said.append, rings=False, **settings
    )
    return manifest, said


# --- scans


@pytest.mark.slow
@pytest.mark.parametrize(
    "scan",
    [
        lambda k: np.full((455, 454, 456, 449, 463)[k % 5], 3.0),
        lambda k: ({"angle_increment": 2 * math.pi / RAYS * (1 + 1e-7 * (k % 3))}, np.full(RAYS, 3.0)),
        lambda k: ({"angle_min": -3.14 + 1e-4 * (k % 5)}, np.full(RAYS, 3.0)),
        # a nominal increment, and some more rays than fit into a turn
        lambda k: ({"angle_increment": 2 * math.pi / 455}, np.full(455 + 4 * (k % 3), 3.0)),
    ],
    ids=["rays", "increment", "angle_min", "more than a turn"],
)
def test_scans_whose_rays_vary(tmp_path, scan):
    with Recorder(tmp_path / "bag", "ros1") as bag:
        drive_along(bag, scan=scan)
    manifest, said = read(bag, tmp_path / "d")
    assert manifest.rows == 13
    assert not [line for line in said if "left out" in line]
    (scans,) = rows_of(tmp_path / "d", "scan")
    assert np.abs(scans - 3.0).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("first", [[], np.full(170, 3.0), np.full(2, np.nan)])
def test_first_scans_that_are_short_or_empty(tmp_path, first):
    with Recorder(tmp_path / "bag", "ros2") as bag:
        drive_along(bag, scan=lambda k: first if k < 2 else np.full(RAYS, 3.0))
    manifest, said = read(bag, tmp_path / "d")
    assert manifest.rows == 12
    assert [line for line in said if "left out 2 of 25 scans" in line]


def test_two_scanners_on_one_topic_are_refused(tmp_path):
    with Recorder(tmp_path / "bag", "ros1") as bag:
        drive_along(bag, scan=lambda k: np.full(RAYS if k % 2 else 180, 3.0))
    with pytest.raises(
        DatasetError, match=r"1[23] of 25 scans are unlike the others: scan \d has other rays than the first"
    ):
        read(bag, tmp_path / "d")


@pytest.mark.slow
@pytest.mark.parametrize("far", [0.0, math.nan])
def test_scans_that_do_not_say_how_far_they_reach(tmp_path, far):
    ranges = np.full(RAYS, 3.0)
    ranges[100:110], ranges[180] = 12.0, 7.0
    with Recorder(tmp_path / "bag", "ros2") as bag:
        drive_along(bag, scan=lambda k: ({"range_max": far, "range_min": math.nan}, ranges))
    with pytest.raises(ConfigError, match=r"range_max of the scans is (0|nan), .*--range-max"):
        read(bag, tmp_path / "d")
    manifest, _ = read(bag, tmp_path / "d", range_max=10.0)
    (scans,) = rows_of(tmp_path / "d", "scan")
    assert manifest.sensor.range_max == scans.max() == 10.0
    assert scans[0, 0] == 7.0


@pytest.mark.slow
def test_blind_sectors_are_said_once_and_declared(tmp_path):
    """The scanner's body hides 90 degrees, the driver says NaN there; some rays say nothing now and then."""

    def scan(k):
        ranges = np.full(RAYS, 3.0)
        ranges[:90], ranges[200 + k] = np.nan, np.nan
        return ranges

    with Recorder(tmp_path / "bag", "ros2") as bag:
        drive_along(bag, n=60, scan=scan)
    said = []
    manifest = import_rosbag(bag.path, tmp_path / "d", note=said.append)
    (line,) = [line for line in said if "blind in every scan" in line]
    assert "rays are blind in every scan (" in line
    ((first, last),) = manifest.config["blind_rays"]
    scans, rings = rows_of(tmp_path / "d", "scan", "rings")
    assert (scans[:, first : last + 1] == 0.0).all()
    assert last - first + 1 == pytest.approx(270, abs=4)
    assert (rings[:, math.ceil(first / 16.9) + 1 : last // 17 - 1] == 1).all(), "unknown"
    assert check_dataset(tmp_path / "d").ok
    manifest = import_rosbag(bag.path, tmp_path / "e", note=said.append, invalid_is_free=True)
    assert manifest.config["blind_rays"] == []
    assert (rows_of(tmp_path / "e", "scan")[0][:, first + 2 : last - 2] == 25.0).all()


# --- odometry


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.9, 2.0, 16384.0, 1e-9, 1e200])
def test_quaternions_of_any_length(tmp_path, length):
    with Recorder(tmp_path / "bag", "ros1") as bag:
        drive_along(bag, theta=1.2, length=length)
    read(bag, tmp_path / "d")
    np.testing.assert_allclose(rows_of(tmp_path / "d", "robot_pose")[0][:, 2], 1.2, atol=1e-6)


@pytest.mark.slow
def test_quaternions_of_zeros_are_no_orientation(tmp_path):
    with Recorder(tmp_path / "bag", "ros2") as bag:
        drive_along(bag, length=0.0)
    with pytest.raises(DatasetError, match="50 of them without an orientation"):
        read(bag, tmp_path / "d")
    with Recorder(tmp_path / "some", "ros2") as bag:
        bag.odometry(-0.05, 0.0, 0.0, 1.0, length=0.0)
        drive_along(bag)
    manifest, said = read(bag, tmp_path / "d")
    assert manifest.rows == 13
    assert [line for line in said if "left out 1 of 51 messages on /odom" in line]


# --- clocks


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_recordings_in_bursts_go_by_the_headers_stamps(tmp_path, kind):
    """Messages arrive a second's worth at a time; when they were measured stands in their headers."""
    with Recorder(tmp_path / "bag", kind, late=lambda topic, t: math.floor(t) + 1.0 - t) as bag:
        drive_along(bag, n=40)
        bag.goal(0.3, 9.0, 0.0)
    manifest, said = read(bag, tmp_path / "d")
    assert manifest.rows == 20
    assert manifest.config["source"][0]["clock"] == "stamps"
    assert said == []
    pose, state = rows_of(tmp_path / "d", "robot_pose", "robot_state")
    np.testing.assert_allclose(pose[:, 0], 0.1 * np.arange(20), atol=1e-6)
    assert np.isnan(state[:2, 0]).all()
    assert not np.isnan(state[2:, 0]).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stamps", "why"),
    [
        (None, "those of scans are 0"),
        (lambda topic, t: 100.0 if topic == "/odom" else 0.0, "two clocks, 100 s apart"),
        (lambda topic, t: -20.0 * t, "repeat or go back"),
    ],
)
def test_stamps_that_are_none(tmp_path, stamps, why):
    """The time of recording is the clock then, and one line says so."""
    with Recorder(tmp_path / "bag", "ros2") as bag:
        if stamps is not None:
            plain, topics = bag.header, {"laser": "/scan", "odom": "/odom"}
            bag.late = lambda topic, t: 0.0
            bag.header = lambda frame, t=None: plain(frame, t + stamps(topics[frame], t))
        drive_along(bag)
    manifest, said = read(bag, tmp_path / "d")
    assert manifest.rows == 13
    assert manifest.config["source"][0]["clock"] == "recording"
    (line,) = said
    assert re.search(why, line)
    assert "rows follow the time of recording" in line


# --- frames


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_goals_in_another_frame_by_tf(tmp_path, kind):
    """map -> world is fixed, world -> odom drifts: the goal is where that was when it came, between two transforms."""
    with Recorder(tmp_path / "bag", kind, late=lambda topic, t: 0.0) as bag:
        bag.transform(0.0, "map", "world", 10.0, 0.0, math.pi / 2, topic="/tf_static")
        bag.transform(0.0, "/world", "odom", 1.0, 0.0, 0.0)
        bag.transform(0.0, "odom", "base_link", 0.0, 0.0, 0.0)
        drive_along(bag)
        bag.goal(1.0, 10.0, 5.0, frame="map")
        bag.transform(2.0, "world", "odom", 3.0, 0.0, 0.0)
    _, said = read(bag, tmp_path / "d")
    assert [line for line in said if "goals are in frame map, odometry in odom: taken over by /tf" in line]
    pose, state = rows_of(tmp_path / "d", "robot_pose", "robot_state")
    # (10, 5) in map is (5, 0) in world, which at 1 s is (3, 0) in odom
    known = ~np.isnan(state[:, 0])
    assert known.sum() == 8
    np.testing.assert_allclose(pose[known, 0] + state[known, 0], 3.0, atol=1e-5)
    np.testing.assert_allclose(state[known, 1], 0.0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("transforms", "has"), [(False, "the bag has none"), (True, r"do not join them \(2 frames\)")])
def test_goals_in_a_frame_that_nothing_joins(tmp_path, transforms, has):
    with Recorder(tmp_path / "bag", "ros2") as bag:
        drive_along(bag)
        bag.goal(1.0, 1.0, 5.0, frame="map")
        if transforms:  # a loop, too
            bag.transform(0.0, "odom", "base_link", 0.0, 0.0, 0.0)
            bag.transform(0.0, "base_link", "odom", 0.0, 0.0, 0.0)
    with pytest.raises(DatasetError, match=rf"in frame 'map', .*record /tf and /tf_static .*{has}") as caught:
        read(bag, tmp_path / "d")
    assert "\n" not in str(caught.value)
    assert read(bag, tmp_path / "d", assume_same_frame=True)[0].rows == 13


@pytest.mark.slow
@pytest.mark.parametrize("mount", [None, (0.25, 0.1, 1.5)])
def test_mountings_that_the_bag_knows_better(tmp_path, mount):
    with Recorder(tmp_path / "bag", "ros1") as bag:
        bag.transform(0.0, "base_link", "plate", 0.25, 0.0, 0.0, topic="/tf_static")
        bag.transform(0.0, "plate", "laser", 0.0, 0.1, 1.5, topic="/tf_static")
        drive_along(bag)
    _, said = read(bag, tmp_path / "d", **({"mount": mount} if mount else {}))
    found = [line for line in said if "/tf_static has the scanner laser on base_link at 0.25,0.1,1.5, and" in line]
    assert len(found) == (mount is None)
    assert all("taken to be at 0,0,0: give --mount 0.25,0.1,1.5 if" in line for line in found)


# --- topics that nobody reads


@pytest.mark.slow
@pytest.mark.parametrize("text", ["other_msgs/Thing thing\n", "uint8[] data\nencoder_msgs/Measure", "\x00%$"])
@pytest.mark.parametrize("kind", KINDS[:2])
def test_definitions_of_topics_that_are_not_used_do_not_matter(tmp_path, kind, text):
    path = tmp_path / ("bag.bag" if kind == "ros1" else "bag")
    with Recorder(tmp_path / "bag", kind) as bag:
        settings = {"md5sum": "0" * 32} if kind == "ros1" else {"rihs01": "RIHS01_" + "0" * 64}
        vendor = bag.writer.add_connection("/vendor", "vendor_msgs/msg/Packet", msgdef=text, **settings)
        bag.writer.write(vendor, 1_600_000_000 * 10**9, b"\0\0\0\0")
        drive_along(bag)
    assert read(path, tmp_path / "d")[0].rows == 13


# --- what was cut off


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS[1:])
def test_folders_without_metadata(tmp_path, kind):
    path = record(tmp_path / "bag", kind, seconds=2.0)
    expected = read(path, tmp_path / "whole")[0].shards[0].sequence_hashes
    text = (path / "metadata.yaml").read_text()
    for broken in (None, text[: len(text) // 2], "", text.replace("bag.", "gone.")):
        (path / "metadata.yaml").unlink(missing_ok=True)
        if broken is not None:
            (path / "metadata.yaml").write_text(broken)
        shutil.rmtree(tmp_path / "d", ignore_errors=True)
        manifest, said = read(path, tmp_path / "d")
        assert manifest.shards[0].sequence_hashes == expected
        assert [line for line in said if "directly" in line and "ros2 bag reindex" in line]


@pytest.mark.parametrize("code", [errno.EACCES, errno.EIO])
def test_metadata_that_cannot_be_read_is_refused_at_once(tmp_path, monkeypatch, code):
    """It says nothing about what is in it, and the import would end at its hash."""
    path = record(tmp_path / "bag", "ros2", seconds=2.0)
    read_text = Path.read_text

    def refuse(self, *arguments, **named):
        if self.name == "metadata.yaml":
            raise OSError(code, os.strerror(code), str(self))
        return read_text(self, *arguments, **named)

    monkeypatch.setattr(Path, "read_text", refuse)
    said = []
    with pytest.raises(FileAccessError, match=rf"refuses .*metadata\.yaml: {os.strerror(code)}\. Expected|The disk"):
        import_rosbag(path, tmp_path / "d", note=said.append)
    assert said == []


def test_notes_are_one_line_of_bounded_length(tmp_path):
    path = record(tmp_path / "bag", "ros2", seconds=2.0)
    (path / "metadata.yaml").write_text('a: "\x1b[31m' + 5000 * "x" + "\nb: [")
    said = read(path, tmp_path / "d")[1]
    (line,) = [line for line in said if "does not fit" in line]
    assert line.isprintable()
    assert len(line) <= LONGEST_MESSAGE
    assert "ros2 bag reindex" in line


@pytest.mark.slow
def test_split_recordings_without_metadata(tmp_path):
    """Two files of one recording are read as one."""
    for k in (0, 1):
        with Recorder(tmp_path / f"part{k}", "mcap") as bag:
            for j in range(20 * k, 20 * k + 20):
                bag.scan(0.1 * j, np.full(RAYS, 3.0))
                bag.odometry(0.1 * j, 0.05 * j, 0.0, 0.0)
    (tmp_path / "bag").mkdir()
    for k in (0, 1):
        shutil.move(tmp_path / f"part{k}" / f"part{k}.mcap", tmp_path / "bag" / f"bag_{k}.mcap")
    assert read(tmp_path / "bag", tmp_path / "d")[0].rows == 20


@pytest.mark.parametrize(
    ("kind", "words"), [("ros1", "rosbag reindex"), ("mcap", "mcap recover"), ("ros2", r"sqlite3 .*\.recover")]
)
def test_cut_recordings_name_what_mends_them(tmp_path, kind, words):
    path = record(tmp_path / "bag", kind, seconds=1.0)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: 2 * len(data) // 3])
    for given in {path, file}:
        with pytest.raises(CorruptDataError, match=rf"cannot be read as a ROS bag .*{words}") as caught:
            read(given, tmp_path / "d")
        assert "\n" not in str(caught.value)
        assert "again" not in str(caught.value)


def test_ros1_bags_that_were_never_indexed(tmp_path):
    path = record(tmp_path / "bag", "ros1", seconds=1.0)
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = struct.pack("<Q", 0)
    active = tmp_path / "lab.bag.active"
    active.write_bytes(data)
    with pytest.raises(CorruptDataError, match=r"not indexed.*rosbag reindex .*lab\.bag\.active"):
        read(active, tmp_path / "d")
    active.write_bytes(path.read_bytes())
    assert read(active, tmp_path / "d")[0].rows == 6


def test_databases_that_were_not_closed(tmp_path):
    """The last messages lie in a file beside the database: nobody reads the rest without a word."""
    path = record(tmp_path / "bag", "ros2", seconds=2.0)
    (file,) = path.glob("*.db3")
    other = sqlite3.connect(file)
    other.execute("PRAGMA journal_mode=WAL")
    other.execute("DELETE FROM messages WHERE id > 50")
    other.commit()
    shutil.copytree(path, tmp_path / "killed")
    other.close()
    (killed,) = (tmp_path / "killed").glob("*.db3")
    assert killed.with_name(killed.name + "-wal").stat().st_size
    for given in (tmp_path / "killed", killed):
        with pytest.raises(CorruptDataError, match=r"was not closed: .*-wal beside it .*sqlite3 .*wal_checkpoint"):
            read(given, tmp_path / "d")


def test_folders_of_ros1_bags(tmp_path):
    (tmp_path / "lab").mkdir()
    record(tmp_path / "lab" / "a", "ros1", seconds=1.0)
    with pytest.raises(CorruptDataError, match=r"it is a folder\); give the files in it: a\.bag"):
        read(tmp_path / "lab", tmp_path / "d")


def test_compressed_files_without_metadata(tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "bag_0.db3.zstd").write_bytes(b"x")
    with pytest.raises(CorruptDataError, match=r"unzstd bag_0\.db3\.zstd"):
        read(tmp_path / "bag", tmp_path / "d")
