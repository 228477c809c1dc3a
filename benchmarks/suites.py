"""How long the suite navrep27 takes on two cores, by policy; start-up and loading of kernels and maps included."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from harness import cores, run_tree

POLICIES = ("goal", "orca", "dwa")
FULL = 300


def played(out: Path, rounds: int, workers: int) -> dict[str, float]:
    """Return the wall time [s] that each policy took."""
    options = [
        "--suite",
        "navrep27",
        "--episodes",
        rounds,
        "--workers",
        workers,
        "--out",
        out,
        "--no-figures",
        "--json",
    ]
    run = run_tree([sys.executable, "-m", "navrep_data", "benchmark", *POLICIES, *map(str, options)])
    seconds: dict[str, float] = json.loads(run.stdout)["seconds"]
    return seconds


def navrep27(effort: Any) -> list[dict[str, Any]]:
    """Measure the whole suite, or a tenth of it scaled where `effort` is small."""
    rounds = FULL if effort.big >= 1000 else FULL // 10
    workers = min(2, cores())
    with tempfile.TemporaryDirectory() as folder:
        played(Path(folder) / "warm", 1, workers)  # compiles, solves goal fields
        seconds = played(Path(folder) / "out", rounds, workers)
    scale = FULL / rounds
    note = f"{workers} workers, {27 * rounds:,} episodes"
    if scale != 1:
        note += f"; SCALED x{scale:g}, start-up too"
    return [
        {
            "key": f"navrep27-{name}", "value": scale * seconds[name], "low": scale * seconds[name],
            "high": scale * seconds[name], "reference": "`goal`", "reference_value": scale * seconds["goal"],
            "ratio": seconds[name] / seconds["goal"], "note": note,
        }
        for name in POLICIES
    ]  # fmt: skip
