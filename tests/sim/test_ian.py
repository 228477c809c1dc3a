"""Worlds on maps in `consistent` physics, and what both physics promise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from navrep_data.errors import ConfigError, MissingExtraError, UnknownNameError
from navrep_data.schema import Event
from navrep_data.sim import Simulator, make_config, map_names
from navrep_data.sim import _layout as lay
from navrep_data.sim.map_tables import map_world_data

ORIGIN = np.zeros(2)


@pytest.fixture(autouse=True)
def _maps() -> None:
    try:
        map_names()
    except MissingExtraError as error:
        pytest.skip(str(error))


def one(physics: str, scenario: str, heading: float, seed: int = 0, **fields: Any) -> Simulator:
    simulator = Simulator(make_config("ian", physics=physics, scenarios=(scenario,), **fields))
    simulator.reset_scenarios([scenario], [seed], headings=[heading])
    return simulator


@pytest.mark.parametrize("physics", ["consistent", "original"])
@pytest.mark.parametrize("env", ["map", "ian"])
def test_tables_have_one_type(env: str, physics: str) -> None:
    """Another order of axes, or read-only arrays, are other types: kernels would be compiled once more."""
    fields = {"maps": tuple(map_names()[:1])} if env == "map" else {}
    data = map_world_data(make_config(env, physics=physics, **fields))
    for array in (*data.tables, *data.edges):
        assert array.flags.c_contiguous
        assert array.flags.writeable


# --- the listed defects: there in `original`, gone in `consistent` ---------------------------------------------------


def test_humans_behind_the_heading_are_seen() -> None:
    """`original` loses everybody between the map's -x direction and the robot's heading; `consistent` does not."""
    for physics, blind in (("original", True), ("consistent", False)):
        simulator = one(physics, "rlasl3", 4.7)
        simulator.step(np.zeros((1, 3)))
        simulator.observe()
        humans, robot = simulator.state().humans, simulator.state().robot
        bearing = np.arctan2(humans[:, 1] - robot[1], humans[:, 0] - robot[0]) % (2 * np.pi)
        behind = (bearing > np.pi + 0.1) & (bearing < 4.6)
        assert behind.sum() >= 2
        visible = simulator.humans()[0, : len(humans), 5] > 0
        assert visible[~behind].all()
        assert visible[behind].any() != blind
        assert visible[behind].all() != blind


def test_first_scan_is_of_the_start() -> None:
    for physics, stale in (("original", True), ("consistent", False)):
        simulator = one(physics, "irosasl4", 1.0)
        first, first_state = simulator.observe()
        simulator.step(np.zeros((1, 3)))
        second, second_state = simulator.observe()
        # nobody has moved much in a fifth of a second; the goal part was right from the start
        np.testing.assert_allclose(first_state[0, :2], second_state[0, :2], atol=1e-5)
        assert (np.median(np.abs(first - second)) > 0.5) == stale
        assert (np.median(np.abs(first - second)) < 1e-3) != stale


def test_a_collision_in_the_first_step_puts_back_to_the_start() -> None:
    """`original` puts the robot to (0, 0); `consistent` leaves it where it stood."""
    for physics, thrown in (("original", True), ("consistent", False)):
        simulator = one(physics, "rlasl3", 0.0)
        start = simulator.state().robot[:2].copy()
        # a human is put in the robot's way
        agents, walkers = simulator.arrays.agents[0], simulator.arrays.worlds.walkers[0]
        agents[1, [lay.A_X, lay.A_Y]] = start + np.array([0.45, 0.0])
        walkers[1, :] = 0.0
        simulator.step(np.array([[0.55, 0.0, 0.0]]))
        assert simulator.damage()[0, 0] == pytest.approx(0.55)
        after = simulator.state().robot[:2]
        np.testing.assert_allclose(after, ORIGIN if thrown else start, atol=1e-12)


# --- rules -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_pushing_a_wall_ends_the_episode_at_damage_five(physics: str) -> None:
    simulator = one(physics, "rlasl1", np.pi)
    events = []
    for _ in range(300):
        _, event = simulator.step(np.array([[0.55, 0.0, 0.0]]))
        events.append(int(event[0]))
        if event[0]:
            break
    assert events[-1] == Event.COLLISION_OBSTACLE
    assert simulator.damage()[0, 0] == pytest.approx(5.5)
    assert not any(events[:-1])


def test_consistent_robot_never_overlaps_cells() -> None:
    """In free flight into walls from many headings the robot's disc stays clear of solid cells."""
    config = make_config("ian", scenarios=("irosasl2",))
    simulator = Simulator(config, 12)
    simulator.reset_scenarios(["irosasl2"] * 12, headings=np.linspace(0.0, 6.0, 12))
    start = min(simulator.clearance(simulator.state(w).robot[:2], w)[0] for w in range(12))
    for _ in range(120):
        simulator.step(np.tile([0.55, 0.1, 0.2], (12, 1)))
        for w in range(12):
            gap = simulator.clearance(simulator.state(w).robot[:2], w)[0]
            assert gap >= min(0.3, start) - 1e-9


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_time_limit(physics: str) -> None:
    simulator = one(physics, "rlasl1", 0.0, time_limit=2.0)
    events = [int(simulator.step(np.zeros((1, 3)))[1][0]) for _ in range(10)]
    assert events == [0] * 9 + [Event.TIMEOUT]


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_goal_and_its_reward(physics: str) -> None:
    """rlasl1 is a straight way: 100 discounted by the time, a twentieth of a hundredth per metre before."""
    simulator = one(physics, "rlasl1", 0.0)
    steps = 0
    while steps < 200:
        steps += 1
        robot = simulator.state().robot
        to_goal = robot[3:5] - robot[:2]
        command = np.append(to_goal / np.hypot(*to_goal) * 0.55, 0.0)
        reward, event = simulator.step(command[None])
        if event[0]:
            break
    assert event[0] == Event.GOAL
    assert reward[0] == pytest.approx(100.0 * 0.9 ** (steps * 0.2 / 60.0))
    assert np.hypot(*(simulator.state().robot[:2] - robot[3:5])) < 0.5


