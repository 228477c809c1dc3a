"""Merge, split, filter, stats and sample: what comes out, where it came from, and that nothing else changes."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from navrep_data.datasets import SequenceDataset, import_npz
from navrep_data.datasets.tools import _pieces, edits, filter, merge, sample, split, stats
from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetError,
    DatasetMismatchError,
    DatasetNotFoundError,
    FolderInUseError,
)
from navrep_data.generate import generate, regenerate
from navrep_data.schema import EVENT_NAMES, Event
from navrep_data.shards import DatasetFolder, Manifest, SequenceSource, dataset_writer, info, select_shards, verify
from navrep_data.testing import tiny_dataset
from navrep_data.view import dataset_page

ROWS = 240


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """Five sequences in four shards, small crowds: 0, 3 and 4 for training, 1 and 2."""
    return tiny_dataset(tmp_path_factory.mktemp("few") / "few", n=5, length=ROWS, humans=4)


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """Another seed, larger crowds, shorter sequences."""
    return tiny_dataset(tmp_path_factory.mktemp("many") / "many", n=3, length=150, seed=1, humans=6)


def contents(root):
    """Columns of each sequence, and its worlds."""
    result = []
    with DatasetFolder(root) as folder:
        for k, entry in enumerate(folder.manifest.shards):
            sequence = folder.read("sequence", k, 0, entry.rows)
            worlds = folder.worlds(k)
            for number in entry.numbers:
                rows = np.flatnonzero(sequence == number)
                columns = {c: folder.read(c, k, rows[0], rows[-1] + 1) for c in folder.manifest.columns}
                there = [worlds.episode(i) for i in range(len(worlds))] if worlds else []
                result.append((number, columns, [w for w in there if w.sequence == number]))
    return [(columns, worlds) for _, columns, worlds in sorted(result, key=lambda one: one[0])]


def by_number(root, name):
    """What the entries of the shards say of each sequence, in the order of their numbers."""
    listed = [one for s in Manifest.read(root).shards for one in zip(s.numbers, getattr(s, name), strict=True)]
    return [value for _, value in sorted(listed, key=lambda one: one[0])]


def sources(root) -> list[SequenceSource]:
    return by_number(root, "source")


def hashes(root):
    return by_number(root, "sequence_hashes")


def tree(folder):
    """One hash over names and bytes of everything in a folder."""
    digest = hashlib.sha256()
    for path in sorted(Path(folder).rglob("*")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        if path.is_file():
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def check_taken_over(root, roots):
    """Every row, every episode's world and every split is that of its source; returns (dataset, sequence, row)."""
    old = [contents(one) for one in roots]
    manifests = [Manifest.read(one) for one in roots]
    new, manifest = contents(root), Manifest.read(root)
    by_hash = {h: (d, k) for d, one in enumerate(roots) for k, h in enumerate(hashes(one))}
    where = []
    for number, ((columns, worlds), source) in enumerate(zip(new, sources(root), strict=True)):
        d, k = by_hash[source.content_hash]
        assert k == source.sequence
        assert manifest.source[source.dataset]["content_hash"] == info(roots[d])["content_hash"]
        before, all_worlds = old[d][k]
        n = len(columns["step"])
        assert n <= manifest.length
        rows = slice(source.row, source.row + n)
        first_episode = before["episode"][source.row]
        for name, values in columns.items():
            expected = before[name][rows]
            if name == "sequence":
                expected = np.full(n, number)
            elif name == "episode":
                expected = expected - first_episode
            elif name == "humans":
                slots = expected.shape[1]
                assert np.isnan(values[:, slots:]).all()
                values = values[:, :slots]
            np.testing.assert_array_equal(values, expected, err_msg=name)
        expected = [w for w in all_worlds if first_episode <= w.episode <= first_episode + columns["episode"][-1]]
        starts = np.flatnonzero(columns["is_first"])
        assert len(worlds) == len(expected) == len(starts)
        for a, b in zip(worlds, expected, strict=True):
            assert a.sequence == number
            assert a.episode == b.episode - first_episode
            for name in ("robot_start", "robot_goal", "human_start", "human_goal", "human_gait", "human_sees_robot"):
                np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
            assert len(a.polygons) == len(b.polygons)
            for p, q in zip((*a.polygons, a.border), (*b.polygons, b.border), strict=True):
                np.testing.assert_array_equal(p, q)
        assert manifest.split_of(number) == manifests[d].split_of(k)
        where.append((d, k, source.row))
    return where


