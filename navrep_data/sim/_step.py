# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""One world: reset, step, observe. Everything that happens in the simulator happens here, for all callers."""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.schema import (
    CONTACT_HUMAN,
    CONTACT_NONE,
    CONTACT_ROBOT,
    CONTACT_STATIC,
    LABEL_HUMAN,
    LABEL_NOTHING,
    LABEL_ROBOT,
    LABEL_STATIC,
)
from navrep_data.sim._ellipse import body_ellipse, scan_ellipses
from navrep_data.sim._judge import GOAL, NONE, judge, measure
from navrep_data.sim._layout import (
    A_CLEAR_HUMAN,
    A_CLEAR_STATIC,
    A_EVENT,
    A_GAIT_T,
    A_GAIT_X,
    A_GAIT_Y,
    A_GX,
    A_GY,
    A_HEADING,
    A_OMEGA,
    A_RADIUS,
    A_SEES,
    A_TOUCHED,
    A_VPREF,
    A_VX,
    A_VY,
    A_X,
    A_Y,
    F_ADAPTIVE,
    F_DAMAGE,
    F_DIFFERENTIAL,
    F_ELLIPSE,
    F_GAP_QUIRK,
    F_HIDE_OMEGA,
    F_HUMAN_POLICY,
    F_INERTIA,
    F_LEGS,
    F_NOISE,
    F_ORIGINAL,
    F_ROBOTS,
    F_WANT_LABELS,
    F_WORLD,
    HUMANS_CONSTANT_VELOCITY,
    HUMANS_ORCA,
    P_ANGLE_INCREMENT,
    P_ANGLE_MIN,
    P_BORDER_GAP,
    P_DT,
    P_HUMANS,
    P_RANGE_MAX,
    P_SQUARES,
    RAY_NOTHING,
    RAY_STATIC,
    S_CLEAR_HUMAN,
    S_CLEAR_STATIC,
    S_EPISODE,
    S_EVENT,
    S_FEWER_HUMANS,
    S_FEWER_OBSTACLES,
    S_HUMANS,
    S_NOISE_HIGH,
    S_NOISE_LOW,
    S_OBST_HUMAN,
    S_OBST_ROBOT,
    S_POLYGONS,
    S_STEP,
    S_TIME,
    WORLD_EMPTY,
)
from navrep_data.sim._lidar import leg_circles, scan_world
from navrep_data.sim._noise import disturb, noise_key
from navrep_data.sim._obstacles import build_obstacles
from navrep_data.sim._orca import orca_velocity
from navrep_data.sim._original import draw_original, judge_original, walk_original
from navrep_data.sim._rng import is_mersenne
from navrep_data.sim._robots import first_event, go_on, note_touches, put_back
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
def orca_choice(i, agents, agents32, n_robots, n_humans, obst_f, obst_i, n_obst, orca_params, work_f, work_i):
    """Return the ORCA velocity of agent i [m/s], world frame; a robot sees everybody, a human perhaps no robot."""
    px = agents[i, A_GX] - agents[i, A_X]
    py = agents[i, A_GY] - agents[i, A_Y]
    distance = np.hypot(px, py)
    if distance > 1.0:  # orca.py: the preferred speed is 1 m/s, or less within a metre of the goal
        px /= distance
        py /= distance
    sees = i < n_robots or agents[i, A_SEES] > 0.5
    first, extra = n_robots, -1
    if n_robots > 1:
        first = 0 if sees else n_robots
    elif i > 0 and sees:
        extra = 0
    return orca_velocity(
        i, agents32, first, n_robots + n_humans, extra, np.float32(px), np.float32(py),
        obst_f, obst_i, n_obst, orca_params, work_f, work_i,
    )  # fmt: skip


@kernel
def _walk_straight(agents, i, at_start, moves):
    """Let human i walk at its own speed in the direction in which its goal lay at the start."""
    c, s = np.cos(agents[i, A_HEADING]), np.sin(agents[i, A_HEADING])
    if at_start:
        gx, gy = agents[i, A_GX] - agents[i, A_X], agents[i, A_GY] - agents[i, A_Y]
        distance = np.hypot(gx, gy)
        if distance > 0.0:
            c, s = gx / distance, gy / distance
    moves[i, 0] = agents[i, A_VPREF] * c
    moves[i, 1] = agents[i, A_VPREF] * s


