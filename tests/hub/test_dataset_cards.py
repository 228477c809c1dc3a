"""Dataset cards: current, true to what the package generates, and readable by the Hub."""

import io
from dataclasses import replace
from pathlib import Path

import dataset_cards as cards
import h5py
import numpy as np
import pytest
import yaml
from PIL import Image

from navrep_data.datasets import _hub_pictures, pull, push
from navrep_data.datasets._hub_pictures import draw_pictures
from navrep_data.datasets.tools import merge
from navrep_data.errors import ConfigError, MissingExtraError
from navrep_data.io import json_bytes, sha256_file
from navrep_data.shards import DatasetFolder, Manifest, dataset_card, split_of
from navrep_data.sim.drawing import scan_points
from navrep_data.sim.maps import load_map
from navrep_data.testing import tiny_dataset

FOLDER = Path(__file__).resolve().parents[2] / "cards" / "datasets"
ENVS = sorted(cards.PUBLISHED)
MAX_PICTURE_BYTES = 300_000
AGAIN = "run: python tools/dataset_cards.py cards/datasets"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("cards") / "tiny", n=4, length=60)


@pytest.mark.slow
def test_cards_are_current():
    committed = {path.stem: path.read_text() for path in FOLDER.glob("*.md")}
    assert set(committed) == set(ENVS) == {path.stem for path in FOLDER.glob("*.json")}, AGAIN
    for env in ENVS:
        manifest = cards.read_published(FOLDER, env)
        assert committed[env] == dataset_card(manifest), AGAIN
        assert (FOLDER / f"{env}.json").read_bytes() == json_bytes(manifest.to_dict())
        published = cards.PUBLISHED[env]
        assert (manifest.env, manifest.license, manifest.complete) == (env, published.license, True)
        assert manifest.command == published.command
        assert manifest.card_sha256 == sha256_file(FOLDER / f"{env}.md")


@pytest.mark.parametrize("env", ENVS)
def test_no_person_of_a_published_dataset_is_faster_than_people_walk(env):
    """ORCA once let one in 7,000 steps go at up to 4 m/s; the largest preferred speed is 1.2 m/s."""
    humans = cards.read_published(FOLDER, env).statistics["columns"]["humans"]
    assert max(abs(value) for name in ("min", "max") for value in humans[name][2:4]) <= 1.2


def test_pictures_are_those_of_the_manifests():
    listed = {}
    for env in ENVS:
        extras = cards.read_published(FOLDER, env).extras
        listed |= {e.file: e.sha256 for e in extras if e.file.startswith("media/")}
    there = {f"media/{path.name}": sha256_file(path) for path in (FOLDER / "media").iterdir()}
    assert there == listed
    assert {Path(name).name for name in listed} == {
        f"{env}-{kind}" for env in ENVS for kind in ("episode.gif", "scene.png")
    }
    for path in (FOLDER / "media").iterdir():
        assert path.stat().st_size < MAX_PICTURE_BYTES


@pytest.mark.parametrize("env", ENVS)
def test_card(env):
    manifest = cards.read_published(FOLDER, env)
    _, front, body = (FOLDER / f"{env}.md").read_text().split("---\n", 2)
    head = yaml.safe_load(front)
    assert head["license"] == cards.PUBLISHED[env].license
    assert set(head["task_categories"]) <= {"reinforcement-learning", "robotics"}
    assert head["size_categories"] == ["1M<n<10M" if manifest.rows >= 1_000_000 else "100K<n<1M"]
    assert {"navrep", "lidar"} <= set(head["tags"])
    files = [{"split": name, "path": f"data/{name}-*.h5"} for name in ("train", "val", "test")]
    assert head["configs"] == [{"config_name": "default", "data_files": files}]
    for title in ("How it was made", "Columns", "Outcomes", "Splits", "Statistics", "How to load it", "Known limits"):
        assert f"\n## {title}\n" in body
    for event, outcome in manifest.statistics["outcomes"].items():
        if outcome["episodes"]:
            assert f"| {event} | {outcome['episodes']:,} | {100 * outcome['share']:.1f} %" in body
    for extra in manifest.extras:
        if extra.file.startswith("media/"):
            assert f"]({extra.file})" in body
    assert "not made or endorsed by the NavRep authors" in body


