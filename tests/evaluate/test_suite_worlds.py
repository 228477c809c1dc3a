"""Policies in a benchmark are shown the robot state that the simulator shows, by its own definition."""

import numpy as np
import pytest

from navrep_data.evaluate.suite_worlds import SuiteWorlds
from navrep_data.policies import observe
from navrep_data.sim import make_config


@pytest.mark.parametrize(("physics", "omega"), [("original", 0.0), ("consistent", 1.0)])
def test_a_turning_robot_is_shown_as_the_simulator_shows_it(physics, omega):
    worlds = SuiteWorlds(make_config("navrep-test", physics=physics), 3)
    worlds.reset(np.ones(3, bool), np.array([5000, 5001, 5002]), np.zeros(3, np.int64))
    worlds.step(np.tile([0.3, -0.2, 1.0], (3, 1)))
    states = observe(worlds.simulator, frozenset()).robot_state
    np.testing.assert_array_equal(states, worlds.simulator.observe()[1])
    # the released software shows no rotation, and released policies were trained on that
    assert (states[:, 4] == omega).all()
