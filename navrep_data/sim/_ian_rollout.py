# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Rows of worlds on maps: what ``_rollout`` does for polygons, with the same columns in the same order."""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.schema import CONTACT_NONE
from navrep_data.sim._ian_layout import (
    M_MAP,
    M_SCENARIO,
    R_MAX_VX,
    R_ROBOTS,
    W_SHOWN_HEADING,
    W_SHOWN_X,
    W_SHOWN_Y,
)
from navrep_data.sim._ian_orca import guided_velocity, pack_agents
from navrep_data.sim._ian_plan import limit_command
from navrep_data.sim._ian_reset import reset_map_world
from navrep_data.sim._ian_scan import scan_map_world, state_on_map
from navrep_data.sim._ian_step import step_map_world
from navrep_data.sim._judge import CUT, NONE, STUCK
from navrep_data.sim._layout import (
    A_HEADING,
    A_RADIUS,
    F_DIFFERENTIAL,
    F_POLICY,
    F_SCAN_MM,
    F_WANT_HUMANS,
    F_WANT_LABELS,
    P_DT,
    P_OMEGA_NOISE,
    P_POLICY_SPEED,
    P_RANGE_MAX,
    P_STUCK_SPEED,
    POLICY_CONSTANT_VELOCITY,
    POLICY_ORCA,
    S_EPISODE,
    S_EVENT,
    S_HUMANS,
    S_STEP,
)
from navrep_data.sim._rng import uniform
from navrep_data.sim._rollout import _momentum, _steer, note_episode, store_scan
from navrep_data.sim._step import contact_of, label_rays, observe_humans


@kernel
def _choose(r, agents, walkers, scalars, place, own_field, rng, maps, orca, path, params, flags, rules, memory, out):
    """Fill out (3,) with a scripted policy's command for robot r; returns False where it gives up."""
    policy = flags[F_POLICY]
    heading = agents[r, A_HEADING]
    if policy == POLICY_ORCA:
        n = int(rules[R_ROBOTS]) + int(scalars[S_HUMANS])
        pack_agents(agents, n, orca)
        map_row = maps.table[int(place[M_MAP])]
        vx, vy = guided_velocity(
            agents, walkers, r, 0, n, -1, place, own_field, maps, map_row, orca, rng, path
        )  # fmt: skip
        if np.hypot(vx, vy) < params[P_STUCK_SPEED]:
            out[:] = 0.0
            return False
        c, s = np.cos(heading), np.sin(heading)
        out[0], out[1] = c * vx + s * vy, c * vy - s * vx
        out[2] = params[P_OMEGA_NOISE] * (uniform(rng) - 0.5)
    else:
        if policy == POLICY_CONSTANT_VELOCITY:
            if scalars[S_STEP] == 0.0:
                speed = params[P_POLICY_SPEED] * uniform(rng)
                direction = 2.0 * np.pi * uniform(rng)
                memory[0], memory[1] = speed * np.cos(direction), speed * np.sin(direction)
        else:
            if scalars[S_STEP] == 0.0:
                memory[:] = 0.0
            _momentum(r, agents, params, flags, rng, heading, memory)
        out[0], out[1], out[2] = memory[0], memory[1], memory[2]
    if flags[F_DIFFERENTIAL]:
        _steer(out[0], out[1], params[P_DT], out)
    return True


@kernel
def choose_on_map(w, worlds, maps, orca, path, params, flags, rules, memory, actions):
    """Fill actions (R, 3) with the scripted policy's commands in world w; returns whether robot 0 goes on."""
    going = True
    for r in range(int(rules[R_ROBOTS])):
        goes = _choose(
            r, worlds.agents[w], worlds.walkers[w], worlds.scalars[w], worlds.place[w], worlds.own_field[w],
            worlds.rng[w], maps, orca, path, params, flags, rules, memory[r], actions[r],
        )  # fmt: skip
        going = going and (goes or r > 0)
    return going


@kernel
def begin_map_row(
    w, row, worlds, maps, rules, bodies, dirs, inv_work, owner_work, hits, scan32, params, flags, no_corners, no_start,
    out_scan, out_floats, out_ints, out_humans, out_labels, episodes, corners, sizes, humans, counts, places,
):  # fmt: skip
    """Observe world w from robot 0 and write this row's observation; on an episode's first row also who is where.

    places (E, 2): map and scenario of each episode, -1: no scenario.
    """
    agents, walkers, scalars, place = worlds.agents[w], worlds.walkers[w], worlds.scalars[w], worlds.place[w]
    robots = int(rules[R_ROBOTS])
    if scalars[S_STEP] == 0.0:
        places[counts[0], 0], places[counts[0], 1] = int(place[M_MAP]), int(place[M_SCENARIO])
        note_episode(row, agents, robots, scalars, no_corners, no_start, episodes, corners, sizes, humans, counts)
    scan_map_world(
        0, agents, walkers, scalars, place, maps, rules, bodies, dirs, inv_work, owner_work, hits, params, flags, scan32
    )  # fmt: skip
    if flags[F_SCAN_MM]:
        store_scan(scan32, params[P_RANGE_MAX], out_scan)
    else:
        for k in range(scan32.shape[0]):
            out_scan[k] = scan32[k]
    state_on_map(0, agents, walkers, out_floats[:5])
    for k in range(5, 9):
        out_floats[k] = 0.0
    out_floats[9], out_floats[10] = walkers[0, W_SHOWN_X], walkers[0, W_SHOWN_Y]
    out_floats[11], out_floats[12] = walkers[0, W_SHOWN_HEADING], agents[0, A_RADIUS]
    out_ints[0], out_ints[1], out_ints[2] = NONE, int(scalars[S_EPISODE]), int(scalars[S_STEP])
    out_ints[3] = CONTACT_NONE
    if flags[F_WANT_LABELS]:
        label_rays(owner_work, int(scalars[S_HUMANS]), out_labels)
    if flags[F_WANT_HUMANS]:
        observe_humans(0, agents, robots, int(scalars[S_HUMANS]), hits, out_humans)


