"""What the columns of one dataset look like on disk: concrete dtypes, shapes, chunks and attributes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.errors import ConfigError, did_you_mean
from navrep_data.schema import (
    COLUMNS,
    EVENT_NAMES,
    HUMAN_FIELDS,
    HUMANS_AXIS,
    RAYS_AXIS,
    SCAN_SCALE,
    Column,
    SensorContract,
)

SCAN_DTYPES = ("uint16", "float32")
CHUNK_TARGET = 25
CHUNK_RANGE = (12, 40)
# HDF5 keeps a chunk index entry and a header per narrow chunk, so one chunk per sequence; but not megabytes
# in one.
NARROW_CHUNK_MAX = 4096
VECTOR_COLUMNS = ("robot_state", "action", "robot_pose", "leading_action", "source_robot_state", "humans")
"""Columns whose last axis holds different quantities: their statistics are lists, one entry per component."""

# Measured on 20 sequences of soadrl (20,000 rows, 25 rows per chunk); leading_* and source_* on an import.
BYTES_PER_ROW: dict[str, float] = {
    "scan": 1290.0,
    "rings": 150.0,
    "scan_label": 60.0,
    "robot_state": 17.1,
    "action": 10.5,
    "reward": 3.0,
    "robot_pose": 9.5,
    "leading_action": 20.0,
    "leading_reward": 8.0,
    "source_robot_state": 26.0,
}
_BYTES_PER_FLOAT32_RAY = 2.55
_BYTES_PER_HUMAN_SLOT = 6.9
_BYTES_OTHER_COLUMN = 0.3
_BYTES_EXTRA = 20.0


@dataclass(frozen=True)
class Layout:
    """Concrete layout of one column.

    Attributes
    ----------
    column : Column
        The schema's entry.
    dtype : numpy.dtype
        Stored dtype, little-endian.
    row_shape : tuple of int
        Shape per row.
    chunk : int
        Rows per HDF5 chunk.
    """

    column: Column
    dtype: np.dtype[Any]
    row_shape: tuple[int, ...]
    chunk: int

    @property
    def row_bytes(self) -> int:
        """Bytes of one decoded row."""
        return self.dtype.itemsize * int(np.prod(self.row_shape, dtype=np.int64))


def chunk_rows(length: int) -> int:
    """Return the rows per chunk of wide columns for sequences of `length` rows.

    The divisor of `length` in [12, 40] nearest to 20, so that no chunk crosses two sequences; 20 if there is
    none.

    Notes
    -----
    A random 32-row window decodes 32 + chunk - 1 rows on average. Measured on one of the original's
    sequences, uint16, one core of a busy machine, decoding alone: 10 rows 1.308 kB/row and 6.0k windows/s,
    20 rows 1.303 and 7.7k, 40 rows 1.300 and 6.5k.
    """
    low, high = CHUNK_RANGE
    divisors = [d for d in range(low, high + 1) if length % d == 0]
    return min(divisors, key=lambda d: (abs(d - CHUNK_TARGET), d), default=CHUNK_TARGET)


def column_order(names: Iterable[str]) -> tuple[str, ...]:
    """Return `names` in the schema's order.

    Raises
    ------
    ConfigError
        If a name is unknown, doubled, or a column that every dataset has is missing.
    """
    given = list(names)
    for name in given:
        if name not in COLUMNS:
            raise ConfigError(
                f"Unknown column {name!r}; expected some of {', '.join(COLUMNS)}.{did_you_mean(name, COLUMNS)}"
            )
        if given.count(name) > 1:
            raise ConfigError(f"Column {name!r} is named twice; expected each once.")
    missing = [name for name, column in COLUMNS.items() if not column.optional and name not in given]
    if missing:
        raise ConfigError(f"Column {missing[0]!r} is missing; every dataset has it. Add it to the columns.")
    return tuple(name for name in COLUMNS if name in given)


def layouts(
    columns: Iterable[str], sensor: SensorContract, scan_dtype: str, max_humans: int, length: int
) -> dict[str, Layout]:
    """Return the layout of each of `columns`, in the schema's order.

    Parameters
    ----------
    columns : iterable of str
        Column names.
    sensor : SensorContract
        Gives the number of rays.
    scan_dtype : {"uint16", "float32"}
        How scans are stored.
    max_humans : int
        Slots of the humans column.
    length : int
        Rows per sequence.

    Raises
    ------
    ConfigError
        If a value cannot be used.
    """
    if scan_dtype not in SCAN_DTYPES:
        raise ConfigError(f"scan_dtype is {scan_dtype!r}; expected 'uint16' or 'float32'.")
    names = column_order(columns)
    if length < 1:
        raise ConfigError(f"length is {length}; expected at least 1 row per sequence.")
    if "humans" in names and max_humans < 1:
        raise ConfigError(f"max_humans is {max_humans}; expected at least 1, or leave the humans column out.")
    axes = {RAYS_AXIS: sensor.n_rays, HUMANS_AXIS: max_humans}
    wide, narrow = chunk_rows(length), min(length, NARROW_CHUNK_MAX)
    result = {}
    for name in names:
        column = COLUMNS[name]
        dtype = np.dtype(scan_dtype if column.dtype == "scan" else column.dtype).newbyteorder("<")
        shape = tuple(axes.get(n, n) for n in column.shape)
        result[name] = Layout(column, dtype, shape, wide if column.wide else narrow)
    return result


def column_attributes(layout: Layout) -> dict[str, str | float]:
    """Return the HDF5 attributes of a column."""
    column = layout.column
    attributes: dict[str, str | float] = {"units": column.unit, "description": column.description}
    if column.name == "scan":
        metres = layout.dtype.kind == "f"
        attributes["units"] = "m" if metres else "mm"
        attributes["scale"] = 1.0 if metres else SCAN_SCALE
    elif column.name == "robot_state":
        attributes["symbol"] = "s_r"
    elif column.name == "humans":
        attributes["fields"] = ",".join(HUMAN_FIELDS)
    elif column.name == "event":
        attributes["names"] = ",".join(EVENT_NAMES)
    elif column.name == "rings":
        attributes["names"] = "free,unknown,occupied"
    elif column.name == "contact":
        attributes["names"] = "none,human,robot,static"
    elif column.name == "scan_label":
        attributes["names"] = "nothing,static,robot,human of slot 0,..."
    return attributes


def estimate_bytes(columns: Iterable[str], rows: int, *, n_rays: int, scan_dtype: str, max_humans: int) -> int:
    """Return about how many bytes `rows` rows take on disk, worlds included.

    Parameters
    ----------
    columns : iterable of str
        Column names.
    rows : int
        Number of rows.
    n_rays : int
        Rays per scan.
    scan_dtype : {"uint16", "float32"}
        How scans are stored.
    max_humans : int
        Slots of the humans column.
    """
    per_row = _BYTES_EXTRA
    for name in columns:
        if name == "scan":
            ray = BYTES_PER_ROW["scan"] / 1080 if scan_dtype == "uint16" else _BYTES_PER_FLOAT32_RAY
            per_row += ray * n_rays
        elif name == "humans":
            per_row += _BYTES_PER_HUMAN_SLOT * max_humans
        else:
            per_row += BYTES_PER_ROW.get(name, _BYTES_OTHER_COLUMN)
    return round(per_row * rows)


def little_endian(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return `array` C-contiguous and little-endian, without a copy where it is so already."""
    return np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
