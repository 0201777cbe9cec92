"""Linear quadratic regulators with infinite and finite horizon, and their exact closed-loop motions.

For x' = A x + B u and the paper's cost (Table 2), here with a cross weight N (n, m),

    J = 1/2 x(T)^T S x(T) + 1/2 int_0^T (x^T Q x + 2 x^T N u + u^T R u) dt

the optimal input is u = -K x, K = R^-1 (B^T P + N^T), where P(T - t) solves the Riccati equation

    dP/dtau = A^T P + P A - (P B + N) R^-1 (B^T P + N^T) + Q

back from P(0) = S. Q, R and S are symmetric matrices, or lists of their diagonals; N is the N of
python-control and Drake, the ``s`` of `scipy.linalg.solve_continuous_are`, and zero unless given.
R must be positive definite. Q, S and Q - N R^-1 N^T need not be; a cost without a bounded minimum is
refused (see Willems 1971, doi:10.1109/TAC.1971.1099831).

Each axis of a formation is a double integrator: x = (position, velocity), u the acceleration. For a
double integrator, N = (n1, n2) is equivalent to changes of Q and S: x u + v^2 and v u are the rates of
x v and v^2/2, so N has the same effect as Q22 - 2 n1, S12 + n1 and S22 + n2.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.renamed import getattr_of_earlier_names
from rigidfleet.math import riccati
from rigidfleet.typing import Floats

# States (K, n, n) and inputs (K, m, n) of a regulated system, from each state alone.
Response = tuple[Floats, Floats]

_WIDE = (
    "the Riccati equation has no stabilising solution to rounding: bring the magnitudes of"
    " the entries of Q and R closer together, or use a finite horizon"
)
# Newton's step, relative to the cost, that is not taken any more, and the greatest number of steps.
_CLOSE, _NEWTON = 1e-10, 10

# The double integrator.
_A = np.array([[0.0, 1.0], [0.0, 0.0]])
_B = np.array([[0.0], [1.0]])


def infinite_horizon(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, *, N: ArrayLike | None = None
) -> tuple[Floats, Floats]:
    """Gain K (m, n) and cost P (n, n) for T to infinity: u = -K x.

    P is the stabilising stationary solution of the Riccati equation: the least cost of all inputs that bring
    x to rest. Raises ValueError if the weights or shapes are wrong, no input brings x to rest, or none
    does so at least cost.
    """
    from scipy.linalg import solve_continuous_lyapunov

    A, B, Q, R, N = _check_system(A, B, Q, R, N)
    F, G, W = _a_g_q_without_cross_weight(A, B, Q, R, N)
    for s in np.linalg.eigvals(A):
        mode = A - s * np.eye(len(A))
        if s.real >= 0.0 and np.linalg.matrix_rank(np.hstack([mode, B])) < len(A):
            raise ValueError(
                f"the input B does not act on the motion of A with eigenvalue {s:.3g}, which does not"
                " decay by itself: no gain stabilises it"
            )
        if s.real == 0.0 and not N.any() and np.linalg.matrix_rank(np.vstack([mode, Q])) < len(A):
            raise ValueError(
                f"Q does not weigh the motion of A with eigenvalue {s:.3g}, so an infinite horizon"
                " does not control it: weigh it (for a double integrator the position,"
                " Q[0] > 0), or use a finite horizon"
            )
    # The closed loop has the stable half of the Hamiltonian's eigenvalues, which are +- each other.
    H = riccati.hamiltonian(F, G, W)
    modes = np.linalg.eigvals(H)
    slowest = np.abs(modes.real).min()
    start = np.eye(len(A))
    if not riccati.is_semidefinite(W):
        start = riccati.solution_by_subspace(H)
    elif not slowest > 1e-12 * np.abs(modes).max():
        raise ValueError(_WIDE)
    # Beyond 40 of the slowest time constants, the cost to go no longer depends on its final value.
    P = riccati.cost_to_go(F, G, W, start, np.array(40.0 / slowest))
    # Rounding of B R^-1 B^T may have taken digits: Newton's steps do without it (Kleinman).
    for _ in range(_NEWTON):
        K = riccati.solve_linear(R, B.T @ P + N.T)
        rest = A.T @ P + P @ A - K.T @ R @ K + Q
        step = solve_continuous_lyapunov((A - B @ K).T, -rest)
        if np.abs(step).max() <= _CLOSE * np.abs(P).max():
            return K, P
        P = P + step
    raise ValueError(_WIDE)


def finite_horizon(
    A: ArrayLike,
    B: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
    S: ArrayLike,
    time_to_go: ArrayLike,
    *,
    N: ArrayLike | None = None,
) -> tuple[Floats, Floats]:
    """Cost P (..., n, n) and gain K (..., m, n) at times to go T - t (...) [s]: u = -K x.

    The exponential of the Hamiltonian matrix is taken over a short step and doubled in a form that keeps
    every part positive, so that horizons of any length neither overflow nor cancel. With Q = 0 the cost is
    P = Phi^T (S^-1 + W)^-1 Phi. B R^-1 B^T is rounded: where fewer inputs than states are coupled, half of
    the digits are lost if rates of the closed loop differ by 1e4, and nearly all at 1e6. Raises ValueError
    if a time to go is negative, or so long that the cost has no minimum; the message says from which time on.
    """
    A, B, Q, R, N = _check_system(A, B, Q, R, N)
    S = _weight_matrix("S", S, len(A))
    P = riccati.cost_to_go(
        *_a_g_q_without_cross_weight(A, B, Q, R, N), S, _check_times("time_to_go", time_to_go)
    )
    return P, riccati.solve_linear(R, B.T @ P + N.T)


def closed_loop_response(
    A: ArrayLike,
    B: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
    S: ArrayLike,
    T: float,
    x0: ArrayLike,
    times: ArrayLike,
    *,
    N: ArrayLike | None = None,
) -> tuple[Floats, Floats]:
    """Optimal states x (K, n, ...) and inputs u (K, m, ...) at times (K,) [s] in [0, T] from x0 (n, ...).

    This is the solution of the Hamiltonian boundary value problem, not an integration: each time is computed
    on its own. Raises ValueError if a time lies outside [0, T], or the cost over T has no minimum.
    """
    A, x0 = np.asarray(A, dtype=float), np.asarray(x0, dtype=float)
    if x0.shape[:1] != A.shape[:1]:
        raise ValueError(f"x0 must have {len(A)} rows, one per state, not the shape {x0.shape}")
    x, u = _unit_responses(A, B, Q, R, N, S, T, times)
    return np.tensordot(x, x0, axes=1), np.tensordot(u, x0, axes=1)


def double_integrator_gains(Q: ArrayLike, R: ArrayLike) -> tuple[float, float]:
    """Infinite-horizon gains k1 [1/s^2], k2 [1/s] of a double integrator: u = -k1 x - k2 v.

    In closed form: k1 = sqrt(q1/r), k2 = sqrt(q2/r + 2 k1), for any coupling in Q. Raises ValueError
    unless q1 and q2/r + 2 k1 are positive.
    """
    _, _, Q, R, _ = _check_system(_A, _B, Q, R)
    if not Q[0, 0] > 0.0:
        raise ValueError(
            "an infinite horizon needs a weight on the position, Q[0] > 0: without one, a vehicle"
            " at rest does not move to its target; or use a finite horizon"
        )
    k1 = math.sqrt(Q[0, 0] / R[0, 0])
    square = Q[1, 1] / R[0, 0] + 2.0 * k1
    if not square > 0.0:
        raise ValueError(
            f"a weight of {Q[1, 1]:g} on the velocity rewards endless oscillation: Q[1] must be"
            f" greater than -2 sqrt(Q[0] R) = {-2.0 * k1 * R[0, 0]:g}"
        )
    return k1, math.sqrt(square)


def finite_horizon_trajectory(
    times: ArrayLike,
    start: tuple[ArrayLike, ArrayLike] | Floats,
    target: tuple[ArrayLike, ArrayLike] | Floats,
    T: float,
    Q: ArrayLike,
    R: ArrayLike,
    S: ArrayLike,
) -> tuple[Floats, Floats, Floats]:
    """Trajectory of a double integrator to a moving target: x, v, a (K, ...) at times (K,) [s] in [0, T].

    ``start`` = (x, v) at t = 0 and ``target`` = (x, v) at t = T [m, m/s], any shape, one entry
    per axis. The regulated error is e = x - (x_target + v_target (t - T)). With a final velocity,
    the regulator follows this moving target, not a fixed point.
    """
    t = _check_times("times", times)
    return trajectory_of_response(double_integrator_response(t, T, Q, R, S), t, start, target, T)


def double_integrator_response(
    times: Floats, T: float, Q: ArrayLike, R: ArrayLike, S: ArrayLike | None
) -> Response:
    """How a regulated double integrator responds at times (K,) [s] in [0, T]; S = None means an infinite horizon.

    States (K, 2, 2) and inputs (K, 1, 2) from an error of 1 in position, and in velocity; see `trajectory_of_response`.
    """
    if S is None:
        # With the cost of an infinite horizon as final weight, the Riccati equation is stationary.
        S = _double_integrator_cost(Q, R)
    return _unit_responses(_A, _B, Q, R, None, S, T, times)


def trajectory_of_response(
    response: Response,
    times: Floats,
    start: Sequence[ArrayLike] | Floats,
    target: Sequence[ArrayLike] | Floats,
    T: float,
) -> tuple[Floats, Floats, Floats]:
    """The trajectory of `finite_horizon_trajectory`, from the response at its times (K,) [s]."""
    states, inputs = response
    ends = (np.asarray(z, dtype=float) for z in (*start, *target))
    x0, v0, x1, v1 = np.broadcast_arrays(*ends)
    e0 = np.array([x0 - (x1 - T * v1), v0 - v1])
    rows, shape = e0.reshape(2, -1), x0.shape
    e = (states.reshape(-1, 2) @ rows).reshape(-1, 2, *shape)
    a = (inputs.reshape(-1, 2) @ rows).reshape(-1, *shape)
    since = (times - T).reshape(-1, *[1] * x0.ndim)
    return x1 + since * v1 + e[:, 0], v1 + e[:, 1], a


def infinite_horizon_trajectory(
    times: ArrayLike,
    start: tuple[ArrayLike, ArrayLike] | Floats,
    target: tuple[ArrayLike, ArrayLike] | Floats,
    T: float,
    Q: ArrayLike,
    R: ArrayLike,
) -> tuple[Floats, Floats, Floats]:
    """The same trajectory under the infinite-horizon regulator, with constant gains.

    The target position is that at t = T; for a target at rest, T is only the end of ``times``.
    """
    t = _check_times("times", times)
    return trajectory_of_response(double_integrator_response(t, T, Q, R, None), t, start, target, T)


def knots(
    T: float, Q: ArrayLike, R: ArrayLike, S: ArrayLike | None = None, tolerance: float = 1e-10
) -> Floats:
    """Knots (n + 1,) [s] from 0 to T between which quintics represent a trajectory of a double integrator.

    For any start, position and velocity deviate by at most ``tolerance``, relative to their greatest values.
    Pieces are halved where the trajectory bends: at the start if Q is large, at the end if S is. One piece is
    exact for Q = 0, for which the trajectory is a cubic. S = None means an infinite horizon.
    """
    if not (math.isfinite(T) and T > 0):
        raise ValueError(f"the horizon T must be positive [s], not {T}")
    if S is None:
        S = _double_integrator_cost(Q, R)
    _, _, Q, R, _ = _check_system(_A, _B, Q, R)
    fastest = riccati.fastest_rate(_A, _B @ riccati.solve_linear(R, _B.T), Q)
    inside = np.array([0.25, 0.5, 0.75])
    powers = np.arange(6)
    u = inside[:, None] ** powers
    u_dot = powers * inside[:, None] ** np.maximum(powers - 1, 0)
    # In shares of T, which are exact: knots of different regulators that should be equal have the same bits.
    left, share = np.zeros(1), 1.0
    result: list[Floats] = [np.array([0.0, 1.0])]
    largest = np.zeros((2, 2))
    while left.size:
        t = T * (left[:, None] + share * np.array([0.0, *inside, 1.0]))
        width = T * share
        # Two starts span all others: position 1 with velocity 0, and position 0 with velocity 1.
        x, a = closed_loop_response(_A, _B, Q, R, S, T, np.eye(2), t.ravel())
        x, a = x.reshape(*t.shape, 2, 2), a.reshape(*t.shape, 2)
        largest = np.maximum(largest, np.abs(x).max(axis=(0, 1)))
        # In units of the piece's width, so that one set of powers serves all pieces.
        ends = [z[:, [0, -1]] for z in (x[:, :, 0], width * x[:, :, 1], width**2 * a)]
        c = _quintics_between_end_states(np.ones(len(left)), *(z.swapaxes(0, 1) for z in ends))
        quintic = np.stack([c @ u.T, c @ u_dot.T / width], axis=2)
        deviation = quintic - x[:, 1:-1].transpose(0, 3, 2, 1)
        # Rounding of the positions enters the quintic's velocity divided by the width.
        rounding = 16 * np.finfo(float).eps * largest[0] * np.array([[1.0], [1.0 / width]])
        allowed = tolerance * largest + rounding
        bad = np.any(np.abs(deviation) > allowed.T[..., None], axis=(1, 2, 3))
        bad &= width * fastest > 1 / 64  # narrower pieces contain only rounding
        result.append(left[~bad] + share)
        share *= 0.5
        left = np.concatenate([left[bad], left[bad] + share])
    every: Floats = np.unique(np.concatenate(result))
    return T * every


def quintic_pieces(times: ArrayLike, x: ArrayLike, v: ArrayLike, a: ArrayLike) -> Floats:
    """Quintics that meet x, v, a (n + 1, ...) at the times (n + 1,) [s]: coefficients (n, ..., 6).

    x(t) = sum_p coefficients[i, ..., p] (t - times[i])^p for times[i] <= t <= times[i + 1], with two
    continuous derivatives. Raises ValueError unless the times increase.
    """
    t = np.asarray(times, dtype=float)
    x, v, a = (np.asarray(z, dtype=float) for z in (x, v, a))
    if t.ndim != 1 or len(t) < 2 or not ((h := t[1:] - t[:-1]) > 0).all():
        raise ValueError("times must be at least two increasing times [s]")
    if not x.shape == v.shape == a.shape or x.shape[:1] != t.shape:
        raise ValueError(
            f"x, v and a must have one row for each of the {len(t)} times and the same shape,"
            f" not {x.shape}, {v.shape} and {a.shape}"
        )
    return _quintics_between_end_states(h, (x[:-1], x[1:]), (v[:-1], v[1:]), (a[:-1], a[1:]))


def _quintics_between_end_states(h: Floats, x: ArrayLike, v: ArrayLike, a: ArrayLike) -> Floats:
    """Coefficients (n, ..., 6) from both ends' (2, n, ...) values, widths h (n,)."""
    (x0, x1), (v0, v1), (a0, a1) = (np.asarray(z) for z in (x, v, a))
    h = h.reshape(-1, *[1] * (x0.ndim - 1))
    # Errors at the right end of a parabola from the left end.
    x = (x1 - x0 - h * (v0 + 0.5 * h * a0)) / h**3
    v = (v1 - v0 - h * a0) / h**2
    a = (a1 - a0) / h
    c = [x0, v0, 0.5 * a0, 10 * x - 4 * v + 0.5 * a, (-15 * x + 7 * v - a) / h]
    return np.stack([*c, (6 * x - 3 * v + 0.5 * a) / h**2], axis=-1)


