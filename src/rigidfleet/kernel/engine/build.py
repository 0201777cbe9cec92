"""Compile the kernel's functions to machine code that can be called without the compiler.

Numba translates the integrator, the recorder, the monitor and all functions that they call to LLVM's intermediate
representation. Functions that are not called from outside become internal, and all are optimised once, together.

In a process of its own (`objects.build_command`) it writes the code to standard output. A second process makes what
shares little with the integrator meanwhile.
"""

# ruff: noqa: PLW0108 -- functions are called, not entered themselves: how the compiler fuses products depends on it
import re
import subprocess
import sys
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
from rigidfleet.kernel.compiler.pointers import Pointer, pointer_cast
from rigidfleet.kernel.engine import objects, packing
from rigidfleet.kernel.measured import Measured
from rigidfleet.kernel.problem import Problem, Workspace
from rigidfleet.kernel.records import IntegratorState, Monitor, Record, Recursion, Segment
from rigidfleet.solids.records import Solids

#: Functions that every evaluation calls, to be inlined; calls would take a tenth of a small formation's time.
_HOT = (
    "closed_loop", "input_law", "constraint_force", "mean_axes", "centre_of_mass", "inertia",
    "inertia_inverse", "multiply", "damp_deformation", "reference_motion", "desired_agents", "local_law", "septic",
    "blend_slots", "distance_references", "right_side", "solve_multipliers", "assemble", "cholesky",
    "cholesky_solve", "apply_multipliers",
)  # fmt: skip
#: The same of sampled flights.
_HOT_SAMPLED = ("attitude_matrix", "quaternion_rate", "thrust_of", "speed_of")
#: Functions of the solver of large formations that return a number.
_RETURNING = {"solve", "add_block_counts", "factor", "inner", "conjugate_gradients"}
#: Passes that simplify each translated function before inlining.
_QUICK = ("sroa", "simplify_cfg", "instruction_combine", "simplify_cfg")


def flight_object_code(second: "subprocess.Popen[bytes] | None" = None) -> list[bytes]:
    """Object code of the C functions of the first library.

    Their arguments are addresses of named tuples. They integrate (and return what `dopri5.integrate` returns),
    record, and monitor. The ``second`` process, if there is one, makes what is `monitor_object_code`.
    """

    def integrate_segment(p, w, state, call):
        return dopri5.integrate(
            p, w, state, call.t_end, call.fresh, call.times, call.samples, call.max_steps
        )

    def record_segment(p, w, call, out):
        recorder.write_record(call.times, call.samples, p, w, call.dy, out, call.first)
        return 0

    integrated, recorded = (IntegratorState, Segment), (Segment, Record)
    integration = _ir_text(integrate_segment, Problem, Workspace, *integrated, result=types.int64)
    recording = _ir_text(record_segment, Problem, Workspace, *recorded, result=types.int64)
    codes = [_object_code(*integration, "integrate"), _object_code(*recording, "record")]
    made = None if second is None else objects.split_object_codes(second.communicate()[0])
    return [*codes, *(made or monitor_object_code())]


def monitor_object_code() -> list[bytes]:
    """Object codes of monitor, measurement, clearances and recursions, which share little with the rest."""
    watched, word = (Problem, IntegratorState, Monitor), types.int64
    with_law = Problem, Workspace, IntegratorState, Monitor
    calls = (
        ("write_first_step_change_bounds", lambda p, s, m: monitor.write_first_step_change_bounds(p, s, m), *watched),
        ("watch_trail_distances",
         lambda i, j, p, s, m: monitor.watch_trail_distances(i, j, p, s, m), word, word, *watched),
        ("watch_forces", lambda last, p, w, s, m: monitor.watch_forces(last, p, w, s, m), word, *with_law),
        ("measure", lambda m: measurement.measure_samples(m), Measured),
        ("follow", lambda s: recursion.run_linear_recursion(s), Recursion),
    )  # fmt: skip
    return [_object_code(*_ir_text(*call), name) for name, *call in calls]


def sampled_object_code() -> list[bytes]:
    """Object code of sampled flights."""
    from rigidfleet.kernel import sampled_flight

    def fly(p, w, flight, state, call):
        return sampled_flight.fly_ticks(p, w, flight, state, call)

    kinds = Problem, Workspace, fleet.SampledFlight, fleet.SampledState, fleet.SampledSegment
    module = _ir_text(fly, *kinds, result=types.int64)
    return [_object_code(*module, "fly_ticks", hot=_HOT_SAMPLED)]


