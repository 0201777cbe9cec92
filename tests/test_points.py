"""Points from files in missions, and points on outlines."""

import hashlib
import struct
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree

from rigidfleet import Result, assess, load_mission, simulate
from rigidfleet.cli.app import main
from rigidfleet.errors import MissionError
from rigidfleet.formation import outlines, shapes
from rigidfleet.formation.point_files import read_points
from rigidfleet.mission import Mission

POINTS = np.array([[0.0, 0.0, 1.5], [2.25, 0.0, 0.0], [0.0, -3.0, 0.125]])
TEXT = """
schema_version = 1
name = "from-files"  # kept
formations = { flat = { slots = "flat.npy", edges = [] } }
[agents]
mass = 1.0
position = "sub/grid.csv"
[formations.logo]
slots = "logo.ply"
edges = []
[[phases]]
kind = "establish"
formation = "logo"
duration = 4.0
"""
#: The same, with nothing inline, so that the text stays as it is written.
PLAIN = TEXT.replace('formations = { flat = { slots = "flat.npy", edges = [] } }\n', "")


def ply(points: np.ndarray, form: str) -> bytes:
    """A PLY file as its definition has it, with colours, and faces after the vertices."""
    head = (
        f"ply\nformat {form} 1.0\ncomment made by hand\nelement vertex {len(points)}\nproperty float x\n"
        "property float y\nproperty double z\nproperty uchar red\nelement face 0\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    if form == "ascii":
        return (head + "".join(f"{x} {y} {z} 255\n" for x, y, z in points)).encode()
    mark = "<" if form == "binary_little_endian" else ">"
    return head.encode() + b"".join(struct.pack(mark + "ffdB", *p, 255) for p in points.tolist())


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "sub").mkdir()
    np.savetxt(tmp_path / "sub" / "grid.csv", POINTS + [0, 0, 9], delimiter=",")
    np.save(tmp_path / "flat.npy", POINTS[:, :2])
    (tmp_path / "logo.ply").write_bytes(ply(POINTS, "binary_little_endian"))
    (tmp_path / "m.toml").write_text(PLAIN)
    return tmp_path


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_files_are_read(tmp_path, form):
    """Text and binary of either order give the vertices, whatever else they have."""
    (tmp_path / "p.ply").write_bytes(ply(POINTS, form))
    np.testing.assert_array_equal(read_points(tmp_path / "p.ply").slots, POINTS)


def test_npy_files_are_read(tmp_path):
    """Two columns are points at z = 0; whole numbers are numbers."""
    np.save(tmp_path / "p.npy", np.array([[0, 1], [2, 3]]))
    np.testing.assert_array_equal(read_points(tmp_path / "p.npy").slots, [[0, 1, 0], [2, 3, 0]])


def npy(array: np.ndarray) -> bytes:
    import io

    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("p.npy", npy(POINTS)[:-9], "no whole NPY file"),
        ("p.npy", b"", "no whole NPY file"),
        ("p.npy", npy(np.array([object()])), "no whole NPY file"),
        ("p.npy", npy(np.zeros((2, 4))), r"an array \(2, 4\)"),
        ("p.npy", npy(np.array([["a", "b", "c"]])), "no array of numbers"),
        ("p.npy", npy(np.array([[0, 0, np.nan]])), "point 1 .*is not finite"),
        ("p.npy", npy(np.zeros((2, 3))), "point 2 .*repeats point 1"),
        ("p.npy", npy(np.zeros((0, 3))), "has no points"),
        ("p.ply", ply(POINTS, "ascii")[:-9], "before the last of its 3 vertices"),
        ("p.ply", ply(POINTS, "binary_big_endian")[:-1], "before the last of its 3 vertices"),
        ("p.ply", ply(POINTS, "ascii")[:40], "no whole header"),
        ("p.ply", ply(POINTS, "ascii").replace(b"property float x\n", b""), "no vertices with x"),
        ("p.ply", ply(POINTS, "ascii").replace(b"1.5", b"nan"), "point 1 .*is not finite"),
        ("p.ply", ply(POINTS, "ascii").replace(b"1.5", b"a"), "could not convert"),
        ("p.csv", b"0,0,0\n1,0,nan\n", "line 2 .*not a finite number"),
    ],
)
def test_bad_files_are_one_error(tmp_path, name, data, words):
    """Truncated, not finite, repeated, of another shape: one error that names the file and the place."""
    (tmp_path / name).write_bytes(data)
    with pytest.raises(MissionError, match=words) as told:
        read_points(tmp_path / name)
    assert len(told.value.findings) == 1
    assert name in str(told.value)


