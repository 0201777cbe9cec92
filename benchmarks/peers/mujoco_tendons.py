"""MuJoCo: point bodies on three slides each, every edge an equality constraint of a spatial tendon."""

from __future__ import annotations

import numpy as np

from rigidfleet.formation import distance_geometry

from .case import DURATION, STEPS, AbsentError, Array, Case, Flight, Peer, timed


def peer() -> Peer:
    """Fourth-order Runge-Kutta, at a step."""
    try:
        import mujoco
    except ImportError:
        raise AbsentError("MuJoCo: .venv/bin/uv pip install mujoco") from None
    return Peer(
        "MuJoCo",
        mujoco.__version__,
        "soft constraints, set as stiff as they get (impedance 0.9999), with our alpha and beta but without"
        " the integral and without the centripetal term of turning edges; steps of equal length",
        False,
        STEPS,
        "step [s]",
        flight,
    )


def flight(case: Case, step: float) -> Flight:
    """RK4 with Newton's solver."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(_xml(case, step))
    data = mujoco.MjData(model)
    steps = round(DURATION / step)

    def fly() -> Array:
        mujoco.mj_resetData(model, data)
        data.xfrc_applied[1:, :3] = case.force
        mujoco.mj_step(model, data, steps)
        return case.r + data.qpos.reshape(-1, 3)

    return timed(fly)


def _xml(case: Case, step: float) -> str:
    """The model."""
    alpha, beta, _ = case.gains
    slides = "".join(f'<joint type="slide" axis="{a}"/>' for a in ("1 0 0", "0 1 0", "0 0 1"))
    bodies = "".join(
        f'<body pos="{_row(r)}">{slides}<site name="s{k}"/>'
        f'<inertial pos="0 0 0" mass="{m!r}" diaginertia="1e-6 1e-6 1e-6"/></body>'
        for k, (r, m) in enumerate(zip(case.r, case.m.tolist(), strict=True))
    )
    edges = case.edges.tolist()
    tendons = "".join(
        f'<spatial name="t{k}"><site site="s{i}"/><site site="s{j}"/></spatial>'
        for k, (i, j) in enumerate(edges)
    )
    # An equality holds a tendon's length beyond that at the start.
    change = (case.d - distance_geometry.distances(case.r, case.edges)).tolist()
    equalities = "".join(
        f'<tendon tendon1="t{k}" polycoef="{x!r} 0 0 0 0" solref="{-(beta**2)!r} {-2 * alpha!r}"'
        ' solimp="0.9999 0.9999 0.001"/>'
        for k, x in enumerate(change)
    )
    return (
        f'<mujoco><option timestep="{step!r}" gravity="0 0 0" integrator="RK4" tolerance="1e-10">'
        '<flag contact="disable"/></option>'
        f"<worldbody>{bodies}</worldbody><tendon>{tendons}</tendon><equality>{equalities}</equality></mujoco>"
    )


def _row(x: Array) -> str:
    return " ".join(map(repr, np.asarray(x).tolist()))
