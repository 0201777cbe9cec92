"""Definition of a sweep: a mission, its variations, the number of runs and a seed. It is checked as a whole.

Run k depends only on the definition and on k: its grid point is k modulo the size of the grid, and its random numbers
come from a separate Philox stream, keyed by (seed, k). So does its seed of noise and gusts, if each run has its own.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from os.path import commonprefix
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, Strict

from rigidfleet._common.arguments import as_path
from rigidfleet._common.reading import READING
from rigidfleet._common.renamed import rename_hint, with_earlier_members
from rigidfleet._version import __version__
from rigidfleet.errors import MissionError, RigidfleetError, SweepError, wrong_type
from rigidfleet.mission import Mission, load_mission, mission_names
from rigidfleet.mission.findings import FindingCollector, Keys, look_up, unknown_key_in_words
from rigidfleet.mission.loading import as_mission
from rigidfleet.mission.text import parse_toml, read_text
from rigidfleet.mission.values import Part, key, required_key
from rigidfleet.sweep import controllers, faults, keypaths
from rigidfleet.sweep.faults import Drill
from rigidfleet.sweep.variation import (
    VARIATIONS,
    Gridded,
    NotationError,
    Variation,
    is_number,
    parse_variation,
)

#: Remedy if final states cannot be evaluated alone.
_STARTS = ("agents", "position"), ("agents", "velocity")
_WHOLE = 'evaluate whole flights: evaluate = "flight", no --final-states'
#: Smallest fraction at which a distribution is evaluated, so that no normal number is infinite.
_LEAST = 2.0**-54
#: Greatest number of runs.
_RUNS = 10**8
#: Tables with seeds of random numbers.
_SEEDED = ("disturbances", "noise"), ("disturbances", "gusts"), ("network",), ("avoidance",)


class SweepHeader(Part):
    """Keys at the top of a sweep file."""

    mission: str = required_key(
        "a shipped mission, or the path of a mission file relative to this file"
    )
    runs: Annotated[int, Strict(), Field(ge=1, le=_RUNS)] | None = key(
        "number of runs; default: one per point of the grid"
    )
    seed: Annotated[int, Strict(), Field(ge=0, lt=2**63)] = key("seed of the random numbers", 0)
    evaluate: Literal["flight", "final"] = key(
        "flight: evaluate whole flights; final: evaluate only the final states of phases, thousands of runs per second,"
        " for open-loop missions with varied start states",
        "flight",
    )
    random_numbers: Literal["shared", "own"] = key(
        "of noise, gusts and network: shared: every run has the seeds of the mission, so that runs differ only in what"
        " varies; own: each run has a seed of its own",
        "shared",
    )
    controller: str = key(
        "controller of your own, MODULE:NAME: a function of an observation, or a class, of which each run has a new"
        " object; default: the laws of the mission",
        "",
    )
    rate: Annotated[float, Strict(), Field(gt=0, le=1e6)] = key(
        "rate at which the controller is called [Hz]", 50.0
    )
    agent: str = key(
        "law of each vehicle's own, MODULE:NAME: a function of what it knows, or a class, of which each vehicle has a"
        " new object; for missions with [network]; default: the laws of the mission",
        "",
    )
    drill: Drill | None = key("faults of the day, in turn, instead of what varies: [drill]")

    @property
    def law_key_and_name(self) -> tuple[str, str]:
        """Key of the user's law and its name; the name is "" if the laws of the mission fly."""
        return ("agent", self.agent) if self.agent else ("controller", self.controller)


@dataclass(frozen=True)
class SweepColumn:
    """A number that varies: its variation, and its place in the mission."""

    variation: Variation
    keys: Keys

    @property
    def name(self) -> str:
        """Path of the number, counted from 1."""
        return keypaths.path_of_keys(self.keys)

    @property
    def has_order(self) -> bool:
        """Whether its values have an order; those of seeds have none."""
        return self.variation.is_numeric and self.keys[-1] != "seed"


