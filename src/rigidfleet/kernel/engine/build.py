"""Compile the kernel's functions to machine code that can be called without the compiler.

Numba translates the integrator, the recorder, the monitor and all functions that they call to LLVM's intermediate
representation. Functions that are not called from outside become internal, and all are optimised once, together.

In a process of its own (`objects.build_process`) it writes the code to standard output. Most of the time goes into the
translation, so that a second process does its half of it meanwhile.
"""

import pickle
import re
import subprocess
import sys
from contextlib import suppress
from functools import cached_property
from typing import Any

import llvmlite.binding as llvm
from numba import cfunc, typeof, types

from rigidfleet.kernel import (
    constraint,
    control,
    disturbances,
    dopri5,
    dynamics,
    measurement,
    monitor,
    recorder,
    rigid_body,
)
from rigidfleet.kernel.compiler import gathering, numba_internals
from rigidfleet.kernel.compiler.jit import OPTIONS
from rigidfleet.kernel.compiler.pointers import Pointer, pointer
from rigidfleet.kernel.engine import objects, packing

_Functions = dict[Any, tuple[types.Type, ...]]
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
#: Passes that simplify each translated function before inlining.
_QUICK = ("sroa", "simplify_cfg", "instruction_combine", "simplify_cfg")


def machine_code(second: "_SecondProcess | None" = None) -> list[bytes]:
    """Object code of the C functions that `native` calls, `objects.ENTRIES`.

    Their arguments are addresses of named tuples. They integrate (and return what `dopri5.integrate` returns),
    record, and monitor (as `monitor.watch` does). The ``second`` process, if there is one, does part of the work.
    """
    problem, workspace, integrator, segment, record, *_ = _pointers()

    def integrate_segment(p, w, state, s):
        call = segment(s)
        return dopri5.integrate(
            problem(p), workspace(w), integrator(state), call.t_end, call.fresh, call.times, call.samples,
            call.max_steps,
        )  # fmt: skip

    def record_segment(p, w, s, out):
        call = segment(s)
        recorder.record(call.times, call.samples, problem(p), workspace(w), call.dy, record(out))
        return 0

    if second is not None:
        # Before the parts that wait for the second process
        for function, arguments in _halves()[0].items():
            function.compile(arguments)
    functions = zip((integrate_segment, record_segment), objects.ENTRIES, strict=False)
    modules = [_module(function, name) for function, name in functions]
    codes, small = [_object(*module) for module in modules], _small()
    made = None if second is None else second.apart()
    return [*codes, *(made or _apart()), *small]


def _apart() -> list[bytes]:
    """Object codes of the monitor and of measurement, which share nothing with the rest."""
    problem, workspace, integrator, _, _, watching, *_, measured, _ = _pointers()

    def watch_trail(p, w, state, found):
        return monitor.watch(problem(p), workspace(w), integrator(state), watching(found))

    def measure_flight(m):
        measurement.measure(measured(m))
        return 0

    entries = zip((watch_trail, measure_flight), (4, 1), objects.ENTRIES[2:4], strict=True)
    return [_object(*_module(function, name, words)) for function, words, name in entries]


def _small() -> list[bytes]:
    """Object codes of singular values and of packing, for which the first process has time left."""
    spectrum = _pointers()[-1]

    def singular_values(s):
        measurement.spectrum(spectrum(s))
        return 0

    def gather(of, count, asked, words):
        return gathering.gather(of, count, asked, words)

    entries = zip((singular_values, gather), (1, 4), objects.ENTRIES[4:], strict=True)
    return [_object(*_module(function, name, words)) for function, words, name in entries]


def sampled_code() -> list[bytes]:
    """Object code of the two C functions of sampled flights, `objects.SAMPLED_ENTRIES`."""
    from rigidfleet.kernel import quadrotor, sampled_flight

    problem, workspace, *_, flight, state, segment, evaluation, _, _, _ = _pointers()

    def fly(p, w, f, s, call):
        return sampled_flight.fly_ticks(
            problem(p), workspace(w), flight(f), state(s), segment(call)
        )

    def evaluate(f, call):
        return quadrotor.evaluate(flight(f), evaluation(call))

    entries = zip((fly, evaluate), (5, 2), objects.SAMPLED_ENTRIES, strict=True)
    modules = [_module(function, name, arguments) for function, arguments, name in entries]
    return [_object(*module, hot=_HOT_SAMPLED) for module in modules]


def avoidance_code() -> list[bytes]:
    """Object code of avoidance in flight, `objects.AVOIDANCE_ENTRY`."""
    from rigidfleet.kernel import guard

    problem, workspace, *_, flight, state, _, _, avoidance, _, _ = _pointers()

    def avoid(f, s, given, _):
        a = avoidance(given)
        return guard.avoid(problem(a.law[0]), workspace(a.law[1]), flight(f), state(s), a)

    return [_object(*_module(avoid, objects.AVOIDANCE_ENTRY), hot=())]


#: The makers of the libraries beside the first.
LIBRARIES = {"sampled": sampled_code, "avoidance": avoidance_code}


def _pointers() -> list[Any]:
    return [pointer(typeof(x)) for x in packing.examples()]


