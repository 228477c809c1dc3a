"""The joint world model: V and a two-layer LSTM, trained together.

Notes
-----
Original: ``vaelstm.py`` and ``vae1dlstm.py`` (torch).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from navrep_data.models.config import JointConfig
from navrep_data.models.noise import Noise, drop
from navrep_data.models.vae import VAE, init_linear
from navrep_data.models.world_model import CONTEXT, LSTMState, WorldModel


class JointWorldModel(WorldModel):
    """V + LSTM; h is the hidden state of the upper LSTM layer.

    Parameters
    ----------
    config : JointConfig
        Representation and sizes.

    Notes
    -----
    The goal is fed in metres. The original draws a random LSTM state for every pass, in use too; here the state
    is zero unless noise is asked for.
    """

    config: JointConfig

    def __init__(self, config: JointConfig) -> None:
        super().__init__()
        self.config = config
        n = config.z_size
        self.vae = VAE(self.vae_config())
        self.action_emb = nn.Linear(3, n)
        self.state_emb = nn.Linear(2, n)
        self.lstm = nn.LSTM(3 * n, config.h_size, config.n_layers, batch_first=True)
        self.lstm_head = nn.Linear(config.h_size, config.h_size)
        self.ln_f = nn.LayerNorm(config.h_size)
        self.z_head = nn.Linear(n, n)
        self.state_head = nn.Linear(n, 2)
        self.apply(init_linear)

    def hidden(
        self, z: Tensor, goal: Tensor, action: Tensor, noise: Noise | None = None, state: LSTMState | None = None
    ) -> tuple[Tensor, LSTMState | None]:
        """Run the LSTM over codes; see :meth:`WorldModel.hidden`."""
        x = drop(torch.cat([z, self.action_emb(action), self.state_emb(goal)], dim=-1), noise)
        if state is None and noise is not None:
            zero = x.new_zeros(self.config.n_layers, x.shape[0], self.config.h_size)
            state = (noise.normal_like(zero), noise.normal_like(zero))
        return self.lstm(x, state)  # type: ignore[no-any-return]

    def heads(self, z: Tensor, goal: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Return next z and next goal [m]; see :meth:`WorldModel.heads`."""
        x = self.ln_f(self.lstm_head(h))
        n = self.config.z_size
        next_z, next_goal = self.z_head(x[..., :n]), self.state_head(x[..., n:])
        if self.config.residual:
            return z + next_z, goal + next_goal
        return next_z, next_goal

    def incremental(self, batch_size: int) -> JointStream:
        """Return a memory that carries the LSTM's state over the first 32 rows."""
        return JointStream(self, batch_size)


class JointStream:
    """LSTM state of a batch of episodes; stays as it is after 32 rows, as the released policies know it."""

    def __init__(self, model: JointWorldModel, batch_size: int) -> None:
        config, device = model.config, model.device_of()
        self.model = model
        self.state = torch.zeros(2, config.n_layers, batch_size, config.h_size, dtype=torch.float32, device=device)
        self.count = torch.zeros(batch_size, dtype=torch.long, device=device)

    def step(self, mu: Tensor, logvar: Tensor, goal: Tensor, action: Tensor) -> Tensor:
        """Feed one row per episode; see :class:`Stream`."""
        rows = torch.nonzero(self.count < CONTEXT).squeeze(1)
        if len(rows):
            state = self.state[:, :, rows]
            _, after = self.model.hidden(
                mu[rows, None], goal[rows, None], action[rows, None], None, (state[0], state[1])
            )
            assert after is not None
            self.state[0, :, rows], self.state[1, :, rows] = after
            self.count[rows] += 1
        return self.state[0, -1].clone()

    def reset(self, mask: Tensor) -> None:
        """Forget episodes; see :class:`Stream`."""
        self.state[:, :, mask] = 0.0
        self.count[mask] = 0

    def listens(self) -> bool:
        """Return whether h can still change; see :class:`Stream`."""
        return bool((self.count < CONTEXT).any())
