"""Several robots in one world, each driven by the same policy: in the CrowdMove environments, or any other.

python examples/several_robots.py --robots 6 --humans 5 --out robots.gif

Observations and actions have a leading axis of robots; the episode is joint and ends for all when it ends for one.
"""

import argparse

import gymnasium
import numpy as np
from own_policy import careful

from navrep_data.envs import record


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="NavRepTrain", help="as in the README's table, for example CrowdMove1")
    parser.add_argument("--robots", type=int, default=6)
    parser.add_argument("--humans", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", help="write the first episode there (.gif)")
    arguments = parser.parse_args()

    settings = {} if arguments.env.startswith("CrowdMove") else {"humans": arguments.humans, "curriculum": "constant"}
    env = gymnasium.make(f"navrep_data:{arguments.env}-v0", robots=arguments.robots, **settings)
    for k in range(arguments.episodes):
        observation, info = env.reset(seed=arguments.seed + k)
        total, over, steps = np.zeros(arguments.robots), False, 0
        while not over:
            # scan (robots, 1080), robot_state (robots, 5) -> action (robots, 3)
            observation, _, terminated, truncated, info = env.step(careful(**observation))
            total += info["rewards"]
            over, steps = terminated or truncated, steps + 1
        print(f"episode {k}: {info['event']} after {steps} steps; rewards {np.round(total, 1).tolist()}")
    if arguments.out:
        film = record(env, careful, arguments.out, seed=arguments.seed)
        print(f"{film.path}: {film.steps} steps")


if __name__ == "__main__":
    main()
