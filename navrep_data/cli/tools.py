"""``navrep-data merge``, ``split``, ``filter``, ``stats``, ``sample``, ``export`` and ``import-rosbag``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from navrep_data.cli._common import print_json, progress_bar, say, say_err

if TYPE_CHECKING:
    from navrep_data.shards import Manifest

Root = Annotated[Path, typer.Argument(metavar="DIR", help="Dataset folder.")]
Out = Annotated[Path, typer.Option("--out", help="New folder.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Split = Annotated[str | None, typer.Option("--split", help="Only train, val or test.", show_default="all")]
_QUARTILES = ("least", "quarter", "half", "three quarters", "most")


def _describe(manifest: Manifest, root: Path) -> dict[str, Any]:
    from navrep_data.datasets.tools.edits import describe

    return describe(manifest, root)


def _tell(found: dict[str, Any]) -> None:
    """Print what a new dataset holds."""
    splits = ", ".join(f"{name} {count}" for name, count in found["splits"].items() if count)
    say(f"{found['root']}: {found['sequences']:,} sequences, {found['rows']:,} rows, {found['bytes'] / 1e6:.1f} MB")
    say("episodes: " + ", ".join(f"{name} {count:,}" for name, count in found["episodes"].items()))
    say(f"splits: {splits or 'none'}")


def _finish(manifest: Manifest, out: Path, as_json: bool) -> None:
    found = _describe(manifest, out)
    if as_json:
        print_json(found)
        return
    _tell(found)
    say(f"next: navrep-data verify {out}")


def merge_command(
    roots: Annotated[list[Path], typer.Argument(metavar="DIR DIR...", help="Dataset folders of one kind.")],
    out: Out,
    as_json: Json = False,
) -> None:
    """Join datasets into a new one; each sequence stays in its split."""
    from navrep_data.datasets.tools import merge

    with progress_bar("sequence") as progress:
        manifest = merge(roots, out, progress=progress)
    _finish(manifest, out, as_json)


def split_command(
    root: Root,
    out: Out,
    shares: Annotated[
        str | None,
        typer.Option(
            "--shares", help="Draw new splits: train,val,test as in 0.7,0.2,0.1.", show_default="keep its own"
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Which draw.")] = 0,
    as_json: Json = False,
) -> None:
    """Write train, val and test as datasets of their own: OUT/train, OUT/val, OUT/test."""
    from navrep_data.datasets.tools import split
    from navrep_data.datasets.tools.edits import parse_shares

    chosen = None if shares is None else parse_shares(shares)
    with progress_bar("sequence") as progress:
        made = split(root, out, shares=chosen, seed=seed, progress=progress)
    found = {name: _describe(manifest, out / name) for name, manifest in made.items()}
    if as_json:
        print_json(found)
        return
    for one in found.values():
        _tell(one)
    say(f"next: navrep-data verify {out / next(iter(found))}")


def filter_command(
    root: Root,
    out: Out,
    outcome: Annotated[
        list[str] | None, typer.Option("--outcome", help="How episodes ended: goal, timeout, ... (repeatable).")
    ] = None,
    min_humans: Annotated[int | None, typer.Option("--min-humans", help="Smallest crowd.")] = None,
    max_humans: Annotated[int | None, typer.Option("--max-humans", help="Largest crowd.")] = None,
    min_steps: Annotated[int | None, typer.Option("--min-steps", help="Shortest episode \\[steps].")] = None,
    max_steps: Annotated[int | None, typer.Option("--max-steps", help="Longest episode \\[steps].")] = None,
    as_json: Json = False,
) -> None:
    """Keep the episodes that meet all conditions, in a new dataset."""
    from navrep_data.datasets.tools import filter

    with progress_bar("sequence") as progress:
        manifest = filter(
            root, out, outcomes=outcome, min_humans=min_humans, max_humans=max_humans, min_steps=min_steps,
            max_steps=max_steps, progress=progress,
        )  # fmt: skip
    _finish(manifest, out, as_json)


def stats_command(root: Root, split: Split = None, as_json: Json = False) -> None:
    """Tell means, spreads and ranges of all columns, outcomes, lengths of episodes, sizes of crowds."""
    from navrep_data.datasets.tools import stats

    found = stats(root, split=split)
    if as_json:
        print_json(found)
        return
    where = f", split {split}" if split else ""
    say(f"{root}{where}: {found['sequences']:,} sequences, {found['episodes']:,} episodes, {found['rows']:,} rows")
    say(f"{'steps per episode':24s}" + "".join(f"{name:>15s}" for name in _QUARTILES) + f"{'episodes':>15s}")
    for name, values in found["steps"].items():
        count = found["outcomes"][name]["episodes"] if name in found["outcomes"] else found["episodes"]
        say(f"  {name:22s}" + "".join(f"{v:15.1f}" for v in values) + f"{count:15,}")
    if found["humans"]:
        say("humans (episodes): " + ", ".join(f"{n} ({count:,})" for n, count in found["humans"].items()))
    say(f"{'column':24s}" + "".join(f"{name:>15s}" for name in ("mean", "std", "min", "max", "count")))
    for name, values in found["columns"].items():
        many = isinstance(values["mean"], list)
        for k in range(len(values["mean"]) if many else 1):
            row = [values[key][k] if many else values[key] for key in ("mean", "std", "min", "max", "count")]
            text = "".join(f"{'-' if v is None else format(v, '.5g'):>15s}" for v in row[:-1])
            say(f"{name + f'[{k}]' * many:24s}{text}{row[-1]:15,}")


def sample_command(
    root: Root,
    out: Out,
    n: Annotated[int, typer.Option("--n", help="How many pictures.")] = 9,
    seed: Annotated[int, typer.Option("--seed", help="Which rows.")] = 0,
    split: Split = None,
    as_json: Json = False,
) -> None:
    """Draw rows chosen at random: world, scan and rings, one PNG each."""
    from navrep_data.datasets.tools import sample

    with progress_bar("picture") as progress:
        paths = sample(root, out, n=n, seed=seed, split=split, progress=progress)
    if as_json:
        print_json({"root": str(out), "files": [str(path) for path in paths]})
        return
    for path in paths:
        say(str(path))


def export_command(
    root: Root,
    out: Out,
    format: Annotated[str, typer.Option("--format", help="npz (the original's files) or minari.")],
    dataset_id: Annotated[
        str | None, typer.Option("--id", help="Name in Minari.", show_default="navrep-data/ENV-v0")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a dataset in another format."""
    from navrep_data.datasets.tools import export

    with progress_bar("sequence") as progress:
        result = export(root, out, format=format, dataset_id=dataset_id, progress=progress)
    if as_json:
        print_json(result.to_dict())
        return
    say(f"{out}: {result.files} files, {result.bytes / 1e6:.1f} MB, {result.episodes:,} episodes, {result.rows:,} rows")
    if result.skipped:
        say(f"left out: {result.skipped:,} episodes without an action, which Minari has no place for")
    if result.dataset_id:
        say(f"next: MINARI_DATASETS_PATH={out} python -c \"import minari; minari.load_dataset('{result.dataset_id}')\"")


