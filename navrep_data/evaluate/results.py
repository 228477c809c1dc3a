"""The results file: one JSON per policy, suite and physics, written as episodes finish."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data._version import __version__
from navrep_data.errors import CorruptDataError, DatasetMismatchError
from navrep_data.evaluate.metrics import METRICS
from navrep_data.evaluate.policies import PilotSpec
from navrep_data.evaluate.runner import Episode
from navrep_data.evaluate.suites import Suite, get_suite
from navrep_data.io import atomic_write_bytes, read_json
from navrep_data.schema import Event, fed_as, result_name

FORMAT = "navrep-data-benchmark"
FORMAT_VERSION = 1
LETTERS = {Event.GOAL: "S", Event.TIMEOUT: "T"}
"""One letter per outcome: S goal, T timeout, C any collision, - not played."""
NOT_PLAYED = "-"
TRAJECTORIES = 540
"""Trajectories are kept of this many episodes, the first ones: 20 per scenario of navrep27."""
_MAX_BYTES = 64 << 20
_DIGITS = 5


class Results:
    """What one policy did in one suite.

    Parameters
    ----------
    header : dict
        Name, sees, settings and versions, as plain JSON values.

    Attributes
    ----------
    outcome : list of str
        A letter per episode: S goal, T timeout, C any collision, - not played.
    events : list of str
        Name of the event per episode, empty where it was not played.
    steps : list of int
        Steps per episode.
    metrics : dict of str to list of float
        Per episode; NaN where a metric means nothing.
    trajectories : dict of int to ndarray of shape (n, 2)
        Positions [m] by episode.
    """

    def __init__(self, header: dict[str, Any]) -> None:
        self.header = header
        self.outcome: list[str] = []
        self.events: list[str] = []
        self.steps: list[int] = []
        self.metrics: dict[str, list[float]] = {m.name: [] for m in METRICS}
        self.trajectories: dict[int, NDArray[np.float64]] = {}

    @property
    def name(self) -> str:
        """Full name of the policy; says so where it ran with the noise of the release, or was not fed as by default."""
        return result_name(str(self.header["name"]), self.header["settings"])

    @property
    def suite(self) -> Suite:
        """The suite that was played."""
        return get_suite(self.header["settings"]["suite"])

    @property
    def physics(self) -> str:
        """The physics that was played in."""
        return str(self.header["settings"]["physics"])

    def missing(self, total: int) -> list[int]:
        """Return the numbers below `total` of the episodes that are not there yet."""
        return [k for k in range(total) if k >= len(self.outcome) or self.outcome[k] == NOT_PLAYED]

    def add(self, episodes: Iterable[Episode]) -> None:
        """Put finished episodes in."""
        for e in episodes:
            self._grow(e.episode + 1)
            self.outcome[e.episode] = LETTERS.get(e.event, "C")
            self.events[e.episode] = e.event.label
            self.steps[e.episode] = e.steps
            for name, values in self.metrics.items():
                values[e.episode] = round(e.metrics[name], _DIGITS)
            if e.episode < TRAJECTORIES:
                self.trajectories[e.episode] = e.trajectory / 100.0

    def _grow(self, n: int) -> None:
        more = n - len(self.outcome)
        if more > 0:
            self.outcome += [NOT_PLAYED] * more
            self.events += [""] * more
            self.steps += [0] * more
            for values in self.metrics.values():
                values += [math.nan] * more

    def first(self, total: int) -> Results:
        """Return the results of the episodes below `total` alone."""
        part = Results(self.header)
        part.outcome, part.events, part.steps = self.outcome[:total], self.events[:total], self.steps[:total]
        part.metrics = {name: values[:total] for name, values in self.metrics.items()}
        part.trajectories = {k: xy for k, xy in self.trajectories.items() if k < total}
        return part

    def save(self, path: Path) -> None:
        """Write the file whole, or leave the old one."""
        suite = self.suite
        names = [s.name for s in suite.scenarios]
        n = len(self.outcome)
        columns: dict[str, Any] = {
            "seed": [suite.seed(k) for k in range(n)],
            "scenario": [names[suite.scenario(k)] for k in range(n)] if len(names) > 1 else [],
            "event": self.events,
            "steps": self.steps,
        }
        for name, values in self.metrics.items():
            columns[name] = [None if math.isnan(v) else v for v in values]
        paths = {
            str(k): np.rint(100.0 * xy).astype(int).ravel().tolist() for k, xy in sorted(self.trajectories.items())
        }
        value = {
            "format": FORMAT, "version": FORMAT_VERSION, **self.header,
            "outcome": "".join(self.outcome), "episodes": columns, "trajectories_cm": paths,
        }  # fmt: skip
        atomic_write_bytes(path, _lines(value))

    @classmethod
    def load(cls, path: Path | str) -> Results:
        """Read a results file.

        Raises
        ------
        CorruptDataError
            If it is no results file, or does not fit itself.
        """
        value = read_json(path, _MAX_BYTES)
        try:
            if value["format"] != FORMAT or value["version"] != FORMAT_VERSION:
                raise ValueError(f"format {value['format']!r} version {value['version']!r}")
            results = cls({key: value[key] for key in ("name", "sees", "variant", "settings", "versions")})
            results._read(value)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise CorruptDataError(
                f"{path} is not a results file of this version ({type(error).__name__}: {error}). Expected one written "
                "by navrep-data benchmark; run it again with another --out."
            ) from error
        return results

    def _read(self, value: dict[str, Any]) -> None:
        self.outcome = list(value["outcome"])
        n, columns = len(self.outcome), value["episodes"]
        if not set(self.outcome) <= {*"SCT", NOT_PLAYED}:
            raise ValueError("unknown outcomes")
        self.events, self.steps = [str(e) for e in columns["event"]], [int(s) for s in columns["steps"]]
        self.metrics = {m.name: [math.nan if v is None else float(v) for v in columns[m.name]] for m in METRICS}
        lengths = {len(self.events), len(self.steps), *map(len, self.metrics.values())}
        if lengths != {n}:
            raise ValueError("columns of different lengths")
        if not all(isinstance(value["settings"][key], str) for key in ("suite", "physics", "inference")):
            raise TypeError("settings that are no text")
        self.trajectories = {
            int(k): np.asarray(xy, np.float64).reshape(-1, 2) / 100.0 for k, xy in value["trajectories_cm"].items()
        }
        get_suite(value["settings"]["suite"])  # raises where this version does not know it


def _lines(value: dict[str, Any]) -> bytes:
    """Return JSON with one line per column: json's own indentation would give every number a line."""

    def text(v: Any, level: int) -> str:
        if isinstance(v, dict) and v and level < 2:
            pad = " " * (level + 1)
            inner = ",\n".join(f"{pad}{json.dumps(k)}: {text(x, level + 1)}" for k, x in v.items())
            return "{\n" + inner + "\n" + " " * level + "}"
        return json.dumps(v, separators=(",", ":"), allow_nan=False)

    return (text(value, 0) + "\n").encode()


