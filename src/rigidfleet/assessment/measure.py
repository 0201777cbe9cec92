"""Measurements of a flight: shapes against their slots, waypoints, extremes at samples and between them."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from rigidfleet._common.quantities import QUANTITIES, quantity
from rigidfleet.assessment.fits import Fit, angle_between
from rigidfleet.assessment.outcome import Extreme, PhaseVerdict, Waypoint, value
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.result import PAD, Extremum, PhaseRecord, Result
from rigidfleet.result.quantities import (
    SAMPLED,
    Samples,
    closeness,
    length,
    owner_name,
    samples,
    without_lost,
)
from rigidfleet.typing import Bools, Floats, Ints

#: Share by which a sample may be worse than the worst value of its phase; beyond it, the record contradicts itself.
#: Forces have no such bound: a peak is searched only where the ends of a step show one, so that a jump of a user's
#: force may be missed.
_SLACK = {"separation": 0.0, "clearance": 0.0, "speed": 1e-9}


class Measurements:
    """Measures a result phase by phase, at samples (recomputed from positions and forces) and between them."""

    def __init__(self, result: Result) -> None:
        self.result, self.mission = result, result.mission
        self.left = result.left
        self.whole = bool(self.left.all())
        #: Samples of each phase.
        ends = np.searchsorted(result.phase, np.arange(len(result.phases) + 1))
        self.samples = [slice(*pair) for pair in pairwise(ends.tolist())]
        #: Phases that have samples.
        self.flown = [k for k, s in enumerate(self.samples) if s.stop > s.start]
        #: Quantities of which the record tells what happens between samples.
        self.told = set[str]().union(*(p.extremes for p in result.phases))
        self._formations: dict[str, tuple[Floats | None, Ints, Floats]] = {}
        self._sampled: dict[str, Samples] = {}
        #: Distances to each other and to obstacles at samples.
        self.close = closeness(result)
        self.measured = {q.name: self.sampled(q.name) for q in QUANTITIES.values() if q.by_phase}
        self.thrust = self.measured["thrust"].values
        #: Greatest rank of each quantity at the samples of each phase; -infinity of phases without samples.
        self.rank = {name: [-math.inf] * len(result.phases) for name in self.measured}
        starts = np.array([self.samples[k].start for k in self.flown])
        for name, sampled in self.measured.items():
            if places := sampled.rank.shape[1]:
                most = np.maximum.reduceat(sampled.rank.reshape(-1), places * starts).tolist()
                for k, rank in zip(self.flown, most, strict=True):
                    self.rank[name][k] = rank

    def first(self, broken: Bools) -> float:
        """Time [s] of the first sample at which ``broken`` holds; infinity if it never does."""
        return float(self.result.time[int(np.argmax(broken))]) if broken.any() else math.inf

    # -- at samples -----------------------------------------------------------------------------------

    def sampled(self, name: str) -> Samples:
        """Values of a quantity at samples."""
        if name not in self._sampled:
            self._sampled[name] = samples(self.result, name, self.close)
        return self._sampled[name]

    def worst_sample(
        self, samples: Samples, part: slice = slice(None), *, alone: bool = False
    ) -> Extreme | None:
        """The worst of some values; None if none is finite. ``alone``: nothing is known between them."""
        rank, values, result = samples.rank[part], samples.values, self.result
        if not rank.size:
            return None
        k, place = divmod(int(rank.argmax()), rank.shape[1])
        if rank.item(k, place) == -math.inf:
            return None
        k += part.start or 0
        at = (k,) if values.ndim == 1 else (k, place)
        phase, who = result.phases[result.phase.item(k)].name, samples.owner(*at)
        return Extreme(
            values.item(at),
            result.time.item(k),
            owner_name(result, samples.quantity, *who),
            phase,
            alone,
        )

    # -- between samples ------------------------------------------------------------------------------

    def between(self, name: str, index: int) -> Extreme | None:
        """The recorded extreme of a phase in continuous time; None if the record has none."""
        phase = self.result.phases[index]
        x = phase.extremes.get(name)
        return None if x is None else self.recorded(name, x, phase.name)

    def recorded(self, name: str, x: Extremum, phase: str) -> Extreme:
        """An extreme of a phase, as it was recorded."""
        q = quantity(name)
        size = abs(x.value) if name == "constraint" else q.scale * x.value
        return Extreme(size, x.time, owner_name(self.result, q, x.who, x.other), phase)

    def worst(self, name: str) -> Extreme | None:
        """The worst value of a flight, at its samples or between them; None if it is not known."""
        if name in self.measured:
            every = [worst[name] for worst in self.worst_of if name in worst]
            rank = QUANTITIES[name].rank
            return max(every, key=lambda e: rank(e.value), default=None)
        return self.among(name, self.sampled(name) if name in SAMPLED else None)

    def among(self, name: str, samples: Samples | None) -> Extreme | None:
        """The worst value of a flight among some ``samples``, or between them."""
        rank = quantity(name).rank
        every = {
            k: rank(p.extremes[name].value)
            for k, p in enumerate(self.result.phases)
            if name in p.extremes
        }
        between = self.between(name, max(every, key=every.__getitem__)) if every else None
        sampled = None if samples is None else self.worst_sample(samples, alone=between is None)
        if sampled is None or between is None:
            return sampled or between
        return between if rank(between.value) > rank(sampled.value) else sampled

    @cached_property
    def worst_of(self) -> list[dict[str, Extreme]]:
        """The worst values of each phase, at its samples or between them, by name."""
        found: list[dict[str, Extreme]] = [{} for _ in self.samples]
        for name, sampled in self.measured.items():
            ranks, alone = self.rank[name], name not in self.told
            for k, phase in enumerate(self.result.phases):
                x, rank, worst = phase.extremes.get(name), ranks[k], None
                if x is not None and rank < sampled.quantity.rank(x.value):
                    worst = self.recorded(name, x, phase.name)
                elif rank != -math.inf:
                    worst = self.worst_sample(sampled, self.samples[k], alone=alone)
                if worst is not None:
                    found[k][name] = worst
        return found

    def first_contact(self, name: str, e: Extreme) -> Extreme | None:
        """The first contact of agents ("separation") or with an obstacle ("clearance"), of which e is the worst."""
        if e.value > 0.0:
            return None
        every = [k for k, p in enumerate(self.result.phases) if f"{name}_first" in p.extremes]
        if every:
            return self.between(f"{name}_first", every[0])
        sampled = self.sampled(name)
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
        if not (stands or self.told & {"clearance_start", "clearance_end"}):
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
            name: self.among(
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
        reach = float(max(r.max(initial=0.0), -r.min(initial=0.0)))
        if math.isnan(reach):
            reach = float(np.nanmax(np.abs(r), initial=0.0))
        rounding = 1e-9 * (1.0 + reach)
        stored = {}
        with np.errstate(invalid="ignore"):  # infinity where there is nothing to be near
            for name in ("separation", "clearance"):
                if name in vars(result):  # else it would be made of these very positions
                    stored[name] = getattr(result, name) - getattr(self.close, name), "m"
        stored |= {
            "distance": (
                np.abs(proximity.lengths(r, result.edges).T - result.distance),
                "m",
            ),
            "thrust": (self.thrust - result.thrust, "N"),
        }
        for name, (off, unit) in stored.items():
            wrong = off > (rounding if unit == "m" else 1e-6)
            if wrong.any():
                k = int(np.argmax(wrong.reshape(len(time), -1).any(axis=1)))
                worst = float(off[wrong].max())
                words = (
                    f"its {name} is up to {value(worst, unit)} off the value from its own samples"
                )
                yield words, float(time[k])
        there = [thing.solid.there[0].tolist() for thing in self.mission.obstacles]
        fenced = self.mission.limits.geofence is not None
        for index, phase in enumerate(result.phases):
            samples, extremes = self.samples[index], phase.extremes
            if samples.stop > samples.start and extremes:
                due = {
                    "speed": True,
                    "lowest": True,
                    "highest": True,
                    "thrust": self.rank["thrust"][index] > -math.inf,
                    "separation": result.n_agents > 1
                    and (self.whole or np.count_nonzero(self.left[samples.start]) > 1),
                    "clearance": _meets(there, phase),
                    "geofence": fenced,
                }
                lacking = [name for name, needed in due.items() if needed and name not in extremes]
                if lacking:
                    words = (
                        f"it lacks the worst '{lacking[0]}' of phase '{phase.name}' between samples"
                    )
                    yield words, float(time[samples.start])
            for name, share in _SLACK.items():
                x, rank = extremes.get(name), self.rank[name][index]
                if x is None or rank == -math.inf:
                    continue
                slack = rounding + share * abs(rank)
                if rank > quantity(name).rank(x.value) + slack or not (
                    phase.t_start - 1e-9 <= x.time <= phase.t_end + 1e-9
                ):
                    sampled = self.worst_sample(self.measured[name], samples)
                    assert sampled is not None
                    words = (
                        f"its worst {name.replace('_', ' ')} of phase '{phase.name}' is given as"
                    )
                    words += f" {value(x.value)} at {x.time:.2f} s, but a sample shows {value(sampled.value)}"
                    yield words, sampled.when

    def phase(self, index: int, record: PhaseRecord) -> PhaseVerdict:
        """Numbers of a phase."""
        result, samples = self.result, self.samples[index]
        flown = samples.stop > samples.start
        finished = flown and (result.complete or index < len(result.phases) - 1)
        finished = finished and not record.abandoned
        fit = self.fits.get(index)
        return PhaseVerdict(
            name=record.name,
            kind=record.kind,
            control=record.control,
            formation=record.formation,
            t_start=record.t_start,
            t_end=record.t_end,
            settled=record.settled,
            finished=finished,
            constraint=_greatest(result.constraint[samples.stop - 1]) if flown else None,
            distances=self.edge_error(index) if flown else None,
            shape=None if fit is None else fit.error,
            handedness=None if fit is None or fit.dimension < 3 else not fit.mirrored,
            flip=self.flip(index),
            order=None if fit is None else fit.in_order,
            waypoint=self.miss(index, record.target) if finished else None,
            stay=self.miss(index, record.stay) if finished else None,
            through=tuple(self.passed(index)),
            worst=self.worst_of[index],
        )

    def edge_error(self, index: int) -> float | None:
        """Greatest error [m] of an edge against the formation at the end of a phase flown; None without one."""
        name, k = self.result.phases[index].formation, self.samples[index].stop - 1
        if name is None:
            return None
        (edges, intended), r = self.edges(name, k), self.result.position[k]
        return _greatest(length(r[edges[:, 0]] - r[edges[:, 1]]) - intended)

    @property
    def _same_edges(self) -> bool:
        """Whether no edge of a formation is ever lost."""
        return self.whole and not len(self.mission.links_lost[1])

    def edges(self, formation: str, k: int) -> tuple[Ints, Floats]:
        """Edges (m, 2) of a formation that are not lost at sample k, and their lengths (m,) [m]."""
        _, edges, intended = self.formation(formation)
        if self._same_edges:
            return edges, intended
        kept = self.left[k][edges].all(axis=1)
        kept &= self.mission.linked(edges, float(self.result.time[k]))
        return edges[kept], intended[kept]

    def formation(self, name: str) -> tuple[Floats | None, Ints, Floats]:
        """Slots (N, 3) [m] of a formation (None if unknown), its edges (m, 2) and their lengths (m,) [m]."""
        if name not in self._formations:
            m = self.mission
            self._formations[name] = (
                m.formation_slots(name), m.formation_edges(name), m.formation_distances(name)
            )  # fmt: skip
        return self._formations[name]

    @cached_property
    def fits(self) -> dict[int, Fit]:
        """Fits of the formations at the end of each phase."""
        fits = {}
        for index in self.flown:
            k, name = self.samples[index].stop - 1, self.result.phases[index].formation
            slots = None if name is None else self.formation(name)[0]
            p, left = self.result.position[k], np.flatnonzero(self.left[k])
            if name is None or slots is None or len(left) < 2 or not np.isfinite(p).all():
                continue
            fit = fits[index] = Fit(p[left], slots[left], left)
            fit.limit = self.mission.formations[name].greatest_error(fit.shortest)
        return fits

    @cached_property
    def turns(self) -> dict[int, Floats]:
        """Matrices (2, 3, 3) from the slots' axes to how they should lie at the end of each phase flown.

        A commanded attitude decides; without one, the integrated frame says how a plane should lie.
        """
        last = [self.samples[k].stop - 1 for k in self.flown]
        q = np.stack([self.result.attitude_reference[last], self.result.frame[last]], axis=1)
        return dict(zip(self.flown, att.dcm_from_quaternion(q).swapaxes(2, 3), strict=True))

    def flip(self, index: int) -> float | None:
        """Angle [deg] of a line or plane from its intended direction at the end of a phase that has one."""
        fit = self.fits.get(index)
        if fit is None or fit.dimension not in (1, 2):
            return None
        aims = (self.turns[index] @ fit.axis).tolist()
        if fit.dimension == 1:
            # Only tracked slots steer a line; otherwise its direction follows from the shape before.
            aims = aims[:1] if self.result.phases[index].control == "tracking" else []
        angles = (angle_between(fit.points, aim) for aim in aims)
        return next(filter(math.isfinite, angles), None)

    def nearest(self, t: float, index: int) -> int:
        """The sample of a phase flown that is nearest to a time [s]; of two equally near the first."""
        time, samples = self.result.time, self.samples[index]
        after = bisect_left(time, t, samples.start, samples.stop - 1)
        before = max(after - 1, samples.start)
        return after if abs(time[after] - t) < abs(time[before] - t) else before

    def miss(self, index: int, target: dict[str, Any] | None) -> Waypoint | None:
        """Miss of the target of a phase, or of its place to stay at its end; None without one.

        A target is due at its time, or at the end of a phase that settles earlier. Where no formation is held, each
        vehicle has a place of its own: the vehicle furthest from it counts.
        """
        if target is None:
            return None
        result, k = self.result, self.nearest(target["time"], index)
        off: dict[str, float] = {}
        for name, values in (
            ("position", result.cm), ("velocity", result.cm_velocity), ("attitude", result.attitude),
            ("rates", result.rates),
        ):  # fmt: skip
            x, wanted = values[k], target.get(name)
            if wanted is None or not all(map(math.isfinite, x.tolist())):
                continue
            if name == "attitude":
                off[name] = math.degrees(att.angle_between(x, np.array(wanted)))
            else:
                off[name] = math.dist(x.tolist(), wanted)
        if "position" in off and result.phases[index].formation is None:
            own = float(np.fmax.reduce(self.sampled("tracking_error").values[k]))
            # With a vehicle lost, the centre of those left says nothing of their places.
            off["position"] = max(off["position"], own) if self.left[k].all() else own
        if "rates" in off:
            off["rates"] = math.degrees(off["rates"])
        return Waypoint(
            result.time.item(k),
            *(off.get(x) for x in ("position", "velocity", "attitude", "rates")),
        )

    def passed(self, index: int) -> Iterator[Waypoint]:
        """Misses of the points on the way of a phase that the flight came to."""
        result, samples = self.result, self.samples[index]
        for point in (result.phases[index].target or {}).get("through", ()):
            if samples.stop == samples.start or result.time[samples.stop - 1] < point["time"]:
                continue
            k = self.nearest(point["time"], index)
            miss, v = math.dist(result.cm[k].tolist(), point["position"]), point.get("velocity")
            off = None if v is None else math.dist(result.cm_velocity[k].tolist(), v)
            yield Waypoint(float(result.time[k]), miss, off, None, None)


def _meets(there: list[list[float]], phase: PhaseRecord) -> bool:
    """Whether an obstacle is there during a phase, not only at its start or end, of all ``there`` from when to when."""
    return any(a < phase.t_end - 1e-9 and b > phase.t_start + 1e-9 for a, b in there)


def _greatest(values: Floats) -> float | None:
    """Greatest finite size of values (m,); None if there is none."""
    sizes = np.abs(values[np.isfinite(values)])
    return float(sizes.max()) if sizes.size else None
