"""Examples run as a user would run them."""

import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from navrep_data.testing import tiny_dataset

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("examples") / "d")


def run(script, *arguments):
    done = subprocess.run(
        [sys.executable, EXAMPLES / script, *map(str, arguments)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("lidar", ["rings", "1d"])
def test_load_windows(root, lidar):
    out = run("load_windows.py", root, "--lidar", lidar, "--batch-size", 4)
    assert "robot_state    (4, 32, 5)" in out
    assert "windows/s" in out


@pytest.mark.slow
def test_picture(root, tmp_path):
    run("picture.py", root, "--out", tmp_path / "p.png")
    image = Image.open(tmp_path / "p.png")
    assert image.size == (1210, 660)
    assert len(image.convert("RGB").getcolors(1 << 20)) > 50
