"""Judge flights, also those that others made: `assess`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from rigidfleet._common.quantities import LIMITS_OF_CURVES
from rigidfleet._common.reading import READING, Gaps, Interpolation, Spans
from rigidfleet.cli import console
from rigidfleet.cli.arguments import MissionName
from rigidfleet.cli.codes import FAILED, PASSED, UNDECIDED
from rigidfleet.cli.outputs import Files
from rigidfleet.errors import RigidfleetError

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict
    from rigidfleet.foreign.curves import Trajectories
    from rigidfleet.mission import Mission
    from rigidfleet.result import Result
    from rigidfleet.simulation.as_logged import Doubts

#: Options that a mission replaces.
_OWN = ("separation", "separation_altitude", "radius", "ground", "limits")
_LIMITS = f"Further limits, KEY=VALUE, may be repeated: {', '.join(LIMITS_OF_CURVES)}."
#: Options that say how files are read.
_READ = (*READING, "spans", "origin")


def assess(
    *files: Path,
    mission: MissionName | None = None,
    separation: float | None = None,
    separation_altitude: float | None = None,
    limits: Annotated[list[str] | None, Parameter(help=_LIMITS)] = None,
    radius: float | None = None,
    ground: float | None = None,
    interpolation: Interpolation | None = None,
    spans: Spans | None = None,
    gaps: Gaps | None = None,
    units: str | None = None,
    axes: str | None = None,
    noise: str | None = None,
    clock: Literal["recorded", "offset", "own"] | None = None,
    topic: list[str] | None = None,
    origin: tuple[float, float, float] | None = None,
    explain: bool = False,
    out: Path | None = None,
    figures: Literal["few", "all"] = "few",
    force: bool = False,
    json: bool = False,
) -> int:
    """Judge a flight: a result, trajectories that another program made, or logs against their plan.

    Parameters
    ----------
    files : Path
        A result (NAME.nc), or trajectories: setpoints (CSV with columns time, x, y, z and, for several vehicles,
        agent), Crazyswarm2's polynomials (CSV, one a vehicle), a Skybrush show (.skyc), a recording of ROS 2 (.mcap,
        .db3), a log of an autopilot (.ulg, .tlog, .bin), or folders of these. If the first is a mission (its name, or a
        .toml), or the result of one, the others are logs of what flew it: they are judged against it, with doubt.
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
    noise : str
        Of measured positions: its standard deviation in a coordinate [m], and its correlation time [s] if it is known,
        such as 0.003 or 0.003,0.2; log: as the log says; or data: as the samples show it. What is judged then has an
        interval, and may be undecided. Default: trajectories are exact; of logs against a plan, log if it says it, or
        data.
    clock : str
        Of logs against a plan: recorded (that of the plan), offset (one for all, which is estimated), or
        own (each vehicle has one; separation is then not judged). Default: recorded.
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
    from rigidfleet.mission import Mission, as_mission
    from rigidfleet.result import Result

    if not files:
        raise RigidfleetError("no file was given; give a result or trajectories to judge")
    options: dict[str, Any] = {
        "mission": mission, "separation": separation, "separation_altitude": separation_altitude, "limits": limits,
        "radius": radius, "ground": ground, "interpolation": interpolation, "spans": spans, "gaps": gaps,
        "units": units, "axes": axes, "topic": topic, "origin": origin, "noise": noise, "clock": clock,
    }  # fmt: skip
    chosen = [key for key, value in options.items() if value is not None]
    plan = _is_mission_or_result(files[0])
    planned: Result | Mission | None = None
    if plan:
        planned = Result.load(files[0]) if files[0].suffix == ".nc" else as_mission(str(files[0]))
    alone = len(files) == 1
    if alone and isinstance(planned, Mission):
        raise RigidfleetError(
            f"{files[0]}: is a mission, and no flight. Fly and judge it by `rigidfleet run {files[0]}`, or give logs of"
            " its flight behind it"
        )
    if alone and isinstance(planned, Result):
        if chosen:
            words = f"--{chosen[0].replace('_', '-')}: no effect on a result, which has its own mission; remove it"
            raise RigidfleetError(words)
        result, verdict = planned, judge(planned)
    else:
        from rigidfleet.foreign.files import read_trajectories

        own = [key for key in _OWN if key in chosen]
        if (mission is not None or plan) and own:
            other = "a plan" if plan else "--mission"
            words = f"--{own[0].replace('_', '-')}: no effect with {other}, which has its own; remove one"
            raise RigidfleetError(words)
        if plan and mission is not None:
            raise RigidfleetError(f"--mission: no effect with the plan {files[0]}; remove one")
        if clock and not plan:
            raise RigidfleetError(
                "--clock: needs a plan to compare clocks with; give a mission before the logs"
            )
        higher = {} if separation_altitude is None else {"separation_altitude": separation_altitude}
        known = planned.mission if isinstance(planned, Result) else planned or mission
        if origin is None and known is not None:
            options["origin"] = getattr(as_mission(known).geodetic_origin, "geodetic", None)
        read = read_trajectories(
            files[plan:], **{key: x for key, x in options.items() if key in _READ and x is not None}
        )
        if origin is not None and not any("origin" in part for part in read.read):
            raise RigidfleetError("--origin: no file says where on the Earth it is; remove it")
        judged: dict[str, Any] = {} if plan else {
            "mission": mission, "separation": separation, "limits": _parse_limits(limits or []) | higher,
            "radius": radius or 0.0, "ground": ground, "name": flight_name(files[0]),
        }  # fmt: skip
        doubts = _stated_doubts(noise, clock) if noise or plan else None
        result, verdict = _judge(read, planned, doubts, judged)
    made = Files(out, result.mission.name) if out is not None else None
    if made is not None:
        made.check_writable(replace=force)
    for part in verdict.read if explain and not json else ():
        for key, value in part.items():
            words = ", ".join(map(str, value)) if isinstance(value, list) else f"{value}"
            if words:
                console.out().print(f"{key.replace('_', ' ')}: {words}", soft_wrap=True)
    console.show_verdict(verdict, json=json)
    if made is not None:
        from rigidfleet.cli.report import write_report
        from rigidfleet.cli.run import DRAWN, write_figures, write_replay

        made.save_result_and_verdict(result, verdict)
        write_report([result], [verdict], made.report, quiet=json)
        write_replay(result, made.replay)
        write_figures(result, made.list_figure_paths(figures, DRAWN), quiet=json)
        if not json:
            made.print_paths()
    return {"passed": PASSED, "failed": FAILED, "undecided": UNDECIDED}[verdict.word]


