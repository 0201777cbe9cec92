"""Flights that others made, as results: judged, drawn, replayed and exported like one's own.

A trajectory is a piecewise polynomial for each vehicle. Its extremes are those of the curve, in continuous time, by the
same monitor that watches our own flights; what was recorded elsewhere is not read. The monitor takes curves of fourth
degree: pieces of a higher one are cut so short that they are within a micrometre of such a curve.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.quantities import SOURCES
from rigidfleet.errors import ResultError
from rigidfleet.foreign.curves import ASSUMED, Trajectories
from rigidfleet.kernel import records
from rigidfleet.math import series
from rigidfleet.math.bernstein import SIZES, greatest_convex_value
from rigidfleet.math.piecewise import (
    SAME,
    Piecewise,
    common_knots,
    pad,
    piece_index,
    refine_knots,
    stack_ways,
)
from rigidfleet.mission import Mission, as_mission
from rigidfleet.result import LABELS, Extremum, PhaseRecord, Result, presence
from rigidfleet.result.result import CLOSE, VARIABLES
from rigidfleet.setpoints import interval_starts_and_knots
from rigidfleet.simulation.extremes import CurveWatch
from rigidfleet.simulation.recording import closeness_arrays, mission_text_field
from rigidfleet.typing import Floats, Ints

#: Greatest distance [m] of a curve of fourth degree from the piece that it stands for, and most parts of a piece.
_CLOSE, _PARTS = 1e-6, 256
#: Greatest jump of a position between two pieces [m]; a larger one is no flight.
_JUMP = 1e-3
#: Numbers of a result, and of a block of pieces that is processed together.
_MOST, _TOGETHER = 5e8, 400_000
#: Time between samples [s], unless the trajectory itself has more; about so many in all, and steps of all vehicles
#: beside obstacles.
_STEP, _SAMPLES, _WATCHED = 0.05, 400_000, 2_000_000
#: From where on a start, as one before zero, is moved to zero: a time of a clock, not of a flight [s].
_CLOCK = 1e5
CURVE_NAMES = {
    1: ASSUMED["linear"],
    3: "cubics",
    5: "quintics",
    7: "polynomials of degree 7",
}
#: What of a mission trajectories are judged by, beside radii and masses.
_JUDGING = (
    "schema_version", "name", "title", "limits", "obstacles", "fences", "people", "gravity", "geodetic_origin",
)  # fmt: skip
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
        The arrays are no trajectories: a wrong shape, values that are not finite, times that do not increase. Or
        positions over time do not show what a limit is of.
    MissionError
        A limit is invalid.
    """
    t = _check_numbers("time", time, None)
    states = [_check_numbers("position", position, len(t), None, 3)]
    shape, lacks = states[0].shape, ""
    for what, values in (("velocity", velocity), ("acceleration", acceleration), ("jerk", jerk)):
        if values is None:
            lacks = lacks or what
        elif lacks:
            raise ResultError(
                f"without {lacks}, {what} says nothing. Give {lacks}, or leave {what} out."
            )
        else:
            states.append(_check_numbers(what, values, *shape))
    if len(t) < 2:
        raise ResultError("a trajectory needs two samples or more.")
    if not (np.diff(t) > 0).all():
        k = int(np.argmin(np.diff(t)))
        raise ResultError(
            f"times must increase: sample {k + 2} is at {t[k + 1]:g} s, the one before at {t[k]:g} s."
        )
    # A sample that is one representable number after another marks a jump, as at a switch of phases in a result.
    first, knots = interval_starts_and_knots(t)
    if not len(first):
        raise ResultError(f"all samples are at {t[0]:g} s; a trajectory lasts.")
    yaws = np.full(shape[:2], np.nan) if yaw is None else _check_numbers("yaw", yaw, *shape[:2])
    x, angle = np.stack(states), np.unwrap(yaws, axis=0)[None, ..., None]
    way, turned = (Piecewise.of_end_states(knots, y[:, first], y[:, first + 1]) for y in (x, angle))
    how = CURVE_NAMES[2 * len(states) - 1]
    if cubic and len(states) == 1:
        _refuse_jumps(way)
        way, how = Piecewise.cubic_spline(knots, way.at(knots)), ASSUMED["cubic"]
    return result_of_curve(
        way.stack(turned), how,
        mission=mission, separation=separation, limits=limits, radius=radius, ground=ground, name=name,
    )  # fmt: skip


