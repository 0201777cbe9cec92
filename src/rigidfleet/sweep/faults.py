"""Faults of the day: a late start, a wrong file, a show that is set up askew; and what of a flight they change.

A *geometric* fault moves vehicles on ways that are known: those that a file of the mission, or of others, tells them to
fly. It is judged as `assess` judges trajectories, in continuous time, but only of the vehicles that it moves and of
those that may come near them. Proof that no other comes near: at the same time, a way is no further from its chord
between two knots than its control points from theirs, so that two ways come no nearer to each other than their chords,
less both. A *flown* fault, wind or a loss, changes the mission, which is flown as in any sweep.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rigidfleet._common.quantities import MOTIONS
from rigidfleet._common.reading import READING, Gaps, Interpolation
from rigidfleet._common.text import first_few
from rigidfleet.errors import RigidfleetError
from rigidfleet.math import proximity
from rigidfleet.math.piecewise import Piecewise, common_knots, pad, piece_index, stack_ways
from rigidfleet.mission import Mission, load_mission, mission_names
from rigidfleet.mission.obstacles import Ground
from rigidfleet.mission.values import AgentNumber, Angle, Part, Positive, key
from rigidfleet.sweep.metrics import METRICS
from rigidfleet.sweep.variation import Grid, Variation
from rigidfleet.typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict
    from rigidfleet.result import Result

#: Faults of some vehicles, of the whole show or one vehicle, and those that are flown, with units of their magnitudes.
PARTIAL = {"late": "s", "another": "", "stale": "", "bias": "m"}
SETUP = {"rotated": "deg", "shifted": "m", "mirrored": "deg"}
IN_FLIGHT = {"wind": "m/s", "links": "", "lost": ""}
FAULTS = PARTIAL | SETUP | IN_FLIGHT
#: Agents in a message.
_AGENTS = re.compile(r"\bagent \d+|\bagents \d+(?:, \d+)* and \d+")
_TURN = 2.0 * np.pi

_Sizes = tuple[Positive, ...]
_Counts = tuple[AgentNumber, ...]


class Drill(Part):
    """The table `[drill]` of a sweep file: the magnitudes of each fault; if it names none, all have some."""

    late: _Sizes = key("vehicles start so much later than the others [s]", (0.5, 1, 2, 5))
    another: _Counts = key("from their pads, vehicles fly files of so many numbers on", (1, 2))
    stale: tuple[str, ...] = key("vehicles fly an earlier version: missions, or files", ())
    bias: _Sizes = key("vehicles are off, in horizontal directions of their own [m]", (0.5, 1, 2))
    rotated: _Sizes = key("a vehicle about its pad, the show about its origin [deg]", (1, 3, 10))
    shifted: _Sizes = key("a vehicle or the show, in any horizontal direction [m]", (0.5, 2, 5))
    mirrored: tuple[Angle, ...] = key("the same, at a plane of this bearing [deg]", (0, 90))
    wind: _Sizes = key("wind beyond the forecast, in any horizontal direction [m/s]", (2, 5))
    links: _Counts = key("so many links are lost, each at any time", ())
    lost: _Counts = key("so many vehicles are lost, each at any time", (1,))
    vehicles: _Counts = key("of how many at once late, another, stale and bias are faults", (1, 5))
    trials: AgentNumber = key("trials of each magnitude: other vehicles, directions, times", 20)
    files: tuple[str, ...] = key("files of others that are flown, not those of the mission", ())
    interpolation: Interpolation = key("between samples of files: cubic or linear", "cubic")
    gaps: Gaps = key(
        "times without samples in files, longer than ten usual steps: refuse or bridge", "refuse"
    )
    units: str | None = key("units of a table's columns that do not name theirs: 'ms,mm,deg'")
    axes: str | None = key("where x, y and z of a table point: 'enu', 'ned', ...")
    topic: tuple[str, ...] = key("topics of a log that have positions; default: chosen", ())

    def case_grids(self, n: int) -> list[Variation]:
        """The cases of a show of n vehicles as three grids that go together: a drill is a sweep over them."""
        possible = PARTIAL | SETUP if self.files else FAULTS
        faults, most = self.model_fields_set & FAULTS.keys() or possible.keys(), max_fault_sizes(n)
        some = sorted({min(count, n) for count in self.vehicles})
        counts = dict.fromkeys(PARTIAL, some) | dict.fromkeys(SETUP, sorted({1, n}))
        places = range(1, len(self.stale) + 1)
        cases = [
            (fault, float(size), count)
            for fault in FAULTS
            if fault in faults
            for size in (places if fault == "stale" else getattr(self, fault))
            if fault not in most or size <= most[fault]
            for count in counts.get(fault, [int(size) if fault == "lost" else n])
        ]
        names = "drill.fault", "drill.magnitude", "drill.vehicles"
        columns = zip(names, zip(*cases, strict=True), strict=False)
        return [Grid(path=name, kind="grid", values=x, group="drill") for name, x in columns]

    @property
    def files_digest(self) -> str:
        """A digest of all files that it names; "" if it names none."""
        named = [*map(Path, self.files + self.stale)]
        paths = sorted(p for path in named for p in (path, *path.rglob("*")) if p.is_file())
        return hashlib.sha256(b"".join(p.read_bytes() for p in paths)).hexdigest() if paths else ""

    def with_files_in_folder(self, folder: Path) -> Drill:
        """The same, with files as seen from a folder; names of shipped missions stay."""

        def resolve_file(name: str) -> str:
            return name if name in mission_names() else str((folder / name).resolve())

        named = {key: (*map(resolve_file, getattr(self, key)),) for key in ("stale", "files")}
        return self.model_copy(update={key: x for key, x in named.items() if x})


def max_fault_sizes(n: int) -> dict[str, int]:
    """Of how many vehicles or links at most a key may be in a show of n vehicles."""
    return {"vehicles": n, "another": n - 1, "lost": n - 1, "links": n * (n - 1) // 2}


def names_mission(version: str) -> bool:
    """Whether an earlier version is a mission, which is flown, and no file of trajectories."""
    return version in mission_names() or version.endswith(".toml")


def random_stream(seed: int, *number: int) -> np.random.Generator:
    """Random numbers of a run or of an order of the vehicles."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=number))


