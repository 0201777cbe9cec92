"""A verdict on what was measured: passed, failed, or undecided, by intervals of all that is judged.

What is judged of places changes no more than the places do: a distance from a slot, a wall or a fence by at most the
distance of a vehicle's true place from the likely one, a distance of two vehicles by that of their true difference from
the likely one, a speed by that of velocities. How far these are apart is known from ways drawn beside the likely one
(`deviations`). An extreme is worse than what it was taken from is wrong at one time: so the greatest deviation counts,
over all times and vehicles at which the extreme may be. That is a simultaneous band, which has no bias.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rigidfleet._common.quantities import quantity
from rigidfleet._common.text import first_few
from rigidfleet.assessment.alignment import Alignment
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.verdict import CheckResult, Verdict, keeps_limit, value
from rigidfleet.formation.assignment import least_squares_assignment
from rigidfleet.math import proximity
from rigidfleet.math.smoothing import NoiseEstimate
from rigidfleet.result import Result
from rigidfleet.result.quantities import SAMPLED, norms
from rigidfleet.typing import Floats, Ints

#: What a log does not show of what is no quantity, which checks leave out; sources of quantities that it shows.
_UNSEEN = ("record", "settled", "waypoint_attitude", "waypoint_rates")
_SEEN = ("", "a plan", "edges")
#: Checks of shapes; those of a moment, at the end of a phase; those of which nothing is in doubt.
_SHAPES = ("shape", "distances", "order", "handedness", "flip")
_AT_END = (*_SHAPES, "waypoint_position", "waypoint_velocity", "touch_down", "corner")
_CERTAIN = ("complete", "samples", "abandoned")
#: Derivative of the position that a check is of, where no quantity says it.
_ORDERS = {"waypoint_velocity": 1, "touch_down": 1, "corner": 1}
#: Half of the power of noise by which an interval of a derivative shrinks (of positions 5/6, speeds 1/2, accelerations
#: 1/6: splines of a third derivative that wanders), and of white noise's rate; the greatest rate that is named; a share
#: to be safe.
_POWERS, _TIMES, _SHORTER = (5 / 12, 3 / 12, 1 / 12), 250.0, 0.9
#: What a vehicle is off its slot on average, at least, to be named [m]; errors from which on something is sure.
_OFF, _SURE = 0.01, 4.0
#: What a choice of clocks does, in words.
_APPLIED = {
    "recorded": "clocks count as recorded (--clock offset takes it out)", "offset": "that is taken out",
    "own": "each vehicle's own offset is taken out, and separation is not judged",
}  # fmt: skip
#: Samples by which slots are matched with vehicles; a share of the distances as judged that is less by another order.
_SAMPLES, _NEARER = 20, 0.5
#: Time about a reset of an estimator in which a smoothed way is not what was flown [s].
_RESET = 1.0
#: Pairs and times that may be nearest, of which so many are compared, and distances that are computed together.
_CANDIDATES, _AT_ONCE = 100_000, 500_000


@dataclass(frozen=True)
class DrawnWays:
    """How ways drawn differ from the likely one at the samples of its result.

    Attributes
    ----------
    states : (S, 3, K, N, 3) position, velocity, acceleration, of S ways; float32
    """

    result: Result
    states: Floats

    @cached_property
    def likely_flight_measurements(self) -> Measurements:
        """The likely flight."""
        return Measurements(self.result)

    def uncertainty_of(self, check: CheckResult) -> float:
        """By how much what is judged may differ from what is true, in the unit of the check."""
        name, order, shifts = _quantity_name(check), _derivative_order(check), self.states
        q = quantity(name)
        if check.worst is None and name not in _SHAPES:  # it cannot be judged, whatever the noise
            return 0.0
        if name in _AT_END:
            k = int(np.abs(self.result.time - (check.when or 0.0)).argmin())
            if name not in _SHAPES:
                return _estimate_greatest_norm(shifts[:, order, k])
            i, j = proximity.all_pairs(self.result.n_agents)
            by = _estimate_greatest_norm(shifts[:, 0, k, i] - shifts[:, 0, k, j])
            least = float(norms(self.result.position[k, i] - self.result.position[k, j]).min())
            if check.worst is None:  # what is lost where vehicles may change places
                return by if by > 0.5 * least else 0.0
            return math.degrees(math.atan2(by, least)) if check.unit == "deg" else by
        sizes = norms(shifts[:, order])
        most = _estimate_greatest(sizes)
        if q.name in ("separation", "separation_flying"):
            k, i, j = self._near_pairs(float(check.worst or 0.0) + 4.0 * most)
            return _estimate_greatest_norm(shifts[:, 0, k, i] - shifts[:, 0, k, j])
        if _is_of_pairs(name):
            return 2.0 * most
        if name == "people":  # where one falls depends on its velocity, for the time of a fall
            height, gravity = np.ptp(self.result.position[..., 2]), self.result.mission.gravity
            return most + math.sqrt(2.0 * height / gravity) * _estimate_greatest_norm(shifts[:, 1])
        if q.measure and not q.monitored:  # others' places may count, too
            r, v, mission = self.result.position, self.result.velocity, self.result.mission
            by = [q.measure(mission, r + x[0], v + x[1]) for x in shifts]
            return _estimate_greatest(np.abs(by - q.measure(mission, r, v)))
        values = -self.likely_flight_measurements.closeness.each if name == "clearance" else None
        if name in SAMPLED and q.who == "agent":
            values = self.likely_flight_measurements.samples_of(name).rank
        if values is None or values.shape != sizes.shape[1:]:
            return most
        # Only what is near the worst value may be the worst in truth.
        return _estimate_greatest(sizes[:, values >= q.rank(check.worst) - 2.0 * most])

    def _near_pairs(self, reach: float) -> tuple[Ints, Ints, Ints]:
        """Samples and pairs whose surfaces are nearer than a distance: the nearest ones, if they are many."""
        radius, (i, j) = self.result.mission.fleet.radius, proximity.all_pairs(self.result.n_agents)
        parts = np.array_split(self.result.position, -(-len(self.result.time) * len(i) // _AT_ONCE))
        apart = np.concatenate([norms(r[:, i] - r[:, j]).astype(np.float32) for r in parts])
        apart = (apart - (radius[i] + radius[j])).ravel()
        near = np.flatnonzero(apart <= max(reach, float(apart.min())))
        if len(near) > _CANDIDATES:
            near = near[np.argpartition(apart[near], _CANDIDATES)[:_CANDIDATES]]
        k, pair = np.divmod(near, len(i))
        return k, i[pair], j[pair]


def _estimate_greatest_norm(draws: Floats) -> float:
    return _estimate_greatest(norms(draws))


def _estimate_greatest(sizes: Floats) -> float:
    """How great lengths (S, ...) of deviations of S ways drawn may be: so few ways alone do not reach what is rare."""
    squares = float(np.einsum("s...,s...->...", sizes, sizes).max(initial=0.0))
    return max(float(sizes.max(initial=0.0)), _SURE * math.sqrt(squares / (3 * len(sizes))))


def _quantity_name(check: CheckResult) -> str:
    return re.sub("_(flight|start|end)$", "", check.check)


def _derivative_order(check: CheckResult) -> int:
    """Which derivative of positions a check is of."""
    name = _quantity_name(check)
    return _ORDERS.get(name, quantity(name).order)


def _is_of_pairs(name: str) -> bool:
    """Whether a check is of two vehicles or more: without a common clock it is not judged."""
    return name in (*_SHAPES, "separation_as_planned") or quantity(name).who in ("pair", "edge")


def verdict_with_intervals(
    verdict: Verdict, deviations: DrawnWays | None, facts: dict[str, Any], *, common_clock: bool
) -> Verdict:
    """A verdict with intervals.

    Parameters
    ----------
    verdict : on the likely flight
    deviations : of ways drawn; None: the noise is not known, and nothing with a limit is decided
    facts : what is told of noise, clock, set-up and vehicles
    common_clock : whether all vehicles have one clock
    """
    checks, resets = [], facts.get("resets_s", [])
    for check in verdict.checks:
        name, why = check.check, "" if deviations else "the noise is not told. State it: --noise"
        if name in _UNSEEN or quantity(name).source not in _SEEN:
            continue
        if not common_clock and _is_of_pairs(name):
            why = "vehicles have no common clock"
            check = replace(check, worst=None, first=None)  # noqa: PLW2901
        if deviations and not why and name not in _CERTAIN:
            check = _with_interval(check, deviations.uncertainty_of(check), facts["noise_m"])  # noqa: PLW2901
            check = _leave_open_at_reset(check, resets)  # noqa: PLW2901
        elif why and check.judged and name not in _CERTAIN:
            words = f"{name.replace('_', ' ')} is not judged: {why}"
            check = replace(check, passed=False, undecided=True, message=words)  # noqa: PLW2901
        checks.append(check)
    return replace(verdict, checks=checks, doubt=facts, notes=[*doubt_notes(facts), *verdict.notes])


def _with_interval(check: CheckResult, by: float, sigma: float) -> CheckResult:
    """A check with its interval, decided only if all of the interval is on one side of the limit."""
    worst, limit = check.worst, check.limit
    if worst is None:
        sure = by == 0.0 or check.passed
        words = "" if sure else ": undecided, as vehicles may be where others seem to be"
        return replace(check, undecided=not sure, message=check.message + words)
    at_least = check.at_least or quantity(check.check).at_least
    low, high = worst - by, worst + by
    low = low if at_least or worst < 0.0 else max(low, 0.0)
    words = f"{check.message}; {value(low)} to {value(high, check.unit)}"
    check = replace(check, interval=(low, high), message=words)
    if not check.judged or limit is None:
        return check
    sense = replace(quantity(check.check), sense="least" if at_least else "greatest")
    worse, better = (low, high) if at_least else (high, low)
    if keeps_limit(sense, worse, limit):
        return replace(check, passed=True)
    if not keeps_limit(sense, better, limit):
        return replace(check, passed=False)
    # The interval is then to be shorter than the way to the limit, which another log finds a little nearer.
    # All of what is there may be noise, which then is less, too.
    share = min(abs(worst - limit) / by, limit / high if low == 0.0 else math.inf)
    less = (_SHORTER * share) ** (1.0 / _POWERS[_derivative_order(check)])
    remedy = f"noise of {value(1e3 * sigma * math.sqrt(less))} mm would decide it"
    if less * _TIMES > 1.0:
        remedy += f", or, if it is white, {math.ceil(1.0 / less)} times the rate"
    words = re.sub(" is (missed|met),", " may be missed,", words)
    words = words.replace(" is not reached", " may not be reached")
    return replace(check, passed=False, undecided=True, message=f"{words}: undecided; {remedy}")


def _leave_open_at_reset(check: CheckResult, resets: list[float]) -> CheckResult:
    """A check, undecided if it is missed where an estimator sets its position anew: no vehicle flew that."""
    near = [t for t in resets if check.when is not None and abs(t - check.when) < _RESET]
    if check.passed or check.undecided or not near:
        return check
    words = f"{check.message}: undecided, as an estimator moves its position at {near[0]:.2f} s"
    return replace(check, undecided=True, message=words)


def uncertainty_facts(
    flown: Result, deviations: DrawnWays | None, estimate: NoiseEstimate, alignment: Alignment | None, clock: str
) -> dict[str, Any]:  # fmt: skip
    """What is told of noise, clock, set-up and, beside a plan, of vehicles: how far off their slots, and when."""
    sigma, tau = estimate.noise or (None, None)
    facts: dict[str, Any] = {"noise_m": sigma, "correlation_s": tau, "source": estimate.source}
    facts |= {"remark": estimate.words, "clock": clock}
    if resets := flown.statistics["resets"]:
        facts["resets_s"] = resets
    if alignment is None:
        return facts
    off = np.where(flown.left[..., None], flown.position - flown.slot_position, np.nan)
    mean, far = np.nanmean(off, axis=0), np.nan_to_num(np.linalg.norm(off, axis=2))
    worst, each = far.argmax(axis=0), np.arange(flown.n_agents)
    shifts = np.full((1, 1, *mean.shape), np.nan) if deviations is None else deviations.states[:, 0]
    by = np.linalg.norm(shifts.mean(axis=1), axis=2).max(axis=0)
    size = np.linalg.norm(mean, axis=1)
    places = np.nan_to_num([flown.position, flown.slot_position])[:, :: -(-len(off) // _SAMPLES)]
    p, slots = places.swapaxes(1, 2).reshape(2, len(each), -1)
    order = least_squares_assignment(p, slots)
    if np.sum((p - slots[order]) ** 2) < _NEARER**2 * np.sum((p - slots) ** 2):
        facts["order"] = (order + 1).tolist()
    aside = size - np.nan_to_num(by) > np.maximum(_OFF, 2.0 * np.median(size) * (len(size) > 1))
    columns = {
        "name": flown.statistics["names"], "mean_off_m": size, "mean_error_m": by, "mean_off_xyz_m": mean,
        "worst_off_m": far[worst, each], "worst_at_s": flown.time[worst], "offset_s": alignment.own.T,
        "off_its_slot": aside, "late": alignment.has_own_clock_offset,
    }  # fmt: skip
    rows = zip(*(np.asarray(x).tolist() for x in columns.values()), strict=True)
    vehicles = [dict(zip(columns, row, strict=True)) for row in rows]
    return facts | {"alignment": alignment.to_dict(), "vehicles": vehicles}


def doubt_notes(facts: dict[str, Any]) -> Iterator[str]:
    """What is told of noise, clock, set-up and vehicles, in sentences without a full stop."""
    remark = f": {facts['remark']}" if facts["remark"] else ""
    if facts["noise_m"] is None:
        yield f"the noise is not told{remark}. State it: --noise"
    else:
        tau = facts["correlation_s"]
        kind = f"with a correlation time of {value(tau, 's')}" if tau else "white"
        source = "stated" if facts["source"] == "stated" else "as samples show"
        yield f"the noise of a coordinate is {value(1e3 * facts['noise_m'], 'mm')}, {kind}, {source}{remark}"
    if "alignment" not in facts:
        return
    explained = facts["alignment"]
    applied = _APPLIED[facts["clock"]]
    if facts["clock"] == "own":
        every = [x["offset_s"] for x in facts["vehicles"]]
        own = (_lateness_in_words(*x) if np.isfinite(x[0]) else "?" for x in every)
        yield f"against the plan, clocks of vehicles are {', '.join(own)}; {applied}"
    elif explained["offset_s"] is None:
        yield f"the offset of the clock cannot be told, as the plan hardly moves; {applied}"
    else:
        late = _lateness_in_words(*explained["offset_s"])
        yield f"the log is {late} against the plan; {applied}. Positions alone do not tell a clock from a lag"
    turn, scale = explained["turn_deg"], explained["scale"]
    parts = []
    if turn and abs(turn[0]) > _SURE * turn[1]:
        parts.append(f"turned by {_plus_minus(*turn)} deg about the vertical")
    if scale and abs(scale[0] - 1.0) > _SURE * scale[1]:
        parts.append(f"scaled by {_plus_minus(*scale)}")
    if any(x and abs(x[0]) > max(_SURE * x[1], _OFF) for x in explained["shift_m"]):
        parts.append(f"shifted by ({', '.join(value(x[0]) for x in explained['shift_m'])}) m")
    if parts:
        far, left = (value(explained[key], "m") for key in ("rms_as_logged_m", "rms_explained_m"))
        judged = f"It is judged as flown, {far} off (root mean square)"
        causes = f"against the plan the log is {' and '.join(parts)}"
        yield f"{causes}. {judged}; without clock and set-up, {left} are left"
    if order := facts.get("order"):
        places = enumerate(zip(facts["vehicles"], order, strict=True), 1)
        moved = [
            f"{each['name']} counts as agent {k}, but is where agent {i} is to be"
            for k, (each, i) in places
            if i != k
        ]
        yield f"{first_few(moved)}: the log may have another order"
    for each in facts["vehicles"]:
        if each["off_its_slot"]:
            off, by = 1e3 * each["mean_off_m"], 1e3 * np.nan_to_num(each["mean_error_m"])
            x, y, z = (value(1e3 * x) for x in each["mean_off_xyz_m"])
            peak = f"{value(1e3 * each['worst_off_m'], 'mm')} at {each['worst_at_s']:.2f} s"
            yield f"{each['name']!r} is {_plus_minus(off, by)} mm off its slot on average, ({x}, {y}, {z}), and {peak}"
        if each["late"] and facts["clock"] != "own":  # then all are told at once
            yield f"{each['name']!r} is {_lateness_in_words(*each['offset_s'])} by itself: its clock, or its tracking"


def _lateness_in_words(offset: float, error: float) -> str:
    return f"{_plus_minus(abs(offset), error)} s {'late' if offset >= 0.0 else 'early'}"


def _plus_minus(x: float, error: float) -> str:
    """A value with its error, to the digits that the error has."""
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0.0 else 2
    return f"{x:.{digits}f} +- {error:.{digits}f}"
