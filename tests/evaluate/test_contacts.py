"""Contacts: what the robot touches by the simulator's own rules, success without contact, later rounds, pairs."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from navrep_data.errors import ConfigError, SchemaVersionError
from navrep_data.evaluate import METRICS, Contacts, Results, benchmark, get_suite, mcnemar, redraw
from navrep_data.evaluate.executors import Job, run
from navrep_data.evaluate.metrics import time_stopped
from navrep_data.evaluate.results import header_of
from navrep_data.evaluate.runner import _ContactCounter
from navrep_data.evaluate.scores import compare, score, summary
from navrep_data.evaluate.sources import find_benchmarks
from navrep_data.evaluate.statistics import bootstrap_ratio
from navrep_data.policies import PolicySpec, resolve_policy
from navrep_data.schema import Event
from navrep_data.sim import Simulator, make_config, scale_actions
from navrep_data.sim import _layout as lay


def touches(agents, speeds, matter, matter_speed):
    return SimpleNamespace(
        agents=np.array([agents], bool), agent_speeds=np.array([speeds], float), matter=np.array([matter], bool),
        matter_speeds=np.array([matter_speed], float),
    )  # fmt: skip


def test_a_contact_is_a_run_of_steps_in_touch_with_the_same_body():
    counter = _ContactCounter(1)
    counter.begin(np.array([True]))
    assert counter.of(0).total == 0
    assert math.isnan(counter.of(0).speed)
    for agents, matter in (((1, 0), 0), ((1, 1), 0), ((0, 1), 1), ((0, 0), 1), ((1, 0), 0), ((0, 0), 1)):
        counter.advance(touches(agents, np.multiply(agents, [0.5, 0.9]), matter, 1.1 * matter))
    assert counter.of(0) == Contacts(human=3, obstacle=2, speed=1.1)
    counter.begin(np.array([True]))
    counter.advance(touches((0, 0), (0, 0), 1, 0.0))
    assert counter.of(0) == Contacts(human=0, obstacle=1, speed=0.0), "a step of the episode before does not go on"


def beside(env, physics, gap, **settings):
    """Return a world whose robot stands on its goal's edge with one human `gap` m from its edge, both at rest."""
    sim = Simulator(make_config(env, physics=physics, **settings))
    sim.reset_seeded([1000])
    agents = sim.arrays.agents[0]
    agents[1:, lay.A_X] = 500.0 + 10.0 * np.arange(len(agents) - 1)
    robot, human = agents[0], agents[1]
    robot[[lay.A_X, lay.A_Y]] = 0.0, 0.0
    robot[[lay.A_GX, lay.A_GY]] = 0.1, 0.0
    human[[lay.A_X, lay.A_Y, lay.A_GX, lay.A_GY]] = 0.0, robot[lay.A_RADIUS] + human[lay.A_RADIUS] + gap, 0.0, 50.0
    agents[:, [lay.A_VX, lay.A_VY]] = 0.0
    return sim


def test_in_the_original_the_goal_outranks_a_collision_that_is_a_contact_all_the_same():
    sim = beside("navrep-test", "original", -0.05)
    _, (event,) = sim.step([[0.1, 0.0, 0.0]])
    assert Event(event) == Event.GOAL
    found = sim.touches()
    assert found.agents[0].tolist() == [True] + [False] * (found.agents.shape[1] - 1)
    assert found.agent_speeds[0, 0] == pytest.approx(0.1)
    sim = beside("navrep-test", "original", 0.05)
    sim.step([[0.1, 0.0, 0.0]])
    assert not sim.touches().agents.any()
    sim.reset()
    assert not sim.touches().agents.any()


@pytest.mark.parametrize("physics", ["original", "consistent"])
def test_every_collision_in_polygon_worlds_is_one_contact_and_nothing_else_is(physics):
    job = Job("navreptest", physics, resolve_policy("goal"), tuple(range(30)))
    for finished in run(job, 1):
        for e in finished:
            collided = e.event in (Event.COLLISION_HUMAN, Event.COLLISION_OBSTACLE)
            assert (e.contacts.total > 0) == collided, e.episode
            assert math.isnan(e.contacts.speed) != collided
            if e.event == Event.COLLISION_HUMAN:
                assert e.contacts.human >= 1


def straight(scan, robot_state):
    """Drive straight to the goal, into whatever stands in the way."""
    goal = np.asarray(robot_state, np.float64)[:, :2]
    return goal / np.maximum(np.abs(goal).max(axis=1, keepdims=True), 1e-9)


