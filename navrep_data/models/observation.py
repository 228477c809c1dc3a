"""From scans and stored rings to what the networks take."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from navrep_data.observations import fill_blind, rings_to_float, scan_to_1d, scan_to_rings


def observation_from_scan(scan: NDArray[Any], lidar: str, zero_first_bin: bool = True) -> Tensor:
    """Turn scans into observations for V and the world models.

    Parameters
    ----------
    scan : ndarray of shape (..., 1080) [m]
        Ranges; ray 0 straight ahead, anticlockwise, 25 where a ray hits nothing, 0 where nobody saw anything.
    lidar : str
        ``"rings"`` or ``"1d"``.
    zero_first_bin : bool
        Rings: set the nearest cell free, as everywhere in the original but in the end-to-end networks.

    Returns
    -------
    Tensor of shape (..., 64, 64) in {0, 0.5, 1} or (..., 1080), ranges over 25 m, float32, on the CPU

    Notes
    -----
    Ranges above 25 m are not clipped, as in the original's use of the models.
    """
    scan = np.ascontiguousarray(scan, dtype=np.float32)
    if lidar == "1d":
        return torch.from_numpy(scan_to_1d(fill_blind(scan)))
    return observation_from_rings(scan_to_rings(scan), zero_first_bin)


def observation_from_rings(rings: NDArray[np.uint8], zero_first_bin: bool = True) -> Tensor:
    """Turn stored rings (0, 1, 2) of shape (..., 64, 64), uint8, into observations {0, 0.5, 1}, float32."""
    return torch.from_numpy(rings_to_float(rings, zero_first_bin))
