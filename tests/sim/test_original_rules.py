"""Steps in original physics, by hand: rewards, which condition decides, time, motion, observation."""

import numpy as np
import pytest

from navrep_data.schema import Event
from navrep_data.sim import RolloutSettings, ScriptedPolicy, ScriptedRollout, Simulator, make_config
from navrep_data.sim import _layout as lay

STILL = [[0.0, 0.0, 0.0]]


@pytest.fixture
def scene():
    """A robot alone in the middle of a wide world: heading along x, goal 5 m ahead, radius 0.4 m."""
    sim = Simulator(make_config("navrep-train", physics="original", humans=2, obstacles=1), seed=0)
    robot = sim.arrays.agents[0, 0]
    robot[[lay.A_X, lay.A_Y, lay.A_HEADING, lay.A_GX, lay.A_GY, lay.A_RADIUS]] = 0, 0, 0, 5, 0, 0.4
    scalars = sim.arrays.scalars[0]
    scalars[[lay.S_HUMANS, lay.S_POLYGONS, lay.S_OBST_HUMAN, lay.S_OBST_ROBOT]] = 0, 1, 0, 0
    scalars[[lay.S_XMIN, lay.S_YMIN, lay.S_XMAX, lay.S_YMAX]] = -8, -8, 8, 8
    return sim


def put_human(sim, x, y, vx=0.0, vy=0.0, goal=None):
    """Add a human of radius 0.3 m that wants to stay where it is, or to go to `goal`."""
    agents, scalars = sim.arrays.agents[0], sim.arrays.scalars[0]
    scalars[lay.S_HUMANS] += 1
    n = int(scalars[lay.S_HUMANS])
    agents[n] = 0.0
    gx, gy = goal or (x, y)
    agents[n, [lay.A_X, lay.A_Y, lay.A_VX, lay.A_VY, lay.A_GX, lay.A_GY, lay.A_RADIUS, lay.A_VPREF]] = (
        x, y, vx, vy, gx, gy, 0.3, 1.0,
    )  # fmt: skip


def put_cell(sim, ix, iy):
    """Occupy one cell of the collision grid."""
    sim.arrays.boxes[0, 0] = ix, ix + 1, iy, iy + 1, 1
    sim.arrays.scalars[0, lay.S_POLYGONS] = 2


def test_progress_is_a_tenth_and_rotation_costs(scene):
    assert scene.step(STILL)[0][0] == 0.0
    assert scene.step([[1.0, 0.0, 0.0]])[0][0] == pytest.approx(0.02)
    assert scene.step([[0.0, 0.0, -0.5]])[0][0] == pytest.approx(-0.3 * 0.1)
    rewards, events = scene.step([[0.5, 0.0, 0.5]])  # the body has turned by -0.1 rad
    before, after = 4.8, np.hypot(4.8 - 0.1 * np.cos(0.1), 0.1 * np.sin(0.1))
    assert rewards[0] == pytest.approx(0.1 * (before - after) - 0.03)
    assert events[0] == Event.NONE


def test_goal_pays_100_and_no_progress(scene):
    scene.arrays.agents[0, 0, lay.A_GX] = 0.5
    assert scene.step([[0.45, 0.0, 0.0]])[1][0] == Event.NONE
    rewards, events = scene.step([[0.1, 0.0, 0.0]])
    assert (rewards[0], events[0]) == (100.0, Event.GOAL)


@pytest.mark.parametrize(
    ("gap", "event", "reward"), [(0.3, 0, 0.0), (0.15, 0, -0.5), (0.01, 0, -1.9), (-0.01, 2, -25.0)]
)
def test_near_humans_cost_in_proportion(scene, gap, event, reward):
    put_human(scene, 0.0, 0.7 + gap)
    rewards, events = scene.step(STILL)
    assert events[0] == event
    assert rewards[0] == pytest.approx(reward, abs=1e-9)
    assert scene.arrays.scalars[0, lay.S_CLEAR_HUMAN] == pytest.approx(gap)


def test_humans_are_judged_by_their_old_velocity(scene):
    """One that walks away is judged as if it went on towards the robot, as it did before."""
    put_human(scene, 0.85, 0.0, vx=-1.0, goal=(5.0, 0.0))
    assert scene.step(STILL)[1][0] == Event.COLLISION_HUMAN
    assert scene.state().humans[0, 2] > 0.5
    assert scene.step(STILL)[1][0] == Event.NONE


def test_passing_through_a_human_within_a_step_is_a_collision(scene):
    put_human(scene, 1.0, 0.0)
    assert scene.step([[10.0, 0.0, 0.0]])[1][0] == Event.COLLISION_HUMAN


def test_cells_collide_in_the_small_window_and_warn_in_the_large(scene):
    """Radius 0.39: 3 cells for a collision (0.39 / sqrt 2), 6 for danger (0.59), one less on the upper side."""
    scene.arrays.agents[0, 0, lay.A_RADIUS] = 0.39
    for cell, event, reward in (
        (63, Event.NONE, 0.0),
        (64, Event.NONE, -1.0),
        (66, Event.NONE, -1.0),
        (67, Event.COLLISION_OBSTACLE, -25.0),
        (72, Event.COLLISION_OBSTACLE, -25.0),
        (73, Event.NONE, -1.0),
        (75, Event.NONE, -1.0),
        (76, Event.NONE, 0.0),
    ):
        put_cell(scene, cell, 70)
        rewards, events = scene.step(STILL)
        assert (rewards[0], events[0]) == (reward, event), cell


