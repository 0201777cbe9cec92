"""The flight by neighbours of a formation that holds its slots, linear in what little it is off them.

Edges then do not turn, and all that a vehicle computes (`kernel.neighbours`) is a sum of what it knows. What it has
heard is kept as it was brought forward to now, so that time enters by the messages alone. Attitude and rotors follow as
their linear lag (`math.margins.Lag`), limits do not act, and messages are sent and used at ticks of the formation law.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.kernel.mail import FRESH, TOGETHER, UNDER_WAY
from rigidfleet.math.margins import Lag, LoopGains
from rigidfleet.math.rigid_body import rigid_motions
from rigidfleet.planning.vehicles import links_and_reverses
from rigidfleet.typing import Floats, Ints

#: Of each coordinate: place, velocity, acceleration and two derivatives of it; those of a point end with the velocity.
_ORDERS = 5
#: Rows of what is heard over a link, all along the edge: half of what the hearer then was, less what the sender was, in
#: place, velocity and acceleration; velocity and acceleration of the sender, and the share of its input. Then follows
#: what the sender's other edges do to it, by each iterate.
_PLACE, _VELOCITY, _ACCELERATION, _THEIR_VELOCITY, _THEIR_ACCELERATION, _INPUT, _REST = range(7)
#: Shortest time constant of a rotor [s]: a shorter one makes no difference.
_QUICK = 1e-4
#: Number of links up to which products with full matrices are quicker than with sparse ones.
_FEW = 200

#: What the arrivals at a tick change, (W, L, B): from the tick, and the change if all arrived that are some ticks late.
Arrivals = Callable[[int, Callable[[int], Floats]], Floats | float]


class Radio(NamedTuple):
    """Messages of vehicles, in ticks of the formation law.

    ``every`` ticks each sends; a message takes ``delay`` ticks. ``lag`` [s] is that of the estimate of accelerations,
    ``tick`` [s] the time between two evaluations of the law.
    """

    every: int
    delay: int
    lag: float
    tick: float


class LinearFlight:
    """N vehicles with L links.

    The state (size, B) of B flights at once begins with the places (3 N), and ends with the W rows of each link: its
    integral, and what it holds.

    Parameters
    ----------
    r : (N, 3) slots [m]
    edges : (m, 2) agents from 0
    masses : (N,) [kg]
    law : of constraints, and of the tracking of slots or none
    lags, drag : of each vehicle; drag per mass along each axis (N, 3) [1/s]
    """

    def __init__(
        self,
        r: Floats,
        edges: Ints,
        masses: Floats,
        law: LoopGains,
        radio: Radio,
        lags: Sequence[Lag],
        drag: Floats,
    ) -> None:
        tracks, iterated = law.control == "tracking", law.solver == "iterated"
        self.law = law if tracks else replace(law, k1=0.0, k2=0.0, ki=0.0)
        self.n, self.r, self.radio = len(r), r, radio
        self.links, self.back = links_and_reverses(edges)
        #: Whether nothing acts on motions of the whole formation.
        self.is_free = not (tracks or drag.any())

        i, j = self.links.T
        L, n3, iterations = len(i), 3 * self.n, law.iterations if iterated else 1
        unit = r[i] - r[j]
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        own, other = (_component_matrix(unit, x, n3) for x in (i, j))
        #: Errors of edges (m, N 3) of places.
        self.edges = (own - other)[i < j]
        inverse = 1.0 / masses
        pull = own.T * np.repeat(inverse, 3)[:, None]
        self._maps = [x.toarray() if L <= _FEW else x.tocsr() for x in (own, other, pull)]
        self._theirs = inverse[j, None]
        self._mean, self._damping = masses.mean(), law.damping * iterated

        # The equations of each vehicle's own edges, those of one vehicle below each other; L stands for no edge.
        first = np.searchsorted(i, np.arange(self.n + 1))
        most = int(np.diff(first).max())
        self._at = i, np.arange(L) - first[i]
        self._rows = np.full((self.n, most), L)
        self._rows[self._at] = np.arange(L)
        u, diagonal = np.zeros((self.n, most, 3)), np.ones((self.n, most))
        u[self._at] = unit
        diagonal[self._at] = self._mean * (inverse[i] + inverse[j]) + self._damping
        self._diagonal = np.eye(most) * diagonal[:, None]
        self._coupling = self._mean * inverse[:, None, None] * (u @ u.transpose(0, 2, 1))
        self._coupling *= 1.0 - np.eye(most)
        self._inverse = self._equation_inverses(np.ones((self.n, most)), np.arange(self.n))

        late, tick = lags[0].delay, radio.tick
        #: Ticks from a measurement to its use.
        self.waits = math.ceil(late / tick - 1e-9)
        orders = _ORDERS if any(not lag.point for lag in lags) else 2
        self._motion, self._early = (
            _transition_matrix(t, lags, drag, orders) for t in (tick, self.waits * tick - late)
        )
        #: Rows that are held and sent of each link, and number of links.
        self.shape = 1 + _REST + iterations, L
        self._shapes = {
            "orders": (orders, n3), "seen": (self.waits, 2, n3), "estimate": (n3,), "gust": (n3,), "commanded": (n3,),
            "error": (n3 * (self.law.ki > 0.0),), "held": self.shape,
        }  # fmt: skip
        self.size = sum(map(math.prod, self._shapes.values()))

    def parts(self, x: Floats) -> Any:
        """Views of the parts of a state (size, B), by name."""
        ends = np.cumsum([math.prod(shape) for shape in self._shapes.values()])
        cut = zip(self._shapes.items(), np.split(x, ends[:-1]), strict=True)
        return SimpleNamespace(**{name: y.reshape(*shape, x.shape[1]) for (name, shape), y in cut})

    def _extrapolate(self, heard: Floats, t: float) -> Floats:
        """Bring forward what was heard (W, L, B) in place by t [s], as `neighbours.extrapolate_neighbour` does."""
        place, velocity, acceleration, v, a, put = heard[:_REST]
        place += t * (velocity + 0.5 * t * acceleration)
        velocity += t * acceleration
        put -= t * (self.law.k1 * (v + 0.5 * t * a) + self.law.k2 * a)
        v += t * a
        return heard

    def _equation_inverses(self, grip: Floats, who: Ints) -> Floats:
        """Inverses (K, W, W) of the equations of some vehicles, whose edges have the ``grip`` (K, W).

        As in `neighbours.solve_own_constraint_force`, an edge that slips has a larger entry on the diagonal.
        """
        rows = grip[:, :, None] * self._coupling[who] + self._diagonal[who]
        return np.linalg.inv(rows) * grip[:, None]

    def _inverses_of_slipping_vehicles(self, grip: Floats) -> tuple[Ints, Ints, Floats]:
        """Vehicles (K,) in flights (K,) of which an edge slips, and the inverses of their equations."""
        each = np.concatenate([grip, np.ones((1, grip.shape[1]))])[self._rows]
        who, flight = np.nonzero((each < 1.0).any(axis=1))
        return who, flight, self._equation_inverses(each[who, :, flight], who)

    def _multipliers(self, right: Floats, slipping: tuple[Ints, Ints, Floats] | None) -> Floats:
        """Multipliers (L, B) by the right sides of all rows."""
        each = np.concatenate([right, np.zeros((1, right.shape[1]))])[self._rows]
        y = self._inverse @ each
        if slipping is not None:
            who, flight, inverses = slipping
            y[who, :, flight] = (inverses @ each[who, :, flight, None])[..., 0]
        return y[self._at]

    def rigid_states(self) -> Floats:
        """States (size, 2 t) in the places and with the steady velocities of the whole formation; nothing is heard."""
        Q = rigid_motions(self.r)
        still, moving = np.hstack([Q, 0.0 * Q]), np.hstack([0.0 * Q, Q])
        x = np.zeros((self.size, still.shape[1]))
        z = self.parts(x)
        z.orders[:2], z.seen[:], z.estimate[:] = (still, moving), (still, moving), moving
        return x

    def squares_and_end(
        self,
        x: Floats,
        sent: Floats,
        ticks: int,
        delay: int,
        arrivals: Arrivals,
        grip: Floats | None = None,
    ) -> tuple[Floats, Floats]:
        """Fly ``ticks`` ticks from a state (size, B), with the messages (D, W, L, B) of the last D ticks, oldest first.

        ``sent`` is changed in place, the message of tick k is then at k modulo D. ``grip`` (L, B) is the share with
        which an end pulls, which ``arrivals`` may change; default: all of it. Returns the sums of squares of errors of
        edges (ticks, B) [m^2], and the state.
        """
        x, squares = x.copy(), np.zeros((ticks, x.shape[1]))
        z, law, tick, (own, other, pull) = self.parts(x), self.law, self.radio.tick, self._maps
        lag, (integral, *held) = max(self.radio.lag, 4.0 * tick), z.held
        for k in range(ticks):
            r, v = z.seen[-1] if len(z.seen) else z.orders[:2]
            z.estimate += tick * (z.commanded + z.gust)
            off = v - z.estimate
            z.estimate += min(1.0, 2.0 * tick / lag) * off
            z.gust += tick / lag**2 * off
            put, nearer, faster = -law.k1 * r - law.k2 * v, own @ r, own @ v
            gap, along = FRESH * nearer + held[_PLACE], FRESH * faster + held[_VELOCITY]
            integral += tick * (gap if grip is None else gap * (grip > 0.0))
            right = held[_INPUT] - own @ put - 2.0 * law.alpha * along - law.beta**2 * gap
            right -= law.gamma * integral
            slipping = None if grip is None else self._inverses_of_slipping_vehicles(grip)
            y, force, rest = np.zeros_like(right), 0.0, []
            for theirs in held[_REST:]:
                y = self._multipliers(self._mean * (right + theirs) + self._damping * y, slipping)
                force = pull @ y
                # What a vehicle's other edges do to it: all of them, without the one that leads back.
                rest.append(other @ force + self._theirs * y[self.back])
            z.commanded[:] = put + force
            if law.ki:
                z.error += tick * r
                z.commanded -= law.ki * z.error
            a = z.commanded + z.gust
            pace, change = other @ v, other @ a
            news = (
                integral - integral[self.back], (1.0 - FRESH) * nearer - other @ r, (1.0 - FRESH) * faster - pace,
                (1.0 - FRESH) * (own @ a) - change, pace, change, other @ put, *rest,
            )  # fmt: skip
            np.stack(news, out=sent[k % len(sent)])
            motion = np.concatenate([z.orders, z.commanded[None]])
            if len(z.seen):
                z.seen[1:] = z.seen[:-1].copy()
                z.seen[0] = np.einsum("qpn,pnb->qnb", self._early[:2], motion)
            z.orders[:] = np.einsum("qpn,pnb->qnb", self._motion, motion)
            self._extrapolate(z.held[1:], tick)
            z.held += arrivals(k + 1, partial(self._message_updates, sent, k + 1, delay, z.held))
            squares[k] = ((self.edges @ z.orders[0]) ** 2).sum(axis=0)
        return squares, x

    def _message_updates(self, sent: Floats, k: int, delay: int, held: Floats, late: int) -> Floats:
        """What changes in what is held (W, L, B) if each link's message arrives at tick k, some ticks late."""
        age = delay + late
        news = sent[(k - age) % len(sent)].copy()
        news[0] *= -min(TOGETHER, UNDER_WAY / max(age / self.radio.every, 1.0))
        news[1:] = self._extrapolate(news[1:], age * self.radio.tick) - held[1:]
        return news


