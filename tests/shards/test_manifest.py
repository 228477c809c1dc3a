"""The manifest, the lock, the folder and the card."""

from __future__ import annotations

import json
import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetLockedError,
    DatasetNotFoundError,
    SchemaVersionError,
)
from navrep_data.io import json_bytes
from navrep_data.schema import Event
from navrep_data.shards import (
    SPLIT_RULE,
    SPLITS,
    DatasetFolder,
    Manifest,
    Origin,
    choose_shards,
    chunk_rows,
    content_hash,
    count_in_split,
    dataset_card,
    dataset_record,
    estimate_bytes,
    info,
    nth_of_split,
    read_origin,
    select_shards,
    split_of,
    verify,
    writer_lock,
)
from navrep_data.shards.manifest import _hash

from .synthetic import ALL_COLUMNS, MAX_HUMANS, make_dataset, make_sequence


def test_round_trip_in_equal_bytes(dataset):
    before = (dataset / "manifest.json").read_bytes()
    manifest = Manifest.read(dataset)
    assert manifest.save(dataset, card=dataset_card(manifest)) == manifest
    assert (dataset / "manifest.json").read_bytes() == before
    assert json.loads(before)["rows"] == 600
    assert {"file", "sha256", "rows"} <= set(json.loads(before)["shards"][0])


def test_a_dataset_is_a_function_of_its_input(dataset, tmp_path):
    make_dataset(tmp_path / "again")
    for path in dataset.rglob("*"):
        if path.is_file():
            assert (tmp_path / "again" / path.relative_to(dataset)).read_bytes() == path.read_bytes()


def test_the_rule_of_splits_is_stable_and_covers_everything():
    for n in (0, 1, 2, 3, 10, 57):
        members = {name: [nth_of_split(name, k) for k in range(count_in_split(name, n))] for name in SPLITS}
        assert sorted(k for numbers in members.values() for k in numbers) == list(range(n))
        assert all(split_of(k) == name for name, numbers in members.items() for k in numbers)
        assert all(numbers == sorted(numbers) for numbers in members.values())
        assert all(nth_of_split(name, len(numbers)) >= n for name, numbers in members.items())
    assert all(count_in_split(name, 3) for name in SPLITS)
    assert [split_of(k) for k in (1, 2, 11, 12)] == ["val", "test"] * 2


def change(root, edit, sign=True):
    values = json.loads((root / "manifest.json").read_text())
    edit(values)
    if sign:
        values["manifest_sha256"] = _hash(values)
    (root / "manifest.json").write_bytes(json_bytes(values))


