"""What follows from the recorded positions and forces of a flight: attitude, rates, wrench and thrust.

One pass over all samples. Attitudes are those of the formation's slots, fitted to the agents (Wahba's problem): the
quaternion is the eigenvector of the largest eigenvalue of Davenport's matrix K, found as in QUEST by Newton's method
on the characteristic polynomial (Shuster and Oh 1981, doi:10.2514/3.19717; Theobald 2005,
doi:10.1107/S0108767305015266).
"""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_exact
from rigidfleet.kernel.linalg import copy, copy_vector, jacobi_eigen
from rigidfleet.kernel.rigid_body import (
    attitude_matrix,
    centre_of_mass,
    inertia,
    inertia_inverse,
    multiply,
    multiply_transposed,
)

#: Slots thinner than this, relative to their length, count as a line in an attitude fit.
_THIN = 1e-3
#: Slots narrower than the first count as a line unless their width exceeds the agents' errors by the second factor.
_NARROW, _SURE = 0.1, 4.0
#: A rotation counts as half a turn if 1 + cos of its angle is smaller: within 1e-8 rad.
_HALF_TURN = 5e-17
#: Share of K's size, to the third power, below which the product of the gaps between its largest eigenvalue and the
#: others is too small for the root of a polynomial; the error grows with the inverse square of the gap.
_MULTIPLE = 0.03


@jit
def fit_quaternion(B, bound, K, V, w, q):
    """Unit quaternion q (4,) of the rotation T that maximises tr(T B^T), B = sum m p x^T (3, 3).

    ``bound`` is the maximum, or little more: sum m (p^2 + x^2) / 2 is, if the points nearly fit.
    """
    trace = B[0, 0] + B[1, 1] + B[2, 2]
    a, b, c = B[1, 2] - B[2, 1], B[2, 0] - B[0, 2], B[0, 1] - B[1, 0]
    size = 0.0
    for i in range(3):
        for j in range(3):
            size += B[i, j] * B[i, j]
            K[1 + i, 1 + j] = B[i, j] + B[j, i]
        K[1 + i, 1 + i] -= trace
    K[0, 0], K[0, 1], K[0, 2], K[0, 3] = trace, a, b, c
    K[1, 0], K[2, 0], K[3, 0] = a, b, c
    # det (K - x) = x^4 - 2 |B|^2 x^2 - 8 det B x + det K: Newton's method, from above all roots.
    det = (
        B[0, 0] * (B[1, 1] * B[2, 2] - B[1, 2] * B[2, 1])
        - B[0, 1] * (B[1, 0] * B[2, 2] - B[1, 2] * B[2, 0])
        + B[0, 2] * (B[1, 0] * B[2, 1] - B[1, 1] * B[2, 0])
    )
    second, first = -2.0 * size, -8.0 * det
    last = determinant_4x4(K)
    x = min(math.sqrt(3.0 * size), bound)
    for _ in range(60):
        square = x * x
        value = (square + second) * square + first * x + last
        slope = (4.0 * square + 2.0 * second) * x + first
        step = value / slope if slope > 0.0 else 0.0
        x -= step
        if not abs(step) > 1e-15 * x:
            break
    for i in range(4):
        K[i, i] -= x
    # The eigenvector is a column of the adjugate; the longest one is accurate.
    most = 0.0
    for i in range(4):
        length = write_4x4_cofactor_row(K, i, V[1])
        if length > most:
            most = length
            copy_vector(V[1], q)
    if most > (_MULTIPLE * size * math.sqrt(size)) ** 2:
        scale = 1.0 / math.sqrt(most)
        for j in range(4):
            q[j] *= scale
        return
    # Several rotations fit almost equally well
    for i in range(4):
        K[i, i] += x
    largest, at = jacobi_eigen(K, V, w), 0
    for i in range(4):
        if w[i] == largest:
            at = i
    for j in range(4):
        q[j] = V[j, at]