@with_earlier_members(document="mission_document", varied="document_of_run")
class Sweep:
    """A checked sweep. Create one by `Sweep.of`, or from a file by `Sweep.load`.

    Attributes
    ----------
    mission : the mission to vary
    variations : its variations
    header : its other keys
    runs : number of runs
    seed : seed of the random numbers
    name : name of the sweep
    evaluate : what is evaluated of each run: "flight" or "final"
    drill : the faults of a drill, which are its cases; None: what varies does so in the mission
    """

    def __init__(
        self, mission: Mission, variations: Sequence[Variation], header: SweepHeader, name: str
    ) -> None:
        self.mission, self.variations, self.header = mission, tuple(variations), header
        self.seed, self.name, self.evaluate = header.seed, name, header.evaluate
        self.drill = header.drill
        trials = self.drill.trials if self.drill else 1
        self.runs = header.runs or trials * math.prod(self.grid_sizes.values())
        if self.runs > _RUNS:
            raise RigidfleetError(f"the grid has {self.runs:,} points: give runs, or fewer values.")

    @classmethod
    def of(
        cls,
        mission: Mission | str | Path,
        vary: Iterable[str | Mapping[str, Any]],
        *,
        name: str = "",
        origin: str = "sweep",
        **keys: Any,
    ) -> Self:
        """Define a sweep of a mission, given as a `Mission`, a shipped name or a path.

        Parameters
        ----------
        vary : variations, each a line such as `agents.mass.* *= normal(1, 0.05)` or a table
        name : name of the sweep; default: the name of the mission, of a drill with "-drill" behind it
        origin : name of the sweep in messages
        runs : number of runs; default: one per point of the grid
        seed : seed of the random numbers; default: 0
        evaluate : "flight", or "final" to evaluate only the final states of phases, for open-loop missions with
            varied start states
        random_numbers : "shared": noise and gusts of every run have the seeds of the mission; "own": each run has a
            seed of its own
        controller : a controller of your own, "MODULE:NAME" of a function, or of a class, of which each run has a new
            object; the module is installed or in the current folder
        rate : rate at which the controller is called [Hz]; default: 50
        agent : a law of each vehicle's own, "MODULE:NAME" of a function, or of a class, of which each vehicle has a
            new object; see `simulate`
        drill : faults of the day, as the table `[drill]` of a sweep file; nothing else varies then

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
        data = {"mission": mission.name, "vary": list(vary), **keys}
        variations, header = _SweepDraft(data, origin, mission).variations_and_header()
        ending = "" if header.drill is None else "-drill"
        return cls(mission, variations, header, name or mission.name + ending)

    @classmethod
    def load(cls, path: str | Path, *, more: Iterable[str] = (), **keys: Any) -> Self:
        """Read a sweep file.

        Parameters
        ----------
        more : lines of additional variations
        keys : replace those at the top of the file: runs, seed, evaluate, random_numbers, controller, rate, agent,
            drill

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
        if isinstance(data.get("drill"), dict):
            keys["drill"] = data["drill"] | (keys.get("drill") or {})
        data |= {key: value for key, value in keys.items() if value is not None}
        if isinstance(own := data.get("vary", []), list):
            data["vary"] = [*own, *more]
        controllers.add_module_folder(path.parent)
        variations, header = _SweepDraft(data, origin, mission).variations_and_header()
        assert mission is not None  # otherwise the check has raised
        if header.drill:
            drill = header.drill.with_files_in_folder(path.parent)
            header = header.model_copy(update={"drill": drill})
        return cls(mission, variations, header, path.stem)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Restore a sweep from the output of `json`."""
        data = json.loads(text)
        variations = [VARIATIONS[entry["kind"]].model_validate(entry) for entry in data["vary"]]
        mission = Mission.from_toml(data["mission"], "mission of the sweep")
        header = {key: data[key] for key in SweepHeader.model_fields if key in data}
        return cls(mission, variations, SweepHeader.model_validate(header), data["name"])

    def json(self) -> str:
        """Return the definition as JSON text, including the mission."""
        return json.dumps(self._definition_data(), ensure_ascii=False)

    @property
    def identity(self) -> dict[str, Any]:
        """Everything on which a run depends besides its number. The number of runs is not included: it may grow."""
        data = self._definition_data()
        del data["runs"], data["name"]
        files = {"code": self.law[1], "files": self.drill.files_digest if self.drill else ""}
        return data | {"version": __version__} | {key: x for key, x in files.items() if x}

    @cached_property
    def law(self) -> tuple[Any, str]:
        """The user's controller or law, or its class, with a digest of its file; None if the mission's laws fly.

        Raises
        ------
        RigidfleetError
            It cannot be imported.
        """
        key, name = self.header.law_key_and_name
        if not name:
            return None, ""
        try:
            return controllers.import_law_and_digest(name)
        except ImportError as error:
            raise RigidfleetError(f"{key}: {error}\n    {controllers.REMEDY}") from error

    @property
    def version(self) -> str:
        """What flies it: the version of rigidfleet, and the user's controller."""
        name = self.header.law_key_and_name[1]
        law = f" with {name} {self.law[1][:8]}" if name else ""
        return f"rigidfleet {__version__}{law}"

    @property
    def has_random_flights(self) -> bool:
        """Whether the first run has random numbers: of noise, gusts, network or sensing."""
        tables = (*_SEEDED[:3], ("avoidance", "sensing_noise"))
        return any(look_up(self.document_of_run(0), keys) for keys in tables)

    @property
    def mission_document(self) -> dict[str, Any]:
        """The mission as plain data, as written."""
        return self.mission.to_dict()

    @cached_property
    def whole(self) -> dict[str, Any]:
        """The mission as plain data with all defaults."""
        return keypaths.whole_document(self.mission)

    @cached_property
    def columns(self) -> list[SweepColumn]:
        """All numbers that vary, in order."""
        if self.drill:  # whose cases are none of the mission
            return [SweepColumn(v, tuple(v.path.split("."))) for v in self.variations]
        places = ((v, keypaths.expand_path(self.whole, v.path)) for v in self.variations)
        return [SweepColumn(v, keys) for v, there in places for keys in there]

    @cached_property
    def grid_sizes(self) -> dict[str | int, int]:
        """Number of values of each grid, by its column, or by its group if it has one; in order of first occurrence."""
        grids = {_group_or_number(c, k): c.variation.grid for k, c in enumerate(self.columns)}
        return {axis: len(grid) for axis, grid in grids.items() if grid}

    def values(self, run: int) -> list[Any]:
        """Value of every column in a run; runs count from 0."""
        stream = np.random.Philox(np.random.SeedSequence(self.seed, spawn_key=(run,)))
        drawn = sum(not column.variation.grid for column in self.columns)
        fractions = np.maximum(np.random.Generator(stream).random(drawn), _LEAST).tolist()
        point, places = run, {}
        for axis, size in reversed(self.grid_sizes.items()):  # the last grid varies fastest
            point, places[axis] = divmod(point, size)
        return [
            grid[places[_group_or_number(c, k)]]
            if (grid := c.variation.grid)
            else c.variation.quantile(fractions.pop(0))
            for k, c in enumerate(self.columns)
        ]

    def document_of_run(
        self, run: int, values: Sequence[Any] | None = None, mission: Mission | None = None
    ) -> dict[str, Any]:
        """The mission of a run as plain data, not yet checked.

        ``values`` are those of the run, if they are known; ``mission`` is that of the sweep with its ways, if it has
        some.
        """
        varied = {column.keys for column in self.columns}
        document, values = (mission or self.mission).to_dict(), values or self.values(run)
        if self.drill:
            stream = faults.random_stream(self.seed, run, 2)
            faults.apply_fault(document, *values[:2], stream, self.mission.n_agents, self._end_time)
        for column, value in zip(self.columns, values, strict=True) if not self.drill else ():
            apply_value(document, self.whole, column, value)
        if self.header.random_numbers == "own":
            stream = np.random.SeedSequence(self.seed, spawn_key=(run, 1))
            seed = int(stream.generate_state(1)[0] >> 1)
            for keys in _SEEDED:
                table = look_up(document, keys)
                if table is not None and (*keys, "seed") not in varied:
                    table["seed"] = seed
        return document

    def mission_of(self, run: int, values: Sequence[Any] | None = None) -> Mission:
        """The mission of a run, with its ``values``, if they are known.

        Raises
        ------
        MissionError
            It has errors.
        """
        if self._mission_with_ways is not self.mission:
            with suppress(MissionError):  # errors are told of the mission as written
                document = self.document_of_run(run, values, self._mission_with_ways)
                return Mission.from_plain(document, f"run {run}")
        return Mission.from_plain(self.document_of_run(run, values), f"run {run}")

    @cached_property
    def _mission_with_ways(self) -> Mission:
        """The mission with phases for its transitions and ways if nothing that varies matters to them, else as written.

        Then they are searched once for all runs. The start is such a key, too.
        """
        from rigidfleet.planning.timing import can_affect_plan, expand_mission

        if any(can_affect_plan(self.mission, column.keys) for column in self.columns):
            return self.mission
        with suppress(MissionError):  # without a way, each run says so
            return expand_mission(self.mission)
        return self.mission

    @cached_property
    def _end_time(self) -> float:
        """Time [s] at which the mission is expected to end."""
        from rigidfleet.planning.legs import phase_spans
        from rigidfleet.planning.timing import complete_times

        return phase_spans(complete_times(self.mission))[-1][1]

    def _definition_data(self) -> dict[str, Any]:
        return self.header.model_dump(exclude_defaults=True) | {
            "name": self.name,
            "mission": self.mission.text,
            "vary": [v.model_dump() for v in self.variations],
            "runs": self.runs,
            "seed": self.seed,
            "evaluate": self.evaluate,
        }


