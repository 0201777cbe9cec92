"""The file of a result: netCDF-4, in which each variable has its unit and its meaning.

h5netcdf reads and writes the file; it is imported only when needed.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from rigidfleet._common.files import os_error_in_words
from rigidfleet._common.plain import to_json_text
from rigidfleet.errors import ResultError, refuse_format
from rigidfleet.result.phases import PhaseRecord

#: Version of the file format. Files of any other version are rejected.
SCHEMA_VERSION = 4


class Variable(NamedTuple):
    """Declaration of an array of a result: dimensions, unit and meaning, type, and whether it may be missing."""

    dims: tuple[str, ...]
    units: str
    text: str
    integers: bool = False
    optional: bool = False


#: Labels of each dimension whose length does not depend on the flight.
LABELS: dict[str, tuple[str, ...]] = {
    "axis": ("x", "y", "z"),
    "quaternion": ("w", "x", "y", "z"),
    "wrench": ("Fx", "Fy", "Fz", "tau_x", "tau_y", "tau_z"),
    "end": ("first", "second"),
    "link": ("second to first", "first to second"),
    "message": ("sent", "heard", "lost"),
    "rotor": ("front left", "front right", "rear right", "rear left"),
}


class Statistics(TypedDict, total=False):
    """Statistics of the integrator. Other keys are allowed."""

    __others__: Any
    evaluations: int
    steps: int
    rejected: int
    wall_s: float
    simulated_s: float
    rtol: float
    atol: float
    solvers: dict[str, dict[str, float]]
    spans: list[tuple[float, float]]


#: Attributes of a file and their types. Types other than int and str are stored as JSON.
ATTRIBUTES: dict[str, Any] = {
    "mission_text": str,
    "complete": int,
    "ending": str,
    "phases": list[PhaseRecord],
    "statistics": Statistics,
    "versions": dict[str, str],
    "platform": str,
    "created": str,
}
#: Attribute that identifies a file as a result.
_MARK = "rigidfleet_schema_version"
#: Maximum size of a chunk [bytes]: the size of HDF5's cache.
_CHUNK = 1 << 20


def netcdf_content(
    variables: Mapping[str, Variable],
    arrays: Mapping[str, NDArray[Any]],
    edges: Sequence[str],
    attributes: Mapping[str, Any],
) -> bytes:
    """Build the content of a file in memory, so that a full disk is an ordinary write error, not one of HDF5.

    Parameters
    ----------
    variables : declaration of each array by name
    arrays : those that the result has
    edges : names of the edges
    attributes : as `ATTRIBUTES` names them
    """
    import h5netcdf
    import h5py

    text = h5py.string_dtype()
    labels: dict[str, Sequence[str]] = LABELS | {"edge": edges}
    sizes = {dim: len(names) for dim, names in labels.items()}
    for name in ("time", "position"):
        sizes.update(zip(variables[name].dims, arrays[name].shape, strict=True))
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        file.dimensions = sizes
        file.attrs["Conventions"] = "CF-1.11"
        file.attrs["title"] = "flight of a virtual rigid body formation"
        file.attrs[_MARK] = SCHEMA_VERSION
        for name, kind in ATTRIBUTES.items():
            # Attributes can be text or numbers, but not dict, bool or None: those are stored as JSON.
            plain = kind if kind in (int, str) else to_json_text
            file.attrs[_stored_attribute_name(name)] = plain(attributes[name])
        for name, names in labels.items():
            names_along = file.create_variable(name, (name,), text)
            if names:
                names_along[...] = np.array(names, dtype=object)
        agent = file.create_variable("agent", ("agent",), "i4")
        agent[...] = np.arange(1, sizes["agent"] + 1)
        agent.attrs["long_name"] = "agent, from 1"
        for name, value in arrays.items():
            variable = variables[name]
            entry = file.create_variable(
                name,
                variable.dims,
                "i4" if variable.integers else "f8",
                data=value,
                chunks=_chunk_shape(value.shape),
                fletcher32=True,  # detects damage; compression would save a seventh of the size and double the time
            )
            entry.attrs["units"] = variable.units
            entry.attrs["long_name"] = variable.text
    return buffer.getvalue()


def read_netcdf(path: Path, variables: Mapping[str, Variable]) -> dict[str, Any]:
    """Read the arrays and attributes of a file by name, checked against their declarations.

    Raises
    ------
    ResultError
        The file does not exist, is not a result, or has another format version.
    Exception
        Any other error: the file is damaged.
    """
    from rigidfleet._common import reader

    data = _read_result_bytes(path)
    due = {name: reader.Array(v.dims, v.integers, v.optional) for name, v in variables.items()}
    with reader.open_hdf5(data) as file:
        if _MARK not in file.attrs:
            raise ResultError(
                f"{path}: is a netCDF-4 or HDF5 file, but not a result of rigidfleet. "
                "Give the path of a result of `rigidfleet run`."
            )
        made = reader.read_attribute(file, _MARK, int)
        refuse_format(path, "result", made, SCHEMA_VERSION, older="Fly the mission again")
        attributes = {
            name: reader.read_attribute(file, _stored_attribute_name(name), kind)
            for name, kind in ATTRIBUTES.items()
        }
        sizes = {dim: len(names) for dim, names in LABELS.items()}
        arrays = reader.read_arrays(file, due, sizes, len(data))
    return arrays | attributes | {"complete": bool(attributes["complete"])}


def _stored_attribute_name(name: str) -> str:
    """Name of an attribute in the file."""
    return "mission" if name == "mission_text" else name


def _chunk_shape(shape: tuple[int, ...]) -> tuple[int, ...] | None:
    """Shape of a chunk: as many whole rows as fit into `_CHUNK`; None for an empty array."""
    if 0 in shape:
        return None
    row = 8 * math.prod(shape[1:])
    return (min(shape[0], max(1, _CHUNK // row)), *shape[1:])


def _read_result_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ResultError(f"{path}: {os_error_in_words(error, 'read', path)}") from error
    if not data.startswith(b"\x89HDF\r\n\x1a\n"):
        what = "is empty" if not data else "is not a netCDF-4 file"
        raise ResultError(f"{path}: {what}. Give the path of a result of `rigidfleet run`.")
    return data
