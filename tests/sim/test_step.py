"""One step: motion, rewards, events, observations, by hand."""

import numpy as np
import pytest

from navrep_data.errors import ConfigError
from navrep_data.schema import Event
from navrep_data.sim import Simulator, make_config
from navrep_data.sim import _layout as lay


@pytest.fixture
def empty():
    """A world with a robot alone: at the origin, heading 90 degrees, goal 5 m ahead, radius 0.4 m."""
    sim = Simulator(make_config("soadrl", humans=0, obstacles=0), seed=0)
    robot = sim.arrays.agents[0, 0]
    robot[[lay.A_X, lay.A_Y, lay.A_HEADING, lay.A_GX, lay.A_GY, lay.A_RADIUS]] = 0, 0, np.pi / 2, 0, 5, 0.4
    return sim


def put_human(sim, x, y, vx=0.0, vy=0.0):
    """Add a standing human of radius 0.3 m that wants to stay where it is."""
    a = sim.arrays
    n = int(a.scalars[0, lay.S_HUMANS]) + 1
    a.scalars[0, lay.S_HUMANS] = n
    a.agents[0, n] = 0.0
    a.agents[0, n, [lay.A_X, lay.A_Y, lay.A_VX, lay.A_VY, lay.A_GX, lay.A_GY, lay.A_RADIUS, lay.A_VPREF]] = (
        x, y, vx, vy, x, y, 0.3, 1.0,
    )  # fmt: skip


@pytest.fixture
def crowd():
    sim = Simulator(make_config("soadrl", humans=2, obstacles=0), seed=0)
    robot = sim.arrays.agents[0, 0]
    robot[[lay.A_X, lay.A_Y, lay.A_HEADING, lay.A_GX, lay.A_GY, lay.A_RADIUS]] = 0, 0, 0, 5, 0, 0.4
    sim.arrays.scalars[0, lay.S_HUMANS] = 0
    return sim


def test_robot_translates_along_its_old_heading_then_turns(empty):
    empty.step([[0.5, 0.25, 0.5]])
    x, y, theta = empty.state().robot[:3]
    np.testing.assert_allclose([x, y], [-0.05, 0.1], atol=1e-12)
    assert theta == pytest.approx(np.pi / 2 + 0.1)
    state = empty.observe()[1][0]
    c, s = np.cos(theta), np.sin(theta)
    np.testing.assert_allclose(state[:2], [c * 0.05 + s * 4.9, c * 4.9 - s * 0.05], rtol=1e-6)
    vx, vy = -0.25, 0.5
    np.testing.assert_allclose(state[2:], [c * vx + s * vy, c * vy - s * vx, 0.5], rtol=1e-6)


def test_progress_is_paid_in_metres(empty):
    rewards, events = empty.step([[1.0, 0.0, 0.0]])
    assert rewards[0] == pytest.approx(0.2)
    assert events[0] == Event.NONE
    rewards, _ = empty.step([[-1.0, 0.0, 0.0]])
    assert rewards[0] == pytest.approx(-0.2)


def test_goal_ends_the_episode_within_one_radius(empty):
    empty.arrays.agents[0, 0, lay.A_GY] = 0.5
    rewards, events = empty.step([[0.45, 0.0, 0.0]])  # 0.41 m away: not yet
    assert events[0] == Event.NONE
    rewards, events = empty.step([[0.1, 0.0, 0.0]])
    assert events[0] == Event.GOAL
    assert rewards[0] == pytest.approx(100 + 0.02)


def test_time_is_up_after_35_seconds(empty):
    for step in range(175):
        _, events = empty.step([[0.0, 0.0, 0.0]])
        assert events[0] == (Event.TIMEOUT if step == 174 else Event.NONE)


@pytest.mark.parametrize(
    ("gap", "event", "reward"),
    [(0.3, Event.NONE, 0.0), (0.19, Event.NONE, -1.0), (-0.01, Event.COLLISION_HUMAN, -26.0)],
)
def test_human_clearance_decides(crowd, gap, event, reward):
    put_human(crowd, 0.0, 0.7 + gap)
    rewards, events = crowd.step([[0.0, 0.0, 0.0]])
    assert events[0] == event
    assert rewards[0] == pytest.approx(reward)
    assert crowd.arrays.scalars[0, lay.S_CLEAR_HUMAN] == pytest.approx(gap, abs=0.02)


def test_passing_through_a_human_within_a_step_is_a_collision(crowd):
    put_human(crowd, 1.0, 0.0)
    _, events = crowd.step([[10.0, 0.0, 0.0]])  # ends 2 m ahead, 1 m behind the human
    assert events[0] == Event.COLLISION_HUMAN


