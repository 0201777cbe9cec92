"""How many: whole flights of large formations, against real time.

``make bench`` runs it. Each formation has a process of its own, so that its memory is its own; the kernel is loaded
and the graph made before the clock starts, and of three flights the median counts (a million agents fly once).
All establish their shape from offsets of 2 % of the spacing, and translate and turn at 0.1 rad/s meanwhile and after:
lattices and spheres by constraint forces alone, the sheet by slots, under a load that would bend it. Errors are of all
edges and of all pairs at the end, and of the sheet its flatness. The show is a whole command, from mission to verdict.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rigidfleet.assessment import assess
from rigidfleet.assessment.fits import fits_by_sample, shape_of_slots
from rigidfleet.formation import distance_geometry, shapes
from rigidfleet.formation.graphs import GRAPHS as DESIGNS
from rigidfleet.math import proximity, rigid_body
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.solvers import METHOD_WORDS
from rigidfleet.result import Result
from rigidfleet.rigidity import spectrum
from rigidfleet.simulation.flight import simulate

SPACING, DURATION, RATE = 2.0, 20.0, 0.1  # [m], [s], [rad/s]
LOAD = 0.05  # on an agent of the sheet, greatest [N]
TOLERANCE = {"rtol": 1e-6, "atol": 1e-5}
#: Flights of the table: kind, agents, and how many times real time they are to reach.
FLIGHTS: list[tuple[str, int, float | None]] = [
    ("lattice, henneberg, body axes", 1000, None),
    ("lattice, henneberg, body axes", 3000, None),
    ("lattice, henneberg, body axes", 10_000, 20.0),
    ("lattice, henneberg", 10_000, None),
    ("lattice, henneberg, from 10 %", 10_000, None),
    ("lattice, henneberg-multilevel, body axes", 10_000, None),
    ("lattice, neighbours within 1.5", 1000, None),
    ("sphere, triangulated", 500, None),
    ("sphere, triangulated", 2000, 5.0),
    ("sphere, triangulated, body axes", 2000, None),
    ("shells, neighbours", 2000, None),
    ("sheet, neighbours and slots", 900, 5.0),
]
#: Those that begin farther from their slots; and whose equations are those of the body frame.
_FAR, _BODY = ", from 10 %", ", body axes"
#: Graphs of the other table: shape, agents, edges and their reach in spacings.
GRAPHS: list[tuple[str, int, str, float | None]] = [
    ("lattice", 1000, "neighbours", 1.5),
    ("lattice", 1000, "henneberg", None),
    ("lattice", 1000, "henneberg-multilevel", None),
    ("sphere", 2000, "neighbours", 1.9),
    ("sphere", 500, "neighbours", 1.9),
    ("sphere", 500, "henneberg", None),
    ("sphere", 500, "henneberg-multilevel", None),
    ("shells", 2000, "neighbours", 1.9),
    ("shells", 500, "neighbours", 1.9),
    ("shells", 500, "henneberg-multilevel", None),
    ("helix of show-1000", 1000, "neighbours", 2.1),
    ("helix of show-1000", 1000, "neighbours", 3.05),
    ("helix of show-1000", 1000, "henneberg-multilevel", None),
]
#: The largest of the table; and a million, flown only if asked for, for its memory [GB].
LARGEST = ("lattice, henneberg, body axes", 100_000, 7.0)
MILLION = ("lattice, henneberg, body axes", 1_000_000, None)
#: Agents of flights whose samples are judged, and how often each is.
JUDGED, TIMES = (500, 1581, 5000, 15_811, 50_000), 3
#: Goals: growth of the time of a step and of judging, flatness of the sheet [m], the show from command to verdict [s].
EXPONENT, JUDGING, FLAT, SHOW, MEMORY = 1.1, 1.2, 5e-3, 60.0, 24.0
ROUNDS = 3
#: What is judged.
WORK: dict[str, Callable[[Result], object]] = {
    "separation": lambda x: proximity.separation_of_remaining(
        x.position, x.mission.agents.radius, x.left
    ),
    "clearance": lambda x: proximity.obstacle_clearances(
        x.position, x.mission.agents.radius, x.mission.obstacles, x.time
    ),
    "verdict": assess,
}


@dataclass
class Flown:
    """One formation: median times [s] of the wall's clock and of the processor, memory [GB], errors [m]."""

    kind: str
    agents: int
    edges: int
    solve: str
    wall: float
    processor: float
    walls: list[float]
    steps: int
    memory: float
    error: float
    shape: float
    flat: float | None
    ending: str


