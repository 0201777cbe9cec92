"""Inputs and outputs of the measurement of a flight (`rigidfleet.kernel.measurement`): arrays, as in `records`."""

from typing import Annotated, Any, NamedTuple

import numpy as np

from rigidfleet.kernel.problem import Extents, PerAgent, PlacesInTime
from rigidfleet.typing import Bools, Floats, Ints

Vectors = Annotated[Floats, Extents((None, 3))]
Quaternions = Annotated[Floats, Extents((None, 4))]


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
    # work[5] is expected if the first sample commands no attitude
    work: Annotated[Floats, Extents((9, 4, 4))]
    left: PerAgent  # masses of the agents left, 0 of others
    x: Annotated[Floats, Extents((2, "N", 3))]  # agents and slots about their centres


def measurement_arrays(n: int, m: int, K: int, **samples: Any) -> Measured:
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
