"""Formations whose vehicles know each other by messages, beside the law that knows all states at once.

    python benchmarks/network.py [--seeds 30] [--time 60]

Each row flies the same seeds under both, in gusts that no law knows: Ornstein-Uhlenbeck accelerations of 1 m/s^2 with
a time scale of 2 s on every vehicle of 1 kg. It gives the mean ratio of the root mean square errors of all distances,
with its 95 % interval, and the root mean square of the sum of all constraint forces, zero where all is known.
Beside it stands the law of everyone: each vehicle solves the whole law on the same late states of all others, brought
forward by their commanded accelerations. It is not flown by the program: it is computed here, on point masses.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import t as student

import rigidfleet as rf
from rigidfleet.math.constraint_jacobian import jacobian
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
    result = rf.simulate(m)
    settled = result.time > _SETTLED
    slots = SHAPES[m.name][0]
    push = result.constraint_force[settled].sum(axis=1)
    return errors(slots, result.position[settled]), float(np.sqrt((push**2).sum(axis=1).mean()))


def everyone(shape: str, rate: float, network: dict[str, float], seeds: int, time: float) -> Floats:
    """Ratios (seeds,) of the law of everyone to the law that knows all, on point masses in gusts of their own.

    Losses are left out: what does not arrive is as late as the last message.
    """
    late = max(1, round(network.get("delay", 0.0) * rate))
    central, theirs = (_point_masses(shape, rate, k, seeds, time) for k in (0, late))
    return theirs / central


def _point_masses(shape: str, rate: float, late: int, seeds: int, time: float) -> Floats:
    """Errors (seeds,) of shapes whose vehicles know the others ``late`` ticks late; 0: one law knows all."""
    slots, pairs = SHAPES[shape]
    edges, n, h = np.array(pairs) - 1, len(slots), 1.0 / rate
    lengths = np.linalg.norm(slots[edges[:, 0]] - slots[edges[:, 1]], axis=1)
    k1, k2 = 1.0, 2.0**0.5
    rng = np.random.default_rng(7)
    r, v = slots + rng.normal(0, 0.3, (seeds, n, 3)), np.zeros((seeds, n, 3))
    gust, keep = rng.normal(size=r.shape), np.exp(-h / 2.0)
    views = n if late else 1
    integral = np.zeros((seeds, views, len(edges)))
    past: list[tuple[Floats, Floats, Floats]] = []
    total, count = np.zeros(seeds), 0
    own = np.arange(n)
    for tick in range(round(time * rate)):
        gust = keep * gust + np.sqrt(1 - keep**2) * rng.normal(size=r.shape)
        R, V = r[:, None], v[:, None]
        if late and len(past) >= late:
            r0, v0, a0 = past[-late]
            age = late * h
            R = np.repeat((r0 + v0 * age + 0.5 * a0 * age**2)[:, None], n, axis=1)
            V = np.repeat((v0 + a0 * age)[:, None], n, axis=1)
            R[:, own, own], V[:, own, own] = r, v
        elif late:
            R, V = np.repeat(R, n, axis=1), np.repeat(V, n, axis=1)
        u = -k1 * (R - slots) - k2 * V
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
        integral += h * off
        a = (u + force)[:, own, own] if late else (u + force)[:, 0]
        past = [*past[-late:], (r, v, a)] if late else past
        total_force = a + gust
        r, v = r + h * v + 0.5 * h * h * total_force, v + h * total_force
        if tick * h > _SETTLED and tick % 10 == 0:
            total += np.array([errors(slots, x[None]) ** 2 for x in r])
            count += 1
    return np.sqrt(total / count)


def interval(x: Floats) -> str:
    """Mean of samples with its 95 % interval."""
    half = student.ppf(0.975, len(x) - 1) * x.std(ddof=1) / np.sqrt(len(x))
    return f"{x.mean():.3f} +- {half:.3f}"


def main() -> int:
    """Print the table; 1 if a goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--time", type=float, default=60.0, help="of each flight [s]")
    arguments = parser.parse_args()
    seeds, time = arguments.seeds, arguments.time
    table = Table(
        "shape",
        "rate [Hz]",
        "network",
        "ratio",
        "goal",
        "push [N]",
        "with noise",
        "push [N]",
        "everyone",
    )
    missed, central = 0, {}
    for shape, rate, network, goal in ROWS:
        cells = []
        for noise in (0.0, 0.01):
            key = shape, rate, noise
            if key not in central:
                central[key] = np.array(
                    [flown(mission(shape, rate, None, k, time, noise))[0] for k in range(seeds)]
                )
            ours = np.array(
                [flown(mission(shape, rate, network, k, time, noise)) for k in range(seeds)]
            )
            ratios, push = ours[:, 0] / central[key], float(np.sqrt((ours[:, 1] ** 2).mean()))
            cells.append((ratios, push))
        (plain, push), (noisy, noisy_push) = cells
        missed += plain.mean() > goal or push > PUSH
        words = ", ".join(f"{name} {value:g}" for name, value in network.items()) or "as sent"
        table.add_row(
            shape, f"{rate:g}", words, interval(plain), f"{goal:g}", f"{push:.2f}", interval(noisy),
            f"{noisy_push:.2f}", interval(everyone(shape, rate, network, seeds, time)),
        )  # fmt: skip
    Console().print(table)
    return int(missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
