"""Slow, plain float64 forward passes of the networks, straight from the files' own layouts, and the made-up weights
of ``golden/synthetic_*``. Nothing here uses the package."""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

KERNELS_1D, KERNELS_1D_BACK = (8, 9, 6, 4), (4, 6, 9, 8)


def zip_arrays(path: Path) -> dict[str, Array]:
    """Parameters of a stable-baselines 2 zip by their short names, float64."""
    with zipfile.ZipFile(path) as archive, np.load(io.BytesIO(archive.read("parameters"))) as npz:
        return {k.removeprefix("model/").removesuffix(":0"): npz[k].astype(np.float64) for k in npz.files}


def convolve(x: Array, kernel: Array, bias: Array, stride: int) -> Array:
    """Valid convolution, channels last, by a loop over places: (H, W, in) or (L, in)."""
    size = kernel.shape[0]
    n = (x.shape[0] - size) // stride + 1
    if kernel.ndim == 3:
        return np.stack([np.tensordot(x[i * stride : i * stride + size], kernel, 2) for i in range(n)]) + bias
    out = np.empty((n, n, kernel.shape[-1]))
    for i in range(n):
        for j in range(n):
            patch = x[i * stride : i * stride + size, j * stride : j * stride + size]
            out[i, j] = np.tensordot(patch, kernel, 3)
    return out + bias


def zip_forward(arrays: dict[str, Array], inputs: Array) -> tuple[Array, Array]:
    """Mean (2,) and value of one row of inputs."""
    if "enc_conv1/kernel" not in arrays:
        pi = vf = np.asarray(inputs, np.float64)
        for layer in ("fc0", "fc1"):
            pi = np.tanh(pi @ arrays[f"pi_{layer}/w"] + arrays[f"pi_{layer}/b"])
            vf = np.tanh(vf @ arrays[f"vf_{layer}/w"] + arrays[f"vf_{layer}/b"])
        return pi @ arrays["pi/w"] + arrays["pi/b"], (vf @ arrays["vf/w"] + arrays["vf/b"])[0]
    rings = arrays["enc_conv1/kernel"].ndim == 4
    x = np.asarray(inputs[:-5], np.float64)
    x = x.reshape(64, 64, 1) if rings else x[:, None]
    for i in range(1, 5):
        x = np.maximum(convolve(x, arrays[f"enc_conv{i}/kernel"], arrays[f"enc_conv{i}/bias"], 2 if rings else 4), 0)
    x = x.reshape(-1) @ arrays["enc_fc_mu/kernel"] + arrays["enc_fc_mu/bias"]
    pi = vf = np.concatenate([x, inputs[-5:]])
    for layer in ("fc0", "fc1"):
        pi = np.maximum(pi @ arrays[f"pi_{layer}/kernel"] + arrays[f"pi_{layer}/bias"], 0)
        vf = np.maximum(vf @ arrays[f"vf_{layer}/kernel"] + arrays[f"vf_{layer}/bias"], 0)
    return pi @ arrays["pi/w"] + arrays["pi/b"], (vf @ arrays["vf/kernel"] + arrays["vf/bias"])[0]


# --- the recipe of golden/README.md -----------------------------------------------------------------------------


def tf_shapes(kind: str) -> list[tuple[int, ...]]:
    """Shapes of a V or M file's arrays, typed from MODEL_FACTS 2 and 3."""
    if kind == "memory":
        return [(550, 2048), (2048,), (512, 511), (511,)]
    convs: list[tuple[int, ...]] = []
    channels = (1, 32, 64, 128, 256)
    for i in range(4):
        kernel = (4, 4) if kind == "vae_rings" else (KERNELS_1D[i],)
        convs += [(*kernel, channels[i], channels[i + 1]), (channels[i + 1],)]
    heads: list[tuple[int, ...]] = [(1024, 32), (32,), (1024, 32), (32,), (32, 1024), (1024,)]
    ins = (1024 if kind == "vae_rings" else 256, 128, 64, 32)
    back: list[tuple[int, ...]] = []
    for i, n_out in enumerate((128, 64, 32, 1)):
        kernel = ((5, 5), (5, 5), (6, 6), (6, 6))[i] if kind == "vae_rings" else (KERNELS_1D_BACK[i], 1)
        back += [(*kernel, n_out, ins[i]), (n_out,)]
    return convs + heads + back


