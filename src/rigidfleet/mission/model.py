"""Missions from TOML text, from plain data, from files, and those that ship with the package."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from pydantic import PrivateAttr

from rigidfleet._arguments import as_path
from rigidfleet._toml import to_toml
from rigidfleet.errors import Finding, MissionError, wrong_type
from rigidfleet.formation.assignment import assigned
from rigidfleet.formation.distance_geometry import distances
from rigidfleet.math import constraint_jacobian
from rigidfleet.math.attitude import dcm_from_euler
from rigidfleet.mission import bounds
from rigidfleet.mission.check import check
from rigidfleet.mission.describe import counted
from rigidfleet.mission.findings import near
from rigidfleet.mission.phases import latest_end
from rigidfleet.mission.schema import (
    DRAG,
    Contents,
    Establish,
    Phase,
    Start,
)
from rigidfleet.typing import Bools, Floats, Ints

_SHIPPED = resources.files("rigidfleet") / "missions"
#: Least and greatest damping that "auto" takes: below, rounding shows; docs/robustness.md has the table.
_DAMPING = (1e-5, 0.03)
#: Beyond so many equations eigenvalues take too long; the greatest damping is taken.
_DENSE = 1000


class Fleet(NamedTuple):
    """What all vehicles start from and can bear: read-only arrays, made once."""

    mass: Floats  # (N,) as the laws believe [kg]
    position: Floats  # (N, 3) at the start [m]
    velocity: Floats  # (N, 3) at the start [m/s]
    radius: Floats  # (N,) [m]
    thrust_limit: Floats  # (N,) [N], infinite where unlimited


class Mission(Contents):
    """A checked mission: make one by `load_mission`, `Mission.from_toml` or `Mission.from_dict`.

    >>> import rigidfleet as rf
    >>> rf.load_mission("narrow-passage")  # one that ships; a path reads a file
    <Mission narrow-passage: 3 agents, 2 formations, 12 phases, 90 s>
    """

    _text: str = PrivateAttr("")
    _origin: str = PrivateAttr("")
    _made_slots: dict[str, Floats | None] = PrivateAttr(default_factory=dict)
    _made_edges: dict[str, Ints] = PrivateAttr(default_factory=dict)

    @classmethod
    def from_toml(cls, text: str, origin: str = "<text>") -> Self:
        """Check a mission given as TOML; `origin` names it in messages.

        Raises
        ------
        MissionError
            With a finding for each error.
        """
        if not isinstance(text, str):
            raise wrong_type("the text of a mission file", text)
        mission = cls.model_construct(**check(parse_toml(text, origin), origin))
        mission._text, mission._origin = text, origin
        return mission

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], origin: str = "<dict>") -> Self:
        """Check a mission given as plain data with the keys of the TOML format, NumPy's arrays too.

        Raises
        ------
        MissionError
            With a finding for each error.
        """
        if not isinstance(data, Mapping):
            raise wrong_type("a dict with the keys of a mission", data)
        try:
            text = to_toml(data)
        except TypeError as error:
            remedy = "use numbers, strings, lists and dicts"
            raise MissionError([Finding(origin, "", None, str(error), remedy)]) from None
        except RecursionError:
            raise _unread(origin, "is nested without end", "use the keys of a mission") from None
        return cls.from_toml(text, origin)

    @property
    def size_in_words(self) -> str:
        """How much of everything there is: 3 agents, 2 formations, 12 phases, 90 s."""
        return counted(self.n_agents, len(self.formations), self.phases)

    def __repr__(self) -> str:
        return f"<Mission {self.name}: {self.size_in_words}>"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        """The mission as a notebook shows it: its phases, in order."""
        from rigidfleet import _markup
        from rigidfleet.mission.describe import ending, goal

        rows = [
            (n, phase.name, phase.kind, goal(phase), ending(phase), phase.control)
            for n, phase in enumerate(self.phases, start=1)
        ]
        heads = ("#", "phase", "kind", "to", "ends", "control")
        return _markup.shown(self.name, self.title, heads, rows, self.size_in_words)

    def to_dict(self) -> dict[str, Any]:
        """Plain data as it was written: change it, and check it again by `Mission.from_dict`."""
        return tomllib.loads(self._text)

    @property
    def text(self) -> str:
        """The mission's TOML."""
        return self._text

    @property
    def origin(self) -> str:
        """Where the mission was read."""
        return self._origin

    @property
    def n_agents(self) -> int:
        """Number of agents N."""
        return len(self.agents.position)

    @cached_property
    def edges(self) -> Ints:
        """Edges (m, 2) of all formations, counted from 0, i < j, in the order of first mention."""
        all_ = [self.formation_edges(name) for name in self.formations]
        pairs = np.concatenate([np.zeros((0, 2), dtype=np.int64), *all_])
        first = np.unique(pairs[:, 0] * self.n_agents + pairs[:, 1], return_index=True)[1]
        return pairs[np.sort(first)]

    @property
    def assigned_slots(self) -> dict[str, Ints]:
        """Slot (N,) of each formation that each agent takes, from 0, as `assignment` has it.

        By "shortest" and "safe" the same in all formations; by "each" what is nearest to where the agents are
        when the formation is first flown.
        """
        return self._assigned[0]

    def assigned_turn(self, before: str | None, after: str) -> Floats | None:
        """Rotation (3, 3) of a formation's slots onto those ``before``, if slots were assigned on this way.

        Both are in their own axes; None before is the start, in the axes in which formations are drawn. Slots that
        are assigned are flown with this rotation, or what their assignment promises does not hold.
        """
        return self._assigned[1].get((before, after))

    @cached_property
    def _assigned(self) -> tuple[dict[str, Ints], dict[tuple[str | None, str | None], Floats]]:
        """Slots of each formation (N,), and the rotations by which they were found, by formations before and after.

        Where slots are tracked to an attitude that is known beforehand, ways are straight, and nothing turns.
        """
        orders = dict.fromkeys(self.formations, np.arange(self.n_agents))
        turns: dict[tuple[str | None, str | None], Floats] = {}
        if self.assignment == "given" or self.n_agents < 2:
            return orders, turns
        before: str | None = None
        known = True  # where agents are to each other, which distances alone do not tell
        asked: Floats | None = None  # attitude asked for by name
        lies: Floats | None = self.drawn_attitude  # that of the axes of `places`, where it is known
        places = self.fleet.position @ self.drawn_attitude.T
        flown: set[str] = set()
        for p in self.phases:
            if p.moves and (angles := p.attitude_deg) is not None:
                lies = asked = dcm_from_euler(np.deg2rad(angles))
            if p.turns_away:
                lies = asked = None
            if (shaping := p.shaping) is None:
                continue
            name = shaping.formation
            axes: Floats | None = np.eye(3)  # of this formation, in those of the one before
            if self.free_attitude(p):
                axes = lies = None
                asked = None if p.control == "tracking" else asked
            elif (establishing := p.establishing) is not None:
                asked = self.establish_attitude(establishing, asked)
                axes = None if lies is None else lies @ asked.T
                lies = asked
            slots = self._slots(name)
            if slots is None:
                known = False
            elif name not in flown:
                radius = self.agents.radius if self.assignment == "safe" else None
                order, turn = assigned(places, slots, turn=axes, radius=radius)
                if self.assignment != "each":
                    return dict.fromkeys(self.formations, order), {(before, name): turn}
                orders[name] = order
                if known:
                    turns.setdefault((before, name), turn)
                    turns.setdefault((name, before), turn.T)  # as long as the way there
            if slots is not None:
                places, known = slots[orders[name]], True
            if self.assignment != "each":
                break
            flown.add(name)
            before = name
        return orders, turns

    @cached_property
    def drawn_attitude(self) -> Floats:
        """Attitude (3, 3), world to body, in which formations are drawn: the world's axes, or [body_frame]."""
        b = self.body_frame
        return (
            np.eye(3)
            if b is None
            else dcm_from_euler(np.deg2rad([b.roll_deg, b.pitch_deg, b.yaw_deg]))
        )

    def establish_attitude(self, phase: Establish, asked: Floats | None) -> Floats:
        """Attitude (3, 3) in which a formation is established that is not free.

        By the phase's own angles, or as ``asked`` for by name before, or else as it is drawn.
        """
        angles = phase.attitude_deg
        if angles is not None:
            return dcm_from_euler(np.deg2rad(angles))
        return self.drawn_attitude if asked is None else asked

    def free_attitude(self, phase: Phase) -> bool:
        """Whether nothing steers the attitude in which a phase takes its formation.

        Forces between agents do not. Slots do, unless the phase asks for that by name, or what is established is given
        by distances alone, which have no axes.
        """
        taken = phase.establishing
        if phase.control != "tracking" or taken is None:
            return phase.control != "tracking"
        if taken.attitude_deg is not None:
            return False
        return taken.attitude == "free" or not self.formations[taken.formation].knows_slots

    def _slots(self, name: str) -> Floats | None:
        """Slots (N, 3) [m] of a formation in their own order; made once."""
        if name not in self._made_slots:
            self._made_slots[name] = self.formations[name].slot_array(self.n_agents)
        return self._made_slots[name]

    def formation_edges(self, name: str) -> Ints:
        """Edges (m, 2) of a formation between agents, counted from 0, i < j."""
        if name not in self._made_edges:
            edges = self.formations[name].edge_array(self.n_agents)
            if self.assignment != "given":
                edges = np.sort(np.argsort(self.assigned_slots[name])[edges], axis=1)
            self._made_edges[name] = edges
        return self._made_edges[name]

    def formation_slots(self, name: str) -> Floats | None:
        """Slots (N, 3) [m] of a formation about their geometric centre, in the order of the agents.

        Derived from a complete set of distances where no slots are given; None where that is
        incomplete, too.
        """
        slots = self._slots(name)
        return slots if slots is None else slots[self.assigned_slots[name]]

    def formation_distances(self, name: str) -> Floats:
        """Length (m,) [m] of each edge of a formation."""
        given = self.formations[name].distances
        if given is not None:
            return np.array(given, dtype=np.float64)
        slots = self.formation_slots(name)
        assert slots is not None  # checked: without distances there are a shape or slots
        return distances(slots, self.formation_edges(name))

    def damping(self, name: str | None, lost: Bools | None = None) -> float:
        """Damping mu [-] of the iterated solve while a formation is held; ``name`` None: on the way.

        "auto" is a quarter of the smallest non-zero eigenvalue w of mbar J M^-1 J^T at the formation, of the vehicles
        that are not ``lost`` (N,), at most 0.03; and 0.03 on the way to one, or where there are no slots.
        """
        given = self.constraint.damping
        if given != "auto":
            return given
        slots = self.formation_slots(name) if name else None
        if name is None or slots is None:
            return _DAMPING[1]
        left = np.ones(self.n_agents, dtype=np.bool_) if lost is None else ~lost
        edges = self.formation_edges(name)
        edges = (np.cumsum(left) - 1)[edges[left[edges].all(axis=1)]]
        if not len(edges) or min(len(edges), 3 * int(left.sum())) > _DENSE:
            return _DAMPING[1]
        masses = self.fleet.mass[left]
        index = constraint_jacobian.smallest_singular_value(slots[left][None], edges, masses)[0]
        return float(np.clip(index**2 / 4, *_DAMPING))

    @property
    def latest_end(self) -> float:
        """Mission time [s] by which the last phase has ended, if each settling times out."""
        return latest_end(self.phases)

    @cached_property
    def fleet(self) -> Fleet:
        """The vehicles as arrays."""
        fleet = Fleet(
            *(np.array(getattr(self.agents, name), dtype=float) for name in Fleet._fields)
        )
        for values in fleet:
            values.flags.writeable = False
        return fleet

    @cached_property
    def true_mass(self) -> Floats:
        """Mass (N,) [kg] that each vehicle has: `agents.mass` is what the laws believe."""
        error = self.disturbances.mass_error if self.disturbances is not None else 0.0
        return self.fleet.mass * (1.0 + np.array(error))

    @cached_property
    def drag(self) -> Floats:
        """Force of the air (N,) on each vehicle for each m/s of velocity through it [N s/m]."""
        d = self.disturbances
        if d is None or (d.drag is None and not any(d.wind) and d.gusts is None):
            return np.zeros(self.n_agents)
        if d.drag is None:
            return DRAG * self.fleet.mass
        return np.broadcast_to(np.array(d.drag, dtype=np.float64), self.n_agents).copy()

    @cached_property
    def lost_at(self) -> Floats:
        """Time (N,) [s] at which each vehicle is lost; infinite for those that are not."""
        when = np.full(self.n_agents, np.inf)
        for lost in self.disturbances.lost if self.disturbances is not None else ():
            when[lost.agent - 1] = lost.time
        return when


