"""Second-order rigidity: whether a self-stress blocks the flexes, or a flex extends to a finite motion.

Connelly and Whiteley, "Second-order rigidity and prestress stability in tensegrity frameworks" (1996): a
self-stress (forces f_k along the edges, in balance at each agent) with densities omega_k = f_k / L_k gives
a flex q the energy

    E(q) = sum_k omega_k |q_i - q_j|^2,

quadratic in the flex. If some stress has E > 0 for every flex, the framework is rigid (prestress-stable). If
E(q) = 0 for every stress, q extends to second order.
"""

from __future__ import annotations

import numpy as np

from rigidfleet.rigidity.framework import Framework, few_agent_flexes
from rigidfleet.typing import Bools, Floats, Ints

#: A stress blocks all flexes if its least energy exceeds this share of its greatest energy.
_DEFINITE = 1e-7

#: Lengths that differ by less than this share of the shape's size count as equal.
_EQUAL = 1e-12

#: A flex is finite if it moves an agent this far, as a share of the shape's size; a walk along it ends at _FAR.
#: A framework rigid at order n would be off by about the n-th power of it, which is far more than _EQUAL.
_FINITE, _FAR = 0.01, 0.1

#: Number of flexes that move few agents, and of random ones, near which finite ones are sought.
_STARTS = 8

#: Stride of a walk from one shape to another, as a share of the size for each agent, and the greatest number of them:
#: few to the nearest shape of a family, and then enough to go round a closed curve.
_STRIDE, STRIDES = 0.1, (20, 300)


class StressEnergy:
    """The energies of all self-stresses on flexes of a framework.

    `flexes` (N d, k) are orthonormal; by default all flexes.
    """

    def __init__(self, frame: Framework, flexes: Floats | None = None) -> None:
        n, d = frame.p.shape
        self.frame, self.n = frame, n
        self.flexes = frame.flexes if flexes is None else flexes
        self.k = self.flexes.shape[1]
        self._F = np.ascontiguousarray(self.flexes.reshape(n, d, -1).transpose(1, 0, 2))
        self._i, self._j = frame.edges.T
        self._length = frame.lengths / frame.lengths.mean()

    def nearest_stress(self, z: Floats) -> Floats:
        """Nearest self-stress to forces z (m,)."""
        return z - self.frame.span @ (self.frame.span.T @ z)

    def energy_matrix(self, force: Floats) -> Floats:
        """Matrix E (k, k) of a self-stress (m,): energy q^T E q of the flex with coordinates q."""
        omega = np.zeros((self.n, self.n))
        np.add.at(omega, (self._i, self._j), -force / self._length)
        omega += omega.T
        np.fill_diagonal(omega, -omega.sum(axis=1))
        return (self._F.transpose(0, 2, 1) @ (omega @ self._F)).sum(axis=0)

    def adjoint_stress(self, Y: Floats) -> Floats:
        """The self-stress (m,) whose inner product with any stress is <Y, E> of that stress."""
        G = (self._F @ Y @ self._F.transpose(0, 2, 1)).sum(axis=0)
        diagonal = np.diag(G)
        reach = diagonal[self._i] + diagonal[self._j] - 2 * G[self._i, self._j]
        return self.nearest_stress(reach / self._length)

    def second_order_residual(self, q: Floats) -> Floats:
        """Residual (m,) that stops a flex with coordinates q at second order; 0 if nothing stops it."""
        return self.adjoint_stress(np.outer(q, q))

    def second_order_residual_rate(self, q: Floats) -> Floats:
        """Derivative (m, k) of `second_order_residual`."""
        step = self._F[:, self._i] - self._F[:, self._j]
        rate = 2 * np.einsum("qm,qmk->mk", step @ q, step) / self._length[:, None]
        return rate - self.frame.span @ (self.frame.span.T @ rate)


def blocking_stress(energy: StressEnergy) -> tuple[Floats | None, Floats, bool]:
    """A self-stress with positive energy on every flex, or the flexes that may extend.

    With one independent stress, its eigenvalues decide. With more, minimise the convex function
    1/2 |(1 - E)_+|^2 over the stresses: its infimum is 0 if a blocking stress exists, and at least 1/2 if
    there is none, because then some Y >= 0 is orthogonal to all E, and |(1 - E)_+| |Y| >= <1 - E, Y> = tr Y >= |Y|.
    At the minimum, (1 - E)_+ is itself such a Y, and flexes are searched in its range.

    Returns
    -------
    stress : (m,), scaled to a largest force of 1 N, or None
    flexes : (k, .) orthonormal coordinates of the flexes that the stresses found do not block
    proven : whether it is certain that no stress blocks all
    """
    frame = energy.frame
    if frame.stress_dimension == 0:
        return None, np.eye(energy.k), True
    if frame.stress_dimension > 1:
        return _blocking_stress_or_proof(energy)
    z = np.zeros(len(frame.edges))
    z[(frame.span**2).sum(axis=1).argmin()] = 1
    force = energy.nearest_stress(z)
    force /= np.abs(force).max()
    value, vector = np.linalg.eigh(energy.energy_matrix(force))
    if value.sum() < 0:
        force, value, vector = -force, -value[::-1], vector[:, ::-1]
    small = _DEFINITE * max(value[-1], 1.0)
    if value[0] > small:
        return force, vector[:, :0], False
    return None, vector[:, value < small] if value[0] > -small else vector, True


