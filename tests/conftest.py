"""Fixtures for all tests."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference material beside the checkout."""
    if not (SHARED / "reference").is_dir():
        pytest.skip("needs ../shared (reference material, not part of the repository)")
    return SHARED
