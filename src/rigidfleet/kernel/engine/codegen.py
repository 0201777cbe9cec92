"""Fly eight flights at a time, of one problem or of problems that differ in numbers, with straight-line code.

`rigidfleet.kernel.engine.tracer` generates the code of the right-hand side. It is compiled once for each
structure of a problem (its graph, its law, which of its numbers are equal). The integrator is that of
single flights, compiled once for vectors.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable, Container, Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from rigidfleet.kernel import dopri5
from rigidfleet.kernel.compiler import simd
from rigidfleet.kernel.compiler.jit import compiled_copy, compiled_for_c, jit_inline
from rigidfleet.kernel.compiler.simd import VECTOR, WIDTH, LaneArray, unpack_lanes
from rigidfleet.kernel.disturbances import spline_weights
from rigidfleet.kernel.engine import lane_steps
from rigidfleet.kernel.engine.tracer import (
    INPUTS,
    MOMENT,
    TURN,
    Code,
    FlightTrace,
    Symbol,
    Trace,
    code_structure,
    flight_code_structure,
    varying_numbers,
)
from rigidfleet.kernel.problem import Disturbance, Problem
from rigidfleet.kernel.references import piece_at, septic
from rigidfleet.typing import Floats, Ints


class UnrolledProblem(NamedTuple):
    """A problem in the form that straight-line code reads; arrays of lanes hold a number of each of eight flights.

    ``before``, ``time``, ``known``, ``gauge``, ``stage`` and ``halves`` are overwritten in flight. Tables over time
    have no rows if there are none.
    """

    address: int  # of the code
    uniform: LaneArray  # (U,) values that depend on the problem's numbers alone
    before: LaneArray  # (m,) distances from which references are blended [m]
    time: Floats  # (13,) numbers of the moment, see `tracer`, and the moment itself [s]
    known: LaneArray  # (T,) values that depend on the moment, but not on the state
    gauge: LaneArray  # (5N + 2m,) forces to watch, or (0,)
    stage: Ints  # (1,) of the step, which is being evaluated
    t0: float  # [s]
    T_b: float  # [s]
    knots: Floats  # of the reference motion [s]
    motion: LaneArray  # (pieces, 36) its coefficients
    gust_step: float  # [s]
    gust: LaneArray  # (K, 3N)
    noise_step: float  # [s]
    noise_r: LaneArray  # (K, 3N)
    noise_v: LaneArray  # (K, 3N)
    samples: Ints  # (8,) addresses of each flight's samples
    trails: Ints  # (4, 8) of the arrays `lane_steps.TRAIL` of each flight
    halves: LaneArray  # (2, 5, n) control points of the two halves of the last step


def unrolled(problem: Problem) -> UnrolledProblem:
    """Prepare a problem of eight flights for `integrate`; compile its code if it is not yet in the cache.

    Raises
    ------
    UnfitError
        The problem has branches that depend on the state.
    """
    description, values, _ = code_structure(problem)
    return _prepare_unrolled(problem, description, values[:, None], lambda: Trace(problem))


def unrolled_together(problems: Sequence[Problem], tables: dict[str, Any]) -> UnrolledProblem:
    """Prepare eight problems, which `batch.can_unroll_together`, of one flight each.

    Their gusts and noise are in ``tables`` (`gust_and_noise_tables`).

    Raises
    ------
    UnfitError
        The problems have branches that depend on the state, or take different ones.
    """
    first, values = problems[0], varying_numbers(problems)
    turns = values[TURN].any(axis=0)
    if turns.any():  # slots that do not turn, where others do
        values[TURN, ~turns] = _BARELY
    motion = packed([p.motion.coefficients.reshape(-1, 36) for p in problems])
    sizes = np.abs(unpack_lanes(motion)).reshape(-1, 6, 6 * WIDTH).max(axis=(0, 2))
    moves = (sizes > _STILL).tolist()
    description = flight_code_structure(first, values, moves)
    ready = _prepare_unrolled(first, description, values, lambda: FlightTrace(first, values, moves))
    return ready._replace(
        before=packed([p.reference.d0 for p in problems]), knots=first.motion.knots, motion=motion,
        **tables,
    )  # fmt: skip


#: A turn of slots that do not turn: too little to count, yet with a direction [rad].
_BARELY = np.array([[0.0], [0.0], [1e-150]])
#: Coefficients of a component of the reference motion that does not move, in metres or radians and seconds: rounding of
#: a turn about another axis. In 1000 s they would make 1e-15 of it.
_STILL = 1e-30


def gust_and_noise_tables(disturbances: Sequence[Disturbance]) -> dict[str, Any]:
    """Fields of an `UnrolledProblem` with the gusts and the noise of eight flights."""
    first = disturbances[0]
    tables = {
        name: packed(
            [x.reshape(-1, 3 * x.shape[1]) for x in (getattr(d, name) for d in disturbances)]
        )
        for name in ("gust", "noise_r", "noise_v")
    }
    return {"gust_step": first.gust_step, "noise_step": first.noise_step, **tables}


def packed(parts: Sequence[Floats]) -> LaneArray:
    """Lanes (...) of eight arrays of one shape (...)."""
    lanes = simd.empty_lanes(parts[0].shape)
    np.stack(parts, axis=-1, out=unpack_lanes(lanes))
    return lanes


def addresses(arrays: Sequence[Floats]) -> Ints:
    """Addresses of the numbers of some arrays."""
    return np.array([x.ctypes.data for x in arrays])


def _prepare_unrolled(
    problem: Problem, description: bytes, values: Floats, trace: Callable[[], Trace]
) -> UnrolledProblem:
    name = hashlib.sha256(description).hexdigest()[:16]
    if name not in _KNOWN:
        code = Code(trace())
        _KNOWN[name] = code, _compile(code, name), _compile_flight_constants(code, name)
    code, address, before = _KNOWN[name]
    uniform = simd.empty_lanes((len(code.inputs),))
    distinct = simd.pack_lanes(np.broadcast_to(values, (len(values), WIDTH)))
    before(distinct.ctypes.data, uniform.ctypes.data)
    reference, none = problem.reference, simd.empty_lanes((0, 1))
    lanes = lambda count: simd.empty_lanes((count,))  # noqa: E731
    return UnrolledProblem(
        address, uniform, lanes(len(problem.graph.edges)), np.zeros(MOMENT + 1), lanes(len(code.known)),
        lanes(len(code.gauge)), np.zeros(1, dtype=np.int64), reference.t0, reference.T_b, np.zeros(0), none,
        1.0, none, 1.0, none, none, np.zeros(WIDTH, dtype=np.int64),
        np.zeros((len(lane_steps.TRAIL), WIDTH), dtype=np.int64), simd.empty_lanes((2, 5, 0)),
    )  # fmt: skip


#: Code by its structure, the address of what is computed in flight, and a function of two addresses that computes what
#: is known before.
_KNOWN: dict[str, tuple[Code, int, Callable[[int, int], None]]] = {}


#: What an evaluation of the code does beside the derivative, as bits: the values of the moment, and the gauge.
OF_MOMENT, OF_GAUGE = 1, 2


@intrinsic
def _call_unrolled_code(
    _context, address, wanted, y, dy, gauge, uniform, before, time, known, motion, gust, noise_r, noise_v
):  # fmt: skip
    """Call straight-line code with the data of arrays."""

    def generate(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        pointer = ir.DoubleType().as_pointer()
        data = [
            builder.bitcast(context.make_array(kind)(context, builder, value).data, pointer)
            for kind, value in zip(sig.args[2:], arguments[2:], strict=True)
        ]
        data.append(builder.inttoptr(arguments[1], pointer))
        kind = ir.FunctionType(ir.VoidType(), [pointer] * len(data))
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), data)
        return context.get_dummy_value()

    arrays = y, dy, gauge, uniform, before, time, known, motion, gust, noise_r, noise_v
    return types.void(types.int64, types.int64, *arrays), generate


@jit_inline
def _closed_loop(t, y, dy, p, w):
    time, stage, wanted = p.time, p.stage[0], 0
    piece = gust = noise = 0
    # The last two stages are at the same moment.
    if stage == 0 or t != time[MOMENT]:
        wanted, time[MOMENT] = OF_MOMENT, t
        time[0], time[1], time[2] = septic(t, p.t0, p.T_b)
        if p.motion.shape[0] > 0:
            piece, time[3], _ = piece_at(t, p.knots)
        if p.gust.shape[0] > 0:
            gust, time[4], time[5], time[6], time[7] = spline_weights(
                t, p.gust_step, p.gust.shape[0]
            )
        if p.noise_r.shape[0] > 0:
            noise, time[8], time[9], time[10], time[11] = spline_weights(
                t, p.noise_step, p.noise_r.shape[0]
            )
    if stage == 0 or stage == lane_steps.STAGES - 1:  # the start, the middle and the end of a step
        wanted += OF_GAUGE
    _call_unrolled_code(
        p.address, wanted, y, dy, p.gauge, p.uniform, p.before, time, p.known, p.motion[piece:], p.gust[gust:],
        p.noise_r[noise:], p.noise_v[noise:],
    )  # fmt: skip


#: As `dopri5.integrate`, by the steps of `lane_steps`; p is an `UnrolledProblem`, w is not used, arrays hold lanes.
integrate = compiled_copy(
    dopri5.integrate,
    "integrate_straight",
    closed_loop=_closed_loop,
    record_step=compiled_copy(
        lane_steps.record_step, "keep_step_straight", closed_loop=_closed_loop
    ),
    **lane_steps.INSTEAD,
)


def _run_code(y, dy, gauge, uniform, before, time, known, motion, gust, noise_r, noise_v, wanted):
    """Straight-line code: each copy of `_write_dy` has its own."""
    raise NotImplementedError


def _write_dy(y, dy, gauge, uniform, before, time, known, motion, gust, noise_r, noise_v, wanted):
    _run_code(y, dy, gauge, uniform, before, time, known, motion, gust, noise_r, noise_v, wanted)


#: Number of arrays that the code takes, and ``wanted``, bits in the form of an address.
_ARGUMENTS = _write_dy.__code__.co_argcount


def _compile(code: Code, name: str) -> int:
    """Compile straight-line code, or find it compiled on disk; return its address."""

    @intrinsic
    def straight_line_intrinsic(
        _context, y, dy, gauge, uniform, before, time, known, motion, gust, noise_r, noise_v, wanted
    ):
        def generate(context: Any, builder: Any, _sig: Any, arguments: Any) -> Any:
            builder.call(_emit_code(builder.module, code), arguments)
            return context.get_dummy_value()

        kinds = y, dy, gauge, uniform, before, time, known, motion, gust, noise_r, noise_v, wanted
        return types.void(*kinds), generate

    return compiled_for_c(
        _write_dy, f"derivative_{name}", arguments=_ARGUMENTS, _run_code=straight_line_intrinsic
    )


def _write_flight_constants(numbers, uniform):
    """What depends on a problem's numbers alone: each copy of `_compute_before_flight` has its own."""
    raise NotImplementedError


