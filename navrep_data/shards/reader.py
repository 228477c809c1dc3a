"""Read one shard that may come from anywhere.

The HDF5 library opens a file once, to check its structure and to collect where its chunks lie. Rows are then
read by ``os.pread`` and decoded by us: safe in threads and after a fork, no library lock, no handle to leak,
and inflating is bounded by the chunk's size. Columns without deflate (written by plain h5py) are read through h5py,
slower. All rows and chunks must be in the file, none twice: what a column takes in memory is bounded by its file.
"""

from __future__ import annotations

import math
import os
import threading
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from navrep_data.errors import CorruptDataError, DatasetNotFoundError, SchemaVersionError
from navrep_data.io import raise_refusal, reading
from navrep_data.schema import COLUMNS, FORMAT_NAME, FORMAT_VERSION, SensorContract
from navrep_data.shards._attributes import read_attribute
from navrep_data.shards._codec import inflate, unshuffle
from navrep_data.shards._layout import Layout, layouts
from navrep_data.shards.entries import ShardEntry, check_version

_DEFLATE, _SHUFFLE, _FLETCHER = 1, 2, 3
_FLETCHER_BYTES = 4
# Deflate, shuffle, fletcher32, and h5py's built-in lzf: what a plain h5py can read everywhere.
_LZF = 32000
_KNOWN_FILTERS = frozenset({_DEFLATE, _SHUFFLE, _FLETCHER, _LZF})
_MAX_CHUNK_BYTES = 64 << 20
# A narrow column is cached whole; no shard of ours comes near this.
_MAX_NARROW_BYTES = 256 << 20
_ADVICE = "Run `navrep-data verify` on its folder, then get the file again or run the generate command again"

Array = npt.NDArray[Any]


class _Chunked:
    """Where the chunks of one column lie, and which filters were left out of which of them.

    Filters are those of our own writer and of h5py's gzip: deflate, perhaps after shuffle, perhaps before fletcher32.
    """

    def __init__(self, layout: Layout, shape: tuple[int, ...], grid: tuple[int, ...], codes: list[int]) -> None:
        self.layout, self.shape, self.grid, self.codes = layout, shape, grid, codes
        self.chunk = shape[0]
        self.whole_rows = shape[1:] == layout.row_shape
        self.chunk_bytes = math.prod(shape) * layout.dtype.itemsize
        count = math.prod(grid)
        self.offsets, self.sizes = np.full(count, -1, np.int64), np.zeros(count, np.int64)
        self.masks = np.zeros(count, np.int64)
        self.row_items = layout.row_bytes // layout.dtype.itemsize

    def note(self, info: Any) -> None:
        """Take up what the HDF5 library says of one chunk."""
        k = 0
        for n, size, at in zip(self.grid, self.shape, info.chunk_offset, strict=True):
            k = k * n + at // size
        self.offsets[k], self.sizes[k], self.masks[k] = info.byte_offset, info.size, info.filter_mask

    def applied(self, code: int, k: int) -> bool:
        """Return whether chunk `k` went through a filter: HDF5 leaves optional ones out where they do not help."""
        return code in self.codes and not int(self.masks[k]) >> self.codes.index(code) & 1


