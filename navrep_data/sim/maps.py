"""The paper's 23 maps by name, any map_server folder by path, and the time that planned humans take to a goal.

The paper's maps come with the optional package asl-pepper-2d-sim, which states no licence.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ConfigError, MapError, MissingExtraError, UnknownNameError, did_you_mean
from navrep_data.sim import _fast_marching
from navrep_data.sim._map_cache import RecentArrays
from navrep_data.sim._maps import (
    YAML_SUFFIXES,
    MapDescription,
    is_bare,
    occupancy_of,
    packaged_folder,
    read_description,
    read_grey,
    yaml_in_folder,
)
from navrep_data.sim.gridmap import GridMap

__all__ = [
    "GridMap",
    "OccupancyRule",
    "goal_field",
    "is_packaged",
    "load_map",
    "map_names",
    "planning_map",
    "planning_speeds",
]

OccupancyRule = Literal["original", "ros"]

# Speed of a planned human (pyIAN cia.pyx), in cells per unit of time: 1 / (1 + c) with
# c = NEAR_COST / (NEAR_SOFTENING + d^2), and WALL_COST more closer than WALL_DISTANCE [m].
NEAR_COST, NEAR_SOFTENING, WALL_COST, WALL_DISTANCE = 0.2, 1e-5, 10.0, 0.3
# How often the original coarsens its three test maps for planning (scenario_list.py).
PLANNING_PASSES = {"asl": 1, "asl_office_j": 3, "unity_scene_map": 2}
# Other maps are coarsened until a cell has at least this side [m], which is between those of the three.
PLANNING_RESOLUTION = 0.1
GOAL_FIELD_BYTES = 256 << 20
MAPS_KEPT = 8

_goal_fields = RecentArrays(GOAL_FIELD_BYTES)
_maps: OrderedDict[tuple[object, ...], GridMap] = OrderedDict()


def map_names() -> list[str]:
    """Return the names of the paper's maps, sorted.

    Raises
    ------
    MissingExtraError
        If the optional package that they come with is not installed; says the pip command.
    """
    return sorted(path.stem for path in packaged_folder().iterdir() if path.suffix in YAML_SUFFIXES)


def is_packaged(name: str) -> bool:
    """Return whether a bare word names one of the paper's maps that are installed here."""
    try:
        return is_bare(name) and name in map_names()
    except MissingExtraError:
        return False


def load_map(name_or_path: str | os.PathLike[str], *, occupancy: OccupancyRule | None = None) -> GridMap:
    """Return a map by name or from files.

    Parameters
    ----------
    name_or_path : str or path-like
        One of :func:`map_names`, or the path of a map_server YAML file or of a folder with one. A bare word is a name
        first. Its files may be links.
    occupancy : {"original", "ros"}, optional
        How grey values v become occupancies. "original" is ``1 - v / 254``, the rule of the software behind the paper's
        maps; "ros" is ``(255 - v) / 255``, or ``v / 255`` with ``negate: 1``, the rule of map_server. The two part at
        the grey of unknown ground, 205: 0.193 and 0.196, below and above the usual free_thresh of 0.196. Default: the
        paper's maps as the original reads them, all others as map_server does. Of colours, "ros" takes the mean of the
        channels as map_server does, alpha among them unless ``mode: scale``; "original" takes the luma.

    Returns
    -------
    GridMap
        Kept in memory, so that what is worked out from it is worked out once.

    Raises
    ------
    UnknownNameError
        If a bare word is neither a name nor a folder.
    MissingExtraError
        If it may be a name and the optional package is not installed.
    MapError
        If a file is missing, too large, or not what it should be; if no cell is free.
    ConfigError
        If `occupancy` is something else, or "original" is asked for a map with ``negate: 1``, which that rule ignores.

    Notes
    -----
    As the original's ``CMap2D.__init__`` with "original"; as map_server's ``loadMapFromFile`` in its trinary reading
    with "ros".
    """
    if occupancy not in (None, "original", "ros"):
        raise ConfigError(f"occupancy is {occupancy!r}, expected 'original' or 'ros': choose one.")
    path, packaged = _find(name_or_path)
    description = read_description(path, packaged=packaged)
    rule: OccupancyRule = occupancy or ("original" if packaged else "ros")
    stamps = [(file.stat().st_mtime_ns, file.stat().st_size) for file in (path, description.image_path)]
    key = (str(description.yaml_path), str(description.image_path), rule, *stamps)
    if key in _maps:
        _maps.move_to_end(key)
        return _maps[key]
    grid = _read(description, path.stem, rule)
    _maps[key] = grid
    while len(_maps) > MAPS_KEPT:
        _maps.popitem(last=False)
    return grid


