"""Train V, M, the joint model or the transformer: one loop for all."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from navrep_data._version import __version__
from navrep_data.datasets.latents import LatentManifest
from navrep_data.errors import CheckpointError, ConfigError, DatasetMismatchError, FolderInUseError, TrainingError
from navrep_data.io import atomic_write_bytes, atomic_write_json, read_json, translate_os_error
from navrep_data.models import (
    MDNRNN,
    VAE,
    JointConfig,
    JointWorldModel,
    MemoryConfig,
    TransformerConfig,
    TransformerWorldModel,
    VAEConfig,
    WorldModel,
    checkpoint,
)
from navrep_data.shards import LOCK_FILE, writer_lock
from navrep_data.train import state
from navrep_data.train.cues import Cues
from navrep_data.train.cues import wanted as cues_wanted
from navrep_data.train.data import Batches, describe_dataset, open_dataset
from navrep_data.train.logs import Logger, picture
from navrep_data.train.optim import clip, learning_rate, make_optimizer
from navrep_data.train.recipe import Recipe
from navrep_data.train.tasks import Task, make_task

_LOG_EVERY = 10
_MAX_RECIPE = 1 << 20
# May differ between a run and its resume: they change neither losses nor weights.
_FREE_ON_RESUME = ("validate_every", "validate_batches", "save_every", "picture_every")


@dataclass(frozen=True)
class Trained:
    """What a training made.

    Attributes
    ----------
    out : Path
        Folder; its top holds the weights to use.
    step : int
        Steps done.
    losses : list of float
        Loss of every step of this run.
    validation : dict
        Errors of the last validation.
    frames_per_s : float
        Rows per second of this run, padding, validation and saving not counted.
    """

    out: Path
    step: int
    losses: list[float]
    validation: dict[str, float]
    frames_per_s: float


def make_model(recipe: Recipe) -> nn.Module:
    """Return the new network of a recipe, drawn from its seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        match recipe.model:
            case "v":
                return VAE(VAEConfig(recipe.lidar, recipe.z_size))
            case "m":
                return MDNRNN(MemoryConfig(recipe.z_size, recipe.h_size, action_alignment=recipe.action_alignment))
            case "joint":
                return JointWorldModel(
                    JointConfig(
                        recipe.lidar, recipe.z_size, recipe.h_size, action_alignment=recipe.action_alignment,
                        residual=recipe.residual,
                    )
                )  # fmt: skip
        return TransformerWorldModel(
            TransformerConfig(
                recipe.lidar, recipe.z_size, recipe.n_blocks, context=recipe.window,
                action_alignment=recipe.action_alignment, residual=recipe.residual,
            )
        )  # fmt: skip


@checkpoint.single_precision()
def train_world_model(
    recipe: Recipe,
    data: Path | str,
    out: Path | str,
    *,
    resume: bool = False,
    stop_after: int | None = None,
    device: str = "cpu",
    init: nn.Module | None = None,
    preload: bool | None = None,
    progress: bool = False,
    report: Callable[[str], None] | None = None,
) -> Trained:
    """Train V, M, a joint model or a transformer.

    Parameters
    ----------
    recipe : Recipe
        Settings: :func:`default_recipe`, :func:`original_recipe`, or one of your own.
    data : path-like
        Dataset folder; for M the folder that ``navrep-data encode`` wrote.
    out : path-like
        Output folder, new or empty; see :mod:`navrep_data.train.state`.
    resume : bool
        Go on from the last checkpoint in `out`, to the same losses as without the interruption.
    stop_after : int, optional
        Stop, with a checkpoint, after this step of the recipe's `steps`.
    device : str
        ``"cpu"``, ``"cuda"``.
    init : nn.Module, optional
        Start from this network's weights instead of new ones; a joint model or transformer may start from a V alone.
    preload : bool, optional
        Hold the dataset in memory; where it fits if left out.
    progress : bool
        Show a progress bar on stderr.
    report : callable, optional
        Takes lines for people.

    Returns
    -------
    Trained

    Raises
    ------
    DatasetMismatchError
        If the dataset has another sensor, or on resuming is not the one of before.
    ConfigError
        If a resume has other settings, or a setting cannot be used.
    TrainingError
        If the loss becomes NaN or infinite; the last good checkpoint is kept.
    """
    data, out = Path(data), Path(out)
    described = describe_dataset(data, recipe.model)
    if recipe.model == "m":
        recipe = recipe.replace(z_size=LatentManifest.read(data).z_size)
    claim(out, recipe.to_dict(), described, resume)
    with writer_lock(out):
        with unclaimed_if_refused(out, resume):
            loop = _Loop(recipe, data, out, described, torch.device(device), init, preload)
        return loop.run(recipe.steps if stop_after is None else min(stop_after, recipe.steps), progress, report)


