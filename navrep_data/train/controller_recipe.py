"""What a controller training consists of: one frozen dataclass, stored as JSON with the controller."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from navrep_data.errors import ConfigError, check_whole, real_number
from navrep_data.models.controllers import LEAST_STD, MOST_STD
from navrep_data.sim import SimConfig, make_config
from navrep_data.train.settings import environment_of_settings
from navrep_data.zoo.policy import FEATURES

DEFAULT_ENV = "navrep-train"
VALIDATION_SEEDS = range(5000, 5100)
"""Episodes that selection looks at: never those of the test suite, 1000 to 1199."""
AUTHORS_SEEDS = range(1000, 1100)
AUTHORS_HELD_OUT = range(1100, 1200)
PRECISIONS = ("int8", "bfloat16", "float32")
_MOST = {"lr": 1.0, "gamma": 1.0, "gae_lambda": 1.0, "clip_range": 1.0}


@dataclass(frozen=True)
class ControllerRecipe:
    """Settings of one controller training.

    Attributes
    ----------
    features : str
        ``"z"``, ``"h"``, ``"zh"``, or ``"e2e"``.
    lidar : str
        ``"rings"`` or ``"1d"``.
    original : bool
        Whether these are the authors' settings; then the action is a clipped Gaussian without bounds,
        and selection looks at episodes 1000 to 1099.
    steps : int
        Steps of all worlds together.
    worlds, rollout : int
        Worlds, and steps of each between two updates.
    batch, epochs : int
        Rows per gradient step, passes over a rollout.
    lr : float
        Learning rate; falls linearly to a fiftieth unless original.
    gamma, gae_lambda, clip_range, entropy, value_weight, max_grad_norm : float
        PPO's.
    target_kl : float
        An update stops where the policy moved farther; 0 = never.
    least_std : float
        Width of the action's distribution that stays at least, so that ways out of dead ends are tried to the end.
    hidden : int
        Units per layer.
    max_speed : float
        Longest velocity commanded [m/s]; 0 = no limit beyond [-1, 1] on each axis.
    env : str
        Environment to train in.
    physics : str
        Of the training worlds.
    sim : dict
        Other settings of the training worlds, as ``navrep_data.train.settings.sim_settings`` names them. Without
        any in ``navrep-train``, validation plays navrep-test in original physics, as the benchmark; otherwise the
        environment itself, with a constant curriculum.
    reward_scale : float
        Factor on rewards.
    progress : float
        Further reward, before the factor, per metre that a step brings the robot nearer to its goal: without it
        standing still is what early training learns, since driving ends in collisions.
    timeouts_end : bool
        Whether nothing is expected after a timeout, as in the authors' software, so that waiting for one is a loss;
        otherwise timeouts are truncations.
    easy_start : bool
        Whether worlds start without humans and obstacles, for the curriculum to add; the authors' start with most.
    precision : str
        Of the frozen encoder during training: ``"int8"`` (where the processor cannot: as ``"bfloat16"``),
        ``"bfloat16"`` or ``"float32"``. Of the convolutions in ``"e2e"``, which learn. Validation is in float32.
    context : str
        What a joint or transformer memory keeps.
    refit : bool
        ``--init`` names a controller that sees through another V: fit its first layers to the codes of this one first,
        by least squares; see ``navrep_data.train.refit``. For ``"z"``.
    validate_every : int
        Steps between validations, each with a checkpoint.
    seed : int
        Of worlds and weights.
    """

    features: str = "z"
    lidar: str = "rings"
    original: bool = False
    steps: int = 20_000_000
    worlds: int = 256
    rollout: int = 16
    batch: int = 512
    epochs: int = 3
    lr: float = 5e-4
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    entropy: float = 0.0
    value_weight: float = 0.5
    max_grad_norm: float = 0.5
    target_kl: float = 0.03
    least_std: float = LEAST_STD
    hidden: int = 128
    max_speed: float = 1.0
    physics: str = "consistent"
    reward_scale: float = 0.05
    progress: float = 5.0
    timeouts_end: bool = False
    easy_start: bool = True
    precision: str = "bfloat16"
    context: str = "newest-32"
    refit: bool = False
    validate_every: int = 100_000
    seed: int = 0
    # left out of to_dict at their defaults: recipes written before they came stay as they are
    env: str = DEFAULT_ENV
    sim: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check what the parts it is passed to do not check."""
        choices = {"features": (*FEATURES, "e2e"), "lidar": ("rings", "1d"), "precision": PRECISIONS}
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ConfigError(f"{name} is {str(getattr(self, name))!r}, expected one of: {', '.join(allowed)}.")
        for field in dataclasses.fields(self):
            value: Any = getattr(self, field.name)
            if field.type == "int":
                object.__setattr__(self, field.name, check_whole(field.name, value, 0 if field.name == "seed" else 1))
            if field.type == "bool" and type(value) is not bool:
                raise ConfigError(f"{field.name} is {value!r}, expected true or false.")
            most = _MOST.get(field.name, 1e6)
            if field.type == "float":
                number = real_number(value)
                if number is None or not 0 <= number <= most:
                    raise ConfigError(f"{field.name} is {value!r}, expected a number from 0 to {most:g}.")
                object.__setattr__(self, field.name, number)
        if self.refit and self.features != "z":
            raise ConfigError(f"refit is for controllers on z, this is a recipe for {self.features}: leave it out.")
        if not 0.0 < self.least_std <= MOST_STD:
            raise ConfigError(f"least_std is {self.least_std}, expected more than 0, and {MOST_STD} at most.")
        if self.worlds * self.rollout % self.batch:
            raise ConfigError(
                f"batch is {self.batch}, expected a divisor of worlds x rollout = {self.worlds * self.rollout}."
            )
        if environment(self).robots > 1:
            raise ConfigError(f"robots is {environment(self).robots}, expected 1: controllers drive one robot.")

    def replace(self, **changes: Any) -> ControllerRecipe:
        """Return a copy with some fields changed; None means unchanged."""
        return dataclasses.replace(self, **{name: value for name, value in changes.items() if value is not None})

    def fit_batch(self, **changes: Any) -> ControllerRecipe:
        """Return :meth:`replace`'s copy with a batch that divides its rollouts, no larger than before, unless given."""
        if changes.get("batch") is None:
            given = {n: v for n, v in changes.items() if n in ("worlds", "rollout") and type(v) is int and v > 0}
            rows = given.get("worlds", self.worlds) * given.get("rollout", self.rollout)
            changes["batch"] = next(rows // n for n in range(-(-rows // self.batch), rows + 1) if rows % n == 0)
        return self.replace(**changes)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain JSON values, environment and its settings only where they were chosen."""
        values = dataclasses.asdict(self)
        return {n: v for n, v in values.items() if n not in ("env", "sim") or v not in (DEFAULT_ENV, {})}


def default_controller_recipe(features: str, lidar: str) -> ControllerRecipe:
    """Return our settings; end to end with smaller steps, since its encoder learns at the same time."""
    if features == "e2e":
        return ControllerRecipe(features, lidar, lr=3e-4)
    return ControllerRecipe(features, lidar, precision="int8")


def original_controller_recipe(features: str, lidar: str, modular: bool = False) -> ControllerRecipe:
    """Return the authors' settings, as all their released runs have them (MODEL_FACTS 7)."""
    return ControllerRecipe(
        features, lidar, original=True, steps=100_000_000 if modular else 60_000_000, worlds=6, rollout=128, batch=192,
        epochs=4, lr=2.5e-4, entropy=0.01, target_kl=0.0, hidden=64, max_speed=0.0, physics="original",
        reward_scale=1.0, progress=0.0, timeouts_end=True, easy_start=False, precision="float32", context="oldest-32",
        validate_every=600_000,
    )  # fmt: skip


def environment(recipe: ControllerRecipe) -> SimConfig:
    """Return the training environment; in ``navrep-train`` each world adapts its own difficulty."""
    adaptive = {"curriculum": "adaptive"} if recipe.env == DEFAULT_ENV else {}
    return environment_of_settings(recipe.env, recipe.physics, {**adaptive, **recipe.sim})


def validation_environment(recipe: ControllerRecipe | None = None) -> SimConfig:
    """Return what validation plays, episodes by numpy seed: the test suite's environment, or the recipe's own."""
    if recipe is None or (recipe.env == DEFAULT_ENV and not recipe.sim):
        return make_config("navrep-test", physics="original")
    return environment(recipe).replace(curriculum="constant")
