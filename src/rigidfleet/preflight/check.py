"""Check a mission before the flight: rigidity, gains, and the planned paths of the agents.

The planned paths are samples of the reference: slots that blend, moved by the LQR flights of the virtual body. Nothing
is integrated, so the check takes a fraction of a second and needs no compiler. In a phase in which only distances
guide the agents, straight paths to the slots are assumed. Such a phase is not `exact`, and problems on its paths are
notes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rigidfleet.mission import Mission, as_mission
from rigidfleet.mission.files import notes_on_files
from rigidfleet.planning.preview import FEWEST_SAMPLES, preview_phases, samples_per_phase
from rigidfleet.planning.timing import timed_mission_and_legs
from rigidfleet.planning.vehicles import lags_by_vehicle, tracking_lag_times
from rigidfleet.preflight import trajectory
from rigidfleet.preflight.assignment import assignment_remarks
from rigidfleet.preflight.avoidance import avoidance_remarks
from rigidfleet.preflight.findings import Preflight, Remark
from rigidfleet.preflight.formations import SEARCHED, check_formations, formation_remarks
from rigidfleet.preflight.gains import check_pid_gains, gain_remarks
from rigidfleet.preflight.losses import loss_remarks, parts_before_and_after_loss
from rigidfleet.preflight.margins import check_margins, loop_remarks
from rigidfleet.preflight.network import check_network, network_remarks
from rigidfleet.preflight.obstacles import area_remarks, obstacle_remarks
from rigidfleet.preflight.offsets import steady_offset_remarks
from rigidfleet.preflight.vehicles import check_vehicles, vehicle_remarks


def check(
    mission: Mission | str | Path,
    *,
    search: bool | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Preflight:
    """Check a mission before the flight. `rigidfleet check` prints the result.

    Parameters
    ----------
    mission : a shipped name, a path or a `Mission`
    search : whether to search for other shapes with the same distances, from `formations.STARTS` random starts per
        formation; default: for up to `SEARCHED` agents
    progress : called with a description of the next step

    Raises
    ------
    TypeError
        ``mission`` is none of these.
    MissionError
        The mission cannot be read or has errors.
    """
    mission, legs = timed_mission_and_legs(as_mission(mission))
    search = mission.n_agents <= SEARCHED if search is None else search
    formations = check_formations(mission, search=search, progress=progress)
    progress("planned paths")
    planned, known = preview_phases(mission, legs)
    flown, rest = parts_before_and_after_loss(mission, planned)
    gains = check_pid_gains(mission, formations)
    preflight = Preflight(mission, formations, gains, planned, flown)
    trajectory.find_planned_peaks(mission, preflight)
    if not known:
        preflight.judged_to = float(planned[-1].time[-1]) if planned else 0.0
    if lags := lags_by_vehicle(mission):
        progress("margins")
        preflight.margins = check_margins(mission, planned, lags)
        preflight.network = check_network(mission, planned, lags)
        preflight.vehicles = check_vehicles(mission, flown)
        preflight.reserve = float(tracking_lag_times(mission).max()) if mission.smooth else 0.0
    progress("collisions, obstacles and limits")
    preflight.remarks = [
        *(Remark("note", "files", text) for text in notes_on_files(mission.file_digests_text)),
        *formation_remarks(mission, formations),
        *gain_remarks(mission, preflight),
        *loop_remarks(preflight),
        *network_remarks(preflight),
        *trajectory.separation_remarks(mission, preflight),
        *trajectory.downwash_remarks(mission, preflight),
        *assignment_remarks(mission, preflight),
        *trajectory.step_thrust_remarks(mission, preflight),
        *vehicle_remarks(mission, preflight),
        *avoidance_remarks(mission),
        *trajectory.disturbance_remarks(mission, preflight),
        *steady_offset_remarks(mission, preflight),
        *obstacle_remarks(mission, preflight),
        *area_remarks(mission, preflight),
        *trajectory.limit_remarks(mission, preflight),
        *trajectory.waypoint_miss_remarks(mission, preflight),
        *loss_remarks(mission, preflight, rest),
    ]
    if planned and not rest and (words := mission.landing_swaps_in_words(planned[-1].position[-1])):
        preflight.remarks.append(Remark("note", "landing", words))
    if not known:
        why = "later positions depend on distances alone and are known only in flight"
        if len(planned) < len(mission.phases) and samples_per_phase(mission) < FEWEST_SAMPLES:
            why = "more agents and phases would take too long"
        text = f"paths are checked only up to {preflight.judged_to:g} s: {why}"
        preflight.remarks.append(Remark("note", "paths", text))
    if any(x.leg.phase.leads_body for x in planned):
        text = "paths in phases with control = 'body' are estimates, less close the faster the formation turns"
        preflight.remarks.append(Remark("note", "paths", text))
    return preflight
