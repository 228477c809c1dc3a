"""The rings' own deflate against zlib: any content, any length, and never an invalid stream."""

import zlib

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from navrep_data.kernels import kernel
from navrep_data.observations import scan_to_rings
from navrep_data.shards._bits import high_zeros, low_zeros
from navrep_data.shards._codec import encode, inflate
from navrep_data.shards._rings_deflate import deflate_rings


def check(block):
    stream = deflate_rings(block)
    decoder = zlib.decompressobj(-15)
    assert decoder.decompress(stream) == block.tobytes()
    assert decoder.eof
    assert decoder.unused_data == b""
    return len(stream)


def real_rings(rows, seed=0):
    rng = np.random.default_rng(seed)
    walls = np.cumsum(rng.normal(0, 0.05, (rows, 1080)), axis=1) + rng.uniform(2, 9, (rows, 1))
    return scan_to_rings(np.clip(walls, 0.1, 25.0).astype(np.float32))


def test_real_rings_become_small():
    block = real_rings(25)
    assert check(block) < 0.12 * block.size


@pytest.mark.parametrize("value", [0, 1, 2])
@pytest.mark.parametrize("rows", [1, 2, 25])
def test_constant_rings(value, rows):
    block = np.full((rows, 64, 64), value, np.uint8)
    assert check(block) < 400 + 64 * rows


def test_every_run_length_and_every_pair_of_values():
    sections = [np.repeat([a, b], [n, 64 - n]) for a in range(3) for b in range(3) for n in range(65)]
    sections += [sections[0]] * (64 * 10 - len(sections) % 64)
    block = np.array(sections, np.uint8)
    check(block[: len(block) // 64 * 64].reshape(-1, 64, 64))


@pytest.mark.parametrize("repeats", range(1, 12))
def test_repeated_sections(repeats):
    rng = np.random.default_rng(repeats)
    sections = np.repeat(rng.integers(0, 3, (64, 64)), repeats, axis=0).astype(np.uint8)
    check(sections.reshape(repeats, 64, 64))


@pytest.mark.slow
@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.floats(0.0, 1.0))
def test_random_rings(seed, rows, noise):
    rng = np.random.default_rng(seed)
    block = real_rings(rows, seed)
    block = np.where(rng.random(block.shape) < noise, rng.integers(0, 3, block.shape), block).astype(np.uint8)
    check(block)


def test_worst_case_fits_its_buffer():
    rng = np.random.default_rng(1)
    check(rng.integers(0, 3, (40, 64, 64)).astype(np.uint8))
    alternating = np.tile(np.array([0, 1], np.uint8), 2048).reshape(1, 64, 64)
    alternating[0, ::2] ^= 1
    check(alternating)


def test_other_values_are_left_to_the_library():
    block = np.zeros((2, 64, 64), np.uint8)
    block[1, 63, 63] = 3
    assert deflate_rings(block) is None
    assert inflate(encode(block), block.size) == block.tobytes()


def test_hdf5_reads_it(tmp_path):
    block = real_rings(20)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        d = file.create_dataset("r", block.shape, np.uint8, chunks=block.shape, compression="gzip")
        d.id.write_direct_chunk((0, 0, 0), encode(block))
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file["r"][:], block)


def test_every_copy_length():
    """Stretches of 1 to 600 cells that equal what stands 64 cells ago, each ended by a cell that does not."""
    cells = list(np.random.default_rng(4).integers(0, 3, 64))
    for length in range(1, 601):
        for _ in range(length):
            cells.append(cells[-64])
        cells.append((cells[-64] + 1) % 3)
    cells += [0] * (-len(cells) % 4096)
    check(np.array(cells, np.uint8).reshape(-1, 64, 64))


@pytest.mark.parametrize(
    ("word", "low", "high"), [(0, 64, 64), (1, 0, 63), (1 << 63, 63, 0), (0x0000100000080000, 19, 19)]
)
def test_zero_bits_of_a_word(word, low, high):
    """Compiled, and as plain Python (without numba these are the functions themselves)."""
    assert (low_zeros(np.uint64(word)), high_zeros(np.uint64(word))) == (low, high)
    assert _both(np.uint64(word)) == (low, high)


@kernel
def _both(word):
    return low_zeros(word), high_zeros(word)
