"""Trainings of a few steps: losses fall, resume is exact, bad input is told in a line."""

import json
import math
import shutil

import numpy as np
import pytest
import torch

from navrep_data.datasets import LatentDataset, SequenceDataset, import_npz
from navrep_data.errors import (
    CheckpointError,
    ConfigError,
    CorruptDataError,
    DatasetMismatchError,
    FolderInUseError,
    NavrepDataError,
    TrainingError,
)
from navrep_data.models import VAE, VAEConfig, checkpoint
from navrep_data.train import (
    default_recipe,
    original_recipe,
    read_recipe,
    shipped_recipes,
    train_world_model,
    world_models,
)
from navrep_data.train.encode import encode_dataset
from navrep_data.train.logs import read_log
from navrep_data.train.modular import join
from navrep_data.train.recipe import Recipe
from navrep_data.train.state import last_folder

# Processors without bfloat16 need ten times as long for it: tests of what has nothing to do with it do without.
SMALL = {
    "warmup": 1, "validate_every": 100, "save_every": 100, "picture_every": 100, "validate_batches": 1, "lr": 2e-3,
    "precision": "float32",
}  # fmt: skip


def recipe(model, lidar, **changes):
    size = {"v": 16, "m": 4}.get(model, 2)
    window = {"window": 8, "stride": 8} if model in ("joint", "transformer") else {}
    return default_recipe(model, lidar).replace(batch=size, micro_batch=size, **{**SMALL, **window, **changes})


def train(settings, data, out, **options):
    return train_world_model(settings, data, out, preload=True, **options)


@pytest.fixture(scope="session")
def latents(dataset, tmp_path_factory):
    torch.manual_seed(0)
    vae = VAE(VAEConfig("1d", 8))
    out = tmp_path_factory.mktemp("latents") / "codes"
    encode_dataset(dataset, vae, out, name="V")
    return vae, out


@pytest.fixture
def pictures():
    """For tests in which trainings draw."""


@pytest.fixture(autouse=True)
def no_pictures(request, monkeypatch):
    """Drawing is half the time of a training of a few steps."""
    if "pictures" not in request.fixturenames:
        monkeypatch.setattr(world_models._Loop, "_picture", lambda *_: None)


def one_line(error):
    assert "\n" not in str(error.value)
    return str(error.value)


# --- losses fall ---


@pytest.mark.slow
@pytest.mark.parametrize(("model", "steps"), [("v", 12), ("joint", 12), ("transformer", 12)])
def test_losses_fall(model, steps, dataset, tmp_path, pictures):
    done = train(recipe(model, "1d", steps=steps, precision="bfloat16"), dataset, tmp_path / "out")
    assert all(map(math.isfinite, done.losses))
    assert np.mean(done.losses[-3:]) < 0.9 * np.mean(done.losses[:2])
    assert done.step == steps
    trained = checkpoint.load(tmp_path / "out")
    metadata = checkpoint.read_config(tmp_path / "out")["metadata"]
    assert metadata["note"].startswith("Retrained by navrep-data")
    assert len(metadata["dataset"]["content_hash"]) == 64
    assert metadata["recipe"]["seed"] == 0
    assert trained.config.lidar == "1d"
    assert list((tmp_path / "out" / "pictures").glob("*.png"))
    assert list((tmp_path / "out" / "tensorboard").iterdir())
    log = read_log(tmp_path / "out")
    assert {"loss", "lr", "frames_per_s"} <= set(log[0])
    assert "val_error" in log[-1]


@pytest.mark.slow
@pytest.mark.parametrize("model", ["v", "joint", "transformer"])
@pytest.mark.parametrize("original", [False, True])
def test_losses_fall_with_rings(model, original, dataset, tmp_path, pictures):
    settings = recipe(model, "rings", steps=12)
    if original:
        sizes = {name: getattr(settings, name) for name in ("steps", "batch", "micro_batch", "window", "stride", "lr")}
        settings = original_recipe(model, "rings").replace(**sizes, schedule="constant")
    done = train(settings, dataset, tmp_path / "out")
    assert np.mean(done.losses[-3:]) < np.mean(done.losses[:2])