@pytest.mark.parametrize("env", ENVS)
def test_cards_of_maps_say_that_the_maps_have_no_licence(env):
    card, config = (FOLDER / f"{env}.md").read_text(), cards.read_published(FOLDER, env).config
    on_maps = config.get("world") == "map"
    assert on_maps == (env == "ian")
    assert ("`asl-pepper-2d-sim`, which states no licence" in card) == on_maps
    assert ("humans that follow ORCA." in card) == ("\n- orca\n" in card) == (not on_maps)
    assert cards.PUBLISHED[env].license == ("other" if on_maps else "mit")  # nobody may licence others' maps


@pytest.mark.parametrize("env", ENVS)
def test_cards_say_how_seldom_the_robot_arrives_and_who_does_not_see_it(env):
    """Where that is so; the share is the statistics' own, without the episodes that were cut."""
    card, manifest = (FOLDER / f"{env}.md").read_text(), cards.read_published(FOLDER, env)
    on_maps = env == "ian"
    ended = {name: v["episodes"] for name, v in manifest.statistics["outcomes"].items() if name != "cut"}
    share = f"arrives in {100 * ended['goal'] / sum(ended.values()):.0f} % of the {sum(ended.values()):,} episodes"
    assert ("Half of all humans" in card) == (share in card) == (not on_maps)
    assert env != "soadrl" or "arrives in 12 %" in card


@pytest.mark.parametrize(("physics", "words"), [("imported", "original software"), ("recorded", "with a robot")])
def test_cards_of_imports_say_what_they_are(physics, words):
    made = cards.read_published(FOLDER, "soadrl")
    shards = tuple(replace(s, worlds=None) for s in made.shards)
    manifest = replace(
        made, physics=physics, config={"source": []}, policy={"name": "unknown"}, length=1001, shards=shards, command=""
    )
    card = dataset_card(manifest)
    _, front, body = card.split("---\n", 2)
    head = yaml.safe_load(front)
    assert not {"crowd", "orca"} & set(head["tags"])
    assert head["pretty_name"] == f"navrep-data soadrl ({physics})"
    lead = " ".join(body.split("## How")[0].split())
    assert words in lead
    assert "at most 1,001 steps" in lead
    assert not any(
        word in body for word in ("among humans", "crowd behind", "ORCA", "seed 0", "`worlds/`", "Half of all")
    )


def hashes(manifest):
    return {n: h for shard in manifest.shards for n, h in zip(shard.numbers, shard.sequence_hashes, strict=True)}


@pytest.mark.slow
@pytest.mark.parametrize("env", ENVS)
def test_the_package_generates_what_the_card_describes(env, tmp_path):
    """The first sequences of the published dataset, made again: a sequence depends on seed and number alone."""
    import shlex

    from navrep_data.cli import main as cli

    manifest = cards.read_published(FOLDER, env)
    words = shlex.split(manifest.command)
    assert words[:2] == ["navrep-data", "generate"]
    words[words.index("--n") + 1] = "12"  # a rare case may first show in a later one
    with pytest.raises(SystemExit) as done:
        cli.run([*words[1:], "--out", str(tmp_path), "--workers", "1"])
    assert done.value.code == 0
    again = Manifest.read(tmp_path)
    if again.versions != manifest.versions:
        pytest.skip("other versions or another CPU: bytes are promised for those of the manifest")
    made, published = hashes(again), hashes(manifest)
    assert set(made) == set(range(12))
    assert made == {number: published[number] for number in made}


