"""Small synthetic datasets whose every value tells where it came from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from navrep_data.observations import scan_to_rings
from navrep_data.schema import COLUMNS, Event, SensorContract
from navrep_data.shards import DatasetWriter, Manifest, split_of

N_RAYS = 1080
H = 3


def make_sequence(
    sequence: int,
    lengths: list[int],
    columns: tuple[str, ...],
    scan_dtype: str = "uint16",
    nan_goals: bool = False,
) -> dict[str, np.ndarray]:
    """One sequence with episodes of the given lengths; `robot_state[:, 2]` = sequence, `[:, 3]` = row."""
    rng = np.random.default_rng([11, sequence])
    n = sum(lengths)
    starts = np.cumsum([0, *lengths[:-1]])
    is_first = np.zeros(n, bool)
    is_first[starts] = True
    is_last = np.append(is_first[1:], True)
    episode = np.cumsum(is_first) - 1
    step = np.arange(n) - starts[episode]
    event = np.zeros(n, np.uint8)
    event[is_last] = rng.integers(1, 7, is_last.sum())
    scan = rng.integers(300, 25001, (n, N_RAYS))
    scan[rng.random(scan.shape) < 0.02] = 0
    scan = scan.astype(np.uint16) if scan_dtype == "uint16" else scan.astype(np.float32) / np.float32(1000)
    state = np.stack([rng.normal(size=n), rng.normal(size=n), np.full(n, sequence), np.arange(n), np.zeros(n)], 1)
    if nan_goals:
        state[::3, :2] = np.nan
    action = rng.normal(size=(n, 3)) * ~is_last[:, None]
    reward = rng.normal(size=n) * ~is_last
    humans = rng.normal(size=(n, H, 6))
    humans[:, H - 1] = np.nan
    values = {
        "scan": scan,
        "rings": scan_to_rings(scan),
        "scan_label": rng.integers(0, 3 + H - 1, scan.shape),  # the last slot is empty
        "robot_state": state,
        "action": action,
        "reward": reward,
        "is_first": is_first,
        "is_last": is_last,
        "is_terminal": np.isin(event, [e for e in Event if e.terminal]),
        "event": event,
        "contact": rng.integers(0, 4, n) * ~is_last,
        "sequence": np.full(n, sequence),
        "episode": episode,
        "step": step,
        "robot_pose": rng.normal(size=(n, 3)),
        "robot_radius": np.full(n, 0.3),
        "humans": humans,
        "leading_action": rng.normal(size=(n, 3)),
        "leading_reward": rng.normal(size=n),
        "source_robot_state": state,
    }
    return {
        name: np.ascontiguousarray(values[name], scan_dtype if name == "scan" else COLUMNS[name].dtype)
        for name in columns
    }


def write_dataset(
    root: Path,
    sequences: list[list[int]],
    *,
    shard_size: int = 2,
    scan_dtype: str = "uint16",
    without: tuple[str, ...] = ("leading_action", "leading_reward", "source_robot_state"),
    nan_goals: bool = False,
) -> list[dict[str, np.ndarray]]:
    """Write a dataset of sequences given by their episodes' lengths; return the columns of each sequence."""
    columns = tuple(name for name in COLUMNS if name not in without)
    length = max(sum(lengths) for lengths in sequences)
    sensor = SensorContract()
    root.mkdir(parents=True)
    manifest = Manifest(
        env="test",
        physics="consistent",
        seed=0,
        length=length,
        planned=len(sequences),
        shard_size=shard_size,
        scan_dtype=scan_dtype,
        columns=columns,
        max_humans=H,
        sensor=sensor,
        config={},
        policy={},
        versions={},
    )
    writer, contents = DatasetWriter(root, manifest), []
    for k, lengths in enumerate(sequences):
        contents.append(make_sequence(k, lengths, columns, scan_dtype, nan_goals))
        writer.append(k, split_of(k), contents[-1])
    writer.finish()
    return contents


def slow_windows(contents: list[dict[str, np.ndarray]], window: int, stride: int) -> list[tuple[int, int, int]]:
    """The default windows as (sequence, first row, real rows), found row by row: the oracle of the index."""
    found = []
    for columns in contents:
        rows = len(columns["step"])
        for row in range(rows):
            if columns["step"][row] % stride == 0:
                count = 0
                while (
                    count < window and row + count < rows and columns["episode"][row + count] == columns["episode"][row]
                ):
                    count += 1
                found.append((int(columns["sequence"][0]), row, count))
    return found


def identity(batch: dict) -> tuple[int, int]:
    """(sequence, first row) of a window."""
    state = batch["robot_state"][0]
    return int(state[2]), int(state[3])
