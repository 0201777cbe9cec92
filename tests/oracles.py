"""Formulas written plainly, by which tests check the faster code of the package."""

import os

import numpy as np

#: Whether oracles of hundreds of flights have their full size, which takes hours: `RIGIDFLEET_FULL=1`.
FULL = os.environ.get("RIGIDFLEET_FULL") == "1"


def jacobian(r: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Constraint Jacobian J (m, 3N) of agents at r (N, 3): its rows are the unit vectors of the edges."""
    J = np.zeros((len(edges), *r.shape))
    for k, (i, j) in enumerate(edges):
        J[k, i] = (r[i] - r[j]) / np.linalg.norm(r[i] - r[j])
        J[k, j] = -J[k, i]
    return J.reshape(len(edges), -1)
