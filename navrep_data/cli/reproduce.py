"""``navrep-data reproduce``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from navrep_data.cli._common import print_json, say, say_err


def reproduce_command(
    figure: Annotated[
        str,
        typer.Argument(
            metavar="FIGURE",
            help="fig-state, fig-worldmodel, fig-training, fig-testing, fig-trajectories or table.",
        ),
    ],
    results: Annotated[
        Path,
        typer.Option(
            "--results",
            metavar="DIR",
            help="Folder with results at any depth: of benchmark, of evaluate world-model --out, trainings, datasets.",
        ),
    ] = Path("benchmark"),
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="What to write: .png, .pdf, .svg; a table .md, .tex, .csv.",
            show_default="DIR/FIGURE.png (.md)",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Draw the paper's figures again from results files.

    Released weights measured here, our own, and the authors' own figure are kept apart and labelled by source.
    """
    from navrep_data.evaluate.reproduce import reproduce

    done = reproduce(figure, results, out)
    if as_json:
        print_json(done.to_dict())
    elif done.text is not None:
        say(done.text)
    else:
        say(str(done.file))
    for missing in done.missing:
        say_err(f"not there: {missing.what}; made by: {missing.command}")
    if done.text is not None and not as_json:
        say_err(f"wrote {done.file}")
