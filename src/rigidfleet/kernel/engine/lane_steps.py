"""Steps of the integrator for eight flights in the lanes of vectors: another pair, and positions from accelerations.

The pair is Bogacki and Shampine's 5(4) (Computers Math. Applic. 32 (6), 1996): eight stages, of which the last is the
first of the next step. At the same tolerance it needs a quarter fewer evaluations than Dormand and Prince's pair, and
its errors are smaller.

The derivative of a position is a velocity, which is a state, too. The stage of a position therefore follows from
accelerations alone, as in Nystroem's methods (Hairer, Norsett and Wanner, Solving ODEs I, section II.14):

    r_s = r + h c_s v + h^2 sum (A A)[s, j] a_j,   v_s = v + h sum A[s, j] a_j.

Both sums load the same numbers, and derivatives of positions are neither stored nor loaded. States are
[r (3N), v (3N), int c (m)].
"""

import numpy as np

from rigidfleet.kernel.compiler.jit import compiled, inlined
from rigidfleet.kernel.compiler.simd import spread
from rigidfleet.kernel.dopri5 import step_to_knot
from rigidfleet.kernel.engine.lane_bounds import begin_forces, bound_forces, bound_step
from rigidfleet.kernel.vectors import filled, rough_inverse

#: Number of stages; rows of `IntegratorState.K` after them.
STAGES = 8
STATE, TRIAL, ATOL = STAGES, STAGES + 1, STAGES + 2
ROWS = STAGES + 3

A = np.zeros((STAGES, STAGES))
A[1, :1] = 1 / 6
A[2, :2] = 2 / 27, 4 / 27
A[3, :3] = 183 / 1372, -162 / 343, 1053 / 1372
A[4, :4] = 68 / 297, -4 / 11, 42 / 143, 1960 / 3861
A[5, :5] = 597 / 22528, 81 / 352, 63099 / 585728, 58653 / 366080, 4617 / 20480
A[6, :6] = (
    174197 / 959244, -30942 / 79937, 8152137 / 19744439, 666106 / 1039181, -29421 / 29068,
    482048 / 414219,
)  # fmt: skip
A[7, :7] = (
    587 / 8064, 0, 4440339 / 15491840, 24353 / 124800, 387 / 44800, 2152 / 5985, 7267 / 94080
)  # fmt: skip
C = np.array([0, 1 / 6, 2 / 9, 3 / 7, 2 / 3, 3 / 4, 1, 1])
# The pair's two estimates of the error: an early one from six stages, and that of the embedded formula.
_EARLY = np.array([-3 / 1280, 0, 6561 / 632320, -343 / 20800, 243 / 12800, -1 / 95, 0, 0])
_LATE = (
    np.array(
        [
            2479 / 34992, 0, 123 / 416, 612941 / 3411720, 43 / 1440, 2272 / 6561, 79937 / 1113912,
            3293 / 556956,
        ]
    )
    - A[7]
)  # fmt: skip
#: Weights of the stages in the estimate that controls the steps.
E = 1.5 * _EARLY - 0.5 * _LATE
#: Weights of the stages halfway through a step, of fifth order, too.
HALF = np.array(
    [455 / 6144, 0, 10256301 / 35409920, 2307361 / 17971200, -387 / 102400, 73 / 5130, -7267 / 215040, 1 / 32]
)  # fmt: skip
# Weights of accelerations in positions, in their error, and halfway.
_AA, _EA, _HALF_A = A @ A, E @ A, HALF @ A


@compiled
def forget_stages(k, first):
    """As `dopri5.forget_stages`."""
    for s in range(first, STAGES):
        for q in range(k.shape[1]):
            k[s, q] = filled(0.0)


@inlined
def _sum(k, q, w, terms, last):
    """Sum of w_j k[j, q] over the first ``terms`` stages, a literal; the second has no weight if ``last``."""
    total = w[0] * k[0, q]
    if terms > 1 and not last:
        total += w[1] * k[1, q]
    if terms > 2:
        total += w[2] * k[2, q]
    if terms > 3:
        total += w[3] * k[3, q]
    if terms > 4:
        total += w[4] * k[4, q]
    if terms > 5:
        total += w[5] * k[5, q]
    if terms > 6:
        total += w[6] * k[6, q]
    return total


@inlined
def _weights(w, h):
    return h * w[0], h * w[1], h * w[2], h * w[3], h * w[4], h * w[5], h * w[6]


@inlined
def _to_stage(k, coordinates, s, h):
    """Write the state of stage s, a literal, so that no term of weight zero is left."""
    w, x, hc = _weights(A[s], h), _weights(_AA[s], h * h), h * C[s]
    last = s == STAGES - 1
    for q in range(coordinates):
        i = coordinates + q
        v = k[STATE, i]
        r = k[STATE, q] + hc * v
        if s > 1:
            r += _sum(k, i, x, s - 1, last)
        k[TRIAL, i] = v + _sum(k, i, w, s, last)
        k[TRIAL, q] = r
    for q in range(2 * coordinates, k.shape[1]):
        k[TRIAL, q] = k[STATE, q] + _sum(k, q, w, s, last)


@inlined
def _coordinates(k, p):
    """Number of coordinates of all positions, for an `UnrolledProblem` p."""
    return (k.shape[1] - p.before.shape[0]) // 2


