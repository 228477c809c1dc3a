# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""A map's outlines as ORCA's obstacle edges.

RVO2 sorts obstacles into a tree to find near ones, and cuts edges on the way. A map has thousands of edges, which takes
seconds; here they stay whole and a chain stands for the tree, which only decides between edges at equal distance.
"""

from navrep_data.kernels import kernel
from navrep_data.sim._obstacles import (
    OF_EX,
    OF_EY,
    OF_LEN2,
    OF_X,
    OF_X2,
    OF_Y,
    OF_Y2,
    OI_DEPTH,
    OI_NEXT,
    OI_PARENT,
    OI_SHORT,
    OI_SIDE,
    OI_TIE,
    RIGHT,
    TIE_NEXT_FIRST,
    TIE_THIS_FIRST,
    _add_polygons,
)


@kernel
def link_edges(vertices, polygon_start, edges_f, edges_i):
    """Fill ORCA's obstacle arrays from polygons, whole edges in their order; returns how many there are."""
    n = _add_polygons(vertices, polygon_start, edges_f, edges_i)
    for j in range(n):
        edges_f[OF_EX, j] = edges_f[OF_X2, j] - edges_f[OF_X, j]
        edges_f[OF_EY, j] = edges_f[OF_Y2, j] - edges_f[OF_Y, j]
        edges_f[OF_LEN2, j] = edges_f[OF_EX, j] * edges_f[OF_EX, j] + edges_f[OF_EY, j] * edges_f[OF_EY, j]
        edges_i[OI_PARENT, j] = j - 1
        edges_i[OI_DEPTH, j] = j
        edges_i[OI_SIDE, j] = RIGHT
        edges_i[OI_TIE, j] = TIE_THIS_FIRST if edges_i[OI_NEXT, j] > j else TIE_NEXT_FIRST
    if n > 0:
        edges_i[OI_SHORT, 0] = 0
    return n
