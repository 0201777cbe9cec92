"""Setpoints as tables of text: the files that `Result.to_csv` writes, for all vehicles or for one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rigidfleet.interchange.curves import Curve, Motion, through
from rigidfleet.setpoints import HEADER, Setpoints, csv


def write_table(motion: Motion, rate: float | None) -> Iterator[bytes]:
    """One table with a row for each time and vehicle."""
    yield csv(motion.at_rate(rate)).encode()


def write_tables(motion: Motion, rate: float | None) -> Iterator[bytes]:
    """One table a vehicle, with the same columns."""
    given = motion.at_rate(rate)
    for i in range(motion.n_agents):
        only = slice(i, i + 1)
        part = Setpoints(
            given.time, given.state[:, :, only], given.yaw[:, only], given.yaw_rate[:, only]
        )
        yield csv(part, first=i + 1).encode()


def read_table(data: bytes) -> list[Curve]:
    """The ways in a table: polynomials of degree 7 (yaw: 3) that meet all that it says."""
    head, *rows = data.decode().splitlines()
    if head != HEADER:
        raise ValueError(f"expected the columns {HEADER}, found {head[:100]}")
    numbers = np.loadtxt(rows, delimiter=",", ndmin=2)
    curves = []
    for agent in np.unique(numbers[:, 1]):
        own = numbers[numbers[:, 1] == agent]
        states = own[:, 2:14].reshape(-1, 4, 3).swapaxes(0, 1)
        curves.append(through(own[:, 0], states, own[:, 14:16].T))
    return curves
