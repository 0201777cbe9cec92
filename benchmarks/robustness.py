"""Which shapes come out: shipped and random formations from random starts, by every graph and law.

    make robustness                        the tables of docs/robustness.md, on all cores
    python benchmarks/robustness.py --random 20 --rows "slots" --json out.json

Each formation is flown once in each row. What counts as the intended shape is judged here by all pairs
of agents and by the volume of a tetrahedron, independently of `rigidfleet.assess`, whose verdict is
then held against it.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from itertools import chain, combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pages import markdown, splice

from rigidfleet.assessment import assess
from rigidfleet.errors import FlightError
from rigidfleet.formation import assignment, distance_geometry, graphs, shapes
from rigidfleet.math import rigid_body
from rigidfleet.math.constraint_jacobian import smallest_singular_value
from rigidfleet.mission import Mission, load_mission
from rigidfleet.mission.text import GROUPS
from rigidfleet.planning.reference import shift_and_rotvec
from rigidfleet.result import Result
from rigidfleet.rigidity import RigidityClass, analyse, jacobian
from rigidfleet.simulation.flight import simulate

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Least distance of two random slots, and of two agents at the start [m].
SPACING, APART = 2.0, 1.0
#: Length of a flight [s], that of the paper's Table 1.
FLIGHT = 20.0
#: Laws are compared on formations of so many agents at most.
FEW = 5
#: Formations have so many agents at most.
LARGEST = 20
#: A pair is right within this part of the shortest distance.
TOLERANCE = 0.01
#: What the flight itself has to say, whatever comes near to whom.
_SHAPE_CHECKS = {"complete", "settled", "distances", "shape", "handedness", "order"}
_WHERE = {1: "line", 2: "plane", 3: "space"}


@dataclass(frozen=True)
class Case:
    """A formation and a start."""

    name: str
    slots: Floats  # (N, 3) [m]
    start: Floats  # (N, 3) [m]
    own: Ints | None = None  # the edges it ships with, unless complete

    @property
    def n(self) -> int:
        """Number of agents."""
        return len(self.slots)

    @property
    def dimension(self) -> int:
        """1, 2 or 3: of the formation."""
        return distance_geometry.dimension(self.slots, 1e-3)


@dataclass(frozen=True)
class Row:
    """How the formations are flown."""

    name: str
    graph: str  # minimal, redundant, complete
    control: str = "open"
    reference: str = "shape"  # shape, distances, squares, step
    constraint: dict[str, Any] = field(default_factory=dict)
    assigned: bool = False  # each agent takes the slot that makes the ways short
    most: int = 1000  # agents
    near: bool = False  # from a tenth of the shortest distance beside the slots, not from anywhere
    hold: bool = False  # for the second half of the flight


@dataclass(frozen=True)
class Outcome:
    """What became of one flight."""

    row: str
    case: str
    agents: int
    dimension: int
    end: str  # intended; flexible, other, mirrored, unmet; failure, stall, nan
    noticed: bool  # the verdict agrees
    force: float  # greatest force of an agent beyond its weight [N]
    steps: int
    wall: float  # [s]
    ending: str
    error: float = np.nan  # of the worst pair at the end, in parts of the shortest distance
    same_side: bool = True  # the agents start on the intended side of the mirror
    crossings: int | None = None  # of singular shapes on the way, minimal graphs in space


def _rows() -> Iterator[Row]:
    graphs = ("minimal", "redundant", "complete")
    for graph in graphs:
        yield Row(f"slots, {graph}", graph, control="tracking")
    for reference in ("shape", "distances", "step"):
        for graph in graphs:
            yield Row(f"{reference}, {graph}", graph, reference=reference)
            if (reference, graph == "complete") in {("shape", False), ("step", True)}:
                yield Row(
                    f"{reference}, {graph}, assigned", graph, "open", reference, assigned=True
                )
    yield Row("squares, complete", "complete", reference="squares")
    yield Row("squares, complete, assigned", "complete", reference="squares", assigned=True)


def _law_rows() -> Iterator[Row]:
    laws: dict[str, dict[str, Any]] = {
        "exact": {"solver": "exact"},
        "pinv": {"solver": "pinv"},
        "Tikhonov": {"iterations": 1},
        "iterated": {},
        "spectral": {"solver": "spectral"},
    }
    for law, constraint in laws.items():
        for reference in ("shape", "step"):
            for graph in ("minimal", "complete"):
                name = f"{law}, {reference}, {graph}"
                yield Row(name, graph, "open", reference, constraint, most=FEW)


def _damping_rows() -> Iterator[Row]:
    for start, reference in (("near", "shape"), ("near", "step"), ("anywhere", "shape")):
        for damping in (0.03, "w/4", "auto"):
            yield Row(
                f"{reference}, from {start}, {damping}", "minimal", "open", reference,
                {"damping": damping}, near=start == "near", hold=True,
            )  # fmt: skip


ROWS, LAWS, DAMPING = tuple(_rows()), tuple(_law_rows()), tuple(_damping_rows())
FEW_ROWS = tuple(
    Row(f"{reference}, complete{', assigned' * again}", "complete", "open", reference, assigned=again)
    for reference, again in (
        ("shape", False), ("shape", True), ("distances", False), ("squares", False),
    )
)  # fmt: skip


# -- formations ------------------------------------------------------------------------------------


def cases(count: int = 200, seed: int = 1) -> list[Case]:
    """The shipped formations, and ``count`` random ones: on lines, in planes, in space in turn."""
    return [*shipped(seed), *(random_case(k, seed) for k in range(count))]


def shipped(seed: int) -> list[Case]:
    """The formations of up to 20 agents of missions that show formations, each once, from random starts."""
    found: dict[bytes, Case] = {}
    groups = (GROUPS[group] for group in ("The paper", "Shapes and rigidity", "Vehicles"))
    for mission in map(load_mission, sorted(chain(*groups))):
        for name in mission.formations:
            slots = mission.formation_slots(name)
            if slots is None or len(slots) > LARGEST:
                continue
            edges = mission.formation_edges(name)
            rng = np.random.default_rng([seed, len(found)])
            own = None if len(edges) == len(graphs.complete_graph(len(slots))) else edges
            case = Case(f"{mission.name}: {name}", slots, start(slots, rng), own)
            found.setdefault(np.round(slots, 6).tobytes(), case)
    return list(found.values())


def few_in_space(count: int, seed: int) -> dict[int, list[Case]]:
    """Random formations in space, so many of four agents, of five and of six."""
    return {n: [random_case(3 * k + 2, seed, n) for k in range(count)] for n in (4, 5, 6)}


def random_case(k: int, seed: int, agents: int | None = None) -> Case:
    """Formation k: on a line, in a plane or in space, of 2, 3 or 4 to 20 agents, and a start."""
    rng = np.random.default_rng([seed, 1000 + k, *([agents] if agents else [])])
    d = 1 + k % 3
    n = agents or int(rng.integers(d + 1, LARGEST + 1))
    side = 1.6 * SPACING * n ** (1 / d) * np.exp(rng.uniform(-0.5, 0.5, d))
    slots = np.zeros((n, 3))
    slots[:, :d] = scattered(rng, n, side, SPACING)
    return Case(f"{_WHERE[d]} {k}", rigid_body.centred(slots), start(slots, rng))


def start(slots: Floats, rng: np.random.Generator) -> Floats:
    """A random start in a cube with as much room as a spatial formation has, high above ground."""
    side = np.full(3, 1.6 * SPACING * len(slots) ** (1 / 3))
    return scattered(rng, len(slots), side, APART) + [0.0, 0.0, 20.0]


def scattered(rng: np.random.Generator, n: int, side: Floats, apart: float) -> Floats:
    """n random points in a box, no two nearer than ``apart``; the box grows where they do not fit."""
    points = np.zeros((0, len(side)))
    for trial in range(1, 1_000_000):
        p = rng.uniform(-0.5, 0.5, len(side)) * side * (1 + trial / 2000)
        if not len(points) or np.linalg.norm(points - p, axis=1).min() >= apart:
            points = np.vstack([points, p])
        if len(points) == n:
            return points
    raise RuntimeError("no room for the points")


def named() -> dict[str, list[Case]]:
    """Formations of four kinds for the choice of the damping, each from two starts.

    The flat ones have all edges, as no fewer hold them.
    """
    kinds: dict[str, dict[str, Floats]] = {
        "small": {
            "tetrahedron": shapes.slots("tetrahedron", 4.0, 4),
            "pyramid": shapes.slots("pyramid", 4.0, 5),
            "cube": shapes.slots("cube", 4.0, 8),
        },
        "slender": {
            "cuboid": shapes.slots("cuboid", [8.0, 2.0, 4.0], 8),
            "beam of 12": _beam(4),
            "beam of 36": _beam(12),
        },
        "flat": {
            "square": shapes.slots("square", 4.0, 4),
            "hexagon": shapes.slots("hexagon", 4.0, 6),
            "grid of 16": shapes.slots("grid", 4.0, 16),
        },
        "large": {
            "helix of 30": shapes.slots("helix", [6.0, 3.0, 4.0], 30),
            "sphere of 40": shapes.slots("sphere", 4.0, 40),
        },
    }
    return {
        kind: [
            Case(f"{name}, {k}", slots, start(slots, np.random.default_rng([7, k])),
                 graphs.complete_graph(len(slots)) if kind == "flat" else None)
            for name, slots in ((name, rigid_body.centred(p)) for name, p in some.items())
            for k in range(2)
        ]
        for kind, some in kinds.items()
    }  # fmt: skip


def _beam(stations: int) -> Floats:
    """Triangles one behind the other, 3 m apart, their sides 3 m long."""
    triangle = 3.0 * np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.5, 0.75**0.5]])
    return np.concatenate([triangle + [3.0 * k, 0.0, 0.0] for k in range(stations)])


def edges_of(case: Case, graph: str) -> Ints:
    """Edges of a formation: as few as its dimension needs, half as many more, or all."""
    complete = graphs.complete_graph(case.n)
    if graph == "complete":
        return complete
    rng = np.random.default_rng(case.n)
    few = case.own if case.own is not None else joined(case.slots, case.dimension, rng)
    if graph == "minimal":
        return few
    have = {tuple(e) for e in few.tolist()}
    rest = np.array([e for e in complete.tolist() if tuple(e) not in have], dtype=np.int64)
    extra = min(len(rest), (len(few) + 1) // 2)
    chosen = rng.permutation(len(rest))[:extra]
    return np.vstack([few, rest.reshape(-1, 2)[chosen]])


def joined(slots: Floats, d: int, rng: np.random.Generator) -> Ints:
    """A minimal graph: each agent joined to d earlier ones (fewer at the start), well spread."""
    edges = []
    for j in range(1, len(slots)):
        before = list(combinations(range(j), min(d, j)))
        picks = [before[k] for k in rng.permutation(len(before))[:30]]
        best = max(picks, key=lambda who: _repeat_for_agents(slots[list(who)] - slots[j], d))
        edges += [(i, j) for i in best]
    return np.array(sorted(edges), dtype=np.int64)


def _repeat_for_agents(u: Floats, d: int) -> float:
    """Smallest singular value of the directions u (k, 3), those to one agent from its neighbours."""
    s = np.linalg.svd(u / np.linalg.norm(u, axis=1)[:, None], compute_uv=False)
    return float(s[min(len(u), d) - 1])


def beside(case: Case) -> Case:
    """The same formation, its agents a tenth of its shortest distance beside their slots."""
    rng = np.random.default_rng(case.n)
    offset = 0.1 * distance_geometry.distances(case.slots, graphs.complete_graph(case.n)).min()
    return replace(
        case, start=case.slots + offset * rng.normal(size=case.slots.shape) + [0.0, 0.0, 20.0]
    )


def assigned(case: Case) -> Case:
    """The same start, each agent where the slots are nearer: as assignment = "shortest" has it."""
    order = assignment.assign_slots(case.start, case.slots).order
    return replace(case, start=case.start[np.argsort(order)])


def singular_on_the_way(case: Case, edges: Ints) -> int:
    """How often J of a minimal graph in space loses rank while the shape is blended to.

    J and the six rigid motions make a square matrix: its determinant changes sign there.
    """
    before, after = rigid_body.centred(case.start), rigid_body.centred(case.slots)
    dp = shift_and_rotvec(before, after, np.ones(case.n))[0]
    signs = []
    for s in np.linspace(0.0, 1.0, 200):
        p = before + s * dp
        turns = [np.cross(axis, p).ravel() for axis in np.eye(3)]
        whole = np.vstack([jacobian(p, edges), np.tile(np.eye(3), case.n), turns])
        signs.append(np.linalg.slogdet(whole)[0])
    return int(np.count_nonzero(np.diff(signs)))


# -- flights ---------------------------------------------------------------------------------------


def mission_of(case: Case, row: Row) -> Mission:
    """The mission that takes the formation from its start."""
    phase = {"kind": "establish", "formation": "shape", "until": FLIGHT}
    phase |= {"control": row.control, "reference": row.reference}
    edges, constraint = edges_of(case, row.graph), dict(row.constraint)
    if constraint.get("damping") == "w/4":
        w = smallest_singular_value(case.slots[None], edges)[0] ** 2
        constraint["damping"] = float(np.clip(w / 4, 1e-5, 0.03))
    phases = [phase]
    if row.hold:
        phases = [
            phase | {"until": FLIGHT / 2},
            {"kind": "hold", "until": FLIGHT, "control": "open"},
        ]
    return Mission.from_dict(
        {
            "schema_version": 1,
            "name": "robustness",
            "output_step": 0.1,
            "agents": {"mass": 1.0, "position": case.start},
            "constraint": constraint,
            "formations": {"shape": {"slots": case.slots, "edges": edges + 1}},
            "phases": phases,
        }
    )


def fly(case: Case, row: Row) -> Outcome:
    """Fly one formation in one row, and judge it twice."""
    case = beside(case) if row.near else assigned(case) if row.assigned else case
    edges = edges_of(case, row.graph)
    about = (row.name, case.name, case.n, case.dimension)
    crossings = None
    if row.graph == "minimal" and case.dimension == 3 and row.control == "open":
        crossings = singular_on_the_way(case, edges)
    begun = time.perf_counter()
    try:
        result = simulate(mission_of(case, row))
    except FlightError as error:
        wall = time.perf_counter() - begun
        return Outcome(*about, "failure", True, np.nan, 0, wall, str(error), crossings=crossings)
    wall = time.perf_counter() - begun
    end = judged(case, edges, result)
    verdict = assess(result)
    wrong = any(f.check in _SHAPE_CHECKS and not f.passed for f in verdict.checks)
    weight = np.array([0.0, 0.0, 9.81])
    force = np.linalg.norm(result.input_force + result.constraint_force - weight, axis=2).max()
    steps = result.statistics["steps"] + result.statistics["rejected"]
    noticed = wrong == (end != "intended")
    return Outcome(
        *about, end, noticed, float(force), steps, wall, result.ending,
        worst_pair(case, result.position[-1]), not mirrored(case, case.start), crossings,
    )  # fmt: skip


def judged(case: Case, edges: Ints, result: Result) -> str:
    """How a flight ended, by distances of all pairs and the hand of a large tetrahedron."""
    if not result.complete:
        return "stall" if "steps have been taken" in result.ending else "failure"
    r = result.position[-1]
    numbers = (result.position, result.velocity, result.constraint_force, result.input_force)
    if not all(np.isfinite(x).all() for x in numbers):
        return "nan"
    if worst_pair(case, r) <= TOLERANCE:
        return "mirrored" if mirrored(case, r) else "intended"
    if flexible(case.slots.tobytes(), edges.tobytes()):
        return "flexible"
    error = np.abs(
        distance_geometry.distances(r, edges) - distance_geometry.distances(case.slots, edges)
    ).max()
    return "other" if error <= TOLERANCE * _shortest(case) else "unmet"


@lru_cache(64)
def flexible(slots: bytes, edges: bytes) -> bool:
    """Whether a graph is certain to be flexible; each is asked for in several rows."""
    p, graph = np.frombuffer(slots).reshape(-1, 3), np.frombuffer(edges, dtype=np.int64)
    return analyse(p, graph.reshape(-1, 2)).rigidity_class is RigidityClass.FLEXIBLE


def mirrored(case: Case, r: Floats) -> bool:
    """Whether a large tetrahedron of a spatial formation has the other hand at r (N, 3)."""
    if case.dimension < 3:
        return False
    some = large_tetrahedron(case.slots)
    return volume(r[some]) * volume(case.slots[some]) < 0


def worst_pair(case: Case, r: Floats) -> float:
    """Greatest error of a distance between two agents, relative to the shortest one."""
    every = graphs.complete_graph(case.n)
    error = np.abs(
        distance_geometry.distances(r, every) - distance_geometry.distances(case.slots, every)
    )
    return float(error.max() / _shortest(case))


def _shortest(case: Case) -> float:
    return float(distance_geometry.distances(case.slots, graphs.complete_graph(case.n)).min())


def large_tetrahedron(slots: Floats) -> list[int]:
    """Four agents that span much: far apart, far from their line, far from their plane."""
    a, b = divmod(int(np.linalg.norm(slots[:, None] - slots, axis=2).argmax()), len(slots))
    x = slots - slots[a]
    c = int(np.linalg.norm(np.cross(x, x[b]), axis=1).argmax())
    return [a, b, c, int(np.abs(x @ np.cross(x[b], x[c])).argmax())]


def volume(p: Floats) -> float:
    """Six times the signed volume of a tetrahedron (4, 3)."""
    a, b, c = p[1:] - p[0]
    return float(a @ np.cross(b, c))


# -- the table -------------------------------------------------------------------------------------


def fly_all(work: tuple[Case, Sequence[Row]]) -> list[Outcome]:
    """One formation in all rows."""
    case, rows = work
    return [fly(case, row) for row in rows if case.n <= row.most]


def run(some: Sequence[Case], rows: Sequence[Row], jobs: int) -> Iterator[list[Outcome]]:
    """All flights, a formation at a time, on ``jobs`` processes."""
    fly(some[0], rows[0])  # compiles, if need be, for all
    work = [(case, rows) for case in sorted(some, key=lambda c: -c.n)]
    if jobs == 1:
        yield from map(fly_all, work)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(fly_all, work)


_ELSEWHERE = ("flexible", "other", "mirrored", "unmet")
_FAILED = ("failure", "stall", "nan")


def summary(row: Row, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """A row of the table."""
    mine = [o for o in outcomes if o.row == row.name]
    ends = {end: sum(o.end == end for o in mine) for end in ("intended", *_ELSEWHERE, *_FAILED)}
    by_dimension = {}
    for d, where in _WHERE.items():
        there = [o for o in mine if o.dimension == d]
        intended = sum(o.end == "intended" for o in there)
        by_dimension[where] = intended / len(there) if there else None
    flown = np.array([o.force for o in mine if np.isfinite(o.force)])
    return {
        "row": row.name, "flights": len(mine), **ends, **by_dimension,
        "unnoticed": sum(not o.noticed for o in mine),
        "force_median": float(np.median(flown)) if len(flown) else None,
        "force_95": float(np.quantile(flown, 0.95)) if len(flown) else None,
        "steps": int(np.median([o.steps for o in mine])) if mine else None,
    }  # fmt: skip


_HEAD = (
    "row", "flights", "intended", "line", "plane", "space", "flexible", "other shape", "mirrored",
    "unmet", "solver failures", "not noticed", "peak force, median / 95 % [N]", "steps",
)  # fmt: skip


def cells(s: dict[str, Any]) -> list[str]:
    """A row of the table as text."""
    part = lambda x: "" if x is None else f"{100 * x:.0f} %"  # noqa: E731
    force = "" if s["force_median"] is None else f"{s['force_median']:.3g} / {s['force_95']:.3g}"
    return [
        s["row"],
        str(s["flights"]),
        _fly_in_threads(s["intended"], s["flights"]),
        *(part(s[w]) for w in _WHERE.values()),
        *(str(s[end]) for end in _ELSEWHERE),
        str(sum(s[end] for end in _FAILED)),
        str(s["unnoticed"]),
        force,
        str(s["steps"]),
    ]


def crossings(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Minimal graphs in space, by how often they lose rank on the way: flights, and right ones."""
    lines = []
    for row in ("shape, minimal", "shape, minimal, assigned"):
        mine = [o for o in outcomes if o.row == row and o.crossings is not None]
        for name, times in (("0", [0]), ("1 or 2", [1, 2]), ("3 or more", range(3, 200))):
            there = [o for o in mine if o.crossings in times]
            right = sum(o.end == "intended" for o in there)
            lines.append([row, name, str(len(there)), _fly_in_threads(right, len(there))])
    return lines


