# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Kernels from scans to rings and millimetres: integer tables and bit masks, one pass per scan.

A section of the scan becomes a 64-bit mask with one bit per range cell that some ray falls in. Everything
behind the nearest return is at least unknown, so a cell's value is ``bit(mask) + bit(mask with all bits above
its lowest set)``. Eight cells at a time are expanded from a byte of each mask by table, and written as one word.

Float scans go through the upper 16 bits of their float32 pattern: no two range edges share such a bucket, so
one comparison with the bucket's edge decides the cell exactly.
"""

from __future__ import annotations

import numpy as np

from navrep_data.kernels import kernel

N_SECTIONS = 64
N_CELLS = 64
# Table entry for float32 patterns that need a look of their own: zero, denormals, negative, infinite, NaN.
SPECIAL = 255
_ONE = np.uint64(1)
_BYTE = np.uint64(255)
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)


@kernel
def _write_section(mask, behind, spread, row):
    """Write one section: `mask` marks returns, `behind` marks every cell from the nearest return outwards."""
    for group in range(8):
        shift = np.uint64(8 * group)
        # eight cells in one sum of words: none of them exceeds 2
        row[group] = spread[np.int64((mask >> shift) & _BYTE)] + spread[np.int64((behind >> shift) & _BYTE)]


@kernel
def rings_from_mm(scan, cell_of_mm, first_ray, spread, unseen, out):
    """Rings of one scan in millimetres.

    scan (n_rays,) uint16; cell_of_mm (65536,) uint8; first_ray (65,) int64; spread (256,) uint64, eight cells each;
    unseen uint64, the cells that are unknown in a section of which nobody saw anything: all or none;
    out (64, 8) uint64, eight cells each, overwritten.
    """
    for section in range(N_SECTIONS):
        mask = np.uint64(0)
        rays = scan[first_ray[section] : first_ray[section + 1]]
        for i in range(rays.shape[0]):
            value = rays[i]
            # 0 mm = invalid: it shifts a zero in.
            mask |= np.uint64(value != 0) << np.uint64(cell_of_mm[value])
        behind = np.uint64(0)
        if mask != np.uint64(0):
            behind = mask | (~mask + _ONE)
        elif rays.shape[0] > 0:
            behind = unseen
        _write_section(mask, behind, spread, out[section])


@kernel
def rings_from_metres(scan, bits, cell_of_bucket, edge_bits, first_ray, spread, unseen, out):
    """Rings of one scan in metres.

    scan (n_rays,) float32; bits (n_rays,) uint32 = scan.view(uint32); cell_of_bucket (65536,) uint8;
    edge_bits (64,) uint32, lower edges as bit patterns (+1 past the largest for the last cell);
    first_ray, spread, unseen, out as in `rings_from_mm`.
    """
    for section in range(N_SECTIONS):
        mask = np.uint64(0)
        behind_all = False
        seen = first_ray[section] == first_ray[section + 1]  # no ray looks there: the resolution's fault
        for i in range(first_ray[section], first_ray[section + 1]):
            pattern = bits[i]
            cell = np.int64(cell_of_bucket[pattern >> np.uint32(16)])
            if cell == SPECIAL:
                value = scan[i]
                if value < np.float32(0.0):
                    behind_all = True  # as in the original: nearer than every cell, but in none
                elif value > np.float32(0.0) and value < np.float32(1.0):
                    mask |= _ONE  # a denormal
                elif value == np.float32(np.inf):
                    seen = True
                continue  # zero, infinite and NaN mark nothing
            if pattern >= edge_bits[cell]:
                cell += 1
            mask |= _ONE << np.uint64(cell)
        behind = np.uint64(0)
        if behind_all:
            behind = _ALL
        elif mask != np.uint64(0):
            behind = mask | (~mask + _ONE)
        elif not seen:
            behind = unseen
        _write_section(mask, behind, spread, out[section])


@kernel
def rings_from_mm_rows(scans, cell_of_mm, first_ray, spread, unseen, out):
    """`rings_from_mm` for scans (N, n_rays), out (N, 64, 8)."""
    for n in range(scans.shape[0]):
        rings_from_mm(scans[n], cell_of_mm, first_ray, spread, unseen, out[n])


@kernel
def rings_from_metres_rows(scans, bits, cell_of_bucket, edge_bits, first_ray, spread, unseen, out):
    """`rings_from_metres` for scans (N, n_rays), out (N, 64, 8)."""
    for n in range(scans.shape[0]):
        rings_from_metres(scans[n], bits[n], cell_of_bucket, edge_bits, first_ray, spread, unseen, out[n])


@kernel
def millimetres_row(scan, range_max, out):
    """Round one scan to millimetres: scan (n,) float32 [m], range_max [m], out (n,) uint16, overwritten.

    float32 times 1000 is exact in float64, so ``rint`` rounds the true value, half to even. Negative and NaN
    become 0.
    """
    farthest = np.rint(np.float64(range_max) * 1000.0)
    for i in range(scan.shape[0]):
        value = scan[i]
        count = np.float64(value) * 1000.0
        count = count if count < farthest else farthest
        count = np.rint(count)
        count = count if count > 1.0 else 1.0
        # NaN fails the test as negative values do; by here it has been clamped to a number.
        out[i] = np.uint16(count if value > np.float32(0.0) else 0.0)
