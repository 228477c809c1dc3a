"""How generating scales over processes and over Ray, and what manifests of very large datasets cost.

    python benchmarks/scale.py [--quick] [--only scaling|manifests] [--json] [--write]

The same dataset is made in turns by one and two local processes and by one and two tasks of a Ray cluster that runs
already (one node of this machine, processes started for each run, as for the local ones). Bytes are compared too.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness import ONE_THREAD, machine, ratio, run_child, spread
from report import describe, number, table, write_section

RUNS = {"local, 1 process": ("local", 1), "local, 2 processes": ("local", 2), "ray, 1 task": ("ray", 1),
        "ray, 2 tasks": ("ray", 2)}  # fmt: skip
BASES = {"local, 2 processes": "local, 1 process", "ray, 1 task": "local, 1 process",
         "ray, 2 tasks": "local, 2 processes"}  # fmt: skip
LENGTH = 1000
STORE_BYTES = 100 << 20
# A billion rows: in shards of the default size, and of the size that generate then asks for or more.
MANIFESTS = ((20, 50_000), (200, 5_000))
INTRODUCTION = """## Scaling

{machine}

`benchmarks/scale.py`: {n} sequences of {length:,} rows, {turns} turns; rows per second of wall time from the first task
to the finished manifest, starting processes included, starting Ray's own daemons not. The ratio is within a turn.
"""

MANIFESTS_INTRODUCTION = """## Manifests of a billion rows

{machine}

`benchmarks/scale.py`: entries of a real shard, repeated.
"""


@contextmanager
def ray_node() -> Iterator[str]:
    """Run a Ray cluster of one node with two processors; yields its address."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True,
        head_node_args={
            "num_cpus": 2,
            "object_store_memory": STORE_BYTES,
            "include_dashboard": False,
        },
    )
    try:
        yield cluster.address
    finally:
        cluster.shutdown()


def generate(name: str, n: int, out: Path, address: str) -> dict[str, Any]:
    """Make the dataset in a fresh process; returns what ``generate --json`` prints."""
    executor, workers = RUNS[name]
    words = ["--n", str(n), "--length", str(LENGTH), "--workers", str(workers), "--out", str(out), "--json"]
    words += ["--executor", "ray", "--address", address] if executor == "ray" else []
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "navrep_data", "generate", *words],
        env={**os.environ, **ONE_THREAD}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise RuntimeError(f"{name}: {done.stderr.strip().splitlines()[-1]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return {**found, "wall": time.perf_counter() - begun, "manifest": (out / "manifest.json").read_bytes()}


def scaling(n: int, turns: int) -> list[dict[str, Any]]:
    """Return a row per way of running."""
    speeds: dict[str, list[float]] = {name: [] for name in RUNS}
    walls: dict[str, list[float]] = {name: [] for name in RUNS}
    manifests = set()
    with ray_node() as address:
        for turn in range(turns):
            for name in RUNS:
                print(f"turn {turn + 1} of {turns}: {name} ...", file=sys.stderr, flush=True)
                with tempfile.TemporaryDirectory() as folder:
                    found = generate(name, n, Path(folder) / "d", address)
                speeds[name].append(found["rows_per_s"])
                walls[name].append(found["wall"])
                manifests.add(found["manifest"])
    if len(manifests) != 1:
        raise RuntimeError("The datasets differ, expected the same bytes from every way of running.")
    rows = []
    for name in RUNS:
        base = BASES.get(name)
        rows.append({
            "key": name, **spread(speeds[name]), "whole": spread(walls[name])["median"], "reference": base,
            "ratio": None if base is None else ratio(speeds[name], speeds[base]),
        })  # fmt: skip
    return rows


def manifest_of_a_billion(size: int, shards: int) -> dict[str, Any]:
    """Return bytes and seconds of a manifest of so many shards, copies of one that was made."""
    import resource

    from navrep_data.generate import generate as make
    from navrep_data.io import read_json
    from navrep_data.shards import FileEntry, Manifest, shard_file, worlds_file

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "d"
        make(n=size, length=20, shard_size=size, out=root)
        small = Manifest.read(root)
        entry = small.shards[0]
        assert entry.worlds is not None
        worlds = entry.worlds
        entries = [
            replace(
                entry, file=shard_file("train", k), sequences=((k * size, k * size + entry.count),),
                worlds=FileEntry(worlds_file("train", k), worlds.sha256, worlds.bytes),
            )
            for k in range(shards)
        ]  # fmt: skip
        begun = time.perf_counter()
        many = replace(small, planned=size * shards, split_rule="all are train")
        many.with_shards(entries, complete=False).save(root)
        saved = time.perf_counter() - begun
        n_bytes = (root / "manifest.json").stat().st_size
        begun = time.perf_counter()
        read_json(root / "manifest.json", max_bytes=n_bytes)
        read = time.perf_counter() - begun
    return {
        "key": f"{shards:,} shards of {size} sequences", "bytes": n_bytes, "save": saved, "read": read,
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }  # fmt: skip


def scaling_section(n: int, turns: int) -> tuple[str, list[dict[str, Any]]]:
    """Measure the ways of running; return text and figures."""
    where = machine()
    rows = scaling(n, turns)
    text = INTRODUCTION.format(machine=describe(where), n=n, length=LENGTH, turns=turns) + "\n"
    text += table(
        ("run", "rows/s", "spread", "whole command, s", "compared with", "ratio"),
        [[r["key"], number(r["median"]), f"{number(r['low'])} to {number(r['high'])}", f"{r['whole']:.1f}",
          r["reference"] or "-", "-" if r["ratio"] is None else f"{r['ratio']:.3g}"] for r in rows],
    )  # fmt: skip
    return text, rows


def manifests_section() -> tuple[str, list[dict[str, Any]]]:
    """Measure manifests; return text and figures."""
    where = machine()
    rows = [run_child([Path(__file__), "--child", str(k)]) for k in range(len(MANIFESTS))]
    text = MANIFESTS_INTRODUCTION.format(machine=describe(where)) + "\n"
    text += table(
        ("manifest", "MB", "merge statistics and save, s", "parse, s", "peak memory, GB"),
        [[m["key"], f"{m['bytes'] / 1e6:.0f}", f"{m['save']:.1f}", f"{m['read']:.1f}", f"{m['peak'] / 1e9:.2f}"]
         if "error" not in m else [m["error"], *["-"] * 4] for m in rows],
    )  # fmt: skip
    return text, rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer sequences, one turn")
    parser.add_argument("--only", choices=("scaling", "manifests"), help="measure this alone")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    parser.add_argument("--write", action="store_true", help="update benchmarks/RESULTS.md")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        print(json.dumps(manifest_of_a_billion(*MANIFESTS[options.child])))
        return 0
    # ten shards: five for each of two; fewer would measure little but the start of processes
    sizes = (40, 1) if options.quick else (200, 2)
    sections = {}
    if options.only != "manifests":
        sections["scaling"] = scaling_section(*sizes)
    if options.only != "scaling":
        sections["manifests"] = manifests_section()
    for name, (text, _) in sections.items():
        if options.write:
            write_section(f"scale.py {name}", text)
        if not options.json:
            print(text, end="\n\n")
    figures = {name: rows for name, (_, rows) in sections.items()}
    if options.json:
        print(json.dumps({"benchmark": "scale", "quick": options.quick, **figures}))
    return int(any("error" in row for rows in figures.values() for row in rows))


if __name__ == "__main__":
    sys.exit(main())
