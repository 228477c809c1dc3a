"""Memory for batches, used again once nobody looks at it any more."""

from __future__ import annotations

import sys
import threading
from typing import Any

import numpy as np
import numpy.typing as npt

# Below this, malloc keeps freed memory anyway and the bookkeeping costs more than it saves.
SMALL_BYTES = 256 << 10


def _references(buffers: list[npt.NDArray[np.uint8]], position: int) -> int:
    """Return how often a buffer is referenced, plus a constant that depends on the interpreter."""
    return sys.getrefcount(buffers[position])


# What that is for a buffer that nobody but the list holds.
_UNUSED = _references([np.empty(1, np.uint8)], 0)


class BufferPool:
    """Hands out uninitialised arrays, reusing the memory of earlier ones that are no longer referenced.

    Parameters
    ----------
    keep : int
        Number of buffers kept.

    Notes
    -----
    A batch of 64 windows of scans is 8.8 MB. Fresh from the operating system, its pages cost more than
    filling it: measured 17k windows/s with new memory each time, 126k with the same memory. Tensors made by
    ``torch.from_numpy`` hold a reference to the array, and so do views, so an unreferenced buffer is one that
    no batch can see.
    """

    def __init__(self, keep: int = 6) -> None:
        self.keep = keep
        self._buffers: list[npt.NDArray[np.uint8]] = []
        self._lock = threading.Lock()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> npt.NDArray[Any]:
        """Return an uninitialised C-contiguous array."""
        dtype = np.dtype(dtype)
        size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        if size < SMALL_BYTES:
            return np.empty(shape, dtype)
        with self._lock:
            array: npt.NDArray[Any] = self._take(size)[:size].view(dtype).reshape(shape)
            return array

    def _take(self, size: int) -> npt.NDArray[np.uint8]:
        for position in range(len(self._buffers)):
            # A buffer much larger than asked for is left to those who need it.
            fits = size <= self._buffers[position].nbytes <= 4 * size
            if fits and _references(self._buffers, position) <= _UNUSED:
                self._buffers.append(self._buffers.pop(position))
                return self._buffers[-1]
        fresh = np.empty(size, np.uint8)
        self._buffers.append(fresh)
        if len(self._buffers) > self.keep:
            del self._buffers[0]  # the least recently used; whoever still looks at it keeps it alive
        return fresh

    def __reduce__(self) -> tuple[type[BufferPool], tuple[int]]:
        return BufferPool, (self.keep,)
