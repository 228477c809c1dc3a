"""Arrays as the page carries them: whole numbers of 8 or 16 bits, filtered, deflated, in base64.

The page's ``data.js`` undoes exactly this. A number's code is ``round((value - origin) / step)``; code 65535 is NaN.
16-bit arrays are stored as differences along their last axis (zigzag, modulo 65536), low bytes before high bytes:
scans shrink to half of what plain deflate makes of them.
"""

from __future__ import annotations

import base64
from typing import Any

import deflate
import numpy as np
from numpy.typing import ArrayLike, NDArray

NAN_CODE = 65535
LARGEST_CODE = 65534
HUGE = 1e30
"""Numbers from here on mean nothing in metres and seconds: they become NaN."""
_LEVEL = 9


def quantise(values: ArrayLike, step: float) -> tuple[NDArray[np.uint16], float, float]:
    """Return 16-bit codes of numbers, with the origin and the step that were used.

    Parameters
    ----------
    values : array_like of float
        Any shape; NaN and what is not below :data:`HUGE` become :data:`NAN_CODE`.
    step : float
        Wished difference between neighbouring codes; made larger where the values' range needs it.

    Returns
    -------
    codes : ndarray of uint16
        In the shape of `values`; ``origin + step * code`` is within half a step of each value.
    origin, step : float
        What decodes them.
    """
    x = np.asarray(values, np.float64)
    good = np.abs(x) < HUGE  # False for NaN
    codes = np.full(x.shape, NAN_CODE, np.uint16)
    if not good.any():
        return codes, 0.0, step
    low, high = float(x[good].min()), float(x[good].max())
    step = max(step, (high - low) / LARGEST_CODE)
    codes[good] = np.clip(np.rint((x[good] - low) / step), 0, LARGEST_CODE).astype(np.uint16)
    return codes, low, step


def zigzag_delta(codes: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the differences along the last axis, modulo 65536, small ones of either sign as small numbers."""
    difference = np.diff(codes, axis=-1, prepend=np.uint16(0)).astype(np.uint16).view(np.int16)
    folded = (difference << 1) ^ (difference >> 15)
    return folded.view(np.uint16)


def pack_rings(rings: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return rings (n, 64, 64) of 0, 1, 2 as (n, 1024) bytes of four cells each, the first in the lowest bits."""
    cells = rings.reshape(len(rings), -1, 4)
    packed = cells[..., 0] | cells[..., 1] << 2 | cells[..., 2] << 4 | cells[..., 3] << 6
    return packed.astype(np.uint8)


class Blob:
    """Arrays that go into one deflated stream.

    Attributes
    ----------
    arrays : dict of str to dict
        What the page has to know of each array: ``type`` (``"u8"``, ``"u16"``), ``shape``, ``at`` (its first byte in
        the stream), ``origin``, ``step``. Plain JSON values.
    parts : list of bytes
        The arrays' bytes, in order.
    """

    def __init__(self) -> None:
        self.arrays: dict[str, dict[str, Any]] = {}
        self.parts: list[bytes] = []
        self._size = 0

    @property
    def size(self) -> int:
        """Bytes of the stream before it is deflated."""
        return self._size

    def add_bytes(self, name: str, values: NDArray[np.uint8]) -> None:
        """Put an array of bytes in."""
        self._add(name, "u8", values.shape, np.ascontiguousarray(values).tobytes(), 0.0, 1.0)

    def add_codes(self, name: str, codes: NDArray[np.uint16], origin: float, step: float) -> None:
        """Put an array of codes in; differences are taken along its last axis."""
        folded = zigzag_delta(np.ascontiguousarray(codes))
        data = (folded & 255).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
        self._add(name, "u16", codes.shape, data, origin, step)

    def add(self, name: str, values: ArrayLike, step: float) -> None:
        """Put numbers in, to `step`; see :func:`quantise`."""
        self.add_codes(name, *quantise(values, step))

    def _add(self, name: str, kind: str, shape: tuple[int, ...], data: bytes, origin: float, step: float) -> None:
        self.arrays[name] = {"type": kind, "shape": list(shape), "at": self._size, "origin": origin, "step": step}
        self.parts.append(data)
        self._size += len(data)

    def base64(self) -> str:
        """Return the stream, deflated (no header), in base64."""
        packed = bytes(deflate.deflate_compress(b"".join(self.parts), _LEVEL))
        return base64.b64encode(packed).decode("ascii")
