"""Starts and goals that are given: where the robot is put, what stays, what is refused."""

import numpy as np
import pytest
from env_cases import PHYSICS, make, make_vec, param, same

from navrep_data.envs import NavRepEnv, record
from navrep_data.errors import ConfigError
from navrep_data.sim import Simulator, make_config


@pytest.mark.slow
@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("env", ["navrep-test", "navrep-train", param("mark-test-2")])
def test_the_robot_starts_there_and_wants_to_go_there(env, physics):
    plain, world = make(env, physics=physics), make(env, physics=physics)
    _, before = plain.reset(seed=5)
    state = plain.unwrapped._worlds.sim.state()
    # where it would have been, looking elsewhere, and a goal a little nearer
    start = (*before["robot"][:2], 0.5)
    goal = state.robot[3:5] + 0.1 * (state.robot[:2] - state.robot[3:5]) / np.linalg.norm(
        state.robot[:2] - state.robot[3:5]
    )
    goal += plain.unwrapped._worlds.sim.origins[0]
    observation, info = world.reset(seed=5, options={"start": start, "goal": goal})
    np.testing.assert_allclose(info["robot"], start)
    assert same(info["humans"], before["humans"])
    away = goal - start[:2]
    c, s = np.cos(0.5), np.sin(0.5)
    expected = [c * away[0] + s * away[1], c * away[1] - s * away[0], 0.0, 0.0, 0.0]
    np.testing.assert_allclose(observation["robot_state"], expected, atol=1e-5)
    assert observation in world.observation_space
    # the first step pays for the way that it made, from the new start
    moved, *_ = world.step([0.3, 0.0, 0.0])
    assert np.linalg.norm(moved["robot_state"][:2] - observation["robot_state"][:2]) < 0.1
    # a later reset without them draws as ever
    assert same(world.reset(seed=5)[0], plain.reset(seed=5)[0])


def test_empty_worlds_are_driven_from_start_to_goal(tmp_path):
    env = NavRepEnv("empty")
    film = record(
        env, "goal", tmp_path / "a.gif", seed=1, options={"start": (-1.0, 0.5, 0.0), "goal": (1.5, 0.5)}, size=64
    )
    assert film.event == "goal"
    assert 10 <= film.steps <= 14
    np.testing.assert_allclose(env._trail[0][0], [-1.0, 0.5])


def test_worlds_of_a_batch_have_one_place_or_one_each():
    env = make_vec("empty", 3, time_limit=2.0)
    observations, infos = env.reset(seed=1, options={"goal": (3.0, 0.0), "start": [[0, 0, 0], [1, 0, 0], [0, 1, 0]]})
    np.testing.assert_allclose(infos["robot"], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(observations["robot_state"][:, :2], [[3, 0], [2, 0], [3, -1]], atol=1e-6)
    kept = infos["robot"][1:].copy()
    _, infos = env.reset(options={"reset_mask": np.array([True, False, False]), "start": (0.5, 0.5)})
    np.testing.assert_allclose(infos["robot"][0, :2], 0.5)
    np.testing.assert_allclose(infos["robot"][1:], kept)
    for _ in range(11):
        infos = env.step(np.zeros((3, 3)))[4]
    assert abs(infos["robot"][1, 0] - 1.0) > 0.1  # the next episode starts where it is drawn


@pytest.mark.slow
@pytest.mark.parametrize("env", [param("mark-test-2")])
def test_planners_follow_a_new_goal_on_maps(env):
    sim = Simulator(make_config(env), 2, seed=3)
    ahead = sim.maps.ways_ahead().copy()
    first = sim.state(0)
    there = first.robot[3:5]
    sim.place([[*there, 0.0], [np.nan] * 3], [first.robot[:2], [np.nan] * 2], [True, False])  # the way back
    after = sim.maps.ways_ahead()
    assert 0.3 < np.linalg.norm(after[0] - there) < 2.0
    np.testing.assert_array_equal(after[1], ahead[1])


@pytest.mark.parametrize(
    ("env", "options", "words"),
    [
        (
            "navrep-test",
            {"start": (100.0, 0.0)},
            r"The start \(100, 0\) has -.* m to the next obstacle, expected at least",
        ),
        ("navrep-test", {"goal": (0.0, 99.0)}, r"The goal \(0, 99\) has -.*: choose a free place"),
        (
            "empty",
            {"start": (1.0, 1.0), "goal": (1.1, 1.0)},
            r"The goal is 0.10 m from the start, expected more than 0",
        ),
        ("empty", {"start": "here"}, r"start is here, expected finite x, y \[m\], or with a heading \[rad\]"),
        ("empty", {"goal": (1.0, np.nan)}, r"goal is \(1.0, nan\), expected finite x, y \[m\]"),
        ("empty", {"goal": (1.0, 2.0, 3.0)}, "goal is .*expected finite"),
        (
            "empty",
            {"start": (456000.0, 5428000.0, 0.0), "goal": (456005.0, 5428000.0)},
            r"The start holds 5.428e\+06; expected coordinates within 16384 m of 0, .*Subtract a common offset",
        ),
        ("cadrl", {"goal": (0.0, -16385.0)}, "The goal holds 16385; expected coordinates within 16384 m of 0"),
        ("empty", {"gaol": (1.0, 2.0)}, "Unknown reset option 'gaol', expected one of: episode, goal"),
    ],
)
def test_places_that_cannot_be_are_refused_in_one_line(env, options, words):
    world = NavRepEnv(env)
    with pytest.raises(ConfigError, match=words) as caught:
        world.reset(seed=1, options=options)
    assert "\n" not in str(caught.value)
    world.reset(seed=1)  # nothing of it is left


def test_places_on_people_and_of_several_robots_are_refused():
    env = NavRepEnv("soadrl", obstacles=0)
    human = env.reset(seed=2)[1]["humans"][0, :2]
    with pytest.raises(ConfigError, match=r"overlaps a human by .*choose a free place, or another seed"):
        env.reset(seed=2, options={"start": human})
    with pytest.raises(ConfigError, match="robots is 2, expected 1"):
        NavRepEnv("empty", robots=2).reset(options={"start": (0.0, 0.0)})
    sim = Simulator(make_config("empty"))
    sim.step(np.zeros((1, 3)))
    with pytest.raises(ConfigError, match="World 0 has had 1 steps, expected none"):
        sim.place([[0.0, 0.0, 0.0]], [[1.0, 1.0]])
    with pytest.raises(ConfigError, match=r"goals have shape \(2,\), expected \(1, 2\)"):
        sim.place([[0.0, 0.0, 0.0]], [1.0, 1.0])


@pytest.mark.slow
@pytest.mark.parametrize("env", [param("ian")])
def test_scenarios_take_starts_but_no_goals(env):
    world = make(env)
    before = world.reset(options={"episode": 0})[1]["robot"]
    _, info = world.reset(options={"episode": 0, "start": (*before[:2], 1.0)})
    np.testing.assert_allclose(info["robot"], [*before[:2], 1.0])
    with pytest.raises(ConfigError, match="A goal was given, but scenarios have their own"):
        world.reset(options={"episode": 0, "goal": before[:2]})
