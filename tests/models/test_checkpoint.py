"""Saving, loading, and refusing what was damaged."""

import json
import pickle

import numpy as np
import pytest
import safetensors.torch
import torch

from navrep_data.errors import CheckpointError, ConfigError, CorruptDataError
from navrep_data.models import checkpoint

CASES = [
    ("vae", {"lidar": "1d"}),
    ("memory", {}),
    ("modular", {"lidar": "1d"}),
    ("joint", {"lidar": "1d"}),
    ("transformer", {"lidar": "1d", "n_blocks": 2}),
    ("controller", {"n_inputs": 37}),
    ("e2e", {"lidar": "1d"}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "config"), CASES, ids=lambda v: str(v))
def test_what_is_saved_is_loaded(tmp_path, kind, config):
    module = checkpoint.make(kind, config)
    checkpoint.save(module, tmp_path / "m", {"made_by": "a test"})
    loaded = checkpoint.load(tmp_path / "m")
    assert type(loaded) is type(module)
    assert loaded.config == module.config
    assert not loaded.training
    for name, value in module.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[name])
    assert checkpoint.read_config(tmp_path / "m")["metadata"] == {"made_by": "a test"}
    assert sorted(p.name for p in (tmp_path / "m").iterdir()) == ["config.json", "model.safetensors"]


def test_folder_weights_and_config_name_the_same_checkpoint(tmp_path):
    checkpoint.save(checkpoint.make("controller", {"n_inputs": 3}), tmp_path / "c.safetensors")
    assert (tmp_path / "c.json").is_file()
    for name in ("c.safetensors", "c.json"):
        assert checkpoint.load(tmp_path / name).config.n_inputs == 3
    checkpoint.save(checkpoint.make("controller", {"n_inputs": 4}), tmp_path)
    for path in (tmp_path, tmp_path / "model.safetensors", tmp_path / "config.json"):
        assert checkpoint.load(path).config.n_inputs == 4


def test_saving_is_reproducible(tmp_path):
    module = checkpoint.make("controller", {})
    first = checkpoint.save(module, tmp_path / "a").read_bytes()
    assert checkpoint.save(module, tmp_path / "b").read_bytes() == first


def test_half_precision_takes_half_the_bytes_and_rounds(tmp_path):
    module = checkpoint.make("controller", {"n_inputs": 69})
    whole = checkpoint.save(module, tmp_path / "whole")
    half = checkpoint.save(module, tmp_path / "half", storage="float16")
    assert half.stat().st_size < 0.55 * whole.stat().st_size
    assert "weights_dtype" not in checkpoint.read_config(tmp_path / "whole")
    loaded = checkpoint.load(tmp_path / "half").state_dict()
    for name, value in module.state_dict().items():
        assert loaded[name].dtype == torch.float32
        assert torch.equal(loaded[name], value.half().float())
    torch.nn.init.constant_(module.logstd, 1e5)
    with pytest.raises(CheckpointError, match="network in float16: 'logstd' holds NaN or infinity"):
        checkpoint.save(module, tmp_path / "large", storage="float16")
    with pytest.raises(ConfigError, match="storage is 'int8'"):
        checkpoint.save(module, tmp_path / "large", storage="int8")


@pytest.mark.parametrize(("said", "words"), [("int8", "weights_dtype is 'int8'"), (["x"], "weights_dtype is"),
                                             ("float16", "is torch.float32, expected float16")])  # fmt: skip
def test_wrong_storage_is_refused(saved, said, words):
    edit(saved, weights_dtype=said)
    with pytest.raises(CheckpointError, match=words):
        checkpoint.load(saved)


@pytest.fixture
def saved(tmp_path):
    checkpoint.save(checkpoint.make("controller", {"n_inputs": 8}), tmp_path)
    return tmp_path


def test_every_flipped_byte_is_noticed(saved):
    weights = saved / "model.safetensors"
    good = weights.read_bytes()
    rng = np.random.default_rng(0)
    for at in rng.integers(0, len(good), 40):
        weights.write_bytes(good[:at] + bytes([good[at] ^ (1 << rng.integers(8))]) + good[at + 1 :])
        with pytest.raises(CheckpointError, match="does not have the SHA-256"):
            checkpoint.load(saved)


