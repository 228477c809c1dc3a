# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Static obstacles as RVO2 sees them: linked edges, convexity, and the edges' splitting by the obstacle tree.

An obstacle is an edge that starts at a vertex; anticlockwise polygons are solid inside, clockwise ones bound
free space. RVO2 sorts the edges into a binary space partition and cuts every edge that crosses the line of a
chosen one. The cuts change what an agent sees (a half edge has its own nearest point and its own velocity
obstacle), so they are part of the result and not only of the search; the tree itself is needed only to order
edges at equal distance.

One column per edge, one row per field, so that the scan over all edges runs on vectors.
"""

import numpy as np
from numpy.typing import NDArray

from navrep_data.kernels import kernel

# --- obst_f (OF_FIELDS, capacity) float32 -------------------------------------------------------------------
OF_X = 0  # start of the edge [m]
OF_Y = 1
OF_X2 = 2  # its end: start of the next edge
OF_Y2 = 3
OF_EX = 4  # end minus start, rounded once
OF_EY = 5
OF_LEN2 = 6  # squared length
OF_DX = 7  # unit direction of the edge before it was split
OF_DY = 8
OF_FIELDS = 9

# --- obst_i (OI_FIELDS, capacity) int32 ---------------------------------------------------------------------
OI_NEXT = 0
OI_PREV = 1
OI_CONVEX = 2
OI_PARENT = 3  # node of the tree = index of its edge; -1 for the root
OI_DEPTH = 4
OI_SIDE = 5  # LEFT or RIGHT child of the parent
OI_TIE = 6  # which of this edge and the next comes first at equal distance, see _tie_code
OI_SHORT = 7  # 1 in column 0 where the world has an edge so short that its side of the world is ill defined
# Scratch of build_obstacles; the list of pending edges and its copy use the two rows above, which are filled
# last.
_LIST = OI_TIE
_COPY = OI_SHORT
_BEGIN = 8  # stack of pending lists: where each starts, the node above it, on which side of it
_ABOVE = 9
_BELOW_SIDE = 10
OI_FIELDS = 11

LEFT = 0
RIGHT = 1

TIE_THIS_FIRST = -1
TIE_NEXT_FIRST = -2

RVO_EPSILON = np.float32(0.00001)
# Sides are decided by cross products to within RVO_EPSILON: off by 1e-5 / length metres. Below this length
# that is more than the margin inside which orca_velocity asks the tree (see NEAR_RANGE there).
SHORT_EDGE_SQ = np.float32(0.01**2)


def make_obstacles(capacity: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return empty ``(obst_f, obst_i)`` with room for `capacity` edges after splitting."""
    return np.zeros((OF_FIELDS, capacity), np.float32), np.zeros((OI_FIELDS, capacity), np.int32)


@kernel
def _left_of(ax, ay, bx, by, cx, cy):
    """Return twice the signed area of a, b, c: positive where c lies left of the line from a to b."""
    return (ax - cx) * (by - ay) - (ay - cy) * (bx - ax)


@kernel
def _add_polygons(vertices, polygon_start, obst_f, obst_i):
    """Enter the edges of all polygons; return their number, or -1 where they do not fit."""
    n = 0
    for p in range(polygon_start.shape[0] - 1):
        first = polygon_start[p]
        count = polygon_start[p + 1] - first
        if count < 2:
            continue
        if n + count > obst_f.shape[1]:
            return -1
        for k in range(count):
            j = n + k
            nxt = n + (k + 1 if k + 1 < count else 0)
            prv = n + (k - 1 if k > 0 else count - 1)
            x = np.float32(vertices[first + k, 0])
            y = np.float32(vertices[first + k, 1])
            nx = np.float32(vertices[first + nxt - n, 0])
            ny = np.float32(vertices[first + nxt - n, 1])
            qx = np.float32(vertices[first + prv - n, 0])
            qy = np.float32(vertices[first + prv - n, 1])
            ex = nx - x
            ey = ny - y
            length = np.sqrt(ex * ex + ey * ey)
            # RVO2 divides by multiplying with the reciprocal; a doubled vertex has no direction.
            scale = np.float32(1.0) / length if length > np.float32(0.0) else np.float32(np.nan)
            obst_f[OF_X, j] = x
            obst_f[OF_Y, j] = y
            obst_f[OF_X2, j] = nx
            obst_f[OF_Y2, j] = ny
            obst_f[OF_DX, j] = ex * scale
            obst_f[OF_DY, j] = ey * scale
            obst_i[OI_NEXT, j] = nxt
            obst_i[OI_PREV, j] = prv
            convex = count == 2 or _left_of(qx, qy, x, y, nx, ny) >= np.float32(0.0)
            obst_i[OI_CONVEX, j] = 1 if convex else 0
        n += count
    return n


