"""Humans, robots and collisions as config fields, by hand."""

import numpy as np
import pytest

from navrep_data.schema import Event
from navrep_data.sim import RolloutSettings, ScriptedPolicy, ScriptedRollout, Simulator, make_config
from navrep_data.sim import _layout as lay

STILL = [[0.0, 0.0, 0.0]]


def alone(n=1, **fields):
    """A robot alone: at the origin, heading 0, goal 50 m ahead, radius 0.4 m."""
    sim = Simulator(make_config("empty", **fields), n, seed=0)
    sim.arrays.agents[:, 0, [lay.A_X, lay.A_Y, lay.A_HEADING, lay.A_GX, lay.A_GY, lay.A_RADIUS]] = 0, 0, 0, 50, 0, 0.4
    return sim


def put_human(sim, x, y, gx, gy, v_pref=1.0, world=0):
    a = sim.arrays
    n = int(a.scalars[world, lay.S_HUMANS])
    row = sim.config.robots + n
    a.scalars[world, lay.S_HUMANS] = n + 1
    a.agents[world, row] = 0.0
    a.agents[world, row, [lay.A_X, lay.A_Y, lay.A_GX, lay.A_GY, lay.A_RADIUS, lay.A_VPREF]] = x, y, gx, gy, 0.3, v_pref
    a.agents[world, row, lay.A_HEADING] = np.arctan2(gy - y, gx - x) % (2 * np.pi)


# --- worlds ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_empty_worlds_hold_nothing(physics):
    sim = Simulator(make_config("empty", physics=physics), n_worlds=3, seed=1)
    assert sim.state().polygons == []
    assert sim.state().humans.shape == (0, 10)
    assert (sim.observe()[0] == np.float32(25.0)).all()
    assert np.isinf(sim.clearance([[0.0, 0.0]])).all()
    far = 200
    events = np.array([sim.step(np.tile([3.0, 0.0, 0.0], (3, 1)))[1] for _ in range(far)])
    assert not np.isin(events, [Event.COLLISION_HUMAN, Event.COLLISION_OBSTACLE]).any(), "there is no border to hit"


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_cadrl_has_humans_as_trunks_and_no_border(physics):
    sim = Simulator(make_config("cadrl", physics=physics), n_worlds=40, seed=1)
    counts = sim.arrays.scalars[:, lay.S_HUMANS]
    assert counts.min() >= 5
    assert counts.max() <= 15
    assert len(np.unique(counts)) > 5
    assert all(sim.state(w).polygons == [] for w in range(40))
    state = sim.state()
    np.testing.assert_array_equal(state.circles, state.humans[:, [0, 1, 7]])
    for _ in range(20):
        sim.step(np.zeros((40, 3)))
    assert sim.observe()[0].min() < 25.0


# --- humans ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("crossing", ["circle", "square"])
def test_static_humans_stand_on_both_legs_off_everybodys_goal(crossing):
    n = 80
    config = make_config("soadrl", human_policy="static", crossing=crossing, humans=40, obstacles=2)
    sim = Simulator(config, n_worlds=n, seed=3)
    start = sim.arrays.agents.copy()
    for w in range(n):
        state = sim.state(w)
        off = np.hypot(*(state.humans[:, :2] - state.robot[3:5]).T) - state.humans[:, 7] - state.robot[5]
        assert off.min() >= 0.2
        np.testing.assert_array_equal(state.humans[:, :2], state.humans[:, 5:7])
        legs = state.circles[:, :2].reshape(-1, 2, 2)
        # stride of a standing human 1 cm, legs 0.2 m to the sides
        np.testing.assert_allclose(np.hypot(*(legs[:, 0] - legs[:, 1]).T), 2 * np.hypot(0.01, 0.2))
    assert len(np.unique(sim.arrays.agents[0, 1:10, lay.A_HEADING])) == 9, "they look in all directions"
    for _ in range(5):
        sim.step(np.zeros((n, 3)))
    np.testing.assert_array_equal(sim.arrays.agents[:, 1:, :13], start[:, 1:, :13])


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_humans_of_constant_velocity_walk_on_through_everything(physics):
    sim = Simulator(make_config("soadrl", human_policy="constant-velocity", physics=physics), n_worlds=4, seed=3)
    starts = [sim.state(w).humans for w in range(4)]
    steps = 120
    for _ in range(steps):
        sim.step(np.zeros((4, 3)))
    for w, before in enumerate(starts):
        after = sim.state(w).humans
        way = before[:, 5:7] - before[:, :2]
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        expected = before[:, :2] + 0.2 * steps * before[:, 8:9] * way
        np.testing.assert_allclose(after[:, :2], expected, atol=1e-9)
        np.testing.assert_allclose(after[:, 2:4], before[:, 8:9] * way, atol=1e-12)
        assert (np.linalg.norm(after[:, :2] - before[:, :2], axis=1) > 15.0).all(), "beyond their goals"


