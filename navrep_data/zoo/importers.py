"""Readers of the files that the NavRep authors released. Nothing in them is ever unpickled or run.

Three formats: integer JSON lists (V and M, TensorFlow's order), torch state dicts (joint and transformer), and zips of
stable-baselines 2 (controllers and end-to-end networks). Each is measured against what a network of that kind needs
before it is read, so that a bomb or a huge file costs nothing.
"""

from __future__ import annotations

from pathlib import Path

from torch import nn

from navrep_data.errors import CheckpointError
from navrep_data.models import checkpoint
from navrep_data.sb3_file import refuse_sb3_file
from navrep_data.zoo.importers_bounds import opened, zip_members
from navrep_data.zoo.importers_sb2 import load_controller_zip
from navrep_data.zoo.importers_tf import load_tf_json
from navrep_data.zoo.importers_torch import load_torch_world_model

__all__ = ["load_any", "load_controller_zip", "load_tf_json", "load_torch_world_model"]


def load_any(path: Path | str) -> nn.Module:
    """Read a file in any of the formats, told apart by its first bytes and its contents.

    Parameters
    ----------
    path : path-like
        A released file, or a checkpoint of this package.

    Returns
    -------
    nn.Module
        The network, in eval mode.

    Raises
    ------
    CheckpointError
        If it is none of them, or broken.
    PolicyError
        If it is a file of stable-baselines3.
    """
    path = Path(path)
    refuse_sb3_file(path)
    if path.is_dir() or path.suffix == ".safetensors":
        return checkpoint.load(path)
    with opened(path) as handle:
        first = handle.read(4)
    if first[:2] == b"PK":
        members = zip_members(path, path.stat().st_size)
        return load_controller_zip(path) if "parameter_list" in members else load_torch_world_model(path)
    if first[:1] == b"[":
        return load_tf_json(path, None)
    if first[:1] == b"{":
        return checkpoint.load(path)
    raise CheckpointError(
        f"{path} is no file of weights that can be read: expected a V or M JSON, a zip of stable-baselines 2, a torch "
        "state dict in zip format, or safetensors with JSON. Pickles are never read."
    )
