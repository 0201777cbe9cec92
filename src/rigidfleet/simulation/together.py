"""Fly eight missions side by side, in the lanes of vectors: missions that differ in numbers, as in a sweep.

Each phase in which the eight differ in nothing but numbers is integrated in common steps
(`rigidfleet.kernel.engine.batch.Vector`); each flight flies any other phase alone. Everything else is that of a single
flight: plan, monitor, record. A flight agrees with `simulate` to the integrator's tolerances, not to the last bit,
because the steps are those that the eight need.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

from rigidfleet.kernel import records
from rigidfleet.mission import Mission
from rigidfleet.result import Result
from rigidfleet.simulation.active_phase import ActivePhase
from rigidfleet.simulation.flight import Flight, simulate
from rigidfleet.simulation.point_propagator import PointPropagator

if TYPE_CHECKING:
    from rigidfleet.kernel.engine import batch  # imports the compiler

T = TypeVar("T")

#: Number of missions of a vector.
WIDTH = 8
#: Greatest number of vehicles in a vector: straight-line code of more takes longer to compile than it gains, and of a
#: thousand minutes and gigabytes.
MOST_VEHICLES = 60
#: Greatest number of common steps between two looks at Ctrl-C.
_STEPS = 2000


def simulate_together(missions: Sequence[Mission]) -> list[Result]:
    """Fly at most eight missions side by side, each as by `simulate`; return their records.

    A flight's last bits depend on the others. If a step of the common ones fails, each mission is flown alone; so it is
    with more than `MOST_VEHICLES`.

    Raises
    ------
    MissionError
        A mission has errors.
    """
    many = any(mission.n_agents > MOST_VEHICLES for mission in missions)
    if many or len({mission.output_step for mission in missions}) > 1:
        return [simulate(mission) for mission in missions]
    flights = [Flight(mission) for mission in missions]
    vector: batch.Vector | None = None
    while True:
        going = [flight.begin() for flight in flights]
        if not any(going):
            return [flight.finish() for flight in flights]
        active = [flight.under_way() for flight, goes in zip(flights, going, strict=True) if goes]
        points = [x.propagator for x in active if isinstance(x.propagator, PointPropagator)]
        if all(going) and len(points) == len(active) and _can_share_steps(active):
            if vector is None:
                from rigidfleet.kernel.engine import batch

                vector = batch.Vector(_fill_lanes([x.plan.problem.disturbance for x in active]))
            if not _fly_in_common_steps(points, vector):
                return [simulate(mission) for mission in missions]
            for flight in flights:
                flight.end_phase_if_over()
            continue
        for flight, goes in zip(flights, going, strict=True):
            while goes and flight.advance():
                pass


def _can_share_steps(active: Sequence[ActivePhase]) -> bool:
    """Whether phases differ in nothing but numbers, so that they can share steps."""
    first = _sharing_key(active[0])
    if not all(_allows_common_steps(phase) and _sharing_key(phase) == first for phase in active):
        return False
    from rigidfleet.kernel.engine import batch

    return batch.can_unroll_together([phase.plan.problem for phase in active])


def _allows_common_steps(phase: ActivePhase) -> bool:
    """Whether a phase has a given duration, without losses, calls of users' functions, fences and people."""
    plan, at = phase.plan, phase.integration
    return (
        not at.extremes.boundaries.every
        and plan.phase.settle is None
        and at.solver is None
        and at.external is None
        and not plan.loses
    )


def _sharing_key(phase: ActivePhase) -> tuple[object, ...]:
    """What phases that share steps have in common: when they are flown and recorded, and sizes of arrays."""
    plan, at = phase.plan, phase.integration
    points = tuple(at["time"] for at in plan.through)
    times = plan.start, plan.t_end, plan.arrival, points
    return *times, plan.integrator.rtol, len(at.state.y), at.extremes.directed


def _fly_in_common_steps(points: Sequence[PointPropagator], vector: batch.Vector) -> bool:
    """Fly phases of points to their end in common steps and record them; return whether they came there."""
    from rigidfleet.kernel.engine.tracer import UnfitError

    first = points[0].integration
    t_end = first.plan.t_end
    times = first.sample_times(t_end)
    stretches = [one.prepare_stretch(one.integration.plan.problem, times) for one in points]
    try:
        vector.begin(
            _fill_lanes([stretch.problem for stretch in stretches]),
            _fill_lanes([one.integration.state for one in points]),
            t_end,
            times,
            _fill_lanes([stretch.samples for stretch in stretches]),
        )
    except UnfitError:
        return False
    status = records.PAUSED
    while status == records.PAUSED:
        status = vector(_STEPS)
        if status == records.PAUSED:
            for one in points:
                one.search_extremes(last=False)
            if points[0].has_stalled():
                return False
    for one, stretch in zip(points, stretches, strict=True):
        one.record_samples(stretch)
    return status == records.FINISHED


def _fill_lanes(x: list[T]) -> list[T]:
    """Eight things: the last one is repeated."""
    return x + x[-1:] * (WIDTH - len(x))
