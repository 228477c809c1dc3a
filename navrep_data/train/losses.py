"""Losses: what V, M, the joint model and the transformer are trained on.

Every function returns sums over rows of a part of a batch, so that parts of different sizes add up to the loss of the
whole batch once they are divided by its number of rows.

Notes
-----
Paper section II-D; MODEL_FACTS 2 to 5 for what the released software computes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from navrep_data.models import MDNRNN, VAE, Mixture, Noise
from navrep_data.models.modular import GOAL_SIZE
from navrep_data.models.noise import sample
from navrep_data.models.world_model import LSTMState, WorldModel
from navrep_data.schema import RANGE_MAX
from navrep_data.train import passes
from navrep_data.train.cues import Cues
from navrep_data.train.recipe import Recipe

_LOG_ROOT_TWO_PI = 0.5 * math.log(2.0 * math.pi)
_DREAMING_WINDOWS = 0.5
# Rows that were expected from rows that were expected from rows ...: so long are the dreams that are learned from.
_DREAM_PASSES = 3


@dataclass
class Counts:
    """Rows of a whole batch that the sums of its parts are divided by.

    Attributes
    ----------
    rows, targets : float
        Rows with an observation, and those whose next row is known.
    reconstructed, predicted : float
        Rows of them that are decoded.
    """

    rows: float
    targets: float
    reconstructed: float
    predicted: float


@dataclass
class Terms:
    """Summands of a loss, already divided by the batch's counts.

    Attributes
    ----------
    total : Tensor of shape ()
        What is differentiated.
    parts : dict of str to float
        The summands before their weights, for logs.
    """

    total: Tensor
    parts: dict[str, float] = field(default_factory=dict)


def observation_loss(logits: Tensor, target: Tensor, kind: str) -> Tensor:
    """Return the loss per row of decoded observations (N, ...) before the sigmoid; see :class:`Recipe`."""
    if kind == "cross_entropy":
        return functional.binary_cross_entropy_with_logits(logits, target, reduction="none").flatten(1).mean(1)
    squared = (torch.sigmoid(logits) - target).square().flatten(1)
    return squared.sum(1) if kind == "squared_sum" else squared.mean(1)


def divergence(mu: Tensor, logvar: Tensor, recipe: Recipe) -> Tensor:
    """Return the KL divergence from the standard normal per row (N,): a sum over latents for ``squared_sum``."""
    each = -0.5 * (1.0 + logvar - mu.square() - logvar.exp())
    return each.sum(-1) if recipe.reconstruction == "squared_sum" else each.mean(-1)


def kl_weight(recipe: Recipe, step: int) -> float:
    """Return the KL weight of a step."""
    return recipe.kl_weight * min(1.0, (step + 1) / recipe.kl_warmup) if recipe.kl_warmup else recipe.kl_weight


def cue_loss(
    cues: Cues | None, mu: Tensor, batch: dict[str, Tensor], recipe: Recipe, counts: Counts
) -> tuple[Tensor, dict[str, float]]:
    """Return the weighted cost of cues over the rows of a part of a batch, and its summands."""
    if cues is None:
        return mu.new_zeros(()), {}
    ranges, people = (each.sum() / counts.rows for each in cues.errors(mu, batch["obs"], batch.get("humans")))
    cost = recipe.ranges_weight * ranges + recipe.people_weight * people
    return cost, {"cue_ranges": float(ranges.detach()), "cue_people": float(people.detach())}


def vae_loss(
    vae: VAE, batch: dict[str, Tensor], recipe: Recipe, step: int, noise: Noise | None, counts: Counts,
    cues: Cues | None = None,
) -> Terms:  # fmt: skip
    """Return V's loss on a part of a batch: `obs` (N, ...), and `humans` where people are asked for."""
    obs = batch["obs"]
    dtype = passes.PRECISIONS[recipe.precision]
    mu, logvar = passes.distribution(vae, obs, dtype)
    logits = passes.decode_logits(vae, sample(mu, logvar, noise), dtype)
    rec = observation_loss(logits, obs, recipe.reconstruction).sum() / counts.rows
    kl = divergence(mu, logvar, recipe)
    if recipe.original:  # floored per frame
        kl = kl.clamp_min(recipe.kl_floor)
    kl = kl.sum() / counts.rows
    asked, found = cue_loss(cues, mu, batch, recipe, counts)
    parts = {"rec": float(rec.detach()), "kl": float(kl.detach()), **found}
    return Terms(rec + kl_weight(recipe, step) * kl + asked, parts)


