"""What an episode was like, from the path that the robot took; see :data:`METRICS` for every definition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]

PERSONAL_SPACE = 0.2
"""Gap to a human [m] below which a robot is in its personal space: the paper's danger distance."""
STOPPED_SPEED = 0.05
"""Speed [m/s] below which a robot counts as stopped: a tenth of the slower suite's largest, above rounding."""
METRES_PER_KM = 1000.0


@dataclass(frozen=True)
class Metric:
    """How a number per episode is called, and over which episodes its mean is taken.

    Attributes
    ----------
    name : str
        Key in results.
    unit : str
        Unit, empty if none.
    text : str
        Definition, one line.
    successes_only : bool
        True where only episodes count that reached the goal.
    """

    name: str
    unit: str
    text: str
    successes_only: bool = False


METRICS: tuple[Metric, ...] = (
    Metric("time_to_goal", "s", "steps x time step, of the episodes that reached the goal", successes_only=True),
    Metric("path_length", "m", "sum of the distances between the robot's positions one step apart"),
    Metric("spl", "", "success as released, weighted by path length: success x shortest / max(shortest, path length)"),
    Metric(
        "min_clearance",
        "m",
        "smallest gap between the robot's edge and a human's disc or an obstacle (of those within a metre, on maps)",
    ),
    Metric("personal_space_time", "s", "time with the nearest human's disc less than 0.2 m from the robot's edge"),
    Metric(
        "time_stopped", "s", "time at a speed below 0.05 m/s; speed = distance between positions one step apart / dt"
    ),
    Metric("mean_jerk", "m/s^3", "mean norm of the second difference of the velocity over the time step squared"),
)
"""All means that results hold beside the shares of success, collision and timeout."""

RATIOS: tuple[Metric, ...] = (
    Metric("contacts_per_km", "1/km", "all contacts of all episodes / all path lengths; intervals resample episodes"),
    Metric(
        "personal_space_share", "", "all time in personal space / all time: the share of time under 0.2 m from people"
    ),
)
"""Ratios of sums over episodes."""

CONTACT_TEXT = (
    "contact: a maximal run of steps in which the robot touches the same person, or static matter, by the rule of the "
    "simulator's collisions, whether it does damage or not"
)


@dataclass(frozen=True)
class Contacts:
    """What a robot touched in an episode.

    Attributes
    ----------
    human : int
        Number of contacts with people: for every person the maximal runs of steps in touch.
    obstacle : int
        The same with static matter: walls, obstacles, the border, the map's edge.
    speed : float
        Largest speed at a contact [m/s]: with people the norm of the difference of both velocities, with matter the
        robot's own speed. NaN without a contact.
    """

    human: int = 0
    obstacle: int = 0
    speed: float = float("nan")

    @property
    def total(self) -> int:
        """Number of all contacts."""
        return self.human + self.obstacle


def path_length(positions: ArrayLike) -> float:
    """Return the length of a path [m].

    Parameters
    ----------
    positions : array_like of shape (T + 1, 2)
        Where the robot was before each step and after the last [m].
    """
    steps = np.diff(_points(positions), axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


def spl(success: bool, shortest: float, length: float) -> float:
    """Return success weighted by path length, 0 to 1 (Anderson et al. 2018, arXiv:1807.06757).

    Parameters
    ----------
    success : bool
        Whether the goal was reached.
    shortest : float
        Length of the shortest path from the start to where the goal counts as reached [m].
    length : float
        Length of the path that was taken [m].
    """
    if not success:
        return 0.0
    longest = max(shortest, length)
    return 1.0 if longest <= 0.0 else shortest / longest


def min_clearance(human_gaps: ArrayLike, static_gaps: ArrayLike) -> float:
    """Return the smallest gap to anything [m], NaN where there was nothing.

    Parameters
    ----------
    human_gaps, static_gaps : array_like of shape (T + 1,)
        Gap between the robot's edge and the nearest human's disc, or the nearest obstacle, at every moment [m];
        negative where they overlap, infinite where there is none.
    """
    smallest = min(float(np.min(human_gaps)), float(np.min(static_gaps)))
    return smallest if np.isfinite(smallest) else float("nan")


def personal_space_time(human_gaps: ArrayLike, dt: float) -> float:
    """Return for how long the nearest human was less than 0.2 m away [s].

    Parameters
    ----------
    human_gaps : array_like of shape (T + 1,)
        As for :func:`min_clearance`. The first moment, before any step, does not count.
    dt : float
        Time step [s].
    """
    return float(np.count_nonzero(np.asarray(human_gaps, np.float64)[1:] < PERSONAL_SPACE)) * dt


def time_stopped(positions: ArrayLike, dt: float) -> float:
    """Return for how long the robot was slower than 0.05 m/s [s].

    Parameters
    ----------
    positions : array_like of shape (T + 1, 2)
        As for :func:`path_length`.
    dt : float
        Time step [s].
    """
    steps = np.diff(_points(positions), axis=0)
    return float(np.count_nonzero(np.hypot(steps[:, 0], steps[:, 1]) < STOPPED_SPEED * dt)) * dt


def mean_jerk(positions: ArrayLike, dt: float) -> float:
    """Return the mean norm of the jerk [m/s^3], NaN for paths of less than three steps.

    Parameters
    ----------
    positions : array_like of shape (T + 1, 2)
        As for :func:`path_length`.
    dt : float
        Time step [s].

    Notes
    -----
    Velocity = difference of positions / dt, jerk = second difference of the velocity / dt^2, world frame.
    """
    points = _points(positions)
    if len(points) < 4:
        return float("nan")
    jerk = np.diff(points, n=3, axis=0) / dt**3
    return float(np.hypot(jerk[:, 0], jerk[:, 1]).mean())


def measure(
    positions: ArrayLike, human_gaps: ArrayLike, static_gaps: ArrayLike, dt: float, success: bool, shortest: float
) -> dict[str, float]:
    """Return every metric of one episode by name; NaN where it means nothing.

    Parameters
    ----------
    positions : array_like of shape (T + 1, 2)
        Where the robot was [m].
    human_gaps, static_gaps : array_like of shape (T + 1,)
        As for :func:`min_clearance`.
    dt : float
        Time step [s].
    success : bool
        Whether the goal was reached.
    shortest : float
        As for :func:`spl` [m].
    """
    points = _points(positions)
    length = path_length(points)
    return {
        "time_to_goal": (len(points) - 1) * dt if success else float("nan"),
        "path_length": length,
        "spl": spl(success, shortest, length),
        "min_clearance": min_clearance(human_gaps, static_gaps),
        "personal_space_time": personal_space_time(human_gaps, dt),
        "time_stopped": time_stopped(points, dt),
        "mean_jerk": mean_jerk(points, dt),
    }


def _points(positions: ArrayLike) -> F64:
    return np.asarray(positions, np.float64).reshape(-1, 2)