def test_merge(few, many, tmp_path):
    seen = []
    manifest = merge([few, many], tmp_path / "out", progress=lambda *a: seen.append(a))
    assert verify(tmp_path / "out").problems == []
    assert check_taken_over(tmp_path / "out", [few, many]) == [(0, k, 0) for k in range(5)] + [
        (1, k, 0) for k in range(3)
    ]
    assert (manifest.sequences, manifest.length, manifest.complete) == (8, ROWS, True)
    assert manifest.max_humans == max(Manifest.read(r).max_humans for r in (few, many))
    assert Manifest.read(few).max_humans != Manifest.read(many).max_humans
    assert seen == [(k, 8) for k in range(1, 9)]
    # settings that differ are with the sources
    assert "humans" not in manifest.config
    assert manifest.config["env"] == "soadrl"
    assert [record["name"] for record in info(tmp_path / "out")["source"]] == [
        "soadrl, consistent physics, seed 0", "soadrl, consistent physics, seed 1",
    ]  # fmt: skip
    card = (tmp_path / "out" / "README.md").read_text()
    assert "made out of 2 datasets" in card
    assert info(few)["content_hash"] in card
    windows = SequenceDataset(tmp_path / "out", "1d", window=16, split="val")
    assert {windows.info(i)["sequence"] for i in range(len(windows))} == {1, 6}
    # the page draws the same: worlds, people and their legs came along
    assert drawn(dataset_page(tmp_path / "out", [6])) == drawn(dataset_page(many, [1]))


def drawn(page):
    """The data embedded in a page."""
    found = re.findall(rb"[A-Za-z0-9+/=]{2000,}", page.html)
    assert found
    return found


def slow_runs(root, fits):
    """(sequence, row, rows) of each run of episodes that fit, found episode by episode."""
    runs = []
    for k, (columns, _) in enumerate(contents(root)):
        open_run = None
        for episode in range(columns["episode"][-1] + 1):
            rows = np.flatnonzero(columns["episode"] == episode)
            humans = int((~np.isnan(columns["humans"][rows[0], :, 0])).sum())
            if fits(EVENT_NAMES[columns["event"][rows[-1]]], humans, len(rows) - 1):
                open_run = open_run or [k, int(rows[0]), 0]
                open_run[2] += len(rows)
            elif open_run:
                runs.append(tuple(open_run))
                open_run = None
        if open_run:
            runs.append(tuple(open_run))
    return runs


@pytest.mark.slow
@pytest.mark.parametrize(
    ("conditions", "fits"),
    [
        ({"outcomes": ["goal"]}, lambda event, humans, steps: event == "goal"),
        ({"outcomes": ["cut", "stuck", "goal"]}, lambda event, humans, steps: event in ("cut", "stuck", "goal")),
        ({"min_humans": 4, "max_humans": 5}, lambda event, humans, steps: 4 <= humans <= 5),
        ({"min_steps": 60}, lambda event, humans, steps: steps >= 60),
        (
            {"outcomes": ["goal", "cut"], "max_steps": 80, "min_humans": 2},
            lambda event, humans, steps: event in ("goal", "cut") and steps <= 80 and humans >= 2,
        ),
    ],
)
def test_filter(few, tmp_path, conditions, fits):
    expected = slow_runs(few, fits)
    assert len(expected) > 0
    assert sum(rows for _, _, rows in expected) < Manifest.read(few).rows
    manifest = filter(few, tmp_path / "out", **conditions)
    assert verify(tmp_path / "out").problems == []
    where = check_taken_over(tmp_path / "out", [few])
    lengths = [len(columns["step"]) for columns, _ in contents(tmp_path / "out")]
    assert [(k, row, n) for (_, k, row), n in zip(where, lengths, strict=True)] == expected
    assert manifest.rows == sum(lengths)
    assert manifest.length == ROWS
    assert len(SequenceDataset(tmp_path / "out", "1d", window=8, split="train"))


