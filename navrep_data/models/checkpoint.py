"""The only way weights are saved and loaded here: safetensors and a JSON config, never a pickle.

A checkpoint is a folder with ``model.safetensors`` and ``config.json``, or two files side by side, ``NAME.safetensors``
and ``NAME.json``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from navrep_data.errors import CheckpointError, ConfigError, did_you_mean
from navrep_data.io import atomic_write_bytes, atomic_write_json, read_json, sha256_bytes
from navrep_data.models.config import (
    ControllerConfig,
    EndToEndConfig,
    JointConfig,
    MemoryConfig,
    ModelConfig,
    ModularConfig,
    TransformerConfig,
    VAEConfig,
)
from navrep_data.models.controllers import Controller, EndToEnd
from navrep_data.models.joint import JointWorldModel
from navrep_data.models.modular import MDNRNN, ModularWorldModel
from navrep_data.models.transformer import TransformerWorldModel
from navrep_data.models.vae import VAE

DATASET_FIELDS = ("name", "repo", "revision", "content_hash")
"""What the record of a dataset holds at least: its name, Hub repository and commit (or None), hash over its rows."""
FORMAT_NAME = "navrep-data-model"
STORAGE = {"float32": torch.float32, "float16": torch.float16}
"""How weights may be stored; networks always hold float32. Half the bytes cost about three decimals."""
FORMAT_VERSION = 1
WEIGHTS_NAME, CONFIG_NAME = "model.safetensors", "config.json"
# Configs hold a few settings and notes; weights carry a header beside the numbers.
_MAX_CONFIG_BYTES = 1 << 20
_MAX_HEADER_BYTES = 1 << 20

_KINDS: dict[str, tuple[type[ModelConfig], type[nn.Module]]] = {
    VAEConfig.kind: (VAEConfig, VAE),
    MemoryConfig.kind: (MemoryConfig, MDNRNN),
    ModularConfig.kind: (ModularConfig, ModularWorldModel),
    JointConfig.kind: (JointConfig, JointWorldModel),
    TransformerConfig.kind: (TransformerConfig, TransformerWorldModel),
    ControllerConfig.kind: (ControllerConfig, Controller),
    EndToEndConfig.kind: (EndToEndConfig, EndToEnd),
}
KINDS = tuple(_KINDS)
"""Kinds of networks that a checkpoint can hold."""


def make(kind: str, config: Mapping[str, Any] | ModelConfig) -> nn.Module:
    """Return a new network.

    Parameters
    ----------
    kind : str
        One of :data:`KINDS`.
    config : ModelConfig or mapping
        Its settings; missing ones take the defaults of the released models.

    Raises
    ------
    ConfigError
        If there is no such kind or a setting cannot be used.
    """
    if kind not in _KINDS:
        raise ConfigError(
            f"Unknown kind of network {str(kind)!r}.{did_you_mean(str(kind), KINDS)} Known: {', '.join(KINDS)}."
        )
    config_type, network_type = _KINDS[kind]
    settings = config if isinstance(config, config_type) else config_type.from_dict(config)
    return network_type(settings)


def paths(path: Path | str) -> tuple[Path, Path]:
    """Return the weights file and the config file of a checkpoint given as a folder or as either file."""
    path = Path(path)
    if path.suffix in (".safetensors", ".json") and path.name not in (WEIGHTS_NAME, CONFIG_NAME):
        return path.with_suffix(".safetensors"), path.with_suffix(".json")
    folder = path.parent if path.name in (WEIGHTS_NAME, CONFIG_NAME) else path
    return folder / WEIGHTS_NAME, folder / CONFIG_NAME


def save(
    module: nn.Module,
    path: Path | str,
    metadata: Mapping[str, Any] | None = None,
    *,
    dataset: Mapping[str, Any] | None = None,
    storage: str = "float32",
) -> Path:
    """Write a network as safetensors and JSON; the config comes last, so a checkpoint with one is complete.

    Parameters
    ----------
    module : nn.Module
        A network of this package.
    path : path-like
        Folder (made if missing) or ``FILE.safetensors``.
    metadata : mapping, optional
        Plain JSON values to keep beside the config: provenance, results.
    dataset : mapping, optional
        What it was trained on, kept as ``metadata["dataset"]``: the ``provenance`` of a dataset of
        :mod:`navrep_data.datasets`, or :func:`navrep_data.shards.dataset_record` of a folder, with more keys (split) if
        you like. It says which rows, by content hash, and where they came from, by repository and commit.
    storage : str
        ``"float32"``, or ``"float16"``: half the bytes, rounded.

    Returns
    -------
    pathlib.Path
        The weights file.

    Raises
    ------
    CheckpointError
        If the module is not a network of this package or holds NaN or infinity.
    ConfigError
        If `dataset` lacks what identifies a dataset, or `storage` is unknown.
    """
    if storage not in STORAGE:
        raise ConfigError(f"storage is {storage!r}, expected one of: {', '.join(STORAGE)}.")
    kept = dict(metadata or {})
    if dataset is not None:
        missing = [name for name in DATASET_FIELDS if name not in dataset]
        if missing:
            raise ConfigError(
                f"The dataset record lacks {', '.join(missing)}; expected the provenance of a dataset, as "
                "SequenceDataset(...).provenance gives it."
            )
        kept["dataset"] = dict(dataset)
    config = getattr(module, "config", None)
    if not isinstance(config, ModelConfig) or config.kind not in _KINDS:
        raise CheckpointError(
            f"A {type(module).__name__} cannot be saved, expected a network of navrep_data.models: {', '.join(KINDS)}."
        )
    state = {name: t.detach().to("cpu", STORAGE[storage]).contiguous() for name, t in module.state_dict().items()}
    # float16 ends at 65504: what is larger would be infinite
    _check_finite(state, "The network" if storage == "float32" else f"The network in {storage}")
    weights_path, config_path = paths(path)
    weights_path.parent.mkdir(parents=True, exist_ok=True)
    weights = safetensors.torch.save(state)
    atomic_write_bytes(weights_path, weights)
    atomic_write_json(
        config_path,
        {
            "format": FORMAT_NAME,
            "format_version": FORMAT_VERSION,
            "kind": config.kind,
            "config": config.to_dict(),
            "weights_sha256": sha256_bytes(weights),
            # said only where it is not the usual one, so that older configs keep their bytes
            **({} if storage == "float32" else {"weights_dtype": storage}),
            "metadata": kept,
        },
    )
    return weights_path


def read_config(path: Path | str) -> dict[str, Any]:
    """Return the JSON beside the weights: kind, config, weights_sha256, metadata.

    Raises
    ------
    CheckpointError
        If it is missing or is not a checkpoint's, or of a later format version.
    """
    _, config_path = paths(path)
    if not config_path.is_file():
        raise CheckpointError(
            f"There is no {config_path}; expected a checkpoint of navrep-data: {WEIGHTS_NAME} and {CONFIG_NAME} in one "
            "folder. Convert other files with: navrep-data models convert FILE"
        )
    found = read_json(config_path, _MAX_CONFIG_BYTES)
    if not isinstance(found, dict) or found.get("format") != FORMAT_NAME:
        raise CheckpointError(f"{config_path} is not the config of a navrep-data model (no format {FORMAT_NAME!r}).")
    if found.get("format_version") != FORMAT_VERSION:
        raise CheckpointError(
            f"{config_path} has format version {found.get('format_version')!r}, expected {FORMAT_VERSION}: "
            "install a newer navrep-data."
        )
    return found


@contextlib.contextmanager
def single_precision() -> Iterator[None]:
    """Make float32 the default of torch for a while, whatever it is."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextlib.contextmanager
