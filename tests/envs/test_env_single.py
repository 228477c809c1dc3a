"""The single environment: checkers, episodes and seeds, infos, endings, errors."""

import gymnasium
import numpy as np
import pytest
from env_cases import CASES, HAS_MAPS, KINDS, NUMBERED, PHYSICS, STREAMED, make, same
from gymnasium.utils.env_checker import check_env
from recorded import reference

from navrep_data.envs import NavRepEnv
from navrep_data.errors import ConfigError, UnknownNameError
from navrep_data.policies import to_goal
from navrep_data.registration import ENVIRONMENTS
from navrep_data.sim import SimConfig, Simulator, make_config, numpy_seed


@pytest.mark.parametrize(("env", "physics"), CASES)
def test_passes_gymnasiums_checker(env, physics):
    check_env(make(env, physics=physics).unwrapped)
    check_env(make(env, physics=physics, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("env", NUMBERED)
@pytest.mark.parametrize("physics", PHYSICS)
def test_a_seed_is_a_numpy_seed_where_episodes_are_numbered(env, physics):
    sim = Simulator(make_config(env, physics=physics))
    world = make(env, physics=physics)
    for episode in (0, 3, 7):
        seed = numpy_seed(env, episode)
        sim.reset_seeded([seed])
        expected = sim.observe()
        for how in ({"seed": seed}, {"options": {"episode": episode}}, {"seed": 5, "options": {"episode": episode}}):
            observation, info = world.reset(**how)
            assert info["seed"] == seed
            np.testing.assert_array_equal(observation["scan"], expected[0][0])
            np.testing.assert_array_equal(observation["robot_state"], expected[1][0])
        _, later = world.reset()
        assert later["seed"] == numpy_seed(env, episode + 1)


def test_a_seed_outside_the_numbered_list_goes_on_counting():
    env = make("navrep-test")
    assert env.reset(seed=77)[1]["seed"] == 77
    assert env.reset()[1]["seed"] == 78


def test_episodes_start_where_asked_and_wrap_at_500():
    env = gymnasium.make("navrep_data:NavRepTest-v0", physics="original", episode=498)
    assert [env.reset()[1]["seed"] for _ in range(4)] == [1498, 1499, 1000, 1001]
    env = gymnasium.make("NavRepVal-v0", episode=49)
    assert [env.reset()[1]["seed"] for _ in range(2)] == [49, 0]


def test_original_episodes_are_the_original_softwares():
    episodes = reference("test_env_reference.json")["episodes"]
    env = make("navrep-test", physics="original", episode=0)
    assert len(episodes) == 5
    for k, episode in enumerate(episodes):
        observation, info = env.reset()
        assert info["seed"] == 1000 + k
        np.testing.assert_allclose(observation["scan"][::108], episode["scan_every_108"], atol=1e-4)
        np.testing.assert_allclose(observation["robot_state"], episode["obs_state"], atol=1e-5)
        theirs = episode["robot"]
        np.testing.assert_allclose(info["robot"], [theirs["px"], theirs["py"], theirs["theta"]], atol=1e-9)
        people = [[h[name] for name in ("px", "py", "vx", "vy")] for h in episode["humans_after_reset"]]
        np.testing.assert_allclose(info["humans"], people, atol=1e-6)
        run = episode["action_0.5_0.25_0.1"]
        for expected in run["rewards"]:
            _, reward, terminated, _, info = env.step([0.5, 0.25, 0.1])
            assert reward == pytest.approx(expected, abs=1e-6)
        assert terminated == run["done"]
        assert (run["event"] == "Collision") == info["event"].startswith("collision")
        np.testing.assert_allclose(info["robot"], run["robot"], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("env", "physics"), STREAMED)
def test_a_seed_is_a_stream_elsewhere(env, physics):
    sim = Simulator(make_config(env, physics=physics), seed=41)
    world = make(env, physics=physics)
    world.reset()
    for how in ({"seed": 41}, {}, {}):
        observation, info = world.reset(**how)
        assert "seed" not in info
        np.testing.assert_array_equal(observation["scan"], sim.observe()[0][0])
        sim.reset()


def test_nobodys_seed_is_another_world_each_time():
    scans = [make("navrep-train").reset()[0]["scan"].tobytes() for _ in range(3)]
    assert len(set(scans)) == 3


@pytest.mark.slow
@pytest.mark.parametrize(("env", "physics"), CASES)
def test_info_says_where_everybody_is(env, physics):
    world = NavRepEnv(env, physics=physics)
    _, info = world.reset(seed=7)
    for step in range(12):
        state = world._worlds.sim.state()
        at = world._worlds.sim.origins[0]  # maps in consistent physics are simulated elsewhere than their files say
        robots = state.robots[:, :3] + [*at, 0.0]
        np.testing.assert_array_equal(info["robot"], robots if len(robots) > 1 else robots[0])
        np.testing.assert_array_equal(info["humans"], state.humans[:, :4] + [*at, 0.0, 0.0])
        assert info["event"] == "none", step
        observation, _, terminated, truncated, info = world.step(np.zeros(world.action_space.shape))
        assert observation in world.observation_space
        if terminated or truncated:
            break
    assert NavRepEnv(env, physics=physics, pad_humans=True).reset(seed=7)[1]["humans"].shape[1] == 4


def test_padded_humans_have_nan_in_empty_slots():
    plain, padded = NavRepEnv("soadrl"), NavRepEnv("soadrl", pad_humans=True)
    a, b = plain.reset(seed=3)[1]["humans"], padded.reset(seed=3)[1]["humans"]
    assert b.shape == (make_config("soadrl").max_humans, 4)
    np.testing.assert_array_equal(b[: len(a)], a)
    assert np.isnan(b[len(a) :]).all()
    assert 10 <= len(a) < len(b)


def endings(env, policy, episodes, **kwargs):
    world = make(env, **kwargs)
    found = []
    for _ in range(episodes):
        observation, _ = world.reset()
        over = False
        while not over:
            observation, reward, terminated, truncated, info = world.step(policy(observation))
            over = terminated or truncated
            assert type(reward) is float
            assert (info["event"] != "none") == over
        found.append((info["event"], terminated, truncated, round(reward)))
    return found


def test_goal_and_collisions_terminate():
    found = endings("navrep-test", lambda seen: to_goal(seen["robot_state"]), 16, episode=0)
    assert {event for event, *_ in found} == {"goal", "collision_human", "collision_obstacle"}
    for event, terminated, truncated, reward in found:
        assert (terminated, truncated) == (True, False)
        assert reward > 90 if event == "goal" else reward < -20


def test_timeout_truncates():
    still = endings("navrep-test", lambda _: np.zeros(3), 1, humans=0, time_limit=1.0)
    assert [ending[:3] for ending in still] == [("timeout", False, True)]


def test_actions_are_clipped_shares_of_the_largest_velocity():
    config = make_config("navrep-train", humans=0, obstacles=0)
    a, b = NavRepEnv(config), NavRepEnv(config)
    a.reset(seed=1), b.reset(seed=1)
    first, second = a.step([5.0, -0.5, 0.25]), b.step([1.0, -0.5, 0.25])
    assert same(first[0], second[0])
    np.testing.assert_allclose(first[0]["robot_state"][4], 0.25)
    speed = np.linalg.norm(first[0]["robot_state"][2:4])
    np.testing.assert_allclose(speed, np.hypot(1.0, 0.5), rtol=1e-6)


def test_settings_reach_the_simulator():
    env = make("navrep-train", physics="original", humans=2, obstacles=1, rendering="trunk", time_limit=9.0)
    config = env.unwrapped.config
    assert config == make_config(
        "navrep-train", physics="original", humans=2, obstacles=1, rendering="trunk", time_limit=9.0
    )
    assert NavRepEnv(config).config == config
    assert NavRepEnv(SimConfig(), humans=1).config.humans == 1
    assert make("navrep-train", sensor=config.sensor).unwrapped.metadata["render_fps"] == 5


def test_returned_arrays_are_the_callers():
    env = NavRepEnv("navrep-train")
    observation, info = env.reset(seed=1)
    for values in (*observation.values(), info["robot"], info["humans"]):
        values[:] = -1.0
    again, _ = NavRepEnv("navrep-train").reset(seed=1)
    observation, *_ = env.step(np.zeros(3))
    assert observation in env.observation_space
    assert again in env.observation_space


@pytest.mark.parametrize(
    ("error", "words", "kwargs"),
    [
        (UnknownNameError, "Unknown environment 'navrep-tset'. Did you mean 'navrep-test'", {"env": "navrep-tset"}),
        (ConfigError, "Environment 'soadrl' has no numbered episodes", {"env": "soadrl", "episode": 0}),
        (ConfigError, "episode is -1", {"env": "navrep-test", "episode": -1}),
        (ConfigError, "physics is 'orginal'", {"physics": "orginal"}),
        (ConfigError, "Unknown setting 'human'. Did you mean 'humans'", {"human": 3}),
        (ConfigError, "render_mode is 'rgb', expected one of: human, rgb_array", {"render_mode": "rgb"}),
    ],
)
def test_wrong_settings_say_so_in_one_line(error, words, kwargs):
    with pytest.raises(error, match="^" + words) as caught:
        NavRepEnv(**kwargs)
    assert "\n" not in str(caught.value)


def test_wrong_calls_say_so_in_one_line():
    env = NavRepEnv("navrep-test")
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) before step\(\)"):
        env.step(np.zeros(3))
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"before the first reset\(\)"):
        env.frame()
    for wrong, words in [
        ({"options": {"epsiode": 1}}, "Unknown reset option 'epsiode', expected one of: episode"),
        ({"options": {"episode": 1.5}}, "episode is 1.5"),
        ({"seed": 2**32}, "seed is 4294967296, expected a whole number from 0 to 4294967295"),
    ]:
        with pytest.raises(ConfigError, match=words):
            env.reset(**wrong)
    with pytest.raises(ConfigError, match="has no numbered episodes"):
        NavRepEnv("soadrl").reset(options={"episode": 1})
    env.reset()
    with pytest.raises(ConfigError, match=r"action has shape \(2,\), expected \(3,\)"):
        env.step(np.zeros(2))
    with pytest.raises(ConfigError, match="NaN"):
        env.step(np.full(3, np.nan))