def import_rosbag_command(
    bags: Annotated[list[Path], typer.Argument(metavar="BAG...", help="ROS 1 .bag files, folders of ROS 2 bags.")],
    out: Annotated[Path, typer.Option("--out", help="Dataset folder, new or empty.")],
    scan_topic: Annotated[
        str | None, typer.Option("--scan-topic", help="Topic of LaserScan.", show_default="the only one")
    ] = None,
    odometry_topic: Annotated[
        str | None, typer.Option("--odometry-topic", help="Topic of Odometry.", show_default="the only one")
    ] = None,
    goal_topic: Annotated[
        str | None,
        typer.Option("--goal-topic", help="Topic of PoseStamped, or none.", show_default='the one named "goal"'),
    ] = None,
    env: Annotated[str, typer.Option("--env", help="Name to record as the environment.")] = "rosbag",
    dt: Annotated[float, typer.Option("--dt", help="Time between rows \\[s].")] = 0.2,
    length: Annotated[int, typer.Option("--length", help="Most rows of a sequence.")] = 1000,
    range_max: Annotated[
        float | None,
        typer.Option(
            "--range-max", help="Largest range to store; the scanner's if it does not say \\[m].", show_default="25"
        ),
    ] = None,
    mount: Annotated[str, typer.Option("--mount", help="Scanner on the robot: x,y,yaw \\[m, m, rad].")] = "0,0,0",
    goal_radius: Annotated[
        float, typer.Option("--goal-radius", help="A goal is reached nearer than this \\[m].")
    ] = 0.5,
    assume_same_frame: Annotated[
        bool, typer.Option("--assume-same-frame", help="Goals and odometry are in one frame, whatever it is called.")
    ] = False,
    invalid_is_free: Annotated[
        bool, typer.Option("--invalid-is-free", help="NaN and 0 in scans mean that nothing was hit.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Convert recordings of a real robot (scan, odometry, goals) into a dataset."""
    from navrep_data.datasets import import_rosbag
    from navrep_data.datasets.rosbag import parse_mount

    place = parse_mount(mount)
    with progress_bar("sequence") as progress:
        manifest = import_rosbag(
            bags, out, scan_topic=scan_topic, odometry_topic=odometry_topic, goal_topic=goal_topic, env=env, dt=dt,
            length=length, range_max=range_max, mount=place, goal_radius=goal_radius,
            assume_same_frame=assume_same_frame, invalid_is_free=invalid_is_free, progress=progress, note=say_err,
        )  # fmt: skip
    _finish(manifest, out, as_json)
