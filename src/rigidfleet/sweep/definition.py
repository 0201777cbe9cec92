"""What a sweep is: a mission, what varies in it, how many runs, and a seed; checked as a whole on entry.

Run k depends on the definition and on k alone: its point of the grid is k modulo the size of the grid,
and its random numbers come from a Philox stream of its own, keyed by (seed, k).
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, Strict

from rigidfleet import __version__
from rigidfleet.errors import Finding, MissionError, SweepError
from rigidfleet.mission import Mission, load_mission, mission_names
from rigidfleet.mission.model import parse_toml, read_text
from rigidfleet.mission.notes import Keys, Notes, unknown_key
from rigidfleet.mission.phases import kind, tables
from rigidfleet.mission.schema import Part
from rigidfleet.sweep import paths
from rigidfleet.sweep.variation import KINDS, Drawn, Gridded, Variation, from_line, is_number

#: Least fraction of a distribution, so that no normal number is infinite.
_LEAST = 2.0**-54


class Header(Part):
    """Keys at the top of a sweep file."""

    mission: str = Field(
        description="a shipped mission, or the path of a mission file as seen from this one"
    )
    runs: Annotated[int, Strict(), Field(ge=1, le=10**9)] | None = Field(
        None, description="how many runs; when absent, one for each point of the grid"
    )
    seed: Annotated[int, Strict(), Field(ge=0, lt=2**63)] = Field(
        0, description="seed of the random numbers"
    )


@dataclass(frozen=True)
class Column:
    """One number that varies: what varies it, and where in the mission."""

    variation: Variation
    keys: Keys

    @property
    def name(self) -> str:
        """Its path, counted from 1."""
        return paths.name_of(self.keys)


class Sweep:
    """A checked sweep: make one by `Sweep.of`, or `Sweep.load` from a file.

    Attributes
    ----------
    mission : the mission that varies
    variations : what varies in it
    runs : number of runs
    seed : of the random numbers
    name : what to call it
    """

    def __init__(
        self,
        mission: Mission,
        variations: Sequence[Variation],
        runs: int | None,
        seed: int,
        name: str,
    ) -> None:
        self.mission, self.variations = mission, tuple(variations)
        self.seed, self.name = seed, name
        axes = (c.variation for c in self.columns)
        self.runs = runs or math.prod(len(v.grid) for v in axes if isinstance(v, Gridded))

    @classmethod
    def of(
        cls,
        mission: Mission | str | Path,
        vary: Iterable[str | Mapping[str, Any]],
        *,
        runs: int | None = None,
        seed: int = 0,
        name: str = "",
        origin: str = "sweep",
    ) -> Self:
        """A sweep of a mission, or of one by its name or path.

        Parameters
        ----------
        vary : a line for each variation, as `agents.mass.* *= normal(1, 0.05)`, or its table
        runs : one for each point of the grid when absent
        seed : of the random numbers
        name : that of the mission when absent
        origin : what messages call the sweep

        Raises
        ------
        SweepError
            With a finding for each error of the sweep.
        MissionError
            The mission is wrong.
        """
        if not isinstance(mission, Mission):
            mission = load_mission(mission)
        entries = [from_line(v, origin) if isinstance(v, str) else dict(v) for v in vary]
        wrong = [entry for entry in entries if isinstance(entry, Finding)]
        data: dict[str, Any] = {"mission": mission.name, "seed": seed}
        data |= {"vary": [entry for entry in entries if not isinstance(entry, Finding)]}
        data |= {} if runs is None else {"runs": runs}
        header, variations = _checked(data, origin, mission, wrong)
        return cls(mission, variations, header.runs, header.seed, name or mission.name)

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        more: Iterable[str] = (),
        runs: int | None = None,
        seed: int | None = None,
    ) -> Self:
        """Read a sweep file.

        Parameters
        ----------
        more : lines of further variations
        runs, seed : in place of the file's

        Raises
        ------
        SweepError
            With a finding for each error of the sweep.
        MissionError
            The file cannot be read, or its mission is wrong.
        """
        path = Path(path)
        origin = str(path)
        data = parse_toml(read_text(path), origin)
        named = data.get("mission")
        mission = None
        if isinstance(named, str):
            shipped = named in mission_names()
            mission = load_mission(named if shipped else path.parent / named)
        data |= {} if runs is None else {"runs": runs}
        data |= {} if seed is None else {"seed": seed}
        entries = [from_line(line, "--vary") for line in more]
        if isinstance(data.get("vary", []), list):
            data["vary"] = data.get("vary", []) + [e for e in entries if isinstance(e, dict)]
        wrong = [entry for entry in entries if isinstance(entry, Finding)]
        header, variations = _checked(data, origin, mission, wrong)
        assert mission is not None  # else the check has raised
        return cls(mission, variations, header.runs, header.seed, path.stem)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """A sweep from what `json` gave."""
        data = json.loads(text)
        variations = [KINDS[entry["kind"]].model_validate(entry) for entry in data["vary"]]
        mission = Mission.from_toml(data["mission"], "mission of the sweep")
        return cls(mission, variations, data["runs"], data["seed"], data["name"])

    def json(self) -> str:
        """All of it as JSON text, with the mission inside."""
        return json.dumps(self._data(), ensure_ascii=False)

    @property
    def identity(self) -> dict[str, Any]:
        """What a run depends on besides its number; further runs may be added to a sweep."""
        data = self._data()
        del data["runs"], data["name"]
        return data | {"version": __version__}

    @cached_property
    def document(self) -> dict[str, Any]:
        """The mission as written."""
        return self.mission.to_dict()

    @cached_property
    def whole(self) -> dict[str, Any]:
        """The mission with every default filled in."""
        return paths.whole_document(self.mission)

    @cached_property
    def columns(self) -> list[Column]:
        """Every number that varies, in order."""
        return [
            Column(v, keys) for v in self.variations for keys in paths.expand(self.whole, v.path)
        ]

    def values(self, run: int) -> list[Any]:
        """Value of every column in a run, counted from 0."""
        drawn = [c for c in self.columns if isinstance(c.variation, Drawn)]
        stream = np.random.Philox(np.random.SeedSequence(self.seed, spawn_key=(run,)))
        fractions = iter(
            np.maximum(np.random.Generator(stream).random(len(drawn)), _LEAST).tolist()
        )
        point, found = run, []
        for column in reversed(self.columns):  # the last grid varies fastest
            v = column.variation
            if isinstance(v, Gridded):
                point, place = divmod(point, len(v.grid))
                found.append(v.grid[place])
            else:
                found.append(None)
        return [
            column.variation.quantile(next(fractions))
            if isinstance(column.variation, Drawn)
            else value
            for column, value in zip(self.columns, reversed(found), strict=True)
        ]

    def varied(self, run: int) -> dict[str, Any]:
        """The document of a run, not checked yet."""
        document = copy.deepcopy(self.document)
        for column, value in zip(self.columns, self.values(run), strict=True):
            apply(document, self.whole, column, value)
        return document

    def _data(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "mission": self.mission.text,
            "vary": [v.model_dump() for v in self.variations],
            "runs": self.runs,
            "seed": self.seed,
        }


@lru_cache(maxsize=4)
def shared(text: str) -> Sweep:
    """A sweep from its JSON, kept for the chunks that follow."""
    return Sweep.from_json(text)


def is_sweep_file(path: str | Path) -> bool:
    """Whether a file is a sweep file and no mission: it names a mission."""
    try:
        return "mission" in parse_toml(read_text(path), str(path))
    except MissionError:
        return False


def apply(document: dict[str, Any], whole: Mapping[str, Any], column: Column, value: Any) -> None:
    """Change a document by a column's value: every number at its place alike."""
    integral = all(isinstance(x, int) for x in paths.numbers(paths.look_up(whole, column.keys)))

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
        return paths.mapped(there, changed) if is_number(value) else value

    paths.change(document, whole, column.keys, replaced)


