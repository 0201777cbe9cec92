"""Transitions with a proof: how long planning takes, how near vehicles come, how long the ways last.

``make avoidance`` runs it. Times are processor time of one process; makespans are multiples of what the slowest
vehicle needs alone.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.distance import pdist

from rigidfleet.formation import assignment, shapes
from rigidfleet.math import proximity
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission import Mission
from rigidfleet.planning import transfers
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.timing import complete_times
from rigidfleet.simulation.flight import simulate
from rigidfleet.typing import Floats

PROBLEMS = Path(__file__).parent / "problems"
#: Limits of the permutation: speed [m/s], acceleration [m/s^2].
SPEED, ACCELERATION = 8.0, 4.0
#: Distance by which point masses in calm air may come nearer than planned [m].
TRACKED = 1e-6


def clocked(work: Callable[[], Any]) -> tuple[Any, float]:
    begin = time.process_time()
    return work(), time.process_time() - begin


def logo(n: int) -> Floats:
    """A standing picture: random pixels of a raster of 2 m, half of it filled."""
    side = int(np.sqrt(2 * n)) + 1
    pixels = np.stack(np.divmod(np.arange(side * side), side), axis=1) * 2.0
    points = np.zeros((n, 3))
    points[:, ::2] = pixels[np.random.default_rng(0).permutation(len(pixels))[:n]]
    return points


def tour(sizes: list[int]) -> Iterator[list[str]]:
    """Grid -> sphere -> helix -> logo -> grid, spacing 2 m: assignment and proof of each change."""
    for n in sizes:
        stops = {
            "grid": shapes.slots("grid", 2.0, n),
            "sphere": shapes.slots("sphere", 2.0, n),
            "helix": shapes.slots("helix", (20.0, 3.0, 2.0), n),
            "logo": logo(n),
            "grid again": shapes.slots("grid", 2.0, n),
        }
        names = list(stops)
        at = stops["grid"] - stops["grid"].mean(axis=0)
        for before, name in pairwise(names):
            to = stops[name] - stops[name].mean(axis=0)
            order, plan = clocked(
                lambda at=at, to=to: assignment.assign_slots(at, to, turn=np.eye(3)).order
            )
            (least, _, _), proof = clocked(
                lambda at=at, to=to, order=order: assignment.closest_approach(at, to[order])
            )
            d = [float(proximity.nearest(x).min()) for x in (at, to)]
            bound = d[0] * d[1] / np.hypot(*d)
            yield [
                f"{n:,}",
                f"{before} to {name}",
                f"{plan:.2f}",
                f"{proof:.2f}",
                f"{least:.3f}",
                f"{bound:.3f}",
            ]
            at = to[order]


def scattered(rng: np.random.Generator, n: int, flat: bool) -> Floats:
    """Random points (n, 3) [m], 2 m apart at least, in a level plane or in space."""
    axes = 2 if flat else 3
    side = 2.0 * (2.2 * n) ** (1.0 / axes)
    found: list[Floats] = []
    while len(found) < n:
        x = rng.uniform(0.0, side, axes)
        if all(np.linalg.norm(x - y) >= 2.0 for y in found):
            found.append(x)
    points = np.zeros((n, 3))
    points[:, :axes] = found
    return points - points.mean(axis=0)


def flown(kind: str, seed: int) -> tuple[int, float, float]:
    """Agents, least distance flown over the one promised, and that less the certificate [m], of a random change."""
    rng = np.random.default_rng([seed, kind == "reshape"])
    n = int(rng.integers(4, 61))
    a, b = (scattered(rng, n, rng.random() < 0.5) for _ in range(2))
    last = {"formation": "b", "blend": 8.0, "duration": 10.0}
    first = {"kind": "establish", "control": "tracking"} | last
    changes = (
        [first] if kind == "establish" else [first | {"formation": "a"}, {"kind": kind} | last]
    )
    mission = Mission.from_dict(
        {
            "schema_version": 1,
            "name": "random",
            "smoothness": "jerk",
            "assignment": "each",
            "agents": {"mass": 1.0, "radius": 0.0, "position": a + [0, 0, 100]},
            "formations": {k: {"slots": x, "edges": "neighbours"} for k, x in (("a", a), ("b", b))},
            "phases": changes,
        }
    )
    phase = simulate(mission).phases[-1]
    assert phase.planned is not None
    d = [float(proximity.nearest(x).min()) for x in (a, b)]
    least = phase.extremes["separation"].value
    return n, least / (d[0] * d[1] / np.hypot(*d)), least - phase.planned["separation"]


def changes(runs: int) -> Iterator[list[str]]:
    """Random changes as flown, in continuous time, against the bound and the certificate."""
    for kind in ("reshape", "establish"):
        _, share, beyond = (
            np.array(x) for x in zip(*(flown(kind, s) for s in range(runs)), strict=True)
        )
        below = int((beyond < -TRACKED).sum() + (share < 1.0 - TRACKED).sum())
        yield [kind, str(runs), str(below), f"{share.min():.3f}", f"{-beyond.min():.1e}"]


def permutation(n: int, seed: int) -> list[str]:
    """A random permutation of a grid of 2 m, 1 m to keep, by layers with automatic times."""
    side = int(np.ceil(np.sqrt(n)))
    grid = np.zeros((n, 3))
    grid[:, :2] = np.stack(np.divmod(np.arange(n), side), axis=1) * 2.0
    order = np.random.default_rng(seed).permutation(n)
    swap = {"kind": "reshape", "formation": "b", "transition": "layers", "blend": "auto"}
    mission = Mission.from_dict(
        {
            "schema_version": 1,
            "name": "permutation",
            "smoothness": "jerk",
            "agents": {"mass": 1.0, "radius": 0.0, "position": grid + [0, 0, 100]},
            "formations": {
                "a": {"slots": grid, "edges": []},
                "b": {"slots": grid[order], "edges": []},
            },
            "limits": {
                "separation": 1.0,
                "separation_allowance": 0.0,
                "speed": SPEED,
                "acceleration": ACCELERATION,
            },
            "phases": [
                {"kind": "establish", "formation": "a", "blend": 1.0, "duration": 1.0},
                swap | {"duration": "auto"},
            ],
        }
    )
    planned, took = clocked(lambda: preview_phases(complete_times(mission))[0][1:])
    least = min(p.leg.certificate.separation for p in planned if p.leg.certificate is not None)
    assert all(p.leg.certificate is not None for p in planned)
    makespan = float(planned[-1].time[-1] - planned[0].time[0])
    way = float(np.linalg.norm(grid[order] - grid, axis=1).max())
    alone = way / SPEED + SPEED / ACCELERATION
    return [
        f"{n:,}",
        str(seed),
        f"{took:.2f}",
        f"{least:.3f}",
        f"{makespan:.1f}",
        f"{makespan / alone:.2f}",
    ]


def published(some: int | None) -> Iterator[tuple[str, float, float, float]]:
    """Size or name, processor time [s], makespan over the slowest vehicle's, least distance over the one to keep."""
    for e in json.loads((PROBLEMS / "lsc_empty.json").read_text())[:: some or 1]:
        corners = np.array(e["box"])
        yield solved(
            f"{e['agents']} vehicles, LSC", e["start"], e["goal"], 2 * e["radius"], e["max_vel"], e["max_acc"],
            (corners[:3], corners[3:]), e["downwash"],
        )  # fmt: skip
    e = json.loads((PROBLEMS / "dmpc_48.json").read_text())
    at = e["limits"]
    yield solved(
        "48 vehicles, DMPC/RLSS", e["start"], e["goal"], e["min_distance"], np.inf, at["amax"],
        (at["pmin"], at["pmax"]), e["height_scaling"],
    )  # fmt: skip


