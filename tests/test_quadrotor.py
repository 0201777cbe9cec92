"""The quadrotor against closed forms, RotorPy, crazyflow and conserved quantities; see `vehicle_samples`."""

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation
from vehicle_samples import (
    FROZEN,
    PAPER,
    ROTORPY,
    G,
    begun,
    derivatives,
    from_crazyflow,
    random_inputs,
    random_states,
    rotorpy,
    rotorpy_derivative,
    rotorpy_flight,
)

from rigidfleet.kernel import aerodynamics, attitude_control, fleet
from rigidfleet.kernel.engine import sampled
from rigidfleet.kernel.records import FINISHED
from rigidfleet.math import attitude

HUMMINGBIRD = ROTORPY["hummingbird"]
NO_AIR = {"rotor_drag": (0, 0), "lift": 0.0, "c": (0, 0, 0)}


def derivative(vehicle: fleet.VehicleDynamics, S, command, wind) -> np.ndarray:
    flight = fleet.new_ideal_flight(
        fleet.quadrotor_arrays([vehicle] * len(S), G), start=0.0, h=1e-3, steps=1
    )
    return derivatives(flight, np.array(S), np.array(command), np.array(wind))


def by_rotors(flight: fleet.SampledFlight) -> fleet.SampledFlight:
    """The same flight under rotor commands, which can be overwritten."""
    return flight._replace(commands=flight.commands._replace(kind=fleet.ROTOR_SPEEDS))


def relative(ours, theirs) -> float:
    theirs = np.asarray(theirs)
    return float((np.abs(ours - theirs) / np.maximum(1.0, np.abs(theirs))).max())


# -- others' equations of motion -------------------------------------------------------------------


def test_derivatives_are_those_of_rotorpy_and_crazyflow():
    """Derivatives far from hover are RotorPy's and crazyflow's to 1e-12, thrust curves, drag and gyroscopic torque."""
    frozen = json.loads(FROZEN.read_text())
    assert (frozen["rotorpy"], frozen["crazyflow"]) == ("3.0.0", "0.4.0")
    for name, given in frozen["derivatives"].items():
        if name in ROTORPY:
            vehicle = ROTORPY[name]
        else:
            vehicle = from_crazyflow({k: np.array(v) for k, v in given["parameters"].items()})
        ours = derivative(vehicle, given["S"], given["command"], given["wind"])
        assert relative(ours, given["dS"]) < 1e-12, name


@pytest.mark.parametrize("name", ROTORPY)
def test_a_second_of_random_rotor_inputs(name):
    """One second of random rotor inputs ends where RotorPy, integrated to 1e-12, does; the order is four."""
    given = json.loads(FROZEN.read_text())["flights"][name]
    errors = []
    for h in (2e-3, 1e-3, 5e-4):
        problem, work, flight, state = begun(
            [ROTORPY[name]], np.zeros((1, 3)), h=h, steps=round(0.02 / h)
        )
        flight = by_rotors(flight)
        for k, command in enumerate(given["command"]):
            flight.commands.speeds[0] = command
            call = fleet.sampled_segment(1, 0, 0.02 * (k + 1))
            assert sampled.fly_ticks(problem, work, flight, state, call) == FINISHED
        errors.append(np.abs(state.S[0] - given["end"])[:3].max())
    assert errors[1] < 1e-6
    assert 12.0 < errors[0] / errors[1] < 20.0
    assert 12.0 < errors[1] / errors[2] < 20.0


