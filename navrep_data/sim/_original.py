# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""The `original` physics: what the released simulator does where it differs from `consistent`.

Worlds are drawn with the original's order of draws, so a numpy-seeded stream gives the original's episodes. The robot
collides with cells of a grid, not with the polygons that the lidar and ORCA see. Rewards come from an exclusive table.

Source: crowd_sim.py and agent.py of soadrl-crowdnav 0.0.3, navreptrainenv.py of NavRep (SIM_FACTS a.2 to a.8).
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._geometry import point_segment_sq
from navrep_data.sim._judge import COLLISION_HUMAN, COLLISION_OBSTACLE, GOAL, NONE, TIMEOUT, note_touch, reach_of_goal
from navrep_data.sim._layout import (
    A_GAIT_T,
    A_GAIT_X,
    A_GAIT_Y,
    A_GX,
    A_GY,
    A_HEADING,
    A_RADIUS,
    A_SEES,
    A_VPREF,
    A_VX,
    A_VY,
    A_X,
    A_Y,
    B_STEP,
    B_X0,
    B_X1,
    B_Y0,
    B_Y1,
    F_SQUARE_CROSSING,
    P_DANGER_DIST,
    P_DT,
    P_HUMANS,
    P_POLYGON_SCALE,
    P_RADIUS_HIGH,
    P_RADIUS_LOW,
    P_REWARD_COLLISION,
    P_REWARD_DANGER,
    P_REWARD_GOAL,
    P_REWARD_PROGRESS,
    P_SQUARES,
    P_TIME_LIMIT,
    P_VPREF_HIGH,
    P_VPREF_LOW,
    P_WALLS,
    S_BORDER,
    S_CLEAR_HUMAN,
    S_CLEAR_STATIC,
    S_FEWER_HUMANS,
    S_FEWER_OBSTACLES,
    S_HUMANS,
    S_POLYGONS,
    S_TIME,
    S_XMAX,
    S_XMIN,
    S_YMAX,
    S_YMIN,
)
from navrep_data.sim._rng import integer, uniform
from navrep_data.sim._worlds import CIRCLE_RADIUS, ROBOT_RADIUS_CAP, SQUARE_HALF, SQUARE_WIDTH, WALL_THICKNESS, add_box

# The original draws without limit until everybody has a place. Seeded episodes need a few dozen draws at most.
PLACE_LIMIT = 100_000
# test_soadrl_static.config: map_size_m 14, map_resolution 0.1
CELL = 0.1
CELLS = 140
HALF_CELLS = 70
HALF_MAP = 7.0
# navreptrainenv.py: the hidden first step turns the robot by 10 (u - 0.5) rad
HIDDEN_TURN = 10.0
# 100 x discomfort_penalty_factor x dt [1/m]: an agent 0.2 - d too near costs ten times that
NEAR_HUMAN_FACTOR = 10.0
# 100 x rotation_penalty_factor [1/rad]
ROTATION_FACTOR = -0.3
TWO_PI = 2.0 * np.pi


# --- world -----------------------------------------------------------------------------------------------------------


@kernel
def between(rng, low, high):
    """Return a uniform in [low, high), in numpy's arithmetic."""
    return low + (high - low) * uniform(rng)


@kernel
def _too_near(agents, n, i_x, i_y, x, y, radius, gap):
    """Return whether (x, y) is nearer than the radii and `gap` to column pair i_x, i_y of agents 0..n-1."""
    for j in range(n):
        if np.hypot(x - agents[j, i_x], y - agents[j, i_y]) < radius + agents[j, A_RADIUS] + gap:
            return True
    return False


@kernel
def _place_circle(agents, n, radius, v_pref, gap, rng):
    """Draw a human's start on the ring, off all starts and goals; the goal lies opposite."""
    for _ in range(PLACE_LIMIT):
        angle = uniform(rng) * np.pi * 2.0
        noise_x = (uniform(rng) - 0.5) * v_pref
        noise_y = (uniform(rng) - 0.5) * v_pref
        ring = CIRCLE_RADIUS * (1.0 + uniform(rng) * 1.5)
        x = ring * np.cos(angle) + noise_x
        y = ring * np.sin(angle) + noise_y
        if _too_near(agents, n, A_X, A_Y, x, y, radius, gap) or _too_near(agents, n, A_GX, A_GY, x, y, radius, gap):
            continue
        agents[n, A_X], agents[n, A_Y] = x, y
        agents[n, A_GX], agents[n, A_GY] = -x, -y
        return True
    return False


