"""ORCA: the collision-free velocity nearest to a preferred one, with the exact semantics of RVO2 2.0.3.

Everything is float32 and in RVO2's order of operations, so that results are equal to the C++ library's bit for bit (on
machines whose C++ compiler does not fuse multiply and add). A line is a point and a direction; allowed velocities lie
to its left. Lines that divide by zero there become NaN and constrain nothing; the same happens here.

Where RVO2 branches per neighbour, the loops here compute both branches and select, to run on vectors.
"""

import numpy as np
from numba import njit

from navrep_data.sim._obstacles import (
    LEFT,
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
    OI_PARENT,
    OI_PREV,
    OI_SHORT,
    OI_SIDE,
    OI_TIE,
    RIGHT,
    RVO_EPSILON,
    TIE_NEXT_FIRST,
    TIE_THIS_FIRST,
    tie_node,
)

# --- agents (N, ORCA_AGENT_FIELDS) float32 --------------------------------------------------------------------------
OA_X = 0
OA_Y = 1
OA_VX = 2
OA_VY = 3
OA_RADIUS = 4
OA_MAX_SPEED = 5
ORCA_AGENT_FIELDS = 6

# --- params (ORCA_PARAM_FIELDS,) float32 ----------------------------------------------------------------------------
OP_NEIGHBOR_DIST = 0
OP_MAX_NEIGHBORS = 1
OP_TIME_HORIZON = 2
OP_TIME_HORIZON_OBST = 3
OP_DT = 4
ORCA_PARAM_FIELDS = 5

# --- scratch --------------------------------------------------------------------------------------------------------
_DIST = 0  # squared distance to every edge or agent, infinite where it does not count
_NEAR = 1  # those of the candidates, compacted
_LINE = 2  # the constraints, LINE_FIELDS numbers each: x, y, dx, dy
_PROJ = 3  # the same for linear program 3
_NEIGHBOR = 4  # x, y, vx, vy, radius of every neighbour, NB_FIELDS numbers each
WORK_F_ROWS = 5
LINE_FIELDS = 4
NB_FIELDS = 5
_CANDIDATE = 0  # index of every candidate
_ORDER = 1  # positions among the candidates, nearest first
_RANK = 2
_EDGE = 3  # the obstacle neighbours, nearest first
WORK_I_ROWS = 4
# Loops over neighbours run on whole blocks, so rows have this much room to spare.
_BLOCK = 16

F0 = np.float32(0.0)
F1 = np.float32(1.0)
HALF = np.float32(0.5)
INF = np.float32(np.inf)
NAN = np.float32(np.nan)
# An edge within this factor of the search range is counted only if RVO2's walk over the tree would reach it: the walk
# prunes by distances to lines, which rounding can push over the range before the edge itself.
NEAR_RANGE = np.float32(0.998)


def make_orca_work(max_edges=512, max_agents=64):
    """Return ``(work_f, work_i)``, the scratch arrays of :func:`orca_velocity`.

    Parameters
    ----------
    max_edges : int
        Capacity of the obstacle arrays (edges after splitting).
    max_agents : int
        Largest number of agents in a world.
    """
    columns = max_edges + max_agents + 3 * _BLOCK
    return np.zeros((WORK_F_ROWS, NB_FIELDS * columns), np.float32), np.zeros((WORK_I_ROWS, columns), np.int32)


@njit(cache=True, error_model="numpy")
def _edge_distances(px, py, obst_f, n, work_f):
    """Squared distance to every edge that has the agent on its right, infinite for the others."""
    x = obst_f[OF_X]
    y = obst_f[OF_Y]
    x2 = obst_f[OF_X2]
    y2 = obst_f[OF_Y2]
    ex = obst_f[OF_EX]
    ey = obst_f[OF_EY]
    len2 = obst_f[OF_LEN2]
    out = work_f[_DIST]
    for j in range(n):
        ax = px - x[j]
        ay = py - y[j]
        bx = px - x2[j]
        by = py - y2[j]
        # an edge without length has no nearest point in RVO2 either (0 / 0)
        r = (ax * ex[j] + ay * ey[j]) / (len2[j] if len2[j] > F0 else NAN)
        cx = px - (x[j] + r * ex[j])
        cy = py - (y[j] + r * ey[j])
        inside = cx * cx + cy * cy
        start = ax * ax + ay * ay
        end = bx * bx + by * by
        d = start if r < F0 else (end if r > F1 else inside)
        left = (x[j] - px) * ey[j] - (y[j] - py) * ex[j]
        out[j] = d if left < F0 else INF


