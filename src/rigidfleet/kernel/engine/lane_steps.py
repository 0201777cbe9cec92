"""Steps of the integrator for eight flights in the lanes of vectors: another pair, and positions from accelerations.

The pair is Tsitouras and Famelis' 6(5) (ICNAAM 2006; its coefficients to more digits are those of P. Stone): nine
stages, of which the last is the first of the next step. At the same tolerance it needs a third fewer evaluations than
Dormand and Prince's pair, and its errors are smaller. A step from one knot of gusts or noise to the next is as accurate
as two steps of theirs.

The derivative of a position is a velocity, which is a state, too. The stage of a position therefore follows from
accelerations alone, as in Nystroem's methods (Hairer, Norsett and Wanner, Solving ODEs I, section II.14):

    r_s = r + h c_s v + h^2 sum (A A)[s, j] a_j,   v_s = v + h sum A[s, j] a_j.

Both sums load the same numbers, and derivatives of positions are neither stored nor loaded. States are
[r (3N), v (3N), int c (m)].

A step that is kept becomes two rows of the trail, its halves. Their polynomials of fourth degree are as accurate as the
step, and forces are known at its middle, too. This takes one more evaluation.
"""

import numpy as np

from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.compiler.simd import scatter_lanes
from rigidfleet.kernel.dopri5 import step_to_knot
from rigidfleet.kernel.dynamics import closed_loop
from rigidfleet.kernel.records import EVALUATIONS, FIRST_ROW, SAMPLES, TRAILED
from rigidfleet.kernel.vectors import fill_lanes, rough_inverse

#: Number of stages; rows of `IntegratorState.K` after them: the last ones are the state halfway, and its derivative.
STAGES = 9
STATE, TRIAL, ATOL, MIDDLE, SLOPE = range(STAGES, STAGES + 5)
ROWS = STAGES + 5
#: Arrays of each flight's trail, whose addresses are rows of `UnrolledProblem.trails`.
TRAIL = "clock", "points", "gauge", "start"
CLOCK, POINTS, GAUGE, START = range(len(TRAIL))

# Only the third stage needs the second one, and neither the end nor the error needs the third.
A = np.zeros((STAGES, STAGES))
A[1, :1] = 17 / 183
A[2, :2] = 0.032071588978166386, 0.11250672427484566
A[3, :3] = 9 / 166, 0, 27 / 166
A[4, :4] = (
    0.656598126617284, 0, -2.4972770465185183, 2.4086789199012344,
)  # fmt: skip
A[5, :5] = (
    -1.7212338830272755, 0, 7.223107511920211, -5.4959191727393515, 0.7059099506260772,
)  # fmt: skip
A[6, :6] = (
    4.128671897161615, 0, -16.91402530428944, 14.328981321740587, -1.553355090373531, 1.004727175760767,
)  # fmt: skip
A[7, :7] = (
    4.468607842844296, 0, -18.34544186942965, 15.52377072335432, -1.7228800213316942, 1.0815157174021452,
    -0.005572392839416983,
)  # fmt: skip
A[8, :8] = (
    0.06423090937210832, 0, 0, 0.3328618246994211, 0.2678592291657781, 0.17986389967093872, 1.5107578480576216,
    -1.3555737109658679,
)  # fmt: skip
C = np.array([0, 17 / 183, 12 / 83, 18 / 83, 71 / 125, 42 / 59, 199 / 200, 1, 1])
_EMBEDDED = np.array(
    [
        0.06229809541712388, 0, 0, 0.34020351963578366, 0.235997541364109, 0.22064027639604253, 1.1504413395286892,
        -1.0029141056750814, -1 / 150,
    ]
)  # fmt: skip
#: Weights of the stages in the estimate that controls the steps. Any multiple of the difference to the embedded formula
#: belongs to another embedded formula of fifth order. With a tenth, the medians of errors are at most those of Dormand
#: and Prince's pair at the same tolerance.
E = 0.1 * (A[-1] - _EMBEDDED)
#: Weights of the stages halfway through a step: of fifth order, with the least errors of sixth order.
HALF = np.array(
    [
        0.06110646035058691, 0, 0, 0.3430452633989088, 0.10018189953640919, 0.01796431043510746, -0.6422206531527976,
        0.5885881169514897, 0.03133460248029588,
    ]
)  # fmt: skip
# Weights of accelerations in positions, in their error, and halfway.
_AA, _EA, _HALF_A = A @ A, E @ A, HALF @ A


@jit_inline
def _weighted_stage_sum(K, q, w, first, end):
    """Sum of w_j K[j, q] over stage 0 and the stages from ``first`` to before ``end``, literals."""
    total = w[0] * K[0, q]
    for s in range(first, end):
        total += w[s] * K[s, q]
    return total


