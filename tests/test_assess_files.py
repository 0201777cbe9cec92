"""Files of other programs: known flights are judged right, and each bad file gets one clear error."""

import io
import itertools
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.cli.app import BAD_INPUT, FAILED, PASSED, main
from rigidfleet.foreign import shows, texts
from rigidfleet.foreign.files import SUFFIXES, read_trajectories
from rigidfleet.simulation.trajectories import result_of_trajectories

SEVEN = Path(__file__).parent / "data" / "sequence_trajectories"
HEAD = "time_s,x_m,y_m,z_m"


def judged(files, interpolation="cubic", **given):
    """The verdict on files, and the result."""
    read = read_trajectories(files, interpolation)
    result = result_of_trajectories(read._replace(away=False), **given)
    return rf.assess(result), result


def check_of(verdict, name):
    return next(c for c in verdict.checks if c.check == name)


def table(path, rows, head=HEAD):
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def show(path, drones, **more):
    """A show: for each drone its points, as a member of the archive."""
    entries = {
        f"drones/{k}.json": {"version": 1, "points": points, "takeoffTime": 0}
        for k, points in enumerate(drones)
    }
    settings = [
        {"type": "generic", "settings": {"name": f"cf{k}", "trajectory": {"$ref": f"./drones/{k}.json#"}}}
        for k in range(len(drones))
    ]  # fmt: skip
    entries |= {"show.json": {"version": 1, "swarm": {"drones": settings}}} | more
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content if isinstance(content, str) else json.dumps(content))
    return path


# -- known flights -----------------------------------------------------------------------------------


def seven_at(t):
    """Positions (K, 7, 3) of the seven Crazyflies, evaluated from the definition of their table."""
    found = np.zeros((len(t), 7, 3))
    for i in range(7):
        rows = np.loadtxt(SEVEN / f"{i + 1}.csv", delimiter=",", skiprows=1)
        ends = np.cumsum(rows[:, 0])
        k = np.minimum(np.searchsorted(ends, t, side="right"), len(rows) - 1)
        after = t - (ends - rows[:, 0])[k]
        for axis in range(3):
            coefficients = rows[k, 1 + 8 * axis : 9 + 8 * axis]
            found[:, i, axis] = sum(coefficients[:, p] * after**p for p in range(8))
    return found


def test_seven_crazyflies_come_within_0_286_m(tmp_path):
    """Crazyswarm's flight: least distance 0.286 m centre to centre, as dense samples of its polynomials say."""
    verdict, _ = judged(SEVEN, separation=0.25)
    found = check_of(verdict, "separation")
    assert verdict.passed
    assert found.worst == pytest.approx(0.286, abs=5e-4)
    near = np.linspace(found.when - 0.5, found.when + 0.5, 20_001)
    every = np.concatenate([np.linspace(0, 198, 39_601), near])
    r = seven_at(every)
    dense = min(
        np.linalg.norm(r[:, i] - r[:, j], axis=1).min()
        for i, j in itertools.combinations(range(7), 2)
    )
    assert found.worst <= dense + 2e-6
    assert found.worst == pytest.approx(dense, abs=1e-5)
    assert any("centre to centre is 0.286 m" in note for note in verdict.notes)
    with_radius, _ = judged(SEVEN, radius=0.06, separation=0.0)
    assert check_of(with_radius, "separation").worst == pytest.approx(found.worst - 0.12, abs=1e-9)
    assert any("centre to centre is 0.286 m" in note for note in with_radius.notes)
    assert not judged(SEVEN, separation=0.29)[0].passed


def test_files_that_a_vehicle_flies_one_after_the_other(tmp_path):
    """A folder of folders is the same flight as the joined tables."""
    for source in SEVEN.glob("*.csv"):
        head, *rows = source.read_text().splitlines()
        folder = tmp_path / source.stem
        folder.mkdir()
        for part, first in enumerate(
            range(0, len(rows), 18), start=1
        ):  # 10 is after 9, not after 1
            text = [head + ",", *(row + "," for row in rows[first : first + 18])]
            (folder / f"{part}.csv").write_text("\n".join(text))
    joined, parts = read_trajectories(SEVEN), read_trajectories(tmp_path)
    assert parts.names == joined.names
    for a, b in zip(joined.curves, parts.curves, strict=True):
        np.testing.assert_allclose(a.time, b.time)
        np.testing.assert_array_equal(a.pieces, b.pieces)


