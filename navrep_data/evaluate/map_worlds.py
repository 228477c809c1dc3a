"""The worlds of scenarios on maps, as the benchmark plays them."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from navrep_data.evaluate._on_maps import guided_robots, start_gaps
from navrep_data.sim import SimConfig, Simulator, Touches, robot_contract, scale_actions
from navrep_data.sim import _layout as lay
from navrep_data.sim._fast_marching import UPWIND_FINAL, march
from navrep_data.sim.map_tables import RADIUS
from navrep_data.sim.maps import load_map
from navrep_data.sim.scenarios import get_scenario

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

COARSE = 0.16
"""Shortest paths are looked for on cells of at most this side [m], where the map is as fine."""


class ScenarioWorlds:
    """Worlds that play scenarios on maps; see :class:`navrep_data.evaluate.worlds.Worlds` for the methods.

    Parameters
    ----------
    config : SimConfig
        Of an environment with scenarios.
    n : int
        Number of worlds.

    Notes
    -----
    An action of 1 is the robot's largest velocity, and a translation longer than 1 is shortened to 1, as in the
    original. The shortest path is that of a disc of the robot's radius through the map without humans, up to the edge
    of the goal. Gaps to obstacles are exact up to a metre; beyond that they are lower bounds.
    """

    def __init__(self, config: SimConfig, n: int) -> None:
        self.n = n
        self.sensor = config.sensor
        self.robot = robot_contract(config)
        self.simulator = Simulator(config, n)
        self._config = config
        self._names = config.scenarios
        self._maps = self.simulator.maps
        self._state = self.simulator.arrays.worlds
        self._playing = np.zeros(n, np.int64)
        self._velocities = np.zeros((n, 2))
        self._gaps = np.zeros((2, n))

    def reset(self, mask: Mask, seeds: NDArray[np.int64], scenarios: NDArray[np.int64]) -> None:
        """Start the episodes of numpy seeds in scenarios, by index."""
        self.simulator.reset_scenarios(scenarios, seeds, mask)
        self._playing[mask] = scenarios[mask]
        s = self._state
        assert self._maps is not None
        start_gaps(mask, s.agents, s.scalars, s.place, self._maps.data.tables, *self._gaps)

    def step(self, actions: F64) -> NDArray[np.uint8]:
        """Execute actions as shares of the largest velocity."""
        events = self.simulator.step(self.commands(actions))[1]
        self._gaps[0] = self._state.agents[:, 0, lay.A_CLEAR_HUMAN]
        self._gaps[1] = self._state.agents[:, 0, lay.A_CLEAR_STATIC]
        return events

    def commands(self, actions: F64) -> F64:
        """Return body velocities (W, 3) of actions: a translation longer than 1 is shortened to 1."""
        return scale_actions(self._config, actions)

    def scans(self) -> F32:
        """Return scans (W, n_rays) [m]."""
        return self.simulator.observe()[0]

    def robot_states(self) -> F32:
        """Return robot states (W, 5)."""
        return self.simulator.robot_states()

    def poses(self) -> F64:
        """Return x, y, theta of the robots (W, 3), in the frame of the map's file."""
        poses: F64 = self._state.agents[:, 0, [lay.A_X, lay.A_Y, lay.A_HEADING]]
        poses[:, :2] += self.simulator.origins
        return poses

    def radii(self) -> F64:
        """Return the robots' radii (W,)."""
        radii: F64 = self._state.agents[:, 0, lay.A_RADIUS]
        return radii

    def touches(self) -> Touches:
        """Return whom and what the robots touched during the last step."""
        return self.simulator.touches()

    def gaps(self) -> tuple[F64, F64]:
        """Return the gaps to the nearest human and obstacle, both (W,)."""
        return self._gaps[0], self._gaps[1]

    def shortest(self) -> F64:
        """Return the lengths of the shortest paths from the scenarios' starts (W,)."""
        reach = RADIUS if self._config.goal_radius is None else self._config.goal_radius
        lengths = [max(shortest_path(self._names[i]) - reach, 0.0) for i in self._playing]
        return np.array(lengths, np.float64)

    def orca(self) -> F64:
        """Return the velocities (W, 2) that ORCA chooses along the planned way [m/s]."""
        s, maps, arrays = self._state, self._maps, self.simulator.arrays
        assert maps is not None
        guided_robots(
            s.agents, s.walkers, s.scalars, s.place, s.own_field, s.rng, maps.data.tables, arrays.orca, arrays.path,
            self._velocities,
        )  # fmt: skip
        return self._velocities

    def targets(self) -> F64:
        """Return points (W, 2) about a metre ahead on the planned way, in the frame of the map's file."""
        assert self._maps is not None
        return self._maps.ways_ahead() + self.simulator.origins

    def speed(self) -> float:
        """Return the velocity that an action of 1 stands for [m/s]."""
        return self.robot.max_speed


@cache
def shortest_path(scenario: str) -> float:
    """Return the length of the robot's shortest path from start to goal in a scenario, humans left out [m].

    Parameters
    ----------
    scenario : str
        Name of the scenario.

    Notes
    -----
    Fast marching at unit speed over blocks of cells, of which at least one leaves the robot's disc room; never less
    than the straight line.
    """
    recipe = get_scenario(scenario)
    grid = load_map(recipe.map)
    room = grid.signed_distance() >= np.float32(RADIUS)
    block = max(1, int(COARSE / grid.resolution))
    # cells beyond the last whole block count as closed
    width, height = (-(-n // block) * block for n in room.shape)
    padded = np.zeros((width, height), np.bool_)
    padded[: room.shape[0], : room.shape[1]] = room
    speeds = padded.reshape(width // block, block, height // block, block).any(axis=(1, 3)).astype(np.float32)
    start, goal = (grid.cell_of(xy) // block for xy in (recipe.starts[:1, :2], recipe.goals[:1]))
    field = np.empty(speeds.shape, np.float32)
    march(speeds, int(goal[0, 0]), int(goal[0, 1]), UPWIND_FINAL, field)
    straight = float(np.hypot(*(recipe.goals[0] - recipe.starts[0, :2])))
    found = float(field[start[0, 0], start[0, 1]]) * block * grid.resolution
    # the start lies closer to a wall than the robot's radius, by less than a cell: there is no better bound then
    return max(straight, found) if np.isfinite(found) else straight
