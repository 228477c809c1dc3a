"""The transformer world model: V and a causal transformer, trained together.

Notes
-----
Original: ``gpt.py`` and ``gpt1d.py`` (torch, after minGPT).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from navrep_data.errors import ArrayError
from navrep_data.models.config import TransformerConfig
from navrep_data.models.noise import Noise, drop
from navrep_data.models.vae import VAE, init_linear
from navrep_data.models.world_model import LSTMState, WorldModel

# The original's stand-in for minus infinity in masked attention.
_MASKED = -1e10


class Attention(nn.Module):
    """Causal self-attention with separate key, query and value layers."""

    def __init__(self, size: int, n_heads: int) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.key = nn.Linear(size, size)
        self.query = nn.Linear(size, size)
        self.value = nn.Linear(size, size)
        self.proj = nn.Linear(size, size)

    def split(self, x: Tensor) -> Tensor:
        """Return (B, T, size) as (B, heads, T, size / heads)."""
        return x.reshape(*x.shape[:-1], self.n_heads, -1).transpose(1, 2)

    def mix(self, query: Tensor, key: Tensor, value: Tensor, hidden: Tensor, noise: Noise | None) -> Tensor:
        """Attend from queries (B, H, T, d) to keys and values (B, H, S, d), except where `hidden` is true."""
        weights = query @ key.transpose(-2, -1) * (1.0 / math.sqrt(key.shape[-1]))
        weights = drop(torch.softmax(weights.masked_fill(hidden, _MASKED), dim=-1), noise)
        return drop(self.proj((weights @ value).transpose(1, 2).flatten(2)), noise)

    def forward(self, x: Tensor, hidden: Tensor, noise: Noise | None) -> Tensor:
        """Return the attention's output of shape (B, T, size)."""
        query, key, value = (self.split(layer(x)) for layer in (self.query, self.key, self.value))
        return self.mix(query, key, value, hidden, noise)


class Block(nn.Module):
    """Attention and a two-layer perceptron, each after a normalisation and added to its input."""

    def __init__(self, size: int, n_heads: int) -> None:
        super().__init__()
        self.ln1 = nn.LayerNorm(size)
        self.ln2 = nn.LayerNorm(size)
        self.attn = Attention(size, n_heads)
        self.mlp = nn.Sequential(nn.Linear(size, 4 * size), nn.GELU(), nn.Linear(4 * size, size))

    def forward(self, x: Tensor, hidden: Tensor, noise: Noise | None) -> Tensor:
        """Return the block's output of shape (B, T, size)."""
        x = x + self.attn(self.ln1(x), hidden, noise)
        out: Tensor = x + drop(self.mlp(self.ln2(x)), noise)
        return out

    def step(self, x: Tensor, keys: Tensor, values: Tensor, at: Tensor, hidden: Tensor) -> Tensor:
        """Run one token per episode.

        Parameters
        ----------
        x : Tensor of shape (B, 1, size)
            The token.
        keys, values : Tensor of shape (B, H, S, d)
            What earlier tokens left; the token's own are written at place `at`.
        at : Tensor of shape (B,), int64
            Place of the token in its episode.
        hidden : Tensor of shape (B, 1, 1, S), bool
            True at the places after `at`.
        """
        normed, episodes = self.ln1(x), torch.arange(len(x), device=x.device)
        keys[episodes, :, at] = self.attn.split(self.attn.key(normed))[:, :, 0]
        values[episodes, :, at] = self.attn.split(self.attn.value(normed))[:, :, 0]
        x = x + self.attn.mix(self.attn.split(self.attn.query(normed)), keys, values, hidden, None)
        out: Tensor = x + self.mlp(self.ln2(x))
        return out


