"""Measurements of a flight: shapes against their slots, waypoints, extremes at samples and between them."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet.assessment.fits import Fit, Laid, angle_between, length
from rigidfleet.assessment.outcome import SENSE, Extreme, PhaseVerdict, Waypoint, value
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.math.bernstein import SIZES
from rigidfleet.result import PAD, Extremum, PhaseRecord, Result
from rigidfleet.typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from rigidfleet.mission.obstacles import Obstacle

#: Share by which a sample may be worse than the worst value of its phase; beyond it, the record contradicts itself.
#: Forces have no such bound: a peak is searched only where the ends of a step show one, so that a jump of a user's
#: force may be missed.
_SLACK = {"separation": 0.0, "clearance": 0.0, "speed": 1e-9}
#: Extremes of pairs of agents, and of edges.
_OF_PAIRS = frozenset(("separation", "separation_below", "separation_flying", "lost"))
_OF_EDGES = frozenset(("tension", "constraint"))


#: The first sample.
_START = np.zeros(1, dtype=np.int64)

#: Numbers from which on a product is shared out over threads.
_PRODUCT = 10_000


class Quantity:
    """Values (K, ...) at samples, with the name of their owner.

    Attributes
    ----------
    rank : of each value (K, places): greater is worse; -infinity if the value is not finite
    most : greatest rank from the start of each phase to that of the next one
    """

    def __init__(self, values: Floats, who: Callable[..., str], rank: Floats, starts: Ints) -> None:
        """Take values with their ranks (K, ...), and the samples at which phases begin."""
        self.values, self.who = values, who
        self.rank, flat = rank.reshape(len(rank), -1), rank.reshape(-1)
        # Of all tests of few numbers a product is the fastest; one of many would wake other threads, for a sum's time.
        if not math.isfinite(flat @ flat if flat.size < _PRODUCT else flat.sum()):
            self.rank = np.where(np.isfinite(self.rank), self.rank, -np.inf)
        places = self.rank.shape[1]
        self.most = [-math.inf] * len(starts)
        if places:
            self.most = np.maximum.reduceat(self.rank.reshape(-1), places * starts).tolist()


def agent(_k: int, i: int) -> str:
    """Name of agent i (from 0), the same at every sample."""
    return f"agent {i + 1}"


def _edge(edges: Ints, _k: int, e: int) -> str:
    """Name of edge e (from 0), the same at every sample."""
    i, j = edges[e].tolist()
    return f"edge {i + 1}-{j + 1}"


def _pair(close: proximity.Closeness, k: int) -> str:
    """The two agents that are nearest to each other at sample k."""
    return agent_names(sorted(close.pair[k].tolist()))


def _obstacle(close: proximity.Closeness, obstacles: Sequence[Obstacle], k: int) -> str:
    """Names of the agent nearest to an obstacle at sample k, and of that obstacle."""
    return _beside(obstacles, close.agent.item(k), close.obstacle.item(k))


def _beside(obstacles: Sequence[Obstacle], agent: int, obstacle: int) -> str:
    return f"agent {agent + 1}, {obstacles[obstacle].name}"


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
        self.told = {name for p in result.phases for name in p.extremes}
        self._formations: dict[str, tuple[Floats | None, Ints, Floats]] = {}
        #: Distances to each other and to obstacles at samples.
        self.close = proximity.closeness(
            result.position,
            self.mission.agents.radius,
            self.mission.obstacles,
            result.time,
            self.left,
        )
        thrust = length(result.input_force, result.constraint_force)
        if self.mission.agents.saturate:
            thrust = np.minimum(thrust, self.mission.agents.thrust_limit)
        if result.rotor_force is not None:  # what was given, not what was asked
            thrust = result.rotor_force.sum(axis=2)
        self.thrust = self.of_left(np.maximum(thrust, result.thrust))
        starts = np.array([self.samples[k].start for k in self.flown])
        constraint, tension = np.abs(result.constraint), -result.multiplier
        speed, acceleration, force = (
            self.of_left(length(x))
            for x in (result.velocity, result.acceleration, result.constraint_force)
        )
        close, single = self.close, result.singular_value
        # Owners know what they need of this object, not the object: no cycle keeps a record that is judged.
        edge, pair = partial(_edge, result.edges), partial(_pair, close)
        obstacle = partial(_obstacle, close, self.mission.obstacles)
        self.measured: dict[str, Quantity] = {
            name: Quantity(values, who, rank, starts)
            for name, values, who, rank in (
                ("constraint", constraint, edge, constraint),
                ("separation", close.separation, pair, -close.separation),
                ("clearance", close.clearance, obstacle, -close.clearance),
                ("thrust", self.thrust, agent, self.thrust),
                ("speed", speed, agent, speed),
                ("acceleration", acceleration, agent, acceleration),
                ("constraint_force", force, agent, force),
                ("tension", tension, edge, np.abs(tension)),
                ("singular_value", single, lambda k: "", -single),
            )
        }
        #: Greatest rank of each quantity at the samples of each phase; -infinity of phases without samples.
        self.rank = {name: [-math.inf] * len(result.phases) for name in self.measured}
        for name, quantity in self.measured.items():
            for k, rank in zip(self.flown, quantity.most, strict=True):
                self.rank[name][k] = rank
        #: The last sample of each phase flown, and positions (F, N, 3) there.
        self.last = [self.samples[k].stop - 1 for k in self.flown]
        self.ends = result.position[self.last]

    def of_left(self, values: Floats) -> Floats:
        """Values (K, N), NaN for lost agents."""
        return values if self.whole else np.where(self.left, values, np.nan)

    def beside(self, agent: int, obstacle: int) -> str:
        """Names of an agent and an obstacle, both counted from 0."""
        return _beside(self.mission.obstacles, agent, obstacle)

    def first(self, broken: Bools) -> float:
        """Time [s] of the first sample at which ``broken`` holds; infinity if it never does."""
        return float(self.result.time[int(np.argmax(broken))]) if broken.any() else math.inf

    def extreme(
        self, values: Floats, who: Callable[..., str], sense: Callable[..., Any] = lambda x: x
    ) -> Extreme | None:
        """The finite one of ``values`` (K, ...) whose ``sense`` is greatest."""
        rank = np.ascontiguousarray(sense(values))
        return self.worst_sample(Quantity(values, who, rank, _START), slice(0, len(values)))

    def worst_sample(
        self, quantity: Quantity, samples: slice, *, alone: bool = False
    ) -> Extreme | None:
        """The worst value of a quantity among some samples; None if none is finite.

        ``alone``: nothing is known between them.
        """
        rank, values, result = quantity.rank[samples], quantity.values, self.result
        if not rank.size:
            return None
        k, place = divmod(int(rank.argmax()), rank.shape[1])
        if rank.item(k, place) == -math.inf:
            return None
        k += samples.start
        at = (k,) if values.ndim == 1 else (k, place)
        phase = result.phases[result.phase.item(k)].name
        return Extreme(values.item(at), result.time.item(k), quantity.who(*at), phase, alone)

    # -- between samples ------------------------------------------------------------------------------

    def between(self, name: str, index: int) -> Extreme | None:
        """The recorded extreme of a phase in continuous time; None if the record has none."""
        phase = self.result.phases[index]
        x = phase.extremes.get(name)
        return None if x is None else self.recorded(name, x, phase.name)

    def recorded(self, name: str, x: Extremum, phase: str) -> Extreme:
        """An extreme of a phase, as it was recorded."""
        if name.removesuffix("_first") in _OF_PAIRS:
            who = agent_names(sorted((x.who, x.other)))
        elif name in _OF_EDGES:
            who = f"edge {x.who + 1}-{x.other + 1}"
        elif name.startswith("clearance"):
            who = self.beside(x.who, x.other)
        else:
            who = f"agent {x.who + 1}"
        return Extreme(abs(x.value) if name == "constraint" else x.value, x.time, who, phase)

    def worst(
        self, name: str, sampled: Extreme | None, sense: Callable[..., Any] = lambda x: x
    ) -> Extreme | None:
        """The worst value of a flight, at its samples or between them."""
        every = {
            k: sense(p.extremes[name].value)
            for k, p in enumerate(self.result.phases)
            if name in p.extremes
        }
        between = self.between(name, max(every, key=every.__getitem__)) if every else None
        if between is None:
            return None if sampled is None else replace(sampled, at_samples=True)
        if sampled is None:
            return between
        return between if sense(between.value) > sense(sampled.value) else sampled

    @cached_property
    def worst_of(self) -> list[dict[str, Extreme]]:
        """The worst values of each phase, at its samples or between them, by name."""
        found: list[dict[str, Extreme]] = [{} for _ in self.samples]
        for name, quantity in self.measured.items():
            sense, ranks, alone = SENSE[name], self.rank[name], name not in self.told
            for k, phase in enumerate(self.result.phases):
                x, rank, worst = phase.extremes.get(name), ranks[k], None
                if x is not None and rank < sense(x.value):
                    worst = self.recorded(name, x, phase.name)
                elif rank != -math.inf:
                    worst = self.worst_sample(quantity, self.samples[k], alone=alone)
                if worst is not None:
                    found[k][name] = worst
        return found

    def directed(self, name: str) -> Extreme | None:
        """Greatest speed or acceleration in a direction, named as in `DIRECTIONS`; None if unknown."""
        way, what = name.split("_")
        x = getattr(self.result, what.replace("speed", "velocity"))
        return self.worst(name, self.extreme(self.of_left(SIZES[way](x)), agent))

    def first_contact(self, name: str, e: Extreme) -> Extreme | None:
        """The first contact of agents ("separation") or with an obstacle ("clearance"), of which e is the worst."""
        if e.value > 0.0:
            return None
        every = [k for k, p in enumerate(self.result.phases) if f"{name}_first" in p.extremes]
        if every:
            return self.between(f"{name}_first", every[0])
        quantity = self.measured[name]
        k = int(np.argmax(quantity.values <= 0.0))
        return self.worst_sample(quantity, slice(k, k + 1), alone=True) or e

    def below(self) -> Extreme | None:
        """Least height [m] between two agents, one below the other."""
        least, pair = proximity.headroom(
            self.result.position, self.mission.agents.radius, self.left
        )
        sampled = self.extreme(least, lambda k: agent_names(pair[k]), lambda x: -x)
        return self.worst("separation_below", sampled, lambda x: -x)

    def outside(self, low: Floats, high: Floats) -> Extreme | None:
        """Greatest distance [m] of an agent's centre outside a box with these corners; negative inside."""
        r = self.result.position
        beyond = self.of_left(np.maximum(low - r, r - high).max(axis=2))
        return self.worst("geofence", self.extreme(beyond, agent))

    def height(self, *, lowest: bool) -> Extreme | None:
        """Least or greatest altitude [m] of an agent's centre."""
        z, sense = (
            self.of_left(self.result.position[..., 2]),
            np.negative if lowest else np.positive,
        )
        name = "lowest" if lowest else "highest"
        return self.worst(name, self.extreme(z, agent, sense), sense)

    def nearest_to_limit(self) -> Extreme | None:
        """Thrust minus limit [N] of the agent nearest to its own limit, or furthest beyond it."""
        most = self.mission.fleet.thrust_limit
        return self.worst("thrust_margin", self.extreme(self.thrust - most, agent))

    def clearances(self) -> dict[str, Extreme | None]:
        """Least clearance to obstacles [m] in flight, and of vehicles standing on one at the start or end.

        A vehicle stands on an obstacle below it while it has been within `PAD` of it since the start, or stays so to
        the end.
        """
        time = self.result.time
        clearance, nearest = self.of_left(self.close.each), self.close.nearest
        stands = (~(clearance[0] > PAD)).any() or (self.left[-1] & ~(clearance[-1] > PAD)).any()
        if not (stands or self.told & {"clearance_start", "clearance_end"}):
            # No vehicle ever stands on an obstacle.
            return {"clearance_flight": self.worst_clearance()}
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
        found = {}
        for name, part in parts.items():
            values = np.where(part, clearance, np.nan)
            sampled = self.extreme(
                values, lambda k, i: self.beside(i, int(nearest[k, i])), lambda x: -x
            )
            found[name] = self.worst(name, sampled, lambda x: -x)
        return found

    def standing(self, k: Ints, i: Ints) -> Bools:
        """On which obstacles (B, M) agents i (M,) stand, or may stand if they stay, at samples k (M,)."""
        r, things = self.result.position[k, i], self.mission.obstacles
        return proximity.below(r, self.mission.fleet.radius[i], things, self.result.time[k], PAD)

    def worst_clearance(self) -> Extreme | None:
        """Least clearance to an obstacle [m] of all vehicles, standing ones included."""
        q = self.measured["clearance"]
        sampled = self.worst_sample(q, slice(0, len(q.values)))
        return self.worst("clearance", sampled, SENSE["clearance"])

    def fallen_on(self) -> Extreme | None:
        """Least clearance [m] between a lost agent and one still flying; None if no agent is lost."""
        r, radius = self.result.position, self.mission.fleet.radius
        least, who = np.full(len(r), np.nan), np.zeros((len(r), 2), dtype=np.int64)
        for i in np.flatnonzero(~self.left[-1]):
            separation = np.linalg.norm(r - r[:, [i]], axis=2) - radius - radius[i]
            separation = np.where(self.left & ~self.left[:, [i]], separation, np.inf)
            j = separation.argmin(axis=1)
            separation = np.where(self.left[:, i], np.nan, separation[np.arange(len(r)), j])
            closer = np.fmin(separation, least) != least
            closer &= np.isfinite(separation)
            least[closer] = separation[closer]
            who[closer] = np.column_stack([np.full(len(r), i), j])[closer]
        sampled = self.extreme(least, lambda k: agent_names(who[k]), lambda x: -x)
        return self.worst("lost", sampled, lambda x: -x)

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
            "distance": (self.off_lengths, "m"),
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
                    "separation": np.count_nonzero(self.left[samples.start]) > 1,
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
                if rank > SENSE[name](x.value) + slack or not (
                    phase.t_start - 1e-9 <= x.time <= phase.t_end + 1e-9
                ):
                    sampled = self.worst_sample(self.measured[name], samples)
                    assert sampled is not None
                    words = (
                        f"its worst {name.replace('_', ' ')} of phase '{phase.name}' is given as"
                    )
                    words += f" {value(x.value)} at {x.time:.2f} s, but a sample shows {value(sampled.value)}"
                    yield words, sampled.when

    @property
    def off_lengths(self) -> Floats:
        """Greatest size (K,) [m] by which a recorded length of an edge differs from that between positions."""
        r, edges, given = self.result.position, self.result.edges, self.result.distance
        greatest = np.zeros(len(r))
        some = max(1, proximity.CACHED * len(r) // r.size)  # of some samples at a time
        for k in range(0, len(r), some):
            part = slice(k, k + some)
            off = proximity.lengths(r[part], edges)
            off -= given[part].T
            np.fmax.reduce(np.abs(off, out=off), axis=0, initial=0.0, out=greatest[part])
        return greatest

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
            constraint=self.constraints.get(index),
            distances=self.distances.get(index),
            shape=None if fit is None else fit.error,
            handedness=None if fit is None or fit.dimension < 3 else not fit.mirrored,
            flip=self.flips.get(index),
            order=None if fit is None else fit.in_order,
            waypoint=self.misses.get(("target", index)) if finished else None,
            stay=self.misses.get(("stay", index)) if finished else None,
            through=tuple(self.passed(index)),
            worst=self.worst_of[index],
        )

    @cached_property
    def constraints(self) -> dict[int, float | None]:
        """Greatest |c| [m] of an edge at the end of each phase flown."""
        return dict(zip(self.flown, _greatest(self.result.constraint[self.last]), strict=True))

    @cached_property
    def distances(self) -> dict[int, float | None]:
        """Greatest error [m] of an edge against its formation at the end of each phase that has one."""
        alike: dict[str, list[int]] = {}
        for i, k in enumerate(self.flown):
            if (name := self.result.phases[k].formation) is not None:
                alike.setdefault(name, []).append(i)
        found: dict[int, float | None] = {}
        for name, every in alike.items():
            # Some edges may be lost later
            for group in [every] if self._same_edges else [[i] for i in every]:
                edges, intended = self.edges(name, self.last[group[0]])
                off = (proximity.lengths(self.ends[group], edges) - intended[:, None]).T
                found |= zip([self.flown[i] for i in group], _greatest(off), strict=True)
        return found

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
        """Fits of the formations at the end of each phase; those of equally many agents are computed at once."""
        alike: dict[int, list[tuple[int, Floats, Floats, Ints | None]]] = {}
        known = np.atleast_1d(np.isfinite(self.ends).all(axis=(1, 2)))
        for index, end, finite in zip(self.flown, self.ends, known, strict=True):
            name = self.result.phases[index].formation
            slots = None if name is None else self.formation(name)[0]
            if slots is None or not finite:
                continue
            one = index, end, slots, None
            if not self.whole:
                left = np.flatnonzero(self.left[self.samples[index].stop - 1])
                one = index, end[left], slots[left], left
            if len(one[1]) > 1:
                alike.setdefault(len(one[1]), []).append(one)
        fits = {}
        for group in alike.values():
            laid = Laid(np.array([p for _, p, *_ in group]), np.array([s for *_, s, _ in group]))
            for k, (index, p, slots, left) in enumerate(group):
                fit = fits[index] = Fit(p, slots, left, laid, k)
                form = self.mission.formations[self.result.phases[index].formation or ""]
                fit.limit = form.greatest_error(fit.shortest)
        return fits

    @cached_property
    def flips(self) -> dict[int, float]:
        """Angle [deg] of a line or plane from its intended direction at the end of each phase that has one."""
        flat = {k: fit for k, fit in self.fits.items() if fit.dimension in (1, 2)}
        if not flat:
            return {}
        # A commanded attitude decides; without one, the integrated frame says how a plane should lie.
        last = [self.samples[k].stop - 1 for k in flat]
        q = np.array([self.result.attitude_reference[last], self.result.frame[last]])
        axes = np.array([fit.axis for fit in flat.values()])
        aims = (att.dcm_from_quaternion(q).swapaxes(2, 3) @ axes[..., None])[..., 0]
        found = {}
        for i, (k, fit) in enumerate(flat.items()):
            some = aims[:, i].tolist()
            if fit.dimension == 1:
                # Only tracked slots steer a line; otherwise its direction follows from the shape before.
                some = some[:1] if self.result.phases[k].control == "tracking" else []
            angles = (angle_between(fit.points, aim) for aim in some)
            angle = next(filter(math.isfinite, angles), None)
            if angle is not None:
                found[k] = angle
        return found

    def nearest(self, t: float, index: int) -> int:
        """The sample of a phase flown that is nearest to a time [s]; of two equally near the first."""
        time, samples = self.result.time, self.samples[index]
        after = bisect_left(time, t, samples.start, samples.stop - 1)
        before = max(after - 1, samples.start)
        return after if abs(time[after] - t) < abs(time[before] - t) else before

    @cached_property
    def misses(self) -> dict[tuple[str, int], Waypoint]:
        """Miss of the ``target`` of each phase that has one, and of its place to ``stay`` at its end.

        A target is due at its time, or at the end of a phase that settles earlier. Where no formation is held, each
        vehicle has a place of its own: the vehicle furthest from it counts.
        """
        result = self.result
        targets = [
            ((what, k), x)
            for k in self.flown
            for what in ("target", "stay")
            if (x := getattr(result.phases[k], what)) is not None
        ]
        if not targets:
            return {}
        at = [self.nearest(target["time"], k) for (_, k), target in targets]
        miss: dict[str, dict[int, float]] = {}
        for name, values in (
            ("position", result.cm), ("velocity", result.cm_velocity), ("attitude", result.attitude),
            ("rates", result.rates),
        ):  # fmt: skip
            rows = values[at].tolist()
            # Where the quantity is asked for, and known.
            asked = {
                i: wanted for i, ((_, target), row) in enumerate(zip(targets, rows, strict=True))
                if (wanted := target.get(name)) is not None and all(map(math.isfinite, row))
            }  # fmt: skip
            rows = [rows[i] for i in asked]
            if name == "attitude" and rows:
                off = np.degrees(att.angle_between(rows, [*asked.values()])).tolist()
            else:
                off = map(math.dist, rows, asked.values())
            miss[name] = dict(zip(asked, off, strict=True))
        for i, off in miss["position"].items():
            if result.phases[targets[i][0][1]].formation is None:
                own = float(np.fmax.reduce(self.off_slot[at[i]]))
                # With a vehicle lost, the centre of those left says nothing of their places.
                miss["position"][i] = max(off, own) if self.left[at[i]].all() else own
        return {
            k: Waypoint(
                time=t,
                position=miss["position"].get(i),
                velocity=miss["velocity"].get(i),
                attitude=miss["attitude"].get(i),
                rates=math.degrees(miss["rates"][i]) if i in miss["rates"] else None,
            )
            for i, ((k, _), t) in enumerate(zip(targets, result.time[at].tolist(), strict=True))
        }

    @cached_property
    def off_slot(self) -> Floats:
        """Distance (K, N) [m] of each vehicle from its slot; NaN where slots are not tracked."""
        return self.of_left(length(self.result.position - self.result.slot_position))

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


def _greatest(values: Floats) -> list[float | None]:
    """Greatest finite size of each row of values (G, m); None if there is none."""
    sizes = np.abs(values)
    if not sizes.shape[1]:
        return [None] * len(sizes)
    return [
        most if math.isfinite(most) else max(filter(math.isfinite, row.tolist()), default=None)
        for most, row in zip(sizes.max(axis=1).tolist(), sizes, strict=True)
    ]
