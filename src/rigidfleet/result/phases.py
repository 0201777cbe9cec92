"""What a result tells of each phase: its target, the certificate of its plan, its worst values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple, TypedDict

from rigidfleet.typing import InputLaw

_Three = tuple[float, float, float]


class _Moment(TypedDict):
    time: float


class _Place(_Moment):
    position: _Three


class Passed(_Place, total=False):
    """A point that the centre of mass is to pass, when, and at which velocity if that is commanded."""

    velocity: _Three


class Target(_Moment, total=False):
    """Target of a phase: time of arrival [s] and the state commanded then, and points to pass on the way.

    None: nothing is commanded.
    """

    position: _Three | None
    velocity: _Three | None
    attitude: tuple[float, float, float, float] | None
    rates: _Three | None
    through: list[Passed]


class Planned(_Moment):
    """Certificate of a phase: the least separation of the planned paths [m], its time [s], the two agents, the proof.

    Agents are counted from 0. ``how`` is "closed form" or "conservative advancement".
    """

    separation: float
    agents: tuple[int, int]
    how: str


class Extremum(NamedTuple):
    """Worst value of a quantity in continuous time, not only at samples.

    ``who`` is the agent, or the first of two, counted from 0. ``other`` is the second agent or the obstacle, counted
    from 0; -1 if there is neither.
    """

    value: float
    time: float
    who: int
    other: int


@dataclass(slots=True)
class PhaseRecord:
    """A phase as flown.

    Attributes
    ----------
    name, kind, control : as in the mission; control is "open", "tracking" or "body"
    formation : name of the formation that is held or approached; None if no formation has been established
    t_start, t_end : mission time [s]
    settled : whether a phase that ends by settling has settled; None for a phase that ends at a time
    target : for phases with a goal of their own (fly, turn, orbit), and for establish phases with a commanded
        attitude: {"time" [s], "position" [m], "velocity" [m/s], "attitude" quaternion, "rates" [rad/s]}. Entries other
        than the time are None if nothing is commanded
    stay : of phases that stay (such as hold, reshape, brake), and of those that go on after their arrival: {"time" [s],
        "position" [m], "velocity" [m/s]} of the centre of mass at the end of the phase. None if nothing leads it there,
        and of a phase that was left early
    abandoned : whether the loss of a vehicle or link ended it, before its own end
    planned : certificate of the planned paths, before the flight: {"separation" [m], "time" [s], "agents" from 0,
        "how"}. None if agents track no slots, there is a single agent, or a controller of the user's flew
    extremes : worst values of the phase in continuous time, by name: separation, clearance, separation_below,
        separation_flying (with an agent at limits.separation_altitude or above), lost (distance
        of a lost vehicle to one that still flies), geofence (distance beyond it), lowest, highest [m];
        speed [m/s]; acceleration [m/s^2]; where one by direction is limited, all of these by direction; thrust,
        thrust_margin (thrust minus its limit), constraint_force, tension [N]; constraint [m]; of vehicles also
        rotor_force [N] (of the rotor nearest to its limit), tilt [rad],
        tracking_error [m] and saturation (share of the phase). With [avoidance] also barrier and guard (greatest share
        of the phase in which they acted on a vehicle, and since when), clock (by how much the phase ended later because
        the formation waited [s], and since when) and body (share of the phase in which the formation deviated from its
        path as a body), guarantee and clearance_guarantee (least margin
        of stop segments [m]) and, where it was negative, the first such: guarantee_lost, clearance_guarantee_lost. If
        vehicles stand on obstacles, clearance is also given for those that have stood on one since the start
        (clearance_start), for those in flight (clearance_flight), and for those that stand on one until the end
        (clearance_end). The first contacts of the flight, in the phase in which they are: separation_first, lost_first,
        clearance_first. Empty if only samples are known
    controller : whether a user's controller was called; None if the flight had none
    """

    name: str
    kind: str
    control: InputLaw
    formation: str | None
    t_start: float
    t_end: float
    settled: bool | None = None
    target: Annotated[dict[str, Any] | None, Target] = None
    planned: Annotated[dict[str, Any] | None, Planned] = None
    extremes: Annotated[dict[str, Extremum], dict[str, tuple[float, float, int, int]]] = field(
        default_factory=dict
    )
    abandoned: bool = False
    controller: bool | None = None
    stay: Annotated[dict[str, Any] | None, Target] = None

    def __post_init__(self) -> None:
        self.extremes = {name: Extremum(*x) for name, x in (self.extremes or {}).items()}
