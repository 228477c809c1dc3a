"""Optimisers and learning-rate schedules."""

from __future__ import annotations

import math

import torch
from torch import nn

from navrep_data.train.recipe import Recipe

# minGPT's schedule as the authors use it: final_tokens = 200 epochs, never below a tenth
_EPOCHS_OF_TOKENS = 200
_LEAST_SHARE = 0.1
_M_DECAY = 0.99999
_MATRIX_LAYERS = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d, nn.LSTM)


def decaying(model: nn.Module, rule: str) -> set[str]:
    """Return the names of the parameters that weight decay applies to."""
    names = dict(model.named_parameters())
    if rule == "none":
        return set()
    if rule == "authors":  # everything whose name does not contain "bias" (nor a literal that no name contains)
        return {name for name in names if "bias" not in name}
    found = set()
    for prefix, module in model.named_modules():
        if isinstance(module, _MATRIX_LAYERS):
            found |= {f"{prefix}.{n}".lstrip(".") for n, p in module.named_parameters(recurse=False) if "bias" not in n}
    return found


def make_optimizer(model: nn.Module, recipe: Recipe) -> torch.optim.Optimizer:
    """Return AdamW, or Adam where nothing decays, with the recipe's groups."""
    names = {name: p for name, p in model.named_parameters() if p.requires_grad}
    decay = decaying(model, recipe.decay) if recipe.weight_decay > 0 else set()
    groups = [
        {"params": [p for n, p in names.items() if n in decay], "weight_decay": recipe.weight_decay},
        {"params": [p for n, p in names.items() if n not in decay], "weight_decay": 0.0},
    ]
    # one pass over the weights: a seventh of the time, which is a twentieth of a step of 8 windows of rings
    return torch.optim.AdamW(
        [g for g in groups if g["params"]], lr=recipe.lr, betas=(recipe.beta1, recipe.beta2), eps=recipe.epsilon,
        fused=True,
    )  # fmt: skip


def learning_rate(recipe: Recipe, step: int, tokens: int, epoch_tokens: int) -> float:
    """Return the learning rate of a step.

    Parameters
    ----------
    recipe : Recipe
        Settings.
    step : int
        Steps done before.
    tokens : int
        Rows of the windows of the steps before.
    epoch_tokens : int
        Rows of the windows of an epoch.
    """
    if recipe.schedule == "constant":
        return recipe.lr
    if recipe.schedule == "exponential":
        return (recipe.lr - recipe.lr_end) * _M_DECAY**step + recipe.lr_end
    if recipe.schedule == "tokens":
        if step == 0:  # the authors set the rate after each step, so the first one runs at full rate
            return recipe.lr
        if tokens < recipe.warmup:
            return recipe.lr * tokens / max(1, recipe.warmup)
        final = _EPOCHS_OF_TOKENS * epoch_tokens
        progress = (tokens - recipe.warmup) / max(1, final - recipe.warmup)
        return recipe.lr * max(_LEAST_SHARE, 0.5 * (1.0 + math.cos(math.pi * progress)))
    if step < recipe.warmup:
        return recipe.lr * (step + 1) / recipe.warmup
    progress = min(1.0, (step - recipe.warmup) / max(1, recipe.steps - recipe.warmup))
    return recipe.lr_end + (recipe.lr - recipe.lr_end) * 0.5 * (1.0 + math.cos(math.pi * progress))


def clip(model: nn.Module, recipe: Recipe) -> float:
    """Limit the gradients as the recipe says; returns their global norm before."""
    parameters = [p for p in model.parameters() if p.grad is not None]
    norm = nn.utils.clip_grad_norm_(parameters, recipe.clip_norm if recipe.clip_norm > 0 else math.inf)
    if recipe.clip_value > 0:
        nn.utils.clip_grad_value_(parameters, recipe.clip_value)
    return float(norm)
