"""Fixtures for all tests; and no test reaches another machine."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "no_network"))

import loopback_only
from recorded import AUTHORS

loopback_only.install()


@pytest.fixture(scope="session")
def released() -> Path:
    """The folder with the NavRep authors' weights, which are not part of the repository."""
    if not (AUTHORS / "models" / "gym").is_dir():
        pytest.skip("needs the authors' weights: let NAVREP_RELEASED_DIR name a checkout of their repository")
    return AUTHORS
