"""Draw the pictures of README and documents into docs/images: `python docs/picture.py`, or `make docs`."""

import io
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib
from diagrams import DIAGRAMS
from PIL import Image
from shapes import SHAPES

import rigidfleet as rf
from rigidfleet.figures import write_figure
from rigidfleet.figures.style import settings
from rigidfleet.sweep import Sweep, fly
from rigidfleet.sweep.figures import over_two

IMAGES = Path(__file__).parent / "images"
MISSION = "narrow-passage"


def flight() -> None:
    """The README's picture, with few colours, as everybody loads it."""
    result = rf.simulate(rf.load_mission(MISSION))
    with TemporaryDirectory() as folder:
        (path,) = rf.plot(result, folder, formats=["png"], names=["summary"])
        _save_with_few_colours(path, MISSION)


def study() -> None:
    """The map of the example of a sweep."""
    sweep = Sweep.load(IMAGES.parents[1] / "examples" / "gain_study.toml")
    with TemporaryDirectory() as folder:
        table = fly(sweep, folder, workers=1)
        figure = over_two(table, ["constraint.alpha", "constraint.gamma"], "shape_end")
        assert figure is not None
        (path,) = write_figure(figure, Path(folder), "map", ["png"])
        _save_with_few_colours(path, "gain-study")


def _save_with_few_colours(path: Path, name: str) -> None:
    # A palette makes a third of the size; without refining it (kmeans), greys come out tinted.
    picture = Image.open(path).convert("RGB").quantize(256, kmeans=5, dither=Image.Dither.NONE)
    picture.save(IMAGES / f"{name}.png", optimize=True)


def drawings() -> None:
    """The drawings, letters as outlines: they are read on screens without our fonts."""
    for draw in (*DIAGRAMS, *SHAPES):
        buffer = io.StringIO()
        with settings(), matplotlib.rc_context({"svg.fonttype": "path"}):
            draw().savefig(buffer, format="svg", metadata={"Date": None})
        name = draw.__name__.replace("_", "-")
        # Lines without blanks at their ends, as in any text that is kept.
        lines = (line.rstrip() for line in buffer.getvalue().splitlines())
        (IMAGES / f"{name}.svg").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    flight()
    study()
    drawings()
