"""The modular world model: V, then M, an LSTM with a mixture of normal distributions on top.

Notes
-----
Paper section II-C; original: ``rnn.py`` (TensorFlow, after World Models).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from navrep_data.errors import ConfigError
from navrep_data.models.config import MemoryConfig, ModularConfig
from navrep_data.models.noise import Noise
from navrep_data.models.vae import VAE
from navrep_data.models.world_model import LSTMState, WorldModel
from navrep_data.schema import ACTION_SIZE, RANGE_MAX

GOAL_SIZE = 2
FORGET_BIAS = 1.0
"""Added to the forget gate by the original at run time; part of the bias here."""


@dataclass
class Mixture:
    """Distribution over the change of z and goal until the next row.

    Attributes
    ----------
    logmix, mean, logstd : Tensor of shape (..., Z + 2, K)
        Logarithms of the components' weights (normalised), their means and logarithms of their widths. The last two
        dimensions are goal x, y over 25 m.
    restart_logit : Tensor of shape (...)
        Logit of the next row starting an episode.
    """

    logmix: Tensor
    mean: Tensor
    logstd: Tensor
    restart_logit: Tensor

    def likeliest(self) -> Tensor:
        """Return the mean of each dimension's heaviest component, shape (..., Z + 2)."""
        return self.mean.gather(-1, self.logmix.argmax(-1, keepdim=True)).squeeze(-1)

    def expected(self) -> Tensor:
        """Return the mean of each dimension's mixture, shape (..., Z + 2): what a squared error is least for."""
        return (torch.exp(self.logmix) * self.mean).sum(-1)


class MDNRNN(nn.Module):
    """M: one LSTM layer and a linear layer that parametrises the mixture.

    Parameters
    ----------
    config : MemoryConfig
        Sizes.

    Notes
    -----
    The LSTM has a single bias per gate, as TensorFlow's: it is the last column of ``weight_ih_l0``, fed a constant 1.
    The file's gates i, j, f, o are stored in torch's order i, f, g, o.
    """

    def __init__(self, config: MemoryConfig) -> None:
        super().__init__()
        self.config = config
        self.n_predicted = config.z_size + GOAL_SIZE
        self.n_inputs = self.n_predicted + ACTION_SIZE + 1
        self.lstm = nn.LSTM(self.n_inputs + 1, config.h_size, bias=False, batch_first=True)
        self.output = nn.Linear(config.h_size, self.n_predicted * 3 * config.n_mixture + 1)
        with torch.no_grad():
            biases = self.lstm.get_parameter("weight_ih_l0")[:, -1]
            biases.zero_()
            biases[config.h_size : 2 * config.h_size] = FORGET_BIAS

    def inputs(self, z: Tensor, goal: Tensor, action: Tensor, restart: Tensor | None = None) -> Tensor:
        """Return what the LSTM takes, shape (..., n_inputs + 1).

        Parameters
        ----------
        z, goal, action : Tensor of shape (..., Z), (..., 2) [m], (..., 3)
            As everywhere; the goal is divided by 25 m here.
        restart : Tensor of shape (...), optional
            1 on the first row of an episode; 0 if left out, as in use.
        """
        flag = z.new_zeros(*z.shape[:-1], 1) if restart is None else restart[..., None].to(z.dtype)
        return torch.cat([z, goal / RANGE_MAX, action, flag, torch.ones_like(flag)], dim=-1)

    def hidden(self, inputs: Tensor, state: LSTMState | None = None) -> tuple[Tensor, LSTMState]:
        """Run the LSTM over inputs of shape (B, T, n_inputs + 1); returns h (B, T, H) and the state."""
        return self.lstm(inputs, state)  # type: ignore[no-any-return]

    def mixture(self, h: Tensor) -> Mixture:
        """Return the mixture that the memory `h` of shape (..., H) predicts."""
        out = self.output(h)
        k = self.config.n_mixture
        logmix, mean, logstd = out[..., 1:].reshape(*out.shape[:-1], self.n_predicted, 3, k).unbind(-2)
        return Mixture(torch.log_softmax(logmix, dim=-1), mean, logstd, out[..., 0])

    def forward(
        self, z: Tensor, goal: Tensor, action: Tensor, state: LSTMState | None = None
    ) -> tuple[Mixture, Tensor, LSTMState]:
        """Return mixture, h and state for sequences of codes (B, T, Z)."""
        h, state = self.hidden(self.inputs(z, goal, action), state)
        return self.mixture(h), h, state


class ModularWorldModel(WorldModel):
    """V and M together; h is M's hidden state (the cell's output, 512 numbers).

    Parameters
    ----------
    config : ModularConfig
        Representation and sizes.
    vae, memory : VAE, MDNRNN, optional
        The halves; new ones if left out.

    Notes
    -----
    The prediction is z plus the mean of the mixture, since M models the *change* of z. (The original's world-model
    error took the mean of the likeliest component, for z itself.)
    """

    config: ModularConfig
    default_context = "carried-state"

    def __init__(self, config: ModularConfig, vae: VAE | None = None, memory: MDNRNN | None = None) -> None:
        super().__init__()
        self.config = config
        wanted = MemoryConfig(config.z_size, config.h_size, config.n_mixture, config.action_alignment)
        self.vae = VAE(self.vae_config()) if vae is None else vae
        self.memory = MDNRNN(wanted) if memory is None else memory
        if self.vae.config != self.vae_config() or self.memory.config != wanted:
            raise ConfigError(
                f"V is {self.vae.config} and M is {self.memory.config}, expected both to fit {config}: take the V and "
                "M that belong together."
            )

    @classmethod
    def of(cls, vae: VAE, memory: MDNRNN) -> ModularWorldModel:
        """Join a V and an M that share their size of z."""
        m = memory.config
        config = ModularConfig(vae.config.lidar, m.z_size, m.h_size, m.n_mixture, m.action_alignment)
        return cls(config, vae, memory)

    def hidden(
        self, z: Tensor, goal: Tensor, action: Tensor, noise: Noise | None = None, state: LSTMState | None = None
    ) -> tuple[Tensor, LSTMState | None]:
        """Run M over codes; see :meth:`WorldModel.hidden`. M has no noise of its own."""
        return self.memory.hidden(self.memory.inputs(z, goal, action), state)

    def heads(self, z: Tensor, goal: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Return next z and next goal [m]; see :meth:`WorldModel.heads`."""
        change = self.memory.mixture(h).expected()
        return z + change[..., : self.config.z_size], goal + change[..., self.config.z_size :] * RANGE_MAX

    def incremental(self, batch_size: int) -> ModularStream:
        """Return a memory that carries the LSTM's state without end."""
        return ModularStream(self, batch_size)


class ModularStream:
    """LSTM state of a batch of episodes."""

    def __init__(self, model: ModularWorldModel, batch_size: int) -> None:
        self.model = model
        self.state = torch.zeros(2, 1, batch_size, model.config.h_size, dtype=torch.float32, device=model.device_of())

    def step(self, mu: Tensor, logvar: Tensor, goal: Tensor, action: Tensor) -> Tensor:
        """Feed one row per episode; see :class:`Stream`."""
        _, after = self.model.hidden(mu[:, None], goal[:, None], action[:, None], None, (self.state[0], self.state[1]))
        assert after is not None
        self.state = torch.stack(after)
        return self.state[0, 0].clone()

    def reset(self, mask: Tensor) -> None:
        """Forget episodes; see :class:`Stream`."""
        self.state[:, :, mask] = 0.0

    def listens(self) -> bool:
        """Return whether h can still change; see :class:`Stream`."""
        return True