def _group_or_number(column: SweepColumn, number: int) -> str | int:
    """What grids share that take their values together: their group, or the column's own number."""
    return getattr(column.variation, "group", "") or number


@lru_cache(maxsize=4)
def sweep_of_json(text: str) -> Sweep:
    """Restore a sweep from its JSON; kept for the next chunks, which would find its ways again (1.4 s)."""
    return Sweep.from_json(text)


def is_sweep_file(path: str | Path) -> bool:
    """Whether a file is a sweep file, not a mission file: it has the key `mission`."""
    try:
        return "mission" in parse_toml(read_text(path), str(path))
    except MissionError:
        return False


def apply_value(
    document: dict[str, Any], whole: Mapping[str, Any], column: SweepColumn, value: Any
) -> None:
    """Apply a value of a column to a document; all numbers at its place change alike."""
    there = keypaths.flatten_lists(look_up(whole, column.keys))
    integral = all(isinstance(x, int) for x in there)

    def new_number(there: Any) -> Any:
        new = column.variation.changed_value(there, value)
        return round(new) if integral and math.isfinite(new) else new

    def new_value(there: Any) -> Any:
        return keypaths.map_nested_lists(there, new_number) if is_number(value) else value

    keypaths.replace_value(document, whole, column.keys, new_value)


