"""Legs from the columns are where the simulator had them."""

import numpy as np
import pytest

from navrep_data.sim import Simulator, make_config
from navrep_data.view.legs import headings, leg_offsets, to_world


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_legs_are_those_that_the_lidar_saw(physics):
    config = make_config("soadrl", physics=physics, humans=12, obstacles=4)
    simulator = Simulator(config, seed=3)
    simulator.reset()
    rows, poses, circles, centres = [], [], [], []
    for _ in range(80):
        state = simulator.state()
        rows.append(simulator.humans()[0, : len(state.humans)])
        poses.append(state.robot[:3])
        circles.append(state.circles)
        centres.append(state.humans[:, :2])
        if len(rows) == 1:
            # worlds files hold headings and gait of an episode's first row; agents are x, y, ..., as _layout says
            from navrep_data.sim import _layout as lay

            agents = simulator.arrays.agents[0, 1 : len(state.humans) + 1]
            start = agents[:, lay.A_HEADING].copy()
            gait = agents[:, [lay.A_GAIT_X, lay.A_GAIT_Y, lay.A_GAIT_T]].copy()
        simulator.step(np.array([[0.3, 0.1, 0.4]]))
    world = to_world(np.array(rows, np.float64), np.array(poses))
    np.testing.assert_allclose(world[..., :2], centres, atol=2e-3)
    legs = leg_offsets(world[..., 2:4], start, gait, config.sensor.dt, physics == "original")
    seen = np.array(circles)[:, ::2, :2] - np.array(centres)
    # headings of those that creep are lost in the rounding of the column
    walking = np.hypot(world[..., 2], world[..., 3]) > 0.3
    assert walking.sum() > 300
    error = np.linalg.norm(legs - seen, axis=-1)[walking]
    assert np.percentile(error, 95) < 0.01
    assert error.max() < 0.1
    shifted = np.linalg.norm(legs[1:] - seen[:-1], axis=-1)[walking[1:]]
    assert np.median(shifted) > 0.05  # a row off would be seen


def test_who_stands_keeps_the_heading_or_loses_it_in_original_physics():
    velocity = np.zeros((4, 1, 2))
    velocity[1] = [0.0, -1.0]
    start = np.array([0.5])
    np.testing.assert_allclose(headings(velocity, start, False)[:, 0], [0.5, 1.5 * np.pi, 1.5 * np.pi, 1.5 * np.pi])
    np.testing.assert_allclose(headings(velocity, start, True)[:, 0], [0.5, 1.5 * np.pi, 0.0, 0.0])