def sides(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Spatial formations led by squares, by the side of the mirror on which they start."""
    lines = []
    for row in ("squares, complete", "squares, complete, assigned"):
        for name, side in (("intended", True), ("other", False)):
            there = [
                o for o in outcomes if o.row == row and o.dimension == 3 and o.same_side == side
            ]
            right = sum(o.end == "intended" for o in there)
            hand = sum(o.end == "mirrored" for o in there)
            lines.append(
                [row, name, str(len(there)), _fly_in_threads(right, len(there)), str(hand)]
            )
    return lines


def few_lines(outcomes: dict[int, list[Outcome]]) -> list[list[str]]:
    """Few agents in space, led by all edges, by the side of the mirror on which they start."""
    lines = []
    for n, some in outcomes.items():
        for row in FEW_ROWS:
            line = [str(n), row.name]
            for side in (True, False):
                there = [o for o in some if o.row == row.name and o.same_side == side]
                right = sum(o.end == "intended" for o in there)
                line.append(f"{right} of {len(there)}")
            hand = sum(o.row == row.name and o.end == "mirrored" for o in some)
            lines.append([*line, str(hand)])
    return lines


def damping_lines(outcomes: dict[str, list[Outcome]]) -> list[list[str]]:
    """The choice of the damping, by kind of shape."""
    lines = []
    for kind, some in outcomes.items():
        for row in DAMPING:
            mine = [o for o in some if o.row == row.name]
            right = sum(o.end == "intended" for o in mine)
            errors = [o.error for o in mine]
            error = f"{np.median(errors):.1e} / {max(errors):.1e}"
            force = [o.force for o in mine]
            force = f"{np.median(force):.3g} / {max(force):.3g}"
            steps = f"{np.median([o.steps for o in mine]):.0f}"
            lines.append([kind, row.name, f"{right} of {len(mine)}", error, force, steps])
    return lines


def _fly_in_threads(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else ""


def tables(
    outcomes: Sequence[Outcome], few: dict[int, list[Outcome]], damped: dict[str, list[Outcome]]
) -> dict[str, str]:
    """Every table as Markdown, by the name that it has on the page; of rows that were flown."""
    flown = {o.row for o in outcomes}
    found = {}
    for name, part in (("graphs", ROWS), ("laws", LAWS)):
        lines = [cells(summary(row, outcomes)) for row in part if row.name in flown]
        if lines:
            found[name] = markdown(_HEAD, lines)
    if flown.issuperset(row.name for row in ROWS):
        head = ("row", "singular on the way", "flights", "intended")
        found["crossings"] = markdown(head, crossings(outcomes))
        head = ("row", "starts on the side", "flights", "intended", "mirrored")
        found["sides"] = markdown(head, sides(outcomes))
    if few:
        head = ("agents", "row", "from the intended side", "from the other", "mirrored")
        found["few"] = markdown(head, few_lines(few))
    if damped:
        head = (
            "shapes", "reference, start, damping", "intended", "worst pair, median / most",
            "peak force, median / most [N]", "steps",
        )  # fmt: skip
        found["damping"] = markdown(head, damping_lines(damped))
    return found


def progress(parts: Iterable[list[Outcome]], what: str, whole: int) -> list[Outcome]:
    """All outcomes, and a word on stderr as they come: each time to a terminal, else now and then."""
    outcomes: list[Outcome] = []
    live = sys.stderr.isatty()
    for k, part in enumerate(parts, start=1):
        outcomes += part
        if live or k % 20 == 0 or k == whole:
            end = "" if live and k < whole else "\n"
            print(f"\r{what}: {k} of {whole} formations", end=end, file=sys.stderr, flush=True)
    return outcomes


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, print the tables, write JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--random", type=int, default=200, help="number of random formations")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rows", action="append", help="only rows whose names begin so")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path, help="write every outcome to a file")
    parser.add_argument(
        "--write", type=Path, help="put the tables into a page (docs/robustness.md)"
    )
    asked = parser.parse_args(arguments)
    rows = [r for r in ROWS + LAWS if not asked.rows or r.name.startswith(tuple(asked.rows))]
    some = cases(asked.random, asked.seed)
    begun = time.perf_counter()
    outcomes = progress(run(some, rows, asked.jobs), "rows", len(some))
    few: dict[int, list[Outcome]] = {}
    damped: dict[str, list[Outcome]] = {}
    if not asked.rows:
        for n, part in few_in_space(asked.random // 2, asked.seed).items():
            few[n] = progress(run(part, FEW_ROWS, asked.jobs), f"{n} agents", len(part))
        for kind, part in named().items():
            damped[kind] = progress(run(part, DAMPING, asked.jobs), f"damping, {kind}", len(part))
    found = tables(outcomes, few, damped)
    print("\n".join(found.values()))
    every = [*outcomes, *(o for part in (*few.values(), *damped.values()) for o in part)]
    wall = time.perf_counter() - begun
    print(f"{len(every)} flights, {wall:.0f} s on {asked.jobs} processes")
    if asked.json:
        table = [summary(row, outcomes) for row in rows]
        data = {"table": table, "outcomes": [asdict(o) for o in every]}
        asked.json.write_text(json.dumps(data))
    if asked.write:
        splice(asked.write, {f"flown: {name}": table for name, table in found.items()})
    return 0


if __name__ == "__main__":
    sys.exit(main())
