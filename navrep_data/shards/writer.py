"""Build one shard in memory, then put it in place in one atomic write.

Memory: the compressed chunks, and while :meth:`ShardWriter.finish` runs twice more of them, so a shard's size
is bounded by its plan (:data:`MAX_SHARD_BYTES`). In return a full disk is one clean error, and equal
sequences are equal bytes whatever happened in between.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from navrep_data.errors import ConfigError, CorruptDataError
from navrep_data.io import atomic_write_bytes, sha256_bytes, translate_os_error
from navrep_data.schema import (
    COLUMNS,
    CONTACT_STATIC,
    EVENT_NAMES,
    FORMAT_NAME,
    FORMAT_VERSION,
    LABEL_HUMAN,
    Event,
    SensorContract,
)
from navrep_data.shards._attributes import write_attribute
from navrep_data.shards._codec import DEFLATE_LEVEL, encode
from navrep_data.shards._layout import Layout, column_attributes, layouts, little_endian
from navrep_data.shards.entries import SPLITS, FileEntry, Ranges, ShardEntry, ranges_of, shard_file, worlds_file
from navrep_data.shards.statistics import ShardStatistics, scan_scale
from navrep_data.shards.worlds import Arrays, as_worlds, concatenate_worlds, worlds_bytes

MAX_SHARD_BYTES = 512 << 20
"""Largest estimated size of a shard that a plan may ask for."""
# HDF5 1.8 is the oldest format with checksummed metadata; MATLAB, Julia and every h5py read it.
_LIBVER = ("v108", "v108")
# Room for headers and chunk index beside the chunks: the file image then never has to grow and be copied.
_HEADER_ROOM = 1 << 20
DERIVED_COLUMNS = ("rings",)
"""Functions of other columns: not in the sequence hash, which is then the same with and without them."""

Columns = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class ShardImage:
    """A finished shard in memory.

    Attributes
    ----------
    rows : int
        Number of rows.
    split : str
        The split that it belongs to.
    sequences : tuple of (start, stop)
        Numbers of its sequences, as ranges [start, stop).
    data : bytes
        The HDF5 file.
    data_sha256 : str
        Its SHA-256.
    worlds : bytes or None
        The worlds file.
    worlds_sha256 : str or None
        Its SHA-256.
    statistics : dict
        See :mod:`navrep_data.shards.statistics`.
    sequence_hashes : tuple of str
        Content hash per sequence, see :func:`sequence_hash`.
    """

    rows: int
    split: str
    sequences: Ranges
    data: bytes
    data_sha256: str
    worlds: bytes | None
    worlds_sha256: str | None
    statistics: dict[str, Any]
    sequence_hashes: tuple[str, ...]


def canonical(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return `array` little-endian, C-contiguous, with one bit pattern for NaN."""
    array = little_endian(array)
    if array.dtype.kind == "f":
        unknown = np.isnan(array)
        if unknown.any():
            array = array.copy()
            array[unknown] = np.nan
    return array


def sequence_hash(columns: Columns) -> str:
    """Return the SHA-256 over the decoded columns of one sequence: comparable across machines.

    Parameters
    ----------
    columns : mapping of str to ndarray
        All columns in the schema's order; floats with one kind of NaN.

    Notes
    -----
    Hashed per column: name, dtype and shape as ASCII, then the little-endian C-order bytes. Rings are left
    out: they are a function of the scan, which ``verify`` checks by itself.
    """
    digest = hashlib.sha256()
    for name, array in columns.items():
        if name not in DERIVED_COLUMNS:
            digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode("ascii"))
            digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def check_labels(columns: Columns) -> str:
    """Return what is wrong with the labels and contacts of one sequence, or an empty string."""
    if "scan_label" in columns and "humans" in columns:
        filled = (~np.isnan(columns["humans"][:, :, 0])).sum(axis=1)  # slots are filled from the first
        most = columns["scan_label"].max(axis=1)
        odd = np.flatnonzero(most >= LABEL_HUMAN + filled)
        if len(odd):
            row, limit = odd[0], LABEL_HUMAN - 1 + filled[odd[0]]
            return (
                f"column 'scan_label' holds {most[row]} in row {row}, expected at most {limit}: 'humans' has "
                f"{filled[row]} people there"
            )
    if "contact" in columns and columns["contact"].max() > CONTACT_STATIC:
        return f"column 'contact' holds {int(columns['contact'].max())}, expected 0 to {CONTACT_STATIC}"
    return ""


