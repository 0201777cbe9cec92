"""Steady offsets from slots, foreseen and flown, and the limits that they break."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.linalg import expm
from test_legs import Draw

from rigidfleet import MissionError
from rigidfleet.assessment import assess
from rigidfleet.math.pid import matrix_exponential
from rigidfleet.mission import Mission
from rigidfleet.mission.vehicles import MODELS
from rigidfleet.preflight.check import check
from rigidfleet.preflight.offsets import sampled_tracking_offsets
from rigidfleet.simulation.flight import simulate

SQUARE = np.array([[2.0, 2, 0], [-2, 2, 0], [-2, -2, 0], [2, -2, 0]])
UPRIGHT = np.array([[0.0, -2, -1.5], [0, 2, -1.5], [0, -2, 1.5], [0, 2, 1.5]])
#: What a remark foresees, and the checks of a verdict that then fail.
FORESEEN = {
    "waypoint": ("waypoint_position",),
    "attitude": ("waypoint_attitude",),
    "tracking error": ("tracking_error",),
    "collision": ("separation", "separation_as_planned"),
    "downwash": ("separation_below",),
    "obstacle": ("clearance",),
    "geofence": ("geofence",),
    "fence": ("fence",),
    "people": ("people",),
    "formation": ("shape", "distances"),
    "settle": ("settled",),
    "landing": ("touch_down",),
}


def mission(*phases, model=None, size=1.0, **tables):
    """Four points that are blown about, or vehicles of a model; phases as given, tables added or replaced."""
    agents = {"radius": 0.2 * size, "position": (size * SQUARE + [0, 0, 3]).tolist()}
    agents |= {"mass": 1.0} if model is None else {"vehicle": "x"}
    data = {
        "schema_version": 1,
        "name": "offsets",
        "smoothness": "jerk",
        "agents": agents | tables.pop("agents", {}),
        "formations": {
            "square": {"slots": (size * SQUARE).tolist()} | tables.pop("square", {}),
            "upright": {"slots": (size * UPRIGHT).tolist()} | tables.pop("upright", {}),
        },
        "phases": list(phases) or [TAKE, FLY],
    }
    if model is not None:
        data["vehicles"] = {"x": {"model": model}}
    return Mission.from_dict(data | tables)


TAKE = {"kind": "establish", "formation": "square", "duration": 6.0}
FLY = {"kind": "fly", "position": [8.0, 2.0, 5.0], "duration": 9.0}
APART = {"edges": []}
#: Limits that offsets move: what is foreseen, and a mission as a function of the strength of what disturbs it.
MOVED = {
    "waypoint": lambda x: mission(disturbances={"wind": [3.0 * x, 0, 0], "drag": 0.1}),
    "attitude": lambda x: mission(
        square=APART, disturbances={"mass_error": [0.01 * x, 0.01 * x, -0.01 * x, -0.01 * x]}
    ),
    "tracking error": lambda x: mission(
        model="x500", limits={"tracking_error": 0.1}, disturbances={"wind": [2.5 * x, 0, 0]}
    ),
    "collision": lambda x: mission(
        TAKE | {"formation": "upright"}, upright=APART,
        agents={"position": (UPRIGHT + [0, 0, 4]).tolist()},
        disturbances={"mass_error": [-0.02 * x, -0.02 * x, 0.02 * x, 0.02 * x]},
    ),
    "obstacle": lambda x: mission(
        obstacles=[{"kind": "box", "name": "wall", "min": [6, 4.4, 0], "max": [7, 9, 9]}],
        disturbances={"wind": [0, 6.0 * x, 0], "drag": 0.1},
    ),
    "geofence": lambda x: mission(
        limits={"geofence": {"min": [-9, -9, 0], "max": [20, 4.2, 9]}},
        disturbances={"wind": [0, 6.0 * x, 0], "drag": 0.1},
    ),
    "fence": lambda x: mission(
        fences=[{"kind": "inclusion", "polygon": [[-9, -9], [20, -9], [20, 4.2], [-9, 4.2]]}],
        disturbances={"wind": [0, 6.0 * x, 0], "drag": 0.1},
    ),
    "people": lambda x: mission(
        people=[{"polygon": [[-9, 4.85], [20, 4.85], [20, 9], [-9, 9]]}],
        disturbances={"wind": [0, 6.0 * x, 0], "drag": 0.1},
    ),
    "formation": lambda x: mission(
        TAKE | {"formation": "upright"}, upright=APART,
        disturbances={"mass_error": [0.02 * x, 0.02 * x, -0.02 * x, -0.02 * x]},
    ),
    "settle": lambda x: mission(
        TAKE, {"kind": "hold", "settle": {"tolerance": 0.05, "timeout": 9.0}},
        disturbances={"wind": [1.3 * x, 0, 0], "drag": 0.1},
    ),
}  # fmt: skip


def foreseen(found):
    """Topics of limits that steady offsets will break."""
    return {r.topic for r in found.remarks if r.level == "fails" and "steady disturb" in r.text}


def failed(verdict):
    """Names of the checks that failed."""
    return {c.check for c in verdict.checks if not c.passed}


@pytest.mark.parametrize("what", MOVED)
def test_every_limit_that_an_offset_moves_is_held_against_it(what):
    """What breaks a limit in flight is said before it, and a sixth of it is not."""
    strong, weak = MOVED[what](1.0), MOVED[what](1 / 6)
    assert what in foreseen(check(strong, search=False))
    assert failed(assess(simulate(strong))) & set(FORESEEN[what])
    assert not foreseen(check(weak, search=False))


@pytest.mark.parametrize("what", MOVED)
@pytest.mark.parametrize("lost", [1, 4])
def test_who_is_left_is_held_against_limits_also_after_a_loss(what, lost):
    """With one of four lost at the start, what is foreseen fails in flight, and a sixth of it is not foreseen."""
    whole = [MOVED[what](x).to_dict() for x in (1.0, 1 / 6)]
    for data in whole:
        data["disturbances"]["lost"] = [{"agent": lost, "time": 0.5}]
        data["phases"].insert(
            0, data["phases"][0] | {"name": "first", "blend": 1.0, "duration": 1.0}
        )
    strong, weak = (Mission.from_dict(data) for data in whole)
    verdict, ahead = assess(simulate(strong)), foreseen(check(strong, search=False))
    for topic in ahead:
        assert failed(verdict) & set(FORESEEN[topic]), (topic, verdict.summary)
    fails = failed(verdict) & set(FORESEEN[what])
    assert (what in ahead) == bool(fails), (ahead, verdict.summary)
    assert not foreseen(check(weak, search=False))


@pytest.mark.parametrize(
    ("tolerance", "fails"),
    [({}, True), ({"tolerance": 0.5}, False), ({"tolerance_share": 0.2}, False)],
)
def test_an_offset_is_held_against_the_tolerance_of_its_formation(tolerance, fails):
    """A shape that errors of mass bend is missed as far as its own tolerance says, before the flight and after it."""
    bent = mission(
        TAKE | {"formation": "upright"}, upright=APART | tolerance,
        disturbances={"mass_error": [0.02, 0.02, -0.02, -0.02]},
    )  # fmt: skip
    assert ("formation" in foreseen(check(bent, search=False))) == fails
    assert ("shape" in failed(assess(simulate(bent)))) == fails


def test_wind_on_points_against_the_closed_form():
    """A wind that sets in holds a point off by f/k1 (1 - the step response of its tracking), to 1e-6 m."""
    blown = mission({"kind": "establish", "formation": "square", "duration": 9.0, "blend": 4.0},
                    disturbances={"wind": [1.2, 0, 0], "drag": 0.5})  # fmt: skip
    found = check(blown, search=False)
    (off,), t = sampled_tracking_offsets(blown, found.planned_phases), found.planned_phases[0].time
    k1, k2 = blown.tracking_gains
    w = k2 / 2
    assert k1 == pytest.approx(w * w)  # critically damped
    step = 1 - np.exp(-w * t) * (1 + w * t)
    assert off[:, :, 0] == pytest.approx(np.repeat(0.6 / k1 * step[:, None], 4, axis=1), abs=1e-6)


@pytest.mark.parametrize("model", [None, "x500", pytest.param("crazyflie", marks=pytest.mark.long)])
def test_offsets_are_those_flown(model):
    """Along paths, in wind, with errors of mass and jets, foreseen offsets are the flown ones to a tenth, or 15 mm."""
    small = model == "crazyflie"
    disturbances = {"wind": [1.0, 0.5, 0] if small else [3.0, 1, 0], "mass_error": 0.03}
    disturbances |= {"drag": 0.2} if model is None else {"downwash": True}
    blown = mission(
        TAKE, {"kind": "reshape", "formation": "upright", "duration": 7.0}, FLY,
        {"kind": "hold", "duration": 2.0}, model=model, size=0.3 if small else 1.0, disturbances=disturbances,
    )  # fmt: skip
    way = check(blown, search=False).planned_phases
    flown = simulate(blown)
    far = 0.0
    known = list(zip(way, sampled_tracking_offsets(blown, way), strict=True))
    for planned, off in (known[0], *known[2:]):  # a change of shape leaves errors of its own
        inside = (flown.time > planned.time[0]) & (flown.time < planned.time[-1])
        seen = (flown.position - flown.slot_position)[inside]
        at = np.array([[np.interp(flown.time[inside], planned.time, x) for x in agent.T]
                       for agent in off.swapaxes(0, 1)]).transpose(2, 0, 1)  # fmt: skip
        far = max(far, np.abs(off).max())
        assert np.abs(at - seen).max() < 0.015 + 0.1 * np.abs(off).max()
    assert far > 0.05


def test_gusts_may_make_up_for_an_offset():
    """An offset just beyond a limit is no failure where gusts are as strong."""
    gusts = {"model": "first-order", "time_scale": 2.0, "intensity": 1.5, "seed": 1}
    calm = {"wind": [3.0, 0, 0], "drag": 0.1}
    assert "waypoint" in foreseen(check(mission(disturbances=calm), search=False))
    found = check(mission(disturbances=calm | {"gusts": gusts}), search=False)
    assert not foreseen(found)
    assert any(r.topic == "waypoint" and r.level == "note" for r in found.remarks)


def test_a_jet_against_a_tracking_error():
    """Crazyflies one above the other: the lower ones' push against `tracking_error` is said, and flown."""
    under = mission(
        TAKE | {"formation": "upright"}, {"kind": "hold", "duration": 4.0},
        model="crazyflie", size=0.2, limits={"tracking_error": 0.1, "separation_allowance": 0.5},
        disturbances={"downwash": True},
    )  # fmt: skip
    assert "tracking error" in foreseen(check(under, search=False))
    assert "tracking_error" in failed(assess(simulate(under)))


