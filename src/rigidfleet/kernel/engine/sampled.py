"""Sampled flights by machine code, called without the compiler; see `rigidfleet.kernel.sampled_flight`."""

from __future__ import annotations

import numpy as np

from rigidfleet.kernel.engine import native
from rigidfleet.kernel.engine.packing import UNRECORDED, pack, packed
from rigidfleet.kernel.fleet import Evaluation, Flight, SampledSegment, SampledState
from rigidfleet.kernel.problem import Problem, Workspace
from rigidfleet.kernel.records import Segment
from rigidfleet.typing import Floats


def fly_ticks(
    problem: Problem,
    workspace: Workspace,
    flight: Flight,
    state: SampledState,
    segment: SampledSegment,
) -> int:
    """Fly to the end of the segment, see `rigidfleet.kernel.sampled_flight.fly_ticks`.

    The state and the samples of the segment are written; ``state.count[fleet.SAMPLES]`` is the next sample, which the
    caller sets to 0 for a new segment. The problem must be in the inertial formulation, and without disturbances: the
    flight brings its own.
    """
    code, work = native.sampled(), state.work
    if problem.body_formulation or problem.disturbance.active:
        raise ValueError(
            "a sampled flight takes a problem in the inertial formulation without disturbances; its Flight has its own"
        )
    law = pack(Segment(0.0, False, 0, work.law_time, work.law_state, work.law_rate))
    recorded = pack(UNRECORDED)
    call = pack(
        segment._replace(recorder=code.recorder, segment=law.address, record=recorded.address)
    )
    arguments = packed(problem), packed(workspace), packed(flight), packed(state), call
    return code.fly_ticks(*(a.address for a in arguments))


def derivatives(
    flight: Flight,
    S: Floats,
    command: Floats,
    air: Floats | None = None,
    push: Floats | None = None,
) -> Floats:
    """Derivatives (N, 17) of states ``S`` (N, 17), see `rigidfleet.kernel.quadrotor.derivative`.

    For commands (N, 4) [rad/s], velocities of the air (N, 3) [m/s] and further forces (N, 3) [N], both zero by default.
    """
    none = np.zeros((len(S), 3))
    out = np.empty_like(S)
    call = pack(
        Evaluation(
            S, command, none if air is None else air, none if push is None else push, np.eye(3), out
        )
    )
    native.sampled().evaluate(packed(flight).address, call.address)
    return out
