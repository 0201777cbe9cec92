"""What `assess` says of logs of which the truth is known: simulated flights, with noise, clocks and turns made here.

    python benchmarks/evening.py [--flights 500] [--only KIND] [--write docs/logs.md]

Three vehicles, a metre apart, fly a curve in gusts that their plan does not know. What they flew is the truth. Each
kind of log is made of so many flights; its row says in which share of them an interval has the true value. The size of
the noise is stated, but in kinds "from data": there, shares count the flights in which the noise is told.
"""

from __future__ import annotations

import argparse
import resource
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from pages import splice
from scipy.signal import butter, lfilter

import rigidfleet as rf
from rigidfleet.foreign.curves import ASSUMED, Trajectories, curve_through_samples
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.setpoints import ways_of
from rigidfleet.simulation.as_logged import Doubts, judge_log
from rigidfleet.typing import Floats

#: Noise of a coordinate [m], rate of samples [Hz], span of a log [s].
SIGMA, RATE, BEGIN, END = 0.003, 50.0, 0.5, 13.5
#: Kinds of logs, and correlation times of their noise [s].
SLOTS = [[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.5, 0.9, 5.0]]
KINDS = {
    "white": 0.0, "correlated over 0.05 s": 0.05, "correlated over 0.2 s": 0.2, "correlated over 1 s": 1.0,
    "of an estimator": 0.0, "quantised, irregular stamps": 0.0, "dropouts": 0.0, "turned by up to 10 degrees": 0.0,
    "one vehicle late": 0.0, "white, from data": 0.0, "correlated over 0.05 s, from data": 0.05,
    "of an estimator, from data": 0.0,
}  # fmt: skip
#: What is to hold, in shares of flights (of positions, of times).
HELD = ("positions", "separation", "speed", "offset", "turn")
#: Columns of the table that are shares.
SHARES = (*HELD, "noise told", "decided")
#: Share of flights in which intervals are to hold.
SHARE = 0.9
#: Standard errors of an interval of an offset or a turn.
_WIDE = 1.96
#: Drag [N s/m] by which gusts push, small enough to damp nothing.
_DRAG = 1e-3


def mission(seed: int | None, separation: float = 0.1) -> rf.Mission:
    """Three vehicles on a curve; a seed for gusts, or None: as planned."""
    data: dict[str, Any] = {
        "schema_version": 1,
        "name": "evening",
        "agents": {"position": SLOTS, "vehicle": "point", "radius": 0.0},
        "vehicles": {"point": {"model": "point", "mass": 1.0, "thrust_limit": 1e3, "drag": _DRAG}},
        "tracking": {"Q": [60.0, 20.0], "R": 1.0},
        "formations": {"triangle": {"slots": SLOTS}},
        "limits": {"separation": separation},
        "phases": [
            {"kind": "establish", "formation": "triangle", "blend": 1.0, "duration": 2.0},
            {"kind": "fly", "position": [4.0, 1.0, 6.0], "velocity": [1.0, 1.0, 0.0], "duration": 6.0},
            {"kind": "fly", "position": [5.0, 5.0, 5.0], "duration": 6.0},
        ],
        "output_step": 0.02,
    }  # fmt: skip
    if seed is not None:
        gusts = {"model": "first-order", "intensity": 0.2 / _DRAG, "time_scale": 0.5, "seed": seed}
        data["disturbances"] = {"gusts": gusts}
    return rf.Mission.from_dict(data)


def noise(random: np.random.Generator, shape: tuple[int, ...], kind: str) -> Floats:
    """Noise of samples (K, ...) of a kind of log [m]."""
    if kind.startswith("of an estimator"):
        filter_of = butter(2, 2.0 / (0.5 * RATE))
        e = lfilter(*filter_of, random.standard_normal((shape[0] + 500, *shape[1:])), axis=0)[500:]
        return SIGMA * e / e.std()
    e = SIGMA * random.standard_normal(shape)
    if KINDS[kind]:
        share = np.exp(-1.0 / (RATE * KINDS[kind]))
        for k in range(1, len(e)):
            e[k] = share * e[k - 1] + np.sqrt(1.0 - share**2) * e[k]
    return e