@kernel
def _place_square(agents, n, radius, gap, rng):
    """Draw a human's start on one side of the square, off all starts, and its goal on the other, off all goals."""
    sign = -1.0 if uniform(rng) > 0.5 else 1.0
    for column_x, column_y, side in ((A_X, A_Y, sign), (A_GX, A_GY, -sign)):
        placed = False
        for _ in range(PLACE_LIMIT):
            x = uniform(rng) * SQUARE_WIDTH * 0.5 * side
            y = (uniform(rng) - 0.5) * SQUARE_WIDTH
            if not _too_near(agents, n, column_x, column_y, x, y, radius, gap):
                agents[n, column_x], agents[n, column_y] = x, y
                placed = True
                break
        if not placed:
            return False
    return True


@kernel
def _place_humans(agents, scalars, rng, params, flags):
    """Draw all humans; returns their number, or -1 where one found no place."""
    gap = params[P_DANGER_DIST]
    humans = params[P_HUMANS] - scalars[S_FEWER_HUMANS]
    wanted = min(int(np.rint(humans * (0.5 + uniform(rng)))), agents.shape[0] - 1)
    uniform(rng)  # the number of other robots, always 0
    for n in range(1, wanted + 1):
        agents[n, :] = 0.0
        v_pref = between(rng, params[P_VPREF_LOW], params[P_VPREF_HIGH])
        radius = between(rng, params[P_RADIUS_LOW], params[P_RADIUS_HIGH])
        if flags[F_SQUARE_CROSSING]:
            placed = _place_square(agents, n, radius, gap, rng)
        else:
            placed = _place_circle(agents, n, radius, v_pref, gap, rng)
        if not placed:
            return -1
        agents[n, A_RADIUS] = radius
        agents[n, A_VPREF] = v_pref
        agents[n, A_SEES] = 1.0 if uniform(rng) > 0.5 else 0.0
    return wanted


@kernel
def set_cells(box, ix, iy, size_x, size_y):
    """Write the grid cells of an obstacle centred on cell (ix, iy), size in cells, to one row of `boxes`.

    An obstacle wholly on the grid is a rectangle. Any other is filled cell by cell by the original: each cell's index
    is rounded half to even on its own and index 0 is left out. With an odd size all its cells lie half way between
    two indices, so only every second row and column is filled (B_STEP 2).
    """
    x0 = int(np.rint(ix - 0.5 * size_x))
    y0 = int(np.rint(iy - 0.5 * size_y))
    half_x, half_y = size_x / 2.0, size_y / 2.0
    if ix > half_x and ix < CELLS - half_x and iy > half_y and iy < CELLS - half_y:
        box[B_X0], box[B_X1] = x0, x0 + size_x
        box[B_Y0], box[B_Y1] = y0, y0 + size_y
        box[B_STEP] = 1.0
    else:
        # squares have one odd size for both axes, walls even ones
        step = 2 if size_x % 2 == 1 else 1
        box[B_X0], box[B_X1] = max(x0, step), min(int(np.rint(ix + half_x - 1.0)) + 1, CELLS)
        box[B_Y0], box[B_Y1] = max(y0, step), min(int(np.rint(iy + half_y - 1.0)) + 1, CELLS)
        box[B_STEP] = step


