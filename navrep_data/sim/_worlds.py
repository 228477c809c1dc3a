# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Procedural worlds of the `consistent` physics.

The recipe is the original's (crowd_sim.py, SIM_FACTS a.2 to a.5) with its defects mended: obstacles come first and
humans are only put where they are free, every loop is bounded, headings are uniform, the border is part of the world.
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._geometry import box_distance
from navrep_data.sim._layout import (
    A_GX,
    A_GY,
    A_HEADING,
    A_RADIUS,
    A_SEES,
    A_VPREF,
    A_X,
    A_Y,
    F_HUMAN_POLICY,
    F_ROBOTS,
    F_SQUARE_CROSSING,
    F_WORLD,
    HUMANS_STATIC,
    P_BORDER_GAP,
    P_DANGER_DIST,
    P_HUMANS,
    P_MAP_HALF,
    P_POLYGON_SCALE,
    P_RADIUS_HIGH,
    P_RADIUS_LOW,
    P_SQUARES,
    P_VPREF_HIGH,
    P_VPREF_LOW,
    P_WALLS,
    S_BORDER,
    S_FEWER_HUMANS,
    S_FEWER_OBSTACLES,
    S_HUMANS,
    S_POLYGONS,
    S_XMAX,
    S_XMIN,
    S_YMAX,
    S_YMIN,
    WORLD_EMPTY,
)
from navrep_data.sim._rng import integer, uniform

# Humans and obstacles that find no place in this many draws are left out.
MAX_TRIES = 200
# crowd_sim.py: circle radius 4 m, robot circle 4 (1 + 2u) capped at 9 m, square side 10 m, clearance 0.2 m
CIRCLE_RADIUS = 4.0
ROBOT_RADIUS_CAP = 9.0
SQUARE_WIDTH = 10.0
SQUARE_HALF = 0.7
WALL_THICKNESS = 1.0


@kernel
def add_box(vertices, polygon_start, n, cx, cy, hx, hy, clockwise):
    """Append an axis-aligned box as polygon n and return n + 1; anticlockwise = solid inside (RVO2's convention)."""
    v = polygon_start[n]
    vertices[v, 0] = cx + hx
    vertices[v, 1] = cy + hy
    vertices[v + 2, 0] = cx - hx
    vertices[v + 2, 1] = cy - hy
    first, third = (v + 3, v + 1) if clockwise else (v + 1, v + 3)
    vertices[first, 0] = cx - hx
    vertices[first, 1] = cy + hy
    vertices[third, 0] = cx + hx
    vertices[third, 1] = cy - hy
    polygon_start[n + 1] = v + 4
    return n + 1


@kernel
def _off_robots(agents, robots, cx, cy, hx, hy, danger):
    """Return whether a box leaves room at the robots' starts and goals."""
    for r in range(robots):
        gap = agents[r, A_RADIUS] + danger
        if (
            box_distance(agents[r, A_X], agents[r, A_Y], cx, cy, hx, hy) <= gap
            or box_distance(agents[r, A_GX], agents[r, A_GY], cx, cy, hx, hy) <= gap
        ):
            return False
    return True


@kernel
def _place_obstacles(agents, robots, scalars, vertices, polygon_start, boxes, rng, params):
    """Draw squares and walls clear of the robots' starts and goals; returns the number of polygons."""
    scale = params[P_POLYGON_SCALE]
    half = params[P_MAP_HALF]
    n_squares = round(uniform(rng) * (params[P_SQUARES] - scalars[S_FEWER_OBSTACLES]))
    n_walls = round(uniform(rng) * (params[P_WALLS] - scalars[S_FEWER_OBSTACLES]))
    n = 0
    for k in range(n_squares + n_walls):
        for _ in range(MAX_TRIES):
            cx = (2.0 * uniform(rng) - 1.0) * half
            cy = (2.0 * uniform(rng) - 1.0) * half
            if k < n_squares:
                hx = SQUARE_HALF * (0.5 + uniform(rng)) * scale
                hy = hx
            else:
                along_x = uniform(rng) > 0.5
                long = 0.5 * (2.0 + integer(rng, 0, 2)) * scale
                thick = 0.5 * WALL_THICKNESS * scale
                hx = long if along_x else thick
                hy = thick if along_x else long
            if _off_robots(agents, robots, cx, cy, hx, hy, params[P_DANGER_DIST]):
                boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3] = cx, cy, hx, hy
                n = add_box(vertices, polygon_start, n, cx, cy, hx, hy, False)
                break
    return n


