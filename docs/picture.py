"""Draw the pictures of README and documents into docs/images: `python docs/picture.py`, or `make docs`."""

import io
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib
from diagrams import DIAGRAMS
from PIL import Image

import rigidfleet as rf
from rigidfleet.figures.style import settings

IMAGES = Path(__file__).parent / "images"
MISSION = "narrow-passage"


def flight() -> None:
    """The README's picture, with few colours, as everybody loads it."""
    result = rf.simulate(rf.load_mission(MISSION))
    with TemporaryDirectory() as folder:
        (path,) = rf.plot(result, folder, formats=["png"], names=["summary"])
        # A palette makes a third of the size; without refining it (kmeans), greys come out tinted.
        picture = Image.open(path).convert("RGB").quantize(256, kmeans=5, dither=Image.Dither.NONE)
    picture.save(IMAGES / f"{MISSION}.png", optimize=True)


def drawings() -> None:
    """The drawings, letters as outlines: they are read on screens without our fonts."""
    for draw in DIAGRAMS:
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
    drawings()
