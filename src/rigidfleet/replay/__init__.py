"""A flight in the browser: one page that works offline, to look at and to send.

`replay` writes it. The page holds its own small renderer (WebGL 2) and asks nothing of any network;
its parts lie beside this module, and `page` puts them together.
"""

from __future__ import annotations

import html
import json
import math
import re
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.figures.style import agent_colours
from rigidfleet.replay.pack import Column, Floats, pack
from rigidfleet.result import plain, write_file

if TYPE_CHECKING:
    from rigidfleet.mission import Mission
    from rigidfleet.result import Result

__all__ = ["html_page", "replay"]

_RATE = 30.0  # samples [Hz] at most: the page draws smooth curves through them
_SAMPLES = 3_000_000  # of all agents together; longer flights have fewer in a second
_EDGES = 3000  # drawn at most: more would hide what they hold
_LINES = 12  # in a plot at most; of more agents the least and the greatest
_FLOOR = 1e-6  # least constraint error that is told apart from none [m]
#: Shares of a vehicle's weight that the full colour of an edge stands for at least, and at most.
_IDLE, _HEAVY = 0.005, 2.0

#: What the page may load: nothing but itself.
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"


def replay(result: Result, path: str | Path) -> None:
    """Write a flight as one HTML file that plays it, offline, in any browser of today.

    An existing file is replaced, whole or not at all.

    Raises
    ------
    ResultError
        The file cannot be written, or the mission inside the result cannot be read.
    """
    write_file(Path(path), html_page(result).encode())


def html_page(result: Result) -> str:
    """The page that `replay` writes."""
    time = _times(result)
    shown = _edges(result)
    described, data = pack(_columns(result, time, shown))
    info = describe(result.mission, result.edges[shown]) | _story(result, time, shown)
    return page("replay.js", info | {"columns": described, "count": len(time)}, data)


def page(main: str, info: dict[str, Any], data: str = "", *, policy: str = _POLICY) -> str:
    """A page made of the parts beside this module; ``main`` names the script that starts it."""
    parts = resources.files("rigidfleet.replay")

    def read(name: str) -> str:
        return (parts / name).read_text(encoding="utf-8")

    scripts = ("gl.js", "recording.js", "scene.js", "player.js", main)
    fill = {
        "policy": policy,
        "title": html.escape(f"{info['name']} – rigidfleet"),
        "style": read("page.css"),
        # No mark-up inside: a user's words must not end the script.
        "info": json.dumps(plain(info), ensure_ascii=False).replace("<", "\\u003c"),
        "data": data,
        "script": "\n".join(map(read, scripts)),
    }
    return re.sub(r"\{(\w+)\}", lambda match: fill[match[1]], read("page.html"))


def describe(mission: Mission, edges: np.ndarray) -> dict[str, Any]:
    """What the page shows of a mission, before anything flies; ``edges`` (m, 2) are those drawn."""
    ground = [o.height for o in mission.obstacles if o.kind == "ground"]
    boxes = [o for o in mission.obstacles if o.kind == "box"]
    fence = mission.limits.geofence
    return {
        "name": mission.name,
        "title": mission.title,
        "radius": mission.agents.radius,
        "colours": agent_colours(mission.n_agents),
        "edges": edges,
        "tension": _IDLE * _weight(mission),
        "beyond": True,
        "boxes": [{"name": o.name, "min": o.min, "max": o.max} for o in boxes],
        "fence": None if fence is None else {"min": fence.min, "max": fence.max},
        "ground": max(ground, default=0.0),
        "solid": bool(ground),
        "plots": _plots(mission),
        "ending": "",
        "note": "",
    }


# -- the flight as the page sees it ------------------------------------------------------------------


def _times(result: Result) -> Floats:
    """Even times (K,) [s] from start to end, about as dense as the result is where that is seldom."""
    first, last = float(result.time[0]), float(result.time[-1])
    gaps = np.diff(result.time)
    gaps = gaps[gaps > 1e-9 * max(1.0, last - first)]
    if not len(gaps):
        return np.array([first])
    least = max(1.0 / _RATE, (last - first) * result.n_agents / _SAMPLES)
    count = math.ceil((last - first) / max(least, float(np.median(gaps))) - 1e-6)
    return np.linspace(first, last, count + 1)


def _sampled(result: Result, values: Floats, time: Floats) -> Floats:
    """Values (K, ...) of the result at other times, straight between its samples.

    Between a value and none, the earlier sample counts.
    """
    if len(result.time) == 1:
        return values
    k = np.clip(np.searchsorted(result.time, time, side="right") - 1, 0, len(result.time) - 2)
    share = (time - result.time[k]) / (result.time[k + 1] - result.time[k])
    share = share.reshape(-1, *(1,) * (values.ndim - 1))
    low, high = values[k], values[k + 1]
    between = (1.0 - share) * low + share * high
    return np.where(np.isfinite(between), between, np.where(share < 1.0, low, high))


