import json
from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import PPoly
from scipy.linalg import expm, solve_continuous_are
from scipy.optimize import brentq

from rigidfleet.math.attitude import (
    dcm_from_rotation_vector,
    rotation_vector_from_dcm,
    rotation_vector_rate,
)
from rigidfleet.math.lqr import (
    closed_loop_response,
    double_integrator_gains,
    finite_horizon,
    finite_horizon_trajectory,
    infinite_horizon,
    infinite_horizon_trajectory,
    knots,
    quintic_pieces,
)
from rigidfleet.mission.schema import Lqr, Regulator, Tracking
from rigidfleet.planning.body_trajectories import regulated_motion
from rigidfleet.planning.reference import Pose

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


@pytest.mark.parametrize("seed", range(10))
def test_infinite_horizon_of_rates_far_apart(seed):
    """Where rates of the closed loop differ by 1e6 and one input moves six states, the cost is still SciPy's."""
    rng = np.random.default_rng(seed)
    system, C = (rng.normal(size=(6, 6)), rng.normal(size=(6, 1))), rng.normal(size=(6, 6))
    weights = 1e5 * C @ C.T, np.array([[1e-5]])
    K, P = infinite_horizon(*system, *weights)
    expected = solve_continuous_are(*system, *weights)
    assert pytest.approx(expected, rel=0, abs=2e-9 * np.abs(expected).max()) == P
    assert np.linalg.eigvals(system[0] - system[1] @ K).real.max() < 0


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


def test_knots_of_two_regulators_are_equal_or_apart():
    """They lie at exact shares of the horizon: those of both together leave no piece that is only rounding."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        T = rng.uniform(0.1, 50.0)
        both = [
            knots(T, rng.uniform(0.1, 5.0, 2), 1.0, 10 ** rng.uniform(1, 4, 2)) for _ in range(2)
        ]
        assert all(ends[0] == 0.0 and ends[-1] == T for ends in both)
        assert np.diff(np.unique(np.concatenate(both))).min() > 1e-6 * T


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


# -- cross weights, and weights that are not positive

# The case of Drake's finite_horizon_linear_quadratic_regulator_test: Q - N R^-1 N^T is indefinite.
DRAKE = {"Q": np.eye(2), "R": np.array([[4.12]]), "N": np.array([[2.2], [1.3]])}


def indefinite_system(seed, n=4, m=2, more=0.0):
    """A, B, Q, R, N of which Q and Q - N R^-1 N^T have negative eigenvalues; ``more`` is added to Q."""
    rng = np.random.default_rng(seed)
    C = rng.normal(size=(n, n))
    Q, R = C + C.T + more * np.eye(n), np.diag(rng.uniform(0.5, 2, m))
    return rng.normal(size=(n, n)), rng.normal(size=(n, m)), Q, R, rng.normal(size=(n, m))


def riccati(t, P, A, B, Q, R, N):
    """dP/dtau, flat, as it stands in textbooks."""
    P = P.reshape(A.shape)
    return (A.T @ P + P @ A - (P @ B + N) @ np.linalg.solve(R, B.T @ P + N.T) + Q).ravel()


def escape(S, A, B, Q, R, N, most):
    """When the Riccati equation from S first grows beyond all bounds: its linear form turns singular."""
    F = A - B @ np.linalg.solve(R, N.T)
    W = Q - N @ np.linalg.solve(R, N.T)
    H = np.block([[F, -B @ np.linalg.solve(R, B.T)], [-W, -F.T]])

    start = np.vstack([np.eye(len(A)), S])
    step = most / 4000
    once, state = expm(-H * step), start
    for k in range(4000):
        if np.linalg.det((state := once @ state)[: len(A)]) <= 0.0:
            return brentq(
                lambda t: np.linalg.det((expm(-H * t) @ start)[: len(A)]),
                k * step, (k + 1) * step, xtol=1e-14, rtol=1e-14,
            )  # fmt: skip
    return None


def told(error):
    """The time that an error message names [s]."""
    return float(str(error.value).split("time to go of ")[1].split(" s")[0])


def test_drakes_case_of_a_cross_weight():
    """With N = (2.2, 1.3), Drake's claims hold: 40 s from zero lead to its infinite horizon, which stays."""
    K, P = infinite_horizon(A, B, **DRAKE)
    # By hand: (p12 + n1)^2 = r q1, (p22 + n2)^2 = r (q2 + 2 p12), p11 = (p12 + n1)(p22 + n2)/r.
    k1 = np.sqrt(4.12)
    k2 = np.sqrt(4.12 * (1 + 2 * (k1 - 2.2)))
    assert K[0] == pytest.approx(np.array([k1, k2]) / 4.12, rel=1e-14)
    assert (
        pytest.approx(np.array([[k1 * k2 / 4.12, k1 - 2.2], [k1 - 2.2, k2 - 1.3]]), rel=1e-13) == P
    )
    nonnegative_number_field, gain = finite_horizon(
        A, B, S=np.zeros((2, 2)), time_to_go=40.0, **DRAKE
    )
    assert pytest.approx(P, abs=1e-5) == nonnegative_number_field
    assert pytest.approx(K, abs=1e-5) == gain
    stays, gain = finite_horizon(A, B, S=P, time_to_go=2.0, **DRAKE)
    assert pytest.approx(P, abs=1e-12) == stays
    assert pytest.approx(K, abs=1e-12) == gain


