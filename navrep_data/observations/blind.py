"""Directions that nobody saw: what they are in a scan, and what models are shown there.

Notes
-----
The rule of the whole package. A scan holds 0 where nobody saw anything: outside every scanner's field of view, or
where a scanner said nothing. Rings show a section of only such rays as unknown. Models that read ranges have no word
for unknown; they are shown the nearer of the ranges on both sides of a gap as narrow as a section of the rings, and at
most :data:`BLIND_RANGE` in wider ones: a policy does not drive where nobody looked.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ArrayError
from navrep_data.observations import _adapter
from navrep_data.observations.rings import N_SECTIONS
from navrep_data.schema import SensorContract

BLIND_RANGE = 1.0
"""Range [m] that models which read ranges are shown, at most, in a sector that nobody saw.

With a goal 5 m behind and a blind sector of 60 to 120 degrees there, e2e_1d.v1 and joint_1d_z.v1 drive into it at 0.77
to 0.98 m/s where it is called free, at 0.05 to 0.89 m/s where it reads 2 m, and away from it where it reads 1 m, as the
networks on rings do where it is unknown.
"""


def fill_blind(scan: ArrayLike) -> NDArray[np.floating]:
    """Replace rays that nobody saw by what models are to be shown there.

    Parameters
    ----------
    scan : ndarray of shape (..., n_rays), floating [m]
        Ranges of rays that go once around; 0 where nobody saw anything.

    Returns
    -------
    ndarray of shape (..., n_rays)
        Ranges [m] in the scan's own dtype; the array itself where everything was seen. In a gap no wider than a
        section of the rings (1/64 of the rays) the nearer of the ranges on both sides, in a wider one that or
        :data:`BLIND_RANGE`, whichever is nearer.

    Raises
    ------
    ArrayError
        If `scan` is not floating or has no axis of rays.
    """
    array = np.asarray(scan)
    if array.ndim == 0 or not np.issubdtype(array.dtype, np.floating):
        raise ArrayError(
            f"scan has shape {array.shape} and dtype {array.dtype}, expected (..., n_rays) floating metres: use "
            "metres_from_millimetres for a stored scan."
        )
    unseen = array == 0.0
    if not unseen.any():
        return array
    rows = np.array(array, np.float64).reshape(-1, array.shape[-1])
    gaps = unseen.reshape(rows.shape)
    widest = max(1, math.ceil(array.shape[-1] / N_SECTIONS))
    for k in np.flatnonzero(gaps.any(axis=1)).tolist():
        _adapter.fill_gaps(rows[k], gaps[k], ~gaps[k], widest, True, BLIND_RANGE)
    return rows.reshape(array.shape).astype(array.dtype)


def describe_rays(rays: NDArray[np.bool_], angle_min: float, angle_increment: float) -> str:
    """Return the chosen rays as sectors in degrees, as in ``"135 to 225 deg"``.

    Parameters
    ----------
    rays : ndarray of shape (n_rays,), bool
        Which rays are meant.
    angle_min, angle_increment : float
        Angle of ray 0 and between neighbours [rad].
    """
    first, step = math.degrees(angle_min), math.degrees(angle_increment)
    sectors = [f"{first + a * step:.0f} to {first + b * step:.0f} deg" for a, b in runs_of(rays)]
    return ", ".join(sectors[:_LISTED]) + (f" and {len(sectors) - _LISTED} more" if len(sectors) > _LISTED else "")


def declaration(rays: NDArray[np.bool_], sensor: SensorContract) -> str:
    """Return what an import says of rays (n_rays,) that no scan of a recording has seen anything with."""
    where = describe_rays(rays, sensor.angle_min, sensor.angle_increment)
    return (
        f"{int(rays.sum())} of {sensor.n_rays} rays are blind in every scan ({where}): they are 0, unknown in rings, "
        "and declared in the manifest (blind_rays)"
    )


def runs_of(rays: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of chosen rays as pairs (first, last), ascending."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rays, [False]]).astype(np.int8)))
    return [(a, b - 1) for a, b in edges.reshape(-1, 2).tolist()]


_LISTED = 4

__all__ = ["BLIND_RANGE", "describe_rays", "fill_blind", "runs_of"]
