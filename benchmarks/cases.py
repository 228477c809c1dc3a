"""The measurements of run.py: each function returns rows; those named in CASES run in a process of their own.

A row is a dictionary: `key` (of targets.py), `value` with `low` and `high` (what is judged), `wall` where that
differs, `reference` (name), `reference_value`, `ratio` (ours / reference, within turns), `note`.
"""

from __future__ import annotations

import itertools
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from harness import Timing, cores, in_turns, ratio, run_tree, spread
from suites import navrep27

Row = dict[str, Any]
GENERATE = [sys.executable, "-m", "navrep_data", "generate", "--env", "soadrl", "--json"]
LENGTH = 1000
WORLDS = 64
BATCH = 64


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    Attributes
    ----------
    repeats : int
        Turns.
    seconds : float
        Least time of one figure in one turn [s].
    core, sequences : int
        Sequences of 1000 rows of a run with one worker, and of the dataset of the windows.
    big, small : int
        Sequences of the large and of the small ``generate`` run.
    turns : int
        How often the large run is made.
    """

    repeats: int = 5
    seconds: float = 1.5
    core: int = 40
    sequences: int = 100
    big: int = 1000
    small: int = 100
    turns: int = 2


QUICK = Effort(repeats=3, seconds=0.4, core=20, sequences=20, big=100, small=40, turns=1)


def rate_row(key: str, ours: Timing, other: Timing, reference: str, note: str = "", judge: str = "cpu") -> Row:
    """Return a row of units per second; judged by CPU time, or by the slower of the two clocks."""
    judged, theirs = ours.cpu, other.cpu
    if judge == "slower":
        judged = [min(pair) for pair in zip(ours.cpu, ours.wall, strict=True)]
        theirs = [min(pair) for pair in zip(other.cpu, other.wall, strict=True)]
    figures = spread(judged)
    return {
        "key": key,
        "value": figures["median"],
        "low": figures["low"],
        "high": figures["high"],
        "wall": spread(ours.wall)["median"],
        "reference": reference,
        "reference_value": spread(theirs)["median"],
        "ratio": ratio(judged, theirs),
        "note": note,
    }


def plain_row(key: str, values: Sequence[float], reference: str, others: Sequence[float], note: str = "") -> Row:
    """Return a row of anything else (seconds, bytes)."""
    figures, theirs = spread(values), spread(others)
    return {
        "key": key,
        "value": figures["median"],
        "low": figures["low"],
        "high": figures["high"],
        "reference": reference,
        "reference_value": theirs["median"],
        "ratio": figures["median"] / theirs["median"],
        "note": note,
    }


# --- in one process and thread each -----------------------------------------------------------------------------


def simulate(effort: Effort) -> list[Row]:
    """Measure steps per second of the simulator, rows in memory, beside RVO2's own step in the same worlds."""
    from navrep_data.sim import RolloutSettings, ScriptedPolicy, ScriptedRollout, make_config

    def rollout(rings: bool) -> Callable[[], float]:
        made = ScriptedRollout(make_config("soadrl"), RolloutSettings(LENGTH, rings=rings), ScriptedPolicy(), 0)
        numbers = itertools.count()

        def work() -> float:
            made.run([next(numbers)])
            return LENGTH

        return work

    bare, with_rings, other = in_turns(
        [rollout(False), rollout(True), crowd_of_rvo2(8)], effort.repeats, effort.seconds
    )
    reference = "pyrvo, doStep alone"
    note = "scan, state, reward, humans; resets included"
    return [
        rate_row("simulate", bare, other, reference, note),
        rate_row("simulate-rings", with_rings, other, reference, note + "; rings too"),
    ]


