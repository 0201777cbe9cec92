"""Judge a log of many vehicles with doubt: `python benchmarks/logs.py [vehicles] [samples]`."""

import resource
import sys
import time

import numpy as np

import rigidfleet as rf
from rigidfleet.foreign.curves import Trajectories
from rigidfleet.foreign.samples import ASSUMED, curve_through_samples
from rigidfleet.simulation.as_logged import Doubts, judge_log

RATE, SIGMA = 100.0, 0.003


def slots(t: np.ndarray, n: int) -> np.ndarray:
    """A sheet of vehicles (K, n, 3), 3 m apart, that circles."""
    k = np.arange(n)
    sheet = np.stack([3.0 * (k % 8), 3.0 * (k // 8), np.full(n, 5.0)], axis=1)
    centre = np.stack(
        [20.0 * np.sin(0.05 * t), 20.0 * np.cos(0.05 * t), 2.0 * np.sin(0.1 * t)], axis=1
    )
    return centre[:, None] + sheet


def main() -> None:
    """Print time, memory and verdict."""
    n, samples = (int(x) for x in (*sys.argv[1:], 60, 30_000)[:2])
    t = np.arange(samples) / RATE
    coarse = np.arange(0.0, t[-1], 0.05)
    plan = rf.trajectories(coarse, slots(coarse, n), cubic=True, separation=1.0)
    random, curves = np.random.default_rng(0), []
    x = slots(t, n)
    for i in range(n):
        y = x[:, i] + SIGMA * random.standard_normal((samples, 3))
        curves.append(curve_through_samples(t, y, None, "cubic", str))
    names = tuple(f"v{i + 1}" for i in range(n))
    log = Trajectories(names, tuple(curves), ASSUMED["cubic"], away=True)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    begin = time.process_time()
    _, verdict = judge_log(log, plan, Doubts(SIGMA))
    spent = time.process_time() - begin
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{n} vehicles of {samples:,} samples: {spent:.1f} s of processor time, {most:,.0f} MiB at most"
    )
    print(f"({before:,.0f} MiB before), {verdict.word}")


if __name__ == "__main__":
    main()
