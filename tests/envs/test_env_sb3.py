"""stable-baselines3: its checker, and PPO."""

import contextlib

import gymnasium
import numpy as np
import pytest
from env_cases import CASES, KINDS, make, same

from navrep_data import envs
from navrep_data.envs import make_sb3_vec
from navrep_data.errors import ConfigError
from navrep_data.sim import make_config


@pytest.fixture(scope="module")
def check_env():
    return pytest.importorskip("stable_baselines3.common.env_checker").check_env


@pytest.mark.slow
@pytest.mark.parametrize(("env", "physics"), CASES)
def test_passes_stable_baselines3s_checker(check_env, env, physics):
    joint = make_config(env).robots > 1
    # for several robots it recommends to flatten, which is what FlatObservation does
    advice = pytest.warns(UserWarning, match="unconventional shape") if joint else contextlib.nullcontext()
    with advice:
        check_env(make(env, physics=physics).unwrapped)
        check_env(envs.Scan1dObservation(make(env, physics=physics)))
    check_env(envs.FlatObservation(make(env, physics=physics)))
    check_env(envs.FlatObservation(envs.RingsObservation(make(env, physics=physics))))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "wrapper"),
    [("MultiInputPolicy", None), ("MultiInputPolicy", envs.Scan1dObservation), ("MlpPolicy", envs.FlatObservation)],
)
def test_ppo_trains(policy, wrapper):
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    env = make_vec_env("navrep_data:NavRepTrain-v0", n_envs=2, seed=3, wrapper_class=wrapper)
    model = PPO(policy, env, n_steps=16, batch_size=16, n_epochs=2, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(64)
    after = list(model.policy.parameters())
    assert model.num_timesteps == 64
    assert any(not np.array_equal(a.numpy(), b.detach().numpy()) for a, b in zip(before, after, strict=True))
    action, _ = model.predict(env.reset(), deterministic=True)
    assert action.shape == (2, 3)


class Marked(gymnasium.Wrapper):
    """A wrapper that no world has."""


def both(env="navrep-train", n=3, **settings):
    """Return our VecEnv and stable-baselines3's own of the same environments, with the same seed."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    ours = make_sb3_vec(env, n, monitor=False, **settings)
    theirs = DummyVecEnv([lambda: make(env, **settings) for _ in range(n)])
    assert ours.seed(7) == theirs.seed(7) == [7 + i for i in range(n)]
    return ours, theirs


def test_steps_are_those_of_stable_baselines3s_own_vecenv():
    """Observations, rewards, ends, infos, truncations, last observations, infos of resets: bit for bit."""
    ours, theirs = both(time_limit=3.0, render_mode="rgb_array")
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert same(ours.reset(), dict(theirs.reset()))
    rng, kinds = np.random.default_rng(1), set()
    for _ in range(40):
        assert all(same(a, b) for a, b in zip(ours.reset_infos, theirs.reset_infos, strict=True))
        actions = rng.uniform(-1.0, 1.0, (3, 3)).astype(np.float32)
        a, b = ours.step(actions), theirs.step(actions)
        assert same(a[0], dict(b[0]))
        assert same(a[1], b[1])
        assert same(a[2], b[2])
        for info, expected in zip(a[3], b[3], strict=True):
            assert same(info, expected)
        kinds |= {info["TimeLimit.truncated"] for info, over in zip(a[3], a[2], strict=True) if over}
    assert True in kinds
    assert np.shape(ours.render()) == np.shape(theirs.render())
    assert same(ours.get_images()[1], theirs.get_images()[1])


def test_seeds_and_options_hold_for_the_next_reset_only():
    ours, theirs = both("navrep-test", humans=1)
    for worlds in (ours, theirs):
        worlds.set_options({"episode": 4})
        worlds.reset()
    assert [info["seed"] for info in ours.reset_infos] == [1004, 1005, 1006]
    assert {info["seed"] for info in theirs.reset_infos} == {1004}
    ours.reset()
    assert [info["seed"] for info in ours.reset_infos] == [1007, 1008, 1009]
    ours.set_options([{"episode": 1}, {}, {}])
    with pytest.raises(ConfigError, match="options differ from world to world"):
        ours.reset()


def test_attributes_and_methods_are_those_of_each_world():
    from stable_baselines3.common.vec_env import VecMonitor, is_vecenv_wrapped

    worlds = make_sb3_vec("NavRepTest-v0", 3, humans=1, seed=1000)
    assert is_vecenv_wrapped(worlds, VecMonitor)
    worlds.reset()
    assert [config.env for config in worlds.get_attr("config", [0, 2])] == ["navrep-test"] * 2
    assert worlds.get_attr("render_mode") == [None] * 3
    assert not worlds.has_attr("colour")
    with pytest.raises(AttributeError, match=r"A world of a batch has no attribute 'colour', expected .*config"):
        worlds.get_attr("colour")
    worlds.set_attr("colour", "red", indices=1)
    assert worlds.get_attr("colour", 1) == ["red"]
    assert not worlds.has_attr("colour")
    with pytest.raises(ConfigError, match="'config' is shared by all worlds of a batch and cannot be set"):
        worlds.set_attr("config", None)
    frames = worlds.env_method("frame", 64, indices=[0, 1])
    assert [frame.shape for frame in frames] == [(64, 64, 3)] * 2
    assert not same(*frames)
    single = make("navrep-test", humans=1).unwrapped
    single.reset(seed=1001)
    assert same(worlds.env_method("state", indices=1)[0].robot, single._worlds.sim.state().robot)
    assert worlds.env_is_wrapped(Marked, [0, 1]) == [False, False]
    worlds.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lidar", "flat", "policy"),
    [(None, True, "MlpPolicy"), ("1d", True, "MlpPolicy"), ("rings", False, "MultiInputPolicy")],
)
def test_ppo_learns_on_our_worlds(lidar, flat, policy):
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy

    worlds = make_sb3_vec("navrep-train", 4, lidar=lidar, flat=flat, time_limit=2.0, humans=1, seed=0)
    model = PPO(policy, worlds, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(128)
    assert any(not np.array_equal(a, b.detach()) for a, b in zip(before, model.policy.parameters(), strict=True))
    assert len(model.ep_info_buffer) > 0
    rewards, lengths = evaluate_policy(model, worlds, 4, return_episode_rewards=True)
    assert len(rewards) >= 4
    assert max(lengths) <= 10


def test_wrong_requests_say_so_in_one_line():
    from gymnasium.vector import AutoresetMode

    with pytest.raises(ConfigError, match="lidar is 'ring', expected one of: scan, rings, 1d"):
        make_sb3_vec(lidar="ring")
    with pytest.raises(ConfigError, match=r"expected a NavRepVectorEnv with autoreset_mode='SameStep'"):
        envs.NavRepSB3VecEnv(envs.NavRepVectorEnv(2, autoreset_mode=AutoresetMode.NEXT_STEP))
    with pytest.raises(ConfigError, match="robots is 2, expected 1"):
        make_sb3_vec("empty", 2, robots=2)


def test_names_are_accepted_however_they_are_spelt():
    for name in ("navrep-test", "NavRepTest-v0", "navrep_data:NavRepTest-v0", "navreptest", "NavRepTest"):
        assert envs.NavRepEnv(name).config.env == "navrep-test"


@pytest.mark.parametrize("kind", KINDS)
def test_whole_numbers_of_any_kind(kind):
    plain, other = make_sb3_vec("empty", 2, seed=2), make_sb3_vec("empty", kind(2), seed=kind(2))
    assert same(plain.reset()["robot_state"], other.reset()["robot_state"])
    plain.seed(255)
    other.seed(kind(255))  # 256 is more than a byte holds
    assert same(plain.reset()["robot_state"], other.reset()["robot_state"])
    wanted = plain.env_method("state", indices=1)[0].robot
    for indices in (kind(1), [kind(1)], np.array([1]), -1):
        assert same(other.env_method("state", indices=indices)[0].robot, wanted)


def test_what_is_no_seed_and_no_world_is_refused():
    with pytest.raises(ConfigError, match=r"seed is 2\.5, expected a whole number from 0"):
        make_sb3_vec("empty", 2, seed=2.5)
    worlds = make_sb3_vec("empty", 2)
    for indices in (1.5, [0, 1.5], 2, [-3]):
        with pytest.raises(ConfigError, match=r"indices is .*, expected a whole number from -2 to 1"):
            worlds.get_attr("config", indices)
