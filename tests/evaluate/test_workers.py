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
from navrep_data.evaluate.executors import Job, run
from navrep_data.policies import resolve_policy

pytestmark = pytest.mark.slow  # seconds to a minute each; `make test` runs them


@pytest.fixture
def scores():
    return reference("original_scores.json")


def test_one_worker_and_two_write_the_same_bytes(tmp_path, monkeypatch):
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([here, os.environ.get("PYTHONPATH", "")]))
    for workers in (1, 2):
        benchmark(
            ["dwa", "pilots_for_tests:Counting"],
            episodes=20,
            workers=workers,
            out=tmp_path / str(workers),
            figures=False,
        )
    one, two = (sorted((tmp_path / str(w) / "navreptest-original").iterdir()) for w in (1, 2))
    assert [f.name for f in one] == [f.name for f in two]
    assert [f.read_bytes() for f in one] == [f.read_bytes() for f in two]


PATIENT = "pilots_for_tests:patient"
EPISODES = 130  # more than two batches, so that many are left when the first ones are saved


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """What a run that nobody interrupts writes."""
    out = tmp_path_factory.mktemp("whole")
    benchmark([PATIENT], episodes=EPISODES, out=out, figures=False)
    return (out / "navreptest-original" / "pilots_for_tests-patient.json").read_bytes()


@pytest.mark.parametrize("workers", [1, 2])
def test_sigkill_loses_little_and_the_same_command_goes_on(tmp_path, workers, uninterrupted, monkeypatch):
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([here, os.environ.get("PYTHONPATH", "")]))
    arguments = [
        PATIENT,
        "--episodes",
        str(EPISODES),
        "--workers",
        str(workers),
        "--out",
        str(tmp_path),
        "--no-figures",
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "navrep_data", "benchmark", *arguments],
        env={**os.environ, "PATIENCE": "0.1"}, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    file = tmp_path / "navreptest-original" / "pilots_for_tests-patient.json"
    while not file.exists() and process.poll() is None:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    outcome = json.loads(file.read_text())["outcome"]
    assert 0 < len(outcome) - outcome.count("-") < EPISODES
    again = benchmark([PATIENT], episodes=EPISODES, workers=workers, out=tmp_path, figures=False)
    assert f"| {EPISODES} " in again.text
    assert file.read_bytes() == uninterrupted


def test_a_worker_that_fails_says_why(monkeypatch):
    from navrep_data.errors import PolicyError

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]))
    job = Job("navreptest", "original", resolve_policy("pilots_for_tests:not_a_number"), tuple(range(4)))
    with pytest.raises(PolicyError, match="returned NaN"):
        list(run(job, 2))


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
    for batch in (1, 3, 64):
        benchmark(
            ["e2e_1d.20201026"], episodes=4, source=released, out=tmp_path / str(batch), figures=False, batch=batch
        )
        files.append((tmp_path / str(batch) / "navreptest-original" / "e2e_1d.20201026.json").read_bytes())
    assert files[0] == files[1] == files[2]


def test_as_released_does_not_depend_on_what_was_played_before(tmp_path, released):
    """An LSTM, whose state goes on; the noise comes from the seed of the group, for every kind of memory."""
    options = {"source": released, "figures": False}

    def episodes(folder, n, inference="as_released"):
        benchmark(["joint_1d_zh.released"], episodes=n, out=tmp_path / folder, inference=inference, **options)
        (file,) = (tmp_path / folder / "navreptest-original").glob("joint*.json")
        return json.loads(file.read_text())["episodes"]

    episodes("parts", 3)
    parts, whole = episodes("parts", 5), episodes("whole", 5)
    assert parts == whole
    assert episodes("quiet", 5, "deterministic")["path_length"] != whole["path_length"]


def test_e2e_on_the_first_two_rounds_of_navrep27(tmp_path, released, scores, maps):
    """In the original's share's 95 % interval, outcomes compared one by one."""
    report = benchmark(
        ["e2e_1d.20201026"], "navrep27", episodes=2, source=released, out=tmp_path, figures=False, ranges="as_released"
    )
    (theirs,) = scores["ian"].values()
    assert theirs["outcome"].count("S") == 25
    outcome = theirs["outcome"][:54]
    low, high = wilson(outcome.count("S"), 54)
    assert low <= report.rows[0]["success_rate"] <= high
    file = tmp_path / "navrep27-original" / "e2e_1d.20201026.ranges-as_released.json"
    ours = json.loads(file.read_text())["outcome"]
    assert sum(a == b for a, b in zip(ours, outcome, strict=True)) >= 0.8 * 54


def test_goal_on_the_first_four_rounds_of_navrep27(tmp_path, scores, maps):
    """18.5 % in the original's control."""
    assert "18.5 % (27 scenarios)" in scores["note"]
    report = benchmark(["goal"], "navrep27", episodes=4, out=tmp_path, figures=False)
    assert report.rows[0]["success_rate"] == pytest.approx(20 / 108)
