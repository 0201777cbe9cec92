"""Write a mission: `new`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from rigidfleet.cli import console
from rigidfleet.cli.arguments import exact, parse_number, parse_whole
from rigidfleet.errors import RigidfleetError

if TYPE_CHECKING:
    pass
from rigidfleet.cli.check import facts
from rigidfleet.cli.codes import PASSED


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
    force: bool = False,
    quiet: bool = False,
    json: bool = False,
) -> int:
    """Write a mission to start from: commented, checked, ready to fly.

    Without options, on a terminal, it asks a few questions.

    Parameters
    ----------
    name : str
        Name of the mission, which is written to NAME.toml; or a path that ends so.
    shape : str
        line, triangle, square, polygon, hexagon, pyramid, cube, cuboid, v, grid, sphere, shells,
        helix, tetrahedron, octahedron, icosahedron or dodecahedron.
    agents : int
        Number of vehicles; as many as the shape needs if not given.
    size : float
        Edge length of the shape [m]; of a cuboid or a helix one, or three.
    mass : float
        Mass of each vehicle [kg].
    thrust_limit : float
        Greatest thrust of each vehicle [N]; 2.2 times its weight if not given.
    to : float
        Waypoint to fly to, X Y Z [m]; may be repeated.
    force : bool
        Replace a file that is there already.
    quiet : bool
        Print nothing but errors, and the JSON if asked for. Ask nothing.
    json : bool
        Print what was written as JSON. Ask nothing.
    """
    from rigidfleet._files import write_file
    from rigidfleet.mission import Mission, draft
    from rigidfleet.preflight.check import check as preflight

    given: dict[str, Any] = {
        "shape": shape, "agents": agents, "size": size, "mass": mass,
        "thrust_limit": thrust_limit, "waypoints": to,
    }  # fmt: skip
    asked = {key: value for key, value in given.items() if value is not None}
    if not (asked or quiet or json) and sys.stdin.isatty() and console.err().is_terminal:
        name, asked = _ask(name)
    file = Path(name or "mission")
    if not file.name:
        raise RigidfleetError(f"{file}: is a folder. Name a file.")
    file = file if file.suffix == ".toml" else file.with_name(f"{file.name}.toml")
    if file.exists() and not force:
        raise RigidfleetError(f"{file}: exists already and is kept. Replace it by --force.")
    try:
        text = draft.draft(file.stem, file=str(file), **asked)
    except ValueError as error:
        raise RigidfleetError(str(error)) from None
    mission = Mission.from_toml(text, str(file))
    fails = [r.text for r in preflight(mission, search=False).remarks if r.level == "fails"]
    if fails:
        raise RigidfleetError(
            f"{file}: is not written, as it would fail: {'; '.join(fails)}. Change what you ask for."
        )
    write_file(file, text.encode())
    if json:
        console.print_json({"file": str(file)} | facts(mission))
    elif not quiet:
        console.out().print(f"{file}: {mission.size_in_words}", soft_wrap=True)
        console.out().print(f"Fly it by: rigidfleet run {file}", soft_wrap=True)
    return PASSED


def _ask(name: str) -> tuple[str, dict[str, Any]]:
    """Name and contents of a new mission, asked for one by one; an empty answer takes what is offered."""
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
                raise RigidfleetError("No answer, so nothing is written. Give options.") from None
            try:
                return take(text)
            except ValueError as error:
                console.err().print(f"  {error}", style="yellow")

    def positive(text: str) -> float:
        value = parse_number(text)
        if not value > 0:
            raise ValueError("It must be positive.")
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
            raise ValueError("Three numbers: x, y, z.")
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
    if waypoint != draft.WAYPOINT:  # of which a large shape takes a higher one
        asked["waypoints"] = [waypoint]
    return name, asked