def mission_names() -> list[str]:
    """Names of the missions that ship with the package, in alphabetical order."""
    names = (entry.name for entry in _SHIPPED.iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def mission_text(name: str) -> str:
    """TOML of a shipped mission.

    Raises
    ------
    MissionError
        There is none of this name.
    """
    if name not in mission_names():
        raise MissionError([_not_found(name)])
    return (_SHIPPED / f"{name}.toml").read_text(encoding="utf-8")


def load_mission(name_or_path: str | Path) -> Mission:
    """Read and check a mission: a shipped one by its name, or a file.

    A shipped name wins over a file of that name; write `./name` for the file.

    Raises
    ------
    MissionError
        There is no such mission, it cannot be read, or it has errors: all of them, in `findings`.
    """
    if isinstance(name_or_path, str) and name_or_path in mission_names():
        return Mission.from_toml(mission_text(name_or_path), name_or_path)
    return Mission.from_toml(read_text(name_or_path), str(name_or_path))


def as_mission(given: Mission | str | Path) -> Mission:
    """A mission as a function takes it: a `Mission`, the name of a shipped one, or a file.

    Raises
    ------
    TypeError
        It is none of these.
    MissionError
        As `load_mission` does.
    """
    if isinstance(given, Mission):
        return given
    if isinstance(given, str | Path):
        return load_mission(given)
    raise wrong_type("a mission (a shipped name, a path or a Mission)", given)


def json_schema() -> dict[str, Any]:
    """JSON schema of the mission format, for editors: every key with its unit and meaning."""
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    schema = Mission.model_json_schema()
    parts = schema["$defs"]
    parts["Start"] = Start.model_json_schema()
    # Positions are written out before they become those of a model.
    position = parts["Agents"]["properties"]["position"]
    listed = {key: position.pop(key) for key in ("type", "items", "minItems")}
    position["anyOf"] = [listed, {"$ref": "#/$defs/Start"}]
    return draft | schema


def read_text(path: str | Path) -> str:
    """Text of a mission file, or of one like it.

    Raises
    ------
    MissionError
        It cannot be read.
    """
    origin = str(path)
    as_path(path)  # a number would be an open file
    try:
        with open(path, "rb") as file:
            data = file.read(bounds.BYTES + 1)
    except FileNotFoundError:
        raise MissionError([_not_found(origin)]) from None
    except IsADirectoryError:
        raise _unread(origin, "is a directory", "name a mission file in it") from None
    except PermissionError:
        raise _unread(origin, "may not be read", "change its permissions") from None
    except (OSError, ValueError) as error:
        raise _unread(origin, f"cannot be read ({error})", "name a mission file") from None
    if len(data) > bounds.BYTES:
        raise _unread(
            origin, f"is larger than {bounds.BYTES >> 20} MiB", "name a mission file (TOML)"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        remedy = "name a mission file (TOML)" if b"\0" in data else "save it as UTF-8"
        raise _unread(origin, f"is not UTF-8 text (byte {error.start + 1})", remedy) from None


def _unread(origin: str, problem: str, remedy: str) -> MissionError:
    return MissionError([Finding(origin, "", None, problem, remedy)])


def _not_found(name: str) -> Finding:
    known = mission_names()
    remedy = near(Path(name).stem, known) or f"shipped missions: {', '.join(known)}"
    return Finding(name, "", None, "there is no such file, nor a shipped mission", remedy)


def parse_toml(text: str, origin: str) -> dict[str, Any]:
    """Plain data of TOML text.

    Raises
    ------
    MissionError
        It is no TOML, or beyond the bounds of a mission's text.
    """
    if beyond := bounds.excess(text):
        raise _unread(origin, beyond, "make it smaller; docs/missions.md lists the bounds")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        problem, remedy = f"is not valid TOML: {error}", "correct the line; toml.io has the format"
    except ValueError as error:  # thousands of digits
        problem, remedy = f"cannot be read as TOML: {error}", "correct it; toml.io has the format"
    except RecursionError:
        problem, remedy = "is nested without end", "use the keys of a mission"
    raise _unread(origin, problem, remedy)
