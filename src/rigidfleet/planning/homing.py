"""Straight ways home from rest, in steps: to any landing place, to the own one, or by levels one above the other."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rigidfleet.formation.assignment import assign_slots, downwash_metric
from rigidfleet.math import proximity
from rigidfleet.planning.avoidance import why_no_landing
from rigidfleet.planning.courses import ABOVE
from rigidfleet.planning.levels import altitude_levels
from rigidfleet.planning.steps import CLEARANCE_STEP, Step, Steps
from rigidfleet.typing import Floats

#: Height of the last straight way down [m].
_FINAL = 3.0
#: Time at which all that falls lies [s].
_EVER = 1e6
#: Vertical, of `downwash_metric`.
_UP = np.array([0.0, 0.0, 1.0])


class Home(NamedTuple):
    """Steps from rest, what their way is called, why there is none, and its number, which aborts may share."""

    steps: tuple[Step, ...] = ()
    way: str = ""
    reason: str = ""
    number: int | None = None


class WaysHome:
    """Straight ways home of those left, to places as [abort] asks, or ``to`` others."""

    def __init__(self, steps: Steps, to: str | None = None) -> None:
        self.steps, mission = steps, steps.mission
        self.to = to or mission.aborting.to
        self.no_landing, limits = why_no_landing(mission), mission.limits
        widest = 2.0 * float(steps.radius.max())
        self.apart = widest + steps.need + max(limits.separation_allowance, steps.off)
        self.below = max(self.apart, widest + (limits.separation_below or 0.0))
        start = mission.fleet.position
        below = mission.height_below(*start.T) + ABOVE + steps.radius
        self.stands = bool(mission.is_standing(start).all() and np.isfinite(below).all())
        self.start = np.column_stack([start[:, :2], below])

    def straight_ways_home(self, r: Floats, begin: float | None) -> Home:
        """Straight ways home from places (N, 3) [m] where all rest at a time [s]; None: at one without what moves."""
        left, goal = self.steps.left, r.copy()
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
                    steps.append(self.steps.straight_step(name, a, b))
                    problem = problem or self.steps.obstruction_in_words(steps[-1], t)
                    t = None if t is None else t + steps[-1].duration
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
        left, stops = self.steps.left, []
        p, q = r[left], goal[left]
        if way == "to any place":
            metric, goal = downwash_metric(_UP, self.below / self.apart), goal.copy()
            q = self._places_clear_of_wrecks(r, q, off)
            goal[left] = q[assign_slots(p, q, turn=np.eye(3), metric=metric).order]
        if way == "by levels":
            height = altitude_levels(self.apart + off, p, q) * (self.below + off)
            height += max(q[:, 2].max() + _FINAL, p[:, 2].mean() - 0.5 * height.max())
            one, two = r.copy(), goal.copy()
            one[left, 2] = two[left, 2] = height
            stops, r = [("apart", r, one), ("across", one, two)], two
        # No higher than the lowest of them.
        rise = max(0.0, min(_FINAL, float((r[left, 2] - goal[left, 2]).min())))
        above = goal.copy()
        above[left] += rise * _UP
        return [*stops, ("over the places", r, above), ("down", above, goal)]

    def _places_clear_of_wrecks(self, r: Floats, own: Floats, off: float) -> Floats:
        """The own places (n, 3) of those left; where a lost vehicle lies on one, that of a lost one if it is free."""
        steps, every = self.steps, self.landing_places(r, off)
        if not steps.wrecks:
            return own
        room, _ = proximity.obstacle_clearances(every, steps.radius, steps.wrecks, _EVER)
        near = room < CLEARANCE_STEP
        own, spare, taken = own.copy(), every[steps.lost & ~near], np.flatnonzero(near[steps.left])
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
        if len(self.steps.left) > 1:
            near = float(proximity.nearest(r[self.steps.left]).min())
        wide = near / math.sqrt(max(near**2 - apart**2, 0.1 * near**2)) if near < math.inf else 1.0
        side = math.ceil(math.sqrt(n))
        k = np.arange(n)
        grid = np.column_stack([k % side, k // side]) - 0.5 * (side - 1)
        xy = r[self.steps.left, :2].mean(axis=0) + 1.05 * apart * max(wide, 1.2) * grid
        z = self.steps.mission.height_below(*xy.T) + ABOVE + self.steps.radius
        return np.column_stack([xy, z])
