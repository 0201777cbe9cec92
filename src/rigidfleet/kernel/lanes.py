"""Eight numbers in one: a vector of doubles as a Numba value, so that one source serves two ends.

A `lanes` value holds eight doubles; arithmetic, `math` functions, ``min``, ``max`` and ``abs`` act
on each of them, and a comparison is true where it holds in *all*. A `LaneArray` is an array whose
elements are such values. The kernel's functions compile for them as they stand: eight flights in the
lanes share their steps and their branches. For a single flight, `blocks` looks at eight consecutive
states as one value, which is how the integrator's sums use the machine's vector registers.
"""

import math
import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import (
    NativeValue,
    intrinsic,
    lower_builtin,
    lower_cast,
    models,
    overload,
    register_model,
    typeof_impl,
    unbox,
)
from numpy.typing import NDArray

#: Lanes of a value.
WIDTH = 8
# Products and sums may be fused, but not reordered: what a lane gets never depends on the compiler.
_FAST = ("contract", "arcp", "nsz")
_VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
_INDEX = ir.IntType(32)


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
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


class LaneArray(np.ndarray):
    """An array of `lanes`; of no dimension, one value. Made by `pack`, read by `unpack`."""


def pack(values: NDArray[np.float64]) -> LaneArray:
    """Array (...) of lanes from float64 (..., 8), a copy that is aligned as vectors like it."""
    values = np.asarray(values, dtype=np.float64)
    room = np.empty(values.size + WIDTH)
    skip = -room.ctypes.data // room.itemsize % WIDTH
    flat = room[skip : skip + values.size]
    flat[:] = values.ravel()
    kind = np.dtype((np.void, WIDTH * flat.itemsize))
    return flat.view(kind).reshape(values.shape[:-1]).view(LaneArray)


def unpack(array: NDArray[Any]) -> NDArray[np.float64]:
    """View an array (...) of lanes as float64 (..., 8)."""
    plain = array.view(np.ndarray)
    return plain.reshape(plain.shape + (1,)).view(np.float64)


@typeof_impl.register(LaneArray)
def _typeof(value: LaneArray, _context: Any) -> types.Type:
    if value.ndim == 0:
        return lanes
    # Alignment is not promised, as NumPy promises none; vectors in `pack`'s arrays have it.
    return types.Array(lanes, value.ndim, "C", aligned=False)


@unbox(_Lanes)
def _unbox(_type: Any, value: Any, context: Any) -> NativeValue:
    native = context.unbox(types.Array(lanes, 0, "C", aligned=False), value)
    builder = context.builder
    kind = types.Array(lanes, 0, "C", aligned=False)
    array = context.context.make_array(kind)(context.context, builder, native.value)
    return NativeValue(builder.load(array.data, align=8), is_error=native.is_error)


def _spread(builder: ir.IRBuilder, number: ir.Value) -> ir.Value:
    start = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(start, number, ir.Constant(_INDEX, 0))
    every = ir.Constant(ir.VectorType(_INDEX, WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(one, start, every)


@lower_cast(types.Float, _Lanes)
@lower_cast(types.Integer, _Lanes)
def _cast(context: Any, builder: Any, kind: Any, _to: Any, value: Any) -> ir.Value:
    return _spread(builder, context.cast(builder, value, kind, types.float64))


def _operands(context: Any, builder: Any, sig: Any, arguments: Any) -> list[ir.Value]:
    """Arguments as vectors: a number is spread over the lanes."""
    return [
        value
        if isinstance(kind, _Lanes)
        else _spread(builder, context.cast(builder, value, kind, types.float64))
        for kind, value in zip(sig.args, arguments, strict=True)
    ]


def _register(functions: tuple[Any, ...], arity: int, result: types.Type, generate: Any) -> None:
    """Let functions or operators take lanes, with numbers among them, and give ``result``."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, _kws: Any) -> Any:
            return signature(result, *args) if len(args) == arity and lanes in args else None

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> ir.Value:
        return generate(builder, *_operands(context, builder, sig, arguments))

    kinds = (
        [(_Lanes,)]
        if arity == 1
        else [(_Lanes, _Lanes), (_Lanes, types.Number), (types.Number, _Lanes)]
    )
    for function in functions:
        infer_global(function)(type(f"_{function.__name__}", (Template,), {"key": function}))
        for kind in kinds:
            lower_builtin(function, *kind)(lower)


def _arithmetic(name: str) -> Any:
    return lambda builder, a, b: getattr(builder, name)(a, b, flags=_FAST)


def _in_all(sign: str) -> Any:
    def generate(builder: Any, a: Any, b: Any) -> ir.Value:
        bits = builder.bitcast(builder.fcmp_ordered(sign, a, b), ir.IntType(WIDTH))
        return builder.icmp_unsigned("==", bits, ir.Constant(bits.type, (1 << WIDTH) - 1))

    return generate


def _each(name: str) -> Any:
    """Return what calls one of LLVM's functions lane by lane."""

    def generate(builder: Any, x: Any) -> ir.Value:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        symbol = f"llvm.{name}.v{WIDTH}f64"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, symbol), [x])

    return generate


