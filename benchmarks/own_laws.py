"""What laws of vehicles' own cost, in processor time: `python benchmarks/own_laws.py`.

A cube of eight points over a lossy network, 50 ticks a second: by a law in Python, by the built-in law, and as an
environment to learn in. Medians, with the best in brackets, since other programs share the machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from network import mission

import rigidfleet as rf
from rigidfleet.simulation.environment import FormationEnv
from rigidfleet.simulation.own_laws import View
from rigidfleet.typing import Floats

NETWORK = {"loss": 0.3, "delay": 0.02}


def gradient(me: View) -> tuple[Floats, tuple[Floats, Floats]]:
    """The law of the example."""
    off, off_rate = me.position - me.reference_position, me.velocity - me.reference_velocity
    a = me.reference_acceleration - off - 1.4 * off_rate + [0.0, 0.0, me.gravity]
    for j, ((r, v), age) in me.inbox.items():
        apart = me.position - (r + age * v)
        length = np.linalg.norm(apart)
        rate = apart @ (me.velocity - v) / length
        pull = 12.0 * (length - me.distance[j]) + 3.0 * (rate - me.distance_rate[j])
        a = a - pull * apart / length
    return me.mass * a, (me.position, me.velocity)


def seconds(job: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median and best processor time of a job [s]."""
    taken = []
    for _ in range(repeats):
        begun = time.process_time()
        job()
        taken.append(time.process_time() - begun)
    return float(np.median(taken)), min(taken)


def main() -> None:
    """Print what each costs."""
    m = mission("cube", 50.0, NETWORK, 0, 20.0, 0.01)
    steps = 8 * 50 * 20
    rf.simulate(m, agent=gradient)  # once, to load
    for name, law in (("a law in Python", gradient), ("the built-in law", None)):
        usual, best = seconds(lambda law=law: rf.simulate(m, agent=law), 7)
        print(
            f"{name:>30}: {1e6 * usual / steps:6.1f} us a vehicle and tick ({1e6 * best / steps:.1f})"
        )
    env = FormationEnv(m, numbers=2, scatter=0.1)
    env.reset(seed=1)
    actions = {name: env.action_space(name).sample() for name in env.agents}

    def fifty() -> None:
        for _ in range(50):
            env.step(actions)

    usual, best = seconds(fifty, 18)
    print(
        f"{'steps of the environment':>30}: {400 / usual:6,.0f} a second, one a vehicle ({400 / best:,.0f})"
    )
    usual, best = seconds(env.reset, 31)
    print(f"{'a reset':>30}: {1e3 * usual:6.1f} ms ({1e3 * best:.1f})")


if __name__ == "__main__":
    main()