@kernel
def _fits(agents, n, i_x, i_y, x, y, radius, boxes, n_boxes, gap):
    """Return whether a human of this radius is free at (x, y) among agents 0..n-1 (columns i_x, i_y) and boxes."""
    for j in range(n):
        need = radius + agents[j, A_RADIUS] + gap
        if (x - agents[j, i_x]) ** 2 + (y - agents[j, i_y]) ** 2 < need * need:
            return False
    for b in range(n_boxes):
        if box_distance(x, y, boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3]) <= radius:
            return False
    return True


@kernel
def _place_humans(agents, robots, scalars, boxes, n_boxes, rng, params, flags):
    """Draw humans free of each other, the robots and all obstacles at start and goal; returns their number."""
    humans = params[P_HUMANS] - scalars[S_FEWER_HUMANS]
    wanted = min(round(humans * (0.5 + uniform(rng))), agents.shape[0] - robots)
    gap = params[P_DANGER_DIST]
    stand = flags[F_HUMAN_POLICY] == HUMANS_STATIC
    n = robots
    for _k in range(wanted):
        v_pref = params[P_VPREF_LOW] + uniform(rng) * (params[P_VPREF_HIGH] - params[P_VPREF_LOW])
        radius = params[P_RADIUS_LOW] + uniform(rng) * (params[P_RADIUS_HIGH] - params[P_RADIUS_LOW])
        sees = uniform(rng) > 0.5
        for _ in range(MAX_TRIES):
            if flags[F_SQUARE_CROSSING]:
                sign = -1.0 if uniform(rng) > 0.5 else 1.0
                x = sign * 0.5 * SQUARE_WIDTH * uniform(rng)
                y = (uniform(rng) - 0.5) * SQUARE_WIDTH
                gx = -sign * 0.5 * SQUARE_WIDTH * uniform(rng)
                gy = (uniform(rng) - 0.5) * SQUARE_WIDTH
            else:
                angle = uniform(rng) * 2.0 * np.pi
                noise_x = (uniform(rng) - 0.5) * v_pref
                noise_y = (uniform(rng) - 0.5) * v_pref
                ring = CIRCLE_RADIUS * (1.0 + 1.5 * uniform(rng))
                x = ring * np.cos(angle) + noise_x
                y = ring * np.sin(angle) + noise_y
                gx = -x
                gy = -y
                # the original also keeps starts off other agents' goals here, which thins out the ring
                if not _fits(agents, n, A_GX, A_GY, x, y, radius, boxes, 0, gap):
                    continue
            look_x, look_y = gx - x, gy - y
            if stand:  # for good; by the test of goals below off everybody's goal, too
                gx, gy = x, y
            if _fits(agents, n, A_X, A_Y, x, y, radius, boxes, n_boxes, gap) and _fits(
                agents, n, A_GX, A_GY, gx, gy, radius, boxes, n_boxes, gap
            ):
                agents[n, :] = 0.0
                agents[n, A_X], agents[n, A_Y] = x, y
                agents[n, A_GX], agents[n, A_GY] = gx, gy
                agents[n, A_HEADING] = np.arctan2(look_y, look_x) % (2.0 * np.pi)
                agents[n, A_RADIUS] = radius
                agents[n, A_VPREF] = v_pref
                agents[n, A_SEES] = 1.0 if sees else 0.0
                n += 1
                break
    return n - robots


