"""Phases that follow trajectories of other programs, and transitions on bent ways."""

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

import rigidfleet as rf
from rigidfleet.foreign.curves import curve_to_rows, least_jerk_curve
from rigidfleet.kernel.problem import SHAPE, Reference
from rigidfleet.kernel.references import blend_slots
from rigidfleet.math.piecewise import Piecewise, stack_ways
from rigidfleet.planning.derivatives import slot_way_taylor

SLOTS = [[2.0, 0.0, 0.0], [-1.0, 1.7, 0.0], [-1.0, -1.7, 0.0]]
HEAD = """schema_version = 1
name = "followed"
[agents]
mass = 1.2
radius = 0.25
thrust_limit = 26.0
position = [[2.0, 0.0, 10.0], [-1.0, 1.7, 10.0], [-1.0, -1.7, 10.0]]
[limits]
separation = 0.5
{limits}
[formations.tri]
slots = [[2.0, 0.0, 0.0], [-1.0, 1.7, 0.0], [-1.0, -1.7, 0.0]]
edges = "complete"
[[phases]]
kind = "establish"
formation = "tri"
duration = 4.0
[[phases]]
kind = "follow"
"""
TIME = np.linspace(0.0, 12.0, 121)
SHARE = (TIME / 12) ** 4 * (35 - 84 * (TIME / 12) + 70 * (TIME / 12) ** 2 - 20 * (TIME / 12) ** 3)
ANGLE = 2 * np.pi * SHARE
LOOP = np.stack([5 * np.sin(ANGLE), 5 * (1 - np.cos(ANGLE)), 10 + 0 * ANGLE], axis=1)


def _loop(higher: float = 0.0) -> str:
    rows = zip(TIME, LOOP + [0, 0, higher], ANGLE, strict=True)
    return "time_s,x_m,y_m,z_m,yaw_rad\n" + "".join(
        f"{t:.4f},{x:.7f},{y:.7f},{z:.7f},{a:.7f}\n" for t, (x, y, z), a in rows
    )


def _own() -> np.ndarray:
    """Positions (K, 3, 3) of three vehicles that turn with the loop, and come nearer meanwhile."""
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    R = np.stack([np.stack([c, -s, 0 * c], 1), np.stack([s, c, 0 * c], 1), [[0, 0, 1]] * 121], 1)
    near = 1 - 0.4 * np.sin(np.pi * SHARE) ** 2
    return LOOP[:, None] + near[:, None, None] * np.einsum("kab,nb->kna", R, np.array(SLOTS))


def _csv_text(position: np.ndarray, agents: bool = True) -> str:
    rows = ["time_s," + "agent," * agents + "x_m,y_m,z_m"]
    for t, places in zip(TIME, position, strict=True):
        for i, place in enumerate(places.tolist(), start=1):
            rows.append(f"{t:.4f}," + f"{i}," * agents + ",".join(f"{x:.7f}" for x in place))
    return "\n".join(rows) + "\n"


def _written(
    folder: Path, keys: str, limits: str = "", *, content: str = "", file: str = "way.csv"
) -> Path:
    (folder / file).parent.mkdir(exist_ok=True)
    (folder / file).write_text(content or _loop())
    path = folder / "mission.toml"
    path.write_text(HEAD.format(limits=limits) + keys)
    return path


def test_the_kernel_and_the_plan_evaluate_the_same_ways():
    """Slots and two derivatives in the kernel, four in the plan, against NumPy's polynomials; at rest outside."""
    rng = np.random.default_rng(0)
    knots, ways = np.array([1.0, 1.5, 3.0]), rng.normal(size=(2, 2, 3, 8))
    none, slots = np.zeros(0), np.zeros((2, 3))
    ref = Reference(SHAPE, 1.0, 2.0, none, none, slots, slots, np.zeros(3), knots, ways)
    for t in (0.5, 1.2, 1.5, 2.9, 4.0):
        p = np.zeros((3, 2, 3))
        blend_slots(t, ref, *p)
        k = int(t >= 1.5)
        inside = min(max(t, 1.0), 3.0)
        for i in range(2):
            for q in range(3):
                told = np.polynomial.Polynomial(ways[k, i, q])
                for m in range(3):
                    want = told.deriv(m)(inside - knots[k]) if t == inside or not m else 0.0
                    np.testing.assert_allclose(p[m, i, q], want, rtol=1e-12)
        found = slot_way_taylor(ref, np.array([t]))[..., 0]
        np.testing.assert_allclose(found[:3], p / np.array([1, 1, 2])[:, None, None], rtol=1e-12)


