"""Pictures of worlds, scans and rings on matplotlib axes; matplotlib is imported by whoever makes the axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.observations import RING_EDGES
from navrep_data.schema import SensorContract

OBSTACLE = "#5b6470"
ROBOT = "#d1495b"
HUMAN = "#2e86ab"
HIDDEN = "#b9cfe0"
RAY = "#f2b134"
GOAL = "#3a7d44"
# Rings: free, unknown, occupied
RING_COLOURS = ("#ffffff", "#c9ced6", "#1d3557")


def scan_points(scan: ArrayLike, pose: ArrayLike, sensor: SensorContract | None = None) -> NDArray[np.float64]:
    """Return where the rays of a scan end, shape (n_rays, 2) [m], in the frame of `pose`.

    Parameters
    ----------
    scan : array_like of shape (n_rays,)
        Ranges [m].
    pose : array_like of shape (3,)
        x, y [m], theta [rad] of the sensor.
    sensor : SensorContract, optional
        The rays' angles.
    """
    sensor = sensor or SensorContract()
    ranges = np.asarray(scan, np.float64)
    x, y, theta = np.asarray(pose, np.float64)
    angles = theta + sensor.angle_min + sensor.angle_increment * np.arange(len(ranges))
    return np.column_stack([x + ranges * np.cos(angles), y + ranges * np.sin(angles)])


def draw_world(
    axes: Any,
    polygons: Sequence[ArrayLike],
    pose: ArrayLike,
    *,
    radius: float,
    goal: ArrayLike | None = None,
    humans: ArrayLike | None = None,
    scan: ArrayLike | None = None,
    sensor: SensorContract | None = None,
    trail: ArrayLike | None = None,
) -> None:
    """Draw a world from above.

    Parameters
    ----------
    axes : matplotlib Axes
        Where to draw.
    polygons : sequence of array_like of shape (k, 2)
        Corners [m]; anticlockwise = solid inside, clockwise = the border.
    pose : array_like of shape (3,)
        Robot x, y [m], theta [rad].
    radius : float
        Robot radius [m].
    goal : array_like of shape (2,), optional
        Goal [m].
    humans : array_like of shape (n, 6), optional
        x, y, vx, vy in the world frame, radius, visible (NaN rows are left out).
    scan : array_like of shape (n_rays,), optional
        Ranges [m], drawn as the seen area and its points.
    sensor : SensorContract, optional
        The rays' angles.
    trail : array_like of shape (t, 2), optional
        Where the robot has been [m].
    """
    from matplotlib.patches import Circle, Polygon

    x, y, theta = np.asarray(pose, np.float64)
    if scan is not None:
        points = scan_points(scan, pose, sensor)
        axes.add_patch(Polygon(points, closed=True, facecolor=RAY, alpha=0.15, edgecolor="none", zorder=1))
        axes.plot(*points.T, ".", color=RAY, markersize=1.5, zorder=4)
    for corners in (np.asarray(p, np.float64) for p in polygons):
        px, py = corners.T
        solid = float((px * np.roll(py, -1) - py * np.roll(px, -1)).sum()) > 0
        face = OBSTACLE if solid else "none"
        axes.add_patch(Polygon(corners, closed=True, facecolor=face, edgecolor=OBSTACLE, linewidth=1.2, zorder=2))
    if trail is not None:
        axes.plot(*np.asarray(trail, np.float64).T, color=ROBOT, linewidth=1.0, alpha=0.6, zorder=3)
    for hx, hy, vx, vy, r, visible in np.asarray(humans if humans is not None else np.zeros((0, 6)), np.float64):
        if np.isfinite(hx):
            axes.add_patch(Circle((hx, hy), r, color=HUMAN if visible else HIDDEN, alpha=0.8, zorder=3))
            axes.plot([hx, hx + vx], [hy, hy + vy], color=HUMAN, linewidth=1.0, zorder=3)
    axes.add_patch(Circle((x, y), radius, color=ROBOT, zorder=5))
    axes.plot([x, x + 2 * radius * np.cos(theta)], [y, y + 2 * radius * np.sin(theta)], color=ROBOT, lw=2, zorder=5)
    if goal is not None:
        axes.plot(*np.asarray(goal, np.float64), "*", color=GOAL, markersize=14, zorder=5)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def draw_scan(axes: Any, scan: ArrayLike, sensor: SensorContract | None = None) -> None:
    """Draw ranges [m] over the rays' angles [degrees], 0 = straight ahead, left positive."""
    sensor = sensor or SensorContract()
    ranges = np.asarray(scan, np.float64)
    angles = np.rad2deg(sensor.angle_min + sensor.angle_increment * np.arange(len(ranges)))
    axes.plot(angles, ranges, color=RAY, linewidth=1.0)
    axes.set_xlim(angles[0], angles[-1])
    axes.set_ylim(0, None)
    axes.set_xlabel("angle [degrees], anticlockwise from straight ahead")
    axes.set_ylabel("range [m]")


def draw_rings(axes: Any, rings: ArrayLike) -> None:
    """Draw rings (64, 64) with values 0, 1, 2 as the network sees them: angle to the right, range upwards."""
    from matplotlib.colors import ListedColormap

    values = np.asarray(rings)
    axes.imshow(values.T, origin="lower", cmap=ListedColormap(RING_COLOURS), vmin=0, vmax=2, aspect="auto")
    ticks = [0, 16, 32, 48, 63]
    axes.set_yticks(ticks, [f"{RING_EDGES[k]:.1f}" for k in ticks])
    axes.set_xticks([0, 16, 32, 48, 63], ["0", "90", "180", "270", "360"])
    axes.set_xlabel("angle [degrees]")
    axes.set_ylabel("range [m]")
