"""How things are timed: interleaved pairs, child processes with one thread, memory of a process tree.

Machines are shared and clocks change, so a figure alone says little. Everything is therefore measured beside a
reference, in turns (A B A B ...): the median of each, their spread, and the median of the ratios within a turn.
"Per core" means per second of CPU time of the process, all its threads together.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PROC = Path("/proc")
_POOLS = ("OMP", "OPENBLAS", "MKL", "NUMBA")
ONE_THREAD = {f"{pool}_NUM_THREADS": "1" for pool in _POOLS}
PACKAGES = ("navrep-data", "numpy", "numba", "h5py", "isal", "torch")
POLL_SECONDS = 0.05


@dataclass
class Timing:
    """Units done per second, one number per turn.

    Attributes
    ----------
    cpu, wall : list of float
        Units per second of CPU time and of wall time.
    """

    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)

    def add(self, count: float, cpu: float, wall: float) -> None:
        """Record one turn: `count` units in so many seconds."""
        self.cpu.append(count / max(cpu, 1e-9))
        self.wall.append(count / max(wall, 1e-9))


def timed(work: Callable[[], float], seconds: float) -> tuple[float, float, float]:
    """Call `work` (returns units done) for at least `seconds`; returns units, CPU seconds, wall seconds."""
    count, cpu, wall = 0.0, time.process_time(), time.perf_counter()
    while True:
        count += work()
        spent = time.perf_counter() - wall
        if spent >= seconds:
            return count, time.process_time() - cpu, spent


def in_turns(works: Sequence[Callable[[], float]], repeats: int, seconds: float) -> list[Timing]:
    """Time several works in turns, each warmed by one call that does not count."""
    for work in works:
        work()
    timings = [Timing() for _ in works]
    for _ in range(repeats):
        for work, timing in zip(works, timings, strict=True):
            timing.add(*timed(work, seconds))
    return timings


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return median, smallest and largest."""
    return {"median": statistics.median(values), "low": min(values), "high": max(values)}


def ratio(ours: Sequence[float], other: Sequence[float]) -> float:
    """Return the median over turns of ours / other."""
    return statistics.median(a / b for a, b in zip(ours, other, strict=True))


def run_child(arguments: Sequence[str | Path], **environment: str) -> dict[str, Any]:
    """Run a Python script in a fresh, single-threaded process; returns the JSON object it prints last.

    A child that fails gives ``{"error": its last line}``: one broken row must not lose the rest of the table.
    """
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env={**os.environ, **ONE_THREAD, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = done.stdout.strip().splitlines()
    if done.returncode != 0 or not lines:
        said = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        return {"error": f"exit {done.returncode}: {said[:200]}"}
    found: dict[str, Any] = json.loads(lines[-1])
    return found


# --- memory and wall time of a whole process tree -------------------------------------------------------------


@dataclass
class TreeRun:
    """What running a command cost, with all its child processes.

    Attributes
    ----------
    stdout : str
        What it printed.
    wall, cpu : float
        Seconds; `cpu` sums all processes that ended.
    rss, pss : float
        Largest sum over the tree at one moment [bytes]. RSS counts shared pages once per process (an upper bound),
        PSS shares them out. 0 where there is no /proc.
    """

    stdout: str
    wall: float
    cpu: float
    rss: float
    pss: float


def run_tree(command: Sequence[str | Path], **environment: str) -> TreeRun:
    """Run `command` to its end, polling the memory of its process tree.

    Raises
    ------
    RuntimeError
        If it exits with an error: the last line it wrote.
    """
    before = _children_cpu()
    started = time.perf_counter()
    process = subprocess.Popen(
        [str(word) for word in command],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    peak = {"rss": 0.0, "pss": 0.0}
    watcher = threading.Thread(target=_watch, args=(process, peak), daemon=True)
    watcher.start()
    stdout, stderr = process.communicate()
    wall = time.perf_counter() - started
    watcher.join()
    if process.returncode != 0:
        said = (stderr.strip() or "no output").splitlines()[-1]
        raise RuntimeError(f"{Path(command[0]).name} exited with {process.returncode}: {said[:200]}")
    return TreeRun(stdout, wall, _children_cpu() - before, peak["rss"], peak["pss"])


def _children_cpu() -> float:
    spent = os.times()
    return spent.children_user + spent.children_system


def _watch(process: subprocess.Popen[str], peak: dict[str, float]) -> None:
    while process.poll() is None:
        rss = pss = 0.0
        for pid in process_tree(process.pid):
            one = memory_of(pid)
            rss += one["Rss"]
            pss += one["Pss"]
        peak["rss"], peak["pss"] = max(peak["rss"], rss), max(peak["pss"], pss)
        time.sleep(POLL_SECONDS)


def process_tree(root: int) -> list[int]:
    """Return `root` and all processes below it."""
    found = [root]
    for pid in found:
        try:
            for task in (PROC / str(pid) / "task").iterdir():
                found += [int(child) for child in (task / "children").read_text().split()]
        except (OSError, ValueError):
            continue  # it ended meanwhile
    return found


def memory_of(pid: int) -> dict[str, float]:
    """Return Rss and Pss of one process [bytes]; zeros where it ended."""
    sizes = {"Rss": 0.0, "Pss": 0.0}
    try:
        for line in (PROC / str(pid) / "smaps_rollup").read_text().splitlines():
            name, _, value = line.partition(":")
            if name in sizes:
                sizes[name] = float(value.split()[0]) * 1024
    except (OSError, IndexError, ValueError):
        return {"Rss": 0.0, "Pss": 0.0}
    return sizes


# --- where and when -------------------------------------------------------------------------------------------


def _proc_field(file: str, name: str) -> str | None:
    try:
        for line in (PROC / file).read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == name:
                return value.strip()
    except OSError:
        pass
    return None


def cores() -> int:
    """Return how many cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS
        return os.cpu_count() or 1


def versions_of(packages: Sequence[str]) -> dict[str, str]:
    """Return the installed versions of those of `packages` that are installed."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def machine(packages: Sequence[str] = PACKAGES) -> dict[str, Any]:
    """Return what the figures depend on: processor, cores, memory, load, date, versions."""
    memory = (_proc_field("meminfo", "MemTotal") or "0 kB").split()[0]
    return {
        "cpu": _proc_field("cpuinfo", "model name") or platform.processor() or "unknown",
        "cores": cores(),
        "memory_gb": round(int(memory) * 1024 / 1e9, 1),
        "system": f"{platform.system()} {platform.release()}",
        "load": round(os.getloadavg()[0], 2),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
        "versions": versions_of(packages),
    }
