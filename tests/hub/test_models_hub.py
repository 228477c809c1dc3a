"""Models in folders and on the Hub: up, down, whole, and only what is one."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hub_server import Fault

from navrep_data import zoo
from navrep_data.datasets import SequenceDataset, push
from navrep_data.errors import (
    CheckpointError,
    ConfigError,
    CorruptDataError,
    HubError,
    ModelNotFoundError,
    OfflineError,
    UnknownNameError,
)
from navrep_data.io import json_bytes
from navrep_data.models import checkpoint
from navrep_data.zoo.hub import push_model
from navrep_data.zoo.policy import Policy

REPO = "user/brain"


def few(cases, n):
    """The first n cases in quick runs, all of them in slow ones."""
    wrap = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [*cases[:n], *(pytest.param(*case, marks=pytest.mark.slow) for case in wrap[n:])]


def a_policy(features="z", name="mine_1d_z"):
    torch.manual_seed(0)
    n = {"z": 8 + 5, "h": 5 + 16, "zh": 8 + 5 + 16}[features]
    controller = checkpoint.make("controller", {"n_inputs": n})
    if features == "z":
        return Policy(controller, "z", "1d", vae=checkpoint.make("vae", {"lidar": "1d", "z_size": 8}), name=name)
    world_model = checkpoint.make("joint", {"lidar": "1d", "z_size": 8, "h_size": 16})
    return Policy(controller, features, "1d", world_model=world_model, name=name, context="oldest-32")


def actions(policy):
    rng = np.random.default_rng(0)
    policy.reset(batch_size=2)
    scans, states = rng.uniform(0.3, 20, (4, 2, 1080)), rng.normal(size=(4, 2, 5))
    return np.stack(
        [
            policy.act(scan.astype(np.float32), state.astype(np.float32))
            for scan, state in zip(scans, states, strict=True)
        ]
    )


def same_weights(a, b):
    mine, other = a.state_dict(), b.state_dict()
    assert set(mine) == set(other)
    assert all(torch.equal(mine[name], other[name]) for name in mine)


def world_model():
    torch.manual_seed(1)
    return checkpoint.make("joint", {"lidar": "1d", "z_size": 8, "h_size": 16})


# ---- folders ----


@pytest.mark.slow
@pytest.mark.parametrize("features", few(["z", "h", "zh"], 1))
def test_a_policy_folder(tmp_path, features, monkeypatch):
    policy = a_policy(features)
    zoo.save_policy(policy, tmp_path / "p", {"run": 1})
    monkeypatch.chdir(tmp_path)
    for place in ("./p", tmp_path / "p", f"{tmp_path}/p/"):
        again = zoo.load(place)
        assert (again.name, again.features, again.context) == (policy.name, features, policy.context)
        assert np.array_equal(actions(again), actions(policy))
    zoo.save_policy(policy, tmp_path / "p")  # over an older one
    (tmp_path / "p" / "notes").write_text("x")
    with pytest.raises(ConfigError, match="holds 'notes', expected a new folder or an older policy"):
        zoo.save_policy(policy, tmp_path / "p")


@pytest.mark.parametrize("kind", few(["vae", "memory", "joint", "transformer", "modular"], 1))
def test_a_checkpoint_folder(tmp_path, kind, monkeypatch):
    small = {} if kind in ("vae", "memory") else {"lidar": "1d"}
    module = checkpoint.make(kind, small)
    checkpoint.save(module, tmp_path / "m")
    checkpoint.save(module, tmp_path / "m.safetensors")
    monkeypatch.chdir(tmp_path)
    same_weights(zoo.load("./m"), module)
    same_weights(zoo.load("m.safetensors"), module)
    assert not zoo.load("./m").training


def test_end_to_end_and_bare_controllers(tmp_path):
    checkpoint.save(checkpoint.make("e2e", {"lidar": "1d"}), tmp_path / "e")
    policy = zoo.load(tmp_path / "e")
    assert (policy.lidar, policy.features, policy.name) == ("1d", None, "e")
    assert actions(policy).shape == (4, 2, 3)
    checkpoint.save(checkpoint.make("controller", {}), tmp_path / "c")
    assert zoo.load(tmp_path / "c").n_inputs == 69


def test_names_stay_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "transformer").mkdir()
    with pytest.raises(UnknownNameError):
        zoo.load("transformer")
    with pytest.raises(ModelNotFoundError, match="There is no nowhere/at/all, expected a folder with a checkpoint"):
        zoo.load("nowhere/at/all")
    with pytest.raises(CheckpointError, match="expected a checkpoint of navrep-data"):
        zoo.load("./transformer")


@pytest.mark.parametrize(
    ("change", "words"),
    few(
        [
            ({"format": "x"}, "not the description of a policy"),
            ({"format_version": 2}, "format version 2, expected 1"),
            ({"features": "y"}, "features is 'y'"),
            ({"parts": ["controller", "../../x"]}, "parts is"),
            ({"context": "whatever"}, "context is"),
            ({"sensor": {"n_rays": "1"}}, "sensor is no sensor contract"),
            ({"name": 3}, "name or metadata"),
            ({"lidar": "rings"}, "is for rings, its V for 1d"),
            ({"features": "h"}, "expected a world model"),
        ],
        2,
    ),
)
def test_a_policy_that_is_none(tmp_path, change, words):
    path = zoo.save_policy(a_policy(), tmp_path / "p")
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises((CheckpointError, ConfigError), match=words):
        zoo.load(tmp_path / "p")


# ---- the Hub ----


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_a_world_model_goes_up_and_comes_down(hub, template, tmp_path):
    push(template, "user/crowd", license="mit")
    record = {**SequenceDataset.from_hub("user/crowd", "1d", window=8).provenance, "split": "train"}
    module = world_model()
    checkpoint.save(module, tmp_path / "m", {"epochs": 3}, dataset=record)
    pushed = push_model(tmp_path / "m", REPO, license="mit")
    files = hub.repo(REPO, "model").files()
    assert files["model.safetensors"] == (tmp_path / "m" / "model.safetensors").read_bytes()
    card = files["README.md"].decode()
    assert card.startswith("---\nlicense: mit\nlibrary_name: navrep-data\n")
    assert "A joint world model for robots" in card
    assert record["content_hash"] in card
    assert record["revision"] in card
    same_weights(zoo.load(f"hf://{REPO}"), module)
    same_weights(zoo.load(f"hf://{REPO}@{pushed.commit}"), module)
    assert push_model(tmp_path / "m", REPO, license="mit").commit == pushed.commit


@pytest.mark.parametrize("features", few(["z", "zh"], 1))
def test_a_policy_goes_up_and_comes_down(hub, tmp_path, features):
    policy = a_policy(features)
    zoo.save_policy(policy, tmp_path / "p")
    pushed = push_model(tmp_path / "p", REPO, license="cc-by-4.0", private=True, revision="v2")
    assert hub.repo(REPO, "model").private
    again = zoo.load(f"hf://{REPO}@v2")
    assert np.array_equal(actions(again), actions(policy))
    assert pushed.revision == "v2"
    with pytest.raises(ModelNotFoundError, match=r"has no navrep-model.json, expected a model"):
        zoo.load(f"hf://{REPO}")


@pytest.mark.slow
def test_a_trainings_folder_goes_up_as_a_policy(hub, tmp_path):
    """What ``train controller`` writes: the controller's weights at the top, its world model in a folder."""
    policy, folder = a_policy("z"), tmp_path / "training"
    checkpoint.save(policy.network, folder, {"step": 3})
    checkpoint.save(policy.vae, folder / "world_model")
    described = {"format": "navrep-data-policy", "features": "z", "lidar": "1d", "context": None,
                 "world_model": "world_model", "sensor": policy.sensor.to_dict()}  # fmt: skip
    (folder / "policy.json").write_bytes(json_bytes(described))
    push_model(folder, REPO, license="mit")
    np.testing.assert_array_equal(actions(zoo.load(f"hf://{REPO}")), actions(policy))