@pytest.mark.parametrize(
    ("edit", "match"),
    [
        (lambda v: v.update(format="minari"), "'format'"),
        (lambda v: v.update(format_version="1"), "'format_version' is '1'"),
        (lambda v: v.update(format_version=True), "'format_version'"),
        (lambda v: v.pop("env"), "'env' is 'missing'"),
        (lambda v: v.update(seed=-1), "'seed' is -1"),
        (lambda v: v.update(complete=1), "'complete' is 1"),
        (lambda v: v.update(length=0), "'length'"),
        (lambda v: v.update(columns=["scan", "virus"]), "'columns'"),
        (lambda v: v.update(columns=v["columns"][::-1]), "'columns'"),
        (lambda v: v.update(columns=[[]]), "'columns'"),
        (lambda v: v.update(scan_dtype="int8"), "'scan_dtype'"),
        (lambda v: v.update(inputs={"policy": "no hash"}), "'inputs'"),
        (lambda v: v.update(origins={"map:m": [1.0]}), "'origins'"),
        (lambda v: v.update(origins={"map:m": [True, 0.0]}), "'origins'"),
        (lambda v: v.update(origins={"map:m": [10**400, 0]}), "'origins'"),
        (lambda v: v.update(max_humans=10**9), "'max_humans'"),
        (lambda v: v.update(shard_size=0), "'shard_size' is 0, expected at least 1"),
        (lambda v: v["sensor"].update(angle_min=10**400), "'sensor'"),
        (lambda v: v["sensor"].update(angle_increment=float("1e308")), "'sensor'"),
        (lambda v: v["sensor"].update(n_rays=10**9), "'sensor'"),
        (lambda v: v["sensor"].pop("dt"), "'sensor'"),
        (lambda v: v.update(statistics={"columns": {}}), "'statistics'"),
        (lambda v: v["shards"][0].update(split="all"), r"'shards\[0\].split'"),
        (lambda v: v["shards"][0].pop("split"), r"'shards\[0\].split'"),
        (lambda v: v["shards"][0].update(split="val"), "as files of split val are called"),
        (lambda v: v["shards"][0].update(file="data/val-00000.h5"), "as files of split train are called"),
        (lambda v: v.update(split_rule=SPLIT_RULE), "of split train holds sequence 1, which is of split val"),
        (lambda v: v["shards"][1].update(sequences=[[3, 4], [4, 6]]), r"'shards\[1\].sequences'"),
        (lambda v: v["shards"][1].update(sequences=[[5, 6], [3, 5]]), r"'shards\[1\].sequences'"),
        (lambda v: v["shards"][1].update(sequences=[]), r"'shards\[1\].sequences'"),
        (lambda v: v["shards"][1].update(sequences=[[2, 5]]), "holds sequence 2, which data/train-00000.h5 holds too"),
        (lambda v: v["shards"][1].update(sequences=[[4, 7]]), "does not hold the sequences 3 to 3"),
        (lambda v: v["shards"][0].update(file="../../etc/passwd"), "outside the dataset"),
        (lambda v: v["shards"][0].update(file="/etc/passwd"), "outside the dataset"),
        (lambda v: v["shards"][0]["worlds"].update(file="worlds/../../x"), "outside the dataset"),
        (lambda v: v["shards"][0].update(sha256="0" * 63), r"'shards\[0\].sha256'"),
        (lambda v: v["shards"][1].update(bytes=-4), r"'shards\[1\].bytes'"),
        (lambda v: v["shards"][1].update(sequences=[[3, 3]]), r"'shards\[1\].sequences'"),
        (lambda v: v["shards"][1].update(sequence_hashes=[]), "sequence_hashes"),
        (lambda v: v["shards"][1].update(statistics=None), "statistics"),
        (lambda v: v["shards"][1].update(statistics={}), r"'shards\[1\].statistics'"),
        (lambda v: v["shards"][1].update(sequences=[[0, 2**61]]), "one for each number in `sequences`"),
        (lambda v: v["shards"][0].update(rows=10**9), "rows for 3 sequences"),
        (lambda v: v["shards"].reverse(), "not in the order"),
        (lambda v: v["shards"].pop(0), "complete, but does not hold the sequences 0 to 2"),
        (lambda v: v["shards"].pop(), "complete, but does not hold the sequences 3 to 5"),
        (lambda v: v["shards"][1].update({k: v["shards"][0][k] for k in ("file", "worlds")}), "twice"),
        (lambda v: v.update(shards=[3]), "not a JSON object"),
        (lambda v: v.update(rows=1), "not the sums"),
        (lambda v: v.update(card_sha256=3), "'card_sha256'"),
    ],
)
def test_hostile_manifests_are_refused(dataset, edit, match):
    change(dataset, edit)
    with pytest.raises(CorruptDataError, match=match) as error:
        Manifest.read(dataset)
    assert "\n" not in str(error.value)


def test_changed_values_break_the_hash(dataset):
    change(dataset, lambda v: v.update(env="soadr1"), sign=False)
    with pytest.raises(CorruptDataError, match="manifest_sha256"):
        Manifest.read(dataset)


def test_missing_broken_and_newer(dataset, tmp_path, monkeypatch):
    with pytest.raises(DatasetNotFoundError, match="not a folder"):
        Manifest.read(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetNotFoundError, match=r"no manifest\.json"):
        Manifest.read(tmp_path / "empty")
    change(dataset, lambda v: v.update(format_version=1))
    with pytest.raises(SchemaVersionError, match="never released; expected 2 or newer: generate or import it again"):
        Manifest.read(dataset)
    change(dataset, lambda v: v.update(format_version=3))
    with pytest.raises(SchemaVersionError, match="pip install -U navrep-data"):
        Manifest.read(dataset)
    for text in (b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000, b'{"a": NaN}'):
        (dataset / "manifest.json").write_bytes(text)
        with pytest.raises(CorruptDataError):
            Manifest.read(dataset)
    with open(dataset / "manifest.json", "wb") as handle:
        handle.truncate(300 << 20)  # sparse: refused before it is read
    with pytest.raises(ValueError, match="expected at most"):
        Manifest.read(dataset)


