"""The piecewise polynomial: against closed forms, and SciPy's PPoly, BPoly, CubicSpline and KroghInterpolator."""

from math import factorial

import numpy as np
import pytest
from scipy.interpolate import BPoly, BSpline, CubicSpline, KroghInterpolator, PPoly

from rigidfleet.math.piecewise import (
    Piecewise,
    common_knots,
    piece_index,
    refine_knots,
    stack_ways,
)

RNG = np.random.default_rng(7)
TIME = 3.0 + np.cumsum(RNG.uniform(0.3, 1.5, 9))
INSIDE = np.sort(RNG.uniform(TIME[0], TIME[-1], 40))


def normal(*shape: int) -> np.ndarray:
    return np.random.default_rng(shape).normal(size=shape)


def scipys(curve: Piecewise) -> PPoly:
    return PPoly(np.moveaxis(curve.pieces, -1, 0)[::-1], curve.time)


def a_curve(powers: int = 6) -> Piecewise:
    return Piecewise(TIME, normal(8, 2, 3, powers))


def test_values_and_derivatives_are_those_of_scipy():
    """At any time, at knots (the piece after them counts) and beyond both ends, where the outer pieces go on."""
    curve = a_curve()
    t = np.concatenate([INSIDE, TIME, [TIME[0] - 0.5, TIME[-1] + 0.5]])
    known = scipys(curve)
    np.testing.assert_allclose(curve.at(t), known(t), rtol=1e-10, atol=1e-10)
    states = curve.states(t, 8)
    for order in range(8):
        np.testing.assert_allclose(states[order], known(t, order), rtol=1e-9, atol=1e-9)
        taylor = curve.taylor_coefficients(t, 8)[order]
        np.testing.assert_allclose(taylor, known(t, order) / factorial(order), rtol=1e-9, atol=1e-9)
    begin, end = curve.piece_end_states(3)
    for order in range(3):
        np.testing.assert_allclose(begin[order], known(TIME[:-1], order), atol=1e-12)
        left = known(np.nextafter(TIME[1:], 0.0), order)
        np.testing.assert_allclose(end[order], left, rtol=1e-9, atol=1e-9)
        jump = known(TIME[1:-1], order) - left[:-1]
        np.testing.assert_allclose(curve.jumps(3)[order], jump, rtol=1e-9, atol=1e-9)
    shares = np.array([0.1, 0.8])
    at = (TIME[:-1, None] + np.diff(TIME)[:, None] * shares).ravel()
    np.testing.assert_allclose(curve.at_shares(shares).reshape(16, 2, 3), known(at), atol=1e-10)


def test_the_piece_at_a_time():
    """The later one at a knot, or the earlier if that is asked for; the outer ones beyond the ends."""
    knots = np.array([0.0, 1.0, 2.0, 4.0])
    t = np.array([-1.0, 0.0, 1.0, 1.5, 2.0, 4.0, 9.0])
    np.testing.assert_array_equal(piece_index(knots, t), [0, 0, 1, 1, 2, 2, 2])
    np.testing.assert_array_equal(piece_index(knots, t, "left"), [0, 0, 0, 1, 1, 2, 2])


@pytest.mark.parametrize("orders", [1, 2, 3, 4])
def test_hermite_meets_all_derivatives(orders):
    """It is SciPy's polynomial in the Bernstein basis, and between two knots that of Krogh's divided differences."""
    states = normal(orders, len(TIME), 3)
    curve = Piecewise.hermite(TIME, states)
    assert curve.pieces.shape == (8, 3, 2 * orders)
    known = BPoly.from_derivatives(TIME, states.swapaxes(0, 1))
    np.testing.assert_allclose(curve.at(INSIDE), known(INSIDE), rtol=1e-8, atol=1e-8)
    ends = np.repeat(TIME[:2], orders)
    krogh = KroghInterpolator(ends, states[:, :2].swapaxes(0, 1).reshape(-1, 3))
    t = np.linspace(*TIME[:2], 7)
    np.testing.assert_allclose(curve.at(t), krogh(t), rtol=1e-8, atol=1e-8)
    apart = Piecewise.of_end_states(TIME, states[:, :-1] + 1.0, states[:, 1:])
    np.testing.assert_allclose(apart.piece_end_states(orders)[0], states[:, :-1] + 1.0, atol=1e-9)
    np.testing.assert_allclose(apart.jumps(orders), 1.0, rtol=1e-7)