def check_index(columns: Columns, sequence: int) -> str:
    """Return what is wrong with the index columns of one sequence, or an empty string.

    Parameters
    ----------
    columns : mapping of str to ndarray
        At least sequence, episode, step, is_first, is_last, is_terminal, event.
    sequence : int
        The index that it must have.
    """
    first, last = columns["is_first"], columns["is_last"]
    if not first[0] or not last[-1] or not np.array_equal(first[1:], last[:-1]):
        return "is_first and is_last do not cut it into whole episodes"
    if (columns["sequence"] != sequence).any():
        return f"column 'sequence' is {int(columns['sequence'][0])}, expected {sequence} on every row"
    episode = np.cumsum(first) - 1
    if not np.array_equal(columns["episode"], episode):
        return "column 'episode' does not count 0, 1, 2, ... within the sequence"
    rows = np.arange(len(first))
    if not np.array_equal(columns["step"], rows - np.flatnonzero(first)[episode]):
        return "column 'step' does not count 0, 1, 2, ... within each episode"
    event = columns["event"]
    if event.max() >= len(EVENT_NAMES) or not np.array_equal(event != Event.NONE, last):
        return f"column 'event' is not 1 to {len(EVENT_NAMES) - 1} on each episode's last row and 0 elsewhere"
    if not np.array_equal(columns["is_terminal"], np.isin(event, [e for e in Event if e.terminal])):
        return "column 'is_terminal' does not follow from column 'event'"
    return ""


def check_finite(name: str, array: npt.NDArray[Any]) -> str:
    """Return what is wrong with the floats of a column (infinity, misplaced NaN), or an empty string."""
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return ""
    if COLUMNS[name].may_be_nan and not np.isinf(array).any():
        return ""
    return f"column {name!r} holds NaN or infinity"