def test_the_virtual_body_follows_a_file(tmp_path):
    """The formation's centre keeps to the file to a tracking error of a micrometre; the shape and its attitude stay."""
    result = rf.simulate(_written(tmp_path, 'file = "way.csv"'))
    assert rf.assess(result).passed
    x = np.interp(result.time - 4.0, TIME, LOOP[:, 0])
    flown = result.phase == 1
    bend = np.abs(np.diff(LOOP[:, 0], 2)).max() / 8  # of the samples, from the lines between them
    assert np.abs(result.cm[flown, 0] - x[flown]).max() < 1.1 * bend
    np.testing.assert_allclose(result.cm[-1], LOOP[-1], atol=1e-6)
    np.testing.assert_allclose(result.position[-1] - result.cm[-1], SLOTS, atol=1e-6)
    spline = make_interp_spline(TIME, LOOP, k=5)
    inner = flown & (result.time > 5.0) & (result.time < 15.0)
    np.testing.assert_allclose(result.cm[inner], spline(result.time[inner] - 4.0), atol=1e-4)


def test_the_body_turns_with_the_yaw_of_the_file(tmp_path):
    """After three quarters of the turn the first vehicle is where the turned slot is."""
    result = rf.simulate(_written(tmp_path, 'file = "way.csv"\nyaw = "file"\nduration = 24.0'))
    assert rf.assess(result).passed
    k = int(np.abs(result.time - 4.0 - 2 * 7.2).argmin())
    angle = ANGLE[72]
    want = LOOP[72] + 2.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
    np.testing.assert_allclose(result.position[k, 0], want, atol=1e-3)


@pytest.mark.parametrize("folder", [False, True])
def test_each_vehicle_follows_its_own(tmp_path, folder):
    """From one table, or a folder with one a vehicle. The certificate is the least distance of the files."""
    own = _own()
    if folder:
        for i in (1, 2, 3):
            _written(
                tmp_path,
                'file = "ways"',
                content=_csv_text(own[:, i - 1 : i], False),
                file=f"ways/{i}.csv",
            )
        path = tmp_path / "mission.toml"
    else:
        path = _written(tmp_path, 'file = "way.csv"', content=_csv_text(own))
    result = rf.simulate(path)
    assert rf.assess(result).passed
    for k in (60, 72, 120):
        row = int(np.abs(result.time - 4.0 - TIME[k]).argmin())
        np.testing.assert_allclose(result.position[row], own[k], atol=1e-3)
    planned = result.phases[1].planned
    assert planned is not None
    assert planned["how"] == "conservative advancement"
    np.testing.assert_allclose(planned["separation"], 0.6 * 3.4 - 0.5, atol=1e-4)
    assert result.phases[1].extremes["separation"].value == pytest.approx(
        planned["separation"], abs=1e-4
    )


def test_a_result_repeats_from_itself(tmp_path):
    """The numbers and the digest of the file are in its mission; the file may be gone."""
    path = _written(tmp_path, 'file = "way.csv"')
    result = rf.simulate(path)
    (tmp_path / "way.csv").unlink()
    text = result.mission.text
    assert "SHA-256" in text
    assert "trajectories of 'way.csv'" in text
    again = rf.simulate(rf.Mission.from_toml(text))
    np.testing.assert_array_equal(again.position, result.position)


def test_a_small_offset_fades_and_a_large_one_is_refused(tmp_path):
    """Ten centimetres at the start are led in within a second; further away, check and run name both points."""
    near = _loop(0.09)
    result = rf.simulate(_written(tmp_path, 'file = "way.csv"', content=near))
    assert rf.assess(result).passed
    np.testing.assert_allclose(result.cm[result.time > 5.2, 2], 10.09, atol=1e-3)
    far = _loop(2.0)
    path = _written(tmp_path, 'file = "way.csv"', content=far)
    with pytest.raises(
        rf.MissionError,
        match=r"(?s)\(0\.00, 0\.00, 12\.00\) m is 2\.00 m from .* lead the vehicles there",
    ):
        rf.check(path)


