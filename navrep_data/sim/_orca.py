# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""ORCA: the collision-free velocity nearest to a preferred one, with the exact semantics of RVO2 2.0.3.

Everything is float32 and in RVO2's order of operations, so that results are equal to the C++ library's bit
for bit (on machines whose C++ compiler does not fuse multiply and add). A line is a point and a direction;
allowed velocities lie to its left. Lines that divide by zero there become NaN and constrain nothing; the same
happens here.

Where RVO2 branches per neighbour, the loops here compute both branches and select, to run on vectors.
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._obstacles import (
    OF_DX,
    OF_DY,
    OF_EX,
    OF_EY,
    OF_LEN2,
    OF_X,
    OF_X2,
    OF_Y,
    OF_Y2,
    OI_CONVEX,
    OI_NEXT,
    OI_PREV,
    RVO_EPSILON,
)
from navrep_data.sim._orca_lp import F0, F1, HALF, NAN, program2, program3, unit, whole_blocks
from navrep_data.sim._orca_neighbors import (
    INF,
    OA_MAX_SPEED,
    OA_RADIUS,
    OA_VX,
    OA_VY,
    OA_X,
    OA_Y,
    ORCA_AGENT_FIELDS,
    WORK_COVERED,
    WORK_EDGE,
    WORK_LINE,
    WORK_NEIGHBOR,
    WORK_PROJ,
    WORK_X1,
    WORK_X2,
    WORK_Y1,
    WORK_Y2,
    agent_neighbors,
    make_orca_work,
    obstacle_neighbors,
)

__all__ = [
    "OA_MAX_SPEED",
    "OA_RADIUS",
    "OA_VX",
    "OA_VY",
    "OA_X",
    "OA_Y",
    "OP_DT",
    "OP_KEEP_LIMIT",
    "OP_MAX_NEIGHBORS",
    "OP_NEIGHBOR_DIST",
    "OP_TIME_HORIZON",
    "OP_TIME_HORIZON_OBST",
    "ORCA_AGENT_FIELDS",
    "ORCA_PARAM_FIELDS",
    "make_orca_work",
    "orca_step",
    "orca_velocity",
]

# --- params (ORCA_PARAM_FIELDS,) float32 --------------------------------------------------------------------
OP_NEIGHBOR_DIST = 0
OP_MAX_NEIGHBORS = 1
OP_TIME_HORIZON = 2
OP_TIME_HORIZON_OBST = 3
OP_DT = 4
OP_KEEP_LIMIT = 5  # 1: the largest speed holds even where RVO2's arithmetic loses it
ORCA_PARAM_FIELDS = 6


@kernel(inline=True)
def _edge_ends(px, py, inv_tau, n, edges, obst_f, x1, y1, x2, y2, covered):
    """Write the (scaled) ends of `n` edges as seen from the agent, and that no line covers them yet."""
    for k in range(n):
        j = edges[k]
        x1[k] = inv_tau * (obst_f[OF_X, j] - px)
        y1[k] = inv_tau * (obst_f[OF_Y, j] - py)
        x2[k] = inv_tau * (obst_f[OF_X2, j] - px)
        y2[k] = inv_tau * (obst_f[OF_Y2, j] - py)
        covered[k] = 0


@kernel(inline=True)
def _cover(lx, ly, dx, dy, scaled_radius, n, x1, y1, x2, y2, covered):
    """Mark those of `n` edges both (scaled) ends of which a line keeps the agent off."""
    for k in range(whole_blocks(n)):
        first = (x1[k] - lx) * dy - (y1[k] - ly) * dx - scaled_radius >= -RVO_EPSILON
        second = (x2[k] - lx) * dy - (y2[k] - ly) * dx - scaled_radius >= -RVO_EPSILON
        covered[k] |= np.int32(1) if first & second else np.int32(0)


@kernel(inline=True)
def _tangent(x, y, dist_sq, radius, radius_sq, sign):
    """Direction of the tangent from the origin to a circle at (x, y); `sign` +1 = left, -1 = right."""
    leg = np.sqrt(dist_sq - radius_sq)
    scale = F1 / dist_sq
    r = sign * radius
    return (x * leg - y * r) * scale, (x * r + y * leg) * scale


@kernel(inline=True)
def _put_line(x, y, dx, dy, n_lines, lines):
    lines[4 * n_lines] = x
    lines[4 * n_lines + 1] = y
    lines[4 * n_lines + 2] = dx
    lines[4 * n_lines + 3] = dy
    return n_lines + 1


