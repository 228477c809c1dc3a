"""Models in folders: a checkpoint, or a policy with its parts, written and loaded as one.

A checkpoint is what :func:`navrep_data.models.checkpoint.save` writes. A policy is a folder with ``policy.json`` and
one checkpoint per part: ``controller/``, and ``world_model/`` or ``vae/`` where it has one.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from navrep_data.errors import CheckpointError, ConfigError, ModelNotFoundError
from navrep_data.io import HUB_SCHEME, atomic_write_json, is_path, read_json
from navrep_data.sb3_file import refuse_sb3_file
from navrep_data.schema import RobotContract, SensorContract

if TYPE_CHECKING:
    from torch import nn

    from navrep_data.zoo.policy import Policy

POLICY_FILE = "policy.json"
POLICY_FORMAT = "navrep-data-policy"
POLICY_VERSION = 1
CONTROLLER = "controller"
PART_FOLDERS = (CONTROLLER, "world_model", "vae")
"""Folders that a policy may have; each holds a checkpoint."""
_MAX_POLICY_BYTES = 1 << 20
_CONTEXTS = ("oldest-32", "newest-32", "carried-state")
# What the registry calls the kinds of checkpoints.
_KINDS = {"vae": "vae", "memory": "memory", "controller": "controller", "e2e": "policy"}


def place_of(name: str | os.PathLike[str]) -> Path | None:
    """Return where on this machine the model lies that is named by its place; None for a name of the zoo.

    Parameters
    ----------
    name : str or path-like
        What somebody typed: ``./folder``, ``/folder``, ``~/folder``, ``FILE.safetensors``, a path object, or
        ``hf://user/name``, which is fetched. A bare word is a name of the zoo, whatever lies in the working folder.

    Raises
    ------
    HubError, OfflineError, DownloadError, CorruptDataError
        If a model on the Hub cannot be had.
    PolicyError
        If it is a file of stable-baselines3, which nothing here opens.
    """
    if not is_path(name):
        return None
    if isinstance(name, str) and name.startswith(HUB_SCHEME):
        from navrep_data.zoo.hub import fetch_model

        return fetch_model(name)
    place = Path(name).expanduser()
    refuse_sb3_file(place)
    return place


def save_policy(policy: Policy, folder: Path | str, metadata: Mapping[str, Any] | None = None) -> Path:
    """Write a policy and all its parts into a folder; ``policy.json`` comes last, so a folder with one is complete.

    Parameters
    ----------
    policy : Policy
        What to write.
    folder : path-like
        Made if missing; must hold nothing else.
    metadata : mapping, optional
        Plain JSON values to keep: provenance, results, ``dataset`` (see :func:`navrep_data.models.checkpoint.save`).

    Returns
    -------
    pathlib.Path
        ``policy.json``.

    Raises
    ------
    ConfigError
        If the folder holds something else.
    CheckpointError
        If a part holds NaN or infinity.
    """
    from navrep_data.models import checkpoint

    folder = Path(folder)
    others = [p.name for p in folder.iterdir() if p.name not in (POLICY_FILE, *PART_FOLDERS)] if folder.exists() else []
    if others:
        raise ConfigError(
            f"{folder} holds {sorted(others)[0]!r}, expected a new folder or an older policy: choose another."
        )
    parts: dict[str, nn.Module] = {CONTROLLER: policy.network}
    if policy.world_model is not None:
        parts["world_model"] = policy.world_model
    elif policy.vae is not None:
        parts["vae"] = policy.vae
    folder.mkdir(parents=True, exist_ok=True)
    for name, module in parts.items():
        checkpoint.save(module, folder / name)
    path = folder / POLICY_FILE
    atomic_write_json(
        path,
        {
            "format": POLICY_FORMAT,
            "format_version": POLICY_VERSION,
            "name": policy.name,
            "features": policy.features,
            "lidar": policy.lidar,
            "context": policy.context,
            "sensor": policy.sensor.to_dict(),
            "robot": policy.trained_on.to_dict(),
            "parts": list(parts),
            "metadata": dict(metadata or {}),
        },
    )
    return path


def read_policy(folder: Path | str) -> dict[str, Any]:
    """Return the checked JSON of a policy folder.

    Raises
    ------
    CheckpointError
        If it is not what :func:`save_policy` writes.
    """
    path = Path(folder) / POLICY_FILE
    found = read_json(path, _MAX_POLICY_BYTES)
    if not isinstance(found, dict) or found.get("format") != POLICY_FORMAT:
        raise CheckpointError(f"{path} is not the description of a policy (no format {POLICY_FORMAT!r}).")
    if found.get("format_version") != POLICY_VERSION:
        raise CheckpointError(
            f"{path} has format version {found.get('format_version')!r}, expected {POLICY_VERSION}: install a "
            "newer navrep-data."
        )
    check_described(found, path, {"parts": ([CONTROLLER], [CONTROLLER, "world_model"], [CONTROLLER, "vae"])})
    missing = [name for name in ("features", "lidar", "context") if name not in found]  # null is a value of theirs
    if missing or not isinstance(found.get("name"), str) or not isinstance(found.get("metadata"), dict):
        raise CheckpointError(f"{path}: {(missing or ['name or metadata'])[0]} is missing; get the policy again.")
    return found


def check_described(found: Mapping[str, Any], path: Path, more: Mapping[str, tuple[Any, ...]]) -> None:
    """Refuse the description of a policy unless features, lidar, context, sensor and `more` are what they may be.

    Raises
    ------
    CheckpointError
        If one is not.
    """
    allowed: dict[str, tuple[Any, ...]] = {
        "features": ("z", "h", "zh", None),
        "lidar": ("rings", "1d", None),
        "context": (*_CONTEXTS, None),
        **more,
    }
    for name, values in allowed.items():
        if found.get(name) not in values:
            raise CheckpointError(f"{path}: {name} is {str(found.get(name))!r}, expected one of: {values}.")
    sensor = found.get("sensor")
    if not isinstance(sensor, dict) or any(type(v) not in (int, float) for v in sensor.values()):
        sensor = {}
    if set(sensor) != set(SensorContract().to_dict()):
        raise CheckpointError(f"{path}: sensor is no sensor contract; get the policy again.")
    try:
        trained_robot(found)
    except (ConfigError, TypeError) as error:
        raise CheckpointError(f"{path}: robot is no robot's speed and radius; get the policy again.") from error


def trained_robot(found: Mapping[str, Any]) -> RobotContract | None:
    """Return the robot that a described policy was trained on, None where nothing is said: that of navrep-train.

    Raises
    ------
    ConfigError, TypeError
        If it is no speed and radius.
    """
    robot = found.get("robot")
    return None if robot is None else RobotContract(**robot)


def load_folder(
    path: str | os.PathLike[str], *, inference: str = "deterministic", seed: int = 0, **options: Any
) -> Any:
    """Load the checkpoint or policy at `path`.

    Parameters
    ----------
    path : path-like
        Policy folder, checkpoint folder, output folder of a training, or ``FILE.safetensors`` with its JSON beside it.
    inference, seed, **options
        As for :func:`navrep_data.zoo.load`.

    Raises
    ------
    ModelNotFoundError
        If there is nothing at `path`.
    CheckpointError
        If it is not a model of this package, or its weights do not have their hash.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise ModelNotFoundError(f"There is no {path}, expected a folder with a checkpoint: check the path.")
    if not (path / POLICY_FILE).is_file():
        return _load_checkpoint(path, path.stem if path.is_file() else path.resolve().name, inference, seed, options)
    if is_training(path):
        from navrep_data.zoo.local import load_policy

        return load_policy(path, inference=inference, seed=seed, **options)
    found = read_policy(path)
    from navrep_data.zoo.assemble import build

    name = found["name"] or path.resolve().name
    parts = {
        part: _load_checkpoint(
            path / part, f"{part} of {name}", inference, seed, {"device": options.get("device", "cpu")}
        )
        for part in found["parts"][1:]
    }
    record = {
        "name": name, "kind": "policy", "format": "safetensors", "features": found["features"],
        "lidar": found["lidar"], "context_rule": found["context"], "sensor": found["sensor"],
        "robot": found.get("robot"),
    }  # fmt: skip
    return build(record, _files(path / CONTROLLER), parts, inference=inference, seed=seed, **options)


