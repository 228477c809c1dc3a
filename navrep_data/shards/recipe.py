"""What a shard says of its own making, read without a manifest."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

from navrep_data.errors import CorruptDataError
from navrep_data.io import raise_refusal
from navrep_data.schema import FORMAT_NAME
from navrep_data.shards._attributes import read_attribute


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
    """

    env: str
    config: dict[str, Any]
    seed: int
    length: int


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
            values = {name: read_attribute(file, name) for name in ("format", "env", "config", "seed", "length")}
        if values["format"] != FORMAT_NAME:
            raise ValueError("its attributes are not those of a shard")
        return ShardRecipe(str(values["env"]), json.loads(values["config"]), int(values["seed"]), int(values["length"]))
    except Exception as error:  # a damaged file makes the HDF5 library raise nearly anything
        raise_refusal(error, path)
        raise CorruptDataError(f"{path} cannot be read as a shard ({error}); get it again or make it again.") from error
