"""Stability margins of a formation flown by vehicles with lag and delay: exact, for the linear loop.

About a formation at rest, let x be the agents' deviations from their slots, weighted by the root of the mass. The
constraint law commands M^-1 f_C = M^-1 J^T phi(mbar A) b with b = -J M^-1 (f_E + f_u) - (2 alpha s + beta^2 + gamma/s)
J r, and f_E + f_u = -M k_u r without gravity, which f_u cancels. With S = phi(mbar A) on the weighted Jacobian, whose
eigenvalues are the filter factors sigma = w phi(w), the command is therefore

    -K(s) x,   K = (1 - S) k_u + S k_c,   k_c = 2 alpha s + beta^2 + gamma/s :

the law takes the share sigma of the input away, and puts its own feedback in its place. Each vehicle follows with
its own lag, so that s^2 x = -G K x and the loop is L(s) = G K / s^2, with G diagonal. Horizontal and vertical lags
differ, and so may vehicles; L is then a matrix. It splits into the subspaces that S and G leave invariant. Lag and
delay are not approximated. Gain, phase and delay margins are those of a factor common to all loops: they are where the
eigenvalues of L(j omega), its characteristic loci, meet -1 (MacFarlane and Postlethwaite 1977,
doi:10.1080/00207177708922216).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigidfleet.math import pid
from rigidfleet.math.constraint_jacobian import filter_factors, jacobian
from rigidfleet.math.rigid_body import rigid_motions
from rigidfleet.typing import Bools, Floats, InputLaw, Ints

Complexes = NDArray[np.complexfloating]

#: Growth rate [1/s] from which a motion counts as unstable, unless another is asked for: slower ones need hours.
GROWTH = 1e-4
# Filter factors that differ by less than this share of themselves count as equal; below the second, as 0.
_ALIKE, _NO_SHARE = 1e-4, 1e-6
# Relative size of what counts as zero in a subspace, and of eigenvalues w that rounding makes.
_ROUNDING, _SINGULAR = 1e-8, 1e-12
# Frequencies [rad/s] that are looked at, and the number of first samples.
_FREQUENCIES, _SAMPLES = (1e-3, 1e5), 120
# Loci are followed while they are larger than this: gain margins above its inverse count as infinite.
_FAINT = 0.02
# Greatest change of log(locus) between samples.
_STEP = 0.4
# Accuracy of the logarithm of a frequency at which a locus crosses, and the greatest number of secants to it.
_CLOSE, _TRIES = 1e-12, 60
# Number of instants of an impulse response, and the time between them [s]: a minute.
_INSTANTS, _APART = 1 << 15, 2e-3
# Least and greatest rate p of a triple pole that is tried [1/s], ratio of successive trials, relative accuracy.
_POLES, _RATIO, _ACCURACY = (0.1, 400.0), 1.5, 5e-4


@dataclass(frozen=True)
class Lag:
    """What lies between a vehicle's commanded and its actual acceleration, linearised at hover.

    The attitude is controlled by torque / inertia = -k_R e_R - k_omega e_omega (Lee, Leok and McClamroch 2010,
    doi:10.1109/CDC.2010.5717652) through rotors with first-order lag tau. From commanded to actual acceleration,
    horizontal G = k_R / (tau s^3 + s^2 + k_omega s + k_R), vertical G = 1 / (tau s + 1).

    Attributes
    ----------
    k_R, k_omega : attitude gains [1/s^2, 1/s]; not of a point
    tau : time constant of the rotors [s]
    delay : age of the states that the law uses [s], transport and computation included
    rate : of the law [Hz]; its command is held in between (zero-order hold); infinite for a continuous law
    point : a point that delivers any acceleration at once; delay and rate apply to it, too
    """

    k_R: float = math.nan
    k_omega: float = math.nan
    tau: float = 0.0
    delay: float = 0.0
    rate: float = math.inf
    point: bool = False

    @property
    def stable(self) -> bool:
        """Whether the attitude loop is stable by itself: k_omega > tau k_R (Hurwitz)."""
        return self.point or self.k_omega > self.tau * self.k_R

    def response(self, s: Complexes, *, vertical: bool) -> Complexes:
        """Commanded to actual acceleration at s (K,), with delay and hold. The hold's sidebands are left out."""
        wait = np.exp(-s * self.delay)
        if self.rate < math.inf:
            x = s / self.rate
            wait = wait * -np.expm1(-x) / x
        if self.point:
            return wait
        if vertical:
            return wait / (self.tau * s + 1)
        return wait * self.k_R / (((self.tau * s + 1) * s + self.k_omega) * s + self.k_R)