def claim(
    out: Path, settings: dict[str, Any], data: dict[str, Any], resume: bool, free: tuple[str, ...] = _FREE_ON_RESUME
) -> None:
    """Make the output folder with its recipe, or check that a resume agrees with it.

    Parameters
    ----------
    out : Path
        Output folder.
    settings : dict
        The recipe.
    data : dict
        What it trains on; ``content_hash``, ``encoder`` and ``world_model_sha256`` must stay the same.
    resume : bool
        Whether there is a training to go on with.
    free : tuple of str
        Settings that may differ on a resume.

    Raises
    ------
    FolderInUseError, ConfigError, DatasetMismatchError
        If they do not agree.
    """
    path = out / state.RECIPE_FILE
    here = {"settings": settings, "data": data, "version": __version__}
    if not resume:
        if out.exists() and (not out.is_dir() or any(path.name != LOCK_FILE for path in out.iterdir())):
            raise FolderInUseError(
                f"{out} is not empty and is not overwritten: go on with --resume, or choose another folder with --out."
            )
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise translate_os_error(error, out) from error
        atomic_write_json(path, here)
        return
    if not path.is_file():
        raise ConfigError(f"There is no training to resume in {out}: expected {state.RECIPE_FILE}; leave out --resume.")
    before = read_json(path, _MAX_RECIPE)
    old = before.get("settings") if isinstance(before, dict) else None
    old = old if isinstance(old, dict) else {}
    for name in dict.fromkeys((*settings, *old)):  # a setting at its default may be left out on either side
        value = settings.get(name)
        if name not in free and old.get(name) != value:
            raise ConfigError(
                f"{out} was started with {name} = {old.get(name)!r}, this resume has {value}: use the "
                f"settings in {path}, or start anew in another folder."
            )
    for name in ("content_hash", "encoder", "world_model_sha256"):
        if before.get("data", {}).get(name) != data.get(name):
            raise DatasetMismatchError(
                f"{out} was trained on other data ({name} differs): resume with those it was started with."
            )


@contextmanager
def unclaimed_if_refused(out: Path, resume: bool) -> Iterator[None]:
    """Take :func:`claim`'s recipe away again where a new training is refused before it began: the folder stays free."""
    try:
        yield
    except BaseException:
        if not resume:
            (out / state.RECIPE_FILE).unlink(missing_ok=True)
        raise


