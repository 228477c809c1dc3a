"""ORCA's obstacle edges on grid maps: for each place only those within reach.

A real map has thousands of edges, of which an agent's ORCA may see those within its time horizon times its speed. So
the map is divided into square buckets, and each bucket with ground in it gets a small table of its own, in the arrays
that :func:`navrep_data.sim._orca.orca_velocity` takes. Choosing a table costs one division per axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import ConfigError
from navrep_data.kernels import kernel
from navrep_data.sim._obstacles import (
    OF_DX,
    OF_DY,
    OF_EX,
    OF_EY,
    OF_FIELDS,
    OF_LEN2,
    OF_X,
    OF_X2,
    OF_Y,
    OF_Y2,
    OI_CONVEX,
    OI_DEPTH,
    OI_FIELDS,
    OI_NEXT,
    OI_PARENT,
    OI_PREV,
    OI_SIDE,
    OI_TIE,
    RIGHT,
    TIE_THIS_FIRST,
)
from navrep_data.sim.gridmap import GridMap

__all__ = ["MapObstacles", "orca_table", "orca_tables"]

DEFAULT_BUCKET = 1.0
DEFAULT_TOLERANCE = 0.05
# Agents of the IAN scenarios have a radius of 0.3 m; what a disc a little smaller cannot enter is filled.
DEFAULT_RADIUS = 0.25
# More would be a mistake in the units of the reach, and slow.
MAX_TABLE_BYTES = 1 << 30


@dataclass(frozen=True, eq=False)
class MapObstacles:
    """Obstacle edges of a map, bucket by bucket.

    Attributes
    ----------
    edges_f : ndarray of shape (T, OF_FIELDS, capacity), float32
        ``edges_f[t]`` is the `obst_f` of table t.
    edges_i : ndarray of shape (T, OI_FIELDS, capacity), int32
        ``edges_i[t]`` is its `obst_i`.
    counts : ndarray of shape (T,), int64
        Edges of table t: its `n_obst`.
    index : ndarray of shape (columns, rows), int32
        Table of each bucket; table 0 is empty and stands for buckets without ground.
    x0, y0 : float
        Lower-left corner of the first bucket, world frame [m].
    bucket : float
        Side of a bucket [m].
    reach : float
        An agent's tables are complete up to this distance from it [m].
    """

    edges_f: NDArray[np.float32]
    edges_i: NDArray[np.int32]
    counts: NDArray[np.int64]
    index: NDArray[np.int32]
    x0: float
    y0: float
    bucket: float
    reach: float


@kernel
def orca_table(x, y, x0, y0, bucket, index):  # type: ignore[no-untyped-def]
    """Return the number of the table for an agent at (x, y) [m]; 0, the empty one, off the map."""
    column, row = math.floor((x - x0) / bucket), math.floor((y - y0) / bucket)
    if column < 0 or column >= index.shape[0] or row < 0 or row >= index.shape[1]:
        return 0
    return index[column, row]


def orca_tables(
    grid: GridMap,
    reach: float,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    radius: float = DEFAULT_RADIUS,
    bucket: float = DEFAULT_BUCKET,
) -> MapObstacles:
    """Return the tables of a map.

    Parameters
    ----------
    grid : GridMap
        A map.
    reach : float
        How far agents look for obstacles [m]: obstacle time horizon times largest speed, plus their radius.
    tolerance : float
        Largest distance between edges and outline [m]; agents may come that much closer to walls, or be kept that much
        further off.
    radius : float
        Ground that a disc of this radius cannot enter is filled [m]; not more than the agents' own.
    bucket : float
        Side of a bucket [m]. Smaller ones have shorter tables and take more memory.

    Returns
    -------
    MapObstacles
        Kept in memory with the map.

    Raises
    ------
    ConfigError
        If a length is not positive, or the tables would be too large.

    Notes
    -----
    An edge is left out of a table where no point of the bucket is within reach of it or on its right, which is where
    RVO2 ignores it. Edges are not cut along the lines of others, as RVO2's tree does; of equally distant ones the later
    comes first.
    """
    for name, value in (("reach", reach), ("bucket", bucket)):
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigError(f"{name} is {value}, expected a positive number of metres: correct it.")
    kept: dict[tuple[float, ...], MapObstacles] = grid.__dict__.setdefault("_orca_tables", {})
    key = (float(reach), float(tolerance), float(radius), float(bucket))
    if key not in kept:
        kept[key] = _build(grid, *key)
    return kept[key]


def _build(grid: GridMap, reach: float, tolerance: float, radius: float, bucket: float) -> MapObstacles:
    links, fields = _edges(grid.contours(tolerance, radius=radius, unknown_is_solid=True))
    (left, right, low, high), open_ground = grid.extent, grid.ground(radius)
    columns, rows = math.ceil((right - left) / bucket), math.ceil((high - low) / bucket)
    index = np.zeros((columns, rows), np.int32)
    chosen: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
    for column in range(columns):
        for row in range(rows):
            corner = np.array([left + column * bucket, low + row * bucket])
            (i0, j0), (i1, j1) = grid.cell_of([corner, corner + bucket])
            if not open_ground[i0 : i1 + 1, j0 : j1 + 1].any():
                continue
            near = _in_reach(fields, corner, bucket, reach)
            index[column, row] = len(chosen)
            # an edge's line depends on the corners at both its ends
            chosen.append(np.unique(np.concatenate([near, links[OI_NEXT, near], links[OI_PREV, near]])))
    capacity = max(1, *(len(edges) for edges in chosen))
    size = len(chosen) * capacity * 4 * (OF_FIELDS + OI_FIELDS)
    if size > MAX_TABLE_BYTES:
        raise ConfigError(
            f"ORCA's tables for map '{grid.name}' would take {size / 1e9:.1f} GB with reach {reach:g} m and tolerance "
            f"{tolerance:g} m, expected at most {MAX_TABLE_BYTES / 1e9:.1f}: ask for a shorter reach or more tolerance."
        )
    edges_f = np.zeros((len(chosen), OF_FIELDS, capacity), np.float32)
    edges_i = np.zeros((len(chosen), OI_FIELDS, capacity), np.int32)
    for table, edges in enumerate(chosen):
        edges_f[table, :, : len(edges)] = fields[:, edges]
        edges_i[table, :, : len(edges)] = _renumbered(links, edges)
    counts = np.array([len(edges) for edges in chosen], np.int64)
    return MapObstacles(edges_f, edges_i, counts, index, left, low, bucket, reach)


def _edges(polygons: list[NDArray[np.float64]]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return all edges as `obst_i` and `obst_f`, without a tree."""
    total = sum(len(polygon) for polygon in polygons)
    links, fields = np.zeros((OI_FIELDS, total), np.int32), np.zeros((OF_FIELDS, total), np.float32)
    first = 0
    for polygon in polygons:
        n = len(polygon)
        part = slice(first, first + n)
        start = polygon.astype(np.float32)
        end, before = np.roll(start, -1, axis=0), np.roll(start, 1, axis=0)
        links[OI_NEXT, part] = first + (np.arange(n) + 1) % n
        links[OI_PREV, part] = first + (np.arange(n) - 1) % n
        along, behind = end - start, start - before
        links[OI_CONVEX, part] = (n == 2) | (behind[:, 0] * along[:, 1] - behind[:, 1] * along[:, 0] >= 0.0)
        length2 = (along * along).sum(axis=1)
        unit = along / np.sqrt(length2)[:, None]
        fields[OF_X, part], fields[OF_Y, part] = start.T
        fields[OF_X2, part], fields[OF_Y2, part] = end.T
        fields[OF_EX, part], fields[OF_EY, part] = along.T
        fields[OF_DX, part], fields[OF_DY, part] = unit.T
        fields[OF_LEN2, part] = length2
        first += n
    return links, fields