@pytest.mark.long
def test_frozen_numbers_are_those_of_the_installed_packages(tmp_path):
    """RotorPy and crazyflow, where they are installed, give the frozen numbers today."""
    pytest.importorskip("rotorpy")
    pytest.importorskip("casadi")  # of crazyflow, which cannot be imported after SciPy
    made = tmp_path / "frozen.json"
    script = Path(__file__).with_name("vehicle_samples.py")
    environment = os.environ | {"SCIPY_ARRAY_API": "1"}
    subprocess.run(
        [sys.executable, script, made],
        check=True,
        env=environment,
        cwd=tmp_path,
        capture_output=True,
    )
    new, old = json.loads(made.read_text()), json.loads(FROZEN.read_text())
    assert new["rotorpy"] == old["rotorpy"]
    assert new["crazyflow"] == old["crazyflow"]
    for name, given in old["derivatives"].items():
        assert relative(np.array(new["derivatives"][name]["dS"]), given["dS"]) < 1e-12
    for name, given in old["flights"].items():
        assert relative(np.array(new["flights"][name]["end"]), given["end"]) < 1e-9


@pytest.mark.long
@pytest.mark.parametrize("name", ROTORPY)
def test_many_derivatives_are_those_of_rotorpy(name):
    """A thousand random states have RotorPy's derivatives to 1e-12; parameters are those that it ships."""
    pytest.importorskip("rotorpy")
    S, command, wind = random_states(ROTORPY[name], 1000, 7)
    model = rotorpy(name)
    theirs = [rotorpy_derivative(model, *row) for row in zip(S, command, wind, strict=True)]
    assert relative(derivative(ROTORPY[name], S, command, wind), theirs) < 1e-12
    S, command = random_inputs(ROTORPY[name])
    assert (
        relative(
            rotorpy_flight(model, S, command),
            json.loads(FROZEN.read_text())["flights"][name]["end"],
        )
        < 1e-9
    )


# -- closed forms ----------------------------------------------------------------------------------


@pytest.mark.parametrize("vehicle", [*ROTORPY.values(), PAPER], ids=[*ROTORPY, "paper"])
def test_hover(vehicle):
    """A vehicle that hovers stays where it is, its rotors carry a quarter of the weight each."""
    problem, work, flight, state = begun([vehicle], [[1.0, 2.0, 3.0]])
    assert (
        sampled.fly_ticks(problem, work, flight, state, fleet.sampled_segment(1, 0, 5.0))
        == FINISHED
    )
    np.testing.assert_allclose(state.S[0, :3], [1, 2, 3], rtol=0, atol=1e-11)
    np.testing.assert_allclose(state.peak, vehicle.m * G / 4, rtol=1e-12)
    assert not state.saturated.any()


def test_free_fall():
    """Without rotors and drag, a tumbling vehicle falls on a parabola and keeps its angular momentum and energy."""
    vehicle = replace(HUMMINGBIRD, **NO_AIR)
    problem, work, flight, state = begun([vehicle], [[0.0, 0.0, 100.0]])
    state.S[0, 3:6], state.S[0, 10:13], state.S[0, 13:] = (1.0, -2.0, 3.0), (4.0, -1.0, 2.0), 0.0
    inertia = np.array(vehicle.inertia)

    def momentum_and_energy() -> np.ndarray:
        omega, T = state.S[0, 10:13], attitude.dcm_from_quaternion(state.S[0, 6:10])
        return np.append(T.T @ (inertia * omega), 0.5 * omega @ (inertia * omega))

    before = momentum_and_energy()
    times = np.linspace(0.0, 2.0, 9)
    call = fleet.sampled_segment(1, 0, 2.0, times)
    sampled.fly_ticks(problem, work, by_rotors(flight), state, call)
    t = times[:, None]
    path = np.array([0, 0, 100]) + t * [1, -2, 3] - 0.5 * G * t**2 * [0, 0, 1]
    np.testing.assert_allclose(call.S[:, 0, :3], path, rtol=0, atol=1e-11)
    np.testing.assert_allclose(momentum_and_energy(), before, rtol=0, atol=1e-9)
    np.testing.assert_allclose(call.dS[:, 0, 3:6], np.tile([0, 0, -G], (9, 1)), rtol=0, atol=1e-14)


