import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from rigidfleet.math.pid import (
    error_response,
    is_stable,
    overshoot,
    poles,
    settling_time,
    triple_pole,
)

CASE = json.loads((Path(__file__).parent / "data/reference_pid_unit_response.json").read_text())

rate = st.floats(0.1, 10.0)


def gains_of(*s):
    """(alpha, beta, gamma) with these three poles."""
    _, a, b, c = np.poly(s).real
    return a / 2, math.sqrt(b), c


def test_reference():
    """The unit response under the default gains is that of the reference implementation."""
    spec, result = CASE["spec"], CASE["result"]
    start = (spec["c0"], spec["cdot0"], spec["I0"])
    c, _, _ = error_response(spec["alpha"], spec["beta"], spec["gamma"], *start, result["t"])
    assert c == pytest.approx(np.array(result["c"]), abs=1e-13)


@settings(max_examples=20)
@given(st.floats(0.2, 5.0))
def test_triple_pole(p):
    """A triple pole's response from rest is e^-x (1 + x - x^2), with its exact rate and integral."""
    t = np.linspace(0.0, 12.0 / p, 50)
    x = p * t
    c, c_dot, integral = error_response(*triple_pole(p), 1.0, 0.0, 0.0, t)
    assert c == pytest.approx(np.exp(-x) * (1 + x - x**2), abs=1e-13)
    assert c_dot == pytest.approx(p * np.exp(-x) * (x**2 - 3 * x), abs=1e-13 * p)
    assert integral == pytest.approx(np.exp(-x) * (x + x**2) / p, abs=1e-13 / p)
    assert poles(*triple_pole(p)) == pytest.approx(np.full(3, -p), rel=1e-14)


@settings(max_examples=30)
@given(rate, st.floats(0.3, 3.0), st.floats(1.3, 4.0))
def test_distinct_poles(a, re, ratio):
    """With distinct poles the response is the sum of their exponentials."""
    s = np.array([-a * ratio - re, complex(-re, a), complex(-re, -a)])
    alpha, beta, gamma = gains_of(*s)
    c0, v0, I0 = 0.7, -0.4, 0.2
    t = np.linspace(0.0, 4.0, 9)
    start = [c0, v0, -2 * alpha * v0 - beta**2 * c0 - gamma * I0]
    r = np.linalg.solve(s ** np.arange(3)[:, None], start)
    grown = np.exp(np.outer(t, s))
    c, c_dot, integral = error_response(alpha, beta, gamma, c0, v0, I0, t)
    assert c == pytest.approx((grown @ r).real, abs=1e-11)
    assert c_dot == pytest.approx((grown @ (s * r)).real, abs=1e-10)
    assert integral == pytest.approx(I0 + ((grown - 1) @ (r / s)).real, abs=1e-11)
    assert poles(alpha, beta, gamma) == pytest.approx(np.sort_complex(s), rel=1e-10)


def test_without_integral_action():
    """gamma = 0 leaves a second-order error: critically damped, c = e^-x (1 + x)."""
    t = np.linspace(0.0, 8.0, 30)
    c, c_dot, integral = error_response(1.5, 1.5, 0.0, 2.0, 0.0, 0.1, t)
    x = 1.5 * t
    assert c == pytest.approx(2 * np.exp(-x) * (1 + x), abs=1e-14)
    assert c_dot == pytest.approx(-3 * x * np.exp(-x), abs=1e-14)
    assert integral == pytest.approx(0.1 + (2 - np.exp(-x) * (2 + x)) / 0.75, abs=1e-14)
    assert poles(1.5, 1.5, 0.0) == pytest.approx(np.array([-1.5, -1.5]), rel=1e-15)


def test_double_pole():
    """A double pole beside a single one comes out as such."""
    assert poles(*gains_of(-5.0, -2.0, -2.0)) == pytest.approx([-5.0, -2.0, -2.0], rel=1e-13)


def test_unstable_and_free_errors():
    """Without stabilisation the error drifts, c = c0 + v0 t; unstable gains let it grow."""
    t = np.array([0.0, 1.0, 10.0])
    c, c_dot, integral = error_response(0.0, 0.0, 0.0, 1.0, 0.5, 0.0, t)
    assert c == pytest.approx(1.0 + 0.5 * t, rel=1e-14)
    assert c_dot == pytest.approx(np.full(3, 0.5), rel=1e-14)
    assert integral == pytest.approx(t + 0.25 * t**2, rel=1e-14)
    assert np.abs(error_response(1.0, 1.0, 3.0, 1.0, 0.0, 0.0, 100.0)[0]) > 1e3


