"""One tick of guard and barriers, against what follows in continuous time: sampled densely, or in closed form."""

import math
from itertools import combinations
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation
from vehicle_samples import PAPER, begun

from rigidfleet.kernel import barriers, fleet, guard
from rigidfleet.kernel.avoidance import (
    BARRIER,
    BRAKE,
    GUARD,
    OBSTACLE,
    PAIR,
    avoidance_arrays,
    candidate_accelerations,
    initial_sight,
)
from rigidfleet.kernel.engine import sampled
from rigidfleet.kernel.problem import graph, workspace
from rigidfleet.solids.records import ball, box, half_space, join_solids, one_solid

#: Period of the commands [s].
T = 0.1
#: Acceleration by which all brake [m/s^2], and radius of all [m].
B, RADIUS = 5.0, 0.3
#: By how much a candidate keeps its distances if there is no doubt that the guard accepts it [m].
SURE = 0.03


class Crowd:
    """Vehicles that are given accelerations tick by tick: points, or quadrotors."""

    def __init__(
        self, n: int, *, model: Any = None, edges: Any = (), g: float = 0.0, **options: Any
    ) -> None:
        point = fleet.VehicleDynamics(1.0, point=True)
        self.problem, self.work, self.flight, self.state = begun([model or point] * n)
        every: dict[str, Any] = {
            "period": T,
            "b": B,
            "lift": 50.0,
            "mass": 1.0,
            "radius": RADIUS,
        } | options
        for name in ("b", "lift", "mass", "radius"):
            every[name] = np.broadcast_to(np.asarray(every[name], dtype=float), n).copy()
        if len(edges):
            self.problem = self.problem._replace(graph=graph(np.array(edges), every["mass"]))
            self.work = workspace(n, len(edges))
            S = np.zeros((n, fleet.STATES))
            self.state = fleet.initial_state(self.flight, S, self.work)
        self.a = avoidance_arrays(g=g, edges=len(edges), **every)

    def __call__(self, r: Any, v: Any, asked: Any, t: float = 0.0) -> np.ndarray:
        """Accelerations (N, 3) that are given at t [s] for some asked for."""
        s, a = self.state, self.a
        s.seen[:, :3], s.seen[:, 3:] = r, v
        s.force[:] = a.weight[:, None] * (np.asarray(asked) + [0.0, 0.0, a.g])
        s.work.law_time[0] = t
        assert sampled.correct_forces(self.problem, self.work, self.flight, s, a)
        return s.force / a.weight[:, None] - [0.0, 0.0, a.g]


def course(r: Any, v: Any, c: Any, drag: float, t: Any) -> tuple[np.ndarray, np.ndarray]:
    """Places and velocities (K, 3) at times (K,) under a held acceleration and linear drag, in closed form."""
    t = np.asarray(t, dtype=float)[:, None]
    if drag == 0.0:
        return r + v * t + 0.5 * c * t * t, v + c * t
    E = np.exp(-drag * t)
    return r + v * (1 - E) / drag + c * (t - (1 - E) / drag) / drag, v * E + c * (1 - E) / drag


def way_to_rest(u: float, lag: float = 0.0) -> float:
    """Way [m] to rest with commands held for a period, tick by tick."""
    way = lag * u
    while u > 0.0:
        b = min(B, u / T)
        way, u = way + T * (u - 0.5 * b * T), u - b * T
        u = 0.0 if u < 1e-12 else u
    return way


def stop(r: np.ndarray, v: np.ndarray, lag: float = 0.0) -> np.ndarray:
    """The stop segment (2, 3) of a vehicle."""
    speed = float(np.linalg.norm(v))
    return np.array([r, r + way_to_rest(speed, lag) / max(speed, 1e-12) * v])


def apart(P: np.ndarray, Q: np.ndarray) -> float:
    """Least distance of the hulls of points (P, 3) and (Q, 3), by non-negative least squares."""
    heavy, m, n = 1e4, len(P), len(Q)
    A = np.vstack([np.hstack([P.T, -Q.T]), heavy * np.r_[np.ones(m), np.zeros(n)],
                   heavy * np.r_[np.zeros(m), np.ones(n)]])  # fmt: skip
    return nnls(A, np.array([0.0, 0.0, 0.0, heavy, heavy]))[1]


#: Obstacles that stand still: a corner of a box, a ball and the ground; each with its distance from points (K, 3).
LOW, HIGH, MIDDLE, SIZE, GROUND = (
    np.array([0.9, -9, -9.0]),
    np.array([9, 0.5, 9.0]),
    np.array([-1.6, 0.3, 0.2]),
    0.6,
    -1.3,
)
SOLIDS = box(LOW, HIGH), ball(MIDDLE, SIZE), half_space(GROUND)
WALLS = join_solids([one_solid(solid) for solid in SOLIDS])


def from_walls(x: np.ndarray) -> list[np.ndarray]:
    beyond = np.linalg.norm(np.maximum(np.maximum(LOW - x, x - HIGH), 0.0), axis=1)
    return [beyond, np.linalg.norm(x - MIDDLE, axis=1) - SIZE, x[:, 2] - GROUND]


def along(segment: np.ndarray) -> np.ndarray:
    return segment[0] + np.linspace(0.0, 1.0, 41)[:, None] * (segment[1] - segment[0])


def braking(v: np.ndarray, drag: float) -> np.ndarray:
    """What a vehicle brakes by: b, or what brings it to rest at the end of the tick."""
    speed = float(np.linalg.norm(v))
    rest = speed / T if drag == 0.0 else speed * drag / math.expm1(drag * T)
    return -min(B, rest) / max(speed, 1e-12) * v


