"""Models by name or by folder: what a command line's NAME|DIR stands for."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from navrep_data.errors import CheckpointError, ModelNotFoundError
from navrep_data.io import read_json
from navrep_data.schema import SensorContract
from navrep_data.zoo.folders import (
    check_described,
    is_training,
    load_folder,
    place_of,
    policy_files,
    read_policy,
    trained_robot,
)

POLICY_FILE = "policy.json"
"""Beside a controller's weights: what it sees through."""
PARTS = "world_model"
"""Folder beside a controller's weights that holds its world model or V."""
_MAX_JSON = 1 << 16


def load_any_model(name: str | os.PathLike[str], source: str | os.PathLike[str] | None = None, **options: Any) -> Any:
    """Load a model of the zoo by name, or a checkpoint by its place.

    Parameters
    ----------
    name : str or path-like
        Name such as ``transformer_1d.released``, or a place (``./folder``, ``hf://user/name``, see
        ``navrep_data.zoo.folders.place_of``) with ``model.safetensors`` and ``config.json``: a checkpoint of
        :mod:`navrep_data.models.checkpoint`, what ``navrep-data train`` wrote, or a policy of
        :func:`navrep_data.zoo.save_policy`.
    source : path-like or str, optional
        Where names are looked for, see :func:`navrep_data.zoo.load`.
    **options
        For names: passed on to :func:`navrep_data.zoo.load`.

    Returns
    -------
    torch.nn.Module or navrep_data.zoo.policy.Policy

    Raises
    ------
    CheckpointError
        If the folder holds no checkpoint.
    UnknownNameError, CorruptDataError, OfflineError, DownloadError
        As :func:`navrep_data.zoo.load`.
    """
    path = place_of(name)
    if path is None:
        from navrep_data import zoo

        return zoo.load(os.fspath(name), source, **options)
    if not path.exists():
        raise CheckpointError(
            f"There is no {path}; expected a folder with model.safetensors, or a name: navrep-data models"
        )
    if is_training(path):
        return load_policy(path, **options)
    if (path / POLICY_FILE).is_file():
        return load_folder(path, **options)
    from navrep_data.models import checkpoint

    return checkpoint.load(path)


def described(path: Path) -> dict[str, Any]:
    """Return what the JSON at a place says of the model there, with the sizes of its files; no weights are read.

    Raises
    ------
    ModelNotFoundError
        If there is nothing.
    CheckpointError
        If it is no model of this package.
    """
    from navrep_data.models import checkpoint

    if not path.exists():
        raise ModelNotFoundError(f"There is no {path}, expected a folder with a checkpoint: check the path.")
    if (path / POLICY_FILE).is_file() and not is_training(path):
        found, files = read_policy(path), policy_files(path)
    else:
        found = checkpoint.read_config(path)
        files = policy_files(path) or {file.name: file for file in checkpoint.paths(path) if file.is_file()}
        if is_training(path):
            found = {**found, "policy": read_json(path / POLICY_FILE, _MAX_JSON)}
    return {"path": str(path), **found, "files": {name: file.stat().st_size for name, file in files.items()}}


def load_policy(folder: Path, **options: Any) -> Any:
    """Return the policy in a folder that ``navrep-data train controller`` or ``train e2e`` wrote.

    Parameters
    ----------
    folder : Path
        With ``policy.json``, the controller's checkpoint, and its world model in a folder of its own.
    **options
        Passed on to :class:`navrep_data.zoo.policy.Policy`.

    Raises
    ------
    CorruptDataError
        If ``policy.json`` is no JSON.
    CheckpointError
        If ``policy.json`` is not what training writes, or a checkpoint is missing or does not fit.
    """
    from navrep_data.models import VAE, ActorCritic, WorldModel, checkpoint
    from navrep_data.zoo.policy import Policy

    found = read_json(folder / POLICY_FILE, _MAX_JSON)
    if not isinstance(found, dict):
        raise CheckpointError(f"{folder / POLICY_FILE} is not the description of a policy; get it again.")
    check_described(found, folder / POLICY_FILE, {"world_model": (None, PARTS)})
    features, lidar, context, part = (found.get(key) for key in ("features", "lidar", "context", "world_model"))
    sensor = SensorContract(**found["sensor"])
    network = checkpoint.load(folder)
    if not isinstance(network, ActorCritic):
        raise CheckpointError(f"{folder} holds a {type(network).__name__}, expected a controller.")
    model = None if part is None else checkpoint.load(folder / PARTS)
    world_model = model if isinstance(model, WorldModel) and features != "z" else None
    vae = model if isinstance(model, VAE) else getattr(model, "vae", None)
    return Policy(
        network,
        features,
        lidar,
        vae,
        world_model,
        context=context,
        sensor=sensor,
        robot=trained_robot(found),
        **{"name": folder.name, **options},
    )
