"""The results file: one JSON per policy, suite and physics, written as episodes finish."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Iterable, Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data._version import __version__
from navrep_data.errors import CorruptDataError, DatasetMismatchError
from navrep_data.evaluate.metrics import METRICS, Contacts
from navrep_data.evaluate.runner import Episode
from navrep_data.evaluate.suites import Suite, get_suite
from navrep_data.io import atomic_write_bytes, read_json
from navrep_data.policies import PolicySpec
from navrep_data.schema import RESULTS_FORMAT, RESULTS_VERSION, Event, check_results_version, fed_as, result_name

LETTERS = {Event.GOAL: "S", Event.TIMEOUT: "T"}
"""One letter per outcome: S goal, T timeout, C any collision, - not played."""
NOT_PLAYED = "-"
TRAJECTORIES = 540
"""Trajectories are kept of this many episodes, the first ones: 20 per scenario of navrep27."""
_MAX_BYTES = 64 << 20
_DIGITS = 5


class Results:
    """What one policy did in consecutive episodes of one suite; lists begin with that of number `first_episode`.

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
    contacts : list of Contacts
        What the robot touched, per episode.
    trajectories : dict of int to ndarray of shape (n, 2)
        Positions [m] by index into the lists.
    """

    def __init__(self, header: dict[str, Any]) -> None:
        self.header = header
        self.outcome: list[str] = []
        self.events: list[str] = []
        self.steps: list[int] = []
        self.metrics: dict[str, list[float]] = {m.name: [] for m in METRICS}
        self.contacts: list[Contacts] = []
        self.trajectories: dict[int, NDArray[np.float64]] = {}

    @property
    def first_round(self) -> int:
        """The first round that was played."""
        return int(self.header["settings"]["first_round"])

    @property
    def first_episode(self) -> int:
        """Number of the first episode in the suite."""
        return self.first_round * len(self.suite.scenarios)

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return float(self.suite.config(self.physics).sensor.dt)

    @property
    def rounds(self) -> str:
        """The rounds that were played, in words."""
        scenarios = len(self.suite.scenarios)
        return f"{self.first_round} to {self.first_round + max(1, -(-len(self.outcome) // scenarios)) - 1}"

    def contact_free(self, index: int) -> bool:
        """Return whether an episode ended at the goal with no contact at all."""
        return self.outcome[index] == LETTERS[Event.GOAL] and self.contacts[index].total == 0

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
        """Return the numbers of those of the first `total` episodes that are not there yet."""
        lacks = [i for i in range(total) if i >= len(self.outcome) or self.outcome[i] == NOT_PLAYED]
        return [self.first_episode + i for i in lacks]

    def add(self, episodes: Iterable[Episode]) -> None:
        """Put finished episodes in."""
        for e in episodes:
            i = e.episode - self.first_episode
            self._grow(i + 1)
            self.outcome[i] = LETTERS.get(e.event, "C")
            self.events[i] = e.event.label
            self.steps[i] = e.steps
            for name, values in self.metrics.items():
                values[i] = round(e.metrics[name], _DIGITS)
            self.contacts[i] = replace(e.contacts, speed=round(e.contacts.speed, _DIGITS))
            if i < TRAJECTORIES:
                self.trajectories[i] = e.trajectory / 100.0

    def _grow(self, n: int) -> None:
        more = n - len(self.outcome)
        if more > 0:
            self.outcome += [NOT_PLAYED] * more
            self.events += [""] * more
            self.steps += [0] * more
            for values in self.metrics.values():
                values += [math.nan] * more
            self.contacts += [Contacts()] * more

    def first(self, total: int) -> Results:
        """Return the results of the first `total` episodes alone."""
        part = Results(self.header)
        part.outcome, part.events, part.steps = self.outcome[:total], self.events[:total], self.steps[:total]
        part.metrics = {name: values[:total] for name, values in self.metrics.items()}
        part.contacts = self.contacts[:total]
        part.trajectories = {k: xy for k, xy in self.trajectories.items() if k < total}
        return part

    def save(self, path: Path) -> None:
        """Write the file whole, or leave the old one."""
        suite = self.suite
        names = [s.name for s in suite.scenarios]
        n = len(self.outcome)
        columns: dict[str, Any] = {
            "seed": [suite.seed(self.first_episode + i) for i in range(n)],
            "scenario": [names[suite.scenario(i)] for i in range(n)] if len(names) > 1 else [],
            "event": self.events,
            "steps": self.steps,
        }
        for name, values in self.metrics.items():
            columns[name] = _nulls(values)
        columns["contacts_human"] = [c.human for c in self.contacts]
        columns["contacts_obstacle"] = [c.obstacle for c in self.contacts]
        columns["contact_speed"] = _nulls([c.speed for c in self.contacts])
        paths = {
            str(k): np.rint(100.0 * xy).astype(int).ravel().tolist() for k, xy in sorted(self.trajectories.items())
        }
        value = {
            "format": RESULTS_FORMAT, "version": RESULTS_VERSION, **self.header,
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
        SchemaVersionError
            If it is of the version that did not record contacts.
        """
        value = read_json(path, _MAX_BYTES)
        check_results_version(value, path)
        try:
            if value["format"] != RESULTS_FORMAT or value["version"] != RESULTS_VERSION:
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
        touched = [columns[name] for name in ("contacts_human", "contacts_obstacle", "contact_speed")]
        lengths = {len(self.events), len(self.steps), *map(len, self.metrics.values()), *map(len, touched)}
        if lengths != {n}:
            raise ValueError("columns of different lengths")
        self.contacts = [
            Contacts(int(h), int(o), math.nan if v is None else float(v)) for h, o, v in zip(*touched, strict=True)
        ]
        if any(min(c.human, c.obstacle) < 0 for c in self.contacts):
            raise ValueError("negative contacts")
        first = value["settings"]["first_round"]
        if isinstance(first, bool) or not isinstance(first, int) or not 0 <= first < 1_000_000:
            raise ValueError("a first round that is none")
        if not all(isinstance(value["settings"][key], str) for key in ("suite", "physics", "inference")):
            raise TypeError("settings that are no text")
        self.trajectories = {
            int(k): np.asarray(xy, np.float64).reshape(-1, 2) / 100.0 for k, xy in value["trajectories_cm"].items()
        }
        get_suite(value["settings"]["suite"])  # raises where this version does not know it


def _nulls(values: Sequence[float]) -> list[float | None]:
    return [None if math.isnan(v) else v for v in values]


def _lines(value: dict[str, Any]) -> bytes:
    """Return JSON with one line per column: json's own indentation would give every number a line."""

    def text(v: Any, level: int) -> str:
        if isinstance(v, dict) and v and level < 2:
            pad = " " * (level + 1)
            inner = ",\n".join(f"{pad}{json.dumps(k)}: {text(x, level + 1)}" for k, x in v.items())
            return "{\n" + inner + "\n" + " " * level + "}"
        return json.dumps(v, separators=(",", ":"), allow_nan=False)

    return (text(value, 0) + "\n").encode()


def header_of(spec: PolicySpec, suite: Suite, physics: str, first_round: int = 0) -> dict[str, Any]:
    """Return what results say of who played what with which versions."""
    how = fed_as(spec.settings())
    return {
        "name": spec.name,
        "sees": spec.sees,
        # runs that were fed otherwise are never counted among the runs of a variant
        "variant": f"{spec.variant} ({how})" if how else spec.variant,
        "settings": {
            **suite.settings(physics, first_round),
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


def file_name(spec: PolicySpec) -> str:
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
