"""Formations whose vehicles know each other by messages, beside the law that knows all states at once.

    python benchmarks/network.py [--seeds 30] [--time 60] [--write docs/network.md]

Each row flies the same seeds under both, in gusts that no law knows: Ornstein-Uhlenbeck accelerations of 1 m/s^2 with
a time scale of 2 s on every vehicle of 1 kg. It gives the mean ratio of the root mean square errors of all distances,
with its 95 % interval, and the root mean square of the sum of all constraint forces, zero where all is known.
Beside it stands the law of everyone: each vehicle solves the whole law on the same late states of all others, brought
forward by their commanded accelerations. It is not flown by the program: it is computed here, on point masses.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from pages import Page, splice
from scipy.stats import t as student

import rigidfleet as rf
from rigidfleet.math.constraint_jacobian import jacobian
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.vehicles import lags_by_vehicle
from rigidfleet.preflight.network import check_network
from rigidfleet.typing import Floats

#: The paper's cube (establish-cube) and triangle: slots [m] and edges from 1.
CUBE = np.array(
    [[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [0, 0, 4], [4, 0, 4], [4, 4, 4], [0, 4, 4.0]]
)
SHAPES = {
    "cube": (
        CUBE,
        [[1, 2], [1, 4], [1, 5], [1, 6], [2, 3], [2, 4], [2, 6], [2, 7], [3, 4], [3, 7], [3, 8], [4, 5], [4, 8],
         [5, 6], [5, 8], [6, 7], [6, 8], [7, 8]],
    ),
    "triangle": (np.array([[0, 0, 0], [4, 0, 0], [2, 2 * 3**0.5, 0]]), [[1, 2], [1, 3], [2, 3]]),
}  # fmt: skip
#: Shape, rate [Hz], network and the goal of the ratio.
ROWS: tuple[tuple[str, float, dict[str, float], float], ...] = (
    *(
        (shape, 100.0, network, goal)
        for shape in SHAPES
        for network, goal in (
            ({}, 1.04), ({"loss": 0.6}, 1.06), ({"delay": 0.02}, 1.06), ({"loss": 0.3, "delay": 0.05}, 1.10),
        )
    ),
    ("cube", 50.0, {}, 1.10),
    ("cube", 50.0, {"delay": 0.04}, 1.15),
    ("cube", 50.0, {"delay": 0.1}, 1.25),
)  # fmt: skip
#: Greatest push [N] of all constraint forces together, root mean square.
PUSH = 0.5
#: Drag [N s/m] by which gusts push, small enough to damp nothing.
_DRAG = 1e-3
#: Time after which errors count [s].
_SETTLED = 10.0
#: Broadcasts that the law of everyone keeps.
_DEPTH = 128


def mission(
    shape: str, rate: float, network: dict[str, float] | None, seed: int, time: float, noise: float
) -> rf.Mission:
    """Vehicles that hold their slots; ``noise`` [m], twice as much in [m/s], of what they measure."""
    slots, edges = SHAPES[shape]
    start = slots + np.random.default_rng(1000 + seed).normal(0, 0.3, slots.shape) + [0, 0, 20]
    gusts = {"model": "first-order", "intensity": 1.0 / _DRAG, "time_scale": 2.0, "seed": seed}
    data: dict[str, Any] = {
        "schema_version": 1,
        "name": shape,
        "agents": {"position": start.tolist(), "vehicle": "point"},
        "vehicles": {"point": {"model": "point", "mass": 1.0, "thrust_limit": 1e3, "drag": _DRAG}},
        "autopilot": {"rate": rate, "formation_rate": rate},
        "tracking": {"Q": [1.0, 0.0], "R": 1.0},
        "formations": {shape: {"slots": slots.tolist(), "edges": edges}},
        "phases": [{"kind": "establish", "formation": shape, "duration": time}],
        "disturbances": {"gusts": gusts},
        "output_step": 0.1,
    }
    if noise:
        data["disturbances"]["noise"] = {
            "position": noise,
            "velocity": 2 * noise,
            "rate": rate,
            "seed": seed,
        }
    if network is not None:
        data["network"] = network | {"rate": rate, "seed": seed}
    return rf.Mission.from_dict(data)


def errors(slots: Floats, r: Floats) -> float:
    """Root mean square error [m] of all distances of positions r (K, N, 3)."""
    i, j = np.triu_indices(len(slots), 1)
    off = np.linalg.norm(r[:, i] - r[:, j], axis=-1) - np.linalg.norm(slots[i] - slots[j], axis=1)
    return float(np.sqrt((off**2).mean()))


def flown(m: rf.Mission) -> tuple[float, float]:
    """Error of the shape [m] and push [N] of a flight, root mean square."""
    return measured(m, rf.simulate(m))


def measured(m: rf.Mission, result: rf.Result) -> tuple[float, float]:
    """Error of the shape [m] and push [N], root mean square."""
    settled = result.time > _SETTLED
    slots = SHAPES[m.name][0]
    push = result.constraint_force[settled].sum(axis=1)
    return errors(slots, result.position[settled]), float(np.sqrt((push**2).sum(axis=1).mean()))


def everyone(
    shape: str, rate: float, network: dict[str, float], seeds: int, time: float, noise: float
) -> tuple[Floats, float]:
    """Ratios (seeds,) of the law of everyone to the law that knows all, and its push [N], on point masses."""
    arguments = shape, rate, seeds, time, noise
    central, _ = _point_masses(*arguments, None)
    theirs, push = _point_masses(*arguments, network)
    return theirs / central, push


def _point_masses(
    shape: str, rate: float, seeds: int, time: float, noise: float, network: dict[str, float] | None
) -> tuple[Floats, float]:
    """Errors (seeds,) of shapes whose vehicles know the others by a network, or all at once; and the push [N]."""
    slots, pairs = SHAPES[shape]
    edges, n, h = np.array(pairs) - 1, len(slots), 1.0 / rate
    lengths = np.linalg.norm(slots[edges[:, 0]] - slots[edges[:, 1]], axis=1)
    rng = np.random.default_rng(7)
    r, v = slots + rng.normal(0, 0.3, (seeds, n, 3)), np.zeros((seeds, n, 3))
    gust, keep = rng.normal(size=r.shape), np.exp(-h / 2.0)
    chances = np.random.default_rng(8)
    views = 1 if network is None else n
    late = 0 if network is None else max(1, round(network.get("delay", 0.0) * rate))
    loss = 0.0 if network is None else network.get("loss", 0.0)
    integral = np.zeros((seeds, views, len(edges)))
    past = np.zeros(
        (_DEPTH, 3, seeds, n, 3)
    )  # what each broadcast: position, velocity, acceleration
    age = np.full((seeds, n, n), late)
    a, own, total, pushed, count = np.zeros_like(r), np.arange(n), np.zeros(seeds), 0.0, 0
    for tick in range(round(time * rate)):
        gust = keep * gust + np.sqrt(1 - keep**2) * rng.normal(size=r.shape)
        seen_r = r + rng.normal(0, noise, r.shape)
        seen_v = v + rng.normal(0, 2 * noise, r.shape)
        past[tick % _DEPTH] = seen_r, seen_v, a
        R, V = seen_r[:, None], seen_v[:, None]
        if network is not None:
            heard = chances.uniform(size=age.shape) >= loss
            age = np.minimum(np.where(heard, late, age + 1), min(tick, _DEPTH - 1))
            age[:, own, own] = 0
            then = (tick - age) % _DEPTH, slice(None), np.arange(seeds)[:, None, None], own
            r0, v0, a0 = np.moveaxis(past[then], 3, 0)
            old = h * age[..., None]
            R, V = r0 + v0 * old + 0.5 * a0 * old**2, v0 + a0 * old
        u = -(R - slots) - np.sqrt(2.0) * V
        J = jacobian(R.reshape(-1, n, 3), edges)
        A = J @ J.transpose(0, 2, 1)
        d, w = (x[..., edges[:, 0], :] - x[..., edges[:, 1], :] for x in (R, V))
        L = np.linalg.norm(d, axis=-1)
        rate_of = (d * w).sum(axis=-1) / L
        off = L - lengths
        b = -((w**2).sum(axis=-1) - rate_of**2) / L - 6.0 * rate_of - 12.0 * off - 8.0 * integral
        b = b.reshape(-1, len(edges)) - (J @ u.reshape(-1, 3 * n, 1))[..., 0]
        inverse, y = np.linalg.inv(A + 0.03 * np.eye(len(edges))), np.zeros_like(b)
        for _ in range(3):
            y = (inverse @ (b + 0.03 * y)[..., None])[..., 0]
        force = (J.transpose(0, 2, 1) @ y[..., None])[..., 0].reshape(seeds, views, n, 3)
        force, u = (x[:, own, own] if views > 1 else x[:, 0] for x in (force, u))
        integral += h * off
        a = u + force
        moved = a + gust
        r, v = r + h * v + 0.5 * h * h * moved, v + h * moved
        if tick * h > _SETTLED and tick % 10 == 0:
            total += np.array([errors(slots, x[None]) ** 2 for x in r])
            pushed += float((force.sum(axis=1) ** 2).sum(axis=1).mean())
            count += 1
    return np.sqrt(total / count), float(np.sqrt(pushed / count))


def lattice_mission(network: dict[str, float] | None, seed: int, side: int) -> rf.Mission:
    """20 s of a lattice of points whose cells have edges and diagonals."""
    slots = 3.0 * np.indices((side, side, side)).reshape(3, -1).T
    apart = np.abs(slots[:, None] - slots) / 3.0
    near = (apart.max(axis=-1) == 1) & (apart.sum(axis=-1) <= 2)
    edges = np.argwhere(np.triu(near)) + 1
    SHAPES["lattice"] = slots, edges.tolist()
    return mission("lattice", 50.0, network, seed, 20.0, 0.0)


def lattice(network: dict[str, float] | None, seed: int, side: int) -> tuple[float, float]:
    """Error of the shape [m] and processor time [s] of a lattice."""
    m = lattice_mission(network, seed, side)
    begun = process_time()
    result = rf.simulate(m)
    cost = process_time() - begun
    return errors(SHAPES["lattice"][0], result.position[result.time > 5.0][::10]), cost


def passage(name: str) -> rf.Verdict:
    """The verdict of a passage of quadrotors in wind and gusts, of which each knows its neighbours by messages."""
    data = rf.load_mission(name).to_dict()
    for key in ("reference", "control"):  # slots hold against the wind from the start
        data["phases"][0].pop(key, None)
    data["tracking"]["Q"] = [600.0, 60.0]
    data["limits"]["tracking_error"] = 0.06
    data["disturbances"] = {
        "wind": [3.0, 1.5, 0.0],
        "gusts": {"model": "dryden", "altitude": 20.0, "correlation_length": 20.0, "seed": 1},
    }
    data["network"] = {"rate": 50.0, "delay": 0.02, "loss": 0.3, "burst": 3.0}
    return rf.assess(rf.simulate(rf.Mission.from_dict(data)))


def interval(x: Floats) -> str:
    """Mean of samples with its 95 % interval."""
    half = student.ppf(0.975, len(x) - 1) * x.std(ddof=1) / np.sqrt(len(x))
    return f"{x.mean():.3f} +- {half:.3f}"


def laws(page: Page, seeds: int, time: float) -> None:
    """The tables of shapes, without and with noise."""
    for noise in (0.0, 0.01):
        known = f"{100 * noise:g} cm and {200 * noise:g} cm/s of noise" if noise else "no noise"
        head = (
            "shape",
            "Hz",
            "network",
            "ratio",
            "goal",
            "push [N]",
            "law of everyone",
            "push [N]",
        )
        page.title(f"{seeds} seeds of {time:g} s, {known}:", *head)
        central: dict[tuple[str, float], Floats] = {}
        for shape, rate, network, goal in ROWS:
            if (shape, rate) not in central:
                alone = [flown(mission(shape, rate, None, k, time, noise)) for k in range(seeds)]
                central[shape, rate] = np.array(alone)[:, 0]
            ours = np.array(
                [flown(mission(shape, rate, network, k, time, noise)) for k in range(seeds)]
            )
            ratios, push = ours[:, 0] / central[shape, rate], np.sqrt((ours[:, 1] ** 2).mean())
            theirs, their_push = everyone(shape, rate, network, min(seeds, 10), time, noise)
            words = ", ".join(f"{name} {value:g}" for name, value in network.items()) or "as sent"
            page.row(
                shape, f"{rate:g}", words, interval(ratios), "" if noise else f"{goal:g}", f"{push:.2f}",
                interval(theirs), f"{their_push:.2f}",
                kept=bool(noise) or (ratios.mean() <= goal and push <= PUSH),
            )  # fmt: skip


def events(page: Page, seeds: int, time: float) -> None:
    """Vehicles that send only when their neighbours guess them wrongly."""
    words = f"Broadcasts on events, {seeds} seeds of {time:g} s, no noise; the law of everyone hears each time:"
    head = ("ratio", "goal", "push [N]", "broadcasts", "goal", "law of everyone", "push [N]")
    page.title(words, "shape", "Hz", "network", *head)
    for shape, rate in (("triangle", 100.0), ("triangle", 50.0), ("cube", 100.0), ("cube", 50.0)):
        settings: list[dict[str, float]] = [{"event": 0.005}, {"event": 0.0005, "loss": 0.3}]
        central = [flown(mission(shape, rate, None, k, time, 0.0))[0] for k in range(seeds)]
        for network in settings:
            ours, sent = [], []
            for k in range(seeds):
                m = mission(shape, rate, network, k, time, 0.0)
                result = rf.simulate(m)
                ours.append(measured(m, result))
                assert result.messages is not None
                sent.append(float(result.messages[..., 0].mean()) / (rate * time))
            ratios, push = (
                np.array(ours)[:, 0] / central,
                np.sqrt((np.array(ours)[:, 1] ** 2).mean()),
            )
            theirs, their_push = everyone(shape, rate, network, min(seeds, 10), time, 0.0)
            page.row(
                shape, f"{rate:g}", ", ".join(f"{name} {value:g}" for name, value in network.items()),
                interval(ratios), "1.1", f"{push:.2f}", f"{np.mean(sent):.2f}", "0.5",
                interval(theirs), f"{their_push:.2f}",
                kept=ratios.mean() <= 1.1 and push <= PUSH and bool(np.mean(sent) <= 0.5),
            )  # fmt: skip


def others(page: Page, seeds: int) -> None:
    """What else is measured."""
    page.title("Quadrotors, and lattices of points:", "what", "measured", "goal")
    for name in ("passage-quadrotors", "cube-passage-quadrotors"):
        verdict = passage(name)
        words = "passed" if verdict.passed else str(verdict)
        what = f"{name} in gusts, 50 Hz, 20 ms, 30 % lost in bursts of 3"
        page.row(what, words, "passes", kept=verdict.passed)
    for side in (2, 3, 5, 7):
        runs = [
            (lattice(None, k, side), lattice({"delay": 0.02}, k, side))
            for k in range(min(seeds, 3))
        ]
        central, ours = np.moveaxis(np.array(runs), 1, 0)
        ratio, cost = (
            float((ours[:, 0] / central[:, 0]).mean()),
            np.median(ours[:, 1] / central[:, 1]),
        )
        count = len(SHAPES["lattice"][1])
        each = 1e3 * float(np.median(ours[:, 1])) / count
        page.row(
            f"lattice of {side**3} vehicles, {count:,} edges, 50 Hz, 20 ms",
            f"ratio {ratio:.3f}; a flight costs {cost:.2f} times the central law's, {each:.1f} ms an edge",
            "1.1; 2 times",
            kept=ratio <= 1.1 and bool(cost <= 2.0),
        )


def checks(page: Page) -> None:
    """What `check` takes of processor time, all of it and what it says of the network."""
    page.title("`check`, processor time:", "what", "network", "in all", "goal")
    cube, points = rf.load_mission("cube-by-neighbours"), lattice_mission({"delay": 0.02}, 0, 7)
    for m, goal in ((cube, 2.0), (points, 30.0)):
        begun = process_time()
        rf.check(m)
        whole = process_time() - begun
        way, lags, begun = preview_phases(m)[0], lags_by_vehicle(m), process_time()
        check_network(m, way, lags)
        part = process_time() - begun
        what = f"{m.name}: {m.n_agents} vehicles, {len(m.edges):,} edges"
        page.row(what, f"{part:.1f} s", f"{whole:.1f} s", f"{goal:g} s", kept=part <= goal)


def main() -> int:
    """Print the tables; 1 if a goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--time", type=float, default=60.0, help="of each flight [s]")
    parser.add_argument("--write", type=Path, help="put the tables into a page (docs/network.md)")
    options, page = parser.parse_args(), Page()
    laws(page, options.seeds, options.time)
    events(page, options.seeds, options.time)
    others(page, options.seeds)
    checks(page)
    if options.write:
        splice(options.write, {"network": "\n".join(page.lines)})
    return int(page.missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
