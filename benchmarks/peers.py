"""Other simulators and formats beside ours: one run, one thread, one scene, the same rows.

    python benchmarks/peers.py [--quick] [--write] [--json]

Peers that are not installed are reported as such; `pip install "navrep-data[peers]"` brings them. Every turn measures
all of them one after the other. ``--write`` puts the tables into benchmarks/RESULTS.md, beside the original's figures.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from harness import ONE_THREAD, PACKAGES, Timing, in_turns, machine, ratio, spread

os.environ.update(ONE_THREAD)  # before numpy and numba are imported

import numpy as np
import peer_loaders as loaders
import scene
from report import describe, number, table, write_section

Result = dict[str, Any]
PEERS = (*PACKAGES, "navground", "ir-sim", "pyrvo", "minari", "gymnasium")
ORIGINAL = (
    ("original NavRep generator, RVO2 as its setup.py builds it", "92 steps/s (70 to 110)"),
    ("original NavRep generator, RVO2 rebuilt with -O3", "252 steps/s (185 to 319)"),
    ("original train environment, 5 humans, random actions", "684 steps/s (908 with -O3)"),
    ("original IAN test environment", "232 to 286 steps/s, 1.65 CPU s per reset"),
    ("original npz, `np.savez_compressed`", "5.7k rows/s at 3.8 kB/row"),
    ("original npz, `np.load` per window", "39 windows/s"),
)


def simulators(folder: Path) -> dict[str, list[tuple[str, Callable[[], Any]]]]:
    """Return what is compared with what: title to (name, maker); the first is ours and the measure of the others."""
    return {
        "20 ORCA agents, 1080-ray lidar, four boxes and a border": [
            ("navrep-data", scene.Ours),
            ("navrep-data, legs", lambda: scene.Ours(legs=True)),
            ("navground", scene.Navground),
            ("ir-sim", lambda: scene.IrSim(folder / "world.yaml")),
        ],
        "20 ORCA agents, 1080-ray lidar, border only": [
            ("navrep-data", lambda: scene.Ours(with_boxes=False)),
            ("navground", lambda: scene.Navground(with_boxes=False)),
        ],
        "20 ORCA agents, four boxes and a border, no lidar": [
            ("navrep-data, ORCA alone", scene.OursOrca),
            ("pyrvo (RVO2 in C++), ORCA alone", scene.PyRvo),
            ("navground, no lidar", lambda: scene.Navground(lidar=False)),
        ],
    }


def build(makers: list[tuple[str, Callable[[], Any]]]) -> tuple[list[Any], list[Result]]:
    """Return what could be made, and a result for what could not."""
    made, missing = [], []
    for name, make in makers:
        try:
            made.append(make())
        except ImportError:
            missing.append({"name": name, "state": "not installed"})
        except Exception as error:  # a peer of another version: say so, and go on with the others
            missing.append({"name": name, "state": f"does not run: {type(error).__name__}: {str(error)[:80]}"})
    return made, missing


def episodes(adapter: Any, seconds: float, timing: Timing) -> None:
    """Run episodes for at least `seconds`; going back to the start is not timed."""
    steps, cpu, wall = 0, 0.0, 0.0
    while wall < seconds:
        adapter.restart()
        began, began_cpu = time.perf_counter(), time.process_time()
        adapter.run(scene.EPISODE)
        wall += time.perf_counter() - began
        cpu += time.process_time() - began_cpu
        steps += scene.EPISODE
    timing.add(steps, cpu, wall)


def compare_simulators(makers: list[tuple[str, Callable[[], Any]]], repeats: int, seconds: float) -> list[Result]:
    """Return a result for each simulator: steps/s per CPU second, ours as a multiple, and how it ended."""
    made, results = build(makers)
    timings = [Timing() for _ in made]
    for adapter in made:
        episodes(adapter, 0.0, Timing())
    for _ in range(repeats):
        for adapter, timing in zip(made, timings, strict=True):
            episodes(adapter, seconds, timing)
    measured = []
    for adapter, timing in zip(made, timings, strict=True):
        left = np.hypot(*(adapter.positions() + scene.starts()).T).mean()
        measured.append(
            {
                "name": adapter.name,
                "state": "measured",
                **spread(timing.cpu),
                "wall": statistics.median(timing.wall),
                "ours_times": ratio(timings[0].cpu, timing.cpu),
                "left": float(left),
                "misses": adapter.misses,
            }
        )
    return measured + results


def compare_loaders(folder: Path, sequences: int, repeats: int, seconds: float) -> list[Result]:
    """Return a result for each way to store the same rows."""
    rows = loaders.Rows(folder, sequences)
    ways: list[tuple[str, str, Callable[[], Any]]] = [
        ("navrep-data, disk", "-", lambda: loaders.ours(rows, preload=False)),
        ("navrep-data, preloaded", "-", lambda: loaders.ours(rows, preload=True)),
        ("np.load of the original's npz", "random access, checks, batches, rings", lambda: loaders.original_npz(rows)),
        ("Minari, HDF5", "windows (reads whole episodes), compression, batches, rings", lambda: loaders.minari(rows)),
    ]
    names = {name: misses for name, misses, _ in ways}
    made, results = build([(name, lambda n=name, m=make: (n, *m())) for name, _, make in ways])
    timings = in_turns([draw for _, draw, _ in made], repeats, seconds)
    measured = [
        {
            "name": name,
            "state": "measured",
            **spread(timing.cpu),
            "wall": statistics.median(timing.wall),
            "ours_times": ratio(timings[0].cpu, timing.cpu),
            "bytes_per_row": stored / (sequences * 1000),
            "misses": names[name],
        }
        for (name, _, stored), timing in zip(made, timings, strict=True)
    ]
    return measured + results


def cells(result: Result, unit: str, extra: str) -> list[str]:
    """Return one result as cells of its table."""
    if result["state"] != "measured":
        return [result["name"], result["state"], *["-"] * 4]
    between = f"{number(result['low'])} to {number(result['high'])}"
    return [
        result["name"], f"{number(result['median'])} {unit}", between, f"{result['ours_times']:.3g}",
        number(result.get(extra)), result["misses"],
    ]  # fmt: skip


def tables(found: dict[str, list[Result]], where: dict[str, Any]) -> str:
    """Return the Markdown of everything."""
    parts = [
        "## Beside others",
        describe(where),
        'One thread, per CPU second; "ours, times" is the first row divided by this row.',
    ]
    for title, results in found.items():
        loading = "windows" in title
        unit, extra = ("windows/s", "bytes_per_row") if loading else ("steps/s", "left")
        last = "B/row" if loading else "left to go [m]"
        header = ("system", "measured", "spread", "ours, times", last, "does not do")
        parts += [f"### {title}", table(header, [cells(result, unit, extra) for result in results])]
    parts += [
        f"\"Left to go\": mean distance to the goal after {scene.EPISODE} steps, to see that all simulate the same. "
        "navground handles no collisions here and pyrvo gets new preferred velocities every ten steps, both in their "
        "favour; ir-sim's ORCA does not see obstacles.",
        "### The original, measured before on another machine (2 vCPU Xeon with AVX-512, per core)",
        table(("system", "figure"), ORIGINAL),
        "Source: performance notes of this project; 20 ORCA humans and a 1080-ray lidar unless said otherwise. It does "
        "not do: seeded data, resuming, compression beyond npz, windows without loading whole files, Python above 3.6.",
    ]  # fmt: skip
    return "\n\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="shorter turns and a smaller dataset")
    parser.add_argument("--write", action="store_true", help="update benchmarks/RESULTS.md")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    options = parser.parse_args()
    repeats, seconds, sequences = (3, 0.4, 10) if options.quick else (7, 1.5, 50)
    warnings.simplefilter("ignore")  # what peers warn of is not ours to show
    where = machine(PEERS)
    found: dict[str, list[Result]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for title, makers in simulators(Path(folder)).items():
            print(f"measuring {title} ...", file=sys.stderr, flush=True)
            found[title] = compare_simulators(makers, repeats, seconds)
        title = f"Random 32-row windows (scan, state, action, reward) of {sequences} sequences"
        print(f"measuring {title} ...", file=sys.stderr, flush=True)
        found[title] = compare_loaders(Path(folder), sequences, repeats, seconds)
    text = tables(found, where)
    if options.quick:
        text += "\n\nMeasured with --quick: short turns, a small dataset."
    if options.json:
        print(json.dumps({"benchmark": "peers", "quick": options.quick, "machine": where, "results": found}))
    else:
        print(text)
    if options.write:
        write_section("peers.py", text)


if __name__ == "__main__":
    main()
