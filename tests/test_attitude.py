import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rigidfleet.math.attitude import (
    angle_between,
    dcm_from_euler,
    dcm_from_quaternion,
    dcm_from_rotation_vector,
    euler_from_dcm,
    euler_from_quaternion,
    quaternion_conjugate,
    quaternion_from_dcm,
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_rate,
    rotation_vector_from_dcm,
    rotation_vector_from_quaternion,
    rotation_vector_rate,
    triangle_frame,
    unwrap_quaternion,
)

CASES = json.loads((Path(__file__).parent / "data/reference_quaternion_dcm.json").read_text())

component = st.floats(-1.0, 1.0)
quaternions = (
    st.tuples(component, component, component, component)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: np.array(q) / np.linalg.norm(q))
)
vectors = st.tuples(component, component, component).map(np.array)


def scipy_rotation(q):
    """SciPy's rotation takes body components to the world, its scalar comes last."""
    return Rotation.from_quat(np.roll(q, -1, axis=-1))


def same_attitude(p, q):
    return np.minimum(np.abs(p - q).max(axis=-1), np.abs(p + q).max(axis=-1))


@pytest.mark.parametrize("case", CASES["result"]["list"], ids=lambda case: str(case["euler_deg"]))
def test_reference(case):
    """T(q), q(T), Euler angles and the quaternion's rate are those of the reference implementation."""
    euler, T, q = np.radians(case["euler_deg"]), np.array(case["T"]), np.array(case["q"])
    assert dcm_from_euler(euler) == pytest.approx(T, abs=1e-15)
    assert dcm_from_quaternion(q) == pytest.approx(T, abs=1e-15)
    assert quaternion_from_dcm(T) == pytest.approx(q, abs=1e-15)
    assert quaternion_from_euler(euler) == pytest.approx(q, abs=1e-15)
    assert euler_from_dcm(T) == pytest.approx(euler, abs=1e-12)
    rate = quaternion_rate(q, [1.0, 2.0, 3.0])
    assert rate == pytest.approx(np.array(case["Omega_q_half_w123"]), abs=1e-15)


def test_first_row():
    """Row 1 of T(q) is the paper's, and a yaw of 90 degrees shows the north as the body's x axis."""
    q = np.array([0.1, 0.5, -0.7, 0.5])
    q0, q1, q2, q3 = q / np.linalg.norm(q)
    row = [q0**2 + q1**2 - q2**2 - q3**2, 2 * (q1 * q2 + q0 * q3), 2 * (q1 * q3 - q0 * q2)]
    assert dcm_from_quaternion(q)[0] == pytest.approx(np.array(row), abs=1e-15)
    north = dcm_from_euler([0.0, 0.0, math.pi / 2]) @ [0.0, 1.0, 0.0]
    assert north == pytest.approx(np.array([1.0, 0.0, 0.0]), abs=1e-15)


@given(quaternions)
def test_quaternion_against_scipy(q):
    """T(q) is the transpose of SciPy's body-to-world matrix, and back it gives q with q0 >= 0."""
    T = dcm_from_quaternion(q)
    assert pytest.approx(scipy_rotation(q).as_matrix().T, abs=1e-14) == T
    back = quaternion_from_dcm(T)
    assert back[0] >= 0.0
    assert same_attitude(back, q) < 1e-14


@given(st.tuples(st.floats(-3.14, 3.14), st.floats(-1.57, 1.57), st.floats(-3.14, 3.14)))
def test_euler_against_scipy(euler):
    """Euler angles are SciPy's intrinsic z-y-x sequence; they make a round trip by T and by q."""
    T = dcm_from_euler(euler)
    assert pytest.approx(Rotation.from_euler("ZYX", euler[::-1]).as_matrix().T, abs=1e-14) == T
    assert dcm_from_quaternion(quaternion_from_euler(euler)) == pytest.approx(T, abs=1e-14)
    for angles in (euler_from_dcm(T), euler_from_quaternion(quaternion_from_euler(euler))):
        assert dcm_from_euler(angles) == pytest.approx(T, abs=1e-14)
        if abs(euler[1]) < 1.5:
            assert angles == pytest.approx(np.array(euler), abs=1e-13)


