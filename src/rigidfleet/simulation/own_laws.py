"""A user's law for each vehicle, called at each tick with what that vehicle knows: itself, its slot, its messages."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.errors import FlightError
from rigidfleet.kernel.fleet import ANSWERED, TICKS, SampledFlight, SampledState
from rigidfleet.kernel.mail import NONE
from rigidfleet.kernel.problem import Problem, Workspace
from rigidfleet.simulation.callbacks import call_user_code, copy_finite_array
from rigidfleet.typing import Floats


class Message(NamedTuple):
    """The newest message that a vehicle has heard of a neighbour: what it says, and how old it is [s]."""

    content: Any
    age: float


@dataclass(slots=True)
class View:
    """What one vehicle knows at a tick of its law; arrays are copies of its own.

    Agents count from 0, as in arrays.

    Attributes
    ----------
    agent : which vehicle it is
    t, dt : mission time, and time between two calls [s]
    phase : name of the phase
    mass, gravity : as laws assume them [kg], [m/s^2]
    position, velocity : (3,) its own as measured, world axes [m, m/s]
    reference_position, reference_velocity, reference_acceleration : (3,) of its slot, world axes [m, m/s, m/s^2]; NaN
        where no slots are tracked
    distance, distance_rate : what its edges are to have now, by neighbour [m], [m/s]
    inbox : newest `Message` of each neighbour of which it has heard, by neighbour; contents cannot be changed
    memory : a dictionary of its own, kept from call to call
    attitude, rates, rotor_speed : of a vehicle with rotors: (4,) quaternion, world to body, scalar first; (3,) body
        axes [rad/s]; (4,) [rad/s]; None for a point
    """

    agent: int
    t: float
    dt: float
    phase: str
    mass: float
    gravity: float
    position: Floats
    velocity: Floats
    reference_position: Floats
    reference_velocity: Floats
    reference_acceleration: Floats
    distance: dict[int, float]
    distance_rate: dict[int, float]
    inbox: dict[int, Message]
    memory: dict[Any, Any]
    attitude: Floats | None = None
    rates: Floats | None = None
    rotor_speed: Floats | None = None


#: A law returns the force (3,) [N] of its vehicle, weight included, and what it says to its neighbours; None: nothing.
Law = Callable[[View], tuple[ArrayLike, Any]]


class OwnLaws:
    """The laws of a flight's vehicles, what they remember and what they have said.

    Which message arrives, and when, is the kernel's; what it says is kept here.
    """

    def __init__(self, agent: Law | type, flight: SampledFlight) -> None:
        net, n = flight.network, len(flight.vehicles.m)
        self.laws: list[Law] = [agent() if isinstance(agent, type) else agent for _ in range(n)]
        self.every, self.tick = flight.every, flight.steps * flight.h
        self.points = flight.vehicles.point.tolist()
        self.memories: list[dict[Any, Any]] = [{} for _ in range(n)]
        pairs, first = net.links.tolist(), net.first.tolist()
        #: Links of each vehicle, with the neighbour that it hears by each.
        self.links = [[(l, pairs[l][1]) for l in range(*first[i : i + 2])] for i in range(n)]
        #: What all said at the last ticks of their laws, the newest last: those that may still be under way.
        self.said: deque[list[Any]] = deque(maxlen=(net.delay + net.jitter) // flight.every + 2)
        #: Of each link, the tick at which the newest message was written, and what it says.
        self.newest: list[tuple[int, Any]] = [(-1, None)] * len(pairs)
        #: Length that the edge of each link is to have [m], and its rate [m/s]: (2, L).
        self.lengths = np.zeros((2, len(pairs)))
        #: The views last made, with their tick and problem: who looks before the flight asks has the same ones.
        self.last: tuple[int, Problem | None, list[View | None]] = -1, None, []
        self.numbers = 0  # in the longest message

    def call_laws(
        self, phase: str, problem: Problem, w: Workspace, flight: SampledFlight, state: SampledState
    ) -> None:
        """Call the law of each vehicle at the tick at which the flight asks, and take what they answer.

        Raises
        ------
        FlightError
            A law raised an exception, or did not return a force and a message. It names the vehicle and the tick.
        """
        said: list[Any] = [None] * len(self.laws)
        k = int(state.count[TICKS])
        where = f"at tick {k}, t = {k * self.tick:.3f} s"
        for i, view in enumerate(self.views(phase, problem, w, flight, state)):
            if view is None:
                continue
            answer = call_user_code(f"the law of agent {i + 1}", where, self.laws[i], view)
            try:
                state.f_u[i], said[i], numbers = _force_message_and_size(answer)
            except ValueError as unfit:
                what, remedy = unfit.args
                what = f"the law of agent {i + 1} returned {what} {where}: {remedy}"
                raise FlightError(what) from None
            self.numbers = max(self.numbers, numbers)
            state.mail.mute[i] = said[i] is None
        self.said.append(said)
        state.count[ANSWERED] = k + 1

    def has_current_views(self, problem: Problem, state: SampledState) -> bool:
        """Whether the views last made are those of the tick that comes."""
        return bool(self.last[0] == state.count[TICKS]) and self.last[1] is problem

    def views(
        self, phase: str, problem: Problem, w: Workspace, flight: SampledFlight, state: SampledState
    ) -> list[View | None]:
        """What each vehicle knows at the tick that comes, as the kernel has it ready; None for those that are lost."""
        k, mail = int(state.count[TICKS]), state.mail
        if self.has_current_views(problem, state):
            return self.last[2]
        t, dt, g = k * self.tick, self.every * self.tick, problem.vehicles.g
        has_heard = mail.stamp >= 0
        mail.oldest[has_heard] = np.maximum(mail.oldest, k - mail.stamp)[has_heard]
        # An edge that has lost its other end keeps its last length, as nobody has told.
        has_edge, held = (mail.edge != NONE).tolist(), mail.edge >= 0
        self.lengths[:, held] = w.d[mail.edge[held]], w.d_dot[mail.edge[held]]
        (d, d_dot), stamps = self.lengths.tolist(), mail.stamp.tolist()
        tracks = problem.control.tracks_slots
        slots = [w.r_ref, w.v_ref, w.a_ref] if tracks else [np.full_like(w.r, np.nan)] * 3
        known, masses = np.stack([w.r, w.v, *slots], axis=1), problem.vehicles.m.tolist()
        views: list[View | None] = [None] * len(masses)
        for i in np.flatnonzero(~flight.vehicles.lost).tolist():
            links, inbox = self.links[i], {}
            for l, j in links:
                # A message is sent at the tick that is its stamp: it says what was said last then.
                sent_at, (written, content) = stamps[l] // self.every, self.newest[l]
                if sent_at * self.every > written:
                    written, content = sent_at * self.every, self.said[sent_at - k // self.every][j]
                    self.newest[l] = written, content
                if written >= 0:
                    inbox[j] = Message(content, (k - written) * self.tick)
            body = state.S[i, 6:].copy()
            rotors = () if self.points[i] else (body[:4], body[4:7], body[7:])
            r, v, r_ref, v_ref, a_ref = known[i].copy()
            views[i] = View(
                i, t, dt, phase, masses[i], g, r, v, r_ref, v_ref, a_ref, {j: d[l] for l, j in links if has_edge[l]},
                {j: d_dot[l] for l, j in links if has_edge[l]}, inbox, self.memories[i], *rotors,
            )  # fmt: skip
        self.last = k, problem, views
        return views


def _force_message_and_size(answer: Any) -> tuple[Floats, Any, int]:
    """Force (3,) [N] of what a law returned, a copy of its message, and how many numbers that has.

    Raises
    ------
    ValueError
        It cannot be flown: what it is, and the remedy.
    """
    try:
        force, message = answer
    except (TypeError, ValueError):
        raise ValueError(repr(answer), "return a force (3,) [N] and a message") from None
    try:
        f = copy_finite_array(force, (3,))
    except ValueError as error:
        what = f"as its force {error}"
        raise ValueError(what, "return a force (3,) [N], weight included, and a message") from None
    try:
        return f, *((None, 0) if message is None else immutable_copy(message))
    except TypeError as error:
        remedy = (
            f"it contains {error}; send numbers, arrays, tuples or dictionaries of these, or None"
        )
        raise ValueError("a message that cannot be sent", remedy) from None


def immutable_copy(x: Any) -> tuple[Any, int]:
    """A copy of numbers, arrays, and tuples, lists and dictionaries of these that nobody can change, and its numbers.

    Raises
    ------
    TypeError
        It contains something else, which the message names.
    """
    if isinstance(x, np.ndarray) and x.dtype.kind in "biuf":
        y = x.copy()
        y.flags.writeable = False
        return y, y.size
    if isinstance(x, int | float | np.floating | np.integer | np.bool_):
        return x.item() if isinstance(x, np.generic) else x, 1
    if isinstance(x, tuple | list):
        parts = [immutable_copy(part) for part in x]
        return tuple(part for part, _ in parts), sum(size for _, size in parts)
    if isinstance(x, Mapping):
        named = {name: immutable_copy(part) for name, part in x.items()}
        whole = {name: part for name, (part, _) in named.items()}
        return MappingProxyType(whole), sum(size for _, size in named.values())
    raise TypeError(
        f"an array of {x.dtype}" if isinstance(x, np.ndarray) else f"a {type(x).__name__}"
    )
