"""What the worlds of a config share: maps, goal fields, scenarios and contours, worked out once per process."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import MapError
from navrep_data.schema import MAX_COORDINATE
from navrep_data.sim import _ian_layout as il
from navrep_data.sim._map_edges import link_edges
from navrep_data.sim._obstacles import OF_FIELDS, OI_FIELDS
from navrep_data.sim.config import SimConfig
from navrep_data.sim.gridmap import GridMap
from navrep_data.sim.maps import goal_field, load_map, planning_map, planning_speeds
from navrep_data.sim.scenarios import Scenario, get_scenario

RADIUS = 0.3
"""Radius of every agent on maps [m] (agents.py of pyIAN, kRobotRadius of pepper_2d_simulator.py)."""
SPAWN_CLEARANCE = 0.5
"""Random starts and goals are at least this far from walls [m], between centres of cells (pepper_2d_simulator.py)."""
SPAWN_PASSES = 3
"""pepper_2d_simulator.py draws starts on the map coarsened this often."""
SPAWN_RESOLUTION = 0.2
"""Other maps are coarsened for this as long as a cell stays below this side [m]."""
POOL_SIZE = 24
"""Humans without a scenario walk to one of this many places per map, so that their goal fields are kept."""
CONTOUR_TOLERANCE = 0.03
"""ORCA's walls are off the cells' outline by at most this [m]."""
WAYPOINT_DISTANCE = 1.0
"""pepper_2d_iarlenv.py: a human's waypoint lies this far ahead along its path [m]."""
TABLES_KEPT = 4

_kept: OrderedDict[tuple[Any, ...], MapWorldData] = OrderedDict()


@dataclass(frozen=True)
class MapWorldData:
    """Maps of a config and the arrays that the kernels share.

    Attributes
    ----------
    maps : tuple of GridMap
        At full resolution; in `consistent` physics with their origins at (0, 0), where their worlds are simulated.
    origins : ndarray of shape (M, 2)
        Where those maps' (0, 0) is in the frames of their files [m]; 0 in `original` physics.
    scenarios : tuple of Scenario
        Empty where starts and goals are random.
    tables : MapTables
        For the kernels.
    edges : tuple of ndarray
        ORCA's obstacles of all maps: (M, OF_FIELDS, capacity) float32, (M, OI_FIELDS, capacity) int32.
    """

    maps: tuple[GridMap, ...]
    origins: NDArray[np.float64]
    scenarios: tuple[Scenario, ...]
    tables: il.MapTables
    edges: tuple[NDArray[np.float32], NDArray[np.int32]]


def map_world_data(config: SimConfig) -> MapWorldData:
    """Return what the worlds of a config share; kept in memory.

    Raises
    ------
    MapError
        If a map has no room for a robot, or a scenario does not fit its map.
    UnknownNameError, MissingExtraError
        If a map or scenario is not known, or comes with an extra that is not installed.
    """
    scenarios = tuple(get_scenario(name) for name in config.scenarios)
    names = tuple(dict.fromkeys(s.map for s in scenarios)) if scenarios else config.maps
    given = tuple(load_map(file) for file in (names if scenarios else config.map_files))
    consistent = config.physics == "consistent"
    maps = tuple(map_for_physics(grid, config.physics) for grid in given)
    origins = np.array([np.subtract(old.origin, new.origin) for old, new in zip(given, maps, strict=True)])
    pool = not scenarios and config.humans > 0
    key = (config.scenarios, tuple(grid.hash for grid in maps), origins.tobytes(), pool, consistent)
    if key not in _kept:
        _kept[key] = _build(maps, origins, scenarios, names, pool, consistent)
        while len(_kept) > TABLES_KEPT:
            _kept.popitem(last=False)
    _kept.move_to_end(key)
    return _kept[key]