def _unit_responses(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike | None, S: ArrayLike, T: float,
    times: ArrayLike,
) -> Response:  # fmt: skip
    """States (K, n, n) and inputs (K, m, n) from each state alone."""
    A, B, Q, R, N = _check_system(A, B, Q, R, N)
    S = _weight_matrix("S", S, len(A))
    t, T = _check_times("times", times), float(_check_times("T", T))
    if t.ndim != 1 or np.any(t > T * (1.0 + 1e-12)):
        raise ValueError(f"times must be a list of times between 0 and T = {T} s")
    P, x = riccati.costs_and_states(*_a_g_q_without_cross_weight(A, B, Q, R, N), S, t, T)
    return x, -riccati.solve_linear(R, (B.T @ P + N.T) @ x)


def _double_integrator_cost(Q: ArrayLike, R: ArrayLike) -> Floats:
    """P (2, 2) of the double integrator's infinite horizon, as `infinite_horizon` has it.

    Its Riccati equation has a closed-form solution, which is exact for any weights.
    """
    _, _, weights, effort, _ = _check_system(_A, _B, Q, R)
    (a, b), (_, d), r = *weights.tolist(), float(effort[0, 0])
    double_integrator_gains(Q, R)  # raises an error if the weights are invalid
    cross = math.sqrt(a) * math.sqrt(r)
    last = math.sqrt(r) * math.sqrt(d + 2.0 * cross)
    return np.array([[cross * last / r - b, cross], [cross, last]])


