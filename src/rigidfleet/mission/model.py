"""The mission: its data as checked, and what follows from them, as arrays."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from copy import copy
from functools import cached_property, wraps
from hashlib import sha256
from typing import Any, Literal, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import PrivateAttr

from rigidfleet._common.facts import FactTable, Line, Row, Sheet, Shown
from rigidfleet._common.renamed import with_earlier_members
from rigidfleet._common.text import agent_names, first_few
from rigidfleet._common.toml import to_toml, to_toml_data
from rigidfleet.errors import wrong_type
from rigidfleet.formation.assignment import assign_slots, downwash_metric
from rigidfleet.formation.distance_geometry import distances
from rigidfleet.math import constraint_jacobian
from rigidfleet.math.attitude import dcm_from_euler
from rigidfleet.math.lqr import double_integrator_gains
from rigidfleet.math.rigid_body import about_cm
from rigidfleet.mission.changes import add_scaled_formations, split_shared_formations
from rigidfleet.mission.check import check_parts, default_tables
from rigidfleet.mission.files import digest_lines
from rigidfleet.mission.kinds import Establish, Phase
from rigidfleet.mission.network import with_network
from rigidfleet.mission.obstacles import Ground, Obstacle, is_ground
from rigidfleet.mission.phases import latest_end_of_phases
from rigidfleet.mission.schema import DRAG, Aborting, Contents, Disturbances
from rigidfleet.mission.text import parse_toml, text_error
from rigidfleet.mission.vehicles import VehicleModel, model_of_vehicle
from rigidfleet.solids.distance import top_of_solids_below
from rigidfleet.solids.records import Solids, join_solids
from rigidfleet.typing import Bools, Floats, Ints

#: Smallest and largest damping that "auto" uses. Below, rounding errors show; docs/robustness.md has the measurements.
_DAMPING = (1e-5, 0.03)
#: Maximum number of equations for which "auto" computes eigenvalues; beyond, it uses the largest damping.
_DENSE = 1000


class Fleet(NamedTuple):
    """Parameters and start states of all vehicles, as read-only arrays.

    Attributes
    ----------
    mass : masses (N,) that the control laws use [kg]
    position, velocity : states at the start (N, 3) [m, m/s]
    radius : radii (N,) [m]
    thrust_limit : maximum thrusts (N,) [N], infinite if unlimited
    """

    mass: Floats
    position: Floats
    velocity: Floats
    radius: Floats
    thrust_limit: Floats


A = TypeVar("A", bound="Floats | Ints | None")


def _compute_once(method: Callable[[Any, Any], A]) -> Callable[[Any, Any], A]:
    """Compute an array of each formation, by its name, once, and return a copy; edges are the same array always.

    By that, phases see at once that they have the edges of the phase before.
    """

    @wraps(method)
    def wrapper(self: Mission, name: Any) -> A:
        made = part_of_mission(self, method, name)
        return made if made is None or made.dtype.kind == "i" else made.copy()

    return wrapper


def part_of_mission(mission: Mission, make: Callable[..., Any], *key: Any) -> Any:
    """What ``make`` makes of a mission and a key, made once for the mission: nobody may change it."""
    if (make, *key) not in mission._made:
        mission._made[make, *key] = make(mission, *key)
    return mission._made[make, *key]


#: Vehicles no higher above what is below them stand on it [m].
_STANDING = 0.5


@with_earlier_members(linked="has_link", free_attitude="leaves_attitude_free")
class Mission(Contents, Shown):
    """A checked mission. Create one by `load_mission`, `Mission.from_toml` or `Mission.from_dict`.

    >>> import rigidfleet as rf
    >>> rf.load_mission("narrow-passage")  # a shipped mission, or the path of a file
    <Mission narrow-passage: 3 agents, 2 formations, 12 phases, 90 s>
    """

    #: As written: plain data, which `to_dict` copies, and the text, which is made of them when it is asked for.
    _data: dict[str, Any] = PrivateAttr(default_factory=dict)
    _text: str = PrivateAttr("")
    _about: str = PrivateAttr("")
    _origin: str = PrivateAttr("")

    def __init__(self, *_: object, **__: object) -> None:
        """Refuse: keys alone would not be checked as a whole.

        Raises
        ------
        TypeError
        """
        raise TypeError(
            "a mission is not made by Mission(...): use load_mission(name or path), Mission.from_toml(text) or"
            " Mission.from_dict(keys)"
        )

    @classmethod
    def from_toml(cls, text: str, origin: str = "<text>") -> Self:
        """Check a mission given as TOML text; messages call it `origin`.

        Raises
        ------
        MissionError
            With a finding for each error.
        """
        if not isinstance(text, str):
            raise wrong_type("the text of a mission file", text)
        return cls.from_plain(parse_toml(text, origin), origin, text=text)

    @classmethod
    def from_plain(cls, data: dict[str, Any], origin: str, *, text: str = "") -> Self:
        """Check a mission given as the plain data of its TOML text, as `to_dict` returns it; the mission keeps them.

        An earlier name of a table works, with a warning; the mission's own text then is one with the name of now.

        Raises
        ------
        MissionError
            With a finding for each error.
        """
        if (current := with_network(data)) is not data:
            words = (
                "[disturbances.links] is now [network], where a vehicle hears its neighbours alone"
            )
            # Who has written a file is warned, too, by the command: Python shows no DeprecationWarning of modules.
            warnings.warn(f"{origin}: {words}", FutureWarning, stacklevel=3)
            data, text = current, ""
        parts = check_parts(data, origin)
        if parts["assignment"] == "each":
            parts["formations"], parts["phases"] = split_shared_formations(
                parts["formations"], parts["phases"]
            )
        n = len(parts["agents"].position)
        parts["formations"] = add_scaled_formations(parts["formations"], parts["phases"], n)
        mission = cls.model_construct(set(parts), **default_tables() | parts)
        mission._data, mission._text, mission._origin = data, text, origin
        return mission

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], origin: str = "<dict>") -> Self:
        """Check a mission given as a dictionary with the keys of the TOML format; NumPy arrays are allowed.

        Raises
        ------
        MissionError
            With a finding for each error.
        """
        if not isinstance(data, Mapping):
            raise wrong_type("a dict with the keys of a mission", data)
        try:
            copied = to_toml_data(data)
        except TypeError as error:
            raise text_error(origin, str(error), "use numbers, strings, lists and dicts") from None
        except RecursionError:
            raise text_error(origin, "is nested too deeply", "use the keys of a mission") from None
        return cls.from_plain(copied, origin)

    def rewritten(self, data: Mapping[str, Any], origin: str | None = None) -> Self:
        """Return a mission from changed data of this one, checked, with what is known of its files (`about`).

        Raises
        ------
        MissionError
            With a finding for each error.
        """
        mission = self.from_dict(data, self._origin if origin is None else origin)
        mission._about = self.file_digests_text
        return mission

    def with_phases(self, phases: list[dict[str, Any]], *, as_written: bool = False) -> Self:
        """Return the mission with other tables of phases, checked.

        With ``as_written`` its text stays: for phases that follow from it, as they differ in automatic times alone.

        Raises
        ------
        MissionError
            With a finding for each error.
        """
        mission = self.rewritten(self._data | {"phases": phases})
        if as_written:
            mission._data, mission._text = self._data, self._text
        return mission

    def with_assignment(self, assignment: str) -> Self:
        """Return the mission as it is, with its times known, but with agents assigned to slots otherwise; unchecked.

        It is written with the new assignment, and with automatic times as before.
        """
        parts = {name: getattr(self, name) for name in Contents.model_fields}
        other = self.model_construct(self.model_fields_set, **parts | {"assignment": assignment})
        other._data = self._data | {"assignment": assignment}
        other._about, other._origin = self.file_digests_text, self._origin
        return other

    @property
    def size_in_words(self) -> str:
        """Size of the mission: 3 agents, 2 formations, 12 phases, 90 s."""
        counts = {
            "agent": self.n_agents,
            "formation": len(self.formations),
            "phase": len(self.phases),
        }
        words = [f"{n} {thing}{'s' * (n != 1)}" for thing, n in counts.items()]
        most = "at most " if any(phase.settle for phase in self.phases) else ""
        end = self.latest_end
        lasts = "as long as its limits ask" if math.isnan(end) else f"{most}{end:g} s"
        return ", ".join([*words, lasts])

    def __repr__(self) -> str:
        return f"<Mission {self.name}: {self.size_in_words}>"

    __str__ = __repr__

    def facts(self) -> Sheet:
        """The phases, in order, and the size."""
        return Sheet(self.name, self.title, [self.phase_table, Line(self.size_in_words)])

    @property
    def phase_table(self) -> FactTable:
        """Each phase: where it leads, when it ends, and how it is controlled."""
        rows = [
            Row((n, p.name, p.kind, p.leads_to, p.ends, p.control))
            for n, p in enumerate(self.phases, start=1)
        ]
        heads = ("#", "phase", "kind", "to", "ends", "control")
        return FactTable(heads, rows, heads[1:])

    def to_dict(self) -> dict[str, Any]:
        """Return the mission as a dictionary, as written. Edit it and pass it to `Mission.from_dict`."""
        return to_toml_data(self._data)

    @property
    def text(self) -> str:
        """The TOML text of the mission."""
        if not self._text:
            self._text = self._about + to_toml(self._data)
        return self._text

    @property
    def digest(self) -> str:
        """The SHA-256 of its text."""
        return sha256(self.text.encode()).hexdigest()

    @property
    def file_digests_text(self) -> str:
        """What its text tells of the files that were read: lines with their digests."""
        return self._about or digest_lines(self._text)

    @property
    def origin(self) -> str:
        """Where the mission was read from: a path, a name or a description."""
        return self._origin

    @property
    def smooth(self) -> bool:
        """Whether acceleration and jerk of the references are continuous."""
        return self.smoothness == "jerk"

    @property
    def n_agents(self) -> int:
        """Number of agents N."""
        return len(self.agents.position)

    @cached_property
    def edges(self) -> Ints:
        """Edges (m, 2) of all formations, agents from 0, i < j, in the order of their first occurrence."""
        all_ = [self.formation_edges(name) for name in self.formations]
        pairs = np.concatenate([np.zeros((0, 2), dtype=np.int64), *all_])
        first = np.unique(pairs[:, 0] * self.n_agents + pairs[:, 1], return_index=True)[1]
        return pairs[np.sort(first)]

    @property
    def assigned_slots(self) -> dict[str, Ints]:
        """Slot (N,), from 0, that each agent takes in each formation, by the mission's `assignment`.

        With "shortest" and "safe", an agent keeps its slot in all formations. With "each", slots are assigned anew at
        each change, from the positions of the agents at that time. A formation that is taken again from elsewhere is
        another one here, "NAME (2)".
        """
        return self._assignment[0]

    def assigned_turn(self, before: str | None, after: str) -> Floats | None:
        """Rotation (3, 3) of a formation's slots onto those ``before``, if slots were assigned for this change.

        Each formation is in its own axes. ``before`` None means the start positions, in the axes in which formations
        are drawn. The optimality of an assignment, and the clearance on its paths, hold only with this rotation.
        """
        return self._assignment[1].get((before, after))

    @cached_property
    def _assignment(self) -> tuple[dict[str, Ints], dict[tuple[str | None, str | None], Floats]]:
        """Slots (N,) of each formation, and the rotations used for their assignment, by (before, after).

        Where slots are tracked to a commanded attitude, paths are straight, and the rotation is given, not optimised.
        """
        orders = dict.fromkeys(self.formations, np.arange(self.n_agents))
        turns: dict[tuple[str | None, str | None], Floats] = {}
        if self.assignment == "given" or self.n_agents < 2:
            return orders, turns
        before: str | None = None
        known = True  # relative positions of the agents are known; distances alone do not determine them
        commanded: Floats | None = None  # commanded attitude
        lies: Floats | None = self.drawn_attitude  # of the axes of `places`; None if unknown
        places = self.fleet.position @ self.drawn_attitude.T
        flown: set[str] = set()
        for p in self.phases:
            if p.moves and (angles := p.attitude_deg) is not None:
                lies = commanded = dcm_from_euler(np.deg2rad(angles))
            if p.turns_away:
                lies = commanded = None
            up = np.eye(3)[2] if lies is None else lies[:, 2]
            if (vertical := p.vertical) is not None and vertical.has_way_per_vehicle:
                before = None
                who, places = vertical.movers(self.n_agents), places.copy()
                places[who] -= np.outer(places[who] @ up, up)  # all on one level
            if (shaping := p.shaping) is None:
                continue
            name = shaping.formation
            axes: Floats | None = np.eye(3)  # axes of this formation in those of the one before
            if self.leaves_attitude_free(p):
                axes = lies = None
                commanded = None if p.tracks_slots else commanded
            elif (establishing := p.establishing) is not None:
                commanded = self.establish_attitude(establishing, commanded)
                axes = None if lies is None else lies @ commanded.T
                lies = commanded
            slots = self._slots_in_own_order(name)
            if slots is None:
                known = False
            elif name not in flown:
                radius = self.agents.radius if self.assignment == "safe" else None
                metric = None
                if self.assignment_downwash > 1.0 and axes is not None:
                    metric = downwash_metric(up, self.assignment_downwash)
                order, turn = assign_slots(places, slots, turn=axes, radius=radius, metric=metric)
                if self.assignment != "each":
                    return dict.fromkeys(self.formations, order), {(before, name): turn}
                orders[name] = order
                if known:
                    turns.setdefault((before, name), turn)
                    turns.setdefault((name, before), turn.T)  # the way back has the same length
            if slots is not None:
                places, known = slots[orders[name]], True
            if self.assignment != "each":
                break
            flown.add(name)
            before = name
        return orders, turns

    @cached_property
    def drawn_attitude(self) -> Floats:
        """Attitude (3, 3), world to body, in which formations are drawn: world axes, or those of [body_frame]."""
        b = self.body_frame
        if b is None:
            return np.eye(3)
        return dcm_from_euler(np.deg2rad([b.roll_deg, b.pitch_deg, b.yaw_deg]))

    def establish_attitude(self, phase: Establish, commanded: Floats | None) -> Floats:
        """Attitude (3, 3) in which a phase establishes its formation, if the attitude is not free.

        This is the attitude that the phase commands, else the one commanded before, else the drawn one.
        """
        angles = phase.attitude_deg
        if angles is not None:
            return dcm_from_euler(np.deg2rad(angles))
        return self.drawn_attitude if commanded is None else commanded

    def leaves_attitude_free(self, phase: Phase) -> bool:
        """Whether a phase leaves the attitude of its formation free.

        Constraint forces do not control the attitude. Tracked slots do, unless the phase has ``attitude = "free"`` or
        its formation is given by distances alone, which have no axes.
        """
        taken = phase.establishing
        if not phase.tracks_slots or taken is None:
            return not phase.tracks_slots
        if taken.attitude_deg is not None:
            return False
        return taken.attitude == "free" or not self.formations[taken.formation].knows_slots

    @cached_property
    def _made(self) -> dict[tuple[Any, ...], Any]:
        return {}

    def __copy__(self) -> Self:
        """A copy without what was made of the mission: `model_copy` may change what that follows from."""
        copied = super().__copy__()
        for name in copied.__dict__.keys() - self.__class__.model_fields.keys():
            del copied.__dict__[name]
        return copied

    def __getstate__(self) -> dict[Any, Any]:
        """What is pickled: what a copy has, as what was made of the mission may hold functions."""
        return super(Mission, copy(self)).__getstate__()

    @_compute_once
    def _slots_in_own_order(self, name: str) -> Floats | None:
        """Slots (N, 3) [m] of a formation in their own order."""
        return self.formations[name].slot_array(self.n_agents)

    @_compute_once
    def formation_edges(self, name: str) -> Ints:
        """Edges (m, 2) of a formation, agents from 0, i < j."""
        edges = self.formations[name].edge_array(self.n_agents)
        if self.assignment == "given":
            return edges
        return np.sort(np.argsort(self.assigned_slots[name])[edges], axis=1)

    @_compute_once
    def formation_slots(self, name: str) -> Floats | None:
        """Slots (N, 3) [m] of a formation about their geometric centre, in the order of the agents.

        Without slots, they are derived from the distances; None if the distances are not complete.
        """
        slots = self._slots_in_own_order(name)
        return None if slots is None else slots[self.assigned_slots[name]]

    @_compute_once
    def slots_about_cm(self, name: str | None) -> Floats | None:
        """Slots (N, 3) [m] of a formation about their centre of mass; None without a formation, or if it has none."""
        slots = None if name is None else self.formation_slots(name)
        return None if slots is None else about_cm(slots, self.fleet.mass)

    def formation_colours(self, name: str) -> tuple[str, ...] | None:
        """Light "#rrggbb" of each agent in a formation; None if the formation has none of its own."""
        colour = self.formations[name].colour if name in self.formations else None
        if colour is None:
            return None
        if isinstance(colour, str):
            return (colour,) * self.n_agents
        return tuple(colour[slot] for slot in self.assigned_slots[name].tolist())

    @_compute_once
    def formation_distances(self, name: str) -> Floats:
        """Length (m,) [m] of each edge of a formation."""
        own = self.formations[name].distances
        if own is not None:
            return np.array(own, dtype=np.float64)
        slots = self.formation_slots(name)
        assert slots is not None  # checked: without distances there is a shape or slots
        return distances(slots, self.formation_edges(name))

    def damping(self, name: str | None, lost: Bools | None = None) -> float:
        """Damping mu [-] of the iterated solver while a formation is held, or during a change if ``name`` is None.

        "auto" is a quarter of the smallest non-zero eigenvalue w of mbar J M^-1 J^T at the formation, without the
        vehicles that are ``lost`` (N,), and at most 0.03. During a change, or without slots, it is 0.03.
        """
        own = self.constraint.damping
        if own != "auto":
            return own
        if name is None or self.formation_slots(name) is None:
            return _DAMPING[1]
        gone = () if lost is None else np.flatnonzero(lost).tolist()
        return part_of_mission(self, _automatic_damping, name, *gone)

    @property
    def latest_end(self) -> float:
        """Latest mission time [s] at which the last phase ends: each phase that settles takes its full timeout.

        It is nan while a duration before it is automatic (`rigidfleet.planning.timing.complete_times`).
        """
        return latest_end_of_phases(self.phases)

    @cached_property
    def fleet(self) -> Fleet:
        """Parameters and start states of all vehicles as arrays."""
        fleet = Fleet(
            *(np.array(getattr(self.agents, name), dtype=float) for name in Fleet._fields)
        )
        for values in fleet:
            values.flags.writeable = False
        return fleet

    @cached_property
    def ground(self) -> float:
        """Height of the highest `ground` [m]; minus infinity if there is none."""
        return max((o.height for o in self.obstacles if isinstance(o, Ground)), default=-np.inf)

    @property
    def solids(self) -> list[Obstacle]:
        """Obstacles but for the ground, which is everywhere."""
        return [o for o in self.obstacles if not isinstance(o, Ground)]

    @cached_property
    def roofs(self) -> Solids:
        """What counts as ground besides it: height maps, and boxes at rest that are no zones."""
        return join_solids([o.solid for o in self.solids if is_ground(o)])

    def height_below(self, x: ArrayLike, y: ArrayLike, z: ArrayLike = np.inf) -> Floats:
        """Height [m] of what is below points (x, y) [m], arrays of one shape or numbers; minus infinity: nothing.

        It is that of the highest ground, terrain (`heights`) or roof (the upper side of a `box`, turned or not), of
        those whose underside is not above z [m]. Zones, obstacles that move, appear or vanish, and other shapes do not
        count, and neither does a box of whose upper side z is more than a metre below: it is beside.
        """
        x, y, z = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (x, y, z)))
        return np.maximum(top_of_solids_below(x, y, z, self.roofs), self.ground)

    def is_standing(self, r: Floats) -> Bools:
        """Which vehicles at r (N, 3) [m] stand on what is below them, (N,)."""
        return r[:, 2] - self.fleet.radius - self.height_below(*r.T) <= _STANDING

    def landing_swaps_in_words(self, end: Floats) -> str:
        """Which vehicles land where which other one stood, of those at ``end`` (N, 3) [m]; "" if none does."""
        start, stand = self.fleet.position, self.is_standing(end)
        if len(end) < 2 or not (self.is_standing(start) & stand).any():
            return ""
        from scipy.spatial import KDTree

        pads, standing = KDTree(start[:, :2]), np.flatnonzero(stand)  # none without a position
        far, near = pads.query(end[standing, :2])
        # A place reaches half the way to the next one.
        there = far < 0.5 * pads.query(start[near, :2], 2)[0][:, 1]
        others = np.flatnonzero(there & (near != standing))
        who = first_few([f"{standing[k] + 1} where {near[k] + 1} did" for k in others])
        words = f"{len(others)} of {len(end)} vehicles land where another one stood: {who}"
        return words if others.size else ""

    @cached_property
    def tracking_gains(self) -> tuple[float, float]:
        """Gains k1 [1/s^2] and k2 [1/s] of local tracking."""
        return double_integrator_gains(self.tracking.Q, self.tracking.R)

    @cached_property
    def vehicle_models(self) -> list[VehicleModel] | None:
        """The vehicle of each agent; None if all are point masses that give any force at once."""
        if not self.agents.vehicle:
            return None
        models = {name: model_of_vehicle(vehicle) for name, vehicle in self.vehicles.items()}
        return [models[name] for name in self.agents.vehicle]

    @cached_property
    def all_disturbances(self) -> Disturbances:
        """The disturbances; without the table, some that do nothing."""
        return self.disturbances or Disturbances.model_construct()

    @cached_property
    def true_mass(self) -> Floats:
        """True mass (N,) [kg] of each vehicle. The control laws use `agents.mass`."""
        return self.fleet.mass * (1.0 + np.array(self.all_disturbances.mass_error))

    @cached_property
    def drag(self) -> Floats:
        """Drag coefficient (N,) of each vehicle: force per velocity relative to the air [N s/m].

        Of a quadrotor it is the drag across its rotors' axes near hover.
        """
        if self.vehicle_models is not None:
            return np.array([model.linear_drag[0] for model in self.vehicle_models])
        d = self.all_disturbances
        moves_air = any(d.wind) or d.gusts is not None
        own = d.drag if d.drag is not None else DRAG * self.fleet.mass if moves_air else 0.0
        return np.broadcast_to(np.array(own, dtype=np.float64), self.n_agents).copy()

    @cached_property
    def lost_at(self) -> Floats:
        """Time (N,) [s] at which each vehicle is lost; infinity for those that are not lost."""
        when = np.full(self.n_agents, np.inf)
        for lost in self.all_disturbances.lost:
            when[lost.agent - 1] = lost.time
        return when

    @cached_property
    def links_lost(self) -> tuple[Ints, Floats]:
        """The links that are lost: pairs (L, 2) of agents from 0, i < j, and times (L,) [s]."""
        lost = self.network.lost if self.network is not None else ()
        pairs = np.array([sorted(link.between) for link in lost], dtype=np.int64).reshape(-1, 2)
        return pairs - 1, np.array([link.time for link in lost], dtype=np.float64)

    def has_link(self, edges: Ints, t: float) -> Bools:
        """Mask (m,) of the edges (m, 2), i < j, whose link is not lost at a time [s]."""
        pairs, times = self.links_lost
        n = self.n_agents
        lost = pairs[times < t]
        return ~np.isin(edges[:, 0] * n + edges[:, 1], lost[:, 0] * n + lost[:, 1])

    @cached_property
    def first_loss(self) -> float:
        """Time [s] at which the first vehicle or link is lost; infinity if none is."""
        return float(min(self.lost_at.min(), self.links_lost[1].min(initial=np.inf)))

    @property
    def first_lost(self) -> str:
        """What is lost first, in words: agent 2, agents 1 and 2, the link 1-3."""
        pairs, times = self.links_lost
        when = self.first_loss
        who = np.flatnonzero(self.lost_at == when)
        words = [agent_names(who)] if len(who) else []
        words += [f"the link {i + 1}-{j + 1}" for i, j in pairs[times == when]]
        return " and ".join(words)

    @cached_property
    def aborting(self) -> Aborting:
        """How the flight is aborted: [abort], or its defaults."""
        return self.abort or Aborting.model_construct()

    @property
    def abandons_at(self) -> float:
        """Time [s] at which the flight leaves its plan, for a loss that is answered or an abort; infinity if never."""
        return min(self._loss_and_abort_times)

    @property
    def aborts(self) -> bool:
        """Whether it then aborts, by [abort]."""
        loss, abort = self._loss_and_abort_times
        return abort < loss

    @property
    def _loss_and_abort_times(self) -> tuple[float, float]:
        """Times [s] at which the others brake after a loss, and at which the flight aborts; infinity if never."""
        options, loss = self.aborting, math.inf if self.on_loss == "continue" else self.first_loss
        order = math.inf if options.at is None else options.at
        if self.on_loss == "abort":
            order, loss = min(order, loss), math.inf
        return loss, order + options.reaction

    @property
    def on_loss(self) -> Literal["continue", "hold", "land", "abort"]:
        """What the others do when a vehicle or link is lost."""
        return self.all_disturbances.on_loss


def _automatic_damping(mission: Mission, name: str, *lost: int) -> float:
    """`Mission.damping` "auto" at a formation with slots, without the vehicles that are lost."""
    left = ~np.isin(np.arange(mission.n_agents), lost)
    edges, masses = mission.formation_edges(name), mission.fleet.mass[left]
    slots = mission.formation_slots(name)
    assert slots is not None
    edges = (np.cumsum(left) - 1)[edges[left[edges].all(axis=1)]]
    if not len(edges) or min(len(edges), 3 * len(masses)) > _DENSE:
        return _DAMPING[1]
    J = constraint_jacobian.jacobian(slots[None, left], edges)
    (singular,) = constraint_jacobian.least_singular(J, masses)  # of mbar J M^-1 J^T
    return float(np.clip(singular**2 / 4, *_DAMPING))
