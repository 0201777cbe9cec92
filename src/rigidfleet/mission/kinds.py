"""The kinds of phases: their keys with unit and meaning, and the properties by which other modules tell them apart."""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from rigidfleet._common.renamed import with_earlier_members
from rigidfleet.foreign.curves import rows_to_curve
from rigidfleet.math.piecewise import Piecewise, stack_ways
from rigidfleet.mission import values
from rigidfleet.mission.values import AUTO, Part, key, models_by_kind, required_key
from rigidfleet.typing import InputLaw, Ints

#: Keys of a phase that may be automatic, and the word for it.
TIMES = ("duration", "travel", "blend")
#: Greatest number of coefficients of all trajectories that a phase follows.
_COEFFICIENTS = 10_000_000
#: Keys of an attitude: 3-2-1 Euler angles.
ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")


class Settle(Part):
    """The phase ends when its error has stayed within a tolerance for some time."""

    tolerance: values.Tolerance = key("maximum error [m]", 1e-3)
    dwell: values.Seconds = key("time that the error must stay within tolerance [s]", 1.0)
    timeout: values.Time = key("time after which the mission fails [s]", 60.0)


@with_earlier_members(
    led="follows_curves",
    spelled="flown_as_written",
    ended="keys_if_ended",
    automatic="auto_keys",
    angles="angles_in_words",
    meets="commanded_at_arrival",
    bent="has_bent_ways",
)
class AnyPhase(Part):
    """Keys of every phase. Exactly one of until, duration and settle ends it."""

    # Properties of a kind. Other modules use these instead of testing for the kind.

    #: Whether the phase takes a formation.
    shapes: ClassVar[bool] = False
    #: Whether the phase moves the virtual body to a goal of its own, which needs feedback control.
    moves: ClassVar[bool] = False
    #: Whether a phase may be left anywhere, with its goal there. Other phases keep their goal for the next one.
    goal_moves: ClassVar[bool] = False
    #: Whether the phase leads from or to the ground, so that the mission needs one; whether it ends there.
    grounded: ClassVar[bool] = False
    lands: ClassVar[bool] = False
    #: Whether other phases take its place before the flight, so that it cannot begin in flight.
    replaced: ClassVar[bool] = False
    #: Whether the phase follows curves of its own keys, whose start has to be where the vehicles are.
    follows_curves: ClassVar[bool] = False
    #: Default control in architecture "body".
    body_control: ClassVar[str] = "body"

    name: str = key("unique name; default: its kind and number", "")
    until: values.Time | None = key("the phase ends at this mission time [s]")
    duration: values.Duration | None = key(
        "the phase ends after this time [s]; auto: as soon as the limits allow (smooth missions)"
    )
    settle: Settle | None = key("the phase ends when its error has settled")
    control: InputLaw = key(
        "open: weight compensation and input_force; tracking: each agent tracks its slot; body: "
        "wrench on the virtual body. With architecture 'body' the default is open for establish, tracking for "
        "orbit and body for other phases",
        "tracking",
    )
    input_force: values.Force = key(
        "force on each agent in addition to weight compensation [N]; only with control 'open'",
        (0.0, 0.0, 0.0),
    )

    @property
    def tracks_slots(self) -> bool:
        """Whether each agent tracks its slot."""
        return self.control == "tracking"

    @property
    def leads_body(self) -> bool:
        """Whether feedback leads the virtual body, by a wrench that agents share."""
        return self.control == "body"

    @property
    def shaping(self) -> "Shaping | None":
        """The phase if it takes a formation, else None."""
        return self if isinstance(self, Shaping) else None

    @property
    def establishing(self) -> "Establish | None":
        """The phase if it also attaches the body frame to its formation, else None."""
        return self if isinstance(self, Establish) else None

    @property
    def steering(self) -> "Steering | None":
        """The phase if the regulators of [lqr] steer it to a goal of its own, else None."""
        return self if isinstance(self, Steering) else None

    @property
    def attitude_deg(self) -> tuple[float, float, float] | None:
        """Commanded (roll, pitch, yaw) [deg]; None keeps the attitude commanded before."""
        return None

    @property
    def angles_in_words(self) -> list[str]:
        """Commanded angles in words; empty to keep the attitude commanded before."""
        angles = zip(("roll", "pitch", "yaw"), self.attitude_deg or (), strict=False)
        return [f"{name} {angle:g}°" for name, angle in angles if angle or name == "yaw"]

    @property
    def commanded_at_arrival(self) -> tuple[str, ...]:
        """Which of position, velocity, attitude and rates are commanded at the arrival."""
        if not self.goal_moves:
            return ()
        return ("position", "velocity", *(("attitude", "rates") if self.turns_away else ()))

    @property
    def has_free_velocity(self) -> bool:
        """Whether a place is to be reached at any velocity."""
        meets = self.commanded_at_arrival
        return "position" in meets and "velocity" not in meets

    @property
    def turns_away(self) -> bool:
        """Whether the phase ends in an attitude that no key commands."""
        return False

    @property
    def rest_position(self) -> values.Vector | None:
        """Centre of mass to rest at [m], of a phase that comes to rest; None for where it is."""
        return None

    @property
    def points(self) -> "tuple[Through, ...]":
        """Points to pass on the way, of a kind that has `through`."""
        return self.__dict__.get("through", ())

    @property
    def vertical(self) -> "Vertical | None":
        """The phase if it leads vehicles straight up or down, else None."""
        return self if isinstance(self, Vertical) else None

    @property
    def flown_as_written(self) -> bool:
        """Whether the phase is flown as written; others take its place before the flight (`planning.transitions`)."""
        return True

    @property
    def has_bent_ways(self) -> bool:
        """Whether the phase leads its vehicles on bent ways to a formation: they have been found, or given."""
        return self.__dict__.get("control_points") is not None

    @property
    def auto_keys(self) -> list[str]:
        """Keys whose times follow from the limits (`rigidfleet.planning.timing`)."""
        return [key for key in TIMES if self.__dict__.get(key) == AUTO]

    @property
    def has_least_time(self) -> bool:
        """Whether `duration = "auto"` may end the phase: it moves, or takes a formation, and then is done."""
        return self.moves or self.shapes

    @property
    def time_key(self) -> str:
        """The key that sets the time of its motion."""
        own = self.__dict__
        return "blend" if "blend" in own else "duration" if own.get("travel") is None else "travel"

    @property
    def least_time(self) -> float:
        """Duration of its travel or blend [s], nan while it is automatic. The phase should not end before."""
        own = self.__dict__.get
        return seconds(own("travel") or own("blend") or 0.0)

    @property
    def leads_to(self) -> str:
        """Target of the phase in words; "" if it stays."""
        return ""

    @property
    def ends(self) -> str:
        """When the phase ends, in words: at a time, after a duration, or as it settles."""
        if self.settle is not None:
            return f"settled, within {self.settle.timeout:g} s"
        if self.duration == AUTO:
            return "as soon as the limits allow"
        return f"at {self.until:g} s" if self.until is not None else f"after {self.duration:g} s"

    def keys_if_ended(self, length: float) -> dict[str, Any]:
        """Keys that change if the pilot ends the phase after another duration [s]: no motion is longer than it."""
        own = ((key, self.__dict__.get(key)) for key in ("travel", "blend"))
        return {key: min(seconds(time), length) for key, time in own if time is not None}


