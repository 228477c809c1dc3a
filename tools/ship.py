"""From a training's output folder to weights in this package: for its developers, in a checkout.

``python tools/ship.py weights models/transformer_rings --as transformer_rings --data DIR`` writes
``zoo/weights/NAME/`` in half precision and the record ``zoo/records/NAME.json``, and fills in time and machine of the
recipe. ``python tools/ship.py results NAME --results DIR`` then adds to the record what ``navrep-data
benchmark`` and ``navrep-data evaluate world-model --out`` measured of the shipped weights. Cards come last:
``python tools/model_cards.py cards/models``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from navrep_data.errors import CheckpointError, ConfigError
from navrep_data.io import atomic_write_bytes, atomic_write_json, read_json, sha256_file
from navrep_data.models import EndToEnd, WorldModel, checkpoint
from navrep_data.models.vae import n_parameters
from navrep_data.schema import SensorContract
from navrep_data.train import state
from navrep_data.train.half import Rounding, rounding
from navrep_data.train.logs import read_log
from navrep_data.train.modular import WORLD_MODEL
from navrep_data.zoo import measured, registry
from navrep_data.zoo.local import PARTS, POLICY_FILE, load_policy
from navrep_data.zoo.names import OWN, SHIPPED_BYTES, UNTAGGED_ARE_OURS
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.registry import Record, RecordFile

RECIPES = Path(state.__file__).parent / "recipes"
STORAGE = "float16"
_MAX_JSON = 1 << 20
# What the metadata of a checkpoint keeps beside its weights; everything else is in the record.
_KEPT = ("note", "trained_by", "recipe", "dataset", "step")


@dataclass(frozen=True)
class _Training:
    """An output folder, read."""

    folder: Path
    model: WorldModel | None
    policy: Policy | None
    metadata: dict[str, Any]
    step: int
    seconds: float


def ship(
    folder: Path | str,
    variant: str,
    data: Path | str,
    *,
    commands: Sequence[str] = (),
    before: Sequence[Path | str] = (),
    world_model: str | None = None,
    root: Path | None = None,
    recipes: Path = RECIPES,
) -> Record:
    """Put a training's weights into the package, in half precision, with their record.

    Parameters
    ----------
    folder : path-like
        What ``navrep-data train joint|transformer|m|controller|e2e`` wrote; for m, V and M joined in its
        ``world_model/`` are shipped.
    variant : str
        Name without tag, such as ``transformer_rings_z``; the tag is ``.v1``.
    data : path-like
        Dataset on whose test split the cost of half precision is measured.
    commands : sequence of str
        The command lines that made it, first to last; those of the variant's recipe file if left out.
    before : sequence of path-like
        Output folders of trainings that came before, whose time counts too: V's for modular models, earlier stages that
        ``--init`` went on from.
    world_model : str, optional
        Full name of the shipped world model that a controller sees through; by the variant's name if left out.
    root : pathlib.Path, optional
        Folder with ``records`` and ``weights``: :data:`navrep_data.zoo.registry.FOLDER` if left out.
    recipes : pathlib.Path
        Folder with the recipe files.

    Returns
    -------
    Record
        As written.

    Raises
    ------
    CheckpointError
        If the folder holds no finished training, or another than the variant's.
    ConfigError
        If the settings are not those of the recipe and no commands are given, or the package would hold too much.
    """
    root = registry.FOLDER if root is None else root
    training = _read(Path(folder))
    _check_variant(variant, training)
    recipe = _recipe(recipes / f"{variant}.json", variant, training, commands, [_read_stage(Path(f)) for f in before])
    parts = _parts(variant, training, world_model)
    name = f"{variant}.{OWN}"
    target = root / registry.WEIGHTS / name
    network: Any = training.policy.network if training.policy is not None else training.model
    kept = {key: training.metadata[key] for key in _KEPT if key in training.metadata}
    others = (path for path in (root / registry.WEIGHTS).rglob("*") if path.is_file() and target not in path.parents)
    total = sum(path.stat().st_size for path in others)
    with tempfile.TemporaryDirectory() as made:  # what is shipped stays as it is until all checks have passed
        new = Path(made) / name
        checkpoint.save(network, new, kept, storage=STORAGE)
        files = tuple(
            RecordFile(f"{registry.WEIGHTS}/{name}/{path.name}", path.stat().st_size, sha256_file(path), None)
            for path in checkpoint.paths(new)
        )
        total += sum(file.bytes or 0 for file in files)
        if total > SHIPPED_BYTES:
            raise ConfigError(
                f"The shipped weights take {total:,} bytes with {name}, expected {SHIPPED_BYTES:,} at most."
            )
        reference: Any = training.policy or training.model
        cost = rounding(reference, _rounded(training, new, root, parts), Path(data))
        record = _record(variant, training, parts, files, recipe, cost)
        target.mkdir(parents=True, exist_ok=True)
        for path in checkpoint.paths(new):
            atomic_write_bytes(target / path.name, path.read_bytes())
    atomic_write_json(root / registry.RECORDS / f"{name}.json", record.to_dict())
    atomic_write_json(recipes / f"{variant}.json", recipe)
    for cached in (registry.records, registry.variants, registry.full_names):
        cached.cache_clear()
    return record


# --- reading a training --------------------------------------------------------------------------------------------


def _read_stage(folder: Path) -> _Training:
    """Read an output folder without its networks: what counts of a stage before is what it did."""
    progress = folder / state.PROGRESS_FILE
    if not progress.is_file():
        raise CheckpointError(f"{folder} holds no training, expected {progress.name}: what navrep-data train wrote.")
    last = state.last_folder(folder)
    assert last is not None
    seconds = float(read_json(last / "training.json", _MAX_JSON)["seconds"])
    step = int(read_json(progress, _MAX_JSON)["step"])
    return _Training(folder, None, None, checkpoint.read_config(folder)["metadata"], step, seconds)


def _read(folder: Path) -> _Training:
    stage = _read_stage(folder)
    metadata, step, seconds = stage.metadata, stage.step, stage.seconds
    if (folder / POLICY_FILE).is_file():
        policy = load_policy(folder)
        end_to_end = isinstance(policy.network, EndToEnd)
        model = None if end_to_end else _world_model(folder / PARTS)
        return _Training(folder, model, policy, metadata, step, seconds)
    joined = folder / WORLD_MODEL
    whole = joined if (joined / checkpoint.CONFIG_NAME).is_file() else folder
    return _Training(folder, _world_model(whole), None, metadata, step, seconds)


def _world_model(folder: Path) -> WorldModel:
    found = checkpoint.load(folder)
    if not isinstance(found, WorldModel):
        raise CheckpointError(
            f"{folder} holds a {type(found).__name__} alone, expected a world model: V and M are joined by "
            "navrep-data train m --v DIR."
        )
    return found


def _check_variant(variant: str, training: _Training) -> None:
    """Raise unless a training is of the architecture, lidar and features that a name promises."""
    policy, model = training.policy, training.model
    lidar = policy.lidar if policy is not None else model.lidar if model is not None else ""
    features = f"_{policy.features}" if policy is not None and policy.features else ""
    kind = "e2e" if model is None else str(model.config.kind)
    if variant != f"{kind}_{lidar}{features}":
        raise CheckpointError(f"{training.folder} holds a {kind}_{lidar}{features}, expected a {variant}: mixed up.")


def _recipe(
    path: Path, variant: str, training: _Training, commands: Sequence[str], before: Sequence[_Training]
) -> dict[str, Any]:
    """Return the recipe file of a variant with the training's settings, time and machine."""
    found: Any = read_json(path, _MAX_JSON) if path.is_file() else {"name": f"{variant}.{OWN}", "commands": []}
    used = training.metadata["recipe"]
    earlier = [t.metadata["recipe"] for t in before]
    modular = training.policy is None and training.model is not None and training.model.config.kind == "modular"
    settings = used
    if modular:  # V, the last one before, and M are two trainings of one recipe
        last = max((i for i, recipe in enumerate(earlier) if recipe.get("model") == "v"), default=None)
        settings = used if last is None else {"v": earlier.pop(last), "m": used}
    if not commands and found.get("settings") != settings:
        old = found.get("settings") or {}
        other = sorted(k for k in {*old, *settings} if old.get(k) != settings.get(k))
        raise ConfigError(
            f"{training.folder} was trained with other settings than {path.name} has ({', '.join(other)}): say by "
            "which commands (--command, once for each), so that the recipe is what was done."
        )
    times = [t.seconds for t in (*before, training)]
    return {
        **{name: value for name, value in found.items() if name != "stages_before"},  # of what was shipped before
        "commands": list(commands) or found["commands"],
        "settings": settings,
        **({"stages_before": earlier} if earlier else {}),
        "wall_time_s": round(sum(times)),
        "machine": training.metadata.get("machine"),
        "notes": "Commands in order; settings are those that the training command takes from them. Seeds fixed. The "
        "time is that of the steps: validation, pictures and saving are not counted.",
    }