class _Loop:
    """One run of a training."""

    def __init__(
        self,
        recipe: Recipe,
        data: Path,
        out: Path,
        described: dict[str, Any],
        device: torch.device,
        init: nn.Module | None,
        preload: bool | None,
    ) -> None:
        self.recipe, self.out, self.described, self.device = recipe, out, described, device
        self.model = make_model(recipe)
        if init is not None:
            _start_from(self.model, init)
        if recipe.freeze_v:
            if init is None and state.last_folder(out) is None:
                raise ConfigError("freeze_v keeps V as --init gives it, but there is none: name a V or a world model.")
            self.model.vae.requires_grad_(False)
        self.model.to(device)
        self.cues = Cues(recipe.z_size, recipe.lidar).to(device) if cues_wanted(recipe) else None
        # all that is optimised; the head for cues is part of a checkpoint's state, not of its weights
        self.trained = self.model if self.cues is None else nn.ModuleDict({"model": self.model, "cues": self.cues})
        self.optimizer = make_optimizer(self.trained, recipe)
        self.progress = state.Progress()
        self.task: Task = make_task(self.model, recipe, device, self.cues)
        folder = state.last_folder(out)
        if folder is not None:
            self.progress = state.load(folder, self.model, self.optimizer, self.trained)
            if self.cues is not None:
                head = {name: self.progress.extra.pop(f"cues.{name}") for name in ("weight", "bias")}
                self.cues.load_state_dict(head)
            self.task.extra = self.progress.extra
            self._publish()  # in case the last run was stopped before it could
        self.train = Batches(open_dataset(data, recipe, "train", preload), recipe)
        self.valid = self._validation(data, preload)
        self.validation: dict[str, float] = {}

    def _validation(self, data: Path, preload: bool | None) -> list[Any]:
        """Return the batches of the val split that are looked at, always the same ones; none if it is empty."""
        recipe = replace(self.recipe, batch=min(self.recipe.batch, 64), seed=0)
        try:
            dataset = open_dataset(data, recipe, "val", False if preload is None else preload)
        except ConfigError:
            return []
        smaller = replace(recipe, batch=min(recipe.batch, len(dataset)))
        batches = Batches(dataset, smaller)
        return [batches.read(k) for k in range(min(self.recipe.validate_batches, batches.per_epoch))]

    # --- running -----------------------------------------------------------------------------------------------

    def run(self, stop: int, progress: bool, report: Callable[[str], None] | None) -> Trained:
        """Train up to step `stop`."""
        from tqdm import tqdm

        recipe, at = self.recipe, self.progress
        logger = Logger(self.out, at.step)
        losses: list[float] = []
        frames, spent, before = 0, 0.0, at.seconds
        bar = tqdm(total=recipe.steps, initial=at.step, unit="step", disable=not progress)
        try:
            started = time.perf_counter()
            for batch in self.train.ahead(at.step, stop):
                values = self._step(batch)
                spent += time.perf_counter() - started
                losses.append(values["loss"])
                frames += int(batch["mask"].sum()) if "mask" in batch else len(batch["obs"])
                at.seconds = before + spent
                if at.step % _LOG_EVERY == 0 or at.step in (1, stop):
                    logger.write(at.step, {**values, "frames_per_s": frames / spent, "seconds": at.seconds})
                bar.set_postfix_str(f"loss {values['loss']:.4g}", refresh=False)
                bar.update()
                self._housekeeping(stop, logger, batch)
                started = time.perf_counter()
        finally:
            bar.close()
            logger.close()
        rate = frames / max(1e-9, spent)
        if report is not None:
            errors = ", ".join(f"{name} {value:.4g}" for name, value in self.validation.items() if name != "error")
            report(
                f"{self.out}: step {at.step} of {recipe.steps}, {rate:,.0f} frames/s; validation: {errors or 'none'}"
            )
        return Trained(self.out, at.step, losses, self.validation, rate)

    def _step(self, batch: Any) -> dict[str, float]:
        recipe, at = self.recipe, self.progress
        self.model.train()
        rate = learning_rate(recipe, at.step, at.tokens, len(self.train.dataset) * recipe.window)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        total, sums = 0.0, dict[str, float]()
        for terms in self.task.parts(batch, at.step):
            value = float(terms.total.detach())
            if not math.isfinite(value):
                self._stop_at(value, terms.parts)
            terms.total.backward()  # type: ignore[no-untyped-call]
            total += value
            for name, one in terms.parts.items():
                sums[name] = sums.get(name, 0.0) + one
        norm = clip(self.trained, recipe)
        if not math.isfinite(norm):
            self._stop_at(norm, {"gradient norm": norm})
        self.optimizer.step()
        at.step += 1
        at.tokens += len(next(iter(batch.values()))) * recipe.window
        return {"loss": total, **sums, "lr": rate, "grad_norm": norm}

    def _stop_at(self, value: float, parts: dict[str, float]) -> None:
        at = self.progress.step
        bad = [name for name, one in parts.items() if not math.isfinite(one)] or ["loss"]
        folder = state.last_folder(self.out)
        kept = f"The last good checkpoint is {folder}" if folder is not None else "There is no checkpoint yet"
        epoch, k = divmod(at, self.train.per_epoch)
        raise TrainingError(
            f"The loss is {value} at step {at + 1} (epoch {epoch}, batch {k}; first in: {', '.join(bad)}). {kept}; "
            "verify the dataset, or start in another folder, from that checkpoint by --init, with --set lr=... lower "
            "or --set precision=float32."
        )

    def _housekeeping(self, stop: int, logger: Logger, batch: Any) -> None:
        recipe, at = self.recipe, self.progress
        last = at.step == stop
        better = False
        if last or at.step % recipe.validate_every == 0:
            better = self._validate(logger)
        if last or at.step % recipe.picture_every == 0:
            self._picture(logger, batch)
        if last or better or at.step % recipe.save_every == 0:
            head = {} if self.cues is None else {f"cues.{n}": t for n, t in self.cues.state_dict().items()}
            at.extra = {**self.task.extra, **head}
            state.save(self.out, self.model, self.optimizer, at, self._metadata(), self.trained)
            state.commit(self.out, at)
            self._publish()

    def _publish(self) -> None:
        at = self.progress
        # the authors used what training ended with
        state.publish(self.out, at.step if self.recipe.original or at.best is None else at.best_step)

    @torch.no_grad()
    def _validate(self, logger: Logger) -> bool:
        """Validate, and return whether this is the best so far."""
        if not self.valid:
            return False
        self.model.eval()
        sums: dict[str, float] = {}
        count = 0.0
        for batch in self.valid:
            errors, n = self.task.validate(batch)
            count += n
            for name, value in errors.items():
                sums[name] = sums.get(name, 0.0) + value
        self.validation = {name: value / max(1.0, count) for name, value in sums.items()}
        logger.write(self.progress.step, {f"val_{name}": value for name, value in self.validation.items()})
        error = self.validation["error"]
        if math.isfinite(error) and (self.progress.best is None or error < self.progress.best):
            self.progress.best, self.progress.best_step = error, self.progress.step
            return True
        return False

    def _picture(self, logger: Logger, batch: Any) -> None:
        self.model.eval()
        images = self.task.images(self.valid[0] if self.valid else batch)
        if images is None:
            return
        step = self.progress.step
        png, image = picture(images, self.recipe.lidar, f"{self.recipe.model} {self.recipe.lidar}, step {step}")
        folder = self.out / "pictures"
        folder.mkdir(exist_ok=True)
        atomic_write_bytes(folder / f"step-{step:08d}.png", png)
        logger.picture("frames", step, image)

    def _metadata(self) -> dict[str, Any]:
        """Return what the checkpoint keeps of its origin."""
        at = self.progress
        return {
            "trained_by": f"navrep-data {__version__}",
            "note": "Retrained by navrep-data; not the authors' checkpoint.",
            "recipe": self.recipe.to_dict(),
            "dataset": self.described,
            "sensor": self.described["sensor"],
            "step": at.step,
            "seconds": round(at.seconds, 1),
            "validation": self.validation,
            "machine": machine(self.device),
        }


