# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""The linear programs of ORCA: the best velocity under half-planes and a speed limit, as in RVO2.

A line is x, y, dx, dy in a flat array; velocities to its left are allowed. Lines of NaN constrain nothing.
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._obstacles import RVO_EPSILON

LINE_FIELDS = 4
# Loops over neighbours run on whole blocks, so their arrays have this much room to spare.
BLOCK = 16

F0 = np.float32(0.0)
F1 = np.float32(1.0)
HALF = np.float32(0.5)
NAN = np.float32(np.nan)


@kernel(inline=True)
def whole_blocks(n):
    """Round up to whole vectors: the rest of a loop would run one by one, and is mostly all of it."""
    return (n + BLOCK - 1) // BLOCK * BLOCK


@kernel(inline=True)
def unit(x, y):
    length = np.sqrt(x * x + y * y)
    scale = F1 / (length if length > F0 else NAN)
    return x * scale, y * scale


@kernel(inline=True)
def _program1(lines, line, radius, ox, oy, direction):
    """Optimise along one line under the lines before it and the speed limit: (found, x, y)."""
    px = lines[4 * line]
    py = lines[4 * line + 1]
    dx = lines[4 * line + 2]
    dy = lines[4 * line + 3]
    dot = px * dx + py * dy
    discriminant = dot * dot + radius * radius - (px * px + py * py)
    if discriminant < F0:
        return False, F0, F0
    root = np.sqrt(discriminant)
    t_left = -dot - root
    t_right = -dot + root
    for k in range(line):
        kdx = lines[4 * k + 2]
        kdy = lines[4 * k + 3]
        denominator = dx * kdy - dy * kdx
        numerator = kdx * (py - lines[4 * k + 1]) - kdy * (px - lines[4 * k])
        if abs(denominator) <= RVO_EPSILON:
            if numerator < F0:
                return False, F0, F0
            continue
        t = numerator / denominator
        if denominator >= F0:
            t_right = t if t < t_right else t_right
        else:
            t_left = t if t_left < t else t_left
        if t_left > t_right:
            return False, F0, F0
    if direction:
        t = t_right if ox * dx + oy * dy > F0 else t_left
    else:
        t = dx * (ox - px) + dy * (oy - py)
        t = t_left if t < t_left else (t_right if t > t_right else t)
    return True, px + t * dx, py + t * dy


@kernel(inline=True)
def program2(lines, n, radius, ox, oy, direction):
    """Find the allowed velocity nearest to (ox, oy) or farthest along it: (line that fails or n, x, y)."""
    if direction:
        x = ox * radius
        y = oy * radius
    elif ox * ox + oy * oy > radius * radius:
        x, y = unit(ox, oy)
        x *= radius
        y *= radius
    else:
        x = ox
        y = oy
    for k in range(n):
        # (line point - result) left of the direction: the result violates it
        if lines[4 * k + 2] * (lines[4 * k + 1] - y) - lines[4 * k + 3] * (lines[4 * k] - x) > F0:
            found, new_x, new_y = _program1(lines, k, radius, ox, oy, direction)
            if not found:
                return k, x, y
            x = new_x
            y = new_y
    return n, x, y


@kernel(inline=True)
def _project(ix, iy, idx, idy, count, lines, projected):
    """Turn `count` lines into constraints on the velocities that violate the given line as much as them."""
    for j in range(whole_blocks(count)):
        jx = lines[4 * j]
        jy = lines[4 * j + 1]
        jdx = lines[4 * j + 2]
        jdy = lines[4 * j + 3]
        determinant = idx * jdy - idy * jdx
        parallel = abs(determinant) <= RVO_EPSILON
        t = (jdx * (iy - jy) - jdy * (ix - jx)) / (F1 if parallel else determinant)
        projected[4 * j] = HALF * (ix + jx) if parallel else ix + t * idx
        projected[4 * j + 1] = HALF * (iy + jy) if parallel else iy + t * idy
        ux = jdx - idx
        uy = jdy - idy
        length = np.sqrt(ux * ux + uy * uy)
        # Parallel and of the same direction: RVO2 leaves the line out; one of NaN constrains nothing either.
        idle = (parallel & (idx * jdx + idy * jdy > F0)) | (length <= F0)
        scale = F1 / (NAN if idle else length)
        projected[4 * j + 2] = ux * scale
        projected[4 * j + 3] = uy * scale


@kernel(inline=True)
def program3(lines, n_obstacle, n, begin, radius, x, y, projected):
    """Find the velocity that violates the agents' lines least where no velocity satisfies all."""
    for k in range(LINE_FIELDS * n_obstacle):
        projected[k] = lines[k]
    distance = F0
    for i in range(begin, n):
        ix = lines[4 * i]
        iy = lines[4 * i + 1]
        idx = lines[4 * i + 2]
        idy = lines[4 * i + 3]
        if not idx * (iy - y) - idy * (ix - x) > distance:
            continue
        # begin may lie among the obstacles' lines: those are never projected
        m = max(i, n_obstacle)
        _project(ix, iy, idx, idy, m - n_obstacle, lines[4 * n_obstacle :], projected[4 * n_obstacle :])
        failed, new_x, new_y = program2(projected, m, radius, -idy, idx, True)
        if failed == m:  # else rounding made an impossible failure: keep the result
            x = new_x
            y = new_y
        distance = idx * (iy - y) - idy * (ix - x)
    return x, y
