"""Check the gains of the constraint law: stability, settling time and forces."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from rigidfleet.math import pid
from rigidfleet.mission import Mission
from rigidfleet.planning.legs import phase_spans
from rigidfleet.preflight.findings import FormationCheck, GainsCheck, Preflight, Remark


def check_pid_gains(mission: Mission, formations: list[FormationCheck]) -> GainsCheck:
    """Stability, settling time and overshoot of the constraint law, and its force per error of a distance."""
    c = mission.constraint
    stabilised, settling = c.stabilisation == "pid", c.settling_time
    over = None if settling is None else pid.overshoot(c.alpha, c.beta, c.gamma)
    mass, stiffness = float(np.mean(mission.agents.mass)), c.beta**2 * stabilised
    force = {
        f.name: f.rigidity.constraint_force_bound(stiffness, mass)
        for f in formations
        if f.rigidity is not None and f.rigidity.rank
    }
    margin = 2 * c.alpha * c.beta**2 / c.gamma if stabilised and c.gamma > 0 else math.inf
    return GainsCheck(stabilised, margin, settling, over, force)


def gain_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on missing or slow feedback, if distances guide the agents."""
    g, phases = preflight.gains, mission.phases
    if all(phase.tracks_slots for phase in phases) or not len(mission.edges):
        return
    if not g.stabilised:
        yield from _no_feedback_remarks(mission)
    elif g.settling_time_s is None:
        yield Remark(
            "note", "gains", "errors oscillate for more than a thousand cycles: raise alpha"
        )
    elif g.settling_time_s > max(b - a for a, b in phase_spans(mission)):
        text = f"errors of edges need {g.settling_time_s:.3g} s to settle, longer than any phase"
        yield Remark("note", "gains", text)


def _no_feedback_remarks(mission: Mission) -> Iterator[Remark]:
    """Remark that without feedback an error of a distance grows at its initial rate."""
    text = "there is no feedback (stabilisation = 'none'): errors of distances remain and grow at their initial rate"
    first = mission.phases[0].establishing
    if first is None or first.tracks_slots:
        yield Remark("note", "gains", text)
        return
    r, v = mission.fleet.position, mission.fleet.velocity
    d = mission.formation_distances(first.formation)
    i, j = mission.formation_edges(first.formation).T
    x = r[i] - r[j]
    L = np.linalg.norm(x, axis=1)
    c_dot = ((v[i] - v[j]) * x).sum(axis=1) / L
    end = phase_spans(mission)[0][1]
    error = L - d + c_dot * end if first.reference == "step" else c_dot * first.least_time / 2
    worst = np.abs(error).max(initial=0.0)
    fails = worst > mission.formations[first.formation].greatest_error(d.min(initial=np.inf))
    text += f"; by {end:g} s they reach {worst:.2g} m"
    yield Remark("fails" if fails else "note", "gains", text)
