"""Job arrays: parts made one by one are, once merged, the dataset of a single run; anything else is refused."""

import dataclasses
import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from navrep_data.errors import (
    ConfigError,
    DatasetError,
    DatasetMismatchError,
    DatasetNotFoundError,
    FolderInUseError,
    NavrepDataError,
)
from navrep_data.generate import generate, merge_manifest, parts
from navrep_data.generate.parts import Part, parse_part
from navrep_data.shards import Manifest, verify

SMALL = {"n": 7, "humans": 4, "obstacles": 3, "length": 30, "shard_size": 2, "seed": 5}


def tree(root):
    return {
        p.relative_to(root).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(Path(root).rglob("*"))
        if p.is_file() and p.name != ".navrep-data.lock"
    }


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    root = tmp_path_factory.mktemp("whole") / "d"
    generate(out=root, **SMALL)
    return tree(root)


@pytest.fixture(scope="module")
def three_parts(tmp_path_factory):
    """A folder with the three parts of the same dataset, not merged: of one, two and two shards."""
    root = tmp_path_factory.mktemp("parts") / "d"
    for k in (2, 0, 1):
        result = generate(out=root, shard_range=f"{k}/3", **SMALL)
        assert result.part == f"{k}/3"
        assert result.shards == [1, 2, 2][k]
        assert not (root / "manifest.json").exists()
    return root


@pytest.fixture
def root(three_parts, tmp_path):
    return Path(shutil.copytree(three_parts, tmp_path / "d"))


def test_every_shard_is_in_one_part():
    for total in (0, 1, 4, 7, 100):
        for count in (1, 2, 3, 7, 11):
            shares = [Part(k, count).share(list(range(total))) for k in range(count)]
            assert [s for share in shares for s in share] == list(range(total))
            assert max(map(len, shares)) - min(map(len, shares)) <= 1


@pytest.mark.parametrize("text", ["", "1", "3/3", "4/3", "-1/3", "0/0", "0/10001", "1/3/5", "a/b", "0 / 3", "٣/5"])
def test_what_is_no_range_is_refused(text):
    with pytest.raises(ConfigError, match="expected i/n with i from 0 to n - 1"):
        parse_part(text)


@pytest.mark.slow
def test_merged_parts_are_the_dataset_of_one_run(root, whole):
    merged = merge_manifest(root)
    assert merged.complete
    assert tree(root) == whole
    assert not (root / "parts").exists()
    assert verify(root).ok
    assert merge_manifest(root) == Manifest.read(root)  # again: nothing to do
    assert tree(root) == whole


@pytest.mark.slow
def test_a_merge_that_was_killed_while_cleaning_up(root, whole, tmp_path):
    shutil.copytree(root / "parts" / "0001-of-00003", tmp_path / "left")
    merge_manifest(root)
    (root / "parts").mkdir()
    (tmp_path / "left").rename(root / "parts" / "0001-of-00003")
    merge_manifest(root)
    assert tree(root) == whole


@pytest.mark.slow
def test_a_merged_dataset_can_be_extended(root, tmp_path):
    merge_manifest(root)
    generate(out=root, **{**SMALL, "n": 9})
    generate(out=tmp_path / "nine", **{**SMALL, "n": 9})
    assert tree(root) == tree(tmp_path / "nine")


@pytest.mark.slow
def test_more_jobs_than_shards(tmp_path, whole):
    results = [generate(out=tmp_path / "d", shard_range=f"{k}/6", **SMALL) for k in range(6)]
    assert sorted(r.shards for r in results) == [0, 1, 1, 1, 1, 1]
    merge_manifest(tmp_path / "d")
    assert tree(tmp_path / "d") == whole


def test_an_interrupted_job_goes_on_and_removes_only_its_own_leftovers(tmp_path, whole, monkeypatch):
    from navrep_data.generate import executors

    root, real, made = tmp_path / "d", executors.make_shard, []

    def interrupted(*args):
        if made:
            raise KeyboardInterrupt
        made.append(real(*args))
        return made[-1]

    monkeypatch.setattr(executors, "make_shard", interrupted)
    with pytest.raises(KeyboardInterrupt):
        generate(out=root, shard_range="1/2", **SMALL)
    monkeypatch.setattr(executors, "make_shard", real)
    mine, others = root / "data" / ".test-00000.h5.1.part", root / "data" / ".train-00000.h5.1.part"
    mine.touch()
    others.touch()
    with pytest.raises(DatasetNotFoundError, match=r"Unfinished parts: 0/2 \(no manifest\), 1/2 \(1 of 3 shards\)"):
        merge_manifest(root)
    result = generate(out=root, shard_range="1/2", **SMALL)
    assert (result.shards, result.new_rows) == (3, 60)
    assert (mine.exists(), others.exists()) == (False, True)  # another job may be writing that one just now
    generate(out=root, shard_range="0/2", **SMALL)
    assert not others.exists()
    merge_manifest(root)
    assert tree(root) == whole


def test_merging_early_says_what_is_missing(root):
    before = tree(root)
    shutil.rmtree(root / Part(1, 3).folder)
    with pytest.raises(DatasetNotFoundError, match=r"^Unfinished parts: 1/3 \(no manifest\); expected all 3\."):
        merge_manifest(root)
    assert tree(root).items() <= before.items()  # nothing written, nothing removed
    assert not (root / "manifest.json").exists()


