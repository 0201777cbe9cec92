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
    the same whether it was kept or not. Arrays in results are read-only, and must not be arguments themselves.
    Arguments are given without their names. Results for large arrays are not kept.
    """
    found: dict[Any, R] = {}
    lock = threading.Lock()

    @wraps(function)
    def wrapper(*args: Any) -> R:
        try:
            key = tuple([_key(x) for x in args])
            return found[key]
        except KeyError:
            result = function(*args)
        except _TooLargeError:
            return function(*args)
        _freeze(result)
        with lock:
            while len(found) >= _MANY:
                del found[next(iter(found))]
            found[key] = result
        return result

    return wrapper


def _key(x: Any) -> Any:
    if isinstance(x, float):
        return x or ("zero", str(x))  # 0.0 == -0.0
    if isinstance(x, np.ndarray):
        if x.nbytes > _LARGEST:
            raise _TooLargeError
        return x.shape, x.strides, x.dtype.char, x.tobytes()
    if isinstance(x, tuple):
        return tuple([_key(part) for part in x])
    return x


def _freeze(x: Any) -> None:
    if isinstance(x, np.ndarray):
        x.flags.writeable = False
    elif isinstance(x, tuple):
        for part in x:
            _freeze(part)
