# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Rows: whole sequences under a scripted policy, and batches of worlds stepped for anybody else.

One row = one observation and the action taken from it. Both ways of making rows call the same functions in the same
order, so a sequence has the same bytes however it was made.
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.schema import CONTACT_NONE
from navrep_data.sim._judge import CUT, NONE, STUCK
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
    A_X,
    A_Y,
    F_DIFFERENTIAL,
    F_POLICY,
    F_ROBOTS,
    F_SCAN_MM,
    F_WANT_HUMANS,
    F_WANT_LABELS,
    P_DT,
    P_OMEGA_NOISE,
    P_POLICY_SPEED,
    P_RANGE_MAX,
    P_STUCK_SPEED,
    POLICY_CONSTANT_VELOCITY,
    POLICY_GOAL_MOMENTUM,
    POLICY_ORCA,
    S_BORDER,
    S_EPISODE,
    S_EVENT,
    S_HUMANS,
    S_OBST_ROBOT,
    S_POLYGONS,
    S_STEP,
)
from navrep_data.sim._rng import uniform
from navrep_data.sim._step import (
    contact_of,
    label_rays,
    observe_humans,
    observe_scan,
    observe_state,
    orca_choice,
    pack_orca,
    reset_world,
    step_world,
)

# make_vae_dataset.py, RandomMomentumPolicy: speed <- clip(speed + 0.1 (u - 0.5) - speed (0.01, 0.01, 0.1), +-0.5)
MOMENTUM_NOISE = 0.1
MOMENTUM_DRAG = 0.01
MOMENTUM_SPIN_DRAG = 0.1
MOMENTUM_LIMIT = 0.5
# ours: how strongly goal-seeking momentum is pulled towards full speed at the goal, per step
GOAL_PULL = 0.05
# ours: the fastest turn of a differential drive towards the direction in which a policy wants to go [rad/s]
STEER_LIMIT = 1.0
# what finish_row returns, beside events, after an episode's last row
OVER = -1


@kernel
def _steer(vx, vy, dt, out):
    """Fill out (3,) with what a differential drive does to get the body velocity (vx, vy): turn there, go forward."""
    angle = np.arctan2(vy, vx)
    out[0] = max(vx, 0.0)
    out[1] = 0.0
    out[2] = min(max(angle / dt, -STEER_LIMIT), STEER_LIMIT)


@kernel
def _momentum(r, agents, params, flags, rng, heading, memory):
    """Let a robot's velocity (memory, three numbers) drift, for goal-momentum towards the goal."""
    for k in range(3):
        drag = MOMENTUM_SPIN_DRAG if k == 2 else MOMENTUM_DRAG
        value = memory[k] + MOMENTUM_NOISE * (uniform(rng) - 0.5) - drag * memory[k]
        memory[k] = min(max(value, -MOMENTUM_LIMIT), MOMENTUM_LIMIT)
    if flags[F_POLICY] == POLICY_GOAL_MOMENTUM:
        c, s = np.cos(heading), np.sin(heading)
        gx = agents[r, A_GX] - agents[r, A_X]
        gy = agents[r, A_GY] - agents[r, A_Y]
        norm = max(np.hypot(gx, gy), 1e-6)
        pull_x = params[P_POLICY_SPEED] * (c * gx + s * gy) / norm
        pull_y = params[P_POLICY_SPEED] * (c * gy - s * gx) / norm
        memory[0] += GOAL_PULL * (pull_x - memory[0])
        memory[1] += GOAL_PULL * (pull_y - memory[1])


