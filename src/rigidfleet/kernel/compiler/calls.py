"""Calls by address from compiled code: a user's force, the solver of a large formation, the recorder."""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


@intrinsic
def call_external(_context, address, t, r, v, f):
    """Call the C function at ``address``: void(double t, double *r, *v, *f, ssize_t n)."""

    def generate(context, builder, signature, arguments):
        pointer, double, size = ir.IntType(8).as_pointer(), ir.DoubleType(), ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [double, pointer, pointer, pointer, size])
        function = builder.inttoptr(arguments[0], kind.as_pointer())
        arrays = [
            context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (2, 3, 4)
        ]
        data = [builder.bitcast(a.data, pointer) for a in arrays]
        count = builder.extract_value(arrays[0].shape, 0)
        builder.call(function, [arguments[1], *data, count])
        return context.get_dummy_value()

    return types.void(types.int64, types.float64, r, v, f), generate


@intrinsic
def call_solver(_context, address):
    """Call the C function at ``address``: void()."""

    def generate(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.VoidType(), [])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), [])
        return context.get_dummy_value()

    return types.void(types.int64), generate


@intrinsic
def call_recorder(_context, address, p, w, segment, record):
    """Call `native`'s recorder at ``address``: int64(problem, workspace, segment, record), all of them addresses.

    Avoidance in flight is called in the same way: int64(flight, state, avoidance, 0).
    """

    def generate_recorder_call(context, builder, signature, arguments):
        word = ir.IntType(64)
        kind = ir.FunctionType(word, [word] * 4)
        function, p, w, *rest = arguments
        words = [builder.ptrtoint(x, word) for x in (p, w)]
        return builder.call(builder.inttoptr(function, kind.as_pointer()), [*words, *rest])

    return types.int64(types.int64, p, w, types.int64, types.int64), generate_recorder_call
