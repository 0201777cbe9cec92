"""Definition of a sweep: a mission, its variations, the number of runs and a seed. It is checked as a whole.

Run k depends only on the definition and on k: its grid point is k modulo the size of the grid, and its random numbers
come from a separate Philox stream, keyed by (seed, k).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, Strict

from rigidfleet._common.arguments import as_path
from rigidfleet._common.renamed import successor
from rigidfleet._version import __version__
from rigidfleet.errors import MissionError, SweepError, wrong_type
from rigidfleet.mission import Mission, load_mission, mission_names
from rigidfleet.mission.findings import FindingCollector, Keys, Shared, unknown_key
from rigidfleet.mission.loading import as_mission
from rigidfleet.mission.phases import kind, tables
from rigidfleet.mission.text import parse_toml, read_text
from rigidfleet.mission.values import Part
from rigidfleet.sweep import keypaths
from rigidfleet.sweep.variation import (
    KINDS,
    Drawn,
    Gridded,
    Variation,
    WrongLine,
    from_line,
    is_number,
)

Evaluate = Literal["flight", "final"]

#: Remedy if final states cannot be evaluated alone.
_WHOLE = 'evaluate whole flights: evaluate = "flight", no --final-states'
#: Smallest fraction at which a distribution is evaluated, so that no normal number is infinite.
_LEAST = 2.0**-54


class SweepHeader(Part):
    """Keys at the top of a sweep file."""

    mission: str = Field(
        description="a shipped mission, or the path of a mission file relative to this file"
    )
    runs: Annotated[int, Strict(), Field(ge=1, le=10**8)] | None = Field(
        None, description="number of runs; default: one per point of the grid"
    )
    seed: Annotated[int, Strict(), Field(ge=0, lt=2**63)] = Field(
        0, description="seed of the random numbers"
    )
    evaluate: Evaluate = Field(
        "flight",
        description="flight: evaluate whole flights; final: evaluate only the final states of phases, thousands of "
        "runs per second, for open-loop missions with varied start states",
    )


@dataclass(frozen=True)
class SweepColumn:
    """A number that varies: its variation, its place in the mission, and its values if it is on a grid."""

    variation: Variation
    keys: Keys
    grid: tuple[Any, ...] | None

    @property
    def name(self) -> str:
        """Path of the number, counted from 1."""
        return keypaths.name_of(self.keys)


class Sweep:
    """A checked sweep. Create one by `Sweep.of`, or from a file by `Sweep.load`.

    Attributes
    ----------
    mission : the mission to vary
    variations : its variations
    runs : number of runs
    seed : seed of the random numbers
    name : name of the sweep
    evaluate : what is evaluated of each run: "flight" or "final"
    """

    def __init__(
        self,
        mission: Mission,
        variations: Sequence[Variation],
        runs: int | None,
        seed: int,
        name: str,
        evaluate: Evaluate = "flight",
    ) -> None:
        self.mission, self.variations = mission, tuple(variations)
        self.seed, self.name, self.evaluate = seed, name, evaluate
        self.runs = runs or math.prod(self.grid_sizes.values())

    @classmethod
    def of(
        cls,
        mission: Mission | str | Path,
        vary: Iterable[str | Mapping[str, Any]],
        *,
        runs: int | None = None,
        seed: int = 0,
        evaluate: Evaluate = "flight",
        name: str = "",
        origin: str = "sweep",
    ) -> Self:
        """Define a sweep of a mission, given as a `Mission`, a shipped name or a path.

        Parameters
        ----------
        vary : variations, each a line such as `agents.mass.* *= normal(1, 0.05)` or a table
        runs : number of runs; default: one per point of the grid
        seed : seed of the random numbers
        evaluate : "flight", or "final" to evaluate only the final states of phases, for open-loop missions with
            varied start states
        name : name of the sweep; default: the name of the mission
        origin : name of the sweep in messages

        Raises
        ------
        SweepError
            With a finding for each error of the sweep.
        MissionError
            The mission cannot be read or has errors.
        """
        mission = as_mission(mission)
        if isinstance(vary, str | bytes) or not isinstance(vary, Iterable):
            raise wrong_type("a list of variations", vary)
        data: dict[str, Any] = {"mission": mission.name, "seed": seed, "vary": list(vary)}
        data |= {} if runs is None else {"runs": runs}
        data |= {} if evaluate == "flight" else {"evaluate": evaluate}
        header, variations = _checked(data, origin, mission)
        return cls(
            mission, variations, header.runs, header.seed, name or mission.name, header.evaluate
        )

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        more: Iterable[str] = (),
        runs: int | None = None,
        seed: int | None = None,
        evaluate: Evaluate | None = None,
    ) -> Self:
        """Read a sweep file.

        Parameters
        ----------
        more : lines of additional variations
        runs, seed, evaluate : replace those of the file

        Raises
        ------
        SweepError
            With a finding for each error of the sweep.
        MissionError
            The file cannot be read, or its mission has errors.
        """
        path = as_path(path)
        origin = str(path)
        data = parse_toml(read_text(path), origin)
        named = data.get("mission")
        mission = None
        if isinstance(named, str):
            shipped = named in mission_names()
            mission = load_mission(named if shipped else path.parent / named)
        data |= {} if runs is None else {"runs": runs}
        data |= {} if seed is None else {"seed": seed}
        data |= {} if evaluate is None else {"evaluate": evaluate}
        if isinstance(given := data.get("vary", []), list):
            data["vary"] = [*given, *more]
        header, variations = _checked(data, origin, mission)
        assert mission is not None  # otherwise the check has raised
        return cls(mission, variations, header.runs, header.seed, path.stem, header.evaluate)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Restore a sweep from the output of `json`."""
        data = json.loads(text)
        variations = [KINDS[entry["kind"]].model_validate(entry) for entry in data["vary"]]
        mission = Mission.from_toml(data["mission"], "mission of the sweep")
        return cls(mission, variations, data["runs"], data["seed"], data["name"], data["evaluate"])

    def json(self) -> str:
        """Return the definition as JSON text, including the mission."""
        return json.dumps(self._data(), ensure_ascii=False)

    @property
    def identity(self) -> dict[str, Any]:
        """Everything on which a run depends besides its number. The number of runs is not included: it may grow."""
        data = self._data()
        del data["runs"], data["name"]
        return data | {"version": __version__}

    @cached_property
    def document(self) -> dict[str, Any]:
        """The mission as plain data, as written."""
        return self.mission.to_dict()

    @cached_property
    def whole(self) -> dict[str, Any]:
        """The mission as plain data with all defaults."""
        return keypaths.whole_document(self.mission)

    @cached_property
    def columns(self) -> list[SweepColumn]:
        """All numbers that vary, in order."""
        return [
            SweepColumn(v, keys, grid)
            for v in self.variations
            for grid in [v.grid if isinstance(v, Gridded) else None]
            for keys in keypaths.expand(self.whole, v.path)
        ]

    @cached_property
    def grid_sizes(self) -> dict[str | int, int]:
        """Number of values of each grid, by its column, or by its group if it has one; in order of first occurrence."""
        return {_axis(c, k): len(c.grid) for k, c in enumerate(self.columns) if c.grid is not None}

    def values(self, run: int) -> list[Any]:
        """Value of every column in a run; runs count from 0."""
        stream = np.random.Philox(np.random.SeedSequence(self.seed, spawn_key=(run,)))
        drawn = sum(column.grid is None for column in self.columns)
        fractions = np.maximum(np.random.Generator(stream).random(drawn), _LEAST).tolist()
        point, places, found = run, {}, []
        for axis, size in reversed(self.grid_sizes.items()):  # the last grid varies fastest
            point, places[axis] = divmod(point, size)
        for k, column in reversed([*enumerate(self.columns)]):
            if column.grid is None:
                assert isinstance(column.variation, Drawn)
                found.append(column.variation.quantile(fractions.pop()))
            else:
                found.append(column.grid[places[_axis(column, k)]])
        return found[::-1]

    def varied(self, run: int, values: Sequence[Any] | None = None) -> dict[str, Any]:
        """The mission of a run as plain data, not yet checked; what does not vary is shared with `document`.

        ``values`` are those of the run, if they are known.
        """
        document = _copied(self.document, [column.keys for column in self.columns])
        for column, value in zip(self.columns, values or self.values(run), strict=True):
            apply(document, self.whole, column, value)
        return document

    def mission_of(self, run: int, values: Sequence[Any] | None = None) -> Mission:
        """The mission of a run, with its ``values``, if they are known.

        Raises
        ------
        MissionError
            It has errors.
        """
        return Mission.from_plain(self.varied(run, values), f"run {run}", self._shared)

    @cached_property
    def _shared(self) -> Shared:
        return Shared(self.document)

    def _data(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "mission": self.mission.text,
            "vary": [v.model_dump() for v in self.variations],
            "runs": self.runs,
            "seed": self.seed,
            "evaluate": self.evaluate,
        }


