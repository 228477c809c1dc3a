# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""One world: reset, step, observe. Everything that happens in the simulator happens here, for all callers."""

import numpy as np

from navrep_data._kernels import kernel
from navrep_data.sim._judge import judge
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
    F_GAP_QUIRK,
    F_LEGS,
    F_ORIGINAL,
    P_ANGLE_INCREMENT,
    P_ANGLE_MIN,
    P_BORDER_GAP,
    P_DT,
    P_RANGE_MAX,
    S_EPISODE,
    S_HUMANS,
    S_OBST_HUMAN,
    S_OBST_ROBOT,
    S_OMEGA,
    S_POLYGONS,
    S_STEP,
    S_TIME,
)
from navrep_data.sim._lidar import leg_circles, scan_world
from navrep_data.sim._obstacles import build_obstacles
from navrep_data.sim._orca import orca_velocity
from navrep_data.sim._original import draw_original, judge_original, walk_original
from navrep_data.sim._rng import is_mersenne
from navrep_data.sim._worlds import add_border, draw_world

# orca.py of the original: agents enter RVO2 with their radius plus 1 cm
ORCA_MARGIN = 0.01
# Worlds whose obstacle tree does not fit are drawn again; the sixth in a row means that the config asks for too many.
MAX_REDRAWS = 5
TWO_PI = 2.0 * np.pi
HUMANS_GRID = 1024.0  # steps per metre (and per m/s) of the humans column


@kernel
def fill_edges(vertices, polygon_start, n_polygons, edges):
    """Write the polygons' edges as rows x1, y1, x2, y2."""
    for p in range(n_polygons):
        first, last = polygon_start[p], polygon_start[p + 1] - 1
        for v in range(first, last + 1):
            w = v + 1 if v < last else first
            edges[v, 0], edges[v, 1] = vertices[v, 0], vertices[v, 1]
            edges[v, 2], edges[v, 3] = vertices[w, 0], vertices[w, 1]


@kernel
def pack_orca(agents, n_agents, agents32):
    """Write the agents as RVO2 sees them: float32 x, y, vx, vy, radius + margin, largest speed."""
    for i in range(n_agents):
        agents32[i, 0] = agents[i, A_X]
        agents32[i, 1] = agents[i, A_Y]
        agents32[i, 2] = agents[i, A_VX]
        agents32[i, 3] = agents[i, A_VY]
        agents32[i, 4] = agents[i, A_RADIUS] + ORCA_MARGIN
        agents32[i, 5] = agents[i, A_VPREF]


@kernel
def orca_choice(i, agents, agents32, n_humans, obst_f, obst_i, n_obst, orca_params, work_f, work_i):
    """Return the ORCA velocity of agent i (0 = the robot, which sees all humans) [m/s], world frame."""
    px = agents[i, A_GX] - agents[i, A_X]
    py = agents[i, A_GY] - agents[i, A_Y]
    distance = np.hypot(px, py)
    if distance > 1.0:  # orca.py: the preferred speed is 1 m/s, or less within a metre of the goal
        px /= distance
        py /= distance
    extra = 0 if i > 0 and agents[i, A_SEES] > 0.5 else -1
    return orca_velocity(
        i, agents32, 1, n_humans + 1, extra, np.float32(px), np.float32(py),
        obst_f, obst_i, n_obst, orca_params, work_f, work_i,
    )  # fmt: skip


@kernel
def choose_humans(agents, agents32, scalars, obst_f, obst_i, orca_params, work_f, work_i, moves):
    """Let every human choose its velocity from the present state; writes moves[1:]."""
    n = int(scalars[S_HUMANS])
    pack_orca(agents, n + 1, agents32)
    n_obst = int(scalars[S_OBST_HUMAN])
    for i in range(1, n + 1):
        vx, vy = orca_choice(i, agents, agents32, n, obst_f[0], obst_i[0], n_obst, orca_params, work_f, work_i)
        moves[i, 0] = vx
        moves[i, 1] = vy


@kernel
def move_humans(agents, n_humans, moves, dt):
    """Move the humans and their legs; a human that stands keeps its heading."""
    for i in range(1, n_humans + 1):
        vx, vy = moves[i, 0], moves[i, 1]
        before = agents[i, A_HEADING]
        heading = before
        if vx != 0.0 or vy != 0.0:
            heading = np.arctan2(vy, vx) % TWO_PI
        agents[i, A_X] += vx * dt
        agents[i, A_Y] += vy * dt
        agents[i, A_VX] = vx
        agents[i, A_VY] = vy
        agents[i, A_HEADING] = heading
        c, s = np.cos(heading), np.sin(heading)
        agents[i, A_GAIT_X] += (c * vx + s * vy) * dt
        agents[i, A_GAIT_Y] += (c * vy - s * vx) * dt
        agents[i, A_GAIT_T] += heading - before


