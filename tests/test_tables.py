"""Tables as people write them: what a column means is read, refused with its cause, or noted, by both doors."""

import gzip
import json
import struct

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.cli.app import BAD_INPUT, FAILED, PASSED, main
from rigidfleet.foreign.columns import Doubt
from rigidfleet.foreign.files import read_trajectories
from rigidfleet.formation.point_files import read_points

TIMES = (0.0, 0.5, 1.0, 1.5, 2.0)
HEAD = "time,agent,x,y,z\n"


def place(t, i):
    """The place of vehicle i [m]: each flies at 1 m/s along x, 3.04 m from the next."""
    return (t + 0.25, 3.0 * i + 1.5, 2.0 + 0.5 * i)


def lines(row, vehicles=2, by_vehicle=False):
    """A row for each time and vehicle."""
    pairs = [(t, i) for t in TIMES for i in range(vehicles)]
    pairs = sorted(pairs, key=lambda x: x[1]) if by_vehicle else pairs
    return "".join(row(t, i, *place(t, i)) + "\n" for t, i in pairs)


def plain(t, i, x, y, z):
    return f"{t},{i},{x},{y},{z}"


def milli(t, i, x, y, z):
    return f"{1e3 * t},{i},{1e3 * x},{1e3 * y},{1e3 * z}"


def alone(row):
    """Rows of one vehicle."""
    return lines(row, 1)


def parted(separator, mark=".", head="time agent x y z"):
    """The table with another separator and decimal mark."""
    row = lambda t, i, x, y, z: separator.join(map(str, (t, i, x, y, z))).replace(".", mark)  # noqa: E731
    return separator.join(head.split()) + "\n" + lines(row)


def dated(clock):
    """The table with times as a function writes them."""
    return HEAD + lines(lambda t, i, x, y, z: f"{clock(t)},{i},{x},{y},{z}")


NAMES = [
    "agent", "id", "drone", "vehicle", "name", "uav", "robot", "cf", "body", "rigid_body", "track", "object", "marker",
    "label", "uid", "sysid", "ns", "frame_id", "child_frame_id", "callsign", "drone_id", "VehicleName", "uav_no",
]  # fmt: skip
SAME = {
    **{f"named by {w}": f"time,{w},x,y,z\n{lines(plain)}" for w in NAMES},
    **{
        f"named last by {w}": f"time,x,y,z,{w}\n"
        + lines(lambda t, i, x, y, z: f"{t},{x},{y},{z},a{i}", by_vehicle=True)
        for w in NAMES
    },
    "numbered rows": "seq,time,id,x,y,z\n"
    + "".join(f"{k},{row}\n" for k, row in enumerate(lines(plain).splitlines())),
    "numbered messages": "id,time,agent,x,y,z\n"
    + "".join(f"{k},{row}\n" for k, row in enumerate(lines(plain).splitlines())),
    "numbered times": "time,agent,frame,x,y,z\n"
    + lines(lambda t, i, x, y, z: f"{t},{i},{int(2 * t)},{x},{y},{z}"),
    "a heading": "time,agent,heading (deg),x,y,z\n"
    + lines(lambda t, i, x, y, z: f"{t},{i},{10 * t},{x},{y},{z}"),
    "a battery": "time,agent,battery,x,y,z\n"
    + lines(lambda t, i, x, y, z: f"{t},{i},{16 - t},{x},{y},{z}"),
    "a last column without a name": HEAD.strip() + ",\n" + lines(lambda *v: plain(*v) + ",7"),
    "units beside columns that are not read": "time_s,agent,x_m,y_m,z_m,n,x_raw,y_std\n"
    + lines(lambda *v: plain(*v) + f",7,{v[2]},1"),
    "two frames": "time,frame_id,child_frame_id,x,y,z\n"
    + lines(lambda t, i, x, y, z: f"{t},map,cf{i},{x},{y},{z}"),
    "wide": "t,x1,y1,z1,x2,y2,z2\n" + alone(lambda t, i, x, y, z: f"{t},{x},{y},{z},{x},4.5,2.5"),
    "wide with words": "t,cf1_x,cf1_y,cf1_z,cf2_x,cf2_y,cf2_z\n"
    + alone(lambda t, i, x, y, z: f"{t},{x},{y},{z},{x},4.5,2.5"),
    **{f"by {s!r}": parted(s) for s in (";", "\t", " ", "   ", ", ", " ; ")},
    **{f"decimal commas by {s!r}": parted(s, ",") for s in (";", "\t", " ", " ; ")},
    "quoted decimal commas": HEAD
    + lines(lambda *v: ",".join('"' + str(x).replace(".", ",") + '"' for x in v)),
    **{
        f"after {before!r}": before + HEAD + lines(plain)
        for before in (
            "# a comment\n",
            "\n\n",
            "# planner 3.2, 2024\n\n# x y z in metres\n",
            "robot,one\nframe,cog\n",
            "% by hand\n",
            "Experiment: hall 3\nOperator;Jane\n\n",
        )
    },
    "savetxt": "# " + HEAD + lines(plain),
    "savetxt, blanks": "# time agent x y z\n" + lines(plain),
    "EuRoC": "#timestamp [ns],id,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]\n"
    + lines(lambda t, i, x, y, z: f"{1403636580838555648 + int(1e9 * t)},{i},{x},{y},{z}"),
    "comments among rows": HEAD + lines(plain).replace("1.0,0", "# half, way\n# of it\n1.0,0"),
    "remarks": HEAD + lines(lambda *v: plain(*v) + "  # row"),
    "ends with commas": HEAD.strip() + ",\n" + lines(lambda *v: plain(*v) + ","),
    "# in names": "agent,time,x,y,z\n" + lines(lambda t, i, x, y, z: f"#{i},{t},{x},{y},{z}"),
    "# in some names": "agent,time,x,y,z\n"
    + lines(lambda t, i, x, y, z: f"{'#' if i else ''}{i},{t},{x},{y},{z}"),
    "# within names": HEAD + lines(lambda t, i, x, y, z: f"{t},cf #{i},{x},{y},{z}"),
    "# within last names": "time,x,y,z,agent\n"
    + lines(lambda t, i, x, y, z: f"{t},{x},{y},{z},cf #{i}"),
    "colours": "color,time,agent,x,y,z\n" + lines(lambda *v: f"#ff000{v[1]}," + plain(*v)),
    "a row of units": HEAD + "ms,-,mm,mm,mm\n" + lines(milli),
    "a row of units in brackets, blanks": "t agent x y z\n[ms] [-] [mm] [mm] [mm]\n"
    + lines(lambda *v: milli(*v).replace(",", " ")),
    "a row of units in brackets": HEAD + "[s],,[m],[m],[m]\n" + lines(plain),
    **{
        f"names {head}": f"{head}\n{lines(milli)}"
        for head in (
            "time_ms,agent,x_mm,y_mm,z_mm",
            "time [ms],agent,x [mm],y [mm],z [mm]",
            "Time (Milliseconds),Agent,X (Millimeters),Y (millimetres),Z (MM)",
            "timeMs,agent,posX_mm,posY_mm,posZ_mm",
            "ms,agent,x mm,y mm,z mm",
            "time in ms,agent,x in mm,y in mm,z in mm",
            "time/ms,agent,x/mm,y/mm,z/mm",
            'time_boot_ms,agent,"x, mm","y, mm","z, mm"',
            "milliseconds,agent,x-mm,y.mm,z{mm}",
            "t_ms,agent,mm_x,mm_y,mm_z",
            "time.ms,agent,pos.x.mm,pos.y.mm,pos.z.mm",
        )
    },
    "decimetres": "t,agent,x_dm,y_dm,z_dm\n"
    + lines(lambda t, i, x, y, z: f"{t},{i},{10 * x},{10 * y},{10 * z}"),
    "inches": "t,agent,x [in],y [in],z [in]\n"
    + lines(lambda t, i, *place: ",".join(map(str, (t, i, *(x / 0.0254 for x in place))))),
    "units between axes and vehicles": "t,x1 mm,y1 mm,z1 mm,x_mm_cf2,y_mm_cf2,z_mm_cf2\n"
    + alone(lambda t, i, x, y, z: f"{t},{1e3 * x},{1e3 * y},{1e3 * z},{1e3 * x},4500,2500"),
    "names with numbers": "t,UAV 1 X,UAV 1 Y,UAV 1 Z,UAV 2 X,UAV 2 Y,UAV 2 Z\n"
    + alone(lambda t, i, x, y, z: f"{t},{x},{y},{z},{x},4.5,2.5"),
    "a preamble with numbers": "Version,1.23,Rate,10.0,Frames,21,Space,Global\n\n,ID,1,1,1\n"
    "Frame,agent,Time (Seconds),X,Y,Z,\n"
    + lines(lambda t, i, x, y, z: f"{int(2 * t)},{i},{t},{x},{y},{z},"),
    "names behind !": "! t agent x y z\n" + parted(" ").split("\n", 1)[1],
    "names behind //": "// t agent x y z\n" + parted(" ").split("\n", 1)[1],
    **{
        f"names {head}": f"{head}\n{lines(plain)}"
        for head in (
            "t,id,px,py,pz",
            "header.stamp,drone,pose.position.x,pose.position.y,pose.position.z",
            "stamp,robot,position_x,position_y,position_z",
            "secs,uav,tx,ty,tz",
            "t,agent,east,north,up",
            "t,agent,e,n,u",
            "t,agent,easting,northing,elevation",
            "t,agent,x,y,altitude",
            "t,agent,pos_e,pos_n,pos_u",
        )
    },
    **{
        head: f"time,agent,{head}\n" + lines(lambda t, i, x, y, z: f"{t},{i},{y},{x},{-z}")
        for head in (
            "north,east,down",
            "x_ned,y_ned,z_ned",
            "ned_x,ned_y,ned_z",
            "pos_ned_x,pos_ned_y,pos_ned_z",
            "local_ned.x,local_ned.y,local_ned.z",
            "x (NED),y (NED),z (NED)",
            "x_ned [m],y_ned [m],z_ned [m]",
            "pos_n,pos_e,pos_d",
            "x_north,y_east,z_down",
            "posN_m,posE_m,posD_m",
        )
    },
    **{
        head: f"time,agent,{head}\n" + lines(plain)
        for head in ("x_enu,y_enu,z_enu", "flu_x,flu_y,flu_z", "x (ENU),y (ENU),z (ENU)")
    },
    "seconds since 1970": dated(lambda t: f"{1.7e9 + t:.6f}"),
    "dates": dated(lambda t: f"2024-05-01T12:00:{int(t):02d}.{int(t % 1 * 1000):03d}Z"),
    "dates with a blank": dated(lambda t: f"2024-05-01 23:59:{int(t) + 50}.{int(t % 1 * 1e6):06d}"),
    "dates with their zone among the names": "Time (UTC+2),agent,x (world),y (world),z (world)\n"
    + dated(lambda t: f"2024-05-01T12:00:0{t:.3f}").split("\n", 1)[1],
    "dates with a zone": dated(
        lambda t: f"2024-05-01T12:00:{int(t):02d}.{int(t % 1 * 1e9):09d}+02:00"
    ),
    "CR": (HEAD + lines(plain)).replace("\n", "\r"),
    "CRLF": (HEAD + lines(plain)).replace("\n", "\r\n"),
    "minus signs of print": "time,agent,x,y,z,yaw\n"
    + lines(lambda *v: f"{plain(*v)},\N{MINUS SIGN}{v[0]}"),
    "a duration": HEAD.strip() + ",duration\n" + lines(lambda *v: plain(*v) + ",0.5"),
    "a column as pandas repeats it": "time,agent,x,y,z,x.1\n"
    + lines(lambda *v: f"{plain(*v)},{v[2]}"),
    "a column twice": "time,agent,x,x,y,z\n"
    + lines(lambda t, i, x, y, z: f"{t},{i},{x},{x},{y},{z}"),
}