def five_drones():
    """Five drones with the known numbers of a Skybrush demonstration: 0.747 m between two, 1.31 m/s at most.

    One flies past another by a Bezier curve that begins and ends at rest: its speed peaks at 3/2 of the mean.
    """
    way, apart, fastest = 6.0, 0.747, 1.31
    T = 1.5 * way / fastest
    past = [[0, [0, 0, 2], []], [T, [way, 0, 2], [[0, 0, 2], [way, 0, 2]]]]
    still = [[[0, [way / 2, apart, 2], []], [T, [way / 2, apart, 2], []]]]
    far = [[[0, [x, 9, 2], []], [T, [x, 9, 3], []]] for x in (0, 3, 6)]
    return [past, *still, *far]


def test_a_show_of_five_drones(tmp_path):
    """0.747 m centre to centre, and 1.31 m/s against a limit of 1."""
    path = show(tmp_path / "five.skyc", five_drones())
    verdict, _ = judged(path, separation=0.7, limits={"speed": 1.0})
    assert check_of(verdict, "separation").worst == pytest.approx(0.747, abs=1e-6)
    speed = check_of(verdict, "speed")
    assert speed.worst == pytest.approx(1.31, abs=1e-9)
    assert not speed.passed
    assert judged(path, separation=0.7, limits={"speed": 1.32})[0].passed


def test_a_drone_that_takes_off_later_stays_until_then(tmp_path):
    """Times of a show count from each drone's take-off, and the verdict says who waits."""
    late = {"version": 1, "points": [[0, [0, 0, 0], []], [2, [0, 0, 4], []]], "takeoffTime": 3}
    first = [[0, [5, 0, 0], []], [2, [5, 0, 4], []]]
    path = show(tmp_path / "late.skyc", [first, first], **{"drones/1.json": late})
    read = read_trajectories(path)
    assert read.curves[1].time.tolist() == [3.0, 5.0]
    result = result_of_trajectories(read._replace(away=False))
    assert result.time[-1] == 5.0
    assert not result.position[result.time < 2.9][:, 1].any()
    assert "stays at its first and last place" in read.notes[0]


# -- columns and units -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """Setpoints of a flight of our own."""
    path = tmp_path_factory.mktemp("own") / "own.csv"
    result = rf.simulate("narrow-passage")
    rf.export(result, path, "setpoints", flown=True, rate=5.0)
    return path


def test_columns_may_have_any_order(own, tmp_path):
    """Tables with their columns turned round are the same flight, also for the reader of our own exports."""
    lines = [line.split(",") for line in own.read_text().splitlines()]
    turned = tmp_path / "turned.csv"
    turned.write_text("\n".join(",".join(reversed(line)) for line in lines))
    for a, b in zip(
        texts.read_result_table(own.read_bytes()),
        texts.read_result_table(turned.read_bytes()),
        strict=True,
    ):
        np.testing.assert_array_equal(a.pieces, b.pieces)
    first, second = read_trajectories(own), read_trajectories(turned)
    assert first.names == second.names == ("1", "2", "3")
    for a, b in zip(first.curves, second.curves, strict=True):
        np.testing.assert_array_equal(a.pieces, b.pieces)


