"""Datasets for PyTorch over shards: frames, windows, a stream of windows; import of the original's files."""

from __future__ import annotations

from navrep_data.datasets._batch import FIELDS
from navrep_data.datasets.latents import LatentDataset
from navrep_data.datasets.loading import make_loader
from navrep_data.datasets.npz import import_npz
from navrep_data.datasets.scans import ScanDataset
from navrep_data.datasets.sequences import SequenceDataset
from navrep_data.datasets.streaming import StreamingSequenceDataset

__all__ = [
    "FIELDS",
    "LatentDataset",
    "ScanDataset",
    "SequenceDataset",
    "StreamingSequenceDataset",
    "import_npz",
    "make_loader",
]