def _library(name: str) -> Any:
    """Return what calls a function of the C library on one lane after the other."""

    def generate(builder: Any, *vectors: Any) -> ir.Value:
        kind = ir.FunctionType(ir.DoubleType(), [ir.DoubleType()] * len(vectors))
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        result = ir.Constant(_VECTOR, ir.Undefined)
        for k in range(WIDTH):
            lane = ir.Constant(_INDEX, k)
            value = builder.call(function, [builder.extract_element(v, lane) for v in vectors])
            result = builder.insert_element(result, value, lane)
        return result

    return generate


def _larger(sign: str) -> Any:
    return lambda builder, a, b: builder.select(builder.fcmp_ordered(sign, a, b), a, b)


for _operators, _name in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
    ((operator.truediv, operator.itruediv), "fdiv"),
):
    _register(_operators, 2, lanes, _arithmetic(_name))
for _operator, _sign in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _register((_operator,), 2, types.boolean, _in_all(_sign))
for _function, _name in ((math.sqrt, "sqrt"), (math.sin, "sin"), (math.cos, "cos"), (abs, "fabs")):
    _register((_function,), 1, lanes, _each(_name))
_register((operator.neg,), 1, lanes, lambda builder, x: builder.fneg(x))
_register((math.atan2,), 2, lanes, _library("atan2"))
_register((max,), 2, lanes, _larger(">"))
_register((min,), 2, lanes, _larger("<"))


@intrinsic
def _select(_context, x, a, b):
    def generate(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        x, a, b = _operands(context, builder, sig, args)
        return builder.select(
            builder.fcmp_ordered(">", x, ir.Constant(_VECTOR, [0.0] * WIDTH)), a, b
        )

    return lanes(x, a, b), generate


def where_positive(x, a, b):
    """Return a where x > 0, else b; lane by lane."""
    raise NotImplementedError("compiled code only")


@overload(where_positive)
def _where_positive(x, a, b):
    if lanes in (x, a, b):
        return lambda x, a, b: _select(x, a, b)  # noqa: PLW0108
    return lambda x, a, b: a if x > 0.0 else b


@intrinsic
def spread(_context, x):
    """Return lanes that all hold the number x."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> ir.Value:
        return _spread(builder, context.cast(builder, args[0], sig.args[0], types.float64))

    return lanes(x), generate


@intrinsic
def blocks(_context, array):
    """Look at float64 (..., n), n a multiple of 8, as lanes (..., n / 8); at lanes as they are."""
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
def _fold(_context, x, largest):
    """Sum over the lanes, or the largest of them if any; NaN where any lane is NaN."""

    def generate(_context: Any, builder: Any, _sig: Any, args: Any) -> ir.Value:
        lane = [builder.extract_element(args[0], ir.Constant(_INDEX, k)) for k in range(WIDTH)]
        total = most = lane[0]
        for value in lane[1:]:
            total = builder.fadd(total, value)
            most = builder.select(builder.fcmp_ordered(">", value, most), value, most)
        number = builder.fcmp_ordered("ord", total, total)
        most = builder.select(number, most, total)
        return builder.select(args[1], most, total)

    return types.float64(x, types.boolean), generate


def total_or_worst(x, states):
    """Sum over the lanes of x where ``states`` are one flight's, else its worst flight's value."""
    raise NotImplementedError("compiled code only")


@overload(total_or_worst)
def _overload_total_or_worst(x, states):
    if states.dtype == lanes:
        return lambda x, states: _fold(x, True)
    return lambda x, states: _fold(x, False)


def padded(count: int) -> int:
    """``count`` rounded up to a whole number of values."""
    return -(-count // WIDTH) * WIDTH
