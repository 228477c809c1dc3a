"""Memories fed one row at a time against the whole window at once."""

import numpy as np
import pytest
import torch

from navrep_data.errors import ConfigError
from navrep_data.models import Noise, checkpoint

pytestmark = pytest.mark.slow  # seconds each; `make test` runs them

STEPS, BATCH = 70, 5


def model_of(kind):
    torch.manual_seed(7)
    model = checkpoint.make(kind, {"lidar": "1d"}).eval()
    for p in model.parameters():  # the initial weights are so small that mistakes would hide
        if p.ndim == 1 or kind == "transformer":
            torch.nn.init.normal_(p, std=0.15)
    return model


def rows_of(model):
    g = torch.Generator().manual_seed(3)
    z = torch.randn(BATCH, STEPS, model.z_size, generator=g)
    return z, 5 * torch.randn(BATCH, STEPS, 2, generator=g), torch.randn(BATCH, STEPS, 3, generator=g)


def slow_h(model, rows, context):
    """The original's way: keep a list of what came since the reset, cut it, and run all of it."""
    z, goal, action = (r[None] for r in rows)
    if context == "oldest-32":
        z, goal, action = z[:, :32], goal[:, :32], action[:, :32]
    elif context == "newest-32":
        z, goal, action = z[:, -32:], goal[:, -32:], action[:, -32:]
    h, _ = model.hidden(z, goal, action)
    return h[0, -1]


@pytest.mark.parametrize(
    ("kind", "context"),
    [
        ("modular", "carried-state"),
        ("joint", "oldest-32"),
        ("joint", "newest-32"),
        ("transformer", "oldest-32"),
        ("transformer", "newest-32"),
    ],
)
@torch.no_grad()
def test_one_step_at_a_time_equals_the_whole_window(kind, context):
    """Episodes end at random, so that every row of the batch is at another place."""
    model = model_of(kind)
    z, goal, action = rows_of(model)
    stream = model.stream(BATCH, context)
    ends = np.random.default_rng(0).random((STEPS, BATCH)) < 0.04
    ends[40:, 0] = ends[:, 0] = False  # one that never ends
    start = np.zeros(BATCH, int)
    moved = 0.0
    last = None
    for t in range(STEPS):
        if ends[t].any():
            stream.reset(torch.from_numpy(ends[t]))
            start[ends[t]] = t
        h = stream.step(z[:, t], torch.zeros_like(z[:, t]), goal[:, t], action[:, t])
        for b in range(BATCH):
            s = slice(start[b], t + 1)
            slow = slow_h(model, (z[b, s], goal[b, s], action[b, s]), context)
            np.testing.assert_allclose(h[b], slow, atol=1e-5)
        if last is not None and t < 30:
            moved = max(moved, float((h - last).abs().max()))
        last = h
    assert moved > 0.05
    assert ends.sum() > 5


@pytest.mark.parametrize("kind", ["joint", "transformer"])
@torch.no_grad()
def test_oldest_context_freezes_and_newest_does_not(kind):
    model = model_of(kind)
    z, goal, action = rows_of(model)
    seen = {}
    for context in ("oldest-32", "newest-32"):
        stream = model.stream(BATCH, context)
        seen[context] = [stream.step(z[:, t], z[:, t], goal[:, t], action[:, t]) for t in range(50)]
        assert stream.listens() == (context == "newest-32")
    frozen = seen["oldest-32"]
    assert all(torch.equal(h, frozen[31]) for h in frozen[31:])
    assert not torch.allclose(frozen[30], frozen[31])
    np.testing.assert_allclose(frozen[31], seen["newest-32"][31], atol=1e-5)
    assert not torch.allclose(seen["newest-32"][49], frozen[49], atol=1e-3)


@torch.no_grad()
def test_the_results_of_earlier_steps_are_not_overwritten():
    for kind in ("modular", "joint", "transformer"):
        model = model_of(kind)
        z, goal, action = rows_of(model)
        stream = model.stream(BATCH)
        first = stream.step(z[:, 0], z[:, 0], goal[:, 0], action[:, 0])
        copy = first.clone()
        stream.step(z[:, 1], z[:, 1], goal[:, 1], action[:, 1])
        assert torch.equal(first, copy)


@pytest.mark.parametrize("kind", ["joint", "transformer"])
@torch.no_grad()
def test_noise_comes_from_its_seed_alone(kind):
    model = model_of(kind)
    z, goal, action = rows_of(model)

    def run(seed):
        stream = model.stream(BATCH, "oldest-32", Noise.seeded(seed))
        return torch.stack([stream.step(z[:, t], z[:, t] - 4, goal[:, t], action[:, t]) for t in range(35)])

    before = torch.get_rng_state()
    first = run(1)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(first, run(1))
    assert not torch.allclose(first, run(2))
    assert not torch.allclose(first[33], first[34])  # noise is drawn anew although the context is full


def test_contexts_that_do_not_exist_are_refused():
    with pytest.raises(ConfigError, match="expected 'oldest-32' or 'newest-32' for a joint"):
        model_of("joint").stream(1, "carried-state")
    with pytest.raises(ConfigError, match="expected 'carried-state' for a modular"):
        model_of("modular").stream(1, "newest-32")
