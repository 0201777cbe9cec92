"""Disturbances of a flight: wind, gusts, noise, wrong masses, lost vehicles.

The control laws use measured states and assumed masses; the equations of motion use the true ones.
Before the laws, `swap_in_measured_states` replaces the true state by the measured one. After them,
`restore_states_and_disturb` restores the true state and adds the forces that no vehicle knows.
"""

from rigidfleet.kernel.compiler import elementwise  # noqa: F401 -- compiles `top_of_solids_below`
from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.solids.distance import top_of_solids_below

# A lost vehicle on the ground: critically damped contact of this natural frequency [1/s], damped from
# this depth [m] on. It stops within a metre from 40 m/s, and needs no shorter steps than a flight.
_CONTACT, _SOFT = 20.0, 0.01


@jit_inline
def spline_weights(t, step, rows):
    """First of the four rows of a table of ``rows`` that count at t, and their weights; see `write_spline_value`."""
    last = rows - 4
    x = min(max(t / step, 0.0), last + 1.0)
    j = min(int(x), last)
    s = x - j
    rest = 1.0 - s
    b1 = 2.0 / 3.0 - s * s * (1.0 - 0.5 * s)
    b2 = 2.0 / 3.0 - rest * rest * (1.0 - 0.5 * rest)
    return j, rest * rest * rest / 6.0, b1, b2, s * s * s / 6.0


@jit
def write_spline_value(t, step, table, out):
    """Cubic B-spline with coefficients table (K, N, 3), knots every `step` [s] from 0, into out (N, 3).

    Twice continuously differentiable; constant before the first and after the last knot.
    """
    j, b0, b1, b2, b3 = spline_weights(t, step, table.shape[0])
    for i in range(out.shape[0]):
        for q in range(3):
            out[i, q] = (
                b0 * table[j, i, q]
                + b1 * table[j + 1, i, q]
                + b2 * table[j + 2, i, q]
                + b3 * table[j + 3, i, q]
            )


@jit
def swap_contents(a, b):
    """Exchange the contents of a and b, (N, 3) both."""
    for i in range(a.shape[0]):
        for q in range(3):
            a[i, q], b[i, q] = b[i, q], a[i, q]


@jit
def swap_in_measured_states(t, disturbance, w):
    """Write measured states into w.r and w.v, and store the true ones in w.r_seen and w.v_seen meanwhile."""
    if disturbance.noise_r.shape[0] > 0:
        write_spline_value(t, disturbance.noise_step, disturbance.noise_r, w.r_seen)
        write_spline_value(t, disturbance.noise_step, disturbance.noise_v, w.v_seen)
        for i in range(w.r.shape[0]):
            for q in range(3):
                r, v = w.r[i, q], w.v[i, q]
                w.r[i, q], w.v[i, q] = r + w.r_seen[i, q], v + w.v_seen[i, q]
                w.r_seen[i, q], w.v_seen[i, q] = r, v


@jit_inline
def ground_damping_and_lift(m, g, floor, z):
    """Damping [N s/m] and upward force [N] of the ground on a lost vehicle of mass m [kg] at height z [m].

    In equilibrium with its weight, the vehicle just touches the ground, at the height ``floor`` [m].
    """
    deep = max(0.0, floor + g / _CONTACT**2 - z)
    return 2.0 * _CONTACT * m * min(1.0, deep / _SOFT), _CONTACT**2 * m * deep


@jit
def restore_states_and_disturb(t, m, g, disturbance, w):
    """Write true states back into w.r and w.v, true forces into w.f_E, and the aerodynamic force into w.f_D (N, 3) [N].

    f_D = drag (wind + gust - v), linear in the velocity through the air. Gravity acts on the true masses,
    not on the assumed ones, m (N,). A lost vehicle has no thrust, and comes to rest on the ground.
    """
    if disturbance.noise_r.shape[0] > 0:
        swap_contents(w.r, w.r_seen)
        swap_contents(w.v, w.v_seen)
    if disturbance.gust.shape[0] > 0:
        write_spline_value(t, disturbance.gust_step, disturbance.gust, w.f_D)
    else:
        w.f_D[:] = 0.0
    for i in range(m.shape[0]):
        drag, true = disturbance.drag[i], disturbance.m[i]
        for q in range(3):
            w.f_D[i, q] = drag * (disturbance.wind[q] + w.f_D[i, q] - w.v[i, q])
            w.f_E[i, q] += w.f_D[i, q]
        w.f_E[i, 2] -= (true - m[i]) * g
        if disturbance.lost[i]:
            over = top_of_solids_below(w.r[i, 0], w.r[i, 1], w.r[i, 2], disturbance.roofs)
            floor = max(disturbance.floor[i], over + disturbance.radius[i])
            damping, lift = ground_damping_and_lift(true, g, floor, w.r[i, 2])
            for q in range(3):
                w.f_u[i, q] = 0.0
                w.f_E[i, q] -= damping * w.v[i, q]
            w.f_E[i, 2] += lift
