from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from .synthetic import make_dataset


@pytest.fixture(scope="session")
def dataset_template(tmp_path_factory):
    """A dataset that no test may change."""
    root = tmp_path_factory.mktemp("template") / "soadrl"
    make_dataset(root)
    return root


@pytest.fixture
def dataset(dataset_template, tmp_path) -> Path:
    """A dataset of its own for each test."""
    return Path(shutil.copytree(dataset_template, tmp_path / "soadrl"))
