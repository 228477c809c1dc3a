"""Metrics on hand-made paths whose numbers are known, and against plain loops; intervals against exhaustive search."""

import math
from itertools import pairwise

import numpy as np
import pytest
from recorded import reference

from navrep_data.evaluate.metrics import (
    METRICS,
    mean_jerk,
    measure,
    min_clearance,
    path_length,
    personal_space_time,
    spl,
)
from navrep_data.evaluate.statistics import bootstrap, bootstrap_ratio, spread, wilson

DT = 0.2
SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]


def test_path_length_of_a_square_is_its_perimeter_though_it_ends_where_it_began():
    assert path_length(SQUARE) == pytest.approx(4.0)
    assert path_length([(3, 4)]) == 0.0


@pytest.mark.parametrize(
    ("success", "shortest", "length", "expected"),
    [(True, 3, 3, 1), (True, 3, 4, 0.75), (False, 3, 3, 0), (True, 3, 2.9, 1), (True, 0, 0, 1)],
)
def test_spl(success, shortest, length, expected):
    assert spl(success, shortest, length) == pytest.approx(expected)


def test_min_clearance_is_that_of_the_nearer_kind_and_nan_without_anything():
    assert min_clearance([1.0, 0.3, 2.0], [0.5, 0.4, 0.6]) == 0.3
    assert min_clearance([np.inf, np.inf], [0.5, -0.1]) == -0.1
    assert math.isnan(min_clearance([np.inf], [np.inf]))


def test_personal_space_counts_moments_after_the_first_below_20_cm():
    assert personal_space_time([0.1, 0.1, 0.2, 0.19, -0.3], DT) == pytest.approx(3 * DT)
    assert personal_space_time([0.1], DT) == 0.0


def test_jerk_is_zero_at_constant_acceleration_and_known_for_a_jolt():
    t = DT * np.arange(6)
    assert mean_jerk(np.stack([0.5 * 2.0 * t**2, 3.0 * t], axis=1), DT) == pytest.approx(0.0, abs=1e-9)
    # x = t^3 has the constant jerk 6, and so have its differences
    assert mean_jerk(np.stack([t**3, 0 * t], axis=1), DT) == pytest.approx(6.0)
    # starts to move at 1 m/s and stops after a step: velocities 0, 1, 0
    assert mean_jerk([(0, 0), (0, 0), (0.2, 0), (0.2, 0)], DT) == pytest.approx(2.0 / DT**2)
    assert math.isnan(mean_jerk([(0, 0), (1, 0), (2, 0)], DT))


def slow(positions, human, static, dt, success, shortest):
    """The definitions, in plain loops."""
    length = sum(math.dist(a, b) for a, b in pairwise(positions))
    v = [[(b[i] - a[i]) / dt for i in (0, 1)] for a, b in pairwise(positions)]
    a = [[(q[i] - p[i]) / dt for i in (0, 1)] for p, q in pairwise(v)]
    j = [math.hypot(*[(q[i] - p[i]) / dt for i in (0, 1)]) for p, q in pairwise(a)]
    return {
        "time_to_goal": (len(positions) - 1) * dt if success else math.nan,
        "path_length": length,
        "spl": shortest / max(shortest, length) if success else 0.0,
        "min_clearance": min(min(human), min(static)),
        "personal_space_time": sum(dt for gap in human[1:] if gap < 0.2),
        "time_stopped": sum(dt for a, b in pairwise(positions) if math.dist(a, b) / dt < 0.05),
        "mean_jerk": sum(j) / len(j),
    }


@pytest.mark.parametrize("seed", range(5))
def test_random_walks_against_plain_loops(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 40))
    path = np.cumsum(rng.normal(0, 0.1, (n, 2)) * rng.integers(0, 2, (n, 1)), axis=0)
    human, static = rng.uniform(-0.1, 1.0, (2, n))
    found = measure(path, human, static, DT, bool(seed % 2), 1.5)
    expected = slow(path.tolist(), human.tolist(), static.tolist(), DT, bool(seed % 2), 1.5)
    assert set(found) == {m.name for m in METRICS}
    assert found == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize(("successes", "n"), [(0, 10), (3, 10), (10, 10), (25, 108), (125, 200)])
def test_wilson_holds_exactly_the_shares_within_1_96_standard_deviations(successes, n):
    low, high = wilson(successes, n)
    p = np.linspace(0, 1, 200_001)
    inside = p[np.abs(successes / n - p) <= 1.959963984540054 * np.sqrt(p * (1 - p) / n) + 1e-15]
    assert low == pytest.approx(inside.min(), abs=1e-5)
    assert high == pytest.approx(inside.max(), abs=1e-5)


def test_wilson_of_nothing_knows_nothing():
    assert wilson(0, 0) == (0.0, 1.0)


def test_wilson_equals_the_reference():
    for run in reference("original_scores.json")["navreptrain_test"].values():
        assert wilson(run["outcome"].count("S"), run["n"]) == pytest.approx(run["wilson95_success"])


def test_bootstrap_is_seeded_leaves_out_nan_and_covers_as_the_normal_does():
    values = np.random.default_rng(0).normal(5.0, 2.0, 400)
    mean, low, high = bootstrap([*values, math.nan])
    assert (mean, low, high) == bootstrap(values)
    assert mean == pytest.approx(values.mean())
    half = 1.96 * values.std() / math.sqrt(len(values))
    assert (low, high) == pytest.approx((mean - half, mean + half), abs=0.1 * half)
    assert bootstrap(values, seed=1) != (mean, low, high)
    assert all(math.isnan(x) for x in bootstrap([math.nan]))


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 3, 200, 1081])
def test_bootstrap_is_one_resample_after_the_other(n):
    """In a plain loop; 1,081 values are drawn in several parts, of which the last is shorter."""
    rng = np.random.default_rng(n)
    values, below = rng.normal(size=n), rng.integers(0, 2, n) * rng.uniform(size=n)
    below[0] = 1.0
    draws, means, ratios = np.random.default_rng(4), [], []
    for _ in range(2000):
        chosen = draws.integers(0, n, n)
        means.append(values[chosen].mean())
        if below[chosen].sum() != 0.0:
            ratios.append(values[chosen].sum() / below[chosen].sum())
    assert bootstrap(values, seed=4) == (values.mean(), *np.quantile(means, [0.025, 0.975]))
    ends = np.quantile(ratios, [0.025, 0.975])
    assert bootstrap_ratio(values, below, seed=4) == (values.sum() / below.sum(), *ends)


def test_spread():
    assert spread([0.2, 0.5, 0.2]) == pytest.approx((0.3, 0.2, 0.5))