def _find(name_or_path: str | os.PathLike[str]) -> tuple[Path, bool]:
    """Return the YAML file that is meant, and whether it is one of the paper's."""
    text = os.fspath(name_or_path)
    path = Path(text)
    if not (isinstance(name_or_path, str) and is_bare(text)):
        return (yaml_in_folder(path) if path.is_dir() else path), False
    is_folder = text != "" and path.is_dir()
    try:
        folder = packaged_folder()
    except MissingExtraError:
        if is_folder:
            return yaml_in_folder(path), False
        raise
    names = map_names()
    if text in names:
        return folder / f"{text}.yaml", True
    if is_folder:
        return yaml_in_folder(path), False
    raise UnknownNameError(
        f"Unknown map '{text}'.{did_you_mean(text, names)} Expected one of {', '.join(names)}, or the path of a "
        "map_server YAML file."
    )


def _read(description: MapDescription, name: str, rule: OccupancyRule) -> GridMap:
    if rule == "original" and description.negate:
        raise ConfigError(
            f"{description.yaml_path} has negate: 1, which occupancy='original' ignores: read it with occupancy='ros'."
        )
    sums, channels = read_grey(description.image_path, rule, description.mode)
    grid = GridMap(
        name=name,
        occupancy=occupancy_of(sums, rule, description.negate, channels),
        resolution=description.resolution,
        origin=description.origin,
        occupied_threshold=description.occupied_threshold,
        free_threshold=description.free_threshold,
        source=description.yaml_path.name,
    )
    if not grid.free.any():
        raise MapError(
            f"Map '{name}' has no free cell (occupancy below free_thresh {grid.free_threshold:g}): check thresholds, "
            "negate and the image."
        )
    return grid


def planning_map(grid: GridMap) -> GridMap:
    """Return the coarser map that humans plan on.

    Parameters
    ----------
    grid : GridMap
        A map at full resolution.

    Returns
    -------
    GridMap
        Coarsened as often as the original does for its three test maps (asl 1, asl_office_j 3, unity_scene_map 2),
        other maps until a cell measures at least 0.1 m.
    """
    passes = PLANNING_PASSES.get(grid.name)
    if passes is None:
        passes = 0
        while grid.resolution * 2**passes < PLANNING_RESOLUTION and min(grid.shape) >> (passes + 1) > 1:
            passes += 1
    return grid.coarsened(passes)


def planning_speeds(grid: GridMap) -> NDArray[np.float32]:
    """Return the speed of a planned human in every cell.

    Parameters
    ----------
    grid : GridMap
        The map that is planned on.

    Returns
    -------
    ndarray of shape (W, H), float32
        Cells per unit of time: ``1 / (1 + c)`` with c = 0.2 / (1e-5 + d^2) for a signed distance d [m], and 10 more
        where d < 0.3; 0 in solid cells, which are closed.

    Notes
    -----
    As ``cia.pyx`` and ``paths.py`` of pyIAN.
    """
    distance = grid.signed_distance()
    cost = np.float32(NEAR_COST) / (np.float32(NEAR_SOFTENING) + distance * distance)
    cost += np.where(distance < np.float32(WALL_DISTANCE), np.float32(WALL_COST), np.float32(0.0))
    speeds = np.float32(1.0) / (np.float32(1.0) + cost)
    result: NDArray[np.float32] = np.where(grid.occupied, np.float32(0.0), speeds)
    return result


def goal_field(grid: GridMap, goal_xy: ArrayLike, *, final_only: bool = False) -> NDArray[np.float32]:
    """Return how long a planned human takes from each cell to a goal.

    Parameters
    ----------
    grid : GridMap
        The map to plan on, usually that of :func:`planning_map`.
    goal_xy : ndarray of shape (2,) [m]
        The goal, world frame. It may lie in a closed cell: the field starts there all the same, as in the original.
    final_only : bool
        False: the original's solution bit for bit, which also takes times of neighbours that are not final yet, and so
        comes out up to some per cent too short. True: fast marching proper.

    Returns
    -------
    ndarray of shape (W, H), float32
        Time in cells: the length of the way in cells, longer by 1 + c where it passes walls, see
        :func:`planning_speeds`. 0 at the goal; inf in solid cells and wherever the goal is out of reach. Kept in
        memory; read-only.

    Raises
    ------
    MapError
        If the goal is not on the map.

    Notes
    -----
    First-order fast marching with four neighbours, after the original's ``fastmarch`` (``CMap2D.pyx``).
    """
    goal = np.asarray(goal_xy, dtype=np.float64).reshape(2)
    if not grid.contains(goal):
        left, right, low, high = grid.extent
        raise MapError(
            f"Goal ({goal[0]:g}, {goal[1]:g}) is not on map '{grid.name}', expected x in [{left:g}, {right:g}) and y "
            f"in [{low:g}, {high:g}) m: choose another goal."
        )
    i, j = (int(k) for k in grid.cell_of(goal))

    def make() -> NDArray[np.float32]:
        field = np.empty(grid.shape, np.float32)
        upwind = _fast_marching.UPWIND_FINAL if final_only else _fast_marching.UPWIND_ORIGINAL
        _fast_marching.march(planning_speeds(grid), i, j, upwind, field)
        return field

    return _goal_fields.get((grid.hash, i, j, final_only), make)
