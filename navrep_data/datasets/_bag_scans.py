"""The scans of a recording: which belong to its scanner, how that is set, and which of its rays never say anything.

Drivers vary the number of rays and their increment a little from scan to scan, and begin with a scan that is short or
empty. So every scan is read by its own description; scans that differ by more than that are left out while they are
few.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.errors import ConfigError, DatasetError
from navrep_data.observations import Lidar, ScanAdapter
from navrep_data.schema import SensorContract

Bools = npt.NDArray[np.bool_]
Floats32 = npt.NDArray[np.float32]

MAX_RAYS = 100_000
ALIKE = 0.1
"""Largest difference of scans of one scanner: share of its rays and of its field of view, and of angle_min [rad]."""
START_UP = 10
"""Scans at the beginning that may be of another kind: a scanner that starts turns unevenly."""
MAX_ODD = 0.05
"""Share of later scans that may be of another kind and are left out; more, and two scanners may share a topic."""
_ADAPTERS = 64


class ScannerBook:
    """Reads the description of each scan, and remembers what they have in common.

    Parameters
    ----------
    where : str
        Bag and topic, for messages.
    mount : sequence of float
        x, y [m] and yaw [rad] of the scanner, robot frame.
    reach : float, optional
        Range from which on nothing was hit [m], where the driver does not say (range_max 0 or NaN).
    invalid_is_free : bool
        Whether NaN and 0 mean that nothing was hit.
    """

    def __init__(self, where: str, mount: Sequence[float], reach: float | None, invalid_is_free: bool) -> None:
        self.where, self._mount, self._reach, self._free = where, mount, reach, invalid_is_free
        self._lidars: list[Lidar | None] = []
        self._valid: list[Bools] = []
        self._ever: dict[int, Bools] = {}

    def lidar(self, scan: Any) -> Lidar | None:
        """Return the scanner that a ``sensor_msgs/LaserScan`` describes; None for one without rays or of nonsense.

        Raises
        ------
        ConfigError
            If its range_max is 0 or NaN and no other was given.
        """
        n, step = len(scan.ranges), float(scan.angle_increment)
        if not 1 <= n <= MAX_RAYS or not math.isfinite(step) or step == 0.0:
            return None
        low, high = float(scan.range_min), float(scan.range_max)
        if not high > 0.0:
            if self._reach is None:
                raise ConfigError(
                    f"{self.where}: range_max of the scans is {high:g}, expected the scanner's reach [m]; say from "
                    "which range on nothing was hit: --range-max (range_max=)."
                )
            high = self._reach
        turn = 2.0 * math.pi
        if n * abs(step) > turn + abs(step) and n > 1:  # a nominal increment, and some more rays than usual
            span = float(scan.angle_max) - float(scan.angle_min)
            step = span / (n - 1) if 0.0 < span * math.copysign(1.0, step) <= turn else math.copysign(turn / n, step)
        x, y, yaw = self._mount
        try:
            return Lidar(
                n, float(scan.angle_min), step, low if low > 0.0 else 0.0, high, x, y, yaw, invalid_is_free=self._free
            )
        except ConfigError:
            return None

    def add(self, scan: Any) -> None:
        """Take a scan into account."""
        lidar = self.lidar(scan)
        self._lidars.append(lidar)
        if lidar is None:
            return
        ranges = np.asarray(scan.ranges, np.float32)
        with np.errstate(invalid="ignore"):
            valid = (ranges >= lidar.range_min) & (ranges > 0) | (ranges >= lidar.range_max) | self._free
        ever = self._ever.setdefault(lidar.n_rays, np.zeros(lidar.n_rays, np.bool_))
        ever |= valid

    def finish(self, note: Callable[[str], None]) -> tuple[Lidar, Bools]:
        """Return the usual scanner, and which scans are of it.

        Raises
        ------
        DatasetError
            If there is no usable scan, or too many are of another kind.
        """
        usable = [lidar for lidar in self._lidars if lidar is not None]
        if not usable:
            raise DatasetError(
                f"{self.where}: none of {len(self._lidars)} scans has rays that can be used; expected 1 to "
                f"{MAX_RAYS:,} ranges, angle_increment and range_min < range_max of one scanner."
            )
        # of the middle number of rays, then the most frequent setting
        middle = sorted(lidar.n_rays for lidar in usable)[len(usable) // 2]
        usual = Counter(lidar for lidar in usable if lidar.n_rays == middle).most_common(1)[0][0]
        fits = np.array([lidar is not None and alike(lidar, usual) for lidar in self._lidars])
        odd = int((~fits).sum())
        late = np.flatnonzero(~fits)
        late = late[late >= min(int(fits.argmax()), START_UP)]
        if len(late) > MAX_ODD * len(fits):
            k = int(late[0])
            other = self._lidars[k]
            seen = "none" if other is None else f"{other.n_rays} every {other.angle_increment:.6g} rad"
            raise DatasetError(
                f"{self.where}: {odd} of {len(fits)} scans are unlike the others: scan {k} has other rays than the "
                f"first usable one ({seen}; {usual.n_rays} every {usual.angle_increment:.6g} rad); expected one scanner"
                " on a topic. Choose another with --scan-topic."
            )
        if odd:
            note(f"{self.where}: left out {odd} of {len(fits)} scans, which are empty, short or of other rays")
        self._usual = usual
        return usual, fits

    def never_seen(self, sensor: SensorContract) -> Bools:
        """Return which rays of the new scans are blind in every scan."""
        usual = self._usual
        ever = np.zeros(usual.n_rays, np.bool_)
        for n, valid in self._ever.items():
            if abs(n - usual.n_rays) <= ALIKE * usual.n_rays:
                ever |= valid[np.rint(np.linspace(0, n - 1, usual.n_rays)).astype(np.int64)]
        probe = np.where(ever, np.inf, np.nan)
        blind: Bools = ScanAdapter(replace(usual, invalid_is_free=False), sensor, unknown=0.0)(probe) == 0.0
        return blind


def alike(one: Lidar, usual: Lidar) -> bool:
    """Return whether two scans can be of one scanner whose driver rounds, or drops and adds some rays."""
    span = usual.n_rays * abs(usual.angle_increment)
    return (
        one.angle_increment * usual.angle_increment > 0.0
        and abs(one.n_rays - usual.n_rays) <= max(1.0, ALIKE * usual.n_rays)
        and abs(one.n_rays * abs(one.angle_increment) - span) <= ALIKE * span
        and abs(one.angle_min - usual.angle_min) <= ALIKE
    )


class Adapters:
    """Turns each scan into one of the sensor by its own description."""

    def __init__(self, sensor: SensorContract) -> None:
        self._of = lru_cache(_ADAPTERS)(lambda lidar: ScanAdapter(lidar, sensor, unknown=0.0))

    def __call__(self, lidar: Lidar, ranges: Floats32) -> Floats32:
        """Return the scan (n_rays,) [m], 0 where nobody saw anything."""
        return self._of(lidar)(ranges)
