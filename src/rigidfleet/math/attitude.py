"""Attitude: quaternions, direction cosines, Euler angles, rotation vectors.

Conventions, which are the paper's where it states them:

- A quaternion q = (q0, q1, q2, q3) has its scalar first; T(q) takes world axes to body axes.
- Euler angles are (roll, pitch, yaw) [rad] of the 3-2-1 sequence, T = R1(roll) R2(pitch) R3(yaw);
  the paper does not state its sequence.
- A rotation vector phi [rad] turns the world axes into the body axes: T = exp(-[phi x]). At the
  constant body rates omega, phi = omega t.

All functions take any leading axes, and give NaN where their input is NaN: a formation has no
attitude before its frame is attached. Those that plans call for single rotations compute these in
plain numbers, in a tenth of the time that arrays so small take.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.renamed import getattr_of_earlier_names
from rigidfleet.typing import Floats


def dcm_from_quaternion(q: ArrayLike) -> Floats:
    """Direction cosines T(q) (..., 3, 3), world to body, of quaternions (..., 4).

    The quaternions need not be of unit length. Raises ValueError if one is zero.
    """
    q = _unit_quaternions(q)
    q0, q1, q2, q3 = (q[..., k] for k in range(4))
    rows = [
        [q0**2 + q1**2 - q2**2 - q3**2, 2 * (q1 * q2 + q0 * q3), 2 * (q1 * q3 - q0 * q2)],
        [2 * (q1 * q2 - q0 * q3), q0**2 - q1**2 + q2**2 - q3**2, 2 * (q2 * q3 + q0 * q1)],
        [2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), q0**2 - q1**2 - q2**2 + q3**2],
    ]
    return _matrices_of_entries(rows)


def _dcm_to_quaternion_products_map() -> Floats:
    """4 q q^T - 1 (4, 4) of a rotation T (3, 3), which is linear in T: the map (9, 16)."""
    N = np.zeros((3, 3, 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        N[i, i, 0, 0] = N[i, i, i + 1, i + 1] = 1.0
        N[j, j, i + 1, i + 1] = N[k, k, i + 1, i + 1] = -1.0
        N[j, k, 0, i + 1] = N[j, k, i + 1, 0] = 1.0
        N[k, j, 0, i + 1] = N[k, j, i + 1, 0] = -1.0
        N[
            [j, k, j, k], [k, j, k, j], [j + 1, j + 1, k + 1, k + 1], [k + 1, k + 1, j + 1, j + 1]
        ] = 1.0
    return N.reshape(9, 16)


_PRODUCTS, _ONE = _dcm_to_quaternion_products_map(), np.eye(4)


def quaternion_from_dcm(T: ArrayLike) -> Floats:
    """Unit quaternions (..., 4) with q0 >= 0 of direction cosines (..., 3, 3).

    Computed from the largest component, so that no small number is a divisor. Raises ValueError if T is
    not a rotation to 1e-6.
    """
    T = _check_last_axes("T", T, 3, 3)
    if T.ndim == 2:
        return np.array(_quaternion_of_entries(*T.ravel().tolist()))
    N = (T.reshape(-1, 9) @ _PRODUCTS).reshape(-1, 4, 4) + _ONE  # 4 q q^T
    largest = N.reshape(-1, 16)[:, ::5].argmax(axis=1)
    q = N[np.arange(len(N)), largest]
    q = q / np.sqrt((q * q).sum(axis=-1, keepdims=True))
    if (np.abs(N - 4.0 * q[:, :, None] * q[:, None, :]) > _DRIFT).any():  # NaN stays NaN
        raise ValueError(_DRIFTED)
    return _scalar_positive(q.reshape(*T.shape[:-2], 4))


#: Greatest error of 4 q q^T, for a drift of 1e-6 in T T^T.
_DRIFT = 1.5e-6
_DRIFTED = (
    "T is not a rotation (T T^T = 1 to 1e-6 and det T = +1): a mirror image or a matrix"
    " that has drifted has no quaternion; orthonormalise its rows first"
)


def _quaternion_of_entries(
    a: float, b: float, c: float, d: float, e: float, f: float, g: float, h: float, i: float
) -> tuple[float, float, float, float]:
    """`quaternion_from_dcm` of one T, with rows (a, b, c), (d, e, f), (g, h, i)."""
    wx, wy, wz, xy, xz, yz = f - h, g - c, b - d, b + d, c + g, f + h
    ww, xx, yy, zz = squares = 1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i
    rows = (ww, wx, wy, wz), (wx, xx, xy, xz), (wy, xy, yy, yz), (wz, xz, yz, zz)
    w, x, y, z = rows[squares.index(max(squares))]
    size = math.sqrt(w * w + x * x + y * y + z * z)
    size = -size if w < 0.0 else size
    w, x, y, z = w / size, x / size, y / size, z / size
    for N, q, p in (
        (ww, w, w), (xx, x, x), (yy, y, y), (zz, z, z), (wx, w, x), (wy, w, y), (wz, w, z), (xy, x, y), (xz, x, z),
        (yz, y, z),
    ):  # fmt: skip
        if abs(N - 4.0 * q * p) > _DRIFT:
            raise ValueError(_DRIFTED)
    return w, x, y, z


def dcm_from_euler(euler: ArrayLike) -> Floats:
    """Direction cosines (..., 3, 3) of Euler angles (..., 3) = (roll, pitch, yaw) [rad]."""
    angles = np.moveaxis(_check_last_axes("euler", euler, 3), -1, 0)
    sr, sp, sy = np.sin(angles)
    cr, cp, cy = np.cos(angles)
    rows = [
        [cp * cy, cp * sy, -sp],
        [sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp],
        [cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp],
    ]
    return _matrices_of_entries(rows)


def euler_from_dcm(T: ArrayLike) -> Floats:
    """Euler angles (..., 3) = (roll, pitch, yaw) [rad] of direction cosines (..., 3, 3).

    Roll and yaw lie in [-pi, pi], pitch in [-pi/2, pi/2]. At pitch = +-90 deg only the sum or
    difference of roll and yaw is defined; roll is then 0. The angles always reproduce T to rounding.
    """
    T = _check_last_axes("T", T, 3, 3)
    cos_pitch = np.hypot(T[..., 0, 0], T[..., 0, 1])
    pitch = np.arctan2(-T[..., 0, 2], cos_pitch)
    locked = cos_pitch < 1e-14
    yaw = np.where(
        locked, np.arctan2(-T[..., 1, 0], T[..., 1, 1]), np.arctan2(T[..., 0, 1], T[..., 0, 0])
    )
    # From T R3(yaw)^T = R1 R2, in which no small cos(pitch) multiplies the roll terms.
    s, c = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(s * T[..., 2, 0] - c * T[..., 2, 1], c * T[..., 1, 1] - s * T[..., 1, 0])
    return np.stack([np.where(locked, 0.0, roll), pitch, yaw], axis=-1)


def quaternion_from_euler(euler: ArrayLike) -> Floats:
    """Unit quaternions (..., 4) with q0 >= 0 of Euler angles (..., 3) = (roll, pitch, yaw) [rad]."""
    return quaternion_from_dcm(dcm_from_euler(euler))


def euler_from_quaternion(q: ArrayLike) -> Floats:
    """Euler angles (..., 3) = (roll, pitch, yaw) [rad] of quaternions (..., 4); see `euler_from_dcm`."""
    return euler_from_dcm(dcm_from_quaternion(q))


def quaternion_rate(q: ArrayLike, omega: ArrayLike) -> Floats:
    """Rate (..., 4) [1/s] of quaternions (..., 4) at body rates omega (..., 3) = (p, q, r) [rad/s].

    qdot = 1/2 Omega(omega) q, Eq. (21); the same as 1/2 q (0, omega), and as
    Tdot = -[omega x] T.
    """
    omega = _check_last_axes("omega", omega, 3)
    zero = np.zeros((*omega.shape[:-1], 1))
    return 0.5 * quaternion_multiply(q, np.concatenate([zero, omega], axis=-1))


def quaternion_multiply(p: ArrayLike, q: ArrayLike) -> Floats:
    """Hamilton's product p q (..., 4): T(p q) = T(q) T(p), first p, then q from there."""
    p0, p1, p2, p3 = np.moveaxis(_check_last_axes("p", p, 4), -1, 0)
    q0, q1, q2, q3 = np.moveaxis(_check_last_axes("q", q, 4), -1, 0)
    product = [
        p0 * q0 - p1 * q1 - p2 * q2 - p3 * q3,
        p0 * q1 + p1 * q0 + p2 * q3 - p3 * q2,
        p0 * q2 - p1 * q3 + p2 * q0 + p3 * q1,
        p0 * q3 + p1 * q2 - p2 * q1 + p3 * q0,
    ]
    return np.stack(product, axis=-1)


