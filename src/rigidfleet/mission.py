"""Missions: what the user asked for, read from TOML and checked on entry. Data only.

A mission is checked as a whole and *all* its errors are raised at once, in one `MissionError` whose findings
name the file, the key, the value and the remedy. Keys read like `phases[3].until`; everything a user sees
counts from 1 as in the paper: agents, edges, phases, and so the places in a key. Arrays that the helpers of
`Mission` return count agents from 0.
"""

from __future__ import annotations

import difflib
import json
import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from importlib import resources
from itertools import islice
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Self, Union, get_args, get_origin

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    PrivateAttr,
    Strict,
    Tag,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from rigidfleet import formation as shapes
from rigidfleet.errors import Finding, MissionError
from rigidfleet.formation import Floats, Ints

SCHEMA_VERSION = 1

# -- what a mission holds -----------------------------------------------------------------------------
# The descriptions below are the documentation of the format: `rigidfleet missions --schema` exports them.

Number = Annotated[float, Strict()]
Positive = Annotated[float, Strict(), Field(gt=0)]
NonNegative = Annotated[float, Strict(), Field(ge=0)]
Count = Annotated[int, Strict(), Field(ge=1)]
Flag = Annotated[bool, Strict()]
Vector = Annotated[tuple[Number, ...], Field(min_length=3, max_length=3)]
Pair = Annotated[tuple[Annotated[int, Strict()], ...], Field(min_length=2, max_length=2)]
Weights2 = Annotated[tuple[NonNegative, ...], Field(min_length=2, max_length=2)]


def _kind_of_value(value: object) -> str:
    return "list" if isinstance(value, list | tuple) else "one"


#: One size, or three for a cuboid.
Size = Annotated[
    Annotated[Positive, Tag("one")]
    | Annotated[Annotated[tuple[Positive, ...], Field(min_length=3, max_length=3)], Tag("list")],
    Discriminator(_kind_of_value),
]
Edges = Annotated[
    Annotated[Literal["complete"], Tag("one")] | Annotated[tuple[Pair, ...], Tag("list")],
    Discriminator(_kind_of_value),
]


def _per_agent(lowest: str) -> WithJsonSchema:
    number = {"type": "number", lowest: 0}
    return WithJsonSchema({"anyOf": [number, {"type": "array", "items": number}]})


class Part(BaseModel):
    """A table of a mission file: frozen, without unknown keys, with finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Agents(Part):
    """The vehicles, as point masses. A number instead of a list stands for every agent."""

    mass: Annotated[tuple[Positive, ...], _per_agent("exclusiveMinimum")] = Field(
        description="mass of each agent [kg], > 0: a number, or a list with one for each agent"
    )
    position: Annotated[tuple[Vector, ...], Field(min_length=1)] = Field(
        description="initial position [x, y, z] of each agent [m], world frame ENU (z up)"
    )
    velocity: tuple[Vector, ...] = Field(
        default=(), description="initial velocity of each agent [m/s]; at rest when absent"
    )
    radius: Annotated[tuple[NonNegative, ...], _per_agent("minimum")] = Field(
        default=0.25,  # spread over the agents below
        validate_default=True,
        description="radius of the sphere around each agent that must touch nothing [m]: a number or a list",
    )
    thrust_limit: Annotated[
        tuple[Annotated[float, Strict(), Field(gt=0, allow_inf_nan=True)], ...],
        _per_agent("exclusiveMinimum"),
    ] = Field(
        default=math.inf,
        validate_default=True,
        description="greatest thrust |f_u + f_C| of each agent [N]: a number or a list; unlimited when absent",
    )
    saturate: Flag = Field(
        default=False,
        description="true: thrust is cut off at thrust_limit; false: it is only judged against it",
    )

    @model_validator(mode="before")
    @classmethod
    def _spread(cls, data: Any) -> Any:
        """One number stands for all agents; agents without velocities start at rest."""
        if not (isinstance(data, dict) and isinstance(data.get("position"), list | tuple)):
            return data
        n = len(data["position"])
        full = {"velocity": [[0.0, 0.0, 0.0]] * n, "radius": 0.25, "thrust_limit": math.inf} | data
        for key in ("mass", "radius", "thrust_limit"):
            if key in full and not isinstance(full[key], list | tuple):
                full[key] = [full[key]] * n
        return full


class Constraint(Part):
    """The constraint force: stabilisation gains, and how the multipliers are solved for."""

    alpha: Number = Field(
        default=3.0, description="gain of the rate of c = L - d, 2 alpha [1/s]; > 0"
    )
    beta: Number = Field(
        default=math.sqrt(12), description="gain of c, beta^2 [1/s^2]: beta [1/s]; > 0"
    )
    gamma: Number = Field(
        default=8.0,
        description="gain of the integral of c [1/s^3]; >= 0, stable when 2 alpha beta^2 > gamma",
    )
    stabilisation: Literal["pid", "none"] = Field(
        default="pid",
        description="'none': no feedback of c at all, the law whose drift the paper discusses",
    )
    solver: Literal["iterated", "spectral", "exact", "pinv"] = Field(
        default="iterated",
        description="multipliers: iterated Tikhonov; spectral damping (gentler under steps); the paper's inverse; pinv",
    )
    damping: Positive = Field(default=0.03, description="mu of the iterated solver [-], > 0")
    iterations: Count = Field(default=3, description="k of the iterated solver, >= 1")
    threshold: Positive = Field(default=0.1, description="s0 of the spectral solver [-], > 0")
    cutoff: Annotated[float, Strict(), Field(ge=0, lt=1)] = Field(
        default=1e-12, description="relative cut-off of the pinv solver [-], in [0, 1)"
    )
    deformation_damping: NonNegative = Field(
        default=1.0, description="damping of deformation while no slots are tracked [1/s], >= 0"
    )


class Regulator(Part):
    """Weights of a linear quadratic regulator for a double integrator, alike on each axis."""

    horizon: Literal["finite", "infinite"] = Field(
        default="finite",
        description="finite: the cost ends with S at the phase's end; infinite: Q and R alone",
    )
    Q: Weights2 = Field(default=(0.0, 0.0), description="weights [error, rate error], each >= 0")
    R: Positive = Field(default=1.0, description="weight of the acceleration, > 0")
    S: Weights2 = Field(
        default=(1e3, 1e2), description="final weights [error, rate error], each >= 0"
    )


class Lqr(Regulator):
    """Regulator of the virtual body: its centre of mass here, its attitude in `lqr.attitude`."""

    attitude: Regulator = Field(
        default_factory=Regulator,
        description="regulator of the attitude; its keys default to those of lqr",
    )

    @model_validator(mode="before")
    @classmethod
    def _inherit(cls, data: Any) -> Any:
        if not (isinstance(data, dict) and isinstance(data.get("attitude", {}), dict)):
            return data
        own = {key: value for key, value in data.items() if key in Regulator.model_fields}
        return data | {"attitude": own | data.get("attitude", {})}


class Tracking(Part):
    """Infinite-horizon regulator with which each agent tracks its own slot."""

    Q: Weights2 = Field(
        default=(4.0, 4.0), description="weights [position error, velocity error], Q[1] > 0"
    )
    R: Positive = Field(default=1.0, description="weight of the acceleration, > 0")


class Allocation(Part):
    """How the wrench on the virtual body is shared among the agents (architecture 'body')."""

    method: Literal["rigid", "pinv"] = Field(
        default="rigid",
        description="rigid: each agent gets what a rigid body's point needs; pinv: the paper's H",
    )
    torque_split: Literal["equal", "inertia", "inertia+force"] = Field(
        default="equal", description="pinv only: how the torque is split over the rows of H"
    )


class Integrator(Part):
    """Tolerances of the adaptive integrator."""

    rtol: Annotated[float, Strict(), Field(gt=0, le=0.1)] = Field(
        default=1e-8, description="relative [-]"
    )
    atol: Positive = Field(default=1e-10, description="absolute [m, m/s]")


class BodyFrame(Part):
    """Attach the body frame at t = 0 with this attitude, instead of when a formation is first established."""

    roll_deg: Number = Field(default=0.0, description="roll [deg], 3-2-1 Euler angles")
    pitch_deg: Number = Field(default=0.0, description="pitch [deg]")
    yaw_deg: Number = Field(default=0.0, description="yaw [deg]")


class Formation(Part):
    """A shape (named, or slots), the edges that hold it, and their lengths."""

    shape: str | None = Field(
        default=None,
        description=f"named shape: {', '.join(shapes.SHAPES)}",
        json_schema_extra={"enum": [*shapes.SHAPES]},
    )
    size: Size | None = Field(
        default=None, description="edge length of the shape [m]; [x, y, z] for a cuboid"
    )
    slots: tuple[Vector, ...] | None = Field(
        default=None, description="instead of a shape: place of each agent in the body frame [m]"
    )
    edges: Edges = Field(
        default="complete", description="pairs of agents, counted from 1; 'complete': every pair"
    )
    distances: tuple[Positive, ...] | None = Field(
        default=None, description="length of each edge [m]; those of the slots when absent"
    )


class Box(Part):
    """A box along the world's axes."""

    kind: Literal["box"]
    name: str = Field(default="", description="what to call it; 'box' and its number when absent")
    min: Vector = Field(description="lowest corner [x, y, z] [m]")
    max: Vector = Field(description="highest corner [x, y, z] [m]")


