# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Bodies as ellipses in the lidar: exact ranges, worked out in inverse range like those of circles.

Along its axes, divided by its semi-axes, an ellipse is the unit circle; a ray keeps its parameter there. With p the
centre and d the ray in those coordinates, the nearer hit has ``1/r = (d.p + sqrt(d.d - (d x p)^2)) / (p.p - 1)``.
"""

import math

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._lidar import (
    _ASIN_CUBIC,
    _INSIDE_INVERSE,
    _TURN,
    BEARING_ERROR,
    CIRCLE_OWNER,
    CIRCLE_RADIUS,
    CIRCLE_X,
    CIRCLE_Y,
    COSINE,
    SINE,
    _draw_polygons,
    _finish,
    _take_ray,
    bearing,
)

# Columns after those of a circle, whose radius is the larger semi-axis: the one across the heading.
ELLIPSE_DEPTH, ELLIPSE_COSINE, ELLIPSE_SINE = 4, 5, 6
ELLIPSE_COLUMNS = 7
# Chest depth over shoulder width; adults: about 0.25 m over 0.45 m.
DEPTH_PER_WIDTH = 0.5


@kernel
def body_ellipse(x, y, heading, radius, owner, row):
    """Write the body of an agent: semi-axes `radius` across its heading and half of that along it."""
    row[CIRCLE_X], row[CIRCLE_Y], row[CIRCLE_RADIUS], row[CIRCLE_OWNER] = x, y, radius, owner
    row[ELLIPSE_DEPTH] = DEPTH_PER_WIDTH * radius
    row[ELLIPSE_COSINE], row[ELLIPSE_SINE] = math.cos(heading), math.sin(heading)


@kernel
def _draw_ellipse(
    pf, ps, ef, es, depth, width, owner, directions, inverse, owner_of_ray, hits, low_u, high_u, per_turn
):  # fmt: skip
    """Draw one ellipse on the rays between low_u and high_u and their images.

    pf, ps: its centre along and across its heading over the semi-axes depth and width; ef, es: its heading.
    """
    last = inverse.shape[0] - 1
    scale = 1.0 / (pf * pf + ps * ps - 1.0)
    low_u -= per_turn
    high_u -= per_turn
    while low_u <= last:
        if high_u >= 0.0:
            low = max(np.int64(math.ceil(low_u)), 0)
            high = min(np.int64(math.floor(high_u)), last)
            for ray in range(low, high + 1):
                c, s = directions[COSINE, ray], directions[SINE, ray]
                df, ds = (ef * c + es * s) / depth, (ef * s - es * c) / width
                along = df * pf + ds * ps
                off = df * ps - ds * pf
                inner = df * df + ds * ds - off * off
                if inner >= 0.0 and along > 0.0:
                    value = (along + math.sqrt(inner)) * scale
                    if value > inverse[ray]:
                        _take_ray(inverse, owner_of_ray, hits, ray, value, owner)
        low_u += per_turn
        high_u += per_turn


@kernel
def draw_ellipses(
    bodies, n_bodies, x, y, ct, st, directions, inverse, owner_of_ray, hits, per_radian, zero, per_turn, margin
):  # fmt: skip
    """Draw all ellipses into `inverse`, keeping account of who is seen; arguments as in `_lidar._draw_circles`."""
    for i in range(n_bodies):
        dx, dy = bodies[i, CIRCLE_X] - x, bodies[i, CIRCLE_Y] - y
        width, depth = bodies[i, CIRCLE_RADIUS], bodies[i, ELLIPSE_DEPTH]
        bc, bs = bodies[i, ELLIPSE_COSINE], bodies[i, ELLIPSE_SINE]
        owner = np.int64(bodies[i, CIRCLE_OWNER])
        pf, ps = (bc * dx + bs * dy) / depth, (bc * dy - bs * dx) / width
        if pf * pf + ps * ps <= 1.0:
            for ray in range(inverse.shape[0]):
                if inverse[ray] < _INSIDE_INVERSE:
                    _take_ray(inverse, owner_of_ray, hits, ray, _INSIDE_INVERSE, owner)
            continue
        distance2 = dx * dx + dy * dy
        half = 0.5 * per_turn
        if distance2 > width * width:
            ratio = width / math.sqrt(distance2)
            half = min(ratio * (1.0 + _ASIN_CUBIC * ratio * ratio) * per_radian + margin, half)
        cx, cy = ct * dx + st * dy, ct * dy - st * dx
        u = bearing(cy, cx) * per_radian - zero
        u = u + per_turn if u < 0.0 else u
        _draw_ellipse(
            pf, ps, ct * bc + st * bs, ct * bs - st * bc, depth, width, owner, directions, inverse, owner_of_ray,
            hits, u - half, u + half, per_turn,
        )  # fmt: skip


@kernel
def scan_ellipses(
    edges, poly_start, n_polys, bodies, n_bodies, x, y, theta, directions, angle_min, angle_increment,
    range_max, inverse, owner_of_ray, hits, out,
):  # fmt: skip
    """Scan a world of polygons and ellipses from one pose; arguments as in `_lidar.scan_world`."""
    ct, st = math.cos(theta), math.sin(theta)
    per_radian = 1.0 / angle_increment
    per_turn = _TURN * per_radian
    margin = BEARING_ERROR * per_radian
    zero = angle_min - _TURN * math.floor(angle_min / _TURN + 0.5)
    zero *= per_radian
    inverse[:] = 1.0 / range_max
    owner_of_ray[:] = -1
    hits[:] = 0
    _draw_polygons(
        edges, poly_start, n_polys, x, y, ct, st, directions, inverse, per_radian, zero, per_turn, margin
    )  # fmt: skip
    draw_ellipses(
        bodies, n_bodies, x, y, ct, st, directions, inverse, owner_of_ray, hits, per_radian, zero, per_turn, margin
    )  # fmt: skip
    _finish(inverse, range_max, out)
