"""Rules of a mission: when each is broken, where, what the problem is, and its remedy.

A rule is a condition in a generator that is about one table and yields a `Breach`. The modules beside this one have the
rules of their tables; `Draft.record_breaches` is the one place that records what is broken.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from rigidfleet.mission.findings import FindingCollector, Keys, look_up

#: Stands for the value that the user wrote.
_WRITTEN: Any = object()


class Breach(NamedTuple):
    """A rule that is broken.

    Attributes
    ----------
    where : the key at fault, or several that lead to it, below the table that the rule is about
    problem, remedy : in words
    value : shown beside them; default: what the user wrote
    """

    where: str | int | Keys
    problem: str
    remedy: str
    value: object = _WRITTEN


Breaches = Iterator[Breach]


def unused_key_rules(part: Any, key: str, other: str, *acts: str) -> Breaches:
    """A key that is written has no effect but with one of some values of another key."""
    if key in part.model_fields_set and getattr(part, other) not in acts:
        problem = f"has no effect with {other} '{getattr(part, other)}'"
        yield Breach(key, problem, f"remove it or use {other} = '{acts[0]}'")


class Draft(FindingCollector):
    """A mission under check. Its parts are attributes: those without errors, or else their defaults.

    Attributes
    ----------
    parts : what has been validated, by the fields of `rigidfleet.mission.schema.Contents`
    n : number of agents; None if it is not known
    end : mission time [s] at which the last phase ends at the latest; nan if it is not known
    """

    def __init__(self, data: Mapping[str, Any], origin: str, defaults: Mapping[str, Any]) -> None:
        super().__init__(data, origin)
        self.parts: dict[str, Any] = {}
        self.n: int | None = None
        self.end = math.nan
        self._defaults = defaults

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return self.parts.get(name, self._defaults.get(name))

    @property
    def flies_vehicles(self) -> bool:
        """Whether the agents are to fly vehicles."""
        agents = self.data.get("agents")
        return isinstance(agents, dict) and "vehicle" in agents

    @property
    def are_ways_smooth(self) -> bool:
        """Whether acceleration and jerk of the references are to be continuous."""
        return self.smoothness == "jerk"

    def one_per_agent_rules(self, part: Any, key: str, *where: str, alone: str = "") -> Breaches:
        """A list has one entry per agent; ``alone`` says what else may stand in its place."""
        entries = getattr(part, key)
        if isinstance(entries, tuple) and self.n not in (None, len(entries)):
            problem = f"has {len(entries)} entries for {self.n} agents"
            yield Breach(
                (*where, key), problem, f"give one entry per agent, {self.n} in all{alone}"
            )

    def record_breaches(self, path: Keys, breaches: Breaches) -> None:
        """Record the rules that are broken in the table at a path.

        A key that has had an error before gets no other, since that may follow from the wrong value; a table may.
        """
        wrong = set(self._wrong)
        for where, problem, remedy, value in breaches:
            at = (*path, *(where if isinstance(where, tuple) else (where,)))
            table = (
                at == path or isinstance(at[-1], int) or isinstance(look_up(self.data, at), dict)
            )
            if table or at not in wrong:
                self.add(at, problem, remedy, *(() if value is _WRITTEN else (value,)))
