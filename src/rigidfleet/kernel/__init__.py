"""The physics, compiled: constraint force, body frame, closed loop, integrator.

The kernel knows arrays, not missions: a `Problem` (see `rigidfleet.kernel.problem`) holds
everything it reads, a `Workspace` everything it writes. Flights call its machine code through
`rigidfleet.kernel.engine.native`, which needs the compiler only if the code is not in the cache. Importing
the physics modules themselves imports Numba.
"""
