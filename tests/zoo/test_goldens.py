"""The compact golden files of the package: one for each checkpoint, and a network that computes otherwise is found."""

import numpy as np
import pytest
import torch

from navrep_data import zoo
from navrep_data.zoo import golden, registry
from navrep_data.zoo.fetching import Source, locate
from navrep_data.zoo.verification import compare_compact, open_alone

CHECKPOINTS = {name: r for name, r in registry.records().items() if r.is_checkpoint}
OURS = [name for name, r in CHECKPOINTS.items() if r.ours]
NEVER_SEEN = {
    "joint_rings.released", "modular_1d_m.released", "modular_rings_m.released", "modular_rings_v.released",
    "transformer_rings.released",
}  # fmt: skip
MOST_BYTES = 300_000


def network(name):
    record = CHECKPOINTS[name]
    path, wrong = locate(record.files[0], Source.of(None))
    assert wrong is None
    return record, open_alone(record, path)


def test_every_checkpoint_that_could_be_had_has_its_file():
    """A new one gets its own by ``python tools/compact_goldens.py``."""
    files = {path.stem: path for path in golden.COMPACT.glob("*.npz")}
    assert set(files) == set(CHECKPOINTS) - NEVER_SEEN
    assert sum(path.stat().st_size for path in files.values()) <= MOST_BYTES
    for name, path in files.items():
        with np.load(path) as arrays:
            own = [f for f in CHECKPOINTS[name].golden if not f.startswith("encoder_")]
            assert bool(arrays["original"]) == bool(own), name
            values = [arrays[key] for key in arrays.files]
            assert all(np.isfinite(v).all() for v in values), name


@pytest.mark.slow
def test_our_weights_compute_what_they_did():
    report = zoo.verify("*.v1")
    assert len(report.checks) == len(OURS) == 13
    for check in report.checks:
        assert check.status == "ok", check.problems
        assert {c.original for c in check.comparisons} == {False}
        names = {c.output for c in check.comparisons}
        assert "weights" in names
        if CHECKPOINTS[check.name].kind == "world_model":
            assert {"mu", "decode_mu", "seq0_h_det", "seq0_next_obs_det", "seq0_next_state_det"} < names
        else:
            assert {"action_mean", "value"} < names


@pytest.mark.slow
@pytest.mark.parametrize("name", ["e2e_1d.v1", "modular_1d.v1", "transformer_1d_z.v1"])
@torch.no_grad()
def test_one_weight_that_is_another_is_found(name):
    record, module = network(name)
    assert all(c.ok for c in compare_compact(record, module))
    for key, tensor in module.state_dict().items():
        flat = tensor.view(-1)
        k = len(flat) // 3
        before = flat[k].clone()
        flat[k] += 1e-6 * tensor.abs().max()
        wrong = [c.output for c in compare_compact(record, module) if not c.ok]
        assert "weights" in wrong or flat[k] == before, key
        flat[k] = before
    assert all(c.ok for c in compare_compact(record, module))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tensor", "outputs"),
    [
        ("e2e_1d.v1", "pi.0.weight", {"action_mean"}),
        ("e2e_1d.v1", "vf.0.weight", {"value"}),
        ("modular_rings.v1", "vae.fc1.weight", {"mu", "decode_mu", "seq0_h_det", "seq0_next_obs_det"}),
        ("modular_rings.v1", "memory.lstm.weight_hh_l0", {"seq0_h_det", "seq0_next_state_det"}),
        ("transformer_1d.v1", "blocks.0.attn.value.weight", {"seq0_h_det", "seq0_next_state_det"}),
    ],
)
@torch.no_grad()
def test_the_outputs_depend_on_the_weights(name, tensor, outputs):
    record, module = network(name)
    module.state_dict()[tensor].mul_(1.001)
    wrong = {c.output for c in compare_compact(record, module) if not c.ok}
    assert outputs | {"weights"} <= wrong


def test_thin_rows():
    assert np.array_equal(golden.thin(np.arange(8).reshape(2, 4)), [[0, 1, 2, 3], [4, 5, 6, 7]])
    rows = golden.thin(np.arange(2 * 1080).reshape(2, 1080, 1))
    assert rows.shape == (2, 64)
    assert rows[1, 1] - rows[1, 0] == 17


def test_sums_tell_tensors_apart():
    module = torch.nn.Linear(3, 2)
    before, _ = golden.weight_sums(module)
    with torch.no_grad():
        module.weight.copy_(module.weight.flip(1))
    after, _ = golden.weight_sums(module)
    assert (before != after).tolist() == [False, True]
    assert golden.weights_output(module, {"weights": before})[1] > golden.WEIGHT_SUMS
    assert golden.weights_output(module, {"weights": after})[1] == 0.0
    assert golden.weights_output(module, {"weights": after[:1]})[1] == float("inf")
