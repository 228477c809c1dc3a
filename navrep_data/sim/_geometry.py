# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Distances between moving points and polygon edges: the one geometry that collisions are tested on."""

import numpy as np

from navrep_data.kernels import kernel


@kernel
def point_segment_sq(px, py, ax, ay, bx, by):
    """Return the squared distance of a point to the segment a-b (which may be a point)."""
    dx = bx - ax
    dy = by - ay
    length_sq = dx * dx + dy * dy
    t = 0.0
    if length_sq > 0.0:
        t = ((px - ax) * dx + (py - ay) * dy) / length_sq
        t = min(max(t, 0.0), 1.0)
    ex = px - ax - t * dx
    ey = py - ay - t * dy
    return ex * ex + ey * ey


@kernel
def _crosses(ax, ay, bx, by, cx, cy, dx, dy):
    """Return whether segments a-b and c-d properly intersect."""
    d1 = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    d2 = (bx - ax) * (dy - ay) - (by - ay) * (dx - ax)
    d3 = (dx - cx) * (ay - cy) - (dy - cy) * (ax - cx)
    d4 = (dx - cx) * (by - cy) - (dy - cy) * (bx - cx)
    return d1 * d2 < 0.0 and d3 * d4 < 0.0


@kernel
def in_solid(x, y, edges, polygon_start, n_polygons):
    """Return whether a point lies in solid matter: inside an anticlockwise polygon or outside a clockwise one."""
    for p in range(n_polygons):
        inside = False
        area = 0.0
        for e in range(polygon_start[p], polygon_start[p + 1]):
            ax, ay, bx, by = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
            area += ax * by - bx * ay
            if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
                inside = not inside
        if inside == (area > 0.0):
            return True
    return False


@kernel
def swept_clearance(x0, y0, x1, y1, edges, polygon_start, n_polygons):
    """Return the smallest distance of a point moving from 0 to 1 to solid matter [m]; negative if it starts inside.

    The magnitude of a negative value is the distance to the nearest edge.
    """
    best = np.inf
    mx = 0.5 * (x0 + x1)
    my = 0.5 * (y0 + y1)
    reach = 0.5 * np.hypot(x1 - x0, y1 - y0)
    for e in range(polygon_start[n_polygons]):
        ax, ay, bx, by = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
        # the edge's bounding box is a lower bound of its distance
        gx = max(min(ax, bx) - mx, mx - max(ax, bx), 0.0)
        gy = max(min(ay, by) - my, my - max(ay, by), 0.0)
        limit = best + reach
        if gx * gx + gy * gy >= limit * limit:
            continue
        d = point_segment_sq(x0, y0, ax, ay, bx, by)
        if reach > 0.0:
            if _crosses(x0, y0, x1, y1, ax, ay, bx, by):
                d = 0.0
            else:
                d = min(d, point_segment_sq(x1, y1, ax, ay, bx, by))
                d = min(d, point_segment_sq(ax, ay, x0, y0, x1, y1))
                d = min(d, point_segment_sq(bx, by, x0, y0, x1, y1))
        d = np.sqrt(d)
        if d < best:
            best = d
    if in_solid(x0, y0, edges, polygon_start, n_polygons):
        return -best
    return best


@kernel
def box_distance(px, py, cx, cy, hx, hy):
    """Return the distance of a point to an axis-aligned box with centre c and half sides h; 0 inside [m]."""
    gx = max(abs(px - cx) - hx, 0.0)
    gy = max(abs(py - cy) - hy, 0.0)
    return np.sqrt(gx * gx + gy * gy)