@pytest.mark.slow
def test_add_takes_over_a_dataset(simulated, tmp_path, monkeypatch):
    monkeypatch.setattr(cards, "PUBLISHED", {"soadrl": cards.PUBLISHED["soadrl"]})
    cards.add(tmp_path, simulated)
    assert cards.write_cards(tmp_path) == [tmp_path / "soadrl.md"]
    assert "license: mit" in (tmp_path / "soadrl.md").read_text()
    assert sorted(p.name for p in (tmp_path / "media").iterdir()) == ["soadrl-episode.gif", "soadrl-scene.png"]
    monkeypatch.setattr(cards, "PUBLISHED", {})
    with pytest.raises(ConfigError, match="a dataset of soadrl, which is not in PUBLISHED: add its line"):
        cards.add(tmp_path, simulated)


@pytest.mark.slow
def test_one_command_makes_dataset_and_card(tmp_path, monkeypatch, capfd):
    line = cards.Published("navrep-data generate --env empty --n 2 --length 60", "mit")
    monkeypatch.setattr(cards, "PUBLISHED", {"empty": line})
    found = []
    for _ in range(2):
        cards.main([str(tmp_path / "cards"), "--data", str(tmp_path / "data")])
        found.append({p.relative_to(tmp_path): sha256_file(p) for p in tmp_path.rglob("*") if p.is_file()})
    assert found[0] == found[1]  # what is there is not made anew
    assert Manifest.read(tmp_path / "data" / "empty").rows == 120
    assert "navrep-data generate --env empty --n 2" in (tmp_path / "cards" / "empty.md").read_text()
    assert str(tmp_path / "cards" / "empty.md") in capfd.readouterr().out


# ---- pictures ----


@pytest.mark.slow
def test_pictures_are_drawn_from_the_data(simulated):
    with DatasetFolder(simulated) as folder:
        made = draw_pictures(folder)
    gif, png = (Image.open(io.BytesIO(made[f"media/soadrl-{name}"])) for name in ("episode.gif", "scene.png"))
    assert len(made["media/soadrl-episode.gif"]) < MAX_PICTURE_BYTES
    assert png.size == (1100, 600)
    assert 10 <= gif.n_frames <= 48
    assert gif.info["loop"] == 0
    first = np.asarray(gif.convert("RGB"))
    gif.seek(gif.n_frames - 1)
    last = np.asarray(gif.convert("RGB"))
    assert (first != last).any(axis=2).mean() > 0.01  # it moves
    for colour in ((209, 73, 91), (46, 134, 171)):  # the robot's red, somebody's blue
        distance = np.abs(np.asarray(png.convert("RGB")).astype(int) - colour).sum(axis=2)
        assert (distance < 30).any()


@pytest.mark.slow
def test_pictures_on_maps_show_what_the_lidar_saw(tmp_path):
    """The data do not hold the map; walls are where rays ended, and nobody's legs are among them."""
    from navrep_data.generate import generate

    try:
        load_map("asl")
    except MissingExtraError as missing:
        pytest.skip(str(missing))
    generate(env="ian", n=1, length=60, out=tmp_path / "ian", workers=1)
    with DatasetFolder(tmp_path / "ian") as folder:
        episode = _hub_pictures._choose(folder)
        made = draw_pictures(folder)
        assert episode is not None
        grid = load_map(episode.world.map).local
        cells = grid.cell_of(episode.walls)
        inside = grid.contains(episode.walls)
        assert inside.mean() > 0.95
        near = grid.distance[tuple(cells[inside].T)]
        assert (near < 0.3).mean() > 0.95
        pose = episode.rows["robot_pose"][0]
        ends = scan_points(episode.metres(0), pose, folder.manifest.sensor)
        human = _hub_pictures._to_world(episode.rows["humans"][0], pose)[0]
        ends[5] = human[:2] + 0.2  # somebody's leg
        left = episode._fixed(ends, 0)
        assert 500 < len(left) < len(ends)
        assert (np.hypot(*(left - human[:2]).T) > human[4]).all()
    assert set(made) == {"media/ian-episode.gif", "media/ian-scene.png"}
    assert all(len(data) < MAX_PICTURE_BYTES for data in made.values())
    png = np.asarray(Image.open(io.BytesIO(made["media/ian-scene.png"])).convert("RGB")).astype(int)
    assert (np.abs(png - (0x5B, 0x64, 0x70)).sum(axis=2) < 30).sum() > 200  # walls


