"""References and their derivatives: what vehicles with attitude are told, and how smooth it is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rigidfleet.kernel import control, references
from rigidfleet.kernel.problem import SHAPE, Motion, Reference, workspace
from rigidfleet.math import series
from rigidfleet.planning import derivatives as d

#: Central differences of eighth order.
_FIRST = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
_SECOND = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560])


def random(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def a_reference(powers: int = 6) -> tuple[Reference, Motion]:
    """Four slots that reshape, in a body that moves on polynomials and turns about all axes."""
    knots = np.array([0.0, 1.5, 4.0])
    scale = 0.5 ** np.arange(powers)
    pieces = random(7, 2, 6, powers) * scale
    motion = Motion(
        knots, np.ascontiguousarray(pieces), Rotation.from_rotvec([0.4, -1, 2]).as_matrix()
    )
    slots = 2.0 * random(3, 4, 3)
    reference = Reference(
        SHAPE, 0.5, 2.5, np.zeros(3), np.zeros(3), slots, random(4, 4, 3), np.array([0.3, 0.9, -0.4])
    )  # fmt: skip
    return reference, motion


def flown(reference: Reference, motion: Motion, t: float) -> np.ndarray:
    """Position, velocity and acceleration (3, N, 3) of the slots, as the kernel flies them."""
    w = workspace(len(reference.p0), 0)
    references.blend_slots(t, reference, w.p, w.p_dot, w.p_ddot)
    control.reference_motion(t, motion, w)
    control.desired_agents(w)
    return np.array([w.r_ref, w.v_ref, w.a_ref])


@pytest.mark.parametrize("t", [0.2, 0.9, 1.5, 2.2, 3.5, 4.7])
def test_slots_have_the_kernels_position_velocity_and_acceleration(t):
    """Before, in and after a blend, at a knot and beyond the last one."""
    reference, motion = a_reference()
    found = d.slot_derivatives(reference, motion, np.array([t]))[0]
    np.testing.assert_allclose(found[:3], flown(reference, motion, t), rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("t", [0.3, 0.9, 2.2, 3.5])
def test_jerk_and_snap_are_differences_of_the_kernels_acceleration(t):
    """Eighth-order differences of what the compiled kernel flies."""
    reference, motion = a_reference()
    h = 0.02
    a = np.array([flown(reference, motion, t + k * h)[2] for k in range(-4, 5)])
    found = d.slot_derivatives(reference, motion, np.array([t]))[0]
    scale = np.abs(found[3:]).max()
    np.testing.assert_allclose(found[3], np.tensordot(_FIRST, a, 1) / h, atol=1e-7 * scale)
    np.testing.assert_allclose(found[4], np.tensordot(_SECOND, a, 1) / h**2, atol=1e-6 * scale)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1.0, 3.0, 3.99, 4.01, 30.0, 600.0])
def test_rotations_of_any_angle(size):
    """The series of Exp(phi) is SciPy's rotation a little later, from no turn to a hundred."""
    phi = random(5, 5, 3) * 0.3
    phi[0] *= size / np.linalg.norm(phi[0])
    R = series.rotation(phi)
    for h in (0.0, 0.01):
        later = Rotation.from_rotvec(sum(x * h**k for k, x in enumerate(phi))).as_matrix()
        sum_ = sum(x * h**k for k, x in enumerate(R))
        np.testing.assert_allclose(sum_, later, rtol=0, atol=1e-9 if h else 1e-12)


def test_rotation_vectors_invert_rotations():
    """Rotation vectors, their rotations and body rates are series of one another."""
    phi = random(6, 5, 3) * 0.5
    R = series.rotation(phi)
    np.testing.assert_allclose(series.rotation_vector(R), phi, rtol=0, atol=1e-12)
    again = series.from_rates(R[0], series.body_rates(R))
    np.testing.assert_allclose(again, R, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["formation", "along", "towards"])
def test_yaw_and_its_rates_belong_together(kind):
    """Rate and acceleration of the yaw are differences of the yaw."""
    reference, motion = a_reference()
    yaw = d.Yaw(kind, point=(20.0, -5.0, 3.0))
    h, t = 0.01, 1.9
    grid = t + h * np.arange(-4, 5)
    time = np.concatenate([[1.6], grid])
    found = d.yaw_derivatives(reference, motion, time, yaw)[1:]
    np.testing.assert_allclose(found[4, 1], np.tensordot(_FIRST, found[:, 0], 1) / h, atol=1e-6)
    np.testing.assert_allclose(found[4, 2], np.tensordot(_SECOND, found[:, 0], 1) / h**2, atol=1e-4)


def test_yaw_with_the_formation_is_its_euler_angle_when_it_does_not_roll():
    """A body that pitches by 50 deg and yaws: the vehicles' yaw is the 3-2-1 yaw."""
    reference, _ = a_reference()
    attitude = Rotation.from_euler("ZYX", [130.0, 50.0, 0.0], degrees=True).as_matrix()
    still = Motion(np.array([0.0, 1.0]), np.zeros((1, 6, 6)), attitude.T)
    found = d.yaw_derivatives(reference, still, np.array([0.5]), d.Yaw())
    np.testing.assert_allclose(np.rad2deg(found[0, 0]), 130.0, atol=1e-12)
    np.testing.assert_allclose(found[0, 1:], 0.0, atol=1e-12)


def straight(*legs: tuple[float, float]) -> Motion:
    """The CM at rest at the origin, then along x by (distance, duration) with quintic starts and stops."""
    from rigidfleet.math import lqr

    knots = np.concatenate([[0.0], np.cumsum([time for _, time in legs])])
    x = np.zeros((len(knots), 6))
    x[1:, 0] = np.cumsum([way for way, _ in legs])
    zero = np.zeros_like(x)
    return Motion(knots, np.ascontiguousarray(lqr.quintic_pieces(knots, x, zero, zero)), np.eye(3))


def test_yaw_along_turns_into_the_way_keeps_still_at_rest_and_turns_back():
    """A vehicle that looks sideways turns into the way, stays so at rest, and turns round for the way back."""
    reference, _ = a_reference()
    still = reference._replace(dp=np.zeros((4, 3)), turn=np.zeros(3))
    motion = straight((30.0, 10.0), (0.0, 5.0), (-30.0, 10.0))
    time = np.linspace(0.0, 25.0, 251)
    found = d.yaw_derivatives(still, motion, time, d.Yaw("along"), np.full(4, 1.5))
    yaw = np.rad2deg(found[:, 0])
    np.testing.assert_allclose(yaw[90:151], 0.0, atol=0.1)
    np.testing.assert_allclose(yaw[150], yaw[101], atol=1e-9)
    np.testing.assert_allclose(np.cos(found[-1, 0]), -1.0, atol=1e-4)
    assert np.abs(found[:, 1]).max() < 3.0  # rad/s