class Attitude(Part):
    """Angles of an attitude; if one is given, the default of the others is 0."""

    roll_deg: values.Angle | None = key("roll at arrival [deg], 3-2-1 Euler angles")
    pitch_deg: values.Angle | None = key("pitch at arrival [deg]")
    yaw_deg: values.Angle | None = key(
        "yaw at arrival [deg]; if one angle is given, the default of the others is 0"
    )

    @model_validator(mode="before")
    @classmethod
    def _complete_angles(cls, data: Any) -> Any:
        if isinstance(data, dict) and any(angle in data for angle in ANGLES):
            return dict.fromkeys(ANGLES, 0.0) | data
        return data

    @property
    def attitude_deg(self) -> tuple[float, float, float] | None:
        """Commanded (roll, pitch, yaw) [deg]; None keeps the attitude commanded before."""
        if self.roll_deg is None or self.pitch_deg is None or self.yaw_deg is None:
            return None
        return self.roll_deg, self.pitch_deg, self.yaw_deg


@with_earlier_members(aligned="fits_slots")
class Shaping(AnyPhase):
    """A phase that changes the formation."""

    shapes: ClassVar[bool] = True

    formation: str = required_key("name of the formation to take")
    reference: Literal["shape", "distances", "squares", "step"] = key(
        "how the distances change: shape: slots blend; squares: squared distances blend; distances: as "
        "squares if that leads to the slots or there are none, else as shape; step: at once, as in the paper",
        "shape",
    )
    blend: values.Duration = key(
        "duration of the blend from the start of the phase [s]; auto: the least that keeps the limits",
        4.0,
    )

    position: values.Vector | None = key(
        "centre of mass at the end, at rest [x, y, z] [m]; default: as before"
    )

    @property
    def commanded_at_arrival(self) -> tuple[str, ...]:
        """Position and velocity, if a place is commanded."""
        return () if self.position is None else ("position", "velocity")

    @property
    def rest_position(self) -> values.Vector | None:
        """The position, if it is commanded."""
        return self.position

    @property
    def fits_slots(self) -> bool:
        """Whether the slots are rotated during the blend, so that they move least: unless `alignment` is none."""
        return self.__dict__.get("alignment") != "none"

    @property
    def leads_to(self) -> str:
        """The formation, and its place and angles if they are commanded."""
        place = [] if self.position is None else [_as_text(self.position, "m")]
        return ", ".join([self.formation, *place, *self.angles_in_words])

    def keys_if_ended(self, length: float) -> dict[str, Any]:
        """The formation, and a blend that is not longer than the phase; a step has none."""
        return {"formation": self.formation} | (
            {} if self.reference == "step" else super().keys_if_ended(length)
        )


