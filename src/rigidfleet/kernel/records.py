"""Inputs and outputs of the integrator, the recorder and the monitor: arrays, as in `problem`.

K samples, N agents, m edges.
"""

import math
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigidfleet.kernel.problem import Extents, PerAgent, Places, PlacesInTime, Vector, padded, zeros
from rigidfleet.typing import Bools, Edges, Floats, Ints

PerEdgeInTime = Annotated[Floats, Extents((None, "m"))]
#: Boxes by their least and greatest corners, and pairs of agents.
Corners = Annotated[Floats, Extents((None, 6))]
Pairs = Annotated[Ints, Extents((None, 2))]

#: Return values of an integration; a sampled flight asks for the forces of vehicles that follow laws of their own.
FINISHED, PAUSED, COLLAPSED, ASKS = range(4)
#: Places in `IntegratorState.clock`: the time [s], the next step to try [s], the logarithm of the last error.
TIME, NEXT_STEP, LAST_ERROR = range(3)
#: Places in `IntegratorState.count`: evaluations, steps accepted and rejected, samples written, steps in the trail, and
#: the row of the first of these.
EVALUATIONS, ACCEPTED, REJECTED, SAMPLES, TRAILED, FIRST_ROW = range(6)
#: Rows of `IntegratorState.K` after the seven stages.
STATE, TRIAL, ATOL = 7, 8, 9
#: Logarithm of the least value of the last error; also used if there is no last error.
LEAST_ERROR = math.log(1e-4)
#: Quantities of a `Monitor`. A smaller value of `worst` is worse; greatest values are stored with the opposite sign.
#: One whose value is -infinity is not searched for.
(
    SEPARATION, LOST, SEPARATION_BELOW, SEPARATION_FLYING, CLEARANCE, STANDING, FLYING, GEOFENCE, LOWEST, HIGHEST,
    SPEED, THRUST, THRUST_MARGIN, ACCELERATION, CONSTRAINT_FORCE, TENSION, CONSTRAINT, HORIZONTAL_SPEED, VERTICAL_SPEED,
    HORIZONTAL_ACCELERATION, VERTICAL_ACCELERATION,
) = range(21)  # fmt: skip
EXTREMA = VERTICAL_ACCELERATION + 1
#: Place in `Monitor.count`: 1 if the first step of the trail has been searched, and stays as a neighbour of the next.
STAYED = 0
#: Triple product of three unit vectors below which a pivot counts as lost.
LOST_PIVOT = 1e-6
#: Approximate sizes of trails in bytes, of points and of vehicles; a flight pauses when its trail is full. With more,
#: eight flights side by side wait for memory. Vehicles take short steps: with less, their pauses take an eighth longer.
POINTS_TRAIL, VEHICLES_TRAIL = 1 << 17, 1 << 20
#: Greatest number of points in a search for a greatest force.
_NODES = 27


#: Five points of a step, and the matrix (5, 5) from values at these points to Bernstein coefficients.
KNOTS = np.linspace(0.0, 1.0, 5)


def bernstein_basis(x: Floats) -> Floats:
    """Bernstein polynomials (..., 5) of fourth degree at x (...)."""
    return np.stack([math.comb(4, k) * x**k * (1.0 - x) ** (4 - k) for k in range(5)], axis=-1)


FROM_KNOTS = np.linalg.inv(bernstein_basis(KNOTS))


class Trail(NamedTuple):
    """Recorded steps, for extremes between samples; without rows, no steps are recorded.

    The first row follows the last one: steps that have been searched make room for others, and none is ever moved.
    ``points`` are the Bernstein coefficients of the continuous extension, a polynomial of fourth degree.
    """

    clock: Annotated[Floats, Extents((None, 2))]  # start [s], length [s]
    points: Annotated[Floats, Extents((None, 5, None))]  # (S, 5, n)
    gauge: Floats  # (S, 3N + 2m or 5N + 2m) at the end, see `gauge.write_watched_forces`
    start: Floats  # (3N + 2m or 5N + 2m,) at the start of the first step, after a jump