def _in_reach(fields: NDArray[np.float32], corner: NDArray[np.float64], side: float, reach: float) -> NDArray[np.int64]:
    """Return the edges within reach of a square that have some point of it on their right, the side of the ground."""
    x, y, ex, ey = (fields[row].astype(np.float64) for row in (OF_X, OF_Y, OF_EX, OF_EY))
    cx, cy = corner + 0.5 * side
    along = np.clip(((cx - x) * ex + (cy - y) * ey) / fields[OF_LEN2], 0.0, 1.0)
    close = np.hypot(x + along * ex - cx, y + along * ey - cy) <= reach + side * math.sqrt(0.5)
    right = (cx - x) * ey - (cy - y) * ex + 0.5 * side * (np.abs(ex) + np.abs(ey))
    return np.flatnonzero(close & (right > 0.0))


def _renumbered(links: NDArray[np.int32], edges: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the `obst_i` of a choice of edges; neighbours that are not among them become the edge itself."""
    own = np.arange(len(edges), dtype=np.int32)
    out = np.zeros((OI_FIELDS, len(edges)), np.int32)
    for row in (OI_NEXT, OI_PREV):
        wanted = links[row, edges]
        at = np.minimum(np.searchsorted(edges, wanted), max(len(edges) - 1, 0))
        out[row] = np.where(edges[at] == wanted, at, own) if len(edges) else 0
    out[OI_CONVEX] = links[OI_CONVEX, edges]
    # a tree that is a chain: each edge hangs below the one before
    out[OI_PARENT], out[OI_DEPTH], out[OI_SIDE], out[OI_TIE] = own - 1, own, RIGHT, TIE_THIS_FIRST
    return out
