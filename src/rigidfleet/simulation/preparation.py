"""What all flights of a mission have in common, prepared once: times, disturbances, first plans, the monitor."""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property

from rigidfleet.kernel.problem import Disturbance, External
from rigidfleet.mission import Mission, Phase
from rigidfleet.planning.disturbances import disturbance
from rigidfleet.planning.plan import PhasePlan, plan_phase
from rigidfleet.planning.reference import PhaseState, changed
from rigidfleet.planning.timing import timed, timed_leg
from rigidfleet.simulation.extremes import Extremes

#: Number of missions whose preparation is kept, and their greatest number of agents.
_KEPT, _SMALL = 8, 200


class Preparation:
    """The preparation of a mission; it depends on nothing else."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._plans: dict[tuple[int, External], tuple[Phase, PhasePlan]] = {}
        self._idle: list[Extremes] = []

    @cached_property
    def mission(self) -> Mission:
        """The mission with its times known (`timed`)."""
        return timed(self._mission)

    @cached_property
    def disturbance(self) -> Disturbance:
        """Disturbances of the flight of points."""
        return disturbance(self.mission)

    def extremes(self) -> Extremes:
        """A monitor that no other flight uses."""
        try:
            found = self._idle.pop()
        except IndexError:
            return Extremes(self.mission)
        found.restart()
        return found

    def give_back(self, extremes: Extremes) -> None:
        """Let other flights use the monitor of one that is finished."""
        if extremes.reusable and len(self._idle) < _KEPT:
            self._idle.append(extremes)

    def first_plan(
        self, phase: Phase, now: PhaseState, given: Disturbance | None, external: External
    ) -> PhasePlan:
        """The plan of a flight's first phase, which starts from the mission's start, ``now``.

        A flight may change its plan, and the state before it, but none of their arrays.

        Raises
        ------
        MissionError, StoppedError
            As `timed_leg` and `plan_phase` do.
        """
        key = id(phase), external
        found = self._plans.get(key)
        if found is None or found[0] is not phase:
            leg = timed_leg(self.mission, phase, now, 0)
            plan = plan_phase(self.mission, leg, disturbance=given, external=external)
            _ = plan.certificate, plan.tolerances  # once for all flights
            self._plans = {key: (found := (phase, plan))}
        return changed(found[1], before=changed(found[1].before))


_prepared: OrderedDict[int, tuple[Mission, Preparation]] = OrderedDict()


def prepared(mission: Mission) -> Preparation:
    """The preparation of a mission, which is kept with some others of small missions."""
    found = _prepared.get(id(mission))
    if found is not None and found[0] is mission:
        return found[1]
    made = Preparation(mission)
    if mission.n_agents <= _SMALL:
        _prepared[id(mission)] = mission, made
        while len(_prepared) > _KEPT:
            _prepared.popitem(last=False)
    return made