class Ground(Part):
    """Everything below a height."""

    kind: Literal["ground"]
    name: str = Field(default="", description="what to call it; 'ground' when absent")
    height: Number = Field(default=0.0, description="height of the ground [m]")


class Geofence(Part):
    """The box outside which no agent may be."""

    min: Vector = Field(description="lowest corner [x, y, z] [m]")
    max: Vector = Field(description="highest corner [x, y, z] [m]")


class Limits(Part):
    """What the verdict holds each agent to."""

    speed: Positive | None = Field(default=None, description="greatest speed [m/s]")
    acceleration: Positive | None = Field(default=None, description="greatest acceleration [m/s^2]")
    separation: NonNegative | None = Field(
        default=None,
        description="least room between two agents' surfaces [m]: centre distance minus radii",
    )
    separation_below: NonNegative | None = Field(
        default=None,
        description="least vertical room under an agent where another flies in its downwash [m]",
    )
    geofence: Geofence | None = Field(default=None, description="box that no agent may leave [m]")


class Settle(Part):
    """A phase ends once its error has stayed within a tolerance."""

    tolerance: Positive = Field(
        default=1e-3, description="greatest error of a distance or slot [m]"
    )
    dwell: NonNegative = Field(
        default=1.0, description="how long the error must stay within it [s]"
    )
    timeout: Positive = Field(default=60.0, description="after this long the mission fails [s]")


class _Phase(Part):
    name: str = Field(
        default="", description="what to call it, unique; its kind and number when absent"
    )
    until: Positive | None = Field(default=None, description="ending: at this mission time [s]")
    duration: Positive | None = Field(default=None, description="ending: after this long [s]")
    settle: Settle | None = Field(default=None, description="ending: when settled")
    control: Literal["open", "slots", "body"] = Field(
        default="slots",
        description="open: weight balance and input_force; slots: each agent tracks its slot; body: wrench on the "
        "virtual body. Absent: slots, or in architecture 'body' open to establish and body otherwise",
    )
    input_force: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="force on each agent besides the weight balance [N], control 'open' only",
    )


class _Shaping(_Phase):
    formation: str = Field(description="name of the formation to take")
    reference: Literal["shape", "distances", "step"] = Field(
        default="shape",
        description="how the distances get there: by blending the slots, by blending d^2, or at once as in the paper",
    )
    blend: Positive = Field(
        default=4.0, description="length of the blend [s], from the phase's start"
    )


class Establish(_Shaping):
    """Take a formation from wherever the agents are, and attach the body frame to it."""

    kind: Literal["establish"]


class Reshape(_Shaping):
    """Change from one formation to another."""

    kind: Literal["reshape"]


class _Turning(_Phase):
    roll_deg: Number | None = Field(
        default=None, description="roll at the end [deg], 3-2-1 Euler angles"
    )
    pitch_deg: Number | None = Field(default=None, description="pitch at the end [deg]")
    yaw_deg: Number | None = Field(
        default=None, description="yaw at the end [deg]; given one angle, the others are 0"
    )
    rates_deg_s: Vector = Field(
        default=(0.0, 0.0, 0.0), description="body rates p, q, r at the end [deg/s]"
    )

    @model_validator(mode="before")
    @classmethod
    def _complete_angles(cls, data: Any) -> Any:
        angles = ("roll_deg", "pitch_deg", "yaw_deg")
        if isinstance(data, dict) and any(a in data for a in angles):
            return dict.fromkeys(angles, 0.0) | data
        return data

    @property
    def attitude_deg(self) -> tuple[float, float, float] | None:
        """Commanded (roll, pitch, yaw) [deg], None to keep the attitude commanded before."""
        if self.roll_deg is None or self.pitch_deg is None or self.yaw_deg is None:
            return None
        return self.roll_deg, self.pitch_deg, self.yaw_deg


