"""What a sweep says: success rate with its interval, percentiles, reasons, and what drives failure."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.result import plain
from rigidfleet.sweep.metrics import METRICS, readable
from rigidfleet.sweep.record import called
from rigidfleet.sweep.store import Table
from rigidfleet.sweep.variation import is_number
from rigidfleet.typing import Bools, Floats

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
    from rich.table import Table as Grid


PERCENTILES = (0, 5, 25, 50, 75, 95, 100)
#: What the intervals of rates hold [-].
CONFIDENCE = 0.95
#: A rank correlation that chance alone gives less often than this is one.
_CHANCE = 0.01
_SHOWN = 8  # drivers in words
#: A spread below these, relative and in the unit, is nothing to look into.
_SPREAD, _NOISE = 1e-3, 1e-5
#: Metrics that nobody asks what drives them.
ASIDE = ("flown", "steps", "evaluations")


@dataclass(frozen=True)
class Rate:
    """How many of how many, and the Wilson interval of the rate."""

    count: int
    of: int
    rate: float
    low: float
    high: float


@dataclass(frozen=True)
class Example:
    """A run, and why it failed; the words are empty where it fails another check before."""

    run: int
    detail: str


@dataclass(frozen=True)
class Driver:
    """Spearman's rank correlation of what varies with an outcome, and how likely chance gives as much."""

    varied: str
    outcome: str
    correlation: float
    chance: float


@dataclass(frozen=True)
class Summary:
    """A sweep in numbers.

    Attributes
    ----------
    name, mission : what was flown
    runs, flown : runs asked for, and those there are
    success : rate of flights that passed
    reasons : how many runs failed each check; a run may fail several
    examples : of each reason the first run, and why it failed
    percentiles : of each metric that applies, in the order of `PERCENTILES`
    drivers : rank correlations of every varied number with success and every metric, strongest first
    by_value : success rate at each value of what varies by words
    """

    name: str
    mission: str
    runs: int
    flown: int
    success: Rate
    reasons: dict[str, int]
    examples: dict[str, Example]
    percentiles: dict[str, list[float]]
    drivers: list[Driver]
    by_value: dict[str, dict[str, Rate]]

    def to_dict(self) -> dict[str, Any]:
        """The summary as plain data."""
        found = asdict(self)
        found["percentiles"] = {
            name: dict(zip(map(str, PERCENTILES), values, strict=True))
            for name, values in self.percentiles.items()
        }
        units = {name: METRICS[name].unit for name in self.percentiles}
        return plain(found | {"units": units, "confidence": CONFIDENCE})

    def json(self) -> str:
        """The summary as JSON text."""
        return json.dumps(self.to_dict(), ensure_ascii=False, allow_nan=False, indent=2)

    def __rich__(self) -> RenderableType:
        return _rendered(self)


def summarise(table: Table) -> Summary:
    """The summary of the rows there are."""
    failed = [reason for reasons in table.reason for reason in reasons.split(", ") if reason]
    percentiles = {}
    for name, values in table.metrics.items():
        if len(finite := values[np.isfinite(values)]):
            percentiles[name] = np.percentile(finite, PERCENTILES).tolist()
    by_value = {}
    for k, column in enumerate(table.sweep.columns):
        values = [column.variation.value(code) for code in table.codes[:, k].tolist()]
        if values and not all(map(is_number, values)):
            words = np.array([str(value) for value in values])
            by_value[column.name] = {
                word: rate(table.passed[words == word]) for word in dict.fromkeys(words.tolist())
            }
    return Summary(
        table.sweep.name,
        table.sweep.mission.name,
        table.sweep.runs,
        len(table.run),
        rate(table.passed),
        dict(Counter(failed).most_common()),
        _examples(table),
        percentiles,
        drivers(table),
        by_value,
    )


def _examples(table: Table) -> dict[str, Example]:
    """An example of each reason: if there is one, a run that fails by it first, as the words are of the first."""
    told: dict[str, Example] = {}
    others: dict[str, Example] = {}
    for run, reasons, detail in zip(table.run.tolist(), table.reason, table.detail, strict=True):
        first, *rest = reasons.split(", ")
        told.setdefault(first, Example(run, detail))
        for reason in rest:
            others.setdefault(reason, Example(run, ""))
    told.pop("", None)
    return others | told


def rate(passed: Bools) -> Rate:
    """Rate of what passed, with its Wilson interval; between 0 and 1 where there is nothing."""
    from scipy.stats import binomtest

    n, k = len(passed), int(passed.sum())
    if n == 0:
        return Rate(0, 0, math.nan, 0.0, 1.0)
    interval = binomtest(k, n).proportion_ci(CONFIDENCE, method="wilson")
    return Rate(k, n, k / n, float(interval.low), float(interval.high))


def outcomes(table: Table) -> dict[str, Floats]:
    """What a run is judged by: success and every metric, where it differs between runs."""
    found = {"success": table.passed.astype(float)} | table.metrics
    return {
        name: values
        for name, values in found.items()
        if _differs(values, _SPREAD, _NOISE) and name not in ASIDE
    }


