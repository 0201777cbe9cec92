"""Inputs and outputs of the measurement of a flight (`rigidfleet.kernel.measurement`): arrays, as in `records`."""

from typing import Annotated, Any, NamedTuple

import numpy as np

from rigidfleet.kernel.problem import Extents, PerAgent, PlacesInTime
from rigidfleet.kernel.records import Corners
from rigidfleet.typing import Bools, Floats, Ints

Vectors = Annotated[Floats, Extents((None, 3))]
Quaternions = Annotated[Floats, Extents((None, 4))]

#: Samples of one agent whose places and distances stay in the processor's first cache.
BLOCK = 512


class Measured(NamedTuple):
    """Positions and forces of K samples of a flight, and what follows from them; P pieces, N agents, m edges."""

    time: Floats  # (K,) [s]
    start: Ints  # (P + 1,) first sample of each piece, and the end of the last one
    attached: Bools  # (P,) whether the slots carry the body frame
    framed: bool  # whether the integrated frame is the attitude of a piece without slots
    mass: PerAgent  # [kg]
    lost_at: PerAgent  # [s]
    limit: PerAgent  # at which the thrust is clipped [N]; infinity if it is not
    edges: Annotated[Ints, Extents(("m", 2))]
    r: PlacesInTime
    v: PlacesInTime
    f_u: PlacesInTime
    f_C: PlacesInTime
    p: PlacesInTime  # slots
    T_ref: Annotated[Floats, Extents((None, 3, 3))]
    frame: Quaternions  # integrated frame; signs are made continuous
    cm: Vectors
    cm_velocity: Vectors
    attitude: Quaternions
    attitude_reference: Quaternions
    rates: Vectors  # body axes
    wrench: Annotated[Floats, Extents((None, 6))]
    thrust: Annotated[Floats, Extents((None, "N"))]
    distance: Annotated[Floats, Extents((None, "m"))]
    line: Bools  # (K,) whether the slots count as a line, without a spin about itself
    work: Annotated[
        Floats, Extents((9, 4, 4))
    ]  # work[5] is expected if the first sample commands no attitude
    left: PerAgent  # masses of the agents left, 0 of others
    x: Annotated[Floats, Extents((2, "N", 3))]  # agents and slots about their centres


class SingularValues(NamedTuple):
    """Singular values of the constraint Jacobian at K samples, of eight at once: rows of eights are theirs."""

    positions: Floats  # (K, N, 3)
    edges: Ints  # (m, 2)
    share: Floats  # (m, m) of two edges in J J^T: what their unit vectors' product counts; empty if m > 3N
    r: Floats  # (N, 3 * 8)
    u: Floats  # (m, 3 * 8) unit vectors
    A: Floats  # (s, s * 8), s the smaller of m and 3N
    least: Floats  # (1, 8) the smallest non-zero eigenvalue
    one: Floats  # (s, s) A of one sample
    work: Floats  # (3, s)
    values: Floats  # (K,) the smallest non-zero singular value


class Nearest(NamedTuple):
    """The nearest of some boxes to each of N agents at K samples; infinity and -1 without boxes."""

    r: PlacesInTime
    radius: PerAgent
    boxes: Corners
    least: Annotated[Floats, Extents(("N", None))]  # distance of the agent's surface
    nearest: Annotated[Ints, Extents(("N", None))]
    places: Annotated[Floats, Extents((3, BLOCK))]  # of one agent


def measurement_of(n: int, m: int, K: int, **samples: Any) -> Measured:
    """Arrays for the measurement of K samples of ``n`` agents and ``m`` edges."""
    work = np.zeros((9, 4, 4))
    work[5] = np.eye(4)
    fields: dict[str, Any] = {
        "frame": np.full((K, 4), np.nan), "cm": np.empty((K, 3)), "cm_velocity": np.empty((K, 3)),
        "attitude": np.empty((K, 4)), "attitude_reference": np.full((K, 4), np.nan), "rates": np.empty((K, 3)),
        "wrench": np.empty((K, 6)), "thrust": np.empty((K, n)), "distance": np.empty((K, m)),
        "line": np.zeros(K, dtype=np.bool_), "work": work, "left": np.empty(n), "x": np.empty((2, n, 3)),
    }  # fmt: skip
    return Measured(**(fields | samples))


def spectrum_of(r: Floats, edges: Ints) -> SingularValues:
    """Arrays for the singular values of J with ``edges`` (m, 2) at positions r (K, N, 3)."""
    m, size = len(edges), min(len(edges), 3 * r.shape[1])
    share = np.empty((m, m) if m == size else (0, 0))
    return SingularValues(
        r, edges, share, np.empty((r.shape[1], 24)), np.empty((m, 24)), np.empty((size, 8 * size)), np.empty((1, 8)),
        np.empty((size, size)), np.empty((3, size)), np.empty(len(r)),
    )  # fmt: skip


def nearest_of(r: Floats, radius: Floats, boxes: Floats) -> Nearest:
    """Arrays for the nearest of boxes (B, 6) to agents r (K, N, 3) with ``radius`` (N,)."""
    K, n, _ = r.shape
    return Nearest(
        r, radius, boxes, np.full((n, K), np.inf), np.full((n, K), -1), np.empty((3, BLOCK))
    )
