"""Write a dataset sequence by sequence, in the order of their numbers: each into a shard of its split."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy.typing as npt

from navrep_data.shards.card import dataset_card
from navrep_data.shards.entries import SPLITS, SequenceSource, ShardEntry
from navrep_data.shards.manifest import Manifest
from navrep_data.shards.writer import Columns, ShardWriter, publish


class DatasetWriter:
    """Collects sequences, and puts a shard in place whenever it has ``manifest.shard_size`` of them.

    Memory: up to one unfinished shard per split.

    Parameters
    ----------
    root : pathlib.Path
        Dataset folder (must exist).
    manifest : Manifest
        Of the dataset, without shards.
    """

    def __init__(self, root: Path, manifest: Manifest) -> None:
        self._root, self._manifest = root, manifest
        self._open: dict[str, ShardWriter] = {}
        self._sources: dict[str, list[SequenceSource]] = {split: [] for split in SPLITS}
        self._entries: list[ShardEntry] = []

    def append(
        self,
        number: int,
        split: str,
        columns: Columns,
        worlds: Mapping[str, npt.ArrayLike] | None = None,
        source: SequenceSource | None = None,
    ) -> None:
        """Add a sequence.

        Parameters
        ----------
        number : int
            Its number, larger than those before it.
        split : str
            The split that it belongs to.
        columns, worlds
            See :meth:`ShardWriter.append`.
        source : SequenceSource, optional
            Where it came from, in datasets made out of others.

        Raises
        ------
        CorruptDataError, ConfigError
            See :meth:`ShardWriter.append`.
        DiskSpaceError, FolderNotWritableError
            If a finished shard cannot be written.
        """
        m = self._manifest
        if split not in self._open:
            self._open[split] = ShardWriter(
                env=m.env, config=m.config, seed=m.seed, sensor=m.sensor, scan_dtype=m.scan_dtype, columns=m.columns,
                max_humans=m.max_humans, length=m.length, split=split,
            )  # fmt: skip
        writer = self._open[split]
        writer.append(number, columns, worlds)
        if source is not None:
            self._sources[split].append(source)
        if writer.count == m.shard_size:
            self._publish(split)

    def _publish(self, split: str) -> None:
        index = sum(entry.split == split for entry in self._entries)
        entry = publish(self._root, index, self._open.pop(split).finish())
        self._entries.append(replace(entry, source=tuple(self._sources[split])))
        self._sources[split].clear()

    def finish(self) -> Manifest:
        """Write what is unfinished, the card and the manifest; return the manifest of the complete dataset."""
        for split in list(self._open):
            self._publish(split)
        manifest = self._manifest.with_shards(self._entries, complete=True)
        return manifest.save(self._root, dataset_card(manifest))