def _is_mission_or_result(file: Path) -> bool:
    """Whether a file is a mission or a result, or the name of a shipped mission."""
    from rigidfleet.mission import mission_names

    return file.suffix in (".toml", ".nc") or (not file.exists() and str(file) in mission_names())


def _judge(
    read: Trajectories, plan: Result | Mission | None, doubts: Doubts | None, judged: dict[str, Any]
) -> tuple[Result, Verdict]:
    """Trajectories that were read as a flight, and the verdict on it; with doubt, if something may be in doubt."""
    from rigidfleet.assessment import assess as judge

    if doubts is None:
        from rigidfleet.foreign.curves import looks_measured
        from rigidfleet.simulation.trajectories import result_of_trajectories

        result = result_of_trajectories(read, **judged)
        verdict = judge(result)
        if looks_measured(read.curves, read.assumed):
            verdict.notes.append(
                "the trajectory looks measured, and is taken as exact: its noise is judged, too. Say --noise"
            )
        return result, verdict
    from rigidfleet.mission import Mission
    from rigidfleet.simulation.as_logged import judge_log
    from rigidfleet.simulation.flight import simulate

    planned = simulate(plan) if isinstance(plan, Mission) else plan
    return judge_log(read, planned, doubts, **judged)


def _stated_doubts(noise: str | None, clock: Literal["recorded", "offset", "own"] | None) -> Doubts:
    """What is stated of noise and clock.

    Raises
    ------
    RigidfleetError
        The noise is no number, or not positive.
    """
    from rigidfleet.simulation.as_logged import Doubts

    if noise in (None, "data", "log"):
        return Doubts(noise or "", None, clock or "recorded")
    try:
        size, *more = (float(part) for part in noise.split(","))
    except ValueError:
        size, more = 0.0, []
    if not 0.0 < size < 1e3 or len(more) > 1 or not all(0.0 <= tau < 1e3 for tau in more):
        raise RigidfleetError(
            f"--noise {noise}: give a standard deviation [m], such as 0.003, with a correlation time [s] if it is"
            " known: 0.003,0.2; or log, or data"
        )
    return Doubts(size, more[0] if more else None, clock or "recorded")


def _parse_limits(limits: list[str]) -> dict[str, float]:
    """Limits of the command line by key.

    Raises
    ------
    RigidfleetError
        One cannot be read.
    """
    by_key: dict[str, float] = {}
    for option in limits:
        for part in option.split(","):
            try:
                key, value = part.split("=")
                by_key[key.strip()] = float(value)
            except ValueError:
                words = f"--limits {part}: give KEY=VALUE, such as speed=3"
                raise RigidfleetError(words) from None
    return by_key


def flight_name(file: Path) -> str:
    """The name of a flight after its file: files may have any characters, and names of missions only plain ones."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", file.resolve().stem).strip("._-")
    return plain or "trajectories"
