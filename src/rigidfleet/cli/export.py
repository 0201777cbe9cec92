"""Flights for other programs: `export`."""

from __future__ import annotations

from pathlib import Path

from rigidfleet.cli import console
from rigidfleet.cli.codes import PASSED
from rigidfleet.cli.outputs import refuse_overwriting
from rigidfleet.errors import ResultError, RigidfleetError


def export(
    result: Path,
    /,
    *,
    format: str,
    out: Path | None = None,
    rate: float | None = None,
    tolerance: float | None = None,
    flown: bool = False,
    force: bool = False,
) -> int:
    """Write a flight for another program, and say what is kept and what is lost.

    A flight that is incomplete, or failed its verdict, is written only with --force.

    Parameters
    ----------
    result : Path
        Result of a flight, NAME.nc.
    format : str
        setpoints (CSV), polynomial (Crazyswarm2), poly4d or compressed (memory of a Crazyflie), skyc (Skybrush), mcap
        (ROS 2), tlog (MAVLink), rrd (Rerun) or gltf (Blender).
    out : Path
        File to write, or for polynomial, poly4d, compressed and tlog, folder with one file a vehicle; setpoints takes
        either. Default: beside the result.
    rate : float
        Samples per second [Hz] of setpoints, mcap, tlog and rrd. Default: those of the result.
    tolerance : float
        Greatest deviation [m] of the curves of all other formats. Default: 0.001 for polynomial and poly4d, 0.005 for
        compressed, 0.01 for skyc and gltf.
    flown : bool
        Write the motion flown instead of the reference.
    force : bool
        Overwrite existing files, and write a flight that failed, too.
    """
    from rigidfleet.assessment import assess
    from rigidfleet.interchange import export as write
    from rigidfleet.interchange import format_by_name
    from rigidfleet.result import as_result

    try:
        chosen = format_by_name(format)
    except ValueError as error:
        raise RigidfleetError(f"{error}.") from None
    flight = as_result(result)
    verdict = assess(flight)
    if not verdict.passed:
        why = f"{result}: this flight must not be flown as it is. {verdict.summary}"
        if not force:
            raise ResultError(f"{why}\nUse --force to export it all the same; it overwrites, too.")
        console.warn(why)
    name = f"{result.stem}-{format}" if chosen.each else f"{result.stem}.{chosen.suffix}"
    path = out or result.parent / name  # a path such as "." has no name to change
    refuse_overwriting(path, force=force)
    try:
        made = write(flight, path, format, rate=rate, tolerance=tolerance, flown=flown)  # ty: ignore[invalid-argument-type]
    except ValueError as error:
        raise RigidfleetError(f"{error}.") from None
    if words := flight.mission.landing_swaps_in_words(flight.position[-1]):
        console.warn(f"{words}.")
    console.out().print(f"{made}\nExport   {path}", soft_wrap=True)
    return PASSED
