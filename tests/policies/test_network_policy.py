"""Policies that know of robots drive the environment's: seen in proportion, in its units, told what was executed."""

import gymnasium
import numpy as np

from navrep_data.envs import record
from navrep_data.policies import Driver, NetworkPolicy
from navrep_data.policies.networks import knows_robots
from navrep_data.schema import RobotContract
from navrep_data.sim import DrivenMapRollout, DrivenRollout, RolloutSettings, Simulator, make_config


class Knowing:
    """A policy as those of the zoo are: shares of a top speed, more than there is of them."""

    def __init__(self, robot=None, ranges="contract"):
        self.robot, self.ranges = robot or RobotContract(), ranges
        self.told, self.used, self.rows = [], [], None

    def for_robot(self, max_speed, radius):
        self.used.append(Knowing(RobotContract(max_speed, radius)))
        return self.used[-1]

    def reset(self, batch_size=None, mask=None):
        self.rows = batch_size or self.rows

    def act(self, scan, robot_state):
        assert scan.shape == (self.rows, 1080)
        return np.tile(np.float32([0.5, -2.0, 0.0]), (len(scan), 1))

    def observe(self, executed):
        assert executed.shape == (self.rows, 3)
        self.told.append(executed[0])


LENGTH = np.hypot(0.5, 1.0)  # on maps translations are no longer than 1
SENT = [0.55 * 0.5 / LENGTH, -0.55 / LENGTH, 0.0]


def test_films_tell_a_policy_the_robot_and_what_it_was_sent(hall, tmp_path):
    policy = Knowing()
    assert knows_robots(policy)
    assert not knows_robots(lambda scan, state: None)
    record(gymnasium.make("navrep_data:Map-v0", **hall), policy, tmp_path / "e.gif", seed=1, max_steps=3, size=32)
    (used,) = policy.used
    assert used.robot == RobotContract(0.55, 0.3)
    np.testing.assert_allclose(used.told, [SENT] * 3, rtol=1e-6)
    assert not policy.told


def test_data_of_such_a_policy_is_in_metres_per_second(hall):
    policy = Knowing()
    rollout = DrivenMapRollout(
        make_config("map", **hall), RolloutSettings(length=4), Driver(NetworkPolicy(policy, 2)), seed=1, batch=2
    )
    columns = rollout.run([0, 1])[1][0]
    np.testing.assert_allclose(columns["action"][:3], [SENT] * 3, rtol=1e-6)
    (used,) = policy.used
    np.testing.assert_allclose(used.told, [SENT] * 3, rtol=1e-6)
    same = Knowing()
    config = make_config("navrep-train")
    columns = DrivenRollout(config, RolloutSettings(length=3), Driver(NetworkPolicy(same, 1)), seed=1, batch=1).run(
        [0]
    )[0][0]
    np.testing.assert_allclose(columns["action"][:2], [[0.5, -1.0, 0.0]] * 2, rtol=1e-6)
    assert not same.used
    np.testing.assert_allclose(same.told, [[0.5, -1.0, 0.0]] * 2)


def test_a_robot_that_cannot_slide_turns_and_ranges_as_released_are_neither_scaled_nor_told(hall):
    policy = Knowing(ranges="as_released")
    driver = Driver(NetworkPolicy(policy, 2))
    simulator = Simulator(make_config("map", drive="differential", **hall), 2)
    driver.start(simulator)
    driver.reset(np.ones(2, bool), np.arange(2))
    commands = driver.commands(simulator)
    np.testing.assert_allclose(commands, [[SENT[0], 0.0, -1.0]] * 2, rtol=1e-6)
    assert not policy.used
    assert not policy.told
