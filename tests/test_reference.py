"""Every case of the independent reference, through documented public calls only.

`data/README.md` says where the numbers come from and how accurate they are.
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rigidfleet import physics, simulate
from rigidfleet.math import attitude, lqr, pid
from rigidfleet.mission import Mission

CASES = json.loads((Path(__file__).parent / "data" / "reference_cases.json").read_text())["cases"]
FLIGHTS = [name for name, case in CASES.items() if "solver" in case["spec"]]
TIGHT = {"rtol": 1e-11, "atol": 1e-13}
SOLVERS = {
    "inv": ("exact",),
    "vdamp": ("spectral", "threshold"),
    "itik": ("iterated", "damping", "iterations"),
}


def segments(spec: dict[str, Any]) -> tuple[str, list[tuple[float, list[float]]]]:
    """Kind of reference, and (start, distances) of each segment, as a case words its schedule."""
    schedule = spec["schedule"]
    if isinstance(schedule, dict):
        if "segments" in schedule:
            return "distances", schedule["segments"]
        return "step", [(0.0, schedule["step_at_0"])]
    if schedule.startswith("step to"):
        numbers = re.split(r" at ", schedule)[0]
        return "step", [(0.0, [float(d) for d in re.findall(r"[\d.]+", numbers)])]
    parts = re.findall(r"\[([\d.,]+)\]@([\d.]+)", schedule)
    return "distances", [(float(t), [float(x) for x in d.split(",")]) for d, t in parts]


def a_mission(spec: dict[str, Any], step: float = 0.05, **integrator: float) -> Mission:
    """The mission that a case describes."""
    reference, parts = segments(spec)
    name, *values = spec["solver"]
    solver, *keys = SOLVERS[name]
    ends = [t for t, _ in parts[1:]] + [spec["T"]]
    data: dict[str, Any] = {
        "schema_version": 1,
        "name": "reference",
        "output_step": step,
        "agents": {"mass": spec["masses"], "position": spec["r0"]},
        "constraint": {
            "solver": solver,
            "deformation_damping": spec["kdef"],
            **{gain: spec[gain] for gain in ("alpha", "beta", "gamma")},
            **dict(zip(keys, values, strict=True)),
        },
        "formations": {
            f"shape {k}": {"edges": spec["edges"], "distances": d} for k, (_, d) in enumerate(parts)
        },
        "phases": [
            {
                "kind": "reshape" if k else "establish",
                "formation": f"shape {k}",
                "reference": reference,
                "control": "open",
                "input_force": [0.1, 0.1, 0.0],
                "until": float(end),
            }
            for k, end in enumerate(ends)
        ],
    }
    if integrator:
        data["integrator"] = integrator
    return Mission.from_dict(data)


def test_every_case_is_tested():
    """A case that is added to the file cannot be overlooked."""
    others = {"01", "11", "12", "13", "16", "17"}
    assert {name[:2] for name in CASES} == others | {name[:2] for name in FLIGHTS}


@pytest.mark.parametrize(("integrator", "motion", "force"), [({}, 2e-7, 2e-6), (TIGHT, 5e-9, 5e-8)])
@pytest.mark.parametrize("name", FLIGHTS)
def test_flights(name, integrator, motion, force):
    """Positions, errors, integrals and multipliers are the reference's: by default and tightly."""
    spec, expected = CASES[name]["spec"], CASES[name]["result"]
    result = simulate(a_mission(spec, **integrator), times=expected["t"])
    assert result.complete
    np.testing.assert_array_equal(result.time, expected["t"])
    for attribute, key in (
        ("position", "r"), ("velocity", "v"), ("constraint", "c"), ("distance", "d"),
        ("integral", "I"),
    ):  # fmt: skip
        if key in expected:
            np.testing.assert_allclose(
                getattr(result, attribute), expected[key], rtol=0, atol=motion, err_msg=attribute
            )
    f_C = np.linalg.norm(result.constraint_force, axis=2)
    np.testing.assert_allclose(f_C, expected["fC_norm_per_agent"], rtol=0, atol=force)
    if "lam" in expected:
        np.testing.assert_allclose(result.multiplier, expected["lam"], rtol=0, atol=force)
    if "kinetic" in expected:
        energy = 0.5 * spec["masses"] * (result.velocity**2).sum(axis=(1, 2))
        np.testing.assert_allclose(energy, expected["kinetic"], rtol=0, atol=10 * motion)
    if "all_pairs_final" in expected:
        i, j = np.triu_indices(spec["N"], 1)
        pairs = np.linalg.norm(result.position[-1, i] - result.position[-1, j], axis=1)
        np.testing.assert_allclose(pairs, expected["all_pairs_final"], rtol=0, atol=motion)