@pytest.mark.slow
@pytest.mark.parametrize("model", ["v", "joint", "transformer"])
def test_losses_in_bfloat16_are_near_those_in_float32(model, dataset, tmp_path):
    settings = recipe(model, "rings", steps=3).replace(batch=2, micro_batch=2)
    exact, near = (train(settings.replace(precision=p), dataset, tmp_path / p).losses for p in ("float32", "bfloat16"))
    assert near == pytest.approx(exact, rel=0.02)
    assert near != exact


@pytest.mark.slow
def test_m_learns_from_codes_and_joins_its_v(latents, tmp_path):
    vae, codes = latents
    done = train_world_model(recipe("m", "1d", steps=15, window=16, stride=16), codes, tmp_path / "m")
    assert np.mean(done.losses[-3:]) < np.mean(done.losses[:2]) - 0.1
    joined = checkpoint.load(join(vae, tmp_path / "m"))
    assert (joined.z_size, joined.lidar, joined.config.action_alignment) == (8, "1d", "taken")
    torch.testing.assert_close(joined.vae.fc1.weight, vae.fc1.weight)
    with pytest.raises(DatasetMismatchError, match="codes of another V") as error:
        join(VAE(VAEConfig("1d", 8)), tmp_path / "m")
    one_line(error)


@pytest.mark.slow
def test_the_authors_m_carries_its_state(latents, tmp_path):
    _, codes = latents
    settings = original_recipe("m", "1d").replace(window=60, stride=60, batch=2, micro_batch=2, steps=2)
    done = train_world_model(settings, codes, tmp_path / "m")
    assert all(map(math.isfinite, done.losses))
    tensors = (last_folder(tmp_path / "m") / "training.safetensors").read_bytes()
    assert b"extra/h" in tensors


# --- resume ---


@pytest.mark.slow
@pytest.mark.parametrize("model", ["v", "joint", "transformer", "m"])
def test_resume_gives_the_same_losses_and_weights(model, dataset, latents, tmp_path):
    data = latents[1] if model == "m" else dataset
    settings = recipe(model, "1d", steps=6, dropout=0.1, validate_every=2, window=1 if model == "v" else 8)
    whole = train_world_model(settings, data, tmp_path / "whole", preload=False)
    first = train_world_model(settings, data, tmp_path / "parts", stop_after=3)
    second = train_world_model(settings, data, tmp_path / "parts", resume=True, preload=True)
    assert first.losses + second.losses == whole.losses
    ours, theirs = (checkpoint.load(last_folder(tmp_path / name)) for name in ("whole", "parts"))
    assert all(torch.equal(a, b) for a, b in zip(ours.parameters(), theirs.parameters(), strict=True))
    log = read_log(tmp_path / "parts")
    steps = [row["step"] for row in log if "val_error" in row]
    assert steps == ["2", "3", "4", "6"]  # the stop validates too; no row comes twice


@pytest.mark.slow
def test_a_resume_with_other_settings_or_data_is_refused(dataset, tmp_path):
    out = tmp_path / "out"
    settings = recipe("v", "1d", steps=2)
    train(settings, dataset, out)
    with pytest.raises(FolderInUseError, match="--resume"):
        train(settings, dataset, out)
    with pytest.raises(ConfigError, match=r"started with lr = 0.002, this resume has 0.5") as error:
        train(settings.replace(lr=0.5), dataset, out, resume=True)
    one_line(error)
    with pytest.raises(ConfigError, match="no training to resume"):
        train(settings, dataset, tmp_path / "none", resume=True)
    found = json.loads((out / "recipe.json").read_text())
    found["data"]["content_hash"] = "0" * 64
    (out / "recipe.json").write_text(json.dumps(found))
    with pytest.raises(DatasetMismatchError, match="other data"):
        train(settings, dataset, out, resume=True)


