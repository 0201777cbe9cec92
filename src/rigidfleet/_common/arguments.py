"""Arguments of public functions: what was given becomes what is asked for, or one sentence says what is."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.errors import wrong_type
from rigidfleet.typing import Floats


def as_path(value: object) -> Path:
    """A path as a function takes it.

    Raises
    ------
    TypeError
        It is neither text nor a `Path`. A number would be an open file, which nobody means.
    """
    if isinstance(value, str | os.PathLike) and isinstance(path := os.fspath(value), str):
        return Path(path)
    raise wrong_type("a path (a string or a Path)", value)


def as_numbers(name: str, values: ArrayLike) -> Floats:
    """An array of numbers as a function takes it; ``name`` says of what.

    Raises
    ------
    TypeError
        It is none.
    """
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise wrong_type(f"an array of numbers for {name}", values) from None
