"""Write the tables of day.md, missions.md, sweep.md and vehicles.md: keys, variables of a result, metrics, drills.

`python docs/tables.py` rewrites them in place, each between `<!-- table: NAME -->` and `<!-- end -->`;
tests/test_docs.py fails where they are out of date. NAME is a table of the JSON schema; `A-B` the keys of A
which B lacks; `shapes`, `missions`, `result`, `metrics` and `margins` what their names say.
"""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rigidfleet.formation.shapes import SHAPES, agents_taken, slots
from rigidfleet.math.margins import (
    Lag,
    LoopGains,
    distinct_formation_loops,
    largest_stable_pole,
    stability_margins,
    tracking_loops,
)
from rigidfleet.mission import bounds, json_schema, load_mission
from rigidfleet.mission.kinds import KINDS
from rigidfleet.mission.text import GROUPS
from rigidfleet.result import LABELS, VARIABLES
from rigidfleet.sweep import METRICS
from rigidfleet.sweep.faults import Drill

PAGES = [
    Path(__file__).with_name(name) for name in ("day.md", "missions.md", "sweep.md", "vehicles.md")
]


def render(page: str) -> str:
    """A page with its tables as they should be."""
    schema = json_schema()

    def table(match: re.Match[str]) -> str:
        name = match[1]
        special = {
            "result": _result, "shapes": _shapes, "metrics": _metrics, "bounds": _bounds,
            "magnitudes": _magnitudes, "margins": _margins, "missions": _missions, "drill": _drill,
        }  # fmt: skip
        text = special[name]() if name in special else _keys(schema, name)
        return f"<!-- table: {name} -->\n{text}\n<!-- end -->"

    return re.sub(r"<!-- table: ([\w-]+) -->\n.*?<!-- end -->", table, page, flags=re.DOTALL)


def kinds_without_section(page: str) -> set[str]:
    """Kinds of phases without a section of a page; `hold` needs none, as its keys are those of every kind."""
    sections = re.findall(r"^### `\[\[phases\]\]` of kinds? (.*)$", page, re.MULTILINE)
    return (
        {*KINDS} - {"hold"} - {kind for text in sections for kind in re.findall(r"`(\w+)`", text)}
    )


def _keys(schema: dict[str, Any], name: str) -> str:
    """The keys of a table: name, value, default, meaning."""
    whole, _, without = name.partition("-")
    part = schema if whole == "MissionHeader" else schema["$defs"][whole]
    left_out = set(schema["$defs"][without]["properties"]) if without else set()
    if whole == "MissionHeader":
        left_out |= {key for key, entry in part["properties"].items() if _is_table(entry)}
    if name == "Hold":  # which stands for every kind
        left_out |= {"kind"}
    rows = [
        (f"`{key}`", _value(entry), _default(entry, key in part.get("required", ())), _text(entry))
        for key, entry in part["properties"].items()
        if key not in left_out
    ]
    return _markdown(("key", "value", "default", "meaning"), rows)


def _is_table(entry: dict[str, Any]) -> bool:
    """Whether a key of the whole file is a table, or an array of tables, with a section of its own."""
    return "$ref" in json.dumps(entry)


def _text(entry: dict[str, Any]) -> str:
    return entry["description"].replace("|", "\\|")


def _value(entry: dict[str, Any]) -> str:
    """What a key takes, in words."""
    match entry:
        case {"const": value}:
            return _quoted(value)
        case {"enum": values}:
            return ", ".join(map(_quoted, values))
        case {"anyOf": choices} | {"oneOf": choices}:
            return " or ".join(_value(c) for c in choices if c.get("type") != "null")
        case {"$ref": target}:
            return f"table, see `{_named(target)}`"
        case {"type": "array", "items": {"$ref": target}}:
            return f"list of tables, see `{_named(target)}`"
        case {"type": "array", "items": {"type": "array", "items": {"type": "array"} as inner}}:
            return f"list of lists: {_value(inner)}"
        case {"type": "array", "items": {"type": "array", "items": inner, **size}}:
            if inner["type"] == "array":
                return f"list of lists of lists of {_PLURAL[inner['items']['type']]}"
            if "minItems" not in size:
                return f"list of lists of {_PLURAL[inner['type']]}"
            return f"list of [{size['minItems']} {_PLURAL[inner['type']]}]"
        case {"type": "array", "minItems": n, "maxItems": most} if n < most:
            return f"[{n} to {most} numbers]"
        case {"type": "array", "minItems": n}:
            return f"[{n} numbers]"
        case {"type": "array", "items": inner}:
            return f"list of {_PLURAL[inner['type']]}"
    return {"integer": "whole number", "boolean": "true, false"}.get(entry["type"], entry["type"])


def _named(target: str) -> str:
    """What the page calls a table of the schema."""
    name = target.rpartition("/")[2]
    return "links.lost" if name == "LostLink" else name.lower()


_PLURAL = {"string": "names", "number": "numbers", "integer": "whole numbers"}


def _default(entry: dict[str, Any], given: bool) -> str:
    """The default in words; empty where there is none to tell."""
    if given:
        return "required"
    match entry.get("default"):
        case None | "" | [] | [None]:
            return ""
        case [value]:
            return _shorten_text(value)
        case list() as values:
            return f"[{', '.join(map(_shorten_text, values))}]"
        case value:
            return _shorten_text(value)


def _shorten_text(value: Any) -> str:
    return _quoted(value) if isinstance(value, bool | str) else f"{value:.6g}"


