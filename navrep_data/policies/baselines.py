"""Policies that need no weights: straight to the goal, random, ORCA, and the dynamic window on the scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.observations import fill_blind
from navrep_data.policies import _dwa
from navrep_data.policies.protocol import BasePolicy, Context, Observation

F64 = NDArray[np.float64]

_RANDOM_STREAM = 20_200_916
"""Beside the episode's seed: so that no other stream of that seed is the same."""


def to_goal(robot_state: ArrayLike) -> F64:
    """Return actions (..., 3) straight to the goal, as fast as the box of actions allows.

    Parameters
    ----------
    robot_state : array_like of shape (..., 5)
        Goal x, goal y [m], ...; robot frame.

    Notes
    -----
    The larger component of the action is 1. This is the rule behind the 15.0 % of the original's control on its test
    episodes: a unit vector gives 13.5 % there, each component clipped by itself 9.0 %, measured in `original` physics.
    Where the norm is limited (IAN) all of these are the same but the last.
    """
    goals = np.asarray(robot_state)[..., :2].astype(np.float64)
    largest = np.abs(goals).max(axis=-1, keepdims=True)
    scaled = goals / np.where(largest > 0.0, largest, 1.0)
    return np.concatenate([scaled, np.zeros((*goals.shape[:-1], 1))], axis=-1)


class GoalPolicy(BasePolicy):
    """Straight to the goal, whatever is in the way; see :func:`to_goal`."""

    name = "goal"
    sees = "goal only"
    text = "straight to the goal"

    def act(self, observation: Observation) -> F64:
        """Return actions (B, 3)."""
        return to_goal(observation.robot_state)


class RandomPolicy(BasePolicy):
    """Uniform in the action's box, anew at every step, seeded by the episode."""

    name = "random"
    sees = "nothing"
    text = "uniform random velocities"

    def __init__(self) -> None:
        self._streams: dict[int, np.random.Generator] = {}

    def start(self, context: Context) -> None:
        """Forget the streams of other episodes."""
        self._streams.clear()

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64]) -> None:
        """Give every new episode a stream of its own."""
        for row in np.flatnonzero(mask):
            self._streams[int(row)] = np.random.default_rng([int(seeds[row]), _RANDOM_STREAM])

    def act(self, observation: Observation) -> F64:
        """Return actions (B, 3)."""
        actions = np.zeros((len(observation.robot_state), 3))
        for row, stream in self._streams.items():
            actions[row, :2] = stream.uniform(-1.0, 1.0, 2)
        return actions


class OrcaPolicy(BasePolicy):
    """ORCA with the original's parameters; knows every human and obstacle, and on maps the planned path."""

    name = "orca"
    sees = "true humans"
    sees_on_maps = "true humans, map"
    text = "ORCA among all humans and obstacles"
    needs = frozenset({"orca_velocity"})
    _speed = 1.0

    def start(self, context: Context) -> None:
        """Take note of the robot's top speed."""
        self._speed = context.robot.max_speed

    def act(self, observation: Observation) -> F64:
        """Return actions (B, 3)."""
        return np.pad(observation.orca_velocity / self._speed, ((0, 0), (0, 1)))


class DwaPolicy(BasePolicy):
    """The dynamic window approach on the scan; on maps it heads for a point ahead on the planned path.

    Parameters
    ----------
    acceleration : float
        Of the window and for stopping [m/s^2].
    horizon : float
        Of the forward simulation [s].
    margin : float
        Kept beside the robot's radius [m].
    clearance : float
        More is not better [m].
    weights : tuple of float
        Of progress, clearance and speed.

    Notes
    -----
    Everything in the scan is taken to stand still, as in the original paper (Fox, Burgard, Thrun 1997). The robot
    knows its own radius. The settings were chosen on the training environment's worlds, not on a suite's.
    """

    name = "dwa"
    sees = "scan"
    sees_on_maps = "scan, map"
    text = "dynamic window on the scan"
    needs = frozenset({"scan", "waypoint", "radius"})

    def __init__(
        self,
        acceleration: float = 2.5,
        horizon: float = 2.0,
        margin: float = 0.1,
        clearance: float = 0.6,
        weights: tuple[float, float, float] = (1.0, 1.2, 0.1),
    ) -> None:
        self._settings = np.zeros(_dwa.SETTINGS)
        self._settings[_dwa.D_ACCELERATION] = acceleration
        self._settings[_dwa.D_HORIZON] = horizon
        self._settings[_dwa.D_MARGIN] = margin
        self._settings[_dwa.D_CLEARANCE] = clearance
        self._settings[[_dwa.D_WEIGHT_PROGRESS, _dwa.D_WEIGHT_CLEARANCE, _dwa.D_WEIGHT_SPEED]] = weights

    def start(self, context: Context) -> None:
        """Take note of the robot's top speed and its sensor."""
        s, sensor = self._settings, context.sensor
        s[_dwa.D_MAX_SPEED] = context.robot.max_speed
        s[_dwa.D_DT], s[_dwa.D_RANGE_MAX] = sensor.dt, sensor.range_max
        s[_dwa.D_ANGLE_MIN], s[_dwa.D_ANGLE_INCREMENT] = sensor.angle_min, sensor.angle_increment

    def act(self, observation: Observation) -> F64:
        """Return actions (B, 3)."""
        scans, states, s = fill_blind(observation.scan), observation.robot_state, self._settings
        chosen, points = np.zeros((len(scans), 2)), np.zeros((scans.shape[1], 2))
        _dwa.choose_all(scans, states, observation.waypoint, observation.radius[:, 0], s, points, chosen)
        return np.pad(chosen / s[_dwa.D_MAX_SPEED], ((0, 0), (0, 1)))


BASELINES: dict[str, type[BasePolicy]] = {
    policy.name: policy for policy in (GoalPolicy, RandomPolicy, OrcaPolicy, DwaPolicy)
}
"""Policies without weights, by name."""
