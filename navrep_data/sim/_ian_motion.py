# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""How agents on maps move: at once, or within limits of acceleration and jerk.

Source: odom_update of pepper_2d_simulator.py, asl-pepper-2d-sim 0.0.5 (SIM_FACTS d.3).
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._ian_layout import (
    T_HEIGHT,
    T_RESOLUTION,
    T_WIDTH,
    T_X0,
    T_Y0,
    W_AOMEGA,
    W_AX,
    W_AY,
    W_BODY_OMEGA,
    W_BODY_VX,
    W_BODY_VY,
    W_CMD_OMEGA,
    W_CMD_X,
    W_CMD_Y,
    W_LAST_GAIT_T,
    W_LAST_GAIT_X,
    W_LAST_GAIT_Y,
    W_LAST_HEADING,
    W_LAST_X,
    W_LAST_Y,
    W_LEFT,
    W_OMEGA,
    W_SEEN_GAIT_T,
    W_SEEN_GAIT_X,
    W_SEEN_GAIT_Y,
    W_SEEN_HEADING,
    W_SEEN_SPEED,
    W_SEEN_X,
    W_SEEN_Y,
    W_SHOWN_HEADING,
    W_SHOWN_OMEGA,
    W_SHOWN_VX,
    W_SHOWN_VY,
    W_SHOWN_X,
    W_SHOWN_Y,
)
from navrep_data.sim._ian_plan import cell_index
from navrep_data.sim._layout import A_GAIT_T, A_GAIT_X, A_GAIT_Y, A_HEADING, A_VX, A_VY, A_X, A_Y


@kernel
def move_at_once(agents, walkers, i, dt):
    """Move agent i with exactly its body command, along the heading before the step."""
    c, s = np.cos(agents[i, A_HEADING]), np.sin(agents[i, A_HEADING])
    vx, vy, omega = walkers[i, W_CMD_X], walkers[i, W_CMD_Y], walkers[i, W_CMD_OMEGA]
    agents[i, A_VX], agents[i, A_VY] = c * vx - s * vy, s * vx + c * vy
    walkers[i, W_OMEGA] = omega
    agents[i, A_X] += agents[i, A_VX] * dt
    agents[i, A_Y] += agents[i, A_VY] * dt
    agents[i, A_HEADING] += omega * dt
    walkers[i, W_BODY_VX], walkers[i, W_BODY_VY], walkers[i, W_BODY_OMEGA] = vx, vy, omega
    agents[i, A_GAIT_X] += vx * dt
    agents[i, A_GAIT_Y] += vy * dt
    agents[i, A_GAIT_T] += omega * dt


@kernel
def _accelerate(target, velocity, acceleration, limit, jerk, dt):
    """Return the next acceleration towards a velocity."""
    change = (target - velocity) / dt - acceleration
    change = min(max(change, -jerk * dt), jerk * dt)
    return min(max(acceleration + change, -limit), limit)


@kernel
def move_with_inertia(agents, walkers, i, limits, jerks, dt):
    """Move agent i with its old velocity, then change that by the acceleration and the acceleration by the command.

    limits, jerks (3,): largest acceleration and jerk along x, y of the map and of the rotation.
    """
    agents[i, A_X] += agents[i, A_VX] * dt
    agents[i, A_Y] += agents[i, A_VY] * dt
    agents[i, A_HEADING] += walkers[i, W_OMEGA] * dt
    agents[i, A_VX] += walkers[i, W_AX] * dt
    agents[i, A_VY] += walkers[i, W_AY] * dt
    walkers[i, W_OMEGA] += walkers[i, W_AOMEGA] * dt
    agents[i, A_GAIT_X] += walkers[i, W_BODY_VX] * dt
    agents[i, A_GAIT_Y] += walkers[i, W_BODY_VY] * dt
    agents[i, A_GAIT_T] += walkers[i, W_BODY_OMEGA] * dt
    c, s = np.cos(agents[i, A_HEADING]), np.sin(agents[i, A_HEADING])
    vx, vy = agents[i, A_VX], agents[i, A_VY]
    walkers[i, W_BODY_VX], walkers[i, W_BODY_VY] = c * vx + s * vy, c * vy - s * vx
    walkers[i, W_BODY_OMEGA] = walkers[i, W_OMEGA]
    tx = c * walkers[i, W_CMD_X] - s * walkers[i, W_CMD_Y]
    ty = s * walkers[i, W_CMD_X] + c * walkers[i, W_CMD_Y]
    walkers[i, W_AX] = _accelerate(tx, vx, walkers[i, W_AX], limits[0], jerks[0], dt)
    walkers[i, W_AY] = _accelerate(ty, vy, walkers[i, W_AY], limits[1], jerks[1], dt)
    walkers[i, W_AOMEGA] = _accelerate(
        walkers[i, W_CMD_OMEGA], walkers[i, W_OMEGA], walkers[i, W_AOMEGA], limits[2], jerks[2], dt
    )