def test_motor_step():
    """After a step of the command, a rotor follows exp(-t/tau), with one time constant up and another one down."""
    vehicle = replace(HUMMINGBIRD, motor=(1 / 0.02, 0.0, 1 / 0.05, 0.0))
    problem, work, flight, state = begun([vehicle])
    w0 = state.S[0, 13]
    flight = by_rotors(flight)
    flight.commands.speeds[0] = 1.2 * w0, 0.8 * w0, 1.2 * w0, 0.8 * w0
    times = np.linspace(0.003, 0.1, 7)
    call = fleet.sampled_segment(1, 0, 0.1, times)
    sampled.fly_ticks(problem, work, flight, state, call)
    up, down = 1.2 - 0.2 * np.exp(-times / 0.02), 0.8 + 0.2 * np.exp(-times / 0.05)
    np.testing.assert_allclose(call.S[:, 0, 13] / w0, up, rtol=0, atol=1e-7)
    np.testing.assert_allclose(call.S[:, 0, 14] / w0, down, rtol=0, atol=1e-8)


def test_quadratic_motor():
    """A motor with w' = b (c^2 - w^2) follows c tanh: the closed form of the quadratic lag."""
    b = 0.05
    problem, work, flight, state = begun([replace(HUMMINGBIRD, motor=(0.0, b, 0.0, b))], h=5e-4)
    w0, flight = state.S[0, 13], by_rotors(flight)
    c = 1.3 * w0
    flight.commands.speeds[:] = c
    sampled.fly_ticks(problem, work, flight, state, fleet.sampled_segment(1, 0, 0.05))
    expected = c * math.tanh(math.atanh(w0 / c) + b * c * 0.05)
    np.testing.assert_allclose(state.S[0, 13:], expected, rtol=1e-8)


def test_attitude_step():
    """A small roll decays as the linear loop of rates, lag and sampled control does: x' = A x + B (K x), held."""
    tau, dt = 0.02, 2e-3
    vehicle = replace(PAPER, **NO_AIR, torque=(0, 0, 5.9e-6 * 0.0152))
    problem, work, flight, state = begun([vehicle], h=5e-4, steps=4)
    angle = 1e-6
    state.S[0, 6:10] = math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0
    # Torque over inertia is x[2]; it follows its command with the motors' lag
    A, B = np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / tau]]), np.array([[0], [0], [1 / tau]])
    held = expm(np.block([[A, B], [np.zeros((1, 4))]]) * dt)
    K = -np.array([[544.0, 46.64, 0.0]])
    x, expected = np.array([angle, 0.0, 0.0]), []
    for _ in range(150):
        x = held[:3, :3] @ x + held[:3, 3] * (K @ x)
        expected.append(x[0])
    call = fleet.sampled_segment(1, 0, 0.3, dt * np.arange(1, 151))
    sampled.fly_ticks(problem, work, flight, state, call)
    roll = 2.0 * call.S[:, 0, 7]
    np.testing.assert_allclose(roll / angle, np.array(expected) / angle, rtol=0, atol=2e-5)
    assert expected[-1] < 0.05 * angle


def test_momentum_of_the_rotors():
    """Without air and gravity, rotors that speed up turn the body so that the angular momentum of all stays."""
    vehicle = replace(
        HUMMINGBIRD, **NO_AIR, thrust=(0, 0, 1e-16), torque=(0, 0, 1e-18), rotor_inertia=2e-5, motor=(50, 0, 50, 0)
    )  # fmt: skip
    vehicles = fleet.quadrotor_arrays([vehicle], G)._replace(g=0.0)
    problem, work, flight, state = begun([HUMMINGBIRD], h=5e-4)
    flight = by_rotors(flight._replace(vehicles=vehicles))
    state.S[0, 10:13] = 3.0, -2.0, 1.0
    flight.commands.speeds[0] = 900.0, 100.0, 700.0, 300.0

    def momentum() -> np.ndarray:
        T, spin = attitude.dcm_from_quaternion(state.S[0, 6:10]), np.array([1, -1, 1, -1])
        own = np.array([0, 0, -2e-5 * spin @ state.S[0, 13:]])
        return T.T @ (np.array(vehicle.inertia) * state.S[0, 10:13] + own)

    before = momentum()
    sampled.fly_ticks(problem, work, flight, state, fleet.sampled_segment(1, 0, 1.0))
    np.testing.assert_allclose(momentum(), before, rtol=0, atol=1e-9)
    assert np.abs(state.S[0, 13:] - [900, 100, 700, 300]).max() < 1e-6


