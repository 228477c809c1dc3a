"""Train controllers: PPO over a batch of worlds, encoded by a frozen V."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from navrep_data._version import __version__
from navrep_data.errors import CheckpointError, ConfigError, TrainingError
from navrep_data.io import atomic_write_json
from navrep_data.models import Controller, ControllerConfig, EndToEnd, EndToEndConfig, checkpoint
from navrep_data.models.world_model import WorldModel
from navrep_data.schema import ROBOT_STATE_SIZE, Event, SensorContract
from navrep_data.shards import writer_lock
from navrep_data.train import state
from navrep_data.train.controller_recipe import (
    AUTHORS_HELD_OUT,
    AUTHORS_SEEDS,
    VALIDATION_SEEDS,
    ControllerRecipe,
    environment,
    validation_environment,
)
from navrep_data.train.encode import vae_of, weights_hash
from navrep_data.train.logs import Logger, curve
from navrep_data.train.ppo_policy import BoundedPolicy
from navrep_data.train.worlds import TrainingWorlds, play
from navrep_data.zoo.local import PARTS, POLICY_FILE
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3 import EndToEndExtractor, put_weights, take_weights

_MAX_JSON = 1 << 20
_GOAL_COLUMNS = 2
_LEAST_RATE = 0.02


def make_network(recipe: ControllerRecipe, model: Any) -> Controller | EndToEnd:
    """Return a new controller for a recipe and a world model (or V).

    Raises
    ------
    ConfigError
        If the model lacks what the features need, or is for another lidar.
    """
    squash = "clip" if recipe.original else "tanh"
    if recipe.features == "e2e":
        return EndToEnd(EndToEndConfig(recipe.lidar, n_hidden=recipe.hidden, squash=squash, max_speed=recipe.max_speed))
    vae = vae_of(model, "The world model")
    if vae.config.lidar != recipe.lidar:
        raise ConfigError(f"The world model reads {vae.config.lidar}, expected {recipe.lidar}: set --lidar to match.")
    n = ROBOT_STATE_SIZE + (vae.config.z_size if "z" in recipe.features else 0)
    if "h" in recipe.features:
        if not isinstance(model, WorldModel):
            raise ConfigError(
                f"Features {recipe.features} need a memory, expected a world model, not a {type(model).__name__}: "
                "take --features z, or name a joint, transformer or modular model."
            )
        n += model.h_size
    network = Controller(ControllerConfig(n, recipe.hidden, squash, recipe.max_speed))
    if not recipe.original:
        _scale_inputs(network, vae.config.z_size if "z" in recipe.features else 0)
    return network


@torch.no_grad()
def _scale_inputs(network: Controller, n_before: int) -> None:
    """Start with small weights for the goal, which comes in metres, up to 18."""
    for perceptron in (network.pi, network.vf):
        first = perceptron[0]
        assert isinstance(first, nn.Linear)
        first.weight[:, n_before : n_before + _GOAL_COLUMNS] *= 0.1


def make_policy(recipe: ControllerRecipe, network: Controller | EndToEnd, model: Any, name: str = "") -> Policy:
    """Return the policy that a controller makes with its world model.

    Raises
    ------
    CheckpointError, ConfigError
        If they do not fit.
    """
    if recipe.features == "e2e":
        return Policy(network, None, recipe.lidar, name=name, dtype=recipe.precision)
    world_model = model if isinstance(model, WorldModel) and "h" in recipe.features else None
    context = None if world_model is None or world_model.default_context == "carried-state" else recipe.context
    return Policy(
        network, recipe.features, recipe.lidar, vae_of(model, name), world_model, name=name, context=context,
        dtype=recipe.precision,
    )  # fmt: skip


def make_ppo(recipe: ControllerRecipe, worlds: TrainingWorlds, network: Controller | EndToEnd, device: str) -> PPO:
    """Return the learner, with the network's weights."""
    kwargs: dict[str, Any] = {
        "net_arch": {"pi": [network.config.n_hidden] * 2, "vf": [network.config.n_hidden] * 2},
        "activation_fn": nn.Tanh,
        "optimizer_kwargs": {"eps": 1e-5},
    }
    if isinstance(network, EndToEnd):
        kwargs |= {
            "activation_fn": nn.ReLU,
            "features_extractor_class": EndToEndExtractor,
            "features_extractor_kwargs": {"lidar": recipe.lidar},
        }
    kind = ActorCriticPolicy if network.config.squash == "clip" else BoundedPolicy
    return PPO(
        kind, worlds, learning_rate=recipe.lr, n_steps=recipe.rollout, batch_size=recipe.batch, n_epochs=recipe.epochs,
        gamma=recipe.gamma, gae_lambda=recipe.gae_lambda, clip_range=recipe.clip_range,
        clip_range_vf=recipe.clip_range if recipe.original else None, ent_coef=recipe.entropy,
        vf_coef=recipe.value_weight, max_grad_norm=recipe.max_grad_norm,
        target_kl=recipe.target_kl if recipe.target_kl > 0 else None, policy_kwargs=kwargs, seed=recipe.seed,
        device=device,
    )  # fmt: skip