@njit(cache=True, error_model="numpy")
def _compact(n, limit, work_f, work_i):
    """Collect the indices with distance below `limit`; return their number."""
    m = 0
    for j in range(n):
        d = work_f[_DIST, j]
        work_f[_NEAR, m] = d
        work_i[_CANDIDATE, m] = j
        m += 1 if d < limit else 0
    return m


@njit(cache=True, error_model="numpy")
def _whole_blocks(n):
    """Round up to whole vectors: the rest of a loop would run one by one, and is mostly all of it."""
    return (n + _BLOCK - 1) // _BLOCK * _BLOCK


@njit(cache=True, error_model="numpy")
def _sort(m, work_f, work_i):
    """Order the candidates by distance, equal ones by position: ranks by counting, which has no branches."""
    near = work_f[_NEAR]
    rank = work_i[_RANK]
    padded = _whole_blocks(m)
    for a in range(padded):
        rank[a] = 0
    for b in range(m):
        d = near[b]
        for a in range(padded):
            e = near[a]
            rank[a] += np.int32(1) if (d < e) | ((d == e) & (np.int32(b) < np.int32(a))) else np.int32(0)
    for a in range(m):
        work_i[_ORDER, rank[a]] = a


@njit(cache=True, error_model="numpy")
def _left_of_edge(px, py, j, obst_f):
    return (obst_f[OF_X, j] - px) * obst_f[OF_EY, j] - (obst_f[OF_Y, j] - py) * obst_f[OF_EX, j]


@njit(cache=True, error_model="numpy")
def _near_side(px, py, j, obst_f):
    return LEFT if _left_of_edge(px, py, j, obst_f) >= F0 else RIGHT


@njit(cache=True, error_model="numpy")
def _comes_first(a, b, px, py, obst_f, obst_i):
    """Return whether RVO2's walk over the tree meets edge `a` before edge `b`."""
    if obst_i[OI_NEXT, a] == b or obst_i[OI_NEXT, b] == a:  # a shared corner: nearly every tie, prepared
        swapped = obst_i[OI_NEXT, a] != b
        code = obst_i[OI_TIE, b if swapped else a]
        if code == TIE_THIS_FIRST:
            first = True
        elif code == TIE_NEXT_FIRST:
            first = False
        else:
            first = _near_side(px, py, code >> 1, obst_f) == (code & 1)
        return first != swapped
    node, side_a, side_b = tie_node(a, b, obst_i)
    near = _near_side(px, py, node, obst_f)
    if side_a < 0:
        return side_b != near
    return side_a == near


@njit(cache=True, error_model="numpy")
def _reached(j, px, py, range_sq, obst_f, obst_i):
    """Return whether RVO2's walk over the tree gets as far as edge `j`."""
    node = j
    side = -1
    while node >= 0:
        left = _left_of_edge(px, py, node, obst_f)
        near = LEFT if left >= F0 else RIGHT
        length_sq = obst_f[OF_LEN2, node]
        if side != near and not left * left / (length_sq if length_sq > F0 else NAN) < range_sq:
            return False
        side = obst_i[OI_SIDE, node]
        node = obst_i[OI_PARENT, node]
    return True


@njit(cache=True, error_model="numpy")
def _obstacle_neighbors(px, py, range_sq, obst_f, obst_i, n, work_f, work_i):
    """List the edges within range, nearest first, equal ones in the order of RVO2's walk; return their number."""
    _edge_distances(px, py, obst_f, n, work_f)
    m = _compact(n, range_sq, work_f, work_i)
    if m == 0:
        return 0
    _sort(m, work_f, work_i)
    doubtful = F0 if obst_i[OI_SHORT, 0] == 1 else NEAR_RANGE * range_sq
    count = 0
    run = 0  # where the present run of equal distances starts
    last = -F1
    for k in range(m):
        c = work_i[_ORDER, k]
        d = work_f[_NEAR, c]
        j = work_i[_CANDIDATE, c]
        if d >= doubtful and not _reached(j, px, py, range_sq, obst_f, obst_i):
            continue
        at = count
        if d == last:
            while at > run and _comes_first(j, work_i[_EDGE, at - 1], px, py, obst_f, obst_i):
                work_i[_EDGE, at] = work_i[_EDGE, at - 1]
                at -= 1
        else:
            run = count
            last = d
        work_i[_EDGE, at] = j
        count += 1
    return count


