"""New folders appear whole or not at all, wherever they are to be."""

import os
import subprocess
import sys

import pytest

from navrep_data.errors import DatasetNotFoundError, FolderInUseError
from navrep_data.io import folders, new_folder
from navrep_data.shards import Manifest

NAMES = ("README.md", "data", "manifest.json", "worlds")


def fill(part):
    for name in NAMES:
        (part / name).mkdir() if "." not in name else (part / name).write_text("{}")


def make(out):
    with new_folder(out, what="a test") as part:
        assert list(part.iterdir()) == []
        fill(part)


@pytest.fixture(params=["new", "empty", "here", "link", "mount point", "parent not writable"])
def place(request, tmp_path, monkeypatch):
    """A folder to be filled, as it is given on the command line, and where that is."""
    monkeypatch.chdir(tmp_path)
    real = tmp_path / "real"
    if request.param != "new":
        real.mkdir()
    if request.param == "here":
        monkeypatch.chdir(real)
        return ".", real
    if request.param == "link":
        (tmp_path / "link").symlink_to(real)
        return "link", real
    if request.param == "mount point":
        monkeypatch.setattr(folders.os.path, "ismount", lambda path: os.fspath(path) == "real")
    if request.param == "parent not writable":
        monkeypatch.setattr(folders.os, "access", lambda path, _: path != tmp_path)
    return "real", real


def test_a_folder_is_filled_wherever_it_is(place, tmp_path):
    out, real = place
    kept = real.stat().st_ino if real.exists() else None
    stays = kept is not None and not folders._replaceable(folders.Path(out))
    make(out)
    assert sorted(p.name for p in real.iterdir()) == sorted(NAMES)
    assert os.path.samefile(out, real)
    if stays:
        assert real.stat().st_ino == kept
    assert {p.name for p in tmp_path.iterdir()} <= {"real", "link"}


def test_what_fails_leaves_it_as_it_was(place, tmp_path, monkeypatch):
    out, real = place
    there = real.exists()

    def fail(self, target):
        if self.name in ("manifest.json", "real.part"):
            raise OSError(5, "Input/output error")
        os.rename(self, target)

    monkeypatch.setattr(folders.Path, "rename", fail)
    with pytest.raises(OSError, match="Input/output"):
        make(out)
    assert real.exists() == there
    assert not there or list(real.iterdir()) == []
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.slow
@pytest.mark.parametrize("after", range(len(NAMES)))
def test_killed_while_it_is_filled_it_holds_no_dataset(tmp_path, after):
    program = (
        "import os\nfrom navrep_data.io import folders\nrename = folders.Path.rename\n"
        f"left, names = [{after}], {NAMES}\n"
        "def killed(self, target):\n    left[0] -= 1\n    os._exit(9) if left[0] < 0 else rename(self, target)\n"
        "folders.Path.rename = killed\n"
        "with folders.new_folder('.') as part:\n"
        "    for name in names:\n"
        "        (part / name).mkdir() if '.' not in name else (part / name).write_text('{}')\n"
    )
    assert subprocess.run([sys.executable, "-c", program], cwd=tmp_path, timeout=300).returncode == 9
    with pytest.raises(DatasetNotFoundError):
        Manifest.read(tmp_path)
    with pytest.raises(FolderInUseError, match=r"\.part exists, left by a test that was interrupted"):
        make(_reached(tmp_path))


def _reached(folder):
    link = folder.with_name(folder.name + "-link")
    link.symlink_to(folder)
    return link


def test_a_link_to_nowhere_is_refused_before_the_work(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(FolderInUseError, match=r"is a link to .*nowhere, which does not exist"):
        make(tmp_path / "link")
    assert [p.name for p in tmp_path.iterdir()] == ["link"]


def test_what_holds_something_is_never_overwritten(tmp_path, monkeypatch):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("keep")
    (tmp_path / "link").symlink_to(tmp_path / "full")
    (tmp_path / "file").write_text("keep")
    monkeypatch.chdir(tmp_path / "full")
    for out in (".", tmp_path / "full", tmp_path / "link", tmp_path / "file"):
        with pytest.raises(FolderInUseError, match="never overwrites"):
            make(out)
    assert (tmp_path / "full" / "mine.txt").read_text() == (tmp_path / "file").read_text() == "keep"
