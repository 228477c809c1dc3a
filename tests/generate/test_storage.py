"""Shards behind an fsspec URL: the bytes of a local run, the manifest here and a copy of it there."""

import uuid
from pathlib import Path

import fsspec
import pytest

from navrep_data.errors import ConfigError, DatasetError, FolderInUseError, FolderNotWritableError, MissingExtraError
from navrep_data.generate import executors, generate, storage
from navrep_data.shards import verify

SMALL = {"humans": 4, "obstacles": 3, "length": 30, "shard_size": 2, "seed": 5}


def tree(root):
    return {
        p.relative_to(root).as_posix(): p.read_bytes()
        for p in sorted(Path(root).rglob("*"))
        if p.is_file() and p.name != ".navrep-data.lock"
    }


def remote(url):
    fs, base = fsspec.core.url_to_fs(url)
    return {path.removeprefix(base + "/"): fs.cat_file(path) for path in fs.find(base)}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    root = tmp_path_factory.mktemp("whole") / "d"
    generate(n=7, out=root, **SMALL)
    return tree(root)


@pytest.fixture
def url():
    return f"memory://{uuid.uuid4().hex}/d"


@pytest.mark.slow
def test_the_place_holds_the_dataset_of_a_local_run(tmp_path, url, whole):
    result = generate(n=7, out=tmp_path / "d", storage=url, **SMALL)
    assert (result.sequences, result.new_rows) == (7, 210)
    assert remote(url) == whole
    assert tree(tmp_path / "d") == {name: whole[name] for name in ("README.md", "manifest.json")}
    copy = tmp_path / "copy"
    fs, base = fsspec.core.url_to_fs(url)
    fs.get(base, str(copy), recursive=True)
    assert verify(copy).ok


@pytest.mark.slow
def test_interrupted_and_extended(tmp_path, url, whole, monkeypatch):
    real, made = executors.make_shard, []

    def interrupted(*args):
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(real(*args))
        return made[-1]

    monkeypatch.setattr(executors, "make_shard", interrupted)
    with pytest.raises(KeyboardInterrupt):
        generate(n=5, out=tmp_path / "d", storage=url, **SMALL)
    monkeypatch.setattr(executors, "make_shard", real)
    assert "manifest.json" not in remote(url)  # nothing there calls itself a dataset yet
    assert generate(n=5, out=tmp_path / "d", storage=url, **SMALL).new_rows == 60
    # the last shard for training grows from one sequence to two: it is made aside, then moved over the old one
    assert generate(n=7, out=tmp_path / "d", storage=url, **SMALL).new_rows == 60
    assert remote(url) == whole


@pytest.mark.slow
def test_what_is_lost_there_is_made_again(tmp_path, url, whole):
    generate(n=7, out=tmp_path / "d", storage=url, **SMALL)
    fs, base = fsspec.core.url_to_fs(url)
    fs.rm(f"{base}/data/train-00001.h5")
    fs.pipe_file(f"{base}/worlds/val-00000.npz", b"cut")
    lines = []
    assert generate(n=7, out=tmp_path / "d", storage=url, report=lines.append, **SMALL).new_rows == 90
    assert [line for line in lines if "making it again" in line]
    assert remote(url) == whole


def test_another_dataset_there_is_left_alone(tmp_path, url):
    generate(n=2, out=tmp_path / "a", storage=url, **SMALL)
    before = remote(url)
    with pytest.raises(FolderInUseError, match="holds a dataset already"):
        generate(n=2, out=tmp_path / "b", storage=url, **{**SMALL, "seed": 6})
    assert remote(url) == before
    assert not (tmp_path / "b").exists()


@pytest.mark.slow
def test_workers_whose_files_cannot_be_seen_from_here(tmp_path, url, monkeypatch):
    """memory:// is a place of each process's own: a run must not end well with its shards gone."""
    monkeypatch.setattr(storage, "VISIBLE_SECONDS", 0.1)
    monkeypatch.setattr(storage.UrlStore, "intact", lambda *_, **__: False)
    with pytest.raises(DatasetError, match="from here it cannot be seen in memory://"):
        generate(n=2, out=tmp_path / "d", storage=url, **SMALL)


@pytest.mark.parametrize(
    ("url", "error", "message"),
    [
        ("data/shared", ConfigError, "a folder that all nodes share is given by --out"),
        ("file://data/shared", ConfigError, "expected a whole path: file:///"),
        ("nosuch://x", ConfigError, "Protocol not known: nosuch"),
        ("s3://bucket/name", MissingExtraError, "s3fs"),
    ],
)
def test_places_that_cannot_be_used(tmp_path, url, error, message):
    if error is MissingExtraError and "s3" in fsspec.available_protocols():
        try:
            fsspec.get_filesystem_class("s3")
            pytest.skip("s3fs is installed")
        except ImportError:
            pass
    with pytest.raises(error, match=message):
        generate(n=2, out=tmp_path / "d", storage=url, **SMALL)
    assert not (tmp_path / "d").exists()


def test_a_place_that_refuses_is_one_line(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(FolderNotWritableError, match=r"Cannot write worlds/train-00000\.npz to file://"):
        generate(n=2, out=tmp_path / "d", storage=f"file://{tmp_path}/file/d", **SMALL)


@pytest.mark.slow
def test_two_processes_write_through_a_url(tmp_path, whole):
    url = f"dir://there::file://{tmp_path}"
    generate(n=7, out=tmp_path / "d", storage=url, workers=2, **SMALL)
    assert tree(tmp_path / "there") == whole
