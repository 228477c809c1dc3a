"""``navrep-data doctor``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from navrep_data.cli._common import print_json, say, show_progress


def doctor_command(
    root: Annotated[
        Path | None,
        typer.Argument(metavar="[DIR]", help="Dataset folder.", show_default="check the installation"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Check this installation, or a dataset beyond what `verify` does. Exits 1 if anything is wrong.

    Without DIR: versions, compiled kernels, folders, disk, optional parts. With DIR: all that `verify` checks, rows
    that are in two splits, and sensors, goals, motion and resets that do not fit each other.
    """
    ok, found = _installation(as_json) if root is None else _dataset(root, as_json)
    if as_json:
        print_json(found)
    if not ok:
        raise typer.Exit(1)


def _installation(quiet: bool) -> tuple[bool, dict[str, Any]]:
    from navrep_data.doctor import check_installation

    checks = check_installation()
    problems = [check for check in checks if check.status == "problem"]
    if not quiet:
        for check in checks:
            say(f"{check.status:8s}{check.name:20s} {check.what}")
        say(f"{len(problems)} problems" if problems else "all well")
    return not problems, {"ok": not problems, "checks": [asdict(check) for check in checks]}


def _dataset(root: Path, quiet: bool) -> tuple[bool, dict[str, Any]]:
    from tqdm import tqdm

    from navrep_data.doctor import check_dataset

    with tqdm(unit="sequence", disable=not show_progress()) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        report = check_dataset(root, progress=show)
    if not quiet:
        for finding in report.findings:
            say(f"{finding.severity:8s}{finding.check}: {finding.where + ': ' if finding.where else ''}{finding.what}")
        for what in report.skipped:
            say(f"skipped {what}")
        problems = sum(f.severity == "problem" for f in report.findings)
        seen = f"{report.sequences:,} sequences, {report.episodes:,} episodes, {report.rows:,} rows"
        say(f"{root}: {seen}, {'all well' if report.ok else f'{problems} problems'}")
    return report.ok, {"ok": report.ok, **asdict(report)}
