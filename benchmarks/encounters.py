"""Encounters under [avoidance]: ways that meet, of every kind and vehicle, at random, and how near vehicles come.

Each flight is a mission of its own: vehicles of 0.25 m radius change places and are to keep 0.3 m between their
surfaces. Bearings are random. Ways are level, or tilted by up to 100 mm from end to end, and pass 0, 0.1 or 1 mm beside
each other. The separation is the least in continuous time, by the monitor of the flight, and once more by cubic
splines through the record, which know nothing of the monitor.

    python benchmarks/encounters.py [--runs 500] [--seed 0] [--fast]
"""

from __future__ import annotations

import argparse
import time
from typing import Any, NamedTuple

import numpy as np

import rigidfleet as rf
from rigidfleet.typing import Floats

MODELS = ("paper", "px4-sih", "hummingbird", "crazyflie", "x500", "point")
KINDS = ("pair", "two pairs", "cross", "ring", "overtaking", "standing", "above")
#: Radius, and separation to keep [m]; by how much less still counts as kept.
RADIUS, APART, ALLOWED = 0.25, 0.3, 5e-3


class Encounter(NamedTuple):
    """How near vehicles came."""

    kind: str
    model: str
    least: float  # separation, by the monitor [m]
    splined: float  # by splines through the record
    lost: bool  # the guarantee
    passed: bool  # the verdict
    arrived: bool  # all, within 0.1 m, at the end
    cost: float  # processor time of the flight [s]


def ways(kind: str, rng: np.random.Generator, length: float) -> tuple[Floats, Floats]:
    """Starts and goals (N, 3) [m] of an encounter."""
    angle, up = rng.uniform(0.0, 2.0 * np.pi), np.array([0.0, 0.0, 1.0])
    tilt = rng.choice([0.0, 1e-3, 1e-2, 0.1, rng.uniform(0.0, 0.1)])
    beside = rng.choice([0.0, 1e-4, 1e-3])
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    half, aside = 0.5 * (length * along + tilt * up), beside * across
    if kind == "pair":
        s, g = [-half, half + aside], [half, aside - half]
    elif kind == "two pairs":
        other = rng.uniform(3.0, 6.0) * across
        s = [-half, half + aside, other - half, other + half - aside]
        g = [half, aside - half, other + half, other - half - aside]
    elif kind == "cross":
        second = 0.5 * (length * across - tilt * up)
        s = [-half, half + aside, -second, second + beside * along]
        g = [half, aside - half, second, beside * along - second]
    elif kind == "ring":
        n = int(rng.integers(3, 9))
        around = angle + 2.0 * np.pi * np.arange(n) / n
        s = 0.5 * length * np.stack([np.cos(around), np.sin(around), 0.0 * around], axis=1)
        g = -s
        off = rng.uniform(-1.0, 1.0, (n, 3)) * [beside, beside, 0.5 * tilt]
        s, g = s + off, g + off
    elif kind == "overtaking":
        behind = rng.uniform(1.5, 3.0) * along
        s, g = [-half - behind, aside - 0.2 * half], [half + behind, aside + 0.2 * half]
    elif kind == "standing":
        s, g = [-half, aside], [half, aside]
    else:
        high = 0.25 * length * up + 0.5 * tilt * along
        s, g = [-high, high + aside], [high, aside - high]
    return np.array(s), np.array(g)


