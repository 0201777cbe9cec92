"""Exports against closed forms: a flight made of sines, written in each format, read by decoders of the tests.

Decoders follow the definitions of the formats, not the code under test: the firmware's evaluation of polynomials, De
Casteljau's construction of Bezier curves, the schema of Skybrush, the cubic splines of glTF. Readers of others are in
test_export_readers.py.
"""

import base64
import itertools
import json
import math
import os
import struct
import zipfile
from dataclasses import replace
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from sample_flights import swarm
from scipy.interpolate import BPoly

import rigidfleet as rf
from rigidfleet import interchange
from rigidfleet.cli.app import main
from rigidfleet.interchange import FORMATS, FormatName, export
from rigidfleet.interchange.curves import fit_curves, motion_and_is_cut
from rigidfleet.result import VARIABLES

N, END, W = 4, 20.0, 0.5
ORIGIN = {"latitude_deg": 47.3977, "longitude_deg": 8.5456, "altitude": 488.0}


def motion(t):
    """Position and its derivatives (4, K, N, 3), and yaw and its rate (2, K, N), of the flight at times (K,)."""
    at = W * t[:, None] + np.arange(N)
    angle = 0.4 * t[:, None] + 0.5 * np.arange(N)
    x = [3.0 * W**k * np.sin(at + k * np.pi / 2) for k in range(4)]
    y = [2.0 * W**k * np.cos(at + k * np.pi / 2) for k in range(4)]
    z = [0.0 * at + 5.0 + 2.0 * np.arange(N), *[0.0 * at] * 3]
    yaw = np.stack([1.5 * np.sin(angle), 0.6 * np.cos(angle)])
    return np.stack([np.stack(axes, axis=-1) for axes in zip(x, y, z, strict=True)]), yaw


@pytest.fixture(scope="module")
def flight():
    """Four vehicles on ellipses above each other, whose yaw swings; the flight has a place on the Earth."""
    made = swarm(N, END)
    (r, v, a, j), (yaw, rate) = motion(made.time)
    data = made.mission.to_dict() | {"geodetic_origin": ORIGIN}
    return replace(
        made, mission_text=rf.Mission.from_dict(data).text, position=r, velocity=v, acceleration=a,
        slot_position=r, slot_velocity=v, slot_acceleration=a, slot_jerk=j, yaw=yaw, yaw_rate=rate,
    )  # fmt: skip


def shaken(flight, amplitude, omega):
    """The flight with a sine in height added to the reference and to its derivatives."""
    names = ("slot_position", "slot_velocity", "slot_acceleration", "slot_jerk")
    added = {}
    for k, name in enumerate(names):
        added[name] = getattr(flight, name).copy()
        wave = amplitude * omega**k * np.sin(omega * flight.time + k * np.pi / 2)
        added[name][..., 2] += wave[:, None]
    return replace(flight, **added)


def written(flight, name, path, **options):
    """An export, and its files, of which there is one or one a vehicle."""
    made = export(flight, path, name, **options)
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    assert made.files == len(files) == (N if path.is_dir() else 1)
    assert made.size == sum(file.stat().st_size for file in files)
    return made, files


def off(way, agent, end=END):
    """Greatest distance [m] and difference of yaw [rad] of a way, a function of time, from the closed form."""
    t = np.linspace(0.0, end, 1999)
    got = np.array([way(x) for x in t])
    r, (yaw, _) = motion(t)
    turned = np.angle(np.exp(1j * (got[:, 3] - yaw[:, agent])))
    return np.linalg.norm(got[:, :3] - r[0, :, agent], axis=1).max(), abs(turned).max()


def agrees(made, found):
    """What was found is what the export says of itself: as close as it says, and not much closer."""
    position, yaw = np.max(found, axis=0)
    assert position <= made.deviation + 1e-5
    assert position >= 0.8 * made.deviation - 1e-5
    assert yaw == pytest.approx(made.yaw_deviation, rel=0.2, abs=2e-3)


def in_pieces(durations, evaluate):
    """A way of pieces, as a function of time; ``evaluate`` gives the state of a piece at a time since it began."""
    ends = np.cumsum(durations)

    def at(t):
        k = min(int(np.searchsorted(ends, t, side="right")), len(ends) - 1)
        return evaluate(k, t - (ends[k - 1] if k else 0.0))

    return at


def de_casteljau(points, u):
    """The point (d,) of a Bezier curve with control points (n, d) at u in [0, 1]."""
    points = np.asarray(points, dtype=float)
    while len(points) > 1:
        points = (1.0 - u) * points[:-1] + u * points[1:]
    return points[0]


# -- Crazyflie --------------------------------------------------------------------------------------


