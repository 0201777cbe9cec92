"""Variations of a sweep: distributions and grids, as tables of a sweep file or as lines.

agents.mass = uniform(0.8, 1.2)              one mass for all vehicles
agents.mass.* *= normal(1, 0.05)             a factor for the mass of each vehicle
agents.position.*.* += normal(0, 0.3)        an offset for every coordinate of every start position
constraint.alpha = geomspace(1, 10, 5)       a grid
constraint.solver = choice(iterated, exact)
"""

from __future__ import annotations

import json
import operator
import re
import sys
from functools import cached_property
from statistics import NormalDist
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, Strict

from rigidfleet.errors import RigidfleetError
from rigidfleet.mission.findings import suggest
from rigidfleet.mission.values import Number, Part, Positive, key, models_by_kind, required_key

#: Signs in a line, and the change that each stands for; what each change makes of a number and a value.
_SIGNS = {"=": "set", "+=": "add", "*=": "scale"}
_CHANGES = {"set": lambda _, value: value, "add": operator.add, "scale": operator.mul}
#: Greatest number, as an integer may be beyond.
_MOST = sys.float_info.max


class NotationError(RigidfleetError):
    """A path or a line that is not valid, with problem and remedy."""

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem, remedy)
        self.problem, self.remedy = problem, remedy


class Variation(Part):
    """A variation: a path in the mission, and the values there."""

    path: str = required_key(
        "path in the mission, counted from 1: agents.mass.2; * stands for all entries, each with its own value"
    )
    change: Literal["set", "add", "scale"] = key(
        "set: replaces the value in the mission; add: is added to it; scale: multiplies it", "set"
    )

    @property
    def grid(self) -> tuple[Any, ...]:
        """Values that are taken in turn; none of a distribution."""
        return ()

    @property
    def is_numeric(self) -> bool:
        """Whether all its values are numbers."""
        return True

    def changed_value(self, there: Any, value: Any) -> Any:
        """What is in the place of a number, or of an array, for a value of the variation."""
        return _CHANGES[self.change](there, value)

    def quantile(self, u: float) -> Any:
        """Value at the fraction u of a distribution, in (0, 1)."""
        raise NotImplementedError

    def encode(self, value: Any) -> float:
        """Encode a value as a number: the value itself, or its index in a list that is not numeric."""
        return float(value)

    def decode(self, code: float) -> Any:
        """Decode a value."""
        return code

    def key_problem_and_remedy(self) -> tuple[str, str, str] | None:
        """Key, problem and remedy of an error that involves several keys; None if there is none."""
        return None


class Gridded(Variation):
    """A grid: values taken in turn."""

    group: str = key(
        "grids of the same group take their values together, the first with the first; they have as many values;"
        " default: every grid is combined with all others",
        "",
    )


class Normal(Variation):
    """A normal distribution."""

    kind: Literal["normal"] = required_key("normal distribution")
    mean: Number = required_key("mean")
    sd: Positive = required_key("standard deviation, > 0")

    def quantile(self, u: float) -> float:
        """Value at the fraction u."""
        return NormalDist(self.mean, self.sd).inv_cdf(u)


class _Between(Variation):
    """A distribution between two ends."""

    low: Number = required_key("lower end")
    high: Number = required_key("upper end, > low")

    def key_problem_and_remedy(self) -> tuple[str, str, str] | None:
        """Ends in the wrong order."""
        if self.low < self.high:
            return None
        problem = f"must be above low = {self.low:g}"
        return "high", problem, "swap the two, or set a single value by grid"


class Uniform(_Between):
    """A uniform distribution."""

    kind: Literal["uniform"] = required_key("uniform distribution")

    def quantile(self, u: float) -> float:
        """Value at the fraction u."""
        return self.low + u * (self.high - self.low)


class LogUniform(_Between):
    """A distribution whose logarithm is uniform."""

    kind: Literal["log-uniform"] = required_key("distribution whose logarithm is uniform")
    low: Positive = required_key("lower end, > 0")

    def quantile(self, u: float) -> float:
        """Value at the fraction u."""
        return self.low * (self.high / self.low) ** u


class _Listed(Variation):
    """A list of values."""

    values: Annotated[tuple[Any, ...], Field(min_length=1)] = required_key(
        "values: numbers, words, true or false, lists"
    )

    def encode(self, value: Any) -> float:
        """Encode a value: itself if all values are numbers, else its index."""
        return float(value if self.is_numeric else self.values.index(value))

    def decode(self, code: float) -> Any:
        """Decode a value."""
        return code if self.is_numeric else self.values[int(code)]

    def key_problem_and_remedy(self) -> tuple[str, str, str] | None:
        """Error if a value is of another type, or if values that are not numbers are to be added or scaled."""
        if not all(map(_is_usable_value, self.values)):
            words = "finite numbers, words, true or false, or lists of these"
            return "values", f"must be {words}", "correct the value"
        if self.change != "set" and not self.is_numeric:
            problem = f"must be numbers to {self.change}"
            return "values", problem, "give numbers or use change = 'set'"
        return None

    @cached_property
    def is_numeric(self) -> bool:
        """Whether all its values are numbers."""
        return all(map(is_number, self.values))


