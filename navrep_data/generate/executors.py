"""Run shard tasks here, in worker processes or on a Ray cluster; results come back in any order."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from pickle import PicklingError
from typing import Any

from navrep_data._ray import RayCluster
from navrep_data.errors import FolderNotWritableError, PolicyError, WorkerDiedError
from navrep_data.generate.inputs import check_here
from navrep_data.generate.plan import versions
from navrep_data.generate.worker import (
    DatasetSpec,
    ShardTask,
    make_shard,
    rollout_of,
    run_task,
    start_worker,
)
from navrep_data.io import without_interrupts
from navrep_data.shards import ShardEntry

# A worker that somebody kills is replaced; a task that kills its worker this often is at fault itself.
MAX_RESTARTS = 3
POLL_SECONDS = 0.2

EXECUTORS = ("local", "ray")

_kept: dict[str, Any] = {}

Finished = tuple[ShardTask, ShardEntry]
"""A finished task and what to list."""


class LocalExecutor:
    """Run shard tasks with `workers` processes (1 = in this one).

    Parameters
    ----------
    spec : DatasetSpec
        The dataset.
    workers : int
        Number of processes.
    """

    def __init__(self, spec: DatasetSpec, workers: int) -> None:
        self.spec = spec
        self.workers = workers
        self._here = 0
        self._finished = 0
        self._counters = get_context("spawn").RawArray("q", 2 * workers)

    def __enter__(self) -> LocalExecutor:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: processes live as long as :meth:`run`."""

    like_here = True
    """Whether the workers are as fast as this process."""

    @property
    def place(self) -> str:
        """Where it runs, in words."""
        return f"{self.workers} core{'s' if self.workers > 1 else ''}"

    @property
    def rows_made(self) -> int:
        """Rows simulated so far, those of unfinished shards included."""
        return self._here + self._finished + sum(int(rows) for rows in self._counters)

    def run(self, tasks: Sequence[ShardTask]) -> Iterator[Finished | None]:
        """Yield each finished task, and None several times a second while waiting."""
        if not tasks:
            return
        yield from self._run_here(tasks) if self.workers == 1 else self._run_pool(list(tasks))

    def _run_here(self, tasks: Sequence[ShardTask]) -> Iterator[Finished | None]:
        rollout = rollout_of(self.spec)
        due = time.monotonic()

        def report(rows: int) -> None:
            self._here += rows

        for task in tasks:
            entry = make_shard(self.spec, task, rollout, report)
            yield task, entry
            if time.monotonic() - due > POLL_SECONDS:
                due = time.monotonic()
                yield None

    def _run_pool(self, tasks: list[ShardTask]) -> Iterator[Finished | None]:
        restarts = 0
        while tasks:
            done: set[str] = set()
            try:
                for finished in self._run_once(tasks):
                    if finished is not None:
                        done.add(finished[0].file)
                    yield finished
                return
            except BrokenProcessPool:
                tasks = [task for task in tasks if task.file not in done]
                restarts = 0 if done else restarts + 1
                if restarts > MAX_RESTARTS:
                    raise WorkerDiedError(
                        f"Worker processes died {restarts} times before finishing {tasks[0].file} (killed, out of "
                        "memory, or started by a script without `if __name__ == '__main__':`?). What was finished is "
                        "intact; run the same again, perhaps with fewer --workers."
                    ) from None
                for slot in range(len(self._counters)):
                    self._counters[slot] = 0

    def _run_once(self, tasks: Sequence[ShardTask]) -> Iterator[Finished | None]:
        pool = ProcessPoolExecutor(
            self.workers,
            mp_context=get_context("spawn"),
            initializer=start_worker,
            initargs=(self.spec, self._counters),
        )
        free = list(range(len(self._counters)))
        running: dict[Future[ShardEntry], ShardTask] = {}
        waiting = iter(tasks)
        try:
            while True:
                while free and (task := next(waiting, None)) is not None:
                    task = replace(task, slot=free.pop())
                    with without_interrupts():  # this may start a process
                        running[pool.submit(run_task, task)] = task
                if not running:
                    return
                for future in wait(running, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED).done:
                    task = running.pop(future)
                    entry = future.result()
                    self._finished += entry.rows
                    self._counters[task.slot] = 0
                    free.append(task.slot)
                    yield task, entry
                yield None
        except (PicklingError, AttributeError, TypeError) as error:
            if self.spec.policy.spec is None or self.spec.policy.spec.given is None:
                raise
            raise PolicyError(
                f"The policy cannot be sent to worker processes ({error}). Expected a function or object of an "
                "importable module; use workers=1 or give its name as module:function."
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _run_remote(spec: DatasetSpec, task: ShardTask) -> tuple[ShardEntry, dict[str, str]]:
    """Make one shard in a worker of a cluster; returns its entry, and the versions that its bytes depend on."""
    if not spec.root.is_dir() and spec.storage is None:
        raise FolderNotWritableError(
            f"{spec.root} is not a folder on node {platform.node()}; expected --out on storage that all nodes share, "
            "or --storage with a URL."
        )
    # such a worker may get the tasks of one dataset after the other
    if "rollout" not in _kept or _kept["spec"] != spec:
        check_here(spec.inputs, spec.config, spec.policy, f"on node {platform.node()}")
        _kept["spec"], _kept["rollout"] = spec, rollout_of(spec)
    return make_shard(spec, task, _kept["rollout"], lambda rows: None), versions()


class RayExecutor:
    """Run shard tasks on a Ray cluster, for the duration of a ``with`` block.

    Parameters
    ----------
    spec : DatasetSpec
        The dataset; its root is absolute.
    workers : int or None
        Most tasks at the same time; None = all that the cluster takes.
    address : str or None
        See :class:`navrep_data._ray.RayCluster`.
    say : callable
        Receives notes.
    """

    like_here = False
    """Whether the workers are as fast as this process."""

    def __init__(self, spec: DatasetSpec, workers: int | None, address: str | None, say: Callable[[str], None]) -> None:
        self.spec = spec
        self.rows_made = 0
        self._say = say
        self._cluster: RayCluster[ShardTask, tuple[ShardEntry, dict[str, str]]] = RayCluster(address, workers)
        self._noted: set[str] = set()

    def __enter__(self) -> RayExecutor:
        self._cluster.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._cluster.__exit__()

    @property
    def workers(self) -> int:
        """Tasks at the same time."""
        most = self._cluster.workers
        return self._cluster.cpus if most is None else min(most, self._cluster.cpus)

    @property
    def place(self) -> str:
        """Where it runs, in words."""
        return f"a Ray cluster, {self.workers} task{'s' if self.workers > 1 else ''} at a time"

    def run(self, tasks: Sequence[ShardTask]) -> Iterator[Finished | None]:
        """Yield each finished task, and None several times a second while waiting."""
        here = versions()
        for done in self._cluster.map(_run_remote, self.spec, tasks):
            if done is None:
                yield None
                continue
            task, (entry, there), node = done
            self._compare(here, there, node)
            self.rows_made += entry.rows
            yield task, entry

    def _compare(self, here: dict[str, str], there: dict[str, str], node: str) -> None:
        changed = ", ".join(f"{name} {there.get(name)} (here {value})" for name, value in here.items()
                            if there.get(name) != value)  # fmt: skip
        if changed and changed not in self._noted:
            self._noted.add(changed)
            self._say(f"Note: node {node} has {changed}; its shards may differ in their last digits.")
