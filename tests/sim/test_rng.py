"""The kernels' random streams are numpy's."""

import numpy as np
import pytest

from navrep_data.sim import _rng
from navrep_data.sim._layout import RNG_WORDS


@pytest.mark.parametrize(("seed", "sequence"), [(0, 0), (1, 2), (2**63 - 1, 12345), (7, 2**40)])
def test_philox_is_numpys(seed, sequence):
    rng = np.zeros(RNG_WORDS, np.uint64)
    _rng.seed_philox(rng, seed, sequence)
    expected = np.random.Generator(np.random.Philox(key=np.array([seed, sequence], np.uint64))).random(200)
    assert [_rng.uniform(rng) for _ in range(200)] == list(expected)


def test_philox_counter_carries():
    rng = np.zeros(RNG_WORDS, np.uint64)
    _rng.seed_philox(rng, 3, 4)
    rng[2] = np.uint64(2**64 - 2)
    bits = np.random.Philox(key=np.array([3, 4], np.uint64), counter=np.array([2**64 - 2, 0, 0, 0], np.uint64))
    expected = np.random.Generator(bits).random(20)
    assert [_rng.uniform(rng) for _ in range(20)] == list(expected)


@pytest.mark.parametrize("seed", [0, 1000, 1001, 2**32 - 1])
def test_mersenne_twister_is_numpys(seed):
    rng = np.zeros(RNG_WORDS, np.uint64)
    _rng.seed_mt(rng, seed)
    reference = np.random.RandomState(seed)
    for _ in range(400):
        assert _rng.uniform(rng) == reference.random_sample()
        assert _rng.integer(rng, -70, 70) == reference.randint(-70, 70)
        assert _rng.integer(rng, 2, 4) == reference.randint(2, 4)
        assert _rng.integer(rng, 5, 6) == reference.randint(5, 6)


def test_philox_integers_cover_their_range():
    rng = np.zeros(RNG_WORDS, np.uint64)
    _rng.seed_philox(rng, 0, 0)
    drawn = [int(_rng.integer(rng, -2, 3)) for _ in range(500)]
    assert set(drawn) == {-2, -1, 0, 1, 2}