def others(read):
    """Notes but the one on units that nobody says."""
    return [note for note in read.notes if not note.startswith("no unit is said: ")]


def judged_as_meant(read, vehicles=2):
    """Whether the vehicles are where the table's maker meant them to be, in continuous time."""
    t = np.array([0.0, 0.7, 1.3, 2.0])
    assert len(read.curves) == vehicles
    for i, curve in enumerate(read.curves):
        np.testing.assert_allclose(curve.at(t)[:, :3], [place(x, i) for x in t.tolist()], atol=1e-7)


@pytest.mark.parametrize(
    ("names", "k", "fields"),
    [
        ("t_ms,x,y,z", 0, "0 33.333 66.667 100 133.333 166.667 200"),
        ("t,x,y,z,yaw_deg", 4, "0 51.429 102.857 154.286 205.714 257.143 308.571 360"),
        ("t,x_ft,y_ft,z_ft", 1, "10 13.123 16.404"),
        ("t,x_mm,y_mm,z_mm", 1, "10 13.123 16.404"),
    ],
)
def test_decimals_beside_whole_numbers_are_decimals(names, k, fields, tmp_path):
    """Of a column that leaps less with its points as decimals, these are no marks between thousands."""
    rows = []
    for i, field in enumerate(fields.split()):
        row = [str(i), "1", "1", "1", "1"][: names.count(",") + 1]
        row[k] = field
        rows.append(",".join(row))
    path = tmp_path / "a.csv"
    path.write_text("\n".join([names, *rows]))
    read_trajectories(path)


@pytest.mark.parametrize("kind", SAME)
def test_tables_are_read_as_meant(kind, tmp_path):
    """Names, units, separators, comments, dates: all give the same two vehicles, and no doubt."""
    path = tmp_path / "t.csv"
    path.write_bytes(SAME[kind].encode())
    read = read_trajectories(path)
    judged_as_meant(read)
    assert others(read) == []


def test_utf_16_is_read(tmp_path):
    """What a spreadsheet calls Unicode text."""
    (tmp_path / "t.csv").write_text(HEAD + lines(plain), encoding="utf-16")
    judged_as_meant(read_trajectories(tmp_path / "t.csv"))


