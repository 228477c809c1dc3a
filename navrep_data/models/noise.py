"""Randomness inside the networks, made explicit: what is drawn, and from which generator."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

DROPOUT = 0.1
"""Share of numbers that the original's joint and transformer models drop."""


@dataclass
class Noise:
    """Where a forward pass draws from; passing None instead makes it deterministic.

    Attributes
    ----------
    generator : torch.Generator or None
        Source of all draws; None = torch's global one (as in training).
    dropout : float
        Share of numbers set to 0; the others are scaled up by ``1 / (1 - dropout)``.

    Notes
    -----
    The released joint and transformer models were never switched to eval mode, so the memories that the released h
    and zh controllers saw in training had dropout, a sampled z and a random initial LSTM state. Passing a Noise
    brings that back, under a seed.
    """

    generator: torch.Generator | None = None
    dropout: float = DROPOUT

    @classmethod
    def seeded(cls, seed: int, device: torch.device | str = "cpu") -> Noise:
        """Return noise that draws from a generator of its own."""
        return cls(torch.Generator(device).manual_seed(seed))

    def normal_like(self, like: Tensor) -> Tensor:
        """Return standard normal numbers in the shape, dtype and on the device of `like`."""
        return torch.empty_like(like).normal_(generator=self.generator)

    def drop(self, x: Tensor) -> Tensor:
        """Return `x` with a share of its numbers dropped."""
        if self.dropout == 0.0:
            return x
        keep = 1.0 - self.dropout
        return x * torch.empty_like(x).bernoulli_(keep, generator=self.generator) / keep


def drop(x: Tensor, noise: Noise | None) -> Tensor:
    """Return `x`, with dropout if there is noise."""
    return x if noise is None else noise.drop(x)


def sample(mu: Tensor, logvar: Tensor, noise: Noise | None) -> Tensor:
    """Return `mu` without noise, else a draw from N(mu, exp(logvar))."""
    return mu if noise is None else mu + torch.exp(0.5 * logvar) * noise.normal_like(mu)
