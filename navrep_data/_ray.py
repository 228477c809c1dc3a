"""Calls on a Ray cluster: handed out a few at a time, made again where a worker or a node dies.

Ray is optional (the extra ``ray``) and imported only when a cluster is entered.
"""

from __future__ import annotations

import os
import platform
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Generic, TypeVar

from navrep_data._version import __version__
from navrep_data.errors import ClusterError, MissingExtraError, NavrepDataError, WorkerDiedError
from navrep_data.io import translate_os_error

PIP_COMMAND = "pip install 'navrep-data[ray]'"
LOCAL = "local"
"""What stands for a cluster of this machine's own, started and stopped with the run."""
# Calls waiting on the cluster per processor: none goes idle between two calls, and an autoscaler sees the demand.
QUEUED_PER_CPU = 2
POLL_SECONDS = 0.2
KNOCK_SECONDS = 10.0
# Clusters grow and shrink: this often their size is looked up again.
RESIZE_SECONDS = 5.0
# A call that ends its worker, or loses its node, this often is at fault itself.
MAX_DEATHS = 3
# What calls return is a few kB each; Ray would otherwise set aside 30 % of the memory of a machine of its own.
LOCAL_STORE_BYTES = 256 << 20

Task = TypeVar("Task")
Result = TypeVar("Result")


class _LostError(Exception):
    """A call has no result because its worker or node died."""


