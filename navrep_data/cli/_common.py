"""What every verb shares: printing, errors, progress."""

from __future__ import annotations

import json
import sys
from typing import Any

import typer

INTERRUPTED = 130
INTERRUPTED_LINE = "Interrupted. What was finished is intact; run the same command again to go on."


def say(text: str) -> None:
    """Print a line for people to stdout."""
    typer.echo(text)


def say_err(text: str) -> None:
    """Print a line for people to stderr: what accompanies data on stdout."""
    typer.echo(text, err=True)


def print_json(value: Any) -> None:
    """Print one JSON object to stdout."""
    typer.echo(json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False))


def show_progress() -> bool:
    """Return whether somebody watches stderr."""
    return sys.stderr.isatty()