class Establish(Attitude, Shaping):
    """Take a formation from the current positions of the agents, and attach the body frame to it."""

    body_control: ClassVar[str] = "open"

    kind: Literal["establish"] = required_key("take a formation")
    attitude: Literal["drawn", "free"] = key(
        "drawn: tracked slots have the attitude commanded here or in an earlier phase, else that of the "
        "world axes or [body_frame]; free: slots have the attitude nearest to the agents. The attitude is always "
        "free if no slots are tracked, or if the formation is given by distances and no angle is commanded",
        "drawn",
    )


class Reshape(Shaping):
    """Change from one formation to another."""

    kind: Literal["reshape"] = required_key("change the formation")
    transition: Literal["straight", "layers", "ways", "auto"] = key(
        "ways to the new slots: straight: all at once; layers: apart to levels one above the other, "
        "across, and together again, as three phases, with every pair proved; ways: bent ways for all together, found "
        "within limits.speed and acceleration, and proved; auto: straight if that keeps limits.separation, else layers",
        "straight",
    )
    control_points: tuple[tuple[values.Vector, ...], ...] | None = key(
        "bent ways to the new slots over `blend`: control points of uniform cubic B-splines, a row of "
        "slots [m] for each. `check --expand` and results have them in place of transition = 'ways'"
    )
    alignment: Literal["fit", "none"] = key(
        "fit: the new slots are rotated onto the old ones during the blend, and turn back meanwhile; none: "
        "straight ways in the axes of the body",
        "fit",
    )

    @property
    def flown_as_written(self) -> bool:
        """Whether the ways are straight, or given."""
        return self.transition == "straight"


