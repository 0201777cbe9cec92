"""Content of the page, as plain data for its templates."""

from __future__ import annotations

import math
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet import plotting
from rigidfleet._common.quantities import QUANTITIES, quantity, shown
from rigidfleet._common.text import all_hold
from rigidfleet._version import __version__
from rigidfleet.assessment import Safety, Verdict, assess, safety
from rigidfleet.assessment.outcome import value
from rigidfleet.assessment.table import check_row
from rigidfleet.mission import ending, goal
from rigidfleet.plotting.quadrotors import (
    has_rotors,
    rotor_forces,
    rotor_limits,
    tilt,
)
from rigidfleet.plotting.style import clean
from rigidfleet.reporting import gains, overlay
from rigidfleet.result.quantities import samples

if TYPE_CHECKING:
    from rigidfleet.mission import Mission
    from rigidfleet.result import Result

#: Greatest number of vehicles with a row each; of more vehicles, those with the greatest thrust are shown.
_VEHICLES = 24
#: Greatest number of differing mission keys that are shown.
_KEYS = 40
#: Relative difference below which numbers count as the same.
_SAME = 1e-3


def contents(
    flights: Sequence[Result], labels: Sequence[str] | None, verdicts: Sequence[Verdict] | None
) -> dict[str, Any]:
    """Everything on the page.

    Raises
    ------
    ValueError
        There is no flight, or the number of labels or verdicts differs from that of flights.
    """
    if not flights:
        raise ValueError("a report needs a result")
    names = list(labels) if labels is not None else _named(flights)
    judged = list(verdicts) if verdicts is not None else [assess(flight) for flight in flights]
    if not len(names) == len(judged) == len(flights):
        raise ValueError(f"{len(flights)} results need as many labels and verdicts")
    missions = [flight.mission for flight in flights]
    several = len(flights) > 1
    colours = plotting.agent_colours(len(flights))
    found = [_flight(*each) for each in zip(flights, judged, names, colours, strict=True)]
    # Trajectories that others made have no gains.
    controlled = any(flight.interpolation is None for flight in flights)
    response = overlay.response(missions, names) if controlled else None
    return {
        "title": " · ".join(names),
        "several": several,
        "flights": found,
        "figures": [] if several else _figures(flights[0]),
        "passed": all(verdict.passed for verdict in judged),
        "safety": _safety_table(flights, judged),
        "numbers": _numbers(flights, judged) if several else [],
        "keys": _keys(missions) if several else [],
        "overlays": _overlays(flights, names) if several else [],
        "controlled": controlled,
        "response": None if response is None else _embedded(response),
        "version": __version__,
        "covers": _covers(flights),
    }


def _named(flights: Sequence[Result]) -> list[str]:
    """Names of the missions, numbered if a name occurs twice."""
    names = [flight.mission.name for flight in flights]
    count = Counter(names)
    seen: Counter[str] = Counter()
    found = []
    for name in names:
        seen[name] += 1
        found.append(f"{name} ({seen[name]})" if count[name] > 1 else name)
    return found


# -- one flight --------------------------------------------------------------------------------------


def _flight(result: Result, verdict: Verdict, label: str, colour: str) -> dict[str, Any]:
    mission = result.mission
    judged = [check for check in verdict.checks if check.judged]
    failed = [finding for finding in judged if not finding.passed]
    return {
        "label": label,
        "colour": colour,
        "name": mission.name,
        "title": mission.title,
        "source": mission.source,
        "passed": verdict.passed,
        "head": _head(len(judged), len(failed)),
        "words": [f.message for f in failed]
        or [verdict.summary.split("\n")[0].partition("; ")[2] or verdict.covers],
        "notes": [verdict.uncalled, *verdict.notes] if verdict.uncalled else verdict.notes,
        "facts": _facts(result),
        "checks": [_check(check) for check in verdict.checks],
        "phases": _phases(result, verdict),
        "vehicles": _vehicles(result),
        "vehicles_left_out": max(0, result.n_agents - _VEHICLES),
        "summary": _figure(result, "summary"),
        "gains": gains.explained(mission) if result.interpolation is None else [],
        "versions": _versions(result),
        "text": result.mission_text,
    }


def _head(judged: int, failed: int) -> str:
    return f"{failed} of {judged} checks failed" if failed else all_hold(judged)


