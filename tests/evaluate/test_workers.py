"""Worker processes, interruptions by SIGKILL, and the released policies against the original software's episodes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from recorded import reference

from navrep_data.evaluate import benchmark, wilson

pytestmark = pytest.mark.slow  # seconds to a minute each; `make test` runs them


@pytest.fixture
def scores():
    return reference("original_scores.json")


@pytest.mark.parametrize("policy", ["dwa", "pilots_for_tests:Counting"])
def test_one_worker_and_three_write_the_same_bytes(tmp_path, policy, monkeypatch):
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([here, os.environ.get("PYTHONPATH", "")]))
    for workers in (1, 3):
        benchmark([policy], episodes=30, workers=workers, out=tmp_path / str(workers), figures=False)
    one, three = (sorted((tmp_path / str(w) / "navreptest-original").iterdir()) for w in (1, 3))
    assert [f.name for f in one] == [f.name for f in three]
    assert [f.read_bytes() for f in one] == [f.read_bytes() for f in three]


def run_slowly(out, workers, patience):
    arguments = [
        "pilots_for_tests:patient", "--episodes", "300", "--workers", str(workers), "--out", str(out), "--no-figures",
    ]  # fmt: skip
    here = str(Path(__file__).parent)
    path = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", "navrep_data", "benchmark", *arguments],
        env={**os.environ, "PYTHONPATH": path, "PATIENCE": str(patience)}, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.mark.parametrize("workers", [1, 2])
def test_sigkill_loses_little_and_the_same_command_goes_on(tmp_path, workers):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    first = run_slowly(whole, 1, 0)
    first.communicate()
    assert first.returncode == 0
    file = "navreptest-original/pilots_for_tests-patient.json"
    process = run_slowly(cut, workers, 0.1)
    while not (cut / file).exists() and process.poll() is None:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    process.stdout.close()
    outcome = json.loads((cut / file).read_text())["outcome"]
    assert 0 < len(outcome) - outcome.count("-") < 300
    again = run_slowly(cut, workers, 0)
    assert "| 300 " in again.communicate()[0]
    assert again.returncode == 0
    assert (cut / file).read_bytes() == (whole / file).read_bytes()


def test_a_worker_that_fails_says_why(tmp_path, monkeypatch):
    from navrep_data.errors import PolicyError

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]))
    with pytest.raises(PolicyError, match="returned NaN"):
        benchmark(["pilots_for_tests:not_a_number"], episodes=20, workers=2, out=tmp_path, figures=False)


@pytest.mark.parametrize(("name", "least_equal"), [("e2e_1d.20201026", 0.98), ("transformer_1d_z.20200916", 0.98)])
def test_released_policies_land_where_they_landed_in_the_original(tmp_path, released, scores, name, least_equal):
    """Success within 3 points on the 200 seeded test episodes; outcomes and steps compared one by one."""
    report = benchmark([name], source=released, out=tmp_path, figures=False)
    found = json.loads((tmp_path / "navreptest-original" / f"{name}.json").read_text())
    zips = {Path(path).name for path in found["settings"]["policy_files"]}
    (theirs,) = (r for key, r in scores["navreptrain_test"].items() if r["zip"] in zips and key.endswith("|-"))
    assert theirs["n"] == report.rows[0]["episodes"] == 200
    assert report.rows[0]["success_rate"] == pytest.approx(theirs["success"], abs=0.03)
    equal = [a == b for a, b in zip(found["outcome"], theirs["outcome"], strict=True)]
    assert sum(equal) / 200 >= least_equal
    same_steps = [a == b for a, b in zip(found["episodes"]["steps"], theirs["steps"], strict=True)]
    assert sum(same_steps) / 200 >= 0.97


def test_networks_do_not_depend_on_the_batch(tmp_path, released):
    files = []
    for batch in (1, 7, 64):
        benchmark(
            ["e2e_1d.20201026"], episodes=20, source=released, out=tmp_path / str(batch), figures=False, batch=batch
        )
        files.append((tmp_path / str(batch) / "navreptest-original" / "e2e_1d.20201026.json").read_bytes())
    assert files[0] == files[1] == files[2]


def test_as_released_does_not_depend_on_what_was_played_before(tmp_path, released):
    options = {"inference": "as_released", "source": released, "figures": False}
    name = "transformer_1d_zh.released"
    file = f"navreptest-original/{json_name(tmp_path, name, options)}"
    benchmark([name], episodes=6, out=tmp_path / "a", **options)
    benchmark([name], episodes=9, out=tmp_path / "a", **options)
    benchmark([name], episodes=9, out=tmp_path / "b", workers=2, **options)
    first, second = (json.loads((tmp_path / x / file).read_text()) for x in "ab")
    assert first == second
    quiet = benchmark([name], episodes=9, out=tmp_path / "c", source=released, figures=False)
    assert quiet.rows[0]["path_length"] != first["episodes"]["path_length"]


def json_name(tmp_path, name, options):
    report = benchmark([name], episodes=1, out=tmp_path / "names", **options)
    return next(f.name for f in report.files if "as_released" in f.name)


def test_e2e_on_the_first_four_rounds_of_navrep27(tmp_path, released, scores, maps):
    """25 of 108 in the original: within that share's 95 % interval, outcomes compared one by one."""
    report = benchmark(
        ["e2e_1d.20201026"], "navrep27", episodes=4, source=released, out=tmp_path, figures=False, ranges="as_released"
    )
    (theirs,) = scores["ian"].values()
    assert theirs["outcome"].count("S") == 25
    low, high = wilson(25, 108)
    assert low <= report.rows[0]["success_rate"] <= high
    file = tmp_path / "navrep27-original" / "e2e_1d.20201026.ranges-as_released.json"
    ours = json.loads(file.read_text())["outcome"]
    assert sum(a == b for a, b in zip(ours, theirs["outcome"], strict=True)) >= 0.8 * 108


def test_goal_on_the_first_four_rounds_of_navrep27(tmp_path, scores, maps):
    """18.5 % in the original's control."""
    assert "18.5 % (27 scenarios)" in scores["note"]
    report = benchmark(["goal"], "navrep27", episodes=4, out=tmp_path, figures=False)
    assert report.rows[0]["success_rate"] == pytest.approx(20 / 108)