WIDE = [
    "t,x_a,y_a,z_a,x_b,y_b,z_b",
    "t,a.x,a.y,a.z,b.x,b.y,b.z",
    "t,xa,ya,za,xb,yb,zb",
    "t,x_v,y_v,z_v,x_cf1,y_cf1,z_cf1",
    "t,x_w1,y_w1,z_w1,x_q2,y_q2,z_q2,x_cf3,y_cf3,z_cf3",
    "t,x_r,y_r,z_r,x_alpha,y_alpha,z_alpha",
    "t,x_t [m],y_t [m],z_t [m],x_u [m],y_u [m],z_u [m]",
    "t,a_x_m,a_y_m,a_z_m,c_x_m,c_y_m,c_z_m",
    "t,pos_x_a,pos_y_a,pos_z_a,pos_x_d,pos_y_d,pos_z_d",
    "t,p_x,p_y,p_z,q_x,q_y,q_z",
    "t,x,y,z,x_b,y_b,z_b",
    "t,x,y,z,a_x,a_y,a_z",
    "t,x,y,z,bx,by,bz",
    "t,x_max,y_max,z_max,x_anna,y_anna,z_anna",
    "t,x_p,y_p,z_p,x_v,y_v,z_v",
]


@pytest.mark.parametrize("head", WIDE)
def test_vehicles_beside_each_other_are_not_lost(head, tmp_path, capsys):
    """Two that are 3.04 m apart fail at 4 m whatever letter is the name of one, or a note names its columns."""
    (tmp_path / "t.csv").write_text(
        head
        + "\n"
        + alone(
            lambda t, i, x, y, z: f"{t},{x},{y},{z},{x},4.5,2.5" + f",{x},7.5,3" * ("cf3" in head)
        )
    )
    code = main(["assess", str(tmp_path / "t.csv"), "--json"])
    notes = " ".join(json.loads(capsys.readouterr().out)["notes"])
    read = read_trajectories(tmp_path / "t.csv")
    if len(read.curves) > 1:
        judged_as_meant(read, len(read.curves))
        assert main(["assess", str(tmp_path / "t.csv"), "--separation", "4"]) == FAILED
    else:
        assert code == PASSED
        assert "are not read" in notes or "velocities of the table are up to" in notes


NOTED = {
    **{
        f"named by {w}": (f"time,{w},x,y,z\n{lines(plain)}", f"'{w}' is taken for names")
        for w in ("who", "pilot", "channel")
    },
    "milliseconds since 1970": (
        dated(lambda t: 1700000000000 + int(1e3 * t)),
        "read as ms since 1970",
    ),
    "nanoseconds since 1970": (
        dated(lambda t: 1403636580838555648 + int(1e9 * t)),
        "read as ns since 1970",
    ),
    "a flag": (
        HEAD.strip() + ",valid\n" + lines(lambda *v: f"{plain(*v)},{int(v[0] < 1.0)}"),
        "rows count whatever it says",
    ),
    "units before the names": ("# units: mm\n" + HEAD + lines(plain), "does it say units"),
    "units in words": ("# position in millimetres\n" + HEAD + lines(plain), "does it say units"),
    "units below the names": (HEAD + "# all in cm\n" + lines(plain), "does it say units"),
    "units at the end": (HEAD + lines(plain) + "# scale 0.001\n", "does it say units"),
    **{
        f"beside {line!r}": (f"{line}\n{HEAD}{lines(plain)}", "does it say units or axes")
        for line in (
            "# Y-up",
            "# Up axis: Y",
            "# frame: NWU",
            "# x=north y=east z=up",
            "# left-handed",
            "# positions in km",
            "# t [msec]",
            "# times in frames",
            "# fps: 25",
        )
    },
    **{
        f"no place: {word}": (
            HEAD + lines(plain) + f"2.5,0,{word},{word},{word}\n2.5,1,{word},1,1\n",
            "2 rows without a position are left out",
        )
        for word in ("NA", "null", "None", "#N/A", "-nan(ind)", "-nan", "-", "<NA>")
    },
    "a word that nobody knows": (
        f"time,agent,x_foo,y_foo,z_foo\n{lines(plain)}",
        "are read as places of a vehicle 'foo'",
    ),
    "places by directions, too": (
        HEAD.strip() + ",north,east,down\n" + lines(lambda *v: plain(*v) + ",9,9,9"),
        "north, east, down are not read: x, y and z count",
    ),
    "wanted places": (
        HEAD.strip() + ",x_ref,y_ref,z_ref\n" + lines(lambda *v: plain(*v) + ",0,0,0"),
        "x_ref, y_ref, z_ref are not read",
    ),
}


@pytest.mark.parametrize("kind", NOTED)
def test_guesses_are_noted(kind, tmp_path):
    """What is understood by its data alone, or left out though it may mean something, is said."""
    text, note = NOTED[kind]
    (tmp_path / "t.csv").write_text(text)
    read = read_trajectories(tmp_path / "t.csv")
    judged_as_meant(read)
    assert any(note in told for told in read.notes)


def test_vehicles_that_take_turns_are_told_apart(tmp_path):
    """Rows whose times all increase are of two vehicles, where a column makes their ways short."""
    row = lambda t, i, x, y, z: f"{t + 0.01 * i},{'ab'[i]},{x + 0.01 * i},{y},{z}"  # noqa: E731
    (tmp_path / "t.csv").write_text("time,pilot,x,y,z\n" + lines(row))
    read = read_trajectories(tmp_path / "t.csv")
    assert read.names == ("a", "b")
    assert any("'pilot' is taken" in note for note in read.notes)
    row = lambda t, i, x, y, z: f"{t + 0.01 * i},{x + 0.01 * i},{y},{z}"  # noqa: E731
    (tmp_path / "t.csv").write_text("time,x,y,z\n" + lines(row))
    with pytest.raises(rf.RigidfleetError, match="as if 2 vehicles took turns"):
        read_trajectories(tmp_path / "t.csv", gaps="bridge")


