"""The gains of a mission in words: how its feedback acts on an error."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rigidfleet.math import lqr, pid

if TYPE_CHECKING:
    from rigidfleet.mission import Mission, Regulator

_SOLVERS = {
    "iterated": "iterated Tikhonov: the force stays bounded if distances are redundant",
    "spectral": "spectral damping: the exact law unless distances are nearly redundant",
    "exact": "the paper's inverse, which does not exist if distances are redundant",
    "pinv": "the pseudo-inverse, which fades out components below its cut-off",
}


#: One property of the gains: its name, its value and its meaning.
GainLine = tuple[str, str, str]


def gain_lines(mission: Mission) -> list[GainLine]:
    """The gains of a mission, one by one."""
    lines = _constraint_lines(mission) if len(mission.edges) else []
    if any(phase.tracks_slots for phase in mission.phases):
        k1, k2 = mission.tracking_gains
        meaning = f"each vehicle follows its slot: {_behaviour_in_words(k1, k2)}"
        lines.append(("tracking", f"k₁ = {k1:.3g} /s², k₂ = {k2:.3g} /s", meaning))
    if any(phase.steering is not None for phase in mission.phases):
        lines.append(_regulator_line("centre of mass", mission.lqr))
        lines.append(_regulator_line("attitude", mission.lqr.attitude))
    return lines


def _constraint_lines(mission: Mission) -> list[GainLine]:
    """What the gains of the constraint law mean: name, value and words of each line."""
    c = mission.constraint
    lines = []
    if c.stabilisation == "none":
        lines.append(("constraint force", "no feedback", "distance errors remain and grow"))
    else:
        gain = f"α = {c.alpha:.4g} /s, β = {c.beta:.4g} /s, γ = {c.gamma:.4g} /s³"
        poles = ", ".join(_complex_text(s) for s in pid.poles(c.alpha, c.beta, c.gamma))
        lines += [
            ("constraint feedback", gain, "a distance error c obeys c‴ + 2α c″ + β² c′ + γ c = 0"),
            ("poles of the error", f"{poles} /s", "all have negative real parts: every error decays"),
        ]  # fmt: skip
        if c.gamma > 0:
            margin = 2 * c.alpha * c.beta**2 / c.gamma
            meaning = f"errors decay until γ reaches {margin:.3g} times its value (2αβ² > γ)"
            lines.append(("stability margin", f"{margin:.3g}", meaning))
        if (settled := c.settling_time) is not None:
            beyond = 100 * pid.overshoot(c.alpha, c.beta, c.gamma)
            why = "the integral must return to zero" if c.gamma > 0 else "there is no integral term"
            lines += [
                ("settling", f"{settled:.3g} s", "time until an error stays below 2 %"),
                ("overshoot", f"{beyond:.3g} %", f"an error passes zero by this share: {why}"),
            ]
    setting = {
        "iterated": f"μ = {_solver_damping_in_words(mission)}, {c.iterations} iterations",
        "spectral": f"s₀ = {c.threshold:g}",
        "exact": "",
        "pinv": f"cut-off at {c.cutoff:g} of the largest w",
    }[c.solver]
    value = f"{c.solver} ({setting})" if setting else c.solver
    lines.append(("solver", value, _SOLVERS[c.solver]))
    if any(not phase.tracks_slots for phase in mission.phases):
        rate = f"{c.deformation_damping:g} /s"
        meaning = "motions that change no distance decay at this rate while no slots are tracked"
        lines.append(("deformation damping", rate, meaning))
    return lines


def _solver_damping_in_words(mission: Mission) -> str:
    """Damping of the iterated solve; its range over all formations if it depends on them."""
    every = [mission.damping(name) for name in mission.formations] or [mission.damping(None)]
    low, high = f"{min(every):.2g}", f"{max(every):.2g}"
    return low if low == high else f"{low} to {high}"


def _regulator_line(name: str, regulator: Regulator) -> GainLine:
    if regulator.horizon == "infinite":
        k1, k2 = lqr.double_integrator_gains(regulator.Q, regulator.R)
        value = f"k₁ = {k1:.3g} /s², k₂ = {k2:.3g} /s"
        return (f"{name}, infinite horizon", value, _behaviour_in_words(k1, k2))
    q, r, s = (_weights_text(w) for w in (regulator.Q, (regulator.R,), regulator.S))
    meaning = "gains rise towards arrival, where S weighs errors of position and velocity"
    if not any(regulator.Q):
        meaning = (
            "least acceleration to arrive; S weighs errors of position and velocity at arrival"
        )
    return (f"{name}, finite horizon", f"Q = {q}, R = {r}, S = {s}", meaning)


def _behaviour_in_words(k1: float, k2: float) -> str:
    """Behaviour of x'' = -k1 x - k2 x' in words."""
    omega = math.sqrt(k1)
    zeta = k2 / (2 * omega)
    slowest = omega * (zeta - math.sqrt(zeta**2 - 1)) if zeta > 1 else omega * zeta
    return (
        f"an error oscillates at {omega:.3g} rad/s with damping ratio {zeta:.2f} "
        f"and falls to 2 % in about {4 / slowest:.2g} s"
    )


def _complex_text(s: complex) -> str:
    if abs(s.imag) < 1e-9 * abs(s):
        return f"{s.real:.3g}"
    return f"{s.real:.3g} {'+' if s.imag > 0 else '−'} {abs(s.imag):.3g}i"


def _weights_text(values: tuple[float, ...]) -> str:
    text = ", ".join(f"{v:g}" for v in values)
    return text if len(values) == 1 else f"diag({text})"