def test_polynomial(flight, tmp_path):
    """Crazyswarm2's columns, evaluated as it defines them, are the flight within the tolerance."""
    made, files = written(flight, "polynomial", tmp_path / "p", tolerance=2e-3)
    found = []
    for agent, file in enumerate(files):
        head, *lines = file.read_text().splitlines()
        columns = head.split(",")
        assert columns[:3] == ["duration", "x^0", "x^1"]
        assert columns[-1] == "yaw^7"
        rows = [dict(zip(columns, map(float, line.split(",")), strict=True)) for line in lines]

        def state(k, t, rows=rows):
            return [
                sum(rows[k][f"{axis}^{p}"] * t**p for p in range(8))
                for axis in ("x", "y", "z", "yaw")
            ]

        found.append(off(in_pieces([row["duration"] for row in rows], state), agent))
    agrees(made, found)
    assert made.deviation <= 2e-3


def test_poly4d(flight, tmp_path):
    """The image is 132 bytes a piece, coefficients before durations, and flies as the firmware evaluates it."""
    made, files = written(flight, "poly4d", tmp_path / "p")
    found = []
    for agent, file in enumerate(files):
        data = file.read_bytes()
        assert len(data) % 132 == 0
        pieces = [struct.unpack("<33f", data[i : i + 132]) for i in range(0, len(data), 132)]

        def state(k, t, pieces=pieces):
            return [sum(pieces[k][8 * axis + p] * t**p for p in range(8)) for axis in range(4)]

        found.append(off(in_pieces([piece[32] for piece in pieces], state), agent))
    agrees(made, found)
    assert made.deviation <= 1.01e-3


def decompressed(data):
    """A way from a compressed image, by the firmware's description: heads, kinds of curves, control points."""
    at = list(struct.unpack_from("<4h", data))
    place, pieces = 8, []
    while True:
        head, duration = struct.unpack_from("<BH", data, place)
        place += 3
        if duration == 0:
            assert place == len(data)
            break
        axes = []
        for axis in range(4):
            count = {0: 0, 1: 1, 2: 3, 3: 7}[head >> 2 * axis & 3]
            stored = struct.unpack_from(f"<{count}h", data, place)
            place += 2 * count
            axes.append([at[axis], *stored])
            at[axis] = axes[-1][-1]
        pieces.append((duration / 1000, axes))

    def state(k, t):
        duration, axes = pieces[k]
        x, y, z, yaw = (de_casteljau(np.array(points)[:, None], t / duration)[0] for points in axes)
        return [x / 1000, y / 1000, z / 1000, math.radians(yaw / 10)]

    return in_pieces([duration for duration, _ in pieces], state)


def test_compressed(flight, tmp_path):
    """Millimetres, milliseconds and tenths of a degree, decoded as the firmware does, are the flight."""
    made, files = written(flight, "compressed", tmp_path / "c", tolerance=4e-3)
    agrees(made, [off(decompressed(file.read_bytes()), i) for i, file in enumerate(files)])
    assert made.deviation <= 4e-3
    constant_height = all(file.read_bytes()[8] >> 4 & 3 == 0 for file in files)
    assert constant_height  # z does not change, and is stored so


def test_long_pieces_are_cut(flight, tmp_path):
    """A vehicle that hovers for 100 s has pieces of at most 65.535 s, which 16 bits hold in milliseconds."""
    time = flight.time * 5.0
    still = {
        name: 0.0 * getattr(flight, name)
        for name in ("slot_velocity", "slot_acceleration", "slot_jerk", "yaw", "yaw_rate")
    }
    hover = replace(flight, time=time, slot_position=0 * flight.slot_position + 1.0, **still)
    made, files = written(hover, "compressed", tmp_path / "c")
    heads = struct.unpack_from("<BHBH", files[0].read_bytes(), 8)
    assert heads[1] + heads[3] == 100_000
    assert max(heads) <= 65_535
    assert made.deviation < 1e-9


def test_flights_that_do_not_fit_say_what_would(flight, tmp_path):
    """Too long, too far: the remedy is named, and works; nothing is written."""
    fast = shaken(flight, 0.3, 6.0)
    with pytest.raises(rf.ResultError, match=r"needs \d+ pieces of 132 bytes.* room for 31") as e:
        export(fast, tmp_path / "p", "poly4d")
    told = str(e.value)
    tolerance = float(told.split("--tolerance ")[1].split(maxsplit=1)[0])
    assert export(fast, tmp_path / "p", "poly4d", tolerance=tolerance).deviation <= 1.05 * tolerance
    until = float(told.split("the first ")[1].split(maxsplit=1)[0])
    part = fast.time <= until
    names = [name for name, variable in VARIABLES.items() if variable.dims[0] == "time"]
    arrays = {name: x[part] for name in names if (x := getattr(fast, name)) is not None}
    export(replace(fast, **arrays), tmp_path / "p", "poly4d")
    far = replace(flight, slot_position=flight.slot_position + [40.0, 0.0, 0.0])
    with pytest.raises(
        rf.ResultError, match=r"4\d\.\d+ m from the origin.*ends at 32\.767 m.*use poly4d"
    ):
        export(far, tmp_path / "c", "compressed")
    turned = replace(flight, yaw=flight.yaw + 60.0)
    with pytest.raises(rf.ResultError, match=r"yaw of agent 1 reaches 3\d\d\d deg"):
        export(turned, tmp_path / "c", "compressed")
    with pytest.raises(rf.ResultError, match="rounds to millimetres"):
        export(flight, tmp_path / "c", "compressed", tolerance=1e-3)
    # Reversals every 0.1 s need more than 4096 bytes, whatever the tolerance.
    with pytest.raises(
        rf.ResultError,
        match=r"bytes, and the memory has 4096.*No tolerance up to 1 m.*first \d+\.\d s fit",
    ):
        export(shaken(flight, 5.0, 30.0), tmp_path / "c", "compressed")
    assert not (tmp_path / "c").exists()