def _covers(flights: Sequence[Result]) -> str:
    """What the flights are, and what the report does not cover."""
    if all(flight.interpolation is not None for flight in flights):
        return "Others made this flight: its curve is judged, not whether vehicles can fly it."
    if any(flight.rotor_force is not None for flight in flights):
        return "This is a simulation: real vehicles differ from their models."
    return (
        "This is a simulation: vehicles are point masses that produce any thrust vector instantly."
    )


def _facts(result: Result) -> list[tuple[str, str]]:
    mission = result.mission
    mass = sorted(set(mission.agents.mass))
    masses = f"{mass[0]:.4g} kg" if len(mass) == 1 else f"{mass[0]:.4g} to {mass[-1]:.4g} kg"
    forms = [
        f"{name} ({len(mission.formation_edges(name))} edges)" for name in mission.formations
    ]  # fmt: skip
    made = result.created.replace("T", " ").replace("+00:00", " UTC")
    if result.interpolation is not None:
        return [
            ("vehicles", f"{result.n_agents}"),
            ("duration", f"{result.time[-1] - result.time[0]:.4g} s"),
            ("curve", result.interpolation),
            ("read", made),
        ]
    return [
        ("vehicles", f"{result.n_agents}, {masses}{_models(mission)}"),
        ("formations", ", ".join(forms) or "none"),
        ("control", mission.architecture),
        ("duration", f"{result.time[-1]:.4g} s, {len(result.phases)} phases"),
        ("simulated", made),
    ]


def _models(mission: Mission) -> str:
    """Models of vehicles with their number; "" for points."""
    count = Counter(mission.vehicles[name].model for name in mission.agents.vehicle)
    return ": " * bool(count) + ", ".join(f"{n} × {name}" for name, n in count.items())


def _check(finding: Any) -> dict[str, Any]:
    row = [str(x).replace("<=", "≤").replace(">=", "≥") for x in check_row(finding)]
    state = "failed" if not finding.passed else "ok" if finding.judged else ""
    return dict(zip(("name", "worst", "limit", "when", "who"), row, strict=False), state=state)


def _phases(result: Result, verdict: Verdict) -> list[dict[str, str]]:
    planned = {phase.name: phase for phase in result.mission.phases}
    rows = []
    for number, p in enumerate(verdict.phases, start=1):
        phase, w = planned.get(p.name), p.waypoint
        worst = {name: value(e.value) for name, e in p.worst.items()}
        rows.append(
            {
                "number": str(number),
                "name": p.name,
                "kind": p.kind,
                "to": "" if phase is None else goal(phase),
                "ends": "" if phase is None else ending(phase),
                "control": p.control,
                "flown": f"{p.t_start:.2f} to {p.t_end:.2f}",
                "miss": "" if w is None or w.position is None else value(w.position),
                "shape": "" if p.shape is None else value(p.shape),
                **{k: worst.get(k, "") for k in ("separation", "clearance", "thrust", "speed")},
            }
        )
    return rows


def _vehicles(result: Result) -> list[dict[str, Any]]:
    """Extremes of each vehicle; if there are too many, of those with the greatest thrust."""
    n, mission = result.n_agents, result.mission
    thrust, speed, acceleration = (
        np.nan_to_num(samples(result, name).values).max(axis=0)
        for name in ("thrust", "speed", "acceleration")
    )
    z = result.position[..., 2]
    path = np.linalg.norm(np.diff(result.position, axis=0), axis=2).sum(axis=0)
    shown = np.arange(n) if n <= _VEHICLES else np.sort(np.argsort(-thrust)[:_VEHICLES])
    colours = plotting.agent_colours(n)
    limits = mission.agents.thrust_limit
    flown, known = _with_rotors(result), result.interpolation is None
    return [
        {
            "name": str(i + 1),
            "colour": colours[i],
            "mass": f"{mission.agents.mass[i]:.4g}" if known else "",
            "thrust": value(float(thrust[i])) if known else "",
            "used": f"{100 * thrust[i] / limits[i]:.0f} %" if math.isfinite(limits[i]) else "",
            "speed": value(float(speed[i])),
            "acceleration": value(float(acceleration[i])),
            "low": value(float(np.nanmin(z[:, i]))),
            "high": value(float(np.nanmax(z[:, i]))),
            "path": value(float(path[i])),
            "own": [column[i] for column in flown],
        }
        for i in shown.tolist()
    ]