@pytest.mark.long
@pytest.mark.parametrize("model", [None, *MODELS])
def test_nothing_is_said_to_fail_that_passes(model):
    """In seeded missions of all models, every limit that is said to fail does."""
    rng = np.random.default_rng(3)
    for _ in range(6):
        size = 0.4 if model == "crazyflie" else 1.0
        d = {"wind": (rng.normal(size=3) * [1.5, 1.5, 0.2]).tolist()}
        d |= {"mass_error": (0.03 * rng.normal(size=4)).tolist()} if rng.random() < 0.5 else {}
        d |= {"drag": 0.3} if model is None else {"downwash": True}
        limits = {"separation": 0.2, "geofence": {"min": [-9, -9, 0], "max": [11, 9, 7]}}
        limits |= {} if model is None else {"tracking_error": float(rng.uniform(0.05, 0.4))}
        square = APART if rng.random() < 0.5 else {}
        phases = [TAKE, FLY, {"kind": "reshape", "formation": "upright", "duration": 7.0}]
        if rng.random() < 0.5:
            phases += [{"kind": "turn", "yaw_deg": 40.0, "duration": 6.0}]
        blown = mission(
            *phases, model=model, size=size, square=square, limits=limits, disturbances=d
        )
        broken = failed(assess(simulate(blown)))
        for topic in foreseen(check(blown, search=False)):
            assert broken & set(FORESEEN[topic]), topic


