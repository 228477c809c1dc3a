"""``navrep-data models``: list, show, fetch, verify and convert checkpoints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from navrep_data.cli._common import print_json, say, say_err, show_progress
from navrep_data.errors import ConfigError, NavrepDataError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from navrep_data.zoo import Record, Report
    from navrep_data.zoo.verification import Check

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
From = Annotated[
    str | None,
    typer.Option("--from", metavar="DIR", help="Folder with the authors' files (or https://, hf://user/name)."),
]
Name = Annotated[str | None, typer.Argument(metavar="[NAME]", help="Model, variant or wildcards.")]
All = Annotated[bool, typer.Option("--all", help="Every checkpoint.")]


class _VerbOrPattern(typer.core.TyperGroup):
    """Takes ``models show NAME`` as a verb and ``models '*rings*'`` as a pattern for the list."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in self.commands:
            args = ["list", *args]
        return super().resolve_command(ctx, args)

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        if not any(not a.startswith("-") for a in args) and not {"-h", "--help"} & set(args):
            args = ["list", *args]
        return super().parse_args(ctx, args)


models_app = typer.Typer(
    cls=_VerbOrPattern,
    help="List checkpoints, released ones and our own ([PATTERN]..., --json), or show, fetch, verify, convert them.",
    subcommand_metavar="[PATTERN]... | VERB [ARGS]...",
)


@models_app.command("list", hidden=True)
def list_command(
    patterns: Annotated[
        list[str] | None, typer.Argument(metavar="[PATTERN]...", help="Names, variants or wildcards.")
    ] = None,
    as_json: Json = False,
) -> None:
    """List checkpoints, those in the package first: kind, lidar, size, scores, whether it is on this machine.

    A score is the share of episodes without a contact, and in brackets that which the suite counts as success. One
    with * is of a network that was fed in another way than by default; models show NAME says how.
    """
    from navrep_data.zoo.fetching import Source, missing_here
    from navrep_data.zoo.names import default_tag
    from navrep_data.zoo.registry import find, list_models

    where = Source.of(None)
    found: dict[str, Record] = {}
    for pattern in patterns or ["*"]:
        fitting = {find(name).name: find(name) for name in list_models(pattern)}
        if not fitting:
            raise ConfigError(f"No model matches {pattern!r}. List all: navrep-data models")
        found |= fitting
    chosen = dict(sorted(found.items(), key=lambda item: not item[1].shipped))
    absent = {name: [entry.path for _, entry in missing_here(r, where)] for name, r in chosen.items()}
    if as_json:
        print_json([{**r.to_dict(), "here": not absent[name], "not_here": absent[name]} for name, r in chosen.items()])
        return
    width = max(map(len, chosen))
    suites = ("navreptest", "navrep27")
    say(f"{'name':{width}}  {'kind':11}  {'lidar':5}  {'size':>7}  {'  '.join(f'{s:>14}' for s in suites)}  here")
    for name, r in chosen.items():
        marks = "yes" if not absent[name] else f"no ({len(absent[name])} to fetch)"
        star = f"  = {r.variant}.released" if r.released and r.tag != "released" else ""
        if r.ours:
            star = f"  = {r.variant}, ours" if default_tag(r.variant) == r.tag else "  ours"
        scores = "  ".join(f"{_score(r.results, suite):>14}" for suite in suites)
        say(f"{name:{width}}  {r.kind:11}  {r.lidar or '-':5}  {_size(r):>7}  {scores}  {marks}{star}")
    say_err(
        "scores: episodes without a contact, and as released in brackets; '-' = not measured, '*' = fed in another way "
        "than by default: navrep-data models show NAME"
    )


def _size(record: Record) -> str:
    """Return the size of a checkpoint's own files; those of its parts are listed with them."""
    sizes = [entry.bytes for entry in record.files]
    known = [size for size in sizes if size is not None]
    return f"{sum(known) / 1e6:.2f} MB" if known and len(known) == len(sizes) else "-"


def _score(results: Sequence[dict[str, Any]], suite: str) -> str:
    """Return success in a suite's default physics and rounds, without contacts and as released.

    A network that was never fed by default has that of another way of feeding, marked by ``*``.
    """
    from navrep_data.zoo.measured import main_result, other_result

    mine = main_result(results, suite, "original")
    mark = "" if mine is not None else "*"
    mine = other_result(results, suite, "original") if mine is None else mine
    if mine is None:
        return "-"
    free, released = (mine.get(key) for key in ("contact_free_rate", "success_rate"))
    share = "-" if free is None else f"{100 * free:.1f}"
    return share + ("" if released is None else f" ({100 * released:.1f}) %") + mark


@models_app.command("show")
def show_command(name: Annotated[str, typer.Argument(metavar="NAME|DIR")], as_json: Json = False) -> None:
    """Show what is known of a checkpoint: files, sizes, sensor, quirks, results; of a folder, what its JSON says."""
    from navrep_data.zoo import show
    from navrep_data.zoo.describe import describe
    from navrep_data.zoo.fetching import Source, missing_here
    from navrep_data.zoo.folders import place_of

    place = place_of(name)
    if place is not None:
        from navrep_data.zoo.local import described

        found = described(place)
        if as_json:
            print_json(found)
        else:
            for key, value in found.items():
                say(f"{key}: {value if isinstance(value, str) else json.dumps(value)}")
        return
    record = show(name)
    absent = [entry.path for _, entry in missing_here(record, Source.of(None))]
    if as_json:
        print_json({**record.to_dict(), "here": not absent, "not_here": absent})
        return
    for line in describe(record):
        say(line)
    say(f"here: {'yes' if not absent else 'no; to fetch: ' + ', '.join(absent)}")