@kernel
def choose_humans(agents, agents32, scalars, obst_f, obst_i, flags, orca_params, work_f, work_i, moves):
    """Let every human choose its velocity from the present state; writes their rows of moves."""
    n = int(scalars[S_HUMANS])
    robots = flags[F_ROBOTS]
    policy = flags[F_HUMAN_POLICY]
    if policy == HUMANS_ORCA:
        pack_orca(agents, robots + n, agents32)
        n_obst = int(scalars[S_OBST_HUMAN])
        for i in range(robots, robots + n):
            vx, vy = orca_choice(
                i, agents, agents32, robots, n, obst_f[0], obst_i[0], n_obst, orca_params, work_f, work_i
            )
            moves[i, 0] = vx
            moves[i, 1] = vy
    else:
        for i in range(robots, robots + n):
            moves[i, 0], moves[i, 1] = 0.0, 0.0
            if policy == HUMANS_CONSTANT_VELOCITY:
                _walk_straight(agents, i, scalars[S_TIME] == 0.0, moves)


@kernel
def move_humans(agents, first, stop, moves, dt):
    """Move the humans, rows first to stop, and their legs; a human that stands keeps its heading."""
    for i in range(first, stop):
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
    agents, agents32, scalars, vertices, polygon_start, obst_f, obst_i, params, flags, orca_params, work_f, work_i,
    moves,
):  # fmt: skip
    """Take the hidden first step of a drawn `original` world and close it; returns False where a tree does not fit.

    The humans' tree is built before the border is there, so they do not know of it; the robot's tree has it.
    """
    n_polygons = int(scalars[S_POLYGONS])
    scalars[S_OBST_HUMAN] = build_obstacles(vertices, polygon_start[: n_polygons + 1], obst_f[0], obst_i[0])
    if scalars[S_OBST_HUMAN] < 0.0:
        return False
    n_humans = int(scalars[S_HUMANS])
    choose_humans(agents, agents32, scalars, obst_f, obst_i, flags, orca_params, work_f, work_i, moves)
    walk_original(agents, n_humans, moves, params[P_DT])
    scalars[S_TIME] = params[P_DT]
    for i in range(1, n_humans + 1):
        agents[i, A_GAIT_X], agents[i, A_GAIT_Y], agents[i, A_GAIT_T] = 0.0, 0.0, 0.0
    if flags[F_WORLD] == WORLD_EMPTY:
        scalars[S_OBST_ROBOT] = scalars[S_OBST_HUMAN]
        return True
    n_polygons = add_border(agents, n_humans + 1, scalars, vertices, polygon_start, n_polygons, params[P_BORDER_GAP])
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
def adapt(scalars, params):
    """Adapt the difficulty to how the last episode ended; one that was broken off changes nothing.

    navreptrainenv.py: one more of everything after the goal, one less otherwise, within zero and the most.
    """
    if scalars[S_EVENT] == GOAL:
        scalars[S_FEWER_HUMANS] = max(scalars[S_FEWER_HUMANS] - 1.0, 0.0)
        scalars[S_FEWER_OBSTACLES] = max(scalars[S_FEWER_OBSTACLES] - 1.0, 0.0)
    elif scalars[S_EVENT] != NONE:
        scalars[S_FEWER_HUMANS] = min(scalars[S_FEWER_HUMANS] + 1.0, params[P_HUMANS])
        scalars[S_FEWER_OBSTACLES] = min(scalars[S_FEWER_OBSTACLES] + 1.0, params[P_SQUARES])


