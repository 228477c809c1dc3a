"""V's passes as training runs them: in bfloat16, channels last, around the slow spots of torch's CPU code.

Notes
-----
Same numbers as :class:`navrep_data.models.VAE` up to rounding; the tests compare values and gradients in float32.
Measured on two cores with AVX-512 bf16 (benchmarks/training.py): torch computes the gradient of a transposed
convolution's bias in a pass over its output that costs as much as a third of the whole backward pass, and the forward
pass to a single channel (32 -> 1) four times slower than the same as a plain convolution that gives the four outputs of
each 2 x 2 block as channels.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from navrep_data.models.config import OBSERVATION_SHAPES
from navrep_data.models.vae import VAE, as_images

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def distribution(vae: VAE, obs: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return mean and log-variance, float32, of observations (N, 64, 64) or (N, 1080); see :meth:`VAE.distribution`."""
    x = maps(vae.encoder, obs, vae.config.lidar, dtype)
    mu, logvar = (functional.linear(x, head.weight.to(dtype)).float() + head.bias for head in (vae.fc1, vae.fc2))
    return mu, logvar


def maps(encoder: nn.Sequential, obs: Tensor, lidar: str, dtype: torch.dtype) -> Tensor:
    """Return the flattened maps, in `dtype`, that convolutions of V or end to end make of observations."""
    x = as_images(obs, lidar).to(dtype, memory_format=torch.channels_last)
    for layer in encoder:
        if isinstance(layer, nn.Conv2d):
            x = functional.conv2d(x, layer.weight.to(dtype), None, layer.stride)
            x = torch.relu_(_add_bias(x, layer.bias, dtype))
    return x.flatten(1)


def decode_logits(vae: VAE, z: Tensor, dtype: torch.dtype) -> Tensor:
    """Return observations before the last sigmoid, float32, of codes (N, Z); see :meth:`VAE.decode_logits`."""
    lidar = vae.config.lidar
    x = functional.linear(z.to(dtype), vae.fc3.weight.to(dtype), vae.fc3.bias.to(dtype))
    layers = [layer for layer in vae.decoder if isinstance(layer, nn.ConvTranspose2d)]
    if lidar == "rings":
        # one place blown up to 5 x 5: a matrix product
        first = layers.pop(0)
        n_out, side = first.weight.shape[1], first.weight.shape[2]
        x = (x @ first.weight.flatten(1).to(dtype)).reshape(-1, n_out, side, side)
        x = x.contiguous(memory_format=torch.channels_last)
        x = torch.relu_(_add_bias(x, first.bias, dtype))
    else:
        x = vae.decoder[0](x).contiguous(memory_format=torch.channels_last)
    for layer in layers:
        weight = layer.weight.to(dtype)
        if lidar == "rings" and layer is layers[-1]:
            x = _ToOneChannel.apply(x, weight)  # type: ignore[no-untyped-call]
        else:
            x = functional.conv_transpose2d(x, weight, None, layer.stride)
        x = _add_bias(x, layer.bias, dtype)
        if layer is not layers[-1]:
            x = torch.relu_(x)
    return x.reshape(-1, *OBSERVATION_SHAPES[lidar]).float()


def _add_bias(x: Tensor, bias: Tensor | None, dtype: torch.dtype) -> Tensor:
    assert bias is not None
    return x.add_(bias.to(dtype)[:, None, None])


class _ToOneChannel(torch.autograd.Function):
    """Transposed convolution, kernel 6, stride 2, as a plain one with kernel 3 whose channels are the four phases.

    Output place 2 a + p gathers the inputs a - t with the weights of tap 2 t + p, t = 0, 1, 2, on each axis.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        """Return (N, out, 2 h + 4, 2 w + 4) of x (N, in, h, w) and weight (in, out, 6, 6)."""
        ctx.save_for_backward(x, weight)
        n_in, n_out = weight.shape[:2]
        taps = weight.reshape(n_in, n_out, 3, 2, 3, 2).flip(2, 4)
        kernel = taps.permute(1, 3, 5, 0, 2, 4).reshape(n_out * 4, n_in, 3, 3)
        phases = functional.conv2d(x, kernel.contiguous(memory_format=torch.channels_last), None, padding=2)
        return functional.pixel_shuffle(phases, 2)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Return torch's own gradients of the transposed convolution."""
        x, weight = ctx.saved_tensors
        mask = [ctx.needs_input_grad[0], ctx.needs_input_grad[1], False]
        grad_x, grad_weight, _ = torch.ops.aten.convolution_backward(
            grads[0].contiguous(memory_format=torch.channels_last), x, weight, None, [2, 2], [0, 0], [1, 1], True,
            [0, 0], 1, mask,
        )  # fmt: skip
        return grad_x, grad_weight
