# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Where the legs of a walking human are: the only place that says it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from navrep_data.kernels import kernel

F64 = NDArray[np.float64]

LEG_RADIUS = 0.03
"""Radius of a leg [m] (pymap2d's default)."""
LEGS_PER_HUMAN = 2
# Gait of the original (CMap2D.pyx): stride amplitude per m/s, its bounds, and the sideways amplitude [m].
STRIDE_PER_SPEED, STRIDE_MIN, STRIDE_MAX, SIDE_AMPLITUDE = 0.6, 0.01, 0.3, 0.1


@kernel
def leg_offset(heading, speed, gait_x, gait_y, gait_theta):
    """Return x, y of the first leg seen from the human's centre [m], world frame; the second leg is opposite.

    heading [rad], world frame; speed [m/s]; gait_x, gait_y, gait_theta: way walked in the human's own frame and angle
    turned since the episode began [m, m, rad].
    """
    stride = min(max(STRIDE_PER_SPEED * speed, STRIDE_MIN), STRIDE_MAX)
    forward = stride * math.cos(2.0 * gait_x / stride + gait_theta)
    side = SIDE_AMPLITUDE + SIDE_AMPLITUDE * math.cos(2.0 * gait_y / SIDE_AMPLITUDE + gait_theta)
    c, s = math.cos(heading), math.sin(heading)
    return c * forward - s * side, s * forward + c * side


@kernel
def _fill_offsets(heading, speed, gait, out):
    for i in range(out.shape[0]):
        out[i, 0], out[i, 1] = leg_offset(heading[i], speed[i], gait[i, 0], gait[i, 1], gait[i, 2])


def leg_offsets(heading: F64, speed: F64, gait: F64) -> F64:
    """Return where first legs are, seen from the centres of their humans; second legs are opposite.

    Parameters
    ----------
    heading, speed : ndarray of shape (...)
        Which way humans face [rad], world frame, and how fast they walk [m/s].
    gait : ndarray of shape (..., 3)
        Way walked ahead, sideways, and turned since the episode began [m, m, rad].

    Returns
    -------
    ndarray of shape (..., 2), float64
        [m], world frame.
    """
    out = np.zeros((*np.shape(heading), 2))
    flat = (np.ascontiguousarray(values, np.float64) for values in (heading, speed, gait))
    facing, pace, walked = flat
    _fill_offsets(facing.reshape(-1), pace.reshape(-1), walked.reshape(-1, 3), out.reshape(-1, 2))
    return out
