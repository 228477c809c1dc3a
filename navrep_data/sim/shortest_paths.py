"""Shortest paths through the maps of scenarios."""

from __future__ import annotations

from functools import cache

import numpy as np

from navrep_data.sim._fast_marching import UPWIND_FINAL, march
from navrep_data.sim.map_tables import RADIUS
from navrep_data.sim.maps import load_map
from navrep_data.sim.scenarios import get_scenario

COARSE = 0.16
"""Shortest paths are looked for on cells of at most this side [m], where the map is as fine."""


@cache
def shortest_path(scenario: str) -> float:
    """Return the length of the robot's shortest path from start to goal in a scenario, humans left out [m].

    Parameters
    ----------
    scenario : str
        Name of the scenario.

    Notes
    -----
    Fast marching at unit speed over blocks of cells, of which at least one leaves the robot's disc room; never less
    than the straight line.
    """
    recipe = get_scenario(scenario)
    grid = load_map(recipe.map)
    room = grid.signed_distance() >= np.float32(RADIUS)
    block = max(1, int(COARSE / grid.resolution))
    # cells beyond the last whole block count as closed
    width, height = (-(-n // block) * block for n in room.shape)
    padded = np.zeros((width, height), np.bool_)
    padded[: room.shape[0], : room.shape[1]] = room
    speeds = padded.reshape(width // block, block, height // block, block).any(axis=(1, 3)).astype(np.float32)
    start, goal = (grid.cell_of(xy) // block for xy in (recipe.starts[:1, :2], recipe.goals[:1]))
    field = np.empty(speeds.shape, np.float32)
    march(speeds, int(goal[0, 0]), int(goal[0, 1]), UPWIND_FINAL, field)
    straight = float(np.hypot(*(recipe.goals[0] - recipe.starts[0, :2])))
    found = float(field[start[0, 0], start[0, 1]]) * block * grid.resolution
    # the start lies closer to a wall than the robot's radius, by less than a cell: there is no better bound then
    return max(straight, found) if np.isfinite(found) else straight