class Choice(_Listed):
    """One of several values with equal probability."""

    kind: Literal["choice"] = required_key("one of several values with equal probability")

    def quantile(self, u: float) -> Any:
        """Value at the fraction u."""
        return self.values[min(int(u * len(self.values)), len(self.values) - 1)]


class Grid(_Listed, Gridded):
    """A grid of listed values."""

    kind: Literal["grid"] = required_key("grid of listed values")

    @property
    def grid(self) -> tuple[Any, ...]:
        """The values."""
        return self.values


class _Spaced(Gridded):
    """A grid of spaced numbers, both ends included."""

    low: Number = required_key("first value")
    high: Number = required_key("last value")
    count: Annotated[int, Strict(), Field(ge=2, le=10**6)] = required_key(
        "number of values, both ends included, >= 2"
    )


class Linspace(_Spaced):
    """A grid with equal differences."""

    kind: Literal["linspace"] = required_key("grid with equal differences")

    @cached_property
    def grid(self) -> tuple[float, ...]:
        """The values."""
        return tuple(np.linspace(self.low, self.high, self.count).tolist())


class Geomspace(_Spaced):
    """A grid with equal ratios."""

    kind: Literal["geomspace"] = required_key("grid with equal ratios")
    low: Positive = required_key("first value, > 0")
    high: Positive = required_key("last value, > 0")

    @cached_property
    def grid(self) -> tuple[float, ...]:
        """The values."""
        return tuple(np.geomspace(self.low, self.high, self.count).tolist())


_Kind = Normal | Uniform | LogUniform | Choice | Grid | Linspace | Geomspace
#: Models of variations by `kind`.
VARIATIONS = models_by_kind(Annotated[_Kind, Field(discriminator="kind")])
#: Keys that stand elsewhere in a line than in the brackets.
_SHARED = {*Gridded.model_fields, "kind"}
_LINE = re.compile(r"\s*(.+?)\s*(\+=|\*=|=)\s*([\w-]+)\s*\((.*)\)\s*", re.DOTALL)
_FORM = "write PATH = KIND(NUMBERS), as in agents.mass.* *= normal(1, 0.05)"


def parse_variation(line: str) -> dict[str, Any]:
    """Parse a line into the table that it stands for.

    Raises
    ------
    NotationError
        The line is not valid.
    """
    match = _LINE.fullmatch(line)
    if match is None:
        raise NotationError("is not a valid variation", _FORM)
    path, sign, kind, inside = match.groups()
    data = {"path": path, "change": _SIGNS[sign], "kind": kind}
    if kind not in VARIATIONS:
        remedy = suggest(kind, VARIATIONS) or f"use one of {', '.join(VARIATIONS)}"
        raise NotationError(f"there is no distribution or grid '{kind}'", remedy)
    values = [_parse_value(word) for word in _split_at_commas(inside)]
    keys = [name for name in VARIATIONS[kind].model_fields if name not in _SHARED]
    if keys == ["values"]:
        return data | {"values": values}
    if len(values) != len(keys):
        problem = f"{kind} takes {len(keys)} numbers, not {len(values)}"
        raise NotationError(problem, f"write {kind}({', '.join(keys)})")
    return data | dict(zip(keys, values, strict=True))


def is_number(value: object) -> bool:
    """Whether a value is a number; true and false are not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_usable_value(value: object) -> bool:
    """Whether a mission may have a value."""
    if isinstance(value, list | tuple | dict):
        return all(map(_is_usable_value, value.values() if isinstance(value, dict) else value))
    return isinstance(value, str) or (isinstance(value, int | float) and abs(value) <= _MOST)


def _split_at_commas(text: str) -> list[str]:
    """Split text at commas outside of brackets."""
    words, depth = [""], 0
    for letter in text:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and not depth:
            words.append("")
        else:
            words[-1] += letter
    return [word.strip() for word in words] if text.strip() else []


def _parse_value(word: str) -> Any:
    """Convert a word to a number, true, false or a list; otherwise return it without quotes."""
    for read in (json.loads, float):
        try:
            return read(word)
        except (ValueError, RecursionError):
            continue
    return word.strip("'\"")