@kernel
def build_trees(vertices, polygon_start, scalars, obst_f, obst_i):
    """Build the ORCA obstacle tree of a finished world; returns False where it does not fit."""
    n = int(scalars[S_POLYGONS])
    count = build_obstacles(vertices, polygon_start[: n + 1], obst_f[0], obst_i[0])
    scalars[S_OBST_HUMAN] = count
    scalars[S_OBST_ROBOT] = count
    return count >= 0


@kernel
def begin_original(
    agents, agents32, scalars, vertices, polygon_start, obst_f, obst_i, params, orca_params, work_f, work_i, moves
):  # fmt: skip
    """Take the hidden first step of a drawn `original` world and close it; returns False where a tree does not fit.

    The humans' tree is built before the border is there, so they do not know of it; the robot's tree has it.
    """
    n_polygons = int(scalars[S_POLYGONS])
    scalars[S_OBST_HUMAN] = build_obstacles(vertices, polygon_start[: n_polygons + 1], obst_f[0], obst_i[0])
    if scalars[S_OBST_HUMAN] < 0.0:
        return False
    n_humans = int(scalars[S_HUMANS])
    choose_humans(agents, agents32, scalars, obst_f, obst_i, orca_params, work_f, work_i, moves)
    walk_original(agents, n_humans, moves, params[P_DT])
    scalars[S_TIME] = params[P_DT]
    for i in range(1, n_humans + 1):
        agents[i, A_GAIT_X], agents[i, A_GAIT_Y], agents[i, A_GAIT_T] = 0.0, 0.0, 0.0
    n_polygons = add_border(agents, scalars, vertices, polygon_start, n_polygons, params[P_BORDER_GAP])
    scalars[S_POLYGONS] = n_polygons
    # the original lists the border's corners from the upper left; RVO2's tree depends on the order of the edges
    first = polygon_start[n_polygons - 1]
    for k in range(2):
        corner = vertices[first + 3, k]
        for v in range(first + 3, first, -1):
            vertices[v, k] = vertices[v - 1, k]
        vertices[first, k] = corner
    scalars[S_OBST_ROBOT] = build_obstacles(vertices, polygon_start[: n_polygons + 1], obst_f[-1], obst_i[-1])
    return scalars[S_OBST_ROBOT] >= 0.0


@kernel
def reset_world(
    agents, agents32, scalars, vertices, polygon_start, edges, obst_f, obst_i, boxes, rng, params, flags,
    orca_params, work_f, work_i, moves,
):  # fmt: skip
    """Draw the next episode of a world; returns False if no world fits the arrays."""
    episode = scalars[S_EPISODE]
    # a numpy-seeded stream stands for one episode: another draw would be another episode under the same number
    draws = 1 if is_mersenne(rng) else MAX_REDRAWS + 1
    for _ in range(draws):
        scalars[:] = 0.0
        scalars[S_EPISODE] = episode + 1.0
        if flags[F_ORIGINAL]:
            ready = draw_original(
                agents, scalars, vertices, polygon_start, boxes, rng, params, flags
            ) and begin_original(
                agents, agents32, scalars, vertices, polygon_start, obst_f, obst_i, params, orca_params, work_f,
                work_i, moves,
            )  # fmt: skip
        else:
            draw_world(agents, scalars, vertices, polygon_start, boxes, rng, params, flags)
            ready = build_trees(vertices, polygon_start, scalars, obst_f, obst_i)
        if ready:
            fill_edges(vertices, polygon_start, int(scalars[S_POLYGONS]), edges)
            return True
    return False


