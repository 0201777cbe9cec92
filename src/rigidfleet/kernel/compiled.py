"""How the kernel is compiled: one decorator, the same options everywhere."""

from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba import types
from numba.extending import intrinsic

F = TypeVar("F", bound=Callable[..., Any])

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",  # division by zero gives infinity
    # Sums may be reordered and fused, but NaN and infinity keep their meaning: the integrator has
    # to see them to reject a step.
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
    # Without reference counts, which cost more than the physics: whoever calls keeps the arrays
    # alive. The compiler then refuses any function that would allocate.
    "_nrt": False,
    "no_cfunc_wrapper": True,
}


def compiled(function: F) -> F:
    """Compile for the flight: cached on disk, without the GIL, without allocation."""
    return numba.njit(**_OPTIONS)(function)


def inlined(function: F) -> F:
    """Compile into each caller: for functions of a whole `Program` or `Workspace`.

    A call would copy every field of theirs, some 300 numbers, to the stack.
    """
    return numba.njit(forceinline=True, **_OPTIONS)(function)


@intrinsic
def call_solver(_context, address):
    """Call the C function at ``address``: void()."""
    from llvmlite import ir

    def generate(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.VoidType(), [])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), [])
        return context.get_dummy_value()

    return types.void(types.int64), generate
