"""The attributes of a shard: numbers, and text of fixed length.

HDF5 keeps text of variable length in a "global heap", whose damage makes the library run without end. So shards are
written without such attributes, and nothing is read from a heap, nor anything whose type may point into one.
"""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np

MAX_BYTES = 1 << 20
"""Bytes of the largest attribute that is read."""
_PLAIN = (h5py.h5t.INTEGER, h5py.h5t.FLOAT)


def write_attribute(file: h5py.File, name: str, value: Any) -> None:
    """Write one attribute of a file: text as UTF-8 of fixed length, all else as it is."""
    if isinstance(value, str):
        data = value.encode()
        file.attrs.create(name, np.array(data), dtype=h5py.string_dtype("utf-8", max(len(data), 1)))
    else:
        file.attrs[name] = value


def read_attribute(file: h5py.File, name: str) -> Any:
    """Return one attribute of a file as text, number or array of numbers, None if there is none.

    Raises
    ------
    ValueError
        If it is of another type, variable length above all, or longer than :data:`MAX_BYTES`.
    """
    if not h5py.h5a.exists(file.id, name.encode()):
        return None
    attribute = h5py.h5a.open(file.id, name.encode())
    kind = attribute.get_type()
    text = isinstance(kind, h5py.h5t.TypeStringID)
    if text and kind.is_variable_str():
        raise ValueError(f"attribute {name!r} is text of variable length, expected fixed length: HDF5 may hang on it")
    if not text and kind.get_class() not in _PLAIN:
        raise ValueError(f"attribute {name!r} is neither text nor a number")
    space = attribute.get_space()
    if text and space.get_simple_extent_type() != h5py.h5s.SCALAR:
        raise ValueError(f"attribute {name!r} is not one text")
    if space.get_simple_extent_npoints() * kind.get_size() > MAX_BYTES:
        raise ValueError(f"attribute {name!r} has more than {MAX_BYTES:,} bytes")
    if not text:
        return file.attrs[name]
    try:
        return bytes(file.attrs[name]).decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"attribute {name!r} is not UTF-8: {error}") from None
