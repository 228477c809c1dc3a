# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""What the robots of a world on a map observe."""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._ellipse import body_ellipse, draw_ellipses
from navrep_data.sim._grid_lidar import QUIRK_MANY, QUIRK_NONE, grid_inverse_ranges, scan_grid
from navrep_data.sim._ian_contact import body_circles
from navrep_data.sim._ian_layout import (
    M_MAP,
    R_ELLIPSE,
    R_LEGS,
    R_ORIGINAL,
    R_ROBOTS,
    T_HEIGHT,
    T_RANGE_MAX,
    T_RESOLUTION,
    T_SQUARES,
    T_WIDTH,
    T_X0,
    T_Y0,
    W_SEEN_HEADING,
    W_SEEN_X,
    W_SEEN_Y,
    W_SHOWN_HEADING,
    W_SHOWN_OMEGA,
    W_SHOWN_VX,
    W_SHOWN_VY,
    W_SHOWN_X,
    W_SHOWN_Y,
)
from navrep_data.sim._layout import (
    A_GX,
    A_GY,
    A_RADIUS,
    F_NOISE,
    F_WANT_LABELS,
    P_ANGLE_INCREMENT,
    P_ANGLE_MIN,
    P_RANGE_MAX,
    RAY_NOTHING,
    S_HUMANS,
)
from navrep_data.sim._lidar import BEARING_ERROR, CIRCLE_OWNER
from navrep_data.sim._noise import disturb
from navrep_data.sim._step import note_static

TWO_PI = 2.0 * np.pi


@kernel
def other_bodies(i, agents, walkers, robots, n_humans, rules, bodies):
    """Write what the lidar of robot i sees of the others; returns how many circles or ellipses.

    Owners are the others of robot i: the humans, then the other robots. `bodies` needs two rows per agent.
    """
    n = robots + n_humans
    count = 0
    if rules[R_ELLIPSE]:
        for j in range(n):
            if j != i:
                x, y, heading = walkers[j, W_SEEN_X], walkers[j, W_SEEN_Y], walkers[j, W_SEEN_HEADING]
                owner = other_slot(i, j, robots, n_humans)
                body_ellipse(x, y, heading, agents[j, A_RADIUS], owner, bodies[count])
                count += 1
        return count
    legs = rules[R_LEGS] != 0.0
    body_circles(agents, walkers, n, legs, bodies)
    # leave robot i out by moving the rows behind it up; a trunk is drawn once
    for j in range(n):
        if j == i:
            continue
        for k in range(2 * j, 2 * j + (2 if legs else 1)):
            bodies[count, 0], bodies[count, 1], bodies[count, 2] = bodies[k, 0], bodies[k, 1], bodies[k, 2]
            bodies[count, CIRCLE_OWNER] = other_slot(i, j, robots, n_humans)
            count += 1
    return count


@kernel
def _scan_ellipses(squares, map_row, bodies, count, x, y, theta, dirs, params, range_max, inverse, owners, hits, out):
    """Scan a map with ellipses on it."""
    per_radian = 1.0 / params[P_ANGLE_INCREMENT]
    zero = (params[P_ANGLE_MIN] - TWO_PI * np.floor(params[P_ANGLE_MIN] / TWO_PI + 0.5)) * per_radian
    inverse[:] = 1.0 / range_max
    owners[:] = -1
    hits[:] = 0
    grid_inverse_ranges(
        squares, map_row[T_X0], map_row[T_Y0], map_row[T_RESOLUTION], x, y, theta, dirs, inverse
    )  # fmt: skip
    draw_ellipses(
        bodies, count, x, y, np.cos(theta), np.sin(theta), dirs, inverse, owners, hits, per_radian, zero,
        TWO_PI * per_radian, BEARING_ERROR * per_radian,
    )  # fmt: skip
    for k in range(out.shape[0]):
        value = 1.0 / inverse[k]
        out[k] = np.float32(value if value < range_max else range_max)