def test_str_names_environment_and_physics():
    assert str(NavRepEnv("soadrl")) == "<NavRepEnv soadrl, consistent>"
    assert len(ENVIRONMENTS) == len(set(ENVIRONMENTS))


@pytest.mark.slow
@pytest.mark.skipif(not HAS_MAPS, reason="needs the maps: pip install 'navrep-data[maps]'")
def test_ian_plays_the_suites_episodes_by_number_and_numpy_seeds_by_seed():
    sim = Simulator(make_config("ian", physics="original"))
    names = sim.config.scenarios
    assert len(names) == 27
    env = make("ian", physics="original", episode=30)
    for k in (30, 31):
        observation, info = env.reset()
        assert (info["seed"], info["scenario"]) == (k, names[k % 27])
        sim.reset_scenarios([k % 27], [k])
        np.testing.assert_array_equal(observation["robot_state"], sim.observe()[1][0])
    sim.reset_seeded([77])
    observation, info = env.reset(seed=77)
    assert info["seed"] == 77
    np.testing.assert_array_equal(observation["robot_state"], sim.observe()[1][0])
    assert env.reset()[1]["seed"] == 78
    one = make("ian", scenarios=("rlasl1",))
    assert {one.reset()[1]["scenario"] for _ in range(3)} == {"rlasl1"}
    seeds = {make("ian").reset()[1]["seed"] for _ in range(3)}
    assert len(seeds) == 3
    observation, *_ = one.step([1.0, 1.0, 0.0])
    np.testing.assert_allclose(np.linalg.norm(observation["robot_state"][2:4]), 0.55, atol=1e-6)


