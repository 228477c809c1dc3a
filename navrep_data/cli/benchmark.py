"""``navrep-data benchmark``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from navrep_data.cli._common import print_json, say, say_err, show_progress
from navrep_data.errors import ConfigError

_PAIRS_SHOWN = 6
"""More pairs of policies than these are left to report.md: four policies have six, ten have 45."""
_MANY_PAIRS = "Paired tests of {} pairs of policies: in report.md."


def benchmark_command(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME...",
            help="Baselines goal, random, orca, dwa; networks (navrep-data models); your ./folder or module:function.",
        ),
    ] = None,
    suite: Annotated[
        str,
        typer.Option("--suite", help="navreptest: 200 seeded training worlds. navrep27: the paper's 27 scenarios."),
    ] = "navreptest",
    physics: Annotated[
        str | None,
        typer.Option("--physics", help="original (as NavRep was released) or consistent.", show_default="original"),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option("--episodes", help="Episodes per scenario.", show_default="navreptest 200, navrep27 300"),
    ] = None,
    first_round: Annotated[
        int,
        typer.Option("--first-round", help="First round: later episodes, results in DIR/SUITE-PHYSICS-roundR."),
    ] = 0,
    workers: Annotated[
        int | None,
        typer.Option("--workers", help="Processes; numbers do not depend on it.", show_default="1; on Ray all"),
    ] = None,
    inference: Annotated[
        str,
        typer.Option("--inference", help="deterministic, or as_released (memories with the noise of their training)."),
    ] = "deterministic",
    ranges: Annotated[
        str,
        typer.Option("--ranges", help="contract (cut as in training), or as_released (released networks, uncut)."),
    ] = "contract",
    scaling: Annotated[
        str | None,
        typer.Option(
            "--scaling", help="robot (networks in proportion to the robot) or none (as trained).", show_default="robot"
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option("--from", metavar="DIR", help="Folder with the authors' files (or https://, hf://user/name)."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Results, tables, figures: DIR/SUITE-PHYSICS.")] = Path(
        "benchmark"
    ),
    redraw: Annotated[
        Path | None,
        typer.Option("--redraw", metavar="PATH", help="Play nothing: tables and figures of DIR/SUITE-PHYSICS again."),
    ] = None,
    figures: Annotated[bool, typer.Option("--figures/--no-figures", help="Draw.")] = True,
    executor: Annotated[
        str, typer.Option("--executor", help="local (this machine) or ray (a cluster; needs navrep-data\\[ray]).")
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option("--address", help="Ray cluster, HOST:PORT.", show_default="RAY_ADDRESS, or one of its own here"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Score policies on numbered episodes that everybody plays alike.

    Run the same command again to go on after an interruption, or with more --episodes. The baseline `goal` is always
    played along.
    """
    from navrep_data import evaluate

    if redraw is not None:
        if names:
            raise ConfigError(f"--redraw plays nothing, got the names {', '.join(names)}: leave them out.")
        report = evaluate.redraw(redraw, figures)
    elif not names:
        raise ConfigError(
            "No policy named, expected at least one, for example: navrep-data benchmark goal dwa. Networks: "
            "navrep-data models"
        )
    else:
        with _Bars() as bars:
            report = evaluate.benchmark(
                names,
                suite,
                physics,
                episodes,
                workers,
                inference,
                source,
                out,
                figures,
                executor=executor,
                address=address,
                progress=bars,
                ranges=ranges,
                scaling=scaling,
                first_round=first_round,
            )
    if as_json:
        print_json(report.to_dict())
        return
    say(_short(report))
    for file in report.files:
        say_err(f"wrote {file}")


def _short(report: Any) -> str:
    """Return what a terminal shows: shares, runs of variants, maps, pairs."""
    from navrep_data.evaluate import tables

    parts = [
        tables.overall(report.rows, report.baseline),
        tables.variants(report.variants, report.rows, report.baseline),
        tables.per_part(report.rows, report.baseline, "per_map"),
        tables.paired(report.pairs) if len(report.pairs) <= _PAIRS_SHOWN else _MANY_PAIRS.format(len(report.pairs)),
    ]
    return "\n\n".join(part for part in parts if part)


class _Bars:
    """One progress bar per policy on stderr, silent where nobody watches."""

    def __init__(self) -> None:
        self._bar: Any = None
        self._name = ""

    def __call__(self, name: str, done: int, total: int) -> None:
        from tqdm import tqdm

        if name != self._name:
            self._close()
            self._bar = tqdm(total=total, desc=name, unit="episode", disable=not show_progress())
            self._name = name
        self._bar.update(done - self._bar.n)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()

    def __enter__(self) -> _Bars:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()
