"""Calls from the physics to code outside of it.

- ``call_external(address, t, r, v, f)``: a user's force f (N, 3) [N] on each agent, at time t [s] and state r, v;
- ``call_solver(address)``: the solver of a large formation, which has its own workspace (`kernel.large.solver`);
- ``call_recorder(address, p, w, segment, record)``: the compiled `kernel.recorder`, for the monitor.

These are names of `rigidfleet.kernel.compiler.calls`.
"""

from rigidfleet.kernel.compiler.calls import call_external, call_recorder, call_solver

__all__ = ["call_external", "call_recorder", "call_solver"]
