"""The record of a flight, of which arrays are made when they are first asked for."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import InitVar, asdict, dataclass, field, fields
from datetime import UTC, datetime
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, get_type_hints

import numpy as np

from rigidfleet._common.arguments import as_path
from rigidfleet._common.facts import Fact, FactTable, Row, Sheet, Shown, table_of_worst_values
from rigidfleet._common.files import write_file
from rigidfleet._common.quantities import PLACES, quantity
from rigidfleet._common.renamed import with_earlier_members
from rigidfleet._common.waypoints import PAD
from rigidfleet.errors import MissionError, ResultError, wrong_type
from rigidfleet.result.netcdf import ATTRIBUTES, LABELS, Variable, netcdf_content, read_netcdf
from rigidfleet.result.phases import Extremum, PhaseRecord
from rigidfleet.setpoints import Setpoints, csv_text, setpoints_at_rate, states_with_jerk
from rigidfleet.typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from rigidfleet.mission import Mission


_LABELLED = {dim: len(names) for dim, names in LABELS.items()}


#: Quantities whose worst values are shown.
_WORST = ("separation", "clearance", "speed", "thrust", "rotor_force", "tracking_error")


#: Names of fields, and a function that computes them when they are first asked for.
Later = Sequence[tuple[tuple[str, ...], Callable[[], dict[str, Any]]]]


@cache
def _installed_versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in ("rigidfleet", "numpy", "scipy", "numba", "h5netcdf"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


@with_earlier_members(evaluate="compute_lazy_values", motion="setpoints_at_samples")
@dataclass(kw_only=True, eq=False, repr=False)
class Result(Shown):
    """Record of a flight: the states of all vehicles, the forces on them, and the mission.

    `simulate` returns one; `save` writes it to a netCDF-4 file, and `Result.load` reads it back:

    >>> import rigidfleet as rf
    >>> result = rf.simulate("narrow-passage")
    >>> result.position.shape  # samples, agents, x y z [m]
    (1812, 3, 3)
    >>> result.save("passage.nc")
    >>> rf.assess(rf.Result.load("passage.nc")).passed
    True

    Arrays have K samples in time, N agents (counted from 0) and m edges, the union over all formations.
    Each change of phase has two samples, because references and inputs jump there: the end of one phase and, one
    representable number later, the start of the next. `VARIABLES` gives the dimensions, unit and meaning of each
    array. The other fields describe the flight: its phases, its mission and how it ended.

    `simulate` fills in the states. Forces, frames, rates and distances are computed when one of them is first asked
    for; their values do not depend on when that is.

    Raises
    ------
    ValueError
        An array has the wrong shape, an index is out of range, or time does not increase.
    """

    time: Annotated[Floats, "time | s | mission time"]
    phase: Annotated[Ints, "time | 1 | index of the phase flown, from 0"]

    position: Annotated[Floats, "time agent axis | m | position, world axes (ENU)"]
    velocity: Annotated[Floats, "time agent axis | m s-1 | velocity, world axes"]
    acceleration: Annotated[Floats, "time agent axis | m s-2 | acceleration, world axes"]
    slot_position: Annotated[Floats, "time agent axis | m | desired position, world axes"]

    input_force: Annotated[Floats, "time agent axis | N | input force f_u, world axes"]
    constraint_force: Annotated[Floats, "time agent axis | N | constraint force f_C, world axes"]
    external_force: Annotated[Floats, "time agent axis | N | gravity and disturbances, world axes"]
    thrust: Annotated[
        Floats, "time agent | N | thrust |f_u + f_C|, clipped at the limit if thrust saturates"
    ]

    cm: Annotated[Floats, "time axis | m | centre of mass, world axes"]
    cm_velocity: Annotated[Floats, "time axis | m s-1 | velocity of the centre of mass"]
    cm_reference: Annotated[Floats, "time axis | m | commanded centre of mass"]
    cm_velocity_reference: Annotated[
        Floats, "time axis | m s-1 | commanded velocity of the centre of mass"
    ]

    attitude: Annotated[
        Floats, "time quaternion | 1 | attitude of the formation, world to body, scalar first"
    ]
    attitude_reference: Annotated[Floats, "time quaternion | 1 | commanded attitude"]
    frame: Annotated[Floats, "time quaternion | 1 | integrated mean-axis frame"]
    rates: Annotated[Floats, "time axis | rad s-1 | angular velocity, body axes (p, q, r)"]
    rates_reference: Annotated[
        Floats, "time axis | rad s-1 | commanded angular velocity, body axes"
    ]

    wrench_asked: Annotated[
        Floats, "time wrench | N or N m | commanded wrench: force, torque about the centre of mass"
    ]
    wrench_achieved: Annotated[
        Floats, "time wrench | N or N m | resulting wrench: force, torque about the centre of mass"
    ]

    edges: Annotated[Ints, "edge end | 1 | the two agents of each edge, from 0"]
    distance: Annotated[Floats, "time edge | m | edge length L"]
    distance_reference: Annotated[Floats, "time edge | m | reference d of an edge's length"]
    distance_rate_reference: Annotated[Floats, "time edge | m s-1 | rate of the reference d"]
    constraint: Annotated[Floats, "time edge | m | constraint error c = L - d"]
    integral: Annotated[Floats, "time edge | m s | integral of the constraint error"]
    multiplier: Annotated[Floats, "time edge | N | multiplier lambda; the tension is -lambda"]
    singular_value: Annotated[
        Floats,
        "time | 1 | smallest non-zero singular value of the constraint Jacobian J; with many agents, at some "
        "samples only",
    ]

    separation: Annotated[
        Floats,
        "time | m | least separation between two agents: centre distance minus radii; the sample after the "
        "minimum of a phase has that minimum",
    ]
    separation_pair: Annotated[
        Ints, "time end | 1 | the two agents with the least separation, from 0; -1 for none"
    ]
    clearance: Annotated[
        Floats,
        "time | m | clearance to the nearest obstacle: distance minus radius; the sample after the minimum of a "
        "phase has that minimum",
    ]
    clearance_agent: Annotated[
        Ints, "time | 1 | the agent with the least clearance, from 0; -1 for none"
    ]
    clearance_obstacle: Annotated[
        Ints, "time | 1 | the obstacle nearest to an agent, from 0; -1 for none"
    ]

    disturbance_force: Annotated[
        Floats | None,
        "time agent axis | N | force of the air, part of external_force; missing in still air",
    ] = None
    measured_position: Annotated[
        Floats | None, "time agent axis | m | measured position; missing without noise"
    ] = None
    measured_velocity: Annotated[
        Floats | None, "time agent axis | m s-1 | measured velocity; missing without noise"
    ] = None

    vehicle_attitude: Annotated[
        Floats | None,
        "time agent quaternion | 1 | attitude of each vehicle, world to body, scalar first; missing without vehicles",
    ] = None
    vehicle_rates: Annotated[
        Floats | None,
        "time agent axis | rad s-1 | angular velocity of each vehicle, body axes; missing without vehicles",
    ] = None
    rotor_force: Annotated[
        Floats | None, "time agent rotor | N | thrust of each rotor; missing without vehicles"
    ] = None
    saturated: Annotated[
        Ints | None,
        "time agent | 1 | 1 if a vehicle cannot give what is asked of it, else 0; missing without vehicles",
    ] = None
    vehicle_clock: Annotated[
        Floats | None,
        "time agent | s | time along the plan by each vehicle's own clock; missing with one clock for all",
    ] = None
    message_age: Annotated[
        Floats | None,
        "time edge link | s | age of the newest message that the agents of an edge have of each other; NaN before the "
        "first; missing without [network]",
    ] = None
    messages: Annotated[
        Ints | None,
        "edge link message | 1 | messages of the whole flight; missing without [network]",
    ] = None
    oldest_message: Annotated[
        Floats | None,
        "edge link | s | greatest age of a message when it was used; missing without [network]",
    ] = None
    clock_rate: Annotated[
        Floats | None, "time | 1 | rate of the virtual clock; missing without [avoidance]"
    ] = None
    body_displacement: Annotated[
        Floats | None,
        "time axis | m | displacement of the reference from the planned path, by the body layer; missing without "
        "[avoidance]",
    ] = None
    avoidance_layers: Annotated[
        Ints | None,
        "time agent | 1 | sum of the layers that change what an agent is asked for: 1 barriers, 2 guard, 4 guard "
        "by braking; missing without [avoidance]",
    ] = None
    slot_velocity: Annotated[
        Floats | None, "time agent axis | m s-1 | desired velocity, world axes"
    ] = None
    slot_acceleration: Annotated[
        Floats | None, "time agent axis | m s-2 | desired acceleration, world axes"
    ] = None
    slot_jerk: Annotated[Floats | None, "time agent axis | m s-3 | desired jerk, world axes"] = None
    yaw: Annotated[
        Floats | None, "time agent | rad | desired yaw of each vehicle, from east to north"
    ] = None
    yaw_rate: Annotated[Floats | None, "time agent | rad s-1 | desired yaw rate"] = None

    phases: list[PhaseRecord]
    mission_text: str
    later: InitVar[Later] = ()
    complete: bool = True
    ending: str = ""
    statistics: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=lambda: dict(_installed_versions()))
    platform: str = field(default_factory=platform.platform)
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    def __post_init__(self, later: Later) -> None:
        values = self.__dict__
        self._later = {name: make for names, make in later for name in names}
        for name in self._later:
            del values[name]
        sizes: dict[str, int] = dict(_LABELLED)
        for name in "time", "position", "edges":
            if isinstance(array := values[name], np.ndarray):
                pairs = zip(VARIABLES[name].dims, array.shape, strict=False)
                sizes.update(pair for pair in pairs if pair[0] not in _LABELLED)
        for name in [name for name in values if name in VARIABLES]:
            value = values[name]
            if value is not None or not VARIABLES[name].optional:
                self._set_array(name, value, sizes)
        if not later:  # what a flight of this process has made is right
            self._check_array_values(sizes)
        self._sizes = sizes

    def _check_array_values(self, sizes: dict[str, int]) -> None:
        """Check values: they come from somewhere else."""
        values = self.__dict__
        if sizes["time"] == 0 or sizes["agent"] == 0:
            raise ValueError("a result needs at least one sample and one agent")
        time, phase = self.time, self.phase
        ends = math.isfinite(time[0]) and math.isfinite(time[-1])
        if not (ends and (time[1:] > time[:-1]).all()):
            raise ValueError("time must be finite and strictly increasing")
        if (phase[1:] < phase[:-1]).any():
            raise ValueError("phase must not decrease")
        if phase[0] < 0 or phase[-1] >= len(self.phases):
            raise ValueError(f"phase has indices outside 0 to {len(self.phases) - 1}")
        n = sizes["agent"]
        for name, least in (("edges", 0), ("separation_pair", -1), ("clearance_agent", -1)):
            who = values.get(name)  # None if it is made later
            if who is not None and who.size and not least <= who.min() <= who.max() < n:
                raise ValueError(f"{name} has agents outside {least} to {n - 1}")
        agents, rotors = range(n), range(4)
        for name, x in self._extremes():
            # A clearance names an obstacle, a rotor's force its rotor
            if name == "rotor_force":
                alone = x.other not in rotors
            else:
                alone = not (-1 <= x.other < n and x.other != x.who)
                alone = alone and quantity(name).who not in PLACES
            if alone or x.who not in agents:
                raise ValueError(f"extreme {name} must name different agents from 0 to {n - 1}")
        for name in (name for name, v in VARIABLES.items() if "quaternion" in v.dims):
            q = values.get(name)  # most have a scalar part, which is found in a fifth of the time
            if q is not None and not q[..., 0].all() and not q.any(axis=-1).all():
                raise ValueError(f"{name} has a quaternion of norm zero")
        if (self.edges[:, 0] == self.edges[:, 1]).any():
            raise ValueError("an edge joins an agent to itself")

    def _set_array(self, name: str, array: Any, sizes: dict[str, int]) -> None:
        """Set an array whose dimensions agree with ``sizes``, which learns new ones."""
        dims = VARIABLES[name].dims
        value = np.ascontiguousarray(
            array, dtype=np.int64 if VARIABLES[name].integers else np.float64
        )
        expected = tuple([sizes.get(dim, "any") for dim in dims])
        known = [sizes.setdefault(*pair) for pair in zip(dims, value.shape, strict=False)]
        if value.ndim != len(dims) or (*known,) != value.shape:
            raise ValueError(
                f"{name} ({', '.join(dims)}) has shape {value.shape}, expected {expected}"
            )
        setattr(self, name, value)

    def __getattr__(self, name: str) -> Any:
        """Compute what the flight alone does not need when it is first asked for: it takes longer than the flight."""
        make = self.__dict__.get("_later", {}).get(name)
        if make is None:
            if name in self.__dict__:  # another thread has just made it
                return self.__dict__[name]
            raise AttributeError(f"a result has no {name!r}")
        made = make()
        for key, value in made.items():
            if key in self._later and key not in self.__dict__:  # nor has somebody set it
                if key in VARIABLES:
                    self._set_array(key, value, self._sizes)
                else:
                    setattr(self, key, value)
        # Another one, as a copy of this result may have to make the same.
        self._later = {key: other for key, other in self._later.items() if key not in made}
        return self.__dict__[name]

    def compute_lazy_values(self) -> Result:
        """Compute now what is computed when it is first asked for, as before a copy goes elsewhere; return itself."""
        for name in [*self._later]:
            getattr(self, name)
        return self

    def __dir__(self) -> list[str]:
        """Names that can be asked for, also of what is not computed yet: consoles and notebooks complete them."""
        return sorted({*super().__dir__(), *self.__dict__.get("_later", ())})

    def __repr__(self) -> str:
        end = "complete" if self.complete else f"incomplete: {self.ending or 'stopped'}"
        return (
            f"<Result: {self.n_agents} agents, {len(self.edges)} edges, {len(self.phases)} phases, "
            f"{len(self.time)} samples from {self.time[0]:g} to {self.time[-1]:g} s, {end}>"
        )

    def facts(self) -> Sheet:
        """What the flight consists of, and its worst values."""
        try:
            name, title = self.mission.name, self.mission.title
        except ResultError:
            name, title = "Result", "of a mission that cannot be read"
        end = "complete" if self.complete else f"incomplete: {self.ending or 'stopped'}"
        about = {
            "agents": self.n_agents,
            "edges": len(self.edges) or None,
            "phases": ", ".join(phase.name for phase in self.phases),
            "time": f"{self.time[0]:g} to {self.time[-1]:g} s, {len(self.time)} samples",
            "ending": end,
        }
        rows = [Row(item) for item in about.items() if item[1] is not None]
        worst = [
            Fact(f"{q.sense} {q.name_in_words}", x.value, q.unit, when=x.time)
            for q in map(quantity, _WORST)
            if (x := self.extreme(q.name)) is not None and math.isfinite(x.value)
        ]
        contents = FactTable(("about", "result"), rows, ("result",), bare=True)
        return Sheet(name, title, [contents, table_of_worst_values("quantity", worst)])

    @property
    def n_agents(self) -> int:
        """Number of agents N."""
        return self.position.shape[1]

    @property
    def edge_labels(self) -> list[str]:
        """Name of each edge, agents counted from 1: "1-2"."""
        return [f"{i + 1}-{j + 1}" for i, j in self.edges]

    @cached_property
    def mission(self) -> Mission:
        """The mission, parsed from `mission_text` on first access.

        Raises
        ------
        ResultError
            This version of rigidfleet does not accept the mission, or the mission does not match the arrays.
        """
        from rigidfleet.mission.loading import recorded_mission

        try:
            mission = recorded_mission(self.mission_text, "mission of the result")
        except MissionError as error:
            made = self.versions.get("rigidfleet", "an unknown version")
            message = (
                f"the mission in the result cannot be read (written by rigidfleet {made}):\n{error}"
            )
            raise ResultError(message) from error
        if wrong := self._contradiction_in_words(mission):
            raise ResultError(
                f"the mission in the result belongs to another flight: {wrong}. Fly it again or use another copy."
            )
        return mission

    def _contradiction_in_words(self, mission: Mission) -> str:
        """Describe how the arrays contradict a mission; "" if they agree."""
        from rigidfleet.mission import KINDS

        if mission.n_agents != self.n_agents:
            return f"the mission has {mission.n_agents} agents, the arrays have {self.n_agents}"
        if mission.vehicle_models is not None and self.rotor_force is None:
            return "it flies vehicles with rotors, of which the arrays have none"
        if len(self.statistics.get("spans", ())) not in (0, self.n_agents):
            return "the file has spans of other agents"
        if not np.array_equal(mission.edges, self.edges):
            return "the edges of its formations differ from those of the arrays"
        named = [x.other for key, x in self._extremes() if key.startswith("clear")]
        n = len(mission.obstacles)
        if self.clearance_obstacle.max() >= max(n, 1) or not {*named} <= {*range(n)}:
            return "the arrays name more obstacles than it has"
        if unknown := {p.kind for p in self.phases} - {*KINDS}:
            return f"there is no kind of phase {min(map(repr, unknown))}"
        unknown = {p.formation for p in self.phases} - {None, *mission.formations}
        return f"it has no formation {min(map(repr, unknown))}" if unknown else ""

    @cached_property
    def left(self) -> Bools:
        """Mask (K, N) of the agents that are not lost at the time of each sample, or that a file has then."""
        if spans := self.statistics.get("spans"):
            return presence(self.time, spans, self.n_agents)
        lost_at = self.mission.lost_at
        if self.time[-1] <= lost_at.min():
            return np.ones((len(self.time), len(lost_at)), dtype=np.bool_)
        return self.time[:, None] <= lost_at

    @property
    def interpolation(self) -> str | None:
        """In words, the curve between samples of a flight that others made; None for a flight of our own."""
        return self.statistics.get("interpolation")

    @cached_property
    def motors_off(self) -> Floats:
        """Time (N,) [s] from which each vehicle may have its motors off: the end of the landing after which it stays.

        Infinity for a vehicle that does not end on the ground, or that got there without a landing.
        """
        from rigidfleet.mission import KINDS  # takes long to load

        off = np.full(self.n_agents, np.inf)
        over = self.position[:, :, 2] - self.mission.fleet.radius
        over = over - self.mission.height_below(*np.moveaxis(self.position, 2, 0))
        down = self.left & (over <= PAD)
        for i, phase in enumerate(self.phases):
            rows = self.samples(i)
            k = rows.stop - 1
            if KINDS[phase.kind].lands and k >= rows.start and self.time[k] >= phase.t_end:
                off = np.where(down[k:].all(axis=0), np.minimum(off, self.time[k]), off)
        return off

    def samples(self, phase: int) -> slice:
        """Slice of the samples of a phase; empty if the phase was not reached.

        The index counts from 0, or from the end if it is negative.
        """
        index = range(len(self.phases))[phase]
        first, last = np.searchsorted(self.phase, [index, index + 1])
        return slice(int(first), int(last))

    def _extremes(self) -> Iterator[tuple[str, Extremum]]:
        """Names and worst values of all phases."""
        for phase in self.phases:
            yield from phase.extremes.items()

    def extreme(self, name: str) -> Extremum | None:
        """Worst value of a quantity over the whole flight, in continuous time; None if unknown.

        Names are those of `PhaseRecord.extremes`.
        """
        every = [x for key, x in self._extremes() if key == name]
        rank = quantity(name).rank
        return max(every, key=lambda x: rank(x.value), default=None)

    def save(self, path: str | Path) -> None:
        """Write the result to a netCDF-4 file.

        The file appears in one step once all data are written. If writing fails, an existing file is unchanged.

        Raises
        ------
        ResultError
            The file cannot be written.
        """
        every = {name: getattr(self, name) for name in VARIABLES}
        arrays = {name: value for name, value in every.items() if value is not None}
        attributes = {name: getattr(self, name) for name in ATTRIBUTES}
        attributes["phases"] = [asdict(phase) for phase in self.phases]
        write_file(as_path(path), netcdf_content(VARIABLES, arrays, self.edge_labels, attributes))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a result written by `save`.

        Raises
        ------
        ResultError
            The file does not exist, is not a result, is damaged, or has another format version.
        """
        path = as_path(path)
        try:
            return cls(**read_netcdf(path, VARIABLES))
        except ResultError:
            raise
        except MemoryError as error:
            raise ResultError(f"{path}: there is not enough memory to read this result.") from error
        except Exception as error:  # a damaged file can cause almost any error
            why = " ".join(str(error).split()) or type(error).__name__
            raise ResultError(
                f"{path}: the result is damaged ({why}). Fly its mission again or use another copy."
            ) from error

    def setpoints(self, rate: float | None = None, *, flown: bool = False) -> Setpoints:
        """Position, velocity, acceleration, jerk, yaw and yaw rate of each vehicle: the reference, or what was flown.

        Parameters
        ----------
        rate : setpoints per second [Hz], on polynomials of degree 7 (yaw: 3) between samples; by default the samples
            themselves, of which the later one counts at a change of phase
        flown : give the motion flown instead of its reference; its jerk is that of quintics between samples, and its
            yaw that of the reference

        Raises
        ------
        ValueError
            The rate is not positive, or gives too many setpoints.
        """
        return setpoints_at_rate(self.setpoints_at_samples(flown=flown), rate)

    def setpoints_at_samples(self, *, flown: bool = False) -> Setpoints:
        """The setpoints of every sample, of which there are two at a change of phase; see `setpoints`."""
        references = self.slot_position, self.slot_velocity, self.slot_acceleration, self.slot_jerk
        nothing = np.full(self.position.shape, np.nan)
        state = np.stack([nothing if x is None else x for x in references], axis=1)
        if flown:
            motion = self.position, self.velocity, self.acceleration
            # Forces jump where two samples have one time: at a change of phase and at a loss.
            jumps = np.flatnonzero(np.nextafter(self.time[:-1], np.inf) >= self.time[1:]) + 1
            parts = zip(*(np.split(x, jumps) for x in (*motion, self.time)), strict=True)
            state = np.concatenate([states_with_jerk(*part) for part in parts])
        yaw = [nothing[:, :, 0] if x is None else x for x in (self.yaw, self.yaw_rate)]
        return Setpoints(self.time, state, *yaw)

    def to_csv(self, path: str | Path, *, rate: float | None = None, flown: bool = False) -> None:
        """Write the setpoints of each vehicle to a CSV file, one row per time and agent, to 9 digits.

        Columns: time_s, agent (from 1), position x_m, y_m, z_m, velocity vx_m_s..., acceleration ax_m_s2..., jerk
        jx_m_s3..., yaw_rad, yaw_rate_rad_s. Parameters are those of `setpoints`. Cells are empty where slots are not
        tracked. Like `save`, this never leaves a partial file.

        Raises
        ------
        ResultError
            The file cannot be written.
        ValueError
            The rate is not positive, or gives too many setpoints.
        """
        write_file(as_path(path), csv_text(self.setpoints(rate, flown=flown)).encode())