def _parts(variant: str, training: _Training, world_model: str | None) -> dict[str, str]:
    """Return what a controller sees through, after checking that the shipped one is what it was trained on."""
    if training.policy is None or training.model is None:
        return {}
    name = world_model or f"{variant.rsplit('_', 1)[0]}.{OWN}"
    shipped = registry.records().get(name)
    if shipped is None:
        raise CheckpointError(f"{variant} sees through {name}, which is not shipped: ship that first.")
    path = registry.FOLDER / shipped.files[0].path
    theirs, mine = checkpoint.load(path).state_dict(), training.model.state_dict()
    if training.policy.features == "z":  # whose memory plays no part
        theirs, mine = ({k: v for k, v in all_.items() if k.startswith("vae.")} for all_ in (theirs, mine))
    if theirs.keys() != mine.keys() or any(not torch.equal(t, mine[k].half().float()) for k, t in theirs.items()):
        raise CheckpointError(
            f"{training.folder} was trained through another world model than {name}: name the right one with "
            "--world-model, or ship it again."
        )
    return {"world_model": name}


def _rounded(training: _Training, target: Path, root: Path, parts: dict[str, str]) -> Any:
    """Return what users will load: everything as stored."""
    network: Any = checkpoint.load(target)
    if training.policy is None:
        return network
    p = training.policy
    model = _world_model(root / registry.WEIGHTS / parts["world_model"]) if parts else None
    memory = model if p.world_model is not None else None
    vae = None if model is None else model.vae
    return Policy(network, p.features, p.lidar, vae, memory, context=p.context, sensor=p.sensor)


