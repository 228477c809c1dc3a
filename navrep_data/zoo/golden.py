"""What golden files are compared with, and how closely.

Notes
-----
The package holds a compact golden file for each checkpoint, ``goldens/NAME.npz``, with a few rows of what the full ones
hold under the same names; of long rows evenly spaced values (:func:`thin`). ``original`` says whether the original
software computed the outputs; otherwise this package did, on made-up inputs. A few rows do not show every weight, so
``weights`` has one sum for each tensor (:func:`weight_sums`), as this package read them when the file was written.
``tools/compact_goldens.py`` writes them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from navrep_data.schema import RINGS_SHAPE
from navrep_data.zoo.registry import Record

Output = tuple[str, float, float]
"""Name, largest absolute difference, tolerance."""

FEATURES = 1e-5
"""z, h and decoded observations."""
STEPWISE = 1e-4
"""Controller inputs from raw scans, step by step: differences add up along an episode."""
MEAN = 1e-5
"""Action means, relative to the largest: released ones are in the hundreds."""
VALUE = 1e-4
CLIPPED = 1e-3
WEIGHT_SUMS = 1e-9
"""Relative to a tensor's largest number: more than sums in another order differ, less than a step of float32."""
CONTEXT = 32
COMPACT = Path(__file__).parent / "goldens"
"""Where the compact golden files are."""
LONGEST_ROW = 64
"""Numbers that a compact golden file holds of one row of an output at most."""
FEATURE_WORDS = {"z": "V_ONLY", "h": "M_ONLY", "zh": "VM"}
"""How the authors call the features."""


def thin(rows: ArrayLike) -> NDArray[Any]:
    """Return evenly spaced values of every row, :data:`LONGEST_ROW` of them at most."""
    flat = np.asarray(rows)
    flat = flat.reshape(len(flat), -1)
    return flat[:, :: -(-flat.shape[1] // LONGEST_ROW)]


def weight_sums(module: torch.nn.Module) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a sum and the largest magnitude of each tensor, by name.

    Number i of a tensor counts 1 + cos(i) / 2 times: never less than half, and no two alike, so that the sum tells
    where a number stands.
    """
    tensors = [value for _, value in sorted(module.state_dict().items()) if value.is_floating_point()]
    flat = [tensor.detach().double().numpy().ravel() for tensor in tensors]
    longest = max(len(values) for values in flat)
    factors = 1.0 + 0.5 * np.cos(np.arange(longest))
    largest = np.array([float(np.abs(values).max(initial=0.0)) for values in flat])
    return np.array([values @ factors[: len(values)] for values in flat]), largest


def weights_output(module: torch.nn.Module, arrays: Mapping[str, NDArray[Any]]) -> Output:
    """Compare the weights that were read, each tensor's sum relative to its largest number."""
    sums, largest = weight_sums(module)
    scale = np.maximum(largest, np.finfo(np.float32).tiny)
    theirs = arrays["weights"]
    if theirs.shape != sums.shape:
        return f"weights: {len(sums)} tensors beside {theirs.size}", float("inf"), WEIGHT_SUMS
    return "weights", float(np.abs((sums - theirs) / scale).max()), WEIGHT_SUMS


def _output(name: str, ours: Any, golden: ArrayLike, tolerance: float, compact: bool = False) -> Output:
    mine = np.asarray(ours.detach() if isinstance(ours, torch.Tensor) else ours, np.float64)
    mine = thin(mine) if compact else mine
    theirs = np.asarray(golden, np.float64)
    if mine.size != theirs.size:
        return f"{name} of shape {mine.shape} beside {theirs.shape}", float("inf"), tolerance
    return name, float(np.abs(mine.reshape(theirs.shape) - theirs).max()), tolerance


def _tensor(array: NDArray[Any], *shape: int) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32).reshape(shape))


def _observations(array: NDArray[Any]) -> torch.Tensor:
    """Return 1D or rings observations as (N, 1080) or (N, 64, 64)."""
    return _tensor(array, len(array), *array.shape[1:3] if array.shape[1:3] == RINGS_SHAPE else (-1,))


@torch.no_grad()
def _actions(prefix: str, mean: Any, value: Any, arrays: Mapping[str, NDArray[Any]]) -> Iterator[Output]:
    golden = arrays[f"{prefix}action_mean"]
    mean = np.asarray(mean, np.float64)
    yield _output(f"{prefix}action_mean", mean, golden, MEAN * float(np.abs(golden).max()))
    if f"{prefix}action_clipped" in arrays:  # a compact file has no room for what follows from the mean
        yield _output(f"{prefix}action_clipped", np.clip(mean, -1, 1), arrays[f"{prefix}action_clipped"], CLIPPED)
    golden = arrays[f"{prefix}value"]
    yield _output(f"{prefix}value", value, golden, VALUE)


