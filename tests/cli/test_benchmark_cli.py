"""``navrep-data benchmark`` as a user meets it."""

import json
import os
import subprocess
import sys

import pytest
import warm_process


def run(*arguments, cwd=None):
    return warm_process.shared().run(["benchmark", *arguments], cwd, {**os.environ, "COLUMNS": "200"})


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmark")
    return out, run("random", "goal", "--episodes", 5, "--out", out, "--json")


@pytest.mark.slow
def test_json_is_one_object_with_results(played):
    out, done = played
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert [r["name"] for r in found["results"]] == ["random", "goal"]
    for row in found["results"]:
        assert {"suite", "physics", "episodes", "sees", "success_rate", "collision_rate", "timeout_rate"} <= set(row)
        assert (row["suite"], row["physics"], row["episodes"]) == ("navreptest", "original", 5)
        assert row["success_rate"] + row["collision_rate"] + row["timeout_rate"] == pytest.approx(1.0)
        assert row["goal_success_rate"] == found["results"][1]["success_rate"]
        assert 0 <= row["contact_free_rate"] <= row["success_rate"]
        assert {"contacts_per_km", "personal_space_share", "time_stopped", "goal_contact_free_rate"} <= set(row)
        assert row["success_rate_low"] <= row["success_rate"] <= row["success_rate_high"]
    for name in ("goal.json", "random.json", "report.md", "success.png", "trajectories.png"):
        assert (out / "navreptest-original" / name).stat().st_size > 0
    value = json.loads((out / "navreptest-original" / "random.json").read_text())
    assert value["episodes"]["seed"] == [1000, 1001, 1002, 1003, 1004]
    assert len(value["outcome"]) == len(value["episodes"]["steps"]) == 5
    assert len(value["settings"]["config_sha256"]) == 64
    assert {"python", "numpy", "numba"} <= set(value["versions"])


@pytest.mark.slow
def test_redraw_prints_the_table(played):
    done = run("--redraw", played[0] / "navreptest-original", "--no-figures")
    assert done.returncode == 0, done.stderr
    head, _, *lines = done.stdout.split("\n\n")[0].splitlines()
    assert all(column in head for column in ("policy", "sees", "physics", "episodes", "success", "`goal`"))
    assert {line.split()[1] for line in lines if line} == {"goal", "random"}
    assert "report.md" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["gaol"], "Unknown policy 'gaol'. Did you mean 'goal'?"),
        ([], "No policy named, expected at least one"),
        pytest.param(["goal", "--suite", "navrep26"], "Did you mean 'navrep27'?", marks=pytest.mark.slow),
        pytest.param(["goal", "--redraw", "."], "--redraw plays nothing", marks=pytest.mark.slow),
        pytest.param(["--redraw", "nowhere"], "holds no results", marks=pytest.mark.slow),
    ],
)
def test_errors_are_one_line(arguments, words, tmp_path):
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.slow
def test_without_the_maps_the_error_gives_the_command(tmp_path, monkeypatch):
    """A package of that name that cannot be found is what a missing extra looks like."""
    code = (
        "import sys, importlib.metadata\n"
        "sys.modules['asl_pepper_2d_sim_maps'] = None\n"
        "from navrep_data.cli.main import run\n"
        "run(['benchmark', 'goal', '--suite', 'navrep27', '--episodes', '1'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert "pip install" in done.stderr
    assert "navrep-data[maps]" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
