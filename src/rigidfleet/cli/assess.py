"""Judge flights, also those that others made: `assess`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from rigidfleet._common.quantities import LIMITS_OF_CURVES
from rigidfleet.cli import console
from rigidfleet.cli.codes import FAILED, PASSED
from rigidfleet.cli.outputs import Files
from rigidfleet.errors import RigidfleetError

#: Options that a mission replaces.
_OWN = ("separation", "separation_altitude", "radius", "ground", "limits")
_LIMITS = f"Further limits, KEY=VALUE, may be repeated: {', '.join(LIMITS_OF_CURVES)}."
#: Options that say how files are read.
_READ = ("interpolation", "spans", "gaps", "units", "axes", "topic", "origin")


def assess(
    *files: Path,
    mission: str | None = None,
    separation: float | None = None,
    separation_altitude: float | None = None,
    limits: Annotated[list[str] | None, Parameter(help=_LIMITS)] = None,
    radius: float | None = None,
    ground: float | None = None,
    interpolation: Literal["cubic", "linear"] | None = None,
    spans: Literal["refuse", "stand", "away"] | None = None,
    gaps: Literal["refuse", "bridge"] | None = None,
    units: str | None = None,
    axes: str | None = None,
    topic: list[str] | None = None,
    origin: tuple[float, float, float] | None = None,
    explain: bool = False,
    out: Path | None = None,
    figures: Literal["few", "all"] = "few",
    force: bool = False,
    json: bool = False,
) -> int:
    """Judge a flight: a result, or trajectories that another program made.

    Parameters
    ----------
    files : Path
        A result (NAME.nc), or trajectories: setpoints (CSV with columns time, x, y, z and, for several vehicles,
        agent), Crazyswarm2's polynomials (CSV, one a vehicle), a Skybrush show (.skyc), a recording of ROS 2 (.mcap,
        .db3), a log of an autopilot (.ulg, .tlog, .bin), or folders of these.
    mission : str
        Judge trajectories by this mission's radii, limits and obstacles.
    separation : float
        Least distance [m] between two vehicles, less their radii.
    separation_altitude : float
        Altitude z [m] from which on separation holds: vehicles that are both below it, as on their pads, may be nearer
        to each other. Default: it always holds.
    limits : list
        Further limits, KEY=VALUE, may be repeated.
    radius : float
        Radius of every vehicle [m]. Default: 0, distances are centre to centre.
    ground : float
        Height of the ground [m]. Default: there is none.
    interpolation : str
        Between samples: cubic (a spline through the positions) or linear. Default: cubic.
    spans : str
        Vehicles that begin later than others or end earlier, by more than their usual step: refuse, stand (at their
        first and last place), or away (not judged then). Default: refuse; shows and polynomials stand.
    gaps : str
        Times without samples, longer than ten usual steps of a vehicle: refuse, or bridge (by the curve). Default:
        refuse.
    units : str
        Units of a table's columns that do not name theirs: of time, length and angle, such as ms,mm,deg. Default:
        s,m,rad.
    axes : str
        Where x, y and z of a table point: enu (east, north, up), ned, or three others of e, n, u, w, s and d. Default:
        enu.
    topic : list
        Topic or message of a log that has positions, such as XKF1 or '/cf*/pose'; may be repeated. Default: chosen, and
        named in a note.
    origin : str
        Origin of positions of a log: latitude and longitude [deg], and height above mean sea level [m]. Default: the
        mission's, that of the estimator, or the first place.
    explain : bool
        Say first what was read: vehicles, span, columns used and ignored, units and axes.
    out : Path
        Folder for a result, the verdict, a report, a replay and figures. Default: write nothing.
    figures : str
        Which to draw into the folder: few (summary and trajectory) or all that show something. Default: few.
    force : bool
        Overwrite existing files.
    json : bool
        Print the verdict as JSON.
    """
    from rigidfleet.assessment import assess as judge

    if not files:
        raise RigidfleetError("no file was given; give a result or trajectories to judge")
    options: dict[str, Any] = {
        "mission": mission, "separation": separation, "separation_altitude": separation_altitude, "limits": limits,
        "radius": radius, "ground": ground, "interpolation": interpolation, "spans": spans, "gaps": gaps,
        "units": units, "axes": axes, "topic": topic, "origin": origin,
    }  # fmt: skip
    chosen = [key for key, value in options.items() if value is not None]
    if len(files) == 1 and files[0].suffix == ".nc":
        from rigidfleet.result import Result

        if chosen:
            words = f"--{chosen[0].replace('_', '-')}: no effect on a result, which has its own mission; remove it"
            raise RigidfleetError(words)
        result = Result.load(files[0])
    else:
        from rigidfleet.foreign.files import read_trajectories
        from rigidfleet.mission import as_mission
        from rigidfleet.simulation.trajectories import of_curves

        own = [key for key in _OWN if key in chosen]
        if mission is not None and own:
            words = f"--{own[0].replace('_', '-')}: no effect with --mission, which has its own; remove one"
            raise RigidfleetError(words)
        higher = {} if separation_altitude is None else {"separation_altitude": separation_altitude}
        place = None if mission is None else as_mission(mission).geodetic_origin
        if origin is None and place is not None:
            options["origin"] = place.latitude_deg, place.longitude_deg, place.altitude
        own = {key: options[key] for key in _READ if options[key] is not None}
        read = read_trajectories(files, **own)
        if origin is not None and not any("origin" in part for part in read.read):
            raise RigidfleetError("--origin: no file says where on the Earth it is; remove it")
        result = of_curves(
            read, mission=mission, separation=separation, limits=_limits(limits or []) | higher,
            radius=radius or 0.0, ground=ground, name=flight_name(files[0]),
        )  # fmt: skip
    verdict = judge(result)
    made = Files(out, result.mission.name) if out is not None else None
    if made is not None:
        made.claim(replace=force)
    for part in verdict.read if explain and not json else ():
        for key, value in part.items():
            words = ", ".join(map(str, value)) if isinstance(value, list) else f"{value}"
            line = f"{key.replace('_', ' ')}: {words}"
            console.out().print(line, highlight=False, markup=False, soft_wrap=True)
    console.show_verdict(verdict, json=json)
    if made is not None:
        from rigidfleet.cli.report import write_report
        from rigidfleet.cli.run import of_formats, write_figures, write_replay

        made.save(result, verdict)
        write_report([result], [verdict], made.report, quiet=json)
        write_replay(result, made.replay)
        write_figures(result, of_formats(made.figures, figures, None), quiet=json)
        if not json:
            made.show()
    return PASSED if verdict.passed else FAILED


def _limits(limits: list[str]) -> dict[str, float]:
    """Limits of the command line by key.

    Raises
    ------
    RigidfleetError
        One cannot be read.
    """
    by_key: dict[str, float] = {}
    for option in limits:
        for part in option.split(","):
            key, equals, value = part.partition("=")
            try:
                by_key[key.strip()] = float(value)
            except ValueError:
                equals = ""
            if not equals:
                raise RigidfleetError(f"--limits {part}: give KEY=VALUE, such as speed=3")
    return by_key


def flight_name(file: Path) -> str:
    """The name of a flight after its file: files may have any characters, and names of missions only plain ones."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", file.resolve().stem).strip("._-")
    return plain or "trajectories"