GROUND = [{"kind": "ground"}]
LAND = {"kind": "land", "duration": 6.0}
#: Errors of mass by which a landing ends in the ground, above it, or on it.
LANDED = [(0.03, "obstacle"), (-0.03, "landing"), (0.004, ""), (-0.004, "")]


@pytest.mark.parametrize("model", [None, "x500"])
@pytest.mark.parametrize(("error", "what"), LANDED)
def test_a_landing_with_a_wrong_mass_ends_where_a_check_says(error, what, model):
    """In the ground, above it or on it, of points and of quadrotors."""
    down = mission(TAKE, LAND, model=model, obstacles=GROUND, disturbances={"mass_error": error})
    ahead, broken = foreseen(check(down, search=False)), failed(assess(simulate(down)))
    assert {what} - {""} == ahead & {"obstacle", "landing"}
    assert (what == "obstacle") == ("clearance" in broken)
    assert (what == "landing") == ("touch_down" in broken)


@pytest.mark.parametrize("error", [0.03, -0.03])
def test_a_landing_in_a_ground_effect_is_not_foreseen_for_sure(error):
    """Rotors near the ground give more thrust than a check knows: a note."""
    d = {"mass_error": error, "ground_effect": True}
    found = check(mission(TAKE, LAND, model="x500", obstacles=GROUND, disturbances=d), search=False)
    assert not foreseen(found) & {"obstacle", "landing"}
    assert any("in 'land 2'" in r.text for r in found.remarks if r.topic in ("obstacle", "landing"))


