"""What is worked out from maps and kept: on disk for distances, in memory for goal fields."""

from __future__ import annotations

import hashlib
import io
import math
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import DiskSpaceError, FolderNotWritableError
from navrep_data.io import atomic_write_bytes, cache_dir
from navrep_data.io.npz import read_npz

# Raised with any change of what the files mean; old ones are then left alone.
FORMAT = 1
_Scalar = TypeVar("_Scalar", bound=np.generic)


def content_hash(*parts: object) -> str:
    """Return a hash of arrays (shape, dtype and content) and of other values (their repr), 32 hex digits."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(repr((part.shape, part.dtype.str)).encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(repr(part).encode())
        digest.update(b"\0")
    return digest.hexdigest()[:32]


def cached_on_disk(
    kind: str, key: str, shape: tuple[int, ...], make: Callable[[], NDArray[_Scalar]], dtype: type[_Scalar]
) -> NDArray[_Scalar]:
    """Return the array stored under `key`, made and stored where it is missing or damaged.

    A cache that cannot be written costs time and is not an error.

    Parameters
    ----------
    kind : str
        What it is: first part of the file's name.
    key : str
        Hash of everything that the array depends on.
    shape : tuple of int
        Expected shape.
    make : callable
        Works the array out.
    dtype : type
        Type of its elements.
    """
    path = cache_dir() / "maps" / f"{kind}-v{FORMAT}-{key}.npz"
    stored = _read(path, shape, dtype)
    if stored is not None:
        return stored
    array = make()
    buffer = io.BytesIO()
    np.savez(buffer, values=array)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(path, buffer.getbuffer())
    except (OSError, DiskSpaceError, FolderNotWritableError):
        pass
    return array


def _read(path: Path, shape: tuple[int, ...], dtype: type[_Scalar]) -> NDArray[_Scalar] | None:
    """Return what `path` holds, None where it is not exactly what was stored (the archive carries a checksum)."""
    try:
        if path.stat().st_size > np.dtype(dtype).itemsize * math.prod(shape) + 4096:
            return None
        with open(path, "rb") as handle:
            array: NDArray[_Scalar] = read_npz(handle, np.dtype(dtype).itemsize * math.prod(shape) + 4096)["values"]
    except (OSError, ValueError, KeyError):
        return None
    return array if array.shape == shape and array.dtype == dtype else None


class RecentArrays:
    """Arrays worked out before, the most recently used kept up to a number of bytes."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._arrays: OrderedDict[Hashable, NDArray[np.float32]] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return the array of `key`, made by `make` where it is not at hand; read-only."""
        array = self._arrays.get(key)
        if array is None:
            array = make()
            array.setflags(write=False)
            self._arrays[key] = array
            self._bytes += array.nbytes
            while self._bytes > self._max_bytes and len(self._arrays) > 1:
                self._bytes -= self._arrays.popitem(last=False)[1].nbytes
        else:
            self._arrays.move_to_end(key)
        return array

    def clear(self) -> None:
        """Forget everything."""
        self._arrays.clear()
        self._bytes = 0
