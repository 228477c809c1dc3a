# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""ORCA on maps: humans, or a robot, that go down their goal field and avoid each other and the map's contours.

ORCA alone looks no further than the next wall; the goal field knows the way round it.
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._fast_marching import CORNERS_CLOSED, TIE_FIRST, descend
from navrep_data.sim._ian_layout import (
    M_MAP,
    R_ROBOTS,
    T_EDGES,
    T_PLAN_RESOLUTION,
    T_WAYPOINT,
    T_X0,
    T_Y0,
    W_FIELD,
)
from navrep_data.sim._ian_plan import TASK_POINTS, cell_index, goal_field
from navrep_data.sim._layout import A_GX, A_GY, A_RADIUS, A_VPREF, A_VX, A_VY, A_X, A_Y
from navrep_data.sim._orca import orca_velocity

# ours: agents keep this clear of each other and of walls [m]; more than contours are off the cells
MARGIN = 0.05
# straight to the goal from this near [m]
NEAR_GOAL = 1.0


@kernel
def way_point(agents, walkers, i, maps, own_field, map_row, rng, path):
    """Return a point about a metre ahead of agent i on its way to the goal [m]; the goal itself where that is near."""
    x, y, gx, gy = agents[i, A_X], agents[i, A_Y], agents[i, A_GX], agents[i, A_GY]
    if np.hypot(gx - x, gy - y) < NEAR_GOAL:
        return gx, gy
    field = goal_field(maps, own_field, map_row, int(walkers[i, W_FIELD]))
    resolution = map_row[T_PLAN_RESOLUTION]
    ci = cell_index(x, map_row[T_X0], resolution, field.shape[0])
    cj = cell_index(y, map_row[T_Y0], resolution, field.shape[1])
    most = min(TASK_POINTS, int(map_row[T_WAYPOINT]))
    count = descend(field, ci, cj, TIE_FIRST, CORNERS_CLOSED, rng, path[: most + 1])
    if count < 2:  # at the goal's cell, or where no way leads on
        return gx, gy
    px = map_row[T_X0] + (path[count - 1, 0] + 0.5) * resolution
    py = map_row[T_Y0] + (path[count - 1, 1] + 0.5) * resolution
    return px, py


@kernel
def pack_agents(agents, n, orca):
    """Write the agents as ORCA sees them."""
    for i in range(n):
        orca.agents[i, 0] = agents[i, A_X]
        orca.agents[i, 1] = agents[i, A_Y]
        orca.agents[i, 2] = agents[i, A_VX]
        orca.agents[i, 3] = agents[i, A_VY]
        orca.agents[i, 4] = agents[i, A_RADIUS] + MARGIN
        orca.agents[i, 5] = agents[i, A_VPREF]


@kernel
def guided_velocity(agents, walkers, i, lo, n, extra, place, own_field, maps, map_row, orca, rng, path):
    """Return the ORCA velocity of agent i, world frame [m/s]; the neighbours are rows lo to n - 1, and `extra`."""
    wx, wy = way_point(agents, walkers, i, maps, own_field, map_row, rng, path)
    dx, dy = wx - agents[i, A_X], wy - agents[i, A_Y]
    distance = np.hypot(dx, dy)
    scale = agents[i, A_VPREF] / max(distance, agents[i, A_VPREF])
    m = int(place[M_MAP])
    vx, vy = orca_velocity(
        i, orca.agents, lo, n, extra, np.float32(dx * scale), np.float32(dy * scale), orca.edges_f[m], orca.edges_i[m],
        int(map_row[T_EDGES]), orca.params, orca.work_f, orca.work_i,
    )  # fmt: skip
    return np.float64(vx), np.float64(vy)


@kernel
def choose_orca(agents, walkers, place, own_field, maps, map_row, rules, orca, n, rng, path, moves):
    """Let every human choose its velocity by ORCA; writes moves (N, 2). All see the robots."""
    pack_agents(agents, n, orca)
    for i in range(int(rules[R_ROBOTS]), n):
        moves[i, 0], moves[i, 1] = guided_velocity(
            agents, walkers, i, 0, n, -1, place, own_field, maps, map_row, orca, rng, path
        )
