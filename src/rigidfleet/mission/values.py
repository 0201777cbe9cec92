"""Values of a mission file: numbers within bounds, vectors, lists; and `Part`, the base of all its tables."""

from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    Tag,
    WithJsonSchema,
)

from rigidfleet.mission import bounds

#: Bound on all numbers: larger than any quantity in SI units here, and its sixth power is still finite.
HUGE = 1e15
#: Value of a time that follows from the limits.
AUTO = "auto"

Number = Annotated[float, Strict(), Field(ge=-HUGE, le=HUGE)]
Positive = Annotated[float, Strict(), Field(gt=0, le=HUGE)]


def signed_number_field(bound: bounds.Bound, power: int = 1) -> Any:
    """A number of either sign within the bound, or its power."""
    return Field(ge=-(bound.most**power), le=bound.most**power)


def _positive_number_field(bound: bounds.Bound) -> Any:
    return Field(ge=bound.least, le=bound.most)


def nonnegative_number_field(bound: bounds.Bound) -> Any:
    """A number from zero up to the bound."""
    return Field(ge=0, le=bound.most)


Coordinate = Annotated[float, Strict(), signed_number_field(bounds.LENGTH)]
Length = Annotated[float, Strict(), _positive_number_field(bounds.LENGTH)]
LengthOrZero = Annotated[float, Strict(), nonnegative_number_field(bounds.LENGTH)]
Time = Annotated[float, Strict(), _positive_number_field(bounds.TIME)]
#: A time of the mission, from its start on.
Seconds = Annotated[float, Strict(), nonnegative_number_field(bounds.TIME)]
Speed = Annotated[float, Strict(), _positive_number_field(bounds.SPEED)]
Spread = Annotated[float, Strict(), nonnegative_number_field(bounds.SPEED)]
Acceleration = Annotated[float, Strict(), _positive_number_field(bounds.ACCELERATION)]
Jerk = Annotated[float, Strict(), _positive_number_field(bounds.JERK)]
Mass = Annotated[float, Strict(), _positive_number_field(bounds.MASS)]
Angle = Annotated[float, Strict(), signed_number_field(bounds.ANGLE)]
Gain = Annotated[float, Strict(), signed_number_field(bounds.GAIN)]
Weight = Annotated[float, Strict(), nonnegative_number_field(bounds.WEIGHT)]
Cost = Annotated[float, Strict(), _positive_number_field(bounds.WEIGHT)]
Tolerance = Annotated[float, Strict(), _positive_number_field(bounds.TOLERANCE)]
#: Infinity is allowed here; a later check rejects it with its own remedy.
Limit = Annotated[float, Strict(), Field(ge=bounds.FORCE.least, allow_inf_nan=True)]
Whole = Annotated[int, Strict(), Field(ge=-(2**31), lt=2**31)]
Flag = Annotated[bool, Strict()]
#: Number of an agent, from 1.
AgentNumber = Annotated[int, Strict(), Field(ge=1, le=bounds.AGENTS)]

_T = TypeVar("_T")
_Other = TypeVar("_Other")


#: One value, or a list in its place; one value, or as many as there are agents; a value, or a word in its place.
_OneOrList = Annotated[
    Annotated[_T, Tag("one")] | Annotated[_Other, Tag("list")],
    Discriminator(lambda value: "list" if isinstance(value, list | tuple) else "one"),
]
_PerAgent = _OneOrList[_T, tuple[_T, ...]]
_ValueOrWord = Annotated[
    Annotated[_T, Tag("one")] | Annotated[_Other, Tag("word")],
    Discriminator(lambda value: "word" if isinstance(value, str) else "one"),
]
_Two, _Three = (Field(min_length=n, max_length=n) for n in (2, 3))
#: A place [x, y] as it is seen from above.
Place = Annotated[tuple[Coordinate, ...], _Two]
Vector = Annotated[tuple[Coordinate, ...], _Three]
_SignedSpeed = Annotated[float, Strict(), signed_number_field(bounds.SPEED)]
Velocity = Annotated[tuple[_SignedSpeed, ...], _Three]
#: A velocity, or "free": any.
VelocityOrFree = _ValueOrWord[Velocity, Literal["free"]]
Force = Annotated[tuple[Annotated[float, Strict(), signed_number_field(bounds.FORCE)], ...], _Three]
Rates = Annotated[tuple[Angle, ...], _Three]
Weights = Annotated[tuple[Weight, ...], _Two]
Size = _OneOrList[Length, Annotated[tuple[Length, ...], _Three]]
Edges = _OneOrList[
    Literal["complete", "neighbours", "henneberg", "henneberg-multilevel"],
    tuple[Annotated[tuple[Whole, ...], _Two], ...],
]

