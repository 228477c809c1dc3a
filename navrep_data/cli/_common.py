"""What every verb shares: printing, errors, progress."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from typing import Any

import typer

from navrep_data.errors import FileAccessError


def say(text: str) -> None:
    """Print a line for people to stdout."""
    _print(text)


def say_err(text: str) -> None:
    """Print a line for people to stderr: what accompanies data on stdout."""
    typer.echo(text, err=True)


def print_json(value: Any) -> None:
    """Print one JSON object to stdout."""
    # where the terminal cannot show every character JSON has its own way to write it
    ascii_only = not str(getattr(sys.stdout, "encoding", None) or "utf-8").lower().startswith("utf")
    _print(json.dumps(value, indent=1, ensure_ascii=ascii_only, allow_nan=False))


def _print(text: str) -> None:
    try:
        typer.echo(text)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise refused_output(error) from error


def refused_output(error: OSError) -> FileAccessError:
    """Return what to say where standard output cannot be written."""
    return FileAccessError(
        f"Cannot write to the standard output: {error.strerror}. What was done is done; send the output elsewhere, or "
        "free some space, and ask again."
    )


def show_progress() -> bool:
    """Return whether somebody watches stderr."""
    return sys.stderr.isatty()


@contextlib.contextmanager
def progress_bar(unit: str) -> Iterator[Callable[[int, int], None]]:
    """Yield what is called with (done, total) to move a bar on stderr, where somebody watches it."""
    from tqdm import tqdm

    with tqdm(unit=unit, disable=not show_progress()) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show
