"""``navrep-data import-npz``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from navrep_data.cli._common import print_json, say, say_err


def import_npz_command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help="*_scans_robotstates_actions_rewards_dones.npz of the original, or folders."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Dataset folder, new or empty.")],
    env: Annotated[str, typer.Option("--env", help="Name to record as the environment.")] = "imported",
    range_max: Annotated[float, typer.Option("--range-max", help="Largest range of the recorded sensor \\[m].")] = 25.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Convert sequences recorded by the original NavRep into a dataset."""
    from navrep_data.datasets import import_npz

    manifest = import_npz(files, out, env=env, range_max=range_max, report=say_err)
    if as_json:
        print_json(
            {
                "rows": manifest.rows,
                "sequences": manifest.sequences,
                "shards": len(manifest.shards),
                "bytes": manifest.bytes,
            }
        )
    else:
        say(f"{out}: {manifest.sequences} sequences, {manifest.rows:,} rows, {manifest.bytes / 1e6:.1f} MB")
        say(f"next: navrep-data info {out}")