def crowd_of_rvo2(worlds: int, steps: int = 100) -> Callable[[], float]:
    """Return work that steps the humans of soadrl worlds by RVO2, in C++; goals are set anew every ten steps.

    Where pyrvo is not installed, raises ImportError.
    """
    from references import Rvo2

    from navrep_data.sim import Simulator, make_config

    drawn = Simulator(make_config("soadrl"), worlds)
    scenes = []
    for w in range(worlds):
        state = drawn.state(w)
        h = state.humans
        agents = np.column_stack([h[:, 0:2], h[:, 5:7], h[:, 7] + 0.01, h[:, 8]])
        scenes.append(Rvo2(agents, state.polygons))
    turn = itertools.cycle(scenes)

    def work() -> float:
        scene = next(turn)
        scene.restart()
        for step in range(steps):
            if step % 10 == 0:
                scene.aim()
            scene.sim.do_step()
        return steps

    return work


def lidar(effort: Effort) -> list[Row]:
    """Measure scans per second of 64 soadrl worlds with walking people, beside numpy without any cleverness."""
    from references import brute_lidar

    from navrep_data.sim import Simulator, make_config

    simulator = Simulator(make_config("soadrl"), WORLDS)
    for _ in range(20):
        simulator.step(np.zeros((WORLDS, 3)))
    contract = simulator.config.sensor
    states = [simulator.state(w) for w in range(WORLDS)]
    scans, _ = simulator.observe()
    wrong = np.mean([np.abs(brute_lidar(s, contract) - scan) > 1e-3 for s, scan in zip(states, scans, strict=True)])
    if wrong > 1e-3:  # rays along an edge or a rim may differ, others not
        raise RuntimeError(f"{wrong:.2%} of rays differ from brute force, expected fewer than 0.1 %: fix that first")
    turn = itertools.cycle(states)

    def ours() -> float:
        simulator.observe()
        return WORLDS

    def brute() -> float:
        brute_lidar(next(turn), contract)
        return 1

    a, b = in_turns([ours, brute], effort.repeats, effort.seconds)
    return [rate_row("lidar", a, b, "numpy brute force", "Simulator.observe: legs, scan, robot state")]


def rings(effort: Effort) -> list[Row]:
    """Measure rings per second from stored scans, beside compiled loops."""
    from references import loop_rings

    from navrep_data.observations import scan_to_rings
    from navrep_data.observations.rings import RING_EDGES, first_rays

    scans = sequence_of_rows()["scan"]
    out, check = np.empty((len(scans), 64, 64), np.uint8), np.empty((len(scans), 64, 64), np.uint8)
    lower, first = RING_EDGES[:-1].copy(), first_rays(scans.shape[1]).copy()
    loop_rings(scans, lower, first, check)
    if not np.array_equal(scan_to_rings(scans, out), check):
        raise RuntimeError("rings differ from the loops': fix that first")

    def ours() -> float:
        scan_to_rings(scans, out)
        return len(scans)

    def loops() -> float:
        loop_rings(scans, lower, first, check)
        return len(scans)

    a, b = in_turns([ours, loops], effort.repeats, effort.seconds)
    return [rate_row("rings", a, b, "the original's loops, by numba", "scan_to_rings of uint16 scans")]


def sequence_of_rows(scan_dtype: str = "uint16") -> dict[str, np.ndarray]:
    """Return the columns of one soadrl sequence; scans in millimetres, or in metres for float32."""
    from navrep_data.sim import RolloutSettings, ScriptedPolicy, ScriptedRollout, make_config

    rollout = ScriptedRollout(make_config("soadrl"), RolloutSettings(LENGTH, scan_dtype), ScriptedPolicy(), 0)
    ((columns, _),) = rollout.run([0])
    return {name: values.copy() for name, values in columns.items()}


def generate_core(effort: Effort) -> list[Row]:
    """Measure rows per second to finished shards with one worker, beside the original's way to write such rows."""
    from references import original_npz

    from navrep_data.generate import generate

    columns = sequence_of_rows("float32")
    with tempfile.TemporaryDirectory() as folder:
        numbers = itertools.count()

        def ours() -> float:
            out = Path(folder) / str(next(numbers))
            return float(generate("soadrl", effort.core, out, workers=1).new_rows)

        def npz() -> float:
            (Path(folder) / "rows.npz").write_bytes(original_npz(columns))
            return LENGTH

        a, b = in_turns([ours, npz], effort.repeats, effort.seconds)
    note = f"n={effort.core}, all columns, hashed, manifest; compile excluded; the slower of CPU and wall"
    return [rate_row("generate-core", a, b, "np.savez_compressed, writing alone", note, "slower")]


