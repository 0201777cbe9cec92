"""What varies in a sweep, and how: distributions and grids, as tables of a sweep file or in one line.

agents.mass = uniform(0.8, 1.2)              one mass for all vehicles
agents.mass.* *= normal(1, 0.05)             of each vehicle its own, about what the mission has
agents.position.*.* += normal(0, 0.3)        every coordinate of every start
constraint.alpha = geomspace(1, 10, 5)       a grid
constraint.solver = choice(iterated, exact)
"""

from __future__ import annotations

import json
import re
from abc import abstractmethod
from dataclasses import dataclass
from statistics import NormalDist
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, Strict

from rigidfleet.mission.findings import near
from rigidfleet.mission.schema import Number, Part, Positive

#: The line's sign for each way to change.
SIGNS = {"=": "set", "+=": "add", "*=": "scale"}


class Variation(Part):
    """One entry of a sweep: a path in the mission, and the values it takes."""

    path: str = Field(
        description="place in the mission, counted from 1: agents.mass.2; * stands for all, each with a "
        "value of its own"
    )
    change: Literal["set", "add", "scale"] = Field(
        "set",
        description="set: in place of what the mission has; add: added to it; scale: times it",
    )

    def code(self, value: Any) -> float:
        """A value that it takes, as a number: itself, or its place in a list that is not of numbers."""
        return float(value)

    def value(self, code: float) -> Any:
        """The value of a code."""
        return code

    def wrong(self) -> tuple[str, str, str] | None:
        """Key, problem and remedy of what only several keys together tell."""
        return None


class Drawn(Variation):
    """A distribution to draw from."""

    @abstractmethod
    def quantile(self, u: float) -> Any:
        """Value at the fraction u, in (0, 1), of the distribution."""


class Gridded(Variation):
    """Values to take in turn."""

    @property
    @abstractmethod
    def grid(self) -> tuple[Any, ...]:
        """The values."""


class Normal(Drawn):
    """A normal distribution."""

    kind: Literal["normal"] = Field(description="a normal distribution")
    mean: Number = Field(description="its mean")
    sd: Positive = Field(description="its standard deviation, > 0")

    def quantile(self, u: float) -> float:
        """Value at the fraction u."""
        return NormalDist(self.mean, self.sd).inv_cdf(u)


class Uniform(Drawn):
    """A uniform distribution."""

    kind: Literal["uniform"] = Field(description="a uniform distribution")
    low: Number = Field(description="its lower end")
    high: Number = Field(description="its upper end, above low")

    def quantile(self, u: float) -> float:
        """Value at the fraction u."""
        return self.low + u * (self.high - self.low)

    def wrong(self) -> tuple[str, str, str] | None:
        """Ends in the wrong order."""
        return _ordered(self.low, self.high)


class LogUniform(Drawn):
    """A distribution whose logarithm is uniform."""

    kind: Literal["log-uniform"] = Field(description="the logarithm is uniform")
    low: Positive = Field(description="its lower end, > 0")
    high: Positive = Field(description="its upper end, above low")

    def quantile(self, u: float) -> float:
        """Value at the fraction u."""
        return self.low * (self.high / self.low) ** u

    def wrong(self) -> tuple[str, str, str] | None:
        """Ends in the wrong order."""
        return _ordered(self.low, self.high)


class _Listed(Variation):
    """Several values."""

    values: Annotated[tuple[Any, ...], Field(min_length=1)] = Field(
        description="its values: numbers, words, true or false, lists"
    )

    def code(self, value: Any) -> float:
        """A number itself, if all are numbers, else the place of a value among them."""
        return float(value) if self._numeric else float(self.values.index(value))

    def value(self, code: float) -> Any:
        """The value of a code."""
        return code if self._numeric else self.values[int(code)]

    def wrong(self) -> tuple[str, str, str] | None:
        """Words cannot be added."""
        if self.change != "set" and not self._numeric:
            return "values", f"must be numbers to {self.change}", "give numbers, or set them"
        return None

    @property
    def _numeric(self) -> bool:
        return all(map(is_number, self.values))


