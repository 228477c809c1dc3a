"""Sizes of the networks, their shapes, and the two ways through the rings decoder."""

import shutil
import warnings

import numpy as np
import pytest
import torch

from navrep_data.errors import ArrayError, ConfigError
from navrep_data.models import VAE, FrozenEncoder, JointConfig, TransformerConfig, VAEConfig, checkpoint, n_parameters

# MODEL_FACTS 2-5, 7, 8: counted in the original's own networks
COUNTS = [
    ("vae", {"lidar": "rings"}, 4_345_217),
    ("vae", {"lidar": "1d"}, 497_921),
    ("vae", {"lidar": "rings", "z_size": 64}, 4_443_585),
    ("vae", {"lidar": "1d", "z_size": 64}, 596_289),
    ("memory", {}, 1_390_591),
    ("modular", {"lidar": "1d"}, 497_921 + 1_390_591),
    ("joint", {"lidar": "rings"}, 4_425_603),
    ("joint", {"lidar": "1d"}, 578_307),
    ("transformer", {"lidar": "rings"}, 4_850_371),
    ("transformer", {"lidar": "1d"}, 1_003_075),
    *(("controller", {"n_inputs": d}, 128 * d + 8775) for d in (37, 69, 101, 133, 517, 549)),
    ("controller", {"n_inputs": 1085}, 147_655),
    ("e2e", {"lidar": "1d"}, 245_703),
    ("e2e", {"lidar": "rings"}, 735_431),
]


@pytest.mark.parametrize(("kind", "config", "count"), COUNTS, ids=lambda v: str(v))
def test_parameter_counts_are_the_originals(kind, config, count):
    assert n_parameters(checkpoint.make(kind, config)) == count


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["modular", "joint", "transformer"])
@pytest.mark.parametrize("lidar", ["rings", "1d"])
def test_world_models_take_and_give_the_same_shapes(kind, lidar):
    torch.manual_seed(0)
    model = checkpoint.make(kind, {"lidar": lidar}).eval()
    shape = (64, 64) if lidar == "rings" else (1080,)
    obs, goal, action = torch.rand(2, 5, *shape), torch.randn(2, 5, 2), torch.randn(2, 5, 3)
    ahead = model.predict(obs, goal, action)
    assert ahead.obs.shape == obs.shape
    assert ahead.goal.shape == goal.shape
    assert ahead.z.shape == (2, 5, model.z_size)
    assert ahead.h.shape == (2, 5, model.h_size)
    assert model.encode(obs).shape == (2, 5, model.z_size)
    assert model.decode(model.encode(obs[0, 0])).shape == shape
    assert 0 < ahead.obs.min() < ahead.obs.max() < 1


def test_rings_decode_equals_the_layers_one_by_one():
    torch.manual_seed(1)
    vae = VAE(VAEConfig("rings", 32))
    z = torch.randn(3, 32)
    slow = vae.decoder(vae.fc3(z))[:, 0]
    np.testing.assert_allclose(vae.decode(z).detach(), slow.detach(), atol=1e-6)


def test_prediction_is_causal():
    torch.manual_seed(2)
    for kind in ("modular", "joint", "transformer"):
        model = checkpoint.make(kind, {"lidar": "1d"}).eval()
        obs, goal, action = torch.rand(1, 6, 1080), torch.randn(1, 6, 2), torch.randn(1, 6, 3)
        before = model.predict(obs, goal, action).h
        obs[:, 4:], goal[:, 4:], action[:, 4:] = 0.5, 3.0, -1.0
        after = model.predict(obs, goal, action).h
        np.testing.assert_allclose(before[:, :4], after[:, :4], atol=1e-6)
        assert not torch.allclose(before[:, 4:], after[:, 4:], atol=1e-4)