class Judge:
    """By how much candidates keep their distances, from the motion over the tick and the stop segments after it."""

    def __init__(
        self, r: np.ndarray, v: np.ndarray, drag: float, need: float, beside: float | None
    ) -> None:
        self.r, self.v, self.drag = r, v, drag
        self.now = [braking(x, drag) for x in v]
        self.times = np.linspace(0.0, T, 21)
        segments = [stop(x, y) for x, y in zip(r, v, strict=True)]
        self.kept = {
            (i, j): apart(segments[i], segments[j]) for i, j in combinations(range(len(r)), 2)
        }
        self.floor = {pair: min(need, kept) for pair, kept in self.kept.items()}
        self.beside = [
            [min(d.min(), beside) for d in from_walls(along(s))] if beside else [] for s in segments
        ]

    def way(self, i: int, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        places, velocities = course(self.r[i], self.v[i], c, self.drag, self.times)
        return places, stop(places[-1], velocities[-1])

    def room(self, i: int, c: np.ndarray) -> float:
        """The least by which vehicle i with c keeps its distances from the others' present choices, and from walls."""
        places, segment = self.way(i, c)
        rooms = [np.inf]
        for j in range(len(self.r)):
            if j != i:
                other, its = self.way(j, self.now[j])
                least = min(np.linalg.norm(places - other, axis=1).min(), apart(segment, its))
                rooms.append(least - self.floor[min(i, j), max(i, j)])
        for walls in from_walls(np.vstack([places, along(segment)])) if self.beside[i] else ():
            rooms.append(walls.min() - self.beside[i][len(rooms) - len(self.r)])
        return min(rooms)


@pytest.mark.parametrize("drag", [0.0, 0.8])
@pytest.mark.parametrize("walls", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_each_takes_the_nearest_of_its_accelerations_that_keeps_all_distances(seed, walls, drag):
    """In turn, each takes what it wants or the nearest candidate that is safe beyond doubt, or one still nearer.

    What it takes keeps the distances that the stop segments have, or should have, in continuous time.
    """
    rng = np.random.default_rng(seed)
    acted = 0
    for _ in range(3):
        n = 3
        r, v = rng.uniform(-0.7, 0.7, (n, 3)), rng.normal(0.0, 0.8, (n, 3))
        asked = rng.normal(0.0, 6.0, (n, 3))
        crowd = Crowd(
            n,
            solids=WALLS if walls else None,
            separation=0.1,
            clearance=0.1,
            drag=drag,
            filtered=False,
        )
        took = crowd(r, v, asked, t=0.7)
        judge = Judge(r, v, drag, 2 * RADIUS + 0.1, RADIUS + 0.1 if walls else None)
        a = crowd.a
        for i in (1, 2, 0):
            menu = [asked[i], *(B * candidate_accelerations()), judge.now[i]]
            off = [np.linalg.norm(c - asked[i]) for c in menu]
            mine = int(np.argmin([np.linalg.norm(c - took[i]) for c in menu]))
            assert took[i] == pytest.approx(menu[mine], abs=1e-9)
            brakes = mine == len(menu) - 1
            if not brakes:
                assert judge.room(i, took[i]) >= -1e-7
            for c, far in zip(menu[:-1], off[:-1], strict=True):
                if far < off[mine] - 1e-9 or brakes:
                    assert judge.room(i, c) < SURE
            acted += mine > 0
            layers = [a.acted[GUARD, i], a.acted[BRAKE, i]]
            assert layers == [mine > 0, brakes]
            assert a.first[GUARD, i] == (0.7 if mine > 0 else np.inf)
            judge.now[i] = took[i]
        margin = {pair: kept - 2 * RADIUS - 0.1 for pair, kept in judge.kept.items()}
        nearest = min(margin, key=lambda pair: margin[pair])
        assert a.margin[PAIR, 0] == pytest.approx(margin[nearest], abs=1e-6)
        assert tuple(a.between[PAIR]) == nearest
        assert a.margin[PAIR, 1] == 0.7
    assert acted > 0


@pytest.mark.parametrize("seed", range(4))
def test_who_passes_beside_another_is_left_alone(seed):
    """Two that pass each other within a tick, straight on and far enough apart, may go on; a little nearer, not.

    They are nearest somewhere in the tick, of which a bound from either end would be of no use.
    """
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(2.0 * rng.normal(size=3))
    part = rng.uniform(0.3, 0.7)
    for gap, free in ((2 * RADIUS + 0.15, True), (2 * RADIUS - 0.05, False)):
        # Beyond the stop points of both, they would have met long before if they could not pass.
        r = turn.apply([[-1.2 * part, 0.5 * gap, 0], [1.2 * part, -0.5 * gap, 0]])
        v = turn.apply([[6.0, 0, 0], [-6.0, 0, 0]])
        crowd = Crowd(2, filtered=False, b=60.0)
        crowd(r, v, np.zeros((2, 3)))
        assert (crowd.a.acted[GUARD].sum() == 0) == free


@pytest.mark.parametrize("drag", [0.0, 0.8])
def test_who_brakes_just_in_time_may_also_fly_along_the_wall(drag):
    """It comes to rest above the ground within the tick, which no other candidate than the one asked for does as well.

    What rises over the tick makes its way bend away from the ground: it counts whole.
    """
    for speed in (0.1, 0.4):
        v, way = np.array([0.0, 0.0, -speed]), speed * T / 2.0 + 0.002
        ask = -braking(v, drag)[2] * np.array([0.0, 0.0, -1.0]) + [3.0, 0.0, 0.0]
        crowd = Crowd(1, solids=one_solid(half_space(0.0)), filtered=False, drag=drag)
        took = crowd([[0.0, 0.0, RADIUS + way]], [v], [ask])
        assert took == pytest.approx(ask[None], abs=1e-9)
        assert crowd.a.acted[GUARD].sum() == 0


def test_who_is_left_alone_has_the_very_force_that_was_asked_for():
    """To the bit, also beyond its thrust, if nothing is near: avoidance that has nothing to do changes nothing."""
    rng = np.random.default_rng(4)
    r, v = 100.0 * np.arange(12.0).reshape(4, 3), rng.normal(size=(4, 3))
    for flow in (False, True):
        crowd = Crowd(4, g=9.81, lift=14.0, flow=flow, mass=1.3)
        crowd(r, v, 9.0 * rng.normal(size=(4, 3)))
        force = 11.0 * rng.normal(size=(4, 3))
        crowd.state.force[:] = force
        assert sampled.correct_forces(crowd.problem, crowd.work, crowd.flight, crowd.state, crowd.a)
        assert np.array_equal(crowd.state.force, force)


def test_margins_are_the_least_so_far_and_the_first_that_is_lost():
    """Of two that come nearer and part, and of one beside a ball: the least margin, and the first negative one."""
    things = one_solid(ball([0.0, 0, 5.0], 1.0))
    crowd = Crowd(2, solids=things, filtered=False, separation=0.2, clearance=0.1)
    gaps, heights = [1.2, 0.75, 0.5, 0.9], [3.4, 3.8, 3.3, 3.75]
    for k, (gap, z) in enumerate(zip(gaps, heights, strict=True)):
        crowd([[0.0, 0, z], [gap, 0, z]], np.zeros((2, 3)), np.zeros((2, 3)), t=k * T)
    a = crowd.a
    assert a.margin[PAIR] == pytest.approx([0.5 - 0.8, 2 * T])
    assert a.lost[PAIR] == pytest.approx([T, 0.75 - 0.8])
    assert a.margin[OBSTACLE] == pytest.approx([5.0 - 3.8 - 1.0 - 0.4, T])
    assert a.lost[OBSTACLE] == pytest.approx([T, 5.0 - 3.8 - 1.0 - 0.4])
    assert [*a.between[PAIR], *a.loser[PAIR]] == [0, 1, 0, 1]
    assert [*a.between[OBSTACLE], *a.loser[OBSTACLE]] == [0, 0, 0, 0]


@pytest.mark.parametrize("seed", range(6))
def test_who_is_nearer_to_an_obstacle_than_it_should_be_comes_no_nearer(seed):
    """Past a ball, with less room than should be kept, and asked to fly into it: the stop segment keeps what it has."""
    rng = np.random.default_rng(seed)
    crowd = Crowd(1, solids=one_solid(ball(np.zeros(3), 0.7)), clearance=0.3, filtered=False)
    n = rng.normal(size=3)
    n /= np.linalg.norm(n)
    t = np.cross(n, rng.normal(size=3))
    t /= np.linalg.norm(t)
    r, v = (
        n * (1.0 + rng.uniform(0.05, 0.29)) - t * rng.uniform(0.2, 1.2),
        t * rng.uniform(1.0, 4.0),
    )
    kept = []
    for k in range(20):
        first, last = stop(r, v)
        way = last - first
        share = np.clip(-(first @ way) / (way @ way), 0.0, 1.0)
        kept.append(float(np.linalg.norm(first + share * way)) - 1.0)
        (c,) = crowd([r], [v], [-8.0 * r / np.linalg.norm(r)], t=k * T)
        (r,), (v,) = course(r, v, c, 0.0, [T])
    assert kept[0] < 0.3
    assert min(kept) >= kept[0] - 1e-6
    assert crowd.a.margin[OBSTACLE, 0] == pytest.approx(min(kept) - 0.3, abs=1e-6)


class Beside:
    """One vehicle beside a ball at the origin, of a constant velocity w, in the frame of the ball."""

    size = 0.7

    def __init__(self, r: np.ndarray, v: np.ndarray, w: np.ndarray, drag: float) -> None:
        self.r, self.v, self.w, self.drag = r, v, w, drag
        self.b = B - drag * float(
            np.linalg.norm(w)
        )  # drag at the velocity of the ball takes from the braking
        self.u = v - w
        self.kept = self.away(along(self.rest(r, self.u)))
        self.floor = min(RADIUS + 0.1, self.kept)

    def away(self, x: np.ndarray) -> float:
        return float(np.linalg.norm(x, axis=1).min()) - self.size

    def rest(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The stop segment of a relative motion, in closed form: whole periods, then one to rest."""
        fast, change = float(np.linalg.norm(y)), self.b * T
        whole = math.floor(fast / change)
        length = T * (whole * (fast - 0.5 * whole * change) + 0.5 * (fast - whole * change))
        return np.array([x, x + length / max(fast, 1e-12) * y])

    def room(self, c: np.ndarray) -> float:
        """By how much an acceleration keeps the distance over the tick, and by braking after it."""
        times = np.linspace(0.0, T, 41)
        places, velocities = course(self.r, self.v, c, self.drag, times)
        places = places - self.w * times[:, None]
        after = along(self.rest(places[-1], velocities[-1] - self.w))
        return min(self.away(places), self.away(after)) - self.floor

    def miss(self, c: np.ndarray) -> float:
        """Least distance with an acceleration held, until twice the time of the nearest approach without it."""
        until = max(T, min(-2.0 * (self.r @ self.u) / (self.u @ self.u), 3.0))
        t = np.linspace(until / 12, until, 111)[:, None]
        return self.away(self.r + t * self.u + 0.5 * t * t * c)

    def braking(self) -> np.ndarray:
        """What brakes relative to the ball, and bears the drag that the vehicle has at its velocity."""
        speed = float(np.linalg.norm(self.u))
        rest = speed / T if self.drag == 0.0 else speed * self.drag / math.expm1(self.drag * T)
        return self.drag * self.w - min(self.b, rest) * self.u / speed


@pytest.mark.parametrize("drag", [0.0, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_beside_a_ball_that_moves_the_relative_motion_keeps_the_distance(seed, drag):
    """The nearest candidate is taken that keeps the distance to the ball, or the one that it has; else what misses it.

    Too late to brake, it is what would miss it most if it were held.
    """
    rng = np.random.default_rng(seed)
    judged, evaded = 0, 0
    for k in range(12):
        w, ends, way = rng.normal(0.0, 1.2, 3), np.array([0.0, 60.0]), rng.normal(size=3)
        r, v = way / np.linalg.norm(way) * rng.uniform(1.2, 1.8), rng.normal(0.0, 0.8, 3)
        asked = rng.normal(0.0, 6.0, 3)
        if k % 3 == 0:  # straight at the vehicle, too fast to brake
            w = w + 3.5 * way / np.linalg.norm(way)
        thing = one_solid(ball(np.zeros(3), Beside.size), ends, np.outer(ends, w))
        crowd = Crowd(1, solids=thing, clearance=0.1, drag=drag, filtered=False)
        (took,) = crowd([r], [v], [asked])
        of = Beside(r, v, w, drag)
        menu = [asked, *(B * candidate_accelerations()), of.braking(), braking(v, drag)]
        off = [np.linalg.norm(c - asked) for c in menu]
        mine = int(np.argmin([np.linalg.norm(c - took) for c in menu]))
        assert took == pytest.approx(menu[mine], abs=1e-9)
        short = of.kept - RADIUS - 0.1
        nearest = min(
            (x for x, c in zip(off, menu, strict=True) if of.room(c) >= SURE), default=None
        )
        if short < -0.06:
            evaded += 1
            assert of.miss(took) > max(map(of.miss, menu)) - 0.03
        elif nearest is not None and short > -0.04:
            judged += 1
            assert of.room(took) >= -1e-6
            assert off[mine] <= nearest + 1e-9
        if short < 0.0:
            assert crowd.a.margin[OBSTACLE, 0] <= short + 1e-3
        else:  # it is known to be enough
            assert -1e-6 <= crowd.a.margin[OBSTACLE, 0] <= short + 1e-3
    assert judged > 2
    assert evaded > 0


@pytest.mark.parametrize("turned", [False, True])
def test_of_two_balls_the_one_that_leaves_less_room_is_the_threat(turned):
    """Both come too fast to brake in time; braking is then relative to the worse one, whatever their order."""
    ends, n = np.array([0.0, 60.0]), np.array([0.6, 0.0, 0.8])
    fast = one_solid(ball(-3.0 * n, 0.5), ends, np.outer(ends, 5.3 * n))
    slow = one_solid(ball(3.0 * n, 0.5), ends, np.outer(ends, -5.0 * n))
    crowd = Crowd(1, solids=join_solids([fast, slow][:: -1 if turned else 1]), filtered=False)
    crowd([[0.0, 0, 0]], np.zeros((1, 3)), np.zeros((1, 3)))
    short = {5.3: 0.0, 5.0: 0.0}
    for u in short:
        whole = math.floor(u / (B * T))
        short[u] = (
            3.0 - 0.5 - RADIUS - T * (whole * (u - 0.5 * whole * B * T) + 0.5 * (u - whole * B * T))
        )
    assert short[5.3] < short[5.0] < 0.0
    assert crowd.a.threat[0] == int(turned)
    assert crowd.a.late[0] == pytest.approx(short[5.3], abs=1e-6)
    assert crowd.a.margin[OBSTACLE, 0] == crowd.a.late[0]
    assert crowd.a.between[OBSTACLE].tolist() == [0, int(turned)]


# -- neighbours ----------------------------------------------------------------------------------------


def listed(a: Any) -> list[tuple[int, int]]:
    """All entries (i, j) of the list of neighbours."""
    return [(i, int(j)) for i in range(len(a.b)) for j in a.near[a.start[i] : a.start[i + 1]]]


@pytest.mark.parametrize("seed", range(3))
def test_whoever_could_meet_by_the_next_tick_is_listed(seed):
    """At every tick, of a fleet that spreads and travels: all pairs that could come near, once each way; no lost ones.

    They could meet where both fly at each other with all the thrust there is for a tick, and brake after it.
    """
    rng = np.random.default_rng(seed)
    n, lift = 30, 12.0
    r, v = rng.uniform(-6.0, 6.0, (n, 3)) * [1, 2, 1], rng.normal(0.0, 0.5, (n, 3))
    crowd = Crowd(n, lift=lift, filtered=seed == 2, guarded=seed != 2)
    crowd.flight.vehicles.lost[3] = True
    renewed = 0
    for k in range(40):
        before = crowd.a.listed.copy()
        crowd(r, v, rng.normal(0.0, 1.0 + 0.3 * k, (n, 3)), t=k * T)
        entries = listed(crowd.a)
        pairs = set(entries)
        assert len(entries) == len(pairs)
        assert all((j, i) in pairs and 3 not in (i, j) and i != j for i, j in pairs)
        speed = np.linalg.norm(v, axis=1)
        reach = T * speed + 0.5 * T * T * lift + [way_to_rest(x + T * lift) for x in speed]
        for i, j in combinations(np.delete(np.arange(n), 3), 2):
            if np.linalg.norm(r[i] - r[j]) < 2 * RADIUS + reach[i] + reach[j]:
                assert (i, j) in pairs
        if not np.array_equal(
            before, crowd.a.listed
        ):  # just listed: all within one distance, and no others
            renewed += 1
            kept = np.delete(np.arange(n), 3)
            within = [float(np.linalg.norm(r[i] - r[j])) for i, j in pairs]
            beyond = [
                float(np.linalg.norm(r[i] - r[j]))
                for i, j in combinations(kept, 2)
                if (i, j) not in pairs
            ]
            assert max(within, default=0.0) < min(beyond, default=np.inf)
        v = v + rng.normal(0.0, 0.08, (n, 3)) * (k < 20)
        r = r + T * v
    assert 1 < renewed < 40


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize(("down", "lift"), [(False, 50.0), (True, 50.0), (True, 12.0)])
def test_at_no_distance_two_may_begin_what_braking_cannot_end(down, lift, filtered):
    """Both at rest, asked to fly at each other with all their thrust: after the tick, both still stop in time.

    Also downwards, where gravity helps. There, one of them alone is asked to.
    """
    g, one = (9.81, np.array([0.0, 0.0, -1.0])) if down else (0.0, np.array([0.6, 0.0, 0.8]))
    asked = np.array([lift * one - [0.0, 0.0, g], -lift * one - [0.0, 0.0, g]])
    if down:
        asked[1] = 0.0
    held = 0
    for gap in np.linspace(0.1, 12.0, 60):
        r, v = np.array([np.zeros(3), (2 * RADIUS + gap) * one]), np.zeros((2, 3))
        crowd = Crowd(2, g=g, lift=lift, filtered=filtered)
        took = crowd(r, v, asked)
        held += not np.allclose(took, asked)
        segments = [stop(*(x[0] for x in course(r[i], v[i], took[i], 0.0, [T]))) for i in range(2)]
        assert apart(*segments) >= 2 * RADIUS - 1e-6, gap
    assert held > 0
    assert filtered or not listed(crowd.a)  # so far away, none could


@pytest.mark.parametrize("lag", [0.0, 0.2])
@pytest.mark.parametrize("u", [0.3, 1.0, 4.0])
def test_from_the_range_of_neighbours_on_no_barrier_asks_for_anything(u, lag):
    """Two at this distance that fly at each other, and wish to accelerate so: their barrier asks for just that."""
    a, accel = Crowd(2, lag=lag, lift=B).a, 30.0
    interaction_range = as_python(guard, "stop_distance", "interaction_range")
    gap = interaction_range(u, accel, a) - 2.0 * RADIUS - 2.0 * u * lag
    assert needed(gap, -2.0 * u, 0.9 * 2.0 * B, 3.0) == pytest.approx(-2.0 * accel)


def test_a_fleet_that_travels_together_keeps_its_list():
    """What all fly together, at a constant speed, renews no list; one that leaves the others does."""
    rng = np.random.default_rng(1)
    r, v = rng.uniform(-3.0, 3.0, (12, 3)), np.tile([[2.0, -1.5, 1.0]], (12, 1))
    crowd = Crowd(12, guarded=False)
    crowd(r, v, np.zeros((12, 3)))
    first = crowd.a.listed.copy()
    for k in range(1, 30):
        crowd(r + k * T * v, v, np.zeros((12, 3)), t=k * T)
    assert np.array_equal(first, crowd.a.listed)
    for axis in range(3):
        crowd = Crowd(12, guarded=False)
        crowd(r, v, np.zeros((12, 3)))
        first = crowd.a.listed.copy()
        off = r.copy()
        off[5, axis] += 40.0
        crowd(off, v, np.zeros((12, 3)), t=T)
        assert not np.array_equal(first, crowd.a.listed)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("seed", range(3))
def test_neighbours_are_sought_along_the_widest_axis_and_all_are_listed(seed, axis):
    """Wherever the fleet is: it is in order along this axis, and pairs are as near as a search of all says."""
    rng = np.random.default_rng(seed)
    place = [[40.0, -70.0, 5.0], [-9.0, 3.0, 80.0], [0.0, 0.0, 0.0]][seed]
    r = place + rng.uniform(0.0, 4.0, (12, 3))
    r[:, axis] += rng.uniform(0.0, 12.0, 12)
    lost, way = np.zeros(12, dtype=np.bool_), 5.0
    a = Crowd(12).a
    neighbours = as_python(guard, "list_neighbours")
    for _ in range(2):  # unsorted at first
        assert neighbours(r, lost, way, a)
        assert (np.diff(r[a.order, axis]) > 0.0).all()
        near = np.linalg.norm(r[:, None] - r, axis=2) <= way
        assert sorted(listed(a)) == [(i, j) for i, j in np.argwhere(near) if i != j]
        r[:2, axis] = r[1::-1, axis]


def test_a_list_is_renewed_once_where_all_have_slowed_down():
    """A list for great speeds holds many: at a fifth of the speed it is made anew, but only once, also at rest."""
    r, toward = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]] * 2)
    crowd = Crowd(2, guarded=False)
    renewed = []
    for speed in (5.0, 5.0, 4.0, 1.0, 1.0, 0.0, 0.0, 0.0):
        crowd.a.listed[:] = 7.0 + r  # as if all had moved together, which renews nothing
        crowd(r, speed * toward, np.zeros((2, 3)))
        renewed.append(bool((crowd.a.listed == r).all()))
    assert renewed == [True, False, False, True, False, True, False, False]


# -- the barriers --------------------------------------------------------------------------------------


def needed(gap: float, s: float, b: float, rate: float, soft: float = 0.0) -> float:
    """The least second derivative of a distance by its barrier h = sqrt(2 b gap + soft^2) - soft + s."""
    root = math.sqrt(2.0 * b * gap + soft * soft)
    return -rate * (root - soft + s) - b * s / root


@pytest.mark.parametrize("lag", [0.0, 0.2])
@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_beside_a_ball_a_vehicle_is_pushed_as_much_as_its_barrier_asks(seed, moves, noise, lag):
    """Straight towards the middle of a ball: what is given has along the normal what the barrier needs, and no less.

    What is not known of the ball's place and velocity, three standard deviations, counts against the vehicle.
    """
    rng = np.random.default_rng(seed)
    n, u, size, clearance, rate = rng.normal(size=3), 2.5, 0.5, 0.2, 3.0
    n /= np.linalg.norm(n)
    w = rng.normal(0.0, 1.0, 3) * moves
    ends = np.array([0.0, 60.0])
    place = rng.normal(size=3)
    thing = (
        one_solid(ball(place, size), ends, np.outer(ends, w))
        if moves
        else one_solid(ball(place, size))
    )
    seen = initial_sight(thing, 50.0, noise * moves, seed=seed)
    crowd = Crowd(
        1, solids=thing, seen=seen, clearance=clearance, rate=rate, lag=lag, guarded=False
    )
    ticks = 40 if noise and moves else 1
    for k in range(ticks):
        if k == ticks - 1:  # what the last measurement will make of it, at a copy
            kept = [x.copy() for x in (seen.known, seen.track, seen.spread, seen.bound)]
        crowd([place + 30.0 * n], [w], np.zeros((1, 3)), t=k * T)
    x = seen.track[0].copy()
    for mine, old in zip((seen.known, seen.track, seen.spread, seen.bound), kept, strict=True):
        mine[...] = old
    # From afar, nothing of a ball that moves is passed too near: it would ask to be steered past, too.
    near, u = (size + RADIUS + 0.6, -0.1) if moves else (2.0, u)
    asked = rng.normal(0.0, 1.0, 3) - 8.0 * n * moves
    (took,) = crowd([place + x[:3] + near * n], [x[3:] - u * n], [asked], t=(ticks - 1) * T)
    bound = crowd.a.sight.bound[0] if moves else np.zeros(2)
    assert (bound > 0.0).all() == (noise > 0.0 and moves)
    s = -u - bound[1]
    gap = near - size - RADIUS - clearance - bound[0] + min(s, 0.0) * lag
    asks = needed(gap, s, 0.9 * B, rate)
    expected = asked + max(0.0, asks - asked @ n) * n
    assert asks > asked @ n
    assert took == pytest.approx(expected, abs=1e-4)
    assert crowd.a.acted[BARRIER, 0] == 1


@pytest.mark.parametrize("lag", [0.0, 0.1])
def test_two_that_meet_share_a_push_by_their_masses(lag):
    """Head-on: both together have what the barrier needs, each in proportion to the inverse of its mass."""
    mass, u, rate = np.array([1.0, 3.0]), 1.2, 3.0
    crowd = Crowd(2, mass=mass, lag=lag, separation=0.2, rate=rate, guarded=False)
    n = np.array([2.0, -1.0, 2.0]) / 3.0
    took = crowd([[0.0, 0, 0], 1.7 * n], [u * n, -u * n], np.zeros((2, 3)))
    asks = needed(1.7 - 0.8 - 2 * u * lag, -2 * u, 0.9 * 2 * B, rate)
    assert asks > 0.0
    assert took[0] == pytest.approx(-0.75 * asks * n, abs=1e-4)
    assert took[1] == pytest.approx(0.25 * asks * n, abs=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_rigid_edges_pass_a_push_on_to_all(seed):
    """Edges that hold completely, in a chain of unequal masses: the least change that the barrier and they allow.

    The equations of Gauss's principle, solved by NumPy.
    """
    rng = np.random.default_rng(seed)
    n, rate, u, gap = 10, 3.0, 2.0, 0.8
    mass = np.where(np.arange(n) % 2, 5.0, 0.5)
    way = np.cumsum(rng.normal(size=(n, 3)) * 0.5 + [3.0, 0, 0], axis=0)
    edges = [(i, i + 1) for i in range(n - 1)] + [(i, i + 2) for i in range(n - 2)]
    m = np.array([0.0, 0, 1.0])
    thing = one_solid(ball(way[0] - (gap + 0.5 + RADIUS) * m, 0.5))
    crowd = Crowd(n, mass=mass, edges=edges, solids=thing, rate=rate, guarded=False)
    x = np.array([way[i] - way[j] for i, j in edges])
    crowd.work.u[:] = x / np.linalg.norm(x, axis=1)[:, None]
    crowd.problem = crowd.problem._replace(law=crowd.problem.law._replace(mu=0.0))
    v = np.zeros((n, 3))
    v[0] = -u * m
    took = crowd(way, v, np.zeros((n, 3)))
    J = np.zeros((len(edges) + 1, n, 3))
    for e, (i, j) in enumerate(edges):
        J[e, i], J[e, j] = crowd.work.u[e], -crowd.work.u[e]
    J[-1, 0] = m
    J = J.reshape(len(edges) + 1, -1)
    inverse = np.repeat(1.0 / mass, 3)
    right = np.r_[np.zeros(len(edges)), needed(gap, -u, 0.9 * B, rate)]
    forces = np.linalg.solve(J @ (inverse[:, None] * J.T), right)
    expected = inverse * (J.T @ forces)
    assert right[-1] > 0.0
    assert took == pytest.approx(expected.reshape(n, 3), abs=1e-5)
    assert crowd.a.known[2, 0] == pytest.approx(forces[-1] * m, rel=1e-4)  # by which edges let go
    assert not crowd.a.known[2, 1:].any()


def test_edges_let_go_as_they_are_pushed_and_take_hold_again():
    """The share to which edges hold falls with the push, by its part of half the braking, and returns to all."""
    release = 0.5
    crowd = Crowd(1, solids=one_solid(half_space(0.0)), guarded=False, release=release, mass=2.0)
    hold = 1.0
    for k in range(3):
        (took,) = crowd([[0.0, 0, 0.8]], [[0.0, 0, -1.6]], np.zeros((1, 3)), t=k * T)
        aim = 1.0 - min(1.0, 2.0 * took[2] / (0.5 * 2.0 * B))
        hold += (aim - hold) * T / release
        assert 0.0 < took[2] < 0.5 * B
        assert crowd.a.hold[0] == pytest.approx(hold, abs=1e-5)
    assert crowd.a.acted[BARRIER, 0] == 3
    for k in range(3, 90):
        crowd([[0.0, 0, 9.0]], np.zeros((1, 3)), np.zeros((1, 3)), t=k * T)
        hold = 1.0 - (1.0 - hold) * (1.0 - T / release)
        assert crowd.a.hold[0] == pytest.approx(hold, abs=2e-6)
    assert crowd.a.hold[0] == 1.0
    assert crowd.a.acted[BARRIER, 0] == 3
    assert crowd.a.first[BARRIER, 0] == 0.0


@pytest.mark.parametrize("saturated", [False, True])
def test_forces_of_edges_that_let_go_are_taken_back(saturated):
    """All edges lose the share of the vehicle that holds least; integrals do, too, unless thrust is at its limit."""
    rng = np.random.default_rng(0)
    edges = [[0, 1], [1, 2]]
    crowd = Crowd(3, edges=edges, guarded=False)
    u = rng.normal(size=(2, 3))
    crowd.work.u[:] = u / np.linalg.norm(u, axis=1)[:, None]
    crowd.work.multiplier[:], crowd.work.c[:] = [2.0, -3.0], [0.1, -0.2]
    crowd.a.hold[:] = [0.9, 1.0, 0.4]
    crowd.state.integral[:] = 1.0
    crowd.state.saturated[0] = saturated
    took = crowd([[0.0, 0, 0], [50.0, 0, 0], [0, 90.0, 0]], np.zeros((3, 3)), np.ones((3, 3)))
    force = 0.6 * crowd.work.multiplier[:, None] * crowd.work.u
    assert took - 1.0 == pytest.approx(np.array([-force[0], force[0] - force[1], force[1]]))
    lost = 0.6 * T * crowd.work.c * [not saturated, True]
    assert crowd.state.integral == pytest.approx(1.0 - lost)
    crowd.a.hold[:] = 1.0
    before = crowd.state.integral.copy()
    assert crowd(
        [[0.0, 0, 0], [50.0, 0, 0], [0, 90.0, 0]], np.zeros((3, 3)), np.ones((3, 3))
    ) == pytest.approx(1.0)
    assert np.array_equal(before, crowd.state.integral)


def test_thrust_is_limited_in_its_own_direction():
    """Whatever is asked for, the thrust that bears the weight, too, keeps its direction and ends at the limit.

    With a flow round a ball, it ends there as well.
    """
    g, lift = 9.81, 14.0
    asked = np.array([[10.0, -8.0, -2.0], [1.0, 2.0, -3.0]])
    r = [[0.0, 0, 0], [30.0, 0, 0]]
    crowd = Crowd(2, g=g, lift=lift, guarded=False, filtered=False)
    crowd(r, np.zeros((2, 3)), asked)
    thrust = asked + [0, 0, g]
    expected = thrust * np.minimum(1.0, lift / np.linalg.norm(thrust, axis=1))[:, None] - [0, 0, g]
    assert np.linalg.norm(thrust[0]) > lift
    assert crowd.a.wanted == pytest.approx(expected, abs=1e-9)
    near = one_solid(ball([0.0, 0.0, -2.2], 1.0))
    crowd = Crowd(2, g=g, lift=lift, solids=near, flow=True, guarded=False, filtered=False)
    took = crowd(r, np.zeros((2, 3)), asked)
    assert not np.allclose(took[0], expected[0], atol=0.1)
    assert np.linalg.norm(took[0] + [0, 0, g]) == pytest.approx(lift)


def test_a_push_that_asks_for_too_much_thrust_is_limited():
    """Pushed aside with all its thrust up already, a vehicle has the direction of both, at the limit."""
    g, lift = 9.81, 14.0
    crowd = Crowd(1, g=g, lift=lift, solids=one_solid(ball([2.0, 1.0, 0.0], 0.5)), guarded=False)
    n = np.array([-2.0, -1.0, 0.0]) / math.sqrt(5.0)
    u, asked = 3.5, np.array([0.0, 0.0, 4.0])
    (took,) = crowd([[0.0, 0, 0]], [-u * n], [asked])
    push = needed(math.sqrt(5.0) - 0.5 - RADIUS, -u, 0.9 * B, 3.0)
    thrust = asked + push * n + [0, 0, g]
    assert np.linalg.norm(thrust) > lift
    assert took == pytest.approx(thrust * lift / np.linalg.norm(thrust) - [0, 0, g], abs=1e-4)


# -- quadrotors ----------------------------------------------------------------------------------------

#: Time until commands act [s]; lags of each axis: a1 [s], a2 [s^2], and of commands [s].
LAG = 0.08
AHEAD = np.array([[0.09, 0.0018, 0.35], [0.09, 0.0018, 0.3], [0.02, 0.0, 0.4]])


def quadrotors(n: int, **options: Any) -> Crowd:
    """Quadrotors of the paper, whose commands act with lags."""
    every: dict[str, Any] = {
        "ahead": np.tile(AHEAD, (n, 1, 1)),
        "lag": 0.2,
        "g": 9.81,
        "lift": 23.6,
        "tilt": math.radians(45.0),
    }
    return Crowd(n, model=PAPER, **(every | options))


def tilted(crowd: Crowd, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give quadrotors attitudes, rates and motor speeds; body z axes, their rates of change, and thrusts per mass."""
    S = crowd.state.S
    turn = Rotation.from_rotvec(rng.normal(0.0, 0.2, (len(S), 3)))
    S[:, 6:10] = turn.as_quat()[:, [3, 0, 1, 2]]
    S[:, 10:13] = rng.normal(0.0, 0.5, (len(S), 3))
    S[:, 13:] *= rng.uniform(0.8, 1.1, (len(S), 4))
    step = 1e-6
    up = turn.apply([0.0, 0, 1])
    later = (turn * Rotation.from_rotvec(step * S[:, 10:13])).apply([0.0, 0, 1])
    return up, (later - up) / step, (5.9e-6 * S[:, 13:] ** 2).sum(axis=1)


def test_the_point_that_is_led_obeys_at_once():
    """x + a1 v + a2 a, ahead by the commands' lag: its motion under the command held is that under the choice held."""
    rng = np.random.default_rng(3)
    n = 4
    crowd = quadrotors(n, guarded=False, filtered=False)
    up, turning, lift = tilted(crowd, rng)
    r, v = 50.0 * np.eye(4, 3) + rng.normal(size=(n, 3)), rng.normal(0.0, 1.0, (n, 3))
    asked = rng.normal(0.0, 1.0, (n, 3))
    u = rng.normal(0.0, 1.0, (n, 3))
    crowd.a.commanded[:] = u
    took = crowd(r, v, asked)
    a1, a2, s = AHEAD.T
    a, jerk = lift[:, None] * up - [0, 0, 9.81], lift[:, None] * turning
    x, x_rate = r + a1 * v + a2 * a, v + a1 * a + a2 * jerk
    led, led_rate = x + s * (x_rate - 0.5 * T * u), x_rate + s * u
    assert crowd.a.known[0] == pytest.approx(led, abs=1e-5)
    assert crowd.a.known[1] == pytest.approx(led_rate, abs=1e-5)
    assert took == pytest.approx(asked)  # nothing is near: what is asked for, at once
    # Of the choice that is not what is asked for, by its first tick: the command follows with the lag.
    c = rng.normal(0.0, 1.0, (n, 3))
    then = c - s / (T + s) * (c - u)
    later = x + T * x_rate + 0.5 * T * T * then + s * (x_rate + T * then - 0.5 * T * then)
    assert later == pytest.approx(led + T * led_rate + 0.5 * T * T * c)


def test_a_quadrotor_that_is_overruled_follows_with_its_lag():
    """Beside a wall, the command follows the guard's choice by T / (T + s) of what is left, and then what is asked."""
    wall = one_solid(box([0.75, -9, -9], [2.0, 9, 9]))
    crowd = quadrotors(1, solids=wall, filtered=False)
    asked, s = np.array([[6.0, 0.0, 0.0]]), AHEAD[:, 2]
    for k in range(2):  # nothing is near: it is commanded what is asked for
        u = np.array([0.2, -0.1, 0.3]) * (k + 1)
        assert crowd([[-30.0, 0, 0]], np.zeros((1, 3)), [u], t=k * T) == pytest.approx(u[None])
    for k in range(2, 5):
        (took,) = crowd([[0.0, 0, 0]], [[0.05, 0, 0]], asked, t=k * T)
        c = crowd.a.chosen[0]
        u = c - s / (T + s) * (c - u)
        assert crowd.a.acted[GUARD, 0] == k - 1
        assert took == pytest.approx(u)
        assert crowd.a.overruled[0] == 1
    # Away from the wall, what is wanted brings the command to what is asked for at once, within thrust and tilt.
    gentle = np.array([[-0.3, 0.1, 0.2]])
    for k in range(5, 60):
        (took,) = crowd([[-30.0, 0, 0]], np.zeros((1, 3)), gentle, t=k * T)
    assert took == pytest.approx(gentle[0])
    assert crowd.a.overruled[0] == 0


def test_the_tilt_of_a_quadrotor_is_limited_and_its_lift_kept():
    """Beyond its greatest tilt, the horizontal part of a thrust is shortened, the vertical one stays."""
    crowd = quadrotors(1, guarded=False, filtered=False)
    crowd([[0.0, 0, 0]], np.zeros((1, 3)), [[12.0, -9.0, -1.0]])
    up = 9.81 - 1.0
    assert crowd.a.requested[0] == pytest.approx([0.8 * up, -0.6 * up, -1.0])


@pytest.mark.parametrize("lag", [0.2, 0.04])
def test_quadrotors_that_fly_apart_are_still_where_they_are(lag):
    """The points led are farther apart than the vehicles, whose places count, however short their lag is."""
    crowd = quadrotors(2, filtered=False, lag=lag)
    crowd([[0.0, 0, 0], [0.8, 0, 0]], [[-1.0, 0, 0], [1.0, 0, 0]], np.zeros((2, 3)))
    assert crowd.a.margin[PAIR, 0] == pytest.approx(0.8 - 2 * RADIUS, abs=1e-6)


class Hulls:
    """Hulls of quadrotors: of place, what is behind the point led, this point, that after the tick, and its stop."""

    def __init__(self, crowd: Crowd, r: np.ndarray) -> None:
        a = crowd.a
        self.behind = np.stack([r, a.ways[:, 5]], axis=1)
        self.led, self.rate = a.known[0].copy(), a.known[1].copy()
        self.now = [self.braking(i) for i in range(len(r))]
        first = [np.vstack([self.hull(i, c)[[0, 1, 3, 4]], stop(self.led[i], self.rate[i], LAG)[1]])
                 for i, c in enumerate(self.now)]  # fmt: skip
        self.kept = {(i, j): apart(first[i], first[j]) for i, j in combinations(range(len(r)), 2)}

    def braking(self, i: int) -> np.ndarray:
        """Braking of a quadrotor, which fades below b times its lag."""
        speed = float(np.linalg.norm(self.rate[i]))
        return -min(B * speed / (speed + B * LAG), speed / T) / speed * self.rate[i]

    def hull(self, i: int, c: np.ndarray) -> np.ndarray:
        places, velocities = course(self.led[i], self.rate[i], c, 0.0, [T])
        return np.vstack(
            [self.led[i], places, stop(places[0], velocities[0], LAG)[1], self.behind[i]]
        )

    def room(self, i: int, c: np.ndarray, need: float) -> float:
        """The least by which the hull with c keeps the distances from the others' with their present choices."""
        hull = self.hull(i, c)
        return min(
            apart(hull, self.hull(j, self.now[j])) - min(need, self.kept[min(i, j), max(i, j)])
            for j in range(len(self.now))
            if j != i
        )


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_hulls_of_quadrotors_keep_their_distance(seed):
    """No hull is nearer to another than it should be or was; what each takes is the nearest candidate that is so."""
    rng = np.random.default_rng(seed)
    acted, need, n = 0, 2 * RADIUS + 0.1, 3
    for _ in range(2):
        crowd = quadrotors(n, separation=0.1, filtered=False)
        r, v = rng.uniform(-0.9, 0.9, (n, 3)), rng.normal(0.0, 0.3, (n, 3))
        u = rng.normal(0.0, 0.3, (n, 3))
        crowd.a.commanded[:] = u
        crowd(r, v, rng.normal(0.0, 3.0, (n, 3)))
        a, of = crowd.a, Hulls(crowd, r)
        at_once = u + (1.0 + AHEAD[:, 2] / T) * (a.requested - u)
        for i in (1, 2, 0):
            menu = [at_once[i], *(B * candidate_accelerations()), of.now[i]]
            off = [np.linalg.norm(c - a.wanted[i]) for c in menu]
            mine = int(np.argmin([np.linalg.norm(c - a.chosen[i]) for c in menu]))
            brakes = mine == len(menu) - 1
            if mine > 0 and not brakes:
                assert a.chosen[i] == pytest.approx(menu[mine])
                assert of.room(i, a.chosen[i], need) >= -0.05
            for c, far in zip(menu[1:-1], off[1:-1], strict=True):
                if mine > 0 and (far < off[mine] - 1e-9 or brakes):
                    assert of.room(i, c, need) < 2 * SURE
            acted += mine > 0
            of.now[i] = a.chosen[i].copy()
        # The search of hulls ends after many steps, a little below.
        assert -0.1 <= a.margin[PAIR, 0] - min(of.kept.values()) + need <= 1e-6
    assert acted > 0


def as_python(module: Any, *names: str) -> Any:
    """The last of some functions of the kernel, as plain Python that calls the others."""
    every = {name: getattr(module, name) for name in names}
    space = dict(vars(module))
    for name, function in every.items():
        space[name] = FunctionType(getattr(function, "py_func", function).__code__, space)
    return space[names[-1]]


@pytest.mark.parametrize("ask", [(-1.0, 3.0), (-9.0, -8.0)])
def test_sweeps_push_all_and_then_those_that_push_until_little_changes(ask):
    """A sweep is projected over-relaxation of all rows of A, then of those that push and the edges, up to 8 times.

    The oracle has A as a matrix, and no accelerations.
    """
    rng = np.random.default_rng(3)
    n, count, m, mu = 6, 7, 3, 0.02
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 3), (2, -1)]
    edges = np.array([(0, 2), (1, 4), (3, 5)])
    normals, u = (x / np.linalg.norm(x, axis=1)[:, None] for x in rng.normal(size=(2, count, 3)))
    inverse = rng.uniform(0.3, 2.0, n)
    J = np.zeros((count + m, n, 3))
    for k, (i, j) in enumerate([*pairs, *edges.tolist()]):
        J[k, i] = normals[k] if k < count else u[k - count]
        J[k, j] -= J[k, i] if j >= 0 else 0.0
    J = J.reshape(count + m, -1)
    A = J @ (np.repeat(inverse, 3)[:, None] * J.T)
    diagonal, missing = np.diag(A).copy(), rng.uniform(*ask, count)
    mean, most = float(np.mean(1.0 / inverse)), np.full(count, 2.5)
    problem = SimpleNamespace(
        graph=SimpleNamespace(edges=edges, diagonal=diagonal[count:]),
        law=SimpleNamespace(mu=mu),
        vehicles=SimpleNamespace(mean=mean),
    )
    a = SimpleNamespace(
        rows=np.array(pairs), normals=normals, shift=np.zeros((n, 3)), missing=missing, push=np.zeros(count),
        reduced=1.0 / diagonal[:count], most=most, inverse=inverse, pushing=np.zeros(count, dtype=np.int64),
        pull=np.zeros(m), hold=np.ones(n),
    )  # fmt: skip
    sweep = as_python(
        barriers,
        "difference_along",
        "apply_force",
        "edge_compliance",
        "enforce_barrier",
        "update_edge_pulls",
        "sweep_gauss_seidel",
    )
    x, right = np.r_[np.zeros(count), rng.normal(size=m)], np.r_[missing, np.zeros(m)]
    a.pull[:], a.shift[:] = x[count:], (np.repeat(inverse, 3) * (x @ J)).reshape(n, 3)
    A += np.diag([0.0] * count + [mu / mean] * m)
    low, high = np.r_[np.zeros(count), np.full(m, -np.inf)], np.r_[most, np.full(m, np.inf)]

    def relax(rows: Any) -> float:
        change = 0.0
        for k in rows:
            new = np.clip(x[k] + 1.5 * (right[k] - A[k] @ x) / A[k, k], low[k], high[k])
            change = max(change, abs(new - x[k]) * diagonal[k])
            x[k] = new
        return change

    for _ in range(4):
        took = sweep(count, problem, SimpleNamespace(u=u[:m]), a)
        first = relax(range(count + m))
        again = [*np.flatnonzero(x[:count] > 0.0), *range(count, count + m)]
        for _ in range(8 if first >= 5e-5 else 0):
            if relax(again) < 5e-5:
                break
        assert took == pytest.approx(first, rel=1e-9)
        assert np.r_[a.push, a.pull] == pytest.approx(x, rel=1e-9, abs=1e-12)
    assert np.count_nonzero(x[:count]) > 3 or ask[1] < 0.0


@pytest.mark.parametrize("most", [0.5, 1.0, 2.0])
def test_a_barrier_that_asks_for_more_pushes_as_much_as_it_may(most):
    """From no push to the greatest at once: what it pushes with is passed on, and so is its change."""
    n = np.array([[0.6, 0.0, 0.8]])
    a = SimpleNamespace(
        rows=np.array([[0, 1]]), normals=n, shift=np.zeros((2, 3)), missing=np.array([99.0]), push=np.zeros(1),
        reduced=np.array([2.0 / 3.0]), most=np.array([most]), inverse=np.array([1.0, 0.5]),
    )  # fmt: skip
    enforce = as_python(barriers, "difference_along", "apply_force", "enforce_barrier")
    for change in (1.5 * most, 0.0):
        assert enforce(0, a) == pytest.approx(change)
        assert a.push == pytest.approx([most])
        assert a.shift == pytest.approx(np.array([1.0, -0.5])[:, None] * most * n)