def log_of(way: Piecewise, kind: str, random: np.random.Generator) -> tuple[Trajectories, Any]:
    """A log of ways (K, N, 3, P), and what is true of it: clock [s], turn [deg], shift [m], own clocks (N,) [s]."""
    n = way.pieces.shape[1]
    t = stamps = np.arange(BEGIN, END, 1.0 / RATE)
    if kind == "quantised, irregular stamps":
        t = np.sort(t + random.uniform(-0.3, 0.3, len(t)) / RATE)
        stamps = np.round(t, 3)
    offset, own = random.uniform(-0.3, 0.3), np.zeros(n)
    turn, shift = 0.0, np.zeros(3)
    if kind == "turned by up to 10 degrees":
        turn, shift = random.uniform(-10.0, 10.0), random.normal(0.0, 0.3, 3)
    if kind == "one vehicle late":
        own[random.integers(n)] = random.uniform(0.1, 0.3)
        offset = 0.0
    x = np.stack([way.at(t - by)[:, i, :3] for i, by in enumerate(own)], axis=1)
    x = x @ turning(turn).T + shift + noise(random, x.shape, kind)
    kept = np.ones(x.shape[:2], dtype=np.bool_)
    if kind == "dropouts":
        kept = random.random(kept.shape) > 0.3
    kept[[0, -1]] = True
    curves = [
        curve_through_samples(stamps[k] + offset, x[k, i], None, "cubic", str)
        for i, k in enumerate(kept.T)
    ]
    names = tuple(f"v{i + 1}" for i in range(n))
    return Trajectories(names, tuple(curves), ASSUMED["cubic"], away=True), (
        offset,
        turn,
        shift,
        own,
    )