@kernel
def add_border(agents, n_agents, scalars, vertices, polygon_start, n_polygons, gap):
    """Close the world by a box `gap` outside everything in it (navreptrainenv.py); returns the number of polygons."""
    xmin, xmax = np.inf, -np.inf
    ymin, ymax = np.inf, -np.inf
    for i in range(n_agents):
        xmin = min(xmin, agents[i, A_X], agents[i, A_GX])
        xmax = max(xmax, agents[i, A_X], agents[i, A_GX])
        ymin = min(ymin, agents[i, A_Y], agents[i, A_GY])
        ymax = max(ymax, agents[i, A_Y], agents[i, A_GY])
    for v in range(polygon_start[n_polygons]):
        xmin, xmax = min(xmin, vertices[v, 0]), max(xmax, vertices[v, 0])
        ymin, ymax = min(ymin, vertices[v, 1]), max(ymax, vertices[v, 1])
    xmin, ymin, xmax, ymax = xmin - gap, ymin - gap, xmax + gap, ymax + gap
    scalars[S_XMIN], scalars[S_YMIN], scalars[S_XMAX], scalars[S_YMAX] = xmin, ymin, xmax, ymax
    scalars[S_BORDER] = 1.0
    cx, cy = 0.5 * (xmin + xmax), 0.5 * (ymin + ymax)
    return add_box(vertices, polygon_start, n_polygons, cx, cy, xmax - cx, ymax - cy, True)


@kernel
def _place_robots(agents, robots, rng, params):
    """Draw all robots but the first, on rings like its own; returns False where one finds no place."""
    for n in range(1, robots):
        agents[n, :] = 0.0
        agents[n, A_VPREF] = params[P_VPREF_LOW] + uniform(rng) * (params[P_VPREF_HIGH] - params[P_VPREF_LOW])
        radius = params[P_RADIUS_LOW] + uniform(rng) * (params[P_RADIUS_HIGH] - params[P_RADIUS_LOW])
        agents[n, A_RADIUS] = radius
        placed = False
        for _ in range(MAX_TRIES):
            angle = uniform(rng) * 2.0 * np.pi
            ring = min(ROBOT_RADIUS_CAP, CIRCLE_RADIUS * (1.0 + 2.0 * uniform(rng)))
            x, y = ring * np.cos(angle), ring * np.sin(angle)
            # goals lie opposite, so they are as far apart as the starts
            if _fits(agents, n, A_X, A_Y, x, y, radius, agents, 0, params[P_DANGER_DIST]):
                agents[n, A_X], agents[n, A_Y] = x, y
                agents[n, A_GX], agents[n, A_GY] = -x, -y
                placed = True
                break
        if not placed:
            return False
        agents[n, A_HEADING] = uniform(rng) * 2.0 * np.pi
    return True


@kernel
def draw_world(agents, scalars, vertices, polygon_start, boxes, rng, params, flags):
    """Draw a world: robots, obstacles, humans, border; returns False where a robot has no place.

    Fills agents, scalars, vertices and polygon_start. `boxes` is scratch of shape (polygons, 4).
    """
    robots = flags[F_ROBOTS]
    agents[0, :] = 0.0
    robot_v = params[P_VPREF_LOW] + uniform(rng) * (params[P_VPREF_HIGH] - params[P_VPREF_LOW])
    robot_r = params[P_RADIUS_LOW] + uniform(rng) * (params[P_RADIUS_HIGH] - params[P_RADIUS_LOW])
    ring = min(ROBOT_RADIUS_CAP, CIRCLE_RADIUS * (1.0 + 2.0 * uniform(rng)))
    agents[0, A_Y] = -ring
    agents[0, A_GY] = ring
    agents[0, A_HEADING] = uniform(rng) * 2.0 * np.pi
    agents[0, A_RADIUS] = robot_r
    agents[0, A_VPREF] = robot_v
    if not _place_robots(agents, robots, rng, params):
        return False
    polygon_start[0] = 0
    n_polygons = _place_obstacles(agents, robots, scalars, vertices, polygon_start, boxes, rng, params)
    n_humans = _place_humans(agents, robots, scalars, boxes, n_polygons, rng, params, flags)
    scalars[S_HUMANS] = n_humans
    if flags[F_WORLD] != WORLD_EMPTY:
        n_polygons = add_border(
            agents, robots + n_humans, scalars, vertices, polygon_start, n_polygons, params[P_BORDER_GAP]
        )
    scalars[S_POLYGONS] = n_polygons
    return True
