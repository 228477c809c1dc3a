"""navrep-data: datasets and pretrained models for robots that navigate among people.

Sub-packages are imported on first use, so that ``import navrep_data`` stays light (no torch, no numba). The gymnasium
ids are registered as strings, without loading gymnasium: ``gymnasium.make("navrep_data:NavRepTest-v0")`` works alone.
"""

from __future__ import annotations

import importlib
from types import ModuleType

from navrep_data._version import __version__
from navrep_data.registration import register_soon

__all__ = [
    "__version__",
    "datasets",
    "envs",
    "errors",
    "evaluate",
    "generate",
    "io",
    "models",
    "observations",
    "schema",
    "shards",
    "sim",
    "testing",
    "train",
    "zoo",
]

register_soon()


def __getattr__(name: str) -> ModuleType:
    if name in __all__:
        return importlib.import_module(f"navrep_data.{name}")
    raise AttributeError(f"module 'navrep_data' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