def building() -> Iterator[None]:
    """Build networks the same whatever torch is set to: float32, on the CPU, with gradients, and without a trace.

    Weights that are about to be overwritten are drawn first; the global generator is left as it was. Loading goes
    through this; networks that are about to be trained do not, since a training's seed decides their weights.
    """
    with (
        single_precision(), torch.random.fork_rng(devices=[]), torch.device("cpu"), torch.inference_mode(False),
        torch.enable_grad(),
    ):  # fmt: skip
        yield


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread for a while: sums do not depend on the number of cores then."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@building()
def load(path: Path | str) -> nn.Module:
    """Read a network written by :func:`save`, in eval mode, on the CPU.

    Parameters
    ----------
    path : path-like
        Folder, ``FILE.safetensors`` or ``FILE.json``.

    Raises
    ------
    CheckpointError
        If files are missing or too large, or names, shapes, dtypes or the hash are wrong.
    ConfigError
        If the config cannot be used.
    """
    found = read_config(path)
    weights_path, config_path = paths(path)
    kind, storage = found.get("kind"), found.get("weights_dtype", "float32")
    settings = found.get("config", {})
    if not isinstance(storage, str) or storage not in STORAGE:
        raise CheckpointError(f"{config_path}: weights_dtype is {str(storage)!r}, expected {', '.join(STORAGE)}.")
    module = make(str(kind), settings)
    expected = module.state_dict()
    if not weights_path.is_file():
        raise CheckpointError(f"There is no {weights_path} beside {config_path.name}; get the checkpoint again.")
    limit = sum(t.numel() for t in expected.values()) * STORAGE[storage].itemsize + _MAX_HEADER_BYTES
    size = weights_path.stat().st_size
    if not limit - _MAX_HEADER_BYTES < size <= limit:
        raise CheckpointError(
            f"{weights_path} has {size:,} bytes, expected a little over {limit - _MAX_HEADER_BYTES:,} for this {kind}."
        )
    data = weights_path.read_bytes()
    if sha256_bytes(data) != found.get("weights_sha256"):
        raise CheckpointError(
            f"{weights_path} does not have the SHA-256 that {config_path.name} gives; it was changed or cut short: "
            "get it again."
        )
    try:
        state = safetensors.torch.load(data)
    except safetensors.SafetensorError as error:
        raise CheckpointError(f"{weights_path} is not a safetensors file ({error}); get it again.") from error
    for name, value in state.items():
        if value.dtype != STORAGE[storage]:
            raise CheckpointError(f"{weights_path}: {name!r} is {value.dtype}, expected {storage}; get it again.")
    put_weights(module, {name: value.to(torch.float32) for name, value in state.items()}, str(weights_path))
    return module


