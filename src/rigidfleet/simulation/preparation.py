"""What all flights of a mission have in common, prepared once: times and disturbances."""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property

from rigidfleet.kernel.problem import Disturbance
from rigidfleet.mission import Mission
from rigidfleet.planning.disturbances import disturbance
from rigidfleet.planning.timing import complete_times

#: Number of missions whose preparation is kept, and their greatest number of agents.
_KEPT, _SMALL = 8, 200


class Preparation:
    """The preparation of a mission; it depends on nothing else."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission

    @cached_property
    def mission(self) -> Mission:
        """The mission with its times known (`complete_times`)."""
        return complete_times(self._mission)

    @cached_property
    def disturbance(self) -> Disturbance:
        """Disturbances of the flight of points."""
        return disturbance(self.mission)


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
