"""Compile the kernel's functions to machine code that can be called without the compiler.

Numba translates the integrator, the recorder, the monitor and all functions that they call to LLVM's intermediate
representation. Functions that are not called from outside become internal, and all are optimised once, together.

In a process of its own (`objects.build_command`) it writes the code to standard output. A second process makes what
shares little with the integrator meanwhile.
"""

import re
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import llvmlite.binding as llvm
from numba import cfunc, typeof, types

from rigidfleet.kernel import (
    block_cholesky,
    dopri5,
    elimination,
    fleet,
    measurement,
    monitor,
    recorder,
    recursion,
)
from rigidfleet.kernel.avoidance import AvoidanceArrays
from rigidfleet.kernel.compiler.jit import OPTIONS
from rigidfleet.kernel.compiler.pointers import keep_extents, pointer, set_extents
from rigidfleet.kernel.engine import objects, packing
from rigidfleet.kernel.measured import Measured
from rigidfleet.kernel.problem import Problem, Workspace
from rigidfleet.kernel.records import IntegratorState, Monitor, Record, Recursion, Segment
from rigidfleet.solids.records import Solids

#: Functions that every evaluation calls, to be inlined; calls would take a tenth of a small formation's time.
_HOT = (
    "closed_loop", "input_law", "constraint_force", "accelerate", "mean_axes", "centre_of_mass", "inertia",
    "inertia_inverse", "multiply", "damp_deformation", "reference_motion", "desired_agents", "local_law", "septic",
    "blend_slots", "distance_references", "right_side", "solve_multipliers", "assemble", "cholesky",
    "cholesky_solve", "apply_multipliers",
)  # fmt: skip
#: The same of sampled flights.
_HOT_SAMPLED = (
    "derivative", "attitude_matrix", "quaternion_rate", "contact", "normalise", "thrust_of", "speed_of",
)  # fmt: skip
#: Extents of the triangle, the paper's first formation, for which the integrator is compiled once more: loops of known
#: length save a fifth of the time.
THREE = {"N": 3, "m": 3, "P": 3, "A": 3}
#: No extents: code for any number of agents.
ANY: Mapping[str, int] = {}
#: Functions of the solver of large formations that return a number.
_RETURNING = {"solve", "count_blocks", "factor", "inner", "conjugate_gradients"}
#: Passes that simplify each translated function before inlining.
_QUICK = ("sroa", "simplify_cfg", "instruction_combine", "simplify_cfg")


def flight_code(second: "subprocess.Popen[bytes] | None" = None) -> list[bytes]:
    """Object code of the C functions of the first library.

    Their arguments are addresses of named tuples. They integrate (and return what `dopri5.integrate` returns),
    record, and monitor. The ``second`` process, if there is one, makes what is `monitor_code`.
    """
    problem, workspace, integrator, segment, record = map(
        _pointer, (Problem, Workspace, IntegratorState, Segment, Record)
    )

    def integrate_segment(p, w, state, s):
        call = segment(s)
        return dopri5.integrate(
            problem(p), workspace(w), integrator(state), call.t_end, call.fresh, call.times, call.samples,
            call.max_steps,
        )  # fmt: skip

    def record_segment(p, w, s, out):
        call = segment(s)
        recorder.record(
            call.times, call.samples, problem(p), workspace(w), call.dy, record(out), call.first
        )
        return 0

    keep_extents()
    entries = objects.ENTRIES["flight"]
    functions = zip((integrate_segment, record_segment), entries.items(), strict=False)
    modules = [_module(function, *entry) for function, entry in functions]
    text, symbol, _ = modules[0]
    codes = [_object_code(*module) for module in modules]
    three = _object_code(text, symbol, "integrate_three", sizes=THREE)
    made = None if second is None else objects.split_objects(second.communicate()[0])
    return [*codes, *(made or monitor_code()), three]


def monitor_code() -> list[bytes]:
    """Object codes of monitor, measurement, clearances and recursions, which share little with the rest."""
    problem, workspace, integrator, watching = map(
        _pointer, (Problem, Workspace, IntegratorState, Monitor)
    )

    def bound_moves(p, state, watch):
        monitor.bound_changes(problem(p), integrator(state), watching(watch))
        return 0

    def watch_distances(first, end, p, state, watch):
        monitor.watch_distances(first, end, problem(p), integrator(state), watching(watch))
        return 0

    def watch_forces(last, p, w, state, watch):
        monitor.watch_forces(last, problem(p), workspace(w), integrator(state), watching(watch))
        return 0

    def caller(function, of):
        def call(address):
            function(of(address))
            return 0

        return call

    functions = (
        bound_moves,
        watch_distances,
        watch_forces,
        caller(measurement.measure, _pointer(Measured)),
        caller(recursion.recurse, _pointer(Recursion)),
    )
    entries = list(objects.ENTRIES["flight"].items())[2:-1]
    return [
        _object_code(*_module(function, name, words))
        for function, (name, words) in zip(functions, entries, strict=True)
    ]


def sampled_code() -> list[bytes]:
    """Object code of the two C functions of sampled flights."""
    from rigidfleet.kernel import quadrotor, sampled_flight

    problem, workspace, flight, state = map(
        _pointer, (Problem, Workspace, fleet.SampledFlight, fleet.SampledState)
    )
    segment, evaluation = map(_pointer, (fleet.SampledSegment, fleet.Evaluation))

    def fly(p, w, f, s, call):
        return sampled_flight.fly_ticks(
            problem(p), workspace(w), flight(f), state(s), segment(call)
        )

    def evaluate(f, call):
        return quadrotor.evaluate(flight(f), evaluation(call))

    functions = zip((fly, evaluate), objects.ENTRIES["sampled"].items(), strict=True)
    modules = [_module(function, *entry) for function, entry in functions]
    return [_object_code(*module, hot=_HOT_SAMPLED) for module in modules]


