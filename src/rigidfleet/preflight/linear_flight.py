"""The flight by neighbours of a formation that holds its slots, linear in what little it is off them.

Edges then do not turn, and all that a vehicle computes (`kernel.neighbours`) is a sum of what it knows. What it has
heard is kept as it was brought forward to now, so that time enters by the messages alone: a tick is a product with
constant matrices, and an arrival replaces a part of the state. Attitude and rotors follow as their linear lag
(`math.margins.Lag`), limits do not act, and messages are sent and used at ticks of the formation law.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.kernel.mail import FRESH, TOGETHER, UNDER_WAY
from rigidfleet.math.margins import Lag, LoopGains
from rigidfleet.math.rigid_body import rigid_motions
from rigidfleet.planning.vehicles import links_of
from rigidfleet.typing import Floats, Ints

#: Of each coordinate: place, velocity, acceleration and two derivatives of it; those of a point end with the velocity.
_ORDERS = 5
#: What is heard over a link, all along the edge: half of what the hearer then was, less what the sender was, in place,
#: velocity and acceleration; velocity and acceleration of the sender, and the share of its input.
_HEARD = ("place", "velocity", "acceleration", "their velocity", "their acceleration", "input")
#: Shortest time constant of a rotor [s]: a shorter one makes no difference.
_QUICK = 1e-4

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
    """Matrices of one tick of N vehicles with L links.

    The state (size, B) of B flights at once ends with the part of each link: its integral, and what it holds.

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
        from scipy import sparse

        self.n, self.r, self.radio = len(r), r, radio
        self.links, back = links_of(edges)
        self.tracks = law.control == "tracking"
        self.iterations = law.iterations if law.solver == "iterated" else 1
        self._gains = (law.k1, law.k2) if self.tracks else (0.0, 0.0)
        i, j = self.links.T
        unit = r[i] - r[j]
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        L, n3 = len(i), 3 * self.n
        rows = np.repeat(np.arange(L), 3)
        own, other = (
            sparse.csr_array((unit.ravel(), (rows, (3 * x[:, None] + range(3)).ravel())), (L, n3))
            for x in (i, j)
        )
        #: Rows that are held and sent of each link, and number of links.
        self.shape = len(self._held()) + 1, L
        #: Whether nothing acts on motions of the whole formation.
        self.is_free = not (self.tracks or drag.any())
        self._ends = own, other
        #: Errors of edges (m, N 3) of places.
        self.edges = sparse.csr_array(own - other)[i < j]

        damping = law.damping if law.solver == "iterated" else 0.0
        mean, inverse = masses.mean(), 1.0 / masses
        pull = sparse.diags_array(np.repeat(inverse, 3)) @ own.T
        theirs = sparse.diags_array(inverse[j])
        matrix = mean * (own @ pull + theirs) + damping * sparse.eye_array(L)
        solve = _inverse_of_blocks(matrix, np.searchsorted(i, np.arange(self.n + 1)))
        # What a neighbour's other edges do to it: all of them, without the one that leads back.
        rest = sparse.csr_array(other @ pull + sparse.csr_array((inverse[j], (range(L), back))))
        rest.data[np.abs(rest.data) < 1e-12] = 0.0
        rest.eliminate_zeros()

        self.late = late = lags[0].delay
        drift = law.ki if self.tracks else 0.0
        waits = math.ceil(late / radio.tick - 1e-9)
        motion, early = (
            _motion_over(t, lags, drag) for t in (radio.tick, waits * radio.tick - late)
        )
        orders = _ORDERS if any(not lag.point for lag in lags) else 2
        self.slices, self.size = _places(
            {f"order {q}": n3 for q in range(orders)}
            | {f"seen {q} {waits}": n3 for waits in range(waits) for q in range(2)}
            | dict.fromkeys(("estimate", "gust", "commanded", *(["error"] if drift else [])), n3)
            | dict.fromkeys(("integral", *self._held()), L)
        )

        def law_of(x: dict[str, Any]) -> tuple[dict[str, Any], Any]:
            """What vehicles know and keep, and the right side of each link without others' pulls."""
            r, v = (x[f"seen {q} {waits - 1}" if waits else f"order {q}"] for q in range(2))
            known = x["estimate"] + radio.tick * (x["commanded"] + x["gust"])
            lag, off = max(radio.lag, 4.0 * radio.tick), v - known
            y = {
                "r": r,
                "v": v,
                "own input": -self._gains[0] * r - self._gains[1] * v,
                "estimate": known + min(1.0, 2.0 * radio.tick / lag) * off,
                "gust": x["gust"] + radio.tick / lag**2 * off,
            }
            if drift:
                y["error"] = x["error"] + radio.tick * r
            gap, along = FRESH * (own @ r) + x["place"], FRESH * (own @ v) + x["velocity"]
            y["integral"] = x["integral"] + radio.tick * gap
            right = x["input"] - own @ y["own input"] - 2.0 * law.alpha * along - law.beta**2 * gap
            return y, right - law.gamma * y["integral"]

        # Each equation above is written once: of an identity matrix, it gives the matrix.
        x = self._parts(sparse.eye_array(self.size, format="csr"))
        right = law_of(x)[1]
        self.right = sparse.vstack(
            [mean * (right + x[f"rest {q}"]) for q in range(self.iterations)], format="csr"
        )
        self.solve, self.damping = solve, damping
        x = self._parts(identity := sparse.eye_array(self.size + self.iterations * L, format="csr"))
        multipliers = [identity[self.size + q * L :][:L] for q in range(self.iterations)]
        y = law_of(x)[0]
        y["commanded"] = y["own input"] + pull @ multipliers[-1]
        if drift:
            y["commanded"] = y["commanded"] - drift * y["error"]
        state = [x[f"order {q}"] for q in range(orders)] + [y["commanded"]]

        def after(over: Floats, q: int) -> Any:
            parts = [*range(orders), _ORDERS]
            return sum(
                sparse.diags_array(over[:, q, p]) @ z for p, z in zip(parts, state, strict=True)
            )

        y |= {f"order {q}": after(motion, q) for q in range(orders)}
        for q in range(2 * bool(waits)):
            y[f"seen {q} 0"] = after(early, q)
            y |= {f"seen {q} {k}": x[f"seen {q} {k - 1}"] for k in range(1, waits)}
        y |= dict(
            zip(
                self._held(),
                self.brought_forward([x[c] for c in self._held()], radio.tick),
                strict=True,
            )
        )
        said = [y["r"], y["v"], y["commanded"] + y["gust"], y["own input"], y["integral"]]
        self.step = sparse.vstack([*(y[name] for name in self.slices), *said], format="csr")
        # Messages, of what is said and the multipliers.
        identity = sparse.eye_array(4 * n3 + L + self.iterations * L, format="csr")
        r, v, a, put = (identity[q * n3 :][:n3] for q in range(4))
        integral = identity[4 * n3 :][:L]
        halves = [(1.0 - FRESH) * (own @ z) - other @ z for z in (r, v, a)]
        pulls = [rest @ identity[4 * n3 + (1 + q) * L :][:L] for q in range(self.iterations)]
        parts = [integral - integral[back], *halves, *(other @ z for z in (v, a, put)), *pulls]
        self.message = sparse.vstack(parts, format="csr")

    def _held(self) -> tuple[str, ...]:
        return (*_HEARD, *(f"rest {q}" for q in range(self.iterations)))

    def _parts(self, x: Any) -> dict[str, Any]:
        return {name: x[place] for name, place in self.slices.items()}

    def brought_forward(self, heard: Sequence[Any], t: float) -> list[Any]:
        """What was heard, as it is t [s] later without a further message (`neighbours.bring_forward`)."""
        place, velocity, acceleration, v, a, put, *rest = heard
        k1, k2 = self._gains
        return [
            place + t * velocity + 0.5 * t * t * acceleration,
            velocity + t * acceleration,
            acceleration,
            v + t * a,
            a,
            put - k1 * t * v - (0.5 * k1 * t * t + k2 * t) * a,
            *rest,
        ]

    def drift(self, delay: int) -> Floats:
        """Places and steady velocities of the whole formation, which no vehicle feels.

        Of each, the state with the messages of ``delay`` ticks (size + ..., 2 t), as `fly` takes them.
        """
        Q = rigid_motions(self.r)
        still, none = np.hstack([Q, 0.0 * Q]), np.hstack([0.0 * Q, Q])
        own, other = self._ends
        x, messages = (
            np.zeros((self.size, 2 * Q.shape[1])),
            np.zeros((delay, *self.shape, 2 * Q.shape[1])),
        )
        tick = self.radio.tick
        x[self.slices["order 0"]], x[self.slices["order 1"]] = still, none
        x[self.slices["estimate"]] = none
        waits = sum(name.startswith("seen 0") for name in self.slices)
        for k in range(waits):
            x[self.slices[f"seen 0 {k}"]] = still + ((waits - 1 - k) * tick - self.late) * none
            x[self.slices[f"seen 1 {k}"]] = none
        held = x[self.slices["integral"].start :].reshape(self.shape + (-1,))
        for parts, age in ((held, 0), *((messages[k], delay - k) for k in range(delay))):
            parts[1], parts[2] = (
                (1.0 - FRESH) * (own @ z) - other @ z
                for z in (still - (age * tick + self.late) * none, none)
            )
            parts[4] = other @ none
        return np.concatenate([x, messages.reshape(-1, x.shape[1])])

    def fly(
        self,
        x: Floats,
        sent: Floats,
        ticks: int,
        delay: int,
        arrivals: Arrivals,
        grip: Floats | float = 1.0,
    ) -> tuple[Floats, Floats]:
        """Fly ``ticks`` ticks from a state (size, B), with the messages (D, W, L, B) of the last D ticks, oldest first.

        ``sent`` is changed in place, the message of tick k is then at k modulo D. ``grip`` (L, B) is the share with
        which an end pulls. Returns the sums of squares of errors of edges (ticks, B) [m^2], and the state.
        """
        L, depth, errors = len(self.links), len(sent), np.zeros((ticks, x.shape[1]))
        for k in range(ticks):
            right = self.right @ x
            unknown = self.solve @ right[:L]
            multipliers = [grip * unknown]
            for q in range(1, self.iterations):
                unknown = self.solve @ (right[q * L :][:L] + self.damping * unknown)
                multipliers.append(grip * unknown)
            y = self.step @ np.concatenate([x, *multipliers])
            x, said = y[: self.size], y[self.size :]
            message = self.message @ np.concatenate([said, *multipliers])
            sent[k % depth] = message.reshape(sent.shape[1:])
            held = x[self.slices["integral"].start :].reshape(sent.shape[1:])

            def change(late: int, k: int = k, held: Floats = held) -> Floats:
                age = delay + late
                difference, *heard = sent[(k + 1 - age) % depth]
                part = min(TOGETHER, UNDER_WAY / max(age / self.radio.every, 1.0))
                forward = self.brought_forward(heard, age * self.radio.tick)
                return np.stack(
                    [-part * difference, *(a - b for a, b in zip(forward, held[1:], strict=True))]
                )

            held += arrivals(k + 1, change)
            errors[k] = ((self.edges @ x[self.slices["order 0"]]) ** 2).sum(axis=0)
        return errors, x


