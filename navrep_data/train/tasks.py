"""What differs between the models: how a batch becomes gradients, validation errors and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from navrep_data.models import MDNRNN, VAE, Noise
from navrep_data.models.noise import sample
from navrep_data.models.world_model import WorldModel
from navrep_data.train import passes
from navrep_data.train.cues import Cues
from navrep_data.train.data import Batch, part
from navrep_data.train.losses import Counts, Terms, memory_loss, observation_loss, vae_loss, world_model_loss
from navrep_data.train.recipe import Recipe

_PICTURED = 4
# Keeps the draws of noise, shares and validation apart.
_NOISE, _SHARES = 1, 2


def generator(recipe: Recipe, step: int, stream: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return the generator of one step's draws, a function of seed, step and stream alone."""
    seed = int(np.random.SeedSequence([recipe.seed, step, stream]).generate_state(1, np.uint64)[0] >> np.uint64(1))
    return torch.Generator(device).manual_seed(seed)


class Task(Protocol):
    """One model in training."""

    extra: dict[str, Tensor]

    def parts(self, batch: Batch, step: int) -> Iterator[Terms]:
        """Yield the losses of the batch's parts; their sum is that of the batch."""

    def validate(self, batch: Batch) -> tuple[dict[str, float], float]:
        """Return error sums over a batch without noise, and the rows that they are sums over."""

    def images(self, batch: Batch) -> dict[str, NDArray[Any]] | None:
        """Return what to draw of the first windows of a batch, or None."""


def _slices(n: int, size: int) -> Iterator[tuple[int, int]]:
    for first in range(0, n, size):
        yield first, min(n, first + size)


def _to(batch: Batch, device: torch.device) -> Batch:
    return batch if device.type == "cpu" else {name: value.to(device) for name, value in batch.items()}


def _cue_sums(cues: Cues, mu: Tensor, batch: Batch) -> dict[str, float]:
    ranges, people = cues.errors(mu, batch["obs"], batch.get("humans"))
    return {"cue_ranges": float(ranges.sum()), "cue_people": float(people.sum())}


class VAETask:
    """V."""

    def __init__(self, model: VAE, recipe: Recipe, device: torch.device, cues: Cues | None = None) -> None:
        self.model, self.recipe, self.device, self.cues = model, recipe, device, cues
        self.extra: dict[str, Tensor] = {}

    def parts(self, batch: Batch, step: int) -> Iterator[Terms]:
        """Yield the losses of the batch's parts; see :class:`Task`."""
        noise = Noise(generator(self.recipe, step, _NOISE, self.device), 0.0)
        n = len(batch["obs"])
        for first, stop in _slices(n, self.recipe.micro_batch):
            piece = {name: value[first:stop].to(self.device) for name, value in batch.items()}
            yield vae_loss(self.model, piece, self.recipe, step, noise, Counts(n, 0, n, 0), self.cues)

    @torch.no_grad()
    def validate(self, batch: Batch) -> tuple[dict[str, float], float]:
        """Return error sums; see :class:`Task`."""
        obs = batch["obs"].to(self.device)
        dtype = passes.PRECISIONS[self.recipe.precision]
        mu, _ = passes.distribution(self.model, obs, dtype)
        decoded = torch.sigmoid(passes.decode_logits(self.model, mu, dtype))
        error = float((decoded - obs).square().flatten(1).mean(1).sum())
        sums = {"rec_mse": error, "error": error}
        if self.cues is not None:
            sums |= _cue_sums(self.cues, mu, _to(batch, self.device))
        return sums, len(obs)

    @torch.no_grad()
    def images(self, batch: Batch) -> dict[str, NDArray[Any]]:
        """Return input and reconstruction; see :class:`Task`."""
        obs = batch["obs"][:_PICTURED].to(self.device)
        return {"input": obs.cpu().numpy(), "reconstruction": self.model.decode(self.model.encode(obs)).cpu().numpy()}


