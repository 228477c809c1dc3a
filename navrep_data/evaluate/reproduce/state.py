"""The paper's figure of the state: a world, and what the robot knows of it: ranges or rings, goal and velocity."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from navrep_data.evaluate.figures import new_figure
from navrep_data.evaluate.reproduce.drawn import Drawn, Missing
from navrep_data.observations import metres_from_millimetres, scan_to_rings
from navrep_data.schema import Event
from navrep_data.shards import DatasetFolder
from navrep_data.shards.manifest import MANIFEST_FILE
from navrep_data.sim.drawing import draw_rings, draw_scan, draw_world

_SHARE = 0.35
"""How far into its longest successful episode the row lies: people and obstacles are near then."""


def state(folder: Path) -> Drawn:
    """Draw the state from the first dataset below `folder` (or `folder` itself)."""
    found = [p.parent for p in sorted(folder.rglob(MANIFEST_FILE)) if (p.parent / "worlds").is_dir()]
    command = f"navrep-data generate --env soadrl --n 20 --out {folder / 'soadrl'}"
    if not found:
        return Drawn(missing=[Missing("a dataset", command)])
    with DatasetFolder(found[0]) as dataset:
        k = _episode(dataset)
        shard, start, length = (int(getattr(dataset.episodes, name)[k]) for name in ("shard", "start", "length"))
        row = start + int(_SHARE * (length - 1))
        figure = _draw(dataset, shard, start, row)
        m = dataset.manifest
    source = {"name": f"{m.env}, {m.physics} physics, seed {m.seed}", "source": "simulated by navrep-data",
              "shard": shard, "row": row}  # fmt: skip
    return Drawn(figure, sources=[source])


def _episode(dataset: DatasetFolder) -> int:
    """Return the longest episode that reached its goal, or the longest of all."""
    episodes = dataset.episodes
    reached = np.flatnonzero(episodes.event == Event.GOAL)
    candidates = reached if len(reached) else np.arange(len(episodes))
    return int(candidates[np.argmax(episodes.length[candidates])])


def _to_world(humans: np.ndarray[Any, Any], pose: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Turn the humans column, along the robot's axes, to the world frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    turned = humans.astype(float).copy()
    turned[:, :2] = humans[:, :2] @ turn.T + pose[:2]
    turned[:, 2:4] = humans[:, 2:4] @ turn.T
    return turned


def _draw(dataset: DatasetFolder, shard: int, start: int, row: int) -> Any:
    def read(column: str) -> Any:
        return dataset.read(column, shard, row, row + 1)[0]

    scan, pose, robot_state = read("scan"), read("robot_pose"), read("robot_state")
    metres = metres_from_millimetres(scan) if scan.dtype == np.uint16 else scan
    worlds = dataset.worlds(shard)
    assert worlds is not None  # only datasets with worlds are looked at
    world = worlds.episode(int(np.flatnonzero(worlds.arrays["row"] == start)[0]))
    polygons = [*world.polygons, *([world.border] if world.border is not None else [])]
    humans = _to_world(read("humans"), pose) if "humans" in dataset.manifest.columns else None
    figure = new_figure(11.5, 6.2)
    axes = figure.subplot_mosaic("WSS;WRG", width_ratios=[1.9, 1.0, 1.0])
    draw_world(
        axes["W"], polygons, pose, radius=float(read("robot_radius")), goal=world.robot_goal, humans=humans,
        scan=metres, trail=dataset.read("robot_pose", shard, start, row + 1)[:, :2],
    )  # fmt: skip
    axes["W"].set_title("the world: robot red, goal a star, people pale where not seen", fontsize=9)
    draw_scan(axes["S"], metres)
    axes["S"].set_title("$s_l$ as 1D: 1080 ranges [m]", fontsize=9)
    draw_rings(axes["R"], scan_to_rings(scan))
    axes["R"].set_title("$s_l$ as rings: 64 x 64", fontsize=9)
    _draw_robot_state(axes["G"], robot_state)
    return figure


def _draw_robot_state(ax: Any, robot_state: np.ndarray[Any, Any]) -> None:
    """Draw goal and velocity in the robot's frame, ahead = up."""
    goal, velocity = robot_state[:2], robot_state[2:4]
    reach = 1.15 * max(1.0, float(np.abs(goal).max()))
    # x is ahead and y to the left, so that up and left are what they are for the robot
    ax.plot([0], [0], "o", color="#d1495b", markersize=8)
    ax.plot([-goal[1]], [goal[0]], "*", color="#3a7d44", markersize=13)
    ax.plot([0, -goal[1]], [0, goal[0]], color="#3a7d44", linewidth=1.0)
    scale = reach / 2.0
    ax.annotate(
        "", (-velocity[1] * scale, velocity[0] * scale), (0, 0), arrowprops={"arrowstyle": "->", "color": "#1d3557"}
    )
    text = f"goal ({goal[0]:.1f}, {goal[1]:.1f}) m\nv ({velocity[0]:.2f}, {velocity[1]:.2f}) m/s\n"
    text += f"omega {robot_state[4]:.2f} rad/s"
    ax.text(0.03, 0.03, text, transform=ax.transAxes, fontsize=7.5, va="bottom")
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_title("$s_r$: goal and velocity, ahead is up", fontsize=9)
