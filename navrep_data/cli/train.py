"""``navrep-data train``: V, M, joint model, transformer, controllers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from navrep_data.cli._common import print_json, say, say_err, show_progress
from navrep_data.errors import ConfigError
from navrep_data.registration import ENVIRONMENTS, spelled

if TYPE_CHECKING:
    from navrep_data.train import Recipe, Trained

_MOST_EPOCHS = 1_000_000

train_app = typer.Typer(help="Train V, M, joint model, transformer or controllers.", no_args_is_help=True)

Lidar = Annotated[str, typer.Option("--lidar", help="rings or 1d.")]
Data = Annotated[Path, typer.Option("--data", metavar="DIR", help="Dataset folder.")]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Output folder, new or empty.")]
Original = Annotated[bool, typer.Option("--original", help="The authors' settings instead of ours.")]
RecipeFile = Annotated[Path | None, typer.Option("--recipe", metavar="FILE", help="Settings from a JSON file.")]
Settings = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Any other setting.")]
Steps = Annotated[int | None, typer.Option("--steps", help="Optimiser steps.", show_default="the recipe's")]
Epochs = Annotated[float | None, typer.Option("--epochs", help="Passes over the training split, instead of --steps.")]
Batch = Annotated[
    int | None, typer.Option("--batch", help="Windows (v: frames) per step.", show_default="the recipe's")
]
Seed = Annotated[int | None, typer.Option("--seed", help="Of weights, order and noise.", show_default="the recipe's")]
Action = Annotated[
    str | None, typer.Option("--action", help="taken or leading: what a row is fed.", show_default="the recipe's")
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint in --out.")]
StopAfter = Annotated[int | None, typer.Option("--stop-after", help="Stop with a checkpoint after this step.")]
Device = Annotated[str, typer.Option("--device", help="cpu, cuda, cuda:1, ...")]
Threads = Annotated[int | None, typer.Option("--threads", help="Threads of torch.", show_default="torch's")]
Init = Annotated[str | None, typer.Option("--init", metavar="NAME|DIR", help="Start from these weights.")]
From = Annotated[str | None, typer.Option("--from", metavar="DIR", help="Folder with the authors' files.")]


def _list_settings(context: typer.Context, wanted: bool) -> None:
    """Print the settings of a stage, or of all, and end; before flags that are missing are complained about."""
    if not wanted:
        return
    from navrep_data.train.settings import STAGES, list_settings

    stages = [context.info_name] if context.info_name in STAGES else list(STAGES)
    for stage in stages:
        if len(stages) > 1:
            say(f"[{stage}]")
        for line in list_settings(str(stage)):
            say(line)
    raise typer.Exit


ListSettings = Annotated[
    bool,
    typer.Option("--list-settings", is_eager=True, callback=_list_settings, help="List what --set sets, and end."),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Encoder = Annotated[
    str | None,
    typer.Option("--v", metavar="NAME|DIR", help="The V that encoded --data: also write V and M joined."),
]


@train_app.callback()
def train_command(list_settings: ListSettings = False) -> None:
    """Train V, M, joint model, transformer or controllers."""


@train_app.command("v")
def v_command(
    data: Data, out: Out, lidar: Lidar = "rings", original: Original = False, recipe: RecipeFile = None,
    steps: Steps = None, epochs: Epochs = None, batch: Batch = None, seed: Seed = None, settings: Settings = None,
    resume: Resume = False, stop_after: StopAfter = None, device: Device = "cpu", threads: Threads = None,
    init: Init = None, source: From = None, as_json: Json = False,
    list_settings: ListSettings = False,
) -> None:  # fmt: skip
    """Train V, the auto-encoder of lidar frames."""
    chosen = _recipe("v", lidar, original, recipe, settings, steps=steps, batch=batch, seed=seed)
    _train(chosen, data, out, epochs, resume, stop_after, device, threads, init, source, as_json)


@train_app.command("m")
def m_command(
    data: Annotated[Path, typer.Option("--data", metavar="DIR", help="What navrep-data encode wrote.")],
    out: Out, lidar: Annotated[str | None, typer.Option("--lidar", help="That of V; only checked.")] = None,
    original: Original = False, recipe: RecipeFile = None, steps: Steps = None, epochs: Epochs = None,
    batch: Batch = None, seed: Seed = None, action: Action = None, settings: Settings = None, resume: Resume = False,
    stop_after: StopAfter = None, device: Device = "cpu", threads: Threads = None, init: Init = None,
    encoder: Encoder = None, source: From = None, as_json: Json = False,
    list_settings: ListSettings = False,
) -> None:  # fmt: skip
    """Train M, the memory that predicts codes, on an encoded dataset."""
    from navrep_data.datasets.latents import LatentManifest

    made_by = LatentManifest.read(data).encoder
    if lidar is not None and made_by.get("lidar") != lidar:
        raise ConfigError(f"--lidar is {lidar}, but {data} holds codes of {made_by.get('lidar')}: leave it out.")
    vae: Any = None
    if encoder is not None:  # told before hours are spent
        from navrep_data.train.encode import vae_of
        from navrep_data.train.modular import check_encoder
        from navrep_data.zoo.local import load_any_model

        vae = vae_of(load_any_model(encoder, source), encoder)
        check_encoder(vae, made_by, str(data))
    chosen = _recipe(
        "m", str(made_by.get("lidar")), original, recipe, settings, steps=steps, batch=batch, seed=seed,
        action_alignment=action,
    )  # fmt: skip
    _train(chosen, data, out, epochs, resume, stop_after, device, threads, init, source, as_json)
    if vae is not None:
        from navrep_data.train.modular import join

        say_err(f"V and M joined: {join(vae, out)}")


@train_app.command("joint")
def joint_command(
    data: Data, out: Out, lidar: Lidar = "rings", original: Original = False, recipe: RecipeFile = None,
    steps: Steps = None, epochs: Epochs = None, batch: Batch = None, seed: Seed = None, action: Action = None,
    settings: Settings = None, resume: Resume = False, stop_after: StopAfter = None, device: Device = "cpu",
    threads: Threads = None, init: Init = None, source: From = None, as_json: Json = False,
    list_settings: ListSettings = False,
) -> None:  # fmt: skip
    """Train V and an LSTM together."""
    chosen = _recipe(
        "joint", lidar, original, recipe, settings, steps=steps, batch=batch, seed=seed, action_alignment=action
    )
    _train(chosen, data, out, epochs, resume, stop_after, device, threads, init, source, as_json)


@train_app.command("transformer")
def transformer_command(
    data: Data, out: Out, lidar: Lidar = "rings", original: Original = False, recipe: RecipeFile = None,
    steps: Steps = None, epochs: Epochs = None, batch: Batch = None, seed: Seed = None, action: Action = None,
    settings: Settings = None, resume: Resume = False, stop_after: StopAfter = None, device: Device = "cpu",
    threads: Threads = None, init: Init = None, source: From = None, as_json: Json = False,
    list_settings: ListSettings = False,
) -> None:  # fmt: skip
    """Train V and a causal transformer together."""
    chosen = _recipe(
        "transformer", lidar, original, recipe, settings, steps=steps, batch=batch, seed=seed, action_alignment=action
    )
    _train(chosen, data, out, epochs, resume, stop_after, device, threads, init, source, as_json)


def _recipe(
    model: str, lidar: str, original: bool, file: Path | None, settings: list[str] | None, **changes: Any
) -> Recipe:
    """Return the recipe that the flags ask for: ours, the authors' or a file's, with what is set on top."""
    from navrep_data.train import default_recipe, original_recipe, read_recipe

    if file is not None:
        if original:
            raise ConfigError("--recipe and --original exclude each other: a recipe file says itself what it is.")
        recipe = read_recipe(file, model)
        if (recipe.model, recipe.lidar) != (model, lidar):
            raise ConfigError(
                f"{file} is a recipe for {recipe.model} {recipe.lidar}, expected one for {model} {lidar}."
            )
    else:
        recipe = (original_recipe if original else default_recipe)(model, lidar)
    from navrep_data.train.settings import parse

    return recipe.replace(**changes).replace(**parse(settings or (), recipe.to_dict(), model))


def use_threads(threads: int | None) -> None:
    """Set torch's threads."""
    if threads is not None:
        import torch

        if threads < 1:
            raise ConfigError(f"--threads is {threads}, expected at least 1.")
        torch.set_num_threads(threads)


