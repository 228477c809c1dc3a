# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Sums over the two large columns of integers, in one pass and exact, and the entropy of bytes."""

import numpy as np

from navrep_data.kernels import kernel


@kernel
def sum_rays(rays):
    """Return count, total, total of squares, least and largest of the values above 0 of rays (n,) uint16.

    Squares are below 2**32, so up to 2**31 rays cannot overflow.
    """
    zeros = 0
    total = np.int64(0)
    squares = np.int64(0)
    low = np.int64(0xFFFF)
    high = np.int64(0)
    for k in range(rays.shape[0]):
        value = np.int64(rays[k])
        zeros += 1 if value == 0 else 0
        total += value
        squares += value * value
        high = max(high, value)
        # 0 - 1 wraps to the largest value: zeros then never are the least
        low = min(low, (value - 1) & 0xFFFF)
    return rays.shape[0] - zeros, total, squares, low + 1, high


@kernel
def count_cells(cells):
    """Return how many of cells (n,) uint8 are not 0, and how many are 2."""
    known = 0
    twos = 0
    for k in range(cells.shape[0]):
        known += 1 if cells[k] != 0 else 0
        twos += 1 if cells[k] == 2 else 0
    return known, twos


@kernel
def count_bytes(values):
    """Return how often each of the 256 values is in values (n,) uint8, n > 0: (256,) int64."""
    counts = np.zeros(256, np.int64)
    present, run = values[0], 0
    for k in range(values.shape[0]):  # most follow an equal one
        if values[k] != present:
            counts[present] += run
            present, run = values[k], 0
        run += 1
    counts[present] += run
    return counts


@kernel
def byte_entropy(sample):
    """Return the entropy of sample (n,) uint8, n > 0 [bit per byte]."""
    counts = np.zeros(256, np.int64)
    for k in range(sample.shape[0]):
        counts[sample[k]] += 1
    bits = 0.0
    for value in range(256):
        if counts[value] > 0:
            share = counts[value] / sample.shape[0]
            bits -= share * np.log2(share)
    return bits
