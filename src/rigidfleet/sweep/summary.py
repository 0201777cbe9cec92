"""Summary of a sweep: success rate with its interval, percentiles, reasons of failure, and rank correlations."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from statistics import NormalDist
from typing import Any

import numpy as np

from rigidfleet._common.facts import FactTable, Line, Row, Sheet, Shown, display_unit
from rigidfleet._common.plain import to_json_data
from rigidfleet.sweep import store
from rigidfleet.sweep.faults import FAULTS
from rigidfleet.sweep.metrics import METRICS, readable_unit
from rigidfleet.sweep.record import BROKEN, reason_in_words
from rigidfleet.typing import Bools, Floats, Ints

#: Percentiles of metrics.
PERCENTILES = (0, 5, 25, 50, 75, 95, 100)
#: Confidence level of the intervals of rates [-].
CONFIDENCE = 0.95
#: Share of the rank correlations shown that chance may have made (false discovery rate).
_CHANCE = 0.01
#: Maximum number of rank correlations in the table.
_SHOWN = 8
#: A metric whose range is below these limits, relative and absolute (in its unit), counts as constant.
_SPREAD, _NOISE = 1e-3, 1e-5
#: Metrics without correlations.
ASIDE = ("flown", "steps", "evaluations")


@dataclass(frozen=True)
class Rate:
    """A rate: count, total, fraction and Wilson interval."""

    count: int
    of: int
    rate: float
    low: float
    high: float

    @property
    def interval(self) -> str:
        """The interval in words."""
        return f"{100 * self.low:.3g} to {100 * self.high:.3g} %"


@dataclass(frozen=True)
class Example:
    """A failed run and its message; the message is empty if it is about another check."""

    run: int
    detail: str


@dataclass(frozen=True)
class Driver:
    """Spearman's rank correlation of a varied number with an outcome, and its p-value (`chance`).

    `adjusted` is the p-value after Benjamini and Hochberg: of all drivers that it is below q for, chance makes the
    share q at most.
    """

    varied: str
    outcome: str
    correlation: float
    chance: float
    adjusted: float


@dataclass(frozen=True)
class Borne:
    """How often a fault of a drill fails, and how.

    Attributes
    ----------
    fault, magnitude, unit : what happens, and by how much
    vehicles : to how many
    failed : rate of the runs that fail
    separation : least separation that was measured [m]; None if none was
    worst : of the runs that fail, the one of least separation; None if none does
    """

    fault: str
    magnitude: float
    unit: str
    vehicles: int
    failed: Rate
    separation: float | None
    worst: Example | None


@dataclass(frozen=True)
class Summary(Shown):
    """Summary of a sweep.

    Attributes
    ----------
    name, mission : names of the sweep and of its mission
    runs, flown : number of runs of the sweep, and number of finished ones
    success : rate of runs that passed
    reasons : number of runs that failed each check; a run can fail several
    examples : for each reason, a run and its message
    percentiles : values of each metric at `PERCENTILES`
    drivers : rank correlations of every varied number with success and every metric, strongest first
    by_value : success rate for each value of a variation that is not numeric
    random_numbers : "shared": all runs have the same ones; "own": each run has its own; "varied": their seeds vary;
        "none": no random numbers act
    levels : number of runs by the level of machine code that flew them, if it is known
    drill : how often each fault of a drill fails, in order; empty for other sweeps
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
    random_numbers: str
    levels: dict[str, int]
    drill: list[Borne] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """The summary as plain data."""
        data = asdict(self)
        if not self.drill:
            del data["drill"]
        data["percentiles"] = {
            name: dict(zip(map(str, PERCENTILES), values, strict=True))
            for name, values in self.percentiles.items()
        }
        units = {name: METRICS[name].unit for name in self.percentiles}
        tested = {"pairs_tested": len(self.drivers), "false_discovery_rate": _CHANCE}
        return to_json_data(data | tested | {"units": units, "confidence": CONFIDENCE})

    def json(self) -> str:
        """The summary as JSON text."""
        return json.dumps(self.to_dict(), ensure_ascii=False, allow_nan=False, indent=2)

    def facts(self) -> Sheet:
        """Percentiles, reasons of failure, rank correlations, and the rate of success."""
        s, n = self.success, len(self.drivers)
        strong = [d for d in self.drivers if d.adjusted < _CHANCE]
        parts: list[Any] = [
            self._percentile_table(),
            self._reason_table(),
            self._correlation_table(strong),
        ]
        if self.drill:
            parts = [*self._case_tables(), self._reason_table()]
        if BROKEN in self.reasons:
            words = "Rows of program errors stay. Where the machine was to blame, as without memory, --force flies all."
            parts.append(Line(words, "note"))
        if n:
            words = f"{len(strong)} of {n} pairs tested correlate (false discovery rate {100 * _CHANCE:g} %)."
            parts.append(Line(words))
        if self.random_numbers != "none":
            words = {"shared": "the same in all runs", "own": "of each run its own"}
            numbers = words.get(self.random_numbers, "by varied seeds")
            parts.append(Line(f"Random numbers: {numbers}."))
        if len(self.levels) > 1:
            levels = ", ".join(f"{count} by {level}" for level, count in self.levels.items())
            parts.append(Line(f"Levels of machine code, whose last bits differ: {levels}.", "note"))
        for name, rates in () if self.drill else self.by_value.items():
            rows = [Row((word, f"{100 * r.rate:.3g} %", r.interval)) for word, r in rates.items()]
            parts.append(FactTable((name, "passed", "95 % interval"), rows))
        if s.of:
            words = f"{s.count} of {s.of} runs passed: {100 * s.rate:.3g} % (95 % interval {s.interval})."
            parts.append(Line(words, "ok" if s.count == s.of else "note"))
        return Sheet(self.name, f"{self.flown} of {self.runs} runs", parts)

    def drill_sentences(self) -> list[str]:
        """What a drill has shown, first of all faults, then of each, in a sentence: for the first page of a report."""
        lines = [f"{self.success.count:,} of {self.flown:,} faults are harmless."]
        if more := self.runs - self.flown:
            lines.append(f"{more:,} more are planned and were not tried.")
        for (fault, unit), cases in groupby(self.drill, lambda x: (x.fault, x.unit)):
            harmless, dangerous, why = [], [], ""
            for size, same_size in groupby(cases, lambda x: x.magnitude):
                every = [*same_size]
                if failed := sum(x.failed.count for x in every):
                    of = sum(x.failed.of for x in every)
                    dangerous.append(f"{failed} of {of} fail by {size:g}")
                    why = why or next(f": {x.worst.detail}" for x in every if x.worst)
                else:
                    harmless.append(f"{size:g}")
            parts = [f"none fails by {', '.join(harmless)}"] * bool(harmless) + dangerous
            words = f"{'; '.join(parts)} {display_unit(unit)}".rstrip()
            lines.append(f"{fault.capitalize()}: {words}{why}.")
        return lines

    def _case_tables(self) -> list[FactTable]:
        """Shares of each case, and below them the worst run of those that fail: its words are too long for a column."""
        shares, worst = [], []
        for x in self.drill:
            size, by = x.failed, f"{x.magnitude:g} {display_unit(x.unit)}".strip()
            case, share = (x.fault, by, x.vehicles), f"{100 * size.rate:.3g} %"
            level: Any = "fails" if size.count else "ok"
            shares.append(Row((*case, f"{size.count} of {size.of}", share, x.separation), level))
            if x.worst:
                worst.append(Row((*case, x.worst.run, x.worst.detail)))
        heads = "fault", "by", "vehicles"
        return [
            FactTable((*heads, "fail", "share", "least apart [m]"), shares),
            FactTable((*heads, "run", "the worst"), worst, ("the worst",)),
        ]

    def _percentile_table(self) -> FactTable:
        heads = "metric", "unit", "min", "5 %", "25 %", "median", "75 %", "95 %", "max"
        units = {name: readable_unit(METRICS[name].unit) for name in self.percentiles}
        return FactTable(heads, [Row((x, units[x], *v)) for x, v in self.percentiles.items()])

    def _reason_table(self) -> FactTable:
        rows = []
        for reason, count in self.reasons.items():
            example = self.examples[reason]
            words = f"run {example.run}{': ' if example.detail else ''}{example.detail}"
            share = f"{100 * count / self.success.of:.3g} %"
            rows.append(Row((reason_in_words(reason), count, share, words)))
        return FactTable(("failed check", "runs", "of all", "for example"), rows, ("for example",))

    def _correlation_table(self, strong: Sequence[Driver]) -> FactTable:
        """The strongest, those with success first."""
        first = sorted(strong, key=lambda d: d.outcome != "success")[:_SHOWN]
        rows = [Row((d.varied, d.outcome, f"{d.correlation:+.2f}")) for d in first]
        return FactTable(("varied number", "outcome", "rank correlation"), rows, ("outcome",))