# --- the record ----------------------------------------------------------------------------------------------------


def _record(
    variant: str, training: _Training, parts: dict[str, str], files: tuple[RecordFile, ...], recipe: dict[str, Any],
    cost: Rounding,
) -> Record:  # fmt: skip
    policy, model = training.policy, training.model
    lidar = policy.lidar if policy is not None else model.lidar if model is not None else None
    remembers = model is not None and (policy is None or policy.world_model is not None)
    e2e = policy is not None and policy.features is None
    network: Any = policy.network if policy is not None else model
    return Record(
        name=f"{variant}.{OWN}", variant=variant, tag=OWN, released=False, released_rule="trained by navrep-data",
        kind="policy" if policy is not None else "world_model",
        architecture=variant.split("_")[0], network=None, lidar=lidar,
        features=None if policy is None else policy.features,
        z_size=None if model is None else model.z_size, h_size=None if model is None else model.h_size,
        n_inputs=None if policy is None else policy.n_inputs, n_parameters=n_parameters(network),
        sensor=SensorContract().to_dict(),
        preprocessing={
            "scan": "rings" if lidar == "rings" else "metres" if e2e else "over_25",
            "zero_first_bin": lidar == "rings" and not e2e,
        },
        action_alignment=model.config.action_alignment if model is not None and remembers else None,
        context_rule=_context(policy, model) if model is not None and remembers else None,
        parts=parts, format="safetensors", files=files,
        source={"trained_by": training.metadata["trained_by"], "license": "MIT"},
        started=None, saved=None, golden=(), notes=(), results=(),
        training=_provenance(training, recipe, cost),
    )  # fmt: skip