@inlined
def advance(k, stage, _a, h, p):
    """As `dopri5.advance`."""
    coordinates = _coordinates(k, p)
    p.stage[0] = stage
    if stage == 0:
        for q in range(k.shape[1]):
            k[TRIAL, q] = k[STATE, q]
    elif stage == 1:
        _to_stage(k, coordinates, 1, h)
    elif stage == 2:
        _to_stage(k, coordinates, 2, h)
    elif stage == 3:
        _to_stage(k, coordinates, 3, h)
    elif stage == 4:
        _to_stage(k, coordinates, 4, h)
    elif stage == 5:
        _to_stage(k, coordinates, 5, h)
    elif stage == 6:
        _to_stage(k, coordinates, 6, h)
    else:
        _to_stage(k, coordinates, 7, h)


@inlined
def _scaled(k, q, e, rtol):
    """Square of an error over its tolerance."""
    size = max(abs(k[STATE, q]), abs(k[TRIAL, q]))
    e *= rough_inverse(k[ATOL, q] + rtol * size)
    return e * e


@inlined
def squared_errors(k, h, rtol, p):
    """As `dopri5.squared_errors`."""
    coordinates = _coordinates(k, p)
    squares = filled(0.0)
    v, r = _weights(E, h), _weights(_EA, h * h)
    for q in range(coordinates):
        i = coordinates + q
        squares += _scaled(k, q, _sum(k, i, r, STAGES - 1, False), rtol)
        squares += _scaled(k, i, _sum(k, i, v, STAGES - 1, True) + h * E[7] * k[7, i], rtol)
    for q in range(2 * coordinates, k.shape[1]):
        squares += _scaled(k, q, _sum(k, q, v, STAGES - 1, True) + h * E[7] * k[7, q], rtol)
    return squares


@inlined
def step_size(t, h, t_end, p):
    """As `dopri5.step_size`; the tables of an `UnrolledProblem` are named as those of a `Disturbance`."""
    return step_to_knot(t, h, t_end, p)


@inlined
def _points(k, q, coordinates, h):
    """Bernstein coefficients of a state's continuous extension.

    It is the polynomial of fourth degree with the states and derivatives at both ends, and the state halfway.
    """
    y, y_new = k[STATE, q], k[TRIAL, q]
    if q < coordinates:
        i = coordinates + q
        w = _HALF_A
        middle = y + (0.5 * h) * k[STATE, i]
        middle += (h * h) * (_sum(k, i, w, STAGES - 1, False) + w[7] * k[7, i])
        first, last = y + (0.25 * h) * k[STATE, i], y_new - (0.25 * h) * k[TRIAL, i]
    else:
        middle = y + h * (_sum(k, q, HALF, STAGES - 1, True) + HALF[7] * k[7, q])
        first, last = y + (0.25 * h) * k[0, q], y_new - (0.25 * h) * k[7, q]
    return y, first, (16.0 * middle - (y + y_new) - 4.0 * (first + last)) * (1 / 6), last, y_new


@compiled
def keep_step(t, h, p, w, state):
    """As `dopri5.keep_step`, for all flights; `lane_bounds.list_steps` hands them the steps to search."""
    k, found, rows = state.K, p.search, state.trail.clock.shape[0]
    row = (state.count[5] + state.count[4]) % rows
    found.clock[row, 0], found.clock[row, 1] = t, h
    points = found.points[row]
    for q in range(k.shape[1]):
        a, b, c, d, e = _points(k, q, _coordinates(k, p), h)
        points[0, q], points[1, q], points[2, q], points[3, q], points[4, q] = a, b, c, d, e
    for g in range(p.gauge.shape[0]):
        found.gauge[row, g] = p.gauge[g]
    bound_step(found, row)
    bound_forces(t + h, found, row, (row + rows - 1) % rows)
    state.count[4] += 1


@compiled
def keep_start(p, w, state):
    """As `dopri5.keep_start`, for each flight into its own trail."""
    for g in range(p.gauge.shape[0]):
        spread(p.gauge[g], p.search.trails[2], g)
    begin_forces(state.clock[0], p.gauge, p.search)


@compiled
def keep_samples(t, h, t_new, times, samples, p, state):
    """As `dopri5.keep_samples`, for each flight into its own samples."""
    k, count = state.K, state.count
    n = k.shape[1]
    while count[3] < times.shape[0] and times[count[3]] <= t_new:
        x = (times[count[3]] - t) / h
        z = 1.0 - x
        for q in range(n):
            a, b, c, d, e = _points(k, q, _coordinates(k, p), h)
            value = (z * z) * ((z * z) * a + (4.0 * x * z) * b + (6.0 * x * x) * c)
            value += (x * x * x) * ((4.0 * z) * d + x * e)
            spread(value, p.samples, n * count[3] + q)
        count[3] += 1


#: What differs from `dopri5.integrate`.
INSTEAD = {
    "_A": A,
    "_C": C,
    "_STAGES": STAGES,
    "STATE": STATE,
    "TRIAL": TRIAL,
    "advance": advance,
    "forget_stages": forget_stages,
    "keep_samples": keep_samples,
    "keep_start": keep_start,
    "keep_step": keep_step,
    "squared_errors": squared_errors,
    "step_size": step_size,
}
