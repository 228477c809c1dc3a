"""Benchmark results as a page: trajectories per scenario, coloured by outcome, for every policy of a folder.

The files are those of :mod:`navrep_data.evaluate`, a sibling that this package does not import: they are read here as
what they are, JSON from anywhere.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import ConfigError, CorruptDataError, DatasetNotFoundError, NavrepDataError
from navrep_data.io import read_json
from navrep_data.schema import DT, EVENT_NAMES, RESULTS_FORMAT, RESULTS_VERSION, check_results_version, result_name
from navrep_data.view.packing import Blob
from navrep_data.view.page import DEFAULT_MAX_BYTES, MIN_MAX_BYTES, Page, assemble, clip

MAX_FILE_BYTES = 64 << 20
MAX_POLICIES = 60
MAX_EPISODES = 20_000
"""Episodes of one policy that are shown; the first ones."""
MAX_POINTS = 2000
"""Points of one trajectory that are shown."""
MAX_MAP_CELLS = 1024
"""Cells of a map along its longer side; finer ones are made coarser, occupied where any cell was."""
CONTACTS = ("contacts_human", "contacts_obstacle")
"""Columns that count what the robot touched."""
METRIC_UNITS = {
    "time_to_goal": "s",
    "path_length": "m",
    "min_clearance": "m",
    "personal_space_time": "s",
    "time_stopped": "s",
    "contact_speed": "m/s",
    "mean_jerk": "m/s\u00b3",
}
"""Units of the benchmark's metrics, which its files do not say."""
_FAR = 1e6  # centimetres: nothing of a benchmark is 10 km away
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """What lies behind a scenario's trajectories; world frame, metres.

    Attributes
    ----------
    occupied : ndarray of shape (W, H), bool, or None
        Cells of the map, [column, row counted from the bottom]; None where there is none.
    extent : tuple of float
        x0, x1, y0, y1 of the map.
    start, goal : ndarray of shape (2,)
        Of the robot.
    humans : ndarray of shape (n, 2)
        Where humans start.
    """

    occupied: NDArray[np.bool_] | None
    extent: tuple[float, float, float, float]
    start: F64
    goal: F64
    humans: F64


@dataclass
class _Policy:
    """One results file, checked."""

    name: str
    sees: str
    settings: dict[str, Any]
    number: list[int]
    scenario: list[str]
    event: list[str]
    steps: list[int]
    seed: list[int]
    touched: list[int]
    metrics: dict[str, list[float | None]]
    paths: dict[int, F64] = field(repr=False)

    def rate(self) -> tuple[float, float]:
        """Return the shares of episodes that reached the goal without contact, and at all."""
        reached = [n for n, event in zip(self.touched, self.event, strict=True) if event == "goal"]
        return reached.count(0) / max(1, len(self.event)), len(reached) / max(1, len(self.event))


def is_results(path: Path) -> bool:
    """Return whether a file or folder looks like benchmark results rather than a dataset."""
    if path.is_dir():
        return not (path / "manifest.json").exists() and any(path.glob("*.json"))
    return path.suffix.lower() == ".json" and path.is_file()


