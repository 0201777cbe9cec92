"""The first page, for those who decide: what is planned, proved and rehearsed, where things fall, and versions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from hashlib import sha256

import numpy as np

from rigidfleet._common.facts import value
from rigidfleet._common.text import agent_names
from rigidfleet.assessment import Verdict
from rigidfleet.result import Result
from rigidfleet.typing import Floats

#: Checks about fences and people.
_AREAS = "fence", "soft_fence", "people"


def brief_rows(
    result: Result, verdict: Verdict, falls: Floats, rehearsed: Sequence[str] = (), abort: Sequence[str] = ()
) -> list[tuple[str, Sequence[str]]]:  # fmt: skip
    """Headings, each with its sentences.

    Parameters
    ----------
    falls : where vehicles fall (K, N, 2) [m], by `areas.fall_places_by_sample`
    rehearsed : what drills have shown, in sentences
    abort : how the flight is aborted
    """
    beside = [
        f"{x.message[0].upper()}{x.message[1:]}." for x in verdict.checks if x.check in _AREAS
    ]
    return [
        ("Planned", plan_sentences(result)),
        ("Proved", _proof_sentences(result, verdict)),
        ("Rehearsed", rehearsed or ["No drill belongs to this report."]),
        ("Aborted", abort or ["No way home belongs to this report."]),
        ("Fences and people", beside or ["The mission has neither."]),
        ("Where things fall", _fall_reach_sentences(result, falls)),
        ("Versions and digests", provenance_sentences(result)),
    ]


def plan_sentences(result: Result) -> list[str]:
    """What flies, for how long, and how far and fast."""
    mission, mass = result.mission, sorted({*result.mission.agents.mass})
    lasting = value(float(result.time[-1] - result.time[0]), "s")
    count = Counter(mission.vehicles[name].model for name in mission.agents.vehicle)
    what = ", ".join(f"{n} × {name}" for name, n in count.items())
    what += f"{', ' if count else 'Mass '}{mass[0]:.4g}{f' to {mass[-1]:.4g}' * (len(mass) > 1)} kg"
    phases = ", ".join(dict.fromkeys(phase.name for phase in result.phases))
    made_by_others = result.interpolation is not None
    how = f", as others planned it: {result.interpolation}" if made_by_others else f": {phases}"
    edges = {name: len(mission.formation_edges(name)) for name in mission.formations}
    held = ", ".join(f"{name} ({n} edge{'s' * (n != 1)})" for name, n in edges.items() if n)
    fastest = result.extreme("speed")
    ends = "" if made_by_others else f"{what}. "
    ends += f"Greatest height {value(float(np.nanmax(result.position[..., 2])), 'm')}"
    ends += "" if fastest is None else f", greatest speed {value(fastest.value, 'm/s')}"
    ends += f". Distances are held in {held}" * bool(held)
    number = "One vehicle flies" if result.n_agents == 1 else f"{result.n_agents:,} vehicles fly"
    return [f"{number} for {lasting}{how}.", f"{ends}."]


def _proof_sentences(result: Result, verdict: Verdict) -> list[str]:
    """The least of the plan's certificates, and how many checks of the flight are judged at all times."""
    judged = [check.at_samples for check in verdict.checks if check.judged]
    known = f"{judged.count(False)} of {len(judged)} checks are judged at all times, not at samples alone."
    proofs = [phase.planned for phase in result.phases if phase.planned is not None]
    if not proofs:
        return [known]
    least = min(proofs, key=lambda x: x["separation"])
    return [
        f"The plan keeps {value(least['separation'], 'm')} between surfaces, proved for {len(proofs)} of"
        f" {len(result.phases)} phases; {agent_names(sorted(least['agents']))} come nearest, at {least['time']:.2f} s.",
        known,
    ]


def _fall_reach_sentences(result: Result, falls: Floats) -> list[str]:
    """How far vehicles that fail are carried, at samples."""
    mission = result.mission
    if not np.isfinite(falls).any():
        return ["Without gravity, nothing falls."]
    off = np.linalg.norm(falls - result.position[..., :2], axis=2)
    off = np.where(np.isfinite(off) & result.left, off, -1.0)
    k, i = np.unravel_index(int(off.argmax()), off.shape)
    wind = math.hypot(*mission.all_disturbances.wind[:2])
    air = f"in wind of {value(wind, 'm/s')}" if wind else "in still air"
    drag = "with the mission's drag" if mission.drag.any() else "without drag"
    low, high = np.nanmin(falls, axis=(0, 1)), np.nanmax(falls, axis=(0, 1))
    return [
        f"A vehicle that fails falls {air}, {drag}, at most {value(float(off[k, i]), 'm')} sideways: agent {i + 1} at"
        f" {result.time[k]:.2f} s.",
        f"All falls end between x = {low[0]:.1f} and {high[0]:.1f} m, y = {low[1]:.1f} and {high[1]:.1f} m.",
    ]


def provenance_sentences(result: Result) -> list[str]:
    """Versions, what the flight took to compute, and digests of its mission, of files and of what was flown."""
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items())
    states = sha256(np.ascontiguousarray(result.position).tobytes()).hexdigest()
    known, steps = result.statistics, ""
    if {"steps", "rtol", "atol"} <= known.keys():
        steps = f", in {known['steps']:,} steps at tolerances of {known['rtol']:g} and {known['atol']:g}"
    return [
        f"{versions}, on {result.platform}; made {result.created[:19].replace('T', ' ')} UTC{steps}.",
        f"Mission file, SHA-256 {result.mission.digest}",
        f"Positions flown, SHA-256 {states}",
        *result.mission.file_digests_text.replace("# ", "").splitlines(),
    ]