@kernel(inline=True)
def _edge_line(j, px, py, vx, vy, radius, inv_tau, n, obst_f, obst_i, lines):
    """Add the constraint of edge `j`, which none covers, to the `n` lines, if it makes one; return their number."""
    o1 = j
    o2 = obst_i[OI_NEXT, j]
    r1x = obst_f[OF_X, o1] - px
    r1y = obst_f[OF_Y, o1] - py
    r2x = obst_f[OF_X2, o1] - px
    r2y = obst_f[OF_Y2, o1] - py
    left_x = inv_tau * r1x
    left_y = inv_tau * r1y
    right_x = inv_tau * r2x
    right_y = inv_tau * r2y
    scaled_radius = inv_tau * radius
    radius_sq = radius * radius
    dist1 = r1x * r1x + r1y * r1y
    dist2 = r2x * r2x + r2y * r2y
    ex = obst_f[OF_EX, o1]
    ey = obst_f[OF_EY, o1]
    s = (-r1x * ex - r1y * ey) / obst_f[OF_LEN2, o1]
    qx = r1x + s * ex
    qy = r1y + s * ey
    dist_line = qx * qx + qy * qy
    convex1 = obst_i[OI_CONVEX, o1] == 1
    convex2 = obst_i[OI_CONVEX, o2] == 1
    dx1 = obst_f[OF_DX, o1]
    dy1 = obst_f[OF_DY, o1]
    dx2 = obst_f[OF_DX, o2]
    dy2 = obst_f[OF_DY, o2]

    # touching: the left vertex, the right vertex (unless the next edge sees to it), the edge itself
    if s < F0 and dist1 <= radius_sq:
        if convex1:
            ux, uy = unit(-r1y, r1x)
            return _put_line(F0, F0, ux, uy, n, lines)
        return n
    if s > F1 and dist2 <= radius_sq:
        if convex2 and r2x * dy2 - r2y * dx2 >= F0:
            ux, uy = unit(-r2y, r2x)
            return _put_line(F0, F0, ux, uy, n, lines)
        return n
    if s >= F0 and s <= F1 and dist_line <= radius_sq:
        return _put_line(F0, F0, -dx1, -dy1, n, lines)

    # legs of the velocity obstacle; seen obliquely, one vertex makes both
    same = False
    if s < F0 and dist_line <= radius_sq:
        if not convex1:
            return n
        same = True
        o2 = o1
        dx2 = dx1
        dy2 = dy1
        right_x = left_x
        right_y = left_y
        ll_x, ll_y = _tangent(r1x, r1y, dist1, radius, radius_sq, F1)
        rl_x, rl_y = _tangent(r1x, r1y, dist1, radius, radius_sq, -F1)
        convex2 = True
    elif s > F1 and dist_line <= radius_sq:
        if not convex2:
            return n
        same = True
        o1 = o2
        dx1 = dx2
        dy1 = dy2
        left_x = right_x
        left_y = right_y
        ll_x, ll_y = _tangent(r2x, r2y, dist2, radius, radius_sq, F1)
        rl_x, rl_y = _tangent(r2x, r2y, dist2, radius, radius_sq, -F1)
        convex1 = True
    else:
        if convex1:
            ll_x, ll_y = _tangent(r1x, r1y, dist1, radius, radius_sq, F1)
        else:  # the leg extends the cut-off line
            ll_x = -dx1
            ll_y = -dy1
        if convex2:
            rl_x, rl_y = _tangent(r2x, r2y, dist2, radius, radius_sq, -F1)
        else:
            rl_x = dx1
            rl_y = dy1

    # a leg never points into the neighbouring edge: that edge's own cut-off line takes over, and adds its own
    # line
    left_foreign = False
    right_foreign = False
    if convex1:
        before = obst_i[OI_PREV, o1]
        nx = -obst_f[OF_DX, before]
        ny = -obst_f[OF_DY, before]
        if ll_x * ny - ll_y * nx >= F0:
            ll_x = nx
            ll_y = ny
            left_foreign = True
    if convex2 and rl_x * dy2 - rl_y * dx2 <= F0:
        rl_x = dx2
        rl_y = dy2
        right_foreign = True

    # project the velocity on the velocity obstacle: cut-off circles, cut-off line or legs
    cut_x = right_x - left_x
    cut_y = right_y - left_y
    wl_x = vx - left_x
    wl_y = vy - left_y
    wr_x = vx - right_x
    wr_y = vy - right_y
    t = HALF if same else (wl_x * cut_x + wl_y * cut_y) / (cut_x * cut_x + cut_y * cut_y)
    t_left = wl_x * ll_x + wl_y * ll_y
    t_right = wr_x * rl_x + wr_y * rl_y
    if (t < F0 and t_left < F0) or (same and t_left < F0 and t_right < F0):
        ux, uy = unit(wl_x, wl_y)
        return _put_line(left_x + scaled_radius * ux, left_y + scaled_radius * uy, uy, -ux, n, lines)
    if t > F1 and t_right < F0:
        ux, uy = unit(wr_x, wr_y)
        return _put_line(right_x + scaled_radius * ux, right_y + scaled_radius * uy, uy, -ux, n, lines)
    d_cut = INF
    d_left = INF
    d_right = INF
    if not (t < F0 or t > F1 or same):
        gx = vx - (left_x + t * cut_x)
        gy = vy - (left_y + t * cut_y)
        d_cut = gx * gx + gy * gy
    if not t_left < F0:
        gx = vx - (left_x + t_left * ll_x)
        gy = vy - (left_y + t_left * ll_y)
        d_left = gx * gx + gy * gy
    if not t_right < F0:
        gx = vx - (right_x + t_right * rl_x)
        gy = vy - (right_y + t_right * rl_y)
        d_right = gx * gx + gy * gy
    if d_cut <= d_left and d_cut <= d_right:
        return _put_line(left_x + scaled_radius * dy1, left_y - scaled_radius * dx1, -dx1, -dy1, n, lines)
    if d_left <= d_right:
        if left_foreign:
            return n
        return _put_line(left_x - scaled_radius * ll_y, left_y + scaled_radius * ll_x, ll_x, ll_y, n, lines)
    if right_foreign:
        return n
    return _put_line(right_x + scaled_radius * rl_y, right_y - scaled_radius * rl_x, -rl_x, -rl_y, n, lines)


