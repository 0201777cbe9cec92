"""What a mission holds: every table of the format, with the unit and meaning of each key.

The descriptions are the documentation of the format: `rigidfleet missions --schema` exports them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    Tag,
    WithJsonSchema,
    model_validator,
)

from rigidfleet.formation import distance_geometry, graphs, shapes
from rigidfleet.math import rigid_body
from rigidfleet.mission import bounds
from rigidfleet.mission.bounds import (
    ACCELERATION,
    ANGLE,
    FORCE,
    GAIN,
    LENGTH,
    MASS,
    SPEED,
    TIME,
    TOLERANCE,
    WEIGHT,
    Bound,
)
from rigidfleet.typing import Floats, Ints

#: No quantity in SI units is larger here, and the sixth power of a length is still a float.
HUGE = 1e15
#: Drag of a vehicle for each kg of its mass [1/s]. At the speeds of formation flight that of rotors leads, which is
#: linear in the speed; flights identified some 0.4 to 0.5 /s along two axes of a quadrotor (Faessler, Franchi,
#: Scaramuzza, Robotics and Automation Letters 3, 2018), and a vehicle with more mass on each rotor has less.
DRAG = 0.3
#: Keys of an attitude, 3-2-1 Euler angles.
ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")

Number = Annotated[float, Strict(), Field(ge=-HUGE, le=HUGE)]
Positive = Annotated[float, Strict(), Field(gt=0, le=HUGE)]


def _signed(bound: Bound, power: int = 1) -> Any:
    return Field(ge=-(bound.most**power), le=bound.most**power)


def _positive(bound: Bound) -> Any:
    return Field(ge=bound.least, le=bound.most)


def _from_zero(bound: Bound) -> Any:
    return Field(ge=0, le=bound.most)


Coordinate = Annotated[float, Strict(), _signed(LENGTH)]
Length = Annotated[float, Strict(), _positive(LENGTH)]
Room = Annotated[float, Strict(), _from_zero(LENGTH)]
Time = Annotated[float, Strict(), _positive(TIME)]
Dwell = Annotated[float, Strict(), _from_zero(TIME)]
Speed = Annotated[float, Strict(), _positive(SPEED)]
Spread = Annotated[float, Strict(), _from_zero(SPEED)]
Acceleration = Annotated[float, Strict(), _positive(ACCELERATION)]
Mass = Annotated[float, Strict(), _positive(MASS)]
Angle = Annotated[float, Strict(), _signed(ANGLE)]
Gain = Annotated[float, Strict(), _signed(GAIN)]
Weight = Annotated[float, Strict(), _from_zero(WEIGHT)]
Cost = Annotated[float, Strict(), _positive(WEIGHT)]
Tolerance = Annotated[float, Strict(), _positive(TOLERANCE)]
#: Infinity is found later, with a remedy of its own.
Limit = Annotated[float, Strict(), Field(ge=FORCE.least, allow_inf_nan=True)]
Whole = Annotated[int, Strict(), Field(ge=-(2**31), lt=2**31)]
Flag = Annotated[bool, Strict()]
_Three = Field(min_length=3, max_length=3)
Vector = Annotated[tuple[Coordinate, ...], _Three]
Velocity = Annotated[tuple[Annotated[float, Strict(), _signed(SPEED)], ...], _Three]
Force = Annotated[tuple[Annotated[float, Strict(), _signed(FORCE)], ...], _Three]
Rates = Annotated[tuple[Angle, ...], _Three]
Weights = Annotated[tuple[Weight, ...], Field(min_length=2, max_length=2)]

_Extent = Annotated[tuple[Length, ...], _Three]
_Pair = Annotated[tuple[Whole, ...], Field(min_length=2, max_length=2)]


def _form(value: object) -> str:
    return "list" if isinstance(value, list | tuple) else "one"


Size = Annotated[
    Annotated[Length, Tag("one")] | Annotated[_Extent, Tag("list")], Discriminator(_form)
]
Edges = Annotated[
    Annotated[Literal["complete", "neighbours", "henneberg", "henneberg-multilevel"], Tag("one")]
    | Annotated[tuple[_Pair, ...], Tag("list")],
    Discriminator(_form),
]

Damping = Annotated[
    Annotated[Tolerance, Tag("one")] | Annotated[Literal["auto"], Tag("word")],
    Discriminator(lambda value: "word" if isinstance(value, str) else "one"),
]


_Error = Annotated[float, Strict(), Field(gt=-1, le=bounds.MASS_RATIO)]
Seed = Annotated[int, Strict(), Field(ge=0, lt=2**31)]
PerAgent = Annotated[
    Annotated[Weight, Tag("one")] | Annotated[tuple[Weight, ...], Tag("list")],
    Discriminator(_form),
]
PerAgentError = Annotated[
    Annotated[_Error, Tag("one")] | Annotated[tuple[_Error, ...], Tag("list")],
    Discriminator(_form),
]
PerAxis = Annotated[
    Annotated[Spread, Tag("one")] | Annotated[tuple[Spread, ...], _Three, Tag("list")],
    Discriminator(_form),
]


def _number_or_list(least: float) -> WithJsonSchema:
    number = {"type": "number", "minimum": least}
    return WithJsonSchema({"anyOf": [number, {"type": "array", "items": number}]})


class Part(BaseModel):
    """A table of a mission file: frozen, without unknown keys, with finite numbers."""

    # Tables are validated one by one; a kind that a mission lacks is never prepared.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


class Start(Part):
    """Agents that start in a named shape, in the order of its slots."""

    shape: str = Field(
        description=f"named shape: {', '.join(shapes.SHAPES)}",
        json_schema_extra={"enum": [*shapes.SHAPES]},
    )
    size: Size = Field(description="edge length of the shape [m], or its sizes")
    count: Annotated[int, Strict(), Field(ge=1, le=bounds.AGENTS)] = Field(
        description="number of agents"
    )
    centre: Vector = Field((0.0, 0.0, 0.0), description="where its centre is [x, y, z] [m]")

    def points(self) -> Floats:
        """Positions (count, 3) [m].

        Raises
        ------
        ValueError
            The shape is unknown, or takes another number of agents or sizes.
        """
        return shapes.slots(self.shape, self.size, self.count) + np.array(self.centre)


class Agents(Part):
    """The vehicles, as point masses. Once checked, each field has one entry for each agent."""

    mass: Annotated[tuple[Mass, ...], _number_or_list(MASS.least)] = Field(
        description="mass [kg], > 0: a number for all agents, or a list with one for each"
    )
    position: Annotated[tuple[Vector, ...], Field(min_length=1)] = Field(
        description="initial position [x, y, z] of each agent [m], world frame ENU (z up); or a table, the "
        "shape in which they start"
    )
    velocity: tuple[Velocity, ...] = Field(
        (), description="initial velocity of each agent [m/s]; at rest when absent"
    )
    radius: Annotated[tuple[Room, ...], _number_or_list(0)] = Field(
        (0.25,), description="radius of the sphere that must touch nothing [m]: a number or a list"
    )
    thrust_limit: Annotated[tuple[Limit, ...], _number_or_list(FORCE.least)] = Field(
        (math.inf,),
        description="greatest thrust |f_u + f_C| [N]: a number or a list; unlimited when absent",
    )
    saturate: Flag = Field(
        False, description="true: thrust is cut off at thrust_limit; false: only judged against it"
    )

    @model_validator(mode="before")
    @classmethod
    def _spread(cls, data: Any) -> Any:
        """One number stands for all agents; agents without velocities start at rest."""
        if not (isinstance(data, dict) and isinstance(data.get("position"), list | tuple)):
            return data
        n = len(data["position"])
        full = {"velocity": [(0.0, 0.0, 0.0)] * n, "radius": 0.25, "thrust_limit": math.inf} | data
        for key in full.keys() & {"mass", "radius", "thrust_limit"}:
            if not isinstance(full[key], list | tuple):
                full[key] = [full[key]] * n
        return full


class Constraint(Part):
    """The constraint force: feedback of the error c = L - d, and the solve for the multipliers."""

    alpha: Gain = Field(3.0, description="feedback 2 alpha of dc/dt [1/s], > 0")
    beta: Gain = Field(math.sqrt(12), description="feedback beta^2 of c; beta [1/s], > 0")
    gamma: Annotated[float, Strict(), _signed(GAIN, 3)] = Field(
        8.0, description="feedback of the integral of c [1/s^3], >= 0, below 2 alpha beta^2"
    )
    stabilisation: Literal["pid", "none"] = Field(
        "pid", description="'none': no feedback at all, the law whose drift the paper discusses"
    )
    solver: Literal["iterated", "spectral", "exact", "pinv"] = Field(
        "iterated",
        description="iterated Tikhonov; spectral damping (gentler under steps); exact, the paper's "
        "inverse; pinv, the pseudo-inverse",
    )
    damping: Damping = Field(
        "auto",
        description="mu of the iterated solver [-], > 0; auto: 0.03, and in phases that begin in their "
        "formation a quarter of its smallest non-zero w if that is less",
    )
    iterations: Annotated[int, Strict(), Field(ge=1, le=100)] = Field(
        3, description="number k of iterations of the iterated solver, 1 to 100"
    )
    threshold: Tolerance = Field(0.1, description="s0 of the spectral solver [-], > 0")
    cutoff: Annotated[float, Strict(), Field(gt=0, lt=1)] = Field(
        1e-3,
        description="cut-off of the pinv solver, in parts of the largest w, in (0, 1); smooth below",
    )
    deformation_damping: Annotated[float, Strict(), _from_zero(GAIN)] = Field(
        1.0, description="damping of deformation while no slots are tracked [1/s], >= 0"
    )


class Regulator(Part):
    """Weights of a linear quadratic regulator for a double integrator, the same on each axis."""

    horizon: Literal["finite", "infinite"] = Field(
        "finite", description="finite: S weighs the arrival; infinite: Q and R alone"
    )
    Q: Weights = Field((0.0, 0.0), description="weights [error, rate error], >= 0")
    R: Cost = Field(1.0, description="weight of the acceleration, > 0")
    S: Weights = Field((1e3, 1e2), description="weights on arrival [error, rate error], >= 0")


class Lqr(Regulator):
    """Regulator of the virtual body: of its centre of mass, and in `lqr.attitude` of its attitude."""

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
    """Infinite-horizon regulator with which each agent tracks its slot."""

    Q: Weights = Field(
        (4.0, 4.0), description="weights [position error, velocity error], the first > 0"
    )
    R: Cost = Field(1.0, description="weight of the acceleration, > 0")


class Allocation(Part):
    """How the wrench on the virtual body is shared among the agents (control 'body')."""

    method: Literal["rigid", "pinv"] = Field(
        "rigid", description="rigid: what a rigid body's points need; pinv: the paper's H"
    )
    torque_split: Literal["equal", "inertia", "inertia+force"] = Field(
        "equal", description="method 'pinv' only: how the torque is split over the agents"
    )


class IntegratorOptions(Part):
    """Tolerances of the adaptive integrator."""

    rtol: Annotated[float, Strict(), Field(gt=0, le=0.1)] = Field(
        1e-8, description="relative tolerance [-]"
    )
    atol: Tolerance = Field(1e-10, description="absolute tolerance [m, m/s]")
    atol_velocity: Tolerance | None = Field(
        None,
        description="that of velocities [m/s]; when absent atol, and in a large formation that of places times beta",
    )
    atol_integral: Tolerance | None = Field(
        None,
        description="that of the integrals of c [m s]; when absent atol, and rtol times the distance besides where "
        "a large formation is not solved densely",
    )
    atol_attitude: Tolerance | None = Field(
        None, description="that of the frame's quaternion [-]; atol when absent"
    )


class BodyFrame(Part):
    """Attach the body frame at t = 0 with this attitude, not when a formation is established."""

    roll_deg: Angle = Field(0.0, description="roll [deg], 3-2-1 Euler angles")
    pitch_deg: Angle = Field(0.0, description="pitch [deg]")
    yaw_deg: Angle = Field(0.0, description="yaw [deg]")


class Formation(Part):
    """A shape (named, or slots), the edges that hold it, and their lengths.

    The arrays below are about a checked formation of `n` agents.
    """

    shape: str | None = Field(
        None,
        description=f"named shape: {', '.join(shapes.SHAPES)}",
        json_schema_extra={"enum": [*shapes.SHAPES]},
    )
    size: Size | None = Field(
        None, description="edge length of the shape [m]; a cuboid's [x, y, z]"
    )
    slots: tuple[Vector, ...] | None = Field(
        None, description="instead of a shape: place of each agent in the body frame [m]"
    )
    edges: Edges = Field(
        "complete",
        description="pairs of agents, counted from 1; 'complete': every pair; 'neighbours': those within reach; "
        "'henneberg': each to three nearer to the centre; 'henneberg-multilevel': each to three before it, far "
        "ones first; 3 N - 6 in all",
    )
    reach: Length = Field(
        graphs.REACH,
        description="how far edges 'neighbours' reach, in distances of nearest neighbours: 1.9 takes the second, too",
    )
    distances: tuple[Length, ...] | None = Field(
        None, description="length of each edge [m]; when absent, those of the slots"
    )

    def edge_array(self, n: int) -> Ints:
        """Edges (m, 2), counted from 0, i < j."""
        if self.edges == "complete":
            return graphs.complete_graph(n)
        if isinstance(self.edges, str):
            slots = self.slot_array(n)
            assert slots is not None  # checked: there are a shape or slots
            if self.edges == "neighbours":
                return graphs.neighbours(slots, self.reach)
            return (
                graphs.henneberg(slots)
                if self.edges == "henneberg"
                else graphs.henneberg_multilevel(slots)
            )
        return np.sort(np.array(self.edges, dtype=np.int64).reshape(-1, 2) - 1, axis=1)

    @property
    def knows_slots(self) -> bool:
        """Whether it is given by slots, not by distances alone."""
        return self.shape is not None or self.slots is not None

    def slot_array(self, n: int) -> Floats | None:
        """Slots (n, 3) [m] about their geometric centre; None where distances do not give them."""
        if self.shape is not None and self.size is not None:
            return shapes.slots(self.shape, self.size, n)
        if self.slots is not None:
            return rigid_body.centred(self.slots)
        return distance_geometry.slots_from_distances(n, self.edge_array(n), self.distances or ())


class Box(Part):
    """A box along the world's axes."""

    kind: Literal["box"] = Field(description="a box along the world's axes")
    name: str = Field("", description="what to call it; 'box' and its number when absent")
    min: Vector = Field(description="lowest corner [x, y, z] [m]")
    max: Vector = Field(description="highest corner [x, y, z] [m]")

    @property
    def corners(self) -> tuple[float, ...]:
        """Lowest and highest corner (6,) [m]."""
        return (*self.min, *self.max)


