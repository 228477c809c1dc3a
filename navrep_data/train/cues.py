"""What a driver needs to see, asked of z by a linear head during training: how far all is, and where people are.

Notes
-----
Reconstruction hardly cares about a leg of 3 cm, a controller does: seen through a z trained on reconstruction alone it
learned to avoid obstacles, and went on colliding with people. The head is thrown away after training; it is linear, so
that what it finds is easy to find for controllers too. Ranges come from the observation itself, people from the
dataset's `humans` column. docs/training.md says what it brings.
"""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor, nn

from navrep_data.observations.rings import RING_EDGES
from navrep_data.schema import RANGE_MAX
from navrep_data.train.recipe import Recipe

N_RANGES = {"rings": 64, "1d": 60}
N_PEOPLE = 32
# Nearness 1 / (this + metres): what is near counts, what is far hardly.
_OFFSET = 0.5
# Typical means and spreads of both, so that both are learned at the same pace.
_RANGES = (0.25, 0.2)
_PEOPLE = (0.0, 0.15)
_OCCUPIED = 0.75


class Cues(nn.Linear):
    """From z to nearness per section of the scan, then of people per sector around the robot.

    Parameters
    ----------
    z_size : int
        Numbers of z.
    lidar : str
        ``"rings"`` or ``"1d"``.
    """

    def __init__(self, z_size: int, lidar: str) -> None:
        super().__init__(z_size, N_RANGES[lidar] + N_PEOPLE)
        # no draws: a training follows from its seed alone
        nn.init.zeros_(self.weight)
        nn.init.zeros_(self.bias)
        self.lidar = lidar

    def errors(self, mu: Tensor, obs: Tensor, humans: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return mean squared errors per row (N,) of ranges and people, as shares of their typical variances.

        Parameters
        ----------
        mu : Tensor of shape (N, Z)
            Means of z.
        obs : Tensor of shape (N, 64, 64) or (N, 1080)
            What they are codes of.
        humans : Tensor of shape (N, H, 6) or None
            As the dataset has them; None = people are not asked for.
        """
        found = self(mu)
        n = N_RANGES[self.lidar]
        ranges = (found[:, :n] - (range_nearness(obs, self.lidar) - _RANGES[0]) / _RANGES[1]).square().mean(1)
        if humans is None:
            return ranges, torch.zeros_like(ranges)
        wanted = (people_nearness(humans) - _PEOPLE[0]) / _PEOPLE[1]
        return ranges, (found[:, n:] - wanted).square().mean(1)


def wanted(recipe: Recipe) -> bool:
    """Tell whether a recipe asks for cues."""
    return recipe.model != "m" and (recipe.ranges_weight > 0.0 or recipe.people_weight > 0.0)


@cache
def _cell_nearness() -> Tensor:
    """Return the nearness (64,) of each ring's cells."""
    return 1.0 / (_OFFSET + torch.from_numpy(RING_EDGES[:-1].copy()))


def range_nearness(obs: Tensor, lidar: str) -> Tensor:
    """Return 1 / (0.5 m + range) of the nearest hit per section (N, 64 or 60)."""
    if lidar == "1d":
        metres = RANGE_MAX * obs.reshape(len(obs), N_RANGES["1d"], -1).amin(2)
        return 1.0 / (_OFFSET + metres)
    nearness = _cell_nearness().to(obs.device)
    return torch.where(obs > _OCCUPIED, nearness, nearness.new_tensor(1.0 / (_OFFSET + RANGE_MAX))).amax(2)


def people_nearness(humans: Tensor) -> Tensor:
    """Return 1 / (0.5 m + distance) of the nearest visible human per sector (N, 32), fading to 0 over a sector.

    Parameters
    ----------
    humans : Tensor of shape (N, H, 6)
        Rows of (x, y, vx, vy, radius, visible), robot frame, NaN-padded.
    """
    x, y, visible = humans[..., 0], humans[..., 1], humans[..., 5]
    there = torch.isfinite(x) & (visible > 0.0)
    x, y = torch.where(there, x, 1.0), torch.where(there, y, 0.0)
    nearness = torch.where(there, 1.0 / (_OFFSET + torch.hypot(x, y)), 0.0)
    sector = torch.atan2(y, x) * (N_PEOPLE / (2.0 * math.pi))
    off = sector[..., None] - torch.arange(N_PEOPLE, device=humans.device)
    off = (off + N_PEOPLE / 2).remainder(N_PEOPLE) - N_PEOPLE / 2
    return (nearness[..., None] * (1.0 - off.abs()).clamp_min(0.0)).amax(1)
