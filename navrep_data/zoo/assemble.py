"""From a registry record and its files to a model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import nn

from navrep_data.errors import CheckpointError, ConfigError
from navrep_data.models import checkpoint
from navrep_data.models.controllers import ActorCritic
from navrep_data.models.modular import MDNRNN, ModularWorldModel
from navrep_data.models.noise import Noise
from navrep_data.models.vae import VAE
from navrep_data.models.world_model import WorldModel
from navrep_data.schema import INFERENCE, SensorContract
from navrep_data.zoo.folders import trained_robot
from navrep_data.zoo.importers import load_any, load_controller_zip, load_tf_json, load_torch_world_model
from navrep_data.zoo.policy import Policy


@checkpoint.building()
def build(
    record: Mapping[str, Any],
    files: Mapping[str, Path],
    parts: Mapping[str, Any],
    *,
    inference: str = "deterministic",
    seed: int = 0,
    dtype: str = "float32",
    compile: bool = False,
    device: str = "cpu",
    context: str | None = None,
    ranges: str = "contract",
) -> Policy | nn.Module:
    """Return the model of a record.

    Parameters
    ----------
    record : mapping
        A registry record; read are name, kind, format, lidar, features, z_size, n_inputs, context_rule, sensor and
        robot.
    files : mapping of str to pathlib.Path
        Its files, by path in the record.
    parts : mapping of str to object
        What it is joined with, by role: ``world_model``, ``vae``, ``memory``; built before, by this function.
    inference, seed, dtype, compile, device, ranges
        As for :class:`Policy`; world models take `inference`, `seed` and `device`.
    context : str, optional
        Instead of the record's context rule.

    Returns
    -------
    Policy or nn.Module
        A Policy for policies and lone controllers; else a WorldModel, VAE or MDNRNN.

    Raises
    ------
    CheckpointError
        If a file or part is not what the record says.
    ConfigError
        If a setting cannot be used.
    """
    if inference not in INFERENCE:
        raise ConfigError(f"inference is {inference!r}, expected one of: {', '.join(INFERENCE)}.")
    name, kind = str(record["name"]), record["kind"]
    if kind in ("policy", "controller"):
        network = _read(record, files)
        _expect(network, ActorCritic, name)
        assert isinstance(network, ActorCritic)
        vae, world_model = _eyes_and_memory(parts)
        sensor = SensorContract(**record["sensor"]) if record.get("sensor") else None
        return Policy(
            network,
            record["features"],
            record["lidar"],
            vae,
            world_model,
            name=name,
            context=context or record.get("context_rule"),
            inference=inference,
            seed=seed,
            dtype=dtype,
            compile=compile,
            device=device,
            sensor=sensor,
            ranges=ranges,
            robot=trained_robot(record),
        )
    model: nn.Module
    if kind == "world_model" and not files:
        model = ModularWorldModel.of(_part(parts, "vae", VAE, name), _part(parts, "memory", MDNRNN, name))
    else:
        model = _read(record, files)
    _expect(model, {"world_model": WorldModel, "vae": VAE, "memory": MDNRNN}[kind], name)
    _check_sizes(model, record)
    if isinstance(model, WorldModel) and inference == "as_released":
        model.inference_noise = Noise.seeded(seed, device)
    return model.to(device)


def _read(record: Mapping[str, Any], files: Mapping[str, Path]) -> nn.Module:
    if not files:
        raise CheckpointError(f"{record['name']} has no files; expected one to read its weights from.")
    by_suffix = [path for path in files.values() if path.suffix == ".safetensors"]
    path = by_suffix[0] if by_suffix else next(iter(files.values()))
    match record.get("format"):
        case "sb2-zip":
            return load_controller_zip(path)
        case "torch-state-dict":
            return load_torch_world_model(path)
        case "tf-json":
            memory = record["kind"] == "memory"
            return load_tf_json(path, "memory" if memory else f"vae_{record['lidar']}")
        case "safetensors":
            return checkpoint.load(path)
    return load_any(path)


def _eyes_and_memory(parts: Mapping[str, Any]) -> tuple[VAE | None, WorldModel | None]:
    """Return V and world model of a policy from whichever parts its record names."""
    world_model, vae, memory = parts.get("world_model"), parts.get("vae"), parts.get("memory")
    if world_model is None and vae is not None and memory is not None:
        world_model = ModularWorldModel.of(vae, memory)
    return vae if world_model is None else world_model.vae, world_model


def _part(parts: Mapping[str, Any], role: str, kind: type[Any], name: str) -> Any:
    if role not in parts:
        raise CheckpointError(f"{name} needs its part {role!r}, expected it among: {', '.join(parts) or 'none given'}.")
    _expect(parts[role], kind, f"{role} of {name}")
    return parts[role]


def _expect(model: object, kind: type[Any], name: str) -> None:
    if not isinstance(model, kind):
        raise CheckpointError(
            f"{name} is a {type(model).__name__}, expected a {kind.__name__}: the files are mixed up."
        )


def _check_sizes(model: nn.Module, record: Mapping[str, Any]) -> None:
    config = getattr(model, "config", None)
    for key in ("lidar", "z_size", "h_size"):
        found, wanted = getattr(config, key, None), record.get(key)
        if found is not None and wanted is not None and found != wanted:
            raise CheckpointError(f"{record['name']} has {key} {found}, expected {wanted}: the files are mixed up.")
