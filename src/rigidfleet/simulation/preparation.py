"""What all flights of a mission have in common, prepared once: times, disturbances, the first plan."""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property

from rigidfleet.kernel.problem import Disturbance, External
from rigidfleet.mission import Mission, Phase
from rigidfleet.planning.disturbances import disturbance
from rigidfleet.planning.plan import PhasePlan, plan_phase
from rigidfleet.planning.reference import PhaseState, copy_with
from rigidfleet.planning.timing import complete_times, timed_leg

#: Number of missions whose preparation is kept, and their greatest number of agents.
_KEPT, _SMALL = 8, 200


class Preparation:
    """The preparation of a mission; it depends on nothing else."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._plan: tuple[Phase, External, PhasePlan] | None = None

    @cached_property
    def mission(self) -> Mission:
        """The mission with its times known (`complete_times`)."""
        return complete_times(self._mission)

    @cached_property
    def disturbance(self) -> Disturbance:
        """Disturbances of the flight of points."""
        return disturbance(self.mission)

    def first_plan(
        self, phase: Phase, now: PhaseState, disturbance: Disturbance | None, external: External
    ) -> PhasePlan:
        """The plan of a flight's first phase, from the mission's start; saves a third of the shortest flights.

        A flight may change its plan, and the state before it, but none of their arrays.
        """
        last = self._plan
        if last is None or last[0] is not phase or last[1] != external:
            leg = timed_leg(self.mission, phase, now, 0)
            plan = plan_phase(self.mission, leg, disturbance=disturbance, external=external)
            _ = plan.certificate, plan.tolerances  # once for all flights
            self._plan = last = phase, external, plan
        return copy_with(last[2], before=copy_with(last[2].before))


_preparations: OrderedDict[int, tuple[Mission, Preparation]] = OrderedDict()


def preparation_of(mission: Mission) -> Preparation:
    """The preparation of a mission, which is kept with some others of small missions."""
    preparation = _preparations.get(id(mission))
    if preparation is not None and preparation[0] is mission:
        return preparation[1]
    made = Preparation(mission)
    if mission.n_agents <= _SMALL:
        _preparations[id(mission)] = mission, made
        while len(_preparations) > _KEPT:
            _preparations.popitem(last=False)
    return made
