"""Policies that need no weights: straight to the goal, random, ORCA, and the dynamic window on the scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from navrep_data.evaluate import _dwa
from navrep_data.evaluate.pilots import Pilot
from navrep_data.evaluate.suite_worlds import SuiteWorlds
from navrep_data.observations import fill_blind

F64 = NDArray[np.float64]


class GoalPilot(Pilot):
    """Straight to the goal: its direction, as long as the action's box allows.

    Notes
    -----
    The larger component of the action is 1. This is the rule behind the 15.0 % of the original's control on its test
    episodes: a unit vector gives 13.5 % there, each component clipped by itself 9.0 %, measured in `original` physics.
    Where the norm is limited (IAN) all of these are the same but the last.
    """

    name = "goal"
    sees = "goal only"
    text = "straight to the goal"

    def act(self, worlds: SuiteWorlds) -> F64:
        """Return actions (W, 3)."""
        return _box(worlds.robot_states()[:, :2].astype(np.float64))


class RandomPilot(Pilot):
    """Uniform in the action's box, anew at every step, seeded by the episode."""

    name = "random"
    sees = "nothing"
    text = "uniform random velocities"

    def __init__(self) -> None:
        self._streams: dict[int, np.random.Generator] = {}

    def start(self, worlds: SuiteWorlds, mask: NDArray[np.bool_], episodes: NDArray[np.int64]) -> None:
        """Give every new episode a stream of its own."""
        for w in np.flatnonzero(mask):
            self._streams[int(w)] = np.random.default_rng([int(episodes[w]), 20_200_916])

    def act(self, worlds: SuiteWorlds) -> F64:
        """Return actions (W, 3)."""
        actions = np.zeros((worlds.n, 3))
        for w, stream in self._streams.items():
            actions[w, :2] = stream.uniform(-1.0, 1.0, 2)
        return actions


class OrcaPilot(Pilot):
    """ORCA with the original's parameters; knows every human and obstacle, and on maps the planned path."""

    name = "orca"
    sees = "true humans"
    sees_on_maps = "true humans, map"
    text = "ORCA among all humans and obstacles"

    def act(self, worlds: SuiteWorlds) -> F64:
        """Return actions (W, 3)."""
        actions = np.zeros((worlds.n, 3))
        actions[:, :2] = _to_robot_frame(worlds.orca(), worlds.poses()[:, 2]) / worlds.speed()
        return actions


class DwaPilot(Pilot):
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
    needs_scan = True

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

    def act(self, worlds: SuiteWorlds) -> F64:
        """Return actions (W, 3)."""
        s, sensor = self._settings, worlds.sensor
        s[_dwa.D_MAX_SPEED] = worlds.speed()
        s[_dwa.D_DT], s[_dwa.D_RANGE_MAX] = sensor.dt, sensor.range_max
        s[_dwa.D_ANGLE_MIN], s[_dwa.D_ANGLE_INCREMENT] = sensor.angle_min, sensor.angle_increment
        poses = worlds.poses()
        targets = _to_robot_frame(worlds.targets() - poses[:, :2], poses[:, 2])
        chosen = np.zeros((worlds.n, 2))
        points = np.zeros((sensor.n_rays, 2))
        _dwa.choose_all(fill_blind(worlds.scans()), worlds.robot_states(), targets, worlds.radii(), s, points, chosen)
        actions = np.zeros((worlds.n, 3))
        actions[:, :2] = chosen / worlds.speed()
        return actions


def _box(vectors: F64) -> F64:
    """Return vectors (W, 2) as long as the box [-1, 1]^2 allows, with a third column of zeros."""
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    scaled = vectors / np.where(largest > 0.0, largest, 1.0)
    return np.concatenate([scaled, np.zeros((len(vectors), 1))], axis=1)


def _to_robot_frame(vectors: F64, theta: F64) -> F64:
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c * vectors[:, 0] + s * vectors[:, 1], c * vectors[:, 1] - s * vectors[:, 0]], axis=1)
