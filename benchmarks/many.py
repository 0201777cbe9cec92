"""How many: whole flights of large formations, against real time.

``make bench`` runs it. Each flight has a process of its own, so that its memory is its own; the kernel is loaded
and the graph made before the clock starts. All establish their shape from offsets of 2 % of the spacing, and
translate and turn at 0.1 rad/s meanwhile and after: lattice and sphere by constraint forces alone, the sheet by
slots, under a load that would bend it. Errors are of all edges at the end, and of the sheet its flatness.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rigidfleet import formation as shapes
from rigidfleet.mission import Mission
from rigidfleet.simulate import simulate
from rigidfleet.solvers import WORDS

SPACING, DURATION, RATE = 2.0, 20.0, 0.1  # [m], [s], [rad/s]
LOAD = 0.05  # on an agent of the sheet, greatest [N]
TOLERANCE = {"rtol": 1e-6, "atol": 1e-5}
#: Flights of the table: kind, agents, and how many times real time they are to reach.
FLIGHTS: list[tuple[str, int, float | None]] = [
    ("lattice", 1000, None),
    ("lattice", 3000, None),
    ("lattice", 10_000, 20.0),
    ("lattice", 100_000, None),
    ("redundant lattice", 1000, None),
    ("sphere", 500, None),
    ("sphere", 2000, 5.0),
    ("sheet", 900, 5.0),
]
EXPONENT = 1.1


@dataclass
class Flown:
    """One flight: times [s] of the wall's clock and of the processor, memory [GB], error [m]."""

    kind: str
    agents: int
    edges: int
    solve: str
    wall: float
    processor: float
    steps: int
    memory: float
    error: float
    flat: float | None
    ending: str


def lattice(n: int) -> np.ndarray:
    """The n points of a cubic lattice that are nearest to its centre, from there outwards."""
    side = np.arange(np.ceil(n ** (1 / 3) - 1e-9))
    p = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    near = ((p - p.mean(axis=0)) ** 2).sum(axis=1)
    return SPACING * p[np.argsort(near, kind="stable")[:n]]


def triangulated(p: np.ndarray) -> list[list[int]]:
    """The edges of the convex hull of points, agents from 1."""
    from scipy.spatial import ConvexHull

    faces = ConvexHull(p).simplices
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [0, 2]]])
    return (np.unique(np.sort(pairs, axis=1), axis=0) + 1).tolist()


def mission(kind: str, n: int) -> Mission:
    """The flight of a kind of formation."""
    slots = {"sphere": "sphere", "sheet": "grid"}
    p = shapes.slots(slots[kind], SPACING, n) if kind in slots else lattice(n)
    r = p + 0.02 * SPACING * np.random.default_rng(0).uniform(-1, 1, p.shape)
    form: dict[str, Any] = {"slots": p.tolist(), "edges": "neighbours"}
    if kind == "lattice":
        form["edges"] = "joined"
    elif kind == "redundant lattice":
        form["reach"] = 1.5
    elif kind == "sphere":
        form["edges"] = triangulated(p)
    data: dict[str, Any] = {
        "schema_version": 1,
        "name": kind.replace(" ", "-"),
        "agents": {"mass": 1.0, "position": r.tolist()},
        "constraint": {"solver": "exact" if kind == "lattice" else "iterated"},
        "formations": {"f": form},
        "integrator": TOLERANCE,
        "output_step": 5.0,
    }
    if kind == "sheet":
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
    flown = mission(kind, n)
    slots = flown.formation_slots("f")
    assert slots is not None
    force = bending(float(np.ptp(slots[:, 0]))) if kind == "sheet" else None
    small = mission(kind, 216 if kind != "sheet" else 100)
    simulate(small, force=force)  # compiled, or loaded from the cache
    edges = flown.formation_edges("f")  # made once, whatever is flown
    wall, processor = time.perf_counter(), time.process_time()
    result = simulate(flown, force=force)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    last = result.position[-1]
    error = np.abs(shapes.distances(last, edges) - flown.formation_distances("f")).max()
    thickness = np.linalg.svd(shapes.centred(last), full_matrices=False)[2][2]
    off = shapes.centred(last) @ thickness
    return Flown(
        kind, n, len(edges), ", ".join(result.statistics["solvers"]) or "dense", wall, processor,
        result.statistics["steps"], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        float(error), float(np.abs(off).max()) if kind == "sheet" else None, result.ending,
    )  # fmt: skip


def measured(kind: str, n: int) -> Flown:
    """A flight in a process of its own."""
    command = [sys.executable, __file__, "--one", kind, str(n)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return Flown(**json.loads(done.stdout))


def show(console: Console, rows: list[tuple[Flown, float | None]]) -> None:
    """The table."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    heads = ("", "agents", "edges", "solve", "steps", "wall [s]", "CPU [s]", "x real time")
    for column in (*heads, "goal", "memory [GB]", "error [m]", "flat to [m]"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row, goal in rows:
        table.add_row(
            row.kind, f"{row.agents:,}", f"{row.edges:,}", row.solve, str(row.steps), f"{row.wall:.3g}",
            f"{row.processor:.3g}", f"{DURATION / row.wall:.3g}", "" if goal is None else f">= {goal:g}",
            f"{row.memory:.2f}", f"{row.error:.1e}", "" if row.flat is None else f"{row.flat:.1e}",
        )  # fmt: skip
    console.print(table)
    for row, _ in rows:
        if row.ending:
            console.print(f"{row.kind}, {row.agents} agents: {row.ending}", highlight=False)
    for method in dict.fromkeys(row.solve for row, _ in rows):
        console.print(f"{method}: {WORDS.get(method, method)}", highlight=False)  # ty: ignore


def main() -> int:
    """Fly all, print the table, and say how times grow."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--one", nargs=2, metavar=("KIND", "AGENTS"), help="fly this one, as JSON")
    parser.add_argument("--most", type=int, default=1 << 30, help="leave out larger formations")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    if arguments.one:
        kind, n = arguments.one
        print(json.dumps(asdict(fly(kind, int(n)))))
        return 0
    console = Console(width=150)
    versions = {p: version(p) for p in ("rigidfleet", "numba", "numpy", "scipy")}
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    console.print(f"{date.today()}; {machine}; {versions}", highlight=False)
    console.print(f"{DURATION:g} s of flight, {TOLERANCE}, one thread", highlight=False)
    rows = [(measured(k, n), goal) for k, n, goal in FLIGHTS if n <= arguments.most]
    show(console, rows)
    sizes = [(r.agents, r.wall / r.steps) for r, _ in rows if r.kind == "lattice"]
    if len(sizes) > 1:
        n, t = np.log(np.array(sizes)).T
        slope = np.polyfit(n, t, 1)[0]
        console.print(f"lattice: time of a step grows as N^{slope:.2f} (goal <= {EXPONENT:g})")
    if arguments.json:
        head = {"date": str(date.today()), "machine": machine, "versions": versions}
        data = [asdict(row) | {"goal": goal} for row, goal in rows]
        arguments.json.write_text(json.dumps(head | {"rows": data}, indent=1))
    return 0 if all(not row.ending for row, _ in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
