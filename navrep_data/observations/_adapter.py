"""Kernels of the scan adapter: what scanners returned, as line segments, seen again from the robot's centre.

Notes
-----
Plain numba functions on arrays; :mod:`navrep_data.observations.adapter` checks what goes in. Each scan is worked on by
itself, so results do not depend on the number of threads or the size of a batch.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from navrep_data.kernels import kernel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
B1 = NDArray[np.bool_]

INVALID, FREE, RETURN = 0, 1, 2
# What is known of a direction from the robot's centre: nobody looked there; a scanner looked, but something is in
# between; it is seen as far as the scan reaches.
BLIND, HIDDEN, SEEN = 0, 1, 2
TWO_PI = 2.0 * math.pi
# Neighbouring returns are one surface up to this change of range per distance between the rays: seen at more than
# about 11 degrees. Beyond, each keeps its own half of the gap between them, at its own range.
JOIN_SLOPE = 5.0
# Directions that differ by rounding only still meet the end of a segment, in parts of a ray's increment.
ROUNDING = 1e-6


@kernel
def classify(ranges: F64, range_min: float, range_max: float, invalid_is_free: bool, state: U8) -> None:
    """Tell returns from rays that hit nothing and rays that say nothing."""
    for i in range(ranges.shape[0]):
        r = ranges[i]
        if r >= range_min and r > 0.0 and r < range_max:
            state[i] = RETURN
        elif r >= range_max or invalid_is_free:
            state[i] = FREE
        else:
            state[i] = INVALID


@kernel
def see_segment(
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    angle_min: float,
    increment: float,
    slack: float,
    directions: F64,
    out: F64,
) -> None:
    """Lower `out` where target rays, from the origin, meet the segment; `slack` widens it by parts of a ray."""
    start = math.atan2(y0, x0)
    span = math.atan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1)
    if span < 0.0:
        x0, y0, x1, y1 = x1, y1, x0, y0
        start, span = math.atan2(y0, x0), -span
    near, far = math.sqrt(x0 * x0 + y0 * y0), math.sqrt(x1 * x1 + y1 * y1)
    area = x0 * y1 - y0 * x1
    period = TWO_PI / increment
    u0 = (start - angle_min) / increment
    # the first window that can hold rays; one segment may straddle the end of the scan and its beginning
    u0 -= period * math.floor((u0 + span / increment + slack) / period)
    for _turn in range(2):
        first = max(0, math.ceil(u0 - slack))
        last = min(out.shape[0] - 1, math.floor(u0 + span / increment + slack))
        for k in range(first, last + 1):
            if k <= u0:
                rho = near
            elif k >= u0 + span / increment:
                rho = far
            else:
                rho = area / (directions[0, k] * (y1 - y0) - directions[1, k] * (x1 - x0))
                # a segment that points at the robot has no one distance; rounding must not carry past its ends
                rho = min(rho, max(near, far)) if rho > 0.0 else min(near, far)
            if rho < out[k]:
                out[k] = rho
        u0 += period


@kernel
def see_scan(
    ranges: F64, state: U8, rays: F64, half_step: float, x: float, y: float, closed: bool, angle_min: float,
    increment: float, slack: float, directions: F64, out: F64,
) -> None:  # fmt: skip
    """See all returns of one scan; `rays` are cosines and sines of its rays, and of half an increment past each."""
    n = ranges.shape[0]
    step = 2.0 * half_step
    for i in range(n):
        if state[i] != RETURN:
            continue
        r = ranges[i]
        px, py = x + r * rays[0, i], y + r * rays[1, i]
        after, before = i + 1, i - 1
        if closed:
            after, before = after % n, before % n
        joined = False
        if after < n and after != i and state[after] == RETURN:
            q = ranges[after]
            joined = abs(q - r) <= JOIN_SLOPE * step * min(q, r)
        if joined:
            q = ranges[after]
            qx, qy = x + q * rays[0, after], y + q * rays[1, after]
        else:
            qx, qy = x + r * rays[2, i], y + r * rays[3, i]
        see_segment(px, py, qx, qy, angle_min, increment, slack, directions, out)
        joined = False
        if before >= 0 and before != i and state[before] == RETURN:
            joined = abs(ranges[before] - r) <= JOIN_SLOPE * step * min(ranges[before], r)
        if not joined:
            # half an increment before ray i: its own direction mirrored
            c, s = rays[0, i], rays[1, i]
            dc, ds = rays[2, i] * c + rays[3, i] * s, rays[3, i] * c - rays[2, i] * s
            qx, qy = x + r * (c * dc + s * ds), y + r * (s * dc - c * ds)
            see_segment(px, py, qx, qy, angle_min, increment, slack, directions, out)


@kernel
def add_scans(
    scans: F64, range_min: float, range_max: float, invalid_is_free: bool, rays: F64, half_step: float, x: float,
    y: float, closed: bool, beam_of: I64, reach: F64, angle_min: float, increment: float, slack: float,
    directions: F64, nearest: F64, known: U8,
) -> None:  # fmt: skip
    """See a batch of scans of one scanner: lower `nearest` to their returns, raise `known` to what its rays tell.

    A ray of the model is seen to its end, `reach` from the scanner, only if the beam that looks there gets so far. If
    it returns from something nearer, the model's ray may have passed beside that: through the parallax between two
    returns, or into the shadow behind one.
    """
    state = np.empty(scans.shape[1], np.uint8)
    for b in range(scans.shape[0]):
        classify(scans[b], range_min, range_max, invalid_is_free, state)
        see_scan(
            scans[b], state, rays, half_step, x, y, closed, angle_min, increment, slack, directions, nearest[b],
        )  # fmt: skip
        for k in range(beam_of.shape[0]):
            if beam_of[k] < 0 or state[beam_of[k]] == INVALID:
                continue
            if state[beam_of[k]] == FREE or scans[b, beam_of[k]] >= reach[k]:
                known[b, k] = SEEN
            elif known[b, k] == BLIND:
                known[b, k] = HIDDEN


@kernel
def fill_gaps(ranges: F64, gap: B1, seen: B1, widest: int, closed: bool, farthest: float) -> None:
    """Give each run of rays in `gap` the smaller of the ranges beside it, as far as those are `seen`.

    Runs of more than `widest` rays get at most `farthest`, as do runs with nothing seen beside them. The last ray is
    the first one's neighbour if `closed`.
    """
    n = ranges.shape[0]
    start = 0
    if closed:
        while start < n and gap[start]:
            start += 1
        start %= n  # a whole turn of gap has no beginning
    k = 0
    while k < n:
        if not gap[(start + k) % n]:
            k += 1
            continue
        stop = k
        while stop < n and gap[(start + stop) % n]:
            stop += 1
        near = np.inf
        before, after = start + k - 1, start + stop
        if (closed or before >= 0) and seen[before % n]:
            near = ranges[before % n]
        if (closed or after < n) and seen[after % n]:
            near = min(near, ranges[after % n])
        if stop - k > widest or near == np.inf:
            near = min(near, farthest)
        for j in range(k, stop):
            ranges[(start + j) % n] = near
        k = stop
