"""Losses against slow, plain formulas."""

import math

import pytest
import torch

from navrep_data.models import (
    MDNRNN,
    MemoryConfig,
    Mixture,
    Noise,
    TransformerConfig,
    TransformerWorldModel,
    checkpoint,
)
from navrep_data.train import default_recipe, original_recipe
from navrep_data.train.losses import (
    Counts,
    _expects,
    _memory_expects,
    _zero_state,
    divergence,
    memory_loss,
    mixture_nll,
    observation_loss,
    partly_dreamt,
    restart_loss,
    run_with_restarts,
    vae_loss,
    world_model_loss,
)
from navrep_data.train.optim import decaying, learning_rate


def test_mixture_nll_is_that_of_a_sum_of_normals():
    torch.manual_seed(0)
    mixture = Mixture(torch.log_softmax(torch.randn(3, 5), -1), torch.randn(3, 5), torch.randn(3, 5), torch.zeros(3))
    x = torch.randn(3)
    for d in range(3):
        density = 0.0
        for k in range(5):
            width = math.exp(float(mixture.logstd[d, k]))
            away = (float(x[d]) - float(mixture.mean[d, k])) / width
            density += (
                math.exp(float(mixture.logmix[d, k])) * math.exp(-0.5 * away**2) / (width * math.sqrt(2 * math.pi))
            )
        assert float(mixture_nll(mixture, x)[d]) == pytest.approx(-math.log(density), rel=1e-5)


def test_restart_loss_weighs_restarts_tenfold():
    logit, target = torch.tensor([0.3, 0.3]), torch.tensor([1.0, 0.0])
    p = 1 / (1 + math.exp(-0.3))
    found = restart_loss(logit, target, 10.0)
    assert found.tolist() == pytest.approx([-10 * math.log(p), -math.log(1 - p)], rel=1e-5)


def test_divergence_and_floors_follow_the_authors():
    mu, logvar = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 1.0]])
    each = [-0.5 * (1 + 0 - 1 - 1), -0.5 * (1 + 1 - 0 - math.e)]
    v, joint = original_recipe("v", "rings"), original_recipe("joint", "rings")
    assert float(divergence(mu, logvar, v)) == pytest.approx(sum(each))
    assert float(divergence(mu, logvar, joint)) == pytest.approx(sum(each) / 2)
    assert (v.kl_weight, v.kl_floor, joint.kl_weight, joint.kl_floor) == (1.0, 16.0, 0.001, 0.5)