def results_page(
    path: str | os.PathLike[str],
    *,
    scene: Callable[[str], Scene | None] | None = None,
    max_bytes: int = DEFAULT_MAX_BYTES,
) -> Page:
    """Return a page that shows benchmark results.

    Parameters
    ----------
    path : path-like
        A results file of ``navrep-data benchmark``, or a folder of them: one suite, one physics.
    scene : callable, optional
        Returns what to draw behind the trajectories of a scenario of this name, None where there is nothing.
    max_bytes : int
        Largest size of the page; trajectories, then policies, are left out until it fits.

    Returns
    -------
    Page

    Raises
    ------
    DatasetNotFoundError
        If there are no results.
    CorruptDataError
        If a file is not what a benchmark writes.
    ConfigError
        If the results are of several suites or physics, or do not fit.
    """
    if max_bytes < MIN_MAX_BYTES:
        raise ConfigError(f"max_bytes is {max_bytes}, expected at least {MIN_MAX_BYTES:,}.")
    root = Path(path)
    policies = _load(root)
    kept = max((len(p.paths) for p in policies), default=0)
    shown = policies
    while True:
        notes = _left_out(policies, shown, kept)
        html = _build(root, shown, kept, scene, notes)
        if len(html) <= max_bytes:
            return Page(html, tuple(notes))
        if kept > 20:
            kept //= 2
        elif len(shown) > 1:
            shown = shown[: len(shown) // 2]
        else:
            raise ConfigError(f"{path} does not fit into {max_bytes:,} bytes; give more with --max-mb.")


def _left_out(policies: Sequence[_Policy], shown: Sequence[_Policy], kept: int) -> list[str]:
    """Return what is not in the page, in words."""
    notes = []
    if len(shown) < len(policies):
        notes.append(f"{len(policies) - len(shown)} of {len(policies)} policies, those with the lowest success rates")
    if any(len(p.paths) > kept for p in shown):
        notes.append(f"trajectories but the first {kept} of each policy (the page's size is bounded)")
    return notes


def _load(root: Path) -> list[_Policy]:
    """Return the policies of a file or folder, best first."""
    files = sorted(root.glob("*.json"))[: 4 * MAX_POLICIES] if root.is_dir() else [root]
    if not files or not files[0].is_file():
        raise DatasetNotFoundError(f"{root} holds no results (*.json), expected OUT/SUITE-PHYSICS of a benchmark.")
    found = []
    for file in files:
        value = read_json(file, MAX_FILE_BYTES)
        # a folder may hold other JSON beside the results; a file that was named is meant
        if root.is_dir() and not (isinstance(value, dict) and value.get("format") == RESULTS_FORMAT):
            continue
        found.append(_parse(value, file))
    if not found:
        raise DatasetNotFoundError(f"{root} holds no results of navrep-data benchmark, expected OUT/SUITE-PHYSICS.")
    if len(found) > MAX_POLICIES:
        raise ConfigError(f"{root} has results of {len(found)} policies, expected at most {MAX_POLICIES}: name a file.")
    kinds = {tuple(str(p.settings.get(key)) for key in ("suite", "physics", "first_round")) for p in found}
    if len(kinds) > 1:
        raise ConfigError(
            f"{root} holds results of several suites, physics or first rounds, expected one: move them apart."
        )
    return sorted(found, key=lambda p: (*(-rate for rate in p.rate()), p.name))


def _parse(value: Any, file: Path) -> _Policy:
    """Return a results file as a policy, every value checked."""
    check_results_version(value, file)
    try:
        if value["format"] != RESULTS_FORMAT or value["version"] != RESULTS_VERSION:
            raise ValueError(f"format {value['format']!r} version {value['version']!r}")
        columns, settings = value["episodes"], dict(value["settings"])
        n = len(value["outcome"])
        scenarios = columns["scenario"] or [""] * n
        whole = {name: [int(v) for v in columns[name]] for name in ("steps", "seed", *CONTACTS)}
        special = {"seed", "scenario", "event", "steps"}
        metrics = {clip(k, 60): [_number(v) for v in column] for k, column in columns.items() if k not in special}
        lengths = {len(columns["event"]), len(scenarios), *map(len, whole.values()), *map(len, metrics.values())}
        if lengths != {n}:
            raise ValueError("columns of different lengths")
        played = [k for k in range(n) if columns["event"][k]][:MAX_EPISODES]
        return _Policy(
            name=result_name(clip(value["name"], 120), settings),
            sees=clip(value.get("sees", ""), 60),
            settings=settings,
            number=played,
            scenario=[clip(scenarios[k], 120) for k in played],
            event=[e if (e := str(columns["event"][k])) in EVENT_NAMES else "none" for k in played],
            steps=[min(max(whole["steps"][k], 0), 1_000_000) for k in played],
            seed=[whole["seed"][k] for k in played],
            touched=[int(any(whole[name][k] > 0 for name in CONTACTS)) for k in played],
            metrics={name: [column[k] for k in played] for name, column in metrics.items()},
            paths=_paths(value["trajectories_cm"], set(played)),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CorruptDataError(
            f"{file} is not a results file of this version ({type(error).__name__}: {clip(error, 120)}). Expected one "
            "written by navrep-data benchmark; run it again with another --out."
        ) from error


def _number(value: Any) -> float | None:
    """Return a finite number as the page shows it, None for anything that means nothing."""
    if value is None:
        return None
    number = float(value)
    return float(f"{number:.4g}") if math.isfinite(number) else None


def _paths(trajectories: dict[str, Any], played: set[int]) -> dict[int, F64]:
    """Return positions [m] by episode."""
    found = {}
    for name, flat in trajectories.items():
        if int(name) not in played:
            continue
        xy = np.asarray(flat, np.float64).reshape(-1, 2)[:MAX_POINTS]
        if not (np.abs(xy) <= _FAR).all():
            raise ValueError(f"trajectory {clip(name, 20)} leaves the world")
        if len(xy):
            found[int(name)] = xy / 100.0
    return dict(sorted(found.items()))


def _build(
    root: Path,
    policies: Sequence[_Policy],
    kept: int,
    scene: Callable[[str], Scene | None] | None,
    notes: Sequence[str],
) -> bytes:
    """Return the page with the first `kept` trajectories of each policy."""
    names = list(dict.fromkeys(name for p in policies for name in p.scenario))
    place = {name: k for k, name in enumerate(names)}
    blobs: list[str] = []
    entries = []
    for policy in policies:
        entry, blob = _pack(policy, kept, place)
        blobs.append(blob.base64())
        entries.append({**entry, "arrays": blob.arrays, "size": blob.size, "blob": len(blobs) - 1})
    maps = Blob()
    scenarios = [{"name": name or "all", "scene": _scene(name, scene, maps)} for name in names]
    settings = policies[0].settings
    meta: dict[str, Any] = {
        "kind": "results",
        "title": clip(settings.get("suite", root.name), 100),
        "facts": [
            ["suite", clip(f"{settings.get('suite')}, {settings.get('physics')} physics")],
            ["played", f"{len(policies)} policies, {sum(len(p.number) for p in policies):,} episodes"],
            ["first round", clip(settings.get("first_round", 0))],
            [
                "success",
                "contact-free: the goal without touching anybody or anything; as released: by the rules of the "
                "environment, which may allow contacts",
            ],
            ["made with", clip(f"navrep-data {settings.get('navrep_data', '?')}")],
            ["file", clip(root.name)],
        ],
        "notes": list(notes),
        "dt": DT,
        "units": METRIC_UNITS,
        "scenarios": scenarios or [{"name": "all", "scene": None}],
        "policies": entries,
        "maps": None,
    }
    if maps.arrays:
        meta["maps"] = {"blob": len(blobs), "arrays": maps.arrays, "size": maps.size}
        blobs.append(maps.base64())
        meta["facts"].append(["maps", "asl-pepper-2d-sim, which states no licence"])
    return assemble("results", meta, blobs)


def _pack(policy: _Policy, kept: int, place: dict[str, int]) -> tuple[dict[str, Any], Blob]:
    """Return a policy's table, and its trajectories one after the other in one array."""
    chosen = dict(list(policy.paths.items())[:kept])
    blob = Blob()
    points = [chosen[k] for k in policy.number if k in chosen]
    blob.add("xy", np.concatenate(points).T if points else np.zeros((2, 1)), 0.01)
    columns = {
        "number": policy.number,
        "scenario": [place[name] for name in policy.scenario],
        "event": policy.event,
        "steps": policy.steps,
        "seed": policy.seed,
        "touched": policy.touched,
        "points": [len(chosen[k]) if k in chosen else 0 for k in policy.number],
        "metrics": policy.metrics,
    }
    return {"name": policy.name, "sees": policy.sees, "columns": columns}, blob


def _scene(name: str, scene: Callable[[str], Scene | None] | None, maps: Blob) -> dict[str, Any] | None:
    """Return a scenario's start, goal and humans, and put its map in, once for all scenarios that share it."""
    try:
        found = None if scene is None or not name else scene(name)
    except NavrepDataError:  # of another version, or its map is not installed
        return None
    if found is None:
        return None
    number = None
    if found.occupied is not None:
        picture = coarser(found.occupied).T[::-1].astype(np.uint8)
        data = picture.tobytes()
        number = next((k for k, known in enumerate(maps.parts) if known == data), len(maps.parts))
        if number == len(maps.parts):
            maps.add_bytes(f"map_{number}", picture)
    x0, x1, y0, y1 = (float(v) for v in found.extent)
    return {
        "map": number,
        "extent": [x0, y0, x1, y1],
        "start": np.asarray(found.start, float).reshape(-1, 2).round(3).tolist(),
        "goal": np.asarray(found.goal, float).reshape(-1, 2).round(3).tolist(),
        "humans": np.asarray(found.humans, float).reshape(-1, 2).round(3).tolist(),
    }


def coarser(occupied: NDArray[np.bool_], most: int = MAX_MAP_CELLS) -> NDArray[np.bool_]:
    """Return a map with at most `most` cells along each side; a cell is occupied where any of its cells was."""
    by = -(-max(occupied.shape) // most)
    if by <= 1:
        return occupied
    w, h = (-(-n // by) for n in occupied.shape)
    padded = np.zeros((w * by, h * by), bool)
    padded[: occupied.shape[0], : occupied.shape[1]] = occupied
    coarse: NDArray[np.bool_] = np.any(padded.reshape(w, by, h, by), axis=(1, 3))
    return coarse