class Ground(Part):
    """Everything below a height."""

    kind: Literal["ground"] = Field(description="everything below a height")
    name: str = Field("", description="what to call it; 'ground' when absent")
    height: Coordinate = Field(0.0, description="height of the ground [m]")

    @property
    def corners(self) -> tuple[float, ...]:
        """Lowest and highest corner (6,) [m] of a box without sides and bottom."""
        return (*(-math.inf,) * 3, math.inf, math.inf, self.height)


class Geofence(Part):
    """The box that no agent may leave."""

    min: Vector = Field(description="lowest corner [x, y, z] [m]")
    max: Vector = Field(description="highest corner [x, y, z] [m]")


class Limits(Part):
    """What the verdict holds each agent to."""

    speed: Speed | None = Field(None, description="greatest speed [m/s]")
    acceleration: Acceleration | None = Field(None, description="greatest acceleration [m/s^2]")
    separation: Room | None = Field(
        None, description="least room between agents [m]: centre distance minus radii"
    )
    separation_below: Room | None = Field(
        None, description="least room [m] to an agent straight below: height minus radii (downwash)"
    )
    geofence: Geofence | None = Field(None, description="box that no agent may leave")


class Gusts(Part):
    """Gusts: the velocity of the air beside the steady wind, of each agent, stationary from the start."""

    model: Literal["first-order", "dryden"] = Field(
        description="first-order: one correlation time, alike in all directions; dryden: MIL-F-8785C's spectra, "
        "along the wind, across and vertical"
    )
    intensity: PerAxis | None = Field(
        None,
        description="standard deviation [m/s]: a number, or [along the wind, across, vertical]; by altitude and "
        "wind speed when absent",
    )
    time_scale: Time | None = Field(None, description="correlation time of first-order gusts [s]")
    length: Size | None = Field(
        None,
        description="scale length of Dryden's gusts [m]: a number, or [along the wind, across, vertical]",
    )
    altitude: Annotated[float, Strict(), Field(ge=3.048, le=304.8)] | None = Field(
        None,
        description="in place of length: height above ground [m] from which MIL-F-8785C has the lengths, 3.048 to "
        "304.8",
    )
    airspeed: Speed | None = Field(
        None,
        description="speed at which Dryden's gusts pass by [m/s]; the wind's when absent",
    )
    correlation: Annotated[float, Strict(), Field(ge=0, le=1)] | None = Field(
        None, description="correlation of any two agents' gusts [-], 0 to 1; 0 when absent"
    )
    correlation_length: Length | None = Field(
        None,
        description="in place of correlation: it is exp(-distance / this length [m]), of the slots of the first "
        "formation established",
    )
    seed: Seed = Field(0, description="of the random numbers: the same seed, the same gusts")


