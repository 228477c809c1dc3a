"""What a shard says of its own making, read without a manifest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

from navrep_data.errors import CorruptDataError
from navrep_data.io import raise_refusal
from navrep_data.schema import FORMAT_NAME
from navrep_data.shards._attributes import read_attribute

_NAMES = ("format", "env", "config", "seed", "length", "made_by")


@dataclass(frozen=True)
class ShardRecipe:
    """The settings in a shard's attributes.

    Attributes
    ----------
    env : str
        Environment name.
    config : dict
        The whole configuration.
    seed : int
        Dataset seed.
    length : int
        Rows of a sequence.
    made_by : str
        See ``made_by`` in this module; empty where a shard was not generated.
    """

    env: str
    config: dict[str, Any]
    seed: int
    length: int
    made_by: str = ""


def made_by(policy: Mapping[str, Any], inputs: Mapping[str, str], scan_dtype: str, columns: Sequence[str]) -> str:
    """Return a SHA-256 over what decides rows beside environment, settings and seed: a shard's attribute ``made_by``.

    Parameters
    ----------
    policy, inputs, scan_dtype, columns
        As in the manifest; of `inputs` what was hashed counts, not what it is called.
    """
    values = [policy, sorted(inputs.values()), scan_dtype, list(columns)]
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def read_recipe(path: Path | str) -> ShardRecipe:
    """Read the settings from a shard's attributes.

    Parameters
    ----------
    path : path-like
        A shard.

    Raises
    ------
    CorruptDataError
        If the file is no shard, or cut off.
    """
    try:
        with h5py.File(path, "r") as file:
            values = {name: read_attribute(file, name) for name in _NAMES}
        if values["format"] != FORMAT_NAME:
            raise ValueError("its attributes are not those of a shard")
        return ShardRecipe(
            str(values["env"]), json.loads(values["config"]), int(values["seed"]), int(values["length"]),
            str(values["made_by"] or ""),
        )  # fmt: skip
    except Exception as error:  # a damaged file makes the HDF5 library raise nearly anything
        raise_refusal(error, path)
        raise CorruptDataError(f"{path} cannot be read as a shard ({error}); get it again or make it again.") from error