def _blocking_stress_or_proof(energy: StressEnergy) -> tuple[Floats | None, Floats, bool]:
    """What `blocking_stress` returns of several independent stresses; the search ends once a stress is definite."""
    from scipy.optimize import minimize

    unit = np.eye(energy.k)
    blocking: list[Floats] = []

    def shortfall_and_gradient(z: Floats) -> tuple[float, Floats]:
        force = energy.nearest_stress(z)
        value, vector = np.linalg.eigh(unit - energy.energy_matrix(force))
        if value[-1] < 0.9 and 1 - value[-1] > _DEFINITE * (1 - value[0]):
            blocking.append(force)
            raise StopIteration
        Y = (vector * np.maximum(value, 0)) @ vector.T
        return 0.5 * float((Y**2).sum()), -energy.adjoint_stress(Y)

    start = energy.adjoint_stress(unit)
    size = float(start @ start)
    if size > 1e-18:
        start *= energy.k / size  # then the trace of E is that of 1
    options = {"maxiter": 300, "maxfun": 300, "ftol": 1e-14, "gtol": 1e-9}
    try:
        best = minimize(shortfall_and_gradient, start, jac=True, method="L-BFGS-B", options=options)
    except StopIteration:
        return blocking[-1] / np.abs(blocking[-1]).max(), unit[:, :0], False
    value, vector = np.linalg.eigh(unit - energy.energy_matrix(energy.nearest_stress(best.x)))
    Y = (vector * np.maximum(value, 0)) @ vector.T
    proven = bool(np.linalg.norm(energy.adjoint_stress(Y)) < 1e-4 * np.linalg.norm(Y))
    return None, vector[:, value > 1e-3], proven


def flexed_points_and_second_order(energy: StressEnergy) -> tuple[Floats | None, bool]:
    """The framework (N, d) deformed by a finite motion that keeps all lengths; None if none is found.

    Flexes that extend to second order are searched near those that move few agents and near random ones. Each is
    followed from the framework until the shape has changed visibly, with lengths equal to 1e-12.
    Also returns whether a flex was found that extends to second order.
    """
    frame = energy.frame
    if energy.k == 0:
        return None, False  # a stress nearly blocks every flex
    few = few_agent_flexes(energy.flexes, frame.rigid_basis, energy.n, _STARTS)
    candidates = [energy.flexes.T @ motion.ravel() for motion in few]
    candidates += list(np.random.default_rng(0).normal(size=(_STARTS, energy.k)))
    goes_on = False
    for q in candidates:
        flex = _extendable_flex_near(energy, q)
        if flex is None:
            continue
        goes_on = True
        for way in (flex, -flex):
            bent = _follow_flex(frame, (energy.flexes @ way).reshape(frame.p.shape))
            if bent is not None:
                return bent, True
    return None, goes_on


def _extendable_flex_near(energy: StressEnergy, q: Floats) -> Floats | None:
    """A flex (k,) near q that extends to second order, by Gauss-Newton on the unit sphere."""
    q = q / max(np.linalg.norm(q), 1e-9)
    for _ in range(40):
        rest = energy.second_order_residual(q)
        if np.linalg.norm(rest) < 1e-11:
            break
        rate = energy.second_order_residual_rate(q)
        rate -= np.outer(rate @ q, q)
        damping = 0.3 * np.linalg.norm(rest) * np.eye(energy.k)
        q = q - np.linalg.solve(rate.T @ rate + damping, rate.T @ rest)
        q = q / np.linalg.norm(q)
    return q if np.linalg.norm(energy.second_order_residual(q)) < 1e-6 else None


