"""V's encoder in 8 bits: what controllers are trained through, since encoding takes much of the time.

Notes
-----
Rings hold 0, 1/2 and 1, which 8 bits represent exactly, so only weights and the maps between layers are rounded: one
scale per output channel for weights, one per map, from observations that it is calibrated on. Ranges would be cut to
steps of 10 cm, so the first layer of the 1D encoder, a fortieth of its work, stays in float32. Features move by a
hundredth of their spread; with bfloat16 by a few thousandths. benchmarks/training.py measures the speed, on an AMD
EPYC without matrix units 1.8 (rings) and 1.4 (1D) times that of bfloat16. Processors without instructions for 8-bit
dot products get weights in 7 bits (:func:`weight_levels`), and features that move by a half more.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor, nn
from torch.nn import functional

from navrep_data.errors import ConfigError
from navrep_data.models.checkpoint import building
from navrep_data.models.vae import VAE, as_images

_CHUNK = 256
_LEVELS = 255
# even, so that 0, 1/2 and 1 are exact
_RINGS_LEVELS = 254
_WEIGHT_LEVELS = 127
# Processors without instructions for 8-bit dot products add pairs of products in 16 bits and cut what is larger;
# 2 x 255 x 64 still fits.
_NARROW_WEIGHT_LEVELS = 64
# A map's scale ignores the largest ones of this share: single outliers would cost all others resolution.
_KEPT = 0.9999
_AT_MOST = 1_000_000


def can_quantize() -> bool:
    """Tell whether this torch and processor multiply in 8 bits; the calls are not in torch's public interface."""
    try:
        return _is_exact(_NARROW_WEIGHT_LEVELS)
    except (AttributeError, RuntimeError, TypeError):
        return False


@cache
def weight_levels() -> int:
    """Return into how many steps this processor lets weights be rounded without cutting any sum."""
    return _WEIGHT_LEVELS if _is_exact(_WEIGHT_LEVELS) else _NARROW_WEIGHT_LEVELS


@building()
def _is_exact(weight_levels: int) -> bool:
    """Tell whether the largest possible sums come out right; both kinds of layer, since they take different paths."""
    right = True
    for channels in (1, 32):
        probe = nn.Conv2d(channels, 32, 4, stride=2, bias=False)
        nn.init.ones_(probe.weight)
        layer = Layer(probe, 1 / _LEVELS, None, weight_levels)
        largest = torch.full((2, channels, 8, 8), _LEVELS, dtype=torch.uint8)
        found = layer(largest.to(memory_format=torch.channels_last))
        right = right and torch.allclose(found, torch.full_like(found, channels * 16.0))
    return right


class Layer:
    """A convolution and ReLU from bytes to bytes, or to floats where `out_scale` is None."""

    def __init__(self, conv: nn.Conv2d, in_scale: float, out_scale: float | None, weight_levels: int) -> None:
        weight = conv.weight.detach()
        self.scales = weight.abs().amax((1, 2, 3)).clamp_min(1e-12) / weight_levels
        rounded = (weight / self.scales[:, None, None, None]).round().clamp(-weight_levels, weight_levels)
        self.stride = list(conv.stride)
        self.in_scale, self.out_scale = in_scale, out_scale
        self.bias = None if conv.bias is None else conv.bias.detach().clone()
        self.zeros = torch.zeros(len(weight), dtype=torch.int64)
        self.weight = torch.ops.onednn.qconv_prepack(
            rounded.to(torch.int8), self.scales, in_scale, 0, self.stride, [0, 0], [1, 1], 1, None
        )

    def __call__(self, x: Tensor) -> Tensor:
        """Return the maps (N, channels, height, width) of bytes or floats, in channels-last order."""
        last = self.out_scale is None
        return torch.ops.onednn.qconv2d_pointwise(  # type: ignore[no-any-return]
            x, self.in_scale, 0, self.weight, self.scales, self.zeros, self.bias, self.stride, [0, 0], [1, 1], 1,
            1.0 if last else self.out_scale, 0, torch.float32 if last else torch.uint8, "relu", [], "",
        )  # fmt: skip


class _FloatLayer:
    """A convolution and ReLU from floats to bytes."""

    def __init__(self, conv: nn.Conv2d, out_scale: float) -> None:
        # the scale is in the weights, and half a step in the bias: bytes are cut, not rounded
        self.weight = (conv.weight.detach() / out_scale).contiguous(memory_format=torch.channels_last)
        bias = torch.zeros(len(conv.weight), dtype=torch.float32) if conv.bias is None else conv.bias.detach()
        self.bias = bias / out_scale + 0.5
        self.stride = conv.stride

    def __call__(self, x: Tensor) -> Tensor:
        maps = functional.conv2d(x, self.weight, self.bias, self.stride)
        return _bytes(maps.clamp_(0.0, _LEVELS))


class QuantizedEncoder(nn.Module):
    """Observations to the mean of z in 8 bits, without gradients.

    Parameters
    ----------
    vae : VAE
        Whose encoder to round; copied.
    calibration : Tensor of shape (N, 64, 64) or (N, 1080)
        Observations as the encoder will see them, some hundreds; the same ones give the same encoder.

    Raises
    ------
    ConfigError
        If this torch or processor cannot multiply in 8 bits.
    """

    @building()
    def __init__(self, vae: VAE, calibration: Tensor) -> None:
        super().__init__()
        if not can_quantize():
            raise ConfigError(
                "Precision int8 needs a processor and a torch with 8-bit convolutions (oneDNN), none was found: set "
                "precision to bfloat16."
            )
        self.lidar = vae.config.lidar
        self.layers: list[Layer | _FloatLayer] = []
        x = as_images(calibration.float(), self.lidar)
        scale = 1.0 / _RINGS_LEVELS
        convolutions = [layer for layer in vae.encoder if isinstance(layer, nn.Conv2d)]
        with torch.no_grad():
            for conv in convolutions:
                x = conv(x).relu()
                out = None if conv is convolutions[-1] else _largest(x) / _LEVELS
                if self.lidar == "1d" and out is not None and not self.layers:
                    self.layers.append(_FloatLayer(conv, out))
                else:
                    self.layers.append(Layer(conv, scale, out, weight_levels()))
                scale = scale if out is None else out
            self.head = nn.Linear(vae.fc1.in_features, vae.fc1.out_features)
            self.head.load_state_dict(vae.fc1.state_dict())
        self.requires_grad_(False)
        self.eval()

    def _run(self, obs: Tensor) -> Tensor:
        x = as_images(obs, self.lidar)
        if self.lidar == "rings":
            x = _bytes(x * _RINGS_LEVELS)
        x = x.to(memory_format=torch.channels_last)
        for layer in self.layers:
            x = layer(x)
        return self.head(x.flatten(1))  # type: ignore[no-any-return]

    @torch.no_grad()
    def forward(self, obs: Tensor) -> Tensor:
        """Return the mean of z, shape (N, z_size), float32, of observations (N, 64, 64) or (N, 1080)."""
        return torch.cat([self._run(part) for part in torch.split(obs, _CHUNK)])


def _bytes(x: Tensor) -> Tensor:
    """Return x, from 0 to 255, cut to bytes: torch takes four times as long when asked for it in one step."""
    return x.to(torch.int16).to(torch.uint8)


def _largest(maps: Tensor) -> float:
    """Return the value that all but very few entries of `maps` stay below."""
    flat = maps.flatten()
    every = max(1, len(flat) // _AT_MOST)
    return max(float(torch.quantile(flat[::every], _KEPT)), 1e-6)
