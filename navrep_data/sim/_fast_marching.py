# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Time-to-goal fields on grids, and the way down them.

Arithmetic is float32 where the original's is (``CMap2D.pyx``), and cells of equal time are taken in its order, so that
fields are equal to its to the last bit and ties along a path are the same ties.
"""

from __future__ import annotations

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._rng import integer

# Ties between equally steep directions: the first one, or one drawn from a random stream.
TIE_FIRST, TIE_RANDOM = 0, 1
# Which neighbours count for the time of a cell: those whose own time is final, which is fast marching; or, as in the
# original, also those that may still get an earlier one, which gives times up to some per cent too short beside walls.
UPWIND_FINAL, UPWIND_ORIGINAL = 0, 1
# Which diagonal steps are allowed: those that cut no closed corner, or the original's rule.
CORNERS_CLOSED, CORNERS_ORIGINAL = 0, 1

_HALF = np.float32(0.5)
_TWO = np.float32(2.0)
_INF = np.float32(np.inf)
_ZERO = np.float32(0.0)
_DIAGONAL = np.float32(np.sqrt(2.0))
_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)
# Neighbours in the original's order: up, right, down, left, then the diagonals.
_DI = (0, 1, 0, -1, 1, 1, -1, -1)
_DJ = (1, 0, -1, 0, 1, -1, 1, -1)


@kernel
def _key(value, node):
    """Return an integer that sorts by value, and among equal ones puts the higher node first."""
    return (np.uint64(np.float32(value).view(np.uint32)) << _SHIFT) | (_LOW - np.uint64(node))


@kernel
def _push(heap, size, key):
    """Add a key to a binary heap of `size` keys; the smallest is heap[0]."""
    at = size
    while at > 0:
        above = (at - 1) >> 1
        if heap[above] <= key:
            break
        heap[at] = heap[above]
        at = above
    heap[at] = key


@kernel
def _pop(heap, size):
    """Remove heap[0] from a heap of `size` keys."""
    key = heap[size - 1]
    last = size - 1
    at = 0
    child = 1
    while child < last:
        if child + 1 < last and heap[child + 1] < heap[child]:
            child += 1
        if heap[child] >= key:
            break
        heap[at] = heap[child]
        at = child
        child = 2 * at + 1
    heap[at] = key


@kernel
def _time_of(field, done, i, j, upwind):
    """Return the time of a neighbour, inf where there is none that counts."""
    if i < 0 or i >= field.shape[0] or j < 0 or j >= field.shape[1] or (upwind == UPWIND_FINAL and not done[i, j]):
        return _INF
    return field[i, j]


@kernel
def _arrival(field, done, speeds, i, j, upwind):
    """Return the first-order upwind solution at a cell from its four neighbours, float32."""
    a = min(_time_of(field, done, i - 1, j, upwind), _time_of(field, done, i + 1, j, upwind))
    b = min(_time_of(field, done, i, j - 1, upwind), _time_of(field, done, i, j + 1, upwind))
    s = speeds[i, j]
    gap = a - b
    inner = _TWO * np.float32(1.0 / np.float64(s * s)) - gap * gap
    if inner > _ZERO:
        return np.float32((np.float64(a + b) + np.sqrt(np.float64(inner))) / 2.0)
    return np.float32(1.0 / np.float64(s) + np.float64(min(a, b)))


@kernel
def march(speeds, goal_i, goal_j, upwind, field):
    """Solve the eikonal equation from one cell outwards by fast marching, with four neighbours.

    speeds          (W, H) float32 speed in each cell [cells per unit of time]; 0 or less = closed
    goal_i, goal_j  cell where the time is 0; may itself be closed
    upwind          UPWIND_FINAL or UPWIND_ORIGINAL
    field           (W, H) float32 out: time to the goal, inf in closed cells and in those that do not reach it
    """
    width, height = speeds.shape
    field[:, :] = _INF
    closed = np.zeros((width, height), np.bool_)
    for i in range(width):
        for j in range(height):
            # closed for good: solid, or its time is final
            closed[i, j] = not speeds[i, j] > _ZERO
    field[goal_i, goal_j] = _ZERO
    heap = np.empty(4 * (width + height) + 64, np.uint64)
    heap[0] = _key(_ZERO, goal_i * height + goal_j)
    size = 1
    while size > 0:
        node = np.int64(_LOW - (heap[0] & _LOW))
        _pop(heap, size)
        size -= 1
        i, j = node // height, node % height
        # an older, larger time of a cell that is done; a closed goal starts all the same
        if closed[i, j] and field[i, j] > _ZERO:
            continue
        closed[i, j] = True
        if size + 4 > heap.shape[0]:
            larger = np.empty(2 * heap.shape[0], np.uint64)
            larger[:size] = heap[:size]
            heap = larger
        for n in range(4):
            ni, nj = i + _DI[n], j + _DJ[n]
            if ni < 0 or ni >= width or nj < 0 or nj >= height or closed[ni, nj]:
                continue
            value = _arrival(field, closed, speeds, ni, nj, upwind)
            if value < field[ni, nj]:
                field[ni, nj] = value
                _push(heap, size, _key(value, ni * height + nj))
                size += 1


@kernel
def _slopes(field, i, j, corners, blocked, slopes):
    """Fill slopes (8,) with the change of the field per cell of way in each direction; return the steepest.

    CORNERS_CLOSED forbids diagonals past a cell without a time. CORNERS_ORIGINAL forbids those beside a direction that
    did not go down, here or at any cell before (`blocked` is carried along), except up-right, which is never forbidden.
    """
    width, height = field.shape
    here = field[i, j]
    best = 0
    for n in range(8):
        di, dj = _DI[n], _DJ[n]
        ni, nj = i + di, j + dj
        if ni < 0 or ni >= width or nj < 0 or nj >= height:
            slope = _ZERO
            if corners == CORNERS_CLOSED and n < 4:
                blocked[n] = 1
        else:
            there = field[ni, nj]
            # inf - inf has no meaning; the original ends up with inf as well
            slope = _INF if here == _INF and there == _INF else there - here
            if n < 4:
                if corners == CORNERS_CLOSED:
                    blocked[n] = 1 if there == _INF else 0
                elif slope >= _ZERO and not (here == _INF and there == _INF):
                    blocked[n] = 1
            elif (corners == CORNERS_CLOSED or n > 4) and (blocked[0 if dj > 0 else 2] or blocked[1 if di > 0 else 3]):
                slope = _ZERO
        if n >= 4:
            slope = slope / _DIAGONAL
        slopes[n] = slope
        if slope < slopes[best]:
            best = n
    return best


@kernel
def descend(field, i, j, ties, corners, rng, path):
    """Walk down a field by steepest descent over eight neighbours; return the number of cells of the path.

    field           (W, H) float32, as from `march`
    i, j            first cell
    ties            TIE_FIRST or TIE_RANDOM
    corners         CORNERS_CLOSED or CORNERS_ORIGINAL
    rng             random stream for TIE_RANDOM; one draw for each cell where several directions are equally steep
    path            (L, 2) int64 out: the cells, the first one included; the walk ends where the array is full

    The path ends in a local minimum: at the goal, or at once where the field does not fall.
    """
    slopes = np.empty(8, np.float32)
    blocked = np.zeros(4, np.uint8)
    path[0, 0], path[0, 1] = i, j
    count = 1
    while count < path.shape[0]:
        best = _slopes(field, i, j, corners, blocked, slopes)
        steepest = slopes[best]
        if not steepest < _ZERO:
            break
        if ties == TIE_RANDOM:
            tied = 0
            for n in range(8):
                tied += 1 if slopes[n] == steepest else 0
            if tied > 1:
                skip = integer(rng, 0, tied)
                for n in range(8):
                    if slopes[n] == steepest:
                        if skip == 0:
                            best = n
                            break
                        skip -= 1
        i += _DI[best]
        j += _DJ[best]
        path[count, 0], path[count, 1] = i, j
        count += 1
    return count
