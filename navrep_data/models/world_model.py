"""What all world models share: codes in and out, one step ahead, and a memory that runs along an episode."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from navrep_data.errors import ConfigError
from navrep_data.models.config import (
    CONTEXT_RULES,
    JointConfig,
    ModularConfig,
    TransformerConfig,
    VAEConfig,
)
from navrep_data.models.noise import Noise, sample
from navrep_data.models.observation import observation_from_scan
from navrep_data.models.vae import VAE

CONTEXT = 32
"""Steps that the released joint and transformer memories look at."""

LSTMState = tuple[Tensor, Tensor]


@dataclass
class Output:
    """Everything that a forward pass over a sequence computes.

    Attributes
    ----------
    mu, logvar, z : Tensor of shape (B, T, Z)
        Distribution of the code of each observation and the code that was used.
    h : Tensor of shape (B, T, H)
        Memory after each row.
    next_z : Tensor of shape (B, T, Z)
        Code predicted for the next row.
    next_goal : Tensor of shape (B, T, 2) [m]
        Goal predicted for the next row, robot frame.
    """

    mu: Tensor
    logvar: Tensor
    z: Tensor
    h: Tensor
    next_z: Tensor
    next_goal: Tensor


@dataclass
class Prediction:
    """One step ahead of each row.

    Attributes
    ----------
    obs : Tensor of shape (B, T, 64, 64) or (B, T, 1080)
        Decoded next observation, values in (0, 1).
    goal : Tensor of shape (B, T, 2) [m]
        Next goal, robot frame.
    z, h : Tensor of shape (B, T, Z) and (B, T, H)
        Code predicted for the next row and memory after this one.
    """

    obs: Tensor
    goal: Tensor
    z: Tensor
    h: Tensor


class Stream(Protocol):
    """A memory that is fed one row at a time, for a batch of episodes that end independently of each other."""

    def step(self, mu: Tensor, logvar: Tensor, goal: Tensor, action: Tensor) -> Tensor:
        """Feed one row per episode and return h of shape (B, H); the result is not changed by later steps."""

    def reset(self, mask: Tensor) -> None:
        """Forget the episodes where `mask` of shape (B,), bool, is true."""

    def listens(self) -> bool:
        """Return whether any episode's h can still change with what is fed."""


