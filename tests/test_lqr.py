import json
from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import PPoly

from rigidfleet.lqr import (
    closed_loop_response,
    double_integrator_gains,
    finite_horizon,
    finite_horizon_trajectory,
    infinite_horizon,
    infinite_horizon_trajectory,
    knots,
    quintic_pieces,
)

CASE = json.loads((Path(__file__).parent / "data/reference_lqr_finite_gains.json").read_text())

A = np.array([[0.0, 1.0], [0.0, 0.0]])
B = np.array([[0.0], [1.0]])
S = [1e3, 1e2]
weight = st.floats(-4.0, 4.0).map(lambda x: 10.0**x)


def random_system(seed, n=5, m=2):
    rng = np.random.default_rng(seed)
    C = rng.normal(size=(3, n))
    return (
        rng.normal(size=(n, n)),
        rng.normal(size=(n, m)),
        C.T @ C,
        np.diag(rng.uniform(0.1, 2, m)),
    )


def test_reference():
    """Costs and gains of the finite horizon are those of the reference implementation."""
    spec, result = CASE["spec"], CASE["result"]
    weights = [spec[k] for k in "ABQR"]
    P, K = finite_horizon(*weights, spec["S"], result["time_to_go"])
    assert pytest.approx(np.array(result["P"]), abs=1e-9) == P
    assert pytest.approx(np.array(result["K"])[:, None], abs=1e-9) == K
    assert infinite_horizon(*weights)[0][0] == pytest.approx(np.array(result["K_inf"]), abs=1e-14)
    gains = double_integrator_gains(spec["Q"], spec["R"])
    assert gains == pytest.approx(tuple(result["K_inf"]), rel=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_infinite_horizon_against_python_control(seed):
    """Gain and cost for an infinite horizon are python-control's."""
    system = random_system(seed)
    K, P = infinite_horizon(*system)
    K_control, P_control, _ = control.lqr(*system)
    assert pytest.approx(K_control, rel=1e-9, abs=1e-10) == K
    assert pytest.approx(P_control, rel=1e-9, abs=1e-10) == P


@settings(max_examples=30)
@given(weight, st.floats(0.0, 1e4), weight, st.floats(-0.9, 0.9))
def test_double_integrator_gains(q1, q2, r, coupling):
    """The closed form agrees with the Riccati equation over eight decades of weights."""
    q12 = coupling * np.sqrt(q1 * q2)
    Q = [[q1, q12], [q12, q2]]
    K, _ = infinite_horizon(A, B, Q, r)
    assert double_integrator_gains(Q, r) == pytest.approx(tuple(K[0]), rel=1e-12)


def test_default_tracking_gains():
    """The default weights Q = 4, 4, R = 1 give k1 = 2 and k2 = sqrt(8)."""
    assert double_integrator_gains([4.0, 4.0], 1.0) == pytest.approx((2.0, np.sqrt(8.0)), rel=1e-15)


@given(st.floats(1e-3, 1e4), weight, weight, weight)
def test_minimum_energy_closed_form(tau, s1, s2, r):
    """With Q = 0 the cost is Phi^T (S^-1 + W)^-1 Phi, whatever the horizon and the weights."""
    Phi = np.array([[1.0, tau], [0.0, 1.0]])
    W = np.array([[tau**3 / 3, tau**2 / 2], [tau**2 / 2, tau]]) / r
    expected = Phi.T @ np.linalg.inv(np.diag([1 / s1, 1 / s2]) + W) @ Phi
    P, K = finite_horizon(A, B, [0.0, 0.0], r, [s1, s2], tau)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert P / size == pytest.approx(expected / size, abs=1e-9)
    assert pytest.approx(P[1:] / r, rel=1e-12) == K


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("tau", [0.03, 1.0, 4.0])
def test_riccati_equation(seed, tau):
    """The cost satisfies dP/dtau = A^T P + P A - P B R^-1 B^T P + Q and begins at S."""
    system = A5, B5, Q5, R5 = random_system(seed)
    S5, h = np.diag([1.0, 0.0, 20.0, 3.0, 100.0]), min(2e-3, tau / 100)
    P = finite_horizon(*system, S5, tau + h * np.arange(-3, 4))[0]
    P_dot = np.tensordot([-1, 9, -45, 0, 45, -9, 1], P, axes=1) / (60 * h)
    P = P[3]
    residual = A5.T @ P + P @ A5 - P @ B5 @ np.linalg.solve(R5, B5.T) @ P + Q5 - P_dot
    assert np.abs(residual).max() < 1e-6 * max(1.0, np.abs(P_dot).max())
    assert np.array_equal(finite_horizon(*system, S5, 0.0)[0], S5)


@given(weight, st.floats(0.0, 1e3), weight, st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_horizons_add_up(q1, q2, r, first, second):
    """The cost over two horizons in turn is the cost over their sum."""
    system = (A, B, [q1, q2], r)
    between = finite_horizon(*system, S, first)[0]
    P = finite_horizon(*system, S, first + second)[0]
    size = np.sqrt(np.outer(np.diag(P), np.diag(P)))
    assert finite_horizon(*system, between, second)[0] / size == pytest.approx(P / size, abs=1e-12)


@pytest.mark.parametrize("Q", [[4.0, 4.0], [1.0, 1e4], [1e4, 0.0]])
def test_long_horizons_end_at_the_infinite_one(Q):
    """No horizon overflows: the cost tends to that of the infinite horizon and stays there."""
    P = finite_horizon(A, B, Q, 1.0, S, [2e3, 1e6, 1e12])[0]
    expected = np.broadcast_to(infinite_horizon(A, B, Q, 1.0)[1], P.shape)
    assert pytest.approx(expected, rel=1e-12) == P


@pytest.mark.parametrize("seed", range(3))
def test_cost_is_what_the_motion_costs(seed):
    """x0^T P x0 / 2 is the paper's cost of the optimal motion, by Gauss-Legendre quadrature."""
    system = random_system(seed)
    S5, T, x0 = np.diag([1.0, 2.0, 30.0, 4.0, 0.0]), 2.0, np.array([1.0, -2.0, 0.5, 0.0, 3.0])
    node, share = np.polynomial.legendre.leggauss(60)
    times = np.append(0.5 * T * (node + 1.0), T)
    x, u = closed_loop_response(*system, S5, T, x0, times)
    running = np.einsum("ki,ij,kj->k", x, system[2], x) + np.einsum("ki,ij,kj->k", u, system[3], u)
    cost = 0.5 * (x[-1] @ S5 @ x[-1] + 0.5 * T * share @ running[:-1])
    assert cost == pytest.approx(0.5 * x0 @ finite_horizon(*system, S5, T)[0] @ x0, rel=1e-11)


@pytest.mark.parametrize("Q", [[0.0, 0.0], [4.0, 4.0], [0.0, 50.0]])
def test_trajectory_is_the_feedback_law_flown(Q):
    """The exact flight is what integrating a = -K(T - t) (e, edot) gives, on every axis."""
    T, R = 8.0, 0.7
    start = np.array([[17.5, 7.5, 20.0], [0.3, 0.0, -1.0]])
    target = np.array([[35.0, 7.5, 21.0], [2.0, 0.0, 0.5]])
    times = np.linspace(0.0, T, 9)

    def law(t, y):
        x, v = y.reshape(2, 3)
        e = np.array([x - (target[0] + (t - T) * target[1]), v - target[1]])
        K = finite_horizon(A, B, Q, R, S, T - t)[1]
        return np.concatenate([v, -(K @ e)[0]])

    flown = solve_ivp(law, (0, T), start.ravel(), "DOP853", times, rtol=1e-12, atol=1e-12).y
    x, v, a = finite_horizon_trajectory(times, start, target, T, Q, R, S)
    assert x == pytest.approx(flown[:3].T, abs=1e-9)
    assert v == pytest.approx(flown[3:].T, abs=1e-9)
    asked = np.array([law(t, y)[3:] for t, y in zip(times, flown.T, strict=True)])
    assert a == pytest.approx(asked, abs=1e-6)


def test_moving_target_is_met():
    """Waypoint 3 of the paper, 8 s after the second, is met to 2e-4 m with at most 0.68 m/s^2."""
    start, target = ([35.0, 7.5], [2.0, 0.0]), ([45.0, 20.0], [0.0, 2.0])
    times = np.linspace(0.0, 8.0, 81)
    x, v, a = finite_horizon_trajectory(times, start, target, 8.0, [0.0, 0.0], 1.0, S)
    assert np.linalg.norm(x[-1] - target[0]) < 2e-4
    assert np.linalg.norm(v[-1] - target[1]) < 5e-3
    assert np.abs(a).max() < 0.68


@pytest.mark.parametrize("T", [1e3, 1e6])
def test_long_flights(T):
    """A flight over a very long horizon begins as the infinite one, rests, and meets its end."""
    Q, times = [4.0, 4.0], np.array([0.0, 0.5, 2.0, T / 2, T - 0.5, T])
    start, target = (1.0, -2.0), (0.0, 0.0)
    long = finite_horizon_trajectory(times, start, target, T, Q, 1.0, S)
    rest = infinite_horizon_trajectory(times, start, target, T, Q, 1.0)
    for one, other in zip(long, rest, strict=True):
        assert one[:3] == pytest.approx(other[:3], abs=1e-13)
        assert np.abs(one[3:]).max() < 1e-14


def test_infinite_horizon_trajectory():
    """A critically damped regulator follows e = e0 (1 + t) e^-t toward a moving target."""
    t = np.linspace(0.0, 20.0, 50)
    x, v, a = infinite_horizon_trajectory(t, (3.0, 0.5), (23.0, 0.5), 20.0, [1.0, 2.0], 1.0)
    e = -10.0 * np.exp(-t)
    assert x == pytest.approx(13.0 + 0.5 * t + e * (1 + t), abs=1e-13)
    assert v == pytest.approx(0.5 - e * t, abs=1e-13)
    assert a == pytest.approx(e * (t - 1), abs=1e-13)


def test_minimum_energy_flight_is_one_cubic():
    """With Q = 0 the flight is a cubic: one piece, without fourth and fifth powers."""
    ends = knots(9.0, [0.0, 0.0], 1.0, S)
    assert np.array_equal(ends, [0.0, 9.0])
    motion = finite_horizon_trajectory(
        ends, ([1.0, 2.0], 0.0), ([15.0, -4.0], 2.0), 9.0, [0.0, 0.0], 1.0, S
    )
    c = quintic_pieces(ends, *motion)
    assert c.shape == (1, 2, 6)
    assert np.abs(c[..., 4:] * 9.0 ** np.arange(4, 6)).max() < 1e-12


@pytest.mark.parametrize(
    ("T", "Q", "R", "S_T"),
    [
        (9.0, [4.0, 4.0], 1.0, S),
        (9.0, [4.0, 4.0], 1.0, None),
        (10.0, [1e3, 1e3], 0.01, [1e6, 1e6]),
        (10.0, [1.0, 1e4], 1.0, S),
        (1e4, [1.0, 2.0], 0.5, S),
        (0.1, [1.0, 1.0], 1.0, [1e9, 1e9]),
    ],
)
def test_knots(T, Q, R, S_T):
    """Quintics between the knots give the flight's position and velocity to 1e-10 and rounding."""
    ends = knots(T, Q, R, S_T)
    assert (ends[0], ends[-1]) == (0.0, T)
    assert len(ends) < 300
    t = (ends[:-1, None] + np.diff(ends)[:, None] * np.linspace(0.0, 0.97, 12)).ravel()
    S_T = infinite_horizon(A, B, Q, R)[1] if S_T is None else S_T
    at_ends, exact = (closed_loop_response(A, B, Q, R, S_T, T, np.eye(2), z) for z in (ends, t))
    c = quintic_pieces(ends, at_ends[0][:, 0], at_ends[0][:, 1], at_ends[1][:, 0])
    motion = PPoly(np.moveaxis(c, -1, 0)[::-1], ends)
    largest = np.abs(exact[0]).max(axis=0)
    assert np.all(np.abs(motion(t) - exact[0][:, 0]) <= 1e-10 * largest[0])
    rounding = 4e-15 * largest[0] / np.diff(ends).min()
    assert np.all(np.abs(motion(t, 1) - exact[0][:, 1]) <= 1.1e-10 * largest[1] + rounding)


def test_knots_are_dense_where_the_flight_bends():
    """Over a long horizon the knots gather at its two ends, and the calm middle needs few."""
    ends = knots(1000.0, [4.0, 4.0], 1.0, S)
    assert np.sum((ends > 100.0) & (ends < 900.0)) <= 5
    assert np.sum(ends < 10.0) > 50


def test_quintic_pieces_reproduce_a_quintic():
    """A quintic is its own piece, in every channel, and neighbours join smoothly."""
    rng = np.random.default_rng(2)
    polynomials = [np.polynomial.Polynomial(rng.normal(size=6)) for _ in range(3)]
    times = np.array([0.0, 0.3, 1.0, 2.5])
    x, v, a = (np.stack([p.deriv(k)(times) for p in polynomials], axis=-1) for k in range(3))
    c = quintic_pieces(times, x, v, a)
    assert c.shape == (3, 3, 6)
    for j, p in enumerate(polynomials):
        assert c[0, j] == pytest.approx(p.coef, abs=1e-9)
        for i in range(3):
            piece = np.polynomial.Polynomial(c[i, j])
            for k, z in enumerate((x, v, a)):
                joint = piece.deriv(k)(times[i + 1] - times[i])
                assert joint == pytest.approx(z[i + 1, j], rel=1e-12, abs=1e-12)


def test_what_is_kept_is_not_handed_out():
    """What a caller does with a result changes no later one; other weights, other results."""
    weights = ([1.0, 1.0], 1.0, S)
    first = knots(3.0, *weights)
    kept = first.copy()
    first[:] = -1.0
    assert knots(3.0, *weights) == pytest.approx(kept, abs=0)
    start = np.eye(2)
    x, u = closed_loop_response(A, B, *weights, 3.0, start, kept)
    before = x.copy()
    x[:], u[:] = 0.0, 0.0
    assert closed_loop_response(A, B, *weights, 3.0, start, kept)[0] == pytest.approx(before, abs=0)
    stiffer = closed_loop_response(A, B, [1.0, 1.0], 0.1, S, 3.0, start, kept)[0]
    assert np.abs(stiffer - before).max() > 0.1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: infinite_horizon(A, B, [0.0, 1.0], 1.0), r"Q\[0\] > 0"),
        (lambda: infinite_horizon(A, [[1.0], [0.0]], [1.0, 1.0], 1.0), "does not reach"),
        (lambda: infinite_horizon(A, B, [1.0, 1.0], 0.0), "R must be positive"),
        (lambda: infinite_horizon(A, B, [[1.0, 0.5], [0.0, 1.0]], 1.0), "symmetric"),
        (lambda: infinite_horizon(A, B, [1.0, -1.0], 1.0), "Q must not be negative"),
        (lambda: infinite_horizon(A, B, [1.0, np.inf], 1.0), "Q must be finite"),
        (lambda: infinite_horizon(A, B, [1.0], 1.0), r"Q must be \(2, 2\)"),
        (lambda: infinite_horizon(A[:1], B, [1.0, 1.0], 1.0), r"A must be \(n, n\)"),
        (lambda: infinite_horizon(A * np.nan, B, [1.0, 1.0], 1.0), "A and B must be finite"),
        (lambda: double_integrator_gains([0.0, 1.0], 1.0), r"Q\[0\] > 0"),
        (lambda: finite_horizon(A, B, [1.0, 1.0], 1.0, S, [1.0, -0.1]), "not negative"),
        (lambda: closed_loop_response(A, B, [1, 1], 1, S, 2.0, np.zeros(3), [0.0]), "2 rows"),
        (lambda: closed_loop_response(A, B, [1, 1], 1, S, 2.0, np.zeros(2), [3.0]), "T = 2.0"),
        (lambda: knots(0.0, [1.0, 1.0], 1.0, S), "T must be positive"),
        (lambda: quintic_pieces([0.0, 0.0], [1, 2], [1, 2], [1, 2]), "increasing"),
        (lambda: quintic_pieces([0.0, 1.0], [1, 2], [1, 2], [1]), "same shape"),
    ],
)
def test_errors(call, message):
    """Weights, shapes and times that mean nothing are refused, and the message says why."""
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("Q", [[1.0, 1e15], [1e-9, 1e9], [1e9, 1e-9], [1e15, 1.0]])
def test_references_take_weights_of_any_proportion(Q):
    """Knots of a reference come out where the two weights differ by 24 orders of magnitude."""
    times = knots(0.2, Q, [1.0])
    assert np.isfinite(times).all()
    assert times[-1] == pytest.approx(0.2)