class TransformerWorldModel(WorldModel):
    """V + transformer; h is the last layer's output after its normalisation.

    Parameters
    ----------
    config : TransformerConfig
        Representation and sizes.

    Notes
    -----
    A token is the *sum* of z, a learned position and linear images of the action and of the goal in metres.
    Difference to the original's files: the causal masks are computed, not stored.
    """

    config: TransformerConfig

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        self.config = config
        n = config.z_size
        self.pos_emb = nn.Parameter(torch.zeros(1, config.context, n, dtype=torch.float32))
        self.vae = VAE(self.vae_config())
        self.action_emb = nn.Linear(3, n)
        self.state_emb = nn.Linear(2, n)
        self.blocks = nn.ModuleList(Block(n, config.n_heads) for _ in range(config.n_blocks))
        self.ln_f = nn.LayerNorm(n)
        self.z_head = nn.Linear(n, n)
        self.state_head = nn.Linear(n, 2)
        self.apply(init_linear)

    def hidden(
        self, z: Tensor, goal: Tensor, action: Tensor, noise: Noise | None = None, state: LSTMState | None = None
    ) -> tuple[Tensor, LSTMState | None]:
        """Run the transformer over codes; see :meth:`WorldModel.hidden`.

        Raises
        ------
        ArrayError
            If the sequences are longer than the model's context.
        """
        length = z.shape[1]
        if length > self.config.context:
            raise ArrayError(
                f"The sequences have {length} rows, expected at most {self.config.context}: cut them into windows."
            )
        x = z + self.pos_emb[:, :length] + self.action_emb(action) + self.state_emb(goal)
        x = drop(x, noise)
        later = torch.ones(length, length, dtype=torch.bool, device=z.device).triu(1)
        for block in self.blocks:
            x = block(x, later, noise)
        h: Tensor = self.ln_f(x)
        return h, None

    def heads(self, z: Tensor, goal: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Return next z and next goal [m]; see :meth:`WorldModel.heads`."""
        next_z, next_goal = self.z_head(h), self.state_head(h)
        if self.config.residual:
            return z + next_z, goal + next_goal
        return next_z, next_goal

    def incremental(self, batch_size: int) -> TransformerStream:
        """Return a memory that keeps keys and values of the rows so far."""
        return TransformerStream(self, batch_size)


class TransformerStream:
    """Keys and values of a batch of episodes; full after 32 rows, and h then stays as it is."""

    def __init__(self, model: TransformerWorldModel, batch_size: int) -> None:
        c, device = model.config, model.device_of()
        shape = (2, c.n_blocks, batch_size, c.n_heads, c.context, c.z_size // c.n_heads)
        self.model = model
        self.cache = torch.zeros(shape, dtype=torch.float32, device=device)
        self.count = torch.zeros(batch_size, dtype=torch.long, device=device)
        self.h = torch.zeros(batch_size, c.z_size, dtype=torch.float32, device=device)

    def step(self, mu: Tensor, logvar: Tensor, goal: Tensor, action: Tensor) -> Tensor:
        """Feed one row per episode; see :class:`Stream`."""
        model = self.model
        rows = torch.nonzero(self.count < model.config.context).squeeze(1)
        if len(rows) == 0:
            return self.h.clone()
        at = self.count[rows]
        places = int(at.max()) + 1
        # usually all episodes are at work, and the cache is then used in place
        all_at_work = len(rows) == len(self.count)
        cache = self.cache[..., :places, :] if all_at_work else self.cache[:, :, rows, :, :places]
        later = (torch.arange(places, device=at.device) > at[:, None])[:, None, None, :]
        x = mu[rows] + model.pos_emb[0, at] + model.action_emb(action[rows]) + model.state_emb(goal[rows])
        x = x[:, None]
        for i, block in enumerate(model.blocks):
            assert isinstance(block, Block)
            x = block.step(x, cache[0, i], cache[1, i], at, later)
        if not all_at_work:
            self.cache[:, :, rows, :, :places] = cache
        self.h[rows] = model.ln_f(x[:, 0])
        self.count[rows] += 1
        return self.h.clone()

    def reset(self, mask: Tensor) -> None:
        """Forget episodes; see :class:`Stream`."""
        self.count[mask] = 0
        self.h[mask] = 0.0

    def listens(self) -> bool:
        """Return whether h can still change; see :class:`Stream`."""
        return bool((self.count < self.model.config.context).any())
