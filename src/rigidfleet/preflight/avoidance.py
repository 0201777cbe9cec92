"""Check whether all vehicles could brake in time at the start, as the guarantee of [avoidance] needs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rigidfleet.mission import Mission
from rigidfleet.planning.avoidance import avoidance_in_flight, why_no_landing
from rigidfleet.preflight.findings import Remark


def is_left_to_avoidance(mission: Mission, topic: str, limit: float = 0.0) -> bool:
    """Whether [avoidance] has to keep vehicles off obstacles, or a separation [m], where the plan does not."""
    a = mission.avoidance
    if a is None or topic not in ("collision", "obstacle"):
        return False
    return topic == "obstacle" or (a.guard and (a.separation is None or a.separation >= limit))


def avoidance_remarks(mission: Mission) -> Iterator[Remark]:
    """Remark on landings, and on the two, vehicles or an obstacle at rest, that braking at the start leaves nearest."""
    if any(phase.lands for phase in mission.phases) and (words := why_no_landing(mission)):
        yield Remark("fails", "avoidance", words)
    if mission.avoidance is None or not mission.avoidance.guard:
        return
    from rigidfleet.kernel.moving import way_to_rest
    from rigidfleet.kernel.segments import segment_distance, segment_obstacle_bounds
    from rigidfleet.planning.vehicles import sampled_flight

    a = avoidance_in_flight(mission, sampled_flight(mission))
    assert a is not None
    r, v = mission.fleet.position, mission.fleet.velocity
    speed = np.linalg.norm(v, axis=1)
    way = [way_to_rest(u, b, lag, a.period) for u, b, lag in zip(speed, a.b, a.lag, strict=True)]
    way += a.lead[:, 0] * speed
    stop = r + (way / np.maximum(speed, 1e-12))[:, None] * v
    worst, who = -1e-9, ""
    for i in range(len(r)):
        far = np.linalg.norm(r - r[i], axis=1) - way - way[i] - a.room - a.room[i]
        for j in np.flatnonzero(far[:i] < worst):
            room = segment_distance(r[i], stop[i], r[j], stop[j]) - a.room[i] - a.room[j]
            if room < worst:
                worst, who = room, f"agents {j + 1} and {i + 1}"
        for o in np.flatnonzero(a.sight.moves == 0):
            nearest = segment_obstacle_bounds(r[i], stop[i], o, a.solids, np.nan, a.normal)
            if nearest[0] - a.reach[i] < worst:
                worst = nearest[0] - a.reach[i]
                who = f"agent {i + 1} and '{mission.obstacles[o].name}'"
    if who:
        text = (
            f"{who} cannot brake in time at the start: they would come {-worst:.2g} m nearer than [avoidance] keeps, so"
            " that its guarantee is lost from there on; start slower or farther apart, or keep less"
        )
        yield Remark("fails", "avoidance", text)