def encounter(k: int, seed: int = 0, *, fast: bool = False) -> tuple[str, str, dict[str, Any]]:
    """Kind, model and mission of encounter k; kinds take turns, then models."""
    rng = np.random.default_rng([seed, k])
    kind, model = KINDS[k % len(KINDS)], MODELS[k // len(KINDS) % len(MODELS)]
    length, blend = rng.uniform(4.0, 20.0), rng.uniform(4.0, 10.0)
    if not fast:
        length, blend = rng.uniform(6.0, 12.0), rng.uniform(6.0, 12.0)
    s, g = ways(kind, rng, length)
    vehicle: dict[str, Any] = {"model": model}
    if model == "point":
        vehicle |= {"mass": 1.0, "thrust_limit": 20.0}
    establish = {"kind": "establish", "formation": "start", "blend": 2.0, "duration": 3.0}
    swap = {"kind": "reshape", "formation": "goal", "alignment": "none"}
    return kind, model, {
        "schema_version": 1, "name": f"encounter-{k}", "smoothness": "jerk", "output_step": 0.01,
        "vehicles": {"own": vehicle},
        "agents": {"vehicle": "own", "radius": RADIUS, "position": (s + [0.0, 0.0, 10.0]).tolist()},
        "avoidance": {"separation": APART},
        "formations": {
            name: {"slots": x.tolist(), "edges": []} for name, x in (("start", s), ("goal", g))
        },
        "phases": [establish, swap | {"blend": blend, "duration": blend + 15.0}],
    }  # fmt: skip


def splined(result: rf.Result) -> float:
    """Least separation [m] of any two on cubic splines through recorded positions and velocities, ten places a step."""
    i, j = np.triu_indices(result.position.shape[1], 1)
    x, v = (y[:, i] - y[:, j] for y in (result.position, result.velocity))
    h, least = np.diff(result.time)[:, None, None], np.inf
    for u in np.linspace(0.0, 1.0, 11):
        at = (1 + 2 * u) * (1 - u) ** 2 * x[:-1] + u * u * (3 - 2 * u) * x[1:]
        at += h * u * (1 - u) * ((1 - u) * v[:-1] - u * v[1:])
        least = min(least, float(np.linalg.norm(at, axis=2).min()))
    return least - 2.0 * RADIUS


def fly(k: int, seed: int = 0, *, fast: bool = False) -> Encounter:
    """Fly and judge encounter k."""
    kind, model, data = encounter(k, seed, fast=fast)
    mission = rf.Mission.from_dict(data)
    begun = time.process_time()
    result = rf.simulate(mission)
    cost = time.process_time() - begun
    verdict = rf.assess(result)
    least = min(p.extremes["separation"].value for p in result.phases)
    assert result.slot_position is not None
    off = np.linalg.norm(result.position[-1] - result.slot_position[-1], axis=1).max()
    lost = any(not check.passed for check in verdict.checks if check.check == "guarantee")
    return Encounter(
        kind, model, least, splined(result), lost, verdict.passed, bool(off < 0.1), cost
    )


def row(name: str, some: list[Encounter]) -> str:
    """A row of the table."""
    kept = sum(e.least >= APART - ALLOWED for e in some)
    return (
        f"| {name} | {len(some)} | {sum(min(e.least, e.splined) < 0.0 for e in some)} | {kept} |"
        f" {min(e.least for e in some):.3f} | {sum(e.lost for e in some)} | {sum(e.arrived for e in some)} |"
        f" {sum(e.passed for e in some)} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--runs", type=int, default=500, help="encounters")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fast", action="store_true", help="4 to 20 m in 4 to 10 s")
    chosen = parser.parse_args()
    flown = [fly(k, chosen.seed, fast=chosen.fast) for k in range(chosen.runs)]
    print("| encounters | flown | overlap | 0.295 m kept | least [m] | lost | arrive | pass |")
    print("|---|---|---|---|---|---|---|---|")
    for model in MODELS:
        if some := [e for e in flown if e.model == model]:
            print(row(model, some))
    for kind in KINDS:
        if some := [e for e in flown if e.kind == kind]:
            print(row(kind, some))
    print(row("all", flown))
    apart = max(abs(e.least - e.splined) for e in flown)
    print(f"\nMonitor and splines differ by {apart:.1e} m at most.")
    print(f"Processor time of a flight: {np.median([e.cost for e in flown]):.3f} s (median).")


if __name__ == "__main__":
    main()
