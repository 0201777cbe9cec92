"""Many flights of one problem: eight flights per SIMD vector, and vectors distributed over the cores."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from rigidfleet.kernel.compiler.jit import compiled
from rigidfleet.kernel.compiler.pointers import by_address
from rigidfleet.kernel.compiler.simd import WIDTH, LaneArray, pack, unpack
from rigidfleet.kernel.engine import lane_steps, native
from rigidfleet.kernel.engine.codegen import integrate, unrolled
from rigidfleet.kernel.problem import EXACT, ITERATED, OPEN, SHAPE, Problem, padded, workspace
from rigidfleet.kernel.records import FINISHED, LEAST_ERROR, NO_TRAIL, IntegratorState, integrator
from rigidfleet.typing import Bools, Floats, Ints

#: Number of ranges of flights per thread; each range is taken by the next free thread.
_RANGES = 4
#: First step that a flight tries alone, and in a vector, whose pair takes longer steps [s].
_FIRST_STEP, _FIRST_STEP_IN_VECTORS = 1e-3, 1e-2
#: Greatest number of equations for straight-line code, whose length grows with their cube.
_MOST_EQUATIONS = 36


@compiled
def fly(p, state, t0, t_end, step, starts, before, ends, status, evaluations, max_steps, fresh):
    """Integrate vectors of eight flights from ``starts`` (G, n) at t0 to ``t_end`` [s], into ``ends``.

    ``before`` (G, m) [m] are the distances from which the references of each vector are blended. The
    return values of `integrate` are written to ``status`` (G,), and the numbers of evaluations of the
    right-hand side to ``evaluations`` (G,). p, an `UnrolledProblem`, and state are overwritten. ``fresh``
    is always True; a literal here would have another type for the compiler.
    """
    p, state = by_address(p), by_address(state)
    unsampled = state.clock[:0]
    for g in range(starts.shape[0]):
        for q in range(starts.shape[1]):
            state.y[q] = starts[g, q]
        for k in range(before.shape[1]):
            p.before[k] = before[g, k]
        state.clock[0], state.clock[1], state.clock[2] = t0, step, LEAST_ERROR
        for q in range(4):
            state.count[q] = 0
        status[g] = integrate(p, p, state, t_end, fresh, unsampled, ends[:0], max_steps)
        evaluations[g] = state.count[0]
        for q in range(starts.shape[1]):
            ends[g, q] = state.y[q]


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


def fits(problem: Problem) -> bool:
    """Return whether straight-line code can be generated for a problem, and is worthwhile.

    Its branches must not depend on the state, and its code must not be too long to be compiled.
    """
    edges, agents = len(problem.graph.edges), len(problem.vehicles.m)
    equations = min(edges, 3 * agents) if problem.law.solver == ITERATED else edges
    return (
        problem.control.kind == OPEN
        and problem.law.solver in (ITERATED, EXACT)
        and problem.reference.kind != SHAPE
        and not (problem.has_frame or problem.body_formulation or problem.disturbance.active)
        and problem.external == 0
        and equations <= _MOST_EQUATIONS
    )


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
        The problem does not fit vectors, see `fits`.
    """
    if not vectors:
        return _fly_alone(problem, starts, before, times, rtol, atol, max_steps, threads)
    if not fits(problem):
        raise ValueError("flights of this problem cannot share vectors; use vectors=False")
    count, n = starts.shape
    ready = unrolled(problem)

    def packed(x: Floats) -> LaneArray:
        if count % WIDTH:  # unused lanes of the last vector repeat the last flight
            x = x[np.minimum(np.arange(padded(count)), count - 1)]
        return pack(x.reshape(len(x) // WIDTH, WIDTH, x.shape[1]).swapaxes(1, 2))

    def begin() -> Callable[..., None]:
        K = np.zeros((lane_steps.ROWS, n, WIDTH))
        K[lane_steps.ATOL] = atol[:, None]
        y, clock, counts = pack(np.zeros((n, WIDTH))), np.zeros(3), np.zeros(5, dtype=np.int64)
        state = IntegratorState(y, pack(K), clock, counts, rtol, NO_TRAIL)
        own = ready._replace(before=ready.before.copy(), time=ready.time.copy())

        def work(*part: Any) -> None:
            fly(own, state, *times, _FIRST_STEP_IN_VECTORS, *part, max_steps, True)

        return work

    found = _share(begin, packed(starts), packed(before), threads)
    y = unpack(found.y).swapaxes(1, 2).reshape(-1, n)[:count]
    finished = np.repeat(found.finished, WIDTH)[:count]
    evaluations = np.repeat(found.evaluations, WIDTH)[:count]
    lost = ~finished
    if lost.any():
        again = _fly_alone(
            problem, starts[lost], before[lost], times, rtol, atol, max_steps, threads
        )
        y[lost], finished[lost], evaluations[lost] = again.y, again.finished, again.evaluations
    return FinalStates(y, finished, evaluations)


def _fly_alone(
    problem: Problem,
    starts: Floats,
    before: Floats,
    times: tuple[float, float],
    rtol: float,
    atol: Floats,
    max_steps: int,
    threads: int,
) -> FinalStates:
    def begin() -> Callable[..., None]:
        d0 = problem.reference.d0.copy()
        own = problem._replace(reference=problem.reference._replace(d0=d0))
        w = workspace(len(problem.vehicles.m), len(d0), solver=problem.law.solver)
        unsampled = np.zeros(0), np.zeros((0, starts.shape[1]))

        def work(
            starts: Floats, before: Floats, ends: Floats, status: Ints, evaluations: Ints
        ) -> None:
            for k, start in enumerate(starts):
                d0[:] = before[k]
                state = integrator(start, times[0], rtol=rtol, atol=atol, step=_FIRST_STEP)
                status[k] = native.integrate(own, w, state, times[1], True, *unsampled, max_steps)
                ends[k], evaluations[k] = state.y, state.count[0]

        return work

    return _share(begin, starts, before, threads)


def _share(
    begin: Callable[[], Callable[..., None]], starts: Floats, before: Floats, threads: int
) -> FinalStates:
    """Distribute flights, or vectors of them, over threads; each thread calls `begin` for its own data."""
    count = len(starts)
    threads = min(threads, count)
    ends = np.empty_like(starts)
    status, evaluations = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    size = max(1, -(-count // (threads * _RANGES)))
    ranges = iter(range(0, count, size))

    def work() -> None:
        fly_part = begin()
        for first in ranges:
            part = slice(first, first + size)
            fly_part(starts[part], before[part], ends[part], status[part], evaluations[part])

    with ThreadPoolExecutor(max(1, threads - 1)) as pool:  # this thread works, too
        jobs = [pool.submit(work) for _ in range(threads - 1)]
        work()
        for job in jobs:
            job.result()
    return FinalStates(ends, status == FINISHED, evaluations)
