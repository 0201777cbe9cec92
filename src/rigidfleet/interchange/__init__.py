"""Flights as the files that other programs fly, show or record.

`export` writes a flight in one of `FORMATS`, reads its own output back, and says how far it is from what was exported.
Each module of this package writes and reads the formats of one family: a ``write`` function yields the bytes of
each file, of one or all vehicles, and its ``read`` function returns the ways in them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from rigidfleet._common.arguments import as_path
from rigidfleet._common.files import replace_folder_atomically, write_file
from rigidfleet.errors import ResultError
from rigidfleet.foreign import texts
from rigidfleet.interchange import crazyflie, gltf, mavlink, recordings, skybrush
from rigidfleet.interchange.curves import Deviation, ExportedMotion, deviation, motion_and_is_cut
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.result import Result, as_result
from rigidfleet.result.lights import has_lights
from rigidfleet.setpoints import csv_text

__all__ = ["FORMATS", "Export", "Format", "FormatName", "export"]

FormatName = Literal[
    "setpoints", "polynomial", "poly4d", "compressed", "skyc", "mcap", "tlog", "rrd", "gltf"
]
#: How much further off than its tolerance an export may be, by rounding and between the times that a fit checks.
_SLACK = 1.05


class Format(NamedTuple):
    """A format of an export.

    Attributes
    ----------
    write : from the motion and the rate [Hz] or the tolerance [m] to the bytes of each file
    read : from the bytes of a file to the ways of its vehicles
    suffix : of the files' names
    each : whether each vehicle has a file of its own
    tolerance : default tolerance of fitted curves [m]; None: it has samples at a rate instead
    kept, lost : what such a file has of each vehicle, and what it lacks
    own_time : whether its time begins at 0, not at the mission time of the first state
    package, distribution : module that has to be installed, and the name under which pip installs it
    lights : whether it has the vehicles' lights
    """

    write: Callable[[ExportedMotion, Any], Iterator[bytes]]
    read: Callable[[bytes], list[Piecewise]]
    suffix: str
    each: bool
    tolerance: float | None
    kept: str
    lost: str
    own_time: bool = True
    package: str = ""
    distribution: str = ""
    lights: bool = False


def _write_table(motion: ExportedMotion, rate: float | None, first: int = 1) -> Iterator[bytes]:
    """The table that `Result.to_csv` writes: a row for each time and vehicle."""
    yield csv_text(motion.at_rate(rate), first).encode()


def _write_table_of_each_vehicle(motion: ExportedMotion, rate: float | None) -> Iterator[bytes]:
    """Such a table for each vehicle."""
    for i in range(motion.n_agents):
        yield from _write_table(motion.of_vehicle(i), rate, i + 1)


FORMATS: dict[str, Format] = {
    "setpoints": Format(
        _write_table, texts.read_result_table, "csv", False, None,
        "position, velocity, acceleration, jerk, yaw and yaw rate", "tilt and rotors", False,
    ),
    "polynomial": Format(
        crazyflie.write_polynomial, texts.read_polynomial, "csv", True, 1e-3,
        "position and yaw (pieces of degree 7)", "tilt and rotors",
    ),
    "poly4d": Format(
        partial(crazyflie.write_within_memory, crazyflie.poly4d_images),
        crazyflie.read_poly4d, "bin", True, 1e-3,
        "position and yaw (pieces of degree 7)", "tilt and rotors",
    ),
    "compressed": Format(
        partial(crazyflie.write_within_memory, crazyflie.compressed_images),
        crazyflie.read_compressed, "bin", True, 5e-3,
        "position and yaw (pieces of degree 7 in whole mm)", "tilt and rotors",
    ),
    "skyc": Format(
        skybrush.write_skyc, skybrush.read_skyc, "skyc", False, 1e-2,
        "position (cubic pieces) and yaw", "continuous acceleration, tilt and rotors", lights=True,
    ),
    "mcap": Format(
        recordings.write_mcap, recordings.read_mcap, "mcap", False, None,
        "position, velocity, yaw and yaw rate", "acceleration, jerk, tilt and rotors", False, "mcap", "mcap",
    ),
    "tlog": Format(
        mavlink.write_tlog_of_each_vehicle, mavlink.read_tlog, "tlog", True, None,
        "position, velocity, acceleration, yaw and yaw rate", "jerk, tilt and rotors",
    ),
    "rrd": Format(
        recordings.write_rrd, recordings.read_rrd, "rrd", False, None,
        "position and yaw", "velocity, acceleration, jerk, tilt and rotors", False, "rerun", "rerun-sdk",
    ),
    "gltf": Format(
        gltf.write_gltf, gltf.read_gltf, "glb", False, 1e-2,
        "position (cubic splines) and yaw", "continuous acceleration, tilt and rotors", lights=True,
    ),
}  # fmt: skip
assert tuple(FORMATS) == get_args(FormatName)


@dataclass(frozen=True)
class Export:
    """What an export wrote, kept and lost; as text, one line.

    Attributes
    ----------
    format, path : what was written, and where: a file, or a folder with one file a vehicle
    files, size : number of files and of all their bytes
    flown : whether it is the motion flown, not the reference
    deviation : greatest distance of the files' ways from what was exported [m]
    yaw_deviation : greatest difference of yaw [rad]
    span : first and last mission time of the ways [s]
    part : words about the part of the flight that the files have; "" for all of it
    lights : whether the flight has lights, which the format keeps or loses
    """

    format: str
    path: Path
    files: int
    size: int
    flown: bool
    deviation: float
    yaw_deviation: float
    span: tuple[float, float]
    part: str
    lights: bool = False

    def __str__(self) -> str:
        what = FORMATS[self.format]
        files = "1 file" if self.files == 1 else f"{self.files} files"
        source = "flown" if self.flown else "reference"
        turned = math.degrees(self.yaw_deviation)
        within = f"{brief_number(1e3 * self.deviation)} mm and {brief_number(turned)} deg"
        size = max(1, round(self.size / 1e3))
        # No yaw is flown by points, and none is recorded of vehicles but in their attitudes.
        extra = "; yaw is the reference's, and east where it has none" if self.flown else ""
        kept = ", and lights" if self.lights and what.lights else ""
        lost = f"lights, {what.lost}" if self.lights and not what.lights else what.lost
        return (
            f"{self.format}: {files}, {size:,} kB; kept the {source} {what.kept}{self.part} within {within}{kept}; "
            f"lost {lost}{extra}."
        )


def export(
    result: Result | str | Path,
    path: str | Path,
    format: FormatName,
    *,
    rate: float | None = None,
    tolerance: float | None = None,
    flown: bool = False,
) -> Export:
    """Write a flight for another program, and measure what was written by reading it back.

    It does not judge the flight: see `assess` before you hand one to vehicles. The command refuses one that failed.
    Existing files of the same names are replaced, all or none.

    Parameters
    ----------
    result : a flight, or the path of a saved one
    path : file to write; for a format with one file a vehicle, a folder. ``setpoints`` writes one file to a path that
        ends in ``.csv``, and otherwise one a vehicle into a folder
    format : see `FORMATS`
    rate : samples per second [Hz] of ``setpoints``, ``mcap``, ``tlog`` and ``rrd``; by default those of the result
    tolerance : greatest deviation of fitted curves [m], for all other formats; by default that of the format
    flown : export the motion flown instead of the reference

    Raises
    ------
    ResultError
        The flight has no reference, does not fit the format, or cannot be kept within the tolerance; a package is
        missing; the files cannot be written, or the result cannot be read.
    ValueError
        The format is unknown, or the rate or the tolerance is not positive or does not apply.
    TypeError
        ``result`` is neither a flight nor a path.
    """
    result, path = as_result(result), as_path(path)
    chosen = format_by_name(format)
    if format == "setpoints" and path.suffix != ".csv":
        chosen = chosen._replace(write=_write_table_of_each_vehicle, each=True)
    setting = _rate_or_tolerance(format, chosen, rate, tolerance)
    if chosen.package and find_spec(chosen.package) is None:
        raise ResultError(
            f"{format}: needs the package {chosen.package!r}, which is not installed. Run: "
            f"pip install {chosen.distribution}"
        )
    try:
        motion, cut = motion_and_is_cut(result, flown=flown)
        off, size, count = _write_and_measure(motion, chosen, path, setting)
    except ResultError as error:
        raise ResultError(f"{format}: {error}") from None
    end = motion.end - off.missing
    part = ""
    if cut or off.missing > 1e-3:
        why = " (slots are not tracked before or after)" if cut else ""
        part = f" from {motion.start:g} to {end:g} s{why}"
    return Export(
        format, path, count, size, flown, off.position, off.yaw, (motion.start, end), part,
        has_lights(result),
    )  # fmt: skip


def format_by_name(name: str) -> Format:
    """The format of a name.

    Raises
    ------
    ValueError
        There is none of this name.
    """
    if name not in FORMATS:
        why = "; plans have no times: use tlog to fly, gltf to look" if name == "plan" else ""
        raise ValueError(f"there is no format {name!r}{why}; use one of {', '.join(FORMATS)}")
    return FORMATS[name]


def _rate_or_tolerance(
    name: str, chosen: Format, rate: float | None, tolerance: float | None
) -> float | None:
    """The rate [Hz] or the tolerance [m] of an export, whichever its format has."""
    values = {"rate": rate, "tolerance": tolerance}
    has, lacks = ("rate", "tolerance") if chosen.tolerance is None else ("tolerance", "rate")
    if values[lacks] is not None:
        of = "samples at a rate" if has == "rate" else "curves within a tolerance"
        raise ValueError(f"{lacks} does not apply to {name}, which has {of}; give {has} instead")
    value = values[has]
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{has} must be positive, not {value!r}")
    return chosen.tolerance if value is None else value


def _write_and_measure(
    motion: ExportedMotion, chosen: Format, path: Path, setting: float | None
) -> tuple[Deviation, int, int]:
    """Write the files, all or none; return how far they are off, and how many bytes and files they are."""
    deviations: list[Deviation] = []
    sizes: list[int] = []

    def files_while_measuring() -> Iterator[bytes]:
        start = motion.start if chosen.own_time else 0.0
        sources = zip(motion.curves(), motion.result.motors_off, strict=True)
        for data in chosen.write(motion, setting):
            ways = zip(chosen.read(data), sources, strict=False)
            own = [deviation(source, way.shift_time(start), until) for way, (source, until) in ways]
            worst = max(x.position for x in own)
            if chosen.tolerance is not None and setting is not None and worst > _SLACK * setting:
                raise ResultError(
                    f"the tolerance of {1e3 * setting:g} mm cannot be met: what was written is {1e3 * worst:.2g} mm "
                    f"off, by rounding. Use --tolerance {1.2 * worst:.2g}."
                )
            deviations.extend(own)
            sizes.append(len(data))
            yield data

    if not chosen.each:
        write_file(path, next(files_while_measuring()))
    else:
        if path.suffix == f".{chosen.suffix}":
            raise ResultError(f"{path}: each vehicle has a file of its own. Give a folder.")
        width = len(str(motion.n_agents))
        ours = re.compile(rf"agent-\d+\.{chosen.suffix}")
        with replace_folder_atomically(path, ours) as folder:
            for number, data in enumerate(files_while_measuring(), 1):
                name = f"agent-{number:0{width}}.{chosen.suffix}"
                (folder / name).write_bytes(data)
    greatest = Deviation(*(float(np.max(x)) for x in zip(*deviations, strict=True)))
    return greatest, sum(sizes), len(sizes)


def brief_number(x: float) -> str:
    """A deviation with two digits or in whole units; a tiny one as a bound."""
    return "0.001" if x < 1e-3 else f"{x:.2g}" if x < 10.0 else f"{x:.0f}"