def world_model_loss(
    model: WorldModel,
    batch: dict[str, Tensor],
    recipe: Recipe,
    step: int,
    noise: Noise | None,
    counts: Counts,
    cues: Cues | None = None,
) -> Terms:
    """Return the loss of a joint model or a transformer on a part of a batch.

    Parameters
    ----------
    model : WorldModel
        Joint or transformer.
    batch : dict
        From :mod:`navrep_data.train.data`: `obs` and `next_obs` (N, ...) of the real rows only, `mask` and
        `next_mask` (B, T), `goal`, `next_goal` (B, T, 2) [m], `goal_mask` (B, T), `action` (B, T, 3), and what is
        decoded: `reconstruct`, `predict` (B, T), bool.
    recipe : Recipe
        Settings.
    step : int
        Steps done before.
    noise : Noise or None
        Samples z, and drops out; None = validation.
    counts : Counts
        Of the whole batch.
    cues : Cues, optional
        Head that z is asked through; `batch` then has `humans` of the real rows where people are asked for.
    """
    dtype = passes.PRECISIONS[recipe.precision]
    mask, next_mask = batch["mask"], batch["next_mask"]
    mu_rows, logvar_rows = passes.distribution(model.vae, batch["obs"], dtype)
    z_rows = sample(mu_rows, logvar_rows, noise)
    z = z_rows.new_zeros(*mask.shape, z_rows.shape[-1])
    z[mask] = z_rows
    state = None if recipe.original and noise is not None else _zero_state(model, z)
    memory_noise = None if noise is None else Noise(noise.generator, recipe.dropout)
    fed_z, fed_goal = z, batch["goal"]
    if noise is not None and recipe.dream_share > 0.0:
        expected = _expects(model, batch)
        fed_z, fed_goal = partly_dreamt(z, batch["goal"], mask, expected, recipe.dream_share, noise)
    h, _ = model.hidden(fed_z, fed_goal, batch["action"], memory_noise, state)
    next_z, next_goal = model.heads(fed_z, fed_goal, h)
    rec_at, pred_at = mask & batch["reconstruct"], next_mask & batch["predict"]
    logits = passes.decode_logits(model.vae, torch.cat([z[rec_at], next_z[pred_at]]), dtype)
    wanted = torch.cat([batch["obs"][rec_at[mask]], batch["next_obs"][pred_at[next_mask]]])
    losses = observation_loss(logits, wanted, recipe.reconstruction)
    n_rec = int(rec_at.sum())
    rec = losses[:n_rec].sum() / max(1.0, counts.reconstructed)
    pred = losses[n_rec:].sum() / max(1.0, counts.predicted)
    kl = divergence(mu_rows, logvar_rows, recipe).sum() / counts.rows
    kl_cost = kl.clamp_min(recipe.kl_floor * mask.sum() / counts.rows) if recipe.kl_floor > 0 else kl
    error = (next_goal - batch["next_goal"])[batch["goal_mask"]].square().mean(-1).sum()
    goal = error / max(1.0, counts.targets) / recipe.goal_scale**2
    parts = {"rec": rec, "pred": pred, "kl": kl, "goal": goal}
    asked, found = cue_loss(cues, mu_rows, batch, recipe, counts)
    total = rec + pred + goal + kl_weight(recipe, step) * kl_cost + asked
    return Terms(total, {**{name: float(value.detach()) for name, value in parts.items()}, **found})