@jit
def write_4x4_cofactor_row(K, i, out):
    """Row i of the cofactors of K (4, 4) into out (4,); returns the square of their length."""
    a, b, c = K[0], K[1], K[2]
    if i < 3:
        c = K[3]
    if i < 2:
        b = K[2]
    if i < 1:
        a = K[1]
    sign, total = 1.0 if i % 2 == 0 else -1.0, 0.0
    for j in range(4):
        k, l, m = 0 if j > 0 else 1, 1 if j > 1 else 2, 2 if j > 2 else 3
        minor = (
            a[k] * (b[l] * c[m] - b[m] * c[l])
            - a[l] * (b[k] * c[m] - b[m] * c[k])
            + a[m] * (b[k] * c[l] - b[l] * c[k])
        )
        out[j] = sign * minor
        sign = -sign
        total += minor * minor
    return total


@jit
def determinant_4x4(K):
    """Determinant of K (4, 4)."""
    s0, s1 = K[0, 0] * K[1, 1] - K[1, 0] * K[0, 1], K[0, 0] * K[1, 2] - K[1, 0] * K[0, 2]
    s2, s3 = K[0, 0] * K[1, 3] - K[1, 0] * K[0, 3], K[0, 1] * K[1, 2] - K[1, 1] * K[0, 2]
    s4, s5 = K[0, 1] * K[1, 3] - K[1, 1] * K[0, 3], K[0, 2] * K[1, 3] - K[1, 2] * K[0, 3]
    c5, c4 = K[2, 2] * K[3, 3] - K[3, 2] * K[2, 3], K[2, 1] * K[3, 3] - K[3, 1] * K[2, 3]
    c3, c2 = K[2, 1] * K[3, 2] - K[3, 1] * K[2, 2], K[2, 0] * K[3, 3] - K[3, 0] * K[2, 3]
    c1, c0 = K[2, 0] * K[3, 2] - K[3, 0] * K[2, 2], K[2, 0] * K[3, 1] - K[3, 0] * K[2, 1]
    return s0 * c5 - s1 * c4 + s2 * c3 + s3 * c2 - s4 * c1 + s5 * c0


@jit
def write_matrix_quaternion(T, q):
    """Unit quaternion q (4,) of a rotation T (3, 3): the longest column of 4 q q^T."""
    a, b, c = T[0, 0], T[1, 1], T[2, 2]
    q0, q1, q2, q3 = 1.0 + a + b + c, 1.0 + a - b - c, 1.0 - a + b - c, 1.0 - a - b + c
    x, y, z = T[1, 2] - T[2, 1], T[2, 0] - T[0, 2], T[0, 1] - T[1, 0]
    f, g, h = T[0, 1] + T[1, 0], T[0, 2] + T[2, 0], T[1, 2] + T[2, 1]
    if q0 >= q1 and q0 >= q2 and q0 >= q3:
        q[0], q[1], q[2], q[3] = q0, x, y, z
    elif q1 >= q2 and q1 >= q3:
        q[0], q[1], q[2], q[3] = x, q1, f, g
    elif q2 >= q3:
        q[0], q[1], q[2], q[3] = y, f, q2, h
    else:
        q[0], q[1], q[2], q[3] = z, g, h, q3
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for k in range(4):
        q[k] *= scale


@jit
def choose_sign_and_write_last(q, last):
    """Choose the sign of a quaternion q (4,): no jump from the one before, ``last``, or else q0 >= 0."""
    if math.isnan(q[0] + q[1] + q[2] + q[3]):
        return
    along = 0.0
    for k in range(4):
        along += q[k] * last[k]
    if along < 0.0:
        for k in range(4):
            q[k] = -q[k]
    copy_vector(q, last)


@jit
def width_length_and_axis(p, mass, C, V, w, axis):
    """Width and length of slots p (N, 3) of a ``mass`` (N,); the direction of the length into ``axis`` (3,).

    For slots too wide to be a line, two numbers with a ratio that shows this, and no axis.
    """
    C[:] = 0.0  # a fit before may have used a fourth row
    for a in range(3):
        axis[a] = 0.0
        for b in range(a + 1):
            s = 0.0
            for i in range(p.shape[0]):
                s += mass[i] * p[i, a] * p[i, b]
            C[a, b] = C[b, a] = s
    # Eigenvalues a >= b >= c of C: with s = a + b + c, b >= (ab + ac + bc) / 3s.
    s, square = C[0, 0] + C[1, 1] + C[2, 2], 0.0
    for a in range(3):
        for b in range(3):
            square += C[a, b] * C[a, b]
    length = math.sqrt(s)
    width = math.sqrt(max(s * s - square, 0.0) / (6.0 * s)) if s > 0.0 else 0.0
    if width > _NARROW * length:
        return width, length
    jacobi_eigen(C, V, w)
    k = 0
    for a in range(1, 3):
        if w[a] > w[k]:
            k = a
    for a in range(3):
        axis[a] = V[a, k]
    second = max(w[0] if k != 0 else w[1], w[2] if k != 2 else w[1])
    return math.sqrt(max(second, 0.0)), math.sqrt(max(w[k], 0.0))


