"""Flights that others made, as results: judged, drawn, replayed and exported like one's own.

A trajectory is a piecewise polynomial for each vehicle. Its extremes are those of the curve, in continuous time, by the
same monitor that watches our own flights; what was recorded elsewhere is not read. The monitor takes curves of fourth
degree: pieces of a higher one are cut so short that they are within a micrometre of such a curve.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.errors import ResultError
from rigidfleet.foreign.samples import ASSUMED
from rigidfleet.kernel import records
from rigidfleet.kernel.problem import workspace
from rigidfleet.math import proximity, series
from rigidfleet.math.bernstein import SIZES, greatest
from rigidfleet.math.piecewise import Piecewise, common_knots, join
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.plan import plan_phase
from rigidfleet.planning.reference import PhaseState
from rigidfleet.result import Extremum, PhaseRecord, Result
from rigidfleet.setpoints import intervals
from rigidfleet.simulation.extremes import Extremes
from rigidfleet.typing import Floats

#: Greatest distance [m] of a curve of fourth degree from the piece that it stands for, and most parts of a piece.
_CLOSE, _PARTS = 1e-6, 256
#: Greatest jump of a position between two pieces [m]; a larger one is no flight.
_JUMP = 1e-3
#: Numbers of a result, and of a part of the pieces that is processed together.
_MOST, _TOGETHER = 5e8, 4_000_000
#: Time between samples [s], unless the trajectory itself has more; about so many in all.
_STEP, _SAMPLES = 0.05, 2_000_000
#: Where a start is moved to zero: a time of a clock, not of a flight [s].
_CLOCK = 1e5
NAMES = {
    1: ASSUMED["linear"],
    3: "cubics",
    5: "quintics",
    7: "polynomials of degree 7",
}
#: Limits of a mission that positions over time do not show.
UNJUDGED = ("jerk", "tilt_deg", "saturation", "tracking_error", "separation_allowance")
#: Name of the only phase.
PHASE = "flight"


def trajectories(
    time: ArrayLike,
    position: ArrayLike,
    *,
    velocity: ArrayLike | None = None,
    acceleration: ArrayLike | None = None,
    jerk: ArrayLike | None = None,
    yaw: ArrayLike | None = None,
    cubic: bool = False,
    mission: Mission | str | Path | None = None,
    separation: float | None = None,
    limits: Mapping[str, float] | None = None,
    radius: float = 0.0,
    ground: float | None = None,
    name: str = "trajectories",
) -> Result:
    """A flight that others made, from samples: a result that is judged, drawn, replayed and exported like any.

    Between samples, vehicles move on polynomials that meet all that is given: straight lines through positions, cubics
    through velocities, too, quintics through accelerations, and degree 7 through jerks. The verdict says so, and
    "passed" covers this curve.

    >>> import numpy as np
    >>> import rigidfleet as rf
    >>> t = np.linspace(0, 10, 101)
    >>> x = np.stack([t, 0 * t, 2 + 0 * t], axis=1)
    >>> flight = rf.trajectories(t, np.stack([x, x + [0, 1, 0]], axis=1), separation=0.9)
    >>> rf.assess(flight).passed
    True

    Parameters
    ----------
    time : (K,) [s], increasing
    position : (K, N, 3) [m], world axes (z up)
    velocity, acceleration, jerk : (K, N, 3); each needs those before
    yaw : (K, N) [rad], on lines; full turns between two samples do not count
    cubic : without velocities, cubic splines with continuous acceleration (`scipy.interpolate.CubicSpline`) instead of
        lines
    mission : a mission, its name or path: the radii and masses of its vehicles, its limits and obstacles count, instead
        of what follows
    separation : least distance of centres, less their radii [m]
    limits : further keys of `[limits]`
    radius : of every vehicle [m]; 0: separation is centre to centre
    ground : height of the ground [m]; None: there is none
    name : of the result

    Raises
    ------
    ResultError
        The arrays are no trajectories: a wrong shape, values that are not finite, times that do not increase.
    MissionError
        A limit is invalid.
    """
    t = _checked("time", time, 1)
    states = [_checked("position", position, 3)]
    lacks = ""
    for what, given in (("velocity", velocity), ("acceleration", acceleration), ("jerk", jerk)):
        if given is None:
            lacks = lacks or what
        elif lacks:
            raise ResultError(
                f"without {lacks}, {what} says nothing. Give {lacks}, or leave {what} out."
            )
        else:
            states.append(_checked(what, given, 3))
    shape = (len(t), states[0].shape[1], 3)
    for what, x in zip(("position", "velocity", "acceleration", "jerk"), states, strict=False):
        if x.shape != shape:
            raise ResultError(
                f"{what} has shape {x.shape}, expected {shape}: samples, vehicles, x y z."
            )
    if len(t) < 2:
        raise ResultError("a trajectory needs two samples or more.")
    if not (np.diff(t) > 0).all():
        k = int(np.argmin(np.diff(t)))
        raise ResultError(
            f"times must increase: sample {k + 2} is at {t[k + 1]:g} s, the one before at {t[k]:g} s."
        )
    first, knots = intervals(t)
    if not len(first):
        raise ResultError(f"all samples are at {t[0]:g} s; a trajectory lasts.")
    yaws = None if yaw is None else np.unwrap(_checked("yaw", yaw, 2), axis=0)
    if yaws is not None and yaws.shape != shape[:2]:
        raise ResultError(f"yaw has shape {yaws.shape}, expected {shape[:2]}: samples, vehicles.")
    # A sample that is one representable number after another marks a jump, as at a switch of phases in a result.
    if cubic and len(states) == 1:
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(knots, np.append(states[0][first], states[0][-1:], axis=0))
        position = Piecewise(knots, np.moveaxis(spline.c[::-1], 0, -1))
        how = ASSUMED["cubic"]
    else:
        x = np.stack(states)
        position = Piecewise.of_ends(knots, x[:, first], x[:, first + 1])
        how = NAMES[2 * len(states) - 1]
    angle = (np.full(shape[:2], np.nan) if yaws is None else yaws)[None, ..., None]
    turned = Piecewise.of_ends(knots, angle[:, first], angle[:, first + 1])
    return of_curve(
        position.beside(turned), how,
        mission=mission, separation=separation, limits=limits, radius=radius, ground=ground, name=name,
    )  # fmt: skip


def _checked(name: str, given: ArrayLike, dimensions: int) -> Floats:
    try:
        x = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ResultError(f"{name} is no array of numbers.") from None
    if x.ndim != dimensions or not x.size:
        raise ResultError(
            f"{name} has shape {x.shape}; it needs {dimensions} dimensions, none of them empty."
        )
    if not np.isfinite(x).all():
        where = ", ".join(str(k + 1) for k in np.argwhere(~np.isfinite(x))[0])
        raise ResultError(f"{name} has a value that is not finite, first at ({where}).")
    return x


def judged_as(
    start: Floats,
    duration: float,
    *,
    mission: Mission | str | Path | None = None,
    separation: float | None = None,
    limits: Mapping[str, float] | None = None,
    radius: float = 0.0,
    ground: float | None = None,
    name: str = "trajectories",
) -> Mission:
    """The mission against which trajectories are judged: one phase, in which nothing is commanded.

    Parameters
    ----------
    start : (N, 3) positions at the start [m]
    duration : [s]
    mission : its vehicles' radii and masses, limits and obstacles count, instead of what follows
    separation : least distance of centres, less their radii [m]
    limits : further keys of `[limits]`
    radius : of every vehicle [m]; 0: separation is centre to centre
    ground : height of the ground [m]; None: there is none

    Raises
    ------
    MissionError
        A limit is invalid.
    ResultError
        The mission has another number of vehicles.
    """
    phase = {"kind": "hold", "name": PHASE, "control": "open", "duration": max(duration, 1e-3)}
    if mission is not None:
        given = mission if isinstance(mission, Mission) else load_mission(mission)
        if given.n_agents != len(start):
            raise ResultError(
                f"the mission {given.name!r} has {given.n_agents} agents, and there are {len(start)} trajectories."
            )
        kept = (
            "schema_version",
            "name",
            "title",
            "limits",
            "obstacles",
            "gravity",
            "geodetic_origin",
        )
        data = {key: x for key, x in given.to_dict().items() if key in kept}
        bounds = data.get("limits", {})
        data["limits"] = {key: x for key, x in bounds.items() if key not in UNJUDGED}
        agents: dict[str, Any] = {
            "radius": list(given.agents.radius),
            "mass": list(given.agents.mass),
        }
    else:
        if "separation_below" in (limits or {}) and radius == 0.0:
            raise ResultError(
                "separation_below needs radii: one vehicle is below another where their spheres overlap as seen from "
                "above. Give a radius."
            )
        bounds = dict(limits or {}) | ({} if separation is None else {"separation": separation})
        data = {"schema_version": 1, "name": name, "limits": bounds}
        if ground is not None:
            data["obstacles"] = [{"kind": "ground", "height": ground}]
        agents = {"radius": radius, "mass": 1.0}
    agents["position"] = _told_apart(start).tolist()
    step = {"output_step": phase["duration"]} if duration < _STEP else {}
    return Mission.from_dict(data | step | {"agents": agents, "phases": [phase]}, "the limits")


def _told_apart(start: Floats) -> Floats:
    """Starts (N, 3) of which no two are equal: a mission refuses what the verdict on the curves has to judge."""
    _, first, again = np.unique(start, axis=0, return_index=True, return_inverse=True)
    twice = np.flatnonzero(first[again.ravel()] != np.arange(len(start)))
    found = start.copy()
    found[twice, 2] += 1e-6 * np.arange(1, len(twice) + 1)
    return found


def of_curve(
    curve: Piecewise, interpolation: str, *, names: Sequence[str] = (), **judged: Any
) -> Result:
    """A result of a curve (K, N, 4, P) of x, y, z [m] and yaw [rad]; see `trajectories`. Yaw is NaN if it is not known.

    Parameters
    ----------
    interpolation : what the curves are, in words
    names : of the vehicles, where they come from
    judged : see `judged_as`

    Raises
    ------
    ResultError
        A vehicle jumps, or there are too many numbers.
    MissionError
        A limit is invalid.
    """
    if abs(curve.time[0]) > _CLOCK or curve.time[0] < 0.0:
        curve = curve.later(-curve.time[0])
    _continuous(curve)
    n, span = curve.pieces.shape[1], float(curve.time[-1] - curve.time[0])
    step = max(_STEP, span * n / _SAMPLES)
    grid = curve.time[0] + step * np.arange(1, math.ceil(span / step))
    _bounded(n, len(curve.time) + len(grid))
    curve = curve.cut(grid, 1e-6)
    time, state, yaw = _samples(curve)
    mission = judged_as(state[0, 0], span, **judged)
    record = PhaseRecord(PHASE, "hold", "open", None, float(time[0]), float(time[-1]))
    _put_extremes(record, mission, Piecewise(curve.time, curve.pieces[:, :, :3]))
    if curve.pieces.shape[-1] < 3:  # lines turn at once at samples
        state[2:] = np.nan
    return _result(mission, record, time, state, yaw, interpolation, names)


def of_curves(
    curves: Sequence[Piecewise], interpolation: str, *, names: Sequence[str] = (), **judged: Any
) -> Result:
    """A result of curves with times of their own; before and after its own, a vehicle stays where it is.

    Parameters
    ----------
    interpolation, judged : see `of_curve`
    names : of the vehicles, where they come from

    Raises
    ------
    ResultError, MissionError
        As for `of_curve`.
    """
    _bounded(len(curves), len(common_knots(curves)))
    return of_curve(join(curves), interpolation, names=names, **judged)


def _bounded(n: int, times: int) -> None:
    """Refuse more numbers than a result may have.

    Raises
    ------
    ResultError
        There are more.
    """
    numbers = 2.0 * times * n * 45
    if numbers > _MOST:
        raise ResultError(
            f"{n:,} trajectories with {times:,} times of their own are {numbers:.2g} numbers; the maximum is {_MOST:g}."
            " Give fewer vehicles, or samples at common times."
        )


def _continuous(curve: Piecewise) -> None:
    """Refuse trajectories that jump.

    Raises
    ------
    ResultError
        One does.
    """
    off = np.linalg.norm(curve.jumps(1)[0, ..., :3], axis=2)
    if off.size and off.max() > _JUMP:
        k, i = np.unravel_index(int(off.argmax()), off.shape)
        raise ResultError(
            f"agent {i + 1} jumps by {off[k, i]:.3g} m at {curve.time[k + 1]:g} s: its pieces do not join."
        )


def _samples(curve: Piecewise) -> tuple[Floats, Floats, Floats]:
    """Times (K',), states (4, K', N, 3), yaws and their rates (2, K', N): one sample at each end of a piece.

    Where states jump, there are two. Where the rate of yaw jumps, it is the mean.
    """
    begin, end = curve.ends(4)
    first, last = begin[..., :3], end[..., :3]
    before, after = last[:, :-1], first[:, 1:]
    scale = 1.0 + np.abs(after).max(axis=(1, 2, 3), initial=0.0)
    jump = (np.abs(after - before) > 1e-9 * scale[:, None, None, None]).any(axis=(0, 2, 3))
    again = np.flatnonzero(jump) + 1
    k = np.sort(np.concatenate([np.arange(len(curve.time)), again]))
    later = np.append(False, k[1:] == k[:-1])  # the second sample of a jump
    time = curve.time[k]
    time[later] = np.nextafter(time[later], np.inf)
    state = np.concatenate([first, last[:, -1:]], axis=1)[:, k]
    state[:, np.flatnonzero(later) - 1] = before[:, again - 1]
    left, right = (
        np.concatenate(x, axis=1)[:2, k][..., 3]
        for x in ((begin[:, :1], end), (begin, end[:, -1:]))
    )
    return time, state, np.stack([right[0], (left[1] + right[1]) / 2])


def _put_extremes(record: PhaseRecord, mission: Mission, curve: Piecewise) -> None:
    """Give the phase the extremes of the curves, in continuous time."""
    n = mission.n_agents
    extremes = Extremes(mission)
    r, v = curve.states(curve.time[:1], 2)[:, 0]
    problem = plan_phase(mission, mission.phases[0], PhaseState(0.0, r, v)).problem
    work = workspace(n, 0)
    y = np.zeros(6 * n)
    state = extremes.begin(y, record.t_start, 0, rtol=1e-9, atol=np.ones_like(y))
    trail = state.trail
    powers = curve.pieces.shape[-1]
    together = max(1, _TOGETHER // (n * 3 * powers))
    row, best = 0, {}
    for begin in range(0, len(curve.pieces), together):
        c = curve.pieces[begin : begin + together]
        t, h = curve.time[begin : begin + len(c)], np.diff(curve.time[begin : begin + len(c) + 1])
        for k, parts in enumerate(_parts(c, h)):
            for part in range(parts):
                width = h[k] / parts
                x = part * width + width * records.KNOTS
                x = series.of_polynomials(np.broadcast_to(c[k], (5, *c[k].shape)), x, 2)
                trail.clock[row] = t[k] + part * width, width
                trail.points[row] = records.FROM_KNOTS @ x.reshape(2, 5, -1).swapaxes(0, 1).reshape(
                    5, -1
                )
                row += 1
                if row == len(trail.clock):
                    _take(extremes, problem, work, state, row)
                    row = 0
        part = Piecewise(curve.time[begin : begin + len(c) + 1], c)
        _accelerations(best, part, directed=extremes.directed)
    _take(extremes, problem, work, state, row)
    record.extremes.update(extremes.phase())
    extremes.flight([record])
    record.extremes.update(best)


def _take(
    extremes: Extremes, problem: Any, work: Any, state: records.IntegratorState, rows: int
) -> None:
    state.count[4] = rows
    extremes.take_path(problem, work, state)


def _parts(c: Floats, h: Floats) -> list[int]:
    """Into how many parts each piece (M, N, 3, P) of width h (M,) is cut, to be within `_CLOSE` of fourth degree."""
    beyond = np.abs(c[..., 5:]).max(axis=(1, 2), initial=0.0)
    power = np.arange(5, c.shape[-1])
    parts = np.ones(len(c), dtype=np.int64)
    while True:
        # Of a position, and of a velocity in the time of a part.
        off = (beyond * (h / parts)[:, None] ** power * (1.0 + power)).sum(axis=1)
        wide = (off > _CLOSE) & (parts < _PARTS)
        if not wide.any():
            return parts.tolist()
        parts[wide] *= 2


def _accelerations(best: dict[str, Extremum], curve: Piecewise, *, directed: bool) -> None:
    """Take the greatest accelerations of some pieces into account, by direction too; straight lines have none."""
    n, powers = curve.pieces.shape[1], curve.pieces.shape[-1]
    if powers < 3:
        return
    power = np.arange(2, powers)
    a = Piecewise(curve.time, curve.pieces[..., 2:] * (power * (power - 1)))
    points = a.bernstein().reshape(-1, 3, powers - 2)
    for way in SIZES if directed else ("",):
        name = f"{way}_acceleration".lstrip("_")
        found, known = greatest(points, SIZES[way]), best.get(name)
        if known is None or found.value > known.value:
            k, i = divmod(found.curve, n)
            t, end = curve.time[k : k + 2]
            best[name] = Extremum(found.value, float(t + found.place * (end - t)), i, -1)


def _result(
    mission: Mission,
    record: PhaseRecord,
    time: Floats,
    state: Floats,
    yaw: Floats,
    interpolation: str,
    names: Sequence[str],
) -> Result:
    r, v, a, j = state
    k, n = r.shape[:2]
    left = np.ones((k, n), dtype=np.bool_)
    close = proximity.closeness(r, mission.agents.radius, mission.obstacles, time, left)
    close = proximity.Closeness._make(x.copy() for x in close)
    nothing, none = np.full((k, n, 3), np.nan), np.zeros((k, 0))
    cm, cm_velocity = r.mean(axis=1), v.mean(axis=1)
    unknown: dict[str, Any] = {
        name: np.full((k, size), np.nan)
        for names, size in (
            (("attitude", "attitude_reference", "frame"), 4),
            (("rates", "rates_reference"), 3),
            (("wrench_asked", "wrench_achieved"), 6),
        )
        for name in names
    }
    edged = (
        "distance",
        "distance_reference",
        "distance_rate_reference",
        "constraint",
        "integral",
        "multiplier",
    )
    empty: dict[str, Any] = dict.fromkeys(edged, none)
    return Result(
        time=time, phase=np.zeros(k, dtype=np.int64), position=r, velocity=v, acceleration=a,
        slot_position=r, slot_velocity=v, slot_acceleration=a, slot_jerk=j,
        yaw=np.nan_to_num(yaw[0]), yaw_rate=np.nan_to_num(yaw[1]),
        input_force=nothing, constraint_force=nothing, external_force=nothing, thrust=nothing[..., 0],
        cm=cm, cm_velocity=cm_velocity, cm_reference=cm, cm_velocity_reference=cm_velocity,
        edges=np.zeros((0, 2), dtype=np.int64), **empty, singular_value=np.full(k, np.nan),
        separation=close.separation, separation_pair=close.pair, clearance=close.clearance,
        clearance_agent=close.agent, clearance_obstacle=close.obstacle, **unknown, phases=[record],
        mission_text=mission.text, statistics={"interpolation": interpolation, "names": list(names)},
    )  # fmt: skip
