"""What `check --abort` says: from which seconds of the flight there is a way home that is proved, and which."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidfleet._common.facts import FactTable, Line, Row, Sheet, Shown
from rigidfleet._common.files import write_file
from rigidfleet._common.text import agent_names
from rigidfleet.mission import Mission
from rigidfleet.planning.abort import Abort, Aborts, Nearest, Step
from rigidfleet.planning.legs import at_start
from rigidfleet.planning.losses import legs_from


class AbortRow(NamedTuple):
    """One abort, in numbers.

    Attributes
    ----------
    ordered, begins, stops, ends : when it is ordered, when all act on it, stop and rest at home [s]
    way, reason : how they go home, or why there is no way that is proved
    least : least separation that is promised: proved, less what vehicles are off their ways
    unheard : the nearest that a vehicle which does not hear and flies on, the first of the two, comes to another one
    endangered : how many vehicles would come within the limit of separation if they did not hear
    number : of the ways from rest, which equal stopped places share
    """

    ordered: float
    begins: float
    stops: float
    ends: float
    way: str
    reason: str
    least: Nearest
    unheard: Nearest
    endangered: int
    number: int

    @property
    def alike(self) -> str:
        """What rows have in common that are told as one."""
        return self.way or re.sub(r"[\d.]+", "#", self.reason)


@dataclass
class AbortsCheck(Shown):
    """Result of `check_aborts`.

    Attributes
    ----------
    mission : with its times known
    rows : of each order, in numbers
    homes : steps of the ways from rest, by their number
    """

    mission: Mission
    rows: list[AbortRow]
    homes: dict[int, tuple[Step, ...]]

    @property
    def least(self) -> float:
        """The least separation that all ways home promise [m]."""
        return min((x.least.separation for x in self.rows if x.way), default=np.inf)

    def facts(self) -> Sheet:
        """Runs of seconds with the same answer, each with its worst numbers."""
        options = self.mission.aborting
        heads = ("ordered [s]", "way home", "takes [s]", "least [m]", "one that does not hear")
        rows = [Row(*row) for row in self._runs()]
        none = sum(not x.way for x in self.rows)
        all_ = len(self.rows)
        text = f"{self.mission.name}: a way home from {all_ - none} of {all_} times, {options.step:g} s apart"
        if none < len(self.rows) and np.isfinite(self.least):
            text += f"; no two vehicles come nearer than {self.least:.2f} m"
        to = "any place" if options.to == "any" else "their own places"
        title = f"aborts, {options.reaction:g} s after each order, to {to}"
        parts = [
            FactTable(heads, rows, ("way home", "one that does not hear")),
            Line(text, "note" if none else "ok"),
        ]
        return Sheet(self.mission.name, title, parts)

    def _runs(self) -> Iterator[tuple[list[Any], Any]]:
        for _, group in itertools.groupby(self.rows, key=lambda x: x.alike):
            run = list(group)
            first, last = run[0].ordered, run[-1].ordered
            when = f"{first:g}" if first == last else f"{first:g} to {last:g}"
            if not run[0].way:
                yield [when, f"none: {run[0].reason}", None, None, ""], "note"
                continue
            worst = min(x.least for x in run)
            takes = max(x.ends - x.ordered for x in run)
            least = worst.separation
            yield (
                [when, run[0].way, takes, least if np.isfinite(least) else None, _unheard(run)],
                "",
            )

    def data(self) -> dict[str, Any]:
        """Plain data for JSON, agents counted from 1."""
        options = self.mission.aborting
        return {
            "to": options.to, "reaction_s": options.reaction, "step_s": options.step,
            "aborts": [
                {
                    "ordered_s": x.ordered, "begins_s": x.begins, "stops_s": x.stops, "ends_s": x.ends,
                    "way": x.way, "reason": x.reason, "ways": x.number,
                    "separation": _nearest(x.least), "unheard": _nearest(x.unheard), "endangered": x.endangered,
                }
                for x in self.rows
            ],
        }  # fmt: skip

    def write(self, folder: Path) -> None:
        """Write the aborts to a folder: aborts.json, and a file for each vehicle.

        Each vehicle flies its own trajectory until the abort begins, slows down along it by the clock, so that its time
        along it is t - 2.5 T x^4 + 3 T x^5 - T x^6 with x the share of the time T of slowing down, and flies straight
        from place to place, by the share 35 x^4 - 84 x^5 + 70 x^6 - 20 x^7 of each way.
        """
        folder.mkdir(parents=True, exist_ok=True)
        write_file(folder / "aborts.json", _text(self.data()))
        for i in range(self.mission.n_agents):
            ways = {
                number: [
                    {
                        "name": x.name,
                        "duration_s": x.duration,
                        "to_m": np.round(x.end[i], 6).tolist(),
                    }
                    for x in steps
                ]
                for number, steps in self.homes.items()
            }
            aborts = [
                {"ordered_s": x.ordered, "begins_s": x.begins, "stops_s": x.stops, "ways": x.number}
                for x in self.rows
                if x.way
            ]
            table = {"vehicle": i + 1, "aborts": aborts, "ways": ways}
            write_file(folder / f"vehicle-{i + 1:04d}.json", _text(table))


def _text(table: dict[str, Any]) -> bytes:
    return (json.dumps(table, indent=1) + "\n").encode()


def _nearest(x: Nearest) -> dict[str, Any] | None:
    if not np.isfinite(x.separation):
        return None
    return {"least_m": x.separation, "time_s": x.time, "agents": [i + 1 for i in x.agents]}


def _unheard(run: list[AbortRow]) -> str:
    """What follows if a vehicle does not hear, in words."""
    worst = min(run, key=lambda x: x.unheard)
    x = worst.unheard
    if not np.isfinite(x.separation):
        return ""
    who, other = (agent_names([i]) for i in x.agents)
    near = f"least {x.separation:.2f} m" if x.separation > 0.0 else "hits it"
    text = f"{who} flies on: {near}, {other} at {x.time:.1f} s"
    return text + (f"; {worst.endangered} would come too near" if worst.endangered else "")


def check_aborts(
    mission: Mission, *, progress: Callable[[str], None] = lambda _: None
) -> AbortsCheck:
    """Plan an abort of each `abort.step` of a mission whose times are known.

    Raises
    ------
    MissionError
        No time of a phase keeps the limits of the mission.
    """
    progress("planned paths")
    aborts = Aborts(mission, legs_from(mission, at_start(mission), mission.phases))
    rows, homes = [], {}
    for abort in aborts.every():
        progress(f"way home from {abort.ordered:g} s")
        rows.append(_row(aborts, abort))
        homes.setdefault(abort.number, abort.steps[1:])
    return AbortsCheck(mission, rows, homes)


def _row(aborts: Aborts, abort: Abort) -> AbortRow:
    unheard, each = aborts.unheard(abort)
    endangered = int((each < max(aborts.judge.need, 0.0)).sum()) if abort.way else 0
    stops = abort.begins + (abort.steps[0].duration if abort.steps else 0.0)
    return AbortRow(
        abort.ordered, abort.begins, stops, abort.end, abort.way, abort.reason, abort.least,
        unheard, endangered, abort.number,
    )  # fmt: skip