class Noise(Part):
    """Errors of what each vehicle measures of itself, normal, independent, new at a sensor's rate."""

    position: Room = Field(
        0.0, description="standard deviation of each component of the position [m]"
    )
    velocity: Spread = Field(
        0.0, description="standard deviation of each component of the velocity [m/s]"
    )
    rate: Annotated[float, Strict(), Field(gt=0, le=1000)] = Field(
        50.0, description="measurements each second [Hz], at most 1000"
    )
    seed: Seed = Field(0, description="of the random numbers: the same seed, the same noise")


class Lost(Part):
    """A vehicle lost: from then on without thrust and without edges."""

    agent: Whole = Field(description="which one, counted from 1")
    time: Time = Field(description="mission time [s], > 0")


class Disturbances(Part):
    """What disturbs the flight, and is told to no law."""

    wind: Velocity = Field((0.0, 0.0, 0.0), description="steady wind [m/s], where the air goes to")
    drag: PerAgent | None = Field(
        None,
        description="force of the air for each m/s of velocity through it [N s/m]: a number or a list; when absent, "
        "0.3 for each kg of mass if there is wind or a gust, else 0",
    )
    mass_error: PerAgentError = Field(
        0.0,
        description="true mass = mass (1 + mass_error) [-], > -1: a number or a list; the laws work with mass",
    )
    gusts: Gusts | None = Field(None, description="gusts: [disturbances.gusts]")
    noise: Noise | None = Field(None, description="measurement noise: [disturbances.noise]")
    lost: tuple[Lost, ...] = Field(
        (), description="vehicles lost on the way, `lost = [{ agent = 2, time = 30.0 }]`"
    )