def turning(degrees: float) -> Floats:
    """The matrix of a turn about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def judge(kind: str, seed: int) -> dict[str, float]:
    """What holds of one flight: shares of 0 to 1, by what is judged."""
    random = np.random.default_rng(seed)
    motion = rf.simulate(mission(seed)).setpoints_at_samples(flown=True)
    way = ways_of(motion, slice(None))
    log, (offset, turn, shift, own) = log_of(way, kind, random)
    fine = np.arange(BEGIN, END, 1e-3)
    alone = [Piecewise(way.time, pieces[:, :3]) for pieces in way.pieces.swapaxes(0, 1)]
    states = np.stack(
        [one.states(fine - by, 2) for one, by in zip(alone, own, strict=True)], axis=2
    )
    states = states @ turning(turn).T
    i, j = np.triu_indices(len(own), 1)
    least = np.linalg.norm(states[0][:, i] - states[0][:, j], axis=2).min()
    fastest = np.linalg.norm(states[1], axis=2).max()
    # Every other flight collides by more than the noise.
    collides = seed % 2 == 1
    limit = (
        least + 4.0 * SIGMA + random.exponential(0.02)
        if collides
        else least - random.exponential(0.02)
    )
    plan = rf.simulate(mission(None, limit))
    clock = "recorded" if kind == "one vehicle late" else "offset"
    size = "data" if kind.endswith("from data") else SIGMA
    flown, verdict = judge_log(log, plan, Doubts(size, None, clock))
    assert verdict.doubt is not None
    facts = verdict.doubt["alignment"]
    held = dict.fromkeys(HELD, float("nan")) | {
        "noise told": float(verdict.doubt["noise_m"] is not None)
    }
    if held["noise told"]:
        for name, true in (("separation", least), ("speed", fastest)):
            low, high = verdict.by_name[name].interval
            held[name] = float(low <= true <= high)
        bands = flown.statistics["bands"]
        t = np.array(bands["time"])
        at = (t > BEGIN + 0.3) & (t < END - 0.3)
        true = np.stack([one.at(t - by) for one, by in zip(alone, own, strict=True)], axis=1)
        true = true @ turning(turn).T + shift
        rows = np.searchsorted(flown.time, t - 1e-9)
        off = np.linalg.norm(flown.position[rows] - true, axis=2)[at]
        held["positions"] = float((off <= np.array(bands["place"])[at]).mean())
    pairs = (
        [(facts["offset_s"], offset)]
        if kind != "one vehicle late"
        else [(x["offset_s"], late) for x, late in zip(verdict.doubt["vehicles"], own, strict=True)]
    )
    held["offset"] = float(np.mean([abs(x - true) <= _WIDE * error for (x, error), true in pairs]))
    value, error = facts["turn_deg"]
    held["turn"] = float(abs(value - turn) <= _WIDE * error)
    check = verdict.by_name["separation"]
    failed = not check.passed and not check.undecided
    held["clean flights failed"] = float("nan") if collides else float(failed)
    held["collisions passed"] = float(check.passed) if collides else float("nan")
    held["decided"] = float(not check.undecided)
    return held


def rows_of(kind: str, flights: list[dict[str, float]]) -> str:
    """The row of a kind of log: shares, in per cent."""
    columns = {key: np.array([each[key] for each in flights]) for key in flights[0]}
    known = {key: x[np.isfinite(x)] for key, x in columns.items()}
    faults = [int(known[key].sum()) for key in ("clean flights failed", "collisions passed")]
    kept = not any(faults) and all(x.mean() >= SHARE for key in HELD if len(x := known[key]))
    shares = [f"{100.0 * x.mean():.1f}" if len(x := known[key]) else "-" for key in SHARES]
    cells = [kind, f"{len(flights)}", *shares, *map(str, faults), "yes" if kept else "**no**"]
    return f"| {' | '.join(cells)} |"


def many(n: int = 60, samples: int = 30_000, rate: float = 100.0) -> str:
    """What it costs to judge a log of many vehicles: a sheet, 3 m apart, that circles."""

    def slots(t: Floats) -> Floats:
        k = np.arange(n)
        sheet = np.stack([3.0 * (k % 8), 3.0 * (k // 8), np.full(n, 5.0)], axis=1)
        centre = [20.0 * np.sin(0.05 * t), 20.0 * np.cos(0.05 * t), 2.0 * np.sin(0.1 * t)]
        return np.stack(centre, axis=1)[:, None] + sheet

    t, random = np.arange(samples) / rate, np.random.default_rng(0)
    coarse = np.arange(0.0, t[-1], 0.05)
    plan = rf.trajectories(coarse, slots(coarse), cubic=True, separation=1.0)
    x = slots(t) + SIGMA * random.standard_normal((samples, n, 3))
    curves = tuple(curve_through_samples(t, x[:, i], None, "cubic", str) for i in range(n))
    names = tuple(f"v{i + 1}" for i in range(n))
    log = Trajectories(names, curves, ASSUMED["cubic"], away=True)
    begin = process_time()
    _, verdict = judge_log(log, plan, Doubts(SIGMA))
    spent, most = process_time() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    what = f"{n} vehicles of {samples:,} samples, {verdict.word}"
    return f"| {what} | {spent:.0f} s of processor time, {most:.2f} GB | 60 s, 2 GB |"


def table(flights: dict[str, list[dict[str, float]]], cost: str) -> str:
    """The tables of the page."""
    head = [
        "log",
        "flights",
        *(f"{key} [%]" for key in SHARES),
        "clean, failed",
        "collisions, passed",
        "kept",
    ]
    lines = [
        f"| {' | '.join(head)} |",
        f"|{' --- |' * len(head)}",
        *(rows_of(*each) for each in flights.items()),
    ]
    return "\n".join([*lines, "", "| what | measured | goal |", "| --- | --- | --- |", cost])


def main() -> int:
    """Print the tables, or write them into a page; 1 if a row is not kept."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--flights", type=int, default=500, help="of each kind of log")
    parser.add_argument("--only", choices=KINDS, action="append", help="only this kind")
    parser.add_argument("--write", type=Path, help="put the tables into a page (docs/logs.md)")
    options, cost = parser.parse_args(), many()  # first: memory is the most that was ever taken
    kinds, seeds = options.only or KINDS, range(options.flights)
    with ProcessPoolExecutor() as pool:
        flights = {kind: list(pool.map(partial(judge, kind), seeds, chunksize=5)) for kind in kinds}
    text = table(flights, cost)
    print(text)
    if options.write:
        splice(options.write, {"evening": text})
    return int("**no**" in text)


if __name__ == "__main__":
    raise SystemExit(main())
