# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Lidar kernel for grid maps: the exact point where a ray enters the first occupied cell.

A ray leaps from free square to free square. For each cell and each quadrant of directions the side of the largest
free square is known that has the cell as its near corner (`free_squares`); a ray of that quadrant crosses it without
looking, and only the crossing itself is worked out, from the sensor and not from the last leap, so that nothing
accumulates. Unlike a distance field this does not slow down beside a wall that the ray is moving away from.

The planes of the other quadrants are stored mirrored, so that every ray goes up and to the right. Cells outside the
map count as the end of the ray. Leaps end in a cell that shares a side with the square, so no ray slips between two
occupied cells that share a corner.

Everything is float64 without fastmath: results do not depend on how a compiler fuses or orders operations. Map and
sensor are in the world frame [m]; cells are [i, j] = [column x, row y from the bottom]; rays are in the robot frame.
"""

from __future__ import annotations

import math

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._lidar import (
    BEARING_ERROR,
    CIRCLE_OWNER,
    CIRCLE_RADIUS,
    CIRCLE_X,
    CIRCLE_Y,
    COSINE,
    INSIDE_RANGE,
    SINE,
    _draw_circles,
    _finish,
    _take_ray,
    bearing,
)

# Planes of `squares`: which way the rays go. Bit 0: to the left, bit 1: down.
QUADRANTS = 4
# A leap is at most this many cells: squares are stored in bytes.
LARGEST_SQUARE = 255
# gap_quirk of scan_grid
QUIRK_NONE, QUIRK_SINGLE, QUIRK_MANY = 0, 1, 2
_TURN = 2.0 * math.pi
# Rays that go forward together: enough that vectors are full and memory has several requests at a time.
LANES = 8
# Rows of the lanes' state: sensor, direction and its inverse, time of the last leap [cells]; then whole numbers.
_PX, _PY, _C, _S, _INVERSE_C, _INVERSE_S, _T = 0, 1, 2, 3, 4, 5, 6
_LANE_FLOATS = 7
_PLANE, _I, _J, _SIDE = 0, 1, 2, 3
_LANE_INTS = 4
# In place of 1 / 0: infinity times a distance of 0 would be no number.
_NEVER = 1e300
_NONE, _ONE = np.int32(0), np.int32(1)


@kernel
def free_squares(occupied, squares):
    """Fill the leap tables of a map.

    occupied    (W, H) bool or uint8, nonzero = solid
    squares     (4, W + 1, H + 1) uint8 out: side [cells] of the largest free square that starts in this cell and goes
                away from the sensor; 0 = solid, or outside the map (the last row and column of each plane)
    """
    width, height = occupied.shape
    for q in range(QUADRANTS):
        plane = squares[q]
        plane[width, :] = 0
        plane[:, height] = 0
        for i in range(width - 1, -1, -1):
            column = occupied[width - 1 - i] if q & 1 else occupied[i]
            for j in range(height - 1, -1, -1):
                solid = column[height - 1 - j] if q & 2 else column[j]
                if solid:
                    plane[i, j] = 0
                else:
                    side = min(plane[i + 1, j], plane[i, j + 1], plane[i + 1, j + 1])
                    plane[i, j] = side + 1 if side < LARGEST_SQUARE else LARGEST_SQUARE


@kernel
def _start_ray(x, y, c, s, width, height):
    """Return when a ray is first on the map, and in which cell; column `width` where it misses the map.

    All in cells, mirrored so that the direction (c, s) has no negative part.
    """
    t = 0.0
    if x < 0.0:
        t = -x / c if c > 0.0 else np.inf
    if y < 0.0:
        t = max(t, -y / s if s > 0.0 else np.inf)
    if t > 0.0:
        if t == np.inf:
            return 0.0, width, 0
        x, y = max(x + t * c, 0.0), max(y + t * s, 0.0)
    if x >= width or y >= height:
        return 0.0, width, 0
    return t, np.int64(x), np.int64(y)


@kernel
def _step_lanes(lanes_f, lanes_i):
    """Let every lane leap once across its free square; lanes whose square has side 0 stay.

    One straight loop without branches, so that it runs on vectors.
    """
    px, py, c, s = lanes_f[_PX], lanes_f[_PY], lanes_f[_C], lanes_f[_S]
    inverse_c, inverse_s, time = lanes_f[_INVERSE_C], lanes_f[_INVERSE_S], lanes_f[_T]
    column, row, sides = lanes_i[_I], lanes_i[_J], lanes_i[_SIDE]
    for b in range(LANES):
        i, j, side = column[b], row[b], sides[b]
        tx = (i + side - px[b]) * inverse_c[b]
        ty = (j + side - py[b]) * inverse_s[b]
        across = tx <= ty
        moves = side > _NONE
        t = (tx if across else ty) if moves else 0.0
        # into a cell that shares a side with the square, whatever rounding says
        ni = min(max(np.int32(px[b] + t * c[b]), i), i + side - _ONE)
        nj = min(max(np.int32(py[b] + t * s[b]), j), j + side - _ONE)
        ni = i + side if across else ni
        nj = nj if across else j + side
        column[b] = ni if moves else i
        row[b] = nj if moves else j
        time[b] = t if moves else time[b]


@kernel
def _load_lanes(squares, lanes_i):
    """Look up the free square at every lane's cell; return whether any lane still moves."""
    alive = 0
    for b in range(LANES):
        side = squares[lanes_i[_PLANE, b], lanes_i[_I, b], lanes_i[_J, b]]
        lanes_i[_SIDE, b] = side
        alive |= side
    return alive != 0