class WorldModelTask:
    """Joint model or transformer."""

    def __init__(self, model: WorldModel, recipe: Recipe, device: torch.device, cues: Cues | None = None) -> None:
        self.model, self.recipe, self.device, self.cues = model, recipe, device, cues
        self.extra: dict[str, Tensor] = {}

    def parts(self, batch: Batch, step: int) -> Iterator[Terms]:
        """Yield the losses of the batch's parts; see :class:`Task`."""
        recipe = self.recipe
        draw = generator(recipe, step, _SHARES)
        mask, next_mask = batch["mask"], batch["next_mask"]
        shares = torch.rand(2, *mask.shape, generator=draw)
        # rows that are decoded without loss of any kind would be waste where all are wanted
        batch = {
            **batch,
            "reconstruct": shares[0] < (0.0 if recipe.freeze_v else recipe.reconstruct_share),
            "predict": shares[1] < recipe.predict_share,
        }
        counts = Counts(
            float(mask.sum()),
            float(batch["goal_mask"].sum()),
            float((mask & batch["reconstruct"]).sum()),
            float((next_mask & batch["predict"]).sum()),
        )
        noise = Noise(generator(recipe, step, _NOISE, self.device), recipe.dropout)
        for first, stop in _slices(len(mask), recipe.micro_batch):
            piece = _to(part(batch, first, stop), self.device)
            yield world_model_loss(self.model, piece, recipe, step, noise, counts, self.cues)

    @torch.no_grad()
    def validate(self, batch: Batch) -> tuple[dict[str, float], float]:
        """Return error sums; see :class:`Task`. The error is that of the decoded next observation."""
        recipe, model = self.recipe, self.model
        dtype = passes.PRECISIONS[recipe.precision]
        sums = {"rec_mse": 0.0, "pred_mse": 0.0, "pred_loss": 0.0, "goal_mse_m2": 0.0, "error": 0.0}
        if self.cues is not None:
            sums |= {"cue_ranges": 0.0, "cue_people": 0.0}
        for first, stop in _slices(len(batch["mask"]), recipe.micro_batch):
            piece = _to(part(batch, first, stop), self.device)
            mask, next_mask = piece["mask"], piece["next_mask"]
            mu, _ = passes.distribution(model.vae, piece["obs"], dtype)
            z = mu.new_zeros(*mask.shape, mu.shape[-1])
            z[mask] = mu
            h, _ = model.hidden(z, piece["goal"], piece["action"])
            next_z, next_goal = model.heads(z, piece["goal"], h)
            # rows with a successor only, so that both errors are means over the same rows
            rec = passes.decode_logits(model.vae, z[next_mask], dtype)
            pred = passes.decode_logits(model.vae, next_z[next_mask], dtype)
            at = next_mask[mask]
            now = piece["obs"][at]
            if self.cues is not None:
                rows: Batch = {name: piece[name][at] for name in ("obs", "humans") if name in piece}
                for name, value in _cue_sums(self.cues, mu[at], rows).items():
                    sums[name] += value
            sums["rec_mse"] += float((torch.sigmoid(rec) - now).square().flatten(1).mean(1).sum())
            squared = (torch.sigmoid(pred) - piece["next_obs"]).square().flatten(1).mean(1)
            sums["pred_mse"] += float(squared.sum())
            sums["pred_loss"] += float(observation_loss(pred, piece["next_obs"], recipe.reconstruction).sum())
            goal_mask = piece["goal_mask"]
            known = float(goal_mask.sum())
            off = float((next_goal - piece["next_goal"])[goal_mask].square().mean(-1).sum())
            # rows whose goal is unknown count as the others' mean
            sums["goal_mse_m2"] += off * float(next_mask.sum()) / max(1.0, known)
        sums["error"] = sums["pred_mse"]
        return sums, float(batch["next_mask"].sum())

    @torch.no_grad()
    def images(self, batch: Batch) -> dict[str, NDArray[Any]]:
        """Return input, reconstruction, next frame and its prediction; see :class:`Task`."""
        chosen = torch.nonzero(batch["next_mask"].sum(1) == batch["next_mask"].sum(1).max()).flatten()[:_PICTURED]
        at = int(batch["next_mask"].sum(1).max()) - 1
        obs = batch["obs"][chosen, : at + 1].to(self.device)
        goal, action = (batch[name][chosen, : at + 1].to(self.device) for name in ("goal", "action"))
        out = self.model.forward(obs, goal, action)
        return {
            "input": obs[:, at].cpu().numpy(),
            "reconstruction": self.model.decode(out.z[:, at]).cpu().numpy(),
            "next": batch["next_obs"][chosen, at].numpy(),
            "prediction": self.model.decode(out.next_z[:, at]).cpu().numpy(),
        }


class MemoryTask:
    """M; its codes are drawn anew from mu and logvar every time they are seen."""

    def __init__(self, model: MDNRNN, recipe: Recipe, device: torch.device) -> None:
        self.model, self.recipe, self.device = model, recipe, device
        self.extra: dict[str, Tensor] = {}

    def _codes(self, batch: Batch, noise: Noise | None) -> Batch:
        z = sample(batch["mu"], batch["logvar"], noise)
        return {**batch, "z": z[:, :-1], "next_z": z[:, 1:]}

    def parts(self, batch: Batch, step: int) -> Iterator[Terms]:
        """Yield the loss of the whole batch; the authors' state is carried over from the batch before."""
        noise = Noise(generator(self.recipe, step, _NOISE, self.device), 0.0)
        codes = self._codes(_to(batch, self.device), noise)
        state = (self.extra["h"], self.extra["c"]) if self.recipe.original and "h" in self.extra else None
        terms, after = memory_loss(self.model, codes, self.recipe, state, noise)
        if self.recipe.original:
            self.extra = {"h": after[0], "c": after[1]}
        yield terms

    @torch.no_grad()
    def validate(self, batch: Batch) -> tuple[dict[str, float], float]:
        """Return error sums; see :class:`Task`. The error is the negative log-likelihood of the change of z."""
        codes = self._codes(_to(batch, self.device), None)
        terms, _ = memory_loss(self.model, codes, self.recipe)
        n = float(batch["next_mask"].sum())
        return {**{k: v * n for k, v in terms.parts.items()}, "error": terms.parts["nll"] * n}, n

    def images(self, batch: Batch) -> None:
        """M sees no lidar."""
        return


def make_task(model: nn.Module, recipe: Recipe, device: torch.device, cues: Cues | None = None) -> Task:
    """Return the task of a model, with the head for cues where the recipe asks for them."""
    if isinstance(model, VAE):
        return VAETask(model, recipe, device, cues)
    if isinstance(model, MDNRNN):
        return MemoryTask(model, recipe, device)
    assert isinstance(model, WorldModel)
    return WorldModelTask(model, recipe, device, cues)