def test_two_inputs_with_a_cross_weight():
    """The infinite horizon of Drake's affine case, two inputs and a full N, is python-control's."""
    system = (
        np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[5.0, 6.0], [7.0, 8.0]]),
        np.array([[0.8, 0.7], [0.7, 0.9]]), np.array([[1.4, 0.2], [0.2, 1.2]]),
    )  # fmt: skip
    N = np.array([[0.1, 0.2], [0.3, 0.4]])
    K_control, P_control, _ = control.lqr(*system, N)
    K, P = infinite_horizon(*system, N=N)
    assert pytest.approx(K_control, rel=1e-9) == K
    assert pytest.approx(P_control, rel=1e-9) == P
    later = finite_horizon(*system, P, 70.0, N=N)[0]
    assert pytest.approx(P, rel=1e-12) == later


def test_infinite_horizon_of_any_weights():
    """Of 60 random Q and N of either sign, those with a stabilising solution have SciPy's; others are refused."""
    solved = 0
    for seed in range(60):
        system = A4, B4, Q4, R4, N4 = indefinite_system(seed, more=2.0)
        try:
            expected = solve_continuous_are(A4, B4, Q4, R4, s=N4)
            K = np.linalg.solve(R4, B4.T @ expected + N4.T)
            # It also returns what solves nothing.
            exists = np.abs(riccati(0.0, expected, *system)).max() < 1e-8
            exists &= np.linalg.eigvals(A4 - B4 @ K).real.max() < 0.0
        except np.linalg.LinAlgError:
            exists = False
        if not exists:
            with pytest.raises(ValueError, match="imaginary axis"):
                infinite_horizon(A4, B4, Q4, R4, N=N4)
            continue
        solved += 1
        gain, P = infinite_horizon(A4, B4, Q4, R4, N=N4)
        assert pytest.approx(expected, rel=1e-8, abs=1e-8) == P
        assert pytest.approx(K, rel=1e-8, abs=1e-8) == gain
    assert 20 <= solved <= 40


def test_substitution_is_the_cross_weight():
    """In the input u + R^-1 N^T x there is no N, Q is indefinite, and cost and flight are the same."""
    R, N = DRAKE["R"], DRAKE["N"]
    F, W = A - B @ N.T / R, DRAKE["Q"] - N @ N.T / R
    assert np.linalg.eigvalsh(W)[0] < -0.1
    K, P = infinite_horizon(A, B, **DRAKE)
    K_v, P_v = infinite_horizon(F, B, W, R)
    assert pytest.approx(P, rel=1e-12) == P_v
    assert pytest.approx(K - N.T / R, rel=1e-12) == K_v
    x0, t = np.array([1.0, -0.5]), np.linspace(0.0, 3.0, 7)
    x, u = closed_loop_response(A, B, **DRAKE, S=[5.0, 1.0], T=3.0, x0=x0, times=t)
    x_v, v = closed_loop_response(F, B, W, R, [5.0, 1.0], 3.0, x0, t)
    assert pytest.approx(x, abs=1e-13) == x_v
    assert pytest.approx(v - x @ N / R, abs=1e-12) == u


