"""``navrep-data generate``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from navrep_data.cli._common import print_json, say, say_err, show_progress

if TYPE_CHECKING:
    from navrep_data.generate import GenerateResult

# Loading cached kernels takes about a second.
COMPILED_SECONDS = 8.0


def _cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS
        return os.cpu_count() or 1


def generate_command(
    env: Annotated[str, typer.Option("--env", help="Environment.")] = "soadrl",
    n: Annotated[int, typer.Option("--n", help="Number of sequences of --length rows.")] = 100,
    out: Annotated[Path | None, typer.Option("--out", help="Dataset folder.", show_default="data/<env>")] = None,
    seed: Annotated[int, typer.Option("--seed", help="Same seed and settings, same bytes.")] = 0,
    workers: Annotated[
        int | None, typer.Option("--workers", help="Processes, or tasks on Ray.", show_default="all cores")
    ] = None,
    length: Annotated[int, typer.Option("--length", help="Rows per sequence (0.2 s each).")] = 1000,
    physics: Annotated[
        str | None,
        typer.Option(
            "--physics",
            help="consistent (one geometry for obstacles; people are seen as legs and, off maps, hit as discs of "
            "0.3 to 0.5 m), or original (as NavRep was released).",
            show_default="consistent",
        ),
    ] = None,
    humans: Annotated[
        int | None,
        typer.Option(
            "--humans",
            help="Mean number of humans; an episode has half to 1.5 times as many.",
            show_default="the environment's",
        ),
    ] = None,
    obstacles: Annotated[
        int | None,
        typer.Option(
            "--obstacles",
            help="Most squares, and most walls, in an episode.",
            show_default="the environment's",
        ),
    ] = None,
    legs: Annotated[bool, typer.Option("--legs/--trunk", help="What the lidar sees of a human.")] = True,
    maps: Annotated[
        list[str] | None,
        typer.Option("--map", help="Map of --env map: a name, a YAML file or its folder; may be repeated."),
    ] = None,
    policy: Annotated[
        str,
        typer.Option(
            "--policy",
            help="orca, goal-momentum, random-momentum, constant-velocity, or what benchmark takes: goal, dwa, a name "
            "of the zoo, ./folder, hf://user/name, module:function.",
        ),
    ] = "orca",
    policy_batch: Annotated[
        int, typer.Option("--policy-batch", help="Batch size that networks and functions always see.")
    ] = 64,
    shard_size: Annotated[
        int | None,
        typer.Option("--shard-size", help="Sequences per shard.", show_default="20,000 rows' worth"),
    ] = None,
    scan_dtype: Annotated[
        str | None,
        typer.Option("--scan-dtype", help="uint16 (millimetres) or float32 (metres).", show_default="uint16"),
    ] = None,
    rings: Annotated[bool, typer.Option("--rings/--no-rings", help="Store the rings column.")] = True,
    humans_column: Annotated[
        bool, typer.Option("--humans-column/--no-humans-column", help="Store the humans behind each scan.")
    ] = True,
    labels: Annotated[
        bool, typer.Option("--labels/--no-labels", help="Store what each ray hit: the column scan_label.")
    ] = False,
    executor: Annotated[
        str, typer.Option("--executor", help="local (this machine) or ray (a cluster; needs navrep-data\\[ray]).")
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option("--address", help="Ray cluster, HOST:PORT.", show_default="RAY_ADDRESS, or one of its own here"),
    ] = None,
    storage: Annotated[
        str | None,
        typer.Option(
            "--storage", metavar="URL", help="Write shards there (s3://..., by fsspec); --out keeps the rest."
        ),
    ] = None,
    shard_range: Annotated[
        str | None,
        typer.Option(
            "--shard-range", metavar="I/N", help="Make part I (from 0) of N only; then merge-manifest. For job arrays."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object at the end.")] = False,
) -> None:
    """Simulate robots among people and write a dataset of lidar sequences.

    Run the same command again to go on after an interruption, or with a larger --n to extend a dataset.
    """  # fmt: skip
    from navrep_data.generate import generate

    if workers is None and executor == "local":
        workers = _cores()
    result = generate(
        env=env, n=n, out=out, seed=seed, workers=workers, length=length,
        physics=physics, humans=humans, obstacles=obstacles, legs=legs, maps=maps or None, policy=policy,
        policy_batch=policy_batch, shard_size=shard_size, scan_dtype=scan_dtype, rings=rings,
        humans_column=humans_column, labels=labels, executor=executor, address=address, storage=storage,
        shard_range=shard_range,
        progress=show_progress(), report=say_err if as_json else say,
    )  # fmt: skip
    if as_json:
        print_json(result.to_dict())
    else:
        _print_summary(result)


def _print_summary(result: GenerateResult) -> None:
    episodes = sum(result.outcomes.values())
    outcomes = ", ".join(f"{name} {100 * count / episodes:.0f} %" for name, count in result.outcomes.items() if count)
    part = "" if result.part is None else f", part {result.part}"
    say(
        f"{result.root}{part}: {result.sequences} sequences, {result.rows:,} rows, {result.shards} shards, "
        f"{result.bytes / 1e6:,.1f} MB ({result.bytes / max(1, result.rows) / 1e3:.2f} kB/row)"
    )
    if result.new_rows:
        speed = f"made {result.new_rows:,} rows in {result.seconds:.1f} s: {result.rows_per_s:,.0f} rows/s"
        compiled = result.setup_seconds > COMPILED_SECONDS
        say(speed + (f" (after {result.setup_seconds:.0f} s of compiling kernels)" if compiled else ""))
    say(f"{episodes:,} episodes: {outcomes}" if episodes else "no episodes")
    if result.part is None:
        say(f"next: navrep-data info {result.root}")
    else:
        say(f"next, when all parts are made: navrep-data merge-manifest {result.root}")
