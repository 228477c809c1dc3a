"""``navrep-data evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from navrep_data.cli._common import print_json, say, say_err, show_progress
from navrep_data.errors import ConfigError

evaluate_app = typer.Typer(help="Measure world models.", no_args_is_help=True)


@evaluate_app.command("world-model")
def world_model_command(
    models: Annotated[
        list[str], typer.Argument(metavar="NAME|DIR...", help="World models, or V alone (reconstruction only).")
    ],
    data: Annotated[Path, typer.Option("--data", metavar="DIR", help="Dataset folder.")],
    split: Annotated[str, typer.Option("--split", help="train (as the paper), val or test.")] = "train",
    steps: Annotated[int, typer.Option("--steps", help="Steps of the free-running dream.")] = 16,
    limit: Annotated[int | None, typer.Option("--limit", help="Windows looked at.", show_default="all")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write results to DIR/world-model, for reproduce.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="FILE", help="Draw the errors: .png, .pdf or .svg.")
    ] = None,
    device: Annotated[str, typer.Option("--device", help="cpu, cuda, ...")] = "cpu",
    threads: Annotated[int | None, typer.Option("--threads", help="Threads of torch.", show_default="torch's")] = None,
    source: Annotated[str | None, typer.Option("--from", metavar="DIR", help="Folder with the authors' files.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure the paper's world-model error: mean squared error of the next step, lidar and goal apart.

    Teacher-forced, and as a dream of --steps steps that starts from 16 real rows.
    """
    from navrep_data.cli.train import check_device, use_threads
    from navrep_data.evaluate import world_model as measure
    from navrep_data.evaluate import world_model_results as files
    from navrep_data.evaluate.pictures import check_suffix
    from navrep_data.evaluate.sources import full_name, weights_of
    from navrep_data.shards import dataset_record
    from navrep_data.zoo.local import load_any_model

    if split not in ("train", "val", "test"):
        raise ConfigError(f"--split is {split!r}, expected train, val or test.")
    if figure is not None:  # told before minutes of measuring
        check_suffix(figure, False, "--figure")
    use_threads(threads)
    check_device(device)
    results = []
    for name in models:
        model: Any = load_any_model(name, source)
        part: Any = split
        results.append(
            measure.world_model_error(
                model.to(device) if hasattr(model, "to") else model, data, split=part, steps=steps, limit=limit,
                name=full_name(name), progress=show_progress(),
            )
        )  # fmt: skip
        if out is not None:
            say_err(f"wrote {files.save(results[-1], out, dataset_record(data), weights_of(name), limit)}")
    if figure is not None:
        files.figure(results, figure)
    if as_json:
        print_json({"results": [r.to_dict() for r in results]})
        return
    for line in files.table(results):
        say(line)