class Settle(Part):
    """A phase ends once its error has stayed within a tolerance."""

    tolerance: Tolerance = Field(1e-3, description="greatest error [m]")
    dwell: Dwell = Field(1.0, description="how long the error must stay within it [s]")
    timeout: Time = Field(60.0, description="after this long the mission fails [s]")


class AnyPhase(Part):
    """What every phase has. It ends by exactly one of until, duration and settle."""

    # What a kind is to the rest of the code, which asks for this and not for the kind.

    #: Whether it takes a formation.
    shapes: ClassVar[bool] = False
    #: Whether it leads the virtual body to a goal of its own, so that somebody has to steer.
    moves: ClassVar[bool] = False
    #: Whether it may be left anywhere, and its goal is there; others keep theirs for the phase after.
    goal_moves: ClassVar[bool] = False
    #: Its control in architecture "body", unless another is given.
    body_control: ClassVar[str] = "body"

    name: str = Field("", description="what to call it, unique; its kind and number when absent")
    until: Time | None = Field(None, description="ending: at this mission time [s]")
    duration: Time | None = Field(None, description="ending: after this long [s]")
    settle: Settle | None = Field(None, description="ending: when settled")
    control: Literal["open", "tracking", "body"] = Field(
        "tracking",
        description="open: weight balance and input_force; tracking: each agent tracks its slot; body: "
        "wrench on the virtual body. Default tracking; in architecture 'body', open to establish, "
        "tracking to orbit and body otherwise",
    )
    input_force: Force = Field(
        (0.0, 0.0, 0.0),
        description="force on each agent besides the weight balance [N], control 'open' only",
    )

    @property
    def shaping(self) -> Shaping | None:
        """The phase, if it takes a formation."""
        return None

    @property
    def establishing(self) -> Establish | None:
        """The phase, if it attaches the body frame to the formation that it takes."""
        return None

    @property
    def steering(self) -> Steering | None:
        """The phase, if the regulators of [lqr] lead it to a goal of its own."""
        return None

    @property
    def attitude_deg(self) -> tuple[float, float, float] | None:
        """Commanded (roll, pitch, yaw) [deg]; None to keep the attitude commanded before."""
        return None

    @property
    def meets(self) -> tuple[str, ...]:
        """Which of position, velocity, attitude and rates the verdict holds it to, at its arrival."""
        return ()

    @property
    def turns_away(self) -> bool:
        """Whether it leaves an attitude that nobody has asked for by name."""
        return False

    @property
    def least_time(self) -> float:
        """How long its own motion takes [s]: it should not end before."""
        return 0.0

    @property
    def leads_to(self) -> str:
        """What it leads to, in words; "" if it stays."""
        return ""

    def ended(self, length: float) -> dict[str, Any]:
        """Keys that another length [s] changes, where the phase was ended by hand."""
        return {}