@dataclass(frozen=True)
class TrainedController:
    """What a controller training made.

    Attributes
    ----------
    out : Path
        Folder of the best controller, with all that it needs.
    steps : int
        Steps of all worlds together.
    best : float
        Largest success rate on the validation episodes.
    steps_per_s : float
        Of this run, validation not counted.
    held_out : float or None
        ``original`` only: success rate on episodes 1100 to 1199, which the authors' selection did not look at.
    """

    out: Path
    steps: int
    best: float
    steps_per_s: float
    held_out: float | None


def train_controller(
    recipe: ControllerRecipe,
    out: Path | str,
    *,
    model: Any = None,
    model_name: str = "",
    init: Policy | None = None,
    resume: bool = False,
    stop_after: int | None = None,
    device: str = "cpu",
    progress: bool = False,
    report: Callable[[str], None] | None = None,
) -> TrainedController:
    """Train a controller on a frozen world model, or an end-to-end network.

    Parameters
    ----------
    recipe : ControllerRecipe
        Settings.
    out : path-like
        Output folder, new or empty.
    model : WorldModel or VAE, optional
        What the controller sees through; none for ``"e2e"``.
    model_name : str
        Its name or folder, for the record.
    init : Policy, optional
        Go on from this policy's controller; its own bounds and sizes are kept.
    resume : bool
        Go on from the last checkpoint in `out`; the worlds start anew, from another stream of the same seed.
    stop_after : int, optional
        Stop, with a checkpoint, after this many steps.
    device : str
        Of learner and encoder.
    progress : bool
        Show a progress bar on stderr.
    report : callable, optional
        Takes lines for people.

    Returns
    -------
    TrainedController

    Raises
    ------
    ConfigError, CheckpointError
        If the model does not fit the features, or a resume has other settings.
    TrainingError
        If weights become NaN; the last good checkpoint is kept.
    """
    out = Path(out)
    torch.manual_seed(recipe.seed)
    network = make_network(recipe, model) if init is None else _network_of(init, recipe, model)
    used = None if recipe.features == "e2e" else weights_hash(model)
    from navrep_data.train.world_models import claim

    claim(
        out, recipe.to_dict(), {"world_model": model_name, "world_model_sha256": used}, resume, free=("validate_every",)
    )
    with writer_lock(out):
        run = _Run(recipe, out, network, model, model_name, init is not None, resume, device)
        return run.train(recipe.steps if stop_after is None else min(stop_after, recipe.steps), progress, report)


def _network_of(init: Policy, recipe: ControllerRecipe, model: Any) -> Controller | EndToEnd:
    """Return the network to go on from, after checking that it takes what the recipe feeds."""
    if not isinstance(init, Policy):
        raise CheckpointError(
            f"--init is a {type(init).__name__}, expected a policy such as transformer_1d_z.released."
        )
    wanted = make_network(recipe, model)
    network = init.network
    if type(network) is not type(wanted) or init.features != (None if recipe.features == "e2e" else recipe.features):
        raise CheckpointError(
            f"--init {init.name} takes {init.features or 'observations'}, expected {recipe.features}: they do not fit."
        )
    assert isinstance(network, Controller | EndToEnd)
    first, other = network.pi[0], wanted.pi[0]
    assert isinstance(first, nn.Linear)
    assert isinstance(other, nn.Linear)
    if init.lidar != recipe.lidar or first.in_features != other.in_features:
        raise CheckpointError(
            f"--init {init.name} has {first.in_features} inputs for {init.lidar}, expected {other.in_features} for "
            f"{recipe.lidar}: name the world model that it was trained with."
        )
    return network


