"""Draw the README's moving picture from a flight: `python docs/moving.py` writes docs/images/narrow-passage.gif.

On the left stands the whole flight, on the right the formation from above, cut at its own height, as it comes to the
gap. `make docs` leaves the picture alone: a GIF has no two versions that look the same to the byte.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from PIL import Image
from scipy.spatial import KDTree

import rigidfleet as rf
from rigidfleet.plotting.style import FAINT, GREY, INK, agent_colours, apply_style
from rigidfleet.result.lights import camera_axes

IMAGE = Path(__file__).parent / "images" / "narrow-passage.gif"
MISSION, END = "narrow-passage", 85.0  # [s]
#: Seconds of flight in a second of film, pictures in a second, and how long the last one stays [ms].
SPEED, RATE, LAST = 6.0, 12.5, 1600
SIZE, DPI, COLOURS = (8.6, 4.3), 100, 128
AZIMUTH, ELEVATION = -60.0, 32.0  # of the eye [deg]
FADED = (0.75, 0.45)  # shares of a colour: of ways, and of what is behind a box
TRAIL = 8.0  # [s] of each way
REACH = 8.0  # [m] to be seen around the centre from above
GROUND, SIDE, DARK, TOP = "#ECEEF0", "#C9C7C1", "#B7B4AD", "#DEDCD6"


def hidden(points: np.ndarray, boxes: list[Any], towards: np.ndarray) -> np.ndarray:
    """Whether a box stands between each of the points (n, 3) and the eye."""
    found = np.zeros(len(points), dtype=bool)
    for box in boxes:
        with np.errstate(divide="ignore"):
            ends = np.stack([(np.array(c) - points) / towards for c in (box.min, box.max)])
        found |= np.maximum(ends.min(axis=0).max(axis=1), 0.0) < ends.max(axis=0).min(axis=1)
    return found


def faces(box: Any, axes: np.ndarray) -> list[tuple[np.ndarray, str]]:
    """The faces of a box that the eye sees, in the picture, with their tones."""
    low, high = np.array(box.min), np.array(box.max)
    seen = []
    for axis, tone in ((0, DARK), (1, SIDE), (2, TOP)):
        corner = np.tile(low, (4, 1))
        a, b = (k for k in range(3) if k != axis)
        corner[[1, 2], a], corner[[2, 3], b] = high[a], high[b]
        corner[:, axis] = high[axis] if axes[2, axis] > 0 else low[axis]
        seen.append((corner @ axes[:2].T, tone))
    return seen


class Film:
    """A figure whose moving parts are set for one time after the other."""

    def __init__(self, result: rf.Result) -> None:
        self.result = result
        self.axes3 = camera_axes(*np.radians([AZIMUTH, ELEVATION]))
        self.boxes = [o for o in result.mission.obstacles if o.kind == "box"]
        self.colours = agent_colours(result.n_agents)
        self.figure = Figure(figsize=SIZE, dpi=DPI)
        self.whole = self.figure.add_axes((0.0, 0.02, 0.6, 0.96))
        self.near = self.figure.add_axes((0.615, 0.055, 0.37, 0.74))
        self._still()
        look: dict[str, Any] = {"zorder": 20}
        self.trails = [self.whole.plot([], [], color=c, lw=1.5, **look)[0] for c in self.colours]
        self.shape: Any = self.whole.add_collection(
            LineCollection([], colors=INK, lw=1.0, zorder=21)
        )
        self.dots = self.whole.scatter([], [], s=22, zorder=22, linewidths=0)
        self.walls: list[Any] = [
            self.near.add_patch(Rectangle((0, 0), 0, 0, facecolor=SIDE, edgecolor=GREY, lw=0.8))
            for _ in self.boxes
        ]
        self.edges: Any = self.near.add_collection(LineCollection([], colors=INK, lw=1.6, zorder=5))
        self.ways = [
            self.near.plot([], [], color=mixed(c, FADED[1]), lw=1.4)[0] for c in self.colours
        ]
        self.bodies: list[list[Any]] = [
            [self.near.add_patch(Circle((0, 0), 0.26, color=c, zorder=6)) for _ in range(4)]
            for c in self.colours
        ]
        self.arms: Any = self.near.add_collection(LineCollection([], colors=INK, lw=1.6, zorder=7))
        self.clock = self.figure.text(0.975, 0.93, "", ha="right", fontsize=11, color=GREY)
        self.words = self.figure.text(0.617, 0.86, "", fontsize=13, weight="bold", color=INK)

    def _still(self) -> None:
        """What does not move: ground, boxes, the way of the centre of mass, names."""
        P = self.axes3[:2]
        for x in range(-20, 101, 10):
            self.whole.plot(*(np.array([[x, -50, 0], [x, 150, 0]]) @ P.T).T, color=GROUND, lw=1)
        for y in range(-50, 151, 10):
            self.whole.plot(*(np.array([[-20, y, 0], [100, y, 0]]) @ P.T).T, color=GROUND, lw=1)
        shadow = self.result.cm * [1, 1, 0]
        self.whole.plot(*(shadow @ P.T).T, color=FAINT, lw=1.2)
        far = sorted(self.boxes, key=lambda box: (np.array(box.min) + box.max) @ self.axes3[2])
        for n, box in enumerate(far):
            drawn = faces(box, self.axes3)
            self.whole.add_collection(
                PolyCollection(
                    [face for face, _ in drawn], facecolors=[tone for _, tone in drawn],
                    edgecolors="white", lw=0.6, zorder=3 + n,
                )
            )  # fmt: skip
        corners = [c for box in self.boxes for face, _ in faces(box, self.axes3) for c in face]
        seen = np.concatenate([corners, self.result.position.reshape(-1, 3) @ P.T])
        (left, low), (right, high) = seen.min(axis=0), seen.max(axis=0)
        self.whole.set(xlim=(left - 2, right + 2), ylim=(low - 2, high + 2), aspect="equal")
        self.whole.set_axis_off()
        self.near.set(xticks=[], yticks=[], aspect="equal")
        self.near.spines[:].set(visible=True, color=FAINT)
        self.near.set_facecolor("#F7F8F9")
        self.figure.text(0.617, 0.93, "three vehicles, one body", fontsize=11, color=GREY)

    def show(self, t: float) -> None:
        """Set everything for a time [s]."""
        r, time = self.result, self.result.time
        k = int(np.searchsorted(time, t, side="right")) - 1
        since = int(np.searchsorted(time, t - TRAIL))
        at, centre, P = r.position[k], r.cm[k], self.axes3[:2]
        faint = hidden(at, self.boxes, self.axes3[2])
        flat = at @ P.T
        for i, trail in enumerate(self.trails):
            trail.set_data(*(r.position[since : k + 1, i] @ P.T).T)
            trail.set_color(mixed(self.colours[i], FADED[int(faint[i])]))
            self.ways[i].set_data(*r.position[since : k + 1, i, :2].T)
        held = r.edges[np.isfinite(r.constraint[k])]
        self.shape.set_segments(list(flat[held]))
        self.shape.set_color(GREY if faint.any() else INK)
        self.dots.set_offsets(flat)
        self.dots.set_facecolor(
            [mixed(c, FADED[1] if f else 1.0) for c, f in zip(self.colours, faint, strict=True)]
        )
        self.near.set(
            xlim=centre[0] + REACH * np.array([-1, 1]), ylim=centre[1] + REACH * np.array([-1, 1])
        )
        for wall, box in zip(self.walls, self.boxes, strict=True):
            wall.set_bounds(*box.min[:2], box.max[0] - box.min[0], box.max[1] - box.min[1])
            wall.set_visible(box.min[2] <= centre[2] <= box.max[2])
        self.edges.set_segments(list(at[held][..., :2]))
        turned = np.arctan2(*self._ahead(k)[::-1])
        arms = []
        for body, (x, y) in zip(self.bodies, at[:, :2], strict=True):
            rotors = [turned + np.pi / 4 + n * np.pi / 2 for n in range(4)]
            places = [(x + 0.42 * np.cos(a), y + 0.42 * np.sin(a)) for a in rotors]
            for rotor, place in zip(body, places, strict=True):
                rotor.set_center(place)
            arms += [[places[0], places[2]], [places[1], places[3]]]
        self.arms.set_segments(arms)
        self.words.set_text(r.phases[int(r.phase[k])].name)
        self.clock.set_text(f"{t:.0f} s")

    def _ahead(self, k: int) -> np.ndarray:
        """Where the formation's own x axis points in the plane, (2,)."""
        q = self.result.attitude[k]
        if not np.isfinite(q).all():
            return np.array([1.0, 0.0])
        w, x, y, z = q
        return np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)])

    def picture(self) -> Image.Image:
        """What is set, as pixels."""
        buffer = io.BytesIO()
        self.figure.savefig(buffer, format="png", dpi=DPI)
        return Image.open(buffer).convert("RGB")


