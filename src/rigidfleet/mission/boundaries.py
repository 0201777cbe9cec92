"""Fences and people along curves, in continuous time: how far beyond a fence, how near to people a fall goes.

A distance from a fence is bounded along a curve by its control points. A fall is bounded by those of position and
velocity: it takes the longer the higher and the faster upwards it begins, and two falls that take equally long end no
farther apart than they begin, and by what their velocities differ. Both bounds come together as curves are halved.
"""

from __future__ import annotations

from functools import partial, reduce
from typing import NamedTuple

import numpy as np

from rigidfleet._common.facts import value as show
from rigidfleet._common.quantities import QUANTITIES
from rigidfleet.math import falls
from rigidfleet.math.bernstein import Measure, Measured, greatest_curve_measure
from rigidfleet.math.piecewise import Piecewise, pad
from rigidfleet.mission.model import Mission
from rigidfleet.mission.obstacles import Obstacle, is_ground
from rigidfleet.solids.distance import STEEP
from rigidfleet.solids.polygons import Region, bezier_curve_middles
from rigidfleet.solids.records import swept_extent
from rigidfleet.typing import Bools, Floats, Ints

#: How far a worst value may be from the worst of the curve: of a fence, and of a fall [m].
_NEAR, _NEAR_FALL = 1e-3, 1e-2
#: Heights between floor and ceiling of people at which falls are looked at. Between two of them, the way that is flown
#: sideways counts in full: a distance is at most an eighth of that less than it is.
_LEVELS = 5
#: Heights at which a fall is looked at that may end on terrain or a roof.
_HEIGHTS = 128
#: Curves that are searched together, and steps of an agent in one box.
_TOGETHER, _BOXED = 20_000, 32
#: States whose falls fit into the processor's cache.
_CACHED = 4000
#: Corners (3, 8) of a box about its centre, of which two by two are opposite.
_CORNERS = np.array([[1.0 if k >> axis & 1 else -1.0 for k in range(8)] for axis in range(3)])


class Worst(NamedTuple):
    """A worst value of a quantity, its time [s], the agent, and the fence or the place, both from 0."""

    value: float
    time: float
    who: int
    other: int


class _Boundary(NamedTuple):
    """A fence or a place with people: its quantity, its number, what it measures of curves, and how closely."""

    quantity: str
    number: int
    measure: Measure
    close: float


def areas_judged_by(mission: Mission, quantity: str) -> list[tuple[int, Region]]:
    """Numbers and regions of the fences, or of the places with people, that a quantity is about."""
    things = mission.people if quantity == "people" else mission.fences
    regions = [(k, x.region(mission.geodetic_origin, mission.ground)) for k, x in enumerate(things)]
    if quantity == "people":
        return regions
    return [(k, x) for k, x in regions if mission.fences[k].soft is (quantity == "soft_fence")]


def boundary_in_words(quantity: str, agent: str, place: str, value: float, when: float) -> str:
    """A value [m] at a time [s] of an agent beside a fence or people, in words."""
    if quantity == "people":
        where = f"{show(value, 'm')} from people" if value > 0.0 else "on people"
        return f"{agent} falls {where} in '{place}' if it fails at {when:.2f} s"
    fence = f"the {'soft ' if quantity == 'soft_fence' else ''}fence '{place}'"
    if value > 0.0:
        return f"{agent} crosses {fence} by {show(value, 'm')} at {when:.2f} s"
    return f"{agent} comes within {show(-value, 'm')} of {fence} at {when:.2f} s"


