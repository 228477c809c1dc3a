"""Slow, dumb versions of what is worked out from grid maps, written from the definitions.

Nothing is shared with the package. Cells are [column, row from the bottom], lengths in cells.
"""

from __future__ import annotations

import heapq
import math

import numpy as np

TURN = 1e-9  # [rad] to either side of a ray: one through a corner has no single right answer


def squares_ranges(solid, x, y, angles):
    """Return each ray's distance to the nearest solid cell's square, tested one by one; inf without any.

    A square that the ray only leaves, from a place on its side, does not count.
    """
    ranges = np.full(len(angles), np.inf)
    dx, dy = np.cos(angles), np.sin(angles)
    for i, j in np.argwhere(solid):
        with np.errstate(all="ignore"):
            tx = np.sort(np.stack([(i - x) / dx, (i + 1 - x) / dx]), axis=0)
            ty = np.sort(np.stack([(j - y) / dy, (j + 1 - y) / dy]), axis=0)
        # a ray along an axis is inside the slab for ever, or never
        tx[:, dx == 0] = [[-np.inf], [np.inf]] if i <= x <= i + 1 else [[np.inf], [-np.inf]]
        ty[:, dy == 0] = [[-np.inf], [np.inf]] if j <= y <= j + 1 else [[np.inf], [-np.inf]]
        enter, leave = np.maximum(tx[0], ty[0]), np.minimum(tx[1], ty[1])
        hit = (enter <= leave) & (leave > 0)
        ranges[hit] = np.minimum(ranges[hit], np.maximum(enter[hit], 0.0))
    return ranges


def walk_ranges(solid, x, y, angles):
    """Return the same for a sensor on the map by walking from cell to cell; inf where the ray leaves the map."""
    return np.array([_walk(solid, x, y, math.cos(angle), math.sin(angle)) for angle in angles])


def _walk(solid, x, y, c, s):
    i, j = math.floor(x), math.floor(y)
    t = 0.0
    while 0 <= i < solid.shape[0] and 0 <= j < solid.shape[1]:
        if solid[i, j]:
            return t
        tx = ((i + 1 if c > 0 else i) - x) / c if c != 0 else math.inf
        ty = ((j + 1 if s > 0 else j) - y) / s if s != 0 else math.inf
        if tx <= ty:
            t, i = tx, i + (1 if c > 0 else -1)
        else:
            t, j = ty, j + (1 if s > 0 else -1)
    return math.inf


def wrong_rays(scan, ranges_at, angles, tolerance):
    """Return the rays that neither side's answer explains, and the share of rays that have two answers.

    ranges_at(angles) gives the oracle's ranges, in the unit of `scan`.
    """
    left, right = ranges_at(angles + TURN), ranges_at(angles - TURN)
    scan = np.asarray(scan, np.float64)
    low, high = np.minimum(left, right), np.maximum(left, right)
    good = (np.abs(scan - left) <= tolerance) | (np.abs(scan - right) <= tolerance)
    good |= (scan >= low - tolerance) & (scan <= high + tolerance) & (high - low < 0.01)
    return np.flatnonzero(~good), float(np.mean(high - low > tolerance))


def distances(solid):
    """Return each cell's distance to the nearest solid one, centre to centre."""
    places = np.argwhere(solid)
    out = np.empty(solid.shape)
    for i in range(solid.shape[0]):
        for j in range(solid.shape[1]):
            out[i, j] = np.sqrt(((places - (i, j)) ** 2).sum(axis=1)).min() if len(places) else np.inf
    return out


def reached(closed, start):
    """Return the cells that a king reaches who may step diagonally only between two open cells."""
    seen, todo = {start}, [start]
    while todo:
        i, j = todo.pop()
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                ni, nj = i + di, j + dj
                if not (0 <= ni < closed.shape[0] and 0 <= nj < closed.shape[1]) or closed[ni, nj]:
                    continue
                if di and dj and (closed[i + di, j] or closed[i, j + dj]):
                    continue
                if (ni, nj) not in seen:
                    seen.add((ni, nj))
                    todo.append((ni, nj))
    out = np.zeros(closed.shape, bool)
    for cell in seen:
        out[cell] = True
    return out