@kernel
def grid_inverse_ranges(squares, x0, y0, resolution, x, y, theta, directions, inverse):
    """Raise the inverse ranges of all rays to those of the map, where these are larger.

    squares         (4, W + 1, H + 1) uint8, from `free_squares`
    x0, y0          lower-left corner of the map, world frame [m]
    resolution      side of a cell [m]
    x, y, theta     pose of the sensor [m, m, rad]; it may stand outside the map
    directions      (2, n_rays) float64 cosines, sines of the ray angles relative to the heading
    inverse         (n_rays,) float64 in and out: 1 / range [1/m]
    """
    width, height = squares.shape[1] - 1, squares.shape[2] - 1
    ct, st = math.cos(theta), math.sin(theta)
    gx, gy = (x - x0) / resolution, (y - y0) / resolution
    n_rays = inverse.shape[0]
    lanes_f, lanes_i = np.zeros((_LANE_FLOATS, LANES)), np.zeros((_LANE_INTS, LANES), np.int32)
    for first in range(0, n_rays, LANES):
        count = min(LANES, n_rays - first)
        for b in range(LANES):
            ray = first + min(b, count - 1)
            c = ct * directions[COSINE, ray] - st * directions[SINE, ray]
            s = st * directions[COSINE, ray] + ct * directions[SINE, ray]
            px, py = (width - gx if c < 0.0 else gx), (height - gy if s < 0.0 else gy)
            plane = (1 if c < 0.0 else 0) + (2 if s < 0.0 else 0)
            c, s = abs(c), abs(s)
            lanes_f[_PX, b], lanes_f[_PY, b], lanes_f[_C, b], lanes_f[_S, b] = px, py, c, s
            lanes_f[_INVERSE_C, b] = 1.0 / c if c > 0.0 else _NEVER
            lanes_f[_INVERSE_S, b] = 1.0 / s if s > 0.0 else _NEVER
            t, i, j = _start_ray(px, py, c, s, width, height)
            lanes_f[_T, b] = t
            lanes_i[_PLANE, b], lanes_i[_I, b], lanes_i[_J, b] = plane, i, j
        while _load_lanes(squares, lanes_i):
            _step_lanes(lanes_f, lanes_i)
        for b in range(count):
            if lanes_i[_I, b] < width and lanes_i[_J, b] < height:
                value = 1.0 / max(lanes_f[_T, b] * resolution, INSIDE_RANGE)
                inverse[first + b] = max(inverse[first + b], value)


@kernel
def grid_ranges(squares, x0, y0, resolution, x, y, theta, directions, range_max, inverse, out):
    """Scan a map alone: ranges [m] into out (n_rays,) float32, range_max where nothing is hit.

    inverse (n_rays,) float64 is work; the rest as in `grid_inverse_ranges`. A sensor in a solid cell sees INSIDE_RANGE.
    """
    inverse[:] = 1.0 / range_max
    grid_inverse_ranges(squares, x0, y0, resolution, x, y, theta, directions, inverse)
    _finish(inverse, range_max, out)


