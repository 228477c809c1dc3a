"""What packing promises of numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from navrep_data.view.packing import NAN_CODE, pack_rings, quantise, zigzag_delta

FLOATS = st.floats(width=32, allow_nan=True, allow_infinity=True)


@pytest.mark.slow
@given(arrays(np.float64, array_shapes(max_dims=2, max_side=20), elements=FLOATS))
def test_codes_are_within_half_a_step_and_nan_stays_nan(values):
    codes, origin, step = quantise(values, 0.001)
    good = np.abs(values) < 1e30
    np.testing.assert_array_equal(codes == NAN_CODE, ~good)
    error = np.abs(origin + step * codes[good].astype(float) - values[good])
    assert (error <= step * (0.5 + 1e-9) + np.abs(values[good]) * 1e-12).all()
    assert step >= 0.001


def test_the_step_is_as_asked_where_the_range_allows():
    assert quantise(np.array([-30.0, 35.0]), 0.001)[2] == 0.001
    assert quantise(np.array([-300.0, 350.0]), 0.001)[2] == pytest.approx(650 / 65534)


@pytest.mark.parametrize("values", [[-1e308, 1.7e308, np.inf], [np.nan, 1e30], []])
def test_huge_numbers_are_unknown(values):
    codes, origin, step = quantise(np.array(values), 0.001)
    assert (origin, step) == (0.0, 0.001)
    assert (codes == NAN_CODE).all()


@pytest.mark.slow
@given(arrays(np.uint16, array_shapes(min_dims=2, max_dims=2, max_side=30)))
def test_differences_fold_and_unfold(codes):
    for row, folded in zip(codes.tolist(), zigzag_delta(codes).tolist(), strict=True):
        value = 0
        for code, f in zip(row, folded, strict=True):
            value = (value + (f // 2 if f % 2 == 0 else -(f + 1) // 2)) % 65536
            assert value == code


def test_rings_take_two_bits_a_cell():
    rings = np.random.default_rng(0).integers(0, 3, (3, 64, 64)).astype(np.uint8)
    packed = pack_rings(rings)
    assert packed.shape == (3, 1024)
    cells = [(int(byte) >> (2 * k)) & 3 for byte in packed.ravel() for k in range(4)]
    np.testing.assert_array_equal(cells, rings.ravel())
