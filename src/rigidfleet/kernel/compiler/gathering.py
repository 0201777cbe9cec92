"""Addresses and shapes of many NumPy arrays in one call; in Python, each array takes a microsecond."""

from numba import types
from numba.extending import intrinsic

from rigidfleet.kernel.compiler.jit import jit

#: Offsets in bytes of an array's data, number of dimensions, shape, type of numbers and flags: `PyArrayObject_fields`
#: of NumPy's C interface, after the two words of every Python object. The second and the last have 32 bits.
_DATA, _DIMENSIONS, _SHAPE, _NUMBERS, _FLAGS = 16, 24, 32, 56, 64
_HALF, _CONTIGUOUS = 0xFFFFFFFF, 1


@intrinsic
def load(_context, address):
    """The word at an address."""
    from llvmlite import ir

    def generate(_context, builder, _signature, arguments):
        return builder.load(builder.inttoptr(arguments[0], ir.IntType(64).as_pointer()))

    return types.int64(types.int64), generate


@intrinsic
def store(_context, address, word):
    """Store a word at an address."""
    from llvmlite import ir

    def generate(context, builder, _signature, arguments):
        builder.store(arguments[1], builder.inttoptr(arguments[0], ir.IntType(64).as_pointer()))
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


@jit
def gather(objects, count, expected, words):
    """Write the data addresses and shapes of ``count`` arrays to ``words``; return how many are not as asked.

    All arguments are addresses: of the arrays' own addresses, and of three words for each: its first word in ``words``,
    its number of dimensions, and the address of its type of numbers.
    """
    wrong = 0
    for k in range(count):
        x = load(objects + 8 * k)
        first = load(expected + 24 * k)
        dimensions = load(expected + 24 * k + 8)
        if (
            (load(x + _DIMENSIONS) & _HALF) != dimensions
            or load(x + _NUMBERS) != load(expected + 24 * k + 16)
            or (load(x + _FLAGS) & _CONTIGUOUS) == 0
        ):
            wrong += 1
            continue
        store(words + 8 * first, load(x + _DATA))
        shape = load(x + _SHAPE)
        for n in range(dimensions):
            store(words + 8 * (first + 1 + n), load(shape + 8 * n))
    return wrong
