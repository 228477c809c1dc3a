"""Generate and benchmark on a real Ray cluster of several nodes, whose workers and nodes are killed in the middle."""

import hashlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from navrep_data._ray import RayCluster
from navrep_data.errors import (
    ClusterError,
    ConfigError,
    FolderNotWritableError,
    MissingExtraError,
    PolicyError,
    WorkerDiedError,
)
from navrep_data.evaluate import benchmark
from navrep_data.generate import generate
from navrep_data.shards import verify

TESTS = Path(__file__).parent
# Ray's switch for the address of this machine, read when it is imported: 0 = the loopback, and tests may use no other
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
HERE = {"node_ip_address": "127.0.0.1", "object_store_memory": 100 << 20}
# dead nodes are noticed in a second or two instead of half a minute
NOTICE = {
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 500,
    "health_check_failure_threshold": 4,
}
PATIENT = "pilots_for_tests:patient"
"""A policy that waits for its turn in the cluster's workers, and only there, so that there is a middle to kill in."""
DATA = {"n": 24, "length": 40, "humans": 4, "obstacles": 3, "shard_size": 2, "seed": 5, "policy": PATIENT}
DATA["policy_batch"] = 2
RESULTS = "navreptest-original/pilots_for_tests-patient.json"

slow = pytest.mark.slow
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs navrep-data[ray]")
needs_proc = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc to find worker processes")


def tree(root):
    return {
        p.relative_to(root).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(Path(root).rglob("*"))
        if p.is_file() and p.name != ".navrep-data.lock"
    }


class Nodes:
    """A cluster on this machine: a head without processors, and nodes with one each."""

    def __init__(self, turnstile):
        self.turnstile, self.cluster = turnstile, None
        self.fill()

    def fill(self):
        """Have two living nodes; Ray gives each 30 s to start, which a busy machine may exceed: then all start anew."""
        for left in (2, 1, 0):
            try:
                if self.cluster is None:
                    self._begin()
                self._fill()
                return
            except Exception:
                self.shutdown()
                if not left:
                    raise

    def _begin(self):
        from ray.cluster_utils import Cluster

        self.nodes, self.dead = [], []
        self.cluster = Cluster()
        self.cluster.add_node(wait=False, num_cpus=0, include_dashboard=False, _system_config=NOTICE, **HERE)
        self.address = self.cluster.address

    def _fill(self):
        while self.dead:  # the helper counts them among its nodes until it is told
            self.cluster.remove_node(self.dead.pop(), allow_graceful=False)
        os.environ["TURNSTILE"] = str(self.turnstile)  # the nodes' workers inherit it
        try:
            while len(self.nodes) < 2:
                self.nodes.append(self.cluster.add_node(wait=False, num_cpus=1, **HERE))
        finally:
            del os.environ["TURNSTILE"]
        self.cluster.wait_for_nodes(timeout=300)

    @staticmethod
    def raylet(node):
        return node.all_processes["raylet"][0].process.pid

    def busy(self, node):
        """Processes of workers of this node that are in the middle of a task of ours."""
        found = []
        for task in Path(f"/proc/{self.raylet(node)}/task").glob("*/children"):
            for pid in task.read_text().split():
                try:
                    command = Path(f"/proc/{pid}/cmdline").read_bytes()
                except OSError:
                    continue
                if command.startswith(b"ray::_call"):
                    found.append(int(pid))
        return found

    def kill_worker(self, node, deadline):
        while time.monotonic() < deadline:
            if pids := self.busy(node):
                os.kill(pids[0], signal.SIGKILL)
                return pids[0]
            time.sleep(0.01)
        return None

    def kill_node(self, node):
        """The way of a machine that loses power: nothing of it says goodbye."""
        os.kill(self.raylet(node), signal.SIGKILL)
        self.nodes.remove(node)
        self.dead.append(node)
        return node

    def shutdown(self):
        if self.cluster is not None:
            self.cluster.shutdown()
            self.cluster = None


@pytest.fixture(scope="module")
def turnstile(tmp_path_factory):
    return tmp_path_factory.mktemp("turnstile")


@pytest.fixture(scope="module")
def nodes(turnstile):
    before = {name: os.environ.get(name) for name in ("PYTHONPATH", "TURNSTILE", "RAY_ADDRESS")}
    paths = [str(TESTS / "evaluate"), str(TESTS), str(TESTS.parent), *filter(None, [before["PYTHONPATH"]])]
    os.environ.pop("RAY_ADDRESS", None)
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)
    sys.path.insert(0, str(TESTS / "evaluate"))
    started = Nodes(turnstile)
    yield started
    started.shutdown()
    sys.path.remove(str(TESTS / "evaluate"))
    for name, value in before.items():
        os.environ.pop(name, None)
        if value is not None:
            os.environ[name] = value