@pytest.mark.parametrize("answer", ["abort", "land"])
@pytest.mark.parametrize(("error", "what"), LANDED)
def test_the_way_after_an_abort_or_a_loss_is_held_against_offsets(answer, error, what):
    """The last landing misses the ground where a check says so; a phase that is abandoned promises nothing."""
    lost = {"lost": [{"agent": 1, "time": 8.0}], "on_loss": "land"}
    why = {"abort": {"abort": {"at": 8.0}}, "land": {}}[answer]
    d = {"mass_error": error} | (lost if answer == "land" else {})
    home = mission(TAKE, FLY, obstacles=GROUND, disturbances=d, **why)
    found, verdict = check(home, search=False), assess(simulate(home))
    assert {what} - {""} == foreseen(found) & {"obstacle", "landing"}
    assert (what == "obstacle") == ("clearance" in failed(verdict))
    assert (what == "landing") == ("touch_down" in failed(verdict))
    assert not any("in 'fly 2'" in r.text and r.topic == "waypoint" for r in found.remarks)
    assert not any(c.phase == "fly 2" and c.check.startswith("waypoint") for c in verdict.checks)


def test_what_follows_a_phase_that_may_not_settle_is_not_sure():
    """It waits for its end, which is here an abort: the phases after it are never flown."""
    wait = {"kind": "hold", "settle": {"tolerance": 0.01, "timeout": 60.0}}
    waits = mission(TAKE, wait, FLY, disturbances={"mass_error": 0.03}, abort={"at": 40.0})
    assert "fly 3" not in [p.name for p in simulate(waits).phases]
    fails = [r.text for r in check(waits, search=False).remarks if r.level == "fails"]
    assert fails  # by what comes before
    assert not any("in 'fly 3'" in text or "in 'hold 2'" in text for text in fails)


@pytest.mark.parametrize(
    "d", [{"wind": [3.0, 1, 0], "drag": 0.1}, {"mass_error": [0.05, 0.0, 0.0, 0.02]}]
)
def test_the_drift_of_a_phase_without_feedback_is_told(d):
    """Wind and errors of mass carry it as far as is flown, to a tenth."""
    adrift = mission(TAKE | {"control": "open"}, FLY, smoothness="lqr", disturbances=d)
    found, flown = check(adrift, search=False), simulate(adrift)
    end = flown.position[np.searchsorted(flown.time, 6.0)] - found.planned_phases[0].position[-1]
    (text,) = (r.text for r in found.remarks if r.text.startswith("nothing holds 'establish 1'"))
    told = float(text.split("about ")[1].split(" m")[0])
    assert told == pytest.approx(np.linalg.norm(end.mean(axis=0)), rel=0.1)
    calm = mission(TAKE | {"control": "open"}, FLY, smoothness="lqr")
    assert not any(r.text.startswith("nothing holds") for r in check(calm, search=False).remarks)


