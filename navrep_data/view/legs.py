"""Where humans' legs were, from the humans column and the gait that worlds files keep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from navrep_data.sim import gait as gaits

F64 = NDArray[np.float64]
TWO_PI = 2.0 * np.pi


def to_world(humans: F64, pose: F64) -> F64:
    """Return the humans column in the world frame.

    Parameters
    ----------
    humans : ndarray of shape (n, H, 6)
        The column: position and velocity along the robot's axes, radius, visible.
    pose : ndarray of shape (n, 3)
        Robot x, y [m], theta [rad], world frame.

    Returns
    -------
    ndarray of shape (n, H, 6), float64
        x, y [m], vx, vy [m/s], world frame, radius [m], visible.
    """
    result = np.array(humans, np.float64)
    c, s = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
    for k in (0, 2):
        a, b = humans[..., k], humans[..., k + 1]
        result[..., k], result[..., k + 1] = c * a - s * b, s * a + c * b
    result[..., 0] += pose[:, None, 0]
    result[..., 1] += pose[:, None, 1]
    return result


def headings(velocity: F64, start: F64, original: bool) -> F64:
    """Return which way humans face in each row of an episode.

    Parameters
    ----------
    velocity : ndarray of shape (T, H, 2)
        The velocity that led to each row [m/s], world frame.
    start : ndarray of shape (H,)
        Headings at the first row [rad].
    original : bool
        Whether a human that stands has heading 0 (`original` physics) instead of the one it had.

    Returns
    -------
    ndarray of shape (T, H)
        [rad], 0 to 2 pi.
    """
    moving = (velocity != 0.0).any(axis=2)
    moving[0] = True
    facing = np.arctan2(velocity[..., 1], velocity[..., 0]) % TWO_PI
    facing[0] = start
    if original:
        facing[1:][~moving[1:]] = 0.0
        return facing
    last = np.maximum.accumulate(np.where(moving, np.arange(len(velocity))[:, None], 0), axis=0)
    return np.take_along_axis(facing, last, axis=0)


def leg_offsets(velocity: F64, start: F64, gait: F64, dt: float, original: bool = False) -> F64:
    """Return where the first leg of each human is, seen from the human's centre; the second is opposite.

    Parameters
    ----------
    velocity : ndarray of shape (T, H, 2)
        Velocities in the rows of one episode [m/s], world frame.
    start : ndarray of shape (H,)
        Headings at the first row [rad].
    gait : ndarray of shape (H, 3)
        Gait distances at the first row [m, m, rad].
    dt : float
        Time between rows [s].
    original : bool
        Whether the episode is of `original` physics.

    Returns
    -------
    ndarray of shape (T, H, 2)
        [m], world frame.

    Notes
    -----
    Gaits are summed up over whole episodes, as the simulator does it (``_step.move_humans``). The column's velocities
    are rounded to 1/1024 m/s, so a human that creeps after a long way may have its legs a few centimetres off.
    """
    heading = headings(velocity, start, original)
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    walked = speed * dt
    walked[0] = 0.0
    walks = np.empty((*speed.shape, 3))
    walks[..., 0] = gait[:, 0] + np.cumsum(walked, axis=0)
    walks[..., 1] = gait[:, 1]
    walks[..., 2] = gait[:, 2] + heading - heading[0]
    return gaits.leg_offsets(heading, speed, walks)