@kernel
def _place_obstacles(agents, scalars, vertices, polygon_start, boxes, rng, params):
    """Draw squares and walls: polygons, inflated, and cells at true size. Returns their number, -1 where one failed."""
    scale = params[P_POLYGON_SCALE]
    gap = agents[0, A_RADIUS] + params[P_DANGER_DIST]
    x0, y0, x1, y1 = agents[0, A_X], agents[0, A_Y], agents[0, A_GX], agents[0, A_GY]
    n_squares = int(np.rint(uniform(rng) * (params[P_SQUARES] - scalars[S_FEWER_OBSTACLES])))
    n_walls = int(np.rint(uniform(rng) * (params[P_WALLS] - scalars[S_FEWER_OBSTACLES])))
    for n in range(n_squares + n_walls):
        placed = False
        for _ in range(PLACE_LIMIT):
            ix = integer(rng, -HALF_CELLS, HALF_CELLS)
            iy = integer(rng, -HALF_CELLS, HALF_CELLS)
            cx, cy = ix * CELL, iy * CELL
            if n < n_squares:
                hx = (uniform(rng) + 0.5) * SQUARE_HALF
                hy = hx
                hit = np.hypot(cx - x0, cy - y0) < hx + gap or np.hypot(cx - x1, cy - y1) < hx + gap
            else:
                along_x = uniform(rng) > 0.5
                long = 0.5 * integer(rng, 2, 4)
                thick = 0.5 * WALL_THICKNESS
                hx, hy = (long, thick) if along_x else (thick, long)
                hit = (abs(cx - x0) < hx + gap and abs(cy - y0) < hy + gap) or (
                    abs(cx - x1) < hx + gap and abs(cy - y1) < hy + gap
                )
            if not hit:
                placed = True
                size_x, size_y = int(np.rint(2.0 * hx / CELL)), int(np.rint(2.0 * hy / CELL))
                set_cells(boxes[n], ix + HALF_CELLS, iy + HALF_CELLS, size_x, size_y)
                add_box(vertices, polygon_start, n, cx, cy, scale * hx, scale * hy, False)
                break
        if not placed:
            return -1
    return n_squares + n_walls


@kernel
def draw_original(agents, scalars, vertices, polygon_start, boxes, rng, params, flags):
    """Draw robot, humans and obstacles in the original's order; returns False where something found no place.

    The world has no border yet and nobody has moved; the robot's heading is that after the hidden first step.
    """
    agents[0, :] = 0.0
    agents[0, A_VPREF] = between(rng, params[P_VPREF_LOW], params[P_VPREF_HIGH])
    agents[0, A_RADIUS] = between(rng, params[P_RADIUS_LOW], params[P_RADIUS_HIGH])
    ring = min(ROBOT_RADIUS_CAP, CIRCLE_RADIUS * (1.0 + uniform(rng) * 2.0))
    agents[0, A_Y], agents[0, A_GY] = -ring, ring
    n_humans = _place_humans(agents, scalars, rng, params, flags)
    if n_humans < 0:
        return False
    scalars[S_HUMANS] = n_humans
    polygon_start[0] = 0
    n_polygons = _place_obstacles(agents, scalars, vertices, polygon_start, boxes, rng, params)
    if n_polygons < 0:
        return False
    scalars[S_POLYGONS] = n_polygons
    agents[0, A_HEADING] = (0.5 * np.pi + HIDDEN_TURN * (uniform(rng) - 0.5)) % TWO_PI
    return True


# --- step ------------------------------------------------------------------------------------------------------------


@kernel
def walk_original(agents, n_humans, moves, dt):
    """Move the humans: a velocity becomes speed and turn, and a human that stands has heading 0."""
    for i in range(1, n_humans + 1):
        before = agents[i, A_HEADING]
        speed = np.hypot(moves[i, 0], moves[i, 1])
        turned = before + (np.arctan2(moves[i, 1], moves[i, 0]) - before)
        vx, vy = np.cos(turned) * speed, np.sin(turned) * speed
        heading = turned % TWO_PI
        agents[i, A_X] += vx * dt
        agents[i, A_Y] += vy * dt
        agents[i, A_VX], agents[i, A_VY] = vx, vy
        agents[i, A_HEADING] = heading
        c, s = np.cos(heading), np.sin(heading)
        agents[i, A_GAIT_X] += (c * vx + s * vy) * dt
        agents[i, A_GAIT_Y] += (c * vy - s * vx) * dt
        agents[i, A_GAIT_T] += heading - before