# -- air -------------------------------------------------------------------------------------------


def test_wind_is_a_change_of_frame():
    """A vehicle carried by a steady wind flies as one in still air, seen from the moving air."""
    wind = np.array([3.0, -2.0, 0.5])
    ends = []
    for moving in (False, True):
        problem, work, flight, state = begun([HUMMINGBIRD], np.zeros((1, 3)))
        flight = by_rotors(flight)
        flight.commands.speeds[:] = state.S[0, 13] * np.array([1.02, 1.0, 0.99, 1.01])
        if moving:
            flight = flight._replace(air=flight.air._replace(wind=wind))
            state.S[0, 3:6] = wind
        sampled.fly_ticks(problem, work, flight, state, fleet.sampled_segment(1, 0, 1.0))
        ends.append(state.S[0])
    ends[1][:6] -= np.concatenate([wind, wind])
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-11)


def test_gusts_keep_the_order_of_the_steps():
    """Gusts are evaluated at the stages of a step: halving it divides the error by sixteen."""
    table = np.zeros((18, 1, 3))
    table[3:15:3, 0] = 12.0, 8.0, -4.0
    dragged, ends = replace(ROTORPY["crazyflie"], drag=(0.1, 0.1, 0.1)), []
    for h in (4e-3, 2e-3, 1e-3, 2.5e-4):
        problem, work, flight, state = begun([dragged], h=h, steps=round(8e-3 / h))
        flight = by_rotors(flight._replace(air=flight.air._replace(gust=table, gust_step=0.04)))
        flight.commands.speeds[:] = state.S[0, 13]
        sampled.fly_ticks(problem, work, flight, state, fleet.sampled_segment(1, 0, 0.56))
        ends.append(state.S[0, :3])
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert errors[0] > 1e-10
    assert 12.0 < errors[0] / errors[1] < 20.0
    assert 12.0 < errors[1] / errors[2] < 20.0


def below(distance: float, aside: float) -> float:
    """Downwash [m/s] at the lower of two hummingbirds with rotors of 0.1 m."""
    vehicle = replace(HUMMINGBIRD, radius=0.1)
    problem, work, flight, state = begun([vehicle] * 2, [[0, 0, 9.0], [aside, 0, 9.0 - distance]])
    flight = flight._replace(air=flight.air._replace(downwash=True))
    call = fleet.sampled_segment(2, 0, 0.01, max_steps=1)
    sampled.fly_ticks(problem, work, flight, state, call)
    air = state.work.air[0]  # at the start of the step
    assert air[0].tolist() == [0, 0, 0]  # nothing from below
    return -float(air[1, 2])


def test_downwash_is_the_published_jet():
    """On its axis the jet has the published speed; it halves at the published width; its momentum stays."""
    l, hover = 0.34, math.sqrt(0.5 * G / (2 * math.pi * 1.225 * 0.01 * 4))
    for s in (1.0, 2.0, 4.0):
        x = s / l + 5.817
        middle = below(s, 0.0)
        assert middle == pytest.approx(10.11 * hover / x, rel=1e-9)
        assert below(s, 0.07668 * l * x) == pytest.approx(0.5 * middle, rel=1e-9)
    # A round jet: the flux of momentum, as U^2 times the square of its width, is the same at all distances
    flux = [below(s, 0.0) * (s / l + 5.817) for s in (1.0, 3.0)]
    assert flux[0] == pytest.approx(flux[1], rel=1e-9)