#: Of each vehicle, pieces: duration, and coefficients of x, y, z and yaw.
_Number = Annotated[float, Strict(), Field(ge=-1e12, le=1e12)]
_Row = Annotated[tuple[_Number, ...], Field(min_length=5, max_length=33)]
_Trajectory = Annotated[tuple[_Row, ...], Field(min_length=1)]
Trajectories = Annotated[tuple[_Trajectory, ...], Field(min_length=1)]

#: Where vehicles without a slot wait.
Rest = _OneOrList[Literal["sides"], tuple[Vector, ...]]
Damping = _ValueOrWord[Tolerance, Literal["auto"]]
#: A time, or "auto": the least one that keeps the limits.
Duration = _ValueOrWord[Time, Literal["auto"]]
Delay = Annotated[float, Strict(), Field(ge=0, le=10)]
Seed = Annotated[int, Strict(), Field(ge=0, lt=2**31)]
PerAgent = _PerAgent[Weight]
PerAgentError = _PerAgent[Annotated[float, Strict(), Field(gt=-1, le=bounds.MASS_RATIO)]]
PerAgentDelay = _PerAgent[Delay]
PerAgentDrift = _PerAgent[Annotated[float, Strict(), Field(ge=-1e5, le=1e5)]]
PerAxis = _OneOrList[Spread, Annotated[tuple[Spread, ...], _Three]]
Small = Annotated[float, Strict(), Field(ge=1e-15, le=1.0)]
Coefficient = Annotated[float, Strict(), Field(ge=0, le=1e3)]
Scale = Annotated[float, Strict(), Field(ge=0.1, lt=1.0)]
Share = Annotated[float, Strict(), Field(ge=0, le=0.95)]
Frequency = Annotated[float, Strict(), Field(gt=0, le=1000)]
Rate = Annotated[float, Strict(), Field(ge=1, le=100_000)]
Tilt = Annotated[float, Strict(), Field(gt=0, lt=90)]
Longitude = Annotated[float, Strict(), Field(ge=-180, le=180)]
Inertia = Annotated[tuple[Annotated[float, Strict(), Field(ge=1e-9, le=1e6)], ...], _Three]
BodyDrag = Annotated[tuple[Coefficient, ...], _Three]
RotorSpeeds = Annotated[tuple[Annotated[float, Strict(), Field(ge=0, le=1e5)], ...], _Two]
MotorTimes = Annotated[tuple[Annotated[float, Strict(), Field(ge=1e-3, le=10)], ...], _Two]
AttitudeGains = Annotated[tuple[Annotated[float, Strict(), Field(gt=0, le=1e6)], ...], _Two]
#: A colour of light: red, green and blue in hexadecimal digits.
Colour = _PerAgent[Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")]]


def _one_or_list(kind: dict[str, Any]) -> WithJsonSchema:
    """In the schema: one value of a kind, or a list of them."""
    return WithJsonSchema({"anyOf": [kind, {"type": "array", "items": kind}]})


NAME_OR_LIST = _one_or_list({"type": "string"})


def number_or_list(least: float) -> WithJsonSchema:
    """In the schema: a number of at least ``least``, or a list of them."""
    return _one_or_list({"type": "number", "minimum": least})


def key(text: str, default: Any = None, **more: Any) -> Any:
    """A key of a table that may be left out: its meaning with its unit, and its default, or what makes one."""
    kind = "default_factory" if callable(default) else "default"
    return Field(description=text, **{kind: default}, **more)


def required_key(text: str, **more: Any) -> Any:
    """A key that a table must have: its meaning with its unit."""
    return Field(description=text, **more)


def models_by_kind(union: Any) -> dict[str, Any]:
    """Models of a union of tables by their `kind`."""
    models = get_args(get_args(union)[0])
    return {get_args(model.model_fields["kind"].annotation)[0]: model for model in models}


class Part(BaseModel):
    """A table of a mission file: immutable, without unknown keys, with finite numbers."""

    # Tables are validated one by one; the models of tables that a mission lacks are never built.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)