@pytest.mark.parametrize("pitch", [90.0, -90.0, 90.0 - 1e-7, 90.0 - 1e-11, 90.0 - 1e-13])
@pytest.mark.parametrize(("roll", "yaw"), [(0, 0), (30, 70), (-170, 160), (180, -180)])
def test_gimbal_lock(pitch, roll, yaw):
    """At and beside a pitch of 90 degrees the angles give their T back, with roll 0 at the lock."""
    T = dcm_from_euler(np.radians([roll, pitch, yaw]))
    angles = euler_from_dcm(T)
    assert dcm_from_euler(angles) == pytest.approx(T, abs=3e-14)
    if abs(pitch) == 90.0:
        assert angles[0] == 0.0


@given(quaternions, quaternions)
def test_product(p, q):
    """T(p q) = T(q) T(p), and a quaternion times its conjugate is no turn at all."""
    product = dcm_from_quaternion(quaternion_multiply(p, q))
    assert product == pytest.approx(dcm_from_quaternion(q) @ dcm_from_quaternion(p), abs=1e-14)
    identity = quaternion_multiply(q, quaternion_conjugate(q))
    assert identity == pytest.approx(np.array([1.0, 0.0, 0.0, 0.0]), abs=1e-14)
    transposed = dcm_from_quaternion(q).T
    assert dcm_from_quaternion(quaternion_conjugate(q)) == pytest.approx(transposed, abs=1e-14)


@given(quaternions, vectors)
def test_rate(q, omega):
    """The quaternion's rate keeps its length and turns T as Tdot = -[omega x] T."""
    h = 1e-5
    rate = quaternion_rate(q, omega)
    assert q @ rate == pytest.approx(0.0, abs=1e-15)
    T_dot = (dcm_from_quaternion(q + h * rate) - dcm_from_quaternion(q - h * rate)) / (2 * h)
    cross = np.cross(np.eye(3), omega)  # = [omega x]
    assert pytest.approx(-cross @ dcm_from_quaternion(q), abs=1e-9) == T_dot


@given(vectors, st.sampled_from([0.0, 1e-300, 1e-12, 1e-5, 1e-3, 1.0, 3.0, 3.141592]))
def test_rotation_vector_round_trip(axis, angle):
    """Rotation vectors make a round trip by q and by T, from a denormal turn to half a turn."""
    length = np.linalg.norm(axis)
    phi = angle * (axis / length if length > 1e-3 else np.array([0.6, 0.0, 0.8]))
    assert pytest.approx(
        Rotation.from_rotvec(phi).as_matrix().T, abs=1e-14
    ) == dcm_from_rotation_vector(phi)
    tolerance = 1e-13 * angle
    q = quaternion_from_rotation_vector(phi)
    assert np.abs(rotation_vector_from_quaternion(q) - phi).max() <= tolerance
    assert np.abs(rotation_vector_from_quaternion(-q) - phi).max() <= tolerance
    if angle > 1e-290:  # products of smaller numbers vanish in T
        assert np.abs(rotation_vector_from_dcm(dcm_from_rotation_vector(phi)) - phi).max() <= max(
            tolerance, 1e-15
        )


def test_half_turn():
    """Half a turn comes back with length pi about the same axis, though T cannot tell its sense."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    phi = rotation_vector_from_dcm(dcm_from_rotation_vector(math.pi * axis))
    assert np.linalg.norm(phi) == pytest.approx(math.pi, abs=1e-14)
    assert abs(phi @ axis) == pytest.approx(math.pi, abs=1e-14)


@pytest.mark.parametrize("length", [0.0, 1e-9, 1e-3, 0.0499, 0.0501, 1.0, 3.1])
def test_rotation_vector_rate(length):
    """phi_dot moves T(phi) as the body rates omega do, on both sides of its series' limit."""
    phi, omega, h = length * np.array([0.6, 0.0, 0.8]), np.array([0.3, -0.5, 0.7]), 1e-4
    phi_dot = rotation_vector_rate(phi, omega)
    ahead, behind = (dcm_from_rotation_vector(phi + s * h * phi_dot) for s in (1, -1))
    T_dot = -np.cross(np.eye(3), omega) @ dcm_from_rotation_vector(phi)
    assert (ahead - behind) / (2 * h) == pytest.approx(T_dot, abs=1e-7)