class WorldModel(nn.Module):
    """Base of the modular, joint and transformer world models.

    Notes
    -----
    Shapes: obs (B, T, 64, 64) rings in {0, 0.5, 1} or (B, T, 1080) ranges over 25 m; goal (B, T, 2) [m] robot
    frame; action (B, T, 3) [m/s, m/s, rad/s]. Released models pair a row with the action that *led to* it.
    """

    config: ModularConfig | JointConfig | TransformerConfig
    vae: VAE
    default_context = "oldest-32"
    inference_noise: Noise | None = None
    """What :meth:`predict` draws from where it is not told; None = deterministic."""

    @property
    def lidar(self) -> str:
        """Representation that the model takes: ``"rings"`` or ``"1d"``."""
        return self.config.lidar

    @property
    def z_size(self) -> int:
        """Numbers of z."""
        return self.config.z_size

    @property
    def h_size(self) -> int:
        """Numbers of h."""
        return self.config.h_size

    def vae_config(self) -> VAEConfig:
        """Return the config of the model's V."""
        return VAEConfig(self.config.lidar, self.config.z_size)

    def encode(self, obs: Tensor, noise: Noise | None = None) -> Tensor:
        """Return codes of shape (..., Z) of observations: the mean, or with `noise` a sample."""
        return self.vae.encode(obs, noise)

    def decode(self, z: Tensor) -> Tensor:
        """Return observations in (0, 1) of codes of shape (..., Z)."""
        return self.vae.decode(z)

    @abstractmethod
    def hidden(
        self,
        z: Tensor,
        goal: Tensor,
        action: Tensor,
        noise: Noise | None = None,
        state: LSTMState | None = None,
    ) -> tuple[Tensor, LSTMState | None]:
        """Run the memory over codes.

        Parameters
        ----------
        z : Tensor of shape (B, T, Z)
            Codes.
        goal, action : Tensor of shape (B, T, 2) [m] and (B, T, 3)
            As everywhere.
        noise : Noise, optional
            Brings dropout, and where there is no `state` a random one.
        state : pair of Tensor, optional
            LSTM state before the first row; zero if left out. Transformers have none.

        Returns
        -------
        h : Tensor of shape (B, T, H)
        state : pair of Tensor or None
        """

    @abstractmethod
    def heads(self, z: Tensor, goal: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Return the next z and the next goal [m] that follow from the memory `h` at `z` and `goal`."""

    def forward(
        self,
        obs: Tensor,
        goal: Tensor,
        action: Tensor,
        noise: Noise | None = None,
        state: LSTMState | None = None,
    ) -> Output:
        """Run the whole model over sequences; see :class:`Output`."""
        mu, logvar = self.vae.distribution(obs)
        z = sample(mu, logvar, noise)
        h, _ = self.hidden(z, goal, action, noise, state)
        next_z, next_goal = self.heads(z, goal, h)
        return Output(mu, logvar, z, h, next_z, next_goal)

    @torch.no_grad()
    def predict(self, obs: Tensor, goal: Tensor, action: Tensor, noise: Noise | None = None) -> Prediction:
        """Predict the next observation and goal after every row of sequences.

        Parameters
        ----------
        obs, goal, action : Tensor
            (B, T, ...) as in the class's notes.
        noise : Noise, optional
            Dropout, sampled z and random initial state. Left out: :attr:`inference_noise`.

        Returns
        -------
        Prediction
        """
        out = self.forward(obs, goal, action, self.inference_noise if noise is None else noise)
        return Prediction(self.decode(out.next_z), out.next_goal, out.next_z, out.h)

    def observation(self, scan: NDArray[Any]) -> Tensor:
        """Return what the model takes, made of scans of shape (..., 1080) [m]; on the CPU."""
        return observation_from_scan(scan, self.lidar)

    def stream(self, batch_size: int, context: str | None = None, noise: Noise | None = None) -> Stream:
        """Return an empty memory for a batch of episodes.

        Parameters
        ----------
        batch_size : int
            Episodes that run side by side.
        context : str, optional
            ``"oldest-32"`` keeps the first 32 rows of an episode and stays as it is afterwards (what the released h
            policies were trained with), ``"newest-32"`` the last 32; ``"carried-state"`` is the modular LSTM that
            runs on for ever. Left out: what the released model of this kind was used with.
        noise : Noise, optional
            Dropout, sampled z and random initial state, drawn anew for the whole window at every step, as the
            authors' software does.

        Raises
        ------
        ConfigError
            If this kind of model has no such context.
        """
        context = self.default_context if context is None else context
        if context not in CONTEXT_RULES or (context == "carried-state") != (self.default_context == "carried-state"):
            raise ConfigError(
                f"context is {context!r}, expected {self._contexts()} for a {self.config.kind} world model."
            )
        if context == "carried-state" or (context == "oldest-32" and noise is None):
            return self.incremental(batch_size)
        return WindowStream(self, batch_size, newest=context == "newest-32", noise=noise)

    def _contexts(self) -> str:
        return "'carried-state'" if self.default_context == "carried-state" else "'oldest-32' or 'newest-32'"

    @abstractmethod
    def incremental(self, batch_size: int) -> Stream:
        """Return the memory that costs one step per step, with the context of the released model."""

    def device_of(self) -> torch.device:
        """Return where the weights are."""
        return next(self.parameters()).device


class WindowStream:
    """A memory that runs over its whole window at every step: the newest 32 rows, or any context with noise.

    Parameters
    ----------
    model : WorldModel
        Whose memory runs.
    batch_size : int
        Episodes.
    newest : bool
        Keep the newest rows instead of the oldest.
    noise : Noise, optional
        Drawn anew for the whole window at every step.
    """

    def __init__(self, model: WorldModel, batch_size: int, newest: bool, noise: Noise | None) -> None:
        device = model.device_of()
        self.model, self.newest, self.noise = model, newest, noise
        self.rows = torch.zeros(batch_size, CONTEXT, 2 * model.z_size + 5, dtype=torch.float32, device=device)
        self.count = torch.zeros(batch_size, dtype=torch.long, device=device)

    def step(self, mu: Tensor, logvar: Tensor, goal: Tensor, action: Tensor) -> Tensor:
        """Feed one row per episode; see :class:`Stream`."""
        full = self.count >= CONTEXT
        if self.newest and bool(full.any()):
            self.rows[full] = self.rows[full].roll(-1, dims=1)
            self.count[full] -= 1
            full = torch.zeros_like(full)
        row = torch.cat([mu, logvar, goal, action], dim=-1)
        room = torch.nonzero(~full).squeeze(1)
        self.rows[room, self.count[room]] = row[room]
        self.count[room] += 1
        # the memories are causal, so rows beyond the longest episode so far need not be run
        rows = self.rows[:, : int(self.count.max())]
        z_size = self.model.z_size
        means, logvars, goals, actions = torch.split(rows, [z_size, z_size, 2, 3], dim=-1)
        h, _ = self.model.hidden(sample(means, logvars, self.noise), goals, actions, self.noise)
        return h[torch.arange(len(h), device=h.device), self.count - 1]

    def reset(self, mask: Tensor) -> None:
        """Forget episodes; see :class:`Stream`."""
        self.count[mask] = 0
        self.rows[mask] = 0.0

    def listens(self) -> bool:
        """Return whether h can still change; see :class:`Stream`."""
        return True
