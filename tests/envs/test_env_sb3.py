"""stable-baselines3: its checker, and PPO."""

import contextlib

import numpy as np
import pytest
from env_cases import CASES, make

from navrep_data import envs
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