@dataclass(frozen=True)
class LoopGains:
    """Gains of the laws, as in a mission.

    Attributes
    ----------
    alpha, beta, gamma : of the constraint law [1/s, 1/s, 1/s^3]; zeros for none
    k1, k2, ki : of tracking, or of the virtual body [1/s^2, 1/s, 1/s^3]
    control : "tracking" of slots, regulation of the virtual "body" (rigid allocation), or "open"
    k_def : deformation damping where no slots are tracked [1/s]
    solver, damping, iterations, threshold, cutoff : see `filter_factors`
    """

    alpha: float = 3.0
    beta: float = 12.0**0.5
    gamma: float = 8.0
    k1: float = 2.0
    k2: float = 8.0**0.5
    ki: float = 0.0
    control: InputLaw = "tracking"
    k_def: float = 1.0
    solver: str = "iterated"
    damping: float = 0.03
    iterations: int = 3
    threshold: float = 0.1
    cutoff: float = 1e-3

    def with_triple_pole(self, p: float) -> LoopGains:
        """With all three poles of the constraint law at -p [1/s]."""
        alpha, beta, gamma = pid.triple_pole(p)
        return replace(self, alpha=alpha, beta=beta, gamma=gamma)


def tracking_lag_time(lag: Lag, laws: LoopGains, drag: float) -> float:
    """Time T [s] by which a vehicle that tracks leaves its reference at most, in any direction, under either law.

    The reference's acceleration, jerk and snap are fed forward past the attitude control, so that only rotors and the
    hold lag behind it: G_r is their response, G that of the feedback K, and d the ``drag`` per mass [1/s] that is not
    fed forward. The error of the acceleration is then that of the filter

        H(s) = ((1 - G_r) s + d) / (s^2 + d s + G K)

    on the reference's jerk, and the error of the velocity the same of its acceleration. Neither exceeds T = int |h| dt
    times the greatest value of its input, whatever the reference (linear, near hover).
    """
    s = (2j * np.pi * np.fft.rfftfreq(_INSTANTS, _APART)).astype(np.complex128)
    s[0] = 1e-6j
    track = laws.k1 + laws.k2 * s + laws.ki / s
    constrain = 2.0 * laws.alpha * s + laws.beta**2 + laws.gamma / s
    most, window = 0.0, np.cos(np.linspace(0.0, 0.5 * np.pi, len(s))) ** 2  # against ripples
    for vertical in (False, True):
        G = lag.response(s, vertical=vertical)
        ahead = replace(lag, delay=0.0).response(s, vertical=vertical)
        ahead *= 1.0 if vertical else 1.0 + s * (s + lag.k_omega) / lag.k_R
        for K in (track, constrain):
            H = ((1.0 - ahead) * s + drag) / (s * (s + drag) + G * K)
            most = max(most, float(np.abs(np.fft.irfft(window * H, _INSTANTS)).sum()))
    return most


class Loop(NamedTuple):
    """A part of the loop that no other part acts on, in an orthonormal basis of n directions.

    ``S`` (n, n) is the share of the constraint law, and ``Q`` (n, n) the projection on rigid motions. ``P`` (g, n, n)
    are the directions of each of the ``channels``: a lag, and whether it is the vertical one.
    """

    S: Floats
    Q: Floats
    P: Floats
    channels: tuple[tuple[Lag, bool], ...]

    @property
    def has_constraint_law(self) -> bool:
        """Whether the constraint law has a share in it."""
        return bool(np.abs(self.S).max() > _NO_SHARE)

    def gain(self, s: Complexes, law: LoopGains) -> Complexes:
        """L (K, n, n) at s (K,)."""
        k_u, to_k_c, to_rigid = _controller_terms(s, law)[..., None, None]
        K = k_u * np.eye(len(self.S)) + to_k_c * self.S + to_rigid * self.Q
        G = [lag.response(s, vertical=vertical) / (s * s) for lag, vertical in self.channels]
        if len(G) == 1:
            return G[0][:, None, None] * K
        # A sum without BLAS: for few channels, that mostly wakes its threads.
        return np.einsum("gk,gij->kij", G, self.P) @ K


