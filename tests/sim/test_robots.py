"""Several robots in one world."""

import numpy as np
import pytest

from navrep_data.errors import ConfigError
from navrep_data.schema import Event
from navrep_data.sim import DrivenRollout, RolloutSettings, ScriptedPolicy, ScriptedRollout, Simulator, make_config
from navrep_data.sim import _layout as lay
from navrep_data.sim.lidar import scan_polygons

POSE = [lay.A_X, lay.A_Y, lay.A_HEADING]
GOAL = [lay.A_GX, lay.A_GY]


def three(**fields):
    """Three robots of radius 0.4 m on a line, 3 m apart, heading 0, goals far ahead."""
    sim = Simulator(make_config("empty", robots=3, rendering="trunk", **fields), seed=0)
    for r in range(3):
        robot = sim.arrays.agents[0, r]
        robot[POSE], robot[GOAL], robot[lay.A_RADIUS] = (3.0 * r, 0.0, 0.0), (3.0 * r + 50.0, 0.0), 0.4
    return sim


def test_shapes():
    sim = Simulator(make_config("soadrl", robots=4, humans=4), n_worlds=2, seed=0)
    rewards, events = sim.step(np.zeros((2, 4, 3)))
    scans, states = sim.observe()
    assert (rewards.shape, events.shape) == ((2, 4), (2,))
    assert (scans.shape, states.shape) == ((2, 4, 1080), (2, 4, 5))
    assert sim.humans().shape == (2, 4, 6 + 3, 6)
    assert sim.robot_events().shape == sim.damage().shape == (2, 4)
    assert sim.state().robots.shape == (4, 7)
    np.testing.assert_array_equal(sim.state().robot, sim.state().robots[0])
    with pytest.raises(ConfigError, match=r"shape \(2, 3\), expected \(2, 4, 3\)"):
        sim.step(np.zeros((2, 3)))


@pytest.mark.parametrize("settings", [{"physics": "original"}, {"robots": 3}, {"inertia": "limited"}])
def test_robot_states_are_those_of_observe(settings):
    env = "navrep-test" if "physics" in settings else "soadrl"
    sim = Simulator(make_config(env, humans=1, obstacles=1, **settings), n_worlds=3, seed=0)
    for _ in range(2):
        sim.step(np.broadcast_to([0.3, -0.2, 0.5], (3, *sim.robot_states().shape[1:-1], 3)))
    states = sim.robot_states()
    np.testing.assert_array_equal(states, sim.observe()[1])
    masked = sim.robot_states([True, False, True])
    np.testing.assert_array_equal(masked[[0, 2]], states[[0, 2]])
    assert not masked[1].any()


def test_places():
    sim = Simulator(make_config("soadrl", robots=10, humans=10), n_worlds=30, seed=0)
    for w in range(30):
        state = sim.state(w)
        everybody = np.concatenate([state.robots[:, [0, 1, 5]], state.humans[:, [0, 1, 7]]])
        apart = np.hypot(*(everybody[:, None, :2] - everybody[None, :, :2]).transpose(2, 0, 1))
        gap = apart - everybody[:, None, 2] - everybody[None, :, 2] + 10 * np.eye(len(everybody))
        assert gap.min() >= 0.2 - 1e-9
        goals = state.robots[:, 3:5]
        np.testing.assert_allclose(goals, -state.robots[:, :2], atol=1e-12)
        for points in (state.robots[:, :2], goals):
            assert (sim.clearance(points, w) >= state.robots[:, 5]).all()
        assert len(np.unique(state.robots[:, 2])) == 10
    first = sim.arrays.agents[:, 0]
    assert (first[:, lay.A_X] == 0.0).all()
    assert (first[:, lay.A_Y] < 0.0).all()


def test_the_first_robot_and_the_world_of_one_robot_are_as_ever():
    one, two = (Simulator(make_config("soadrl", humans=0, obstacles=0, robots=r), seed=4) for r in (1, 2))
    np.testing.assert_array_equal(one.state().robot, two.state().robot)


