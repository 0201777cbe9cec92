import math
import re
import subprocess
import sys
import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace
from itertools import combinations, permutations
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.text import Annotation, Text
from PIL import Image
from sample_flights import drifting, swarm
from scipy.spatial import ConvexHull

from rigidfleet import plotting, simulate
from rigidfleet.errors import ResultError
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.mission import Mission, load_mission
from rigidfleet.plotting import curves, sketches, space, style
from rigidfleet.plotting.areas import draw_ground
from rigidfleet.plotting.solids import area_from_above
from rigidfleet.result import LABELS, VARIABLES, PhaseRecord, Result
from rigidfleet.result.quantities import samples
from rigidfleet.solids.outline import outline_of_solid

START = [[1.0, 6.0, 3.0], [8.0, 3.0, 3.0], [7.0, 6.0, 3.0]]
TRIANGLE = {"shape": "triangle", "size": 4.0}
CUBE = {"shape": "cube", "size": 4.0}
BOX = {"kind": "box", "name": "wall", "min": [10.0, 8.0, 0.0], "max": [14.0, 12.0, 6.0]}
OF_VEHICLES = (
    "vehicle_attitude", "vehicle_rates", "rotor_force", "saturated", "clock_rate", "body_displacement",
    "avoidance_layers", "message_age", "messages", "oldest_message", "vehicle_clock",
)  # fmt: skip
OVER_TIME = [
    "distances", "cm", "attitude", "inputs", "constraint_force", "constraint_error", "clearance",
]  # fmt: skip


