"""The benchmark's view of worlds on maps against the simulator's own, step by step; shortest paths against Dijkstra."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from navrep_data.evaluate import get_suite, redraw
from navrep_data.evaluate.driver import benchmark
from navrep_data.evaluate.suite_worlds import SuiteWorlds
from navrep_data.policies import Driver, OrcaPolicy
from navrep_data.schema import Event
from navrep_data.sim import Simulator, scale_actions
from navrep_data.sim.maps import load_map
from navrep_data.sim.scenarios import get_scenario, scenario_names
from navrep_data.sim.shortest_paths import shortest_path

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("maps")]

SUITE = get_suite("navrep27")
CHOSEN = [0, 20, 9, 26]


@pytest.mark.parametrize("physics", ["original", "consistent"])
def test_worlds_show_what_the_simulator_shows(physics):
    config = SUITE.config(physics)
    worlds = SuiteWorlds(config, len(CHOSEN))
    seeds = np.array(CHOSEN) + 27
    worlds.reset(np.ones(len(CHOSEN), bool), seeds, np.array(CHOSEN))
    single = []
    for scenario, seed in zip(CHOSEN, seeds, strict=True):
        sim = Simulator(config)
        sim.reset_scenarios([scenario], [seed])
        single.append(sim)
    rng = np.random.default_rng(0)
    for step in range(12):
        to_human, to_static = worlds.gaps()
        scans, states, poses = *worlds.simulator.observe(), worlds.poses()
        for w, sim in enumerate(single):
            scan, state = sim.observe()
            assert np.array_equal(scan[0], scans[w])
            assert np.array_equal(state[0], states[w])
            now = sim.state()
            here = poses[w] - [*sim.origins[0], 0.0]
            np.testing.assert_allclose(now.robot[:3], here, rtol=0.0, atol=1e-12)
            radius = now.robot[5]
            assert worlds.simulator.radii()[w] == radius
            h = now.humans
            expected = np.inf
            if len(h):
                expected = (np.hypot(h[:, 0] - here[0], h[:, 1] - here[1]) - h[:, 7]).min() - radius
            if step < 11:  # the humans of a scenario may be sent back to their starts after the gap was noted
                assert to_human[w] == pytest.approx(expected, abs=0.2)
            static = sim.clearance(here[None, :2])[0] - radius
            assert min(to_static[w], 1.0) == pytest.approx(min(static, 1.0), abs=1e-6)
        commands = scale_actions(config, rng.uniform(-1, 1, (len(CHOSEN), 2)))
        events = worlds.step(commands)
        for w, sim in enumerate(single):
            assert sim.step(commands[w : w + 1])[1][0] == events[w]


def slow_shortest(scenario):
    """Dijkstra over free cells and their eight neighbours: never shorter than the true way, at most 8 % longer."""
    recipe = get_scenario(scenario)
    grid = load_map(recipe.map)
    room = grid.signed_distance() >= np.float32(0.3)
    index = np.full(room.shape, -1)
    index[room] = np.arange(room.sum())
    rows, columns, lengths = [], [], []
    for di, dj, length in ((1, 0, 1.0), (0, 1, 1.0), (1, 1, 2**0.5), (1, -1, 2**0.5)):
        a = index[: -di or None, max(0, -dj) : (-dj if dj > 0 else None)]
        b = index[di:, max(0, dj) : (dj if dj < 0 else None)]
        both = (a >= 0) & (b >= 0)
        rows.append(a[both])
        columns.append(b[both])
        lengths.append(np.full(both.sum(), length * grid.resolution))
    n = int(room.sum())
    graph = coo_matrix((np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), (n, n)).tocsr()
    (start,), (goal,) = (grid.cell_of(xy) for xy in (recipe.starts[:1, :2], recipe.goals[:1]))
    return dijkstra(graph, directed=False, indices=index[tuple(start)])[index[tuple(goal)]]


@pytest.mark.parametrize("scenario", ["irosasl2", "rlasl2", "irosasl4"])
def test_shortest_paths_lie_between_the_straight_line_and_a_walk_over_cells(scenario):
    recipe = get_scenario(scenario)
    straight = np.hypot(*(recipe.goals[0] - recipe.starts[0, :2]))
    found, walk = shortest_path(scenario), slow_shortest(scenario)
    assert straight <= found <= walk + 0.35
    assert found >= walk / 1.09 - 0.35


def test_every_scenario_has_a_way():
    for name in scenario_names():
        recipe = get_scenario(name)
        straight = np.hypot(*(recipe.goals[0] - recipe.starts[0, :2]))
        assert straight <= shortest_path(name) < 1.4 * straight


def test_orca_finds_its_way_where_straight_ahead_does_not_lead_there():
    """irosasl_office_j2: 40 m through an empty office."""
    worlds = SuiteWorlds(SUITE.config("original"), 1)
    scenario = scenario_names().index("irosasl_office_j2")
    worlds.reset(np.ones(1, bool), np.array([scenario]), np.array([scenario]))
    driver, event = Driver(OrcaPolicy()), 0
    driver.start(worlds.simulator)
    while not event:
        (event,) = worlds.step(driver.commands(worlds.simulator))
    assert Event(int(event)) == Event.GOAL


def test_figures_of_scenarios_are_drawn_from_files_alone(tmp_path):
    report = benchmark(["goal"], "navrep27", episodes=1, out=tmp_path)
    assert {"success.png", "trajectories.png", "trajectories-goal.png"} <= {f.name for f in report.files}
    folder = tmp_path / "navrep27-original"
    before = (folder / "trajectories-goal.png").read_bytes()
    assert redraw(folder).rows == report.rows
    assert (folder / "trajectories-goal.png").read_bytes() == before
    row = report.rows[0]
    assert {m: row["per_map"][m]["episodes"] for m in row["per_map"]} == dict.fromkeys(SUITE.maps, 9)
    assert len(row["per_scenario"]) == 27
    assert "asl_office_j (realistic)" in report.text