def map_for_physics(grid: GridMap, physics: str) -> GridMap:
    """Return a map as it is simulated on: with its origin at (0, 0), in `original` physics where its file says.

    Raises
    ------
    MapError
        If `original` physics, which simulates in float32, would lose millimetres there.
    """
    if physics == "consistent":
        return grid.local
    left, right, low, high = grid.extent
    if max(-left, right, -low, high) > MAX_COORDINATE:
        raise MapError(
            f"Map '{grid.name}' lies at x {left:.0f} to {right:.0f}, y {low:.0f} to {high:.0f} m, expected within "
            f"{MAX_COORDINATE:.0f} m of 0, where float32 coordinates keep their millimetres: set the map's origin "
            "near 0, or take physics 'consistent'."
        )
    return grid


class _Flat:
    """Arrays one after the other."""

    def __init__(self, dtype: Any) -> None:
        self.dtype = dtype
        self.parts: list[NDArray[Any]] = []
        self.size = 0

    def add(self, array: NDArray[Any]) -> int:
        """Append an array; returns where it begins."""
        start = self.size
        self.parts.append(np.ascontiguousarray(array, self.dtype).ravel())
        self.size += array.size
        return start

    def joined(self) -> NDArray[Any]:
        return np.concatenate(self.parts) if self.parts else np.zeros(1, self.dtype)


def _build(
    maps: tuple[GridMap, ...], origins: NDArray[np.float64], scenarios: tuple[Scenario, ...], names: tuple[str, ...],
    pool: bool, consistent: bool,
) -> MapWorldData:  # fmt: skip
    table = np.zeros((len(maps), il.MAP_FIELDS))
    flats = {
        "solid": _Flat(np.uint8), "distance": _Flat(np.float32), "squares": _Flat(np.uint8), "pace": _Flat(np.float32),
        "fields": _Flat(np.float32),
    }  # fmt: skip
    fields = _Fields(flats["fields"])
    spots: list[NDArray[np.float64]] = []
    pools: list[int] = []
    for m, grid in enumerate(maps):
        _add_map(table[m], grid, flats)
        places = np.zeros((0, 2)) if scenarios else spawn_places(grid, consistent)
        table[m, il.T_SPOTS] = sum(map(len, spots))
        spots.append(places)
        table[m, il.T_SPOTS_END] = table[m, il.T_SPOTS] + len(places)
        table[m, il.T_POOL] = len(pools)
        if pool:
            pools += [fields.index(grid, goal) for goal in _spread(places, POOL_SIZE)]
        table[m, il.T_POOL_END] = len(pools)
    rows, cast = _cast(maps, origins, scenarios, names, fields)
    edges = _edges(maps, table)
    tables = il.MapTables(
        table=table,
        **{name: flat.joined() for name, flat in flats.items()},
        field_start=np.array(fields.starts or [0], np.int64),
        field_goal=np.array(fields.goals or [(0.0, 0.0)], np.float64),
        scenarios=rows,
        cast=cast,
        # kernels are compiled for one order of axes, and parts without rows may have either
        spots=np.ascontiguousarray(np.concatenate(spots)) if spots else np.zeros((0, 2)),
        pool=np.array(pools or [0], np.int64),
    )
    # not made read-only, though nobody writes here: that is another type to a compiler, and copies would lose it
    return MapWorldData(maps, origins, scenarios, tables, edges)


def _add_map(row: NDArray[np.float64], grid: GridMap, flats: dict[str, _Flat]) -> None:
    plan = planning_map(grid)
    row[il.T_CELLS] = flats["solid"].add(grid.occupied)
    flats["distance"].add(grid.signed_distance())
    row[il.T_SQUARES] = flats["squares"].add(grid.free_squares)
    row[il.T_WIDTH], row[il.T_HEIGHT] = grid.shape
    row[il.T_X0], row[il.T_Y0] = grid.origin
    row[il.T_RESOLUTION] = grid.resolution
    row[il.T_PLAN_BEGIN] = flats["pace"].add(planning_speeds(plan))
    row[il.T_PLAN_CELLS] = plan.occupancy.size
    row[il.T_PLAN_WIDTH], row[il.T_PLAN_HEIGHT] = plan.shape
    row[il.T_PLAN_RESOLUTION] = plan.resolution
    # the original divides by its float32
    row[il.T_WAYPOINT] = int(WAYPOINT_DISTANCE / float(np.float32(plan.resolution)))
    row[il.T_RANGE_MAX] = 2.0 * grid.shape[0] * grid.resolution


