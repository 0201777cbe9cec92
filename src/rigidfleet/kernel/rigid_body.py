"""The virtual rigid body: centre of mass, mean-axis frame, quaternion kinematics, allocation."""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.linalg import is_known_positive, jacobi_eigen, where_positive
from rigidfleet.kernel.problem import PINV_EQUAL, PINV_INERTIA_FORCE, RIGID


@jit_inline
def centre_of_mass(r, m, M, out):
    """Mass-weighted mean of r (N, 3) into out (3,); M is the sum of the masses m (N,)."""
    x = y = z = 0.0
    for i in range(r.shape[0]):
        x, y, z = x + m[i] * r[i, 0], y + m[i] * r[i, 1], z + m[i] * r[i, 2]
    out[0], out[1], out[2] = x / M, y / M, z / M


@jit_inline
def inertia(r, m, cm, I):
    """Inertia I (3, 3) [kg m^2] of points r (N, 3) about cm, as in Eq. (19): sum m (|x|^2 1 - x x^T)."""
    a = b = c = d = e = f = 0.0
    # Exactly zero for a single agent: rounding errors of r - cm would have an inverse.
    for i in range(r.shape[0] if r.shape[0] > 1 else 0):
        x, y, z = r[i, 0] - cm[0], r[i, 1] - cm[1], r[i, 2] - cm[2]
        a += m[i] * (y * y + z * z)
        d += m[i] * (x * x + z * z)
        f += m[i] * (x * x + y * y)
        b -= m[i] * x * y
        c -= m[i] * x * z
        e -= m[i] * y * z
    I[0, 0], I[0, 1], I[0, 2] = a, b, c
    I[1, 0], I[1, 1], I[1, 2] = b, d, e
    I[2, 0], I[2, 1], I[2, 2] = c, e, f


