"""Networks as policies: they know what robot they were trained on, and remember what was executed.

What they are is told by their methods, so that nothing here needs torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.policies.functions import BLOCK, FunctionPolicy
from navrep_data.policies.protocol import Context
from navrep_data.schema import RobotContract


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


class NetworkPolicy(FunctionPolicy):
    """A policy that knows robots, such as what :func:`navrep_data.zoo.load` returns.

    Parameters
    ----------
    policy : object
        With ``act(scan, robot_state)``, ``reset``, ``observe(executed)``, ``for_robot(max_speed, radius)`` and
        ``robot``.
    rows : int
        Rows that it always sees.
    first_seed : int
        ``"as_released"`` starts its noise at ``first_seed + k`` for the 64 episodes from seed k on.
    scaling : str
        ``"robot"``: where the robot is not that of the policy's training, it sees and moves in proportion, see
        :meth:`navrep_data.zoo.policy.Policy.for_robot`. ``"none"``: as trained.

    Notes
    -----
    Memories are told the velocity that each robot was sent, which is what they were trained on. Ranges as released are
    part of running the authors' software as it is: there they got the network's own action, in whatever unit.
    """

    steers = True

    def __init__(self, policy: Any, rows: int = BLOCK, first_seed: int = 0, scaling: str = "robot") -> None:
        super().__init__(str(getattr(policy, "name", "") or type(policy).__name__), policy.act, rows)
        self._loaded = policy
        self._first_seed = first_seed
        self._scaling = scaling
        self.grouped = getattr(policy, "inference", "deterministic") == "as_released"
        self.use(policy.act, policy, listens(policy))

    def start(self, context: Context) -> None:
        """Take the policy for this robot, and refuse a sensor that it was not made for."""
        super().start(context)
        check = getattr(self._loaded, "check_sensor", None)
        if check is not None:
            check(context.sensor)
        if self._scaling == "robot":
            fitting = policy_for(self._loaded, context.robot)
            self.use(fitting.act, fitting, listens(fitting))

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64]) -> None:
        """Clear the memory of new episodes, and start the noise of a group."""
        if self.grouped and self._fresh and self._reset is not None:
            first = int(seeds[mask][0]) // BLOCK * BLOCK
            self._reset(batch_size=self.rows, seed=self._first_seed + first)
            self._fresh = False
        else:
            super().reset(mask, seeds)