# -- Skybrush ---------------------------------------------------------------------------------------


def check_skyc(path):
    """Check a show file against the published types of the format; return its drones with references resolved."""
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        show = json.loads(archive.read("show.json"))

        def resolved(value):
            name, mark, rest = value["$ref"].partition("#")
            assert (mark, rest) == ("#", "")
            assert name.startswith("./")
            assert ".." not in name
            return json.loads(archive.read(name[2:]))

        assert show["version"] == 1
        assert show["environment"]["type"] in ("outdoor", "indoor")
        assert show["settings"]["cues"]["version"] == 1
        assert all(set(cue) == {"name", "time"} for cue in show["settings"]["cues"]["items"])
        drones = []
        for drone in show["swarm"]["drones"]:
            settings = drone["settings"] | {
                key: resolved(drone["settings"][key])
                for key in ("trajectory", "yawControl", "lights")
            }
            trajectory, yaw = settings["trajectory"], settings["yawControl"]
            assert drone["type"] == "generic"
            assert trajectory["version"] == yaw["version"] == settings["lights"]["version"] == 1
            times = [point[0] for point in trajectory["points"]]
            assert times == sorted(set(times))
            assert [t for t, _ in yaw["setpoints"]] == sorted({t for t, _ in yaw["setpoints"]})
            assert trajectory["points"][0][2] == []
            assert all(
                len(end) == 3 and len(control) in (0, 2) for _, end, control in trajectory["points"]
            )
            assert all(len(x) == 3 for _, _, control in trajectory["points"] for x in control)
            assert settings["home"] == trajectory["points"][0][1]
            assert trajectory["landingTime"] == times[-1]
            drones.append(settings)
    return show, drones


def test_skyc(flight, tmp_path):
    """The show follows the schema, and its Bezier curves and yaw setpoints are the flight.

    Between setpoints, yaw is on lines (`show-format/src/yaw-control.ts` in skybrush-io/skybrush.js), clockwise
    (`drone-flock.ts` in skybrush-io/viewer: the angle is inverted before it turns a vehicle about z), from the x axis
    (the same file: the mark of yaw zero is along x; so does `AC_DroneShowManager.cpp` in skybrush-io/ardupilot).
    """
    made, (path,) = written(flight, "skyc", tmp_path / "show.skyc")
    show, drones = check_skyc(path)
    assert show["environment"]["location"] == {
        "origin": [473977000, 85456000, 488000], "orientation": 90.0
    }  # fmt: skip
    assert [cue["time"] for cue in show["settings"]["cues"]["items"]] == [0.0, 10.0]
    found = []
    for agent, drone in enumerate(drones):
        points = drone["trajectory"]["points"]
        yaw = np.array(drone["yawControl"]["setpoints"])

        def state(k, t, points=points, yaw=yaw):
            (t0, begin, _), (t1, end, control) = points[k : k + 2]
            place = de_casteljau([begin, *control, end], t / (t1 - t0))
            return [*place, -math.radians(np.interp(t0 + t, *yaw.T))]

        found.append(off(in_pieces(np.diff([point[0] for point in points]), state), agent))
    agrees(made, found)
    assert made.deviation <= 1.01e-2
    assert math.degrees(made.yaw_deviation) <= 0.51
    assert all(0 <= drone["yawControl"]["setpoints"][0][1] < 360 for drone in drones)
    again = tmp_path / "again.skyc"
    export(flight, again, "skyc")
    assert again.read_bytes() == path.read_bytes()


def show_of(path, *drones):
    """A show of drones with these settings, written as the format's types have it."""
    swarm = [{"type": "generic", "settings": {"name": f"d{k}", **x}} for k, x in enumerate(drones)]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("show.json", json.dumps({"version": 1, "swarm": {"drones": swarm}}))
    return path


def read_show(path):
    return FORMATS["skyc"].read(path.read_bytes())


def studio_rotation(t):
    """Rotation about z [deg], counter-clockwise, of the object that Skybrush Studio's numbers are of."""
    return 30.0 + 52.0 * np.clip(t - 2.0, 0.0, 5.0) - 40.0 * np.clip(t - 7.0, 0.0, 2.0)


