"""Whose results are whose: results files below a folder, told apart by who trained what they measured."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from navrep_data.errors import CorruptDataError, DatasetMismatchError
from navrep_data.evaluate.results import Results
from navrep_data.evaluate.scores import SUCCESSES, score, summary
from navrep_data.evaluate.suites import get_suite, suite_names
from navrep_data.evaluate.world_model import WorldModelError
from navrep_data.evaluate.world_model_results import FOLDER
from navrep_data.evaluate.world_model_results import load as load_world_model
from navrep_data.io import is_path
from navrep_data.policies import BASELINES
from navrep_data.zoo import measured, registry
from navrep_data.zoo.folders import place_of
from navrep_data.zoo.names import OWN
from navrep_data.zoo.registry import Record

SOURCES = {
    "authors": "authors' own figure",
    "released": "released weights, measured by us",
    "released_as_fed": "released weights, ranges as the authors fed them, measured by us",
    "ours": "our weights, measured by us",
    "baseline": "baseline, measured by us",
    "other": "other, measured by us",
}
"""Where a number comes from, in words for legends."""


def full_name(name: str) -> str:
    """Return the full name of a model of the zoo; a folder as it is."""
    return name if is_path(name) else registry.find(name).name


def weights_of(name: str) -> dict[str, str]:
    """Return the hashes of a model's files, its parts' included, by file."""
    place = place_of(name)
    if place is None:
        return _hashes(registry.find(name))
    from navrep_data.models import checkpoint

    return {"model.safetensors": str(checkpoint.read_config(place).get("weights_sha256"))}


def _hashes(record: Record) -> dict[str, str]:
    parts = registry.with_parts(record)
    return {e.path: e.sha256 or f"git:{e.git_blob_sha1}" for r in parts for e in r.files}


def source_of(name: str) -> str:
    """Return ``"released"``, ``"ours"``, ``"baseline"`` or ``"other"``: a key of :data:`SOURCES`."""
    variant, _, tag = name.partition(".")
    if name in BASELINES:
        return "baseline"
    if variant in registry.variants():
        return "ours" if tag == OWN else "released"
    return "other"


def source_of_results(results: Results) -> str:
    """Return the source of results: that of the name, and apart from it what was fed as the authors' software does."""
    source = source_of(results.header["name"])
    uncut = results.header["settings"].get("ranges") == "as_released"
    return "released_as_fed" if source == "released" and uncut else source


def find_benchmarks(folder: Path, suite: str, physics: str = "original", first_round: int = 0) -> list[Results]:
    """Return all results of a suite below a folder, by name; of two of the same, the one with more episodes.

    Those of another first round lie in folders of another name and are not among them.

    Raises
    ------
    CorruptDataError
        If a file is no results file.
    """
    found: dict[str, Results] = {}
    for path in sorted(folder.rglob(f"{get_suite(suite).folder(physics, first_round)}/*.json")):
        results = Results.load(path)
        if (results.suite.name, results.physics, results.first_round) != (suite, physics, first_round):
            raise CorruptDataError(f"{path} holds {results.suite.name} in {results.physics} physics: move it apart.")
        known = found.get(results.name)
        if known is None or _played(results) > _played(known):
            found[results.name] = results
    return [found[name] for name in sorted(found)]


def _played(results: Results) -> int:
    return len(results.outcome) - len(results.missing(len(results.outcome)))


def find_world_models(folder: Path) -> list[tuple[WorldModelError, dict[str, Any]]]:
    """Return all world-model results below a folder with what is said about them."""
    return [load_world_model(path) for path in sorted(folder.rglob(f"{FOLDER}/*.json"))]


def benchmark_entries(folder: Path, record: Record) -> list[dict[str, Any]]:
    """Return what a record says of its benchmark results below a folder, `goal` on the same episodes beside each.

    An entry per suite, physics and first round, and per way in which the network was run and fed.

    Raises
    ------
    DatasetMismatchError
        If they were measured with other weights.
    CorruptDataError
        If the results of `goal` are missing.
    """
    entries = []
    for suite in suite_names():
        for physics in ("original", "consistent"):
            for first_round in _first_rounds(folder, suite, physics):
                found = find_benchmarks(folder, suite, physics, first_round)
                goal = next((r for r in found if r.header["name"] == "goal"), None)
                for mine in (r for r in found if r.header["name"] == record.name):
                    _same_weights(mine.header["settings"]["policy_files"], record, str(folder))
                    if goal is None:
                        raise CorruptDataError(
                            f"{folder} has no results of 'goal' in {suite}, expected them beside every score."
                        )
                    entries.append(_entry(mine, goal, record))
    return entries