@pytest.mark.slow
def test_a_killed_save_leaves_the_checkpoint_before(dataset, tmp_path, monkeypatch):
    out = tmp_path / "out"
    settings = recipe("v", "1d", steps=4)
    train(settings, dataset, out, stop_after=2)
    from navrep_data.train import state

    def die(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(state, "commit", die)
    with pytest.raises(KeyboardInterrupt):
        train(settings, dataset, out, resume=True, stop_after=3)
    monkeypatch.undo()
    assert last_folder(out).name == "step-00000002"
    assert train(settings, dataset, out, resume=True).step == 4
    assert sorted(f.name for f in (out / "checkpoints").iterdir())[-1] == "step-00000004"


# --- bad input ---


@pytest.mark.slow
def test_nan_in_the_loss_stops_and_keeps_the_last_good_checkpoint(dataset, tmp_path, monkeypatch):
    out = tmp_path / "out"
    settings = recipe("transformer", "1d", steps=6, save_every=2)
    from navrep_data.train import data as module

    read = module.Batches.read

    def poisoned(self, step):
        batch = read(self, step)
        if step == 4:
            batch["obs"][0, 0, 0] = float("nan")
        return batch

    monkeypatch.setattr(module.Batches, "read", poisoned)
    with pytest.raises(TrainingError, match=r"nan at step 5 \(epoch \d+, batch \d+; first in: .*rec") as error:
        train(settings, dataset, out)
    assert "step-00000004" in one_line(error)
    assert last_folder(out).name == "step-00000004"
    checkpoint.load(out)


def test_another_sensor_is_refused(dataset, tmp_path):
    from navrep_data.schema import SensorContract
    from navrep_data.train.data import check_sensor

    with pytest.raises(DatasetMismatchError, match=r"range_max = 30, expected 25.*ScanAdapter") as error:
        check_sensor(SensorContract(range_max=30.0), "here")
    one_line(error)


@pytest.mark.slow
def test_m_wants_codes_and_starts_only_from_its_own_kind(dataset, tmp_path, latents):
    with pytest.raises(CorruptDataError, match="navrep-data encode"):
        train_world_model(recipe("m", "1d", steps=1), dataset, tmp_path / "m")
    with pytest.raises(CheckpointError, match="--init"):
        train(recipe("v", "1d", steps=1), dataset, tmp_path / "v", init=latents[0])
    first = train(recipe("joint", "1d", steps=1, action_alignment="leading"), dataset, tmp_path / "joint")
    start = checkpoint.load(first.out)
    with pytest.raises(ConfigError, match="leading action, this recipe feeds the taken") as error:
        train(recipe("joint", "1d", steps=1), dataset, tmp_path / "other", init=start)
    one_line(error)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["joint", "transformer"])
def test_a_frozen_v_stays_and_the_memory_learns(model, dataset, tmp_path):
    started = recipe(model, "1d", steps=1, z_size=8, h_size=16)
    first = checkpoint.load(train(started, dataset, tmp_path / "first").out)
    frozen = recipe(model, "1d", steps=2, z_size=8, h_size=16, seed=3, freeze_v=True)
    train(frozen, dataset, tmp_path / "w", init=first, stop_after=1)
    done = checkpoint.load(train(frozen, dataset, tmp_path / "w", resume=True).out)
    before = first.state_dict()
    moved = {name for name, value in done.state_dict().items() if not torch.equal(value, before[name])}
    assert moved
    assert not [name for name in moved if name.startswith("vae.")]
    with pytest.raises(ConfigError, match="freeze_v keeps V as --init gives it, but there is none") as error:
        train(frozen, dataset, tmp_path / "none")
    one_line(error)
    again = train(frozen, dataset, tmp_path / "none", init=first, stop_after=1)  # the refusal left the folder free
    (again.out / "model.safetensors").unlink()  # as killed before it was published
    train(frozen, dataset, again.out, resume=True, stop_after=1)
    assert checkpoint.load(again.out).config == done.config
    with pytest.raises(ConfigError, match="freeze_v is for joint and transformer"):
        recipe("v", "1d", freeze_v=True)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["joint", "transformer"])
