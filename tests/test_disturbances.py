"""Disturbed flights against closed forms: drift, offsets, parabolas; what laws see and what is true."""

import copy
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from rigidfleet import assess, simulate
from rigidfleet.kernel.disturbances import write_spline_value
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning import disturbances
from rigidfleet.result import Result

G = 9.81
START = [[0.0, 0.0, 20.0], [4.0, 0.0, 20.0], [2.0, 3.4641016151377544, 20.0]]


def mission(disturbed, *, phases=None, edges="complete", **tables) -> Mission:
    """Three vehicles that form a triangle and hold it, or what is asked."""
    hold = [{"kind": "establish", "formation": "triangle", "duration": 12.0}]
    data = {
        "schema_version": 1,
        "name": "disturbed",
        "agents": {"mass": [1.0, 1.5, 2.0], "position": START} | tables.pop("agents", {}),
        "formations": {"triangle": {"shape": "triangle", "size": 4.0, "edges": edges}},
        "phases": hold if phases is None else phases,
        "disturbances": disturbed,
    }
    return Mission.from_dict(data | tables)


OPEN = [{"kind": "hold", "control": "open", "duration": 10.0}]
FIRST = {"model": "first-order", "time_scale": 1.0, "intensity": 0.5}


# -- tables


def test_the_kernels_spline_is_scipys():
    """Between knots the kernel evaluates the natural cubic spline, and outside of them it is constant."""
    from rigidfleet.planning.filters import spline_coefficients

    y = np.random.default_rng(0).standard_normal((20, 2, 3))
    table, out = spline_coefficients(y), np.empty((2, 3))
    reference = CubicSpline(0.3 * np.arange(20), y, bc_type="natural")
    for t in (0.0, 0.123, 0.3, 2.9, 5.6999, 5.7):
        write_spline_value(t, 0.3, table, out)
        np.testing.assert_allclose(out, reference(t), atol=1e-12)
    for t, end in ((-1.0, 0), (9.0, -1), (1e300, -1)):
        write_spline_value(t, 0.3, table, out)
        np.testing.assert_allclose(out, y[end], atol=1e-12)


def knots(table):
    """Values at the knots from coefficients."""
    return (table[:-2] + 4 * table[1:-1] + table[2:]) / 6


def test_gusts_of_a_mission_have_the_stated_statistics():
    """Standard deviation by axis of the wind, correlation between agents and correlation time: within 4 sigma."""
    sigma = [1.0, 0.6, 0.2]
    gusts = FIRST | {"intensity": sigma, "correlation": 0.4, "seed": 5}
    long = [{"kind": "hold", "control": "open", "duration": 2000.0}]
    wind = np.array([3.0, 4.0, 0.0])
    d = disturbances.mission_disturbance(
        mission({"wind": wind, "gusts": gusts}, phases=long, output_step=1.0)
    )
    u = knots(d.gust)
    along = u @ np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1.0]]).T
    np.testing.assert_allclose(along.std(axis=(0, 1)), sigma, rtol=0.06)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert np.corrcoef(along[:, i, 0], along[:, j, 0])[0, 1] == pytest.approx(0.4, abs=0.12)
    lag = round(1.0 / d.gust_step)
    x = along[:, :, 0]
    assert np.mean(x[:-lag] * x[lag:]) / np.mean(x * x) == pytest.approx(np.exp(-1), abs=0.1)
    assert abs(np.corrcoef(x[:, 0], along[:, 0, 2])[0, 1]) < 0.1


