"""Real SIGKILLs at random moments, of the driver or of a worker: nothing is lost, the end is the same bytes.

CI runs 4 kills; ``make kill-test`` runs 200 (NAVREP_DATA_KILLS).
"""

import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from navrep_data.generate import generate
from navrep_data.shards import Manifest, verify

KILLS = int(os.environ.get("NAVREP_DATA_KILLS", "4"))
SETTINGS = {"n": 24, "length": 250, "humans": 8, "obstacles": 4, "shard_size": 1, "seed": 3}


def tree(root):
    return {
        p.relative_to(root).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(Path(root).rglob("*"))
        if p.is_file() and p.name != ".navrep-data.lock"
    }


def children(pid):
    """Worker processes of a driver (not multiprocessing's resource tracker)."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            pids = [int(word) for word in task.read_text().split()]
        except OSError:
            continue
        for child in pids:
            try:
                command = Path(f"/proc/{child}/cmdline").read_bytes()
            except OSError:
                continue
            if b"spawn_main" in command:
                found.append(child)
    return found


def check_listed(root):
    """Whatever the manifest lists is in place, with its hash."""
    if not (root / "manifest.json").exists():
        return 0
    manifest = Manifest.read(root)
    for entry in manifest.shards:
        for part in (entry, entry.worlds):
            assert hashlib.sha256((root / part.file).read_bytes()).hexdigest() == part.sha256
    return len(manifest.shards)


def kill(pid):
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def wait_for(process, condition, *arguments):
    """Wait until something is so or the process has ended, however long that takes; pytest's own limit ends a hang."""
    while process.poll() is None and not condition(*arguments):
        time.sleep(0.005)


def wait_for_shards(process, root, more):
    """Wait until there are so many more shards than now."""
    before = len(list(root.glob("data/*.h5")))
    wait_for(process, lambda: len(list(root.glob("data/*.h5"))) >= before + more)


def cut_last_files(root, rng):
    """What a power cut may leave of the files written last: shorter ones, and temp files."""
    files = sorted((p for p in root.rglob("*.h5")), key=lambda p: p.stat().st_mtime_ns)
    for path in files[-2:]:
        if rng.random() < 0.5:
            path.write_bytes(path.read_bytes()[: rng.randrange(path.stat().st_size + 1)])
    (root / "data").mkdir(exist_ok=True)
    (root / "data" / f".train-00000.h5.{rng.randrange(9999)}.part").write_bytes(b"half")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc to find worker processes")
def test_killed_runs_end_with_the_bytes_of_an_unbroken_one(tmp_path):
    generate(out=tmp_path / "unbroken", **SETTINGS)
    expected = tree(tmp_path / "unbroken")
    script = tmp_path / "run.py"
    root = tmp_path / "d"
    script.write_text(
        "from navrep_data.generate import generate\n"
        f"if __name__ == '__main__':\n    generate(out={str(root)!r}, workers=2, **{SETTINGS!r})\n"
    )
    rng = random.Random(0)
    kills, finished, listed, turn = {"driver": 0, "worker": 0}, 0, 0, 0
    while sum(kills.values()) < KILLS:
        process = subprocess.Popen([sys.executable, str(script)], stderr=subprocess.PIPE, text=True)
        turn += 1
        more = rng.randrange(-(turn % 2), 8)  # finished shards to wait for; -1: not even workers
        if more >= 0:
            wait_for(process, children, process.pid)
        wait_for_shards(process, root, more)
        if process.poll() is None:
            workers = children(process.pid)
            if workers and turn % 2 == 0:  # every other time, so that both happen however few there are
                kills["worker"] += kill(rng.choice(workers))
                wait_for_shards(process, root, rng.randrange(3))
            kills["driver"] += kill(process.pid)
        code = process.wait()
        error = process.stderr.read()
        process.stderr.close()
        assert code in (0, -signal.SIGKILL), error
        # what was listed stays listed: no kill loses a finished shard
        now = check_listed(root)
        assert now >= listed
        listed = now
        if code == 0:
            finished += 1
            assert tree(root) == expected
            shutil.rmtree(root)
            listed = 0
        elif rng.random() < 0.2 and (root / "manifest.json").exists():
            cut_last_files(root, rng)
            listed = 0
    generate(out=root, **SETTINGS)
    assert tree(root) == expected
    assert verify(root).ok
    print(f"{kills['driver']} drivers and {kills['worker']} workers killed, {finished} runs finished in between")
    assert min(kills.values()) > 0


@pytest.mark.slow
def test_a_dead_worker_is_replaced(tmp_path):
    """Kill every worker once, in the middle: the same run still ends with all its shards."""
    root = tmp_path / "d"
    script = tmp_path / "run.py"
    script.write_text(
        "from navrep_data.generate import generate\n"
        f"if __name__ == '__main__':\n    generate(out={str(root)!r}, workers=2, **{SETTINGS!r})\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], stderr=subprocess.PIPE, text=True)
    wait_for_shards(process, root, 1)
    killed = [kill(pid) for pid in children(process.pid)]
    error = process.communicate()[1]
    assert process.returncode == 0, error
    assert any(killed)
    assert verify(root).ok
    assert Manifest.read(root).sequences == SETTINGS["n"]


@pytest.mark.slow
def test_workers_do_not_outlive_their_driver(tmp_path):
    script = tmp_path / "run.py"
    script.write_text(
        "from navrep_data.generate import generate\n"
        "if __name__ == '__main__':\n"
        f"    generate(n=4000, out={str(tmp_path / 'd')!r}, workers=2, seed=1, shard_size=1)\n"
    )
    process = subprocess.Popen([sys.executable, str(script)])
    wait_for(process, lambda: len(children(process.pid)) == 2)
    workers = children(process.pid)
    assert len(workers) == 2
    wait_for_shards(process, tmp_path / "d", 1)
    kill(process.pid)
    process.wait()
    while any(Path(f"/proc/{pid}").exists() for pid in workers):  # pytest's own limit ends this where they stay
        time.sleep(0.05)
