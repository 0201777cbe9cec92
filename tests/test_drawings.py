"""Drawings and words as formations, and new missions of points, drawings and words."""

import shutil
import subprocess

import numpy as np
import pytest
from scipy.spatial import KDTree

from rigidfleet import assess, load_mission, simulate
from rigidfleet.cli.app import main
from rigidfleet.formation import outlines
from rigidfleet.mission import Mission


def written_slots(mission: Mission, name: str) -> np.ndarray:
    """The slots of a formation, as the mission holds them."""
    return np.array(mission.formations[name].slots)


#: Drawings of 200 by 200, and where a browser shows them: x from and to, y from and to; None: nothing.
SHOWN = {
    '<path d="M10 10 H50 V50 H10 Z"/><path style="display:none" d="M0 0 H400 V40 H0 Z"/>': (10, 50, 10, 50),
    '<g style="display:none"><g><rect width="90" height="90"/></g></g><rect x="3" width="9" height="4"/>':
        (3, 12, 0, 4),
    '<g visibility="hidden"><rect width="90" height="9"/><rect visibility="visible" width="4" height="3"/></g>':
        (0, 4, 0, 3),
    "<style>.a{display:none} .b{visibility:hidden} .c, .d{opacity:0} #z{display:none !important}</style>"
    '<g class="a x"><rect width="99" height="9"/></g><rect class="b" width="99" height="9"/><rect class="d" width="99"'
    ' height="9"/><rect id="z" width="99" height="9"/><rect x="5" y="6" width="7" height="8"/>': (5, 12, 6, 14),
    '<rect class="a" width="99" height="9"/><rect width="4" height="4"/><defs><style>.a{display:none}</style></defs>':
        (0, 4, 0, 4),
    '<g opacity="0"><rect opacity="1" width="99" height="9"/></g><g style="display:inline;opacity:0"><rect'
    ' style="opacity:1" width="99" height="9"/></g><rect style="opacity:0.5" width="4" height="4"/>': (0, 4, 0, 4),
    '<defs><path id="p" d="M0 0 H40 V20 H0 Z"/></defs><use xlink:href="#p" x="10" y="5"/>': (10, 50, 5, 25),
    '<defs><path id="p" d="M0 0 H40 V20 H0 Z"/></defs><use href="#p" y="5" transform="rotate(90) scale(2 1)"/>':
        (-25, -5, 0, 80),
    '<path id="p" d="M0 0 H40 V40 H0 Z"/><use xlink:href="#p" x="60"/>': (0, 100, 0, 40),
    '<defs><g id="a"><rect id="r" width="20" height="10"/><use href="#r" y="30"/></g></defs><use href="#a" x="30"/>':
        (30, 50, 0, 40),
    '<symbol id="s" viewBox="0 0 10 10"><rect x="1" y="1" width="8" height="4"/></symbol>'
    '<use href="#s" x="10" y="20" width="100" height="100"/>': (20, 100, 30, 70),
    '<symbol id="s" viewBox="0 0 10 20" preserveAspectRatio="none"><rect width="5" height="20"/></symbol>'
    '<use href="#s" width="100" height="50"/>': (0, 50, 0, 50),
    '<svg x="50" y="60" width="100" height="50" viewBox="0 0 10 10"><rect x="1" width="8" height="5"/></svg>':
        (80, 120, 60, 85),
    '<g transform="translate(20,10) scale(2,1)"><g transform="scale(1,3)"><path d="M0 0 H40 V40 H0 Z"/></g></g>':
        (20, 100, 10, 130),
    '<rect x="10" y="10" width="60" height="20" transform="matrix(0,1,-1,0,80,0)"/>': (50, 70, 10, 70),
    '<rect width="10" height="10" transform="skewX(45)"/>': (0, 20, 0, 10),
    '<rect style="transform:translate(50px, 40px) rotate(90deg)" width="30" height="20"/>': (30, 50, 40, 70),
    '<defs><rect width="99" height="99"/></defs><clipPath id="c"><rect width="99" height="99"/></clipPath><mask id="m">'
    '<rect width="99" height="99"/></mask><pattern id="q"><rect width="99" height="99"/></pattern><marker id="n"><rect'
    ' width="99" height="99"/></marker><symbol><rect width="99" height="99"/></symbol><rect width="4" height="3"/>':
        (0, 4, 0, 3),
    '<rect fill="none" width="99" height="9"/><line x2="99"/><line x2="40" y2="30" stroke="red"/>': (0, 40, 0, 30),
    '<rect x="25.4mm" y="10%" width="1in" height="50%"/>': (96, 192, 20, 120),
    '<a href="#"><rect width="4" height="3"/></a><metadata><rect width="99" height="99"/></metadata>': (0, 4, 0, 3),
    "<style>@media print{.a{display:none}} .b{display:none}</style>"
    '<rect class="a" width="4" height="3"/><rect class="b" width="99" height="99"/>': (0, 4, 0, 3),
    '<svg width="100" height="50"><rect width="50%" height="50%"/><circle cx="50%" cy="50%" r="1"/></svg>':
        (0, 51, 0, 26),
    '<rect x="1em" width="12pt" height="1pc"/>': (16, 32, 0, 16),
    '<rect width="99" height="99" fill="#00000000"/><rect width="99" height="99" fill="rgba(0,0,0,0)"/>'
    '<rect width="4" height="3"/>': (0, 4, 0, 3),
    '<switch><rect systemLanguage="xx" width="99" height="99"/><rect width="4" height="3"/><rect width="99"/></switch>':
        (0, 4, 0, 3),
    '<use href="#p"/>': None,
}  # fmt: skip
VIEW = """<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" viewBox="0 0 200 200"
width="200" height="200">{}</svg>"""