def arrival_times(speeds, goal):
    """Return first-order upwind arrival times by fast marching with heapq, float64; speed 0 = closed."""
    times = {goal: 0.0}
    done = set()
    heap = [(0.0, goal)]

    def final(i, j):
        return times[i, j] if (i, j) in done else math.inf

    while heap:
        value, cell = heapq.heappop(heap)
        if cell in done:
            continue
        done.add(cell)
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            i, j = cell[0] + di, cell[1] + dj
            if not (0 <= i < speeds.shape[0] and 0 <= j < speeds.shape[1]):
                continue
            if speeds[i, j] <= 0 or (i, j) in done:
                continue
            slowness = 1.0 / float(speeds[i, j])
            a, b = sorted((min(final(i - 1, j), final(i + 1, j)), min(final(i, j - 1), final(i, j + 1))))
            if b - a < slowness * math.sqrt(2.0):
                # the larger root of (t - a)^2 + (t - b)^2 = slowness^2
                half = 0.5 * (b - a)
                value = a + half + math.sqrt(0.5 * slowness**2 - half**2)
            else:
                value = a + slowness
            if value < times.get((i, j), math.inf):
                times[i, j] = value
                heapq.heappush(heap, (value, (i, j)))
    out = np.full(speeds.shape, np.inf)
    for cell in done:
        out[cell] = times[cell]
    return out


def original_times(speeds, goal):
    """Return arrival times as the released software finds them: from any times so far, float32, latest cell first."""
    times = {goal: np.float32(0)}
    done = {tuple(cell) for cell in np.argwhere(~(speeds > 0)).tolist()}
    heap = [(np.float32(0), -goal[0], -goal[1])]
    never = np.float32(np.inf)
    first = True
    while heap:
        _, i, j = heapq.heappop(heap)
        cell = (-i, -j)
        if cell in done and not first:
            continue
        first = False
        done.add(cell)
        for step in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            i, j = cell[0] + step[0], cell[1] + step[1]
            if not (0 <= i < speeds.shape[0] and 0 <= j < speeds.shape[1]) or (i, j) in done:
                continue
            a = min(times.get((i - 1, j), never), times.get((i + 1, j), never))
            b = min(times.get((i, j - 1), never), times.get((i, j + 1), never))
            speed = np.float32(speeds[i, j])
            inner = np.float32(2) * np.float32(1.0 / float(speed * speed)) - (a - b) * (a - b)
            if inner > 0:
                value = np.float32((float(a + b) + math.sqrt(inner)) / 2)
            else:
                value = np.float32(1.0 / float(speed) + float(min(a, b)))
            if value < times.get((i, j), never):
                times[i, j] = value
                heapq.heappush(heap, (value, -i, -j))
    out = np.full(speeds.shape, never, np.float32)
    for cell, value in times.items():
        out[cell] = value
    return out


def original_path(field, start, random_state=None):
    """Walk down a field by the released software's rules; ties by `random_state` (numpy's legacy generator) or first.

    Directions in the order up, right, down, left, then the diagonals. A direction that does not go down is remembered
    for the rest of the path and forbids the diagonals beside it, except up-right.
    """
    straight = {"up": (0, 1), "right": (1, 0), "down": (0, -1), "left": (-1, 0)}
    diagonal = {
        ("up", "right"): (1, 1),
        ("down", "right"): (1, -1),
        ("up", "left"): (-1, 1),
        ("down", "left"): (-1, -1),
    }
    path, shut = [start], set()
    while True:
        i, j = path[-1]
        slopes = []
        for name, (di, dj) in straight.items():
            slope = _slope(field, i, j, di, dj)
            if slope is not None and slope >= 0 and not (np.isinf(field[i, j]) and np.isinf(field[i + di, j + dj])):
                shut.add(name)
            slopes.append((np.float32(0) if slope is None else slope, (di, dj)))
        for names, (di, dj) in diagonal.items():
            slope = _slope(field, i, j, di, dj)
            if slope is None or (names != ("up", "right") and shut.intersection(names)):
                slope = np.float32(0)
            slopes.append((slope / np.float32(math.sqrt(2)), (di, dj)))
        steepest = min(slope for slope, _ in slopes)
        if steepest >= 0:
            return path
        best = [step for slope, step in slopes if slope == steepest]
        pick = 0 if len(best) == 1 or random_state is None else int(random_state.randint(len(best), dtype=np.int64))
        path.append((i + best[pick][0], j + best[pick][1]))


def _slope(field, i, j, di, dj):
    ni, nj = i + di, j + dj
    if not (0 <= ni < field.shape[0] and 0 <= nj < field.shape[1]):
        return None
    if np.isinf(field[i, j]) and np.isinf(field[ni, nj]):
        return np.float32(np.inf)
    return np.float32(field[ni, nj] - field[i, j])