def test_dryden_gusts_have_drydens_spectrum():
    """The spectrum of gusts in a mission, averaged, is MIL-F-8785C's along the wind and across it, within 10 %."""
    gusts = {"model": "dryden", "length": 6.0, "intensity": 0.8, "seed": 2}
    long = [{"kind": "hold", "control": "open", "duration": 3000.0}]
    m = mission({"wind": [3.0, 0, 0], "gusts": gusts}, phases=long, output_step=1.0)
    from scipy.signal import welch

    d = disturbances.mission_disturbance(m)
    f, S = welch(knots(d.gust), 1 / d.gust_step, nperseg=1024, axis=0)
    S = S.mean(axis=1)  # over agents
    x = 2.0 * 2 * np.pi * f  # L omega / V
    along = 0.64 * 4 * 2.0 / (1 + x**2)
    across = 0.64 * 2 * 2.0 * (1 + 3 * x**2) / (1 + x**2) ** 2
    band = (f > 0.03) & (f < 1.5)
    for axis, theory in ((0, along), (1, across), (2, across)):
        ratio = S[band, axis] / theory[band]
        assert (
            np.abs(ratio.reshape(-1)[: len(ratio) // 10 * 10].reshape(10, -1).mean(1) - 1).max()
            < 0.12
        )


def test_altitude_gives_lengths_and_intensities():
    """At 20 m in a wind of 5 m/s the vertical deviation is 0.5 m/s, those along the ground are larger as specified."""
    gusts = {"model": "dryden", "altitude": 20.0, "seed": 3}
    long = [{"kind": "hold", "control": "open", "duration": 4000.0}]
    m = mission({"wind": [0.0, 5.0, 0.0], "gusts": gusts}, phases=long, output_step=1.0)
    u = knots(disturbances.mission_disturbance(m).gust)
    factor = 0.177 + 0.000823 * 20 / 0.3048
    assert u[..., 2].std() == pytest.approx(0.5, rel=0.05)
    assert u[..., :2].std() == pytest.approx(0.5 / factor**0.4, rel=0.1)


def test_noise_has_the_stated_deviation():
    """At the sensor's ticks the noise has the stated deviations and is white; between them it falls to 0.87 of them."""
    noise = {"position": 0.02, "velocity": 0.1, "rate": 20.0, "seed": 4}
    long = [{"kind": "hold", "control": "open", "duration": 500.0}]
    d = disturbances.mission_disturbance(mission({"noise": noise}, phases=long))
    assert d.noise_step == 0.05
    for table, sigma in ((d.noise_r, 0.02), (d.noise_v, 0.1)):
        x = knots(table)
        assert x.std() == pytest.approx(sigma, rel=0.02)
        assert abs(np.mean(x[1:] * x[:-1])) < 0.02 * sigma**2
        middle = (table[:-3] + 23 * table[1:-2] + 23 * table[2:-1] + table[3:]) / 48
        assert middle.std() == pytest.approx(0.873 * sigma, rel=0.02)
    r = knots(d.noise_r).ravel()
    assert abs(np.corrcoef(r, knots(d.noise_v).ravel())[0, 1]) < 0.02


def test_a_longer_mission_meets_the_same_air():
    """Gusts and noise of a mission twice as long begin alike, to where the spline's end shows."""
    tables = {"gusts": FIRST, "noise": {"position": 0.1}}
    d, long = (
        disturbances.mission_disturbance(mission(tables, phases=[OPEN[0] | {"duration": t}]))
        for t in (10.0, 20.0)
    )
    for a, b in ((d.gust, long.gust), (d.noise_r, long.noise_r)):
        np.testing.assert_allclose(b[: len(a) - 40], a[:-40], rtol=0, atol=1e-12)


# -- wind


def test_a_constant_wind_gives_the_terminal_drift():
    """Without control, v = w (1 - exp(-c t / m)), each vehicle by its own drag and mass, and the drift that follows."""
    w, c = np.array([3.0, -1.0, 0.5]), np.array([0.2, 0.5, 2.0])
    result = simulate(mission({"wind": w, "drag": c}, phases=OPEN))
    k = c / np.array([1.0, 1.5, 2.0])
    t = result.time[:, None]
    share = 1 - np.exp(-k * t)
    np.testing.assert_allclose(result.velocity, share[:, :, None] * w, rtol=0, atol=1e-7)
    drift = (t - share / k)[:, :, None] * w
    np.testing.assert_allclose(result.position - START, drift, rtol=0, atol=1e-7)
    force = c[:, None] * (w - result.velocity)
    assert result.disturbance_force is not None
    np.testing.assert_allclose(result.disturbance_force, force, atol=1e-12)


def test_wind_holds_tracking_off_by_its_force():
    """At rest in a wind, a vehicle that tracks alone is c w / (m k1) off its slot, k1 = 2 /s^2 by default."""
    result = simulate(mission({"wind": [2.0, 0, 0], "drag": 0.4}, edges=[], phases=[
        {"kind": "establish", "formation": "triangle", "duration": 40.0}]))  # fmt: skip
    off = (result.position - result.slot_position)[-1]
    expected = 0.4 * 2.0 / (2.0 * np.array([1.0, 1.5, 2.0]))
    np.testing.assert_allclose(off[:, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(off[:, 1:], 0.0, atol=1e-7)


def test_the_constraint_law_is_not_told():
    """In the flights of the theory's table, a law that is told of gusts keeps lengths to 1e-6 m; that of a mission has
    only its feedback: 0.12 m, or 4 mm with poles five times as fast, where tracking alone loses 0.53 m."""
    air = {"wind": [2.0, 1.0, 0.0], "drag": 0.25, "gusts": FIRST | {"intensity": 1.7}}
    phases = [
        FLY[0] | {"duration": 6.0, "attitude": "free"},
        FLY[1] | {"position": [35.0, 5.0, 25.0], "duration": 20.0},
    ]
    tables: dict[str, Any] = {"phases": phases, "agents": {"mass": 1.0}}
    m = mission(air, **tables)
    d, calm = disturbances.mission_disturbance(m), m.to_dict()
    del calm["disturbances"]

    def force(t, r, v):
        u = np.empty_like(r)
        write_spline_value(t, d.gust_step, d.gust, u)
        return d.drag[:, None] * (d.wind + u - v)

    def worst(result):
        r = result.position[result.time > 12.0]
        return np.abs(np.linalg.norm(r[:, [0, 0, 1]] - r[:, [1, 2, 2]], axis=2) - 4.0).max()

    fast = {"alpha": 15.0, "beta": np.sqrt(300.0), "gamma": 1000.0}
    assert worst(simulate(Mission.from_dict(calm), force=force)) < 1e-6
    assert worst(simulate(m)) == pytest.approx(0.12, abs=0.01)
    assert worst(simulate(mission(air, constraint=fast, **tables))) == pytest.approx(4e-3, abs=4e-4)
    assert worst(simulate(mission(air, edges=[], **tables))) == pytest.approx(0.53, abs=0.02)


def test_force_given_by_the_user_is_still_told():
    """A force of the user's own still enters the constraint law, beside a disturbance that does not."""

    def push(_t, _r, _v):
        return np.outer([1.0, -1.0, 0.0], [1.0, 0, 0])

    phases = [OPEN[0] | {"kind": "establish", "formation": "triangle", "duration": 4.0}]
    result = simulate(mission({"drag": 0.01}, phases=phases), force=push)
    assert np.abs(result.constraint).max() < 5e-3
    np.testing.assert_allclose(result.multiplier[-1, 0], 1.0, atol=0.05)


# -- masses


def test_a_wrong_mass_gives_the_steady_offset():
    """A vehicle heavier by e sinks to e g / k1 below its slot; its recorded forces obey Newton with the true mass."""
    e = np.array([0.1, 0.0, -0.05])
    result = simulate(mission({"mass_error": e}, edges=[], phases=[
        {"kind": "establish", "formation": "triangle", "duration": 40.0}]))  # fmt: skip
    off = (result.position - result.slot_position)[-1]
    np.testing.assert_allclose(off[:, 2], -e * G / 2.0, rtol=1e-6, atol=1e-8)
    true = np.array([1.0, 1.5, 2.0]) * (1 + e)
    total = result.external_force + result.input_force + result.constraint_force
    np.testing.assert_allclose(true[:, None] * result.acceleration, total, atol=1e-9)


@pytest.mark.parametrize("architecture", ["local", "body"])
def test_both_formulations_fly_disturbed_alike(architecture):
    """Newton's equations and the paper's in the body frame fly through wind, wrong masses and noise alike."""
    disturbed = {
        "wind": [1.0, 0.5, 0],
        "mass_error": 0.02,
        "noise": {"position": 0.01, "rate": 5.0},
    }
    phases = [
        {
            "kind": "establish",
            "formation": "triangle",
            "control": "open",
            "blend": 1.0,
            "duration": 2.0,
        },
        {"kind": "fly", "position": [4.0, 3.0, 21.0], "yaw_deg": 70.0, "duration": 6.0},
    ]
    a, b = (
        simulate(mission(disturbed, phases=phases, architecture=architecture, formulation=f))
        for f in ("inertial", "body")
    )
    np.testing.assert_allclose(b.position, a.position, rtol=0, atol=2e-6)


# -- noise


def test_laws_see_noise_and_newton_does_not():
    """Measured minus true is the noise; the true flight obeys Newton, the input law the measured state."""
    noise = {"position": 0.02, "velocity": 0.05, "rate": 20.0, "seed": 1}
    m = mission({"noise": noise}, edges=[])
    result = simulate(m)
    assert result.measured_position is not None
    assert result.measured_velocity is not None
    table = knots(disturbances.mission_disturbance(m).noise_r)
    reference = CubicSpline(0.05 * np.arange(len(table)), table, bc_type="natural")
    error = result.measured_position - result.position
    np.testing.assert_allclose(error, reference(result.time), atol=1e-12)
    masses = np.array(m.agents.mass)[:, None]
    total = result.external_force + result.input_force
    np.testing.assert_allclose(masses * result.acceleration, total, atol=1e-9)
    # At rest on the slots, f = m (g - k1 e - k2 de) with what is measured, k1 = 2, k2 = sqrt(8).
    k = -1
    e = result.measured_position[k] - result.slot_position[k]
    f = masses * ([0, 0, G] - 2 * e - np.sqrt(8.0) * result.measured_velocity[k])
    np.testing.assert_allclose(result.input_force[k], f, atol=1e-6)


def test_steps_end_at_the_knots_of_gusts_and_noise():
    """Where third derivatives jump, steps end: at the default tolerances, positions are within 1e-9 m."""
    disturbed = {
        "wind": [1.0, 0.0, 0.0], "drag": 0.3, "gusts": FIRST | {"seed": 1},
        "noise": {"position": 0.01, "velocity": 0.03, "rate": 50.0, "seed": 1},
    }  # fmt: skip
    stiff = {
        "edges": [], "tracking": {"Q": [600.0, 60.0]},
        "phases": [{"kind": "establish", "formation": "triangle", "duration": 6.0}],
    }  # fmt: skip
    exact = simulate(mission(disturbed, integrator={"rtol": 1e-12, "atol": 1e-14}, **stiff))
    flown = simulate(mission(disturbed, **stiff))
    assert np.abs(flown.position - exact.position).max() < 1e-9
    assert flown.statistics["rejected"] < 0.01 * flown.statistics["steps"]


def test_a_users_controller_sees_what_is_measured():
    """An observation holds measured positions: a controller can tell them from the truth."""
    seen = []

    def control(now):
        seen.append((now.t, now.position))
        return now.masses[:, None] * (now.reference_acceleration + [0, 0, G])

    m = mission({"noise": {"position": 0.5, "rate": 10.0}}, phases=[
        {"kind": "establish", "formation": "triangle", "blend": 0.5, "duration": 1.0}])  # fmt: skip
    result = simulate(m, controller=control, rate=10.0)
    np.testing.assert_allclose(
        seen[0][1], knots(disturbances.mission_disturbance(m).noise_r)[0] + START
    )
    assert result.measured_position is not None


# -- vehicles lost


LOST = {"lost": [{"agent": 2, "time": 8.0}]}
FLY = [
    {"kind": "establish", "formation": "triangle", "duration": 5.0},
    {"kind": "fly", "position": [20.0, 5.0, 25.0], "duration": 10.0},
]


def test_a_lost_vehicle_falls_on_a_parabola():
    """Without air it flies on at its last velocity under gravity alone, and no law moves it."""
    result = simulate(mission(LOST, phases=FLY))
    k = int(np.searchsorted(result.time, 8.0))
    assert result.time[k] == 8.0
    assert result.time[k + 1] == np.nextafter(8.0, 9.0)  # the jump shows
    after = slice(k + 1, None)
    t = (result.time[after] - 8.0)[:, None]
    r, v = result.position[k, 1], result.velocity[k, 1]
    expected = r + v * t - [0, 0, G / 2] * t**2
    np.testing.assert_allclose(result.position[after, 1], expected, rtol=0, atol=1e-6)
    assert result.thrust[k, 1] > 10.0
    assert not result.thrust[after, 1].any()
    assert np.isnan(result.slot_position[after, 1]).all()


def test_the_others_fly_on_and_meet_the_waypoint():
    """Those left keep their slots, and the formation with its empty slot meets its waypoint: the verdict passes."""
    result = simulate(mission(LOST, phases=FLY))
    off = np.linalg.norm((result.position - result.slot_position)[:, [0, 2]], axis=2)
    assert off.max() < 1e-6
    edges = [tuple(e) for e in result.edges.tolist()]
    after = result.time > 8.0
    assert np.isnan(result.constraint[after][:, edges.index((0, 1))]).all()
    assert np.abs(result.constraint[after][:, edges.index((0, 2))]).max() < 1e-6
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    assert "lost vehicles stay" in verdict.summary
    np.testing.assert_allclose(result.cm[-1], [20.0, 5.0, 25.0], atol=1e-3)
    assert any(
        "agent 2, lost at 8.00 s, is still falling at z = " in note for note in verdict.notes
    )


def test_distances_hold_those_left():
    """Formed by distances alone, with damping, those left keep theirs; the falling one damps nobody."""
    phases = [
        {"kind": "establish", "formation": "square", "reference": "distances", "control": "open", "duration": 6.0},
        {"kind": "hold", "control": "open", "duration": 4.0},
    ]  # fmt: skip
    start = [[0, 0, 9.0], [4.2, 0.1, 9.2], [4.1, 4.0, 9.0], [-0.2, 3.9, 9.1]]
    m = mission(
        {"lost": [{"agent": 4, "time": 3.0}]}, phases=phases, agents={"mass": 1.0, "position": start},
        formations={"square": {"shape": "square", "size": 4.0}},
    )  # fmt: skip
    result = simulate(m)
    sides = np.linalg.norm(result.position[-1][[0, 1, 0]] - result.position[-1][[1, 2, 2]], axis=1)
    np.testing.assert_allclose(sides, [4, 4, 4 * np.sqrt(2)], atol=2e-3)
    np.testing.assert_allclose(result.position[-1, :3, 2], 9.1, atol=0.3)
    assert assess(result).passed


def test_a_formation_taken_after_a_loss_keeps_the_empty_slot():
    """An establishment that begins after the loss fits its frame to those left alone, and reshaping works on."""
    phases = [
        {"kind": "hold", "control": "open", "duration": 4.0},
        {"kind": "establish", "formation": "triangle", "duration": 6.0},
        {"kind": "fly", "position": [3.0, 1.0, 22.0], "yaw_deg": 30.0, "duration": 8.0},
        {"kind": "reshape", "formation": "line", "duration": 6.0},
    ]
    m = mission({"lost": [{"agent": 1, "time": 2.0}]}, phases=phases, formations={
        "triangle": {"shape": "triangle", "size": 5.0}, "line": {"shape": "line", "size": 3.0}})  # fmt: skip
    result = simulate(m)
    apart = np.linalg.norm(result.position[:, 1] - result.position[:, 2], axis=1)
    assert apart[result.samples(1)][-1] == pytest.approx(5.0, abs=1e-4)
    assert apart[-1] == pytest.approx(3.0, abs=1e-4)
    waypoint = assess(result).phases[2].waypoint
    assert waypoint is not None
    assert waypoint.position is not None
    assert waypoint.position < 1e-3
    off = np.linalg.norm(result.position - result.slot_position, axis=2)[result.samples(1), 1:]
    assert off.max() < 0.01


def test_a_lost_vehicle_comes_to_rest_on_the_ground():
    """Where there is ground, it ends one radius above it, and the note says when and where it hit."""
    result = simulate(mission(LOST, phases=FLY, obstacles=[{"kind": "ground"}]))
    assert result.position[-1, 1, 2] == pytest.approx(0.25, abs=1e-3)
    assert np.linalg.norm(result.velocity[-1, 1]) < 1e-3
    (note,) = assess(result).notes
    assert note.startswith("agent 2, lost at 8.00 s, hits the ground at 10.")
    assert assess(result).passed  # the ground is no obstacle to what is lost


def test_falling_on_another_fails_the_verdict():
    """A vehicle that falls on one below it fails the flight, in words that name both, though both slots are kept."""
    stack = [[0.0, 0, 20.0], [0.0, 0, 14.0], [6.0, 0, 14.0]]
    phases = [{"kind": "hold", "duration": 4.0}]
    m = mission({"lost": [{"agent": 1, "time": 1.0}]}, phases=phases,
                agents={"mass": 1.0, "position": stack})  # fmt: skip
    verdict = assess(simulate(m))
    assert not verdict.passed
    (failed,) = [f for f in verdict.checks if not f.passed]
    assert failed.check == "lost"
    assert "agent 1 at 1.00 s; after that, agents 1 and 2 collide, first at 2." in failed.message


def test_losses_at_a_switch_and_while_settling():
    """A loss at the very switch of phases, and one while a phase settles, fly on to the end."""
    phases = [
        {"kind": "establish", "formation": "triangle", "until": 5.0},
        {"kind": "hold", "settle": {"dwell": 2.0}},
    ]
    lost = [{"agent": 1, "time": 5.0}, {"agent": 2, "time": 6.05}]
    result = simulate(mission({"lost": lost}, phases=phases))
    assert result.complete
    assert (np.diff(result.time) > 0).all()
    assert result.phases[1].settled
    np.testing.assert_array_equal(result.left[-1], [False, False, True])
    assert assess(result).passed


def test_a_users_controller_flies_those_left():
    """A user's controller is asked on, and its force on what is lost has no effect."""

    def control(now):
        error = now.position - now.reference_position
        rate = now.velocity - now.reference_velocity
        a = now.reference_acceleration - 2 * error - 3 * rate
        return now.masses[:, None] * np.nan_to_num(a + [0, 0, G])

    result = simulate(mission(LOST, phases=FLY), controller=control, rate=50.0)
    k = result.time > 8.0
    assert not result.thrust[k, 1].any()
    np.testing.assert_allclose(result.acceleration[k, 1, 2], -G, atol=1e-9)
    assert np.nanmax(np.linalg.norm(result.position - result.slot_position, axis=2)) < 0.1


FOUR = [[0.0, 0.0, 20.0], [4.0, 0.0, 20.0], [1.0, 3.5, 20.5], [1.5, 1.0, 23.0]]
SLENDER = [[0.0, 0.0, 20.0], [4.0, 0.0, 20.0], [2.0, 0.9, 20.0], [2.0, 0.4, 21.0]]
MANY = [
    [3.0 * x, 3.0 * y, 30.0 + 3.0 * z + 0.2 * x * y]
    for x in range(4)
    for y in range(4)
    for z in range(4)
]


@pytest.mark.parametrize("controlled", [False, True], ids=["law", "controller"])
@pytest.mark.parametrize(
    ("places", "constraint"),
    [
        (FOUR, {"damping": 0.5}),
        (SLENDER, {"damping": "auto"}),
        (FOUR, {"solver": "spectral", "threshold": 3.0}),
        pytest.param(MANY, {"damping": 0.5}, marks=pytest.mark.long),
    ],
    ids=["damped", "auto", "spectral", "many"],
)
@pytest.mark.parametrize("when", [0.1, 0.5 + 1e-7], ids=["before", "within"])
def test_the_lost_count_for_nothing_in_the_law(places, constraint, when, controlled):
    """Those left fly as if the lost, ten times as heavy, had never been there: the mean mass is that of those left.

    It is lost before the formation is taken, or as soon as that has begun. The other mission lacks it, its slot and its
    edges.
    """
    n = len(places)
    masses = np.linspace(0.8, 1.5, n)
    masses[-1] = 10.0
    slots = np.array(places) * [1.02, 0.97, 1.0]
    near = np.linalg.norm(slots[:, None] - slots, axis=2) < (9.0 if n == 4 else 4.0)
    edges = np.argwhere(np.triu(near, 1)) + 1
    change = {
        "kind": "establish", "formation": "f", "reference": "squares", "blend": 2.0, "duration": 3.0,
        "control": "tracking" if controlled else "open",
    }  # fmt: skip

    def flown(who, lost):
        formation = {
            "slots": slots[:who].tolist(),
            "edges": edges[(edges <= who).all(axis=1)].tolist(),
        }
        agents = {"mass": masses[:who].tolist(), "position": places[:who]}
        return mission(
            lost, phases=[{"kind": "hold", "control": "open", "duration": 0.5}, change], agents=agents,
            formations={"f": formation}, constraint=constraint, integrator={"rtol": 1e-10, "atol": 1e-12},
        )  # fmt: skip

    def push(now):
        """By forces that know no slot: what is left of the flight is the law's."""
        force = np.zeros((len(now.masses), 3))
        force[:, 2] = now.masses * G
        force[: n - 1, 0] += 0.05 * np.arange(n - 1)
        return force

    pair = flown(n, {"lost": [{"agent": n, "time": when}]}), flown(n - 1, {})
    with_loss, without = (
        simulate(m, controller=push if controlled else None, rate=20.0) for m in pair
    )
    assert with_loss.complete
    assert without.complete
    end = with_loss.position[-1, : n - 1] - with_loss.position[-1, :1]
    wanted = without.position[-1] - without.position[-1, :1]
    np.testing.assert_allclose(end, wanted, rtol=0, atol=2e-7)


# -- the same again


EVERYTHING: dict[str, Any] = {
    "wind": [2.0, 1.0, 0.0], "mass_error": 0.01, "gusts": FIRST | {"correlation_length": 5.0},
    "noise": {"position": 0.01, "velocity": 0.02}, "lost": [{"agent": 3, "time": 7.0}],
}  # fmt: skip


def test_the_same_seed_is_the_same_flight(tmp_path):
    """Bit for bit, also after a file; another seed of either kind is another flight."""
    a, b = (simulate(mission(EVERYTHING, phases=FLY)) for _ in range(2))
    np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(a.measured_velocity, b.measured_velocity)
    a.save(tmp_path / "a.nc")
    again = Result.load(tmp_path / "a.nc")
    for name in ("disturbance_force", "measured_position", "measured_velocity"):
        np.testing.assert_array_equal(getattr(again, name), getattr(a, name))
    np.testing.assert_array_equal(simulate(again.mission).position, a.position)
    for kind in ("gusts", "noise"):
        other = copy.deepcopy(EVERYTHING)
        other[kind] = other[kind] | {"seed": 9}
        assert np.abs(simulate(mission(other, phases=FLY)).position - a.position).max() > 1e-4


def test_calm_flights_have_no_variables_of_disturbances(tmp_path):
    """Without disturbances a result has none of their arrays, nor has its file."""
    calm = simulate(load_mission("two-agents"))
    calm.save(tmp_path / "calm.nc")
    again = Result.load(tmp_path / "calm.nc")
    for result in (calm, again):
        assert result.disturbance_force is None
        assert result.measured_position is None
        assert result.measured_velocity is None


def test_the_windy_passage_is_flown_with_room():
    """The shipped mission passes, with a fifth of each tolerance left for other seeds, and 1.4 m to the walls."""
    result = simulate(load_mission("windy-passage"))
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    for finding in verdict.checks:
        if finding.limit and not finding.at_least and finding.worst is not None:
            assert finding.worst < 0.8 * finding.limit, finding.message
    clearance = next(f for f in verdict.checks if f.check == "clearance")
    assert clearance.worst is not None
    assert clearance.worst > 1.4
