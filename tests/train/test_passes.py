"""Fast passes of V and of end-to-end networks against the plain modules: values and gradients."""

import gymnasium
import numpy as np
import pytest
import torch

from navrep_data.models import VAE, EndToEnd, VAEConfig
from navrep_data.train import passes
from navrep_data.train.ppo_policy import FastExtractor
from navrep_data.zoo.sb3 import EndToEndExtractor


def gradients(vae, loss):
    vae.zero_grad()
    loss.backward()
    return {name: p.grad.clone() for name, p in vae.named_parameters()}


@pytest.mark.slow
@pytest.mark.parametrize(("lidar", "shape"), [("rings", (64, 64)), ("1d", (1080,))])
def test_values_and_gradients_are_those_of_the_plain_network(lidar, shape):
    torch.manual_seed(0)
    vae, obs, z = VAE(VAEConfig(lidar, 8)), torch.rand(2, *shape), torch.randn(2, 8)
    mu, logvar = vae.distribution(obs)
    logits = vae.decode_logits(z + mu)
    fast_mu, fast_logvar = passes.distribution(vae, obs, torch.float32)
    fast_logits = passes.decode_logits(vae, z + fast_mu, torch.float32)
    for plain, fast in ((mu, fast_mu), (logvar, fast_logvar), (logits, fast_logits)):
        torch.testing.assert_close(fast, plain, rtol=1e-4, atol=1e-5)
    expected = gradients(vae, mu.square().sum() + logvar.sum() + logits.square().sum())
    found = gradients(vae, fast_mu.square().sum() + fast_logvar.sum() + fast_logits.square().sum())
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-3, atol=1e-4 * float(value.abs().max()))


@pytest.mark.parametrize(("lidar", "shape"), [("rings", (64, 64)), ("1d", (1080,))])
def test_bfloat16_is_near(lidar, shape):
    torch.manual_seed(0)
    vae, obs = VAE(VAEConfig(lidar, 8)), torch.rand(2, *shape)
    with torch.no_grad():
        mu, _ = vae.distribution(obs)
        fast, _ = passes.distribution(vae, obs, torch.bfloat16)
    assert fast.dtype == torch.float32
    assert float((fast - mu).abs().max()) < 0.05 * float(mu.abs().max())
    assert not torch.equal(fast, mu)


@pytest.mark.slow
@pytest.mark.parametrize(("lidar", "size"), [("rings", 4101), ("1d", 1085)])
def test_end_to_end_values_and_gradients_are_those_of_the_plain_network(lidar, size):
    torch.manual_seed(0)
    space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    plain = EndToEndExtractor(space, lidar)
    inputs = torch.rand(300, size) * (20.0 if lidar == "1d" else 1.0)  # more than one part
    expected = plain(inputs)
    slopes = gradients(plain, expected.square().sum())
    for precision, tolerance in (("float32", 1e-3), ("bfloat16", 0.05)):
        fast = FastExtractor(space, lidar, precision)
        fast.load(plain.network)
        features = fast(inputs)
        assert features.dtype == torch.float32
        away = (features - expected).detach().abs().max()
        assert 0 < float(away) < tolerance * float(expected[:, :-5].detach().abs().max())
        torch.testing.assert_close(features[:, -5:], inputs[:, -5:])
        for name, value in gradients(fast, features.square().sum()).items():
            wanted = slopes[name] * (fast.scale if name == "network.encoder.0.weight" else 1.0)
            assert float((value - wanted).norm()) < tolerance * float(wanted.norm()), name
        back = EndToEnd(plain.network.config)
        fast.store(back)
        for name, value in plain.network.state_dict().items():
            assert torch.equal(back.state_dict()[name], value)
