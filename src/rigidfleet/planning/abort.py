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

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet.math.piecewise import Piecewise, common_knots, concatenate_curves
from rigidfleet.mission import Mission
from rigidfleet.mission.boundaries import Worst
from rigidfleet.planning.certificate import Certificate
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.homing import Home, WaysHome
from rigidfleet.planning.legs import Leg
from rigidfleet.planning.plan_path import ON, REST_TO_REST, PlanSteps, path_clock, plan_path
from rigidfleet.planning.reference import PhaseState, Pose, copy_with
from rigidfleet.planning.steps import APART_FOR_EVER, PEAK_SPEED, SHORTEST, Step, Steps
from rigidfleet.planning.wrecks import wrecks_of
from rigidfleet.typing import Bools, Floats

#: Least and greatest time between samples of vehicles that fly on [s], and the latter over the number of vehicles.
_SAMPLED = 0.05, 0.25, 5e-4
#: Time before its end within which a plan that lands comes to rest on the ground [s].
_TOUCHING = 1.0
#: Time along the plan between the places to which steps back lead [s].
_BACK = 1.0
#: Decimals of stopped places [m] that count as the same, whose ways home are planned once.
_SAME = 6


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
        best, t = APART_FOR_EVER, self.begins
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


class _GroupAborts:
    """Aborts of those vehicles for whom there are steps, all at once, from any time of a plan."""

    def __init__(self, steps: Steps, legs: Sequence[Leg], plan: Piecewise) -> None:
        self.steps = steps
        self.path, self.homes = PlanSteps(steps, legs, plan), WaysHome(steps)
        self._known: dict[tuple[bytes, float], Home] = {}
        self._known_past_still_things: dict[float, Home] = {}
        self._aborts: dict[float, Abort] = {}

    def abort_at(self, ordered: float) -> Abort:
        """What follows from an order at a time [s]; planned once."""
        if ordered not in self._aborts:
            self._aborts[ordered] = self._planned_abort(ordered)
        return self._aborts[ordered]

    def _planned_abort(self, ordered: float) -> Abort:
        path, steps = self.path, self.steps
        begins = ordered + steps.mission.aborting.reaction
        phase = path.legs[path.leg_number_at(begins)].phase
        if not phase.tracks_slots:
            reason = f"only tracked slots can slow down, and '{phase.name}' tracks none"
            return Abort(ordered, begins, (), Home(reason=reason))
        step, problem = path.slow_down_step_and_problem(begins)
        if path.lands and step.path is not None and step.path > path.end - 1e-6:
            return Abort(ordered, begins, (step,), Home((), "lands as planned"))
        if problem := problem or steps.obstruction_in_words(step, begins):
            return Abort(ordered, begins, (step,), Home(reason=problem))
        home = self._way_home(step, begins + step.duration)
        return Abort(ordered, begins, (step, *home.steps), home, 0.0, step.duration)

    def _way_home(self, stop: Step, begin: float) -> Home:
        """The way from where all rest after a step along the plan, at a time [s]; that of equal places is planned once.

        If nothing leads home from there, back along the plan to where a way does.
        """
        r, path, when = stop.end, stop.path, begin if self.steps.moves else 0.0
        assert path is not None
        key = np.round(r, _SAME).tobytes(), when
        if key not in self._known:
            home = self.homes.straight_ways_home(r, begin)
            if home.reason and np.isfinite(self.homes.landing_places(r)).all():
                home = next(self._ways_back(path, begin), home)
            self._known[key] = home._replace(number=len(self._known))
        return self._known[key]

    def _ways_back(self, path: float, begin: float) -> Iterator[Home]:
        """Ways home from farther and farther back along the plan, from a time along it where all rest at a time [s].

        The places are those at whole multiples of `_BACK`, which aborts share.
        """
        for place in np.arange(0.0, path, _BACK)[::-1].tolist():
            r = self.path.plan.at(np.array([place]))[0]
            if place not in self._known_past_still_things:
                self._known_past_still_things[place] = self.homes.straight_ways_home(r, None)
            if not (home := self._known_past_still_things[place]).way:
                continue

            def backward_clock(duration: float, far: float = path - place) -> Piecewise:
                return path_clock(path, duration, -far / duration * REST_TO_REST)

            first = PEAK_SPEED * (path - place)
            time, _ = self.path.least_time_and_ratios(first, self.steps.home_limits, backward_clock)
            if self.steps.moves:
                home = self.homes.straight_ways_home(r, begin + time)
            if home.way:
                step = self.path.step_by_clock("back", backward_clock(time))
                if not self.steps.obstruction_in_words(step, begin):
                    yield Home((step, *home.steps), f"back along the plan, and {home.way}")


