"""Content of the page, as plain data for its templates."""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet import plotting
from rigidfleet._common.facts import Cell, FactTable, Level, Row, value
from rigidfleet._common.quantities import QUANTITIES, quantity
from rigidfleet._version import __version__
from rigidfleet.assessment import Safety, Verdict, assess, safety
from rigidfleet.plotting import encode_figure
from rigidfleet.plotting.areas import draw_ground, fall_places_by_sample
from rigidfleet.plotting.quadrotors import (
    has_rotors,
    rotor_forces,
    rotor_limit,
    tilt,
)
from rigidfleet.plotting.style import clean_name
from rigidfleet.reporting import brief, gains, overlay
from rigidfleet.result.quantities import samples

if TYPE_CHECKING:
    from rigidfleet.mission import Mission
    from rigidfleet.result import Result
    from rigidfleet.typing import Floats

#: Greatest number of vehicles with a row each; of more vehicles, those with the greatest thrust are shown.
_VEHICLES = 24
#: Greatest number of differing mission keys that are shown.
_KEYS = 40


def page_contents(
    flights: Sequence[Result],
    labels: Sequence[str] | None,
    verdicts: Sequence[Verdict] | None,
    **more: Sequence[str],
) -> dict[str, Any]:
    """Everything on the page; ``more`` is what the first page of one flight says that no record has.

    Raises
    ------
    ValueError
        There is no flight, or the number of labels or verdicts differs from that of flights.
    """
    if not flights:
        raise ValueError("a report needs a result")
    names = list(labels) if labels is not None else _names_of(flights)
    judged = list(verdicts) if verdicts is not None else [assess(flight) for flight in flights]
    if not len(names) == len(judged) == len(flights):
        raise ValueError(f"{len(flights)} results need as many labels and verdicts")
    missions = [flight.mission for flight in flights]
    several = len(flights) > 1
    colours = plotting.agent_colours(len(flights))
    pages = [_flight_data(*each) for each in zip(flights, judged, names, colours, strict=True)]
    if several:
        parts = {
            "numbers": _number_comparison_table(flights, judged, names),
            "keys": _differing_keys_table(missions, names),
            "overlays": _overlay_pictures(flights, names),
        }
    else:
        falls = fall_places_by_sample(flights[0])
        sketch = encode_figure(draw_ground(flights[0], falls), ["svg"])["svg"]
        # The summary, or the trajectory where a summary would be empty, has its own page.
        drawn = plotting.figure_names(flights[0])[1:]
        parts = {
            "brief": brief.brief_rows(flights[0], judged[0], falls, **more),
            "sketch": _data_url(sketch),
            "figures": [_figure_for_page(flights[0], name) for name in drawn],
        }
    return {
        "title": " · ".join(names),
        "several": several,
        "flights": pages,
        "safety": _safety_table(flights, judged, names),
        "version": __version__,
        "covers": _scope_in_words(flights),
        **parts,
    }


def _names_of(flights: Sequence[Result]) -> list[str]:
    """Names of the missions, numbered if a name occurs twice."""
    names = [flight.mission.name for flight in flights]
    return [
        f"{name} ({names[:k].count(name)})" if names.count(name) > 1 else name
        for k, name in enumerate(names, start=1)
    ]


# -- one flight --------------------------------------------------------------------------------------


def _flight_data(result: Result, verdict: Verdict, label: str, colour: str) -> dict[str, Any]:
    """What the template of a page shows of one flight, by the template's names."""
    return {
        "label": label,
        "head_cell": Cell(label, colour=colour),
        "mission": result.mission,
        "text": result.mission_text,
        "verdict": verdict,
        "plan": brief.plan_sentences(result),
        # The notes, and the verdict in words, stand on the first page.
        "checks": [
            part
            for part in verdict.facts().shown_parts
            if isinstance(part, FactTable) or not part.level
        ],
        "vehicles": _vehicles_table(result),
        "vehicles_left_out": max(0, result.n_agents - _VEHICLES),
        "summary": _figure_for_page(result, plotting.figure_names(result)[0]),
        "gains": _gains_table(result),
        "digests": brief.provenance_sentences(result),
    }


def _scope_in_words(flights: Sequence[Result]) -> str:
    """What the flights are, and what the report does not cover."""
    if all(flight.interpolation is not None for flight in flights):
        return "Others made this flight: its curve is judged, not whether vehicles can fly it."
    if any("doubt" in flight.statistics for flight in flights):
        return (
            "This is a log of a flight: what was measured is judged, with what it leaves in doubt."
        )
    if any(flight.rotor_force is not None for flight in flights):
        return "This is a simulation: real vehicles differ from their models."
    return (
        "This is a simulation: vehicles are point masses that produce any thrust vector instantly."
    )


