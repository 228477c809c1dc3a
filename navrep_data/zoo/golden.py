"""What golden files are compared with, and how closely."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

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
CONTEXT = 32
FEATURE_WORDS = {"z": "V_ONLY", "h": "M_ONLY", "zh": "VM"}
"""How the authors call the features."""


def _output(name: str, ours: Any, golden: ArrayLike, tolerance: float) -> Output:
    mine = np.asarray(ours.detach() if isinstance(ours, torch.Tensor) else ours, np.float64)
    theirs = np.asarray(golden, np.float64)
    if mine.size != theirs.size:
        return f"{name} of shape {mine.shape} beside {theirs.shape}", float("inf"), tolerance
    return name, float(np.abs(mine.reshape(theirs.shape) - theirs).max()), tolerance


def _tensor(array: NDArray[Any], *shape: int) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32).reshape(shape))


@torch.no_grad()
def _actions(prefix: str, mean: Any, value: Any, arrays: Mapping[str, NDArray[Any]]) -> Iterator[Output]:
    golden = arrays[f"{prefix}action_mean"]
    mean = np.asarray(mean, np.float64)
    yield _output(f"{prefix}action_mean", mean, golden, MEAN * float(np.abs(golden).max()))
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
def vae_outputs(vae: Any, arrays: Mapping[str, NDArray[Any]]) -> list[Output]:
    """Compare encoder and decoder of a V, alone or inside a world model, on 1D observations."""
    obs = arrays["lidar_obs"]
    mu, logvar = vae.distribution(_tensor(obs, len(obs), -1))
    found = [
        _output("mu", mu, arrays["mu"], FEATURES),
        _output("logvar", logvar, arrays["logvar"], FEATURES * max(1.0, float(np.abs(arrays["logvar"]).max()))),
    ]
    for code, decoded in (("mu", "decode_mu"), ("z", "decode_z")):
        z = arrays[code]
        found.append(_output(decoded, vae.decode(_tensor(z, len(z), -1)), arrays[decoded], FEATURES))
    return found


@torch.no_grad()
def world_model_outputs(model: Any, arrays: Mapping[str, NDArray[Any]]) -> list[Output]:
    """Compare V, memory and prediction of a joint or transformer world model."""
    found = vae_outputs(model.vae, arrays)
    for k in (0, 1):
        seq = f"seq{k}_"
        obs = _tensor(arrays[f"{seq}obs"][:CONTEXT], 1, CONTEXT, -1)
        goal = _tensor(arrays[f"{seq}robotstates"][:CONTEXT, :2], 1, CONTEXT, 2)
        action = _tensor(arrays[f"{seq}actions"][:CONTEXT], 1, CONTEXT, 3)
        ahead = model.predict(obs, goal, action)
        # the memories are causal: row n - 1 of one run is what the first n rows alone give
        found.append(_output(f"{seq}h_det", ahead.h[0], arrays[f"{seq}h_det"], FEATURES))
        found.append(_output(f"{seq}next_obs_det", ahead.obs[0], arrays[f"{seq}next_obs_det"], FEATURES))
        metres = arrays[f"{seq}next_state_det"]
        largest = max(1.0, float(np.abs(metres).max()))
        found.append(_output(f"{seq}next_state_det", ahead.goal[0], metres, FEATURES * largest))
    return found


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