# -- the check ---------------------------------------------------------------------------------------


def _checked(
    data: dict[str, Any], origin: str, mission: Mission | None, wrong: list[Finding]
) -> tuple[Header, list[Variation]]:
    """Header and variations of a sweep that is in order."""
    notes = Notes(data, origin)
    known = [*Header.model_fields, "vary"]
    for key in data:
        if key not in known:
            notes.add((key,), *unknown_key(key, known))
    own = {key: value for key, value in data.items() if key in Header.model_fields}
    header = notes.validate(Header, own, ())
    variations = []
    for k, entry in enumerate(tables(notes, "vary")):
        model = kind(notes, entry, ("vary", k), KINDS)
        found = None if model is None else notes.validate(model, entry, ("vary", k))
        if found is None or any(f.key.startswith(f"vary[{k + 1}]") for f in notes.findings):
            continue
        variations.append(found)
        if (problem := found.wrong()) is not None:
            notes.add(("vary", k, problem[0]), *problem[1:])
        elif mission is not None:
            _fits(notes, ("vary", k, "path"), found, mission)
    if not data.get("vary") and not wrong:
        notes.add(
            ("vary",), "nothing varies", 'give --vary "agents.mass.* *= normal(1, 0.05)", say'
        )
    gridded = any(isinstance(v, Gridded) for v in variations)
    if "runs" not in data and variations and not gridded and not (notes.findings or wrong):
        notes.add(("runs",), "is missing", "say how many; only a grid has a number of its own")
    if notes.findings or wrong or header is None:
        raise SweepError([*wrong, *notes.findings])
    return header, variations


def _fits(notes: Notes, where: Keys, v: Variation, mission: Mission) -> None:
    """Whether a variation leads somewhere in the mission, and to what it can vary."""
    whole = paths.whole_document(mission)
    try:
        places = paths.expand(whole, v.path)
    except paths.PathError as error:
        notes.add(where, error.problem, error.remedy)
        return
    values = getattr(v, "values", None)
    numeric = values is None or all(map(is_number, values))
    for keys in places:
        at = paths.look_up(whole, keys)
        leaves = paths.numbers(at)
        absent = [x for x in leaves if x is None]
        if any(isinstance(x, dict) for x in leaves):
            inside = leaves[0] if isinstance(leaves[0], dict) else {}
            notes.add(where, "is a table", f"go on to one of its keys: {', '.join(inside)}")
        elif numeric and not absent and not all(map(is_number, leaves)):
            notes.add(
                where, f"is no number, but {leaves[0]!r}", "vary it by choice or grid of words"
            )
        elif absent and v.change != "set":
            notes.add(
                where, f"there is nothing to {v.change} to", "set it, or give it in the mission"
            )
        elif absent:
            _taken(notes, where, v, keys, mission, whole)


def _taken(
    notes: Notes, where: Keys, v: Variation, keys: Keys, mission: Mission, whole: dict[str, Any]
) -> None:
    """Whether a mission takes a value where it has had none."""
    middle = v.quantile(0.5) if isinstance(v, Drawn) else v.grid[0] if isinstance(v, Gridded) else 0
    document = mission.to_dict()
    apply(document, whole, Column(v, keys), middle)
    try:
        Mission.from_dict(document)
    except MissionError as error:
        first = error.findings[0]
        notes.add(where, f"the mission does not take it: {first.key} {first.problem}", first.remedy)
