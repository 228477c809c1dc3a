"""Draw a picture of each environment in one figure, as in the paper's figure of environments.

python examples/gallery.py --out docs/images/gallery.png [--physics original] [--only NavRepTrain IAN ...]

The maps are those of the package asl-pepper-2d-sim, which states no licence; without it, no environments on maps.
"""

import argparse
import math

import gymnasium
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from navrep_data.envs import NavRepEnv, gymnasium_id
from navrep_data.errors import MissingExtraError
from navrep_data.policies import to_goal
from navrep_data.sim import environment_names

# as in the README's table
ORDER = (
    *("navrep-train", "navrep-val", "navrep-test", "soadrl", "cadrl", "empty", "ian", "map"),
    *("mark-train-1", "mark-train-2", "mark-test-1", "mark-test-2"),
)
STEPS, TILE, GAP, TITLE, COLUMNS = 25, 250, 10, 22, 6


def sorted_names() -> list[str]:
    """Return all environments, the paper's own first."""
    names = environment_names()
    return [*(name for name in ORDER if name in names), *(name for name in names if name not in ORDER)]


def title_of(name: str) -> str:
    return gymnasium_id(name).removesuffix("-v0")


def picture(name: str, physics: str | None, seed: int) -> np.ndarray:
    """Return an environment some steps into an episode, (TILE, TILE, 3) uint8."""
    env = gymnasium.make(f"navrep_data:{gymnasium_id(name)}", physics=physics, disable_env_checker=True)
    world = env.unwrapped
    assert isinstance(world, NavRepEnv)
    observation, _ = env.reset(seed=seed)
    frame = world.frame(2 * TILE)
    for _ in range(STEPS):
        observation, _, terminated, truncated, _ = env.step(to_goal(observation["robot_state"]))
        if terminated or truncated:
            break
        frame = world.frame(2 * TILE)
    return np.asarray(Image.fromarray(frame).resize((TILE, TILE), Image.Resampling.LANCZOS))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="gallery.png")
    parser.add_argument("--physics", help="consistent (default) or original")
    parser.add_argument("--seed", type=int, default=1003)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names as in the figure, for example NavRepTrain IAN")
    arguments = parser.parse_args()

    tiles = []
    for name in sorted_names():
        if arguments.only and title_of(name) not in arguments.only:
            continue
        try:
            tiles.append((title_of(name), picture(name, arguments.physics, arguments.seed)))
        except MissingExtraError as error:
            print(f"{title_of(name)} is left out: {error}")
    columns = min(COLUMNS, len(tiles))
    rows = math.ceil(len(tiles) / columns)
    sheet = Image.new("RGB", (columns * (TILE + GAP), rows * (TILE + TITLE)), "white")
    draw = ImageDraw.Draw(sheet)
    for k, (title, tile) in enumerate(tiles):
        x, y = (k % columns) * (TILE + GAP) + GAP // 2, (k // columns) * (TILE + TITLE)
        draw.text((x + TILE / 2, y + TITLE / 2), title, "black", ImageFont.load_default(15), anchor="mm")
        sheet.paste(Image.fromarray(tile), (x, y + TITLE))
    # a palette halves the size; median cut would drop the few red and green pixels
    palette = sheet.quantize(128, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    palette.save(arguments.out, optimize=True)
    print(f"{arguments.out}: {len(tiles)} environments")


if __name__ == "__main__":
    main()
