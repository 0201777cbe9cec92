"""The physics, compiled: constraint force, body frame, closed loop, integrator.

The kernel knows arrays, not missions: a `Program` (see `rigidfleet.kernel.program`) holds
everything it reads, a `Workspace` everything it writes. Importing this package imports Numba.
"""

from rigidfleet.kernel.compiled import cache_directory as cache_directory
from rigidfleet.kernel.compiled import is_compiled as is_compiled