@pytest.mark.slow
def test_crowds_are_known_without_the_humans_column(tmp_path):
    generate(n=3, out=tmp_path / "d", length=120, humans=4, obstacles=2, humans_column=False)
    generate(n=3, out=tmp_path / "with", length=120, humans=4, obstacles=2)
    assert "humans" not in Manifest.read(tmp_path / "d").columns
    filter(tmp_path / "d", tmp_path / "a", max_humans=4)
    filter(tmp_path / "with", tmp_path / "b", max_humans=4)
    assert [s[:3] for s in sources(tmp_path / "a")] == [s[:3] for s in sources(tmp_path / "b")]


@pytest.mark.slow
def test_no_sequence_leaks_through_a_chain_of_tools(few, many, tmp_path):
    """Filter, merge, filter: rows are named by where they were generated, and stay on one side."""
    filter(few, tmp_path / "goals", outcomes=["goal"])
    filter(few, tmp_path / "rest", outcomes=[n for n in EVENT_NAMES[1:] if n != "goal"])
    merge([tmp_path / "rest", many, tmp_path / "goals"], tmp_path / "all")
    assert len(Manifest.read(tmp_path / "all").source) == 2
    filter(tmp_path / "all", tmp_path / "long", min_steps=30)
    for name in ("all", "long"):
        check_taken_over(tmp_path / name, [few, many])
        assert verify(tmp_path / name).ok
        manifest = Manifest.read(tmp_path / name)
        sides = {}
        for k, source in enumerate(sources(tmp_path / name)):
            sides.setdefault(source.content_hash, set()).add(manifest.split_of(k))
        assert all(len(side) == 1 for side in sides.values())
        assert len(sides) == 8
        # the rule is not nested deeper at each turn
        assert manifest.split_rule == Manifest.read(tmp_path / "rest").split_rule
    # nothing is lost: all rows are there once
    assert Manifest.read(tmp_path / "all").rows == Manifest.read(few).rows + Manifest.read(many).rows


