"""Maps and policies of datasets: found again from other folders, and refused where they are not what they were."""

from __future__ import annotations

import hashlib
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from navrep_data.datasets.tools import merge
from navrep_data.errors import DatasetError, DatasetMismatchError, MapError
from navrep_data.generate import generate, merge_manifest, regenerate
from navrep_data.generate.inputs import check_here, inputs_of
from navrep_data.generate.policy import make_policy
from navrep_data.shards import Manifest
from navrep_data.sim import load_map, make_config
from navrep_data.sim.map_tables import map_world_data

SETTINGS = {"env": "map", "humans": 0, "length": 4, "shard_size": 1, "rings": False}


def draw(folder: Path, wall: int = 0, origin: int = 0) -> None:
    """Write a map of 5 x 4 m; with a wall of so many cells."""
    grey = np.full((40, 50), 254, np.uint8)
    grey[[0, -1], :] = grey[:, [0, -1]] = 0
    grey[20, 20 : 20 + wall] = 0
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(grey).save(folder / "map.png")
    (folder / "map.yaml").write_text(
        f"image: map.png\nresolution: 0.1\norigin: [{origin}, 0, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
    )


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a working folder with a map in ``a/m``."""
    draw(tmp_path / "a" / "m")
    (tmp_path / "b").mkdir()
    monkeypatch.chdir(tmp_path / "a")
    return tmp_path


@pytest.mark.slow
def test_a_dataset_is_not_extended_on_an_edited_map(here: Path) -> None:
    generate(n=1, out="../d", maps=["./m"], **SETTINGS)
    before = (here / "d" / "manifest.json").read_bytes()
    draw(here / "a" / "m", wall=9)
    with pytest.raises(DatasetMismatchError, match=r"made on a map '\.\./a/m' with content \w{12}, asked for .*edited"):
        generate(n=2, out="../d", maps=["./m"], **SETTINGS)
    with pytest.raises(DatasetMismatchError, match="has been edited, or is another one"):
        regenerate("../d", 1)
    assert (here / "d" / "manifest.json").read_bytes() == before


@pytest.mark.slow
def test_parts_made_on_two_maps_are_not_merged(here: Path) -> None:
    generate(n=2, out="p", maps=["./m"], shard_range="0/2", **SETTINGS)
    draw(here / "a" / "m", wall=9)
    generate(n=2, out="p", maps=["./m"], shard_range="1/2", **SETTINGS)
    with pytest.raises(DatasetMismatchError, match=r"Part 1/2 was made with inputs.map:\.\./m=\w{32}, part 0/2 with"):
        merge_manifest("p")


POLICY = "import numpy as np\n\n\ndef drive(scan, state):\n    return np.full((len(scan), 2), {speed})\n"


def test_a_dataset_is_not_extended_by_an_edited_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    settings = {"policy": "edited_later:drive", "policy_batch": 1, "humans": 1, "length": 4, "shard_size": 1}
    module = tmp_path / "edited_later.py"
    module.write_text(POLICY.format(speed=0.5))
    generate(n=1, out="d", **settings)
    assert Manifest.read("d").inputs == {"policy": hashlib.sha256(module.read_bytes()).hexdigest()}
    assert regenerate("d", 1).ok
    generate(n=2, out="p", shard_range="0/2", **settings)
    before = (tmp_path / "d" / "manifest.json").read_bytes()
    module.write_text(POLICY.format(speed=0.25))
    words = r"made by edited_later:drive with content \w{12}, which is \w{12} now: the policy has been edited"
    with pytest.raises(DatasetMismatchError, match=words):
        generate(n=2, out="d", **settings)
    with pytest.raises(DatasetMismatchError, match=words):
        regenerate("d", 1)
    assert (tmp_path / "d" / "manifest.json").read_bytes() == before
    generate(n=2, out="p", shard_range="1/2", **settings)
    with pytest.raises(DatasetMismatchError, match=r"Part 1/2 was made with inputs.policy=\w{64}, part 0/2 with"):
        merge_manifest("p")


@pytest.mark.parametrize("what", ["map", "policy"])
def test_workers_compare_what_they_find(here: Path, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node may have another map at the same path, or another module."""
    config = make_config("map", maps=("./m",), humans=0)
    monkeypatch.syspath_prepend(here / "a")
    (here / "a" / f"drives_{what}.py").write_text(POLICY.format(speed=0.5))
    policy = make_policy(f"drives_{what}:drive", 1)
    began = inputs_of(config, policy)
    assert set(began) == {"map:./m", "policy"}
    check_here(began, config, policy, "here")
    if what == "map":
        draw(here / "a" / "m", wall=9)
    else:
        (here / "a" / f"drives_{what}.py").write_text(POLICY.format(speed=0.25))
    with pytest.raises(DatasetMismatchError, match=rf"The {what} .* has content \w{{12}} on node x, but the run began"):
        check_here(began, config, policy, "on node x")


