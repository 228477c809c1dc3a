"""Reader of the released V and M: JSON lists of integers in TensorFlow's order."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from navrep_data.errors import CheckpointError, ConfigError
from navrep_data.models import checkpoint
from navrep_data.models.config import MemoryConfig, VAEConfig
from navrep_data.models.modular import FORGET_BIAS, MDNRNN
from navrep_data.models.vae import CHANNELS, FLAT_SIZE, VAE
from navrep_data.zoo.importers_bounds import HEADROOM, check_size

TF_SCALE = 10000
"""The V and M files hold integers: round(10000 * weight)."""
# "-12345", a comma and a line break, with room to spare: the released V has 5.5 bytes per number.
_BYTES_PER_NUMBER = 12
_LARGEST_INTEGER = 100_000_000

ArrayShapes = list[tuple[str, tuple[int, ...]]]
Arrays = dict[str, NDArray[np.float32]]


def vae_variables(lidar: str) -> ArrayShapes:
    """Return names and TensorFlow shapes of a V file's arrays, in its order."""
    kernels = [(4, 4)] * 4 if lidar == "rings" else [(k,) for k in (8, 9, 6, 4)]
    opposite = [(5, 5), (5, 5), (6, 6), (6, 6)] if lidar == "rings" else [(k, 1) for k in (4, 6, 9, 8)]
    start = FLAT_SIZE if lidar == "rings" else CHANNELS[4]
    shapes: ArrayShapes = []
    for i, kernel in enumerate(kernels):
        shapes += [(f"encoder.{2 * i}.weight", (*kernel, *CHANNELS[i : i + 2]))]
        shapes += [(f"encoder.{2 * i}.bias", (CHANNELS[i + 1],))]
    for name, sizes in (("fc1", (FLAT_SIZE, 32)), ("fc2", (FLAT_SIZE, 32)), ("fc3", (32, FLAT_SIZE))):
        shapes += [(f"{name}.weight", sizes), (f"{name}.bias", sizes[1:])]
    for i, (size, n_out) in enumerate(zip(opposite, (128, 64, 32, 1), strict=True)):
        n_in = (start, 128, 64, 32)[i]
        shapes += [(f"decoder.{2 * i + 1}.weight", (*size, n_out, n_in)), (f"decoder.{2 * i + 1}.bias", (n_out,))]
    return shapes


def memory_variables(config: MemoryConfig | None = None) -> ArrayShapes:
    """Return names and TensorFlow shapes of an M file's arrays, in its order."""
    c = config or MemoryConfig()
    n_in, n_out = c.z_size + 2 + 3 + 1, (c.z_size + 2) * 3 * c.n_mixture + 1
    return [
        ("kernel", (n_in + c.h_size, 4 * c.h_size)),
        ("bias", (4 * c.h_size,)),
        ("output_w", (c.h_size, n_out)),
        ("output_b", (n_out,)),
    ]


_TF_KINDS: dict[str, ArrayShapes] = {
    "vae_1d": vae_variables("1d"),
    "vae_rings": vae_variables("rings"),
    "memory": memory_variables(),
}


def load_tf_json(path: Path | str, kind: str | None) -> VAE | MDNRNN:
    """Read a released V or M: a JSON list of nested lists of integers, 10000 times the weights.

    Parameters
    ----------
    path : path-like
        ``navreptrainvae.json``, ``navreptrainvae1d.json``, ``navreptrainrnn.json`` or ``navreptrainrnn1d.json``.
    kind : str or None
        ``"vae_rings"``, ``"vae_1d"`` or ``"memory"``; None tells them apart by their shapes.

    Raises
    ------
    CheckpointError
        If the file is too large, no JSON, or not the arrays of that kind.

    Notes
    -----
    TensorFlow flattens channels-last and torch channels-first, so the dense layers beside the convolutions are
    reordered.
    """
    path = Path(path)
    if kind is not None and kind not in _TF_KINDS:
        raise ConfigError(f"kind is {kind!r}, expected one of: {', '.join(_TF_KINDS)}.")
    candidates = list(_TF_KINDS) if kind is None else [kind]
    longest = max(sum(math.prod(shape) for _, shape in _TF_KINDS[k]) for k in candidates)
    most_lists = 2 * max(sum(_n_lists(shape) for _, shape in _TF_KINDS[k]) for k in candidates)
    check_size(path, longest * _BYTES_PER_NUMBER + HEADROOM, "a V or M file")
    data = path.read_bytes()
    # Empty lists take 20 times the memory of their two characters, so they are counted before they are made. Up to
    # twice the right number may pass: a wrong shape has a better message.
    if data.count(b"[") + data.count(b"{") > most_lists or data.count(b",") > 2 * longest:
        raise CheckpointError(f"{path} holds more lists or numbers than any V or M has; it is not parsed.")
    try:
        lists = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} is not valid JSON ({error}); get it again.") from error
    if kind is None:
        kind = _guess_kind(lists, path)
    arrays = _integer_arrays(lists, _TF_KINDS[kind], path)
    if kind == "memory":
        return memory_from_tf(arrays, str(path))
    return vae_from_tf(arrays, "rings" if kind == "vae_rings" else "1d", str(path))


