"""What lies behind trajectories: a scenario's map, start, goal and humans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import MissingExtraError
from navrep_data.sim.maps import load_map
from navrep_data.sim.scenarios import get_scenario

F64 = NDArray[np.float64]

LOITER = 0.5
"""Humans whose start is nearer to their goal than this stay there [m]."""


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
    """Return what to draw behind the trajectories of a scenario; without the maps extra, all but the map."""
    recipe = get_scenario(scenario)
    try:
        grid = load_map(recipe.map)
    except MissingExtraError:
        occupied, extent = None, (0.0, 1.0, 0.0, 1.0)
    else:
        occupied, extent = grid.occupied, grid.extent
    humans = recipe.starts[1:, :2]
    far = np.linalg.norm(recipe.goals[1:] - humans, axis=1) >= LOITER
    return Backdrop(occupied, extent, recipe.starts[0, :2], recipe.goals[0], humans, far)