def test_shapes():
    """Times come first in the result, edges after; a scalar of each gives a scalar."""
    c0 = np.array([1.0, 2.0, 3.0])
    c, c_dot, integral = error_response(3.0, 3.0, 1.0, c0, 0.0, np.zeros(3), np.zeros((4, 2)))
    assert c.shape == c_dot.shape == integral.shape == (4, 2, 3)
    assert np.array_equal(c[2, 1], c0)
    assert error_response(3.0, 3.0, 1.0, 1.0, 0.0, 0.0, 1.0)[0].shape == ()


@given(st.floats(-1.0, 5.0), rate, st.floats(-1.0, 50.0))
@example(3.0, math.sqrt(12.0), 8.0)
@example(1.0, 2.0, 0.0)
def test_stability_is_where_the_poles_are(alpha, beta, gamma):
    """Gains are stable exactly where all poles lie in the left half plane."""
    damping = poles(alpha, beta, gamma).real.max()
    assume(abs(damping) > 1e-6)
    assert is_stable(alpha, beta, gamma) == (damping < 0.0)


@pytest.mark.parametrize(
    "gains", [(0, 1, 0), (1, 0, 0), (1, 1, 2), (1, 1, -1), (math.nan, 1, 1), (-1, 1, 1)]
)
def test_unstable_gains(gains):
    """Gains on or beyond the limit, or that are no numbers, are not stable."""
    assert not is_stable(*gains)
    with pytest.raises(ValueError, match=r"unstable: choose alpha, beta > 0 and 0 <= gamma"):
        settling_time(*gains)


@settings(max_examples=20)
@given(st.floats(0.05, 50.0))
def test_overshoot_of_a_triple_pole(p):
    """A triple pole overshoots by 5 e^-3 = 24.9 %, however fast it is."""
    assert overshoot(*triple_pole(p)) == pytest.approx(5 * math.exp(-3), rel=1e-12)


@pytest.mark.parametrize("zeta", [0.01, 0.2, 0.6, 0.9])
def test_overshoot_of_second_order(zeta):
    """With gamma = 0 the overshoot is exp(-pi zeta / sqrt(1 - zeta^2)), and none from zeta = 1 on."""
    expected = math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))
    assert overshoot(3.0 * zeta, 3.0, 0.0) == pytest.approx(expected, rel=1e-10)
    assert overshoot(3.0 / zeta, 3.0, 0.0) == 0.0


@pytest.mark.parametrize("tolerance", [0.5, 0.02, 1e-4, 1e-8])
def test_settling_time(tolerance):
    """After the settling time, and not before, the error of a double pole is within tolerance."""
    x = 2.0 * settling_time(2.0, 2.0, 0.0, tolerance)
    assert (1 + x) * math.exp(-x) == pytest.approx(tolerance, rel=1e-6)


@settings(max_examples=20)
@given(rate, st.floats(0.3, 8.0), st.floats(0.02, 0.95))
def test_settled_means_settled(alpha, beta, fraction):
    """At the settling time |c| equals the tolerance, and later never passes it, for any gains."""
    gamma = fraction * 2 * alpha * beta**2
    t = settling_time(alpha, beta, gamma, 0.02)
    later = np.linspace(1.0, 3.0, 500) * t
    c, _, _ = error_response(alpha, beta, gamma, 1.0, 0.0, 0.0, later)
    assert abs(c[0]) == pytest.approx(0.02, rel=1e-6)
    assert np.abs(c).max() <= 0.02 * (1 + 1e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: triple_pole(0.0), "positive"),
        (lambda: settling_time(3.0, 3.0, 1.0, 1.5), "between 0 and 1"),
        (lambda: settling_time(1e-6, 1.0, 0.0), "more than a thousand cycles"),
    ],
)
def test_errors(call, message):
    """What cannot be answered is refused, and the message says why."""
    with pytest.raises(ValueError, match=message):
        call()
