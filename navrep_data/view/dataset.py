"""A dataset's sequences as a page: rows, worlds and legs collected, packed, and cut where they are too many."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import ConfigError, CorruptDataError, whole_number
from navrep_data.observations import RING_EDGES, scan_to_rings
from navrep_data.schema import EVENT_NAMES, RINGS_SHAPE, SCAN_SCALE
from navrep_data.shards import DatasetFolder, EpisodeWorld, Manifest, Worlds
from navrep_data.view.legs import leg_offsets, to_world
from navrep_data.view.packing import Blob, pack_rings
from navrep_data.view.page import DEFAULT_MAX_BYTES, MIN_MAX_BYTES, Page, assemble, clip

DEFAULT_SEQUENCES = 3
MAX_SEQUENCES = 50
MAX_ROWS = 20_000
"""Rows read of one sequence: more do not fit into a page of any sensible size."""
MAX_READ_BYTES = 128 << 20
"""Bytes of one column that are read at most; bounds the rows where scans or crowds are huge."""
MAX_VERTICES = 40_000
"""Corners of polygons in one sequence."""
MILLIMETRE = 0.001
FINE = 1e-4
Array = NDArray[Any]


@dataclass
class _Rows:
    """The rows of one sequence that are shown, in the columns' stored dtypes."""

    columns: dict[str, Array]
    sequence: int
    first: int
    total: int
    worlds: Worlds | None

    def __len__(self) -> int:
        return len(self.columns["scan"])

    def cut(self, n: int) -> _Rows:
        """Return the first `n` rows alone."""
        return _Rows({k: v[:n] for k, v in self.columns.items()}, self.sequence, self.first, self.total, self.worlds)

    def starts(self) -> NDArray[np.int64]:
        """Return the first row of each episode, counted from the sequence's first."""
        first = np.flatnonzero(self.columns["is_first"])
        return first if len(first) and first[0] == 0 else np.concatenate([[0], first])