def _gains_table(result: Result) -> FactTable:
    """The gains in words; trajectories that others made have none."""
    heads, own = ("gains", "value", "meaning"), result.interpolation is None
    lines = gains.gain_lines(result.mission) if own else []
    return FactTable(heads, [*map(Row, lines)], heads, bare=True)


def _vehicles_table(result: Result) -> FactTable:
    """Extremes of each vehicle; if there are too many, of those with the greatest thrust."""
    n, mission = result.n_agents, result.mission

    def greatest_signed(values: Floats) -> list[float | None]:
        most = np.fmax.reduce(values.reshape(*values.shape[:2], -1), axis=(0, 2), initial=np.nan)
        return [x if math.isfinite(x) else None for x in most.tolist()]

    def greatest_of_each_agent(name: str) -> list[float | None]:
        return greatest_signed(samples(result, name).values)

    def share_of_limit(values: Floats, limits: Any) -> list[str]:
        return ["" if x is None else f"{100 * x:.0f} %" for x in greatest_signed(values / limits)]

    z = result.position[..., 2]
    thrust, nothing = greatest_of_each_agent("thrust"), [None] * n
    own, rotors = result.interpolation is None, has_rotors(result)
    columns = {
        "mass [kg]": [f"{m:.4g}" for m in mission.agents.mass] if own else nothing,
        "thrust [N]": thrust if own else nothing,
        "share of limit": share_of_limit(result.thrust[..., None], np.array(mission.agents.thrust_limit)[:, None])
        if np.isfinite(mission.agents.thrust_limit).any() else nothing,
        "speed [m/s]": greatest_of_each_agent("speed"),
        "acceleration [m/s²]": greatest_of_each_agent("acceleration"),
        "lowest [m]": [-x for x in greatest_signed(-z) if x is not None],
        "highest [m]": greatest_signed(z),
        "path length [m]": np.linalg.norm(np.diff(result.position, axis=0), axis=2).sum(axis=0).tolist(),
        "share of rotor limit": share_of_limit(rotor_forces(result), rotor_limit(mission)[..., None])
        if rotors else nothing,
        "tilt [deg]": greatest_signed(tilt(result)) if rotors else nothing,
        "from the slot [m]": greatest_of_each_agent("tracking_error") if rotors else nothing,
    }  # fmt: skip
    order = np.argsort(-np.nan_to_num(np.array(thrust, dtype=float)))
    shown = np.arange(n) if n <= _VEHICLES else np.sort(order[:_VEHICLES])
    colours = plotting.agent_colours(n)
    rows = [
        Row((Cell(str(i + 1), colour=colours[i]), *(column[i] for column in columns.values())))
        for i in shown.tolist()
    ]
    return FactTable(("agent", *columns), rows)


# -- safety table -----------------------------------------------------------------------------------


def _safety_table(
    flights: Sequence[Result], verdicts: Sequence[Verdict], labels: Sequence[str]
) -> FactTable:
    """A row for each quantity of any flight; beside the quantity, what is known of one flight, or a cell for each."""
    columns = [
        {row.quantity: row for row in safety(*each)} for each in zip(flights, verdicts, strict=True)
    ]
    names = {row.quantity: Cell(row.quantity, row.text) for c in columns for row in c.values()}
    if len(flights) == 1:
        rows = [
            Row((names[row.quantity], *_safety_cells(row)), _safety_level(row))
            for row in columns[0].values()
        ]
        heads = ("quantity", "limit", "worst", "margin", "when", "who")
        return FactTable(heads, rows, ("margin", "when", "who"))
    rows = [
        Row((cell, *(_safety_cell(name, column.get(name)) for column in columns)))
        for name, cell in names.items()
    ]
    return FactTable(("quantity", *labels), rows, labels)


def _safety_level(row: Safety) -> Level:
    if row.undecided:
        return "undecided"
    return "" if row.limit is None else "ok" if row.passed else "fails"


def _nothing_to_measure_text(name: str) -> str:
    return quantity(name.replace(" ", "_")).nothing or "nothing to measure"


def _safety_cells(row: Safety) -> tuple[str | Cell, ...]:
    """Limit, worst value, margin, when and who."""
    if (worst := row.worst) is None:
        return row.fact.bound, "", _nothing_to_measure_text(row.quantity), "", ""
    left = ""
    if row.margin is not None:
        left = f"{value(abs(row.margin), row.unit)} {'left' if row.margin >= 0 else 'beyond'}"
    when = f"{worst.when:.2f} s" + ", at samples" * worst.at_samples
    margin, at = Cell(left, share=row.used), Cell(when, worst.phase)
    size = Cell(value(worst.value, row.unit), row.fact.interval_text)
    return row.fact.bound, size, margin, at, worst.who


def _safety_cell(name: str, row: Safety | None) -> Cell:
    """The worst value of one of several flights, with its limit, whom and when."""
    if row is None:
        return Cell(_nothing_to_measure_text(name))
    limit, worst, margin, when, who = _safety_cells(row)
    small = ", ".join(str(x) for x in (limit, who, getattr(when, "text", "")) if x)
    return Cell(str(worst or margin), small, level=_safety_level(row))