def disturbed(seed):
    """A drawn mission that lands, with errors of mass or wind, losses and aborts."""
    rng, draw = np.random.default_rng([seed, 7]), Draw(seed)
    draw.land()
    data = draw.mission(lossless=rng.random() < 0.5).to_dict()
    d = data.setdefault("disturbances", {})
    d["mass_error"] = (rng.choice([0.002, 0.008, 0.08]) * rng.uniform(-1, 1, 4)).round(4).tolist()
    if rng.random() < 0.3:
        d["wind"] = [*rng.uniform(-1.5, 1.5, 2).round(2).tolist(), round(rng.uniform(-0.3, 0.3), 2)]
    if not ("lost" in d or draw.body or draw.open) and rng.random() < 0.5:
        data["abort"] = {"at": round(rng.uniform(2, 60), 2)}
    return Mission.from_dict(data)


@pytest.mark.parametrize(
    "seeds", [range(700, 712), pytest.param(range(800, 1000), marks=pytest.mark.long)]
)
def test_drawn_missions_fail_where_a_check_says_so_and_say_where_they_land(seeds):
    """No check fails a flight that passes; vehicles in the ground, or none on it, are foreseen, at least by a note."""
    landed = 0
    for seed in seeds:
        try:
            drawn = disturbed(seed)
            found, verdict = check(drawn, search=False), assess(simulate(drawn))
        except MissionError:
            continue
        assert found.passed or not verdict.passed, seed
        if any(p.control == "open" for p in drawn.phases):
            continue
        topics = {r.topic for r in found.remarks}
        for topic, name in (("obstacle", "clearance"), ("landing", "touch_down")):
            assert topic in topics or name not in failed(verdict), (seed, name)
            landed += name in failed(verdict)
    assert landed > len(seeds) / 8


THROUGH = {"through": [{"position": [20.0, 3, 4]}]}


@pytest.mark.parametrize(
    ("phase", "where", "drag"),
    [
        ({"kind": "hold", "duration": 6.0}, "its place at the end", {"wind": [3.0, 0, 0], "drag": 0.1}),
        ({"kind": "brake", "duration": 6.0}, "its place at the end", {"wind": [3.0, 0, 0], "drag": 0.1}),
        (FLY | {"position": [40.0, 0, 5], "duration": 16.0} | THROUGH, "point 1 on", {"drag": 0.2}),
    ],
)  # fmt: skip
def test_offsets_are_held_against_places_that_are_no_waypoints(phase, where, drag):
    """Where a phase stays, and points on its way, are missed in flight where a check says so."""
    strong, weak = (
        mission(phase, disturbances=drag | {"drag": drag["drag"] * x}) for x in (1, 0.1)
    )
    (text,) = (r.text for r in check(strong, search=False).remarks if r.level == "fails")
    assert f": {where}" in text
    assert failed(assess(simulate(strong))) == {"waypoint_position"}
    assert not foreseen(check(weak, search=False))
    assert assess(simulate(weak)).passed


@pytest.mark.parametrize("tolerance", [{"tolerance": 0.3}, {"tolerance_share": 0.1}])
def test_a_tolerance_of_a_formation_is_that_of_its_check(tolerance):
    """Errors of mass that a formation's own tolerance allows are no fault, and those that it does not allow are."""
    for error, share, passes in ((0.02, 1.0, True), (0.002, 0.03, False)):
        own = {name: share * x for name, x in tolerance.items()}
        errors = [error, error, -error, -error]
        tilted = mission(
            TAKE | {"formation": "upright", "duration": 12.0},
            upright=APART | own,
            disturbances={"mass_error": errors},
        )
        assert check(tilted, search=False).passed == passes == assess(simulate(tilted)).passed


@pytest.mark.parametrize("size", [0.0, 1e-3, 1.0, 30.0])
def test_exponentials_are_those_of_scipy(size):
    """Of several matrices at once, of any size."""
    A = size * np.random.default_rng(1).normal(size=(5, 4, 4))
    want = expm(A)
    np.testing.assert_allclose(
        matrix_exponential(A, np.ones(5)), want, rtol=1e-11, atol=1e-12 * np.abs(want).max()
    )


def test_a_check_of_steady_wind_loads_no_scipy():
    """It would take longer to load than all that the check computes."""
    code = (
        "import sys, rigidfleet as rf; rf.check(rf.load_mission('windy-passage')); "
        "assert not [name for name in sys.modules if name.split('.')[0] == 'scipy']"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
