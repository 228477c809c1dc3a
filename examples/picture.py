"""Draw a world of a dataset with its scan and rings, as in figure 1 of the paper.

python examples/picture.py data/demo --out docs/images/state.png
"""

import argparse

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from navrep_data.observations import metres_from_millimetres, scan_to_rings
from navrep_data.shards import DatasetFolder
from navrep_data.sim.drawing import draw_rings, draw_scan, draw_world


def to_world(humans: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Turn the humans column (robot frame) to the world frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    turned = humans.astype(float).copy()
    turned[:, :2] = humans[:, :2] @ turn.T + pose[:2]
    turned[:, 2:4] = humans[:, 2:4] @ turn.T
    return turned


def longest_goal_episode(folder: DatasetFolder) -> int:
    """Return the index of the longest episode that reached its goal, or of the longest of all."""
    episodes = folder.episodes
    reached = np.flatnonzero(episodes.event == 1)
    candidates = reached if len(reached) else np.arange(len(episodes))
    return int(candidates[np.argmax(episodes.length[candidates])])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", nargs="?", default="data/demo", help="dataset folder")
    parser.add_argument("--episode", type=int, help="index among all episodes (default: the longest that succeeded)")
    parser.add_argument("--share", type=float, default=0.35, help="how far into the episode, 0 to 1")
    parser.add_argument("--out", default="state.png")
    arguments = parser.parse_args()

    with DatasetFolder(arguments.root) as folder:
        k = longest_goal_episode(folder) if arguments.episode is None else arguments.episode
        episodes = folder.episodes
        shard, start, length = int(episodes.shard[k]), int(episodes.start[k]), int(episodes.length[k])
        row = start + int(arguments.share * (length - 1))

        def read(column: str) -> np.ndarray:
            return folder.read(column, shard, row, row + 1)[0]

        scan, pose = read("scan"), read("robot_pose")
        metres = metres_from_millimetres(scan) if scan.dtype == np.uint16 else scan
        trail = folder.read("robot_pose", shard, start, row + 1)[:, :2]
        worlds = folder.worlds(shard)
        world = worlds.episode(int(np.flatnonzero(worlds.arrays["row"] == start)[0]))
        polygons = [*world.polygons, world.border] if world.border is not None else list(world.polygons)

        figure, axes = plt.subplot_mosaic("WS;WR", figsize=(11, 6), width_ratios=[1.15, 1], layout="constrained")
        draw_world(
            axes["W"], polygons, pose, radius=float(read("robot_radius")), goal=world.robot_goal,
            humans=to_world(read("humans"), pose), scan=metres, trail=trail,
        )  # fmt: skip
        axes["W"].set_title("world: robot (red), humans (pale: not in sight), goal (star)", fontsize=10)
        draw_scan(axes["S"], metres)
        axes["S"].set_title("scan: 1080 ranges", fontsize=10)
        draw_rings(axes["R"], scan_to_rings(scan))
        axes["R"].set_title("rings: 64 x 64, white free, grey unknown, dark occupied", fontsize=10)
        figure.savefig(arguments.out, dpi=110)
        print(f"{arguments.out}: row {row} of shard {shard}, step {row - start} of {length - 1}")


if __name__ == "__main__":
    main()