@kernel
def roll_with_inertia(agents, walkers, i, limits, jerks, dt):
    """Move a robot that cannot slide sideways as :func:`move_with_inertia` does: one speed, along its heading."""
    agents[i, A_X] += agents[i, A_VX] * dt
    agents[i, A_Y] += agents[i, A_VY] * dt
    agents[i, A_HEADING] += walkers[i, W_OMEGA] * dt
    agents[i, A_GAIT_X] += walkers[i, W_BODY_VX] * dt
    agents[i, A_GAIT_T] += walkers[i, W_BODY_OMEGA] * dt
    speed = walkers[i, W_BODY_VX] + walkers[i, W_AX] * dt
    walkers[i, W_OMEGA] += walkers[i, W_AOMEGA] * dt
    agents[i, A_VX], agents[i, A_VY] = np.cos(agents[i, A_HEADING]) * speed, np.sin(agents[i, A_HEADING]) * speed
    walkers[i, W_BODY_VX], walkers[i, W_BODY_VY], walkers[i, W_BODY_OMEGA] = speed, 0.0, walkers[i, W_OMEGA]
    walkers[i, W_AX] = _accelerate(walkers[i, W_CMD_X], speed, walkers[i, W_AX], limits[0], jerks[0], dt)
    walkers[i, W_AOMEGA] = _accelerate(
        walkers[i, W_CMD_OMEGA], walkers[i, W_OMEGA], walkers[i, W_AOMEGA], limits[2], jerks[2], dt
    )


@kernel
def move_to(agents, walkers, i, vx, vy, dt):
    """Move a human with a velocity in the map frame, its heading along it; one that stands keeps its heading."""
    before = agents[i, A_HEADING]
    if vx != 0.0 or vy != 0.0:
        agents[i, A_HEADING] = np.arctan2(vy, vx)
    agents[i, A_X] += vx * dt
    agents[i, A_Y] += vy * dt
    agents[i, A_VX], agents[i, A_VY] = vx, vy
    agents[i, A_GAIT_X] += np.hypot(vx, vy) * dt
    agents[i, A_GAIT_T] += agents[i, A_HEADING] - before
    walkers[i, W_BODY_VX], walkers[i, W_BODY_VY], walkers[i, W_BODY_OMEGA] = np.hypot(vx, vy), 0.0, 0.0


@kernel
def keep_on_map(agents, walkers, i, map_row):
    """Put an agent that left the map on the centre of the nearest cell, and note it."""
    resolution, x0, y0 = map_row[T_RESOLUTION], map_row[T_X0], map_row[T_Y0]
    width, height = int(map_row[T_WIDTH]), int(map_row[T_HEIGHT])
    u = (np.float32(agents[i, A_X]) - np.float32(x0)) / np.float32(resolution)
    v = (np.float32(agents[i, A_Y]) - np.float32(y0)) / np.float32(resolution)
    inside = u >= np.float32(0.0) and v >= np.float32(0.0) and u < np.float32(width) and v < np.float32(height)
    walkers[i, W_LEFT] = 0.0 if inside else 1.0
    if not inside:
        step = np.float64(np.float32(resolution))
        agents[i, A_X] = (cell_index(agents[i, A_X], x0, resolution, width) + 0.5) * step + np.float32(x0)
        agents[i, A_Y] = (cell_index(agents[i, A_Y], y0, resolution, height) + 0.5) * step + np.float32(y0)


@kernel
def stop(agents, walkers, i):
    """Take agent i's velocity away; its acceleration stays, as in the original."""
    agents[i, A_VX], agents[i, A_VY] = 0.0, 0.0
    walkers[i, W_OMEGA] = 0.0
    walkers[i, W_BODY_VX], walkers[i, W_BODY_VY], walkers[i, W_BODY_OMEGA] = 0.0, 0.0, 0.0


@kernel
def put_back(agents, walkers, i):
    """Bounce: put agent i back to where it was at the end of the step before, at rest."""
    agents[i, A_X], agents[i, A_Y] = walkers[i, W_LAST_X], walkers[i, W_LAST_Y]
    agents[i, A_HEADING] = walkers[i, W_LAST_HEADING]
    agents[i, A_GAIT_X], agents[i, A_GAIT_Y] = walkers[i, W_LAST_GAIT_X], walkers[i, W_LAST_GAIT_Y]
    agents[i, A_GAIT_T] = walkers[i, W_LAST_GAIT_T]
    stop(agents, walkers, i)


@kernel
def remember(agents, walkers, n):
    """Note where everybody is at the end of a step."""
    for i in range(n):
        walkers[i, W_LAST_X], walkers[i, W_LAST_Y] = agents[i, A_X], agents[i, A_Y]
        walkers[i, W_LAST_HEADING] = agents[i, A_HEADING]
        walkers[i, W_LAST_GAIT_X], walkers[i, W_LAST_GAIT_Y] = agents[i, A_GAIT_X], agents[i, A_GAIT_Y]
        walkers[i, W_LAST_GAIT_T] = agents[i, A_GAIT_T]


@kernel
def show(agents, walkers, n):
    """Note what lidar and robot state show from now on."""
    for i in range(n):
        walkers[i, W_SEEN_X], walkers[i, W_SEEN_Y] = agents[i, A_X], agents[i, A_Y]
        walkers[i, W_SEEN_HEADING] = agents[i, A_HEADING]
        walkers[i, W_SEEN_SPEED] = np.hypot(agents[i, A_VX], agents[i, A_VY])
        walkers[i, W_SEEN_GAIT_X], walkers[i, W_SEEN_GAIT_Y] = agents[i, A_GAIT_X], agents[i, A_GAIT_Y]
        walkers[i, W_SEEN_GAIT_T] = agents[i, A_GAIT_T]
        walkers[i, W_SHOWN_X], walkers[i, W_SHOWN_Y] = agents[i, A_X], agents[i, A_Y]
        walkers[i, W_SHOWN_HEADING] = agents[i, A_HEADING]
        walkers[i, W_SHOWN_VX], walkers[i, W_SHOWN_VY] = walkers[i, W_BODY_VX], walkers[i, W_BODY_VY]
        walkers[i, W_SHOWN_OMEGA] = walkers[i, W_BODY_OMEGA]
