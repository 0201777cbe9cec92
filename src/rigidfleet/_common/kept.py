"""Results of functions that are kept by the contents of the arguments, so that other flights take them over."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numpy as np

R = TypeVar("R")

#: Greatest number of results kept of a function, and greatest size of an array among the arguments [bytes].
_MANY, _LARGEST = 512, 4096


class _TooLargeError(Exception):
    """An argument is larger than what is kept."""


def kept(function: Callable[..., R]) -> Callable[..., R]:
    """Keep the results of a function that depends on its arguments alone: numbers, words, arrays, tuples of them.

    Arrays count by their contents and their layout in memory, on which the last bits of products depend: a result is
    the same whether it was kept or not. Other arguments, such as tables of a mission, must be immutable, and count by
    their identity. Arrays in results are read-only, and must not be arguments themselves. Arguments are given without
    their names. Results for large arrays are not kept.
    """
    results: dict[Any, tuple[R, Any]] = {}
    lock = threading.Lock()

    @wraps(function)
    def wrapper(*args: Any) -> R:
        try:
            key = tuple([_KEYS.get(type(x), _of_other)(x) for x in args])
            return results[key][0]
        except KeyError:
            result = function(*args)
        except _TooLargeError:
            return function(*args)
        _freeze(result)
        with lock:
            while len(results) >= _MANY:
                del results[next(iter(results))]
            results[key] = result, args  # alive, so that nothing else gets their identities
        return result

    return wrapper


def same(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> bool:
    """Whether two small arrays of one kind have the same numbers."""
    return a is b or (a.shape == b.shape and a.tobytes() == b.tobytes())


def _of_float(x: float) -> Any:
    return x or ("zero", str(x))  # 0.0 == -0.0


def _of_array(x: np.ndarray[Any, Any]) -> Any:
    if x.nbytes > _LARGEST:
        raise _TooLargeError
    return x.shape, x.strides, x.dtype.char, x.tobytes()


def _of_tuple(x: tuple[Any, ...]) -> Any:
    return tuple([_KEYS.get(type(part), _of_other)(part) for part in x])


def _of_other(x: Any) -> Any:
    if isinstance(x, tuple):
        return _of_tuple(x)
    return _of_float(x) if isinstance(x, float) else id(x)


def _itself(x: Any) -> Any:
    return x


#: What arguments of each type count by.
_KEYS: dict[type, Callable[[Any], Any]] = {
    float: _of_float,
    np.ndarray: _of_array,
    tuple: _of_tuple,
    **dict.fromkeys((int, bool, str, bytes, type(None)), _itself),
}


def _freeze(x: Any) -> None:
    if isinstance(x, np.ndarray):
        x.flags.writeable = False
    elif isinstance(x, tuple):
        for part in x:
            _freeze(part)