@pytest.mark.parametrize("drawing", SHOWN)
def test_drawings_are_those_that_a_browser_shows(drawing, tmp_path):
    """What is hidden, defined alone or unpainted is left out; references, views and transforms place the rest."""
    (tmp_path / "d.svg").write_text(VIEW.format(drawing))
    if (expected := SHOWN[drawing]) is None:
        with pytest.raises(ValueError, match="has no outline"):
            outlines.svg_outlines(tmp_path / "d.svg")
        return
    x = np.concatenate(outlines.svg_outlines(tmp_path / "d.svg")) * (1, -1)
    shown = np.stack([x.min(axis=0), x.max(axis=0)], axis=1).ravel()
    np.testing.assert_allclose(shown, expected, atol=1e-4)


@pytest.mark.long
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Chromium")
@pytest.mark.parametrize("drawing", [d for d, shown in SHOWN.items() if shown and min(shown) >= 0])
def test_chromium_shows_what_is_drawn(drawing, tmp_path):
    """The places where Chromium shows something are those of the table, and of the outlines."""
    from PIL import Image

    (tmp_path / "d.svg").write_text(VIEW.format(drawing))
    page = f'<body style="margin:0"><img src="file://{tmp_path}/d.svg"></body>'
    (tmp_path / "d.html").write_text(page)
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += ["--window-size=300,300", "--force-device-scale-factor=2"]
    command += [f"--user-data-dir={tmp_path}/user", f"--screenshot={tmp_path}/d.png"]
    subprocess.run([*command, f"file://{tmp_path}/d.html"], check=True, capture_output=True)
    rows, columns = np.nonzero(np.asarray(Image.open(tmp_path / "d.png").convert("L")) < 250)
    seen = [columns.min(), columns.max() + 1, rows.min(), rows.max() + 1]
    assert np.array(seen) / 2 == pytest.approx(np.array(SHOWN[drawing]), abs=1.0)


def test_what_is_not_drawn_is_said(tmp_path, monkeypatch, capsys):
    """Text, clips, masks, fills, unread style rules and missing references are named, in the mission, too."""
    monkeypatch.chdir(tmp_path)
    rest = """<rect width="40" height="40" clip-path="url(#c)"/><image width="4"/><line x2="30"/>
    <g style="mask:url(#m)"><rect x="50" width="9" height="9"/></g><text>Hi <tspan>there</tspan></text>
    <use href="other.svg#p"/><style>.a .b{fill:none}</style>
    <symbol id="s" refX="-5" viewBox="0 0 9 9"><path d="M0 0h9"/></symbol><use href="#s" fill="none"/>"""
    (tmp_path / "d.svg").write_text(VIEW.format(rest))
    asked = ["--formations", "d.svg", "--agents", "20", "--spacing", "2"]
    for show in ["--show"], []:
        assert main(["new", "m", *asked, *show, "--force"]) == 0
        shown, text = capsys.readouterr().err, (tmp_path / "m.toml").read_text()
        for said in (
            "clip-path is not followed",
            "mask is not followed",
            "refX is not followed",
            "text 'Hi' is not drawn",
            "tspan 'there' is not drawn",
            "fill is drawn by its edge, without colour (2x)",
            "'other.svg#p' is referred to, and not in the file",
            "style rule '.a .b' is not read",
            "image '' is not drawn",
            "shape without fill and stroke is not drawn",
        ):
            assert said in " ".join(shown.split())
            assert said in text


