"""A map to drive on."""

import pytest
from PIL import Image


@pytest.fixture
def hall(tmp_path):
    """Return settings of an environment in a free hall of 20 x 20 m without people."""
    folder = tmp_path / "hall"
    folder.mkdir()
    Image.new("L", (100, 100), 254).save(folder / "m.png")
    (folder / "m.yaml").write_text(
        "image: m.png\nresolution: 0.2\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return {"maps": (str(folder),), "humans": 0}
