"""Scans to rings and back: a 64 x 64 polar occupancy grid, angle by range.

Notes
-----
Paper section II-A and the original's ``navrep/tools/rings.py`` and ``crings/crings.pyx``. The paper calls the
spacing of the ranges exponential; it is a power law with exponent 3.12.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data import schema
from navrep_data.errors import ArrayError, ConfigError
from navrep_data.observations import _rings

N_SECTIONS, N_CELLS = schema.RINGS_SHAPE
_NEAREST_EDGE = 0.3
_FARTHEST_EDGE = 25.0
_POWER = 3.12
_LEAST_DEPTH = 0.01
# A decoded cell counts as a return or the space behind one from this value of {0, 1, 2} upwards.
_OCCUPIED_FROM = np.float32(0.4)
# Cells of a section of which nobody saw anything that are unknown, as bits.
_BLIND = {"unknown": np.uint64(0xFFFFFFFFFFFFFFFF), "free": np.uint64(0)}


def _make_edges() -> NDArray[np.float32]:
    """Cell 0 ends at 0.3 m, cell 63 starts at 25 m; the depth of the 62 between grows as a power."""
    weights = (np.arange(N_CELLS - 2) / (N_CELLS - 3)) ** _POWER
    # Every cell has the least depth; the power law shares out what is left of the span.
    spread = _FARTHEST_EDGE - (N_CELLS - 2) * _LEAST_DEPTH - _NEAREST_EDGE
    depths = weights * spread / weights.sum() + _LEAST_DEPTH
    inner = _NEAREST_EDGE + np.cumsum(depths)
    return np.concatenate([[0.0, _NEAREST_EDGE], inner, [np.inf]]).astype(np.float32)


RING_EDGES: NDArray[np.float32] = _make_edges()
"""Range edges [m], shape (65,), float32: cell k holds ranges in ``[RING_EDGES[k], RING_EDGES[k + 1])``."""
RING_EDGES.flags.writeable = False


@cache
def first_rays(n_rays: int) -> NDArray[np.int64]:
    """Return the first ray of each angular section, ndarray of shape (65,), int64, read-only.

    Parameters
    ----------
    n_rays : int
        Rays of the scan. With fewer than 64 some sections are empty.

    Notes
    -----
    ``ceil(n_rays / 64 * k)``, as in the original: 1080 rays give 17 per section and 16 in every eighth.
    """
    first = -(-np.arange(N_SECTIONS + 1, dtype=np.int64) * n_rays // N_SECTIONS)
    first.flags.writeable = False
    return first


@cache
def cell_of_millimetre() -> NDArray[np.uint8]:
    """Return the range cell of every count of millimetres, ndarray of shape (65536,), uint8, read-only.

    Notes
    -----
    Of ``float32(k) / float32(1000)``, so that rings of a stored scan equal those of the same scan in metres.
    """
    metres = np.arange(1 << 16).astype(np.float32) / np.float32(1000)
    table = (np.searchsorted(RING_EDGES[:-1], metres, side="right") - 1).astype(np.uint8)
    table.flags.writeable = False
    return table


@cache
def byte_spread() -> NDArray[np.uint64]:
    """Return the eight bits of every byte as eight bytes, lowest first, in one word: shape (256,), read-only."""
    table = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1, bitorder="little").view(np.uint64)[:, 0]
    table.flags.writeable = False
    return table


@cache
def float_tables() -> tuple[NDArray[np.uint8], NDArray[np.uint32]]:
    """Return the tables of the float kernel, read-only.

    Returns
    -------
    cell_of_bucket : ndarray of shape (65536,), uint8
        Cell of the smallest float32 whose upper 16 bits are the index; 255 where a bucket needs a look of its
        own.
    next_edge : ndarray of shape (64,), uint32
        Bit pattern of the upper edge of each cell. Patterns of positive floats are ordered as the floats are.
    """
    start = (np.arange(1 << 16, dtype=np.uint32) << np.uint32(16)).view(np.float32)
    ordinary = np.isfinite(start) & (start >= np.finfo(np.float32).tiny)
    cells = np.full(1 << 16, _rings.SPECIAL, np.uint8)
    cells[ordinary] = np.searchsorted(RING_EDGES[:-1], start[ordinary], side="right") - 1
    next_edge = RING_EDGES[1:].copy().view(np.uint32)
    assert np.unique(RING_EDGES[1:].view(np.uint32) >> 16).size == N_CELLS, "two edges in one bucket"
    cells.flags.writeable = False
    next_edge.flags.writeable = False
    return cells, next_edge


def _checked_out(out: NDArray[np.uint8] | None, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    if out is None:
        return np.empty(shape, np.uint8)
    if out.shape != shape or out.dtype != np.uint8 or not out.flags.c_contiguous or not out.flags.writeable:
        raise ArrayError(
            f"out has shape {out.shape} and dtype {out.dtype}, expected a writeable C-contiguous uint8 "
            "array of "
            f"shape {shape}: allocate it with numpy.empty({shape}, numpy.uint8)."
        )
    return out


def scan_to_rings(
    scan: ArrayLike, out: NDArray[np.uint8] | None = None, *, blind: str = "unknown"
) -> NDArray[np.uint8]:
    """Turn scans into rings.

    Parameters
    ----------
    scan : ndarray of shape (..., n_rays), float32 [m] or uint16 [mm]
        Ranges, ray 0 straight ahead, anticlockwise. Any number of rays. Rays of 0, NaN and +inf mark nothing.
        float64 is rounded to float32 first.
    out : ndarray of shape (..., 64, 64), uint8, optional
        Where to write the result; C-contiguous.
    blind : {"unknown", "free"}
        What a section is of which nobody saw anything (all its rays 0 or NaN). ``"free"``: as in the original.

    Returns
    -------
    ndarray of shape (..., 64, 64), uint8
        Angle by range: 0 free, 1 unknown (behind a return, or not seen), 2 occupied. This is `out` where it was given.

    Raises
    ------
    ArrayError
        If `scan` has another dtype or no ray axis, or `out` does not fit.
    ConfigError
        If `blind` is neither.

    Notes
    -----
    Original: ``crings.pyx``, matched exactly, negative ranges included (they make their whole section
    unknown), but for sections of which nobody saw anything: there they are free, which ``blind="free"`` gives. The
    simulators' scans have none. A uint16 scan gives the rings of ``float32(k) / float32(1000)``.
    """
    if blind not in _BLIND:
        raise ConfigError(f"blind is {blind!r}, expected 'unknown' or 'free'.")
    array = np.asarray(scan)
    if array.dtype == np.float64:
        array = array.astype(np.float32)
    if array.ndim == 0 or array.dtype not in (np.float32, np.uint16):
        raise ArrayError(
            f"scan has shape {array.shape} and dtype {array.dtype}, expected (..., n_rays) as float32 "
            "metres or uint16 "
            "millimetres: convert it with .astype(numpy.float32)."
        )
    n_rays = array.shape[-1]
    rings = _checked_out(out, (*array.shape[:-1], N_SECTIONS, N_CELLS))
    n_scans = rings.size // (N_SECTIONS * N_CELLS)
    rows = np.ascontiguousarray(array).reshape(n_scans, n_rays)
    target = rings.reshape(n_scans, N_SECTIONS, N_CELLS).view(np.uint64)  # eight cells at a time
    if array.dtype == np.uint16:
        _rings.rings_from_mm_rows(rows, cell_of_millimetre(), first_rays(n_rays), byte_spread(), _BLIND[blind], target)
    else:
        cells, next_edge = float_tables()
        _rings.rings_from_metres_rows(
            rows, rows.view(np.uint32), cells, next_edge, first_rays(n_rays), byte_spread(), _BLIND[blind], target
        )
    return rings


def rings_to_scan(rings: ArrayLike, n_rays: int = schema.N_RAYS) -> NDArray[np.float32]:
    """Turn rings, measured or decoded by a model, back into scans.

    Parameters
    ----------
    rings : ndarray of shape (..., 64, 64), uint8 in {0, 1, 2} or floating in [0, 1]
        Angle by range.
    n_rays : int
        Rays of the result.

    Returns
    -------
    ndarray of shape (..., n_rays), float32
        For every ray the lower edge [m] of its section's first cell that is not free (above 0.4 on the scale
        of {0, 1, 2}), 0 where all are.

    Raises
    ------
    ArrayError
        If the shape does not end in (64, 64), the dtype is neither uint8 nor floating, or `n_rays` is not
        positive.

    Notes
    -----
    Original: ``navrep/tools/rings.py``.
    """
    array = np.asarray(rings)
    floating = np.issubdtype(array.dtype, np.floating)
    if array.shape[-2:] != schema.RINGS_SHAPE or not (floating or array.dtype == np.uint8):
        raise ArrayError(
            f"rings has shape {array.shape} and dtype {array.dtype}, expected (..., 64, 64) as uint8 or "
            "floating: drop a "
            "channel axis with rings[..., 0]."
        )
    if n_rays < 1:
        raise ArrayError(f"n_rays is {n_rays}, expected at least 1: pass the number of rays of the sensor.")
    solid = array.astype(np.float32) * np.float32(2 if floating else 1) > _OCCUPIED_FROM
    nearest = RING_EDGES[solid.argmax(axis=-1)]
    section = np.repeat(np.arange(N_SECTIONS), np.diff(first_rays(n_rays)))
    return np.asarray(nearest[..., section], dtype=np.float32)


def rings_to_float(rings: ArrayLike, zero_first_bin: bool = False) -> NDArray[np.float32]:
    """Turn stored rings into what models are fed.

    Parameters
    ----------
    rings : ndarray of shape (..., 64, 64), uint8
        Values 0, 1, 2.
    zero_first_bin : bool
        Set the nearest range cell free, as for the original's V and M encoders (not for its end-to-end
        policies).

    Returns
    -------
    ndarray of shape (..., 64, 64), float32
        Values 0 free, 0.5 unknown, 1 occupied.

    Raises
    ------
    ArrayError
        If the shape does not end in (64, 64) or the dtype is not uint8.
    """
    array = np.asarray(rings)
    if array.shape[-2:] != schema.RINGS_SHAPE or array.dtype != np.uint8:
        raise ArrayError(
            f"rings has shape {array.shape} and dtype {array.dtype}, expected (..., 64, 64) as uint8: make "
            "them with "
            "scan_to_rings."
        )
    result = array * np.float32(0.5)
    if zero_first_bin:
        result[..., 0] = 0.0
    return np.asarray(result, dtype=np.float32)
