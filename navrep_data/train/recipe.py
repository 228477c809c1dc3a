"""What a world-model training consists of: one frozen dataclass, stored as JSON in recipes and in every checkpoint."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError, did_you_mean, real_number, whole_number
from navrep_data.io import read_json
from navrep_data.models.config import ACTION_ALIGNMENTS, LIDARS
from navrep_data.train.passes import PRECISIONS

MODELS = ("v", "m", "joint", "transformer")
SCHEDULES = ("constant", "cosine", "tokens", "exponential")
RECONSTRUCTIONS = ("cross_entropy", "squared", "squared_sum")
DECAYS = ("matrices", "authors", "none")
_MAX_RECIPE_BYTES = 1 << 16
_LIMITS: dict[str, tuple[float, float]] = {
    "steps": (1, 10**9),
    "batch": (1, 4096),
    "micro_batch": (1, 4096),
    "window": (1, 1000),
    "stride": (1, 1000),
    "lr": (0.0, 1.0),
    "lr_end": (0.0, 1.0),
    "warmup": (0, 10**9),
    "weight_decay": (0.0, 1.0),
    "beta1": (0.0, 0.9999),
    "beta2": (0.0, 0.99999),
    "clip_norm": (0.0, 1e6),
    "clip_value": (0.0, 1e6),
    "kl_weight": (0.0, 100.0),
    "kl_floor": (0.0, 1e6),
    "kl_warmup": (0, 10**9),
    "epsilon": (1e-16, 1.0),
    "goal_scale": (0.01, 1000.0),
    "dropout": (0.0, 0.9),
    "reconstruct_share": (0.01, 1.0),
    "predict_share": (0.01, 1.0),
    "dream_share": (0.0, 1.0),
    "restart_factor": (0.0, 1000.0),
    "ranges_weight": (0.0, 100.0),
    "people_weight": (0.0, 100.0),
    "seed": (0, 2**31 - 1),
    "z_size": (1, 512),
    "h_size": (1, 4096),
    "n_blocks": (1, 32),
    "validate_every": (1, 10**9),
    "validate_batches": (1, 10**6),
    "save_every": (1, 10**9),
    "picture_every": (1, 10**9),
}


@dataclass(frozen=True)
class Recipe:
    """Settings of one training of a V, an M or a whole world model.

    Attributes
    ----------
    model : str
        ``"v"``, ``"m"``, ``"joint"`` or ``"transformer"``.
    lidar : str
        ``"rings"`` or ``"1d"``.
    original : bool
        Whether these are the authors' settings; then what cannot be a number follows them too: windows across
        episodes with frames blanked where an episode ends, random LSTM states, no choice of the best weights.
    z_size, h_size, n_blocks : int
        Numbers of z, cells of the LSTM (m and joint), blocks of the transformer.
    action_alignment : str
        Which action a row is fed: ``"taken"`` (chosen at it, so that the next frame's cause is known) or
        ``"leading"`` (led to it, as the authors').
    residual : bool
        Joint and transformer predict changes of z and goal.
    steps : int
        Optimiser steps.
    batch : int
        Windows per step (frames for v).
    micro_batch : int
        Windows (frames) per forward and backward pass; their gradients are summed up to those of the batch.
    window, stride : int
        Rows per window that are predicted from, and between the starts of two.
    lr, lr_end : float
        Learning rate, and where it ends.
    schedule : str
        ``"cosine"`` over all steps; ``"tokens"``: the authors' cosine over 200 epochs of rows, at least a tenth, going
        up again afterwards; ``"exponential"``: the authors' of M; ``"constant"``.
    warmup : int
        Steps (rows for ``"tokens"``) of a linear rise.
    weight_decay : float
        AdamW's; 0 = Adam.
    decay : str
        What decays: ``"matrices"`` (weights of linear layers and convolutions), ``"authors"`` (all but biases, so
        normalisations and positions too), ``"none"``.
    beta1, beta2, epsilon : float
        Adam's.
    clip_norm, clip_value : float
        Limit of the global gradient norm, and of each gradient; 0 = none.
    reconstruction : str
        ``"cross_entropy"`` or ``"squared"``, means over cells or rays; ``"squared_sum"``: sum over them.
    kl_weight, kl_floor : float
        Weight of the KL divergence and the value below which it costs no more. In ``squared_sum`` a sum over latents
        per frame, else a mean over latents.
    kl_warmup : int
        Steps over which the weight rises from 0.
    goal_scale : float
        Length [m] that goal errors are divided by before they are squared.
    dropout : float
        In the memories of joint and transformer.
    reconstruct_share, predict_share : float
        Share of the rows, drawn anew every step, whose reconstruction and prediction are decoded and compared.
    dream_share : float
        All but v: share of the rows of every second window, drawn anew every step, that the memory is fed
        as it expected them itself instead of as they were, so that dreams stay with what it knows. 0 = none.
    freeze_v : bool
        Joint and transformer: V stays as ``--init`` gives it, so that controllers that see through it stay valid; only
        the memory learns.
    restart_factor : float
        M: weight, in the restart loss, of rows whose next row is an episode's last.
    ranges_weight, people_weight : float
        v, joint and transformer: weights of the errors of a linear head on z, thrown away afterwards, that says how
        near things and people are; see ``navrep_data.train.cues``. 0 = not asked; people are only asked for where
        the dataset has a `humans` column.
    precision : str
        ``"bfloat16"`` or ``"float32"``, of V's passes; weights, memory and losses are float32.
    seed : int
        Same seed, data, recipe, machine and number of threads: same losses.
    validate_every, validate_batches, save_every, picture_every : int
        Steps between validations, batches of each, steps between checkpoints and between pictures.
    """

    model: str
    lidar: str
    original: bool = False
    z_size: int = 64
    h_size: int = 64
    n_blocks: int = 8
    action_alignment: str = "taken"
    residual: bool = True
    steps: int = 20_000
    batch: int = 32
    micro_batch: int = 8
    window: int = 32
    stride: int = 32
    lr: float = 1e-3
    lr_end: float = 1e-5
    schedule: str = "cosine"
    warmup: int = 300
    weight_decay: float = 0.01
    decay: str = "matrices"
    beta1: float = 0.9
    beta2: float = 0.95
    epsilon: float = 1e-8
    clip_norm: float = 1.0
    clip_value: float = 0.0
    reconstruction: str = "cross_entropy"
    kl_weight: float = 1e-4
    kl_floor: float = 0.0
    kl_warmup: int = 1000
    goal_scale: float = 5.0
    dropout: float = 0.0
    reconstruct_share: float = 0.25
    predict_share: float = 0.5
    dream_share: float = 0.0
    freeze_v: bool = False
    restart_factor: float = 10.0
    ranges_weight: float = 0.05
    people_weight: float = 0.1
    precision: str = "bfloat16"
    seed: int = 0
    validate_every: int = 1000
    validate_batches: int = 20
    save_every: int = 1000
    picture_every: int = 1000

    def __post_init__(self) -> None:
        """Check every field."""
        choices = {
            "model": MODELS,
            "lidar": LIDARS,
            "action_alignment": ACTION_ALIGNMENTS,
            "schedule": SCHEDULES,
            "reconstruction": RECONSTRUCTIONS,
            "decay": DECAYS,
            "precision": tuple(PRECISIONS),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ConfigError(f"{name} is {str(getattr(self, name))!r}, expected one of: {', '.join(allowed)}.")
        for field in dataclasses.fields(self):
            value: Any = getattr(self, field.name)
            if field.type in ("bool", "str"):
                if type(value).__name__ != field.type:
                    raise ConfigError(f"{field.name} of a recipe is {str(value)!r}, expected {field.type}.")
                continue
            number = whole_number(value) if field.type == "int" else real_number(value)
            low, high = _LIMITS.get(field.name, (-math.inf, math.inf))
            if number is None or not low <= number <= high:
                raise ConfigError(f"{field.name} of a recipe is {value!r}, expected {field.type}, {low:g} to {high:g}.")
            object.__setattr__(self, field.name, number)

        if self.freeze_v and self.model not in ("joint", "transformer"):
            raise ConfigError(
                f"freeze_v is for joint and transformer, this is a recipe for {self.model}: leave it out."
            )

    def replace(self, **changes: Any) -> Recipe:
        """Return a copy with some fields changed; None means unchanged."""
        return dataclasses.replace(self, **{name: value for name, value in changes.items() if value is not None})

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Any) -> Recipe:
        """Make a recipe from JSON values.

        Raises
        ------
        ConfigError
            If a field is missing, unknown or has a value that cannot be used.
        """
        if not isinstance(values, dict) or "model" not in values or "lidar" not in values:
            raise ConfigError("A recipe is a JSON object with at least model and lidar.")
        known = [field.name for field in dataclasses.fields(cls)]
        for name in values:
            if name not in known:
                raise ConfigError(
                    f"A recipe has no setting {str(name)!r}.{did_you_mean(str(name), known)} Known: {', '.join(known)}."
                )
        return cls(**values)


def default_recipe(model: str, lidar: str) -> Recipe:
    """Return the settings that we find better than the authors'; see docs/training.md for what shows it."""
    if model == "m":
        return Recipe(
            model, lidar, h_size=512, batch=64, micro_batch=64, window=64, stride=64, kl_weight=0.0, goal_scale=25.0,
            dream_share=0.5, ranges_weight=0.0, people_weight=0.0,
        )  # fmt: skip
    recipe = Recipe(model, lidar, dream_share=0.0 if model == "v" else 0.5)
    if lidar == "1d":  # squared errors of ranges are a hundredth of the cross entropy of cells
        recipe = recipe.replace(
            reconstruction="squared", kl_weight=1e-5, ranges_weight=0.001, people_weight=0.003
        )  # fmt: skip
    if model == "joint":  # whose LSTM holds two numbers for each of z
        return recipe.replace(h_size=2 * recipe.z_size)
    if model == "v":
        return recipe.replace(batch=256, micro_batch=256, window=1, stride=1, reconstruct_share=1.0)
    return recipe


def original_recipe(model: str, lidar: str) -> Recipe:
    """Return the authors' settings.

    Notes
    -----
    Read from the original's training scripts (train_vae.py, train_rnn.py, train_gpt.py and the like). Not repeated:
    one sequence in ten of the training set simulated anew per epoch, and saving only every twentieth epoch.
    """
    steps = 222_222
    common: dict[str, Any] = {
        "original": True, "action_alignment": "leading", "residual": False, "steps": steps, "precision": "float32",
        "reconstruct_share": 1.0, "predict_share": 1.0, "kl_warmup": 0, "seed": 42, "goal_scale": 25.0,
        "ranges_weight": 0.0, "people_weight": 0.0,
    }  # fmt: skip
    if model == "v":
        # Adam as TensorFlow has it; KL per frame floored at half a nat per latent
        return Recipe(
            model, lidar, z_size=32, batch=100, micro_batch=100, window=1, stride=1, lr=1e-4, schedule="constant",
            warmup=0, weight_decay=0.0, decay="none", beta2=0.999, clip_norm=0.0, reconstruction="squared_sum",
            kl_weight=1.0, kl_floor=16.0, **common,
        )  # fmt: skip
    if model == "m":
        return Recipe(
            model, lidar, z_size=32, h_size=512, batch=32, micro_batch=32, window=1000, stride=1000, lr=1e-3,
            lr_end=1e-5, schedule="exponential", warmup=0, weight_decay=0.0, decay="none", beta2=0.999, clip_norm=0.0,
            clip_value=1.0, kl_weight=0.0, **common,
        )  # fmt: skip
    # vae1dlstm.py alone trains on 64 rows
    window = 64 if (model, lidar) == ("joint", "1d") else 32
    return Recipe(
        model, lidar, z_size=64 if model == "transformer" else 32, batch=128, micro_batch=128, window=window,
        stride=window + 1, lr=6e-4, lr_end=6e-5, schedule="tokens", warmup=10_240, weight_decay=0.1, decay="authors",
        beta2=0.95, clip_norm=1.0, reconstruction="cross_entropy" if lidar == "rings" else "squared", kl_weight=1e-3,
        kl_floor=0.5, dropout=0.1, **common,
    )  # fmt: skip


def shipped_recipes() -> dict[str, dict[str, Any]]:
    """Return the recipes that the package holds, by name: command lines, seeds and settings."""
    folder = resources.files("navrep_data.train") / "recipes"
    files = [f for f in folder.iterdir() if f.name.endswith(".json")]
    return {f.name.removesuffix(".json"): json.loads(f.read_bytes()) for f in sorted(files, key=lambda f: f.name)}


def read_recipe(path: Path | str, model: str | None = None) -> Recipe:
    """Read the settings of a recipe file: the object under ``settings``, or the whole file.

    Parameters
    ----------
    path : path-like
        File.
    model : str, optional
        Which part of a modular recipe: ``"v"`` or ``"m"``.

    Raises
    ------
    ConfigError
        If it is not a recipe.
    """
    found = read_json(path, _MAX_RECIPE_BYTES)
    if isinstance(found, dict) and "settings" in found:
        found = found["settings"]
    if isinstance(found, dict) and set(found) == {"v", "m"}:
        if model not in found:
            raise ConfigError(f"{path} is a recipe for V and M, expected one for {model or 'one model'}.")
        found = found[model]
    return Recipe.from_dict(found)
