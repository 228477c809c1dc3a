"""The format as docs/format.md says it: a reader made from that page alone, without this package, reads the same."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from navrep_data.generate import generate
from navrep_data.observations import metres_from_millimetres
from navrep_data.schema import COLUMNS
from navrep_data.shards import DatasetFolder
from navrep_data.shards.worlds import DRAWN_WORLD_FIELDS, MAP_WORLD_FIELDS, WORLD_FIELDS
from navrep_data.testing import tiny_dataset


# --- what somebody else might write: plain h5py, numpy and json, nothing of navrep_data ------------------------------
def read_dataset(root: Path) -> dict[str, list[dict]]:
    """Return the episodes of each split."""
    manifest = json.loads((root / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["format"] == "navrep-data"
    assert manifest["format_version"] == 2
    assert manifest["complete"]
    splits: dict[str, list[dict]] = {"train": [], "val": [], "test": []}
    for entry in manifest["shards"]:
        data = (root / entry["file"]).read_bytes()
        assert len(data) == entry["bytes"]
        assert hashlib.sha256(data).hexdigest() == entry["sha256"]
        assert entry["file"].startswith(f"data/{entry['split']}-")
        numbers = [k for start, stop in entry["sequences"] for k in range(start, stop)]
        worlds = np.load(root / entry["worlds"]["file"], allow_pickle=False) if entry["worlds"] else None
        with h5py.File(root / entry["file"]) as file:
            assert file.attrs["split"].decode() == entry["split"]
            assert (file.attrs["sequences"], file.attrs["rows"]) == (len(numbers), entry["rows"])
            columns = {name: file[name][:] for name in file}
            scale = float(file["scan"].attrs.get("scale", 1.0))
            range_max = float(file.attrs["range_max"])
        assert set(columns) == set(manifest["columns"])
        assert np.unique(columns["sequence"]).tolist() == numbers
        splits[entry["split"]] += episodes(columns, scale, range_max, worlds)
    return splits


def episodes(columns: dict, scale: float, range_max: float, worlds: object) -> list[dict]:
    """Cut the rows of a file into episodes: T actions, T + 1 observations."""
    first = np.flatnonzero(columns["is_first"])
    last = np.flatnonzero(columns["is_last"])
    assert len(first) == len(last)
    found = []
    for k, (start, stop) in enumerate(zip(first, last + 1, strict=True)):
        rows = {name: values[start:stop] for name, values in columns.items()}
        stored = rows["scan"].astype(np.float32) * np.float32(scale)
        actions = stop - start - 1
        assert not rows["action"][actions].any()
        assert rows["event"][:actions].max(initial=0) == 0 < rows["event"][actions]
        one = {**rows, "ranges": np.where(rows["scan"] == 0, np.nan, stored), "hit": stored < range_max}
        if worlds is not None:
            assert (worlds["sequence"][k], worlds["episode"][k]) == (rows["sequence"][0], rows["episode"][0])
            people = slice(*worlds["human_offset"][k : k + 2])
            one |= {"goal": worlds["robot_goal"][k], "people": worlds["human_start"][people]}
        found.append(one)
    return found


# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_reader_made_from_the_page_reads_what_is_there(tmp_path):
    generate(env="soadrl", n=12, length=50, out=tmp_path / "d", seed=3, shard_size=4, labels=True)
    splits = read_dataset(tmp_path / "d")
    for split, found in splits.items():
        names = ("scan", "ranges", "scan_label", "sequence", "event", "robot_state")
        rows = {name: np.concatenate([one[name] for one in found]) for name in names}
        with DatasetFolder(tmp_path / "d") as folder:
            shards = [(k, s.rows) for k, s in enumerate(folder.manifest.shards) if s.split == split]
            for name in ("scan", "scan_label", "sequence", "event", "robot_state"):
                ours = np.concatenate([folder.read(name, k, 0, count) for k, count in shards])
                np.testing.assert_array_equal(rows[name], ours)
            np.testing.assert_allclose(rows["ranges"], metres_from_millimetres(rows["scan"]), rtol=1e-6)
        assert {k % 10 for k in rows["sequence"].tolist()} == {"train": {0, *range(3, 10)}, "val": {1}, "test": {2}}[
            split
        ]
        # a goal is told in the robot's frame, and the worlds file tells it in the world's
        for one in found:
            x, y, theta = one["robot_pose"][0]
            dx, dy = one["goal"] - (x, y)
            there = np.cos(theta) * dx + np.sin(theta) * dy, np.cos(theta) * dy - np.sin(theta) * dx
            np.testing.assert_allclose(one["robot_state"][0, :2], there, atol=1e-4)
            hit = one["scan_label"] > 0
            assert (hit <= one["hit"]).mean() > 0.999
            assert one["scan_label"].max() < 3 + one["humans"].shape[1]
    assert sum(len(found) for found in splits.values()) > 12


def test_the_page_names_every_column_array_field_and_attribute(tmp_path):
    page = (Path(__file__).resolve().parents[2] / "docs" / "format.md").read_text(encoding="utf-8")
    root = tiny_dataset(tmp_path / "d", n=1, length=20)
    manifest = json.loads((root / "manifest.json").read_text(encoding="utf-8"))
    with h5py.File(root / manifest["shards"][0]["file"]) as file:
        attributes = list(file.attrs)
    names = [*COLUMNS, *WORLD_FIELDS, *MAP_WORLD_FIELDS, *DRAWN_WORLD_FIELDS, *manifest, *attributes]
    names += [*manifest["shards"][0], *manifest["sensor"]]
    assert [name for name in dict.fromkeys(names) if f"`{name}`" not in page] == []
