"""Pictures of worlds drawn by pillow: some milliseconds each, for render modes and films; figures are in `drawing`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageColor, ImageDraw

from navrep_data.errors import check_whole
from navrep_data.schema import SensorContract
from navrep_data.sim.drawing import GOAL, HUMAN, OBSTACLE, RAY, ROBOT, scan_points
from navrep_data.sim.gridmap import GridMap
from navrep_data.sim.simulator import WorldState

F64 = NDArray[np.float64]

BACKGROUND = "#ffffff"
SEEN = "#fdf3dd"
RAY_LINE = "#f8e2b4"
LEG = "#16425b"
BODY = "#a9cfe3"
# Drawn this much larger and averaged: pillow's lines and circles have hard edges.
_OVERSAMPLING = 2
_MARGIN = 0.5
# About so many rays are drawn as lines; all of them would hide the rest.
_RAY_LINES = 36
# Circles smaller than this are legs [m]
_LEG_LIMIT = 0.1
_LEAST_HALF = 3.0
_MAP_MARGIN = 2.0
# [m]: the maps of Mark and CrowdMove, and asl, but not the larger buildings, where nobody could be seen
_WHOLE_MAP = 26.0
_MIN_SIZE, _MAX_SIZE = 16, 4096
_STAR = np.array([[np.sin(k * np.pi / 5), np.cos(k * np.pi / 5)] for k in range(10)]) * np.where(
    np.arange(10) % 2, 0.4, 1.0
).reshape(-1, 1)


@dataclass(frozen=True)
class Camera:
    """The square of the world that a picture shows.

    Attributes
    ----------
    x, y : float
        Centre [m], world frame.
    half : float
        Half of the side [m].
    """

    x: float
    y: float
    half: float

    @classmethod
    def around(cls, state: WorldState, grid: GridMap | None = None) -> Camera:
        """Return the camera that shows a world's obstacles, border, robots, humans and goals.

        On a map: all of a small one, of others the part around them, with some metres to all sides. Where that comes
        near an edge of the map it goes on to there, so that no wall at an edge is cut.
        """
        points = [state.robots[:, 0:2], state.robots[:, 3:5], state.humans[:, 0:2], state.humans[:, 5:7]]
        everything = np.concatenate([*points, *(state.polygons if grid is None else [])])
        low, high = everything.min(axis=0), everything.max(axis=0)
        if grid is None:
            return cls(*_floats((low + high) / 2), _half(low, high))
        first, last = _corners(grid)
        if (last - first).max() <= _WHOLE_MAP:
            return cls(*_floats((first + last) / 2), _half(first, last))
        low, high = low - _MAP_MARGIN, high + _MAP_MARGIN
        seen_low, seen_high = low, high
        for _ in range(5):  # the square shows more than was asked for, which may bring it near another edge, four times
            low = np.where(seen_low < first + _MAP_MARGIN, first, low)
            high = np.where(seen_high > last - _MAP_MARGIN, last, high)
            half = _half(low, high)
            centre = _kept_on(first, last, (low + high) / 2, half)
            seen_low, seen_high = centre - half, centre + half
        return cls(*_floats(centre), half)

    def following(self, state: WorldState, grid: GridMap | None = None) -> Camera:
        """Return the camera that shows the first robot, too: this one, or moved by as little as that takes.

        Only maps are larger than a picture; walls at their edges are shown whole or not at all.
        """
        if grid is None:
            return self
        now, robot, (first, last) = np.array([self.x, self.y]), state.robots[0, 0:2], _corners(grid)
        room = max(self.half - _MAP_MARGIN, 0.0)
        centre = _kept_on(first, last, now.clip(robot - room, robot + room), self.half)
        if np.allclose(centre, now, rtol=0.0, atol=1e-9):
            return self
        small = 2 * (self.half - _MARGIN) >= last - first
        centre = np.where(~small & (centre - self.half < first + _MAP_MARGIN), first - _MARGIN + self.half, centre)
        centre = np.where(~small & (centre + self.half > last - _MAP_MARGIN), last + _MARGIN - self.half, centre)
        return Camera(*_floats(centre), self.half)


def _half(low: F64, high: F64) -> float:
    return max(_LEAST_HALF, float((high - low).max()) / 2 + _MARGIN)


def _floats(centre: F64) -> tuple[float, float]:
    return float(centre[0]), float(centre[1])


def _corners(grid: GridMap) -> tuple[F64, F64]:
    left, right, bottom, top = grid.extent
    return np.array([left, bottom]), np.array([right, top])


def _kept_on(first: F64, last: F64, centre: F64, half: float) -> F64:
    """Return the centre nearest to `centre` from which a square shows no more than a margin beyond the map."""
    low, high = first - _MARGIN + half, last + _MARGIN - half
    kept: F64 = np.where(low >= high, (first + last) / 2, np.minimum(np.maximum(centre, low), high))
    return kept


class Canvas:
    """An image that is drawn on in metres.

    Parameters
    ----------
    camera : Camera
        What it shows.
    size : int
        Width and height of the result [pixels].
    """

    def __init__(self, camera: Camera, size: int) -> None:
        size = check_whole("size in pixels", size, _MIN_SIZE, _MAX_SIZE)
        self._camera = camera
        self._size = size * _OVERSAMPLING
        self._scale = self._size / (2 * camera.half)
        self._image = Image.new("RGB", (self._size, self._size), BACKGROUND)
        self._draw = ImageDraw.Draw(self._image)

    def _pixels(self, points: ArrayLike) -> list[tuple[float, float]]:
        xy = np.asarray(points, np.float64).reshape(-1, 2)
        u = (xy[:, 0] - self._camera.x + self._camera.half) * self._scale
        v = (self._camera.half - xy[:, 1] + self._camera.y) * self._scale
        return list(zip(u.tolist(), v.tolist(), strict=True))

    def polygon(self, points: ArrayLike, fill: str | None = None, line: str | None = None, width: float = 1.0) -> None:
        """Draw a polygon (k, 2) [m]; `width` [pixels of the result]."""
        corners = self._pixels(points)
        if fill is not None:
            self._draw.polygon(corners, fill=fill)
        if line is not None:
            self._draw.line([*corners, corners[0]], fill=line, width=round(width * _OVERSAMPLING), joint="curve")

    def line(self, points: ArrayLike, colour: str, width: float) -> None:
        """Draw a line through points (k, 2) [m]; `width` [pixels of the result]."""
        pixels = self._pixels(points)
        if len(pixels) > 1:
            self._draw.line(pixels, fill=colour, width=round(width * _OVERSAMPLING), joint="curve")

    def disc(self, x: float, y: float, radius: float, fill: str, line: str | None = None) -> None:
        """Draw a disc, at least a pixel wide [m]."""
        ((u, v),) = self._pixels((x, y))
        r = max(radius * self._scale, 0.5 * _OVERSAMPLING)
        self._draw.ellipse((u - r, v - r, u + r, v + r), fill=fill, outline=line, width=_OVERSAMPLING)

    def dots(self, points: ArrayLike, colour: str) -> None:
        """Mark points (k, 2) [m] by dots of about a pixel."""
        for u, v in self._pixels(points):
            self._draw.rectangle((u - 1, v - 1, u + 1, v + 1), fill=colour)

    def cells(self, occupied: NDArray[np.bool_], origin: tuple[float, float], resolution: float, colour: str) -> None:
        """Paint the occupied cells (W, H) of a map: [i, j] = column x, row y from the bottom; `origin` lower left."""
        width, height = occupied.shape
        mask = Image.fromarray(np.ascontiguousarray(occupied.T[::-1]).astype(np.uint8) * 255)
        (left, top), (right, bottom) = self._pixels(
            [
                (origin[0], origin[1] + height * resolution),
                (origin[0] + width * resolution, origin[1]),
            ]
        )
        size = (max(1, round(right - left)), max(1, round(bottom - top)))
        # shrinking by averages keeps walls visible that are thinner than a pixel
        mask = mask.resize(size, Image.Resampling.BOX if size[0] < width else Image.Resampling.NEAREST)
        self._image.paste(ImageColor.getrgb(colour), (round(left), round(top)), mask.point(lambda v: min(255, 3 * v)))

    def array(self) -> NDArray[np.uint8]:
        """Return the picture, ndarray of shape (size, size, 3), uint8."""
        return np.array(self._image.reduce(_OVERSAMPLING))


def draw_frame(
    state: WorldState,
    camera: Camera,
    scan: ArrayLike,
    sensor: SensorContract,
    trail: Sequence[F64] = (),
    grid: GridMap | None = None,
    size: int = 480,
) -> NDArray[np.uint8]:
    """Draw a world from above.

    Parameters
    ----------
    state : WorldState
        From :meth:`navrep_data.sim.Simulator.state`.
    camera : Camera
        What to show.
    scan : array_like of shape (n_rays,) or (robots, n_rays)
        Ranges [m].
    sensor : SensorContract
        The rays' angles.
    trail : sequence of ndarray of shape (robots, 2)
        Where the robots have been [m], one entry per step.
    grid : GridMap, optional
        The map, drawn instead of the state's polygons.
    size : int
        Width and height [pixels].

    Returns
    -------
    ndarray of shape (size, size, 3), uint8
        Seen area (pale yellow) and the rays' ends (orange), obstacles (grey), people (blue; what the lidar sees of them
        dark), goals (green), trails and robots (red).

    Raises
    ------
    ConfigError
        If `size` is not from 16 to 4096.
    """
    canvas = Canvas(camera, size)
    robots = state.robots
    ends = [
        scan_points(ranges, robot[:3], sensor)
        for ranges, robot in zip(np.atleast_2d(np.asarray(scan)), robots, strict=True)
    ]
    for points, robot in zip(ends, robots, strict=True):
        canvas.polygon(points if sensor.covers_full_turn() else np.vstack([robot[:2], points]), fill=SEEN)
        for end in points[:: max(1, len(points) // _RAY_LINES)]:
            canvas.line([robot[:2], end], RAY_LINE, 0.5)
    if grid is not None:
        canvas.cells(grid.occupied, grid.origin, grid.resolution, OBSTACLE)
    for corners in state.polygons if grid is None else ():
        solid = _area(corners) > 0.0
        canvas.polygon(corners, fill=OBSTACLE if solid else None, line=OBSTACLE, width=1.5)
    for x, y, vx, vy, radius in state.humans[:, [0, 1, 2, 3, 7]]:
        canvas.disc(x, y, radius, BODY, HUMAN)
        canvas.line([(x, y), (x + vx, y + vy)], HUMAN, 1.0)
    _draw_bodies(canvas, state)
    for points in ends:
        canvas.dots(points, RAY)
    if len(trail):
        for path in np.stack([np.asarray(step) for step in trail], axis=1):
            canvas.line(path, ROBOT, 1.5)
    for robot in robots:
        _draw_robot(canvas, robot, max(0.35, 0.02 * camera.half))
    return canvas.array()


def _draw_bodies(canvas: Canvas, state: WorldState) -> None:
    """Draw what the lidar sees of people: legs, or outlines of trunks and ellipses."""
    turn = np.linspace(0.0, 2 * np.pi, 24)
    for x, y, along, across, heading in state.ellipses:
        c, s = np.cos(heading), np.sin(heading)
        u, v = along * np.cos(turn), across * np.sin(turn)
        canvas.polygon(np.column_stack([x + c * u - s * v, y + s * u + c * v]), line=LEG)
    for x, y, radius in state.circles if len(state.ellipses) == 0 else ():
        if radius < _LEG_LIMIT:
            canvas.disc(x, y, radius, LEG)
        else:
            canvas.polygon(np.column_stack([x + radius * np.cos(turn), y + radius * np.sin(turn)]), line=LEG)


def _draw_robot(canvas: Canvas, robot: F64, star: float) -> None:
    x, y, theta, goal_x, goal_y, radius = robot[:6]
    canvas.polygon(np.array([goal_x, goal_y]) + star * _STAR, fill=GOAL)
    canvas.disc(x, y, radius, ROBOT)
    canvas.line([(x, y), (x + 2 * radius * np.cos(theta), y + 2 * radius * np.sin(theta))], ROBOT, 2.0)


def _area(corners: F64) -> float:
    x, y = corners.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