@kernel(inline=True)
def _agent_lines(px, py, vx, vy, radius, inv_tau, inv_dt, count, neighbors, lines):
    """Write the constraints of `count` neighbours to `lines`.

    Loops from zero over arrays that start where needed, without ``and`` and ``or``: else LLVM does not
    vectorise them.
    """
    for k in range(whole_blocks(count)):
        rx = neighbors[5 * k] - px
        ry = neighbors[5 * k + 1] - py
        rvx = vx - neighbors[5 * k + 2]
        rvy = vy - neighbors[5 * k + 3]
        dist_sq = rx * rx + ry * ry
        both = radius + neighbors[5 * k + 4]
        both_sq = both * both
        apart = dist_sq > both_sq
        # agents that overlap get apart within one time step
        inv = inv_tau if apart else inv_dt
        wx = rvx - inv * rx
        wy = rvy - inv * ry
        w_sq = wx * wx + wy * wy
        dot = wx * rx + wy * ry
        circle = (not apart) | ((dot < F0) & (dot * dot > both_sq * w_sq))
        # on the cut-off circle
        w = np.sqrt(w_sq)
        scale = F1 / (w if w > F0 else NAN)
        ux = wx * scale
        uy = wy * scale
        push = both * inv - w
        # on a leg: the left one (sign 1) or, mirrored, the right one
        leg = np.sqrt(dist_sq - both_sq if apart else F1)
        scale = F1 / (dist_sq if apart else F1)
        sign = F1 if rx * wy - ry * wx > F0 else -F1
        mirrored = sign * both
        lx = sign * (rx * leg - ry * mirrored) * scale
        ly = sign * (rx * mirrored + ry * leg) * scale
        along = rvx * lx + rvy * ly
        lines[4 * k] = vx + HALF * (push * ux if circle else along * lx - rvx)
        lines[4 * k + 1] = vy + HALF * (push * uy if circle else along * ly - rvy)
        lines[4 * k + 2] = uy if circle else lx
        lines[4 * k + 3] = -ux if circle else ly