class Boundaries:
    """The fences of a mission and its places with people, as measures of states and curves."""

    def __init__(self, mission: Mission) -> None:
        self.mission, self.g = mission, mission.gravity
        self.radius, self.k = mission.fleet.radius, mission.drag / mission.true_mass
        self.wind = np.array(mission.all_disturbances.wind)
        kind_of = [fence.kind for fence in mission.fences]
        self.every = [
            _Boundary("people", k, partial(self._nearness_of_falls, region), _NEAR_FALL)
            for k, region in areas_judged_by(mission, "people")
        ] + [
            _Boundary(name, k, partial(_distance_outside, region, kind_of[k] == "inclusion"), _NEAR)
            for name in ("fence", "soft_fence")
            for k, region in areas_judged_by(mission, name)
        ]

    def worst_by_area(self, quantity: str, r: Floats, v: Floats) -> tuple[Floats, Ints]:
        """Values (K, N) of a quantity at states (K, N, 3), and to which fence or place each belongs."""
        states = np.concatenate([r, v], axis=2).reshape(-1, 6, 1)
        who = np.tile(np.arange(r.shape[1]), len(r))
        own = [x for x in self.every if x.quantity == quantity]
        blocks = [slice(k, k + _CACHED) for k in range(0, len(who), _CACHED)]
        values = [np.concatenate([x.measure(states[b], who[b])[0] for b in blocks]) for x in own]
        ranks, number = np.reshape(values, (len(own), *r.shape[:2])), [x.number for x in own]
        return QUANTITIES[quantity].rank(ranks.max(axis=0)), np.array(number)[ranks.argmax(axis=0)]

    def places_of_falls(self, r: Floats, v: Floats, level: Floats | float) -> Floats:
        """Where vehicles fall to levels [m] that fail at states (K, N, 3): places (K, N, 2) [m]."""
        k = np.broadcast_to(self.k, r.shape[:2])
        tau = falls.fall_time(r[..., 2] - level, v[..., 2], k, self.wind[2], self.g)
        return falls.landing_places(r, v, tau, k, self.wind)

    def ends_of_falls(self, r: Floats, v: Floats) -> Floats:
        """Where these falls end (K, N, 3) [m]: on the ground, or without one at z = 0 or on what is below that.

        Terrain and roofs count at some heights of each fall.
        """
        mission, level = self.mission, self.mission.ground
        if not np.isfinite(level):
            level = min([0.0, *(_lowest_top(x) for x in mission.solids if is_ground(x))])
        ends = np.full(r.shape, level)
        ends[..., :2] = self.places_of_falls(r, v, level)
        for share in np.linspace(0.0, 1.0, _HEIGHTS) if mission.roofs.kind.size else ():
            height = level + share * (r[..., 2] - level)
            x, y = np.moveaxis(self.places_of_falls(r, v, height), 2, 0)
            above = mission.height_below(x, y) >= height
            ends[above] = np.stack([x, y, height], axis=2)[above]
        return ends

    def _nearness_of_falls(self, region: Region, points: Floats, who: Ints) -> Measured:
        """How near people falls from curves (M, 6, P) of agents (M,) go: minus distances [m], see `Measure`."""
        levels = np.linspace(region.ceiling, region.floor, _LEVELS)
        m, k = bezier_curve_middles(points)[..., None], self.k[who][:, None]
        low, high = points.min(axis=2)[..., None], points.max(axis=2)[..., None]

        def fall_times(states: Floats) -> Floats:
            height, climb, drag = np.broadcast_arrays(states[:, 2] - levels, states[:, 5], k)
            return falls.fall_time(height, climb, drag, self.wind[2], self.g)

        tau = fall_times(m)
        first, last = (tau, tau) if points.shape[2] == 1 else (fall_times(low), fall_times(high))
        off = (points - m)[:, [0, 1, 3, 4]].reshape(len(m), 2, 2, -1)
        spread = np.linalg.norm(off, axis=2).max(axis=2)
        place = falls.landing_places(m[:, None, :3, 0], m[:, None, 3:, 0], tau, k, self.wind)
        away = region.distance(place.reshape(-1, 2)).reshape(tau.shape) - self.radius[who][:, None]
        blown = np.linalg.norm(self.wind[:2])
        speed = np.maximum(np.linalg.norm(m[:, 3:5], axis=1), blown)
        early = np.maximum(last - tau, tau - first)
        reach = spread[:, :1] + spread[:, 1:] * falls.drag_integrals(k, last)[0] + speed * early

        def least_distance(distance: Floats, length: Floats) -> Floats:
            return 0.5 * (distance[:, 1:] + distance[:, :-1] - length).min(axis=1)

        way = speed * np.diff(tau, axis=1)
        more = (speed + spread[:, 1:]) * (np.diff(tau, axis=1) + early[:, 1:] + early[:, :-1])
        return -least_distance(away, way), np.full(len(m), 0.5), -least_distance(away - reach, more)


def _lowest_top(thing: Obstacle) -> float:
    """The lowest height [m] of the upper side of a terrain or a box: of faces that are no steeper than 60 degrees."""
    if thing.kind == "heights":
        return float(np.array(thing.heights).min())
    own, rise = thing.solid, np.abs(thing.solid.turn[0, :, 2])  # of each axis of the box
    tops = swept_extent(own)[0, 2] + rise * (own.size[0, 3:] - own.size[0, :3])
    return float(tops[rise >= STEEP].min())