def test_cut_or_swollen_weights_are_refused_unread(saved):
    weights = saved / "model.safetensors"
    good = weights.read_bytes()
    for bad in (b"", good[: len(good) // 2], good + bytes(2 << 20)):
        weights.write_bytes(bad)
        with pytest.raises(CheckpointError, match="bytes, expected a little over"):
            checkpoint.load(saved)
    weights.unlink()
    with pytest.raises(CheckpointError, match=r"There is no .*model\.safetensors"):
        checkpoint.load(saved)


def edit(folder, **changes):
    config = json.loads((folder / "config.json").read_text()) | changes
    (folder / "config.json").write_text(json.dumps(config))


def rewrite(folder, state):
    data = safetensors.torch.save(state)
    (folder / "model.safetensors").write_bytes(data)
    edit(folder, weights_sha256=checkpoint.sha256_bytes(data))


def test_other_configs_are_refused(saved):
    for changes, error, words in (
        ({"format": "other"}, CheckpointError, "not the config of a navrep-data model"),
        ({"format_version": 2}, CheckpointError, "install a newer"),
        ({"kind": "controler"}, ConfigError, "Did you mean 'controller'"),
        ({"kind": ["x"]}, ConfigError, "Unknown kind"),
        ({"config": {"n_inputs": -1}}, ConfigError, "from 1 to"),
        ({"config": {"n_inputs": True}}, ConfigError, "whole number"),
        ({"config": [1]}, ConfigError, "expected a JSON object"),
        ({"config": {"n_inputs": 9000}}, CheckpointError, "expected a little over"),
    ):
        good = (saved / "config.json").read_bytes()
        edit(saved, **changes)
        with pytest.raises(error, match=words):
            checkpoint.load(saved)
        (saved / "config.json").write_bytes(good)
    (saved / "config.json").write_text("{")
    with pytest.raises(CorruptDataError, match="not valid JSON"):
        checkpoint.load(saved)
    (saved / "config.json").unlink()
    with pytest.raises(CheckpointError, match="navrep-data models convert"):
        checkpoint.load(saved)


def test_other_weights_are_refused(saved):
    state = checkpoint.load(saved).state_dict()
    for bad, words in (
        ({k: v for k, v in state.items() if k != "logstd"} | {"logstc": state["logstd"]}, "lacks the weights 'logstd'"),
        (state | {"extra": torch.zeros(1)}, "unknown in a Controller"),
        (state | {"logstd": torch.zeros(1, 2)}, r"has shape \(1, 2\)"),
        (state | {"q.bias": torch.tensor([0.0, float("nan")])}, "holds NaN or infinity"),
    ):
        rewrite(saved, bad)
        with pytest.raises(CheckpointError, match=words):
            checkpoint.load(saved)


def test_pickles_are_never_run(saved, tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "bang"), "w"))

    size = (saved / "model.safetensors").stat().st_size
    data = pickle.dumps(Bomb()).ljust(size, b"\0")
    (saved / "model.safetensors").write_bytes(data)
    edit(saved, weights_sha256=checkpoint.sha256_bytes(data))
    with pytest.raises(CheckpointError, match="not a safetensors file"):
        checkpoint.load(saved)
    assert not (tmp_path / "bang").exists()


def test_foreign_or_broken_networks_are_not_saved(tmp_path):
    with pytest.raises(CheckpointError, match="A Linear cannot be saved"):
        checkpoint.save(torch.nn.Linear(2, 2), tmp_path)
    module = checkpoint.make("controller", {})
    torch.nn.init.constant_(module.logstd, float("nan"))
    with pytest.raises(CheckpointError, match="holds NaN"):
        checkpoint.save(module, tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_dataset_is_recorded_by_content_hash(tmp_path):
    record = {"name": "soadrl", "repo": "user/name", "revision": "a" * 40, "content_hash": "b" * 64, "split": "train"}
    checkpoint.save(checkpoint.make("controller", {}), tmp_path, {"run": 1}, dataset=record)
    assert checkpoint.read_config(tmp_path)["metadata"] == {"run": 1, "dataset": record}
    with pytest.raises(ConfigError, match=r"lacks revision, content_hash; expected the provenance of a dataset"):
        checkpoint.save(checkpoint.make("controller", {}), tmp_path, dataset={"name": "x", "repo": None})