def quaternion_conjugate(q: ArrayLike) -> Floats:
    """Conjugate (q0, -q1, -q2, -q3) (..., 4): its T is the transpose, body to world."""
    return _check_last_axes("q", q, 4) * np.array([1.0, -1.0, -1.0, -1.0])


def unwrap_quaternion(q: ArrayLike) -> Floats:
    """Choose the signs of a time series (..., K, 4) so that neighbours never jump to -q.

    The first sample keeps its sign; after a gap of NaN, the last sample before it decides.
    """
    q = _check_last_axes("q", q, 4)
    if q.ndim < 2:
        raise ValueError(f"q must be a time series (..., K, 4), not of shape {q.shape}")
    known = ~np.isnan(q).any(axis=-1)
    last = np.maximum.accumulate(np.where(known, np.arange(q.shape[-2]), 0), axis=-1)
    filled = np.take_along_axis(q, last[..., None], axis=-2)
    turned = np.sum(filled[..., 1:, :] * filled[..., :-1, :], axis=-1) < 0.0
    sign = np.cumprod(np.where(turned, -1.0, 1.0), axis=-1)
    return q * np.concatenate([np.ones_like(q[..., :1, 0]), sign], axis=-1)[..., None]


def angle_between(p: ArrayLike, q: ArrayLike) -> Floats:
    """Angle (...) [rad] in [0, pi] of the rotation that takes attitude p into q, both (..., 4).

    Exact to rounding even for small angles, for which an arc cosine loses half of the digits.
    """
    p, q = _unit_quaternions(p), _unit_quaternions(q)
    apart, together = np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1)
    return 4.0 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together))


