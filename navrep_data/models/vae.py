"""V: the convolutional variational auto-encoder, for rings and for the scan as a line of numbers.

Notes
-----
Paper section II-B; MODEL_FACTS: original ``vae.py`` (TensorFlow) and ``gpt.py`` (torch). A scan is convolved as an
image of height 1: the same numbers as a 1-D convolution, and about twice as fast on a CPU.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from navrep_data.errors import ArrayError
from navrep_data.models.config import OBSERVATION_SHAPES, VAEConfig
from navrep_data.models.noise import Noise, sample

CHANNELS = (1, 32, 64, 128, 256)
FLAT_SIZE = 1024
"""Numbers between the convolutions and the heads: 256 channels x (2 x 2 or 1 x 4) places."""

# (kernel, stride) of each encoder and decoder layer, and the map that the decoder starts from (channels, h, w)
_ENCODER = {
    "rings": tuple(((4, 4), (2, 2)) for _ in range(4)),
    "1d": tuple(((1, k), (1, 4)) for k in (8, 9, 6, 4)),
}
_DECODER = {
    "rings": tuple(((k, k), (2, 2)) for k in (5, 5, 6, 6)),
    "1d": tuple(((1, k), (1, 4)) for k in (4, 6, 9, 8)),
}
_DECODER_START = {"rings": (1024, 1, 1), "1d": (256, 1, 4)}
_DECODER_CHANNELS = (128, 64, 32, 1)


def convolutions(lidar: str) -> nn.Sequential:
    """Return the four convolutions with ReLU that V and the end-to-end networks share (indices 0, 2, 4, 6)."""
    layers: list[nn.Module] = []
    for i, (kernel, stride) in enumerate(_ENCODER[lidar]):
        layers += [nn.Conv2d(CHANNELS[i], CHANNELS[i + 1], kernel, stride), nn.ReLU()]
    return nn.Sequential(*layers)


def _transposed(lidar: str) -> nn.Sequential:
    start = _DECODER_START[lidar]
    layers: list[nn.Module] = [nn.Unflatten(1, start)]
    n_in = start[0]
    for (kernel, stride), n_out in zip(_DECODER[lidar], _DECODER_CHANNELS, strict=True):
        layers += [nn.ConvTranspose2d(n_in, n_out, kernel, stride), nn.ReLU()]
        n_in = n_out
    layers[-1] = nn.Sigmoid()
    return nn.Sequential(*layers)


def as_images(obs: Tensor, lidar: str) -> Tensor:
    """Return observations of shape (..., 64, 64) or (..., 1080) as a batch of images (N, 1, height, width).

    Raises
    ------
    ArrayError
        If the shape does not end as the representation asks.
    """
    shape = OBSERVATION_SHAPES[lidar]
    if tuple(obs.shape[-len(shape) :]) != shape:
        raise ArrayError(
            f"obs has shape {tuple(obs.shape)}, expected (..., {', '.join(map(str, shape))}) for lidar={lidar!r}: "
            "make it with the model's observation(scan)."
        )
    height, width = shape if lidar == "rings" else (1, shape[0])
    return obs.reshape(-1, 1, height, width)


class VAE(nn.Module):
    """V: observations to codes z and back.

    Parameters
    ----------
    config : VAEConfig
        Representation and size of z.

    Notes
    -----
    Difference to the original: one layout for rings and 1D (see the module's notes); the first transposed
    convolution of rings, which blows one place up to 5 x 5, is computed as the matrix product that it is.
    """

    def __init__(self, config: VAEConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = convolutions(config.lidar)
        self.fc1 = nn.Linear(FLAT_SIZE, config.z_size)
        self.fc2 = nn.Linear(FLAT_SIZE, config.z_size)
        self.fc3 = nn.Linear(config.z_size, FLAT_SIZE)
        self.decoder = _transposed(config.lidar)

    def distribution(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and logarithm of the variance of z.

        Parameters
        ----------
        obs : Tensor of shape (..., 64, 64) or (..., 1080)
            Rings in {0, 0.5, 1} or ranges over 25 m.

        Returns
        -------
        mu, logvar : Tensor of shape (..., z_size)
        """
        x = self.encoder(as_images(obs, self.config.lidar)).flatten(1)
        lead = obs.shape[: obs.ndim - len(OBSERVATION_SHAPES[self.config.lidar])]
        return self.fc1(x).reshape(*lead, -1), self.fc2(x).reshape(*lead, -1)

    def encode(self, obs: Tensor, noise: Noise | None = None) -> Tensor:
        """Return z of shape (..., z_size): the mean, or with `noise` a sample."""
        return sample(*self.distribution(obs), noise)

    def decode(self, z: Tensor) -> Tensor:
        """Return observations of shape (..., 64, 64) or (..., 1080) in (0, 1) for codes of shape (..., z_size)."""
        return torch.sigmoid(self.decode_logits(z))

    def decode_logits(self, z: Tensor) -> Tensor:
        """Return what :meth:`decode` gives before the last sigmoid: what losses are exactly computed from."""
        x = self.fc3(z.reshape(-1, z.shape[-1]))
        if self.config.lidar == "rings":
            blow_up = self.decoder[1]
            assert isinstance(blow_up, nn.ConvTranspose2d)
            assert blow_up.bias is not None
            n_out, side = blow_up.weight.shape[1], blow_up.weight.shape[2]
            places = (x @ blow_up.weight.flatten(1)).reshape(-1, n_out, side, side)
            images = self.decoder[2:-1](places + blow_up.bias[:, None, None])
        else:
            images = self.decoder[:-1](x)
        decoded: Tensor = images.reshape(*z.shape[:-1], *OBSERVATION_SHAPES[self.config.lidar])
        return decoded

    def forward(self, obs: Tensor, noise: Noise | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the reconstruction of `obs`, mu and logvar; `noise` samples z as training does."""
        mu, logvar = self.distribution(obs)
        return self.decode(sample(mu, logvar, noise)), mu, logvar


def init_linear(module: nn.Module) -> None:
    """Initialise linear and normalisation layers as the original's torch models do (for ``Module.apply``)."""
    if isinstance(module, nn.Linear):
        nn.init.normal_(module.weight, std=0.02)
        nn.init.zeros_(module.bias)
    elif isinstance(module, nn.LayerNorm):
        nn.init.ones_(module.weight)
        nn.init.zeros_(module.bias)


def n_parameters(module: nn.Module) -> int:
    """Return the number of trainable numbers of a network."""
    return sum(math.prod(p.shape) for p in module.parameters())


def finite(module: nn.Module) -> bool:
    """Return whether all weights are finite numbers."""
    return all(bool(torch.isfinite(t).all()) for t in module.state_dict().values() if t.is_floating_point())