@given(quaternions, quaternions)
def test_angle_between(p, q):
    """The angle between two attitudes is that of the turn between them, whatever the signs."""
    expected = (scipy_rotation(p).inv() * scipy_rotation(q)).magnitude()
    for angle in (angle_between(p, q), angle_between(q, p), angle_between(p, -q)):
        assert angle == pytest.approx(expected, abs=1e-7 if expected > 3.1 else 1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1.0, math.pi - 1e-9, math.pi])
def test_small_and_large_angles(angle):
    """Angles near 0 and near pi keep their digits."""
    p = np.array([0.5, -0.5, 0.5, 0.5])
    q = quaternion_multiply(p, quaternion_from_rotation_vector([0.0, angle, 0.0]))
    assert angle_between(p, q) == pytest.approx(angle, rel=1e-3, abs=1e-15)
    assert angle_between(p, q) == pytest.approx(angle, abs=2e-15)


def test_unwrap():
    """A turn of two revolutions gives a quaternion without jumps, also across a gap of NaN."""
    angle = np.linspace(0.0, 4 * math.pi, 200)
    smooth = quaternion_from_rotation_vector(angle[:, None] * np.array([0.0, 0.0, 1.0]))
    wrapped = np.where(smooth[:, :1] < 0.0, -smooth, smooth)
    assert np.abs(np.diff(wrapped, axis=0)).max() > 1.0
    assert unwrap_quaternion(wrapped) == pytest.approx(smooth, abs=1e-15)
    wrapped[95:108] = np.nan
    expected = np.where(np.isnan(wrapped), np.nan, smooth)
    assert np.array_equal(unwrap_quaternion(wrapped), expected, equal_nan=True)
    pair = np.stack([wrapped, -wrapped])
    assert np.array_equal(unwrap_quaternion(pair)[1], -expected, equal_nan=True)
    unattached = np.concatenate([np.full((3, 4), np.nan), wrapped])
    assert np.array_equal(unwrap_quaternion(unattached)[3:], expected, equal_nan=True)


def test_leading_axes_and_nan():
    """Every conversion takes leading axes, and an unknown attitude stays unknown."""
    q = np.random.default_rng(1).normal(size=(2, 5, 4))
    q[1, 2] = np.nan
    T = dcm_from_quaternion(q)
    assert T.shape == (2, 5, 3, 3)
    for one in (
        quaternion_from_dcm(T),
        euler_from_dcm(T),
        euler_from_quaternion(q),
        rotation_vector_from_quaternion(q),
        rotation_vector_from_dcm(T),
        quaternion_from_euler(euler_from_dcm(T)),
        quaternion_from_rotation_vector(rotation_vector_from_dcm(T)),
        quaternion_rate(q, np.ones(3)),
        quaternion_multiply(q, q[0, 0]),
    ):
        assert one.shape[:2] == (2, 5)
        assert np.all(np.isnan(one[1, 2]))
        assert np.isnan(one).any(axis=-1).sum() == 1
    assert dcm_from_euler(euler_from_dcm(T))[0] == pytest.approx(T[0], abs=1e-14)


# Positions at 6 s of case 19 of the reference cases, "Table 1" of the paper [m].
TRIANGLE = np.array(
    [
        [4.829518706002667, 6.960535031163502, 3.0],
        [8.146213231813759, 4.7245704915397315, 3.0],
        [8.42426806218358, 8.714894477296768, 3.0],
    ]
)