@pytest.mark.slow
def test_a_dataset_finds_its_map_from_another_folder(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    generate(n=1, out="../d", maps=["./m"], **SETTINGS)
    assert Manifest.read(here / "d").config["maps"] == ["../a/m"], "from the dataset's folder"
    monkeypatch.chdir(here / "b")
    assert [found.verdict for found in regenerate("../d", 1).comparisons] == ["equal bytes"]
    # the same map by other paths
    shutil.copytree(here / "a" / "m", here / "copy")
    for n, path in enumerate(("../a/m", str(here / "a" / "m" / "map.yaml"), "../copy"), start=2):
        assert generate(n=n, out="../d", maps=[path], **SETTINGS).sequences == n
    assert Manifest.read(here / "d").config["maps"] == ["../a/m"]
    whole = generate(n=4, out="../e", maps=["../a/m"], **SETTINGS)
    d, e = (Manifest.read(here / name).shards for name in "de")
    assert [entry.sha256 for entry in d] == [entry.sha256 for entry in e], "however it grew"
    assert whole.sequences == 4
    # the map is gone, and named anew
    shutil.rmtree(here / "a")
    with pytest.raises(MapError, match=r"Map '\.\./a/m' of .* is not at .*name its path by --map"):
        regenerate("../d", 1)
    assert regenerate("../d", 1, maps=["../copy"]).ok
    with pytest.raises(MapError, match="2 maps are given by --map"):
        regenerate("../d", 1, maps=["../copy", "../copy"])


def test_a_config_reads_its_maps_from_where_they_were(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = make_config("map", maps=("./m",), humans=0)
    expected = load_map("./m").hash
    monkeypatch.chdir(here / "b")
    assert config.maps == ("./m",)
    for other in (config, pickle.loads(pickle.dumps(config)), config.replace(robots=2)):  # noqa: S301
        assert map_world_data(other).maps[0].hash == expected
    assert config == make_config("map", maps=("./m",), humans=0), "where a map is read from is no setting"
    assert "map_files" not in config.full_dict()


def edit(root: Path, **values: object) -> None:
    """Change fields of a manifest that stays one in itself."""
    manifest = Manifest.read(root)
    replace(manifest, **values).save(root)


@pytest.mark.slow
@pytest.mark.usefixtures("maps")
@pytest.mark.parametrize("settings", [{"env": "crowdmove-1"}, {"env": "map", "maps": ["crowdmove1"]}, {"env": "ian"}])
def test_datasets_on_the_papers_maps_are_proved_and_their_maps_compared(settings: dict, tmp_path: Path) -> None:
    root = tmp_path / "d"
    generate(n=1, out=root, length=5, rings=False, **settings)
    assert regenerate(root, 1).ok
    known = Manifest.read(root).inputs
    name = sorted(known)[0]
    edit(root, inputs={**known, name: "0" * 32})
    with pytest.raises(DatasetMismatchError, match=r"has been edited|was made from"):
        regenerate(root, 1)
    edit(root, inputs={**known, "map:elsewhere": "0" * 32})
    with pytest.raises(DatasetMismatchError, match=r"was made from map:elsewhere with content 0000.*unknown here"):
        regenerate(root, 1)


@pytest.mark.slow
def test_what_a_merged_dataset_was_made_from_stays_known(here: Path) -> None:
    """Two maps of one name, apart in content and place."""
    generate(n=1, out="../d", maps=["./m"], **SETTINGS)
    draw(here / "a" / "m", wall=9, origin=7)
    generate(n=1, out="../e", maps=["./m"], seed=1, **SETTINGS)
    merge(["../d", "../e"], "../both")
    one, other, both = (Manifest.read(here / name) for name in ("d", "e", "both"))
    assert (both.inputs, both.origins) == ({}, {})
    assert [r["inputs"] for r in both.source] == [one.inputs, other.inputs]
    assert [r["origins"] for r in both.source] == [{}, {"map:../a/m": [7.0, 0.0]}]
    assert one.inputs != other.inputs


def test_a_manifest_whose_rule_of_splits_or_batch_is_another_is_not_gone_on_with(tmp_path: Path) -> None:
    root = tmp_path / "d"
    settings = {"humans": 1, "length": 4, "out": root, "rings": False, "policy": "goal", "policy_batch": 2}
    generate(n=1, **settings)
    edit(root, split_rule="as I like")
    with pytest.raises(DatasetMismatchError, match="was made with split_rule=as I like, asked for split_rule=sequence"):
        generate(n=2, **settings)
    for batch in ("x", 0, None, [2], True):
        edit(root, policy={"name": "goal", "batch": batch})
        with pytest.raises(DatasetError, match=r"says policy\.batch is .*, expected 1 to 4096"):
            regenerate(root, 1)
