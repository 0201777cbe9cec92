"""Fly eight flights of one problem at a time, with straight-line code generated for it.

`rigidfleet.kernel.engine.tracer` generates the code of the right-hand side. It is compiled once for each
structure of a problem (its graph, its law, which of its numbers are equal). The integrator is that of
single flights, compiled once for vectors.
"""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from rigidfleet.kernel import dopri5
from rigidfleet.kernel.compiler import simd
from rigidfleet.kernel.compiler.jit import compiled_copy, compiled_for_c, inlined
from rigidfleet.kernel.compiler.simd import VECTOR, WIDTH, LaneArray
from rigidfleet.kernel.engine import lane_steps
from rigidfleet.kernel.engine.tracer import Code, Symbol, Trace, structure
from rigidfleet.kernel.problem import Problem
from rigidfleet.kernel.references import septic
from rigidfleet.typing import Floats


class UnrolledProblem(NamedTuple):
    """A problem in the form that straight-line code reads; ``before`` and ``time`` are overwritten in flight."""

    address: int  # of the code
    uniform: Floats  # (U,) values that depend on the problem's numbers alone
    before: LaneArray  # (m,) distances from which references are blended [m]
    time: Floats  # (3,) blend of the references, and two derivatives
    t0: float  # [s]
    T_b: float  # [s]


def unrolled(problem: Problem) -> UnrolledProblem:
    """Prepare a problem for `integrate`; compile its code if it is not yet in the cache.

    Raises
    ------
    UnfitError
        The problem has branches that depend on the state.
    """
    description, numbers, _ = structure(problem)
    name = hashlib.sha256(description).hexdigest()[:16]
    if name not in _KNOWN:
        code = Code(Trace(problem))
        _KNOWN[name] = code, _compile(code, name)
    code, address = _KNOWN[name]
    reference = problem.reference
    before = simd.pack(np.zeros((len(problem.graph.edges), WIDTH)))
    return UnrolledProblem(
        address, code.values(numbers), before, np.zeros(3), reference.t0, reference.T_b
    )


_KNOWN: dict[str, tuple[Code, int]] = {}


@intrinsic
def _call_code(_context, address, y, dy, uniform, before, time):
    """Call straight-line code with the data of five arrays."""

    def generate(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        pointer = ir.DoubleType().as_pointer()
        data = [
            builder.bitcast(context.make_array(kind)(context, builder, value).data, pointer)
            for kind, value in zip(sig.args[1:], arguments[1:], strict=True)
        ]
        kind = ir.FunctionType(ir.VoidType(), [pointer] * len(data))
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), data)
        return context.get_dummy_value()

    return types.void(types.int64, y, dy, uniform, before, time), generate


@inlined
def _closed_loop(t, y, dy, p, w):
    p.time[0], p.time[1], p.time[2] = septic(t, p.t0, p.T_b)
    _call_code(p.address, y, dy, p.uniform, p.before, p.time)


#: As `dopri5.integrate`, by the steps of `lane_steps`; p is an `UnrolledProblem`, w is not used, arrays hold lanes.
integrate = compiled_copy(
    dopri5.integrate, "integrate_straight", closed_loop=_closed_loop, **lane_steps.INSTEAD
)


def _lines(y, dy, uniform, before, time):
    """Straight-line code: each copy of `_derivative` has its own."""
    raise NotImplementedError


def _derivative(y, dy, uniform, before, time):
    _lines(y, dy, uniform, before, time)


def _compile(code: Code, name: str) -> int:
    """Compile straight-line code, or find it compiled on disk; return its address."""

    @intrinsic
    def lines(_context, y, dy, uniform, before, time):
        def generate(context: Any, builder: Any, _sig: Any, arguments: Any) -> Any:
            builder.call(_emit(builder.module, code), arguments)
            return context.get_dummy_value()

        return types.void(y, dy, uniform, before, time), generate

    return compiled_for_c(_derivative, f"derivative_{name}", arguments=5, _lines=lines)


def _emit(module: ir.Module, code: Code) -> ir.Function:
    """Write the code as a function of pointers to y, dy, uniform, before and time."""
    pointer = ir.DoubleType().as_pointer()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer] * 5), "straight_line")
    function.linkage = "internal"
    function.attributes.add("noinline")
    for argument in function.args:
        argument.add_attribute("noalias")
    y, dy, uniform, before, time = function.args
    builder = ir.IRBuilder(function.append_basic_block())
    values: dict[int, ir.Value] = {}

    def element(array: ir.Value, index: int) -> ir.Value:
        vectors = builder.bitcast(array, VECTOR.as_pointer())
        return builder.gep(vectors, [ir.Constant(ir.IntType(64), index)])

    def scalar(array: ir.Value, index: int) -> ir.Value:
        place = builder.gep(array, [ir.Constant(ir.IntType(64), index)])
        return simd.in_all(builder, builder.load(place))

    inputs = {x.serial: index for index, x in enumerate(code.inputs)}

    def value(x: Symbol | float) -> ir.Value:
        """The value of a symbol, computed already or loaded at its first use."""
        if not isinstance(x, Symbol):
            return simd.number(x)
        if x.serial not in values:
            if x.serial in inputs:
                found = scalar(uniform, inputs[x.serial])
            elif x.operation == "time":
                found = scalar(time, x.arguments[0])
            else:
                array = {"y": y, "before": before}[x.operation]
                found = builder.load(element(array, x.arguments[0]), align=8)
            values[x.serial] = found
        return values[x.serial]

    for x in code.lines:
        values[x.serial] = simd.BUILD[x.operation](builder, *map(value, x.arguments))
    whole = [builder.fcmp_ordered(">", value(x), simd.number(0.0)) for x in code.positive]
    for index, x in enumerate(code.outputs):
        if index < code.coordinates:  # a velocity, see `lane_steps`
            continue
        found = value(x)
        if index == code.coordinates:  # one state without a derivative is enough
            for good in whole:
                found = builder.select(good, found, simd.number(float("nan")))
        builder.store(found, element(dy, index), align=8)
    builder.ret_void()
    return function
