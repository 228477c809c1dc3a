"""The dataset card: README.md of a dataset, as the Hugging Face Hub shows it."""

from __future__ import annotations

import json
from typing import Any

from navrep_data.schema import COLUMNS
from navrep_data.shards._layout import VECTOR_COLUMNS, Layout, layouts
from navrep_data.shards.entries import SPLITS, count_of, shard_file, shard_pattern
from navrep_data.shards.manifest import Manifest

_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
_SIZES_LARGE = ((10_000_000, "1M<n<10M"), (100_000_000, "10M<n<100M"), (1_000_000_000, "100M<n<1B"))

_NOT_SIMULATED = {
    "imported": "Imported from files of the original software: which simulator or robot made them is not recorded; "
    "people, obstacles and the robot's radius are not known.",
    "recorded": "Recorded with a robot: people, obstacles and the robot's radius are not known.",
}
"""By what a manifest says in place of physics."""
_HUMANS = {
    "orca": "humans that follow ORCA",
    "planned": "humans that follow the shortest way round walls",
    "static": "humans that stand still",
    "constant-velocity": "humans that walk straight on",
}
# By name in the package asl-pepper-2d-sim; scenarios lie on three of them. Named here so that a card is a function of
# its manifest alone, wherever it is made.
_PAPER_MAPS = frozenset(
    {"asl", "asl_office_j", "cla_glass_hall", "empty", "hg_main_hall", "openlab_office_j", "unity_scene_map"}
    | {"original_ckk", "scrubbed_ckk", *(f"crowdmove{k}" for k in range(1, 7)), *(f"marktm{k}" for k in range(1, 4))}
    | {"markclutter", "markcomplex", "markmaze", "marksimple", "marktrain"}
)

CITATION = """\
@article{dugas2020navrep,
  title   = {NavRep: Unsupervised Representations for Reinforcement Learning
             of Robot Navigation in Dynamic Human Environments},
  author  = {Dugas, Daniel and Nieto, Juan and Siegwart, Roland and Chung, Jen Jen},
  journal = {arXiv preprint arXiv:2012.04406},
  year    = {2020}
}"""


def _size_category(rows: int) -> str:
    return next((name for limit, name in (*_SIZES, *_SIZES_LARGE) if rows < limit), "n>1B")


def _data_files(m: Manifest) -> list[str]:
    """Return the files of each split that has any."""
    there = {shard.split for shard in m.shards}
    lines = [(f"  - split: {name}", f'    path: "{shard_pattern(name)}"') for name in SPLITS if name in there]
    return [line for pair in lines for line in pair]


def _configs(m: Manifest) -> list[dict[str, Any]]:
    """Return the configs of the datasets that this one was made out of, or its own: theirs share what is in its own."""
    return [c if isinstance(c := record.get("config"), dict) else m.config for record in m.source] or [m.config]


def _simulated(m: Manifest) -> bool:
    """Return whether this package simulated it, and so knows all about it."""
    return m.physics not in _NOT_SIMULATED


def _crowd(m: Manifest) -> list[str]:
    """Return the tags that say who is around."""
    if not _simulated(m):
        return []
    return ["crowd", *(["orca"] if any(c.get("human_policy", "orca") == "orca" for c in _configs(m)) else [])]


def _front_matter(m: Manifest) -> str:
    which = f"{m.physics} physics, seed {m.seed}" if _simulated(m) else m.physics
    lines = [
        "---",
        *([f"license: {m.license}"] if m.license else []),
        f"pretty_name: {json.dumps(f'navrep-data {m.env} ({which})')}",
        "task_categories:",
        "- reinforcement-learning",
        "- robotics",
        "tags:",
        *(f"- {tag}" for tag in ("navrep", "robot-navigation", "lidar", *_crowd(m), "world-models", "hdf5")),
        "size_categories:",
        f"- {_size_category(m.rows)}",
        "configs:",
        "- config_name: default",
        "  data_files:",
        *_data_files(m),
        "---",
    ]
    return "\n".join(lines)


def _table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(str(v) for v in row) + " |" for row in rows]
    return "\n".join(lines)


def _number(value: Any) -> str:
    return "-" if value is None else f"{value:.4g}"


def _columns_table(all_layouts: dict[str, Layout]) -> str:
    rows = []
    for name, layout in all_layouts.items():
        unit = COLUMNS[name].unit
        if name == "scan":
            unit = "mm" if layout.dtype.kind == "u" else "m"
        shape = f"({', '.join(map(str, layout.row_shape))}{',' if len(layout.row_shape) == 1 else ''})"
        rows.append((f"`{name}`", f"{shape} {layout.dtype.name}", unit, COLUMNS[name].description))
    return _table(("column", "per row", "unit", "meaning"), rows)