REFUSED = {
    "names that nobody knows": (
        "elapsed,who,xcoord,ycoord,zcoord\n" + lines(lambda t, i, *r: f"{t},a{i},{r[0]},0,5"),
        "no names of columns that are understood: elapsed,who,xcoord",
    ),
    "no names": (
        lines(lambda t, i, x, y, z: f"{t},a{i},{x},{y},{z}"),
        "has no names of columns that are understood",
    ),
    "rows out of order, with yaws": (
        "t,x,y,z,yaw_deg\n0,0,0,1,0\n2,2,0,1,400\n1,1,0,1,200\n",
        "goes back behind",
    ),
    "vehicles that take turns, with yaws": (
        "t,x,y,z,yaw_deg\n"
        + "".join(f"{k / 10},{k % 2 * 9},{k / 10},5,{k % 2 * 200 + 9 * k}\n" for k in range(60)),
        "as if 2 vehicles took turns",
    ),
    "vehicles that follow each other": (
        "t,name,x,y,z\n"
        + "".join(
            f"{k / 10 + (k > 29)},{'ab'[k > 29]},{k / 10 + 9 * (k > 29)},0,5\n" for k in range(60)
        ),
        "'a' has samples from 0 to 2.9 s, and others",
    ),
    "nobody": ("time,x,y,z\n" + lines(lambda t, i, x, y, z: f"{t},{x},{y},{z}"), "has two places"),
    "teams": (
        "time,team,x,y,z\n" + lines(lambda t, i, x, y, z: f"{t},{i % 2},{x},{y},{z}", 4),
        "has two places",
    ),
    "another vehicle": (
        "t,x,y,z,x2,y2,z2\n0,0,0,1,0,1,1\n1,1,0,1,1,1,1\n",
        "x2, y2, z2 may be places of another vehicle",
    ),
    "a bone of two": (
        "t,X,Y,Z,X,Y,Z\n0,0,0,1,0,1,1\n1,1,0,1,1,1,1\n",
        "or name those of several vehicles x1, y1, z1",
    ),
    "rows before the names": (
        "0,0,0,1\nt,x,y,z\n1,1,0,1\n2,2,0,1\n",
        "line 1: has a row before its",
    ),
    "TUM between commas": (
        "".join(f"{t},{t},0,1,1,0,0,0\n" for t in range(3)),
        "no 8 numbers between blanks",
    ),
    "polynomials of two": (
        "id,duration,"
        + ",".join(f"{a}^{k}" for a in ("x", "y", "z", "yaw") for k in range(8))
        + "".join(f"\n{i},1" + ",1" * 32 for i in ("a", "b"))
        + "\n",
        "polynomials of several vehicles in the column 'id'",
    ),
    "a log on the globe": (
        "t,OSD.latitude,OSD.longitude,OSD.height [ft]\n0,47.4,8.5,48\n1,47.4,8.5,49\n",
        "has latitude and longitude",
    ),
    "two that differ": ("t,x,x,y,z\n0,0,1,0,1\n1,1,2,0,1\n", "two columns for x"),
    "commas for all": (parted(",", ","), "fields, and the names in line 1 are 5"),
    "thousands": (
        "time;x;y;z\n0;1,500;1,000;2,000\n1;2,500;1,000;2,000\n",
        "Write decimals with a point",
    ),
    "thousands and decimals": (
        'time,x,y,z\n0,"1,000.5",1,2\n1,"1,001.5",1,2\n',
        "no marks between thousands",
    ),
    "both marks": ("time;x;y;z\n0;1,5;1;2.5\n1;2,5;1;2.5\n", "Write decimals with a point"),
    "units contradict": (
        "time_s,x,y,z\nms,mm,mm,mm\n0,0,0,1\n1,1,0,1\n",
        "is in 's', but also in 'ms'",
    ),
    "some units": ("time_s,x_mm,y,z\n0,0,0,1\n1,1,0,1\n", "units for some columns of length only"),
    "no length": ("time_s,x [kg],y,z\n0,0,0,1\n1,1,0,1\n", "unknown unit 'kg'"),
    "the globe": (
        "time,lat,lon,alt\n0,47.4,8.5,480\n1,47.4,8.5,481\n",
        "has latitude and longitude",
    ),
    "a quotation mark": (
        'time,agent,x,y,z\n0,"a,0,0,0\n1,"b,0,0,0\n',
        "a quotation mark is not closed",
    ),
    "no date": (
        dated(lambda t: f"2024-13-01T12:00:0{int(t)}Z"),
        "neither a finite number nor a date",
    ),
    "millimetres without a word": (
        HEAD + lines(lambda t, i, x, y, z: f"{t},{i},{1e3 * x},{1e3 * y},{1e3 * z}"),
        "no unit is said: times as s, places as m, so that speeds reach",
    ),
    "the truth beside an estimate": (
        "t,x_true,y_true,z_true,x_est,y_est,z_est\n0,0,0,1,0.1,0,1\n1,1,0,1,1.1,0,1\n",
        "several places of one vehicle: true, est",
    ),
    "a vehicle without heights": (
        "t,x1,y1,x2,y2,z2\n0,0,0,0,3,1\n1,1,0,1,3,1\n",
        "x1, y1 may be places of another vehicle",
    ),
    "half turns": (
        "t,x,y,z,yaw_deg\n0,0,0,1,0\n1,0,0,1,200\n2,0,0,1,400\n",
        "line 3: the yaw changes by 200 deg, more than half a turn: which way? Give",
    ),
    "two instruments": (
        "t,gps_x,gps_y,gps_z,ekf_x,ekf_y,ekf_z\n0,0,0,1,0.1,0,1\n1,1,0,1,1.1,0,1\n",
        "several places of one vehicle: gps, ekf",
    ),
    "thousands by points": (
        "time_ms;x_mm;y_mm;z_mm\n0;750;0;2.000\n1.000;1.750;0;2.000\n",
        "x_mm is 1.750, and others have no decimals: are these thousands",
    ),
    "a vehicle in the place of another": (
        "t,x,y,z,x.1,y.1,z.1\n0,0,0,1,0,0,1\n1,1,0,1,1,0,1\n",
        "x.1, y.1, z.1 may be places of another vehicle",
    ),
    "no heights": ("t,name,x,y,z\n0,a,0,0,\n0,b,3,0,\n1,a,1,0,\n1,b,4,0,\n", "has no position"),
    "polynomials of degree 8": (
        "duration,"
        + ",".join(f"{a}^{k}" for a in ("x", "y", "z", "yaw") for k in range(9))
        + "\n1"
        + ",1" * 36
        + "\n",
        "has the column x^8",
    ),
    "polynomials in millimetres": (
        "duration,"
        + ",".join(f"{a}^{k}" for a in ("x", "y", "z", "yaw") for k in range(8)).replace(
            "x^0", "x^0 [mm]"
        )
        + "\n1"
        + ",1" * 32
        + "\n",
        "has the column x^0 [mm]",
    ),
    "JSON": ('{"t": [0, 1], "x": [0, 1], "y": [0, 0], "z": [1, 1]}\n', "is JSON, and no table"),
    "two nameless columns": (
        "time,pilot,slot,x,y,z\n"
        + lines(lambda t, i, x, y, z: f"{t},{i},{(i + int(2 * t)) % 2},{x},{y},{z}"),
        "the columns pilot, slot may name vehicles",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_tables_that_may_mean_two_things_are_refused(kind, tmp_path, capsys):
    """With the true cause, and no verdict."""
    text, cause = REFUSED[kind]
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(rf.RigidfleetError) as caught:
        read_trajectories(tmp_path / "t.csv")
    assert cause in str(caught.value)
    assert main(["assess", str(tmp_path / "t.csv")]) == BAD_INPUT
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEAD + lines(milli), {"units": "ms,mm,deg"}),
        (HEAD + lines(milli), {"units": "mm ms"}),
        (HEAD + lines(lambda t, i, x, y, z: f"{t},{i},{y},{x},{-z}"), {"axes": "ned"}),
        (HEAD + lines(lambda t, i, x, y, z: f"{t},{i},{x},{z},{-y}"), {"axes": "eus"}),
        (dated(lambda t: 1403636580838555648 + int(1e9 * t)), {"units": "ns"}),
        ("time_s,agent,x_m,y_m,z_m\n" + lines(plain), {"units": "s,m"}),
    ],
)
def test_what_a_user_says_of_units_and_axes(text, said, tmp_path):
    """It counts where the file says nothing, and settles all doubt."""
    (tmp_path / "t.csv").write_text(text)
    read = read_trajectories(tmp_path / "t.csv", **said)
    judged_as_meant(read)
    assert others(read) == []


