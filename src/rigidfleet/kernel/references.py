"""References of the formation over time: slots and distances, with two exact derivatives."""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.problem import SHAPE, SQUARED, septic_polynomial

blend = jit_inline(septic_polynomial)


@jit
def septic(t, t0, T_b):
    """Blend s from 0 to 1 over [t0, t0 + T_b] with three vanishing derivatives at either end.

    Returns s, ds/dt [1/s], d2s/dt2 [1/s^2]; T_b = 0 is a step.
    """
    if t >= t0 + T_b:
        return 1.0, 0.0, 0.0
    if t <= t0:
        return 0.0, 0.0, 0.0
    x = (t - t0) / T_b
    rest = 1.0 - x
    rate, second = 140.0 * (x * rest) ** 3, 420.0 * (x * rest) ** 2 * (rest - x)
    return blend(x), rate / T_b, second / T_b**2


@jit_inline
def piece_at(t, knots):
    """Piece between knots (n + 1,) [s] at t, the time since it began, and the time since the last knot, or zero."""
    low, high = 0, knots.shape[0] - 1
    inside = min(t, knots[high])
    while high - low > 1:
        middle = (low + high) // 2
        if knots[middle] <= t:
            low = middle
        else:
            high = middle
    return low, inside - knots[low], t - inside


@jit
def follow_ways(t, knots, ways, p, p_dot, p_ddot):
    """Slots p (N, 3) [m] on their ways at t, and their derivatives; at rest before the first knot and after the last.

    Pieces are polynomials of any degree between knots (K + 1,) [s], ``ways`` (K, N, 3, P).
    """
    low, x, beyond = piece_at(max(t, knots[0]), knots)
    moves = 1.0 if t >= knots[0] and beyond == 0.0 else 0.0
    for i in range(p.shape[0]):
        for q in range(3):
            c = ways[low, i, q]
            value = rate = second = 0.0  # Horner's scheme for a polynomial and two derivatives
            for k in range(ways.shape[3] - 1, -1, -1):
                second = second * x + 2.0 * rate
                rate = rate * x + value
                value = value * x + c[k]
            p[i, q], p_dot[i, q], p_ddot[i, q] = value, moves * rate, moves * second


@jit
def blend_slots(t, reference, p, p_dot, p_ddot):
    """Slots p (N, 3) [m] in body axes at t, and their derivatives, by a blend or on their ways.

    p = R(s turn) (p0 + s dp): the shape moves on straight lines while it turns about one axis, so
    that reshaping by a Kabsch-aligned ``dp`` need not change the commanded attitude.
    """
    if reference.knots.shape[0] > 0:
        follow_ways(t, reference.knots, reference.ways, p, p_dot, p_ddot)
        return
    s, s_dot, s_ddot = septic(t, reference.t0, reference.T_b)
    n = reference.turn
    angle = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
    if angle == 0.0:
        for i in range(p.shape[0]):
            for q in range(3):
                p[i, q] = reference.p0[i, q] + s * reference.dp[i, q]
                p_dot[i, q] = s_dot * reference.dp[i, q]
                p_ddot[i, q] = s_ddot * reference.dp[i, q]
        return
    e0, e1, e2 = n[0] / angle, n[1] / angle, n[2] / angle
    cos, sin = math.cos(s * angle), math.sin(s * angle)
    w, w_dot = angle * s_dot, angle * s_ddot
    for i in range(p.shape[0]):
        # The shape and its velocity without the rotation; then both are rotated by Rodrigues' formula.
        x = reference.p0[i, 0] + s * reference.dp[i, 0]
        y = reference.p0[i, 1] + s * reference.dp[i, 1]
        z = reference.p0[i, 2] + s * reference.dp[i, 2]
        k = (e0 * x + e1 * y + e2 * z) * (1.0 - cos)
        X = cos * x + sin * (e1 * z - e2 * y) + k * e0
        Y = cos * y + sin * (e2 * x - e0 * z) + k * e1
        Z = cos * z + sin * (e0 * y - e1 * x) + k * e2
        x, y, z = reference.dp[i, 0], reference.dp[i, 1], reference.dp[i, 2]
        k = (e0 * x + e1 * y + e2 * z) * (1.0 - cos)
        dX = cos * x + sin * (e1 * z - e2 * y) + k * e0
        dY = cos * y + sin * (e2 * x - e0 * z) + k * e1
        dZ = cos * z + sin * (e0 * y - e1 * x) + k * e2
        eX, eY, eZ = e1 * Z - e2 * Y, e2 * X - e0 * Z, e0 * Y - e1 * X  # e x P
        fX, fY, fZ = e1 * dZ - e2 * dY, e2 * dX - e0 * dZ, e0 * dY - e1 * dX  # e x dP
        p[i, 0], p[i, 1], p[i, 2] = X, Y, Z
        p_dot[i, 0] = w * eX + s_dot * dX
        p_dot[i, 1] = w * eY + s_dot * dY
        p_dot[i, 2] = w * eZ + s_dot * dZ
        u = 2.0 * w * s_dot
        p_ddot[i, 0] = w_dot * eX + w * w * (e1 * eZ - e2 * eY) + u * fX + s_ddot * dX
        p_ddot[i, 1] = w_dot * eY + w * w * (e2 * eX - e0 * eZ) + u * fY + s_ddot * dY
        p_ddot[i, 2] = w_dot * eZ + w * w * (e0 * eY - e1 * eX) + u * fZ + s_ddot * dZ


@jit
def distance_references(t, reference, edges, p, p_dot, p_ddot, d, d_dot, d_ddot):
    """Desired distances d (m,) [m] and two derivatives, by the reference's kind.

    They are constant; or blended in d^2, which stays realisable for up to four agents; or those of the
    slots, d = |p_i - p_j|, which are always realisable.
    """
    if reference.kind == SHAPE:
        for k in range(edges.shape[0]):
            i, j = edges[k, 0], edges[k, 1]
            dd = dv = vv = da = 0.0
            for q in range(3):
                x, v, a = p[i, q] - p[j, q], p_dot[i, q] - p_dot[j, q], p_ddot[i, q] - p_ddot[j, q]
                dd, dv, vv, da = dd + x * x, dv + x * v, vv + v * v, da + x * a
            d[k] = math.sqrt(dd)
            d_dot[k] = dv / d[k]
            d_ddot[k] = (vv + da - d_dot[k] * d_dot[k]) / d[k]
    elif reference.kind == SQUARED:
        s, s_dot, s_ddot = septic(t, reference.t0, reference.T_b)
        for k in range(edges.shape[0]):
            before, after = reference.d0[k] * reference.d0[k], reference.d1[k] * reference.d1[k]
            d[k] = math.sqrt(before + (after - before) * s)
            d_dot[k] = 0.5 * (after - before) * s_dot / d[k]
            d_ddot[k] = (0.5 * (after - before) * s_ddot - d_dot[k] * d_dot[k]) / d[k]
    else:
        for k in range(edges.shape[0]):
            d[k] = reference.d1[k]
            d_dot[k] = 0.0
            d_ddot[k] = 0.0