def _copied(x: Any, places: Sequence[Keys]) -> Any:
    """A copy of plain data in which the tables and lists on the way to some places are copied, and others shared."""
    if not isinstance(x, dict | list):
        return x
    new: Any = x.copy()
    below: dict[Any, list[Keys]] = {}
    for first, *rest in filter(None, places):
        below.setdefault(first, []).append(tuple(rest))
    for key, further in below.items():
        if (there := keypaths.look_up(x, (key,))) is not None:
            new[key] = _copied(there, further)
    return new


def _axis(column: SweepColumn, k: int) -> str | int:
    """What grids share that take their values together: their group, or the column's own number."""
    return getattr(column.variation, "group", "") or k


@lru_cache(maxsize=4)
def shared(text: str) -> Sweep:
    """Restore a sweep from its JSON; cached for the next chunks."""
    return Sweep.from_json(text)


def is_sweep_file(path: str | Path) -> bool:
    """Whether a file is a sweep file, not a mission file: it has the key `mission`."""
    try:
        return "mission" in parse_toml(read_text(path), str(path))
    except MissionError:
        return False


def apply(
    document: dict[str, Any], whole: Mapping[str, Any], column: SweepColumn, value: Any
) -> None:
    """Apply a value of a column to a document; all numbers at its place change alike."""
    integral = all(
        isinstance(x, int) for x in keypaths.numbers(keypaths.look_up(whole, column.keys))
    )

    def changed(there: Any) -> Any:
        match column.variation.change:
            case "add":
                new = there + value
            case "scale":
                new = there * value
            case _:
                new = value
        return round(new) if integral and math.isfinite(new) else new

    def replaced(there: Any) -> Any:
        return keypaths.mapped(there, changed) if is_number(value) else value

    keypaths.change(document, whole, column.keys, replaced)