def _controller_terms(s: Complexes, law: LoopGains) -> Complexes:
    """k_u, and what is added to it on S and on rigid motions Q (3, K): K = k_u 1 + ... S + ... Q, because S Q = 0."""
    k_c = 2 * law.alpha * s + law.beta**2 + law.gamma / s
    k_t, k_d = law.k1 + law.k2 * s + law.ki / s, law.k_def * s
    if law.control == "tracking":
        return np.stack([k_t, k_c - k_t, 0 * s])
    return np.stack([k_d, k_c - k_d, (k_t if law.control == "body" else 0 * s) - k_d])


@dataclass(frozen=True)
class Margins:
    """Margins of a loop: the smallest of its parts. NaN where the loop is unstable.

    Attributes
    ----------
    stable : whether every motion that is fed back decays, or at least does not grow
    gain : factors on all gains between which it stays stable; 0 and infinity for no bound
    phase : phase margin [rad]; pi if no locus has unit gain
    delay : further delay until it is unstable [s]; infinite for no bound
    """

    stable: bool
    gain: tuple[float, float] = (math.nan, math.nan)
    phase: float = math.nan
    delay: float = math.nan

    def smaller_margins(self, other: Margins) -> Margins:
        """The smaller margins of both: those of their loops together."""
        if not (self.stable and other.stable):
            return Margins(stable=False)
        gain = max(self.gain[0], other.gain[0]), min(self.gain[1], other.gain[1])
        return Margins(True, gain, min(self.phase, other.phase), min(self.delay, other.delay))

    def data(self) -> dict[str, Any]:
        """Plain data: the phase in degrees."""
        phase = math.degrees(self.phase)
        return {"stable": self.stable, "gain": self.gain, "phase_deg": phase, "delay_s": self.delay}


def distinct_formation_loops(
    positions: ArrayLike,
    edges: ArrayLike,
    masses: ArrayLike,
    law: LoopGains,
    lags: Sequence[Lag],
) -> list[Loop]:
    """The distinct parts of a formation's loop at rest, for `stability_margins`, `is_stable` and `largest_stable_pole`.

    Gains of the law may change afterwards; the solver, its options, and the control may not.

    Parameters
    ----------
    positions : (N, 3) [m], z upwards
    edges : (m, 2) agents from 0
    masses : (N,) [kg]
    lags : of each agent
    """
    r, m = np.asarray(positions, dtype=np.float64), np.asarray(masses, dtype=np.float64)
    S = constraint_filter_matrix(r, np.asarray(edges, dtype=np.int64).reshape(-1, 2), m, law)
    rigid = rigid_motions(r, m)
    Q = rigid @ rigid.T
    kinds = [(lag, axis == 2 and not lag.point) for lag in lags for axis in range(3)]
    channels = tuple(dict.fromkeys(kinds))
    P = np.stack([np.diag([float(kind == channel) for kind in kinds]) for channel in channels])
    parts = [S, Q, *P]
    if law.control == "open":
        # Nothing feeds rigid motions back, and deformations do not depend on them.
        basis = np.linalg.svd(Q)[0][:, rigid.shape[1] :]
        parts = [basis.T @ part @ basis for part in parts]
    loops = []
    acting = [k for k in range(len(parts)) if k != 1 or law.control != "tracking"]
    for V in _invariant_subspaces([parts[k] for k in acting]):
        S2, Q2, *rest = (V.T @ part @ V for part in parts)
        P2 = np.stack(rest)
        present = np.abs(P2).max(axis=(1, 2)) > _ROUNDING
        there = tuple(c for c, is_there in zip(channels, present, strict=True) if is_there)
        loops.append(Loop(S2, Q2, P2[present], there))
    return loops