# -- the check ---------------------------------------------------------------------------------------


class _SweepDraft:
    """A sweep under check: its data, the mission that varies, unless it cannot be read, and what is wrong.

    Attributes
    ----------
    whole : the mission as plain data with all defaults
    lacked : places of keys that the mission does not have, each with the number of its variation
    """

    def __init__(self, data: dict[str, Any], origin: str, mission: Mission | None) -> None:
        self.data = {key: value for key, value in data.items() if value is not None}
        if isinstance(entries := self.data.get("vary"), list):
            self.data["vary"] = [*entries]  # in which tables replace the lines that stand for them
        self.collector, self.mission = FindingCollector(self.data, origin), mission
        self.add = self.collector.add
        self.whole = {} if mission is None else keypaths.whole_document(mission)
        self.lacked: list[tuple[int, SweepColumn]] = []

    def variations_and_header(self) -> tuple[list[Variation], SweepHeader]:
        """Variations and header.

        Raises
        ------
        SweepError
            With a finding for each error.
        """
        known = [*SweepHeader.model_fields, "vary"]
        for name in self.data:
            if name not in known:
                self.add((name,), *unknown_key_in_words(name, known))
        own = {key: value for key, value in self.data.items() if key in SweepHeader.model_fields}
        header = self.collector.validate(SweepHeader, own, ())
        if "drill" not in self.data:
            variations = self._check_variations(header)
        else:
            variations = [] if header is None else self._drill_cases(header.drill or Drill())
        if self.collector.findings or header is None:
            raise SweepError(self.collector.findings)
        return variations, header

    def _drill_cases(self, drill: Drill) -> list[Variation]:
        """The cases of a drill; nothing else varies."""
        for name, default in (("vary", []), ("evaluate", "flight")):
            if self.data.get(name, default) != default:
                self.add((name,), "has no effect on a drill", "remove it, or [drill]")
        if drill.files and (flown := drill.model_fields_set & faults.IN_FLIGHT.keys()):
            self.add(("drill", *flown), "needs a mission that is flown", "remove it, or files")
        if not drill.files and all(map(faults.names_mission, drill.stale)):
            for name in drill.model_fields_set.intersection(READING):
                self.add(("drill", name), "has no effect without files", "remove it, or give files")
        if drill.links and self.mission is not None and self.mission.network is None:
            problem = "has no effect: without [network], one law knows all states"
            self.add(("drill", "links"), problem, "remove it, or add [network] to the mission")
        n = 1 if self.mission is None else self.mission.n_agents
        for name, most in faults.max_fault_sizes(n).items():
            if name in drill.model_fields_set and max(getattr(drill, name), default=0) > most:
                self.add(("drill", name), f"is too much for {n} vehicles", f"give at most {most}")
        grids = drill.case_grids(n)
        if not (grids or self.collector.findings):
            self.add(("drill",), "has no magnitude", "give some, such as late = [1, 2]")
        return grids

    def _check_variations(self, header: SweepHeader | None) -> list[Variation]:
        """What varies, by grids or distributions, and whether it suits the mission and the other keys."""
        by_final_states = header is not None and header.evaluate == "final"
        variations: list[Variation] = []
        for k, entry in enumerate(self.collector.tables("vary")):
            variation = self._check_variation(k, entry)
            path = look_up(self.data, ("vary", k, "path"))
            if self.mission is not None and isinstance(path, str):
                self._check_varied_path(k, path, variation, starts=by_final_states)
            variations += [] if variation is None else [variation]
        if by_final_states and self.mission is not None:
            from rigidfleet.simulation.ensemble import why_unfit_for_establish

            if (why := why_unfit_for_establish(self.mission)) is not None:
                self.add(("evaluate",), why, _WHOLE, "final")
        if self.mission is not None:
            self._check_values_of_new_keys(self.mission)
        if header is not None and header.law_key_and_name[1]:
            self._check_law_import(*header.law_key_and_name, header)
        if "rate" in self.data and not self.data.get("controller"):
            self.add(("rate",), "is that of a controller", "give a controller, or remove rate")
        self._check_groups(variations)
        if self.data.get("vary", []) == []:
            remedy = 'for example, give --vary "agents.mass.* *= normal(1, 0.05)"'
            self.add(("vary",), "nothing varies", remedy)
        gridded = any(v.grid for v in variations)
        if "runs" not in self.data and variations and not gridded:
            self.add(("runs",), "is missing", "give the number of runs; only a grid determines it")
        return variations

    def _check_variation(self, k: int, entry: Any) -> Variation | None:
        """Check a variation by itself; None if it has errors."""
        where, before = ("vary", k), len(self.collector.findings)
        if isinstance(entry, str):
            try:
                entry = self.data["vary"][k] = parse_variation(entry)
            except NotationError as error:
                self.add(where, error.problem, error.remedy)
                return None
        model = self.collector.model_class_of_kind(entry, where, VARIATIONS)
        variation = None if model is None else self.collector.validate(model, entry, where)
        if variation is None or len(self.collector.findings) > before:
            return None
        if problem := variation.key_problem_and_remedy():
            key, *words = problem
            self.add((*where, key), *words, getattr(variation, key))
            return None
        return variation

    def _check_varied_path(self, k: int, path: str, v: Variation | None, *, starts: bool) -> None:
        """Check that the path of a variation exists in the mission and can take its values.

        With ``starts``, only start states can vary.
        """
        where = ("vary", k, "path")
        try:
            places = keypaths.expand_path(self.whole, path)
        except NotationError as error:
            self.add(where, error.problem, error.remedy, path)
            return
        if v is None:
            return
        for word in getattr(v, "values", ()):
            if remedy := next(filter(None, (rename_hint(keys[-1], word) for keys in places)), ""):
                self.add(("vary", k, "values"), "is no value of the mission format", remedy, word)
        for keys in places:
            leaves = keypaths.flatten_lists(look_up(self.whole, keys))
            absent = any(x is None for x in leaves)
            table = next((x for x in leaves if isinstance(x, dict)), None)
            words = [x for x in leaves if not is_number(x)]
            if table is not None:
                problem = "is a table"
                remedy = f"continue the path with one of its keys: {', '.join(table)}"
            elif absent and v.change != "set":
                problem = f"the mission has no value to {v.change} to"
                remedy = "set the value by =, or write one in the mission"
            elif v.is_numeric and words and not absent:
                problem = f"has the value {words[0]!r}, which is not a number"
                remedy = f"vary it by a choice or grid of words, as grid({json.dumps(words[0])})"
            elif starts and not (v.is_numeric and keys[:2] in _STARTS):
                problem = "with final states alone, only numbers in agents.position and agents.velocity can vary"
                remedy = f"remove it, or {_WHOLE}"
            else:
                if absent or keypaths.is_in_absent_table(self.whole, keys):
                    self.lacked.append((k, SweepColumn(v, keys)))
                continue
            self.add(where, problem, remedy, path)

    def _check_values_of_new_keys(self, mission: Mission) -> None:
        """Check that the mission accepts values for the keys that it does not have, all of them together."""
        document = mission.to_dict()
        for _, column in self.lacked:
            v = column.variation
            value = v.grid[0] if v.grid else v.quantile(0.5)
            apply_value(document, self.whole, column, value)
        try:
            Mission.from_plain(document, "<dict>")
        except MissionError as error:
            for finding in error.findings:
                names = [[c.name, finding.key.replace("[", ".")] for _, c in self.lacked]
                near = [len(commonprefix(pair)) for pair in names]  # noqa: RUF071
                k, column = self.lacked[near.index(max(near))]
                problem = f"the mission does not accept a value: {finding.key} {finding.problem}"
                remedy = f"in the mission, {finding.remedy}"
                self.add(("vary", k, "path"), problem, remedy, column.variation.path)

    def _check_law_import(self, key: str, name: str, header: SweepHeader) -> None:
        """Check that the user's law can be imported, and suits the mission."""
        try:
            controllers.import_law_and_digest(name)
        except ImportError as error:
            self.add((key,), str(error), controllers.REMEDY)
        if header.evaluate == "final":
            self.add((key,), "does not act on final states alone", _WHOLE)
        if key == "agent" and self.mission is not None and self.mission.network is None:
            self.add((key,), "needs a network", "add [network] to the mission, or remove agent")
        if key == "agent" and header.controller:
            self.add((key,), "does not go with a controller", "give one of them")

    def _check_groups(self, variations: list[Variation]) -> None:
        """Check that grids of a group have as many values."""
        sizes: dict[str, int] = {}
        for k, v in enumerate(variations):
            if isinstance(v, Gridded) and v.group:
                size = sizes.setdefault(v.group, len(v.grid))
                if len(v.grid) != size:
                    problem = f"has a grid of {len(v.grid)} values here, and one of {size} before"
                    remedy = "give all grids of a group as many values"
                    self.add(("vary", k, "group"), problem, remedy, v.group)
