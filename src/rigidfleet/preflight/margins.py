"""Check what lag and delay the laws bear, at every shape and attitude that the mission plans."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from rigidfleet.math import lqr
from rigidfleet.math.margins import (
    Feedback,
    Lag,
    Loop,
    Margins,
    formation_loops,
    largest_pole,
    margins,
    tracking_loops,
)
from rigidfleet.mission import Mission, Phase
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.preflight.findings import FormationMargins, MarginsCheck, Preflight, Remark
from rigidfleet.typing import Floats

#: Number of shapes and attitudes that are taken of a phase, both ends included.
SHAPES = 9
#: Margins below which a remark is made: 30 degrees and a factor of 2, as is usual in the design of control loops.
_PHASE, _GAIN = math.radians(30.0), 2.0
#: Maximum work on margins: sum of the cubes of the sizes of loops; a hundred thousand take a minute.
_WORK = 20_000


def check_margins(
    mission: Mission, way: Sequence[PlannedPhase], lags: Sequence[Lag]
) -> MarginsCheck:
    """Margins of the tracking, and of all loops of each formation and of the ways between them.

    Parameters
    ----------
    way : the planned phases
    lags : of each vehicle
    """
    tracked = any(phase.control == "tracking" for phase in mission.phases)
    tracking = margins(tracking_loops(lags), _feedback(mission, None, "")) if tracked else None
    found: dict[str, FormationMargins] = {}
    seen: set[tuple[object, ...]] = set()
    work, skipped = 0, False
    for phase, planned in zip(mission.phases, way, strict=False):
        where = _where(planned)
        name = planned.shapes[1]
        if name is None or not len(mission.formation_edges(name)):
            continue
        law = _feedback(mission, phase, name if where == f"'{name}'" else None)
        for r in _shapes(planned, phase):
            key = (where, law, *_seen_from_above(r))
            if key in seen:
                continue
            seen.add(key)
            loops = formation_loops(
                r, mission.formation_edges(name), mission.agents.mass, law, lags
            )
            work += sum(len(loop.S[0]) ** 3 for loop in loops)
            if work > _WORK and found:
                skipped = True
                break
            found[where] = _worse(found.get(where), loops, law)
    return MarginsCheck(tracking, found, skipped)


def _feedback(mission: Mission, phase: Phase | None, held: str | None) -> Feedback:
    """The laws of a phase; ``held`` is the formation in which it begins, None if the shape changes."""
    c = mission.constraint
    k1, k2 = lqr.double_integrator_gains(mission.tracking.Q, mission.tracking.R)
    on = float(c.stabilisation == "pid")
    return Feedback(
        alpha=on * c.alpha,
        beta=on * c.beta,
        gamma=on * c.gamma,
        k1=k1,
        k2=k2,
        control="tracking" if phase is None else phase.control,
        k_def=c.deformation_damping,
        solver=c.solver,
        damping=mission.damping(held or None),
        iterations=c.iterations,
        threshold=c.threshold,
        cutoff=c.cutoff,
    )


def _where(planned: PlannedPhase) -> str:
    before, after = planned.shapes
    if planned.ways is None or before == after:
        return f"'{after}'"
    return f"on the way to '{after}'" if before is None else f"'{before}' to '{after}'"


def _shapes(planned: PlannedPhase, phase: Phase) -> Floats:
    """Positions (SHAPES, N, 3) [m], evenly over the change of shape, or over the phase."""
    shaping = phase.shaping
    t, span = planned.time, planned.time[-1] - planned.time[0]
    if shaping is not None:
        span = min(span, shaping.blend)
    at = np.searchsorted(t, t[0] + span * np.linspace(0.0, 1.0, SHAPES))
    return planned.position[np.minimum(at, len(t) - 1)]


def _seen_from_above(r: Floats) -> tuple[bytes, bytes]:
    """What the loop depends on: all but place and heading, to a millimetre or so."""
    x = r - r.mean(axis=0)
    across = x[:, :2] @ x[:, :2].T
    size = max(float(np.abs(x).max()), 1e-9)
    rounded = (
        np.round(part / scale, 3) + 0.0 for part, scale in ((across, size**2), (x[:, 2], size))
    )
    first, second = (part.tobytes() for part in rounded)
    return first, second


def _worse(
    known: FormationMargins | None, loops: Sequence[Loop], law: Feedback
) -> FormationMargins:
    """The smaller margins of those ``known`` and those of a further shape."""
    now = margins(loops, law)
    constrained = [loop for loop in loops if loop.constrained]
    most = math.inf if known is None else known.largest_pole
    pole = largest_pole(constrained, law, most) if constrained else most
    if known is None:
        return FormationMargins(now, pole)
    was = known.margins
    if not (was.stable and now.stable):
        return FormationMargins(Margins(stable=False), pole)
    low, high = max(was.gain[0], now.gain[0]), min(was.gain[1], now.gain[1])
    worst = Margins(True, (low, high), min(was.phase, now.phase), min(was.delay, now.delay))
    return FormationMargins(worst, pole)


def margin_remarks(found: Preflight) -> Iterator[Remark]:
    """Remarks on loops that lag and delay make unstable, or that have small margins."""
    if found.margins is None:
        return
    tracking = found.margins.tracking
    if tracking is not None:
        yield from _judged("tracking of slots", tracking, "lower tracking.Q")
    if tracking is None or tracking.stable:
        for where, f in found.margins.formations.items():
            remedy = (
                f"a triple pole of the constraint law may be as fast as p = {f.largest_pole:.3g} /s"
            )
            if f.largest_pole == 0:
                remedy = "no triple pole of the constraint law is stable"
            yield from _judged(f"constraint law {_at(where)}", f.margins, remedy)
    if found.margins.skipped:
        yield Remark("note", "margins", "to limit the time of the check, some shapes are left out")


def _at(where: str) -> str:
    return where if where.startswith("on ") else f"at {where}"


def _judged(what: str, m: Margins, remedy: str) -> Iterator[Remark]:
    if not m.stable:
        yield Remark(
            "fails", "margins", f"{what}: unstable with the vehicles' lag and delay; {remedy}"
        )
    elif m.phase < _PHASE or m.gain[1] < _GAIN or m.gain[0] > 1 / _GAIN:
        text = (
            f"{what}: phase margin {math.degrees(m.phase):.0f} deg, gain margin"
            f" {min(m.gain[1], 1 / max(m.gain[0], 1e-12)):.2g}; below 30 deg or 2, errors ring; {remedy}"
        )
        yield Remark("note", "margins", text)
