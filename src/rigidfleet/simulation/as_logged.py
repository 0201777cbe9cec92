"""Logs of a flight: smoothed, aligned with its plan, and judged like a flight of our own, with what is left in doubt.

The likely way of each vehicle (`math.smoothing`) is watched in continuous time and judged as every flight is. How far
the true ones may be from it is known from ways drawn beside it; `assessment.doubt` makes intervals of that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from rigidfleet.assessment import Verdict, assess
from rigidfleet.assessment.alignment import Alignment, fit_alignment
from rigidfleet.assessment.doubt import DrawnWays, uncertainty_facts, verdict_with_intervals
from rigidfleet.errors import TrajectoryError
from rigidfleet.foreign.curves import ASSUMED, Trajectories
from rigidfleet.math import smoothing
from rigidfleet.math.piecewise import Piecewise, stack_ways
from rigidfleet.math.smoothing import NoiseEstimate, PositionNoise, Positions, Smoothed
from rigidfleet.result import Extremum, Result
from rigidfleet.setpoints import ways_of
from rigidfleet.simulation.extremes import CurveWatch
from rigidfleet.simulation.trajectories import result_of, result_of_curve, watch_curve
from rigidfleet.typing import Floats

#: What is believed of clocks: that they are those of the plan as recorded, that one offset is all that they differ from
#: it, or that each vehicle has its own.
Clock = Literal["recorded", "offset", "own"]
#: Time between knots of smoothed ways [s], unless samples are rarer: so short that a corner of a velocity is seen.
_STEP = 0.025
#: Ways that are drawn: as many as fit into so many knots, within bounds.
_KNOTS, _MOST, _LEAST = 8_000_000, 40, 12
#: Standard deviations of a position by which a vehicle that stands on something may be in it.
_TOUCH = 4.0
#: Times for which a result keeps how far places are in doubt.
_BANDS = 500
#: Samples of a vehicle from which a way can be smoothed, at least.
_SAMPLES = 4
#: Usual steps by which a log ends before a plan does and is complete, at most: a log of bursts has rare steps.
_STEPS = 3.0
#: Share by which the noise that samples show is more than the one stated.
_MORE = 1.5
#: Correlation times of noise of which no more is known than its size [s].
_COURSES = (0.0, 0.05, 0.2)
#: Time between the places that are aligned, at least [s], and that between samples beside obstacles.
_ALIGNED, _NEAR = 0.05, 0.05
#: What is planned, and holds of a flight of which positions alone are known.
_PLANNED = (
    "time", "phase", "cm_reference", "cm_velocity_reference", "attitude_reference", "frame", "rates_reference",
    "distance_reference", "distance_rate_reference", "slot_jerk", "yaw", "yaw_rate",
)  # fmt: skip
_WORDS = "a smoothing spline, with doubt"


class Doubts(NamedTuple):
    """What is stated: the noise [m] or who tells it ("": the log or data), its correlation time [s], the clock."""

    noise: float | Literal["log", "data", ""]
    tau: float | None = None
    clock: Clock = "recorded"


def judge_log(
    read: Trajectories, plan: Result | None, doubts: Doubts, **judged: Any
) -> tuple[Result, Verdict]:
    """The flight of a log and the verdict on it, with doubt.

    Parameters
    ----------
    read : the log
    plan : the flight that was planned; None: there is none, and limits are those ``judged``, see `result_of_curve`

    Raises
    ------
    TrajectoryError
        The log has no samples, or other vehicles or times than the plan.
    """
    if read.assumed not in ASSUMED.values():
        raise TrajectoryError(f"{read.names[0]}: has curves, which are exact. Remove --noise.")
    if plan is not None and plan.n_agents != len(read.names):
        words = f"has {plan.n_agents} agents, and the log {len(read.names)} vehicles"
        raise TrajectoryError(f"the plan {plan.mission.name!r} {words}. Give the log of each.")
    if read.own_clocks:
        if plan is None:
            words = "each vehicle has a clock of its own. Give a plan to compare them with."
            raise TrajectoryError(words)
        doubts = doubts._replace(clock="own")
    flown, drawn, estimate, alignment = _likely_flight(read, plan, doubts, judged)
    deviations = None if drawn is None else DrawnWays(flown, drawn)
    facts = uncertainty_facts(flown, deviations, estimate, alignment, doubts.clock)
    verdict = verdict_with_intervals(
        assess(flown), deviations, facts, common_clock=doubts.clock != "own"
    )
    flown.statistics["doubt"] = facts
    return flown, verdict


def _likely_flight(
    read: Trajectories, plan: Result | None, doubts: Doubts, judged: dict[str, Any]
) -> tuple[Result, Any, NoiseEstimate, Alignment | None]:
    """The likely flight of a log, how ways drawn differ from it, and what is known of noise, clock and set-up."""
    logs = [Positions(c.time, c.at(c.time)[:, :3], np.ones(len(c.time))) for c in read.curves]
    if min(len(log.time) for log in logs) < _SAMPLES:
        words = f"has too few samples to be judged with doubt. Give at least {_SAMPLES} of each vehicle."
        raise TrajectoryError(f"{read.names[0]}: {words}")
    sizes = [x.deviation for x in read.measured if x.deviation is not None]
    known = len(sizes) == len(logs) and all((x > 0.0).all() for x in sizes)
    if doubts.noise == "log" and not known:
        words = "the log does not say its noise. State it: --noise."
        raise TrajectoryError(f"{read.names[0]}: {words}")
    if doubts.noise in ("log", "") and known:
        # The least of a log is the unit.
        least = float(min(x.min() for x in sizes))
        doubts = doubts._replace(noise=least)
        scales = (np.sqrt((x**2).mean(axis=1)) / least for x in sizes)
        logs = [log._replace(scale=scale) for log, scale in zip(logs, scales, strict=True)]
    estimate = _noise_of_logs(logs, doubts)
    noise = estimate.noise or PositionNoise(math.nan)
    planned = None if plan is None else _planned_ways(plan)
    lost_at = np.full(len(logs), np.inf) if plan is None else plan.mission.lost_at
    full, logs = logs, _until_losses(logs, lost_at)
    alignment, smoothed, late = None, _smooth_ways(logs, noise), np.zeros(1)
    if planned is not None:
        plans = planned.pieces[:, :, :3].swapaxes(0, 1)
        times = [np.arange(log.time[0], log.time[-1], _ALIGNED) for log in logs]
        places = [(t, own.way.at(t)) for t, own in zip(times, smoothed, strict=True)]
        alignment = fit_alignment(places, [Piecewise(planned.time, x) for x in plans], doubts.clock)
        offsets, late = _clock_offsets_and_errors(alignment, doubts.clock)
        every = np.broadcast_to(offsets, len(logs))
        both = zip(full, every, strict=True)
        full = [log._replace(time=log.time - by) for log, by in both]
        logs = _until_losses(full, lost_at)
        if offsets.any():
            smoothed = _smooth_ways(logs, noise)
    # Beside a plan, a sample counts a step beyond it, as others are lost, and by part of which clocks may be off.
    ends = np.array([log.time[[0, -1]] for log in logs])
    if plan is not None:
        steps = [np.diff(log.time) for log in logs]
        beyond = [min(np.quantile(x, 0.95), _STEPS * np.median(x)) for x in steps]
        ends += np.outer(beyond, [-1.0, 1.0])
    each = zip(smoothed, ends.tolist(), strict=True)
    whole = stack_ways([own.way.between(*end) for own, end in each])
    if not read.away:
        ends[:] = whole.time[[0, -1]]
    ends[:, 1] = np.minimum(ends[:, 1], lost_at)
    for i in [i for i, log in enumerate(full) if log.time[-1] > lost_at[i]]:
        begin = np.nextafter(lost_at[[i]], np.inf)  # at the loss itself, it still flies
        whole = whole.insert_knots(begin)
        falls = _smooth_ways([full[i]], noise)[0].way.with_knots(whole.time, stays=True)
        after = whole.time[:-1] >= begin
        whole.pieces[after, i] = falls.pieces[after]
    spans = ends.tolist() if np.ptp(ends, axis=0).any() else []
    if plan is None or planned is None:
        blank = Piecewise(whole.time, np.full((*whole.pieces.shape[:2], 1, 1), np.nan))
        judged |= {"agents": read.names, "spans": spans, "since": read.since}
        flown = result_of_curve(whole.stack(blank), _WORDS, **judged)
    else:
        flown = replace_ways(plan, planned, whole, spans)
    del whole, planned  # large
    zero = flown.statistics.get("clock", 0.0)
    resets = [t for log, x in zip(full, read.measured, strict=False) for t in log.time[x.resets]]
    flown.statistics |= {
        "names": list(read.names), "notes": list(read.notes), "read": list(read.read),
        "touch": _TOUCH * np.nan_to_num(noise.sigma), "resets": [round(t - zero, 6) for t in sorted(resets)],
    }  # fmt: skip
    if estimate.noise is None:
        return flown, None, estimate, alignment
    # Noise of a known size and an unknown course may be any of several; each gives ways of its own.
    unknown = _COURSES if estimate.words and estimate.source == "stated" else ()
    models = [smoothed, *(_smooth_ways(logs, noise._replace(tau=tau)) for tau in unknown)]
    drawn = _random_deviations(flown, models, late)
    if plan is not None:
        few = slice(None, None, -(-len(flown.time) // _BANDS))
        place = np.linalg.norm(drawn[:, 0, few], axis=3).max(axis=0).round(6)
        flown.statistics["bands"] = {"time": flown.time[few].tolist(), "place": place.tolist()}
    return flown, drawn, estimate, alignment


def _noise_of_logs(logs: Sequence[Positions], doubts: Doubts) -> NoiseEstimate:
    """The noise as it is stated, unless samples show more; or as they show it."""
    size, tau = doubts.noise, doubts.tau
    if not isinstance(size, str) and tau is not None:
        return NoiseEstimate(PositionNoise(size, tau), "stated", "")
    shown = smoothing.fit_noise(logs, None, _STEP)
    if isinstance(size, str):
        return shown
    if shown.noise is None or shown.noise.sigma <= _MORE * size:
        return smoothing.fit_noise(logs, size, _STEP)
    words = f"that is more than the {1e3 * size:.3g} mm stated"
    return shown._replace(words=words)


def _until_losses(logs: Sequence[Positions], lost_at: Floats) -> list[Positions]:
    """The samples of vehicles until they are lost (N,) [s]: their fall tells nothing of the way before."""
    both = zip(logs, lost_at, strict=True)
    counts = [max(_SAMPLES, log.time.searchsorted(end, "right")) for log, end in both]
    return [Positions(*(x[:count] for x in log)) for log, count in zip(logs, counts, strict=True)]


def _smooth_ways(logs: Sequence[Positions], noise: PositionNoise) -> list[Smoothed]:
    """Likely ways, on knots as rare as each one's samples; rare knots are at some of the others', whatever the rate."""
    usual = np.array([max(_STEP, np.median(np.diff(log.time))) for log in logs])
    steps = usual.min() * 2.0 ** np.floor(np.log2(usual / usual.min()))
    both = zip(logs, steps.tolist(), strict=True)
    return [
        smoothing.smooth(log, noise, smoothing.knots_over(log.time, step)) for log, step in both
    ]


def _planned_ways(plan: Result) -> Piecewise:
    """The plan: ways of slots, and of vehicles as they fly in the simulator where no slots are tracked."""
    slots, flown = plan.setpoints_at_samples(), plan.setpoints_at_samples(flown=True)
    state = np.where(np.isnan(slots.state), flown.state, slots.state)
    state[:, 2:] = np.nan_to_num(state[:, 2:])  # of straight lines
    still = np.zeros_like(slots.yaw)
    return ways_of(slots._replace(state=state, yaw=still, yaw_rate=still), slice(None))


def _clock_offsets_and_errors(alignment: Alignment, clock: Clock) -> Floats:
    """By how much stamps are late (2, N or 1) [s] and the error, as far as that is taken out: of each, or of all.

    Raises
    ------
    TrajectoryError
        The offset cannot be told.
    """
    every = alignment.fit[:, :1]
    if clock == "recorded":
        return np.zeros((2, 1))
    offsets = np.where(np.isnan(alignment.own), every, alignment.own) if clock == "own" else every
    if np.isnan(offsets).any():
        why = "the clock cannot be told: the plan hardly moves, noise hides it, or the log is not of it"
        raise TrajectoryError(f"{why}. Give logs of one clock, with --clock recorded.")
    return offsets


def _random_deviations(flown: Result, models: Sequence[Sequence[Smoothed]], late: Floats) -> Any:
    """By how much ways drawn differ from the likely one (S, 3, K, N, 3); ``late``: errors of clocks (N or 1,) [s]."""
    random, time = np.random.default_rng(0), flown.time + flown.statistics.get("clock", 0.0)
    count = int(np.clip(_KNOTS // sum(len(x.knots) for x in models[0]), _LEAST, _MOST))
    shares = [len(range(k, count, len(models))) for k in range(len(models))]
    off = np.zeros((count, 3, *flown.position.shape), dtype=np.float32)
    for i, likely in enumerate(models[0]):
        inside = flown.left[:, i]
        drawn = [model[i].draw(share, random) for model, share in zip(models, shares, strict=True)]
        points = np.concatenate(drawn, axis=2) - likely.points[..., None]
        states = smoothing.b_spline_curve(likely.knots, points).states(time[inside], 3)
        off[:, :, inside, i] = np.moveaxis(states, -1, 0)
    rates = np.stack([flown.velocity, np.nan_to_num(flown.acceleration)])
    for s, by in enumerate(late * random.standard_normal((count, len(late)))):
        off[s, :2] += by[:, None] * rates
    return off


def replace_ways(plan: Result, planned: Piecewise, way: Piecewise, spans: list[Any]) -> Result:
    """A result of a plan with ways (K, N, 3, P) in place of what it flew, at the times that both have.

    Forces, attitudes and messages are unknown.

    Raises
    ------
    TrajectoryError
        They have no time in common.
    """
    mission = plan.mission
    both = (plan.time >= way.time[0] - 1e-9) & (plan.time <= way.time[-1] + 1e-9)
    if np.count_nonzero(both) < 2:
        words = f"{way.time[0]:.6g} to {way.time[-1]:.6g} s, and the plan {plan.time[0]:g} to {plan.time[-1]:g} s"
        raise TrajectoryError(f"the log covers {words}. If the clocks differ, say --clock offset.")
    inside = slice(*(np.flatnonzero(both)[[0, -1]] + [0, 1]))  # a view, to save memory
    time, at_phase = plan.time[inside], plan.phase[inside]
    begin, end = float(time[0]), float(time[-1])
    watch = CurveWatch(mission, begin)
    grid = np.arange(begin, end, _NEAR if mission.obstacles else np.inf)
    records = []
    for record in plan.phases[: at_phase[-1] + 1]:
        since, until = max(record.t_start, begin), min(record.t_end, end)
        extremes: dict[str, Extremum] = {}
        if until - since > 1e-9:
            fastest = watch_curve(watch, way.between(since, until), grid, spans)
            extremes = watch.end_phase() | fastest
        records.append(replace(record, extremes=extremes, settled=None, controller=None))
    watch.keep_agents(np.ones(plan.n_agents, dtype=np.bool_))
    watch.add_extremes_to_phases(records)
    every = {name: getattr(plan, name) for name in _PLANNED}
    known: dict[str, Any] = {name: x[inside] for name, x in every.items() if x is not None}
    (r, v, a), slots = way.states(time, 3), planned.states(time, 3)[..., :3]
    mass, (i, j) = mission.fleet.mass * (time[:, None] <= mission.lost_at), plan.edges.T
    mass /= mass.sum(axis=1, keepdims=True)
    # What vehicles that are left are off their planned places moves the centre.
    off = np.einsum("kn,skna->ska", mass, [r - plan.position[inside], v - plan.velocity[inside]])
    length = np.linalg.norm(r[:, i] - r[:, j], axis=2)
    known |= {
        "edges": plan.edges, "position": r, "velocity": v, "acceleration": a, "slot_position": slots[0],
        "slot_velocity": slots[1], "slot_acceleration": slots[2], "cm": plan.cm[inside] + off[0],
        "cm_velocity": plan.cm_velocity[inside] + off[1],
        "distance": length, "constraint": length - known["distance_reference"],
    }  # fmt: skip
    whole = end >= plan.time[-1] - 1e-6
    ending = plan.ending if whole else "the log ends"
    complete = plan.complete and whole
    return result_of(mission, records, known, {"spans": spans}, complete=complete, ending=ending)