def check_device(device: str) -> None:
    """Raise unless torch has the device."""
    import torch

    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(
            f"--device {device!r} cannot be used ({reason}), expected cpu, or cuda where there is one."
        ) from None


def _train(
    recipe: Recipe, data: Path, out: Path, epochs: float | None, resume: bool, stop_after: int | None, device: str,
    threads: int | None, init: str | None, source: str | None, as_json: bool,
) -> Trained:  # fmt: skip
    from navrep_data.train import train_world_model
    from navrep_data.train.data import Batches, open_dataset

    use_threads(threads)
    check_device(device)
    if epochs is not None:
        if not 0.0 < epochs <= _MOST_EPOCHS:
            raise ConfigError(f"--epochs is {epochs:g}, expected more than 0, and {_MOST_EPOCHS:,} at most.")
        per_epoch = Batches(open_dataset(data, recipe, "train", False), recipe).per_epoch
        recipe = recipe.replace(steps=max(1, round(epochs * per_epoch)))
    start = None
    if init is not None:
        from navrep_data.zoo.local import load_any_model

        start = load_any_model(init, source)
    done = train_world_model(
        recipe, data, out, resume=resume, stop_after=stop_after, device=device, init=start, progress=show_progress(),
        report=say_err,
    )  # fmt: skip
    if as_json:
        print_json(
            {
                "out": str(out), "step": done.step, "steps": recipe.steps, "frames_per_s": done.frames_per_s,
                "loss": done.losses[-1] if done.losses else None, "validation": done.validation,
            }
        )  # fmt: skip
    else:
        say(f"next: {_next(recipe, data, out)}")
    return done