def _asked(name: str | None, every: bool, verb: str) -> str:
    if (name is None) == (not every):
        raise ConfigError(f"Expected either NAME or --all: navrep-data models {verb} NAME, or --all.")
    return name if name is not None else "*"


@models_app.command("fetch")
def fetch_command(name: Name = None, every: All = False, source: From = None, as_json: Json = False) -> None:
    """Bring checkpoints, and the parts they need, to this machine. Exits 1 if one of several cannot be had."""
    from navrep_data.zoo.fetching import Source, get_file
    from navrep_data.zoo.registry import find, list_models, with_parts

    where = Source.of(source)
    pattern = _asked(name, every, "fetch")
    chosen = {r.name: r for n in list_models(pattern) for r in with_parts(find(n))}
    if not chosen:
        raise ConfigError(f"No model matches {pattern!r}. List all: navrep-data models")
    files: dict[str, str] = {}
    problems: list[str] = []
    for record in chosen.values():
        for entry in record.files:
            try:
                files[entry.path] = str(get_file(record, entry, where, progress=show_progress()))
            except NavrepDataError as error:
                if len(chosen) == 1:
                    raise
                problems.append(str(error))
    if as_json:
        print_json({"files": files, "problems": problems})
    else:
        for path in files.values():
            say(path)
        for problem in problems:
            say_err(f"Error: {problem}")
    if problems:
        raise typer.Exit(1)


@models_app.command("verify")
def verify_command(
    name: Name = None,
    every: All = False,
    golden: Annotated[
        Path | None, typer.Option("--golden", metavar="DIR", help="More outputs of the original software to compare.")
    ] = None,
    source: From = None,
    as_json: Json = False,
) -> None:
    """Check hashes, load each checkpoint, compare its outputs with recorded ones. Asks no network.

    Exits 1 if anything is wrong, or if a checkpoint asked for by name is missing; with --all what is missing is listed.
    """
    from tqdm import tqdm

    from navrep_data.zoo import verify

    pattern = _asked(name, every, "verify")
    with tqdm(unit="checkpoint", disable=not show_progress()) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        report = verify(pattern, golden, source, progress=show)
    if not report.checks:
        raise ConfigError(f"No model matches {pattern!r}. List all: navrep-data models")
    if as_json:
        print_json(report.to_dict())
    else:
        for line in _report_lines(report):
            say(line)
    if not report.ok or (not every and report.having("missing")):
        raise typer.Exit(1)


def _report_lines(report: Report) -> list[str]:
    from navrep_data.zoo.registry import dependants, records

    lines = []
    for check in report.checks:
        lines.append(f"{check.status:8}{check.name}{_compared(check)}")
        for problem in check.problems:
            waiting = len(dependants(records()[check.name])) if check.status == "missing" else 0
            lines.append(f"        {problem}" + (f"; {waiting} policies need it" if waiting else ""))
        lines += [f"        {name} is not in the golden folder" for name in check.not_compared]
    ok, missing, wrong = (len(report.having(status)) for status in ("ok", "missing", "wrong"))
    outputs = [c for check in report.checks for c in check.comparisons]
    end = f"; {sum(c.ok for c in outputs)} of {len(outputs)} golden outputs within tolerance" if outputs else ""
    lines.append(f"{len(report.checks)} checkpoints: {ok} right, {missing} missing, {wrong} wrong{end}")
    return lines + _depend_lines(report)


def _compared(check: Check) -> str:
    """Say how many outputs were compared, and whose."""
    outputs = [c for c in check.comparisons if not c.output.startswith("weights")]
    theirs = sum(c.original for c in outputs)
    ours = len(outputs) - theirs
    if check.status != "ok":
        return ""
    said = f", {theirs} outputs of the original software" if theirs else ""
    said += f", {ours} outputs that navrep-data recorded" if ours else ""
    return said or ", no outputs of it are known"


def _depend_lines(report: Report) -> list[str]:
    """Say which policies cannot run, and why."""
    from navrep_data.zoo.registry import records

    waiting = [c for c in report.checks if c.needs]
    unknown = [name for name in report.cannot_run if records()[name].kind == "controller"]
    if not report.cannot_run:
        return []
    parts = sorted({part for c in waiting for part in c.needs})
    lines = [f"{len(report.cannot_run)} policies depend on files that are not here and cannot run:"]
    if waiting:
        lines.append(f"  {len(waiting)} need one or two of {', '.join(parts)}")
    lines += [
        f"  {name} was trained on a transformer that cannot be told: it loads as a bare controller" for name in unknown
    ]
    return lines


@models_app.command("convert")
def convert_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The authors' JSON, torch or stable-baselines 2 file.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="FILE.safetensors or a folder.", show_default="./NAME.safetensors")
    ] = None,
    as_json: Json = False,
) -> None:
    """Convert one of the authors' files to safetensors and a JSON config; nothing is unpickled."""
    if not file.is_file():
        raise ConfigError(f"{file} is not a file, expected one that NavRep released: check the path.")
    target = Path(f"{file.stem}.safetensors") if out is None else out
    if target.exists() and (target.is_file() or any(target.iterdir())):
        raise ConfigError(f"{target} exists already and is not overwritten: choose another with --out.")
    from navrep_data.io import sha256_file
    from navrep_data.models import checkpoint
    from navrep_data.zoo.importers import load_any

    module = load_any(file)
    written = checkpoint.save(module, target, {"converted_from": file.name, "sha256": sha256_file(file)})
    found = {"file": str(file), "out": str(written), "config": checkpoint.read_config(target)}
    if as_json:
        print_json(found)
    else:
        say(f"{file} -> {written}")
