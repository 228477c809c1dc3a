"""Policies that know of robots, such as those of the zoo, as an environment's robot drives by them.

They return shares of a top speed, see other robots in proportion and remember what was executed. What they are is told
by their methods, so that nothing here needs torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.schema import RobotContract
from navrep_data.sim.actions import robot_contract, scale_actions, velocity_commands
from navrep_data.sim.config import SimConfig


def knows_robots(policy: Any) -> bool:
    """Return whether a policy says what robot it drives, and can be had for another."""
    return all(hasattr(policy, name) for name in ("act", "for_robot", "observe", "reset", "robot"))


def listens(policy: Any) -> bool:
    """Return whether such a policy is scaled and told what was executed: as released, networks were neither."""
    return getattr(policy, "ranges", "contract") != "as_released"


def policy_for(policy: Any, robot: RobotContract) -> Any:
    """Return a policy that knows robots for this robot: itself where it is for that one or never scaled."""
    if not listens(policy) or policy.robot == robot:
        return policy
    return policy.for_robot(robot.max_speed, robot.radius)


class RobotPolicy:
    """A policy that knows robots, driving that of an environment.

    Parameters
    ----------
    policy : object
        With ``act(scan, robot_state)``, ``reset``, ``observe(executed)``, ``for_robot(max_speed, radius)`` and
        ``robot``, such as what :func:`navrep_data.zoo.load` returns.
    config : SimConfig
        The environment: its robot, drive and largest velocities.
    """

    def __init__(self, policy: Any, config: SimConfig) -> None:
        self.policy = policy_for(policy, robot_contract(config))
        self._config = config

    def reset(self, **options: Any) -> None:
        """Start episodes: ``batch_size=B``, or ``mask=(B,)`` for some of them."""
        self.policy.reset(**options)

    def __call__(self, scan: ArrayLike, robot_state: ArrayLike) -> NDArray[np.float64]:
        """Return the commands (B, 3) [m/s, m/s, rad/s] for scans (B, n_rays) [m] and robot states (B, 5).

        They are what the robots execute, and what the policy's memory is told.
        """
        shares = np.asarray(self.policy.act(scan, robot_state))
        if self._config.drive == "differential":
            commands = velocity_commands(self._config, shares[..., :2])
        else:
            commands = scale_actions(self._config, shares)
        if listens(self.policy):
            self.policy.observe(commands.astype(np.float32))
        return commands

    def shares(self, scan: ArrayLike, robot_state: ArrayLike) -> NDArray[np.float64]:
        """Return the same commands as shares of the robot's largest velocities, as environments take them."""
        shares: NDArray[np.float64] = self(scan, robot_state) / np.asarray(self._config.max_velocity)
        return shares