def gap_to_matter(grid, way):
    """Return the smallest distance of the points (k, 2) of a way to squares of solid cells and the map's edge [m]."""
    low, cell = np.array(grid.origin), grid.resolution
    high = low + np.array(grid.shape) * cell
    first = np.maximum(np.floor((way.min(axis=0) - 1.0 - low) / cell).astype(int), 0)
    last = np.floor((way.max(axis=0) + 1.0 - low) / cell).astype(int) + 1
    corners = low + (first + np.argwhere(grid.occupied[first[0] : last[0], first[1] : last[1]])) * cell
    outside = np.maximum(np.maximum(corners[:, None] - way, way - corners[:, None] - cell), 0.0)
    rim = min((way - low).min(), (high - way).min())
    return max(min(np.hypot(*np.moveaxis(outside, -1, 0)).min(initial=1.0), rim), 0.0)


def touches_matter(grid, physics, before, after, radius):
    """Say whether a robot that moved from one place to the other met matter, by the words of docs/differences.md."""
    if physics == "original":  # the cell of its centre against the centres of solid cells
        place = ((after.astype(np.float32) - np.float32(grid.origin)) / np.float32(grid.resolution)).astype(int)
        apart = np.hypot(*(np.argwhere(grid.occupied) - place).T).min() * grid.resolution
        return bool(apart < radius or not grid.free[tuple(place)])
    gap = gap_to_matter(grid, np.linspace(before, after, 50))
    return gap < radius and gap < gap_to_matter(grid, before[None]) - 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["original", "consistent"])
def test_on_maps_contacts_are_those_of_legs_and_cells_in_plain_numpy(physics, maps):
    """Everything that the robot meets is worked out from where the simulator put legs, and the cells of the map."""
    episodes = (0, 5, 9, 14)
    job = Job("navrep27", physics, resolve_policy(straight), episodes)
    found = {e.episode: e for finished in run(job, 1) for e in finished}
    met = set()
    for k in episodes:
        sim = Simulator(make_config("ian", physics=physics))
        sim.reset_scenarios([k % 27], [k])
        grid = sim.maps.data.maps[int(sim.arrays.worlds.place[0, 0])]
        agents = sim.arrays.agents[0]
        there = 1 + int(sim.arrays.scalars[0, lay.S_HUMANS])
        before, people, matter, damage, event = set(), 0, 0, 0.0, 0
        while not event:
            (x, y, heading), radius = agents[0, [lay.A_X, lay.A_Y, lay.A_HEADING]], agents[0, lay.A_RADIUS]
            (vx, vy, omega), c, s = (
                scale_actions(sim.config, straight(*sim.observe()))[0],
                np.cos(heading),
                np.sin(heading),
            )
            _, (event,) = sim.step([[vx, vy, omega]])
            start = np.array([x, y])
            end = start + sim.config.sensor.dt * np.array([c * vx - s * vy, s * vx + c * vy])
            # two legs a body, as they stood before anybody was put back
            legs = sim.arrays.circles[: 2 * there, :3].reshape(there, 2, 3)
            np.testing.assert_allclose(legs[0, :, :2].mean(axis=0), end, rtol=0, atol=1e-9)
            reach = np.hypot(*np.moveaxis(legs[:, :, :2] - end, -1, 0)) < radius + legs[:, :, 2]
            now = {int(j) for j in np.flatnonzero(reach.any(axis=1)) if j > 0}
            if touches_matter(grid, physics, start, end, radius):
                now.add(0)
            people += len(now - before - {0})
            matter += 0 in now - before
            before = now
            taken = sim.damage()[0, 0]
            assert now or taken == damage, "damage without a touch"
            damage = taken
        assert (found[k].steps, found[k].event) == (int(sim.state().step), Event(event))
        assert (found[k].contacts.human, found[k].contacts.obstacle) == (people, matter), k
        met |= {name for name, n in (("people", people), ("matter", matter)) if n}
    assert met == {"people", "matter"}


def made_up(name, outcome, touched=(), suite="navreptest"):
    results = Results(header_of(PolicySpec(name, "scan", name, "zoo"), get_suite(suite), "original"))
    results._grow(len(outcome))
    results.outcome, results.steps = list(outcome), [10] * len(outcome)
    results.metrics = {m.name: [0.5] * len(outcome) for m in METRICS}
    results.contacts = [Contacts(human=2 if k in touched else 0, speed=0.3) for k in range(len(outcome))]
    return results


def test_both_successes_and_the_ratios():
    row = score(made_up("a", "SSSCT", touched=(1, 3)))
    assert (row["contact_free_rate"], row["success_rate"]) == (0.4, 0.6)
    assert row["contacts_per_km"] == pytest.approx(1000 * 4 / 2.5)
    assert row["personal_space_share"] == pytest.approx(5 * 0.5 / (5 * 10 * 0.2))
    assert row["contacts_per_km_low"] < row["contacts_per_km"] < row["contacts_per_km_high"]


