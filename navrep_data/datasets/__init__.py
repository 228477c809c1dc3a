"""Datasets for PyTorch over shards: frames, windows, a stream of windows; import of the original's files; the Hub.

Names are imported on first use: what needs no torch (push, pull, import) does not wait for it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from navrep_data.datasets._batch import FIELDS
    from navrep_data.datasets.hub import pull, push
    from navrep_data.datasets.latents import LatentDataset
    from navrep_data.datasets.loading import make_loader
    from navrep_data.datasets.npz import import_npz
    from navrep_data.datasets.rosbag import import_rosbag
    from navrep_data.datasets.scans import ScanDataset
    from navrep_data.datasets.sequences import SequenceDataset
    from navrep_data.datasets.streaming import StreamingSequenceDataset

_HOMES = {
    "FIELDS": "_batch",
    "LatentDataset": "latents",
    "ScanDataset": "scans",
    "SequenceDataset": "sequences",
    "StreamingSequenceDataset": "streaming",
    "import_npz": "npz",
    "import_rosbag": "rosbag",
    "make_loader": "loading",
    "pull": "hub",
    "push": "hub",
}

__all__ = [
    "FIELDS",
    "LatentDataset",
    "ScanDataset",
    "SequenceDataset",
    "StreamingSequenceDataset",
    "import_npz",
    "import_rosbag",
    "make_loader",
    "pull",
    "push",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"navrep_data.datasets.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'navrep_data.datasets' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