def _rate(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.gradient(x, t, axis=0) if len(t) > 1 else 0 * x


def a_flight(
    *,
    n: int = 3,
    formation: dict[str, Any] | None = TRIANGLE,
    phases: list[tuple[str, float]] | None = None,
    samples: int = 181,
    mission: dict[str, Any] | None = None,
    **changes: Any,
) -> Result:
    """A made-up flight: agents move from a spread-out start into slots that turn, climb and drift."""
    phases = [("establish", 6.0), ("fly", 14.0)] if phases is None else phases
    names = [f"{name} {k}" if name == "fly" else name for k, (name, _) in enumerate(phases)]
    ends = np.cumsum([length for _, length in phases])
    starts = ends - [length for _, length in phases]
    rng = np.random.default_rng(n)
    start = np.array(START[:n]) if n <= 3 else rng.uniform(0, 8, (n, 3)) + [0, 0, 3]
    kinds: list[dict[str, Any]] = [
        {"kind": "fly", "name": name, "position": [15.0, 15.0, 15.0], "until": float(end)}
        for name, end in zip(names, ends, strict=True)
    ]
    if formation is not None:
        kinds[0] |= {"kind": "establish", "formation": "shape", "blend": min(4.0, float(ends[0]))}
        del kinds[0]["position"]
        if "edges" in formation:
            kinds[0] |= {"reference": "distances", "control": "open"}
            kinds[1:] = [
                {"kind": "hold", "name": kind["name"], "until": kind["until"], "control": "open"}
                for kind in kinds[1:]
            ]
    data: dict[str, Any] = {
        "schema_version": 1, "name": "made-up", "title": "A made-up flight",
        "agents": {"mass": 1.0, "position": start.tolist(), "thrust_limit": 23.6},
        "formations": {} if formation is None else {"shape": formation},
        "obstacles": [{"kind": "ground"}, BOX], "limits": {"separation": 0.5}, "phases": kinds,
    }  # fmt: skip
    flown = Mission.from_dict(data | (mission or {}))

    t = np.linspace(0, ends[-1], samples)
    s = np.clip(t / ends[-1], 0, 1)[:, None, None]
    slots = None if formation is None else flown.formation_slots("shape")
    goal = start - start.mean(axis=0) if slots is None else slots
    yaw = np.linspace(0, 1.5, samples)
    q = att.quaternion_from_euler(np.column_stack([0 * yaw, 0 * yaw, yaw]))
    turned = np.einsum("kba,ib->kia", att.dcm_from_quaternion(q), goal)
    target = start.mean(axis=0) * (1 - s) + 15.0 * s + turned
    r = start * (1 - np.minimum(3 * s, 1)) + target * np.minimum(3 * s, 1)
    i, j = flown.edges.T
    length = np.linalg.norm(r[:, i] - r[:, j], axis=2)
    final = np.linalg.norm(goal[i] - goal[j], axis=1)
    blank = {
        name: np.full([{"time": samples, "agent": n, "edge": len(i), "axis": 3, "quaternion": 4,
                        "wrench": 6, "end": 2}[d] for d in v.dims], np.nan)
        for name, v in VARIABLES.items() if name not in OF_VEHICLES
    }  # fmt: skip
    force = np.zeros((samples, n, 3)) + [0, 0, 9.81]
    pull = np.sin(t)[:, None, None] * (r - r.mean(axis=1, keepdims=True))
    separation, pair = proximity.separation(r, flown.agents.radius)
    clearance, agent, obstacle = proximity.clearance(r, flown.agents.radius, flown.obstacles)
    arrays: dict[str, Any] = {**blank} | {
        "time": t, "phase": np.minimum(np.searchsorted(ends, t, "right"), len(ends) - 1),
        "position": r, "slot_position": target, "cm": r.mean(axis=1),
        "cm_velocity": _rate(t, r.mean(axis=1)),
        "cm_reference": r.mean(axis=1) + 0.01,
        "attitude": np.where(t[:, None] < ends[0], np.nan, q), "attitude_reference": q,
        "rates": np.column_stack([0 * t, 0 * t, _rate(t, yaw)]),
        "rates_reference": np.zeros((samples, 3)),
        "input_force": force, "constraint_force": pull,
        "thrust": np.linalg.norm(force + pull, axis=2), "edges": flown.edges, "distance": length,
        "distance_reference": np.broadcast_to(final, length.shape),
        "constraint": length - final, "multiplier": 0.1 * length,
        "separation": separation, "separation_pair": pair, "clearance": clearance,
        "clearance_agent": agent, "clearance_obstacle": obstacle,
    }  # fmt: skip
    records = [
        PhaseRecord(
            name, "fly" if k or formation is None else "establish", "tracking",
            None if formation is None else "shape", float(a), float(b), None,
            {"time": float(b), "position": [15.0, 15.0, 15.0], "velocity": [0.0, 0.0, 0.0],
             "attitude": q[-1].tolist(), "rates": [0.0, 0.0, 0.0]} if k else None,
        )
        for k, (name, a, b) in enumerate(zip(names, starts, ends, strict=True))
    ]  # fmt: skip
    arrays |= {"phases": records, "mission_text": flown.text} | changes
    return Result(**arrays)


FREE = {"obstacles": [], "limits": {}, "agents": {"mass": 1.0, "position": START}}
FENCED = {
    "limits": {
        "separation": 0.5, "separation_below": 1.0,
        "geofence": {"min": [0.0, 0.0, 0.0], "max": [20.0, 20.0, 20.0]},
    }
}  # fmt: skip
CHAIN = {"edges": [[1, 2], [2, 3], [3, 4]], "distances": [4.0, 4.0, 4.0]}
FLIGHTS: dict[str, Any] = {
    "one agent": {"n": 1, "formation": None, "mission": FENCED},
    "two agents, stopped": {
        "n": 2, "formation": {"distances": [4.0]}, "complete": False, "ending": "singular",
    },
    "no formation": {"n": 4, "formation": None},
    "no obstacles, no limits": {"mission": FREE},
    "distances only": {"n": 4, "formation": CHAIN},
    "one sample": {"samples": 1, "complete": False, "ending": "at once"},
    "twenty agents": {"n": 20, "formation": {"shape": "line", "size": 2.0}},
}  # fmt: skip


def by_quadrotors(models: list[str], *, lost: int | None = None) -> Result:
    """A made-up flight: agent i tilts by up to 10 i deg, and its rotor i mod 4 gives up to 0.3 + 0.1 i of its limit."""
    n = len(models)
    mission: dict[str, Any] = {
        "vehicles": {
            model: {"model": model} | ({"mass": 1.0} if model == "point" else {}) for model in models
        },
        "agents": {"vehicle": models, "position": START if n == 3 else [[4.0 * i, 0, 3] for i in range(n)]},
    }  # fmt: skip
    if lost is not None:
        mission["disturbances"] = {"lost": [{"agent": lost, "time": 10.0}]}
    bare = a_flight(n=n, mission=mission, formation={"shape": "line", "size": 2.0})
    t, who = bare.time, np.arange(n)
    wave = np.sin(np.pi * t / t[-1]) ** 2
    tilt = np.radians(10.0 * who) * wave[:, None]
    q = np.stack([np.cos(tilt / 2), np.sin(tilt / 2), 0 * tilt, 0 * tilt], axis=2)
    vehicles = Mission.from_toml(bare.mission_text).vehicle_models
    assert vehicles is not None
    limit = np.array([model.rotor_thrust_limit for model in vehicles])
    force = 0.3 * np.broadcast_to(limit[:, None], (len(t), n, 4)).copy()
    force[:, who, who % 4] += 0.1 * who * limit * wave[:, None]
    busy = (t[:, None] > 8.0) & (t[:, None] < 9.0) & (who == 1)
    rates = np.zeros((len(t), n, 3))
    return replace(
        bare, vehicle_attitude=q, vehicle_rates=rates, rotor_force=force, saturated=busy.astype(int)
    )


def nothing_known(samples: int = 30) -> Result:
    """A flight of which only time is known: every other number is NaN."""
    result = a_flight(samples=samples)
    unknown = {
        name: np.full_like(getattr(result, name), np.nan)
        for name in VARIABLES
        if name not in OF_VEHICLES and getattr(result, name).dtype == float and name != "time"
    }
    return a_flight(samples=samples, **unknown)


def drawn(name: str, result: Result) -> Any:
    figure = getattr(plotting, name)(result)
    figure.draw_without_rendering()
    return figure


def by_gid(figure: Any, gid: str) -> list[Any]:
    return figure.findobj(lambda artist: artist.get_gid() == gid)


def covering(figure: Any) -> list[str]:
    """Words above axes that leave the page, or stand on other axes, names of phases or other words."""
    figure.draw_without_rendering()
    found = []
    for ax in figure.axes:
        others = [other for other in figure.axes if other is not ax]
        rest = [
            *(other.bbox for other in others), ax.bbox,
            *(t.get_window_extent() for x in figure.axes for t in x.texts if t.get_gid() == "phase"),
            *(t.get_window_extent() for x in others for t in by_gid(x, "words") if t.get_text()),
            *(other.xaxis.label.get_window_extent() for other in others if other.get_xlabel()),
        ]  # fmt: skip
        for text in by_gid(ax, "words"):
            box = text.get_window_extent()
            if text.get_text() and any(box.overlaps(other) for other in rest):
                found.append(text.get_text())
            if not figure.bbox.padded(1.0).fully_containsx(box.x0):
                found.append(f"{text.get_text()}: off the page")
    return found


def texts(figure: Any) -> list[str]:
    """All that is written; what stands above axes in its parts."""
    written = [text.get_text() for text in figure.findobj(Text) if text.get_visible()]
    return [part for words in written for part in words.replace("\n", " ").split("  ·  ")]


@pytest.fixture(scope="module")
def triangle() -> Result:
    return a_flight()


@pytest.fixture(scope="module")
def cube() -> Result:
    return a_flight(n=8, formation=CUBE)


# -- every flight can be drawn


@pytest.mark.parametrize("flight", [*FLIGHTS, "nothing known", "quadrotors and a point"])
def test_every_flight_can_be_drawn(flight):
    """Each figure draws without a warning: one agent, no edges, no obstacles, stopped, only NaN, different vehicles."""
    few = {"samples": 31} | FLIGHTS.get(flight, {})
    if flight == "quadrotors and a point":
        result = by_quadrotors(["px4-sih", "x500", "point"], lost=2)
    else:
        result = nothing_known() if flight == "nothing known" else a_flight(**few)
    for name in plotting.figure_names():
        figure = drawn(name, result)
        assert isinstance(figure, Figure), name
        assert figure.axes or name == "formations", name


def test_axes_have_units(triangle):
    """Each quantity on an axis has its unit in brackets."""
    for name in plotting.figure_names():
        for ax in getattr(plotting, name)(triangle).axes:
            for label in (ax.get_xlabel(), ax.get_ylabel()):
                assert not label or label.endswith("]"), (name, label)


# -- colours


def test_an_agent_has_the_same_colour_in_every_figure(cube):
    """Lines, discs and legend entries of agent k have the k-th colour wherever they appear."""
    colours = plotting.agent_colours(8)
    seen = set()
    for name in plotting.figure_names():
        figure = getattr(plotting, name)(cube)
        for k, colour in enumerate(colours):
            for artist in by_gid(figure, f"agent-{k + 1}"):
                marked = artist.get_marker() not in ("", "None")
                own = artist.get_markerfacecolor() if marked else artist.get_color()
                assert to_hex(own) == colour.lower(), (name, k)
                seen.add(name)
            for line in figure.findobj(
                lambda a, k=k: isinstance(a, Line2D) and a.get_label() == f"agent {k + 1}"
            ):
                assert to_hex(line.get_color()) == colour.lower(), (name, k)
    assert seen >= {"trajectory", "inputs", "constraint_force", "formations", "summary"}


# Machado, Oliveira and Fernandes (2009), severity 1, on linear RGB.
VISION = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                   [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                     [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                   [0.004733, 0.691367, 0.303900]],
}  # fmt: skip


def cielab(rgb: np.ndarray) -> np.ndarray:
    xyz = np.array([[0.41246, 0.35758, 0.18044], [0.21267, 0.71515, 0.07218],
                    [0.01933, 0.11919, 0.95030]]) @ rgb / [0.95047, 1.0, 1.08883]  # fmt: skip
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("eyes", VISION)
@pytest.mark.parametrize("n", [3, 8, 12])
def test_colours_stay_apart_to_colour_blind_eyes(eyes, n):
    """Any two agents' colours differ by more than 12 in CIELAB, for each kind of colour vision."""
    seen = []
    for colour in plotting.agent_colours(n):
        c = np.array(to_rgb(colour))
        linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        seen.append(cielab(np.clip(np.array(VISION[eyes]) @ linear, 0, 1)))
    assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 12
    assert max(lab[0] for lab in seen) < 75, "too pale on white"


def test_many_agents_all_have_colours_of_their_own():
    """Beyond the palette, colours are still distinct."""
    assert len(set(plotting.agent_colours(100))) == 100


# -- phases


def legend_of(ax: Any) -> list[str]:
    return [text.get_text() for text in ax.get_legend().get_texts()]


def corners(text: Any, points: float = 0.0) -> np.ndarray:
    """Corners (4, 2) [pixels] of a text as it stands, also if it slants."""
    angle = math.radians(text.get_rotation())
    text.set_rotation(0)
    box = text.get_window_extent().padded(points)
    text.set_rotation(math.degrees(angle))
    x, y = text.get_transform().transform(text.get_position())
    c, s = math.cos(angle), math.sin(angle)
    return (box.corners() - [x, y]) @ np.array([[c, s], [-s, c]]) + [x, y]


def overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two rectangles overlap: no line along a side of either lies between them."""
    for box in (a, b):
        for side in (box[1] - box[0], box[2] - box[0]):
            p, q = a @ side, b @ side
            if p.max() <= q.min() or q.max() <= p.min():
                return False
    return True


@pytest.mark.parametrize("name", ["inputs", "clearance", "operation"])
def test_words_stand_above_names_of_phases(name):
    """Limits and worst values stand above the names of the phases, however high the axes are."""
    long = "a name with letters that hang"
    figure = drawn(name, a_flight(phases=[(long, 10.0), (f"{long}, too", 10.0)]))
    assert by_gid(figure, "phase")
    assert not covering(figure)


LENGTHS = {
    "two": [6.0, 14.0],
    "twelve as in the paper": [6, 9, 9, 8, 8, 10, 4, 3, 8, 10, 4, 11],
    "twelve in a rush": [40, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 20, 0.5, 0.5, 0.5, 30],
    "sixty": [1.0] * 60,
}


@pytest.mark.parametrize("name", ["cm", "clearance", "summary"])
@pytest.mark.parametrize("lengths", LENGTHS)
def test_phase_names_do_not_overlap(name, lengths):
    """Names of phases keep clear of each other, of the title and of the figure's edge."""
    phases = [(f"fly to some place far off, {k}", x) for k, x in enumerate(LENGTHS[lengths])]
    figure = drawn(name, a_flight(phases=phases, samples=61))
    labels = by_gid(figure, "phase")
    assert labels
    boxes = [corners(label) for label in labels]
    assert figure._suptitle is not None
    boxes.append(figure._suptitle.get_window_extent().corners())
    for a, b in combinations(boxes, 2):
        assert not overlap(a, b)
    everything = np.concatenate(boxes)
    assert everything.min() >= 0
    assert (everything.max(axis=0) <= figure.bbox.size).all()


@pytest.mark.parametrize("lengths", ["two", "twelve as in the paper", "twelve in a rush"])
def test_every_phase_is_named(lengths):
    """Up to a dozen phases all have their names, over the axes or in the key, in the order of time."""
    phases = [(f"leg {k}", x) for k, x in enumerate(LENGTHS[lengths])]
    figure = drawn("distances", a_flight(phases=phases))
    labels = by_gid(figure, "phase")
    if len(phases) > 2:  # numbers
        key = " ".join(figure._supxlabel.get_text().split())
        assert key == "Phases: " + " · ".join(f"{k + 1} leg {k}" for k in range(len(phases)))
        assert {label.get_text() for label in labels} <= {str(k + 1) for k in range(len(phases))}
    else:
        assert [label.get_text() for label in labels] == [name for name, _ in phases]
    places = [label.get_position()[0] for label in labels]
    assert places == sorted(places)


def test_names_stand_over_their_phases_where_they_fit(triangle):
    """Long phases have their names level and centred, and no key; of a phase of a second, the number stands there."""
    figure = drawn("distances", triangle)
    labels = by_gid(figure, "phase")
    assert [label.get_position()[0] for label in labels] == [3.0, 13.0]
    assert figure._supxlabel is None
    short = drawn("distances", a_flight(phases=[("a name of some length", 1.0), ("fly", 19.0)]))
    assert [label.get_text() for label in by_gid(short, "phase")] == ["1", "2"]


def test_the_summary_says_which_phase_has_which_number(triangle):
    """The summary numbers the phases and has the key to the numbers."""
    words = " ".join(texts(plotting.summary(triangle))).replace("\N{NO-BREAK SPACE}", " ")
    assert "1 establish" in words
    assert "2 fly 1" in words


def test_every_second_phase_is_shaded():
    """Of five phases the second and the fourth are shaded, from their start to their end."""
    figure = drawn("distances", a_flight(phases=[(f"leg {k}", 4.0) for k in range(5)]))
    bands = figure.axes[0].patches
    assert {to_hex(band.get_facecolor()) for band in bands} == {style.BAND.lower()}
    assert [(b.get_x(), b.get_x() + b.get_width()) for b in bands] == [(4.0, 8.0), (12.0, 16.0)]


def test_a_name_may_hold_anything(tmp_path):
    """Dollars, tabs, bells, emoji and Chinese in a phase's name do no harm."""
    phases = [("$x^{", 5.0), ("a\tb\x07 <&>", 5.0), ("起飞 🚁", 5.0), ("long " * 30, 5.0)]
    result = a_flight(phases=phases)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for path in plotting.plot(result, tmp_path, names=["distances", "summary"]):
            if path.suffix == ".svg":
                words = " ".join(ET.parse(path).getroot().itertext())
                assert "$x^{" in words
                assert "a b <&>" in words.replace("\N{NO-BREAK SPACE}", " ")


# -- what the figures show


def test_the_thrust_limit_is_drawn(triangle):
    """The limit is a line at 23.6 N, named, and inside the axes, in the figure and on the summary."""
    for name in ("inputs", "summary"):
        figure = drawn(name, triangle)
        (line,) = [x for x in by_gid(figure, "limit") if x.get_ydata()[0] == 23.6]
        low, high = line.axes.get_ylim()
        assert low < 23.6 < high
        assert "limit 23.6 N" in texts(figure)


def test_each_thrust_limit_is_drawn_and_none_where_there_is_none():
    """Different limits have a line each, an agent's own in its colour; without limits there is none."""
    agents = {"mass": 1.0, "position": START, "thrust_limit": [20.0, 20.0, 30.0]}
    figure = plotting.inputs(a_flight(mission={"agents": agents}))
    lines = {x.get_ydata()[0]: to_hex(x.get_color()) for x in by_gid(figure, "limit")}
    assert lines == {20.0: style.ALERT.lower(), 30.0: plotting.agent_colours(3)[2].lower()}
    assert "limit of 1, 2 20 N" in texts(figure)
    free = plotting.inputs(a_flight(mission=FREE))
    assert not by_gid(free, "limit")


def test_clearance_shows_limits_and_the_worst(triangle):
    """The separation's limit, contact with obstacles, and the least value with when and who."""
    figure = plotting.clearance(a_flight(mission=FENCED))
    assert sorted(x.get_ydata()[0] for x in by_gid(figure, "limit")) == [0.0, 0.5, 1.0]
    k = int(triangle.separation.argmin())
    i, j = sorted(triangle.separation_pair[k] + 1)
    words = f"least {triangle.separation[k]:.3g} m at {triangle.time[k]:.2f} s, agents {i} and {j}"
    assert words in texts(plotting.clearance(triangle))
    k = int(triangle.clearance.argmin())
    thing = triangle.mission.obstacles[triangle.clearance_obstacle[k]].name
    assert any(
        text.endswith(f"agent {triangle.clearance_agent[k] + 1}, {thing}")
        for text in texts(plotting.clearance(triangle))
    )


def near_a_limit(share: float, *, level: float) -> Result:
    """A flight whose clearance dips to a level [m] at a share of its time, close above contact, as in a narrow gap."""
    t = np.linspace(0.0, 20.0, 181)
    room = 9.0 - (9.0 - level) * np.clip(1.6 - 8 * np.abs(t / 20.0 - share), 0.0, 1.0)
    return a_flight(separation=room, clearance=room)


@pytest.mark.parametrize("level", [0.05, 0.6, 1.5, 3.0])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.76, 1.0])
@pytest.mark.parametrize("name", ["clearance", "summary"])
def test_words_cover_nothing(name, share, level):
    """Least values and limits are told above the axes, clear of curves, phases and each other."""
    assert covering(getattr(plotting, name)(near_a_limit(share, level=level))) == []


