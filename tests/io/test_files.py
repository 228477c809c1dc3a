"""Atomic writes, bounded reading, paths that stay inside."""

import errno
import os

import pytest

from navrep_data import io
from navrep_data.errors import CorruptDataError, DatasetError, DiskSpaceError, FolderNotWritableError
from navrep_data.io import _files


def test_atomic_write_replaces_whole_files(tmp_path):
    path = tmp_path / "a.bin"
    io.atomic_write_bytes(path, b"old")
    io.atomic_write_bytes(path, b"new content")
    assert path.read_bytes() == b"new content"
    assert os.listdir(tmp_path) == ["a.bin"]


@pytest.mark.parametrize(
    ("code", "kind", "words"),
    [
        (errno.ENOSPC, DiskSpaceError, "No room left"),
        (errno.EDQUOT, DiskSpaceError, "No room left"),
        (errno.EROFS, FolderNotWritableError, "Cannot write"),
        (errno.EIO, OSError, "boom"),
    ],
)
def test_a_failing_write_leaves_the_old_file(tmp_path, monkeypatch, code, kind, words):
    path = tmp_path / "a.bin"
    io.atomic_write_bytes(path, b"old")

    def fail(_):
        raise OSError(code, "boom")

    monkeypatch.setattr(_files.os, "fsync", fail)
    with pytest.raises(kind, match=words):
        io.atomic_write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("name", ["../a", "/etc/passwd", "a/../../b", "", "c:\\x", "a\\b", "x\0y", "http://a"])
def test_names_from_outside_stay_inside(tmp_path, name):
    with pytest.raises(CorruptDataError, match="points outside"):
        io.safe_join(tmp_path, name)


def test_ordinary_names_are_joined(tmp_path):
    assert io.safe_join(tmp_path, "data/train-00000.h5") == tmp_path / "data" / "train-00000.h5"


def test_json_is_bounded_and_checked(tmp_path):
    path = tmp_path / "a.json"
    io.atomic_write_json(path, {"a": [1, 2.5, "ü"]})
    assert io.read_json(path) == {"a": [1, 2.5, "ü"]}
    with pytest.raises(DatasetError, match="expected at most 5"):
        io.read_json(path, max_bytes=5)
    for bad in (b"{", b"\xff\xfe", b"[" * 100_000):
        path.write_bytes(bad)
        with pytest.raises(CorruptDataError, match="not valid JSON"):
            io.read_json(path)
    with pytest.raises(ValueError, match="Out of range float"):
        io.json_bytes({"a": float("nan")})


def test_hashes_agree(tmp_path):
    data = os.urandom(3 << 20)
    (tmp_path / "a").write_bytes(data)
    assert io.sha256_file(tmp_path / "a") == io.sha256_bytes(data)


def test_cache_folder_follows_the_variable(monkeypatch, tmp_path):
    monkeypatch.setenv("NAVREP_DATA_HOME", str(tmp_path / "x"))
    assert io.cache_dir() == tmp_path / "x"
    assert not (tmp_path / "x").exists()
    monkeypatch.delenv("NAVREP_DATA_HOME")
    assert io.cache_dir().name == "navrep-data"


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_json_with_numbers_that_are_none_is_refused(tmp_path, number):
    (tmp_path / "x.json").write_text(f'{{"a": [1.5, {number}]}}')
    with pytest.raises(CorruptDataError, match=f"not valid JSON.*{number} is not a finite number"):
        io.read_json(tmp_path / "x.json")