def _edges(result: Result) -> np.ndarray:
    """Indices of the edges drawn: all, or of too many the shortest."""
    if len(result.edges) <= _EDGES:
        return np.arange(len(result.edges))
    typical = np.median(result.distance[:: max(1, len(result.time) // 50)], axis=0)
    return np.sort(np.argsort(typical, kind="stable")[:_EDGES])


def _columns(result: Result, time: Floats, shown: np.ndarray) -> dict[str, Column]:
    mission = result.mission
    # Fine enough for a view of one vehicle that fills the screen.
    fine = max(_size(result), *mission.agents.radius, 1e-9) / 20_000
    force = result.input_force + result.constraint_force
    mass = np.array(mission.agents.mass)
    values = {
        "position": (result.position, fine),
        "thrust": (thrust_directions(force, mass), 5e-4),
        "slot": (result.slot_position - result.position, fine),
        "cm": (result.cm, fine),
        "attitude": (result.attitude, 1e-4),
        "reference": (result.attitude_reference, 1e-4),
        "tension": (-result.multiplier[:, shown], _tension(result, shown)[0] / 1000),
        **{f"plot {name}": value for name, value in _plotted(result).items()},
    }
    return {
        name: Column(_sampled(result, whole, time), step) for name, (whole, step) in values.items()
    }


def thrust_directions(force: Floats, mass: Floats) -> Floats:
    """Unit vectors (..., N, 3) along the thrust, which a vehicle's rotors must point along.

    Upwards where there is next to no thrust (2 % of the weight on Earth), whose direction is noise.
    """
    size = np.linalg.norm(force, axis=-1)
    up = np.maximum(0.2 * mass - size, 0.0)
    force = force + up[..., None] * np.array([0.0, 0.0, 1.0])
    return force / np.maximum(np.linalg.norm(force, axis=-1, keepdims=True), 1e-300)


def _size(result: Result) -> float:
    """Typical greatest distance [m] of an agent from the centre of mass."""
    reach = np.linalg.norm(result.position - result.cm[:, None], axis=2).max(axis=1)
    return float(np.median(reach))


def _tension(result: Result, shown: np.ndarray) -> tuple[float, float]:
    """Tension [N] that an edge's full colour stands for, and the greatest there is."""
    most = float(np.nanmax(np.abs(result.multiplier[:, shown]), initial=0.0))
    weight = _weight(result.mission)
    return min(max(most, _IDLE * weight), _HEAVY * weight), most


def _weight(mission: Mission) -> float:
    """Weight [N] of a vehicle; without gravity a tenth of that on Earth."""
    return float(np.mean(mission.agents.mass)) * max(mission.gravity, 1.0)


def _plots(mission: Mission) -> list[dict[str, Any]]:
    """Quantities drawn over time; the samples of each are in the column "plot KEY"."""
    n, limits = mission.n_agents, mission.limits
    thrust = min(mission.agents.thrust_limit)
    each = agent_colours(n) if n <= _LINES else ["#8FA3B8", "#20262D"]
    plots: list[dict[str, Any]] = [
        {"key": "thrust", "title": "Greatest thrust", "unit": "N", "colours": each, "limit": thrust}
    ]
    if len(mission.edges):
        plots.append({"key": "error", "title": "Constraint error", "unit": "m", "log": True})
    if n > 1:
        plots.append(
            {"key": "separation", "title": "Separation", "unit": "m", "least": limits.separation}
        )
    if mission.obstacles:
        plots.append({"key": "clearance", "title": "Clearance", "unit": "m", "least": 0.0})
    basic = {"colours": ["#20262D"], "limit": None, "least": None, "log": False, "floor": _FLOOR}
    return [
        basic | plot | {"column": f"plot {plot['key']}", "worst": _worst(plot["key"])}
        for plot in plots
    ]


def _worst(key: str) -> str:
    return "least" if key in {"separation", "clearance"} else "greatest"


def _plotted(result: Result) -> dict[str, tuple[Floats, float]]:
    """Samples of each plot, and the step they are rounded to."""
    thrust = result.thrust
    if result.n_agents > _LINES:
        thrust = np.stack([thrust.min(axis=1), thrust.max(axis=1)], axis=1)
    # Where no edge is active there is no error.
    error = np.where(np.isnan(result.constraint), -1.0, np.abs(result.constraint))
    error = error.max(axis=1, initial=-1.0)
    values = {
        "thrust": (thrust, 1e-3),
        "error": (np.where(error < 0.0, np.nan, error), _FLOOR),
        "separation": (result.separation, 1e-3),
        "clearance": (result.clearance, 1e-3),
    }
    return {plot["key"]: values[plot["key"]] for plot in _plots(result.mission)}


def _story(result: Result, time: Floats, shown: np.ndarray) -> dict[str, Any]:
    """What the page says of a flight that is over."""
    low, high = result.position.min(axis=(0, 1)), result.position.max(axis=(0, 1))
    extent, size = float(np.linalg.norm(high - low)) / 2, _size(result)
    way = (result.cm[-1] - result.cm[0])[:2]
    far = float(np.linalg.norm(way)) > 2 * size
    tension, most = _tension(result, shown)
    story = {
        "start": float(time[0]),
        "step": float(time[1] - time[0]) if len(time) > 1 else 0.0,
        "phases": [
            {
                "name": phase.name,
                "start": phase.t_start,
                "end": phase.t_end,
                "position": (phase.target or {}).get("position"),
            }
            for phase in result.phases
        ],
        "ending": "" if result.complete else result.ending or "stopped",
        "tension": tension,
        "beyond": most > tension,
        "middle": (low + high) / 2,
        "extent": max(extent, size, 1e-6),
        "path": far,
        # Seen from behind and from the side, where there is a way.
        "azimuth": math.atan2(-way[1], -way[0]) + 0.6 if far else -1.1,
        "note": _note(result, shown, tension, most),
    }
    if not any(o.kind == "ground" for o in result.mission.obstacles):
        # A grid to see motion against; far up there, it goes along.
        lowest = float(low[2])
        story["ground"] = 0.0 if 0.0 <= lowest <= 4 * (extent + size) else lowest - size
    return story


def _note(result: Result, shown: np.ndarray, tension: float, most: float) -> str:
    words = []
    if len(shown) < len(result.edges):
        words.append(f"The {len(shown)} shortest of {len(result.edges)} edges are drawn.")
    if len(shown) and most < tension:
        words.append(f"No edge carries more than {max(most, 0.001):.2g} N.")
    return " ".join(words)
