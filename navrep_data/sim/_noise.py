# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Noise and dropout of scans: functions of the episode, the step, the robot and the ray alone.

Counter-based, with a key of their own per episode. So noise takes no numbers from the stream that worlds are drawn
from, looking twice at the same moment gives the same scan, and a batch gives what a single world gives.
"""

import math

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._layout import P_RANGE_MAX, P_SCAN_DROPOUT, P_SCAN_NOISE, S_NOISE_HIGH, S_NOISE_LOW, S_STEP
from navrep_data.sim._rng import is_mersenne, philox, stream_key

_MASK32 = np.uint64(0xFFFFFFFF)
_S32 = np.uint64(32)
_INV32 = 1.0 / 4294967296.0
# The last word of a counter; the streams that worlds are drawn from have 0 there.
_TAG_KEY, _TAG_NOISE, _TAG_DROPOUT = np.uint64(1), np.uint64(2), np.uint64(3)
_RAYS_PER_BLOCK = 8
# Noise never makes a range invalid: it stays at least this [m].
LEAST_RANGE = 0.001


@kernel
def noise_key(rng, episode):
    """Return the upper and lower 32 bits of an episode's noise key, as floats, without drawing from its stream.

    A legacy stream is one numbered episode: its seed alone decides.
    """
    k0, k1 = stream_key(rng)
    number = np.uint64(0) if is_mersenne(rng) else np.uint64(episode)
    kind = np.uint64(1) if is_mersenne(rng) else np.uint64(0)
    word = philox(k0, k1, number, kind, np.uint64(0), _TAG_KEY)[0]
    return np.float64(word >> _S32), np.float64(word & _MASK32)


@kernel
def disturb(scalars, robot, params, scan):
    """Add noise to the ranges of a scan (n_rays,) float32 [m] that hit something, then let rays drop out."""
    key = (np.uint64(scalars[S_NOISE_HIGH]) << _S32) | np.uint64(scalars[S_NOISE_LOW])
    step, who = np.uint64(scalars[S_STEP]), np.uint64(robot)
    sigma, dropout = params[P_SCAN_NOISE], params[P_SCAN_DROPOUT]
    far = np.float32(params[P_RANGE_MAX])
    n = scan.shape[0]
    for block in range((n + _RAYS_PER_BLOCK - 1) // _RAYS_PER_BLOCK):
        first = block * _RAYS_PER_BLOCK
        if sigma > 0.0:
            words = philox(key, np.uint64(0), np.uint64(block), step, who, _TAG_NOISE)
            for k in range(min(_RAYS_PER_BLOCK, n - first)):
                if scan[first + k] < far:
                    word = words[k // 2]
                    # Box and Muller: one word makes two normal numbers
                    size = math.sqrt(-2.0 * math.log((np.float64(word >> _S32) + 1.0) * _INV32))
                    angle = 2.0 * math.pi * np.float64(word & _MASK32) * _INV32
                    normal = size * (math.cos(angle) if k % 2 == 0 else math.sin(angle))
                    value = np.float64(scan[first + k]) + sigma * normal
                    scan[first + k] = np.float32(min(max(value, LEAST_RANGE), params[P_RANGE_MAX]))
        if dropout > 0.0:
            words = philox(key, np.uint64(0), np.uint64(block), step, who, _TAG_DROPOUT)
            for k in range(min(_RAYS_PER_BLOCK, n - first)):
                word = words[k // 2]
                half = (word >> _S32) if k % 2 == 0 else (word & _MASK32)
                if np.float64(half) * _INV32 < dropout:
                    scan[first + k] = np.float32(0.0)
