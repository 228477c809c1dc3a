"""A policy keeps its contract: ranges are cut as in training, another robot is seen in the proportions of its own."""

import json
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from navrep_data import zoo
from navrep_data.errors import CheckpointError, ConfigError
from navrep_data.generate import generate
from navrep_data.models import (
    Controller,
    ControllerConfig,
    EndToEnd,
    EndToEndConfig,
    TransformerConfig,
    TransformerWorldModel,
)
from navrep_data.observations import RobotScale
from navrep_data.schema import RobotContract, SensorContract
from navrep_data.shards import DatasetFolder
from navrep_data.sim import make_config, robot_contract, scale_actions
from navrep_data.zoo.policy import Policy


def end_to_end(lidar="1d", **options):
    torch.manual_seed(0)
    return Policy(EndToEnd(EndToEndConfig(lidar)), None, lidar, name=f"e2e_{lidar}.test", **options)


def remembering(**options):
    torch.manual_seed(0)
    model = TransformerWorldModel(TransformerConfig("1d", 16, n_blocks=1))
    controller = Controller(ControllerConfig(16 + 5 + model.h_size))
    return Policy(controller, "zh", "1d", None, model, **options)


def scene(n=3, far=25.0):
    rng = np.random.default_rng(1)
    scan = rng.uniform(0.5, far, (n, 1080)).astype(np.float32)
    state = rng.normal(size=(n, 5)).astype(np.float32)
    return scan, state


def test_ranges_beyond_the_contract_are_cut_before_any_network_sees_them():
    scan, state = scene(far=109.0)
    policy = end_to_end()
    np.testing.assert_array_equal(policy.act(scan, state), policy.act(scan.clip(max=25.0), state))
    np.testing.assert_array_equal(policy.encode(scan, state)[:, :1080], scan.clip(max=25.0))
    np.testing.assert_array_equal(policy.look(scan, state)[0][:, :1080], scan.clip(max=25.0))
    uncut = end_to_end(ranges="as_released")
    np.testing.assert_array_equal(uncut.encode(scan, state)[:, :1080], scan)
    policy.check_sensor(SensorContract(range_max=110.0))
    with pytest.raises(ConfigError, match=r"range_max = 25\.0, got 10\.0"):
        policy.check_sensor(SensorContract(range_max=10.0))
    with pytest.raises(ConfigError, match="ranges is 'long', expected one of: contract, as_released"):
        end_to_end(ranges="long")


def test_a_policy_for_the_robot_of_its_training_is_the_same_policy():
    scan, state = scene()
    policy = end_to_end()
    same = policy.for_robot()
    assert (same.robot, same.trained_on) == (policy.robot, policy.trained_on) == (RobotContract(), RobotContract())
    np.testing.assert_array_equal(same.act(scan, state), policy.act(scan, state))


def test_a_slower_robot_is_seen_in_proportion_and_its_body_keeps_its_size():
    scan, state = scene()
    scan[0, :4] = 0.1, 0.2, 1.3, 25.0
    slow = end_to_end().for_robot(max_speed=0.5, radius=0.2)
    seen = slow.encode(scan, state)
    # the edge of the robot is the edge of the robot; 1.1 m from it are 2.2 m from it; free rays stay so
    np.testing.assert_allclose(seen[0, :4], [0.15, 0.3, 2.5, 25.0], rtol=1e-6)
    assert seen[:, :1080].max() <= 25.0
    np.testing.assert_allclose(seen[:, 1080:1084], 2.0 * state[:, :4], rtol=1e-6)
    np.testing.assert_array_equal(seen[:, 1084], state[:, 4])  # time is not scaled
    by_hand = end_to_end().act(np.ascontiguousarray(seen[:, :1080]), np.ascontiguousarray(seen[:, 1080:]))
    np.testing.assert_array_equal(slow.act(scan, state), by_hand)


def test_free_rays_of_a_faster_robot_stay_free():
    scale = RobotScale(RobotContract(), RobotContract(2.0, 0.3))
    np.testing.assert_allclose(scale.ranges(np.array([25.0, 24.3, 0.3, 0.0])), [25.0, 12.3, 0.3, 0.0], rtol=1e-6)


def test_a_memory_hears_what_was_executed_in_the_units_of_its_training():
    scans, states = zip(*(scene() for _ in range(3)), strict=True)
    slow, trained = remembering().for_robot(max_speed=0.5, radius=0.3), remembering()
    scale = RobotScale(RobotContract(), slow.robot)
    factors = np.array([2, 2, 2, 2, 1], np.float32)
    for policy in (slow, trained):
        policy.reset(batch_size=3)
    for scan, state in zip(scans, states, strict=True):
        a = slow.encode(scan, state)
        b = trained.encode(scale.ranges(scan), state * factors)
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
        executed = np.full((3, 3), 0.25, np.float32)
        slow.observe(executed)
        trained.observe(executed * [2, 2, 1])
    other = remembering()
    other.reset(batch_size=3)
    for scan, state in zip(scans, states, strict=True):
        c = other.encode(scale.ranges(scan), state * factors)
    assert np.abs(b - c).max() > 1e-5  # it matters what is told