def header_of(spec: PilotSpec, suite: Suite, physics: str) -> dict[str, Any]:
    """Return what results say of who played what with which versions."""
    how = fed_as(spec.settings())
    return {
        "name": spec.name,
        "sees": spec.sees,
        # runs that were fed otherwise are never counted among the runs of a variant
        "variant": f"{spec.variant} ({how})" if how else spec.variant,
        "settings": {
            **suite.settings(physics),
            "inference": spec.inference,
            **spec.settings(),
            "policy_files": spec.files,
            "navrep_data": __version__,
        },
        "versions": {"python": platform.python_version(), **_versions(("numpy", "numba", "torch"))},
    }


def _versions(names: Sequence[str]) -> dict[str, str]:
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def open_results(path: Path, header: dict[str, Any]) -> Results:
    """Return the results at `path` to go on with, or empty ones.

    Raises
    ------
    DatasetMismatchError
        If those at `path` were made with other settings.
    """
    if not path.exists():
        return Results(header)
    found = Results.load(path)
    old, new = found.header["settings"], header["settings"]
    for key in (*new, *old):
        if old.get(key) != new.get(key):
            raise DatasetMismatchError(
                f"{path} was made with {key} = {old.get(key)!r}, expected {new.get(key)!r}: choose another "
                "--out, or remove it to play again."
            )
    return found


def file_name(spec: PilotSpec) -> str:
    """Return the name of a policy's results file."""
    # a folder's name may begin with dots, and files that do are hidden
    plain = "".join(c if c.isalnum() or c in "._-" else "-" for c in spec.name).lstrip(".-") or "policy"
    how = [spec.inference] if spec.inference != "deterministic" else []
    fed = spec.settings()
    if fed.get("ranges") == "as_released":  # never scaled
        how.append("ranges-as_released")
    elif fed.get("scaling") == "none":
        how.append("scaling-none")
    return ".".join([plain, *how, "json"])