# -- the check ---------------------------------------------------------------------------------------


def _checked(
    data: dict[str, Any], origin: str, mission: Mission | None
) -> tuple[SweepHeader, list[Variation]]:
    """Check a sweep and return its header and variations."""
    wrong: dict[int, WrongLine] = {}
    if isinstance(given := data.get("vary"), list):
        parsed = [from_line(entry) if isinstance(entry, str) else entry for entry in given]
        wrong = {k: entry for k, entry in enumerate(parsed) if isinstance(entry, WrongLine)}
        data["vary"] = [given[k] if k in wrong else entry for k, entry in enumerate(parsed)]
    collector = FindingCollector(data, origin)
    known = [*SweepHeader.model_fields, "vary"]
    for key in data:
        if key not in known:
            collector.add((key,), *unknown_key(key, known))
    own = {key: value for key, value in data.items() if key in SweepHeader.model_fields}
    header = collector.validate(SweepHeader, own, ())
    by_final_states = header is not None and header.evaluate == "final"
    whole = None if mission is None else keypaths.whole_document(mission)
    variations = []
    for k, entry in enumerate(tables(collector, "vary")):
        if k in wrong:
            collector.add(("vary", k), wrong[k].problem, wrong[k].remedy)
            continue
        found = _variation(collector, entry, k)
        if mission is not None and whole is not None:
            _fits(collector, k, entry, found, mission, whole)
        variations += [] if found is None else [found]
        if by_final_states and found is not None and whole is not None:
            _moves_starts(collector, k, found, whole)
    if by_final_states and mission is not None:
        from rigidfleet.simulation.ensemble import unfit

        if (why := unfit(mission)) is not None:
            collector.add(("evaluate",), why, _WHOLE, "final")
    _same_length(collector, variations)
    if "vary" not in data or data["vary"] == []:
        collector.add(
            ("vary",),
            "nothing varies",
            'for example, give --vary "agents.mass.* *= normal(1, 0.05)"',
        )
    gridded = any(isinstance(v, Gridded) for v in variations)
    if "runs" not in data and variations and not gridded:
        collector.add(("runs",), "is missing", "give the number of runs; only a grid determines it")
    if collector.findings or header is None:
        raise SweepError(collector.findings)
    return header, variations