class Attitude(Part):
    """Angles of an attitude; when one is given, the others are 0."""

    roll_deg: Angle | None = Field(None, description="roll on arrival [deg], 3-2-1 Euler angles")
    pitch_deg: Angle | None = Field(None, description="pitch on arrival [deg]")
    yaw_deg: Angle | None = Field(
        None, description="yaw on arrival [deg]; when one angle is given, the others are 0"
    )

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, data: Any) -> Any:
        if isinstance(data, dict) and any(angle in data for angle in ANGLES):
            return dict.fromkeys(ANGLES, 0.0) | data
        return data

    @property
    def attitude_deg(self) -> tuple[float, float, float] | None:
        """Commanded (roll, pitch, yaw) [deg]; None to keep the attitude commanded before."""
        if self.roll_deg is None or self.pitch_deg is None or self.yaw_deg is None:
            return None
        return self.roll_deg, self.pitch_deg, self.yaw_deg

    @property
    def angles(self) -> list[str]:
        """The attitude commanded, in words; empty to keep the one before."""
        given = zip(("roll", "pitch", "yaw"), self.attitude_deg or (), strict=False)
        return [f"{name} {angle:g}°" for name, angle in given if angle or name == "yaw"]


class Shaping(AnyPhase):
    """A phase that changes the formation."""

    shapes: ClassVar[bool] = True

    formation: str = Field(description="name of the formation to take")
    reference: Literal["shape", "distances", "squares", "step"] = Field(
        "shape",
        description="how the distances get there: shape, with slots that blend; squares, with their "
        "squares that blend; distances, so if that leads through space to the slots (always, of a "
        "formation without), else as shape; step, at once as in the paper",
    )
    blend: Time = Field(4.0, description="length of the blend [s], from the phase's start")

    @property
    def shaping(self) -> Shaping:
        """The phase itself."""
        return self

    @property
    def least_time(self) -> float:
        """Length of the blend [s]."""
        return self.blend

    @property
    def leads_to(self) -> str:
        """The formation."""
        return self.formation

    def ended(self, length: float) -> dict[str, Any]:
        """The formation, and a blend that is not longer; a step has none."""
        told = {"formation": self.formation}
        return told if self.reference == "step" else told | {"blend": min(self.blend, length)}


