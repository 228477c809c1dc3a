"""Pictures of a dataset, drawn from its own rows: a still and a moving one for its card, any row for a sample."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.observations import metres_from_millimetres, scan_to_rings
from navrep_data.schema import Event
from navrep_data.shards import DatasetFolder, Episodes, EpisodeWorld
from navrep_data.sim.drawing import OBSTACLE, draw_rings, draw_scan, draw_world, scan_points

FRAMES = 36
SECONDS_PER_FRAME = 0.15
COLOURS = 64
_SHARE = 0.35  # how far into the episode the still picture is
_EPISODES_LOOKED_AT = 2000
_MARGIN = 1.0
# On maps: how far around the robot's way to show, and which ends of rays are somebody's legs, not walls [m].
_MAP_MARGIN = 6.0
_LEGS = 0.4
# What must be stored to draw a world.
_NEEDED = ("scan", "humans", "robot_pose", "robot_radius")

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class FilmedEpisode:
    """The rows of one episode, and what stood around, None where that is not known."""

    rows: dict[str, Array]
    world: EpisodeWorld | None
    folder: DatasetFolder

    def __len__(self) -> int:
        return len(self.rows["scan"])

    def draw_world(self, axes: Any, row: int) -> None:
        assert self.world is not None
        border = self.world.border
        pose = self.rows["robot_pose"][row]
        draw_world(
            axes,
            [*self.world.polygons, *([border] if border is not None else [])],
            pose,
            radius=float(self.rows["robot_radius"][row]),
            goal=self.world.robot_goal,
            humans=_to_world(self.rows["humans"][row], pose),
            scan=self.metres(row),
            sensor=self.folder.manifest.sensor,
            trail=self.rows["robot_pose"][: row + 1, :2],
        )
        axes.plot(*self.walls.T, ",", color=OBSTACLE, zorder=2)
        (left, bottom), (right, top) = self.extent
        axes.set(xlim=(left, right), ylim=(bottom, top))

    @cached_property
    def walls(self) -> Array:
        """What the lidar saw of a map in the whole episode, (n, 2) [m]: datasets on maps do not hold the map itself."""
        if self.world is None or not self.world.map:
            return np.empty((0, 2))
        sensor, rows = self.folder.manifest.sensor, np.linspace(0, len(self) - 1, FRAMES).astype(int)
        seen = [self._fixed(scan_points(self.metres(k), self.rows["robot_pose"][k], sensor), int(k)) for k in rows]
        return np.concatenate(seen)

    def _fixed(self, points: Array, row: int) -> Array:
        """Return those ends of a scan's rays that are on something, and not on somebody."""
        ranges = self.metres(row)
        points = points[(ranges > 0) & (ranges < self.folder.manifest.sensor.range_max)]
        humans = _to_world(self.rows["humans"][row], self.rows["robot_pose"][row])
        for x, y, _, _, radius, _ in humans[np.isfinite(humans[:, 0])]:
            points = points[np.hypot(points[:, 0] - x, points[:, 1] - y) > radius + _LEGS]
        return points

    @cached_property
    def extent(self) -> tuple[Array, Array]:
        """What to show: lower left and upper right corner [m]."""
        assert self.world is not None
        trail = self.rows["robot_pose"][:, :2]
        if self.world.map:
            points = np.concatenate([trail, [self.world.robot_goal]])
            middle = (points.min(axis=0) + points.max(axis=0)) / 2
            points, margin = np.stack([middle, middle]), _MAP_MARGIN + np.ptp(points, axis=0).max() / 2  # a square
        elif self.world.border is not None:
            points, margin = self.world.border, _MARGIN
        else:
            points, margin = np.concatenate([*self.world.polygons, trail]), _MARGIN
        return points.min(axis=0) - margin, points.max(axis=0) + margin

    def metres(self, row: int) -> Array:
        scan = self.rows["scan"][row]
        return metres_from_millimetres(scan) if scan.dtype == np.uint16 else scan

    def rings(self, row: int) -> Array:
        return scan_to_rings(self.rows["scan"][row])


def draw_pictures(folder: DatasetFolder) -> dict[str, bytes]:
    """Return a PNG and a GIF by name; none where a dataset does not hold what is needed to draw its worlds."""
    episode = _choose(folder)
    if episode is None:
        return {}
    name = "".join(c if c.isalnum() else "-" for c in folder.manifest.env)[:80]
    row = int(_SHARE * (len(episode) - 1))
    return {f"media/{name}-episode.gif": _moving(episode), f"media/{name}-scene.png": still(episode, row)}