def _variation(collector: FindingCollector, entry: Any, k: int) -> Variation | None:
    """Check a variation by itself; None if it has errors."""
    before = len(collector.findings)
    model = kind(collector, entry, ("vary", k), KINDS)
    found = None if model is None else collector.validate(model, entry, ("vary", k))
    if found is None or len(collector.findings) > before:
        return None
    if (problem := found.wrong()) is not None:
        key, *words = problem
        collector.add(("vary", k, key), *words, getattr(found, key))
        return None
    return found


def _fits(
    collector: FindingCollector,
    k: int,
    entry: Any,
    v: Variation | None,
    mission: Mission,
    whole: dict[str, Any],
) -> None:
    """Check that the path of a variation exists in the mission and can take its values."""
    path = v.path if v is not None else entry.get("path") if isinstance(entry, dict) else None
    if not isinstance(path, str):
        return
    where = ("vary", k, "path")
    try:
        places = keypaths.expand(whole, path)
    except keypaths.PathError as error:
        collector.add(where, error.problem, error.remedy, path)
        return
    if v is None:
        return
    values = getattr(v, "values", None)
    numeric = values is None or all(map(is_number, values))
    for word in values or ():
        if remedy := next(filter(None, (successor(keys[-1], word) for keys in places)), ""):
            collector.add(("vary", k, "values"), "is no value of the mission format", remedy, word)
    for keys in places:
        leaves = keypaths.numbers(keypaths.look_up(whole, keys))
        absent = any(x is None for x in leaves)
        table = next((x for x in leaves if isinstance(x, dict)), None)
        if table is not None:
            collector.add(
                where,
                "is a table",
                f"continue the path with one of its keys: {', '.join(table)}",
                path,
            )
        elif absent and v.change != "set":
            collector.add(
                where,
                f"the mission has no value to {v.change} to",
                "set the value, or write one in the mission",
                path,
            )
        elif absent:
            _taken(collector, where, v, keys, mission, whole)
        elif numeric and not all(map(is_number, leaves)):
            remedy = "vary it by a choice or grid of words"
            collector.add(
                where, f"has the value {leaves[0]!r}, which is not a number", remedy, path
            )


def _same_length(collector: FindingCollector, variations: list[Variation]) -> None:
    """Check that grids of a group have as many values."""
    sizes: dict[str, int] = {}
    for k, v in enumerate(variations):
        if isinstance(v, Gridded) and v.group:
            size = sizes.setdefault(v.group, len(v.grid))
            if len(v.grid) != size:
                problem = f"has a grid of {len(v.grid)} values here, and one of {size} before"
                remedy = "give all grids of a group as many values"
                collector.add(("vary", k, "group"), problem, remedy, v.group)


def _moves_starts(collector: FindingCollector, k: int, v: Variation, whole: dict[str, Any]) -> None:
    """Check that a variation changes only start states, as the evaluation of final states requires."""
    values = getattr(v, "values", ())
    starts = ("agents", "position"), ("agents", "velocity")
    try:
        places = keypaths.expand(whole, v.path)
    except keypaths.PathError:
        return  # already reported
    if any(keys[:2] not in starts for keys in places) or not all(map(is_number, values)):
        problem = (
            "with final states alone, only numbers in agents.position and agents.velocity can vary"
        )
        collector.add(("vary", k, "path"), problem, f"remove it, or {_WHOLE}", v.path)


def _taken(
    collector: FindingCollector,
    where: Keys,
    v: Variation,
    keys: Keys,
    mission: Mission,
    whole: dict[str, Any],
) -> None:
    """Check that the mission accepts a value for a key that it does not have."""
    middle = v.quantile(0.5) if isinstance(v, Drawn) else v.grid[0] if isinstance(v, Gridded) else 0
    document = mission.to_dict()
    apply(document, whole, SweepColumn(v, keys, None), middle)
    try:
        Mission.from_dict(document)
    except MissionError as error:
        first = error.findings[0]
        problem = f"the mission does not accept a value: {first.key} {first.problem}"
        collector.add(where, problem, first.remedy, v.path)