def summarise(table: store.Table) -> Summary:
    """Summarise the finished runs of a sweep."""
    percentiles = {}
    for name, values in table.metrics.items():
        if len(finite := values[np.isfinite(values)]):
            percentiles[name] = np.percentile(finite, PERCENTILES).tolist()
    by_value = {}
    for k, column in enumerate(table.sweep.columns):
        if not column.variation.is_numeric:
            words = np.array([str(column.variation.decode(x)) for x in table.codes[:, k].tolist()])
            by_value[column.name] = {
                word: pass_rate(table.passed[words == word])
                for word in dict.fromkeys(words.tolist())
            }
    sweep = table.sweep
    seeded = any(column.keys[-1] == "seed" for column in sweep.columns)
    numbers = "varied" if seeded else sweep.header.random_numbers
    return Summary(
        sweep.name,
        sweep.mission.name,
        sweep.runs,
        len(table.run),
        pass_rate(table.passed),
        failure_counts(table.reason),
        _examples_by_reason(table),
        percentiles,
        correlations_by_strength(table),
        by_value,
        numbers if sweep.has_random_flights else "none",
        table.levels,
        failure_rates(table),
    )


def failure_rates(table: store.Table) -> list[Borne]:
    """How often each fault of a drill fails; empty for other sweeps."""
    cases = []
    for codes in np.unique(table.codes, axis=0) if table.sweep.drill else []:
        some = np.flatnonzero((table.codes == codes).all(axis=1))
        apart, passed = table.metrics["separation"][some], table.passed[some]
        fault, size, count = (
            c.variation.decode(x) for c, x in zip(table.sweep.columns, codes.tolist(), strict=True)
        )
        worst, failed, share = None, some[~passed], pass_rate(~passed)
        if len(failed):
            k = failed[np.where(np.isnan(apart[~passed]), np.inf, apart[~passed]).argmin()]
            worst = Example(int(table.run[k]), str(table.detail[k]))
        least = float(np.fmin.reduce(apart)) if np.isfinite(apart).any() else None
        cases.append(Borne(fault, size, FAULTS[fault], int(count), share, least, worst))
    return cases