@pytest.mark.parametrize(
    ("said", "cause"),
    [
        ({"units": "ms"}, "is in 's', but also in 'ms'"),
        ({"units": "furlong"}, "'furlong': give one unit each"),
        ({"units": "ms,s"}, "'s': give one unit each"),
        ({"axes": "north"}, "say where x, y and z point"),
        ({"axes": "enn"}, "say where x, y and z point"),
    ],
)
def test_words_that_contradict_are_refused(said, cause, tmp_path):
    """A user's word neither overrides the file's nor is guessed at."""
    (tmp_path / "t.csv").write_text("time_s,agent,x,y,z\n" + lines(plain))
    with pytest.raises(rf.RigidfleetError, match=cause):
        read_trajectories(tmp_path / "t.csv", **said)


@pytest.mark.parametrize(
    ("step", "way", "note"),
    [
        (20, 0.1, "0.005"),
        (100, 1.0, "0.01"),
        (33.333, 0.1, "0.003"),
        (1000, 5, "0.005"),
        (10000, 5, "0.0005"),
        (1, 0.003, "0.003"),
        (1, 0.3, ""),
        (0.1, 0.001, ""),
        (1, 15, ""),
        (1, 50, ""),
    ],
)
def test_units_are_in_doubt_where_nothing_moves(step, way, note, tmp_path):
    """What was taken is said, and speeds far below those of vehicles are in doubt; what is usual is not."""
    rows = "".join(f"{step * k},{way * k},0,5\n" for k in range(60))
    (tmp_path / "t.csv").write_text("time,x,y,z\n" + rows)
    (said,) = read_trajectories(tmp_path / "t.csv").notes
    assert said.startswith("no unit is said: times as s, places as m")
    assert isinstance(said, Doubt) == bool(note)
    assert (f"so that speeds reach {note} m/s" in said) == bool(note)


UNSAID = {
    "time,x,y,z": "no unit is said: times as s, places as m",
    "time_s,x,y,z": "no unit is said: places as m",
    "time,x_m,y_m,z_m": "no unit is said: times as s",
    "time_s,x_m,y_m,z_m": "",
    "time_s,x_m,y_m,z_m,yaw": "no unit is said: yaws as rad",
    "time_s,x_m,y_m,z_m,yaw_rad,n,x_raw": "",
}


@pytest.mark.parametrize("head", UNSAID)
def test_units_that_nobody_says_are_noted(head, tmp_path, capsys):
    """Beside "passed", in the terminal and in JSON: a flight in feet is not judged in metres in silence."""
    width = head.count(",") + 1
    (tmp_path / "t.csv").write_text(
        head + "\n" + "".join(",".join([f"{0.1 * k:.1f}"] * width) + "\n" for k in range(40))
    )
    assert main(["assess", str(tmp_path / "t.csv")]) == PASSED
    out = " ".join(capsys.readouterr().out.split())
    assert f"Note: {UNSAID[head]}." in out if UNSAID[head] else "no unit" not in out
    assert main(["assess", str(tmp_path / "t.csv"), "--json"]) == PASSED
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert (UNSAID[head] in notes) if UNSAID[head] else not any("no unit" in x for x in notes)


def test_heights_below_the_ground_ask_where_z_points(tmp_path, capsys):
    """North, east, down without a word: a question beside the verdict, and with the word 10 m above ground."""
    rows = "".join(f"{t},0,0,{-min(10, 2 * t)},70\n" for t in range(10))
    (tmp_path / "t.csv").write_text("t,px,py,pz,yaw\n" + rows)
    assert main(["assess", str(tmp_path / "t.csv"), "--ground", "-0.1"]) == FAILED
    assert "does z point down? Say --axes ned" in " ".join(capsys.readouterr().out.split())
    path = str(tmp_path / "t.csv")
    assert main(["assess", path, "--ground", "-0.1", "--axes", "ned", "--units", "deg"]) == PASSED
    (curve,) = read_trajectories(path, axes="ned", units="deg").curves
    assert curve.at(np.array([9.0]))[0, 2] == pytest.approx(10.0)
    assert np.degrees(curve.at(np.array([0.0]))[0, 3]) == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("head", "yaws", "degrees"),
    [
        ("yaw", "0 10 20 30 40 50 60 70 80 90", None),
        ("yaw", "90 90 90", None),
        ("yaw", "0 2.5 5 7.5 10", None),
        ("yaw_deg", "0 10 20 30", [0, 10, 20, 30]),
        ("yaw", "0 0.5 1 1.5", np.degrees([0, 0.5, 1, 1.5])),
        ("yaw_rad", "0 2.5 5 7.5 10", np.degrees([0, 2.5, 5, 7.5, 10])),
        ("yaw_deg", "170 -170 -150", [170, 190, 210]),
        ("yaw_deg", "350 10 30", [350, 370, 390]),
        ("qx,qy,qz,qw", "0,0,0,1 0,0,1,0 0,0,0,-1", [0, 180, 360]),
    ],
)
def test_yaws_without_a_unit_are_not_guessed(head, yaws, degrees, tmp_path):
    """Numbers that may be degrees are not read, and a note says so; others turn the nearer way."""
    rows = "".join(f"{k},0,0,5,{yaw}\n" for k, yaw in enumerate(yaws.split()))
    (tmp_path / "t.csv").write_text(f"t,x,y,z,{head}\n{rows}")
    read = read_trajectories(tmp_path / "t.csv")
    found = read.curves[0].at(np.arange(len(yaws.split()), dtype=float))[:, 3]
    if degrees is None:
        assert np.isnan(found).all()
        assert "may be degrees or radians" in read.notes[0]
    else:
        turned = np.abs((np.degrees(found) - degrees + 180) % 360 - 180)
        np.testing.assert_allclose(turned, 0.0, atol=1e-9)


def test_a_trajectory_without_names_is_tum(tmp_path):
    """Eight numbers between blanks are stamp, place and quaternion, as TUM writes them; other shapes are refused."""
    row = "{} {} 1.5 2 0 0 0 1\n"
    rows = "".join(row.format(1520000000.0 + t, t + 0.25) for t in TIMES)
    for head in ("", "# timestamp tx ty tz qx qy qz qw\n"):
        (tmp_path / "t.txt").write_text(head + rows)
        read = read_trajectories(tmp_path / "t.txt")
        judged_as_meant(read, 1)
        assert len(others(read)) == (not head)
    for other in (" 0 0 0 2", ""):
        (tmp_path / "t.txt").write_text(rows.replace(" 0 0 0 1", other))
        with pytest.raises(rf.RigidfleetError, match="no names of columns"):
            read_trajectories(tmp_path / "t.txt")