def test_downwash_pushes_the_lower_vehicle_down():
    """The lower of two vehicles sinks under the jet as by a wind from above of the same speed."""
    vehicle = replace(HUMMINGBIRD, radius=0.1)
    problem, work, flight, state = begun([vehicle] * 2, [[0, 0, 9.0], [0, 0, 5.0]])
    flight = flight._replace(air=flight.air._replace(downwash=True))
    call = fleet.sampled_segment(2, 0, 0.002, [0.0])
    sampled.fly_ticks(problem, work, flight, state, call)
    alone = derivative(vehicle, call.S[0, 1:], call.command[0, 1:], [[0, 0, -below(4.0, 0.0)]])
    np.testing.assert_allclose(call.dS[0, 1], alone[0], rtol=0, atol=1e-12)
    assert call.dS[0, 1, 5] < -0.1


def test_ground_effect():
    """The thrust near the ground is that of the published formula, also for one rotor alone, and fades with height."""
    alone = aerodynamics.ground_effect_factor(0.3, 0.2, np.array([1e6, 1e6]))
    assert alone == pytest.approx(1.0 / (1.0 - (0.2 / (4 * 0.3)) ** 2), rel=1e-12)
    vehicle = replace(HUMMINGBIRD, radius=0.1)
    span = fleet.quadrotor_arrays([vehicle]).span[0]
    np.testing.assert_allclose(span, [0.34 * 0.70710678118, 0.34], rtol=1e-9)
    d, b, R, z = *span, 0.1, 0.2
    terms = z / np.sqrt((d**2 + 4 * z**2) ** 3) + 0.5 * z / np.sqrt((2 * d**2 + 4 * z**2) ** 3)
    terms += 2 * 2.0 * z / np.sqrt((b**2 + 4 * z**2) ** 3)
    ratio = 1 / (1 - (R / (4 * z)) ** 2 - R**2 * terms)
    _, _, flight, state = begun([vehicle], [[0, 0, 1.0 + z]])
    flight = flight._replace(air=flight.air._replace(ground_effect=True, ground=1.0))
    command = state.S[:, 13:]
    a = derivatives(flight, state.S, command)[0, 5]
    assert a == pytest.approx(G * (ratio - 1.0), rel=1e-9)
    assert 1.05 < ratio < 1.3
    heights = [0.01, 0.05, 0.1, 0.3, 3.0]
    gains = [aerodynamics.ground_effect_factor(h, R, span) for h in heights]
    assert gains[0] == gains[1]  # half a radius and below
    assert gains[1:] == sorted(gains[1:], reverse=True)
    assert gains[-1] == pytest.approx(1.0, abs=1e-3)


# -- attitude control ------------------------------------------------------------------------------


def test_flatness():
    """Rates and accelerations of the desired attitude are derivatives of that attitude along a smooth force and yaw."""

    def given(t: float) -> tuple[np.ndarray, ...]:
        s, c = np.sin(np.array([1.1, 0.7, 1.9]) * t), np.cos(np.array([1.1, 0.7, 1.9]) * t)
        w, A = np.array([1.1, 0.7, 1.9]), np.array([3.0, -2.0, 1.5])
        F = np.array([0.5, 0.2, 9.81]) + A * s
        yaw = np.array(
            [0.8 * math.sin(0.9 * t), 0.72 * math.cos(0.9 * t), -0.648 * math.sin(0.9 * t)]
        )
        return F, A * w * c, -A * w * w * s, yaw

    def desired(t: float) -> np.ndarray:
        out = np.zeros((5, 3))
        attitude_control.write_flat_attitude(*given(t), out)
        return out

    h = 1e-3
    for t in (0.3, 1.7, 4.0):
        now = desired(t)
        T = now[:3]
        np.testing.assert_allclose(T @ T.T, np.eye(3), rtol=0, atol=1e-14)
        F, yaw = given(t)[0], given(t)[3][0]
        np.testing.assert_allclose(T[2], F / np.linalg.norm(F), rtol=0, atol=1e-14)
        assert T[1] @ [math.cos(yaw), math.sin(yaw), 0] == pytest.approx(0, abs=1e-14)
        stencil = np.array([-1, 9, -45, 0, 45, -9, 1]) / (60 * h)
        around = np.array([desired(t + k * h) for k in range(-3, 4)])
        T_dot = np.tensordot(stencil, around[:, :3], 1)
        S = -T_dot @ T.T  # [omega x]
        np.testing.assert_allclose(now[3], [S[2, 1], S[0, 2], S[1, 0]], rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            now[4], np.tensordot(stencil, around[:, 3], 1), rtol=0, atol=1e-9
        )


