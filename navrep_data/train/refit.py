"""A controller behind another V: its first layers are refitted to the new codes.

Notes
-----
Two V, of one lidar or of two, describe the same scans by numbers that mean different things. What one V says
is mostly a linear function of what the other says, so the first layer of a controller can be brought over by least
squares, with no step of reinforcement learning; training goes on from there.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from navrep_data.errors import CheckpointError
from navrep_data.models import VAE, Controller
from navrep_data.models.observation import observation_from_scan
from navrep_data.schema import ACTION_SIZE, ROBOT_STATE_SIZE
from navrep_data.sim import SimConfig, Simulator
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3_worlds import eyes

_WORLDS = 512
_ROUNDS, _STEPS_PER_ROUND = 20, 12
_CHUNK = 256
# Keeps directions that the new codes hardly use from being stretched; a share of their mean spread.
_RIDGE = 1e-3


def random_scans(config: SimConfig, n_worlds: int, n_rounds: int, n_steps: int) -> NDArray[np.float32]:
    """Return scans (n_rounds * n_worlds, 1080) [m] seen by robots that drive at random, always the same ones."""
    simulator = Simulator(config, n_worlds, seed=0)
    simulator.reset()
    draw = np.random.default_rng(0)
    scans = []
    for _ in range(n_rounds):
        for _ in range(n_steps):
            commands = np.zeros((n_worlds, ACTION_SIZE))
            commands[:, :2] = draw.uniform(-1.0, 1.0, (n_worlds, 2))
            _, events = simulator.step(commands)
            simulator.reset(events != 0)
        scans.append(eyes(config)(simulator.observe()[0]).copy())
    return np.concatenate(scans)


@torch.no_grad()
def codes(vae: VAE, scans: NDArray[np.float32]) -> Tensor:
    """Return the means of z, shape (N, Z), float64, of scans (N, 1080) [m]."""
    parts = (observation_from_scan(scans[i : i + _CHUNK], vae.config.lidar) for i in range(0, len(scans), _CHUNK))
    return torch.cat([vae.encode(part) for part in parts]).double()


def linear_map(new: Tensor, old: Tensor) -> tuple[Tensor, Tensor, float]:
    """Return A (O, N) and b (O,) such that `new` (R, N) @ A.T + b is about `old` (R, O), and the share explained."""
    mean_new, mean_old = new.mean(0), old.mean(0)
    x, y = new - mean_new, old - mean_old
    square = x.T @ x
    square.diagonal().add_(_RIDGE * square.diagonal().mean())
    a = torch.linalg.solve(square, x.T @ y).T
    explained = 1.0 - float((y - x @ a.T).square().sum() / y.square().sum())
    return a, mean_old - a @ mean_new, explained


@torch.no_grad()
def refit(init: Policy, vae: VAE, config: SimConfig) -> tuple[Controller, float]:
    """Return a policy's controller for the codes of another V.

    Parameters
    ----------
    init : Policy
        With features ``"z"``.
    vae : VAE
        The new V, of any lidar and size of z.
    config : SimConfig
        Worlds whose scans both V are compared on.

    Returns
    -------
    Controller
        New; `init` stays as it is.
    float
        Share of the old codes' variance that is a linear function of the new ones.

    Raises
    ------
    CheckpointError
        If the policy has other features.
    """
    if not isinstance(init, Policy):
        raise CheckpointError(f"--init is a {type(init).__name__}, expected a policy such as transformer_rings_z.v1.")
    if init.features != "z" or init.vae is None or not isinstance(init.network, Controller):
        raise CheckpointError(
            f"refit brings controllers on z to another V, --init {init.name} takes {init.features or 'observations'}: "
            "name one that ends in _z, or leave refit out."
        )
    scans = random_scans(config, _WORLDS, _ROUNDS, _STEPS_PER_ROUND)
    a, b, explained = linear_map(codes(vae, scans), codes(init.vae, scans))
    z_old, z_new = a.shape
    other = init.network
    network = Controller(dataclasses.replace(other.config, n_inputs=z_new + ROBOT_STATE_SIZE))
    drawn = network.state_dict()
    network.load_state_dict({k: v if v.shape == drawn[k].shape else drawn[k] for k, v in other.state_dict().items()})
    for mine, theirs in ((network.pi, other.pi), (network.vf, other.vf)):
        first, source = mine[0], theirs[0]
        assert isinstance(first, nn.Linear)
        assert isinstance(source, nn.Linear)
        weight = source.weight.double()
        first.weight.copy_(torch.cat([weight[:, :z_old] @ a, weight[:, z_old:]], 1))
        first.bias.copy_(source.bias.double() + weight[:, :z_old] @ b)
    return network, explained
