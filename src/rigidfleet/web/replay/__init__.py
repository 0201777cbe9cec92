"""A flight in the browser: one page that works offline and can be sent to others.

`replay` writes the page. It contains its own small renderer (WebGL 2) and loads nothing from a network.
Its parts are in this package.
"""

from __future__ import annotations

import html
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np

from rigidfleet._common.arguments import as_path
from rigidfleet._common.files import write_file
from rigidfleet.math.piecewise import piece_index
from rigidfleet.plotting.logged import off_plan
from rigidfleet.result import Result, as_result
from rigidfleet.result.lights import angles_facing_formation, has_lights
from rigidfleet.typing import Floats, Ints
from rigidfleet.web.replay.pack import PackedColumn, pack_columns
from rigidfleet.web.replay.page import page
from rigidfleet.web.replay.scene import (
    EDGES,
    describe_phases,
    describe_scene,
    mean_weight,
    page_samples,
    scene_points,
    typical_formation_radius,
)

__all__ = ["Replay", "replay", "replay_page"]

_RATE = 30.0  # greatest sampling rate [Hz]; the page draws smooth curves through the samples
#: Greatest number for all agents together; longer flights have a lower sampling rate.
_SAMPLES = 3_000_000
_HEIGHT = 600  # height in a notebook [px]
#: Number of vehicles beyond which each is a dot, unless it is near; columns that dots do without.
_SWARM, _SHAPES = 3000, ("thrust", "turn", "rotors", "slot", "fall", "doubt")
#: Least and greatest tension that the full colour of an edge stands for, as a share of a vehicle's weight.
_IDLE, _HEAVY = 0.005, 2.0


@dataclass(frozen=True, repr=False)
class Replay:
    """A flight's page, which a notebook shows in its cell; ``html`` is its text."""

    html: str

    def __repr__(self) -> str:
        return f"<Replay: {len(self.html) / 1e6:.1f} MB of HTML; a notebook shows it>"

    def _repr_html_(self) -> str:
        """The page in its own frame, which has no access to the notebook around it."""
        return (
            '<iframe title="Replay of the flight" sandbox="allow-scripts" width="100%"'
            f' height="{_HEIGHT}" style="border:0" srcdoc="{html.escape(self.html)}"></iframe>'
        )


@overload
def replay(result: Result | str | Path, path: None = None) -> Replay: ...


@overload
def replay(result: Result | str | Path, path: str | Path) -> None: ...


def replay(result: Result | str | Path, path: str | Path | None = None) -> Replay | None:
    """Replay a flight, in a notebook or as one HTML file for any browser, offline.

    Parameters
    ----------
    result : a flight, or the path of a saved one
    path : the file to write; an existing one is replaced, completely or not at all

    Returns
    -------
    Without a path, the page, which a notebook shows.

    Raises
    ------
    ResultError
        The file cannot be written, or the result or the mission inside it cannot be read.
    TypeError
        ``result`` is neither a flight nor a path.
    """
    page_ = replay_page(as_result(result))
    if path is None:
        return Replay(page_)
    write_file(as_path(path), page_.encode())
    return None


def replay_page(result: Result) -> str:
    """The page that `replay` writes."""
    time, shown = _even_times(result), _indices_of_drawn_edges(result)
    most = float(np.nanmax(np.abs(result.multiplier[:, shown]), initial=0.0))
    scale = mean_weight(result.mission)
    tension = min(max(most, _IDLE * scale), _HEAVY * scale)
    columns, swarm = page_samples(result, shown, tension), result.n_agents > _SWARM
    if swarm:  # dots have neither attitudes nor slots
        columns = {k: c for k, c in columns.items() if k not in _SHAPES}
    described, data = pack_columns(
        {
            name: PackedColumn(_interpolate(result, c.values, time), c.step)
            for name, c in columns.items()
        }
    )
    info = describe_scene(result, shown, tension) | _page_information(result, time)
    if has_lights(result):
        azimuth, elevation = angles_facing_formation(result)
        info |= {"night": True, "azimuth": azimuth, "elevation": elevation}
    info |= {"columns": described, "count": len(time), "beyond": most > tension}
    info |= {"note": _flight_note(result, shown, tension, most), "swarm": swarm}
    return page(info, start="replay/replay.js", data=data)


