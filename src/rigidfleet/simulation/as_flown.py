"""The mission that was flown, if its phases differ from those given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

from rigidfleet.errors import Finding, MissionError, wrong_type
from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.findings import suggest
from rigidfleet.mission.kinds import AnyPhase
from rigidfleet.mission.losses import ON_LOSS
from rigidfleet.planning.timing import legs_up_to
from rigidfleet.planning.transitions import expand_phases
from rigidfleet.result import PhaseRecord


def mission_as_flown(
    mission: Mission, begun: Sequence[Phase], flown: Sequence[PhaseRecord], step: float
) -> tuple[Mission, list[PhaseRecord]]:
    """The mission with the phases ``flown`` by hand, and their records under its names.

    If they make no valid mission (in a flight by hand, slots and distances may contradict each other), the mission
    keeps its own phases, so that the record of the flight is not lost.

    Parameters
    ----------
    begun : each phase as it was begun
    step : between samples [s]
    """
    records = _make_names_unique(flown)
    data = mission.to_dict()
    data.pop("source", None)  # it no longer reproduces a figure
    data["name"] = f"{mission.name.removesuffix('-live')}-live"
    data["title"] = f"{mission.title or mission.name}, flown by hand"
    own = data.get("obstacles", [])
    pushed = mission.obstacles[len(own) :]  # in flight, by hand
    if pushed:
        tables = [thing.model_dump(mode="json", exclude_unset=True) for thing in pushed]
        data["obstacles"] = [*own, *tables]
    try:
        changed = data | _changes_as_flown(mission, begun, records, step)
        return mission.rewritten(changed, "<dict>"), records
    except MissionError:
        return mission.rewritten(data, "<dict>"), records


def phase_of_table(
    mission: Mission, begun: Sequence[Phase], flown: Sequence[PhaseRecord], table: Mapping[str, Any]
) -> Phase:
    """The phase given as a table of a mission file, checked after the phases flown so far.

    Raises
    ------
    MissionError
        The table has errors.
    """
    data = mission.to_dict()
    if flown:
        # Names may repeat: those of phases before are not the new one's business.
        before = [replace(record, name=f"before {k}") for k, record in enumerate(flown, start=1)]
        data |= _changes_as_flown(mission, begun, before, mission.output_step)
    else:
        data["phases"] = []
    data["phases"] = [*data["phases"], dict(table)]
    made = Mission.from_dict(data, "begin()")
    if not made.phases[-1].flown_as_written:
        spread = expand_phases(made, legs_up_to)[0]
        if len(spread.phases) == len(made.phases):  # with the ways that were found
            made = spread
    _refuse_expanded_phase(made.phases[-1])
    return made.phases[-1]


def _refuse_expanded_phase(phase: Phase) -> None:
    """See that a phase has a flight of its own."""
    if phase.replaced:
        problem = "finds its way before the flight, and cannot begin by hand"
        remedy = "use kind 'fly', or put it into the mission"
        raise MissionError([Finding("begin()", "kind", phase.kind, problem, remedy)])
    if not phase.flown_as_written:
        vertical = phase.vertical
        key = "transition" if vertical is None else "stagger" if vertical.stagger else "places"
        problem = "is flown as several phases, and cannot begin by hand"
        remedy = "begin one phase after the other, each with its agents or formation, or put it into the mission"
        raise MissionError([Finding("begin()", key, getattr(phase, key), problem, remedy)])


def check_phase_can_begin(mission: Mission, phase: Phase) -> None:
    """See that a phase is one, and that the mission has its formation.

    Raises
    ------
    TypeError
        It is no phase.
    MissionError
        The mission has no such formation, the formation has no slots to track, or the phase has no flight of its own.
    """
    # What a script gives may be anything.
    if not isinstance(phase, AnyPhase):
        raise wrong_type(
            "a phase (a table as in a mission file, or one of a mission's phases)", phase
        )
    _refuse_expanded_phase(phase)
    shaping = phase.shaping
    if shaping is None:
        return
    name, known, problem = shaping.formation, mission.formations, ""
    if name not in known:
        problem = "there is no such formation"
        remedy = suggest(name, known) or f"formations: {', '.join(known)}"
    elif phase.tracks_slots and mission.formation_slots(name) is None:
        problem = "has no slots to track"
        remedy = "give it a shape or slots, or use another control"
    if problem:
        raise MissionError([Finding("begin()", "formation", name, problem, remedy)])


def _make_names_unique(flown: Sequence[PhaseRecord]) -> list[PhaseRecord]:
    """Records of phases with unique names."""
    taken = {record.name for record in flown}
    seen: set[str] = set()
    records = []
    for record in flown:
        others = (f"{record.name} ({k})" for k in count(2))
        free = (name for name in others if name not in seen | taken)
        name = next(free) if record.name in seen else record.name
        seen.add(name)
        records.append(replace(record, name=name))
    return records


def _changes_as_flown(
    mission: Mission, begun: Sequence[Phase], records: Sequence[PhaseRecord], step: float
) -> dict[str, Any]:
    """What differs from the data of a mission with these phases in place of its own."""
    data, own, end = dict[str, Any](), mission.to_dict(), records[-1].t_end
    data["output_step"] = min(step, end)
    if mission.assignment != "given":
        # The assignment of agents to slots followed from phases that were not flown.
        data["assignment"] = "given"
        data["formations"] = {name: _formation_table(mission, name) for name in mission.formations}
    data["phases"] = [_phase_toml_table(*each) for each in zip(begun, records, strict=True)]
    if options := own.get("abort"):  # what followed from an order is among the phases
        data["abort"] = {key: x for key, x in options.items() if key != "at"}
    if disturbed := own.get("disturbances"):
        # What followed from a loss is among the phases
        kept = {key: x for key, x in disturbed.items() if key not in ("on_loss", *ON_LOSS)}
        data["disturbances"] = kept
    if net := own.get("network"):
        data["network"] = dict(net)
    for table in (data.get("disturbances", {}), data.get("network", {})):
        if "lost" in table:
            table["lost"] = [lost for lost in table["lost"] if lost["time"] < end]
    return data


def _phase_toml_table(phase: Phase, record: PhaseRecord) -> dict[str, Any]:
    """A phase as a mission file holds it, from its start to its actual end."""
    keys = phase.model_dump(mode="json", exclude_unset=True)
    for key in ("duration", "settle"):
        keys.pop(key, None)
    table: dict[str, Any] = {"kind": record.kind, "name": record.name, "until": record.t_end}
    table = keys | table | {"control": record.control}
    return table | phase.keys_if_ended(record.t_end - record.t_start)


def _formation_table(mission: Mission, name: str) -> dict[str, Any]:
    """A formation with its slots and edges in the order of the agents."""
    edges = (mission.formation_edges(name) + 1).tolist()
    kept = {"distances", "dimension", "tolerance", "tolerance_share"}
    rest = mission.formations[name].model_dump(include=kept, exclude_defaults=True)
    return {"slots": mission.formation_slots(name), "edges": edges} | rest
