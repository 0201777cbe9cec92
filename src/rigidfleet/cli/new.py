"""Write a new mission: `new`."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from rigidfleet.cli import console
from rigidfleet.cli.arguments import parse_number, parse_whole, to_whole_number
from rigidfleet.cli.check import plain_facts
from rigidfleet.cli.codes import PASSED
from rigidfleet.cli.outputs import refuse_overwriting, with_toml_suffix
from rigidfleet.errors import RigidfleetError


def new(
    name: str = "",
    /,
    *,
    shape: str | None = None,
    agents: Annotated[int | None, Parameter(converter=to_whole_number)] = None,
    size: Annotated[list[float] | None, Parameter(consume_multiple=True)] = None,
    mass: float | None = None,
    thrust_limit: float | None = None,
    to: list[tuple[float, float, float]] | None = None,
    show: Annotated[bool, Parameter(negative=())] = False,
    formations: str | None = None,
    spacing: float | None = None,
    force: bool = False,
    quiet: bool = False,
    json: bool = False,
) -> int:
    """Write a new mission with comments, checked and ready to fly.

    On a terminal, without options, the command asks a few questions.

    Parameters
    ----------
    name : str
        Name of the mission, written to NAME.toml, or the path of the file.
    shape : str
        A file of points (CSV, NPY or PLY), a drawing (SVG), text:WORDS or strokes:WORDS, or one of
        line, triangle, square, polygon, hexagon, pyramid, cube, cuboid, v, grid, sphere, shells,
        helix, tetrahedron, octahedron, icosahedron or dodecahedron.
    agents : int
        Number of vehicles. Default: as many as the shape needs.
    size : float
        Edge length of the shape [m]; one or three sizes for a cuboid or a helix.
    mass : float
        Mass of each vehicle [kg].
    thrust_limit : float
        Maximum thrust of each vehicle [N]. Default: 2.2 times its weight.
    to : float
        Waypoint X Y Z [m]; may be repeated.
    show : bool
        Write a show: take off from a grid, go through formations, return and land.
    formations : str
        Formations of a show, separated by commas: shapes, files of points, drawings (SVG), text:WORDS
        or strokes:WORDS (letters of single strokes).
        Default: sphere,helix.
    spacing : float
        Distance of the nearest two vehicles [m] in a show (default: 2) or in points, which are scaled to it.
    force : bool
        Overwrite an existing file.
    quiet : bool
        Print only errors, and JSON with --json. Ask no questions.
    json : bool
        Print a description of the mission as JSON. Ask no questions.
    """
    from rigidfleet._common.files import write_file
    from rigidfleet.formation.shapes import SHAPES
    from rigidfleet.mission import draft
    from rigidfleet.mission.loading import mission_of_file
    from rigidfleet.preflight.check import check as preflight

    all_options: dict[str, Any] = {
        "shape": shape, "agents": agents, "size": size, "mass": mass,
        "thrust_limit": thrust_limit, "waypoints": to,
    }  # fmt: skip
    options = {key: value for key, value in all_options.items() if value is not None}
    if not (options or quiet or json or show) and sys.stdin.isatty() and console.err().is_terminal:
        name, options = _ask_for_name_and_answers(name)
    file = with_toml_suffix(Path(name or "mission"))
    refuse_overwriting(file, force=force, other="give another name")
    if not show and (formations or shape or "cube") not in SHAPES:  # points make a show
        show, formations = True, formations or options.pop("shape")
    try:
        if show:
            spacing = 2.0 if spacing is None else spacing
            text = _text_of_show(file, options, formations or "sphere,helix", spacing)
        elif formations is not None or spacing is not None:
            raise ValueError("--formations and --spacing are for a show: add --show")
        else:
            text = draft.draft(file.stem, file=str(file), **options)
    except ValueError as error:
        raise RigidfleetError(str(error)) from None
    mission = mission_of_file(text, str(file))
    fails = [r.text for r in preflight(mission, search=False).remarks if r.level == "fails"]
    if fails:
        raise RigidfleetError(
            f"{file}: not written, because the flight would fail: {'; '.join(fails)}. Change the options."
        )
    write_file(file, text.encode())
    if json:
        console.print_json({"file": str(file)} | plain_facts(mission))
    elif not quiet:
        console.out().print(f"{file}: {mission.size_in_words}", soft_wrap=True)
        console.out().print(f"To fly it: rigidfleet run {file}", soft_wrap=True)
    return PASSED


def _text_of_show(file: Path, values: dict[str, Any], formations: str, spacing: float) -> str:
    """Text of a show; points in the folder of the mission are written by the name of their file.

    Raises
    ------
    ValueError
        An option has no effect on a show, or a formation cannot be made.
    """
    from rigidfleet.mission import show_draft

    options = {"shape": "--shape", "size": "--size", "waypoints": "--to"}
    if unused := " and ".join(option for key, option in options.items() if key in values):
        raise ValueError(f"{unused}: no effect on a show; use --formations and --spacing")
    agents = values.pop("agents", None)
    words = [word.strip() for word in formations.split(",") if word.strip()]
    if agents is None:
        counts = (len(points.slots) for word in words if (points := _points_of_file(word)))
        agents = next(counts, _SHOWN)
    scenes = [_formation_of_show(file, word, agents, spacing) for word in words]
    return show_draft.show_mission_text(
        file.stem, scenes, agents=agents, spacing=spacing, file=str(file), **values
    )


def _formation_of_show(mission_file: Path, shape: str, agents: int, spacing: float) -> Any:
    """A formation of a show of a shape, a file or words.

    Points of a whole file in the folder of the mission that are not too narrow are written by the name of the file.

    Raises
    ------
    ValueError
        It cannot be made.
    """
    from rigidfleet.cli.design import load_shape_points
    from rigidfleet.formation.shapes import SHAPES
    from rigidfleet.math import proximity
    from rigidfleet.mission import show_draft

    if shape in SHAPES:
        return show_draft.shape_scene(shape, agents, spacing)
    folder, there, count = mission_file.parent.resolve(), Path(shape).resolve(), agents
    if (own := _points_of_file(shape)) is not None:
        whole = not own.notes and len(own.slots) <= agents and there.is_relative_to(folder)
        if whole and spacing <= proximity.nearest(own.slots).min() < math.inf:
            source = there.relative_to(folder).as_posix()
            return show_draft.points_scene(Path(shape).stem, own, source, by_name=True)
        count = min(agents, len(own.slots))
    try:
        name, points = load_shape_points(shape, count, spacing=spacing)
    except ValueError as error:
        raise ValueError(f"{shape}: {error}") from None
    for note in points.notes:
        console.err().print(f"Note: {shape}: {note}.", markup=False)
    return show_draft.points_scene(name, points, shape)


def _points_of_file(word: str) -> Any:
    """The `Points` of a file; None for a drawing, words, or what is no file."""
    from rigidfleet.formation.point_files import read_points

    holds = Path(word).suffix.lower() != ".svg" and Path(word).is_file()
    return read_points(word, repeated=True) if holds else None


#: Number of agents of a show without any file of points.
_SHOWN = 100


def _ask_for_name_and_answers(name: str) -> tuple[str, dict[str, Any]]:
    """Ask for the name and the numbers of a new mission, one by one. An empty answer accepts the default."""
    from rigidfleet.formation.shapes import SHAPES, agents_taken, slots
    from rigidfleet.mission import draft

    def ask_until_valid(question: str, offered: str, take: Callable[[str], Any]) -> Any:
        while True:
            try:
                reply = console.err().input(f"{question} [{offered}]: ", markup=False)
            except EOFError:
                why = "No answer; no file is written. Give options instead."
                raise RigidfleetError(why) from None
            try:
                return take(reply.strip() or offered)
            except ValueError as error:
                console.err().print(f"  {error}", style="yellow")

    def parse_positive(text: str) -> float:
        value = parse_number(text)
        if not value > 0:
            raise ValueError("Enter a positive number.")
        return value

    def parse_shape(text: str) -> str:
        draft.check_shape_name(text)
        return text

    def count(text: str) -> int:
        slots(shape, [1.0] * SHAPES[shape].sizes, parse_whole(text))
        return parse_whole(text)

    def parse_point(text: str) -> tuple[float, ...]:
        values = tuple(map(parse_number, text.replace(",", " ").split()))
        if len(values) != 3:
            raise ValueError("Enter three numbers: x, y, z.")
        return values

    name = name or ask_until_valid("Name", "mission", str)
    shape = ask_until_valid(f"Shape ({', '.join(SHAPES)})", "triangle", parse_shape)
    answers: dict[str, Any] = {"shape": shape}
    usual = draft.agents_for(shape)
    if len(SHAPES[shape].agents) > 1:
        answers["agents"] = ask_until_valid(f"Vehicles ({agents_taken(shape)})", str(usual), count)
    answers["size"] = [ask_until_valid("Edge length [m]", f"{draft.SIZE:g}", parse_positive)]
    answers["mass"] = ask_until_valid("Mass of each [kg]", f"{draft.MASS:g}", parse_positive)
    there = " ".join(f"{x:g}" for x in draft.WAYPOINT)
    waypoint = ask_until_valid("Fly to x y z [m]", there, parse_point)
    if waypoint != draft.WAYPOINT:  # the default waypoint is higher for a large shape
        answers["waypoints"] = [waypoint]
    return name, answers
