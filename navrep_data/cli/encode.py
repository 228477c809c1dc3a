"""``navrep-data encode``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from navrep_data.cli._common import print_json, say, show_progress


def encode_command(
    root: Annotated[Path, typer.Argument(metavar="DIR", help="Dataset folder.")],
    model: Annotated[str, typer.Option("--model", metavar="NAME|DIR", help="A V, or a world model with one.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder of the codes.", show_default="DIR-latents")
    ] = None,
    precision: Annotated[
        str, typer.Option("--precision", help="float32, or bfloat16: faster, less exact.")
    ] = "float32",
    device: Annotated[str, typer.Option("--device", help="cpu, cuda, ...")] = "cpu",
    threads: Annotated[int | None, typer.Option("--threads", help="Threads of torch.", show_default="torch's")] = None,
    source: Annotated[str | None, typer.Option("--from", metavar="DIR", help="Folder with the authors' files.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Write the codes (mu, logvar) of every row of a dataset: what M trains from.

    Run the same command again to go on after an interruption.
    """
    from navrep_data.cli.train import check_device, use_threads
    from navrep_data.train.encode import encode_dataset
    from navrep_data.zoo.local import load_any_model

    use_threads(threads)
    check_device(device)
    target = root.with_name(root.name + "-latents") if out is None else out
    done = encode_dataset(
        root, load_any_model(model, source), target, name=model, precision=precision, device=device,
        progress=show_progress(),
    )  # fmt: skip
    rows, size = sum(s.rows for s in done.shards), sum(s.bytes for s in done.shards)
    if as_json:
        print_json(
            {"out": str(target), "rows": rows, "bytes": size, "z_size": done.z_size, "encoder": done.encoder,
             "source": done.source}
        )  # fmt: skip
    else:
        say(f"{target}: {rows:,} codes of {done.z_size} numbers, {size / 1e6:,.1f} MB")
        say(f"next: navrep-data train m --data {target} --out OUT")
