"""``navrep-data push``, ``pull`` and ``push-model``."""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from navrep_data.cli._common import print_json, say, show_progress
from navrep_data.cli.interrupt import stop

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Repo = Annotated[str, typer.Argument(metavar="USER/NAME", help="Repository on the Hugging Face Hub.")]
Private = Annotated[bool, typer.Option("--private", help="Make a new repository private.")]
Branch = Annotated[str | None, typer.Option("--revision", help="Branch, made if missing.", show_default="main")]
License = Annotated[
    str | None,
    typer.Option("--license", help="Licence identifier: cc-by-4.0, mit, other, ...", show_default="asks for it"),
]
LICENSE_QUESTION = "Licence to publish it under (cc-by-4.0, cc0-1.0, mit, other, ...)"


def _licence(given: str | None, known: str | None) -> str | None:
    """Return the licence: given, known, or asked for where somebody is there to answer."""
    _prepare()
    if given or known or not sys.stdin.isatty():
        return given or known
    return str(typer.prompt(LICENSE_QUESTION, err=True)).strip()


def _prepare() -> None:
    """Leave it to our errors to tell what went wrong, in one line, and let Ctrl-C end it at once.

    huggingface_hub would wait for its threads, minutes where a server stalls. At any moment what lies on the disk and
    on the Hub is whole: files appear by renaming, a push is one commit.
    """
    from huggingface_hub.utils import logging

    logging.set_verbosity_error()  # type: ignore[no-untyped-call]
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, stop)


def push_command(
    root: Annotated[Path, typer.Argument(metavar="DIR", help="Dataset folder.")],
    repo: Repo,
    private: Private = False,
    revision: Branch = None,
    license: License = None,
    as_json: Json = False,
) -> None:
    """Publish a dataset on the Hub, with a card, a picture and a GIF drawn from it.

    Run the same command again to go on after an interruption.
    """
    from navrep_data.datasets.hub import push
    from navrep_data.shards import Manifest

    chosen = _licence(license, Manifest.read(root).license)
    result = push(root, repo, license=chosen, private=private, revision=revision)
    if as_json:
        print_json(result.to_dict())
        return
    say(f"{root} -> {result.url}")
    say(f"{result.files} files, {result.bytes / 1e6:,.1f} MB, licence {chosen}, content {result.content_hash}")
    say(f"commit {result.commit} on {result.revision}")
    say(f"next: navrep-data pull {result.repo} --revision {result.commit}")


def pull_command(
    repo: Repo,
    out: Annotated[Path | None, typer.Option("--out", help="Dataset folder.", show_default="data/NAME")] = None,
    revision: Annotated[
        str | None, typer.Option("--revision", help="Branch, tag or commit.", show_default="main")
    ] = None,
    split: Annotated[
        str | None, typer.Option("--split", help="Only shards that hold a sequence of train, val or test.")
    ] = None,
    shards: Annotated[str | None, typer.Option("--shards", help="Only these, as in 0-9,12.")] = None,
    as_json: Json = False,
) -> None:
    """Bring a dataset from the Hub, every file checked by its SHA-256 before it counts.

    Run the same command again to go on after an interruption, or with more shards to add them.
    """
    from navrep_data.datasets.hub import parse_shards, pull

    _prepare()
    chosen = None if shards is None else parse_shards(shards)
    result = pull(repo, out, revision=revision, split=split, shards=chosen, progress=show_progress())
    if as_json:
        print_json(result.to_dict())
        return
    part = "complete" if result.complete else f"partial: {result.shards} of {result.shards_in_all} shards"
    say(f"{result.root}: {result.repo} at commit {result.commit} ({part})")
    say(f"{result.bytes / 1e6:,.1f} MB, {result.new_bytes / 1e6:,.1f} MB of it now; content {result.content_hash}")
    say(f"next: navrep-data info {result.root}")


def push_model_command(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Checkpoint or policy folder, or FILE.safetensors.")],
    repo: Repo,
    private: Private = False,
    revision: Branch = None,
    license: License = None,
    as_json: Json = False,
) -> None:
    """Publish a checkpoint or a policy on the Hub; ``zoo.load("hf://USER/NAME")`` loads it.

    It is loaded and checked first. Run the same command again to go on after an interruption.
    """
    from navrep_data.zoo.hub import push_model

    chosen = _licence(license, None)
    result = push_model(path, repo, license=chosen, private=private, revision=revision)
    if as_json:
        print_json(result.to_dict())
        return
    say(f"{path} -> {result.url}")
    say(f"{result.files} files, {result.bytes / 1e6:,.1f} MB, licence {chosen}; commit {result.commit}")
    say(f'next: navrep_data.zoo.load("hf://{result.repo}@{result.commit}")')