class RayCluster(Generic[Task, Result]):
    """A connection to a Ray cluster, for the duration of a ``with`` block.

    Parameters
    ----------
    address : str, optional
        As ``ray.init`` takes it: ``host:port`` or ``auto``. By default what ``RAY_ADDRESS`` says, or else a cluster on
        this machine alone that ends with the block. A connection that the caller has made before is used and kept.
    workers : int, optional
        Most calls at the same time; by default as many as the cluster has processors.

    Raises
    ------
    MissingExtraError
        If Ray is not installed.
    ClusterError
        If there is no cluster at the address, or it has no processor.
    """

    def __init__(self, address: str | None = None, workers: int | None = None) -> None:
        self.address = address
        self.workers = workers
        self._ours = False
        self._cpus = 0
        self._asked_at = 0.0

    def __enter__(self) -> RayCluster[Task, Result]:
        self._ray = _import_ray()
        if not self._ray.is_initialized():
            self._connect()
            self._ours = True
        if self.cpus < 1:
            self.__exit__()
            raise ClusterError(
                f"The Ray cluster at {self.address or 'RAY_ADDRESS'} has no processor, expected nodes that run tasks; "
                "add some (ray start --address=...), or look at: ray status"
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._ours:
            self._ray.shutdown()
            self._ours = False

    def _connect(self) -> None:
        where = self.address or os.environ.get("RAY_ADDRESS") or LOCAL
        options: dict[str, Any] = {}
        _check_reachable(where)
        if where == LOCAL:
            options = {
                "num_cpus": self.workers,
                "object_store_memory": LOCAL_STORE_BYTES,
                "include_dashboard": False,
                "_node_ip_address": "127.0.0.1",  # nobody else has any business there
            }
        try:
            self._ray.init(address=where, log_to_driver=False, logging_level="error", **options)
        except (ConnectionError, TimeoutError, ValueError, RuntimeError) as error:
            raise _no_cluster(where, error) from error

    @property
    def cpus(self) -> int:
        """Processors of the cluster, as of a few seconds ago at most."""
        if not self._asked_at or time.monotonic() - self._asked_at > RESIZE_SECONDS:
            self._cpus = int(self._ray.cluster_resources().get("CPU", 0))
            self._asked_at = time.monotonic()
        return self._cpus

    @property
    def _room(self) -> int:
        """How many calls may be on the cluster at once."""
        return self.workers if self.workers is not None else max(1, QUEUED_PER_CPU * self.cpus)

    def map(
        self, function: Callable[[Any, Task], Result], common: Any, tasks: Iterable[Task]
    ) -> Iterator[tuple[Task, Result, str] | None]:
        """Yield each task with its result and its node's name, in any order, and None several times a second.

        Parameters
        ----------
        function : callable
            Called in workers as ``function(common, task)``; importable there.
        common : object
            Sent once.
        tasks : iterable
            Hashable, small.

        Raises
        ------
        NavrepDataError
            What `function` raised.
        ClusterError
            If workers cannot import what they need, or have another version of this package.
        WorkerDiedError
            If a call has ended its worker more often than it may.
        """
        ray = self._ray
        call = ray.remote(num_cpus=1, max_retries=0)(_call)  # Ray's own retries would not count out-of-memory kills
        shared = ray.put(common)
        waiting, again = iter(tasks), deque[Task]()
        deaths: Counter[Task] = Counter()
        running: dict[Any, Task] = {}
        try:
            while True:
                while len(running) < self._room:
                    task = again.popleft() if again else next(waiting, None)
                    if task is None:
                        break
                    running[call.remote(function, shared, task, __version__)] = task
                if not running:
                    return
                for ref in ray.wait(list(running), num_returns=1, timeout=POLL_SECONDS)[0]:
                    task = running.pop(ref)
                    try:
                        yield task, *self._get(ref)
                        continue
                    except _LostError as error:
                        deaths[task] += 1
                        if deaths[task] > MAX_DEATHS:
                            raise WorkerDiedError(
                                f"Workers or nodes of the Ray cluster died {deaths[task]} times during one task (last: "
                                f"{error}). What was finished is intact; run the same command again, perhaps with "
                                "fewer --workers."
                            ) from error
                        again.append(task)
                yield None
        finally:
            if ray.is_initialized():  # the connection may have ended first
                for ref in running:
                    ray.cancel(ref, force=True)

    def _get(self, ref: Any) -> tuple[Result, str]:
        """Return a call's result and node; raises _LostError if its worker or node died."""
        errors = self._ray.exceptions
        lost = (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError, errors.ObjectLostError)
        try:
            good, value, node = self._ray.get(ref)
        except lost as error:
            raise _LostError(f"{type(error).__name__}: {error}") from error
        except errors.RayTaskError as error:
            if isinstance(error.cause, ImportError):
                raise ClusterError(
                    f"A worker of the Ray cluster cannot import what it needs ({error.cause}); install navrep-data "
                    f"{__version__}, and your own module, on every node."
                ) from error
            raise
        if not good:
            raise value
        return value, node


def _call(function: Callable[[Any, Any], Any], common: Any, task: Any, version: str) -> tuple[bool, Any, str]:
    """Run in a worker; errors of ours travel as values, because Ray's wrapping makes a page of a line."""
    node = platform.node()
    if version != __version__:
        return False, ClusterError(
            f"Node {node} has navrep-data {__version__}, expected {version} as here: install the same version on "
            "every node."
        ), node  # fmt: skip
    try:
        return True, function(common, task), node
    except NavrepDataError as error:
        return False, error, node
    except OSError as error:
        return False, translate_os_error(error), node


def _no_cluster(where: str, error: Exception) -> ClusterError:
    return ClusterError(
        f"No Ray cluster can be used at {where} ({error}); expected the host:port that "
        "`ray start --head` prints, or no --address for a cluster on this machine."
    )


def _check_reachable(where: str) -> None:
    """Knock at a host:port: Ray itself would try for minutes."""
    host, _, port = where.rpartition("://")[2].rpartition(":")
    if not host or not port.isdecimal():
        return
    try:
        socket.create_connection((host, int(port)), timeout=KNOCK_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise _no_cluster(where, error) from error


def _import_ray() -> Any:
    # a cluster that we start would otherwise report its use to Ray's makers
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise MissingExtraError(
            f"Running on a cluster needs Ray, which is not installed ({error}). Run {PIP_COMMAND}, or leave "
            "--executor ray out."
        ) from error
    return ray