def _compute_before_flight(numbers, uniform):
    _write_flight_constants(numbers, uniform)


def _compile_flight_constants(code: Code, name: str) -> Callable[[int, int], None]:
    """Compile what is known before a flight: a function of the addresses of numbers (D,) and inputs (U,), in lanes."""

    @intrinsic
    def write_constants_intrinsic(_context, source, uniform):
        def generate(context: Any, builder: Any, _sig: Any, arguments: Any) -> Any:
            numbers, inputs = arguments
            load = lambda b, x: b.load(_element_address(b, numbers, x.arguments[0]), align=8)  # noqa: E731
            value = _symbol_evaluator(builder, load)
            for x in code.before:
                value(x)
            for index, x in enumerate(code.inputs):
                builder.store(value(x), _element_address(builder, inputs, index), align=8)
            return context.get_dummy_value()

        return types.void(source, uniform), generate

    address = compiled_for_c(
        _compute_before_flight,
        f"before_{name}",
        arguments=2,
        _write_flight_constants=write_constants_intrinsic,
    )
    return ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(address)


def _element_address(builder: ir.IRBuilder, array: ir.Value, index: int) -> ir.Value:
    """Place of lanes in an array."""
    vectors = builder.bitcast(array, VECTOR.as_pointer())
    return builder.gep(vectors, [ir.Constant(ir.IntType(64), index)])