def machine(device: torch.device) -> dict[str, Any]:
    """Return what trained: device, processor, threads, cores, torch."""
    return {
        "device": str(device) if device.type == "cpu" else torch.cuda.get_device_name(device),
        "processor": platform.machine(),
        "threads": torch.get_num_threads(),
        "cores": os.cpu_count(),
        "torch": torch.__version__,
    }


def _memory(model: WorldModel) -> tuple[object, ...]:
    """Return what must agree for one memory's weights to fit another's."""
    return (type(model), *(getattr(model.config, name, None) for name in ("h_size", "n_layers", "n_blocks")))


def _start_from(model: nn.Module, init: nn.Module) -> None:
    """Copy weights of a network of the same kind and size; of a V alone, or a world model with another memory, its V.

    Raises
    ------
    CheckpointError, ConfigError
        If it is of another kind, or fed other actions.
    """
    if isinstance(init, WorldModel) and isinstance(model, WorldModel) and _memory(init) != _memory(model):
        init = init.vae
    if isinstance(init, VAE) and isinstance(model, WorldModel):
        if model.vae.config != init.config:
            raise CheckpointError(
                f"--init is a V with {init.config}, expected {model.vae.config}: train it with --lidar "
                f"{model.vae.config.lidar} --set z_size={model.vae.config.z_size}."
            )
        model.vae.load_state_dict(init.state_dict())
        return
    mine, other = getattr(model, "config", None), getattr(init, "config", None)
    wanted, seen = (getattr(c, "action_alignment", None) for c in (mine, other))
    if type(init) is type(model) and wanted != seen:
        raise ConfigError(
            f"--init was trained with the {seen} action, this recipe feeds the {wanted} one: set --action {seen}."
        )
    if type(init) is not type(model) or mine != other:
        raise CheckpointError(f"--init is {other}, expected {mine}: take a checkpoint of the same network.")
    model.load_state_dict(init.state_dict())
