# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Batches of worlds on maps: every array has a leading world axis."""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._batch import gap_to_others
from navrep_data.sim._ian_contact import CLEARANCE_REACH, swept_cells
from navrep_data.sim._ian_layout import M_MAP, M_SEEDED, R_ROBOTS
from navrep_data.sim._ian_orca import guided_velocity, pack_agents, way_point
from navrep_data.sim._ian_reset import reset_map_world
from navrep_data.sim._ian_scan import scan_map_world, state_on_map
from navrep_data.sim._ian_step import step_map_world
from navrep_data.sim._layout import A_CLEAR_HUMAN, A_CLEAR_STATIC, A_RADIUS, A_X, A_Y, S_EVENT, S_HUMANS, S_STEP


@kernel
def reset_map_worlds(mask, worlds, maps, rules, flags, streams, seeded, chosen, headings):
    """Start episodes in the worlds of `mask` from `streams`; returns the first world that could not, or -1.

    seeded: whether the streams are numpy's legacy ones, which then last for the episode. chosen (W,): scenario, -1:
    drawn. headings (W,): the robot's start heading in a scenario, NaN: drawn.
    """
    for w in range(mask.shape[0]):
        if not mask[w]:
            continue
        if not reset_map_world(
            worlds.agents[w], worlds.walkers[w], worlds.contacts[w], worlds.scalars[w], worlds.place[w],
            worlds.own_field[w], streams[w], maps, rules, flags, chosen[w], headings[w],
        ):  # fmt: skip
            return w
        if seeded:
            worlds.place[w, M_SEEDED] = 1.0
            worlds.seeded[w, :] = streams[w]
    return -1


@kernel
def step_map_worlds(actions, worlds, maps, rules, bodies, path, orca, moves, rewards, events):
    """Advance all worlds by one step under actions (W, R, 3); fills rewards (W, R) and events (W,)."""
    each = np.zeros(int(rules[R_ROBOTS]))
    for w in range(actions.shape[0]):
        rng = worlds.seeded[w] if worlds.place[w, M_SEEDED] else worlds.rng[w]
        step_map_world(
            worlds.agents[w], worlds.walkers[w], worlds.contacts[w], worlds.scalars[w], worlds.place[w],
            worlds.own_field[w], rng, maps, rules, bodies, path, orca, moves, actions[w], rewards[w], each,
        )  # fmt: skip
        events[w] = np.uint8(worlds.scalars[w, S_EVENT])


@kernel
def observe_map_worlds(
    mask, worlds, maps, rules, bodies, dirs, inv_work, owner_work, hits, params, flags, scans, states
):
    """Fill scans (W R, rays) [m] and robot states (W R, 5), robot by robot, of the worlds of `mask` (W,)."""
    robots = int(rules[R_ROBOTS])
    for w in range(worlds.agents.shape[0]):
        if not mask[w]:
            continue
        for r in range(robots):
            k = w * robots + r
            scan_map_world(
                r, worlds.agents[w], worlds.walkers[w], worlds.scalars[w], worlds.place[w], maps, rules, bodies, dirs,
                inv_work, owner_work, hits[k], params, flags, scans[k],
            )  # fmt: skip
            state_on_map(r, worlds.agents[w], worlds.walkers[w], states[k])


@kernel
def observe_map_states(mask, worlds, rules, states):
    """Fill robot states (W R, 5), robot by robot, of the worlds of `mask` (W,)."""
    robots = int(rules[R_ROBOTS])
    for w in range(worlds.agents.shape[0]):
        if mask[w]:
            for r in range(robots):
                state_on_map(r, worlds.agents[w], worlds.walkers[w], states[w * robots + r])


@kernel
def ways_ahead(worlds, maps, path, out):
    """Fill out (W, 2) with the point about a metre ahead of each world's first robot on its way to the goal [m]."""
    for w in range(out.shape[0]):
        map_row = maps.table[int(worlds.place[w, M_MAP])]
        x, y = way_point(
            worlds.agents[w], worlds.walkers[w], 0, maps, worlds.own_field[w], map_row, worlds.rng[w], path
        )
        out[w, 0], out[w, 1] = x, y


@kernel
def measure_map_gaps(worlds, maps, rules, to_agent, to_static):
    """Fill to_agent (W,) and to_static (W,) with the smallest gaps around the first robots during the last step [m].

    Before the first step they are those of the start. To static matter they are exact up to a metre, beyond that lower
    bounds.
    """
    for w in range(to_agent.shape[0]):
        agents = worlds.agents[w]
        if worlds.scalars[w, S_STEP] > 0:
            to_agent[w], to_static[w] = agents[0, A_CLEAR_HUMAN], agents[0, A_CLEAR_STATIC]
            continue
        to_agent[w] = gap_to_others(agents, int(rules[R_ROBOTS]) + int(worlds.scalars[w, S_HUMANS]))
        x, y, radius = agents[0, A_X], agents[0, A_Y], agents[0, A_RADIUS]
        map_row = maps.table[int(worlds.place[w, M_MAP])]
        to_static[w] = swept_cells(maps, map_row, x, y, x, y, radius + CLEARANCE_REACH) - radius


@kernel
def choose_guided_robots(worlds, maps, rules, orca, path, out):
    """Fill out (W, 2) with the velocity that ORCA chooses for the first robots along their planned way [m/s]."""
    for w in range(out.shape[0]):
        n = int(rules[R_ROBOTS]) + int(worlds.scalars[w, S_HUMANS])
        pack_agents(worlds.agents[w], n, orca)
        map_row = maps.table[int(worlds.place[w, M_MAP])]
        out[w, 0], out[w, 1] = guided_velocity(
            worlds.agents[w], worlds.walkers[w], 0, 1, n, -1, worlds.place[w], worlds.own_field[w], maps, map_row, orca,
            worlds.rng[w], path,
        )  # fmt: skip
