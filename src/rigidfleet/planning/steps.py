"""Steps of ways home: straight ways from rest to rest, or along the plan, and what keeps one from being flown."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rigidfleet._common.quantities import PLACES, QUANTITIES
from rigidfleet._common.text import agent_names
from rigidfleet.foreign.curves import curve_to_rows
from rigidfleet.math import proximity
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.boundaries import BoundaryWatch, boundary_in_words
from rigidfleet.mission.kinds import Follow, Land
from rigidfleet.mission.obstacles import Obstacle, is_ground
from rigidfleet.planning.avoidance import kept_distances
from rigidfleet.planning.certificate import Certificate, prove_straight_ways, prove_ways
from rigidfleet.planning.clearance import shift_bound
from rigidfleet.planning.limits import Limit, limits_of
from rigidfleet.planning.vehicles import drag_and_lift
from rigidfleet.typing import Bools, Floats, Ints

#: Greatest acceleration [m/s^2], jerk [m/s^3] and speed [m/s] of a vehicle on its way home, unless `limits` asks for
#: less.
BRAKING, JERK, _SPEED = 2.0, 5.0, 5.0
#: Greatest vertical speed of a vehicle with rotors [m/s], which descends in its own inflow.
_SINKING = 2.5
#: Greatest speed on the last straight way down [m/s].
DESCENT = 1.0
#: Shortest step [s], ratio of a time tried to the one before, and number of times tried.
SHORTEST, _LONGER, _TRIES = 0.5, 1.1, 60
#: Share of a limit that steps may use, which are looked at in samples alone; share of that which counts as kept.
USED, KEPT = 0.98, 1.0 + 1e-6
#: Samples of a step at which limits are looked at, and greatest way between two, halved, at which clearance is [m].
LOOKS, CLEARANCE_STEP = 33, 0.25
#: How much farther than in the end vehicles are off their ways while drag changes.
_OVERSHOOT = 1.1
#: Greatest speed from rest to rest, over the mean.
PEAK_SPEED = 2.1875
#: Room for a vehicle whose centre is off its way: sideways alone.
_ASIDE = np.array([1.0, 1.0, 0.0])
APART_FOR_EVER = Certificate(math.inf, 0.0, (0, 0), "closed form")


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


def _rest_to_rest(start: Floats, end: Floats, time: float) -> Piecewise:
    """Straight ways between places (N, 3) [m], from rest to rest in a time [s]."""
    rest = np.zeros((3, 2, *start.shape))
    states = np.concatenate([np.stack([start, end])[None], rest])
    return Piecewise.hermite(np.array([0.0, time]), states)


class Steps:
    """The steps of those vehicles who are left, and what keeps them from being flown: ``wrecks`` of the lost, too."""

    def __init__(self, mission: Mission, lost: Bools, wrecks: Sequence[Obstacle] = ()) -> None:
        self.mission, self.lost, self.wrecks = mission, lost, wrecks
        self.left, self.radius = np.flatnonzero(~lost), mission.fleet.radius
        self.limits, self.need = limits_of(mission), kept_distances(mission)[0]
        sinking = _SINKING if has_rotors(mission) else math.inf
        self.home_limits = capped_limits(
            mission, acceleration=BRAKING, jerk=JERK, speed=_SPEED, vertical_speed=sinking
        )
        self.off = tracking_allowance(mission)
        self.moves = any(x.solid.moves for x in (*mission.solids, *wrecks))

    def step(
        self, name: str, make: Callable[[], Piecewise], least: Certificate, off: float, **how: Any
    ) -> Step:
        """A step of ways that keep a separation, if they are so much off it [m]."""
        way = make()
        end = way.at(way.time[-1:])[0]
        return Step(name, make, float(way.time[-1]), end, least, self.drag_drift(way) + off, **how)

    def limit_shares(self, limits: list[Limit], x: Floats) -> Floats:
        """Greatest share (L,) of each limit in states (orders, K, N, 3), of those left."""
        who, x = self.left, x.swapaxes(0, 1)[:, :, self.left]
        return np.array([(q.values(x, who) / q.most[who]).max() for q in limits])

    def drag_drift(self, way: Piecewise) -> float:
        """By how much nearer than on their way two vehicles may be in flight [m].

        Drag in proportion to the speed holds vehicles off their ways that fly differently, as tracking answers to it.
        """
        mission, who = self.mission, self.left
        v = way.states(np.linspace(0.0, way.time[-1], LOOKS), 2)[1][:, who]
        push = drag_and_lift(mission, np.array(mission.all_disturbances.wind) - v, who)
        if mission.tracking.drag_feedforward:
            push = push - drag_and_lift(mission, -v, who)
        push = push / (mission.fleet.mass[who, None] * mission.tracking_gains[0])
        apart = np.linalg.norm(push - push.mean(axis=1, keepdims=True), axis=2)
        return self.off + 2.0 * _OVERSHOOT * float(apart.max())

    def straight_step(self, name: str, start: Floats, end: Floats) -> Step:
        """The step of straight ways (N, 3) [m], from rest to rest and in step, in the least time that keeps limits."""
        states = _rest_to_rest(start, end, 1.0).states(np.linspace(0.0, 1.0, LOOKS), 4)
        allowed = np.maximum(self.limit_shares(self.home_limits, 0.0 * states), USED)  # at rest

        def limit_ratios(time: float) -> Floats:
            moves = states * time ** -np.arange(4.0)[:, None, None, None]
            return self.limit_shares(self.home_limits, moves) / allowed

        lands = name == "down"
        longest = float(np.linalg.norm(end - start, axis=1).max())
        time, _ = shortest_time(PEAK_SPEED * longest / (DESCENT if lands else _SPEED), limit_ratios)
        least = prove_straight_ways(start, end, time, self.radius, self.lost) or APART_FOR_EVER
        return self.step(name, partial(_rest_to_rest, start, end, time), least, 0.0, lands=lands)

    def obstruction_in_words(self, step: Step, begin: float | None) -> str:
        """What keeps a step from being flown, from a time [s] on; "" if nothing does.

        A step along the plan is where the plan is, but for obstacles that move. Without a time, these do not count.
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
        if begin is None:
            begin, things = 0.0, [x for x in things if not x.solid.moves]
        v = way.states(np.linspace(0.0, step.duration, LOOKS), 2)[1]
        far, when = step.duration * float(np.linalg.norm(v, axis=2).max()), np.array([begin])
        moved = (
            shift_bound(x.solid, when, when + step.duration)[0] for x in things if x.solid.moves
        )
        far += max(moved, default=0.0)
        time = np.linspace(0.0, step.duration, 2 + math.ceil(far / CLEARANCE_STEP / 2.0))
        r = way.at(time)[:, left]
        if limits.geofence is not None and not along:
            low, high = (np.array(x) for x in (limits.geofence.min, limits.geofence.max))
            out = np.maximum(low + astray * _ASIDE - r, r + astray - high).max(axis=2) + radius
            k, i = np.unravel_index(int(out.argmax()), out.shape)
            if out[k, i] > 1e-6:
                return f"agent {left[i] + 1} may leave the geofence by {out[k, i]:.2f} m {on}"
        if limits.separation_below is not None and len(left) > 1 and not along:
            height, pair = proximity.headroom(r, radius)
            k = int(height.argmin())
            if height[k] < limits.separation_below - 1e-6:
                who = agent_names(int(left[i]) for i in sorted(pair[k].tolist()))
                return f"{who} are {height[k]:.2f} m above each other {on}"
        floors = {
            name: QUANTITIES[name].rank(limit) + 1e-6 - astray
            for name in ("people", "fence", "soft_fence")
            if (limit := QUANTITIES[name].limit_of(self.mission)) is not None
        }
        watch = BoundaryWatch(self.mission, floors)
        if watch.every:
            watch.add_way(way, ~self.lost)
        for name, x in watch.search().items():
            place = getattr(self.mission, PLACES[QUANTITIES[name].who])[x.other].name
            words = boundary_in_words(name, f"agent {x.who + 1}", place, x.value, begin + x.time)
            return f"{words}, {on}"
        if step.lands:
            things = [x for x in things if not is_ground(x)]
        if things:
            room, near = proximity.obstacle_clearances(r, radius, things, begin + time)
            k, i = np.unravel_index(int(room.argmin()), room.shape)
            if room[k, i] < CLEARANCE_STEP:  # less than half the way between two samples
                thing = things[int(near[k, i])].name
                return f"'{thing}' stands in the way of agent {left[i] + 1} {on}"
        return ""

    def prove_ways(self, way: Piecewise, who: Ints, with_first: int | None = None) -> Certificate:
        """Certificate of the ways of some vehicles (n,), as `prove_ways`."""
        least = prove_ways(way.time, way.pieces[:, who], self.radius[who], with_first)
        return least._replace(agents=tuple(who[list(least.agents)].tolist()))


def shortest_time(
    time: float, excess: Callable[[float], Floats], kept: float = KEPT
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


def has_rotors(mission: Mission) -> bool:
    """Whether a vehicle is more than a point."""
    return not all(model.point for model in mission.vehicle_models or ())


def tracking_allowance(mission: Mission) -> float:
    """By how much nearer two vehicles may be than on their ways, both off theirs as far as the verdict allows [m].

    None for points that only steady air pushes.
    """
    d, limits = mission.all_disturbances, mission.limits
    if has_rotors(mission) and limits.tracking_error is not None:
        return 2.0 * limits.tracking_error
    steady = d.noise is None and d.gusts is None and not np.any(d.mass_error)
    return 0.0 if steady and mission.vehicle_models is None else limits.separation_allowance


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