@pytest.mark.slow
def test_another_model_leaves_nothing_of_the_first(hub, tmp_path):
    zoo.save_policy(a_policy(), tmp_path / "p")
    push_model(tmp_path / "p", REPO, license="mit")
    checkpoint.save(world_model(), tmp_path / "m")
    push_model(tmp_path / "m", REPO, license="mit")
    assert set(hub.repo(REPO, "model").files()) == {
        ".gitattributes", "README.md", "navrep-model.json", "model.safetensors", "config.json",
    }  # fmt: skip
    same_weights(zoo.load(f"hf://{REPO}"), world_model())


@pytest.mark.slow
def test_offline_and_cached(hub, tmp_path, monkeypatch):
    checkpoint.save(world_model(), tmp_path / "m")
    commit = push_model(tmp_path / "m", REPO, license="mit").commit
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    with pytest.raises(OfflineError):
        zoo.load(f"hf://{REPO}@{commit}")
    monkeypatch.delenv("NAVREP_DATA_OFFLINE")
    zoo.load(f"hf://{REPO}")
    seen = len(hub.seen)
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    same_weights(zoo.load(f"hf://{REPO}"), world_model())
    same_weights(zoo.load(f"hf://{REPO}@{commit}"), world_model())
    assert len(hub.seen) == seen