def put_weights(module: nn.Module, state: Mapping[str, Tensor], source: str) -> None:
    """Put weights into a network after checking names, shapes, dtypes and values, and switch it to eval mode.

    Parameters
    ----------
    module : nn.Module
        Takes the weights.
    state : mapping of str to Tensor
        Exactly the network's names.
    source : str
        Where they come from, for errors.

    Raises
    ------
    CheckpointError
        If anything does not fit.
    """
    expected = module.state_dict()
    for name in expected:
        if name not in state:
            raise CheckpointError(f"{source} lacks the weights {name!r} of a {type(module).__name__}.")
    for name, value in state.items():
        if name not in expected:
            raise CheckpointError(f"{source} has weights {name!r}, unknown in a {type(module).__name__}.")
        wanted = tuple(expected[name].shape)
        if tuple(value.shape) != wanted or value.dtype != torch.float32:
            raise CheckpointError(
                f"{source}: {name!r} has shape {tuple(value.shape)} and {value.dtype}, expected {wanted} and float32."
            )
    _check_finite(state, source)
    module.load_state_dict(dict(state))
    module.eval()
    module.requires_grad_(True)


def _check_finite(state: Mapping[str, Tensor], source: str) -> None:
    for name, value in state.items():
        if not bool(torch.isfinite(value).all()):
            raise CheckpointError(f"{source}: {name!r} holds NaN or infinity, expected finite weights.")
