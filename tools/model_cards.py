"""Write the model cards from the registry: ``python tools/model_cards.py cards/models``.

One per variant for what the authors released, one per checkpoint for what this project trained.

Notes
-----
The cards in the repository are committed; a test checks that they are what this script makes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from own_model_cards import own_card, world_model_errors
from parts_of_cards import front_matter, table, use

from navrep_data.shards.card import CITATION
from navrep_data.zoo.describe import inputs, quirks, summary
from navrep_data.zoo.measured import episodes, feeding, is_benchmark, share
from navrep_data.zoo.names import OWN, RELEASED, RELEASED_RULE, default_tag
from navrep_data.zoo.registry import Record, dependants, records, variants

_FORMATS = {
    "sb2-zip": "stable-baselines 2 zip (its pickled parts are never read)",
    "torch-state-dict": "torch state dict (read with weights_only)",
    "tf-json": "JSON of TensorFlow variables times 10,000",
}


def _ident(r: Record) -> str:
    return "; ".join(f"`{f.id}`" for f in r.files) or "-"


def _whose(variant: str) -> str:
    own = f" Ours: [`{variant}.{OWN}`]({variant}.{OWN}.md)." if f"{variant}.{OWN}" in records() else ""
    return (
        "The NavRep authors' weights, not ours. navrep-data is an independent re-implementation, not made or endorsed "
        f"by the authors; it contains none of their files and fetches them from their repository.{own}"
    )


def _runs_table(runs: Sequence[Record]) -> str:
    rows = []
    for r in runs:
        name = f"**`{r.name}`**" if r.released else f"`{r.name}`"
        paths = "; ".join(f"`{f.path}`" for f in r.files) or "none of its own"
        size = ", ".join("not known" if f.bytes is None else f"{f.bytes:,}" for f in r.files) or "-"
        rows.append((name, r.started, r.saved, paths, size, _ident(r)))
    return table(("run", "started", "written", "file", "bytes", "checked by"), rows)


def _results(runs: Sequence[Record]) -> str:
    rows = [
        (f"`{r.name}`", x["suite"], x["physics"], episodes(x), feeding(x), share(x, "contact_free_rate"),
         share(x, "success_rate"), f"{share(x, 'goal_contact_free_rate')} / {share(x, 'goal_success_rate')}",
         f"`{x['command']}`")
        for r in runs
        for x in r.results
        if is_benchmark(x)
    ]  # fmt: skip
    errors = [text for r in runs for text in world_model_errors(r)]
    if not rows:
        return "\n\n".join(errors) or "Not measured yet."
    head = ("run", "suite", "physics", "episodes (rounds)", "feeding", "success, contact-free", "success, as released")
    scores = table((*head, "`goal` on the same episodes, both", "command"), rows)
    return "\n\n".join([scores, *errors])


def _parts(runs: Sequence[Record]) -> str:
    r = runs[-1]
    lines = [f"- {role}: `{name}`" for role, name in r.parts.items()]
    if r.kind in ("world_model", "vae", "memory"):
        users = sorted({d.variant for run in runs for d in dependants(run)})
        lines.append("- used by: " + ", ".join(f"`{name}`" for name in users))
    return "\n".join(lines) or "Nothing else."


def card(variant: str) -> str:
    """Return the card of a variant as Markdown with the front matter of the Hugging Face Hub.

    Parameters
    ----------
    variant : str
        Name without tag.
    """
    runs = [run for run in variants()[variant] if not run.ours]
    r = next((run for run in runs if run.released), runs[-1])
    untagged = f"`{variant}.{default_tag(variant)}`"
    if default_tag(variant) == OWN and f"{variant}.{OWN}" not in records():
        untagged += ", which this version does not contain"
    notes = [f"`{run.name}`: {note}" for run in runs for note in run.notes]
    one = f"`{variant}.{RELEASED}` is {r.released_rule}." if len(runs) == 1 else (
        f"`{variant}.{RELEASED}` is `{r.name}`. {RELEASED_RULE}"
    )  # fmt: skip
    formats = sorted({_FORMATS[run.format] for run in runs if run.format})
    sections = {
        "Use": use(f"{variant}.{RELEASED}", r),
        "Inputs and outputs": table(("name", "shape", "meaning"), inputs(r))
        + "\n\nOther lidars: `navrep_data.observations.ScanAdapter`. One row is "
        + f"{r.sensor['dt']:g} s.",
        "Runs": f"{_runs_table(runs)}\n\n{one} The untagged name `{variant}` is {untagged}.",
        "Needs": _parts(runs),
        "Results": _results(runs),
        "Known quirks": "\n".join(f"- {text}" for text in [*quirks(r), *notes]) or "None known.",
        "Provenance": f"{r.source['repository']} at commit `{r.source['commit']}`, {r.source['license']} licence, "
        f"{r.source['copyright']}."
        + (f" The authors call the network `{r.source['backend']}`" if r.source["backend"] else "")
        + (f", the features `{r.source['encoding']}`" if r.source["backend"] and r.source["encoding"] else "")
        + ("." if r.source["backend"] else "")
        + (f" Format: {'; '.join(formats)}." if formats else ""),
        "Cite": f"```bibtex\n{CITATION}\n```",
    }
    sizes = {"z": r.z_size, "h": r.h_size, "parameters stored": r.n_parameters}
    facts = ", ".join(f"{key} {value:,}" for key, value in sizes.items() if value is not None)
    body = "\n\n".join(f"## {title}\n\n{text}" for title, text in sections.items())
    head = f"{front_matter(variant, r)}\n\n# {variant}\n\n{_whose(variant)}"
    return f"{head}\n\n{summary(r)} Sizes: {facts}.\n\n{body}\n"


def write_cards(folder: Path) -> list[Path]:
    """Write all cards into `folder`, and remove those of what is no more.

    Returns
    -------
    list of pathlib.Path
        The files, sorted.
    """
    folder.mkdir(parents=True, exist_ok=True)
    texts = {f"{variant}.md": card(variant) for variant in variants()}
    texts |= {f"{r.name}.md": own_card(r) for r in records().values() if r.ours}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    for path in {path for path in folder.glob("*.md") if path.name not in texts}:
        path.unlink()
    return sorted(folder / name for name in texts)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("Expected one folder: python tools/model_cards.py cards/models")
    for written in write_cards(Path(sys.argv[1])):
        print(written)
