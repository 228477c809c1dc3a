"""Lidar scans of polygons and circles: the checked way into the kernel.

Notes
-----
Exact intersections in float64, as the original's renderer makes them in float32 (``CMap2D.pyx``).
Differences: circles are seen at all bearings (``gap_quirk=True`` brings the original's gaps back), sensors
inside a circle are allowed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ArrayError, ConfigError
from navrep_data.schema import SensorContract
from navrep_data.sim import _lidar


def ray_directions(contract: SensorContract) -> NDArray[np.float64]:
    """Return cosines and sines of the ray angles.

    Parameters
    ----------
    contract : SensorContract
        Number of rays and their angles.

    Returns
    -------
    ndarray of shape (2, n_rays), float64
        Robot frame, ray 0 first.

    Raises
    ------
    ConfigError
        If the contract has no ray, or an angle or range that cannot be used.
    """
    if contract.n_rays < 1:
        raise ConfigError(f"n_rays is {contract.n_rays}, expected at least 1: check the sensor contract.")
    for name, value in (("angle_increment", contract.angle_increment), ("range_max", contract.range_max)):
        if not (np.isfinite(value) and value > 0.0):
            raise ConfigError(f"{name} is {value}, expected a positive number: check the sensor contract.")
    if not np.isfinite(contract.angle_min):
        raise ConfigError(
            f"angle_min is {contract.angle_min}, expected an angle in radians: check the sensor contract."
        )
    angles = contract.angle_min + np.arange(contract.n_rays) * contract.angle_increment
    return np.ascontiguousarray(np.stack([np.cos(angles), np.sin(angles)]))


def polygon_edges(polygons: Sequence[ArrayLike]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the edges of closed polygons as the kernel takes them.

    Parameters
    ----------
    polygons : sequence of ndarray of shape (V, 2) [m]
        Vertices in order around each polygon, either way, first not repeated. Simple (no edge crosses
        another); need not be convex. Two vertices make a wall that is seen from both sides.

    Returns
    -------
    edges : ndarray of shape (E, 4), float64
        x1, y1, x2, y2 [m].
    poly_start : ndarray of shape (P + 1,), int64
        Edges ``poly_start[p]:poly_start[p + 1]`` belong to polygon p.

    Raises
    ------
    ArrayError
        If a polygon is not (V >= 2, 2) or not finite.
    """
    parts: list[NDArray[np.float64]] = []
    start = np.zeros(len(polygons) + 1, np.int64)
    for p, polygon in enumerate(polygons):
        vertices = np.asarray(polygon, dtype=np.float64)
        if vertices.ndim != 2 or vertices.shape[0] < 2 or vertices.shape[1] != 2 or not np.isfinite(vertices).all():
            raise ArrayError(
                f"Polygon {p} has shape {vertices.shape}, expected at least two finite vertices (V, 2): "
                "drop or repair it."
            )
        parts.append(np.concatenate([vertices, np.roll(vertices, -1, axis=0)], axis=1))
        start[p + 1] = start[p] + len(vertices)
    return np.concatenate(parts) if parts else np.empty((0, 4)), start


def _checked_circles(circles: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(circles, dtype=np.float64)
    if array.size == 0:
        return np.empty((0, _lidar.CIRCLE_COLUMNS))
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all() or (array[:, 2] < 0.0).any():
        raise ArrayError(
            f"circles has shape {array.shape}, expected (C, 3) finite x, y, radius with radius at least 0: "
            "check the rows."
        )
    return np.column_stack([array, np.arange(len(array))])


def scan_polygons(
    polygons: Sequence[ArrayLike],
    circles: ArrayLike,
    pose: ArrayLike,
    contract: SensorContract | None = None,
    *,
    gap_quirk: bool = False,
) -> NDArray[np.float32]:
    """Scan a world from one or many poses.

    Parameters
    ----------
    polygons : sequence of ndarray of shape (V, 2) [m]
        Closed simple polygons, world frame; see :func:`polygon_edges`. A sensor inside one sees its edges
        from within.
    circles : ndarray of shape (C, 3) [m]
        x, y, radius, world frame. Solid: from within, all rays are 1e-6 m.
    pose : ndarray of shape (..., 3) [m, m, rad]
        x, y, theta of the sensor, world frame.
    contract : SensorContract, optional
        Rays and largest range; default that of the original robot.
    gap_quirk : bool
        Lose circles where the original's renderer loses them: those across the world's +x direction, and of
        those across ray 0 the part seen by the last rays.

    Returns
    -------
    ndarray of shape (..., n_rays), float32
        Ranges [m], `range_max` where nothing is hit or the hit is farther.

    Raises
    ------
    ArrayError
        If an input has another shape or is not finite.
    ConfigError
        If the contract cannot be used.

    Notes
    -----
    An edge seen exactly edge-on has no width; a sensor exactly on an edge looks through it.
    """
    contract = SensorContract() if contract is None else contract
    directions = ray_directions(contract)
    edges, poly_start = polygon_edges(polygons)
    discs = _checked_circles(circles)
    poses = np.asarray(pose, dtype=np.float64)
    if poses.ndim == 0 or poses.shape[-1] != 3 or not np.isfinite(poses).all():
        raise ArrayError(f"pose has shape {poses.shape}, expected (..., 3) finite x, y, theta: check it.")
    rows = np.ascontiguousarray(poses.reshape(-1, 3))
    out = np.empty((len(rows), contract.n_rays), np.float32)
    _lidar.scan_poses(
        edges, poly_start, discs, rows, directions, float(contract.angle_min),
        float(contract.angle_increment), float(contract.range_max), int(gap_quirk), out,
    )  # fmt: skip
    return out.reshape(*poses.shape[:-1], contract.n_rays)
