"""Datasets as files: bytes are a function of settings and seed, whatever happens on the way."""

import dataclasses
import gc
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numba
import numpy as np
import pytest

from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetLockedError,
    DatasetMismatchError,
    DiskSpaceError,
    FolderInUseError,
    PolicyError,
    SchemaVersionError,
)
from navrep_data.generate import compiling, driver, executors, generate, plan
from navrep_data.generate.compiling import Compiling
from navrep_data.io import json_bytes
from navrep_data.shards import DatasetFolder, Manifest, verify, writer_lock
from navrep_data.sim import RolloutSettings, ScriptedPolicy, ScriptedRollout, make_config

SMALL = {"humans": 4, "obstacles": 3, "length": 30, "shard_size": 2, "seed": 5}


def tree(root):
    """Hash of every file of a dataset but the lock."""
    return {
        str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(Path(root).rglob("*"))
        if p.is_file() and p.name != ".navrep-data.lock"
    }


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Seven sequences in five shards, made in one go: 0, 3 and 4, 5 and 6 for training, 1 val, 2 test."""
    root = tmp_path_factory.mktemp("reference") / "d"
    result = generate(n=7, out=root, **SMALL)
    return root, result, tree(root)


def test_result_and_files(reference):
    root, result, files = reference
    assert (result.rows, result.sequences, result.shards, result.new_rows) == (210, 7, 5, 210)
    assert result.bytes == sum(p.stat().st_size for p in root.rglob("*.h5")) + sum(
        p.stat().st_size for p in root.rglob("*.npz")
    )
    assert sum(result.outcomes.values()) >= 7
    expected = {"README.md", "manifest.json"}
    names = [*(f"train-{k:05d}" for k in range(3)), "val-00000", "test-00000"]
    expected |= {f"data/{name}.h5" for name in names} | {f"worlds/{name}.npz" for name in names}
    assert set(files) == expected
    manifest = json.loads((root / "manifest.json").read_text())
    for shard in manifest["shards"]:
        assert files[shard["file"]] == shard["sha256"]
        assert shard["rows"] in (60, 30)
    assert manifest["complete"]
    report = verify(root)
    assert report.ok, report.problems


def test_manifest_knows_nothing_of_time_host_and_folder(reference):
    root, _, _ = reference
    text = (root / "manifest.json").read_text() + (root / "README.md").read_text()
    assert str(root) not in text
    assert not re.search(rf"\b{re.escape(os.uname().nodename)}\b", text)
    assert time.strftime("%Y-%m-%d") not in text


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 3])
def test_any_number_of_workers_writes_the_same_bytes(reference, tmp_path, workers):
    generate(n=7, out=tmp_path / "d", workers=workers, **SMALL)
    assert tree(tmp_path / "d") == reference[2]


def test_extending_gives_the_bytes_of_a_larger_run(reference, tmp_path):
    root = tmp_path / "d"
    # numbers of numpy are numbers
    generate(n=np.int64(3), out=root, workers=np.uint8(1), **{name: np.int64(value) for name, value in SMALL.items()})
    result = generate(n=7, out=root, **SMALL)
    assert result.new_rows == (7 - 3) * 30
    assert tree(root) == reference[2]


def test_running_again_does_nothing(reference, tmp_path):
    root = tmp_path / "d"
    shutil.copytree(reference[0], root)
    before = {p: p.stat().st_mtime_ns for p in root.rglob("*.h5")}
    lines = []
    result = generate(n=7, out=root, report=lines.append, **SMALL)
    assert result.new_rows == 0
    assert result.rows == 210
    assert "already holds all 7 sequences" in lines[-1]
    assert {p: p.stat().st_mtime_ns for p in root.rglob("*.h5")} == before
    assert tree(root) == reference[2]


@pytest.mark.slow
@pytest.mark.parametrize("stop_after", [0, 1, 3])
def test_an_interrupted_run_goes_on(reference, tmp_path, monkeypatch, stop_after):
    root = tmp_path / "d"
    real = executors.make_shard
    made = []

    def interrupted(*args):
        if len(made) == stop_after:
            raise KeyboardInterrupt
        made.append(real(*args))
        return made[-1]

    monkeypatch.setattr(executors, "make_shard", interrupted)
    with pytest.raises(KeyboardInterrupt):
        generate(n=7, out=root, **SMALL)
    monkeypatch.setattr(executors, "make_shard", real)
    assert not Manifest.read(root).complete
    DatasetFolder(root).close()
    generate(n=7, out=root, **SMALL)
    assert tree(root) == reference[2]


@pytest.mark.slow
@pytest.mark.parametrize("harm", ["truncate", "delete", "flip", "worlds"])
def test_a_damaged_shard_is_made_again(reference, tmp_path, harm):
    root = tmp_path / "d"
    shutil.copytree(reference[0], root)
    path = root / ("worlds/train-00001.npz" if harm == "worlds" else "data/train-00001.h5")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    if harm == "delete":
        path.unlink()
    else:
        path.write_bytes(data[: len(data) // 2] if harm == "truncate" else data)
    lines = []
    generate(n=7, out=root, report=lines.append, **SMALL)
    assert any("train-00001" in line and "making it again" in line for line in lines)
    assert tree(root) == reference[2]


@pytest.mark.slow
@pytest.mark.parametrize("cut", [0, 1, 500])
def test_a_cut_manifest_is_made_again(reference, tmp_path, cut):
    root = tmp_path / "d"
    shutil.copytree(reference[0], root)
    manifest = root / "manifest.json"
    manifest.write_bytes(manifest.read_bytes()[:cut])
    (root / "data" / "val-00000.h5").write_bytes(b"\x89HDF")
    lines = []
    generate(n=7, out=root, report=lines.append, **SMALL)
    assert "manifest.json is damaged; making the dataset again." in lines
    assert tree(root) == reference[2]


@pytest.mark.parametrize(
    "other",
    [{"seed": 6}, {"policy": "goal-momentum"}, {"policy": "goal"}, {"labels": True}, {"scan_dtype": "float32"}],
    ids=str,
)
def test_a_cut_manifest_over_other_data_is_refused(reference, tmp_path, other):
    root = tmp_path / "d"
    shutil.copytree(reference[0], root)
    (root / "manifest.json").write_bytes(b"{")
    before = tree(root)
    with pytest.raises(CorruptDataError, match="not valid JSON"):
        generate(**{**SMALL, "n": 7, "out": root, **other})
    assert tree(root) == before


def test_leftovers_of_a_killed_run_disappear(reference, tmp_path):
    root = tmp_path / "d"
    shutil.copytree(reference[0], root)
    (root / "data" / ".train-00009.h5.123.part").write_bytes(b"x" * 100)
    (root / ".staging" / "data").mkdir(parents=True)
    (root / ".staging" / "data" / "train-00003.h5").write_bytes(b"x")
    generate(n=7, out=root, **SMALL)
    assert tree(root) == reference[2]


def test_leftovers_of_workers_killed_in_this_run_disappear(reference, tmp_path):
    root = tmp_path / "d"

    def leave_a_temp_file(line):  # the plan is said once the leftovers of earlier runs are gone
        if " rows, about " in line:
            (root / "data").mkdir(parents=True)
            (root / "data" / ".train-00002.h5.123.part").write_bytes(b"x" * 100)
            (root / "worlds").mkdir()
            (root / "worlds" / ".train-00002.npz.123.part").write_bytes(b"x")

    generate(n=7, out=root, report=leave_a_temp_file, **SMALL)
    assert tree(root) == reference[2]


@pytest.mark.slow
def test_sigkill_of_the_driver_loses_nothing(reference, tmp_path):
    """Kill the whole run at some moments; the same command then ends with the same bytes."""
    root = tmp_path / "d"
    code = (
        "from navrep_data.generate import generate\n"
        f"if __name__ == '__main__': generate(n=7, out={str(root)!r}, **{SMALL!r})\n"
    )
    script = tmp_path / "run.py"
    script.write_text(code)
    for moment in ("*", "data/.*", "data/*.h5", "data/*1.h5"):  # the lock; a shard in the making; one, two finished
        before = set(root.glob(moment))
        process = subprocess.Popen([sys.executable, str(script)])
        while not set(root.glob(moment)) - before and process.poll() is None:
            time.sleep(0.001)
        process.send_signal(signal.SIGKILL)
        process.wait()
        if (root / "manifest.json").exists():
            for entry in Manifest.read(root).shards:
                assert hashlib.sha256((root / entry.file).read_bytes()).hexdigest() == entry.sha256
    generate(n=7, out=root, **SMALL)
    assert tree(root) == reference[2]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seed": 6}, "was made with seed=5, asked for seed=6"),
        ({"humans": 5}, "humans=4, asked for humans=5"),
        ({"length": 31}, "length=30, asked for length=31"),
        ({"shard_size": 3}, "shard_size=2, asked for shard_size=3"),
        ({"policy": "random-momentum"}, "policy=orca, asked for policy=random-momentum"),
        ({"rings": False}, "columns=scan, rings"),
        ({"scan_dtype": "float32"}, "scan_dtype=uint16"),
        ({"legs": False}, "rendering=legs, asked for rendering=trunk"),
        ({"n": 6}, "n=7, asked for n=6"),
    ],
)
def test_other_settings_are_refused_by_name(reference, changes, words):
    before = tree(reference[0])
    with pytest.raises(DatasetMismatchError, match=words):
        generate(**{"n": 7, "out": reference[0], **SMALL, **changes})
    assert tree(reference[0]) == before


def test_shard_size_need_not_be_repeated(tmp_path):
    settings = {**SMALL, "n": 5, "out": tmp_path / "d"}
    generate(**settings)
    del settings["shard_size"]
    assert generate(**{**settings, "n": 6}).shards == 4


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(FolderInUseError, match=r"holds something else \(thesis.tex\)"):
        generate(n=2, out=tmp_path, **SMALL)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(FolderInUseError, match="is or lies under a file"):
        generate(n=2, out=tmp_path / "thesis.tex" / "d", **SMALL)


def test_refused_settings_leave_no_trace(tmp_path):
    for bad in (
        {"n": 0},
        {"n": -3},
        {"workers": 0},
        {"length": 0},
        {"seed": -1},
        {"humans": 61},
        {"scan_dtype": "int8"},
    ):
        with pytest.raises(ConfigError, match=next(iter(bad)).replace("_", "[-_]")):
            generate(**{"n": 2, "out": tmp_path / "d", **SMALL, **bad})
    assert not (tmp_path / "d").exists()


def test_one_writer_at_a_time(tmp_path):
    root = tmp_path / "d"
    generate(n=2, out=root, **SMALL)
    with writer_lock(root), pytest.raises(DatasetLockedError, match="Another process is writing"):
        generate(n=3, out=root, **SMALL)
    assert generate(n=3, out=root, **SMALL).sequences == 3


def test_too_little_disk_is_said_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(plan.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 10_000))
    with pytest.raises(DiskSpaceError, match=r"0.00 GB free, about .* GB are needed for 2 sequences"):
        generate(n=2, out=tmp_path / "d", **SMALL)
    assert not (tmp_path / "d").exists()


def test_a_manifest_too_large_to_be_read_is_said_before_anything_is_made(tmp_path, monkeypatch):
    """At the default shard size a billion rows would end in one."""
    monkeypatch.setattr(plan.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**14, 0, 10**14))
    with pytest.raises(ConfigError, match=r"manifest larger than 256 MiB, the most that is read: give --shard-size 34"):
        generate(n=1_000_000, out=tmp_path / "d")
    with pytest.raises(ConfigError, match="make several datasets, or longer sequences"):
        generate(n=10_000_000, out=tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_manifests_are_no_larger_than_planned(reference):
    shards = json.loads((reference[0] / "manifest.json").read_text())["shards"]
    per_shard = len(json_bytes({"shards": shards})) / 5
    assert 0.5 < per_shard / (plan._MANIFEST_SHARD_BYTES + 2 * plan._MANIFEST_SEQUENCE_BYTES) < 1


@pytest.mark.slow
def test_disk_full_in_the_middle_keeps_what_is_finished(reference, tmp_path):
    """A real limit on file size: larger shards cannot be written, the smaller last one can."""
    root = tmp_path / "d"
    size = max(p.stat().st_size for p in (reference[0] / "data").iterdir())
    code = (
        "import resource, sys, signal\n"
        "from navrep_data.generate import generate\n"
        "from navrep_data.errors import DiskSpaceError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        f"root, small = {str(root)!r}, {SMALL!r}\n"
        "generate(n=2, out=root, **small)\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({size // 2}, {size // 2}))\n"
        "try:\n    generate(n=7, out=root, **small)\n"
        "except DiskSpaceError as error:\n    print(error); sys.exit(7)\n"
    )
    env = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert done.returncode == 7, done.stderr
    assert "No room left while writing" in done.stdout
    assert "\n" not in done.stdout.strip()
    manifest = Manifest.read(root)
    assert (manifest.sequences, manifest.complete) == (2, False)
    assert not list(root.rglob("*.part"))
    generate(n=7, out=root, **SMALL)
    assert tree(root) == reference[2]


@pytest.mark.slow
def test_a_read_only_folder_is_named(tmp_path):
    """As an ordinary user: root may write everywhere, so a root process gives itself up after its imports."""
    folder = tmp_path / "ro"
    folder.mkdir()
    folder.chmod(0o555)
    for parent in [tmp_path, *tmp_path.parents]:
        if parent == Path(tempfile.gettempdir()):
            break
        parent.chmod(parent.stat().st_mode | 0o055)
    code = (
        "import os, sys\nfrom navrep_data.generate import generate\n"
        "from navrep_data.errors import FolderNotWritableError\n"
        f"generate(n=1, out={str(tmp_path / 'warm')!r}, length=5)\n"
        "if os.geteuid() == 0: os.setuid(65534)\n"
        f"for out in ({str(folder)!r}, {str(folder / 'd')!r}):\n"
        "    try:\n        generate(n=2, out=out, length=5)\n"
        "    except FolderNotWritableError as error:\n        print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    assert first.startswith(f"Cannot write {folder}")
    assert second.startswith(f"Cannot make the folder {folder / 'd'}")


def test_a_newer_format_is_not_touched(reference, tmp_path):
    root = tmp_path / "d"
    shutil.copytree(reference[0], root)
    values = json.loads((root / "manifest.json").read_text())
    values["format_version"] = 99
    (root / "manifest.json").write_text(json.dumps(values))
    before = tree(root)
    with pytest.raises(SchemaVersionError, match="format version 99"):
        generate(n=8, out=root, **SMALL)
    assert tree(root) == before


@pytest.mark.slow
def test_python_policies_do_not_depend_on_how_many_sequences_there_are(tmp_path):
    def network(scan, robot_state):
        weights = np.random.default_rng(0).normal(size=(1085, 2)).astype(np.float32)
        return np.tanh(np.concatenate([scan, robot_state], axis=1) @ weights * 0.01)

    settings = {**SMALL, "policy": network, "policy_batch": 2, "shard_size": 3}
    generate(n=4, out=tmp_path / "a", **settings)
    generate(n=7, out=tmp_path / "a", **settings)
    generate(n=7, out=tmp_path / "b", **settings)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")
    assert Manifest.read(tmp_path / "a").policy["name"].endswith("network")


@pytest.mark.slow
def test_a_policy_that_cannot_travel_says_so(tmp_path):
    with pytest.raises(PolicyError, match="cannot be sent to worker processes"):
        generate(n=4, out=tmp_path / "d", workers=2, policy=lambda s, r: np.zeros((len(s), 2)), **SMALL)


@pytest.mark.slow
def test_policies_by_name_work_in_workers(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own_policy.py").write_text(
        "import numpy as np\n\ndef creep(scan, robot_state):\n    return np.full((len(scan), 2), 0.05)\n"
    )
    a = generate(n=4, out=tmp_path / "a", workers=2, policy="own_policy:creep", **SMALL)
    generate(n=4, out=tmp_path / "b", workers=1, policy="own_policy:creep", **SMALL)
    assert a.rows == 120
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


def test_plan_is_said_first(tmp_path):
    lines = []
    generate(n=2, out=tmp_path / "d", report=lines.append, **SMALL)
    plan_line = next(line for line in lines if "sequences x" in line)
    assert plan_line.startswith("2 sequences x 30 steps = 60 rows, about ")
    assert plan_line.endswith("on 1 core")


def test_shard_size_is_bounded_by_memory(tmp_path):
    with pytest.raises(ConfigError, match="--shard-size is 100000, expected at most"):
        generate(n=2, out=tmp_path / "d", shard_size=100_000)


def test_long_ranges_choose_float32_and_refuse_millimetres():
    config = driver.make_config("soadrl")
    far = dataclasses.replace(config, sensor=dataclasses.replace(config.sensor, range_max=100.0))
    assert plan.check_settings(far, 10, None, True, True).scan_dtype == "float32"
    assert plan.check_settings(config, 10, None, True, True).scan_dtype == "uint16"
    with pytest.raises(ConfigError, match="uint16 holds ranges up to 65 m, but range_max is 100 m"):
        plan.check_settings(far, 10, "uint16", True, True)


def test_estimate_is_close(tmp_path):
    lines = []
    result = generate(n=2, out=tmp_path / "d", length=300, report=lines.append)
    said = next(line for line in lines if "about" in line).split("about ")[1].split(" in ")[0]
    value, unit = said.split()
    estimate = float(value) * {"kB": 1e3, "MB": 1e6}[unit]
    assert abs(estimate / result.bytes - 1) < 0.15


def test_datasets_of_before_there_were_more_settings_go_on(tmp_path):
    """A manifest that does not name later settings stands for their defaults, and only for those."""
    out = tmp_path / "d"
    generate(env="navrep-train", n=2, out=out, **SMALL)
    stored = json.loads((out / "manifest.json").read_text())["config"]
    assert sorted(stored) == [
        "crossing", "env", "humans", "obstacles", "physics", "polygon_scale", "rendering", "sensor", "time_limit",
    ]  # fmt: skip
    before = tree(out)
    generate(env="navrep-train", n=2, out=out, **SMALL)
    assert tree(out) == before
    old = Manifest.read(out)
    dataclasses.replace(old, config={**old.config, "drive": "differential"}).save(out)
    with pytest.raises(DatasetMismatchError, match="made with drive=differential, asked for drive=holonomic"):
        generate(env="navrep-train", n=3, out=out, **SMALL)


@pytest.mark.parametrize("env", ["cadrl", "empty"])
def test_worlds_without_polygons_feed_datasets(tmp_path, env):
    generate(env=env, n=1, out=tmp_path / "d", length=200)
    assert verify(tmp_path / "d").problems == []
    with pytest.raises(ConfigError, match="world='empty', obstacles=3 cannot be combined"):
        generate(env=env, n=1, out=tmp_path / "e", obstacles=3)
    assert not (tmp_path / "e").exists()


@pytest.mark.slow
@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="kernels are plain Python here")
def test_what_is_compiled_ahead_is_what_a_sequence_calls(monkeypatch, tmp_path):
    small = {"n": 1, "length": 3}
    generate(out=tmp_path / "first", **small)
    rollout = ScriptedRollout(make_config("soadrl"), RolloutSettings(length=3), ScriptedPolicy("orca"), seed=0)
    said = []
    with Compiling(said.append, progress=False):
        for kernel, arguments in (*rollout.parts()[0], *rollout.parts()[1]):
            kernel.prepare(arguments)
        monkeypatch.setattr(compiling, "is_missing", lambda kernel: True)
        monkeypatch.setattr(compiling.os, "cpu_count", lambda: 2)
        generate(out=tmp_path / "second", **small)
    assert said == []  # all of it was there: the types are the same
    helper = subprocess.run([sys.executable, "-m", "navrep_data.generate.compiling", "uint16"], timeout=300)
    assert helper.returncode == 0


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="kernels are plain Python here")
def test_compiling_is_told_and_counted_once_it_happens(capsys):
    said = []
    number = numba.njit(lambda x: x + 1)
    with Compiling(said.append, progress=True):
        assert number(1) == 2
        assert number(1.0) == 2.0
    assert said == ["Compiling kernels for this machine (once, about half a minute)"]
    assert re.search(r"Compiling: \d kernels", capsys.readouterr().err)
    with Compiling(said.append, progress=True):
        assert number(1) == 2
    with Compiling(said.append, progress=False):
        assert number(2j) == 1 + 2j
    assert len(said) == 2
    assert capsys.readouterr().err == ""
    assert gc.isenabled()