def avoidance_object_code() -> list[bytes]:
    """Object code of avoidance in flight."""
    from rigidfleet.kernel import guard

    problem, workspace = (pointer_cast(_numba_type_of(kind)) for kind in (Problem, Workspace))

    def avoid(f, s, a, _):
        return guard.correct_forces(problem(a.law[0]), workspace(a.law[1]), f, s, a)

    word = types.int64
    kinds = fleet.SampledFlight, fleet.SampledState, AvoidanceArrays, word
    return [_object_code(*_ir_text(avoid, *kinds, result=word), "avoid", hot=())]


def solids_object_code() -> list[bytes]:
    """Object code of the monitor of obstacles that move or are no plain boxes."""
    from rigidfleet.kernel.obstacles import watch_clearances

    row_of = monitor.trail_row_of

    def watch_trail_clearances(first, end, p, state, watch, solids):
        for step in range(first, end):
            row, trail = row_of(step, state), state.trail
            watch_clearances(
                trail.points[row], trail.clock[row, 0], trail.clock[row, 1], p, solids, watch
            )

    kinds = types.int64, types.int64, Problem, IntegratorState, Monitor, Solids
    return [
        _object_code(*_ir_text(watch_trail_clearances, *kinds), "watch_trail_clearances", hot=())
    ]


def large_solver_object_code() -> list[bytes]:
    """Object code of the functions of the solver of large formations."""
    codes = []
    for name, kind in packing.OF_LARGE.items():
        source = name.removesuffix("_single")
        function = getattr(elimination, source, None) or getattr(block_cholesky, source)
        fields = ", ".join(f"x.{field}" for field in kind._fields)
        call = f"return 0.0 + f({fields})" if source in _RETURNING else f"f({fields}); return 0.0"
        scope = {"f": function}
        exec(f"def entry(x):\n    {call}", scope)
        module = _ir_text(scope["entry"], kind, result=types.float64)
        codes.append(_object_code(*module, name, hot=()))
    return codes


#: The makers of the libraries beside the first, and of the part that a second process makes of that.
LIBRARIES = {
    "sampled": sampled_object_code,
    "avoidance": avoidance_object_code,
    "solids": solids_object_code,
    "large": large_solver_object_code,
    "apart": monitor_object_code,
}


def _numba_type_of(kind: type) -> Any:
    """The type, for the compiler, of a type of named tuples."""
    return typeof(packing.example_of(kind))


def _ir_text(function: Any, *arguments: Any, result: Any = types.void) -> tuple[str, str]:
    """The module of a C function of words and of addresses of named tuples of these types, and its symbol."""
    kinds = [x if x is types.int64 else Pointer(_numba_type_of(x)) for x in arguments]
    made = cfunc(result(*kinds), **OPTIONS)(function)
    return made.inspect_llvm(), made.native_name


def _object_code(text: str, symbol: str, name: str, hot: tuple[str, ...] = _HOT) -> bytes:
    """Object code of a module of which ``symbol`` alone, the function ``name``, is called."""
    module = _simplify(text, symbol, name, hot)
    builder = _pass_builder(3)
    builder.getModulePassManager().run(module, builder)
    for function in module.functions:
        if function.is_declaration and function.name.startswith(("numba_", "NRT_", "Py")):
            raise RuntimeError(
                f"the kernel needs {function.name}, which is available only to Numba's own callers"
            )
    return objects.target_machine().emit_object(module)


def _simplify(text: str, symbol: str, name: str, hot: tuple[str, ...]) -> llvm.ModuleRef:
    """Return a module of which ``symbol`` alone, the function ``name``, is called from outside; ``hot`` is inlined."""
    # Only addresses of named tuples are declared dereferenceable, and these are never written.
    module = llvm.parse_assembly(re.sub(r"(?=dereferenceable\(\d+\))", "readonly ", text))
    inlined = tuple(f"{len(name)}{name}B" for name in hot)  # as in Numba's mangled names
    for thing in (*module.functions, *module.global_variables):
        if thing.name == symbol:
            thing.name, thing.linkage = objects.symbol_name(name), "external"
        elif not thing.is_declaration:
            thing.linkage = "internal"
            if thing.is_function and any(name in thing.name for name in inlined):
                thing.add_function_attribute("alwaysinline")
    # A few quick passes first reduce the work of the full ones to a third.
    quick = llvm.create_new_module_pass_manager()
    for add in _QUICK:
        getattr(quick, f"add_{add}_pass")()
    quick.run(module, _pass_builder(1))
    return module


def _pass_builder(level: int) -> Any:
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
        codes = flight_object_code(second)
    sys.stdout.buffer.write(objects.pack_object_codes(codes))
