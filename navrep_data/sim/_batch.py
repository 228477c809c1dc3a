# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Batches of worlds, stepped together for callers outside the generator: every array has a leading world axis."""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._geometry import swept_clearance
from navrep_data.sim._layout import A_RADIUS, A_X, A_Y, F_ROBOTS, S_EPISODE, S_HUMANS, S_OBST_ROBOT, S_POLYGONS
from navrep_data.sim._rng import seed_mt, seed_philox
from navrep_data.sim._step import (
    observe_humans,
    observe_scan,
    observe_state,
    orca_choice,
    pack_orca,
    reset_world,
    step_world,
)


@kernel
def seed_worlds(rng, scalars, seed, sequences):
    """Give world w the stream of sequence sequences[w] and forget all episodes."""
    for w in range(rng.shape[0]):
        seed_philox(rng[w], seed, sequences[w])
        scalars[w, :] = 0.0
        scalars[w, S_EPISODE] = -1.0


@kernel
def reseed_worlds(rng, scalars, seeds, mask):
    """Give the worlds of `mask` the streams (seeds[w], 0) and forget their episodes."""
    for w in range(rng.shape[0]):
        if mask[w]:
            seed_philox(rng[w], seeds[w], 0)
            scalars[w, :] = 0.0
            scalars[w, S_EPISODE] = -1.0


@kernel
def seed_legacy(rng, seeds, mask):
    """Give the worlds of `mask` the streams of ``numpy.random.RandomState(seeds[w])``."""
    for w in range(rng.shape[0]):
        if mask[w]:
            seed_mt(rng[w], seeds[w])


@kernel
def reset_worlds(
    mask, agents, agents32, scalars, vertices, polygon_start, edges, obst_f, obst_i, boxes, rng, params, flags,
    orca_params, work_f, work_i, moves,
):  # fmt: skip
    """Start the next episode in the worlds of `mask`; returns False if one could not be made."""
    for w in range(agents.shape[0]):
        if mask[w] and not reset_world(
            agents[w], agents32, scalars[w], vertices[w], polygon_start[w], edges[w], obst_f[w], obst_i[w], boxes[w],
            rng[w], params, flags, orca_params, work_f, work_i, moves,
        ):  # fmt: skip
            return False
    return True


@kernel
def step_worlds(
    actions, agents, agents32, scalars, edges, polygon_start, boxes, obst_f, obst_i, params, flags, orca_params,
    work_f, work_i, moves, rewards, events,
):  # fmt: skip
    """Advance all worlds by one step under actions (W, 3 R); fills rewards (W, R) and events (W,)."""
    robots = flags[F_ROBOTS]
    result = np.zeros(robots + 1)
    for w in range(agents.shape[0]):
        step_world(
            agents[w], agents32, scalars[w], edges[w], polygon_start[w], boxes[w], obst_f[w], obst_i[w], params, flags,
            orca_params, work_f, work_i, moves, actions[w], result,
        )  # fmt: skip
        for r in range(robots):
            rewards[w, r] = result[r]
        events[w] = np.uint8(result[robots])


@kernel
def observe_worlds(
    mask, agents, scalars, edges, polygon_start, circles, dirs, inv_work, owner_work, hits, params, flags, scans, states
):  # fmt: skip
    """Fill scans (W R, rays) [m] and robot states (W R, 5), robot by robot, of the worlds of `mask` (W,)."""
    robots = flags[F_ROBOTS]
    for w in range(agents.shape[0]):
        if not mask[w]:
            continue
        for r in range(robots):
            k = w * robots + r
            observe_scan(
                r, agents[w], scalars[w], edges[w], polygon_start[w], circles, dirs, inv_work, owner_work, hits[k],
                params, flags, scans[k],
            )  # fmt: skip
            observe_state(r, agents[w], flags, states[k])


@kernel
def observe_states(mask, agents, flags, states):
    """Fill robot states (W R, 5), robot by robot, of the worlds of `mask` (W,)."""
    robots = flags[F_ROBOTS]
    for w in range(agents.shape[0]):
        if mask[w]:
            for r in range(robots):
                observe_state(r, agents[w], flags, states[w * robots + r])


@kernel
def observe_others(agents, scalars, hits, flags, out):
    """Fill out (W R, slots, 6) with what each robot's humans column holds."""
    robots = flags[F_ROBOTS]
    for w in range(agents.shape[0]):
        for r in range(robots):
            k = w * robots + r
            observe_humans(r, agents[w], robots, int(scalars[w, S_HUMANS]), hits[k], out[k])


@kernel
def gap_to_others(agents, n_agents):
    """Return the gap between the first robot's disc and the nearest of rows 1 to n_agents - 1 [m], infinity if none."""
    best = np.inf
    for i in range(1, n_agents):
        distance = np.hypot(agents[i, A_X] - agents[0, A_X], agents[i, A_Y] - agents[0, A_Y])
        best = min(best, distance - agents[i, A_RADIUS] - agents[0, A_RADIUS])
    return best


@kernel
def measure_gaps(agents, scalars, edges, polygon_start, flags, to_agent, to_static):
    """Fill to_agent (W,) and to_static (W,) with the gaps around the first robots [m]."""
    for w in range(agents.shape[0]):
        to_agent[w] = gap_to_others(agents[w], flags[F_ROBOTS] + int(scalars[w, S_HUMANS]))
        x, y = agents[w, 0, A_X], agents[w, 0, A_Y]
        n = int(scalars[w, S_POLYGONS])
        to_static[w] = swept_clearance(x, y, x, y, edges[w], polygon_start[w], n) - agents[w, 0, A_RADIUS]


@kernel
def choose_orca_robots(agents, agents32, scalars, obst_f, obst_i, flags, orca_params, work_f, work_i, out):
    """Fill out (W, 2) with the velocity that ORCA chooses for the first robots [m/s]; they see all others."""
    robots = flags[F_ROBOTS]
    for w in range(agents.shape[0]):
        n = int(scalars[w, S_HUMANS])
        pack_orca(agents[w], robots + n, agents32)
        vx, vy = orca_choice(
            0, agents[w], agents32, robots, n, obst_f[w, -1], obst_i[w, -1], int(scalars[w, S_OBST_ROBOT]),
            orca_params, work_f, work_i,
        )  # fmt: skip
        out[w, 0] = vx
        out[w, 1] = vy
