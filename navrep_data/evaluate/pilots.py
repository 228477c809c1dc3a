"""Whatever drives the robots of a benchmark: networks of the zoo, functions, and the interface of the baselines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import PolicyError
from navrep_data.evaluate.suite_worlds import SuiteWorlds
from navrep_data.schema import ACTION_SIZE
from navrep_data.sim.driving import listens, policy_for

F64 = NDArray[np.float64]
BLOCK = 64
"""Rows that a network or function always sees, so that its numbers do not depend on how many worlds there are."""


class Pilot(ABC):
    """Drives the robots of a batch of worlds.

    Attributes
    ----------
    name : str
        Full name, as in results.
    sees : str
        What it is told beside the goal and its own velocity: scan, map, true humans.
    sees_on_maps : str
        The same in worlds on maps, empty where it does not differ.
    text : str
        One line on what it is.
    needs_scan : bool
        Whether it reads scans, which cost the simulator most of its time.
    max_worlds : int or None
        Most worlds that it drives at once.
    grouped : bool
        True where episodes must start together: 64 consecutive ones, the first of them divisible by 64, each in its
        own row whether or not the others are played.
    """

    name: str
    sees: str
    sees_on_maps: str = ""
    text: ClassVar[str] = ""
    needs_scan: bool = False
    max_worlds: int | None = None
    grouped: bool = False

    def start(self, worlds: SuiteWorlds, mask: NDArray[np.bool_], episodes: NDArray[np.int64]) -> None:
        """Begin the numbered episodes (W,) in the worlds of `mask` (W,)."""
        return

    @abstractmethod
    def act(self, worlds: SuiteWorlds) -> F64:
        """Return the actions of all worlds (W, 3), in [-1, 1] where they are not to be clipped."""

    def observe(self, executed: F64) -> None:
        """Hear what the robots were sent for the last actions: body velocities (W, 3) [m/s, m/s, rad/s]."""
        return


class FunctionPilot(Pilot):
    """A callable ``policy(scan, robot_state) -> action`` over 64 rows; rows beyond the worlds' are copies of the first.

    Parameters
    ----------
    name : str
        As in results.
    function : callable
        Takes scans (64, 1080) [m] and robot states (64, 5), returns (64, 2) or (64, 3) in [-1, 1]. If it has a method
        ``reset`` that is called as ``reset(batch_size=64)`` at first and ``reset(mask=...)`` where episodes begin; a
        method ``observe`` is called with (64, 3) after every step: what the robots were sent [m/s, m/s, rad/s].
    """

    sees = "scan"
    needs_scan = True
    max_worlds = BLOCK

    def __init__(self, name: str, function: Callable[[Any, Any], Any]) -> None:
        self.name = name
        self._function = function
        self._reset: Callable[..., Any] | None = getattr(function, "reset", None)
        self._observe: Callable[[Any], Any] | None = getattr(function, "observe", None)
        self._started = False

    def start(self, worlds: SuiteWorlds, mask: NDArray[np.bool_], episodes: NDArray[np.int64]) -> None:
        """Tell a function with memory where episodes begin."""
        if self._reset is None:
            return
        if not self._started:
            self._reset(batch_size=BLOCK)
            self._started = True
        rows = np.zeros(BLOCK, np.bool_)
        rows[: len(mask)] = mask
        self._reset(mask=rows)

    def act(self, worlds: SuiteWorlds) -> F64:
        """Return actions (W, 3)."""
        actions = np.asarray(self._function(_fill_up(worlds.scans()), _fill_up(worlds.robot_states())), np.float64)
        if actions.shape not in ((BLOCK, 2), (BLOCK, ACTION_SIZE)):
            raise PolicyError(
                f"Policy {self.name!r} returned shape {actions.shape}, expected ({BLOCK}, 3) or ({BLOCK}, 2): vx, vy, "
                "omega in [-1, 1], one row per scan."
            )
        if not np.isfinite(actions).all():
            raise PolicyError(f"Policy {self.name!r} returned NaN or infinity, expected numbers in [-1, 1].")
        padded = np.zeros((worlds.n, ACTION_SIZE))
        padded[:, : actions.shape[1]] = actions[: worlds.n]
        return padded

    def observe(self, executed: F64) -> None:
        """Tell a function with memory what the robots were sent."""
        if self._observe is not None:
            self._observe(_fill_up(executed).astype(np.float32))


class ZooPilot(FunctionPilot):
    """A released or trained network, by name.

    Parameters
    ----------
    policy : navrep_data.zoo.policy.Policy
        What :func:`navrep_data.zoo.load` returned.
    first_seed : int
        ``"as_released"`` starts its noise at ``first_seed + k`` for the 64 episodes from k on.
    scaling : str
        ``"robot"``: where the worlds' robot is not that of the policy's training, it sees and moves in proportion, see
        :meth:`navrep_data.zoo.policy.Policy.for_robot`. ``"none"``: as trained.

    Notes
    -----
    Memories are told the velocity that each robot was sent, which is what they were trained on. Ranges as released are
    part of running the authors' software as it is: there they got the network's own action, in whatever unit.
    """

    def __init__(self, policy: Any, first_seed: int, scaling: str = "robot") -> None:
        super().__init__(policy.name, policy.act)
        self._policy = policy
        self._first_seed = first_seed
        self._scaling = scaling
        self.grouped = policy.inference == "as_released"
        self._use(policy)

    def _use(self, policy: Any) -> None:
        self._policy, self._function, self._reset = policy, policy.act, policy.reset
        self._observe = policy.observe if listens(policy) else None

    def start(self, worlds: SuiteWorlds, mask: NDArray[np.bool_], episodes: NDArray[np.int64]) -> None:
        """Clear the memory of new episodes, and start the noise of a group."""
        if self._scaling == "robot":
            fitting = policy_for(self._policy, worlds.robot)
            if fitting is not self._policy:
                self._use(fitting)
        if self.grouped:
            first = int(episodes[mask][0]) // BLOCK * BLOCK
            self._policy.reset(batch_size=BLOCK, seed=self._first_seed + first)
        else:
            super().start(worlds, mask, episodes)


def _fill_up(rows: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([rows, np.repeat(rows[:1], BLOCK - len(rows), axis=0)])
