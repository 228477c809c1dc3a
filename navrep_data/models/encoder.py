"""The encoder as it is used: frozen, laid out and, on request, rounded for speed.

Notes
-----
Measured on one core of an AMD EPYC with AVX-512 bf16 (benchmarks/zoo.py; samples per second of the convolutions):
rings 1.5k as written, 3k channels last, 6k channels last in bf16; 1D as an image of height 1: 6k, 17k, 32k. Convolution
and ReLU in one oneDNN call bring another 5 %; weights laid out beforehand brought 3 % more, and were not worth it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor, nn

from navrep_data.errors import ConfigError
from navrep_data.models.config import OBSERVATION_SHAPES
from navrep_data.models.vae import VAE, as_images

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
# Measured best of 16 to 256; larger ones fall out of the cache.
_CHUNK = 256


class FrozenEncoder(nn.Module):
    """Observations to the mean of z, without gradients.

    Parameters
    ----------
    encoder : nn.Sequential
        The convolutions; copied.
    head : nn.Linear
        Flattened maps to the result; copied, always float32.
    lidar : str
        ``"rings"`` or ``"1d"``.
    dtype : str
        ``"float32"`` reproduces the released features to 1e-5; ``"bfloat16"`` is about twice as fast and moves them
        by a few thousandths of their spread.
    compile : bool
        Compile with torch.compile, which needs a C++ compiler and takes seconds.

    Raises
    ------
    ConfigError
        If `dtype` is neither.
    """

    def __init__(
        self, encoder: nn.Sequential, head: nn.Linear, lidar: str, dtype: str = "float32", compile: bool = False
    ) -> None:
        super().__init__()
        if dtype not in DTYPES:
            raise ConfigError(f"dtype is {dtype!r}, expected one of: {', '.join(DTYPES)}.")
        self.lidar, self.dtype = lidar, DTYPES[dtype]
        self.encoder = copy.deepcopy(encoder).to(self.dtype, memory_format=torch.channels_last)  # type: ignore[call-overload]
        for layer in self.encoder:
            if isinstance(layer, nn.ReLU):
                layer.inplace = True
        self.head = copy.deepcopy(head)
        self.requires_grad_(False)
        self.eval()
        self._fused = not compile and self._can_fuse()
        self._run: Callable[[Tensor], Tensor] = torch.compile(self._maps) if compile else self._maps

    @classmethod
    def of(cls, vae: VAE, dtype: str = "float32", compile: bool = False) -> FrozenEncoder:
        """Return the encoder of a V; gives the mean of z."""
        return cls(vae.encoder, vae.fc1, vae.config.lidar, dtype, compile)

    def _can_fuse(self) -> bool:
        """Try whether this torch and processor have the joined call; it is not part of torch's public interface."""
        probe = as_images(torch.ones(1, *OBSERVATION_SHAPES[self.lidar], dtype=self.dtype), self.lidar)
        probe = probe.to(memory_format=torch.channels_last)
        try:
            joined = self._joined(probe)
        except (AttributeError, RuntimeError, TypeError):
            return False
        return torch.allclose(joined.float(), self.encoder(probe).float(), rtol=0.02, atol=1e-3)

    def _joined(self, x: Tensor) -> Tensor:
        """Return what the layers give, with each convolution and its ReLU in one call."""
        for conv in self.encoder[::2]:
            x = torch.ops.mkldnn._convolution_pointwise(
                x, conv.weight, conv.bias, [0, 0], list(conv.stride), [1, 1], 1, "relu", [], ""
            )
        return x

    def _maps(self, images: Tensor) -> Tensor:
        x = images.to(self.dtype, memory_format=torch.channels_last)
        x = self._joined(x) if self._fused and x.device.type == "cpu" else self.encoder(x)
        return self.head(x.flatten(1).float())  # type: ignore[no-any-return]

    @torch.no_grad()
    def forward(self, obs: Tensor) -> Tensor:
        """Return the mean of z, shape (N, z_size), float32, of observations (N, 64, 64) or (N, 1080)."""
        images = as_images(obs, self.lidar)
        if len(images) <= _CHUNK:
            return self._run(images)
        return torch.cat([self._run(part) for part in torch.split(images, _CHUNK)])
