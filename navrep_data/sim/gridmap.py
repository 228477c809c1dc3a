"""An occupancy grid and what follows from it: distances, free space, what can be reached, outlines.

Cells are indexed [i, j] = [column, row counted from the bottom]; cell (i, j) covers
``origin + [i, i + 1) x [j, j + 1) * resolution`` in the world frame.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ArrayError, ConfigError, MapError
from navrep_data.schema import MAX_COORDINATE
from navrep_data.sim import _grid_lidar, _map_contours
from navrep_data.sim._map_cache import cached_on_disk, content_hash

__all__ = ["GridMap"]

# Smaller maps are done again in less time than a file takes to open.
DISK_CACHE_CELLS = 1 << 18
_Array = TypeVar("_Array", bound=NDArray[Any])


@dataclass(frozen=True, eq=False)
class GridMap:
    """An occupancy grid and what follows from it; every array is read-only and worked out once.

    Attributes
    ----------
    name : str
        Name of the map, for messages and figures.
    occupancy : ndarray of shape (W, H), float32
        Per cell, about 0 (free) to 1 (solid), indexed [column, row from the bottom].
    resolution : float
        Side of a cell [m].
    origin : tuple of float
        Lower-left corner of cell (0, 0), world frame [m].
    occupied_threshold, free_threshold : float
        Cells above the first are solid, those below the second free, the others unknown.
    source : str
        Where it came from: the file name, or "array".
    """

    name: str
    occupancy: NDArray[np.float32]
    resolution: float
    origin: tuple[float, float]
    occupied_threshold: float = 0.65
    free_threshold: float = 0.196
    source: str = "array"

    def __post_init__(self) -> None:
        occupancy = np.array(self.occupancy, dtype=np.float32, order="C")
        if occupancy.ndim != 2 or occupancy.size == 0 or not np.isfinite(occupancy).all():
            raise ArrayError(f"occupancy has shape {occupancy.shape}, expected (W, H) finite numbers: check the array.")
        if not (math.isfinite(self.resolution) and self.resolution > 0.0):
            raise ConfigError(f"resolution is {self.resolution}, expected a positive number of metres: correct it.")
        if len(self.origin) != 2 or not all(math.isfinite(value) for value in self.origin):
            raise ConfigError(f"origin is {self.origin}, expected two finite numbers of metres: correct it.")
        size = max(occupancy.shape) * self.resolution
        if size > MAX_COORDINATE:
            raise MapError(
                f"Map '{self.name}' is {size:.0f} m long, expected at most {MAX_COORDINATE:.0f} m, where float32 "
                "coordinates keep their millimetres: cut it."
            )
        occupancy.setflags(write=False)
        object.__setattr__(self, "occupancy", occupancy)

    # --- cells and places -----------------------------------------------------------------------------------------

    @property
    def shape(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.occupancy.shape[0], self.occupancy.shape[1]

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, lower and upper end of the map, world frame [m] (the order of matplotlib's ``imshow``)."""
        (x, y), (width, height) = self.origin, self.shape
        return x, x + width * self.resolution, y, y + height * self.resolution

    @cached_property
    def occupied(self) -> NDArray[np.bool_]:
        """Which cells are solid: what the lidar sees and the robot hits. ndarray of shape (W, H), bool."""
        return _read_only(self.occupancy > self.occupied_threshold)

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which cells are free. ndarray of shape (W, H), bool."""
        return _read_only(self.occupancy < self.free_threshold)

    @cached_property
    def hash(self) -> str:
        """Hash of everything but name and source, 32 hex digits."""
        return content_hash(
            self.occupancy, self.resolution, self.origin, float(self.occupied_threshold), float(self.free_threshold)
        )

    @cached_property
    def local(self) -> GridMap:
        """The same map with its origin at (0, 0): the frame that `consistent` physics simulates in."""
        return self if self.origin == (0.0, 0.0) else dataclasses.replace(self, origin=(0.0, 0.0))

    def contains(self, xy: ArrayLike) -> NDArray[np.bool_]:
        """Return which places lie on the map.

        Parameters
        ----------
        xy : ndarray of shape (..., 2) [m]
            World frame.

        Returns
        -------
        ndarray of shape (...), bool
        """
        ij = (_places(xy) - self.origin) / self.resolution
        return np.asarray(((ij >= 0.0) & (ij < self.shape)).all(axis=-1))

    def cell_of(self, xy: ArrayLike) -> NDArray[np.int64]:
        """Return the cells that places lie in; the nearest cell of the map for places outside.

        Parameters
        ----------
        xy : ndarray of shape (..., 2) [m]
            World frame.

        Returns
        -------
        ndarray of shape (..., 2), int64
            Columns and rows.
        """
        ij = np.floor((_places(xy) - self.origin) / self.resolution)
        return np.clip(ij, 0, np.array(self.shape) - 1).astype(np.int64)

    def centre_of(self, ij: ArrayLike) -> NDArray[np.float64]:
        """Return the centres of cells.

        Parameters
        ----------
        ij : ndarray of shape (..., 2)
            Columns and rows.

        Returns
        -------
        ndarray of shape (..., 2), float64
            World frame [m].
        """
        return (_places(ij) + 0.5) * self.resolution + self.origin

    # --- derived maps and fields ----------------------------------------------------------------------------------

    def coarsened(self, passes: int = 1) -> GridMap:
        """Return the map at half the resolution, `passes` times over: a cell takes the highest of its four.

        Parameters
        ----------
        passes : int
            How often. An odd last row or column is dropped; the origin stays.

        Raises
        ------
        ConfigError
            If nothing would be left.

        Notes
        -----
        As the original's ``as_coarse_map2d`` (``CMap2D.pyx``). Kept in memory.
        """
        if passes < 0 or (min(self.shape) >> passes) < 1:
            raise ConfigError(
                f"Cannot halve the {self.shape[0]} x {self.shape[1]} cells of map '{self.name}' {passes} times: "
                "ask for fewer passes."
            )
        if passes == 0:
            return self
        kept: dict[int, GridMap] = self.__dict__.setdefault("_coarser", {})
        if passes not in kept:
            finer = self.coarsened(passes - 1)
            width, height = finer.shape[0] // 2, finer.shape[1] // 2
            blocks = finer.occupancy[: 2 * width, : 2 * height].reshape(width, 2, height, 2)
            kept[passes] = dataclasses.replace(
                self, occupancy=blocks.max(axis=(1, 3)), resolution=finer.resolution * 2.0
            )
        return kept[passes]

    @cached_property
    def distance(self) -> NDArray[np.float32]:
        """Distance from each cell's centre to that of the nearest solid cell [m], inf where there is none.

        ndarray of shape (W, H), float32. Kept on disk for large maps, in the folder ``maps`` of the cache.
        """
        if self.occupancy.size < DISK_CACHE_CELLS:
            return _read_only(self._distance())
        key = content_hash(self.occupied, float(self.resolution))
        return _read_only(cached_on_disk("distance", key, self.shape, self._distance, np.float32))

    def _distance(self) -> NDArray[np.float32]:
        if not self.occupied.any():
            return np.full(self.shape, np.inf, np.float32)
        from scipy import ndimage  # here and below: importing it takes longer than simulating a first row without maps

        cells = ndimage.distance_transform_edt(~self.occupied)
        # whole numbers of cells squared, then float32 as the original
        squares = np.rint(np.square(cells)).astype(np.float32)
        result: NDArray[np.float32] = np.sqrt(squares) * np.float32(self.resolution)
        return result

    def signed_distance(self, free_threshold: float | None = None) -> NDArray[np.float32]:
        """Return the distance to solid cells, negative where a cell is not free.

        Parameters
        ----------
        free_threshold : float, optional
            Cells above this occupancy get the minus sign; default that of the map. At ``occupied_threshold`` only solid
            cells get it, so that unknown ground counts as free.

        Returns
        -------
        ndarray of shape (W, H), float32
            Cell centre to cell centre [m]. Kept in memory; read-only.

        Notes
        -----
        As the original's ``as_sdf`` (``CMap2D.pyx``): unknown cells (grey 205) collide where free_threshold is 0.15
        and do not where it is 0.196.
        """
        threshold = float(self.free_threshold if free_threshold is None else free_threshold)
        kept: dict[float, NDArray[np.float32]] = self.__dict__.setdefault("_signed", {})
        if threshold not in kept:
            kept[threshold] = _read_only(np.where(self.occupancy > threshold, -self.distance, self.distance))
        return kept[threshold]

    def reachable(self, xy: ArrayLike, clearance: float) -> NDArray[np.bool_]:
        """Return the cells that a disc can move to, from cell to neighbouring cell without cutting corners.

        Parameters
        ----------
        xy : ndarray of shape (2,) [m]
            Where it starts, world frame.
        clearance : float
            Cells whose signed distance is less are closed [m].

        Returns
        -------
        ndarray of shape (W, H), bool

        Raises
        ------
        MapError
            If the start is outside the map or in a closed cell.

        Notes
        -----
        As the original's spawn area (``pepper_2d_simulator.py``), which takes it on the map coarsened three times.
        """
        from scipy import ndimage

        start = self._start_cell(xy, clearance)
        labels, _ = ndimage.label(self.signed_distance() >= clearance)
        return _read_only(labels == labels[start])

    def _start_cell(self, xy: ArrayLike, clearance: float) -> tuple[int, int]:
        place = _places(xy).reshape(2)
        if not self.contains(place):
            left, right, low, high = self.extent
            raise MapError(
                f"({place[0]:g}, {place[1]:g}) is not on map '{self.name}', expected x in [{left:g}, {right:g}) and y "
                f"in [{low:g}, {high:g}) m: choose another place."
            )
        i, j = self.cell_of(place)
        found = float(self.signed_distance()[i, j])
        if found < clearance:
            raise MapError(
                f"({place[0]:g}, {place[1]:g}) on map '{self.name}' is {found:.2f} m from the nearest wall (negative: "
                f"not free), expected at least {clearance:g}: choose another place."
            )
        return int(i), int(j)

    @cached_property
    def free_squares(self) -> NDArray[np.uint8]:
        """Leap tables of the lidar kernel, ndarray of shape (4, W + 1, H + 1), uint8; see ``sim/_grid_lidar.py``."""
        squares = np.empty((_grid_lidar.QUADRANTS, self.shape[0] + 1, self.shape[1] + 1), np.uint8)
        _grid_lidar.free_squares(self.occupied, squares)
        return _read_only(squares)

    def ground(self, radius: float) -> NDArray[np.bool_]:
        """Return the cells that some disc on free ground covers: free ground without its narrow ends and gaps.

        Parameters
        ----------
        radius : float
            Radius of the disc [m]; 0 gives the free cells.

        Returns
        -------
        ndarray of shape (W, H), bool
            Unknown cells count as solid, and so does what lies outside the map. Kept in memory; read-only.
        """
        if not (math.isfinite(radius) and radius >= 0.0):
            raise ConfigError(f"radius is {radius}, expected 0 or more metres: correct it.")
        kept: dict[float, NDArray[np.bool_]] = self.__dict__.setdefault("_ground", {})
        if radius not in kept:
            allowed = self.occupancy <= self.free_threshold

            def make() -> NDArray[np.bool_]:
                from scipy import ndimage

                ground = np.pad(allowed, 1)
                for _ in range(2 if radius > 0.0 else 0):
                    # where the disc's centre may be; then, with solid and ground exchanged, what it covers
                    ground = ~(ndimage.distance_transform_edt(ground) * self.resolution >= radius)
                return np.ascontiguousarray(ground[1:-1, 1:-1])

            if allowed.size < DISK_CACHE_CELLS:
                kept[radius] = _read_only(make())
            else:
                key = content_hash(allowed, float(self.resolution), float(radius))
                kept[radius] = _read_only(cached_on_disk("ground", key, self.shape, make, np.bool_))
        return kept[radius]

    def contours(
        self, tolerance: float = 0.0, *, radius: float = 0.0, unknown_is_solid: bool = False
    ) -> list[NDArray[np.float64]]:
        """Return the outlines of solid matter as polygons, for ORCA and for drawing.

        Parameters
        ----------
        tolerance : float
            Largest distance between the polygons and the outline of the cells, either way [m]. 0 gives the cells' own
            outline with collinear corners dropped. From half a cell on, stairs become slopes.
        radius : float
            Where positive, everything but :meth:`ground` of this radius is taken for solid [m], also outside the map.
        unknown_is_solid : bool
            Whether cells that are neither free nor solid count as solid, as they do in :meth:`signed_distance`. Always
            so with a radius.

        Returns
        -------
        list of ndarray of shape (V, 2), float64
            World frame [m], anticlockwise round solid matter, clockwise round ground enclosed by it; the first vertex
            is not repeated. Cells that share only a corner belong together. What is thinner than the tolerance may
            have two vertices. Kept in memory; read-only.
        """
        if not (math.isfinite(tolerance) and tolerance >= 0.0):
            raise ConfigError(f"tolerance is {tolerance}, expected 0 or more metres: correct it.")
        kept: dict[tuple[float, float, bool], list[NDArray[np.float64]]] = self.__dict__.setdefault("_contours", {})
        key = (float(tolerance), float(radius), bool(unknown_is_solid))
        if key not in kept:
            if radius > 0.0:
                # with a frame of solid cells round the map, whose own outline is left out
                solid = np.pad(~self.ground(radius), 1, constant_values=True)
                outlines = _map_contours.outlines(solid, tolerance / self.resolution)
                outlines = [line - 1.0 for line in outlines if line[:, 0].min() >= 1.0]
            else:
                solid = self.occupancy > self.free_threshold if unknown_is_solid else self.occupied
                outlines = _map_contours.outlines(solid, tolerance / self.resolution)
            kept[key] = [_read_only(line * self.resolution + self.origin) for line in outlines]
        return kept[key]


def _read_only(array: _Array) -> _Array:
    array.setflags(write=False)
    return array


def _places(xy: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(xy, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 2 or not np.isfinite(array).all():
        raise ArrayError(f"Places have shape {array.shape}, expected (..., 2) finite numbers: check the array.")
    return array