def quaternion_from_rotation_vector(phi: ArrayLike) -> Floats:
    """Unit quaternions (..., 4) of rotation vectors phi (..., 3) [rad]; q0 < 0 beyond half a turn."""
    phi = _check_last_axes("phi", phi, 3)
    x = np.linalg.norm(phi, axis=-1, keepdims=True)
    small = x < 1e-4
    ratio = np.where(small, 0.5 - x**2 / 48, np.sin(0.5 * x) / np.where(small, 1.0, x))
    return np.concatenate([np.cos(0.5 * x), ratio * phi], axis=-1)


def rotation_vector_from_quaternion(q: ArrayLike) -> Floats:
    """Rotation vectors (..., 3) [rad], at most pi long, of quaternions (..., 4).

    For half a turn there are two vectors; the one along (q1, q2, q3) is returned.
    """
    q = _scalar_positive(_unit_quaternions(q))
    vector = q[..., 1:]
    n = np.linalg.norm(vector, axis=-1, keepdims=True)
    tiny = n == 0.0
    return vector * np.where(tiny, 2.0, 2.0 * np.arctan2(n, q[..., :1]) / np.where(tiny, 1.0, n))


def dcm_from_rotation_vector(phi: ArrayLike) -> Floats:
    """Direction cosines T = exp(-[phi x]) (..., 3, 3) of rotation vectors phi (..., 3) [rad]."""
    return dcm_from_quaternion(quaternion_from_rotation_vector(phi))


def rotation_vector_from_dcm(T: ArrayLike) -> Floats:
    """Rotation vectors (..., 3) [rad], at most pi long, of direction cosines (..., 3, 3)."""
    T = _check_last_axes("T", T, 3, 3)
    if T.ndim == 2:
        return np.array(single_rotation_vector(T))
    return rotation_vector_from_quaternion(quaternion_from_dcm(T))


def single_rotation_vector(T: Floats) -> tuple[float, float, float]:
    """`rotation_vector_from_dcm` of one T (3, 3)."""
    w, x, y, z = _quaternion_of_entries(*T.ravel().tolist())
    n = math.sqrt(x * x + y * y + z * z)
    ratio = 2.0 if n == 0.0 else 2.0 * math.atan2(n, w) / n
    return ratio * x, ratio * y, ratio * z


