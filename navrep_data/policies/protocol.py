"""What every policy is: told where it drives, told when episodes begin, asked for actions, told what was executed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from navrep_data.schema import RobotContract, SensorContract
from navrep_data.sim import GridMap

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]


class Observation(NamedTuple):
    """What a policy sees of a batch of B robots, one row each.

    Every policy is given ``robot_state``; the other fields are filled where its ``needs`` name them, and have no
    columns (shape (B, 0)) where they do not. The robot frame has its origin at the robot's centre, x ahead, y left.

    Attributes
    ----------
    robot_state : ndarray of shape (B, 5), float32
        Goal x, goal y [m], vx, vy [m/s], omega [rad/s], robot frame.
    scan : ndarray of shape (B, n_rays), float32
        Ranges [m]; see :class:`navrep_data.schema.SensorContract`.
    pose : ndarray of shape (B, 3), float64
        x, y [m], theta [rad] in the frame of :meth:`navrep_data.sim.Simulator.state`, which is the frame of the maps in
        :class:`Context`.
    waypoint : ndarray of shape (B, 2), float64
        A point to head for [m], robot frame: about a metre ahead on the planned path in worlds on maps, elsewhere the
        goal.
    map_index : ndarray of shape (B, 1), int64
        Which of the maps in :class:`Context` each robot is on; -1 where there is none.
    humans : ndarray of shape (B, H, 4), float64
        True x, y [m], vx, vy [m/s] of the humans, robot frame; NaN in slots that nobody fills.
    orca_velocity : ndarray of shape (B, 2), float64
        What ORCA would do [m/s], robot frame, knowing all humans and obstacles, on maps the planned path.
    radius : ndarray of shape (B, 1), float64
        Radius of the robot [m].
    """

    robot_state: F32
    scan: F32
    pose: F64
    waypoint: F64
    map_index: NDArray[np.int64]
    humans: F64
    orca_velocity: F64
    radius: F64


NEEDS = frozenset(Observation._fields) - {"robot_state"}
"""What a policy may ask for."""
OF_EVERY_ROBOT = frozenset({"scan", "pose", "radius"})
"""What every robot of a world is given, where it has several; the rest is known for the first."""


@dataclass(frozen=True)
class Context:
    """Where a policy drives; the same for all robots of a batch.

    Attributes
    ----------
    robot : RobotContract
        Speed of a full action [m/s] and radius [m].
    sensor : SensorContract
        What scans are; its `dt` is the time between two actions [s].
    maps : tuple of GridMap
        The maps that the robots may be on; empty where there are none.
    """

    robot: RobotContract
    sensor: SensorContract
    maps: tuple[GridMap, ...] = ()


class BasePolicy(ABC):
    """Drives a batch of robots. Derive from it to write a policy that sees more than a scan, or has a memory.

    A policy is used in this order: :meth:`start` once, :meth:`reset` wherever episodes begin, then for every step
    :meth:`act` and :meth:`observe`.

    Attributes
    ----------
    name : str
        Full name, as results and datasets record it.
    sees : str
        What it is given beside the goal and its own velocity, in a few words: ``"scan"``, ``"true humans"``; its
        `needs` where it is empty.
    sees_on_maps : str
        The same in worlds on maps, empty where it does not differ.
    text : str
        One line on what it is.
    needs : frozenset of str
        The fields of :class:`Observation` that it reads beside ``robot_state``.
    steers : bool
        Whether its actions are velocities (vx, vy) that it wants, so that a robot with a differential drive turns
        towards where they point. Otherwise an action is sent as it is.
    max_rows : int or None
        Most robots that it drives at once.
    grouped : bool
        True where episodes must start together: 64 consecutive ones, the first of them divisible by 64, each in its
        own row whether or not the others are played.
    """

    name: str = ""
    sees: str = ""
    sees_on_maps: str = ""
    text: ClassVar[str] = ""
    needs: frozenset[str] = frozenset()
    steers: bool = True
    max_rows: int | None = None
    grouped: bool = False

    def start(self, context: Context) -> None:
        """Get ready to drive there; what was remembered of other episodes is forgotten."""
        return

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64]) -> None:
        """Begin episodes in the rows of `mask` (B,); `seeds` (B,) belong to the episodes, whatever their rows are."""
        return

    @abstractmethod
    def act(self, observation: Observation) -> F64:
        """Return the actions (B, 3): vx, vy, omega in [-1, 1], shares of the robot's largest velocities."""

    def observe(self, executed: F64) -> None:
        """Hear what the robots were sent for the last actions: body velocities (B, 3) [m/s, m/s, rad/s]."""
        return
