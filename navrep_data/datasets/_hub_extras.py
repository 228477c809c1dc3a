"""What a published dataset has besides shards: an index of its episodes, and pictures drawn from its data."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from navrep_data.datasets._hub_pictures import draw_pictures
from navrep_data.errors import CorruptDataError
from navrep_data.io import read_json
from navrep_data.shards import INDEX_FILE, DatasetFolder, Episodes, Manifest, ShardEntry
from navrep_data.shards._fields import Fields
from navrep_data.shards.folder import ShardIndex, join_index

INDEX_FORMAT = "navrep-data-index"
_MAX_INDEX_BYTES = 256 << 20
_COLUMNS = ("sequence", "episode", "start", "event")


def make_extras(root: Path) -> dict[str, bytes]:
    """Return the files that a push adds to the dataset in `root`, by name."""
    with DatasetFolder(root) as folder:
        return {INDEX_FILE: index_bytes(folder.episodes, folder.manifest), **draw_pictures(folder)}


def index_bytes(episodes: Episodes, manifest: Manifest) -> bytes:
    """Return the index of a dataset's episodes: per shard their sequence, episode, first row and event."""
    shards: list[dict[str, Any]] = []
    for k, entry in enumerate(manifest.shards):
        mine = np.flatnonzero(episodes.shard == k)
        shards.append({"file": entry.file, **{name: getattr(episodes, name)[mine].tolist() for name in _COLUMNS}})
    return json.dumps({"format": INDEX_FORMAT, "shards": shards}, separators=(",", ":")).encode()


def read_index(path: Path, manifest: Manifest) -> Episodes:
    """Return the episodes of a dataset, or of a part of it, from an index that came from anywhere.

    Raises
    ------
    CorruptDataError
        If it is not an index of these shards.
    """
    fields = Fields(read_json(path, _MAX_INDEX_BYTES), path)
    if fields.get("format", str) != INDEX_FORMAT:
        fields.bad("format", INDEX_FORMAT)
    listed: dict[str, Fields] = {}
    for k, values in enumerate(fields.get("shards", list)):
        one = Fields(values, path, f"shards[{k}].")
        listed[one.get("file", str)] = one
    parts = []
    for entry in manifest.shards:
        if entry.file not in listed:
            raise CorruptDataError(f"{path} lacks {entry.file}; get the dataset again.")
        part = _part(listed[entry.file])
        problem = _check_part(part, entry)
        if problem:
            raise CorruptDataError(f"{path}: {entry.file} {problem}; get the dataset again.")
        parts.append(part)
    return join_index(manifest, parts)


def _part(fields: Fields) -> ShardIndex:
    columns: list[Any] = []
    for name in _COLUMNS:
        values = fields.get(name, list)
        if not all(type(v) is int and 0 <= v < 1 << 31 for v in values):
            fields.bad(name, "a list of whole numbers")
        columns.append(np.array(values, np.int64))
    sequence, episode, start, event = columns
    return sequence, episode, start, event.astype(np.uint8)


def _check_part(part: ShardIndex, entry: ShardEntry) -> str:
    """Return what is wrong with the index of a shard, or an empty string."""
    sequence, episode, start, event = part
    if len({len(column) for column in part}) != 1 or not len(start):
        return "has columns of different lengths, or none"
    if start[0] != 0 or (np.diff(start) < 1).any() or start[-1] >= entry.rows:
        return f"has first rows that do not go up from 0 to less than {entry.rows}"
    new = np.append(True, np.diff(sequence) != 0)
    if not np.array_equal(sequence[new], entry.numbers):
        return "has other sequences than the manifest"
    if (episode[new] != 0).any() or (np.diff(episode)[~new[1:]] != 1).any() or (event > 6).any():
        return "has episodes that are not numbered from 0, or unknown events"
    return ""


def check_shard_index(shard: Any, part: ShardIndex) -> None:
    """Raise CorruptDataError unless the index of a shard is that of its rows."""
    first = np.flatnonzero(shard.read("is_first", 0, shard.rows))
    event = shard.read_rows("event", np.append(first[1:], shard.rows) - 1)
    if not (np.array_equal(first, part[2]) and np.array_equal(event, part[3])):
        raise CorruptDataError(f"{INDEX_FILE} does not fit {shard.path}: the dataset was put together wrongly.")