def lattice(n: int) -> np.ndarray:
    """The n points of a cubic lattice that are nearest to its centre, from there outwards."""
    side = np.arange(np.ceil(n ** (1 / 3) - 1e-9))
    p = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    near = ((p - p.mean(axis=0)) ** 2).sum(axis=1)
    return SPACING * p[np.argsort(near, kind="stable")[:n]]


def graph(shape: str, n: int, edges: str, reach: float | None) -> dict[str, Any]:
    """How well a graph holds a shape."""
    if shape.startswith("helix"):
        p = load_mission("show-1000").formation_slots("helix")
    else:
        p = lattice(n) if shape == "lattice" else shapes.slots(shape, SPACING, n)
    assert p is not None
    pairs = DESIGNS[edges](p, reach or 0.0)
    ends = spectrum(p, pairs, np.ones(n))
    return {
        "shape": shape, "agents": n, "graph": edges, "reach": reach, "edges": len(pairs),
        "longest": float(distance_geometry.distances(p, pairs).max()) / SPACING,
        "index": ends.index, "condition": ends.condition if ends.w > 0 else None,
    }  # fmt: skip


def triangulated(p: np.ndarray) -> list[list[int]]:
    """The edges of the convex hull of points, agents from 1."""
    from scipy.spatial import ConvexHull

    faces = ConvexHull(p).simplices
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [0, 2]]])
    return (np.unique(np.sort(pairs, axis=1), axis=0) + 1).tolist()


def mission(kind: str, n: int) -> Mission:
    """The flight of a kind of formation."""
    shape, _, graph = kind.removesuffix(_FAR).removesuffix(_BODY).partition(", ")
    named = {"sheet": "grid", "lattice": None}.get(shape, shape)
    p = lattice(n) if named is None else shapes.slots(named, SPACING, n)
    off = (0.1 if kind.endswith(_FAR) else 0.02) * SPACING
    r = p + off * np.random.default_rng(0).uniform(-1, 1, p.shape)
    # The text of a mission has at most 64 MiB and 10,000,000 numbers: a million start from their slots, at rest.
    few = n >= MILLION[1]
    slots = p.astype(int) if few else p
    form: dict[str, Any] = {"slots": slots.tolist(), "edges": graph.partition(" ")[0]}
    if graph == "triangulated":
        form["edges"] = triangulated(p)
    elif graph == "neighbours within 1.5":
        form["reach"] = 1.5
    exact = graph in ("henneberg", "henneberg-multilevel")
    data: dict[str, Any] = {
        "schema_version": 1,
        "name": shape,
        "agents": {"mass": 1.0, "position": (slots if few else r).tolist()},
        "formulation": "body" if kind.endswith(_BODY) else "inertial",
        "constraint": {"solver": "exact" if exact else "iterated"},
        "formations": {"f": form},
        "integrator": TOLERANCE,
        "output_step": 5.0,
    }
    if shape == "sheet":
        data["tracking"] = {"Q": [400.0, 40.0]}
        data["phases"] = [
            {"kind": "establish", "formation": "f", "duration": 6.0},
            {
                "kind": "fly",
                "position": [10.0, 0.0, 0.0],
                "yaw_deg": float(np.degrees(RATE * (DURATION - 6.0))),
                "duration": DURATION - 6.0,
            },
        ]
        return Mission.from_dict(data)
    if not few:
        data["agents"]["velocity"] = np.cross([0.0, 0.0, RATE], r - r.mean(axis=0)).tolist()
    data["phases"] = [
        {"kind": "establish", "formation": "f", "control": "open", "reference": "step", "duration": 6.0},
        {"kind": "hold", "control": "open", "input_force": [0.1, 0.1, 0.0], "duration": DURATION - 6.0},
    ]  # fmt: skip
    return Mission.from_dict(data)