class Steering(Attitude, AnyPhase):
    """A phase that can change the attitude."""

    moves: ClassVar[bool] = True

    travel: values.Duration | None = key(
        "time from the start to the arrival [s]; default: the whole phase; auto: the least that keeps the "
        "limits"
    )
    rates_deg_s: values.Rates = key("body rates [p, q, r] at arrival [deg/s]", (0.0, 0.0, 0.0))

    @property
    def commanded_at_arrival(self) -> tuple[str, ...]:
        """The attitude, if one is commanded."""
        return () if self.attitude_deg is None else ("attitude", "rates")

    @property
    def leads_to(self) -> str:
        """The commanded angles and rates."""
        rates = [_as_text(self.rates_deg_s, "°/s")] if any(self.rates_deg_s) else []
        return ", ".join([*self.angles_in_words, *rates])


class Through(Part):
    """A point that a `fly` phase passes without a stop."""

    position: values.Vector = required_key("centre of mass [x, y, z] [m]")
    time: values.Time | None = key(
        "time from the start of the phase [s]; default: the times with the least snap"
    )
    velocity: values.Velocity | None = key(
        "its velocity then [m/s]; default: the one with the least snap"
    )


class Fly(Steering):
    """Fly the centre of mass to a waypoint, with arrival after `travel` or at the end of the phase."""

    kind: Literal["fly"] = required_key("fly to a waypoint")
    position: values.Vector = required_key("centre of mass at arrival [x, y, z] [m]")
    velocity: values.VelocityOrFree = key(
        "its velocity at arrival [m/s]; free: any, not judged", (0.0, 0.0, 0.0)
    )
    through: tuple[Through, ...] = key(
        "points to pass on the way, with the least snap (smooth missions): "
        "`through = [{ position = [x, y, z], time = 4.0, velocity = [vx, vy, vz] }]`",
        (),
    )

    @property
    def commanded_at_arrival(self) -> tuple[str, ...]:
        """Position and velocity (unless it is free), and the attitude if one is commanded."""
        velocity = () if self.velocity == "free" else ("velocity",)
        return ("position", *velocity, *super().commanded_at_arrival)

    @property
    def leads_to(self) -> str:
        """The waypoint and the attitude."""
        v = self.velocity
        velocity = ["any velocity" if isinstance(v, str) else _as_text(v, "m/s")] if any(v) else []
        return ", ".join(filter(None, [_as_text(self.position, "m"), *velocity, super().leads_to]))


class Go(Attitude, AnyPhase):
    """Fly to a pose on a way that is found round obstacles. The way replaces the phase before the flight."""

    moves: ClassVar[bool] = True
    replaced: ClassVar[bool] = True
    body_control: ClassVar[str] = "tracking"

    kind: Literal["go"] = required_key("fly to a pose, on a way that is found round obstacles")
    position: values.Vector = required_key("centre of mass at arrival [x, y, z] [m]")
    clearance: values.LengthOrZero = key(
        "least distance of vehicles from obstacles on the planned way [m]", 0.2
    )
    formations: tuple[str, ...] | None = key(
        "formations that may be taken on the way; default: all that have slots. The phase ends in the "
        "formation in which it begins"
    )
    scales: tuple[values.Scale, ...] = key(
        "factors by which formations may shrink on the way, below 1; default: none", ()
    )

    @property
    def leads_to(self) -> str:
        """The position and the attitude."""
        return ", ".join([_as_text(self.position, "m"), *self.angles_in_words])


class Turn(Steering):
    """Turn on the spot to an attitude. At least one angle is required."""

    kind: Literal["turn"] = required_key("turn on the spot")


class Hold(AnyPhase):
    """Stay at the commanded position and attitude."""

    kind: Literal["hold"] = required_key("stay at the commanded position and attitude")


class Arriving(AnyPhase):
    """A phase that arrives at a time of its own, and stays there until its end."""

    moves: ClassVar[bool] = True
    body_control: ClassVar[str] = "tracking"

    travel: values.Time | None = key(
        "time from the start to the arrival [s]; default: the whole phase"
    )


