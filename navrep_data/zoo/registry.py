"""The registry: one JSON record per checkpoint, read once, and the resolution of names to records.

Notes
-----
A record says what a checkpoint is and which bytes it consists of, so it exists for every released file, present on
this machine or not. Nothing here imports torch.
"""

from __future__ import annotations

import fnmatch
import json
import shlex
import sys
from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from navrep_data.errors import UnknownNameError, did_you_mean
from navrep_data.io import FileId, here_hint, is_path
from navrep_data.zoo.names import OWN, RELEASED, WILDCARDS, alias_line, default_tag, split_name

KINDS = ("policy", "controller", "world_model", "vae", "memory")
FOLDER = Path(__file__).parent
"""Holds ``records/`` and, for what this project trained, ``weights/``."""
RECORDS, WEIGHTS = "records", "weights"


@dataclass(frozen=True)
class RecordFile:
    """One file of a checkpoint.

    Attributes
    ----------
    path : str
        Relative POSIX path, as in the authors' repository; ``weights/...`` for files that are part of this package.
    bytes : int or None
        Size, None where it is not known.
    sha256, git_blob_sha1 : str or None
        Hashes; where the SHA-256 is not known the git blob id is checked.
    """

    path: str
    bytes: int | None
    sha256: str | None
    git_blob_sha1: str | None

    @property
    def id(self) -> FileId:
        """What the file must be, for checks and downloads."""
        return FileId(self.bytes, self.sha256, self.git_blob_sha1)

    @property
    def packaged(self) -> bool:
        """Whether the file is part of this package."""
        return self.path.startswith(f"{WEIGHTS}/")


@dataclass(frozen=True)
class Record:
    """What is known of one checkpoint.

    Attributes
    ----------
    name, variant, tag : str
        ``name == f"{variant}.{tag}"``.
    released : bool
        Whether ``{variant}.released`` is this run.
    released_rule : str
        By which rule that was decided.
    kind : str
        policy, controller (a policy whose encoder is not known), world_model, vae (V) or memory (M).
    architecture : str
        modular, joint, transformer or e2e.
    network : str or None
        The authors' name of the network.
    lidar : str or None
        rings or 1d.
    features : str or None
        What the controller reads besides the robot_state: z, h or zh.
    z_size, h_size, n_inputs, n_parameters : int or None
        Sizes of latent, memory and controller input; number of stored parameters.
    sensor : dict
        Fields of :class:`navrep_data.schema.SensorContract`.
    preprocessing : dict or None
        ``scan``: over_25, rings or metres; ``zero_first_bin``: whether the nearest ring is cleared.
    action_alignment : str or None
        leading: row t goes with the action that led to it; taken: with the one chosen there. None without memory.
    context_rule : str or None
        oldest-32: memory sees the first 32 rows of an episode, then stands still; carried-state: a state carried on.
    parts : dict
        Role (world_model, vae, memory) to full name of the checkpoints that this one needs.
    format : str or None
        sb2-zip, torch-state-dict or tf-json; safetensors for our own; None for a checkpoint without files of its own.
    files : tuple of RecordFile
        Files to fetch and check.
    source : dict
        Repository, commit, license and the authors' words for the variant; for our own who trained it and license.
    started, saved : str or None
        When the run began and when its file was written, as its name and time stamps say.
    golden : tuple of str
        Files with outputs of the original software that ``models verify --golden`` compares.
    notes : tuple of str
        What is odd about it.
    results : tuple of dict
        Measured results, each with the command that made it.
    training : dict or None
        How this project trained it: commands, settings, seed, dataset, steps, seconds, machine, what half precision
        costs, validation. None for the authors' checkpoints.
    robot : dict or None
        Of policies: fields of :class:`navrep_data.schema.RobotContract`, the robot that it was trained on.
    """

    name: str
    variant: str
    tag: str
    released: bool
    released_rule: str
    kind: str
    architecture: str
    network: str | None
    lidar: str | None
    features: str | None
    z_size: int | None
    h_size: int | None
    n_inputs: int | None
    n_parameters: int | None
    sensor: dict[str, Any]
    preprocessing: dict[str, Any] | None
    action_alignment: str | None
    context_rule: str | None
    parts: dict[str, str]
    format: str | None
    files: tuple[RecordFile, ...]
    source: dict[str, Any]
    started: str | None
    saved: str | None
    golden: tuple[str, ...]
    notes: tuple[str, ...]
    results: tuple[dict[str, Any], ...]
    training: dict[str, Any] | None = None
    robot: dict[str, float] | None = None

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Record:
        """Make a record of its JSON; keys must be exactly the fields, those with a default may be left out."""
        known = {f.name for f in fields(cls)}
        needed = {f.name for f in fields(cls) if f.default is MISSING}
        if wrong := (set(data) - known) | (needed - set(data)):
            raise UnknownNameError(
                f"Record {data.get('name')!r} has the wrong keys {sorted(wrong)}: reinstall navrep-data."
            )
        lists = {key: tuple(data[key]) for key in ("golden", "notes", "results")}
        return cls(**{**data, **lists, "files": tuple(RecordFile(**entry) for entry in data["files"])})

    def to_dict(self) -> dict[str, Any]:
        """Return the record as plain JSON values."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain

    @property
    def is_checkpoint(self) -> bool:
        """Whether it has files of its own; the authors' V and M together as a world model have none."""
        return bool(self.files)

    @property
    def shipped(self) -> bool:
        """Whether all its files, and those of its parts, are in this package."""
        return all(e.packaged for e in self.files) and all(records()[part].shipped for part in self.parts.values())

    @property
    def ours(self) -> bool:
        """Whether this project trained it, and not the authors."""
        return self.tag == OWN