@jit_inline
def _weights(w, h):
    return h * w[0], h * w[1], h * w[2], h * w[3], h * w[4], h * w[5], h * w[6], h * w[7], h * w[8]


@jit_inline
def _write_stage(K, row, coordinates, w, x, hc, s):
    """Write into a row the state that the first s stages, a literal, lead to, so that no term of weight zero is left.

    ``w`` and ``x`` are the `_weights` of accelerations in velocities and in positions, ``hc`` the time to it [s].
    """
    of_rates, of_positions = 1 if s < 3 else 2, 1
    if s >= STAGES - 1:  # the end and the middle
        of_rates = of_positions = 3
    for q in range(coordinates):
        i = coordinates + q
        v = K[STATE, i]
        r = K[STATE, q] + hc * v
        if s > 1:
            r += _weighted_stage_sum(K, i, x, of_positions, s - 1)
        K[row, i] = v + _weighted_stage_sum(K, i, w, of_rates, s)
        K[row, q] = r
    for q in range(2 * coordinates, K.shape[1]):
        K[row, q] = K[STATE, q] + _weighted_stage_sum(K, q, w, of_rates, s)


@jit_inline
def _write_trial_of_stage(K, coordinates, s, h):
    """Write the state of stage s, a literal."""
    _write_stage(K, TRIAL, coordinates, _weights(A[s], h), _weights(_AA[s], h * h), h * C[s], s)


@jit_inline
def _count_coordinates(K, p):
    """Number of coordinates of all positions, for an `UnrolledProblem` p."""
    return (K.shape[1] - p.before.shape[0]) // 2


@jit_inline
def write_stage_state(K, stage, _a, h, p):
    """As `dopri5.write_stage_state`."""
    coordinates = _count_coordinates(K, p)
    p.stage[0] = stage
    if stage == 0:
        for q in range(K.shape[1]):
            K[TRIAL, q] = K[STATE, q]
    elif stage == 1:
        _write_trial_of_stage(K, coordinates, 1, h)
    elif stage == 2:
        _write_trial_of_stage(K, coordinates, 2, h)
    elif stage == 3:
        _write_trial_of_stage(K, coordinates, 3, h)
    elif stage == 4:
        _write_trial_of_stage(K, coordinates, 4, h)
    elif stage == 5:
        _write_trial_of_stage(K, coordinates, 5, h)
    elif stage == 6:
        _write_trial_of_stage(K, coordinates, 6, h)
    elif stage == 7:
        _write_trial_of_stage(K, coordinates, 7, h)
    else:
        _write_trial_of_stage(K, coordinates, 8, h)


@jit_inline
def _squared_error(K, q, e, rtol):
    """Square of an error over its tolerance."""
    size = max(abs(K[STATE, q]), abs(K[TRIAL, q]))
    e *= rough_inverse(K[ATOL, q] + rtol * size)
    return e * e


@jit_inline
def squared_errors(K, h, rtol, p):
    """As `dopri5.squared_errors`."""
    coordinates = _count_coordinates(K, p)
    squares = fill_lanes(0.0)
    v, r = _weights(E, h), _weights(_EA, h * h)
    for q in range(coordinates):
        i = coordinates + q
        squares += _squared_error(K, q, _weighted_stage_sum(K, i, r, 3, STAGES - 1), rtol)
        squares += _squared_error(K, i, _weighted_stage_sum(K, i, v, 3, STAGES), rtol)
    for q in range(2 * coordinates, K.shape[1]):
        squares += _squared_error(K, q, _weighted_stage_sum(K, q, v, 3, STAGES), rtol)
    return squares


@jit_inline
def _write_half_bernstein(points, q, y, quarter, y_new, slope, slope_new):
    """Write Bernstein coefficients of a state q over half a step, from its value after a quarter of the step.

    Slopes are multiplied by a quarter of the half.
    """
    first, last = y + slope, y_new - slope_new
    points[0, q], points[1, q], points[3, q], points[4, q] = y, first, last, y_new
    points[2, q] = (16.0 * quarter - (y + y_new) - 4.0 * (first + last)) * (1 / 6)


