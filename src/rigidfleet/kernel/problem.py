"""One phase of a flight as arrays, written by `plan` and read by the kernel.

Short names are the paper's; every array is C-contiguous float64 (edges: uint32). N agents, m edges. The kernel is
compiled with the extents that types of arrays declare here as numbers (see `compiler.pointers`).
"""

import math
from functools import cache
from itertools import accumulate
from typing import Annotated, Any, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

from rigidfleet.solids.records import Solids, join_solids
from rigidfleet.typing import Bools, Edges, Floats


class Extents(tuple[int | str | None, ...]):
    """Extents of an array: numbers, or "N", "m", "P" pairs of edges, "A" unknowns of the multipliers; None: any.

    "V" and "H" are those of arrays that only some laws need.
    """


@cache
def extents_of(kind: type) -> dict[str, Extents]:
    """Declared extents of the arrays of a type of named tuple."""
    hints = get_type_hints(kind, include_extras=True)
    about = {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
    return {name: x for name, known in about.items() for x in known if isinstance(x, Extents)}


PerAgent = Annotated[Floats, Extents(("N",))]
PerEdge = Annotated[Floats, Extents(("m",))]
#: A vector for each agent, and over time.
Places = Annotated[Floats, Extents(("N", 3))]
PlacesInTime = Annotated[Floats, Extents((None, "N", 3))]
Vector = Annotated[Floats, Extents((3,))]
Matrix = Annotated[Floats, Extents((3, 3))]

# Multiplier solves (`ConstraintLaw.solver`).
ITERATED, SPECTRAL, EXACT, PINV = range(4)
# Distance references (`Reference.kind`).
CONSTANT, SQUARED, SHAPE = range(3)
# Input laws (`Control.kind`).
OPEN, TRACKING, BODY = range(3)
# Allocation of a wrench (`Control.allocation`), the last three with the paper's H.
RIGID, PINV_EQUAL, PINV_INERTIA, PINV_INERTIA_FORCE = range(4)
#: Their names in missions: input laws, solvers, and splits of the torque.
LAWS = {"open": OPEN, "tracking": TRACKING, "body": BODY}
SOLVERS = {"iterated": ITERATED, "spectral": SPECTRAL, "exact": EXACT, "pinv": PINV}
SPLITS = {"equal": PINV_EQUAL, "inertia": PINV_INERTIA, "inertia+force": PINV_INERTIA_FORCE}


class Vehicles(NamedTuple):
    """The agents: point masses."""

    m: PerAgent  # mass [kg]
    inverse: PerAgent  # of it [1/kg]
    M: float  # their sum [kg]
    mean: float  # mean mass of the agents not lost [kg]; the laws' unit of mass
    thrust_limit: PerAgent  # [N]; inf if unlimited
    saturate: bool  # clip the thrust at its limit
    g: float  # gravity along -z [m/s^2]


class Graph(NamedTuple):
    """The constraint graph, and the pairs of its edges that share an agent.

    ``pairs[p] = (k, l)``, k > l, are the edges that share an agent and ``weight[p]`` is what
    that agent adds to ``A = J M^-1 J^T``: ``A[k, l] = weight[p] * (u_k . u_l)``.
    """

    # agents from 0; unsigned, which makes an index cheaper
    edges: Annotated[Edges, Extents(("m", 2))]
    pairs: Annotated[Edges, Extents(("P", 2))]
    weight: Annotated[Floats, Extents(("P",))]  # +-1/m_i [1/kg]
    diagonal: PerEdge  # of A: 1/m_i + 1/m_j [1/kg]
    solver: int = 0  # address of the multiplier solver of a large formation (`large`)
    # if it finds the constraint force itself: address of what computes the multipliers of the last evaluation
    multipliers: int = 0


class ConstraintLaw(NamedTuple):
    """Baumgarte gains, and options of the multipliers' solver."""

    alpha: float  # [1/s]
    beta: float  # [1/s]
    gamma: float  # [1/s^3]
    solver: int
    mu: float  # Tikhonov damping, on the scale of the eigenvalues of mbar A
    iterations: int
    s0: float  # spectral damping starts below this eigenvalue of mbar A
    cutoff: float  # cut-off of pinv, as a share of the largest eigenvalue
    k_def: float  # deformation damping [1/s]


#: Ways of slots that only blend: none. One object for all, and of a type that all share.
NO_KNOTS, NO_WAYS = np.zeros(0), np.zeros((0, 0, 3, 4))


class Reference(NamedTuple):
    """Desired shape or distances, blended from one to another over [t0, t0 + T_b].

    If there are ``knots``, slots follow ``ways`` instead, piecewise polynomials from ``p0`` to ``p0 + dp`` over the
    same time. They have two continuous derivatives, up to the tolerances of the file or plan that they are from.
    """

    kind: int
    t0: float  # [s]
    T_b: float  # [s]
    d0: PerEdge  # distances before [m]
    d1: PerEdge  # distances after [m]
    p0: Places  # slots before, body axes [m]
    dp: Places  # what the blend adds to them [m]
    turn: Vector  # rotation vector by which the slots turn during the blend [rad]; zero with ``knots``
    knots: Floats = NO_KNOTS  # (K + 1,) [s], or empty
    # (K, N, 3, P): piece, slot in body axes [m], power of (t - knots[piece])
    ways: Floats = NO_WAYS


class Motion(NamedTuple):
    """Reference motion of the virtual body: piecewise polynomials of CM and attitude.

    Channels 0-2 are the CM [m], 3-5 the rotation vector phi [rad] of the body relative to the
    attitude ``T1``: body -> world is ``T1^T Exp(phi)``.
    """

    knots: Floats  # (n + 1,) [s]
    # (n, 6, P) piece, channel, power of (t - knots[piece]); quintics (P = 6) are fastest
    coefficients: Annotated[Floats, Extents((None, 6, None))]
    T1: Matrix  # world -> body


class Feedback(NamedTuple):
    """LQR of the virtual body: gain tables over the time to go, and the moving target."""

    to_go: Floats  # (n,) increasing, from 0 [s]
    gain: Annotated[Floats, Extents((None, 4))]  # position [1/s^2], velocity [1/s]; attitude, rate
    slope: Annotated[Floats, Extents((None, 4))]  # their derivatives with respect to the time to go
    arrival: float  # T [s]
    r: Vector  # target at T [m]
    v: Vector  # [m/s]
    T1: Matrix  # target attitude at T, world -> body
    omega: Vector  # target rates, body axes [rad/s]
    hold: Annotated[Floats, Extents((4,))]  # gains after T


#: A body at rest, and one that no regulator steers.
REST = Motion(np.zeros(2), np.zeros((1, 6, 6)), np.eye(3))
NO_FEEDBACK = Feedback(
    NO_KNOTS, np.zeros((0, 4)), np.zeros((0, 4)), 0.0, np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.zeros(4),
)  # fmt: skip


class Control(NamedTuple):
    """Input law of a phase. Other code asks what it does, not which it is."""

    kind: int
    tracks_slots: bool  # each agent tracks its slot: the law calls `control.desired_agents`
    leads_body: bool  # feedback leads the virtual body, from its mean axes to a wrench
    force: Places  # open loop: input force, weight balance included [N]
    k1: float  # local LQR [1/s^2]
    k2: float  # [1/s]
    allocation: int


class Disturbance(NamedTuple):
    """Disturbances of the flight, which no law knows; see `rigidfleet.kernel.disturbances`.

    Gusts and noise are coefficients of cubic B-splines over time; empty if there are none.
    """

    active: bool  # whether there is any disturbance; `inverse` is always used
    m: PerAgent  # true mass [kg]
    inverse: PerAgent  # of it [1/kg]
    drag: PerAgent  # [N s/m]
    wind: Vector  # steady, world [m/s]
    gust_step: float  # between knots [s]
    gust: PlacesInTime  # [m/s]
    noise_step: float  # [s]
    noise_r: PlacesInTime  # of the measured position [m]
    noise_v: PlacesInTime  # of the measured velocity [m/s]
    lost: Annotated[Bools, Extents(("N",))]  # without thrust
    floor: PerAgent  # height at which a lost vehicle comes to rest on the ground [m]
    radius: PerAgent  # by which this is above the ground [m]
    roofs: Solids  # boxes and height maps that are ground where they are below a vehicle


class External(NamedTuple):
    """A user's force, and how long a step may be so that none of it is missed."""

    address: int = 0  # of the callback; 0 for none
    max_step: float = math.inf  # longest step of the integrator [s]


class Problem(NamedTuple):
    """One phase of a flight."""

    body_formulation: bool
    has_frame: bool  # whether the mean-axis quaternion is among the states
    vehicles: Vehicles
    graph: Graph
    law: ConstraintLaw
    reference: Reference
    motion: Motion
    feedback: Feedback
    control: Control
    disturbance: Disturbance
    external: External = External()


class Workspace(NamedTuple):
    """Everything that the right-hand side writes; after a call it holds the values at that state."""

    r: Places  # position, world [m]
    v: Places  # velocity [m/s]
    r_seen: Places  # position as measured [m], if there is noise
    v_seen: Places  # velocity as measured [m/s], if there is noise
    u: Annotated[Floats, Extents(("m", 3))]  # unit vectors of the edges
    L: PerEdge  # lengths [m]
    d: PerEdge  # references [m]
    d_dot: PerEdge  # [m/s]
    d_ddot: PerEdge  # [m/s^2]
    c: PerEdge  # constraints [m]
    b: PerEdge  # right side of the multiplier equation [m/s^2]
    # J M^-1 J^T (m, m), or J^T J (3N, 3N); its lower triangle is factored in place
    A: Annotated[Floats, Extents(("A", "A"))]
    V: Annotated[Floats, Extents(("V", "V"))]  # (m, m) eigenvectors, if a law needs them
    w: PerEdge  # eigenvalues; work
    multiplier: PerEdge  # [N]
    f_E: Places  # gravity, the user's force and disturbances [N]
    f_u: Places  # input [N]
    f_C: Places  # constraint force [N]
    f_D: Places  # aerodynamic force, part of f_E, if there are disturbances [N]
    a: Places  # acceleration [m/s^2]
    p: Places  # slots, body axes [m]
    p_dot: Places
    p_ddot: Places
    r_ref: Places  # desired positions, world [m]
    v_ref: Places
    a_ref: Places
    # CM position, velocity; omega, h, world axes; omega, body axes
    cm: Annotated[Floats, Extents((5, 3))]
    I: Matrix  # inertia about the CM, world axes [kg m^2]
    I_inv: Matrix  # its pseudo-inverse
    T: Matrix  # world -> body, of the frame among the states
    # reference motion: r, v, a of the CM; omega, omega_dot; phi, its rates
    body: Annotated[Floats, Extents((8, 3))]
    gain: Annotated[Floats, Extents((4,))]
    E: Matrix  # a relative rotation
    T_ref: Matrix  # world -> body, of the reference motion
    # commanded: force, torque about the CM, world [N, N m]
    wrench: Annotated[Floats, Extents((6,))]
    H: Annotated[Floats, Extents(("H", "H"))]  # (3N, 3N) normal matrix of the paper's H; work
    H_V: Annotated[Floats, Extents(("H", "H"))]  # (3N, 3N)
    H_w: Annotated[Floats, Extents((2, "H"))]  # right side, eigenvalues


def septic_polynomial(x):
    """s = 35 x^4 - 84 x^5 + 70 x^6 - 20 x^7: from 0 to 1 over [0, 1], three derivatives vanishing at either end."""
    return x**4 * (35.0 - x * (84.0 - x * (70.0 - 20.0 * x)))


def zeros(*shape: int) -> Floats:
    """Zeros aligned to a cache line: rows that straddle lines would cost up to a tenth of the time."""
    size = math.prod(shape)
    memory = np.zeros(size + 8)
    skip = -memory.__array_interface__["data"][0] // memory.itemsize % 8
    return memory[skip : skip + size].reshape(shape)


def workspace(
    n: int, m: int, *, with_h: bool = False, solver: int | None = None, large: bool = False
) -> Workspace:
    """Allocate a workspace for N = ``n`` agents and ``m`` edges.

    If ``solver`` is the iterated one, only the smaller of its two systems is allocated, in the edges'
    or in the agents' coordinates; for a ``large`` formation, none is.
    """
    size = 0 if large else min(m, 3 * n) if solver == ITERATED else m
    vectors = 0 if large or solver in (ITERATED, EXACT) else m
    layout = _workspace_layout(n, m, size, vectors, 3 * n if with_h else 0)
    memory = np.ndarray((), layout, zeros(layout.itemsize // 8))
    w = Workspace(*[memory[name] for name in Workspace._fields])
    w.T[:] = w.T_ref[:] = np.eye(3)
    return w


def _workspace_layout(*sizes: int) -> np.dtype[Any]:
    """Arrays of extents N, m, A, V and H side by side in one memory, each aligned to a cache line."""
    size_of: dict[Any, int] = dict(zip("NmAVH", sizes, strict=True))
    shapes = [
        tuple(x if isinstance(x, int) else size_of[x] for x in extents)
        for extents in extents_of(Workspace).values()
    ]
    *starts, _ = accumulate((8 * padded(math.prod(shape)) for shape in shapes), initial=0)
    kinds = [(float, shape) for shape in shapes]
    return np.dtype({"names": Workspace._fields, "formats": kinds, "offsets": starts})


def padded(count: int) -> int:
    """``count`` rounded up to a multiple of 8: the numbers in a cache line, and the lanes of a `lanes` value."""
    return -(-count // 8) * 8


def no_disturbance(masses: Floats) -> Disturbance:
    """A `Disturbance` without any effect on agents with these masses (N,) [kg]."""
    n = len(masses)
    none = zeros(0, n, 3)
    return Disturbance(
        False, masses, 1.0 / masses, np.zeros(n), np.zeros(3), 1.0, none, 1.0, none, none, np.zeros(n, dtype=np.bool_),
        np.full(n, -np.inf), np.zeros(n), join_solids([]),
    )  # fmt: skip


def graph(ends: NDArray[np.integer], masses: Floats, *, large: bool = False) -> Graph:
    """Prepare a constraint graph: edges (m, 2) with agents from 0, (N,) masses [kg].

    A ``large`` graph is not solved densely and needs no pairs of edges.
    """
    edges = np.ascontiguousarray(ends, dtype=np.uint32).reshape(-1, 2)
    if large:
        return Graph(edges, np.zeros((0, 2), dtype=np.uint32), np.zeros(0), np.zeros(0))
    A, inverse = np.zeros((len(edges), len(edges))), 1.0 / masses
    k, l, end, other = np.nonzero(edges[:, None, :, None] == edges[:, None])
    np.add.at(A, (k, l), np.where(end == other, 1.0, -1.0) * inverse[edges[k, end]])
    pairs = np.ascontiguousarray(np.argwhere(np.tril(A, -1)), dtype=np.uint32)
    return Graph(edges, pairs, A[tuple(pairs.T)], A.diagonal().copy())
