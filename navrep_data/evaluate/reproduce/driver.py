"""One function for all figures: look for results, say what is missing, draw."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from navrep_data.errors import ConfigError, DatasetNotFoundError, did_you_mean
from navrep_data.evaluate.pictures import check_suffix
from navrep_data.evaluate.reproduce.drawn import Drawn, Missing, Reproduced
from navrep_data.evaluate.reproduce.formats import write
from navrep_data.evaluate.reproduce.state import state
from navrep_data.evaluate.reproduce.testing import table, testing, trajectories
from navrep_data.evaluate.reproduce.training import training
from navrep_data.evaluate.reproduce.world_models import world_models
from navrep_data.io import translate_os_error

FIGURES: dict[str, Callable[[Path], Drawn]] = {
    "fig-state": state,
    "fig-worldmodel": world_models,
    "fig-training": training,
    "fig-testing": testing,
    "fig-trajectories": trajectories,
    "table": table,
}
"""What can be reproduced, and what draws it."""


def reproduce(
    figure: str, results: str | os.PathLike[str] = "benchmark", out: str | os.PathLike[str] | None = None
) -> Reproduced:
    """Draw a figure of the paper again from results files.

    Parameters
    ----------
    figure : str
        One of :data:`FIGURES`.
    results : path-like
        Folder that holds results at any depth: what ``navrep-data benchmark --out`` and ``evaluate world-model --out``
        wrote, output folders of trainings, datasets.
    out : path-like, optional
        File to write; ``FIGURE.png`` (``table.md``) in `results` if left out. Its suffix chooses the format: .png,
        .pdf or .svg for figures; .md, .tex (with booktabs) or .csv (the numbers) for the table.

    Returns
    -------
    Reproduced
        The file, what is on it and from where, and what is missing with the commands that make it.

    Raises
    ------
    ConfigError
        If there is no such figure, or the suffix names no format.
    DatasetNotFoundError
        If `results` has nothing for it; says by which commands to make it.
    CorruptDataError
        If a results file is none.
    """
    if figure not in FIGURES:
        raise ConfigError(
            f"Unknown figure {figure!r}.{did_you_mean(figure, FIGURES)} Expected one of: {', '.join(FIGURES)}."
        )
    folder = Path(results)
    if out is not None:
        check_suffix(Path(out), figure == "table")
    drawn = FIGURES[figure](folder)
    if drawn.figure is None and drawn.text is None:
        commands = "; or: ".join(m.command for m in drawn.missing)
        raise DatasetNotFoundError(f"{folder} has nothing for {figure}, expected results made by: {commands}")
    path = Path(out) if out is not None else folder / (f"{figure}.png" if drawn.text is None else f"{figure}.md")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise translate_os_error(error, path.parent) from error
    write(drawn, path)
    return Reproduced(figure, path, drawn.sources, drawn.missing, drawn.text)


__all__ = ["FIGURES", "Missing", "Reproduced", "reproduce"]
