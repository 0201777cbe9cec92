"""Gains that are tuned: which, in what range, with what margins, and how they are written into a mission file."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from rigidfleet._common.toml import to_toml, toml_equals_data
from rigidfleet.math import lqr, pid
from rigidfleet.math.margins import Margins, stability_margins
from rigidfleet.mission import Mission
from rigidfleet.mission.files import digest_lines
from rigidfleet.mission.schema import Tracking
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.timing import complete_times
from rigidfleet.planning.vehicles import lags_by_vehicle
from rigidfleet.preflight.margins import ClosedLoops, loops_and_omission, tracking_closed_loops
from rigidfleet.sweep.keypaths import replace_value
from rigidfleet.typing import Floats

#: A gain by its path in the mission, as in a variation.
Gains = dict[str, float]

#: Factors on the mission's own gain between which each is searched. The integral of the constraint law is searched
#: far downwards: it costs phase, and only steady forces need it.
RANGES = {
    "constraint.alpha": (1 / 4, 4.0),
    "constraint.beta": (1 / 3, 3.0),
    "constraint.gamma": (1 / 30, 3.0),
    "tracking.Q.1": (1 / 16, 16.0),
    "tracking.Q.2": (1 / 16, 16.0),
    "tracking.integral": (1 / 8, 8.0),
}
#: Lower gain margin that always suffices: all gains may fall to half, as `check` asks of the upper one.
_HALF = 0.5
#: Number of points that are tried for one of the first population.
_TRIES = 30
#: Relative size of rounding errors of margins.
_ROUNDING = 1e-9
#: Table of the gains of the constraint law.
_LAW = "constraint."
#: Name of the law of all shapes together; that of the tracking is "tracking", as `check` has it.
_CONSTRAINT = "constraint law"


def own_gains(mission: Mission) -> Gains:
    """The gains of a mission that can be tuned: those that act on its flight and are not 0."""
    c, t = mission.constraint, mission.tracking
    own: Gains = {}
    if c.stabilisation == "pid" and len(mission.edges):
        own |= {
            "constraint.alpha": c.alpha, "constraint.beta": c.beta, "constraint.gamma": c.gamma
        }  # fmt: skip
    if any(phase.tracks_slots for phase in mission.phases):
        own |= {"tracking.Q.1": t.Q[0], "tracking.Q.2": t.Q[1], "tracking.integral": t.integral}
    return {path: gain for path, gain in own.items() if gain > 0}


class GainSpace:
    """The box in which gains are searched: one axis for each, from 0 to 1, on a logarithmic scale."""

    def __init__(self, own: Gains) -> None:
        self.own = own
        self.ends = {path: tuple(gain * f for f in RANGES[path]) for path, gain in own.items()}

    def gains_at(self, x: Sequence[float] | Floats) -> Gains:
        """The gains at a point x (D,), to four digits; there, the mission's own are whole."""
        gains = {}
        for u, (path, (low, high)) in zip(x, self.ends.items(), strict=True):
            gain, own = _to_four_digits(low * (high / low) ** u), self.own[path]
            gains[path] = own if gain == _to_four_digits(own) else gain
        return gains

    @property
    def mission_point(self) -> Floats:
        """The point (D,) of the mission's own gains."""
        return np.array(
            [math.log(self.own[p] / a) / math.log(b / a) for p, (a, b) in self.ends.items()]
        )


def _to_four_digits(gain: float) -> float:
    return float(f"{gain:.4g}")


class Screen:
    """Margins of the laws of a mission with other gains, to refuse gains before they fly.

    Attributes
    ----------
    own : margins of the mission's own gains, by law; empty for points, which bear any gain
    """

    def __init__(self, mission: Mission, share: float) -> None:
        mission = complete_times(mission)
        self.mission, self.share = mission, share
        self.gains = own_gains(mission)
        lags = lags_by_vehicle(mission)
        laws: list[ClosedLoops] = []
        if lags:
            tracking = tracking_closed_loops(mission, lags)
            looped, _ = loops_and_omission(mission, preview_phases(mission)[0], lags)
            laws = [*filter(None, [tracking]), *(x._replace(where=_CONSTRAINT) for x in looped)]
        self.parts = _distinct_loop_parts(laws)
        self.own = self.margins_by_law(self.gains)

    def margins_by_law(self, gains: Gains) -> dict[str, Margins]:
        """The smallest margins of each law with some gains."""
        smallest: dict[str, Margins] = {}
        for name, m in self._margins_of_parts(gains):
            smallest[name] = smallest[name].smaller_margins(m) if name in smallest else m
        return smallest

    def margin_slack(self, gains: Gains) -> float:
        """By how much the margins exceed what is asked, as a share of the mission's own; negative if they are worse."""
        c = {key: gains.get(f"constraint.{key}", 0.0) for key in ("alpha", "beta", "gamma")}
        if "constraint.alpha" in self.gains and not pid.is_stable(**c):
            return -1.0
        least = math.inf
        for name, m in self._margins_of_parts(gains):
            if not m.stable:
                return -1.0
            least = min(least, _margin_ratio(m, self.own[name]) - self.share * (1 - _ROUNDING))
            if least < 0:
                break
        return min(least, 1.0)

    def _margins_of_parts(self, gains: Gains) -> Iterator[tuple[str, Margins]]:
        """Margins of all parts, with the name of the law of each."""
        t = self.mission.tracking
        Q = [gains.get(f"tracking.Q.{k}", own) for k, own in enumerate(t.Q, start=1)]
        k1, k2 = lqr.double_integrator_gains(Q, t.R)
        new = {"k1": k1, "k2": k2, "ki": gains.get("tracking.integral", t.integral)}
        new |= {k.removeprefix(_LAW): x for k, x in gains.items() if k.startswith(_LAW)}
        for law, loops, own, growth in self.parts:
            yield law, stability_margins(loops, replace(own, **new), growth)