def test_a_show_of_studio_turns_as_it_did_there(tmp_path):
    """Yaw that Skybrush Studio's own code wrote is read as the rotation that it was given, counter-clockwise."""
    own = json.loads((Path(__file__).parent / "data" / "skybrush_studio.json").read_text())
    (curve,) = read_show(show_of(tmp_path / "studio.skyc", own))
    t = np.linspace(0.0, 10.0, 401)
    yaw = curve.at(t)[:, 3]
    assert abs(np.angle(np.exp(1j * (yaw - np.radians(studio_rotation(t)))))).max() < 1e-4
    assert yaw[280] - yaw[80] == pytest.approx(np.radians(260.0))


def test_a_show_of_studio_turns_so_in_mavlink(tmp_path):
    """Read by `assess` and exported, Studio's show asks MAVLink for headings clockwise from north, and their rates."""
    own = json.loads((Path(__file__).parent / "data" / "skybrush_studio.json").read_text())
    bent = {"points": [[0, [0, 0, 5], []], [10, [4, 0, 5], [[0, 1, 5], [4, 1, 5]]]], "version": 1}
    show = show_of(tmp_path / "studio.skyc", own | {"trajectory": bent})
    assert (
        main(["assess", str(show), "--limits", "speed=1", "--out", str(tmp_path / "judged")]) == 0
    )
    (result,) = (tmp_path / "judged").glob("*.nc")
    assert main(["export", str(result), "--format", "tlog", "--out", str(tmp_path / "tlog")]) == 0
    (log,) = (tmp_path / "tlog").iterdir()
    # Message 84 in MAVLink's common.xml: time [ms], 9 floats of state, yaw and its rate; 18 bytes ahead, 2 after.
    data, found = log.read_bytes(), []
    while data:
        length = data[9]
        if data[13] == 84:
            found.append(struct.unpack_from("<I9f2f", data, 14))
        data = data[8 + 6 + length + 2 :]
    t, yaw, rate = np.array(found)[:, [0, 10, 11]].T
    wanted = np.radians(90.0 - studio_rotation(t / 1e3))
    assert abs(np.angle(np.exp(1j * (yaw - wanted)))).max() < math.radians(0.01)
    turning = (t > 2100) & (t < 6900)
    assert np.degrees(rate[turning]) == pytest.approx(-52.0, abs=0.01)
    again = tmp_path / "again.skyc"
    assert main(["export", str(result), "--format", "skyc", "--out", str(again)]) == 0
    _, (drone,) = check_skyc(again)
    way = np.array(drone["yawControl"]["setpoints"])
    t = np.linspace(0.0, 10.0, 401)
    assert np.interp(t, *way.T) == pytest.approx(360.0 - studio_rotation(t), abs=0.5)


STILL = {"points": [[0, [0, 0, 1], []], [10, [0, 0, 1], []]], "version": 1}


def test_yaw_counts_from_the_start_of_the_show(tmp_path):
    """A later take-off moves a trajectory, not yaw; yaw is constant outside of its setpoints, and may jump."""
    yaw = {"version": 1, "setpoints": [[4, 90], [6, -90], [6, 0], [8, 0], [8, 45]]}
    late = {"trajectory": STILL | {"takeoffTime": 3}, "yawControl": yaw}
    (curve,) = read_show(show_of(tmp_path / "late.skyc", late))
    assert curve.time[[0, -1]].tolist() == [3.0, 13.0]
    found = np.degrees(
        curve.at(np.array([3.0, 4.0, 5.0, 5.999, 6.001, 7.0, 7.999, 8.001, 13.0]))[:, 3]
    )
    assert found == pytest.approx([-90, -90, 0, 90, 0, 0, 0, -45, -45], abs=0.1)


def test_automatic_yaw_is_unknown(tmp_path):
    """Where a vehicle turns by itself, setpoints of yaw are not its yaw; a flight by the file's yaw says so."""
    yaw = {"version": 1, "autoYaw": True, "autoYawOffset": 90, "setpoints": [[0, 10]]}
    (curve,) = read_show(show_of(tmp_path / "auto.skyc", {"trajectory": STILL, "yawControl": yaw}))
    assert np.isnan(curve.pieces[:, 3]).all()


def lights(settings):
    """The light program of a drone as (time, colour, fades) at the end of each of its commands.

    From the table of commands of libskybrush: 4 sets a colour for a time, 8 fades to one in a time, 0 ends.
    """
    code, at, found, frames = base64.b64decode(settings["lights"]["data"]), 0, [], 0
    while code[at]:
        command, colour = code[at], tuple(code[at + 1 : at + 4])
        assert command in (4, 8)
        at, shift, duration = at + 4, 0, 0
        while True:
            duration |= (code[at] & 127) << shift
            shift, at = shift + 7, at + 1
            if code[at - 1] < 128:
                break
        frames += duration
        found.append((round(frames * 0.02, 6), colour, command == 8))
    assert at == len(code) - 1
    return found


