"""Intervals: Wilson's for shares, the bootstrap's for means."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

Z95 = 1.959963984540054
"""97.5 % quantile of the normal distribution."""
RESAMPLES = 2000


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share.

    Parameters
    ----------
    successes, n : int
        How many of how many; (0, 1) for n = 0.

    Notes
    -----
    E. B. Wilson 1927: the shares p for which the seen one is within 1.96 standard deviations sqrt(p (1 - p) / n).
    """
    if n == 0:
        return 0.0, 1.0
    share = successes / n
    denominator = 1.0 + Z95**2 / n
    centre = (share + Z95**2 / (2 * n)) / denominator
    half = Z95 * math.sqrt(share * (1 - share) / n + Z95**2 / (4 * n * n)) / denominator
    return max(0.0, centre - half), min(1.0, centre + half)


def bootstrap(values: ArrayLike, seed: int = 0) -> tuple[float, float, float]:
    """Return the mean of values and its 95 % percentile bootstrap interval; NaN for no values.

    Parameters
    ----------
    values : array_like of shape (n,)
        Numbers; NaN are left out.
    seed : int
        Same seed and values, same interval.
    """
    x = np.asarray(values, np.float64)
    x = x[~np.isnan(x)]
    if len(x) == 0:
        return math.nan, math.nan, math.nan
    rng = np.random.default_rng(seed)
    # by rows, so that 8,100 values do not need 130 MB
    means = np.array([x[rng.integers(0, len(x), len(x))].mean() for _ in range(RESAMPLES)])
    low, high = np.quantile(means, [0.025, 0.975])
    return float(x.mean()), float(low), float(high)


def spread(values: Sequence[float]) -> tuple[float, float, float]:
    """Return mean, least and greatest of the scores of several runs of one variant."""
    return float(np.mean(values)), float(min(values)), float(max(values))