@jit
def write_attitude_of_line(x, p, mass, axis, near, T, now, scratch, across):
    """Attitude T (3, 3) of a line: ``near``, followed by the smallest rotation that lays its axis along the agents."""
    scratch[:] = 0.0
    for i in range(x.shape[0]):
        along = p[i, 0] * axis[0] + p[i, 1] * axis[1] + p[i, 2] * axis[2]
        along = along if mass[i] > 0.0 else 0.0  # agents that are lost do not count
        for a in range(3):
            scratch[a] += along * x[i, a]
    length = math.sqrt(scratch[0] ** 2 + scratch[1] ** 2 + scratch[2] ** 2)
    if length == 0.0:
        copy(near, T)
        return
    multiply_transposed(near, axis, now)
    close = square = 0.0  # 1 + c with the cosine c of the angle, accurate up to half a turn
    for a in range(3):
        scratch[a] /= length
        close += 0.5 * (now[a] + scratch[a]) ** 2
    if close < _HALF_TURN:
        # Half a turn, about any axis perpendicular to the line: R = 2 n n^T - 1
        k = 0
        for a in range(1, 3):
            if abs(now[a]) < abs(now[k]):
                k = a
        i, j = (k + 1) % 3, (k + 2) % 3
        scale = 1.0 / math.sqrt(now[i] * now[i] + now[j] * now[j])
        across[k], across[i], across[j] = 0.0, now[j] * scale, -now[i] * scale
        for a in range(3):
            s = near[a, 0] * across[0] + near[a, 1] * across[1] + near[a, 2] * across[2]
            for b in range(3):
                T[a, b] = 2.0 * s * across[b] - near[a, b]
        return
    # T = near R^T with R = 1 + [n x] + [n x]^2 / (1 + c), n = now x there
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        across[a] = now[b] * scratch[c] - now[c] * scratch[b]
        square += across[a] * across[a]
    for k in range(3):
        along = near[k, 0] * across[0] + near[k, 1] * across[1] + near[k, 2] * across[2]
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            T[k, a] = near[k, a] - (near[k, b] * across[c] - near[k, c] * across[b])
            T[k, a] += (along * across[a] - square * near[k, a]) / close


@jit
def write_inertia_inverse_of_line(I, scratch_matrix, scratch_axis, out):
    """Pseudo-inverse of an inertia I (3, 3) into out, without the spin of a line about itself.

    ``scratch_matrix`` (3, 3) and ``scratch_axis`` (3,) are scratch.
    """
    first = I[0, 0] + I[1, 1] + I[2, 2]
    second = I[0, 0] * I[1, 1] + I[0, 0] * I[2, 2] + I[1, 1] * I[2, 2]
    second -= I[0, 1] * I[0, 1] + I[0, 2] * I[0, 2] + I[1, 2] * I[1, 2]
    third = write_eigenvector_of_value(I, 0.0, scratch_axis)
    if not second > 0.0:
        out[:] = 0.0
        return
    # det (I - x) = -x^3 + first x^2 - second x + third: Newton's method, from below all roots.
    x = 0.0
    for _ in range(60):
        slope = second - (2.0 * first - 3.0 * x) * x
        step = (third - (second - (first - x) * x) * x) / slope if slope > 0.0 else 0.0
        x += step
        if not abs(step) > 1e-15 * first:
            break
    half = 0.5 * (first - x)
    largest = half + math.sqrt(max(half * half - (second - 2.0 * x * half), 0.0))
    if x > _NARROW * _NARROW * largest:
        inertia_inverse(I, out)
        return
    # I + largest n n^T, n the axis of the least inertia, has no small eigenvalue.
    write_eigenvector_of_value(I, x, scratch_axis)
    for a in range(3):
        for b in range(3):
            scratch_matrix[a, b] = I[a, b] + largest * scratch_axis[a] * scratch_axis[b]
    inertia_inverse(scratch_matrix, out)
    for a in range(3):
        for b in range(3):
            out[a, b] -= scratch_axis[a] * scratch_axis[b] / (x + largest)