def test_lights_of_a_show(tmp_path):
    """Vehicles fade to the colour of the slot that they take, and keep it in a formation that has none."""
    (tmp_path / "row.csv").write_text(
        "x,y,z,red,green,blue\n-2,0,0,255,0,0\n0,0,0,0,255,0\n2,0,0,0,0,255\n"
    )
    mission = tmp_path / "m.toml"
    phase = '[[phases]]\nkind = "{}"\nformation = "{}"\nblend = 2.0\nduration = 3.0\ncontrol = "tracking"\n'
    mission.write_text(
        'schema_version = 1\nname = "lit"\nassignment = "each"\n[agents]\nmass = 1.0\n'
        "position = [[2, 0, 5], [-2, 0, 5], [0, 0, 5]]\n"
        '[formations.row]\nslots = "row.csv"\nedges = []\n'
        "[formations.plain]\nslots = [[-3, 0, 0], [0, 0, 0], [3, 0, 0]]\nedges = []\n"
        "[formations.dark]\nslots = [[-4, 0, 0], [0, 0, 0], [4, 0, 0]]\nedges = []\ncolour = '#000000'\n"
        + "".join(
            phase.format(*x)
            for x in (("establish", "row"), ("reshape", "plain"), ("reshape", "dark"))
        )
    )
    result = rf.simulate(rf.load_mission(mission))
    export(result, tmp_path / "show.skyc", "skyc")
    _, drones = check_skyc(tmp_path / "show.skyc")
    for drone, colour in zip(drones, ((0, 0, 255), (255, 0, 0), (0, 255, 0)), strict=True):
        assert lights(drone) == [
            (0.0, (255, 255, 255), False), (2.0, colour, True), (6.0, colour, False), (8.0, (0, 0, 0), True),
            (9.0, (0, 0, 0), False),
        ]  # fmt: skip


def test_places_are_on_the_earth():
    """A latitude of 91 deg is refused with its key."""
    data = rf.load_mission("hexagon").to_dict() | {
        "geodetic_origin": ORIGIN | {"latitude_deg": 91.0}
    }
    with pytest.raises(rf.MissionError, match=r"geodetic_origin\.latitude_deg = 91"):
        rf.Mission.from_dict(data)


# -- tables and animations --------------------------------------------------------------------------


def test_setpoints(flight, tmp_path):
    """One file and files a vehicle have the same rows, which are the closed form to 9 digits."""
    made, (table,) = written(flight, "setpoints", tmp_path / "all.csv", rate=25.0)
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    t = rows[::N, 0]
    assert t == pytest.approx(np.arange(501) / 25.0)
    r, yaw = motion(t)
    assert rows[:, 2:14] == pytest.approx(r.transpose(1, 2, 0, 3).reshape(-1, 12), abs=2e-4)
    assert rows[:, 2:5] == pytest.approx(r[0].reshape(-1, 3), abs=1e-7)
    assert rows[:, 14:] == pytest.approx(yaw.transpose(1, 2, 0).reshape(-1, 2), abs=1e-4)
    assert made.deviation < 1e-6
    _, files = written(flight, "setpoints", tmp_path / "each", rate=25.0)
    for agent, file in enumerate(files):
        assert np.array_equal(np.loadtxt(file, delimiter=",", skiprows=1), rows[agent::N])
    slow, _ = written(flight, "setpoints", tmp_path / "slow.csv", rate=0.3)
    assert slow.deviation > 10 * made.deviation
    assert slow.span[1] == pytest.approx(20.0)
    assert "from 0 to" not in str(slow)
    cut, _ = written(flight, "setpoints", tmp_path / "cut.csv", rate=0.15)
    assert cut.span == (0.0, 20.0)
    cut, _ = written(flight, "setpoints", tmp_path / "cut.csv", rate=0.12)
    assert cut.span[1] == pytest.approx(2 / 0.12)
    assert "from 0 to 16.6667 s" in str(cut)