class Choice(_Listed, Drawn):
    """One of several values, each as likely."""

    kind: Literal["choice"] = Field(description="one of several values, each as likely")

    def quantile(self, u: float) -> Any:
        """Value at the fraction u."""
        return self.values[min(int(u * len(self.values)), len(self.values) - 1)]


class Grid(_Listed, Gridded):
    """Each of several values in turn."""

    kind: Literal["grid"] = Field(description="each of several values in turn")

    @property
    def grid(self) -> tuple[Any, ...]:
        """Its values."""
        return self.values


class _Spaced(Gridded):
    """Each of several numbers in turn, from one end to the other."""

    count: Annotated[int, Strict(), Field(ge=2, le=10**6)] = Field(
        description="how many numbers, both ends included, >= 2"
    )


class Linspace(_Spaced):
    """A grid of equal differences."""

    kind: Literal["linspace"] = Field(description="a grid of equal differences")
    low: Number = Field(description="its first number")
    high: Number = Field(description="its last number")

    @property
    def grid(self) -> tuple[float, ...]:
        """Its numbers."""
        return tuple(np.linspace(self.low, self.high, self.count).tolist())


class Geomspace(_Spaced):
    """A grid of equal ratios."""

    kind: Literal["geomspace"] = Field(description="a grid of equal ratios")
    low: Positive = Field(description="its first number, > 0")
    high: Positive = Field(description="its last number, > 0")

    @property
    def grid(self) -> tuple[float, ...]:
        """Its numbers."""
        return tuple(np.geomspace(self.low, self.high, self.count).tolist())


#: What `kind` may be, and the keys of each in the order of a line.
KINDS: dict[str, type[Variation]] = {
    "normal": Normal,
    "uniform": Uniform,
    "log-uniform": LogUniform,
    "choice": Choice,
    "grid": Grid,
    "linspace": Linspace,
    "geomspace": Geomspace,
}
_KEYS = {
    "normal": ("mean", "sd"),
    "uniform": ("low", "high"),
    "log-uniform": ("low", "high"),
    "linspace": ("low", "high", "count"),
    "geomspace": ("low", "high", "count"),
}
_LINE = re.compile(r"\s*(.+?)\s*(\+=|\*=|=)\s*([\w-]+)\s*\((.*)\)\s*", re.DOTALL)
_FORM = "write PATH = KIND(NUMBERS), as in agents.mass.* *= normal(1, 0.05)"


@dataclass(frozen=True)
class WrongLine:
    """What is wrong with a line, and what to do about it."""

    problem: str
    remedy: str


def from_line(line: str) -> dict[str, Any] | WrongLine:
    """The table that a line stands for."""
    match = _LINE.fullmatch(line)
    if match is None:
        return WrongLine("is no variation", _FORM)
    path, sign, kind, inside = match.groups()
    data = {"path": path, "change": SIGNS[sign], "kind": kind}
    if kind not in KINDS:
        remedy = near(kind, KINDS) or f"use one of {', '.join(KINDS)}"
        return WrongLine(f"there is no distribution or grid '{kind}'", remedy)
    values = [_value(word) for word in _words(inside)]
    if kind not in _KEYS:
        return data | {"values": values}
    keys = _KEYS[kind]
    if len(values) != len(keys):
        problem = f"{kind} takes {len(keys)} numbers, not {len(values)}"
        return WrongLine(problem, f"write {kind}({', '.join(keys)})")
    return data | dict(zip(keys, values, strict=True))


def is_number(value: object) -> bool:
    """Whether a value is a number, which true and false are not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _words(text: str) -> list[str]:
    """Words between commas that stand in no brackets."""
    words, depth = [""], 0
    for letter in text:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and not depth:
            words.append("")
        else:
            words[-1] += letter
    return [word.strip() for word in words] if text.strip() else []


def _value(word: str) -> Any:
    """A number, true, false or a list; or the word itself, with or without quotes."""
    for read in (json.loads, float):
        try:
            return read(word)
        except ValueError:
            continue
    return word.strip("'\"")


def _ordered(low: float, high: float) -> tuple[str, str, str] | None:
    if low < high:
        return None
    return "high", f"must be above low = {low:g}", "exchange the two, or set one number by grid"