def _even_times(result: Result) -> Floats:
    """Even times (K,) [s] from start to end, about as dense as the result if its samples are sparse."""
    first, last = float(result.time[0]), float(result.time[-1])
    gaps = np.diff(result.time)
    gaps = gaps[gaps > 1e-9 * max(1.0, last - first)]
    if not len(gaps):
        return np.array([first])
    least = max(1.0 / _RATE, (last - first) * result.n_agents / _SAMPLES)
    count = math.ceil((last - first) / max(least, float(np.median(gaps))) - 1e-6)
    return np.linspace(first, last, count + 1)


def _interpolate(result: Result, values: Floats, time: Floats) -> Floats:
    """Values (K, ...) of the result at other times, by linear interpolation between samples.

    Between a value and a missing one, the earlier sample counts.
    """
    if len(result.time) == 1:
        return values
    k = piece_index(result.time, time)
    share = (time - result.time[k]) / (result.time[k + 1] - result.time[k])
    share = share.reshape(-1, *(1,) * (values.ndim - 1))
    low, high = values[k], values[k + 1]
    with np.errstate(invalid="ignore"):  # a separation is infinite where one vehicle is left
        between = (1.0 - share) * low + share * high
    return np.where(np.isfinite(between), between, np.where(share < 1.0, low, high))


def _indices_of_drawn_edges(result: Result) -> Ints:
    """Indices of the edges drawn: all, or the shortest if there are too many."""
    if len(result.edges) <= EDGES:
        return np.arange(len(result.edges))
    typical = np.median(result.distance[:: max(1, len(result.time) // 50)], axis=0)
    return np.sort(np.argsort(typical, kind="stable")[:EDGES])


def _page_information(result: Result, time: Floats) -> dict[str, Any]:
    """Information on the page about a finished flight."""
    low, high = result.position.min(axis=(0, 1)), result.position.max(axis=(0, 1))
    extent, reach = float(np.linalg.norm(high - low)) / 2, typical_formation_radius(result)
    seen = scene_points(result.mission, low, high)
    least, most = seen.min(axis=0), seen.max(axis=0)
    way = (result.cm[-1] - result.cm[0])[:2]
    far = float(np.linalg.norm(way)) > 2 * reach
    story = {
        "start": float(time[0]),
        "step": float(time[1] - time[0]) if len(time) > 1 else 0.0,
        "phases": describe_phases(result.phases),
        "ending": "" if result.complete else result.ending or "stopped",
        "camera": "overview",
        "sight": seen[8:],  # in addition to the flight itself
        "middle": (least + most) / 2,
        "extent": max(float(np.linalg.norm(most - least)) / 2, reach, 1e-6),
        "path": far,
        "forces": bool(np.isfinite(result.multiplier).any()),
        # Seen obliquely from behind, if the formation moves.
        "azimuth": math.atan2(-way[1], -way[0]) + 0.6 if far else -1.1,
    }
    if (off := off_plan(result)) is not None:
        story["drifts"] = [x._asdict() for x in off.drift_spans(result.time)]
        story["off"] = off.limit
    if not np.isfinite(result.mission.ground):
        # A grid to see motion against; high above the ground, it moves along with the flight.
        lowest = float(low[2])
        story["ground"] = 0.0 if 0.0 <= lowest <= 4 * (extent + reach) else lowest - reach
    return story


def _flight_note(result: Result, shown: Ints, tension: float, most: float) -> str:
    words = []
    for name in ("separation_first", "lost_first", "clearance_first"):
        if (x := result.extreme(name)) is not None:
            thing = name == "clearance_first" and result.mission.obstacles[x.other].name
            other = thing or f"agent {x.other + 1}"
            words.append(f"At {x.time:.2f} s, agent {x.who + 1} first hits {other}.")
    if result.n_agents > _SWARM:
        words.append("Vehicles are dots, without trails and slots.")
    if result.mission.fences or result.mission.people:
        words.append("Crosses: where vehicles fall that fail now.")
    if off_plan(result) is not None:
        words.append("Thin black lines are the plan; a halo is where a vehicle may be.")
    if len(shown) < len(result.edges):
        words.append(f"Only the {len(shown)} shortest of {len(result.edges)} edges are drawn.")
    if len(shown) and most < tension and np.isfinite(result.multiplier).any():
        words.append(f"No edge carries a force above {max(most, 0.001):.2g} N.")
    return " ".join(words)