@pytest.mark.skipif(not HAS_MAPS, reason="needs the maps: pip install 'navrep-data[maps]'")
def test_several_robots_have_an_axis():
    env = make("crowdmove-1")
    observation, info = env.reset(seed=4)
    assert observation["scan"].shape == (10, 1080)
    assert observation["robot_state"].shape == (10, 5)
    assert (info["robot"].shape, info["humans"].shape) == ((10, 3), (0, 4))
    _, reward, _, _, info = env.step(env.action_space.sample())
    assert info["rewards"].shape == (10,)
    assert reward == pytest.approx(info["rewards"].mean())


@pytest.mark.parametrize("env", ["empty", "navrep-test"])
@pytest.mark.parametrize("kind", KINDS)
def test_seeds_are_whole_numbers_of_any_kind(env, kind):
    plain, other = NavRepEnv(env), NavRepEnv(env)
    assert same(plain.reset(seed=5)[0]["robot_state"], other.reset(seed=kind(5))[0]["robot_state"])


@pytest.mark.parametrize("seed", [2.5, True, -1, [1], np.array([1, 2]), 2**63])
def test_what_is_no_seed_is_refused(seed):
    with pytest.raises(ConfigError, match=r"seed is .*, expected a whole number from 0"):
        NavRepEnv("empty").reset(seed=seed)