@settings(max_examples=30, deadline=None)
@given(
    st.floats(-2.0, 2.0), st.floats(-3.0, 3.0), st.floats(0.1, 10.0), st.floats(0.1, 10.0),
    st.floats(0.1, 4.0),
)  # fmt: skip
def test_of_a_double_integrator_a_cross_weight_is_another_weight(n1, n2, r, q1, tau):
    """N = (n1, n2) is Q22 - 2 n1, S12 + n1 and S22 + n2: x a and v a are rates, but for -v^2."""
    q2 = 2.0 * abs(n1) + 0.5
    P, K = finite_horizon(A, B, [q1, q2], r, [9.0, 9.0], tau, N=[n1, n2])
    end = np.array([[0.0, n1], [n1, n2]])
    P_other, K_other = finite_horizon(A, B, [q1, q2 - 2.0 * n1], r, np.diag([9.0, 9.0]) + end, tau)
    size = np.abs(P_other).max()
    assert pytest.approx(P_other - end, abs=1e-11 * size) == P
    assert pytest.approx(K_other, abs=1e-11 * size / r) == K


@pytest.mark.parametrize("seed", range(6))
def test_any_weights_follow_the_riccati_equation(seed):
    """As long as the cost has a minimum, P is what integrating the Riccati equation gives."""
    system = indefinite_system(seed)
    S4 = np.diag([3.0, 0.0, -0.5, 1.0])
    T = 0.9 * (escape(S4, *system, 4.0) or 4.0)
    times = np.linspace(0.0, T, 5)
    expected = solve_ivp(
        riccati, (0.0, T), S4.ravel(), "DOP853", times, args=system, rtol=1e-12, atol=1e-12
    ).y.T
    P, _ = finite_horizon(*system[:4], S4, times, N=system[4])
    assert pytest.approx(expected.reshape(P.shape), rel=1e-8, abs=1e-8) == P


@pytest.mark.parametrize("seed", range(12))
def test_a_cost_without_minimum_is_refused_with_its_time(seed):
    """The Riccati equation's escape is told to 1e-8; just before it all is well, and from it on all is refused."""
    system, S4 = indefinite_system(seed), np.diag([1.0, 0.0, 0.0, 2.0])
    expected = escape(S4, *system, 6.0)
    if expected is None:
        assert np.isfinite(finite_horizon(*system[:4], S4, [3.0, 6.0], N=system[4])[0]).all()
        return
    P, _ = finite_horizon(*system[:4], S4, expected * (1 - 1e-6), N=system[4])
    assert np.linalg.eigvalsh(P)[0] < -1e4
    for beyond in (expected * (1 + 1e-6), 2 * expected, 1e3 * expected):
        with pytest.raises(ValueError, match="no minimum") as error:
            finite_horizon(*system[:4], S4, [0.1 * expected, beyond], N=system[4])
        assert told(error) == pytest.approx(expected, rel=1e-8)
        with pytest.raises(ValueError, match="no minimum"):
            closed_loop_response(*system[:4], S4, beyond, np.ones(4), [0.0], N=system[4])


@pytest.mark.parametrize("seed", [3, 14, 77])
@pytest.mark.parametrize("S1", [0.0, 5.0])
def test_escapes_in_closed_form(seed, S1):
    """x' = a x + u with q < -a^2 escapes when its tangent does, however far beyond the horizon reaches."""
    a, q = np.random.default_rng(seed).uniform([0.1, -20.0], [0.9, -1.0])
    # P = a - w tan(w tau + phase), of the angular velocity w.
    w = np.sqrt(-q - a * a)
    expected = (np.pi / 2 - np.arctan((a - S1) / w)) / w
    for T in (1.001 * expected, 1e6):
        with pytest.raises(ValueError, match="no minimum") as error:
            finite_horizon([[a]], [[1.0]], [q], [1.0], [S1], T)
        assert told(error) == pytest.approx(expected, rel=1e-9)
    P, _ = finite_horizon([[a]], [[1.0]], [q], [1.0], [S1], 0.9 * expected)
    phase = np.arctan((a - S1) / w)
    assert P[0, 0] == pytest.approx(a - w * np.tan(0.9 * w * expected + phase), rel=1e-10)


