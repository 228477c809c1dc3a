"""``navrep-data view``."""

from __future__ import annotations

import importlib
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from navrep_data.cli._common import print_json, say, say_err

if TYPE_CHECKING:
    from navrep_data.view import Page, Scene

_ON_HUB = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*/[A-Za-z0-9][A-Za-z0-9._-]*(@[A-Za-z0-9._/-]+)?")


def view_command(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Dataset folder, user/name on the Hub, or benchmark results.")
    ],
    sequence: Annotated[
        list[int] | None,
        typer.Option(
            "--sequence", metavar="K", help="Show this sequence (repeatable).", show_default="the first three"
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="The page.", show_default="NAME.view.html here")
    ] = None,
    max_mb: Annotated[float, typer.Option("--max-mb", min=0.1, max=1000.0, help="Largest size of the page.")] = 6.0,
    open_it: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Make one HTML page that plays sequences of a dataset, or shows the trajectories of benchmark results.

    The page holds all it needs: no server, no network.
    """
    page, name = _make(source, sequence, int(max_mb * 1e6))
    target = page.write(out if out is not None else Path(f"{name}.view.html"))
    if as_json:
        print_json({"file": str(target), "bytes": len(page.html), "left_out": list(page.notes)})
    else:
        for note in page.notes:
            say_err(f"left out: {note}")
        say(str(target))
    if open_it:
        import webbrowser

        webbrowser.open(target.resolve().as_uri())


def _make(source: str, sequences: list[int] | None, max_bytes: int) -> tuple[Page, str]:
    """Return the page of a source, and a name for its file."""
    from navrep_data.errors import ConfigError, DatasetNotFoundError
    from navrep_data.view import dataset_page, is_results, results_page

    path = Path(source)
    if path.exists():
        name = path.resolve().stem if path.is_file() else path.resolve().name
        if is_results(path):
            if sequences:
                raise ConfigError(f"{source} holds benchmark results, which have no --sequence; leave it out.")
            return results_page(path, scene=_scenes(), max_bytes=max_bytes), name
        if path.is_file():
            raise DatasetNotFoundError(f"{source} is a file; expected a dataset's folder or benchmark results (.json).")
        return dataset_page(path, sequences, max_bytes=max_bytes), name
    if not _ON_HUB.fullmatch(source):
        raise DatasetNotFoundError(
            f"There is no {source}; expected a dataset's folder, user/name, or benchmark results."
        )
    with tempfile.TemporaryDirectory(prefix="navrep-data-view-") as folder:
        root = _pull(source, Path(folder) / "dataset", sequences)
        return dataset_page(root, sequences, max_bytes=max_bytes, title=source), source.split("@")[0].split("/")[1]


def _pull(repo: str, root: Path, sequences: list[int] | None) -> Path:
    """Bring the shards that hold the wanted sequences from the Hub; returns their folder."""
    from navrep_data.errors import DatasetNotFoundError
    from navrep_data.shards import Manifest

    try:
        hub = importlib.import_module("navrep_data.datasets.hub")
    except ModuleNotFoundError:
        raise DatasetNotFoundError(
            f"There is no folder {repo}, and this version cannot fetch datasets from the Hub; bring it here first."
        ) from None
    hub.pull(repo, root, shards=[0])
    if sequences:
        # every shard but the last has `shard_size` sequences
        size = max(1, Manifest.read(root).shard_size)
        further = sorted({k // size for k in sequences} - {0})
        if further:
            hub.pull(repo, root, shards=further)
    return root


def _scenes() -> Callable[[str], Scene | None] | None:
    """Return what lies behind a scenario's trajectories, where the benchmark can tell."""
    from navrep_data.errors import NavrepDataError
    from navrep_data.view import Scene

    try:
        backdrops = importlib.import_module("navrep_data.evaluate.backdrops")
    except ModuleNotFoundError:
        return None

    def scene(name: str) -> Scene | None:
        try:
            found = backdrops.backdrop(name)
        except (NavrepDataError, NotImplementedError):  # worlds that are drawn at random have nothing in common
            return None
        return Scene(found.occupied, found.extent, found.start, found.goal, found.humans)

    return scene