def tracking_loops(lags: Sequence[Lag]) -> list[Loop]:
    """The distinct loops by which single vehicles track their slots: each lag, horizontal and vertical."""
    zero, one = np.zeros((1, 1)), np.ones((1, 1, 1))
    kinds = dict.fromkeys((lag, up and not lag.point) for lag in lags for up in (False, True))
    return [Loop(zero, zero, one, (kind,)) for kind in kinds]


def constraint_filter_matrix(r: Floats, edges: Ints, m: Floats, law: LoopGains) -> Floats:
    """S (3N, 3N): the law's share of the input, with nearly equal filter factors made equal."""
    if not len(edges):
        return np.zeros((r.size, r.size))
    J = jacobian(r, edges) * np.repeat(np.sqrt(m.mean() / m), 3)
    w, V = np.linalg.eigh(J.T @ J)
    w[w < _SINGULAR * w[-1]] = 0.0
    options = {
        name: getattr(law, name) for name in ("damping", "iterations", "threshold", "cutoff")
    }
    sigma = filter_factors(w, law.solver, **options)
    sigma[sigma < _NO_SHARE] = 0.0
    some = sigma > 0
    sigma[some] = np.exp(np.round(np.log(sigma[some]) / _ALIKE) * _ALIKE)
    return (V * sigma) @ V.T


def _invariant_subspaces(matrices: list[Floats]) -> list[Floats]:
    """Orthonormal bases (n, k) of subspaces that symmetric matrices (n, n) leave invariant; of alike ones, one.

    An eigenvector of a random combination lies in a single irreducible subspace but for accidents, which only
    join subspaces; the matrices, applied to it again and again, span that subspace (Murota et al. 2010,
    doi:10.1007/s13160-010-0006-9).
    """
    random = np.random.default_rng(0).uniform(1.0, 2.0, len(matrices))
    w, V = np.linalg.eigh(sum(c * A for c, A in zip(random, matrices, strict=True)))
    turned = np.stack([V.T @ A @ V for A in matrices])
    turned[np.abs(turned) < _ROUNDING] = 0.0
    bases: dict[tuple[float, ...], Floats] = {}
    for own in _connected_components(turned.any(axis=0) | np.eye(len(w), dtype=np.bool_)):
        done = np.zeros((len(own), 0))
        for v in np.eye(len(own)):
            rest = v - done @ (done.T @ v)
            size = np.linalg.norm(rest)
            if size < 1e-3:
                continue
            U = (rest / size)[:, None]
            at = 0
            while at < U.shape[1]:
                for A in turned[:, own[:, None], own]:
                    y = A @ U[:, at]
                    for _ in range(2):  # once leaves rounding errors of the others' size
                        y = y - U @ (U.T @ y) - done @ (done.T @ y)
                    if (size := np.linalg.norm(y)) > _ROUNDING:
                        U = np.column_stack([U, y / size])
                at += 1
            done = np.column_stack([done, U])
            bases.setdefault(
                tuple(np.round(np.linalg.eigvalsh((U.T * w[own]) @ U), 6)), V[:, own] @ U
            )
    return list(bases.values())


def _connected_components(joined: Bools) -> list[Ints]:
    """Sets of what is joined (n, n), each also with itself, directly or through others."""
    first = np.arange(len(joined))
    while ((least := np.where(joined, first, len(joined)).min(axis=1)) < first).any():
        first = least
    return [np.flatnonzero(first == k) for k in np.unique(first)]


def is_stable(loops: Sequence[Loop], law: LoopGains, growth: float = GROWTH) -> bool:
    """Whether no motion grows at a rate of ``growth`` [1/s] > 0 or more: Nyquist's criterion on det(1 + L)."""
    # Small parts first: most are small, and what is done with each takes longer.
    return all(_is_stable(loop, law, growth) for loop in sorted(loops, key=lambda x: len(x.S)))