class Fly(_Turning):
    """Fly the centre of mass to a waypoint and arrive at the phase's end."""

    kind: Literal["fly"]
    position: Vector = Field(description="centre of mass at the end [m]")
    velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="its velocity at the end [m/s]")


class Turn(_Turning):
    """Turn to an attitude where one is; at least one angle is given."""

    kind: Literal["turn"]


class Hold(_Phase):
    """Stay."""

    kind: Literal["hold"]


Obstacle = Annotated[Box | Ground, Field(discriminator="kind")]
Phase = Annotated[Establish | Fly | Reshape | Turn | Hold, Field(discriminator="kind")]
_PHASES: dict[str, type[_Phase]] = {
    "establish": Establish, "fly": Fly, "reshape": Reshape, "turn": Turn, "hold": Hold
}  # fmt: skip
_OBSTACLES: dict[str, type[Part]] = {"box": Box, "ground": Ground}


class Header(Part):
    """Keys at the top of a mission file."""

    schema_version: Literal[1] = Field(description="version of this format: 1")
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")] = Field(
        description="short name; letters, digits, '.', '_' and '-', as results are filed under it"
    )
    title: Annotated[str, Field(pattern=r"^[^\r\n]*$")] = Field(
        default="", description="one line on what it shows"
    )
    source: str = Field(default="", description="table or figure of the paper it reproduces")
    architecture: Literal["local", "body"] = Field(
        default="local",
        description="local: each agent tracks its slot; body: control of the virtual body",
    )
    formulation: Literal["inertial", "body"] = Field(
        default="inertial",
        description="equations of motion integrated: Newton's, or the paper's in the body frame",
    )
    gravity: NonNegative = Field(default=9.81, description="gravity [m/s^2], >= 0")
    output_step: Positive = Field(
        default=0.05, description="time between samples of the result [s]"
    )


class Mission(Header):
    """A checked mission. Make one with `load_mission`, `from_toml` or `from_dict`: they check it whole."""

    agents: Agents
    constraint: Constraint = Field(default_factory=Constraint)
    lqr: Lqr = Field(default_factory=Lqr)
    tracking: Tracking = Field(default_factory=Tracking)
    allocation: Allocation = Field(default_factory=Allocation)
    integrator: Integrator = Field(default_factory=Integrator)
    body_frame: BodyFrame | None = None
    formations: dict[str, Formation] = Field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] = ()
    limits: Limits = Field(default_factory=Limits)
    phases: Annotated[tuple[Phase, ...], Field(min_length=1)]

    _text: str = PrivateAttr(default="")
    _origin: str = PrivateAttr(default="")

    @classmethod
    def from_toml(cls, text: str, origin: str = "<text>") -> Self:
        """Check a mission given as TOML. `origin` names the file in messages.

        Raises
        ------
        MissionError
            With a finding for each error.
        """
        mission = _Checker(_parse(text, origin), origin).mission(cls)
        mission._text, mission._origin = text, origin
        return mission

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], origin: str = "<dict>") -> Self:
        """Check a mission given as plain data with the keys of the TOML format (arrays of NumPy are fine).

        Raises
        ------
        MissionError
            With a finding for each error.
        """
        try:
            text = to_toml(data)
        except TypeError as error:
            raise MissionError(
                [Finding(origin, "", None, str(error), "use numbers, strings, lists and dicts")]
            ) from None
        return cls.from_toml(text, origin)

    def to_dict(self) -> dict[str, Any]:
        """The mission as plain data, as it was written: change it and check it again with `from_dict`."""
        return tomllib.loads(self._text)

    @property
    def text(self) -> str:
        """The mission's TOML."""
        return self._text

    @property
    def origin(self) -> str:
        """Where it was read."""
        return self._origin

    @property
    def n_agents(self) -> int:
        """Number of agents N."""
        return len(self.agents.position)

    @cached_property
    def edges(self) -> Ints:
        """Union of all formations' edges (m, 2), from 0, i < j, in the order in which they are first seen."""
        seen = dict.fromkeys(
            (i, j) for name in self.formations for i, j in self.formation_edges(name).tolist()
        )
        return np.array(list(seen), dtype=np.int64).reshape(-1, 2)

    def formation_edges(self, name: str) -> Ints:
        """Edges (m, 2) of a formation, counted from 0, i < j."""
        return _edges(self.formations[name], self.n_agents)

    def formation_slots(self, name: str) -> Floats | None:
        """Slots (N, 3) [m] of a formation about their geometric centre; None where distances do not give them."""
        return _slots(self.formations[name], self.n_agents)

    def formation_distances(self, name: str) -> Floats:
        """Length (m,) [m] of each of a formation's edges."""
        return _distances(self.formations[name], self.n_agents)

    @property
    def latest_end(self) -> float:
        """Mission time [s] by which the last phase has ended, every settling phase taking its whole time-out."""
        t = 0.0
        for p in self.phases:
            t = (
                p.until
                if p.until is not None
                else t + (p.duration or (p.settle.timeout if p.settle else 0.0))
            )
        return t


def _edges(form: Formation, n: int) -> Ints:
    if form.edges == "complete":
        return shapes.complete_graph(n)
    pairs = np.array(form.edges, dtype=np.int64).reshape(-1, 2) - 1
    return np.sort(pairs, axis=1)


def _slots(form: Formation, n: int) -> Floats | None:
    if form.shape is not None and form.size is not None:
        return shapes.slots(form.shape, form.size, n)
    if form.slots is not None:
        return shapes.centred(form.slots)
    return shapes.slots_from_distances(n, _edges(form, n), _distances(form, n))


def _distances(form: Formation, n: int) -> Floats:
    if form.distances is not None:
        return np.array(form.distances, dtype=np.float64)
    slots = _slots(form, n)
    assert slots is not None  # checked on entry: no distances, so a shape or slots
    return shapes.distances(slots, _edges(form, n))


# -- shipped missions and files -----------------------------------------------------------------------

_SHIPPED = resources.files("rigidfleet") / "missions"
#: No mission is longer; a device file or a video given by mistake is noticed before memory is full.
_LARGEST_FILE = 64 * 2**20


def mission_names() -> list[str]:
    """Names of the missions that ship with the package."""
    return sorted(
        entry.name.removesuffix(".toml")
        for entry in _SHIPPED.iterdir()
        if entry.name.endswith(".toml")
    )


def mission_text(name: str) -> str:
    """TOML of a shipped mission.

    Raises
    ------
    MissionError
        There is no such mission.
    """
    if name not in mission_names():
        raise MissionError([_not_found(name)])
    return (_SHIPPED / f"{name}.toml").read_text(encoding="utf-8")


