"""Matrix Riccati equations, with every digit that their problem has.

    dP/dtau = A^T P + P A - P G P + Q,  P(0) = S,

is solved from the flow of its Hamiltonian system x' = A x - G y, y' = -Q x - A^T y, of matrices (n, n). A flow over a
long time is doubled from a short one, in unknowns that do not grow with it. Where a motion grows that no weight sees,
small steps keep its digits.
"""

import math

import numpy as np

from rigidfleet.typing import Bools, Floats

# A weight counts as negative beyond this share of its greatest entry.
ROUNDING = 1e-12
# Growth of a motion over a step up to which the doubled flow keeps half of its digits: they are lost with its square.
_GROWTH = 1e4
# Most steps of a horizon in which such a motion grows: about a second.
_STEPS = 20_000


def is_semidefinite(weight: Floats) -> bool:
    """Whether a weight is positive semi-definite, to rounding."""
    return bool(np.linalg.eigvalsh(weight)[0] >= -ROUNDING * np.abs(weight).max())


def cost_to_go(A: Floats, G: Floats, Q: Floats, S: Floats, to_go: Floats) -> Floats:
    """P (..., n, n) at times to go (...).

    Raises ValueError if P does not exist at all times to go until the greatest, or cannot be computed.
    """
    grows = _needs_small_steps(A, G, Q, S, to_go.max(initial=0.0))
    return _march_cost(A, G, Q, S, to_go)[0] if grows else _costs_by_doubling(A, G, Q, S, to_go)


def costs_and_states(
    A: Floats, G: Floats, Q: Floats, S: Floats, t: Floats, T: float
) -> tuple[Floats, Floats]:
    """P and x (K, n, n) at times t (K,) of a horizon T [s]; columns of x are the states that each state alone leads to.

    Raises ValueError as `cost_to_go` does.
    """
    to_go = np.maximum(T - t, 0.0)
    if _needs_small_steps(A, G, Q, S, T):
        P, x = (part[:-1] for part in _march_cost(A, G, Q, S, np.append(to_go, T)))
        return P, x
    P = _costs_by_doubling(A, G, Q, S, to_go)
    X, Phi, W, _ = _hamiltonian_flow(A, G, Q, S, t, T)
    return P, solve_linear(np.eye(len(A)) + W @ (P - X), Phi)


def _costs_by_doubling(A: Floats, G: Floats, Q: Floats, S: Floats, to_go: Floats) -> Floats:
    """P (..., n, n) at times to go (...), from the flow of `_transition_and_gramians`."""
    X, Phi, W, V = _hamiltonian_flow(A, G, Q, S, to_go, to_go.max(initial=0.0))
    D = S - X
    P = X + V + _transpose(Phi) @ solve_linear(np.eye(len(A)) + D @ W, D @ Phi)
    return 0.5 * (P + _transpose(P))


def _needs_small_steps(A: Floats, G: Floats, Q: Floats, S: Floats, T: float) -> bool:
    """Whether a motion that no weight sees grows over T so far that only small steps keep its digits.

    Motions that are weighed end the growth themselves, on the way of the doublings.
    """
    if not np.linalg.eigvals(A).real.max() * T > math.log(_GROWTH):
        return False
    if not (is_semidefinite(Q) and is_semidefinite(S)):
        return False
    rate = fastest_rate(A, G, Q)
    stages = np.ldexp(T, -np.arange(math.ceil(math.log2(2.0 * rate * T)) + 1))
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            Phi = _transition_and_gramians(A, G, Q, stages, rate)[0]
    except np.linalg.LinAlgError:  # too great for any digits
        return True
    return not float(np.abs(Phi).max()) <= _GROWTH  # true for NaN


