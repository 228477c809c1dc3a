# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""What the robots of a world on a map observe."""

import numpy as np

from navrep_data._kernels import kernel
from navrep_data.sim._grid_lidar import QUIRK_MANY, QUIRK_NONE, scan_grid
from navrep_data.sim._ian_contact import body_circles
from navrep_data.sim._ian_layout import (
    M_MAP,
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
from navrep_data.sim._layout import A_GX, A_GY, P_ANGLE_INCREMENT, P_ANGLE_MIN, P_RANGE_MAX, S_HUMANS
from navrep_data.sim._lidar import CIRCLE_OWNER


@kernel
def scan_map_world(
    i, agents, walkers, scalars, place, maps, rules, circles, dirs, inv_work, owner_work, hits, params, out
):  # fmt: skip
    """Fill out (n_rays,) float32 with the ranges that robot i sees [m], and hits with the rays on each other agent.

    Owners are the others of robot i: the humans, then the other robots.
    """
    robots = int(rules[R_ROBOTS])
    n = robots + int(scalars[S_HUMANS])
    map_row = maps.table[int(place[M_MAP])]
    legs = rules[R_LEGS] != 0.0
    body_circles(agents, walkers, n, legs, circles)
    # leave robot i out, by moving the circles before it up; a trunk is drawn once
    count = 0
    for j in range(n):
        if j == i:
            continue
        owner = other_slot(i, j, robots, n - robots)
        for k in range(2 if legs else 1):
            circles[count, 0], circles[count, 1] = circles[2 * j + k, 0], circles[2 * j + k, 1]
            circles[count, 2], circles[count, CIRCLE_OWNER] = circles[2 * j + k, 2], owner
            count += 1
    width, height = int(map_row[T_WIDTH]), int(map_row[T_HEIGHT])
    start = int(map_row[T_SQUARES])
    squares = maps.squares[start : start + 4 * (width + 1) * (height + 1)].reshape(4, width + 1, height + 1)
    range_max = min(map_row[T_RANGE_MAX], params[P_RANGE_MAX])
    x, y, theta = walkers[i, W_SEEN_X], walkers[i, W_SEEN_Y], walkers[i, W_SEEN_HEADING]
    original = rules[R_ORIGINAL] != 0.0
    scan_grid(
        squares, map_row[T_X0], map_row[T_Y0], map_row[T_RESOLUTION], circles, count, x, y, theta, dirs,
        params[P_ANGLE_MIN], params[P_ANGLE_INCREMENT], range_max, QUIRK_MANY if original else QUIRK_NONE,
        inv_work, owner_work, hits, out,
    )  # fmt: skip
    if not original:
        _see_rim(map_row, width, height, x, y, theta, dirs, out)


@kernel
def other_slot(i, j, robots, n_humans):
    """Return the place of agent j among the others of robot i: humans first, then the other robots."""
    if j >= robots:
        return j - robots
    return n_humans + (j if j < i else j - 1)


@kernel
def _see_rim(map_row, width, height, x, y, theta, dirs, out):
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
        out[k] = min(out[k], np.float32(max(min(tx, ty), 0.0)))


@kernel
def state_on_map(i, agents, walkers, out):
    """Fill out (5,) with goal x, goal y [m], vx, vy [m/s], omega [rad/s] in the frame of robot i."""
    c, s = np.cos(walkers[i, W_SHOWN_HEADING]), np.sin(walkers[i, W_SHOWN_HEADING])
    gx = agents[i, A_GX] - walkers[i, W_SHOWN_X]
    gy = agents[i, A_GY] - walkers[i, W_SHOWN_Y]
    out[0], out[1] = c * gx + s * gy, c * gy - s * gx
    out[2], out[3], out[4] = walkers[i, W_SHOWN_VX], walkers[i, W_SHOWN_VY], walkers[i, W_SHOWN_OMEGA]
