"""``navrep-data info``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from navrep_data.cli._common import print_json, say


def info_command(
    root: Annotated[Path, typer.Argument(metavar="DIR", help="Dataset folder.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Tell what a dataset holds: settings, size, splits, outcomes, statistics."""
    from navrep_data.shards import info

    found = info(root)
    if as_json:
        print_json(found)
    else:
        _print_info(root, found)


def _print_info(root: Path, found: dict[str, Any]) -> None:
    whole = found["partial"]
    if whole is not None:
        state = f"partial: {found['shards']} of {whole['shards']} shards, {found['sequences']} of {whole['sequences']}"
        state += " sequences"
    else:
        state = "complete" if found["complete"] else f"unfinished: {found['sequences']} of {found['planned']} sequences"
    say(f"{root}: {found['env']}, {found['physics']} physics, seed {found['seed']} ({state})")
    say(
        f"{found['sequences']:,} sequences, {found['rows']:,} rows in {found['shards']} shards, "
        f"{found['bytes'] / 1e6:,.1f} MB ({found['bytes_per_row'] / 1e3:.2f} kB/row)"
    )
    origin = found["origin"]
    if origin is not None:
        say(f"from: {origin['repo']} at commit {origin['commit']} ({origin['endpoint']})")
    for record in found["source"] or ():
        say(f"made out of: {record.get('name', 'a dataset')}, content {record['content_hash']}")
    say(f"content: {found['content_hash']}" + (f", licence {found['license']}" if found["license"] else ""))
    say("splits: " + ", ".join(f"{name} {count}" for name, count in found["splits"].items()))
    say("columns: " + ", ".join(found["columns"]))
    episodes = max(1, sum(o["episodes"] for o in found["outcomes"].values()))
    for name, outcome in found["outcomes"].items():
        if outcome["episodes"]:
            share = 100 * outcome["episodes"] / episodes
            say(
                f"  {name:20s} {outcome['episodes']:7,d} episodes {share:5.1f} %, "
                f"mean length {outcome['mean_length']:.1f} steps"
            )
    say("versions: " + ", ".join(f"{name} {value}" for name, value in found["versions"].items()))
    say(f"next: navrep-data verify {root}")