class Establish(Attitude, Shaping):
    """Take a formation from wherever the agents are, and attach the body frame to it."""

    body_control: ClassVar[str] = "open"

    kind: Literal["establish"] = Field(description="take a formation")
    attitude: Literal["drawn", "free"] = Field(
        "drawn",
        description="drawn: the slots tracked lie as they are drawn, in the world's axes or those of [body_frame], or "
        "at the angles asked for last, here or in a phase before; free: as they lie nearest to the agents, as always "
        "where no slots are tracked, and of a formation given by distances unless it asks for angles",
    )

    @property
    def establishing(self) -> Establish:
        """The phase itself."""
        return self

    @property
    def leads_to(self) -> str:
        """The formation, and how it is to lie."""
        return ", ".join([self.formation, *self.angles])


class Reshape(Shaping):
    """Change from one formation to another."""

    kind: Literal["reshape"] = Field(description="change the formation")


class Steering(Attitude, AnyPhase):
    """A phase that may change the attitude."""

    moves: ClassVar[bool] = True

    travel: Time | None = Field(
        None, description="from the start to the arrival [s]; when absent, the whole phase"
    )
    rates_deg_s: Rates = Field(
        (0.0, 0.0, 0.0), description="body rates [p, q, r] on arrival [deg/s]"
    )

    @property
    def steering(self) -> Steering:
        """The phase itself."""
        return self

    @property
    def meets(self) -> tuple[str, ...]:
        """The attitude, if one is commanded."""
        return () if self.attitude_deg is None else ("attitude", "rates")

    @property
    def least_time(self) -> float:
        """Time to the arrival [s]."""
        return self.travel or 0.0

    @property
    def leads_to(self) -> str:
        """The attitude, and its rates."""
        rates = [_vector(self.rates_deg_s, "°/s")] if any(self.rates_deg_s) else []
        return ", ".join([*self.angles, *rates])

    def ended(self, length: float) -> dict[str, Any]:
        """An arrival that is not later."""
        return {} if self.travel is None else {"travel": min(self.travel, length)}


