"""Episodes: the same whatever the batch, the workers, the order and interruptions; paths as a plain loop sees them."""

import json

import numpy as np
import pytest
from recorded import reference

from navrep_data.errors import (
    ConfigError,
    DatasetMismatchError,
    DatasetNotFoundError,
    ModelNotFoundError,
    PolicyError,
    UnknownNameError,
)
from navrep_data.evaluate import Results, benchmark, get_suite, redraw
from navrep_data.evaluate.driver import write_report
from navrep_data.evaluate.executors import Job, run
from navrep_data.evaluate.metrics import measure
from navrep_data.evaluate.runner import TRAJECTORY_POINTS, n_worlds, thin, units
from navrep_data.policies import GoalPolicy, resolve_policy, to_goal
from navrep_data.schema import Event
from navrep_data.sim import Simulator, make_config
from navrep_data.testing import tiny_checkpoint

SUITE = get_suite("navreptest")


def played(policy, episodes, batch=None, physics="original"):
    found = run(Job("navreptest", physics, resolve_policy(policy), tuple(episodes), batch=batch), workers=1)
    return {e.episode: e for finished in found for e in finished}


def same(a, b):
    return (
        (a.event, a.steps) == (b.event, b.steps)
        and np.array_equal(a.trajectory, b.trajectory)
        and all(np.array_equal(v, b.metrics[k], equal_nan=True) for k, v in a.metrics.items())
    )


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["goal", "random", "orca", "dwa"])
def test_episodes_do_not_depend_on_the_batch_or_on_who_is_played_beside_them(policy):
    one = played(policy, range(9), batch=1)
    for batch, episodes in ((7, range(9)), (64, range(9)), (2, [8, 3, 0])):
        other = played(policy, episodes, batch)
        assert sorted(other) == sorted(episodes)
        assert all(same(one[k], e) for k, e in other.items())


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["pilots_for_tests:sideways", "pilots_for_tests:Counting"])
def test_functions_see_64_rows_so_their_episodes_do_not_depend_on_the_batch_either(policy):
    one = played(policy, range(9), batch=1)
    other = played(policy, range(9), batch=5)
    assert all(same(one[k], other[k]) for k in one)


def look(sim):
    """Where the robot is, and its gaps to the nearest human and obstacle."""
    state = sim.state()
    x, y, radius = *state.robot[:2], state.robot[5]
    to_humans = np.hypot(state.humans[:, 0] - x, state.humans[:, 1] - y) - state.humans[:, 7]
    return (x, y), to_humans.min() - radius, sim.clearance([x, y])[0] - radius


@pytest.mark.parametrize("physics", ["original", "consistent"])
def test_metrics_and_events_are_those_of_a_plain_loop(physics):
    found = played("goal", [3, 35], physics=physics)
    for k, episode in found.items():
        sim = Simulator(make_config("navrep-test", physics=physics))
        sim.reset_seeded([1000 + k])
        looks = [look(sim)]
        start = sim.state().robot
        shortest = np.hypot(*(start[3:5] - start[:2])) - start[5]
        event = 0
        while not event:
            goal = sim.observe()[1][0, :2].astype(float)
            _, (event,) = sim.step([[*goal / np.abs(goal).max(), 0.0]])
            looks.append(look(sim))
        path, human, static = zip(*looks, strict=True)
        assert (episode.event, episode.steps) == (Event(event), len(path) - 1)
        assert episode.metrics == pytest.approx(
            measure(path, human, static, 0.2, event == Event.GOAL, shortest), abs=1e-9, nan_ok=True
        )
        assert episode.trajectory[-1] == pytest.approx(100 * np.array(path[-1]), abs=0.51)


@pytest.mark.slow
def test_the_goal_rule_gives_the_originals_control():
    """15.0 % on the original's 200 seeded test episodes (original_scores.json, note)."""
    note = reference("original_scores.json")["note"]
    assert "straight to the goal 15.0 % (test env)" in note
    found = played("goal", range(200))
    assert sum(e.event == Event.GOAL for e in found.values()) == 30


def test_goal_fills_the_action_box_and_stands_at_the_goal():
    states = np.float32([[4, 2, 0, 0, 0], [-0.1, 0.2, 0, 0, 0], [0, 0, 0, 0, 0]])
    assert to_goal(states) == pytest.approx(np.array([[1, 0.5, 0], [-0.5, 1, 0], [0, 0, 0]]))