def _march_cost(A: Floats, G: Floats, Q: Floats, S: Floats, to_go: Floats) -> tuple[Floats, Floats]:
    """P and x (..., n, n) at times to go (...), in steps that each keep P positive.

    Columns of x are the states that each state alone, at the greatest time to go, leads to. Raises ValueError if there
    are too many steps.
    """
    identity, rate = np.eye(len(A)), fastest_rate(A, G, Q)
    P, costs, moves = S, [], []
    steps = 0
    every, which = np.unique(to_go, return_inverse=True)
    for span in np.diff(every, prepend=0.0):
        left = max(1, math.ceil(span * rate / math.log(_GROWTH)))
        Phi, W, V, _ = _transition_and_gramians(A, G, Q, np.array(span / left), rate)
        move = identity
        while left:
            value, vector = np.linalg.eigh(P)
            root = vector * np.sqrt(value.clip(min=0.0))
            closed, reach = solve_linear(identity + W @ P, Phi), root.T @ Phi
            last, P = P, V + reach.T @ solve_linear(identity + root.T @ W @ root, reach)
            P = 0.5 * (P + P.T)
            # At a stationary P, all further steps are the same.
            done = left if np.abs(P - last).max() <= np.finfo(float).eps * np.abs(P).max() else 1
            move = move @ np.linalg.matrix_power(closed, done)
            left, steps = left - done, steps + 1
            if steps > _STEPS:
                raise ValueError(
                    f"the cost over {every[-1]:.6g} s cannot be computed: a motion grows that no weight sees, while"
                    " another one changes too slowly. Weigh the first in Q, or shorten the horizon"
                )
        costs.append(P)
        moves.append(move)
    states = [identity]
    for move in moves[:0:-1]:  # each leads x at its time to go to x at the one before
        states.append(move @ states[-1])
    where = which.reshape(to_go.shape)
    return np.array(costs)[where], np.array(states[::-1])[where]