# -- what differs ------------------------------------------------------------------------------------


def _number_comparison_table(
    flights: Sequence[Result], verdicts: Sequence[Verdict], labels: Sequence[str]
) -> FactTable:
    """Numbers of the flights side by side, with how much they differ from those of the first."""
    measures: list[tuple[str, str, Callable[[Result, Verdict], float | None]]] = [
        ("length of the flight", "s", lambda r, _: float(r.time[-1])),
        ("failed checks", "", lambda _, v: float(sum(not f.passed for f in v.checks))),
        ("greatest waypoint miss", "m", partial(_worst_of, "waypoint_position")),
        ("mean thrust of a vehicle", "N", lambda r, _: _mean_thrust(r)),
        *((q.text, q.display_unit, partial(_worst_of, q.name)) for q in QUANTITIES.values()),
    ]
    rows = []
    for name, unit, measure in measures:
        values = [measure(*each) for each in zip(flights, verdicts, strict=True)]
        if all(x is None for x in values):
            continue
        cells = [Cell("–" if x is None else value(x), _change_text(values[0], x)) for x in values]
        rows.append(Row((f"{name} [{unit}]" if unit else name, *cells)))
    return FactTable(("quantity", *labels), rows)


def _worst_of(name: str, _: Result, verdict: Verdict) -> float | None:
    """The worst value that a check found."""
    check = verdict.by_name.get(name)
    return None if check is None else check.worst


def _mean_thrust(result: Result) -> float | None:
    """Mean thrust of a vehicle over time [N]."""
    mean = result.thrust.mean(axis=1)
    length = float(result.time[-1] - result.time[0])
    if not length or not np.isfinite(mean).all():
        return None
    return float(np.trapezoid(mean, result.time)) / length


def _change_text(first: float | None, x: float | None) -> str:
    """Change of a number from that of the first flight, if it is meaningful."""
    if first is None or x is None or abs(first) < 1e-6 or x / first < 0:
        return ""
    percent = 100 * (x - first) / abs(first)
    if abs(percent) >= 300:
        return f"×{x / first:.2g}" if x / first < 100 else ""
    return f"{percent:+.0f} %".replace("-", "−") if abs(percent) >= 0.5 else ""


def _differing_keys_table(missions: Sequence[Mission], labels: Sequence[str]) -> FactTable:
    """Keys of the mission files that differ between missions."""
    flat = [dict(_key_paths_and_values(mission.to_dict())) for mission in missions]
    rows = []
    for key in dict.fromkeys(key for one in flat for key in one):
        values = [one.get(key, "not set") for one in flat]
        if key != "name" and len(set(values)) > 1:
            rows.append(Row((key, *(clean_name(v, 60) for v in values))))
    if len(rows) > _KEYS:
        more = Row((f"and {len(rows) - _KEYS} more keys", *["…"] * len(missions)))
        rows = [*rows[:_KEYS], more]
    return FactTable(("key", *labels), rows, labels)


def _key_paths_and_values(data: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Keys in the notation of messages (phases[2].until), and their values as text."""
    if isinstance(data, Mapping):
        for name, item in data.items():
            yield from _key_paths_and_values(item, f"{key}.{name}" if key else str(name))
    elif isinstance(data, list) and data and all(isinstance(item, Mapping) for item in data):
        for number, item in enumerate(data, start=1):
            yield from _key_paths_and_values(item, f"{key}[{number}]")
    else:
        yield key, str(data)


# -- figures -----------------------------------------------------------------------------------------


def _figure_for_page(result: Result, name: str) -> dict[str, str]:
    svg = plotting.render_figure(result, name, ["svg"])["svg"]
    pairs = name == "constraint_error" and not len(result.edges)
    return _image_data(name, svg, "Shape error of all pairs." if pairs else plotting.caption(name))


def _image_data(name: str, svg: bytes, caption: str) -> dict[str, str]:
    return {"name": name.replace("_", " "), "image": _data_url(svg), "caption": caption}


def _data_url(svg: bytes) -> str:
    # An image keeps its ids and styles to itself. Runs of spaces are preserved as drawn.
    svg = svg.replace(b"</style>", b" text{white-space:pre}</style>", 1)
    return f"data:image/svg+xml;base64,{b64encode(svg).decode()}"


def _overlay_pictures(flights: Sequence[Result], labels: Sequence[str]) -> list[dict[str, str]]:
    return [
        _image_data("paths", overlay.svg_of_paths(flights, labels), "Paths of the formations' centres of mass."),
        _image_data("over time", overlay.svg_of_time_curves(flights, labels), "Worst value of all vehicles at a time."),
    ]  # fmt: skip
