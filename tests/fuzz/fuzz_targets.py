"""Everything that reads files from outside, each with a valid file made by this package to start from.

A reader that is new gets an entry in :data:`TARGETS`: a function that makes valid files in a folder, and one that reads
them there as deeply as users do.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_edits import Files
from PIL import Image

from navrep_data.errors import NavrepDataError
from navrep_data.io import json_bytes
from navrep_data.schema import EVENT_NAMES


@dataclass(frozen=True)
class Target:
    """One reader.

    Attributes
    ----------
    name : str
        For reports and the command line.
    make : callable
        Fills the empty folder it is given with valid files.
    read : callable
        Reads the files of a folder; raises nothing but errors of this package.
    seal : callable
        Makes hashes right again that the files hold of each other, so that changes are not only found by hash.
    """

    name: str
    make: Callable[[Path], None]
    read: Callable[[Path], None]
    seal: Callable[[Files], Files] = dict


def load_files(folder: Path) -> Files:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _hashed(values: Any, key: str = "manifest_sha256") -> bytes:
    if isinstance(values, dict):
        with contextlib.suppress(ValueError, RecursionError):
            values[key] = hashlib.sha256(json_bytes({k: v for k, v in values.items() if k != key})).hexdigest()
    with contextlib.suppress(ValueError, RecursionError):
        return json_bytes(values)
    return json.dumps(values).encode()


def _sealed(files: Files, name: str, change: Callable[[Any], None]) -> Files:
    """Return `files` with JSON file `name` changed and its own hash made right; unchanged where it is no JSON."""
    try:
        values = json.loads(files[name])
        with contextlib.suppress(KeyError, TypeError, IndexError, AttributeError):
            change(values)
        return {**files, name: _hashed(values)}
    except (KeyError, ValueError, RecursionError):
        return files


# --- datasets ---------------------------------------------------------------------------------------------------


@cache
def _simulated() -> Files:
    from navrep_data.testing import tiny_dataset

    with tempfile.TemporaryDirectory() as name:
        root = tiny_dataset(Path(name) / "tiny", n=4, length=24, humans=2, obstacles=1)
        return {
            name: data
            for name, data in load_files(root).items()
            if name.startswith(("data/", "worlds/")) or "." in name
        }


def _make_dataset(folder: Path) -> None:
    for name, data in _simulated().items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)


def _make_manifest(folder: Path) -> None:
    from navrep_data.shards import FileEntry, Manifest, Origin

    _make_dataset(folder)
    manifest = Manifest.read(folder)
    extra = FileEntry("media/scene.png", "0" * 64, 5)
    replace(manifest, license="mit", extras=(extra,)).save(folder)
    Origin("user/name", "0" * 40, "main", "https://huggingface.co", "1" * 64).save(folder)
    for name in ("data", "worlds"):
        shutil.rmtree(folder / name)


def _read_manifest(folder: Path) -> None:
    from navrep_data.shards import Manifest, content_hash, dataset_card, info

    manifest = Manifest.read(folder)
    json.dumps(info(folder), allow_nan=False).encode()
    dataset_card(manifest).encode()
    json_bytes(manifest.to_dict())
    content_hash(manifest)
    manifest.split_of(1)


def _seal_manifest(files: Files) -> Files:
    return _sealed(files, "manifest.json", lambda values: None)


def _seal_dataset(files: Files) -> Files:
    def fit(values: Any) -> None:
        for shard in values["shards"]:
            for entry in (shard, shard.get("worlds")):
                data = files.get(entry["file"]) if isinstance(entry, dict) else None
                if data is not None:
                    entry["sha256"], entry["bytes"] = hashlib.sha256(data).hexdigest(), len(data)
                if data is not None and entry is shard:
                    _fit_rows(shard, data, values)

    return _sealed(files, "manifest.json", fit)


def _fit_rows(shard: dict[str, Any], data: bytes, values: dict[str, Any]) -> None:
    """Let the manifest say of rows and lengths what the shard says."""
    import h5py

    from navrep_data.shards._attributes import read_attribute

    with contextlib.suppress(Exception), h5py.File(io.BytesIO(data), "r") as file:
        rows = int(read_attribute(file, "rows"))
        if rows != shard["rows"]:
            values["rows"] = shard["rows"] = rows
            values["length"] = max(values["length"], int(read_attribute(file, "length")), rows)


def _read_shard(folder: Path) -> None:
    from navrep_data.shards import Shard, read_recipe

    def read() -> None:
        shard = Shard(folder / "shard.h5")
        for name in shard.columns:
            shard.read(name, 0, min(shard.rows, 8))
            if shard.rows:
                shard.read_rows(name, [0, shard.rows - 1, shard.rows // 2])
        shard.close()

    _each(lambda: read_recipe(folder / "shard.h5"), read)


def _make_shard(folder: Path) -> None:
    (folder / "shard.h5").write_bytes(_simulated()["data/train-00000.h5"])


def _make_float_shard(folder: Path) -> None:
    """An import has float32 scans, no poses and columns of its own."""
    with tempfile.TemporaryDirectory() as name:
        _make_npz(Path(name))
        _read_npz(Path(name))
        (folder / "shard.h5").write_bytes((Path(name) / "out/data/train-00000.h5").read_bytes())


def _make_h5py_shard(folder: Path) -> None:
    """The same columns as plain h5py writes them: other chunks, other filters, none at all."""
    import h5py

    _make_shard(folder)
    path = folder / "shard.h5"
    with h5py.File(path, "r+") as file:
        plain: tuple[dict[str, Any], ...] = (
            {}, {"compression": "gzip"}, {"compression": "lzf"}, {"compression": "gzip", "fletcher32": True},
            {"fletcher32": True}, {"compression": "gzip", "shuffle": True},
        )  # fmt: skip
        for k, name in enumerate(list(file)):
            column = file[name][()]
            del file[name]
            chunks = (5, *column.shape[1:]) if plain[k % 6] else None
            file.create_dataset(name, data=column, chunks=chunks, **plain[k % 6])


def _make_worlds(folder: Path) -> None:
    (folder / "worlds.npz").write_bytes(_simulated()["worlds/train-00000.npz"])


def _read_worlds(folder: Path) -> None:
    from navrep_data.shards import read_worlds

    worlds = read_worlds(folder / "worlds.npz")
    for k in range(min(len(worlds), 20)):
        worlds.episode(k)


def _read_dataset(folder: Path) -> None:
    from navrep_data.doctor import check_dataset
    from navrep_data.shards import DatasetFolder
    from navrep_data.view import dataset_page

    _each(
        lambda: check_dataset(folder),  # all of verify, too
        lambda: _use_windows(folder),
        lambda: dataset_page(folder, max_bytes=1 << 20),
        lambda: DatasetFolder(folder).episodes.in_split("train"),
        lambda: DatasetFolder(folder).worlds(0),
    )


def _each(*reads: Callable[[], Any]) -> None:
    """Read all, then raise the first refusal; anything but a refusal ends it at once."""
    refusal: NavrepDataError | None = None
    for read in reads:
        try:
            read()
        except NavrepDataError as error:
            refusal = refusal or error
    if refusal is not None:
        raise refusal


def _use_windows(folder: Path) -> None:
    from navrep_data.datasets import SequenceDataset

    dataset = SequenceDataset(folder, lidar="1d", window=8, targets=True)
    if len(dataset):
        dataset[0], dataset[len(dataset) - 1]


def _make_index(folder: Path) -> None:
    from navrep_data.datasets._hub_extras import index_bytes
    from navrep_data.shards import DatasetFolder

    _make_dataset(folder)
    with DatasetFolder(folder) as opened:
        (folder / "index.json").write_bytes(index_bytes(opened.episodes, opened.manifest))
    for name in ("data", "worlds"):
        shutil.rmtree(folder / name)


def _read_index(folder: Path) -> None:
    from navrep_data.datasets._hub_extras import read_index
    from navrep_data.shards import Manifest

    read_index(folder / "index.json", Manifest.read(folder))


# --- imports ----------------------------------------------------------------------------------------------------


def _make_npz(folder: Path) -> None:
    from navrep_data.datasets.npz import FILE_SUFFIX

    rng = np.random.default_rng(0)
    rows = 12
    dones = np.zeros(rows, bool)
    dones[[5, 11]] = True
    arrays = {
        "scans": rng.uniform(0.3, 25, (rows, 1080)).astype(np.float32).round(1),
        "robotstates": rng.normal(size=(rows, 5)), "actions": rng.normal(size=(rows, 3)),
        "rewards": rng.normal(size=rows), "dones": dones,
    }  # fmt: skip
    np.savez_compressed(folder / f"000_{FILE_SUFFIX}", **arrays)
    np.savez(folder / f"001_{FILE_SUFFIX}", **arrays)


def _read_npz(folder: Path) -> None:
    from navrep_data.datasets import import_npz

    shutil.rmtree(folder / "out", ignore_errors=True)
    import_npz(folder, folder / "out", rings=False)


def _make_bag(kind: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        sys.path.insert(0, str(Path(__file__).parents[1] / "datasets"))
        from bag_files import record, record_by_tf

        if kind == "mcap":
            record(folder / "bag", kind, seconds=0.8)
        else:
            record_by_tf(folder / "bag", kind)

    return make


def _read_bag(folder: Path) -> None:
    from navrep_data.datasets import import_rosbag

    with tempfile.TemporaryDirectory() as out:  # some changes leave no bag, nor a folder
        import_rosbag(next(folder.iterdir(), folder / "bag"), Path(out) / "d", dt=0.2, rings=False)


# --- models -----------------------------------------------------------------------------------------------------


def _make_sb2(folder: Path) -> None:
    from navrep_data.zoo.importers_sb2 import controller_variables

    rng = np.random.default_rng(0)
    arrays = {name: rng.normal(0, 0.1, shape).astype(np.float32) for name, shape in controller_variables(37)}
    inner = io.BytesIO()
    np.savez(inner, **arrays)
    with zipfile.ZipFile(folder / "model.zip", "w") as archive:
        archive.writestr("data", b"{}")
        archive.writestr("parameter_list", json.dumps(list(arrays)))
        archive.writestr("parameters", inner.getvalue())


def _make_torch(folder: Path) -> None:
    import torch

    from navrep_data.models import checkpoint

    torch.manual_seed(0)
    state = {}
    for name, value in checkpoint.make("joint", {"lidar": "1d"}).state_dict().items():
        value = value.squeeze(2) if value.ndim == 4 else value
        state[name.replace("vae.", "convVAE.", 1)] = torch.zeros_like(value)
    torch.save(state, folder / "model.zip")


def _read_any(folder: Path) -> None:
    from navrep_data.zoo.importers import load_any

    load_any(folder / "model.zip")


def _make_tf(folder: Path) -> None:
    from navrep_data.zoo.importers_tf import memory_variables

    shapes = [shape for _, shape in memory_variables()]
    # no ".json": changing three megabytes as a structure takes seconds; tests/zoo/test_import_hostile.py does that
    (folder / "memory").write_text(json.dumps([np.zeros(shape, int).tolist() for shape in shapes]))


def _read_tf(folder: Path) -> None:
    from navrep_data.zoo.importers import load_tf_json

    load_tf_json(folder / "memory", None)


def _make_checkpoint(folder: Path) -> None:
    from navrep_data.models import checkpoint

    checkpoint.save(checkpoint.make("controller", {"n_inputs": 9, "n_hidden": 8}), folder, {"note": ["a", 1]})


def _read_checkpoint(folder: Path) -> None:
    from navrep_data.models import checkpoint

    checkpoint.load(folder)


def _seal_checkpoint(files: Files) -> Files:
    for name in [n for n in files if n.endswith("model.safetensors")]:
        digest = hashlib.sha256(files[name]).hexdigest()
        config = name.replace("model.safetensors", "config.json")
        files = _sealed_plain(files, config, {"weights_sha256": digest})
    return files


def _sealed_plain(files: Files, name: str, changes: dict[str, Any]) -> Files:
    with contextlib.suppress(KeyError, ValueError, RecursionError):
        values = json.loads(files[name])
        if isinstance(values, dict):
            return {**files, name: json.dumps({**values, **changes}).encode()}
    return files


def _make_policy(folder: Path) -> None:
    import torch

    from navrep_data.models import checkpoint
    from navrep_data.zoo.folders import save_policy
    from navrep_data.zoo.policy import Policy

    torch.manual_seed(0)
    world_model = checkpoint.make("joint", {"lidar": "1d", "z_size": 4, "h_size": 8})
    network = checkpoint.make("controller", {"n_inputs": 4 + 8 + 5, "n_hidden": 4})
    policy = Policy(network, "zh", "1d", None, world_model, name="tiny")
    save_policy(policy, folder / "saved")
    trained = folder / "trained"
    checkpoint.save(network, trained)
    checkpoint.save(world_model, trained / "world_model")
    described = {"features": "zh", "lidar": "1d", "context": policy.context, "world_model": "world_model",
                 "sensor": policy.sensor.to_dict()}  # fmt: skip
    (trained / "policy.json").write_text(json.dumps(described))


def _read_policy(folder: Path) -> None:
    from navrep_data.zoo.folders import load_folder
    from navrep_data.zoo.local import load_policy

    _each(lambda: _drive(load_folder(folder / "saved")), lambda: _drive(load_policy(folder / "trained")))


def _drive(policy: Any) -> None:
    policy.reset(batch_size=1)
    policy.act(np.full((1, 1080), 5.0, np.float32), np.zeros((1, 5), np.float32))


def _make_latents(folder: Path) -> None:
    from navrep_data.datasets.latents import LatentManifest, write_latent_shard
    from navrep_data.schema import SensorContract

    rows, z = 20, 3
    first = np.zeros(rows, bool)
    first[[0, 10]] = True
    columns = {
        "mu": np.zeros((rows, z)), "logvar": np.zeros((rows, z)), "robot_state": np.zeros((rows, 5)),
        "action": np.zeros((rows, 3)), "reward": np.zeros(rows), "is_first": first, "is_last": np.roll(first, -1),
        "is_terminal": np.zeros(rows, bool), "event": np.zeros(rows), "sequence": np.zeros(rows),
        "episode": np.arange(rows) // 10, "step": np.arange(rows) % 10,
    }  # fmt: skip
    shard = write_latent_shard(folder, "data/train-00000.h5", "train", columns)
    manifest = LatentManifest(z, {"name": "v"}, {"name": "d"}, SensorContract().to_dict())
    manifest.with_shard(shard, True).save(folder)


def _read_latents(folder: Path) -> None:
    from navrep_data.datasets.latents import LatentDataset

    dataset = LatentDataset(folder, window=5, split="train")
    if len(dataset):
        dataset[len(dataset) - 1]


def _make_training(folder: Path) -> None:
    import torch

    from navrep_data.train import state
    from navrep_data.train.recipe import default_recipe

    model = _small_network()
    optimizer = torch.optim.Adam(model.parameters())
    model(torch.zeros(1, 9))[0].sum().backward()
    optimizer.step()
    progress = state.Progress(step=5, tokens=10, seconds=1.0, best=0.5, best_step=5, extra={"mask": torch.zeros(2)})
    (folder / "run").mkdir()
    state.save(folder / "run", model, optimizer, progress, metadata={})
    state.commit(folder / "run", progress)
    (folder / "recipe.json").write_bytes(json_bytes({"settings": default_recipe("v", "1d").to_dict()}))


def _small_network() -> Any:
    from navrep_data.models import checkpoint

    return checkpoint.make("controller", {"n_inputs": 9, "n_hidden": 8})


def _read_training(folder: Path) -> None:
    import torch

    from navrep_data.train import state
    from navrep_data.train.recipe import read_recipe

    def resume() -> None:
        at = state.last_folder(folder / "run")
        if at is not None:
            model = _small_network()
            state.load(at, model, torch.optim.Adam(model.parameters()))

    _each(lambda: read_recipe(folder / "recipe.json"), resume)


def _seal_training(files: Files) -> Files:
    files = _seal_checkpoint(files)
    for name in [n for n in files if n.endswith("training.safetensors")]:
        digest = hashlib.sha256(files[name]).hexdigest()
        files = _sealed_plain(files, name.replace(".safetensors", ".json"), {"sha256": digest})
    return files


def _make_model_list(folder: Path) -> None:
    files = [{"file": n, "sha256": "0" * 64, "bytes": 5} for n in ("config.json", "model.safetensors")]
    from navrep_data.zoo.hub import LIST_FORMAT

    (folder / "files.json").write_text(json.dumps({"format": LIST_FORMAT, "files": files}))
    np.savez(folder / "golden.npz", a=np.zeros(3), b=np.ones((2, 2), np.float32))


def _read_model_list(folder: Path) -> None:
    from navrep_data.hub.client import Revision
    from navrep_data.zoo.hub import _wanted
    from navrep_data.zoo.verification import _arrays

    at = Revision("user/name", "model", "0" * 40, "main", "https://huggingface.co", None)
    _each(lambda: _wanted(at, folder / "files.json"), lambda: _arrays(folder / "golden.npz"))


# --- results and maps -------------------------------------------------------------------------------------------


def _make_results(folder: Path) -> None:
    import math

    from navrep_data.evaluate.metrics import METRICS, Contacts
    from navrep_data.evaluate.results import Results
    from navrep_data.evaluate.suites import get_suite

    suite = get_suite("navrep27")
    results = Results({
        "name": "goal", "sees": "scan", "variant": "", "versions": {},
        "settings": {**suite.settings("original"), "inference": "deterministic", "policy_files": {}},
    })  # fmt: skip
    n = 6
    results.events = [EVENT_NAMES[1 + k % 4] for k in range(n)]
    results.outcome = ["S" if e == "goal" else "T" if e == "timeout" else "C" for e in results.events]
    results.steps = list(range(5, 5 + n))
    results.metrics = {m.name: [1.5, math.nan, 2.0] * 2 for m in METRICS}
    results.contacts = [Contacts(k % 2, k % 3, 0.5) for k in range(n)]
    results.trajectories = {k: np.arange(10.0).reshape(5, 2) for k in range(n)}
    results.save(folder / "results.json")


def _read_results(folder: Path) -> None:
    from navrep_data.evaluate.results import Results
    from navrep_data.view import results_page

    def load() -> None:
        results = Results.load(folder / "results.json")
        f"{results.name} {results.physics}".encode()
        results.first(3).save(folder / "again.json")

    _each(lambda: results_page(folder / "results.json", max_bytes=1 << 20), load)


def _make_map(folder: Path) -> None:
    grey = np.full((30, 40), 254, np.uint8)
    grey[[0, -1]], grey[:, [0, -1]] = 0, 0
    Image.fromarray(grey).save(folder / "map.pgm")
    Image.fromarray(grey).save(folder / "map.png")
    text = "image: map.{}\nresolution: 0.05\norigin: [-1.0, -1.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\n"
    for kind in ("pgm", "png"):
        (folder / f"{kind}.yaml").write_text(text.format(kind) + "free_thresh: 0.196\nmode: trinary\n")


def _read_map(folder: Path) -> None:
    from navrep_data.sim.maps import load_map

    _each(lambda: _use_map(load_map(folder / "pgm.yaml")), lambda: _use_map(load_map(folder / "png.yaml")))


def _use_map(grid: Any) -> None:
    assert grid.free.any()
    if grid.occupancy.size < 1 << 18:
        grid.signed_distance()


TARGETS: tuple[Target, ...] = (
    Target("manifest", _make_manifest, _read_manifest, _seal_manifest),
    Target("shard", _make_shard, _read_shard),
    Target("shard-float32", _make_float_shard, _read_shard),
    Target("shard-h5py", _make_h5py_shard, _read_shard),
    Target("worlds", _make_worlds, _read_worlds),
    Target("dataset", _make_dataset, _read_dataset, _seal_dataset),
    Target("index", _make_index, _read_index, _seal_manifest),
    Target("npz", _make_npz, _read_npz),
    Target("bag-ros1", _make_bag("ros1"), _read_bag),
    Target("bag-ros2", _make_bag("ros2"), _read_bag),
    Target("bag-mcap", _make_bag("mcap"), _read_bag),
    Target("map", _make_map, _read_map),
    Target("results", _make_results, _read_results),
    Target("sb2-zip", _make_sb2, _read_any),
    Target("torch-zip", _make_torch, _read_any),
    Target("tf-json", _make_tf, _read_tf),
    Target("checkpoint", _make_checkpoint, _read_checkpoint, _seal_checkpoint),
    Target("policy", _make_policy, _read_policy, _seal_checkpoint),
    Target("latents", _make_latents, _read_latents, _seal_dataset),
    Target("training", _make_training, _read_training, _seal_training),
    Target("model-list", _make_model_list, _read_model_list),
)
"""All readers of files from outside."""