@njit(cache=True, error_model="numpy")
def _covered(x1, y1, x2, y2, scaled_radius, n_lines, lines):
    """Return whether some line already keeps the agent off both (scaled) ends of an edge."""
    for k in range(n_lines):
        lx = lines[4 * k]
        ly = lines[4 * k + 1]
        dx = lines[4 * k + 2]
        dy = lines[4 * k + 3]
        if (
            (x1 - lx) * dy - (y1 - ly) * dx - scaled_radius >= -RVO_EPSILON
            and (x2 - lx) * dy - (y2 - ly) * dx - scaled_radius >= -RVO_EPSILON
        ):
            return True
    return False


@njit(cache=True, error_model="numpy")
def _unit(x, y):
    length = np.sqrt(x * x + y * y)
    scale = F1 / (length if length > F0 else NAN)
    return x * scale, y * scale


@njit(cache=True, error_model="numpy")
def _tangent(x, y, dist_sq, radius, radius_sq, sign):
    """Direction of the tangent from the origin to a circle at (x, y); `sign` +1 = left, -1 = right."""
    leg = np.sqrt(dist_sq - radius_sq)
    scale = F1 / dist_sq
    r = sign * radius
    return (x * leg - y * r) * scale, (x * r + y * leg) * scale


@njit(cache=True, error_model="numpy")
def _put_line(x, y, dx, dy, n_lines, lines):
    lines[4 * n_lines] = x
    lines[4 * n_lines + 1] = y
    lines[4 * n_lines + 2] = dx
    lines[4 * n_lines + 3] = dy
    return n_lines + 1


@njit(cache=True, error_model="numpy")
def _edge_line(j, px, py, vx, vy, radius, inv_tau, n, obst_f, obst_i, lines):
    """Add the constraint of edge `j` to the `n` lines, if it makes one; return the number of lines."""
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
    if _covered(left_x, left_y, right_x, right_y, scaled_radius, n, lines):
        return n

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
            ux, uy = _unit(-r1y, r1x)
            return _put_line(F0, F0, ux, uy, n, lines)
        return n
    if s > F1 and dist2 <= radius_sq:
        if convex2 and r2x * dy2 - r2y * dx2 >= F0:
            ux, uy = _unit(-r2y, r2x)
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

    # a leg never points into the neighbouring edge: that edge's own cut-off line takes over, and adds its own line
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
        ux, uy = _unit(wl_x, wl_y)
        return _put_line(left_x + scaled_radius * ux, left_y + scaled_radius * uy, uy, -ux, n, lines)
    if t > F1 and t_right < F0:
        ux, uy = _unit(wr_x, wr_y)
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


@njit(cache=True, error_model="numpy")
def _agent_neighbors(i, agents, lo, hi, extra, range_sq, most, work_f, work_i):
    """Copy the nearest agents to the neighbour rows, nearest first; return their number.

    At equal distance the lower row comes first and `extra` last.
    """
    px = agents[i, OA_X]
    py = agents[i, OA_Y]
    n = hi - lo
    others = agents[lo:hi]
    distance = work_f[_DIST]
    for k in range(n):
        dx = px - others[k, OA_X]
        dy = py - others[k, OA_Y]
        distance[k] = dx * dx + dy * dy
    if lo <= i < hi:
        work_f[_DIST, i - lo] = INF
    if extra >= 0 and extra != i:
        dx = px - agents[extra, OA_X]
        dy = py - agents[extra, OA_Y]
        work_f[_DIST, n] = dx * dx + dy * dy
        n += 1
    m = _compact(n, range_sq, work_f, work_i)
    _sort(m, work_f, work_i)
    count = min(m, most)
    neighbors = work_f[_NEIGHBOR]
    for k in range(count):
        j = work_i[_CANDIDATE, work_i[_ORDER, k]]
        j = lo + j if j < hi - lo else extra
        for field in range(NB_FIELDS):
            neighbors[NB_FIELDS * k + field] = agents[j, field]
    return count


