"""Avoidance in flight as arrays, read and written by `barriers` and `guard`.

N vehicles, m edges, B obstacles. A vehicle can always brake with b [m/s^2]. Its *stop segment* S reaches from its
position to where it would come to rest. Two vehicles are kept D apart, and a vehicle R from an obstacle, both between
centres and surfaces: D and R contain the radii.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.solids.records import CYLINDER, HEIGHTS, Solids, join_solids
from rigidfleet.typing import Floats, Ints

#: Columns of `AvoidanceArrays.count`: ticks, entries of the list of neighbours, whether the list is too short.
TICKS, LISTED, FULL = range(3)
#: Columns of `AvoidanceArrays.acted` and `AvoidanceArrays.first`: the barrier, the guard, the guard by braking.
BARRIER, GUARD, BRAKE = range(3)
#: Bits of `SampledState.layers`, of the same three.
ACTS = (1, 2, 4)
#: Rows of `AvoidanceArrays.margin`: between two vehicles, between a vehicle and an obstacle.
PAIR, OBSTACLE = range(2)
#: What is known of an obstacle that moves: nothing, its place, or its velocity, too; see `Sight.known`.
UNKNOWN, FOLLOWED, KNOWN = range(3)
#: Number of random numbers that measurements take in turn; prime, so that obstacles and axes share no pattern.
_DRAWS = 65_521
#: Mean number of neighbours in a large fleet at most, and number of vehicles up to which all pairs fit.
_NEIGHBOURS, _FEW = 256, 400
#: Greatest number of barriers between vehicles at a tick, per vehicle; more are left to the guard.
_BARRIERS = 32
#: Distance that counts as none [m].
_NEAREST = 1e-6
#: Greatest number of rows of an exact solution of the barriers.
MOST_ROWS = 64


class Sight(NamedTuple):
    """What is known of B obstacles, as displacements from where they stand in `AvoidanceArrays.solids`."""

    moves: Ints  # (B,) 1 if it moves
    reach: float  # distance from a vehicle within which an obstacle is seen [m]; infinity: known in advance
    noise: float  # standard deviation of a measured place along each axis [m]
    swerve: float  # acceleration of obstacles that is reckoned with [m/s^2]
    normals: Floats  # (D,) standard normal numbers, taken in turn
    centre: Floats  # (B, 3) middle of a ball that holds the obstacle, where it stands [m]
    ball: Floats  # (B,) its radius [m]
    known: Ints  # (B,) see `UNKNOWN`
    track: Floats  # (B, 6) estimated displacement [m] and velocity [m/s]
    spread: Floats  # (B, 3) variance of place, covariance of place and velocity, variance of velocity, of each axis
    bound: Floats  # (B, 2) three standard deviations of place [m] and velocity [m/s]


def initial_sight(
    solids: Solids,
    reach: float = math.inf,
    noise: float = 0.0,
    swerve: float = 0.0,
    seed: int = 0,
) -> Sight:
    """What is known of obstacles before the flight: nothing of those that move; see `Sight`."""
    count = len(solids.kind)
    moves = solids.last[:count, 3] > solids.first[:count, 3]  # also what appears or vanishes
    drawn = np.random.default_rng(seed).standard_normal(_DRAWS) if noise else np.zeros(1)
    centre, radius = np.zeros((count, 3)), np.zeros(count)
    for o in range(count):
        centre[o], radius[o] = _bounding_ball(solids, o)
    return Sight(
        moves=moves.astype(np.int64), reach=float(reach), noise=float(noise), swerve=float(swerve), normals=drawn,
        centre=centre, ball=radius, known=np.full(count, UNKNOWN), track=np.zeros((count, 6)),
        spread=np.zeros((count, 3)), bound=np.zeros((count, 2)),
    )  # fmt: skip


def _bounding_ball(solids: Solids, o: int) -> tuple[Floats, float]:
    """Middle (3,) and radius [m] of a ball that holds obstacle o; the radius of a ground or terrain is infinite."""
    size, origin = solids.size[o], solids.origin[o]
    if solids.kind[o] == CYLINDER:
        return origin, float(np.hypot(size[0], size[1]))
    if solids.kind[o] == HEIGHTS or not np.isfinite(size).all():
        return origin, math.inf
    half = float(0.5 * np.linalg.norm(size[3:] - size[:3]))
    return origin + 0.5 * (size[:3] + size[3:]) @ solids.turn[o], half + float(solids.rounding[o])


class AvoidanceArrays(NamedTuple):
    """What avoidance reads and writes at the ticks of the formation's law; K candidates, P entries of neighbours."""

    law: Ints  # (2,) addresses of the `Problem` whose law gave the forces, and of its `Workspace`
    guarded: bool
    filtered: bool
    period: float  # for which a command is held [s]
    rate: float  # at which a barrier is approached [1/s]
    share: float  # of the braking that the barrier plans with [-]
    release: float  # time in which edges let go and take hold again [s]
    b: Floats  # (N,) acceleration in any direction that each vehicle always has [m/s^2]
    lift: Floats  # (N,) greatest thrust per mass [m/s^2]
    weight: Floats  # (N,) mass that the laws know [kg]
    inverse: Floats  # (N,) its inverse [1/kg]
    g: float  # [m/s^2]
    coast: Floats  # (N, 3) of the drag k per mass over a period T: e^-kT, (1 - e^-kT)/k, (T - (1 - e^-kT)/k)/k
    lag: Floats  # (N,) time until a command acts [s]
    ahead: Floats  # (N, 3, 3) lags of each axis: a1 [s], a2 [s^2], of the guard's commands [s]; 0 of points
    lead: Floats  # (N, 3) by which the point that obeys at once is ahead [s]
    requested: Floats  # (N, 3) acceleration that the laws ask for [m/s^2]
    commanded: Floats  # (N, 3) acceleration last commanded [m/s^2]
    overruled: Ints  # (N,) 1 if that was not what the laws asked for
    soft: Floats  # (N,) speed below which braking fades [m/s]
    tilt: Floats  # (N,) greatest tilt of the thrust [rad]
    spare: Floats  # (N,) by which D and R are widened [m]
    room: Floats  # (N,) radius, and half of the separation to keep [m]
    reach: Floats  # (N,) radius, and the clearance to keep [m]
    solids: Solids  # (B,) convex obstacles
    sight: Sight  # those of them that move
    flow: bool  # whether what vehicles are asked for flows round obstacles
    candidates: Floats  # (K, 3) accelerations that replace a refused one, in units of b
    # Neighbours
    start: Ints  # (N + 1,) those of vehicle i are at start[i] to start[i + 1]
    near: Ints  # (P,)
    floor: Floats  # (P,) distance of the stop segments to keep [m]
    order: Ints  # (N,) vehicles along an axis
    listed: Floats  # (N, 3) positions when they were listed [m]
    span: Floats  # (3,) for what the list holds: ways since then [m], speeds [m/s], accelerations asked for [m/s^2]
    # The tick
    known: Floats  # (3, N, 3) measured positions and velocities; pushes of barriers [N]
    wanted: Floats  # (N, 3) acceleration asked for, without drag [m/s^2]
    shift: Floats  # (N, 3) by which barriers change it [m/s^2]
    chosen: Floats  # (N, 3) acceleration given [m/s^2]
    rise: Floats  # (N, 3) acceleration at the start of the tick, with drag [m/s^2]
    ways: Floats  # (N, 6, 3) present choice: point led, after the tick, stop point; stop point without a tick; behind
    behind: Floats  # (N,) how far the place is from the position [m]
    far: Floats  # (N,) distance from its position that a vehicle cannot leave in the tick and by braking after it [m]
    walls: Floats  # (N, B) distance of the stop segment from an obstacle to keep [m]
    threat: Ints  # (N,) a known obstacle that moves, the one that leaves the least room; -1 if none
    late: Floats  # (N,) by which its stop segment comes nearer than it should to this obstacle, negative [m]
    shifted: (
        Floats  # (4, 3) work: a way relative to an obstacle that moves, and the relative velocity
    )
    trial: Floats  # (5, 3) the same of a candidate; its acceleration; at the start of the tick
    normal: Floats  # (3,)
    # Barriers: W rows
    rows: Ints  # (W, 3) vehicle, the other or -1, entry of ``last``
    normals: Floats  # (W, 3)
    missing: Floats  # (W,) acceleration along them that is needed, less what is asked for [m/s^2]
    reduced: Floats  # (W,) reduced mass of the two [kg]
    push: Floats  # (W,) kappa [N]
    most: Floats  # (W,) greatest one [N]
    last: Floats  # (P + 2 N B,) those of the tick before, of neighbours and of obstacles [N]
    pushing: Ints  # (W,) work: rows that push
    hold: Floats  # (N,) share to which edges of a vehicle hold
    pull: Floats  # (m,) what barriers add to the multipliers of edges [N]
    system: Floats  # (MOST_ROWS, MOST_ROWS) work
    right: Floats  # (MOST_ROWS,)
    active: Ints  # (MOST_ROWS,)
    # The record
    count: Ints  # (3,) see `TICKS`
    acted: Ints  # (3, N) ticks at which each acted on a vehicle, see `BARRIER`
    first: Floats  # (3, N) time of the first one [s], infinity if none
    margin: (
        Floats  # (2, 2) least of dist(S, S) - D, of dist(S, obstacle) - R [m], and their times [s]
    )
    between: Ints  # (2, 2) vehicle, and the other or the obstacle
    lost: Floats  # (2, 2) time at which a margin first was negative [s], infinity if none; and its value [m]
    loser: Ints  # (2, 2) vehicle, and the other or the obstacle


