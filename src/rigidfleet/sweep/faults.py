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
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, Strict

from rigidfleet._common.quantities import MOTIONS
from rigidfleet.errors import RigidfleetError
from rigidfleet.math import proximity
from rigidfleet.math.piecewise import Piecewise, common_knots, join, pad, piece_at
from rigidfleet.mission import Mission, load_mission, mission_names
from rigidfleet.mission.obstacles import Ground
from rigidfleet.mission.values import Part, Positive
from rigidfleet.sweep.variation import Grid
from rigidfleet.typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict

#: Number of vehicles up to which all that a fault moves are judged again; of more, those near others or a fence.
_FEW = 30
#: Faults of a part of the vehicles, of the whole show or one vehicle, and faults that are flown.
PARTIAL = "late", "another", "stale", "bias"
SETUP = "rotated", "shifted", "mirrored"
FLOWN = "wind", "links", "lost"
#: Units of magnitudes; "" for numbers of things.
UNITS = {
    "late": "s", "another": "", "stale": "", "bias": "m", "rotated": "deg", "shifted": "m", "mirrored": "deg",
    "wind": "m/s", "links": "", "lost": "",
}  # fmt: skip
#: Magnitudes of a drill that names no fault.
_SCAN: dict[str, tuple[float, ...]] = {
    "late": (0.5, 1.0, 2.0, 5.0), "another": (1, 2), "rotated": (1.0, 3.0, 10.0), "shifted": (0.5, 2.0, 5.0),
    "mirrored": (0.0, 90.0), "bias": (0.5, 1.0, 2.0), "wind": (2.0, 5.0), "lost": (1,),
}  # fmt: skip
_AGENTS = re.compile(r"\bagent \d+|\bagents \d+(?:, \d+)* and \d+")

_Sizes = tuple[Positive, ...]
_Counts = tuple[Annotated[int, Strict(), Field(ge=1, le=10**6)], ...]
_Bearings = tuple[Annotated[float, Strict(), Field(ge=-360, le=360)], ...]