@pytest.mark.parametrize("name", ["p.csv", "p.npy"])
def test_thousands_of_errors_are_a_few_lines(tmp_path, name):
    """A file without a single number tells ten lines, and how many more."""
    bad = np.full((10_000, 3), np.nan)
    (tmp_path / name).write_bytes(npy(bad) if name == "p.npy" else b"nan,nan,nan\n" * 10_000)
    with pytest.raises(MissionError, match="has 9,990 more errors"):
        read_points(tmp_path / name)


@pytest.mark.parametrize("text", [PLAIN, TEXT], ids=["tables", "inline"])
def test_a_result_repeats_without_the_files(folder, text):
    """The mission's text holds the points, and the SHA-256 digest of each file; the flight repeats from the result."""
    if text == TEXT:
        text = text.replace("[formations.logo]\n", "").replace(
            'slots = "logo.ply"\nedges = []\n', ""
        )
        text = text.replace("flat = { slots", "logo = { slots")
    (folder / "m.toml").write_text(text)
    used = [folder / "sub" / "grid.csv", folder / ("logo.ply" if text == PLAIN else "flat.npy")]
    digests = [hashlib.sha256(file.read_bytes()).hexdigest() for file in used]
    mission = load_mission(folder / "m.toml")
    result = simulate(mission)
    result.save(folder / "r.nc")
    for file in folder.glob("*.[np]*"):
        file.unlink() if file.suffix != ".nc" else None
    used[0].unlink()
    held = Result.load(folder / "r.nc")
    assert all(digest in held.mission.text for digest in digests)
    np.testing.assert_array_equal(held.mission.agents.position, POINTS + [0, 0, 9])
    if text == PLAIN:
        assert held.mission.formations["logo"].slots == tuple(map(tuple, POINTS.tolist()))

    again = simulate(Mission.from_toml(held.mission_text))
    np.testing.assert_array_equal(again.position, result.position)


@pytest.mark.parametrize("name", ["../out.csv", "/etc/hostname", "link.csv", "sub/../../out.csv"])
def test_names_do_not_leave_the_folder(folder, name):
    """Paths upwards, absolute ones and links to the outside are refused before anything is read."""
    outside = folder.parent / "out.csv"
    outside.write_text("0,0,0\n")
    (folder / "link.csv").symlink_to(outside)
    (folder / "m.toml").write_text(PLAIN.replace("logo.ply", name))
    with pytest.raises(MissionError, match="leaves the folder of the mission") as told:
        load_mission(folder / "m.toml")
    (finding,) = told.value.findings
    assert finding.key == "formations.logo.slots"
    outside.unlink()


def test_ten_thousand_points_for_three_agents(folder):
    """A file with other counts than agents is one finding."""
    np.save(folder / "many.npy", np.random.default_rng(0).uniform(-99, 99, (10_000, 3)))
    (folder / "m.toml").write_text(PLAIN.replace("logo.ply", "many.npy"))
    with pytest.raises(MissionError, match="has 10000 slots for 3 agents") as told:
        load_mission(folder / "m.toml")
    assert len(told.value.findings) == 1


def test_what_is_not_read_of_points_is_noted_before_the_flight(folder, capsys):
    """A mission whose points may be in another unit says so when it is checked."""
    (folder / "mm.csv").write_text("# all in mm\nx,y,z\n0,0,1.5\n2.25,0,0\n0,-3,0.125\n")
    (folder / "m.toml").write_text(PLAIN.replace("logo.ply", "mm.csv"))
    assert main(["check", str(folder / "m.toml")]) == 0
    assert "'# all in mm' is not read" in " ".join(capsys.readouterr().out.split())


