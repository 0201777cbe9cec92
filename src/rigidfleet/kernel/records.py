"""What the integrator and the recorder are told, and what they write: arrays, as in `program`.

K samples, N agents, m edges.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigidfleet.kernel.program import Array, padded, zeros

#: What an integration returns.
FINISHED, PAUSED, COLLAPSED = range(3)
#: Rows of `Integrator.K` after the seven stages.
STATE, TRIAL, ATOL = 7, 8, 9
#: What counts as the last error where there was none, or a smaller one: its logarithm.
LEAST_ERROR = math.log(1e-4)


class Integrator(NamedTuple):
    """State of an integration, so that it can pause and go on."""

    y: Array  # (n,) state at `clock[0]`
    K: Array  # (10, n padded to eights) stages, K[0] the derivative at y; y, trial, tolerance
    clock: Array  # (3,) t [s], next step h [s], logarithm of the last error
    count: NDArray[np.int64]  # (4,) evaluations, accepted, rejected, samples written
    rtol: float


def integrator(y: Array, t: float, *, rtol: float, atol: Array, step: float = 1e-3) -> Integrator:
    """Start an integration from state ``y`` (n,) at time t [s] with a first step [s] to try.

    ``atol`` (n,) is the absolute tolerance of each state, ``rtol`` the relative one of all.
    """
    n = len(y)
    K = zeros(10, padded(n))
    K[ATOL] = 1.0
    K[ATOL, :n] = atol
    clock, count = np.array([t, step, LEAST_ERROR]), np.zeros(4, dtype=np.int64)
    return Integrator(y.copy(), K, clock, count, rtol)


class Stretch(NamedTuple):
    """How far to integrate, and what to sample on the way."""

    t_end: float  # time to land on [s]
    fresh: bool  # whether the derivative at the start is not known: after a start or a switch
    max_steps: int  # pause after so many
    times: Array  # (K,) [s], increasing
    samples: Array  # (K, n) states there: written, or, by the recorder, read
    dy: Array  # (n,) the recorder's derivative


class Record(NamedTuple):
    """What is recorded, one row per sample."""

    r: Array  # (K, N, 3)
    v: Array
    a: Array
    f_E: Array
    f_u: Array
    f_C: Array
    r_ref: Array
    c: Array  # (K, m)
    L: Array
    d: Array
    d_dot: Array
    multiplier: Array
    p: Array  # (K, N, 3) slots
    motion: Array  # (K, 6) CM reference position and velocity
    rates: Array  # (K, 3) reference rates, body axes
    T_ref: Array  # (K, 3, 3)
    wrench: Array  # (K, 6)
    r_seen: Array  # (K, N, 3) as measured
    v_seen: Array
    f_D: Array


def recorder(k: int, n: int, m: int) -> Record:
    """Allocate a record of ``k`` samples."""
    agent, edge = (lambda: np.full((k, n, 3), np.nan)), (lambda: np.full((k, m), np.nan))
    return Record(
        *(agent() for _ in range(7)), *(edge() for _ in range(5)), agent(),
        np.full((k, 6), np.nan), np.full((k, 3), np.nan), np.full((k, 3, 3), np.nan),
        np.full((k, 6), np.nan), *(agent() for _ in range(3)),
    )  # fmt: skip
