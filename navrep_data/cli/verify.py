"""``navrep-data verify``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from navrep_data.cli._common import print_json, say, show_progress


def verify_command(
    root: Annotated[Path, typer.Argument(metavar="DIR", help="Dataset folder.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Check every file of a dataset: hashes, schema, index, ranges, rings. Exits 1 if anything is wrong."""
    from tqdm import tqdm

    from navrep_data.shards import verify

    with tqdm(unit="shard", disable=not show_progress()) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        report = verify(root, progress=show)
    if as_json:
        print_json(report.to_dict())
    else:
        for problem in report.problems:
            say(f"{problem.file}: {problem.what}")
        files = f"{report.files} files, {report.rows:,} rows"
        say(f"{root}: {files}, all well" if report.ok else f"{root}: {files}, {len(report.problems)} problems")
    if not report.ok:
        raise typer.Exit(1)