class Killer(threading.Thread):
    """Kills a worker of one node once something is finished, and the other node once more is.

    Nothing of it is a race: the policy in the cluster waits for its turn at every call, and a kill comes while both
    nodes wait. Each portion of calls is so large that two workers cannot use it up without finishing a task, and both
    together are so small that work is left.

    Parameters
    ----------
    nodes : Nodes
        Two of them.
    turnstile : Path
        The folder where the policy asks.
    longest : int
        The most calls of the policy that a task takes.
    finished : callable
        Returns how much the driver has finished.
    """

    def __init__(self, nodes, turnstile, longest, finished):
        super().__init__(daemon=True)
        self.nodes, self.turnstile, self.longest, self.finished = nodes, turnstile, longest, finished
        self.worker, self.node, self.at = None, None, []
        (turnstile / "calls").write_bytes(b"")
        self._allow(0)

    def run(self):
        deadline = time.monotonic() + 1000
        first, second = self.nodes.nodes
        try:
            self._finish(1, deadline)
            self.worker = self.nodes.kill_worker(first, deadline)
            self.at.append(self.finished())
            self._finish(self.at[0] + 1, deadline)
            self.node = self.nodes.kill_node(second)
            self.at.append(self.finished())
        finally:
            (self.turnstile / "allowed").unlink()

    def _allow(self, calls):
        new = self.turnstile / "allowed.new"
        new.write_text(str(calls))
        new.replace(self.turnstile / "allowed")

    def _calls(self):
        return (self.turnstile / "calls").stat().st_size

    def _finish(self, count, deadline):
        """Let calls pass until so much is finished and both nodes wait for more."""
        # those that wait have their numbers already, and so has the worker that was killed
        allowed = self._calls() + 2 * self.longest + 1
        self._allow(allowed)
        while (self.finished() < count or self._calls() < allowed + 2) and time.monotonic() < deadline:
            time.sleep(0.01)


@slow
@needs_ray
@needs_proc
def test_a_dataset_survives_a_killed_worker_and_a_killed_node(nodes, turnstile, tmp_path):
    nodes.fill()
    generate(out=tmp_path / "here", **DATA)
    root = tmp_path / "there"
    killer = Killer(nodes, turnstile, DATA["length"], lambda: len(list(root.glob("data/*.h5"))))
    killer.start()
    result = generate(out=root, executor="ray", address=nodes.address, **DATA)
    killer.join()
    assert killer.worker is not None
    assert killer.node is not None
    assert 1 <= killer.at[0] < killer.at[1] < 12, "the kills were not in the middle"
    assert result.new_rows == 24 * 40  # nothing lost, nothing counted twice
    assert tree(root) == tree(tmp_path / "here")
    assert verify(root).ok


@slow
@needs_ray
@needs_proc
def test_a_benchmark_survives_a_killed_worker_and_a_killed_node(nodes, turnstile, tmp_path):
    nodes.fill()
    here = benchmark([PATIENT], episodes=64, out=tmp_path / "here", figures=False)
    done = [0]

    def watch(name, count, total):
        done[0] = count if name == PATIENT else 0

    longest = max(json.loads((tmp_path / "here" / RESULTS).read_text())["episodes"]["steps"])
    killer = Killer(nodes, turnstile, longest, lambda: done[0])
    killer.start()
    there = benchmark(
        [PATIENT], episodes=64, out=tmp_path / "there", figures=False, executor="ray", address=nodes.address,
        progress=watch,
    )  # fmt: skip
    killer.join()
    assert killer.worker is not None
    assert killer.node is not None
    assert 1 <= killer.at[0] < killer.at[1] < 64, "the kills were not in the middle"
    assert there.rows == here.rows
    assert tree(tmp_path / "there") == tree(tmp_path / "here")


@slow
@needs_ray
def test_scripted_policies_extending_and_urls(nodes, tmp_path):
    """Kernels in the workers; a shorter last shard is replaced; through fsspec, workers and driver alike."""
    nodes.fill()
    settings = {"length": 30, "humans": 4, "obstacles": 3, "shard_size": 2, "seed": 5}
    generate(n=7, out=tmp_path / "here", **settings)
    ray = {"executor": "ray", "address": nodes.address}
    lines = []
    for n in (3, 7):
        generate(n=n, out=tmp_path / "there", report=lines.append, **ray, **settings)
    assert tree(tmp_path / "there") == tree(tmp_path / "here")
    assert any("on a Ray cluster, 2 tasks at a time" in line for line in lines)
    generate(n=7, out=tmp_path / "home", storage=f"dir://far::file://{tmp_path}", **ray, **settings)
    assert tree(tmp_path / "far") == tree(tmp_path / "here")
    assert set(tree(tmp_path / "home")) == {"manifest.json", "README.md"}