def test_rows_do_not_come_twice(few, tmp_path):
    filter(few, tmp_path / "goals", outcomes=["goal"])
    with pytest.raises(DatasetMismatchError, match=r"Row \d+ of sequence \d+ .* is both in .*few and in .*goals"):
        merge([few, tmp_path / "goals"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_one_sequence_on_two_sides_is_refused(few, tmp_path):
    filter(few, tmp_path / "goals", outcomes=["goal"])
    filter(few, tmp_path / "rest", outcomes=[n for n in EVENT_NAMES[1:] if n != "goal"])
    split(tmp_path / "goals", tmp_path / "s", shares={"test": 1.0})
    with pytest.raises(
        DatasetMismatchError, match=r"sequence \d+ .* is in split \w+ in .* and in \w+ in .*; expected one split"
    ):
        merge([tmp_path / "s" / "test", tmp_path / "rest"], tmp_path / "out")


@pytest.mark.slow
def test_split_keeps_the_splits(few, tmp_path):
    made = split(few, tmp_path / "out")
    assert sorted(made) == ["test", "train", "val"]
    for name, manifest in made.items():
        root = tmp_path / "out" / name
        assert verify(root).problems == []
        check_taken_over(root, [few])
        assert {manifest.split_of(k) for k in range(manifest.sequences)} == {name}
        assert len(SequenceDataset(root, "1d", window=16, split=name))
    merge([tmp_path / "out" / name for name in made], tmp_path / "again")
    check_taken_over(tmp_path / "again", [few])
    assert Manifest.read(tmp_path / "again").rows == Manifest.read(few).rows


@pytest.mark.slow
def test_split_by_shares_keeps_what_came_from_one_sequence_together(few, many, tmp_path):
    merge([few, many], tmp_path / "both")
    filter(tmp_path / "both", tmp_path / "cut", min_steps=40)
    assert len(sources(tmp_path / "cut")) > len({s.content_hash for s in sources(tmp_path / "cut")})
    shares = {"train": 0.5, "val": 0.25, "test": 0.25}

    def sides(out, seed):
        made = split(tmp_path / "cut", tmp_path / out, shares=shares, seed=seed)
        return {name: {s.content_hash for s in sources(tmp_path / out / name)} for name in made}

    a = sides("a", 3)
    everything = {s.content_hash for s in sources(tmp_path / "cut")}
    assert sum(map(len, a.values())) == len(everything)
    assert set().union(*a.values()) == everything
    assert all(a.values())
    assert a == sides("b", 3)
    assert any(a != sides(f"c{seed}", seed) for seed in range(3))
    assert "drawn with seed 3" in Manifest.read(tmp_path / "a" / "val").split_rule


def test_the_command_of_a_split_gives_its_shares_exactly(many, tmp_path):
    shares = {"train": 1 / 3, "val": 1 / 3, "test": 1 - 2 / 3}
    made = split(many, tmp_path / "s", shares=shares)
    words = made["train"].command.split()
    assert [float(v) for v in words[words.index("--shares") + 1].split(",")] == list(shares.values())


@pytest.mark.parametrize(
    ("shares", "words"),
    [
        ({"train": 0.5}, "add up to 1"),
        ({"train": 2.0, "val": -1.0}, "add up to 1"),
        ({"train": float("nan"), "val": 1.0}, "add up to 1"),
        ({"trian": 1.0}, "Unknown split 'trian'; .* Did you mean 'train'"),
    ],
)
def test_shares_that_cannot_be_used(few, tmp_path, shares, words):
    with pytest.raises(ConfigError, match=words):
        split(few, tmp_path / "out", shares=shares)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_too_few_sequences_to_split(few, tmp_path):
    split(few, tmp_path / "one", shares={"train": 0.6, "val": 0.2, "test": 0.2})
    with pytest.raises(ConfigError, match="1 sequences are too few for 3 splits"):
        split(tmp_path / "one" / "val", tmp_path / "out", shares={"train": 0.6, "val": 0.2, "test": 0.2})


@pytest.mark.slow
@pytest.mark.parametrize("tool", ["merge", "split", "filter"])
def test_a_failure_leaves_everything_as_it_was(few, many, tmp_path, monkeypatch, tool):
    shutil.copytree(few, tmp_path / "few")
    shutil.copytree(many, tmp_path / "many")
    run = {
        "merge": lambda: merge([tmp_path / "few", tmp_path / "many"], tmp_path / "new" / "out"),
        "split": lambda: split(tmp_path / "few", tmp_path / "new" / "out"),
        "filter": lambda: filter(tmp_path / "few", tmp_path / "new" / "out", min_steps=1),
    }[tool]
    before = tree(tmp_path)
    calls = []

    def broken(root, index, image):
        calls.append(index)
        assert (root.parent if tool != "split" else root.parent.parent) == tmp_path / "new"
        entry = _pieces_publish(root, index, image)
        if len(calls) == 2:
            raise OSError(5, "the disk is gone")
        return entry

    _pieces_publish = dataset_writer.publish
    monkeypatch.setattr(dataset_writer, "publish", broken)
    monkeypatch.setattr(_pieces, "TARGET_SHARD_ROWS", 2 * ROWS)
    with pytest.raises(OSError, match="the disk is gone"):
        run()
    assert len(calls) == 2
    assert tree(tmp_path) == before
    monkeypatch.undo()
    run()
    assert tree(tmp_path / "few") == tree(few)
    assert tree(tmp_path / "many") == tree(many)


def test_damage_does_not_get_a_right_hash(few, tmp_path):
    for name in ("data/train-00001.h5", "worlds/train-00001.npz"):
        root = tmp_path / "d"
        shutil.copytree(few, root)
        data = bytearray((root / name).read_bytes())
        data[len(data) // 2] ^= 1
        (root / name).write_bytes(data)
        before = tree(tmp_path)
        with pytest.raises(CorruptDataError, match=f"{name} differs from its SHA-256"):
            filter(root, tmp_path / "out", min_steps=1)
        assert tree(tmp_path) == before
        shutil.rmtree(root)


@pytest.mark.slow
def test_nothing_is_written_in_place_or_over_something(few, tmp_path):
    root = shutil.copytree(few, tmp_path / "few")
    (tmp_path / "notes").write_text("mine")
    before = tree(tmp_path)
    with pytest.raises(FolderInUseError, match="is in use, expected a new or empty folder: filter never overwrites"):
        filter(root, root, min_steps=1)
    with pytest.raises(ConfigError, match=r"few/goals lies inside .*few, which is only read"):
        filter(root, root / "goals", min_steps=1)
    with pytest.raises(FolderInUseError, match="lies under a file"):
        filter(root, tmp_path / "notes" / "goals", min_steps=1)
    (tmp_path / "out.part").mkdir()
    with pytest.raises(FolderInUseError, match=r"out.part exists, left by filter"):
        filter(root, tmp_path / "out", min_steps=1)
    (tmp_path / "out.part").rmdir()
    assert tree(tmp_path) == before
    (tmp_path / "out").mkdir()
    assert filter(root, tmp_path / "out", min_steps=1).rows


@pytest.mark.parametrize(
    ("conditions", "words"),
    [
        ({}, "no condition to filter by"),
        ({"outcomes": ["gaol"]}, "Unknown outcome 'gaol'; expected some of goal, .*Did you mean 'goal'?"),
        ({"outcomes": ["none"]}, "Unknown outcome 'none'"),
        ({"min_steps": 5, "max_steps": 4}, "bounds of steps are 5 and 4"),
        ({"min_humans": -1}, "bounds of humans are -1"),
        ({"max_steps": 2.5}, "bounds of steps are 0 and 2.5; expected whole numbers"),
        ({"min_steps": 10_000}, r"Nothing is left: none of the \d+ episodes of .* fits \(.*goal \d"),
    ],
)
def test_filters_that_cannot_be_used(few, tmp_path, conditions, words):
    with pytest.raises(ConfigError, match=words) as caught:
        filter(few, tmp_path / "out", **conditions)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def changed(root, out, **fields):
    """A copy whose manifest says something else."""
    shutil.copytree(root, out)
    replace(Manifest.read(out), **fields).save(out)
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (lambda m: {"env": "ian"}, r"few has environment soadrl, .*other has ian; expected datasets of one kind"),
        (lambda m: {"physics": "original"}, "physics consistent, .* has original"),
        (lambda m: {"sensor": replace(m.sensor, range_max=30.0)}, "range_max=25, .*range_max=30"),
        (lambda m: {"columns": tuple(c for c in m.columns if c != "humans")}, "columns scan, .*humans, .*other has"),
        (lambda m: {"scan_dtype": "float32"}, "scan dtype uint16, .* has float32"),
        (lambda m: {"shards": tuple(replace(s, worlds=None) for s in m.shards)}, "worlds files on all shards"),
    ],
)
def test_datasets_of_different_kind_are_not_merged(few, many, tmp_path, fields, words):
    m = Manifest.read(many)
    values = fields(m)
    if "columns" in values:
        shards = [
            replace(
                s, statistics={**s.statistics, "columns": {c: s.statistics["columns"][c] for c in values["columns"]}}
            )
            for s in m.shards
        ]
        values |= {"shards": tuple(shards), "statistics": shards[0].statistics}
    other = changed(many, tmp_path / "other", **values)
    with pytest.raises(DatasetMismatchError, match=words):
        merge([few, other], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_merge_wants_two_finished_datasets(few, tmp_path):
    with pytest.raises(ConfigError, match="1 datasets were given, expected at least two"):
        merge([few], tmp_path / "out")
    with pytest.raises(DatasetNotFoundError, match="No dataset in"):
        merge([few, tmp_path / "gone"], tmp_path / "out")
    unfinished = changed(few, tmp_path / "unfinished", complete=False, planned=9)
    with pytest.raises(DatasetError, match="is not finished; run its generate command again"):
        merge([few, unfinished], tmp_path / "out")


@pytest.mark.slow
def test_parts_are_tools_food_and_parts_of_results_know_their_source(few, many, tmp_path, monkeypatch):
    monkeypatch.setattr(_pieces, "TARGET_SHARD_ROWS", 2 * ROWS)
    part = shutil.copytree(few, tmp_path / "part")
    select_shards(Manifest.read(few), [1]).save(part)
    (part / "README.md").unlink()
    for name in ("train-00000", "val-00000", "test-00000"):
        (part / f"data/{name}.h5").unlink()
        (part / f"worlds/{name}.npz").unlink()
    merge([part, many], tmp_path / "out")
    assert verify(tmp_path / "out").ok
    assert [s.sequence for s in sources(tmp_path / "out")] == [4, 0, 1, 2]
    # a sequence is the same one in the part and in the whole
    with pytest.raises(DatasetMismatchError, match="is both in"):
        merge([tmp_path / "out", few], tmp_path / "twice")
    whole = Manifest.read(tmp_path / "out")
    again = select_shards(whole, [1])
    assert again.source == whole.source
    assert again.shards[0].source == whole.shards[1].source
    assert Manifest.from_dict(json.loads(json.dumps(again.to_dict())), tmp_path) == again


def test_what_generate_writes_has_never_heard_of_sources(few):
    values = json.loads((few / "manifest.json").read_text())
    assert "source" not in values
    assert all("source" not in shard for shard in values["shards"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda v: v["shards"][0]["source"].pop(), r"shards\[0\].source.*one|expected \d+ lists of dataset"),
        (lambda v: v["shards"][0].pop("source"), r"field 'shards\[0\].source' is 'missing', expected a list"),
        (lambda v: v["shards"][0]["source"][0].__setitem__(0, 1), r"dataset \(below 1\)"),
        (lambda v: v["shards"][0]["source"][0].__setitem__(2, -1), "sequence, row and content hash"),
        (lambda v: v["shards"][0]["source"][0].__setitem__(1, True), "sequence, row and content hash"),
        (lambda v: v["shards"][0]["source"][0].__setitem__(3, "../../etc"), "sequence, row and content hash"),
        (lambda v: v.pop("source"), r"dataset \(below 0\)"),
        (lambda v: v["source"].clear(), "field 'source' is .*, expected a list of datasets"),
        (lambda v: v["source"].__setitem__(0, "few"), r"source\[0\] is not a JSON object"),
        (lambda v: v["source"][0].pop("content_hash"), r"field 'source\[0\].content_hash' is 'missing'"),
    ],
)
def test_sources_from_outside_are_checked(few, tmp_path, edit, words):
    filter(few, tmp_path / "out", min_steps=1)
    values = json.loads((tmp_path / "out" / "manifest.json").read_text())
    edit(values)
    with pytest.raises(CorruptDataError, match=words):
        Manifest.from_dict(values, tmp_path / "out")


def test_generate_leaves_results_alone(few, tmp_path):
    filter(few, tmp_path / "out", min_steps=1)
    with pytest.raises(DatasetMismatchError, match=r"was made out of other datasets .*navrep-data filter DIR"):
        generate(n=50, out=tmp_path / "out", length=ROWS, humans=4, obstacles=3)
    with pytest.raises(DatasetError, match=r"was made out of other datasets .* regenerate from those"):
        regenerate(tmp_path / "out", 1)


@pytest.mark.slow
def test_shards_are_neither_tiny_nor_too_large(few, tmp_path, monkeypatch):
    monkeypatch.setattr(_pieces, "TARGET_SHARD_ROWS", 2 * ROWS)
    manifest = filter(few, tmp_path / "out", min_steps=1)
    per_shard = [s.count for s in manifest.shards if s.split == "train"]
    assert set(per_shard[:-1]) == {manifest.shard_size}
    assert max(s.rows for s in manifest.shards) < 4 * ROWS
    monkeypatch.setattr(_pieces, "MAX_SHARD_BYTES", 1000)
    assert filter(few, tmp_path / "small", min_steps=1).shard_size == 1


@pytest.mark.slow
def test_stats(few):
    whole = stats(few)
    manifest = Manifest.read(few)
    assert whole["columns"] == manifest.statistics["columns"]
    assert (whole["sequences"], whole["rows"]) == (5, 5 * ROWS)
    parts = [stats(few, split=name) for name in ("train", "val", "test")]
    assert sum(p["episodes"] for p in parts) == whole["episodes"]
    assert sum(n for p in parts for n in p["humans"].values()) == whole["episodes"]
    val = contents(few)[1][0]
    assert parts[1]["columns"]["reward"]["count"] == (~val["is_last"]).sum()
    np.testing.assert_allclose(
        parts[1]["columns"]["reward"]["mean"], val["reward"][~val["is_last"]].astype(float).mean()
    )
    np.testing.assert_allclose(parts[1]["columns"]["scan"]["max"], val["scan"].max() / 1000)
    lengths = np.diff(np.append(np.flatnonzero(val["is_first"]), ROWS)) - 1
    assert parts[1]["steps"]["all"] == np.quantile(lengths, [0, 0.25, 0.5, 0.75, 1]).tolist()
    crowd = (~np.isnan(val["humans"][val["is_first"]][..., 0])).sum(axis=1)
    assert parts[1]["humans"] == {str(n): int((crowd == n).sum()) for n in np.unique(crowd)}
    json.dumps(whole, allow_nan=False)
    with pytest.raises(ConfigError, match=r"Unknown split 'vall'.*Did you mean 'val'"):
        stats(few, split="vall")


@pytest.mark.slow
def test_sample(few, tmp_path):
    paths = sample(few, tmp_path / "a", n=2, seed=5)
    assert len(paths) == len(set(paths)) == 2
    for path in paths:
        with Image.open(path) as image:
            assert image.size == (1100, 600)
            assert len(np.unique(np.asarray(image))) > 20
    again = sample(few, tmp_path / "b", n=2, seed=5)
    assert [p.name for p in again] == [p.name for p in paths]
    assert [p.read_bytes() for p in again] == [p.read_bytes() for p in paths]
    other = sample(few, tmp_path / "c", n=1, seed=6, split="val")
    assert {p.name[:14] for p in other} == {"sequence-00001"}
    with pytest.raises(ConfigError, match="0 pictures were asked for"):
        sample(few, tmp_path / "d", n=0)
    with pytest.raises(FolderInUseError):
        sample(few, tmp_path / "a", n=1)


@pytest.mark.slow
def test_imports_have_no_worlds_and_go_through_all_tools(tmp_path):
    from test_import_npz import sequence, write

    import_npz(
        write(tmp_path / "in", sequence(seed=1), sequence(seed=2), sequence(40, (9,), (), (9,), ())), tmp_path / "d"
    )
    manifest = filter(tmp_path / "d", tmp_path / "goals", outcomes=["goal"])
    assert verify(tmp_path / "goals").ok
    assert [s[1:3] for s in sources(tmp_path / "goals")] == [(0, 0), (1, 0), (2, 0)]
    assert manifest.rows == 30
    with pytest.raises(ConfigError, match="does not record its humans; filter by outcome or steps"):
        filter(tmp_path / "d", tmp_path / "crowds", min_humans=1)
    assert stats(tmp_path / "d")["humans"] == {}
    (picture,) = sample(tmp_path / "d", tmp_path / "pictures", n=1)
    with Image.open(picture) as image:
        assert image.size == (1100, 400)
    import_npz(write(tmp_path / "in2", sequence(seed=9)), tmp_path / "e")
    merged = merge([tmp_path / "d", tmp_path / "e"], tmp_path / "all")
    assert verify(tmp_path / "all").ok
    assert "source" not in merged.config
    assert [len(record["config"]["source"]) for record in merged.source] == [3, 1]


def test_descriptions(few, tmp_path):
    found = edits.describe(filter(few, tmp_path / "out", outcomes=["goal"]), tmp_path / "out")
    assert set(found["episodes"]) == {Event.GOAL.label}
    assert sum(found["splits"].values()) == found["sequences"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [np.int64, np.array, torch.tensor])
def test_bounds_and_seeds_are_whole_numbers_of_any_kind(few, tmp_path, kind):
    plain, other = filter(few, tmp_path / "a", min_steps=2), filter(few, tmp_path / "b", min_steps=kind(2))
    assert other.shards == plain.shards
    pictures = sample(few, tmp_path / "c", n=1, seed=3), sample(few, tmp_path / "d", n=1, seed=kind(3))
    assert pictures[0][0].name == pictures[1][0].name
