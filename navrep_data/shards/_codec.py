"""One chunk of a column to bytes and back: HDF5's shuffle and deflate filters, computed by us.

Notes
-----
The bytes are what HDF5's own filters 2 (shuffle) and 1 (deflate) accept, so that any HDF5 library reads them.
Deflating is libdeflate's, whose output is a function of its input. isal is two to four times faster at it, but not
repeatable: in about one of ten thousand chunks it wrote other, equally valid bytes in another process, which broke the
promise of equal bytes (found by the kill test). It still inflates, where there is only one right answer.

Byte planes of large chunks that are nearly noise (the low byte of a scan in millimetres) go into the stream as
deflate's uncompressed blocks: measured on the original's scans, that costs 0.08 kB/row, but random windows are read
twice as fast and rows written in half the time. Reading needs neither the HDF5 library nor its global lock.
"""

from __future__ import annotations

from typing import Any

import deflate
import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from navrep_data.schema import RINGS_SHAPE
from navrep_data.shards._rings_deflate import deflate_rings
from navrep_data.shards._sums import byte_entropy

DEFLATE_LEVEL = 1
# Below this size a Huffman table per plane costs more than it saves.
SPLIT_PLANE_BYTES = 8192
# A plane is stored as it is where an eighth from its middle has more than this share of a byte's entropy.
_NOISE_RATIO = 0.85
_ZLIB_HEADER = b"\x78\x01"
_STORED_BLOCK_MAX = 0xFFFF
# The stub calls it an instance; it is a class.
_DAMAGED: Any = isal_zlib.error


def _planes(block: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Return the bytes of `block` as (itemsize, n): HDF5's shuffle."""
    size = block.dtype.itemsize
    if size == 2:  # twice as fast as the general way
        flat = block.reshape(-1).view("<u2")
        out = np.empty((2, flat.size), np.uint8)
        np.bitwise_and(flat, 0xFF, out=out[0], casting="unsafe")
        np.right_shift(flat, 8, out=out[1], casting="unsafe")
        return out
    return np.ascontiguousarray(block.reshape(-1).view(np.uint8).reshape(-1, size).T)


def encode(block: npt.NDArray[Any]) -> bytes:
    """Return `block` (C-contiguous, little-endian) shuffled and deflated.

    Parameters
    ----------
    block : ndarray of shape (rows, ...)
        One whole chunk.
    """
    if block.shape[1:] == RINGS_SHAPE and block.dtype == np.uint8:
        stream = deflate_rings(block)
        if stream is not None:
            return b"".join([_ZLIB_HEADER, stream, int(isal_zlib.adler32(block)).to_bytes(4, "big")])
    if block.dtype.itemsize == 1:
        return bytes(deflate.zlib_compress(block.reshape(-1).view(np.uint8), DEFLATE_LEVEL))
    planes = _planes(block)
    if planes.shape[1] < SPLIT_PLANE_BYTES:
        return bytes(deflate.zlib_compress(planes, DEFLATE_LEVEL))
    parts = [_ZLIB_HEADER]
    first = 0
    while first < len(planes) - 1 and _is_noise(planes[first]):
        parts += _stored_blocks(planes[first])
        first += 1
    parts.append(bytes(deflate.deflate_compress(planes[first:], DEFLATE_LEVEL)))
    parts.append(int(isal_zlib.adler32(planes)).to_bytes(4, "big"))
    return b"".join(parts)


def _is_noise(plane: npt.NDArray[np.uint8]) -> bool:
    """Return whether deflating `plane` would save little, judged by the entropy of a sample from its middle."""
    return bool(byte_entropy(plane[plane.size * 7 // 16 : plane.size * 9 // 16]) > 8 * _NOISE_RATIO)


def _stored_blocks(plane: npt.NDArray[np.uint8]) -> list[bytes]:
    """Return `plane` as deflate blocks without compression (RFC 1951, 3.2.4), none of them the last."""
    parts = []
    for start in range(0, plane.size, _STORED_BLOCK_MAX):
        block = plane[start : start + _STORED_BLOCK_MAX].tobytes()
        size = len(block)
        parts += [b"\0", size.to_bytes(2, "little"), (size ^ 0xFFFF).to_bytes(2, "little"), block]
    return parts


def inflate(data: bytes, size: int) -> bytes:
    """Return the `size` bytes that `data` inflates to, never holding more.

    Raises
    ------
    ValueError
        If `data` is damaged or holds another number of bytes.
    """
    stream = isal_zlib.decompressobj()
    try:
        # One byte more than wanted: lets the stream reach its checksum, and shows one that would go on.
        plain: bytes = stream.decompress(data, size + 1)
    except _DAMAGED as error:
        raise ValueError(f"its compressed bytes are damaged ({error})") from error
    if len(plain) != size or not stream.eof:
        raise ValueError(f"it does not inflate to the expected {size} bytes")
    return plain


def unshuffle(
    plain: bytes, dtype: np.dtype[Any], row_items: int, start: int, stop: int, shuffled: bool = True
) -> npt.NDArray[Any]:
    """Return rows [start, stop) of an inflated chunk as a new flat array.

    Parameters
    ----------
    plain : bytes
        The inflated chunk.
    dtype : numpy.dtype
        Stored dtype.
    row_items : int
        Items per row.
    start, stop : int
        Rows within the chunk.
    shuffled : bool
        Whether the shuffle filter was applied.
    """
    size = dtype.itemsize
    first, last = start * row_items, stop * row_items
    if size == 1 or not shuffled:
        return np.frombuffer(plain, dtype, last - first, first * size).copy()
    planes = np.frombuffer(plain, np.uint8).reshape(size, -1)[:, first:last]
    if size == 2:
        words = planes[1].astype(np.uint16)
        words <<= 8
        words |= planes[0]
        decoded: npt.NDArray[Any] = words.view(dtype)
        return decoded
    out = np.empty((last - first, size), np.uint8)
    for k in range(size):
        out[:, k] = planes[k]
    return out.reshape(-1).view(dtype)
