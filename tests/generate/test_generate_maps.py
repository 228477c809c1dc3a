"""Datasets in worlds on maps: made by the same generator, the same bytes however they were made."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from navrep_data.errors import DatasetMismatchError, MissingExtraError
from navrep_data.generate import generate, regenerate
from navrep_data.shards import Manifest, read_worlds, verify
from navrep_data.sim import environment_names, load_map, make_config, map_names


@pytest.fixture
def hall(tmp_path: Path) -> str:
    """Return a map of 12 x 9 m with a wall that leaves a gap."""
    grey = np.full((90, 120), 254, np.uint8)
    grey[[0, -1], :] = grey[:, [0, -1]] = 0
    grey[:60, 58:60] = 0
    folder = tmp_path / "hall"
    folder.mkdir()
    Image.fromarray(grey).save(folder / "hall.png")
    (folder / "hall.yaml").write_text(
        "image: hall.png\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
    )
    return str(folder)


def toward_goal(scan: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Go straight to the goal."""
    gap = np.linalg.norm(state[:, :2], axis=1, keepdims=True)
    return 0.5 * state[:, :2] / np.maximum(gap, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["orca", toward_goal])
def test_dataset_on_an_own_map(hall: str, tmp_path: Path, policy: object) -> None:
    kwargs = {"env": "map", "maps": [hall], "humans": 3, "length": 60, "seed": 3, "policy": policy, "policy_batch": 4}
    size = 4 if callable(policy) else 3
    generate(n=3, out=tmp_path / "a", shard_size=size, **kwargs)
    root = tmp_path / "a"
    assert verify(root).problems == []
    manifest = Manifest.read(root)
    assert manifest.config["maps"] == [hall]
    worlds = read_worlds(root / manifest.shards[0].worlds.file)
    first = worlds.episode(0)
    assert (first.map, first.map_hash, first.scenario) == ("hall", load_map(hall).hash, "")
    assert first.polygons == ()
    assert len(first.human_start) <= 4
    generate(n=2, out=tmp_path / "b", shard_size=size, **kwargs)
    fewer = Manifest.read(tmp_path / "b")
    assert fewer.shards[0].sequence_hashes == manifest.shards[0].sequence_hashes[:2]
    if not callable(policy):
        report = regenerate(root, 2)
        assert [found.verdict for found in report.comparisons] == ["equal bytes"] * 2


@pytest.mark.slow
@pytest.mark.parametrize("origin", [(-6.0, -4.5), (456000.25, 5428000.5)])
def test_rows_do_not_depend_on_where_the_map_lies(hall: str, origin: tuple[float, float], tmp_path: Path) -> None:
    kwargs = {"env": "map", "humans": 3, "length": 40, "n": 3, "seed": 3}
    generate(out=tmp_path / "a", maps=[hall], **kwargs)
    path = Path(hall) / "hall.yaml"
    path.write_text(path.read_text().replace("[0, 0, 0]", str([*origin, 0])))
    generate(out=tmp_path / "b", maps=[hall], **kwargs)
    made, moved = (Manifest.read(tmp_path / name) for name in "ab")
    assert moved.inputs == made.inputs
    assert (made.origins, moved.origins) == ({}, {f"map:{hall}": origin})
    assert [s.sha256 for s in moved.shards] == [s.sha256 for s in made.shards]
    assert [s.worlds.sha256 for s in moved.shards] == [s.worlds.sha256 for s in made.shards]
    with pytest.raises(DatasetMismatchError, match=r"origin of map .* at None, which .* puts at"):
        generate(out=tmp_path / "a", maps=[hall], **{**kwargs, "n": 4})
    assert [one.verdict for one in regenerate(tmp_path / "a", 3).comparisons] == ["equal bytes"] * 3


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["consistent", "original"])
@pytest.mark.parametrize("env", environment_names())
def test_every_environment_feeds_generate(env: str, physics: str, tmp_path: Path) -> None:
    on_map = make_config(env).world == "map"
    if on_map:
        try:
            map_names()
        except MissingExtraError as error:
            pytest.skip(str(error))
    generate(env=env, physics=physics, n=1, length=60, out=tmp_path / "d", seed=1)
    assert verify(tmp_path / "d").problems == []
    manifest = Manifest.read(tmp_path / "d")
    assert (manifest.env, manifest.physics, manifest.rows) == (env, physics, 60)
    assert ("which states no licence" in (tmp_path / "d" / "README.md").read_text()) == on_map
    # the scripted robot goes somewhere
    with h5py.File(tmp_path / "d" / manifest.shards[0].file) as shard:
        pose = shard["robot_pose"][:]
    assert np.ptp(pose[:, :2], axis=0).max() > 0.5