@njit(cache=True, error_model="numpy")
def _agent_lines(px, py, vx, vy, radius, inv_tau, inv_dt, count, neighbors, lines):
    """Write the constraints of `count` neighbours to `lines`.

    Loops from zero over arrays that start where needed, without ``and`` and ``or``: else LLVM does not vectorise them.
    """
    for k in range(_whole_blocks(count)):
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _program2(lines, n, radius, ox, oy, direction):
    """Find the allowed velocity nearest to (ox, oy), or farthest along it: (first line that fails or n, x, y)."""
    if direction:
        x = ox * radius
        y = oy * radius
    elif ox * ox + oy * oy > radius * radius:
        x, y = _unit(ox, oy)
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


@njit(cache=True, error_model="numpy")
def _project(ix, iy, idx, idy, count, lines, projected):
    """Turn `count` lines into constraints on the velocities that violate the given line as much as them."""
    for j in range(_whole_blocks(count)):
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


@njit(cache=True, error_model="numpy")
def _program3(lines, n_obstacle, n, begin, radius, x, y, projected):
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
        failed, new_x, new_y = _program2(projected, m, radius, -idy, idx, True)
        if failed == m:  # else rounding made an impossible failure: keep the result
            x = new_x
            y = new_y
        distance = idx * (iy - y) - idy * (ix - x)
    return x, y


@njit(cache=True, error_model="numpy")
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
        Neighbour distance [m], largest number of neighbours, time horizons for agents and obstacles [s], time step [s].
    work_f, work_i : ndarray
        Scratch from :func:`make_orca_work`.

    Notes
    -----
    RVO2 2.0.3 ``Agent::computeNeighbors`` and ``computeNewVelocity``. Difference: agents at exactly equal distances are
    taken in the order of their rows (RVO2 agrees up to ten agents; beyond, its agent tree decides).
    """
    px = agents[i, OA_X]
    py = agents[i, OA_Y]
    vx = agents[i, OA_VX]
    vy = agents[i, OA_VY]
    radius = agents[i, OA_RADIUS]
    max_speed = agents[i, OA_MAX_SPEED]

    inv_tau = F1 / params[OP_TIME_HORIZON_OBST]
    reach = params[OP_TIME_HORIZON_OBST] * max_speed + radius
    n_edges = _obstacle_neighbors(px, py, reach * reach, obst_f, obst_i, n_obst, work_f, work_i)
    lines = work_f[_LINE]
    n_obstacle = 0
    for k in range(n_edges):
        n_obstacle = _edge_line(
            work_i[_EDGE, k], px, py, vx, vy, radius, inv_tau, n_obstacle, obst_f, obst_i, lines
        )  # fmt: skip

    neighbor_dist = params[OP_NEIGHBOR_DIST]
    most = int(params[OP_MAX_NEIGHBORS])
    count = _agent_neighbors(i, agents, lo, hi, extra, neighbor_dist * neighbor_dist, most, work_f, work_i)
    _agent_lines(
        px, py, vx, vy, radius, F1 / params[OP_TIME_HORIZON], F1 / params[OP_DT], count,
        work_f[_NEIGHBOR], lines[4 * n_obstacle :],
    )  # fmt: skip
    n = n_obstacle + count

    failed, x, y = _program2(lines, n, max_speed, pref_vx, pref_vy, False)
    if failed < n:
        x, y = _program3(lines, n_obstacle, n, failed, max_speed, x, y, work_f[_PROJ])
    return x, y


@njit(cache=True, error_model="numpy")
def orca_step(agents, preferred, obst_f, obst_i, n_obst, params, work_f, work_i, out):
    """Write the new velocities of all agents, each of which sees all others, to `out` (N, 2) float32."""
    n = agents.shape[0]
    for i in range(n):
        out[i, 0], out[i, 1] = orca_velocity(
            i, agents, 0, n, -1, np.float32(preferred[i, 0]), np.float32(preferred[i, 1]),
            obst_f, obst_i, n_obst, params, work_f, work_i,
        )  # fmt: skip