@pytest.mark.parametrize("top", [9.9, 12.0, 22.0, 23.4, 30.0])
def test_words_of_forces_cover_nothing(top):
    """Peaks and limits are told above the axes, whether thrust is far below its limit, at it, or above."""
    t = np.linspace(0.0, 20.0, 181)[:, None]
    thrust = 9.8 + (top - 9.8) * np.abs(np.sin(t + [0.0, 0.4, 1.1]))
    assert covering(plotting.inputs(a_flight(thrust=thrust))) == []
    pull = (thrust - 9.8)[:, :, None] * [1.0, 0.0, 0.0]
    assert covering(plotting.constraint_force(a_flight(constraint_force=pull))) == []


def test_a_force_that_is_rounding_is_told_in_words():
    """A constraint force of 3e-8 N is no line along zero in empty axes: the figure says what it is, whose and when."""
    force, tension = np.zeros((181, 3, 3)), np.zeros((181, 3))
    force[100, 2, 0], tension[90, 1] = 3.03e-8, -2e-8
    figure = plotting.constraint_force(a_flight(constraint_force=force, multiplier=tension))
    t = np.linspace(0.0, 20.0, 181)
    assert f"only rounding errors: at most 3.03e-08 N, agent 3 at {t[100]:.2f} s" in texts(figure)
    assert f"only rounding errors: at most 2e-08 N, edge 1-3 at {t[90]:.2f} s" in texts(figure)
    assert not any(ax.yaxis.get_tick_params()["labelleft"] for ax in figure.axes)
    nothing = a_flight(constraint_force=0.0 * force, multiplier=0.0 * tension)
    assert texts(plotting.constraint_force(nothing)).count("0 N throughout") == 2


