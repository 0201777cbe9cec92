"""Vectors of eight doubles as Numba values, so that one source serves single flights and batches.

A `lanes` value holds eight doubles; arithmetic, ``max`` and ``abs`` act on each of them. A `LaneArray`
is an array of such values. The unchanged source of the integrator compiles for them: eight flights in
the lanes share their steps. For a single flight, `as_lanes` views eight consecutive states as one value,
so that the integrator's sums use the machine's vector registers.
"""

import math
import operator
from functools import partial
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils, config
from numba.core.imputils import impl_ret_borrowed
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import (
    intrinsic,
    lower_builtin,
    lower_cast,
    models,
    register_model,
    typeof_impl,
)
from numpy.typing import NDArray

from rigidfleet.kernel.compiler import jit  # noqa: F401 -- sets for which processor Numba compiles
from rigidfleet.kernel.problem import zeros
from rigidfleet.typing import Floats

#: Number of lanes of a value.
WIDTH = 8
# Products and sums may be fused but not reordered, so that the result of a lane never depends on the compiler.
_FAST = ("contract", "arcp", "nsz")
VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
_INDEX = ir.IntType(32)
# Whether the machine can estimate eight roots or quotients at once, to 14 bits, and this is enabled.
_ESTIMATES = config.CPU_NAME == "x86-64-v4" or (
    not config.CPU_NAME and bool(binding.get_host_cpu_features().get("avx512f"))
)


class _Lanes(types.Type):
    def __init__(self) -> None:
        super().__init__(name="lanes")

    def can_convert_from(self, _context: Any, other: types.Type) -> Conversion | None:
        return Conversion.safe if _is_number(other) else None

    def unify(self, _context: Any, other: types.Type) -> types.Type | None:
        return self if _is_number(other) else None


def _is_number(kind: types.Type) -> bool:
    return isinstance(kind, types.Float | types.Integer)


lanes = _Lanes()


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


#: A number of each lane, for NumPy.
_KIND = np.dtype((np.void, WIDTH * 8))


class LaneArray(np.ndarray):
    """An array of `lanes`, made by `pack_lanes` and read by `unpack_lanes`."""


def pack_lanes(values: Floats) -> LaneArray:
    """An array (...) of lanes from float64 (..., 8): a copy, aligned for vectors."""
    values = np.asarray(values, dtype=np.float64)
    packed = empty_lanes(values.shape[:-1])
    unpack_lanes(packed)[...] = values
    return packed


def empty_lanes(shape: tuple[int, ...]) -> LaneArray:
    """An array of lanes with any numbers, aligned for vectors."""
    return zeros(math.prod(shape) * WIDTH).view(_KIND).reshape(shape).view(LaneArray)


def unpack_lanes(array: NDArray[Any]) -> Floats:
    """View an array (...) of lanes as float64 (..., 8)."""
    plain = array.view(np.ndarray)
    return plain.reshape(plain.shape + (1,)).view(np.float64)


@typeof_impl.register(LaneArray)
def _typeof(value: LaneArray, _context: Any) -> types.Type:
    # Alignment is not declared, because NumPy does not guarantee it; arrays made by `pack` are aligned.
    return types.Array(lanes, value.ndim, "C", aligned=False)


