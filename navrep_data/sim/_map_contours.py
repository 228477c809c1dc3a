# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Outlines of the solid cells of a grid, traced exactly and simplified within a stated distance.

An outline runs along the sides of cells with solid matter on its left, so that it goes anticlockwise round matter and
clockwise round the ground inside. Where two solid cells share only a corner it goes on to the other cell: they are one.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from navrep_data.kernels import kernel

# Directions along the lattice: right, up, left, down; turning left adds 1.
_DX = (1, 0, -1, 0)
_DY = (0, 1, 0, -1)
# Distance from a cell's corner to the line through the middles of its two sides [cells].
_CHAMFER = 0.25 * math.sqrt(2.0)
# Squared distances below this are rounding of points on the line [cells^2].
_ROUNDING = 1e-12


@kernel
def _solid(cells, i, j):
    return 0 <= i < cells.shape[0] and 0 <= j < cells.shape[1] and cells[i, j]


@kernel
def _is_side(cells, x, y, d):
    """Return whether the step from corner (x, y) in direction d has matter on its left and none on its right."""
    if d == 0:
        return _solid(cells, x, y) and not _solid(cells, x, y - 1)
    if d == 1:
        return _solid(cells, x - 1, y) and not _solid(cells, x, y)
    if d == 2:
        return _solid(cells, x - 1, y - 1) and not _solid(cells, x - 1, y)
    return _solid(cells, x, y - 1) and not _solid(cells, x - 1, y - 1)


@kernel
def _count_sides(cells):
    count = 0
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            if cells[i, j]:
                for d in range(4):
                    count += 0 if _solid(cells, i + _DX[d], j + _DY[d]) else 1
    return count


@kernel
def trace(cells, corners, starts):
    """Trace all outlines; return how many there are.

    cells       (W, H) bool, true = solid
    corners     (sides, 2) int32 out: lattice corners of all outlines, every step of one cell
    starts      (sides + 1,) int64 out: outline k has corners starts[k]:starts[k + 1]
    """
    width, height = cells.shape
    # every outline has a step to the right; those done are marked
    done = np.zeros((width, height + 1), np.bool_)
    count = 0
    n = 0
    starts[0] = 0
    for x0 in range(width):
        for y0 in range(height):
            if done[x0, y0] or not _is_side(cells, x0, y0, 0):
                continue
            x, y, d = x0, y0, 0
            while True:
                corners[n, 0], corners[n, 1] = x, y
                n += 1
                if d == 0:
                    done[x, y] = True
                x += _DX[d]
                y += _DY[d]
                # right turn first: over to a cell that touches with a corner
                d = (d + 3) & 3
                while not _is_side(cells, x, y, d):
                    d = (d + 1) & 3
                if x == x0 and y == y0 and d == 0:
                    break
            count += 1
            starts[count] = n
    return count


@kernel
def _off_line(points, k, a, b):
    """Return the squared distance of point k from the segment between points a and b."""
    ex, ey = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
    dx, dy = points[k, 0] - points[a, 0], points[k, 1] - points[a, 1]
    length2 = ex * ex + ey * ey
    along = dx * ex + dy * ey
    if length2 > 0.0:
        share = min(max(along / length2, 0.0), 1.0)
        dx -= share * ex
        dy -= share * ey
    return dx * dx + dy * dy


@kernel
def simplify(points, tolerance, keep, stack):
    """Choose vertices of a closed line by Douglas and Peucker's rule, in place.

    points      (n, 2) float64, closed: the last point is followed by the first
    tolerance   largest distance of a dropped point from the line that replaces it, either way
    keep        (n,) bool out
    stack       (n + 2, 2) int64 work
    """
    n = points.shape[0]
    keep[:] = False
    # two ends that are on the line for certain: the lowest of the leftmost, and the farthest from it
    a = 0
    for k in range(1, n):
        if points[k, 0] < points[a, 0] or (points[k, 0] == points[a, 0] and points[k, 1] < points[a, 1]):
            a = k
    b = a
    farthest = -1.0
    for k in range(n):
        dx, dy = points[k, 0] - points[a, 0], points[k, 1] - points[a, 1]
        if dx * dx + dy * dy > farthest:
            farthest = dx * dx + dy * dy
            b = k
    keep[a] = True
    keep[b] = True
    # pieces run forward from the first index, past the end where the second is smaller
    stack[0, 0], stack[0, 1] = a, b
    stack[1, 0], stack[1, 1] = b, a
    top = 2
    while top > 0:
        top -= 1
        first, last = stack[top, 0], stack[top, 1]
        worst = max(tolerance * tolerance, _ROUNDING)
        at = -1
        k = first + 1 if first + 1 < n else 0
        while k != last:
            off = _off_line(points, k, first, last)
            if off > worst:
                worst = off
                at = k
            k = k + 1 if k + 1 < n else 0
        if at >= 0:
            keep[at] = True
            stack[top, 0], stack[top, 1] = first, at
            stack[top + 1, 0], stack[top + 1, 1] = at, last
            top += 2


def outlines(solid: NDArray[np.bool_], tolerance: float) -> list[NDArray[np.float64]]:
    """Return the outlines of the solid cells, in cells from the lower-left corner.

    Parameters
    ----------
    solid : ndarray of shape (W, H), bool
        The cells.
    tolerance : float
        Largest distance from the cells' outline [cells]. From half a cell on the lines run through the middles of the
        cells' sides, so that stairs become slopes.

    Returns
    -------
    list of ndarray of shape (V, 2), float64
        Closed polygons, matter on the left.
    """
    cells = np.ascontiguousarray(solid)
    sides = int(_count_sides(cells))
    corners, starts = np.empty((sides, 2), np.int32), np.empty(sides + 1, np.int64)
    count = int(trace(cells, corners, starts))
    middles = tolerance >= 0.5
    allowed = tolerance - _CHAMFER if middles else tolerance
    result = []
    for k in range(count):
        points = corners[starts[k] : starts[k + 1]].astype(np.float64)
        if middles:
            points = 0.5 * (points + np.roll(points, -1, axis=0))
        keep, stack = np.empty(len(points), np.bool_), np.empty((len(points) + 2, 2), np.int64)
        simplify(points, allowed, keep, stack)
        result.append(points[keep])
    return result