class Fly(Steering):
    """Fly the centre of mass to a waypoint, to arrive after `travel`, or at the phase's end."""

    kind: Literal["fly"] = Field(description="fly to a waypoint")
    position: Vector = Field(description="centre of mass on arrival [x, y, z] [m]")
    velocity: Velocity = Field((0.0, 0.0, 0.0), description="its velocity on arrival [m/s]")

    @property
    def meets(self) -> tuple[str, ...]:
        """The waypoint, and the attitude if one is commanded."""
        return ("position", "velocity", *super().meets)

    @property
    def leads_to(self) -> str:
        """The waypoint, and the attitude."""
        velocity = [_vector(self.velocity, "m/s")] if any(self.velocity) else []
        rest = super().leads_to
        return ", ".join([_vector(self.position, "m"), *velocity, *([rest] if rest else [])])


class Turn(Steering):
    """Turn on the spot to an attitude: at least one angle is given."""

    kind: Literal["turn"] = Field(description="turn on the spot")


class Hold(AnyPhase):
    """Stay."""

    kind: Literal["hold"] = Field(description="stay")


class Orbit(AnyPhase):
    """Circle a point on a level circle, at a steady rate, and leave it with the velocity there."""

    moves: ClassVar[bool] = True
    goal_moves: ClassVar[bool] = True
    body_control: ClassVar[str] = "tracking"

    kind: Literal["orbit"] = Field(description="circle a point")
    centre: Vector = Field(description="centre of the circle, which is level [x, y, z] [m]")
    radius: Length = Field(description="radius of the circle [m]")
    rate_deg_s: Angle = Field(
        description="rate [deg/s], not 0: counter-clockwise seen from above where > 0, clockwise where < 0"
    )
    yaw: Literal["fixed", "along"] = Field(
        "fixed",
        description="fixed: the attitude commanded before is kept; along: the body turns with the orbit, and shows "
        "the centre the side that it had there at first",
    )
    blend: Time = Field(
        4.0, description="length of the run-in [s], from where the body is onto the circle"
    )

    @property
    def meets(self) -> tuple[str, ...]:
        """The place on the circle where it ends, and the attitude if that turns."""
        return ("position", "velocity", *(("attitude", "rates") if self.turns_away else ()))

    @property
    def turns_away(self) -> bool:
        """Whether the body turns with the orbit."""
        return self.yaw == "along"

    @property
    def least_time(self) -> float:
        """Length of the run-in [s]."""
        return self.blend

    @property
    def leads_to(self) -> str:
        """The circle."""
        return f"round {_vector(self.centre, 'm')} at {self.radius:g} m, {self.rate_deg_s:g}°/s"

    def ended(self, length: float) -> dict[str, Any]:
        """A run-in that is not longer."""
        return {"blend": min(self.blend, length)}