def dataset_page(
    root: str | os.PathLike[str],
    sequences: Sequence[int] | None = None,
    *,
    max_bytes: int = DEFAULT_MAX_BYTES,
    title: str | None = None,
) -> Page:
    """Return a page that plays sequences of a dataset.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    sequences : sequence of int, optional
        Which ones; the first three by default.
    max_bytes : int
        Largest size of the page. Sequences are cut at the end, and then left out, until they fit; what was left out
        is in `Page.notes` and on the page.
    title : str, optional
        The folder's name by default.

    Returns
    -------
    Page

    Raises
    ------
    DatasetNotFoundError, SchemaVersionError, CorruptDataError
        If there is no dataset that can be read.
    ConfigError
        If a sequence is not in it, or a setting cannot be used.
    """
    if max_bytes < MIN_MAX_BYTES:
        raise ConfigError(f"max_bytes is {max_bytes}, expected at least {MIN_MAX_BYTES:,}.")
    name = Path(root).resolve().name if title is None else title
    with DatasetFolder(Path(root)) as folder:
        chosen = _choose(folder.manifest, sequences, Path(root))
        notes: list[str] = []
        if sequences is None and folder.manifest.sequences > len(chosen):
            hidden = folder.manifest.sequences - len(chosen)
            notes.append(f"{hidden:,} of {folder.manifest.sequences:,} sequences; choose others with --sequence")
        shown: list[dict[str, Any]] = []
        blobs: list[str] = []
        room = max_bytes - len(assemble("dataset", _meta(folder.manifest, name, [], notes), []))
        for k, number in enumerate(chosen):
            # what is left is shared out evenly; sequences that need less leave more to the others
            entry, text = _fit(_read(folder, number, notes), room // (len(chosen) - k), folder.manifest, notes)
            if entry is not None:
                entry["blob"] = len(blobs)
                shown.append(entry)
                blobs.append(text)
                room -= len(text) + len(str(entry)) + 200
        if not shown:
            raise ConfigError(f"Not one row of {root} fits into {max_bytes:,} bytes; give more with --max-mb.")
        html = assemble("dataset", _meta(folder.manifest, name, shown, notes), blobs)
    return Page(html, tuple(notes))


def _choose(manifest: Manifest, sequences: Sequence[int] | None, root: Path) -> list[int]:
    """Return which sequences to show, checked."""
    there = sorted(k for s in manifest.shards for k in s.numbers)
    if not there:
        raise ConfigError(f"{root} has no finished sequence yet; run its generate command again, then look at it.")
    if sequences is None:
        return there[:DEFAULT_SEQUENCES]
    numbers = [whole_number(k) for k in sequences]
    if None in numbers:
        raise ConfigError(f"The sequences are {list(sequences)}, expected whole numbers.")
    wanted = list(dict.fromkeys(k for k in numbers if k is not None))
    if len(wanted) > MAX_SEQUENCES:
        raise ConfigError(f"{len(wanted)} sequences were asked for, expected at most {MAX_SEQUENCES} in one page.")
    for k in wanted:
        if manifest.place_of(k) is None:
            raise ConfigError(
                f"Sequence {k} is not in {root}; it has {len(there):,} from {there[0]} to {there[-1]}. Choose with "
                "--sequence."
            )
    return wanted


def _read(folder: DatasetFolder, number: int, notes: list[str]) -> _Rows:
    """Return the rows of a sequence, as many as can be shown at all."""
    index = next(k for k, s in enumerate(folder.manifest.shards) if s.position(number) is not None)
    shard = folder.shard(index)
    mine = np.flatnonzero(shard.read("sequence", 0, shard.rows) == number)
    if not len(mine) or mine[-1] - mine[0] + 1 != len(mine):
        raise CorruptDataError(f"{shard.path} does not hold sequence {number} in one piece; get the file again.")
    first, total = int(mine[0]), len(mine)
    widest = max(layout.row_bytes for name, layout in shard.columns.items() if name != "humans")
    n = max(1, min(total, MAX_ROWS, MAX_READ_BYTES // max(widest, 1)))
    names = [c for c in shard.columns if not c.startswith(("leading_", "source_")) and c != "humans"]
    if "humans" in shard.columns:
        if shard.columns["humans"].row_bytes * n <= MAX_READ_BYTES:
            names.append("humans")
        else:
            notes.append(f"humans of sequence {number}: {shard.columns['humans'].row_shape[0]:,} slots are too many")
    columns = {name: shard.read(name, first, first + n) for name in names}
    return _Rows(columns, number, first, total, folder.worlds(index))


def _fit(rows: _Rows, room: int, manifest: Manifest, notes: list[str]) -> tuple[dict[str, Any] | None, str]:
    """Return a sequence's description and stream, with as many rows as there is room for."""
    cut = rows
    while True:
        entry, text, remarks = _pack(cut, manifest)
        size = len(text) + len(str(entry))
        if size <= room:
            break
        n = min(int(len(cut) * room / size * 0.97), len(cut) - 1)
        if n < 1:
            notes.append(f"sequence {rows.sequence}: no room in a page of this size")
            return None, ""
        cut = rows.cut(n)
    notes += remarks
    if len(cut) < rows.total:
        notes.append(f"sequence {rows.sequence}: rows {len(cut):,} to {rows.total - 1:,} (the page's size is bounded)")
    return entry, text


def _pack(rows: _Rows, manifest: Manifest) -> tuple[dict[str, Any], str, list[str]]:
    """Return the description and the stream of the rows of one sequence, and what is missing from them."""
    blob, remarks = Blob(), list[str]()
    c = rows.columns
    scan = c["scan"]
    if scan.dtype == np.uint16:
        blob.add_codes("scan", scan, 0.0, SCAN_SCALE)
    else:
        blob.add("scan", scan, MILLIMETRE)
    if "scan_label" in c:
        blob.add_bytes("scan_label", c["scan_label"])
    if "rings" in c:
        blob.add_bytes("rings", pack_rings(c["rings"]))
    elif manifest.sensor.covers_full_turn():
        blob.add_bytes("rings", pack_rings(scan_to_rings(scan)))
    for name, step in (
        ("robot_state", MILLIMETRE),
        ("action", MILLIMETRE),
        ("robot_pose", MILLIMETRE),
        ("reward", FINE),
    ):
        if name in c and np.isfinite(c[name]).any():
            blob.add(name, c[name].T, step)
    episodes, starts = _episodes(rows), rows.starts()
    posed = "robot_pose" in c and bool(np.isfinite(c["robot_pose"]).all())
    # without poses all is seen from the robot: the world's own coordinates have no place in it
    worlds: list[EpisodeWorld | None] = _worlds_of(rows, starts) if posed else [None] * len(starts)
    if "humans" in c:
        _pack_humans(blob, rows, worlds, starts, manifest, posed)
    _pack_polygons(blob, episodes, worlds, remarks, rows.sequence)
    radius = c["robot_radius"][0] if "robot_radius" in c else np.nan
    entry = {
        "sequence": rows.sequence,
        "rows": len(rows),
        "total": rows.total,
        "frame": "world" if posed else "robot",
        "radius": float(radius) if np.isfinite(radius) and radius > 0 else None,
        "episodes": episodes,
        "arrays": blob.arrays,
        "size": blob.size,
    }
    return entry, blob.base64(), remarks


def _episodes(rows: _Rows) -> list[dict[str, Any]]:
    """Return number, first row, length and event of each episode."""
    starts = rows.starts()
    stops = np.append(starts[1:], len(rows))
    result = []
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        code = int(rows.columns["event"][stop - 1])
        # an episode that the page cuts off has not ended: no event
        event = EVENT_NAMES[code] if code < len(EVENT_NAMES) else "none"
        number = int(rows.columns["episode"][start])
        result.append({"episode": number, "start": start, "length": stop - start, "event": event})
    return result


def _worlds_of(rows: _Rows, starts: NDArray[np.int64]) -> list[EpisodeWorld | None]:
    """Return the world of each shown episode, None where there is none."""
    if rows.worlds is None:
        return [None] * len(starts)
    at = {int(row): k for k, row in enumerate(rows.worlds.arrays["row"])}
    found = [at.get(rows.first + int(start)) for start in starts]
    return [None if k is None else rows.worlds.episode(k) for k in found]


def _pack_humans(
    blob: Blob,
    rows: _Rows,
    worlds: list[EpisodeWorld | None],
    starts: NDArray[np.int64],
    manifest: Manifest,
    posed: bool,
) -> None:
    """Put the crowd in: (slot, row) arrays of position, velocity, radius, visible, and offset of the first leg."""
    column = rows.columns["humans"].astype(np.float64)
    if posed:
        column = to_world(column, rows.columns["robot_pose"].astype(np.float64))
    used = np.isfinite(column[..., 0]).any(axis=0)
    if not used.any():
        return
    slots = int(np.flatnonzero(used)[-1]) + 1
    column = column[:, :slots]
    for name, k, step in (("x", 0, MILLIMETRE), ("y", 1, MILLIMETRE), ("vx", 2, 0.01), ("vy", 3, 0.01)):
        blob.add(f"human_{name}", column[..., k].T, step)
    blob.add("human_radius", column[..., 4].T, MILLIMETRE)
    blob.add_bytes("human_visible", (np.nan_to_num(column[..., 5].T) > 0.5).astype(np.uint8))
    if not posed or manifest.config.get("rendering") != "legs":
        return
    legs = np.full((len(rows), slots, 2), np.nan)
    for world, start, stop in zip(worlds, starts, [*starts[1:], len(rows)], strict=True):
        h = 0 if world is None else min(slots, len(world.human_gait))
        if world is not None and h:
            legs[start:stop, :h] = leg_offsets(
                np.nan_to_num(column[start:stop, :h, 2:4]),
                world.human_start[:h, 2].astype(np.float64),
                world.human_gait[:h].astype(np.float64),
                manifest.sensor.dt,
                manifest.physics == "original",
            )
    if np.isfinite(legs).any():
        blob.add("leg_x", legs[..., 0].T, 0.002)
        blob.add("leg_y", legs[..., 1].T, 0.002)


def _pack_polygons(
    blob: Blob, episodes: list[dict[str, Any]], worlds: list[EpisodeWorld | None], remarks: list[str], sequence: int
) -> None:
    """Put the static geometry in: corners in one array, counts per polygon with the episodes."""
    corners: list[NDArray[np.float32]] = []
    total, dropped = 0, 0
    for episode, world in zip(episodes, worlds, strict=True):
        polygons = [] if world is None else [*world.polygons, *([] if world.border is None else [world.border])]
        count = sum(map(len, polygons))
        if total + count > MAX_VERTICES:
            polygons, count, dropped = [], 0, dropped + 1
        episode["corner"] = total
        episode["polygons"] = [len(p) for p in polygons]
        episode["border"] = bool(polygons) and world is not None and world.border is not None
        corners += polygons
        total += count
    if dropped:
        remarks.append(f"sequence {sequence}: the obstacles of {dropped} episodes (more than {MAX_VERTICES:,} corners)")
    if total:
        blob.add("corners", np.concatenate(corners).T, MILLIMETRE)


def _meta(manifest: Manifest, title: str, shown: list[dict[str, Any]], notes: list[str]) -> dict[str, Any]:
    """Return what the page's script reads."""
    policy = manifest.policy.get("name", "unknown")
    rows = sum(entry["rows"] for entry in shown)
    facts = {
        "environment": f"{manifest.env}, {manifest.physics} physics",
        "policy": policy,
        "seed": manifest.seed,
        "dataset": f"{manifest.sequences:,} sequences, {manifest.rows:,} rows",
        "in this page": f"{len(shown)} sequences, {rows:,} rows",
        "sensor": f"{manifest.sensor.n_rays} rays, {manifest.sensor.range_max:g} m, every {manifest.sensor.dt:g} s",
        "made by": manifest.command or "not recorded",
    }
    # the first edge is 0 and the last infinite: no JSON number
    edges = [round(float(e), 4) for e in RING_EDGES[:-1]]
    return {
        "kind": "dataset",
        "title": clip(title, 100),
        "facts": [[name, clip(value)] for name, value in facts.items()],
        "sensor": manifest.sensor.to_dict(),
        "rings": {"shape": list(RINGS_SHAPE), "edges": edges},
        "events": list(EVENT_NAMES),
        "notes": [clip(n) for n in notes],
        "sequences": shown,
    }
