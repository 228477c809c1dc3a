"""Simulate robots on a map of your own: a ROS map folder with a YAML file and an image.

python examples/own_map.py path/to/map_folder --film episode.gif
python examples/own_map.py --draw my_map    # writes a small made-up map first

Without a path an office of four rooms is drawn and used.
"""

import argparse
from collections import Counter
from pathlib import Path

import gymnasium
import numpy as np
from own_policy import careful
from PIL import Image, ImageDraw

from navrep_data.envs import record
from navrep_data.sim.maps import load_map

RESOLUTION = 0.05  # metres per pixel
SIZE = 240  # pixels


def draw_map(folder: Path) -> Path:
    """Write a map as map_server does: white free, black occupied; the origin is the lower left corner."""
    folder.mkdir(parents=True, exist_ok=True)
    image = Image.new("L", (SIZE, SIZE), 254)
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, SIZE - 1, SIZE - 1), outline=0, width=4)
    middle, door = SIZE // 2, 36
    for start in (0, middle):  # walls between the rooms, each with a door in its middle
        for low, high in ((start, start + 42), (start + 42 + door, start + middle)):
            draw.rectangle((low, middle - 2, high, middle + 2), fill=0)
            draw.rectangle((middle - 2, low, middle + 2, high), fill=0)
    draw.rectangle((50, 50, 70, 66), fill=0)  # a table
    image.save(folder / "map.pgm")
    (folder / "map.yaml").write_text(
        f"image: map.pgm\nresolution: {RESOLUTION}\norigin: [-6.0, -6.0, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", nargs="?", type=Path, help="folder, or YAML file")
    parser.add_argument("--draw", type=Path, default=Path("my_map"), help="where the made-up map is written")
    parser.add_argument("--humans", type=int, default=4, help="they plan their ways on the map")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--film", type=Path, help="write an episode there (.gif)")
    arguments = parser.parse_args()

    folder = (arguments.map or draw_map(arguments.draw)).resolve()
    grid = load_map(folder)
    free = float(np.mean(grid.free)) * grid.free.size * grid.resolution**2
    print(f"{grid.name}: {grid.shape[0]} x {grid.shape[1]} cells of {grid.resolution} m, {free:.0f} m2 free")

    env = gymnasium.make("navrep_data:Map-v0", maps=(str(folder),), humans=arguments.humans, time_limit=60.0)
    endings: Counter[str] = Counter()
    for k in range(arguments.episodes):
        observation, info = env.reset(seed=k)
        while info["event"] == "none":
            observation, _, _, _, info = env.step(careful(**observation))
        endings[info["event"]] += 1
    print(", ".join(f"{event} {n}" for event, n in endings.items()))
    if arguments.film:
        film = record(env, careful, arguments.film, seed=0, speed=4.0)
        print(f"{film.path}: {film.event} after {film.steps} steps")


if __name__ == "__main__":
    main()