def failure_counts(reasons: Iterable[str]) -> dict[str, int]:
    """Number of runs that failed each check, most frequent first, of the reasons of each run."""
    failed = [check for checks in reasons for check in checks.split(", ") if check]
    return dict(Counter(failed).most_common())


def _examples_by_reason(table: store.Table) -> dict[str, Example]:
    """An example of each reason, preferably a run that fails it first: messages are about the first check."""
    with_detail: dict[str, Example] = {}
    others: dict[str, Example] = {}
    for run, reasons, detail in zip(table.run.tolist(), table.reason, table.detail, strict=True):
        first, *rest = reasons.split(", ")
        with_detail.setdefault(first, Example(run, detail))
        for reason in rest:
            others.setdefault(reason, Example(run, ""))
    with_detail.pop("", None)
    return others | with_detail


def pass_rate(passed: Bools) -> Rate:
    """Success rate with its Wilson interval; NaN with the interval 0 to 1 if there are no runs."""
    n, k = len(passed), int(passed.sum())
    if n == 0:
        return Rate(0, 0, math.nan, 0.0, 1.0)
    low, high = wilson_interval(np.array([k]), np.array([n]))
    return Rate(k, n, k / n, float(low[0]), float(high[0]))


def wilson_interval(k: Ints, n: Ints) -> tuple[Floats, Floats]:
    """Ends of the Wilson interval of each rate: k (m,) of n (m,)."""
    p, z = k / n, NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE)
    middle = (2 * n * p + z**2) / (2 * (n + z**2))
    half = z / (2 * (n + z**2)) * np.sqrt(4 * n * p * (1 - p) + z**2)
    return np.where(k == 0, 0.0, middle - half), np.where(k == n, 1.0, middle + half)