def test_names_need_a_mission_file():
    """A mission from a text has no folder: each name is one finding with a remedy."""
    with pytest.raises(MissionError, match="read only with a mission file") as told:
        Mission.from_toml(PLAIN)
    assert [f.key for f in told.value.findings] == ["agents.position", "formations.logo.slots"]


# -- outlines -----------------------------------------------------------------------------------------

SVG = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 100">
<g transform="translate(50 20)">{}</g></svg>"""


def neighbours(p: np.ndarray) -> np.ndarray:
    return KDTree(p).query(p, 2)[0][:, 1]


def test_a_circle_is_sampled_evenly(tmp_path):
    """Points of a drawn circle are a regular polygon whose side is the spacing."""
    (tmp_path / "c.svg").write_text(SVG.format('<circle cx="3" cy="4" r="40"/>'))
    p = outlines.slots_on_outlines(outlines.svg_outlines(tmp_path / "c.svg"), 24, 2.0)
    np.testing.assert_allclose(p[:, 1], 0.0)
    np.testing.assert_allclose(neighbours(p), 2.0, rtol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(p, axis=1), 1.0 / np.sin(np.pi / 24), rtol=2e-3)


def test_drawings_stand_upright(tmp_path):
    """SVG's y points down: what is above in the drawing is above in the air."""
    (tmp_path / "t.svg").write_text(SVG.format('<path d="M 0 0 L 10 40 L -10 40 Z"/>'))
    p = outlines.slots_on_outlines(outlines.svg_outlines(tmp_path / "t.svg"), 30, 1.0)
    top, bottom = p[p[:, 2].argmax()], p[p[:, 2] < p[:, 2].min() + 0.5]
    assert np.ptp(bottom[:, 0]) > 5 * abs(top[0] - bottom[:, 0].mean())
    assert neighbours(p).min() == pytest.approx(1.0)


def test_words_keep_their_spacing():
    """No two points are nearer than the spacing, none is alone, and all lie on the letters' outlines."""
    drawn = outlines.text_outlines("HI")
    p = outlines.slots_on_outlines(drawn, 80, 2.0)
    assert neighbours(p).min() == pytest.approx(2.0)
    assert neighbours(p).max() < 4.0
    assert p.shape == (80, 3)


def test_points_are_thinned_evenly():
    """Fewer of a grid's points keep a distance as large as a coarser grid's."""
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0)), axis=-1).reshape(-1, 2)
    grid = np.asarray(grid, dtype=np.float64)
    assert neighbours(grid[outlines.most_even_points(grid, 20)]).min() >= np.sqrt(2.0)
    with pytest.raises(ValueError, match="81 points cannot place 82"):
        outlines.most_even_points(grid, 82)


