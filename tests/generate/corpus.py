"""Small datasets of every environment, physics and option, and the hashes of what is in them.

``python tests/generate/corpus.py`` writes ``tests/data/corpus.json`` again: only where bytes are meant to change.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from navrep_data.generate.plan import check_settings, make_request, versions
from navrep_data.generate.policy import make_policy
from navrep_data.generate.worker import all_shards, make_shard, rollout_of
from navrep_data.shards import read_worlds
from navrep_data.sim import environment_names, make_config

RECORDED = Path(__file__).resolve().parents[1] / "data" / "corpus.json"
LENGTH, SEQUENCES, SEED = 30, 3, 11
HALL = "./hall"
"""The map of one's own, from the folder that a recipe is made in."""

Recipe = tuple[str, dict[str, Any], dict[str, Any]]
"""Environment, fields of the config, options of the rows and the policy."""

RECIPES: dict[str, Recipe] = {
    **{f"{env} {physics}": (env, {"physics": physics}, {})
       for env in environment_names() if env != "map" for physics in ("consistent", "original")},
    "trunk": ("soadrl", {"rendering": "trunk"}, {}),
    "ellipse": ("soadrl", {"rendering": "ellipse"}, {}),
    "inertia": ("soadrl", {"inertia": "limited"}, {}),
    "differential": ("soadrl", {"drive": "differential"}, {}),
    "damage": ("soadrl", {"on_collision": "damage"}, {"policy": "random-momentum"}),
    "robots": ("soadrl", {"robots": 3, "rendering": "trunk", "humans": 5}, {"labels": True}),
    "noise": ("soadrl", {"scan_noise": 0.05, "scan_dropout": 0.1}, {"labels": True}),
    "labels": ("soadrl", {}, {"labels": True}),
    "labels of ellipses": ("soadrl", {"rendering": "ellipse"}, {"labels": True}),
    "labels original": ("soadrl", {"physics": "original"}, {"labels": True}),
    "straight people": ("soadrl", {"human_policy": "constant-velocity"}, {}),
    "float32": ("soadrl", {}, {"scan_dtype": "float32"}),
    "bare": ("soadrl", {}, {"rings": False, "humans": False}),
    "python policy": ("soadrl", {}, {"policy": "half_speed"}),
    "map": ("map", {"maps": (HALL,), "humans": 4}, {"labels": True}),
    "map orca": ("map", {"maps": (HALL,), "humans": 4, "human_policy": "orca"}, {}),
    "map original": ("map", {"maps": (HALL,), "physics": "original"}, {}),
    "map damage": ("map", {"maps": (HALL,), "humans": 4, "on_collision": "damage"}, {"policy": "random-momentum"}),
    "map ellipse": ("map", {"maps": (HALL,), "humans": 4, "rendering": "ellipse"}, {"labels": True}),
    "map trunk": ("map", {"maps": (HALL,), "humans": 4, "rendering": "trunk", "drive": "differential"}, {}),
    "map robots": ("map", {"maps": (HALL,), "robots": 2, "humans": 2, "inertia": "limited"}, {"labels": True}),
    "map noise": ("map", {"maps": (HALL,), "humans": 4, "scan_noise": 0.05}, {"labels": True}),
    "map python policy": ("map", {"maps": (HALL,), "humans": 2}, {"policy": "half_speed"}),
}  # fmt: skip


def half_speed(scan: np.ndarray, robot_state: np.ndarray) -> np.ndarray:
    """Go to the goal at half a metre per second."""
    gap = np.linalg.norm(robot_state[:, :2], axis=1, keepdims=True)
    return 0.5 * robot_state[:, :2] / np.maximum(gap, 0.5)


def write_hall(folder: Path) -> None:
    """Write the map: 12 x 9 m, far from its frame's origin of the file, with a wall that leaves a gap."""
    grey = np.full((90, 120), 254, np.uint8)
    grey[[0, -1], :] = grey[:, [0, -1]] = 0
    grey[:60, 58:60] = 0
    (folder / "hall").mkdir()
    Image.fromarray(grey).save(folder / "hall" / "hall.png")
    (folder / "hall" / "hall.yaml").write_text(
        "image: hall.png\nresolution: 0.1\norigin: [-3, -2, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
    )


def hash_of(arrays: Mapping[str, np.ndarray]) -> str:
    """Return a hash of names, types, shapes and numbers."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(repr((name, array.dtype.str, array.shape)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def make(name: str, root: Path) -> dict[str, list[str]]:
    """Make a dataset of the corpus in `root`, from the working folder with the hall, and return its hashes."""
    env, fields, options = RECIPES[name]
    options = dict(options)
    policy = options.pop("policy", "orca")
    spec = make_policy(half_speed if policy == "half_speed" else policy, 2)
    if spec.spec is not None:  # neither this file's content nor how it is imported is to count
        spec = replace(spec, name=policy, spec=replace(spec.spec, files={}))
    rows = {"scan_dtype": None, "rings": True, "humans": True, "labels": False} | options
    config = make_config(env, curriculum="constant", **fields)
    request = make_request(root, config, check_settings(config, LENGTH, **rows), spec, SEED, SEQUENCES, 8)
    rollout = rollout_of(request.spec)
    entries = [make_shard(request.spec, task, rollout, lambda rows: None) for task in all_shards(SEQUENCES, 8)]
    return {
        "sequences": [digest for entry in entries for digest in entry.sequence_hashes],
        "worlds": [hash_of(read_worlds(root / entry.worlds.file).arrays) for entry in entries if entry.worlds],
        "files": [file.sha256 for entry in entries for file in (entry, entry.worlds) if file],
    }


def main() -> None:
    """Write all hashes."""
    import os

    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        write_hall(Path(folder))
        found = {}
        for number, name in enumerate(RECIPES):
            found[name] = make(name, Path(folder) / str(number))
    RECORDED.write_text(json.dumps({"versions": versions(), "datasets": found}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