@kernel
def step_world(
    agents, agents32, scalars, edges, polygon_start, boxes, obst_f, obst_i,
    params, flags, orca_params, work_f, work_i, moves, ax, ay, omega, result,
):  # fmt: skip
    """Advance a world by one step under the body command (ax, ay [m/s], omega [rad/s]); fills result (reward, event).

    Humans choose from the state before the step; then the step is judged; then everybody moves: the robot translates
    along its old heading and turns afterwards, as the original does.
    """
    dt = params[P_DT]
    choose_humans(agents, agents32, scalars, obst_f, obst_i, orca_params, work_f, work_i, moves)
    c, s = np.cos(agents[0, A_HEADING]), np.sin(agents[0, A_HEADING])
    moves[0, 0] = c * ax - s * ay
    moves[0, 1] = s * ax + c * ay
    original = flags[F_ORIGINAL] != 0
    if original:
        judge_original(agents, scalars, boxes, moves, omega, params, result)
    else:
        judge(agents, scalars, edges, polygon_start, moves, params, result)
    agents[0, A_X] += moves[0, 0] * dt
    agents[0, A_Y] += moves[0, 1] * dt
    agents[0, A_VX] = moves[0, 0]
    agents[0, A_VY] = moves[0, 1]
    agents[0, A_HEADING] = (agents[0, A_HEADING] + omega * dt) % TWO_PI
    if original:
        walk_original(agents, int(scalars[S_HUMANS]), moves, dt)
    else:
        move_humans(agents, int(scalars[S_HUMANS]), moves, dt)
        scalars[S_OMEGA] = omega  # the original observes 0
    scalars[S_TIME] += dt
    scalars[S_STEP] += 1.0


@kernel
def fill_circles(agents, n_humans, legs, circles):
    """Write the humans' circles as the lidar sees them (two legs or one trunk); returns how many.

    The fourth column is the owner: human i has owner i - 1.
    """
    count = 0
    for i in range(1, n_humans + 1):
        if legs:
            speed = np.hypot(agents[i, A_VX], agents[i, A_VY])
            leg_circles(
                agents[i, A_X], agents[i, A_Y], agents[i, A_HEADING], speed,
                agents[i, A_GAIT_X], agents[i, A_GAIT_Y], agents[i, A_GAIT_T], i - 1, circles[count : count + 2],
            )  # fmt: skip
            count += 2
        else:
            circles[count, 0] = agents[i, A_X]
            circles[count, 1] = agents[i, A_Y]
            circles[count, 2] = agents[i, A_RADIUS]
            circles[count, 3] = i - 1
            count += 1
    return count


@kernel
def observe_scan(
    agents, scalars, edges, polygon_start, circles, dirs, inv_work, owner_work, hits, params, flags, out
):  # fmt: skip
    """Fill out (n_rays,) float32 with the ranges from the robot's pose [m], and hits with the rays on each human."""
    n = int(scalars[S_HUMANS])
    n_circles = fill_circles(agents, n, flags[F_LEGS] != 0, circles)
    scan_world(
        edges, polygon_start, int(scalars[S_POLYGONS]), circles, n_circles,
        agents[0, A_X], agents[0, A_Y], agents[0, A_HEADING], dirs,
        params[P_ANGLE_MIN], params[P_ANGLE_INCREMENT], params[P_RANGE_MAX], flags[F_GAP_QUIRK],
        inv_work, owner_work, hits, out,
    )  # fmt: skip


@kernel
def observe_state(agents, scalars, out):
    """Fill out (5,) with goal x, goal y [m], vx, vy [m/s], omega [rad/s] in the robot frame."""
    c, s = np.cos(agents[0, A_HEADING]), np.sin(agents[0, A_HEADING])
    gx = agents[0, A_GX] - agents[0, A_X]
    gy = agents[0, A_GY] - agents[0, A_Y]
    out[0] = c * gx + s * gy
    out[1] = c * gy - s * gx
    out[2] = c * agents[0, A_VX] + s * agents[0, A_VY]
    out[3] = c * agents[0, A_VY] - s * agents[0, A_VX]
    out[4] = scalars[S_OMEGA]


@kernel
def observe_humans(agents, n_humans, hits, out):
    """Fill out (H, 6): position and velocity along the robot's axes, radius, visible; NaN in empty slots."""
    c, s = np.cos(agents[0, A_HEADING]), np.sin(agents[0, A_HEADING])
    for i in range(out.shape[0]):
        if i < n_humans:
            dx = agents[i + 1, A_X] - agents[0, A_X]
            dy = agents[i + 1, A_Y] - agents[0, A_Y]
            vx, vy = agents[i + 1, A_VX], agents[i + 1, A_VY]
            # rounded to about the scan's resolution: what lies below is noise that would not compress
            out[i, 0] = np.rint((c * dx + s * dy) * HUMANS_GRID) / HUMANS_GRID
            out[i, 1] = np.rint((c * dy - s * dx) * HUMANS_GRID) / HUMANS_GRID
            out[i, 2] = np.rint((c * vx + s * vy) * HUMANS_GRID) / HUMANS_GRID
            out[i, 3] = np.rint((c * vy - s * vx) * HUMANS_GRID) / HUMANS_GRID
            out[i, 4] = agents[i + 1, A_RADIUS]
            out[i, 5] = 1.0 if hits[i] > 0 else 0.0
        else:
            out[i, :] = np.nan
