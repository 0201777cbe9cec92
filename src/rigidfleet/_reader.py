"""Read netCDF-4 files that may be damaged, or made to do harm: what a file declares is checked before it is read.

What it shall hold is told by declarations; nothing here knows flights. No array is read before its kind, its shape
and its size are known to be due, no text before it is text, and nothing from any other file.
"""

from __future__ import annotations

import io
import json
import math
import reprlib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
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

#: Numbers in a file at most: 8 GB, twice what a mission may have stored.
MOST_NUMBERS = 1e9
#: Bytes that a file may declare for each that it has, and besides: a small file must not ask for all memory.
_DENSE, _SPARE = 200, 1 << 20


class DamagedError(ValueError):
    """A file that does not hold what it should; the message says what is wrong, without a full stop."""


@dataclass(frozen=True)
class Array:
    """What an array of a file is to be: its dimensions, whether of whole numbers, and whether it may be absent."""

    dims: tuple[str, ...]
    whole: bool
    optional: bool


def attribute(file: h5py.File, name: str, kind: Any) -> Any:
    """An attribute as ``int`` or ``str``; of any other kind, as what its JSON is to be (`typed`).

    Raises
    ------
    DamagedError
        It is missing, or of another kind.
    """
    if name not in file.attrs:
        raise DamagedError(f"attribute {name} is missing")
    value = file.attrs[name]
    if isinstance(value, np.ndarray) and value.size == 1:  # as other tools write single ones
        value = value.reshape(-1)[0]
    if kind is int:
        if not isinstance(value, int | np.integer) or isinstance(value, bool):
            raise DamagedError(f"attribute {name} is no whole number")
        return int(value)
    if isinstance(value, bytes):
        value = value.decode("utf-8", "surrogateescape")
    if not isinstance(value, str):
        raise DamagedError(f"attribute {name} is no text")
    if not _is_text(value):
        raise DamagedError(f"attribute {name} is not UTF-8 text")
    if kind is str:
        return value
    try:
        plain = json.loads(value)
    except (ValueError, RecursionError) as error:
        raise DamagedError(f"attribute {name} is no JSON ({error})") from None
    return typed(plain, kind, f"attribute {name}")


def typed(value: Any, kind: Any, where: str) -> Any:
    """Plain data as a type says that it is: of dataclasses, typed dictionaries, lists, literals and finite numbers.

    Dataclasses are made; a tuple stays a list. Keys that a dataclass or a closed dictionary does not name, and
    numbers where text is due, are no such data. Of ``Annotated[A, B]`` it is B, where there is anything.

    Raises
    ------
    DamagedError
        It is not; ``where`` begins the message.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin is Annotated:  # plain data to all others, and to a file what stands beside
        return None if value is None else typed(value, inner[1], where)
    if origin in (Union, UnionType):  # with None, all of them
        some = next(k for k in inner if k is not NoneType)
        return None if value is None else typed(value, some, where)
    if origin is Literal and isinstance(value, str) and value in inner:
        return value
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        if abs(value) <= _HUGE:
            return float(value)
    elif kind in (str, int, bool) and type(value) is kind:
        if kind is not str or _is_text(value):
            return value
    elif origin is list and isinstance(value, list):
        return [typed(item, inner[0], f"{where}[{k + 1}]") for k, item in enumerate(value)]
    elif origin is tuple and isinstance(value, list) and len(value) == len(inner):
        return [typed(item, k, where) for item, k in zip(value, inner, strict=True)]
    elif isinstance(value, dict):
        if origin is dict:
            return {key: typed(item, inner[1], f"{where}.{key}") for key, item in value.items()}
        hints = get_type_hints(kind, include_extras=True)
        needed = getattr(kind, "__required_keys__", None)
        if needed is None:  # a dataclass
            needed = {
                f.name
                for f in fields(kind)
                if f.default is MISSING and f.default_factory is MISSING
            }
        known = hints.keys() - {"__others__"}
        if needed <= value.keys() and ("__others__" in hints or value.keys() <= known):
            made = {
                key: typed(item, hints.get(key, Any), f"{where}.{key}")
                for key, item in value.items()
            }
            return kind(**made)
    raise DamagedError(f"{where} is not as it should be: {_short(value)}")


#: Greater numbers are none of a flight.
_HUGE = 1e300


def _is_text(value: str) -> bool:
    try:
        value.encode()
    except UnicodeEncodeError:  # half a character
        return False
    return True


def _short(value: Any) -> str:
    text = reprlib.repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def arrays(
    file: h5py.File, declared: Mapping[str, Array], sizes: Mapping[str, int], size: int
) -> dict[str, NDArray[Any]]:
    """Arrays by name, those absent that may be left out.

    Parameters
    ----------
    declared : what each is to be
    sizes : of dimensions that are known
    size : of the file [bytes]

    Raises
    ------
    DamagedError
        One is missing, of another kind or shape, or they are larger together than such a file can hold.
    """
    found, known, numbers = {}, dict(sizes), 0
    for name, due in declared.items():
        if name not in file:
            if due.optional:
                continue
            raise DamagedError(f"{name} is missing")
        data = _dataset(file, name)
        kind = data.dtype.kind
        if kind not in ("iu" if due.whole else "f") or data.dtype.itemsize > 8:
            raise DamagedError(f"{name} has numbers of type {data.dtype}")
        shape = data.shape or ()
        right = len(shape) == len(due.dims) and all(
            known.setdefault(dim, n) == n for dim, n in zip(due.dims, shape, strict=True)
        )
        if not right:
            asked = ", ".join(f"{dim} {known.get(dim, '')}".rstrip() for dim in due.dims)
            raise DamagedError(f"{name} has shape {shape}, not ({asked})")
        numbers += math.prod(shape)
        if numbers > MOST_NUMBERS or 8 * numbers > _DENSE * size + _SPARE:
            raise DamagedError(f"{name} is larger than a file of {size:,} bytes holds")
        found[name] = data
    return {name: data[...] for name, data in found.items()}


def _dataset(file: h5py.File, name: str) -> h5py.Dataset:
    """A dataset of the file itself: no link, no window on other files."""
    import h5py

    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise DamagedError(f"{name} is a link to elsewhere")
    data = file[name]
    if not isinstance(data, h5py.Dataset):
        raise DamagedError(f"{name} is no array")
    if data.is_virtual or data.external:
        raise DamagedError(f"{name} has its numbers in another file")
    return data


def opened(data: bytes) -> h5py.File:
    """The content of a file, to be read.

    Raises
    ------
    DamagedError
        The library cannot open it.
    """
    import h5py

    try:
        return h5py.File(io.BytesIO(data), "r")
    except (OSError, RuntimeError, ValueError) as error:
        raise DamagedError(" ".join(str(error).split())) from None