def test_a_small_force_fills_its_axes():
    """A constraint force of 2e-5 N has axes of its size."""
    force = np.zeros((181, 3, 3))
    force[:, 1, 0] = np.linspace(2e-5, 1e-5, 181)
    (above, _) = plotting.constraint_force(a_flight(constraint_force=force)).axes
    assert 2e-5 < above.get_ylim()[1] < 3e-5


def test_what_is_cut_off_is_marked():
    """A peak of 730 N that the axes cut off has a mark there and its height beside; others have none."""
    thrust = np.full((181, 3), 9.8)
    thrust[-1, 1] = 730.0
    pull = 0.1 * np.ones((181, 3))
    pull[-1, 2] = -5e3
    flight = a_flight(thrust=thrust, multiplier=pull, complete=False, ending="singular")
    for name, expected in (("inputs", 2), ("summary", 1)):
        figure = getattr(plotting, name)(flight)
        marks = by_gid(figure, "cut")
        assert len(marks) == expected
        for mark in marks:
            t, y = mark.get_xydata()[0]
            assert t == 20.0
            assert y == mark.axes.get_ylim()[1] < 100
        assert texts(figure).count("off scale: peak 730 N: agent 2 at 20.00 s") == expected
    (mark,) = by_gid(plotting.constraint_force(flight), "cut")
    assert mark.get_marker() == "^"
    assert "off scale: peak 5e+03 N: edge 2-3 at 20.00 s" in texts(
        plotting.constraint_force(flight)
    )
    whole = a_flight(thrust=np.minimum(thrust, 20.0))
    for name in ("inputs", "constraint_force", "summary"):
        assert by_gid(getattr(plotting, name)(whole), "cut") == []


def test_nothing_drawn_leaves_its_axes_unmarked():
    """Curves of forces leave their axes only beneath a mark, in whole flights and in those that broke down."""
    thrust = 9.8 + np.geomspace(1e-3, 1e3, 181)[:, None] * [1.0, 0.3, 0.1]
    thrust[-1] = 1e7, 1e6, -1e7
    for complete in (True, False):
        ending = "" if complete else "singular"
        flight = a_flight(thrust=thrust, multiplier=thrust, complete=complete, ending=ending)
        for name in ("inputs", "constraint_force", "summary"):
            figure = drawn(name, flight)
            for ax in figure.axes:
                low, high = ax.get_ylim()
                marks = {m.get_marker() for m in ax.lines if m.get_gid() == "cut"}
                curves_ = [x for x in ax.lines if x.get_gid() != "cut" and len(x.get_ydata()) > 9]
                beyond = {
                    side
                    for x in curves_
                    for side, out in (
                        ("^", np.nanmax(x.get_ydata()) > high), ("v", np.nanmin(x.get_ydata()) < low)
                    )
                    if out
                }  # fmt: skip
                assert ax.name == "3d" or beyond <= marks, (name, complete, ax.get_ylabel())


def test_what_stands_still_is_told_in_words(triangle):
    """Of a height of 3 m that never changes the figure says so, in a low row, without a scale of rounding errors."""
    place = np.broadcast_to([0.0, 0.0, 3.0], (181, 3)).copy()
    place[:, 0] = triangle.time
    place[:, 2] += 4e-8 * np.sin(triangle.time)
    speed = np.broadcast_to([1.0, 0.0, 0.0], (181, 3))
    phases = [("establish", 20.0)]
    flight = a_flight(
        cm=place, cm_velocity=speed, cm_reference=place, cm_velocity_reference=speed, phases=phases
    )
    figure = drawn("cm", flight)
    assert "3 m throughout, within 4e-08" in texts(figure)
    words = [text for ax in figure.axes for text in ax.texts if "throughout" in text.get_text()]
    for text in words:  # above the rings of waypoints, which have a radius of 2.5 points
        box, ax = text.get_window_extent(), text.axes
        line = ax.transAxes.transform((0.0, 0.5))[1]
        assert line + 3 * figure.dpi / 72 < box.y0 < box.y1 < ax.bbox.y1
    assert "1 m/s throughout" in texts(figure)
    assert texts(figure).count("0 m/s throughout") == 2
    x, speed_x, y, _, z, _ = figure.axes
    assert list(z.get_yticks()) == [3.0]
    assert y.bbox.height == pytest.approx(z.bbox.height)
    assert z.bbox.height < 0.6 * x.bbox.height == pytest.approx(0.6 * speed_x.bbox.height)
    moving = a_flight(cm=place + 0.01 * np.sin(triangle.time)[:, None], phases=phases)
    assert not any("m throughout" in text for text in texts(plotting.cm(moving)))


def test_axes_of_the_summary_stand_where_they_are():
    """Axes over time stand in the same places whatever their numbers, below each other."""
    small, large = (a_flight(samples=31, thrust=np.full((31, 3), x)) for x in (1.5, 12345.5))
    places = [
        [ax.get_position().bounds for ax in drawn("summary", f).axes[2:]] for f in (small, large)
    ]
    assert places[0] == places[1]
    lengths, *_, apart = places[0]
    assert lengths[0] == apart[0]


def test_the_key_of_the_summary_reads_as_words():
    """Phases without names are told by kind, not "1 establish 1", and a dot parts each from the next."""
    phases = [("establish 1", 6.0), ("WP0: clear the ground", 7.0), ("fly 3", 7.0)]
    words = " ".join(texts(plotting.summary(a_flight(phases=phases))))
    plain = words.replace("\N{NO-BREAK SPACE}", " ")
    assert "Phases:  1 establish  ·  2 WP0: clear the ground  ·  3 fly" in plain


def test_room_below_counts_only_agents_above_each_other():
    """Two spheres of 0.25 m, 2 m above each other: 1.5 m apart; side by side: none to speak of."""
    result = a_flight(n=2, formation=None, samples=2)
    position = np.array([[[0, 0, 0], [0.4, 0, 2.0]], [[0, 0, 0], [0.6, 0, 2.0]]])
    np.testing.assert_allclose(
        samples(
            a_flight(n=2, formation=None, samples=2, position=position), "separation_below"
        ).worst,
        [1.5, np.nan],
    )
    assert len(samples(result, "separation_below").worst) == 2


def test_every_edge_has_a_line_and_few_legend_entries(cube):
    """The cube's 28 edges are all drawn, in a colour for each length, with a legend of three lengths."""
    (ax,) = drawn("distances", cube).axes
    flown = [x for x in ax.lines if x.get_linestyle() == "-" and len(x.get_xdata()) > 2]
    assert len(flown) == len(cube.edges) == 28
    assert legend_of(ax) == [
        "12 edges: 4 m", "12 edges: 5.66 m", "4 edges: 6.93 m", "reference",
    ]  # fmt: skip
    last = {round(float(x.get_ydata()[-1]), 2): to_hex(x.get_color()) for x in flown}
    assert len(set(last.values())) == len(last) == 3


def test_few_edges_have_names(triangle):
    """The triangle's edges each have their entry, agents counted from 1."""
    assert legend_of(plotting.distances(triangle).axes[0]) == ["1-2", "1-3", "2-3", "reference"]


def test_euler_angles_do_not_jump():
    """Two turns about z show as a straight line to 720 deg, and nothing before the frame is attached."""
    yaw = np.linspace(0, 4 * np.pi, 101)
    q = att.quaternion_from_euler(np.column_stack([0 * yaw, 0 * yaw, yaw]))
    q[:20] = np.nan
    shown = curves.euler_deg(q)
    assert np.isnan(shown[:20]).all()
    np.testing.assert_allclose(np.diff(shown[20:, 2]), 7.2, atol=1e-9)
    result = a_flight(samples=101, attitude=q, attitude_reference=np.where(np.isnan(q), q, -q))
    flown, wanted, _ = curves.flown_and_wanted_euler(result)
    np.testing.assert_allclose(wanted[20:], flown[20:], atol=1e-9)


def test_a_reference_lies_on_the_turn_that_is_flown():
    """A command of -170 deg is drawn at 190 deg where 185 deg is flown."""
    flown = np.array([[0.0, 0.0, 185.0], [np.nan] * 3])
    wanted = np.array([[0.0, 0.0, -170.0], [0.0, 0.0, -170.0]])
    np.testing.assert_allclose(curves._unwrap_near(wanted, flown)[:, 2], [190.0, -170.0])


