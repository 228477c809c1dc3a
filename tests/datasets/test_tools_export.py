"""What leaves in other formats: the original's npz, equal for what came in that way, and Minari."""

from __future__ import annotations

import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from recorded import write_original_npz
from test_import_npz import sequence, write

from navrep_data.datasets import import_npz
from navrep_data.datasets.tools import export, filter, original_arrays
from navrep_data.errors import ConfigError, DiskSpaceError, FolderInUseError, MissingExtraError
from navrep_data.schema import Event
from navrep_data.shards import DatasetFolder, Manifest
from navrep_data.testing import tiny_dataset


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("export") / "d", n=3, length=200)


def columns_of(root, number):
    with DatasetFolder(root) as folder:
        for k, entry in enumerate(folder.manifest.shards):
            mine = np.flatnonzero(folder.read("sequence", k, 0, entry.rows) == number)
            if len(mine):
                return {c: folder.read(c, k, mine[0], mine[-1] + 1) for c in folder.manifest.columns}
    raise AssertionError(number)


def check_equal(folder, source):
    """File by file, array by array: values, dtypes, shapes."""
    before, after = sorted(Path(source).iterdir()), sorted(Path(folder).iterdir())
    assert [p.name for p in before] == [p.name for p in after]
    for a, b in zip(before, after, strict=True):
        with np.load(a, allow_pickle=False) as old, np.load(b, allow_pickle=False) as new:
            assert old.files == new.files
            for name in old.files:
                np.testing.assert_array_equal(new[name], old[name], err_msg=f"{a.name} {name}", strict=True)


def test_imports_go_out_as_they_came(tmp_path):
    one = sequence(seed=1)
    one["robotstates"][::4, :2] = np.nan
    source = write(tmp_path / "in", one, sequence(51, unplayed=(30,), seed=2), sequence(1, (), (), (), (), seed=3))
    import_npz(source, tmp_path / "d")
    result = export(tmp_path / "d", tmp_path / "out", format="npz")
    check_equal(tmp_path / "out", source)
    # written by the same numpy, they are the same files
    for path in source.iterdir():
        assert (tmp_path / "out" / path.name).read_bytes() == path.read_bytes()
    assert (result.files, result.rows, result.skipped) == (3, 112, 0)
    assert result.bytes == sum(p.stat().st_size for p in source.iterdir())


@pytest.mark.slow
def test_the_original_files_go_out_as_they_came(tmp_path):
    original = write_original_npz(tmp_path / "original")
    import_npz(original, tmp_path / "d")
    export(tmp_path / "d", tmp_path / "out", format="npz")
    check_equal(tmp_path / "out", original)


def test_an_end_is_not_lost_with_the_frame_that_told_of_it(tmp_path):
    """`stuck` is followed by a frame that alone was marked as done; once that is filtered away, the end itself is."""
    import_npz(write(tmp_path / "in", sequence()), tmp_path / "d")
    whole = original_arrays(columns_of(tmp_path / "d", 0))["dones"]
    assert not whole[49]
    assert whole[50]
    filter(tmp_path / "d", tmp_path / "stuck", outcomes=["stuck"])
    export(tmp_path / "stuck", tmp_path / "out", format="npz")
    (path,) = (tmp_path / "out").iterdir()
    with np.load(path) as arrays:
        assert arrays["dones"].tolist() == [False] * (len(arrays["dones"]) - 1) + [True]


@pytest.mark.slow
def test_generated_rows_survive_export_and_import(generated, tmp_path):
    export(generated, tmp_path / "out", format="npz")
    import_npz(tmp_path / "out", tmp_path / "again")
    for number in range(3):
        old, new = columns_of(generated, number), columns_of(tmp_path / "again", number)
        for name in ("robot_state", "action", "reward", "is_first", "is_last", "rings", "episode", "step"):
            np.testing.assert_array_equal(new[name], old[name], err_msg=name)
        np.testing.assert_array_equal(new["scan"], old["scan"].astype(np.float32) / np.float32(1000))
        # what led to a row is what was taken from the one before
        led = np.flatnonzero(~old["is_first"])
        np.testing.assert_array_equal(new["leading_action"][led], old["action"][led - 1])
        assert not new["leading_action"][old["is_first"]].any()


@pytest.mark.slow
def test_names_sort_like_sequences(tmp_path, monkeypatch):
    from navrep_data.datasets.tools import exports

    import_npz(write(tmp_path / "in", *(sequence(2, (), (), (), (), seed=k) for k in range(12))), tmp_path / "d")
    monkeypatch.setattr(exports, "MIN_DIGITS", 1)
    export(tmp_path / "d", tmp_path / "out", format="npz")
    import_npz(tmp_path / "out", tmp_path / "again")
    assert Manifest.read(tmp_path / "again").shards[0].sequence_hashes == (
        Manifest.read(tmp_path / "d").shards[0].sequence_hashes
    )


