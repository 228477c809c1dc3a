"""Checkpoints of a training: weights, optimiser and position, from which it goes on to the same losses.

Notes
-----
Layout of an output folder::

    recipe.json                     settings, data and version: what a resume must agree with
    progress.json                   which folders below are the last and the best; written last, atomically
    checkpoints/step-00001000/      model.safetensors, config.json: a checkpoint like any other
                                    training.safetensors, training.json: optimiser and position
    model.safetensors, config.json  the weights to use
    log.csv, tensorboard/, pictures/

Nothing is pickled. All randomness of a step follows from seed and step, so no generator's state is stored.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from navrep_data.errors import CheckpointError
from navrep_data.io import atomic_write_bytes, atomic_write_json, fsync_dir, read_json, sha256_bytes
from navrep_data.models import checkpoint

PROGRESS_FILE, RECIPE_FILE = "progress.json", "recipe.json"
CHECKPOINTS = "checkpoints"
_WEIGHTS, _STATE = "training.safetensors", "training.json"
_MAX_JSON = 1 << 22
_MAX_WEIGHTS = 1 << 33


@dataclass
class Progress:
    """Where a training stands.

    Attributes
    ----------
    step : int
        Optimiser steps done.
    tokens : int
        Rows of the windows seen.
    seconds : float
        Time spent on steps, over all runs; validation, pictures and saving not counted.
    best : float or None
        Smallest validation error so far.
    best_step : int
        When it was reached.
    extra : dict of str to Tensor
        Further state: M's carried LSTM state.
    """

    step: int = 0
    tokens: int = 0
    seconds: float = 0.0
    best: float | None = None
    best_step: int = 0
    extra: dict[str, Tensor] = field(default_factory=dict)


def folder_of(out: Path, step: int) -> Path:
    """Return the folder of the checkpoint of a step."""
    return out / CHECKPOINTS / f"step-{step:08d}"


def save(
    out: Path,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    progress: Progress,
    metadata: Mapping[str, Any],
    trained: nn.Module | None = None,
) -> Path:
    """Write a checkpoint into a new folder, then move it to its name.

    `trained` is the module whose parameters the optimiser holds, where that is not `model` itself.

    Raises
    ------
    CheckpointError
        If the weights are not finite.
    """
    target = folder_of(out, progress.step)
    part = target.with_name(target.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    checkpoint.save(model, part, metadata, dataset=metadata.get("dataset"))
    tensors = {f"extra/{name}": t.detach().cpu().contiguous() for name, t in progress.extra.items()}
    for name, parameter in (trained or model).named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            tensors[f"optimizer/{name}/{key}"] = torch.as_tensor(value).detach().cpu().contiguous()
    data = safetensors.torch.save(tensors)
    atomic_write_bytes(part / _WEIGHTS, data)
    atomic_write_json(
        part / _STATE,
        {
            "step": progress.step,
            "tokens": progress.tokens,
            "seconds": progress.seconds,
            "best": progress.best,
            "best_step": progress.best_step,
            "sha256": sha256_bytes(data),
        },
    )
    shutil.rmtree(target, ignore_errors=True)
    os.replace(part, target)
    fsync_dir(target.parent)
    return target


def commit(out: Path, progress: Progress) -> None:
    """Name the last and the best checkpoint in ``progress.json``, then remove all others."""
    best = progress.best_step if folder_of(out, progress.best_step).is_dir() and progress.best is not None else None
    atomic_write_json(
        out / PROGRESS_FILE,
        {
            "last": folder_of(out, progress.step).name,
            "best": None if best is None else folder_of(out, best).name,
            "step": progress.step,
            "best_error": progress.best,
        },
    )
    keep = {folder_of(out, progress.step).name} | ({folder_of(out, best).name} if best is not None else set())
    for folder in (out / CHECKPOINTS).iterdir():
        if folder.name not in keep:
            shutil.rmtree(folder, ignore_errors=True)


def publish(out: Path, step: int) -> None:
    """Copy the weights of a checkpoint to the top of the output folder: what a name or path of it loads."""
    weights, config = checkpoint.paths(folder_of(out, step))
    atomic_write_bytes(out / checkpoint.WEIGHTS_NAME, weights.read_bytes())
    atomic_write_bytes(out / checkpoint.CONFIG_NAME, config.read_bytes())


def last_folder(out: Path) -> Path | None:
    """Return the folder of the last checkpoint, None where there is none yet."""
    path = out / PROGRESS_FILE
    if not path.is_file():
        return None
    found = read_json(path, _MAX_JSON)
    name = str(found.get("last", "")) if isinstance(found, dict) else ""
    folder = out / CHECKPOINTS / name
    if not re.fullmatch(r"step-\d{1,12}", name) or not (folder / _STATE).is_file():
        raise CheckpointError(f"{path} names {name!r}, which is not there: start anew in another folder.")
    return folder


def load(
    folder: Path, model: nn.Module, optimizer: torch.optim.Optimizer, trained: nn.Module | None = None
) -> Progress:
    """Put a checkpoint's weights into model and optimiser; returns where it stood. For `trained` see :func:`save`.

    Raises
    ------
    CheckpointError
        If a file is missing, changed or of another network.
    """
    device = next(model.parameters()).device
    saved = checkpoint.load(folder)
    if type(saved) is not type(model) or getattr(saved, "config", 0) != getattr(model, "config", 1):
        raise CheckpointError(f"{folder} holds another network than this recipe trains: resume with its own recipe.")
    model.load_state_dict(saved.state_dict())
    progress, digest = _read_state(folder)
    path = folder / _WEIGHTS
    if not path.is_file() or path.stat().st_size > _MAX_WEIGHTS:
        raise CheckpointError(f"{path} is missing or too large: start anew in another folder.")
    data = path.read_bytes()
    if sha256_bytes(data) != digest:
        raise CheckpointError(f"{path} does not have the SHA-256 of {_STATE}: it was changed or cut short.")
    try:
        tensors = safetensors.torch.load(data)
    except safetensors.SafetensorError as error:
        raise CheckpointError(f"{path} is not a safetensors file ({error}).") from error
    by_name = dict((trained or model).named_parameters())
    fused = {p for group in optimizer.param_groups if group.get("fused") for p in group["params"]}
    for key, tensor in tensors.items():
        if key.startswith("optimizer/"):
            name, _, what = key.removeprefix("optimizer/").rpartition("/")
            if name not in by_name or tensor.shape not in (by_name[name].shape, ()):
                raise CheckpointError(f"{path} has a state of {name!r}, unknown in this network.")
            parameter = by_name[name]
            # torch keeps the step counter on the CPU, unless it updates in one pass
            stays = what == "step" and parameter not in fused
            optimizer.state[parameter][what] = tensor if stays else tensor.to(parameter.device)
    extra = {k.removeprefix("extra/"): t.to(device) for k, t in tensors.items() if k.startswith("extra/")}
    return replace(progress, extra=extra)


def read_step(folder: Path) -> int:
    """Return how many steps the checkpoint in `folder` had done."""
    return _read_state(folder)[0].step


def _read_state(folder: Path) -> tuple[Progress, str]:
    """Return where a checkpoint stood, without its tensors, and their hash."""
    state = read_json(folder / _STATE, _MAX_JSON)
    try:
        best = state["best"]
        progress = Progress(
            int(state["step"]), int(state["tokens"]), float(state["seconds"]), None if best is None else float(best),
            int(state["best_step"]),
        )  # fmt: skip
        digest = str(state["sha256"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CheckpointError(f"{folder / _STATE} lacks or garbles a field: start anew in another folder.") from error
    return progress, digest