# `help` shows this signature first. The forty arrays are left out: their units stand at their declarations.
vars(Result.__init__)["__signature__"] = signature(lambda self, **fields: None)


_HINTS = get_type_hints(Result, include_extras=True)


def _parse_declaration(hint: Any, *, optional: bool) -> Variable:
    """The declaration that stands beside the type of a field: dimensions | unit | meaning."""
    dims, units, text = hint.__metadata__[0].split(" | ", 2)
    return Variable(
        tuple(dims.split()), units, text, hint.__origin__ in (Ints, Ints | None), optional
    )


#: Dimensions, unit and meaning of each array of a result.
VARIABLES: dict[str, Variable] = {
    f.name: _parse_declaration(_HINTS[f.name], optional=f.default is None)
    for f in fields(Result)
    if hasattr(_HINTS[f.name], "__metadata__")
}


#: Variables that are computed when they are first asked for: references of slots; distances; what the law makes of the
#: states, and what is measured of that, as a rule; as a rule, with noise, too.
LATER = ("slot_velocity", "slot_acceleration", "slot_jerk", "yaw", "yaw_rate")
CLOSE = ("separation", "separation_pair", "clearance", "clearance_agent", "clearance_obstacle")
_FLOWN = ("time", "phase", "position", "velocity", "edges", "singular_value")
RECORDED = tuple(
    name for name, v in VARIABLES.items() if not (v.optional or name in (*_FLOWN, *CLOSE))
)
SEEN = ("measured_position", "measured_velocity")
# The default of the field remains; without the class's attribute, `__getattr__` is called.
for _name in (*LATER, *SEEN, "disturbance_force"):
    delattr(Result, _name)


def presence(time: Floats, spans: Sequence[Sequence[float]], n: int) -> Bools:
    """Mask (K, N) of n agents that are there at times (K,) [s], each after the begin of its span and up to its end [s].

    An agent that is there at the first time counts then, too; without spans, all agents always do.
    """
    begin, end = np.reshape(spans or [(-np.inf, np.inf)] * n, (n, 2)).T
    return ((time[:, None] > begin) | (begin <= time[0])) & (time[:, None] <= end)


def as_result(value: Result | str | Path) -> Result:
    """Return the `Result` that was given, or read it from its file.

    Raises
    ------
    TypeError
        The argument is neither a `Result` nor a path.
    ResultError
        As `Result.load` does.
    """
    if isinstance(value, Result):
        return value
    if isinstance(value, str | Path):
        return Result.load(value)
    raise wrong_type("a flight (a Result or the path of one that was saved)", value)