def test_a_drawing_of_text_alone_says_so(tmp_path):
    """A drawing without outlines is refused with what it has instead."""
    (tmp_path / "d.svg").write_text(VIEW.format("<text>Hi</text>"))
    with pytest.raises(ValueError, match="no outline; text 'Hi' is not drawn: convert it to paths"):
        outlines.svg_outlines(tmp_path / "d.svg")


def test_drawings_that_never_end_are_refused(tmp_path):
    """A drawing inside itself, and one of a million elements by references, is one error, in a second."""
    inside = '<g id="a"><rect width="3" height="3"/><use href="#a"/></g>'
    groups = [f"<g id='x{k + 1}'>" + f"<use href='#x{k}'/>" * 10 + "</g>" for k in range(6)]
    many = f"<defs><rect id='x0' width='1' height='1'/>{''.join(groups)}</defs><use href='#x6'/>"
    for rest in inside, many:
        (tmp_path / "d.svg").write_text(VIEW.format(rest))
        with pytest.raises(ValueError, match="more than 20,000 elements, or one inside itself"):
            outlines.svg_outlines(tmp_path / "d.svg")


def write_points(path, points):
    """A file of points, with names of its columns."""
    path.parent.mkdir(exist_ok=True)
    rows = [",".join(map(repr, map(float, row))) for row in points]
    path.write_text("\n".join(["x,y,z", *rows, ""]))


#: Six places on a circle of 4 m radius, upright, and six in a row.
RING = [(4 * np.cos(a), 0.0, 4 * np.sin(a)) for a in np.arange(6) * np.pi / 3]
ROW = [(3.0 * k, 0.0, 0.0) for k in range(6)]


@pytest.mark.parametrize(
    "names", [("a/x.csv", "b/x.csv"), ("a/pads.csv", "b/x.csv"), ("a/pads.csv", "b/pads.csv")]
)
def test_formations_of_one_name_are_both_kept(tmp_path, monkeypatch, names):
    """`new --show` flies every file of points, also if two have one name, or that of the formation on the ground."""
    monkeypatch.chdir(tmp_path)
    for name, points in zip(names, (RING, ROW), strict=True):
        write_points(tmp_path / name, points)
    asked = [
        "new",
        "s",
        "--show",
        "--agents",
        "6",
        "--spacing",
        "2",
        "--formations",
        ",".join(names),
    ]
    assert main(asked) == 0
    mission = load_mission(tmp_path / "s.toml")
    flown = [str(name) for p in mission.phases if (name := getattr(p, "formation", None))]
    assert len(flown) == 3
    for name, points in zip(flown, (RING, ROW), strict=False):
        slots = written_slots(mission, name)
        np.testing.assert_allclose(
            slots - slots.mean(0), np.array(points) - np.mean(points, 0), atol=1e-9
        )
    assert mission.formations[flown[2]].shape == "grid"  # back on the ground
    again = [
        "new",
        "t",
        "--show",
        "--agents",
        "6",
        "--formations",
        f"{names[1]},{names[0]},{names[1]}",
    ]
    assert main(again) == 0
    assert len(load_mission(tmp_path / "t.toml").formations) == 3  # a formation that returns is one


@pytest.mark.parametrize("verb", [["new", "m", "--show"], ["new", "m", "--shape"], ["design"]])
def test_a_scale_is_said(tmp_path, monkeypatch, capsys, verb):
    """Points too near for the spacing are enlarged; the scale, the sizes and the two points are said and written."""
    monkeypatch.chdir(tmp_path)
    places = [(1.0 * k, 0.0, 0.0) for k in range(5)] + [(4.0, 0.0, 0.5)]
    write_points(tmp_path / "p.csv", places)
    verb = [*verb, "--formations"] if verb[-1] == "--show" else verb
    more = ["--edges", "none"] if verb == ["design"] else []
    assert main([*verb, "p.csv", "--spacing", "2", *more]) == 0
    shown = capsys.readouterr()
    told = " ".join((shown.out + shown.err).split())
    text = shown.out if verb == ["design"] else (tmp_path / "m.toml").read_text()
    said = "scaled by 4, from 4 m to 16 m across: the points (4, 0, 0) and (4, 0, 0.5) are 0.5 m apart, to become 2 m"
    assert said in text
    assert said in told