def test_units_and_rows_of_groups():
    assert units([5, 2], grouped=False) == [[5], [2]]
    assert units([0, 63, 64, 130], grouped=True) == [[0, 63], [64], [130]]

    class Grouped(GoalPolicy):
        grouped = True

    assert n_worlds(Grouped(), 7, 3) == 64
    assert n_worlds(GoalPolicy(), 7, 3) == 3


def test_thin_keeps_first_and_last():
    path = np.stack([np.arange(500) / 100, np.zeros(500)], axis=1)
    points = thin(path)
    assert len(points) == TRAJECTORY_POINTS
    assert points[0].tolist() == [0, 0]
    assert points[-1].tolist() == [499, 0]
    assert thin(path[:3]).tolist() == [[0, 0], [1, 0], [2, 0]]


@pytest.mark.slow
def test_results_are_extended_and_read_back(tmp_path):
    few = benchmark(["goal"], episodes=5, out=tmp_path, figures=False)
    assert few.rows[0]["episodes"] == 5
    more = benchmark(["goal"], episodes=12, out=tmp_path, figures=False)
    whole = benchmark(["goal"], episodes=12, out=tmp_path / "other", figures=False)
    assert more.rows == whole.rows
    file = "navreptest-original/goal.json"
    assert (tmp_path / file).read_bytes() == (tmp_path / "other" / file).read_bytes()
    # all there: nothing is played, fewer episodes are scored from the same file
    again = benchmark(["goal"], episodes=5, out=tmp_path, figures=False)
    assert again.seconds == {"goal": 0.0}
    assert again.rows == few.rows
    results = Results.load(tmp_path / file)
    assert len(results.outcome) == 12
    assert results.missing(14) == [12, 13]


def test_goal_is_played_beside_others_but_not_listed(tmp_path):
    report = benchmark(["random"], episodes=4, out=tmp_path, figures=False)
    assert [r["name"] for r in report.rows] == ["random"]
    assert report.baseline["name"] == "goal"
    assert "| `goal`, both" in report.text
    (row,) = report.to_dict()["results"]
    assert row["goal_success_rate"] == report.baseline["success_rate"]
    assert row["goal_contact_free_rate"] == report.baseline["contact_free_rate"]


def test_changed_settings_are_refused_and_damaged_files_too(tmp_path):
    benchmark(["goal"], episodes=3, out=tmp_path, figures=False)
    path = tmp_path / "navreptest-original" / "goal.json"
    value = json.loads(path.read_text())
    value["settings"]["navrep_data"] = "0.0.1"
    path.write_text(json.dumps(value))
    with pytest.raises(DatasetMismatchError, match=r"goal.json was made with navrep_data = '0.0.1', expected"):
        benchmark(["goal"], episodes=4, out=tmp_path, figures=False)
    for damage in ('{"format": "other"}', "[]", "{", json.dumps({**value, "outcome": "SX"})):
        path.write_text(damage)
        with pytest.raises(ValueError, match=r"is not (a results file of this version|valid JSON)"):
            benchmark(["goal"], episodes=4, out=tmp_path, figures=False)


@pytest.mark.slow
def test_redraw_writes_the_same_report_and_figures_without_playing(tmp_path):
    report = benchmark(["goal", "random"], episodes=6, out=tmp_path)
    folder = tmp_path / "navreptest-original"
    written = {name: (folder / name).read_bytes() for name in ("report.md", "success.png", "trajectories.png")}
    for name in written:
        (folder / name).unlink()
    again = redraw(folder)
    assert again.rows == report.rows
    assert {name: (folder / name).read_bytes() for name in written} == written
    assert [r["name"] for r in redraw(folder / "random.json", figures=False).rows] == ["random"]
    with pytest.raises(DatasetNotFoundError, match="holds no results"):
        redraw(tmp_path)
    (folder / "goal.json").unlink()
    with pytest.raises(DatasetNotFoundError, match="no results of 'goal'"):
        redraw(folder)