def test_no_pictures_without_worlds_or_humans(simulated, monkeypatch):
    with DatasetFolder(simulated) as folder:
        folder.manifest = replace(
            folder.manifest, shards=tuple(replace(s, worlds=None) for s in folder.manifest.shards)
        )
        assert draw_pictures(folder) == {}
        folder.manifest = replace(folder.manifest, columns=tuple(c for c in folder.manifest.columns if c != "humans"))
        assert draw_pictures(folder) == {}


# ---- the Hub's viewer ----


@pytest.fixture
def loader(monkeypatch, tmp_path):
    """``datasets.load_dataset``, which the Hub's viewer runs on; it must not ask the network."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    datasets = pytest.importorskip("datasets")
    return lambda *a, **k: datasets.load_dataset(*a, cache_dir=str(tmp_path / "cache"), **k)


def check_rows(table, shards):
    at = 0
    for path in shards:
        with h5py.File(path) as shard:
            rows = len(shard["reward"])
            part = table.with_format("numpy")[at : at + rows]
            for name, column in shard.items():
                stored = column[:]
                if stored.dtype == np.float64:  # the numpy format of datasets gives float32
                    stored = stored.astype(np.float32)
                assert part[name].dtype.kind == stored.dtype.kind or part[name].dtype == np.int64
                assert np.array_equal(part[name], stored, equal_nan=stored.dtype.kind == "f"), name
            at += rows
    assert at == len(table)


@pytest.mark.slow
def test_load_dataset_opens_the_shards(loader, template):
    shards = sorted((template / "data").glob("*.h5"))
    table = loader("hdf5", data_files=[str(path) for path in shards], split="train")
    with h5py.File(shards[0]) as shard:
        assert set(table.column_names) == set(shard)
    check_rows(table, shards)


@pytest.mark.slow
@pytest.mark.parametrize("shard_size", [1, 2])
def test_load_dataset_understands_the_card(loader, tmp_path, shard_size):
    """What the viewer does: the front matter of README.md says which files are which split."""
    from shards.synthetic import make_dataset

    root = tmp_path / "set"
    manifest = make_dataset(root, 14, shard_size, 20, by_rule=True)
    tables = loader(str(root))
    assert set(tables) == {"train", "val", "test"}
    for name, table in tables.items():
        check_rows(table, [root / s.file for s in manifest.shards if s.split == name])
        assert set(table["sequence"]) == {k for k in range(14) if split_of(k) == name}


@pytest.mark.slow
def test_load_dataset_of_merged_and_of_partly_pulled_datasets(hub, request, tmp_path):
    made = [tiny_dataset(tmp_path / str(seed), n=13, length=20, seed=seed) for seed in (0, 1)]
    merge(made, tmp_path / "merged")
    push(made[0], "user/crowd", license="mit")
    pull("user/crowd", tmp_path / "part", shards=[1, 6])
    loader = request.getfixturevalue("loader")  # from here on nothing is asked of any network
    for root, splits in ((tmp_path / "merged", {"train", "val", "test"}), (tmp_path / "part", {"train", "test"})):
        tables = loader(str(root))
        manifest = Manifest.read(root)
        assert set(tables) == splits == {shard.split for shard in manifest.shards}
        for name, table in tables.items():
            check_rows(table, [root / s.file for s in manifest.shards if s.split == name])
