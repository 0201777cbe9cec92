"""Measurements of a flight: shapes against their slots, waypoints, extremes at samples and between them."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from rigidfleet._common.quantities import QUANTITIES, Quantity, quantity
from rigidfleet.assessment.fits import Fit, angle_between
from rigidfleet.assessment.outcome import Extreme, PhaseVerdict, Waypoint, value
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.result import PAD, Extremum, PhaseRecord, Result
from rigidfleet.result.quantities import (
    SAMPLED,
    Samples,
    closeness,
    owner_name,
    samples,
    without_lost,
)
from rigidfleet.typing import Bools, Floats, Ints

#: Share by which a sample may be worse than the worst value of its phase; beyond it, the record contradicts itself.
#: Forces have no such bound: a peak is searched only where the ends of a step show one, so that a jump of a user's
#: force may be missed.
_SLACK = {"separation": 0.0, "clearance": 0.0, "speed": 1e-9}

#: Quantities of which a phase between samples has a worst value.
_DUE = ("speed", "lowest", "highest", "thrust", "separation", "clearance", "geofence")

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
        #: Phases that have samples.
        self.flown = [k for k, s in enumerate(self.parts) if s.stop > s.start]
        #: Quantities of which the record tells what happens between samples.
        self.names_recorded = set[str]().union(*(p.extremes for p in result.phases))
        self._sampled: dict[str, Samples] = {}

    @cached_property
    def close(self) -> proximity.Closeness:
        """Distances to each other and to obstacles at samples."""
        return closeness(self.result)

    @cached_property
    def of_phases(self) -> dict[str, Samples]:
        """Values at samples of each quantity of which a phase has a worst value."""
        return {q.name: self.samples_of(q.name) for q in QUANTITIES.values() if q.by_phase}

    def rank(self, name: str, index: int) -> float:
        """Greatest rank of a quantity at the samples of a phase; -infinity of a phase without samples."""
        return float(self.of_phases[name].rank[self.parts[index]].max(initial=-np.inf))

    def first_time(self, broken: Bools) -> float:
        """Time [s] of the first sample at which ``broken`` holds; infinity if it never does."""
        return float(self.result.time[int(np.argmax(broken))]) if broken.any() else math.inf

    # -- at samples -----------------------------------------------------------------------------------

    def samples_of(self, name: str) -> Samples:
        """Values of a quantity at samples."""
        if name not in self._sampled:
            close = self.close if name in ("separation", "clearance") else None
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
        return Extreme(_size(q, x), x.time, owner_name(self.result, q, x.who, x.other), phase)

    def worst(self, name: str) -> Extreme | None:
        """The worst value of a flight, at its samples or between them; None if it is not known."""
        known = quantity(name).by_phase or name in SAMPLED
        return self.worst_among(name, self.samples_of(name) if known else None)

    def worst_among(self, name: str, values: Samples | None) -> Extreme | None:
        """The worst value of a flight among some ``values`` at samples, or between them."""
        q = quantity(name)
        rank = q.rank
        every = [(p.extremes[name], p.name) for p in self.result.phases if name in p.extremes]
        worst = max(every, key=lambda each: rank(_size(q, each[0])), default=None)
        between = None if worst is None else self.extreme_of(name, *worst)
        sampled = None if values is None else self.worst_sample(values, alone=between is None)
        if sampled is None or between is None:
            return sampled or between
        return between if rank(between.value) > rank(sampled.value) else sampled

    @cached_property
    def worst_by_phase(self) -> list[dict[str, Extreme]]:
        """The worst values of each phase, at its samples or between them, by name."""
        every: list[dict[str, Extreme]] = [{} for _ in self.parts]
        for name, sampled in self.of_phases.items():
            rank, alone = sampled.quantity.rank, name not in self.names_recorded
            for k, (phase, worst) in enumerate(zip(self.result.phases, every, strict=True)):
                e, x = (
                    self.worst_sample(sampled, self.parts[k], alone=alone),
                    phase.extremes.get(name),
                )
                if x is not None and (e is None or rank(e.value) < rank(x.value)):
                    e = self.extreme_of(name, x, phase.name)
                if e is not None:
                    worst[name] = e
        return every

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

    def clearances(self) -> dict[str, Extreme | None]:
        """Least clearance to obstacles [m] in flight, and of vehicles standing on one at the start or end.

        A vehicle stands on an obstacle below it while it has been within `PAD` of it since the start, or stays so to
        the end.
        """
        time = self.result.time
        clearance, nearest = without_lost(self.result, self.close.each), self.close.nearest
        stands = (~(clearance[0] > PAD)).any() or (self.left[-1] & ~(clearance[-1] > PAD)).any()
        if not (stands or self.names_recorded & {"clearance_start", "clearance_end"}):
            # No vehicle ever stands on an obstacle.
            return {"clearance_flight": self.worst("clearance")}
        off, beside = clearance > PAD, np.zeros(clearance.shape, dtype=np.bool_)
        near = np.nonzero(clearance <= PAD)
        below = self.standing(*near)
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

        def owner(k: int, i: int) -> tuple[int, int]:
            return i, int(nearest[k, i])

        return {
            name: self.worst_among(
                name, Samples(quantity(name), np.where(part, clearance, np.nan), owner)
            )
            for name, part in parts.items()
        }

    def standing(self, k: Ints, i: Ints) -> Bools:
        """On which obstacles (B, M) agents i (M,) stand, or may stand if they stay, at samples k (M,)."""
        r, things = self.result.position[k, i], self.mission.obstacles
        return proximity.below(r, self.mission.fleet.radius[i], things, self.result.time[k], PAD)

    def contradictions(self) -> Iterator[tuple[str, float]]:
        """Values of the record that disagree with its own positions and forces: in words, and when [s]."""
        result, time = self.result, self.result.time
        r = result.position
        rounding = 1e-9 * (1.0 + float(np.nanmax(np.abs(r), initial=0.0)))
        stored = {}
        with np.errstate(invalid="ignore"):  # infinity where there is nothing to be near
            for name in ("separation", "clearance"):
                if name in vars(result):  # else it would be made of these very positions
                    stored[name] = getattr(result, name) - getattr(self.close, name)
        stored["distance"] = np.abs(proximity.lengths(r, result.edges).T - result.distance)
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
        for index, phase in enumerate(result.phases):
            part, extremes = self.parts[index], phase.extremes
            if part.stop > part.start and extremes:
                lacking = (x for x in _DUE if x not in extremes and self.is_due(x, index))
                if name := next(lacking, ""):
                    words = f"it lacks the worst '{name}' of phase '{phase.name}' between samples"
                    yield words, float(time[part.start])
            for name, share in _SLACK.items():
                x, rank = extremes.get(name), self.rank(name, index)
                if x is None or rank == -math.inf:
                    continue
                slack = rounding + share * abs(rank)
                if rank > self.of_phases[name].quantity.rank(x.value) + slack or not (
                    phase.t_start - 1e-9 <= x.time <= phase.t_end + 1e-9
                ):
                    sampled = self.worst_sample(self.of_phases[name], part)
                    assert sampled is not None
                    words = (
                        f"its worst {name.replace('_', ' ')} of phase '{phase.name}' is given as"
                    )
                    words += f" {value(x.value)} at {x.time:.2f} s, but a sample shows {value(sampled.value)}"
                    yield words, sampled.when

    def is_due(self, name: str, index: int) -> bool:
        """Whether a phase that has samples has a worst value of a quantity between them."""
        if name == "geofence":
            return self.mission.limits.geofence is not None
        if name != "clearance":
            return self.rank(name, index) > -math.inf
        # An obstacle that is there at the start or the end of a phase alone is not in it.
        phase = self.result.phases[index]
        there = (thing.solid.there[0] for thing in self.mission.obstacles)
        return any(a < phase.t_end - 1e-9 and b > phase.t_start + 1e-9 for a, b in there)

    def phase(self, index: int, record: PhaseRecord) -> PhaseVerdict:
        """Numbers of a phase."""
        result, flown = self.result, index in self.flown
        finished = flown and (result.complete or index < len(result.phases) - 1)
        finished = finished and not record.abandoned
        fit = self.fits.get(index)
        return PhaseVerdict(
            **{key: getattr(record, key) for key in _OF_RECORD},
            finished=finished,
            constraint=_greatest(result.constraint[self.parts[index].stop - 1]) if flown else None,
            distances=self.edge_error(index),
            shape=None if fit is None else fit.error,
            handedness=None if fit is None or fit.dimension < 3 else not fit.is_mirrored,
            flip=self.flip(index),
            order=None if fit is None else fit.in_order,
            waypoint=self.miss(index, record.target) if finished else None,
            stay=self.miss(index, record.stay) if finished else None,
            through=tuple(self.misses_on_way(index)),
            worst=self.worst_by_phase[index],
        )

    def edge_error(self, index: int) -> float | None:
        """Greatest error [m] of an edge against its formation at the end of a phase; None if it has none."""
        name, k = self.result.phases[index].formation, self.parts[index].stop - 1
        if name is None or index not in self.flown:
            return None
        edges, intended = self.edges(name, k)
        return _greatest(proximity.lengths(self.result.position[k : k + 1], edges)[:, 0] - intended)

    def edges(self, formation: str, k: int) -> tuple[Ints, Floats]:
        """Edges (m, 2) of a formation that are not lost at sample k, and their lengths (m,) [m]."""
        mission = self.mission
        edges, intended = mission.formation_edges(formation), mission.formation_distances(formation)
        kept = self.left[k][edges].all(axis=1)
        kept &= mission.has_link(edges, float(self.result.time[k]))
        return edges[kept], intended[kept]

    @cached_property
    def fits(self) -> dict[int, Fit]:
        """Fits of the formations at the end of each phase."""
        fits = {}
        for index in self.flown:
            name, k = self.result.phases[index].formation, self.parts[index].stop - 1
            slots = None if name is None else self.mission.formation_slots(name)
            end, left = self.result.position[k], np.flatnonzero(self.left[k])
            if name is None or slots is None or len(left) < 2 or not np.isfinite(end).all():
                continue
            fits[index] = fit = Fit(end[left], slots[left])
            fit.pair = left.item(fit.pair[0]), left.item(fit.pair[1])
            fit.limit = self.mission.formations[name].greatest_error(fit.shortest)
        return fits

    def flip(self, index: int) -> float | None:
        """Angle [deg] of a line or plane from its intended direction at the end of a phase that has one."""
        fit, k = self.fits.get(index), self.parts[index].stop - 1
        if fit is None or fit.dimension > 2:
            return None
        # A commanded attitude decides; without one, the integrated frame says how a plane should lie.
        aims = [self.result.attitude_reference[k], self.result.frame[k]]
        if fit.dimension == 1:
            # Only tracked slots steer a line; otherwise its direction follows from the shape before.
            aims = aims[: self.result.phases[index].control == "tracking"]
        angles = (
            angle_between(fit.points, (att.dcm_from_quaternion(q).T @ fit.axis).tolist())
            for q in aims
        )
        return next(filter(math.isfinite, angles), None)

    def nearest_sample(self, t: float, index: int) -> int:
        """The sample of a phase flown that is nearest to a time [s]; of two equally near the first."""
        time, part = self.result.time, self.parts[index]
        after = bisect_left(time, t, part.start, part.stop - 1)
        before = max(after - 1, part.start)
        return after if abs(time[after] - t) < abs(time[before] - t) else before

    def miss(self, index: int, target: dict[str, Any] | None) -> Waypoint | None:
        """Miss of the target of a phase, or of its place to stay at its end; None if it has none.

        A target is due at its time, or at the end of a phase that settles earlier. Where no formation is held, each
        vehicle has a place of its own: the vehicle furthest from it counts.
        """
        if target is None:
            return None
        result, k = self.result, self.nearest_sample(target["time"], index)
        miss: dict[str, float] = {}
        for name, values in (
            ("position", result.cm), ("velocity", result.cm_velocity), ("attitude", result.attitude),
            ("rates", result.rates),
        ):  # fmt: skip
            row, wanted = values[k].tolist(), target.get(name)
            # Where the quantity is asked for, and known.
            if wanted is not None and all(map(math.isfinite, row)):
                turned = name == "attitude"
                miss[name] = (
                    float(att.angle_between(row, wanted)) if turned else math.dist(row, wanted)
                )
        if "position" in miss and result.phases[index].formation is None:
            own = float(np.fmax.reduce(self.samples_of("tracking_error").values[k]))
            # With a vehicle lost, the centre of those left says nothing of their places.
            miss["position"] = max(miss["position"], own) if self.left[k].all() else own
        for name in {"attitude", "rates"} & miss.keys():
            miss[name] = math.degrees(miss[name])
        return Waypoint(
            result.time.item(k), *map(miss.get, ("position", "velocity", "attitude", "rates"))
        )

    def misses_on_way(self, index: int) -> Iterator[Waypoint]:
        """Misses of the points on the way of a phase that the flight came to."""
        result, part = self.result, self.parts[index]
        for point in (result.phases[index].target or {}).get("through", ()):
            if part.stop == part.start or result.time[part.stop - 1] < point["time"]:
                continue
            k = self.nearest_sample(point["time"], index)
            miss, v = math.dist(result.cm[k].tolist(), point["position"]), point.get("velocity")
            off = None if v is None else math.dist(result.cm_velocity[k].tolist(), v)
            yield Waypoint(float(result.time[k]), miss, off, None, None)


def _size(q: Quantity, x: Extremum) -> float:
    """The value of an extreme in the unit of its quantity; of a constraint, its size."""
    return abs(x.value) if q.name == "constraint" else q.scale * x.value


def _greatest(values: Floats) -> float | None:
    """Greatest finite size of values (m,); None if there is none."""
    sizes = np.abs(values[np.isfinite(values)])
    return float(sizes.max()) if sizes.size else None
