"""What a mission will meet, found before it flies: rigidity, gains, and what is on the way.

The way is the planned reference, sampled: slots that blend, moved by the LQR flights of the virtual body.
Nothing is integrated, so this takes a fraction of a second and no compiler. Where nothing but distances leads,
the agents are taken to go straight to their slots, which is a guess: such phases are not `exact`, and what is found
on them is a note.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rigidfleet.mission import Mission, as_mission
from rigidfleet.planning.preview import FEWEST_SAMPLES, preview, samples_per_phase
from rigidfleet.preflight.assignment import assignment_remarks
from rigidfleet.preflight.findings import Preflight, Remark
from rigidfleet.preflight.formations import SEARCHED, check_formations, formation_remarks
from rigidfleet.preflight.gains import check_gains, gain_remarks
from rigidfleet.preflight.trajectory import (
    disturbance_remarks,
    downwash_remarks,
    limit_remarks,
    obstacle_remarks,
    separation_remarks,
    thrust_remarks,
)


def check(
    mission: Mission | str | Path,
    *,
    search: bool | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Preflight:
    """Find what a mission will meet, before it flies; `rigidfleet check` prints it.

    Parameters
    ----------
    mission : a shipped name, a path or a `Mission`
    search : for other shapes with the same distances, `STARTS` random starts a formation; default: for up to
        `SEARCHED` agents
    progress : called with what is looked at next, in words
    """
    mission = as_mission(mission)
    search = mission.n_agents <= SEARCHED if search is None else search
    formations = check_formations(mission, search=search, progress=progress)
    progress("the way")
    way, known = preview(mission)
    found = Preflight(formations, check_gains(mission, formations), way)
    if not known:
        found.judged_to = float(way[-1].time[-1]) if way else 0.0
    progress("what is on the way")
    found.remarks = [
        *formation_remarks(mission, formations),
        *gain_remarks(mission, found),
        *separation_remarks(mission, found),
        *downwash_remarks(mission, found),
        *assignment_remarks(mission, found),
        *thrust_remarks(mission, found),
        *disturbance_remarks(mission, found),
        *obstacle_remarks(mission, found),
        *limit_remarks(mission, found),
    ]
    if not known:
        why = "what follows is led by distances that fix no places before it flies"
        if len(way) < len(mission.phases) and samples_per_phase(mission) < FEWEST_SAMPLES:
            why = "so many agents in so many phases take too long to look at"
        text = f"the way is judged to {found.judged_to:g} s: {why}"
        found.remarks.append(Remark("note", "way", text))
    return found
