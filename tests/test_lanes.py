"""Eight numbers in one: `rigidfleet.kernel.compiler.simd`."""

import math

import numba
import numpy as np
import pytest

from rigidfleet.kernel.compiler.simd import (
    as_lanes,
    fill_lanes,
    pack_lanes,
    rough_inverse,
    sum_lanes_or_worst_flight,
    unpack_lanes,
)

VALUES = np.random.default_rng(0).normal(size=(5, 8))


def test_packing_keeps_every_number():
    """What is packed is unpacked, from arrays of any dimension, at an address that vectors like."""
    for values in (VALUES, VALUES[0], VALUES.reshape(5, 1, 8)):
        packed = pack_lanes(values)
        assert packed.shape == values.shape[:-1]
        assert packed.ctypes.data % 64 == 0
        np.testing.assert_array_equal(unpack_lanes(packed), values)


def test_arithmetic_acts_on_each_lane():
    """Operators and functions give what they give for eight numbers, numbers mixed in."""

    @numba.njit(error_model="numpy")
    def formula(a, c, out):
        for k in range(a.shape[0]):
            x, b = a[k], c[0]
            y = 2 * x - b + x * b
            y += max(x, 0.25) * max(b, x) - abs(x)
            y *= 0.5
            out[k] = y

    a, b = VALUES, VALUES[0] + 3.0
    out = pack_lanes(np.zeros_like(a))
    formula(pack_lanes(a), pack_lanes(b[None]), out)
    expected = 0.5 * (2 * a - b + a * b + np.maximum(a, 0.25) * np.maximum(b, a) - abs(a))
    np.testing.assert_allclose(unpack_lanes(out), expected, rtol=1e-14, atol=1e-14)


def test_a_number_becomes_a_vector_where_it_meets_one():
    """A sum that starts at 0.0, and an array that is set to a number, hold lanes."""

    @numba.njit
    def total(a, out):
        s = 0.0
        for k in range(a.shape[0]):
            s += a[k]
        out[0], out[1] = s, 1

    out = pack_lanes(np.zeros((2, 8)))
    total(pack_lanes(VALUES), out)
    np.testing.assert_allclose(unpack_lanes(out), [VALUES.sum(axis=0), np.ones(8)], atol=1e-15)


def test_blocks_are_a_view_of_eight_states_each():
    """Of float64, vectors share the memory; of lanes, they are the lanes."""

    @numba.njit
    def double(x):
        y = as_lanes(x)
        for k in range(y.shape[1]):
            y[1, k] = 2.0 * y[0, k]
        return y.shape[1]

    plain = np.zeros((2, 16))
    plain[0] = VALUES.ravel()[:16]
    assert double(plain) == 2
    np.testing.assert_array_equal(plain[1], 2 * plain[0])
    lanes = pack_lanes(np.stack([VALUES, VALUES]))
    assert double(lanes) == 5
    np.testing.assert_array_equal(unpack_lanes(lanes)[1], 2 * VALUES)


def test_an_error_is_a_sum_of_one_flight_and_the_worst_of_eight():
    """Squares add up over the states of one flight; of eight flights the worst counts, and NaN most."""

    @numba.njit
    def error(x):
        y = as_lanes(x)
        squares = fill_lanes(0.0)
        for k in range(y.shape[0]):
            squares += y[k] * y[k]
        return sum_lanes_or_worst_flight(squares, x)

    assert error(VALUES.ravel()) == pytest.approx((VALUES**2).sum(), rel=1e-14)
    assert error(pack_lanes(VALUES)) == pytest.approx((VALUES**2).sum(axis=0).max(), rel=1e-14)
    for lane in range(8):
        broken = VALUES.copy()
        broken[3, lane] = math.nan
        assert math.isnan(error(pack_lanes(broken)))


def test_a_rough_inverse_has_four_digits():
    """What weighs an error need not be exact."""

    @numba.njit
    def weights(x):
        y = as_lanes(x)
        for k in range(y.shape[0]):
            y[k] = rough_inverse(y[k])

    x = np.logspace(-12, 12, 32)
    found = x.copy()
    weights(found)
    np.testing.assert_allclose(found, 1.0 / x, rtol=1e-4)