@pytest.mark.parametrize("name", FLIGHTS)
def test_peaks_of_the_constraint_force(name):
    """The peak of |f_C| on the reference's grid of samples is the reference's."""
    spec, expected = CASES[name]["spec"], CASES[name]["result"]
    fine = "peak_fC_on_0p01s_grid" in expected
    result = simulate(a_mission(spec, step=0.01 if fine else 0.05))
    peaks = np.linalg.norm(result.constraint_force, axis=2).max(axis=0)
    if fine:
        assert peaks.max() == pytest.approx(expected["peak_fC_on_0p01s_grid"], rel=1e-6)
    else:
        np.testing.assert_allclose(peaks, expected["peak_fC_on_0p05s_grid"], rtol=1e-6)


@pytest.mark.parametrize("name", FLIGHTS)
def test_multipliers_at_the_reference_states(name):
    """One call at each state of the reference, its integral included, gives the force it has there."""
    spec, expected = CASES[name]["spec"], CASES[name]["result"]
    reference, parts = segments(spec)
    solver, *keys = SOLVERS[spec["solver"][0]]
    options: dict[str, Any] = {"solver": solver, **dict(zip(keys, spec["solver"][1:], strict=True))}
    edges = np.array(spec["edges"]) - 1
    m = np.full(spec["N"], spec["masses"])
    r0 = np.array(spec["r0"])
    starts = [np.linalg.norm(r0[edges[:, 0]] - r0[edges[:, 1]], axis=1), *(d for _, d in parts)]
    for k, t in enumerate(expected["t"]):
        segment = max(i for i, (start, _) in enumerate(parts) if start < t)
        start, goal = parts[segment]
        blend = 4.0 if reference == "distances" else 0.0
        d, d_dot, d_ddot = physics.distance_schedule(
            starts[segment], goal, t, start=start, blend=blend
        )
        r, v = np.array(expected["r"][k]), np.array(expected["v"][k])
        f = np.tile([0.1, 0.1, 0.0], (len(m), 1))
        if spec["kdef"]:
            x, y = r - r.mean(axis=0), v - v.mean(axis=0)
            inertia = (x**2).sum() * np.eye(3) - x.T @ x
            omega = np.linalg.pinv(inertia, 1e-9) @ np.cross(x, y).sum(axis=0)
            f -= spec["kdef"] * (y - np.cross(omega, x))
        force = physics.constraint_force(
            r, v, m, edges, d[0], d_dot=d_dot[0], d_ddot=d_ddot[0], integral=expected["I"][k],
            f_E=f, alpha=spec["alpha"], beta=spec["beta"], gamma=spec["gamma"],
            **options,
        )  # fmt: skip
        found = np.linalg.norm(force.f_C, axis=1)
        # Rounding of the states read back, divided by the smallest eigenvalue near the line.
        np.testing.assert_allclose(found, expected["fC_norm_per_agent"][k], rtol=0, atol=1e-8)
        np.testing.assert_allclose(force.c, expected["c"][k], rtol=0, atol=1e-11)
        if "lam" in expected:
            np.testing.assert_allclose(force.multiplier, expected["lam"][k], rtol=0, atol=1e-8)


def test_unit_response_of_the_error():
    """The error's closed form, at a triple pole, is the reference's."""
    spec, expected = CASES["01_pid_unit_response"].values()
    c, _, _ = pid.error_response(
        spec["alpha"], spec["beta"], spec["gamma"], spec["c0"], spec["cdot0"], spec["I0"],
        expected["t"],
    )  # fmt: skip
    np.testing.assert_allclose(c, expected["c"], rtol=0, atol=1e-13)


def test_shape_schedule():
    """Distances of a blended shape and two derivatives, the triangle folding into a line."""
    spec, expected = CASES["11_shape_schedule"].values()
    found = physics.shape_schedule(
        spec["p0"], spec["p1"], np.array(spec["edges"]) - 1, expected["t"],
        start=spec["t_start"], blend=spec["Tb"],
    )  # fmt: skip
    np.testing.assert_allclose(
        np.swapaxes(found, 0, 1), expected["d_d1_d2"], rtol=1e-11, atol=1e-12
    )


