"""The watch of obstacles of every kind (`rigidfleet.kernel.obstacles`), called; loads the compiler."""

from numba import typeof

from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.compiler.pointers import pointer
from rigidfleet.kernel.engine.native import Watch
from rigidfleet.kernel.engine.packing import examples, pack
from rigidfleet.kernel.monitor import row_of
from rigidfleet.kernel.obstacles import watch_step
from rigidfleet.kernel.problem import Problem
from rigidfleet.kernel.records import IntegratorState
from rigidfleet.solids.records import Solids

_problem, _, _integrator, _, _, _monitor, *_ = (pointer(typeof(x)) for x in examples())


@jit
def _watch_steps(first, end, p, state, monitor, s):
    p, state, monitor = _problem(p), _integrator(state), _monitor(monitor)
    for step in range(first, end):
        row = row_of(step, state)
        start, length = state.trail.clock[row, 0], state.trail.clock[row, 1]
        watch_step(state.trail.points[row], start, length, p, s, monitor)


def watch_solids(
    watch: Watch, problem: Problem, state: IntegratorState, first: int, end: int, solids: Solids
) -> None:
    """Search the steps of a trail from ``first`` to before ``end`` for clearances to all ``solids``."""
    addresses = pack(problem).address, pack(state).address, watch.address
    _watch_steps(first, end, *addresses, solids)
