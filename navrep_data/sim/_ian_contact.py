# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Who touches whom or what on a map.

An agent touches another where its disc meets a circle that the lidar sees of the other: one of its legs, or its trunk.
Static matter is the map's solid cells: in `consistent` physics the disc, swept along the step, against the cells'
squares; in `original` the distance field at the cell of the centre, which is up to a cell off.

Source: pepper_2d_simulator.py and pepper_2d_iarlenv.py of asl-pepper-2d-sim 0.0.5 (SIM_FACTS d.4, d.5).
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._geometry import point_segment_sq
from navrep_data.sim._ian_layout import (
    T_CELLS,
    T_HEIGHT,
    T_RESOLUTION,
    T_WIDTH,
    T_X0,
    T_Y0,
    W_PERMISSIVITY,
    W_SEEN_GAIT_T,
    W_SEEN_GAIT_X,
    W_SEEN_GAIT_Y,
    W_SEEN_HEADING,
    W_SEEN_SPEED,
    W_SEEN_X,
    W_SEEN_Y,
)
from navrep_data.sim._ian_plan import cell_index
from navrep_data.sim._layout import A_RADIUS, A_X, A_Y
from navrep_data.sim._lidar import CIRCLE_RADIUS, CIRCLE_X, CIRCLE_Y, leg_circles
from navrep_data.sim._rng import uniform

# contacts: two humans near each other either block each other or let each other through
CONTACT_NONE, CONTACT_BLOCKED, CONTACT_PASSING = 0, 1, 2
# pepper_2d_iarlenv.py: contact begins where centres are nearer than twice both radii
CONTACT_REACH = 2.0
# beyond this the exact distance to solid cells is not looked for [m]
CLEARANCE_REACH = 1.0


@kernel
def update_contacts(agents, walkers, contacts, n_robots, n, rng):
    """Begin and end contact episodes; whether two pass through each other is drawn once per episode.

    A robot's pairs never pass, yet they draw, as in the original.
    """
    for i in range(n):
        for j in range(i + 1, n):
            dx, dy = agents[j, A_X] - agents[i, A_X], agents[j, A_Y] - agents[i, A_Y]
            if np.sqrt(dx * dx + dy * dy) < CONTACT_REACH * agents[i, A_RADIUS] + CONTACT_REACH * agents[j, A_RADIUS]:
                if contacts[i, j] == CONTACT_NONE:
                    chance = min(max(min(walkers[i, W_PERMISSIVITY], walkers[j, W_PERMISSIVITY]), 0.0), 1.0)
                    state = CONTACT_PASSING if uniform(rng) < chance else CONTACT_BLOCKED
                    contacts[i, j] = state
                    contacts[j, i] = state
            else:
                contacts[i, j] = CONTACT_NONE
                contacts[j, i] = CONTACT_NONE
    for i in range(n_robots):
        for j in range(n):
            contacts[i, j] = CONTACT_NONE
            contacts[j, i] = CONTACT_NONE


@kernel
def body_circles(agents, walkers, n, legs, circles):
    """Write two circles per agent, as the lidar sees it (row 2 i and 2 i + 1): its legs, or twice its trunk."""
    for i in range(n):
        rows = circles[2 * i : 2 * i + 2]
        leg_circles(
            walkers[i, W_SEEN_X], walkers[i, W_SEEN_Y], walkers[i, W_SEEN_HEADING], walkers[i, W_SEEN_SPEED],
            walkers[i, W_SEEN_GAIT_X], walkers[i, W_SEEN_GAIT_Y], walkers[i, W_SEEN_GAIT_T], i, rows,
        )  # fmt: skip
        if not legs:
            for k in range(2):
                rows[k, CIRCLE_X], rows[k, CIRCLE_Y] = walkers[i, W_SEEN_X], walkers[i, W_SEEN_Y]
                rows[k, CIRCLE_RADIUS] = agents[i, A_RADIUS]


@kernel
def touches(agents, circles, i, j):
    """Return whether agent i's disc meets a circle of agent j."""
    for k in range(2 * j, 2 * j + 2):
        dx, dy = agents[i, A_X] - circles[k, CIRCLE_X], agents[i, A_Y] - circles[k, CIRCLE_Y]
        if np.sqrt(dx * dx + dy * dy) < agents[i, A_RADIUS] + circles[k, CIRCLE_RADIUS]:
            return True
    return False