def _n_lists(shape: tuple[int, ...]) -> int:
    """Return how many lists an array of this shape is written as."""
    return sum(math.prod(shape[:depth]) for depth in range(len(shape)))


def _guess_kind(lists: Any, path: Path) -> str:
    if isinstance(lists, list):
        if len(lists) == len(_TF_KINDS["memory"]):
            return "memory"
        if len(lists) == len(_TF_KINDS["vae_1d"]) and isinstance(lists[0], list):
            return "vae_rings" if len(lists[0]) == 4 else "vae_1d"
    raise CheckpointError(f"{path} is no V or M file: expected a JSON list of 22 (V) or 4 (M) arrays.")


def _integer_arrays(lists: Any, shapes: ArrayShapes, path: Path) -> Arrays:
    if not isinstance(lists, list) or len(lists) != len(shapes):
        n = len(lists) if isinstance(lists, list) else 0
        raise CheckpointError(f"{path} holds {n} arrays, expected {len(shapes)}: it is another kind of model.")
    arrays: Arrays = {}
    for (name, shape), nested in zip(shapes, lists, strict=True):
        try:
            values = np.array(nested)
        except (ValueError, OverflowError) as error:
            raise CheckpointError(f"{path}: {name!r} is no regular array; expected shape {shape}.") from error
        if values.shape != shape or values.dtype.kind not in "iu":
            raise CheckpointError(
                f"{path}: {name!r} has shape {values.shape} and dtype {values.dtype}, expected {shape} and integers."
            )
        if int(np.abs(values).max()) > _LARGEST_INTEGER or int(values.min()) < -_LARGEST_INTEGER:
            raise CheckpointError(f"{path}: {name!r} holds values beyond {_LARGEST_INTEGER:,}; it is damaged.")
        arrays[name] = (values / TF_SCALE).astype(np.float32)
    return arrays


def vae_from_tf(arrays: Arrays, lidar: str, source: str) -> VAE:
    """Return the V of TensorFlow arrays by the names of :func:`vae_variables`."""
    state: dict[str, Tensor] = {}
    for name, value in arrays.items():
        if name.startswith("encoder") and value.ndim > 1:
            value = conv_from_tf(value)
        elif name.startswith("decoder") and value.ndim > 1:
            # (height, width, out, in), or along the scan (length, 1, out, in) -> (in, out, height, width)
            value = value.transpose(3, 2, 0, 1) if lidar == "rings" else value.transpose(3, 2, 1, 0)
        elif name in ("fc1.weight", "fc2.weight"):
            value = channels_first(value.T)
        elif name == "fc3.weight":
            # rings decode from one place of 1024 channels, so only the scan has places to reorder
            value = value.T if lidar == "rings" else channels_first(value).T
        elif name == "fc3.bias" and lidar == "1d":
            value = channels_first(value)
        state[name] = tensor(value)
    vae = VAE(VAEConfig(lidar, 32))
    checkpoint.put_weights(vae, state, source)
    return vae


def memory_from_tf(arrays: Arrays, source: str) -> MDNRNN:
    """Return the M of TensorFlow arrays by the names of :func:`memory_variables`."""
    config = MemoryConfig()
    n = config.h_size
    bias = arrays["bias"].copy()
    bias[2 * n : 3 * n] += np.float32(FORGET_BIAS)
    n_in = arrays["kernel"].shape[0] - n
    rows = np.concatenate([arrays["kernel"][:n_in], bias[None], arrays["kernel"][n_in:]])
    i, j, f, o = np.split(rows, 4, axis=1)
    gates = np.concatenate([i, f, j, o], axis=1).T
    state = {
        "lstm.weight_ih_l0": gates[:, : n_in + 1],
        "lstm.weight_hh_l0": gates[:, n_in + 1 :],
        "output.weight": arrays["output_w"].T,
        "output.bias": arrays["output_b"],
    }
    memory = MDNRNN(config)
    checkpoint.put_weights(memory, {name: tensor(value) for name, value in state.items()}, source)
    return memory


def conv_from_tf(kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """(height, width, in, out) or (length, in, out) -> (out, in, height, width)."""
    return (kernel if kernel.ndim == 4 else kernel[None]).transpose(3, 2, 0, 1)


def channels_first(value: NDArray[np.float32]) -> NDArray[np.float32]:
    """Reorder a last axis of 1024 from (4 places, 256 channels) to (256 channels, 4 places)."""
    places = value.reshape(*value.shape[:-1], -1, CHANNELS[4])
    return places.swapaxes(-1, -2).reshape(value.shape)


def tensor(value: NDArray[np.float32]) -> Tensor:
    """Return a contiguous float32 copy as a tensor."""
    return torch.from_numpy(np.array(value, dtype=np.float32, order="C"))
