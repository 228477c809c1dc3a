"""ORCA for a whole group of agents: the checked way to the kernels, for tests, examples and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ConfigError
from navrep_data.schema import MAX_COORDINATE
from navrep_data.sim._obstacles import build_obstacles, make_obstacles
from navrep_data.sim._orca import (
    ORCA_AGENT_FIELDS,
    ORCA_PARAM_FIELDS,
    make_orca_work,
    orca_step,
)


def orca_velocities(
    positions: ArrayLike,
    velocities: ArrayLike,
    radii: ArrayLike,
    max_speeds: ArrayLike,
    preferred: ArrayLike,
    polygons: Sequence[ArrayLike] = (),
    *,
    neighbor_dist: float = 10.0,
    max_neighbors: int = 10,
    time_horizon: float = 5.0,
    time_horizon_obst: float = 5.0,
    time_step: float = 0.2,
) -> NDArray[np.float32]:
    """Return the velocities that N agents choose by ORCA, all at once.

    Parameters
    ----------
    positions : array_like of shape (N, 2)
        Positions [m], world frame.
    velocities : array_like of shape (N, 2)
        Present velocities [m/s], world frame.
    radii : array_like of shape (N,) or ()
        Radii [m], used as they are.
    max_speeds : array_like of shape (N,) or ()
        Largest speeds [m/s].
    preferred : array_like of shape (N, 2)
        Preferred velocities [m/s], world frame.
    polygons : sequence of array_like of shape (V, 2), optional
        Static obstacles [m], world frame; V at least 2. Anticlockwise = solid inside, clockwise = free
        inside.
    neighbor_dist : float, optional
        Agents farther away do not count [m].
    max_neighbors : int, optional
        Only so many nearest agents count.
    time_horizon, time_horizon_obst : float, optional
        For how long velocities must be free of collisions with agents and with obstacles [s].
    time_step : float, optional
        Time in which agents that overlap get apart [s].

    Returns
    -------
    ndarray of shape (N, 2), float32
        New velocities [m/s], world frame.

    Raises
    ------
    ConfigError
        If a shape does not fit, a number is not finite, or a setting is out of range.

    Notes
    -----
    Van den Berg et al., Reciprocal n-body collision avoidance (2011), as implemented by RVO2 2.0.3
    (``doStep`` without the motion), in float32 and to the same bits where the compiler of RVO2 does not fuse
    multiply and add. Difference: more than ten agents at exactly equal distances are taken in the order of
    their rows. Two agents at the same place with the same velocity ignore each other, as there.

    Examples
    --------
    >>> from navrep_data.sim.orca import orca_velocities
    >>> v = orca_velocities([[0, 0], [4, 0]], [[1, 0], [-1, 0]], 0.3, 1.0, [[1, 0], [-1, 0]])
    >>> v.shape
    (2, 2)
    """
    position = _matrix("positions", positions, None)
    n = len(position)
    agents = np.zeros((n, ORCA_AGENT_FIELDS), np.float32)
    agents[:, 0:2] = position
    agents[:, 2:4] = _matrix("velocities", velocities, n)
    agents[:, 4] = _column("radii", radii, n)
    agents[:, 5] = _column("max_speeds", max_speeds, n)
    want = _matrix("preferred", preferred, n)
    params = np.zeros(ORCA_PARAM_FIELDS, np.float32)
    params[:] = (
        _at_least("neighbor_dist", neighbor_dist, 0.0),
        _at_least("max_neighbors", max_neighbors, 0.0),
        _above_zero("time_horizon", time_horizon),
        _above_zero("time_horizon_obst", time_horizon_obst),
        _above_zero("time_step", time_step),
        0.0,  # to the bit as RVO2, largest speed or not
    )
    obst_f, obst_i, n_obst = obstacle_arrays(polygons)
    work_f, work_i = make_orca_work(obst_f.shape[1], n)
    out = np.zeros((n, 2), np.float32)
    orca_step(agents, want, obst_f, obst_i, n_obst, params, work_f, work_i, out)
    return out


def obstacle_arrays(
    polygons: Sequence[ArrayLike],
) -> tuple[NDArray[np.float32], NDArray[np.int32], int]:
    """Return ``(obst_f, obst_i, n)``: the obstacle arrays of the kernels, as large as they need to be.

    Parameters
    ----------
    polygons : sequence of array_like of shape (V, 2)
        Static obstacles [m], world frame; V at least 2.

    Returns
    -------
    tuple
        Arrays of shape (fields, capacity), float32 and int32, and the number of edges after splitting.

    Raises
    ------
    ConfigError
        If a polygon is not a list of at least two finite points.
    """
    shapes = [_matrix(f"polygons[{k}]", polygon, None) for k, polygon in enumerate(polygons)]
    for k, shape in enumerate(shapes):
        if len(shape) < 2:
            raise ConfigError(
                f"polygons[{k}] has {len(shape)} vertices; expected at least 2. Leave it out or add vertices."
            )
    start = np.zeros(len(shapes) + 1, np.int64)
    np.cumsum([len(shape) for shape in shapes], out=start[1:])
    vertices = np.concatenate(shapes) if shapes else np.zeros((0, 2))
    capacity = max(16, 2 * len(vertices))
    while True:
        obst_f, obst_i = make_obstacles(capacity)
        n = int(build_obstacles(vertices, start, obst_f, obst_i))
        if n >= 0:
            return obst_f, obst_i, n
        capacity *= 2


def _matrix(name: str, value: ArrayLike, n: int | None) -> NDArray[np.float64]:
    """Return `value` as (n, 2) float64, or say what is wrong with it."""
    array = np.asarray(value, np.float64)
    if n in (None, 0) and array.size == 0:
        array = array.reshape(0, 2)
    if array.ndim != 2 or array.shape[1] != 2 or (n is not None and len(array) != n):
        raise ConfigError(
            f"{name} has shape {array.shape}; expected ({'N' if n is None else n}, 2). Pass rows of x, y."
        )
    _check_finite(name, array)
    check_near_zero(name, array)
    return np.ascontiguousarray(array)


def check_near_zero(name: str, coordinates: NDArray[np.float64]) -> None:
    """Raise ConfigError unless finite coordinates [m] are so near 0 that ORCA can reckon with them."""
    largest = np.abs(coordinates).max(initial=0.0)
    if largest > MAX_COORDINATE:
        raise ConfigError(
            f"{name} holds {largest:g}; expected coordinates within {MAX_COORDINATE:.0f} m of 0, where float32 keeps "
            "their millimetres. Subtract a common offset."
        )


def _column(name: str, value: ArrayLike, n: int) -> NDArray[np.float64]:
    """Return `value` as (n,) float64 without negative numbers, or say what is wrong with it."""
    array = np.asarray(value, np.float64)
    if array.shape not in ((), (n,)):
        raise ConfigError(f"{name} has shape {array.shape}; expected ({n},) or one number. Pass one per agent.")
    _check_finite(name, array)
    if (array < 0.0).any():
        raise ConfigError(f"{name} holds {array.min():g}; expected no negative numbers. Check the order of arguments.")
    return np.broadcast_to(array, (n,))


def _check_finite(name: str, array: NDArray[np.float64]) -> None:
    if not np.isfinite(array).all():
        raise ConfigError(f"{name} holds NaN or infinity; expected finite numbers. Remove or replace those rows.")


def _at_least(name: str, value: float, low: float) -> float:
    if not value >= low:
        raise ConfigError(f"{name} is {value!r}; expected at least {low:g}.")
    return value


def _above_zero(name: str, value: float) -> float:
    if not value > 0.0:
        raise ConfigError(f"{name} is {value!r}; expected a number above 0.")
    return value