def solved(name, start, goal, distance, speed, acceleration, box, downwash):
    found, took = clocked(
        lambda: transfers.plan_transfer(
            start,
            goal,
            distance=distance,
            speed=speed,
            acceleration=acceleration,
            box=box,
            downwash=downwash,
        )
    )
    if found is None:
        return name, took, np.inf, 0.0
    # Not the proof: dense samples, beside it.
    ways = Piecewise.b_spline(found.control, found.duration)
    places = ways.at(np.linspace(0, found.duration, 2001)) * [1, 1, 1 / downwash]
    sampled = min(pdist(r).min() for r in places)
    assert sampled >= found.certificate.separation - 1e-9
    alone = transfers.least_duration(start, goal, speed, acceleration)
    return name, took, found.duration / alone, found.certificate.separation / distance


def table(title: str, columns: list[str], rows: Iterator[list[str]]) -> None:
    shown = Table(title=title, title_justify="left")
    for column in columns:
        shown.add_column(column, justify="right")
    for row in rows:
        shown.add_row(*row)
    Console(width=110).print(shown)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="*", default=[1000, 5000, 20_000])
    parser.add_argument(
        "--every", type=int, default=1, help="solve every n-th published problem only"
    )
    parser.add_argument("--random", type=int, default=300, help="fly so many random changes")
    asked = parser.parse_args()
    assignment.assign_slots(
        *np.eye(400, 3)[[range(400), range(400)]], turn=np.eye(3)
    )  # loads SciPy
    table(
        "A tour, assigned at each change and proved",
        ["agents", "change", "assignment [s]", "proof [s]", "least distance [m]", "bound [m]"],
        tour(asked.sizes),
    )
    table(
        "Random changes of 4 to 60 agents, planar and spatial, as flown",
        [
            "change",
            "flights",
            "below the promise",
            "least, over D0 D1 / sqrt(D0^2 + D1^2)",
            "most below the certificate [m]",
        ],
        changes(asked.random),
    )
    table(
        "A labelled random permutation on a grid of 2 m, by layers",
        ["agents", "seed", "planning [s]", "proved [m]", "makespan [s]", "over the slowest alone"],
        (permutation(1000, seed) for seed in range(3)),
    )
    found: dict[str, list[tuple[float, float, float]]] = {}
    for name, *numbers in published(asked.every):
        found.setdefault(name, []).append(tuple(numbers))
    rows = []
    for name, each in found.items():
        took, ratio, kept = (np.array(x) for x in zip(*each, strict=True))
        proved = int((kept >= 1.0).sum())
        rows.append(
            [
                name,
                f"{proved} of {len(each)}",
                f"{took.max():.2f}",
                f"{ratio.max():.2f}",
                f"{kept.min():.3f}",
            ]
        )
    table(
        "Published transfers",
        [
            "problem",
            "proved",
            "most planning [s]",
            "most over the slowest alone",
            "least distance, of that to keep",
        ],
        iter(rows),
    )


if __name__ == "__main__":
    main()