def test_shape_error_is_that_of_the_worst_pair():
    """A triangle of 4 m that is flown 10 % too large is 0.4 m off."""
    result = a_flight()
    slots = np.array(result.mission.formation_slots("shape"))
    grown = a_flight(position=np.broadcast_to(1.1 * slots + 7.0, result.position.shape))
    np.testing.assert_allclose(curves.greatest_pair_error(grown), 0.4)


def test_many_samples_are_light_and_keep_their_peaks():
    """Of 20,001 samples an SVG has what can be seen of them, with the single sample that peaks."""
    thrust = np.full((20_001, 3), 9.8) + 0.1 * np.sin(np.linspace(0, 90, 20_001))[:, None]
    thrust[7_777, 1] = 20.0
    flight = a_flight(samples=20_001, thrust=thrust)
    (svg,) = plotting.render_figure(flight, "inputs", ["svg"]).values()
    assert len(svg) < 200_000
    (path,) = [e for e in ET.fromstring(svg).iter() if e.get("id") == "agent-2"][:1]
    (curve,) = [e.get("d", "") for e in path.iter() if e.tag.endswith("}path")]
    heights = np.array([float(y) for y in re.findall(r"[ML] \S+ (\S+)", curve)])
    usual = np.median(heights)
    assert usual - heights.min() > 20 * (heights.max() - usual)


def test_a_flight_that_breaks_down_is_still_readable():
    """A thrust of 1e6 N in the last sample does not flatten what was flown before."""
    thrust = np.full((181, 3), 9.8)
    thrust[-1] = 1e6
    wild = plotting.inputs(a_flight(thrust=thrust, complete=False, ending="singular"))
    assert all(ax.get_ylim()[1] < 50 for ax in wild.axes)
    assert any("1e+06 N" in text for text in texts(wild))
    assert any("incomplete, stopped at 20.00 s" in text for text in texts(wild))


# -- space


@pytest.mark.parametrize("name", ["trajectory", "summary"])
@pytest.mark.parametrize("flight", ["no obstacles, no limits", "one agent", "two agents, stopped"])
def test_three_dimensions_have_one_scale(name, flight):
    """A metre is as long in x, y and z: the view is a rotation, cut to two rows, times one scale."""
    figure = drawn(name, a_flight(**FLIGHTS[flight]))
    (ax,) = [ax for ax in figure.axes if ax.name == "3d"]
    origin, *units = space._screen_positions(ax, np.vstack([np.zeros(3), np.eye(3)]))
    A = np.array(units).T - origin[:, None]
    scale = np.linalg.norm(A[0])
    np.testing.assert_allclose(A @ A.T / scale**2, np.eye(2), atol=1e-6)


@pytest.mark.parametrize("flight", [f for f in FLIGHTS if f != "one sample"])
def test_everything_in_space_is_in_the_picture(flight):
    """All agents at all times, all obstacles and waypoints lie inside their part of the trajectory's figure."""
    result = a_flight(**FLIGHTS[flight])
    figure = drawn("trajectory", result)
    view = space.trajectory_scene(result)
    spatial, above = figure.axes
    points = np.concatenate(
        [result.position.reshape(-1, 3), *(shape.extent for shape in view.shapes)]
    )
    inside = space._screen_positions(spatial, points) / figure.bbox.size
    assert (inside > [0, 0.05]).all()
    assert (inside < [0.62, 0.97]).all()
    flat = above.transData.transform(points[:, :2])
    assert (flat >= above.bbox.min).all()
    assert (flat <= above.bbox.max).all()
    assert (points >= view.low - 1e-9).all()
    assert (points <= view.high + 1e-9).all()


def test_the_formation_is_drawn_at_both_ends_and_not_on_top_of_itself(triangle):
    """The first and last sample are drawn, and no two drawn formations lie within each other's shape."""
    shots = space.trajectory_scene(triangle).shots
    assert (shots[0], shots[-1]) == (0, len(triangle.time) - 1)
    assert 3 < len(shots) < 25
    r = triangle.position[shots]
    for a, b in combinations(r[1:-1], 2):
        assert np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))) > 1.0


def test_a_flight_without_edges_still_draws_its_agents():
    """Without any edge there are paths, starts and ends, in both views."""
    figure = plotting.trajectory(a_flight(n=4, formation=None))
    for k in range(4):
        assert len(by_gid(figure, f"agent-{k + 1}")) == 2
    assert len(by_gid(figure, "start")) == len(by_gid(figure, "end")) == 8
    assert "no edges" in texts(plotting.distances(a_flight(n=4, formation=None)))


def test_a_log_beside_its_plan_shows_who_drifted_when():
    """The vehicle that was off its slot is in bold then, and named with how far; of other flights there is a note."""
    figure = plotting.plan_and_flight(drifting(4, 2, 20.0, 30.0, 1.5, 0.2))
    above, below = figure.axes
    assert len(by_gid(figure, "drift")) == 2
    (bold,) = [line for line in below.lines if line.get_gid() == "drift"]
    ends = np.asarray(bold.get_xdata())[[0, -1]]
    assert ends == pytest.approx([20.0, 30.0], abs=0.051)
    assert bold.get_color() == plotting.agent_colours(4)[2]
    low, high = below.collections[2].get_paths()[0].get_extents().get_points()[:, 1]
    assert (low, high) == pytest.approx((0.0, 1700.0))
    assert any(words.startswith("log3: 1500 mm at 2") for words in texts(figure))
    assert above.lines
    assert "no log against a plan" in texts(plotting.plan_and_flight(swarm(3, 4.0)))


def test_a_huge_obstacle_does_not_shrink_the_flight():
    """Of a wall a hundred kilometres long only what stands near the flight is shown."""
    wall = {"kind": "box", "name": "wall", "min": [-1e5, 20.0, 0.0], "max": [1e5, 21.0, 50.0]}
    near = space.trajectory_scene(a_flight(mission={"obstacles": [wall]}))
    assert near.shapes
    assert np.ptp([near.low, near.high], axis=0).max() < 100


@pytest.mark.parametrize(("n", "formation"), [(3, TRIANGLE), (8, CUBE), (4, CHAIN)])
def test_a_formation_shows_its_graph(n, formation):
    """Every edge is a line between its two agents, which carry their numbers; slots have body axes."""
    result = a_flight(n=n, formation=formation)
    figure = drawn("formations", result)
    for i, j in result.edges:
        (edge,) = by_gid(figure, f"edge-{i + 1}-{j + 1}")
        ends = [by_gid(figure, f"agent-{k + 1}")[0].get_xydata()[0] for k in (i, j)]
        np.testing.assert_allclose(edge.get_xydata()[[0, -1]], ends)
    assert {str(k + 1) for k in range(result.n_agents)} <= set(texts(figure))
    assert len(by_gid(figure, "body-axis")) == (0 if formation is CHAIN else 3)


@pytest.mark.parametrize("shape", ["v", "line", "polygon"])
def test_nothing_covers_a_formation(shape):
    """Names of body axes and the legend stand beside agents and the lengths of edges."""
    figure = drawn("formations", a_flight(n=7, formation={"shape": shape, "size": 3.0}))
    agents = [by_gid(figure, f"agent-{k}")[0].get_window_extent() for k in range(1, 8)]
    names = [x.get_window_extent() for x in by_gid(figure, "body-axis")]
    assert len(names) == 3
    for box in [*names, *(x.get_window_extent() for x in figure.legends)]:
        assert not any(box.overlaps(agent) for agent in agents)


def test_names_of_axes_stand_off_their_numbers():
    """In a long and flat scene too, and at night, the name of an axis in space covers none of its numbers."""
    flight = a_flight()
    place = flight.position * [3.0, 0.4, 0.3]
    flat = drawn("trajectory", replace(flight, position=place, cm=place.mean(axis=1))).axes[0]
    lights = drawn("trajectory", simulate(load_mission("change-of-picture"))).axes[0]
    for axis in (flat.xaxis, flat.yaxis, lights.xaxis, lights.yaxis, lights.zaxis):
        name = corners(axis.label)
        numbers = [corners(tick.label1) for tick in axis.get_major_ticks()]
        assert not any(overlap(name, number) for number in numbers)


def test_a_graph_without_slots_is_spread_out():
    """A chain of four distances is drawn as a line: each shortest path as long as it is."""
    result = a_flight(n=4, formation=CHAIN)
    places, placed = sketches.slots_or_layout(result.mission, "shape")
    assert not placed
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), 4.0, atol=1e-6)
    assert np.linalg.norm(places[0] - places[3]) == pytest.approx(12.0)


