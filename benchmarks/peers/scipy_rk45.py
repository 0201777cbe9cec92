"""SciPy's `solve_ivp`, RK45, on the paper's equations as they stand, written with NumPy."""

from __future__ import annotations

import numpy as np
import scipy
from scipy_peer import Literal, constant

from .case import DURATION, TOLERANCES, Array, Case, Flight, Peer, timed


def peer() -> Peer:
    """RK45, at a tolerance."""
    return Peer(
        "SciPy solve_ivp",
        scipy.__version__,
        "the same law and order of method; right-hand side in NumPy",
        True,
        TOLERANCES,
        "tolerance",
        flight,
    )


def flight(case: Case, tolerance: float) -> Flight:
    """The undamped law."""
    B = np.zeros((len(case.edges), case.n))
    rows = np.arange(len(case.edges))
    B[rows, case.edges[:, 0]], B[rows, case.edges[:, 1]] = 1.0, -1.0
    law = Literal(
        r0=case.r,
        m=case.m,
        B=B,
        gains=case.gains,
        reference=constant(case.d),
        f=case.force,
        mu=0.0,
        iterations=1,
        k_def=0.0,
    )

    def fly() -> Array:
        return law.fly(np.array([DURATION]), tolerance)[-1, : 3 * case.n].reshape(-1, 3)

    return timed(fly)