def test_too_fast_for_the_limits_tells_the_least_time(tmp_path):
    """With the duration that check names, the mission passes its check; with 2 % less, it does not."""
    path = _written(tmp_path, 'file = "way.csv"', "acceleration = 5.0")
    failed = [r for r in rf.check(path).remarks if r.level == "fails"]
    assert "the least duration of this phase is 13.7" in failed[0].text
    for duration, count in ((13.80, 0), (13.50, 1)):
        path = _written(tmp_path, f'file = "way.csv"\nduration = {duration}', "acceleration = 5.0")
        assert len([r for r in rf.check(path).remarks if r.level == "fails"]) == count


def _cut(text: str, line: int) -> str:
    return "\n".join(text.splitlines()[:line])


BAD = {
    "truncated": (_cut(_loop(), 40) + "\n3.9,1.2", "line 41"),
    "nan": (_loop().replace("0.5000,", "0.5000,nan,", 1).replace("nan,", "nan,", 1), "line"),
    "order": (_loop().replace("0.5000,", "0.3000,", 1), "line 7"),
    "columns": ("a,b,c\n1,2,3\n2,3,4\n", "has no names of columns"),
    "two vehicles": (_csv_text(_own()[:, :2]), "has 2 trajectories for 3 agents"),
    "jump": (
        "duration," + ",".join(f"{c}^{k}" for c in ("x", "y", "z", "yaw") for k in range(8)) + "\n"
        + "1," + ",".join(["0"] * 16 + ["10"] + ["0"] * 15) + "\n"
        + "1," + ",".join(["3"] + ["0"] * 15 + ["10"] + ["0"] * 15) + "\n",
        "jumps by 3 m at 1 s",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "near"), [("skyc", 0.02), ("mcap", 1e-3)])
def test_vehicles_follow_what_was_exported(tmp_path, kind, near):
    """A flight that leaves as a show or as ROS 2 poses is followed as it was flown, within the format's deviation."""
    if kind == "mcap":
        pytest.importorskip("mcap", reason="make .venv/.interchange installs it")
    first = rf.simulate(_written(tmp_path, 'file = "way.csv"', content=_csv_text(_own())))
    file = f"flown.{kind}"
    rf.export(first, tmp_path / file, kind)
    path = tmp_path / "again.toml"
    path.write_text(HEAD.format(limits="") + f'file = "{file}"')
    again = rf.simulate(path)
    assert rf.assess(again).passed
    # The second flight waits for the establishment of its own; the file begins with that of the first.
    for t in np.linspace(0.0, first.time[-1], 9):
        then, now = np.abs(first.time - t).argmin(), np.abs(again.time - t - 4.0).argmin()
        assert abs(again.time[now] - 4.0 - first.time[then]) < 1e-9
        np.testing.assert_allclose(again.position[now], first.position[then], atol=near)


@pytest.mark.parametrize("name", BAD)
def test_bad_files_get_one_clear_error(tmp_path, name):
    """What is wrong, and where."""
    content, told = BAD[name]
    path = _written(tmp_path, 'file = "way.csv"', content=content)
    with pytest.raises(rf.MissionError) as caught:
        rf.load_mission(path)
    assert told in str(caught.value)
    assert len(caught.value.findings) == 1


@pytest.mark.parametrize("file", ["../way.csv", "/etc/hostname", "none.csv", "empty"])
def test_files_that_are_not_there(tmp_path, file):
    """Names may not leave the folder; a file that lacks, or a folder without any, is named."""
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "empty").mkdir()
    (tmp_path / "way.csv").write_text(_loop())
    path = inside / "mission.toml"
    path.write_text(HEAD.format(limits="") + f'file = "{file}"\n')
    with pytest.raises(rf.MissionError) as caught:
        rf.load_mission(path)
    assert len(caught.value.findings) == 1


def test_trajectories_are_joined_at_all_knots():
    """Curves with knots of their own agree with themselves at any time, and stay where they end."""
    one = least_jerk_curve(Piecewise(np.array([0.0, 1.0, 3.0]), np.arange(24.0).reshape(2, 4, 3)))
    two = Piecewise(np.array([0.0, 2.0]), np.arange(8.0).reshape(1, 4, 2))
    knots, pieces = stack_ways([one, two])
    np.testing.assert_array_equal(knots, [0.0, 1.0, 2.0, 3.0])
    for t in (0.3, 1.7, 2.5):
        k = int(t)
        x = pieces[k] @ (t - knots[k]) ** np.arange(pieces.shape[-1])
        np.testing.assert_allclose(x[0], one.at(np.array([t]))[0])
        np.testing.assert_allclose(x[1], two.at(np.array([min(t, 2.0)]))[0])