def labels(effort: Effort) -> list[Row]:
    """Measure what it costs to store what each ray hit: rows per second beside those without, and bytes."""
    import h5py

    from navrep_data.generate import generate

    with tempfile.TemporaryDirectory() as folder:
        numbers = itertools.count()

        def make(on: bool) -> Callable[[], float]:
            return lambda: float(generate("soadrl", effort.core, Path(folder) / str(next(numbers)), labels=on).new_rows)

        a, b = in_turns([make(True), make(False)], effort.repeats, effort.seconds)
        shards = list((Path(folder) / "0" / "data").glob("*.h5"))
        sizes = []
        for path in shards:
            with h5py.File(path) as file:
                sizes.append((file["scan_label"].id.get_storage_size(), len(file["scan_label"])))
        stored, rows = map(sum, zip(*sizes, strict=True))
    note = f"n={effort.core}, all columns"
    each = [size / count for size, count in sizes]
    return [
        rate_row("label-speed", a, b, "without labels", note),
        plain_row("label-bytes", each, "one byte per ray", [1080.0], f"{stored / rows:.1f} over {rows:,} rows"),
    ]


def dataset(effort: Effort) -> list[Row]:
    """Measure bytes per row and random windows of one generated dataset."""
    from navrep_data.generate import generate

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "soadrl"
        generate("soadrl", effort.sequences, root)
        return [*sizes(root), *window_rates(root, effort)]


def sizes(root: Path) -> list[Row]:
    """Measure bytes per row of scans, and of everything in the folder."""
    import h5py
    from references import original_npz, zlib_bytes

    from navrep_data.shards import Manifest

    manifest = Manifest.read(root)
    stored = rows = 0
    for entry in manifest.shards:
        with h5py.File(root / entry.file) as file:
            stored += file["scan"].id.get_storage_size()
            rows += len(file["scan"])
    with h5py.File(root / manifest.shards[0].file) as file:
        chunk = file["scan"].chunks[0]
        best = zlib_bytes(file["scan"][:LENGTH], chunk) / LENGTH
    npz = len(original_npz(sequence_of_rows("float32"))) / LENGTH
    whole = sum(path.stat().st_size for path in root.rglob("*") if path.is_file())
    note = f"{rows:,} rows"
    return [
        plain_row("scan-bytes", [stored / rows], "shuffle + zlib level 9", [best], note),
        plain_row(
            "row-bytes",
            [whole / rows],
            "original's npz (float32 scans, no rings, no humans)",
            [npz],
            note + ", whole folder",
        ),
    ]


