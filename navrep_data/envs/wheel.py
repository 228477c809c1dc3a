"""A policy at the wheel of an environment's robots."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.envs.single import NavRepEnv
from navrep_data.policies import AnyPolicy, Driver, resolve_policy


class Wheel:
    """Chooses the actions of a single environment, for films and for watching.

    Parameters
    ----------
    env : NavRepEnv
        The environment, without its wrappers.
    policy : str, callable or BasePolicy
        See :func:`navrep_data.policies.resolve_policy`.
    """

    def __init__(self, env: NavRepEnv, policy: AnyPolicy) -> None:
        self._env = env
        self._rows = env.config.robots
        self._driver = Driver(resolve_policy(policy).make(self._rows))
        self._started = False

    def begin(self, info: dict[str, Any]) -> None:
        """Begin the episode that a reset with this info has drawn."""
        if not self._started:
            self._driver.start(self._env.simulator)
            self._started = True
        self._driver.reset(np.ones(self._rows, np.bool_), np.full(self._rows, info.get("seed", 0), np.int64))

    def action(self) -> NDArray[np.float32]:
        """Return the action for ``env.step``, in [-1, 1]."""
        seen = self._env.seen
        assert seen is not None
        commands = self._driver.commands(self._env.simulator, seen=(seen["scan"], seen["robot_state"]))
        # one world: its only row, or that of all its robots
        shares: NDArray[np.float32] = (commands[0] / np.asarray(self._env.config.max_velocity)).astype(np.float32)
        return shares