def test_walls_collide_by_distance(empty):
    """The border of an empty world lies 1 m outside start and goal."""
    ymin = empty.arrays.scalars[0, lay.S_YMIN]
    robot = empty.arrays.agents[0, 0]
    robot[lay.A_X] = 0.5 * (empty.arrays.scalars[0, lay.S_XMIN] + empty.arrays.scalars[0, lay.S_XMAX])
    robot[[lay.A_GX, lay.A_GY]] = robot[lay.A_X], 0.0
    for gap, event, danger in (
        (0.25, Event.NONE, 0.0),
        (0.15, Event.NONE, -1.0),
        (-0.01, Event.COLLISION_OBSTACLE, -26.0),
    ):
        robot[lay.A_Y] = ymin + 0.4 + gap + 0.1
        rewards, events = empty.step([[-0.5, 0.0, 0.0]])
        assert events[0] == event
        assert rewards[0] == pytest.approx(-0.1 + danger)


def test_humans_walk_with_their_legs(crowd):
    put_human(crowd, 3.0, 3.0)
    crowd.arrays.agents[0, 1, [lay.A_GX, lay.A_GY]] = 3.0, -3.0
    for _ in range(3):
        crowd.step([[0.0, 0.0, 0.0]])
    x, y, vx, _, theta = crowd.state().humans[0, :5]
    assert (x, vx) == (pytest.approx(3.0, abs=1e-5), pytest.approx(0.0, abs=1e-5))
    assert y == pytest.approx(3.0 - 0.6, abs=1e-5)
    assert theta == pytest.approx(1.5 * np.pi, abs=1e-4)
    assert crowd.arrays.agents[0, 1, lay.A_GAIT_X] == pytest.approx(0.6, abs=1e-5)
    assert crowd.arrays.agents[0, 1, lay.A_GAIT_Y] == pytest.approx(0.0, abs=1e-5)
    legs = crowd.state().circles
    amplitude = 0.3
    forward = amplitude * np.cos(2 * 0.6 / amplitude + crowd.arrays.agents[0, 1, lay.A_GAIT_T])
    assert legs[0, 1] - y == pytest.approx(-forward, abs=1e-4)
    assert legs[1, 1] - y == pytest.approx(forward, abs=1e-4)


def test_humans_column_is_the_crowd_in_the_robot_frame(crowd):
    put_human(crowd, 2.0, 1.0)
    crowd.arrays.agents[0, 0, lay.A_HEADING] = np.pi / 2
    crowd.observe()
    humans = crowd.humans()[0]
    np.testing.assert_allclose(humans[0, :2], [1.0, -2.0], atol=1e-6)
    assert humans[0, 4] == np.float32(0.3)
    assert humans[0, 5] == 1.0
    assert np.isnan(humans[1:]).all()


def test_a_human_behind_another_is_not_visible():
    sim = Simulator(make_config("soadrl", humans=2, obstacles=0, rendering="trunk"), seed=0)
    sim.arrays.agents[0, 0, [lay.A_X, lay.A_Y, lay.A_HEADING]] = 0, 0, 0
    sim.arrays.scalars[0, lay.S_HUMANS] = 0
    put_human(sim, 2.0, 0.0)
    put_human(sim, 4.0, 0.0)
    put_human(sim, 0.0, -3.0)
    sim.observe()
    np.testing.assert_array_equal(sim.humans()[0, :3, 5], [1.0, 0.0, 1.0])


def test_wrong_actions_are_refused(empty):
    with pytest.raises(ConfigError, match=r"shape \(1, 2\), expected \(1, 3\)"):
        empty.step([[0.0, 0.0]])
    with pytest.raises(ConfigError, match="NaN or infinity"):
        empty.step([[0.0, np.nan, 0.0]])
    with pytest.raises(ConfigError, match="mask has shape"):
        empty.reset(mask=[True, False])


def test_rotating_world_and_robot_together_changes_no_scan():
    """The robot frame is all the lidar knows: turn everything by any angle and the scan stays."""
    sim = Simulator(make_config("soadrl"), seed=6)
    a = sim.arrays
    before = sim.observe()[0][0]
    agents, vertices = a.agents.copy(), a.edges.copy()
    for angle in (0.3, 1.7, 3.1, 5.9):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s], [s, c]])
        a.agents[:] = agents
        a.agents[0, :, [lay.A_X, lay.A_Y]] = turn @ agents[0][:, [lay.A_X, lay.A_Y]].T
        a.agents[0, :, [lay.A_VX, lay.A_VY]] = turn @ agents[0][:, [lay.A_VX, lay.A_VY]].T
        a.agents[0, :, lay.A_HEADING] = agents[0][:, lay.A_HEADING] + angle
        a.edges[0, :, :2] = vertices[0, :, :2] @ turn.T
        a.edges[0, :, 2:] = vertices[0, :, 2:] @ turn.T
        after = sim.observe()[0][0]
        # a ray that passes a corner within rounding may fall on either side of it
        assert np.isclose(after, before, atol=1e-5, rtol=0).mean() > 0.998
        assert after.max() <= 25.0