def _statistics_table(statistics: dict[str, Any]) -> str:
    rows = []
    for name, values in statistics.get("columns", {}).items():
        if name in ("sequence", "episode"):
            continue
        keys = ("mean", "std", "min", "max")
        if name not in VECTOR_COLUMNS:
            rows.append((f"`{name}`{' [m]' if name == 'scan' else ''}", *(_number(values[k]) for k in keys)))
            continue
        for k in range(len(values["mean"])):
            rows.append((f"`{name}[{k}]`", *(_number(values[key][k]) for key in keys)))
    return _table(("column", "mean", "std", "min", "max"), rows)


def _outcomes_table(statistics: dict[str, Any]) -> str:
    rows = [
        (
            name,
            f"{v['episodes']:,}",
            f"{100 * v['share']:.1f} %",
            f"{v['mean_length']:.1f}",
            v["min_length"],
            v["max_length"],
        )
        for name, v in statistics.get("outcomes", {}).items()
    ]
    return _table(("event", "episodes", "share", "mean steps", "min", "max"), rows)


def _pictures(m: Manifest) -> str:
    """Return the lines that show the pictures of a published dataset."""
    words = {".gif": "An episode: the robot (red) among people (blue), what its lidar sees (yellow), and its rings.",
             ".png": "A world, its scan and its rings."}  # fmt: skip
    lines = []
    for entry in m.extras:
        suffix = entry.file[entry.file.rfind(".") :]
        if suffix in words:
            lines += [f"![{words[suffix]}]({entry.file})", "", f"*{words[suffix]} Drawn from the data.*", ""]
    return "\n".join([*lines, ""]) if lines else ""


def _maps_note(m: Manifest) -> str:
    """Say whose maps the worlds lie on; empty where there are none of the paper's."""
    maps = m.config.get("maps")
    named = isinstance(maps, list) and any(isinstance(name, str) and name in _PAPER_MAPS for name in maps)
    if not named and not m.config.get("scenarios"):
        return ""
    return (
        "The maps are those of the package `asl-pepper-2d-sim`, which states no licence: the licence of this dataset\n"
        "does not cover them. No map file is part of it, but scans and pictures show where walls are.\n\n"
    )


def _lead(m: Manifest) -> str:
    return _part(m) + _pictures(m)


def _part(m: Manifest) -> str:
    if m.partial is None:
        return ""
    return (
        f"**This copy is a part**: {len(m.shards):,} of {m.partial['shards']:,} shards, "
        f"{m.sequences:,} of {m.partial['sequences']:,} sequences.\n\n"
    )


def _seed(m: Manifest) -> str:
    return f"made out of {len(m.source)} datasets" if len(m.source) > 1 else f"seed {m.seed}"


def _length(m: Manifest) -> str:
    return f"{m.length:,}" if m.rows == m.sequences * m.length else f"at most {m.length:,}"


def _what(m: Manifest) -> str:
    """Say what it holds, and where that is from."""
    sequences = f"in {m.sequences:,} sequences of {_length(m)} steps"
    if _simulated(m):
        return (
            f"{m.rows:,} steps of a robot among humans, {sequences}: lidar\n"
            "scans, robot states, actions, rewards and the crowd behind them.\n"
            f"Environment `{m.env}`, `{m.physics}` physics, {_seed(m)}."
        )
    made = "recorded with a robot" if m.physics == "recorded" else "imported from files of the original software"
    return (
        f"{m.rows:,} steps {made}, {sequences}: lidar\n"
        "scans, robot states, actions and rewards. Nothing was simulated here.\n"
        f"Called `{m.env}`" + (f", {_seed(m)}." if len(m.source) > 1 else ".")
    )


def _sources(m: Manifest) -> str:
    """Return the lines that name the datasets that this one was made out of."""
    if not m.source:
        return ""
    lines = [f"* {record.get('name', 'a dataset')}: content `{record['content_hash']}`" for record in m.source]
    return "\n".join(
        ["Made out of:\n", *lines, "", "Which sequence and row is where: `source` in `manifest.json`.\n", ""]
    )


def _limits(m: Manifest) -> str:
    if not _simulated(m):
        lines = [f"* {_NOT_SIMULATED[m.physics]}"]
    else:
        lines = _simulation_limits(m)
    if m.scan_dtype == "uint16":
        lines.append(
            "* Scans are rounded to millimetres: about 1 frame in 8 has one rings cell one bin off that of float32."
        )
    lines += [
        "* Equal bytes for the same command are promised for one package version, locked dependencies and "
        "CPU family; `navrep-data verify --regenerate` compares elsewhere.",
        "* An episode of T actions has T + 1 rows; the action and reward of its last row mean nothing. "
        "`cut` marks episodes that the end of a sequence cut off.",
    ]
    return "\n".join(lines)


