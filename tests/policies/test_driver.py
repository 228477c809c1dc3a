"""What policies are given, and what becomes of what they return, whatever simulator they drive in."""

import numpy as np
import pytest

from navrep_data.errors import PolicyError
from navrep_data.policies import BasePolicy, Driver, FunctionPolicy, RandomPolicy, observe
from navrep_data.policies.protocol import NEEDS
from navrep_data.schema import RobotContract
from navrep_data.sim import Simulator, make_config


class Fixed(BasePolicy):
    """Returns the same action for every robot, and keeps what it is given."""

    name, sees = "fixed", "everything"

    def __init__(self, action, needs=(), steers=True):
        self.action, self.needs, self.steers = action, frozenset(needs), steers
        self.seen, self.told, self.contexts = [], [], []

    def start(self, context):
        self.contexts.append(context)

    def act(self, observation):
        self.seen.append(observation)
        return np.tile(self.action, (len(observation.robot_state), 1))

    def observe(self, executed):
        self.told.append(executed)


def turned(vectors, theta):
    """Return world vectors (2,) in the robot's frame, by a rotation matrix."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, s], [-s, c]]) @ vectors


@pytest.mark.parametrize("where", ["polygons", "map"])
def test_observations_are_what_the_simulator_knows_seen_from_the_robot(where, hall):
    config = (
        make_config("map", **hall | {"humans": 2}) if where == "map" else make_config("soadrl", humans=4, obstacles=3)
    )
    simulator = Simulator(config, 3, seed=5)
    found = observe(simulator, NEEDS)
    scans, states = simulator.observe()
    np.testing.assert_array_equal(found.scan, scans)
    np.testing.assert_array_equal(found.robot_state, states)
    np.testing.assert_array_equal(found.map_index[:, 0], [0] * 3 if where == "map" else [-1] * 3)
    ways, orca = simulator.waypoints(), simulator.orca_velocities()
    for w in range(3):
        x, y, theta, _, _, radius, _ = simulator.state(w).robot
        np.testing.assert_array_equal(found.pose[w], [x, y, theta])
        assert found.radius[w] == radius
        np.testing.assert_allclose(found.waypoint[w], turned(ways[w] - [x, y], theta), atol=1e-12)
        np.testing.assert_allclose(found.orca_velocity[w], turned(orca[w], theta), atol=1e-12)
        people = simulator.state(w).humans
        for human, seen in zip(people, found.humans[w], strict=False):
            np.testing.assert_allclose(seen[:2], turned(human[:2] - [x, y], theta), atol=1e-12)
            np.testing.assert_allclose(seen[2:], turned(human[2:4], theta), atol=1e-12)
        assert np.isnan(found.humans[w, len(people) :]).all()
    if where == "polygons":
        np.testing.assert_allclose(found.waypoint, states[:, :2], atol=1e-5)


def test_what_nobody_asked_for_is_empty():
    found = observe(Simulator(make_config("empty"), 2), frozenset())
    assert found.robot_state.shape == (2, 5)
    empty = {name: getattr(found, name).shape for name in NEEDS - {"humans"}}
    assert set(empty.values()) == {(2, 0)}
    assert found.humans.shape == (2, 0, 4)


def test_a_policy_is_told_where_it_drives(hall):
    policy = Fixed([0.0, 0.0, 0.0])
    simulator = Simulator(make_config("map", **hall), 1)
    Driver(policy).start(simulator)
    (context,) = policy.contexts
    assert context.robot == RobotContract(0.55, 0.3)
    assert context.sensor == simulator.config.sensor
    assert context.maps == (simulator.grid(),)


def test_actions_are_shares_of_the_robots_largest_velocities_and_it_hears_what_was_sent():
    policy = Fixed([0.5, -7.0, 1.0])
    simulator = Simulator(make_config("navrep-train", max_velocity=(0.6, 0.4, 2.0)), 3)
    driver = Driver(policy)
    driver.start(simulator)
    sent = driver.commands(simulator, mask=np.array([True, False, True]))
    np.testing.assert_allclose(sent, [[0.3, -0.4, 2.0], [0.0, 0.0, 0.0], [0.3, -0.4, 2.0]])
    np.testing.assert_array_equal(policy.told, [sent])


@pytest.mark.parametrize(("steers", "sent"), [(True, [0.0, 0.0, 1.0]), (False, [0.0, 0.0, 0.25])])
def test_who_wants_a_velocity_turns_a_differential_drive_towards_it(steers, sent):
    simulator = Simulator(make_config("navrep-train", drive="differential"), 1)
    driver = Driver(Fixed([0.0, 1.0, 0.25], steers=steers))
    driver.start(simulator)
    commands = driver.commands(simulator)
    assert commands[0, 2] == pytest.approx(sent[2])
    if steers:
        np.testing.assert_allclose(commands[0], sent, atol=1e-12)


def test_several_robots_are_rows():
    simulator = Simulator(make_config("soadrl", robots=2, humans=3), 2)
    policy = Fixed([1.0, 0.0, 0.0], needs=("scan", "pose", "radius"))
    driver = Driver(policy)
    driver.start(simulator)
    driver.reset(np.ones(4, bool), np.zeros(4, int))
    assert driver.commands(simulator).shape == (2, 2, 3)
    (seen,) = policy.seen
    scans, states = simulator.observe()
    np.testing.assert_array_equal(seen.scan, scans.reshape(4, -1))
    np.testing.assert_array_equal(seen.robot_state, states.reshape(4, 5))
    np.testing.assert_array_equal(seen.pose, simulator.poses().reshape(4, 3))
    driver = Driver(Fixed([1.0, 0.0, 0.0], needs=("waypoint",)))
    with pytest.raises(PolicyError, match="needs waypoint, which worlds with one robot offer, but here are 2"):
        driver.start(simulator)


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        (Fixed([1.0, 0.0]), r"'fixed' returned shape \(2, 2\), expected \(2, 3\)"),
        (Fixed([np.nan, 0.0, 0.0]), "'fixed' returned NaN or infinity"),
        (FunctionPolicy("f", lambda s, r: np.zeros((5, 3)), 2), r"'f' returned shape \(5, 3\), expected \(2, 3\) or"),
        (FunctionPolicy("f", lambda s, r: np.full((2, 2), np.inf), 2), "'f' returned NaN or infinity"),
    ],
)
def test_what_are_no_actions_is_refused(policy, words):
    simulator = Simulator(make_config("empty"), 2)
    driver = Driver(policy)
    driver.start(simulator)
    with pytest.raises(PolicyError, match=words):
        driver.commands(simulator)


def test_unknown_needs_are_refused():
    with pytest.raises(PolicyError, match="needs 'speed', expected: humans, map_index, orca_velocity, pose"):
        Driver(Fixed([0, 0, 0], needs=("speed",)))


def test_noise_belongs_to_the_episode_whatever_its_row():
    def drawn(rows, seeds):
        simulator = Simulator(make_config("empty"), rows)
        policy = RandomPolicy()
        driver = Driver(policy)
        driver.start(simulator)
        driver.reset(np.ones(rows, bool), np.array(seeds))
        return np.array([driver.commands(simulator) for _ in range(3)])

    many, alone = drawn(3, [7, 8, 9]), drawn(1, [9])
    np.testing.assert_array_equal(many[:, 2], alone[:, 0])
    assert (many[:, 0, :2] != many[:, 1, :2]).all()