def _component_matrix(directions: Floats, who: Ints, columns: int) -> Any:
    """The map (L, 3 N) of vectors of vehicles to the components of one of them (L,) along ``directions`` (L, 3)."""
    from scipy import sparse

    places = np.repeat(np.arange(len(who)), 3), (3 * who[:, None] + range(3)).ravel()
    return sparse.csr_array((directions.ravel(), places), (len(who), columns))


def _transition_matrix(t: float, lags: Sequence[Lag], drag: Floats, orders: int) -> Floats:
    """What places and their derivatives become in t [s]: (Q, Q + 1, 3 N), the command, which is held, last."""
    from scipy.linalg import expm

    kinds: dict[Any, Floats] = {}
    for lag, friction in zip(lags, drag.tolist(), strict=True):
        for axis in range(3):
            A, tau, moving = np.zeros((6, 6)), max(lag.tau, _QUICK), _ORDERS
            A[0, 1], A[1, 1] = 1.0, -friction[axis]
            if lag.point:
                A[1, 5], moving = 1.0, 2
            elif axis == 2:
                A[1, 2], A[2, 2], A[2, 5], moving = 1.0, -1.0 / tau, 1.0 / tau, 3
            else:
                A[1, 2] = A[2, 3] = A[3, 4] = 1.0
                A[4, 2:] = -lag.k_R / tau, -lag.k_omega / tau, -1.0 / tau, lag.k_R / tau
            over = expm(t * A)
            over[moving:] = 0.0
            kinds[lag, axis == 2, friction[axis]] = over[:orders, [*range(orders), 5]]
    of = [[kinds[lag, q == 2, drag[i, q]] for q in range(3)] for i, lag in enumerate(lags)]
    return np.moveaxis(np.array(of).reshape(-1, orders, orders + 1), 0, -1)