@jit
def write_eigenvector_of_value(I, x, axis):
    """Unit eigenvector of symmetric I (3, 3) for its simple eigenvalue x, into axis (3,); returns det (I - x)."""
    a, d, f = I[0, 0] - x, I[1, 1] - x, I[2, 2] - x
    b, c, e = I[0, 1], I[0, 2], I[1, 2]
    # It is any column of the adjugate; the longest is accurate.
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    if A >= D and A >= F:
        axis[0], axis[1], axis[2] = A, B, C
    elif D >= F:
        axis[0], axis[1], axis[2] = B, D, E
    else:
        axis[0], axis[1], axis[2] = C, E, F
    size = vector_length(axis[0], axis[1], axis[2])
    for k in range(3):
        axis[k] /= size
    return a * A + b * B + c * C


@jit
def measure_slot_attitude(m, sample, is_commanded, line_known, prior, work, T):
    """Attitude of the slots at a sample into ``m.attitude`` and T (3, 3); returns whether they count as a line.

    ``prior`` (3, 3) is the attitude expected, commanded (``is_commanded``) or that of the sample before. ``line_known``
    tells that the slots are those of the sample before, whose extent is in ``work[7]``.
    """
    x, p, mass = m.x[0], m.x[1], m.left
    B, K, V, w, axis, size = work[0], work[1], work[2], work[3, 0], work[7, 0], work[7, 1]
    n = x.shape[0]
    if not line_known:
        size[0], size[1] = width_length_and_axis(p, mass, K, V, w, axis)
    width, length = size[0], size[1]
    line = width <= _THIN * length
    if line or (is_commanded and width <= _NARROW * length):
        write_attitude_of_line(x, p, mass, axis, prior, T, work[3, 1], work[3, 2], work[3, 3])
        if not line:
            off = 0.0
            for i in range(n):
                for a in range(3):
                    d = x[i, a] - (p[i, 0] * T[0, a] + p[i, 1] * T[1, a] + p[i, 2] * T[2, a])
                    off += mass[i] * d * d
            line = width <= _SURE * math.sqrt(off)
        if line:
            write_matrix_quaternion(T, m.attitude[sample])
            return True
    bound = 0.0
    for a in range(3):
        for b in range(3):
            s = 0.0
            for i in range(n):
                s += mass[i] * p[i, a] * x[i, b]
            B[a, b] = s
        for i in range(n):
            bound += 0.5 * mass[i] * (p[i, a] * p[i, a] + x[i, a] * x[i, a])
    fit_quaternion(B, bound, K, V, w, m.attitude[sample])
    attitude_matrix(m.attitude[sample], T)
    return False


