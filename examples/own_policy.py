"""Drive a robot with a policy of your own, count how its episodes end, and film one of them.

python examples/own_policy.py --env NavRepTest --episodes 50 --film episode.gif
"""

import argparse
from collections import Counter

import gymnasium
import numpy as np

from navrep_data.envs import record
from navrep_data.schema import Event


def careful(scan: np.ndarray, robot_state: np.ndarray) -> np.ndarray:
    """Drive to the goal, pushed aside by what is near.

    Works for one robot and for a batch: scan (..., 1080) [m], robot_state (..., 5) -> action (..., 3) in [-1, 1]. So
    `navrep-data benchmark own_policy:careful` plays it, and `generate --policy own_policy:careful` records it.
    """
    goal = robot_state[..., :2] / np.maximum(np.linalg.norm(robot_state[..., :2], axis=-1, keepdims=True), 1.0)
    bearing = np.linspace(0.0, 2 * np.pi, scan.shape[-1], endpoint=False)
    # every ray pushes away from what it hits within 1.5 m, the nearer the stronger
    strength = np.clip(1.5 - scan, 0.0, None) ** 2
    push = -np.stack([strength * np.cos(bearing), strength * np.sin(bearing)], axis=-1).mean(axis=-2)
    velocity = goal + 6.0 * push
    velocity /= np.maximum(np.linalg.norm(velocity, axis=-1, keepdims=True), 1.0)
    return np.concatenate([velocity, np.zeros_like(velocity[..., :1])], axis=-1).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="NavRepTest", help="as in the README's table")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--worlds", type=int, default=10, help="how many are played at once")
    parser.add_argument("--film", help="write the first episode there (.gif)")
    arguments = parser.parse_args()

    name = f"navrep_data:{arguments.env}-v0"
    env = gymnasium.make_vec(name, num_envs=arguments.worlds, vectorization_mode="vector_entry_point")
    observations, _ = env.reset(seed=1000)
    endings: Counter[str] = Counter()
    # each world plays the same number of episodes: whoever finishes first must not count more often
    left = np.full(arguments.worlds, -(-arguments.episodes // arguments.worlds))
    while left.any():
        observations, _, _, _, infos = env.step(careful(**observations))
        for i in np.flatnonzero(infos.get("_final_info", np.zeros(arguments.worlds, bool)) & (left > 0)):
            endings[Event(infos["final_info"]["event"][i]).label] += 1
            left[i] -= 1
    total = sum(endings.values())
    print(f"{total} episodes: " + ", ".join(f"{event} {100 * n / total:.0f} %" for event, n in endings.most_common()))
    if arguments.film:
        film = record(gymnasium.make(name), careful, arguments.film, seed=1000)
        print(f"{film.path}: {film.event} after {film.steps} steps")


if __name__ == "__main__":
    main()