@cache
def records() -> dict[str, Record]:
    """Return all records by full name, sorted: 61 released checkpoints, the two pairs of V and M, and our own."""
    found = (Record.from_dict(json.loads(f.read_bytes())) for f in (FOLDER / RECORDS).glob("*.json"))
    return {record.name: record for record in sorted(found, key=lambda r: r.name)}


@cache
def variants() -> dict[str, tuple[Record, ...]]:
    """Return the runs of every variant: our own, then the authors', oldest first."""
    runs: dict[str, list[Record]] = {}
    for record in records().values():
        runs.setdefault(record.variant, []).append(record)
    return {name: tuple(sorted(of, key=lambda r: r.started or "")) for name, of in sorted(runs.items())}


@cache
def full_names() -> tuple[str, ...]:
    """Return every full name that can be loaded: each run, and ``.released`` of each variant."""
    released = {f"{variant}.{RELEASED}" for variant, runs in variants().items() if any(r.released for r in runs)}
    return tuple(sorted(set(records()) | released))


def list_models(pattern: str = "*") -> list[str]:
    """Return full names of checkpoints.

    Parameters
    ----------
    pattern : str
        Shell wildcards (``*``, ``?``, ``[...]``), or a variant such as ``e2e_1d`` for all its runs, or a full name.

    Returns
    -------
    list of str
        Sorted. Every name is listed that :func:`load` takes: the runs by day, and ``.released`` for the recommended
        one. Empty if wildcards match nothing.

    Raises
    ------
    UnknownNameError
        If `pattern` has no wildcard and is no name.
    """
    if any(c in pattern for c in WILDCARDS):
        return [name for name in full_names() if fnmatch.fnmatchcase(name, pattern)]
    if pattern in variants():
        return [name for name in full_names() if split_name(name)[0] == pattern]
    return [pattern] if pattern in full_names() else [find(pattern).name]


def find(name: str) -> Record:
    """Return the record that a name stands for, without a word about aliases.

    Parameters
    ----------
    name : str
        Full name, or a variant without tag.

    Raises
    ------
    UnknownNameError
        If there is no such name, or several runs fit the tag.
    """
    if is_path(name):
        raise UnknownNameError(
            f"{name!r} is a place, expected a name of the zoo: navrep-data models lists them, and navrep-data models "
            f"show {shlex.quote(name)} tells what is there."
        )
    variant, tag = split_name(name)
    runs = variants().get(variant)
    if runs is None:
        raise UnknownNameError(f"Unknown model {name!r}.{_closest(name)}{here_hint(name)} List all: navrep-data models")
    tag = default_tag(variant) if tag is None else tag
    fitting = [r for r in runs if r.tag == tag or (tag == RELEASED and r.released)]
    # a day alone names its run where it is the only one of that day
    fitting = fitting or [r for r in runs if r.tag.startswith(f"{tag}-")]
    if len(fitting) == 1:
        return fitting[0]
    every = ", ".join(r.name for r in fitting or runs)
    if fitting:
        raise UnknownNameError(f"{name!r} is ambiguous: {len(fitting)} runs began on that day. Name one of: {every}")
    if tag == OWN:
        meant = f"{name} means {variant}.{OWN} (trained by navrep-data)" if name == variant else f"{name}"
        raise UnknownNameError(
            f"{meant}: this version of navrep-data does not contain it. "
            f"The NavRep authors' weights: {variant}.{RELEASED}{_shipped_hint()}"
        )
    raise UnknownNameError(f"Unknown model {name!r}: {variant} has no tag {tag!r}.{here_hint(name)} Its runs: {every}")


def _shipped_hint() -> str:
    ours = [r.name for r in records().values() if r.ours]
    return f". Trained by navrep-data and here: {', '.join(ours)}" if ours else ""


def resolve(name: str) -> Record:
    """Return the record that a name stands for; an untagged name says on stderr whose weights those are.

    Parameters
    ----------
    name : str
        Full name, or a variant without tag.

    Raises
    ------
    UnknownNameError
        If there is no such name, or several runs fit the tag.
    """
    record = find(name)
    if split_name(name)[1] is None:
        print(alias_line(name, record.name), file=sys.stderr)
    return record


def _closest(name: str) -> str:
    """Suggest a full name where a tag was typed, a variant otherwise."""
    return did_you_mean(name, full_names() if "." in name else variants())


def with_parts(record: Record) -> Iterator[Record]:
    """Yield a record's parts, theirs before them, then itself: the order in which they are built."""
    for name in record.parts.values():
        yield from with_parts(records()[name])
    yield record


def dependants(record: Record) -> list[Record]:
    """Return the policies that cannot run without this checkpoint."""
    return [r for r in records().values() if r.kind == "policy" and any(p.name == record.name for p in with_parts(r))]