def _check_numbers(name: str, values: ArrayLike, *sizes: int | None) -> Floats:
    """Finite numbers of these sizes, of which None is any but none."""
    try:
        x = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ResultError(f"{name} is no array of numbers.") from None
    if x.ndim != len(sizes) or not x.size:
        raise ResultError(
            f"{name} has shape {x.shape}; it needs {len(sizes)} dimensions, none of them empty."
        )
    if any(size not in (None, own) for size, own in zip(sizes, x.shape, strict=True)):
        expected = ", ".join("any" if size is None else f"{size}" for size in sizes)
        raise ResultError(
            f"{name} has shape {x.shape}, expected ({expected}): samples, vehicles, axes."
        )
    if not np.isfinite(x).all():
        where = ", ".join(str(k + 1) for k in np.argwhere(~np.isfinite(x))[0])
        raise ResultError(f"{name} has a value that is not finite, first at ({where}).")
    return x


def judging_mission(
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
    """What trajectories are judged against: radii, limits and obstacles, as the mission that readers of a result need.

    It is data of one phase in which nothing is commanded. Nothing plans or flies it.

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
        The mission has another number of vehicles, or positions over time do not show what a limit is of.
    """
    lasting = max(duration, 1e-3)
    phase = {"kind": "hold", "name": PHASE, "control": "open", "duration": lasting}
    agents: dict[str, Any] = {"position": start.tolist()}
    if mission is not None:
        own = as_mission(mission)
        if own.n_agents != len(start):
            raise ResultError(
                f"the mission {own.name!r} has {own.n_agents} agents, and there are {len(start)} trajectories."
            )
        data = {key: x for key, x in own.to_dict().items() if key in _JUDGING}
        bounds = data.get("limits", {})
        data["limits"] = {key: x for key, x in bounds.items() if key not in SOURCES}
        agents |= {"radius": list(own.agents.radius), "mass": list(own.agents.mass)}
        if own.people:  # what fails falls through the air of the mission
            wind = list(own.all_disturbances.wind)
            data["disturbances"] = {"wind": wind, "drag": own.drag.tolist()}
    else:
        for key in filter(SOURCES.get, limits or {}):
            problem = f"is judged by {SOURCES[key]}, which positions over time do not show"
            raise ResultError(f"limits.{key}: {problem}. Leave it out.")
        if "separation_below" in (limits or {}) and radius == 0.0:
            raise ResultError(
                "separation_below needs radii: one vehicle is below another where their spheres overlap as seen from "
                "above. Give a radius."
            )
        bounds = dict(limits or {}) | ({} if separation is None else {"separation": separation})
        data = {"schema_version": 1, "name": name, "limits": bounds}
        if ground is not None:
            data["obstacles"] = [{"kind": "ground", "height": ground}]
        agents |= {"radius": radius, "mass": 1.0}
    step = min(lasting, max(_STEP, 1e-5 * lasting, 6.1e-8 * lasting * len(start)))  # not flown
    more = {"output_step": step, "agents": agents, "phases": [phase]}
    return Mission.from_plain(data | more, "the limits")


def result_of_curve(
    curve: Piecewise,
    interpolation: str,
    *,
    agents: Sequence[str] = (),
    spans: Sequence[Sequence[float]] = (),
    since: float = 0.0,
    **judged: Any,
) -> Result:
    """A result of a curve (K, N, 4, P) of x, y, z [m] and yaw [rad]; see `trajectories`. Yaw is NaN if it is not known.

    Parameters
    ----------
    interpolation : what the curves are, in words
    agents : their names, where these come from
    spans : from when to when [s] each vehicle is there; empty: all always are
    since : time of another clock from which times count [s]; no clock of obstacles that move, unless it is 0
    judged : see `judging_mission`

    Raises
    ------
    ResultError
        A vehicle jumps, there are too many numbers, or obstacles move by another clock.
    MissionError
        A limit is invalid.
    """
    zero = 0.0 if 0.0 <= curve.time[0] <= _CLOCK else float(curve.time[0])
    curve, spans = curve.shift_time(-zero), np.subtract(spans, zero).tolist()
    _refuse_jumps(curve)
    time, n, powers = curve.time, curve.pieces.shape[1], curve.pieces.shape[-1]
    span = float(time[-1] - time[0])
    # Samples are at all knots, and between them so that none is further from the next one than a step.
    step = max(_STEP, span * n / _SAMPLES) * (1.0 + 1e-9)
    parts = np.ceil(np.diff(time) / step).astype(np.int64)
    _refuse_too_many(n, int(parts.sum()) + 1)
    start = curve.at(time[:1])[0, :, :3]
    mission = judging_mission(start, span, **judged)
    if (zero or since) and any(thing.solid.moves for thing in mission.obstacles):
        raise ResultError(
            f"the trajectories begin at {since + zero:.12g} s, and obstacles move from 0 s on. Let both count from one "
            "zero."
        )
    watch = CurveWatch(mission, float(time[0]))
    # The end of a step tells whether a vehicle that came near an obstacle below it has landed there, or passed.
    near = max(_STEP, span * n / _WATCHED) if mission.obstacles else np.inf
    grid = time[0] + near * np.arange(1, math.ceil(span / near))
    fastest = watch_curve(watch, curve, grid, spans)
    record = PhaseRecord(PHASE, "hold", "open", None, float(time[0]), float(time[-1]))
    watch.keep_agents(np.ones(n, dtype=np.bool_))  # whose data end near an obstacle has not left it
    record.extremes.update(watch.end_phase())
    watch.add_extremes_to_phases([record])
    record.extremes.update(fastest)
    at, state, yaws = _sample_times_states_and_yaw(curve, parts)
    if powers < 3:  # lines turn at once at samples
        state[2:] = np.nan
    facts = {"interpolation": interpolation, "names": list(agents), "spans": spans, "clock": zero}
    r, v, a, j = state
    turned = np.nan_to_num(yaws, copy=False)
    known: dict[str, Any] = {
        "time": at, "phase": np.zeros(len(at), dtype=np.int64), "position": r, "velocity": v, "acceleration": a,
        "slot_position": r, "slot_velocity": v, "slot_acceleration": a, "slot_jerk": j,
        "yaw": turned[0], "yaw_rate": turned[1],
        "cm": r.mean(axis=1), "cm_velocity": v.mean(axis=1), "edges": np.zeros((0, 2), dtype=np.int64),
    }  # fmt: skip
    known |= {"cm_reference": known["cm"], "cm_velocity_reference": known["cm_velocity"]}
    return result_of(mission, [record], known, facts)


def result_of_trajectories(read: Trajectories, **judged: Any) -> Result:
    """A result of trajectories that were read; before and after its own times, a vehicle stays or is not judged.

    Parameters
    ----------
    judged : see `judging_mission`

    Raises
    ------
    ResultError, MissionError
        As for `result_of_curve`.
    """
    if read.own_clocks:
        raise ResultError(
            f"{', '.join(read.names[:3])}: each has a clock of its own, so how near they came cannot be told. Give one "
            "file at a time, or logs with the time of GNSS."
        )
    curves, knots = read.curves, common_knots(read.curves)
    _refuse_too_many(len(curves), len(knots))
    ends = knots[np.searchsorted(knots, [curve.time[[0, -1]] - 2.0 * SAME for curve in curves])]
    spans = ends.tolist() if read.away and np.ptp(ends, axis=0).any() else ()
    result = result_of_curve(
        stack_ways(curves), read.assumed, agents=read.names, spans=spans, since=read.since, **judged
    )
    result.statistics |= {"notes": list(read.notes), "read": list(read.read)}
    return result


def _refuse_too_many(n: int, times: int) -> None:
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


def _refuse_jumps(curve: Piecewise) -> None:
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


def _sample_times_states_and_yaw(curve: Piecewise, parts: Ints) -> tuple[Floats, Floats, Floats]:
    """Times (K,) [s], position to jerk (4, K, N, 3), and yaw and its rate (2, K, N), at ends of equal parts of pieces.

    Where states jump, there are two samples. Where the rate of yaw jumps, it is the mean.
    """
    time, (pieces, n, _, powers) = curve.time, curve.pieces.shape
    together = max(1, _TOGETHER // (4 * n * powers))
    greatest_of = np.abs(curve.pieces[:, :, :3, :4]).max(axis=(0, 1, 2))
    scale = 1.0 + series.taylor_derivatives(pad(greatest_of, 4))
    ends = np.append(np.zeros(pieces - 1, dtype=np.bool_), True)  # which pieces have a sample there
    turn = np.zeros((pieces + 1, n))  # half of the jumps of yaw's rate
    for k in range(0, pieces - 1, together):
        jumps = curve.slice_pieces(k, k + together + 1).jumps(4)
        turn[k + 1 : k + 1 + jumps.shape[1]] = 0.5 * jumps[1, ..., 3]
        jumps = np.abs(jumps[..., :3]) > 1e-9 * scale[:, None, None, None]
        ends[k : k + jumps.shape[1]] |= jumps.any(axis=(0, 2, 3))
    count = parts + ends
    k = np.repeat(np.arange(pieces), count)
    first = np.cumsum(count) - count
    share = (np.arange(len(k)) - first[k]) / parts[k]
    at = time[k] + np.diff(time)[k] * share
    at[share == 1.0] = time[1:][ends]
    again = np.flatnonzero(ends[:-1]) + 1
    at[first[again]] = np.nextafter(time[again], np.inf)
    state, yaw = np.empty((4, len(k), n, 3)), np.empty((2, len(k), n))
    for row in range(0, len(k), together):
        rows = slice(row, row + together)
        after = np.diff(time)[k[rows]] * share[rows]
        x = series.taylor_derivatives(series.polynomial_series(curve.pieces[k[rows]], after, 4))
        state[:, rows], yaw[:, rows] = x[..., :3], x[:2, ..., 3]
    yaw[1, share == 0.0] -= turn[k[share == 0.0]]
    yaw[1, share == 1.0] += turn[k[share == 1.0] + 1]
    return at, state, yaw


def watch_curve(
    watch: CurveWatch, curve: Piecewise, grid: Floats, presence_spans: Sequence[Sequence[float]]
) -> dict[str, Extremum]:
    """Watch a curve (K, N, 3 or more, P), see `_watch_positions`, and return its greatest accelerations."""
    fastest: dict[str, Extremum] = {}
    together = max(1, _TOGETHER // (4 * curve.pieces.shape[1] * curve.pieces.shape[-1]))
    for k in range(0, len(curve.pieces), together):  # in blocks, to save memory
        block = curve.slice_pieces(k, k + together)
        way = Piecewise(block.time, pad(block.pieces[:, :, :3], 2))
        _watch_positions(watch, way, grid, presence_spans)
        here = presence(0.5 * (way.time[1:] + way.time[:-1]), presence_spans, way.pieces.shape[1])
        way = Piecewise(way.time, way.pieces * here[..., None, None])
        _update_peak_accels(fastest, way, directed=watch.directed)
    return fastest


def _watch_positions(
    watch: CurveWatch, way: Piecewise, grid: Floats, spans: Sequence[Sequence[float]]
) -> None:
    """Watch positions (K, N, 3, P) in steps that end at times of a grid, within `_CLOSE` of curves of fourth degree.

    Vehicles are watched in their ``spans`` alone, if there are any.
    """
    knots = refine_knots(way.time, grid, 1e-6)
    k = piece_index(way.time, 0.5 * (knots[:-1] + knots[1:]))
    share = np.diff(knots) / np.diff(way.time)[k]
    parts = np.ceil(_parts_a_piece(way)[k] * share - 1e-9)
    number = np.append(0.0, np.cumsum(parts))  # of the knots that remain
    knots = np.interp(np.arange(number[-1] + 1.0), number, knots)  # equal parts of each interval
    together = max(1, _TOGETHER // (30 * way.pieces.shape[1]))
    here = presence(0.5 * (knots[:-1] + knots[1:]), spans, way.pieces.shape[1] if spans else 1)
    change = np.flatnonzero((here[1:] != here[:-1]).any(axis=1)) + 1
    starts = np.union1d(np.arange(0, len(here), together), change)
    for first, last in pairwise([*starts.tolist(), len(here)]):
        if spans:
            watch.keep_agents(here[first])
        if not here[first].any():
            continue
        part = way.with_knots(knots[first : last + 1])
        at = [x.at_shares(records.KNOTS) for x in (part, part.derivative_curve())]
        points = np.concatenate([x.reshape(*x.shape[:2], -1) for x in at], axis=2)
        clock = np.column_stack([part.time[:-1], np.diff(part.time)])
        watch.monitor_curves(clock, records.FROM_KNOTS @ points)


def _parts_a_piece(way: Piecewise) -> Ints:
    """Into how many parts each piece (K, N, 3, P) is cut, to be within `_CLOSE` of curves of fourth degree.

    About any place of a piece of width h, power p has a coefficient of at most sum_j C(j, p) |c_j| h^(j - p). What is
    beyond the fourth counts of a position, and of a velocity in the time of a part.
    """
    power = np.arange(way.pieces.shape[-1])
    weight = [sum((1 + p) * math.comb(j, p) for p in range(5, j + 1)) for j in power.tolist()]
    size = np.abs(way.pieces).max(axis=(1, 2)) * np.diff(way.time)[:, None] ** power
    return np.ceil((size @ np.array(weight) / _CLOSE) ** 0.2).clip(1, _PARTS).astype(np.int64)


def _update_peak_accels(best: dict[str, Extremum], curve: Piecewise, *, directed: bool) -> None:
    """Take the greatest accelerations of some pieces into account, by direction too; straight lines have none."""
    n = curve.pieces.shape[1]
    if curve.pieces.shape[-1] < 3:
        return
    points = curve.derivative_curve().derivative_curve().control_points()
    points = points.reshape(-1, *points.shape[2:])
    for way in SIZES if directed else ("",):
        name = f"{way}_acceleration".lstrip("_")
        peak, known = greatest_convex_value(points, SIZES[way]), best.get(name)
        if known is None or peak.value > known.value:
            k, i = divmod(peak.curve, n)
            t, end = curve.time[k : k + 2]
            best[name] = Extremum(peak.value, float(t + peak.place * (end - t)), i, -1)


def result_of(
    mission: Mission,
    records: list[PhaseRecord],
    known: dict[str, Any],
    statistics: dict[str, Any],
    **ending: Any,
) -> Result:
    """A result of what is known of a flight, NaN for the rest; ``statistics`` have the spans of `result_of_curve`."""
    time, r = known["time"], known["position"]
    k, n = r.shape[:2]
    left = presence(time, statistics["spans"], n)
    sizes = {dim: len(names) for dim, names in LABELS.items()}
    sizes |= {"time": k, "agent": n, "edge": len(known["edges"])}
    nothing = cache(lambda *shape: np.full(shape, np.nan))  # of each shape once
    unknown = {
        name: nothing(*(sizes[dim] for dim in x.dims))
        for name, x in VARIABLES.items()
        if not x.optional and name not in (*known, *CLOSE)
    }
    worst = [record.extremes for record in records]
    result = Result(
        **known, **unknown, **dict.fromkeys(CLOSE), phases=records, mission_text="",
        statistics=statistics, **ending,
        later=[
            (CLOSE, partial(closeness_arrays, mission, worst, [r], time, left)),
            (("mission_text",), partial(mission_text_field, mission)),
        ],
    )  # fmt: skip
    # Its text is written where the result is, and need not be read.
    vars(result)["mission"] = mission
    return result