def test_units_are_those_of_the_names(tmp_path):
    """Milliseconds and millimetres in the header give seconds and metres; without units, the note doubts them."""
    t = np.arange(5.0)
    rows = [[1000 * x, 1500 * x, 0, 2000, 90] for x in t]
    named = table(tmp_path / "named.csv", rows, "Time [msec],x [mm],y [mm],z [mm],yaw [deg]")
    (curve,) = read_trajectories(named).curves
    np.testing.assert_allclose(curve.at(t)[:, 0], 1.5 * t, atol=1e-12)
    np.testing.assert_allclose(curve.at(t)[:, 3], np.pi / 2)
    plain = table(tmp_path / "plain.csv", [[x, 1500 * x, 0, 2000] for x in t])
    assert any("metres and seconds?" in note for note in judged(plain)[0].notes)
    assert not any("metres and seconds?" in note for note in judged(named)[0].notes)


def test_fields_may_be_quoted(tmp_path):
    """A spreadsheet that quotes every field writes the same table, with the same names of vehicles."""
    head, rows = f"agent,{HEAD}", [["cf 1", 0, 0, 0, 1], ["cf 1", 1, 2, 3, 4]]
    plain, quoted = table(tmp_path / "plain.csv", rows, head), tmp_path / "quoted.csv"
    quoted.write_text(re.sub(r"[^,\n]+", r'"\g<0>"', plain.read_text()))
    one, other = read_trajectories(plain), read_trajectories(quoted)
    assert one.names == other.names == ("cf 1",)
    np.testing.assert_array_equal(one.curves[0].pieces, other.curves[0].pieces)


def test_a_flight_shorter_than_a_sample_is_judged(tmp_path):
    """Seconds that a column calls milliseconds: 2 m in 20 ms are 100 m/s."""
    path = table(tmp_path / "short.csv", [[0, 0, 0, 1], [20, 2, 0, 1]], "time [ms],x,y,z")
    verdict, result = judged(path, limits={"speed": 50.0})
    assert check_of(verdict, "speed").worst == pytest.approx(100.0)
    assert result.time[-1] == pytest.approx(0.02)


def test_vehicles_at_one_place_fail(tmp_path):
    """Two vehicles that start and fly at the same place are judged, not refused."""
    rows = [[t, i, t, 0, 1] for t in range(4) for i in (1, 2)]
    path = table(tmp_path / "same.csv", rows, "time_s,agent,x_m,y_m,z_m")
    verdict, _ = judged(path)
    assert not verdict.passed
    assert check_of(verdict, "separation").worst == 0.0
    with pytest.raises(rf.RigidfleetError, match="separation_below needs radii"):
        judged(path, limits={"separation_below": 1.0})
    stacked = judged(path, radius=0.2, limits={"separation_below": 1.0})[0]
    assert not check_of(stacked, "separation_below").passed


def test_stated_velocities_are_not_believed(tmp_path):
    """Speeds come from positions; other velocities in the file are noted."""
    head = HEAD + ",vx_m_s,vy_m_s,vz_m_s"
    path = table(tmp_path / "v.csv", [[k, 2 * k, 0, 1, 0, 0, 0] for k in range(6)], head)
    verdict, _ = judged(path, limits={"speed": 1.0})
    assert check_of(verdict, "speed").worst == pytest.approx(2.0)
    assert "which count" in read_trajectories(path).notes[0]


def test_lines_and_corners_break_limits_of_acceleration(tmp_path):
    """What jumps in velocity keeps no limit of acceleration, whether it is a table or a show."""
    path = table(tmp_path / "lines.csv", [[0, 0, 0, 1], [1, 1, 0, 1], [2, 1, 1, 1], [3, 0, 1, 1]])
    for limit in ("acceleration", "horizontal_acceleration"):
        lines, _ = judged(path, "linear", limits={limit: 1e6})
        assert "cannot be judged" in check_of(lines, limit).message
        assert not lines.passed
        assert judged(path, "cubic", limits={limit: 1e6})[0].passed
    points = [[0, [0, 0, 1], []], [1, [1, 0, 1], [[0.3, 0, 1], [0.6, 0, 1]]], [2, [1, 1, 1], []]]
    bent = show(tmp_path / "bent.skyc", [points])
    verdict, _ = judged(bent, limits={"acceleration": 1e6})
    assert not check_of(verdict, "corner").passed
    assert check_of(verdict, "corner").when == pytest.approx(1.0)
    assert judged(bent, limits={"speed": 1e3})[0].passed