def test_design_writes_points_that_it_reads(tmp_path, monkeypatch, capsys):
    """Words become a file of points; the file is a formation again, scaled and thinned."""
    monkeypatch.chdir(tmp_path)
    asked = ["design", "text:Hi", "--agents", "40", "--spacing", "1.5", "--edges", "none"]
    assert main([*asked, "--out", "hi.csv"]) == 0
    p = read_points("hi.csv").slots
    assert p.shape == (40, 3)
    assert neighbours(p).min() == pytest.approx(1.5)
    capsys.readouterr()
    asked = ["design", "hi.csv", "--agents", "30", "--spacing", "3", "--edges", "none"]
    assert main(asked) == 0
    import tomllib

    form = tomllib.loads(capsys.readouterr().out)["formations"]["hi"]
    assert form["edges"] == []
    assert len(form["slots"]) == 30
    assert neighbours(np.array(form["slots"])).min() == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (["text:", "--agents", "9", "--spacing", "1"], "has no outline"),
        (["text:A", "--agents", "9"], "needs --agents and --spacing"),
        (["text:A", "--agents", "10000", "--spacing", "1"], "takes 2 to 5,000 agents"),
        (["text:A", "--agents", "9", "--spacing", "-1"], "positive length"),
        (["text:A", "--agents", "9", "--spacing", "1", "--font", "No Such"], "there is no font"),
        (["cube", "--spacing", "1"], "use --size"),
        (["bad.svg", "--agents", "9", "--spacing", "1"], "is no SVG drawing"),
        (["empty.svg", "--agents", "9", "--spacing", "1"], "has no outline"),
    ],
    ids=str,
)
def test_what_cannot_be_designed(tmp_path, monkeypatch, capsys, asked, words):
    """One clear error, and no file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.svg").write_text("<svg><path d='M 0")
    (tmp_path / "empty.svg").write_text(SVG.format(""))
    assert main(["design", *asked, "--out", "x.toml"]) != 0
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "x.toml").exists()


@pytest.mark.parametrize("suffix", [".csv", ".npy", ".ply"])
def test_colours_of_points(suffix, tmp_path):
    """Points keep the colours of their file: in a mission, and where a formation is designed from it."""
    rows, path = np.hstack([POINTS, [[255, 0, 0], [0, 128, 7], [1, 2, 3]]]), tmp_path / f"p{suffix}"
    if suffix == ".npy":
        np.save(path, rows)
    elif suffix == ".csv":
        path.write_text("".join(f"{x},{y},{z},{r:g},{g:g},{b:g}\n" for x, y, z, r, g, b in rows))
    else:
        head = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
        head += b"".join(b"property float %c\n" % axis for axis in b"xyz")
        head += b"".join(b"property uchar %s\n" % name for name in (b"red", b"green", b"blue"))
        body = b"".join(struct.pack("<fffBBB", *row[:3], *map(int, row[3:])) for row in rows)
        path.write_bytes(head + b"end_header\n" + body)
    found = read_points(path)
    np.testing.assert_array_equal(found.slots, POINTS)
    assert found.colours == ("#ff0000", "#008007", "#010203")
    (tmp_path / "sub").mkdir()
    np.savetxt(tmp_path / "sub" / "grid.csv", POINTS + [0, 0, 9], delimiter=",")
    (tmp_path / "m.toml").write_text(PLAIN.replace("logo.ply", path.name))
    mission = load_mission(tmp_path / "m.toml")
    assert mission.formations["logo"].colour == found.colours
    assert main(["design", str(path), "--out", str(tmp_path / "again.csv"), "--edges", "none"]) == 0
    assert read_points(tmp_path / "again.csv").colours == found.colours


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,0,0,1,2,256\n1,0,0,1,2,3\n", "no whole numbers from 0 to 255"),
        ("0,0,0,1,2,3.5\n1,0,0,1,2,3\n", "no whole numbers from 0 to 255"),
        ("0,0,0,1,2,3\n1,0,0\n", "unlike the lines before"),
        ("0,0,0,1,2\n", "and 5 numbers"),
    ],
)
def test_wrong_colours_of_points(rows, message, tmp_path):
    """Colours that are no colours are told with their line."""
    (tmp_path / "p.csv").write_text(rows)
    with pytest.raises(MissionError, match=message):
        read_points(tmp_path / "p.csv")


def test_wrong_colours_of_formations(folder):
    """A list of colours has one for each slot, and a colour is six hexadecimal digits."""
    text = PLAIN.replace('slots = "logo.ply"', 'slots = "logo.ply"\ncolour = {}')
    for colour, message in (('["#000000"]', "1 colours for 3 agents"), ('"red"', "colour")):
        (folder / "m.toml").write_text(text.format(colour))
        with pytest.raises(MissionError, match=message):
            load_mission(folder / "m.toml")


def fleet(n: int, **form: Any) -> dict[str, Any]:
    """A mission of n vehicles in a row that take a formation, each the slot for which all ways are shortest."""
    return {
        "schema_version": 1, "name": "resting", "assignment": "each", "limits": {"separation": 0.3},
        "agents": {"mass": 1.0, "position": [[2.0 * i, 0.0, 5.0] for i in range(n)]},
        "formations": {"some": {"edges": []} | form},
        "phases": [{"kind": "establish", "formation": "some", "control": "tracking", "duration": 12.0, "blend": 10.0}],
    }  # fmt: skip


def written_slots(mission: Mission, name: str) -> np.ndarray:
    """The slots of a formation that has them as numbers."""
    slots = mission.formations[name].slots
    assert slots is not None
    return np.array(slots)


@pytest.mark.parametrize(("n", "k"), [(7, 3), (10, 4), (40, 9)])
def test_vehicles_without_a_slot_rest_at_the_sides(n, k):
    """They wait mirrored at the middle, no nearer than the slots are to each other, and dark; the flight passes."""
    rng = np.random.default_rng(n)
    slots = np.unique(rng.integers(-3, 4, (400, 3)), axis=0)
    slots = 1.5 * slots[rng.permutation(len(slots))[:k]]
    mission = Mission.from_dict(fleet(n, slots=slots.tolist(), rest="sides", colour="#ff0000"))
    every = written_slots(mission, "some")
    np.testing.assert_array_equal(every[:k], slots)
    off = every[k:] - slots.mean(axis=0)
    pairs = (n - k) // 2
    np.testing.assert_allclose(off[: 2 * pairs : 2], -off[1 : 2 * pairs : 2], atol=1e-12)
    step = neighbours(slots).min()
    assert neighbours(every).min() >= step - 1e-9
    assert (abs(off[:, 0]) > abs(slots[:, 0] - slots[:, 0].mean()).max() + step).all()
    colours = mission.formation_colours("some")
    assert colours is not None
    assert colours.count("#ff0000") == k
    assert colours.count("#000000") == n - k
    result = simulate(mission)
    assert assess(result).passed
    # What is written is what was flown: the mission repeats from its text.
    assert (
        Mission.from_toml(result.mission.text).formations["some"].slots
        == mission.formations["some"].slots
    )


def test_vehicles_rest_at_given_places():
    """A shape of fewer vehicles, and a place for each of the others."""
    rest = [[9.0, 0.0, 0.0], [-9.0, 0.0, 0.0]]
    mission = Mission.from_dict(fleet(6, shape="square", size=3.0, agents=4, rest=rest))
    slots = written_slots(mission, "some")
    np.testing.assert_array_equal(slots[4:], rest)
    np.testing.assert_array_equal(slots[:4], shapes.slots("square", 3.0, 4))


@pytest.mark.parametrize(
    ("form", "message"),
    [
        ({"slots": [[0, 0, 0], [3, 0, 0]]}, "2 slots for 6 agents\n    .*rest = 'sides'"),
        ({"slots": [[0, 0, 0], [3, 0, 0]], "rest": [[9, 0, 0]]}, "1 places for the 4 agents"),
        ({"slots": [[0, 0, 0]], "rest": "sides"}, "needs two or more slots"),
        ({"slots": [[0, 0, 0], [3, 0, 0]], "rest": "below"}, "rest"),
        ({"shape": "square", "size": 3.0, "agents": 4}, "no effect without rest"),
        ({"shape": "square", "size": 3.0, "rest": "sides"}, "rest = 'sides': needs slots"),
        ({"shape": "square", "size": 3.0, "agents": 9, "rest": "sides"}, "more than the 6 agents"),
        ({"shape": "square", "size": 3.0, "agents": 5, "rest": "sides"}, "square"),
    ],
)
def test_wrong_rests(form, message):
    """What cannot rest says so."""
    with pytest.raises(MissionError, match=message):
        Mission.from_dict(fleet(6, **form))


def test_a_show_of_fewer_points_than_vehicles(tmp_path, monkeypatch, capsys):
    """`new --show` lets the vehicles rest for which a file has no points, and the show passes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "logo.csv").write_text("".join(f"{2.5 * k},0,{k % 2}\n" for k in range(9)))
    asked = [
        "new",
        "s",
        "--show",
        "--agents",
        "16",
        "--spacing",
        "2",
        "--formations",
        "logo.csv,sphere",
    ]
    assert main(asked) == 0
    assert 'rest = "sides"' in (tmp_path / "s.toml").read_text()
    mission = load_mission(tmp_path / "s.toml")
    assert written_slots(mission, "logo").shape == (16, 3)
    assert assess(simulate(mission)).passed


@pytest.mark.parametrize(("suffix", "what"), [("pcd", "PCL"), ("obj", "Wavefront"), ("DXF", "CAD")])
def test_points_of_other_programs_are_refused_by_name(suffix, what, tmp_path):
    """What it is, and what to give instead."""
    path = tmp_path / f"logo.{suffix}"
    path.write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(MissionError, match=rf"{what}\s+save.* as (PLY|SVG)"):
        read_points(path)
