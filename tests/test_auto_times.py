"""Automatic times: what is checked is what flies, and vehicles in calm air keep the limits of their mission."""

import numpy as np
import pytest
from sample_missions import REQUIRED_KEYS
from scipy.signal import impulse, lsim

from rigidfleet.assessment import assess
from rigidfleet.errors import MissionError
from rigidfleet.math.margins import Lag, LoopGains, tracking_lag_time
from rigidfleet.mission import KINDS, Mission
from rigidfleet.mission.vehicles import MODELS
from rigidfleet.planning.vehicles import tracking_lag_times
from rigidfleet.preflight.check import check
from rigidfleet.simulation.flight import simulate

STANDING = [[0.0, -2, 1], [0, 2, 1], [3, -2, 1], [3, 2, 1]]
FRAME = [[0.0, -2, -1.5], [0, 2, -1.5], [0, -2, 1.5], [0, 2, 1.5]]
WIDE = (1.4 * np.array(FRAME)).tolist()
FLAT = [[-1.5, -2, 0], [-1.5, 2, 0], [1.5, -2, 0], [1.5, 2, 0]]
AUTO = {"duration": "auto"}
BOTH = AUTO | {"blend": "auto"}
FLY = {"kind": "fly", "position": [1.5, 0, 6]} | AUTO
TAKE = {"kind": "establish", "formation": "frame"}
#: Phases before the first formation, the first formation itself, and what follows it.
BEFORE = [
    [],
    [FLY],
    [{"kind": "takeoff", "height": 6} | AUTO],
    [{"kind": "takeoff", "height": 6} | AUTO, FLY, {"kind": "hold", "duration": 1.0}],
    [FLY | {"through": [{"position": [4, 2, 4]}]}],
    [FLY | {"duration": 30.0, "travel": "auto"}],
    [FLY, {"kind": "turn", "yaw_deg": 70.0} | AUTO],
    [
        {"kind": "orbit", "centre": [4, 0, 6], "radius": 4, "rate_deg_s": 12, "duration": 30.0}
        | {"blend": "auto"}
    ],
    [FLY, {"kind": "brake", "duration": 4.0}],
]
FIRST = [TAKE | BOTH, TAKE | {"duration": 8, "blend": 4}, TAKE | {"duration": 30, "blend": "auto"}]
AFTER = [
    [],
    [{"kind": "reshape", "formation": "wide"} | BOTH, {"kind": "land"} | AUTO],
    [{"kind": "reshape", "formation": "wide", "transition": "layers"} | BOTH],
    [{"kind": "reshape", "formation": "frame", "transition": "layers", "duration": 9, "blend": 9}],
    [{"kind": "go", "position": [9, 0, 8]} | AUTO],
    [FLY | {"position": [6, 3, 8]}, {"kind": "turn", "yaw_deg": 20} | AUTO],
]


def points(*phases, **tables):
    """Four points that take a frame; phases as given, tables added."""
    data = {
        "schema_version": 1,
        "name": "auto",
        "smoothness": "jerk",
        "agents": {"mass": 1.0, "radius": 0.2, "position": STANDING},
        "formations": {"frame": {"slots": FRAME}, "wide": {"slots": WIDE}, "flat": {"slots": FLAT}},
        "obstacles": [{"kind": "ground"}],
        "limits": {"speed": 4, "acceleration": 2},
        "phases": list(phases),
    }
    return Mission.from_dict(data | tables)


def compare(mission):
    """See that a check ends, and plans the phases and times that are flown."""
    planned = [(p.phase, p.time[-1]) for p in check(mission, search=False).planned_phases]
    flown = [(phase.name, phase.t_end) for phase in simulate(mission).phases]
    assert [name for name, _ in planned] == [name for name, _ in flown]
    assert [t for _, t in planned] == pytest.approx([t for _, t in flown], abs=1e-6)