@kernel
def finish_map_row(
    w, row, length, pending, gave_up, actions, worlds, maps, rules, flags, bodies, path, orca, moves, rewards, each,
    out_floats, out_ints,
):  # fmt: skip
    """Take the row's actions (R, 3), or end the episode; returns the event that ends it at the next row, -1: no world.

    `pending` is that event from the row before.
    """
    last = row == length - 1
    scalars = worlds.scalars[w]
    if pending != NONE:
        out_ints[0] = pending
    elif last:
        out_ints[0] = CUT
    elif gave_up:
        out_ints[0] = STUCK
        scalars[S_EVENT] = STUCK
    else:
        for r in range(actions.shape[0]):  # what is stored is what was executed
            vx, vy, omega = limit_command(
                actions[r, 0], 0.0 if flags[F_DIFFERENTIAL] else actions[r, 1], actions[r, 2], rules[R_MAX_VX],
                rules[R_MAX_VX + 1], rules[R_MAX_VX + 2],
            )  # fmt: skip
            actions[r, 0], actions[r, 1] = np.float64(np.float32(vx)), np.float64(np.float32(vy))
            actions[r, 2] = np.float64(np.float32(omega))
        step_map_world(
            worlds.agents[w], worlds.walkers[w], worlds.contacts[w], scalars, worlds.place[w], worlds.own_field[w],
            worlds.rng[w], maps, rules, bodies, path, orca, moves, actions, rewards, each,
        )  # fmt: skip
        out_floats[5], out_floats[6], out_floats[7] = actions[0, 0], actions[0, 1], actions[0, 2]
        out_floats[8] = rewards[0]
        agents = worlds.agents[w]
        out_ints[3] = contact_of(agents, int(rules[R_ROBOTS]), int(rules[R_ROBOTS]) + int(scalars[S_HUMANS]))
        return int(scalars[S_EVENT])
    if not last and not reset_map_world(
        worlds.agents[w], worlds.walkers[w], worlds.contacts[w], scalars, worlds.place[w], worlds.own_field[w],
        worlds.rng[w], maps, rules, flags, -1, np.nan,
    ):  # fmt: skip
        return -1
    return NONE


@kernel
def begin_map_rows(
    row, worlds, maps, rules, bodies, dirs, inv_work, owner_work, hits, scans, params, flags, no_corners, no_start,
    out_scan, out_floats, out_ints, out_humans, out_labels, episodes, corners, sizes, humans, counts, places,
):  # fmt: skip
    """Call :func:`begin_map_row` on every world of a batch."""
    robots = int(rules[R_ROBOTS])
    for w in range(worlds.agents.shape[0]):
        humans_row = row if flags[F_WANT_HUMANS] else 0
        labels_row = row if flags[F_WANT_LABELS] else 0
        begin_map_row(
            w, row, worlds, maps, rules, bodies, dirs, inv_work, owner_work, hits[w * robots], scans[w], params, flags,
            no_corners, no_start, out_scan[w, row], out_floats[w, row], out_ints[w, row], out_humans[w, humans_row],
            out_labels[w, labels_row], episodes[w], corners[w], sizes[w], humans[w], counts[w], places[w],
        )  # fmt: skip


@kernel
def finish_map_rows(
    row, length, pending, gave_up, actions, worlds, maps, rules, flags, bodies, path, orca, moves, rewards, each,
    out_floats, out_ints,
):  # fmt: skip
    """Call :func:`finish_map_row` on every world of a batch; returns False if one could not be made anew."""
    for w in range(worlds.agents.shape[0]):
        pending[w] = finish_map_row(
            w, row, length, pending[w], gave_up[w], actions[w], worlds, maps, rules, flags, bodies, path, orca, moves,
            rewards, each, out_floats[w, row], out_ints[w, row],
        )  # fmt: skip
        if pending[w] < 0:
            return False
    return True


@kernel
def choose_rows(row, length, pending, gave_up, worlds, maps, orca, path, params, flags, rules, memory, actions):
    """Fill actions (W, R, 3) with the scripted policy's commands where the episode goes on; notes who gives up."""
    for w in range(pending.shape[0]):
        gave_up[w] = False
        if pending[w] == NONE and row < length - 1:
            gave_up[w] = not choose_on_map(
                w, worlds, maps, orca, path, params, flags, rules, memory[w], actions[w]
            )  # fmt: skip