# -- bent ways -----------------------------------------------------------------------------------------

RING = np.round([[2 * np.cos(a), 2 * np.sin(a), 0.0] for a in np.arange(6) * np.pi / 3], 6)


def _swap(keys: str = "", speed: str = "speed = 2.0") -> dict:
    limits = {"separation": 0.2, "acceleration": 2.0}
    if speed:
        limits["speed"] = 2.0
    phase = {"kind": "reshape", "formation": "opposite", "transition": "ways", "duration": 12.0}
    return {
        "schema_version": 1, "name": "swap",
        "agents": {"mass": 0.5, "radius": 0.1, "thrust_limit": 12.0, "position": RING + [0, 0, 5]},
        "limits": limits,
        "formations": {
            "ring": {"slots": RING, "edges": "complete"},
            "opposite": {"slots": np.roll(RING, 3, axis=0), "edges": []},
        },
        "phases": [{"kind": "establish", "formation": "ring", "duration": 4.0}, phase],
    }  # fmt: skip


def test_a_mission_flies_bent_ways_with_a_certificate():
    """All straight ways meet in the middle. The flight keeps what the plan proves, and the limits of every axis."""
    mission = rf.Mission.from_dict(_swap())
    found = rf.check(mission)
    assert not [r for r in found.remarks if r.level == "fails"]
    result = rf.simulate(mission)
    verdict = rf.assess(result)
    assert verdict.passed
    planned = result.phases[1].planned
    assert planned is not None
    assert planned["how"] == "conservative advancement"
    assert planned["separation"] >= 0.2
    assert result.phases[1].extremes["separation"].value >= planned["separation"] - 1e-4
    np.testing.assert_allclose(result.position[-1], np.roll(RING, 3, axis=0) + [0, 0, 5], atol=1e-6)
    again = rf.simulate(rf.Mission.from_toml(result.mission.text))
    np.testing.assert_array_equal(again.position, result.position)


@pytest.mark.parametrize("yaw", [0.0, 90.0])
def test_bent_ways_keep_to_the_ground_and_the_geofence(yaw):
    """Close to the ground and below a ceiling, with the fence's sides if the body's axes are along it."""
    data = _swap()
    fence = {"min": [-5.0, -2.4, 0.0], "max": [5.0, 2.4, 1.4]}
    data["limits"]["geofence"] = fence
    data["obstacles"] = [{"kind": "ground"}]
    data["agents"]["position"] = RING + [0, 0, 0.4]
    data["phases"].insert(1, {"kind": "turn", "yaw_deg": yaw, "duration": 6.0})
    result = rf.simulate(rf.Mission.from_dict(data))
    assert rf.assess(result).passed
    flown = result.position[result.phase == 2]
    rest = 2.0 * (0.2 + 0.2 + 0.1)  # what ways without these would take below and above their slots
    assert flown[..., 2].max() > 0.45  # they do leave the plane
    assert flown[..., 2].min() >= 0.1
    assert 0.4 - rest < 0.1
    assert np.abs(flown[..., 1]).max() <= 2.3 + 1e-6


def test_quadrotors_fly_bent_ways():
    """With rotors and lag, within the allowance of the certificate."""
    data = _swap()
    data["agents"] = {"vehicle": "small", "radius": 0.1, "position": RING + [0, 0, 5]}
    data["vehicles"] = {"small": {"model": "crazyflie"}}
    verdict = rf.assess(rf.simulate(rf.Mission.from_dict(data)))
    assert [c.check for c in verdict.checks if c.check == "separation_as_planned" and c.passed]


def test_bent_ways_need_limits_and_time():
    """Without a speed limit, or with too short a blend, the error says what to give."""
    with pytest.raises(rf.MissionError, match=r"give limits\.speed"):
        rf.check(rf.Mission.from_dict(_swap(speed="")))
    data = _swap()
    data["phases"][1]["blend"] = 2.0
    with pytest.raises(rf.MissionError, match=r"the least is \d"):
        rf.check(rf.Mission.from_dict(data))


def test_bent_ways_begin_by_hand():
    """They are found when the phase begins; phases that are several ones are refused, not flown as one."""
    data = _swap()
    flight = rf.Flight(rf.Mission.from_dict(data | {"phases": data["phases"][:1]}))
    assert flight.begin()
    flight.advance()
    assert flight.begin(data["phases"][1])
    flight.advance()
    planned = flight.phases[1].planned
    assert planned is not None
    assert planned["how"] == "conservative advancement"
    with pytest.raises(rf.MissionError, match="cannot begin by hand"):
        flight.begin(data["phases"][1] | {"transition": "layers", "formation": "ring"})
    result = flight.finish()
    assert rf.assess(result).checks