@kernel(inline=True)
def orca_velocity(
    i, agents, lo, hi, extra, pref_vx, pref_vy, obst_f, obst_i, n_obst, params, work_f, work_i
):  # fmt: skip
    """Return the new velocity (vx, vy) of agent `i`, float32 [m/s].

    Parameters
    ----------
    i : int
        Row of the agent.
    agents : ndarray of shape (N, ORCA_AGENT_FIELDS), float32
        x, y [m], vx, vy [m/s], radius [m], largest speed [m/s] of every agent. The radius is used as it is.
    lo, hi, extra : int
        Neighbours are the rows ``lo <= j < hi`` other than `i`, and row `extra` where that is not negative.
    pref_vx, pref_vy : float32
        Preferred velocity [m/s].
    obst_f, obst_i : ndarray
        Obstacles from ``build_obstacles``, the first `n_obst` columns.
    params : ndarray of shape (ORCA_PARAM_FIELDS,), float32
        Neighbour distance [m], largest number of neighbours, time horizons for agents and obstacles [s], time
        step [s], whether the largest speed holds where RVO2's arithmetic loses it.
    work_f, work_i : ndarray
        Scratch from :func:`make_orca_work`.

    Notes
    -----
    RVO2 2.0.3 ``Agent::computeNeighbors`` and ``computeNewVelocity``. Difference: agents at exactly equal
    distances are taken in the order of their rows (RVO2 agrees up to ten agents; beyond, its agent tree
    decides).
    """
    px = agents[i, OA_X]
    py = agents[i, OA_Y]
    vx = agents[i, OA_VX]
    vy = agents[i, OA_VY]
    radius = agents[i, OA_RADIUS]
    max_speed = agents[i, OA_MAX_SPEED]

    inv_tau = F1 / params[OP_TIME_HORIZON_OBST]
    reach = params[OP_TIME_HORIZON_OBST] * max_speed + radius
    n_edges = obstacle_neighbors(px, py, reach * reach, obst_f, obst_i, n_obst, work_f, work_i)
    lines = work_f[WORK_LINE]
    n_obstacle = 0
    edges, covered = work_i[WORK_EDGE], work_i[WORK_COVERED]
    x1, y1, x2, y2 = work_f[WORK_X1], work_f[WORK_Y1], work_f[WORK_X2], work_f[WORK_Y2]
    _edge_ends(px, py, inv_tau, n_edges, edges, obst_f, x1, y1, x2, y2, covered)
    for k in range(n_edges):
        if covered[k] != 0:
            continue
        n = _edge_line(edges[k], px, py, vx, vy, radius, inv_tau, n_obstacle, obst_f, obst_i, lines)
        if n > n_obstacle:
            line = lines[4 * n_obstacle : 4 * n]
            n_obstacle = n
            _cover(line[0], line[1], line[2], line[3], inv_tau * radius, n_edges, x1, y1, x2, y2, covered)

    neighbor_dist = params[OP_NEIGHBOR_DIST]
    most = int(params[OP_MAX_NEIGHBORS])
    count = agent_neighbors(i, agents, lo, hi, extra, neighbor_dist * neighbor_dist, most, work_f, work_i)
    _agent_lines(
        px, py, vx, vy, radius, F1 / params[OP_TIME_HORIZON], F1 / params[OP_DT], count,
        work_f[WORK_NEIGHBOR], lines[4 * n_obstacle :],
    )  # fmt: skip
    n = n_obstacle + count

    failed, x, y = program2(lines, n, max_speed, pref_vx, pref_vy, False)
    if failed < n:
        x, y = program3(lines, n_obstacle, n, failed, max_speed, x, y, work_f[WORK_PROJ])
    # Two constraints that are all but parallel meet thousands of m/s away. From a line through such a point, float32
    # finds its way into the circle of allowed speeds only to within metres per second.
    if params[OP_KEEP_LIMIT] > F0 and np.sqrt(x * x + y * y) > max_speed + RVO_EPSILON:
        x, y = unit(x, y)
        x *= max_speed
        y *= max_speed
    return x, y


@kernel(inline=True)
def orca_step(agents, preferred, obst_f, obst_i, n_obst, params, work_f, work_i, out):
    """Write the new velocities of all agents, each of which sees all others, to `out` (N, 2) float32."""
    n = agents.shape[0]
    for i in range(n):
        out[i, 0], out[i, 1] = orca_velocity(
            i, agents, 0, n, -1, np.float32(preferred[i, 0]), np.float32(preferred[i, 1]),
            obst_f, obst_i, n_obst, params, work_f, work_i,
        )  # fmt: skip