def test_the_last_weight_with_an_infinite_horizon():
    """Q22 = -2 sqrt(Q11 R) puts a double eigenvalue on the axis, and is refused; a millionth more is not."""
    with pytest.raises(ValueError, match="eigenvalue 1i on the imaginary axis"):
        infinite_horizon(A, B, [1.0, -2.0], 1.0)
    K, _ = infinite_horizon(A, B, [1.0, -2.0 + 1e-6], 1.0)
    assert K[0] == pytest.approx([1.0, 1e-3], rel=1e-6)
    assert double_integrator_gains([1.0, -2.0 + 1e-6], 1.0) == pytest.approx(tuple(K[0]), rel=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_no_cost_that_is_positive_is_refused(seed):
    """Where [[Q, N], [N^T, R]] is positive semi-definite, even of rank one, horizons of any length are solved."""
    rng = np.random.default_rng(seed)
    C = rng.normal(size=(1, 3))
    Q, N, R = C[:, :2].T @ C[:, :2], C[:, :2].T @ C[:, 2:], C[:, 2:].T @ C[:, 2:]
    P, _ = finite_horizon(A, B, Q, R, [1.0, 0.0], [1e2, 10.0, 0.0, 1.0], N=N)
    assert np.linalg.eigvalsh(P).min() > -1e-12 * np.abs(P).max()

    def rate(_, p):
        P = p.reshape(2, 2)
        K = np.linalg.solve(R, B.T @ P + N.T)
        return (A.T @ P + P @ A - K.T @ R @ K + Q).ravel()

    expected = solve_ivp(rate, (0, 10), [1.0, 0, 0, 0], "Radau", [0, 1, 10], rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(P[[2, 3, 1]].reshape(3, 4), expected.y.T, rtol=1e-4, atol=1e-6)

    def law(t, x):
        K = finite_horizon(A, B, Q, R, [1.0, 0.0], 5.0 - t, N=N)[1]
        return (A - B @ K) @ x

    x, u = closed_loop_response(A, B, Q, R, [1.0, 0.0], 5.0, [1.0, -2.0], [5.0, 0.0, 2.0], N=N)
    flown = solve_ivp(law, (0, 5), [1.0, -2.0], "DOP853", [0, 2, 5], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(x[[1, 2, 0]], flown.y.T, rtol=1e-6, atol=1e-6)
    K = finite_horizon(A, B, Q, R, [1.0, 0.0], 3.0, N=N)[1]
    np.testing.assert_allclose(u[2], -K @ x[2], rtol=1e-9, atol=1e-9)


def test_motions_that_no_weight_sees_are_brought_to_rest():
    """Of x' = x + u, at no cost of x, P is 2 and x' = -x then; a motion that is 10^8 times slower is too slow."""
    modes, inputs = np.diag([1.0, -1e-3]), [[1.0], [1.0]]
    K, P = infinite_horizon(modes, inputs, [0.0, 0.0], 1.0)
    assert pytest.approx([2.0, 0.0], abs=1e-9) == K[0]
    np.testing.assert_allclose(P, np.diag([2.0, 0.0]), atol=1e-9)
    with pytest.raises(ValueError, match="a motion grows that no weight sees"):
        infinite_horizon(np.diag([1.0, -1e-8]), inputs, [0.0, 0.0], 1.0)
    # One that is weighed needs no steps, however much slower another one is.
    stiff = np.diag([1e2, -1e-4])
    K, P = infinite_horizon(stiff, inputs, [1.0, 1.0], 1.0)
    residual = stiff.T @ P + P @ stiff - K.T @ K + np.eye(2)
    assert np.abs(residual).max() < 1e-9 * np.abs(P).max() * 1e2


@pytest.mark.parametrize("seed", range(3))
def test_cost_with_a_cross_weight_is_what_the_motion_costs(seed):
    """x0^T P x0 / 2 is the cost of the optimal motion, its cross term included, by Gauss-Legendre quadrature."""
    A4, B4, Q4, R4, N4 = system = indefinite_system(seed)
    S4, x0 = np.diag([1.0, 2.0, 30.0, 0.0]), np.array([1.0, -2.0, 0.5, 3.0])
    T = min(1.5, 0.8 * (escape(S4, *system, 4.0) or 4.0))
    node, share = np.polynomial.legendre.leggauss(60)
    times = np.append(0.5 * T * (node + 1.0), T)
    x, u = closed_loop_response(A4, B4, Q4, R4, S4, T, x0, times, N=N4)
    running = np.einsum("ki,ij,kj->k", x, Q4, x) + np.einsum("ki,ij,kj->k", u, R4, u)
    running += 2.0 * np.einsum("ki,ij,kj->k", x, N4, u)
    cost = 0.5 * (x[-1] @ S4 @ x[-1] + 0.5 * T * share @ running[:-1])
    P, _ = finite_horizon(A4, B4, Q4, R4, S4, T, N=N4)
    assert cost == pytest.approx(0.5 * x0 @ P @ x0, rel=1e-9)
    flown = solve_ivp(
        lambda t, y: A4 @ y - B4 @ finite_horizon(A4, B4, Q4, R4, S4, T - t, N=N4)[1] @ y,
        (0.0, T), x0, "DOP853", rtol=1e-10, atol=1e-10,
    ).y[:, -1]  # fmt: skip
    assert x[-1] == pytest.approx(flown, abs=1e-7)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: infinite_horizon(A, B, [0.0, 1.0], 1.0), r"Q\[0\] > 0"),
        (lambda: infinite_horizon(A, [[1.0], [0.0]], [1.0, 1.0], 1.0), "does not act on"),
        (lambda: infinite_horizon(A, B, [1.0, 1.0], 0.0), "R must be positive"),
        (lambda: infinite_horizon(A, B, [[1.0, 0.5], [0.0, 1.0]], 1.0), "symmetric"),
        (lambda: infinite_horizon(A, B, [1.0, -3.0], 1.0), "no minimum .* oscillation at"),
        (lambda: infinite_horizon(A, B, [1.0, 1.0], 1.0, N=[[1.0, 2.0]]), r"N must be \(2, 1\)"),
        (lambda: infinite_horizon(A, B, [1.0, 1.0], 1.0, N=[1.0, np.nan]), "N must be finite"),
        (lambda: double_integrator_gains([4.0, -4.0], 1.0), r"Q\[1\] must be greater than .* -4$"),
        (lambda: infinite_horizon(A, B, [1.0, np.inf], 1.0), "Q must be finite"),
        (lambda: infinite_horizon(A, B, [1.0], 1.0), r"Q must be \(2, 2\)"),
        (lambda: infinite_horizon(A[:1], B, [1.0, 1.0], 1.0), r"A must be \(n, n\)"),
        (lambda: infinite_horizon(A * np.nan, B, [1.0, 1.0], 1.0), "A, B and N must be finite"),
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


def test_planned_motions_are_those_of_the_regulators():
    """CM and rotation vector of a regulated phase are the trajectories of both regulators, then of the tracking gains.

    The plan has one linear map from its ends to its pieces; here each axis is regulated by itself.
    """
    rng = np.random.default_rng(5)
    t0, arrival, t_end = 3.0, 9.0, 14.0
    turn = Regulator(horizon="infinite", Q=(0.7, 0.2), R=1.0, S=(0.0, 0.0))
    laws = Lqr(horizon="finite", Q=(2.0, 1.0), R=1.5, S=(50.0, 9.0), attitude=turn)
    tracking = Tracking(Q=(4.0, 4.0), R=1.0)
    (r, v, omega), (r1, v1, omega1) = rng.normal(0.0, 5.0, (2, 3, 3))
    T, T1 = (dcm_from_rotation_vector(x) for x in rng.normal(0.0, 0.8, (2, 3)))
    phi = rotation_vector_from_dcm(T @ T1.T)
    ends = Pose(r, v, T, omega), Pose(r1, v1, T1, omega1)
    motion = regulated_motion(laws, tracking, *ends, t0, arrival, t_end)
    assert motion.knots[[0, -1]] == pytest.approx([t0, t_end])
    np.testing.assert_array_equal(motion.T1, T1)

    t = np.linspace(t0, t_end, 201)
    k = np.clip(np.searchsorted(motion.knots, t, side="right") - 1, 0, len(motion.coefficients) - 1)
    u = (t - motion.knots[k])[:, None] ** np.arange(6)
    found = np.einsum("kap,kp->ka", motion.coefficients[k], u)
    slope = np.einsum("kap,kp->ka", motion.coefficients[k][..., 1:], u[:, :-1] * np.arange(1, 6))
    way, length, rest = t <= arrival, arrival - t0, t_end - arrival
    begins = (r, v), (phi, rotation_vector_rate(phi, omega))
    goals = (r1, v1), (np.zeros(3), omega1)
    for axes, law, begin, goal in zip(
        (slice(3), slice(3, 6)), (laws, turn), begins, goals, strict=True
    ):
        given = [*(t[way] - t0), length], begin, goal, length, law.Q, law.R
        x, x_dot, _ = (
            finite_horizon_trajectory(*given, law.S)
            if law.horizon == "finite"
            else infinite_horizon_trajectory(*given)
        )
        np.testing.assert_allclose(found[way, axes], x[:-1], rtol=0, atol=1e-8)
        np.testing.assert_allclose(slope[way, axes], x_dot[:-1], rtol=0, atol=1e-8)
        onward = goal[0] + rest * goal[1], goal[1]
        x, x_dot, _ = infinite_horizon_trajectory(
            t[~way] - arrival, (x[-1], x_dot[-1]), onward, rest, tracking.Q, tracking.R
        )
        np.testing.assert_allclose(found[~way, axes], x, rtol=0, atol=1e-8)
        np.testing.assert_allclose(slope[~way, axes], x_dot, rtol=0, atol=1e-8)
