"""What a path asks of a quadrotor, against finite differences and statics."""

import numpy as np
import pytest

from rigidfleet.math.quadrotor import ROTORS, flat, mixing


def thrust(t):
    """A thrust vector (K, 3) [N] over time, with derivatives by hand."""
    t = np.asarray(t)
    f = np.stack([2 * np.sin(t), 3 * np.cos(0.7 * t), 10 + np.sin(0.4 * t)], axis=-1)
    df = np.stack([2 * np.cos(t), -2.1 * np.sin(0.7 * t), 0.4 * np.cos(0.4 * t)], axis=-1)
    ddf = np.stack([-2 * np.sin(t), -1.47 * np.cos(0.7 * t), -0.16 * np.sin(0.4 * t)], axis=-1)
    return np.stack([f, df, ddf], axis=1)


def yaw(t):
    t = np.asarray(t)
    return np.stack([0.8 * t + 0.1 * t**2, 0.8 + 0.2 * t, np.full_like(t, 0.2)], axis=1)


def test_rates_are_those_of_the_attitude():
    """The rates are the derivative of the attitude, R' = R [omega x], and their derivative follows them."""
    t, h = np.linspace(0.0, 3.0, 7), 1e-5
    now, before, after = (flat(thrust(s), yaw(s)) for s in (t, t - h, t + h))
    spin = np.einsum("kji,kjl->kil", now.axes, (after.axes - before.axes) / (2 * h))
    found = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    np.testing.assert_allclose(now.omega, found, atol=1e-8)
    slope = (after.omega - before.omega) / (2 * h)
    np.testing.assert_allclose(now.omega_dot, slope, atol=1e-8)


def test_axes_carry_the_thrust_and_the_heading():
    """The third axis is the thrust's direction; the first one lies over the heading."""
    t = np.linspace(0.0, 3.0, 7)
    found = flat(thrust(t), yaw(t))
    np.testing.assert_allclose(
        found.axes[:, :, 2] * found.thrust[:, None], thrust(t)[:, 0], atol=1e-12
    )
    heading = np.arctan2(found.axes[:, 1, 0], found.axes[:, 0, 0])
    side = found.axes[:, :2, 1]  # horizontal, across the heading
    across = np.stack([np.cos(yaw(t)[:, 0]), np.sin(yaw(t)[:, 0])], axis=1)
    np.testing.assert_allclose(np.einsum("ki,ki->k", side, across), 0.0, atol=1e-12)
    assert np.isfinite(heading).all()
    np.testing.assert_allclose(np.linalg.det(found.axes), 1.0)


def test_hover_shares_the_weight():
    """In hover every rotor carries a quarter of the weight; a torque changes the sum of no pair."""
    force = np.zeros((1, 3, 3))
    force[0, 0, 2] = 9.81
    found = flat(force, np.zeros((1, 3)))
    mix = mixing(0.17, 0.015)
    forces = found.rotor_forces(np.array([0.01, 0.01, 0.02]), mix)
    np.testing.assert_allclose(forces, 9.81 / 4)
    assert found.tilt == pytest.approx(0.0)


def test_mixing_is_the_sum_of_lever_arms():
    """Torques of rotor forces are r x f, and the drag of the rotors about z."""
    rng = np.random.default_rng(0)
    f = rng.uniform(0.0, 5.0, 4)
    r = np.column_stack([0.2 * ROTORS[:, :2], np.zeros(4)])
    torque = np.cross(r, np.column_stack([np.zeros((4, 2)), f])).sum(axis=0)
    torque[2] = 0.03 * (ROTORS[:, 2] * f).sum()
    np.testing.assert_allclose(mixing(0.2, 0.03) @ f, [f.sum(), *torque])
