"""Random 32-row windows out of the same rows, stored by this package, as the original's npz, and by Minari."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from navrep_data.datasets import SequenceDataset
from navrep_data.generate import generate
from navrep_data.shards import Manifest

WINDOW = 32
BATCH = 64
Draw = Callable[[], float]


class Rows:
    """A small soadrl dataset, and its rows for others to store.

    Parameters
    ----------
    folder : Path
        Where to make it.
    sequences : int
        How many sequences of 1000 rows.
    """

    def __init__(self, folder: Path, sequences: int) -> None:
        self.folder = folder
        self.root = folder / "soadrl"
        generate("soadrl", sequences, self.root)

    def columns(self) -> dict[str, np.ndarray]:
        """Return the columns that all loaders serve; scans as float32 [m]."""
        parts: dict[str, list[np.ndarray]] = {}
        names = ("scan", "robot_state", "action", "reward", "is_last", "is_terminal")
        for entry in Manifest.read(self.root).shards:
            with h5py.File(self.root / entry.file) as file:
                for name in names:
                    parts.setdefault(name, []).append(file[name][:])
        joined = {name: np.concatenate(values) for name, values in parts.items()}
        joined["scan"] = joined["scan"].astype(np.float32) / np.float32(1000)
        return joined


def bytes_of(folder: Path) -> int:
    """Return the bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def ours(rows: Rows, preload: bool) -> tuple[Draw, int]:
    """Return work that reads a batch of windows with SequenceDataset, and the bytes on disk."""
    dataset = SequenceDataset(rows.root, "1d", window=WINDOW, stride=1, preload=preload)
    full = np.flatnonzero(dataset.table.count == WINDOW)
    rng = np.random.default_rng(1)

    def draw() -> float:
        dataset.batch(rng.choice(full, BATCH))
        return BATCH

    return draw, bytes_of(rows.root)


def original_npz(rows: Rows) -> tuple[Draw, int]:
    """Return work that opens the original's npz of a sequence for a window, and the bytes on disk."""
    folder = rows.folder / "npz"
    folder.mkdir()
    columns = rows.columns()
    paths = []
    for start in range(0, len(columns["reward"]), 1000):
        part = slice(start, start + 1000)
        paths.append(folder / f"{start // 1000:03}_scans_robotstates_actions_rewards_dones.npz")
        np.savez_compressed(
            paths[-1],
            scans=columns["scan"][part],
            robotstates=columns["robot_state"][part].astype(np.float64),
            actions=columns["action"][part].astype(np.float64),
            rewards=columns["reward"][part].astype(np.float64),
            dones=columns["is_last"][part],
        )
    rng = np.random.default_rng(1)

    def draw() -> float:
        start = rng.integers(0, 1000 - WINDOW)
        with np.load(paths[rng.integers(len(paths))], allow_pickle=False) as archive:
            for name in archive.files:
                archive[name][start : start + WINDOW].copy()
        return 1

    return draw, bytes_of(folder)


def minari(rows: Rows) -> tuple[Draw, int]:
    """Return work that reads an episode from Minari's HDF5 and cuts a window, and the bytes on disk.

    Raises
    ------
    ImportError
        If Minari is not installed.
    """
    os.environ["MINARI_DATASETS_PATH"] = str(rows.folder / "minari")
    library, buffers, spaces = map(importlib.import_module, ("minari", "minari.data_collector", "gymnasium.spaces"))
    columns = rows.columns()
    stops = np.flatnonzero(columns["is_last"]) + 1
    episodes: list[Any] = []
    for start, stop in zip(np.concatenate([[0], stops[:-1]]), stops, strict=True):
        if stop - start < WINDOW:
            continue
        taken = slice(start, stop - 1)
        end = bool(columns["is_terminal"][stop - 1])
        flags = np.zeros(stop - start - 1, bool)
        last = flags.copy()
        last[-1] = True
        observations = {"scan": columns["scan"][start:stop], "robot_state": columns["robot_state"][start:stop]}
        episodes.append(
            buffers.EpisodeBuffer(
                observations=observations,
                actions=columns["action"][taken],
                rewards=columns["reward"][taken],
                terminations=last if end else flags,
                truncations=flags if end else last,
            )
        )
    box = spaces.Box
    made = library.create_dataset_from_buffers(
        "navrep/benchmark-v0",
        buffer=episodes,
        observation_space=spaces.Dict(
            {"scan": box(0, 100, (1080,), np.float32), "robot_state": box(-np.inf, np.inf, (5,), np.float32)}
        ),
        action_space=box(-np.inf, np.inf, (3,), np.float32),
        algorithm_name="orca",
        author="benchmark",
        author_email="none",
        code_permalink="none",
        description="benchmark",
    )
    rng = np.random.default_rng(1)

    def draw() -> float:
        episode = made[int(rng.integers(len(made)))]
        start = rng.integers(0, len(episode.rewards) - WINDOW + 2)
        part = slice(start, start + WINDOW)
        for values in (*episode.observations.values(), episode.actions, episode.rewards):
            values[part].copy()
        return 1

    return draw, bytes_of(rows.folder / "minari")