@kernel
def choose_action(
    r, agents, agents32, scalars, obst_f, obst_i, rng, params, flags, orca_params, work_f, work_i, memory, out
):
    """Fill out (3,) with a scripted policy's command for robot r; returns False where it gives up (ORCA's stuck rule).

    `memory` (3,) is the policy's own state, zero at the start of each episode.
    """
    policy = flags[F_POLICY]
    heading = agents[r, A_HEADING]
    if policy == POLICY_ORCA:
        c, s = np.cos(heading), np.sin(heading)
        n, robots = int(scalars[S_HUMANS]), flags[F_ROBOTS]
        pack_orca(agents, robots + n, agents32)
        vx, vy = orca_choice(
            r, agents, agents32, robots, n, obst_f[-1], obst_i[-1], int(scalars[S_OBST_ROBOT]), orca_params,
            work_f, work_i,
        )  # fmt: skip
        wx, wy = np.float64(vx), np.float64(vy)
        if np.hypot(wx, wy) < params[P_STUCK_SPEED]:
            out[:] = 0.0
            return False
        out[0] = c * wx + s * wy
        out[1] = c * wy - s * wx
        out[2] = params[P_OMEGA_NOISE] * (uniform(rng) - 0.5)
    else:
        if policy == POLICY_CONSTANT_VELOCITY:
            if scalars[S_STEP] == 0.0:
                speed = params[P_POLICY_SPEED] * uniform(rng)
                direction = 2.0 * np.pi * uniform(rng)
                memory[0] = speed * np.cos(direction)
                memory[1] = speed * np.sin(direction)
        else:
            if scalars[S_STEP] == 0.0:
                memory[:] = 0.0
            _momentum(r, agents, params, flags, rng, heading, memory)
        out[0], out[1], out[2] = memory[0], memory[1], memory[2]
    if flags[F_DIFFERENTIAL]:
        _steer(out[0], out[1], params[P_DT], out)
    return True


@kernel
def choose_actions(
    agents, agents32, scalars, obst_f, obst_i, rng, params, flags, orca_params, work_f, work_i, memory, out
):
    """Fill out (3 R,) with the scripted policy's commands for all robots; returns whether robot 0 goes on.

    Another robot that gives up stands still.
    """
    going = choose_action(
        0, agents, agents32, scalars, obst_f, obst_i, rng, params, flags, orca_params, work_f, work_i, memory[:3],
        out[:3],
    )  # fmt: skip
    for r in range(1, flags[F_ROBOTS]):
        k = 3 * r
        choose_action(
            r, agents, agents32, scalars, obst_f, obst_i, rng, params, flags, orca_params, work_f, work_i,
            memory[k : k + 3], out[k : k + 3],
        )  # fmt: skip
    return going


@kernel
def store_scan(scan, range_max, out_mm):
    """Write a float32 scan [m] as millimetres: rounded half to even, at least 1 unless it is 0 (invalid)."""
    for k in range(scan.shape[0]):
        value = np.rint(np.float64(min(scan[k], np.float32(range_max))) * 1000.0)
        out_mm[k] = np.uint16(max(value, 1.0 if scan[k] > 0.0 else 0.0))


@kernel
def note_episode(row, agents, robots, scalars, vertices, polygon_start, episodes, corners, sizes, humans, counts):
    """Append the present episode's static side to the worlds tables; `counts` (4,) holds how full each of them is.

    The robots but the first are listed after the humans.

    episodes (E, 10): row, robot x, y, heading, goal x, y, v_pref, has border, number of polygons, number of humans.
    sizes (P,): corners of each polygon; corners (V, 2). humans (Hn, 10): x, y, heading, goal x, y, v_pref, sees the
    robot, gait x, y, theta.
    """
    e, v, p, h = counts[0], counts[1], counts[2], counts[3]
    n_polygons, n_humans = int(scalars[S_POLYGONS]), int(scalars[S_HUMANS])
    n_others = n_humans + robots - 1
    episodes[e, 0] = row
    episodes[e, 1], episodes[e, 2], episodes[e, 3] = agents[0, A_X], agents[0, A_Y], agents[0, A_HEADING]
    episodes[e, 4], episodes[e, 5] = agents[0, A_GX], agents[0, A_GY]
    episodes[e, 6], episodes[e, 7] = agents[0, A_VPREF], scalars[S_BORDER]
    episodes[e, 8], episodes[e, 9] = n_polygons, n_others
    for k in range(n_polygons):
        sizes[p + k] = polygon_start[k + 1] - polygon_start[k]
    for m in range(polygon_start[n_polygons]):
        corners[v + m, 0] = vertices[m, 0]
        corners[v + m, 1] = vertices[m, 1]
    for k in range(n_others):
        i = robots + k if k < n_humans else k - n_humans + 1
        t = h + k
        humans[t, 0], humans[t, 1], humans[t, 2] = agents[i, A_X], agents[i, A_Y], agents[i, A_HEADING]
        humans[t, 3], humans[t, 4] = agents[i, A_GX], agents[i, A_GY]
        humans[t, 5] = agents[i, A_VPREF]
        humans[t, 6] = agents[i, A_SEES] if k < n_humans else 1.0
        humans[t, 7], humans[t, 8], humans[t, 9] = (
            agents[i, A_GAIT_X],
            agents[i, A_GAIT_Y],
            agents[i, A_GAIT_T],
        )
    counts[0] = e + 1
    counts[1] = v + polygon_start[n_polygons]
    counts[2] = p + n_polygons
    counts[3] = h + n_others