def window_rates(root: Path, effort: Effort) -> list[Row]:
    """Measure random 32-row windows per second, page cache warm, beside numpy slices of raw files."""
    import torch
    from windows import MemmapWindows, W

    from navrep_data.datasets import SequenceDataset

    torch.set_num_threads(1)
    rows = []
    for kind in ("1d", "rings"):
        disk = SequenceDataset(root, kind, window=W, stride=1)
        memory = SequenceDataset(root, kind, window=W, stride=1, preload=True)
        full = np.flatnonzero(disk.table.count == W)
        for index in np.array_split(full[:: W // 2], max(1, len(full) // (W // 2) // BATCH)):
            disk.batch(index)  # every file is in the page cache from here on
        with tempfile.TemporaryDirectory() as folder:
            raw = MemmapWindows(memory, Path(folder))
            works = [draws(source.batch, full) for source in (disk, memory, raw)]
            a, b, floor = in_turns(works, effort.repeats, effort.seconds)
        note = f"batches of {BATCH}, collated; {effort.sequences * LENGTH:,} rows"
        rows += [
            rate_row(f"windows-disk-{kind}", a, floor, "numpy memmap of raw columns", note, "slower"),
            rate_row(f"windows-memory-{kind}", b, floor, "numpy memmap of raw columns", note),
        ]
    return rows


def draws(batch: Callable[[np.ndarray], object], windows: np.ndarray) -> Callable[[], float]:
    """Return work that reads one batch of random windows."""
    rng = np.random.default_rng(1)

    def work() -> float:
        batch(rng.choice(windows, BATCH))
        return BATCH

    return work


CASES: dict[str, Callable[[Effort], list[Row]]] = {
    "simulate": simulate,
    "generate-core": generate_core,
    "lidar": lidar,
    "rings": rings,
    "labels": labels,
    "dataset": dataset,
}

# --- whole commands, timed from outside -------------------------------------------------------------------------


def generate_wall(effort: Effort) -> list[Row]:
    """Measure wall time and memory of the command, beside one worker and beside little to do."""
    workers = min(2, cores())
    few = 20 * workers  # one shard for each
    big, one, small = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        _command(out, few, workers)  # compiles
        for _ in range(effort.turns):
            big.append(_command(out, effort.big, workers))
            one.append(_command(out, effort.small, 1))
            small.append(_command(out, few, workers))
    scale = 1000 / effort.big
    rates = [effort.big * LENGTH / run.wall for run in big]
    others = [effort.small * LENGTH / run.wall for run in one]
    wall = plain_row("generate-wall", [run.wall * scale for run in big], "1 worker", [1e6 / rate for rate in others])
    cpu = spread([run.cpu / effort.big for run in big])["median"]  # per 1000 rows, of all processes
    wall["note"] = f"{workers} workers, {spread(rates)['median']:,.0f} rows/s, {1000 * cpu:.0f} CPU s per 1M rows"
    wall["note"] += f"; reference: n={effort.small}, scaled"
    if effort.big != 1000:
        wall["note"] += f"; SCALED x{scale:g} FROM n={effort.big}, start-up too"
    memory = plain_row(
        "generate-memory", [run.rss / 1e9 for run in big], f"n={few}", [run.rss / 1e9 for run in small]
    )  # fmt: skip
    pss = spread([run.pss / 1e9 for run in big])["median"]
    memory["note"] = f"n={effort.big}, {workers} workers + driver, sum of RSS; PSS {pss:.2f} GB"
    return [wall, memory]


def _command(out: Path, n: int, workers: int) -> Any:
    shutil.rmtree(out, ignore_errors=True)
    run = run_tree([*GENERATE, "--n", str(n), "--workers", str(workers), "--out", out])
    made = json.loads(run.stdout)
    if made["rows"] != n * LENGTH:
        raise RuntimeError(f"generate made {made['rows']} rows, expected {n * LENGTH}")
    return run


def first_row(effort: Effort) -> list[Row]:
    """Measure seconds from starting Python to the first row, beside importing what that needs."""
    in_memory = (
        "from navrep_data.sim import *;ScriptedRollout(make_config(), RolloutSettings(1), ScriptedPolicy(), 0).run([0])"
    )
    walls: dict[str, list[float]] = {"disk": [], "memory": [], "imports": []}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        commands = {
            "disk": [*GENERATE, "--n", "1", "--length", "1", "--workers", "1", "--out", out],
            "memory": [sys.executable, "-c", in_memory],
            "imports": [sys.executable, "-c", "import numpy, numba, h5py"],
        }
        for turn in range(effort.repeats + 1):
            for name, command in commands.items():
                shutil.rmtree(out, ignore_errors=True)
                wall = run_tree(command).wall
                if turn > 0:  # the first turn fills numba's cache and the page cache
                    walls[name].append(wall)
    reference = "import numpy, numba, h5py"
    return [
        plain_row("first-row", walls["disk"], reference, walls["imports"], "generate --n 1 --length 1, to its end"),
        plain_row("first-row-memory", walls["memory"], reference, walls["imports"], "ScriptedRollout, to its end"),
    ]


OUTSIDE: dict[str, Callable[[Effort], list[Row]]] = {
    "generate-wall": generate_wall,
    "first-row": first_row,
    "navrep27": navrep27,
}