@torch.no_grad()
def controller_outputs(module: Any, arrays: Mapping[str, NDArray[Any]]) -> list[Output]:
    """Compare a controller or end-to-end network on its stored inputs."""
    obs = arrays["obs"]
    mean, value = module(_tensor(obs, len(obs), -1))
    found = list(_actions("", mean, value, arrays))
    if "logstd" in arrays:
        found.append(_output("logstd", module.logstd, arrays["logstd"], FEATURES))
    return found


@torch.no_grad()
def vae_outputs(vae: Any, arrays: Mapping[str, NDArray[Any]], compact: bool = False) -> list[Output]:
    """Compare encoder and decoder of a V, alone or inside a world model."""
    obs = arrays["lidar_obs" if "lidar_obs" in arrays else "rings_obs"]
    mu, logvar = vae.distribution(_observations(obs))
    largest = max(1.0, float(np.abs(arrays["logvar"]).max()))
    found = [
        _output("mu", mu, arrays["mu"], FEATURES, compact),
        _output("logvar", logvar, arrays["logvar"], FEATURES * largest, compact),
    ]
    for code, decoded in (("mu", "decode_mu"), ("z", "decode_z")):
        z = mu if code == "mu" and compact else arrays[code]
        found.append(_output(decoded, vae.decode(_codes(z)), arrays[decoded], FEATURES, compact))
    return found


def _codes(z: Any) -> torch.Tensor:
    return z if isinstance(z, torch.Tensor) else _tensor(z, len(z), -1)


@torch.no_grad()
def world_model_outputs(model: Any, arrays: Mapping[str, NDArray[Any]], compact: bool = False) -> list[Output]:
    """Compare V, memory and prediction of a world model, along the sequences that there are."""
    found = vae_outputs(model.vae, arrays, compact)
    for k in (0, 1):
        seq = f"seq{k}_"
        if f"{seq}obs" not in arrays:
            continue
        ahead = predicted(model, arrays[f"{seq}obs"], arrays[f"{seq}robotstates"], arrays[f"{seq}actions"])
        # the memories are causal: row n - 1 of one run is what the first n rows alone give
        found.append(_output(f"{seq}h_det", ahead.h[0], arrays[f"{seq}h_det"], FEATURES, compact))
        found.append(_output(f"{seq}next_obs_det", ahead.obs[0], arrays[f"{seq}next_obs_det"], FEATURES, compact))
        metres = arrays[f"{seq}next_state_det"]
        largest = max(1.0, float(np.abs(metres).max()))
        found.append(_output(f"{seq}next_state_det", ahead.goal[0], metres, FEATURES * largest, compact))
    return found


@torch.no_grad()
def predicted(model: Any, obs: NDArray[Any], robotstates: NDArray[Any], actions: NDArray[Any]) -> Any:
    """Return what a world model predicts after each of the first 32 rows of a sequence."""
    n = min(len(obs), CONTEXT)
    goal = _tensor(robotstates[:n, :2], 1, n, 2)
    return model.predict(_observations(obs[:n])[None], goal, _tensor(actions[:n], 1, n, 3))


@torch.no_grad()
def fed_controller_outputs(
    record: Record, module: Any, encoder: Mapping[str, NDArray[Any]], arrays: Mapping[str, NDArray[Any]]
) -> list[Output]:
    """Compare a controller along the sequences of an encoder file, where its own file has those."""
    word = FEATURE_WORDS[str(record.features)]
    found: list[Output] = []
    for k in (0, 1):
        prefix = f"encoder_seq{k}_"
        if f"{prefix}action_mean" in arrays:
            features = encoder[f"seq{k}_{word}"]
            mean, value = module(_tensor(features, len(features), -1))
            found += _actions(prefix, mean, value, arrays)
    return found


def policy_outputs(record: Record, policy: Any, arrays: Mapping[str, NDArray[Any]]) -> list[Output]:
    """Compare what a policy's controller is fed, step by step from raw scans."""
    word = FEATURE_WORDS[str(record.features)]
    found = []
    for k in (0, 1):
        scans, states, actions = (arrays[f"seq{k}_{name}"] for name in ("scans", "robotstates", "actions"))
        policy.reset(batch_size=1)
        fed = []
        for t in range(len(scans)):
            if t:
                policy.observe(np.asarray(actions[t : t + 1], np.float32))
            fed.append(np.asarray(policy.encode(scans[t : t + 1], np.asarray(states[t : t + 1], np.float32)))[0])
        found.append(_output(f"seq{k}_{word}", np.stack(fed), arrays[f"seq{k}_{word}"], STEPWISE))
    return found