def _next(recipe: Recipe, data: Path, out: Path) -> str:
    if recipe.model == "v":
        return f"navrep-data encode {data} --model {out} --out LATENTS"
    if recipe.model == "m":
        return f"navrep-data evaluate world-model {out}/world_model --data DIR"
    return f"navrep-data evaluate world-model {out} --data {data} --split val"


Validate = Annotated[
    int | None, typer.Option("--validate-every", help="Steps between validations.", show_default="the recipe's")
]
PpoSteps = Annotated[
    int | None, typer.Option("--steps", help="Steps of all worlds together.", show_default="the recipe's")
]
Env = Annotated[
    str | None,
    typer.Option("--env", help="Environment to train in, such as navrep-train or map.", show_default="navrep-train"),
]
Worlds = Annotated[int | None, typer.Option("--worlds", help="Worlds stepped at once.", show_default="the recipe's")]
PpoBatch = Annotated[int | None, typer.Option("--batch", help="Rows per gradient step.", show_default="the recipe's")]


@train_app.command("controller")
def controller_command(
    world_model: Annotated[str, typer.Option("--world-model", metavar="NAME|DIR", help="What it sees through.")],
    out: Out,
    features: Annotated[str, typer.Option("--features", help="z, h or zh.")] = "z", env: Env = None,
    original: Original = False, steps: PpoSteps = None, worlds: Worlds = None, batch: PpoBatch = None,
    seed: Seed = None, validate_every: Validate = None, settings: Settings = None, init: Init = None,
    resume: Resume = False, stop_after: StopAfter = None, device: Device = "cpu", threads: Threads = None,
    source: From = None, as_json: Json = False,
    list_settings: ListSettings = False,
) -> None:  # fmt: skip
    """Train a controller by PPO on the codes of a frozen world model."""
    from navrep_data.train.encode import vae_of
    from navrep_data.zoo.local import load_any_model

    use_threads(threads)
    check_device(device)
    if features not in ("z", "h", "zh"):
        raise ConfigError(f"--features is {features!r}, expected z, h or zh.")
    model = load_any_model(world_model, source)
    lidar = vae_of(model, world_model).config.lidar
    changes = {"steps": steps, "worlds": worlds, "batch": batch, "seed": seed, "validate_every": validate_every,
               "env": spelled(env, ENVIRONMENTS) or env}  # fmt: skip
    _train_controller(
        features, lidar, original, settings, changes, out, model, world_model, init, resume, stop_after, device, source,
        as_json,
    )  # fmt: skip


@train_app.command("e2e")
def e2e_command(
    out: Out, lidar: Lidar = "rings", env: Env = None, original: Original = False, steps: PpoSteps = None,
    worlds: Worlds = None, batch: PpoBatch = None, seed: Seed = None, validate_every: Validate = None,
    settings: Settings = None, init: Init = None, resume: Resume = False, stop_after: StopAfter = None,
    device: Device = "cpu", threads: Threads = None, source: From = None, as_json: Json = False,
    list_settings: ListSettings = False,
) -> None:  # fmt: skip
    """Train an end-to-end network by PPO."""
    use_threads(threads)
    check_device(device)
    changes = {"steps": steps, "worlds": worlds, "batch": batch, "seed": seed, "validate_every": validate_every,
               "env": spelled(env, ENVIRONMENTS) or env}  # fmt: skip
    _train_controller(
        "e2e", lidar, original, settings, changes, out, None, "", init, resume, stop_after, device, source, as_json
    )


def _train_controller(
    features: str, lidar: str, original: bool, settings: list[str] | None, changes: dict[str, Any], out: Path,
    model: Any, name: str, init: str | None, resume: bool, stop_after: int | None, device: str, source: str | None,
    as_json: bool,
) -> None:  # fmt: skip
    from navrep_data.models import ModularWorldModel
    from navrep_data.train import default_controller_recipe, original_controller_recipe, train_controller
    from navrep_data.train.settings import parse, sim_settings
    from navrep_data.zoo.local import load_any_model

    if original:
        recipe = original_controller_recipe(features, lidar, modular=isinstance(model, ModularWorldModel))
    else:
        recipe = default_controller_recipe(features, lidar)
    # --set has the last word
    given = {name: value for name, value in changes.items() if value is not None}
    worlds = sim_settings()
    found = parse(settings or (), {**worlds, **recipe.to_dict()}, "e2e" if features == "e2e" else "controller")
    sim = {name: value for name, value in found.items() if name in worlds}
    own = {name: value for name, value in found.items() if name not in worlds}
    recipe = recipe.fit_batch(**{**given, **own, "sim": sim})
    start = None if init is None else load_any_model(init, source)
    done = train_controller(
        recipe, out, model=model, model_name=name, init=start, resume=resume, stop_after=stop_after, device=device,
        progress=show_progress(), report=say_err,
    )  # fmt: skip
    if as_json:
        print_json(
            {"out": str(out), "steps": done.steps, "best_validation": done.best, "steps_per_s": done.steps_per_s,
             "held_out": done.held_out}
        )  # fmt: skip
    else:
        say(f"{out}: best of {done.steps:,} steps reaches the goal in {done.best:.1%} of the validation episodes")