def outcomes(table: store.Table) -> dict[str, Floats]:
    """Outcomes of runs: success and every metric, if they differ between runs."""
    all_outcomes = {"success": table.passed.astype(float)} | table.metrics
    return {
        name: values
        for name, values in all_outcomes.items()
        if _has_spread(values, _SPREAD, _NOISE) and name not in ASIDE
    }


def varied_numbers(table: store.Table) -> dict[str, Floats]:
    """Varied numbers by path, without seeds, which have no order, and variations that are not numeric."""
    return {
        column.name: table.codes[:, k]
        for k, column in enumerate(table.sweep.columns)
        if column.has_order and _has_spread(table.codes[:, k])
    }


def correlations_by_strength(table: store.Table) -> list[Driver]:
    """Rank correlation of every varied number with every outcome, strongest first; of a drill's faults, none."""
    if table.sweep.drill is not None:
        return []
    tested: list[tuple[str, str, float, float]] = []
    numbers = varied_numbers(table)
    ranked = {name: _centred_ranks(x) for name, x in numbers.items()}
    for outcome, y in outcomes(table).items():
        there = np.isfinite(y)
        if (n := int(there.sum())) < 4:
            continue
        every = n == len(y)
        y_ranked = _centred_ranks(y[there])
        for name, x in numbers.items():
            if every or _has_spread(x[there]):
                x_ranked = ranked[name] if every else _centred_ranks(x[there])
                tested.append((name, outcome, *_rank_correlation(x_ranked, y_ranked)))
    adjusted = _adjusted_p_values(np.array([chance for *_, chance in tested]))
    pairs = [Driver(*d, float(q)) for d, q in zip(tested, adjusted, strict=True)]
    return sorted(pairs, key=lambda d: -abs(d.correlation))


def _adjusted_p_values(chance: Floats) -> Floats:
    """P-values (n,) corrected for their number, by Benjamini and Hochberg."""
    n = len(chance)
    order = np.argsort(-chance)
    adjusted = np.empty(n)
    adjusted[order] = np.minimum.accumulate(chance[order] * n / np.arange(n, 0, -1))
    return adjusted


def _centred_ranks(x: Floats) -> Floats:
    """Ranks (n,) of values, centred; equal values have their mean rank."""
    _, which, counts = np.unique(x, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - 0.5 * counts)[which] - 0.5 * len(x)


def _rank_correlation(x: Floats, y: Floats) -> tuple[float, float]:
    """Correlation of ranks, and the chance of a larger one: Student's t with n - 2 degrees of freedom.

    It is at least that of the strongest correlation, which two of all orders have: t is too sure of a few runs.
    """
    from scipy.special import stdtr

    r = float(np.clip(x @ y / math.sqrt(x @ x * (y @ y)), -1.0, 1.0))
    free, least = len(x) - 2, 2.0 * math.exp(-math.lgamma(len(x) + 1.0))
    if abs(r) == 1.0:
        return r, least
    t = abs(r) * math.sqrt(free / ((1.0 + r) * (1.0 - r)))
    return r, max(float(2.0 * stdtr(free, -t)), least)


def _has_spread(values: Floats, relative: float = 0.0, absolute: float = 0.0) -> bool:
    finite = values[np.isfinite(values)]
    least = max(absolute, relative * np.abs(finite).max(initial=0.0))
    return len(finite) > 1 and bool(np.ptp(finite) > least)