def _hamiltonian_flow(
    A: Floats, G: Floats, Q: Floats, S: Floats, tau: Floats, T: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """X (n, n) and Phi, W, V (..., n, n) over tau (...), as `_transition_and_gramians` has them of P - X.

    Raises ValueError if P, starting from S, does not exist at all times to go up to T.
    """
    if is_semidefinite(Q) and is_semidefinite(S):
        return np.zeros_like(Q), *_transition_and_gramians(A, G, Q, tau, fastest_rate(A, G, Q))[:3]
    # P - S starts from zero. Its Phi, W and V therefore exist exactly as long as P does.
    GS = G @ S
    A, Q = A - GS, A.T @ S + S @ A - S @ GS + Q
    rate = float(np.linalg.norm(A, 2) + np.sqrt(np.linalg.norm(G, 2) * np.linalg.norm(Q, 2)))

    def escapes(t: float) -> bool:
        return bool(_transition_and_gramians(A, G, Q, np.array(t), rate)[3])

    if escapes(T):
        low, high = 0.0, T
        while high - low > 1e-12 * high:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if escapes(middle) else (middle, high)
        raise ValueError(
            f"the cost has no minimum over {high:.10g} s or longer: its Riccati equation grows"
            f" beyond all bounds at a time to go of {high:.10g} s. Shorten the horizon, or make Q or S"
            " greater or N less, so that the cost cannot fall below all bounds"
        )
    return S, *_transition_and_gramians(A, G, Q, tau, rate)[:3]


def solution_by_subspace(H: Floats) -> Floats:
    """P (n, n), to some digits, from the stable half of a Hamiltonian matrix (2 n, 2 n).

    Raises ValueError if an eigenvalue lies on the imaginary axis, within rounding of the matrix.
    """
    from scipy.linalg import schur

    n = len(H) // 2
    near = min(np.linalg.eigvals(H), key=lambda s: abs(s.real))
    # Rounding moves a double eigenvalue far off the axis, so the distance to a singular matrix decides.
    g, q = np.linalg.norm(H[:n, n:], 2), np.linalg.norm(H[n:, :n], 2)
    scale = np.repeat([1.0, math.sqrt(q / g) if g > 0.0 else 1.0], n)
    balanced = H * scale / scale[:, None]
    least = np.linalg.svd(balanced - 1j * near.imag * np.eye(2 * n), compute_uv=False)[-1]
    if not least > 8 * n * np.finfo(float).eps * np.linalg.norm(balanced, 2):
        raise ValueError(
            "the cost has no minimum over an infinite horizon: its Hamiltonian matrix has the"
            f" eigenvalue {abs(near.imag):.6g}i on the imaginary axis, so an oscillation at"
            f" {abs(near.imag):.6g} rad/s has zero or negative cost. Increase Q or reduce N, or use a"
            " finite horizon"
        )
    vectors = schur(balanced, sort="lhp")[1][:, :n] * scale[:, None]
    P = solve_linear(vectors[:n].T, vectors[n:].T)
    return 0.5 * (P + P.T)


def fastest_rate(A: Floats, G: Floats, Q: Floats) -> float:
    """Rate of the fastest motion of a Hamiltonian system [1/s]."""
    return float(np.abs(np.linalg.eigvals(hamiltonian(A, G, Q))).max())


def _transition_and_gramians(
    A: Floats, G: Floats, Q: Floats, tau: Floats, rate: float
) -> tuple[Floats, Floats, Floats, Bools]:
    """Phi, W, V (..., n, n): x(tau) = Phi x(0) - W y(tau), y(0) = V x(0) + Phi^T y(tau).

    The flow of the Hamiltonian system x' = A x - G y, y' = -Q x - A^T y over tau, solved for the unknowns of its
    boundary value problem. The exponential would grow as fast as y does, but these matrices do not: W and V
    grow monotonically from zero, and Phi tends to the transition matrix of the closed loop.

    Also returns whether the solution V of the Riccati equation, which starts from zero, has become unbounded by
    tau (...). This happens only for an indefinite Q; the three matrices are then meaningless.
    """
    n = len(A)
    identity = np.eye(n)
    backward = -hamiltonian(A, G, Q)
    with np.errstate(divide="ignore"):
        doublings = np.ceil(np.log2(2.0 * rate * tau)).clip(min=0.0)
    # A Taylor series, because each entry keeps its own leading power of the step. A Pade approximant
    # would round the small entries (W begins with the third power) relative to the large ones.
    step = backward * (tau * 0.5**doublings)[..., None, None]
    E = term = step
    for k in range(2, 25):
        term = term @ step / k
        E = E + term
    # D = Phi - 1 in place of Phi: squaring a matrix near 1 doubles its rounding error each time.
    D = -solve_linear(identity + E[..., :n, :n], E[..., :n, :n])
    W = E[..., :n, n:] + D @ E[..., :n, n:]
    V = E[..., n:, :n] + E[..., n:, :n] @ D
    escaped, watched = np.zeros(tau.shape, dtype=bool), not is_semidefinite(Q)
    for k in range(int(doublings.max(initial=0.0))):
        more = doublings > k
        if watched:
            # Over a further step V becomes (1 + V w)^-1 V and more, w from 0 to W: as w only grows, it has
            # passed a singular 1 + V w by the end if and only if 1 + V W has an eigenvalue that is not positive.
            more &= ~escaped
            passed = np.linalg.eigvals(W[more] @ V[more]).real.min(axis=-1, initial=0.0) <= -1.0
            escaped[more] = passed
            more &= ~escaped
        d, w, v = D[more], W[more], V[more]
        phi, wv = identity + d, w @ v
        turn = solve_linear(identity + wv, np.concatenate([wv, w @ _transpose(phi)], axis=-1))
        loss, reach = turn[..., :n], turn[..., n:]
        D[more] = 2.0 * d + d @ d - phi @ loss @ phi
        W[more] = w + phi @ reach
        V[more] = v + _transpose(phi) @ v @ (phi - loss @ phi)
    return identity + D, W, V, escaped


def hamiltonian(A: Floats, G: Floats, Q: Floats) -> Floats:
    """Matrix (2 n, 2 n) of x' = A x - G y, y' = -Q x - A^T y."""
    return np.block([[A, -G], [-Q, -A.T]])


def solve_linear(M: Floats, b: Floats) -> Floats:
    """M^-1 b, of stacks of matrices, too."""
    return np.linalg.solve(M, b).astype(float, copy=False)


def _transpose(M: Floats) -> Floats:
    return np.swapaxes(M, -1, -2)
