"""Inputs and outputs of the measurement of a flight (`rigidfleet.kernel.measurement`): arrays, as in `records`."""

from typing import Any, NamedTuple

import numpy as np

from rigidfleet.typing import Bools, Floats, Ints


class Measured(NamedTuple):
    """Positions and forces of K samples of a flight, and what follows from them; P pieces, N agents, m edges."""

    time: Floats  # (K,) [s]
    start: Ints  # (P + 1,) first sample of each piece, and the end of the last one
    attached: Bools  # (P,) whether the slots carry the body frame
    framed: bool  # whether the integrated frame is the attitude of a piece without slots
    mass: Floats  # (N,) [kg]
    lost_at: Floats  # (N,) [s]
    limit: Floats  # (N,) at which the thrust is clipped [N]; infinity if it is not
    edges: Ints  # (m, 2)
    r: Floats  # (K, N, 3)
    v: Floats
    f_u: Floats
    f_C: Floats
    p: Floats  # (K, N, 3) slots
    T_ref: Floats  # (K, 3, 3)
    frame: Floats  # (K, 4) integrated frame; signs are made continuous
    cm: Floats  # (K, 3)
    cm_velocity: Floats
    attitude: Floats  # (K, 4)
    attitude_reference: Floats  # (K, 4)
    rates: Floats  # (K, 3) body axes
    wrench: Floats  # (K, 6)
    thrust: Floats  # (K, N)
    distance: Floats  # (K, m)
    line: Bools  # (K,) whether the slots count as a line, without a spin about itself
    work: Floats  # (9, 4, 4); work[5] is the attitude expected if the first sample commands none
    who: Floats  # (2, N) masses of the agents left, and roots of them
    x: Floats  # (2, N, 3) agents and slots about their centres


class Spectrum(NamedTuple):
    """Singular values of the constraint Jacobian at K samples."""

    r: Floats  # (K, N, 3)
    edges: Ints  # (m, 2)
    u: Floats  # (m, 3) unit vectors
    share: Floats  # (m, m) of two edges in J J^T: what their unit vectors' product counts; empty if m > 3N
    A: Floats  # (s, s), s the smaller of m and 3N
    work: Floats  # (3, s)
    least: Floats  # (K,) the smallest non-zero one


def measured(n: int, m: int, K: int, **given: Any) -> Measured:
    """Arrays for the measurement of K samples of ``n`` agents and ``m`` edges."""
    work = np.zeros((9, 4, 4))
    work[5] = np.eye(4)
    fields: dict[str, Any] = {
        "frame": np.full((K, 4), np.nan), "cm": np.empty((K, 3)), "cm_velocity": np.empty((K, 3)),
        "attitude": np.empty((K, 4)), "attitude_reference": np.full((K, 4), np.nan), "rates": np.empty((K, 3)),
        "wrench": np.empty((K, 6)), "thrust": np.empty((K, n)), "distance": np.empty((K, m)),
        "line": np.zeros(K, dtype=np.bool_), "work": work, "who": np.empty((2, n)), "x": np.empty((2, n, 3)),
    }  # fmt: skip
    return Measured(**(fields | given))


def spectrum_of(r: Floats, edges: Ints) -> Spectrum:
    """Arrays for the singular values of J with ``edges`` (m, 2) at positions r (K, N, 3)."""
    m, size = len(edges), min(len(edges), 3 * r.shape[1])
    share = np.empty((m, m) if m == size else (0, 0))
    return Spectrum(
        r, edges, np.empty((m, 3)), share, np.empty((size, size)), np.empty((3, size)), np.empty(len(r))
    )  # fmt: skip
