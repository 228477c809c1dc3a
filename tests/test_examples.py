"""Examples run as a user would run them."""

from pathlib import Path

import pytest
import warm_process
from PIL import Image

from navrep_data.testing import tiny_dataset

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("examples") / "d")


def run(script, *arguments):
    done = warm_process.shared().run([EXAMPLES / script, *arguments])
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


@pytest.mark.slow
def test_gallery(tmp_path):
    out = run("gallery.py", "--out", tmp_path / "g.png", "--only", "NavRepTrain", "CADRL", "SOADRL")
    assert "3 environments" in out
    image = Image.open(tmp_path / "g.png").convert("RGB")
    assert image.size == (3 * 260, 272)
    assert len(image.getcolors(1 << 20)) > 30


@pytest.mark.slow
def test_own_policy(tmp_path):
    out = run("own_policy.py", "--episodes", 20, "--film", tmp_path / "e.gif")
    assert out.startswith("20 episodes: ")
    assert "goal" in out
    with Image.open(tmp_path / "e.gif") as film:
        assert film.n_frames > 5


@pytest.mark.slow
def test_own_sensor(tmp_path):
    out = run("own_sensor.py", "--out", tmp_path / "s.png")
    assert "(240,) -> (1080,)" in out
    with Image.open(tmp_path / "s.png") as image:
        assert image.size == (900, 450)


@pytest.mark.slow
def test_own_map(tmp_path):
    out = run("own_map.py", "--draw", tmp_path / "office", "--episodes", 2, "--film", tmp_path / "e.gif")
    assert "240 x 240 cells of 0.05 m" in out
    with Image.open(tmp_path / "e.gif") as film:
        assert film.n_frames > 5


@pytest.mark.slow
def test_several_robots(tmp_path):
    out = run("several_robots.py", "--robots", 4, "--episodes", 2, "--out", tmp_path / "r.gif")
    assert out.count("after") == 2
    with Image.open(tmp_path / "r.gif") as film:
        assert film.n_frames > 3


@pytest.mark.slow
def test_drive(tmp_path):
    import torch

    from navrep_data.models import checkpoint

    torch.manual_seed(0)
    checkpoint.save(checkpoint.make("e2e", {"lidar": "1d"}), tmp_path / "mine")
    out = run("drive.py", "--policy", tmp_path / "mine", "--max-steps", 4, "--out", tmp_path / "d.gif")
    with Image.open(tmp_path / "d.gif") as film:
        assert film.n_frames >= 4
    assert "d.gif" in out
