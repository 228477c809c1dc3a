"""What a robot perceives, in the forms that are stored and that models are fed (numpy and numba, no torch).

Notes
-----
Compiled loops use the kernels of ``navrep_data.observations._rings`` with the tables that
:mod:`navrep_data.observations.rings` makes.
"""

from __future__ import annotations

from navrep_data.observations.adapter import Lidar, ScanAdapter
from navrep_data.observations.blind import BLIND_RANGE, fill_blind
from navrep_data.observations.rings import RING_EDGES, rings_to_float, rings_to_scan, scan_to_rings
from navrep_data.observations.robots import RobotScale
from navrep_data.observations.scans import (
    metres_from_millimetres,
    millimetres_from_metres,
    robot_state,
    scan_to_1d,
)

__all__ = [
    "BLIND_RANGE",
    "RING_EDGES",
    "Lidar",
    "RobotScale",
    "ScanAdapter",
    "fill_blind",
    "metres_from_millimetres",
    "millimetres_from_metres",
    "rings_to_float",
    "rings_to_scan",
    "robot_state",
    "scan_to_1d",
    "scan_to_rings",
]
