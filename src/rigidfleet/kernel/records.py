"""What the integrator, the recorder and the monitor are told, and what they write: arrays, as in `problem`.

K samples, N agents, m edges.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigidfleet.kernel.problem import padded, zeros
from rigidfleet.typing import Bools, Floats, Ints

#: What an integration returns.
FINISHED, PAUSED, COLLAPSED = range(3)
#: Rows of `IntegratorState.K` after the seven stages.
STATE, TRIAL, ATOL = 7, 8, 9
#: What counts as the last error where there was none, or a smaller one: its logarithm.
LEAST_ERROR = math.log(1e-4)
#: Quantities of a `Monitor`; the less each of its `worst` is, the worse: greatest values are kept with the other sign.
(
    SEPARATION, LOST, SEPARATION_BELOW, CLEARANCE, STANDING, FLYING, GEOFENCE, LOWEST, HIGHEST, SPEED, THRUST,
    THRUST_MARGIN, ACCELERATION, CONSTRAINT_FORCE, TENSION, CONSTRAINT,
) = range(16)  # fmt: skip
#: Bytes of a trail, about: the integrator pauses when it is full.
_TRAIL = 1 << 19
#: Points that a greatest force is looked for with, at most.
_NODES = 27


#: Five points of a step, and from values there to Bernstein coefficients (5, 5).
KNOTS = np.linspace(0.0, 1.0, 5)


def bernstein(x: Floats) -> Floats:
    """Bernstein polynomials (..., 5) of fourth degree at x (...)."""
    return np.stack([math.comb(4, k) * x**k * (1.0 - x) ** (4 - k) for k in range(5)], axis=-1)


FROM_KNOTS = np.linalg.inv(bernstein(KNOTS))


class Trail(NamedTuple):
    """Steps as they were flown, for whoever looks between samples; no rows, and none are kept.

    ``points`` are the Bernstein coefficients of the continuous extension, a polynomial of fourth degree.
    """

    clock: Floats  # (S, 2) start [s], length [s]
    points: Floats  # (S, 5, n)
    gauge: Floats  # (S, 3N + 2m) at the end, see `gauge.read_gauge`
    start: Floats  # (3N + 2m,) at the start of the first step, behind a jump


def trail(states: int, agents: int, edges: int) -> Trail:
    """Allocate a trail of half a megabyte, or of two steps."""
    row = 5 * states + 3 * agents + 2 * edges
    rows = max(2, _TRAIL // (8 * row))
    gauge = 3 * agents + 2 * edges
    shapes = (rows, 2), (rows, 5, states), (rows, gauge), (gauge,)
    return Trail(*(np.empty(shape) for shape in shapes))


#: Where no steps are kept.
NO_TRAIL = Trail(np.zeros((0, 2)), np.zeros((0, 5, 0)), np.zeros((0, 0)), np.zeros(0))


class Monitor(NamedTuple):
    """Worst values of a phase, in continuous time, and what they are looked for with; see `kernel.monitor`."""

    worst: Floats  # (16,) by quantity; infinity where there is none yet
    when: Floats  # (16,) [s]
    who: Ints  # (16, 2) agents; agent and obstacle; agents of an edge; -1: nobody
    sign: Floats  # (1,) of the greatest tension
    radius: Floats  # (N,) [m]
    left: Bools  # (N,) who is judged: not lost
    standing: Ints  # (N,) whether an agent stands on an obstacle since the start
    low: Floats  # (N, 3) clearance, time and obstacle of who may be landing; infinity: nobody
    pad: float  # who is so near an obstacle may stand on it [m]
    boxes: Floats  # (B, 6) corners of obstacles; of the ground infinite
    fence: Floats  # (F, 6) corners of the geofence, if there is one
    pairs: Ints  # (P, 2) whose separation is watched
    struck: Ints  # (P', 2) of a lost agent and one that is left
    columns: Ints  # (P'', 2) who may be below one another
    flags: Ints  # (4,) see `monitor.watch`
    recorder: int  # address of the recorder, with its arguments: `time` and `states` to evaluate at
    segment: int
    record: int
    time: Floats  # (1,) [s]
    states: Floats  # (1, n)
    gauge: Floats  # (2, 3N + 2m) forces before the first step, and in the middle of one
    nodes: Floats  # (27, 3N + 2m) forces at points of two steps
    instants: Floats  # (27,) [s] when
    rank: Ints  # (27,) them in order
    places: Floats  # (N, 5, 3) where agents are over a step: control points [m]
    curve: Floats  # (5, 3) of one pair
    work: Floats  # (40, 11) polynomials
    pieces: Floats  # (40, 17) curves
    basis: Floats  # (5, 5)
    poses: Floats  # (5, 15) attitude, centre and its velocity at knots
    knots: Floats  # (5, 3)
    room: Floats  # (3, 10)


def monitor(
    radius: Floats, boxes: Floats, fence: Floats, states: int, gauge: int, **given: Any
) -> Monitor:
    """Begin to watch: nothing is known yet, and no pairs are listed but those ``given`` among the fields."""
    n, none = len(radius), np.zeros((0, 2), dtype=np.int64)
    count = CONSTRAINT + 1
    fields: dict[str, Any] = {
        "worst": np.full(count, np.inf), "when": np.zeros(count), "sign": np.zeros(1),
        "who": np.full((count, 2), -1), "radius": radius, "boxes": boxes, "fence": fence,
        "left": np.ones(n, dtype=np.bool_), "standing": np.zeros(n, dtype=np.int64),
        "low": np.full((n, 3), np.inf), "pad": 0.0, "pairs": none, "struck": none, "columns": none,
        "flags": np.zeros(4, dtype=np.int64),
        "recorder": 0, "segment": 0, "record": 0, "time": np.zeros(1),
        "states": np.zeros((1, states)), "gauge": np.zeros((2, gauge)),
        "nodes": np.empty((_NODES, gauge)), "instants": np.zeros(_NODES),
        "rank": np.zeros(_NODES, dtype=np.int64),
        "places": np.zeros((n, 5, 3)), "curve": np.zeros((5, 3)), "work": np.zeros((40, 11)),
        "pieces": np.zeros((40, 17)), "basis": np.zeros((5, 5)), "poses": np.zeros((5, 15)),
        "knots": np.zeros((5, 3)), "room": np.zeros((3, 10)),
    }  # fmt: skip
    return Monitor(**(fields | given))


class IntegratorState(NamedTuple):
    """State of an integration, so that it can pause and go on."""

    y: Floats  # (n,) state at `clock[0]`
    K: Floats  # (10, n padded to eights) stages, K[0] the derivative at y; y, trial, tolerance
    clock: Floats  # (3,) t [s], next step h [s], logarithm of the last error
    count: NDArray[
        np.int64
    ]  # (5,) evaluations, accepted, rejected, samples written, steps in the trail
    rtol: float
    trail: Trail


def integrator(
    y: Floats,
    t: float,
    *,
    rtol: float,
    atol: Floats,
    step: float = 1e-3,
    trail: Trail = NO_TRAIL,
) -> IntegratorState:
    """Start an integration from state ``y`` (n,) at time t [s] with a first step [s] to try.

    ``atol`` (n,) is the absolute tolerance of each state, ``rtol`` the relative one of all. Steps go
    into the ``trail``.
    """
    n = len(y)
    K = zeros(10, padded(n))
    K[ATOL] = 1.0
    K[ATOL, :n] = atol
    clock, count = np.array([t, step, LEAST_ERROR]), np.zeros(5, dtype=np.int64)
    return IntegratorState(y.copy(), K, clock, count, rtol, trail)


class Segment(NamedTuple):
    """How far to integrate, and what to sample on the way."""

    t_end: float  # time to land on [s]
    fresh: bool  # whether the derivative at the start is not known: after a start or a switch
    max_steps: int  # pause after so many
    times: Floats  # (K,) [s], increasing
    samples: Floats  # (K, n) states there: written, or, by the recorder, read
    dy: Floats  # (n,) the recorder's derivative


class Record(NamedTuple):
    """What is recorded, one row per sample."""

    r: Floats  # (K, N, 3)
    v: Floats
    a: Floats
    f_E: Floats
    f_u: Floats
    f_C: Floats
    r_ref: Floats
    c: Floats  # (K, m)
    L: Floats
    d: Floats
    d_dot: Floats
    multiplier: Floats
    p: Floats  # (K, N, 3) slots
    motion: Floats  # (K, 6) CM reference position and velocity
    rates: Floats  # (K, 3) reference rates, body axes
    T_ref: Floats  # (K, 3, 3)
    wrench: Floats  # (K, 6)
    r_seen: Floats  # (K, N, 3) as measured
    v_seen: Floats
    f_D: Floats


def recorder(k: int, n: int, m: int) -> Record:
    """Allocate a record of ``k`` samples."""
    agent, edge = (lambda: np.full((k, n, 3), np.nan)), (lambda: np.full((k, m), np.nan))
    return Record(
        *(agent() for _ in range(7)), *(edge() for _ in range(5)), agent(),
        np.full((k, 6), np.nan), np.full((k, 3), np.nan), np.full((k, 3, 3), np.nan),
        np.full((k, 6), np.nan), *(agent() for _ in range(3)),
    )  # fmt: skip