@pytest.mark.parametrize("edges", [True, False])
def test_errors_are_named_by_what_is_drawn(edges):
    """Where slots alone hold a formation, its figure of errors speaks of no edge."""
    flight = a_flight(formation=TRIANGLE if edges else TRIANGLE | {"edges": []})
    words = " ".join(texts(drawn("constraint_error", flight)))
    assert ("edge" in words or "Constraint" in words) == edges
    assert "error of all pairs" in words


def test_a_shape_without_any_error_is_told_in_words():
    """Slots that are met to the bit have errors of zero, which no axis of logarithms has."""
    slots = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    flight = a_flight(
        formation={"slots": slots.tolist(), "edges": []},
        position=np.broadcast_to(slots, (181, 3, 3)),
        slot_position=np.broadcast_to(slots, (181, 3, 3)),
    )
    assert "0 m throughout" in texts(plotting.constraint_error(flight))


def test_every_formation_of_the_mission_is_drawn():
    """A mission with two formations has both sketches, also of the one never flown."""
    both = {"shape": TRIANGLE, "row": {"shape": "line", "size": 4.0}}
    words = texts(plotting.formations(a_flight(mission={"formations": both})))
    assert {"shape", "row", "triangle, 3 edges", "line, 3 edges"} <= set(words)


def test_a_flight_has_no_empty_figures(tmp_path):
    """Figures with nothing to show are left out, and say why when they are asked for."""
    calm = a_flight(disturbance_force=None)
    files = {p.stem for p in plotting.plot(calm, tmp_path, formats=["svg"])}
    assert files == set(plotting.figure_names()) - {
        "disturbance",
        "rotors",
        "vehicles",
        "operation",
        "motion",
        "messages",
        "plan_and_flight",
    }
    assert "still air" in texts(plotting.disturbance(calm))
    unknown = np.full((181, 4), np.nan)
    free = a_flight(n=4, formation=None, attitude=unknown, attitude_reference=unknown)
    missing = set(plotting.figure_names()) - set(plotting.figure_names(free))
    assert missing == {
        "distances", "attitude", "constraint_force", "constraint_error", "formations",
        "rotors", "vehicles", "operation", "motion", "messages", "plan_and_flight",
    }  # fmt: skip
    assert "no body frame attached" in texts(plotting.attitude(free))
    alone = a_flight(n=1, formation=None, mission={"obstacles": [], "limits": {}})
    assert "clearance" not in plotting.figure_names(alone)


def test_the_figure_of_an_operator():
    """Altitude, speeds, separation and clearance with their limits; single vehicles on demand."""
    data = {
        "schema_version": 1, "name": "up", "limits": {"speed": 9.5, "separation": 0.5},
        "agents": {"mass": 1.0, "position": [[2.0 * i, 0.0, 0.3 + 0.1 * i] for i in range(4)]},
        "obstacles": [{"kind": "ground"}],
        "phases": [{"kind": "takeoff", "height": 12.0, "duration": 4.0}],
    }  # fmt: skip
    flight = simulate(Mission.from_dict(data))
    assert "operation" in plotting.figure_names(flight)
    figure = plotting.operation(flight)
    labels = [ax.get_ylabel() for ax in figure.axes[:5]]
    assert labels[:3] == ["altitude [m]", "speed [m/s]", "vertical [m/s]"]
    assert "limit 9.5 m/s" in texts(figure)
    one = plotting.operation(flight, [3])
    assert "agent 3" in texts(one)
    (line,) = [x for x in one.axes[0].lines if np.size(x.get_ydata()) > 10]
    assert np.asarray(line.get_ydata())[-1] == pytest.approx(flight.position[-1, 2, 2])
    with pytest.raises(ValueError, match="no agent 5"):
        plotting.operation(flight, [5])


@pytest.mark.parametrize("name", ["statue", "bridge-inspection", "narrow-passage"])
def test_an_obstacle_seen_from_above_covers_its_hull(name):
    """What is painted of a convex obstacle from above is as large as the hull that Qhull finds, without holes."""
    for thing in load_mission(name).solids:
        faces = np.clip(outline_of_solid(thing.solid).triangles, -100.0, 100.0)
        hull = ConvexHull(faces.reshape(-1, 3)[:, :2])
        figure = Figure(figsize=(4, 4), dpi=100)
        ax = figure.add_axes(
            (0, 0, 1, 1), xlim=hull.min_bound[:1].tolist() + hull.max_bound[:1].tolist()
        )
        ax.set_ylim(hull.min_bound[1], hull.max_bound[1])
        ax.axis("off")
        ax.add_patch(PathPatch(area_from_above(faces), facecolor="black", linewidth=0))
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        painted = np.mean(1.0 - np.asarray(canvas.buffer_rgba())[..., 0] / 255)
        assert painted * np.prod(hull.max_bound - hull.min_bound) == pytest.approx(
            hull.volume, rel=0.01
        )


# -- files


def test_files_appear_in_both_formats(triangle, tmp_path):
    """Each figure is a PNG of 150 to 200 dpi and an SVG whose text is text."""
    paths = plotting.plot(triangle, tmp_path / "new" / "folder")
    assert {p.name for p in paths} == {
        f"{name}.{kind}" for name in plotting.figure_names(triangle) for kind in ("png", "svg")
    }
    assert sorted(p.name for p in (tmp_path / "new" / "folder").iterdir()) == sorted(
        p.name for p in paths
    )
    for path in paths:
        if path.suffix == ".png":
            with Image.open(path) as image:
                assert 150 <= image.info["dpi"][0] <= 200
                assert image.width >= 900
        else:
            root = ET.parse(path).getroot()
            assert root.tag == "{http://www.w3.org/2000/svg}svg"
            words = " ".join("".join(e.itertext()) for e in root.iter() if e.tag.endswith("}text"))
            assert "made-up" in words or path.stem == "summary"
            if path.stem in OVER_TIME:
                assert "time [s]" in words
                assert "establish" in words


def test_names_and_formats_choose(triangle, tmp_path):
    """Only the figures and formats asked for are written, in the order asked."""
    paths = plotting.plot(triangle, tmp_path, formats=["svg"], names=["cm", "distances"])
    assert [p.name for p in paths] == ["cm.svg", "distances.svg"]
    assert sorted(tmp_path.iterdir()) == sorted(paths)


@pytest.mark.parametrize("name", ["inputs", "attitude", "summary", "trajectory", "formations"])
def test_titles_may_be_left_out(triangle, tmp_path, name):
    """Without titles neither title nor mission is drawn, what is drawn fills the picture, and all else is the same."""
    with_, without = (
        plotting.plot(triangle, tmp_path / str(on), names=[name], formats=["svg", "png"], titles=on)
        for on in (True, False)
    )
    words, rest = (
        [t for e in ET.parse(p[0]).iter() if e.tag.endswith("}text") for t in e.itertext()]
        for p in (with_, without)
    )
    gone = list(words)
    for word in rest:
        gone.remove(word)
    title = "A made-up flight" if name == "summary" else None
    assert len(gone) == 2
    assert "made-up" in gone
    assert title is None or title in gone
    with Image.open(without[1]) as image:
        ink = np.asarray(image.convert("L")) < 250
        rows = np.flatnonzero(ink.any(axis=1))
        assert rows[0] < 40
        assert image.height - rows[-1] < 40
    assert "A made-up flight" in texts(plotting.summary(triangle)), "titles are back afterwards"


def test_an_incomplete_flight_says_so_without_titles(tmp_path):
    """That a flight stopped is no title: it is on the figure all the same."""
    stopped = a_flight(complete=False, ending="singular")
    (path,) = plotting.plot(stopped, tmp_path, names=["inputs"], formats=["svg"], titles=False)
    words = " ".join(
        "".join(e.itertext()) for e in ET.parse(path).iter() if e.tag.endswith("}text")
    )
    assert "incomplete, stopped at 20.00 s" in words
    assert "Thrust of each agent" not in words
    with style.figure_options(titles=False):
        figure = drawn("inputs", stopped)
    assert figure._suptitle is not None
    warning = figure._suptitle.get_window_extent().corners()
    assert not any(overlap(warning, corners(label)) for label in by_gid(figure, "phase"))


