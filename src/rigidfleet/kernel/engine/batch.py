"""Eight flights per SIMD vector: many flights of one problem, over all cores, or flights of eight missions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from rigidfleet._common.arrays import arrays_equal
from rigidfleet._common.renamed import getattr_of_earlier_names
from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.compiler.pointers import address_of
from rigidfleet.kernel.compiler.simd import WIDTH, LaneArray, empty_lanes, pack_lanes, unpack_lanes
from rigidfleet.kernel.engine import lane_steps, native
from rigidfleet.kernel.engine.codegen import (
    addresses,
    gust_and_noise_tables,
    integrate,
    packed,
    unrolled,
    unrolled_together,
)
from rigidfleet.kernel.linalg import copy_vector
from rigidfleet.kernel.problem import (
    EXACT,
    ITERATED,
    OPEN,
    SHAPE,
    TRACKING,
    Disturbance,
    Problem,
    padded,
    workspace,
)
from rigidfleet.kernel.records import (
    ATOL,
    EVALUATIONS,
    FINISHED,
    FIRST_ROW,
    LAST_ERROR,
    LEAST_ERROR,
    NEXT_STEP,
    NO_TRAIL,
    TIME,
    TRAILED,
    IntegratorState,
    integrator,
)
from rigidfleet.typing import Bools, Floats, Ints

#: Number of ranges of flights per thread; each range is taken by the next free thread.
_RANGES = 4
#: First step that a flight tries alone, and in a vector, whose pair takes longer steps [s].
_FIRST_STEP, _FIRST_STEP_IN_VECTORS = 1e-3, 1e-2
#: Greatest number of equations for straight-line code, whose length grows with their cube.
_MOST_EQUATIONS = 36


@jit
def fly(p, state, t0, t_end, step, starts, before, ends, status, evaluations, max_steps, fresh):
    """Integrate vectors of eight flights from ``starts`` (G, n) at t0 to ``t_end`` [s], into ``ends``.

    ``before`` (G, m) [m] are the distances from which the references of each vector are blended. The
    return values of `integrate` are written to ``status`` (G,), and the numbers of evaluations of the
    right-hand side to ``evaluations`` (G,). p, an `UnrolledProblem`, and state are overwritten. ``fresh``
    is always True; a literal here would have another type for the compiler.
    """
    p, state = address_of(p), address_of(state)
    unsampled = state.clock[:0]
    for g in range(starts.shape[0]):
        copy_vector(starts[g], state.y)
        copy_vector(before[g], p.before)
        state.clock[TIME], state.clock[NEXT_STEP], state.clock[LAST_ERROR] = t0, step, LEAST_ERROR
        state.count[:TRAILED] = 0
        status[g] = integrate(p, p, state, t_end, fresh, unsampled, ends[:0], max_steps)
        evaluations[g] = state.count[EVALUATIONS]
        copy_vector(state.y, ends[g])


@jit
def fly_on(p, state, t_end, fresh, times, unsampled, max_steps):
    """Integrate eight flights to ``t_end`` [s], see `dopri5.integrate`; p is an `UnrolledProblem`."""
    p, state = address_of(p), address_of(state)
    return integrate(p, p, state, t_end, fresh, times, unsampled, max_steps)


@dataclass(frozen=True)
class FinalStates:
    """Final states of flights.

    Attributes
    ----------
    y : (B, n) states
    finished : (B,) whether the end was reached; if not, the state is the last valid one
    evaluations : (B,) evaluations of the right-hand side; flights of a vector share them
    """

    y: Floats
    finished: Bools
    evaluations: Ints


def can_unroll(problem: Problem) -> bool:
    """Return whether straight-line code can be generated for a problem, and is worthwhile.

    Its branches must not depend on the state, and its code must not be too long to be compiled.
    """
    return (
        problem.control.kind == OPEN
        and problem.law.solver in (ITERATED, EXACT)
        and problem.reference.kind != SHAPE
        and not (problem.has_frame or problem.body_formulation or problem.disturbance.active)
        and problem.external.address == 0
        and _constraint_system_size(problem) <= _MOST_EQUATIONS
    )


def _constraint_system_size(problem: Problem) -> int:
    edges, agents = len(problem.graph.edges), len(problem.vehicles.m)
    return min(edges, 3 * agents) if problem.law.solver == ITERATED else edges


def can_unroll_together(problems: Sequence[Problem]) -> bool:
    """Return whether problems differ in nothing but numbers and tables over time, and suit straight-line code.

    They must have the same graph, laws, blend and knots, no branch that depends on the state, and no longest step.
    """
    first = problems[0]
    if not (
        first.control.kind in (OPEN, TRACKING)
        and first.law.solver in (ITERATED, EXACT)
        and first.graph.solver == 0
        and first.motion.coefficients.shape[2] == 6
        and _constraint_system_size(first) <= _MOST_EQUATIONS
    ):
        return False
    return all(
        not (x.has_frame or x.body_formulation or any(x.disturbance.lost.tolist()))
        and x.external.max_step == np.inf  # also of any force
        and len(x.reference.knots) == 0
        and _sharing_key(x) == _sharing_key(first)
        and arrays_equal(x.graph.edges, first.graph.edges)
        and arrays_equal(x.motion.knots, first.motion.knots)
        for x in problems
    )


#: What problems in common steps have in common, beside graph and knots: options, the blend, and sizes of tables.
_sharing_key = attrgetter(
    "vehicles.saturate", "law.solver", "law.iterations", "control.kind", "reference.kind", "reference.t0",
    "reference.T_b", "disturbance.active", "disturbance.gust.shape", "disturbance.noise_r.shape",
    "disturbance.noise_v.shape", "disturbance.gust_step", "disturbance.noise_step",
)  # fmt: skip


class Vector:
    """Eight flights in the lanes of a vector, integrated in common steps, phase by phase.

    Parameters
    ----------
    disturbances : of the flights
    """

    def __init__(self, disturbances: Sequence[Disturbance]) -> None:
        self._tables = gust_and_noise_tables(disturbances)

    def begin(
        self,
        problems: Sequence[Problem],
        states: Sequence[IntegratorState],
        t_end: float,
        times: Floats,
        samples: Sequence[Floats],
    ) -> None:
        """Begin a phase that ends at ``t_end`` [s].

        Parameters
        ----------
        problems : of eight flights, which `can_unroll_together`
        states : of their integrators, at one time; their trails have the same number of rows
        times, samples : times (K,) [s] to record, and an array (K, n) for each flight

        Raises
        ------
        UnfitError
            The problems take different branches.
        """
        self._states, self._t_end, self._times = states, t_end, times
        ready = unrolled_together(problems, self._tables)
        first = states[0]
        n, (rows, forces) = len(first.y), first.trail.gauge.shape
        trails = [addresses([getattr(x.trail, name) for x in states]) for name in lane_steps.TRAIL]
        self._problem = ready._replace(
            samples=addresses(samples), trails=np.array(trails), halves=empty_lanes((2, 5, n))
        )
        K = empty_lanes((lane_steps.ROWS, n))
        unpack_lanes(K)[lane_steps.ATOL] = np.stack(
            [state.K[ATOL, :n] for state in states], axis=-1
        )
        clock = np.array([first.clock[TIME], _FIRST_STEP_IN_VECTORS, LEAST_ERROR])
        y, count = packed([state.y for state in states]), np.zeros_like(first.count)
        trail = NO_TRAIL._replace(clock=np.empty((rows, 2)), gauge=np.empty((0, forces)))
        self._state = IntegratorState(y, K, clock, count, first.rtol, trail)
        self._fresh = True

    def __call__(self, max_steps: int) -> int:
        """Go on to the end of the phase; return what `dopri5.integrate` returns.

        States, samples and trails are then known.
        """
        state = self._state
        state.count[TRAILED:] = self._states[0].count[TRAILED:]
        status = fly_on(
            self._problem, state, self._t_end, self._fresh, self._times, _UNSAMPLED, max_steps
        )
        self._fresh = False
        y = unpack_lanes(state.y)
        for lane, own in enumerate(self._states):
            own.y[:] = y[:, lane]
            own.clock[:], own.count[:] = state.clock, state.count
        return int(status)


_UNSAMPLED = pack_lanes(np.zeros((0, 1, WIDTH)))


def fly_all(
    problem: Problem,
    starts: Floats,
    before: Floats,
    times: tuple[float, float],
    *,
    rtol: float,
    atol: Floats,
    max_steps: int,
    vectors: bool,
    threads: int,
) -> FinalStates:
    """Fly one problem from many starts.

    Parameters
    ----------
    problem : the problem of all flights
    starts : (B, n) states at ``times[0]``
    before : (B, m) distances from which references are blended [m]
    times : start and end [s]
    rtol, atol : relative tolerance, and the absolute one (n,) of each state
    max_steps : number of steps after which a flight has failed
    vectors : whether eight flights share a SIMD vector and its steps. If one of them fails, all eight are
        flown again, one by one. Flight k is in vector k // 8 for any number of threads, so results do
        not depend on ``threads``.
    threads : number of threads

    Raises
    ------
    ValueError
        The flights cannot share vectors, see `can_unroll`.
    """

    def make_scalar_worker() -> Callable[..., None]:
        d0 = problem.reference.d0.copy()
        own = problem._replace(reference=problem.reference._replace(d0=d0))
        w = workspace(len(problem.vehicles.m), len(d0), solver=problem.law.solver)
        unsampled = np.zeros(0), np.zeros((0, starts.shape[1]))

        def fly_one_by_one(
            starts: Floats, before: Floats, ends: Floats, status: Ints, evaluations: Ints
        ) -> None:
            for k, start in enumerate(starts):
                d0[:] = before[k]
                state = integrator(start, times[0], rtol=rtol, atol=atol, step=_FIRST_STEP)
                integration = native.Integration(own, w, state, times[1], *unsampled)
                status[k] = integration(True, max_steps)
                ends[k], evaluations[k] = state.y, state.count[EVALUATIONS]

        return fly_one_by_one

    if not vectors:
        return _fly_in_threads(make_scalar_worker, starts, before, threads)
    if not can_unroll(problem):
        raise ValueError("flights of this problem cannot share vectors; use vectors=False")
    count, n = starts.shape
    ready = unrolled(problem)

    def in_lanes(x: Floats) -> LaneArray:
        if count % WIDTH:  # unused lanes of the last vector repeat the last flight
            x = x[np.minimum(np.arange(padded(count)), count - 1)]
        return pack_lanes(x.reshape(len(x) // WIDTH, WIDTH, x.shape[1]).swapaxes(1, 2))

    def make_vector_worker() -> Callable[..., None]:
        K = np.zeros((lane_steps.ROWS, n, WIDTH))
        K[lane_steps.ATOL] = atol[:, None]
        y, clock = pack_lanes(np.zeros((n, WIDTH))), np.zeros(3)
        counts = np.zeros(FIRST_ROW + 1, dtype=np.int64)
        state = IntegratorState(y, pack_lanes(K), clock, counts, rtol, NO_TRAIL)
        own = ready._replace(
            before=empty_lanes(ready.before.shape), known=empty_lanes(ready.known.shape), time=ready.time.copy(),
            stage=ready.stage.copy(),
        )  # fmt: skip

        def fly_range(*part: Any) -> None:
            fly(own, state, *times, _FIRST_STEP_IN_VECTORS, *part, max_steps, True)

        return fly_range

    ends = _fly_in_threads(make_vector_worker, in_lanes(starts), in_lanes(before), threads)
    y = unpack_lanes(ends.y).swapaxes(1, 2).reshape(-1, n)[:count]
    finished = np.repeat(ends.finished, WIDTH)[:count]
    evaluations = np.repeat(ends.evaluations, WIDTH)[:count]
    lost = ~finished
    if lost.any():
        again = _fly_in_threads(make_scalar_worker, starts[lost], before[lost], threads)
        y[lost], finished[lost], evaluations[lost] = again.y, again.finished, again.evaluations
    return FinalStates(y, finished, evaluations)


def _fly_in_threads(
    begin: Callable[[], Callable[..., None]], starts: Floats, before: Floats, threads: int
) -> FinalStates:
    """Distribute flights, or vectors of them, over threads; each thread calls ``begin`` for a worker of its own."""
    count = len(starts)
    threads = min(threads, count)
    ends = np.empty_like(starts)
    status, evaluations = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    size = max(1, -(-count // (threads * _RANGES)))
    ranges = iter(range(0, count, size))

    def fly_share() -> None:
        fly_part = begin()
        for first in ranges:
            part = slice(first, first + size)
            fly_part(starts[part], before[part], ends[part], status[part], evaluations[part])

    with ThreadPoolExecutor(max(1, threads - 1)) as pool:  # this thread works, too
        jobs = [pool.submit(fly_share) for _ in range(threads - 1)]
        fly_share()
        for job in jobs:
            job.result()
    return FinalStates(ends, status == FINISHED, evaluations)


__getattr__ = getattr_of_earlier_names(
    __name__, fit_together="can_unroll_together", fits="can_unroll"
)