class Shard:
    """One shard, checked when opened and read row by row.

    Parameters
    ----------
    path : path-like
        The HDF5 file.
    expected : ShardEntry, optional
        What the manifest says: rows, split and number of sequences must be these.

    Attributes
    ----------
    rows : int
        Number of rows.
    split : str
        The split that it belongs to.
    first_sequence, sequences : int
        Number of its first sequence in the dataset, and how many it has.
    env : str
        Environment that made it.
    sensor : SensorContract
        What a scan means.
    columns : dict of str to Layout
        Its columns: dtype and shape per row.

    Raises
    ------
    DatasetNotFoundError
        If there is no such file.
    SchemaVersionError
        If it is of another format version than this one reads.
    CorruptDataError
        If it is not a shard, or has links, virtual or external data, references, unknown filters, or columns
        that differ from the format or from `expected`.

    Notes
    -----
    Threads may share one; it can be pickled and survives a fork. Columns come in their stored dtypes.
    """

    def __init__(self, path: Path | str, expected: ShardEntry | None = None) -> None:
        self.path = Path(path)
        self.columns: dict[str, Layout] = {}
        self._chunked: dict[str, _Chunked] = {}
        self._narrow: dict[str, Array] = {}
        self._last: dict[str, tuple[int, bytes]] = {}
        self._fd: int | None = None
        self._lock = threading.Lock()
        if not self.path.is_file():
            raise DatasetNotFoundError(f"Shard {self.path} is missing. {_ADVICE}.")
        try:
            with h5py.File(self.path, "r") as file:
                self._open(file)
        except CorruptDataError:
            raise
        except SchemaVersionError:
            raise
        except Exception as error:  # a damaged file makes the HDF5 library raise nearly anything
            raise_refusal(error, self.path)
            raise self._corrupt(f"is not readable as HDF5 ({_first_line(error)})") from error
        if expected is None:
            return
        if self.split != expected.split:
            raise self._corrupt(f"belongs to split {self.split!r}, the manifest says {expected.split!r}")
        wanted = expected.rows, expected.count, expected.sequences[0][0]
        if (self.rows, self.sequences, self.first_sequence) != wanted:
            raise self._corrupt(
                f"has {self.rows} rows of {self.sequences} sequences from {self.first_sequence} on, "
                f"the manifest says {wanted[0]} of {wanted[1]} from {wanted[2]} on"
            )

    def __repr__(self) -> str:
        return f"Shard({str(self.path)!r}, rows={self.rows}, split={self.split!r}, sequences={self.sequences})"

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_fd": None, "_lock": None, "_last": {}, "_narrow": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def __del__(self) -> None:
        if getattr(self, "_fd", None) is not None:
            self.close()

    def close(self) -> None:
        """Close the file; reading opens it again."""
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)

    def read(self, column: str, start: int, stop: int) -> Array:
        """Return rows [start, stop) of a column.

        Parameters
        ----------
        column : str
            Column name.
        start, stop : int
            Rows, 0 <= start <= stop <= rows.

        Returns
        -------
        ndarray of shape (stop - start, ...)
            In the stored dtype, writable, not shared.

        Raises
        ------
        KeyError
            If the shard has no such column.
        IndexError
            If the rows are not in it.
        CorruptDataError
            If the bytes are damaged.
        """
        layout = self._layout(column)
        if not 0 <= start <= stop <= self.rows:
            raise IndexError(f"Rows {start} to {stop} are not in {self.path}; expected within 0 to {self.rows}.")
        chunked = self._chunked.get(column)
        if not layout.column.wide or chunked is None:
            return (
                self._whole(column, chunked)[start:stop].copy()
                if not layout.column.wide
                else self._by_h5py(column, start, stop)
            )
        return self._rows(chunked, start, stop)

    def read_rows(self, column: str, indices: npt.ArrayLike) -> Array:
        """Return the rows at `indices`, in their order; each chunk is decoded once.

        Parameters
        ----------
        column : str
            Column name.
        indices : array_like of int, shape (n,)
            Row numbers.

        Returns
        -------
        ndarray of shape (n, ...)
            In the stored dtype.
        """
        layout = self._layout(column)
        rows = np.asarray(indices, dtype=np.int64)
        if rows.size and not (rows.min() >= 0 and rows.max() < self.rows):
            raise IndexError(f"Rows {rows.min()} to {rows.max()} are not all in {self.path}, which has {self.rows}.")
        chunked = self._chunked.get(column)
        if not layout.column.wide:
            return self._whole(column, chunked)[rows]
        out = np.empty((len(rows), *layout.row_shape), layout.dtype)
        step = chunked.chunk if chunked else layout.chunk
        for chunk in np.unique(rows // step):
            mine = np.flatnonzero(rows // step == chunk)
            first = int(chunk) * step
            out[mine] = self.read(column, first, min(first + step, self.rows))[rows[mine] - first]
        return out

    def _layout(self, column: str) -> Layout:
        try:
            return self.columns[column]
        except KeyError:
            raise KeyError(f"{self.path} has no column {column!r}; it has {', '.join(self.columns)}.") from None

    def _corrupt(self, what: str) -> CorruptDataError:
        return CorruptDataError(f"{self.path} {what}. {_ADVICE}.")

    # -- opening

    def _open(self, file: Any) -> None:
        """Check the open file and remember where its chunks are."""
        if self._attribute(file, "format") != FORMAT_NAME:
            raise self._corrupt(f"is HDF5, but its attribute 'format' is not {FORMAT_NAME!r}")
        check_version(str(self.path), self._number(file, "format_version"))
        self.env = str(self._attribute(file, "env") or "")
        self.rows = int(self._number(file, "rows"))
        self.length = int(self._number(file, "length"))
        self.split = str(self._attribute(file, "split") or "")
        self.first_sequence = int(self._number(file, "first_sequence"))
        self.sequences = int(self._number(file, "sequences"))
        numbers = {name: self._number(file, name) for name in SensorContract().to_dict()}
        self.sensor = SensorContract(n_rays=int(numbers.pop("n_rays")), **numbers)
        if file.userblock_size:  # moves all offsets
            raise self._corrupt(f"starts with a user block of {file.userblock_size} bytes; expected plain HDF5")
        datasets = {name: self._dataset(file, name) for name in file}
        self._check_layouts(datasets)
        size = os.path.getsize(self.path)
        for name, dataset in datasets.items():
            chunked = self._chunk_table(dataset, self.columns[name], size)
            if chunked is not None:
                self._chunked[name] = chunked

    def _attribute(self, file: Any, name: str) -> Any:
        try:
            return read_attribute(file, name)
        except ValueError as error:
            raise self._corrupt(f"is HDF5, but its {error}") from error

    def _number(self, file: Any, name: str) -> float:
        value = self._attribute(file, name)
        if not isinstance(value, np.number) or not np.isfinite(value) or value.dtype.kind not in "iuf":
            raise self._corrupt(f"has no number as attribute {name!r}")
        result: float = value.item()
        return result

    def _dataset(self, file: Any, name: str) -> Any:
        """Return one member after refusing all that is not plain data in this very file."""
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise self._corrupt(f"holds a soft or external link {name!r}; expected plain columns only")
        if file.get(name, getclass=True) is not h5py.Dataset:
            raise self._corrupt(f"holds {name!r}, which is not a dataset; expected plain columns only")
        dataset = file[name]
        if name not in COLUMNS:
            raise self._corrupt(f"holds a column {name!r} that format version {FORMAT_VERSION} does not have")
        plist = dataset.id.get_create_plist()
        if dataset.is_virtual or plist.get_external_count():
            raise self._corrupt(f"column {name!r} takes its data from other files; expected plain columns only")
        if dataset.dtype.hasobject or dataset.dtype.fields or dataset.dtype.subdtype:
            raise self._corrupt(f"column {name!r} holds references or objects; expected plain numbers")
        for k in range(plist.get_nfilters()):
            code = plist.get_filter(k)[0]
            if code not in _KNOWN_FILTERS:
                raise self._corrupt(f"column {name!r} uses HDF5 filter {code}; expected shuffle and deflate")
        return dataset

    def _check_layouts(self, datasets: dict[str, Any]) -> None:
        """Check names, dtypes and shapes against the schema."""
        if "scan" not in datasets:
            raise self._corrupt("has no column 'scan'")
        humans = datasets["humans"].shape[1:2] if "humans" in datasets else ()
        scan_dtype = datasets["scan"].dtype.name
        try:
            expected = layouts(datasets, self.sensor, scan_dtype, humans[0] if humans else 0, self.length)
        except ValueError as error:
            raise self._corrupt(f"has other columns than the format: {str(error).rstrip('.')}") from error
        for name, layout in expected.items():
            dataset = datasets[name]
            if dataset.dtype != layout.dtype or dataset.shape != (self.rows, *layout.row_shape):
                raise self._corrupt(
                    f"column {name!r} is {dataset.dtype} {dataset.shape}, "
                    f"expected {layout.dtype} {(self.rows, *layout.row_shape)}"
                )
            if not layout.column.wide and layout.row_bytes * self.rows > _MAX_NARROW_BYTES:
                raise self._corrupt(f"column {name!r} would take {layout.row_bytes * self.rows:,} bytes")
        self.columns = expected

    def _chunk_table(self, dataset: Any, layout: Layout, file_size: int) -> _Chunked | None:
        """Return where the chunks are, or None if h5py has to read this column."""
        plist = dataset.id.get_create_plist()
        name, codes = layout.column.name, [plist.get_filter(k)[0] for k in range(plist.get_nfilters())]
        if dataset.chunks is None:
            # Rows that were never written take no bytes, but memory once they are read.
            if dataset.id.get_storage_size() != dataset.nbytes or dataset.nbytes > file_size:
                raise self._corrupt(f"lacks rows of column {name!r}: it is cut off or damaged")
            return None
        shape = tuple(int(n) for n in dataset.chunks)
        if math.prod(shape) * layout.dtype.itemsize > _MAX_CHUNK_BYTES:
            raise self._corrupt(f"column {name!r} has chunks of more than {_MAX_CHUNK_BYTES:,} bytes")
        grid = tuple(-(-n // size) for n, size in zip(dataset.shape, shape, strict=True))
        if dataset.id.get_num_chunks() != math.prod(grid):
            raise self._corrupt(f"lacks chunks of column {name!r}: it is cut off or damaged")
        if _DEFLATE not in codes:
            return None
        if codes != [code for code in (_SHUFFLE, _DEFLATE, _FLETCHER) if code in codes]:
            # the library would unpack whatever comes, however much that is
            raise self._corrupt(f"column {name!r} uses HDF5 filters {codes}; expected shuffle and deflate")
        chunked = _Chunked(layout, shape, grid, codes)
        dataset.id.chunk_iter(chunked.note)
        order = np.argsort(chunked.offsets)
        starts, ends = chunked.offsets[order], (chunked.offsets + chunked.sizes)[order]
        if (starts < 0).any() or (ends < starts).any() or (ends > file_size).any() or (ends[:-1] > starts[1:]).any():
            raise self._corrupt(f"lacks chunks of column {name!r}, or they overlap: it is cut off or damaged")
        return chunked

    # -- reading

    def _descriptor(self) -> int:
        if self._fd is None:
            with self._lock:
                if self._fd is None:
                    try:
                        self._fd = os.open(self.path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
                    except FileNotFoundError:
                        raise DatasetNotFoundError(f"Shard {self.path} is missing. {_ADVICE}.") from None
        return self._fd

    def _chunk(self, chunked: _Chunked, k: int) -> bytes:
        """Return inflated chunk `k`; the last one of each column is kept."""
        name = chunked.layout.column.name
        last = self._last.get(name)
        if last is not None and last[0] == k:
            return last[1]
        size = int(chunked.sizes[k])
        with reading(self.path):
            data = os.pread(self._descriptor(), size, int(chunked.offsets[k]))
        try:
            if len(data) != size:
                raise ValueError("the file ends before it")
            if chunked.applied(_FLETCHER, k):  # deflate has a checksum of its own, and files have their hash
                data = data[:-_FLETCHER_BYTES]
            plain = inflate(data, chunked.chunk_bytes) if chunked.applied(_DEFLATE, k) else data
            if len(plain) != chunked.chunk_bytes:
                raise ValueError(f"it has {len(plain)} bytes, expected {chunked.chunk_bytes}")
        except ValueError as error:
            raise self._corrupt(f"is damaged: chunk {k} of column {name!r}: {error}") from error
        self._last[name] = (k, plain)
        return plain

    def _rows(self, chunked: _Chunked, start: int, stop: int) -> Array:
        if not chunked.whole_rows:
            return self._grid_rows(chunked, start, stop)
        layout, step, items = chunked.layout, chunked.chunk, chunked.row_items
        parts = []
        for k in range(start // step, -(-stop // step)):
            first = k * step
            low, high = max(start - first, 0), min(stop - first, step)
            parts.append(
                unshuffle(self._chunk(chunked, k), layout.dtype, items, low, high, chunked.applied(_SHUFFLE, k))
            )
        flat = parts[0] if len(parts) == 1 else np.concatenate(parts) if parts else np.empty(0, layout.dtype)
        return flat.reshape(stop - start, *layout.row_shape)

    def _grid_rows(self, chunked: _Chunked, start: int, stop: int) -> Array:
        """Return rows whose chunks do not hold them whole, as h5py cuts them by itself."""
        layout, shape = chunked.layout, chunked.shape
        low, high = start // shape[0], -(-stop // shape[0])
        out = np.empty(
            tuple(n * size for n, size in zip((high - low, *chunked.grid[1:]), shape, strict=True)), layout.dtype
        )
        for place in np.ndindex(high - low, *chunked.grid[1:]):
            k = int(np.ravel_multi_index((place[0] + low, *place[1:]), chunked.grid))
            plain = self._chunk(chunked, k)
            values = unshuffle(plain, layout.dtype, 1, 0, math.prod(shape), chunked.applied(_SHUFFLE, k))
            out[tuple(slice(p * n, (p + 1) * n) for p, n in zip(place, shape, strict=True))] = values.reshape(shape)
        within = (slice(start - low * shape[0], stop - low * shape[0]), *(slice(n) for n in layout.row_shape))
        return np.ascontiguousarray(out[within])

    def _whole(self, column: str, chunked: _Chunked | None) -> Array:
        """Return a narrow column, decoded once."""
        values = self._narrow.get(column)
        if values is None:
            if chunked is None:
                values = self._by_h5py(column, 0, self.rows)
            else:
                values = self._rows(chunked, 0, self.rows)
                self._last.pop(column, None)
            values.flags.writeable = False
            self._narrow[column] = values
        return values

    def _by_h5py(self, column: str, start: int, stop: int) -> Array:
        try:
            with h5py.File(self.path, "r") as file:
                values: Array = file[column][start:stop]
        except Exception as error:
            raise_refusal(error, self.path)
            raise self._corrupt(f"is damaged: column {column!r}: {_first_line(error)}") from error
        return values


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