def test_fonts_of_a_pdf_are_those_that_publishers_take(triangle, tmp_path):
    """A PDF embeds TrueType fonts; Type 3, which many journals refuse, is not in it."""
    (path,) = plotting.plot(triangle, tmp_path, names=["summary"], formats=["pdf"])
    kinds = set(re.findall(rb"/Subtype /(Type\w+|CIDFontType\w+|TrueType)", path.read_bytes()))
    assert b"Type3" not in kinds
    assert kinds & {b"CIDFontType2", b"TrueType"}


@pytest.mark.parametrize("width", [80.0, 88.0, 130.0, 250.0])
def test_a_figure_fits_its_column(triangle, tmp_path, width):
    """Files have the width that is wanted; legends, titles and names of axes are on the page, and letters keep size."""
    names = ["attitude", "cm", "distances", "constraint_force", "inputs", "clearance", "trajectory"]
    for titles in (True, False):
        for name, figure in zip(
            names, plotting.plot(triangle, names=names, titles=titles, width=width), strict=True
        ):
            assert figure.get_figwidth() == pytest.approx(width / 25.4)
            figure.canvas.draw()  # which moves the names of axes
            page, flat = figure.bbox.padded(1.0), [ax for ax in figure.axes if ax.name != "3d"]
            shown: list[Any] = [*figure.texts, *figure.legends, *(ax.get_legend() for ax in flat)]
            shown += [ax.xaxis.label for ax in flat] + [ax.yaxis.label for ax in flat]
            spatial: list[Any] = [ax for ax in figure.axes if ax.name == "3d"]
            shown += [ax.zaxis.label for ax in spatial]
            for part in shown:
                if part is not None and (not isinstance(part, Text) or part.get_text()):
                    box = part.get_window_extent()
                    assert page.containsx(box.x0), (name, part)
                    assert page.containsx(box.x1), (name, part)
            assert {text.get_fontsize() for ax in figure.axes for text in ax.get_xticklabels()} <= {
                8.0,
                7.0,
                6.5,
            }
    (path,) = plotting.plot(triangle, tmp_path, names=["cm"], formats=["png"], width=width)
    with Image.open(path) as image:
        assert image.width / image.info["dpi"][0] * 25.4 == pytest.approx(width, abs=0.5)


@pytest.mark.parametrize("n", [3, 8, 12, 13])
@pytest.mark.parametrize("width", [80.0, 130.0, None])
def test_the_legend_of_a_trajectory_covers_nothing(n, width):
    """However many rows it has, the legend is below the axes and their names."""
    result = a_flight(n=n, formation=None, samples=20)
    (figure,) = plotting.plot(result, names=["trajectory"], width=width)
    figure.canvas.draw()
    (legend,) = figure.legends
    above = figure.axes[1].get_tightbbox()
    assert above is not None
    assert legend.get_window_extent().y1 <= above.y0


@pytest.mark.parametrize("width", [80.0, 88.0, 130.0])
def test_words_above_axes_are_on_the_page(width):
    """However narrow a figure is, what is written above its axes is on the page and covers nothing."""
    result = a_flight(n=12, samples=41, formation=None, mission=FENCED)
    for figure in plotting.plot(result, names=["clearance", "inputs"], width=width):
        assert covering(figure) == []


@pytest.mark.parametrize("width", [0.0, -88.0, 79.0, 401.0, math.nan])
def test_a_width_has_bounds(triangle, width):
    """A width that no page has is refused with the bounds."""
    with pytest.raises(ValueError, match="80 to 400 mm"):
        plotting.plot(triangle, names=["cm"], width=width)


@pytest.mark.parametrize("n", [1, 7, 12, 13, 60, 200, 201])
def test_the_legend_of_the_summary_is_on_the_page(n):
    """Whatever the number of agents, the legend is on the page, clear of the axes above and the phases below."""
    figure = plotting.plot(a_flight(n=n, formation=None, samples=20), names=["summary"])[0]
    figure.canvas.draw()
    (legend,) = figure.legends
    box, page = legend.get_window_extent(), figure.bbox
    assert page.x0 <= box.x0 < box.x1 <= page.x1
    (phases,) = [text for text in figure.texts if text.get_text().startswith("Phases")]
    assert box.y0 >= phases.get_window_extent().y1
    below = [ax.xaxis.label for ax in figure.axes if ax.get_xlabel() == "time [s]"]
    assert len(below) >= 3
    assert all(box.y1 <= label.get_window_extent().y0 for label in below)


def test_pdf_is_written(triangle, tmp_path):
    """A PDF begins as one and ends as one, and is the same when written again."""
    (first,) = plotting.plot(triangle, tmp_path / "a", names=["inputs"], formats=["pdf"])
    (second,) = plotting.plot(triangle, tmp_path / "b", names=["inputs"], formats=["pdf"])
    data = first.read_bytes()
    assert data.startswith(b"%PDF-")
    assert data.rstrip().endswith(b"%%EOF")
    assert data == second.read_bytes()


@pytest.mark.parametrize(
    ("wrong", "known"), [({"names": ["speed"]}, "clearance"), ({"formats": ["bmp"]}, "svg")]
)
def test_an_unknown_name_is_refused_before_anything_is_drawn(triangle, tmp_path, wrong, known):
    """An unknown figure or format is named, with those there are, and nothing is written."""
    with pytest.raises(ValueError, match=known):
        plotting.plot(triangle, tmp_path, **wrong)
    assert not list(tmp_path.iterdir())


def test_the_same_flight_gives_the_same_files(tmp_path):
    """Drawn twice, also with other settings of matplotlib in between, the files are equal byte by byte."""
    names = ["trajectory", "inputs"]
    first = plotting.plot(a_flight(), tmp_path / "a", names=names)
    with mpl.rc_context({"font.size": 30, "axes.facecolor": "black", "svg.fonttype": "path"}):
        second = plotting.plot(a_flight(), tmp_path / "b", names=names)
    for a, b in zip(first, second, strict=True):
        assert a.read_bytes() == b.read_bytes(), a.name