# -- bad files ---------------------------------------------------------------------------------------

_POLY = "duration," + ",".join(f"{a}^{k}" for a in ("x", "y", "z", "yaw") for k in range(8))
_ROW = "1," + ",".join(["0"] * 32)
BAD_TEXTS = {
    "empty": ("", "is empty"),
    "no header": ("0,0,0,1\n1,0,0,1\n", "line 1: has no names of columns"),
    "no rows": (HEAD + "\n", "no rows"),
    "truncated": (f"{HEAD}\n0,0,0,1\n1,0,0\n", "line 3: has 3 fields"),
    "too many": (f"{HEAD}\n0,0,0,1\n1,0,0,1,7\n", "line 3: has 5 fields"),
    "NaN": (f"{HEAD}\n0,0,0,1\n# a comment\nnan,0,0,1\n", "line 4: time_s is nan"),
    "no position": (f"{HEAD}\n0,nan,0,1\n1,nan,0,1\n", "'bad' has no position"),
    "infinite": (f"{HEAD}\n0,0,0,1\n1,0,0,inf\n", "line 3: z_m is inf"),
    "no number": (f"{HEAD}\n0,0,0,1\n1,here,0,1\n", "line 3: x_m is here"),
    "empty field": (f"{HEAD}\n0,0,0,1\n,0,0,1\n", "line 3: time_s is empty"),
    "repeated": (f"{HEAD}\n0,0,0,1\n1,0,0,1\n1,0,0,1\n", "line 4: the time 1 s repeats 1 s"),
    "backwards": (f"{HEAD}\n0,0,0,1\n2,0,0,1\n1,0,0,1\n", "line 4: the time 1 s goes back behind 2 s"),
    "huge": (f"{HEAD}\n0,0,0,1\n1,1e300,0,1\n", "from the origin in piece 1"),
    "late": (f"{HEAD}\n0,0,0,1\n1e9,0,0,1\n", "the most is 1e+06 s"),
    "missing column": ("time_s,x_m,y_m\n0,0,0\n", "no column for z"),
    "two columns": ("time_s,x_m,y_m,z_m,x [mm]\n0,0,0,0,0\n", "two columns for x"),
    "rods": ("time_s,x [rd],y_m,z_m\n0,0,0,1\n", "unknown unit 'rd'"),
    "other spans": (f"agent,{HEAD}\n1,0,0,0,1\n1,1.5,0,0,1\n2,0,1,0,1\n2,1,1,0,1\n2,9,1,0,1\n2,10,1,0,1\n",
                    "'1' has samples from 0 to 1.5 s, and others from 0 to 10 s"),
    "decimal comma": ("time;x;y;z\n0;0;0;1\n0,5;0;0;1.5\n",
                      "line 3: time is 0,5, not a finite number. Write decimals with a point"),
    "grouped digits": (f"{HEAD}\n0,0,0,1\n1,1_0,0,1\n", "line 3: x_m is 1_0"),
    "nameless": (f"agent,{HEAD}\na,0,0,0,1\n,1,0,0,1\n", "line 3: agent is empty"),
    "escapes": (f"{HEAD}\n0,0,0,1\n1,\033[31m0,0,1\n", "line 3: has the control character U+001B"),
    "NUL": (f"{HEAD}\n0,0,0,\0\n", "line 2: has the control character U+0000"),
    "short polynomial": (f"{_POLY}\n{_ROW}\n1,0,0\n", "line 3: has 3 fields"),
    "NaN polynomial": (f"{_POLY}\n{_ROW[:-1]}nan\n", "line 2: yaw^7 is nan"),
    "no duration": (f"{_POLY}\n{_ROW}\n0{_ROW[1:]}\n", "line 3: the duration is 0 s"),
    "lacks a power": (f"{_POLY.replace('z^3', 'z^9')}\n{_ROW}\n", "no column, or two, for z^3"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD_TEXTS)
def test_bad_tables_are_refused_by_file_and_line(kind, tmp_path, capsys):
    text, message = BAD_TEXTS[kind]
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(rf.RigidfleetError, match=re.escape(message)) as caught:
        read_trajectories(path)
    assert str(path) in str(caught.value)
    assert main(["assess", str(path)]) == BAD_INPUT
    err = capsys.readouterr().err
    assert "Traceback" not in err
    assert "bug" not in err


def test_another_encoding_is_named(tmp_path):
    path = tmp_path / "old.csv"
    path.write_bytes(f"agent,{HEAD}\né,0,0,0,1\n".encode("latin-1"))
    with pytest.raises(
        rf.RigidfleetError, match=r"old\.csv: is neither text in UTF-8 .* Save a table as UTF-8"
    ):
        read_trajectories(path)


def zipped(entries):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def one(trajectory):
    """A show of one drone whose trajectory is in show.json."""
    drones = [{"settings": {"name": "cf", "trajectory": trajectory}}]
    return zipped({"show.json": json.dumps({"version": 1, "swarm": {"drones": drones}})})


_GOOD = {"points": [[0, [0, 0, 0], []], [1, [0, 0, 1], []]]}
BAD_SHOWS = {
    "no zip": (b"PK\3\4 and then nothing", "not a complete zip archive"),
    "truncated": (one(_GOOD)[:-30], "not a complete zip archive"),
    "no show": (zipped({"other.json": "{}"}), "has no show.json"),
    "damaged": (zipped({"show.json": "{"}), "show.json: is damaged"),
    "no drones": (zipped({"show.json": '{"swarm": {"drones": []}}'}), "has no drones"),
    "list": (zipped({"show.json": "[]"}), "has no list 'swarm.drones'"),
    "nested": (zipped({"show.json": "[" * 200_000}), "nested too deeply"),
    "leaves": (one({"$ref": "../../etc/passwd"}), "outside of the show"),
    "leaves by a drive": (one({"$ref": "C:\\x.json"}), "outside of the show"),
    "leaves by the root": (one({"$ref": "/etc/passwd#"}), "outside of the show"),
    "missing entry": (one({"$ref": "./none.json#"}), "has no none.json"),
    "NaN": (zipped({"show.json": '{"swarm": {"drones": [NaN]}}'}), "NaN, not a finite number"),
    "text": (one({"points": [["a", [0, 0, 0], []], [1, [0, 0, 1], []]]}), "cf: point 1"),
    "two axes": (one({"points": [[0, [0, 0], []], [1, [0, 0, 1], []]]}), "cf: point 1"),
    "backwards": (one({"points": [[1, [0, 0, 0], []], [0, [0, 0, 1], []]]}), "cf: point 2: its time 0 s"),
    "repeated": (one({"points": [[0, [0, 0, 0], []], [0, [0, 0, 1], []]]}), "cf: point 2: its time 0 s"),
    "control": (one({"points": [[0, [0, 0, 0], []], [1, [0, 0, 1], [[1, 2]]]]}), "cf: point 2"),
    "many": (one({"points": [[0, [0, 0, 0], []], [1, [0, 0, 1], [[0, 0, 0]] * 9]]}), "9 control points"),
    "huge": (one({"points": [[0, [0, 0, 0], []], [1, [0, 0, 1e200], []]]}), "from the origin"),
    "none": (one({"points": []}), "no points"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD_SHOWS)
def test_bad_shows_are_refused(kind, tmp_path, capsys):
    data, message = BAD_SHOWS[kind]
    path = tmp_path / "bad.skyc"
    path.write_bytes(data)
    with pytest.raises(rf.RigidfleetError, match=re.escape(message)) as caught:
        read_trajectories(path)
    assert str(path) in str(caught.value)
    assert main(["assess", str(path)]) == BAD_INPUT
    assert "Traceback" not in capsys.readouterr().err


def test_a_zip_bomb_is_refused_unopened(tmp_path, monkeypatch):
    """An archive that says it unpacks to more than the greatest size is not unpacked."""
    monkeypatch.setattr(shows, "_BYTES", 1 << 20)
    path = tmp_path / "bomb.skyc"
    path.write_bytes(zipped({"show.json": " " * (2 << 20)}))
    assert path.stat().st_size < 10_000
    with pytest.raises(rf.RigidfleetError, match="unpacks to 2 MiB"):
        read_trajectories(path)


def test_an_entry_that_all_drones_refer_to_is_not_read_without_end(tmp_path, monkeypatch):
    """An entry counts as often as it is read; drones that fly the same way share what was read once."""
    way = '{"points": [[0, [0, 0, 1], []], [1, [1, 0, 1], []]]' + " " * 1000 + "}"
    drones: Any = [{"settings": {"trajectory": {"$ref": "./way.json#"}}} for _ in range(100)]
    show = {"swarm": {"drones": drones}}
    path = tmp_path / "show.skyc"
    monkeypatch.setattr(shows._Archive, "room", 20_000)
    path.write_bytes(zipped({"show.json": json.dumps(show), "way.json": way}))
    assert len(read_trajectories(path).curves) == 100
    for k, drone in enumerate(drones):
        drone["settings"] |= {"yawControl": {"setpoints": [[0, k]]}}
    path.write_bytes(zipped({"show.json": json.dumps(show), "way.json": way}))
    with pytest.raises(rf.RigidfleetError, match=r"way\.json: drones refer to it too often"):
        read_trajectories(path)


def test_bad_recordings_are_refused(tmp_path):
    pytest.importorskip("mcap")
    path = tmp_path / "bad.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(rf.RigidfleetError, match=re.escape(str(path))):
        read_trajectories(path)


def test_recordings_of_other_writers_are_read(tmp_path):
    """Poses that rosbags serialises, with any name of the frame, in whatever order the topics come."""
    pytest.importorskip("mcap")
    rosbags = pytest.importorskip("rosbags.typesys")
    from mcap.writer import Writer

    store = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
    T = store.types
    path = tmp_path / "poses.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        kind = "geometry_msgs/msg/PoseStamped"
        schema = writer.register_schema(kind, "ros2msg", b"")
        for i, frame in enumerate(("map", "a longer frame", "")):
            channel = writer.register_channel(f"/drone{i}/pose", "cdr", schema)
            for k in range(5):
                stamp = T["builtin_interfaces/msg/Time"](sec=1_700_000_000 + k, nanosec=500)
                at = T["geometry_msgs/msg/Point"](x=float(k), y=float(i), z=2.0)
                turned = T["geometry_msgs/msg/Quaternion"](
                    x=0.0, y=0.0, z=np.sin(0.5), w=np.cos(0.5)
                )
                pose = T["geometry_msgs/msg/Pose"](position=at, orientation=turned)
                header = T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)
                data = store.serialize_cdr(T[kind](header=header, pose=pose), kind)
                writer.add_message(channel, k, bytes(data), k)
        writer.finish()
    read = read_trajectories(path, topic="*")
    assert read.names == ("/drone0/pose", "/drone1/pose", "/drone2/pose")
    for i, curve in enumerate(read.curves):
        np.testing.assert_allclose(curve.time, np.arange(5.0), atol=1e-9)
        np.testing.assert_allclose(curve.at(curve.time)[:, :3], [[k, i, 2] for k in range(5)])
        np.testing.assert_allclose(curve.at(curve.time)[:, 3], 1.0)
    whole = path.read_bytes()
    path.write_bytes(whole[:-200])  # as of a recording that ended with the power
    cut = read_trajectories(path, topic="*")
    assert cut.names == read.names
    assert "the log is damaged in part: what could be read is judged" in cut.notes
    path.write_bytes(whole[:200])
    with pytest.raises(rf.RigidfleetError, match="damaged"):
        read_trajectories(path)


def test_ten_thousand_drones(tmp_path):
    """A table of 10,000 drones is judged."""
    n = 10_000
    x, y = np.divmod(np.arange(n), 100)
    rows = [
        f"{t},{i},{2 * x[i]},{2 * y[i]},{10 + t}" for t in (0, 1, 2) for i in range(n)
    ]  # fmt: skip
    path = tmp_path / "many.csv"
    path.write_text("\n".join(["time_s,agent,x_m,y_m,z_m", *rows]))
    verdict, result = judged(path, separation=1.9, limits={"vertical_speed": 1.1})
    assert result.n_agents == n
    assert verdict.passed
    assert check_of(verdict, "separation").worst == pytest.approx(2.0)


# -- command -----------------------------------------------------------------------------------------


def test_assess_writes_what_a_flight_has(tmp_path, capsys):
    """Verdict, result, report, replay and figures, of which none outlives its flight; exit codes as for a flight."""
    out = tmp_path / "out"
    options = ["assess", str(SEVEN), "--limits", "speed=0.3,vertical_speed=0.19", "--out", str(out)]
    assert main([*options, "--separation", "0.2", "--figures", "all"]) == PASSED
    text = " ".join(capsys.readouterr().out.split())
    assert "centre to centre is 0.286 m" in text
    assert "the polynomials of the file" in text
    names = {path.name for path in out.iterdir()}
    assert {"sequence_trajectories.nc", "verdict.json", "report.html", "replay.html"} <= names
    (read,) = json.loads((out / "verdict.json").read_text())["read"]
    assert (read["files"], read["vehicles"]) == (7, 7)
    assert rf.Result.load(out / "sequence_trajectories.nc").statistics["read"] == [read]
    drawn = {"clearance.png", "cm.png", "motion.png", "trajectory.png"}
    assert {path.name for path in (out / "figures").iterdir()} == drawn
    page = (out / "report.html").read_text()
    assert "the polynomials of the file" in page
    assert "Gains" not in page
    assert main([*options, "--separation", "0.2"]) == BAD_INPUT
    assert main([*options, "--separation", "0.2", "--force"]) == PASSED
    assert [path.name for path in (out / "figures").iterdir()] == ["trajectory.png"]
    capsys.readouterr()
    assert main(["assess", str(SEVEN), "--separation", "0.3"]) == FAILED
    assert main(["assess", str(out / "sequence_trajectories.nc")]) == PASSED
    assert main(["assess", str(SEVEN), "--limits", "sped=2"]) == BAD_INPUT
    assert main(["assess", str(SEVEN), "--mission", "narrow-passage"]) == BAD_INPUT
    assert main(["assess", str(tmp_path / "nothing.csv")]) == BAD_INPUT
    empty = tmp_path / "empty"
    empty.mkdir()
    assert main(["assess", str(empty)]) == BAD_INPUT
    assert "Traceback" not in capsys.readouterr().err


def test_a_mission_gives_obstacles_and_limits(own, capsys):
    """Our own flight, read back from its setpoints, is judged by the mission it flew: obstacles, radii and limits."""
    assert main(["assess", str(own), "--mission", "narrow-passage", "--json"]) == PASSED
    found = {c["check"]: c for c in json.loads(capsys.readouterr().out)["checks"]}
    flown = check_of(rf.assess(rf.simulate("narrow-passage")), "clearance")
    assert found["clearance"]["worst"] == pytest.approx(flown.worst, abs=0.02)


# -- the page ----------------------------------------------------------------------------------------

ROOT = Path(__file__).parents[1]


def test_the_page_says_what_happens(tmp_path, monkeypatch, capsys):
    """The command of the page gives the verdict that it quotes, and its Python runs.

    The report has no summary, of which most panels would be empty.
    """
    page = (ROOT / "docs" / "import.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^rigidfleet (assess .*)$", page, re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    tmp_path.joinpath("tests").symlink_to(ROOT / "tests")
    assert main(command.split()) == FAILED
    said = " ".join(capsys.readouterr().out.split())
    quoted = re.search(r"^Note: others.*?(?=\n```)", page, re.MULTILINE | re.DOTALL)
    assert quoted is not None
    assert " ".join(quoted[0].split()) in said
    report = (tmp_path / "flights" / "seven" / "report.html").read_text(encoding="utf-8")
    assert report.count("Paths of the vehicles") == 1
    assert "Summary of the flight" not in report
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(compile(code, "import.md", "exec"), {})
    assert capsys.readouterr().out.startswith("Passed")


def test_a_missing_file_is_named(tmp_path, capsys):
    """A path without a file says so, and nothing of folders to create."""
    assert main(["assess", str(tmp_path / "none.csv")]) == BAD_INPUT
    assert "none.csv: no such file" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["my flight (2).csv", "Дрон.csv", "flight é.csv", "-.csv"])
def test_a_file_may_have_any_name(name, tmp_path, monkeypatch, capsys):
    """Also one that a mission may not have; so may the folder in which it is judged."""
    folder = tmp_path / "été 2026"
    folder.mkdir()
    table(folder / name, [[0, 0, 0, 1], [1, 1, 0, 1]])
    monkeypatch.chdir(folder)
    assert main(["assess", str(folder / name), "--out", "made"]) == PASSED
    assert "Passed: the only check holds." in capsys.readouterr().out
    assert len(list(Path("made").glob("*.nc"))) == 1
    assert main(["assess", "."]) == PASSED


def test_no_table_of_an_earlier_flight_stays_beside_a_result(tmp_path):
    """`assess --out` refuses to write where one stands, as `run` does; with --force, it goes."""
    out = tmp_path / "made"
    out.mkdir()
    (out / "flight.csv").write_text("of an earlier flight\n")
    table(tmp_path / "flight.csv", [[0, 0, 0, 1], [1, 1, 0, 1]])
    options = ["assess", str(tmp_path / "flight.csv"), "--out", str(out)]
    assert main(options) == BAD_INPUT
    assert [path.name for path in out.iterdir()] == ["flight.csv"]
    assert main([*options, "--force"]) == PASSED
    assert (out / "flight.nc").exists()
    assert not (out / "flight.csv").exists()


@pytest.mark.parametrize("mission", ["narrow-passage", "mine.toml"])
def test_a_mission_is_no_flight(mission, tmp_path, monkeypatch, capsys):
    """A mission in place of a result is refused with what flies it; a file that is not there, as that."""
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(rf.load_mission("two-agents").text)
    assert main(["assess", mission]) == BAD_INPUT
    error = capsys.readouterr().err
    assert error.startswith(f"error: {mission}: is a mission")
    assert f"`rigidfleet run {mission}`" in error
    assert main(["assess", "yours.toml"]) == BAD_INPUT
    assert "yours.toml: no such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "words"), [(["a"], "agent 1 is a"), (["a", "b"], "agents from 1 on are a, b")]
)
def test_a_note_names_the_vehicles_of_a_file(names, words, tmp_path):
    """Names of one vehicle and of several stand in a sentence that fits their number."""
    rows = [[t, 3.0 * k, t, 2.0, name] for k, name in enumerate(names) for t in (0.0, 1.0, 2.0)]
    verdict, _ = judged(table(tmp_path / "of.csv", rows, f"{HEAD},agent"), separation=0.5)
    assert words in verdict.notes


def test_vehicles_with_numbers_for_names_are_in_their_order(tmp_path):
    """A first row that is lost, or has no position, changes no vehicle's number."""
    rows = [f"{t},{who},{who}.5,{t},1" for t in range(5) for who in (10, 2, 1)]
    for first in (rows[:2], ["0,10,,,", "0,2,nan,nan,nan"]):
        table = tmp_path / "log.csv"
        table.write_text("\n".join(["time,agent,x,y,z", *first, *rows[3:]]) + "\n")
        assert read_trajectories(table, spans="stand").names == ("1", "2", "10")


def test_help_names_every_kind_of_file_that_is_read(capsys):
    """Each suffix by which a file of a folder is read stands in the help of `assess`."""
    assert main(["assess", "--help"]) == PASSED
    words = capsys.readouterr().out.replace("CSV", ".csv")
    assert all(suffix in words for suffix in (*SUFFIXES, ".bin") if suffix != ".zstd")  # packed
