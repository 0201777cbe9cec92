"""Eight numbers in one: `rigidfleet.kernel.lanes`."""

import math

import numba
import numpy as np
import pytest

from rigidfleet.kernel.lanes import blocks, pack, spread, total_or_worst, unpack, where_positive

VALUES = np.random.default_rng(0).normal(size=(5, 8))


def test_packing_keeps_every_number():
    """What is packed is unpacked, from arrays of any dimension, at an address that vectors like."""
    for values in (VALUES, VALUES[0], VALUES.reshape(5, 1, 8)):
        packed = pack(values)
        assert packed.shape == values.shape[:-1]
        assert packed.ctypes.data % 64 == 0
        np.testing.assert_array_equal(unpack(packed), values)


def test_arithmetic_acts_on_each_lane():
    """Operators and functions give what they give for eight numbers, numbers mixed in."""

    @numba.njit(error_model="numpy")
    def formula(a, b, out):
        for k in range(a.shape[0]):
            x = a[k]
            y = 2 * x - b / 3.0 + (-x) * b
            y += math.sqrt(max(x, 0.25)) + min(x, b) * abs(x)
            y -= math.sin(x) / math.cos(x) + math.atan2(x, b)
            y *= 0.5
            out[k] = y + where_positive(x, 1.0, b)

    a, b = VALUES, VALUES[0] + 3.0
    out = pack(np.zeros_like(a))
    formula(pack(a), pack(b), out)
    expected = 2 * a - b / 3 - a * b + np.sqrt(np.maximum(a, 0.25)) + np.minimum(a, b) * abs(a)
    expected = 0.5 * (expected - np.tan(a) - np.arctan2(a, b)) + np.where(a > 0, 1.0, b)
    np.testing.assert_allclose(unpack(out), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("lane", range(8))
def test_a_comparison_holds_where_it_holds_in_all_lanes(lane: int):
    """One lane that differs, or that is no number, is enough for a comparison to fail."""

    @numba.njit
    def compare(a):
        return a > 1.0, a >= 2.0, a < 3.0, a <= 2.0, a == 2.0

    values = np.full(8, 2.0)
    assert compare(pack(values)) == (True,) * 5
    for odd in (-1.0, 5.0, math.nan):
        values[lane] = odd
        expected = odd > 1, odd >= 2, odd < 3, odd <= 2, odd == 2
        assert compare(pack(values)) == expected


def test_a_number_becomes_a_vector_where_it_meets_one():
    """A sum that starts at 0.0, and an array that is set to a number, hold lanes."""

    @numba.njit
    def total(a, out):
        s = 0.0
        for k in range(a.shape[0]):
            s += a[k]
        out[0], out[1] = s, 1

    out = pack(np.zeros((2, 8)))
    total(pack(VALUES), out)
    np.testing.assert_allclose(unpack(out), [VALUES.sum(axis=0), np.ones(8)], atol=1e-15)


def test_blocks_are_a_view_of_eight_states_each():
    """Of float64, blocks share the memory; of lanes, they are the lanes."""

    @numba.njit
    def double(x):
        y = blocks(x)
        for k in range(y.shape[1]):
            y[1, k] = 2.0 * y[0, k]
        return y.shape[1]

    plain = np.zeros((2, 16))
    plain[0] = VALUES.ravel()[:16]
    assert double(plain) == 2
    np.testing.assert_array_equal(plain[1], 2 * plain[0])
    lanes = pack(np.stack([VALUES, VALUES]))
    assert double(lanes) == 5
    np.testing.assert_array_equal(unpack(lanes)[1], 2 * VALUES)


def test_an_error_is_a_sum_of_one_flight_and_the_worst_of_eight():
    """Squares add up over the states of one flight; of eight flights the worst counts, and NaN most."""

    @numba.njit
    def error(x):
        y = blocks(x)
        squares = spread(0.0)
        for k in range(y.shape[0]):
            squares += y[k] * y[k]
        return total_or_worst(squares, x)

    assert error(VALUES.ravel()) == pytest.approx((VALUES**2).sum(), rel=1e-14)
    assert error(pack(VALUES)) == pytest.approx((VALUES**2).sum(axis=0).max(), rel=1e-14)
    for lane in range(8):
        broken = VALUES.copy()
        broken[3, lane] = math.nan
        assert math.isnan(error(pack(broken)))