@pytest.mark.parametrize("before", range(len(BEFORE)))
def test_a_check_ends_whatever_is_automatic_before_the_first_formation(before):
    """A check of automatic times before, at and after the first formation ends, and its times are those flown."""
    first, after = FIRST[before % len(FIRST)], AFTER[before % len(AFTER)]
    compare(points(*BEFORE[before], first, *after))


@pytest.mark.long
@pytest.mark.parametrize("assignment", ["given", "shortest", "safe", "each"])
@pytest.mark.parametrize("on_loss", [None, "hold", "land"])
def test_a_check_ends_for_seeded_missions(assignment, on_loss):
    """Whatever kinds, assignments and losses go together, a check ends where a flight does, with the same times."""
    rng = np.random.default_rng(5)
    for _ in range(8):
        before, first, after = (group[rng.integers(len(group))] for group in (BEFORE, FIRST, AFTER))
        if assignment != "given" and any("transition" in phase for phase in after):
            after = []
        lost = {"lost": [{"agent": 2, "time": 2.0}], "on_loss": on_loss}
        lost |= {"landing_formation": "flat"} if on_loss == "land" else {}
        tables = {} if on_loss is None else {"disturbances": lost}
        mission = points(*before, first, *after, assignment=assignment, **tables)
        if on_loss is None:
            compare(mission)
        else:
            check(mission, search=False)
            simulate(mission)


def vehicles(model, phases, speed=4.0, acceleration=2.0, integral=0.5, **tables):
    """Four vehicles of a model that fly with drag fed forward."""
    size = 0.25 if model == "crazyflie" else 1.0
    data = {
        "schema_version": 1,
        "name": "auto",
        "smoothness": "jerk",
        "vehicles": {"x": {"model": model}},
        "agents": {
            "vehicle": "x",
            "radius": 0.3 * size,
            "position": (size * np.array(STANDING) + [0, 0, 0.5]).tolist(),
        },
        "tracking": {"drag_feedforward": True, "integral": integral},
        "formations": {
            "frame": {"slots": (size * np.array(FRAME)).tolist()},
            "wide": {"slots": (size * np.array(WIDE)).tolist()},
        },
        "obstacles": [{"kind": "ground"}],
        "limits": {"speed": speed, "acceleration": acceleration},
        "phases": phases,
    }
    return Mission.from_dict(data | tables)


def beyond(mission):
    """Limits of motion that a flight does not keep."""
    names = ("speed", "acceleration", "tilt", "thrust")
    verdict = assess(simulate(mission))
    return [c.message for c in verdict.checks if c.check.endswith(names) and not c.passed]


