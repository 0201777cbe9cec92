"""The first page, for those who decide: what is planned, proved and rehearsed, where things fall, and versions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from hashlib import sha256
from typing import TYPE_CHECKING

import numpy as np

from rigidfleet._common.facts import value
from rigidfleet._common.text import agent_names, all_hold
from rigidfleet.assessment import Verdict
from rigidfleet.plotting import areas, encode_figure
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from rigidfleet.result import Result

#: Checks about fences and people.
_AREAS = "fence", "soft_fence", "people"


def rows(
    result: Result,
    verdict: Verdict,
    falls: Floats,
    rehearsed: Sequence[str] = (),
    abort: Sequence[str] = (),
) -> list[tuple[str, list[str]]]:
    """Headings, each with its sentences.

    Parameters
    ----------
    falls : where vehicles fall (K, N, 2) [m], by `areas.falls_of`
    rehearsed : what drills have shown, in sentences
    abort : how the flight is aborted
    """
    beside = [f"{check.message}." for check in verdict.checks if check.check in _AREAS]
    beside = [x[0].upper() + x[1:] for x in beside]
    return [
        ("Planned", _plan(result)),
        ("Proved", _proofs(result, verdict)),
        ("Rehearsed", [*rehearsed] or ["No drill belongs to this report."]),
        ("Aborted", [*abort] or ["No way home belongs to this report."]),
        ("Fences and people", beside or ["The mission has neither."]),
        ("Where things fall", _falls(result, falls)),
        ("Versions and digests", _digests(result)),
    ]


def _plan(result: Result) -> list[str]:
    n, z = result.n_agents, result.position[..., 2]
    lasting = value(float(result.time[-1] - result.time[0]), "s")
    vehicles = "One vehicle flies" if n == 1 else f"{n:,} vehicles fly"
    names = list(dict.fromkeys(phase.name for phase in result.phases))
    what = f": {', '.join(names)}" if result.interpolation is None else ", as others planned it"
    fastest = result.extreme("speed")
    ends = f"They reach up to {value(float(np.nanmax(z)), 'm')}"
    ends += "" if fastest is None else f" and {value(fastest.value, 'm/s')}"
    return [f"{vehicles} for {lasting}{what}.", f"{ends}."]


def _proofs(result: Result, verdict: Verdict) -> list[str]:
    """The least of the plan's certificates, and how many checks of the flight hold, at all times."""
    proofs = [phase.planned for phase in result.phases if phase.planned is not None]
    lines = []
    if proofs:
        least = min(proofs, key=lambda x: x["separation"])
        who = agent_names(sorted(least["agents"]))
        lines.append(
            f"The plan keeps {value(least['separation'], 'm')} between surfaces, proved for {len(proofs)} of"
            f" {len(result.phases)} phases; {who} come nearest, at {least['time']:.2f} s."
        )
    judged = [check for check in verdict.checks if check.judged]
    failed = sum(not check.passed for check in judged)
    words = f"{failed} of {len(judged)} checks fail" if failed else all_hold(len(judged))
    known = sum(not check.at_samples for check in judged)
    how = "all of them" if known == len(judged) else f"{known} of them"
    words = f"{words[0].upper()}{words[1:]}; {how} are judged at all times, not at samples alone."
    return [*lines, words]


def _falls(result: Result, falls: Floats) -> list[str]:
    """How far vehicles that fail are carried, at samples."""
    mission = result.mission
    if not np.isfinite(falls).any():
        return ["Without gravity, nothing falls."]
    off = np.linalg.norm(falls - result.position[..., :2], axis=2)
    off = np.where(np.isfinite(off) & result.left, off, -1.0)
    k, i = np.unravel_index(int(off.argmax()), off.shape)
    d = mission.disturbances
    wind = 0.0 if d is None else math.hypot(*d.wind[:2])
    air = f"in wind of {value(wind, 'm/s')}" if wind else "in still air"
    drag = "with the mission's drag" if mission.drag.any() else "without drag"
    low, high = np.nanmin(falls, axis=(0, 1)), np.nanmax(falls, axis=(0, 1))
    return [
        f"A vehicle that fails falls {air}, {drag}, at most {value(float(off[k, i]), 'm')} sideways: agent {i + 1} at"
        f" {result.time[k]:.2f} s.",
        f"All falls end between x = {low[0]:.1f} and {high[0]:.1f} m, y = {low[1]:.1f} and {high[1]:.1f} m.",
    ]


def _digests(result: Result) -> list[str]:
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items())
    about = result.mission.about.replace("# ", "").splitlines()
    digest = sha256(result.mission_text.encode()).hexdigest()
    states = sha256(np.ascontiguousarray(result.position).tobytes()).hexdigest()
    return [
        f"{versions}; made {result.created.replace('T', ' ').replace('+00:00', ' UTC')}.",
        f"Mission file, SHA-256 {digest}",
        f"Positions flown, SHA-256 {states}",
        *about,
    ]


def sketch(result: Result, falls: Floats) -> bytes:
    """The ground from above with fences, people, and where vehicles fly and fall, as an SVG."""
    return encode_figure(areas.sketch(result, falls), ["svg"])["svg"]
