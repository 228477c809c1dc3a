"""Steps per second of the gymnasium environments, vectorised, beside the same environment stepped singly.

    python benchmarks/envs.py [--quick] [--only ID ...] [--worlds N] [--json] [--write]

Each environment runs in a fresh process with one thread: 256 worlds under random actions, scans, infos, automatic
resets and last observations included, in turns with a single environment that is reset by hand. The exit code is 1 if
an environment is slower than it has to be.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from harness import in_turns, machine, ratio, run_child, spread
from report import describe, number, table, write_section

# steps/s per core that part 5 asks for, and seconds per reset once a map is cached
MUST = {"NavRepTrain-v0": 40e3, "IAN-v0": 10e3}
MUST_RESET = {"IAN-v0": 5e-3}
# with random actions the curriculum would make the worlds ever easier
SETTINGS = {"NavRepTrain-v0": {"curriculum": "constant"}}
ALWAYS = ("NavRepTrain-v0", "NavRepTest-v0", "SOADRL-v0")
SEEDS = 64
HEADER = ("environment", "worlds", "vectorised, steps/s", "spread", "per wall s", "must", "verdict", "singly, steps/s",
          "ratio", "reset, ms", "must")  # fmt: skip
INTRODUCTION = """## Environments

{machine}

`benchmarks/envs.py`: steps per second of CPU time of one core under random actions, scans, infos and automatic resets
included (NavRepTrain at its greatest difficulty); singly = the same environment, one world, in turns. Reset = of a
single environment, median. The verdict is on both.
"""


def known() -> list[str]:
    """Return the ids of all environments that can be made here."""
    from navrep_data.registration import ENVIRONMENTS
    from navrep_data.sim import gymnasium_id

    return [gymnasium_id(env) for env in ENVIRONMENTS]


def vectorised(name: str, worlds: int) -> Callable[[], float]:
    """Return work that steps many worlds ten times."""
    import gymnasium
    import numpy as np

    env: Any = gymnasium.make_vec(
        f"navrep_data:{name}", num_envs=worlds, vectorization_mode="vector_entry_point", **SETTINGS.get(name, {})
    )
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = [rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32) for _ in range(10)]

    def work() -> float:
        for action in actions:
            env.step(action)
        return 10 * worlds

    return work


def singly(name: str) -> Callable[[], float]:
    """Return work that steps one world two hundred times."""
    import gymnasium
    import numpy as np

    env: Any = gymnasium.make(f"navrep_data:{name}", disable_env_checker=True, **SETTINGS.get(name, {}))
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (200, *env.action_space.shape)).astype(np.float32)

    def work() -> float:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return len(actions)

    return work


def reset_seconds(name: str) -> float:
    """Return the median time of a reset [s], after each episode has been played once."""
    import gymnasium

    env: Any = gymnasium.make(f"navrep_data:{name}", disable_env_checker=True, **SETTINGS.get(name, {}))
    times = []
    for turn in range(2):
        for seed in range(SEEDS):
            started = time.perf_counter()
            env.reset(seed=seed)
            if turn:
                times.append(time.perf_counter() - started)
    return statistics.median(times)


def measure(name: str, worlds: int, repeats: int, seconds: float) -> dict[str, Any]:
    """Return the figures of one environment."""
    many, one = in_turns([vectorised(name, worlds), singly(name)], repeats, seconds)
    figures = spread(many.cpu)
    reset = reset_seconds(name)
    slow = figures["median"] < MUST.get(name, 0.0) or reset > MUST_RESET.get(name, float("inf"))
    asked = name in MUST or name in MUST_RESET
    return {
        "key": name, "worlds": worlds, "value": figures["median"], "low": figures["low"], "high": figures["high"],
        "wall": spread(many.wall)["median"], "must": MUST.get(name), "verdict": ("FAIL" if slow else "pass") if asked
        else "-", "reference": "single environment", "reference_value": spread(one.cpu)["median"],
        "ratio": ratio(many.cpu, one.cpu), "reset": reset, "must_reset": MUST_RESET.get(name),
    }  # fmt: skip


def cells(row: dict[str, Any]) -> list[str]:
    """Return a row as the cells of the table."""
    if "error" in row:
        return [row["key"], row["error"], *["-"] * 4, "FAIL", *["-"] * 4]
    return [
        row["key"], str(row["worlds"]), number(row["value"]), f"{number(row['low'])} to {number(row['high'])}",
        number(row["wall"]), number(row["must"]), row["verdict"], number(row["reference_value"]),
        f"{row['ratio']:.3g}", f"{1e3 * row['reset']:.2f}", number(row["must_reset"] and 1e3 * row["must_reset"]),
    ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="shorter turns")
    parser.add_argument("--only", nargs="+", metavar="ID", help="gymnasium ids; default those with a target, and a few")
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    parser.add_argument("--write", action="store_true", help="update benchmarks/RESULTS.md")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    repeats, seconds = (3, 0.4) if options.quick else (5, 1.5)
    if options.child:
        print(json.dumps(measure(options.child, options.worlds, repeats, seconds)))
        return 0
    where = machine()
    rows = []
    for name in options.only or [name for name in known() if name in (*MUST, *ALWAYS)]:
        print(f"measuring {name} ...", file=sys.stderr, flush=True)
        arguments = [Path(__file__), "--child", name, "--worlds", str(options.worlds)]
        rows.append({"key": name, **run_child([*arguments, *(["--quick"] if options.quick else [])])})
    text = INTRODUCTION.format(machine=describe(where)) + "\n" + table(HEADER, map(cells, rows))
    text += "\n\nMeasured with --quick: short turns." if options.quick else ""
    print(json.dumps({"benchmark": "envs", "quick": options.quick, "machine": where, "rows": rows})
          if options.json else text)  # fmt: skip
    if options.write:
        write_section("envs.py", text)
    return int(any("error" in row or row["verdict"] == "FAIL" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