def test_observation_losses():
    logits, target = torch.randn(2, 64, 64), torch.rand(2, 64, 64)
    p = torch.sigmoid(logits.double())
    t = target.double()
    bce = -(t * p.log() + (1 - t) * (1 - p).log()).mean((1, 2))
    torch.testing.assert_close(observation_loss(logits, target, "cross_entropy").double(), bce, rtol=1e-4, atol=1e-5)
    squared = ((p - t) ** 2).sum((1, 2))
    torch.testing.assert_close(observation_loss(logits, target, "squared_sum").double(), squared, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("given", [True, False])
def test_the_state_goes_back_to_the_fed_one_at_restarts(given):
    torch.manual_seed(0)
    m = MDNRNN(MemoryConfig(z_size=4, h_size=8))
    inputs = torch.randn(3, 9, m.n_inputs + 1)
    restart = torch.zeros(3, 9, dtype=torch.bool)
    restart[0, 4] = restart[0, 5] = restart[2, 8] = True
    mask = torch.ones(3, 9, dtype=torch.bool)
    state = (torch.randn(1, 3, 8), torch.randn(1, 3, 8)) if given else None
    h, after = run_with_restarts(m, inputs, restart, mask, state)
    start = (torch.zeros(1, 3, 8), torch.zeros(1, 3, 8)) if state is None else state
    for b in range(3):
        now = tuple(s[:, b : b + 1].contiguous() for s in start)
        for t in range(9):
            if restart[b, t]:
                now = tuple(s[:, b : b + 1].contiguous() for s in start)
            out, now = m.lstm(inputs[b : b + 1, t : t + 1], now)
            torch.testing.assert_close(h[b, t], out[0, 0], rtol=1e-5, atol=1e-6)
        for kept, last in zip(after, now, strict=True):
            torch.testing.assert_close(kept[:, b], last[:, 0], rtol=1e-5, atol=1e-6)


def batch_of(n, t, rows):
    mask = torch.arange(t) < torch.tensor(rows)[:, None]
    next_mask = torch.arange(t) < torch.tensor(rows)[:, None] - 1
    return {
        "obs": torch.rand(n, t, 1080), "next_obs": torch.rand(n, t, 1080), "mask": mask, "next_mask": next_mask,
        "goal_mask": next_mask, "goal": torch.randn(n, t, 2), "next_goal": torch.randn(n, t, 2),
        "action": torch.randn(n, t, 3), "reconstruct": torch.ones(n, t, dtype=torch.bool),
        "predict": torch.ones(n, t, dtype=torch.bool),
    }  # fmt: skip


def test_the_parts_of_a_batch_add_up_to_it_and_padding_does_not_count():
    from navrep_data.train.data import part

    torch.manual_seed(0)
    model = TransformerWorldModel(TransformerConfig("1d", 16, 1, 2, 4))
    recipe = default_recipe("transformer", "1d").replace(precision="float32", kl_warmup=0)
    batch = batch_of(4, 4, [4, 2, 1, 3])
    counts = Counts(10, 6, 10, 6)

    def loss(first, stop):
        return float(world_model_loss(model, part(batch, first, stop), recipe, 0, None, counts).total.detach())

    whole = loss(0, 4)
    parts = loss(0, 2) + loss(2, 4)
    assert parts == pytest.approx(whole, rel=1e-5)
    for name in ("obs", "next_obs", "goal", "next_goal", "action"):
        away = ~batch["mask"] if name in ("obs", "goal", "action") else ~batch["next_mask"]
        batch[name][away] = 1e3
    assert loss(0, 4) == pytest.approx(whole, rel=1e-5)


def unreached(model):
    return [n for n, p in model.named_parameters() if p.grad is None or not bool(p.grad.abs().sum() > 0)]


@pytest.mark.slow
@pytest.mark.parametrize("original", [False, True])
@pytest.mark.parametrize("kind", ["joint", "transformer"])
def test_gradients_reach_every_weight_of_a_world_model(kind, original):
    from navrep_data.train.data import part

    torch.manual_seed(0)
    settings = {"lidar": "1d", "z_size": 16}
    settings |= {"h_size": 32} if kind == "joint" else {"n_blocks": 2, "n_heads": 2, "context": 4}
    model = checkpoint.make(kind, settings).train()
    # beyond the step at which the weight of the KL divergence has risen
    recipe = (original_recipe if original else default_recipe)(kind, "1d").replace(kl_floor=0.0)
    batch = part(batch_of(2, 4, [4, 4]), 0, 2)
    world_model_loss(model, batch, recipe, 5000, Noise.seeded(0), Counts(8, 6, 8, 6)).total.backward()
    # softmax does not see what is added to all its inputs alike
    assert [n for n in unreached(model) if not n.endswith("attn.key.bias")] == []


@pytest.mark.parametrize("kind", ["joint", "transformer"])
def test_dreamt_rows_are_what_the_memory_expected(kind):
    """With all rows of a window dreamt, the first ones are those of a dream from its first row on."""
    torch.manual_seed(0)
    settings = {"lidar": "1d", "z_size": 8, "residual": True, "action_alignment": "taken"}
    settings |= {"h_size": 16} if kind == "joint" else {"n_blocks": 2, "n_heads": 2, "context": 8}
    model = checkpoint.make(kind, settings).eval()
    recipe = default_recipe(kind, "1d").replace(dream_share=1.0)
    z, mask = torch.randn(16, 6, 8), torch.ones(16, 6, dtype=torch.bool)
    mask[:, 5] = False
    batch = {"mask": mask, "goal": torch.randn(16, 6, 2), "action": torch.randn(16, 6, 3)}
    fed, fed_goal = partly_dreamt(
        z, batch["goal"], batch["mask"], _expects(model, batch), recipe.dream_share, Noise.seeded(1)
    )
    dreaming = (fed[:, 1] != z[:, 1]).any(1)
    assert 3 <= int(dreaming.sum()) <= 13  # every second window
    torch.testing.assert_close(fed[~dreaming], z[~dreaming])
    torch.testing.assert_close(fed_goal[~dreaming], batch["goal"][~dreaming])
    torch.testing.assert_close(fed[:, [0, 5]], z[:, [0, 5]])  # first rows, and padding
    dream, goal = z[dreaming][:, :1], batch["goal"][dreaming][:, :1]
    for length in (1, 2, 3):
        h, _ = model.hidden(dream, goal, batch["action"][dreaming][:, :length], None, _zero_state(model, dream))
        ahead = model.heads(dream, goal, h)
        dream, goal = torch.cat([dream, ahead[0][:, -1:]], 1), torch.cat([goal, ahead[1][:, -1:]], 1)
    torch.testing.assert_close(fed[dreaming][:, :4], dream, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(fed_goal[dreaming][:, :4], goal, atol=1e-5, rtol=1e-4)


def test_m_dreams_until_an_episode_ends():
    torch.manual_seed(0)
    memory = MDNRNN(MemoryConfig(8, 16, 3, "taken")).eval()
    z, goal, action = torch.randn(16, 6, 8), torch.randn(16, 6, 2), torch.randn(16, 6, 3)
    restart, mask = torch.zeros(16, 6), torch.ones(16, 6, dtype=torch.bool)
    restart[:, 3], mask[:, 5] = 1.0, False
    batch = {"mask": mask, "action": action, "restart": restart}
    may = mask & ~restart.bool()
    fed, fed_goal = partly_dreamt(z, goal, may, _memory_expects(memory, batch), 1.0, Noise.seeded(1))
    dreaming = (fed[:, 1] != z[:, 1]).any(1)
    assert 3 <= int(dreaming.sum()) <= 13
    torch.testing.assert_close(fed[:, [0, 3, 5]], z[:, [0, 3, 5]])  # first rows of windows and episodes, and padding
    for first, last in ((0, 3), (3, 5)):
        flags = restart[dreaming][:, first:last]
        dream, ahead_goal = z[dreaming][:, first : first + 1], goal[dreaming][:, first : first + 1]
        for length in range(1, last - first):
            actions = action[dreaming][:, first : first + length]
            h, _ = memory.hidden(memory.inputs(dream, ahead_goal, actions, flags[:, :length]))
            change = memory.mixture(h[:, -1:]).expected()
            dream = torch.cat([dream, dream[:, -1:] + change[..., :8]], 1)
            ahead_goal = torch.cat([ahead_goal, ahead_goal[:, -1:] + change[..., 8:] * 25.0], 1)
        torch.testing.assert_close(fed[dreaming][:, first:last], dream, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(fed_goal[dreaming][:, first:last], ahead_goal, atol=1e-5, rtol=1e-4)


def test_m_learns_the_way_back_from_its_dreams():
    torch.manual_seed(0)
    memory = MDNRNN(MemoryConfig(8, 16, 3, "taken"))
    with torch.no_grad():  # a memory that always expects a step of 1 in z[0]
        memory.output.weight.zero_()
        memory.output.bias.zero_()
        memory.output.bias[1:].reshape(10, 3, 3)[0, 1] = 1.0
    z, goal = torch.zeros(64, 5, 8), torch.zeros(64, 5, 2)
    batch = {
        "z": z[:, :-1], "next_z": z[:, 1:], "goal": goal[:, :-1], "next_goal": goal[:, 1:],
        "action": torch.zeros(64, 4, 3), "restart": torch.zeros(64, 4), "next_last": torch.zeros(64, 4),
        **dict.fromkeys(("mask", "next_mask", "goal_mask"), torch.ones(64, 4, dtype=torch.bool)),
    }  # fmt: skip
    recipe = default_recipe("m", "1d").replace(dream_share=1.0)
    real = memory_loss(memory, batch, recipe, noise=None)[0].parts
    dreamt = memory_loss(memory, batch, recipe, noise=Noise.seeded(1))[0].parts
    # rows 0..3 have drifted by 0, 1, 2 and 3 and expect one more: half the windows are off by 1, 2, 3, 4 in z[0]
    assert real["z_error"] == pytest.approx(1 / 8)
    assert 0.3 < (dreamt["z_error"] - 1 / 8) / ((30 / 4 - 1) / 8) < 0.7
    assert real == memory_loss(memory, batch, recipe.replace(dream_share=0.0), noise=Noise.seeded(1))[0].parts
    starts = {**batch, "restart": torch.ones(64, 4)}  # no row follows another: nothing to dream
    assert memory_loss(memory, starts, recipe, noise=Noise.seeded(1))[0].parts["z_error"] == pytest.approx(1 / 8)


def test_dreaming_costs_real_rows_nothing_and_teaches_all():
    from navrep_data.train.data import part

    torch.manual_seed(0)
    model = TransformerWorldModel(TransformerConfig("1d", 16, 2, 2, 4, residual=True)).train()
    batch = part(batch_of(2, 4, [4, 4]), 0, 2)
    plain = default_recipe("transformer", "1d").replace(kl_weight=0.0)

    def found(share):
        return world_model_loss(
            model, batch, plain.replace(dream_share=share), 0, Noise.seeded(2), Counts(8, 6, 8, 6)
        )  # fmt: skip

    without, half = found(0.0), found(0.5)
    assert half.parts["rec"] == pytest.approx(without.parts["rec"], abs=1e-6)
    assert half.parts["pred"] != without.parts["pred"]
    half.total.backward()
    assert [n for n in unreached(model) if not n.endswith("attn.key.bias")] == []


def test_the_prediction_teaches_memory_and_encoder_by_itself():
    from navrep_data.train.data import part

    torch.manual_seed(0)
    model = TransformerWorldModel(TransformerConfig("1d", 16, 1, 2, 4))
    batch = part(batch_of(2, 4, [4, 4]), 0, 2)
    batch["reconstruct"] = torch.zeros(2, 4, dtype=torch.bool)
    recipe = default_recipe("transformer", "1d").replace(kl_weight=0.0)
    world_model_loss(model, batch, recipe, 5000, Noise.seeded(0), Counts(8, 6, 0, 6)).total.backward()
    assert {"vae.encoder.0.weight", "blocks.0.attn.query.weight", "z_head.weight", "action_emb.weight"} <= {
        n for n, p in model.named_parameters() if p.grad is not None and bool(p.grad.abs().sum() > 0)
    }


def test_gradients_reach_every_weight_of_v_and_m():
    torch.manual_seed(0)
    v = checkpoint.make("vae", {"lidar": "1d", "z_size": 8}).train()
    vae_loss(
        v, {"obs": torch.rand(3, 1080)}, default_recipe("v", "1d"), 5000, Noise.seeded(0), Counts(3, 0, 3, 0)
    ).total.backward()
    assert unreached(v) == []
    m = checkpoint.make("memory", {"z_size": 4, "h_size": 8}).train()
    rows = {
        name: torch.randn(2, 5, n)
        for name, n in (("z", 4), ("next_z", 4), ("goal", 2), ("next_goal", 2), ("action", 3))
    }
    flags = {"restart": torch.zeros(2, 5), "next_last": torch.zeros(2, 5)}
    masks = dict.fromkeys(("mask", "next_mask", "goal_mask"), torch.ones(2, 5, dtype=torch.bool))
    terms, _ = memory_loss(m, {**rows, **flags, **masks}, default_recipe("m", "1d"))
    terms.total.backward()
    assert unreached(m) == []


def test_unknown_goals_teach_m_nothing():
    torch.manual_seed(0)
    m = checkpoint.make("memory", {"z_size": 4, "h_size": 8}).eval()
    n = {"z": 4, "next_z": 4, "goal": 2, "next_goal": 2, "action": 3}
    rows = {name: torch.randn(2, 5, size) for name, size in n.items()}
    rows |= {"restart": torch.zeros(2, 5), "next_last": torch.zeros(2, 5)}
    rows |= dict.fromkeys(("mask", "next_mask", "goal_mask"), torch.ones(2, 5, dtype=torch.bool))
    recipe = default_recipe("m", "1d")
    whole = memory_loss(m, rows, recipe)[0].parts
    last = torch.tensor([1, 1, 1, 1, 0], dtype=torch.bool).expand(2, 5)
    some = memory_loss(m, {**rows, "goal_mask": last}, recipe)[0].parts
    assert some["z_error"] == whole["z_error"]
    assert some["nll"] != whole["nll"]
    far = {**rows, "goal_mask": last, "next_goal": rows["next_goal"].clone()}
    far["next_goal"][:, 4] = 1e6
    assert memory_loss(m, far, recipe)[0].parts == some


def test_only_matrices_decay_by_default_and_nearly_all_by_the_authors():
    model = TransformerWorldModel(TransformerConfig("1d", 16, 1, 2, 4))
    ours, theirs = decaying(model, "matrices"), decaying(model, "authors")
    assert not any("bias" in n or ".ln" in n or n in ("pos_emb", "ln_f.weight") for n in ours)
    assert {"pos_emb", "ln_f.weight", "blocks.0.ln1.weight", "vae.encoder.0.weight"} <= theirs
    assert "vae.encoder.0.weight" in ours


def test_the_authors_schedules():
    w, m = original_recipe("transformer", "rings"), original_recipe("m", "rings")
    assert learning_rate(w, 0, 0, 1000) == 6e-4
    assert learning_rate(w, 1, 5120, 10**6) == pytest.approx(3e-4)
    assert learning_rate(w, 99, 200 * 10**6, 10**6) == pytest.approx(6e-5)  # the end of 200 epochs
    assert learning_rate(w, 999, 400 * 10**6 - 10_240, 10**6) == pytest.approx(6e-4, rel=1e-3)  # cyclic: up again
    assert learning_rate(m, 0, 0, 1) == 1e-3
    assert learning_rate(m, 100_000, 0, 1) == pytest.approx((1e-3 - 1e-5) * 0.99999**100_000 + 1e-5)
    ours = default_recipe("transformer", "rings")
    assert learning_rate(ours, 0, 0, 1) == pytest.approx(ours.lr / ours.warmup)
    assert learning_rate(ours, ours.steps, 0, 1) == pytest.approx(ours.lr_end)