@kernel
def begin_row(
    row, agents, scalars, vertices, polygon_start, edges, circles, dirs, inv_work, owner_work, hits, scan32,
    params, flags, out_scan, out_floats, out_ints, out_humans, out_labels, episodes, corners, sizes, humans, counts,
):  # fmt: skip
    """Observe a world from robot 0 and write this row's observation; on an episode's first row also its static side."""
    robots = flags[F_ROBOTS]
    if scalars[S_STEP] == 0.0:
        note_episode(row, agents, robots, scalars, vertices, polygon_start, episodes, corners, sizes, humans, counts)
    observe_scan(
        0,
        agents,
        scalars,
        edges,
        polygon_start,
        circles,
        dirs,
        inv_work,
        owner_work,
        hits,
        params,
        flags,
        scan32,
    )
    if flags[F_SCAN_MM]:
        store_scan(scan32, params[P_RANGE_MAX], out_scan[row])
    else:
        for k in range(scan32.shape[0]):
            out_scan[row, k] = scan32[k]
    floats = out_floats[row]
    observe_state(0, agents, flags, floats[:5])
    for k in range(5, 9):
        floats[k] = 0.0
    floats[9] = agents[0, A_X]
    floats[10] = agents[0, A_Y]
    floats[11] = agents[0, A_HEADING]
    floats[12] = agents[0, A_RADIUS]
    out_ints[row, 0] = NONE
    out_ints[row, 1] = int(scalars[S_EPISODE])
    out_ints[row, 2] = int(scalars[S_STEP])
    out_ints[row, 3] = CONTACT_NONE
    if flags[F_WANT_LABELS]:
        label_rays(owner_work, int(scalars[S_HUMANS]), out_labels[row])
    if flags[F_WANT_HUMANS]:
        observe_humans(0, agents, robots, int(scalars[S_HUMANS]), hits, out_humans[row])


@kernel
def finish_row(
    row, length, pending, gave_up, action, agents, agents32, scalars, polygon_start, edges, obst_f, obst_i, boxes,
    params, flags, orca_params, work_f, work_i, moves, result, out_floats, out_ints,
):  # fmt: skip
    """Take the row's action, or end its episode; returns the event that ends the episode at the next row.

    `pending` is that event from the row before. OVER is returned where this row is its episode's last: worlds are made
    anew by the caller, so that a first run can compile that and this in two processes at the same time.
    """
    if pending != NONE:
        out_ints[row, 0] = pending
    elif row == length - 1:
        out_ints[row, 0] = CUT
    elif gave_up:
        out_ints[row, 0] = STUCK
        scalars[S_EVENT] = STUCK
    else:
        # what is stored is what was executed
        for k in range(action.shape[0]):
            action[k] = np.float64(np.float32(action[k]))
        if flags[F_DIFFERENTIAL]:
            action[1] = 0.0
        step_world(
            agents, agents32, scalars, edges, polygon_start, boxes, obst_f, obst_i, params, flags, orca_params,
            work_f, work_i, moves, action, result,
        )  # fmt: skip
        out_floats[row, 5], out_floats[row, 6], out_floats[row, 7] = action[0], action[1], action[2]
        out_floats[row, 8] = result[0]
        out_ints[row, 3] = contact_of(agents, flags[F_ROBOTS], flags[F_ROBOTS] + int(scalars[S_HUMANS]))
        return int(result[flags[F_ROBOTS]])
    return OVER