@kernel
def reset_world(
    agents, agents32, scalars, vertices, polygon_start, edges, obst_f, obst_i, boxes, rng, params, flags,
    orca_params, work_f, work_i, moves,
):  # fmt: skip
    """Draw the next episode of a world; returns False if no world fits the arrays."""
    if flags[F_ADAPTIVE]:
        adapt(scalars, params)
    episode = scalars[S_EPISODE] + 1.0
    fewer_humans, fewer_obstacles = scalars[S_FEWER_HUMANS], scalars[S_FEWER_OBSTACLES]
    noise_high, noise_low = 0.0, 0.0
    if flags[F_NOISE]:
        noise_high, noise_low = noise_key(rng, episode)
    # a numpy-seeded stream stands for one episode: another draw would be another episode under the same number
    draws = 1 if is_mersenne(rng) else MAX_REDRAWS + 1
    for _ in range(draws):
        scalars[:] = 0.0
        scalars[S_EPISODE] = episode
        scalars[S_FEWER_HUMANS], scalars[S_FEWER_OBSTACLES] = fewer_humans, fewer_obstacles
        scalars[S_NOISE_HIGH], scalars[S_NOISE_LOW] = noise_high, noise_low
        if flags[F_ORIGINAL]:
            ready = draw_original(
                agents, scalars, vertices, polygon_start, boxes, rng, params, flags
            ) and begin_original(
                agents, agents32, scalars, vertices, polygon_start, obst_f, obst_i, params, flags, orca_params,
                work_f, work_i, moves,
            )  # fmt: skip
        else:
            ready = draw_world(agents, scalars, vertices, polygon_start, boxes, rng, params, flags) and build_trees(
                vertices, polygon_start, scalars, obst_f, obst_i
            )
        if ready:
            fill_edges(vertices, polygon_start, int(scalars[S_POLYGONS]), edges)
            return True
    return False


@kernel
def step_world(
    agents, agents32, scalars, edges, polygon_start, boxes, obst_f, obst_i,
    params, flags, orca_params, work_f, work_i, moves, commands, result,
):  # fmt: skip
    """Advance a world by one step under the robots' body commands (vx, vy [m/s], omega [rad/s], three numbers each).

    Fills result with one reward per robot, then the event. Humans choose from the state before the step; then the step
    is judged; then everybody moves: a robot translates along its old heading and turns afterwards, as the original
    does.
    """
    dt = params[P_DT]
    robots = flags[F_ROBOTS]
    stop = robots + int(scalars[S_HUMANS])
    choose_humans(agents, agents32, scalars, obst_f, obst_i, flags, orca_params, work_f, work_i, moves)
    # Two loops are written out here that could be functions: arguments cost as much as what they do.
    for r in range(robots):
        if flags[F_INERTIA]:  # it goes on as it was; the command acts on its acceleration afterwards
            moves[r, 0], moves[r, 1], moves[r, 2] = agents[r, A_VX], agents[r, A_VY], agents[r, A_OMEGA]
        else:
            ax, ay = commands[3 * r], 0.0 if flags[F_DIFFERENTIAL] else commands[3 * r + 1]
            c, s = np.cos(agents[r, A_HEADING]), np.sin(agents[r, A_HEADING])
            moves[r, 0], moves[r, 1], moves[r, 2] = c * ax - s * ay, s * ax + c * ay, commands[3 * r + 2]
    original = flags[F_ORIGINAL] != 0
    event = NONE
    if original:
        judge_original(agents, scalars, boxes, moves, params, result)
        event = int(result[1])
        agents[0, A_EVENT] = event
        agents[0, A_CLEAR_HUMAN], agents[0, A_CLEAR_STATIC] = scalars[S_CLEAR_HUMAN], scalars[S_CLEAR_STATIC]
    else:
        for r in range(robots):
            measure(r, agents, stop, scalars, edges, polygon_start, moves, dt)
        note_touches(agents, stop, scalars, edges, polygon_start, moves, dt, flags[F_DAMAGE] != 0)
        if flags[F_DAMAGE]:
            put_back(agents, robots, stop, scalars, edges, polygon_start, moves, dt)
        for r in range(robots):
            result[r], mine = judge(r, agents, scalars, moves, params, flags)
            agents[r, A_EVENT] = mine
            if r == 0:
                event = mine
                scalars[S_CLEAR_HUMAN], scalars[S_CLEAR_STATIC] = agents[0, A_CLEAR_HUMAN], agents[0, A_CLEAR_STATIC]
            else:
                event = first_event(event, mine)
                scalars[S_CLEAR_HUMAN] = min(scalars[S_CLEAR_HUMAN], agents[r, A_CLEAR_HUMAN])
                scalars[S_CLEAR_STATIC] = min(scalars[S_CLEAR_STATIC], agents[r, A_CLEAR_STATIC])
        result[robots] = event
    for r in range(robots):
        before = agents[r, A_HEADING]
        agents[r, A_X] += moves[r, 0] * dt
        agents[r, A_Y] += moves[r, 1] * dt
        agents[r, A_VX], agents[r, A_VY], agents[r, A_OMEGA] = moves[r, 0], moves[r, 1], moves[r, 2]
        agents[r, A_HEADING] = (before + moves[r, 2] * dt) % TWO_PI
        if robots > 1 or flags[F_INERTIA]:
            go_on(r, before, agents, params, flags, commands, moves)
        if flags[F_DIFFERENTIAL] and not original and not flags[F_INERTIA]:
            # wheels roll along the heading that the robot has now, and that is what its odometry says
            speed = np.cos(before) * moves[r, 0] + np.sin(before) * moves[r, 1]
            agents[r, A_VX], agents[r, A_VY] = (
                np.cos(agents[r, A_HEADING]) * speed, np.sin(agents[r, A_HEADING]) * speed
            )  # fmt: skip
    if original:
        walk_original(agents, int(scalars[S_HUMANS]), moves, dt)
    else:
        move_humans(agents, robots, stop, moves, dt)
    if scalars[S_EVENT] == NONE:
        scalars[S_EVENT] = event
    scalars[S_TIME] += dt
    scalars[S_STEP] += 1.0