def avoidance_code() -> list[bytes]:
    """Object code of avoidance in flight."""
    from rigidfleet.kernel import guard

    problem, workspace, flight, state = map(
        _pointer, (Problem, Workspace, fleet.SampledFlight, fleet.SampledState)
    )
    avoidance = _pointer(AvoidanceArrays)

    def avoid(f, s, address, _):
        a = avoidance(address)
        return guard.guard_forces(problem(a.law[0]), workspace(a.law[1]), flight(f), state(s), a)

    return [_object_code(*_module(avoid, "avoid", objects.ENTRIES["avoidance"]["avoid"]), hot=())]


def solids_code() -> list[bytes]:
    """Object code of the monitor of obstacles that move or are no plain boxes."""
    from rigidfleet.kernel.obstacles import watch_step

    row_of = monitor.row_of
    problem, integrator, watching, solids = map(
        _pointer, (Problem, IntegratorState, Monitor, Solids)
    )

    def watch_solids(first, end, p, state, watch, s):
        at, trail = integrator(state), integrator(state).trail
        for step in range(first, end):
            row = row_of(step, at)
            start, length = trail.clock[row, 0], trail.clock[row, 1]
            watch_step(trail.points[row], start, length, problem(p), solids(s), watching(watch))
        return 0

    return [_object_code(*_module(watch_solids, "watch_solids", 6), hot=())]


def large_code() -> list[bytes]:
    """Object code of the functions of the solver of large formations."""
    codes = []
    for name, kind in packing.OF_LARGE.items():
        source = name.removesuffix("_single")
        function = getattr(elimination, source, None) or getattr(block_cholesky, source)
        fields = ", ".join(f"x.{field}" for field in kind._fields)
        call = f"return 0.0 + f({fields})" if source in _RETURNING else f"f({fields}); return 0.0"
        scope = {"at": _pointer(kind), "f": function}
        exec(f"def entry(address):\n    x = at(address)\n    {call}", scope)
        codes.append(_object_code(*_module(scope["entry"], name, 1, types.float64), hot=()))
    return codes


#: The makers of the libraries beside the first, and of the part that a second process makes of that.
LIBRARIES = {
    "sampled": sampled_code,
    "avoidance": avoidance_code,
    "solids": solids_code,
    "large": large_code,
    "apart": monitor_code,
}


def _pointer(kind: type) -> Any:
    """The compiled function that converts an int64 to the address of a named tuple of this type."""
    return pointer(typeof(packing.example_of(kind)))


def _module(
    function: Any, name: str, arguments: int, result: Any = types.int64
) -> tuple[str, str, str]:
    """Input of `_object_code`: the module of a C function of so many addresses, its symbol, and its ``name``."""
    made = cfunc(result(*(types.int64,) * arguments), **OPTIONS)(function)
    return made.inspect_llvm(), made.native_name, name


def _object_code(
    text: str,
    symbol: str,
    name: str,
    hot: tuple[str, ...] = _HOT,
    sizes: Mapping[str, int] = ANY,
) -> bytes:
    """Object code of a module of which ``symbol`` alone, the function ``name``, is called; see `set_extents`."""
    module = _simplify(set_extents(text, sizes), symbol, name, hot)
    builder = _passes(3)
    builder.getModulePassManager().run(module, builder)
    for function in module.functions:
        if function.is_declaration and function.name.startswith(("numba_", "NRT_", "Py")):
            raise RuntimeError(
                f"the kernel needs {function.name}, which is available only to Numba's own callers"
            )
    return objects.target_machine().emit_object(module)


def _simplify(text: str, symbol: str, name: str, hot: tuple[str, ...] = _HOT) -> llvm.ModuleRef:
    """Return a module of which ``symbol`` alone, the function ``name``, is called from outside; ``hot`` is inlined."""
    # Only addresses of named tuples are declared dereferenceable, and these are never written.
    module = llvm.parse_assembly(re.sub(r"(?=dereferenceable\(\d+\))", "readonly ", text))
    inlined = tuple(f"{len(name)}{name}B" for name in hot)  # as in Numba's mangled names
    for thing in (*module.functions, *module.global_variables):
        if thing.name == symbol:
            thing.name, thing.linkage = objects.symbol(name), "external"
        elif not thing.is_declaration:
            thing.linkage = "internal"
            if thing.is_function and any(name in thing.name for name in inlined):
                thing.add_function_attribute("alwaysinline")
    # A few quick passes first reduce the work of the full ones to a third.
    quick = llvm.create_new_module_pass_manager()
    for add in _QUICK:
        getattr(quick, f"add_{add}_pass")()
    quick.run(module, _passes(1))
    return module


def _passes(level: int) -> Any:
    options = llvm.create_pipeline_tuning_options(speed_level=level)
    # Most loops are short, and the integrator's sums use vectors already
    options.loop_vectorization = False
    return llvm.create_pass_builder(objects.target_machine(), options)


def main(part: str) -> None:
    """Write machine code to standard output: of "flight", for which a second process is started, or of a library."""
    if part in LIBRARIES:
        codes = LIBRARIES[part]()
    else:
        second = subprocess.Popen(
            objects.build_command("apart"), cwd=objects.ELSEWHERE, stdout=subprocess.PIPE
        )
        codes = flight_code(second)
    sys.stdout.buffer.write(objects.concatenate(codes))