def fill_vector(builder: ir.IRBuilder, number: ir.Value) -> ir.Value:
    """Build a vector with a number in all lanes."""
    start = ir.Constant(VECTOR, ir.Undefined)
    one = builder.insert_element(start, number, ir.Constant(_INDEX, 0))
    every = ir.Constant(ir.VectorType(_INDEX, WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(one, start, every)


@lower_cast(types.Float, _Lanes)
@lower_cast(types.Integer, _Lanes)
def _spread_number(context: Any, builder: Any, kind: Any, _to: Any, value: Any) -> ir.Value:
    return fill_vector(builder, context.cast(builder, value, kind, types.float64))


def _vector_operands(context: Any, builder: Any, sig: Any, arguments: Any) -> list[ir.Value]:
    """Arguments as vectors; a number is copied to all lanes."""
    return [
        value
        if isinstance(kind, _Lanes)
        else fill_vector(builder, context.cast(builder, value, kind, types.float64))
        for kind, value in zip(sig.args, arguments, strict=True)
    ]


def _register_lane_functions(functions: tuple[Any, ...], arity: int, generate: Any) -> None:
    """Let functions or operators take lanes, also mixed with numbers."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, _kws: Any) -> Any:
            return signature(lanes, *args) if len(args) == arity and lanes in args else None

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> ir.Value:
        return generate(builder, *_vector_operands(context, builder, sig, arguments))

    kinds = (
        [(_Lanes,)]
        if arity == 1
        else [(_Lanes, _Lanes), (_Lanes, types.Number), (types.Number, _Lanes)]
    )
    for function in functions:
        infer_global(function)(type(f"_{function.__name__}", (Template,), {"key": function}))
        for kind in kinds:
            lower_builtin(function, *kind)(lower)


def build_arithmetic(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, name: str) -> ir.Value:
    """Build one of LLVM's instructions on vectors: fadd, fsub, fmul."""
    return getattr(builder, name)(a, b, flags=_FAST)


def build_absolute(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    """Build abs(x)."""
    return builder.call(_llvm_intrinsic(builder, "fabs", 1), [x])


def build_maximum(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    """Build max(a, b)."""
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def build_minimum(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    """Build min(a, b)."""
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _build_multiply_add(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
    return builder.call(_llvm_intrinsic(builder, "fma", 3), [a, b, c])


def _build_machine_estimate(builder: ir.IRBuilder, name: str, x: ir.Value) -> ir.Value:
    mask = ir.IntType(WIDTH)
    kind = ir.FunctionType(VECTOR, [VECTOR, VECTOR, mask])
    symbol = f"llvm.x86.avx512.{name}14.pd.512"
    function = cgutils.get_or_insert_function(builder.module, kind, symbol)
    return builder.call(function, [x, lane_constant(0.0), ir.Constant(mask, (1 << WIDTH) - 1)])


def lane_constant(value: float) -> ir.Constant:
    """Return a constant in all lanes."""
    return ir.Constant(VECTOR, [value] * WIDTH)


def build_inverse(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    """Build 1/x, exact to the last bit but one; NaN for zero, if the machine estimates quotients.

    Eight quotients take a wide machine as long as sixteen products. Its estimate y of 1/x, corrected
    by e + e^2 + e^3 with the error e = 1 - x y, takes a third of that.
    """
    if not _ESTIMATES:
        return builder.fdiv(lane_constant(1.0), x, flags=_FAST)
    y = _build_machine_estimate(builder, "rcp", x)
    e = _build_multiply_add(builder, builder.fneg(x), y, lane_constant(1.0))
    power = _build_multiply_add(builder, e, e, e)
    return _build_multiply_add(builder, y, _build_multiply_add(builder, power, e, e), y)


@intrinsic
def rough_inverse(_context, x):
    """Return lanes of 1/x to four digits; exact if the machine has no estimate of quotients."""

    def generate(_context: Any, builder: Any, _sig: Any, args: Any) -> ir.Value:
        if _ESTIMATES:
            return _build_machine_estimate(builder, "rcp", args[0])
        return build_inverse(builder, args[0])

    return lanes(x), generate


def build_inverse_root(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    """Build 1/sqrt(x), exact to the last bit but one; NaN for zero, if the machine estimates roots.

    From an estimate y, with e = 1 - x y^2: y (1 + e/2 + 3 e^2/8 + 5 e^3/16).
    """
    if not _ESTIMATES:
        root = builder.call(_llvm_intrinsic(builder, "sqrt", 1), [x])
        return builder.fdiv(lane_constant(1.0), root, flags=_FAST)
    y = _build_machine_estimate(builder, "rsqrt", x)
    e = _build_multiply_add(builder, builder.fneg(builder.fmul(x, y)), y, lane_constant(1.0))
    series = _build_multiply_add(builder, lane_constant(0.3125), e, lane_constant(0.375))
    series = _build_multiply_add(builder, series, e, lane_constant(0.5))
    return _build_multiply_add(builder, builder.fmul(y, e), series, y)


def build_root(builder: ir.IRBuilder, x: ir.Value, inverse_of_it: ir.Value) -> ir.Value:
    """Build sqrt(x) from 1/sqrt(x)."""
    zero = builder.fcmp_ordered("==", x, lane_constant(0.0))
    return builder.select(zero, x, builder.fmul(x, inverse_of_it))


def _llvm_intrinsic(builder: ir.IRBuilder, name: str, arity: int) -> ir.Function:
    kind = ir.FunctionType(VECTOR, [VECTOR] * arity)
    return cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{WIDTH}f64")


#: Builder of each operation.
BUILD: dict[str, Any] = {
    "add": partial(build_arithmetic, name="fadd"),
    "sub": partial(build_arithmetic, name="fsub"),
    "mul": partial(build_arithmetic, name="fmul"),
    "neg": ir.IRBuilder.fneg,
    "inverse": build_inverse,
    "inverse_root": build_inverse_root,
    "root": build_root,
    "abs": build_absolute,
    "max": build_maximum,
    "min": build_minimum,
    "where_positive": lambda builder, x, a, b: builder.select(
        builder.fcmp_ordered(">", x, lane_constant(0.0)), a, b
    ),
}
_register_lane_functions((operator.add, operator.iadd), 2, BUILD["add"])
_register_lane_functions((operator.sub, operator.isub), 2, BUILD["sub"])
_register_lane_functions((operator.mul, operator.imul), 2, BUILD["mul"])
_register_lane_functions((abs,), 1, BUILD["abs"])
_register_lane_functions((max,), 2, BUILD["max"])


@intrinsic
def fill_lanes(_context, x):
    """Return lanes that all hold the number x."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return fill_vector(builder, context.cast(builder, args[0], sig.args[0], types.float64))

    return lanes(x), generate


@intrinsic
def scatter_lanes(_context, x, addresses, offset):
    """Store each lane of x at one of eight addresses (8,), plus an offset in numbers."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        places = context.make_array(sig.args[1])(context, builder, args[1]).data
        pointer = ir.DoubleType().as_pointer()
        for lane in range(WIDTH):
            place = builder.load(builder.gep(places, [ir.Constant(_INDEX, lane)]))
            place = builder.gep(builder.inttoptr(place, pointer), [args[2]])
            builder.store(builder.extract_element(args[0], ir.Constant(_INDEX, lane)), place)
        return context.get_dummy_value()

    return types.void(lanes, addresses, types.int64), generate


@intrinsic
def as_lanes(_context, array):
    """View float64 (..., n), n a multiple of 8, as lanes (..., n / 8); lanes are returned unchanged."""
    if array.dtype == lanes:
        same = lambda context, builder, sig, args: impl_ret_borrowed(  # noqa: E731
            context, builder, sig.return_type, args[0]
        )
        return array(array), same
    kind = types.Array(lanes, array.ndim, "C", aligned=False)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        source = context.make_array(sig.args[0])(context, builder, args[0])
        view = context.make_array(kind)(context, builder)
        width = context.get_constant(types.intp, WIDTH)
        shape = cgutils.unpack_tuple(builder, source.shape)
        strides = cgutils.unpack_tuple(builder, source.strides)
        shape[-1] = builder.udiv(shape[-1], width)
        view.itemsize = strides[-1] = builder.mul(source.itemsize, width)
        view.nitems = builder.udiv(source.nitems, width)
        view.data = builder.bitcast(source.data, view.data.type)
        view.shape = cgutils.pack_array(builder, shape)
        view.strides = cgutils.pack_array(builder, strides)
        view.meminfo, view.parent = source.meminfo, source.parent
        return impl_ret_borrowed(context, builder, sig.return_type, view._getvalue())

    return kind(array), generate


@intrinsic
def sum_lanes_or_worst_flight(_context, x, states):
    """Sum over the lanes of x if ``states`` belong to one flight; otherwise the value of the worst flight, or NaN."""

    def generate(_context: Any, builder: Any, _sig: Any, args: Any) -> ir.Value:
        def combine_halves(x: ir.Value, combine: Any) -> ir.Value:
            width = WIDTH
            while width > 1:
                width //= 2
                sides = [
                    ir.Constant(ir.VectorType(_INDEX, width), [*range(k, k + width)])
                    for k in (0, width)
                ]
                x = combine(*(builder.shuffle_vector(x, x, side) for side in sides))
            return builder.extract_element(x, ir.Constant(_INDEX, 0))

        total = combine_halves(args[0], builder.fadd)
        if states.dtype != lanes:
            return total
        most = combine_halves(args[0], partial(build_maximum, builder))
        return builder.select(builder.fcmp_ordered("ord", total, total), most, total)

    return types.float64(x, states), generate