def test_gltf(flight, tmp_path):
    """The animation, evaluated as glTF defines cubic splines and slerp, with y up, is the flight."""
    made, (path,) = written(flight, "gltf", tmp_path / "flight.glb")
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    scene = json.loads(data[20 : 20 + length])
    binary = data[28 + length :]

    def array(index):
        accessor = scene["accessors"][index]
        view = scene["bufferViews"][accessor["bufferView"]]
        each = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        values = np.frombuffer(binary[view["byteOffset"] :][: view["byteLength"]], "<f4").reshape(
            -1, each
        )
        assert len(values) == accessor["count"]
        if "min" in accessor:
            assert values.min(axis=0).tolist() == accessor["min"]
        return values.astype(float)

    def spline(t, times, rows):
        k = min(max(np.searchsorted(times, t, side="right") - 1, 0), len(times) - 2)
        h = times[k + 1] - times[k]
        u = (t - times[k]) / h
        (_, p0, m0), (m1, p1, _) = rows[3 * k : 3 * k + 3], rows[3 * k + 3 : 3 * k + 6]
        return (
            (2 * u**3 - 3 * u**2 + 1) * p0 + h * (u**3 - 2 * u**2 + u) * m0
            + (-2 * u**3 + 3 * u**2) * p1 + h * (u**3 - u**2) * m1
        )  # fmt: skip

    def slerp(t, times, q):
        k = min(max(np.searchsorted(times, t, side="right") - 1, 0), len(times) - 2)
        u = (t - times[k]) / (times[k + 1] - times[k])
        angle = math.acos(min(1.0, abs(q[k] @ q[k + 1])))
        if angle < 1e-9:
            return q[k]
        sign = math.copysign(1.0, q[k] @ q[k + 1])
        return (
            math.sin((1 - u) * angle) * q[k] + sign * math.sin(u * angle) * q[k + 1]
        ) / math.sin(angle)

    (animation,) = scene["animations"]
    found = []
    for agent in range(N):
        ways = {}
        for channel in animation["channels"]:
            if channel["target"]["node"] == agent:
                sampler = animation["samplers"][channel["sampler"]]
                times, values = array(sampler["input"])[:, 0], array(sampler["output"])
                assert (np.diff(times) > 0.0).all()
                ways[channel["target"]["path"]] = times, values

        def state(t, ways=ways):
            x, y, z = spline(t, *ways["translation"])
            q = slerp(t, *ways["rotation"])
            return [x, -z, y, 2.0 * math.atan2(q[1], q[3])]

        found.append(off(state, agent))
    agrees(made, found)
    assert made.deviation <= 1.01e-2
    assert math.degrees(made.yaw_deviation) <= 0.51


def test_pieces_are_as_long_as_the_tolerance_allows(flight):
    """Of vehicles fitted together, each has pieces of its own: none could go on for one more interval.

    SciPy makes the same pieces from the closed form's derivatives, and the closed form says how far off they are.
    """
    exported, _ = motion_and_is_cut(flight, flown=False)
    for agent, curve in enumerate(fit_curves(exported.curve_chunks(), 1e-3, yaw_tolerance=10.0)):
        time = np.unique(flight.time.round(9))
        at = np.searchsorted(time, curve.time.round(9))
        assert len(curve.pieces) > 3

        def error(i, j, time=time, agent=agent):
            states = motion(time[[i, j]])[0][:, :, agent]
            piece = BPoly.from_derivatives(time[[i, j]], states.swapaxes(0, 1))
            t = np.linspace(time[i], time[j], 4 * (j - i) + 1)
            return np.linalg.norm(piece(t) - motion(t)[0][0, :, agent], axis=1).max()

        for i, j in itertools.pairwise(at.tolist()):
            assert error(i, j) < 1.01e-3
            assert j == len(time) - 1 or error(i, j + 1) > 0.99e-3


@pytest.mark.parametrize("name", ["skyc", "gltf", "compressed"])
@pytest.mark.parametrize("omega", [0.5, 0.9, 3.0])
def test_yaw_keeps_half_a_degree(flight, tmp_path, name, omega):
    """Tolerances of fitted yaw, of lines through it and of rounding stay within half a degree in sum."""
    angle = omega * flight.time[:, None] + 0.5 * np.arange(N)
    swings = replace(flight, yaw=1.5 * np.sin(angle), yaw_rate=1.5 * omega * np.cos(angle))
    made = export(swings, tmp_path / f"{name}.x", name, tolerance=0.5)
    assert 0.1 < math.degrees(made.yaw_deviation) <= 0.5


def test_fast_turns_are_kept(flight, tmp_path):
    """Vehicles that turn by 1.5 turns a second still do so in a show and an animation: none takes the short way."""
    rate = 3.0 * np.pi
    spun = replace(
        flight, yaw=np.repeat(rate * flight.time[:, None], N, axis=1), yaw_rate=np.full((len(flight.time), N), rate)
    )  # fmt: skip
    for name, most in (("skyc", 0.01), ("gltf", 0.02)):
        made = export(spun, tmp_path / f"spun.{name}", name)
        assert math.degrees(made.yaw_deviation) <= most
    for curve in read_show(tmp_path / "spun.skyc"):
        assert curve.at(np.array([19.9]))[0, 3] == pytest.approx(19.9 * rate, abs=1e-3)


# -- all formats ------------------------------------------------------------------------------------


def test_names():
    """The type and the table of formats have the same names."""
    assert get_args(FormatName) == tuple(FORMATS)


def test_a_plan_is_refused(flight, tmp_path, capsys):
    """Plans, which had no times, are no format any more; the error names what to use instead."""
    with pytest.raises(ValueError, match="no format 'plan'; plans have no times: use tlog to fly"):
        export(flight, tmp_path / "plan", "plan")  # ty: ignore
    assert main(["export", "nothing.nc", "--format", "plan"]) == 2
    assert "use tlog to fly" in capsys.readouterr().err


