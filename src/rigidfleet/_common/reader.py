"""Read netCDF-4 files that may be damaged or malicious.

The caller declares what the file must contain; this module knows nothing about flights. Type, shape and size of
each array are checked against the declaration before the array is read. Text is checked before it is used. Data in
other files are never read.
"""

from __future__ import annotations

import io
import json
import math
import re
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from inspect import signature
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import h5py

#: Maximum number of values in a file: 8 GB, twice what a mission may store.
MOST_NUMBERS = 1e9
#: A file of n bytes may declare at most _DENSE n + _SPARE bytes of arrays, so that a small file cannot fill memory.
_DENSE, _SPARE = 200, 1 << 20


class DamagedError(ValueError):
    """A file does not contain what it should. The message says what is wrong, without a full stop."""


@dataclass(frozen=True)
class Array:
    """Declaration of an array: its dimensions, whether its values are integers, and whether it may be missing."""

    dims: tuple[str, ...]
    whole: bool
    optional: bool


def read_attribute(file: h5py.File, name: str, kind: Any) -> Any:
    """Return an attribute as ``int`` or ``str``, or the JSON in it as any other type (`of_type`).

    Raises
    ------
    DamagedError
        The attribute is missing or has another type.
    """
    if name not in file.attrs:
        raise DamagedError(f"attribute {name} is missing")
    value = file.attrs[name]
    # Other tools write a scalar as an array of one element.
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if kind is int:
        if not isinstance(value, int | np.integer) or isinstance(value, bool):
            raise DamagedError(f"attribute {name} is not a whole number")
        return int(value)
    if isinstance(value, bytes):
        value = value.decode("utf-8", "surrogateescape")
    if not isinstance(value, str):
        raise DamagedError(f"attribute {name} is not text")
    if not _is_valid_unicode(value):
        raise DamagedError(f"attribute {name} is not UTF-8 text")
    if kind is str:
        return value
    try:
        plain = json.loads(value)
    except (ValueError, RecursionError) as error:
        raise DamagedError(f"attribute {name} is not valid JSON ({error})") from None
    return of_type(plain, kind, f"attribute {name}")


def of_type(value: Any, kind: Any, where: str) -> Any:
    """Check plain data against a type and return it.

    Types are dataclasses, typed dictionaries, lists, tuples, literals, text, integers and finite numbers. A dataclass
    is constructed; a tuple stays a list. Unknown keys and values of another type are errors, except that a typed
    dictionary with the key ``__others__`` admits any key. ``Annotated[A, B]`` is checked as B, or may be None.

    Raises
    ------
    DamagedError
        The data do not match. The message begins with ``where``.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin is Annotated:  # A is the type in Python, B the type in a file
        return None if value is None else of_type(value, inner[1], where)
    if origin in (Union, UnionType):  # every union here is `X | None`
        some = next(k for k in inner if k is not NoneType)
        return None if value is None else of_type(value, some, where)
    if origin is Literal and isinstance(value, str) and value in inner:
        return value
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        if abs(value) <= _HUGE:
            return float(value)
    elif kind in (str, int, bool) and type(value) is kind:
        if kind is not str or _is_valid_unicode(value):
            return value
    elif origin is list and isinstance(value, list):
        return [of_type(item, inner[0], f"{where}[{k + 1}]") for k, item in enumerate(value)]
    elif origin is tuple and isinstance(value, list) and len(value) == len(inner):
        return [of_type(item, k, where) for item, k in zip(value, inner, strict=True)]
    elif isinstance(value, dict):
        if origin is dict:
            return {key: of_type(item, inner[1], f"{where}.{key}") for key, item in value.items()}
        hints = get_type_hints(kind, include_extras=True)
        needed = getattr(kind, "__required_keys__", None)
        if needed is None:  # a dataclass
            parameters = signature(kind).parameters.values()
            needed = {x.name for x in parameters if x.default is x.empty}
        known = hints.keys() - {"__others__"}
        if needed <= value.keys() and ("__others__" in hints or value.keys() <= known):
            made = {
                key: of_type(item, hints.get(key, Any), f"{where}.{key}")
                for key, item in value.items()
            }
            return kind(**made)
    raise DamagedError(f"{where} has an invalid value: {reprlib.repr(value)[:60]}")


#: Maximum magnitude of a number.
_HUGE = 1e300


def _is_valid_unicode(value: str) -> bool:
    return re.search("[\ud800-\udfff]", value) is None  # a lone surrogate


def read_arrays(
    file: h5py.File, declared: Mapping[str, Array], sizes: Mapping[str, int], size: int
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name. Optional arrays may be missing.

    Parameters
    ----------
    declared : declaration of each array
    sizes : sizes of the dimensions that are already known
    size : size of the file [bytes]

    Raises
    ------
    DamagedError
        An array is missing, has another type or shape, or the arrays are larger than a file of this size can be.
    """
    import h5py

    datasets, known, numbers = {}, dict(sizes), 0
    for name, due in declared.items():
        if name not in file:
            if due.optional:
                continue
            raise DamagedError(f"{name} is missing")
        # Arrays are stored in this file: no link, no view of another file.
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise DamagedError(f"{name} is a link, not an array")
        data = file[name]
        if not isinstance(data, h5py.Dataset):
            raise DamagedError(f"{name} is not an array")
        if data.is_virtual or data.external:
            raise DamagedError(f"{name} is stored in another file")
        kind = data.dtype.kind
        if kind not in ("iu" if due.whole else "f") or data.dtype.itemsize > 8:
            raise DamagedError(f"{name} has numbers of type {data.dtype}")
        shape = data.shape or ()
        right = len(shape) == len(due.dims) and all(
            known.setdefault(dim, n) == n for dim, n in zip(due.dims, shape, strict=True)
        )
        if not right:
            expected = ", ".join(f"{dim} {known.get(dim, '')}".rstrip() for dim in due.dims)
            raise DamagedError(f"{name} has shape {shape}, not ({expected})")
        numbers += math.prod(shape)
        if numbers > MOST_NUMBERS or 8 * numbers > _DENSE * size + _SPARE:
            raise DamagedError(f"{name} is larger than a file of {size:,} bytes can hold")
        datasets[name] = data
    return {name: data[...] for name, data in datasets.items()}


def open_hdf5(data: bytes) -> h5py.File:
    """Open the content of a file for reading.

    Raises
    ------
    DamagedError
        The HDF5 library cannot open it.
    """
    import h5py

    try:
        return h5py.File(io.BytesIO(data), "r")
    except (OSError, RuntimeError, ValueError) as error:
        raise DamagedError(" ".join(str(error).split())) from None