def _first_rounds(folder: Path, suite: str, physics: str) -> list[int]:
    """Return the first rounds of the results below a folder."""
    start = get_suite(suite).folder(physics, 1)[:-1]
    later = {p.parent.name.removeprefix(start) for p in folder.rglob(f"{start}*/*.json")}
    return [0, *sorted(int(name) for name in later if name.isdecimal())]


def _same_weights(files: dict[str, str], record: Record, where: str) -> None:
    if files != _hashes(record):
        raise DatasetMismatchError(
            f"{where} has results of other weights than {record.name} has now: measure again in another folder."
        )


def _entry(mine: Results, goal: Results, record: Record) -> dict[str, Any]:
    row = summary(mine)
    played = [k for k in range(len(mine.outcome)) if mine.outcome[k] != "-"]
    shares = [f"{name}_rate{end}" for name in SUCCESSES for end in ("", "_low", "_high")]
    beside = score(goal, played)
    entry: dict[str, Any] = {
        "suite": mine.suite.name,
        "physics": mine.physics,
        "episodes": row["episodes"],
        "rounds": row["rounds"],
        **_how(mine),
        **{key: round(row[key], 6) for key in (*shares, "collision_rate", "timeout_rate")},
        **{
            key: None if row[key] is None else round(row[key], 6) for key in ("contacts_per_km", "personal_space_share")
        },
        **{f"goal_{name}_rate": round(beside[f"{name}_rate"], 6) for name in SUCCESSES},
        "command": _command(mine, row["episodes"], record),
    }
    if "per_map" in row:
        parts = {"per_map_contact_free": "contact_free_rate", "per_map": "success_rate"}
        for key, share in parts.items():
            entry[key] = {name: round(part[share], 6) for name, part in row["per_map"].items()}
    return entry


def _how(results: Results) -> dict[str, str]:
    """Return how a network was run and fed."""
    return {name: results.header["settings"].get(name, usual) for name, usual in measured.HOW.items()}


def _command(mine: Results, episodes: int, record: Record) -> str:
    """Return the command that gives these results, with every setting that is not the default."""
    suite, rounds, how = mine.suite, episodes / len(mine.suite.scenarios), _how(mine)
    if how["ranges"] == "as_released":  # never scaled
        how["scaling"] = measured.HOW["scaling"]
    given = {
        "physics": (mine.physics, suite.physics),
        "episodes": (f"{rounds:g}", f"{suite.rounds:g}"),
        "first-round": (str(mine.first_round), "0"),
        **{name: (value, measured.HOW[name]) for name, value in how.items()},
    }
    options = [f"--{name} {value}" for name, (value, usual) in given.items() if value != usual]
    return " ".join([f"navrep-data benchmark {record.name} --suite {suite.name}", *options])


def world_model_entries(folder: Path, record: Record) -> list[dict[str, Any]]:
    """Return what a record says of its world-model errors below a folder.

    Raises
    ------
    DatasetMismatchError
        If they were measured with other weights.
    """
    entries = []
    for result, about in find_world_models(folder):
        if result.name != record.name:
            continue
        _same_weights(about["files"], record, os.fspath(folder))
        some = "" if about["limit"] is None else f" --limit {about['limit']}"
        keys = ("scan_mse", "goal_mse", "reconstruction_mse", "still_scan_mse", "still_goal_mse")
        entries.append(
            {
                "suite": "world-model", "split": result.split, "rows": result.rows,
                **{key: None if (v := getattr(result, key)) is None else float(f"{v:.6g}") for key in keys},
                "data": {key: about["data"].get(key) for key in ("name", "content_hash", "rows")},
                "command": f"navrep-data evaluate world-model {record.name} --data DIR --split {result.split}{some}",
            }
        )  # fmt: skip
    return entries
