"""What a simulator says of its worlds, against copies of their states."""

import numpy as np
import pytest

from navrep_data.sim import Simulator, make_config
from navrep_data.sim._step import ORCA_MARGIN
from navrep_data.sim.orca import orca_velocities

POLYGONS = [
    ("soadrl", {"humans": 4, "obstacles": 3}),
    ("navrep-test", {"physics": "original"}),
    ("soadrl", {"robots": 3, "humans": 4}),
]
MAPS = [
    # its three large maps take two minutes without compiled kernels
    pytest.param("ian", {"physics": "consistent"}, marks=pytest.mark.slow),
    pytest.param("ian", {"physics": "original"}, marks=pytest.mark.slow),
    ("map", {"maps": ["asl"], "humans": 5}),
    ("map", {"maps": ["asl"], "humans": 5, "robots": 2}),
]


@pytest.fixture
def moved(env, settings, maps):
    """A simulator whose robots have moved, and their present states."""
    sim = Simulator(make_config(env, **settings), n_worlds=3, seed=2)
    shape = sim.robot_states().shape[:-1]
    for _ in range(4):
        sim.step(np.broadcast_to([0.4, 0.1, 0.3], (*shape, 3)))
    return sim, [sim.state(w) for w in range(3)]


@pytest.mark.parametrize(("env", "settings"), [*POLYGONS, *MAPS])
def test_poses_goals_and_radii_are_those_of_the_states(moved):
    sim, states = moved
    lead = (3, sim.config.robots) if sim.config.robots > 1 else (3,)
    robots = np.array([state.robots for state in states]).reshape(*lead, 7)
    for read, columns in ((sim.poses, slice(0, 3)), (sim.goals, slice(3, 5)), (sim.radii, 5)):
        found, expected = read(), robots[..., columns]
        assert np.array_equal(found, expected)
        found += 1.0  # a copy
    assert np.array_equal(sim.poses(), robots[..., :3])


@pytest.mark.parametrize(("env", "settings"), [*POLYGONS, *MAPS])
def test_humans_are_those_of_the_states(moved):
    sim, states = moved
    counts, motions = sim.human_counts(), sim.human_motions()
    for w, state in enumerate(states):
        assert counts[w] == len(state.humans)
        assert np.array_equal(motions[w, : counts[w]], state.humans[:, :4])
        assert np.isnan(motions[w, counts[w] :]).all()


@pytest.mark.parametrize(("env", "settings"), [*POLYGONS, *MAPS])
def test_gaps_are_those_to_the_nearest(moved):
    sim, states = moved
    to_agent, to_static = sim.gaps()
    for w, state in enumerate(states):
        x, y, radius = state.robot[[0, 1, 5]]
        others = np.concatenate([state.humans[:, [0, 1, 7]], state.robots[1:, [0, 1, 5]]])
        agent = (np.hypot(others[:, 0] - x, others[:, 1] - y) - others[:, 2]).min(initial=np.inf) - radius
        static = sim.clearance([[x, y]], w)[0] - radius
        if sim.maps is None:
            assert to_agent[w] == pytest.approx(agent, abs=1e-9)
            assert to_static[w] == pytest.approx(static, abs=1e-9)
        else:  # the smallest of a step, which may have put somebody back; exact up to a metre
            assert agent - 0.5 <= to_agent[w] <= agent + 0.5 or np.isinf(agent)
            assert static - 0.2 <= to_static[w] or to_static[w] >= 1.0
            assert min(to_static[w], 1.0) <= min(static, 1.0) + 1e-6


@pytest.mark.parametrize(("env", "settings"), [*POLYGONS, *MAPS])
def test_gaps_before_the_first_step(env, settings, maps):
    sim = Simulator(make_config(env, **settings), n_worlds=2, seed=3)
    to_agent, to_static = sim.gaps()
    for w in range(2):
        state = sim.state(w)
        x, y, radius = state.robot[[0, 1, 5]]
        others = np.concatenate([state.humans[:, [0, 1, 7]], state.robots[1:, [0, 1, 5]]])
        agent = (np.hypot(others[:, 0] - x, others[:, 1] - y) - others[:, 2]).min(initial=np.inf) - radius
        static = sim.clearance([[x, y]], w)[0] - radius
        assert to_agent[w] == pytest.approx(agent, abs=1e-9)
        assert min(to_static[w], 1.0) == pytest.approx(min(static, 1.0), abs=1e-6)


@pytest.mark.parametrize("robots", [1, 3])
def test_orca_velocities_are_those_of_orca_for_everybody(robots):
    sim = Simulator(make_config("soadrl", humans=6, obstacles=3, robots=robots), n_worlds=4, seed=1)
    for _ in range(3):
        sim.step(np.broadcast_to([0.5, 0.0, 0.0], (*sim.robot_states().shape[:-1], 3)))
    found, poses = sim.orca_velocities(), sim.poses().reshape(4, robots, 3)
    velocities = sim.robot_states().reshape(4, robots, 5)[..., 2:4]
    for w in range(4):
        state = sim.state(w)
        c, s = np.cos(poses[w, :, 2]), np.sin(poses[w, :, 2])
        vx, vy = velocities[w].T
        own = np.column_stack([c * vx - s * vy, s * vx + c * vy])
        everybody = np.concatenate([poses[w, :, :2], state.humans[:, :2]])
        moving = np.concatenate([own, state.humans[:, 2:4]])
        radii = np.concatenate([state.robots[:, 5], state.humans[:, 7]]) + ORCA_MARGIN
        speeds = np.concatenate([state.robots[:, 6], state.humans[:, 8]])
        goals = np.concatenate([state.robots[:, 3:5], state.humans[:, 5:7]])
        wanted = goals - everybody
        wanted /= np.maximum(1.0, np.linalg.norm(wanted, axis=1, keepdims=True))
        expected = orca_velocities(everybody, moving, radii, speeds, wanted, state.polygons)
        np.testing.assert_allclose(found[w], expected[0], atol=2e-4)


@pytest.mark.parametrize(("env", "settings"), [*POLYGONS, *MAPS])
def test_waypoints_lie_ahead_on_maps_and_at_the_goal_elsewhere(moved, maps):
    sim, states = moved
    points = sim.waypoints()
    for w, state in enumerate(states):
        ahead = np.hypot(*(points[w] - state.robot[:2]))
        if sim.maps is None:
            assert np.array_equal(points[w], state.robot[3:5])
            assert sim.grid(w) is None
        else:
            assert ahead < 2.0
            assert sim.grid(w).name in maps


@pytest.mark.slow
def test_scenarios_played(maps):
    sim = Simulator(make_config("ian"), n_worlds=2)
    sim.reset_scenarios([3, 20])
    assert sim.scenarios_played().tolist() == [3, 20]
    assert (Simulator(make_config("empty"), 2).scenarios_played() == -1).all()