def test_attitudes_in_another_order_are_not_read(tmp_path):
    """Quaternions that begin with w would turn a level vehicle upside down: its yaw is not taken from them."""
    rows = "".join(f"{t} {t} 0 2 0.99 0 0 0.141\n" for t in range(4))
    (tmp_path / "t.txt").write_text(rows)
    read = read_trajectories(tmp_path / "t.txt")
    assert any("upside down" in note for note in read.notes)
    assert np.isnan(read.curves[0].at(np.array([1.0]))[0, 3])


def test_files_have_one_clock(tmp_path):
    """Files that count from dates begin together only if they did; one without dates beside them is refused."""
    for name, start in (("a", 1.7e9), ("b", 1.7e9 + 0.5)):
        rows = "".join(f"{start + t:.3f},{t},{ord(name)},2\n" for t in TIMES)
        (tmp_path / f"{name}.csv").write_text("time,x,y,z\n" + rows)
    first, second = (read_trajectories(tmp_path / f"{name}.csv").curves[0] for name in "ab")
    assert first.time[0] == second.time[0] == 0.0
    both = read_trajectories([tmp_path / "a.csv", tmp_path / "b.csv"])
    t = np.array([1.0])
    assert both.curves[1].at(t)[0, 0] == pytest.approx(both.curves[0].at(t)[0, 0] - 0.5)
    (tmp_path / "b.csv").write_text("time,x,y,z\n0,0,0,1\n2,2,0,1\n")
    with pytest.raises(rf.RigidfleetError, match="Give all files one clock"):
        read_trajectories([tmp_path / "a.csv", tmp_path / "b.csv"])


def test_a_vehicle_whose_name_begins_with_a_hash_collides(tmp_path, capsys):
    """Two vehicles 0.05 m apart fail, whatever their names."""
    (tmp_path / "t.csv").write_text(
        "agent,t,x,y,z\n#1,0,0,0,5\n#1,1,1,0,5\n2,0,0,0.05,5\n2,1,1,0.05,5\n"
    )
    assert main(["assess", str(tmp_path / "t.csv"), "--separation", "0.3", "--json"]) == FAILED
    (check,) = (
        c for c in json.loads(capsys.readouterr().out)["checks"] if c["check"] == "separation"
    )
    assert check["worst"] == pytest.approx(0.05)


def test_the_verdict_says_what_was_read(tmp_path, capsys):
    """`--explain` and the JSON name vehicles, span, columns used and ignored, units and axes."""
    (tmp_path / "t.csv").write_text(
        "time_s,uav,x,y,z,battery\n" + lines(lambda *v: plain(*v) + ",9")
    )
    path = str(tmp_path / "t.csv")
    assert main(["assess", path, "--explain"]) == PASSED
    said = capsys.readouterr().out
    for words in (
        "vehicles: 2",
        "end s: 2.0",
        "rate hz: 2.0",
        "ignored: battery",
        "time s (the file)",
        "enu (assumed)",
    ):
        assert words in said
    assert main(["assess", path, "--json", "--axes", "enu"]) == PASSED
    (read,) = json.loads(capsys.readouterr().out)["read"]
    assert (read["vehicles"], read["rows"], read["vehicles_by"]) == (2, 10, ["uav"])
    assert read["axes"] == "enu (the option)"
    wide = "time_s,x1,y1,z1,x2,y2,z2\n" + "".join(f"{k},{k},0,5,{k},4,5\n" for k in range(4))
    (tmp_path / "wide.csv").write_text(wide)
    assert read_trajectories(tmp_path / "wide.csv").read[0]["rate_hz"] == 1.0  # 4 rows of 3 s


# -- the same in a mission ----------------------------------------------------------------------------

MISSION = """
schema_version = 1
name = "m"
smoothness = "jerk"
[agents]
mass = 1.0
position = [[0, 0, 5], [3, 0, 5], [0, 3, 5]]
[formations.t]
slots = [[0, 0, 0], [3, 0, 0], [0, 3, 0]]
[[phases]]
kind = "establish"
formation = "t"
duration = 5.0
[[phases]]
kind = "follow"
file = "t.csv"
"""
SCALED = "time,x,y,z\n" + "".join(f"{100 * k},{100 * k},0,5000\n" for k in range(20))


def test_follow_reads_as_assess_does(tmp_path):
    """Both doors read one table alike, with the same words for units and axes; a mission does not fly a doubt."""
    (tmp_path / "t.csv").write_text(SCALED)
    mission = tmp_path / "m.toml"
    mission.write_text(MISSION + 'units = "ms,mm"\naxes = "enu"\n')
    (rows,) = rf.load_mission(mission).to_dict()["phases"][1]["trajectories"]
    (curve,) = read_trajectories(tmp_path / "t.csv", units="ms,mm").curves
    np.testing.assert_allclose([row[0] for row in rows], np.diff(curve.time), atol=1e-12)
    starts = curve.at(curve.time[:-1])[:, :3]
    powers = (len(rows[0]) - 1) // 4
    np.testing.assert_allclose(
        [row[1 : 1 + 3 * powers : powers] for row in rows], starts, atol=1e-9
    )
    mission.write_text(MISSION)
    (tmp_path / "t.csv").write_text(
        "time,x,y,z\n" + "".join(f"{20 * k},{0.1 * k},0,5\n" for k in range(9))
    )
    with pytest.raises(rf.RigidfleetError, match=r"speeds reach 0\.005 m/s"):
        rf.load_mission(mission)


def test_follow_does_not_turn_by_doubtful_yaws(tmp_path):
    """Degrees without a unit are refused with their cause; with the word, the body turns by 90 degrees."""
    rows = "".join(f"{k},0,0,5,{10 * k}\n" for k in range(10))
    (tmp_path / "t.csv").write_text("t,x,y,z,yaw\n" + rows)
    mission = tmp_path / "m.toml"
    mission.write_text(MISSION + 'yaw = "file"\n')
    with pytest.raises(rf.RigidfleetError, match="may be degrees or radians"):
        rf.load_mission(mission)
    mission.write_text(MISSION + 'yaw = "file"\nunits = "deg"\n')
    (rows,) = rf.load_mission(mission).to_dict()["phases"][1]["trajectories"]
    powers = (len(rows[0]) - 1) // 4
    last = np.polyval(rows[-1][1 + 3 * powers :][::-1], rows[-1][0])
    assert last == pytest.approx(np.pi / 2)


# -- points -------------------------------------------------------------------------------------------

HUES = ("#ff0000", "#00ff00", "#0000ff")
CORNER = [[0.0, 0.0, 10.0], [3.0, 0.0, 10.0], [0.0, 4.5, 10.0]]


def corner(row):
    return "".join(row(*point, hue) + "\n" for point, hue in zip(CORNER, HUES, strict=True))


def rgb(hue):
    return ",".join(map(str, bytes.fromhex(hue[1:])))