@kernel
def fill_circles(r, agents, n_robots, n_humans, flags, circles):
    """Write all that the lidar of robot r sees of agents (two legs, a trunk or an ellipse each); returns how many rows.

    r = -1: the humans alone. The fourth column is the owner: humans from 0, then the other robots.
    """
    count = 0
    legs, ellipse = flags[F_LEGS] != 0, flags[F_ELLIPSE] != 0
    for owner in range(n_humans if r < 0 else n_humans + n_robots - 1):
        i = n_robots + owner
        if owner >= n_humans:
            i = owner - n_humans
            i += 1 if i >= r else 0
        if legs:
            speed = np.hypot(agents[i, A_VX], agents[i, A_VY])
            leg_circles(
                agents[i, A_X], agents[i, A_Y], agents[i, A_HEADING], speed,
                agents[i, A_GAIT_X], agents[i, A_GAIT_Y], agents[i, A_GAIT_T], owner, circles[count : count + 2],
            )  # fmt: skip
            count += 2
        elif ellipse:
            body_ellipse(
                agents[i, A_X], agents[i, A_Y], agents[i, A_HEADING], agents[i, A_RADIUS], owner, circles[count]
            )  # fmt: skip
            count += 1
        else:
            circles[count, 0] = agents[i, A_X]
            circles[count, 1] = agents[i, A_Y]
            circles[count, 2] = agents[i, A_RADIUS]
            circles[count, 3] = owner
            count += 1
    return count


@kernel
def observe_scan(
    r, agents, scalars, edges, polygon_start, circles, dirs, inv_work, owner_work, hits, params, flags, out
):  # fmt: skip
    """Fill out (n_rays,) float32 with the ranges from robot r's pose [m], and hits with the rays on each agent."""
    n = int(scalars[S_HUMANS])
    n_circles = fill_circles(r, agents, flags[F_ROBOTS], n, flags, circles)
    if flags[F_ELLIPSE]:
        scan_ellipses(
            edges, polygon_start, int(scalars[S_POLYGONS]), circles, n_circles,
            agents[r, A_X], agents[r, A_Y], agents[r, A_HEADING], dirs,
            params[P_ANGLE_MIN], params[P_ANGLE_INCREMENT], params[P_RANGE_MAX],
            inv_work, owner_work, hits, out,
        )  # fmt: skip
    else:
        scan_world(
            edges, polygon_start, int(scalars[S_POLYGONS]), circles, n_circles,
            agents[r, A_X], agents[r, A_Y], agents[r, A_HEADING], dirs,
            params[P_ANGLE_MIN], params[P_ANGLE_INCREMENT], params[P_RANGE_MAX], flags[F_GAP_QUIRK],
            inv_work, owner_work, hits, out,
        )  # fmt: skip
    if flags[F_WANT_LABELS]:
        note_static(owner_work, params[P_RANGE_MAX], out)
    if flags[F_NOISE]:
        disturb(scalars, r, params, out)