def test_a_failure_leaves_the_old_file(triangle, tmp_path, monkeypatch):
    """If a picture cannot be put in its place, the old one stays, no part is left, and the error says where."""
    (tmp_path / "cm.png").write_bytes(b"old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(ResultError, match=r"cm\.png.*No space left"):
        plotting.plot(triangle, tmp_path, names=["cm"], formats=["png"])
    assert [p.name for p in tmp_path.iterdir()] == ["cm.png"]
    assert (tmp_path / "cm.png").read_bytes() == b"old"


def test_a_folder_that_is_a_file_is_reported(triangle, tmp_path):
    """A file in the way of the folder is an error for the user, not a traceback."""
    (tmp_path / "x").write_text("here")
    with pytest.raises(ResultError, match="cannot be written"):
        plotting.plot(triangle, tmp_path / "x", names=["cm"], formats=["png"])


def test_drawing_leaves_matplotlib_alone(triangle, tmp_path):
    """Settings are as before, and the backend is not chosen for the user."""
    before = dict(mpl.rcParams)
    plotting.plot(triangle, tmp_path, names=["distances", "trajectory"], formats=["png"])
    assert dict(mpl.rcParams) == before


def test_matplotlib_waits_until_something_is_drawn():
    """Importing the figures imports no matplotlib, and drawing no pyplot."""
    code = (
        "import sys, rigidfleet.plotting as f\n"
        "assert 'matplotlib' not in sys.modules\n"
        "from rigidfleet.plotting.style import apply_style\n"
        "with apply_style(): pass\n"
        "import matplotlib.figure, mpl_toolkits.mplot3d.art3d\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# -- layout


@pytest.mark.parametrize("name", OVER_TIME)
def test_axes_keep_clear_of_one_another(name, cube):
    """Axes with their words and legends stand apart, inside the page, and nothing moves when they are placed again."""
    figure = drawn(name, cube)
    boxes = [ax.get_tightbbox() for ax in figure.axes]
    for a, b in combinations(boxes, 2):
        assert not a.overlaps(b)
    for box in boxes:
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
    widest = figure.bbox.x1 - max(box.x1 for box in boxes)
    assert widest < 0.02 * figure.bbox.width, "no room is wasted"
    places = []
    for _ in range(2):
        with style.apply_style():
            figure.draw_without_rendering()
        places.append([ax.get_position().bounds for ax in figure.axes])
    np.testing.assert_allclose(places[1], places[0], rtol=0, atol=1e-6)  # of the page


@pytest.mark.parametrize(
    "flight", [*FLIGHTS, "two-agents", "single-waypoint", "market-square", "bridge-inspection"]
)
def test_the_summary_is_on_the_page(flight):
    """No number, name or curve of the summary's axes leaves the page or covers another one."""
    if flight in FLIGHTS:
        figure = drawn("summary", a_flight(**{"samples": 31} | FLIGHTS[flight]))
    else:  # errors down to 1e-12 m; long words above axes; small angles; lengths that stay
        figure = drawn("summary", simulate(load_mission(flight)))
    assert covering(figure) == []
    for a, b in permutations(figure.axes[1:], 2):
        assert not a.yaxis.label.get_window_extent().overlaps(b.bbox), a.get_ylabel()
    for ax in figure.axes[1:]:
        box = ax.get_tightbbox()
        assert box is not None
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1, ax.get_ylabel()
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1, ax.get_ylabel()


@pytest.mark.parametrize("flight", ["hill-search", "market-square", "lossy-passage", "statue"])
def test_names_of_waypoints_stay_in_the_view_from_above(flight):
    """With their outlines of 1.25 points, whether their waypoints are near its right side or its upper one.

    None covers another one.
    """
    figure = drawn("summary", simulate(load_mission(flight)))
    above = figure.axes[1]
    names = [text for text in above.texts if isinstance(text, Annotation)]
    assert names
    for name in names:
        box = name.get_window_extent().padded(1.25 * figure.dpi / 72)
        assert (box.min >= above.bbox.min).all(), name.get_text()
        assert (box.max <= above.bbox.max).all(), name.get_text()
        others = [x.get_window_extent() for x in names if x is not name]
        assert not name.get_window_extent().count_overlaps(others), name.get_text()


def test_a_legend_has_each_look_of_fences_once():
    """All of many fences and places with people are in the legend, those that look alike in one entry."""
    corners = [[0, 0], [30, 0], [30, 30]]
    fences = [
        {"kind": "inclusion", "name": f"f{k}", "polygon": corners, "soft": k > 3} for k in range(8)
    ]
    people = [{"name": "crowd", "polygon": corners}]
    flight = a_flight(mission={"fences": fences, "people": people})
    (legend,) = draw_ground(flight, flight.position[..., :2]).legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names[2:] == ["f0, f1, f2, f3", "f4, f5, f6, f7", "crowd"]


def test_axes_that_find_no_room_stay(triangle):
    """A figure too small for its words is drawn all the same."""
    figure = plotting.cm(triangle)
    figure.set_size_inches(1.0, 0.7)
    with pytest.warns(UserWarning, match="making figure larger"):
        figure.draw_without_rendering()
    assert all(ax.bbox.width > 0 and ax.bbox.height > 0 for ax in figure.axes)


# -- many agents -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many():
    """A flight of more agents than can be told apart."""
    return a_flight(
        n=240, samples=41, formation={"shape": "sphere", "size": 2.0, "edges": "neighbours"}
    )


def test_of_many_agents_the_spread_is_drawn(many):
    """Bands from least to greatest instead of lines: at each time they enclose every agent's thrust."""
    ax = plotting.inputs(many).axes[0]
    (band,) = [c for c in ax.collections if c.get_gid() == "spread"]
    edge = np.array(band.get_paths()[0].vertices)
    for k in (3, 20, 37):
        at = edge[np.isclose(edge[:, 0], many.time[k]), 1]
        thrust = many.thrust[k]
        np.testing.assert_allclose((at.min(), at.max()), (thrust.min(), thrust.max()))
    assert len(ax.lines) < 10


@pytest.mark.parametrize("name", plotting.figure_names())
def test_figures_of_many_agents_are_light(many, name):
    """No figure has an artist for every agent or edge, but for paths."""
    fig = getattr(plotting, name)(many)
    assert sum(len(ax.lines) for ax in fig.axes) <= 2 * style.MANY + 40


def test_many_edges_are_told_by_formation(many):
    """A legend entry for each formation, with the range of its lengths."""
    (entry,) = curves.edge_handles(many)
    d = many.mission.formation_distances("shape")
    assert entry.get_label() == f"{len(d)} edges of shape: {d.min():.3g} to {d.max():.3g} m"


# -- vehicles with rotors


def line_of(ax: Any, agent: int) -> np.ndarray:
    """Values of an agent's line (counted from 1)."""
    return ax.findobj(lambda artist: artist.get_gid() == f"agent-{agent}")[0].get_ydata()


def test_rotors_of_one_model_stand_beside_their_limit():
    """Each vehicle's greatest rotor is drawn as a share of its limit; below, all rotors of the one nearest to it."""
    result = by_quadrotors(["px4-sih"] * 3)
    above, below = drawn("rotors", result).axes
    for i in range(3):
        assert line_of(above, i + 1).max() == pytest.approx(30.0 + 10.0 * i)
    assert [line.get_ydata()[0] for line in by_gid(above, "limit")] == [pytest.approx(100.0)]
    assert "limit 100 %" in above.get_title(loc="right")
    assert below.get_ylabel() == "rotors of agent 3 [N]"
    assert [line.get_ydata().max() for line in below.lines[:4]] == pytest.approx(
        [1.5, 1.5, 2.5, 1.5]
    )
    assert [t.get_text() for t in below.get_legend().get_texts()] == list(LABELS["rotor"])


def test_rotors_of_different_models_are_shares_of_their_limits():
    """A large vehicle's newtons do not hide a small one at its limit: shares are drawn, of points and the lost none."""
    result = by_quadrotors(["x500", "px4-sih", "crazyflie", "point"], lost=2)
    above, below = drawn("rotors", result).axes
    shares = [np.nanmax(line_of(above, i + 1)) for i in range(3)]
    assert shares[::2] == pytest.approx([30.0, 50.0])
    assert np.isnan(line_of(above, 2)[result.time > 10.0]).all()
    assert np.isnan(line_of(above, 4)).all()
    assert "%" in above.get_ylabel()
    assert below.get_ylabel() == "rotors of agent 3 [N]"


def test_tilt_and_saturation_are_those_of_the_vehicles():
    """Tilt is drawn in degrees, and a vehicle's bar lasts while it is saturated."""
    result = by_quadrotors(["px4-sih"] * 3)
    tilt, off, saturated = drawn("vehicles", result).axes
    assert [line_of(tilt, i + 1).max() for i in range(3)] == pytest.approx([0.0, 10.0, 20.0])
    error = np.linalg.norm(result.position - result.slot_position, axis=2)
    np.testing.assert_allclose(line_of(off, 2), error[:, 1])
    (bar,) = [path for bars in saturated.collections for path in bars.get_paths()]
    assert result.saturated is not None
    busy = result.time[result.saturated[:, 1] > 0]
    x, y = bar.vertices[:, 0], bar.vertices[:, 1]
    after = result.time[np.searchsorted(result.time, busy[-1]) + 1]
    assert (x.min(), x.max()) == pytest.approx((busy[0], after))
    assert round(y.mean()) == 2


def test_only_flights_with_rotors_have_their_figures(triangle):
    """Flights of points have neither figure, and those of quadrotors both."""
    own = {"rotors", "vehicles"}
    assert not own & set(plotting.figure_names(triangle))
    assert own <= set(plotting.figure_names(by_quadrotors(["paper"] * 3)))


def test_one_vehicle_beside_people_has_their_distance():
    """The clearance of a single vehicle without obstacles shows its falls to people, and is no empty figure."""
    people = [{"polygon": [[40.0, 40.0], [50.0, 40.0], [50.0, 50.0]]}]
    mission = {"obstacles": [], "limits": {}, "people": people}
    alone = a_flight(n=1, formation=None, mission=mission, velocity=np.zeros((181, 1, 3)))
    assert "clearance" in plotting.figure_names(alone)
    (ax,) = plotting.clearance(alone).axes
    assert ax.get_ylabel() == "falls, to people [m]"
    assert not any(text.get_text() == "no people" for text in ax.texts)
