"""Functions of numbers that a lower layer also runs on arrays, made known to the compiler from the same source."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from numba.extending import overload

from rigidfleet.kernel.compiler.jit import OPTIONS
from rigidfleet.solids import distance


def _register_for_jit(function: Callable[..., Any]) -> None:
    """Let compiled functions call a function of Python."""
    overload(function, jit_options=OPTIONS, strict=False)(lambda *_: function)


def _floor(x):
    return math.floor(x)


# Numba takes the implementation that the second function returns for the arguments' types.
overload(distance.where, jit_options=OPTIONS)(
    lambda test, this, other: lambda test, this, other: this if test else other
)
overload(distance.any_true, jit_options=OPTIONS)(lambda test: lambda test: test)
overload(distance.pick, jit_options=OPTIONS)(lambda test, values: lambda test, values: values)
overload(distance.put, jit_options=OPTIONS)(
    lambda test, values, picked: lambda test, values, picked: picked
)
overload(distance.floor, jit_options=OPTIONS)(lambda x: _floor)

for _function in distance.ELEMENTWISE:
    _register_for_jit(_function)