@kernel
def window_hits(boxes, n_boxes, x, y, half):
    """Return whether a cell in the window of 2 x half cells about (x, y) [m] is occupied.

    The window is [i - half, i + half): one cell shorter on the upper side. What lies off the grid is free.
    """
    ix = int(np.rint((x + HALF_MAP) / CELL))
    iy = int(np.rint((y + HALF_MAP) / CELL))
    x0, x1 = max(ix - half, 0), min(ix + half, CELLS)
    y0, y1 = max(iy - half, 0), min(iy + half, CELLS)
    for b in range(n_boxes):
        low_x, low_y = max(x0, int(boxes[b, B_X0])), max(y0, int(boxes[b, B_Y0]))
        if boxes[b, B_STEP] == 2.0:  # only even cells
            low_x += low_x % 2
            low_y += low_y % 2
        if low_x < min(x1, int(boxes[b, B_X1])) and low_y < min(y1, int(boxes[b, B_Y1])):
            return True
    return False


@kernel
def _nearest_human(agents, n_humans, moves, dt):
    """Return the smallest gap to a human during the step, humans going on at their old velocity [m].

    Also notes whom the robot touches.
    """
    best = np.inf
    for j in range(1, n_humans + 1):
        rx = agents[j, A_X] - agents[0, A_X]
        ry = agents[j, A_Y] - agents[0, A_Y]
        ex = rx + (agents[j, A_VX] - moves[0, 0]) * dt
        ey = ry + (agents[j, A_VY] - moves[0, 1]) * dt
        gap = np.sqrt(point_segment_sq(0.0, 0.0, rx, ry, ex, ey)) - agents[j, A_RADIUS] - agents[0, A_RADIUS]
        note_touch(agents, j, gap < 0.0, agents[j, A_VX] - moves[0, 0], agents[j, A_VY] - moves[0, 1])
        best = min(best, gap)
    return best


@kernel
def judge_original(agents, scalars, boxes, moves, params, result):
    """Fill result with (reward, event) of the step, before anybody has moved; the first condition that holds decides.

    Time, goal, collision with a human, with a cell or the border; then, while the episode goes on: a cell within
    0.2 m, a human within 0.2 m, a rotation, nothing. Progress is paid only where the episode goes on.
    """
    dt = params[P_DT]
    radius = agents[0, A_RADIUS]
    x = agents[0, A_X] + moves[0, 0] * dt
    y = agents[0, A_Y] + moves[0, 1] * dt
    before = np.hypot(agents[0, A_GX] - agents[0, A_X], agents[0, A_GY] - agents[0, A_Y])
    after = np.hypot(agents[0, A_GX] - x, agents[0, A_GY] - y)
    to_human = _nearest_human(agents, int(scalars[S_HUMANS]), moves, dt)
    scalars[S_CLEAR_HUMAN] = to_human
    scalars[S_CLEAR_STATIC] = np.nan  # cells have no distance
    border = scalars[S_BORDER] != 0.0
    n_boxes = int(scalars[S_POLYGONS]) - (1 if border else 0)
    at_border = border and (
        x <= scalars[S_XMIN] + radius
        or x >= scalars[S_XMAX] - radius
        or y <= scalars[S_YMIN] + radius
        or y >= scalars[S_YMAX] - radius
    )
    # looked at whatever decides: the goal outranks a collision, which is a contact all the same
    at_wall = at_border or window_hits(boxes, n_boxes, x, y, int(np.ceil(radius / np.sqrt(2.0) / CELL)))
    note_touch(agents, 0, at_wall, moves[0, 0], moves[0, 1])
    event = NONE
    reward = 0.0
    if scalars[S_TIME] >= params[P_TIME_LIMIT]:
        event = TIMEOUT
    elif after < reach_of_goal(0, agents, params):
        event = GOAL
        reward = params[P_REWARD_GOAL]
    elif to_human < 0.0:
        event = COLLISION_HUMAN
        reward = params[P_REWARD_COLLISION]
    elif at_wall:
        event = COLLISION_OBSTACLE
        reward = params[P_REWARD_COLLISION]
    else:
        reward = params[P_REWARD_PROGRESS] * (before - after)
        if window_hits(boxes, n_boxes, x, y, int(np.ceil((radius + params[P_DANGER_DIST]) / CELL))):
            reward += params[P_REWARD_DANGER]
        elif to_human < params[P_DANGER_DIST]:
            reward += NEAR_HUMAN_FACTOR * (to_human - params[P_DANGER_DIST])
        else:
            reward += ROTATION_FACTOR * abs(moves[0, 2] * dt)
    result[0] = reward
    result[1] = event
