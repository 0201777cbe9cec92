"""A way home from every second: an abort of the flight, planned and proved before it.

All vehicles slow down along the plan by the clock, at once: the path is the plan's and only its time is another, so
that no two come nearer than the plan proves. From rest they go home in steps of straight ways, each from rest to rest
and all in step, whose least separation is known in closed form. At any landing place the ways have the least sum of
squares, by which vehicles that keep a distance keep a share of it on the way (`formation.assignment`). To their own
places they go straight, or by levels one above the other, or else back along the plan.

A flight that aborts flies these steps as ordinary phases (`phases_of`), after an order as after a loss.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from rigidfleet._common.quantities import PLACES, QUANTITIES
from rigidfleet._common.text import agent_names
from rigidfleet.foreign.curves import curve_to_rows
from rigidfleet.formation.assignment import (
    assign_slots,
    closest_approach,
    downwash_metric,
    pairs_nearer_than,
)
from rigidfleet.kernel.problem import septic_polynomial
from rigidfleet.math import proximity, series
from rigidfleet.math.piecewise import Piecewise, join, pad
from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.boundaries import BoundaryWatch, boundary_in_words
from rigidfleet.mission.kinds import Follow, Land
from rigidfleet.mission.obstacles import is_ground
from rigidfleet.planning.certificate import certificate_of, of_ways
from rigidfleet.planning.courses import ABOVE
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.legs import Leg
from rigidfleet.planning.limits import Limit, limits_of
from rigidfleet.planning.reference import PhaseState, Pose, copy_with
from rigidfleet.planning.vehicles import air_force
from rigidfleet.typing import Bools, Floats, Ints

#: Greatest acceleration [m/s^2], jerk [m/s^3] and speed [m/s] of a vehicle on its way home, unless `limits` asks for
#: less.
BRAKING, JERK, SPEED = 2.0, 5.0, 5.0
#: Height of the last straight way down [m], and the greatest speed [m/s] there.
FINAL, DESCENT = 3.0, 1.0
#: Shortest step [s], ratio of a time tried to the one before, and number of times tried; share that counts as kept.
_SHORTEST, _LONGER, _TRIES, _KEPT = 0.5, 1.1, 40, 1.01
#: Time between knots of a path at another clock [s], with which polynomials of degree 7 differ from it by micrometres;
#: knots that are nearer count as one.
_KNOTS, _NEAR = 0.2, 0.01
#: Samples of a step at which limits are looked at, and greatest way between two at which clearance is [m].
_LOOKS, _PACE = 33, 0.25
#: Least and greatest time between samples of vehicles that fly on [s], and the latter over the number of vehicles.
_SAMPLED = 0.05, 0.25, 5e-4
#: How much farther than in the end vehicles are off their ways while drag changes.
_OVERSHOOT = 1.1
#: Time before its end within which the plan of those that fly on comes to rest on the ground [s].
_TOUCHING = 1.0
#: Steps back along the plan that are tried, and the time in which its clock starts and stops to run back [s].
_BACK, _REVERSING = 1.0, 2.0
#: Height of two stopped vehicles that counts as one [m], for `Ways` that are planned once.
_SAME = 6
#: Progress along the path, of the time of slowing down, by the share of that time: the rate falls from 1 to 0 as
#: 1 - 10 x^3 + 15 x^4 - 6 x^5, so that acceleration and jerk stay continuous; and the blend of straight ways.
_SLOWING = np.array([0.0, 1.0, 0.0, 0.0, -2.5, 3.0, -1.0])
_BLEND = septic_polynomial(np.polynomial.Polynomial([0.0, 1.0])).coef
#: Greatest change of the rate and of that, over powers of the time of slowing down.
_STEEPEST, _BENT = 1.875, 5.774
#: Vertical, of `downwash_metric`; and what of a place is seen from above.
_UP, _ABOVE = np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 0.0])


class Nearest(NamedTuple):
    """The least distance between the surfaces of two vehicles [m], when [s], and which two, from 0."""

    separation: float
    time: float
    agents: tuple[int, int]


_APART_FOR_EVER = Nearest(math.inf, 0.0, (0, 0))


class Step(NamedTuple):
    """One step of an abort, from its beginning.

    Attributes
    ----------
    name : what it is called
    duration : [s]
    least : separation that is proved, its time from the beginning
    at : positions (K, N, 3) [m] at times (K,) [s]
    ways : the ways of all vehicles, pieces (K, N, 3, P)
    end : positions (N, 3) [m] at its end
    off : by how much nearer two vehicles may be in flight, since each is off its way [m]
    lands : whether vehicles come straight down to the ground in it
    """

    name: str
    duration: float
    least: Nearest
    at: Callable[[Floats], Floats]
    ways: Callable[[], Piecewise]
    end: Floats
    off: float = 0.0
    lands: bool = False


@dataclass(frozen=True)
class Abort:
    """What follows if the flight is aborted at a time.

    Attributes
    ----------
    ordered, begins : when the order is given, and when all vehicles act on it [s]
    steps : from then on
    way : how the vehicles go home
    reason : why there is no way that is proved; "" if there is one
    number : of the ways from rest, which other aborts may share
    home : the steps from rest of those that go home
    waits, slows : how long these fly on before they slow down, and how long that takes [s]
    """

    ordered: float
    begins: float
    steps: tuple[Step, ...]
    way: str
    reason: str = ""
    number: int = 0
    home: tuple[Step, ...] = ()
    waits: float = 0.0
    slows: float = 0.0

    @property
    def stops(self) -> float:
        """When those that go home have stopped on the plan [s]."""
        return self.begins + self.waits + self.slows

    @property
    def end(self) -> float:
        """When all vehicles rest [s]."""
        return self.begins + sum(step.duration for step in self.steps)

    @property
    def least(self) -> Nearest:
        """The least separation that is promised, in mission time: what is proved, less what vehicles are off."""
        best, t = _APART_FOR_EVER, self.begins
        for step in self.steps:
            apart, time, who = step.least
            best = min(best, Nearest(apart - step.off, t + time, who))
            t += step.duration
        return best

    def at(self, time: Floats) -> Floats:
        """Positions (K, N, 3) [m] at mission times (K,) [s] from `begins` on; at rest after the last step."""
        r, t = np.repeat(self.steps[-1].end[None], len(time), axis=0), self.begins
        for step in self.steps:
            during = (time >= t) & (time < t + step.duration)
            if during.any():
                r[during] = step.at(time[during] - t)
            t += step.duration
        return r


class Plan(NamedTuple):
    """The planned paths of all vehicles, leg by leg."""

    legs: Sequence[Leg]

    @property
    def end(self) -> float:
        """When the last leg ends [s]."""
        return self.legs[-1].end

    @property
    def lands(self) -> bool:
        """Whether the vehicles stand on the ground at its end."""
        return bool(self.legs[-1].phase.lands)

    def number_at(self, time: Floats) -> Ints:
        """Number (K,) of the leg at times (K,) [s]; at a switch, of the one before."""
        return np.minimum(np.searchsorted([x.end for x in self.legs], time), len(self.legs) - 1)

    def states(self, time: Floats, orders: int, middle: Floats | None = None) -> Floats:
        """Position and derivatives (K, orders, N, 3) at times (K,) [s], in the legs of the times ``middle`` (K,)."""
        legs = self.number_at(time if middle is None else middle)
        parts = [(self.legs[k].paths, time[legs == k]) for k in np.unique(legs)]
        x = np.concatenate([slot_derivatives(*paths, t, orders) for paths, t in parts])
        return x[np.argsort(np.argsort(legs, kind="stable"), kind="stable")]

    def least(self, begin: float, end: float, lost: Bools | None) -> Nearest:
        """The least separation that the legs between two times prove [s], lost vehicles (N,) set aside."""
        best = _APART_FOR_EVER
        first, last = self.number_at(np.array([begin, end]))
        for leg in self.legs[first : last + 1]:
            proved = leg.certificate
            if lost is not None:
                proved = certificate_of(leg.phase, leg.reference, leg.radius, lost)
            if proved is not None:
                best = min(best, Nearest(*proved[:3]))
        return best


class Along(NamedTuple):
    """The planned paths at another clock: the time along them [s], as a curve of the time since the beginning."""

    plan: Plan
    clock: Piecewise

    @property
    def duration(self) -> float:
        """Of the clock [s]."""
        return float(self.clock.time[-1])

    def at(self, t: Floats) -> Floats:
        """Positions (K, N, 3) [m] at times (K,) since the beginning [s]."""
        return self.plan.states(self.clock.at(t), 1)[:, 0]

    def states(self, t: Floats, middle: Floats | None = None) -> Floats:
        """Position, velocity, acceleration, jerk (K, 4, N, 3) at times (K,), in the legs of the times ``middle``."""
        s = self.clock.states(t, 4)
        x = self.plan.states(s[0], 4, None if middle is None else self.clock.at(middle))
        first, second, third = (rate[:, None, None] for rate in s[1:])  # and the chain rule
        jerk = x[:, 3] * first**3 + 3.0 * x[:, 2] * first * second + x[:, 1] * third
        moves = x[:, 0], x[:, 1] * first, x[:, 2] * first**2 + x[:, 1] * second, jerk
        return np.stack(moves, axis=1)

    def ways(self) -> Piecewise:
        """The ways of all vehicles (K, N, 3, 8): pieces that meet the path with three derivatives at their ends."""
        steps = max(2, math.ceil(self.duration / _KNOTS) + 1)
        knots, fine = [self.clock.time], np.linspace(0.0, self.duration, 50 * steps)
        path = self.clock.at(fine)
        order = np.argsort(path)
        for leg in self.plan.legs:  # where the plan's own polynomials change
            own = np.unique([leg.end, *leg.paths[0].knots, *leg.paths[1].knots])
            own = own[(own > path.min()) & (own < path.max())]
            if len(own) < 4 * steps:
                knots.append(np.interp(own, path[order], fine[order]))
        time = np.unique(np.concatenate([np.linspace(0.0, self.duration, steps), *knots]))
        time = time[np.append(True, np.diff(time) > _NEAR)]
        time[-1] = self.duration
        middle = 0.5 * (time[:-1] + time[1:])
        ends = (self.states(t, middle).swapaxes(0, 1) for t in (time[:-1], time[1:]))
        return Piecewise.of_ends(time, *ends)


def _clock(begin: float, *rates: tuple[float, float, float]) -> Piecewise:
    """The time along the path, from a beginning on, whose rate goes from one value to another within times [s]."""
    knots, pieces = [0.0], []
    for before, after, time in (x for x in rates if x[2] > 0.0):
        share = before * np.eye(7)[1] + (after - before) * (np.eye(7)[1] - _SLOWING)
        piece = share * time ** (1.0 - np.arange(7.0))
        pieces.append(np.append(begin, piece[1:]))
        begin += 0.5 * (before + after) * time
        knots.append(knots[-1] + time)
    return Piecewise(np.array(knots), np.array(pieces))


class _Judge:
    """The limits of a mission as they hold for an abort, and the least distances that its ways keep."""

    def __init__(self, mission: Mission, lost: Bools | None) -> None:
        own = mission.limits
        gentle = {"acceleration": BRAKING, "jerk": JERK, "speed": SPEED}
        self.mission, self.lost = mission, lost
        self.left = np.flatnonzero(np.ones(mission.n_agents) if lost is None else ~lost)
        self.radius = mission.fleet.radius
        self.limits = limits_of(mission)
        home = {name: min(most, getattr(own, name) or most) for name, most in gentle.items()}
        self.home = limits_of(mission, own.model_copy(update=home))
        widest = 2.0 * float(self.radius.max())
        self.need = own.separation or 0.0
        # Vehicles with rotors are off their ways by what both may be off, and all by the drag that no law knows.
        rotors = not all(model.point for model in mission.vehicle_models or ())
        off = own.separation_allowance if own.tracking_error is None else 2.0 * own.tracking_error
        self.off = off if rotors else 0.0
        self.apart = widest + self.need + max(own.separation_allowance, self.off)
        self.below = max(self.apart, widest + (own.separation_below or 0.0))
        self.things = mission.solids

    def shares(self, limits: list[Limit], x: Floats) -> Floats:
        """Greatest share (L,) of each limit in states (K, orders, N, 3) of those left."""
        who = self.left
        return np.array([(q.values(x[:, :, who], who) / q.most[who]).max() for q in limits])

    def off_at(self, at: Callable[[Floats], Floats], duration: float) -> float:
        """By how much nearer than their ways two vehicles may be in flight [m].

        Drag in proportion to the speed holds vehicles off their ways that fly differently, as tracking answers to it.
        """
        mission, who = self.mission, self.left
        if not mission.drag.any() or duration == 0.0 or len(who) < 2:
            return self.off
        time = np.linspace(0.0, duration, _LOOKS)
        v = np.gradient(at(time)[:, who], time, axis=0)
        d = mission.disturbances
        wind = np.zeros(3) if d is None else np.array(d.wind)
        push = air_force(mission, wind - v, who)
        if mission.tracking.drag_feedforward:
            push = push - air_force(mission, -v, who)
        push = push / (mission.fleet.mass[who, None] * mission.tracking_gains[0])
        apart = np.linalg.norm(push - push.mean(axis=1, keepdims=True), axis=2)
        return self.off + 2.0 * _OVERSHOOT * float(apart.max())

    def nearest(self, start: Floats, end: Floats, duration: float) -> Nearest:
        """The least separation on straight ways in step between places (N, 3) [m], in closed form."""
        if len(self.left) < 2:
            return _APART_FOR_EVER
        who = self.left
        least, (i, j), share = closest_approach(start[who], end[who], self.radius[who])
        flown = septic_polynomial(np.linspace(0.0, 1.0, 1001))
        time = duration * float(np.interp(share, flown, np.linspace(0.0, 1.0, 1001)))
        return Nearest(least, time, (int(who[i]), int(who[j])))

    def least_time(self, time: float, excess: Callable[[float], Floats]) -> tuple[float, Floats]:
        """The least time from a first one on [s] that exceeds no limit, and the shares of them that it takes."""
        time = max(time, _SHORTEST)
        for _ in range(_TRIES):
            over = excess(time)
            if over.max(initial=0.0) <= _KEPT:
                break
            time *= _LONGER
        return time, over

    def straight(self, name: str, start: Floats, end: Floats, *, lands: bool = False) -> Step:
        """The step of straight ways, in step and from rest to rest, in the least time that keeps the limits."""
        way, time = end - start, 0.0
        if (longest := float(np.linalg.norm(way, axis=1).max())) > 1e-9:
            x = np.linspace(0.0, 1.0, _LOOKS)
            s = series.derivatives(series.of_polynomials(np.tile(_BLEND, (_LOOKS, 1)), x, 4))
            moves = s.T[:, :, None, None] * way
            moves[:, 0] += start
            allowed = self.shares(self.home, 0.0 * moves)  # at rest

            def excess(time: float) -> Floats:
                powers = time ** -np.arange(4.0)[:, None, None]
                return self.shares(self.home, moves * powers) / np.maximum(allowed, 1.0)

            fastest = DESCENT if lands else SPEED
            time, _ = self.least_time(2.1875 * longest / fastest, excess)
        scaled = _BLEND * max(time, 1e-3) ** -np.arange(8.0)
        piece = start[..., None] * np.eye(8)[0] + way[..., None] * scaled
        curve = Piecewise(np.array([0.0, max(time, 1e-3)]), piece[None])
        least, off = self.nearest(start, end, time), self.off_at(curve.at, time)
        return Step(name, time, least, curve.at, partial(_itself, curve), end, off, lands)

    def obstruction(self, step: Step, begin: float, *, along: bool = False) -> str:
        """What keeps a step from being flown, from a time [s] on; "" if nothing does.

        A step ``along`` the plan is where the plan is, but for obstacles that move.
        """
        least, limits, n = step.least, self.mission.limits, 2
        if along:
            things = [x for x in self.things if x.solid.moves]
            n += math.ceil(step.duration * SPEED / _PACE)
        else:
            things = [x for x in self.things if not (step.lands and is_ground(x))]
            way = step.end - step.at(np.zeros(1))[0]
            n += math.ceil(float(np.linalg.norm(way, axis=1).max()) / _PACE)
            apart = least.separation - step.off
            if apart < max(self.need, 1e-6) and not self._on_pads(step):
                who, limit = agent_names(least.agents), f"(limit {self.need:g} m)"
                return f"{who} come within {max(apart, 0.0):.2f} m on the way {step.name} {limit}"
        time = np.linspace(0.0, step.duration, n)
        r, radius = step.at(time)[:, self.left], self.radius[self.left]
        if limits.geofence is not None and not along:
            low, high = (np.array(x) for x in (limits.geofence.min, limits.geofence.max))
            out = np.maximum(low - r, r - high).max(axis=2) + radius
            k, i = np.unravel_index(int(out.argmax()), out.shape)
            if out[k, i] > 1e-6:
                return f"agent {self.left[i] + 1} leaves the geofence by {out[k, i]:.2f} m on the way {step.name}"
        if limits.separation_below is not None and len(self.left) > 1 and not along:
            height, pair = proximity.headroom(r, radius)
            k = int(height.argmin())
            if height[k] < limits.separation_below - 1e-6:
                who = agent_names(int(self.left[i]) for i in sorted(pair[k].tolist()))
                return f"{who} are {height[k]:.2f} m above each other on the way {step.name}"
        if crossing := self._crossing(step, begin):
            return f"{crossing}, on the way {step.name}"
        if not things:
            return ""
        room, near = proximity.obstacle_clearances(r, radius, things, begin + time)
        k, i = np.unravel_index(int(room.argmin()), room.shape)
        if (
            room[k, i] < _PACE
        ):  # more than half the way between two samples, at twice the mean speed
            thing = things[int(near[k, i])].name
            return f"'{thing}' stands in the way {step.name} of agent {self.left[i] + 1}"
        return ""

    def _crossing(self, step: Step, begin: float) -> str:
        """Where a step crosses a hard fence, or leads vehicles that fail onto people; "" if nowhere."""
        mission, watch = self.mission, BoundaryWatch(self.mission)
        if watch.every:
            watch.take_way(step.ways(), np.isin(np.arange(mission.n_agents), self.left))
        for name, x in watch.search().items():
            q = QUANTITIES[name]
            limit, place = q.limit_of(mission), getattr(mission, PLACES[q.who])[x.other].name
            if limit is not None and q.rank(x.value) > q.rank(limit) + 1e-6:
                who = f"agent {x.who + 1}"
                return boundary_in_words(name, who, place, x.value, begin + x.time)
        return ""

    def _on_pads(self, step: Step) -> bool:
        """Whether vehicles are near each other only where their separation is not limited, as on their pads."""
        altitude, least = self.mission.limits.separation_altitude, step.least
        both = step.at(np.zeros(1))[0, list(least.agents), 2]
        return altitude is not None and bool((both < altitude).all()) and least.separation > 0.0


#: Name of a straight step, and places (N, 3) [m] before and after it.
Stop = tuple[str, Floats, Floats]
#: Steps of ways from rest, what they are called, and why there are none.
Ways = tuple[list[Step], str, str]


class Homes:
    """Ways home from rest; those of equal stopped places are planned once."""

    def __init__(
        self, mission: Mission, plan: Plan, lost: Bools | None = None, to: str | None = None
    ) -> None:
        self.mission, self.plan, self.judge = mission, plan, _Judge(mission, lost)
        self.to = to or mission.aborting.to
        start = mission.fleet.position
        below = mission.height_at(*start.T) + ABOVE + mission.fleet.radius
        self.stands = bool(mission.standing(start).all() and np.isfinite(below).all())
        self.start = np.column_stack([start[:, :2], below])
        self.known: dict[bytes, tuple[int, Ways]] = {}
        self.moves = any(x.solid.moves for x in self.judge.things)

    def ways(self, r: Floats, begin: float, path: float) -> tuple[int, Ways]:
        """Number and ways from places (N, 3) [m] where all rest at ``begin`` [s], at a time [s] along the plan."""
        key = np.round(r, _SAME).tobytes() + (np.array([begin]).tobytes() if self.moves else b"")
        if key not in self.known:
            number, ways = len(self.known), self.search(r, begin)
            self.known[key] = number, ways
            if not ways[0] and np.isfinite(self.places(r)).all():
                self.known[key] = number, self._back(ways, begin, path)
        return self.known[key]

    def _back(self, ways: Ways, begin: float, path: float) -> Ways:
        """Back along the plan from a time [s] along it, to where there is a way; the same, if there is none."""
        judge = self.judge
        for k in range(1, math.ceil(path / _BACK) + 1):
            to = max(0.0, path - k * _BACK)
            time = min(_REVERSING, path - to)
            rates = (0.0, -1.0, time), (-1.0, -1.0, path - to - time), (-1.0, 0.0, time)
            step = self.along("back along the plan", _clock(path, *rates), to)
            if judge.obstruction(step, begin, along=True):
                continue
            steps, way, _ = self.search(step.end, begin + step.duration)
            if way:
                return [step, *steps], f"back along the plan, and {way}", ""
        return ways

    def along(self, name: str, clock: Piecewise, to: float) -> Step:
        """A step along the plan by a clock, from its first time to another one [s], in either direction."""
        along, end = Along(self.plan, clock), self.plan.end
        first, last = sorted((float(clock.pieces[0, 0]), to))
        least = self.plan.least(min(first, end), min(last, end), self.judge.lost)
        time = along.duration
        off, stop = self.judge.off_at(along.at, time), along.at(np.array([time]))[0]
        return Step(name, time, least._replace(time=0.0), along.at, along.ways, stop, off)

    def search(self, r: Floats, begin: float) -> Ways:
        """Steps, the name of their way, and why there are none."""
        left, goal = self.judge.left, r.copy()
        goal[left] = self.places(r)[left]  # lost ones stay
        if not np.isfinite(goal).all():
            return [], "", "there is no ground to land on: add [[obstacles]] with kind = 'ground'"
        reasons, off = [], 0.0
        # Levels are tried again with as much more between them as vehicles were off their ways.
        own = "straight to their own", "by levels", "by levels"
        for way in ("to any place",) if self.to == "any" else own:
            steps: list[Step] = []
            problem, t = "", begin
            for name, a, b in self._stops(way, r, goal, off):
                step = self.judge.straight(name, a, b, lands=name == "down")
                if step.duration > 0.0:
                    steps.append(step)
                    problem = problem or self.judge.obstruction(step, t)
                    t += step.duration
            if not problem:
                return steps, way, ""
            off = max(step.off for step in steps)
            reasons.append(f"{way}: {problem}")
        return [], "", "; ".join(reasons)

    def _stops(self, way: str, r: Floats, goal: Floats, off: float) -> list[Stop]:
        """The straight ways from places to others (N, 3) [m] on the ground, if vehicles are off theirs [m].

        By levels, they go apart, across and down. Who is above another one stays above it.
        """
        judge, left, stops = self.judge, self.judge.left, []
        p, q = r[left], goal[left]
        if way == "to any place":
            metric, goal = downwash_metric(_UP, judge.below / judge.apart), goal.copy()
            goal[left] = q[assign_slots(p, q, turn=np.eye(3), metric=metric).order]
        if way == "by levels":
            height = _levels(judge.apart + off, p, q) * (judge.below + off)
            height += max(q[:, 2].max() + FINAL, p[:, 2].mean() - 0.5 * height.max())
            one, two = r.copy(), goal.copy()
            one[left, 2] = two[left, 2] = height
            stops, r = [("apart", r, one), ("across", one, two)], two
        # No higher than the lowest of them.
        rise = max(0.0, min(FINAL, float((r[left, 2] - goal[left, 2]).min())))
        above = goal + rise * _UP
        return [*stops, ("over the places", r, above), ("down", above, goal)]

    def places(self, r: Floats) -> Floats:
        """Landing places (N, 3) [m] of the vehicles' centres.

        Where they stood at the start; if they did not stand on the ground, a square grid below where they stop.
        """
        if self.stands:
            return self.start
        judge = self.judge
        n, near, apart = len(r), math.inf, judge.apart
        if len(judge.left) > 1:
            near = float(proximity.nearest(r[judge.left]).min())
        wide = near / math.sqrt(max(near**2 - apart**2, 0.1 * near**2)) if near < math.inf else 1.0
        side = math.ceil(math.sqrt(n))
        k = np.arange(n)
        grid = np.column_stack([k % side, k // side]) - 0.5 * (side - 1)
        xy = r[judge.left, :2].mean(axis=0) + 1.05 * apart * max(wide, 1.2) * grid
        z = self.mission.height_at(*xy.T) + ABOVE + self.mission.fleet.radius
        return np.column_stack([xy, z])


def _itself(curve: Piecewise) -> Piecewise:
    return curve


def _in_a_row(curves: Sequence[Piecewise]) -> Piecewise:
    """Curves from 0 [s], one after the other, with 8 powers."""
    ends = np.cumsum([0.0, *(float(x.time[-1]) for x in curves)])
    times = [x.time[1:] + t for x, t in zip(curves, ends, strict=False)]
    pieces = [pad(x.pieces, 8) for x in curves]
    return Piecewise(np.concatenate([[0.0], *times]), np.concatenate(pieces))


def _levels(distance: float, p: Floats, q: Floats) -> Ints:
    """Level (N,) of each vehicle, from 0: others on ways across that come nearer than a distance [m] get another one.

    Of two that are one above the other at first, the higher one gets the higher level.
    """
    n = len(p)
    near: list[list[int]] = [[] for _ in range(n)]
    for i, j in pairs_nearer_than(distance, p * _ABOVE, q * _ABOVE).tolist():
        near[i].append(j)
        near[j].append(i)
    level = np.full(n, -1)
    for i in np.argsort(p[:, 2], kind="stable").tolist():
        others = np.array([j for j in near[i] if level[j] >= 0], dtype=np.int64)
        under = others[np.linalg.norm((p[others] - p[i])[:, :2], axis=1) < distance]
        taken = set(level[others].tolist())
        k = int(level[under].max(initial=-1)) + 1
        while k in taken:
            k += 1
        level[i] = k
    return level


class Aborts:
    """The aborts of a mission, from its legs: of each second (`every`), or of one time (`at`)."""

    def __init__(self, mission: Mission, legs: Sequence[Leg], lost: Bools | None = None) -> None:
        self.mission, self.plan = mission, Plan(legs)
        self.options = mission.aborting
        self.homes = Homes(mission, self.plan, lost)
        self.judge = self.homes.judge

    def every(self) -> Iterator[Abort]:
        """The abort of each `step` of the flight."""
        end = self.plan.end - self.options.reaction
        for k in range(1 + max(0, math.floor(end / self.options.step - 1e-9))):
            yield self.at(k * self.options.step)

    def at(self, ordered: float) -> Abort:
        """What follows from an order at a time [s]."""
        return self._leaving(ordered) if self.options.agents else self.of_all(ordered)

    @cached_property
    def _alone(self) -> Aborts:
        """The aborts of those that leave, who land where the plan leads them, if it lands."""
        stay = np.ones(self.mission.n_agents, dtype=np.bool_)
        stay[np.array(self.options.agents) - 1] = False
        alone = Aborts(self.mission, self.plan.legs, stay)
        if self.plan.lands:
            alone.homes.start = self.plan.states(np.array([self.plan.end]), 1)[0, 0]
        return alone

    @cached_property
    def _on(self) -> Piecewise:
        """The plan of all vehicles as one curve of mission time, which ends at rest."""
        end = self.plan.end
        on = Along(self.plan, _clock(0.0, (1.0, 1.0, end))).ways()
        last = np.array([max(0.0, end - _TOUCHING), end])
        states = on.states(last, 4)
        states[1:, 1] = 0.0  # a landing ends with the speed at which it touches down
        return _in_a_row([on.between(0.0, last[0]), Piecewise.hermite(last - last[0], states)])

    def _leaving(self, ordered: float) -> Abort:
        """Some vehicles go home, as soon as they come near no other one; the others fly the plan on."""
        begins, end = ordered + self.options.reaction, self.plan.end
        left, who, judge = self.judge.left, np.array(self.options.agents) - 1, self.judge
        order = np.concatenate([np.intersect1d(left, who), np.setdiff1d(left, who)])
        problem, on = "there is no time left", self._on.between(begins, end).later(-begins)
        for waits in np.arange(0.0, end - begins, self.options.step).tolist():
            alone = self._alone.of_all(ordered + waits)
            if alone.reason:
                problem = alone.reason
                continue
            before = [on.between(0.0, waits)] if waits else []
            own = _in_a_row([*before, *(step.ways() for step in alone.steps)])
            each = [own if i in who else on for i in range(self.mission.n_agents)]
            curve = join([Piecewise(x.time, x.pieces[:, i]) for i, x in enumerate(each)])
            among = curve.pieces[:, order]
            proved = of_ways(curve.time, among, judge.radius[order], len(who))
            i, j = (int(order[k]) for k in proved.agents)
            least = self.plan.least(begins, end, judge.lost)._replace(time=0.0)
            least = min(Nearest(proved.separation, proved.time, (i, j)), least)
            duration, last = float(curve.time[-1]), curve.at(curve.time[-1:])[0]
            off = judge.off_at(curve.at, duration)
            if proved.separation - off >= max(judge.need, 1e-6):
                way = f"{agent_names(who.tolist())} {'leaves' if len(who) == 1 else 'leave'}"
                way += f" after {waits:g} s" if waits else ""
                ways = partial(_itself, curve)
                step = Step("leave", duration, least, curve.at, ways, last, off)
                number, (slow, *home) = round(ordered / self.options.step), alone.steps
                return Abort(
                    ordered, begins, (step,), way, "", number, tuple(home), waits, slow.duration
                )
            problem = f"{agent_names((i, j))} come within {max(proved.separation - off, 0.0):.2f} m"
        return Abort(ordered, begins, (), "", problem)

    def of_all(self, ordered: float) -> Abort:
        """What follows for all at once."""
        begins = ordered + self.options.reaction
        plan, judge = self.plan, self.judge
        untracked = [x.phase for x in plan.legs if x.end > begins and x.phase.control != "tracking"]
        if untracked and untracked[0] is plan.legs[plan.number_at(np.array([begins]))[0]].phase:
            reason = f"only tracked slots can slow down, and '{untracked[0].name}' tracks none"
            return Abort(ordered, begins, (), "", reason)
        time, problem = self._slowing(begins)
        path = begins + 0.5 * time
        if path >= plan.end and plan.lands:
            on = _clock(begins, (1.0, 1.0, max(plan.end - begins, _SHORTEST)))
            step = self.homes.along("to its end", on, plan.end)
            return Abort(ordered, begins, (step,), "lands as planned")
        step = self.homes.along("slow down", _clock(begins, (1.0, 0.0, time)), path)
        if not problem and step.least.separation < max(judge.need, 1e-6):
            who, least = agent_names(step.least.agents), step.least.separation
            problem = f"the plan itself leads {who} within {max(least, 0.0):.2f} m of each other"
        if problem := problem or judge.obstruction(step, begins, along=True):
            return Abort(ordered, begins, (step,), "", problem)
        number, (steps, way, reason) = self.homes.ways(step.end, begins + time, path)
        return Abort(ordered, begins, (step, *steps), way, reason, number, tuple(steps), 0.0, time)

    @cached_property
    def _samples_of_plan(self) -> tuple[Floats, Floats]:
        """Times (K,) of the whole plan [s], and the places (K, N, 3) [m] in it."""
        least, most, each = _SAMPLED
        step = min(max(least, each * self.mission.n_agents), most)
        time = np.arange(0.0, self.plan.end, step)
        return time, self.plan.states(time, 1)[:, 0]

    def if_not_heard(self, abort: Abort) -> list[Nearest]:
        """How near each vehicle comes to others if it does not hear the order and flies on, until these rest.

        At samples; the first of the agents is the one that flies on.
        """
        from scipy.spatial import KDTree

        left, (time, places) = self.judge.left, self._samples_of_plan
        some = (time > abort.begins) & (time < abort.end)
        if len(left) < 2 or not abort.steps or not some.any():
            return []
        time, on, others = time[some], places[some][:, left], abort.at(time[some])[:, left]
        nearest = [KDTree(b).query(a, 2) for a, b in zip(on, others, strict=True)]
        far, whom = np.array([x for x, _ in nearest]), np.array([x for _, x in nearest])
        itself = whom[..., 0] == np.arange(len(left))
        far, whom = (np.where(itself, x[..., 1], x[..., 0]) for x in (far, whom))
        far = far - self.judge.radius[left] - self.judge.radius[left[whom]]
        return [
            Nearest(float(far[k, i]), float(time[k]), (int(left[i]), int(left[whom[k, i]])))
            for i, k in enumerate(far.argmin(axis=0))
        ]

    def _slowing(self, begins: float) -> tuple[float, str]:
        """The least time of slowing down that keeps the limits [s], and what breaks them if none does.

        Where the plan itself is beyond a limit, that counts as the limit.
        """
        plan, judge, x = self.plan, self.judge, np.linspace(0.0, 1.0, _LOOKS)

        def excess(time: float) -> Floats:
            slowing = Along(plan, _clock(begins, (1.0, 0.0, time)))
            allowed = judge.shares(judge.limits, plan.states(begins + 0.5 * time * x, 4))
            return judge.shares(judge.limits, slowing.states(time * x)) / np.maximum(allowed, 1.0)

        v = plan.states(np.array([begins]), 2)[0, 1, judge.left]
        speed = float(np.linalg.norm(v, axis=1).max())
        first = max(_STEEPEST * speed / BRAKING, math.sqrt(_BENT * speed / JERK))
        time, over = judge.least_time(first, excess)
        if over.max(initial=0.0) <= _KEPT:
            return time, ""
        q = judge.limits[int(over.argmax())].of
        return time, f"slowing down would break the limit of {q.name_in_words}"


def phases_of(mission: Mission, steps: Sequence[Step], what: str) -> list[Phase]:
    """The phases that fly steps: each vehicle follows its ways, and at the end it comes straight down."""
    phases: list[Phase] = []
    for step in steps:
        name, time = f"{what}: {step.name}", step.duration
        if step.lands:
            everyone = tuple(range(1, mission.n_agents + 1))
            phases.append(Land(kind="land", name=name, agents=everyone, duration=time))
            continue
        knots, pieces = step.ways()
        level = np.zeros_like(pieces[:, :, :1])  # whose yaw follows [yaw]
        rows = tuple(
            tuple(map(tuple, curve_to_rows(Piecewise(knots, one))))
            for one in np.concatenate([pieces, level], axis=2).swapaxes(0, 1)
        )
        phases.append(Follow(kind="follow", name=name, trajectories=rows, duration=time))
    return phases


def state_to_leave(leg: Leg, now: PhaseState, t: float) -> PhaseState:
    """The state at a time [s] from which all vehicles leave the plan, each with the motion that it is led on.

    The virtual body is their mean and no longer turns; no formation outlasts it.
    """
    x = slot_derivatives(*leg.paths, np.array([t]), 4)[0]
    mass = leg.masses
    r, v, a, jerk = mean = np.einsum("i,kiq->kq", mass / mass.sum(), x)
    assert now.pose is not None
    T = now.pose.T
    own = (x - mean[:, None]) @ T.T
    pose = Pose(r, v, T, np.zeros(3), a=a, jerk=jerk)
    goal = Pose(r, np.zeros(3), T, np.zeros(3))
    return copy_with(
        now, pose=pose, goal=goal, slots=own[0], rates=own[1:], formation=None, blend=None
    )