def _simulation_limits(m: Manifest) -> list[str]:
    configs = _configs(m)
    noise = "with noise" if any(c.get("scan_noise") or c.get("scan_dropout") for c in configs) else "without noise"
    walks = [_HUMANS.get(str(c.get("human_policy", "orca")), "humans that follow a script") for c in configs]
    lines = [f"* Simulated: flat ground, a planar lidar {noise}, {' or '.join(dict.fromkeys(walks))}."]
    if all(c.get("world") != "map" and c.get("human_policy", "orca") == "orca" for c in configs):
        lines.append(
            "* Half of all humans, drawn by chance (`human_sees_robot` in `worlds/`), do not see the robot and walk as "
            "if it was not there, as in the original."
        )
    ended = {name: v["episodes"] for name, v in m.statistics.get("outcomes", {}).items() if name != "cut"}
    played = sum(ended.values())
    if m.policy.get("name") == "orca" and played and all(c.get("world") != "map" for c in configs):
        walls = "it plans no way round walls" if any(c.get("obstacles") for c in configs) else ""
        why = " and ".join(filter(None, [walls, "humans who do not see it walk into it"]))
        lines.append(
            f"* The robot arrives in {100 * ended.get('goal', 0) / played:.0f} % of the {played:,} episodes that "
            f"ended: it follows ORCA straight to its goal, {why}. "
            "This is data for world models, not driving to imitate."
        )
    return lines


def dataset_card(manifest: Manifest) -> str:
    """Return the dataset card: a function of the manifest alone, without dates.

    Parameters
    ----------
    manifest : Manifest
        With shards and statistics; its `card_sha256` is not used.

    Returns
    -------
    str
        Markdown with Hugging Face front matter.
    """
    m = manifest
    all_layouts = layouts(m.columns, m.sensor, m.scan_dtype, m.max_humans, m.length)
    humans = m.statistics.get("humans_per_episode") or {}
    crowd = (
        f" Humans per episode: {_number(humans['mean'])} on average "
        f"({_number(humans['min'])} to {_number(humans['max'])})."
        if humans.get("count")
        else ""
    )
    splits = [(name, f"{count_of(ranges):,}") for name, ranges in m.splits.items()]
    example = m.shards[0].file if m.shards else shard_file(SPLITS[0], 0)
    scene = "map" if m.config.get("world") == "map" else "obstacles"
    worlds = (
        f"`worlds/` holds the {scene}, goals and start states of each episode, one npz per shard.\n\n"
        if any(shard.worlds for shard in m.shards) or (not m.shards and _simulated(m))
        else ""
    )
    command = m.command or "(not recorded)"
    versions = ", ".join(f"{k} {v}" for k, v in m.versions.items())
    return f"""{_front_matter(m)}

# navrep-data: {m.env}

{_lead(m)}{_what(m)}
{len(m.shards):,} HDF5 shards, {m.bytes:,} bytes ({m.bytes / max(m.rows, 1):,.0f} per step).

{_maps_note(m)}Made by navrep-data, an independent re-implementation of the simulator of NavRep (Dugas et al. 2020);
it is not made or endorsed by the NavRep authors. If you use it, please cite their paper:

```bibtex
{CITATION}
```

## How it was made

```
{command}
```

Versions: {versions or "(not recorded)"}. Policy: `{json.dumps(m.policy, ensure_ascii=False)}`.
{_sources(m)}{m.sensor.n_rays} rays from {m.sensor.angle_min:g} rad, {m.sensor.angle_increment:.6g} rad apart,
anticlockwise; up to {m.sensor.range_max:g} m; one step is {m.sensor.dt:g} s.

## Columns

{_columns_table(all_layouts)}

{worlds}## Outcomes

{_outcomes_table(m.statistics)}

{sum(v["episodes"] for v in m.statistics.get("outcomes", {}).values()):,} episodes.{crowd}

## Splits

By sequence ({m.split_rule}); each file belongs to one split.

{_table(("split", "sequences"), splits)}

## Statistics

Without NaN, padding, invalid rays, and the actions and rewards of last rows.

{_statistics_table(m.statistics)}

## How to load it

```python
from navrep_data.datasets import SequenceDataset

windows = SequenceDataset("path/to/this/folder", lidar="rings", window=32, split="train")
```

Without navrep-data, any HDF5 reader works:

```python
import h5py

with h5py.File("{example}") as shard:
    scans_in_metres = shard["scan"][:32] * shard["scan"].attrs["scale"]
    actions = shard["action"][:32]
```

`navrep-data verify path/to/this/folder` checks every byte against the hashes in `manifest.json`.

## Known limits

{_limits(m)}
"""
