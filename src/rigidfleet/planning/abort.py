"""A way home from every second: an abort of the flight, planned and proved before it.

All vehicles slow down along the plan by the clock, at once: the path is the plan's and only its time is another, so
that no two come nearer than the plan proves. From rest they go home in steps of straight ways, each from rest to rest
and all in step, whose least separation is known in closed form. At any landing place the ways have the least sum of
squares, by which vehicles that keep a distance keep a share of it on the way (`formation.assignment`). To their own
places they go straight, or by levels one above the other. Where something stands in the way, they first fly back along
the plan.

A flight that aborts flies these steps as ordinary phases (`phases_of`), after an order as after a loss.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from rigidfleet._common.quantities import PLACES, QUANTITIES
from rigidfleet._common.text import agent_names
from rigidfleet.foreign.curves import curve_to_rows
from rigidfleet.formation.assignment import assign_slots, downwash_metric, pairs_nearer_than
from rigidfleet.kernel.problem import septic_polynomial
from rigidfleet.math import falls, proximity
from rigidfleet.math.piecewise import Piecewise, common_knots, concatenate_curves, refine_knots
from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.boundaries import Boundaries, BoundaryWatch, Worst, boundary_in_words
from rigidfleet.mission.kinds import Follow, Land
from rigidfleet.mission.obstacles import Sphere, is_ground
from rigidfleet.planning.avoidance import kept_distances, why_no_landing
from rigidfleet.planning.certificate import (
    PROOF_SLACK,
    Certificate,
    certificate_of,
    prove_straight_ways,
    prove_ways,
)
from rigidfleet.planning.clearance import shift_bound
from rigidfleet.planning.courses import ABOVE
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.legs import Leg
from rigidfleet.planning.limits import Limit, limits_of
from rigidfleet.planning.reference import PhaseState, Pose, copy_with
from rigidfleet.planning.vehicles import drag_and_lift
from rigidfleet.typing import Bools, Floats, Ints

#: Greatest acceleration [m/s^2], jerk [m/s^3] and speed [m/s] of a vehicle on its way home, unless `limits` asks for
#: less.
BRAKING, JERK, _SPEED = 2.0, 5.0, 5.0
#: Greatest vertical speed of a vehicle with rotors [m/s], which descends in its own inflow.
_SINKING = 2.5
#: Height of the last straight way down [m], and the greatest speed [m/s] there.
FINAL, DESCENT = 3.0, 1.0
#: Shortest step [s], ratio of a time tried to the one before, and number of times tried.
SHORTEST, _LONGER, _TRIES = 0.5, 1.1, 60
#: Share of a limit that steps may use, which are looked at in samples alone; share of that which counts as kept.
_USED, _KEPT = 0.98, 1.0 + 1e-6
#: Time between knots of the plan as polynomials of degree 7 [s], which differ from it by micrometres; knots that are
#: nearer count as one.
_KNOTS, _NEAR = 0.2, 0.01
#: Samples of a step at which limits are looked at, and greatest way between two, halved, at which clearance is [m].
_LOOKS, _PACE = 33, 0.25
#: Least and greatest time between samples of vehicles that fly on [s], and the latter over the number of vehicles.
_SAMPLED = 0.05, 0.25, 5e-4
#: How far from its fall by the plan a lost vehicle may be [m], and over its acceleration by the wind [s^2], which blows
#: it on along the ground.
_ASTRAY, _BLOWN = 0.1, 0.5
#: Time between places of a fall, between which it is taken as straight [s]; one at which all lie.
_FALLING, _EVER = 0.1, 1e6
#: How much farther than in the end vehicles are off their ways while drag changes.
_OVERSHOOT = 1.1
#: Time before its end within which a plan that lands comes to rest on the ground [s].
_TOUCHING = 1.0
#: Shortest rest of a plan [s].
_LEAST = 0.01
#: Steps back along the plan that are tried [s].
_BACK = 1.0
#: Decimals of stopped places [m] that count as the same, whose ways home are planned once.
_SAME = 6
#: Progress along the path, of the time of slowing down, by the share of that time: the rate falls from 1 to 0 as
#: 1 - 10 x^3 + 15 x^4 - 6 x^5, so that acceleration and jerk stay continuous; and of a flight that goes on.
_SLOWING = np.array([0.0, 1.0, 0.0, 0.0, -2.5, 3.0, -1.0])
_ON = np.array([0.0, 1.0])
#: From rest to rest, by that share.
_BLEND = septic_polynomial(np.polynomial.Polynomial(_ON)).coef
#: Greatest change of the rate and of that, over powers of the time of slowing down; greatest speed of a straight way.
_STEEPEST, _BENT, _FASTEST = 1.875, 5.774, 2.1875
#: Vertical, of `downwash_metric`; and what of a place is seen from above.
_UP, _ABOVE = np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 0.0])
_APART_FOR_EVER = Certificate(math.inf, 0.0, (0, 0), "closed form")


#: When something happens in a step, in words; in others, on the way by that name.
_ON_STEP = {
    "slow down": "while slowing down", "leave": "on leaving", "apart": "while moving apart",
    "over the places": "on the way to the places",
}  # fmt: skip


class Step(NamedTuple):
    """One step of an abort, from its beginning.

    Attributes
    ----------
    name : what it is called
    make : makes its `way`: so many ways of so many vehicles are not kept
    duration : how long it takes [s]
    end : positions (N, 3) [m] at its end
    least : separation that is proved, its time from the beginning
    off : by how much nearer two vehicles may be in flight, since each is off its way [m]
    path : time along the plan at its end, if it leads along the plan [s]
    lands : whether vehicles come straight down to the ground in it
    """

    name: str
    make: Callable[[], Piecewise]
    duration: float
    end: Floats
    least: Certificate
    off: float = 0.0
    path: float | None = None
    lands: bool = False

    @property
    def way(self) -> Piecewise:
        """The ways of all vehicles, pieces (K, N, 3, P) from 0 [s]."""
        return self.make()


class Home(NamedTuple):
    """Steps from rest, what their way is called, why there is none, and its number, which aborts may share."""

    steps: tuple[Step, ...] = ()
    way: str = ""
    reason: str = ""
    number: int | None = None


@dataclass(frozen=True)
class Abort:
    """What follows if the flight is aborted at a time.

    Attributes
    ----------
    ordered, begins : when the order is given, and when all vehicles act on it [s]
    steps : from then on
    home : of those that go home, from rest; or why there is no way that is proved
    waits, slows : how long these fly on before they slow down, and how long that takes [s]
    """

    ordered: float
    begins: float
    steps: tuple[Step, ...]
    home: Home
    waits: float = 0.0
    slows: float = 0.0

    @property
    def rest_time(self) -> float:
        """When all vehicles rest [s]."""
        return self.begins + sum(step.duration for step in self.steps)

    @property
    def certificate(self) -> Certificate:
        """The least separation that is promised, in mission time: what is proved, less what vehicles are off."""
        best, t = _APART_FOR_EVER, self.begins
        for step in self.steps:
            apart, time, who, how = step.least
            best = min(best, Certificate(apart - step.off, t + time, who, how))
            t += step.duration
        return best

    def positions_at(self, time: Floats) -> Floats:
        """Positions (K, N, 3) [m] at mission times (K,) [s] from `begins` on; at rest after the last step."""
        return concatenate_curves([step.way for step in self.steps]).at(
            np.minimum(time, self.rest_time) - self.begins
        )


def _rest_to_rest(start: Floats, end: Floats, time: float) -> Piecewise:
    """Straight ways between places (N, 3) [m], from rest to rest in a time [s]."""
    rest = np.zeros((3, 2, *start.shape))
    states = np.concatenate([np.stack([start, end])[None], rest])
    return Piecewise.hermite(np.array([0.0, time]), states)


def _path_clock(begin: float, time: float, progress: Floats) -> Piecewise:
    """The time along a path, from a beginning on, for a time [s]: it goes on by a polynomial (P,) of its share."""
    piece = progress * time ** (1.0 - np.arange(float(len(progress))))
    piece[0] = begin
    return Piecewise(np.array([0.0, time]), piece[None])


def _states_by_clock(x: Floats, rates: Floats) -> Floats:
    """Position and three derivatives (4, K, N, 3) by the time, along a path and its clock (3, K)."""
    first, second, third = rates[:, :, None, None]  # and the chain rule
    jerk = x[3] * first**3 + 3.0 * x[2] * first * second + x[1] * third
    return np.stack([x[0], x[1] * first, x[2] * first**2 + x[1] * second, jerk])


class Aborts:
    """Ways home of the vehicles left, from any time of a plan: of each second (`all_aborts`), or one (`abort_at`).

    A mission's own `abort.to` may be replaced by another one.
    """

    def __init__(
        self, mission: Mission, legs: Sequence[Leg], lost: Bools | None = None, to: str | None = None
    ) -> None:  # fmt: skip
        self.mission, self.legs = mission, legs
        self.options, limits = mission.aborting, mission.limits
        self.to = to or self.options.to
        #: When the plan ends [s], and whether on the ground.
        self.plan_end = legs[-1].end if legs else 0.0
        self.mission_lands = bool(legs) and legs[-1].phase.lands
        self.lost = np.zeros(mission.n_agents, dtype=np.bool_) if lost is None else lost
        self.left, self.radius = np.flatnonzero(~self.lost), mission.fleet.radius
        self.limits = limits_of(mission)
        rotors = not all(model.point for model in mission.vehicle_models or ())
        sinking = _SINKING if rotors else math.inf
        self.home_limits = capped_limits(
            mission, acceleration=BRAKING, jerk=JERK, speed=_SPEED, vertical_speed=sinking
        )
        self.no_landing = why_no_landing(mission)
        self.need, widest = kept_distances(mission)[0], 2.0 * float(self.radius.max())
        # In flight both are off their ways, as far as the verdict allows, but for points that only steady air pushes.
        allowed, most = limits.separation_allowance, limits.tracking_error
        d = mission.all_disturbances
        steady = d.noise is None and d.gusts is None and not np.any(d.mass_error)
        self.off = 0.0 if steady and mission.vehicle_models is None else allowed
        if rotors and most is not None:
            self.off = 2.0 * most
        self.apart = widest + self.need + max(allowed, self.off)
        self.below = max(self.apart, widest + (limits.separation_below or 0.0))
        #: How vehicles fall, and how far from its fall by the plan each one (N,) may be that is lost [m].
        self.fall_model = air = Boundaries(mission)
        self.fall_uncertainty = (
            self.off + _ASTRAY + _BLOWN * air.k * float(np.linalg.norm(air.wind))
        )
        falls_down = mission.gravity >= 1.0
        self.wrecked = np.flatnonzero(self.lost & falls_down)
        self.moves = any(x.solid.moves for x in mission.solids) or self.wrecked.size > 0
        start = mission.fleet.position
        below = mission.height_below(*start.T) + ABOVE + self.radius
        self.stands = bool(mission.is_standing(start).all() and np.isfinite(below).all())
        self.start = np.column_stack([start[:, :2], below])
        self._known: dict[bytes, Home] = {}

    # -- the plan -----------------------------------------------------------------------------------------

    def leg_number_at(self, time: float) -> int:
        """Number of the leg at a time [s]; at a switch, of the one before."""
        ends = [x.end for x in self.legs]
        return min(int(np.searchsorted(ends, time)), len(ends) - 1)

    @cached_property
    def plan(self) -> Piecewise:
        """The paths of all vehicles over mission time, pieces (K, N, 3, 8); beyond the end they go on uniformly."""
        times, pieces = [np.zeros(1)], []
        for leg in (x for x in self.legs if x.end > x.start):
            reference, motion = leg.slots_and_motion
            steps = 2 + math.ceil((leg.end - leg.start) / _KNOTS)
            time = np.linspace(leg.start, leg.end, steps)
            own = np.unique([reference.t0 + reference.T_b, *reference.knots, *motion.knots])
            if len(own) < 4 * steps:  # where the plan's own polynomials change
                time = refine_knots(time, own, _NEAR)
            states = slot_derivatives(reference, motion, time, 4).swapaxes(0, 1)
            times.append(time[1:])
            pieces.append(Piecewise.hermite(time, states).pieces)
        on = np.zeros_like(pieces[-1][:1])
        on[0, ..., :2] = np.moveaxis(Piecewise(time, pieces[-1]).states(time[-1:], 2)[:, 0], 0, -1)
        return Piecewise(np.concatenate([*times, time[-1:] + 1.0]), np.concatenate([*pieces, on]))

    @cached_property
    def wrecks(self) -> list[Sphere]:
        """The lost vehicles, wider by `fall_uncertainty`, which fall from where they were by the plan, and then lie."""
        air, lost_at, wrecks = self.fall_model, self.mission.lost_at, []
        for i in self.wrecked.tolist():
            states = self.plan.states(lost_at[[i]], 2)
            (r, v), k = states[:, 0, i], air.k[[i]]
            height = r[2] - air.ends_of_falls(*states)[:, i, 2] - self.radius[i]
            tau = float(falls.fall_time(height, v[2:], k, air.wind[2], air.g)[0])
            time = np.linspace(0.0, max(tau, SHORTEST), 2 + math.ceil(tau / _FALLING))
            places = falls.fall_places(r, v, np.minimum(time, tau), float(k[0]), air.wind, air.g)
            moves = {"waypoints": places.tolist(), "times": (lost_at[i] + time).tolist()}
            size = float(self.radius[i] + self.fall_uncertainty[i])
            wrecks.append(Sphere(kind="sphere", name=f"lost agent {i + 1}", radius=size, **moves))
        return wrecks

    def _ways_by_clock(self, clock: Piecewise) -> Piecewise:
        """The ways of all vehicles along the plan by a clock, either way."""
        duration, plan = float(clock.time[-1]), self.plan
        time = np.linspace(0.0, duration, 2 + math.ceil(duration / _KNOTS))
        begin, end = clock.at(time[[0, -1]]).tolist()
        turn = slice(None, None, 1 if begin <= end else -1)
        first, last = (begin, end)[turn]
        inside = plan.time[(plan.time > first) & (plan.time < last)]
        fine = np.linspace(0.0, duration, 50 * len(time))
        time = refine_knots(time, np.interp(inside, clock.at(fine)[turn], fine[turn]), _NEAR)
        s = clock.states(time, 4)
        ends = tuple(x[:, turn] for x in plan.with_knots(s[0, turn]).piece_end_states(4))[turn]
        rates = s[1:, :-1], s[1:, 1:]
        return Piecewise.of_end_states(time, *map(_states_by_clock, ends, rates))

    def step_by_clock(self, name: str, clock: Piecewise) -> Step:
        """A step along the plan by a clock, either way: its least separation is that which the legs it meets prove."""
        begin, end = clock.at(clock.time[[0, -1]]).tolist()
        first, last = sorted((begin, end))
        make, least = partial(self._ways_by_clock, clock), _APART_FOR_EVER
        for leg in self.legs[self.leg_number_at(first) : self.leg_number_at(last) + 1]:
            proved = leg.certificate
            if self.lost.any():
                proved = certificate_of(leg.phase, leg.reference, leg.radius, self.lost)
            if proved is None and len(self.left) > 1:  # no slots are tracked there
                proved = self._prove_ways(make(), self.left)
            least = min(least, proved or least)
        # Its polynomials differ from the plan's ways by less than `PROOF_SLACK`.
        return self._step(name, make, least._replace(time=0.0), PROOF_SLACK, path=end)

    def _step(
        self, name: str, make: Callable[[], Piecewise], least: Certificate, off: float, **how: Any
    ) -> Step:
        """A step of ways that keep a separation, if they are so much off it [m]."""
        way = make()
        end = way.at(way.time[-1:])[0]
        return Step(name, make, float(way.time[-1]), end, least, self._drag_drift(way) + off, **how)

    def slow_down_step_and_problem(self, begins: float) -> tuple[Step, str]:
        """Slow down along the plan from a time on [s], in the least time that keeps the limits, or fly to its landing.

        Where the plan itself is beyond a limit, that counts as the limit.

        Returns
        -------
        step : of it
        problem : what breaks a limit, or leads two vehicles too near; "" if nothing does
        """
        v = self.plan.states(np.array([begins]), 2)[1, 0, self.left]
        speed = float(np.linalg.norm(v, axis=1).max())
        first = max(_STEEPEST * speed / BRAKING, math.sqrt(_BENT * speed / JERK))
        time, over = self._least_time_and_ratios(
            first, self.limits, lambda time: _path_clock(begins, time, _SLOWING)
        )
        if begins + 0.5 * time >= self.plan_end and self.mission_lands:
            # What goes on beyond the end goes on down.
            clock = _path_clock(begins, max(self.plan_end - begins, _LEAST), _ON)
            return self.step_by_clock("to its end", clock), ""
        problem, step = "", self.step_by_clock("slow down", _path_clock(begins, time, _SLOWING))
        if over.max(initial=0.0) > _KEPT:
            q = self.limits[int(over.argmax())].of
            problem = f"slowing down would break the limit of {q.name_in_words}"
        elif step.least.separation < max(self.need, 1e-6):
            who, least = agent_names(step.least.agents), step.least.separation
            problem = f"the plan itself leads {who} within {max(least, 0.0):.2f} m of each other"
        return step, problem

    def _least_time_and_ratios(
        self, first: float, limits: list[Limit], clock: Callable[[float], Piecewise]
    ) -> tuple[float, Floats]:
        """`shortest_time` of a step along the plan by a clock of a time; where the plan exceeds a limit, it counts."""
        share = np.linspace(0.0, 1.0, _LOOKS)

        def limit_ratios(time: float) -> Floats:
            at, *rates = clock(time).states(time * share, 4)
            states = self.plan.states(at, 4)
            allowed = np.maximum(self._limit_shares(limits, states), _USED)
            return self._limit_shares(limits, _states_by_clock(states, np.array(rates))) / allowed

        return shortest_time(first, limit_ratios)

    # -- what a step keeps --------------------------------------------------------------------------------

    def _limit_shares(self, limits: list[Limit], x: Floats) -> Floats:
        """Greatest share (L,) of each limit in states (orders, K, N, 3), of those left."""
        who, x = self.left, x.swapaxes(0, 1)[:, :, self.left]
        return np.array([(q.values(x, who) / q.most[who]).max() for q in limits])

    def _drag_drift(self, way: Piecewise) -> float:
        """By how much nearer than on their way two vehicles may be in flight [m].

        Drag in proportion to the speed holds vehicles off their ways that fly differently, as tracking answers to it.
        """
        mission, who = self.mission, self.left
        v = way.states(np.linspace(0.0, way.time[-1], _LOOKS), 2)[1][:, who]
        push = drag_and_lift(mission, np.array(mission.all_disturbances.wind) - v, who)
        if mission.tracking.drag_feedforward:
            push = push - drag_and_lift(mission, -v, who)
        push = push / (mission.fleet.mass[who, None] * mission.tracking_gains[0])
        apart = np.linalg.norm(push - push.mean(axis=1, keepdims=True), axis=2)
        return self.off + 2.0 * _OVERSHOOT * float(apart.max())

    def _straight_step(self, name: str, start: Floats, end: Floats) -> Step:
        """The step of straight ways (N, 3) [m], from rest to rest and in step, in the least time that keeps limits."""
        states = _rest_to_rest(start, end, 1.0).states(np.linspace(0.0, 1.0, _LOOKS), 4)
        allowed = np.maximum(self._limit_shares(self.home_limits, 0.0 * states), _USED)  # at rest

        def limit_ratios(time: float) -> Floats:
            moves = states * time ** -np.arange(4.0)[:, None, None, None]
            return self._limit_shares(self.home_limits, moves) / allowed

        lands = name == "down"
        longest = float(np.linalg.norm(end - start, axis=1).max())
        time, _ = shortest_time(_FASTEST * longest / (DESCENT if lands else _SPEED), limit_ratios)
        least = prove_straight_ways(start, end, time, self.radius, self.lost) or _APART_FOR_EVER
        return self._step(name, partial(_rest_to_rest, start, end, time), least, 0.0, lands=lands)

    def obstruction_in_words(self, step: Step, begin: float) -> str:
        """What keeps a step from being flown, from a time [s] on; "" if nothing does.

        A step along the plan is where the plan is, but for obstacles that move.
        """
        limits, left, radius = self.mission.limits, self.left, self.radius[self.left]
        along = step.path is not None
        astray = 0.0 if along else 0.5 * step.off  # how far each may be off its way in flight
        way = step.way
        on = _ON_STEP.get(step.name, f"on the way {step.name}")
        if not along and (apart := step.least.separation - step.off) < max(self.need, 1e-6):
            # On their pads vehicles may be nearer.
            both, pads = way.at(np.zeros(1))[0, list(step.least.agents), 2], limits.separation_altitude  # fmt: skip
            if pads is None or (both >= pads).any() or step.least.separation <= 0.0:
                who, limit = agent_names(step.least.agents), f"(limit {self.need:g} m)"
                return f"{who} come within {max(apart, 0.0):.2f} m {on} {limit}"
        things = [x for x in (*self.mission.solids, *self.wrecks) if x.solid.moves or not along]
        v = way.states(np.linspace(0.0, step.duration, _LOOKS), 2)[1]
        far, when = step.duration * float(np.linalg.norm(v, axis=2).max()), np.array([begin])
        moved = (
            shift_bound(x.solid, when, when + step.duration)[0] for x in things if x.solid.moves
        )
        far += max(moved, default=0.0)
        time = np.linspace(0.0, step.duration, 2 + math.ceil(far / _PACE / 2.0))
        r = way.at(time)[:, left]
        if limits.geofence is not None and not along:
            low, high = (np.array(x) for x in (limits.geofence.min, limits.geofence.max))
            out = np.maximum(low + astray * _ABOVE - r, r + astray - high).max(axis=2) + radius
            k, i = np.unravel_index(int(out.argmax()), out.shape)
            if out[k, i] > 1e-6:
                return f"agent {left[i] + 1} may leave the geofence by {out[k, i]:.2f} m {on}"
        if limits.separation_below is not None and len(left) > 1 and not along:
            height, pair = proximity.headroom(r, radius)
            k = int(height.argmin())
            if height[k] < limits.separation_below - 1e-6:
                who = agent_names(int(left[i]) for i in sorted(pair[k].tolist()))
                return f"{who} are {height[k]:.2f} m above each other {on}"
        watch = BoundaryWatch(self.mission)
        if watch.every:
            watch.add_way(way, ~self.lost)
        for name, x in watch.search().items():
            q = QUANTITIES[name]
            limit, place = q.limit_of(self.mission), getattr(self.mission, PLACES[q.who])[x.other].name  # fmt: skip
            if limit is not None and q.rank(x.value) > q.rank(limit) + 1e-6 - astray:
                words = boundary_in_words(name, f"agent {x.who + 1}", place, x.value, begin + x.time)  # fmt: skip
                return f"{words}, {on}"
        if step.lands:
            things = [x for x in things if not is_ground(x)]
        if things:
            room, near = proximity.obstacle_clearances(r, radius, things, begin + time)
            k, i = np.unravel_index(int(room.argmin()), room.shape)
            if room[k, i] < _PACE:  # less than half the way between two samples
                thing = things[int(near[k, i])].name
                return f"'{thing}' stands in the way of agent {left[i] + 1} {on}"
        return ""

    def _prove_ways(self, way: Piecewise, who: Ints, with_first: int | None = None) -> Certificate:
        """Certificate of the ways of some vehicles (n,), as `prove_ways`."""
        least = prove_ways(way.time, way.pieces[:, who], self.radius[who], with_first)
        return least._replace(agents=tuple(who[list(least.agents)].tolist()))

    # -- ways home from rest ------------------------------------------------------------------------------

    def way_home(self, stop: Step, begin: float) -> Home:
        """The way from where all rest after a step along the plan, at a time [s]; that of equal places is planned once.

        If nothing leads home from there, back along the plan to where a way does.
        """
        r, path = stop.end, stop.path
        assert path is not None
        key = np.round(r, _SAME).tobytes() + (np.array([begin]).tobytes() if self.moves else b"")
        if key not in self._known:
            home = self.straight_ways_home(r, begin)
            if home.reason and np.isfinite(self.landing_places(r)).all():
                home = next(self._ways_back(path, begin), home)
            self._known[key] = home._replace(number=len(self._known))
        return self._known[key]

    def _ways_back(self, path: float, begin: float) -> Iterator[Home]:
        """Ways home from farther and farther back along the plan, from a time along it where all rest at a time [s]."""
        for far in np.append(np.arange(_BACK, path, _BACK), path).tolist():

            def backward_clock(duration: float, far: float = far) -> Piecewise:
                return _path_clock(path, duration, -far / duration * _BLEND)

            time, _ = self._least_time_and_ratios(_FASTEST * far, self.home_limits, backward_clock)
            home = self.straight_ways_home(self.plan.at(np.array([path - far]))[0], begin + time)
            if home.way:
                step = self.step_by_clock("back", backward_clock(time))
                if not self.obstruction_in_words(step, begin):
                    yield Home((step, *home.steps), f"back along the plan, and {home.way}")

    def straight_ways_home(self, r: Floats, begin: float) -> Home:
        """Straight ways home from places (N, 3) [m] where all rest at a time [s]."""
        left, goal = self.left, r.copy()
        goal[left] = self.landing_places(r)[left]  # lost ones stay
        reason = self.no_landing
        if not np.isfinite(goal).all():
            reason = "there is no ground to land on: add [[obstacles]] with kind = 'ground'"
        if reason:
            return Home(reason=reason)
        reasons: dict[str, str] = {}
        off = 0.0
        # Tried again with as much more between levels, or in the grid, as vehicles were off their ways.
        own = "straight to their own", "by levels", "by levels"
        for way in ("to any place",) * (2 - self.stands) if self.to == "any" else own:
            steps: list[Step] = []
            problem, t = "", begin
            if off:
                goal[left] = self.landing_places(r, off)[left]
            for name, a, b in self._landing_step_ends(way, r, goal, off):
                if np.abs(b - a).max() > 1e-9:
                    steps.append(self._straight_step(name, a, b))
                    problem = problem or self.obstruction_in_words(steps[-1], t)
                    t += steps[-1].duration
            if not problem:
                return Home(tuple(steps), way)
            off = max(step.off for step in steps)
            reasons[way] = problem
        return Home(reason="; ".join(f"{way}: {problem}" for way, problem in reasons.items()))

    def _landing_step_ends(
        self, way: str, r: Floats, goal: Floats, off: float
    ) -> list[tuple[str, Floats, Floats]]:
        """Names of straight ways, from places to others (N, 3) [m] on the ground, if vehicles are off theirs [m].

        By levels, they go apart, across and down. Who is above another one stays above it.
        """
        left, stops = self.left, []
        p, q = r[left], goal[left]
        if way == "to any place":
            metric, goal = downwash_metric(_UP, self.below / self.apart), goal.copy()
            q = self._places_clear_of_wrecks(r, q, off)
            goal[left] = q[assign_slots(p, q, turn=np.eye(3), metric=metric).order]
        if way == "by levels":
            height = _altitude_levels(self.apart + off, p, q) * (self.below + off)
            height += max(q[:, 2].max() + FINAL, p[:, 2].mean() - 0.5 * height.max())
            one, two = r.copy(), goal.copy()
            one[left, 2] = two[left, 2] = height
            stops, r = [("apart", r, one), ("across", one, two)], two
        # No higher than the lowest of them.
        rise = max(0.0, min(FINAL, float((r[left, 2] - goal[left, 2]).min())))
        above = goal.copy()
        above[left] += rise * _UP
        return [*stops, ("over the places", r, above), ("down", above, goal)]

    def _places_clear_of_wrecks(self, r: Floats, own: Floats, off: float) -> Floats:
        """The own places (n, 3) of those left; where a lost vehicle lies on one, that of a lost one if it is free."""
        if not self.wrecked.size:
            return own
        every = self.landing_places(r, off)
        near = proximity.obstacle_clearances(every, self.radius, self.wrecks, _EVER)[0] < _PACE
        own, spare, taken = own.copy(), every[self.lost & ~near], np.flatnonzero(near[self.left])
        count = min(len(spare), len(taken))
        own[taken[:count]] = spare[:count]
        return own

    def landing_places(self, r: Floats, off: float = 0.0) -> Floats:
        """Landing places (N, 3) [m] of the vehicles' centres.

        Where they stood at the start; if they did not stand on the ground, a square grid below where they stop, for
        vehicles that are ``off`` their ways [m].
        """
        if self.stands:
            return self.start
        n, near, apart = len(r), math.inf, self.apart + off
        if len(self.left) > 1:
            near = float(proximity.nearest(r[self.left]).min())
        wide = near / math.sqrt(max(near**2 - apart**2, 0.1 * near**2)) if near < math.inf else 1.0
        side = math.ceil(math.sqrt(n))
        k = np.arange(n)
        grid = np.column_stack([k % side, k // side]) - 0.5 * (side - 1)
        xy = r[self.left, :2].mean(axis=0) + 1.05 * apart * max(wide, 1.2) * grid
        z = self.mission.height_below(*xy.T) + ABOVE + self.radius
        return np.column_stack([xy, z])

    # -- aborts -------------------------------------------------------------------------------------------

    def all_aborts(self) -> Iterator[Abort]:
        """The abort of each `step` of the flight, on which vehicles act after its start and before its end."""
        end = self.plan_end - self.options.reaction
        for k in range(self.options.reaction == 0.0, math.ceil(end / self.options.step - 1e-9)):
            yield self.abort_at(k * self.options.step)

    def abort_at(self, ordered: float) -> Abort:
        """What follows from an order at a time [s]."""
        return (
            self._abort_of_leavers(ordered) if self.options.agents else self._abort_of_all(ordered)
        )

    def _abort_of_all(self, ordered: float) -> Abort:
        """What follows for all at once."""
        begins = ordered + self.options.reaction
        phase = self.legs[self.leg_number_at(begins)].phase
        if not phase.tracks_slots:
            reason = f"only tracked slots can slow down, and '{phase.name}' tracks none"
            return Abort(ordered, begins, (), Home(reason=reason))
        step, problem = self.slow_down_step_and_problem(begins)
        if self.mission_lands and step.path is not None and step.path > self.plan_end - 1e-6:
            return Abort(ordered, begins, (step,), Home((), "lands as planned"))
        if problem := problem or self.obstruction_in_words(step, begins):
            return Abort(ordered, begins, (step,), Home(reason=problem))
        home = self.way_home(step, begins + step.duration)
        return Abort(ordered, begins, (step, *home.steps), home, 0.0, step.duration)

    @cached_property
    def _aborts_of_leavers(self) -> Aborts:
        """The aborts of those that leave, who land where the plan leads them, if it lands."""
        stay = np.ones(self.mission.n_agents, dtype=np.bool_)
        stay[np.array(self.options.agents) - 1] = False
        alone = Aborts(self.mission, self.legs, stay | self.lost)
        alone.wrecked, alone.moves = self.wrecked, self.moves
        if self.mission_lands:
            alone.start = self.plan.at(np.array([self.plan_end]))[0]
        return alone

    def _abort_of_leavers(self, ordered: float) -> Abort:
        """Some vehicles go home, as soon as they come near no other one; the others fly the plan on."""
        begins, end = ordered + self.options.reaction, self.plan_end
        who = self._aborts_of_leavers.left
        order = np.concatenate([who, np.setdiff1d(self.left, who)])
        problem = "there is no time left" if who.size else "those who would leave are lost"
        plan = self.step_by_clock("", _path_clock(begins, max(end - begins, SHORTEST), _ON)).least
        for waits in np.arange(0.0, end - begins, self.options.step).tolist() if who.size else ():
            alone = self._aborts_of_leavers._abort_of_all(ordered + waits)
            if alone.home.reason:
                problem = alone.home.reason
                continue
            make = partial(self._ways_of_all, begins, waits, alone.steps)
            way = make()
            proved = self._prove_ways(way, order, len(who))
            step = self._step("leave", make, min(proved, plan), 0.0)
            if (apart := proved.separation - step.off) < max(self.need, 1e-6):
                problem = f"{agent_names(proved.agents)} come within {max(apart, 0.0):.2f} m"
                continue
            words = f"{agent_names(who.tolist())} {'leaves' if len(who) == 1 else 'leave'}"
            words += f" after {waits:g} s" if waits else ""
            slow, *steps = alone.steps
            home = Home(tuple(steps), words, "", round(ordered / self.options.step))
            return Abort(ordered, begins, (step,), home, waits, slow.duration)
        return Abort(ordered, begins, (), Home(reason=problem))

    def _ways_of_all(self, begins: float, waits: float, steps: Sequence[Step]) -> Piecewise:
        """The ways from a time on [s] of those that wait so long and then fly steps, and of the others, by the plan."""
        lands, end = self.mission_lands, self.plan_end
        last, ways = np.array([max(begins, end - _TOUCHING * lands), end]), list[Piecewise]()
        if last[0] > begins:
            ways.append(self.plan.between(begins, last[0]).shift_time(-begins))
        if lands:
            states = self.plan.states(last, 4)
            states[1:, 1] = 0.0  # a landing ends with the speed at which it touches down
            ways.append(Piecewise.hermite(last, states).shift_time(-last[0]))
        on = concatenate_curves(ways)
        before = [on.between(0.0, waits)] if waits else []
        own = concatenate_curves([*before, *(step.way for step in steps)])
        knots, who = common_knots([own, on]), self._aborts_of_leavers.left
        own, way = (x.with_knots(knots, stays=True) for x in (own, on))
        way.pieces[:, who] = own.pieces[:, who]
        return way

    # -- who does not hear --------------------------------------------------------------------------------

    def nearness_if_unheard(self, abort: Abort) -> list[Worst]:
        """How near each vehicle comes to another one if it does not hear the order and flies on, until the others rest.

        Distances between surfaces [m], at samples.
        """
        from scipy.spatial import KDTree

        left, (least, most, each) = self.left, _SAMPLED
        step = min(max(least, each * self.mission.n_agents), most)
        time = np.arange(abort.begins, min(abort.rest_time, self.plan_end), step)
        if len(left) < 2 or not len(time):
            return []
        on, others = self.plan.at(time)[:, left], abort.positions_at(time)[:, left]
        nearest = [KDTree(b).query(a, 2) for a, b in zip(on, others, strict=True)]
        far, whom = np.array([x for x, _ in nearest]), np.array([x for _, x in nearest])
        itself = whom[..., 0] == np.arange(len(left))
        far, whom = (np.where(itself, x[..., 1], x[..., 0]) for x in (far, whom))
        far = far - self.radius[left] - self.radius[left[whom]]
        return [
            Worst(float(far[k, i]), float(time[k]), int(left[i]), int(left[whom[k, i]]))
            for i, k in enumerate(far.argmin(axis=0))
        ]


def shortest_time(
    time: float, excess: Callable[[float], Floats], kept: float = _KEPT
) -> tuple[float, Floats]:
    """The least time from a first one on [s], to within a tenth, that exceeds no limit, and the shares that it takes.

    A share up to ``kept`` exceeds none. If every time exceeds one, the best of those that were tried.
    """
    tries: list[tuple[float, Floats]] = []
    time = max(time, SHORTEST)
    for _ in range(_TRIES):
        tries.append((time, excess(time)))
        if tries[-1][1].max(initial=0.0) <= kept:
            return tries[-1]
        time *= _LONGER
    return min(tries, key=lambda x: x[1].max())


def capped_limits(mission: Mission, lost_by: float = -math.inf, **most: float) -> list[Limit]:
    """The limits of a mission, of which some are no greater than given here; for ``lost_by`` see `limits_of`."""
    own = mission.limits
    less = {name: min(x, getattr(own, name) or x) for name, x in most.items()}
    return limits_of(mission, own.model_copy(update=less), lost_by=lost_by)


def _altitude_levels(distance: float, p: Floats, q: Floats) -> Ints:
    """Level (N,) of each vehicle, from 0: others on ways across that come nearer than a distance [m] get another one.

    Of two that are one above the other at first, the higher one gets the higher level.
    """
    near, level = neighbours_on_ways(distance, p, q), np.full(len(p), -1)
    for i in np.argsort(p[:, 2], kind="stable").tolist():
        others = np.array([j for j in near[i] if level[j] >= 0], dtype=np.int64)
        under = others[np.linalg.norm((p[others] - p[i])[:, :2], axis=1) < distance]
        level[i] = first_free_level(level[others], int(level[under].max(initial=-1)) + 1)
    return level


def neighbours_on_ways(distance: float, p: Floats, q: Floats) -> list[list[int]]:
    """Of each vehicle, the others that come nearer than a distance [m], seen from above, on ways from p to q (N, 3)."""
    near: list[list[int]] = [[] for _ in p]
    for i, j in pairs_nearer_than(distance, p * _ABOVE, q * _ABOVE).tolist():
        near[i].append(j)
        near[j].append(i)
    return near


def first_free_level(taken: Ints, least: int = 0) -> int:
    """The first level from a least one on that is not taken."""
    return next(k for k in itertools.count(least) if k not in taken)


def phases_of(mission: Mission, steps: Sequence[Step], before: str = "") -> list[Phase]:
    """The phases that fly steps, words before their names: each vehicle follows its ways, or comes straight down."""
    phases: list[Phase] = []
    for step in steps:
        name, time = before + step.name, step.duration
        if step.lands:
            everyone = tuple(range(1, mission.n_agents + 1))
            phases.append(Land(kind="land", name=name, agents=everyone, duration=time))
            continue
        level = np.zeros_like(step.way.pieces[:, :, :1])  # whose yaw follows [yaw]
        pieces = np.concatenate([step.way.pieces, level], axis=2).swapaxes(0, 1)
        ways = (curve_to_rows(Piecewise(step.way.time, one)) for one in pieces)
        rows = tuple(tuple(map(tuple, way)) for way in ways)
        phases.append(Follow(kind="follow", name=name, trajectories=rows, duration=time))
    return phases


def abandonment_state(legs: Sequence[Leg], now: PhaseState) -> PhaseState:
    """The state from which all vehicles leave a plan, each with the motion that it is led on.

    The virtual body is their mean and no longer turns; no formation outlasts it.
    """
    leg = next((x for x in legs if x.end >= now.t), legs[-1])
    x = slot_derivatives(*leg.slots_and_motion, np.array([now.t]), 4)[0]
    mean = np.einsum("i,kiq->kq", leg.masses / leg.masses.sum(), x)
    r, v, a, jerk = mean
    assert now.pose is not None
    T = now.pose.T
    own = (x - mean[:, None]) @ T.T
    goal = Pose(r, np.zeros(3), T, np.zeros(3))
    pose = copy_with(goal, v=v, a=a, jerk=jerk)
    return copy_with(
        now, pose=pose, goal=goal, slots=own[0], rates=own[1:], formation=None, blend=None
    )
