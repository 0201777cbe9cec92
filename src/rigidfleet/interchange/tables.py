"""Setpoints as tables of text: the files that `Result.to_csv` writes, for all vehicles or for one."""

from __future__ import annotations

from collections.abc import Iterator

from rigidfleet.interchange.curves import ExportedMotion
from rigidfleet.setpoints import Setpoints, csv_text


def write_table(motion: ExportedMotion, rate: float | None) -> Iterator[bytes]:
    """One table with a row for each time and vehicle."""
    yield csv_text(motion.at_rate(rate)).encode()


def write_tables(motion: ExportedMotion, rate: float | None) -> Iterator[bytes]:
    """One table a vehicle, with the same columns."""
    setpoints = motion.at_rate(rate)
    for i in range(motion.n_agents):
        only = slice(i, i + 1)
        part = Setpoints(
            setpoints.time,
            setpoints.state[:, :, only],
            setpoints.yaw[:, only],
            setpoints.yaw_rate[:, only],
        )
        yield csv_text(part, first=i + 1).encode()