def _is_stable(loop: Loop, law: LoopGains, growth_limit: float) -> bool:
    """`is_stable` of one loop; never where a vehicle's attitude itself is unstable."""
    if not all(lag.stable for lag, _ in loop.channels):
        return False
    n = len(loop.S)
    # From F to F (1 + X), det F turns by sum arg(1 + eig X) < pi if the norm of X is below this.
    near = min(0.7, 2.5 / math.sqrt(n))
    end = _top_frequency(loop, law, min(0.7, 2.5 / n))  # from here on, det F turns by less than pi
    if end == 0.0:
        return True

    def return_difference(omega: Floats) -> Complexes:
        return np.eye(n) + loop.gain(growth_limit + 1j * omega, law)

    # The poles of L at 0 are left of this line. To its right L is analytic and vanishes at infinity.
    omega = np.append(0.0, np.geomspace(0.1 * growth_limit, end, _SAMPLES))
    F = return_difference(omega)
    for _ in range(30):
        turn = np.linalg.solve(F[:-1], F[1:])
        turns = np.linalg.norm(turn - np.eye(n), axis=(-2, -1))
        far = np.flatnonzero(turns > near)
        if not len(far):
            break
        middle = 0.5 * (omega[far] + omega[far + 1])
        omega = np.insert(omega, far + 1, middle)
        F = np.insert(F, far + 1, return_difference(middle), axis=0)
    else:
        return False  # det(1 + L) = 0 on the line itself
    turned = np.angle(np.linalg.slogdet(turn)[0]).sum()
    rest = np.angle(np.linalg.slogdet(F[-1])[0])
    return bool(np.round((rest - turned) / math.pi) == 0.0)


def _top_frequency(loop: Loop, law: LoopGains, size: float) -> float:
    """Frequency [rad/s] from which on the norm of L is below ``size``, by an upper bound; 0 if it is nowhere above."""
    omega = np.geomspace(*_FREQUENCIES, 600)
    s = 1j * omega
    each = np.abs([lag.response(s, vertical=vertical) for lag, vertical in loop.channels])
    k_u, to_k_c, to_rigid = np.abs(_controller_terms(s, law))
    K = k_u + to_k_c + to_rigid  # the norms of S and Q are at most 1
    above = np.flatnonzero(each.max(axis=0) * K > size * omega**2)
    return float(omega[min(above[-1] + 1, len(omega) - 1)]) if len(above) else 0.0


def _eigenvalues(A: Complexes) -> Complexes:
    return A[..., 0] if A.shape[-1] == 1 else np.linalg.eigvals(A)


def stability_margins(loops: Sequence[Loop], law: LoopGains, growth: float = GROWTH) -> Margins:
    """Gain, phase and delay margin common to all loops: the smallest of them; ``growth`` as in `is_stable`."""
    if not is_stable(loops, law, growth):
        return Margins(stable=False)
    low, high, phase, delay = 0.0, math.inf, math.pi, math.inf
    for loop in loops:
        omega, loci, on_axis = _crossovers_loci_and_are_real(loop, law)
        gain = 1.0 / np.abs(loci[on_axis])
        high = min(high, gain[gain > 1].min(initial=math.inf))
        low = max(low, gain[gain <= 1].max(initial=0.0))
        angle = np.angle(-loci[~on_axis])
        phase = min(phase, np.abs(angle).min(initial=math.pi))
        delay = min(delay, (angle % (2 * math.pi) / omega[~on_axis]).min(initial=math.inf))
    return Margins(True, (float(low), float(high)), float(phase), float(delay))


