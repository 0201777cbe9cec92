"""The integrator: Dormand and Prince's pair of fifth and fourth order, with its steps recorded in a trail."""

import math

import numpy as np

from rigidfleet._common.renamed import getattr_of_earlier_names
from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.dynamics import closed_loop
from rigidfleet.kernel.gauge import write_watched_forces
from rigidfleet.kernel.records import (
    ACCEPTED,
    ATOL,
    COLLAPSED,
    EVALUATIONS,
    FINISHED,
    FIRST_ROW,
    LAST_ERROR,
    LEAST_ERROR,
    NEXT_STEP,
    PAUSED,
    REJECTED,
    SAMPLES,
    STATE,
    TIME,
    TRAILED,
    TRIAL,
)
from rigidfleet.kernel.vectors import as_lanes, fill_lanes, rough_inverse, sum_lanes_or_worst_flight

# Dormand and Prince's 5(4) pair, with Hairer's fourth-order continuous extension.
_STAGES = 7
#: Rows of the trail that a step takes.
_TRAIL_ROWS = 1
_A = np.zeros((7, 6))
_A[1, :1] = 1 / 5
_A[2, :2] = 3 / 40, 9 / 40
_A[3, :3] = 44 / 45, -56 / 15, 32 / 9
_A[4, :4] = 19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729
_A[5, :5] = 9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656
_A[6] = 35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84
_C = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1, 1])
_E = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
_D = np.array(
    [
        -12715105075 / 11282082432, 0, 87487479700 / 32700410799, -10690763975 / 1880347072,
        701980252875 / 199316789632, -1453857185 / 822651844, 69997945 / 29380423,
    ]
)  # fmt: skip


@jit
def forget_stages(k):
    """Set stages k to zero: NaN in them would survive a weight of zero."""
    k[:] = fill_lanes(0.0)


@jit_inline
def write_stage_state(k, stage, a, h, p):
    """Write the state of a stage of p: y + h sum a[stage, s] k_s."""
    # All six terms at once, or the first: later stages have weight zero and finite values.
    a0, a1, a2 = h * a[stage, 0], h * a[stage, 1], h * a[stage, 2]
    a3, a4, a5 = h * a[stage, 3], h * a[stage, 4], h * a[stage, 5]
    if stage < 3:
        for q in range(k.shape[1]):
            k[TRIAL, q] = (a0 * k[0, q] + a1 * k[1, q]) + k[STATE, q]
    elif stage < 5:
        for q in range(k.shape[1]):
            early = (a0 * k[0, q] + a1 * k[1, q]) + (a2 * k[2, q] + a3 * k[3, q])
            k[TRIAL, q] = early + k[STATE, q]
    else:
        for q in range(k.shape[1]):
            early = (a0 * k[0, q] + a1 * k[1, q]) + (a2 * k[2, q] + a3 * k[3, q])
            k[TRIAL, q] = early + (k[STATE, q] + (a4 * k[4, q] + a5 * k[5, q]))


@jit_inline
def squared_errors(k, h, rtol, p):
    """Squares of a step's errors over their tolerances, summed over vectors of states."""
    squares = fill_lanes(0.0)
    for q in range(k.shape[1]):
        e = h * (
            (_E[0] * k[0, q] + _E[2] * k[2, q] + _E[3] * k[3, q])
            + (_E[4] * k[4, q] + _E[5] * k[5, q] + _E[6] * k[6, q])
        )
        size = max(abs(k[STATE, q]), abs(k[TRIAL, q]))
        e *= rough_inverse(k[ATOL, q] + rtol * size)
        squares += e * e
    return squares


@jit_inline
def until_knot(t, step):
    """Time from t to the next knot [s]; knots are every ``step`` from 0, and one that t just meets has passed."""
    return (math.floor(t / step + 1e-6) + 1.0) * step - t


@jit_inline
def step_size(t, h, t_end, p):
    """Length of the next step [s], see `step_to_knot`."""
    return step_to_knot(t, min(h, p.external.max_step), t_end, p.disturbance)


@jit_inline
def step_to_knot(t, h, t_end, disturbance):
    """Length of the next step [s]: about h at most, in equal steps up to the next knot of gusts or noise.

    Third derivatives of the disturbances jump at knots; the error of a step across one falls with h^4 only.
    """
    rest = t_end - t
    if disturbance.noise_r.shape[0] == 0 and disturbance.gust.shape[0] == 0:
        return min(h, rest)
    if disturbance.noise_r.shape[0] > 0:
        rest = min(rest, until_knot(t, disturbance.noise_step))
    if disturbance.gust.shape[0] > 0:
        rest = min(rest, until_knot(t, disturbance.gust_step))
    return rest / max(1.0, math.ceil(rest / h - 0.05))


@jit
def record_start_forces(p, w, state):
    """Record the forces after a jump in the trail."""
    write_watched_forces(p, w, state.trail.start)


