"""Make policies of this folder importable by name; skip what needs the maps."""

import sys
from pathlib import Path

import pytest

from navrep_data.errors import MissingExtraError
from navrep_data.sim._maps import packaged_folder

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def maps():
    """The paper's maps are installed."""
    try:
        return packaged_folder()
    except MissingExtraError:
        pytest.skip("needs the extra navrep-data[maps]")