def test_shards_may_come_in_any_order_with_gaps_until_complete(dataset):
    manifest = Manifest.read(dataset)
    back = manifest.with_shards(reversed(manifest.shards), complete=True)
    assert replace(back, card_sha256=manifest.card_sha256) == manifest
    part = manifest.with_shards(manifest.shards[1:], complete=False).save(dataset)
    assert Manifest.read(dataset) == part
    assert part.sequences == 3
    with pytest.raises(ConfigError, match="does not hold"):
        manifest.with_shards(manifest.shards[1:], complete=True)
    with pytest.raises(ConfigError, match="holds too"):
        manifest.with_shards([*manifest.shards, manifest.shards[0]], complete=True)


@pytest.mark.slow
def test_second_writer_is_refused_and_a_killed_one_is_not(dataset):
    code = (
        "import sys\nfrom navrep_data.shards import writer_lock\n"
        "with writer_lock(sys.argv[1]):\n    print('held', flush=True)\n    sys.stdin.read()"
    )
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(dataset)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=root
    )
    try:
        assert process.stdout.readline() == b"held\n"
        with pytest.raises(DatasetLockedError, match="one writer at a time"), writer_lock(dataset):
            pass
    finally:
        process.kill()
        process.communicate()
    with writer_lock(dataset):
        pass
    with writer_lock(dataset):
        pass