def _with_rotors(result: Result) -> list[list[str]]:
    """Columns of vehicles with rotors: rotor share, tilt, tracking error; empty for points, none for their flights."""
    if not has_rotors(result):
        return []
    share = rotor_forces(result).max(axis=2) / rotor_limits(result.mission)
    return [
        [form(x) if math.isfinite(x) else "" for x in np.fmax.reduce(values, axis=0).tolist()]
        for values, form in (
            (share, lambda x: f"{100 * x:.0f} %"),
            (tilt(result), value),
            (samples(result, "tracking_error").values, value),
        )
    ]


def _versions(result: Result) -> list[tuple[str, str]]:
    known = result.statistics
    found = [*result.versions.items(), ("platform", result.platform)]
    for name, key, form in (
        ("integrator steps", "steps", "{}"),
        ("rejected steps", "rejected", "{}"),
        ("relative tolerance", "rtol", "{:g}"),
        ("absolute tolerance", "atol", "{:g}"),
        ("computing time", "wall_s", "{:.3g} s"),
    ):
        if known.get(key) is not None:
            found.append((name, form.format(known[key])))
    return found


# -- safety table -----------------------------------------------------------------------------------


def _safety_table(flights: Sequence[Result], verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """A row for each quantity of any flight, with a cell for each flight."""
    columns = [
        {row.quantity: row for row in safety(*each)} for each in zip(flights, verdicts, strict=True)
    ]
    return [
        {
            "name": name,
            "text": text,
            "cells": [_safety_cell(name, column.get(name)) for column in columns],
        }
        for name, text in {row.quantity: row.text for c in columns for row in c.values()}.items()
    ]


def _safety_cell(name: str, row: Safety | None) -> dict[str, Any]:
    nothing = quantity(name.replace(" ", "_")).nothing or "nothing to measure"
    if row is None:
        return {"state": "free", "worst": "", "nothing": nothing}
    margin, used, worst = row.margin, row.used, row.worst
    state = "free" if row.limit is None else "ok" if row.passed else "failed"
    left = ""
    if margin is not None:
        left = f"{value(abs(margin), row.unit)} {'left' if margin >= 0 else 'beyond'}"
    return {
        "state": state,
        "sign": "≤" if not row.at_least else "≥" if row.limit else ">",
        "limit": "" if row.limit is None else value(row.limit, row.unit),
        "worst": "" if worst is None else value(worst.value, row.unit),
        "nothing": nothing if worst is None else "",
        "left": left,
        "used": None if used is None else min(max(used, 0.0), 1.0),
        "when": "" if worst is None else f"{worst.when:.2f} s" + ", at samples" * worst.at_samples,
        "who": "" if worst is None else worst.who,
        "phase": "" if worst is None else worst.phase,
    }


# -- what differs ------------------------------------------------------------------------------------


def _numbers(flights: Sequence[Result], verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """Numbers of the flights side by side, with whether they differ."""
    measures: list[tuple[str, str, Callable[[Result, Verdict], float | None]]] = [
        ("length of the flight", "s", lambda r, _: float(r.time[-1])),
        ("failed checks", "", lambda _, v: float(sum(not f.passed for f in v.checks))),
        ("greatest waypoint miss", "m", partial(_checked, "waypoint_position")),
        ("mean thrust of a vehicle", "N", lambda r, _: _mean(r)),
        *((q.text, shown(q.unit), partial(_checked, q.name)) for q in QUANTITIES.values()),
    ]
    rows = []
    for name, unit, measure in measures:
        found = [measure(*each) for each in zip(flights, verdicts, strict=True)]
        if all(x is None for x in found):
            continue
        rows.append(
            {
                "name": name,
                "unit": unit,
                "cells": ["–" if x is None else value(x) for x in found],
                "change": [_change(found[0], x) for x in found],
                "same": all(_same(found[0], x) for x in found),
            }
        )  # fmt: skip
    return rows


def _checked(name: str, _: Result, verdict: Verdict) -> float | None:
    """The worst value that a check found."""
    check = verdict.by_name.get(name)
    return None if check is None else check.worst


def _mean(result: Result) -> float | None:
    """Mean thrust of a vehicle over time [N]."""
    mean = result.thrust.mean(axis=1)
    length = float(result.time[-1] - result.time[0])
    if not length or not np.isfinite(mean).all():
        return None
    return float(np.trapezoid(mean, result.time)) / length


def _same(a: float | None, b: float | None) -> bool:
    if a is None or b is None:
        return a is b
    return math.isclose(a, b, rel_tol=_SAME, abs_tol=1e-9)


def _change(first: float | None, x: float | None) -> str:
    """Change of a number from that of the first flight, if it is meaningful."""
    if first is None or x is None or _same(first, x) or abs(first) < 1e-6:
        return ""
    percent = 100 * (x - first) / abs(first)
    if abs(percent) >= 300:
        return f"×{x / first:.2g}" if 0 < x / first < 100 else ""
    return f"{percent:+.0f} %".replace("-", "−") if abs(percent) >= 0.5 else ""


def _keys(missions: Sequence[Mission]) -> list[dict[str, Any]]:
    """Keys of the mission files that differ between missions."""
    flat = [dict(_flat(mission.to_dict())) for mission in missions]
    rows = []
    for key in dict.fromkeys(key for one in flat for key in one):
        values = [one.get(key, "") for one in flat]
        if key != "name" and len(set(values)) > 1:
            rows.append({"key": key, "values": [clean(v, 60) for v in values]})
    if len(rows) > _KEYS:
        more = {"key": f"and {len(rows) - _KEYS} more keys", "values": ["…"] * len(missions)}
        rows = [*rows[:_KEYS], more]
    return rows


def _flat(data: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Keys in the notation of messages (phases[2].until), and their values as text."""
    if isinstance(data, Mapping):
        for name, item in data.items():
            yield from _flat(item, f"{key}.{name}" if key else str(name))
    elif isinstance(data, list) and data and all(isinstance(item, Mapping) for item in data):
        for number, item in enumerate(data, start=1):
            yield from _flat(item, f"{key}[{number}]")
    else:
        yield key, str(data)


# -- figures -----------------------------------------------------------------------------------------

_CAPTIONS = {
    "summary": "Summary of the flight on one page.",
    "trajectory": "Paths of the vehicles, and the formation at selected times.",
    "distances": "Distances of the active edges, with their references (dashed).",
    "cm": "Centre of mass: flown, reference (dashed) and waypoints (rings).",
    "attitude": "Attitude of the formation: flown, reference (dashed) and waypoints (rings).",
    "inputs": "Thrust of each vehicle with its limit, and enlarged.",
    "constraint_force": "Constraint force on each vehicle, and tension of each edge (negative: the edge pushes).",
    "constraint_error": "Constraint error |c| of each edge (length minus reference), and shape error of all pairs.",
    "clearance": "Distances between surfaces, with the limits.",
    "formations": "Formations with their edges and body axes.",
    "disturbance": "Aerodynamic force on each vehicle, and distance of each vehicle from its slot.",
    "rotors": "Greatest force of a rotor of each vehicle with its limit; all rotors of the one nearest to its limit.",
    "operation": "Altitude and speeds of all vehicles, their least separation, and their clearance to obstacles.",
    "motion": "Speed, acceleration and jerk of each vehicle, as far as they are limited, with their limits.",
    "vehicles": "Tilt of each vehicle, its distance from its slot, and when it is asked for more than its rotors give.",
}  # fmt: skip


def _figures(result: Result) -> list[dict[str, str]]:
    """All figures except the summary, which has its own page."""
    return [_figure(result, name) for name in plotting.figure_names(result) if name != "summary"]


def _figure(result: Result, name: str) -> dict[str, str]:
    svg = plotting.rendered(result, name, ["svg"])["svg"]
    return _picture(name, svg, _CAPTIONS.get(name, ""))


def _picture(name: str, svg: bytes, caption: str) -> dict[str, str]:
    return {"name": name.replace("_", " "), "image": _embedded(svg), "caption": caption}


def _embedded(svg: bytes) -> str:
    # An image keeps its ids and styles to itself. Runs of spaces are preserved as drawn.
    svg = svg.replace(b"</style>", b" text{white-space:pre}</style>", 1)
    return f"data:image/svg+xml;base64,{b64encode(svg).decode()}"


def _overlays(flights: Sequence[Result], labels: Sequence[str]) -> list[dict[str, str]]:
    return [
        _picture("paths", overlay.paths(flights, labels), "Paths of the formations' centres of mass."),
        _picture("over time", overlay.over_time(flights, labels), "Worst value of all vehicles at each time."),
    ]  # fmt: skip
