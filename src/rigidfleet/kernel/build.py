"""From the kernel's functions to machine code that needs no compiler to be called.

Numba translates the integrator, the recorder and all they call to LLVM's language. What is then called from
nowhere else may be rearranged at will, and is optimised once, together.

As a program (``python -m rigidfleet.kernel.build``) it writes the code to standard output.
"""

import re
import sys

import llvmlite.binding as llvm
from numba import cfunc, typeof, types

from rigidfleet.kernel import flight, native
from rigidfleet.kernel.compiled import OPTIONS
from rigidfleet.kernel.pointers import pointer

#: What every evaluation of a flight goes through: its calls would take a tenth of a small formation's time.
_HOT = (
    "closed_loop", "mean_axes", "centre_of_mass", "inertia", "inertia_inverse", "multiply", "damp_deformation",
    "reference_motion", "desired_agents", "local_law", "septic", "blend_slots", "distance_references", "right_side",
    "solve_multipliers", "assemble", "cholesky", "cholesky_solve", "apply_multipliers",
)  # fmt: skip


def machine_code() -> bytes:
    """Object code of the C function that `native` calls: int64(program, workspace, integrator, stretch, record).

    All are addresses of named tuples. It integrates and returns what `flight.integrate` does; without an
    integrator, it records.
    """
    program, workspace, integrator, stretch, record = (
        pointer(typeof(x)) for x in native.examples()
    )

    def enter(p, w, state, s, out):
        call = stretch(s)
        if state != 0:
            return flight.integrate(
                program(p), workspace(w), integrator(state), call.t_end, call.fresh, call.times, call.samples,
                call.max_steps,
            )  # fmt: skip
        flight.record(call.times, call.samples, program(p), workspace(w), call.dy, record(out))
        return 0

    entry = cfunc(types.int64(*(types.int64,) * 5), **OPTIONS)(enter)
    return _optimised(entry.inspect_llvm(), entry.native_name)


def _optimised(text: str, symbol: str) -> bytes:
    """Object code of a module of which ``symbol`` alone is called from outside."""
    # Of the arguments only addresses of named tuples are said to be dereferenceable; nobody writes there.
    module = llvm.parse_assembly(re.sub(r"(?=dereferenceable\(\d+\))", "readonly ", text))
    hot = tuple(f"{len(name)}{name}B" for name in _HOT)  # as in the names that Numba gives
    for thing in (*module.functions, *module.global_variables):
        if thing.name == symbol:
            thing.name = native.ENTRY
        elif not thing.is_declaration:
            thing.linkage = "internal"
            if thing.is_function and any(name in thing.name for name in hot):
                thing.add_function_attribute("alwaysinline")
    machine = native.target_machine()
    # That nothing fails, and nothing of Python is ever called to say so, shows only once all is inlined: a first,
    # quick run leaves it to the second.
    for level in (1, 3):
        options = llvm.create_pipeline_tuning_options(speed_level=level)
        options.loop_vectorization = False  # loops are short; the integrator's sums are of vectors
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(module, builder)
    for function in module.functions:
        if function.is_declaration and function.name.startswith(("numba_", "NRT_", "Py")):
            raise RuntimeError(
                f"the kernel needs {function.name}, which only Numba's own callers have"
            )
    return machine.emit_object(module)


if __name__ == "__main__":
    sys.stdout.buffer.write(native.sealed(machine_code()))
