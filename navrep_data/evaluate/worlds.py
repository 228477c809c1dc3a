"""What a suite's worlds must do, and the worlds of procedural polygons."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from navrep_data.evaluate._polygons import orca_robots, polygon_gaps
from navrep_data.schema import RobotContract, SensorContract
from navrep_data.sim import SimConfig, Simulator, Touches, robot_contract, scale_actions
from navrep_data.sim import _layout as lay

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


class Worlds(Protocol):
    """A batch of worlds that play numbered episodes; everything in metres and seconds, world frame.

    Attributes
    ----------
    n : int
        Number of worlds W.
    sensor : SensorContract
        What scans are.
    robot : RobotContract
        What robot it is, as policies are told.
    """

    n: int
    sensor: SensorContract
    robot: RobotContract

    def reset(self, mask: Mask, seeds: NDArray[np.int64], scenarios: NDArray[np.int64]) -> None:
        """Start episodes in the worlds of `mask` (W,): numpy seed and index of the scenario, both (W,)."""

    def step(self, actions: F64) -> NDArray[np.uint8]:
        """Execute actions (W, 3) in [-1, 1] and return :class:`navrep_data.schema.Event` codes (W,)."""

    def commands(self, actions: F64) -> F64:
        """Return what robots are sent for actions (W, 3): body velocities [m/s, m/s, rad/s], within their limits."""

    def scans(self) -> F32:
        """Return scans (W, n_rays) [m]."""

    def robot_states(self) -> F32:
        """Return robot states (W, 5): goal x, y, vx, vy, omega, robot frame."""

    def poses(self) -> F64:
        """Return x, y, theta of the robots (W, 3)."""

    def radii(self) -> F64:
        """Return the robots' radii (W,)."""

    def touches(self) -> Touches:
        """Return whom and what the robots touched during the last step."""

    def gaps(self) -> tuple[F64, F64]:
        """Return the gaps between the robots' edges and the nearest human and obstacle, both (W,)."""

    def shortest(self) -> F64:
        """Return the lengths of the shortest paths from where the robots are to where the goal is reached (W,)."""

    def orca(self) -> F64:
        """Return the velocities (W, 2) that ORCA chooses for robots that see all humans [m/s]."""

    def targets(self) -> F64:
        """Return points (W, 2) to head for: ahead on the planned way, or the goals where there is no map."""

    def speed(self) -> float:
        """Return the velocity that an action of 1 stands for [m/s]."""


class PolygonWorlds:
    """Worlds of procedural polygons: an action of 1 is the config's `max_velocity` along each axis.

    Parameters
    ----------
    config : SimConfig
        Of an environment with numpy-seeded episodes.
    n : int
        Number of worlds.

    Notes
    -----
    The shortest path is taken to be the straight line, as far as the goal's edge: a lower bound, obstacles are not
    gone round, so SPL is a lower bound too.
    """

    def __init__(self, config: SimConfig, n: int) -> None:
        self.n = n
        self.sensor = config.sensor
        self.robot = robot_contract(config)
        self.simulator = Simulator(config, n)
        self._velocities = np.zeros((n, 2))
        self._gaps = np.zeros((2, n))

    def reset(self, mask: Mask, seeds: NDArray[np.int64], scenarios: NDArray[np.int64]) -> None:
        """Start the episodes of numpy seeds; there is one scenario."""
        self.simulator.reset_seeded(seeds, mask)

    def step(self, actions: F64) -> NDArray[np.uint8]:
        """Execute actions as shares of the largest velocity."""
        return self.simulator.step(self.commands(actions))[1]

    def commands(self, actions: F64) -> F64:
        """See :class:`Worlds`."""
        return scale_actions(self.simulator.config, actions)

    def scans(self) -> F32:
        """See :class:`Worlds`."""
        return self.simulator.observe()[0]

    def robot_states(self) -> F32:
        """See :class:`Worlds`."""
        return self.simulator.robot_states()

    def _robots(self, columns: int | list[int]) -> F64:
        found: F64 = self.simulator.arrays.agents[:, 0, columns]
        return found

    def poses(self) -> F64:
        """See :class:`Worlds`."""
        return self._robots([lay.A_X, lay.A_Y, lay.A_HEADING])

    def goals(self) -> F64:
        """Return the goals (W, 2)."""
        return self._robots([lay.A_GX, lay.A_GY])

    def radii(self) -> F64:
        """See :class:`Worlds`."""
        return self._robots(lay.A_RADIUS)

    def touches(self) -> Touches:
        """See :class:`Worlds`."""
        return self.simulator.touches()

    def gaps(self) -> tuple[F64, F64]:
        """See :class:`Worlds`."""
        a = self.simulator.arrays
        polygon_gaps(a.agents, a.scalars, a.edges, a.polygon_start, *self._gaps)
        return self._gaps[0], self._gaps[1]

    def shortest(self) -> F64:
        """See :class:`Worlds` and the notes of this class."""
        to_goal: F64 = np.linalg.norm(self.goals() - self.poses()[:, :2], axis=1)
        return np.maximum(to_goal - self.radii(), 0.0)

    def orca(self) -> F64:
        """See :class:`Worlds`."""
        a = self.simulator.arrays
        orca_robots(
            a.agents, a.agents32, a.scalars, a.obst_f, a.obst_i, a.orca_params, a.work_f, a.work_i, self._velocities
        )
        return self._velocities

    def targets(self) -> F64:
        """Return the goals: there is no map."""
        return self.goals()

    def speed(self) -> float:
        """See :class:`Worlds`."""
        return self.robot.max_speed