def test_many_missing_parts_are_one_line(tmp_path):
    generate(out=tmp_path / "d", shard_range="0/50", **SMALL)
    with pytest.raises(DatasetNotFoundError, match=r"8/50 \(no manifest\) and 41 more") as caught:
        merge_manifest(tmp_path / "d")
    assert len(str(caught.value)) < 400
    assert "\n" not in str(caught.value)


def edit(root, part, **fields):
    folder = root / part.folder
    dataclasses.replace(Manifest.read(folder), **fields).save(folder)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("seed", 6, "Part 2/3 was made with seed=6, part 0/3 with seed=5"),
        ("planned", 70, "planned=70"),
        ("config", None, "config.n_humans=11"),
        ("versions", None, r"versions.numba=0.1"),
    ],
)
def test_differing_parts_are_refused(root, field, value, message):
    if value is None:
        old = getattr(Manifest.read(root / Part(2, 3).folder), field)
        value = {**old, **({"n_humans": 11} if field == "config" else {"numba": "0.1"})}
    edit(root, Part(2, 3), **{field: value})
    before = tree(root)
    with pytest.raises(DatasetMismatchError, match=message):
        merge_manifest(root)
    assert tree(root) == before


def test_parts_from_another_processor_are_told(root):
    old = Manifest.read(root / Part(1, 3).folder)
    edit(root, Part(1, 3), versions={**old.versions, "cpu": "i486"})
    notes = []
    merge_manifest(root, report=notes.append)
    (note,) = notes
    assert "part 1/3 was made with cpu i486" in note


def test_overlapping_parts_are_refused(root):
    generate(out=root, shard_range="0/2", **SMALL)
    with pytest.raises(DatasetMismatchError, match="parts that overlap: of 2 and of 3"):
        merge_manifest(root)
    shutil.rmtree(root / Part(0, 2).folder)
    first, second = (root / Part(k, 3).folder for k in (0, 1))
    Manifest.read(second).with_shards(Manifest.read(first).shards, complete=False).save(second)
    with pytest.raises(DatasetMismatchError, match=r"Part 1/3 lists data/train-00000\.h5, which is not its own"):
        merge_manifest(root)


def test_a_listed_file_must_be_there(root, whole):
    path = root / "data" / "train-00001.h5"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DatasetError, match=r"train-00001\.h5 is missing or has another size"):
        merge_manifest(root)
    generate(out=root, shard_range="1/3", **SMALL)  # as the message says
    merge_manifest(root)
    assert tree(root) == whole


def test_parts_and_whole_datasets_do_not_mix(root, tmp_path):
    with pytest.raises(FolderInUseError, match=r"holds parts of a job array.*merge-manifest"):
        generate(out=root, **SMALL)
    merge_manifest(root)
    before = tree(root)
    with pytest.raises(DatasetMismatchError, match="is a dataset of 7 sequences already"):
        generate(out=root, shard_range="0/3", **SMALL)
    assert tree(root) == before
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(FolderInUseError, match=r"thesis\.tex"):
        generate(out=tmp_path / "other", shard_range="0/3", **SMALL)
    assert [p.name for p in (tmp_path / "other").iterdir()] == ["thesis.tex"]
    with pytest.raises(DatasetNotFoundError, match="no folder parts"):
        merge_manifest(tmp_path / "other")


def test_a_part_does_not_grow(root):
    before = tree(root)
    with pytest.raises(DatasetMismatchError, match="cannot grow"):
        generate(out=root, shard_range="0/3", **{**SMALL, "n": 8})
    assert tree(root) == before


def test_a_refused_part_leaves_no_trace(tmp_path):
    with pytest.raises(NavrepDataError, match="--storage"):
        generate(out=tmp_path / "d", shard_range="0/3", storage="memory://x", **SMALL)
    with pytest.raises(ConfigError):
        generate(out=tmp_path / "d", shard_range="0/3", **{**SMALL, "shard_size": 10**9})
    assert not (tmp_path / "d").exists()


def test_folders_of_parts_sort_and_parse():
    assert parts._FOLDER.fullmatch(Part(9_999, 10_000).folder.partition("/")[2])


@pytest.mark.slow
def test_from_the_command_line_at_the_same_time(tmp_path, whole):
    words = [sys.executable, "-m", "navrep_data"]
    flags = ["--n", "7", "--humans", "4", "--obstacles", "3", "--length", "30", "--shard-size", "2", "--seed", "5"]
    jobs = [
        subprocess.Popen(
            [*words, "generate", *flags, "--workers", "1", "--out", "d", "--shard-range", f"{k}/2"],
            cwd=tmp_path, stdout=subprocess.PIPE, text=True,
        )
        for k in range(2)
    ]  # fmt: skip
    for k, job in enumerate(jobs):
        text = job.communicate()[0]
        assert job.returncode == 0, text
        assert f"d, part {k}/2: " in text
        assert "merge-manifest d" in text
    done = subprocess.run([*words, "merge-manifest", "d"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "7 sequences, 210 rows, 5 shards" in done.stdout
    assert tree(tmp_path / "d") == whole
    shutil.rmtree(tmp_path / "d")
    done = subprocess.run([*words, "merge-manifest", "d"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1


def test_json_of_a_part(three_parts):
    values = json.loads((three_parts / Part(0, 3).folder / "manifest.json").read_text())
    assert (values["complete"], values["planned"], values["sequences"]) == (False, 7, 2)