@jit_inline
def _write_bernstein_halves(K, q, slopes, h, early, late):
    """Write the coefficients of a state over both halves of a step into ``early`` and ``late`` (5, n).

    Between, it is the polynomial of fifth degree through three states with their derivatives, ``slopes``.
    """
    y, middle, y_new = K[STATE, q], K[MIDDLE, q], K[TRIAL, q]
    d, d_middle, d_new = slopes
    quarter = (45 / 128) * y + (72 / 128) * middle + (11 / 128) * y_new
    quarter += (h / 256) * (9.0 * d - 36.0 * d_middle - 3.0 * d_new)
    last = (11 / 128) * y + (72 / 128) * middle + (45 / 128) * y_new
    last += (h / 256) * (3.0 * d + 36.0 * d_middle - 9.0 * d_new)
    s = 0.125 * h
    _write_half_bernstein(early, q, y, quarter, middle, s * d, s * d_middle)
    _write_half_bernstein(late, q, middle, last, y_new, s * d_middle, s * d_new)


@jit
def record_trail_forces(p, state, array_index, row):
    """Write the forces that the code has evaluated into a row of an array of each flight's trail."""
    forces, addresses = state.trail.gauge.shape[1], p.trails[array_index]
    for g in range(forces):
        scatter_lanes(p.gauge[g], addresses, forces * row + g)


@jit
def record_step(t, h, p, w, state):
    """As `dopri5.record_step`, for each flight into its own trail.

    The halves of the step are kept as two.
    """
    K, trails, rows = state.K, p.trails, state.trail.clock.shape[0]
    coordinates, n = _count_coordinates(K, p), K.shape[1]
    # The first half goes to the next row of the trail, the second to the one after it. The forces of the end are there
    # already, as those of the last stage; the code for the middle overwrites them, so they are stored first.
    row = (state.count[FIRST_ROW] + state.count[TRAILED]) % rows
    after = (row + 1) % rows
    record_trail_forces(p, state, GAUGE, after)
    w_half, x_half = _weights(HALF, h), _weights(_HALF_A, h * h)
    _write_stage(K, MIDDLE, coordinates, w_half, x_half, 0.5 * h, STAGES)
    p.stage[0] = 0  # forces are asked for, as at a start
    closed_loop(t + 0.5 * h, K[MIDDLE], K[SLOPE], p, w)
    state.count[EVALUATIONS] += 1
    record_trail_forces(p, state, GAUGE, row)
    early, late = p.halves[0], p.halves[1]
    for q in range(coordinates):
        i = coordinates + q
        _write_bernstein_halves(K, q, (K[STATE, i], K[MIDDLE, i], K[TRIAL, i]), h, early, late)
    for q in range(coordinates, n):
        _write_bernstein_halves(K, q, (K[0, q], K[SLOPE, q], K[STAGES - 1, q]), h, early, late)
    for half in range(2):
        place = row if half == 0 else after
        scatter_lanes(fill_lanes(t + half * 0.5 * h), trails[CLOCK], 2 * place)
        scatter_lanes(fill_lanes(0.5 * h), trails[CLOCK], 2 * place + 1)
        for i in range(5):
            for q in range(n):
                scatter_lanes(p.halves[half, i, q], trails[POINTS], (5 * place + i) * n + q)
    state.count[TRAILED] += 2


@jit
def record_start_forces(p, w, state):
    """As `dopri5.record_start_forces`, for each flight into its own trail."""
    record_trail_forces(p, state, START, 0)


@jit
def write_step_samples(t, h, t_new, times, samples, p, state):
    """As `dopri5.write_step_samples`, for each flight into its own samples, from the halves of a step that is kept."""
    count, n = state.count, state.K.shape[1]
    while count[SAMPLES] < times.shape[0] and times[count[SAMPLES]] <= t_new:
        x = 2.0 * (times[count[SAMPLES]] - t) / h
        half = 1 if x > 1.0 else 0
        points = p.halves[half]
        x -= half
        z = 1.0 - x
        for q in range(n):
            value = (z * z) * (
                (z * z) * points[0, q] + (4.0 * x * z) * points[1, q] + (6.0 * x * x) * points[2, q]
            )
            value += (x * x * x) * ((4.0 * z) * points[3, q] + x * points[4, q])
            scatter_lanes(value, p.samples, n * count[SAMPLES] + q)
        count[SAMPLES] += 1


#: What differs from `dopri5.integrate`, beside the right-hand side and `record_step`, which calls it.
INSTEAD = {
    "_A": A,
    "_C": C,
    "_STAGES": STAGES,
    "_TRAIL_ROWS": 2,
    "STATE": STATE,
    "TRIAL": TRIAL,
    "write_stage_state": write_stage_state,
    "write_step_samples": write_step_samples,
    "record_start_forces": record_start_forces,
    "squared_errors": squared_errors,
    # The tables of an `UnrolledProblem` are named as those of a `Disturbance`.
    "step_size": step_to_knot,
}
