# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""The dynamic window on a lidar scan, for batches of robots that move in any direction (Fox, Burgard, Thrun 1997).

A robot without inertia that does not turn follows a straight line at constant velocity, so that the forward simulation
of a velocity over the horizon is a segment, and its clearance the distance of the scan's points to that segment: exact,
without time steps.
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._geometry import point_segment_sq

# settings (SETTINGS,) float64
D_MAX_SPEED = 0  # limit of the velocity's norm [m/s]
D_ACCELERATION = 1  # of the window, and for stopping [m/s^2]
D_DT = 2  # the window's time step [s]
D_HORIZON = 3  # of the forward simulation [s]
D_MARGIN = 4  # kept beside the robot's radius [m]
D_CLEARANCE = 5  # more clearance is not better [m]
D_WEIGHT_PROGRESS = 6
D_WEIGHT_CLEARANCE = 7
D_WEIGHT_SPEED = 8
D_ANGLE_MIN = 9  # of the rays [rad]
D_ANGLE_INCREMENT = 10
D_RANGE_MAX = 11  # rays of this length hit nothing [m]
SETTINGS = 12

SAMPLES = 11
"""Velocities per axis of the window."""
GROUP = 6
"""Neighbouring rays of which the shortest counts."""


@kernel
def near_points(scan, reach, settings, points):
    """Write the scan's points nearer than `reach` [m], the nearest of every group of rays; returns how many."""
    count = 0
    for first in range(0, len(scan), GROUP):
        best = np.inf
        ray = first
        for i in range(first, min(first + GROUP, len(scan))):
            if 0.0 < scan[i] < best:
                best = np.float64(scan[i])
                ray = i
        if best < reach and best < settings[D_RANGE_MAX]:
            angle = settings[D_ANGLE_MIN] + ray * settings[D_ANGLE_INCREMENT]
            points[count, 0] = best * np.cos(angle)
            points[count, 1] = best * np.sin(angle)
            count += 1
    return count


@kernel
def clearance_along(vx, vy, horizon, radius, points, n_points):
    """Return (gap along the segment, time to contact) of driving at (vx, vy) past the points.

    Points that overlap the robot now do not count where it moves away from them: they would block every way out.
    """
    ex, ey = vx * horizon, vy * horizon
    nearest_sq = np.inf
    contact = np.inf
    speed_sq = vx * vx + vy * vy
    for k in range(n_points):
        px, py = points[k, 0], points[k, 1]
        along = px * vx + py * vy
        now_sq = px * px + py * py
        if now_sq < radius * radius and along <= 0.0:
            continue
        d_sq = point_segment_sq(px, py, 0.0, 0.0, ex, ey)
        nearest_sq = min(nearest_sq, d_sq)
        if d_sq < radius * radius and speed_sq > 0.0:
            # |p - v t| = radius
            root = along * along - speed_sq * (now_sq - radius * radius)
            if root >= 0.0:
                contact = min(contact, max(0.0, (along - np.sqrt(root)) / speed_sq))
    return np.sqrt(nearest_sq) - radius, contact


@kernel
def choose(scan, vx, vy, tx, ty, radius, settings, points, out):
    """Fill out (2,) with the best velocity of the window [m/s], robot frame.

    Sampled are a grid over the window, standing still and the way straight to the target. A velocity is admissible if
    there is no contact in this time step, and the robot can stop before there is one. Of the admissible ones that with
    the greatest weighted sum of progress to the target within the horizon, clearance and speed wins; if there is none,
    the robot stands.
    """
    top, dt, horizon = settings[D_MAX_SPEED], settings[D_DT], settings[D_HORIZON]
    reach = top * horizon + radius + settings[D_MARGIN] + settings[D_CLEARANCE]
    n_points = near_points(scan, reach, settings, points)
    change = settings[D_ACCELERATION] * dt
    distance = np.hypot(tx, ty)
    straight = min(top, distance / dt) / max(distance, 1e-9)
    best = -np.inf
    out[0], out[1] = 0.0, 0.0
    # the way straight to the target first: what follows has to beat it, most need no look at the points
    for sample in range(-2, SAMPLES * SAMPLES):
        if sample >= 0:
            ux = vx + change * (2.0 * (sample // SAMPLES) / (SAMPLES - 1) - 1.0)
            uy = vy + change * (2.0 * (sample % SAMPLES) / (SAMPLES - 1) - 1.0)
        elif sample == -2:
            ux, uy = tx * straight, ty * straight
        else:
            ux, uy = 0.0, 0.0
        if abs(ux - vx) > change + 1e-9 or abs(uy - vy) > change + 1e-9:
            continue
        speed = np.hypot(ux, uy)
        if speed > top + 1e-9:
            continue
        # beyond the target nothing is won: progress is that of the nearest point of the segment
        nearest = np.sqrt(point_segment_sq(tx, ty, 0.0, 0.0, ux * horizon, uy * horizon))
        score = settings[D_WEIGHT_PROGRESS] * (distance - nearest) / (top * horizon)
        score += settings[D_WEIGHT_SPEED] * speed / top
        if score + settings[D_WEIGHT_CLEARANCE] <= best:
            continue  # not even with all the clearance that counts
        gap, contact = clearance_along(ux, uy, horizon, radius + settings[D_MARGIN], points, n_points)
        if speed > 0.0 and (contact < dt or speed > settings[D_ACCELERATION] * contact):
            continue
        score += settings[D_WEIGHT_CLEARANCE] * min(max(gap, 0.0), settings[D_CLEARANCE]) / settings[D_CLEARANCE]
        if score > best:
            best = score
            out[0], out[1] = ux, uy
    return best


@kernel
def choose_all(scans, states, targets, radii, settings, points, out):
    """Fill out (W, 2) for scans (W, rays), robot states (W, 5), targets (W, 2) in the robot frame and radii (W,)."""
    for w in range(scans.shape[0]):
        choose(
            scans[w], np.float64(states[w, 2]), np.float64(states[w, 3]), targets[w, 0], targets[w, 1], radii[w],
            settings, points, out[w],
        )  # fmt: skip
