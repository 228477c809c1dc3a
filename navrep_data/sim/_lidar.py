# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Lidar kernel: exact ranges to line segments and circles, worked out in inverse range.

Along a straight edge the inverse range is linear in the direction of the ray: for a ray (c, s) and an edge
from a to b, ``1/r = (c * ey - s * ex) / cross(a, b)`` with e = b - a. So an edge costs one multiply-add and
one maximum per ray that it covers, and no division. Which rays those are follows from the bearings of its
ends.

Bearings come from a polynomial of known error; the first and last ray of every interval are then tested
exactly against the edge's ends. Two edges that share a corner make opposite tests of the same numbers, so no
ray slips between them. Everything is float64 without fastmath, so results do not depend on how a compiler
fuses or orders operations.

Frames: edges, circles and pose are in the world frame [m, rad]; rays in the robot frame, x forward, y left.
"""

from __future__ import annotations

import math

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim.gait import LEG_RADIUS, LEGS_PER_HUMAN, leg_offset

# Columns of `circles`.
CIRCLE_X, CIRCLE_Y, CIRCLE_RADIUS, CIRCLE_OWNER = 0, 1, 2, 3
CIRCLE_COLUMNS = 4
# Rows of `directions`.
COSINE, SINE = 0, 1

# Edges whose line passes the sensor this closely [m] are seen edge-on, or the sensor lies on them.
EDGE_ON = 1e-9
# Edges shorter than this [m] are drawn square to the line of sight: their direction is mostly rounding.
SHORT_EDGE = 1e-6
# Range seen from within a circle [m]: people are solid. Positive, because 0 means "no measurement".
INSIDE_RANGE = 1e-6
_INSIDE_INVERSE = 1.0 / INSIDE_RANGE
# More than the largest error of `bearing` [rad].
BEARING_ERROR = 1e-6
# asin(q) <= q + (pi/2 - 1) q^3 for 0 <= q <= 1.
_ASIN_CUBIC = 0.5 * math.pi - 1.0
_TURN = 2.0 * math.pi


@kernel
def bearing(y, x):
    """Return atan2(y, x) within 3e-7 rad, 0 at the origin; a minimax polynomial."""
    ax, ay = abs(x), abs(y)
    near, far = min(ax, ay), max(ax, ay)
    if far == 0.0:
        return 0.0
    q = near / far
    z = q * q
    angle = q * (
        0.9999961116
        + z
        * (
            -0.333173681
            + z * (0.1980781577 + z * (-0.132333424 + z * (0.0796236728 + z * (-0.03360421819 + z * 0.006811791911))))
        )
    )
    if ay > ax:
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


@kernel
def _raise_line(inverse, cosines, sines, a, b):
    """Raise `inverse` to ``a * cosines + b * sines`` where that is larger; three views of equal length."""
    for i in range(inverse.shape[0]):
        value = a * cosines[i] + b * sines[i]
        old = inverse[i]
        inverse[i] = value if value > old else old


@kernel
def _draw_edge(directions, inverse, ax, ay, bx, by, ua, ub, per_turn, margin, slope_c, slope_s):
    """Draw the edge from a anticlockwise to b (robot frame); ua, ub: their bearings in rays, in one turn."""
    last = inverse.shape[0] - 1
    # b follows a by less than half a turn; just below zero (or one turn) means ends within the bearing error.
    if ub - ua < -0.25 * per_turn:
        ub += per_turn
    elif ub - ua > 0.75 * per_turn:
        ua += per_turn
    ua -= per_turn
    ub -= per_turn
    # The same interval one turn earlier and later: it may lie across ray 0, or the sensor turn further.
    while ua - margin <= last:
        if ub + margin >= 0.0:
            low = max(np.int64(math.ceil(ua - margin)), 0)
            high = min(np.int64(math.floor(ub + margin)), last)
            while low <= high and ax * directions[SINE, low] - ay * directions[COSINE, low] < 0.0:
                low += 1
            while high >= low and by * directions[COSINE, high] - bx * directions[SINE, high] < 0.0:
                high -= 1
            if low <= high:
                _raise_line(
                    inverse[low : high + 1],
                    directions[COSINE, low : high + 1],
                    directions[SINE, low : high + 1],
                    slope_c,
                    slope_s,
                )
        ua += per_turn
        ub += per_turn


@kernel
def _edge_on(ax, ay, bx, by, det):
    """Return whether the line through a and b, det = cross(a, b), passes through the sensor at the origin."""
    ex, ey = bx - ax, by - ay
    return det * det <= EDGE_ON * EDGE_ON * (ex * ex + ey * ey)


@kernel
def _hidden_side(edges, first, stop, x, y):
    """Return the sign of cross(a, b) of the edges that cannot be the nearest hit, 0 where both sides may be.

    From outside a simple closed polygon the nearest hit on it is always where a ray enters, from inside where
    it leaves.
    """
    if stop - first < 3 or edges[first, 0] != edges[stop - 1, 2] or edges[first, 1] != edges[stop - 1, 3]:
        return 0.0
    area2 = 0.0
    winding = 0
    for e in range(first, stop):
        ax, ay, bx, by = edges[e, 0] - x, edges[e, 1] - y, edges[e, 2] - x, edges[e, 3] - y
        det = ax * by - ay * bx
        if _edge_on(ax, ay, bx, by, det):
            return 0.0
        area2 += det
        if ay <= 0.0:
            if by > 0.0 and det > 0.0:
                winding += 1
        elif by <= 0.0 and det < 0.0:
            winding -= 1
    if area2 == 0.0:
        return 0.0
    inside = winding != 0
    return 1.0 if (area2 > 0.0) != inside else -1.0


@kernel
def _draw_polygons(
    edges, poly_start, n_polys, x, y, ct, st, directions, inverse, per_radian, zero, per_turn, margin
):  # fmt: skip
    """Draw all polygons into `inverse`; `zero` is the bearing of ray 0 in rays, within half a turn of 0."""
    for p in range(n_polys):
        first, stop = poly_start[p], poly_start[p + 1]
        hidden = _hidden_side(edges, first, stop, x, y)
        # The end of one edge is the start of the next: its bearing is worked out once.
        known = -1
        bx = by = ub = 0.0
        for e in range(first, stop):
            dax, day, dbx, dby = edges[e, 0] - x, edges[e, 1] - y, edges[e, 2] - x, edges[e, 3] - y
            det = dax * dby - day * dbx
            if det * hidden > 0.0 or _edge_on(dax, day, dbx, dby, det):
                continue
            if known == e and edges[e, 0] == edges[e - 1, 2] and edges[e, 1] == edges[e - 1, 3]:
                ax, ay, ua = bx, by, ub
            else:
                ax, ay = ct * dax + st * day, ct * day - st * dax
                ua = bearing(ay, ax) * per_radian - zero
                ua = ua + per_turn if ua < 0.0 else ua
            bx, by = ct * dbx + st * dby, ct * dby - st * dbx
            ub = bearing(by, bx) * per_radian - zero
            ub = ub + per_turn if ub < 0.0 else ub
            known = e + 1
            if abs(bx - ax) + abs(by - ay) < SHORT_EDGE:
                distance2 = ax * ax + ay * ay
                slope_c, slope_s = ax / distance2, ay / distance2
            else:
                slope_c, slope_s = (by - ay) / det, (ax - bx) / det
            if det > 0.0:
                _draw_edge(directions, inverse, ax, ay, bx, by, ua, ub, per_turn, margin, slope_c, slope_s)
            else:
                _draw_edge(directions, inverse, bx, by, ax, ay, ub, ua, per_turn, margin, slope_c, slope_s)


@kernel
def _take_ray(inverse, owner_of_ray, hits, ray, value, owner):
    """Give a ray to `owner`, counting for all owners how many rays they have."""
    before = owner_of_ray[ray]
    if before >= 0:
        hits[before] -= 1
    owner_of_ray[ray] = owner
    hits[owner] += 1
    inverse[ray] = value


@kernel
def _draw_circle(
    cx, cy, radius, power, owner, directions, inverse, owner_of_ray, hits, low_u, high_u, per_turn, gap_quirk
):  # fmt: skip
    """Draw one circle (robot frame, sensor outside) on the rays between low_u and high_u and their images."""
    last = inverse.shape[0] - 1
    if gap_quirk != 0:
        # A circle in front of ray 0 loses what lies on the far side of it: the last rays.
        c, s = directions[COSINE, 0], directions[SINE, 0]
        if abs(c * cy - s * cx) < radius and c * cx + s * cy > 0.0:
            last = min(last, np.int64(0.5 * per_turn))
    scale = 1.0 / power
    square = radius * radius
    low_u -= per_turn
    high_u -= per_turn
    while low_u <= last:
        if high_u >= 0.0:
            low = max(np.int64(math.ceil(low_u)), 0)
            high = min(np.int64(math.floor(high_u)), last)
            for ray in range(low, high + 1):
                c, s = directions[COSINE, ray], directions[SINE, ray]
                off = c * cy - s * cx
                inner = square - off * off
                along = c * cx + s * cy
                if inner >= 0.0 and along > 0.0:
                    value = (along + math.sqrt(inner)) * scale
                    if value > inverse[ray]:
                        _take_ray(inverse, owner_of_ray, hits, ray, value, owner)
        low_u += per_turn
        high_u += per_turn


@kernel
def _draw_circles(
    circles, n_circles, x, y, ct, st, directions, inverse, owner_of_ray, hits, per_radian, zero, per_turn,
    margin, gap_quirk,
):  # fmt: skip
    """Draw all circles into `inverse`, keeping account of who is seen."""
    for i in range(n_circles):
        dx, dy = circles[i, CIRCLE_X] - x, circles[i, CIRCLE_Y] - y
        radius = circles[i, CIRCLE_RADIUS]
        owner = np.int64(circles[i, CIRCLE_OWNER])
        distance2 = dx * dx + dy * dy
        if distance2 <= radius * radius:
            for ray in range(inverse.shape[0]):
                if inverse[ray] < _INSIDE_INVERSE:
                    _take_ray(inverse, owner_of_ray, hits, ray, _INSIDE_INVERSE, owner)
            continue
        if gap_quirk != 0 and dx > 0.0 and abs(dy) < radius:
            continue
        ratio = radius / math.sqrt(distance2)
        half = ratio * (1.0 + _ASIN_CUBIC * ratio * ratio) * per_radian + margin
        cx, cy = ct * dx + st * dy, ct * dy - st * dx
        u = bearing(cy, cx) * per_radian - zero
        u = u + per_turn if u < 0.0 else u
        # Positive by the test above, in the same rounding.
        power = distance2 - radius * radius
        _draw_circle(
            cx, cy, radius, power, owner, directions, inverse, owner_of_ray, hits, u - half, u + half,
            per_turn, gap_quirk,
        )  # fmt: skip


@kernel
def _finish(inverse, range_max, out):
    """Turn inverse ranges into ranges."""
    for ray in range(out.shape[0]):
        value = 1.0 / inverse[ray]
        out[ray] = np.float32(value if value < range_max else range_max)


@kernel
def scan_world(
    edges, poly_start, n_polys, circles, n_circles, x, y, theta, directions, angle_min, angle_increment,
    range_max, gap_quirk, inverse, owner_of_ray, hits, out,
):  # fmt: skip
    """Scan a world of polygons and circles from one pose.

    edges           (E, 4) float64 x1, y1, x2, y2 [m], world frame
    poly_start      (P + 1,) int64 edges poly_start[p]:poly_start[p + 1] belong to polygon p, in order around
    it, in
                    either direction; polygons are simple. Lists that do not close are seen from both sides.
    circles         (C, 4) float64 x, y, radius [m], owner (an index into hits)
    x, y, theta     pose of the sensor [m, m, rad]
    directions      (2, n_rays) float64 cosines, sines of the ray angles relative to the heading
    angle_min, angle_increment, range_max   [rad, rad, m], increment > 0
    gap_quirk       1: circles vanish where the original's renderer loses them
    inverse         (n_rays,) float64 work
    owner_of_ray    (n_rays,) int32 out: owner of the circle that is the ray's nearest hit, -1 if none
    hits            (n_owners,) int32 out: rays whose nearest hit is a circle of this owner
    out             (n_rays,) float32 out: ranges [m], range_max where nothing is hit
    """
    ct, st = math.cos(theta), math.sin(theta)
    per_radian = 1.0 / angle_increment
    per_turn = _TURN * per_radian
    margin = BEARING_ERROR * per_radian
    zero = angle_min - _TURN * math.floor(angle_min / _TURN + 0.5)
    zero *= per_radian
    inverse[:] = 1.0 / range_max
    owner_of_ray[:] = -1
    hits[:] = 0
    _draw_polygons(
        edges, poly_start, n_polys, x, y, ct, st, directions, inverse, per_radian, zero, per_turn, margin
    )  # fmt: skip
    _draw_circles(
        circles, n_circles, x, y, ct, st, directions, inverse, owner_of_ray, hits, per_radian, zero, per_turn,
        margin, gap_quirk,
    )  # fmt: skip
    _finish(inverse, range_max, out)


@kernel
def scan_poses(edges, poly_start, circles, poses, directions, angle_min, angle_increment, range_max, gap_quirk, out):
    """Scan one world from poses (N, 3) into out (N, n_rays); each circle is its own owner."""
    n_rays, n_circles = directions.shape[1], circles.shape[0]
    inverse, owner_of_ray = np.empty(n_rays), np.empty(n_rays, np.int32)
    hits = np.empty(n_circles, np.int32)
    for n in range(poses.shape[0]):
        scan_world(
            edges, poly_start, poly_start.shape[0] - 1, circles, n_circles,
            poses[n, 0], poses[n, 1], poses[n, 2], directions, angle_min, angle_increment, range_max,
            gap_quirk, inverse, owner_of_ray, hits, out[n],
        )  # fmt: skip


@kernel
def leg_circles(x, y, heading, speed, gait_x, gait_y, gait_theta, owner, rows):
    """Write the two legs of a human at x, y [m] into rows (2, 4), as in `circles`; the rest as for `leg_offset`."""
    dx, dy = leg_offset(heading, speed, gait_x, gait_y, gait_theta)
    rows[0, CIRCLE_X], rows[0, CIRCLE_Y] = x + dx, y + dy
    rows[1, CIRCLE_X], rows[1, CIRCLE_Y] = x - dx, y - dy
    for leg in range(LEGS_PER_HUMAN):
        rows[leg, CIRCLE_RADIUS] = LEG_RADIUS
        rows[leg, CIRCLE_OWNER] = owner
