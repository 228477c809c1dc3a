"""Bags that the tests write themselves, ROS 1 and ROS 2: the rows they become, and what is refused."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from navrep_data.datasets import SequenceDataset, import_rosbag
from navrep_data.datasets.rosbag import parse_mount
from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetError,
    DatasetNotFoundError,
    FolderInUseError,
    MissingExtraError,
)
from navrep_data.schema import Event
from navrep_data.shards import DatasetFolder, verify

rosbags = pytest.importorskip("rosbags")

from bag_files import KINDS, RAYS, SECOND, START, Recorder, drive, record  # noqa: E402


def rows_of(root):
    """Columns of the whole dataset, put end to end."""
    with DatasetFolder(root) as folder:
        shards = range(len(folder.manifest.shards))
        found = {
            c: np.concatenate([folder.read(c, k, 0, folder.manifest.shards[k].rows) for k in shards])
            for c in folder.manifest.columns
        }
    order = np.argsort(found["sequence"], kind="stable")
    return {name: values[order] for name, values in found.items()}


@pytest.mark.slow
def test_poses_far_from_the_origin_are_stored_near_it_and_said_to_be(tmp_path, monkeypatch):
    """Odometry in UTM coordinates: the steps between poses keep their millimetres in float32."""
    plain = rows_of_import(tmp_path, "plain")
    odometry = Recorder.odometry

    def far(self, seconds, x, y, *args, **kwargs):
        odometry(self, seconds, x + 456000.0, y + 5428000.0, *args, **kwargs)

    monkeypatch.setattr(Recorder, "odometry", far)
    said = []
    moved = rows_of_import(tmp_path, "far", note=said.append)
    assert any("stored less (456000, 5428001) m, which the manifest holds under origins" in line for line in said)
    np.testing.assert_allclose(moved["robot_pose"] + [0, 1, 0], plain["robot_pose"], atol=1e-6)
    with DatasetFolder(tmp_path / "far") as folder:
        assert folder.manifest.origins == {"recording": (456000.0, 5428001.0)}
    with DatasetFolder(tmp_path / "plain") as folder:
        assert folder.manifest.origins == {}


def rows_of_import(tmp_path, name, **settings):
    """Rows of a bag of two seconds without goals."""
    import_rosbag(
        record(tmp_path / f"{name}-bag", KINDS[0], seconds=2.0, goals=()), tmp_path / name, dt=0.2, **settings
    )
    return rows_of(tmp_path / name)


def test_the_card_gives_numbers_exactly(tmp_path):
    bag = record(tmp_path / "bag", KINDS[0], seconds=3.0, goals=())
    given = {"--dt": 1 / 3, "--range-max": 25 + 1e-7, "--goal-radius": 2 / 3}
    mount = (0.1, 1 / 3, -1e-7)
    manifest = import_rosbag(
        bag, tmp_path / "d", dt=given["--dt"], range_max=given["--range-max"], goal_radius=given["--goal-radius"],
        mount=mount,
    )  # fmt: skip
    words = manifest.command.split()
    assert {flag: float(words[words.index(flag) + 1]) for flag in given} == given
    assert parse_mount(words[words.index("--mount") + 1]) == mount


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_bag(tmp_path, kind):
    """Goal at x = 2, known from 0.35 s, reached (nearer than 0.5 m) after x = 1.5 (3.0 s): in the row at 3.2 s."""
    path = record(tmp_path / "bag", kind)
    seen = []
    manifest = import_rosbag(path, tmp_path / "d", dt=0.2, progress=lambda *a: seen.append(a))
    assert verify(tmp_path / "d").problems == []
    assert seen == [(1, 1)]
    assert (manifest.rows, manifest.sequences, manifest.physics) == (41, 1, "recorded")
    c = rows_of(tmp_path / "d")
    t = 0.2 * np.arange(41)
    pose = np.array([drive(s) for s in t])
    np.testing.assert_allclose(c["robot_pose"], pose, atol=1e-6)
    # the odometry's twist led to a row; the action of a row is what led to the next
    omega = 0.01 * (t / 0.05)
    np.testing.assert_allclose(c["leading_action"], np.stack([0 * t, -0.5 + 0 * t, omega], 1), atol=1e-6)
    goes_on = np.flatnonzero(~c["is_last"])
    np.testing.assert_array_equal(c["action"][goes_on], c["leading_action"].astype(np.float32)[goes_on + 1])
    assert not c["action"][c["is_last"]].any()
    # the goal is to the right of a robot that looks along y: robot frame (0, -(2 - x))
    known = (t > 0.35) & (t < 3.3)
    assert np.isnan(c["robot_state"][~known, :2]).all()
    expected = np.stack([0 * t, -(2.0 - 0.5 * t)], 1)
    np.testing.assert_allclose(c["robot_state"][known, :2], expected[known], atol=1e-6)
    np.testing.assert_allclose(c["robot_state"][:, 2:], c["leading_action"], atol=1e-6)
    arrived = int(np.flatnonzero(known)[-1])
    ends = np.flatnonzero(c["is_last"]).tolist()
    assert ends == [1, arrived, 40]
    assert [Event(e).label for e in c["event"][ends]] == ["cut", "goal", "cut"]
    assert c["leading_reward"][arrived] == 100
    assert (np.delete(c["leading_reward"], arrived) == -0.01).all()
    assert len(SequenceDataset(tmp_path / "d", "1d", window=8))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS[:2])
def test_scans_are_seen_from_the_robot(tmp_path, kind):
    """360 rays from straight behind become 1080 from straight ahead; invalid is 0, nothing is range_max."""
    ranges = np.full(RAYS, 4.0)
    ranges[270] = 2.0  # 90 degrees to the left
    ranges[90:100] = np.inf
    ranges[10:20] = np.nan
    with Recorder(tmp_path / "bag", kind) as bag:
        for k in range(11):
            bag.scan(0.2 * k, ranges)
            bag.odometry(0.2 * k, 0.0, 0.0, 0.0)
    manifest = import_rosbag(bag.path, tmp_path / "d", range_max=25.0)
    scan = rows_of(tmp_path / "d")["scan"]
    assert scan.shape == (11, 1080)
    assert scan.dtype == np.float32
    angles = np.rad2deg(manifest.sensor.angle_min + manifest.sensor.angle_increment * np.arange(1080))
    assert scan[5][np.abs(angles - 90).argmin()] == pytest.approx(2.0, abs=0.01)
    assert scan[5][np.abs(angles - 45).argmin()] == pytest.approx(4.0, abs=0.01)
    assert scan[5][np.abs(angles - (95 - 180 + 360)).argmin()] == 25.0
    assert scan[5][np.abs(angles - (15 - 180 + 360)).argmin()] == 0.0
    # mounted 1 m ahead of the centre, turned: what was 90 degrees to its left is now straight behind it
    import_rosbag(bag.path, tmp_path / "e", mount=(1.0, 0.0, math.pi / 2))
    moved = rows_of(tmp_path / "e")["scan"][5]
    assert moved[np.abs(angles - 180).argmin()] == pytest.approx(1.0, abs=0.02)
    assert moved[np.abs(angles - 90).argmin()] == pytest.approx(math.sqrt(15.0), abs=0.02)


def test_rows_take_the_nearest_scan(tmp_path):
    path = record(tmp_path / "bag", "ros1", scan_period=0.15, seconds=6.0)
    import_rosbag(path, tmp_path / "d", dt=0.2)
    scan = rows_of(tmp_path / "d")["scan"]
    # straight ahead is ray 180 of the 360: 1 + 1.8 + 0.001 * number of the scan
    numbers = np.rint((scan[:, 0] - 2.8) / 0.001)
    t = 0.2 * np.arange(len(scan))
    assert (np.abs(numbers * 0.15 - t) <= 0.075 + 1e-9).all()


@pytest.mark.slow
def test_sequences_are_cut_by_length_and_by_pauses(tmp_path):
    path = record(tmp_path / "bag", "ros2", seconds=20.0, pause=(6.05, 9.95, "scan"), goals=())
    manifest = import_rosbag(path, tmp_path / "d", length=np.int64(20))
    c = rows_of(tmp_path / "d")
    assert verify(tmp_path / "d").ok
    _, sizes = np.unique(c["sequence"], return_counts=True)
    assert sizes.tolist() == [20, 11, 20, 20, 11]
    assert manifest.length == 20
    # time goes on by dt within a sequence, and nowhere else
    jumps = np.diff(c["robot_pose"][:, 0])
    torn = np.flatnonzero(np.diff(c["sequence"]))
    assert np.allclose(np.delete(jumps, torn[1]), 0.1, atol=1e-5)
    assert jumps[torn[1]] == pytest.approx(0.5 * 4.0, abs=0.06)
    assert (c["event"][np.append(torn, len(c["step"]) - 1)] == Event.CUT).all()
    assert np.isnan(c["robot_state"][:, :2]).all()


def test_a_pause_of_the_odometry_ends_a_sequence(tmp_path):
    path = record(tmp_path / "bag", "ros1", seconds=10.0, pause=(3.02, 6.98, "odometry"), goals=())
    import_rosbag(path, tmp_path / "d")
    c = rows_of(tmp_path / "d")
    assert np.unique(c["sequence"]).tolist() == [0, 1]
    x = c["robot_pose"][:, 0]
    assert not ((x > 1.56) & (x < 3.44)).any()


def test_every_episode_has_one_goal(tmp_path):
    """A second goal before the first is reached; the second published again, before and after it is reached."""
    goals = ((0.1, 50.0, 1.0), (2.1, 3.0, 1.0), (2.5, 3.0, 1.0), (7.1, 3.0, 1.0))
    path = record(tmp_path / "bag", "ros1", goals=goals, seconds=9.0)
    import_rosbag(path, tmp_path / "d")
    c = rows_of(tmp_path / "d")
    ends = np.flatnonzero(c["is_last"]).tolist()
    # 3.0 is nearer than 0.5 m from x > 2.5, t > 5.0
    assert [Event(e).label for e in c["event"][ends]] == ["cut", "cut", "goal", "cut"]
    assert ends[:2] == [0, 10]
    goal_x = c["robot_pose"][:, 0] - c["robot_state"][:, 1]
    for first, last in zip([1, *np.array(ends[1:-1]) + 1], ends[1:], strict=True):
        spread = goal_x[first : last + 1]
        assert np.isnan(spread).all() or np.ptp(spread) < 1e-5
    assert np.isnan(c["robot_state"][ends[2] + 1 :, 0]).all()


@pytest.mark.slow
def test_176_rows_are_no_timeout(tmp_path):
    """The original's limit is not the recorded robot's: row 176 is cut off by a new goal, not by a clock."""
    path = record(tmp_path / "bag", "ros1", seconds=40.0, goals=((0.0, 90.0, 1.0), (35.1, 95.0, 1.0)))
    import_rosbag(path, tmp_path / "d")
    c = rows_of(tmp_path / "d")
    assert c["step"][c["is_last"]].tolist()[0] == 175
    assert (c["event"][c["is_last"]] == Event.CUT).all()


@pytest.mark.slow
def test_several_bags(tmp_path):
    paths = [record(tmp_path / "a", "ros1"), record(tmp_path / "b", "ros1", seconds=4.0)]
    manifest = import_rosbag(paths, tmp_path / "d", env="lab", rings=False)
    assert (manifest.env, manifest.sequences, manifest.rows) == ("lab", 2, 41 + 21)
    assert [s["file"] for s in manifest.config["source"]] == ["a.bag", "b.bag"]
    assert manifest.config["source"][0]["goal"] == "/move_base_simple/goal"
    assert "rings" not in manifest.columns
    assert str(tmp_path) not in (tmp_path / "d" / "manifest.json").read_text()


def record_odd(path, edit, kind="ros1"):
    with Recorder(path, kind) as bag:
        for k in range(11):
            bag.scan(0.1 * k, np.full(RAYS, 3.0))
            bag.odometry(0.1 * k, 0.1 * k, 0.0, 0.0)
        edit(bag)
    return bag.path


def second_scan(bag):
    bag.scan(1.1, np.full(RAYS, 3.0), topic="/rear")


def second_odometry(bag):
    bag.odometry(1.1, 1.0, 0.0, 0.0, topic="/wheel_odom")


def other_rays(bag):
    bag.scan(1.2, np.ones(180))
    bag.odometry(1.2, 1.0, 0.0, 0.0)


def second_goal(bag):
    bag.goal(0.5, 5.0, 0.0)
    bag.goal(0.5, 5.0, 0.0, topic="/other_goal")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edit", "settings", "error", "words"),
    [
        (
            second_scan,
            {},
            ConfigError,
            r"2 topics of sensor_msgs/msg/LaserScan: choose with --scan-topic: \['/rear', '/sc",
        ),
        (second_odometry, {}, ConfigError, r"choose with --odometry-topic: \['/odom', '/wheel_odom'\]"),
        (second_goal, {}, ConfigError, "choose with --goal-topic"),
        (second_scan, {"scan_topic": "/rera"}, ConfigError, "no topic '/rera'; it has .*Did you mean '/rear'"),
        (second_scan, {"scan_topic": "/odom"}, ConfigError, "Topic /odom holds nav_msgs/msg/Odometry, expected sensor"),
        (lambda b: b.goal(0.5, 5, 0, "map"), {}, DatasetError, "in frame 'map', odometry on /odom in 'odom'; choose"),
        (other_rays, {}, DatasetError, "has other rays than the first"),
        (
            lambda b: None,
            {"dt": 0.05},
            DatasetError,
            "come every 0.1 s, expected at least every 0.05 s; give a larger dt",
        ),
        (lambda b: None, {"dt": -1.0}, ConfigError, "expected positive numbers"),
        (lambda b: None, {"length": 1}, ConfigError, "length is 1, expected a whole number from 2 to"),
        (lambda b: None, {"mount": (1.0,)}, ConfigError, "mount has 1 numbers"),
    ],
)
def test_what_is_refused(tmp_path, edit, settings, error, words):
    path = record_odd(tmp_path / "bag", edit)
    with pytest.raises(error, match=words) as caught:
        import_rosbag(path, tmp_path / "d", **settings)
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["bag.bag"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edit", "settings"),
    [
        (second_scan, {"scan_topic": "/scan"}),
        (lambda b: b.scan(1.1, np.full(RAYS, 3.0), topic="/combined_scan"), {"scan_topic": "/scan"}),
        (second_goal, {"goal_topic": "/other_goal"}),
        (second_goal, {"goal_topic": "none"}),
        (lambda b: b.goal(0.5, 5, 0, "map"), {"assume_same_frame": True}),
        (lambda b: b.goal(0.5, 5, 0, "/odom"), {}),
    ],
)
def test_what_to_do_about_it_works(tmp_path, edit, settings):
    path = record_odd(tmp_path / "bag", edit)
    assert import_rosbag(path, tmp_path / "d", dt=0.1, **settings).rows >= 10
    goals = ~np.isnan(rows_of(tmp_path / "d")["robot_state"][:, 0])
    assert goals.any() == (
        edit is not second_scan and "scan_topic" not in settings and settings.get("goal_topic") != "none"
    )


def test_poses_that_are_no_goals_are_not_taken_for_one(tmp_path):
    path = record_odd(tmp_path / "bag", lambda b: b.goal(0.5, 5.0, 0.0, topic="/tracked_pose"))
    import_rosbag(path, tmp_path / "d")
    assert np.isnan(rows_of(tmp_path / "d")["robot_state"][:, 0]).all()


def test_a_bag_without_scans(tmp_path):
    with Recorder(tmp_path / "bag", "ros2") as bag:
        bag.odometry(0.0, 0.0, 0.0, 0.0)
    with pytest.raises(
        DatasetError, match=r"holds no sensor_msgs/msg/LaserScan; .*It has /odom \(nav_msgs/msg/Odometry\)"
    ):
        import_rosbag(bag.path, tmp_path / "d")


def test_scans_and_odometry_of_different_times(tmp_path):
    with Recorder(tmp_path / "bag", "ros1") as bag:
        for k in range(5):
            bag.odometry(0.1 * k, 0.0, 0.0, 0.0)
        for k in range(5):
            bag.scan(100 + 0.1 * k, np.ones(RAYS))
    with pytest.raises(DatasetError, match=r"Nothing is left of .*never recorded at the same time"):
        import_rosbag(bag.path, tmp_path / "d")


def test_clocks_that_jump_cost_no_memory(tmp_path):
    """A scan from 1970 among those of today: years in between, and no rows."""
    with Recorder(tmp_path / "bag", "ros1") as bag:
        bag.scan(-START / SECOND + 1, np.ones(RAYS))
        for k in range(11):
            bag.scan(0.2 * k, np.ones(RAYS))
            bag.odometry(0.2 * k, 0.0, 0.0, 0.0)
    assert import_rosbag(bag.path, tmp_path / "d").rows == 11


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bags_are_refused(tmp_path, kind):
    path = record(tmp_path / "bag", kind, seconds=1.0)
    files = [path] if path.is_file() else [p for p in path.iterdir() if p.suffix in (".db3", ".mcap")]
    data = files[0].read_bytes()
    for size in (0, 10, len(data) // 3):
        files[0].write_bytes(data[:size])
        with pytest.raises(CorruptDataError, match="cannot be read as a ROS bag") as caught:
            import_rosbag(path, tmp_path / "d")
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "d").exists()


def test_paths_that_are_no_bags(tmp_path):
    with pytest.raises(DatasetNotFoundError, match=r"There is no .*gone\.bag; expected a ROS 1 .bag or the folder"):
        import_rosbag(tmp_path / "gone.bag", tmp_path / "d")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(CorruptDataError, match="cannot be read as a ROS bag"):
        import_rosbag(tmp_path / "notes.txt", tmp_path / "d")
    (tmp_path / "folder").mkdir()
    with pytest.raises(CorruptDataError, match="cannot be read as a ROS bag"):
        import_rosbag(tmp_path / "folder", tmp_path / "d")
    with pytest.raises(ConfigError, match="No bag was given"):
        import_rosbag([], tmp_path / "d")


def test_nothing_is_overwritten(tmp_path):
    path = record_odd(tmp_path / "bag", lambda b: None)
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "thesis.tex").write_text("mine")
    with pytest.raises(FolderInUseError, match="an import never overwrites"):
        import_rosbag(path, tmp_path / "d")
    assert [p.name for p in (tmp_path / "d").iterdir()] == ["thesis.tex"]


def test_rosbags_is_optional(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'navrep-data\[ros\]'"):
        import_rosbag(tmp_path / "bag", tmp_path / "d")


def test_mounts():
    assert parse_mount("0.25,0,-1.5") == (0.25, 0.0, -1.5)
    for text in ("1,2", "a,b,c", "1,2,3,4", ""):
        with pytest.raises(ConfigError, match="expected x,y,yaw"):
            parse_mount(text)