def test_a_cell_in_danger_outranks_a_near_human_and_rotation(scene):
    put_human(scene, 0.0, 0.75)
    put_cell(scene, 75, 70)
    assert scene.step([[0.0, 0.0, 0.5]])[0][0] == pytest.approx(-1.0)
    put_cell(scene, 100, 70)
    assert scene.step([[0.0, 0.0, 0.5]])[0][0] == pytest.approx(-1.5)


def test_border_collides_at_one_radius_and_is_no_danger(scene):
    robot = scene.arrays.agents[0, 0]
    for axis in (lay.A_X, lay.A_Y):
        for side in (-1, 1):
            robot[[lay.A_X, lay.A_Y]] = 0.0
            robot[axis] = side * (8 - 0.45)
            assert scene.step(STILL)[1][0] == Event.NONE
            robot[axis] = side * (8 - 0.4)
            rewards, events = scene.step(STILL)
            assert (rewards[0], events[0]) == (-25.0, Event.COLLISION_OBSTACLE)


def test_time_outranks_the_goal_and_the_goal_outranks_a_collision(scene):
    scene.arrays.agents[0, 0, lay.A_GX] = 0.1
    put_human(scene, 0.5, 0.0)
    put_cell(scene, 70, 70)
    assert scene.step(STILL)[1][0] == Event.GOAL
    scene.arrays.scalars[0, lay.S_TIME] = 35.0
    rewards, events = scene.step(STILL)
    assert (rewards[0], events[0]) == (0.0, Event.TIMEOUT)


def test_a_human_outranks_a_cell(scene):
    put_human(scene, 0.5, 0.0)
    put_cell(scene, 70, 70)
    assert scene.step(STILL)[1][0] == Event.COLLISION_HUMAN


def test_time_is_up_at_the_176th_step(scene):
    scene.reset()
    scene.arrays.scalars[0, [lay.S_HUMANS, lay.S_POLYGONS]] = 0, 1
    assert scene.arrays.scalars[0, lay.S_TIME] == 0.2  # the hidden step
    for step in range(1, 177):
        events = scene.step(STILL)[1]
        assert events[0] == (Event.TIMEOUT if step == 176 else Event.NONE), step


def test_humans_that_stand_head_along_x_and_omega_is_never_seen(scene):
    put_human(scene, 3.0, 3.0, goal=(3.0, 2.9))
    scene.step([[0.0, 0.0, 0.5]])
    assert scene.state().humans[0, 4] == pytest.approx(1.5 * np.pi)
    scene.arrays.agents[0, 1, [lay.A_GX, lay.A_GY]] = scene.state().humans[0, :2]
    scene.step([[0.0, 0.0, 0.5]])
    assert scene.state().humans[0, 2:5].tolist() == [0.0, 0.0, 0.0]
    assert scene.observe()[1][0, 4] == 0.0


def test_legs_swing_with_the_way_walked(scene):
    put_human(scene, 3.0, 3.0, goal=(3.0, -3.0))
    for _ in range(3):
        scene.step(STILL)
    gait = scene.arrays.agents[0, 1, [lay.A_GAIT_X, lay.A_GAIT_Y, lay.A_GAIT_T]]
    np.testing.assert_allclose(gait, [0.6, 0.0, 1.5 * np.pi], atol=1e-5)


def test_legs_straight_ahead_in_x_are_invisible(scene):
    """The original's renderer drops a circle that straddles world bearing 0."""
    put_human(scene, 3.0, 0.0, goal=(3.0, 0.0))
    sideways = scene.arrays.agents[0, 1]
    sideways[lay.A_HEADING] = np.pi / 2  # its legs lie 0.2 m either side along x, one behind the other
    assert scene.observe()[0][0, 0] > 8.0  # the border
    consistent = Simulator(make_config("navrep-train", humans=2, obstacles=0), seed=0)
    consistent.arrays.agents[0] = scene.arrays.agents[0]
    consistent.arrays.scalars[0, lay.S_HUMANS] = 1
    assert consistent.observe()[0][0, 0] < 3.0


def test_rollouts_store_what_the_simulator_does():
    """A short sequence: rewards of its rows follow from its own columns."""
    settings = RolloutSettings(length=60, rings=False)
    config = make_config("navrep-train", physics="original")
    columns, worlds = ScriptedRollout(config, settings, ScriptedPolicy(), seed=4).run([0])[0]
    again, _ = ScriptedRollout(config, settings, ScriptedPolicy(), seed=4).run([0])[0]
    assert worlds["has_border"].all()
    np.testing.assert_array_equal(columns["scan"], again["scan"])
    assert (columns["robot_state"][:, 4] == 0).all()
    distance = np.hypot(*columns["robot_state"][:, :2].T)
    goes_on = ~columns["is_last"] & ~np.roll(columns["is_last"], -1)
    progress = 0.1 * (distance[:-1] - distance[1:])[goes_on[:-1]]
    extra = columns["reward"][:-1][goes_on[:-1]] - progress
    assert len(extra) > 20
    assert (extra < 1e-5).all()
    assert (extra > -2.02).all()