@jit_inline
def inertia_inverse(I, out):
    """Pseudo-inverse of the inertia of point masses into out (3, 3), relative cut-off 1e-9.

    Points on a line have the eigenvalues 0, c, c with c = trace / 2, so that I^+ = I / c^2. This is the
    only case in which the inertia of distinct points is singular.
    """
    a, b, c = I[0, 0], I[0, 1], I[0, 2]
    d, e, f = I[1, 1], I[1, 2], I[2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    half = 0.5 * (a + d + f)
    spatial = det - 1e-9 * half * half * half
    q = 1.0 / det
    out[0, 0], out[0, 1], out[0, 2] = A * q, B * q, C * q
    out[1, 1], out[1, 2] = (a * f - c * c) * q, (b * c - a * e) * q
    out[2, 2] = (a * d - b * b) * q
    if not is_known_positive(spatial):
        q = where_positive(half, 1.0 / (half * half), 0.0)
        for i in range(3):
            for j in range(i, 3):
                out[i, j] = where_positive(spatial, out[i, j], q * I[i, j])
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@jit
def multiply(A, x, out):
    """out = A x for a (3, 3) matrix."""
    for i in range(3):
        out[i] = A[i, 0] * x[0] + A[i, 1] * x[1] + A[i, 2] * x[2]


@jit
def multiply_transposed(A, x, out):
    """out = A^T x for a (3, 3) matrix."""
    for i in range(3):
        out[i] = A[0, i] * x[0] + A[1, i] * x[1] + A[2, i] * x[2]


@jit_inline
def mean_axes(r, v, m, M, w):
    """Centre of mass, inertia and mean-axis angular velocity omega = I^+ h, world axes.

    h = sum x cross m dx/dt, Eq. (17), is of the momenta of Eq. (13). In the mean-axis (Tisserand) frame
    the first term of Eqs. (18), (19) is zero, and h = I omega: this replaces Eq. (20). Fills
    w.cm = (r_cm, v_cm, omega, h), w.I and w.I_inv.
    """
    centre_of_mass(r, m, M, w.cm[0])
    centre_of_mass(v, m, M, w.cm[1])
    inertia(r, m, w.cm[0], w.I)
    inertia_inverse(w.I, w.I_inv)
    r0, r1, r2 = w.cm[0, 0], w.cm[0, 1], w.cm[0, 2]
    v0, v1, v2 = w.cm[1, 0], w.cm[1, 1], w.cm[1, 2]
    h0 = h1 = h2 = 0.0
    for i in range(r.shape[0]):
        x, y, z = r[i, 0] - r0, r[i, 1] - r1, r[i, 2] - r2
        X, Y, Z = v[i, 0] - v0, v[i, 1] - v1, v[i, 2] - v2
        h0 += m[i] * (y * Z - z * Y)
        h1 += m[i] * (z * X - x * Z)
        h2 += m[i] * (x * Y - y * X)
    w.cm[3, 0], w.cm[3, 1], w.cm[3, 2] = h0, h1, h2
    multiply(w.I_inv, w.cm[3], w.cm[2])


@jit
def damp_deformation(r, v, m, k_def, cm, f):
    """Add -k_def m_i (v_i - v_cm - omega x (r_i - r_cm)) to f (N, 3): no net force or torque."""
    r0, r1, r2 = cm[0, 0], cm[0, 1], cm[0, 2]
    v0, v1, v2 = cm[1, 0], cm[1, 1], cm[1, 2]
    o0, o1, o2 = cm[2, 0], cm[2, 1], cm[2, 2]
    for i in range(r.shape[0]):
        x, y, z = r[i, 0] - r0, r[i, 1] - r1, r[i, 2] - r2
        k = k_def * m[i]
        f[i, 0] -= k * (v[i, 0] - v0 - (o1 * z - o2 * y))
        f[i, 1] -= k * (v[i, 1] - v1 - (o2 * x - o0 * z))
        f[i, 2] -= k * (v[i, 2] - v2 - (o0 * y - o1 * x))


@jit
def attitude_matrix(q, T):
    """T(q) (3, 3), world -> body, of a scalar-first quaternion of any length."""
    n = 1.0 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    T[0, 0] = n * (q[0] * q[0] + q[1] * q[1] - q[2] * q[2] - q[3] * q[3])
    T[0, 1] = n * 2.0 * (q[1] * q[2] + q[0] * q[3])
    T[0, 2] = n * 2.0 * (q[1] * q[3] - q[0] * q[2])
    T[1, 0] = n * 2.0 * (q[1] * q[2] - q[0] * q[3])
    T[1, 1] = n * (q[0] * q[0] - q[1] * q[1] + q[2] * q[2] - q[3] * q[3])
    T[1, 2] = n * 2.0 * (q[2] * q[3] + q[0] * q[1])
    T[2, 0] = n * 2.0 * (q[1] * q[3] + q[0] * q[2])
    T[2, 1] = n * 2.0 * (q[2] * q[3] - q[0] * q[1])
    T[2, 2] = n * (q[0] * q[0] - q[1] * q[1] - q[2] * q[2] + q[3] * q[3])


@jit
def quaternion_rate(q, omega, out):
    """Rotational kinematics, Eq. (21): out (4,) = 1/2 Omega(omega) q, omega in body axes."""
    P, Q, R = omega[0], omega[1], omega[2]
    out[0] = 0.5 * (-P * q[1] - Q * q[2] - R * q[3])
    out[1] = 0.5 * (P * q[0] + R * q[2] - Q * q[3])
    out[2] = 0.5 * (Q * q[0] - R * q[1] + P * q[3])
    out[3] = 0.5 * (R * q[0] + Q * q[1] - P * q[2])


@jit
def rotation_vector(R, phi):
    """Log of a rotation matrix R = Exp(phi) into phi (3,) [rad], |phi| <= pi."""
    # From the quaternion's largest component, which is well conditioned at every angle.
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace >= R[0, 0] and trace >= R[1, 1] and trace >= R[2, 2]:
        w = 1.0 + trace
        x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        w = R[2, 1] - R[1, 2]
        x, y, z = 1.0 + R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]
    elif R[1, 1] >= R[2, 2]:
        w = R[0, 2] - R[2, 0]
        x, y, z = R[1, 0] + R[0, 1], 1.0 + R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2]
    else:
        w = R[1, 0] - R[0, 1]
        x, y, z = R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], 1.0 + R[2, 2] - R[0, 0] - R[1, 1]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-150 else 0.0
    phi[0], phi[1], phi[2] = scale * x, scale * y, scale * z


