"""Train controllers: PPO over a batch of worlds, encoded by a frozen V."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from navrep_data._version import __version__
from navrep_data.errors import CheckpointError, ConfigError, TrainingError
from navrep_data.io import atomic_write_json
from navrep_data.models import Controller, EndToEnd, checkpoint
from navrep_data.schema import Event, SensorContract
from navrep_data.shards import writer_lock
from navrep_data.sim import robot_contract
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
from navrep_data.train.learner import (
    make_encoder,
    make_network,
    make_policy,
    make_ppo,
    make_worlds,
    network_of,
    scale_inputs,
)
from navrep_data.train.logs import Logger, curve
from navrep_data.train.refit import refit
from navrep_data.train.world_models import claim, machine, unclaimed_if_refused
from navrep_data.train.worlds import play
from navrep_data.zoo.local import PARTS, POLICY_FILE
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3 import put_weights, take_weights

_LEAST_RATE = 0.02
HELD_OUT_FILE = "held_out.json"


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


@checkpoint.single_precision()
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
        Go on from this policy's controller; its own bounds and sizes are kept. Not needed to resume.
    resume : bool
        Go on from the last checkpoint in `out`, to the same weights as without the interruption: at every checkpoint
        all worlds start anew, as difficult as they were.
    stop_after : int, optional
        Stop, with a checkpoint, after this many steps.
    device : str
        Of the learner; worlds and the frozen encoder stay on the CPU.
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
    if report is not None and environment(recipe).scenarios:
        report(
            "Episodes of this training are drawn from the scenarios of navrep27: what it scores in that suite says "
            "nothing of places that it has not seen."
        )
    torch.manual_seed(recipe.seed)
    folder = state.last_folder(out) if resume else None
    network = _saved_network(folder, recipe, model) if folder else _first_network(recipe, model, init, resume, report)
    used = None if recipe.features == "e2e" else weights_hash(model)
    data = {"world_model": model_name, "world_model_sha256": used, "init": None if init is None else init.name}
    claim(out, recipe.to_dict(), data, resume, free=("validate_every",))
    with writer_lock(out):
        with unclaimed_if_refused(out, resume):
            run = _Run(recipe, out, network, model, model_name, init is not None, folder, device)
        return run.train(recipe.steps if stop_after is None else min(stop_after, recipe.steps), progress, report)


def _first_network(
    recipe: ControllerRecipe, model: Any, init: Policy | None, resume: bool, report: Callable[[str], None] | None
) -> Controller | EndToEnd:
    """Return the network to start from; a resume overwrites its weights."""
    if recipe.refit and init is None and not resume:
        raise ConfigError(
            "refit brings the controller of --init to this V, but there is none: name one, or leave it out."
        )
    if init is None:
        return make_network(recipe, model)
    if not recipe.refit:
        return network_of(init, recipe, model)
    make_network(recipe, model)  # whose checks hold here too
    network, explained = refit(init, vae_of(model, "The world model"), environment(recipe))
    if report is not None:
        report(f"{init.name}: {100 * explained:.0f} % of its codes' variance is a linear function of the new codes")
    return network


def _saved_network(folder: Path, recipe: ControllerRecipe, model: Any) -> Controller | EndToEnd:
    """Return the network of a checkpoint, of whatever sizes and bounds ``--init`` gave it."""
    wanted = make_network(recipe, model)  # whose checks hold here too
    network = checkpoint.load(folder)
    if not isinstance(network, Controller | EndToEnd) or type(network) is not type(wanted):
        raise CheckpointError(
            f"{folder} holds a {type(network).__name__}, expected a {type(wanted).__name__}: start anew in another "
            "folder."
        )
    return network


def _stream(recipe: ControllerRecipe, step: int) -> int:
    """Return the seed of worlds and noise from a step on."""
    return int(np.random.SeedSequence([recipe.seed, step]).generate_state(1, np.uint32)[0])


class _Run(BaseCallback):
    """One run of a controller training: learner, validation, checkpoints."""

    def __init__(
        self, recipe: ControllerRecipe, out: Path, network: Controller | EndToEnd, model: Any, model_name: str,
        pretrained: bool, folder: Path | None, device: str,
    ) -> None:  # fmt: skip
        super().__init__()
        self.recipe, self.out, self.network, self.model_name = recipe, out, network, model_name
        self.encoder = make_encoder(recipe, model)
        self.policy_now = make_policy(recipe, network, model, model_name, self.encoder)
        self.at = state.Progress()
        done = state.read_step(folder) if folder is not None else 0
        self.worlds = make_worlds(recipe, network, model, self.encoder, _stream(recipe, done))
        if recipe.easy_start and self.worlds.groups[0].config.curriculum == "adaptive":
            self.worlds.set_difficulty(np.zeros_like(self.worlds.difficulty()))
        self.ppo = make_ppo(recipe, self.worlds, network, device)
        if folder is not None:
            self.at = state.load(folder, network, self.ppo.policy.optimizer, self.ppo.policy)
            state.publish(out, self.at.best_step)  # in case the last run was stopped before it could
            if "difficulty" in self.at.extra:
                self.worlds.set_difficulty(self.at.extra["difficulty"].cpu().numpy())
        if folder is not None or pretrained:
            put_weights(self.ppo.policy, network)
        else:  # start from stable-baselines3's orthogonal weights, but with the scaled inputs
            self._start()
        self.ppo.num_timesteps = self.at.step
        self.logger_file: Logger | None = None
        self.spent, self.began, self.first = 0.0, 0.0, self.at.step
        self.stop_at = recipe.steps
        self.bar: Any = None
        if model is not None and not (out / PARTS / checkpoint.CONFIG_NAME).is_file():  # which is written last
            checkpoint.save(model, out / PARTS, {"name": model_name})
        atomic_write_json(out / POLICY_FILE, self._description())

    def _start(self) -> None:
        take_weights(self.network, self.ppo.policy)
        if isinstance(self.network, Controller) and not self.recipe.original:
            vae = self.policy_now.vae
            scale_inputs(self.network, vae.config.z_size if vae is not None and "z" in self.recipe.features else 0)
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
            "robot": robot_contract(environment(self.recipe)).to_dict(),
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
        self._seed()
        try:
            if self.at.step < stop:
                self._learn(stop - self.at.step)
                self._log(self.ppo.num_timesteps)
                self._checkpoint(validate=True)
        finally:
            self.bar.close()
            self.logger_file.close()
            self.worlds.close()
        rate = (self.at.step - self.first) / max(1e-9, self.spent)
        held_out = self._held_out() if self.recipe.original else None
        best = 0.0 if self.at.best is None else 1.0 - self.at.best
        if report is not None:
            more = "" if held_out is None else f", {held_out:.1%} on episodes 1100 to 1199"
            report(f"{self.out}: {self.at.step:,} steps, {rate:,.0f} steps/s, best validation {best:.1%}{more}")
        curve(self.out)
        return TrainedController(self.out, self.at.step, best, rate, held_out)

    def _held_out(self) -> float | None:
        """Return the success of the selected controller on episodes that its selection did not look at."""
        folder = state.last_folder(self.out)
        if folder is None:
            return None
        best: Any = checkpoint.load(state.folder_of(self.out, self.at.best_step))
        rate = self._success(AUTHORS_HELD_OUT, best)
        atomic_write_json(
            self.out / HELD_OUT_FILE,
            {
                "success_rate": rate, "step": self.at.best_step,
                "episodes": f"navrep-test, original physics, numpy seeds {AUTHORS_HELD_OUT.start} to "
                f"{AUTHORS_HELD_OUT.stop - 1}",
            },
        )  # fmt: skip
        return rate

    def _learn(self, steps: int) -> None:
        try:
            self.ppo.learn(steps, callback=self, reset_num_timesteps=False)
        except ValueError:  # torch's distributions refuse what is not finite
            self._check_finite()
            raise

    def _check_finite(self) -> None:
        """Raise where an update left weights that are not finite: nothing of that is saved."""
        if all(bool(torch.isfinite(p).all()) for p in self.ppo.policy.parameters()):
            return
        last = state.last_folder(self.out)
        kept = f"The last good checkpoint is {last}" if last is not None else "There is no checkpoint yet"
        raise TrainingError(
            f"Weights are NaN after {self.ppo.num_timesteps:,} steps, expected finite ones. {kept}; start in "
            "another folder with a lower lr (--set lr=...), from that checkpoint by --init."
        )

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
        self._check_finite()
        due = now // self.recipe.validate_every > self.at.step // self.recipe.validate_every
        self._log(now)
        if due:
            self._checkpoint(validate=True)
            self._start_worlds()

    def _seed(self) -> None:
        """Draw noise and order from here on from seed and step alone."""
        stream = _stream(self.recipe, self.at.step)
        np.random.seed(stream)  # noqa: NPY002  stable-baselines3 shuffles rollouts by this one
        torch.manual_seed(stream)

    def _start_worlds(self) -> None:
        """Go on as a run that resumes from this checkpoint does: in new worlds, so that no world's state is kept."""
        self.worlds.restart(_stream(self.recipe, self.at.step), self.worlds.difficulty())
        self._seed()
        self.ppo._last_obs = self.worlds.reset()
        self.ppo._last_episode_starts = np.ones(self.worlds.num_envs, bool)

    def _log(self, now: int) -> None:
        self.spent += time.perf_counter() - self.began
        self.at.seconds += time.perf_counter() - self.began
        self.began = time.perf_counter()
        if self.bar is not None:
            self.bar.update(now - self.bar.n)
        values = self.worlds.take_outcomes()
        difficulty = self.worlds.difficulty().mean(0)
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
        self._check_finite()
        clock = time.perf_counter()
        self.spent += clock - self.began
        self.at.step = self.ppo.num_timesteps
        self.at.extra = {"difficulty": torch.from_numpy(self.worlds.difficulty())}
        take_weights(self.network, self.ppo.policy)
        if validate:
            rate = self._success(AUTHORS_SEEDS if self.recipe.original else VALIDATION_SEEDS)
            assert self.logger_file is not None
            self.logger_file.write(self.at.step, {"val_success": rate})
            if self.at.best is None or 1.0 - rate <= self.at.best:  # of equals the later, which has learned for longer
                self.at.best, self.at.best_step = 1.0 - rate, self.at.step
        state.save(self.out, self.network, self.ppo.policy.optimizer, self.at, self._metadata(), self.ppo.policy)
        state.commit(self.out, self.at)
        state.publish(self.out, self.at.best_step)
        self.began = time.perf_counter()

    def _success(self, seeds: range, network: Controller | EndToEnd | None = None) -> float:
        """Return the share of validation episodes that end well; the policy acts by its mean.

        At the goal without a contact; with the authors' settings a goal is enough, as it was for them.
        """
        network = self.network if network is None else network
        exact = self.recipe.replace(precision="float32")
        policy = make_policy(exact, network, self.policy_now.world_model or self.policy_now.vae)
        ended = play(policy, validation_environment(self.recipe), seeds)
        any_goal = self.recipe.original
        return sum(e.event == Event.GOAL and (any_goal or not e.touched) for e in ended) / len(ended)

    def _metadata(self) -> dict[str, Any]:
        seeds = AUTHORS_SEEDS if self.recipe.original else VALIDATION_SEEDS
        where = validation_environment(self.recipe)
        rule = "goals, as the authors did" if self.recipe.original else "goals without contact"
        return {
            "trained_by": f"navrep-data {__version__}",
            "note": "Retrained by navrep-data; not the authors' checkpoint.",
            "recipe": self.recipe.to_dict(),
            "world_model": self.model_name,
            "environment": environment(self.recipe).to_dict(),
            "selected_on": f"{where.env}, {where.physics} physics, numpy seeds {seeds.start} to {seeds.stop - 1}, by "
            f"the share of {rule}",
            "step": self.at.step,
            "seconds": round(self.at.seconds, 1),
            "machine": machine(self.ppo.device),
            "best_validation": None if self.at.best is None else 1.0 - self.at.best,
        }