# --- drive and inertia ----------------------------------------------------------------------------------------------


def test_a_differential_drive_has_no_sideways_motion():
    sim, free = alone(drive="differential"), alone()
    for command in ([0.5, 0.7, 0.4], [0.8, -0.3, -1.0]):
        sim.step([command])
        free.step([[command[0], 0.0, command[2]]])
        # along the heading, where a holonomic robot shows the last step's velocity in the frame that it has turned to
        np.testing.assert_allclose(sim.robot_states()[0, 2:], [command[0], 0.0, command[2]], atol=1e-7)
        sim.arrays.agents[0, 0, [lay.A_VX, lay.A_VY]] = free.arrays.agents[0, 0, [lay.A_VX, lay.A_VY]]
        np.testing.assert_array_equal(sim.arrays.agents, free.arrays.agents)


def test_a_differential_drive_of_the_original_is_a_command_without_vy():
    sim, free = alone(drive="differential", physics="original"), alone(physics="original")
    for command in ([0.5, 0.7, 0.4], [0.8, -0.3, -1.0]):
        sim.step([command])
        free.step([[command[0], 0.0, command[2]]])
    np.testing.assert_array_equal(sim.arrays.agents, free.arrays.agents)


def inertial_oracle(commands, acceleration, jerk, dt=0.2):
    """The original's update, written out with vectors: x, v, a along x, y and theta (SIM_FACTS d.3)."""
    x, v, a = np.zeros(3), np.zeros(3), np.zeros(3)
    poses, speeds = [], []
    for command in commands:
        x = x + v * dt
        v = v + a * dt
        c, s = np.cos(x[2]), np.sin(x[2])
        target = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ command
        a = a + np.clip((target - v) / dt - a, -jerk * dt, jerk * dt)
        a = np.clip(a, -acceleration, acceleration)
        poses.append(x)
        speeds.append(v)
    return np.array(poses), np.array(speeds)


