"""Parts of a dataset, each made by a job of its own, and the dataset that they make together.

All jobs write their shards to their places in one folder, and keep manifests of their own in ``parts/``. Merging
writes the dataset's manifest and card, and moves no data.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError, DatasetError, DatasetMismatchError, DatasetNotFoundError
from navrep_data.generate.storage import FolderStore
from navrep_data.generate.worker import ShardTask, all_shards
from navrep_data.shards import MANIFEST_FILE, Manifest, ShardEntry, dataset_card, writer_lock

PARTS = "parts"
"""Folder of the parts' manifests, until they are merged."""
MAX_PARTS = 10_000
_FOLDER = re.compile(r"([0-9]{4})-of-([0-9]{5})")
# What every part must say alike; `versions` are compared one by one.
_SAME = (
    "env", "physics", "seed", "length", "planned", "shard_size", "scan_dtype", "columns", "max_humans", "sensor",
    "config", "policy", "inputs", "origins", "command", "format_version",
)  # fmt: skip
# Nodes of one cluster may differ in these; the last digits may then too, as when a dataset is extended elsewhere.
_HARDWARE = ("cpu", "machine")
_NAMED = 8


@dataclass(frozen=True, order=True)
class Part:
    """Part `index` of `count`, counted from 0.

    Attributes
    ----------
    index, count : int
        Which one of how many.
    """

    index: int
    count: int

    @property
    def folder(self) -> str:
        """Its folder inside the dataset."""
        return f"{PARTS}/{self.index:04d}-of-{self.count:05d}"

    def share(self, shards: list[ShardTask]) -> list[ShardTask]:
        """Return its share of all shards, as even as can be."""
        total = len(shards)
        return shards[self.index * total // self.count : (self.index + 1) * total // self.count]

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


def parse_part(text: str) -> Part:
    """Return the part that ``i/n`` names, i from 0 to n - 1.

    Raises
    ------
    ConfigError
        If it names none.
    """
    match = re.fullmatch(r"([0-9]{1,5})/([0-9]{1,5})", text)
    if match is None or not 0 <= int(match[1]) < int(match[2]) <= MAX_PARTS:
        raise ConfigError(
            f"--shard-range is {text}, expected i/n with i from 0 to n - 1 and n up to {MAX_PARTS:,}: 0/4, 1/4, 2/4 "
            "and 3/4 for four jobs."
        )
    return Part(int(match[1]), int(match[2]))


def merge_manifest(root: Path | str, report: Callable[[str], None] | None = None) -> Manifest:
    """Make one dataset of the parts that jobs with ``--shard-range`` have left in a folder.

    Parameters
    ----------
    root : path-like
        The jobs' ``--out``.
    report : callable, optional
        Receives notes.

    Returns
    -------
    Manifest
        Of the dataset, byte for byte that of a single run.

    Raises
    ------
    DatasetNotFoundError
        If there are no parts, or some are missing or unfinished.
    DatasetMismatchError
        If parts differ in settings or versions, or overlap.
    DatasetError
        If a listed file is not there.
    """
    root = Path(root)
    if (root / MANIFEST_FILE).is_file():  # merged before, but perhaps not cleaned up
        with writer_lock(root):
            merged = Manifest.read(root)
            _check_files(root, merged.shards)
            if report is not None:
                report(f"{root} is one dataset already.")
            shutil.rmtree(root / PARTS, ignore_errors=True)
        return merged
    if not (root / PARTS).is_dir():
        raise DatasetNotFoundError(
            f"{root} has no folder {PARTS}, expected the --out of jobs run with `navrep-data generate --shard-range "
            "i/n`."
        )
    with writer_lock(root):
        found = _read_parts(root)
        first = found[0][1]
        _check_alike(found, report)
        _check_all(found)
        entries = [entry for _, manifest in found for entry in manifest.shards]
        _check_files(root, entries)
        merged = first.with_shards(entries, complete=True)
        merged = merged.save(root, dataset_card(merged))
        shutil.rmtree(root / PARTS)
    return merged


def _read_parts(root: Path) -> list[tuple[Part, Manifest]]:
    """Return the parts in order; raises where they are not those of one array."""
    found = []
    for folder in sorted((root / PARTS).iterdir()):
        match = _FOLDER.fullmatch(folder.name)
        if match is not None and (folder / MANIFEST_FILE).is_file():
            found.append((Part(int(match[1]), int(match[2])), Manifest.read(folder)))
    if not found:
        raise DatasetNotFoundError(
            f"{root / PARTS} holds no manifest of a part yet, expected those of finished jobs; wait for them, or run "
            "them again."
        )
    counts = sorted({part.count for part, _ in found})
    if len(counts) > 1:
        raise DatasetMismatchError(
            f"{root} holds parts that overlap: of {' and of '.join(map(str, counts))}, expected --shard-range i/n with "
            f"one n; remove the others' folders from {root / PARTS}."
        )
    return found


def _check_alike(found: Sequence[tuple[Part, Manifest]], report: Callable[[str], None] | None) -> None:
    part, first = found[0]
    for other, manifest in found[1:]:
        for field in _SAME:
            _compare(part, getattr(first, field), other, getattr(manifest, field), field)
        for name in {**first.versions, **manifest.versions}:
            seen, expected = manifest.versions.get(name), first.versions.get(name)
            if name not in _HARDWARE:
                _compare(part, expected, other, seen, f"versions.{name}")
            elif seen != expected and report is not None:
                report(
                    f"Note: part {other} was made with {name} {seen}, part {part} with {expected}, which is what the "
                    "manifest will say; its rows may differ in their last digits."
                )


def _compare(part: Part, expected: Any, other: Part, seen: Any, field: str) -> None:
    if seen == expected:
        return
    if isinstance(seen, dict) and isinstance(expected, dict):
        field, seen, expected = next(
            (f"{field}.{k}", seen.get(k), expected.get(k))
            for k in {**expected, **seen}
            if seen.get(k) != expected.get(k)
        )
    raise DatasetMismatchError(
        f"Part {other} was made with {field}={seen}, part {part} with {field}={expected}; expected the same in all: "
        f"remove the folder of the wrong one ({part.folder} or {other.folder}) and run its job again."
    )


def _check_all(found: Sequence[tuple[Part, Manifest]]) -> None:
    """Make sure that every part is there with all its shards and no others."""
    count, first = found[0][0].count, found[0][1]
    size, n = first.shard_size, first.planned
    there = {part.index for part, _ in found}
    lacking = [f"{k}/{count} (no manifest)" for k in range(count) if k not in there]
    shards = all_shards(n, size)
    for part, manifest in found:
        wanted = {(task.file, task.sequences) for task in part.share(shards)}
        have = {(entry.file, entry.sequences) for entry in manifest.shards}
        if have - wanted:
            raise DatasetMismatchError(
                f"Part {part} lists {min(have - wanted)[0]}, which is not its own: parts overlap; expected "
                f"what --shard-range {part} makes. Remove {part.folder} and run its job again."
            )
        if have != wanted:
            lacking.append(f"{part} ({len(have)} of {len(wanted)} shards)")
    if lacking:
        more = f" and {len(lacking) - _NAMED} more" if len(lacking) > _NAMED else ""
        raise DatasetNotFoundError(
            f"Unfinished parts: {', '.join(lacking[:_NAMED])}{more}; expected all {count}. Wait for their jobs, or run "
            "them again with the same --shard-range."
        )


def _check_files(root: Path, entries: Sequence[ShardEntry]) -> None:
    """Make sure that what is listed is in place, by size; ``navrep-data verify`` hashes."""
    store = FolderStore(root)
    for entry in entries:
        for part in (entry, entry.worlds):
            if part is not None and not store.intact(part, hashed=False):
                raise DatasetError(
                    f"{root / part.file} is missing or has another size than {part.bytes:,} bytes; run the jobs again "
                    "with the same --shard-range: they make what is missing."
                )
