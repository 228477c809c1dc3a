"""Sequences and datasets that look like real ones, made without the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from navrep_data.observations import scan_to_rings
from navrep_data.schema import COLUMNS, LABEL_HUMAN, Event, SensorContract
from navrep_data.shards import SPLIT_RULE, DatasetWriter, Manifest, ShardWriter, split_of

SENSOR = SensorContract()
MAX_HUMANS = 6
ALL_COLUMNS = tuple(name for name, c in COLUMNS.items() if not name.startswith("leading_"))


def make_sequence(
    sequence: int,
    rows: int = 100,
    *,
    scan_dtype: str = "uint16",
    columns: tuple[str, ...] = ALL_COLUMNS,
    seed: int = 0,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return (columns, worlds) of one sequence with random episodes."""
    rng = np.random.default_rng([seed, sequence])
    first = np.zeros(rows, bool)
    first[0] = True
    first[rng.integers(0, rows, rows // 30)] = True
    last = np.append(first[1:], True)
    starts = np.flatnonzero(first)
    episode = np.cumsum(first) - 1
    event = np.where(last, rng.integers(1, len(Event), rows), 0).astype(np.uint8)
    walk = 3.0 + np.cumsum(rng.normal(0, 0.02, (rows, 1)), axis=0) + np.sin(np.arange(1080) / 40.0) ** 2 * 6
    metres = np.clip(walk + rng.normal(0, 0.004, (rows, 1080)), 0.02, 25.0).astype(np.float32)
    metres[rng.random((rows, 1080)) < 0.001] = 0.0
    scan = np.rint(metres * 1000).astype(np.uint16) if scan_dtype == "uint16" else metres
    humans = np.full((rows, MAX_HUMANS, 6), np.nan, np.float32)
    per_episode = rng.integers(0, MAX_HUMANS + 1, len(starts))
    for k, n in enumerate(per_episode):
        mine = episode == k
        humans[mine, :n, :4] = rng.normal(size=(mine.sum(), n, 4))
        humans[mine, :n, 4] = rng.uniform(0.3, 0.5, n)
        humans[mine, :n, 5] = rng.random((mine.sum(), n)) < 0.5
    people = per_episode[episode][:, None]
    pose = np.cumsum(rng.normal(0, 0.1, (rows, 3)), axis=0).astype(np.float32)
    table = {
        "scan": scan,
        "rings": scan_to_rings(scan),
        "scan_label": np.repeat(rng.integers(0, LABEL_HUMAN + people, (rows, 27)), 40, axis=1).astype(np.uint8),
        "robot_state": rng.normal(size=(rows, 5)).astype(np.float32),
        "action": np.where(last[:, None], 0, rng.uniform(-1, 1, (rows, 3))).astype(np.float32),
        "reward": np.where(last, 0, rng.normal(size=rows)).astype(np.float32),
        "is_first": first,
        "is_last": last,
        "is_terminal": (event >= 1) & (event <= 3),
        "event": event,
        "contact": np.where(last, 0, rng.integers(0, 4, rows)).astype(np.uint8),
        "sequence": np.full(rows, sequence, np.int32),
        "episode": episode.astype(np.int32),
        "step": (np.arange(rows) - starts[episode]).astype(np.int32),
        "robot_pose": pose,
        "robot_radius": rng.uniform(0.3, 0.5, len(starts)).astype(np.float32)[episode],
        "humans": humans,
        "leading_action": rng.normal(size=(rows, 3)).astype(COLUMNS["leading_action"].dtype),
        "leading_reward": rng.normal(size=rows).astype(COLUMNS["leading_reward"].dtype),
        "source_robot_state": rng.normal(size=(rows, 5)),
    }
    n_episodes, n_humans = len(starts), int(per_episode.sum())
    polygons = rng.integers(1, 4, n_episodes)
    worlds = {
        "sequence": np.full(n_episodes, sequence),
        "episode": np.arange(n_episodes),
        "row": starts,
        "robot_start": pose[starts],
        "robot_goal": rng.normal(size=(n_episodes, 2)),
        "robot_v_pref": rng.uniform(0.8, 1.2, n_episodes),
        "vertices": rng.normal(size=(4 * polygons.sum(), 2)),
        "polygon_offset": 4 * np.arange(polygons.sum() + 1),
        "episode_polygon_offset": np.append(0, np.cumsum(polygons)),
        "has_border": rng.random(n_episodes) < 0.8,
        "human_offset": np.append(0, np.cumsum(per_episode)),
        "human_start": rng.normal(size=(n_humans, 3)),
        "human_goal": rng.normal(size=(n_humans, 2)),
        "human_v_pref": rng.uniform(0.8, 1.2, n_humans),
        "human_sees_robot": rng.random(n_humans) < 0.5,
        "human_gait": np.zeros((n_humans, 3)),
    }
    return {name: table[name] for name in columns}, worlds


def make_writer(split: str = "train", length: int = 100, **changes: Any) -> ShardWriter:
    """Return a writer with the defaults of these tests."""
    settings = {
        "env": "soadrl",
        "config": {"humans": 5, "name": "\u00e9t\u00e9"},
        "seed": 7,
        "sensor": SENSOR,
        "scan_dtype": "uint16",
        "columns": ALL_COLUMNS,
        "max_humans": MAX_HUMANS,
    }
    return ShardWriter(**{**settings, **changes}, length=length, split=split)


def make_dataset(
    root: Path,
    sequences: int = 6,
    shard_size: int = 3,
    length: int = 100,
    *,
    worlds: bool = True,
    by_rule: bool = False,
    **changes: Any,
) -> Manifest:
    """Write a whole dataset and return its manifest; all of it is for training, unless splits are `by_rule`."""
    root.mkdir(parents=True, exist_ok=True)
    scan_dtype = changes.get("scan_dtype", "uint16")
    columns = changes.get("columns", ALL_COLUMNS)
    manifest = Manifest(
        env="soadrl",
        physics="consistent",
        seed=7,
        length=length,
        planned=sequences,
        shard_size=shard_size,
        scan_dtype=scan_dtype,
        columns=columns,
        max_humans=MAX_HUMANS,
        sensor=SENSOR,
        config={"humans": 5},
        policy={"name": "orca"},
        versions={"navrep-data": "0"},
        command=f"navrep-data generate --env soadrl --n {sequences}",
        split_rule=SPLIT_RULE if by_rule else "all are train",
    )
    writer = DatasetWriter(root, manifest)
    for k in range(sequences):
        table, world = make_sequence(k, length, scan_dtype=scan_dtype, columns=columns)
        writer.append(k, split_of(k) if by_rule else "train", table, world if worlds else None)
    return writer.finish()
