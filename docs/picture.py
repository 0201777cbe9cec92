"""Draw the picture of the README: `python docs/picture.py`."""

from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

import rigidfleet as rf

MISSION = "narrow-passage"

if __name__ == "__main__":
    result = rf.simulate(rf.load_mission(MISSION))
    with TemporaryDirectory() as folder:
        (path,) = rf.plot(result, folder, formats=["png"], names=["summary"])
        # A palette makes a third of the size; without refining it (kmeans), greys come out tinted.
        picture = Image.open(path).convert("RGB").quantize(256, kmeans=5, dither=Image.Dither.NONE)
    target = Path(__file__).parent / "images" / f"{MISSION}.png"
    target.parent.mkdir(exist_ok=True)
    picture.save(target, optimize=True)
    print(f"{target}: {target.stat().st_size / 1000:.0f} kB")