@kernel
def _best_split(begin, m, obst_f, obst_i):
    """Return (position, left size, right size) of the edge whose line parts the list most evenly."""
    best = 0
    best_left = m
    best_right = m
    for a in range(m):
        i = obst_i[_LIST, begin + a]
        ix = obst_f[OF_X, i]
        iy = obst_f[OF_Y, i]
        ix2 = obst_f[OF_X2, i]
        iy2 = obst_f[OF_Y2, i]
        left = 0
        right = 0
        worst = max(best_left, best_right)
        for b in range(m):
            if b == a:
                continue
            j = obst_i[_LIST, begin + b]
            s1 = _left_of(ix, iy, ix2, iy2, obst_f[OF_X, j], obst_f[OF_Y, j])
            s2 = _left_of(ix, iy, ix2, iy2, obst_f[OF_X2, j], obst_f[OF_Y2, j])
            if s1 >= -RVO_EPSILON and s2 >= -RVO_EPSILON:
                left += 1
            elif s1 <= RVO_EPSILON and s2 <= RVO_EPSILON:
                right += 1
            else:
                left += 1
                right += 1
            if left > worst or right > worst:  # sizes only grow: cannot win any more
                break
        high = max(left, right)
        low = min(left, right)
        if high < worst or (high == worst and low < min(best_left, best_right)):
            best = a
            best_left = left
            best_right = right
    return best, best_left, best_right


@kernel
def _split(i, j, new, obst_f, obst_i):
    """Cut edge `j` where the line of edge `i` crosses it; the far part becomes edge `new`."""
    ix = obst_f[OF_X, i]
    iy = obst_f[OF_Y, i]
    ex = obst_f[OF_X2, i] - ix
    ey = obst_f[OF_Y2, i] - iy
    jx = obst_f[OF_X, j]
    jy = obst_f[OF_Y, j]
    jx2 = obst_f[OF_X2, j]
    jy2 = obst_f[OF_Y2, j]
    t = (ex * (jy - iy) - ey * (jx - ix)) / (ex * (jy - jy2) - ey * (jx - jx2))
    x = jx + t * (jx2 - jx)
    y = jy + t * (jy2 - jy)
    obst_f[OF_X, new] = x
    obst_f[OF_Y, new] = y
    obst_f[OF_X2, new] = jx2
    obst_f[OF_Y2, new] = jy2
    obst_f[OF_DX, new] = obst_f[OF_DX, j]
    obst_f[OF_DY, new] = obst_f[OF_DY, j]
    obst_f[OF_X2, j] = x
    obst_f[OF_Y2, j] = y
    far = obst_i[OI_NEXT, j]
    obst_i[OI_NEXT, new] = far
    obst_i[OI_PREV, new] = j
    obst_i[OI_CONVEX, new] = 1
    obst_i[OI_NEXT, j] = new
    obst_i[OI_PREV, far] = new


@kernel
def _partition(i, best, m, begin, n_left, n_right, n, obst_f, obst_i):
    """Replace a list by its right part and, behind it, its left part; return the number of edges."""
    for b in range(m):
        obst_i[_COPY, b] = obst_i[_LIST, begin + b]
    right = begin
    left = begin + n_right
    ix = obst_f[OF_X, i]
    iy = obst_f[OF_Y, i]
    ix2 = obst_f[OF_X2, i]
    iy2 = obst_f[OF_Y2, i]
    for b in range(m):
        if b == best:
            continue
        j = obst_i[_COPY, b]
        s1 = _left_of(ix, iy, ix2, iy2, obst_f[OF_X, j], obst_f[OF_Y, j])
        s2 = _left_of(ix, iy, ix2, iy2, obst_f[OF_X2, j], obst_f[OF_Y2, j])
        on_left = j
        on_right = j
        if s1 >= -RVO_EPSILON and s2 >= -RVO_EPSILON:
            on_right = -1
        elif s1 <= RVO_EPSILON and s2 <= RVO_EPSILON:
            on_left = -1
        else:
            _split(i, j, n, obst_f, obst_i)
            if s1 > np.float32(0.0):
                on_right = n
            else:
                on_left = n
            n += 1
        if on_left >= 0:
            obst_i[_LIST, left] = on_left
            left += 1
        if on_right >= 0:
            obst_i[_LIST, right] = on_right
            right += 1
    return n