def test_stopped_is_slower_than_5_cm_per_second():
    assert time_stopped([[0, 0], [0.009, 0], [0.02, 0], [0.02, 0]], 0.2) == pytest.approx(0.4)


def test_mcnemar_is_the_exact_binomial():
    for b, c in ((0, 0), (3, 3), (1, 9), (9, 1), (26, 6)):
        n, k = b + c, min(b, c)
        tail = sum(math.comb(n, i) for i in range(k + 1)) / 2**n
        assert mcnemar(b, c) == pytest.approx(min(1.0, 2 * tail))


@pytest.mark.slow
def test_pairs_count_discordant_episodes_and_bootstrap_whole_scenarios(maps):
    a, b = made_up("a", "S" * 54, range(27, 54), "navrep27"), made_up("b", "S" * 27 + "C" * 27, (), "navrep27")
    (pair,) = compare([a, b])
    assert (pair["first"], pair["second"], pair["episodes"]) == ("a", "b", 54)
    assert (pair["success_first_only"], pair["success_second_only"]) == (27, 0)
    assert pair["success_p"] == pytest.approx(2 / 2**27)
    assert (pair["contact_free_first_only"], pair["contact_free_p"], pair["contact_free_difference"]) == (0, 1.0, 0.0)
    # every scenario is alike here: no spread over scenarios, whatever the interval over episodes says
    assert pair["success_difference_scenarios_low"] == pair["success_difference_scenarios_high"] == 0.5
    row = summary(b)
    assert row["success_rate_scenarios_low"] == row["success_rate_scenarios_high"] == 0.5
    assert row["success_rate_low"] < 0.5 < row["success_rate_high"]
    # and where scenarios differ altogether, that over scenarios is the wider one
    mixed = summary(made_up("c", ("S" * 13 + "C" * 14) * 20, (), "navrep27"))
    wide = mixed["success_rate_scenarios_high"] - mixed["success_rate_scenarios_low"]
    assert wide > 2 * (mixed["success_rate_high"] - mixed["success_rate_low"])


def test_the_ratio_is_of_sums_and_unknown_over_nothing():
    assert bootstrap_ratio([1, 3], [2, 2])[0] == 1.0
    assert all(math.isnan(v) for v in bootstrap_ratio([0.0], [0.0]))


@pytest.mark.slow
def test_later_rounds_are_the_same_episodes_in_a_place_of_their_own(tmp_path):
    whole = benchmark(["goal"], episodes=8, out=tmp_path, figures=False)
    later = benchmark(["goal"], episodes=3, first_round=5, out=tmp_path, figures=False)
    a, b = (Results.load(r.files[0]) for r in (whole, later))
    assert b.outcome == a.outcome[5:]
    assert b.steps == a.steps[5:]
    assert b.contacts == a.contacts[5:] or str(b.contacts) == str(a.contacts[5:])
    assert np.array_equal(b.trajectories[0], a.trajectories[5])
    assert json.loads(later.files[0].read_text())["episodes"]["seed"] == [1005, 1006, 1007]
    assert later.files[0].parent.name == "navreptest-original-round5"
    assert "3 (rounds 5 to 7)" in later.text
    assert (later.rows[0]["first_round"], later.rows[0]["rounds"]) == (5, "5 to 7")
    again = benchmark(["goal"], episodes=3, first_round=5, out=tmp_path, figures=False)
    assert again.seconds == {"goal": 0.0}
    assert [r.first_round for r in find_benchmarks(tmp_path, "navreptest")] == [0]
    assert [r.first_round for r in find_benchmarks(tmp_path, "navreptest", first_round=5)] == [5]
    twin = later.files[0].with_name("copy.json")
    twin.write_bytes(later.files[0].read_bytes())
    with pytest.raises(ConfigError, match=r"copy\.json and .*goal\.json both hold results of goal, expected one"):
        redraw(twin.parent)
    twin.unlink()
    moved = later.files[0].rename(whole.files[0].parent / "other.json")
    with pytest.raises(ConfigError, match="several suites, physics or first rounds"):
        redraw(moved.parent)


def test_files_that_do_not_know_of_contacts_are_refused_with_the_command(tmp_path):
    report = benchmark(["goal"], episodes=2, out=tmp_path, figures=False)
    value = json.loads(report.files[0].read_text())
    assert value["version"] == 2
    assert {"contacts_human", "contacts_obstacle", "contact_speed", "time_stopped"} <= set(value["episodes"])
    report.files[0].write_text(json.dumps({**value, "version": 1}))
    with pytest.raises(SchemaVersionError, match="play it again, navrep-data benchmark NAME --suite SUITE"):
        benchmark(["goal"], episodes=2, out=tmp_path, figures=False)
