"""Write a new mission: `new`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from rigidfleet.cli import console
from rigidfleet.cli.arguments import exact, parse_number, parse_whole
from rigidfleet.cli.check import facts
from rigidfleet.cli.codes import PASSED
from rigidfleet.cli.outputs import keep_existing
from rigidfleet.errors import RigidfleetError


def new(
    name: str = "",
    /,
    *,
    shape: str | None = None,
    agents: Annotated[int | None, Parameter(converter=exact)] = None,
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
        Formations of a show, separated by commas: shapes, files of points, drawings (SVG) or text:WORDS.
        Default: sphere,helix.
    spacing : float
        Distance of neighbours in a show [m]. Default: 2.
    force : bool
        Overwrite an existing file.
    quiet : bool
        Print only errors, and JSON with --json. Ask no questions.
    json : bool
        Print a description of the mission as JSON. Ask no questions.
    """
    from rigidfleet._common.files import write_file
    from rigidfleet.mission import Mission, draft
    from rigidfleet.mission.files import completed
    from rigidfleet.preflight.check import check as preflight

    given: dict[str, Any] = {
        "shape": shape, "agents": agents, "size": size, "mass": mass,
        "thrust_limit": thrust_limit, "waypoints": to,
    }  # fmt: skip
    asked = {key: value for key, value in given.items() if value is not None}
    if not (asked or quiet or json or show) and sys.stdin.isatty() and console.err().is_terminal:
        name, asked = _ask(name)
    file = Path(name or "mission")
    if not file.name:
        raise RigidfleetError(f"{file}: is a folder. Name a file.")
    file = file if file.suffix == ".toml" else file.with_name(f"{file.name}.toml")
    keep_existing(file, force=force, other="give another name")
    try:
        if show:
            text = _show(
                file, asked, formations or "sphere,helix", 2.0 if spacing is None else spacing
            )
        elif formations is not None or spacing is not None:
            raise ValueError("--formations and --spacing are for a show: add --show")
        else:
            text = draft.draft(file.stem, file=str(file), **asked)
    except ValueError as error:
        raise RigidfleetError(str(error)) from None
    mission = Mission.from_toml(completed(text, file), str(file))
    fails = [r.text for r in preflight(mission, search=False).remarks if r.level == "fails"]
    if fails:
        raise RigidfleetError(
            f"{file}: not written, because the flight would fail: {'; '.join(fails)}. Change the options."
        )
    write_file(file, text.encode())
    if json:
        console.print_json({"file": str(file)} | facts(mission))
    elif not quiet:
        console.out().print(f"{file}: {mission.size_in_words}", soft_wrap=True)
        console.out().print(f"To fly it: rigidfleet run {file}", soft_wrap=True)
    return PASSED


def _show(file: Path, asked: dict[str, Any], formations: str, spacing: float) -> str:
    """Text of a show; points in the folder of the mission are written by the name of their file.

    Raises
    ------
    ValueError
        An option has no effect on a show, or a formation cannot be made.
    """
    from rigidfleet.cli.design import points_of
    from rigidfleet.formation.shapes import SHAPES
    from rigidfleet.math import proximity
    from rigidfleet.mission import show_draft

    options = {"shape": "--shape", "size": "--size", "waypoints": "--to"}
    if unused := " and ".join(option for key, option in options.items() if key in asked):
        raise ValueError(f"{unused}: no effect on a show; use --formations and --spacing")
    agents, scenes = asked.pop("agents", None), []
    words = [word.strip() for word in formations.split(",") if word.strip()]
    if agents is None:
        files = [w for w in words if Path(w).suffix.lower() in _POINTS and Path(w).exists()]
        agents = len(points_of(files[0], None)[1].slots) if files else _SHOWN
    for word in words:
        path = Path(word)
        if word in SHAPES or not (word.startswith("text:") or path.exists()):
            scenes.append(show_draft.scene(word, agents, spacing))
            continue
        try:
            own = points_of(word, None)[1] if path.suffix.lower() in _POINTS else None
            count = agents if own is None else min(agents, len(own.slots))
            name, points = points_of(word, count, spacing=spacing)
        except ValueError as error:
            raise ValueError(f"{word}: {error}") from None
        folder, there = file.parent.resolve(), path.resolve()
        own = None if own is not None and own.notes else own  # with fewer points than the file
        source, by_name = word, False
        whole = own is not None and len(own.slots) == count and there.is_relative_to(folder)
        for note in points.notes:
            console.err().print(f"Note: {word}: {note}.")
        if own is not None and whole and proximity.nearest(own.slots).min() >= spacing:
            source, points, by_name = there.relative_to(folder).as_posix(), own, True
        scenes.append(show_draft.points_scene(name, points, source, by_name=by_name))
    return show_draft.show(
        file.stem, scenes, agents=agents, spacing=spacing, file=str(file), **asked
    )


#: Files of points, and the number of agents of a show without any.
_POINTS, _SHOWN = (".csv", ".npy", ".ply", ".txt"), 100


def _ask(name: str) -> tuple[str, dict[str, Any]]:
    """Ask for the name and the numbers of a new mission, one by one. An empty answer accepts the default."""
    from rigidfleet.formation.shapes import SHAPES, agents_taken, slots
    from rigidfleet.mission import draft

    def answer(question: str, offered: str, take: Callable[[str], Any]) -> Any:
        while True:
            try:
                text = (
                    console.err().input(f"{question} [{offered}]: ", markup=False).strip()
                    or offered
                )
            except EOFError:
                raise RigidfleetError(
                    "No answer; no file is written. Give options instead."
                ) from None
            try:
                return take(text)
            except ValueError as error:
                console.err().print(f"  {error}", style="yellow")

    def positive(text: str) -> float:
        value = parse_number(text)
        if not value > 0:
            raise ValueError("Enter a positive number.")
        return value

    def known(text: str) -> str:
        draft.shape_known(text)
        return text

    def count(text: str) -> int:
        slots(shape, [1.0] * SHAPES[shape].sizes, parse_whole(text))
        return parse_whole(text)

    def point(text: str) -> tuple[float, ...]:
        values = tuple(map(parse_number, text.replace(",", " ").split()))
        if len(values) != 3:
            raise ValueError("Enter three numbers: x, y, z.")
        return values

    name = name or answer("Name", "mission", str)
    shape = answer(f"Shape ({', '.join(SHAPES)})", "triangle", known)
    asked: dict[str, Any] = {"shape": shape}
    usual = draft.agents_for(shape)
    if len(SHAPES[shape].agents) > 1:
        asked["agents"] = answer(f"Vehicles ({agents_taken(shape)})", str(usual), count)
    asked["size"] = [answer("Edge length [m]", f"{draft.SIZE:g}", positive)]
    asked["mass"] = answer("Mass of each [kg]", f"{draft.MASS:g}", positive)
    there = " ".join(f"{x:g}" for x in draft.WAYPOINT)
    waypoint = answer("Fly to x y z [m]", there, point)
    if waypoint != draft.WAYPOINT:  # the default waypoint is higher for a large shape
        asked["waypoints"] = [waypoint]
    return name, asked