class ShardWriter:
    """Collects the sequences of one shard.

    Parameters
    ----------
    env : str
        Environment name.
    config : dict
        The whole configuration as JSON values.
    seed : int
        Dataset seed, 0 to 2**64 - 1.
    sensor : SensorContract
        What a scan means.
    scan_dtype : {"uint16", "float32"}
        How scans are stored.
    columns : sequence of str
        Columns to store; those that are not optional in the schema must be among them.
    max_humans : int
        Slots of the humans column (ignored without it).
    length : int
        Rows of a sequence; a sequence may have fewer.
    split : str
        The split that all its sequences belong to.
    made_by : str
        See ``navrep_data/shards/recipe.py``; empty where they are not generated.

    Raises
    ------
    ConfigError
        If a setting cannot be used.
    """

    def __init__(
        self,
        *,
        env: str,
        config: dict[str, Any],
        seed: int,
        sensor: SensorContract,
        scan_dtype: str,
        columns: Sequence[str],
        max_humans: int,
        length: int,
        split: str,
        made_by: str = "",
    ) -> None:
        if not 0 <= seed < 1 << 64:
            raise ConfigError(f"seed is {seed}; expected 0 to 2**64 - 1.")
        if split not in SPLITS:
            raise ConfigError(f"split is {split!r}; expected one of: {', '.join(SPLITS)}.")
        self.layouts = layouts(columns, sensor, scan_dtype, max_humans, length)
        self._env, self._config, self._seed, self._sensor = env, config, seed, sensor
        self._length, self._split, self._made_by = length, split, made_by
        self._rows = 0
        self._numbers: list[int] = []
        self._chunks: dict[str, list[bytes]] = {name: [] for name in self.layouts}
        self._pending: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in self.layouts}
        self._hashes: list[str] = []
        self._worlds: list[Arrays] = []
        self._statistics = ShardStatistics(scan_scale(self.layouts["scan"].dtype))
        self._finished = False

    @property
    def count(self) -> int:
        """Number of sequences so far."""
        return len(self._numbers)

    def append(self, index: int, columns: Columns, worlds: Mapping[str, npt.ArrayLike] | None = None) -> None:
        """Add one sequence.

        Parameters
        ----------
        index : int
            Its number in the dataset, larger than those before it.
        columns : mapping of str to ndarray
            Every column, of 1 to `length` rows, in exactly the stored dtype.
        worlds : mapping of str to array_like, optional
            Arrays of :data:`navrep_data.shards.WORLD_FIELDS` for this sequence alone: `row` counted from its
            first row, offsets starting at 0. All sequences of a shard have worlds, or none.

        Raises
        ------
        CorruptDataError
            If a column is missing, unexpected, or has another shape, dtype or content than the format asks
            for. The writer is then as before the call.
        """
        if self._finished:
            raise RuntimeError("ShardWriter.finish was called; expected no more sequences. Make a new ShardWriter.")
        least = self._numbers[-1] + 1 if self._numbers else 0
        if not least <= index < 1 << 31:
            raise ConfigError(f"The sequence's number is {index}; expected {least} to 2**31 - 1.")
        ready = self._checked(columns, index)
        part = None
        if worlds is not None:
            part = as_worlds(worlds)
            self._check_worlds(part, ready, index)
            part = {**part, "row": part["row"] + np.int32(self._rows)}
        if self._hashes and (part is None) == bool(self._worlds):
            raise CorruptDataError(
                f"Sequence {index} has {'no ' if part is None else ''}worlds, unlike those before it."
            )
        if part is not None:
            self._worlds.append(part)
        self._statistics.add(ready)
        self._hashes.append(sequence_hash(ready))
        self._numbers.append(index)
        for name, array in ready.items():
            self._store(name, array)
        self._rows += len(ready["step"])

    def _checked(self, columns: Columns, index: int) -> dict[str, npt.NDArray[Any]]:
        where = f"Sequence {index}"
        odd = sorted(set(columns) ^ set(self.layouts))
        if odd:
            what = "is missing" if odd[0] in self.layouts else "is not a column of this shard"
            raise CorruptDataError(f"{where}: column {odd[0]!r} {what}; expected {', '.join(self.layouts)}.")
        rows = len(columns["step"])
        if not 1 <= rows <= self._length:
            raise CorruptDataError(f"{where} has {rows} rows; expected 1 to {self._length}.")
        ready = {}
        for name, layout in self.layouts.items():
            array = columns[name]
            if array.shape != (rows, *layout.row_shape) or array.dtype != layout.dtype:
                raise CorruptDataError(
                    f"{where}: column {name!r} is {array.dtype} {array.shape}; "
                    f"expected {layout.dtype} {(rows, *layout.row_shape)}."
                )
            ready[name] = canonical(array)
        bad = "; ".join(filter(None, (check_finite(*item) for item in ready.items())))
        if bad:
            raise CorruptDataError(f"{where}: {bad}; expected finite numbers.")
        if "rings" in ready and ready["rings"].max() > 2:
            raise CorruptDataError(f"{where}: column 'rings' holds {ready['rings'].max()}; expected 0, 1 or 2.")
        problem = check_labels(ready) or check_index(ready, index)
        if problem:
            raise CorruptDataError(f"{where}: {problem}.")
        return ready

    @staticmethod
    def _check_worlds(part: Arrays, columns: Columns, index: int) -> None:
        starts = np.flatnonzero(columns["is_first"])
        if not (
            np.array_equal(part["row"], starts)
            and np.array_equal(part["episode"], columns["episode"][starts])
            and (part["sequence"] == index).all()
        ):
            raise CorruptDataError(
                f"Sequence {index}: worlds 'sequence', 'episode', 'row' do not match its {len(starts)} episodes."
            )

    def _store(self, name: str, array: npt.NDArray[Any]) -> None:
        """Compress the whole chunks, keep the rest for the next sequence."""
        chunk = self.layouts[name].chunk
        pending = self._pending[name]
        if pending:
            array = np.concatenate([*pending, array])
            pending.clear()
        whole = len(array) - len(array) % chunk
        self._chunks[name] += [encode(array[k : k + chunk]) for k in range(0, whole, chunk)]
        if whole < len(array):
            pending.append(array[whole:].copy())

    def finish(self) -> ShardImage:
        """Return the finished shard; the writer is empty afterwards.

        Raises
        ------
        CorruptDataError
            If there is no sequence.
        """
        if not self._hashes:
            raise CorruptDataError("A shard without sequences; expected at least one before ShardWriter.finish.")
        self._finished = True
        room = sum(len(c) + 64 for chunks in self._chunks.values() for c in chunks) + _HEADER_ROOM
        with h5py.File("shard", "w", driver="core", backing_store=False, block_size=room, libver=_LIBVER) as file:
            for name, value in self._attributes().items():
                write_attribute(file, name, value)
            for name, layout in self.layouts.items():
                self._write_column(file, name, layout)
            file.flush()
            data: bytes = file.id.get_file_image()
        worlds = worlds_bytes(concatenate_worlds(self._worlds)) if self._worlds else None
        return ShardImage(
            rows=self._rows,
            split=self._split,
            sequences=ranges_of(self._numbers),
            data=data,
            data_sha256=sha256_bytes(data),
            worlds=worlds,
            worlds_sha256=None if worlds is None else sha256_bytes(worlds),
            statistics=self._statistics.to_dict(),
            sequence_hashes=tuple(self._hashes),
        )

    def _attributes(self) -> dict[str, Any]:
        sensor = self._sensor
        made_by = {"made_by": self._made_by} if self._made_by else {}
        return {
            "format": FORMAT_NAME,
            "format_version": np.int32(FORMAT_VERSION),
            "env": self._env,
            "config": json.dumps(self._config, allow_nan=False),
            "seed": np.uint64(self._seed),
            **made_by,
            "split": self._split,
            "first_sequence": np.int64(self._numbers[0]),
            "sequences": np.int64(len(self._numbers)),
            "rows": np.int64(self._rows),
            "length": np.int64(self._length),
            "n_rays": np.int64(sensor.n_rays),
            "angle_min": np.float64(sensor.angle_min),
            "angle_increment": np.float64(sensor.angle_increment),
            "range_max": np.float64(sensor.range_max),
            "dt": np.float64(sensor.dt),
        }

    def _write_column(self, file: Any, name: str, layout: Layout) -> None:
        # A shard smaller than a chunk: nothing has been compressed yet, and HDF5 wants chunks within the
        # extent.
        chunk = min(layout.chunk, self._rows)
        tail = self._pending[name]
        if tail:
            block = np.zeros((chunk, *layout.row_shape), layout.dtype)
            block[: len(tail[0])] = tail[0]
            self._chunks[name].append(encode(block))
        dataset = file.create_dataset(
            name,
            shape=(self._rows, *layout.row_shape),
            dtype=layout.dtype,
            chunks=(chunk, *layout.row_shape),
            shuffle=layout.dtype.itemsize > 1,
            compression="gzip",
            compression_opts=DEFLATE_LEVEL,
        )
        for key, value in column_attributes(layout).items():
            dataset.attrs[key] = value
        zeros = (0,) * len(layout.row_shape)
        for k, data in enumerate(self._chunks[name]):
            dataset.id.write_direct_chunk((k * chunk, *zeros), data)
        self._chunks[name] = []
        self._pending[name] = []