@pytest.mark.parametrize("every", [4099, pytest.param(331, marks=pytest.mark.slow)])
def test_cut_connections(hub, tmp_path, every):
    checkpoint.save(checkpoint.make("controller", {}), tmp_path / "m")
    push_model(tmp_path / "m", REPO, license="mit")
    hub.cut_every = every
    same_weights(zoo.load(f"hf://{REPO}").network, checkpoint.load(tmp_path / "m"))


@pytest.mark.slow
def test_wrong_weights(hub, tmp_path):
    checkpoint.save(world_model(), tmp_path / "m")
    push_model(tmp_path / "m", REPO, license="mit")
    hub.faults = [Fault("flip", "^/cdn/", "GET", times=1)]
    same_weights(zoo.load(f"hf://{REPO}"), world_model())
    shutil.rmtree(tmp_path / "hf-cache")
    hub.faults = [Fault("flip", "^/cdn/", "GET", times=1000)]
    with pytest.raises(CorruptDataError, match=r"gave a model.safetensors that does not have its SHA-256"):
        zoo.load(f"hf://{REPO}")
    assert not list((tmp_path / "hf-cache").rglob("*.safetensors"))
    hub.faults = []
    same_weights(zoo.load(f"hf://{REPO}"), world_model())


def test_only_what_loads_is_published(hub, tmp_path):
    checkpoint.save(world_model(), tmp_path / "m")
    with pytest.raises(ConfigError, match="has no licence, expected one to publish it under"):
        push_model(tmp_path / "m", REPO)
    weights = tmp_path / "m" / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"\1")
    with pytest.raises(CheckpointError, match="does not have the SHA-256"):
        push_model(tmp_path / "m", REPO, license="mit")
    with pytest.raises(ModelNotFoundError):
        push_model(tmp_path / "none", REPO, license="mit")
    assert hub.seen == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("files", "words"),
    few(
        [
            ([], "is not a list of a model's files"),
            ([{"file": "../../x", "sha256": "0" * 64, "bytes": 1}], "names a file '../../x'"),
            ([{"file": "model.pkl", "sha256": "0" * 64, "bytes": 1}], "names a file 'model.pkl'"),
            ([{"file": "config.json", "sha256": "x", "bytes": 1}], "has no SHA-256 or size for config.json"),
            ([{"file": "config.json", "sha256": "0" * 64, "bytes": 3 << 30}], r"lists more than [\d,]+ bytes"),
            ([{"file": "config.json", "sha256": "0" * 64, "bytes": 1}], "holds another config.json"),
            ([{"file": "vae/config.json", "sha256": "0" * 64, "bytes": 1}], "lacks vae/config.json"),
            (3, "is not a list of a model's files"),
        ],
        3,
    ),
)
def test_a_list_that_asks_for_too_much(hub, tmp_path, files, words):
    checkpoint.save(checkpoint.make("controller", {}), tmp_path / "m")
    push_model(tmp_path / "m", REPO, license="mit")
    repo = hub.repo(REPO, "model")
    listed = json_bytes({"format": "navrep-data-model-files", "files": files})
    repo.commit("main", {**repo.files(), "navrep-model.json": listed})
    with pytest.raises(CorruptDataError, match=words):
        zoo.load(f"hf://{REPO}")


def test_what_is_not_there(hub):
    with pytest.raises(HubError, match="there is no such repository"):
        zoo.load("hf://user/none")
    with pytest.raises(ConfigError, match="expected user/name as on the Hub"):
        zoo.load("hf://none")


@pytest.mark.slow
def test_all_files_of_a_policy_are_listed_in_its_card(hub, tmp_path):
    zoo.save_policy(a_policy(), Path(tmp_path / "p"))
    push_model(tmp_path / "p", REPO, license="mit")
    card = hub.repo(REPO, "model").files()["README.md"].decode()
    assert 'zoo.load("hf://user/brain")' in card
    assert "Not recorded." in card
    assert "pipeline_tag: reinforcement-learning" in card
