"""Quantities with limits, read from the workspace of the closed loop."""

import math

from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.constraint import find_multipliers


@jit
def write_watched_forces(p, w, values):
    """Thrust, acceleration and constraint force of each agent; tension and constraint of each edge; into (3N + 2m,).

    If there is room for (5N + 2m,), also the horizontal and the vertical acceleration of each agent.
    """
    vehicles, edges = p.vehicles, p.graph.edges
    n, m = vehicles.m.shape[0], edges.shape[0]
    noisy = p.disturbance.noise_r.shape[0] > 0
    directed = 3 * n + 2 * m
    find_multipliers(p.graph)
    for i in range(n):
        thrust, a, f = 0.0, 0.0, 0.0
        for q in range(3):
            force = w.f_u[i, q] + w.f_C[i, q]
            thrust += force * force
            a += w.a[i, q] * w.a[i, q]
            f += w.f_C[i, q] * w.f_C[i, q]
        thrust = math.sqrt(thrust)
        if vehicles.saturate:
            thrust = min(thrust, vehicles.thrust_limit[i])
        values[i], values[n + i], values[2 * n + i] = thrust, math.sqrt(a), math.sqrt(f)
        if values.shape[0] > directed:
            x, y = w.a[i, 0], w.a[i, 1]
            values[directed + i], values[directed + n + i] = math.sqrt(x * x + y * y), w.a[i, 2]
    for k in range(m):
        values[3 * n + k] = -w.multiplier[k]
        c = w.c[k]
        if noisy:  # the true values, not the measured ones
            c = 0.0
            for q in range(3):
                d = w.r[edges[k, 0], q] - w.r[edges[k, 1], q]
                c += d * d
            c = math.sqrt(c) - w.d[k]
        values[3 * n + m + k] = c
