"""Scans in other units, and the robot state beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data import schema
from navrep_data.errors import ArrayError, ConfigError
from navrep_data.observations import _rings


def _check_range_max(range_max: float) -> None:
    if not (np.isfinite(range_max) and range_max > 0.0):
        raise ConfigError(
            f"range_max is {range_max}, expected a positive number of metres: take it from the sensor contract."
        )


def scan_to_1d(scan: ArrayLike, range_max: float = schema.RANGE_MAX, clip: bool = False) -> NDArray[np.float32]:
    """Scale scans for models that read them as a line of numbers.

    Parameters
    ----------
    scan : ndarray of shape (..., n_rays) [m]
        Ranges.
    range_max : float
        Range that becomes 1 [m].
    clip : bool
        Clip the result to [0, 1].

    Returns
    -------
    ndarray of shape (..., n_rays), float32
        ``scan / range_max``.

    Raises
    ------
    ArrayError
        If `scan` is not floating; stored millimetres go through :func:`metres_from_millimetres` first.
    ConfigError
        If `range_max` is not positive.

    Notes
    -----
    Original: ``navrep/tools/wdataset.py`` divides by 25 and does not clip; its VAE1D trainer clips. Rays that nobody
    saw (0) stay 0, which a model would take for something that touches the robot: :func:`fill_blind` comes first.
    """
    _check_range_max(range_max)
    array = np.asarray(scan)
    if not np.issubdtype(array.dtype, np.floating):
        raise ArrayError(
            f"scan has dtype {array.dtype}, expected floating metres: use metres_from_millimetres for a stored scan."
        )
    scaled = array.astype(np.float32) / np.float32(range_max)
    return np.clip(scaled, np.float32(0), np.float32(1)) if clip else scaled


def millimetres_from_metres(scan: ArrayLike, range_max: float = schema.RANGE_MAX) -> NDArray[np.uint16]:
    """Round scans to the millimetres that a shard stores.

    Parameters
    ----------
    scan : ndarray of shape (..., n_rays) [m]
        Ranges; taken as float32.
    range_max : float
        Range of a ray that hits nothing [m]; larger values, +inf included, become this.

    Returns
    -------
    ndarray of shape (..., n_rays), uint16
        Nearest millimetre, half to even, at least 1; 0 = invalid (NaN, 0 or negative).

    Raises
    ------
    ArrayError
        If `scan` is not floating.
    ConfigError
        If `range_max` is not positive or above 65 m, where uint16 ends: keep float32 there.
    """
    _check_range_max(range_max)
    if range_max > schema.UINT16_RANGE_LIMIT:
        raise ConfigError(
            f"range_max is {range_max} m, expected at most {schema.UINT16_RANGE_LIMIT} m for uint16 "
            "millimetres: store "
            "float32 (--scan-dtype float32)."
        )
    array = np.asarray(scan)
    if not np.issubdtype(array.dtype, np.floating):
        raise ArrayError(f"scan has dtype {array.dtype}, expected floating metres: it may be in millimetres already.")
    flat = np.ascontiguousarray(array, dtype=np.float32).reshape(-1)
    out = np.empty(flat.shape, np.uint16)
    _rings.millimetres_row(flat, float(range_max), out)
    return out.reshape(array.shape)


def metres_from_millimetres(scan: ArrayLike) -> NDArray[np.float32]:
    """Turn stored millimetres into metres.

    Parameters
    ----------
    scan : ndarray of shape (..., n_rays), uint16 [mm]
        Stored ranges.

    Returns
    -------
    ndarray of shape (..., n_rays), float32
        ``float32(k) / float32(1000)`` [m]; invalid rays stay 0.

    Raises
    ------
    ArrayError
        If `scan` is not uint16.
    """
    array = np.asarray(scan)
    if array.dtype != np.uint16:
        raise ArrayError(f"scan has dtype {array.dtype}, expected uint16 millimetres: floating scans are in metres.")
    return array.astype(np.float32) / np.float32(1000)


def _pairs(name: str, value: ArrayLike, size: int) -> NDArray[np.float64]:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != size:
        raise ArrayError(
            f"{name} has shape {array.shape}, expected (..., {size}): put the components on the last axis."
        )
    return array


def robot_state(
    goal_xy: ArrayLike, robot_pose: ArrayLike, velocity_world: ArrayLike, omega: ArrayLike
) -> NDArray[np.float32]:
    """Express goal and velocity along the robot's axes.

    Parameters
    ----------
    goal_xy : ndarray of shape (..., 2) [m]
        Goal, world frame.
    robot_pose : ndarray of shape (..., 3) [m, m, rad]
        x, y, theta, world frame.
    velocity_world : ndarray of shape (..., 2) [m/s]
        Velocity of the last step, world frame.
    omega : ndarray of shape (...) [rad/s]
        Turn rate; the training environment always reports 0.

    Returns
    -------
    ndarray of shape (..., 5), float32
        goal x, goal y, vx, vy, omega, robot frame (x forward, y left). Leading dimensions broadcast.

    Raises
    ------
    ArrayError
        If a last axis has the wrong length.

    Notes
    -----
    s_r of the paper; original: ``navreptrainenv.py``, which rotates the last velocity by the *new* heading.
    """
    pose = _pairs("robot_pose", robot_pose, 3)
    goal = _pairs("goal_xy", goal_xy, 2) - pose[..., :2]
    velocity = _pairs("velocity_world", velocity_world, 2)
    cosine, sine = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    fields = np.broadcast_arrays(
        cosine * goal[..., 0] + sine * goal[..., 1],
        cosine * goal[..., 1] - sine * goal[..., 0],
        cosine * velocity[..., 0] + sine * velocity[..., 1],
        cosine * velocity[..., 1] - sine * velocity[..., 0],
        np.asarray(omega, dtype=np.float64),
    )
    return np.stack(fields, axis=-1).astype(np.float32)
