"""What a worker process does: one shard from its sequence range to its place on disk."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

from navrep_data.generate.inputs import check_here
from navrep_data.generate.policy import DatasetPolicy, make_rollout
from navrep_data.generate.storage import Store, store_of
from navrep_data.shards import SPLITS, Ranges, ShardEntry, ShardWriter, count_in_split, nth_of_split, ranges_of
from navrep_data.shards.entries import shard_file
from navrep_data.shards.recipe import made_by
from navrep_data.sim import DrivenRollout, RolloutSettings, ScriptedRollout, SimConfig


@dataclass(frozen=True)
class DatasetSpec:
    """Everything that determines the bytes of a dataset's shards, and where they go.

    Shards go to the URL `storage`, or to `root` where there is none. `inputs` are hashes of what it is made from, see
    ``navrep_data/generate/inputs.py``.
    """

    root: Path
    config: SimConfig
    settings: RolloutSettings
    policy: DatasetPolicy
    seed: int
    columns: tuple[str, ...]
    storage: str | None = None
    inputs: Mapping[str, str] = field(default_factory=dict)

    @property
    def made_by(self) -> str:
        """What every shard says of policy, inputs and columns, see ``navrep_data/shards/recipe.py``."""
        return made_by(self.policy.to_dict(), self.inputs, self.settings.scan_dtype, self.columns)

    @property
    def store(self) -> Store:
        """Where shards go."""
        return store_of(self.root, self.storage)


@dataclass(frozen=True)
class ShardTask:
    """One shard to make.

    Attributes
    ----------
    split : str
        Its split.
    index : int
        Its number among the shards of the split.
    first, stop : int
        Its sequences, counted within the split.
    slot : int
        The counter to report rows in.
    staged : bool
        Whether it is to wait beside its place, where a shorter one is.
    """

    split: str
    index: int
    first: int
    stop: int
    slot: int = 0
    staged: bool = False

    @property
    def file(self) -> str:
        """Its file in the dataset."""
        return shard_file(self.split, self.index)

    @property
    def numbers(self) -> list[int]:
        """The numbers of its sequences in the dataset."""
        return [nth_of_split(self.split, k) for k in range(self.first, self.stop)]

    @property
    def sequences(self) -> Ranges:
        """The same as the manifest lists them."""
        return ranges_of(self.numbers)


def all_shards(n: int, shard_size: int) -> list[ShardTask]:
    """Return the shards of a dataset of `n` sequences: those of each split, `shard_size` sequences in all but its last.

    Only the last one of each split changes when the dataset grows.
    """
    counts = {split: count_in_split(split, n) for split in SPLITS}
    return [
        ShardTask(split, index, first, min(first + shard_size, count))
        for split, count in counts.items()
        for index, first in enumerate(range(0, count, shard_size))
    ]


# Enough for an estimate to within the machine's own noise, and done before one notices.
PILOT_ROWS = 400

_state: dict[str, Any] = {}


def start_worker(spec: DatasetSpec, counters: Any) -> None:
    """Prepare a worker process: the driver handles Ctrl-C, and no worker outlives its driver."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with, args=(parent,), daemon=True).start()
    _state["spec"] = spec
    _state["counters"] = counters


def _exit_with(parent: Any) -> None:
    """Wait for the driver's end. Only a SIGKILL gets here: the pool cannot tell its workers of that by itself."""
    parent.join()
    os._exit(1)


def run_task(task: ShardTask) -> ShardEntry:
    """Make one shard in a worker process that :func:`start_worker` has prepared."""
    if "rollout" not in _state:
        spec = _state["spec"]
        check_here(spec.inputs, spec.config, spec.policy, "in a worker process")
        _state["rollout"] = rollout_of(_state["spec"])
    counters = _state["counters"]
    made = 0

    def report(rows: int) -> None:
        nonlocal made
        made += rows
        counters[task.slot] = made

    return make_shard(_state["spec"], task, _state["rollout"], report)


def rollout_of(spec: DatasetSpec) -> ScriptedRollout | DrivenRollout:
    """Return what simulates this dataset's sequences."""
    return make_rollout(spec.config, spec.settings, spec.policy, spec.seed)


def make_shard(
    spec: DatasetSpec,
    task: ShardTask,
    rollout: ScriptedRollout | DrivenRollout,
    report: Callable[[int], None],
) -> ShardEntry:
    """Simulate, compress, hash and publish one shard.

    Parameters
    ----------
    spec : DatasetSpec
        The dataset.
    task : ShardTask
        Which of its shards.
    rollout : ScriptedRollout or DrivenRollout
        From :func:`rollout_of`; reused between shards.
    report : callable
        Called with the number of rows after each sequence.

    Returns
    -------
    ShardEntry
        What the manifest lists.

    Raises
    ------
    DiskSpaceError
        If there is no room; what is in place stays as it was.
    """
    writer, numbers = new_writer(spec, task.split), task.numbers
    with spec.policy.in_its_way():
        for start in range(0, len(numbers), rollout.batch):
            group = numbers[start : start + rollout.batch]
            for number, (columns, worlds) in zip(group, rollout.run(group), strict=True):
                writer.append(number, columns, worlds)
                report(spec.settings.length)
    return spec.store.publish(task.index, writer.finish(), staged=task.staged)


def new_writer(spec: DatasetSpec, split: str) -> ShardWriter:
    """Return the writer of a shard of this split."""
    return ShardWriter(
        env=spec.config.env,
        config=spec.config.to_dict(),
        seed=spec.seed,
        sensor=spec.config.sensor,
        scan_dtype=spec.settings.scan_dtype,
        columns=spec.columns,
        max_humans=spec.config.max_others,
        length=spec.settings.length,
        split=split,
        made_by=spec.made_by,
    )


def seconds_per_row(spec: DatasetSpec) -> float:
    """Return how long a row of a scripted policy takes here, simulated and compressed, after compiling [s].

    The clock runs over one short sequence in memory; nothing is written.
    """
    short = replace(spec, settings=replace(spec.settings, length=min(spec.settings.length, PILOT_ROWS)))
    rollout = rollout_of(short)
    seconds = 0.0
    for sequence in (0, 1):  # the first one compiles
        begun = time.perf_counter()
        writer = new_writer(short, SPLITS[0])
        for columns, worlds in rollout.run([sequence]):
            writer.append(sequence, columns, worlds)
        writer.finish()
        seconds = time.perf_counter() - begun
    return seconds / short.settings.length
