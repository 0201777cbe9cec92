"""Content of a sample: forces and references at a state."""

import math

from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.constraint import find_multipliers
from rigidfleet.kernel.dynamics import closed_loop
from rigidfleet.kernel.linalg import copy, copy_vector
from rigidfleet.kernel.problem import OPEN
from rigidfleet.kernel.references import blend_slots


@jit
def write_record(times, samples, p, w, scratch, out, first):
    """Evaluate the closed loop at the sampled states, and record its forces and references from row ``first`` on.

    Without rows in ``out``, the only result is what the last evaluation leaves in the workspace.
    """
    for k in range(times.shape[0]):
        closed_loop(times[k], samples[k], scratch, p, w)
        if first + k < out.r.shape[0]:
            record_sample(times[k], p, w, first + k, out)


@jit
def record_sample(t, p, w, k, out):
    """Copy the values of the closed loop at time t [s] from the workspace into row k of a record; NaN for none."""
    find_multipliers(p.graph)
    for i in range(w.c.shape[0]):
        out.c[k, i], out.L[k, i], out.multiplier[k, i] = w.c[i], w.L[i], w.multiplier[i]
        out.d[k, i], out.d_dot[k, i] = w.d[i], w.d_dot[i]
    copy(w.r, out.r[k])
    copy(w.v, out.v[k])
    copy(w.a, out.a[k])
    copy(w.f_E, out.f_E[k])
    copy(w.f_u, out.f_u[k])
    copy(w.f_C, out.f_C[k])
    if out.f_D.shape[0] > 0:
        if p.disturbance.active:
            copy(w.f_D, out.f_D[k])
        else:
            out.f_D[k] = math.nan
        if p.disturbance.noise_r.shape[0] > 0:
            copy(w.r_seen, out.r_seen[k])
            copy(w.v_seen, out.v_seen[k])
        else:
            out.r_seen[k] = out.v_seen[k] = math.nan
    copy_vector(w.wrench, out.wrench[k])
    # Even if only distances are blended, the slots give the formation's attitude.
    blend_slots(t, p.reference, w.p, w.p_dot, w.p_ddot)
    copy(w.p, out.p[k])
    if p.control.kind == OPEN:
        out.T_ref[k] = math.nan
    else:
        copy(w.T_ref, out.T_ref[k])
    if p.control.tracks_slots:
        copy(w.r_ref, out.r_ref[k])
        for q in range(3):
            out.motion[k, q], out.motion[k, 3 + q] = w.body[0, q], w.body[1, q]
            out.rates[k, q] = w.body[3, q]
        return
    out.r_ref[k] = out.motion[k] = out.rates[k] = math.nan
    if p.control.leads_body:
        since = t - p.feedback.arrival
        for q in range(3):
            out.motion[k, q] = p.feedback.r[q] + p.feedback.v[q] * since
            out.motion[k, 3 + q] = p.feedback.v[q]
            out.rates[k, q] = p.feedback.omega[q]