def _choose(folder: DatasetFolder) -> FilmedEpisode | None:
    """Return the longest of the first episodes that reached the goal, else of all; on maps the most crowded."""
    if folder.manifest.sensor.n_rays < 2:
        return None
    e = folder.episodes
    looked = np.arange(min(len(e), _EPISODES_LOOKED_AT))
    reached = looked[e.event[looked] == Event.GOAL]
    candidates = reached if len(reached) else looked
    if not len(candidates):
        return None
    k = int(candidates[np.argmax(e.length[candidates])])
    if folder.manifest.config.get("world") == "map" and "humans" in folder.manifest.columns:
        # the longest are on ways so long that nobody can be made out: the largest crowd of the first shard
        candidates = candidates[e.shard[candidates] == e.shard[candidates[0]]]
        k = int(max(candidates, key=lambda i: (_crowd(folder, e, i), e.length[i])))
    episode = read_episode(folder, k)
    return None if episode.world is None else episode


def read_episode(folder: DatasetFolder, k: int) -> FilmedEpisode:
    """Return episode `k` of ``folder.episodes``, without a world where not all is stored that drawing it needs."""
    e = folder.episodes
    shard, start, stop = int(e.shard[k]), int(e.start[k]), int(e.start[k] + e.length[k])
    rows = {name: folder.read(name, shard, start, stop) for name in _NEEDED if name in folder.manifest.columns}
    worlds = folder.worlds(shard) if set(_NEEDED) <= set(rows) else None
    if worlds is None or not np.isfinite(rows["robot_pose"]).all():  # imports do not know it
        return FilmedEpisode(rows, None, folder)
    return FilmedEpisode(rows, worlds.episode(int(np.flatnonzero(worlds.arrays["row"] == start)[0])), folder)


def _crowd(folder: DatasetFolder, episodes: Episodes, k: int) -> int:
    """Return the number of humans in an episode."""
    start, shard = int(episodes.start[k]), int(episodes.shard[k])
    return int(np.isfinite(folder.read("humans", shard, start, start + 1)[0, :, 0]).sum())


def _to_world(humans: Array, pose: Array) -> Array:
    """Turn one row of the humans column to the world frame."""
    c, s = np.cos(float(pose[2])), np.sin(float(pose[2]))
    turn = np.array([[c, -s], [s, c]])
    turned = humans.astype(np.float64)
    turned[:, :2] = humans[:, :2] @ turn.T + pose[:2]
    turned[:, 2:4] = humans[:, 2:4] @ turn.T
    return turned


def _figure(width: float, height: float, mosaic: str, dpi: int, ratios: tuple[float, float]) -> tuple[Any, Any]:
    # not pyplot: it would choose a backend for the whole process
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplot_mosaic(mosaic, width_ratios=list(ratios))


def still(episode: FilmedEpisode, row: int) -> bytes:
    """Return a PNG of one row: its world (if known), scan and rings."""
    sensor = episode.folder.manifest.sensor
    if episode.world is not None:
        figure, axes = _figure(11, 6, "WS;WR", 100, (1.15, 1.0))
        episode.draw_world(axes["W"], row)
        axes["W"].set_title("world: robot (red), humans (pale: not in sight), goal (star)", fontsize=10)
    else:
        figure, axes = _figure(11, 4, "SR", 100, (1.0, 1.0))
    draw_scan(axes["S"], episode.metres(row), sensor)
    axes["S"].set_title(f"scan: {sensor.n_rays} ranges", fontsize=10)
    draw_rings(axes["R"], episode.rings(row))
    axes["R"].set_title("rings: 64 x 64, white free, grey unknown, dark occupied", fontsize=10)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _frames(episode: FilmedEpisode) -> Iterator[Any]:
    from PIL import Image

    assert episode.world is not None
    figure, axes = _figure(6.4, 3.2, "WR", 80, (1.0, 1.0))
    for row in np.unique(np.linspace(0, len(episode) - 1, FRAMES).astype(int)):
        for one in axes.values():
            one.clear()
        episode.draw_world(axes["W"], int(row))
        draw_rings(axes["R"], episode.rings(int(row)))
        for one in axes.values():
            one.set(xticks=[], yticks=[], xlabel="", ylabel="")
        figure.canvas.draw()
        figure.set_layout_engine("none")  # frames have no labels, so the first one's places do for all
        yield Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())


def _moving(episode: FilmedEpisode) -> bytes:
    from PIL import Image

    frames = list(_frames(episode))
    # one palette for all frames, so that still parts stay equal and cost nothing
    palette = frames[len(frames) // 2].quantize(COLOURS, dither=Image.Dither.NONE)
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    buffer = io.BytesIO()
    pause = int(1000 * SECONDS_PER_FRAME)
    flat[0].save(buffer, "GIF", save_all=True, append_images=flat[1:], duration=pause, loop=0, optimize=True)
    return buffer.getvalue()