@jit
def allocate_rigid(x, m, M, F, tau, omega, I, I_inv, f):
    """Distribute a wrench among agents as in a rigid body, without internal forces.

    f_i = m_i (F/M + alpha x x_i + omega x (omega x x_i)), alpha = I^+ (tau - omega x I omega).

    Parameters: x (N, 3) positions about the CM [m], m (N,) and
    their sum M, F and tau (3,) [N, N m], omega (3,)
    [rad/s], I and I_inv (3, 3), all in the same axes; f (N, 3) [N] is written.
    """
    o = omega
    h0 = I[0, 0] * o[0] + I[0, 1] * o[1] + I[0, 2] * o[2]
    h1 = I[1, 0] * o[0] + I[1, 1] * o[1] + I[1, 2] * o[2]
    h2 = I[2, 0] * o[0] + I[2, 1] * o[1] + I[2, 2] * o[2]
    t0 = tau[0] - (o[1] * h2 - o[2] * h1)
    t1 = tau[1] - (o[2] * h0 - o[0] * h2)
    t2 = tau[2] - (o[0] * h1 - o[1] * h0)
    a0 = I_inv[0, 0] * t0 + I_inv[0, 1] * t1 + I_inv[0, 2] * t2
    a1 = I_inv[1, 0] * t0 + I_inv[1, 1] * t1 + I_inv[1, 2] * t2
    a2 = I_inv[2, 0] * t0 + I_inv[2, 1] * t1 + I_inv[2, 2] * t2
    for i in range(x.shape[0]):
        X, Y, Z = x[i, 0], x[i, 1], x[i, 2]
        c0, c1, c2 = o[1] * Z - o[2] * Y, o[2] * X - o[0] * Z, o[0] * Y - o[1] * X
        f[i, 0] = m[i] * (F[0] / M + a1 * Z - a2 * Y + o[1] * c2 - o[2] * c1)
        f[i, 1] = m[i] * (F[1] / M + a2 * X - a0 * Z + o[2] * c0 - o[0] * c2)
        f[i, 2] = m[i] * (F[2] / M + a0 * Y - a1 * X + o[0] * c1 - o[1] * c0)


@jit
def allocate_pinv(x, m, M, F, tau, split, I, I_inv, f, H, V, work):
    """The paper's input decoupling, Eqs. (24)-(27): f = H^+ [F; tau_1; ...; tau_N].

    H^T H is always singular (forces along m_i x_i that sum to zero lie in its null space), so its
    inverse is a pseudo-inverse here, with relative cut-off 1e-12. The torque is split among the
    agents as tau / N (``PINV_EQUAL``), by their share of inertia I_i I^+ tau
    (``PINV_INERTIA``), or that plus x_i x m_i F/M, the torque of their share of the force.
    The resulting wrench differs from the commanded one: see theory in the documentation.

    H (3N, 3N), V (3N, 3N) and work (2, 3N) are scratch; other arguments as in `allocate_rigid`.
    """
    n = x.shape[0]
    b, values = work[0], work[1]
    a0 = I_inv[0, 0] * tau[0] + I_inv[0, 1] * tau[1] + I_inv[0, 2] * tau[2]
    a1 = I_inv[1, 0] * tau[0] + I_inv[1, 1] * tau[1] + I_inv[1, 2] * tau[2]
    a2 = I_inv[2, 0] * tau[0] + I_inv[2, 1] * tau[1] + I_inv[2, 2] * tau[2]
    for i in range(n):
        X, Y, Z = x[i, 0], x[i, 1], x[i, 2]
        if split == PINV_EQUAL:
            t0, t1, t2 = tau[0] / n, tau[1] / n, tau[2] / n
        else:
            square, along = X * X + Y * Y + Z * Z, X * a0 + Y * a1 + Z * a2
            t0 = m[i] * (square * a0 - along * X)
            t1 = m[i] * (square * a1 - along * Y)
            t2 = m[i] * (square * a2 - along * Z)
            if split == PINV_INERTIA_FORCE:
                k = m[i] / M
                t0 += k * (Y * F[2] - Z * F[1])
                t1 += k * (Z * F[0] - X * F[2])
                t2 += k * (X * F[1] - Y * F[0])
        # H^T H = [1 ... 1]^T [1 ... 1] + blockdiag([x_i]^T [x_i]),  H^T rhs = F - x_i x tau_i.
        b[3 * i] = F[0] - (Y * t2 - Z * t1)
        b[3 * i + 1] = F[1] - (Z * t0 - X * t2)
        b[3 * i + 2] = F[2] - (X * t1 - Y * t0)
        for j in range(n):
            for q in range(3):
                for p in range(3):
                    H[3 * i + q, 3 * j + p] = 1.0 if p == q else 0.0
        square = X * X + Y * Y + Z * Z
        for q in range(3):
            H[3 * i + q, 3 * i + q] += square
            for p in range(3):
                H[3 * i + q, 3 * i + p] -= x[i, q] * x[i, p]
    largest = jacobi_eigen(H, V, values)
    f[:] = 0.0
    for q in range(3 * n):
        if values[q] > 1e-12 * largest:
            s = 0.0
            for k in range(3 * n):
                s += V[k, q] * b[k]
            s /= values[q]
            for k in range(3 * n):
                f[k // 3, k % 3] += s * V[k, q]


@jit
def allocate(x, m, M, F, tau, omega, method, I, I_inv, f, H, V, work):
    """Distribute a wrench among the agents by the named method; see the two functions above."""
    if method == RIGID:
        allocate_rigid(x, m, M, F, tau, omega, I, I_inv, f)
    else:
        allocate_pinv(x, m, M, F, tau, method, I, I_inv, f, H, V, work)