def test_folder_reads_and_indexes(dataset):
    folder = DatasetFolder(dataset, max_open=1)
    episodes = folder.episodes
    expected = []
    for k in range(6):
        columns, _ = make_sequence(k)
        starts = np.flatnonzero(columns["is_first"])
        for start, stop in zip(starts, [*starts[1:], 100], strict=True):
            where = (k, columns["episode"][start], k // 3, start + 100 * (k % 3))
            expected.append((*where, stop - start, columns["event"][stop - 1], 0))
            got = folder.read("robot_state", k // 3, start + 100 * (k % 3), stop + 100 * (k % 3))
            assert np.array_equal(got, columns["robot_state"][start:stop])
    names = ("sequence", "episode", "shard", "start", "length", "event", "split")
    assert [tuple(row) for row in zip(*(getattr(episodes, n) for n in names), strict=True)] == expected
    assert set(episodes.event) <= set(Event)
    assert len(episodes.in_split("val")) + len(episodes.in_split("test")) + len(episodes.in_split("train")) == len(
        expected
    )
    with pytest.raises(ConfigError, match="Did you mean 'train'"):
        episodes.in_split("trian")
    again = pickle.loads(pickle.dumps(folder))  # noqa: S301
    assert np.array_equal(again.read("scan", 1, 5, 9), folder.read("scan", 1, 5, 9))
    worlds = folder.worlds(1)
    assert [worlds.episode(k).row for k in range(len(worlds))] == [r[3] for r in expected if r[2] == 1]


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs /proc")
def test_open_files_are_bounded(tmp_path):
    make_dataset(tmp_path, 12, 1, 20)
    before = len(os.listdir("/proc/self/fd"))
    with DatasetFolder(tmp_path, max_open=3) as folder:
        for k in [*range(12), *range(12)]:
            folder.read("scan", k, 0, 20)
            assert len(os.listdir("/proc/self/fd")) <= before + 4
    assert len(os.listdir("/proc/self/fd")) <= before


def test_info_and_card(dataset):
    values = info(dataset)
    assert json.loads(json.dumps(values)) == values
    assert values["rows"] == 600
    assert values["splits"] == {"train": 6, "val": 0, "test": 0}
    files = [p for folder in ("data", "worlds") for p in (dataset / folder).iterdir()]
    assert values["bytes"] == sum(p.stat().st_size for p in files)
    card = (dataset / "README.md").read_text()
    assert card.startswith("---\npretty_name: ")  # no licence before somebody chose one
    published = replace(Manifest.read(dataset), license="cc-by-4.0")
    assert dataset_card(published).startswith("---\nlicense: cc-by-4.0\npretty_name: ")
    assert all(f"| `{name}` |" in card for name in ALL_COLUMNS)
    assert "navrep-data generate --env soadrl --n 6" in card
    assert "not made or endorsed by the NavRep authors" in " ".join(card.split())


@pytest.mark.parametrize(
    ("config", "named"),
    [
        ({}, False),
        ({"world": "map", "maps": ["/home/me/office"]}, False),
        ({"world": "map", "maps": ["/home/me/office", "asl"]}, True),
        ({"world": "map", "scenarios": ["rlasl1"]}, True),
        ({"maps": 3, "human_policy": []}, False),
    ],
)
def test_card_says_that_the_papers_maps_state_no_licence(dataset, config, named):
    card = dataset_card(replace(Manifest.read(dataset), config=config, license="mit"))
    assert ("`asl-pepper-2d-sim`, which states no licence" in card) == named


def test_card_names_every_one_of_the_papers_maps(dataset):
    from navrep_data.errors import MissingExtraError
    from navrep_data.sim import map_names

    try:
        names = map_names()
    except MissingExtraError as error:
        pytest.skip(str(error))
    manifest = Manifest.read(dataset)
    for name in names:
        assert "states no licence" in dataset_card(replace(manifest, config={"maps": [name]})), name


def test_card_says_who_walked_and_how_the_lidar_saw(dataset):
    manifest = Manifest.read(dataset)
    plain = dataset_card(replace(manifest, config={}))
    assert "a planar lidar without noise, humans that follow ORCA." in plain
    other = dataset_card(replace(manifest, config={"human_policy": "static", "scan_noise": 0.1}))
    assert "a planar lidar with noise, humans that stand still." in other
    assert "\n- orca\n" in plain
    assert "\n- orca\n" not in other
    assert "`worlds/` holds the obstacles, goals" in other
    assert "`worlds/` holds the map, goals" in dataset_card(replace(manifest, config={"world": "map"}))


def test_card_of_a_dataset_without_optional_parts(tmp_path):
    columns = tuple(c for c in ALL_COLUMNS if c not in ("rings", "humans"))
    manifest = make_dataset(tmp_path, 1, 1, 40, worlds=False, scan_dtype="float32", columns=columns)
    assert "| `scan` | (1080,) float32 | m |" in dataset_card(manifest)
    assert "Humans per episode" not in dataset_card(manifest)


def test_estimate_is_near_for_full_size_columns():
    kwargs = {"n_rays": 1080, "scan_dtype": "uint16", "max_humans": 30}
    assert 1_600_000_000 < estimate_bytes(ALL_COLUMNS, 1_000_000, **kwargs) < 2_200_000_000
    less = estimate_bytes(("scan", "reward"), 1_000_000, **kwargs)
    assert less < estimate_bytes(ALL_COLUMNS, 1_000_000, **kwargs)
    assert MAX_HUMANS < 30
    assert chunk_rows(1000) == 25


@pytest.fixture
def six(tmp_path):
    """Six sequences in four shards: two for training, with 0, 3 and 4, 5, one each for val, 1, and test, 2."""
    make_dataset(tmp_path / "six", 6, 2, 50, by_rule=True)
    return tmp_path / "six"


@pytest.mark.slow
def test_a_part_of_a_dataset_is_a_dataset_that_says_so(six):
    whole = Manifest.read(six)
    assert select_shards(whole, range(len(whole.shards))) is whole
    part = select_shards(whole, [0, 3])
    assert Manifest.from_dict(json.loads(json.dumps(part.to_dict())), six) == part
    assert (part.complete, part.planned, part.sequences) == (False, whole.planned, 3)
    assert part.partial["manifest_sha256"] == whole.to_dict()["manifest_sha256"]
    assert {k: part.split_of(k) for k in (0, 3, 2)} == {0: "train", 3: "train", 2: "test"}
    assert part.split_of(1) is None
    assert part.rows == sum(whole.shards[k].rows for k in (0, 3))
    part.save(six, dataset_card(part))
    for gone in whole.shards[1:3]:
        (six / gone.file).unlink()
        (six / gone.worlds.file).unlink()
    assert verify(six).problems == []
    assert info(six)["splits"] == {"train": 2, "val": 0, "test": 1}
    assert "a part**: 2 of 4 shards, 3 of 6 sequences" in (six / "README.md").read_text()
    with DatasetFolder(six) as folder:
        assert set(folder.episodes.sequence.tolist()) == {0, 2, 3}
        assert folder.provenance["partial"] is True


@pytest.mark.slow
@pytest.mark.parametrize(
    ("asked", "chosen"),
    [
        ({}, [0, 1, 2, 3]),
        ({"split": "val"}, [2]),
        ({"split": "test"}, [3]),
        ({"split": "train", "shards": [1, 2]}, [1]),
    ],
)
def test_choose_shards(six, asked, chosen):
    assert choose_shards(Manifest.read(six), **asked) == chosen


@pytest.mark.slow
@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"split": "vall"}, "Unknown split 'vall'; expected train, val, test. Did you mean 'val'?"),
        ({"shards": [0, 4]}, "There is no shard 4, expected numbers from 0 to 3."),
        ({"split": "val", "shards": [1]}, "No shard is left"),
    ],
)
def test_choose_shards_refuses(six, asked, words):
    with pytest.raises(ConfigError, match=re.escape(words)):
        choose_shards(Manifest.read(six), **asked)