def test_a_brake_takes_its_least_time():
    """From a steady flight, the velocity falls as a quintic, whose greatest slope is 15/8 of its mean."""
    away = FLY | {"position": [9, 0, 6], "velocity": [2, 0, 0]}
    mission = points(FLY, TAKE | BOTH, away, {"kind": "brake"} | AUTO)
    result = simulate(mission)
    assert assess(result).passed
    brake = result.phases[-1]
    assert brake.t_end - brake.t_start == pytest.approx(15 / 8 * 2 / 2, rel=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_that_can_be_done_has_a_least_time(kind):
    """An automatic duration is refused of kinds that are never done, as to hold and to orbit, and of no other."""
    done = KINDS[kind].model_construct().has_least_time
    assert done or kind not in ("brake", "fly", "turn", "land")
    assert not done or kind not in ("hold", "orbit")
    refused = ""
    try:
        points(TAKE | BOTH, REQUIRED_KEYS[kind] | {"kind": kind} | AUTO)
    except MissionError as error:
        refused = str(error)
    assert ("has no least duration" in refused) != done


@pytest.mark.parametrize("model", MODELS)
def test_a_vehicle_in_calm_air_keeps_its_own_limits(model):
    """Flown with automatic times, a vehicle of any model keeps its limits in calm air."""
    climb = {"kind": "takeoff", "height": 6} | AUTO
    assert not beyond(vehicles(model, [climb, TAKE | BOTH, {"kind": "land"} | AUTO]))


@pytest.mark.long
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("fed", [True, False])
def test_vehicles_keep_limits_in_seeded_missions(model, fed):
    """As above with seeded limits of all kinds, ways and gains, and with drag that is not fed forward."""
    rng = np.random.default_rng(11)
    for _ in range(4):
        limits = {"speed": rng.uniform(1, 5), "acceleration": rng.uniform(0.5, 3)}
        limits |= {"vertical_speed": 0.5 * limits["speed"]} if rng.random() < 0.5 else {}
        limits |= (
            {"horizontal_acceleration": 0.7 * limits["acceleration"]} if rng.random() < 0.5 else {}
        )
        limits |= {"tilt_deg": rng.uniform(10, 20)} if rng.random() < 0.5 else {}
        fly, through = ([*rng.uniform(-15, 15, 2), rng.uniform(5, 12)] for _ in range(2))
        phases = [
            {"kind": "takeoff", "height": 6} | AUTO,
            TAKE | BOTH,
            FLY | {"position": fly, "yaw_deg": float(rng.uniform(-90, 90))},
            FLY | {"position": [0, 0, 8], "through": [{"position": through}]},
            {"kind": "reshape", "formation": "wide"} | BOTH,
            {"kind": "turn", "yaw_deg": float(rng.uniform(-90, 90))} | AUTO,
        ]
        tracking = {"drag_feedforward": fed, "integral": float(rng.choice([0.0, 0.5]))}
        assert not beyond(vehicles(model, phases, limits=limits, tracking=tracking))


@pytest.mark.parametrize("lag", [Lag(310.0, 57.0, 0.072), Lag(310.0, 57.0, 0.0125)])
def test_the_reserve_bounds_what_a_vehicle_leaves_its_reference_by(lag):
    """The reserve is the integral of the impulse response, by another library; no input makes a greater error."""
    law = LoopGains()
    tau, k_R, k_omega = lag.tau, lag.k_R, lag.k_omega
    along = np.array([tau, 1.0, k_omega, k_R])  # of the attitude with its rotors
    systems = []
    for feedback in ([law.k2, law.k1], [2 * law.alpha, law.beta**2, law.gamma]):
        integrates = len(feedback) - 2  # K = feedback / s^integrates
        s = [1.0] + [0.0] * integrates
        for rotors, gain, share in (([tau, 1.0], 1.0, [tau, 0.0]), (along, k_R, [tau, 0, 0, 0])):
            below = np.polyadd(np.polymul(np.r_[s, 0, 0], rotors), gain * np.array(feedback))
            systems.append((np.polymul(np.r_[s, 0.0], share), below))
    time = np.linspace(0.0, 20.0, 20_001)
    bounds = [np.trapezoid(np.abs(impulse(system, T=time)[1]), time) for system in systems]
    found = tracking_lag_time(lag, law, 0.0)
    assert found == pytest.approx(max(bounds), rel=0.02)
    jerk = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 201), 100)[: len(time)]
    assert max(np.abs(lsim(system, jerk, time)[1]).max() for system in systems) < found


def test_points_need_no_reserve():
    """Points that give any force at once leave none, with control that is continuous or sampled."""
    assert not tracking_lag_times(points(FLY)).any()
    sampled = {"vehicles": {"x": {"model": "point", "mass": 1.0}}}
    assert not tracking_lag_times(
        points(FLY, agents={"vehicle": "x", "position": STANDING}, **sampled)
    ).any()


def test_a_check_prints_the_reserve():
    """A check of vehicles prints what automatic times leave."""
    found = check(vehicles("x500", [FLY]), search=False)
    assert dict(found.describe())["reserve of automatic times"].startswith("worst 0.065")
    assert found.data()["reserve_s"] == pytest.approx(0.065, abs=5e-4)