def test_paper_reward_where_a_collision_ends_the_episode() -> None:
    simulator = one("consistent", "rlasl1", np.pi, on_collision="end")
    rewards = []
    for _ in range(300):
        before = simulator.state().robot
        reward, event = simulator.step(np.array([[0.55, 0.0, 0.0]]))
        rewards.append(reward[0])
        if event[0]:
            break
    assert event[0] == Event.COLLISION_OBSTACLE
    after = simulator.state().robot
    progress = np.hypot(*(before[:2] - before[3:5])) - np.hypot(*(after[:2] - before[3:5]))
    assert rewards[-1] == pytest.approx(progress - 1.0 - 25.0)


def test_commands_are_limited() -> None:
    """Diagonals are not faster than straight on, and nothing is faster than the largest velocity."""
    simulator = one("consistent", "rlasl1", 0.0)
    simulator.step(np.array([[5.0, 5.0, 9.0]]))
    state = simulator.observe()[1][0]
    np.testing.assert_allclose(state[2:], [0.55 / np.sqrt(2), 0.55 / np.sqrt(2), 2.0], rtol=1e-6)


# --- batches and seeds -----------------------------------------------------------------------------------------------


def play(simulator: Simulator, steps: int) -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    commands = rng.uniform(-0.5, 0.5, (steps, 3)) + np.array([0.3, 0.0, 0.0])
    shape = (
        (simulator.n_worlds, 3) if simulator.config.robots == 1 else (simulator.n_worlds, simulator.config.robots, 3)
    )
    seen = []
    for command in commands:
        reward, event = simulator.step(np.broadcast_to(command, shape))
        scan, state = simulator.observe()
        seen.append(np.concatenate([a.reshape(simulator.n_worlds, -1) for a in (reward, event, scan, state)], axis=1))
        if event.any():
            simulator.reset(event > 0)
    return seen