@kernel
def scan_map_world(
    i, agents, walkers, scalars, place, maps, rules, bodies, dirs, inv_work, owner_work, hits, params, flags, out
):  # fmt: skip
    """Fill out (n_rays,) float32 with the ranges that robot i sees [m], and hits with the rays on each other agent."""
    robots = int(rules[R_ROBOTS])
    count = other_bodies(i, agents, walkers, robots, int(scalars[S_HUMANS]), rules, bodies)
    map_row = maps.table[int(place[M_MAP])]
    width, height = int(map_row[T_WIDTH]), int(map_row[T_HEIGHT])
    start = int(map_row[T_SQUARES])
    squares = maps.squares[start : start + 4 * (width + 1) * (height + 1)].reshape(4, width + 1, height + 1)
    range_max = min(map_row[T_RANGE_MAX], params[P_RANGE_MAX])
    x, y, theta = walkers[i, W_SEEN_X], walkers[i, W_SEEN_Y], walkers[i, W_SEEN_HEADING]
    original = rules[R_ORIGINAL] != 0.0
    if rules[R_ELLIPSE]:
        _scan_ellipses(
            squares, map_row, bodies, count, x, y, theta, dirs, params, range_max, inv_work, owner_work, hits, out
        )
    else:
        scan_grid(
            squares, map_row[T_X0], map_row[T_Y0], map_row[T_RESOLUTION], bodies, count, x, y, theta, dirs,
            params[P_ANGLE_MIN], params[P_ANGLE_INCREMENT], range_max, QUIRK_MANY if original else QUIRK_NONE,
            inv_work, owner_work, hits, out,
        )  # fmt: skip
    if not original:
        _see_rim(map_row, width, height, x, y, theta, dirs, owner_work, out)
    if flags[F_WANT_LABELS]:
        note_static(owner_work, range_max, out)
    if flags[F_NOISE]:
        disturb(scalars, i, params, out)


@kernel
def other_slot(i, j, robots, n_humans):
    """Return the place of agent j among the others of robot i: humans first, then the other robots."""
    if j >= robots:
        return j - robots
    return n_humans + (j if j < i else j - 1)


@kernel
def _see_rim(map_row, width, height, x, y, theta, dirs, owner_of_ray, out):
    """Cut ranges where rays leave the map: its rim is as solid to the lidar as it is to the robot."""
    resolution = map_row[T_RESOLUTION]
    left, low = map_row[T_X0] - x, map_row[T_Y0] - y
    right, high = left + width * resolution, low + height * resolution
    ct, st = np.cos(theta), np.sin(theta)
    for k in range(out.shape[0]):
        c = ct * dirs[0, k] - st * dirs[1, k]
        s = st * dirs[0, k] + ct * dirs[1, k]
        tx = (right if c > 0.0 else left) / c if c != 0.0 else np.inf
        ty = (high if s > 0.0 else low) / s if s != 0.0 else np.inf
        rim = np.float32(max(min(tx, ty), 0.0))
        if rim < out[k]:
            out[k] = rim
            owner_of_ray[k] = RAY_NOTHING  # who stands behind it is not seen


@kernel
def state_on_map(i, agents, walkers, out):
    """Fill out (5,) with goal x, goal y [m], vx, vy [m/s], omega [rad/s] in the frame of robot i."""
    c, s = np.cos(walkers[i, W_SHOWN_HEADING]), np.sin(walkers[i, W_SHOWN_HEADING])
    gx = agents[i, A_GX] - walkers[i, W_SHOWN_X]
    gy = agents[i, A_GY] - walkers[i, W_SHOWN_Y]
    out[0], out[1] = c * gx + s * gy, c * gy - s * gx
    out[2], out[3], out[4] = walkers[i, W_SHOWN_VX], walkers[i, W_SHOWN_VY], walkers[i, W_SHOWN_OMEGA]