def rotation_vector_rate(phi: ArrayLike, omega: ArrayLike) -> Floats:
    """Rate (..., 3) [rad/s] of rotation vectors phi (..., 3) [rad] at body rates omega (..., 3) [rad/s].

    phi_dot = omega + phi x omega / 2 + k phi x (phi x omega), k = (1 - x/2 cot(x/2))/x^2,
    x = |phi|. It is singular at full turns, x = 2 pi; keep |phi| <= pi.
    """
    phi, omega = _check_last_axes("phi", phi, 3), _check_last_axes("omega", omega, 3)
    with np.errstate(invalid="ignore"):
        rates = _rates(*np.moveaxis(phi, -1, 0), *np.moveaxis(omega, -1, 0))
    return np.stack(rates, axis=-1).astype(np.float64)


def single_rotation_vector_rate(
    x: float, y: float, z: float, p: float, q: float, r: float
) -> tuple[float, float, float]:
    """`rotation_vector_rate` of one phi = (x, y, z) at omega = (p, q, r)."""
    square = x * x + y * y + z * z
    if square < 0.05**2:
        k = 1 / 12 + square / 720 + square * square / 30240
    else:
        half = 0.5 * math.sqrt(square)
        k = (1.0 - half / math.tan(half)) / square if half < math.inf else math.nan
    a, b, c = y * r - z * q, z * p - x * r, x * q - y * p
    return (
        p + 0.5 * a + k * (y * c - z * b), q + 0.5 * b + k * (z * a - x * c), r + 0.5 * c + k * (x * b - y * a)
    )  # fmt: skip


_rates = np.frompyfunc(single_rotation_vector_rate, 6, 3)


def triangle_frame(r: ArrayLike, masses: ArrayLike | None = None) -> Floats:
    """Body frame of a triangle by the recipe of the paper, Eq. (23): T (..., 3, 3).

    x points from the centre of mass to agent 3, y along r_1 - r_2 made orthogonal to x, and
    z = x cross y. Positions r (..., 3, 3) [m], one row per agent; masses (3,) [kg], equal by
    default. Raises ValueError for agents on a line, for which the recipe has no y axis.
    """
    r = _check_last_axes("r", r, 3, 3)
    m = np.ones(3) if masses is None else np.asarray(masses, dtype=float)
    if m.shape != (3,) or not np.all(m > 0):
        raise ValueError(f"masses must be three positive numbers [kg], not {masses!r}")
    x = r[..., 2, :] - m @ r / m.sum()
    y = r[..., 0, :] - r[..., 1, :]
    normal = np.cross(x, y)
    sides = r - np.roll(r, 1, axis=-2)
    longest = np.linalg.norm(sides, axis=-1).max(axis=-1)
    flat = np.linalg.norm(normal, axis=-1) <= 1e-9 * longest**2
    if np.any(flat):
        raise ValueError(
            "the three agents are on a line (to 1e-9 of its length), so agent 3 and the side 1-2"
            " define no plane: attach the frame before the line is reached, or fit the slots"
        )
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    z = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-2)


def _check_last_axes(name: str, value: ArrayLike, *shape: int) -> Floats:
    """Array of floats whose last axes have this shape."""
    array = np.asarray(value, dtype=float)
    if array.shape[-len(shape) :] != shape:
        wanted = ", ".join(["...", *map(str, shape)])
        raise ValueError(f"{name} must have the shape ({wanted}), not {array.shape}")
    return array


def _matrices_of_entries(rows: list[list[Floats]]) -> Floats:
    """Matrices (..., 3, 3) of entries (...)."""
    entries = np.array(rows)
    return np.ascontiguousarray(entries.transpose(*range(2, entries.ndim), 0, 1))


def _unit_quaternions(q: ArrayLike) -> Floats:
    q = _check_last_axes("q", q, 4)
    norm = np.sqrt((q * q).sum(axis=-1, keepdims=True))
    if (norm == 0.0).any():
        raise ValueError(
            "a quaternion of length zero is not an attitude; the identity is (1, 0, 0, 0)"
        )
    return q / norm


def _scalar_positive(q: Floats) -> Floats:
    return np.where(q[..., :1] < 0.0, -q, q)


__getattr__ = getattr_of_earlier_names(
    __name__, vector_of="single_rotation_vector", vector_rate="single_rotation_vector_rate"
)