def test_tilt_limit():
    """A force within the limit stays; beyond, it keeps its vertical part and direction of tilt, and has the limit."""
    limit = math.radians(30)
    F = np.array([1.0, -2.0, 9.0])
    kept = F.copy()
    assert not attitude_control.limit_tilt_in_place(kept, limit, 10.0)
    assert kept.tolist() == F.tolist()
    F = np.array([6.0, -8.0, 9.0])
    cut = F.copy()
    assert attitude_control.limit_tilt_in_place(cut, limit, 10.0)
    assert cut[2] == 9.0
    assert math.hypot(*cut[:2]) == pytest.approx(9.0 * math.tan(limit))
    assert cut[0] / cut[1] == pytest.approx(F[0] / F[1])
    down = np.array([3.0, 0.0, -4.0])
    assert attitude_control.limit_tilt_in_place(down, limit, 10.0)
    assert down[2] == pytest.approx(0.5)
    free = np.array([3.0, 0.0, -4.0])
    assert not attitude_control.limit_tilt_in_place(free, math.pi, 10.0)
    assert free.tolist() == [3.0, 0.0, -4.0]


def test_attitude_torque_vanishes_on_the_way_and_leads_back():
    """At the desired attitude and rates torque is that of the motion; small errors meet -k_R e_R - k_omega e_omega."""
    rng = np.random.default_rng(3)
    inertia, k_R, k_omega = (
        np.array([0.01, 0.012, 0.019]),
        np.array([500.0, 400, 90]),
        np.array([40.0, 35, 9]),
    )
    T = Rotation.random(rng=rng).as_matrix()
    desired = np.vstack([T, rng.normal(size=(2, 3))])
    tau = np.zeros(3)
    attitude_control.write_attitude_torque(T, desired[3], desired, inertia, k_R, k_omega, tau)
    motion = inertia * desired[4] + np.cross(desired[3], inertia * desired[3])
    np.testing.assert_allclose(tau, motion, rtol=0, atol=1e-14)
    small = 1e-7 * rng.normal(size=3)
    turned = Rotation.from_rotvec(-small).as_matrix() @ T  # world -> a body turned by `small`
    rest = np.vstack([T, np.zeros((2, 3))])
    omega = 1e-7 * rng.normal(size=3)
    attitude_control.write_attitude_torque(turned, omega, rest, inertia, k_R, k_omega, tau)
    np.testing.assert_allclose(tau, -inertia * (k_R * small + k_omega * omega), rtol=1e-6)


def lexicographic(thrust, tau, B, least, most) -> np.ndarray:
    """Forces of rotors by three linear programmes: roll and pitch first, then thrust, then yaw."""
    roll_pitch, each = B[:, 1] * tau[0] + B[:, 2] * tau[1], B[:, :1]
    limits = np.r_[np.full(4, most), np.full(4, -least)]
    # share of roll and pitch, with any thrust
    A = np.vstack([np.c_[roll_pitch, each], -np.c_[roll_pitch, each]])
    share = linprog([-1, 0], A, limits, bounds=[(0, 1), (None, None)]).x[0]
    # thrust nearest to the one asked for: z >= |T - thrust|
    fixed = share * roll_pitch
    A = np.vstack([np.c_[each, np.zeros(4)], -np.c_[each, np.zeros(4)], [[1, -1]], [[-1, -1]]])
    room = limits - np.r_[fixed, -fixed] + 1e-12
    T = linprog([0, 1], A, np.r_[room, thrust, -thrust], bounds=[(None, None), (0, None)]).x[0]
    yaw = (B[:, 3] * tau[2])[:, None]
    fixed = fixed + each[:, 0] * T
    k = linprog(
        [-1], np.vstack([yaw, -yaw]), limits - np.r_[fixed, -fixed] + 1e-12, bounds=[(0, 1)]
    ).x[0]
    return fixed + k * yaw[:, 0]