def _context(policy: Policy | None, model: WorldModel) -> str:
    if model.default_context == "carried-state":
        return "carried-state"
    return (policy.context if policy is not None else None) or "newest-32"


def _provenance(training: _Training, recipe: dict[str, Any], cost: Rounding) -> dict[str, Any]:
    metadata = training.metadata
    found = {
        "commands": recipe["commands"],
        "settings": recipe["settings"],
        **({"stages_before": recipe["stages_before"]} if "stages_before" in recipe else {}),
        "seed": metadata["recipe"]["seed"],
        "step": metadata["step"],
        "steps": training.step,
        "seconds": recipe["wall_time_s"],
        "machine": recipe["machine"],
        "half_precision": cost.to_dict(),
    }
    if "dataset" in metadata:
        keys = ("name", "repo", "revision", "content_hash", "env", "physics", "seed", "sequences", "rows")
        found["dataset"] = {k: metadata["dataset"][k] for k in keys if k in metadata["dataset"]}
        found["validation"] = metadata.get("validation")
    if "selected_on" in metadata:
        found["selected_on"] = metadata["selected_on"]
        found["curve"] = [
            [int(r["step"]), round(float(r["val_success"]), 4)] for r in read_log(training.folder) if "val_success" in r
        ]
    return found


def add_results(name: str, results: Path | str, *, root: Path | None = None) -> Record:
    """Put into a record what was measured of its weights.

    Parameters
    ----------
    name : str
        Full name of a shipped checkpoint.
    results : path-like
        Folder that ``navrep-data benchmark --out`` and ``navrep-data evaluate world-model --out`` wrote into.
    root : pathlib.Path, optional
        As for :func:`ship`.

    Returns
    -------
    Record
        As written; what the folder has replaces earlier results of the same suite, physics and first round that were
        fed in the same way, and stands beside all others.

    Raises
    ------
    ConfigError
        If the folder has nothing of this checkpoint.
    CorruptDataError
        If results are of other weights.
    """
    from navrep_data.evaluate.sources import benchmark_entries, world_model_entries

    root = registry.FOLDER if root is None else root
    record = registry.find(name)
    found = [*benchmark_entries(Path(results), record), *world_model_entries(Path(results), record)]
    if not found:
        raise ConfigError(
            f"{results} has no results of {record.name}: run navrep-data benchmark {record.name} --out DIR"
        )
    path = root / registry.RECORDS / f"{record.name}.json"
    atomic_write_json(path, {**record.to_dict(), "results": measured.merged(record.results, found)})
    for cached in (registry.records, registry.variants, registry.full_names):
        cached.cache_clear()
    return registry.find(name)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    import argparse

    parser = argparse.ArgumentParser(prog="python tools/ship.py", description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    weights = verbs.add_parser("weights", help="a training's folder -> weights, record, recipe")
    weights.add_argument("folder", type=Path)
    weights.add_argument("--as", dest="variant", required=True, metavar="VARIANT")
    weights.add_argument("--data", type=Path, required=True, help="dataset for the cost of half precision")
    weights.add_argument("--command", action="append", default=[], help="a command that made it; once for each")
    weights.add_argument("--before", type=Path, action="append", default=[], help="V's folder, or an earlier stage's")
    weights.add_argument("--world-model", metavar="NAME")
    results = verbs.add_parser("results", help="what was measured -> record")
    results.add_argument("name")
    results.add_argument("--results", type=Path, required=True)
    given = parser.parse_args(arguments)
    if given.verb == "weights":
        record = ship(
            given.folder, given.variant, given.data, commands=given.command, before=given.before,
            world_model=given.world_model,
        )  # fmt: skip
        print(f"{record.name}: {sum(f.bytes or 0 for f in record.files):,} bytes; half precision costs")
        for key, value in (record.training or {})["half_precision"].items():
            print(f"  {key}: {value}")
        if record.variant not in UNTAGGED_ARE_OURS:
            print(f"{record.variant} still means the authors' weights: add it to UNTAGGED_ARE_OURS in zoo/names.py")
    else:
        record = add_results(given.name, given.results)
        for entry in record.results:
            print(entry)
    print("next: python tools/model_cards.py cards/models")


if __name__ == "__main__":
    main()
