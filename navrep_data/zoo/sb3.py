"""Released controllers as stable-baselines3 PPO models, to predict with and to train on."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from navrep_data.models.config import EndToEndConfig
from navrep_data.models.controllers import ActorCritic, EndToEnd
from navrep_data.schema import ROBOT_STATE_SIZE
from navrep_data.zoo.policy import Policy

# Read from the zips: the same in all 53 released runs (paper section III-C). Batch = 128 steps x 6 environments / 4.
N_ENVS = 6
HYPERPARAMETERS: dict[str, Any] = {
    "learning_rate": 2.5e-4,
    "n_steps": 128,
    "batch_size": 192,
    "n_epochs": 4,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "clip_range_vf": 0.2,
    "ent_coef": 0.01,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
}
# stable-baselines 2's Adam; torch's default is 1e-8
_ADAM_EPS = 1e-5


class EndToEndExtractor(BaseFeaturesExtractor):
    """The convolutions of an end-to-end network, shared by actor and critic, as a features extractor.

    Parameters
    ----------
    observation_space : gymnasium.spaces.Box
        Of shape (1085,) or (4101,).
    lidar : str
        ``"rings"`` or ``"1d"``.
    """

    def __init__(self, observation_space: gymnasium.spaces.Box, lidar: str) -> None:
        config = EndToEndConfig(lidar)
        super().__init__(observation_space, config.n_features + ROBOT_STATE_SIZE)
        self.network = EndToEnd(config)
        # the perceptrons are stable-baselines3's own
        for name in ("pi", "vf", "mean", "value", "q", "logstd"):
            delattr(self.network, name)
        self.scale = 1.0
        """What observations are multiplied by before the convolutions; the first one's weights are kept for it."""

    def load(self, network: EndToEnd) -> None:
        """Take the convolutions of a network, which reads observations as they are."""
        self.network.encoder.load_state_dict(network.encoder.state_dict())
        self.network.fc.load_state_dict(network.fc.state_dict())
        with torch.no_grad():
            self._first(self.network).weight /= self.scale

    def store(self, network: EndToEnd) -> None:
        """Give the convolutions to a network, which reads observations as they are."""
        network.encoder.load_state_dict(self.network.encoder.state_dict())
        network.fc.load_state_dict(self.network.fc.state_dict())
        with torch.no_grad():
            self._first(network).weight *= self.scale

    @staticmethod
    def _first(network: EndToEnd) -> nn.Conv2d:
        first = network.encoder[0]
        assert isinstance(first, nn.Conv2d)
        return first

    def forward(self, observations: Tensor) -> Tensor:
        """Return features of shape (B, 37)."""
        return self.network.features(observations)


def spaces(policy: Policy) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return the observation space (unbounded features) and the action space (two velocities in [-1, 1])."""
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (policy.n_inputs,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
    )


def to_sb3(policy: Policy, env: Any = None, **options: Any) -> PPO:
    """Return a PPO model with a policy's weights.

    Parameters
    ----------
    policy : Policy
        From the zoo. Its encoder stays outside: observations are what ``policy.encode`` returns.
    env : gymnasium.Env or VecEnv, optional
        To train in, with observations of shape (n_inputs,) and actions of shape (2,). Without one the model predicts;
        ``set_env`` then takes environments of 6 worlds, as the original trained with.
    **options
        Instead of the hyper-parameters of the released runs; ``n_envs`` sets the worlds of a model without `env`.

    Returns
    -------
    stable_baselines3.PPO
        ``predict(features, deterministic=True)`` gives the mean clipped to [-1, 1].

    Notes
    -----
    Released runs: stable-baselines 2.10 PPO2. The unused state-action value is left out; the optimiser starts anew.
    """
    observation_space, action_space = spaces(policy)
    n_envs = options.pop("n_envs", N_ENVS)
    settings = {**HYPERPARAMETERS, "device": "cpu", **options}
    settings.setdefault("policy_kwargs", _policy_kwargs(policy.network))
    model = PPO(ActorCriticPolicy, env, _init_setup_model=False, **settings)
    if env is None:
        model.observation_space, model.action_space, model.n_envs = observation_space, action_space, n_envs
    model._setup_model()
    put_weights(model.policy, policy.network)
    return model


def _policy_kwargs(network: ActorCritic) -> dict[str, Any]:
    hidden = [layer.out_features for layer in network.pi if isinstance(layer, nn.Linear)]
    kwargs: dict[str, Any] = {
        "net_arch": {"pi": hidden, "vf": hidden},
        "activation_fn": nn.Tanh,
        "optimizer_kwargs": {"eps": _ADAM_EPS},
    }
    if isinstance(network, EndToEnd):
        kwargs |= {
            "activation_fn": nn.ReLU,
            "features_extractor_class": EndToEndExtractor,
            "features_extractor_kwargs": {"lidar": network.config.lidar},
        }
    return kwargs


@torch.no_grad()
def put_weights(target: ActorCriticPolicy, network: ActorCritic) -> None:
    """Copy a controller's weights into a stable-baselines3 policy."""
    pairs: list[tuple[nn.Module, nn.Module]] = [
        (target.mlp_extractor.policy_net, network.pi),
        (target.mlp_extractor.value_net, network.vf),
        (target.action_net, network.mean),
        (target.value_net, network.value),
    ]
    if isinstance(network, EndToEnd):
        extractor = target.features_extractor
        assert isinstance(extractor, EndToEndExtractor)
        extractor.load(network)
    for module, source in pairs:
        module.load_state_dict(source.state_dict())
    target.log_std.copy_(network.logstd)


def take_weights(network: ActorCritic, source: ActorCriticPolicy) -> None:
    """Copy the weights of a stable-baselines3 policy back into a controller, for saving it in the package's format."""
    target = source
    pairs: list[tuple[nn.Module, nn.Module]] = [
        (network.pi, target.mlp_extractor.policy_net),
        (network.vf, target.mlp_extractor.value_net),
        (network.mean, target.action_net),
        (network.value, target.value_net),
    ]
    if isinstance(network, EndToEnd):
        extractor = target.features_extractor
        assert isinstance(extractor, EndToEndExtractor)
        extractor.store(network)
    with torch.no_grad():
        for module, origin in pairs:
            module.load_state_dict(origin.state_dict())
        network.logstd.copy_(target.log_std)
