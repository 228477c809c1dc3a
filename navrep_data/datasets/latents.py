"""Datasets of codes: what V sees of every row, stored once, so that M trains without the lidar.

A folder like a dataset's: ``manifest.json`` and ``data/train-00000.h5`` with top-level columns of equal length: ``mu``,
``logvar`` and copies of the source's ``robot_state``, ``action``, ``reward``, flags and indices. The manifest names the
encoder by the hash of its weights, and the dataset by that of its content.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import numpy.typing as npt
from torch.utils.data import Dataset

from navrep_data.datasets._batch import Assembler, BatchSpec
from navrep_data.datasets._index import Ints, WindowTable, across_episodes, within_episodes
from navrep_data.datasets._windows import Batch, check_choice, check_rows
from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetNotFoundError,
    SchemaVersionError,
    one_line,
    whole_number,
)
from navrep_data.io import atomic_write_bytes, json_bytes, read_json, reading, safe_join, sha256_bytes
from navrep_data.schema import ACTION_SIZE, ROBOT_STATE_SIZE, SensorContract
from navrep_data.shards import SPLITS, Episodes

FORMAT_NAME = "navrep-data-latents"
FORMAT_VERSION = 2
MANIFEST_FILE = "manifest.json"
_MAX_Z = 512
_MAX_SHARD_BYTES = 1 << 34
Array = npt.NDArray[Any]

_COLUMNS: dict[str, tuple[str, int]] = {
    "mu": ("float32", -1),
    "logvar": ("float32", -1),
    "robot_state": ("float32", ROBOT_STATE_SIZE),
    "action": ("float32", ACTION_SIZE),
    "reward": ("float32", 0),
    "is_first": ("bool", 0),
    "is_last": ("bool", 0),
    "is_terminal": ("bool", 0),
    "event": ("uint8", 0),
    "sequence": ("int32", 0),
    "episode": ("int32", 0),
    "step": ("int32", 0),
}
"""Columns: dtype and numbers per row (0: one, without an axis; -1: the size of z)."""
COPIED_COLUMNS = tuple(name for name in _COLUMNS if name not in ("mu", "logvar"))
"""Columns that are those of the source dataset."""
_FIELDS = (
    "mu", "logvar", "robot_state", "goal_valid", "action", "action_valid", "reward", "is_first", "is_last",
    "is_terminal",
)  # fmt: skip


@dataclass(frozen=True)
class LatentShard:
    """One file of codes: its name, hash, size, rows and split."""

    file: str
    sha256: str
    bytes: int
    rows: int
    split: str


@dataclass(frozen=True)
class LatentManifest:
    """Everything about a latent dataset but its rows.

    Attributes
    ----------
    z_size : int
        Numbers per code.
    encoder : dict
        ``name``, ``weights_sha256`` (of V's weights), ``lidar``.
    source : dict
        ``content_hash``, ``env``, ``physics``, ``rows`` of the dataset that was encoded.
    sensor : dict
        Its sensor contract.
    shards : tuple of LatentShard
        Finished files.
    complete : bool
        Whether all shards of the source are there.
    """

    z_size: int
    encoder: dict[str, Any]
    source: dict[str, Any]
    sensor: dict[str, Any]
    shards: tuple[LatentShard, ...] = field(default=())
    complete: bool = False

    def save(self, root: Path) -> None:
        """Write ``manifest.json`` atomically."""
        values: dict[str, Any] = {"format": FORMAT_NAME, "format_version": FORMAT_VERSION, **asdict(self)}
        values["shards"] = [asdict(shard) for shard in self.shards]
        values["manifest_sha256"] = sha256_bytes(json_bytes(values))
        atomic_write_bytes(root / MANIFEST_FILE, json_bytes(values))

    def with_shard(self, shard: LatentShard, complete: bool) -> LatentManifest:
        """Return a manifest that lists one more shard."""
        return replace(self, shards=(*self.shards, shard), complete=complete)

    @classmethod
    def read(cls, root: Path | str) -> LatentManifest:
        """Read and check the manifest of a latent dataset.

        Raises
        ------
        DatasetNotFoundError
            If there is none.
        SchemaVersionError
            If it is of a later format version.
        CorruptDataError
            If it is not what :meth:`save` writes.
        """
        path = Path(root) / MANIFEST_FILE
        if not path.is_file():
            raise DatasetNotFoundError(
                f"No latent dataset in {root}: there is no {MANIFEST_FILE}. Make one: navrep-data encode DIR --model V"
            )
        found = read_json(path)
        if not isinstance(found, dict) or found.get("format") != FORMAT_NAME:
            kind = found.get("format") if isinstance(found, dict) else type(found).__name__
            raise CorruptDataError(
                f"{path} has format {str(kind)!r}, expected {FORMAT_NAME!r}: M trains on codes, make them first: "
                f"navrep-data encode {root} --model V --out LATENTS"
            )
        if found.get("format_version") != FORMAT_VERSION:
            raise SchemaVersionError(
                f"{path} has format version {found.get('format_version')!r}, this package reads "
                f"{FORMAT_VERSION}. Upgrade it: pip install -U navrep-data"
            )
        hashed = {name: value for name, value in found.items() if name != "manifest_sha256"}
        try:
            if found.get("manifest_sha256") != sha256_bytes(json_bytes(hashed)):
                raise CorruptDataError(f"{path} does not match its own hash: it was changed or damaged; encode again.")
            return cls._parse(found, Path(root))
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
            if isinstance(error, CorruptDataError):
                raise
            raise CorruptDataError(f"{path} lacks or garbles a field ({error!r}); encode again.") from error

    @classmethod
    def _parse(cls, found: dict[str, Any], root: Path) -> LatentManifest:
        z_size = found["z_size"]
        if type(z_size) is not int or not 1 <= z_size <= _MAX_Z:
            raise ValueError(f"z_size {z_size!r}")
        shards = []
        for entry in found["shards"]:
            shard = LatentShard(
                str(entry["file"]), str(entry["sha256"]), int(entry["bytes"]), int(entry["rows"]), str(entry["split"])
            )
            safe_join(root, shard.file)
            if not 0 < shard.bytes <= _MAX_SHARD_BYTES or shard.rows < 1 or shard.split not in SPLITS:
                raise ValueError(f"shard {shard.file}")
            shards.append(shard)
        SensorContract(**found["sensor"])
        dicts = [dict(found[name]) for name in ("encoder", "source", "sensor")]
        return cls(z_size, dicts[0], dicts[1], dicts[2], tuple(shards), bool(found["complete"]))


def latent_shard_bytes(columns: Mapping[str, Array]) -> bytes:
    """Return an HDF5 file of columns (rows, ...), the same bytes for the same columns."""
    memory = io.BytesIO()
    with h5py.File(memory, "w", libver=("v110", "v110")) as file:
        for name, (dtype, _) in _COLUMNS.items():
            file.create_dataset(name, data=np.ascontiguousarray(columns[name], dtype), track_times=False)
    return memory.getvalue()


def write_latent_shard(root: Path, name: str, split: str, columns: Mapping[str, Array]) -> LatentShard:
    """Write the codes of the shard `name` of a dataset atomically and return the entry for the manifest."""
    data = latent_shard_bytes(columns)
    (root / name).parent.mkdir(parents=True, exist_ok=True)
    atomic_write_bytes(root / name, data)
    return LatentShard(name, hashlib.sha256(data).hexdigest(), len(data), len(columns["mu"]), split)


def read_latent_shard(root: Path, shard: LatentShard, z_size: int) -> dict[str, Array]:
    """Return all columns of a shard after checking its hash and layout.

    Raises
    ------
    CorruptDataError
        If the file is missing, changed, or not what the manifest says.
    """
    path = safe_join(root, shard.file)
    if not path.is_file() or path.stat().st_size != shard.bytes:
        raise CorruptDataError(
            f"{path} is missing or does not have {shard.bytes:,} bytes; run the encode command again."
        )
    with reading(path):
        data = path.read_bytes()
    if sha256_bytes(data) != shard.sha256:
        raise CorruptDataError(f"{path} does not have the SHA-256 of the manifest; run the encode command again.")
    columns: dict[str, Array] = {}
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            for name, (dtype, width) in _COLUMNS.items():
                columns[name] = _column(file, name, dtype, width if width >= 0 else z_size, shard.rows)
    except Exception as error:  # a damaged file makes the HDF5 library raise nearly anything
        raise CorruptDataError(f"{path} is not a shard of codes ({error}); encode again.") from error
    return columns


def _column(file: Any, name: str, dtype: str, width: int, rows: int) -> Array:
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"column {name} is missing or a link")
    data = file[name]
    wanted = (rows, width) if width else (rows,)
    if not isinstance(data, h5py.Dataset) or data.shape != wanted or data.dtype != np.dtype(dtype):
        raise ValueError(f"column {name} is not {wanted} {dtype}")
    if data.is_virtual or data.external:
        raise ValueError(f"column {name} points outside the file")
    if data.chunks is not None or data.id.get_storage_size() != data.nbytes:
        # as written: one piece, unpacked, so that no column is larger than its file
        raise ValueError(f"column {name} is not stored in one piece")
    return np.asarray(data[()])


class LatentDataset(Dataset[Batch]):
    """Windows of consecutive codes, as dictionaries of tensors, held in memory.

    Parameters
    ----------
    root : path-like
        Folder written by ``navrep-data encode``.
    window : int
        W, rows per window.
    stride : int, optional
        Rows between the starts of two windows; W by default.
    split : {"train", "val", "test"} or None
        Part of the dataset (by sequence), None for all.
    action : {"taken", "leading"}
        The action chosen at a row, or the one that led to it (zero on an episode's first row).
    across_episodes : bool
        Cut whole sequences into windows, as the original does, instead of episodes.

    Raises
    ------
    DatasetNotFoundError, SchemaVersionError, CorruptDataError
        If there is no such dataset, or it is damaged.
    ConfigError
        If an argument cannot be used.

    Notes
    -----
    Fields: ``mu``, ``logvar`` (W, Z), ``robot_state`` (W, 5), ``goal_valid`` (W,), ``action`` (W, 3),
    ``action_valid``, ``reward``, ``is_first``, ``is_last``, ``is_terminal`` and ``mask`` (W,); rows past an episode's
    end are zero and ``mask`` is False there, and an unknown goal (imports) is zero with ``goal_valid`` False.
    Draw z anew every epoch as ``mu + exp(logvar / 2) * noise``.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        window: int = 64,
        stride: int | None = None,
        split: Literal["train", "val", "test"] | None = None,
        action: Literal["taken", "leading"] = "taken",
        across_episodes: bool = False,
    ) -> None:
        check_choice("action", action, ("taken", "leading"))
        check_choice("split", split, (*SPLITS, None))
        window = check_rows("window", window)
        stride = window if stride is None else check_rows("stride", stride)
        self.root = Path(root)
        self.manifest = LatentManifest.read(self.root)
        self.root = self.root.absolute()  # shards are read later, perhaps from another working folder
        self._rows, episodes = self._load(split)
        self.spec = BatchSpec(
            window=window, fields=_FIELDS, leading=action == "leading", targets=False, blank=False, normalized=False,
            invalid=0.0, fill=False, range_max=1.0, columns=frozenset(_COLUMNS),
        )  # fmt: skip
        self._assemble = Assembler(self.spec)
        self.table = (_whole_windows if across_episodes else within_episodes)(episodes, window, stride)
        if len(self.table) == 0:
            raise ConfigError(f"No window of {window} rows fits into {self.root}; expected a smaller window.")

    def _load(self, split: str | None) -> tuple[dict[str, Array], Episodes]:
        """Return the rows of the sequences of a split, one after the other, and the episodes in them."""
        parts = [
            read_latent_shard(self.root, shard, self.manifest.z_size)
            for shard in self.manifest.shards
            if split in (None, shard.split)
        ]
        rows = {name: np.concatenate([part[name] for part in parts]) if parts else np.zeros(0) for name in _COLUMNS}
        if len(rows["mu"]) == 0:
            what = "no rows" if split is None else f"nothing in split {split!r}"
            raise ConfigError(f"{self.root} has {what}. Encode more, or choose another split.")
        if split is None:  # windows are cut from sequences in the order of their numbers
            order = np.argsort(rows["sequence"], kind="stable")
            rows = {name: values[order] for name, values in rows.items()}
        start = np.flatnonzero(rows["is_first"])
        if start[:1].tolist() != [0]:
            raise CorruptDataError(f"{self.root} does not start with an episode's first row; encode again.")
        stop = np.append(start[1:], len(rows["mu"]))
        zero = np.zeros(len(start), np.int64)
        episodes = Episodes(
            rows["sequence"][start].astype(np.int64), rows["episode"][start].astype(np.int64), zero, start,
            stop - start, rows["event"][stop - 1], zero.astype(np.int8),
        )  # fmt: skip
        return rows, episodes

    @property
    def z_size(self) -> int:
        """Numbers per code."""
        return self.manifest.z_size

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.table)

    def batch(self, indices: Sequence[int] | Ints) -> Batch:
        """Return several windows stacked; see the class's notes.

        Raises
        ------
        IndexError
            If an index is out of range.
        """
        index = np.asarray(indices)
        n = len(self.table)
        if index.ndim != 1 or len(index) == 0 or index.dtype.kind not in "iu" or index.min() < -n or index.max() >= n:
            raise IndexError(f"indices {one_line(repr(index))} do not fit {n} windows.")
        chosen, table = np.mod(index.astype(np.int64), n), self.table
        return self._assemble(self._rows, table.start[chosen], table.count[chosen], table.after[chosen])

    def __getitem__(self, index: int) -> Batch:
        """Return one window."""
        number = whole_number(index)
        if number is None:
            raise IndexError(f"index is {one_line(repr(index))}, expected a whole number.")
        return {name: value[0] for name, value in self.batch([number]).items()}

    def __getitems__(self, indices: Sequence[int]) -> list[Batch]:
        """Return several windows as a list; ``DataLoader`` calls this once per batch."""
        batch = self.batch(indices)
        return [{name: value[i] for name, value in batch.items()} for i in range(len(indices))]


def _whole_windows(episodes: Episodes, window: int, stride: int) -> WindowTable:
    """Cut sequences into whole windows at ``k * stride``; what is left at the end of a sequence is dropped."""
    # across_episodes starts at row 1 and wants one row after the window: two rows fewer, shifted by one
    table = across_episodes(episodes, window - 2, stride)
    return replace(table, start=table.start - 1, step=table.step - 1, count=table.count + 2)