def test_allocation_keeps_its_priorities():
    """Within limits the wrench is exact; beyond, forces are those of roll and pitch first, then thrust, then yaw."""
    rng, f, saturated = np.random.default_rng(0), np.zeros(4), 0
    uneven = replace(
        PAPER, rotors=[[0.2, 0.15, 0], [0.15, -0.2, 0], [-0.2, -0.15, 0], [-0.15, 0.25, 0]]
    )
    for vehicle in (PAPER, uneven):
        B = vehicle.wrench_to_rotors(G)
        for _ in range(100):
            thrust, tau = (
                rng.uniform(-5, 30),
                rng.normal(size=3) * rng.choice([0.1, 1.0, 3.0]) * [1, 1, 0.2],
            )
            if attitude_control.allocate_rotors(thrust, tau, B, 0.1, 5.9, f):
                saturated += 1
                np.testing.assert_allclose(
                    f, lexicographic(thrust, tau, B, 0.1, 5.9), rtol=0, atol=1e-7
                )
            else:
                np.testing.assert_allclose(np.linalg.inv(B) @ f, [thrust, *tau], rtol=0, atol=1e-12)
            assert f.min() >= 0.1
            assert f.max() <= 5.9
    assert 50 < saturated < 190


def test_rotor_speeds_invert_the_thrust_curve():
    """Commanded speeds have the forces asked for, by any quadratic curve, and stay within the limits."""
    curve, limits, out = np.array([0.01, -5e-6, 6e-8]), np.array([100.0, 2000.0]), np.zeros(4)
    f = np.array([0.02, 0.1, 0.2, 5.0])
    attitude_control.rotor_speeds(f, curve, limits, out)
    np.testing.assert_allclose(np.polynomial.polynomial.polyval(out[:3], curve), f[:3], rtol=1e-12)
    assert out[3] == 2000.0


def test_thrust_and_attitude_can_be_commanded():
    """A user's thrust and attitude are taken: the vehicle turns there and accelerates by its thrust."""
    problem, work, flight, state = begun([replace(HUMMINGBIRD, **NO_AIR)])
    q = attitude.quaternion_from_euler([0.2, -0.1, 0.7])
    commands = flight.commands._replace(
        kind=fleet.ATTITUDE, thrust=np.array([6.0]), attitude=q[None].copy()
    )
    flight = flight._replace(commands=commands)
    call = fleet.sampled_segment(1, 0, 2.0, [2.0])
    sampled.fly_ticks(problem, work, flight, state, call)
    assert attitude.angle_between(state.S[0, 6:10], q) < 1e-6
    expected = attitude.dcm_from_quaternion(q).T @ [0, 0, 12.0] - [0, 0, G]
    np.testing.assert_allclose(call.dS[0, 0, 3:6], expected, rtol=0, atol=1e-4)


def test_rotors_that_cannot_turn_or_lift_the_vehicle_are_refused():
    """Rotors at one place have no torque, and rotors beside the centre of mass cannot hover: errors say so."""
    aside = np.array([[0.3, 0.1, 0], [0.3, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0]])
    with pytest.raises(ValueError, match="cannot hover"):
        fleet.quadrotor_arrays([replace(PAPER, rotors=aside)])
    with pytest.raises(ValueError, match="do not span thrust and three torques"):
        fleet.quadrotor_arrays([replace(PAPER, rotors=np.zeros((4, 3)))])