class Expects(Protocol):
    """What a memory expects of the next rows of the chosen windows: z (W, T, Z) and goal (W, T, 2) [m]."""

    def __call__(self, windows: Tensor, z: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Feed it z (W, T, Z) and goal (W, T, 2) [m] of the windows with these indices (W,)."""


def partly_dreamt(
    z: Tensor, real_goal: Tensor, may: Tensor, expects: Expects, share: float, noise: Noise
) -> tuple[Tensor, Tensor]:
    """Return z and goals whose rows are partly what the memory itself expected of them.

    A dream is fed its own predictions: a memory that has only seen real rows drifts away from them within a few steps.
    The other half of the windows stays real, so that what follows real rows is learned as before.

    Parameters
    ----------
    z, real_goal : Tensor of shape (B, T, Z), (B, T, 2) [m]
        Real rows.
    may : Tensor of shape (B, T)
        Rows that follow the row before them; the first of a window never does.
    expects : callable
        The memory.
    share : float
        Share of those rows that are dreamt, in windows that dream.
    noise : Noise
        Draws them.
    """
    draw = torch.rand(may.shape[0], may.shape[1] + 1, generator=noise.generator, device=z.device)
    windows = torch.nonzero(draw[:, 0] < _DREAMING_WINDOWS).squeeze(1)
    if len(windows) == 0:
        return z, real_goal
    chosen = (may & (draw[:, 1:] < share))[windows][..., None]
    chosen[:, 0] = False
    with torch.no_grad():
        awake, goal = z[windows], real_goal[windows]
        fed_z, fed_goal = awake, goal
        for _ in range(_DREAM_PASSES):
            before = [torch.cat([x[:, :1], x[:, :-1]], 1) for x in expects(windows, fed_z, fed_goal)]
            fed_z, fed_goal = torch.where(chosen, before[0], awake), torch.where(chosen, before[1], goal)
    dreamt = torch.where(chosen, fed_z, z[windows])
    return z.index_copy(0, windows, dreamt), real_goal.index_copy(0, windows, fed_goal)


def _expects(model: WorldModel, batch: dict[str, Tensor]) -> Expects:
    def expects(windows: Tensor, z: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        h, _ = model.hidden(z, goal, batch["action"][windows], None, _zero_state(model, z))
        return model.heads(z, goal, h)

    return expects


def _zero_state(model: WorldModel, z: Tensor) -> LSTMState | None:
    """Return an LSTM state of zeros, so that noise does not draw a random one; transformers have none."""
    layers = getattr(model.config, "n_layers", None)
    if layers is None:
        return None
    zero = z.new_zeros(layers, len(z), model.h_size)
    return zero, zero


# --- M --------------------------------------------------------------------------------------------------------------


def mixture_nll(mixture: Mixture, change: Tensor) -> Tensor:
    """Return the negative log-likelihood of changes (..., D), per number."""
    x = (change[..., None] - mixture.mean) * torch.exp(-mixture.logstd)
    each = mixture.logmix - 0.5 * x.square() - mixture.logstd - _LOG_ROOT_TWO_PI
    return -torch.logsumexp(each, dim=-1)


def restart_loss(logit: Tensor, target: Tensor, factor: float) -> Tensor:
    """Return the cross entropy of restart flags, rows with a restart weighted by `factor`."""
    loss = functional.binary_cross_entropy_with_logits(logit, target, reduction="none")
    return loss * (1.0 + target * (factor - 1.0))


def memory_loss(
    memory: MDNRNN,
    batch: dict[str, Tensor],
    recipe: Recipe,
    state: LSTMState | None = None,
    noise: Noise | None = None,
) -> tuple[Terms, LSTMState]:
    """Return M's loss on a batch of code sequences, and the LSTM states at their ends.

    Parameters
    ----------
    memory : MDNRNN
        M.
    batch : dict
        `z`, `next_z` (B, T, Z), `goal`, `next_goal` (B, T, 2) [m], `action` (B, T, 3), `restart`, `next_last` (B, T),
        `next_mask` (B, T), and `goal_mask` (B, T), where both goals are known: elsewhere only z counts.
    recipe : Recipe
        Settings.
    state : pair of Tensor, optional
        LSTM states (1, B, H) before the first rows, to which a restart brings them back; zero if left out.
    noise : Noise, optional
        Draws the rows that are dreamt; None = validation, or no dreams.
    """
    z, goal, restarts = batch["z"], batch["goal"], batch["restart"]
    if noise is not None and recipe.dream_share > 0.0:
        may = batch["mask"] & ~restarts.bool()
        z, goal = partly_dreamt(z, goal, may, _memory_expects(memory, batch), recipe.dream_share, noise)
    inputs = memory.inputs(z, goal, batch["action"], restarts)
    h, after = run_with_restarts(memory, inputs, batch["restart"], batch["mask"], state)
    mixture = memory.mixture(h)
    change = torch.cat([batch["next_z"] - z, (batch["next_goal"] - goal) / RANGE_MAX], dim=-1)
    where = batch["next_mask"].to(h.dtype)
    n = where.sum().clamp_min(1.0)
    with_goal = batch["goal_mask"].to(h.dtype)
    each = mixture_nll(mixture, change)
    of_goal = each[..., -GOAL_SIZE:].sum(-1) * with_goal
    each = (each[..., :-GOAL_SIZE].sum(-1) + of_goal) / (each.shape[-1] - GOAL_SIZE + GOAL_SIZE * with_goal)
    nll = (each * where).sum() / n
    restart = restart_loss(mixture.restart_logit, batch["next_last"].to(h.dtype), recipe.restart_factor)
    restart = (restart * where).sum() / n
    error = (mixture.expected() - change).detach()
    parts = {
        "nll": nll,
        "restart": restart,
        "z_error": (error[..., :-GOAL_SIZE].square().mean(-1) * where).sum() / n,
        "goal_error_m2": (error[..., -GOAL_SIZE:].square().mean(-1) * with_goal).sum()
        / with_goal.sum().clamp_min(1.0)
        * RANGE_MAX**2,
    }
    return Terms(nll + restart, {name: float(value.detach()) for name, value in parts.items()}), after


def _memory_expects(memory: MDNRNN, batch: dict[str, Tensor]) -> Expects:
    def expects(windows: Tensor, z: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        restart = batch["restart"][windows]
        inputs = memory.inputs(z, goal, batch["action"][windows], restart)
        h, _ = run_with_restarts(memory, inputs, restart, batch["mask"][windows], None)
        change = memory.mixture(h).expected()  # the mean, which is what errors ask for
        return z + change[..., :-GOAL_SIZE], goal + change[..., -GOAL_SIZE:] * RANGE_MAX

    return expects


def run_with_restarts(
    memory: MDNRNN, inputs: Tensor, restart: Tensor, mask: Tensor, state: LSTMState | None
) -> tuple[Tensor, LSTMState]:
    """Run the LSTM over sequences (B, T, N) whose state goes back to `state` wherever `restart` (B, T) is set.

    Notes
    -----
    The stretches between restarts are independent, so they run side by side as one packed batch. The released
    software's "zero" state is the state that it was fed (MODEL_FACTS 3); so it is here.
    """
    batch, length = restart.shape
    real = mask.sum(1)
    first = restart.bool() & mask
    first[:, 0] = True
    row, start = torch.nonzero(first, as_tuple=True)
    stop = torch.full_like(start, 0)
    same = torch.cat([row[1:] == row[:-1], row.new_zeros(1, dtype=torch.bool)])
    stop[:-1] = start[1:]
    stop = torch.where(same, stop, real[row])
    size = (stop - start).clamp_min(1)
    longest = int(size.max())
    at = (start[:, None] + torch.arange(longest, device=start.device)).clamp_max(length - 1)
    pieces = inputs[row[:, None], at]
    n_hidden = memory.config.h_size
    zero = inputs.new_zeros(1, batch, n_hidden)
    h0, c0 = (zero, zero) if state is None else state
    packed = nn_pack(pieces, size)
    out, (h_end, c_end) = memory.lstm(packed, (h0[:, row], c0[:, row]))
    padded, _ = torch.nn.utils.rnn.pad_packed_sequence(out, batch_first=True, total_length=longest)
    h = inputs.new_zeros(batch, length, n_hidden)
    inside = torch.arange(longest, device=size.device) < size[:, None]
    h = h.index_put((row[:, None].expand_as(at)[inside], at[inside]), padded[inside])
    last = torch.cat([row[1:] != row[:-1], row.new_ones(1, dtype=torch.bool)])
    return h, (h_end[:, last].detach(), c_end[:, last].detach())


def nn_pack(pieces: Tensor, size: Tensor) -> torch.nn.utils.rnn.PackedSequence:
    """Pack pieces (P, T, N) of the given sizes, in any order."""
    return torch.nn.utils.rnn.pack_padded_sequence(pieces, size.cpu(), batch_first=True, enforce_sorted=False)
