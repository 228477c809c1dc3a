"""Scans of other lidars, as the one scan that a model expects.

Notes
-----
The models were trained on 1080 rays around the robot's centre; the paper's robot carried two scanners at its corners
and merged them. What is done here, in order: each ray is a return, free (nothing within reach) or invalid; returns
become short pieces of surface in the robot's frame; the model's rays are cast against them from the robot's centre.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ArrayError, BlindSectorWarning, ConfigError
from navrep_data.observations import _adapter
from navrep_data.observations.blind import BLIND_RANGE, describe_rays, runs_of
from navrep_data.schema import SensorContract

POOLINGS = ("nearest", "min")
# Rays further apart than this see too little between them to be joined into surfaces [rad].
LARGEST_INCREMENT = math.radians(30.0)
# Angles that agree to this are the same [rad]: float32 drivers round.
SAME_ANGLE = 1e-5
# More rays than this share that say nothing, though a scanner looks there, are worth a word.
MANY_INVALID = 0.1


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
        Range of directions that nobody saw [m]: outside every field of view, or invalid. Default: 0, which rings show
        as unknown and models that read ranges as something near (:mod:`navrep_data.observations.blind`); the first such
        scan warns, once per adapter. Giving a number says that this is known, and no warning comes. The contract's
        range_max calls such directions free: a policy drives there without looking.

    Attributes
    ----------
    blind : ndarray of shape (contract.n_rays,), bool
        Rays that no scanner looks along, whatever it returns.

    Warns
    -----
    BlindSectorWarning
        If there are blind rays, or a tenth of the others say nothing, and `unknown` is not given.

    Notes
    -----
    Rules:

    * Where several scanners see something in one direction, the nearest counts.
    * A ray of the model is free only if some scanner sees as far as the model's ray goes. Where a scanner looks there
      but returns from something nearer, which the ray passes by (a gap of parallax, a shadow), the nearer of the rays
      beside it counts. So it does between two fields of view, up to the largest increment.
    * Neighbouring returns are joined by a straight line if their ranges are alike (a surface seen at more than about 11
      degrees), otherwise each stands for half the gap at its own range. So few rays become many without stairs.
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
        self.unknown = 0.0 if unknown is None else float(unknown)
        self._silent = unknown is not None
        if not self.lidars:
            raise ConfigError("lidars is empty, expected at least one Lidar: describe the robot's scanner.")
        if pooling not in POOLINGS:
            raise ConfigError(f"pooling is {pooling!r}, expected 'nearest' or 'min'.")
        if not 0.0 <= self.unknown <= self.contract.range_max:
            raise ConfigError(
                f"unknown is {unknown} m, expected 0 to {self.contract.range_max:g}: 0 for not seen, range_max if free."
            )
        self.pooling = pooling
        angles = self.contract.angle_min + np.arange(self.contract.n_rays) * self.contract.angle_increment
        self._directions = np.stack([np.cos(angles), np.sin(angles)])
        self._slack = 0.5 if pooling == "min" else _adapter.ROUNDING
        self._rays = [_ray_table(lidar) for lidar in self.lidars]
        self._beam_of = [_beam_table(lidar, self.contract, self._directions) for lidar in self.lidars]
        self._reach = [_reach_table(lidar, self.contract, self._directions) for lidar in self.lidars]
        self._closed = self.contract.covers_full_turn()
        self.blind, self._bridged = self._blind_rays()
        self._same = len(self.lidars) == 1 and _same_rays(self.lidars[0], self.contract)

    def _blind_rays(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the rays that no scanner looks along, and those where two fields of view all but meet."""
        unwatched = np.all([beam < 0 for beam in self._beam_of], axis=0)
        n = len(unwatched)
        widest = max(abs(lidar.angle_increment) for lidar in self.lidars) / abs(self.contract.angle_increment)
        narrow = np.zeros(n, np.bool_)
        start = int(np.argmin(unwatched)) if self._closed else 0  # no run is cut in two by the beginning of the scan
        for first, last in runs_of(np.roll(unwatched, -start)):
            if last - first + 1 <= max(1.0, widest + _adapter.ROUNDING):
                narrow[(np.arange(first, last + 1) + start) % n] = True
        return unwatched & ~narrow, narrow

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
        known = np.full(shape, _adapter.BLIND, np.uint8)
        known[:, self._bridged] = _adapter.HIDDEN
        tables = zip(self.lidars, rows, self._rays, self._beam_of, self._reach, strict=True)
        for lidar, batch, rays, beam_of, reach in tables:
            if self._same:
                self._copy(lidar, batch, nearest, known)
                continue
            flipped = -1.0 if lidar.angle_increment < 0.0 else 1.0
            _adapter.add_scans(
                np.ascontiguousarray(batch[:, :: int(flipped)]), lidar.range_min, lidar.range_max,
                lidar.invalid_is_free, rays, 0.5 * abs(lidar.angle_increment), lidar.x, lidar.y, lidar.closed,
                beam_of, reach, self.contract.angle_min, self.contract.angle_increment, self._slack, self._directions,
                nearest, known,
            )  # fmt: skip
        scan: NDArray[np.float32] = self._finish(nearest, known).astype(np.float32)
        return scan.reshape(*lead, self.contract.n_rays)

    def _finish(self, nearest: NDArray[np.float64], known: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Return ranges of all rays: what was hit, what is free, what is behind something, what nobody saw."""
        ranges = np.minimum(nearest, self.contract.range_max)
        missed = np.isinf(nearest)
        hidden = missed & (known == _adapter.HIDDEN)
        blind = missed & (known == _adapter.BLIND)
        for k in np.flatnonzero(hidden.any(axis=1)).tolist():
            seen = ~(hidden[k] | blind[k])
            _adapter.fill_gaps(ranges[k], hidden[k], seen, len(seen), self._closed, self.unknown)
        ranges[blind] = self.unknown
        if not self._silent and blind.any():
            self._warn(blind)
        return ranges

    def _warn(self, blind: NDArray[np.bool_]) -> None:
        """Say once that models are shown something in place of what nobody saw."""
        contract, watched = self.contract, int((~self.blind).sum())
        lost = int((blind & ~self.blind).sum(axis=1).max())
        shown = (
            f"they are 0 in its scans, unknown in rings, at most {BLIND_RANGE:g} m for networks that read ranges. Give "
            "ScanAdapter(unknown=0) if that is meant, unknown=range_max if they are free"
        )
        if self.blind.any():
            where = describe_rays(self.blind, contract.angle_min, contract.angle_increment)
            said = f"No scanner looks along {int(self.blind.sum())} of {contract.n_rays} rays ({where}): {shown}."
        elif lost > MANY_INVALID * watched:
            said = (
                f"{lost} of {contract.n_rays} rays say nothing (NaN, 0, below range_min): {shown}, or "
                "Lidar(invalid_is_free=True) if the driver reports no return so."
            )
        else:
            return
        self._silent = True
        warnings.warn(said, BlindSectorWarning, stacklevel=4)

    def _copy(
        self, lidar: Lidar, batch: NDArray[np.float64], nearest: NDArray[np.float64], known: NDArray[np.uint8]
    ) -> None:
        """Take over a scan that has the contract's rays already."""
        with np.errstate(invalid="ignore"):
            hit = (batch >= lidar.range_min) & (batch > 0.0) & (batch < lidar.range_max)
            known[hit | (batch >= lidar.range_max) | lidar.invalid_is_free] = _adapter.SEEN
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


def _reach_table(lidar: Lidar, contract: SensorContract, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far from the lidar each ray of the contract ends [m]."""
    ends = contract.range_max * directions
    # float32 ranges of what stands exactly at the end still reach it
    reach: NDArray[np.float64] = np.hypot(ends[0] - lidar.x, ends[1] - lidar.y) * (1.0 - 1e-6)
    return reach


def _same_rays(lidar: Lidar, contract: SensorContract) -> bool:
    """Whether a lidar sits in the robot's centre and has the contract's rays."""
    if lidar.n_rays != contract.n_rays or lidar.angle_increment < 0.0 or (lidar.x, lidar.y) != (0.0, 0.0):
        return False
    off = _angles(lidar) - (contract.angle_min + np.arange(contract.n_rays) * contract.angle_increment)
    return bool(np.abs((off + math.pi) % (2.0 * math.pi) - math.pi).max() <= SAME_ANGLE)
