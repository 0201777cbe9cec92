"""Along the plan by another clock: back, or slower until all rest. The path is the plan's, only its time is not."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet.kernel.problem import septic_polynomial
from rigidfleet.math.piecewise import Piecewise, refine_knots
from rigidfleet.planning.certificate import PROOF_SLACK, certificate_of
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.legs import Leg
from rigidfleet.planning.limits import Limit
from rigidfleet.planning.steps import (
    APART_FOR_EVER,
    BRAKING,
    JERK,
    KEPT,
    LOOKS,
    USED,
    Step,
    Steps,
    shortest_time,
)
from rigidfleet.typing import Floats

#: Time between knots of the plan as polynomials of degree 7 [s], which differ from it by micrometres; knots that are
#: nearer count as one.
_KNOTS, _NEAR = 0.2, 0.01
#: Shortest rest of a plan [s].
_LEAST = 0.01
#: Progress along the path, of the time of slowing down, by the share of that time: the rate falls from 1 to 0 as
#: 1 - 10 x^3 + 15 x^4 - 6 x^5, so that acceleration and jerk stay continuous; and of a flight that goes on.
_SLOWING = np.array([0.0, 1.0, 0.0, 0.0, -2.5, 3.0, -1.0])
ON = np.array([0.0, 1.0])
#: From rest to rest, by that share.
REST_TO_REST = septic_polynomial(np.polynomial.Polynomial(ON)).coef
#: Greatest change of the rate and of that, over powers of the time of slowing down.
_STEEPEST, _BENT = 1.875, 5.774


def plan_path(legs: Sequence[Leg]) -> Piecewise:
    """The paths of all vehicles over mission time, pieces (K, N, 3, 8); beyond the end they go on uniformly."""
    times, pieces = [np.zeros(1)], []
    for leg in (x for x in legs if x.end > x.start):
        reference, motion = leg.slots_and_motion
        steps = 2 + math.ceil((leg.end - leg.start) / _KNOTS)
        time = np.linspace(leg.start, leg.end, steps)
        own = np.unique([reference.t0 + reference.T_b, *reference.knots, *motion.knots])
        if len(own) < 4 * steps:  # where the plan's own polynomials change
            time = refine_knots(time, own, _NEAR)
        states = slot_derivatives(reference, motion, time, 4).swapaxes(0, 1)
        times.append(time[1:])
        pieces.append(Piecewise.hermite(time, states).pieces)
    on = np.zeros_like(pieces[-1][:1])
    on[0, ..., :2] = np.moveaxis(Piecewise(time, pieces[-1]).states(time[-1:], 2)[:, 0], 0, -1)
    return Piecewise(np.concatenate([*times, time[-1:] + 1.0]), np.concatenate([*pieces, on]))


def path_clock(begin: float, time: float, progress: Floats) -> Piecewise:
    """The time along a path, from a beginning on, for a time [s]: it goes on by a polynomial (P,) of its share."""
    piece = progress * time ** (1.0 - np.arange(float(len(progress))))
    piece[0] = begin
    return Piecewise(np.array([0.0, time]), piece[None])


def _states_by_clock(x: Floats, rates: Floats) -> Floats:
    """Position and three derivatives (4, K, N, 3) by the time, along a path and its clock (3, K)."""
    first, second, third = rates[:, :, None, None]  # and the chain rule
    jerk = x[3] * first**3 + 3.0 * x[2] * first * second + x[1] * third
    return np.stack([x[0], x[1] * first, x[2] * first**2 + x[1] * second, jerk])


class PlanSteps:
    """Steps along a plan by a clock, with the plan as paths of all vehicles, by default that of its legs."""

    def __init__(self, steps: Steps, legs: Sequence[Leg], plan: Piecewise | None = None) -> None:
        self.steps, self.legs = steps, legs
        self.plan = plan_path(legs) if plan is None else plan
        #: When the plan ends [s], and whether on the ground.
        self.end, self.lands = legs[-1].end, legs[-1].phase.lands

    def leg_number_at(self, time: float) -> int:
        """Number of the leg at a time [s]; at a switch, of the one before."""
        ends = [x.end for x in self.legs]
        return min(int(np.searchsorted(ends, time)), len(ends) - 1)

    def _ways_by_clock(self, clock: Piecewise) -> Piecewise:
        """The ways of all vehicles along the plan by a clock, either way."""
        duration, plan = float(clock.time[-1]), self.plan
        time = np.linspace(0.0, duration, 2 + math.ceil(duration / _KNOTS))
        begin, end = clock.at(time[[0, -1]]).tolist()
        turn = slice(None, None, 1 if begin <= end else -1)
        first, last = (begin, end)[turn]
        inside = plan.time[(plan.time > first) & (plan.time < last)]
        fine = np.linspace(0.0, duration, 50 * len(time))
        time = refine_knots(time, np.interp(inside, clock.at(fine)[turn], fine[turn]), _NEAR)
        s = clock.states(time, 4)
        ends = tuple(x[:, turn] for x in plan.with_knots(s[0, turn]).piece_end_states(4))[turn]
        rates = s[1:, :-1], s[1:, 1:]
        return Piecewise.of_end_states(time, *map(_states_by_clock, ends, rates))

    def step_by_clock(self, name: str, clock: Piecewise) -> Step:
        """A step along the plan by a clock, either way: its least separation is that which the legs it meets prove."""
        begin, end = clock.at(clock.time[[0, -1]]).tolist()
        first, last = sorted((begin, end))
        make, least = partial(self._ways_by_clock, clock), APART_FOR_EVER
        for leg in self.legs[self.leg_number_at(first) : self.leg_number_at(last) + 1]:
            proved = leg.certificate
            if self.steps.lost.any():
                proved = certificate_of(leg.phase, leg.reference, leg.radius, self.steps.lost)
            if proved is None and len(self.steps.left) > 1:  # no slots are tracked there
                proved = self.steps.prove_ways(make(), self.steps.left)
            least = min(least, proved or least)
        # Its polynomials differ from the plan's ways by less than `PROOF_SLACK`.
        return self.steps.step(name, make, least._replace(time=0.0), PROOF_SLACK, path=end)

    def slow_down_step_and_problem(self, begins: float) -> tuple[Step, str]:
        """Slow down along the plan from a time on [s], in the least time that keeps the limits, or fly to its landing.

        Where the plan itself is beyond a limit, that counts as the limit.

        Returns
        -------
        step : of it
        problem : what breaks a limit, or leads two vehicles too near; "" if nothing does
        """
        v = self.plan.states(np.array([begins]), 2)[1, 0, self.steps.left]
        speed = float(np.linalg.norm(v, axis=1).max())
        first = max(_STEEPEST * speed / BRAKING, math.sqrt(_BENT * speed / JERK))
        time, over = self.least_time_and_ratios(
            first, self.steps.limits, lambda time: path_clock(begins, time, _SLOWING)
        )
        if begins + 0.5 * time >= self.end and self.lands:
            # What goes on beyond the end goes on down.
            clock = path_clock(begins, max(self.end - begins, _LEAST), ON)
            return self.step_by_clock("to its end", clock), ""
        problem, step = "", self.step_by_clock("slow down", path_clock(begins, time, _SLOWING))
        if over.max(initial=0.0) > KEPT:
            q = self.steps.limits[int(over.argmax())].of
            problem = f"slowing down would break the limit of {q.name_in_words}"
        elif step.least.separation < max(self.steps.need, 1e-6):
            who, least = agent_names(step.least.agents), step.least.separation
            problem = f"the plan itself leads {who} within {max(least, 0.0):.2f} m of each other"
        return step, problem

    def least_time_and_ratios(
        self, first: float, limits: list[Limit], clock: Callable[[float], Piecewise]
    ) -> tuple[float, Floats]:
        """`shortest_time` of a step along the plan by a clock of a time; where the plan exceeds a limit, it counts."""
        share = np.linspace(0.0, 1.0, LOOKS)

        def limit_ratios(time: float) -> Floats:
            at, *rates = clock(time).states(time * share, 4)
            states = self.plan.states(at, 4)
            allowed = np.maximum(self.steps.limit_shares(limits, states), USED)
            return (
                self.steps.limit_shares(limits, _states_by_clock(states, np.array(rates))) / allowed
            )

        return shortest_time(first, limit_ratios)