@slow
@needs_ray
def test_errors_of_workers_are_one_line_of_ours(nodes, tmp_path):
    nodes.fill()
    with pytest.raises(PolicyError, match="returned NaN") as caught:
        benchmark(
            ["pilots_for_tests:not_a_number"], episodes=4, out=tmp_path / "b", figures=False, executor="ray",
            address=nodes.address,
        )  # fmt: skip
    assert "\n" not in str(caught.value)
    message = "is not a folder on node"
    with pytest.raises(FolderNotWritableError, match=message), RayCluster(nodes.address) as cluster:
        list(cluster.map(remove_then_run, tmp_path / "gone", [0]))


def remove_then_run(root, _):
    """What a worker on a machine without the shared folder sees."""
    from navrep_data.generate import executors
    from navrep_data.generate.worker import DatasetSpec

    spec = DatasetSpec(root, None, None, None, 0, ())
    return executors._run_remote(spec, None)


@slow
@needs_ray
def test_a_task_that_always_ends_its_worker_ends_the_run(nodes):
    nodes.fill()
    with pytest.raises(WorkerDiedError, match="died 4 times during one task"), RayCluster(nodes.address) as cluster:
        list(cluster.map(die, None, [0]))


def die(_, __):
    os._exit(1)


@slow
@needs_ray
def test_a_cluster_of_its_own_ends_with_the_run(tmp_path):
    """No address: Ray starts here and is gone afterwards; from the command line, as users do it."""
    words = "generate --n 3 --length 30 --humans 4 --obstacles 3 --shard-size 1 --executor ray --workers 1 --out d"
    env = {k: v for k, v in os.environ.items() if k != "RAY_ADDRESS"}
    done = subprocess.run(
        [sys.executable, "-m", "navrep_data", *words.split()], cwd=tmp_path, env=env, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "3 sequences, 90 rows, 3 shards" in done.stdout
    generate(n=3, length=30, humans=4, obstacles=3, shard_size=1, out=tmp_path / "here")
    assert tree(tmp_path / "d") == tree(tmp_path / "here")


@slow
@needs_ray
def test_from_the_command_line(nodes, tmp_path):
    nodes.fill()
    words = f"generate --n 3 --length 30 --humans 4 --obstacles 3 --executor ray --address {nodes.address} --out d"
    done = subprocess.run(
        [sys.executable, "-m", "navrep_data", *words.split()], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    generate(n=3, length=30, humans=4, obstacles=3, out=tmp_path / "here")
    assert tree(tmp_path / "d") == tree(tmp_path / "here")


@pytest.mark.slow
@needs_ray
def test_no_cluster_there(tmp_path):
    with pytest.raises(
        ClusterError, match=r"No Ray cluster can be used at 127\.0\.0\.1:1 \(.*refused.*\); expected the"
    ):
        generate(n=3, executor="ray", address="127.0.0.1:1", out=tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_without_ray_the_pip_command_is_told(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'navrep-data\[ray\]'"):
        generate(n=2, out=tmp_path / "d", executor="ray", length=30)
    assert not (tmp_path / "d").exists()
    with pytest.raises(MissingExtraError, match=r"pip install 'navrep-data\[ray\]'"):
        benchmark(["goal"], episodes=2, out=tmp_path / "b", executor="ray", figures=False)


def test_flags_that_do_not_fit(tmp_path):
    with pytest.raises(ConfigError, match="expected one of: local, ray"):
        generate(n=2, out=tmp_path / "d", executor="slurm")
    with pytest.raises(ConfigError, match="expected --executor ray"):
        generate(n=2, out=tmp_path / "d", address="auto")
    with pytest.raises(ConfigError, match="expected one of: local, ray"):
        benchmark(["goal"], executor="slurm", out=tmp_path / "b")
    with pytest.raises(ConfigError, match="expected executor ray"):
        benchmark(["goal"], address="auto", out=tmp_path / "b")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_ray_is_imported_only_where_it_is_used():
    code = "import sys, navrep_data.cli.main, navrep_data.generate; sys.exit('ray' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
