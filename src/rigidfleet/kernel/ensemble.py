"""Many flights of one program: eight of them to a vector, vectors shared out over the cores."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigidfleet.kernel.compiled import compiled
from rigidfleet.kernel.flight import FINISHED, Integrator, integrate, integrator
from rigidfleet.kernel.lanes import WIDTH, LaneArray, pack, padded, unpack
from rigidfleet.kernel.program import (
    EXACT,
    ITERATED,
    OPEN,
    Array,
    Program,
    Workspace,
    workspace,
)

#: What the flights of one vector have in common: times, and what decides on branches.
_COMMON = {"g", "t0", "T_b", "knots", "to_go", "arrival", "gust_step", "noise_step"}
#: A range of flights is begun by whichever thread is free, so many ranges to a thread.
_RANGES = 8
#: Steps of one flight in a phase at most.
_MOST_STEPS = 1_000_000


@compiled
def fly(p, w, state, t0, t_end, step, starts, before, ends, status, evaluations, max_steps, fresh):
    """Integrate from each of ``starts`` (G, n) at t0 to ``t_end`` [s], into ``ends`` (G, n).

    A start is one flight, or eight where the arrays hold lanes. ``before`` (G, m) [m] are the
    distances from which the references of each are blended. What `integrate` returns goes into
    ``status`` (G,), the calls of the right-hand side into ``evaluations`` (G,); p, w and state are
    overwritten. ``fresh`` is true; written here, the compiler would take it for another type.
    """
    unsampled = state.clock[:0]
    for g in range(starts.shape[0]):
        for q in range(starts.shape[1]):
            state.y[q] = starts[g, q]
        for k in range(before.shape[1]):
            p.reference.d0[k] = before[g, k]
        state.clock[0], state.clock[1], state.clock[2] = t0, step, 1e-4
        for q in range(4):
            state.count[q] = 0
        status[g] = integrate(p, w, state, t_end, fresh, unsampled, ends[:0], max_steps)
        evaluations[g] = state.count[0]
        for q in range(starts.shape[1]):
            ends[g, q] = state.y[q]


@dataclass(frozen=True)
class Ends:
    """Where flights have come to.

    Attributes
    ----------
    y : (B, n) states
    finished : (B,) whether the end was reached; the state is the last good one where not
    evaluations : (B,) calls of the right-hand side; flights of a vector share theirs
    """

    y: Array
    finished: NDArray[np.bool_]
    evaluations: NDArray[np.int64]


def fits_lanes(program: Program) -> bool:
    """Return whether flights of a program may share vectors: all their branches are common."""
    return (
        program.control.kind == OPEN
        and program.law.solver in (ITERATED, EXACT)
        and not program.body_formulation
        and program.external == 0
    )


def fly_all(
    program: Program,
    starts: Array,
    before: Array,
    times: tuple[float, float],
    *,
    rtol: float,
    atol: Array,
    lanes: bool,
    threads: int,
) -> Ends:
    """Fly one program from many starts.

    Parameters
    ----------
    program : of every flight
    starts : (B, n) states at ``times[0]``
    before : (B, m) distances from which references are blended [m]
    times : start and end [s]
    rtol, atol : relative tolerance, and the absolute one (n,) of each state
    lanes : whether eight flights share a vector, its steps and its fate: should one of them be
        rejected for good, all eight are flown again alone. The first vectors ever take the
        compiler a minute. Flight k lies in vector k // 8 however many threads there are, so
        results do not depend on ``threads``.
    threads : how many run at a time

    Raises
    ------
    ValueError
        The program does not fit lanes, see `fits_lanes`.
    """
    if lanes and not fits_lanes(program):
        raise ValueError(
            "flights of this program take branches of their own: fly them with lanes=False"
        )
    if not lanes:
        return _run(program, starts, before, times, rtol, atol, threads)
    count = len(starts)
    # Places left over in the last vector repeat the last flight.
    index = np.minimum(np.arange(padded(count)), count - 1)
    vectors = [
        pack(x[index].reshape(-1, WIDTH, x.shape[1]).swapaxes(1, 2)) for x in (starts, before)
    ]
    found = _run(_lifted(program), *vectors, times, rtol, atol, threads)
    y = unpack(found.y).swapaxes(1, 2).reshape(len(index), -1)[:count].copy()
    finished = np.repeat(found.finished, WIDTH)[:count]
    evaluations = np.repeat(found.evaluations, WIDTH)[:count]
    alone = ~finished
    if alone.any():
        again = _run(program, starts[alone], before[alone], times, rtol, atol, threads)
        y[alone], finished[alone], evaluations[alone] = again.y, again.finished, again.evaluations
    return Ends(y, finished, evaluations)


def _run(
    program: Program,
    starts: Array,
    before: Array,
    times: tuple[float, float],
    rtol: float,
    atol: Array,
    threads: int,
) -> Ends:
    """Share the flights, or vectors of them, out over threads."""
    count = len(starts)
    ends = np.empty_like(starts)
    status, evaluations = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    size = max(1, -(-count // (threads * _RANGES)))
    ranges = iter(range(0, count, size))

    def work() -> None:
        p, w, state = _buffers(program, starts, rtol, atol)
        for first in ranges:
            part = slice(first, first + size)
            fly(
                p, w, state, *times, 1e-3, starts[part], before[part], ends[part], status[part],
                evaluations[part], _MOST_STEPS, True,
            )  # fmt: skip

    with ThreadPoolExecutor(threads) as pool:
        for job in [pool.submit(work) for _ in range(threads)]:
            job.result()
    return Ends(ends, status == FINISHED, evaluations)


def _buffers(
    program: Program, starts: Array, rtol: float, atol: Array
) -> tuple[Program, Workspace, Integrator]:
    """What one thread overwrites."""
    reference = program.reference._replace(d0=program.reference.d0.copy())
    n, m = program.vehicles.m.shape[0], program.graph.edges.shape[0]
    w = workspace(n, m, solver=program.law.solver)
    state = integrator(np.zeros(len(atol)), 0.0, rtol=rtol, atol=atol)
    if isinstance(starts, LaneArray):
        w = _lifted(w)
        K = np.zeros((*state.K.shape[:1], len(atol), WIDTH))
        K[-1] = atol[:, None]
        state = state._replace(y=_lifted(state.y), K=pack(K))
    return program._replace(reference=reference), w, state


def _lifted(x: Any, name: str = "") -> Any:
    """Repeat the numbers of a program or workspace in all lanes."""
    if isinstance(x, tuple) and hasattr(x, "_fields"):
        return type(x)(*(_lifted(v, f) for v, f in zip(x, x._fields, strict=True)))
    real = isinstance(x, float) or (isinstance(x, np.ndarray) and x.dtype == np.float64)
    if not real or name in _COMMON:
        return x
    return pack(np.repeat(np.asarray(x)[..., None], WIDTH, axis=-1))