class Brake(Arriving):
    """Come to rest where braking leads, in position and attitude, with the least snap."""

    kind: Literal["brake"] = required_key("come to rest where braking leads")


@with_earlier_members(each="has_way_per_vehicle")
class Vertical(Arriving):
    """A phase that leads vehicles straight up or down: all together, some of them, or one group after another."""

    grounded: ClassVar[bool] = True
    commanded_at_arrival: ClassVar[tuple[str, ...]] = ("position", "velocity")

    agents: tuple[values.AgentNumber, ...] = key(
        "numbers of the vehicles that move; the others stay. Default: all", ()
    )
    stagger: values.Time | None = key(
        "time [s] from one group's start to the next's; all arrive by the end of the phase, each before "
        "the next starts. Default: all start together"
    )
    by: Literal["rows", "vehicles"] = key(
        "groups of stagger: rows: vehicles with the same y, the southernmost first; vehicles: one by one, "
        "in the order of their numbers",
        "rows",
    )

    def movers(self, n: int) -> Ints:
        """Numbers, from 0, of the vehicles that move, of n."""
        return np.array(self.agents, dtype=np.int64) - 1 if self.agents else np.arange(n)

    @property
    def flown_as_written(self) -> bool:
        """Whether there is one group, which does not land elsewhere."""
        return self.stagger is None and self.__dict__.get("places") != "own"

    @property
    def arrival_height(self) -> float | None:
        """Height of all vehicles above the ground on arrival [m]; None to come down to it."""
        return self.__dict__.get("height")

    @property
    def has_way_per_vehicle(self) -> bool:
        """Whether each vehicle has a way of its own, so that the shape may change."""
        return bool(self.agents) or self.stagger is not None


class Takeoff(Vertical):
    """Climb straight up from the ground, until all vehicles are at one height."""

    #: Vehicles that stand on different heights come level.
    has_way_per_vehicle: ClassVar[bool] = True

    kind: Literal["takeoff"] = required_key("climb straight up to a level height")
    height: values.Length = required_key(
        "height of the vehicles' centres above the ground on arrival [m]"
    )

    @property
    def leads_to(self) -> str:
        """The height."""
        return f"{self.height:g} m above the ground"


class Land(Vertical):
    """Descend straight down, until the lowest vehicle is just above the ground; staggered, until each is."""

    lands: ClassVar[bool] = True
    leads_to: ClassVar[str] = "the ground"

    kind: Literal["land"] = required_key("descend straight down to the ground")
    places: Literal["below", "own"] = key(
        "below: each vehicle lands where it is, often where another one stood; own: each goes to where it stood at the "
        "start, straight or by levels, on ways that are proved, and then down",
        "below",
    )


class Cruising(AnyPhase):
    """A phase on a course of its own, which it leaves with the velocity, and perhaps the attitude, there."""

    moves: ClassVar[bool] = True
    goal_moves: ClassVar[bool] = True
    body_control: ClassVar[str] = "tracking"