def test_digests_of_files_stay_where_a_mission_is_rewritten(tmp_path):
    """Ways, layers and staggered phases are written from data; what the numbers are from is still told."""
    (tmp_path / "ring.csv").write_text("\n".join(",".join(map(str, x)) for x in RING.tolist()))
    data = _swap()
    data["formations"]["ring"]["slots"] = "ring.csv"
    path = tmp_path / "mission.toml"
    from rigidfleet._common.toml import to_toml

    path.write_text(to_toml(data))
    result = rf.simulate(path)
    assert "slots of 'ring.csv', SHA-256 " in result.mission.text
    assert "control_points" in result.mission.text


def _circles(rate: float, time: float) -> list:
    """Rows of three vehicles that go on round the origin as a rigid body, from where an orbit has led them."""
    t = np.linspace(0.0, time, 41)
    slots = np.array([[3.0, 0.0, 0.0], [-1.5, 2.6, 0.0], [-1.5, -2.6, 0.0]])
    begin = 8.0 + (slots[:, 0] + 1j * slots[:, 1])
    rows = []
    for z in begin * np.exp(1j * rate * 4.5):  # 3 s of run-in turn half as far as 3 s after it
        y = [(1j * rate) ** k * z * np.exp(1j * rate * t) for k in range(4)]
        states = [
            np.stack([w.real, w.imag, 10.0 * (k == 0) + 0.0 * t, 0.0 * t], axis=1)
            for k, w in enumerate(y)
        ]
        rows.append(curve_to_rows(Piecewise.hermite(t, np.stack(states))))
    return rows


@pytest.mark.parametrize("rate", [20.0, 60.0])
def test_vehicles_fly_their_files_from_a_body_that_turns(rate):
    """Files that go on as the vehicles move are flown as they are, whether or not the body turned before."""
    mission = rf.Mission.from_dict({
        "schema_version": 1, "name": "on", "smoothness": "jerk", "output_step": 0.05,
        "formations": {"three": {"edges": "complete", "slots": [[3, 0, 0], [-1.5, 2.6, 0], [-1.5, -2.6, 0]]}},
        "agents": {"position": [[11.0, 0, 10], [6.5, 2.6, 10], [6.5, -2.6, 10]], "mass": 1.0},
        "phases": [
            {"kind": "establish", "formation": "three", "blend": 2.0, "duration": 3.0},
            {"kind": "orbit", "centre": [0, 0, 10], "radius": 8.0, "rate_deg_s": rate, "blend": 3.0, "duration": 6.0,
             "yaw": "along"},
            {"kind": "follow", "trajectories": _circles(np.radians(rate), 3.0), "duration": 3.0},
        ],
    })  # fmt: skip
    result = rf.simulate(mission)
    inside = result.phase == 2
    radius = np.hypot(*result.position[inside][..., :2].T)
    assert np.ptp(radius, axis=1).max() < 1e-6
    moved = np.diff(np.unwrap(np.arctan2(*result.position[inside][..., [1, 0]].T)), axis=1)
    expected = np.broadcast_to(np.radians(rate) * np.diff(result.time[inside]), moved.shape)
    np.testing.assert_allclose(moved, expected, atol=1e-6)


def test_files_that_end_in_motion_are_followed_by_files_alone():
    """Where vehicles move beside each other at the end, what follows goes on with that motion or is refused."""
    row = lambda x: [2.0, *x, 0.0, 0.0, 0.0, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0]  # noqa: E731
    first = [[row([0.0, 0.0, 0.0])], [row([5.0, 0.0, 0.25])]]
    second = [[row([0.0, 0.0, 0.0])], [row([6.0, 1.0, -0.25])]]
    data = {
        "schema_version": 1, "name": "two", "output_step": 0.05,
        "agents": {"position": [[0.0, 0, 10], [5.0, 0, 10]], "mass": 1.0},
        "limits": {"tracking_error": 0.02},
    }  # fmt: skip
    phases = [{"kind": "follow", "trajectories": x, "duration": 2.0} for x in (first, second)]
    hold = {"kind": "hold", "duration": 1.0}
    assert rf.assess(rf.simulate(rf.Mission.from_dict(data | {"phases": [*phases, hold]}))).passed
    cut = phases[0] | {"duration": 1.0, "travel": 2.0}
    for before, speed in (phases[0], "0.50"), (cut, "0.25"):
        with pytest.raises(rf.MissionError, match=f"goes on at {speed} m/s beside the others"):
            rf.simulate(rf.Mission.from_dict(data | {"phases": [before, hold]}))


