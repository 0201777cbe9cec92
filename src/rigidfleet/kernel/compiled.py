"""How the kernel is compiled: the same options everywhere, and a cache that notices every change.

Numba's own cache does not notice a change in a callee that lives in another file, so the cache
folder is keyed here by a digest of all sources of the kernel.
"""

import hashlib
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar

import numba
from numba import types
from numba.core.caching import FunctionCache
from numba.extending import intrinsic

F = TypeVar("F", bound=Callable[..., Any])

_OPTIONS: dict[str, Any] = {
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
    return _cached(function, _OPTIONS)


def inlined(function: F) -> F:
    """Compile into each caller: for functions of a whole `Program` or `Workspace`.

    A call would copy every field of theirs, some 300 numbers, to the stack.
    """
    return _cached(function, _OPTIONS | {"forceinline": True})


def compiled_copy(function: Any, name: str, **instead: Any) -> Any:
    """Compile a compiled function's source once more, with other functions in place of some it calls."""
    return _cached(_copy(function.py_func, name, instead), _OPTIONS)


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
            _not_kept(error.strerror)
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


def cache_directory() -> Path:
    """Return the folder of the compiled kernel: one per state of its sources, Numba and Python.

    The base is ``NUMBA_CACHE_DIR`` if set, else ``XDG_CACHE_HOME`` or ``~/.cache``; a folder that
    cannot be written falls back to the system's temporary folder.
    """
    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    for root in (Path(base).expanduser(), Path(tempfile.gettempdir())):
        folder = root / "rigidfleet" / f"kernel-{digest.hexdigest()[:16]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return folder


def is_compiled() -> bool:
    """Return whether the flight kernel is in the cache, so that nothing has to be compiled."""
    return any(_CACHE.rglob("flight.integrate-*.nbc"))


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
            _not_kept(error.strerror)


@cache
def _not_kept(why: str) -> None:
    """Warn once, not for each function; Numba makes Python forget what it has warned of."""
    warnings.warn(
        f"the compiled flight kernel cannot be kept in {_CACHE}: {why}. It will be compiled again by"
        " the next process",
        RuntimeWarning,
        stacklevel=3,
    )


def _cached(function: F, options: dict[str, Any]) -> F:
    with _own_cache():
        dispatcher = numba.njit(**options)(function)
        dispatcher._cache = _Cache(function)
    return dispatcher