def _places(sizes: dict[str, int]) -> tuple[dict[str, slice], int]:
    ends = np.cumsum(list(sizes.values())).tolist()
    starts = [0, *ends[:-1]]
    return {name: slice(a, b) for name, a, b in zip(sizes, starts, ends, strict=True)}, ends[-1]


def _inverse_of_blocks(matrix: Any, first: Ints) -> Any:
    """Inverse of a matrix of blocks along the diagonal that begin at ``first``."""
    from scipy import sparse

    matrix = sparse.csr_array(matrix)
    blocks = [
        np.linalg.inv(matrix[a:b, a:b].toarray())
        for a, b in zip(first[:-1].tolist(), first[1:].tolist(), strict=True)
        if b > a
    ]
    return sparse.block_diag(blocks, format="csr")


def _motion_over(t: float, lags: Sequence[Lag], drag: Floats) -> Floats:
    """What place, velocity and acceleration with its derivatives become in t [s]: (3 N, 5, 6), the command held."""
    from scipy.linalg import expm

    kinds: dict[Any, Floats] = {}
    for lag, friction in zip(lags, drag.tolist(), strict=True):
        for axis in range(3):
            A, tau, orders = np.zeros((6, 6)), max(lag.tau, _QUICK), _ORDERS
            A[0, 1], A[1, 1] = 1.0, -friction[axis]
            if lag.point:
                A[1, 5], orders = 1.0, 2
            elif axis == 2:
                A[1, 2], A[2, 2], A[2, 5], orders = 1.0, -1.0 / tau, 1.0 / tau, 3
            else:
                A[1, 2] = A[2, 3] = A[3, 4] = 1.0
                A[4, 2:] = -lag.k_R / tau, -lag.k_omega / tau, -1.0 / tau, lag.k_R / tau
            over = expm(t * A)[:_ORDERS]
            over[orders:] = 0.0
            kinds.setdefault((lag, axis == 2, friction[axis]), over)
    return np.array(
        [kinds[lag, axis == 2, drag[i, axis]] for i, lag in enumerate(lags) for axis in range(3)]
    )