def test_files_are_flown_on_from_beside_an_obstacle():
    """A file that begins while the formation evades a ball is led to, and its last point is reached."""
    data = rf.load_mission("moving-obstacles").to_dict()
    place = np.mean(rf.load_mission("moving-obstacles").fleet.position, axis=0)
    x, y, z = place.tolist()
    ways = [[10.0, x + d, 1.5, y, 0.0, z, 0.0, 0.0, 0.0] for d in (0.0, 15.0)]
    data["agents"]["velocity"] = [[1.5, 0.0, 0.0]] * 8
    data["phases"] = [{"kind": "follow", "trajectories": [[way]], "duration": 10.0} for way in ways]
    result = rf.simulate(rf.Mission.from_dict(data))
    assert result.complete, result.ending
    assert np.linalg.norm(result.cm[-1] - place - [30.0, 0, 0]) < 0.1


def _piece(duration, begin, velocity):
    """From rest at a place to a velocity, a row of a trajectory."""
    T, both = duration, zip(begin, velocity, strict=True)
    return [T, *(c for x, v in both for c in (x, 0.0, 0.0, v / T**2, -0.5 * v / T**3)), *[0.0] * 5]


@pytest.mark.parametrize(
    ("speeds", "durations", "keys", "words"),
    [
        ((0.0, 1.0), (2.0, 2.0), {"travel": 2.0, "duration": 4.0}, "agent 1 goes on at 0.50 m/s"),
        ((0.0, 1.0), (2.0, 2.0), {"travel": 2.0, "until": 4.0}, "agent 1 goes on at 0.50 m/s"),
        ((0.0, 1.0), (4.0, 2.0), {"duration": 4.0}, "jumps by 1 m/s at 2 s"),
        ((0.0, 1.0), (2.0, 4.0), {"duration": 4.0}, ""),
        ((1.0, 1.0), (2.0, 2.0), {"travel": 2.0, "duration": 4.0}, ""),
        ((0.0, 1.0), (2.0, 2.0), {"travel": 4.0, "duration": 2.0}, ""),
    ],
)
def test_no_vehicle_stops_at_once_within_a_phase(speeds, durations, keys, words):
    """What ends in motion before its phase does, or before the others, is refused; what flies on to its end is not."""
    ways = [
        [_piece(T, [5.0 * i, 0.0, 10.0], [0.0, v, 0.0])]
        for i, (v, T) in enumerate(zip(speeds, durations, strict=True))
    ]
    data = {
        "schema_version": 1, "name": "two", "output_step": 0.05, "limits": {"tracking_error": 1e-3},
        "agents": {"position": [[0.0, 0, 10], [5.0, 0, 10]], "mass": 1.0},
        "phases": [{"kind": "follow", "trajectories": ways} | keys],
    }  # fmt: skip
    if words:
        with pytest.raises(rf.MissionError, match=words):
            rf.check(rf.Mission.from_dict(data))
        return
    assert rf.assess(rf.simulate(rf.Mission.from_dict(data))).passed


@pytest.mark.parametrize(
    ("until", "speed", "fits"), [(2.0, 1.0, True), (4.0, 1.0, False), (4.0, 0.5, True)]
)
def test_the_first_velocity_is_that_at_which_the_phase_flies(until, speed, fits):
    """A file of two seconds that begins at 1 m/s begins at half of that in a phase that ends at four seconds."""
    rows = [[2.0, *(0.0, 1.0), *(0.0, 0.0), *(10.0, 0.0), *(0.0, 0.0)]]
    mission = rf.Mission.from_dict({
        "schema_version": 1, "name": "one",
        "agents": {"position": [[0.0, 0, 10]], "velocity": [[speed, 0, 0]], "mass": 1.0},
        "phases": [{"kind": "follow", "trajectories": [rows], "until": until}],
    })  # fmt: skip
    if fits:
        assert rf.check(mission).passed
    else:
        with pytest.raises(rf.MissionError, match=r"begins with a velocity 0\.50 m/s off"):
            rf.check(mission)
