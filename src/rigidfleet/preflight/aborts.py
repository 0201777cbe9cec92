"""What `check --abort` says: from which seconds of the flight there is a way home that is proved, and which."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rigidfleet._common.facts import FactTable, Line, Row, Sheet, Shown
from rigidfleet._common.files import write_file
from rigidfleet._common.text import agent_names
from rigidfleet.mission import Mission
from rigidfleet.mission.boundaries import Worst
from rigidfleet.planning.abort import Abort, Aborts
from rigidfleet.planning.timing import legs_up_to, timed_mission_and_legs


@dataclass
class AbortsCheck(Shown):
    """Result of `check_aborts`.

    Attributes
    ----------
    mission : with its times known
    aborts : of each order
    unheard : of each, how near each vehicle comes to another one if it does not hear the order and flies on
    """

    mission: Mission
    aborts: list[Abort]
    unheard: list[list[Worst]]

    @property
    def least_separation(self) -> float:
        """The least separation that all ways home promise [m]."""
        return min((x.certificate.separation for x in self.aborts if x.home.way), default=np.inf)

    @property
    def _proved_in_words(self) -> str:
        """From how many times a way home is proved, and how near vehicles come on it, in words."""
        ways = sum(bool(x.home.way) for x in self.aborts)
        step, least = self.mission.aborting.step, self.least_separation
        text = f"a way home is proved from {ways} of {len(self.aborts)} times, {step:g} s apart"
        near = f"; no two vehicles come nearer than {least:.2f} m" if np.isfinite(least) else ""
        return text + near

    def facts(self) -> Sheet:
        """Runs of orders with the same answer, each with its worst numbers."""
        options, name = self.mission.aborting, self.mission.name
        heads = ("ordered [s]", "way home", "takes [s]", "least [m]", "one that does not hear")
        to = "any place" if options.to == "any" else "their own places"
        level = "ok" if self.aborts and all(x.home.way for x in self.aborts) else "note"
        parts = [
            FactTable(heads, [*self._rows_by_answer()], ("way home", "one that does not hear")),
            Line(f"{name}: {self._proved_in_words}", level),
        ]
        return Sheet(name, f"aborts, {options.reaction:g} s after each order, to {to}", parts)

    def sentences(self) -> list[str]:
        """How the mission is aborted, from when and when not, and what follows if a vehicle does not hear the order."""
        options, rows = self.mission.aborting, [*self._rows_by_answer()]
        to = (
            "to any places where vehicles stood" if options.to == "any" else "each to its own place"
        )
        lines = [
            f"Within {options.reaction:g} s of an order, all slow down along the plan, then go home, {to}."
        ]
        ways = [(x, y) for x, y in zip(self.aborts, self.unheard, strict=True) if x.home.way]
        takes = max((x.rest_time - x.ordered for x, _ in ways), default=0.0)
        longest = f"; going home takes {takes:.1f} s at most" if ways else ""
        lines.append(f"{self._proved_in_words[0].upper()}{self._proved_in_words[1:]}{longest}.")
        none = ((row.cells[0], row.cells[1]) for row in rows if row.level)
        lines += [f"{'From' if ' to ' in when else 'At'} {when} s, {why}." for when, why in none]
        if worst := self._unheard_in_words(min((y for _, y in ways if y), key=min, default=[])):
            lines.append(f"If one does not hear: {worst}.")
        return lines

    def _rows_by_answer(self) -> Iterator[Row]:
        both = zip(self.aborts, self.unheard, strict=True)
        for _, group in itertools.groupby(
            both, lambda x: re.sub(r"[\d.]+", "#", x[0].home.way or x[0].home.reason)
        ):
            run = list(group)
            aborts = [abort for abort, _ in run]
            first, last = aborts[0].ordered, aborts[-1].ordered
            when = f"{first:g}" if first == last else f"{first:g} to {last:g}"
            if not aborts[0].home.way:
                yield Row((when, f"none: {aborts[0].home.reason}", None, None, ""), "note")
                continue
            takes = max(x.rest_time - x.ordered for x in aborts)
            least = min(x.certificate.separation for x in aborts)
            worst = min((each for _, each in run if each), key=min, default=[])
            apart = least if np.isfinite(least) else None
            yield Row((when, aborts[0].home.way, takes, apart, self._unheard_in_words(worst)))

    def _unheard_in_words(self, each: list[Worst]) -> str:
        """What follows if a vehicle does not hear, in words."""
        if not each:
            return ""
        least, when, i, j = min(each)
        near = f"comes within {least:.2f} m of" if least > 0.0 else "hits"
        text = f"{agent_names([i])} flies on and {near} {agent_names([j])} at {when:.1f} s"
        count = self._endangered_vehicles(each)
        return text + (f"; {count} would come too near" if count else "")

    def _endangered_vehicles(self, each: list[Worst]) -> int:
        """How many vehicles would come within the limit of separation."""
        return sum(x.value < (self.mission.limits.separation or 0.0) for x in each)

    def data(self) -> dict[str, Any]:
        """Plain data for JSON, agents counted from 1."""
        options = self.mission.aborting
        return {
            "mission_sha256": self.mission.digest,
            "to": options.to, "reaction_s": options.reaction, "step_s": options.step,
            "sentences": self.sentences(),
            "aborts": [
                {
                    "ordered_s": x.ordered, "begins_s": x.begins, "waits_s": x.waits,
                    "stops_s": x.begins + x.waits + x.slows, "ends_s": x.rest_time,
                    "way": x.home.way, "reason": x.home.reason, "ways": x.home.number,
                    "separation": _pair_data(x.certificate.separation, x.certificate.time, *x.certificate.agents),
                    "unheard": _pair_data(*min(each)) if each else None, "endangered": self._endangered_vehicles(each),
                }
                for x, each in zip(self.aborts, self.unheard, strict=True)
            ],
        }  # fmt: skip

    def write(self, folder: Path) -> None:
        """Write the aborts to a folder: aborts.json, and a file for each vehicle.

        Each vehicle flies its own trajectory until the abort begins and has waited, slows down along it by the clock,
        so that its time along it goes on by T (x - 2.5 x^4 + 3 x^5 - x^6), with x the share of the time T of slowing
        down, and flies straight from place to place, by the share 35 x^4 - 84 x^5 + 70 x^6 - 20 x^7 of each way. In a
        step with ``back_to_s``, its time along its trajectory goes back to that, by the same share. Where ``ways`` is
        null, it flies its own trajectory to the end.
        """
        folder.mkdir(parents=True, exist_ok=True)
        data = self.data()
        homes = {x.home.number: x.home.steps for x in self.aborts if x.home.number is not None}
        keys = ("ordered_s", "begins_s", "waits_s", "stops_s", "ways")
        aborts = [{key: x[key] for key in keys} for x in data["aborts"] if x["way"]]
        tables, n = {"aborts.json": data}, self.mission.n_agents
        leavers = self.mission.aborting.agents or range(1, n + 1)
        for i in range(n):
            ways = {
                number: [
                    {"name": x.name, "duration_s": x.duration, "to_m": x.end[i].round(6).tolist()}
                    | ({} if x.path is None else {"back_to_s": x.path})
                    for x in steps
                ]
                for number, steps in homes.items()
                if i + 1 in leavers
            }
            own = [x | {"ways": x["ways"] if x["ways"] in ways else None} for x in aborts]
            tables[f"vehicle-{i + 1:04d}.json"] = {"vehicle": i + 1, "aborts": own, "ways": ways}
        for name, table in tables.items():
            write_file(folder / name, (json.dumps(table, indent=1) + "\n").encode())


def _pair_data(least: float, when: float, *who: int) -> dict[str, Any] | None:
    """Two vehicles that come nearest, as plain data; None for one alone."""
    agents = [i + 1 for i in who]
    return {"least_m": least, "time_s": when, "agents": agents} if np.isfinite(least) else None


def check_aborts(
    mission: Mission, *, progress: Callable[[str], None] = lambda _: None
) -> AbortsCheck:
    """Plan an abort of each `abort.step` of a mission.

    Raises
    ------
    MissionError
        No time of a phase keeps the limits of the mission, or another reason of `complete_times`.
    """
    progress("planned paths")
    mission, legs = timed_mission_and_legs(mission)
    aborts = Aborts(mission, legs_up_to(mission, len(mission.phases), legs))
    every: list[Abort] = []
    unheard: list[list[Worst]] = []
    for abort in aborts.all_aborts():
        progress(f"way home from {abort.ordered:g} s")
        every.append(abort)
        unheard.append(aborts.nearness_if_unheard(abort))
    return AbortsCheck(mission, every, unheard)