class _Fields:
    """Goal fields by map and goal cell, each once."""

    def __init__(self, flat: _Flat) -> None:
        self.flat = flat
        self.known: dict[tuple[str, int, int], int] = {}
        self.starts: list[int] = []
        self.goals: list[tuple[float, float]] = []

    def index(self, grid: GridMap, goal: NDArray[np.float64]) -> int:
        plan = planning_map(grid)
        i, j = (int(k) for k in plan.cell_of(goal))
        key = (plan.hash, i, j)
        if key not in self.known:
            self.known[key] = len(self.starts)
            self.starts.append(self.flat.add(goal_field(plan, goal)))
            self.goals.append((float(goal[0]), float(goal[1])))
        return self.known[key]


def spawn_places(grid: GridMap, consistent: bool = True) -> NDArray[np.float64]:
    """Return where robots may start and have goals on a map: centres of cells, (N, 2) [m], in the map's frame.

    Parameters
    ----------
    grid : GridMap
        The map at full resolution.
    consistent : bool
        Whether the map's edge counts as a wall, and places are those of the largest connected region, wherever the
        map's (0, 0) is; `unity_scene_map` is larger outside than inside, where places are to be.

    Raises
    ------
    MapError
        If there is no such place.

    Notes
    -----
    The original coarsens its maps three times and takes the cells that are reachable from (0, 0) at 0.5 m from walls
    (``pepper_2d_simulator.py``); so does this where not `consistent`. Maps whose (0, 0) is no such place: the largest
    connected region.
    """
    passes = SPAWN_PASSES
    if grid.source != f"{grid.name}.yaml" or grid.name not in _ORIGINAL_SPAWN:
        passes = 0
        while passes < SPAWN_PASSES and grid.resolution * 2 ** (passes + 1) < SPAWN_RESOLUTION:
            passes += 1
    # a map of few columns or rows cannot be halved as often
    coarse = grid.coarsened(min(passes, min(grid.shape).bit_length() - 1))
    start = _INSIDE.get(grid.hash) if consistent else (0.0, 0.0)
    try:
        free = _largest_region(coarse) if start is None else coarse.reachable(start, SPAWN_CLEARANCE)
    except MapError:
        free = _largest_region(coarse)
    places: NDArray[np.float64] = coarse.centre_of(np.argwhere(free))
    if consistent:
        left, right, low, high = grid.extent
        x, y = places.T
        near = np.minimum(np.minimum(x - left, right - x), np.minimum(y - low, high - y))
        places = places[near >= SPAWN_CLEARANCE]
    if len(places) == 0:
        raise MapError(
            f"Map '{grid.name}' has no place that is {SPAWN_CLEARANCE} m from all walls and unknown ground, expected "
            "room for a robot: check resolution, thresholds and the image."
        )
    return places


_ORIGINAL_SPAWN = frozenset(
    {"marktrain", "marksimple", "markcomplex", "marktm1", "marktm2", "marktm3", "markclutter", "markmaze"}
    | {f"crowdmove{k}" for k in range(1, 7)}
)


# The largest region of this map of the paper is the ground outside of the building; a place inside [m], and the hash of
# the map with its origin at (0, 0), so that a copy at another origin is known, too.
_INSIDE = {"28d739c1fe0aba965c54438af470912d": (23.0, 12.0)}