def _symbol_evaluator(
    builder: ir.IRBuilder,
    load: Callable[[ir.IRBuilder, Symbol], ir.Value],
    stored: Container[int] = (),
) -> Callable[[Symbol | float], ir.Value]:
    """A function that returns the value of a symbol whose arguments it has returned before.

    Sources and the symbols of which the serials are ``stored`` are loaded, at their first use.
    """
    values: dict[int, ir.Value] = {}

    def value(x: Symbol | float) -> ir.Value:
        if not isinstance(x, Symbol):
            return simd.lane_constant(x)
        if x.serial not in values:
            if x.serial in stored or x.operation in INPUTS:
                values[x.serial] = load(builder, x)
            else:
                values[x.serial] = simd.BUILD[x.operation](builder, *map(value, x.arguments))
        return values[x.serial]

    return value


def _emit_code(module: ir.Module, code: Code) -> ir.Function:
    """Write the code as a function of the arguments of `_write_dy`."""
    pointer = ir.DoubleType().as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [pointer] * _ARGUMENTS)
    function = ir.Function(module, kind, "straight_line")
    function.linkage = "internal"
    function.attributes.add("noinline")
    *arrays, wanted = function.args
    for argument in arrays:
        argument.add_attribute("noalias")
    y, dy, gauge, uniform, before, time, known, *rows = arrays
    stored = {x.serial: (uniform, index) for index, x in enumerate(code.inputs)}

    def load(builder: ir.IRBuilder, x: Symbol) -> ir.Value:
        match x.operation, *x.arguments:
            case _ if x.serial in stored:
                array, index = stored[x.serial]
            case "time", place:
                number = builder.gep(time, [ir.Constant(ir.IntType(64), place)])
                return simd.fill_vector(builder, builder.load(number))
            case "table", which, index:
                array = rows[which]
            case operation, index:
                array = {"y": y, "before": before}[operation]
        return builder.load(_element_address(builder, array, index), align=8)

    names = "entry", "moment", "state", "gauge", "end"
    entry, of_moment, of_state, of_gauge, end = map(function.append_basic_block, names)
    bits = ir.IntType(64)

    def branch(builder: ir.IRBuilder, bit: int, there: ir.Block, otherwise: ir.Block) -> None:
        bits_wanted = builder.and_(builder.ptrtoint(wanted, bits), ir.Constant(bits, bit))
        builder.cbranch(
            builder.icmp_unsigned("!=", bits_wanted, ir.Constant(bits, 0)), there, otherwise
        )

    branch(ir.IRBuilder(entry), OF_MOMENT, of_moment, of_state)
    builder = ir.IRBuilder(of_moment)
    value = _symbol_evaluator(builder, load, stored)
    for x in code.moment:
        value(x)
    for index, x in enumerate(code.known):
        builder.store(value(x), _element_address(builder, known, index), align=8)
    builder.branch(of_state)

    builder.position_at_end(of_state)
    stored |= {x.serial: (known, index) for index, x in enumerate(code.known)}
    value = _symbol_evaluator(builder, load, stored)
    for x in code.lines:
        value(x)
    whole = [builder.fcmp_ordered(">", value(x), simd.lane_constant(0.0)) for x in code.positive]
    for index, x in enumerate(code.outputs):
        if index < code.coordinates:  # a velocity, see `lane_steps`
            continue
        result = value(x)
        if index == code.coordinates:  # one state without a derivative is enough
            for good in whole:
                result = builder.select(good, result, simd.lane_constant(float("nan")))
        builder.store(result, _element_address(builder, dy, index), align=8)
    branch(builder, OF_GAUGE, of_gauge, end)

    builder.position_at_end(of_gauge)
    for x in code.last:
        value(x)
    for index, x in enumerate(code.gauge):
        builder.store(value(x), _element_address(builder, gauge, index), align=8)
    builder.branch(end)
    ir.IRBuilder(end).ret_void()
    return function