def load_mission(name_or_path: str | Path) -> Mission:
    """Read and check a mission: a shipped one by its name, or a file.

    A shipped name wins over a file of the same name; write `./name` for the file.

    Raises
    ------
    MissionError
        The mission does not exist, cannot be read, or has errors: all of them, in `findings`.
    """
    if isinstance(name_or_path, str) and name_or_path in mission_names():
        return Mission.from_toml(mission_text(name_or_path), f"{name_or_path} (shipped)")
    return Mission.from_toml(_read(name_or_path), str(name_or_path))


def json_schema() -> dict[str, Any]:
    """JSON schema of the mission format, for editors: every key with its unit and meaning."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | Mission.model_json_schema()


def _read(path: str | Path) -> str:
    origin = str(path)

    def failed(message: str, remedy: str) -> MissionError:
        return MissionError([Finding(origin, "", None, message, remedy)])

    try:
        with open(path, "rb") as file:
            data = file.read(_LARGEST_FILE + 1)
    except FileNotFoundError:
        raise MissionError([_not_found(origin)]) from None
    except IsADirectoryError:
        raise failed("is a directory", "name the mission file in it") from None
    except PermissionError:
        raise failed("may not be read", "ask for permission to read it") from None
    except (OSError, ValueError) as error:
        raise failed(f"cannot be read: {error}", "name a TOML file or a shipped mission") from None
    if len(data) > _LARGEST_FILE:
        raise failed(f"is larger than {_LARGEST_FILE >> 20} MiB", "name a mission file, in TOML")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        hint = "name a mission file, in TOML" if b"\0" in data else "save it as UTF-8"
        raise failed(f"is not UTF-8 text (byte {error.start + 1})", hint) from None


def _not_found(name: str) -> Finding:
    known = mission_names()
    near = _near(Path(name).name.removesuffix(".toml"), known)
    remedy = near or f"shipped missions: {', '.join(known)}"
    return Finding(
        name, "", None, "there is no such file and no shipped mission of this name", remedy
    )


def _parse(text: str, origin: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        finding = Finding(
            origin,
            "",
            None,
            f"is not valid TOML: {error}",
            "correct the line; toml.io shows the format",
        )
    except (
        ValueError,
        RecursionError,
    ) as error:  # a number of thousands of digits, brackets thousands deep
        finding = Finding(
            origin,
            "",
            None,
            f"cannot be read as TOML: {error}",
            "correct it; toml.io shows the format",
        )
    raise MissionError([finding])


def to_toml(data: Mapping[str, Any]) -> str:
    """Plain data as TOML: keys, then tables, then arrays of tables; deeper tables inline. None is left out.

    Raises
    ------
    TypeError
        A value has no TOML form.
    """
    tables, lines = [], []
    for key, value in data.items():
        head = _toml_key(str(key))
        if isinstance(value, Mapping):
            if key == "formations":
                rest = {k: v for k, v in value.items() if not isinstance(v, Mapping)}
                tables += [
                    f"\n[{head}.{_toml_key(str(k))}]\n{_body(v)}"
                    for k, v in value.items()
                    if k not in rest
                ]
                if rest or not value:
                    tables.insert(0, f"\n[{head}]\n{_body(rest)}")
            else:
                tables.append(f"\n[{head}]\n{_body(value)}")
        elif (
            isinstance(value, list | tuple) and value and all(isinstance(v, Mapping) for v in value)
        ):
            tables += [f"\n[[{head}]]\n{_body(v)}" for v in value]
        elif value is not None:
            lines.append(f"{head} = {_toml_value(value)}\n")
    return "".join([*lines, *tables])


def _body(table: Mapping[str, Any]) -> str:
    return "".join(
        f"{_toml_key(str(k))} = {_toml_value(v)}\n" for k, v in table.items() if v is not None
    )


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _toml_value(key)


def _toml_value(value: Any) -> str:
    if hasattr(value, "tolist"):  # NumPy arrays and scalars
        value = value.tolist()
    match value:
        case bool():
            return "true" if value else "false"
        case int():
            return str(value)
        case float():
            return repr(float(value))
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case list() | tuple():
            return f"[{', '.join(map(_toml_value, value))}]"
        case Mapping():
            pairs = (
                f"{_toml_key(str(k))} = {_toml_value(v)}" for k, v in value.items() if v is not None
            )
            return f"{{{', '.join(pairs)}}}"
    raise TypeError(f"a {type(value).__name__} has no place in a mission: {value!r}")


# -- checks -------------------------------------------------------------------------------------------

Path_ = tuple[str | int, ...]


def _near(word: object, known: Iterable[str]) -> str:
    """'did you mean ...?' where a known word is near, else ''."""
    words = {k.lower(): k for k in known}
    near = difflib.get_close_matches(str(word).lower(), words, n=1, cutoff=0.55)
    return f"did you mean '{words[near[0]]}'?" if near else ""


def _key(path: Path_) -> str:
    """`phases[3].until`; places count from 1."""
    text = ""
    for step in path:
        text += f"[{step + 1}]" if isinstance(step, int) else f".{_toml_key(step)}"
    return text.removeprefix(".")


class _Checker:
    """Checks one mission's data, part by part, so that an error in one part hides none in another.

    Each part is validated on its own. Where keys in it are wrong, the rest of it goes on, so that the checks
    across keys and parts still run; those that would need a wrong key are passed over.
    """

    def __init__(self, data: dict[str, Any], origin: str) -> None:
        self.data = data
        self.origin = origin
        self.findings: list[Finding] = []
        self.wrong: set[Path_] = set()
        """Where findings are, and all that is around them."""
        self.n: int | None = None
        self.formations: dict[str, Formation] = {}
        self.sound: set[str] = set()
        """Formations whose edges, slots and distances are in order."""

    def mission(self, cls: type[Mission]) -> Any:
        """The mission, if nothing is wrong with it."""
        parts = self._header()
        parts |= {
            key: part
            for key, kind in _TABLES.items()
            if (part := self._table(key, kind)) is not None
        }
        agents = parts.get("agents")
        self._agents(agents)
        for check, key in (
            (self._gains, "constraint"),
            (self._tracking, "tracking"),
            (self._limits, "limits"),
        ):
            if key in parts:
                check(parts[key])
        if "lqr" in parts:
            self._regulator(parts["lqr"], ("lqr",))
            self._regulator(parts["lqr"].attitude, ("lqr", "attitude"))
        if parts.get("allocation", _ANY).method == "rigid" and "torque_split" in self.data.get(
            "allocation", {}
        ):
            self.add(
                ("allocation", "torque_split"),
                "has no effect with method 'rigid'",
                "remove it, or use method = 'pinv'",
            )
        self._formations()
        parts["formations"] = self.formations
        parts["obstacles"] = self._obstacles()
        phases = self._phases(parts)
        parts["phases"] = tuple(p for p in phases if p is not None)
        if self.findings:
            raise MissionError({(f.key, f.problem): f for f in self.findings}.values())
        return cls(**parts)

    def add(self, path: Path_, problem: str, remedy: str, *value: object) -> None:
        """Record a finding; its value is what the user wrote at the path unless given."""
        shown = value[0] if value else _look_up(self.data, path)
        self.findings.append(Finding(self.origin, _key(path), shown, problem, remedy))
        self.wrong |= {path[:k] for k in range(1, len(path) + 1)}

    def _right(self, path: Path_, *keys: str) -> bool:
        """Whether nothing has been found at these keys of a table."""
        return not any((*path, key) in self.wrong for key in keys)

    # structure: each table against its model

    def _header(self) -> dict[str, Any]:
        sections = Mission.model_fields.keys() - Header.model_fields.keys()
        header = self._validate(
            Header, {k: v for k, v in self.data.items() if k not in sections}, (), Mission
        )
        if "agents" not in self.data:
            self.add(("agents",), "is missing", "add a table [agents] with mass and position")
        return {} if header is None else {k: getattr(header, k) for k in Header.model_fields}

    def _table(self, key: str, kind: type[Part]) -> Any:
        if key not in self.data:
            return None
        if not isinstance(self.data[key], dict):
            self.add((key,), "must be a table", f"write [{key}] and its keys below it")
            return None
        return self._validate(kind, self.data[key], (key,))

    def _validate(
        self, kind: type[Part], data: Any, path: Path_, known: type[Part] | None = None
    ) -> Any:
        """The part with a finding for each of its errors, without the keys that have some; None if that is no part."""
        try:
            return kind.model_validate(data)
        except ValidationError as error:
            errors = error.errors(include_url=False)
        for e in errors:
            self._structural(e, path, known or kind)
        wrong = {e["loc"][0] for e in errors if e["loc"]}
        rest = {key: value for key, value in data.items() if key not in wrong}
        try:
            return kind.model_validate(
                {k: v for k, v in _STAND_IN.items() if k in kind.model_fields} | rest
            )
        except ValidationError:
            return None

    def _structural(self, error: Any, prefix: Path_, kind: type[Part]) -> None:
        here: Any = _look_up(self.data, prefix)
        path, model = prefix, kind
        for step in error["loc"]:
            inside = (
                step in here
                if isinstance(here, dict)
                else isinstance(here, list) and isinstance(step, int)
            )
            if inside:
                here = here[step]
            elif not (isinstance(here, dict) and error["type"] == "missing"):
                continue  # a tag of pydantic's, or one number that stands for all agents
            path = (*path, step)
            field = model.model_fields.get(step) if isinstance(step, str) else None
            model = next(_models(field.annotation), model) if field else model
        if error["type"] == "too_short" and len(here) > error["ctx"]["actual_length"]:
            return  # its wrong entries, found by themselves, were not counted
        if path[:2] == ("lqr", "attitude") and error["loc"][-1] not in _look_up(
            self.data, ("lqr", "attitude"), {}
        ):
            return  # inherited from lqr, where it has been found already
        problem, remedy = _explain(error, path, _owner(kind, error["loc"]))
        self.add(path, problem, remedy)

    # agents, gains and weights

    def _agents(self, agents: Agents | None) -> None:
        table = self.data.get("agents")
        raw = table.get("position") if isinstance(table, dict) else None
        if isinstance(raw, list) and raw:
            self.n = len(raw)
        if agents is None:
            return
        n = len(agents.position)
        for key in ("mass", "velocity", "radius", "thrust_limit"):
            given = len(getattr(agents, key))
            if given != n and self._right(("agents",), key):
                self.add(
                    ("agents", key),
                    f"has {given} entries for {n} agents",
                    f"give one for each agent, {n} in all",
                )
        for i, j in _coincident(agents.position):
            self.add(
                ("agents", "position", j),
                f"agent {j + 1} starts where agent {i + 1} is",
                "start them apart: an edge of length 0 has no direction",
            )
        if (
            agents.saturate
            and self._right(("agents",), "thrust_limit")
            and all(math.isinf(limit) for limit in agents.thrust_limit)
        ):
            self.add(
                ("agents", "saturate"),
                "there is no thrust to cut off at",
                "give agents.thrust_limit [N]",
            )

    def _gains(self, c: Constraint) -> None:
        if c.stabilisation == "none" or not self._right(
            ("constraint",), "stabilisation", "alpha", "beta", "gamma"
        ):
            return
        hint = "triple pole p: alpha = 1.5 p, beta = sqrt(3) p, gamma = p^3; stabilisation = 'none' for no feedback"
        ok = True
        for key, value, good in (
            ("alpha", c.alpha, c.alpha > 0),
            ("beta", c.beta, c.beta > 0),
            ("gamma", c.gamma, c.gamma >= 0),
        ):
            if not good:
                ok = False
                self.add(
                    ("constraint", key),
                    f"unstable: must be {'>=' if key == 'gamma' else '>'} 0",
                    hint,
                    value,
                )
        if ok and not 2 * c.alpha * c.beta**2 > c.gamma:
            self.add(
                ("constraint", "gamma"),
                f"unstable: 2 alpha beta^2 = {2 * c.alpha * c.beta**2:.6g} must exceed gamma",
                f"lower gamma, or raise alpha or beta; {hint}",
                c.gamma,
            )

    def _regulator(self, r: Regulator, path: Path_) -> None:
        if not (
            self._right(("lqr",), "horizon", "Q", "S") and self._right(path, "horizon", "Q", "S")
        ):
            return
        if r.horizon == "infinite" and not r.Q[0] > 0:
            self.add(
                (*path, "Q"), "an infinite horizon needs Q[1] > 0", "give Q = [1.0, 1.0], say", r.Q
            )
        if r.horizon == "finite" and not any(r.Q) and not any(r.S):
            self.add(
                (*path, "S"),
                "with Q and S zero nothing is steered",
                "give S = [1e3, 1e2], say",
                r.S,
            )

    def _tracking(self, t: Tracking) -> None:
        if not t.Q[0] > 0 and self._right(("tracking",), "Q"):
            self.add(("tracking", "Q"), "tracking needs Q[1] > 0", "give Q = [4.0, 4.0], say")

    def _limits(self, limits: Limits) -> None:
        if limits.geofence is not None:
            self._ordered(limits.geofence, ("limits", "geofence"))

    def _ordered(self, box: Box | Geofence, path: Path_) -> None:
        for axis, low, high in zip("xyz", box.min, box.max, strict=True):
            if not low < high:
                self.add(
                    path,
                    f"min must be below max, but in {axis} {low:g} >= {high:g} m",
                    "exchange the two",
                    None,
                )

    # formations and obstacles

    def _formations(self) -> None:
        table = self.data.get("formations", {})
        if not isinstance(table, dict):
            self.add(
                ("formations",), "must hold tables", "write [formations.NAME] for each formation"
            )
            return
        for name, data in table.items():
            path = ("formations", name)
            if not isinstance(data, dict):
                self.add(
                    path,
                    "must be a table",
                    f"write [formations.{_toml_key(name)}] and its keys below it",
                )
            elif (form := self._validate(Formation, data, path)) is not None:
                self.formations[name] = form
                self._formation(form, path)
                if self._right(path[:1], name) and self.n is not None:
                    self.sound.add(name)

    def _formation(self, form: Formation, path: Path_) -> None:
        right = self._right(path, "shape", "size", "slots", "distances")
        if form.shape is not None and form.slots is not None:
            self.add((*path, "slots"), "shape and slots are both given", "keep one of them")
        if right and form.shape is None and form.size is not None:
            self.add(
                (*path, "size"),
                "there is no shape that it is the size of",
                "give shape, or remove size",
            )
        if right and form.shape is form.slots is form.distances is None:
            self.add(
                path,
                "has neither a shape, nor slots, nor distances",
                "give shape and size, say",
                None,
            )
        if form.shape is not None:
            self._shape(form, path)
        if self.n is None:
            return
        if form.slots is not None:
            if len(form.slots) != self.n:
                problem = f"has {len(form.slots)} slots for {self.n} agents"
                self.add(
                    (*path, "slots"), problem, f"give one for each agent, {self.n} in all", None
                )
            for i, j in _coincident(form.slots):
                self.add((*path, "slots", j), f"is slot {i + 1} again", "keep the agents apart")
        if (
            self._right(path, "edges")
            and self._edges(form, (*path, "edges"))
            and form.distances is not None
        ):
            self._lengths(form, (*path, "distances"))

    def _shape(self, form: Formation, path: Path_) -> None:
        if form.shape not in shapes.SHAPES:
            known = ", ".join(shapes.SHAPES)
            self.add(
                (*path, "shape"),
                "unknown shape",
                _near(form.shape, shapes.SHAPES) or f"known shapes: {known}",
            )
        elif not self._right(path, "size"):
            return
        elif form.size is None:
            self.add((*path, "size"), "is missing", "add size, the edge length [m]")
        elif self.n is not None:
            try:
                shapes.slots(form.shape, form.size, self.n)
            except ValueError as error:
                self.add(
                    (*path, "shape"),
                    str(error),
                    "change the shape, its size, or the number of agents",
                )

    def _edges(self, form: Formation, path: Path_) -> bool:
        """Whether the edges are in order."""
        if form.edges == "complete":
            return True
        assert self.n is not None
        before = len(self.findings)
        seen: dict[tuple[int, int], int] = {}
        for k, (i, j) in enumerate(form.edges):
            pair = (min(i, j), max(i, j))
            if not 1 <= pair[0] <= pair[1] <= self.n:
                self.add(
                    (*path, k),
                    f"there are agents 1 to {self.n}",
                    "agents count from 1; correct the edge",
                )
            elif i == j:
                self.add((*path, k), "joins an agent to itself", "join two agents")
            elif pair in seen:
                self.add(
                    (*path, k),
                    f"is edge {seen[pair] + 1} again",
                    "remove one of them, and its distance",
                )
            seen.setdefault(pair, k)
        return len(self.findings) == before

    def _lengths(self, form: Formation, path: Path_) -> None:
        assert self.n is not None
        assert form.distances is not None
        edges = _edges(form, self.n)
        if len(form.distances) != len(edges):
            problem = f"has {len(form.distances)} distances for {len(edges)} edges"
            self.add(
                path,
                problem,
                "give one for each edge, in the order of the edges (12, 13, ... when complete)",
            )
            return
        label = [f"d{_agents_text(e)} = {d:g}" for e, d in zip(edges, form.distances, strict=True)]
        found = shapes.unrealisable(edges, form.distances)
        for v in islice(found, _MOST_VIOLATIONS):
            given = ", ".join(label[k] for k in v.edges)
            if len(v.agents) == 3:
                problem = f"agents {_agents_text(v.agents, ', ')} make no triangle: {given} m"
                remedy = f"shorten the longest by {v.excess:.4g} m or more, or lengthen the others"
            else:
                problem = f"agents {_agents_text(v.agents, ', ')} make no tetrahedron (Cayley-Menger < 0): {given} m"
                remedy = "change one of the six (a flat shape needs 7 digits: 5.656854), or give shape and size"
            self.add(path, problem, remedy, None)
        if len(found) > _MOST_VIOLATIONS:
            more = len(found) - _MOST_VIOLATIONS
            self.add(
                path,
                f"and {more} more such triangles or tetrahedra",
                "correct those above first",
                None,
            )
        if not found:
            try:
                shapes.slots_from_distances(self.n, edges, form.distances)
            except ValueError as error:
                self.add(path, str(error), "change them, or give shape and size", None)

    def _obstacles(self) -> tuple[Any, ...]:
        obstacles = []
        for k, data in enumerate(self._tables("obstacles")):
            path = ("obstacles", k)
            kind = self._kind(data, path, _OBSTACLES)
            if kind is None:
                continue
            default = "ground" if kind is Ground else f"box {k + 1}"
            obstacle = self._validate(kind, {"name": default} | data, path)
            if isinstance(obstacle, Box):
                self._ordered(obstacle, path)
            obstacles.append(obstacle)
        return tuple(obstacles)

    def _tables(self, key: str) -> list[Any]:
        tables = self.data.get(key, [])
        if isinstance(tables, list):
            return tables
        self.add((key,), "must be an array of tables", f"write [[{key}]] above each")
        return []

    def _kind(self, data: Any, path: Path_, kinds: Mapping[str, type[Any]]) -> Any:
        """The class that `kind` names, or None with a finding."""
        choice = f"use one of {', '.join(kinds)}"
        if not isinstance(data, dict):
            self.add(path, "must be a table", f"write [[{path[0]}]] above it")
        elif "kind" not in data:
            self.add((*path, "kind"), "is missing", choice)
        elif not isinstance(data["kind"], str) or data["kind"] not in kinds:
            self.add((*path, "kind"), "unknown kind", _near(data["kind"], kinds) or choice)
        else:
            return kinds[data["kind"]]
        return None

    # phases

    def _phases(self, parts: dict[str, Any]) -> list[Any]:
        body = self.data.get("architecture") == "body"
        tables = self._tables("phases")
        if not tables and isinstance(self.data.get("phases", []), list):
            self.add(("phases",), "there is none", "add at least one [[phases]]")
        phases: list[Any] = []
        for k, data in enumerate(tables):
            kind = self._kind(data, ("phases", k), _PHASES)
            if kind is None:
                phases.append(None)
                continue
            control = ("open" if kind is Establish else "body") if body else "slots"
            full = {"name": f"{data['kind']} {k + 1}", "control": control} | data
            phases.append(self._validate(kind, full, ("phases", k)))
        self._names(phases)
        self._times(phases, parts.get("output_step"))
        self._controls(phases, body)
        self._shaping(phases, parts.get("agents"))
        self._arrivals(phases, parts.get("lqr", Lqr()))
        return phases

    def _names(self, phases: Sequence[Any]) -> None:
        seen: dict[str, int] = {}
        for k, p in enumerate(phases):
            if p is not None and seen.setdefault(p.name, k) != k:
                problem = f"phase {seen[p.name] + 1} has this name"
                self.add(("phases", k, "name"), problem, "give each phase its own", p.name)

    def _times(self, phases: Sequence[Any], output_step: float | None) -> None:
        """One ending each, in order of time, long enough for the blend; a sensible number of samples."""
        earliest: float | None = 0.0
        latest: float | None = 0.0
        for k, p in enumerate(phases):
            path = ("phases", k)
            known = p is not None and self._right(path, "until", "duration", "settle")
            endings = (
                [e for e in ("until", "duration", "settle") if getattr(p, e) is not None]
                if known
                else []
            )
            if known and len(endings) != 1:
                problem = f"ends by {' and '.join(endings)}" if endings else "has no ending"
                remedy = "give exactly one of until (mission time), duration [s] or settle"
                self.add(path, problem, remedy, p.name)
            if len(endings) != 1:
                earliest = latest = None
                continue
            start = earliest, latest
            if p.until is not None:
                earliest = latest = p.until
                self._in_order(path, p.until, *start)
            elif earliest is not None and latest is not None:
                earliest += p.duration or p.settle.dwell
                latest += p.duration or p.settle.timeout
            if p.settle is not None and p.settle.timeout <= p.settle.dwell:
                self.add(
                    (*path, "settle"),
                    "times out before it can have dwelt",
                    "give a timeout longer than dwell",
                )
            longest = p.duration or (p.settle and p.settle.timeout)
            if p.until is not None and start[0] is not None and start[0] == start[1]:
                longest = p.until - start[0]
            self._blend(p, path, longest)
        if latest and output_step is not None and self._right((), "output_step"):
            if output_step > latest:
                remedy = "make it shorter than the mission"
                self.add(("output_step",), f"the mission ends at {latest:g} s", remedy, output_step)
            elif latest / output_step > _MOST_SAMPLES:
                problem = f"{latest / output_step:.3g} samples would be stored, {_MOST_SAMPLES:.0e} at most"
                self.add(
                    ("output_step",),
                    problem,
                    f"use {latest / _MOST_SAMPLES:.2g} s or more",
                    output_step,
                )

    def _in_order(
        self, path: Path_, until: float, earliest: float | None, latest: float | None
    ) -> None:
        if earliest is None or latest is None:
            return
        if until <= earliest:
            problem = f"ends before it begins, at {earliest:g} s"
            self.add(
                (*path, "until"),
                problem,
                "until is mission time and increases; duration is a length",
            )
        elif until <= latest:
            problem = f"the phase may begin as late as {latest:g} s, when the settling before it times out"
            self.add((*path, "until"), problem, "end by duration, or give settle a shorter timeout")

    def _blend(self, p: Any, path: Path_, longest: float | None) -> None:
        if not isinstance(p, _Shaping) or not self._right(path, "reference", "blend"):
            return
        if p.reference == "step":
            if "blend" in p.model_fields_set:
                self.add(
                    (*path, "blend"), "a step has no blend", "remove it, or use reference = 'shape'"
                )
        elif longest is not None and p.blend > longest * (1 + 1e-12):
            problem = f"the phase is over after {longest:g} s, before its blend"
            self.add(
                (*path, "blend"), problem, f"use blend <= {longest:g}, or a longer phase", p.blend
            )

    def _controls(self, phases: Sequence[Any], body: bool) -> None:
        for k, p in enumerate(phases):
            if p is None:
                continue
            path = ("phases", k, "control")
            if not self._right(path[:2], "control"):
                continue
            if p.control == "body" and not body and self._right((), "architecture"):
                self.add(
                    path,
                    "the mission's architecture is 'local'",
                    "use control = 'slots', or architecture = 'body'",
                )
            if p.control == "open" and isinstance(p, Fly | Turn):
                self.add(
                    path, f"nothing steers a {p.kind} phase", "use control = 'slots' or 'body'"
                )
            if any(p.input_force) and p.control != "open":
                problem = f"has no effect with control '{p.control}'"
                self.add(
                    ("phases", k, "input_force"), problem, "remove it, or use control = 'open'"
                )
            if (
                isinstance(p, Turn)
                and self._right(path[:2], "roll_deg", "pitch_deg", "yaw_deg")
                and p.attitude_deg is None
            ):
                self.add(
                    path[:2], "turns to no angle", "give yaw_deg, pitch_deg or roll_deg", p.name
                )

    def _shaping(self, phases: Sequence[Any], agents: Agents | None) -> None:
        """Formations exist and can be referred to, tracked and reached."""
        current: str | None = (
            None  # the formation held; None at first: the initial positions are the slots
        )
        unknown = False
        for k, p in enumerate(phases):
            path = ("phases", k)
            if p is None or not self._right(path, "formation", "reference", "control"):
                unknown = True
                continue
            if isinstance(p, _Shaping):
                if isinstance(p, Reshape) and current is None and not unknown:
                    problem = "there is no formation yet to change from"
                    self.add(
                        (*path, "kind"), problem, "use kind = 'establish' for the first formation"
                    )
                self._named(p, path)
                if current is None and not unknown and agents is not None:
                    self._reachable(p, path, agents)
                current, unknown = p.formation, False
            if current in self.sound and p.control == "slots" and not unknown:
                assert self.n is not None
                assert current is not None
                if _slots(self.formations[current], self.n) is None:
                    problem = f"formation '{current}' has no slots to track"
                    remedy = f"give formations.{_toml_key(current)} a shape or slots, or use another control"
                    self.add((*path, "control"), problem, remedy, p.control)

    def _named(self, p: _Shaping, path: Path_) -> None:
        known = self.data.get("formations", {})
        if isinstance(known, dict) and p.formation not in known:
            names = f"formations: {', '.join(known)}" if known else "add a table [formations.NAME]"
            self.add(
                (*path, "formation"),
                "there is no such formation",
                _near(p.formation, known) or names,
            )
        if p.formation not in self.sound or p.reference != "shape":
            return
        assert self.n is not None
        form = self.formations[p.formation]
        slots = _slots(form, self.n)
        if slots is None:
            remedy = "give the formation a shape or slots, or use reference = 'distances'"
            self.add(
                (*path, "reference"),
                f"formation '{p.formation}' has no slots to blend",
                remedy,
                p.reference,
            )
        elif form.distances is not None:
            edges = _edges(form, self.n)
            from_slots = shapes.distances(slots, edges)
            off = np.abs(from_slots - form.distances)
            worst = int(np.argmax(off)) if len(off) else 0
            if len(off) and off[worst] > 1e-3 * from_slots[worst]:
                problem = f"is {form.distances[worst]:g} m, but the slots of agents {_agents_text(edges[worst], ', ')} "
                problem += f"are {from_slots[worst]:g} m apart"
                remedy = "correct it or leave distances out; to fly them as they are, use reference = 'distances'"
                self.add(("formations", p.formation, "distances", worst), problem, remedy)

    def _reachable(self, p: _Shaping, path: Path_, agents: Agents) -> None:
        """Forces along edges cannot leave the line or plane in which the agents start."""
        if p.formation not in self.sound or p.control != "open":
            return
        if any(p.input_force) and len(set(agents.mass)) > 1:
            return
        assert self.n is not None
        target = _slots(self.formations[p.formation], self.n)
        motion = np.vstack(
            [shapes.centred(agents.position), shapes.centred(agents.velocity or [(0.0, 0.0, 0.0)])]
        )
        start = shapes.dimension(np.vstack([motion, -motion]))
        if target is not None and 0 < start < shapes.dimension(target):
            where = "line" if start == 1 else "plane"
            problem = f"the agents start in a {where}, which forces between them cannot leave"
            remedy = f"move an agent's start off the {where}, or use control = 'slots'"
            self.add((*path, "control"), problem, remedy, p.control)

    def _arrivals(self, phases: Sequence[Any], lqr: Lqr) -> None:
        for k, p in enumerate(phases):
            if not isinstance(p, Fly | Turn) or p.settle is None or not self._right((), "lqr"):
                continue
            finite: list[Path_] = (
                [("lqr",)] if isinstance(p, Fly) and lqr.horizon == "finite" else []
            )
            if p.attitude_deg is not None and lqr.attitude.horizon == "finite":
                finite.append(("lqr", "attitude"))
            for path in finite:
                problem = f"a finite horizon ({_key(path)}) needs an arrival time"
                remedy = f"end by until or duration, or use {_key(path)}.horizon = 'infinite' with Q[1] > 0"
                self.add(("phases", k, "settle"), problem, remedy)


#: For required keys that are wrong, so that the rest of their table can be checked.
_STAND_IN: dict[str, Any] = {"mass": 1.0, "position": (0.0, 0.0, 0.0), "formation": ""}
_ANY = Allocation(method="pinv")
_MOST_VIOLATIONS = 6
_MOST_SAMPLES = 1_000_000
_TABLES: dict[str, type[Part]] = {
    "agents": Agents, "constraint": Constraint, "lqr": Lqr, "tracking": Tracking, "allocation": Allocation,
    "integrator": Integrator, "body_frame": BodyFrame, "limits": Limits,
}  # fmt: skip


def _look_up(data: Any, path: Path_, default: Any = None) -> Any:
    for step in path:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return default
    return data


def _models(annotation: Any) -> Iterator[type[Part]]:
    """Models in an annotation such as `Settle | None`."""
    if get_origin(annotation) in (Union, UnionType, Annotated):
        for arg in get_args(annotation):
            yield from _models(arg)
    elif isinstance(annotation, type) and issubclass(annotation, Part):
        yield annotation


def _owner(kind: type[Part], loc: Sequence[str | int]) -> type[Part]:
    """The model in which the last step of a location is a key."""
    for step in loc[:-1]:
        field = kind.model_fields.get(step) if isinstance(step, str) else None
        kind = next(_models(field.annotation), kind) if field else kind
    return kind


def _coincident(points: Sequence[Sequence[float]]) -> Iterator[tuple[int, int]]:
    """Pairs (first, later) of points within about a nanometre of each other."""
    seen: dict[tuple[float, ...], int] = {}
    for j, point in enumerate(points):
        i = seen.setdefault(tuple(round(x, 9) for x in point), j)
        if i != j:
            yield i, j


def _agents_text(agents: Iterable[int], between: str = "") -> str:
    """Agents counted from 1: '12', or '1-10' where two digits would read as another pair."""
    numbers = [str(a + 1) for a in agents]
    return (between or ("-" if any(len(a) > 1 for a in numbers) else "")).join(numbers)


def _explain(error: Any, path: Path_, owner: type[Part]) -> tuple[str, str]:
    """Problem and remedy of one of pydantic's errors."""
    kind, context = error["type"], error.get("ctx", {})
    name = next((step for step in reversed(path) if isinstance(step, str)), "")
    field = owner.model_fields.get(name)
    meaning = f"{name}: {field.description}" if field and field.description else ""
    if kind == "extra_forbidden":
        known = list(owner.model_fields)
        return "unknown key", _near(path[-1], known) or f"remove it; known keys: {', '.join(known)}"
    if kind == "missing":
        return "is missing", f"add {meaning or path[-1]}"
    if kind == "literal_error":
        words = re.findall(r"'([^']*)'", context["expected"]) or [context["expected"]]
        return f"must be {context['expected']}", _near(error["input"], words) or f"use {words[0]}"
    if kind in ("too_short", "too_long"):
        if context.get("min_length") == 1:
            return "is empty", meaning or "give at least one"
        least = context.get("min_length") or context.get("max_length")
        return (
            f"must have {least} numbers, not {context['actual_length']}",
            meaning or f"give {least} numbers",
        )
    problem = _PROBLEMS.get(kind, error["msg"][:1].lower() + error["msg"][1:]).format_map(context)
    return problem, meaning or "correct it"


_PROBLEMS = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be a string",
    "tuple_type": "must be a list",
    "model_type": "must be a table",
    "finite_number": "must be finite",
    "greater_than": "must be > {gt:g}",
    "greater_than_equal": "must be >= {ge:g}",
    "less_than": "must be < {lt:g}",
    "less_than_equal": "must be <= {le:g}",
    "string_pattern_mismatch": "has characters that it may not have",
}
