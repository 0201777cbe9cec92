"""Measurements of a flight: shapes against their slots, waypoints, extremes at samples and between them."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise

import numpy as np

from rigidfleet._common.quantities import QUANTITIES, Quantity, quantity
from rigidfleet.assessment.fits import Fit, degrees_between_vectors, fits_by_sample, formation_shape
from rigidfleet.assessment.verdict import Extreme, PhaseVerdict, Waypoint, value
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.result import PAD, Extremum, Result
from rigidfleet.result.quantities import (
    SAMPLED,
    Samples,
    closeness,
    mask_lost,
    norms,
    owner_name,
    samples,
)
from rigidfleet.typing import Bools, Floats, Ints

#: Quantities of which the record of a phase has a worst value between samples, in files of every version.
_DUE = ("speed", "lowest", "highest", "thrust", "separation", "clearance", "geofence")
#: Share by which a sample may be worse than that, for rounding; beyond it, the record contradicts itself. Forces have
#: no such bound: a peak is searched only where the ends of a step show one, so that a jump of a user's force may be
#: missed.
_SLACK = {x: 1e-9 * QUANTITIES[x].order for x in _DUE if not QUANTITIES[x].source}

#: What a phase is judged by at its end.
_ENDS = ("target", "stay")

#: What a verdict on a phase repeats of its record.
_OF_RECORD = ("name", "kind", "control", "formation", "t_start", "t_end", "settled")


class Measurements:
    """Measures a result phase by phase, at samples (recomputed from positions and forces) and between them."""

    def __init__(self, result: Result) -> None:
        self.result, self.mission = result, result.mission
        self.left = result.left
        #: Samples of each phase.
        ends = np.searchsorted(result.phase, np.arange(len(result.phases) + 1))
        self.parts = [slice(*pair) for pair in pairwise(ends.tolist())]
        #: Phases that have samples, and the last sample of each.
        self.flown = [k for k, s in enumerate(self.parts) if s.stop > s.start]
        self.last = [self.parts[k].stop - 1 for k in self.flown]
        #: Quantities of which the record tells what happens between samples.
        self.names_recorded = set[str]().union(*(p.extremes for p in result.phases))
        self._starts = ends[self.flown]
        self._sampled: dict[str, Samples] = {}
        self._worst_ranks: dict[str, list[float]] = {}

    @cached_property
    def closeness(self) -> proximity.Closeness:
        """Distances to each other and to obstacles at samples."""
        return closeness(self.result)

    def first_time(self, broken: Bools) -> float:
        """Time [s] of the first sample at which ``broken`` holds; infinity if it never does."""
        return float(self.result.time[int(np.argmax(broken))]) if broken.any() else math.inf

    # -- at samples -----------------------------------------------------------------------------------

    def samples_of(self, name: str) -> Samples:
        """Values of a quantity at samples."""
        if name not in self._sampled:
            close = self.closeness if name in ("separation", "clearance") else None
            self._sampled[name] = samples(self.result, name, close)
        return self._sampled[name]

    def worst_sample(
        self, sampled: Samples, part: slice = slice(None), *, alone: bool = False
    ) -> Extreme | None:
        """The worst of some values; None if none is finite. ``alone``: nothing is known between them."""
        rank, values, result = sampled.rank[part], sampled.values, self.result
        if not rank.size:
            return None
        k, place = divmod(int(rank.argmax()), rank.shape[1])
        if rank.item(k, place) == -math.inf:
            return None
        k += part.start or 0
        at = (k,) if values.ndim == 1 else (k, place)
        who = owner_name(result, sampled.quantity, *sampled.owner(*at))
        phase = result.phases[result.phase.item(k)].name
        return Extreme(values.item(at), result.time.item(k), who, phase, alone)

    # -- between samples ------------------------------------------------------------------------------

    def extreme_of(self, name: str, x: Extremum, phase: str) -> Extreme:
        """An extreme of a phase, as it was recorded."""
        q = quantity(name)
        return Extreme(_in_unit(q, x), x.time, owner_name(self.result, q, x.who, x.other), phase)

    def worst(self, name: str) -> Extreme | None:
        """The worst value of a flight, at its samples or between them; None if it is not known."""
        q = quantity(name)
        if q.by_phase:
            every = [worst[name] for worst in self.worst_by_phase if name in worst]
            return max(every, key=lambda e: q.rank(e.value), default=None)
        return self.worst_among(name, self.samples_of(name) if name in SAMPLED else None)

    def worst_among(self, name: str, values: Samples | None) -> Extreme | None:
        """The worst value of a flight among some ``values`` at samples, or between them."""
        q = quantity(name)
        rank = q.rank
        every = [(p.extremes[name], p.name) for p in self.result.phases if name in p.extremes]
        worst = max(every, key=lambda each: rank(_in_unit(q, each[0])), default=None)
        between = None if worst is None else self.extreme_of(name, *worst)
        sampled = None if values is None else self.worst_sample(values, alone=between is None)
        if sampled is None or between is None:
            return sampled or between
        return between if rank(between.value) > rank(sampled.value) else sampled

    @cached_property
    def worst_by_phase(self) -> list[dict[str, Extreme]]:
        """The worst values of each phase, at its samples or between them, by name."""
        every: list[dict[str, Extreme]] = [{} for _ in self.parts]
        phases = [*zip(self.result.phases, self.parts, every, strict=True)]
        edges, every_quantity = len(self.result.edges), QUANTITIES.values()
        for q in (q for q in every_quantity if q.by_phase and (edges or not q.of_edges)):
            name, ranks, sampled = q.name, self.worst_ranks(q.name), self.samples_of(q.name)
            alone = name not in self.names_recorded
            for (phase, part, worst), rank in zip(phases, ranks, strict=True):
                x = phase.extremes.get(name)
                if x is not None and (rank == -math.inf or rank < q.rank(_in_unit(q, x))):
                    worst[name] = self.extreme_of(name, x, phase.name)
                elif (e := self.worst_sample(sampled, part, alone=alone)) is not None:
                    worst[name] = e
        return every

    def worst_ranks(self, name: str) -> list[float]:
        """Rank of the worst sample of a quantity in each phase; -infinity if none is finite."""
        if name not in self._worst_ranks:
            rank, worst = self.samples_of(name).rank, np.full(len(self.parts), -np.inf)
            if rank.size:
                starts = self._starts * rank.shape[1]
                worst[self.flown] = np.maximum.reduceat(rank.reshape(-1), starts)
            self._worst_ranks[name] = worst.tolist()
        return self._worst_ranks[name]

    def first_contact(self, name: str, e: Extreme) -> Extreme | None:
        """The first contact of agents ("separation") or with an obstacle ("clearance"), of which e is the worst."""
        if e.value > 0.0:
            return None
        for phase in self.result.phases:
            if (x := phase.extremes.get(f"{name}_first")) is not None:
                return self.extreme_of(f"{name}_first", x, phase.name)
        sampled = self.samples_of(name)
        k = int(np.argmax(sampled.values <= 0.0))
        return self.worst_sample(sampled, slice(k, k + 1), alone=True) or e

    def least_clearances_by_stage(self) -> dict[str, Extreme | None]:
        """Least clearance to obstacles [m] in flight, and of vehicles standing on one at the start or end.

        A vehicle stands on an obstacle below it while it has been within `PAD` of it since the start, or stays so to
        the end.
        """
        time = self.result.time
        clearance, nearest = mask_lost(self.result, self.closeness.each), self.closeness.nearest
        stands = (~(clearance[0] > PAD)).any() or (self.left[-1] & ~(clearance[-1] > PAD)).any()
        if not (stands or self.names_recorded & {"clearance_start", "clearance_end"}):
            # No vehicle ever stands on an obstacle.
            return {"clearance_flight": self.worst("clearance")}
        off, beside = clearance > PAD, np.zeros(clearance.shape, dtype=np.bool_)
        near, below = self.near_and_below
        off[near], beside[near] = ~below.any(axis=0), ~below[nearest[near], np.arange(len(near[0]))]
        first = np.where(off.any(axis=0), off.argmax(axis=0), len(time))
        last = np.where(off.any(axis=0), len(time) - 1 - off[::-1].argmax(axis=0), len(time))
        last = np.where(self.left[-1], last, len(time))  # lost vehicles do not land
        k = np.arange(len(time))[:, None]
        parts = {
            "clearance_start": (k < first) & ~beside,
            "clearance_flight": (k >= first) & (k <= last) | beside,
            "clearance_end": (k >= first) & (k > last) & ~beside,
        }

        def agent_and_obstacle(sample: int, agent: int) -> tuple[int, int]:
            return agent, int(nearest[sample, agent])

        return {
            name: self.worst_among(
                name, Samples(quantity(name), np.where(part, clearance, np.nan), agent_and_obstacle)
            )
            for name, part in parts.items()
        }

    @cached_property
    def near_and_below(self) -> tuple[tuple[Ints, ...], Bools]:
        """Samples (M,) and agents (M,) within `PAD` of an obstacle; on which (B, M) they stand, or may if they stay."""
        k, i = near = np.nonzero(mask_lost(self.result, self.closeness.each) <= PAD)
        r, things = self.result.position[near], self.mission.obstacles
        radius, time = self.mission.fleet.radius[i], self.result.time[k]
        return near, proximity.below(r, radius, things, time, PAD)

    def self_contradictions_and_times(self) -> Iterator[tuple[str, float]]:
        """Values of the record that disagree with its own positions and forces: in words, and when [s]."""
        result, time = self.result, self.result.time
        r = result.position
        rounding = 1e-9 * (1.0 + float(np.fmax.reduce(np.abs(r), axis=None, initial=0.0)))
        stored = {}
        with np.errstate(invalid="ignore"):  # infinity where there is nothing to be near
            for name in ("separation", "clearance"):
                if name in vars(result):  # else it would be made of these very positions
                    stored[name] = getattr(result, name) - getattr(self.closeness, name)
        stored["distance"] = np.abs(proximity.pair_distances(r, result.edges).T - result.distance)
        stored["thrust"] = self.samples_of("thrust").values - result.thrust
        for name, off in stored.items():
            unit, least = ("N", 1e-6) if name == "thrust" else ("m", rounding)
            if (wrong := off > least).any():
                k = int(np.argmax(wrong.reshape(len(time), -1).any(axis=1)))
                worst = float(off[wrong].max())
                words = (
                    f"its {name} is up to {value(worst, unit)} off the value from its own samples"
                )
                yield words, float(time[k])
        ranks = {name: self.worst_ranks(name) for name in _SLACK if name in self.names_recorded}
        for index, phase in enumerate(result.phases):
            part, extremes = self.parts[index], phase.extremes
            if part.stop > part.start and extremes:
                lacking = (x for x in _DUE if x not in extremes and self.needs_extreme(x, index))
                if name := next(lacking, ""):
                    words = f"it lacks the worst '{name}' of phase '{phase.name}' between samples"
                    yield words, float(time[part.start])
            for name, by_phase in ranks.items():
                x, rank = extremes.get(name), by_phase[index]
                if x is None or rank == -math.inf:
                    continue
                slack = rounding + _SLACK[name] * abs(rank)
                if rank > quantity(name).rank(x.value) + slack or not (
                    phase.t_start - 1e-9 <= x.time <= phase.t_end + 1e-9
                ):
                    e = self.worst_sample(self.samples_of(name), part)
                    assert e is not None
                    words = (
                        f"its worst {name} of phase '{phase.name}' is given as {value(x.value)} at {x.time:.2f} s,"
                        f" but a sample shows {value(e.value)}"
                    )
                    yield words, e.when

    def needs_extreme(self, name: str, index: int) -> bool:
        """Whether a phase that has samples has a worst value of a quantity between them."""
        if name == "geofence":
            return self.mission.limits.geofence is not None
        if name != "clearance":
            return self.worst_ranks(name)[index] > -math.inf
        # An obstacle that is there at the start or the end of a phase alone is not in it.
        phase = self.result.phases[index]
        there = (thing.solid.there[0] for thing in self.mission.obstacles)
        return any(a < phase.t_end - 1e-9 and b > phase.t_start + 1e-9 for a, b in there)

    def phase_verdicts(self) -> Iterator[PhaseVerdict]:
        """Numbers of each phase."""
        result, off = self.result, _greatest_sizes(self.result.constraint[self.last])
        constraint_errors = dict(zip(self.flown, off, strict=True))
        for index, record in enumerate(result.phases):
            fit, waypoints = self.fits_at_end.get(index), self.misses_by_waypoint.get(index, {})
            finished = index in self.flown and (result.complete or index < len(result.phases) - 1)
            yield PhaseVerdict(
                **{key: getattr(record, key) for key in _OF_RECORD},
                finished=finished and not record.abandoned,
                constraint=constraint_errors.get(index),
                distances=self.edges_and_errors_at_end.get(index, (None, None))[1],
                shape=None if fit is None else fit.error,
                handedness=None if fit is None or fit.dimension < 3 else not fit.is_mirrored,
                flip=self.axis_errors_at_end.get(index),
                order=None if fit is None else fit.in_order,
                waypoint=waypoints.get("target"),
                stay=waypoints.get("stay"),
                through=tuple(w for what, w in waypoints.items() if what not in _ENDS),
                worst=self.worst_by_phase[index],
            )

    @cached_property
    def _ends_alike(self) -> list[tuple[str, list[int], list[int]]]:
        """Phases that end in one formation of the same vehicles and links: its name, the phases, their last samples."""
        alike: dict[tuple[object, ...], tuple[list[int], list[int]]] = {}
        for index, k in zip(self.flown, self.last, strict=True):
            if (name := self.result.phases[index].formation) is not None:
                lost = np.count_nonzero(self.mission.links_lost[1] < self.result.time[k])
                indices, last = alike.setdefault((name, self.left[k].tobytes(), lost), ([], []))
                indices.append(index)
                last.append(k)
        return [(str(key[0]), *phases) for key, phases in alike.items()]

    @cached_property
    def edges_and_errors_at_end(self) -> dict[int, tuple[Ints, float | None]]:
        """Edges (m, 2) that are not lost at the end of each phase with a formation, and the greatest error [m]."""
        mission, ends = self.mission, {}
        for name, indices, last in self._ends_alike:
            edges, intended = mission.formation_edges(name), mission.formation_distances(name)
            kept = self.left[last[0]][edges].all(axis=1)
            kept &= mission.has_link(edges, float(self.result.time[last[0]]))
            edges = edges[kept]
            off = proximity.pair_distances(self.result.position[last], edges).T - intended[kept]
            ends.update(zip(indices, ((edges, x) for x in _greatest_sizes(off)), strict=True))
        return ends

    @cached_property
    def fits_at_end(self) -> dict[int, Fit]:
        """Fits of the formations at the end of each phase that has one."""
        from rigidfleet.mission.model import part_of_mission  # takes long to load

        mission, fits = self.mission, {}
        for name, indices, last in self._ends_alike:
            left, p = np.flatnonzero(self.left[last[0]]), self.result.position[last]
            shape = part_of_mission(mission, formation_shape, name, *left.tolist())
            known = np.flatnonzero(np.isfinite(p).all(axis=(1, 2))).tolist()
            if shape is not None and known:
                most = mission.formations[name].greatest_error
                each = fits_by_sample(p[known][:, left], shape, left, most)
                fits.update(zip([indices[k] for k in known], each, strict=True))
        return fits

    @cached_property
    def axis_errors_at_end(self) -> dict[int, float | None]:
        """Angle [deg] of a line or plane from its intended direction at the end of each phase that has one."""
        flips, result = {}, self.result
        flat = {index: fit for index, fit in self.fits_at_end.items() if fit.dimension < 3}
        last = [self.parts[index].stop - 1 for index in flat]
        # A commanded attitude decides; without one, the integrated frame says how a plane should lie.
        q = np.array([x[last] for x in (result.attitude_reference, result.frame)])
        turns = att.dcm_from_quaternion(q).swapaxes(0, 1)
        for (index, fit), turn in zip(flat.items(), turns, strict=True):
            # Only tracked slots steer a line; otherwise its direction follows from the shape before.
            steers = 2 if fit.dimension == 2 else result.phases[index].control == "tracking"
            aims = (fit.axis @ turn[:steers]).tolist()
            angles = (degrees_between_vectors(fit.turned_axis, aim) for aim in aims)
            flips[index] = next(filter(math.isfinite, angles), None)
        return flips

    def nearest_sample(self, t: float, index: int) -> int:
        """The sample of a phase flown that is nearest to a time [s]; of two equally near the first."""
        time, part = self.result.time, self.parts[index]
        after = bisect_left(time, t, part.start, part.stop - 1)
        before = max(after - 1, part.start)
        return after if abs(time[after] - t) < abs(time[before] - t) else before

    @cached_property
    def misses_by_waypoint(self) -> dict[int, dict[str, Waypoint]]:
        """Misses of the "target" of each phase, of its place to "stay", and of the points to pass on the way.

        A target is due at its time, or at the end of a phase that settles earlier; of the others, those that the
        flight came to. Where no formation is held, each vehicle has a place of its own: the vehicle furthest from it
        counts.
        """
        result, due = self.result, []
        for index, k in zip(self.flown, self.last, strict=True):
            record = result.phases[index]
            if (result.complete or index < len(result.phases) - 1) and not record.abandoned:
                ends = ((what, getattr(record, what)) for what in _ENDS)
                due += [(index, what, x) for what, x in ends if x is not None]
            points = enumerate((record.target or {}).get("through", ()))
            due += [(index, str(n), x) for n, x in points if x["time"] <= result.time[k]]
        at, rows = [self.nearest_sample(x["time"], index) for index, _, x in due], []
        for name, values in (
            ("position", result.cm), ("velocity", result.cm_velocity), ("attitude", result.attitude),
            ("rates", result.rates),
        ):  # fmt: skip
            unknown = [math.nan] * values.shape[1]
            aims = [unknown if (aim := x.get(name)) is None else aim for *_, x in due]
            aims = np.reshape(aims, (-1, values.shape[1]))
            turned = name == "attitude"
            off = att.angle_between(values[at], aims) if turned else norms(values[at] - aims)
            rows.append(np.degrees(off) if turned or name == "rates" else off)
        misses: dict[int, dict[str, Waypoint]] = {}
        for (index, what, _), k, row in zip(due, at, np.transpose(rows).tolist(), strict=True):
            miss = [x if math.isfinite(x) else None for x in row]
            if miss[0] is not None and what in _ENDS and result.phases[index].formation is None:
                own = float(np.fmax.reduce(self.samples_of("tracking_error").values[k]))
                # With a vehicle lost, the centre of those left says nothing of their places.
                miss[0] = max(miss[0], own) if self.left[k].all() else own
            misses.setdefault(index, {})[what] = Waypoint(result.time.item(k), *miss)
        return misses


def _in_unit(q: Quantity, x: Extremum) -> float:
    """The value of an extreme in the unit of its quantity; of a constraint, its size."""
    return abs(x.value) if q.name == "constraint" else q.scale * x.value


def _greatest_sizes(values: Floats) -> list[float | None]:
    """Greatest finite size of each row of values (G, m); None if there is none."""
    sizes = np.where(np.isfinite(values), np.abs(values), -1.0).max(axis=1, initial=-1.0)
    return [None if size < 0.0 else size for size in sizes.tolist()]