@kernel
def cell_distance(maps, map_row, x, y):
    """Return the map's signed distance [m] at the cell of a point, as the original looks it up."""
    width, height = int(map_row[T_WIDTH]), int(map_row[T_HEIGHT])
    i = cell_index(x, map_row[T_X0], map_row[T_RESOLUTION], width)
    j = cell_index(y, map_row[T_Y0], map_row[T_RESOLUTION], height)
    return np.float64(maps.distance[int(map_row[T_CELLS]) + i * height + j])


@kernel
def _segment_box_sq(ax, ay, bx, by, x0, y0, x1, y1):
    """Return the squared distance of the segment a-b to an axis-aligned box; 0 where they meet."""
    # clip the segment to the box (Liang and Barsky)
    low, high = 0.0, 1.0
    dx, dy = bx - ax, by - ay
    apart = False
    for k in range(2):
        d, near, far = (dx, x0 - ax, x1 - ax) if k == 0 else (dy, y0 - ay, y1 - ay)
        if d == 0.0:
            if near > 0.0 or far < 0.0:
                apart = True
        else:
            t0, t1 = near / d, far / d
            if t0 > t1:
                t0, t1 = t1, t0
            low, high = max(low, t0), min(high, t1)
    if not apart and low <= high:
        return 0.0
    gx, gy = max(x0 - ax, ax - x1, 0.0), max(y0 - ay, ay - y1, 0.0)
    best = gx * gx + gy * gy
    gx, gy = max(x0 - bx, bx - x1, 0.0), max(y0 - by, by - y1, 0.0)
    best = min(best, gx * gx + gy * gy)
    best = min(best, point_segment_sq(x0, y0, ax, ay, bx, by))
    best = min(best, point_segment_sq(x1, y0, ax, ay, bx, by))
    best = min(best, point_segment_sq(x0, y1, ax, ay, bx, by))
    return min(best, point_segment_sq(x1, y1, ax, ay, bx, by))


@kernel
def swept_cells(maps, map_row, ax, ay, bx, by, reach):
    """Return the smallest distance of a point moving from a to b to solid cells or the map's edge [m].

    Exact below `reach`; beyond that a lower bound that is at least `reach`. 0 where the point enters solid matter.
    """
    resolution, x0, y0 = map_row[T_RESOLUTION], map_row[T_X0], map_row[T_Y0]
    width, height = int(map_row[T_WIDTH]), int(map_row[T_HEIGHT])
    x1, y1 = x0 + width * resolution, y0 + height * resolution
    rim = min(min(ax, bx) - x0, x1 - max(ax, bx), min(ay, by) - y0, y1 - max(ay, by))
    best = max(rim, 0.0)
    # the distance field goes from centre to centre: it is off by at most a cell's diagonal and the step
    start = int(map_row[T_CELLS])
    i = min(max(int((ax - x0) / resolution), 0), width - 1)
    j = min(max(int((ay - y0) / resolution), 0), height - 1)
    way = np.hypot(bx - ax, by - ay)
    nearest = abs(np.float64(maps.distance[start + i * height + j]))
    sure = nearest - 1.5 * resolution - way
    if sure >= reach:
        return min(best, sure)
    # some solid square is at most this far from a
    limit = min(best, reach, nearest + resolution)
    low_i = max(int(np.floor((min(ax, bx) - limit - x0) / resolution)), 0)
    high_i = min(int(np.floor((max(ax, bx) + limit - x0) / resolution)), width - 1)
    low_j = max(int(np.floor((min(ay, by) - limit - y0) / resolution)), 0)
    high_j = min(int(np.floor((max(ay, by) + limit - y0) / resolution)), height - 1)
    square = limit * limit
    found = False
    for i in range(low_i, high_i + 1):
        row = start + i * height
        j = low_j
        while j <= high_j:
            if maps.solid[row + j]:
                left, bottom = x0 + i * resolution, y0 + j * resolution
                d = _segment_box_sq(ax, ay, bx, by, left, bottom, left + resolution, bottom + resolution)
                if d < square:
                    square = d
                    found = True
                j += 1
            else:  # no solid cell is nearer than the distance field says
                free = min(abs(maps.distance[row + j]), np.float32(1e6)) / np.float32(resolution)
                j += max(int(free), 1)
    return np.sqrt(square) if found else max(limit, min(best, sure))
