"""Statistics of a dataset, or of one of its splits."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from navrep_data.datasets.tools._pieces import Given
from navrep_data.datasets.tools.edits import crowd_sizes
from navrep_data.errors import ConfigError
from navrep_data.schema import EVENT_NAMES
from navrep_data.shards.statistics import ShardStatistics, merge_statistics, scan_scale

QUANTILES = (0.0, 0.25, 0.5, 0.75, 1.0)


def stats(root: str | os.PathLike[str], *, split: str | None = None) -> dict[str, Any]:
    """Return counts, means, spreads and ranges of every column, how episodes ended, how long they and crowds were.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    split : {"train", "val", "test"}, optional
        Of the sequences of this split only, computed from its rows; by default of all, as the manifest has it.

    Returns
    -------
    dict
        JSON values: ``sequences``, ``episodes``, ``rows``; ``columns`` and ``outcomes`` as in the manifest's
        statistics; ``steps`` (least, quartiles, most steps per episode, by outcome and for ``all``); ``humans``
        (episodes by size of the crowd; empty where that is not recorded).

    Raises
    ------
    ConfigError
        If there is no such split, or it is empty.
    DatasetNotFoundError, DatasetError, CorruptDataError
        If the dataset cannot be read.
    """
    given = Given(root)
    folder = given.folder
    e = folder.episodes
    chosen = e.in_split(split)
    if not len(chosen):
        raise ConfigError(f"Nothing is left: {root} has no sequence in split {split}.")
    if split is None:
        found = given.manifest.statistics
    else:
        parts = []
        for piece in given.pieces():
            if piece.split != split:
                continue
            columns = {c: folder.read(c, piece.shard, piece.start, piece.stop) for c in given.manifest.columns}
            one = ShardStatistics(scan_scale(columns["scan"].dtype))
            one.add(columns)
            parts.append(one.to_dict())
        found = merge_statistics(parts)
    steps = e.length[chosen] - 1
    ended = {name: steps[e.event[chosen] == code] for code, name in enumerate(EVENT_NAMES)}
    recorded = "humans" in given.manifest.columns or all(s.worlds for s in given.manifest.shards)
    crowds = np.unique(crowd_sizes(folder)[chosen], return_counts=True) if recorded else ((), ())
    return {
        "root": str(root),
        "split": split,
        "sequences": len(np.unique(e.sequence[chosen])),
        "episodes": len(chosen),
        "rows": int(e.length[chosen].sum()),
        "outcomes": found["outcomes"],
        "steps": {n: np.quantile(v, QUANTILES).tolist() for n, v in {"all": steps, **ended}.items() if len(v)},
        "humans": {str(n): int(count) for n, count in zip(*crowds, strict=True)},
        "columns": found["columns"],
    }