@pytest.mark.slow
def test_minari(generated, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    seen = []
    result = export(generated, tmp_path / "out", format="minari", progress=lambda *a: seen.append(a))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert result.dataset_id == "navrep-data/soadrl-v0"
    before = dict(os.environ)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "out"))
    dataset = minari.load_dataset(result.dataset_id)
    expected = []
    manifest = Manifest.read(generated)
    for number in range(3):
        columns = columns_of(generated, number)
        for episode in range(columns["episode"][-1] + 1):
            rows = columns["episode"] == episode
            if rows.sum() > 1:
                expected.append((manifest.split_of(number), {c: v[rows] for c, v in columns.items()}))
    assert len(dataset) == result.episodes == len(expected)
    assert result.rows == sum(len(rows["step"]) for _, rows in expected)
    metadata = list(dataset.storage.get_episode_metadata(range(len(dataset))))
    for found, about, (split, rows) in zip(dataset, metadata, expected, strict=True):
        assert about["split"] == split
        np.testing.assert_array_equal(found.observations["scan"], rows["scan"].astype(np.float32) / np.float32(1000))
        np.testing.assert_array_equal(found.observations["robot_state"], rows["robot_state"])
        np.testing.assert_array_equal(found.actions, rows["action"][:-1])
        np.testing.assert_array_equal(found.rewards, rows["reward"][:-1])
        np.testing.assert_array_equal(found.infos["humans"], rows["humans"])
        terminal = Event(rows["event"][-1]).terminal
        assert (bool(found.terminations[-1]), bool(found.truncations[-1])) == (terminal, not terminal)
        assert not found.terminations[:-1].any()
        assert not found.truncations[:-1].any()
        assert dataset.spec.observation_space["scan"].contains(found.observations["scan"][0])
    assert {k: v for k, v in os.environ.items() if k != "MINARI_DATASETS_PATH"} == {
        k: v for k, v in before.items() if k != "MINARI_DATASETS_PATH"
    }


@pytest.mark.slow
def test_minari_has_no_place_for_episodes_without_an_action(tmp_path):
    pytest.importorskip("minari")
    import_npz(write(tmp_path / "in", sequence()), tmp_path / "d")
    result = export(tmp_path / "d", tmp_path / "out", format="minari", dataset_id="mine/irl-v3")
    assert (tmp_path / "out" / "mine" / "irl-v3" / "data" / "main_data.hdf5").is_file()
    with DatasetFolder(tmp_path / "d") as folder:
        assert result.skipped == (folder.episodes.length == 1).sum() == 2
        assert result.episodes + result.skipped == len(folder.episodes)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"format": "minary"}, "Unknown format 'minary'; expected npz or minari. Did you mean 'minari'"),
        ({"format": "npz", "dataset_id": "a-v0"}, "is for Minari; leave it out"),
        ({"format": "minari", "dataset_id": "../../a-v0"}, "is no name for Minari; expected namespace/name-v0"),
        ({"format": "minari", "dataset_id": "soadrl"}, "is no name for Minari"),
    ],
)
def test_settings_that_cannot_be_used(generated, tmp_path, settings, words):
    with pytest.raises(ConfigError, match=words):
        export(generated, tmp_path / "out", **settings)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(generated, tmp_path):
    with pytest.raises(FolderInUseError, match="export never overwrites"):
        export(generated, generated, format="npz")


def test_minari_is_optional(generated, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "minari", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'navrep-data\[minari\]'"):
        export(generated, tmp_path / "out", format="minari")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_minari_takes_a_relative_folder(generated, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    result = export(os.path.relpath(generated, tmp_path), "minari", format="minari")
    assert result.root == "minari"
    monkeypatch.setenv("MINARI_DATASETS_PATH", "minari")
    assert len(minari.load_dataset(result.dataset_id)) == result.episodes
    assert [p.name for p in tmp_path.iterdir()] == ["minari"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="bounds the size of files as Linux does")
def test_a_full_disk_is_one_line_and_leaves_nothing(generated, tmp_path):
    """The HDF5 library fails while it closes its file, and crashes its process afterwards."""
    pytest.importorskip("minari")
    program = (
        "import resource, sys\nresource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "from navrep_data.cli.main import run\nrun(sys.argv[1:])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "export", generated, "--format", "minari", "--out", tmp_path / "out"],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert done.stderr.startswith("Error: No room left while writing ")
    assert list(tmp_path.iterdir()) == []


def test_space_for_minari_is_checked_before_anything_is_written(generated, tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setattr("shutil.disk_usage", lambda _: types.SimpleNamespace(free=1000))
    with pytest.raises(DiskSpaceError, match="1,000 are free"):
        export(generated, tmp_path / "out", format="minari")
    assert list(tmp_path.iterdir()) == []