@kernel
def rollout_sequence(
    agents, agents32, scalars, vertices, polygon_start, edges, obst_f, obst_i, boxes, rng, circles, dirs,
    inv_work, owner_work, hits, scan32, work_f, work_i, moves, params, flags, orca_params,
    out_scan, out_floats, out_ints, out_humans, out_labels, episodes, corners, sizes, humans, counts,
):  # fmt: skip
    """Simulate one sequence under a scripted policy into the out arrays; returns False if no world could be made.

    The random stream `rng` must be seeded; everything else is set here.
    """
    length = out_floats.shape[0]
    robots = flags[F_ROBOTS]
    memory = np.zeros(3 * robots)
    action = np.zeros(3 * robots)
    result = np.zeros(robots + 1)
    counts[:] = 0
    scalars[:] = 0.0
    scalars[S_EPISODE] = -1.0
    if not reset_world(
        agents, agents32, scalars, vertices, polygon_start, edges, obst_f, obst_i, boxes, rng, params, flags,
        orca_params, work_f, work_i, moves,
    ):  # fmt: skip
        return False
    pending = NONE
    for row in range(length):
        begin_row(
            row, agents, scalars, vertices, polygon_start, edges, circles, dirs, inv_work, owner_work, hits, scan32,
            params, flags, out_scan, out_floats, out_ints, out_humans, out_labels, episodes, corners, sizes, humans,
            counts,
        )  # fmt: skip
        gave_up = False
        if pending == NONE and row < length - 1:
            gave_up = not choose_actions(
                agents, agents32, scalars, obst_f, obst_i, rng, params, flags, orca_params, work_f, work_i,
                memory, action,
            )  # fmt: skip
        pending = finish_row(
            row, length, pending, gave_up, action, agents, agents32, scalars, polygon_start, edges, obst_f, obst_i,
            boxes, params, flags, orca_params, work_f, work_i, moves, result, out_floats, out_ints,
        )  # fmt: skip
        if pending == OVER:
            pending = NONE
            if row < length - 1 and not reset_world(
                agents, agents32, scalars, vertices, polygon_start, edges, obst_f, obst_i, boxes, rng, params, flags,
                orca_params, work_f, work_i, moves,
            ):  # fmt: skip
                return False
    return True


@kernel
def begin_rows(
    row, agents, scalars, vertices, polygon_start, edges, circles, dirs, inv_work, owner_work, hits, scan32,
    params, flags, out_scan, out_floats, out_ints, out_humans, out_labels, episodes, corners, sizes, humans, counts,
):  # fmt: skip
    """Call :func:`begin_row` on every world of a batch (arrays with a leading world axis)."""
    for w in range(agents.shape[0]):
        begin_row(
            row, agents[w], scalars[w], vertices[w], polygon_start[w], edges[w], circles, dirs, inv_work, owner_work,
            hits[w], scan32[w], params, flags, out_scan[w], out_floats[w], out_ints[w], out_humans[w], out_labels[w],
            episodes[w], corners[w], sizes[w], humans[w], counts[w],
        )  # fmt: skip


@kernel
def finish_rows(
    row, length, pending, gave_up, actions, agents, agents32, scalars, vertices, polygon_start, edges, obst_f, obst_i,
    boxes, rng, params, flags, orca_params, work_f, work_i, moves, result, out_floats, out_ints,
):  # fmt: skip
    """Call :func:`finish_row` on every world of a batch; returns False if one could not be made anew."""
    for w in range(agents.shape[0]):
        pending[w] = finish_row(
            row, length, pending[w], gave_up[w], actions[w], agents[w], agents32, scalars[w], polygon_start[w],
            edges[w], obst_f[w], obst_i[w], boxes[w], params, flags, orca_params, work_f, work_i, moves, result,
            out_floats[w], out_ints[w],
        )  # fmt: skip
        if pending[w] == OVER:
            pending[w] = NONE
            if row < length - 1 and not reset_world(
                agents[w], agents32, scalars[w], vertices[w], polygon_start[w], edges[w], obst_f[w], obst_i[w],
                boxes[w], rng[w], params, flags, orca_params, work_f, work_i, moves,
            ):  # fmt: skip
                return False
    return True
