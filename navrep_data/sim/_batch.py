# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Batches of worlds, stepped together for callers outside the generator: every array has a leading world axis."""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._layout import F_ROBOTS, S_EPISODE, S_HUMANS
from navrep_data.sim._rng import seed_mt, seed_philox
from navrep_data.sim._step import observe_humans, observe_scan, observe_state, reset_world, step_world


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
