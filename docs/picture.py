"""Draw the pictures of the documents into docs/images: `python docs/picture.py`, or `make docs`.

A picture that looks as before is kept to the byte: the last digits of a simulation are those of the machine.
"""

import io
import re
import runpy
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib
import numpy as np
from diagrams import DIAGRAMS
from PIL import Image
from shapes import SHAPES

import rigidfleet as rf
from rigidfleet.foreign.files import read_trajectories
from rigidfleet.formation import outlines
from rigidfleet.formation.point_files import Points
from rigidfleet.mission import Mission, show_draft
from rigidfleet.plotting import encode_figure
from rigidfleet.plotting.style import apply_style
from rigidfleet.simulation.trajectories import result_of_trajectories
from rigidfleet.sweep import Sweep, fly
from rigidfleet.sweep.figures import drill_failure_figure, map_over_two

IMAGES = Path(__file__).parent / "images"
MISSION = "narrow-passage"
#: Numbers in a drawing that differ by no more are the same [points], and so are levels of a colour (of 255).
_POINTS, _LEVELS = 0.02, 24


def flight() -> None:
    """The picture of the first page, with few colours, as everybody loads it."""
    result = rf.simulate(rf.load_mission(MISSION))
    with TemporaryDirectory() as folder:
        (path,) = rf.plot(result, folder, formats=["png"], names=["summary"])
        _save_with_few_colours(path, MISSION)


def show() -> None:
    """The pictures of a show, made as its page makes it."""
    options = ["--agents", "100", "--spacing", "2"]
    with TemporaryDirectory() as folder:
        for words in (
            ["design", "text:HI", *options, "--edges", "none", "--out", "logo.csv"],
            ["new", "my-show", "--show", *options, "--formations", "sphere,helix,logo.csv"],
        ):
            subprocess.run(
                [sys.executable, "-m", "rigidfleet", *words],
                cwd=folder,
                check=True,
                stdout=subprocess.DEVNULL,
            )
        result = rf.simulate(Path(folder, "my-show.toml"))
        paths = rf.plot(result, folder, formats=["png"], names=["formations", "operation"])
        for path, name in zip(paths, ("show", "show-operation"), strict=True):
            _save_with_few_colours(path, name)


def words() -> None:
    """A word in single strokes, as the page of shows writes it."""
    letters = outlines.slots_on_outlines(outlines.stroke_outlines("FLY"), 60, 2.0)
    scenes = [show_draft.points_scene("FLY", Points(letters, None), "strokes:FLY")]
    result = rf.simulate(
        Mission.from_toml(show_draft.show_mission_text("fly", scenes, agents=60, spacing=2.0))
    )
    with TemporaryDirectory() as folder:
        (path,) = rf.plot(result, folder, formats=["png"], names=["formations"])
        _save_with_few_colours(path, "fly")


def others() -> None:
    """The picture of a flight that others made, judged as its page says."""
    files = IMAGES.parents[1] / "tests" / "data" / "sequence_trajectories"
    read = read_trajectories(files)
    result = result_of_trajectories(read, separation=0.3, name=files.name)
    with TemporaryDirectory() as folder:
        (path,) = rf.plot(result, folder, formats=["png"], names=["clearance"])
        _save_with_few_colours(path, "seven-crazyflies")


def study() -> None:
    """The map of the example of a sweep."""
    sweep = Sweep.load(IMAGES.parents[1] / "examples" / "gain_study.toml")
    with TemporaryDirectory() as folder:
        table = fly(sweep, folder, workers=1)
        figure = map_over_two(table, ["constraint.alpha", "constraint.gamma"], "shape_end")
        assert figure is not None
    _save_with_few_colours(io.BytesIO(encode_figure(figure, ["png"])["png"]), "gain-study")


def radio() -> None:
    """The map of the cube that is formed by messages, as its page flies it."""
    mission = rf.load_mission(IMAGES.parents[1] / "examples" / "cube_by_radio.toml")
    vary = ("network.loss = linspace(0, 0.95, 20)", "network.delay = linspace(0, 0.19, 20)")
    with TemporaryDirectory() as folder:
        table = fly(Sweep.of(mission, vary), folder, workers=2)
        figure = map_over_two(table, ["network.delay", "network.loss"], "success")
        assert figure is not None
    _save_with_few_colours(io.BytesIO(encode_figure(figure, ["png"])["png"]), "cube-by-radio")


def own_laws() -> None:
    """The figure of the example of laws of vehicles' own."""
    with TemporaryDirectory() as folder:
        runpy.run_path(str(IMAGES.parents[1] / "examples" / "own_distributed_law.py"))["main"](
            folder
        )
        _save_with_few_colours(Path(folder) / "own-laws.png", "own-laws")


def drill() -> None:
    """What the example of a drill bears."""
    sweep = Sweep.load(IMAGES.parents[1] / "examples" / "market_square.toml")
    with TemporaryDirectory() as folder:
        table = fly(sweep, folder, workers=2)
    with apply_style():
        figure = drill_failure_figure(table)
        assert figure is not None
        picture = encode_figure(figure, ["png"])["png"]
    _save_with_few_colours(io.BytesIO(picture), "drill")


def _save_with_few_colours(path: Path | io.BytesIO, name: str) -> None:
    # A palette makes a third of the size; without refining it (kmeans), greys come out tinted.
    picture = Image.open(path).convert("RGB").quantize(256, kmeans=5, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    picture.save(buffer, "png", optimize=True)
    keep_or_write(IMAGES / f"{name}.png", buffer.getvalue())


def keep_or_write(path: Path, new: bytes) -> None:
    """Write a picture, unless the one that is there looks the same."""
    alike = same_drawing if path.suffix == ".svg" else same_pixels
    if not (path.exists() and alike(path.read_bytes(), new)):
        path.write_bytes(new)


def same_drawing(old: bytes, new: bytes) -> bool:
    """Whether two SVGs have the same elements, with numbers that nobody can tell apart."""
    # Names of shapes are digests of all their digits.
    texts = [re.sub(r"\b[a-z][0-9a-f]{10}\b", "id", text.decode()) for text in (old, new)]
    number = r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?"
    rest = [re.sub(number, "0", text) for text in texts]
    if rest[0] != rest[1]:
        return False
    a, b = (np.array([float(x) for x in re.findall(number, text)]) for text in texts)
    return bool((np.abs(a - b) <= _POINTS).all())


def same_pixels(old: bytes, new: bytes) -> bool:
    """Whether two PNGs have the same size, and colours that nobody can tell apart."""
    a, b = (np.asarray(Image.open(io.BytesIO(x)).convert("RGB"), dtype=int) for x in (old, new))
    return a.shape == b.shape and int(np.abs(a - b).max(initial=0)) <= _LEVELS


def drawings() -> None:
    """The drawings, letters as outlines: they are read on screens without our fonts."""
    for draw in (*DIAGRAMS, *SHAPES):
        buffer = io.StringIO()
        with apply_style(), matplotlib.rc_context({"svg.fonttype": "path"}):
            draw().savefig(buffer, format="svg", metadata={"Date": None})
        name = draw.__name__.replace("_", "-")  # ty: ignore[missing-attribute]
        # Lines without blanks at their ends, as in any text that is kept.
        lines = (line.rstrip() for line in buffer.getvalue().splitlines())
        keep_or_write(IMAGES / f"{name}.svg", ("\n".join(lines) + "\n").encode())


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    flight()
    study()
    radio()
    show()
    words()
    others()
    own_laws()
    drill()
    drawings()
