"""Actor and critic for PPO whose actions stay within bounds by themselves."""

from __future__ import annotations

import math
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor
from torch.nn import functional

from navrep_data.train import passes
from navrep_data.train.controller_recipe import MOST_STD
from navrep_data.zoo.sb3 import EndToEndExtractor

# Metres that the convolutions take for 1: about the lidar's range; a power of two brings weights back to the bit.
_METRES = 32.0
# Rows whose maps stay in the cache until the backward pass, in training as in rollouts.
_CHUNK = 256


class BoundedPolicy(ActorCriticPolicy):
    """A normal distribution whose mean is within (-1, 1) and whose width stays between `least_std` and 0.6.

    Notes
    -----
    The released controllers' means and widths had no bounds while the environment clipped what it executed: with an
    entropy bonus both grew into the hundreds, and control became bang-bang (MODEL_FACTS 7).
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *args: Any,
        least_std: float = 0.05,
        **kwargs: Any,
    ):
        self._least = math.log(least_std)
        kwargs.setdefault("log_std_init", math.log(0.4))
        super().__init__(observation_space, action_space, *args, **kwargs)

    def heads(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return means (N, A), log widths (A,) and values (N,) of observations (N, F)."""
        latent_pi, latent_vf = self.mlp_extractor(self.extract_features(obs))
        mean, log_width = self._distribution(latent_pi)
        return mean, log_width, self.value_net(latent_vf).squeeze(1)

    def _distribution(self, latent_pi: Tensor) -> tuple[Tensor, Tensor]:
        return torch.tanh(self.action_net(latent_pi)), self.log_std.clamp(self._least, math.log(MOST_STD))

    def _get_action_dist_from_latent(self, latent_pi: Tensor) -> Distribution:
        assert isinstance(self.action_dist, DiagGaussianDistribution)
        return self.action_dist.proba_distribution(*self._distribution(latent_pi))


class FastExtractor(EndToEndExtractor):
    """The convolutions of an end-to-end network as training runs them: fast, and with ranges scaled.

    Parameters
    ----------
    observation_space : gymnasium.spaces.Box
        Of shape (1085,) or (4101,).
    lidar : str
        ``"rings"`` or ``"1d"``.
    precision : str
        ``"float32"`` or ``"bfloat16"``.
    """

    def __init__(self, observation_space: spaces.Box, lidar: str, precision: str) -> None:
        super().__init__(observation_space, lidar)
        self.dtype = passes.PRECISIONS[precision]
        self.scale = 1.0 if lidar == "rings" else 1.0 / _METRES

    def forward(self, observations: Tensor) -> Tensor:
        """Return features of shape (B, 37)."""
        return torch.cat([self._features(part) for part in torch.split(observations, _CHUNK)])

    def _features(self, observations: Tensor) -> Tensor:
        network = self.network
        obs, robot_state = network.split(observations)
        x = passes.maps(network.encoder, obs * self.scale, network.config.lidar, self.dtype)
        x = functional.linear(x, network.fc.weight.to(self.dtype)).float() + network.fc.bias
        return torch.cat([x, robot_state], dim=-1)