def new_trail(n_bytes: int, states: int, agents: int, edges: int, directed: bool) -> Trail:
    """Allocate a trail of ``n_bytes``, or of three steps; ``directed``: with accelerations by direction."""
    gauge = (5 if directed else 3) * agents + 2 * edges
    rows = max(3, n_bytes // (8 * (5 * states + gauge)))
    shapes = (rows, 2), (rows, 5, states), (rows, gauge), (gauge,)
    return Trail(*(np.empty(shape) for shape in shapes))


#: An empty trail: no steps are recorded.
NO_TRAIL = Trail(np.zeros((0, 2)), np.zeros((0, 5, 0)), np.zeros((0, 0)), np.zeros(0))


class Monitor(NamedTuple):
    """Worst values of a phase in continuous time, with the data and work arrays of the search; see `kernel.monitor`."""

    worst: Floats  # (21,) by quantity; infinity if there is none yet
    when: Floats  # (21,) [s]
    who: Ints  # (21, 2) agents; agent and obstacle; agents of an edge; -1: none
    sign: Floats  # (1,) of the greatest tension
    radius: PerAgent  # [m]
    left: Annotated[Bools, Extents(("N",))]  # whether an agent is monitored: not lost
    # whether an agent has stood on an obstacle since the start
    standing: Annotated[Ints, Extents(("N",))]
    low: Places  # clearance, time and obstacle of agents that may be landing; infinity: none
    pad: float  # clearance within which an agent may stand on an obstacle [m]
    altitude: (
        float  # z from which on `SEPARATION_FLYING` counts [m]; infinity: it is not searched for
    )
    boxes: Corners  # of obstacles; of the ground infinite
    fence: Corners  # of the geofence, if there is one
    pairs: Pairs  # whose separation is monitored
    struck: Pairs  # of a lost agent and one still flying
    columns: Pairs  # that may fly one below the other
    count: Ints  # (1,) see `STAYED`
    moves: Floats  # (2,) bounds of the change of any distance [m], see `monitor.write_first_step_change_bounds`
    recorder: int  # address of the recorder, with its arguments: `time` and `states` to evaluate at
    segment: int
    record: int
    time: Floats  # (1,) [s]
    states: Floats  # (1, n)
    gauge: Floats  # (3, 3N + 2m or more) forces before the first step, in the middle of one, and the greatest so far
    nodes: Floats  # (27, 3N + 2m or more) forces at points of two steps
    instants: Floats  # (27,) times of these points [s]
    rank: Ints  # (27,) their order in time
    # control points of a piece of a step in world axes, in the body formulation: positions [m], velocities [m/s]
    world: Annotated[Floats, Extents((5, None))]
    # of the ball about the third control point that holds all five: its centre and its radius [m]
    balls: Annotated[Floats, Extents(("N", 4))]
    # a path cut at waypoints, and in the axes of an obstacle
    curves: Annotated[Floats, Extents((2, 5, 3))]
    work: Annotated[Floats, Extents((40, 11))]  # polynomials
    pieces: Annotated[Floats, Extents((40, 17))]  # curves
    basis: Annotated[Floats, Extents((5, 5))]
    # of the body axes at knots, world to body; their centre [m] and its velocity [m/s]
    attitudes: Annotated[Floats, Extents((5, 3, 3))]
    centres: Annotated[Floats, Extents((5, 6))]
    knots: Annotated[Floats, Extents((5, 3))]
    scratch: Annotated[Floats, Extents((3, 10))]


def new_monitor(
    radius: Floats, boxes: Floats, fence: Floats, states: int, gauge: int, **watched: Any
) -> Monitor:
    """A monitor with work arrays of its own. Without the fields that are ``watched``, it has no values and no pairs."""
    n, none = len(radius), np.zeros((0, 2), dtype=np.int64)
    return Monitor(
        radius=radius, boxes=boxes, fence=fence, count=np.zeros(1, dtype=np.int64), moves=np.zeros(2),
        recorder=0, segment=0, record=0, time=np.zeros(1),
        states=np.zeros((1, states)), gauge=np.zeros((3, gauge)),
        nodes=np.empty((_NODES, gauge)), instants=np.zeros(_NODES), rank=np.zeros(_NODES, dtype=np.int64),
        world=np.zeros((5, 6 * n)), balls=np.zeros((n, 4)), curves=np.zeros((2, 5, 3)), work=np.zeros((40, 11)),
        pieces=np.zeros((40, 17)), basis=np.zeros((5, 5)), attitudes=np.zeros((5, 3, 3)),
        centres=np.zeros((5, 6)), knots=np.zeros((5, 3)), scratch=np.zeros((3, 10)),
        **watched or {
            "worst": np.full(EXTREMA, np.inf), "when": np.zeros(EXTREMA), "sign": np.zeros(1),
            "who": np.full((EXTREMA, 2), -1), "left": np.ones(n, dtype=np.bool_),
            "standing": np.zeros(n, dtype=np.int64), "low": np.full((n, 3), np.inf), "pad": 0.0, "altitude": np.inf,
            "pairs": none, "struck": none, "columns": none,
        },
    )  # fmt: skip


class IntegratorState(NamedTuple):
    """State of an integration, which can pause and continue."""

    y: Floats  # (n,) state at the time reached
    K: Floats  # (10, n padded to eights) stages, K[0] the derivative at y; y, trial, tolerance
    clock: Vector  # see `TIME`
    count: NDArray[np.int64]  # (6,) see `EVALUATIONS`
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

    ``atol`` (n,) is the absolute tolerance of each state, ``rtol`` the relative one of all. Steps are recorded
    in the ``trail``.
    """
    n = len(y)
    K = zeros(10, padded(n))
    K[ATOL, :n], K[ATOL, n:] = atol, 1.0
    clock, count = np.array([t, step, LEAST_ERROR]), np.zeros(FIRST_ROW + 1, dtype=np.int64)
    return IntegratorState(np.array(y, dtype=float), K, clock, count, rtol, trail)


class Segment(NamedTuple):
    """End of an integration, and the samples to write on the way."""

    t_end: float  # time of the end, met exactly [s]
    fresh: bool  # whether the derivative at the start is unknown: after a start or a switch
    max_steps: int  # number of steps after which to pause
    times: Floats  # (K,) [s], increasing
    samples: Floats  # (K, n) states at these times: written by the integrator, read by the recorder
    dy: Floats  # (n,) the recorder's derivative
    first: int = 0  # the recorder's first row


class Record(NamedTuple):
    """Recorded quantities, one row per sample."""

    r: PlacesInTime
    v: PlacesInTime
    a: PlacesInTime
    f_E: PlacesInTime
    f_u: PlacesInTime
    f_C: PlacesInTime
    r_ref: PlacesInTime
    c: PerEdgeInTime
    L: PerEdgeInTime
    d: PerEdgeInTime
    d_dot: PerEdgeInTime
    multiplier: PerEdgeInTime
    p: PlacesInTime  # slots
    motion: Annotated[Floats, Extents((None, 6))]  # CM reference position and velocity
    rates: Annotated[Floats, Extents((None, 3))]  # reference rates, body axes
    T_ref: Annotated[Floats, Extents((None, 3, 3))]
    wrench: Annotated[Floats, Extents((None, 6))]
    r_seen: PlacesInTime  # as measured
    v_seen: PlacesInTime
    f_D: PlacesInTime


def new_record(k: int, n: int, m: int, *, disturbed: bool = True) -> Record:
    """Allocate a record of ``k`` samples, to be written.

    Unless ``disturbed``, there are no rows of what disturbances alone give.
    """
    agent, edge, seen = (k, n, 3), (k, m), (k if disturbed else 0, n, 3)
    shapes = *(agent,) * 7, *(edge,) * 5, agent, (k, 6), (k, 3), (k, 3, 3), (k, 6), *(seen,) * 3
    return Record._make([np.empty(shape) for shape in shapes])


class Recursion(NamedTuple):
    """Rows x_k to which the row before is added, times a number; see `rigidfleet.kernel.recursion`."""

    x: Floats  # (K, M)
    a: Floats  # (K,)
    backward: bool  # whether the rows are followed from the last to the first


class Order(NamedTuple):
    """The order of elimination: agents, each with its edges to three before it; missing entries are 0."""

    agent: Edges  # (N,)
    edge: Edges  # (N, 3): none, one, two, then three each
    other: Edges  # (N, 3) the agents at their other ends
    sign: NDArray[np.int8]  # (N, 3) 1 where u of the edge points towards the agent, else -1


class Pattern(NamedTuple):
    """Positions of the blocks of L: by columns, the diagonal first, and by rows."""

    place: Ints  # (N,) column of each agent
    column: Ints  # (N + 1,) first block of each column
    row: Ints  # (B,) row of each block
    first: Ints  # (N + 1,) of each row, the blocks left of the diagonal:
    left: Ints  # (B - N,) their columns
    block: Ints  # (B - N,) and which blocks they are
    of_edge: Ints  # (m,) block of each edge