def avoidance_arrays(
    *,
    period: float,
    b: Floats,
    lift: Floats,
    mass: Floats,
    g: float,
    radius: Floats,
    solids: Solids | None = None,
    separation: float = 0.0,
    clearance: float = 0.0,
    drag: ArrayLike = 0.0,
    lag: ArrayLike = 0.0,
    ahead: ArrayLike = 0.0,
    tilt: ArrayLike = math.inf,
    spare: ArrayLike = 0.0,
    rate: float = 3.0,
    share: float = 0.9,
    release: float = 0.5,
    guarded: bool = True,
    filtered: bool = True,
    flow: bool = False,
    seen: Sight | None = None,
    edges: int = 0,
) -> AvoidanceArrays:
    """Avoidance of a fleet; see `AvoidanceArrays`. ``drag`` [1/s], ``lag`` and ``spare`` are one for all, or (N,).

    Obstacles that move are known in advance, without ``seen``.
    """
    solids = join_solids([]) if solids is None else solids
    n, count = len(b), len(solids.kind)
    capacity = n * (n - 1) if n <= _FEW else _NEIGHBOURS * n
    radius = np.asarray(radius, dtype=float)
    lags: Floats = np.ascontiguousarray(np.broadcast_to(np.asarray(ahead, dtype=float), (n, 3, 3)))
    return AvoidanceArrays(
        law=np.zeros(2, dtype=np.int64), guarded=guarded, filtered=filtered, period=float(period), rate=float(rate),
        share=float(share), release=float(release), b=_per_agent(b, n), lift=_per_agent(lift, n),
        weight=_per_agent(mass, n), inverse=1.0 / _per_agent(mass, n),
        g=float(g), coast=_coast_coefficients(_per_agent(drag, n), period),
        lag=_per_agent(lag, n), spare=_per_agent(spare, n),
        ahead=lags, lead=lags[:, :, 0] + lags[:, :, 2], soft=np.where(lags[:, 0, 0] > 0.0, b * np.asarray(lag), 0.0),
        tilt=_per_agent(tilt, n), requested=np.zeros((n, 3)), commanded=np.where(lags[:, :, 0] > 0.0, np.inf, 0.0),
        overruled=np.zeros(n, dtype=np.int64),
        room=radius + 0.5 * separation, reach=radius + clearance,
        solids=solids, sight=initial_sight(solids) if seen is None else seen, flow=flow,
        candidates=candidate_accelerations(),
        start=np.zeros(n + 1, dtype=np.int64), near=np.zeros(capacity, dtype=np.int64), floor=np.zeros(capacity),
        order=np.arange(n), listed=np.full((n, 3), np.inf), span=np.zeros(3),
        known=np.zeros((3, n, 3)), wanted=np.zeros((n, 3)), shift=np.zeros((n, 3)),
        chosen=np.zeros((n, 3)), rise=np.zeros((n, 3)), ways=np.zeros((n, 6, 3)),
        behind=np.zeros(n), far=np.zeros(n), threat=np.full(n, -1),
        late=np.zeros(n), shifted=np.zeros((4, 3)), trial=np.zeros((5, 3)), normal=np.zeros(3),
        hold=np.ones(n), pull=np.zeros(edges),
        system=np.zeros((MOST_ROWS, MOST_ROWS)), right=np.zeros(MOST_ROWS), active=np.zeros(MOST_ROWS, dtype=np.int64),
        count=np.zeros(3, dtype=np.int64), **_barrier_arrays(n, count), **_empty_avoidance_record(n),
    )  # fmt: skip


