"""The worlds that a benchmark's episodes are played in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from navrep_data.sim import SimConfig, Simulator, Touches
from navrep_data.sim.map_tables import RADIUS
from navrep_data.sim.shortest_paths import shortest_path

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]


class SuiteWorlds:
    """A batch of worlds that play numbered episodes; in metres and seconds, on maps in the frame of the map's file.

    Parameters
    ----------
    config : SimConfig
        Of an environment with numpy-seeded episodes.
    n : int
        Number of worlds W.

    Attributes
    ----------
    n : int
        Number of worlds W.
    sensor : SensorContract
        What scans are.
    simulator : Simulator
        Which simulates them.
    """

    def __init__(self, config: SimConfig, n: int) -> None:
        self.n = n
        self.sensor = config.sensor
        self.simulator = Simulator(config, n)
        self._config = config

    def reset(self, mask: Mask, seeds: NDArray[np.int64], scenarios: NDArray[np.int64]) -> None:
        """Start episodes in the worlds of `mask` (W,): numpy seed and index of the scenario, both (W,)."""
        if self._config.scenarios:
            self.simulator.reset_scenarios(scenarios, seeds, mask)
        else:
            self.simulator.reset_seeded(seeds, mask)

    def step(self, commands: F64) -> NDArray[np.uint8]:
        """Execute body velocities (W, 3) [m/s, m/s, rad/s]; return :class:`navrep_data.schema.Event` codes (W,)."""
        return self.simulator.step(commands)[1]

    def poses(self) -> F64:
        """Return x, y, theta of the robots (W, 3)."""
        poses = self.simulator.poses()
        poses[:, :2] += self.simulator.origins
        return poses

    def touches(self) -> Touches:
        """Return whom and what the robots touched during the last step."""
        return self.simulator.touches()

    def gaps(self) -> tuple[F64, F64]:
        """Return the gaps to the nearest human and static matter, both (W,); see :meth:`Simulator.gaps`."""
        return self.simulator.gaps()

    def shortest(self) -> F64:
        """Return the lengths of the shortest paths from where episodes start to where goals are reached, (W,).

        In scenarios it is that of a disc of the robot's radius through the map without humans. Elsewhere it is taken to
        be the straight line, a lower bound, since obstacles are not gone round; so SPL is a lower bound there, too.
        """
        names = self._config.scenarios
        if names:
            reach = RADIUS if self._config.goal_radius is None else self._config.goal_radius
            paths = np.array([shortest_path(names[i]) for i in self.simulator.scenarios_played()], np.float64)
            return np.maximum(paths - reach, 0.0)
        to_goal: F64 = np.linalg.norm(self.simulator.goals() - self.simulator.poses()[:, :2], axis=1)
        return np.maximum(to_goal - self.simulator.radii(), 0.0)
