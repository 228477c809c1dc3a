"""Cards of the checkpoints that this project trained, one per checkpoint, made from their records."""

from __future__ import annotations

from typing import Any

from parts_of_cards import front_matter, table, use
from training_stages import earlier_stages, stages_table, supervision

from navrep_data.shards.card import CITATION
from navrep_data.zoo.describe import inputs, quirks, summary
from navrep_data.zoo.measured import episodes, feeding, is_benchmark, played, share
from navrep_data.zoo.names import RELEASED
from navrep_data.zoo.registry import Record, dependants

FIRST_LINE = "Retrained by navrep-data; not the authors' checkpoint."
_MACHINE = ("device", "processor", "cores", "threads", "torch")
_LOOKED = (
    "These episodes chose the weights. The recipe itself was changed after scores on both test suites had been seen: "
    "[docs/experiments.md](../../docs/experiments.md) lists who looked at which episodes when."
)
_BLIND_PEOPLE = (
    "In its training worlds half of the people, drawn by chance, do not see the robot and walk as if it was not there."
)
_BENCHMARK_HEAD = (
    "suite", "physics", "episodes (rounds)", "feeding", "success, contact-free (95 % interval)", "success, as released",
    "`goal` on the same episodes, both", "collision", "timeout", "contacts per km", "command",
)  # fmt: skip
_WORLD_MODEL_HEAD = (
    "split", "rows", "next frame MSE", "standing still", "next goal [m2]", "standing still", "reconstruction MSE",
    "command",
)  # fmt: skip


def results(r: Record) -> str:
    """Return the tables of a record's results, each with command and baseline."""
    scores = [
        (
            x["suite"], x["physics"], episodes(x), feeding(x),
            share(x, "contact_free_rate", interval=True), share(x, "success_rate", interval=True),
            f"{share(x, 'goal_contact_free_rate')} / {share(x, 'goal_success_rate')}",
            share(x, "collision_rate"), share(x, "timeout_rate"), _number(x.get("contacts_per_km")),
            f"`{x['command']}`",
        )
        for x in r.results
        if is_benchmark(x)
    ]  # fmt: skip
    parts = [table(_BENCHMARK_HEAD, scores)] if scores else []
    for x in r.results:
        for key, what in (("per_map_contact_free", "contact-free"), ("per_map", "as released")):
            if key in x:
                shares = ", ".join(f"{name} {value:.1%}" for name, value in x[key].items())
                parts.append(f"Per map, {what} ({played(x)}): {shares}.")
    return "\n\n".join([*parts, *world_model_errors(r)]) or "Not measured yet."


def world_model_errors(r: Record) -> list[str]:
    """Return the table of a record's world-model errors with their dataset, nothing where there are none."""
    errors = [
        (
            x["split"], f"{x['rows']:,}", _number(x["scan_mse"]), _number(x["still_scan_mse"]), _number(x["goal_mse"]),
            _number(x["still_goal_mse"]), _number(x["reconstruction_mse"]), f"`{x['command']}`",
        )
        for x in r.results
        if not is_benchmark(x)
    ]  # fmt: skip
    if not errors:
        return []
    data = sorted({f"{x['data']['name']} (content hash `{x['data']['content_hash'][:16]}`)" for x in r.results
                   if not is_benchmark(x)})  # fmt: skip
    return [table(_WORLD_MODEL_HEAD, errors), f"DIR: {'; '.join(data)}."]


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:.4g}"


