"""Loading and driving neither depends on torch's global settings nor moves its generators."""

import numpy as np
import pytest
import torch

from navrep_data import zoo
from navrep_data.datasets import SequenceDataset, make_loader
from navrep_data.evaluate import benchmark
from navrep_data.models import VAE, Controller, ControllerConfig, QuantizedEncoder, VAEConfig
from navrep_data.models.quantized import can_quantize, weight_levels
from navrep_data.testing import tiny_dataset
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3 import to_sb3

NAMES = ["transformer_rings_z.v1", "joint_1d_z.v1", "modular_1d_z.v1", "e2e_1d.v1"]


@pytest.fixture(params=["float64", "meta", "inference"])
def other_settings(request):
    """A default dtype, a default device and a mode that nobody here expects."""
    if request.param == "float64":
        torch.set_default_dtype(torch.float64)
    elif request.param == "meta":
        torch.set_default_device("meta")
    with torch.inference_mode(request.param == "inference"):
        yield
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)


def drive(name, inference="deterministic"):
    """Return what a policy does, and kinds of its weights."""
    policy = zoo.load(name, inference=inference)
    policy.reset(batch_size=2)
    scan = np.linspace(1.0, 20.0, 2160, dtype=np.float32).reshape(2, 1080)
    actions = [policy.act(scan + k, np.tile(np.float32([4, k, 0, 0, 0]), (2, 1))) for k in range(3)]
    parts = [part for part in (policy.network, policy.vae, policy.world_model) if part is not None]
    kinds = {(p.dtype, p.device.type, p.is_inference()) for part in parts for p in part.parameters()}
    return np.array(actions), kinds


EXPECTED = {}


@pytest.fixture(scope="module", autouse=True)
def expected():
    for name in NAMES:
        EXPECTED[name] = drive(name)[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_policies_are_the_same_whatever_torchs_defaults_are(name, other_settings):
    actions, kinds = drive(name)
    assert actions.dtype == np.float32
    np.testing.assert_array_equal(actions, EXPECTED[name])
    assert kinds == {(torch.float32, "cpu", False)}


@pytest.mark.slow
def test_the_default_is_put_back(other_settings):
    before = torch.get_default_dtype(), torch.get_default_device()
    zoo.load(NAMES[0])
    assert (torch.get_default_dtype(), torch.get_default_device()) == before


@pytest.mark.slow
def test_datasets_are_the_same_whatever_torchs_defaults_are(tmp_path, other_settings):
    tiny_dataset(tmp_path / "tiny")
    window = SequenceDataset(tmp_path / "tiny", lidar="rings", window=8)[0]
    assert {value.dtype for value in window.values()} <= {torch.float32, torch.bool, torch.int64}
    assert {value.device.type for value in window.values()} == {"cpu"}


@pytest.mark.slow
def test_nothing_is_drawn_from_global_generators(tmp_path):
    tiny_dataset(tmp_path / "tiny")
    controller, vae = Controller(ControllerConfig(69)), VAE(VAEConfig("rings"))
    weight_levels.cache_clear()  # it tries the processor's instructions at the first call only
    torch.manual_seed(11)
    np.random.seed(11)  # noqa: NPY002  the generator that everybody shares
    state, numpy_state = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
    for name in NAMES:
        drive(name)
    drive(NAMES[0], inference="as_released")
    to_sb3(Policy(controller, "z", "rings", zoo.load(NAMES[0]).vae), device="cpu")
    if can_quantize():
        QuantizedEncoder(vae, torch.zeros(2, 64, 64))
    dataset = SequenceDataset(tmp_path / "tiny", lidar="1d", window=8)
    dataset[0]
    next(iter(make_loader(dataset, batch_size=2, shuffle=True, seed=3)))
    assert torch.equal(torch.get_rng_state(), state)
    after = np.random.get_state()  # noqa: NPY002
    assert (after[1] == numpy_state[1]).all()
    assert after[2:] == numpy_state[2:]


@pytest.fixture
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
def test_a_benchmark_plays_on_one_thread_and_puts_the_number_back(tmp_path, three_threads):
    seen = []
    benchmark(
        ["e2e_1d.v1"], episodes=1, out=tmp_path, figures=False,
        progress=lambda name, *_: seen.append((name, torch.get_num_threads())),
    )  # fmt: skip
    assert ("e2e_1d.v1", 1) in seen
    assert ("goal", 3) in seen
    assert torch.get_num_threads() == 3


def test_a_benchmark_that_is_interrupted_puts_the_number_back(tmp_path, three_threads):
    def interrupt(name, *_):
        if name != "goal":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        benchmark(["e2e_1d.v1"], episodes=1, out=tmp_path, figures=False, progress=interrupt)
    assert torch.get_num_threads() == 3, "while the traceback still holds the run's frames"
    del caught