def _crossovers_loci_and_are_real(loop: Loop, law: LoopGains) -> tuple[Floats, Complexes, Bools]:
    """Frequencies (M,) [rad/s] where a locus is negative real or has unit gain; the loci there; which are real."""
    omega, loci = _frequencies_and_log_loci(loop, law)
    # Numbers of log(locus) that are whole where a locus is negative real, and that change sign at unit gain.
    numbers = np.stack([(loci.imag - math.pi) / (2 * math.pi), loci.real * 1e-3])
    whole = np.floor(numbers)
    kind, k, c = np.nonzero(whole[:, :-1] != whole[:, 1:])
    target = np.maximum(whole[kind, k, c], whole[kind, k + 1, c])
    chord, off = loci[[k, k + 1], c], numbers[kind, [k, k + 1], c] - target
    x = begin, end = np.log(omega[[k, k + 1]])
    z = chord[1]
    for _ in range(_TRIES):  # all at once by secants, between ends of different signs ("Illinois")
        slope = off[1] - off[0]
        new = x[1] - off[1] * (x[1] - x[0]) / np.where(slope == 0.0, 1.0, slope)
        share = (new - begin) / (end - begin)
        guess = (1 - share) * chord[0] + share * chord[1]
        values = np.log(_eigenvalues(loop.gain(1j * np.exp(new), law)) / np.exp(guess)[:, None])
        z = values[np.arange(len(k)), np.abs(values).argmin(axis=1)] + guess
        number = np.where(kind == 0, (z.imag - math.pi) / (2 * math.pi), z.real * 1e-3) - target
        moved, same = np.abs(new - x[1]), number * off[1] > 0
        x = np.where(same, x[0], x[1]), new
        off = np.where(same, 0.5 * off[0], off[1]), number
        if (moved <= _CLOSE).all():
            break
    return np.exp(x[1]), np.exp(z), kind == 0


def _frequencies_and_log_loci(loop: Loop, law: LoopGains) -> tuple[Floats, Complexes]:
    """Frequencies (K,) [rad/s], and the logarithms (K, n) of the loci there, each continuous."""
    end = _top_frequency(loop, law, _FAINT)
    if end <= _FREQUENCIES[0]:
        return np.zeros(0), np.zeros((0, len(loop.S)), np.complex128)
    omega = np.geomspace(_FREQUENCIES[0], end, _SAMPLES)
    values = _eigenvalues(loop.gain(1j * omega, law))
    # At most twelve times, each finer than the one before.
    for left in range(12, -1, -1):
        loci = _continuous_logarithms(np.log(np.where(values == 0, 1e-300, values)))
        step = np.abs(np.diff(loci, axis=0))
        # Where loci are fainter than the threshold, they turn as they please.
        step[np.maximum(loci[1:].real, loci[:-1].real) < math.log(_FAINT)] = 0.0
        coarse = np.flatnonzero(step.max(axis=1) > _STEP)
        if not (left and len(coarse)):
            break
        middle = np.sqrt(omega[coarse] * omega[coarse + 1])
        omega = np.insert(omega, coarse + 1, middle)
        values = np.insert(values, coarse + 1, _eigenvalues(loop.gain(1j * middle, law)), axis=0)
    return omega, loci


def _continuous_logarithms(loci: Complexes) -> Complexes:
    """Logarithms (K, n), reordered and unwrapped so that each column is continuous."""
    if loci.shape[1] > 1:
        for k in range(1, len(loci)):
            gap = loci[k][None, :] - loci[k - 1][:, None]
            turned = (gap.imag + math.pi) % (2 * math.pi) - math.pi
            order: list[int] = []
            # Each goes on with the nearest that is left.
            for distance in np.hypot(gap.real, turned):
                distance[order] = math.inf
                order.append(int(distance.argmin()))
            loci[k] = loci[k][order]
    return loci.real + 1j * np.unwrap(loci.imag, axis=0)


def largest_stable_pole(
    loops: Sequence[Loop], law: LoopGains, most: float = math.inf, growth: float = GROWTH
) -> float:
    """Rate p [1/s] up to which a triple pole -p of the constraint law keeps the loops stable; infinite if all do.

    At most ``most``: of several formations, pass the least so far. 0 if even slow poles are unstable. Rates are tried
    from slow ones upwards, each half as fast again, so that a narrow unstable range between two may be overlooked.
    """

    def stable(p: float) -> bool:
        return is_stable(loops, law.with_triple_pole(p), growth)

    if most < math.inf and all(stable(most * part) for part in (1.0, 0.5, 0.25)):
        return most
    low, high = 0.0, _POLES[0]
    while stable(high):
        low, high = high, high * _RATIO
        if high > _POLES[1]:
            return most
    while high - low > _ACCURACY * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
        if high < _ACCURACY * _POLES[0]:
            return 0.0
    return min(low, most)
