"""The original's recorded runs of its IAN environment, replayed.

Ties between equally short ways and contacts are broken by numpy's global generator; the recordings seed it, so that
these replay, too.
What does not: the heading of a human that stands on its goal to within ten micrometres, which is the direction of a
vector of rounding errors, and rays that pass a corner of a cell, which the original's ray marching jumps over.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from recorded import reference

from navrep_data.errors import MissingExtraError
from navrep_data.sim import Simulator, make_config, map_names

RUNS = 6
MAX_VELOCITY = np.array([0.55, 0.55, 2.0])
# the reference has five digits of humans and six of the robot
TOLERANCE = 1e-4
# float32 along the original's rays, which matters at grazing incidence [m]
RANGE_TOLERANCE = 1e-3


@pytest.fixture(scope="module")
def runs() -> list[dict[str, Any]]:
    try:
        map_names()
    except MissingExtraError as error:
        pytest.skip(str(error))
    found: list[dict[str, Any]] = reference("ian_env_reference.json")["runs"]
    assert len(found) == RUNS
    return found


def _at(records: list[dict[str, Any]], step: int) -> dict[str, Any] | None:
    return next((record for record in records if record["step"] == step), None)


@pytest.mark.parametrize("k", range(RUNS))
def test_run_replays(runs: list[dict[str, Any]], k: int) -> None:
    run = runs[k]
    simulator = Simulator(make_config("ian", physics="original", scenarios=(run["scenario"],)))
    simulator.reset_scenarios([run["scenario"]], [run["numpy_seed_after_reset"]], headings=[run["robot_theta"]])
    action = np.array([run["action"]]) * MAX_VELOCITY
    compared = rays = outliers = loose = 0
    for step in range(run["steps"]):
        reward, event = simulator.step(action)
        state = simulator.state()
        np.testing.assert_allclose(state.robot[:3], run["robot"][step], atol=TOLERANCE)
        np.testing.assert_allclose(reward[0], run["reward"][step], atol=1e-9)
        np.testing.assert_allclose(simulator.damage()[0, 0], run["damage"][step], atol=1e-9)
        assert (event[0] > 0) == (run["done"] and step == run["steps"] - 1)
        humans = _at(run["humans"], step)
        if humans is None:
            continue
        position = np.array(humans["pos"])
        np.testing.assert_allclose(state.humans[:, :2], position[:, :2], atol=TOLERANCE)
        np.testing.assert_allclose(state.humans[:, 2:4], np.array(humans["vel"])[:, :2], atol=TOLERANCE)
        turned = np.abs(state.humans[:, 4] - position[:, 2]) > TOLERANCE
        arrived = np.hypot(*(state.humans[:, :2] - state.humans[:, 5:7]).T) < 1e-5
        assert not (turned & ~arrived).any()
        loose += int(turned.sum())
        scan, robot_state = simulator.observe()
        np.testing.assert_allclose(robot_state[0], _at(run["state_obs"], step)["state"], atol=TOLERANCE)
        ranges = np.array(_at(run["scan_every_60"], step)["ranges"])
        difference = ranges - scan[0, ::60]
        # the original sees too far where its march jumps over a corner, never too near
        assert difference.min() > -RANGE_TOLERANCE
        rays += len(ranges)
        outliers += int((difference > RANGE_TOLERANCE).sum())
        compared += 1
    assert compared >= 5
    assert outliers <= 0.12 * rays
    assert loose <= (10 if run["scenario"] == "irosasl1" else 0)  # five such humans in two records


def test_start_headings_are_those_of_the_original_scores() -> None:
    """Episode r of scenario i: seed 27 r + i, and the heading is the first number drawn."""
    rows = next(iter(reference("original_scores.json")["ian"].values()))["rows"]
    config = make_config("ian", physics="original")
    rows = [row for row in rows if row["scenario"].startswith(("rl", "irosasl3"))]
    simulator = Simulator(config, len(rows))
    simulator.reset_scenarios([row["scenario"] for row in rows], [row["seed"] for row in rows])
    for w, row in enumerate(rows):
        state = simulator.state(w)
        np.testing.assert_allclose(state.robot[:3], row["start"], atol=1e-12)
        np.testing.assert_allclose(state.robot[3:5], row["goal"][:2], atol=1e-12)
        assert row["seed"] == 27 * (row["k"] // 27) + config.scenarios.index(row["scenario"])
