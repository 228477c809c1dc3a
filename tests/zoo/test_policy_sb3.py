"""The same weights as a stable-baselines3 PPO: predicts the same, and trains."""

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from navrep_data.models import Controller, ControllerConfig, EndToEnd, EndToEndConfig
from navrep_data.models.vae import VAE, VAEConfig
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3 import spaces, take_weights, to_sb3

pytestmark = pytest.mark.slow  # seconds each; `make test` runs them


def policies():
    torch.manual_seed(0)
    torch.set_num_threads(1)
    yield Policy(Controller(ControllerConfig(37)), "z", "1d", VAE(VAEConfig("1d", 32)), name="z")
    yield Policy(EndToEnd(EndToEndConfig("1d")), None, "1d", name="e2e_1d")
    yield Policy(EndToEnd(EndToEndConfig("rings")), None, "rings", name="e2e_rings")
    yield Policy(Controller(ControllerConfig(1085)), None, "1d", name="carch")


class Points(gymnasium.Env):
    """Episodes of five steps with random observations."""

    def __init__(self, n):
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps += 1
        return self.observation_space.sample(), float(-np.abs(action).sum()), self.steps == 5, False, {}


@pytest.mark.parametrize("index", range(4))
def test_the_same_actions_and_values(index):
    policy = list(policies())[index]
    model = to_sb3(policy)
    rng = np.random.default_rng(0)
    scan = rng.uniform(0.5, 25, (6, 1080)).astype(np.float32)
    features = policy.encode(scan, rng.normal(size=(6, 5)).astype(np.float32))
    assert model.observation_space.shape == features.shape[1:] == spaces(policy)[0].shape
    mean, value = policy.controller(features)
    action, _ = model.predict(features, deterministic=True)
    np.testing.assert_allclose(action, mean.clip(-1, 1), atol=1e-6)
    with torch.no_grad():
        theirs = model.policy.predict_values(torch.tensor(features))[:, 0]
        std = model.policy.get_distribution(torch.tensor(features)).distribution.stddev[0]
    np.testing.assert_allclose(theirs, value, atol=1e-5)
    np.testing.assert_allclose(std, policy.network.logstd.exp().detach())


@pytest.mark.parametrize("end_to_end", [False, True])
def test_our_own_bounds_hold(end_to_end, tmp_path):
    """Ours have a tanh and a speed limit, which a plain actor-critic has not."""
    torch.manual_seed(0)
    own = {"n_hidden": 32, "squash": "tanh", "max_speed": 1.0}
    network = EndToEnd(EndToEndConfig("1d", **own)) if end_to_end else Controller(ControllerConfig(37, **own))
    with torch.no_grad():
        network.mean.weight *= 5.0  # so that both bounds are met
        network.logstd.copy_(torch.tensor([-9.0, 9.0]))
    vae = None if end_to_end else VAE(VAEConfig("1d", 32))
    policy = Policy(network.eval(), None if vae is None else "z", "1d", vae, name="ours")
    rng = np.random.default_rng(0)
    scan, state = (
        rng.uniform(0.5, 25, (64, 1080)).astype(np.float32),
        rng.normal(size=(64, 5), scale=5.0).astype(np.float32),
    )
    features, expected = policy.encode(scan, state), policy.act(scan, state)[:, :2]
    speed = np.linalg.norm(expected, axis=1)
    assert (speed > 0.999).any()
    assert (speed < 0.99).any()
    model = to_sb3(policy)
    np.testing.assert_allclose(model.predict(features, deterministic=True)[0], expected, atol=1e-5)
    drawn, _ = model.predict(features)
    assert np.abs(drawn - expected).max() > 0.1
    assert np.linalg.norm(drawn, axis=1).max() <= 1 + 1e-6
    width = model.policy.get_distribution(torch.tensor(features)).distribution.stddev[0]
    np.testing.assert_allclose(width.detach(), [0.05, 0.6], rtol=1e-5)
    model.save(tmp_path / "m")
    again = PPO.load(tmp_path / "m", device="cpu")
    np.testing.assert_allclose(again.predict(features, deterministic=True)[0], expected, atol=1e-5)


def test_it_trains_and_the_weights_come_back():
    policy = next(policies())
    model = to_sb3(policy, Points(37), n_steps=16, batch_size=16)
    before = policy.controller(np.ones((1, 37), np.float32))[0]
    model.learn(32)
    assert model.num_timesteps == 32
    trained, _ = model.predict(np.ones((1, 37), np.float32), deterministic=True)
    np.testing.assert_array_equal(policy.controller(np.ones((1, 37), np.float32))[0], before)
    assert np.abs(trained - before).max() > 1e-5
    take_weights(policy.network, model.policy)
    after = policy.controller(np.ones((1, 37), np.float32))[0]
    np.testing.assert_allclose(after, trained, atol=1e-6)


def test_hyperparameters_are_those_of_the_released_runs():
    model = to_sb3(next(policies()))
    assert (model.n_steps, model.n_envs, model.batch_size, model.n_epochs) == (128, 6, 192, 4)
    assert (model.gamma, model.gae_lambda, model.ent_coef, model.learning_rate) == (0.99, 0.95, 0.01, 2.5e-4)
    assert model.policy.optimizer.defaults["eps"] == 1e-5
    assert to_sb3(next(policies()), ent_coef=0.0).ent_coef == 0.0
