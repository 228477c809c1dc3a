"""Scans of other lidars, as the one scan that a model expects.

Notes
-----
The models were trained on 1080 rays around the robot's centre; the paper's robot carried two scanners at its corners
and merged them. What is done here, in order: each ray is a return, free (nothing within reach) or invalid; returns
become short pieces of surface in the robot's frame; the model's rays are cast against them from the robot's centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ArrayError, ConfigError
from navrep_data.observations import _adapter
from navrep_data.schema import SensorContract

POOLINGS = ("nearest", "min")
# Rays further apart than this see too little between them to be joined into surfaces [rad].
LARGEST_INCREMENT = math.radians(30.0)
# Angles that agree to this are the same [rad]: float32 drivers round.
SAME_ANGLE = 1e-5


@dataclass(frozen=True)
class Lidar:
    """One scanner: its rays, its reach and where it is mounted.

    Attributes
    ----------
    n_rays : int
        Rays per scan.
    angle_min : float
        Angle of ray 0 in the scanner's own frame [rad], anticlockwise from where it looks.
    angle_increment : float
        Angle from one ray to the next [rad]; negative for a scanner that turns clockwise or hangs upside down.
    range_min : float
        Smaller ranges say nothing (the robot's own body, dirt) [m].
    range_max : float
        Ranges from here on, +inf included, mean that nothing was hit [m].
    x, y, yaw : float
        Mounting, robot frame: x forward, y left of the robot's centre [m]; direction of the scanner [rad].
    invalid_is_free : bool
        Whether NaN, 0, negative ranges and those below `range_min` mean that nothing was hit, as with drivers that
        report 0 for no return. Otherwise they say nothing.
    """

    n_rays: int
    angle_min: float
    angle_increment: float
    range_min: float = 0.0
    range_max: float = math.inf
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    invalid_is_free: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be a scanner."""
        if self.n_rays < 1:
            raise ConfigError(f"n_rays is {self.n_rays}, expected at least 1: take it from the scanner's driver.")
        if not 0.0 < abs(self.angle_increment) <= LARGEST_INCREMENT:
            raise ConfigError(
                f"angle_increment is {self.angle_increment} rad, expected up to {LARGEST_INCREMENT:.3f} and not 0: "
                "is it in degrees?"
            )
        if self.n_rays * abs(self.angle_increment) > 2.0 * math.pi + 2.0 * abs(self.angle_increment):
            raise ConfigError(
                f"{self.n_rays} rays every {self.angle_increment} rad make more than a turn, expected at most one: "
                "is angle_increment right?"
            )
        for name in ("angle_min", "x", "y", "yaw"):
            if not math.isfinite(getattr(self, name)):
                raise ConfigError(f"{name} is {getattr(self, name)}, expected a finite number: check the mounting.")
        if not 0.0 <= self.range_min < self.range_max:
            raise ConfigError(
                f"range_min is {self.range_min} m and range_max {self.range_max} m, expected 0 <= range_min < "
                "range_max: check the driver's settings."
            )

    @property
    def closed(self) -> bool:
        """Whether the last ray is the first one's neighbour."""
        rest = 2.0 * math.pi - self.n_rays * abs(self.angle_increment)
        return abs(rest) <= 0.5 * abs(self.angle_increment)

    @classmethod
    def of(cls, contract: SensorContract) -> Lidar:
        """Return the scanner in the robot's centre that a contract describes."""
        return cls(contract.n_rays, contract.angle_min, contract.angle_increment, 0.0, contract.range_max)


class ScanAdapter:
    """Turn scans of one or several lidars into scans of a model's contract.

    Parameters
    ----------
    lidars : Lidar or sequence of Lidar
        The robot's scanners.
    contract : SensorContract, optional
        What the model expects; default 1080 rays around, 25 m.
    pooling : str
        ``"nearest"``: a ray of the model takes the surface exactly in its direction, as the simulator's rays do.
        ``"min"``: the nearest surface within half an increment to each side, so that nothing thin is lost when many
        rays become few.
    unknown : float, optional
        Range of directions that no scanner says anything about [m]: outside every field of view, or invalid. Default:
        the contract's range_max, which models read as free. 0 marks them as invalid: rings ignore such rays, but a
        model on ``lidar="1d"`` takes them for something that touches the robot.

    Notes
    -----
    Rules:

    * Where several scanners see something in one direction, the nearest counts.
    * Neighbouring returns are joined by a straight line if their ranges are alike (a surface seen at more than about 11
      degrees), otherwise each stands for half the gap at its own range. So few rays become many without stairs.
    * What the robot's centre would see but no scanner can (behind something, from their places) stays unseen.
    * Surfaces beyond the contract's range_max count as free.
    * A scanner that has the contract's own rays passes through unchanged, but for invalid rays.
    """

    def __init__(
        self,
        lidars: Lidar | Sequence[Lidar],
        contract: SensorContract | None = None,
        pooling: str = "nearest",
        unknown: float | None = None,
    ) -> None:
        self.lidars = (lidars,) if isinstance(lidars, Lidar) else tuple(lidars)
        self.contract = SensorContract() if contract is None else contract
        self.unknown = self.contract.range_max if unknown is None else float(unknown)
        if not self.lidars:
            raise ConfigError("lidars is empty, expected at least one Lidar: describe the robot's scanner.")
        if pooling not in POOLINGS:
            raise ConfigError(f"pooling is {pooling!r}, expected 'nearest' or 'min'.")
        if not 0.0 <= self.unknown <= self.contract.range_max:
            raise ConfigError(
                f"unknown is {unknown} m, expected 0 to {self.contract.range_max:g}: 0 for invalid, range_max for free."
            )
        self.pooling = pooling
        angles = self.contract.angle_min + np.arange(self.contract.n_rays) * self.contract.angle_increment
        self._directions = np.stack([np.cos(angles), np.sin(angles)])
        self._slack = 0.5 if pooling == "min" else _adapter.ROUNDING
        self._rays = [_ray_table(lidar) for lidar in self.lidars]
        self._beam_of = [_beam_table(lidar, self.contract, self._directions) for lidar in self.lidars]
        self._same = len(self.lidars) == 1 and _same_rays(self.lidars[0], self.contract)

    def __call__(self, *scans: ArrayLike) -> NDArray[np.float32]:
        """Turn one scan per lidar into the model's scan.

        Parameters
        ----------
        *scans : ndarray of shape (..., n_rays), floating [m]
            Ranges of each lidar, in the order of the lidars, of the same moment; leading dimensions alike.

        Returns
        -------
        ndarray of shape (..., contract.n_rays), float32
            Ranges [m] as the contract describes.

        Raises
        ------
        ArrayError
            If a scan is missing, is not floating, or has another number of rays than its lidar.
        """
        rows, lead = self._checked(scans)
        shape = (len(rows[0]), self.contract.n_rays)
        nearest = np.full(shape, np.inf)
        known = np.zeros(shape, np.bool_)
        for lidar, batch, rays, beam_of in zip(self.lidars, rows, self._rays, self._beam_of, strict=True):
            if self._same:
                self._copy(lidar, batch, nearest, known)
                continue
            flipped = -1.0 if lidar.angle_increment < 0.0 else 1.0
            _adapter.add_scans(
                np.ascontiguousarray(batch[:, :: int(flipped)]), lidar.range_min, lidar.range_max,
                lidar.invalid_is_free, rays, 0.5 * abs(lidar.angle_increment), lidar.x, lidar.y, lidar.closed,
                beam_of, self.contract.angle_min, self.contract.angle_increment, self._slack, self._directions,
                nearest, known,
            )  # fmt: skip
        seen = np.minimum(nearest, self.contract.range_max)
        seen[np.isinf(nearest) & ~known] = self.unknown
        scan: NDArray[np.float32] = seen.astype(np.float32).reshape(*lead, self.contract.n_rays)
        return scan

    def _copy(
        self, lidar: Lidar, batch: NDArray[np.float64], nearest: NDArray[np.float64], known: NDArray[np.bool_]
    ) -> None:
        """Take over a scan that has the contract's rays already."""
        with np.errstate(invalid="ignore"):
            hit = (batch >= lidar.range_min) & (batch > 0.0) & (batch < lidar.range_max)
            known |= hit | (batch >= lidar.range_max) | lidar.invalid_is_free
        nearest[hit] = batch[hit]

    def _checked(self, scans: tuple[ArrayLike, ...]) -> tuple[list[NDArray[np.float64]], tuple[int, ...]]:
        if len(scans) != len(self.lidars):
            raise ArrayError(f"{len(scans)} scans for {len(self.lidars)} lidars, expected one each, in their order.")
        arrays = [np.asarray(scan) for scan in scans]
        for i, (array, lidar) in enumerate(zip(arrays, self.lidars, strict=True)):
            if not np.issubdtype(array.dtype, np.floating):
                raise ArrayError(
                    f"Scan {i} has dtype {array.dtype}, expected floating metres: divide millimetres by 1000."
                )
            if array.ndim == 0 or array.shape[-1] != lidar.n_rays:
                raise ArrayError(
                    f"Scan {i} has shape {array.shape}, expected (..., {lidar.n_rays}) for its lidar: check the order."
                )
            if array.shape[:-1] != arrays[0].shape[:-1]:
                raise ArrayError(
                    f"Scan {i} has shape {array.shape} beside {arrays[0].shape}, expected equal leading dimensions: "
                    "pass scans of the same moments."
                )
        return [np.asarray(a, np.float64).reshape(-1, a.shape[-1]) for a in arrays], arrays[0].shape[:-1]


def _angles(lidar: Lidar) -> NDArray[np.float64]:
    """Return the angles of a lidar's rays in the robot's frame, anticlockwise whichever way it turns."""
    steps = np.arange(lidar.n_rays, dtype=np.float64)
    angles: NDArray[np.float64] = lidar.yaw + lidar.angle_min + steps * lidar.angle_increment
    return angles[::-1] if lidar.angle_increment < 0.0 else angles


def _ray_table(lidar: Lidar) -> NDArray[np.float64]:
    """Return cosine and sine of each ray, and of the direction half an increment after it, shape (4, n_rays)."""
    angles = _angles(lidar)
    after = angles + 0.5 * abs(lidar.angle_increment)
    return np.ascontiguousarray(np.stack([np.cos(angles), np.sin(angles), np.cos(after), np.sin(after)]))


def _beam_table(lidar: Lidar, contract: SensorContract, directions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return which ray of the lidar looks where each ray of the contract ends; -1 outside its field of view."""
    ends = contract.range_max * directions
    bearing = np.arctan2(ends[1] - lidar.y, ends[0] - lidar.x)
    past = (bearing - _angles(lidar)[0]) / abs(lidar.angle_increment)
    turn = 2.0 * math.pi / abs(lidar.angle_increment)
    beam: NDArray[np.int64] = np.rint((past + 0.5) % turn - 0.5).astype(np.int64)
    beam[beam >= lidar.n_rays] = 0 if lidar.closed else -1
    return beam


def _same_rays(lidar: Lidar, contract: SensorContract) -> bool:
    """Whether a lidar sits in the robot's centre and has the contract's rays."""
    if lidar.n_rays != contract.n_rays or lidar.angle_increment < 0.0 or (lidar.x, lidar.y) != (0.0, 0.0):
        return False
    off = _angles(lidar) - (contract.angle_min + np.arange(contract.n_rays) * contract.angle_increment)
    return bool(np.abs((off + math.pi) % (2.0 * math.pi) - math.pi).max() <= SAME_ANGLE)