@jit
def record_step(t, h, p, w, state):
    """Record a step in the next row of the trail: Bernstein coefficients of its extension, and the forces at its end.

    The terms are those of Hairer's form, y + x (rise + (1 - x) (bend + x (rest + (1 - x) twist))).
    """
    K, row = state.K, (state.count[FIRST_ROW] + state.count[TRAILED]) % state.trail.clock.shape[0]
    points = state.trail.points[row]
    state.trail.clock[row, 0], state.trail.clock[row, 1] = t, h
    for q in range(points.shape[1]):
        y, rise = K[STATE, q], K[TRIAL, q] - K[STATE, q]
        bend = h * K[0, q] - rise
        rest = rise - h * K[6, q] - bend
        twist = _D[0] * K[0, q] + _D[2] * K[2, q] + _D[3] * K[3, q]
        twist = h * (twist + _D[4] * K[4, q] + _D[5] * K[5, q] + _D[6] * K[6, q])
        points[0, q] = y
        points[1, q] = y + 0.25 * (rise + bend)
        points[2, q] = y + 0.5 * rise + bend / 3.0 + (rest + twist) / 6.0
        points[3, q] = y + 0.75 * rise + 0.25 * (bend + rest)
        points[4, q] = K[TRIAL, q]
    write_watched_forces(p, w, state.trail.gauge[row])
    state.count[TRAILED] += 1


@jit_inline
def write_step_samples(t, h, t_new, times, samples, p, state):
    """Write the states at the times in (t, t_new] by the step's continuous extension, from t [s] on, of length h."""
    K, count = state.K, state.count
    if count[SAMPLES] < times.shape[0] and times[count[SAMPLES]] <= t_new:
        for q in range(samples.shape[1]):  # into K[1], which has weight zero in the sums
            d = _D[0] * K[0, q]
            for s in range(1, 7):
                d += _D[s] * K[s, q]
            K[1, q] = h * d
    while count[SAMPLES] < times.shape[0] and times[count[SAMPLES]] <= t_new:
        x = (times[count[SAMPLES]] - t) / h
        for q in range(samples.shape[1]):
            rise = K[TRIAL, q] - K[STATE, q]
            bend = h * K[0, q] - rise
            rest = rise - h * K[6, q] - bend
            inner = bend + x * (rest + (1.0 - x) * K[1, q])
            samples[count[SAMPLES], q] = K[STATE, q] + x * (rise + (1.0 - x) * inner)
        count[SAMPLES] += 1


@jit
def integrate(p, w, state, t_end, fresh, times, samples, max_steps):
    """Integrate `closed_loop` to ``t_end`` [s]; adaptive Dormand-Prince 5(4), PI step control.

    Parameters
    ----------
    p, w, state : Problem, Workspace, IntegratorState (changed in place)
    t_end : time of the end, met exactly [s]
    fresh : True at a start or after a switch, when the derivative at y is not known yet
    times, samples : increasing times (K,) [s] and the array (K, n) for the dense output; the next
        index to write is ``state.count[SAMPLES]``
    max_steps : number of steps after which to pause

    Returns FINISHED, PAUSED (the trail may be full), or COLLAPSED if the step size collapsed (singular
    constraints, non-finite forces). y and t are then those of the last accepted step.
    """
    K, clock, count = state.K, state.clock, state.count
    n, capacity = state.y.shape[0], state.trail.clock.shape[0]
    y, trial = K[STATE], K[TRIAL]
    for q in range(n):
        y[q] = state.y[q]
    k = as_lanes(K)
    t, h, last = clock[TIME], clock[NEXT_STEP], clock[LAST_ERROR]
    if fresh:
        forget_stages(k[:_STAGES])
    first = 0 if fresh else 1
    status = PAUSED
    for _ in range(max_steps):
        h = step_size(t, h, t_end, p)
        stage = first
        # One call site of the right-hand side: stage 0 is the derivative at y itself.
        while stage < _STAGES:
            write_stage_state(k, stage, _A, h, p)
            closed_loop(t + _C[stage] * h, trial, K[stage], p, w)
            if stage == 0 and capacity > 0:
                record_start_forces(p, w, state)
            count[EVALUATIONS] += 1
            stage += 1
        squares = squared_errors(k, h, state.rtol, p)
        error = math.sqrt(sum_lanes_or_worst_flight(squares, y) / n)
        if not error <= 1.0:  # NaN too
            count[REJECTED] += 1
            first = 1
            shrink = 0.1
            if error < math.inf:
                shrink = 0.9 * error**-0.2
            else:
                forget_stages(k[1:_STAGES])
            h *= max(0.1, shrink)
            if h < 1e-12 * max(1.0, abs(t)):
                status = COLLAPSED
                break
            continue
        t_new = t + h if t + h < t_end else t_end
        if capacity > 0:
            record_step(t, h, p, w, state)
        write_step_samples(t, h, t_new, times, samples, p, state)
        for q in range(k.shape[1]):
            k[STATE, q] = k[TRIAL, q]
            k[0, q] = k[_STAGES - 1, q]
        t = t_new
        first = 1
        count[ACCEPTED] += 1
        # 0.9 error^-0.17 last^0.04, by logarithms: two powers would cost half an evaluation.
        error = math.log(max(error, 1e-8))
        h *= min(5.0, max(0.2, 0.9 * math.exp(0.04 * last - 0.17 * error)))
        last = max(error, LEAST_ERROR)
        if t >= t_end:
            status = FINISHED
            break
        if capacity > 0 and count[TRAILED] + _TRAIL_ROWS > capacity:
            break
    for q in range(n):
        state.y[q] = y[q]
    clock[TIME], clock[NEXT_STEP], clock[LAST_ERROR] = t, h, last
    return status


__getattr__ = getattr_of_earlier_names(
    __name__,
    keep_start="record_start_forces",
    keep_samples="write_step_samples",
    advance="write_stage_state",
    keep_step="record_step",
)
