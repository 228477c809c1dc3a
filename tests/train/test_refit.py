"""Controllers brought to another V by least squares."""

import math

import numpy as np
import pytest
import torch

from navrep_data.errors import CheckpointError, ConfigError
from navrep_data.models import VAE, Controller, ControllerConfig, EndToEnd, EndToEndConfig, VAEConfig, checkpoint
from navrep_data.models.controllers import MOST_STD
from navrep_data.sim import make_config
from navrep_data.train import controllers, default_controller_recipe, refit
from navrep_data.zoo.policy import Policy


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(refit, "_WORLDS", 32)
    monkeypatch.setattr(refit, "_ROUNDS", 8)
    monkeypatch.setattr(refit, "_STEPS_PER_ROUND", 2)
    monkeypatch.setattr(controllers, "VALIDATION_SEEDS", range(5000, 5002))


def given(features="z"):
    torch.manual_seed(0)
    settings = {"lidar": "1d", "z_size": 6, "n_blocks": 1, "n_heads": 2}
    model = checkpoint.make("transformer", settings).eval()
    network = Controller(ControllerConfig(11 if features == "z" else 17, 16, squash="tanh"))
    return Policy(network, features, "1d", model.vae, model, name="given")


def mixed(vae, n_more=2):
    """Return a V whose codes are a mix of this one's, and some more."""
    torch.manual_seed(1)
    z = vae.config.z_size
    other = VAE(VAEConfig("1d", z + n_more)).eval()
    other.encoder.load_state_dict(vae.encoder.state_dict())
    with torch.no_grad():
        mix = torch.linalg.qr(torch.randn(z, z)).Q
        other.fc1.weight[:z], other.fc1.bias[:z] = mix @ vae.fc1.weight, mix @ vae.fc1.bias + 3.0
    return other


def test_linear_map_is_found():
    torch.manual_seed(0)
    new = torch.randn(500, 5, dtype=torch.float64)
    a, b = torch.randn(3, 5, dtype=torch.float64), torch.randn(3, dtype=torch.float64)
    found_a, found_b, explained = refit.linear_map(new, new @ a.T + b)
    torch.testing.assert_close(found_a, a, atol=0.01, rtol=0.01)
    torch.testing.assert_close(found_b, b, atol=0.01, rtol=0.01)
    assert explained > 0.9999
    assert refit.linear_map(new, torch.randn(500, 3, dtype=torch.float64))[2] < 0.1


def test_scans_are_always_the_same_and_robots_move():
    config = make_config("navrep-train")
    scans = refit.random_scans(config, 4, 3, 5)
    assert scans.shape == (12, 1080)
    np.testing.assert_array_equal(scans, refit.random_scans(config, 4, 3, 5))
    assert not np.array_equal(scans[:4], scans[4:8])


def test_a_controller_drives_as_before_through_a_v_that_says_the_same():
    init = given()
    vae = mixed(init.vae)
    config = make_config("navrep-train")
    before = {name: p.clone() for name, p in init.network.named_parameters()}
    network, explained = refit.refit(init, vae, config)
    assert explained > 0.995
    assert network.config == ControllerConfig(13, 16, squash="tanh")
    scans = refit.random_scans(make_config("navrep-test"), 16, 2, 3)
    robot_state = torch.randn(len(scans), 5)
    with torch.no_grad():
        old = init.network(torch.cat([refit.codes(init.vae, scans).float(), robot_state], 1))
        new = network(torch.cat([refit.codes(vae, scans).float(), robot_state], 1))
    spread = float(old[0].std())
    for mine, theirs in zip(new, old, strict=True):
        assert float((mine - theirs).abs().max()) < 0.1 * spread
    for name, p in init.network.named_parameters():
        assert torch.equal(p, before[name])


@pytest.mark.slow
def test_training_goes_on_from_it(tmp_path):
    init = given()
    recipe = default_controller_recipe("z", "1d").replace(
        worlds=8, rollout=8, batch=32, steps=64, validate_every=64, lr=1e-9, refit=True, precision="float32"
    )
    vae, lines = mixed(init.vae), []
    controllers.train_controller(recipe, tmp_path / "c", model=vae, init=init, report=lines.append)
    assert any(
        line.startswith("given: ") and "variance is a linear function of the new codes" in line for line in lines
    )
    expected, _ = refit.refit(init, vae, make_config("navrep-train", curriculum="adaptive"))
    with torch.no_grad():
        expected.logstd.fill_(math.log(MOST_STD))  # whose width of 1 was too large
    for name, p in checkpoint.load(tmp_path / "c").named_parameters():
        torch.testing.assert_close(p, dict(expected.named_parameters())[name], rtol=1e-3, atol=1e-5)


def test_what_cannot_be_refitted_is_said(tmp_path):
    recipe = default_controller_recipe("z", "1d").replace(refit=True, steps=64)
    init = given()
    with pytest.raises(ConfigError, match="refit is for controllers on z"):
        default_controller_recipe("h", "1d").replace(refit=True)
    with pytest.raises(ConfigError, match="but there is none: name one"):
        controllers.train_controller(recipe, tmp_path / "c", model=init.vae)
    with pytest.raises(CheckpointError, match="given takes zh"):
        controllers.train_controller(recipe, tmp_path / "c", model=init.vae, init=given("zh"))
    blind = Policy(EndToEnd(EndToEndConfig("1d")), None, "1d", name="whole")
    with pytest.raises(CheckpointError, match="whole takes observations"):
        controllers.train_controller(recipe, tmp_path / "c", model=init.vae, init=blind)
    with pytest.raises(CheckpointError, match="or --set refit=true"):
        controllers.train_controller(
            recipe.replace(refit=False), tmp_path / "c", model=mixed(init.vae), init=init
        )  # fmt: skip
    assert not (tmp_path / "c").exists()