def test_every_robot_moves_by_its_own_command():
    sim = three()
    commands = np.array([[[0.5, 0.0, 0.1], [0.0, 0.5, -0.2], [-0.5, 0.25, 0.0]]])
    before = sim.state().robots
    rewards, _ = sim.step(commands)
    after = sim.state().robots
    np.testing.assert_allclose(after[:, :2] - before[:, :2], 0.2 * commands[0, :, :2], atol=1e-12)
    np.testing.assert_allclose(after[:, 2] % (2 * np.pi), 0.2 * commands[0, :, 2] % (2 * np.pi), atol=1e-12)
    distance = np.hypot(*(before[:, 3:5] - before[:, :2]).T) - np.hypot(*(after[:, 3:5] - after[:, :2]).T)
    np.testing.assert_allclose(rewards[0], distance)
    states = sim.observe()[1][0]
    np.testing.assert_allclose(states[:, 4], commands[0, :, 2], rtol=1e-6)
    np.testing.assert_allclose(states[1, 0], np.cos(-0.04) * 50 + np.sin(-0.04) * -0.1, rtol=1e-5)


@pytest.mark.slow
def test_robots_see_each_other_and_not_themselves():
    sim = three()
    sim.arrays.agents[0, 1, lay.A_HEADING] = np.pi / 2
    scans, _ = sim.observe()
    robots = sim.state().robots
    for r in range(3):
        others = np.delete(robots, r, axis=0)[:, [0, 1, 5]]
        np.testing.assert_allclose(scans[0, r], scan_polygons([], others, robots[r, :3]), atol=1e-6)
    assert scans[0, 0, 0] == pytest.approx(2.6)
    humans = sim.humans()[0]
    np.testing.assert_allclose(humans[0, :, :2], [[3.0, 0.0], [6.0, 0.0]], atol=1e-3)
    np.testing.assert_allclose(humans[1, :, :2], [[0.0, 3.0], [0.0, -3.0]], atol=1e-3)
    np.testing.assert_allclose(humans[2, :, :2], [[-6.0, 0.0], [-3.0, 0.0]], atol=1e-3)
    np.testing.assert_array_equal(humans[:, :, 5], [[1, 0], [1, 1], [0, 1]])  # the middle one hides the last
    np.testing.assert_array_equal(humans[:, :, 4], np.float32(0.4))


def test_robots_have_legs_that_walk():
    sim = three()
    sim.arrays.flags[lay.F_LEGS] = 1
    for _ in range(3):
        sim.step([[[0.5, 0.0, 0.0]] * 3])
    assert sim.arrays.agents[0, :3, lay.A_GAIT_X] == pytest.approx(0.3)
    scan = sim.observe()[0][0, 0]
    # 3 m ahead, legs of 3 cm at 0.2 m to the sides, one stride apart
    forward = 0.3 * np.cos(2 * 0.3 / 0.3)
    left = np.arctan2(0.2, 3.0 + forward)
    ray = round(left / sim.config.sensor.angle_increment)
    assert scan[ray] == pytest.approx(np.hypot(0.2, 3.0 + forward) - 0.03, abs=2e-3)
    assert scan[0] == 25.0


@pytest.mark.parametrize(
    ("moved", "joint", "each"),
    [
        ({0: (50.0 - 0.1, 0.0)}, Event.GOAL, [1, 0, 0]),
        ({2: (3.5, 0.0)}, Event.COLLISION_HUMAN, [0, 2, 2]),
        ({0: (49.9, 0.0), 2: (3.5, 0.0)}, Event.COLLISION_HUMAN, [1, 2, 2]),
        ({}, Event.NONE, [0, 0, 0]),
    ],
)
def test_the_episode_is_joint(moved, joint, each):
    sim = three()
    for r, place in moved.items():
        sim.arrays.agents[0, r, [lay.A_X, lay.A_Y]] = place
    rewards, events = sim.step(np.zeros((1, 3, 3)))
    assert events[0] == joint
    np.testing.assert_array_equal(sim.robot_events()[0], each)
    expected = {0: 0.0, 1: 100.0, 2: -26.0}
    np.testing.assert_allclose(rewards[0], [expected[e] for e in each], atol=1e-9)


