"""The worlds that a benchmark's episodes are played in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from navrep_data.sim import SimConfig, Simulator, Touches, robot_contract, scale_actions
from navrep_data.sim.map_tables import RADIUS
from navrep_data.sim.shortest_paths import shortest_path

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


class SuiteWorlds:
    """A batch of worlds that play numbered episodes; in metres and seconds, on maps in the frame of the map's file.

    An action of 1 is the robot's largest velocity along each axis; what else holds for actions on maps, such as that a
    translation longer than 1 is shortened to 1, is the config's.

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
    robot : RobotContract
        What robot it is, as policies are told.
    simulator : Simulator
        Which simulates them.
    """

    def __init__(self, config: SimConfig, n: int) -> None:
        self.n = n
        self.sensor = config.sensor
        self.robot = robot_contract(config)
        self.simulator = Simulator(config, n)
        self._config = config

    def reset(self, mask: Mask, seeds: NDArray[np.int64], scenarios: NDArray[np.int64]) -> None:
        """Start episodes in the worlds of `mask` (W,): numpy seed and index of the scenario, both (W,)."""
        if self._config.scenarios:
            self.simulator.reset_scenarios(scenarios, seeds, mask)
        else:
            self.simulator.reset_seeded(seeds, mask)

    def step(self, actions: F64) -> NDArray[np.uint8]:
        """Execute actions (W, 3) in [-1, 1] and return :class:`navrep_data.schema.Event` codes (W,)."""
        return self.simulator.step(self.commands(actions))[1]

    def commands(self, actions: F64) -> F64:
        """Return what robots are sent for actions (W, 3): body velocities [m/s, m/s, rad/s], within their limits."""
        return scale_actions(self._config, actions)

    def scans(self) -> F32:
        """Return scans (W, n_rays) [m]."""
        return self.simulator.observe()[0]

    def robot_states(self) -> F32:
        """Return robot states (W, 5): goal x, y, vx, vy, omega, robot frame."""
        return self.simulator.robot_states()

    def poses(self) -> F64:
        """Return x, y, theta of the robots (W, 3)."""
        poses = self.simulator.poses()
        poses[:, :2] += self.simulator.origins
        return poses

    def radii(self) -> F64:
        """Return the robots' radii (W,)."""
        return self.simulator.radii()

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
        return np.maximum(to_goal - self.radii(), 0.0)

    def orca(self) -> F64:
        """Return the velocities (W, 2) that ORCA chooses for robots that see all humans [m/s]."""
        return self.simulator.orca_velocities()

    def targets(self) -> F64:
        """Return points (W, 2) to head for: ahead on the planned path, or the goals where there is no map."""
        return self.simulator.waypoints() + self.simulator.origins

    def speed(self) -> float:
        """Return the velocity that an action of 1 stands for [m/s]."""
        return self.robot.max_speed