def test_the_robot_of_training_is_written_and_read(tmp_path):
    policy = end_to_end(robot=RobotContract(0.55, 0.3))
    zoo.save_policy(policy, tmp_path / "p")
    again = zoo.load(tmp_path / "p")
    assert again.trained_on == again.robot == RobotContract(0.55, 0.3)
    path = tmp_path / "p" / "policy.json"
    old = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in old.items() if key != "robot"}))
    assert zoo.load(tmp_path / "p").trained_on == RobotContract()  # folders from before it was written
    for wrong in ({"max_speed": -1.0, "radius": 0.3}, {"speed": 1.0}, 7):
        path.write_text(json.dumps({**old, "robot": wrong}))
        with pytest.raises(CheckpointError, match="robot is no robot's speed and radius"):
            zoo.load(tmp_path / "p")


def test_a_second_robot_keeps_what_the_first_one_set():
    policy = end_to_end().for_robot(max_speed=0.5).for_robot(radius=0.2)
    assert (policy.robot, policy.trained_on) == (RobotContract(0.5, 0.2), RobotContract())
    assert policy.for_robot().robot == policy.robot


def test_numbers_of_numpy_are_numbers():
    robot = RobotContract(np.float32(0.5), np.int64(1))
    assert robot == RobotContract(0.5, 1.0)
    assert {type(value) for value in robot.to_dict().values()} == {float}
    assert json.loads(json.dumps(robot.to_dict())) == {"max_speed": 0.5, "radius": 1.0}
    for wrong in (np.float32(np.nan), np.bool_(True), True, "0.5", np.array([0.5])):
        with pytest.raises(ConfigError, match=r"max_speed is .*, expected more than 0"):
            RobotContract(wrong)


def test_what_cannot_be_scaled_is_refused():
    with pytest.raises(ConfigError, match="max_speed is 0, expected more than 0"):
        end_to_end().for_robot(max_speed=0)
    with pytest.raises(ConfigError, match="ranges as the authors fed them, which are not scaled"):
        end_to_end(ranges="as_released").for_robot(max_speed=0.5)


def test_robots_of_environments():
    assert robot_contract(make_config("navrep-train")) == RobotContract()
    assert robot_contract(make_config("ian")) == RobotContract(0.55, 0.3)


@pytest.mark.parametrize("name", ["e2e_1d.v1", "e2e_1d.20201026"])
def test_records_say_what_robot_a_policy_was_trained_on(name):
    assert RobotContract(**zoo.show(name).robot) == RobotContract()


@pytest.mark.slow
@pytest.mark.parametrize("text", ["./mine", "drive_by_name:policy"])
def test_data_of_a_network_is_of_the_environments_robot(text, tmp_path, monkeypatch):
    """From its folder, or as an object in a module, it drives that robot at its speed and hears what was sent."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "drive_by_name", raising=False)
    policy = remembering()
    torch.nn.init.normal_(policy.network.mean.weight, std=3.0)
    zoo.save_policy(policy, tmp_path / "mine")
    (tmp_path / "drive_by_name.py").write_text("from navrep_data import zoo\npolicy = zoo.load('./mine')\n")
    folder = tmp_path / "hall"
    folder.mkdir()
    Image.new("L", (100, 100), 254).save(folder / "m.png")
    (folder / "m.yaml").write_text(
        "image: m.png\nresolution: 0.2\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    settings = {"humans": 0, "length": 8, "scan_dtype": "float32", "policy": text, "policy_batch": 1}
    generate("map", n=1, out=tmp_path / "d", workers=1, maps=[str(folder)], **settings)
    with DatasetFolder(tmp_path / "d") as made:
        scan, state, action = (made.read(name, 0, 0, 8) for name in ("scan", "robot_state", "action"))
    slow, config = policy.for_robot(0.55, 0.3), make_config("map", maps=(str(folder),), humans=0)
    slow.reset(batch_size=1)
    for k in range(7):
        share = slow.act(scan[k : k + 1], state[k : k + 1])[0]
        assert np.abs(share).max() > 0.5
        np.testing.assert_allclose(action[k], scale_actions(config, share), rtol=1e-4, atol=1e-5)
        slow.observe(action[k : k + 1])
