"""The physics, compiled: constraint force, body frame, closed loop, integrator.

The kernel knows arrays, not missions: a `Problem` (see `rigidfleet.kernel.problem`) holds
everything it reads, a `Workspace` everything it writes. Flights call its machine code by
`rigidfleet.kernel.engine.native`, which needs the compiler only where that is not in the cache; to import
the modules of the physics themselves imports Numba.
"""
