"""What is asked of a bag, and what it answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from navrep_data.datasets._bag_clock import Clock
from navrep_data.datasets._bag_scans import ScannerBook
from navrep_data.observations import Lidar

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Topics:
    """The topics of a bag that are used; `goal` is None where there is none."""

    scan: str
    odometry: str
    goal: str | None


@dataclass(frozen=True)
class Reading:
    """How a bag is to be read.

    Attributes
    ----------
    mount : sequence of float
        x, y [m] and yaw [rad] of the scanner, robot frame.
    reach : float, optional
        Range from which on nothing was hit [m], where the scans do not say.
    invalid_is_free : bool
        Whether NaN and 0 in scans mean that nothing was hit.
    assume_same_frame : bool
        Whether goals and odometry are in one frame although their names differ.
    """

    mount: Sequence[float]
    reach: float | None
    invalid_is_free: bool
    assume_same_frame: bool


@dataclass(frozen=True)
class Tracks:
    """Everything in a bag but the ranges.

    Attributes
    ----------
    scan_times : ndarray of shape (S,), int64
        When each scan was made [ns], ascending.
    scan_numbers : ndarray of shape (S,), int64
        Which of the scans of the topic it is, in the order of recording.
    lidar : Lidar
        The scanner as most scans describe it, in its place on the robot.
    book : ScannerBook
        Describes each scan.
    clock : Clock
        What times are.
    times : ndarray of shape (N,), int64
        When the robot was there [ns], ascending.
    pose : ndarray of shape (N, 3)
        x, y [m], theta [rad] in the odometry's frame.
    twist : ndarray of shape (N, 3)
        vx, vy [m/s], omega [rad/s] along the robot's axes.
    goal_times : ndarray of shape (G,), int64
        When each new goal came [ns]; goals that were only published again are left out.
    goals : ndarray of shape (G, 2)
        x, y [m], in the odometry's frame.
    """

    scan_times: Ints
    scan_numbers: Ints
    lidar: Lidar
    book: ScannerBook
    clock: Clock
    times: Ints
    pose: Floats
    twist: Floats
    goal_times: Ints
    goals: Floats