def test_flown_is_not_the_reference(flight, tmp_path):
    """With ``flown``, the motion flown is exported: here 7 cm beside the reference."""
    beside = replace(flight, position=flight.position + [0.0, 0.07, 0.0])
    export(beside, tmp_path / "reference.csv", "setpoints")
    made = export(beside, tmp_path / "flown.csv", "setpoints", flown=True)
    assert made.flown
    assert "kept the flown position" in str(made)
    assert "yaw is the reference's" in str(made)
    files = tmp_path / "flown.csv", tmp_path / "reference.csv"
    flown, wanted = (np.loadtxt(file, delimiter=",", skiprows=1)[:, 2:5] for file in files)
    assert flown - wanted == pytest.approx(np.tile([0.0, 0.07, 0.0], (len(flown), 1)), abs=1e-7)


def test_a_lost_vehicle_is_exported_as_it_fell(tmp_path):
    """At a loss, forces jump within a phase: the motion flown has no wild jerk there, and is exported with its fall."""
    data = rf.load_mission("narrow-passage").to_dict()
    data["disturbances"] = {"lost": [{"agent": 2, "time": 30.0}]}
    lost = rf.simulate(rf.Mission.from_dict(data))
    jumps = np.flatnonzero(np.diff(lost.time) < 1e-9)
    (k,) = jumps[lost.phase[jumps] == lost.phase[jumps + 1]]
    assert lost.time[k] == 30.0
    jerk = lost.setpoints_at_samples(flown=True).state[:, 3]
    assert abs(jerk[k] - jerk[k - 1]).max() < 0.1
    assert abs(jerk[k + 1, 1]).max() < 1e-6  # in free fall
    made = export(lost, tmp_path / "fall.csv", "setpoints", flown=True)
    fallen = np.loadtxt(made.path, delimiter=",", skiprows=1)[-3:, 4]
    assert fallen == pytest.approx(lost.position[-1, :, 2], rel=1e-8, abs=1e-8)


def test_the_part_that_is_tracked(flight, tmp_path):
    """A phase at the beginning without a reference is left out, and named; files with their own time begin there."""
    state = {}
    for name in (
        "slot_position",
        "slot_velocity",
        "slot_acceleration",
        "slot_jerk",
        "yaw",
        "yaw_rate",
    ):
        state[name] = getattr(flight, name).copy()
        state[name][flight.phase == 0] = np.nan
    half = replace(flight, **state)
    made, (path,) = written(half, "skyc", tmp_path / "half.skyc")
    assert made.span == pytest.approx((10.0, 20.0))
    assert "from 10 to 20 s (slots are not tracked" in str(made)
    points = check_skyc(path)[1][0]["trajectory"]["points"]
    assert (points[0][0], points[-1][0]) == (0.0, 10.0)
    assert points[0][1] == pytest.approx(motion(np.array([10.0]))[0][0, 0, 0], abs=1e-5)


def test_no_reference(flight, tmp_path):
    """Nothing tracked, a number missing, one sample: one sentence each, with the phase and the agent."""
    nothing = replace(flight, slot_position=np.full_like(flight.slot_position, np.nan))
    with pytest.raises(
        rf.ResultError, match=r"^skyc: the reference .* nothing is tracked.* --flown"
    ):
        export(nothing, tmp_path / "a.skyc", "skyc")
    hole = flight.slot_jerk.copy()
    hole[50, 2, 1] = np.nan
    with pytest.raises(
        rf.ResultError, match=r"agent 3 has no number at 2.5 s \(phase 'establish 1'\)"
    ):
        export(replace(flight, slot_jerk=hole), tmp_path / "a.skyc", "skyc")
    one = np.full_like(flight.slot_position, np.nan)
    one[-1] = flight.slot_position[-1]
    with pytest.raises(rf.ResultError, match="one sample only"):
        export(replace(flight, slot_position=one), tmp_path / "a.skyc", "skyc")
    assert export(nothing, tmp_path / "a.skyc", "skyc", flown=True).deviation < 0.0101


