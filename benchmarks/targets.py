"""What is measured and how fast it has to be: the table "Speed and size" of part 1."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """One row of the table.

    Attributes
    ----------
    what : str
        In words.
    unit : str
        Of all its figures.
    must, aim : float or None
        What it has to reach, and what it should; None where nothing is asked.
    more : bool
        Whether more is better.
    """

    what: str
    unit: str
    must: float | None = None
    aim: float | None = None
    more: bool = True

    def verdict(self, value: float) -> str:
        """Return which of the two `value` reaches."""
        if self.must is None:
            return "-"
        sign = 1 if self.more else -1
        if self.aim is not None and sign * value >= sign * self.aim:
            return "pass, aim reached"
        return "pass" if sign * value >= sign * self.must else "FAIL"


_WINDOWS = "random 32-row windows"
TARGETS: dict[str, Target] = {
    "simulate": Target("simulate soadrl, rows in RAM, per core", "steps/s", 20e3, 30e3),
    "simulate-rings": Target("... with rings", "steps/s"),
    "generate-core": Target("`generate` to finished shards, all columns, per core", "rows/s", 14e3, 20e3),
    "generate-wall": Target("`generate --n 1000` (1M rows), 2 cores, wall", "s", 45, 25, more=False),
    "lidar": Target("lidar scans, per core", "scans/s", 100e3, 150e3),
    "rings": Target("rings, per core", "rings/s", 200e3, 300e3),
    "windows-disk-1d": Target(f"{_WINDOWS} from disk, scans", "windows/s", 3e3, 5e3),
    "windows-disk-rings": Target(f"{_WINDOWS} from disk, rings", "windows/s", 3e3, 5e3),
    "windows-memory-1d": Target(f"{_WINDOWS} preloaded, scans", "windows/s", 30e3, 60e3),
    "windows-memory-rings": Target(f"{_WINDOWS} preloaded, rings", "windows/s", 30e3, 60e3),
    "scan-bytes": Target("scan bytes per row", "B", 1350, 1250, more=False),
    "label-speed": Target("`generate --labels`, per core", "rows/s"),
    "label-bytes": Target("bytes per row of `scan_label`", "B", 70, more=False),
    "row-bytes": Target("bytes per row, all columns", "B", 2200, 1800, more=False),
    "generate-memory": Target("peak memory of `generate`, all processes", "GB", 1.5, 0.8, more=False),
    "first-row": Target("first row on disk in a fresh process, kernels cached", "s", 2.0, more=False),
    "first-row-memory": Target("... in memory", "s", more=False),
    "navrep27-goal": Target("`benchmark --suite navrep27`, 300 per scenario: `goal`, wall", "s", 300, more=False),
    "navrep27-orca": Target("... `orca`", "s", 300, more=False),
    "navrep27-dwa": Target("... `dwa`", "s", 900, more=False),
}