def test_a_cubic_spline_is_that_of_scipy():
    """So are its derivative, and a part of it."""
    x = normal(len(TIME), 2, 3)
    curve, known = Piecewise.cubic_spline(TIME, x), CubicSpline(TIME, x)
    np.testing.assert_allclose(curve.at(INSIDE), known(INSIDE), atol=1e-12)
    np.testing.assert_allclose(curve.derivative_curve().at(INSIDE), known(INSIDE, 1), atol=1e-11)
    np.testing.assert_allclose(curve.slice_pieces(2, 4).at(TIME[2:5]), x[2:5], atol=1e-12)


def test_a_uniform_b_spline_is_that_of_scipy():
    """Its knots are equally spaced over the duration."""
    control, spans = normal(9, 2, 3), 6
    curve = Piecewise.b_spline(control, 3.0)
    known = BSpline(np.arange(-3.0, spans + 4.0) * 3.0 / spans, control, 3)
    t = np.linspace(0.0, 3.0, 50)
    np.testing.assert_allclose(curve.at(t), known(t), atol=1e-12)


def test_control_points_are_those_of_bernstein():
    """They give the curve in SciPy's Bernstein basis, and the curve comes back from them."""
    curve = a_curve(5)
    points = curve.control_points()
    known = BPoly(np.moveaxis(points, -1, 0), TIME)
    np.testing.assert_allclose(curve.at(INSIDE), known(INSIDE), atol=1e-10)
    np.testing.assert_allclose(Piecewise.of_bernstein(TIME, points).pieces, curve.pieces, atol=1e-9)


def test_cuts_parts_and_later_ones_are_the_same_curve():
    """With further knots, within a span, on other knots and begun later, values at all times are those of before."""
    curve = a_curve()
    cut = curve.with_knots(refine_knots(TIME, np.array([0.0, 5.0, TIME[3] + 1e-7, 99.0]), 1e-6))
    np.testing.assert_array_equal(cut.time, np.union1d(TIME, [5.0]))
    part = curve.between(TIME[2] - 0.1, TIME[5])
    np.testing.assert_array_equal(part.time, [TIME[2] - 0.1, *TIME[2:6]])
    for other in (cut, part, curve.with_knots(np.union1d(TIME, [1.0, 20.0]))):
        t = np.linspace(other.time[0], other.time[-1], 60)[:-1]  # at its end the next one begins
        np.testing.assert_allclose(other.at(t), curve.at(t), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(curve.shift_time(2.0).at(INSIDE + 2.0), curve.at(INSIDE), atol=1e-10)


def test_curves_are_joined_at_all_knots():
    """Each agrees with SciPy's spline within its own span, and stays at its ends outside; near knots are one."""
    spans = [TIME[:6] + 1e-10, TIME[2:], TIME[[0, 3, 8]]]
    splines = [CubicSpline(t, normal(len(t), 4)) for t in spans]
    curves = [Piecewise(s.x, np.moveaxis(s.c[::-1], 0, -1)) for s in splines]
    both = stack_ways(curves)
    assert len(both.time) == len(common_knots(curves)) == len(TIME)
    assert both.pieces.shape == (8, 3, 4, 4)
    for i, (t, spline) in enumerate(zip(spans, splines, strict=True)):
        wanted = spline(np.clip(INSIDE, t[0], t[-1]))
        np.testing.assert_allclose(both.at(INSIDE)[:, i], wanted, rtol=0, atol=1e-7)
    with pytest.raises(
        ValueError, match="3 trajectories with 9 times in all are more than 10 coeff"
    ):
        stack_ways(curves, 10)


def test_another_start_fades():
    """Three derivatives begin as asked for and stay continuous; after the fade nothing has changed."""
    curve = Piecewise.hermite(TIME, normal(4, len(TIME), 3))
    state = normal(4, 3)
    moved = curve.start_from(state, 1.7)
    np.testing.assert_allclose(moved.states(TIME[:1], 4)[:, 0], state, atol=1e-9)
    np.testing.assert_allclose(moved.jumps(4), 0.0, atol=1e-6)
    late = INSIDE[TIME[0] + 1.7 < INSIDE]
    np.testing.assert_allclose(moved.at(late), curve.at(late), atol=1e-9)
    assert curve.start_from(curve.states(TIME[:1], 4)[:, 0], 1.7) is curve
