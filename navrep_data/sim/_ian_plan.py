# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Humans that walk along the shortest way on a map: tasks, waypoints and velocity commands.

Source: pepper_2d_iarlenv.py of asl-pepper-2d-sim 0.0.5 and CMap2D.pyx of pymap2d 0.1.15 (SIM_FACTS d.4).
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._fast_marching import CORNERS_CLOSED, CORNERS_ORIGINAL, TIE_RANDOM, descend
from navrep_data.sim._ian_layout import (
    T_PLAN_HEIGHT,
    T_PLAN_RESOLUTION,
    T_PLAN_WIDTH,
    T_WAYPOINT,
    T_X0,
    T_Y0,
    TASK_LOITER,
    TASK_NONE,
    TASK_WALK,
    W_CMD_OMEGA,
    W_CMD_X,
    W_CMD_Y,
    W_FIELD,
    W_TASK,
    W_TASK_TIME,
    W_WAY_X,
    W_WAY_Y,
)
from navrep_data.sim._layout import A_GX, A_GY, A_HEADING, A_RADIUS, A_X, A_Y

# pepper_2d_simulator.py: goals are reached within the radius and this [m]
GOAL_PADDING = 0.2
# pepper_2d_iarlenv.py: a task lasts at most this long [s], and goes at most to this point of the path
TASK_SECONDS = 10.0
TASK_POINTS = 10
LOITER_FACTOR = 0.8
# largest velocity of a human along and across its heading [m/s] and of its rotation [rad/s]
HUMAN_SPEED = 0.8
HUMAN_OMEGA = 1.0


@kernel
def cell_index(value, origin, resolution, size):
    """Return the cell of a coordinate [m], in the original's float32; what lies outside is put on the rim."""
    cell = (np.float32(value) - np.float32(origin)) / np.float32(resolution)
    if cell >= np.float32(size):
        return size - 1
    if cell < np.float32(0.0):
        return 0
    return int(cell)


@kernel
def goal_field(maps, own_field, map_row, index):
    """Return the goal field with this index as (W, H) float32; -1 is the world's own."""
    width, height = int(map_row[T_PLAN_WIDTH]), int(map_row[T_PLAN_HEIGHT])
    size = width * height
    if index < 0:
        return own_field[:size].reshape(width, height)
    start = maps.field_start[index]
    return maps.fields[start : start + size].reshape(width, height)


@kernel
def way_ahead(x, y, field, map_row, original, rng, path):
    """Return the point about a metre ahead on the way down the field from (x, y) [m].

    The original always walks to the end, and so draws for ties far ahead.
    """
    resolution = map_row[T_PLAN_RESOLUTION]
    i = cell_index(x, map_row[T_X0], resolution, field.shape[0])
    j = cell_index(y, map_row[T_Y0], resolution, field.shape[1])
    most = min(TASK_POINTS, int(map_row[T_WAYPOINT]))
    if original:
        count = descend(field, i, j, TIE_RANDOM, CORNERS_ORIGINAL, rng, path)
    else:
        count = descend(field, i, j, TIE_RANDOM, CORNERS_CLOSED, rng, path[: most + 1])
    k = min(most, count - 1)
    # the original's map arithmetic: float32 resolution and origin, points stored as float32
    step = np.float64(np.float32(resolution))
    px = np.float32((path[k, 0] + 0.5) * step + np.float64(np.float32(map_row[T_X0])))
    py = np.float32((path[k, 1] + 0.5) * step + np.float64(np.float32(map_row[T_Y0])))
    return np.float64(px), np.float64(py)


@kernel
def at_goal(agents, i):
    """Return whether agent i is within its radius and 0.2 m of its goal."""
    gap = np.hypot(agents[i, A_X] - agents[i, A_GX], agents[i, A_Y] - agents[i, A_GY])
    return gap < agents[i, A_RADIUS] + GOAL_PADDING


@kernel
def give_tasks(agents, walkers, first, n, time, maps, own_field, map_row, original, rng, path):
    """Give a task to every human (rows first .. n - 1) that has none."""
    for i in range(first, n):
        if walkers[i, W_TASK] != TASK_NONE:
            continue
        if at_goal(agents, i):
            walkers[i, W_TASK] = TASK_LOITER
            walkers[i, W_WAY_X], walkers[i, W_WAY_Y] = agents[i, A_GX], agents[i, A_GY]
        else:
            field = goal_field(maps, own_field, map_row, int(walkers[i, W_FIELD]))
            walkers[i, W_TASK] = TASK_WALK
            walkers[i, W_WAY_X], walkers[i, W_WAY_Y] = way_ahead(
                agents[i, A_X], agents[i, A_Y], field, map_row, original, rng, path
            )
        walkers[i, W_TASK_TIME] = time


@kernel
def limit_command(vx, vy, omega, max_vx, max_vy, max_omega):
    """Return a body command clipped to the largest velocities, the diagonal not faster than straight on."""
    nx = min(max(vx / max_vx, -1.0), 1.0)
    ny = min(max(vy / max_vy, -1.0), 1.0)
    turn = min(max(omega / max_omega, -1.0), 1.0)
    norm = np.sqrt(nx * nx + ny * ny)
    if norm > 1.0:
        nx /= norm
        ny /= norm
    return nx * max_vx, ny * max_vy, turn * max_omega


@kernel
def follow_tasks(agents, walkers, contacts, first, n, time):
    """Write the humans' commands towards their waypoints, and end tasks that are done or have taken too long."""
    for i in range(first, n):
        c, s = np.cos(agents[i, A_HEADING]), np.sin(agents[i, A_HEADING])
        ox, oy = walkers[i, W_WAY_X] - agents[i, A_X], walkers[i, W_WAY_Y] - agents[i, A_Y]
        dx, dy = c * ox + s * oy, c * oy - s * ox
        turn = np.arctan2(dy, dx)
        loiters = walkers[i, W_TASK] == TASK_LOITER
        if time - walkers[i, W_TASK_TIME] > TASK_SECONDS:
            walkers[i, W_TASK] = TASK_NONE
            for j in range(n):  # whom one could not pass may let one through the next time
                if contacts[i, j] == 1:
                    contacts[i, j] = 0
                    contacts[j, i] = 0
        if loiters:
            dx, dy, turn = LOITER_FACTOR * dx, LOITER_FACTOR * dy, LOITER_FACTOR * turn
        elif np.hypot(ox, oy) < agents[i, A_RADIUS]:
            walkers[i, W_TASK] = TASK_NONE
            dx, dy, turn = 0.0, 0.0, 0.0
        vx, vy, omega = limit_command(dx, dy, turn, HUMAN_SPEED, HUMAN_SPEED, HUMAN_OMEGA)
        walkers[i, W_CMD_X], walkers[i, W_CMD_Y], walkers[i, W_CMD_OMEGA] = vx, vy, omega