@given(
    st.lists(st.tuples(vectors, vectors), min_size=1, max_size=5),
    st.sampled_from([1e-9, 0.04, 1.8]),
)
def test_single_rotations_are_those_of_many(pairs, scale):
    """What is computed of a single rotation in plain numbers is what is computed of it among others, to rounding."""
    phi, omega = (np.array(x) for x in zip(*pairs, strict=True))
    phi = scale * phi
    T = dcm_from_rotation_vector(phi)
    for k in range(len(T)):
        assert quaternion_from_dcm(T[k]) == pytest.approx(quaternion_from_dcm(T)[k], abs=1e-15)
        vector = rotation_vector_from_dcm(T)[k]
        if np.linalg.norm(vector) < 3.1:  # half a turn has two vectors
            assert rotation_vector_from_dcm(T[k]) == pytest.approx(vector, abs=1e-14)
        rate = rotation_vector_rate(phi, omega)[k]
        assert rotation_vector_rate(phi[k], omega[k]) == pytest.approx(rate, abs=1e-14)
    nothing = np.full((3, 3), np.nan)
    assert np.isnan(quaternion_from_dcm(nothing)).all()
    assert np.isnan(rotation_vector_from_dcm(nothing)).all()
    assert np.isnan(rotation_vector_rate(nothing[0], nothing[0])).all()


def test_triangle_frame_of_table_1():
    """Table 1's triangle attaches its frame at a yaw of 56.0139 degrees, level."""
    euler = np.degrees(euler_from_dcm(triangle_frame(TRIANGLE)))
    assert euler == pytest.approx(np.array([0.0, 0.0, 56.0139]), abs=5e-5)


@given(vectors, vectors, quaternions)
def test_triangle_frame_turns_with_the_triangle(shape, shift, q):
    """The frame is a rotation, x points to agent 3, and it turns with the triangle."""
    r = np.array([[0.0, 3.0, 0.0], [1.0, -2.0, 0.0], [4.0, 0.0, 1.0]])
    r[0] += 0.5 * shape
    masses = [1.0, 1.5, 2.0]
    T = triangle_frame(r, masses)
    assert pytest.approx(np.eye(3), abs=1e-14) == T @ T.T
    assert np.linalg.det(T) > 0
    body = (r - np.average(r, axis=0, weights=masses)) @ T.T
    assert body[2, 0] > 0
    assert body[2, 1:] == pytest.approx(np.zeros(2), abs=1e-13)
    assert (body[0] - body[1])[1] > 0
    assert body[:, 2] == pytest.approx(np.zeros(3), abs=1e-13)
    turn = dcm_from_quaternion(q)
    assert triangle_frame(r @ turn.T + shift, masses) == pytest.approx(T @ turn.T, abs=1e-12)


@pytest.mark.parametrize("middle", [0, 1, 2])
def test_triangle_frame_fails_on_a_line(middle):
    """On a line the recipe fails, whichever agent is in the middle, and says what to do."""
    r = np.array([[-4.0, 1.0, 2.0], [0.0, 1.0, 2.0], [4.0, 1.0, 2.0]])
    r[[1, middle]] = r[[middle, 1]]
    with pytest.raises(ValueError, match=r"on a line .* attach the frame before the line"):
        triangle_frame(r)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: dcm_from_quaternion([0.0, 0.0, 0.0, 0.0]), "length zero"),
        (lambda: dcm_from_quaternion([1.0, 0.0, 0.0]), r"shape \(\.\.\., 4\), not \(3,\)"),
        (lambda: quaternion_from_dcm(np.diag([1.0, 1.0, -1.0])), "mirror image"),
        (lambda: quaternion_from_dcm(1.01 * np.eye(3)), "not a rotation"),
        (lambda: unwrap_quaternion([1.0, 0.0, 0.0, 0.0]), "time series"),
        (lambda: triangle_frame(TRIANGLE, [1.0, 0.0, 1.0]), "three positive"),
    ],
)
def test_errors(call, message):
    """What cannot be an attitude is refused, and the message says why."""
    with pytest.raises(ValueError, match=message):
        call()