@pytest.mark.parametrize("case", ["one", "pairs", "grid"])
@pytest.mark.parametrize(
    "verb", [["new", "m", "--show", "--formations"], ["new", "m", "--shape"], ["design"]]
)
def test_near_duplicates_do_not_make_giants(tmp_path, monkeypatch, capsys, case, verb):
    """Points that are nearly repeated are named, and no formation of a kilometre comes of one of thirty metres."""
    monkeypatch.chdir(tmp_path)
    circle = [(15 * np.cos(a), 0.0, 15 * np.sin(a)) for a in np.arange(50) * np.pi / 25]
    grid = [(x, 0.0, z) for x in range(7) for z in range(7)]
    points = {
        "one": [*circle, (15.0, 0.0, 0.03)],
        "pairs": [*circle, *((x, 0.03, z) for x, _, z in circle)],
        "grid": [*grid, (3.05, 0.0, 3.0)],
    }[case]
    write_points(tmp_path / "p.csv", points)
    more = ["--edges", "none"] if verb == ["design"] else []
    assert main([*verb, "p.csv", "--spacing", "2", *more]) != 0
    error = " ".join(capsys.readouterr().err.split())
    assert "would be scaled by" in error
    assert (
        "the points (15, 0, 0) and (15, 0" in error
        or "the points (3, 0, 3) and (3.05, 0, 3)" in error
    )
    assert not (tmp_path / "m.toml").exists()


@pytest.mark.parametrize("option", ["--shape", "--formations"])
def test_new_missions_of_points(tmp_path, monkeypatch, option):
    """A new mission of points needs no `--show`: it forms those of a file in their own size, or words, and passes."""
    monkeypatch.chdir(tmp_path)
    write_points(tmp_path / "ring 1.csv", RING)
    assert main(["new", "m", option, "ring 1.csv"]) == 0
    mission = load_mission(tmp_path / "m.toml")
    np.testing.assert_allclose(written_slots(mission, "ring 1"), RING, atol=1e-9)
    result = simulate(mission)
    assert assess(result).passed
    shown = result.position[np.searchsorted(result.time, result.phases[1].t_end) - 1]
    np.testing.assert_allclose(np.linalg.norm(shown - shown.mean(axis=0), axis=1), 4.0, atol=0.05)
    for words in "text:HI", "strokes:HI":
        assert main(["new", "w", option, words, "--agents", "24", "--spacing", "2", "--force"]) == 0
        assert assess(simulate(load_mission(tmp_path / "w.toml"))).passed


def test_words_of_single_strokes():
    """Sixty points of FLY lie, 2 m apart, on all strokes of Hershey's Simplex Roman, as its table has them."""
    # Corners of F, L and Y, and the widths of the letters, by the numbers of the Hershey fonts (NBS, 1967).
    strokes = [(4, 21, 4, 0), (4, 21, 17, 21), (4, 11, 12, 11)]
    strokes += [(22, 21, 22, 0), (22, 0, 34, 0)]
    strokes += [(36, 21, 44, 11), (44, 11, 44, 0), (52, 21, 44, 11)]
    p = outlines.slots_on_outlines(outlines.stroke_outlines("FLY"), 60, 2.0)[:, [0, 2]]
    assert KDTree(p).query(p, 2)[0][:, 1].min() == pytest.approx(2.0)
    a, b = np.array(strokes, dtype=float).reshape(-1, 2, 2).transpose(1, 0, 2)
    p = (p - p.min(axis=0)) * (21.0 / np.ptp(p[:, 1])) + [4.0, 0.0]
    share = np.clip(
        np.einsum("psa,sa->ps", p[:, None] - a, b - a) / ((b - a) ** 2).sum(axis=1), 0, 1
    )
    off = np.linalg.norm(a + share[..., None] * (b - a) - p[:, None], axis=2)
    assert off.min(axis=1).max() < 0.02
    assert set(off.argmin(axis=1)) == set(range(len(strokes)))  # no stroke is left out


def test_letters_that_are_not_in_the_font(tmp_path, capsys):
    """Letters without strokes are named, and nothing is written without them."""
    out = tmp_path / "x.csv"
    for words, error in (("strokes:Füße", "lacks: üß"), ("strokes: ", "has no outline")):
        assert main(["design", words, "--agents", "9", "--spacing", "1", "--out", str(out)]) != 0
        assert error in capsys.readouterr().err
    assert not out.exists()