def recipe(r: Record) -> str:
    """Return how a checkpoint was trained."""
    t = r.training or {}
    machine = t.get("machine") or {}
    facts: list[tuple[str, Any]] = [
        ("seed", t.get("seed")),
        ("weights are those of step", f"{t['step']:,} of {t['steps']:,}"),
    ]
    facts.append(("time of the steps", _hours(t.get("seconds"))))
    facts.append(("machine", ", ".join(f"{key} {machine[key]}" for key in _MACHINE if key in machine) or None))
    if d := t.get("dataset"):
        facts.append(("dataset", f"{d['name']}, {d['rows']:,} rows, content hash `{d['content_hash']}`"))
    if "selected_on" in t:
        facts.append(("weights chosen on", t["selected_on"]))
    if t.get("validation"):
        facts.append(("validation", ", ".join(f"{key} {value:.4g}" for key, value in t["validation"].items())))
    commands = "\n".join(t["commands"])
    looked = f"\n\n{_LOOKED}" if r.kind == "policy" else ""
    return f"```\n{commands}\n```\n\n{stages_table(r)}\n\n{earlier_stages(r)}{table(('', ''), facts)}{looked}"


def _hours(seconds: float | None) -> str | None:
    return None if seconds is None else f"{seconds / 3600:.2f} h, validation and saving not counted"


def half_precision(r: Record) -> str:
    """Return what storing the weights in half precision costs."""
    cost = (r.training or {})["half_precision"]
    words = [f"Weights are stored as {cost['storage']} and computed with as float32."]
    if "z_change" in cost:
        words.append(
            f"Against the weights as trained, a number of z changes by at most {cost['z_change']:.2g} (its standard "
            f"deviation is {cost['z_spread']:.2g}); the reconstruction error is "
            f"{cost['reconstruction_mse_stored']:.6g} instead of {cost['reconstruction_mse']:.6g}."
        )
    if "action_change" in cost:
        words.append(
            f"Against the weights as trained, an action changes by at most {cost['action_change']:.2g} m/s, by "
            f"{cost['action_change_mean']:.2g} m/s in the mean."
        )
    words.append(f"Measured on {cost['rows']:,} rows of a test split; results are of the stored weights.")
    return " ".join(words)


def own_card(r: Record) -> str:
    """Return the card of a checkpoint as Markdown with the front matter of the Hugging Face Hub.

    Parameters
    ----------
    r : Record
        Of a checkpoint that this project trained.
    """
    users = sorted(d.name for d in dependants(r) if d.name != r.name)
    needs = [f"- {role}: `{name}`" for role, name in r.parts.items()]
    needs += [f"- used by: {', '.join(f'`{name}`' for name in users)}"] if users else []
    files = [(f"`navrep_data/zoo/{f.path}`", f"{f.bytes:,}", f"`{f.sha256}`") for f in r.files]
    sections = {
        "Use": use(r.name, r) + "\n\nThe weights are part of the package: nothing is fetched.",
        "Inputs and outputs": table(("name", "shape", "meaning"), inputs(r))
        + f"\n\nOther lidars: `navrep_data.observations.ScanAdapter`. One row is {r.sensor['dt']:g} s.",
        "Results": results(r),
        "Supervision": supervision(r) + f" {_BLIND_PEOPLE}",
        "Recipe": recipe(r),
        "Half precision": half_precision(r),
        "Files": table(("file", "bytes", "SHA-256"), files),
        "Needs": "\n".join(needs) or "Nothing else.",
        "Known quirks": "\n".join(f"- {text}" for text in [*quirks(r), *r.notes]) or "None known.",
        "Provenance": f"Trained by {r.source['trained_by']}, {r.source['license']} licence. navrep-data is an "
        "independent re-implementation, not made or endorsed by the NavRep authors; their checkpoint is "
        f"`{r.variant}.{RELEASED}`.",
        "Cite": f"```bibtex\n{CITATION}\n```",
    }
    body = "\n\n".join(f"## {title}\n\n{text}" for title, text in sections.items())
    sizes = {"z": r.z_size, "h": r.h_size, "parameters": r.n_parameters}
    facts = ", ".join(f"{key} {value:,}" for key, value in sizes.items() if value is not None)
    head = f"{front_matter(r.name, r)}\n\n# {r.name}\n\n{FIRST_LINE}"
    return f"{head}\n\n{summary(r)} Sizes: {facts}.\n\n{body}\n"
