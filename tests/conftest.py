"""Fixtures for all tests; and no test reaches another machine."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "no_network"))

import loopback_only

loopback_only.install()

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference material beside the checkout."""
    if not (SHARED / "reference").is_dir():
        pytest.skip("needs ../shared (reference material, not part of the repository)")
    return SHARED
