"""Intervals: Wilson's for shares, the bootstrap's for means."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Z95 = 1.959963984540054
"""97.5 % quantile of the normal distribution."""
RESAMPLES = 2000
# Numbers drawn at once: whole resamples, so that short lists need few calls, and few enough to stay in the cache.
_AT_ONCE = 1 << 17


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


def _resamples(n: int, seed: int) -> Iterator[NDArray[np.int64]]:
    """Yield indices (k, n) of k resamples of n values at a time; the same as of one resample after the other."""
    rng = np.random.default_rng(seed)
    rows = max(1, _AT_ONCE // n)
    for first in range(0, RESAMPLES, rows):
        yield rng.integers(0, n, (min(rows, RESAMPLES - first), n))


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
    means = np.concatenate([x[chosen].mean(axis=1) for chosen in _resamples(len(x), seed)])
    low, high = np.quantile(means, [0.025, 0.975])
    return float(x.mean()), float(low), float(high)


def bootstrap_ratio(above: ArrayLike, below: ArrayLike, seed: int = 0) -> tuple[float, float, float]:
    """Return sum(above) / sum(below) and its 95 % percentile interval over resampled pairs; NaN where below sums to 0.

    Parameters
    ----------
    above, below : array_like of shape (n,)
        Two numbers of each episode; or, over clusters, sums of each cluster: the cluster bootstrap.
    seed : int
        Same seed and values, same interval.
    """
    a, b = np.asarray(above, np.float64), np.asarray(below, np.float64)
    if len(a) == 0 or b.sum() == 0.0:
        return math.nan, math.nan, math.nan
    parts = [(a[chosen].sum(axis=1), b[chosen].sum(axis=1)) for chosen in _resamples(len(a), seed)]
    over, under = (np.concatenate(part) for part in zip(*parts, strict=True))
    low, high = np.quantile(over[under != 0.0] / under[under != 0.0], [0.025, 0.975])
    return float(a.sum() / b.sum()), float(low), float(high)


def mcnemar(first_only: int, second_only: int) -> float:
    """Return the two-sided p-value of McNemar's exact test of paired outcomes.

    Parameters
    ----------
    first_only, second_only : int
        Discordant pairs: in how many episodes only the first, or only the second, succeeded. 1 without any.

    Notes
    -----
    Q. McNemar 1947; exact, by the binomial distribution with share 1/2, for any number of discordant pairs.
    """
    from scipy.stats import binomtest

    discordant = first_only + second_only
    return float(binomtest(first_only, discordant, 0.5).pvalue) if discordant else 1.0


def spread(values: Sequence[float]) -> tuple[float, float, float]:
    """Return mean, least and greatest of the scores of several runs of one variant."""
    return float(np.mean(values)), float(min(values)), float(max(values))
