"""Random 32-row windows per second: from disk, from memory, and against a plain numpy memmap.

    python benchmarks/windows.py [--root DATASET] [--seconds 2] [--json]

All in one run and one thread. Without ``--root`` a dataset is made in a temporary folder, from the original's
scans if they lie in ../shared, else from synthetic rooms. All rows read the same windows: scan as float32 metres
(or rings), robot_state, action, reward, flags.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import BatchSampler, DataLoader

from navrep_data.datasets import SequenceDataset, StreamingSequenceDataset
from navrep_data.observations import millimetres_from_metres, scan_to_rings
from navrep_data.schema import COLUMNS, Event, SensorContract
from navrep_data.shards import DatasetWriter, Manifest, split_of

W = 32
ORIGINAL = Path(__file__).resolve().parents[1] / "../shared/reference/original_npz"
LENGTH = 1000
COLUMN_NAMES = tuple(name for name in COLUMNS if name not in ("humans", "leading_action", "leading_reward"))


def source_scans() -> list[np.ndarray]:
    """Return sequences of scans (1000, 1080) float32 [m]."""
    files = sorted(ORIGINAL.glob("*.npz")) if ORIGINAL.is_dir() else []
    if files:
        scans = []
        for path in files:
            with np.load(path, allow_pickle=False) as archive:
                scans.append(archive["scans"])
        return scans
    angle = np.linspace(0, 6.27543783188, 1080)
    x = 5 * np.sin(np.arange(LENGTH) / 150)[:, None]
    wall = np.minimum((9 - x * np.sign(np.cos(angle))) / np.abs(np.cos(angle)), 8 / np.abs(np.sin(angle)))
    bumps = np.sin(9 * angle + np.arange(LENGTH)[:, None] / 20) > 0.6
    return [np.where(bumps, wall * 0.6, wall).clip(0.3, 25).astype(np.float32)]


def make_dataset(root: Path, sequences: int) -> None:
    """Write `sequences` sequences of 1000 rows in episodes of 100."""
    rng = np.random.default_rng(0)
    scans = [millimetres_from_metres(s) for s in source_scans()]
    rings = [scan_to_rings(s) for s in scans]
    root.mkdir(parents=True)
    settings: dict[str, Any] = {
        "env": "benchmark", "config": {}, "seed": 0, "sensor": SensorContract(), "scan_dtype": "uint16",
        "columns": COLUMN_NAMES, "max_humans": 0, "length": LENGTH,
    }  # fmt: skip
    manifest = Manifest(**settings, physics="none", planned=sequences, shard_size=10, policy={}, versions={})
    writer = DatasetWriter(root, manifest)
    for k in range(sequences):
        step = np.arange(LENGTH) % 100
        last = step == 99
        values = {
            "scan": scans[k % len(scans)],
            "rings": rings[k % len(scans)],
            "robot_state": rng.normal(size=(LENGTH, 5)),
            "action": rng.normal(size=(LENGTH, 3)),
            "reward": rng.normal(size=LENGTH),
            "is_first": step == 0,
            "is_last": last,
            "is_terminal": np.zeros(LENGTH, bool),
            "event": np.where(last, Event.TIMEOUT, 0),
            "sequence": np.full(LENGTH, k),
            "episode": np.arange(LENGTH) // 100,
            "step": step,
            "robot_pose": rng.normal(size=(LENGTH, 3)),
            "robot_radius": np.full(LENGTH, 0.3),
        }
        dtypes = {name: "uint16" if name == "scan" else COLUMNS[name].dtype for name in values}
        columns = {name: np.ascontiguousarray(v, dtypes[name]) for name, v in values.items()}
        writer.append(k, split_of(k), columns)
    writer.finish()


class MemmapWindows:
    """The floor: the same rows of the same columns as raw files, sliced by numpy and converted."""

    def __init__(self, dataset: SequenceDataset, folder: Path) -> None:
        self.table, self.maps = dataset.table, {}
        loaded, self.starts = dataset._load()
        for name, rows in loaded.rows.items():
            path = folder / f"{name}.raw"
            rows.tofile(path)
            self.maps[name] = np.memmap(path, rows.dtype, "r", shape=rows.shape)

    def batch(self, index: np.ndarray) -> dict[str, torch.Tensor]:
        start = self.starts[index]
        batch = {name: np.stack([rows[s : s + W] for s in start]) for name, rows in self.maps.items()}
        if "scan" in batch:
            batch["scan"] = batch["scan"].astype(np.float32) / np.float32(1000)
        if "rings" in batch:
            batch["rings"] = batch["rings"].astype(np.float32) * np.float32(0.5)
        return {name: torch.from_numpy(rows) for name, rows in batch.items()}


def rate(run: Callable[[np.ndarray], object], windows: np.ndarray, batch: int, seconds: float) -> float:
    """Return windows per second of `run(indices)` over random batches."""
    rng = np.random.default_rng(1)
    run(rng.choice(windows, batch))
    count, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        run(rng.choice(windows, batch))
        count += batch
    return count / (time.perf_counter() - begin)


def loader_rate(dataset: SequenceDataset, windows: np.ndarray, batch: int, seconds: float, whole: bool) -> float:
    """Return windows per second of a DataLoader in this process."""
    order = np.random.default_rng(2).choice(windows, 1 << 20).tolist()
    sampler = BatchSampler(order, batch, False)
    loader = (
        DataLoader(dataset, sampler=sampler, batch_size=None) if whole else DataLoader(dataset, batch_sampler=sampler)
    )
    return drain(loader, seconds)


def drain(loader: Any, seconds: float) -> float:
    """Return windows per second of iterating `loader`."""
    count, begin = 0, time.perf_counter()
    for item in loader:
        count += len(item["mask"])
        if time.perf_counter() - begin > seconds:
            break
    return count / (time.perf_counter() - begin)


def epochs(stream: StreamingSequenceDataset) -> Iterator[Any]:
    """Iterate for ever."""
    for epoch in itertools.count():
        stream.set_epoch(epoch)
        yield from stream


def measure(root: Path, seconds: float, batch: int) -> list[dict[str, Any]]:
    """Return one row per way of reading."""
    rows = []
    for lidar in ("1d", "rings"):
        disk = SequenceDataset(root, lidar, stride=1)
        memory = SequenceDataset(root, lidar, stride=1, preload=True)
        full = np.flatnonzero(disk.table.count == W)
        stream = StreamingSequenceDataset(root, lidar, stride=W, batch_size=batch, rank=0, world_size=1)
        for _ in stream:  # memory and page cache are warm in all rows
            pass
        with tempfile.TemporaryDirectory() as folder:
            floor = rate(MemmapWindows(memory, Path(folder)).batch, full, batch, seconds)
        figures = {
            "numpy memmap": floor,
            "disk": rate(disk.batch, full, batch, seconds),
            "preloaded": rate(memory.batch, full, batch, seconds),
            "preloaded, DataLoader, batch sampler": loader_rate(memory, full, batch, seconds, True),
            "preloaded, DataLoader, default": loader_rate(memory, full, batch, seconds, False),
            "streamed": drain(epochs(stream), seconds),
        }
        rows += [
            {
                "lidar": lidar,
                "source": name,
                "windows_per_s": round(value),
                "ratio_to_memmap": round(value / floor, 3),
            }
            for name, value in figures.items()
        ]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="dataset to read (default: one made for the purpose)")
    parser.add_argument("--sequences", type=int, default=40, help="sequences of the dataset made for the purpose")
    parser.add_argument("--seconds", type=float, default=2.0, help="per figure")
    parser.add_argument("--batch", type=int, default=64, help="windows per batch")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        root = arguments.root or Path(folder) / "dataset"
        if arguments.root is None:
            make_dataset(root, arguments.sequences)
        rows = measure(root, arguments.seconds, arguments.batch)
    if arguments.json:
        print(json.dumps({"benchmark": "windows", "window": W, "batch": arguments.batch, "rows": rows}))
        return
    print("| lidar | source | windows/s | ratio to memmap |")
    print("|---|---|---|---|")
    for row in rows:
        print(f"| {row['lidar']} | {row['source']} | {row['windows_per_s']:,} | {row['ratio_to_memmap']} |")


if __name__ == "__main__":
    main()