@pytest.mark.parametrize("formulation", ["inertial", "body"])
def test_equations_of_motion(formulation):
    """Three unequal masses under forces of t, r and v: Newton and the body frame agree with the reference.

    So do the quaternion and the rates of the mean-axis frame.
    """
    spec, expected = CASES["12_eom_N3"].values()
    n = len(spec["masses"])
    k = np.arange(1, n + 1)

    def force(t: float, r: np.ndarray, v: np.ndarray) -> np.ndarray:
        pushed = [np.sin(t + k), np.cos(1.3 * t * k / n), 0.5 * np.sin(0.7 * t) * k / n]
        return np.stack(pushed, axis=1) - 0.2 * v + 0.05 * r[:, [2, 0, 1]]

    roll, pitch, yaw = np.rad2deg(spec["euler0"])
    mission = Mission.from_dict(
        {
            "schema_version": 1,
            "name": "eom",
            "formulation": formulation,
            "gravity": 0.0,
            "agents": {
                "mass": spec["masses"],
                "position": spec["r0"],
                "velocity": np.stack([np.sin(k), np.cos(2 * k), np.sin(3 * k)], axis=1),
            },
            "body_frame": {"roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw},
            "integrator": {"rtol": 1e-10, "atol": 1e-12},
            "phases": [{"kind": "hold", "control": "open", "until": 6.0}],
        }
    )
    result = simulate(mission, force=force, times=expected["t"])
    np.testing.assert_allclose(result.position, expected["r"], rtol=0, atol=1e-8)
    np.testing.assert_allclose(result.velocity, expected["v"], rtol=0, atol=1e-8)
    assert attitude.angle_between(result.attitude, expected["q"]).max() < 1e-8
    np.testing.assert_allclose(result.rates, expected["omega_b"], rtol=0, atol=1e-8)


def test_finite_horizon_gains():
    """Riccati solutions over the time to go, and their limit, are the reference's."""
    spec, expected = CASES["13_lqr_finite_gains"].values()
    A, B, Q, R, S = (np.array(spec[key]) for key in "ABQRS")
    P, K = lqr.finite_horizon(A, B, Q, R, S, expected["time_to_go"])
    np.testing.assert_allclose(P, expected["P"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(K[:, 0], expected["K"], rtol=1e-9, atol=1e-9)
    K_inf = lqr.infinite_horizon(A, B, Q, R)[0][0]
    np.testing.assert_allclose(K_inf, expected["K_inf"], rtol=1e-9)
    np.testing.assert_allclose(lqr.double_integrator_gains(Q, R), expected["K_inf"], rtol=1e-9)


@pytest.mark.parametrize("method", ["rigid", "pinv_equal", "pinv_inertia", "pinv_inertia+force"])
@pytest.mark.parametrize("shape", ["triangle", "line", "cube", "tetra"])
def test_allocation(shape, method):
    """A wrench shared by each method: the forces, and the wrench that really results."""
    spec = CASES["16_allocation"]["spec"]
    case = CASES["16_allocation"]["result"][shape]
    name, _, split = method.partition("_")
    options: dict[str, Any] = {"method": name} | ({"torque_split": split} if split else {})
    f = physics.allocate(
        case["x"], case["masses"], spec["F"], spec["tau"], spec["omega"], **options
    )
    np.testing.assert_allclose(f, case[f"{method}_f" if split else method], rtol=0, atol=1e-11)
    np.testing.assert_allclose(
        physics.wrench(case["x"], case["masses"], f), case[f"{method}_wrench"], rtol=0, atol=1e-11
    )


@pytest.mark.parametrize("case", CASES["17_quaternion_dcm"]["result"]["list"])
def test_attitude(case):
    """Direction cosines, quaternions and their rates from 3-2-1 Euler angles."""
    euler = np.deg2rad(case["euler_deg"])
    T, q = attitude.dcm_from_euler(euler), attitude.quaternion_from_euler(euler)
    np.testing.assert_allclose(T, case["T"], rtol=0, atol=1e-15)
    sign = np.sign(q @ case["q"])  # q and -q are one attitude; half a turn has either
    np.testing.assert_allclose(sign * q, case["q"], rtol=0, atol=1e-15)
    np.testing.assert_allclose(attitude.dcm_from_quaternion(q), case["T"], rtol=0, atol=1e-15)
    rate = attitude.quaternion_rate(case["q"], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(rate, case["Omega_q_half_w123"], rtol=0, atol=1e-15)