def test_a_modular_model_predicts_the_mean_of_its_mixture():
    """The mean has the least squared error of all predictions; the mean of the heaviest component does not."""
    torch.manual_seed(4)
    model = checkpoint.make("modular", {"lidar": "1d", "z_size": 4, "h_size": 8}).eval()
    obs, goal, action = torch.rand(2, 5, 1080), torch.randn(2, 5, 2), torch.randn(2, 5, 3)
    with torch.no_grad():
        out = model(obs, goal, action)
        mixture = model.memory.mixture(out.h)
    weight = np.exp(mixture.logmix.numpy())
    np.testing.assert_allclose(weight.sum(-1), 1.0, rtol=1e-5)
    change = (weight * mixture.mean.numpy()).sum(-1)
    np.testing.assert_allclose(out.next_z.numpy(), out.z.numpy() + change[..., :4], atol=1e-6)
    np.testing.assert_allclose(out.next_goal.numpy(), goal.numpy() + 25.0 * change[..., 4:], atol=1e-5)
    draws = np.random.default_rng(0)
    which = (draws.random((4000, 1)) < np.cumsum(weight[0, 0, 0])).argmax(-1)
    widths = np.exp(mixture.logstd.numpy()[0, 0, 0])
    seen = mixture.mean.numpy()[0, 0, 0][which] + widths[which] * draws.standard_normal(4000)
    likeliest = float(mixture.likeliest()[0, 0, 0])
    assert ((seen - change[0, 0, 0]) ** 2).mean() < ((seen - likeliest) ** 2).mean()


def test_wrong_shapes_and_settings_are_refused():
    vae = VAE(VAEConfig("1d", 32))
    with pytest.raises(ArrayError, match=r"expected \(..., 1080\)"):
        vae.encode(torch.rand(2, 720))
    with pytest.raises(ArrayError, match="at most 32"):
        checkpoint.make("transformer", {}).predict(torch.rand(1, 33, 1080), torch.rand(1, 33, 2), torch.rand(1, 33, 3))
    with pytest.raises(ConfigError, match="lidar of a vae is 'ring'"):
        VAEConfig("ring")
    with pytest.raises(ConfigError, match="multiple of n_heads"):
        TransformerConfig(z_size=60)
    with pytest.raises(ConfigError, match="expected 2 \\* z_size"):
        JointConfig(h_size=32)
    with pytest.raises(ConfigError, match="Did you mean 'transformer'"):
        checkpoint.make("transformers", {})
    with pytest.raises(ConfigError, match="from 1 to 512"):
        checkpoint.make("vae", {"z_size": 10**9})
    with pytest.raises(ConfigError, match="no setting 'zsize'"):
        checkpoint.make("vae", {"zsize": 3})


@pytest.mark.slow
@pytest.mark.parametrize("lidar", ["rings", "1d"])
def test_the_frozen_encoder_gives_mu_in_every_way_it_may_run(lidar):
    torch.manual_seed(3)
    vae = VAE(VAEConfig(lidar, 32))
    obs = torch.rand(300, 64, 64) if lidar == "rings" else torch.rand(300, 1080)
    with torch.no_grad():
        mu, _ = vae.distribution(obs)
    encoder = FrozenEncoder.of(vae)
    np.testing.assert_allclose(encoder(obs), mu, atol=1e-6)
    encoder._fused = False
    np.testing.assert_allclose(encoder(obs), mu, atol=1e-6)
    assert not encoder(obs).requires_grad
    rounded = FrozenEncoder.of(vae, "bfloat16")
    assert rounded(obs).dtype == torch.float32
    np.testing.assert_allclose(rounded(obs), mu, atol=0.03 * float(mu.abs().max()))
    torch.nn.init.zeros_(vae.fc1.weight)
    np.testing.assert_allclose(encoder(obs), mu, atol=1e-6)  # a copy: training V does not move it


@pytest.mark.slow
def test_the_compiled_encoder_gives_the_same():
    if shutil.which("g++") is None and shutil.which("clang++") is None:
        pytest.skip("needs a C++ compiler")
    vae = VAE(VAEConfig("1d", 32))
    obs = torch.rand(5, 1080)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's own, about its own
        compiled = FrozenEncoder.of(vae, compile=True)(obs)
    np.testing.assert_allclose(compiled, FrozenEncoder.of(vae)(obs), atol=1e-5)