def test_inertia_limits_acceleration_and_jerk():
    acceleration, jerk = np.array([0.6, 0.4, 1.5]), np.array([2.0, 1.0, 4.0])
    sim = alone(inertia="limited", robot_acceleration=tuple(acceleration), robot_jerk=tuple(jerk))
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform(-1, 1, (12, 3)), 7, axis=0)
    poses, speeds = [], []
    for command in commands:
        sim.step([command])
        poses.append(sim.state().robot[:3])
        speeds.append(sim.arrays.agents[0, 0, [lay.A_VX, lay.A_VY, lay.A_OMEGA]].copy())
    expected, expected_speeds = inertial_oracle(commands, acceleration, jerk)
    poses = np.array(poses)
    np.testing.assert_allclose(poses[:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.angle(np.exp(1j * (poses[:, 2] - expected[:, 2]))), 0.0, atol=1e-9)
    np.testing.assert_allclose(speeds, expected_speeds, atol=1e-9)
    change = np.diff(speeds, axis=0) / 0.2
    assert (np.abs(change) <= acceleration + 1e-9).all()
    assert (np.abs(np.diff(change, axis=0)) <= jerk * 0.2 + 1e-9).all()
    assert (np.abs(change).max(axis=0) > 0.99 * acceleration).all(), "the limits were reached"


def test_a_command_with_inertia_is_felt_two_steps_later_and_observed_as_motion():
    sim = alone(inertia="limited")
    for seen in (0.0, 0.0, 0.11 * 0.2 / 0.2):
        before = sim.state().robot[0]
        sim.step([[0.5, 0.0, 0.2]])
        assert sim.state().robot[0] - before == pytest.approx(seen * 0.2)
    state = sim.observe()[1]
    assert state[0, 2] > 0.11
    assert 0.0 < state[0, 4] <= 0.2


def test_a_differential_drive_with_inertia_keeps_its_velocity_along_its_heading():
    sim = alone(inertia="limited", drive="differential")
    rng = np.random.default_rng(1)
    speeds = []
    for command in np.repeat(rng.uniform(-1, 1, (10, 3)), 8, axis=0):
        sim.step([command])
        vx, vy, heading = sim.arrays.agents[0, 0, [lay.A_VX, lay.A_VY, lay.A_HEADING]]
        assert -np.sin(heading) * vx + np.cos(heading) * vy == pytest.approx(0.0, abs=1e-9)
        speeds.append(np.cos(heading) * vx + np.sin(heading) * vy)
    assert np.abs(np.diff(speeds)).max() <= 0.55 * 0.2 + 1e-9
    assert np.ptp(speeds) > 0.3
    assert np.ptp(sim.arrays.agents[0, 0, [lay.A_X, lay.A_Y]]) > 0.1


# --- goal and collisions --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_the_goal_radius_decides_when_the_goal_is_reached(physics):
    for radius, event in ((None, Event.NONE), (1.0, Event.GOAL), (0.2, Event.NONE)):
        sim = alone(goal_radius=radius, physics=physics)
        sim.arrays.agents[0, 0, lay.A_GX] = 1.1
        assert sim.step([[1.0, 0.0, 0.0]])[1][0] == event
    sim = alone(goal_radius=0.2, physics=physics)
    sim.arrays.agents[0, 0, lay.A_GX] = 0.39
    assert sim.step([[1.0, 0.0, 0.0]])[1][0] == Event.GOAL


def wall_ahead(**fields):
    """A robot whose disc touches the border's right side after 0.1 m."""
    sim = Simulator(make_config("soadrl", humans=0, obstacles=0, **fields), seed=0)
    xmax = sim.arrays.scalars[0, lay.S_XMAX]
    robot = sim.arrays.agents[0, 0]
    robot[[lay.A_X, lay.A_Y, lay.A_HEADING, lay.A_GX, lay.A_GY, lay.A_RADIUS]] = xmax - 0.5, 0, 0, xmax - 8, 0, 0.4
    return sim


def test_damage_puts_back_adds_up_and_ends_the_episode():
    sim = wall_ahead(on_collision="damage", max_damage=1.5)
    start = sim.arrays.agents[0, 0].copy()
    total = 0.0
    for k in range(3):
        rewards, events = sim.step([[0.6, 0.0, 0.5]])
        total += rewards[0] + 1.0  # within 0.2 m of the wall
        np.testing.assert_array_equal(sim.arrays.agents[0, 0, :5], [*start[:2], 0.0, 0.0, start[4]])
        assert sim.damage()[0, 0] == pytest.approx(0.6 * (k + 1))
        assert events[0] == (Event.COLLISION_OBSTACLE if k == 2 else Event.NONE)
    assert total == pytest.approx(-25.0), "collisions cost in all what one costs that ends an episode"
    sim.reset()
    assert sim.damage()[0, 0] == 0.0


def test_by_default_one_collision_ends_the_episode():
    sim = wall_ahead()
    rewards, events = sim.step([[0.6, 0.0, 0.0]])
    assert events[0] == Event.COLLISION_OBSTACLE
    assert rewards[0] == pytest.approx(-0.12 - 1.0 - 25.0)


def test_damage_with_inertia_stops_the_robot():
    sim = wall_ahead(on_collision="damage", inertia="limited")
    for _ in range(200):
        sim.step([[0.6, 0.0, 0.0]])
        if sim.damage()[0, 0] > 0:
            break
    robot = sim.arrays.agents[0, 0]
    assert sim.damage()[0, 0] > 0
    assert (robot[[lay.A_VX, lay.A_VY, lay.A_AX, lay.A_AY, lay.A_OMEGA]] == 0.0).all()


def test_standing_still_costs_nothing_and_who_walks_in_is_stopped():
    sim = alone(humans=2, human_policy="constant-velocity", on_collision="damage")
    sim.arrays.scalars[0, lay.S_HUMANS] = 0
    put_human(sim, 1.5, 0.0, -5.0, 0.0)
    for _ in range(40):
        _, events = sim.step(STILL)
        assert events[0] == Event.NONE
        gap = sim.state().humans[0, 0] - 0.7
        assert gap >= 0.0
    assert gap < 0.2
    assert sim.damage()[0, 0] == 0.0
    assert sim.state().humans[0, 2] == 0.0
    sim.step([[-1.0, 0.0, 0.0]])  # the robot gives way
    sim.step([[-1.0, 0.0, 0.0]])
    assert sim.state().humans[0, 2] == pytest.approx(-1.0), "and the human walks on as before"


def test_driving_into_a_human_hurts_the_robot():
    sim = alone(humans=2, human_policy="static", on_collision="damage", max_damage=0.9)
    sim.arrays.scalars[0, lay.S_HUMANS] = 0
    put_human(sim, 0.75, 0.0, 0.75, 0.0)
    assert sim.step([[0.5, 0.0, 0.0]])[1][0] == Event.NONE
    assert sim.state().robot[0] == 0.0
    assert sim.damage()[0, 0] == 0.5
    assert sim.step([[0.5, 0.0, 0.0]])[1][0] == Event.COLLISION_HUMAN


def test_what_overlaps_can_get_apart():
    sim = alone(humans=2, human_policy="static", on_collision="damage")
    sim.arrays.scalars[0, lay.S_HUMANS] = 0
    put_human(sim, 0.6, 0.0, 0.6, 0.0)
    sim.step([[0.5, 0.0, 0.0]])
    assert sim.state().robot[0] == 0.0, "not deeper"
    sim.step([[-0.5, 0.0, 0.0]])
    assert sim.state().robot[0] == pytest.approx(-0.1)
    assert sim.damage()[0, 0] == 0.5
    wall = wall_ahead(on_collision="damage")
    wall.arrays.agents[0, 0, lay.A_X] += 0.2
    before = wall.state().robot[0]
    wall.step([[0.1, 0.0, 0.0]])
    assert wall.state().robot[0] == before
    wall.step([[-0.1, 0.0, 0.0]])
    assert wall.state().robot[0] == pytest.approx(before - 0.02)


# --- generation -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["orca", "goal-momentum"])
def test_generated_robots_with_a_differential_drive_turn_to_where_they_go(policy):
    config = make_config("empty", drive="differential")
    rollout = ScriptedRollout(config, RolloutSettings(length=400, rings=False), ScriptedPolicy(policy), 0)
    columns, _ = rollout.run([0])[0]
    assert (columns["action"][:, 1] == 0.0).all()
    assert (columns["action"][:, 0] >= 0.0).all()
    assert np.abs(columns["action"][:, 2]).max() <= 1.0
    assert (columns["event"] == Event.GOAL).any(), "it gets there"
    assert not np.isin(columns["event"], [Event.COLLISION_HUMAN, Event.COLLISION_OBSTACLE]).any()