@jit
def measure_samples(m):
    """Measure all samples."""
    n, work = m.mass.shape[0], m.work
    T, near, last = work[4], work[5], work[6]
    centre, zero = work[7, 2], work[7, 3]
    I, inverse, h, omega = work[0], work[1], work[3, 0], work[3, 1]
    last[:] = 0.0
    last[0, 0] = last[1, 0] = 1.0
    mass = m.left
    for piece in range(m.attached.shape[0]):
        first = m.start[piece]
        commanded = first < m.start[piece + 1] and not math.isnan(m.T_ref[first, 0, 0])
        for k in range(first, m.start[piece + 1]):
            M, left = 0.0, 0
            for i in range(n):
                mass[i] = m.mass[i] if m.time[k] <= m.lost_at[i] else 0.0
                M += mass[i]
                left += 1 if mass[i] > 0.0 else 0
            same = k > first
            if same:
                for i in range(n):
                    for a in range(3):
                        same = same and m.p[k, i, a] == m.p[k - 1, i, a]
            measure_cm_and_wrench(m, k, mass, M)
            line = False
            if m.attached[piece]:
                centre_of_mass(m.p[k], mass, M, centre)
                for i in range(n):
                    for a in range(3):
                        m.x[1, i, a] = m.p[k, i, a] - centre[a]
                if commanded:
                    copy(m.T_ref[k], near)
                line = m.line[k] = measure_slot_attitude(m, k, commanded, same, near, work, T)
                copy(T, near)
            elif m.framed:
                copy_vector(m.frame[k], m.attitude[k])
                attitude_matrix(m.attitude[k], T)
            else:
                m.attitude[k] = math.nan
            choose_sign_and_write_last(m.attitude[k], last[0])
            if not math.isnan(m.T_ref[k, 0, 0]):
                write_matrix_quaternion(m.T_ref[k], m.attitude_reference[k])
                choose_sign_and_write_last(m.attitude_reference[k], last[1])
            if k == 0 or math.isnan(last[2, 0]):
                copy_vector(m.frame[k], last[2])
            choose_sign_and_write_last(m.frame[k], last[2])
            write_angular_momentum(m, k, mass, h)
            inertia(m.x[0], mass, zero, I)
            if line:
                write_inertia_inverse_of_line(I, work[8], work[3, 2], inverse)
            else:
                inertia_inverse(I, inverse)
            multiply(inverse, h, omega)
            if left < 2:
                omega[0] = omega[1] = omega[2] = 0.0
            if math.isnan(m.attitude[k, 0]):
                m.rates[k] = math.nan
            else:
                multiply(T, omega, m.rates[k])
                if left < n:
                    move_cm_of_incomplete_body(m, k, T, centre, omega, h)


@jit
def move_cm_of_incomplete_body(m, k, T, centre, omega, offset):
    """Move the centre of mass of the agents left to the origin of the body, of which some agents are missing."""
    multiply_transposed(T, centre, offset)
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        m.cm[k, a] -= offset[a]
        m.cm_velocity[k, a] -= omega[b] * offset[c] - omega[c] * offset[b]


@jit_exact
def vector_length(x, y, z):
    """Length of a vector."""
    return math.sqrt(x * x + y * y + z * z)


@jit
def measure_cm_and_wrench(m, k, mass, M):
    """Centre of mass, wrench, thrust and distances at sample k; agents about their centre of mass into ``m.x``."""
    r, v, f, g = m.r[k], m.v[k], m.f_u[k], m.f_C[k]
    n = r.shape[0]
    centre_of_mass(r, mass, M, m.cm[k])
    centre_of_mass(v, mass, M, m.cm_velocity[k])
    m.wrench[k] = 0.0
    for i in range(n):
        for a in range(3):
            m.x[0, i, a] = r[i, a] - m.cm[k, a]
            m.wrench[k, a] += f[i, a]
        thrust = vector_length(f[i, 0] + g[i, 0], f[i, 1] + g[i, 1], f[i, 2] + g[i, 2])
        m.thrust[k, i] = m.limit[i] if thrust > m.limit[i] else thrust
        x, y, z = m.x[0, i, 0], m.x[0, i, 1], m.x[0, i, 2]
        m.wrench[k, 3] += y * f[i, 2] - z * f[i, 1]
        m.wrench[k, 4] += z * f[i, 0] - x * f[i, 2]
        m.wrench[k, 5] += x * f[i, 1] - y * f[i, 0]
    for e in range(m.edges.shape[0]):
        i, j = m.edges[e, 0], m.edges[e, 1]
        x, y, z = r[i, 0] - r[j, 0], r[i, 1] - r[j, 1], r[i, 2] - r[j, 2]
        both = mass[i] > 0.0 and mass[j] > 0.0
        m.distance[k, e] = vector_length(x, y, z) if both else math.nan


@jit
def write_angular_momentum(m, sample, mass, h):
    """h = sum m x cross v about the centre of mass at a sample, Eq. (17), into h (3,)."""
    V, v, x = m.cm_velocity[sample], m.v[sample], m.x[0]
    h[0] = h[1] = h[2] = 0.0
    for i in range(x.shape[0]):
        X, Y, Z = v[i, 0] - V[0], v[i, 1] - V[1], v[i, 2] - V[2]
        h[0] += mass[i] * (x[i, 1] * Z - x[i, 2] * Y)
        h[1] += mass[i] * (x[i, 2] * X - x[i, 0] * Z)
        h[2] += mass[i] * (x[i, 0] * Y - x[i, 1] * X)