@kernel
def tie_node(a, b, obst_i):
    """Return (node, side of a, side of b): the lowest node above both edges, and where they hang below it.

    A side of -1 means that the edge is that node itself.
    """
    side_a = -1
    side_b = -1
    while a != b:
        if obst_i[OI_DEPTH, a] >= obst_i[OI_DEPTH, b]:
            side_a = obst_i[OI_SIDE, a]
            a = obst_i[OI_PARENT, a]
        else:
            side_b = obst_i[OI_SIDE, b]
            b = obst_i[OI_PARENT, b]
    return a, side_a, side_b


@kernel
def _tie_code(a, b, obst_i):
    """Return the tie rule of edge `a` and the next edge `b`: fixed, or 2 * node + side of a below that node.

    The walk takes the agent's side of a node first, then the node, then the other side; an edge that counts
    at all has the agent on its right. So only a third node's side is left to ask for at run time.
    """
    node, side_a, side_b = tie_node(a, b, obst_i)
    if side_a < 0:
        return TIE_NEXT_FIRST if side_b == RIGHT else TIE_THIS_FIRST
    if side_b < 0:
        return TIE_THIS_FIRST if side_a == RIGHT else TIE_NEXT_FIRST
    return 2 * node + side_a


@kernel
def _finish(n, obst_f, obst_i):
    """Fill in what follows from the ends of the edges and from the tree."""
    short = False
    for j in range(n):
        ex = obst_f[OF_X2, j] - obst_f[OF_X, j]
        ey = obst_f[OF_Y2, j] - obst_f[OF_Y, j]
        length_sq = ex * ex + ey * ey
        obst_f[OF_EX, j] = ex
        obst_f[OF_EY, j] = ey
        obst_f[OF_LEN2, j] = length_sq
        obst_i[OI_TIE, j] = _tie_code(j, obst_i[OI_NEXT, j], obst_i)
        if length_sq < SHORT_EDGE_SQ:
            short = True
    if n > 0:
        obst_i[OI_SHORT, 0] = 1 if short else 0


@kernel
def build_obstacles(vertices, polygon_start, obst_f, obst_i):
    """Build RVO2's obstacle edges and tree; return the number of edges, or -1 where they do not fit.

    Parameters
    ----------
    vertices : ndarray of shape (V, 2), float64
        Vertices of all polygons [m], world frame. Anticlockwise = solid inside, clockwise = free inside.
    polygon_start : ndarray of shape (P + 1,), int64
        Polygon p has vertices ``polygon_start[p]:polygon_start[p + 1]``; those with fewer than two are left
        out.
    obst_f : ndarray of shape (OF_FIELDS, capacity), float32
        Out. Columns beyond the returned number are not meaningful.
    obst_i : ndarray of shape (OI_FIELDS, capacity), int32
        Out, likewise; its last rows are scratch.

    Notes
    -----
    Same result as RVO2 2.0.3 ``RVOSimulator::addObstacle`` and ``KdTree::buildObstacleTreeRecursive``, edge
    for edge and bit for bit; new edges are numbered depth first, left before right, as there.
    """
    capacity = obst_f.shape[1]
    n = _add_polygons(vertices, polygon_start, obst_f, obst_i)
    if n <= 0:
        return n
    for j in range(n):
        obst_i[_LIST, j] = j
    obst_i[_BEGIN, 0] = 0
    obst_i[_ABOVE, 0] = -1
    obst_i[_BELOW_SIDE, 0] = LEFT
    top = 1
    end = n
    while top > 0:
        top -= 1
        begin = obst_i[_BEGIN, top]
        parent = obst_i[_ABOVE, top]
        side = obst_i[_BELOW_SIDE, top]
        m = end - begin
        best, n_left, n_right = _best_split(begin, m, obst_f, obst_i)
        if n + n_left + n_right - (m - 1) > capacity:
            return -1
        i = obst_i[_LIST, begin + best]
        obst_i[OI_PARENT, i] = parent
        obst_i[OI_SIDE, i] = side
        obst_i[OI_DEPTH, i] = 0 if parent < 0 else obst_i[OI_DEPTH, parent] + 1
        n = _partition(i, best, m, begin, n_left, n_right, n, obst_f, obst_i)
        end = begin + n_right + n_left
        if n_right > 0:
            obst_i[_BEGIN, top] = begin
            obst_i[_ABOVE, top] = i
            obst_i[_BELOW_SIDE, top] = RIGHT
            top += 1
        if n_left > 0:
            obst_i[_BEGIN, top] = begin + n_right
            obst_i[_ABOVE, top] = i
            obst_i[_BELOW_SIDE, top] = LEFT
            top += 1
    _finish(n, obst_f, obst_i)
    return n