def bending(width: float) -> Callable[..., np.ndarray]:
    """A load across a sheet of this width [m], in half a wave: edges up, middle down."""

    def force(_t: float, r: np.ndarray, _v: np.ndarray) -> np.ndarray:
        f = np.zeros_like(r)
        f[:, 2] = -LOAD * np.cos(2 * np.pi * (r[:, 0] - r[:, 0].mean()) / width)
        return f

    return force


def fly(kind: str, n: int) -> Flown:
    """Fly and measure, after a small flight that loads the kernel."""
    flown, sheet = mission(kind, n), kind.startswith("sheet")
    slots = flown.formation_slots("f")
    assert slots is not None
    force = bending(float(np.ptp(slots[:, 0]))) if sheet else None
    simulate(mission(kind, 216 if not sheet else 100), force=force)  # compiled, or loaded
    edges = flown.formation_edges("f")  # made once, whatever is flown
    times = []
    for _ in range(ROUNDS if n < MILLION[1] else 1):
        wall, processor = time.perf_counter(), time.process_time()
        result = simulate(flown, force=force, max_step=DURATION)
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    last = result.position[-1]
    fit = next(fits_by_sample(last[None], shape_of_slots(slots), np.arange(n), float))
    error = np.abs(distance_geometry.distances(last, edges) - flown.formation_distances("f")).max()
    thickness = np.linalg.svd(rigid_body.centred(last), full_matrices=False)[2][2]
    off = rigid_body.centred(last) @ thickness
    return Flown(
        kind, n, len(edges), ", ".join(result.statistics["solvers"]) or "dense",
        *(median(column) for column in zip(*times, strict=True)), [wall for wall, _ in times],
        result.statistics["steps"], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        float(error), fit.error, float(np.abs(off).max()) if sheet else None, result.ending,
    )  # fmt: skip