def test_content_hash_is_of_the_rows_alone(dataset, tmp_path):
    m = Manifest.read(dataset)
    assert content_hash(replace(m, license="mit", command="other", versions={})) == content_hash(m)
    one_shard = make_dataset(tmp_path / "one", 6, 6, 100)
    assert content_hash(one_shard) == content_hash(m)
    seen = {content_hash(m), content_hash(select_shards(m, [0])), content_hash(replace(m, columns=m.columns[:-1]))}
    digests = (*m.shards[0].sequence_hashes[::-1],)
    swapped = replace(m, shards=(replace(m.shards[0], sequence_hashes=digests), *m.shards[1:]))
    assert len({*seen, content_hash(swapped)}) == 4


def test_card_tells_the_hub_which_files_are_of_which_split(tmp_path):
    yaml = pytest.importorskip("yaml")
    manifest = make_dataset(tmp_path, 2, 1, 20, by_rule=True)
    head = yaml.safe_load(dataset_card(manifest).split("---\n")[1])
    files = {d["split"]: d["path"] for d in head["configs"][0]["data_files"]}
    assert files == {
        "train": "data/train-*.h5",
        "val": "data/val-*.h5",
    }
    assert "each file belongs to one split" in dataset_card(manifest)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"license": "my licence"}, "field 'license' is 'my licence', expected a licence identifier"),
        ({"extras": [{"file": "../x.png", "sha256": "0" * 64, "bytes": 1}]}, "points outside the dataset"),
        ({"extras": [{"file": "README.md", "sha256": "0" * 64, "bytes": 1}]}, "expected index.json, or a .png or .gif"),
        ({"extras": 2 * [{"file": "media/x.png", "sha256": "0" * 64, "bytes": 1}]}, "a file is listed twice"),
        ({"partial": {"manifest_sha256": "0" * 64, "shards": 1, "sequences": 1, "rows": 1}}, "both complete and part"),
        ({"partial": {"manifest_sha256": "0" * 64, "shards": -1}}, "field 'partial.shards' is -1"),
    ],
)
def test_publication_fields_are_checked(dataset, change, words):
    values = {**Manifest.read(dataset).to_dict(), **change}
    values["manifest_sha256"] = _hash(values)
    with pytest.raises(CorruptDataError, match=re.escape(words)):
        Manifest.from_dict(values, dataset)


def test_origin(dataset):
    assert read_origin(dataset) is None
    origin = Origin(
        "user/name", "a" * 40, "main", "https://hub.example", Manifest.read(dataset).to_dict()["manifest_sha256"]
    )
    origin.save(dataset)
    assert read_origin(dataset) == origin
    assert verify(dataset).ok
    assert info(dataset)["origin"]["commit"] == "a" * 40
    record = dataset_record(dataset)
    assert (record["repo"], record["revision"]) == ("user/name", "a" * 40)
    replace(origin, manifest_sha256="0" * 64).save(dataset)
    assert "names another dataset" in str(verify(dataset).problems)
    replace(origin, commit="main").save(dataset)
    with pytest.raises(CorruptDataError, match="expected user/name@commit"):
        read_origin(dataset)