def _largest_region(grid: GridMap) -> NDArray[np.bool_]:
    open_cells = grid.signed_distance() >= SPAWN_CLEARANCE
    best = np.zeros(grid.shape, np.bool_)
    left = open_cells.copy()
    while left.sum() > best.sum():
        i, j = np.argwhere(left)[0]
        region = grid.reachable(grid.centre_of((i, j)), SPAWN_CLEARANCE)
        if region.sum() > best.sum():
            best = region
        left &= ~region
    return best


def _spread(places: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return places far from each other, always the same ones: each next one is the farthest from those before."""
    chosen = [0]
    gap = np.hypot(*(places - places[0]).T)
    while len(chosen) < min(count, len(places)):
        k = int(gap.argmax())
        chosen.append(k)
        gap = np.minimum(gap, np.hypot(*(places - places[k]).T))
    return places[chosen]


def _cast(
    maps: tuple[GridMap, ...],
    origins: NDArray[np.float64],
    scenarios: tuple[Scenario, ...],
    names: tuple[str, ...],
    fields: _Fields,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    rows = np.zeros((len(scenarios), il.SCENARIO_FIELDS), np.int64)
    cast: list[list[float]] = []
    for s, scenario in enumerate(scenarios):
        m = names.index(scenario.map)
        rows[s] = m, len(cast), scenario.humans
        for start, goal, chance in zip(scenario.starts, scenario.goals, scenario.permissivity, strict=True):
            check_way(maps[m], origins[m], start[:2], goal, fields, scenario.name)
            here = goal - origins[m]
            cast.append([*(start[:2] - origins[m]), start[2], *here, chance, fields.index(maps[m], here)])
    return rows, np.array(cast) if cast else np.zeros((0, il.CAST_FIELDS))


def check_way(
    grid: GridMap, origin: NDArray[np.float64], start: NDArray[np.float64], goal: NDArray[np.float64], fields: _Fields,
    which: str,
) -> None:  # fmt: skip
    """Check that one can stand at a start and go to a goal, both in the frame in which the map's (0, 0) is at `origin`.

    Raises
    ------
    MapError
        If the start is in or too near a wall, or the goal is out of reach.
    """
    here, there = start - origin, goal - origin
    clearance = float(grid.signed_distance()[tuple(grid.cell_of(here))]) if grid.contains(here) else -np.inf
    if clearance < RADIUS:
        where = f"{clearance:.2f} m from the nearest wall" if clearance > 0.0 else "inside a wall or on unknown ground"
        raise MapError(
            f"Scenario {which!r}: the start ({start[0]:g}, {start[1]:g}) is "
            f"{'outside' if np.isinf(clearance) else where + ' on'} map '{grid.name}', expected at least {RADIUS} m of "
            "free ground around it: move it."
        )
    plan = planning_map(grid)
    field = fields.flat.parts[fields.index(grid, there)].reshape(plan.shape) if plan.contains(there) else None
    if field is None or not np.isfinite(field[tuple(plan.cell_of(here))]):
        raise MapError(
            f"Scenario {which!r}: the goal ({goal[0]:g}, {goal[1]:g}) on map '{grid.name}' is out of reach from "
            f"({start[0]:g}, {start[1]:g}), expected a way round the walls: move one of them."
        )


def _edges(maps: tuple[GridMap, ...], table: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    outlines = [grid.contours(CONTOUR_TOLERANCE) for grid in maps]
    capacity = max([1, *(sum(map(len, lines)) for lines in outlines)])
    edges_f = np.zeros((len(maps), OF_FIELDS, capacity), np.float32)
    edges_i = np.zeros((len(maps), OI_FIELDS, capacity), np.int32)
    for m, lines in enumerate(outlines):
        vertices = np.concatenate(lines) if lines else np.zeros((0, 2))
        starts = np.concatenate([[0], np.cumsum([len(line) for line in lines])]).astype(np.int64)
        table[m, il.T_EDGES] = link_edges(vertices, starts, edges_f[m], edges_i[m])
    return edges_f, edges_i
