"""Verdict on a flight: whether its shapes held, its waypoints were met, and its agents kept their distance.

`assess` reads a `Result` and nothing else. A constraint error of zero is not success, because the distances
of the edges do not fix a shape. A shape is therefore judged by *all* pairs of agents against the intended
slots, and by properties that no distance shows: mirror image (spatial shapes), side up (planar shapes) and
order (lines).

A verdict prints with rich (`console.print(verdict)`) or as JSON (`verdict.json()`). In both, agents
count from 1.
"""

from pathlib import Path

from rigidfleet.assessment.checks import all_checks
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.notes import verdict_notes
from rigidfleet.assessment.safety import Safety, safety
from rigidfleet.assessment.verdict import Verdict
from rigidfleet.result import Result, as_result

__all__ = ["Safety", "Verdict", "assess", "safety"]


def assess(result: Result | str | Path) -> Verdict:
    """Judge a flight against its mission.

    The flight fails if

    - it is incomplete, or a phase did not settle;
    - a formation is off by more than it allows (`mission.schema`), mirrored, flipped or out of order, at the end of an
      establish or reshape phase or at the end of the flight;
    - a waypoint is missed by more than 0.1 m, 0.1 m/s, 1 deg or 1 deg/s;
    - agents collide with each other or with an obstacle;
    - agents that track slots come nearer to each other than planned, by more than `limits.separation_allowance`; or
    - a limit of the mission is exceeded.

    The worst values of the flight are reported in any case.

    Limits are checked in continuous time, from the extremes that the flight recorded, and at the samples, from
    values recomputed from positions and forces. The worse of the two counts. A record that contradicts its own
    samples fails.

    The geofence applies to the agents' centres. Separation and clearance apply to their surfaces (distance minus
    radii). So does `separation_below`: the vertical distance between two agents whose spheres overlap as seen from
    above. A vehicle that the mission loses is no longer judged from then on, but it must not hit the others.

    Parameters
    ----------
    result : the flight's record, or the path of a saved one

    Raises
    ------
    ResultError
        The result, or the mission inside it, cannot be read.
    TypeError
        ``result`` is neither a flight nor a path.
    """
    result = as_result(result)
    measured = Measurements(result)
    phases = [*measured.phase_verdicts()]
    names = ", ".join(f"'{p.name}'" for p in result.phases if p.controller is False)
    uncalled = names and f"the controller was not called in {names}, as no slots are tracked there"
    covers, n = "", result.n_agents
    if result.interpolation is not None:
        vehicles = "the only vehicle" if n == 1 else f"{n:,} vehicles"
        covers = f" It covers {vehicles} from {result.time[0]:.6g} to {result.time[-1]:.6g} s."
    verdict = Verdict(
        measured.mission.name, measured.mission.title, [], phases, [], uncalled, covers,
        read=[*result.statistics.get("read", [])],
    )  # fmt: skip
    verdict.checks.extend(all_checks(measured, phases))
    verdict.notes.extend(verdict_notes(measured, phases))
    return verdict
