"""Check a dataset from the first byte to the last: hashes, structure, index, values, rings against scans."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.errors import FileAccessError, NavrepDataError, one_line
from navrep_data.io import json_bytes, safe_join, sha256_bytes, sha256_file
from navrep_data.observations import scan_to_rings
from navrep_data.shards.card import dataset_card
from navrep_data.shards.entries import FileEntry, ShardEntry
from navrep_data.shards.lock import LOCK_FILE
from navrep_data.shards.manifest import CARD_FILE, MANIFEST_FILE, Manifest
from navrep_data.shards.origin import ORIGIN_FILE, read_origin
from navrep_data.shards.reader import Shard
from navrep_data.shards.statistics import ShardStatistics, merge_statistics, scan_scale
from navrep_data.shards.worlds import MAX_WORLDS_BYTES, parse_worlds
from navrep_data.shards.writer import canonical, check_finite, check_index, check_labels, sequence_hash

MAX_PROBLEMS_PER_FILE = 20
MAX_SEQUENCE_BYTES = 4 << 30
"""Memory that one sequence may take to be checked: 600,000 rows of a full dataset, a hundred times what is usual."""
_AGAIN = "get it again, or run the generate command again"

Columns = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Problem:
    """Something wrong with a dataset.

    Attributes
    ----------
    file : str
        Relative path in the dataset.
    what : str
        One line: what was seen, what was expected.
    """

    file: str
    what: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "what", one_line(self.what))

    def __str__(self) -> str:
        return one_line(f"{self.file}: {self.what}")


@dataclass
class VerifyReport:
    """What :func:`verify` found.

    Attributes
    ----------
    problems : list of Problem
        Empty if all is well.
    shards, rows, sequences, files, bytes : int
        What was checked.
    """

    problems: list[Problem] = field(default_factory=list)
    shards: int = 0
    rows: int = 0
    sequences: int = 0
    files: int = 0
    bytes: int = 0

    @property
    def ok(self) -> bool:
        """Whether no problem was found."""
        return not self.problems

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        return {
            "ok": self.ok,
            "problems": [{"file": p.file, "what": p.what} for p in self.problems],
            "shards": self.shards,
            "rows": self.rows,
            "sequences": self.sequences,
            "files": self.files,
            "bytes": self.bytes,
        }


def verify(root: Path | str, *, progress: Callable[[int, int], None] | None = None) -> VerifyReport:
    """Check every byte and every row of a dataset.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    progress : callable, optional
        Called with (shards done, shards in all).

    Returns
    -------
    VerifyReport
        With a :class:`Problem` for each thing found. Damage is reported, not raised.

    Raises
    ------
    DatasetNotFoundError
        If there is no dataset.
    SchemaVersionError
        If it is of another format version than this one reads.
    CorruptDataError
        If the manifest itself is damaged, so that nothing can be checked against it.
    FileAccessError
        If the operating system refuses to read a file, so that nothing can be said of it.
    """
    root = Path(root)
    manifest = Manifest.read(root)
    report = VerifyReport()
    report.problems += _check_manifest(root, manifest)
    report.files += 1
    report.bytes += (root / MANIFEST_FILE).stat().st_size
    report.problems += _check_card(root, manifest)
    report.problems += _check_unlisted(root, manifest)
    report.problems += _check_origin(root, manifest)
    for extra in manifest.extras:
        report.problems += [Problem(extra.file, bad)] if (bad := check_file(root, extra)) else []
        report.files += 1
        report.bytes += extra.bytes
    total = len(manifest.shards)
    for k, entry in enumerate(manifest.shards):
        found = list(_check_shard(root, manifest, entry))
        if len(found) > MAX_PROBLEMS_PER_FILE:
            rest = len(found) - MAX_PROBLEMS_PER_FILE
            found = [*found[:MAX_PROBLEMS_PER_FILE], Problem(entry.file, f"and {rest} more problems")]
        report.problems += found
        report.shards += 1
        report.rows += entry.rows
        report.sequences += entry.count
        report.files += 2 if entry.worlds else 1
        report.bytes += entry.bytes + (entry.worlds.bytes if entry.worlds else 0)
        if progress is not None:
            progress(k + 1, total)
    return report


def _check_manifest(root: Path, manifest: Manifest) -> Iterator[Problem]:
    # The hash inside covers the values; this also finds a changed blank between them.
    if (root / MANIFEST_FILE).read_bytes() != json_bytes(manifest.to_dict()):
        yield Problem(MANIFEST_FILE, f"its bytes are not as written; {_AGAIN}")
    if manifest.statistics != merge_statistics(s.statistics for s in manifest.shards):
        yield Problem(MANIFEST_FILE, "field 'statistics' is not the sum over shards")


def _check_card(root: Path, manifest: Manifest) -> Iterator[Problem]:
    if manifest.card_sha256 is None:
        if manifest.complete:
            yield Problem(MANIFEST_FILE, f"a complete dataset without the hash of its {CARD_FILE}")
        return
    path = root / CARD_FILE
    if not path.is_file():
        yield Problem(CARD_FILE, f"is missing; {_AGAIN}")
    elif sha256_file(path) != manifest.card_sha256:
        yield Problem(CARD_FILE, f"differs from its SHA-256 in the manifest; {_AGAIN}")
    elif sha256_bytes(dataset_card(manifest).encode()) != manifest.card_sha256:
        yield Problem(CARD_FILE, "is not the card that this version writes for this manifest")


def _check_origin(root: Path, manifest: Manifest) -> Iterator[Problem]:
    try:
        origin = read_origin(root)
    except NavrepDataError as error:
        yield Problem(ORIGIN_FILE, str(error))
        return
    if origin is not None:
        whole = manifest.partial or manifest.to_dict()
        if whole["manifest_sha256"] != origin.manifest_sha256:
            yield Problem(
                ORIGIN_FILE, f"names another dataset than {MANIFEST_FILE}: it was changed since it was pulled"
            )


def _check_unlisted(root: Path, manifest: Manifest) -> Iterator[Problem]:
    listed = {MANIFEST_FILE, CARD_FILE, LOCK_FILE}
    for shard in manifest.shards:
        listed |= {shard.file, *([shard.worlds.file] if shard.worlds else [])}
    for folder in ("data", "worlds"):
        for path in sorted((root / folder).glob("**/*")):
            name = path.relative_to(root).as_posix()
            if path.is_file() and name not in listed:
                yield Problem(name, "is not in the manifest; remove it, or run the generate command again")


def check_file(root: Path, entry: FileEntry | ShardEntry) -> str:
    """Return what is wrong with a listed file's bytes, or an empty string.

    Parameters
    ----------
    root : pathlib.Path
        Dataset folder.
    entry : FileEntry or ShardEntry
        As the manifest lists it.
    """
    path = safe_join(root, entry.file)
    if path.is_symlink() or not path.is_file():
        return f"is missing; {_AGAIN}" if not path.is_symlink() else "is a link, expected a file"
    size = path.stat().st_size
    if size != entry.bytes:
        return f"has {size:,} bytes, expected {entry.bytes:,}; {_AGAIN}"
    if sha256_file(path) != entry.sha256:
        return f"differs from its SHA-256 in the manifest: a flipped byte or another file; {_AGAIN}"
    return ""


def _check_shard(root: Path, manifest: Manifest, entry: ShardEntry) -> Iterator[Problem]:
    bad = check_file(root, entry)
    if bad:
        yield Problem(entry.file, bad)
        return
    try:
        shard = Shard(safe_join(root, entry.file), entry)
        if tuple(shard.columns) != manifest.columns or shard.sensor != manifest.sensor or shard.env != manifest.env:
            yield Problem(entry.file, "has other columns, another sensor or environment than the manifest")
            return
        starts = yield from _check_rows(shard, manifest, entry)
        shard.close()
    except FileAccessError:  # not what is in the file
        raise
    except (NavrepDataError, OSError) as error:
        yield Problem(entry.file, str(error))
        return
    if entry.worlds is not None:
        yield from _check_worlds(root, entry.worlds, starts)


def _check_rows(
    shard: Shard, manifest: Manifest, entry: ShardEntry
) -> Generator[Problem, None, npt.NDArray[Any] | None]:
    """Check the rows, one sequence in memory at a time; return (sequence, episode, row) of each episode."""
    numbers = np.array(entry.numbers)
    sequence = shard.read("sequence", 0, shard.rows)
    begins = np.flatnonzero(np.append(True, sequence[1:] != sequence[:-1]))
    if not np.array_equal(sequence[begins], numbers):
        yield Problem(entry.file, "column 'sequence' does not hold the sequences of the manifest, each in one run")
        return None
    bounds = np.append(begins, shard.rows)
    statistics = ShardStatistics(scan_scale(shard.columns["scan"].dtype))
    starts = []
    checked = 0
    for k, (low, high) in enumerate(itertools.pairwise(bounds.tolist())):
        number = int(numbers[k])
        where = f"sequence {number}"
        size = (high - low) * sum(layout.row_bytes for layout in shard.columns.values())
        if size > MAX_SEQUENCE_BYTES:
            yield Problem(entry.file, f"{where}: {high - low:,} rows take {size:,} bytes, too many to be checked")
            return None
        columns = {name: canonical(shard.read(name, low, high)) for name in shard.columns}
        problem = check_index(columns, number)
        if problem:
            yield Problem(entry.file, f"{where}: {problem}")
            continue
        wrong = list(_check_values(columns, manifest))
        yield from (Problem(entry.file, f"{where}: {what}") for what in wrong)
        if sequence_hash(columns) != entry.sequence_hashes[k]:
            yield Problem(entry.file, f"{where}: its content differs from its hash in the manifest")
        if not wrong:  # infinity has no statistics
            statistics.add(columns)
            checked += 1
        rows = np.flatnonzero(columns["is_first"])
        starts.append(np.stack([columns["sequence"][rows], columns["episode"][rows], rows + low], axis=1))
    if checked == entry.count and statistics.to_dict() != entry.statistics:
        yield Problem(entry.file, "its statistics in the manifest are not those of its rows")
    return np.concatenate(starts) if starts else None


def _check_values(columns: Columns, manifest: Manifest) -> Iterator[str]:
    """Yield what is out of range in one sequence."""
    scan = columns["scan"]
    if scan.dtype.kind == "u":
        limit = round(manifest.sensor.range_max / scan_scale(scan.dtype))
        if scan.max() > limit:
            yield f"column 'scan' holds {int(scan.max())} mm, beyond range_max {limit} mm"
    else:
        if scan.min() < 0 or scan.max() > np.float32(manifest.sensor.range_max):
            yield f"column 'scan' holds values outside 0 to {manifest.sensor.range_max} m"
    if "rings" in columns and not np.array_equal(columns["rings"], scan_to_rings(scan)):
        yield "column 'rings' is not scan_to_rings of column 'scan'"
    problem = check_labels(columns)
    if problem:
        yield problem
    last = columns["is_last"]
    for name in ("action", "reward"):
        if columns[name][last].any():
            yield f"column {name!r} is not 0 on an episode's last row"
    for name, array in columns.items():
        what = check_finite(name, array)
        if what:
            yield what
    if "humans" in columns:
        yield from _check_humans(columns["humans"], columns["is_first"])


def _check_humans(humans: npt.NDArray[Any], is_first: npt.NDArray[np.bool_]) -> Iterator[str]:
    unknown = np.isnan(humans)
    empty = unknown.all(axis=2)
    if (unknown.any(axis=2) & ~empty).any():
        yield "column 'humans' has a slot that is NaN in part"
        return
    if (np.diff(empty.astype(np.int8), axis=1) < 0).any():
        yield "column 'humans' has a filled slot behind an empty one"
    if ((np.diff(empty, axis=0)).any(axis=1) & ~is_first[1:]).any():
        yield "column 'humans' changes its number of humans within an episode"
    filled = humans[~empty]
    if (filled[:, 4] <= 0).any() or not np.isin(filled[:, 5], (0.0, 1.0)).all():
        yield "column 'humans' holds a radius that is not positive, or 'visible' other than 0 and 1"


def _check_worlds(root: Path, entry: FileEntry, starts: npt.NDArray[Any] | None) -> Iterator[Problem]:
    bad = check_file(root, entry)
    if not bad and entry.bytes > MAX_WORLDS_BYTES:
        bad = f"has {entry.bytes:,} bytes, expected at most {MAX_WORLDS_BYTES:,}"
    if bad:
        yield Problem(entry.file, bad)
        return
    try:
        worlds = parse_worlds(safe_join(root, entry.file).read_bytes(), entry.file)
    except NavrepDataError as error:
        yield Problem(entry.file, str(error))
        return
    a = worlds.arrays
    if starts is not None and not np.array_equal(np.stack([a["sequence"], a["episode"], a["row"]], axis=1), starts):
        yield Problem(entry.file, "its episodes are not those of the shard")
