"""verify finds what is wrong: flipped bytes anywhere, and files that are intact but mean something else."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from navrep_data.errors import DatasetNotFoundError, NavrepDataError
from navrep_data.io import sha256_bytes
from navrep_data.shards import Manifest, ShardEntry, dataset_card, publish, verify
from navrep_data.shards import writer as writer_module

from .synthetic import make_dataset, make_sequence, make_writer


def test_an_intact_dataset_has_no_problems(dataset):
    calls = []
    report = verify(dataset, progress=lambda k, n: calls.append((k, n)))
    assert report.problems == []
    assert report.ok
    assert (report.shards, report.rows, report.sequences, calls) == (2, 600, 6, [(1, 2), (2, 2)])
    assert report.to_dict()["ok"] is True


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{"scan_dtype": "float32"}, {"worlds": False}])
def test_intact_variants(tmp_path, changes):
    make_dataset(tmp_path, 4, 2, 50, **changes)
    assert verify(tmp_path).problems == []


def found(root) -> list[str]:
    """The files that verify complains about; the manifest where it cannot even be read."""
    try:
        return [p.file for p in verify(root).problems]
    except NavrepDataError as error:
        return ["manifest.json"] if re.search(r"manifest\.json|format version", str(error)) else []


def flip_everywhere(root, per_file: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    files = sorted(p for p in root.rglob("*") if p.is_file())
    assert {p.suffix for p in files} >= {".h5", ".npz", ".json", ".md"}
    for path in files:
        data = path.read_bytes()
        edges = [0, 1, len(data) - 2, len(data) - 1]
        for at in [*edges, *rng.integers(0, len(data), per_file)]:
            bad = bytearray(data)
            bad[at] ^= 1 << int(rng.integers(8))
            path.write_bytes(bad)
            assert path.relative_to(root).as_posix() in found(root), (path.name, at)
        path.write_bytes(data)
    assert found(root) == []


def test_flipped_bytes_are_found(dataset):
    flip_everywhere(dataset, 4, 0)


@pytest.mark.slow
def test_hundreds_of_flipped_bytes_are_found(tmp_path):
    make_dataset(tmp_path, 3, 2, 10)
    flip_everywhere(tmp_path, 50, 1)


def test_missing_unlisted_truncated(dataset):
    shard, worlds = dataset / "data/train-00001.h5", dataset / "worlds/train-00000.npz"
    (dataset / "data/train-00007.h5").write_bytes(b"x")
    shard.write_bytes(shard.read_bytes()[:-100])
    worlds.unlink()
    (dataset / "README.md").unlink()
    problems = {p.file: p.what for p in verify(dataset).problems}
    assert "not in the manifest" in problems["data/train-00007.h5"]
    assert "bytes, expected" in problems["data/train-00001.h5"]
    assert "missing" in problems["worlds/train-00000.npz"]
    assert "missing" in problems["README.md"]
    assert all("\n" not in what for what in problems.values())
    with pytest.raises(DatasetNotFoundError):
        verify(dataset / "data")


def spoil(root, monkeypatch, change):
    """Write shard 0 again, its first sequence changed and its hashes right: only its meaning is wrong."""
    monkeypatch.setattr(writer_module, "check_index", lambda *_: "")
    monkeypatch.setattr(writer_module, "check_finite", lambda *_: "")
    monkeypatch.setattr(writer_module, "check_labels", lambda *_: "")
    manifest = Manifest.read(root)
    writer = make_writer()
    for k in range(3):
        columns, worlds = make_sequence(k)
        if k == 0:
            change(columns)
        writer.append(k, columns, worlds)
    # The old statistics: those of infinity are no JSON.
    entry = replace(publish(root, 0, writer.finish()), statistics=manifest.shards[0].statistics)
    manifest = manifest.with_shards([entry, *manifest.shards[1:]], complete=True)
    manifest.save(root, card=dataset_card(manifest))


def set_at(name, index, value):
    return lambda c: c[name].__setitem__(index, value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "match"),
    [
        (set_at("scan", (3, 4), 25001), "beyond range_max"),
        (set_at("rings", (5, 6), 1), "scan_to_rings"),
        (set_at("robot_state", (0, 0), np.inf), "'robot_state' holds NaN or infinity"),
        (set_at("action", (0, 1), np.nan), "'action' holds NaN"),
        (set_at("action", -1, 1.0), "'action' is not 0"),
        (set_at("reward", -1, 1.0), "'reward' is not 0"),
        (set_at("step", 1, 5), "'step'"),
        (set_at("episode", slice(None), 1), "'episode'"),
        (set_at("sequence", slice(40, None), 1), "whole episodes"),
        (set_at("is_last", -1, False), "whole episodes"),
        (set_at("event", 0, 1), "'event'"),
        (set_at("is_terminal", 0, True), "'is_terminal'"),
        (set_at("humans", (0, 0, 4), np.nan), "NaN in part"),
        (set_at("humans", (slice(None), -1), 1.0), "behind an empty one"),
        (set_at("humans", (1, 0), np.nan), "behind an empty one|changes its number"),
        (set_at("humans", (0, 0, 4), -1.0), "radius"),
        (set_at("humans", (0, 0, 5), 0.5), "visible"),
    ],
)
def test_wrong_content_behind_right_hashes(dataset, monkeypatch, change, match):
    columns, _ = make_sequence(0)
    assert np.isfinite(columns["humans"][:2, 0]).all(), "these cases need a human in the first slot"
    monkeypatch.setattr(writer_module.ShardWriter, "_check_worlds", staticmethod(lambda *_: None))
    spoil(dataset, monkeypatch, change)
    problems = [p for p in verify(dataset).problems if p.file == "data/train-00000.h5"]
    assert any(re.search(match, p.what) for p in problems), problems


def test_wrong_sequence_hash_and_statistics(dataset):
    manifest = Manifest.read(dataset)
    entry = manifest.shards[0]
    hashes = (entry.sequence_hashes[0], "0" * 64, entry.sequence_hashes[2])
    statistics = {
        **entry.statistics,
        "humans_per_episode": manifest.shards[1].statistics["humans_per_episode"],
    }
    wrong = replace(entry, sequence_hashes=hashes, statistics=statistics)
    manifest = manifest.with_shards([wrong, manifest.shards[1]], complete=True)
    manifest.save(dataset, card=dataset_card(manifest))
    problems = [str(p) for p in verify(dataset).problems]
    assert any("sequence 1: its content differs" in p for p in problems)
    assert any("statistics" in p for p in problems)
    assert len(problems) == 2


def test_swapped_worlds_and_a_hostile_shard(dataset):
    manifest = Manifest.read(dataset)
    a, b = manifest.shards
    paths = [dataset / shard.worlds.file for shard in (a, b)]
    for path, data in zip(paths, [path.read_bytes() for path in reversed(paths)], strict=True):
        path.write_bytes(data)
    swapped = [replace(one, worlds=replace(other.worlds, file=one.worlds.file)) for one, other in ((a, b), (b, a))]
    manifest.with_shards(swapped, complete=False).save(dataset)
    assert {p.what for p in verify(dataset).problems} == {"its episodes are not those of the shard"}
    data = b"\x89HDF\r\n\x1a\n" + b"\0" * 500
    (dataset / a.file).write_bytes(data)
    wrong: ShardEntry = replace(a, sha256=sha256_bytes(data), bytes=len(data))
    manifest.with_shards([wrong, b], complete=False).save(dataset)
    assert any("not readable as HDF5" in p.what for p in verify(dataset).problems)
