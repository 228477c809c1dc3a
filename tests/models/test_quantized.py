"""The encoder in 8 bits, against the same in float32."""

import numpy as np
import pytest
import torch

from navrep_data.errors import ConfigError
from navrep_data.models import VAE, FrozenEncoder, QuantizedEncoder, VAEConfig, observation_from_scan, quantized
from navrep_data.sim import Simulator, make_config

needs_int8 = pytest.mark.skipif(not quantized.can_quantize(), reason="this processor or torch has no 8-bit convolution")


@pytest.fixture(scope="module")
def scans():
    simulator = Simulator(make_config("navrep-train"), 48, seed=3)
    simulator.reset()
    return simulator.observe()[0]


def small_vae(lidar):
    torch.manual_seed(1)
    return VAE(VAEConfig(lidar, 16)).eval()


@pytest.mark.slow
@needs_int8
@pytest.mark.parametrize("lidar", ["rings", "1d"])
def test_codes_are_near_those_of_float32(lidar, scans):
    share = 0.05 if quantized.weight_levels() == 127 else 0.07
    vae = small_vae(lidar)
    obs = observation_from_scan(scans, lidar)
    exact = FrozenEncoder.of(vae)(obs)
    found = QuantizedEncoder(vae, obs[:24])(obs)
    assert found.shape == exact.shape
    assert found.dtype == torch.float32
    off = (found - exact).square().mean().sqrt()
    assert 0.0 < float(off) < share * float((exact - exact.mean(0)).square().mean().sqrt())


@needs_int8
@pytest.mark.parametrize("channels", [1, 32])
def test_the_largest_sums_are_not_cut(channels):
    """Some processors add pairs of products in 16 bits, which 2 x 255 x 127 does not fit."""
    conv = torch.nn.Conv2d(channels, 8, 3, bias=False)
    torch.nn.init.constant_(conv.weight, 0.5)
    whole = torch.full((1, channels, 5, 5), 255, dtype=torch.uint8).to(memory_format=torch.channels_last)
    found = quantized.Layer(conv, 1 / 255, None, quantized.weight_levels())(whole)
    torch.testing.assert_close(found, torch.full((1, 8, 3, 3), channels * 9 * 0.5))


@needs_int8
def test_ranges_are_not_rounded_before_the_first_layer(scans):
    """Its bytes are those of the exact maps to half a step, although a step of the ranges in 8 bits would be 10 cm."""
    vae = small_vae("1d")
    obs = observation_from_scan(scans, "1d")
    first = QuantizedEncoder(vae, obs).layers[0]
    maps = vae.encoder[0](obs[:, None, None]).relu().detach()
    scale = vae.encoder[0].weight.flatten()[0].item() / first.weight.flatten()[0].item()
    found = first(obs[:, None, None].contiguous(memory_format=torch.channels_last))
    assert found.dtype == torch.uint8
    off = (found.float() - (maps / scale).clamp(max=255.0)).abs()
    assert float(off.max()) <= 0.501


@pytest.mark.slow
@needs_int8
def test_the_same_calibration_gives_the_same_encoder_in_any_batch(scans):
    vae = small_vae("rings")
    obs = observation_from_scan(scans, "rings")
    first, second = QuantizedEncoder(vae, obs), QuantizedEncoder(vae, obs)
    whole = first(obs)
    assert torch.equal(whole, second(obs))
    np.testing.assert_allclose(torch.cat([first(part) for part in obs.split(7)]), whole, atol=1e-6)


@pytest.mark.slow
@needs_int8
def test_the_v_itself_stays_as_it_is(scans):
    vae = small_vae("rings")
    before = {name: tensor.clone() for name, tensor in vae.state_dict().items()}
    QuantizedEncoder(vae, observation_from_scan(scans, "rings"))
    assert all(torch.equal(before[name], tensor) for name, tensor in vae.state_dict().items())


def test_without_8_bit_convolutions_it_says_so(monkeypatch, scans):
    monkeypatch.setattr(quantized, "can_quantize", lambda: False)
    with pytest.raises(ConfigError, match="set precision to bfloat16"):
        QuantizedEncoder(small_vae("rings"), observation_from_scan(scans, "rings"))