def for_next_phase(avoidance: AvoidanceArrays) -> AvoidanceArrays:
    """The same avoidance in the next phase, which has a record of its own."""
    avoidance.count[TICKS] = 0
    return avoidance._replace(**_empty_avoidance_record(len(avoidance.b)))


def avoidance_among(avoidance: AvoidanceArrays, all_solids: Solids) -> AvoidanceArrays:
    """The same avoidance among other obstacles; the first of them are those before, and what is known of them stays."""
    before = avoidance.sight
    seen = initial_sight(all_solids, before.reach, 0.0, before.swerve)
    seen = seen._replace(noise=before.noise, normals=before.normals)
    for mine, old in zip(seen[-4:], before[-4:], strict=True):  # what is known
        mine[: len(old)] = old
    return avoidance._replace(
        solids=all_solids, sight=seen, **_barrier_arrays(len(avoidance.b), len(all_solids.kind))
    )


def _barrier_arrays(n: int, obstacles: int) -> dict[str, Any]:
    """Arrays whose size depends on the number of obstacles."""
    capacity = n * (n - 1) if n <= _FEW else _NEIGHBOURS * n
    rows = min(capacity // 2, _BARRIERS * n) + 2 * n * obstacles
    return {
        "walls": np.zeros((n, obstacles)), "rows": np.zeros((rows, 3), dtype=np.int64), "normals": np.zeros((rows, 3)),
        "missing": np.zeros(rows), "reduced": np.zeros(rows), "push": np.zeros(rows), "most": np.zeros(rows),
        "last": np.zeros(capacity + 2 * n * obstacles), "pushing": np.zeros(rows, dtype=np.int64),
    }  # fmt: skip


def with_edges(avoidance: AvoidanceArrays, edges: int) -> AvoidanceArrays:
    """The same avoidance for so many other edges; neighbours are listed again."""
    avoidance.count[LISTED] = 0
    return avoidance._replace(pull=np.zeros(edges))


def _empty_avoidance_record(n: int) -> dict[str, Any]:
    none = np.full((2, 2), -1)
    endless = np.array([[math.inf, 0.0]] * 2)
    return {
        "acted": np.zeros((3, n), dtype=np.int64), "first": np.full((3, n), np.inf), "margin": endless,
        "between": none, "lost": endless.copy(), "loser": none.copy(),
    }  # fmt: skip


def needed_gap_acceleration(gap, gap_rate, centrifugal, B, rate, soft=0.0):
    """Least second derivative of a distance by a barrier, see `barriers`; ``centrifugal``: the part that motion gives.

    For numbers and arrays: the gap to what is to be kept [m], its rate, the braking B to reckon with, and the speed
    below which it fades.
    """
    safe = np.maximum(gap, _NEAREST - 0.5 * soft * soft / B)
    root = np.sqrt(2.0 * B * safe + soft * soft)
    return -rate * (root - soft + gap_rate) - B * gap_rate / root - centrifugal


def _per_agent(x: ArrayLike, n: int) -> Floats:
    return np.ascontiguousarray(np.broadcast_to(np.asarray(x, dtype=float), (n,)))


def _coast_coefficients(drag_rate: Floats, period: float) -> Floats:
    """Coefficients (N, 3) of a motion under a held acceleration and linear drag; see `AvoidanceArrays.coast`."""
    x = drag_rate * period
    E = np.exp(-x)
    small = x < 0.05
    safe = np.where(small, 1.0, drag_rate)
    # Where the differences would cancel, the series 1/2 - x/6 + x^2/24 - ...
    series = np.ones_like(x)
    for order in range(12, 0, -1):
        series = 1.0 - x / (order + 2) * series
    second = np.where(small, 0.5 * period * period * series, (period + np.expm1(-x) / safe) / safe)
    first = np.where(small, period - drag_rate * second, -np.expm1(-x) / safe)
    return np.stack([E, first, second], axis=1)


def candidate_accelerations() -> Floats:
    """Accelerations (39, 3) in units of b: 26 directions and 12 weaker ones, spread evenly, and none."""

    def spread_directions(count: int) -> Floats:
        i = np.arange(count) + 0.5  # a Fibonacci lattice
        polar, angle = np.arccos(1.0 - 2.0 * i / count), math.pi * (1.0 + math.sqrt(5.0)) * i
        across = np.sin(polar)
        return np.stack([across * np.cos(angle), across * np.sin(angle), np.cos(polar)], axis=1)

    return np.concatenate([spread_directions(26), 0.4 * spread_directions(12), np.zeros((1, 3))])
