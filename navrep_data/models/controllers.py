"""C: controllers on features, and the end-to-end networks.

Notes
-----
Original: stable-baselines 2.10 PPO2 with MlpPolicy, and the policies of ``custom_policy.py``. The state-action value
(q) that stable-baselines 2 keeps and never uses is kept too, so that every released number has its place.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from navrep_data.errors import ArrayError
from navrep_data.models.config import OBSERVATION_SHAPES, ControllerConfig, EndToEndConfig
from navrep_data.models.vae import FLAT_SIZE, as_images, convolutions
from navrep_data.schema import ROBOT_STATE_SIZE

N_ACTIONS = 2
LEAST_STD, MOST_STD = 0.05, 0.6
"""Widths of the distribution of bounded actions in training: the least unless a recipe says otherwise, the largest."""


def _perceptron(n_inputs: int, n_hidden: int, activation: type[nn.Module]) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_inputs, n_hidden), activation(), nn.Linear(n_hidden, n_hidden), activation())


class ActorCritic(nn.Module):
    """Base of both networks: an actor, a critic, and what PPO needs beside them.

    Parameters
    ----------
    n_inputs, n_hidden : int
        Inputs of the perceptrons, and units per layer.
    activation : type
        ``nn.Tanh`` or ``nn.ReLU``.
    """

    config: ControllerConfig | EndToEndConfig

    def __init__(self, n_inputs: int, n_hidden: int, activation: type[nn.Module]) -> None:
        super().__init__()
        self.pi = _perceptron(n_inputs, n_hidden, activation)
        self.vf = _perceptron(n_inputs, n_hidden, activation)
        self.mean = nn.Linear(n_hidden, N_ACTIONS)
        self.value = nn.Linear(n_hidden, 1)
        self.q = nn.Linear(n_hidden, N_ACTIONS)
        self.logstd = nn.Parameter(torch.zeros(N_ACTIONS, dtype=torch.float32))

    def features(self, inputs: Tensor) -> Tensor:
        """Return what the two perceptrons take; here the inputs themselves."""
        return inputs

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean action, unclipped, (B, 2) and the value (B,).

        Notes
        -----
        Released means are in the hundreds: control is bang-bang once they are clipped to [-1, 1].
        """
        x = self.features(inputs)
        return self.mean(self.pi(x)), self.value(self.vf(x)).squeeze(-1)

    def command(self, mean: Tensor) -> Tensor:
        """Return the velocities (B, 2) in [-1, 1] that outputs `mean` (B, 2) stand for, by the config's bounds."""
        squashed = torch.tanh(mean) if self.config.squash == "tanh" else mean.clamp(-1.0, 1.0)
        return limit_speed(squashed, self.config.max_speed)


def limit_speed(velocity: Tensor, max_speed: float) -> Tensor:
    """Return velocities (B, 2) shortened to `max_speed` [m/s] where they are longer; 0 = no limit."""
    if max_speed == 0.0:
        return velocity
    length = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
    limited: Tensor = velocity * (max_speed / length.clamp_min(max_speed))
    return limited


class Controller(ActorCritic):
    """C of the paper: features to action and value.

    Parameters
    ----------
    config : ControllerConfig
        Sizes.
    """

    config: ControllerConfig

    def __init__(self, config: ControllerConfig) -> None:
        super().__init__(config.n_inputs, config.n_hidden, nn.Tanh)
        self.config = config


class EndToEnd(ActorCritic):
    """The end-to-end network: observation and robot state in one row of numbers, to action and value.

    Parameters
    ----------
    config : EndToEndConfig
        Representation and sizes.

    Notes
    -----
    Inputs are (B, 1085): ranges in *metres* and robot state, or (B, 4101): rings in {0, 0.5, 1} with the nearest
    cell as measured, and robot state.
    """

    config: EndToEndConfig

    def __init__(self, config: EndToEndConfig) -> None:
        super().__init__(config.n_features + ROBOT_STATE_SIZE, config.n_hidden, nn.ReLU)
        self.config = config
        self.encoder = convolutions(config.lidar)
        self.fc = nn.Linear(FLAT_SIZE, config.n_features)

    def split(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return observations (B, ...) and robot states (B, 5) of inputs (B, 1085) or (B, 4101).

        Raises
        ------
        ArrayError
            If `inputs` have another size.
        """
        shape = OBSERVATION_SHAPES[self.config.lidar]
        n_obs = math.prod(shape)
        if inputs.shape[-1] != n_obs + ROBOT_STATE_SIZE:
            raise ArrayError(
                f"inputs have shape {tuple(inputs.shape)}, expected (B, {n_obs + ROBOT_STATE_SIZE}): observation and "
                "robot state in one row."
            )
        return inputs[..., :n_obs].reshape(-1, *shape), inputs[..., n_obs:]

    def features(self, inputs: Tensor) -> Tensor:
        """Return the numbers of the convolutions and the robot state, shape (B, n_features + 5)."""
        obs, robot_state = self.split(inputs)
        x = self.encoder(as_images(obs, self.config.lidar)).flatten(1)
        return torch.cat([self.fc(x), robot_state], dim=-1)