@kernel
def grid_scans(squares, x0, y0, resolution, poses, directions, range_max, out):
    """Scan a map from poses (N, 3) into out (N, n_rays) float32."""
    inverse = np.empty(directions.shape[1])
    for n in range(poses.shape[0]):
        grid_ranges(
            squares, x0, y0, resolution, poses[n, 0], poses[n, 1], poses[n, 2], directions, range_max, inverse, out[n]
        )  # fmt: skip


@kernel
def _draw_circles_many(
    circles, n_circles, x, y, theta, ct, st, directions, inverse, owner_of_ray, hits, per_radian, per_turn, margin
):  # fmt: skip
    """Draw all circles as the original's renderer for many agents does, with its blind sector.

    It takes bearings from -pi to pi and adds one turn only to those that end before the first ray. So for a heading
    between pi and a full turn everything with a bearing from pi to the heading is lost; and of a circle across the
    first ray the part seen by the last rays.
    """
    last = inverse.shape[0] - 1
    zero = (theta - _TURN * math.floor(theta / _TURN)) * per_radian
    for k in range(n_circles):
        dx, dy = circles[k, CIRCLE_X] - x, circles[k, CIRCLE_Y] - y
        radius = circles[k, CIRCLE_RADIUS]
        owner = np.int64(circles[k, CIRCLE_OWNER])
        distance2 = dx * dx + dy * dy
        low_u, high_u = 0.0, 1.0 * last
        inside = distance2 <= radius * radius
        if not inside:
            half = math.asin(radius / math.sqrt(distance2)) * per_radian + margin
            u = bearing(dy, dx) * per_radian - zero
            low_u, high_u = u - half, u + half
            if high_u < 0.0:
                low_u, high_u = low_u + per_turn, high_u + per_turn
            if high_u < 0.0 or low_u > last:
                continue
        cx, cy = ct * dx + st * dy, ct * dy - st * dx
        power = distance2 - radius * radius
        for ray in range(max(np.int64(math.ceil(low_u)), 0), min(np.int64(math.floor(high_u)), last) + 1):
            c, s = directions[COSINE, ray], directions[SINE, ray]
            off, along = c * cy - s * cx, c * cx + s * cy
            inner = radius * radius - off * off
            if inner < 0.0 or (along <= 0.0 and not inside):
                continue
            # from within the far side is seen
            value = 1.0 / max(along + math.sqrt(inner), INSIDE_RANGE) if inside else (along + math.sqrt(inner)) / power
            if value > inverse[ray]:
                _take_ray(inverse, owner_of_ray, hits, ray, value, owner)


@kernel
def scan_grid(
    squares, x0, y0, resolution, circles, n_circles, x, y, theta, directions, angle_min, angle_increment,
    range_max, gap_quirk, inverse, owner_of_ray, hits, out,
):  # fmt: skip
    """Scan a map with circles on it from one pose: `scan_world` of `_lidar.py` with a grid in place of polygons.

    squares, x0, y0, resolution     as in `grid_inverse_ranges`
    gap_quirk       QUIRK_NONE; QUIRK_SINGLE, QUIRK_MANY: circles vanish where the original's renderer for the training
                    environment, or that for many agents (IAN, CrowdMove), loses them
    The rest as in `scan_world`.
    """
    ct, st = math.cos(theta), math.sin(theta)
    per_radian = 1.0 / angle_increment
    per_turn = _TURN * per_radian
    margin = BEARING_ERROR * per_radian
    inverse[:] = 1.0 / range_max
    owner_of_ray[:] = -1
    hits[:] = 0
    grid_inverse_ranges(squares, x0, y0, resolution, x, y, theta, directions, inverse)
    if gap_quirk == QUIRK_MANY:
        first = theta + angle_min
        _draw_circles_many(
            circles, n_circles, x, y, first, ct, st, directions, inverse, owner_of_ray, hits, per_radian, per_turn,
            margin,
        )  # fmt: skip
    else:
        zero = (angle_min - _TURN * math.floor(angle_min / _TURN + 0.5)) * per_radian
        _draw_circles(
            circles, n_circles, x, y, ct, st, directions, inverse, owner_of_ray, hits, per_radian, zero, per_turn,
            margin, gap_quirk,
        )  # fmt: skip
    _finish(inverse, range_max, out)
