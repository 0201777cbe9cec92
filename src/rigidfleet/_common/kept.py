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


def kept(function: Callable[..., R]) -> Callable[..., R]:
    """Keep the results of a function that depends on its arguments alone: arrays, and what can be hashed.

    Arrays count by their contents and their layout in memory, on which the last bits of products depend: a result is
    the same whether it was kept or not. Arrays in results are read-only. Arguments are given without their names.
    Results for large arrays are not kept.
    """
    results: dict[Any, R] = {}
    lock = threading.Lock()

    @wraps(function)
    def wrapper(*args: Any) -> R:
        if any(isinstance(x, np.ndarray) and x.nbytes > _LARGEST for x in args):
            return function(*args)
        key = tuple([_contents(x) for x in args])
        with lock:
            if key in results:
                return results[key]
        result = function(*args)
        for x in result if isinstance(result, tuple) else (result,):
            if isinstance(x, np.ndarray):
                x.flags.writeable = False
        with lock:
            if len(results) >= _MANY:
                del results[next(iter(results))]
            results[key] = result
        return result

    return wrapper


def _contents(x: Any) -> Any:
    if isinstance(x, np.ndarray):
        return x.shape, x.strides, x.dtype.char, x.tobytes()
    return x.hex() if isinstance(x, float) else x  # 0.0 == -0.0


def same(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> bool:
    """Whether two small arrays of one kind have the same numbers."""
    return a is b or (a.shape == b.shape and a.tobytes() == b.tobytes())
