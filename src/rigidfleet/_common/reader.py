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
from typing import TYPE_CHECKING, Any

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
    """Return an attribute as ``int`` or ``str``, or the JSON in it as any other type, as pydantic reads it.

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
    if re.search("[\ud800-\udfff]", value):  # a lone surrogate
        raise DamagedError(f"attribute {name} is not UTF-8 text")
    if kind is str:
        return value
    from pydantic import TypeAdapter, ValidationError

    try:
        TypeAdapter(kind).validate_json(value)
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        if wrong["type"] == "json_invalid":
            why = wrong["ctx"]["error"]
            raise DamagedError(f"attribute {name} is not valid JSON ({why})") from None
        steps = (f"[{at + 1}]" if isinstance(at, int) else f".{at}" for at in wrong["loc"])
        shown = reprlib.repr(wrong["input"])[:60]
        raise DamagedError(
            f"attribute {name}{''.join(steps)} has an invalid value: {shown}"
        ) from None
    return json.loads(value)


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
