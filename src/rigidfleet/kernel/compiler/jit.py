"""How the kernel is compiled: the same options everywhere, and a cache that notices every change.

Numba's own cache does not notice a change in a callee that lives in another file, so the cache
folder is keyed here by a digest of all sources of the kernel.
"""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar

import numba
from numba import types
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    NullCache,
    UserProvidedCacheLocator,
)
from numba.core.ccallback import CFunc

from rigidfleet._common.files import replace_atomically
from rigidfleet.kernel.compiler.cache import cache_directory, open_for_reading, warn_not_cached
from rigidfleet.kernel.compiler.levels import (
    KEY,
    runnable_instruction_level,
    target_instruction_level,
)

F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",  # division by zero gives infinity
    # Sums may be reordered and fused, but NaN and infinity keep their meaning: the integrator must
    # see them to reject a step.
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
    # Without reference counts, which would cost more than the physics: the caller keeps the arrays
    # alive. The compiler then refuses any function that would allocate.
    "_nrt": False,
}
#: Whether Numba only translates (see `rigidfleet.kernel.engine.native`); code is then neither cached nor inlined.
_OPTIMISES = numba.config.OPT > 0
_CACHED = OPTIONS | {"no_cfunc_wrapper": True}
if os.environ.get(KEY):  # whatever Numba compiles in this process is then of this level, too
    numba.config.CPU_NAME = (
        runnable_instruction_level() if _OPTIMISES else target_instruction_level()
    )
    numba.config.CPU_FEATURES = ""


def jit(function: F) -> F:
    """Compile for the flight: cached on disk, without the GIL, without allocation."""
    return _compile_with_cache(function, _CACHED)


def jit_inline(function: F) -> F:
    """Compile into each caller, for functions that every evaluation of a flight calls, and for those that sum.

    Where it is not inlined, the linker takes the copy that was loaded first, and copies sum in different orders.
    """
    return _compile_with_cache(function, _CACHED | {"forceinline": _OPTIMISES})


def jit_exact(function: F) -> F:
    """Compile with sums as they are written, neither reordered nor fused: the same bits as NumPy's."""
    return _compile_with_cache(function, _CACHED | {"fastmath": False})


def compiled_copy(function: Any, name: str, **instead: Any) -> Any:
    """Compile the source of a compiled function again, with other functions in place of some that it calls."""
    return _compile_with_cache(_copy_function(function.py_func, name, instead), _CACHED)


def compiled_for_c(function: Any, name: str, *, arguments: int, **instead: Any) -> int:
    """Compile a copy of a function with this number of arguments, pointers to float64; return its address.

    The code and the copy stay alive as long as the process.
    """
    signature = types.void(*[types.CPointer(types.float64)] * arguments)
    copy = _copy_function(function, name, instead)
    made = CFunc(copy, (signature.args, signature.return_type), {}, {"nopython": True})
    made._cache = _cache_of(copy)
    made.compile()
    _STAYING.append(made)
    return made.address


_STAYING: list[Any] = []


def _copy_function(function: FunctionType, name: str, instead: dict[str, Any]) -> FunctionType:
    if unknown := instead.keys() - {*function.__code__.co_names}:
        raise TypeError(f"{function.__qualname__} uses no {', '.join(sorted(unknown))}")
    copy = FunctionType(function.__code__, function.__globals__ | instead, name)
    copy.__module__, copy.__qualname__ = function.__module__, name
    return copy


class _CacheFolder(UserProvidedCacheLocator):
    """The cache folder of a function: that of the kernel."""

    def __init__(self, function: FunctionType) -> None:
        code = function.__code__
        self._py_file, self._lineno = code.co_filename, code.co_firstlineno
        self._cache_path = str(cache_directory())

    def ensure_cache_path(self) -> None:
        cache_directory()


class _Form(CompileResultCacheImpl):
    """The form in which a function is cached. Numba itself would consult the environment and the current folder."""

    def __init__(self, function: FunctionType) -> None:
        self._lineno = function.__code__.co_firstlineno
        self._locator = _CacheFolder(function)
        name = f"{Path(function.__code__.co_filename).stem}.{function.__qualname__}"
        self._filename_base = self.get_filename_base(name, getattr(sys, "abiflags", ""))


class _Files(IndexDataCacheFile):
    """Numba's files, which are pickles; files that others could have written count as missing.

    Nobody else can replace a file between this check and Numba's own access, see `cache_directory`.
    """

    def _load_index(self) -> Any:
        try:
            with open_for_reading(self._index_path):
                return super()._load_index()
        except OSError:
            return {}

    def _load_data(self, name: str) -> Any:
        with open_for_reading(self._data_path(name)):
            return super()._load_data(name)

    def _open_for_write(self, filepath: str) -> Any:
        return replace_atomically(filepath, private=True)


class _Cache(FunctionCache):
    """Numba's cache of a function, on a disk that may be full: code that cannot be stored is compiled again."""

    _impl_class = _Form

    def __init__(self, function: FunctionType) -> None:
        super().__init__(function)
        base, stamp = self._impl.filename_base, self._impl.locator.get_source_stamp()
        self._cache_file = _Files(self._cache_path, base, stamp)

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            warn_not_cached(error)


class _NoCache(NullCache):
    """No cache, with the reason."""

    def __init__(self, error: OSError) -> None:
        self._error = error

    def save_overload(self, *_: Any) -> None:
        warn_not_cached(self._error)


def _cache_of(function: Any) -> _Cache | _NoCache:
    try:
        return _Cache(function)
    except OSError as error:
        return _NoCache(error)


def _compile_with_cache(function: F, options: dict[str, Any]) -> F:
    dispatcher = numba.njit(**options)(function)
    if _OPTIMISES:
        dispatcher._cache = _cache_of(function)
    return dispatcher