class Follow(Cruising):
    """Follow trajectories that another program made: the virtual body, or each vehicle its own."""

    follows_curves: ClassVar[bool] = True

    kind: Literal["follow"] = required_key("follow trajectories of a file")
    file: str | None = key(
        "file of the trajectories, relative to the mission file: one for the virtual body, or one for each "
        "vehicle; or a folder with a file for each vehicle. A result holds `trajectories` in its place"
    )
    units: str | None = key(
        "units of the file's columns that do not say theirs, of time, length and angle: 'ms,mm,deg'"
    )
    axes: str | None = key(
        "where x, y and z of the file point: enu (east, north, up), ned, or others of e, n, u, w, s, d"
    )
    trajectories: values.Trajectories | None = key(
        "of each vehicle, or of the virtual body alone: a list of pieces, each with its duration [s] and "
        "the coefficients of x, y, z [m] and yaw [rad], in ascending powers of the time since its beginning, equally "
        "many of each (at most 8)"
    )
    yaw: Literal["fixed", "file"] = key(
        "fixed: keeps the attitude commanded before; file: the virtual body is level and has the yaw of "
        "the file. The yaw of single vehicles follows [yaw]",
        "fixed",
    )
    travel: values.Time | None = key(
        "time from the start to the end of the trajectories [s]; default: the whole phase, whose default "
        "is the time in the file. With another time, all speeds scale"
    )

    @model_validator(mode="before")
    @classmethod
    def _complete_duration(cls, data: Any) -> Any:
        if isinstance(data, dict) and not {"until", "duration", "settle"} & data.keys():
            return data | {"duration": data.get("travel") or _duration_of(data.get("trajectories"))}
        return data

    @cached_property
    def pieces(self) -> Piecewise:
        """All trajectories as one from 0 [s]: pieces (K, N, 4, P) [m, rad].

        Raises
        ------
        ValueError
            They have too many knots in all.
        """
        return stack_ways([rows_to_curve(rows) for rows in self.trajectories or ()], _COEFFICIENTS)

    @property
    def turns_away(self) -> bool:
        """Whether the body turns as the file says."""
        return self.yaw == "file"

    @property
    def leads_to(self) -> str:
        """The trajectories."""
        n = len(self.trajectories or ())
        return "along a trajectory" if n == 1 else f"along {n} trajectories"

    def keys_if_ended(self, length: float) -> dict[str, Any]:
        """The time of the whole trajectories, so that they are flown as fast up to the new end."""
        whole = self.travel or self.duration
        return {"travel": length if whole is None else seconds(whole)}


def _duration_of(trajectories: Any) -> float:
    """Duration [s] of the longest of trajectories whose form is not checked yet; 1 if it has errors."""
    try:
        longest = max(math.fsum(row[0] for row in rows) for rows in trajectories)
        return longest if 0.0 < longest < math.inf else 1.0
    except (TypeError, ValueError, IndexError, OverflowError):
        return 1.0


class Orbit(Cruising):
    """Circle a point on a horizontal circle at a constant rate, and leave the circle with the velocity there."""

    has_least_time: ClassVar[bool] = False
    kind: Literal["orbit"] = required_key("circle a point")
    centre: values.Vector = required_key("centre of the horizontal circle [x, y, z] [m]")
    radius: values.Length = required_key("radius of the circle [m]")
    rate_deg_s: values.Angle = required_key(
        "angular rate [deg/s], not 0; seen from above, > 0 is counter-clockwise and < 0 clockwise"
    )
    yaw: Literal["fixed", "along"] = key(
        "fixed: keeps the attitude commanded before; along: the body turns with the orbit, with the same "
        "side towards the centre as at the start",
        "fixed",
    )
    blend: values.Duration = key(
        "duration of the entry from the current position onto the circle [s]; auto: the least that keeps "
        "the limits",
        4.0,
    )

    @property
    def turns_away(self) -> bool:
        """Whether the body turns with the orbit."""
        return self.yaw == "along"

    @property
    def leads_to(self) -> str:
        """The circle."""
        return f"round {_as_text(self.centre, 'm')} at {self.radius:g} m, {self.rate_deg_s:g}°/s"


def seconds(time: float | Literal["auto"]) -> float:
    """A time [s]; nan if it is automatic."""
    return math.nan if isinstance(time, str) else time


def _as_text(numbers: Sequence[float], unit: str) -> str:
    return f"({', '.join(f'{value:g}' for value in numbers)}) {unit}"


Phase = Annotated[
    Establish | Fly | Follow | Go | Reshape | Turn | Orbit | Hold | Brake | Takeoff | Land,
    Field(discriminator="kind"),
]
#: Models of all phases by `kind`.
KINDS: dict[str, type[AnyPhase]] = models_by_kind(Phase)