def _distinct_loop_parts(laws: Sequence[ClosedLoops]) -> list[ClosedLoops]:
    """The distinct parts of all loops: most shapes have the same, and what decays on the longest way counts."""
    parts: dict[object, ClosedLoops] = {}
    for looped in laws:
        for loop in looped.loops:
            rounded = ((np.round(x, 9) + 0.0).tobytes() for x in (loop.S, loop.Q, loop.P))
            key = (looped.where, *rounded, loop.channels, looped.law)
            if key not in parts or looped.growth < parts[key].growth:
                parts[key] = looped._replace(loops=[loop])
    return sorted(parts.values(), key=lambda part: part.loops[0].S.size)  # the quick ones first


def _margin_ratio(now: Margins, was: Margins) -> float:
    """The least ratio of margins to those that were, at most 1; 1 if that was unstable."""
    if not was.stable:
        return 1.0
    low = max(was.gain[0], _HALF)
    pairs = (now.phase, was.phase), (now.delay, was.delay), (now.gain[1], was.gain[1])
    ratios = [1.0 if a >= b else a / b for a, b in pairs]
    return min(*ratios, 1.0 if now.gain[0] <= low else low / now.gain[0])


def feasible_points(
    space: GainSpace, slack: Callable[[Gains], float], count: int, rng: np.random.Generator
) -> Floats:
    """Points (count, D) whose gains are not refused: the mission's own, and random ones.

    Where margins refuse `_TRIES` points in a row, the next one is drawn towards the mission's own gains.
    """
    start = space.mission_point
    points = [start]
    while len(points) < count:
        for _ in range(_TRIES):
            x = rng.random(len(start))
            if slack(space.gains_at(x)) >= 0:
                break
        while slack(space.gains_at(x)) < 0 and np.abs(x - start).max() > 1e-3:
            x = start + 0.7 * (x - start)
        points.append(x)
    return np.array(points)


# -- in a file ---------------------------------------------------------------------------------------


def with_gains(text: str, gains: Gains) -> str:
    """The text of a mission with other gains; the rest, comments included, stays where the text allows it."""
    end = "\r\n" if text.count("\r\n") == text.count("\n") > 0 else "\n"
    wanted, new = tomllib.loads(text), text.replace(end, "\n")
    whole = {"tracking": {"Q": [*Tracking.model_fields["Q"].get_default()]}}
    for path, gain in gains.items():
        table, key, *place = path.split(".")
        keys = (table, key, *(int(k) - 1 for k in place))
        replace_value(wanted, whole, keys, lambda _, gain=gain: gain)
        new = _replace_line(new, table, key, to_toml({key: wanted[table][key]}).strip())
    new = new if toml_equals_data(new, wanted) else digest_lines(text) + to_toml(wanted)
    return new.replace("\n", end)


def _replace_line(text: str, table: str, key: str, line: str) -> str:
    """The text with ``line`` in place of a key's, or below the last key of its table, or in a new table at the end."""
    text = text if text.endswith("\n") else f"{text}\n"
    lines = re.search(rf"(?m)^[ \t]*\[\s*{table}\s*\].*(?:\n(?!\s*\[).*)*", text)
    if lines is None:
        return f"{text}\n[{table}]\n{line}\n"
    entry = rf"(?m)^([ \t]*){key}\s*=[^#\n]*?([ \t\r]*(?:#.*)?)$"
    new, changed = re.subn(entry, lambda m: f"{m[1]}{line}{m[2]}", lines[0], count=1)
    if not changed:  # below the last line that is no comment
        new = re.sub(r"\A(?s:.*\n)?[ \t]*[^#\s].*", lambda m: f"{m[0]}\n{line}", new, count=1)
    return text[: lines.start()] + new + text[lines.end() :]