def vehicles_of(seed: int, n: int, count: int, trial: int) -> Ints:
    """Which (S,) of n vehicles a fault concerns in a trial: in n / S trials, each of them once."""
    block, place = divmod(trial, n // count)
    order = random_stream(seed, block, 3).permutation(n)
    return np.sort(order[place * count : (place + 1) * count])


def apply_fault(
    document: dict[str, Any], fault: str, size: float, stream: np.random.Generator, n: int, end: float
) -> None:  # fmt: skip
    """Put a fault, if it is flown, into the document of a mission of n vehicles that ends at a time [s]."""
    if fault not in IN_FLIGHT:
        return
    place = "network" if fault == "links" else "disturbances"
    table = document[place] = {**document.get(place, {})}
    if fault == "wind":
        wind = np.array(table.get("wind", (0.0, 0.0, 0.0)))
        wind[:2] += size * _bearings(stream.uniform(0.0, _TURN))[0]
        table["wind"] = wind.tolist()
        return
    key, things = "agent", range(1, n + 1)
    if fault == "links":
        key, things = "between", (1 + proximity.all_pairs(n).T).tolist()
    there = [*table.get("lost", ())]
    rest = [x for x in things if x not in [each[key] for each in there]]
    some = stream.permutation(len(rest))[: int(size)].tolist()
    times = stream.uniform(1e-3 * end, 0.999 * end, len(some)).tolist()
    table["lost"] = there + [{key: rest[k], "time": t} for k, t in zip(some, times, strict=True)]


def _bearings(angle: Any) -> Floats:
    """Unit vectors (S, 2) of bearings (S,) [rad], clockwise from y."""
    return np.column_stack([np.sin(angle), np.cos(angle)])


class GeometricFault(NamedTuple):
    """A geometric fault: its kind and size, the vehicles (S,) concerned, and its random numbers."""

    kind: str
    size: float
    who: Ints
    stream: np.random.Generator


class _Chords(NamedTuple):
    """Ways by their chords between knots.

    Attributes
    ----------
    place : (3, K + 1, N) positions at knots [m]
    sag : (K, N) greatest distance of a way from its chord, at the same time [m]
    move : (N,) greatest distance of a way, between two knots, from where it is at the nearer one [m]
    """

    place: Floats
    sag: Floats
    move: Floats

    @classmethod
    def of(cls, way: Piecewise) -> _Chords:
        """Chords of ways (K, N, 4, P)."""
        points = Piecewise(way.time, pad(way.pieces[:, :, :3], 2)).control_points()
        place = np.concatenate([points[..., 0], points[-1:, ..., -1]])
        share = np.linspace(0.0, 1.0, points.shape[-1])
        points -= place[:-1, ..., None] + np.diff(place, axis=0)[..., None] * share
        sag = np.linalg.norm(points, axis=2).max(axis=-1)
        return cls.through(np.ascontiguousarray(place.transpose(2, 0, 1)), sag)

    @classmethod
    def through(cls, place: Floats, sag: Floats) -> _Chords:
        """Chords through places (3, K + 1, N) [m], with sags (K, N) [m]."""
        step = proximity.root_of_squares(np.diff(place, axis=1)).max(axis=0)
        return cls(place, sag, 0.5 * step + sag.max(axis=0))


class Show:
    """A flight that is drilled: the ways of its vehicles, and what they are judged by.

    Attributes
    ----------
    curve : ways (K, N, 4, P) of x, y, z [m] and yaw [rad]
    how : what these are, in words
    mission : whose radii, limits, fences and obstacles count
    notes : on files, each behind the first of those that are read together

    Raises
    ------
    RigidfleetError
        The flight fails without any fault, or the ways cannot be read.
    """

    def __init__(self, mission: Mission, drill: Drill) -> None:
        from rigidfleet.simulation.trajectories import judging_mission

        self.mission, self.drill, self.n = mission, drill, mission.n_agents
        self.names: tuple[str, ...] = ()
        self.notes: list[str] = []
        self._origin = getattr(mission.geodetic_origin, "geodetic", None)
        self.curve, self.how, verdict, self.names = self._fly_or_read_ways(mission, drill.files)
        if not verdict.passed:
            why = f"the flight fails without any fault: {verdict.failures[0].message}"
            raise RigidfleetError(f"drill: {why}. Mend this first.")
        data = judging_mission(self.curve.pieces[0, :, :3, 0], 1.0, mission=mission).to_dict()
        motions = {q.name for q in MOTIONS}  # which a fault leaves as they are
        data["limits"] = {k: x for k, x in data.get("limits", {}).items() if k not in motions}
        self._data, self.radius, limits = data, mission.fleet.radius, mission.limits
        self.reach = max(limits.separation or 0.0, limits.separation_below or 0.0)
        #: Whether other pairs than the nearest of all may matter.
        self.by_height = bool(limits.separation_below or limits.separation_altitude is not None)
        solid = any(not isinstance(thing, Ground) for thing in mission.obstacles)
        #: Whether it matters where the show is as a whole: flat ground is the same everywhere.
        self.bounded = solid or limits.geofence or mission.fences or mission.people
        self._chords = _Chords.of(self.curve)
        #: Those on other knots, one for each magnitude of a delay: a thousand drills take 28 s with them, 45 s without.
        self._on_knots: dict[bytes, _Chords] = {}
        #: The ways of earlier versions.
        self.versions = [
            self._fly_or_read_ways(load_mission(name), ())[0]
            if names_mission(name)
            else self._fly_or_read_ways(mission, (name,))[0]
            for name in drill.stale
        ]

    def _fly_or_read_ways(
        self, mission: Mission, files: Sequence[str]
    ) -> tuple[Piecewise, str, Verdict, tuple[str, ...]]:
        """Ways of a mission's vehicles, or of those in files; what they are, in words; the verdict; names in files.

        Vehicles of an earlier version are in the order of the show, if they have its names.
        """
        from rigidfleet.assessment import assess
        from rigidfleet.foreign.files import read_trajectories
        from rigidfleet.setpoints import ways_of
        from rigidfleet.simulation.flight import simulate
        from rigidfleet.simulation.trajectories import CURVE_NAMES, result_of_trajectories

        if files:
            how: dict[str, Any] = {name: getattr(self.drill, name) for name in READING}
            read = read_trajectories(files, spans="stand", origin=self._origin, **how)
            self.notes += [f"{files[0]}: {note}." for note in read.notes]
            self._origin = self._origin or read.read[0].get("origin")
            if len(read.curves) != self.n:
                raise RigidfleetError(
                    f"{files[0]}: has {len(read.curves)} vehicles, and the show {self.n}. Give a file of each."
                )
            strange = sorted({*read.names} - {*self.names})
            if 0 < len(strange) < self.n:  # where some names agree, they say whose a file is
                raise RigidfleetError(
                    f"{files[0]}: has {first_few(strange)}, and the show has not. Name the vehicles of both alike."
                )
            if not strange and self.names:
                order = [read.names.index(name) for name in self.names]
                read = read._replace(names=self.names, curves=tuple(read.curves[i] for i in order))
            verdict = assess(result_of_trajectories(read, mission=mission))
            return stack_ways(read.curves), read.assumed, verdict, read.names
        if mission.n_agents != self.n:
            raise RigidfleetError(
                f"drill.stale: {mission.name} has {mission.n_agents} agents, and the show {self.n}. Give an earlier"
                " version of the same show."
            )
        result = simulate(mission)
        motion = result.setpoints_at_samples(flown=False)
        if not np.isfinite(motion.state).all():  # where no slots are tracked, vehicles have no file
            motion = result.setpoints_at_samples(flown=True)
        return ways_of(motion, slice(None)), CURVE_NAMES[7], assess(result), ()

    def measure_fault(self, fault: GeometricFault) -> tuple[dict[str, float | None], str, str]:
        """What was measured of a fault, the checks that it fails, and the first of these in words."""
        from rigidfleet.assessment import assess

        # A show that is moved as a whole changes no distance between its vehicles.
        if fault.kind in SETUP and len(fault.who) == self.n and not self.bounded:
            return {}, "", ""
        result, every = self.flight_of_vehicles_near_fault(fault)
        verdict = assess(result)
        failed = verdict.failures
        worst = {c.check: c.worst for c in verdict.checks if c.judged and c.check in METRICS}
        named = {k: x for k, x in enumerate(self.names) if x.removeprefix("agent ") != f"{k + 1}"}
        who = [f"{k + 1} ({named[k]})" if k in named else f"{k + 1}" for k in every.tolist()]

        def renumber_in_fleet(match: re.Match[str]) -> str:
            return re.sub(r"\d+", lambda number: who[int(number[0]) - 1], match[0])

        words = _AGENTS.sub(renumber_in_fleet, failed[0].message) if failed else ""
        return worst, ", ".join(dict.fromkeys(check.check for check in failed)), words

    def flight_of_vehicles_near_fault(self, fault: GeometricFault) -> tuple[Result, Ints]:
        """The flight of the vehicles of a fault and of all that may come near them, and which (M,) these are."""
        from rigidfleet.simulation.trajectories import result_of_curve

        who = fault.who
        again = np.isin(np.arange(self.n), who)
        way, knots = self.ways_of_faulty_vehicles(fault), self.curve.time
        if not np.array_equal(knots, way.time):
            knots = common_knots([self.curve, way])
        way = way.with_knots(knots, stays=True)
        if fault.kind not in SETUP or not again.all():
            again |= self._possibly_nearest_vehicles(who, _Chords.of(way), knots)
        every = np.flatnonzero(again)
        curve = self._ways_of(every).with_knots(knots, stays=True)
        powers = max(x.pieces.shape[-1] for x in (curve, way))
        pieces = pad(curve.pieces, powers)
        pieces[:, np.isin(every, who)] = pad(way.pieces, powers)
        agents = self._data["agents"]
        own = {key: [agents[key][i] for i in every] for key in ("position", "radius", "mass")}
        data = self._data | {"agents": own}
        if air := data.get("disturbances"):
            data["disturbances"] = air | {"drag": [air["drag"][i] for i in every]}
        mission = Mission.from_plain(data, "drill")
        return result_of_curve(Piecewise(knots, pieces), self.how, mission=mission), every

    def ways_of_faulty_vehicles(self, fault: GeometricFault) -> Piecewise:
        """The ways (K, S, 4, P) that vehicles (S,) fly by a fault, on knots of their own."""
        kind, size, who, stream = fault
        pads, flown, turn, by = self.curve.pieces[0, :, :2, 0], self._ways_of(who), np.eye(2), 0.0
        match kind:
            case "late":
                return flown.shift_time(size)
            case "stale":
                version = self.versions[int(size) - 1]
                return Piecewise(version.time, version.pieces[:, who])
            case "another":
                source = (who + int(size)) % self.n
                flown, by = self._ways_of(source), pads[who] - pads[source]
            case "bias" | "shifted":
                by = size * _bearings(stream.uniform(0.0, _TURN, len(who) if kind == "bias" else 1))
            case "rotated":
                u, v = _bearings(np.radians(size) * stream.choice([-1.0, 1.0]))[0]
                turn = np.array([[v, u], [-u, v]])
            case "mirrored":
                u = _bearings(np.radians(size))
                turn = 2.0 * u.T @ u - turn
        if len(who) < self.n:  # a vehicle turns about its pad, the show about its origin
            by = by + pads[who] - pads[who] @ turn.T
        pieces = flown.pieces.copy()
        pieces[:, :, :2] = np.einsum("ab,ksbp->ksap", turn, pieces[:, :, :2])
        pieces[:, :, :2, 0] += by
        return Piecewise(flown.time, pieces)

    def _possibly_nearest_vehicles(self, who: Ints, own: _Chords, knots: Floats) -> Bools:
        """Which vehicles (N,) may be the nearest to one of those (S,) that fly by other chords, or hit it.

        If distances count by height, these are all that may come nearer than a limit.
        """
        place, sag, move = (x.copy() for x in self._chords_on(knots))
        place[:, :, who], sag[:, who], move[who] = own
        near, least = np.full(self.n, np.inf), self.reach
        for i in who.tolist():
            apart, radii = place - place[:, :, i : i + 1], self.radius + self.radius[i]
            ends = np.sqrt((apart**2).sum(axis=0).min(axis=0)) - radii
            ends[i] = np.inf
            nearest = ends.argmin()
            near[nearest] = -np.inf
            least = least if self.by_height else min(least, max(float(ends[nearest]), 0.0))
            some = np.flatnonzero(ends < least + move + move[i])
            a, d = apart[:, :-1, some], np.diff(apart[:, :, some], axis=1)
            share = -(a * d).sum(axis=0) / np.maximum((d * d).sum(axis=0), 1e-300)
            a += np.clip(share, 0.0, 1.0) * d
            gap = proximity.root_of_squares(a) - sag[:, some] - sag[:, i : i + 1] - radii[some]
            near[some] = np.minimum(near[some], gap.min(axis=0))
        return near < least

    def _chords_on(self, knots: Floats) -> _Chords:
        """Chords of all vehicles on other knots: on a part of a piece, the sag may be twice that of the piece."""
        own = self.curve.time
        if np.array_equal(knots, own):
            return self._chords
        if (key := knots.tobytes()) not in self._on_knots:
            within = np.clip(knots, own[0], own[-1])
            place = np.ascontiguousarray(self.curve.at(within)[:, :, :3].transpose(2, 0, 1))
            middle = 0.5 * (within[:-1] + within[1:])
            sag = 2.0 * self._chords.sag[piece_index(own, middle)]
            self._on_knots[key] = _Chords.through(place, sag)
        return self._on_knots[key]

    def _ways_of(self, who: Ints) -> Piecewise:
        """The ways of some vehicles."""
        return Piecewise(self.curve.time, self.curve.pieces[:, who])


@lru_cache(maxsize=2)
def show_of(text: str, drill: Drill) -> Show:
    """The show of a mission's text: kept, so that it is flown or read once for all faults."""
    return Show(Mission.from_toml(text, "mission of the drill"), drill)
