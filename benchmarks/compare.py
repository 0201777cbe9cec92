"""Side by side with what a user would pick instead: the same establishment flown by other programs.

``make peers`` runs it. All fly the same masses, starts, edges and 20 s of the undamped law, as near as their
models come to it. Each flies at its coarsest setting that ends within 1 mm of its own tightest flight (and where
it integrates our law, of ours); what is built before a flight is not timed. Rounds are interleaved, and the
median of the rounds' ratios counts.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from dataclasses import asdict, dataclass, field
from datetime import date
from importlib import import_module
from pathlib import Path
from statistics import median

import matplotlib.pyplot as plt
import numpy as np
from peers.case import DURATION, AbsentError, Array, Case, Peer, cases
from rich.console import Console
from rich.table import Table

OURS = "rigidfleet_kernel"
PEERS = ("rigidfleet_flight", "scipy_rk45", "octave_ode45", "mujoco_tendons", "exudyn_distances")
#: Where a flight of the comparison ends, it is to be so near to the tightest one [m].
ENOUGH = 1e-3
#: Tighter settings than the one compared are flown up to so many agents, for the figure.
DRAWN = 8


@dataclass
class Point:
    """One flight at one setting."""

    effort: float
    seconds: float
    error: float  # of the positions at the end, against the tightest flight of the same law [m]


@dataclass
class Row:
    """A peer's flights of a case."""

    agents: int
    peer: str
    version: str
    model: str
    unit: str
    effort: float
    error: float  # as `Point.error`
    from_ours: float  # positions at the end against our tightest flight [m]
    distances: float  # the largest error of a distance at the end [m]
    points: list[Point]
    seconds: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)  # of the seconds against ours, round by round

    @property
    def rate(self) -> float:
        """Simulated seconds in a second."""
        return DURATION / median(self.seconds)


def surveyed(peer: Peer, case: Case, ours: Array) -> Row:
    """Fly at one setting after the other, and choose the coarsest that is near enough."""
    tightest = ours if peer.same_law else peer.flight(case, peer.efforts[-1])()[1]
    points, ends = [], []
    for effort in peer.efforts:
        fly = peer.flight(case, effort)
        fly()
        seconds, r = min((fly() for _ in range(2)), key=lambda flown: flown[0])
        points.append(Point(effort, seconds, float(np.abs(r - tightest).max())))
        ends.append(r)
        if case.n > DRAWN and points[-1].error <= ENOUGH:
            break
    near = [k for k, point in enumerate(points) if point.error <= ENOUGH] or [len(points) - 1]
    k = near[0]
    off = float(np.abs(ends[k] - ours).max())
    chosen = points[k]
    return Row(
        case.n,
        peer.name,
        peer.version,
        peer.model,
        peer.unit,
        chosen.effort,
        chosen.error,
        off,
        case.error(ends[k]),
        points,
    )


def compared(case: Case, peers: list[Peer], rounds: int, console: Console) -> list[Row]:
    """All peers on one case; the first is what the others are measured against."""
    ours = peers[0].flight(case, peers[0].efforts[-1])()[1]
    rows = []
    for peer in peers:
        console.print(f"{case.n} agents: {peer.name}", style="dim")
        rows.append(surveyed(peer, case, ours))
    flights = [p.flight(case, row.effort) for p, row in zip(peers, rows, strict=True)]
    for _ in range(rounds):
        for row, fly in zip(rows, flights, strict=True):
            row.seconds.append(fly()[0])
            row.ratios.append(row.seconds[-1] / rows[0].seconds[-1])
    return rows


def show(console: Console, rows: list[Row]) -> None:
    """The table, and in what the models differ."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    setting = ("agents", "", "setting", "s per s", "time / ours", "spread")
    for column in (*setting, "error [m]", "from ours [m]", "distances [m]"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in rows:
        table.add_row(
            str(row.agents),
            row.peer,
            f"{row.unit.partition(' ')[0]} {row.effort:g}",
            f"{row.rate:,.4g}",
            f"{median(row.ratios):.3g}",
            f"{min(row.ratios):.3g}..{max(row.ratios):.3g}",
            f"{row.error:.0e}",
            f"{row.from_ours:.0e}",
            f"{row.distances:.0e}",
        )
    console.print(table)
    for name, text in {f"{row.peer} {row.version}": row.model for row in rows}.items():
        console.print(f"{name}: {text}", highlight=False)


def draw(rows: list[Row], path: Path) -> None:
    """Work and precision: the time that a flight takes over the error at its end."""
    drawn = [n for n in dict.fromkeys(row.agents for row in rows) if n <= DRAWN]
    figure, axes = plt.subplots(1, len(drawn), figsize=(9, 3.6), sharey=True, layout="constrained")
    for axis, n in zip(np.atleast_1d(axes), drawn, strict=True):
        for row, marker in zip((r for r in rows if r.agents == n), "osv^DPX", strict=False):
            # What ends as near as rounding and the reference allow is no more precise than that.
            points = [p for p in row.points if p.error > 1e-10]
            axis.loglog(
                [p.error for p in points],
                [p.seconds for p in points],
                marker=marker,
                markersize=4,
                linewidth=1.2,
                label=row.peer,
            )
        axis.invert_xaxis()
        axis.grid(alpha=0.3)
        axis.set_title(f"{n} agents", fontsize=10)
        axis.set_xlabel("error of the final positions [m]")
    np.atleast_1d(axes)[0].set_ylabel(f"time for {DURATION:g} s of flight [s]")
    handles, labels = np.atleast_1d(axes)[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> int:
    """Compare, print, and say whether those that fly the same law agree with us."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="rounds, of which the median counts")
    parser.add_argument("--agents", type=int, nargs="+", default=[3, 8, 100], help="cases to fly")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--figure", type=Path, help="draw work and precision into this file")
    arguments = parser.parse_args()
    console = Console(width=150)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    console.print(f"{date.today()}; {machine}", highlight=False)
    peers, absent = [], []
    for name in (OURS, *PEERS):
        try:
            peers.append(import_module(f"peers.{name}").peer())
        except AbsentError as error:
            absent.append(str(error))
            console.print(f"Absent: {error}", highlight=False)
    known = cases()
    rows = []
    for n in arguments.agents:
        rows += compared(known[n], peers, arguments.rounds, console)
    show(console, rows)
    if arguments.figure:
        draw(rows, arguments.figure)
    if arguments.json:
        head = {"date": str(date.today()), "machine": machine, "absent": absent}
        data = [asdict(r) | {"rate": r.rate} for r in rows]
        arguments.json.write_text(json.dumps(head | {"rows": data}, indent=1))
    same = {peer.name for peer in peers if peer.same_law}
    far = [row for row in rows if row.peer in same and row.from_ours > ENOUGH]
    for row in far:
        console.print(
            f"{row.peer}, {row.agents} agents: {row.from_ours:.0e} m from ours, not within {ENOUGH:g} m"
        )
    return 1 if far else 0


if __name__ == "__main__":
    sys.exit(main())
