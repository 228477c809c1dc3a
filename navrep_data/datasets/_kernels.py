"""Copying windows of stored rows into batches, with the conversions on the way.

All kernels take the stored rows of one column, ``start`` and ``count`` (first row and number of rows of each
window) and fill ``out``, whose first two axes are window and row, completely: rows past ``count`` become
zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.kernels import kernel

Array = npt.NDArray[Any]

# A uint16 scan counts millimetres. Dividing (not multiplying by 0.001) gives exactly float32(k) /
# float32(1000), the number that the stored rings were computed from.
MM_PER_METRE = 1000


@kernel
def millimetre_windows(rows: Array, start: Array, count: Array, invalid: Any, range_max: Any, out: Array) -> None:
    """Turn mm (uint16) to metres (float32), a stored 0 to `invalid` [m]; divide by `range_max` unless 1."""
    scale = np.float32(MM_PER_METRE)
    for b in range(start.size):
        first = start[b]
        n = count[b]
        for t in range(n):
            if range_max == np.float32(1.0):
                for r in range(rows.shape[1]):
                    k = rows[first + t, r]
                    out[b, t, r] = np.float32(k) / scale if k != 0 else invalid
            else:
                for r in range(rows.shape[1]):
                    k = rows[first + t, r]
                    out[b, t, r] = (np.float32(k) / scale if k != 0 else invalid) / range_max
        for t in range(n, out.shape[1]):
            for r in range(rows.shape[1]):
                out[b, t, r] = np.float32(0.0)


@kernel
def metre_windows(rows: Array, start: Array, count: Array, invalid: Any, range_max: Any, out: Array) -> None:
    """Copy metres (float32), turn a stored 0 to `invalid` [m]; divide by `range_max`."""
    zero = np.float32(0.0)
    for b in range(start.size):
        first = start[b]
        n = count[b]
        for t in range(n):
            for r in range(rows.shape[1]):
                d = rows[first + t, r]
                out[b, t, r] = (d if d != zero else invalid) / range_max
        for t in range(n, out.shape[1]):
            for r in range(rows.shape[1]):
                out[b, t, r] = zero


@kernel
def ring_windows(rows: Array, start: Array, count: Array, out: Array) -> None:
    """Turn rings 0/1/2 (uint8, cells flattened) to 0 / 0.5 / 1 (float32)."""
    for b in range(start.size):
        first = start[b]
        n = count[b]
        for t in range(n):
            for c in range(rows.shape[1]):
                out[b, t, c] = np.float32(rows[first + t, c]) * np.float32(0.5)
        for t in range(n, out.shape[1]):
            for c in range(rows.shape[1]):
                out[b, t, c] = np.float32(0.0)


@kernel
def byte_windows(flat: Array, width: int, start: Array, count: Array, out: Array) -> None:
    """Copy rows of `width` bytes from `flat` (rows * width,) to `out` (windows, W * width): any dtype."""
    for b in range(start.size):
        first = start[b] * width
        n = count[b] * width
        for c in range(n):
            out[b, c] = flat[first + c]
        for c in range(n, out.shape[1]):
            out[b, c] = np.uint8(0)


@kernel
def leading_windows(actions: Array, is_first: Array, start: Array, count: Array, out: Array) -> None:
    """Copy the action of the row before, zero where a row is the first of its episode."""
    for b in range(start.size):
        first = start[b]
        n = count[b]
        for t in range(out.shape[1]):
            row = first + t
            known = t < n and not is_first[row]
            for c in range(out.shape[2]):
                out[b, t, c] = actions[row - 1, c] if known else np.float32(0.0)
