"""How the kernel is compiled: one decorator, the same options everywhere."""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])

# Sums may be reordered and fused, but NaN and infinity keep their meaning: the integrator has to
# see them to reject a step.
_FAST = {"reassoc", "contract", "arcp", "nsz"}


def compiled(function: F) -> F:
    """Compile for the flight: cached on disk, without the GIL, division by zero gives infinity.

    Nothing in the kernel allocates, so that Numba need not count references (``_nrt``): counting
    them takes as long as the physics of three agents.
    """
    return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, _nrt=False)(
        function
    )