@kernel
def note_static(owner_of_ray, range_max, scan):
    """Give the rays of a scan without noise (n_rays,) [m] that hit something, but nobody, to static matter."""
    for ray in range(scan.shape[0]):
        if owner_of_ray[ray] == RAY_NOTHING and scan[ray] < np.float32(range_max):
            owner_of_ray[ray] = RAY_STATIC


@kernel
def label_rays(owner_of_ray, n_humans, out):
    """Fill out (n_rays,) uint8: 0 nothing, 1 static, 2 another robot, 3 + k the human in slot k."""
    for ray in range(out.shape[0]):
        owner = owner_of_ray[ray]
        if owner >= 0:
            out[ray] = LABEL_HUMAN + owner if owner < n_humans else LABEL_ROBOT
        else:
            out[ray] = LABEL_STATIC if owner == RAY_STATIC else LABEL_NOTHING


@kernel
def contact_of(agents, n_robots, n_agents):
    """Return what the first robot touched in the last step: the first of human, other robot, static matter, or none."""
    found = CONTACT_STATIC if agents[0, A_TOUCHED] > 0.0 else CONTACT_NONE
    for j in range(1, n_agents):
        if agents[j, A_TOUCHED] > 0.0:
            if j >= n_robots:
                return CONTACT_HUMAN
            found = CONTACT_ROBOT
    return found


@kernel
def observe_state(r, agents, flags, out):
    """Fill out (5,) with goal x, goal y [m], vx, vy [m/s], omega [rad/s] in the frame of robot r."""
    c, s = np.cos(agents[r, A_HEADING]), np.sin(agents[r, A_HEADING])
    gx = agents[r, A_GX] - agents[r, A_X]
    gy = agents[r, A_GY] - agents[r, A_Y]
    out[0] = c * gx + s * gy
    out[1] = c * gy - s * gx
    out[2] = c * agents[r, A_VX] + s * agents[r, A_VY]
    out[3] = c * agents[r, A_VY] - s * agents[r, A_VX]
    out[4] = 0.0 if flags[F_HIDE_OMEGA] else agents[r, A_OMEGA]


@kernel
def observe_humans(r, agents, n_robots, n_humans, hits, out):
    """Fill out (H, 6): position and velocity along robot r's axes, radius, visible; NaN in empty slots.

    The humans come first, then the other robots.
    """
    c, s = np.cos(agents[r, A_HEADING]), np.sin(agents[r, A_HEADING])
    for i in range(out.shape[0]):
        if i < n_humans + n_robots - 1:
            j = n_robots + i
            if i >= n_humans:
                j = i - n_humans
                j += 1 if j >= r else 0
            dx = agents[j, A_X] - agents[r, A_X]
            dy = agents[j, A_Y] - agents[r, A_Y]
            vx, vy = agents[j, A_VX], agents[j, A_VY]
            # rounded to about the scan's resolution: what lies below is noise that would not compress
            out[i, 0] = np.rint((c * dx + s * dy) * HUMANS_GRID) / HUMANS_GRID
            out[i, 1] = np.rint((c * dy - s * dx) * HUMANS_GRID) / HUMANS_GRID
            out[i, 2] = np.rint((c * vx + s * vy) * HUMANS_GRID) / HUMANS_GRID
            out[i, 3] = np.rint((c * vy - s * vx) * HUMANS_GRID) / HUMANS_GRID
            out[i, 4] = agents[j, A_RADIUS]
            out[i, 5] = 1.0 if hits[i] > 0 else 0.0
        else:
            out[i, :] = np.nan
