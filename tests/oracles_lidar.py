"""Slow, dumb lidar: every ray against every edge and every circle, in float64 numpy.

Written from the definition (solve for the point on the ray and on the edge), sharing nothing with the kernel.
A ray that
passes within rounding of a corner or a tangent point has no single right answer, so the oracle gives the
ranges of rays turned a little to either side, and the comparison accepts either.
"""

from __future__ import annotations

import numpy as np

TURN = 1e-9  # [rad] to either side; 25 nm at 25 m
TOLERANCE = 1e-5  # [m]
INSIDE_RANGE = 1e-6  # the documented range from within a circle [m]


def brute_force(edges, circles, pose, angles, range_max):
    """Return ranges (n_rays,) float64 and the index of the circle that is the nearest hit, -1 if none is."""
    x, y, theta = pose
    dx, dy = np.cos(angles + theta), np.sin(angles + theta)
    ranges = np.full(len(angles), np.inf)
    for x1, y1, x2, y2 in edges:
        ax, ay, ex, ey = x1 - x, y1 - y, x2 - x1, y2 - y1
        with np.errstate(all="ignore"):
            det = dx * ey - dy * ex
            distance = (ax * ey - ay * ex) / det
            along = (ax * dy - ay * dx) / det
        hit = (det != 0) & (distance >= 0) & (along >= 0) & (along <= 1)
        ranges[hit] = np.minimum(ranges[hit], distance[hit])
    nearest = np.full(len(angles), -1)
    ranges = np.minimum(ranges, range_max)
    for i, (cx, cy, radius) in enumerate(circles):
        cx, cy = cx - x, cy - y
        if cx * cx + cy * cy <= radius * radius:
            distance = np.full(len(angles), INSIDE_RANGE)
        else:
            middle, off = dx * cx + dy * cy, dx * cy - dy * cx
            distance = np.where(
                (np.abs(off) <= radius) & (middle > 0),
                middle - np.sqrt(np.maximum(radius * radius - off * off, 0.0)),
                np.inf,
            )
        nearest[distance < ranges] = i
        ranges = np.minimum(ranges, distance)
    return ranges, nearest


def wrong_rays(scan, edges, circles, pose, angles, range_max):
    """Return the rays that neither side's answer explains, and the share of rays that have two answers."""
    left, _ = brute_force(edges, circles, pose, angles + TURN, range_max)
    right, _ = brute_force(edges, circles, pose, angles - TURN, range_max)
    scan = scan.astype(np.float64)
    low, high = np.minimum(left, right), np.maximum(left, right)
    good = (np.abs(scan - left) <= TOLERANCE) | (np.abs(scan - right) <= TOLERANCE)
    # Along a wall at a grazing angle the range itself changes quickly: anything between the two is right.
    good |= (high - low < 0.01) & (scan >= low - TOLERANCE) & (scan <= high + TOLERANCE)
    return np.flatnonzero(~good), float(np.mean(high - low > TOLERANCE))