def is_training(path: Path) -> bool:
    """Return whether a folder is a controller's training: its weights lie beside ``policy.json``, not in a folder."""
    from navrep_data.models.checkpoint import WEIGHTS_NAME

    return (path / POLICY_FILE).is_file() and (path / WEIGHTS_NAME).is_file()


def policy_files(path: Path) -> dict[str, Path]:
    """Return the files that decide what the policy in a folder does, by their names below it.

    Parameters
    ----------
    path : Path
        Policy folder, output folder of a training, or a folder with the checkpoint of an end-to-end network.
    """
    from navrep_data.models.checkpoint import CONFIG_NAME, WEIGHTS_NAME

    parts = [path, *(path / part for part in PART_FOLDERS)]
    found = [path / POLICY_FILE, *(part / name for part in parts for name in (CONFIG_NAME, WEIGHTS_NAME))]
    return {file.relative_to(path).as_posix(): file for file in found if file.is_file()}


def _files(path: Path) -> dict[str, Path]:
    from navrep_data.models import checkpoint

    return {"model.safetensors": checkpoint.paths(path)[0]}


def _load_checkpoint(path: Path, name: str, inference: str, seed: int, options: Mapping[str, Any]) -> Any:
    from navrep_data.models import checkpoint
    from navrep_data.zoo.assemble import build

    found = checkpoint.read_config(path)
    kind, config = str(found.get("kind")), found.get("config")
    settings = config if isinstance(config, dict) else {}
    record = {
        "name": name, "kind": _KINDS.get(kind, "world_model"), "format": "safetensors", "features": None,
        "lidar": settings.get("lidar") if kind == "e2e" else None,
    }  # fmt: skip
    return build(record, _files(path), {}, inference=inference, seed=seed, **options)
