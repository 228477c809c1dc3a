# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Who is near: obstacle edges and agents within range, nearest first, in RVO2's order."""

import numpy as np
from numpy.typing import NDArray

from navrep_data.kernels import kernel
from navrep_data.sim._obstacles import (
    LEFT,
    OF_EX,
    OF_EY,
    OF_LEN2,
    OF_X,
    OF_X2,
    OF_Y,
    OF_Y2,
    OI_NEXT,
    OI_PARENT,
    OI_SHORT,
    OI_SIDE,
    OI_TIE,
    RIGHT,
    TIE_NEXT_FIRST,
    TIE_THIS_FIRST,
    tie_node,
)
from navrep_data.sim._orca_lp import BLOCK, F0, F1, NAN, whole_blocks

# --- agents (N, ORCA_AGENT_FIELDS) float32 ------------------------------------------------------------------
OA_X = 0
OA_Y = 1
OA_VX = 2
OA_VY = 3
OA_RADIUS = 4
OA_MAX_SPEED = 5
ORCA_AGENT_FIELDS = 6

# --- scratch ------------------------------------------------------------------------------------------------
_DIST = 0  # squared distance to every edge or agent, infinite where it does not count
_NEAR = 1  # those of the candidates, compacted
WORK_LINE = 2  # the constraints, LINE_FIELDS numbers each: x, y, dx, dy
WORK_PROJ = 3  # the same for linear program 3
WORK_NEIGHBOR = 4  # x, y, vx, vy, radius of every neighbour, NB_FIELDS numbers each
WORK_X1, WORK_Y1, WORK_X2, WORK_Y2 = 5, 6, 7, 8  # scaled ends of the obstacle neighbours, nearest first
WORK_F_ROWS = 9
NB_FIELDS = 5
_CANDIDATE = 0  # index of every candidate
_ORDER = 1  # positions among the candidates, nearest first
_RANK = 2
WORK_EDGE = 3  # the obstacle neighbours, nearest first
WORK_COVERED = 4  # whether some line makes an obstacle neighbour superfluous
WORK_I_ROWS = 5

INF = np.float32(np.inf)
# An edge within this factor of the search range is counted only if RVO2's walk over the tree would reach it:
# the walk prunes by distances to lines, which rounding can push over the range before the edge itself.
NEAR_RANGE = np.float32(0.998)


def make_orca_work(max_edges: int = 512, max_agents: int = 64) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return ``(work_f, work_i)``, the scratch arrays of :func:`orca_velocity`.

    Parameters
    ----------
    max_edges : int
        Capacity of the obstacle arrays (edges after splitting).
    max_agents : int
        Largest number of agents in a world.
    """
    columns = max_edges + max_agents + 3 * BLOCK
    work_f = np.zeros((WORK_F_ROWS, NB_FIELDS * columns), np.float32)
    return work_f, np.zeros((WORK_I_ROWS, columns), np.int32)


@kernel(inline=True)
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


@kernel(inline=True)
def _compact(n, limit, work_f, work_i):
    """Collect the indices with distance below `limit`; return their number."""
    m = 0
    for j in range(n):
        d = work_f[_DIST, j]
        work_f[_NEAR, m] = d
        work_i[_CANDIDATE, m] = j
        m += 1 if d < limit else 0
    return m


@kernel(inline=True)
def _sort(m, work_f, work_i):
    """Order the candidates by distance, equal ones by position: ranks by counting, which has no branches."""
    near = work_f[_NEAR]
    rank = work_i[_RANK]
    padded = whole_blocks(m)
    for a in range(padded):
        rank[a] = 0
    for b in range(m):
        d = near[b]
        for a in range(padded):
            e = near[a]
            rank[a] += np.int32(1) if (d < e) | ((d == e) & (np.int32(b) < np.int32(a))) else np.int32(0)
    for a in range(m):
        work_i[_ORDER, rank[a]] = a


@kernel(inline=True)
def _left_of_edge(px, py, j, obst_f):
    return (obst_f[OF_X, j] - px) * obst_f[OF_EY, j] - (obst_f[OF_Y, j] - py) * obst_f[OF_EX, j]


@kernel(inline=True)
def _near_side(px, py, j, obst_f):
    return LEFT if _left_of_edge(px, py, j, obst_f) >= F0 else RIGHT


@kernel(inline=True)
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


@kernel(inline=True)
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


@kernel(inline=True)
def obstacle_neighbors(px, py, range_sq, obst_f, obst_i, n, work_f, work_i):
    """List the edges within range, nearest first, ties in the order of RVO2's walk; return their number."""
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
            while at > run and _comes_first(j, work_i[WORK_EDGE, at - 1], px, py, obst_f, obst_i):
                work_i[WORK_EDGE, at] = work_i[WORK_EDGE, at - 1]
                at -= 1
        else:
            run = count
            last = d
        work_i[WORK_EDGE, at] = j
        count += 1
    return count


@kernel(inline=True)
def agent_neighbors(i, agents, lo, hi, extra, range_sq, most, work_f, work_i):
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
    neighbors = work_f[WORK_NEIGHBOR]
    for k in range(count):
        j = work_i[_CANDIDATE, work_i[_ORDER, k]]
        j = lo + j if j < hi - lo else extra
        for field in range(NB_FIELDS):
            neighbors[NB_FIELDS * k + field] = agents[j, field]
    return count
