"""What a dataset holds, as one number, and a part of a dataset as a dataset."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from navrep_data.errors import ConfigError, did_you_mean
from navrep_data.io import json_bytes, sha256_bytes
from navrep_data.shards.entries import SPLITS
from navrep_data.shards.manifest import Manifest
from navrep_data.shards.statistics import merge_statistics


def content_hash(manifest: Manifest) -> str:
    """Return the hash over everything that the rows of a dataset hold, 64 hex digits.

    Parameters
    ----------
    manifest : Manifest
        Its manifest.

    Notes
    -----
    SHA-256 over the columns, the sensor, and per sequence its number and the hash of its decoded columns. So it does
    not depend on how rows are grouped into shards or compressed, on licence, card or pictures; a part of a dataset has
    another one than the whole.
    """
    sequences = sorted(
        [sequence, digest]
        for shard in manifest.shards
        for sequence, digest in zip(shard.numbers, shard.sequence_hashes, strict=True)
    )
    values = {
        "columns": list(manifest.columns),
        "scan_dtype": manifest.scan_dtype,
        "sensor": manifest.sensor.to_dict(),
        "sequences": sequences,
    }
    return sha256_bytes(json_bytes(values))


def choose_shards(manifest: Manifest, *, split: str | None = None, shards: Iterable[int] | None = None) -> list[int]:
    """Return the positions of the shards that are asked for, ascending.

    Parameters
    ----------
    manifest : Manifest
        Of the whole.
    split : str, optional
        Only shards of this split.
    shards : iterable of int, optional
        Only these positions.

    Raises
    ------
    ConfigError
        If there is no such split or shard, or nothing is left.
    """
    chosen = set(range(len(manifest.shards)))
    if shards is not None:
        asked = set(shards)
        if not asked <= chosen:
            odd = min(asked - chosen)
            raise ConfigError(f"There is no shard {odd}, expected numbers from 0 to {len(manifest.shards) - 1}.")
        chosen = asked
    if split is not None:
        if split not in SPLITS:
            raise ConfigError(f"Unknown split {split!r}; expected {', '.join(SPLITS)}.{did_you_mean(split, SPLITS)}")
        chosen = {k for k in chosen if manifest.shards[k].split == split}
    if not chosen:
        raise ConfigError("No shard is left to get: choose other --shards, or another --split.")
    return sorted(chosen)


def select_shards(manifest: Manifest, chosen: Sequence[int]) -> Manifest:
    """Return the manifest of a copy that holds some shards: itself for all, else one that says it is partial.

    Parameters
    ----------
    manifest : Manifest
        Of the whole, complete.
    chosen : sequence of int
        Positions of the shards, ascending.

    Notes
    -----
    The part keeps the numbers and splits of its sequences; its statistics are those of its own shards.
    """
    if list(chosen) == list(range(len(manifest.shards))):
        return manifest
    kept = tuple(manifest.shards[k] for k in chosen)
    return replace(
        manifest,
        shards=kept,
        complete=False,
        statistics=merge_statistics(shard.statistics for shard in kept),
        partial={
            "manifest_sha256": manifest.to_dict()["manifest_sha256"],
            "shards": len(manifest.shards),
            "sequences": manifest.sequences,
            "rows": manifest.rows,
        },
        card_sha256=None,
    )