class Aborts:
    """Ways home of the vehicles left, from any time of a plan: of each second (`all_aborts`), or one (`abort_at`)."""

    def __init__(self, mission: Mission, legs: Sequence[Leg], lost: Bools | None = None) -> None:
        lost = np.zeros(mission.n_agents, dtype=np.bool_) if lost is None else lost
        self.mission, self.options, self.plan = mission, mission.aborting, plan_path(legs)
        wrecks = wrecks_of(mission, self.plan, lost)
        self._all = _GroupAborts(Steps(mission, lost, wrecks), legs, self.plan)
        self._end, self._lands = self._all.path.end, self._all.path.lands
        #: Those who leave, if not all do; they land where the plan leads them, if it lands.
        self._leavers = self._all
        if self.options.agents:
            stay = np.ones(mission.n_agents, dtype=np.bool_)
            stay[np.array(self.options.agents) - 1] = False
            self._leavers = _GroupAborts(Steps(mission, stay | lost, wrecks), legs, self.plan)
            if self._lands:
                self._leavers.homes.start = self.plan.at(np.array([self._end]))[0]

    def all_aborts(self) -> Iterator[Abort]:
        """The abort of each `step` of the flight, on which vehicles act after its start and before its end."""
        end = self._end - self.options.reaction
        for k in range(self.options.reaction == 0.0, math.ceil(end / self.options.step - 1e-9)):
            yield self.abort_at(k * self.options.step)

    def abort_at(self, ordered: float) -> Abort:
        """What follows from an order at a time [s]."""
        if self.options.agents:
            return self._abort_of_leavers(ordered)
        return self._all.abort_at(ordered)

    def _abort_of_leavers(self, ordered: float) -> Abort:
        """Some vehicles go home, as soon as they come near no other one; the others fly the plan on."""
        begins, end, everyone = ordered + self.options.reaction, self._end, self._all.steps
        who = self._leavers.steps.left
        order = np.concatenate([who, np.setdiff1d(everyone.left, who)])
        problem = "there is no time left" if who.size else "those who would leave are lost"
        clock = path_clock(begins, max(end - begins, SHORTEST), ON)
        plan = self._all.path.step_by_clock("", clock).least
        for waits in np.arange(0.0, end - begins, self.options.step).tolist() if who.size else ():
            alone = self._leavers.abort_at(ordered + waits)
            if alone.home.reason:
                problem = alone.home.reason
                continue
            make = partial(self._ways_of_all, begins, waits, alone.steps)
            way = make()
            proved = everyone.prove_ways(way, order, len(who))
            step = everyone.step("leave", make, min(proved, plan), 0.0)
            if (apart := proved.separation - step.off) < max(everyone.need, 1e-6):
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
        lands, end = self._lands, self._end
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
        knots, who = common_knots([own, on]), self._leavers.steps.left
        own, way = (x.with_knots(knots, stays=True) for x in (own, on))
        way.pieces[:, who] = own.pieces[:, who]
        return way

    def nearness_if_unheard(self, abort: Abort) -> list[Worst]:
        """How near each vehicle comes to another one if it does not hear the order and flies on, until the others rest.

        Distances between surfaces [m], at samples.
        """
        from scipy.spatial import KDTree

        left, radius = self._all.steps.left, self.mission.fleet.radius
        least, most, each = _SAMPLED
        step = min(max(least, each * self.mission.n_agents), most)
        time = np.arange(abort.begins, min(abort.rest_time, self._end), step)
        if len(left) < 2 or not len(time):
            return []
        on, others = self.plan.at(time)[:, left], abort.positions_at(time)[:, left]
        nearest = [KDTree(b).query(a, 2) for a, b in zip(on, others, strict=True)]
        far, whom = np.array([x for x, _ in nearest]), np.array([x for _, x in nearest])
        itself = whom[..., 0] == np.arange(len(left))
        far, whom = (np.where(itself, x[..., 1], x[..., 0]) for x in (far, whom))
        far = far - radius[left] - radius[left[whom]]
        return [
            Worst(float(far[k, i]), float(time[k]), int(left[i]), int(left[whom[k, i]]))
            for i, k in enumerate(far.argmin(axis=0))
        ]


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
