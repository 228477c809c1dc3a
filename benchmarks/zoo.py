"""Actions per second of released policies on one core, at batch 256, and what bf16 changes in their actions.

    python benchmarks/zoo.py [--source DIR] [--write] [--json]

float32 and bfloat16 run in turns (A B A B ...), in one process with one thread. Scans are those of 256 soadrl worlds.
Weights are the released ones where they are at hand (``--source``, NAVREP_RELEASED_DIR or ../shared/released), made-up
ones otherwise: speed does not depend on them, and the comparison of actions is then left out. ``--write`` puts the
table into benchmarks/RESULTS.md. The exit code is 1 if a row misses its "must".
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from harness import ONE_THREAD, Timing, in_turns, machine, ratio, run_child, spread
from report import describe, number, table, write_section

BATCH = 256
SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "released"
# Part 3: actions per second on one core at this batch size.
MUST = {"transformer_1d_z": 20_000, "joint_1d_z": 20_000, "modular_1d_z": 20_000}
MUST |= {name.replace("1d", "rings"): 5_000 for name in MUST}
MORE = ("e2e_1d", "e2e_rings", "joint_1d_zh", "transformer_1d_zh", "transformer_1d_h")


def scenes(n_batches: int) -> tuple[Any, Any]:
    """Return scans and robot states of 256 worlds at several moments, driven straight to their goals."""
    import numpy as np

    from navrep_data.sim import Simulator, make_config

    simulator = Simulator(make_config("soadrl"), BATCH, seed=1)
    simulator.reset()
    scans, states = [], []
    for _ in range(n_batches):
        for _ in range(5):
            scan, state = simulator.observe()
            towards = state[:, :2] / np.maximum(np.linalg.norm(state[:, :2], axis=1, keepdims=True), 1e-6)
            simulator.step(np.concatenate([towards, np.zeros((BATCH, 1))], axis=1))
        scans.append(scan.copy())
        states.append(state.copy())
    return scans, states


def make_policy(variant: str, source: str | None, dtype: str) -> tuple[Any, bool]:
    """Return a policy, and whether it has released weights."""
    import torch

    from navrep_data import zoo
    from navrep_data.errors import NavrepDataError
    from navrep_data.models import Controller, ControllerConfig, checkpoint
    from navrep_data.zoo.policy import Policy

    if source is not None:
        try:
            return zoo.load(f"{variant}.released", source=source, dtype=dtype), True
        except (NavrepDataError, OSError):
            pass
    torch.manual_seed(0)
    architecture, lidar, *features = variant.split("_")
    if architecture == "e2e":
        return Policy(checkpoint.make("e2e", {"lidar": lidar}), None, lidar, name=variant, dtype=dtype), False
    model = checkpoint.make(architecture, {"lidar": lidar})
    n = 5 + ("z" in features[0]) * model.z_size + ("h" in features[0]) * model.h_size
    network = Controller(ControllerConfig(n))
    return Policy(network, features[0], lidar, None, model, name=variant, dtype=dtype), False


def acting(policy: Any, scans: Any, states: Any) -> Callable[[], float]:
    """Return work that acts on one batch after the other; memories restart every 32 steps, so they never rest."""
    policy.reset(batch_size=BATCH)
    calls = 0

    def work() -> float:
        nonlocal calls
        if calls % 32 == 0:
            policy.reset(batch_size=BATCH)
        policy.act(scans[calls % len(scans)], states[calls % len(scans)])
        calls += 1
        return float(BATCH)

    return work


def same_actions(exact: Any, rounded: Any, scans: Any, states: Any) -> float:
    """Return the share of action components that bf16 leaves as they are (to 1e-3), both fed the same actions."""
    import numpy as np

    equal = []
    for policy in (exact, rounded):
        policy.reset(batch_size=BATCH)
    for scan, state in zip(scans, states, strict=True):
        ours, theirs = rounded.act(scan, state), exact.act(scan, state)
        rounded.observe(theirs)
        equal.append(np.abs(ours - theirs)[:, :2] < 1e-3)
    return float(np.mean(equal))


def measure(variant: str, source: str | None, repeats: int, seconds: float) -> dict[str, Any]:
    """Return one row: actions per CPU second in bf16, in float32, and what bf16 changes."""
    import torch

    torch.set_num_threads(1)
    scans, states = scenes(8)
    exact, released = make_policy(variant, source, "float32")
    rounded, _ = make_policy(variant, source, "bfloat16")
    ours, other = in_turns([acting(p, scans, states) for p in (rounded, exact)], repeats, seconds)
    assert isinstance(ours, Timing)
    bf16, f32 = spread(ours.cpu), spread(other.cpu)
    return {
        "variant": variant,
        "value": bf16["median"],
        "low": bf16["low"],
        "high": bf16["high"],
        "wall": spread(ours.wall)["median"],
        "float32": f32["median"],
        "ratio": ratio(ours.cpu, other.cpu),
        "must": MUST.get(variant),
        "released_weights": released,
        "same_actions": same_actions(exact, rounded, scans, states) if released else None,
    }


HEADER = (
    "policy",
    "actions/s, bf16",
    "spread",
    "must",
    "verdict",
    "actions/s, float32",
    "ratio",
    "actions bf16 leaves",
)
INTRODUCTION = """## Policies of the zoo

{machine}

`policy.act` from raw scans, batches of {batch}, one thread: median over turns, per second of CPU time. bf16 is asked
for by `zoo.load(..., dtype="bfloat16")`. The last column is the share of action components that it changes by less
than 1e-3.
"""


def verdict(row: dict[str, Any]) -> str:
    """Return whether a row reaches what it must."""
    if "error" in row:
        return "FAIL"
    if row["must"] is None:
        return "-"
    return "pass" if row["value"] >= row["must"] else "FAIL"


def show(row: dict[str, Any]) -> list[str]:
    """Return a measured row as the cells of the table."""
    if "error" in row:
        return [row["variant"], *["-"] * 3, "FAIL", *["-"] * 2, row["error"]]
    same = "- (made-up weights)" if row["same_actions"] is None else f"{100 * row['same_actions']:.2f} %"
    return [
        row["variant"], number(row["value"]), f"{number(row['low'])} to {number(row['high'])}", number(row["must"]),
        verdict(row), number(row["float32"]), f"{row['ratio']:.2f}", same,
    ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = os.environ.get("NAVREP_RELEASED_DIR") or (str(SHARED) if SHARED.is_dir() else None)
    parser.add_argument("--source", default=known, help="folder of the released files")
    parser.add_argument("--only", nargs="+", default=[*MUST, *MORE], metavar="VARIANT")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--write", action="store_true", help="update benchmarks/RESULTS.md")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(measure(args.child, args.source, args.repeats, args.seconds)))
        return 0
    where = machine()
    rows = []
    for variant in args.only:
        print(f"measuring {variant} ...", file=sys.stderr, flush=True)
        options = ["--child", variant, "--repeats", str(args.repeats), "--seconds", str(args.seconds)]
        if args.source:
            options += ["--source", args.source]
        rows.append({"variant": variant, **run_child([Path(__file__), *options], **ONE_THREAD)})
    if args.json:
        print(json.dumps({"machine": where, "batch": BATCH, "rows": rows}))
    else:
        text = INTRODUCTION.format(machine=describe(where), batch=BATCH) + "\n" + table(HEADER, map(show, rows))
        print(text)
        if args.write:
            write_section("zoo.py", text)
    return int(any(verdict(row) == "FAIL" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