def _vector(values: Sequence[float], unit: str) -> str:
    return f"({', '.join(f'{value:g}' for value in values)}) {unit}"


Phase = Annotated[Establish | Fly | Reshape | Turn | Orbit | Hold, Field(discriminator="kind")]
#: Every kind of phase, by its name.
KINDS: dict[str, type[AnyPhase]] = {
    get_args(model.model_fields["kind"].annotation)[0]: model
    for model in get_args(get_args(Phase)[0])
}
Obstacle = Annotated[Box | Ground, Field(discriminator="kind")]


class MissionHeader(Part):
    """Keys at the top of a mission file."""

    schema_version: Literal[1] = Field(description="version of this format: 1")
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")] = Field(
        description="short name, which results are filed under: letters, digits, '.', '_', '-'"
    )
    title: Annotated[str, Field(pattern=r"^[^\r\n]*$")] = Field(
        "", description="what it shows, in one line"
    )
    source: str = Field("", description="table or figure of the paper that it reproduces")
    architecture: Literal["local", "body"] = Field(
        "local", description="local: each agent tracks its slot; body: a wrench on the virtual body"
    )
    formulation: Literal["inertial", "body"] = Field(
        "inertial",
        description="equations integrated: Newton's, or the paper's in the body frame, of which many agents that turn "
        "take fewer steps",
    )
    assignment: Literal["given", "shortest", "safe", "each"] = Field(
        "given",
        description="who takes which slot (and its edges): given, agent 1 slot 1 and so on; shortest, least "
        "squared way from the start to the first formation established; safe, most room on the way; each, least "
        "squared way anew at each change, without turning the shapes",
    )
    gravity: Annotated[float, Strict(), _from_zero(ACCELERATION)] = Field(
        9.81, description="gravity [m/s^2], >= 0"
    )
    output_step: Time = Field(0.05, description="time between samples of the result [s]")


class Contents(MissionHeader):
    """A whole mission file."""

    agents: Agents = Field(description="the vehicles: [agents]")
    constraint: Constraint = Field(
        default_factory=Constraint, description="the constraint force: [constraint]"
    )
    lqr: Lqr = Field(default_factory=Lqr, description="regulator of the virtual body: [lqr]")
    tracking: Tracking = Field(
        default_factory=Tracking, description="regulator of each agent: [tracking]"
    )
    allocation: Allocation = Field(
        default_factory=Allocation, description="from wrench to agents: [allocation]"
    )
    integrator: IntegratorOptions = Field(
        default_factory=IntegratorOptions, description="tolerances: [integrator]"
    )
    body_frame: BodyFrame | None = Field(
        None, description="attitude of the body frame at t = 0: [body_frame]"
    )
    formations: dict[str, Formation] = Field(
        default_factory=dict, description="formations by name: [formations.NAME]"
    )
    obstacles: tuple[Obstacle, ...] = Field((), description="what not to touch: [[obstacles]]")
    limits: Limits = Field(default_factory=Limits, description="what to stay within: [limits]")
    disturbances: Disturbances | None = Field(
        None, description="wind, gusts, noise, wrong masses, vehicles lost: [disturbances]"
    )
    phases: Annotated[tuple[Phase, ...], Field(min_length=1)] = Field(
        description="what to do, in order: [[phases]]"
    )