def test_a_curve_that_cannot_be_met(flight, tmp_path):
    """Where samples are too far apart for cubic pieces, the tolerance that can be met is named, and works."""
    with pytest.raises(
        rf.ResultError, match=r"1e-08 mm cannot be met: a curve of degree 3 between"
    ) as error:
        export(flight, tmp_path / "a.skyc", "skyc", tolerance=1e-11)
    tolerance = float(str(error.value).split("--tolerance ")[1].split(",")[0])
    assert tolerance > 1e-11
    with pytest.raises(
        rf.ResultError, match=r"cannot be met: what was written is .* off, by rounding"
    ):
        export(flight, tmp_path / "p", "polynomial", tolerance=1e-12)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("usd", {}, "there is no format 'usd'; use one of setpoints, polynomial"),
        ("skyc", {"rate": 10.0}, "rate does not apply to skyc.*give tolerance"),
        ("tlog", {"tolerance": 0.1}, "tolerance does not apply to tlog.*give rate"),
        ("skyc", {"tolerance": 0.0}, "tolerance must be positive, not 0.0"),
        ("tlog", {"rate": math.nan}, "rate must be positive, not nan"),
        ("setpoints", {"rate": 1e9}, "gives .* setpoints; use .* Hz or less"),
        (
            "tlog",
            {"rate": 0.04},
            "a rate of 0.04 Hz gives one setpoint in 20 s; use 0.05 Hz or more",
        ),
    ],
)
def test_wrong_arguments(flight, tmp_path, name, options, message):
    """A wrong argument is a ValueError that says what to give."""
    with pytest.raises(ValueError, match=message):
        export(flight, tmp_path / "x", name, **options)
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_named(flight, tmp_path, monkeypatch):
    """Without the package that writes a format, the message has the command that installs it."""
    monkeypatch.setattr(interchange, "find_spec", lambda name: None)
    for name in ("mcap", "rrd"):
        package = FORMATS[name].distribution
        assert packages_distributions()[FORMATS[name].package] == [package]
        with pytest.raises(rf.ResultError, match=rf"pip install {package}$"):
            export(flight, tmp_path / "x", name)
    export(flight, tmp_path / "x.skyc", "skyc")


def test_all_files_or_none(flight, tmp_path, monkeypatch):
    """A folder is replaced as a whole: an error in the third file leaves the earlier export as it was."""
    folder = tmp_path / "p"
    export(flight, folder, "polynomial")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert set(before) == {f"agent-{i}.csv" for i in (1, 2, 3, 4)}

    def broken(motion, tolerance):
        yield from itertools.islice(FORMATS["polynomial"].write(motion, tolerance), 2)
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(FORMATS, "poly4d", FORMATS["polynomial"]._replace(write=broken))
    with pytest.raises(rf.ResultError, match="cannot be written: No space left on device"):
        export(flight, folder, "poly4d", tolerance=0.5)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["p"]
    export(flight, folder, "polynomial", tolerance=1e-5)
    assert (folder / "agent-1.csv").read_bytes() != before["agent-1.csv"]
    (folder / "mine.txt").write_text("kept")
    with pytest.raises(rf.ResultError, match=r"holds other files \(mine.txt\), which are kept"):
        export(flight, folder, "polynomial")
    with pytest.raises(rf.ResultError, match="each vehicle has a file of its own"):
        export(flight, tmp_path / "p.csv", "polynomial")
    with pytest.raises(rf.ResultError, match="is a folder"):
        export(flight, folder, "skyc")
    assert (folder / "mine.txt").read_text() == "kept"


def test_only_files_are_replaced(flight, tmp_path):
    """A pipe, and so a device, is refused: a file in its place would remove it."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(rf.ResultError, match="pipe: cannot be written: it is a device or a pipe"):
        export(flight, pipe, "skyc")
    assert pipe.is_fifo()


def test_command(tmp_path, monkeypatch, capsys):
    """The command says in one line what it kept and lost, keeps existing files, and refuses a truncated result."""
    result = tmp_path / "sines.nc"
    flight = rf.simulate("crazyflies")
    flight.save(result)
    assert main(["export", str(result), "--format", "skyc"]) == 0
    kept, path = capsys.readouterr().out.splitlines()
    assert kept.startswith("skyc: 1 file, ")
    assert "kept the reference position (cubic pieces) and yaw within" in kept
    assert "; lost continuous acceleration, tilt and rotors." in kept
    assert path.endswith("sines.skyc")
    assert main(["export", str(result), "--format", "skyc"]) == 2
    assert "already exists; use --force" in capsys.readouterr().err
    assert main(["export", str(result), "--format", "skyc", "--force", "--tolerance", "0.1"]) == 0
    assert main(["export", str(result), "--format", "poly4d"]) == 0
    assert len(list((tmp_path / "sines-poly4d").iterdir())) == flight.n_agents
    capsys.readouterr()
    assert main(["export", str(result), "--format", "tlog", "--tolerance", "0.1"]) == 2
    assert "error: tolerance does not apply to tlog" in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    assert main(["export", ".", "--format", "skyc"]) == 2
    assert "error: .: is a folder" in capsys.readouterr().err
    assert main(["export", str(result), "--format", "usd"]) == 2
    assert "usd" in capsys.readouterr().err
    cut = tmp_path / "cut.nc"
    cut.write_bytes(result.read_bytes()[:-1000])
    assert main(["export", str(cut), "--format", "skyc"]) == 2
    assert "cut.nc: the result is damaged" in capsys.readouterr().err
    assert not (tmp_path / "cut.skyc").exists()
