"""Let a policy drive test episodes among people and film one of them.

python examples/drive.py --policy transformer_rings_z --episode 3 --out drive.gif

`--policy` is any policy of the zoo (navrep-data models) or a folder that navrep-data train wrote. The film shows the
world, with what the lidar sees in yellow; the outcome of the episode is printed.
"""

import argparse

import gymnasium

from navrep_data import zoo
from navrep_data.envs import record


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", default="transformer_rings_z", help="name in the zoo, or ./folder")
    parser.add_argument("--episode", type=int, default=3, help="numbered test episode, 0 to 499")
    parser.add_argument("--source", help="folder with the authors' files, for released policies")
    parser.add_argument("--max-steps", type=int, help="end the film after so many steps of 0.2 s")
    parser.add_argument("--out", default="drive.gif", help=".gif, or .mp4 with imageio-ffmpeg")
    arguments = parser.parse_args()

    policy = zoo.load(arguments.policy, arguments.source)
    env = gymnasium.make("navrep_data:NavRepTest-v0", physics="original", episode=arguments.episode)
    filmed = record(
        env, policy, arguments.out, options={"episode": arguments.episode}, max_steps=arguments.max_steps, speed=2.0
    )
    print(f"{policy.name}: {filmed}")


if __name__ == "__main__":
    main()
