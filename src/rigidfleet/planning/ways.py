"""Ways found round obstacles: a phase of kind "go" becomes ordinary phases that fly, turn and change the formation.

The search (`rigidfleet.planning.lattice`) takes the formation as it is first, then the mission's other formations,
then smaller ones, then more attitudes. What it finds is shortened, written as phases, and proved in time along the
planned reference of every vehicle (`rigidfleet.planning.clearance`). If the proof fails, more room is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, cast

import numpy as np

from rigidfleet._common.progress import report_step
from rigidfleet.errors import Finding, MissionError
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.mission import Mission
from rigidfleet.mission.kinds import ANGLES, Go
from rigidfleet.mission.values import AUTO
from rigidfleet.planning import layers
from rigidfleet.planning.clearance import clearance_to, speed_bounds
from rigidfleet.planning.lattice import FreeSpace, Layer, Roadmap, Stops, constant_path
from rigidfleet.planning.legs import Leg, latest_end, state_at_start
from rigidfleet.planning.preview import FEWEST_SAMPLES, sample_leg, samples_per_phase
from rigidfleet.solids.records import box_corners, swept_extent
from rigidfleet.typing import Floats

#: The legs of a mission's first phases up to a number, with their automatic times known, of which some are known.
LegsUpTo = Callable[[Mission, int, Sequence[Leg]], list[Leg]]

#: Greatest speed at the start of a way [m/s]: what regulators leave.
_REST = 0.1
#: Number of agents up to which each is a ball of the search; more are covered by one.
_EACH = 60
#: Least and greatest number of even coordinates along an axis.
_EVEN = (4, 8)
#: Yaws of the last search [deg], and how often a way is asked for more room after a failed proof.
_YAWS, _TRIES = range(0, 360, 30), 4
#: Cost of a way, over the straight one, up to which other shapes are not tried; number of shapes for more yaws.
_SHORT, _FEW = 1.2, 6
#: Room that the search keeps beyond what is asked for [m]: rounded places, and the accuracy of the proof.
_KEPT = 2e-3


def find_ways(
    mission: Mission, legs: Sequence[Leg], legs_up_to: LegsUpTo
) -> tuple[Mission, list[Leg]]:
    """Return the mission with each phase of kind "go" replaced by those of a way; itself if it has none.

    The result is an ordinary mission: it can be written, read and flown by itself. Beside it are the legs of its first
    phases, which are proved, after those that there are.

    Raises
    ------
    MissionError
        There is no way, none was found that can be proved, or a phase cannot begin one.
    """
    while (k := next((k for k, p in enumerate(mission.phases) if p.replaced), None)) is not None:  # fmt: skip
        legs = legs_up_to(mission, k, legs)
        if len(legs) < k:
            raise error_of_key(mission, k, "kind", "go", "begins where distances alone have led",
                               "give the formation a shape or slots")  # fmt: skip
        mission, legs = _Search(mission, legs, legs_up_to).mission_with_way_and_legs()
    return mission, [*legs]


class _Search:
    """The search for the way of one phase, from where the legs before it end."""

    def __init__(self, mission: Mission, legs: Sequence[Leg], legs_up_to: LegsUpTo) -> None:
        self.mission, self.legs, self.legs_up_to = mission, legs, legs_up_to
        self.phase = phase = cast("Go", mission.phases[len(legs)])
        self.now = now = legs[-1].planned_end_state if legs else state_at_start(mission)
        self.mistake = mistake = partial(error_of_key, mission, len(legs))
        if now.formation is None or now.slots is None:
            remedy = "add a phase of kind 'establish' before"
            raise mistake("kind", "go", "needs a formation that flies there", remedy)
        speed = float(np.linalg.norm(now.v, axis=1).max())
        if speed > _REST:
            problem = f"begins at {speed:.2g} m/s, but a way begins at rest"
            raise mistake("kind", "go", problem, "end the phase before at rest")
        masses = mission.fleet.mass
        pose = now.goal
        T = np.eye(3) if pose is None else pose.T
        self.begin = masses @ now.r / masses.sum() if pose is None else pose.r
        self.end = np.array(phase.position)
        roll, pitch, yaw = (float(round(x, 6)) for x in np.rad2deg(att.euler_from_dcm(T)))
        self.start = (roll, pitch, yaw)
        self.goal = self.start if phase.attitude_deg is None else phase.attitude_deg
        self.shapes = list(layers.candidate_shapes(mission, phase, now.formation))
        most = max(float(np.linalg.norm(s.slots, axis=1).max()) for s in self.shapes)
        self.reach = most + float(mission.fleet.radius.max())
        self.each = mission.n_agents <= _EACH
        self.radius = mission.fleet.radius if self.each else np.array([self.reach])

    # -- what there is to choose from ------------------------------------------------------------------

    def _near_obstacles_at_rest(self) -> list[Any]:
        """Obstacles at rest that may stand in the way."""
        low, high = self._search_box
        low, high = low - self.reach - 1.0, high + self.reach + 1.0
        still = ((x, *swept_extent(x.solid)) for x in self.mission.obstacles if not x.solid.moves)
        return [x for x, a, b in still if (a <= high).all() and (b >= low).all()]

    @property
    def _search_box(self) -> Floats:
        """Lowest and highest place (2, 3) [m] of the centre of mass that is looked at."""
        ends = np.array([self.begin, self.end])
        low, high = ends.min(axis=0), ends.max(axis=0)
        around = float(np.linalg.norm(high - low)) + 4.0 * self.reach
        room = np.array([low - around, high + around])
        for thing in self.mission.obstacles:
            a, b = swept_extent(thing.solid)
            if not thing.solid.moves and (a <= room[1]).all() and (b >= room[0]).all():
                low = np.minimum(low, np.maximum(a, room[0]))
                high = np.maximum(high, np.minimum(b, room[1]))
        beside = 2.0 * self.reach + 2.0 * self.phase.clearance
        return np.array([low - beside, high + beside])

    # -- the search ------------------------------------------------------------------------------------

    def mission_with_way_and_legs(self) -> tuple[Mission, list[Leg]]:
        """The mission with the way's phases in place of this one, and the legs of its phases to the end of the way."""
        need = self.phase.clearance + _KEPT
        for _ in range(_TRIES):
            best = self._stops_of_cheapest_way(need)
            mission, legs, lacking = self._mission_legs_and_shortfall(*best)
            if lacking <= 0.0:
                return mission, legs
            need += lacking + _KEPT
        problem = f"finds a way, but its proof lacks {lacking:.3f} m of clearance: {self._worst}"
        remedy = "give more time, or ask for less clearance"
        raise self.mistake("clearance", self.phase.clearance, problem, remedy)

    def _stops_of_cheapest_way(self, need: float) -> tuple[Roadmap, Stops]:
        """The way of least cost among shapes: more shapes, and then more yaws, as long as there is no short one."""
        best: tuple[Roadmap, Stops] | None = None
        straight = float(np.linalg.norm(self.end - self.begin))
        stages = sorted({s.stage for s in self.shapes})
        for stage, more in [*((k, False) for k in stages), (stages[-1], True)]:
            if more and (best is not None or len(self.shapes) > _FEW):
                break
            shapes = [s for s in self.shapes if s.stage <= stage]
            report_step(
                f"looking for a way of '{self.phase.name}' round obstacles, shapes: {len(shapes)}"
            )
            roadmap = self._roadmap(shapes, need, yawed=more)
            stops = roadmap.stops_of_shortest_way((self.begin, 0), (self.end, self._last))
            if stops is not None and (best is None or stops.cost < best[1].cost):
                best = roadmap, stops
            if best is not None and best[1].cost <= _SHORT * straight + self.reach:
                break
        if best is None:
            raise self._no_way_error(roadmap)
        return best[0], best[0].stops_of_shorter_way(best[1])

    def _roadmap(self, shapes: list[layers.CandidateShape], need: float, *, yawed: bool) -> Roadmap:
        """What the search goes through: a layer for each shape and attitude, their changes, and where nodes may be.

        ``need`` is the clearance to keep [m]; ``yawed`` asks for more yaws than start, goal and narrow gaps have.
        """
        frames = layers.lattice_frames(self._near_obstacles_at_rest())
        fence = self.mission.limits.geofence
        box = np.array([[-np.inf] * 3, [np.inf] * 3])
        box = box if fence is None else np.array([fence.min, fence.max]) + [[need], [-need]]
        space = FreeSpace(self._near_obstacles_at_rest(), box)
        roll, pitch, yaw_before = self.start
        yaws = {yaw_before + yaw for yaw in _YAWS} if yawed else set()
        for shape in shapes:
            yaws |= layers.narrow_yaws(shape.slots, self.start, frames)
        angles = [self.start]
        for a in (self.goal, *((roll, pitch, yaw) for yaw in sorted(yaws))):
            if all(layers.angle_between_attitudes(a, b) > 1e-6 for b in angles):
                angles.append(a)
        turns = [att.dcm_from_euler(np.deg2rad(a)) for a in angles]
        nodes = [
            Layer(s.name, a, s.slots @ T if self.each else np.zeros((1, 3)))
            for s in shapes
            for a, T in zip(angles, turns, strict=True)
        ]
        self._last = min(
            range(len(angles)), key=lambda k: layers.angle_between_attitudes(angles[k], self.goal)
        )
        common = []
        for frame in frames:
            points = box_corners(*self._search_box) @ frame.T
            low, high = points.min(axis=0), points.max(axis=0)
            ends = np.array([self.begin, self.end]) @ frame.T
            count = np.clip(np.ceil((high - low) / (2.0 * self.reach)), *_EVEN).astype(int)
            even = map(np.linspace, low, high, count)
            common.append([np.unique([*a, *b]) for a, b in zip(even, ends.T, strict=True)])
        changes = list(layers.changes_between_layers(self.mission, shapes, angles))
        if not self.each:  # the one ball that covers all neither turns nor changes
            stays = constant_path(nodes[0])
            changes = [c._replace(path=stays, ways=np.zeros(1)) for c in changes]
        return Roadmap(space, nodes, changes, self.radius, need, frames, common)

    # -- from nodes to phases --------------------------------------------------------------------------

    def _parts_and_lengths(
        self, roadmap: Roadmap, stops: Stops
    ) -> Iterator[tuple[str, dict[str, Any], float]]:
        """Name, keys and greatest way [m] of an agent, of each part of a way, which becomes a phase."""
        changes = {frozenset((c.before, c.after)): float(c.ways.max()) for c in roadmap.changes}
        written = self._formation_names_in_file()
        for (a, i), (b, j) in pairwise(zip(stops.places, stops.layers, strict=True)):
            layer = roadmap.layers[j]
            if i == j:
                place = f"to ({', '.join(f'{x:.4g}' for x in b)})"
                yield place, {"kind": "fly", "position": b.tolist()}, float(np.linalg.norm(b - a))
            elif layer.formation != roadmap.layers[i].formation:
                name = written.get(layer.formation, layer.formation)
                way_of = changes[frozenset((i, j))]
                yield f"take {name}", {"kind": "reshape", "formation": name}, way_of
            else:
                keys: dict[str, Any] = {"kind": "turn"} | _attitude_keys(layer.angles)
                yield f"turn to {layer.angles[2]:.4g}°", keys, changes[frozenset((i, j))]

    def _formation_names_in_file(self) -> dict[str, str]:
        """Names of formations as the file has them, by those that they have here."""
        tables = self.mission.to_dict()["phases"]
        return {
            p.shaping.formation: t["formation"]
            for p, t in zip(self.mission.phases, tables, strict=True)
            if p.shaping is not None
        }

    def _phase_tables(self, roadmap: Roadmap, stops: Stops) -> list[dict[str, Any]]:
        """The phases of a way as tables; times are shared like the roots of the longest ways, or automatic."""
        phase = self.phase
        parts = list(self._parts_and_lengths(roadmap, stops))
        if not parts:
            parts = [("stay", {"kind": "fly", "position": self.end.tolist()}, 1.0)]
        end = latest_end(phase, self.now.t)
        roots = np.sqrt([max(length, 1e-3) for *_, length in parts])
        lengths = (end - self.now.t) * roots / roots.sum() if phase.duration != AUTO else roots
        tables = []
        for number, ((name, keys, _), length) in enumerate(zip(parts, lengths, strict=True), 1):
            time = AUTO if phase.duration == AUTO else round(float(length), 3)
            table = {"name": f"{phase.name} {number}: {name}", **keys, "duration": time}
            if keys["kind"] == "reshape":
                table["blend"] = time
            if self.mission.architecture == "body":
                table["control"] = phase.control
            tables.append(table)
        last = tables[-1]
        if phase.attitude_deg is not None and last["kind"] == "fly":
            last |= _attitude_keys(phase.attitude_deg)
        if phase.duration != AUTO:
            before = [float(t["duration"]) for t in tables[:-1]]
            last["duration"] = round(end - self.now.t - sum(before), 6)
            if "blend" in last:
                last["blend"] = last["duration"]
            if phase.until is not None:
                last["until"] = phase.until
                del last["duration"]
        return tables

    def _mission_legs_and_shortfall(
        self, roadmap: Roadmap, stops: Stops
    ) -> tuple[Mission, list[Leg], float]:
        """The mission with a way, its legs, and the clearance [m] that their proof lacks: of every vehicle, in time."""
        mission, k = self.mission, len(self.legs)
        data, tables = mission.to_dict(), self._phase_tables(roadmap, stops)
        forms = {
            name: mission.formations[name].model_dump(
                mode="json", exclude_none=True, exclude_defaults=True
            )
            for name in {t.get("formation") for t in tables} - {None} - set(data["formations"])
            if name in mission.formations
        }
        named = [t | {"name": p.name} for t, p in zip(data["phases"], mission.phases, strict=True)]
        data |= {
            "phases": [*named[:k], *tables, *named[k + 1 :]],
            "formations": data["formations"] | dict(sorted(forms.items())),
        }
        tried = mission.rewritten(data)
        self._worst = ""
        legs = self.legs_up_to(tried, k + len(tables), self.legs)
        return tried, legs, max(self._missing_clearance(tried, leg) for leg in legs[k:])

    def _missing_clearance(self, mission: Mission, leg: Leg) -> float:
        """How much [m] the clearance of a planned leg is below what is asked for; negative if it is kept."""
        planned = sample_leg(leg, max(samples_per_phase(mission), FEWEST_SAMPLES))
        speed, need, radius = speed_bounds(planned), self.phase.clearance, mission.fleet.radius
        least = math.inf
        for thing in mission.obstacles:
            clearance, agent, time, proved = clearance_to(planned, thing, radius, speed)
            if proved < least:
                least = proved
                self._worst = (
                    f"agent {agent + 1} is {clearance:.3f} m from '{thing.name}' at {time:.2f} s in"
                    f" '{planned.phase}'"
                )
            if thing.solid.moves and proved < need:
                problem = f"ways lead round obstacles at rest, and on this one {self._worst}"
                remedy = "wait before by kind 'hold', or fly elsewhere first"
                raise self.mistake("position", self.phase.position, problem, remedy)
        return need - least

    # -- what to say -----------------------------------------------------------------------------------

    def _no_way_error(self, roadmap: Roadmap) -> MissionError:
        """What stands in the way, and how much is missing."""
        mistake = partial(self.mistake, "position", self.phase.position)
        for what, place, layer in (("start", self.begin, 0), ("goal", self.end, self._last)):
            room, agent, thing = self._tightest_room(roadmap, place, layer)
            if room < roadmap.need:
                problem = (
                    f"its {what} leaves agent {agent + 1} {room:.2f} m of clearance from {thing}, which is less"
                    f" than {self.phase.clearance:g} m"
                )
                return mistake(problem, "move it, or ask for less clearance")
        least, place, layer = roadmap.widest_way_bottleneck((self.begin, 0), (self.end, self._last))
        x, (_, _, thing) = roadmap.layers[layer], self._tightest_room(roadmap, place, layer)
        where = ", ".join(f"{v:z.2f}" for v in place)
        problem = (
            f"no way is found: at the narrowest place of the best one, ({where}) m, '{x.formation}' at yaw"
            f" {x.angles[2]:.4g}° "
        ) + (
            self._needed_gap_in_words(roadmap, place, layer)
            or f"has {least:.2f} m of clearance from {thing}, {roadmap.need - least:.2f} m less than asked for"
        )
        remedy = "allow a slimmer formation (formations, scales), ask for less clearance, or name points on the way"
        return mistake(problem, remedy)

    def _tightest_room(self, roadmap: Roadmap, place: Floats, layer: int) -> tuple[float, int, str]:
        """The least room [m] of an agent at a place, the agent, and what is nearest to it."""
        r, space = place + roadmap.layers[layer].offsets, roadmap.space
        room = space.clearance(r, roadmap.radius)
        _, near = proximity.obstacle_clearances(r, roadmap.radius, space.obstacles)
        agent = int(room.argmin())
        thing = f"'{space.obstacles[near[agent]].name}'" if near[agent] >= 0 else "the geofence"
        return float(room[agent]), agent, thing

    def _needed_gap_in_words(self, roadmap: Roadmap, place: Floats, layer: int) -> str:
        """What a shape needs in the gap between the two nearest obstacles; "" if they do not lie on two sides of it."""
        x, boxes = roadmap.layers[layer], []
        for other in roadmap.space.obstacles:
            room = proximity.obstacle_clearances(place + x.offsets, roadmap.radius, [other])[0]
            boxes.append((float(room.min()), other))
        boxes.sort(key=lambda b: b[0])
        if len(boxes) < 2:
            return ""
        (_, one), (_, two) = boxes[:2]
        (a, b), (c, d) = swept_extent(one.solid), swept_extent(two.solid)
        wide = np.maximum(a - d, c - b)
        k = int(np.where(np.isfinite(wide), wide, -np.inf).argmax())
        if wide[k] <= 0.0:
            return ""
        along = x.offsets[:, k]
        takes = float((along + roadmap.radius).max() - (along - roadmap.radius).min())
        needs = takes + 2.0 * self.phase.clearance
        if needs <= wide[k]:
            return ""
        return (
            f"needs {needs:.2f} m between '{one.name}' and '{two.name}', which leave {wide[k]:.2f} m:"
            f" {needs - wide[k]:.2f} m are missing"
        )


def _attitude_keys(angles: layers.Angles) -> dict[str, float]:
    """Keys of an attitude; angles of zero need none, but for the yaw."""
    return {k: x for k, x in zip(ANGLES, angles, strict=True) if x or k == "yaw_deg"}


def error_of_key(
    mission: Mission, number: int, key: str, value: object, problem: str, remedy: str
) -> MissionError:
    """The error of a key of a phase, whose number counts from 0."""
    path = f"phases[{number + 1}].{key}"
    return MissionError([Finding(mission.origin, path, value, problem, remedy)])