class _Run(BaseCallback):
    """One run of a controller training: learner, validation, checkpoints."""

    def __init__(
        self, recipe: ControllerRecipe, out: Path, network: Controller | EndToEnd, model: Any, model_name: str,
        pretrained: bool, resume: bool, device: str,
    ) -> None:  # fmt: skip
        super().__init__()
        self.recipe, self.out, self.network, self.model_name = recipe, out, network, model_name
        self.policy_now = make_policy(recipe, network, model, model_name)
        self.at = state.Progress()
        folder = state.last_folder(out) if resume else None
        done = state.read_step(folder) if folder is not None else 0
        # worlds of a resumed run come from a stream of their own
        stream = int(np.random.SeedSequence([recipe.seed, done]).generate_state(1, np.uint32)[0])
        self.worlds = TrainingWorlds(
            environment(recipe), self.policy_now, recipe.worlds, seed=stream, max_speed=network.config.max_speed,
            reward_scale=recipe.reward_scale, truncate=not recipe.original,
        )  # fmt: skip
        self.ppo = make_ppo(recipe, self.worlds, network, device)
        if folder is not None:
            self.at = state.load(folder, network, self.ppo.policy.optimizer, self.ppo.policy)
        if folder is not None or pretrained:
            put_weights(self.ppo.policy, network)
        else:  # start from stable-baselines3's orthogonal weights, but with the scaled inputs
            self._start()
        self.ppo.num_timesteps = self.at.step
        self.logger_file: Logger | None = None
        self.spent, self.began, self.first = 0.0, 0.0, self.at.step
        self.stop_at = recipe.steps
        self.bar: Any = None
        if model is not None and not (out / PARTS).exists():
            checkpoint.save(model, out / PARTS, {"name": model_name})
        atomic_write_json(out / POLICY_FILE, self._description())

    def _start(self) -> None:
        take_weights(self.network, self.ppo.policy)
        if isinstance(self.network, Controller) and not self.recipe.original:
            vae = self.policy_now.vae
            _scale_inputs(self.network, vae.config.z_size if vae is not None and "z" in self.recipe.features else 0)
            put_weights(self.ppo.policy, self.network)

    def _description(self) -> dict[str, Any]:
        e2e = self.recipe.features == "e2e"
        return {
            "format": "navrep-data-policy",
            "features": None if e2e else self.recipe.features,
            "lidar": self.recipe.lidar,
            "context": self.policy_now.context,
            "world_model": None if e2e else PARTS,
            "sensor": SensorContract().to_dict(),
        }

    def train(self, stop: int, progress: bool, report: Callable[[str], None] | None) -> TrainedController:
        """Train up to `stop` steps."""
        from tqdm import tqdm

        self.stop_at = stop
        self.logger_file = Logger(self.out, self.at.step)
        self.bar = tqdm(
            total=self.recipe.steps, initial=self.at.step, unit="step", unit_scale=True, disable=not progress
        )
        self.began = time.perf_counter()
        try:
            if self.at.step < stop:
                self.ppo.learn(stop - self.at.step, callback=self, reset_num_timesteps=False)
                self._checkpoint(validate=True)
        finally:
            self.bar.close()
            self.logger_file.close()
        rate = (self.at.step - self.first) / max(1e-9, self.spent)
        held_out = self._success(AUTHORS_HELD_OUT) if self.recipe.original else None
        best = 0.0 if self.at.best is None else 1.0 - self.at.best
        if report is not None:
            more = "" if held_out is None else f", {held_out:.1%} on episodes 1100 to 1199"
            report(f"{self.out}: {self.at.step:,} steps, {rate:,.0f} steps/s, best validation {best:.1%}{more}")
        curve(self.out)
        return TrainedController(self.out, self.at.step, best, rate, held_out)

    # --- callback ----------------------------------------------------------------------------------------------

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        """Look after everything between two updates."""
        now = self.ppo.num_timesteps
        if not self.recipe.original:  # by the recipe's length, wherever this run stops
            rate = self.recipe.lr * max(_LEAST_RATE, 1.0 - now / self.recipe.steps)
            self.ppo.lr_schedule = lambda _: rate
        if now == self.at.step:
            return
        due = now // self.recipe.validate_every > self.at.step // self.recipe.validate_every
        self._log(now)
        if due:
            self._checkpoint(validate=True)

    def _log(self, now: int) -> None:
        self.spent += time.perf_counter() - self.began
        self.at.seconds += time.perf_counter() - self.began
        self.began = time.perf_counter()
        if self.bar is not None:
            self.bar.update(now - self.bar.n)
        values = self.worlds.take_outcomes()
        difficulty = self.worlds.simulator.difficulty().mean(0)
        std = float(self.ppo.policy.log_std.detach().exp().mean())
        found = self.ppo.logger.name_to_value
        losses: dict[str, float] = {}
        for name, value in found.items():
            if name.startswith("train/") and isinstance(value, int | float | np.floating):
                losses[name.removeprefix("train/")] = float(value)
        assert self.logger_file is not None
        self.logger_file.write(
            now,
            {
                **values, **losses, "humans": float(difficulty[0]), "obstacles": float(difficulty[1]),
                "policy_std": std,
                "steps_per_s": (now - self.first) / max(1e-9, self.spent), "seconds": self.at.seconds,
            },
        )  # fmt: skip

    def _checkpoint(self, validate: bool) -> None:
        if self.ppo.num_timesteps > self.at.step and not self._finite():
            last = state.last_folder(self.out)
            raise TrainingError(
                f"Weights are NaN after {self.ppo.num_timesteps:,} steps. The last good checkpoint is {last}: lower lr."
            )
        clock = time.perf_counter()
        self.spent += clock - self.began
        self.at.step = self.ppo.num_timesteps
        take_weights(self.network, self.ppo.policy)
        if validate:
            rate = self._success(AUTHORS_SEEDS if self.recipe.original else VALIDATION_SEEDS)
            assert self.logger_file is not None
            self.logger_file.write(self.at.step, {"val_success": rate})
            if self.at.best is None or 1.0 - rate < self.at.best:
                self.at.best, self.at.best_step = 1.0 - rate, self.at.step
        state.save(self.out, self.network, self.ppo.policy.optimizer, self.at, self._metadata(), self.ppo.policy)
        state.commit(self.out, self.at)
        state.publish(self.out, self.at.best_step)
        self.began = time.perf_counter()

    def _finite(self) -> bool:
        return all(bool(torch.isfinite(p).all()) for p in self.ppo.policy.parameters())

    def _success(self, seeds: range) -> float:
        """Return the share of validation episodes that end at the goal; the policy acts by its mean."""
        network = self.network
        policy = make_policy(self.recipe, network, self.policy_now.world_model or self.policy_now.vae)
        ended = play(policy, validation_environment(), seeds)
        return sum(event == Event.GOAL for event in ended) / len(ended)

    def _metadata(self) -> dict[str, Any]:
        seeds = AUTHORS_SEEDS if self.recipe.original else VALIDATION_SEEDS
        return {
            "trained_by": f"navrep-data {__version__}",
            "note": "Retrained by navrep-data; not the authors' checkpoint.",
            "recipe": self.recipe.to_dict(),
            "world_model": self.model_name,
            "environment": environment(self.recipe).to_dict(),
            "selected_on": f"navrep-test, original physics, numpy seeds {seeds.start} to {seeds.stop - 1}",
            "step": self.at.step,
            "seconds": round(self.at.seconds, 1),
            "best_validation": None if self.at.best is None else 1.0 - self.at.best,
        }
