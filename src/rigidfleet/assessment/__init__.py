"""Verdict on a flight: whether its shapes held, its waypoints were met, and nobody came too close.

`assess` looks at a `Result` and nothing else. A constraint error of zero is not success, as distances
do not fix a shape: it is judged by *all* pairs of agents against the intended slots, and by what no
distance can tell, mirror image (spatial shapes), side up (planar ones) and order (lines).

A verdict prints with rich (`console.print(verdict)`) or as JSON (`verdict.json()`). In both, agents
count from 1.
"""

from pathlib import Path

from rigidfleet.assessment.checks import findings, notes
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.outcome import (
    FLIPPED,
    SHAPE_TOLERANCE,
    WAYPOINT_TOLERANCE,
    CheckResult,
    Extreme,
    PhaseVerdict,
    Waypoint,
)
from rigidfleet.assessment.safety import Safety, safety
from rigidfleet.assessment.verdict import Verdict
from rigidfleet.result import Result, as_result

__all__ = [
    "FLIPPED",
    "SHAPE_TOLERANCE",
    "WAYPOINT_TOLERANCE",
    "CheckResult",
    "Extreme",
    "PhaseVerdict",
    "Safety",
    "Verdict",
    "Waypoint",
    "assess",
    "safety",
]


def assess(result: Result | str | Path) -> Verdict:
    """Judge a flight against its mission: a `Result`, or the path of one that was saved.

    It fails if it is incomplete; if a phase did not settle; if a formation is not reached at the end of
    a phase that shapes (establish, reshape), or not held at the end of the flight, by `SHAPE_TOLERANCE`,
    or lies mirrored, flipped or out of order there; if a waypoint is missed by more than
    `WAYPOINT_TOLERANCE`; if agents collide with each other or an obstacle; or if one of the mission's
    limits is passed. The flight's worst values are reported in any case.

    Limits hold in continuous time, as the record's extremes tell, and at the samples, which are computed
    anew from positions and forces; the worse counts, and a record that contradicts its samples fails. The
    geofence holds for the agents' centres, separation and clearance for their surfaces (distance minus
    radii), and so `separation_below`, the vertical room between two agents whose spheres overlap as seen from
    above. A vehicle that the mission loses counts in none of this from then on, except that it must not hit
    those that are left.

    Raises
    ------
    ResultError
        The result, or the mission inside it, cannot be read.
    """
    result = as_result(result)
    measured = Measurements(result)
    phases = [measured.phase(i, record) for i, record in enumerate(result.phases)]
    verdict = Verdict(measured.mission.name, measured.mission.title, [], phases, [])
    verdict.findings.extend(findings(measured, verdict))
    verdict.notes.extend(notes(measured, phases))
    return verdict
