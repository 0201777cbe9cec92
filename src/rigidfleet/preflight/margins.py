"""Check what lag and delay the laws bear, at every shape and attitude that the mission plans."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rigidfleet.math.margins import (
    GROWTH,
    Lag,
    Loop,
    LoopGains,
    Margins,
    distinct_formation_loops,
    largest_stable_pole,
    stability_margins,
    tracking_loops,
)
from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.kinds import seconds
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.preflight.findings import FormationMargins, MarginsCheck, Preflight, Remark
from rigidfleet.typing import Floats

#: Number of shapes and attitudes that are taken of a phase, both ends included.
_SHAPES = 7
#: Margins below which a remark is made: 30 degrees and a factor of 2, as is usual in the design of control loops.
_PHASE, _GAIN = math.radians(30.0), 2.0
#: Maximum work on margins: sum of the cubes of the sizes of loops, some seconds.
_WORK = 20_000
#: Margins of nothing.
_UNBOUNDED = FormationMargins(Margins(True, (0.0, math.inf), math.pi, math.inf), math.inf)


def check_margins(
    mission: Mission, way: Sequence[PlannedPhase], lags: Sequence[Lag]
) -> MarginsCheck:
    """Margins of the tracking, and of all loops of each formation and of the ways between them.

    Parameters
    ----------
    way : the planned phases
    lags : of each vehicle
    """
    tracking = tracking_closed_loops(mission, lags)
    laws, skipped = loops_and_omission(mission, way, lags)
    by_place: dict[str, FormationMargins] = {}
    for where, loops, law, growth in laws:
        known, pole = by_place.get(where, _UNBOUNDED)
        now = known.smaller_margins(stability_margins(loops, law, growth))
        if constrained := [loop for loop in loops if loop.has_constraint_law]:
            pole = largest_stable_pole(constrained, law, pole, growth)
        by_place[where] = FormationMargins(now, pole)
    alone = None if tracking is None else stability_margins(tracking.loops, tracking.law)
    return MarginsCheck(alone, by_place, skipped)


class ClosedLoops(NamedTuple):
    """Loops of one shape, or of single vehicles, and the law that closes them.

    Attributes
    ----------
    where : the formation, or the way between two, in words
    loops : their distinct parts
    law : with the gains of the mission
    growth : rate [1/s] from which a motion counts as unstable
    """

    where: str
    loops: list[Loop]
    law: LoopGains
    growth: float


def tracking_closed_loops(mission: Mission, lags: Sequence[Lag]) -> ClosedLoops | None:
    """The tracking of single vehicles; None if no phase tracks slots."""
    if not any(phase.tracks_slots for phase in mission.phases):
        return None
    return ClosedLoops("tracking", tracking_loops(lags), phase_gains(mission, None, None), GROWTH)


def loops_and_omission(
    mission: Mission, way: Sequence[PlannedPhase], lags: Sequence[Lag]
) -> tuple[list[ClosedLoops], bool]:
    """The loops of each formation and of the ways between them, and whether some were left out to limit the work."""
    laws: list[ClosedLoops] = []
    seen: set[tuple[object, ...]] = set()
    work, skipped = 0, False
    pairs = list(zip(mission.phases, way, strict=False))
    for phase, planned in sorted(pairs, key=lambda pair: _changes_shape(pair[1])):  # ways come last
        name = planned.leg.formation
        if name is None or not len(edges := mission.formation_edges(name)):
            continue
        law = phase_gains(mission, phase, None if _changes_shape(planned) else name)
        # On a way that ends, slow growth does no harm: weak shapes pass.
        growth = 1.0 / np.ptp(planned.time) if _changes_shape(planned) else GROWTH
        for r in _sampled_shapes(planned, phase):
            key = (_formations_in_words(planned), law, _shape_key(r))
            if key in seen:
                continue
            seen.add(key)
            loops = distinct_formation_loops(r, edges, mission.agents.mass, law, lags)
            size = sum(len(loop.S) ** 3 for loop in loops)
            if work + size > _WORK and laws:
                skipped = True
                continue
            work += size
            laws.append(ClosedLoops(_formations_in_words(planned), loops, law, growth))
    return laws, skipped


def phase_gains(mission: Mission, phase: Phase | None, held: str | None) -> LoopGains:
    """The laws of a phase; ``held`` is the formation in which it begins, None if the shape changes."""
    c = mission.constraint
    k1, k2 = mission.tracking_gains
    on = float(c.stabilisation == "pid")
    law = {key: getattr(c, key) for key in ("solver", "iterations", "threshold", "cutoff")}
    law |= {key: on * getattr(c, key) for key in ("alpha", "beta", "gamma")}
    return LoopGains(
        **law, k1=k1, k2=k2, ki=mission.tracking.integral, k_def=c.deformation_damping,
        control="tracking" if phase is None or phase.tracks_slots else phase.control, damping=mission.damping(held),
    )  # fmt: skip


def _changes_shape(planned: PlannedPhase) -> bool:
    leg = planned.leg
    return planned.path_ends is not None and leg.before.formation != leg.formation


def _formations_in_words(planned: PlannedPhase) -> str:
    before, after = planned.leg.before.formation, planned.leg.formation
    if not _changes_shape(planned):
        return f"'{after}'"
    return f"on the way to '{after}'" if before is None else f"'{before}' to '{after}'"


def _sampled_shapes(planned: PlannedPhase, phase: Phase) -> Floats:
    """Positions (_SHAPES, N, 3) [m], evenly over the change of shape, or over the phase."""
    shaping = phase.shaping
    t, span = planned.time, planned.time[-1] - planned.time[0]
    if shaping is not None:
        span = min(span, seconds(shaping.blend))
    at = np.searchsorted(t, t[0] + span * np.linspace(0.0, 1.0, _SHAPES))
    return planned.position[np.minimum(at, len(t) - 1)]


def _shape_key(r: Floats) -> bytes:
    """What the loop depends on: all but place and heading, to a millimetre or so."""
    x = r - r.mean(axis=0)
    across = x[:, :2] @ x[:, :2].T
    size = max(float(np.linalg.norm(x, axis=1).max()), 1e-9)
    return (np.round([*across / size**2, x[:, 2] / size], 3) + 0.0).tobytes()


def loop_remarks(preflight: Preflight) -> Iterator[Remark]:
    """Remarks on loops that lag and delay make unstable, or that have small margins."""
    if preflight.margins is None:
        return
    tracking, formations = preflight.margins.tracking, preflight.margins.formations
    if tracking is not None and _has_small_margins(tracking):
        yield _margin_remark("tracking", tracking, "lower tracking.Q")
    # Where the tracking alone is unstable, no constraint law is to blame.
    bad = {where: f for where, f in formations.items() if _has_small_margins(f.margins)}
    if bad and (tracking is None or tracking.stable):
        worst = min(bad.values(), key=lambda f: (f.margins.stable, f.margins.phase))
        if preflight.gains.stabilised:
            pole = min(f.largest_pole for f in bad.values())
            remedy = f"a triple pole of the constraint law is stable up to p = {pole:.3g} /s"
        else:
            remedy = "lower the gains"
        yield _margin_remark(f"constraint law ({', '.join(bad)})", worst.margins, remedy)
    if preflight.margins.skipped:
        text = "to limit the time of the check, margins leave some shapes out"
        yield Remark("note", "margins", text)


def _has_small_margins(m: Margins) -> bool:
    return not m.stable or m.phase < _PHASE or m.gain[1] < _GAIN


def _margin_remark(what: str, m: Margins, remedy: str) -> Remark:
    if not m.stable:
        text = f"{what}: unstable with the vehicles' lag and delay; {remedy}"
        return Remark("fails", "margins", text)
    text = (
        f"{what}: phase margin {math.degrees(m.phase):.0f} deg, gain margin {m.gain[1]:.2g}; below 30 deg or a"
        f" factor of 2, errors ring; {remedy}"
    )
    return Remark("note", "margins", text)
