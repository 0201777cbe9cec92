"""What the others do when a vehicle or link is lost, or an abort is ordered: they brake and hold or land, or go home.

All phases follow from the reference at the moment of the loss, so that nothing jumps: position, velocity and
acceleration of each slot continue, and in a smooth mission jerk. A change of shape under way is completed. Vehicles
that fly ways of their own, or whom their brake would lead into something, slow down along the plan.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.kinds import Brake, Hold, Land, Reshape, Turn
from rigidfleet.planning.abort import Aborts, abandonment_state
from rigidfleet.planning.clearance import CLEARANCE_ACCURACY, clearance_to, speed_bounds
from rigidfleet.planning.courses import climb_distances, height_above_landing
from rigidfleet.planning.legs import Leg, depart, leg_from, leg_of, phase_spans
from rigidfleet.planning.limits import use_of_limits
from rigidfleet.planning.plan_path import PlanSteps
from rigidfleet.planning.preview import FEWEST_SAMPLES, sample_leg
from rigidfleet.planning.reference import PhaseState
from rigidfleet.planning.steps import (
    BRAKING,
    DESCENT,
    JERK,
    SHORTEST,
    Steps,
    capped_limits,
    phases_of,
    shortest_time,
)
from rigidfleet.planning.timing import legs_from
from rigidfleet.typing import Floats

#: Greatest acceleration of the descent [m/s^2].
_DESCENDING = 0.5
#: Peaks of speed and acceleration of a septic blend over unit way and time.
_PEAK_SPEED, _PEAK_ACCELERATION = 2.1875, 7.5132
#: Share of a limit that counts as kept: from a state beyond it, some of its derivatives lead a bit farther.
_KEPT = 1.01
#: Tilt that counts as level [rad].
_LEVEL = 1e-3


class Answer(NamedTuple):
    """What follows a loss or an order: legs, and why they lead to no place that is proved; "" if they do.

    Of a way home that is proved, `promise` is the least separation [m].
    """

    legs: list[Leg]
    problem: str = ""
    promise: float | None = None


def answer_to_loss(mission: Mission, now: PhaseState, plan: Callable[[], Sequence[Leg]]) -> Answer:
    """What follows the loss of a vehicle or link, or the order to abort, from the state at that moment.

    Parameters
    ----------
    now : the state, with the vehicles lost until then, its reference ``pose`` and the ``blend`` under way
    plan : makes the legs of the mission from its start to its end, as far as they are known
    """
    if not mission.aborts:
        return Answer(loss_legs(mission, now, plan))
    legs = plan()
    abort = Aborts(mission, legs, now.lost).abort_at(now.t - mission.aborting.reaction)
    phases, least = phases_of(mission, abort.steps, "abort: "), abort.certificate.separation
    promise = least if abort.home.way and math.isfinite(least) else None
    return Answer(
        legs_from(mission, abandonment_state(legs, now), phases), abort.home.reason, promise
    )


def loss_legs(mission: Mission, now: PhaseState, plan: Callable[[], Sequence[Leg]]) -> list[Leg]:
    """The legs of the phases by which the others brake, and hold or land (`answer_to_loss`)."""
    d = mission.all_disturbances
    rest = 0.0 if now.blend is None else now.blend.t0 + now.blend.T_b - now.t
    legs: list[Leg] = []

    def add_leg(make: Callable[[float], Phase], *, freely: bool = False) -> bool:
        """Add the leg of a phase; with ``freely``, only if it leads into nothing. Return whether it was added."""
        nonlocal now
        leg = _quickest_leg(mission, now, make, SHORTEST)
        if freely and _hits_obstacle(mission, leg):
            return False
        legs.append(leg)
        now = leg.planned_end_state
        return True

    start = now
    add_leg(lambda t: Brake(kind="brake", name="brake (loss)", duration=max(t, rest), travel=t))
    # Slots on ways of their own are where they should be only with the body's way.
    if (start.blend is not None and start.formation is None) or _hits_obstacle(mission, legs[0]):
        whole = plan()
        along = PlanSteps(Steps(mission, start.lost), whole)
        slow, _ = along.slow_down_step_and_problem(start.t)
        brake = phases_of(mission, [slow._replace(name="brake (loss)")])
        legs = legs_from(mission, abandonment_state(whole, start), brake)
        now = legs[-1].planned_end_state
    if d.on_loss == "hold":
        until = phase_spans(mission)[-1][1] if d.hold_until is None else d.hold_until
        if until > now.t:
            legs.append(leg_of(mission, Hold(kind="hold", name="hold (loss)", until=until), now))
        return legs
    name = d.landing_formation
    shaped = now.formation is not None
    if name is not None and name != now.formation:
        spread = partial(Reshape, kind="reshape", name="spread (loss)", formation=name)
        shaped = add_leg(lambda t: spread(blend=t, duration=t), freely=True)
    assert now.goal is not None
    axes = now.goal.T.T
    if shaped and math.acos(min(1.0, float(axes[2, 2]))) > _LEVEL:
        yaw = math.degrees(math.atan2(axes[1, 0] - axes[0, 1], axes[0, 0] + axes[1, 1]))
        level = partial(Turn, kind="turn", name="level (loss)", roll_deg=0.0, pitch_deg=0.0)
        shaped = add_leg(lambda t: level(yaw_deg=yaw, duration=t), freely=True)
    everyone = tuple(range(1, mission.n_agents + 1))
    land = partial(Land, kind="land", name="land (loss)")
    each = partial(land, agents=everyone)
    ways = [(each, -float(climb_distances(mission, each(duration=1.0), now).min()))]
    if shaped:  # together, unless something is below some
        ways.insert(0, (land, height_above_landing(mission, land(duration=1.0), now)))
    for make, depth in ways:
        if depth <= 0.0:
            return legs
        least = max(_PEAK_SPEED * depth / DESCENT, SHORTEST)
        least = max(math.sqrt(_PEAK_ACCELERATION * depth / _DESCENDING), least)
        down = _quickest_leg(mission, now, lambda t, make=make: make(duration=t), least)
        if not _hits_obstacle(mission, down):
            break
    return [*legs, down]


def _hits_obstacle(mission: Mission, leg: Leg) -> bool:
    """Whether a leg leads a slot into an obstacle or the ground."""
    planned = sample_leg(leg, FEWEST_SAMPLES)
    near = (clearance_to(planned, x, leg.radius, speed_bounds(planned)) for x in mission.obstacles)
    return any(x.clearance < -CLEARANCE_ACCURACY for x in near)


def _quickest_leg(
    mission: Mission, now: PhaseState, make: Callable[[float], Phase], least: float
) -> Leg:
    """The leg of a phase of the shortest time from ``least`` [s] on, to within a tenth, that keeps the limits.

    Where the state at the start is beyond a limit, that counts as the limit. If no time keeps them, the best one tried.
    """
    limits = capped_limits(mission, lost_by=now.t, acceleration=BRAKING, jerk=JERK)
    departure = depart(mission, make(least), now)

    def limit_shares(time: float, end: float = math.inf) -> Floats:
        leg = leg_from(mission, make(time), departure)
        use = use_of_limits(limits, leg.reference, leg.motion, now.t, min(leg.end, end))
        return np.array([x.share for x in use])

    allowed = np.maximum(limit_shares(least, now.t + 1e-9 * max(1.0, now.t)), 1.0)
    time, _ = shortest_time(least, lambda time: limit_shares(time) / allowed, _KEPT)
    return leg_from(mission, make(time), departure)
