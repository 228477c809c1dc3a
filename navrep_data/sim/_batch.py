# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Batches of worlds, stepped together for callers outside the generator: every array has a leading world axis."""

import numpy as np

from navrep_data._kernels import kernel
from navrep_data.sim._layout import S_EPISODE
from navrep_data.sim._rng import seed_mt, seed_philox
from navrep_data.sim._step import observe_scan, observe_state, reset_world, step_world


@kernel
def seed_worlds(rng, scalars, seed, first_sequence):
    """Give world w the stream of sequence first_sequence + w and forget all episodes."""
    for w in range(rng.shape[0]):
        seed_philox(rng[w], seed, first_sequence + w)
        scalars[w, :] = 0.0
        scalars[w, S_EPISODE] = -1.0


@kernel
def seed_streams(rng, scalars, seeds, mask):
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
    """Advance all worlds by one step under actions (W, 3)."""
    result = np.zeros(2)
    for w in range(agents.shape[0]):
        step_world(
            agents[w], agents32, scalars[w], edges[w], polygon_start[w], boxes[w], obst_f[w], obst_i[w], params, flags,
            orca_params, work_f, work_i, moves, actions[w, 0], actions[w, 1], actions[w, 2], result,
        )  # fmt: skip
        rewards[w] = result[0]
        events[w] = np.uint8(result[1])


@kernel
def observe_worlds(
    mask, agents, scalars, edges, polygon_start, circles, dirs, inv_work, owner_work, hits, params, flags, scans, states
):  # fmt: skip
    """Fill scans (W, rays) [m] and robot states (W, 5) of the worlds of `mask`; the others' rows stay."""
    for w in range(agents.shape[0]):
        if not mask[w]:
            continue
        observe_scan(
            agents[w], scalars[w], edges[w], polygon_start[w], circles, dirs, inv_work, owner_work, hits[w],
            params, flags, scans[w],
        )  # fmt: skip
        observe_state(agents[w], scalars[w], states[w])
