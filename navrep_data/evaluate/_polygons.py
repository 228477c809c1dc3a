# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""What the benchmark reads from batches of polygon worlds: gaps around the robot, and what ORCA would do."""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._geometry import swept_clearance
from navrep_data.sim._layout import A_RADIUS, A_X, A_Y, S_HUMANS, S_OBST_ROBOT, S_POLYGONS
from navrep_data.sim._step import orca_choice, pack_orca


@kernel
def human_gap(agents, n_humans):
    """Return the gap between the robot's disc and the nearest human's [m], infinity without humans."""
    best = np.inf
    for i in range(1, n_humans + 1):
        distance = np.hypot(agents[i, A_X] - agents[0, A_X], agents[i, A_Y] - agents[0, A_Y])
        best = min(best, distance - agents[i, A_RADIUS] - agents[0, A_RADIUS])
    return best


@kernel
def polygon_gaps(agents, scalars, edges, polygon_start, to_human, to_static):
    """Fill to_human (W,) and to_static (W,) with the gaps around the robots of all worlds [m]."""
    for w in range(agents.shape[0]):
        to_human[w] = human_gap(agents[w], int(scalars[w, S_HUMANS]))
        x, y = agents[w, 0, A_X], agents[w, 0, A_Y]
        n = int(scalars[w, S_POLYGONS])
        to_static[w] = swept_clearance(x, y, x, y, edges[w], polygon_start[w], n) - agents[w, 0, A_RADIUS]


@kernel
def orca_robots(agents, agents32, scalars, obst_f, obst_i, orca_params, work_f, work_i, out):
    """Fill out (W, 2) with the velocity that ORCA chooses for the robots [m/s], world frame; they see all humans."""
    for w in range(agents.shape[0]):
        n = int(scalars[w, S_HUMANS])
        pack_orca(agents[w], n + 1, agents32)
        vx, vy = orca_choice(
            0, agents[w], agents32, 1, n, obst_f[w, -1], obst_i[w, -1], int(scalars[w, S_OBST_ROBOT]), orca_params,
            work_f, work_i,
        )  # fmt: skip
        out[w, 0] = vx
        out[w, 1] = vy
