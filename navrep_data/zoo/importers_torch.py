"""Reader of the released joint and transformer world models: torch state dicts."""

from __future__ import annotations

import pickletools
import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from navrep_data.errors import CheckpointError
from navrep_data.io import raise_refusal
from navrep_data.models import checkpoint
from navrep_data.models.config import JointConfig, TransformerConfig
from navrep_data.models.world_model import WorldModel
from navrep_data.zoo.importers_bounds import check_size, read_member, zip_members

# The largest, the transformer for rings, has 4.85 million numbers and its masks: 19.6 MB.
_MAX_BYTES = 24 << 20
_MAX_PICKLE_BYTES = 1 << 18
# All that a state dict of float tensors is made of. torch's own list is longer, and one entry of it can claim memory.
_INGREDIENTS = frozenset({"collections OrderedDict", "torch FloatStorage", "torch._utils _rebuild_tensor_v2"})


def load_torch_world_model(path: Path | str) -> WorldModel:
    """Read a released joint or transformer world model: a torch state dict.

    Parameters
    ----------
    path : path-like
        ``navreptraingpt``, ``navreptraingpt1d``, ``navreptrainvaelstm`` or ``navreptrainvae1dlstm``.

    Raises
    ------
    CheckpointError
        If the file is no zip, too large, compressed, holds anything but tensors, or not those of such a model.

    Notes
    -----
    ``torch.load(weights_only=True, mmap=True)``: only tensors are built, and mapped from the file, so that a size
    that lies cannot reach beyond it; it is then compared with what the zip stores. The older format, a bare pickle,
    is refused unread.
    """
    path = Path(path)
    check_size(path, _MAX_BYTES, "a joint or transformer world model")
    members = zip_members(path, _MAX_BYTES)
    for name, info in members.items():
        if info.compress_type != zipfile.ZIP_STORED:
            raise CheckpointError(f"{path}: {name!r} is compressed, which torch never does; the file is refused.")
        if name.endswith(".pkl") and info.file_size > _MAX_PICKLE_BYTES:
            raise CheckpointError(f"{path}: {name!r} has {info.file_size:,} bytes, far beyond a list of tensors.")
        if name.endswith("/data.pkl"):
            _check_ingredients(read_member(path, info), path)
        if name.endswith("/byteorder") and read_member(path, info) != b"little":
            raise CheckpointError(f"{path} was saved on a big-endian machine, which is not supported.")
    try:
        loaded = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # a damaged pickle makes torch raise nearly anything
        raise_refusal(error, path)
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise CheckpointError(
            f"{path} is no plain torch state dict, and nothing else is read from pickles ({reason})."
        ) from error
    if not isinstance(loaded, Mapping) or not all(
        isinstance(k, str) and isinstance(v, Tensor) for k, v in loaded.items()
    ):
        raise CheckpointError(f"{path} holds a {type(loaded).__name__}, expected a dictionary of named tensors.")
    _check_storages(dict(loaded), members, path)
    return _world_model_from_state(dict(loaded), path)


def _check_ingredients(data: bytes, path: Path) -> None:
    """Read through a pickle without running it, and refuse it if it names anything but the parts of tensors."""
    try:
        for code, argument, _ in pickletools.genops(data):
            named = code.name in ("GLOBAL", "INST", "STACK_GLOBAL", "EXT1", "EXT2", "EXT4")
            if named and argument not in _INGREDIENTS:
                raise CheckpointError(
                    f"{path} is no plain torch state dict: it names {str(argument)!r}, which is not run."
                )
    except Exception as error:  # damaged opcodes raise more than ValueError
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{path} is no plain torch state dict ({error}).") from error


def _check_storages(loaded: dict[str, Tensor], members: dict[str, zipfile.ZipInfo], path: Path) -> None:
    """Refuse tensors that reach beyond the zip's members: the pickle, not the zip, says how long a storage is."""
    claimed: dict[int, int] = {}
    for name, value in loaded.items():
        if value.layout != torch.strided:
            raise CheckpointError(f"{path}: {name!r} is {value.layout}, expected a plain (strided) tensor.")
        storage = value.untyped_storage()
        claimed[storage.data_ptr()] = storage.nbytes()
    stored = sum(info.file_size for name, info in members.items() if "/data/" in name)
    if sum(claimed.values()) != stored:
        raise CheckpointError(
            f"{path}: its tensors claim {sum(claimed.values()):,} bytes, but {stored:,} are stored; it is damaged."
        )


def _original_shapes(model: WorldModel) -> dict[str, tuple[int, ...]]:
    """Names and shapes of an original state dict, convolutions along the scan being one-dimensional there."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, value in model.state_dict().items():
        shape = tuple(value.shape)
        if model.lidar == "1d" and len(shape) == 4:
            shape = (*shape[:2], shape[3])
        shapes[name.replace("vae.", "convVAE.", 1)] = shape
    if isinstance(model.config, TransformerConfig):
        for i in range(model.config.n_blocks):
            shapes[f"blocks.{i}.attn.mask"] = (1, 1, model.config.context, model.config.context)
    return shapes


def _world_model_from_state(loaded: dict[str, Tensor], path: Path) -> WorldModel:
    kind = "transformer" if "pos_emb" in loaded else "joint"
    first = loaded.get("convVAE.encoder.0.weight")
    if first is None:
        raise CheckpointError(f"{path} lacks 'convVAE.encoder.0.weight': it is no released joint or transformer model.")
    lidar = "rings" if first.ndim == 4 else "1d"
    model = checkpoint.make(kind, TransformerConfig(lidar) if kind == "transformer" else JointConfig(lidar))
    assert isinstance(model, WorldModel)
    shapes = _original_shapes(model)
    state: dict[str, Tensor] = {}
    for name, value in loaded.items():
        if name not in shapes:
            raise CheckpointError(f"{path} has weights {name!r}, unknown in a {kind} model for {lidar}.")
        if tuple(value.shape) != shapes[name] or value.dtype != torch.float32:
            raise CheckpointError(
                f"{path}: {name!r} has shape {tuple(value.shape)} and {value.dtype}, expected {shapes[name]} and "
                "float32."
            )
        if not name.endswith("attn.mask"):
            value = value.unsqueeze(2) if value.ndim == 3 and name.startswith("convVAE.") else value
            state[name.replace("convVAE.", "vae.", 1)] = value.clone(memory_format=torch.contiguous_format)
    checkpoint.put_weights(model, state, str(path))
    return model