def measured(kind: str, n: int) -> Flown:
    """A flight in a process of its own."""
    command = [sys.executable, __file__, "--one", kind, str(n)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return Flown(**json.loads(done.stdout))


def show() -> dict[str, float]:
    """The shipped show, from the command to its verdict: seconds of the wall's clock and of the processor."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "rigidfleet",
            "run",
            "show-1000",
            "--no-figures",
            "--quiet",
            "--out",
            folder,
        ]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        wall = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        wall = time.perf_counter() - wall
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall": wall, "processor": spent}


def judging() -> dict[str, float]:
    """Exponents of the number of agents in the processor's time of separation, clearance and verdict.

    41 samples of the lattice among two spheres, above the ground; least squares of logarithms.
    """
    things = [
        {"kind": "sphere", "name": f"ball {x:+}", "centre": [x, 0, 0], "radius": 2.0}
        for x in (300, -300)
    ]
    times: dict[str, list[float]] = {name: [] for name in WORK}
    for n in JUDGED:
        data = mission(LARGEST[0], n).to_dict()
        data |= {"obstacles": [{"kind": "ground", "height": -200.0}, *things], "output_step": 0.5}
        data["limits"] = {"separation": 0.3, "speed": 100.0}
        data["agents"]["radius"] = 0.2
        flown = simulate(Mission.from_dict(data))
        for name, work in WORK.items():
            spent = []
            for _ in range(TIMES):
                start = time.process_time()
                work(flown)
                spent.append(time.process_time() - start)
            times[name].append(min(spent))
    agents = np.log(np.array(JUDGED))
    return {name: float(np.polyfit(agents, np.log(t), 1)[0]) for name, t in times.items()}


def growth(rows: list[tuple[Flown, float | None]]) -> float:
    """The exponent of N in the time of a step on the henneberg lattice."""
    found = [(r.agents, r.wall / r.steps) for r, _ in rows if r.kind == LARGEST[0]]
    n, t = np.log(np.array([x for x in found if x[0] < LARGEST[1]])).T
    return float(np.polyfit(n, t, 1)[0])


def table(rows: list[tuple[Flown, float | None]]) -> Table:
    """What has been flown."""
    out = Table(box=None, pad_edge=False, header_style="bold")
    heads = (
        "",
        "agents",
        "edges",
        "solve",
        "steps",
        "wall [s]",
        "CPU [s]",
        "x real time",
        "by CPU",
    )
    for column in (*heads, "goal", "memory [GB]", "edges [m]", "pairs [m]", "flat to [m]"):
        out.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row, goal in rows:
        out.add_row(
            row.kind, f"{row.agents:,}", f"{row.edges:,}", row.solve, str(row.steps), f"{row.wall:.3g}",
            f"{row.processor:.3g}", f"{DURATION / row.wall:.3g}", f"{DURATION / row.processor:.3g}",
            "" if goal is None else f">= {goal:g}",
            f"{row.memory:.2f}", f"{row.error:.1e}", f"{row.shape:.1e}", "" if row.flat is None else f"{row.flat:.1e}",
        )  # fmt: skip
    return out


def goals(
    rows: list[tuple[Flown, float | None]],
    exponent: float,
    exponents: dict[str, float],
    spent: dict[str, float],
) -> list[dict[str, Any]]:
    """Each goal, what came of it by the wall's clock, and whether it is reached."""
    found = [
        (f"{row.agents:,}: {row.kind}, times real time", DURATION / row.wall, goal, True)
        for row, goal in rows
        if goal is not None
    ]
    found += [
        ("flatness of the sheet under its load [m]", row.flat, FLAT, False)
        for row, _ in rows
        if row.flat is not None
    ]
    found += [
        (f"{row.agents:,}: memory [GB]", row.memory, MEMORY, False)
        for row, _ in rows
        if row.agents == MILLION[1]
    ]
    found += [
        ("exponent of a step's time on the lattice", exponent, EXPONENT, False),
        *(
            (f"exponent of the time of its {name}", x, JUDGING, False)
            for name, x in exponents.items()
        ),
        ("show-1000 from command to verdict [s]", spent["wall"], SHOW, False),
    ]
    judged = []
    for name, value, goal, least in found:
        reached = value >= goal if least else value <= goal
        judged.append(
            {"name": name, "value": value, "goal": goal, "least": least, "reached": reached}
        )
    return judged


def main() -> int:
    """Fly all, print the table and the goals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--one", nargs=2, metavar=("KIND", "AGENTS"), help="fly this one, as JSON")
    parser.add_argument("--million", action="store_true", help="fly a million agents, too")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    if arguments.one:
        kind, n = arguments.one
        print(json.dumps(asdict(fly(kind, int(n)))))
        return 0
    console = Console(width=170)
    versions = {p: version(p) for p in ("rigidfleet", "numba", "numpy", "scipy")}
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    load = os.getloadavg()[0]  # a time of the wall's clock means little where others work
    console.print(f"{date.today()}; {machine}; {versions}; load {load:.1f}", highlight=False)
    console.print(f"{DURATION:g} s of flight, {TOLERANCE}", highlight=False)
    flights = [*FLIGHTS, LARGEST, *([MILLION] if arguments.million else [])]
    rows = [(measured(k, n), goal) for k, n, goal in flights]
    console.print(table(rows))
    for method in dict.fromkeys(row.solve for row, _ in rows):
        console.print(f"{method}: {METHOD_WORDS.get(method, method)}", highlight=False)
    exponent, exponents, spent = growth(rows), judging(), show()
    judged = goals(rows, exponent, exponents, spent)
    for goal in judged:
        sign, words = ">=" if goal["least"] else "<=", "reached" if goal["reached"] else "MISSED"
        text = f"{goal['name']}: {goal['value']:.3g}, goal {sign} {goal['goal']:g}: {words}"
        console.print(text, highlight=False, markup=False)
    failed = [f"{row.kind}, {row.agents:,} agents: {row.ending}" for row, _ in rows if row.ending]
    for text in failed:
        console.print(text, highlight=False, markup=False)
    if arguments.json:
        head = {"date": str(date.today()), "machine": machine, "versions": versions, "load": load}
        found = {
            "formations": [asdict(row) | {"goal": goal} for row, goal in rows],
            "duration": DURATION,
        }
        found |= {
            "graphs": [graph(*each) for each in GRAPHS],
            "exponent": exponent,
            "show": spent,
            "goals": judged,
        }
        arguments.json.write_text(json.dumps({"many": head | found}, indent=1))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
