"""The convolutions of end-to-end networks as training runs them."""

from __future__ import annotations

import torch
from gymnasium import spaces
from torch import Tensor
from torch.nn import functional

from navrep_data.train import passes
from navrep_data.zoo.sb3 import EndToEndExtractor

# Metres that the convolutions take for 1: about the lidar's range; a power of two brings weights back to the bit.
_METRES = 32.0
# Rows whose maps stay in the cache until the backward pass, in training as in rollouts.
_CHUNK = 256


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
    scaled : bool
        Whether ranges are divided by 32 m before the first convolution; the authors' are not.
    """

    def __init__(self, observation_space: spaces.Box, lidar: str, precision: str, scaled: bool = True) -> None:
        super().__init__(observation_space, lidar)
        self.dtype = passes.PRECISIONS[precision]
        self.scale = 1.0 / _METRES if scaled and lidar == "1d" else 1.0

    def forward(self, observations: Tensor) -> Tensor:
        """Return features of shape (B, 37)."""
        return torch.cat([self._features(part) for part in torch.split(observations, _CHUNK)])

    def _features(self, observations: Tensor) -> Tensor:
        network = self.network
        obs, robot_state = network.split(observations)
        x = passes.maps(network.encoder, obs * self.scale, network.config.lidar, self.dtype)
        x = functional.linear(x, network.fc.weight.to(self.dtype)).float() + network.fc.bias
        return torch.cat([x, robot_state], dim=-1)