def _quoted(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'`"{value}"`' if isinstance(value, str) else str(value)


def _shapes() -> str:
    """The named shapes: name, agents, slots."""
    rows = [(f"`{name}`", agents_taken(name), shape.text) for name, shape in SHAPES.items()]
    return _markdown(("shape", "agents", "slots"), rows)


def _missions() -> str:
    """The shipped missions in their groups: name, what it shows, where in the paper."""
    rows = []
    for group, names in GROUPS.items():
        rows.append((f"**{group}**", "", ""))
        for name in names:
            mission = load_mission(name)
            rows.append((f"`{name}`", mission.title, mission.source))
    return _markdown(("mission", "what it shows", "in the paper"), rows)


def _result() -> str:
    """The variables of a result: name, dimensions, unit, meaning."""
    rows = [
        (f"`{name}`", ", ".join(v.dims), v.units, v.text.replace("|", "\\|"))
        for name, v in VARIABLES.items()
    ]
    along = "; ".join(f"`{dim}`: {', '.join(names)}" for dim, names in LABELS.items())
    return f"{_markdown(('variable', 'dimensions', 'unit', 'meaning'), rows)}\n\n{along}."


def _bounds() -> str:
    """How much of everything a mission may have."""
    most = f"{bounds.EDGES:,}, or {bounds.EDGES_EACH} for each agent if that is more"
    rows = [
        ("text of a mission", f"{bounds.BYTES >> 20} MiB"),
        ("brackets within brackets, parts of a dotted key", f"{bounds.DEPTH}"),
        ("keys", f"{bounds.KEYS:,}"),
        ("entries in lists", f"{bounds.ENTRIES:,}"),
        ("agents", f"{bounds.AGENTS:,}"),
        ('agents where `assignment` is not `"given"`', f"{bounds.ALL_PAIRS:,}"),
        ("formations", f"{bounds.FORMATIONS:,}"),
        ("slots of all formations together", f"{bounds.SLOTS:,}"),
        ('edges of a formation, `"complete"`', f"{bounds.EDGES:,}"),
        ("edges of a formation, all others", f"{most}"),
        ("pairs of agents that touch, if all are as large as the largest", f"{bounds.TOUCHING:,}"),
        ("phases", f"{bounds.PHASES:,}"),
        ("obstacles", f"{bounds.OBSTACLES:,}"),
        ("fences, and places with people", f"{bounds.FENCES:,}"),
        ("corners of one of them", f"{bounds.CORNERS:,}"),
        ("points of a hull", f"{bounds.HULL:,}"),
        ("heights of a height map", f"{bounds.HEIGHTS:,}"),
        ("the heaviest vehicle over the lightest", f"{bounds.MASS_RATIO:g}"),
    ]
    return _markdown(("what", "at most"), rows)


def _magnitudes() -> str:
    """How large each quantity may be."""
    rows = [
        (name.lower().replace("_", " "), f"{b.least:g}", f"{b.most:g}", b.unit)
        for name, b in vars(bounds).items()
        if isinstance(b, bounds.Bound)
    ]
    return _markdown(("quantity", "least, where it must be > 0", "most", "unit"), rows)


def _metrics() -> str:
    """The metrics of a sweep: name, unit, meaning."""
    rows = [(f"`{name}`", m.unit, m.text.replace("|", "\\|")) for name, m in METRICS.items()]
    return _markdown(("metric", "unit", "meaning"), rows)


def _drill() -> str:
    """The keys of a drill: name, magnitudes unless a sweep file has others, meaning."""
    rows = [
        (f"`{name}`", ", ".join(map(str, magnitudes)), str(field.description))
        for name, field in Drill.model_fields.items()
        for default in [field.default]
        for magnitudes in [default if isinstance(default, tuple) else [default][default is None :]]
    ]
    return _markdown(("key", "default", "meaning"), rows)


#: Attitude gains [1/s^2, 1/s] and time constant of the rotors [s]; docs/vehicles.md names the sources.
VEHICLES = {
    "Hummingbird": (544.0, 46.64, 0.005),
    "1 kg, after the paper": (544.0, 46.64, 0.02),
    "PX4 SIH": (310.0, 57.0, 0.05),
    "Crazyflie": (310.0, 57.0, 0.072),
}


def _margins() -> str:
    """What lag and delay allow: largest p, and margins of the default gains, of a triangle of 4 m."""
    law, p, rows = LoopGains(), slots("triangle", (4.0,), 3), []
    for name, (k_R, k_omega, tau) in VEHICLES.items():
        for delay in (0.0, 0.02, 0.05):
            lag = Lag(k_R, k_omega, tau, delay, rate=500.0)
            loops = distinct_formation_loops(p, [[0, 1], [0, 2], [1, 2]], [1.0] * 3, law, [lag] * 3)
            held, alone = (
                stability_margins(loops, law),
                stability_margins(tracking_loops([lag]), law),
            )
            rule = 8 / 9 / (k_omega / k_R + tau + delay)
            rows.append(
                (
                    name if delay == 0 else "",
                    f"{1e3 * delay:.0f}",
                    f"{largest_stable_pole(loops, law):.2f}",
                    f"{rule:.1f}",
                    *(
                        f"{math.degrees(m.phase):.0f}°, {1e3 * m.delay:.0f} ms"
                        for m in (held, alone)
                    ),
                    f"{alone.gain[1]:.1f}",
                )
            )
    head = (
        "vehicle", "delay [ms]", "largest p [1/s]", "8/(9τ)", "constraint law at p = 2",
        "tracking", "its gains, times up to",
    )  # fmt: skip
    return _markdown(head, rows)


def _markdown(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in lines)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(render(page.read_text(encoding="utf-8")), encoding="utf-8")
