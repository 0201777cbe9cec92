"""How the kernel is compiled: the same options everywhere, and a cache that notices every change.

Numba's own cache does not notice a change in a callee that lives in another file, so the cache
folder is keyed here by a digest of all sources of the kernel.
"""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FunctionType
from typing import Any, TypeVar

import numba
from numba import types
from numba.core.caching import FunctionCache
from numba.extending import intrinsic

from rigidfleet.kernel.native import cache_directory, not_kept

F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",  # division by zero gives infinity
    # Sums may be reordered and fused, but NaN and infinity keep their meaning: the integrator has
    # to see them to reject a step.
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
    # Without reference counts, which cost more than the physics: whoever calls keeps the arrays
    # alive. The compiler then refuses any function that would allocate.
    "_nrt": False,
}
#: Where Numba is to optimise nothing (see `rigidfleet.kernel.native`), code is neither kept nor inlined yet.
_OPTIMISES = numba.config.OPT > 0
_CACHED = OPTIONS | {"cache": _OPTIMISES, "no_cfunc_wrapper": True}


def compiled(function: F) -> F:
    """Compile for the flight: cached on disk, without the GIL, without allocation."""
    return _cached(function, _CACHED)


def inlined(function: F) -> F:
    """Compile into each caller: for what every evaluation of a flight goes through."""
    return _cached(function, _CACHED | {"forceinline": _OPTIMISES})


def compiled_copy(function: Any, name: str, **instead: Any) -> Any:
    """Compile a compiled function's source once more, with other functions in place of some it calls."""
    return _cached(_copy(function.py_func, name, instead), _CACHED)


def compiled_for_c(function: Any, name: str, *, arguments: int, **instead: Any) -> int:
    """Compile a copy of a function of so many pointers to float64; return its address.

    Both it and the copy stay as long as the process does.
    """
    signature = types.void(*[types.CPointer(types.float64)] * arguments)
    copy = _copy(function, name, instead)
    with _own_cache():
        try:
            made = numba.cfunc(signature, cache=True, nopython=True)(copy)
        except OSError as error:
            not_kept(error.strerror)
            made = numba.cfunc(signature, nopython=True)(copy)
    _STAYING.append(made)
    return made.address


_STAYING: list[Any] = []


def _copy(function: FunctionType, name: str, instead: dict[str, Any]) -> FunctionType:
    copy = FunctionType(function.__code__, function.__globals__ | instead, name)
    copy.__module__, copy.__qualname__ = function.__module__, name
    return copy


@intrinsic
def call_solver(_context, address):
    """Call the C function at ``address``: void()."""
    from llvmlite import ir

    def generate(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.VoidType(), [])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), [])
        return context.get_dummy_value()

    return types.void(types.int64), generate


@intrinsic
def call_recorder(_context, address, p, w, stretch, record):
    """Call `native`'s recorder at ``address``: int64(program, workspace, stretch, record), all of them addresses."""
    from llvmlite import ir

    def generate(context, builder, signature, arguments):
        word = ir.IntType(64)
        kind = ir.FunctionType(word, [word] * 4)
        function, p, w, *rest = arguments
        words = [builder.ptrtoint(x, word) for x in (p, w)]
        return builder.call(builder.inttoptr(function, kind.as_pointer()), [*words, *rest])

    return types.int64(types.int64, p, w, types.int64, types.int64), generate


_CACHE = cache_directory()


@contextmanager
def _own_cache() -> Generator[None]:
    """Let Numba use the kernel's folder; its other users keep theirs."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(_CACHE)
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


class _Cache(FunctionCache):
    """Numba's cache of a function, on a disk that may be full: what cannot be kept is compiled again."""

    def save_overload(self, sig, data):
        try:
            super().save_overload(sig, data)
        except OSError as error:
            not_kept(error.strerror)


def _cached(function: F, options: dict[str, Any]) -> F:
    with _own_cache():
        dispatcher = numba.njit(**options)(function)
        if options["cache"]:
            dispatcher._cache = _Cache(function)
    return dispatcher
