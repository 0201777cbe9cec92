"""Compare the assignment of a mission with the shortest and the safest one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rigidfleet.formation import assignment
from rigidfleet.mission import Mission
from rigidfleet.planning.legs import leg_of
from rigidfleet.planning.preview import sample_leg
from rigidfleet.preflight.findings import Assignment, Preflight, Remark

#: A shorter assignment is reported if it saves this fraction of the path length and this length besides [m].
_WORTH, _SHORT = 0.05, 0.1
#: Maximum number of agents whose assignments are compared; this takes about a second.
_COMPARED = 200


def assignment_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Notes if another assignment to the slots of the first formation is shorter or safer."""
    first = next((p.establishing for p in mission.phases if p.establishing is not None), None)
    slots = mission.formation_slots(first.formation) if first is not None else None
    if first is None or slots is None or not 2 <= mission.n_agents <= _COMPARED:
        return
    index, masses = mission.phases.index(first), mission.fleet.mass
    if index >= len(preflight.flown_phases):
        return
    for name in ("as it is", "shortest", "safe"):
        other, planned = mission, preflight.flown_phases[index]
        if name not in ("as it is", mission.assignment):
            other = mission.with_assignment(name)
            leg = leg_of(other, other.phases[index], planned.leg.before)
            planned = sample_leg(leg, len(planned.time))
        if planned.path_ends is None:  # on bent ways
            return
        x = planned.position - (masses @ planned.position)[:, None] / masses.sum()
        length = float(np.linalg.norm(np.diff(x, axis=0), axis=2).sum())
        clearance = assignment.closest_approach(*planned.path_ends, mission.agents.radius)[0]
        order = tuple((other.assigned_slots[first.formation] + 1).tolist())
        # They are in their slots: there is nothing to compare.
        if name == "as it is" and length < _SHORT:
            return
        preflight.assignments[name] = Assignment(order, length, clearance)
    now, short, safe = preflight.assignments.values()
    before, after = now.path_length_m, short.path_length_m
    if after < (1 - _WORTH) * before - _SHORT:
        text = f'assignment = "shortest" reduces the total path length from {before:.1f} m to {after:.1f} m'
        yield Remark("note", "assignment", text)
    before, after = now.min_clearance_m, safe.min_clearance_m
    if after > before + 0.05 and before < 2 * mission.fleet.radius.max():
        what = "increases the minimum clearance on the paths"
        text = f'assignment = "safe" {what} from {before:.2f} m to {after:.2f} m'
        yield Remark("note", "assignment", text)
