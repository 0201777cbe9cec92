"""Sampled flights by machine code, called without the compiler; see `rigidfleet.kernel.sampled_flight`."""

from __future__ import annotations

from rigidfleet.kernel.avoidance import AvoidanceArrays
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.engine.packing import UNRECORDED, Packed, pack, pack_uncached
from rigidfleet.kernel.fleet import ENDLESS, SampledFlight, SampledSegment, SampledState
from rigidfleet.kernel.problem import Problem, Workspace
from rigidfleet.kernel.records import Segment


def fly_ticks(
    problem: Problem,
    workspace: Workspace,
    flight: SampledFlight,
    state: SampledState,
    segment: SampledSegment,
    avoidance: AvoidanceArrays | None = None,
) -> int:
    """Fly to the end of the segment, see `rigidfleet.kernel.sampled_flight.fly_ticks`.

    The state and the samples of the segment are written; ``state.count[fleet.SAMPLES]`` is the next sample, which the
    caller sets to 0 for a new segment. The problem must be in the inertial formulation, and without disturbances: the
    flight brings its own. With ``avoidance``, forces pass through its barriers and its guard.
    """
    work = state.work
    _check_sizes(flight, state, workspace)
    if problem.body_formulation or problem.disturbance.active:
        raise ValueError(
            "a sampled flight takes a problem in the inertial formulation without disturbances; its Flight has its own"
        )
    law = pack_uncached(Segment(0.0, False, 0, work.law_time, work.law_state, work.law_rate))
    call = segment._replace(
        recorder=native.recorder_address(), segment=law.address, record=pack(UNRECORDED).address
    )
    if avoidance is not None:
        own = _pack_avoidance(avoidance, problem, workspace)
        guard = native.library("avoidance").addresses["avoid"]
        call = call._replace(guard=guard, avoidance=own.address)
    arguments = *map(pack, (problem, workspace, flight, state)), pack_uncached(call)
    return native.library("sampled").fly_ticks(*(x.address for x in arguments))


def correct_forces(
    problem: Problem,
    workspace: Workspace,
    flight: SampledFlight,
    state: SampledState,
    avoidance: AvoidanceArrays,
) -> int:
    """Filter and guard ``state.force`` once, at `work.law_time`; see `rigidfleet.kernel.guard.correct_forces`."""
    kept = _pack_avoidance(avoidance, problem, workspace)
    return native.library("avoidance").avoid(
        pack(flight).address, pack(state).address, kept.address, 0
    )


def _pack_avoidance(avoidance: AvoidanceArrays, problem: Problem, workspace: Workspace) -> Packed:
    """Avoidance that knows the law whose forces it changes."""
    avoidance.law[:] = pack(problem).address, pack(workspace).address
    return pack(avoidance)


def _check_sizes(flight: SampledFlight, state: SampledState, workspace: Workspace) -> None:
    """Refuse arrays too short for what the machine code reads.

    Raises
    ------
    ValueError
    """
    n, m, t, sensing = len(flight.vehicles.m), len(workspace.c), flight.tables, flight.sensing
    each = len(range(t.first, t.last)) if t.last < ENDLESS else 0
    seen = -(-t.last // sensing.every) - -(-t.first // sensing.every)
    needed = {"yaw": each, "jerk": each, "snap": each}
    needed |= {"noise_r": seen, "noise_v": seen, "dropped": seen}
    for name, rows in needed.items():
        table = getattr(t, name)
        if len(table) and (len(table) < rows or t.last == ENDLESS or table.shape[1] != n):
            raise ValueError(
                f"the table {name!r} of shape {table.shape} does not cover ticks {t.first} to {t.last} of {n} vehicles:"
                f" it needs {rows} rows"
            )
    links = len(flight.network.links)
    sizes = len(state.S), len(state.integral), state.work.law_state.shape[1], len(state.mail.stamp)
    if len(state.history) <= sensing.delay.max() or sizes != (n, m, 6 * n + m + 4, links):
        raise ValueError(
            "the state is of another flight or problem: begin a flight by `fleet.initial_state`, and a phase by"
            " `fleet.state_under_problem`"
        )