def mixed(colour: str, share: float) -> np.ndarray:
    """A colour on white, (3,) from 0 to 1: a share of it, without a veil, which a palette would blur."""
    return 1.0 - share * (1.0 - np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]))


def reduced(picture: Image.Image, palette: np.ndarray) -> Image.Image:
    """A picture in the nearest colours of a palette (n, 3)."""
    colours, place = np.unique(np.asarray(picture).reshape(-1, 3), axis=0, return_inverse=True)
    nearest = KDTree(palette).query(colours)[1].astype(np.uint8)
    found = Image.fromarray(nearest[place].reshape(picture.height, picture.width), "P")
    found.putpalette(palette.tobytes())
    return found


def main() -> None:
    """Fly, draw, write."""
    with apply_style():
        film = Film(rf.simulate(MISSION))
        pictures = []
        for t in np.arange(0.0, END, SPEED / RATE):
            film.show(float(t))
            pictures.append(film.picture())
    # One palette for all, of pictures from everywhere: colours that change would flicker.
    some = pictures[:: max(1, len(pictures) // 6)]
    strip = Image.new("RGB", (some[0].width, some[0].height * len(some)))
    for n, picture in enumerate(some):
        strip.paste(picture, (0, n * picture.height))
    common = strip.quantize(COLOURS, kmeans=3, dither=Image.Dither.NONE).getpalette()
    # Those that must not be missed, as they are: white, which is a page's, and the vehicles'.
    own = [mixed(c, share) for c in film.colours for share in (0.0, *FADED, 1.0)]
    palette = np.concatenate([np.reshape(common, (-1, 3))[:COLOURS], np.round(255 * np.array(own))])
    frames = [reduced(picture, palette.astype(np.uint8)) for picture in pictures]
    step = round(1000 / RATE)
    frames[0].save(
        IMAGE, save_all=True, append_images=frames[1:], loop=0, optimize=True,
        duration=[step] * (len(frames) - 1) + [LAST],
    )  # fmt: skip
    print(f"{IMAGE}: {len(frames)} pictures, {IMAGE.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
