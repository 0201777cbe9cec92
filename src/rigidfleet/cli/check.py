"""Check a mission before the flight: `check`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from rigidfleet.cli import console
from rigidfleet.cli.arguments import MissionName
from rigidfleet.cli.outputs import refuse_overwriting, with_toml_suffix
from rigidfleet.errors import MissionError, RigidfleetError

if TYPE_CHECKING:
    from rigidfleet.mission import Mission
from rigidfleet.cli.codes import BAD_INPUT, FAILED, PASSED


def check(
    mission: MissionName,
    /,
    *,
    realisations: Annotated[bool | None, Parameter(negative="--no-realisations")] = None,
    figure: Path | None = None,
    expand: Path | None = None,
    abort: Annotated[bool, Parameter(negative="")] = False,
    out: Path | None = None,
    force: bool = False,
    json: bool = False,
) -> int:
    """Check a mission without flying it.

    The check finds errors in the file, and problems with the rigidity of formations, the gains and the planned
    paths: collisions, thrust, gaps.

    Parameters
    ----------
    mission : str
        A shipped mission or a mission file.
    realisations : bool
        Search for other shapes with the same distances, from 40 random starts per formation. By default, search
        for up to 12 agents.
    figure : Path
        Draw the graphs to this file (.png, .svg or .pdf): redundant edges dashed, free motions as arrows.
    expand : Path
        Write the mission to this file (.toml) with the ways that are found for it as ordinary phases, to read, copy
        and edit. Comments are not kept.
    abort : bool
        Instead, plan a way home from every second of the flight, by [abort], and say which are proved.
    out : Path
        With --abort, write the aborts to this folder: aborts.json, and a file for each vehicle.
    force : bool
        Overwrite these files if they exist.
    json : bool
        Print the result as JSON.
    """
    from rigidfleet._common.files import write_file
    from rigidfleet._common.progress import report_steps_to
    from rigidfleet._common.toml import to_toml
    from rigidfleet.mission import load_mission
    from rigidfleet.planning.timing import expand_mission

    expand = expand and with_toml_suffix(expand)
    refuse_overwriting(expand, force=force, other="give another path")
    refuse_overwriting(out, force=force, other="give another folder")
    if out is not None and not abort:
        raise RigidfleetError("--out says where --abort writes. Add --abort.")
    watch = console.CheckWatch(mission)
    try:
        with watch, report_steps_to(watch.update):
            loaded = load_mission(mission)
            if expand is not None:
                loaded = expand_mission(loaded)
                write_file(expand, (loaded.file_digests_text + to_toml(loaded.to_dict())).encode())
            if abort:
                from rigidfleet.preflight.aborts import check_aborts

                home = check_aborts(loaded, progress=watch.update)
            else:
                from rigidfleet.preflight.check import check as preflight

                ahead = preflight(loaded, search=realisations, progress=watch.update)
    except MissionError as error:
        if not json:
            raise
        findings = [
            {"key": f.key, "value": f.value, "problem": f.problem, "remedy": f.remedy}
            for f in error.findings
        ]
        console.print_json({"mission": mission, "right": False, "findings": findings})
        return BAD_INPUT
    if abort and out is not None:
        home.write(out)
    if figure is not None and not abort:
        from rigidfleet.plotting.graph import draw_graphs

        judged = {f.name: f.rigidity for f in ahead.formations}
        draw_graphs(ahead.mission, judged, figure)
    if json:
        data = home.data() if abort else plain_facts(ahead.mission) | ahead.data()
        console.print_json({"mission": mission, "right": True} | data)
    else:
        console.out().print(home if abort else ahead)
        for what, path in (("Aborts", out), ("Mission", expand)):
            if path is not None:
                console.out().print(f"\n{what:8} {path}", soft_wrap=True)
    return PASSED if abort or ahead.passed else FAILED


def plain_facts(mission: Mission) -> dict[str, object]:
    """Describe a mission as plain data."""
    return {
        "name": mission.name,
        "title": mission.title,
        "source": mission.source,
        "agents": mission.n_agents,
        "formations": list(mission.formations),
        "phases": [
            {"name": p.name, "kind": p.kind, "to": p.leads_to, "ends": p.ends, "control": p.control}
            for p in mission.phases
        ],
        "latest_end_s": mission.latest_end,
    }