def publish(root: Path | str, index: int, image: ShardImage) -> ShardEntry:
    """Write a finished shard to its place: worlds first, then data, each atomically.

    Parameters
    ----------
    root : path-like
        Dataset folder (must exist).
    index : int
        Number of the shard in its split.
    image : ShardImage
        From :meth:`ShardWriter.finish`.

    Returns
    -------
    ShardEntry
        For the manifest.

    Raises
    ------
    DiskSpaceError, FolderNotWritableError
        If it cannot be written; what was there before is intact.
    """
    root = Path(root)
    try:
        for file, _ in shard_files(index, image):
            (root / file).parent.mkdir(exist_ok=True)
    except OSError as error:
        raise translate_os_error(error, root) from error
    for file, content in shard_files(index, image):
        atomic_write_bytes(root / file, content)
    return shard_entry(index, image)


def shard_files(index: int, image: ShardImage) -> list[tuple[str, bytes]]:
    """Return names and contents of a shard's files, in the order in which to write them: worlds first."""
    worlds = [] if image.worlds is None else [(worlds_file(shard_file(image.split, index)), image.worlds)]
    return [*worlds, (shard_file(image.split, index), image.data)]


def shard_entry(index: int, image: ShardImage) -> ShardEntry:
    """Return what the manifest lists of a shard that is in its place."""
    worlds = None
    if image.worlds is not None and image.worlds_sha256 is not None:
        worlds = FileEntry(worlds_file(shard_file(image.split, index)), image.worlds_sha256, len(image.worlds))
    return ShardEntry(
        file=shard_file(image.split, index),
        sha256=image.data_sha256,
        bytes=len(image.data),
        rows=image.rows,
        split=image.split,
        sequences=image.sequences,
        worlds=worlds,
        statistics=image.statistics,
        sequence_hashes=image.sequence_hashes,
    )