def _a_g_q_without_cross_weight(
    A: Floats, B: Floats, Q: Floats, R: Floats, N: Floats
) -> tuple[Floats, Floats, Floats]:
    """The same problem without N, for the input u + R^-1 N^T x: its A, B R^-1 B^T and Q."""
    G = B @ riccati.solve_linear(R, B.T)
    if not N.any():
        return A, G, Q
    rest = Q - N @ riccati.solve_linear(R, N.T)
    value, vector = np.linalg.eigh(0.5 * (rest + rest.T))
    if -riccati.ROUNDING * np.abs(Q).max() <= value[0] < 0.0:  # a zero with rounding error
        value = value.clip(min=0.0)
    return A - B @ riccati.solve_linear(R, N.T), G, (vector * value) @ vector.T


def _check_system(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike | None = None
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """A (n, n), B (n, m), Q (n, n), R (m, m) > 0 and N (n, m), checked."""
    A, B = np.asarray(A, dtype=float), np.asarray(B, dtype=float)
    if A.ndim != 2 or A.shape[0] != A.shape[1] or B.ndim != 2 or len(B) != len(A):
        raise ValueError(f"A must be (n, n) and B (n, m), not {A.shape} and {B.shape}")
    N = np.zeros(B.shape) if N is None else np.asarray(N, dtype=float)
    if N.shape == (len(A),) and B.shape[1] == 1:
        N = N[:, None]
    if N.shape != B.shape:
        raise ValueError(f"N must be {B.shape}, as B is, not {N.shape}")
    if not all(np.all(np.isfinite(M)) for M in (A, B, N)):
        raise ValueError("A, B and N must be finite")
    R = _weight_matrix("R", R, B.shape[1])
    if np.linalg.eigvalsh(R)[0] <= 0.0:
        raise ValueError("R must be positive definite: every input must have a cost")
    return A, B, _weight_matrix("Q", Q, len(A)), R, N


def _weight_matrix(name: str, value: ArrayLike, n: int) -> Floats:
    """A symmetric weight (n, n), from it or its diagonal."""
    weight = np.asarray(value, dtype=float)
    if weight.shape == (n,) or (n == 1 and weight.shape == ()):
        weight = np.diag(weight.reshape(n))
    if weight.shape != (n, n):
        raise ValueError(f"{name} must be ({n}, {n}) or its diagonal ({n},), not {weight.shape}")
    if not np.all(np.isfinite(weight)):
        raise ValueError(f"{name} must be finite; use a very large weight to enforce a value")
    if np.abs(weight - weight.T).max() > 1e-12 * np.abs(weight).max():
        raise ValueError(
            f"{name} must be symmetric; use ({name} + {name}^T)/2, which has the same cost"
        )
    return weight


def _check_times(name: str, value: ArrayLike) -> Floats:
    t = np.asarray(value, dtype=float)
    if not np.all(np.isfinite(t)) or np.any(t < 0.0):
        raise ValueError(f"{name} must be finite and not negative [s]")
    return t


__getattr__ = getattr_of_earlier_names(__name__, led="trajectory_of_response")
