"""``navrep-data verify``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from navrep_data.cli._common import print_json, progress_bar, say


def verify_command(
    root: Annotated[Path, typer.Argument(metavar="DIR", help="Dataset folder.")],
    regenerate: Annotated[
        int | None, typer.Option("--regenerate", metavar="K", help="Simulate K random sequences again and compare.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Which sequences.", show_default="random")] = None,
    maps: Annotated[
        list[str] | None,
        typer.Option("--map", help="With --regenerate: where the dataset's own map is now; may be repeated."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Check every file of a dataset: hashes, schema, index, ranges, rings. Exits 2 if anything is wrong."""
    from navrep_data.shards import verify

    with progress_bar("shard") as show:
        report = verify(root, progress=show)
    again = None
    if regenerate is not None and report.ok:
        from navrep_data.generate import regenerate as make_again

        again = make_again(root, regenerate, seed, maps or ())
    if as_json:
        print_json({**report.to_dict(), **({"regenerated": again.to_dict()} if again else {})})
    else:
        for problem in report.problems:
            say(f"{problem.file}: {problem.what}")
        files = f"{report.files} files, {report.rows:,} rows"
        say(f"{root}: {files}, all well" if report.ok else f"{root}: {files}, {len(report.problems)} problems")
        for c in again.comparisons if again else []:
            detail = f" ({c.values:,} values differ, by at most {c.largest:.3g})" if c.values else ""
            say(f"sequence {c.sequence} made again: {c.verdict}{detail}")
    if not report.ok or (again is not None and not again.ok):
        raise typer.Exit(2)