def _follow_flex(frame: Framework, direction: Floats) -> Floats | None:
    """The farthest point of a walk along the curve of equal lengths, from the framework in a direction."""
    p = frame.p
    size = np.linalg.norm(p - p.mean(axis=0), axis=1).max()
    step = 2e-3 * size
    direction = direction / np.linalg.norm(direction)
    here, best, most = p, p, 0.0
    for _ in range(80):
        there = restore_lengths(here + step * direction, frame.edges, frame.lengths, _EQUAL * size)
        moved = np.zeros_like(p) if there is None else align_points(there, here) - here
        if not 0.5 * step < np.linalg.norm(moved) < 2 * step:
            if here is p or step < 1e-3 * size:
                break
            step /= 3
            continue
        here, direction = here + moved, moved / np.linalg.norm(moved)
        step = min(1.5 * step, 0.05 * size * np.sqrt(len(p)))
        gone = np.linalg.norm(align_points(here, p) - p, axis=1).max()
        best, most = (here, gone) if gone > most else (best, most)
        if most > _FAR * size:
            break
    return best if most > _FINITE * size else None


def restore_lengths(p: Floats, edges: Ints, lengths: Floats, tol: float) -> Floats | None:
    """Points near p (N, d) whose edges have the given lengths within tol [m], or None."""
    ends, reached = descend_to_lengths(p[None], edges, lengths, tol, 40)
    return ends[0] if reached[0] else None


def descend_to_lengths(
    at: Floats, e: Ints, length: Floats, tol: float, iterations: int
) -> tuple[Floats, Bools]:
    """Levenberg-Marquardt from positions (B, N, d): final positions, and which of them have the lengths within tol."""
    at = at.copy()
    count, n, d = at.shape
    ends, done = at.copy(), np.zeros(count, dtype=bool)
    damping = np.full(count, 1e-2)
    i, j = e.T
    rows, size = np.arange(len(e)), d * n
    lane = np.arange(count)
    c = _length_errors(at, i, j, length)
    for _ in range(iterations):
        x = (at[:, i] - at[:, j]) / length[:, None]
        J = np.zeros((len(at), len(e), n, d))
        J[:, rows, i], J[:, rows, j] = x, -x
        J = J.reshape(len(at), len(e), size)
        K = J.transpose(0, 2, 1) @ J
        K[:, np.arange(size), np.arange(size)] += damping[:, None] + 1e-14
        step = np.linalg.solve(K, (J.transpose(0, 2, 1) @ c[..., None]))[..., 0]
        new = at - step.reshape(at.shape)
        after = _length_errors(new, i, j, length)
        better = (after**2).sum(axis=1) < (c**2).sum(axis=1)
        at, c = np.where(better[:, None, None], new, at), np.where(better[:, None], after, c)
        damping = np.where(better, damping * 0.2, np.minimum(damping * 4, 1e6))
        met = np.abs(c).max(axis=1) <= tol
        ends[lane], done[lane] = at, met
        go_on = ~met & (damping < 1e6)
        at, c, damping, lane = at[go_on], c[go_on], damping[go_on], lane[go_on]
        if not len(at):
            break
    return ends, done


def _length_errors(p: Floats, i: Ints, j: Ints, length: Floats) -> Floats:
    """(L^2 - d^2) / (2 d) [m], which is smooth if agents meet, and equals L - d near the solution."""
    return (((p[:, i] - p[:, j]) ** 2).sum(axis=2) - length**2) / (2 * length)


def can_deform_into(frame: Framework, goal: Floats, strides: int) -> bool:
    """Whether shapes with the same lengths lead from a framework to another one, (N, d), in small steps.

    The walk goes towards the other shape as far as the flexes let it. Where it would turn back, it goes on: a
    family of one motion is a closed curve.
    """
    here, way = frame.p, np.zeros(frame.p.size)
    size = np.linalg.norm(here - here.mean(axis=0), axis=1).max()
    step = most = _STRIDE * size * np.sqrt(len(here))
    for _ in range(strides):
        gap = (align_points(goal, here) - here).ravel()
        if np.linalg.norm(gap) <= step:
            return True
        flexes = Framework(here, frame.edges).flexes
        ahead = flexes.T @ gap
        ahead = flexes.T @ way if ahead @ flexes.T @ way < 0 else ahead
        ahead = flexes @ ahead / max(np.linalg.norm(ahead), 1e-12)
        there = here + step * ahead.reshape(here.shape)
        there = restore_lengths(there, frame.edges, frame.lengths, 1e-9 * size)
        if there is None or not 0.5 < np.linalg.norm(align_points(there, here) - here) / step < 2:
            step /= 3  # round a sharp bend
            if step < 1e-3 * most:
                return False
            continue
        here, way, step = there, ahead, min(1.5 * step, most)
    return False


def align_points(p: Floats, onto: Floats) -> Floats:
    """Points p (N, d) moved rigidly, without reflection in their d dimensions, to fit others."""
    x, y = p - p.mean(axis=0), onto - onto.mean(axis=0)
    u, _, vt = np.linalg.svd(y.T @ x)
    u[:, -1] *= np.linalg.det(u @ vt)
    return x @ (u @ vt).T + onto.mean(axis=0)