POINTS = {
    "millimetres": (
        "x_mm,y_mm,z_mm\n" + corner(lambda x, y, z, h: f"{1e3 * x},{1e3 * y},{1e3 * z}"),
        None,
    ),
    "centimetres": (
        "x (cm);y (cm);z (cm)\n" + corner(lambda x, y, z, h: f"{100 * x};{100 * y};{100 * z}"),
        None,
    ),
    "a row of units": (
        "x,y,z\nmm,mm,mm\n" + corner(lambda x, y, z, h: f"{1e3 * x},{1e3 * y},{1e3 * z}"),
        None,
    ),
    "order": ("z,y,x\n" + corner(lambda x, y, z, h: f"{z},{y},{x}"), None),
    "colours first": (
        "red,green,blue,x,y,z\n" + corner(lambda x, y, z, h: f"{rgb(h)},{x},{y},{z}"),
        HUES,
    ),
    "hex colours": (
        "name,x,y,z,color\n" + corner(lambda x, y, z, h: f"a{h},{x},{y},{z},{h}"),
        HUES,
    ),
    "hex colours first": ("color,x,y,z\n" + corner(lambda x, y, z, h: f"{h},{x},{y},{z}"), HUES),
    "hex colours without names": (corner(lambda x, y, z, h: f"{x},{y},{z},{h}"), HUES),
    "hex colours between blanks": (corner(lambda x, y, z, h: f"{x} {y} {z} {h}"), HUES),
    "shares": (
        "x,y,z,r,g,b\n"
        + corner(
            lambda x, y, z, h: (
                f"{x},{y},{z}," + ",".join(str(b / 255) for b in bytes.fromhex(h[1:]))
            )
        ),
        HUES,
    ),
    "decimal commas and tabs": (
        corner(lambda x, y, z, h: f"{x:.2f}\t{y:.2f}\t{z:.2f}".replace(".", ",")),
        None,
    ),
    "decimal commas and blanks": (
        corner(lambda x, y, z, h: f"{x} {y} {z}".replace(".", ",")),
        None,
    ),
    "decimal commas and semicolons": (
        "x;y;z\n" + corner(lambda x, y, z, h: f"{x};{y};{z}".replace(".", ",")),
        None,
    ),
    "CR": (corner(lambda x, y, z, h: f"{x},{y},{z}").replace("\n", "\r"), None),
    "heights": ("x,y,altitude\n" + corner(lambda x, y, z, h: f"{x},{y},{z}"), None),
    "up": ("x,y,up\n" + corner(lambda x, y, z, h: f"{x},{y},{z}"), None),
    **{
        head: (f"{head}\n" + corner(lambda x, y, z, h: f"{y},{x},{-z}"), None)
        for head in ("north,east,down", "x_ned,y_ned,z_ned", "N,E,D")
    },
    "a frame": ("x_enu,y_enu,z_enu\n" + corner(lambda x, y, z, h: f"{x},{y},{z}"), None),
    "a unit behind blanks": (
        "x mm,y mm,z mm\n" + corner(lambda x, y, z, h: f"{1e3 * x},{1e3 * y},{1e3 * z}"),
        None,
    ),
}


@pytest.mark.parametrize("kind", POINTS)
def test_points_are_read_as_trajectories_are(kind, tmp_path):
    """Names, units, decimal marks and colours of points mean what they say."""
    text, hues = POINTS[kind]
    (tmp_path / "p.csv").write_bytes(text.encode())
    points = read_points(tmp_path / "p.csv")
    np.testing.assert_allclose(points.slots, CORNER)
    assert points.colours == hues


@pytest.mark.parametrize(
    ("text", "note"),
    [
        ("x,y,depth\n0,0,5\n3,0,5\n", "the columns 'depth' are not read"),
        ("formation,x,y,z\na,0,0,5\nb,3,0,5\n", "the columns 'formation' are not read"),
        ("# all in mm\nx,y,z\n0,0,5\n3,0,5\n", "'# all in mm' is not read"),
        ("1,5,2,5,3,0\n4,5,2,5,3,0\n", "six numbers are read as x, y, z, red, green, blue"),
        ("0,0,5,0.0,0.0,1.0\n3,0,5,0.0,0.0,1.0\n", "six numbers are read as x, y, z, red"),
    ],
)
def test_what_is_left_out_of_points_is_noted(text, note, tmp_path):
    """Columns, units in comments, and numbers without names that may be no colours."""
    (tmp_path / "p.csv").write_text(text)
    assert any(note in x for x in read_points(tmp_path / "p.csv").notes)


@pytest.mark.parametrize(
    "elements",
    ["camera 99999999999\nproperty float a", "face 3000000000\nproperty list uchar int v"],
)
def test_files_that_claim_more_than_they_have_are_refused(elements, tmp_path):
    """At once, and without the memory that they claim."""
    head = f"ply\nformat binary_little_endian 1.0\nelement {elements}\nelement vertex 1\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "p.ply").write_bytes(head.encode() + bytes(100))
    with pytest.raises(rf.RigidfleetError, match="ends before its vertices"):
        read_points(tmp_path / "p.ply")
    claim = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000, 3), }\n"
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(claim)) + claim + bytes(48)
    (tmp_path / "p.npy").write_bytes(data)
    with pytest.raises(rf.RigidfleetError, match="is no whole NPY file"):
        read_points(tmp_path / "p.npy")


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("#1,0,0,5\n#2,3,0,5\n0,3,5\n6,3,5\n", "line 1 = '#1,0,0,5': has 4 numbers, unlike"),
        ("1,50,2,25,3,00\n4,50,2,25,3,00\n", "if commas are decimal marks"),
        ("a,b,c\n0,0,0\n1,0,0\n", "has no names of columns that are understood"),
        ("lon,lat,alt\n8.5,47.4,480\n8.6,47.4,480\n", "has latitude and longitude"),
        ("x_s,y,z\n0,0,0\n1,0,0\n", "no column for x"),
        ("x,y,z,color\n0,0,5,red\n3,0,5,blue\n", "has the colour 'red'"),
        ("time,x,y,z\n0,0,0,5\n1,3,0,5\n", "points of several times"),
        ("x_mm;y_mm;z_mm\n0;0;5.000\n500;0;5.000\n3.000;0;5.000\n", "are these thousands"),
    ],
)
def test_points_that_may_mean_two_things_are_refused(text, cause, tmp_path):
    """With the true cause."""
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(rf.RigidfleetError) as caught:
        read_points(tmp_path / "p.csv")
    assert cause in str(caught.value)


