"""What lies behind trajectories: a scenario's map, start, goal and humans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Backdrop:
    """A scenario as figures show it; world frame, metres.

    Attributes
    ----------
    occupied : ndarray of shape (W, H), bool, or None
        Cells of the map, [column, row counted from the bottom]; None where the map is not installed.
    extent : tuple of float
        x0, x1, y0, y1 of the map.
    start, goal : ndarray of shape (2,)
        Of the robot.
    humans : ndarray of shape (n, 2)
        Where humans start.
    moves : ndarray of shape (n,), bool
        Whether they go anywhere.
    """

    occupied: NDArray[np.bool_] | None
    extent: tuple[float, float, float, float]
    start: F64
    goal: F64
    humans: F64
    moves: NDArray[np.bool_]


def backdrop(scenario: str) -> Backdrop:
    """Return what to draw behind the trajectories of a scenario."""
    raise NotImplementedError