def _distance_outside(region: Region, inclusion: bool, curves: Floats, _: Ints) -> Measured:
    """How far curves (M, 6, P) are on the wrong side of a fence [m], see `Measure`."""
    value, bound = region.curve_depths_and_bounds(curves[:, :3], outside=inclusion)
    return value, np.full(len(value), 0.5), bound


class BoundaryWatch:
    """Finds the worst values of curves beside fences and people.

    With ``floors``, ranks by quantity, those alone that are worse, and of these quantities alone.
    """

    def __init__(self, mission: Mission, floors: dict[str, float] | None = None) -> None:
        every = Boundaries(mission).every
        self.every = [x for x in every if floors is None or x.quantity in floors]
        self._floors = floors or {}
        #: By quantity, since it was last asked for.
        self.worst: dict[str, Worst] = {}
        #: Starts, lengths and control points that are not searched yet, and whose of the agents count.
        self._waiting: list[tuple[Floats, Floats]] = []
        self._left: Bools | None = None

    def add_steps(self, clock: Floats, points: Floats, remaining: Bools) -> None:
        """Take steps with starts and lengths (S, 2) [s], and control points (S, N, 6, P) of positions and velocities.

        Agents ``remaining`` (N,) count.
        """
        if not (self.every and len(clock)):
            return
        if self._left is None or (self._left != remaining).any():
            self.search()
            self._left = remaining.copy()
        self._waiting.append((clock, points))
        if sum(len(steps) for steps, _ in self._waiting) * len(remaining) > _TOGETHER:
            self.search()

    def add_way(self, way: Piecewise, left: Bools | None = None) -> None:
        """Take ways (K, N, 3, P) of agents, of whom those ``left`` (N,) count, by default all."""
        n, powers = way.pieces.shape[1], max(way.pieces.shape[-1], 2)
        left = np.ones(n, dtype=np.bool_) if left is None else left
        some = max(1, _TOGETHER // n)
        for k in range(0, len(way.pieces), some):
            part = way.slice_pieces(k, k + some)
            both = part, part.derivative_curve()
            points = [Piecewise(x.time, pad(x.pieces, powers)).control_points() for x in both]
            clock = np.column_stack([part.time[:-1], np.diff(part.time)])
            self.add_steps(clock, np.concatenate(points, axis=2), left)

    def search(self) -> dict[str, Worst]:
        """The worst values of all steps so far, by quantity."""
        if self._waiting and self._left is not None and self._left.any():
            clock, points = map(np.concatenate, zip(*self._waiting, strict=True))
            self._search(clock, points, np.flatnonzero(self._left))
        self._waiting = []
        return self.worst

    def _search(self, clock: Floats, points: Floats, agents: Ints) -> None:
        """Search the curves (S, N, 6, P) of some agents (n,): the steps of which a box may have a worse value."""
        points, starts = points[:, agents], np.arange(0, len(clock), _BOXED)
        # Of few numbers beside each other, `min` takes five times as long.
        low, high = (
            f.reduceat(reduce(f, np.moveaxis(points, 3, 0)), starts, axis=0).reshape(-1, 6, 1)
            for f in (np.minimum, np.maximum)
        )
        boxes = 0.5 * (low + high) + 0.5 * (high - low) * np.tile(_CORNERS, (2, 1))
        states = points[starts, :, :, :1].reshape(-1, 6, 1)
        every = np.tile(agents, len(starts))
        for x in self.every:
            q = QUANTITIES[x.quantity]
            known = self.worst.get(x.quantity)
            start = x.measure(states, every)[0]
            least = self._floors.get(x.quantity, -np.inf)
            least = least if known is None else float(q.rank(known.value))
            if start.max() > least:
                k = int(start.argmax())
                least = float(start[k])
                self._set_worst(x, least, float(clock[starts[k // len(agents)], 0]), int(every[k]))
            near = (x.measure(boxes, every)[2] > least + x.close).reshape(len(starts), -1)
            step, who = np.nonzero(np.repeat(near, _BOXED, axis=0)[: len(clock)])

            def measure(
                p: Floats, curve: Ints, x: _Boundary = x, who: Ints = agents[who]
            ) -> Measured:
                return x.measure(p, who[curve])

            peak = greatest_curve_measure(points[step, who], measure, lambda _, x=x: x.close, least)
            if peak.curve >= 0:
                t, h = clock[step[peak.curve]].tolist()
                self._set_worst(x, peak.value, t + peak.place * h, int(agents[who[peak.curve]]))

    def _set_worst(self, x: _Boundary, rank: float, when: float, who: int) -> None:
        value = float(QUANTITIES[x.quantity].rank(rank))
        self.worst[x.quantity] = Worst(value, when, who, x.number)
