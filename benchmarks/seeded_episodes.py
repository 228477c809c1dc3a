"""Drive released policies through the original's seeded test episodes, in `original` physics.

    python benchmarks/seeded_episodes.py e2e_1d.20201026 transformer_1d_z.20200916 --from DIR \
        [--reference original_scores.json] [--episodes 200] [--json]

Episode k is numpy seed 1000 + k of the original's test environment. With --reference (the outcome and steps of each
episode in the original software) outcomes are compared one by one. The `goal` row drives straight to the goal.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from navrep_data import zoo
from navrep_data.schema import Event
from navrep_data.sim import Simulator, make_config, numpy_seed

LETTERS = {Event.GOAL: "S", Event.COLLISION_HUMAN: "C", Event.COLLISION_OBSTACLE: "C", Event.TIMEOUT: "T"}
ENV = "navrep-test"
Policy = Callable[[np.ndarray, np.ndarray], np.ndarray]


def goal_policy(scan: np.ndarray, robot_state: np.ndarray) -> np.ndarray:
    """Drive straight to the goal at 1 m/s, or what is left to it."""
    goal = robot_state[:, :2]
    velocity = goal / np.maximum(np.linalg.norm(goal, axis=1, keepdims=True), 1.0)
    return np.concatenate([velocity, np.zeros((len(goal), 1), velocity.dtype)], axis=1)


def play(policy: Policy, episodes: int) -> tuple[str, list[int]]:
    """Return one letter (S goal, C collision, T timeout) and the number of steps per episode."""
    sim = Simulator(make_config(ENV, physics="original"), n_worlds=episodes)
    sim.reset_seeded([numpy_seed(ENV, k) for k in range(episodes)])
    if hasattr(policy, "reset"):
        policy.reset(batch_size=episodes)
    outcome, steps = ["?"] * episodes, [0] * episodes
    while "?" in outcome:
        actions = np.clip(policy(*sim.observe()), -1.0, 1.0)
        _, events = sim.step(actions)
        for k in np.flatnonzero(events):
            if outcome[k] == "?":
                outcome[k] = LETTERS[Event(int(events[k]))]
        for k in range(episodes):
            steps[k] += outcome[k] == "?"
    return "".join(outcome), [n + 1 for n in steps]


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Return the Wilson 95 % interval of a share."""
    z, p = 1.959964, successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return float(centre - half), float(centre + half)


def reference_of(record: zoo.Record, path: Path) -> dict | None:
    """Return the original's outcomes for this checkpoint, if it has been run there."""
    files = {Path(f.path).name for f in record.files}
    runs = json.loads(path.read_text())["navreptrain_test"]
    return next((run for key, run in runs.items() if run["zip"] in files and key.endswith("|-")), None)


def measure(name: str, source: str | None, reference: Path | None, episodes: int) -> dict:
    """Return the scores of one policy, and what differs from the original."""
    if name == "goal":
        policy, full, theirs = goal_policy, "goal", None
    else:
        policy = zoo.load(name, source=source)
        full = policy.name
        theirs = reference_of(zoo.show(full), reference) if reference else None
    outcome, steps = play(policy, episodes)
    low, high = wilson(outcome.count("S"), episodes)
    row = {
        "name": full, "suite": "navreptest", "physics": "original", "episodes": episodes,
        "success_rate": outcome.count("S") / episodes, "collision_rate": outcome.count("C") / episodes,
        "timeout_rate": outcome.count("T") / episodes, "wilson95_success": [round(low, 3), round(high, 3)],
        "outcome": outcome, "steps": steps,
    }  # fmt: skip
    if theirs:
        other = theirs["outcome"][:episodes]
        row["original_success_rate"] = other.count("S") / len(other)
        row["outcomes_equal"] = sum(a == b for a, b in zip(outcome, other, strict=True)) / episodes
        row["steps_equal"] = sum(a == b for a, b in zip(steps, theirs["steps"], strict=False)) / episodes
        row["different"] = [
            {"episode": k, "ours": outcome[k], "original": other[k], "steps": [steps[k], theirs["steps"][k]]}
            for k in range(episodes)
            if outcome[k] != other[k]
        ]
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+", help="model names, or goal")
    parser.add_argument("--from", dest="source", help="folder with the released files")
    parser.add_argument("--reference", type=Path, help="original_scores.json")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = [measure(name, arguments.source, arguments.reference, arguments.episodes) for name in arguments.names]
    if arguments.json:
        print(json.dumps({"results": rows}, indent=1))
        return
    for row in rows:
        line = f"{row['name']:32s} success {100 * row['success_rate']:5.1f} % of {row['episodes']}"
        if "outcomes_equal" in row:
            line += f" (original {100 * row['original_success_rate']:.1f} %)"
            line += (
                f", outcomes equal {100 * row['outcomes_equal']:.1f} %, steps equal {100 * row['steps_equal']:.1f} %"
            )
        print(line)
        for d in row.get("different", []):
            ours, theirs = d["steps"]
            print(f"  episode {d['episode']}: ours {d['ours']} after {ours}, original {d['original']} after {theirs}")


if __name__ == "__main__":
    main()