def scan(form, *, camera=True, kind="uchar", name="{}", end="\n"):
    """A PLY file of a scanner: a camera and faces before its vertices, and colours of a kind and name."""
    hues = [bytes.fromhex(hue[1:]) for hue in HUES]
    values = [
        [x / 255 if kind == "float" else x * (257 if kind == "ushort" else 1) for x in hue]
        for hue in hues
    ]
    head = ["ply", f"format {form} 1.0", "obj_info by a scanner"]
    if camera:
        head += ["element camera 1", "property float view", "property int port"]
        head += ["element face 2", "property list uchar int vertex_indices", "property uchar flag"]
    head += ["element vertex 3", *(f"property double {axis}" for axis in "xyz")]
    head += [f"property {kind} {name.format(hue)}" for hue in ("red", "green", "blue")]
    before, rows = ["0.5 640", "3 0 1 2 7", "2 0 1 8"] if camera else [], []
    mark, code = (
        "<>"[form.endswith("big_endian")],
        {"uchar": "B", "ushort": "H", "float": "f"}[kind],
    )
    body = (
        struct.pack(f"{mark}fi", 0.5, 640)
        + struct.pack(f"{mark}B3iBB2iB", 3, 0, 1, 2, 7, 2, 0, 1, 8)
        if camera
        else b""
    )
    for point, value in zip(CORNER, values, strict=True):
        rows.append(" ".join(map(str, (*point, *value))))
        body += struct.pack(f"{mark}3d3{code}", *point, *value)
    if form == "ascii":
        return end.join([*head, "end_header", *before, *rows, ""]).encode()
    return "\n".join([*head, "end_header", ""]).encode() + body


@pytest.mark.parametrize(
    "data",
    [
        *(scan(form) for form in ("ascii", "binary_little_endian", "binary_big_endian")),
        *(scan("ascii", kind=kind) for kind in ("float", "ushort")),
        *(scan("binary_little_endian", kind=kind) for kind in ("float", "ushort")),
        scan("ascii", name="diffuse_{}", camera=False),
        scan("ascii", end="\r"),
        scan("ascii", end="\r\n"),
    ],
)
def test_scans_are_read(data, tmp_path):
    """Whatever stands before the vertices, and colours of any kind."""
    (tmp_path / "p.ply").write_bytes(data)
    points = read_points(tmp_path / "p.ply")
    np.testing.assert_array_equal(points.slots, CORNER)
    assert points.colours == HUES


def test_units_in_remarks_of_scans_are_noted(tmp_path):
    """A scan in millimetres that says so in a comment is not read as metres in silence."""
    data = scan("ascii", camera=False)
    (tmp_path / "p.ply").write_bytes(data.replace(b"obj_info", b"comment units: mm\nobj_info"))
    assert "units: mm' is not read" in " ".join(read_points(tmp_path / "p.ply").notes)
    (tmp_path / "p.ply").write_bytes(data)
    assert not read_points(tmp_path / "p.ply").notes


def test_polynomials_that_may_begin_later_are_noted(tmp_path):
    """Pieces follow each other from 0 s on, whatever a further column says of their times."""
    due = [f"{a}^{k}" for a in ("x", "y", "z", "yaw") for k in range(8)]
    (tmp_path / "p.csv").write_text(f"start_time,duration,{','.join(due)}\n5,1{',1' * 32}\n")
    notes = read_trajectories(tmp_path / "p.csv").notes
    assert notes == ("the column 'start_time' is not read: pieces join, from 0 s on",)


def test_packed_tables_say_how_to_unpack(tmp_path):
    """A table that gzip packed is refused with what unpacks it."""
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress((HEAD + lines(plain)).encode()))
    with pytest.raises(rf.RigidfleetError, match=r"is compressed\. Unpack it: gunzip t\.csv\.gz"):
        read_trajectories(tmp_path / "t.csv.gz")


def test_repeated_points_of_meshes_are_left_out(tmp_path, monkeypatch, capsys):
    """A box whose faces repeat its corners is a formation of eight, and the command says so."""
    corners = [(x, y, z) for x in (0, 3) for y in (0, 3) for z in (0, 3)]
    text = "".join(f"{x},{y},{z}\n" for x, y, z in corners * 3)
    (tmp_path / "box.csv").write_text(text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(rf.RigidfleetError, match="repeats the point of line 1"):
        read_points("box.csv")
    assert main(["design", "box.csv", "--edges", "none", "--out", "out.csv"]) == 0
    assert "16 of 24 points repeat others and are left out" in " ".join(
        capsys.readouterr().err.split()
    )
    assert len(read_points("out.csv").slots) == 8
    assert main(["design", "box.csv", "--agents", "5", "--edges", "none", "--out", "five.csv"]) == 0
    assert len(read_points("five.csv").slots) == 5


#: What `rostopic echo -p` prints of messages with a header, after its source: when one came, its fields in order.
POSE = ["header.seq", "header.stamp", "header.frame_id", *(f"pose.position.{x}" for x in "xyz"),
        *(f"pose.orientation.{x}" for x in "xyzw")]  # fmt: skip


@pytest.mark.parametrize("since", [0, 1_700_000_000])
@pytest.mark.parametrize("header", [True, False])
def test_what_rostopic_prints_is_in_nanoseconds(since, header, tmp_path):
    """The stamp of a message counts, not when it came, in simulated time, too; without a header the other is there."""
    names = POSE if header else [*"xyz"]
    lines = [",".join(["%time", *(f"field.{name}" for name in names)])]
    for k in range(50):
        stamp, place = since * 10**9 + 5_000_000_000 + 20_000_000 * k, [0.01 * k, 1, 2]
        came = stamp + 1_000_000 * (k % 7)
        row = [came, k, stamp, "map", *place, 0, 0, 0, 1] if header else [stamp, *place]
        lines.append(",".join(map(str, row)))
    (tmp_path / "t.csv").write_text("\n".join(lines))
    read = read_trajectories(tmp_path / "t.csv")
    (curve,) = read.curves
    np.testing.assert_allclose(curve.time + read.since, since + 5 + 0.02 * np.arange(50), atol=1e-6)
    np.testing.assert_allclose(curve.at(curve.time)[:, 0], 0.01 * np.arange(50))


@pytest.mark.parametrize(
    ("program", "head"),
    [
        ("Motive", "Format Version,1.23,Take Name,a\n\n,Type,Rigid Body\n"),
        ("Vicon", "Objects\n100\n,,cf1:cf1,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n"),
        ("Vicon", "Trajectories\r\n100\r\n,,cf1:1,,\r\nFrame,Sub Frame,X,Y,Z\r\n"),
    ],
)
def test_exports_of_motion_capture_are_refused_by_name(program, head, tmp_path, capsys):
    """With a line of names that is read as it is meant."""
    path = tmp_path / "t.csv"
    path.write_text(head + "".join(f"{k},0,0,0,0,{k},0,1000\n" for k in range(20)))
    assert main(["assess", str(path)]) == BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert f"is an export of {program}" in said
    names = said.partition("such as ")[2].split()[0]
    assert names.split(",")[1:4] == ["cf1_x_mm", "cf1_y_mm", "cf1_z_mm"]
    whole = f"{names},cf2_y_mm,cf2_z_mm\n" + "".join(
        f"{k / 10},{k},2000,0,{k},2000,500\n" for k in range(20)
    )
    path.write_text(whole)
    read = read_trajectories(path, axes="eus")
    assert read.names == ("cf1", "cf2")
    np.testing.assert_allclose(read.curves[1].at(np.array([1.0]))[0, :3], [0.01, -0.5, 2.0])