def test_world_models_start_from_a_v(model, dataset, tmp_path):
    v = train(recipe("v", "1d", steps=1, z_size=8), dataset, tmp_path / "v")
    start = checkpoint.load(v.out)
    # no learning rate: what comes out is what it started from
    still = recipe(model, "1d", steps=1, z_size=8, h_size=16, seed=3, lr=0.0, lr_end=0.0)
    done = checkpoint.load(train(still, dataset, tmp_path / "w", init=start).out)
    for name, value in start.state_dict().items():
        assert torch.equal(done.vae.state_dict()[name], value)
    with pytest.raises(CheckpointError, match="--set z_size=16") as error:
        train(recipe(model, "1d", steps=1, z_size=16, h_size=32), dataset, tmp_path / "other", init=start)
    one_line(error)
    other = recipe("joint" if model == "transformer" else "transformer", "1d", steps=1, z_size=8, h_size=16, lr=0.0)
    second = checkpoint.load(
        train(other.replace(lr_end=0.0), dataset, tmp_path / "second", init=done).out
    )  # another kind: its V
    assert type(second) is not type(done)
    started = [second]
    if model == "transformer":  # another size of memory: its V
        started.append(checkpoint.load(train(still.replace(n_blocks=2), dataset, tmp_path / "third", init=done).out))
        assert len(started[1].blocks) == 2 < len(done.blocks)
    for again in started:
        for name, value in start.state_dict().items():
            assert torch.equal(again.vae.state_dict()[name], value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("lr", 2.0),
        ("batch", 0),
        ("schedule", "linear"),
        ("steps", 1.5),
        ("residual", 1),
        ("lidar", "2d"),
        ("kl_warmup", -5),
        ("epsilon", -1.0),
    ],
)
def test_recipes_are_checked(field, value):
    with pytest.raises(ConfigError, match=field):
        Recipe.from_dict({"model": "v", "lidar": "1d", field: value})
    with pytest.raises(ConfigError, match="Did you mean 'batch'"):
        Recipe.from_dict({"model": "v", "lidar": "1d", "batsh": 3})


def test_a_recipe_file_of_two_models_gives_the_one_that_is_asked_for(tmp_path):
    path = tmp_path / "modular_1d.json"
    path.write_text(json.dumps({"settings": shipped_recipes()["modular_1d"]["settings"]}))
    assert [read_recipe(path, model).model for model in ("v", "m")] == ["v", "m"]
    for model in ("joint", None):
        with pytest.raises(ConfigError, match="is a recipe for V and M, expected one for"):
            read_recipe(path, model)


def test_shipped_recipes_are_recipes():
    from navrep_data.train import ControllerRecipe

    found = shipped_recipes()
    variants = [f"{model}_{lidar}" for model in ("transformer", "joint", "modular") for lidar in ("rings", "1d")]
    assert {*variants, *(f"{name}_z" for name in variants), "e2e_1d"} <= set(found)
    for name, entry in found.items():
        settings = entry["settings"]
        if "features" in settings:
            ControllerRecipe(**settings)
        else:
            for one in [settings] if "model" in settings else [settings["v"], settings["m"]]:
                Recipe.from_dict(one)
        assert all(line.startswith("navrep-data ") for line in entry["commands"]), name


@pytest.mark.slow
def test_shipped_commands_give_the_shipped_settings(tmp_path, monkeypatch):
    """What a recipe's last command line asks for is what the recipe says."""
    from navrep_data.cli import main
    from navrep_data.train import ControllerRecipe

    asked = {}
    monkeypatch.setattr(
        "navrep_data.train.train_world_model", lambda recipe, *_, **__: asked.update(r=recipe) or stop()
    )
    monkeypatch.setattr("navrep_data.train.train_controller", lambda recipe, *_, **__: asked.update(r=recipe) or stop())
    lidar = {"now": "1d"}
    monkeypatch.setattr("navrep_data.zoo.local.load_any_model", lambda *_: VAE(VAEConfig(lidar["now"], 8)))

    def stop():
        raise ConfigError("far enough")

    for name, entry in shipped_recipes().items():
        if name.startswith("modular") and not name.endswith("_z"):
            continue  # its last command wants codes
        lidar["now"] = "rings" if "rings" in name else "1d"
        with pytest.raises(SystemExit):
            main.run(entry["commands"][-1].split()[1:])
        settings = entry["settings"]
        assert asked["r"] == (ControllerRecipe(**settings) if "features" in settings else Recipe.from_dict(settings)), (
            name
        )


# --- codes ---


