"""From a policy's action in [-1, 1] to the command that the simulator executes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ConfigError
from navrep_data.schema import ACTION_SIZE, TRAINING_RADIUS, RobotContract
from navrep_data.sim._rollout import STEER_LIMIT
from navrep_data.sim.config import SimConfig
from navrep_data.sim.map_tables import RADIUS


def robot_contract(config: SimConfig) -> RobotContract:
    """Return what the robot of an environment is: the speed of a full action, and the radius.

    Parameters
    ----------
    config : SimConfig
        Its `max_velocity` along x counts. On maps the radius is always 0.3 m; elsewhere it is drawn from 0.3 to 0.5 m
        for every episode, and the smallest stands for them.
    """
    return RobotContract(config.max_velocity[0], RADIUS if config.world == "map" else TRAINING_RADIUS)


def scale_actions(config: SimConfig, actions: ArrayLike) -> NDArray[np.float64]:
    """Return the body velocity commands of actions in [-1, 1].

    Parameters
    ----------
    config : SimConfig
        Its `max_velocity` is what a full action means; its `world` decides on the norm.
    actions : array_like of shape (..., 3) or (..., 2)
        Shares of the largest vx, vy and rotation; two numbers mean no rotation. Values beyond 1 count as 1.

    Returns
    -------
    ndarray of shape (..., 3), float64
        vx, vy [m/s], omega [rad/s], robot frame.

    Raises
    ------
    ConfigError
        If the shape is wrong or a value is not finite.

    Notes
    -----
    In map worlds a translation longer than 1 is shortened to 1 before scaling (pepper_2d_simulator.py, SIM_FACTS d.3);
    in the training environment it is not, so its diagonal is sqrt(2) m/s.
    """
    values = np.asarray(actions, np.float64)
    if values.ndim == 0 or values.shape[-1] not in (2, ACTION_SIZE):
        raise ConfigError(f"actions have shape {values.shape}, expected (..., 3) or (..., 2).")
    if not np.isfinite(values).all():
        raise ConfigError("actions hold NaN or infinity, expected numbers from -1 to 1.")
    shares = np.zeros((*values.shape[:-1], ACTION_SIZE))
    shares[..., : values.shape[-1]] = values.clip(-1.0, 1.0)
    if config.world == "map":
        length = np.linalg.norm(shares[..., :2], axis=-1, keepdims=True)
        shares[..., :2] /= np.maximum(length, 1.0)
    commands: NDArray[np.float64] = shares * np.asarray(config.max_velocity)
    return commands


def velocity_commands(config: SimConfig, velocities: ArrayLike) -> NDArray[np.float64]:
    """Return the commands that bring a robot of any drive nearest to the velocities that a controller wants.

    Parameters
    ----------
    config : SimConfig
        Its `drive`, `max_velocity` and time step.
    velocities : array_like of shape (..., 2)
        Shares of the largest vx and vy, robot frame.

    Returns
    -------
    ndarray of shape (..., 3), float64
        vx, vy [m/s], omega [rad/s]. Holonomic: as :func:`scale_actions`. Differential: the robot turns towards where it
        wants to go, by at most 1 rad/s, and goes forward by the part of the velocity that lies ahead, as scripted
        policies do.
    """
    wanted = scale_actions(config, velocities)
    if config.drive != "differential":
        return wanted
    turn = np.arctan2(wanted[..., 1], wanted[..., 0]) / config.sensor.dt
    limited = turn.clip(-STEER_LIMIT, STEER_LIMIT)
    return np.stack([wanted[..., 0].clip(0.0), np.zeros_like(turn), limited], axis=-1)
