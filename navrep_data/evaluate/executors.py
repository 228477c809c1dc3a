"""Play episodes here, in worker processes that take one after the other from a common list, or on a Ray cluster."""

from __future__ import annotations

import queue
import time
import traceback
from collections.abc import Generator
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from typing import Any

from navrep_data._ray import RayCluster
from navrep_data.errors import NavrepDataError, WorkerDiedError
from navrep_data.evaluate.runner import Episode, n_worlds, play, units
from navrep_data.evaluate.suite_worlds import SuiteWorlds
from navrep_data.evaluate.suites import Suite, get_suite
from navrep_data.io import translate_os_error, without_interrupts
from navrep_data.policies import Driver, PolicySpec

POLL_SECONDS = 0.2
# workers hand over what they have finished this often, so that little is lost when they are killed
HAND_OVER_SECONDS = 0.5
# On Ray a task is some units, played to their end: few enough that all processors end at about the same time and
# little is played again where a node dies, enough that networks see batches.
TASKS_PER_CPU = 4
MAX_EPISODES_PER_TASK = 128


@dataclass(frozen=True)
class Job:
    """What is to be played by whom.

    Attributes
    ----------
    suite, physics : str
        Names.
    policy : PolicySpec
        Who drives.
    episodes : tuple of int
        Numbers of the episodes.
    grouped : bool
        See :class:`navrep_data.policies.BasePolicy`.
    batch : int or None
        Worlds per process; None = a good number.
    """

    suite: str
    physics: str
    policy: PolicySpec
    episodes: tuple[int, ...]
    grouped: bool = False
    batch: int | None = None

    def units(self) -> list[list[int]]:
        """Return the episodes as they are handed out."""
        return units(list(self.episodes), self.grouped)


def _start(job: Job, suite: Suite, take: Any, count: int) -> Generator[list[Episode]]:
    with job.policy.in_its_way():
        policy = job.policy.make(first_seed=suite.first_seed)
        worlds = SuiteWorlds(suite.config(job.physics), n_worlds(policy, job.batch, count))
        yield from play(suite, worlds, Driver(policy), take)


def run(job: Job, workers: int) -> Generator[list[Episode]]:
    """Play a job and yield episodes as they end, in any order; empty lists while waiting.

    Parameters
    ----------
    job : Job
        What to play.
    workers : int
        Number of processes; 1 = in this one.

    Raises
    ------
    WorkerDiedError
        If a worker process ended without a word.
    NavrepDataError
        What went wrong in a worker.

    Notes
    -----
    Close it (``contextlib.closing``) where it may not be read to its end: then workers end, and torch is set as before.
    """
    todo = job.units()
    workers = min(workers, len(todo))
    if workers > 1:
        yield from _run_pool(job, workers, len(todo))
    elif todo:
        rest = iter(todo)
        yield from _start(job, get_suite(job.suite), lambda: next(rest, None), len(job.episodes))


def _work(job: Job, share: int, taken: Any, results: Any) -> None:
    """Play in a worker process; `taken` counts the units that somebody has taken."""
    todo = job.units()
    parent = parent_process()

    def take() -> list[int] | None:
        with taken.get_lock():
            index = taken.value
            taken.value += 1
        return todo[index] if index < len(todo) else None

    try:
        done: list[Episode] = []
        due = time.monotonic() + HAND_OVER_SECONDS
        for finished in _start(job, get_suite(job.suite), take, share):
            done += finished
            if time.monotonic() > due:
                if parent is not None and not parent.is_alive():
                    return  # nobody is left to take results
                results.put(("episodes", done))
                done, due = [], time.monotonic() + HAND_OVER_SECONDS
        results.put(("episodes", done))
        results.put(("end", None))
    except NavrepDataError as error:
        results.put(("error", error))
    except OSError as error:
        results.put(("error", translate_os_error(error)))
    except Exception:  # a bug: its traceback must reach the user
        results.put(("bug", traceback.format_exc()))


def _run_pool(job: Job, workers: int, n_units: int) -> Generator[list[Episode]]:
    context = get_context("spawn")
    taken, results = context.Value("q", 0), context.Queue()
    share = -(-len(job.episodes) // workers)
    pool = [context.Process(target=_work, args=(job, share, taken, results), daemon=True) for _ in range(workers)]
    try:
        with without_interrupts():
            for process in pool:
                process.start()
        running = workers
        while running:
            try:
                kind, what = results.get(timeout=POLL_SECONDS)
            except queue.Empty:
                _check_alive(pool)
                yield []
                continue
            if kind == "error":
                raise what
            if kind == "bug":
                raise WorkerDiedError(f"A worker process failed:\n{what}")
            running -= kind == "end"
            if kind == "episodes":
                yield what
    finally:
        for process in pool:
            if process.pid is not None:
                process.terminate()
                process.join()
        results.close()


def _check_alive(pool: list[Any]) -> None:
    for process in pool:
        if process.exitcode not in (None, 0):
            raise WorkerDiedError(
                f"A worker process died (exit code {process.exitcode}: killed, or out of memory?). What was finished "
                "is intact; run the same command again, perhaps with fewer --workers."
            )


def run_on_ray(job: Job, cluster: RayCluster[tuple[int, ...], list[Episode]]) -> Generator[list[Episode]]:
    """Play a job on a cluster and yield episodes as tasks end, in any order; empty lists while waiting.

    Parameters
    ----------
    job : Job
        What to play; what it names (modules, files of weights) must be there on every node.
    cluster : RayCluster
        Entered.

    Raises
    ------
    WorkerDiedError, ClusterError
        See :meth:`navrep_data._ray.RayCluster.map`.
    NavrepDataError
        What went wrong in a worker.
    """
    todo = job.units()
    size = max(1, min(-(-len(todo) // (TASKS_PER_CPU * cluster.cpus)), MAX_EPISODES_PER_TASK // max(map(len, todo))))
    tasks = [tuple(range(k, min(k + size, len(todo)))) for k in range(0, len(todo), size)]
    for done in cluster.map(_play_task, job, tasks):
        yield [] if done is None else done[1]


def _play_task(job: Job, chosen: tuple[int, ...]) -> list[Episode]:
    """Play some of a job's units in a worker of a cluster."""
    todo = job.units()
    mine = [todo[k] for k in chosen]
    rest = iter(mine)
    played = _start(job, get_suite(job.suite), lambda: next(rest, None), sum(map(len, mine)))
    return [episode for finished in played for episode in finished]