def _module(function: Any, name: str, arguments: int = 4) -> tuple[str, str, str]:
    """Input of `_object`: the module of a C function of so many addresses, its symbol, and its ``name``."""
    made = cfunc(types.int64(*(types.int64,) * arguments), **OPTIONS)(function)
    return made.inspect_llvm(), made.native_name, name


def _object(text: str, symbol: str, name: str, hot: tuple[str, ...] = _HOT) -> bytes:
    """Object code of a module of which ``symbol`` alone, now called ``name``, is called from outside."""
    module = _simplified(text, symbol, name, hot)
    builder = _passes(3)
    builder.getModulePassManager().run(module, builder)
    for function in module.functions:
        if function.is_declaration and function.name.startswith(("numba_", "NRT_", "Py")):
            raise RuntimeError(
                f"the kernel needs {function.name}, which is available only to Numba's own callers"
            )
    return objects.target_machine().emit_object(module)


def _simplified(text: str, symbol: str, name: str, hot: tuple[str, ...] = _HOT) -> llvm.ModuleRef:
    """Return a module of which ``symbol`` alone, now called ``name``, is called from outside; ``hot`` is inlined."""
    # Only addresses of named tuples are declared dereferenceable, and these are never written.
    module = llvm.parse_assembly(re.sub(r"(?=dereferenceable\(\d+\))", "readonly ", text))
    inlined = tuple(f"{len(name)}{name}B" for name in hot)  # as in Numba's mangled names
    for thing in (*module.functions, *module.global_variables):
        if thing.name == symbol:
            thing.name, thing.linkage = name, "external"
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
    # Loops are short, and the integrator's sums use vectors already
    options.loop_vectorization = False
    return llvm.create_pass_builder(objects.target_machine(), options)


# -- two processes -----------------------------------------------------------------------------------


def _halves() -> tuple[_Functions, _Functions]:
    """Functions with the types of their arguments, first those of this process, then those of the second."""
    example, work, _, _, out, *_ = packing.examples()
    p, w, record = (Pointer(typeof(x)) for x in (example, work, out))
    disturbance = Pointer(typeof(example.disturbance))
    number, row, places = types.float64, typeof(example.vehicles.m), typeof(work.r)
    own = {
        constraint.constraint_force: (number, row, row, p, w),
        dynamics.accelerate: (row, p, w),
        dynamics.body_derivatives: (row, row, p, w),
        recorder.record_sample: (number, p, w, types.int64, record),
        disturbances.disturb: (number, row, number, disturbance, w),
        disturbances.sense: (number, disturbance, w),
        rigid_body.allocate: (
            places, row, number, row, row, row, types.int64, places, places, places, places, places, places
        ),
        rigid_body.mean_axes: (places, places, row, number, w),
        dynamics.world_states: (row, p, w),
    }  # fmt: skip
    others = {
        control.local_law: (number, p, w),
        control.body_law: (number, p, w),
    }
    return own, others


def _translated() -> dict[str, bytes]:
    """The second half: each function in the form of Numba's cache, but already simplified."""
    halves = _halves()[1].items()
    return {f.__name__: numba_internals.portable(f, types_, _simplified) for f, types_ in halves}


class _SecondProcess:
    """The second process, which translates its half and compiles the monitor and measurement.

    Whatever fails there is done in this process.
    """

    def __init__(self, *, shares: bool) -> None:
        self._shares = shares
        self._process = subprocess.Popen(
            objects.build_process("half"), cwd=objects.ELSEWHERE, stdout=subprocess.PIPE
        )  # fmt: skip
        for function, arguments in _halves()[1].items() if shares else ():
            half = self._Half(self, function.__name__, arguments)
            numba_internals.given_by(function, half)

    @cached_property
    def translated(self) -> dict[str, bytes]:
        """Its half of the functions, by name."""
        return self._answer() or {}

    def apart(self) -> list[bytes] | None:
        """The objects of `_apart`."""
        done = self.translated
        return self._answer() if done or not self._shares else None

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        with suppress(EOFError, pickle.UnpicklingError):
            return pickle.load(self._process.stdout)

    class _Half:
        """Acts as the cache of a function for Numba."""

        def __init__(self, process: "_SecondProcess", name: str, arguments: Any) -> None:
            self._process, self._name, self._arguments = process, name, arguments

        def load_overload(self, arguments: Any, context: Any) -> Any:
            """The function from the other process; with None, Numba translates it here."""
            done = self._process.translated.get(self._name)
            if done is None or arguments != self._arguments:
                return None
            return numba_internals.received(context, done)

        def save_overload(self, *_: Any) -> None:
            """Store nothing."""


def main(part: str) -> None:
    """Write machine code to standard output: of "flight", the "half" that the second process makes of it, or a library.

    Numba's internals are used where they are known; else the second process makes the monitor and measurement alone.
    """
    output, known = sys.stdout.buffer, numba_internals.known()
    if known:
        numba_internals.translate_only()
    if part in LIBRARIES:
        output.write(objects.concatenated(LIBRARIES[part]()))
        return
    if part == "half":
        pickle.dump(_translated() if known else {}, output)
        output.flush()
        pickle.dump(_apart(), output)
        return
    output.write(objects.concatenated(machine_code(_SecondProcess(shares=known))))
