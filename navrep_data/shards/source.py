"""Where the sequences of a dataset came from that was made out of others: per sequence (content hash, sequence, row).

Notes
-----
A tool (merge, split, filter) takes runs of rows over as they are, so three values say where every row was: the content
hash of the sequence it was generated in, that sequence's number, and the run's first row there. Tools pass them on, so
they always name what was generated or imported, however many tools came between. The hash is that of the sequence, not
of its dataset: it is the same in a part of a dataset and in one that was extended, which is what keeps rows of one
sequence from getting into two splits.
"""

from __future__ import annotations

from typing import Any

from navrep_data.shards._fields import SHA256, Fields
from navrep_data.shards.entries import SequenceSource

MAX_INDEX = 1 << 31


def parse_datasets(fields: Fields) -> tuple[dict[str, Any], ...]:
    """Return the field ``source`` of a manifest: a record per dataset; empty where it is absent.

    Raises
    ------
    CorruptDataError
        If it is not a list of objects with a ``content_hash``.
    """
    if "source" not in fields.values:
        return ()
    records = fields.get("source", list)
    if not records:
        fields.bad("source", "a list of datasets")
    for k, record in enumerate(records):
        Fields(record, fields.path, f"source[{k}].").sha256("content_hash")
    return tuple(records)


def parse_sources(fields: Fields, datasets: int, sequences: int) -> tuple[SequenceSource, ...]:
    """Return the field ``source`` of a shard's entry; empty where the dataset has none.

    Parameters
    ----------
    fields : Fields
        The entry.
    datasets : int
        Length of the manifest's `source`.
    sequences : int
        Number of sequences in the shard.

    Raises
    ------
    CorruptDataError
        If it is there and should not be, or the other way round, or does not have one [dataset, sequence, row, content
        hash] per sequence.
    """
    if not datasets and "source" not in fields.values:
        return ()
    values = fields.get("source", list)
    if len(values) != sequences or not all(_is_source(value, datasets) for value in values):
        fields.bad("source", f"{sequences} lists of dataset (below {datasets}), sequence, row and content hash")
    return tuple(SequenceSource(*value) for value in values)


def _is_source(value: Any, datasets: int) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 4
        and all(type(v) is int and 0 <= v < MAX_INDEX for v in value[:3])
        and value[0] < datasets
        and isinstance(value[3], str)
        and SHA256.fullmatch(value[3]) is not None
    )