@pytest.mark.parametrize(
    ("env", "fields"),
    [
        ("ian", {"scenarios": ("rlasl3", "irosasl4")}),
        ("ian", {"scenarios": ("rlasl3", "irosasl4"), "physics": "original"}),
        ("map", {"maps": ("asl",)}),
        ("map", {"maps": ("asl",), "human_policy": "orca", "rendering": "ellipse"}),
        ("map", {"maps": ("asl",), "human_policy": "constant-velocity", "scan_noise": 0.02, "inertia": "limited"}),
        ("map", {"maps": ("asl",), "human_policy": "static", "drive": "differential"}),
        ("crowdmove-1", {}),
        ("crowdmove-1", {"physics": "original"}),
    ],
)
def test_batches_equal_single_worlds(env: str, fields: dict[str, Any]) -> None:
    config = make_config(env, **fields)
    together = np.stack(play(Simulator(config, 3, seed=11), 40))
    for w in range(3):
        alone = np.stack(play(Simulator(config, 1, seed=11, first_sequence=w), 40))
        np.testing.assert_array_equal(together[:, w], alone[:, 0])
    assert (together[:, 0] != together[:, 1]).any()


def test_seeded_episodes_do_not_depend_on_the_batch() -> None:
    config = make_config("ian", physics="original", scenarios=("rlasl3", "irosasl4"))
    names, seeds = ["irosasl4", "rlasl3", "irosasl4"], [3, 20, 30]
    together, runs = Simulator(config, 3), []
    together.reset_scenarios(names, seeds)
    for _ in range(30):
        together.step(np.tile([0.4, 0.0, 0.0], (3, 1)))
        runs.append(together.observe()[0].copy())
    for w in range(3):
        single = Simulator(config)
        single.reset_scenarios([names[w]], [seeds[w]])
        for k in range(30):
            single.step(np.array([[0.4, 0.0, 0.0]]))
            np.testing.assert_array_equal(single.observe()[0][0], runs[k][w])


def test_plain_resets_go_on_after_seeded_ones() -> None:
    """A seeded episode takes nothing from the world's own stream."""
    config = make_config("ian", scenarios=("rlasl3", "irosasl4"))
    plain, mixed = Simulator(config, 2, seed=4), Simulator(config, 2, seed=4)
    mixed.reset_scenarios(["rlasl3", "rlasl3"], [1, 2])
    for _ in range(25):
        mixed.step(np.zeros((2, 3)))
    plain.reset()
    mixed.reset()
    for w in range(2):
        np.testing.assert_array_equal(plain.state(w).robot, mixed.state(w).robot)


# --- errors ----------------------------------------------------------------------------------------------------------


def test_wrong_scenarios_are_refused() -> None:
    simulator = Simulator(make_config("ian", scenarios=("rlasl1", "rlasl2")), 2)
    with pytest.raises(UnknownNameError, match="Unknown scenario 'rlasl9'"):
        simulator.reset_scenarios(["rlasl9", "rlasl1"])
    with pytest.raises(ConfigError, match="Scenario 2 is none, expected a name or an index from 0 to 1"):
        simulator.reset_scenarios([2, 0])
    with pytest.raises(ConfigError, match="scenarios have shape"):
        simulator.reset_scenarios(["rlasl1"])
    with pytest.raises(ConfigError, match="headings have shape"):
        simulator.reset_scenarios([0, 1], headings=[0.0])
    with pytest.raises(ConfigError, match="has no scenarios"):
        Simulator(make_config("mark-test-2")).reset_scenarios([0])
    with pytest.raises(ConfigError, match="has no scenarios"):
        Simulator(make_config("empty")).reset_scenarios([0])