def test_time_is_up_for_all_at_once():
    sim = three(time_limit=1.0)
    for k in range(5):
        _, events = sim.step(np.zeros((1, 3, 3)))
        assert events[0] == (Event.TIMEOUT if k == 4 else Event.NONE)
    assert (sim.robot_events() == Event.TIMEOUT).all()


def test_robots_that_would_meet_are_both_put_back():
    sim = three(on_collision="damage", max_damage=1.0)
    sim.arrays.agents[0, 1, lay.A_X] = 1.0
    for damage in (0.6, 1.2):
        _, events = sim.step([[[0.6, 0.0, 0.0], [-0.6, 0.0, 0.0], [0.6, 0.0, 0.0]]])
        np.testing.assert_array_equal(sim.state().robots[:2, 0], [0.0, 1.0])
        np.testing.assert_allclose(sim.damage()[0], [damage, damage, 0.0])
    assert events[0] == Event.COLLISION_HUMAN
    assert sim.state().robots[2, 0] == pytest.approx(6.0 + 0.24)


def test_humans_that_see_robots_avoid_all_of_them():
    """A human between two robots on its way: one that sees them never comes near, one that does not walks through."""
    closest = {}
    for sees in (0.0, 1.0):
        sim = Simulator(make_config("empty", robots=2, humans=1), seed=0)
        a = sim.arrays
        a.scalars[0, lay.S_HUMANS] = 1
        a.agents[0, 0, POSE], a.agents[0, 1, POSE] = (0.0, 5.0, 0.0), (0.1, 0.0, 0.0)
        a.agents[0, :2, lay.A_RADIUS] = 0.4
        human = a.agents[0, 2]
        human[:] = 0.0
        human[[lay.A_X, *GOAL, lay.A_RADIUS, lay.A_VPREF, lay.A_SEES]] = -4.0, 4.0, 0.0, 0.3, 1.0, sees
        gaps = []
        for _ in range(30):
            sim.step(np.zeros((1, 2, 3)))
            gaps.append(np.hypot(*(human[:2] - a.agents[0, 1, :2])) - 0.7)
        closest[sees] = min(gaps)
    assert closest[0.0] < -0.5
    assert closest[1.0] > -0.01


def test_scripted_policies_drive_all_robots_and_rows_are_the_firsts():
    config = make_config("soadrl", robots=3, humans=4, obstacles=2)
    settings = RolloutSettings(length=120)
    columns, worlds = ScriptedRollout(config, settings, ScriptedPolicy(), 0).run([5])[0]
    assert columns["scan"].shape == (120, 1080)
    assert columns["humans"].shape == (120, 6 + 2, 6)
    going = ~columns["is_last"][:-1]
    pose, action = columns["robot_pose"].astype(float), columns["action"].astype(float)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    step = 0.2 * np.column_stack([c * action[:, 0] - s * action[:, 1], s * action[:, 0] + c * action[:, 1]])
    np.testing.assert_allclose((pose[:-1, :2] + step[:-1])[going], pose[1:, :2][going], atol=2e-6)
    sizes = np.diff(worlds["human_offset"])
    present = np.isfinite(columns["humans"][:, :, 0]).sum(axis=1)
    np.testing.assert_array_equal(present[columns["is_first"]], sizes)
    # the last two of each episode are robots: on the move towards the place opposite their start
    end = worlds["human_offset"][1:]
    for k in (1, 2):
        np.testing.assert_allclose(worlds["human_goal"][end - k], -worlds["human_start"][end - k, :2], atol=1e-6)
    first = columns["humans"][0]
    assert np.hypot(*first[sizes[0] - 1, 2:4]) == 0.0, "at rest at the start"
    assert np.hypot(*columns["humans"][1, sizes[0] - 1, 2:4]) > 0.1, "and driven afterwards"


def test_policies_that_are_asked_at_every_row_drive_one_robot():
    with pytest.raises(ConfigError, match="robots=2 with a policy that drives one robot"):
        DrivenRollout(make_config("soadrl", robots=2), RolloutSettings(), None, 0)
