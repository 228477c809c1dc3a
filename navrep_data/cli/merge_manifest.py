"""``navrep-data merge-manifest``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from navrep_data.cli._common import say, say_err


def merge_manifest_command(
    root: Annotated[Path, typer.Argument(metavar="DIR", help="The --out of the jobs.")],
) -> None:
    """Make one dataset of the parts that jobs with `generate --shard-range` have made; moves no data."""
    from navrep_data.generate import merge_manifest

    manifest = merge_manifest(root, report=say_err)
    say(f"{root}: {manifest.sequences} sequences, {manifest.rows:,} rows, {len(manifest.shards)} shards")
    say(f"next: navrep-data verify {root}")