def test_variants_with_several_runs_get_a_line_of_their_own(tmp_path):
    def made_up(name, outcome):
        results = Results(
            {"name": name, "sees": "scan", "variant": name.split(".")[0], "versions": {},
             "settings": {"suite": "navreptest", "physics": "original", "inference": "deterministic", "first_round": 0}}
        )  # fmt: skip
        results._grow(len(outcome))
        results.outcome = list(outcome)
        return results

    found = [made_up("goal", "SCCT"), made_up("net.1", "SSCC"), made_up("net.2", "SSST")]
    report = write_report(found, tmp_path, figures=False)
    (group,) = report.variants
    assert (group["variant"], group["runs"]) == ("net", ["net.1", "net.2"])
    assert (group["success_rate"], group["success_rate_min"], group["success_rate_max"]) == (0.625, 0.5, 0.75)
    assert "| net     | 2    | scan | original | 4 " in report.text
    assert "62.5 % (50.0 to 75.0)" in report.text


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"policies": ["gaol"]}, UnknownNameError, "Unknown policy 'gaol'. Did you mean 'goal'"),
        ({"policies": ["e2e_1e.released"]}, UnknownNameError, r"Did you mean 'e2e_1d"),
        ({"policies": ["transformer_1d.released"]}, PolicyError, "is a world model, expected a policy"),
        ({"policies": []}, ConfigError, "expected a list of names"),
        ({"policies": ["goal"], "suite": "navreptst"}, UnknownNameError, "Did you mean 'navreptest'"),
        ({"policies": ["goal"], "physics": "real"}, ConfigError, "expected one of: original, consistent"),
        ({"policies": ["goal"], "episodes": 501}, ConfigError, "navreptest: episodes is 501, .* 1 to 500"),
        ({"policies": ["goal"], "episodes": 0}, ConfigError, "episodes is 0"),
        ({"policies": ["goal"], "first_round": 500}, ConfigError, "first_round is 500, expected .* 0 to 499"),
        ({"policies": ["goal"], "first_round": -1}, ConfigError, "first_round is -1"),
        ({"policies": ["goal"], "first_round": 450, "episodes": 51}, ConfigError, "at most 50 episodes from there"),
        ({"policies": ["goal"], "workers": 0}, ConfigError, "workers is 0"),
        ({"policies": ["goal"], "inference": "noisy"}, ConfigError, "expected one of: deterministic, as_released"),
        ({"policies": ["./nowhere"]}, ModelNotFoundError, "There is no .*nowhere"),
        ({"policies": ["nowhere:function"]}, PolicyError, "cannot be imported.*or one of: goal, random, orca, dwa"),
        ({"policies": ["pilots_for_tests:wrong_shape"], "episodes": 1}, PolicyError, r"returned shape \(3, 2\)"),
        ({"policies": ["pilots_for_tests:not_a_number"], "episodes": 1}, PolicyError, "returned NaN"),
    ],
)
def test_refusals(tmp_path, arguments, error, words):
    with pytest.raises(error, match=words):
        benchmark(out=tmp_path, figures=False, **arguments)


@pytest.mark.slow
def test_a_callable_can_be_passed(tmp_path):
    def forward(scan, robot_state):
        return np.tile([1.0, 0.0], (len(scan), 1))

    report = benchmark([forward], episodes=2, out=tmp_path, figures=False)
    assert report.rows[0]["name"].endswith("forward")


@pytest.mark.slow
def test_a_policy_is_named_by_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = {"suite": "navreptest", "episodes": 3, "figures": False}
    tiny_checkpoint("models/mine", seed=3)
    report = benchmark(["./models/mine/"], out="one", **asked)
    assert (report.rows[0]["name"], report.rows[0]["episodes"]) == ("models/mine", 3)
    first = paths(report)
    assert set(first) == {0, 1, 2}
    again = benchmark(["./models/mine"], out="one", **asked)
    assert again.seconds["models/mine"] == 0.0  # nothing was played again
    # other weights in the same place are other results
    tiny_checkpoint("models/mine", seed=4)
    with pytest.raises(DatasetMismatchError, match="policy_files"):
        benchmark(["./models/mine"], out="one", **asked)
    other = paths(benchmark(["models/mine"], out="two", **asked))
    assert any(not np.array_equal(first[k], other[k]) for k in first)
    tiny_checkpoint("models/v", model="vae")
    with pytest.raises(PolicyError, match="holds a VAE, expected a policy"):
        benchmark(["models/v"], out="one", **asked)


def paths(report):
    return Results.load(next(f for f in report.files if "mine" in f.name)).trajectories


def test_two_policies_of_one_name_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"Two policies are called navrep_data\.policies\.baselines:GoalPolicy"):
        benchmark([GoalPolicy(), GoalPolicy()], episodes=1, out=tmp_path)
    one = GoalPolicy()
    assert len(benchmark([one, one, "goal"], episodes=1, out=tmp_path, figures=False).rows) == 2