def synthetic_integers(golden: Any, kind: str) -> list[Array]:
    """Integer arrays of a made-up V or M, checked against the sums in the golden file."""
    seed, largest = int(golden["weight_seed"]), golden["weight_maxabs"]
    arrays = []
    for i, shape in enumerate(tf_shapes(kind)):
        a = int(largest[i])
        arrays.append(np.random.RandomState(seed + i).randint(-a, a + 1, size=shape))
    assert [int(a.reshape(-1)[0]) for a in arrays] == golden["var_first_values"].tolist()
    assert [int(a.sum()) for a in arrays] == golden["var_sums"].tolist()
    return arrays


def write_integers(arrays: list[Array], path: Path) -> Path:
    """Write a V or M file as the original does, one number per line."""
    path.write_text(json.dumps([a.tolist() for a in arrays], indent=0))
    return path


def torch_shapes(kind: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the state dicts for rings, in file order, typed from MODEL_FACTS' appendix A."""
    z = 64 if kind == "gpt" else 32
    vae: dict[str, tuple[int, ...]] = {}
    channels = (1, 32, 64, 128, 256)
    for i in range(4):
        vae[f"convVAE.encoder.{2 * i}.weight"] = (channels[i + 1], channels[i], 4, 4)
        vae[f"convVAE.encoder.{2 * i}.bias"] = (channels[i + 1],)
    for name, shape in (("fc1", (z, 1024)), ("fc2", (z, 1024)), ("fc3", (1024, z))):
        vae[f"convVAE.{name}.weight"], vae[f"convVAE.{name}.bias"] = shape, shape[:1]
    for i, (n_in, n_out, k) in enumerate(((1024, 128, 5), (128, 64, 5), (64, 32, 6), (32, 1, 6))):
        vae[f"convVAE.decoder.{2 * i + 1}.weight"] = (n_in, n_out, k, k)
        vae[f"convVAE.decoder.{2 * i + 1}.bias"] = (n_out,)

    def linear(name: str, n_out: int, n_in: int) -> dict[str, tuple[int, ...]]:
        return {f"{name}.weight": (n_out, n_in), f"{name}.bias": (n_out,)}

    shapes = vae | linear("action_emb", z, 3) | linear("state_emb", z, 2)
    if kind == "gpt":
        shapes = {"pos_emb": (1, 32, 64), **shapes}
        for i in range(8):
            b = f"blocks.{i}"
            for norm in ("ln1", "ln2"):
                shapes |= {f"{b}.{norm}.weight": (64,), f"{b}.{norm}.bias": (64,)}
            shapes[f"{b}.attn.mask"] = (1, 1, 32, 32)
            for part in ("key", "query", "value", "proj"):
                shapes |= linear(f"{b}.attn.{part}", 64, 64)
            shapes |= linear(f"{b}.mlp.0", 256, 64) | linear(f"{b}.mlp.2", 64, 256)
        last = {"ln_f.weight": (64,), "ln_f.bias": (64,)}
        return shapes | last | linear("z_head", 64, 64) | linear("state_head", 2, 64)
    for layer, n_in in (("l0", 96), ("l1", 64)):
        shapes |= {f"lstm.weight_ih_{layer}": (256, n_in), f"lstm.weight_hh_{layer}": (256, 64)}
        shapes |= {f"lstm.bias_ih_{layer}": (256,), f"lstm.bias_hh_{layer}": (256,)}
    shapes |= linear("lstm_head", 64, 64) | {"ln_f.weight": (64,), "ln_f.bias": (64,)}
    return shapes | linear("z_head", 32, 32) | linear("state_head", 2, 32)


def synthetic_state(golden: Any, kind: str) -> dict[str, Array]:
    """Weights of a made-up joint or transformer model, checked against the sums in the golden file."""
    seed = int(golden["weight_seed"])
    state: dict[str, Array] = {}
    for i, (name, shape) in enumerate(torch_shapes(kind).items()):
        r = np.random.RandomState(seed + i)
        if name.endswith("mask"):
            value = np.tril(np.ones((32, 32))).reshape(shape)
        elif "ln" in name and name.endswith("weight"):
            value = 1 + r.uniform(-0.2, 0.2, shape)
        elif len(shape) == 1 or name == "pos_emb":
            value = r.uniform(-0.1, 0.1, shape)
        else:
            fan: float = math.prod(shape[1:])
            if "decoder" in name:
                fan = shape[0] * math.prod(shape[2:]) / 4
            value = r.uniform(-1, 1, shape) * math.sqrt((6 if "coder" in name else 3) / fan)
        state[name] = value.astype(np.float32)
    assert list(state) == golden["keys"].tolist()
    sums = np.array([v.astype(np.float64).sum() for v in state.values()])
    np.testing.assert_allclose(sums, golden["key_sum"], rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose([v.reshape(-1)[0] for v in state.values()], golden["key_first"], rtol=1e-6)
    return state