def varied(table: Table) -> dict[str, Floats]:
    """Numbers that vary, by path: not what varies by words."""
    return {
        column.name: table.codes[:, k]
        for k, column in enumerate(table.sweep.columns)
        if column.name not in _worded(table) and _differs(table.codes[:, k])
    }


def drivers(table: Table) -> list[Driver]:
    """Rank correlation of every varied number with every outcome, strongest first."""
    from scipy.stats import spearmanr

    found = []
    for outcome, y in outcomes(table).items():
        there = np.isfinite(y)
        for name, x in varied(table).items():
            if there.sum() < 4 or not (_differs(x[there]) and _differs(y[there])):
                continue
            result: Any = spearmanr(x[there], y[there])
            found.append(Driver(name, outcome, float(result.statistic), float(result.pvalue)))
    return sorted(found, key=lambda d: -abs(d.correlation))


def _worded(table: Table) -> set[str]:
    return {
        column.name
        for column in table.sweep.columns
        if not all(map(is_number, getattr(column.variation, "values", ())))
    }


def _differs(values: Floats, relative: float = 0.0, absolute: float = 0.0) -> bool:
    finite = values[np.isfinite(values)]
    least = max(absolute, relative * np.abs(finite).max(initial=0.0))
    return len(finite) > 1 and bool(np.ptp(finite) > least)


# -- in words ----------------------------------------------------------------------------------------


#: Percentiles that are shown: on a narrow screen the inner ones are left out, so that none is cut.
_HEADS = dict(
    zip(PERCENTILES, ("least", "5 %", "25 %", "median", "75 %", "95 %", "most"), strict=True)
)
_UNBOUND = 1000  # columns
#: First, the space between columns goes.
_CHOICES = (1, PERCENTILES), (0, PERCENTILES), (1, (0, 25, 50, 75, 100)), (1, (0, 50, 100))


def _short(x: float) -> str:
    """Three digits of a number, or two and a power of ten, in six places and a sign."""
    size = abs(x)
    if size >= 99_999.5 or 0.0 < size < 0.01:
        digits, power = f"{x:.1e}".split("e")
        return f"{digits}e{int(power)}"
    return f"{x:.0f}" if size >= 999.5 else f"{x:.3g}"


def _grid(*columns: str, words: Sequence[str] = (), space: int = 1) -> Grid:
    """A table without rows. Where it is too wide, its first column and ``words`` are wrapped, and no number is cut."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as Grid

    table = Grid(box=SIMPLE_HEAD, pad_edge=False, padding=(0, space, 0, 0), header_style="bold")
    for k, column in enumerate(columns):
        wraps = k == 0 or column in words
        table.add_column(
            column, justify="left" if wraps else "right", no_wrap=not wraps, overflow="fold"
        )
    return table


class _Percentiles:
    """The table of metrics, with as many percentiles as there is room for."""

    def __init__(self, summary: Summary) -> None:
        self.summary = summary

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        unbound = options.update_width(_UNBOUND)
        for space, shown in _CHOICES:
            table = _grid("metric", "unit", *(_HEADS[p] for p in shown), space=space)
            for name, values in self.summary.percentiles.items():
                cells = (_short(x) for p, x in zip(PERCENTILES, values, strict=True) if p in shown)
                table.add_row(name, readable(METRICS[name].unit), *cells)
            if console.measure(table, options=unbound).maximum <= options.max_width:
                break
        yield table


def _rendered(summary: Summary) -> RenderableType:
    from rich.console import Group
    from rich.text import Text

    s = summary.success
    head = Text.assemble((summary.name, "bold"), f"  {summary.flown} of {summary.runs} runs")
    shown: list[RenderableType] = [head, _Percentiles(summary)]
    if summary.reasons:
        reasons = _grid("failed check", "runs", "of all", "for example", words=("for example",))
        for reason, count in summary.reasons.items():
            example = summary.examples[reason]
            words = Text(f"run {example.run}{': ' if example.detail else ''}{example.detail}")
            reasons.add_row(called(reason), str(count), f"{100 * count / s.of:.3g} %", words)
        shown.append(reasons)
    strong = [d for d in summary.drivers if d.chance < _CHANCE]
    failing = [d for d in strong if d.outcome == "success"]
    if strong:
        rank = _grid("what varies", "outcome", "rank correlation")
        for d in (failing + [d for d in strong if d not in failing])[:_SHOWN]:
            rank.add_row(d.varied, d.outcome, f"{d.correlation:+.2f}")
        shown.append(rank)
    for name, rates in summary.by_value.items():
        values = _grid(name, "passed", "95 % interval")
        for word, r in rates.items():
            values.add_row(
                word, f"{100 * r.rate:.3g} %", f"{100 * r.low:.3g} to {100 * r.high:.3g} %"
            )
        shown.append(values)
    if s.of:
        words = f"{s.count} of {s.of} runs passed: {100 * s.rate:.3g} %"
        words += f" (95 % interval {100 * s.low:.3g} to {100 * s.high:.3g} %)."
        shown.append(Text(words, "bold green" if s.count == s.of else "bold"))
    return Group(*shown)