class Drill(Part):
    """The table `[drill]` of a sweep file: the magnitudes of each fault. Without any, all faults have some."""

    late: _Sizes = Field((), description="vehicles start so much later than the others [s]")
    another: _Counts = Field(
        (), description="vehicles fly, from their own pads, the files of those so many numbers on"
    )
    stale: tuple[str, ...] = Field(
        (), description="vehicles fly an earlier version: missions or files of trajectories"
    )
    bias: _Sizes = Field(
        (), description="vehicles are off by so much, each in a horizontal direction of its own [m]"
    )
    rotated: _Sizes = Field(
        (), description="the show about its origin, or one vehicle about its pad, either way [deg]"
    )
    shifted: _Sizes = Field(
        (), description="the show, or one vehicle, in any horizontal direction [m]"
    )
    mirrored: _Bearings = Field(
        (),
        description="the same, mirrored at the vertical plane of this bearing, clockwise from y [deg]",
    )
    wind: _Sizes = Field(
        (), description="wind beyond the forecast, from any horizontal direction [m/s]"
    )
    links: _Counts = Field((), description="so many links are lost, each at any time")
    lost: _Counts = Field((), description="so many vehicles are lost, each at any time")
    vehicles: _Counts = Field(
        (1, 5),
        description="of how many vehicles at a time late, another, stale and bias are faults",
    )
    trials: Annotated[int, Strict(), Field(ge=1, le=10**6)] = Field(
        20,
        description="how often each magnitude is tried, with other vehicles, directions and times",
    )
    files: tuple[str, ...] = Field(
        (), description="trajectories of others that are flown, instead of the mission's"
    )

    def problem(self, n: int) -> tuple[str, str, str] | None:
        """Key, problem and remedy of what cannot be drilled with n vehicles; None if all can."""
        for key in FLOWN:
            if self.files and getattr(self, key):
                return key, "needs a mission that is flown", "remove it, or files"
        for key, most in (
            ("vehicles", n),
            ("another", n - 1),
            ("lost", n - 1),
            ("links", n * (n - 1) // 2),
        ):
            if (values := getattr(self, key)) != Drill().vehicles and max(values, default=0) > most:
                return key, f"is more than {most}, with {n} vehicles", "give a smaller number"
        return None

    def cases(self, n: int) -> list[tuple[str, float, int]]:
        """Fault, magnitude and number of vehicles of each case, for a show of n; of a stale file, its place."""
        own = {k: x for k in UNITS if (x := getattr(self, k))}
        scan = own or {k: x for k, x in _SCAN.items() if not (self.files and k in FLOWN)}
        sizes = {k: range(1, len(x) + 1) if k == "stale" else x for k, x in scan.items()}
        some = [k for k in self.vehicles if k <= n]
        counts = {**dict.fromkeys(PARTIAL, some), **dict.fromkeys(SETUP, [n, 1] if n > 1 else [1])}
        return [
            (fault, float(size), count)
            for fault, every in sizes.items()
            for size in every
            for count in counts.get(fault, [n if fault == "wind" else int(size)])
            if n > 1 or fault not in ("another", "links", "lost")
        ]

    def grids(self, n: int) -> list[Grid]:
        """The cases as three grids that go together: a drill is a sweep over them."""
        columns = zip(*self.cases(n), strict=True)
        names = "fault", "magnitude", "vehicles"
        return [
            Grid(path=f"drill.{name}", kind="grid", values=values, group="drill")
            for name, values in zip(names, columns, strict=True)
        ]

    @property
    def digest(self) -> str:
        """A digest of all files that it names; "" if it names none."""
        paths = [
            p
            for name in (*self.files, *self.stale)
            for p in sorted([Path(name), *Path(name).rglob("*")])
        ]
        whole = hashlib.sha256()
        for path in paths:
            whole.update(path.read_bytes() if path.is_file() else b"")
        return whole.hexdigest() if paths else ""


def with_files_of(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A table `[drill]` whose files, as seen from a folder, have whole paths; names of shipped missions stay."""

    def whole(name: Any) -> Any:
        shipped = not isinstance(name, str) or name in mission_names()
        return name if shipped else str((folder / name).resolve())

    named = {key: table[key] for key in ("stale", "files") if isinstance(table.get(key), list)}
    return table | {key: [whole(name) for name in names] for key, names in named.items()}


def stream_of(seed: int, run: int) -> np.random.Generator:
    """Random numbers of a run of a drill."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run, 2)))


def some_of(seed: int, n: int, count: int, trial: int) -> Ints:
    """Which (S,) of n vehicles a fault concerns in a trial: over n / S trials, every vehicle once."""
    block, place = divmod(trial, n // count)
    order = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(block, 3))).permutation(n)
    return np.sort(order[place * count : (place + 1) * count])


def disturb(
    document: dict[str, Any],
    fault: str,
    size: float,
    stream: np.random.Generator,
    n: int,
    end: float,
) -> None:
    """Put a fault that is flown into the document of a mission of n vehicles that ends at a time [s]."""
    table = document["disturbances"] = {**document.get("disturbances", {})}
    if fault == "wind":
        gust = size * np.append(_heading(stream.uniform(0.0, 2.0 * np.pi)), 0.0)
        table["wind"] = (np.array(table.get("wind", (0.0, 0.0, 0.0))) + gust).tolist()
        return
    times = stream.uniform(1e-3 * end, 0.999 * end, int(size)).tolist()
    if fault == "links":
        table["links"] = links = {**table.get("links", {})}
        known = [sorted(each["between"]) for each in links.get("lost", ())]
        pairs = [pair for pair in (1 + proximity.all_pairs(n).T).tolist() if pair not in known]
        some = stream.permutation(len(pairs))[: int(size)].tolist()
        new = [{"between": pairs[k], "time": t} for k, t in zip(some, times, strict=False)]
        links["lost"] = [*links.get("lost", ()), *new]
    else:
        known = [each["agent"] for each in table.get("lost", ())]
        some = [i for i in (1 + stream.permutation(n)).tolist() if i not in known]
        new = [{"agent": i, "time": t} for i, t in zip(some, times, strict=False)]
        table["lost"] = [*table.get("lost", ()), *new]


def _heading(angle: Any) -> Floats:
    """Unit vectors (S, 2) of bearings (S,) [rad], clockwise from y."""
    return np.column_stack([np.sin(angle), np.cos(angle)])


class _Chords(NamedTuple):
    """Ways by their chords between knots.

    Attributes
    ----------
    place : (3, K + 1, N) positions at knots [m]
    sag : (K, N) greatest distance of a way from its chord, at the same time [m]
    """

    place: Floats
    sag: Floats

    @classmethod
    def of(cls, way: Piecewise) -> _Chords:
        """Chords of ways (K, N, 4, P)."""
        points = Piecewise(way.time, pad(way.pieces[:, :, :3], 2)).bernstein()
        place = np.concatenate([points[..., 0], points[-1:, ..., -1]])
        along = place[:-1, ..., None] + np.diff(place, axis=0)[..., None] * np.linspace(
            0.0, 1.0, points.shape[-1]
        )
        sag = np.linalg.norm(points - along, axis=2).max(axis=-1)
        return cls(np.ascontiguousarray(place.transpose(2, 0, 1)), sag)


class Moved(NamedTuple):
    """The ways of vehicles by a fault: those of a flight, moved over the ground, and begun later.

    Attributes
    ----------
    who : (S,) the vehicles
    source : (S,) of which vehicles they fly the ways
    turn : (2, 2) rotation or reflection of x and y
    shift : (S, 2) then added to x and y [m]
    delay : by which they begin later [s]
    version : place of the earlier version that they fly, from 1; 0: that of the show
    """

    who: Ints
    source: Ints
    turn: Floats
    shift: Floats
    delay: float = 0.0
    version: int = 0

    @property
    def as_one(self) -> bool:
        """Whether they keep their distances."""
        own = not self.version and np.array_equal(self.source, self.who)
        return own and not np.ptp(self.shift, axis=0).any()

    def ways(self, curve: Piecewise) -> Piecewise:
        """The same of ways (K, S, 4, P) of the sources."""
        pieces = curve.pieces.copy()
        pieces[:, :, :2] = np.einsum("ab,ksbp->ksap", self.turn, pieces[:, :, :2])
        pieces[:, :, :2, 0] += self.shift
        return Piecewise(curve.time + self.delay, pieces)


def _gaps(a: Floats, b: Floats) -> Floats:
    """Least distance (...) of points that move straight from a to b (3, ...) from the origin."""
    d = b - a
    share = -(a * d).sum(axis=0) / np.maximum((d * d).sum(axis=0), 1e-300)
    a += np.clip(share, 0.0, 1.0) * d
    return proximity.root_of_squares(a)


class Show:
    """A flight that is drilled: the ways of its vehicles, and what they are judged by.

    Attributes
    ----------
    curve : ways (K, N, 4, P) of x, y, z [m] and yaw [rad]
    mission : whose radii, limits, fences and obstacles count
    how : what the curve is, in words

    Raises
    ------
    RigidfleetError
        The flight fails without any fault, or the ways cannot be read.
    """

    def __init__(self, mission: Mission, drill: Drill) -> None:
        from rigidfleet.simulation.trajectories import judged_as

        self.drill, self.n = drill, mission.n_agents
        self.curve, self.how, verdict = _ways(mission, drill.files)
        if self.curve.pieces.shape[1] != self.n:
            have = self.curve.pieces.shape[1]
            raise RigidfleetError(
                f"drill: files have {have} vehicles, and {mission.name} {self.n}. Give those of one show."
            )
        if not verdict.passed:
            failed = next(check.message for check in verdict.checks if not check.passed)
            raise RigidfleetError(
                f"drill: the flight fails without any fault: {failed}. Mend this first."
            )
        # A fault leaves motions as they are.
        data = judged_as(
            self.curve.at(self.curve.time[:1])[0, :, :3], 1.0, mission=mission
        ).to_dict()
        motions = {q.name for q in MOTIONS}
        data["limits"] = {k: x for k, x in data.get("limits", {}).items() if k not in motions}
        self.mission, self._data = mission, data
        self.radius = mission.fleet.radius
        limits = mission.limits
        self.reach = max(limits.separation or 0.0, limits.separation_below or 0.0)
        #: Coefficients (P, N, 4, K): arithmetic on long rows is fast.
        self._rows = np.ascontiguousarray(self.curve.pieces.transpose(3, 1, 2, 0))
        self._chords = _Chords.of(self.curve)
        self._on_knots: dict[bytes, _Chords] = {}  # one for each magnitude of a delay

    @cached_property
    def _versions(self) -> list[Piecewise]:
        """The ways of earlier versions."""
        versions = []
        for name in self.drill.stale:
            mission = name in mission_names() or Path(name).suffix == ".toml"
            curve, *_ = _ways(
                load_mission(name) if mission else self.mission, () if mission else (name,)
            )
            if curve.pieces.shape[1] != self.n:
                have = curve.pieces.shape[1]
                raise RigidfleetError(
                    f"stale: {name} has {have} vehicles, and the show {self.n}. Name a version with as many."
                )
            versions.append(curve)
        return versions

    def outcome(
        self, fault: str, size: float, who: Ints, stream: np.random.Generator
    ) -> tuple[dict[str, float], str, str]:
        """What was measured of a fault of vehicles (S,), the checks that it fails, and the first of these in words."""
        verdict, every = self.verdict(self.moved_by(fault, size, who, stream))
        if verdict is None:
            return {}, "", ""
        failed = [check for check in verdict.checks if not check.passed]
        reason = ", ".join(dict.fromkeys(check.check for check in failed))
        worst = {c.check: c.worst for c in verdict.checks if c.judged and c.worst is not None}

        def in_fleet(match: re.Match[str]) -> str:
            return re.sub(r"\d+", lambda number: str(every[int(number[0]) - 1] + 1), match[0])

        return worst, reason, _AGENTS.sub(in_fleet, failed[0].message) if failed else ""

    def moved_by(self, fault: str, size: float, who: Ints, stream: np.random.Generator) -> Moved:
        """What a fault makes of the ways of vehicles (S,)."""
        pads, turn, by = self.curve.pieces[0, :, :2, 0], np.eye(2), np.zeros((len(who), 2))
        match fault:
            case "late":
                return Moved(who, who, turn, by, delay=size)
            case "stale":
                return Moved(who, who, turn, by, version=int(size))
            case "another":
                source = (who + int(size)) % self.n
                return Moved(who, source, turn, pads[who] - pads[source])
            case "bias" | "shifted":
                angles = stream.uniform(0.0, 2.0 * np.pi, len(who) if fault == "bias" else 1)
                return Moved(who, who, turn, by + size * _heading(angles))
            case "rotated":
                u, v = _heading(np.radians(size) * stream.choice([-1.0, 1.0]))[0]
                turn = np.array([[v, u], [-u, v]])
            case "mirrored":
                u = _heading(np.radians(size))
                turn = 2.0 * u.T @ u - turn
        if len(who) < self.n:  # one vehicle about its pad, the show about its origin
            by = pads[who] - pads[who] @ turn.T
        return Moved(who, who, turn, by)

    def verdict(self, moved: Moved) -> tuple[Verdict | None, Ints]:
        """The verdict if vehicles fly other ways, and the vehicles (M,) that it is on; None if nothing can change.

        These are all that may come near each other, or near a fence, by the other ways.
        """
        from rigidfleet.assessment import assess
        from rigidfleet.simulation.trajectories import of_curve

        who, source = moved.who, moved.source
        flown = self._versions[moved.version - 1] if moved.version else self.curve
        knots = self.curve.time
        if moved.delay or moved.version:
            knots = common_knots([self.curve, flown.later(moved.delay)])
            own = _Chords.of(self._ways_by(moved, np.ones(len(who), dtype=np.bool_), knots))
        else:
            place = self._chords.place[:, :, source]
            flat = np.tensordot(moved.turn, place[:2], 1) + moved.shift.T[:, None]
            own = _Chords(np.concatenate([flat, place[2:]]), self._chords.sag[:, source])
        again = np.zeros(self.n, dtype=np.bool_)
        again[who] = True if len(who) <= _FEW else self._beside_fences(who, own)
        # A show that is moved as a whole changes no distance between its vehicles.
        whole = moved.as_one and len(who) == self.n
        if not whole:
            self._add_near(again, who, own, knots)
        every = np.flatnonzero(again)
        if not len(every):
            return None, every
        if len(every) == 1:  # a separation is of two
            every = np.unique([*every, (every[0] + 1) % self.n])
        mine = np.isin(who, every)
        pieces = self._some(every).on(knots, stays=True).pieces
        other = self._ways_by(moved, mine, knots).pieces
        powers = max(pieces.shape[-1], other.shape[-1])
        pieces = pad(pieces, powers)
        pieces[:, np.isin(every, who)] = pad(other, powers)
        result = of_curve(Piecewise(knots, pieces), self.how, mission=self._mission_of(every))
        return assess(result), every

    def _ways_by(self, moved: Moved, some: Bools, knots: Floats) -> Piecewise:
        """The ways by a fault of some (S,) of the vehicles that it moves, on knots."""
        source, flown = moved.source[some], self._some(moved.source[some])
        if moved.version:
            stale = self._versions[moved.version - 1]
            flown = Piecewise(stale.time, stale.pieces[:, source])
        part = moved._replace(source=source, shift=moved.shift[some])
        return part.ways(flown).on(knots, stays=True)

    def _beside_fences(self, who: Ints, own: _Chords) -> Bools:
        """Which vehicles (S,) may come to a fence or an obstacle: flat ground is as far as it was."""
        margin = np.full(own.sag.shape[1], np.inf)
        fence = self.mission.limits.geofence
        things = [thing for thing in self.mission.obstacles if not isinstance(thing, Ground)]
        if fence is None and not things:
            return margin <= 0.0
        reach = 0.5 * np.linalg.norm(np.diff(own.place, axis=1), axis=0) + own.sag
        reach = np.maximum(reach, np.roll(reach, 1, axis=0))
        reach = np.concatenate([reach, reach[-1:]])
        place = own.place.transpose(1, 2, 0)
        if fence is not None:
            margin = np.minimum(place - fence.min, np.array(fence.max) - place).min(axis=2) - reach
            margin = margin.min(axis=0)
        if any(thing.solid.moves for thing in things):
            return np.ones(len(margin), dtype=np.bool_)
        away, _ = proximity.obstacle_clearances(place, self.radius[who], things)
        margin = np.minimum(margin, (away - reach).min(axis=0))
        return margin <= 0.0

    def _add_near(self, again: Bools, who: Ints, own: _Chords, knots: Floats) -> None:
        """Add to those that are judged ``again`` (N,) who may come near one that moves, and who is nearest."""
        place, sag = (x.copy() for x in self._chords_on(knots))
        place[:, :, who], sag[:, who] = own
        if len(who) > _FEW:
            self._add_near_of_many(again, who, place, sag)
            return
        step = np.linalg.norm(np.diff(place, axis=1), axis=0).max(axis=0) + 2.0 * sag.max(axis=0)
        for i in who.tolist():
            apart = place - place[:, :, i : i + 1]
            radii = self.radius + self.radius[i]
            ends = np.sqrt((apart**2).sum(axis=0).min(axis=0)) - radii
            ends[i] = np.inf
            again[int(ends.argmin())] = True
            # Between two knots neither moves further than half of a step from the nearer one.
            near = np.flatnonzero(ends - 0.5 * (step + step[i]) < self.reach)
            some = apart[:, :, near]
            gap = _gaps(some[:, :-1], some[:, 1:]) - sag[:, near] - sag[:, i : i + 1]
            again[near[gap.min(axis=0) - radii[near] < self.reach]] = True

    def _add_near_of_many(self, again: Bools, who: Ints, place: Floats, sag: Floats) -> None:
        """The same, if many vehicles move: a tree tells which two are near in each interval."""
        from scipy.spatial import KDTree

        moved = np.isin(np.arange(self.n), who)
        widest = self.reach + 2.0 * self.radius.max()
        for k in range(len(sag)):
            a, b = place[:, k], place[:, k + 1]
            step = b - a
            half = 0.5 * np.linalg.norm(step - step.mean(axis=1, keepdims=True), axis=0) + sag[k]
            tree = KDTree((0.5 * (a + b)).T, balanced_tree=False, compact_nodes=False)
            i, j = tree.query_pairs(widest + 2.0 * half.max(), output_type="ndarray").T
            i, j = (x[moved[i] | moved[j]] for x in (i, j))
            gap = _gaps(a[:, j] - a[:, i], b[:, j] - b[:, i]) - sag[k, i] - sag[k, j]
            near = gap - self.radius[i] - self.radius[j] < self.reach
            again[i[near]] = again[j[near]] = True

    def _chords_on(self, knots: Floats) -> _Chords:
        """Chords of all vehicles on other knots: on a part of a piece, the sag may be twice that of the piece."""
        own = self.curve.time
        if np.array_equal(knots, own):
            return self._chords
        if (key := knots.tobytes()) not in self._on_knots:
            within = np.clip(knots, own[0], own[-1])
            place = np.ascontiguousarray(self.curve.at(within)[:, :, :3].transpose(2, 0, 1))
            middle = 0.5 * (within[:-1] + within[1:])
            self._on_knots[key] = _Chords(place, 2.0 * self._chords.sag[piece_at(own, middle)])
        return self._on_knots[key]

    def _some(self, who: Ints) -> Piecewise:
        """The ways of some vehicles."""
        return Piecewise(self.curve.time, self._rows[:, who].transpose(3, 1, 2, 0))

    def _mission_of(self, who: Ints) -> Mission:
        """What some of the vehicles are judged by."""
        agents = self.mission.agents
        own = {
            key: [getattr(agents, key)[i] for i in who] for key in ("position", "radius", "mass")
        }
        return Mission.from_plain(self._data | {"agents": own}, "drill")


@lru_cache(maxsize=2)
def show_of(text: str, drill: Drill) -> Show:
    """The show of a mission's text: flown or read once for all faults."""
    return Show(Mission.from_toml(text, "mission of the drill"), drill)


def _ways(mission: Mission, files: Sequence[str]) -> tuple[Piecewise, str, Verdict]:
    """Ways (K, N, 4, P) of a mission's vehicles, or of those in files; what they are, in words; and the verdict."""
    from rigidfleet.assessment import assess
    from rigidfleet.simulation.trajectories import NAMES, of_curves

    if files:
        from rigidfleet.foreign.files import read_trajectories

        read = read_trajectories(files, spans="stand")
        return join(read.curves), read.assumed, assess(of_curves(read, mission=mission))
    from rigidfleet.setpoints import ways_of
    from rigidfleet.simulation.flight import simulate

    result = simulate(mission)
    motion = result.motion(flown=False)
    if not np.isfinite(motion.state).all():  # where no slots are tracked, vehicles have no file
        motion = result.motion(flown=True)
    return ways_of(motion, slice(None)), NAMES[7], assess(result)