@pytest.mark.slow
def test_codes_are_those_of_the_rows(dataset, latents):
    vae, codes = latents
    windows = SequenceDataset(dataset, "1d", window=20, split="train", scan_unit="normalized", invalid="range_max")
    encoded = LatentDataset(codes, window=20, split="train")
    assert len(encoded) == len(windows)
    index = list(range(len(windows)))
    a, b = windows.batch(index), encoded.batch(index)
    for name in ("robot_state", "action", "action_valid", "reward", "is_first", "is_last", "is_terminal", "mask"):
        assert torch.equal(a[name], b[name]), name
    with torch.no_grad():
        mu, logvar = vae.distribution(a["scan"][a["mask"]])
    torch.testing.assert_close(b["mu"][b["mask"]], mu, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(b["logvar"][b["mask"]], logvar, rtol=1e-4, atol=1e-5)
    led = LatentDataset(codes, window=20, split="train", action="leading").batch(index)
    assert torch.equal(led["action"][:, 1:][led["mask"][:, 1:]], a["action"][:, :-1][led["mask"][:, 1:]])


def test_codes_of_blind_rays_are_those_that_v_was_trained_with(tmp_path):
    rng = np.random.default_rng(0)
    scans = rng.uniform(0.5, 3.0, (40, 1080)).astype(np.float32)
    scans[:, 300:700] = np.nan
    arrays = {"scans": scans, "robotstates": rng.normal(size=(40, 5)), "actions": rng.normal(size=(40, 3)),
              "rewards": np.zeros(40), "dones": np.arange(40) == 39}  # fmt: skip
    np.savez_compressed(tmp_path / "000_scans_robotstates_actions_rewards_dones.npz", **arrays)
    import_npz(tmp_path, tmp_path / "d")
    torch.manual_seed(1)
    vae = VAE(VAEConfig("1d", 8))
    encode_dataset(tmp_path / "d", vae, tmp_path / "codes")
    seen = SequenceDataset(tmp_path / "d", "1d", window=40, scan_unit="normalized", invalid="near").batch([0])
    with torch.no_grad():
        mu, _ = vae.distribution(seen["scan"][seen["mask"]])
    found = LatentDataset(tmp_path / "codes", window=40).batch([0])
    torch.testing.assert_close(found["mu"][found["mask"]], mu, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_encoding_rings_equals_windows_of_rings(dataset, tmp_path):
    torch.manual_seed(1)
    vae = VAE(VAEConfig("rings", 4))
    encode_dataset(dataset, vae, tmp_path / "codes")
    rings = SequenceDataset(dataset, "rings", window=20, split="val").batch([0])
    rings["rings"][..., 0] = 0.0
    with torch.no_grad():
        mu, _ = vae.distribution(rings["rings"][rings["mask"]])
    found = LatentDataset(tmp_path / "codes", window=20, split="val").batch([0])
    torch.testing.assert_close(found["mu"][found["mask"]], mu, rtol=1e-4, atol=1e-5)


def test_encoding_goes_on_after_an_interruption_and_refuses_other_codes(dataset, latents, tmp_path):
    vae, codes = latents
    copy = tmp_path / "copy"
    shutil.copytree(codes, copy)
    (copy / "data" / "val-00000.h5").write_bytes(b"cut")
    again = encode_dataset(dataset, vae, copy, name="V")
    assert again.complete
    for name in ("manifest.json", "data/train-00000.h5", "data/val-00000.h5"):
        assert (copy / name).read_bytes() == (codes / name).read_bytes()
    with pytest.raises(DatasetMismatchError, match="codes of another model"):
        encode_dataset(dataset, VAE(VAEConfig("1d", 8)), copy)
    with pytest.raises(FolderInUseError):
        encode_dataset(dataset, vae, dataset / "data")


@pytest.mark.parametrize("where", ["manifest.json", "data/train-00000.h5"])
def test_damaged_codes_are_refused(where, latents, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(latents[1], copy)
    data = bytearray((copy / where).read_bytes())
    data[len(data) // 2] ^= 1
    (copy / where).write_bytes(data)
    with pytest.raises(NavrepDataError):
        LatentDataset(copy)
