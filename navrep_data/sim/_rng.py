# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Random streams that live in an array, so that kernels draw without Python and a sequence owns its randomness.

Two kinds, told apart by the last word:

* Philox4x64-10, counter-based: the numbers of ``numpy.random.Generator(numpy.random.Philox(key=[seed, sequence]))``.
  One stream per sequence; this is what makes bytes independent of workers, order and batches.
* MT19937 in numpy's legacy arrangement: the numbers of ``numpy.random.RandomState(seed)``, for the seeded test
  episodes of the original.

Arithmetic on unsigned words is written so that nothing overflows, because numpy warns of that when the kernels run
without compilation.
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._layout import RNG_WORDS

_MASK32 = np.uint64(0xFFFFFFFF)
_S32 = np.uint64(32)
_M0 = np.uint64(0xD2E7470EE14C6C93)
_M1 = np.uint64(0xCA5A826395121157)
_W0 = np.uint64(0x9E3779B97F4A7C15)
_W1 = np.uint64(0xBB67AE8584CAA73B)
_ROUNDS = 10
_INV53 = 1.0 / 9007199254740992.0

# Philox: words 0-1 key, 2-5 counter, 6-9 buffer, 10 position. MT19937: words 0-623 state, 624 position.
_KEY, _COUNTER, _BUFFER, _POS = 0, 2, 6, 10
_MT_POS = 624
_KIND = RNG_WORDS - 1
_KIND_PHILOX = np.uint64(0)
_KIND_MT = np.uint64(1)
_MT_UPPER = np.uint64(0x80000000)
_MT_LOWER = np.uint64(0x7FFFFFFF)
_MT_MATRIX = np.uint64(0x9908B0DF)


@kernel
def _add64(a, b):
    low = (a & _MASK32) + (b & _MASK32)
    high = (a >> _S32) + (b >> _S32) + (low >> _S32)
    return ((high & _MASK32) << _S32) | (low & _MASK32)


@kernel
def _mul128(a, b):
    """Return the high and low 64 bits of a x b."""
    a0, a1 = a & _MASK32, a >> _S32
    b0, b1 = b & _MASK32, b >> _S32
    p00 = a0 * b0
    p01 = a0 * b1
    p10 = a1 * b0
    p11 = a1 * b1
    middle = (p00 >> _S32) + (p01 & _MASK32) + (p10 & _MASK32)
    low = ((middle & _MASK32) << _S32) | (p00 & _MASK32)
    high = p11 + (p01 >> _S32) + (p10 >> _S32) + (middle >> _S32)
    return high, low


@kernel
def philox(k0, k1, c0, c1, c2, c3):
    """Return the four words of one Philox4x64-10 block: key k, counter c."""
    for r in range(_ROUNDS):
        if r > 0:
            k0 = _add64(k0, _W0)
            k1 = _add64(k1, _W1)
        high0, low0 = _mul128(_M0, c0)
        high1, low1 = _mul128(_M1, c2)
        c0, c1, c2, c3 = high1 ^ c1 ^ k0, low1, high0 ^ c3 ^ k1, low0
    return c0, c1, c2, c3


@kernel
def _philox_block(rng):
    """Advance the counter and fill the buffer with four words."""
    for i in range(4):
        word = _add64(rng[_COUNTER + i], np.uint64(1))
        rng[_COUNTER + i] = word
        if word != np.uint64(0):
            break
    c0, c1, c2, c3 = philox(
        rng[_KEY], rng[_KEY + 1], rng[_COUNTER], rng[_COUNTER + 1], rng[_COUNTER + 2], rng[_COUNTER + 3]
    )
    rng[_BUFFER] = c0
    rng[_BUFFER + 1] = c1
    rng[_BUFFER + 2] = c2
    rng[_BUFFER + 3] = c3
    rng[_POS] = np.uint64(0)


@kernel
def _mt_generate(rng):
    for i in range(624):
        y = (rng[i] & _MT_UPPER) | (rng[(i + 1) % 624] & _MT_LOWER)
        value = rng[(i + 397) % 624] ^ (y >> np.uint64(1))
        if y & np.uint64(1):
            value ^= _MT_MATRIX
        rng[i] = value
    rng[_MT_POS] = np.uint64(0)


@kernel
def _mt_uint32(rng):
    if rng[_MT_POS] >= np.uint64(624):
        _mt_generate(rng)
    y = rng[np.int64(rng[_MT_POS])]
    rng[_MT_POS] += np.uint64(1)
    y ^= y >> np.uint64(11)
    y ^= (y << np.uint64(7)) & np.uint64(0x9D2C5680)
    y ^= (y << np.uint64(15)) & np.uint64(0xEFC60000)
    y ^= y >> np.uint64(18)
    return y & _MASK32


@kernel
def seed_philox(rng, seed, sequence):
    """Start the Philox stream with key (seed, sequence)."""
    rng[:] = np.uint64(0)
    rng[_KEY] = np.uint64(seed)
    rng[_KEY + 1] = np.uint64(sequence)
    rng[_POS] = np.uint64(4)
    rng[_KIND] = _KIND_PHILOX


@kernel
def seed_mt(rng, seed):
    """Start the stream of ``numpy.random.RandomState(seed)``."""
    word = np.uint64(seed) & _MASK32
    for i in range(624):
        rng[i] = word
        mixed = word ^ (word >> np.uint64(30))
        # 1812433253 x mixed fits 64 bits: both factors have at most 32
        word = (np.uint64(1812433253) * mixed + np.uint64(i + 1)) & _MASK32
    rng[_MT_POS] = np.uint64(624)
    rng[_KIND] = _KIND_MT


@kernel
def is_mersenne(rng):
    """Return whether the stream is one of numpy's legacy generator."""
    return rng[_KIND] == _KIND_MT


@kernel
def stream_key(rng):
    """Return the two words that name a stream: a Philox key, or the seed of a legacy stream not yet drawn from."""
    if rng[_KIND] == _KIND_MT:
        return rng[0], _KIND_MT
    return rng[_KEY], rng[_KEY + 1]


@kernel
def uniform(rng):
    """Return a float64 in [0, 1), as ``Generator.random`` or ``RandomState.random_sample`` do."""
    if rng[_KIND] == _KIND_MT:
        a = _mt_uint32(rng) >> np.uint64(5)
        b = _mt_uint32(rng) >> np.uint64(6)
        return (np.float64(a) * 67108864.0 + np.float64(b)) * _INV53
    if rng[_POS] >= np.uint64(4):
        _philox_block(rng)
    word = rng[_BUFFER + np.int64(rng[_POS])]
    rng[_POS] += np.uint64(1)
    return np.float64(word >> np.uint64(11)) * _INV53


@kernel
def integer(rng, low, high):
    """Return an integer in [low, high): ``RandomState.randint`` for MT19937, floor of a uniform for Philox."""
    span = high - low
    if rng[_KIND] == _KIND_MT:
        if span <= 1:
            return low
        # numpy's legacy rule: mask to the next power of two and reject
        top = np.uint64(span - 1)
        mask = top
        mask |= mask >> np.uint64(1)
        mask |= mask >> np.uint64(2)
        mask |= mask >> np.uint64(4)
        mask |= mask >> np.uint64(8)
        mask |= mask >> np.uint64(16)
        value = _mt_uint32(rng) & mask
        while value > top:
            value = _mt_uint32(rng) & mask
        return low + np.int64(value)
    return low + np.int64(np.floor(uniform(rng) * span))
