"""Graphs of a mission's formations before it flies: redundant edges dashed, free motions as arrows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.formation import distance_geometry
from rigidfleet.plotting import sketches, space
from rigidfleet.plotting import style as st
from rigidfleet.result.lights import seen_from

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rigidfleet.mission import Mission
    from rigidfleet.rigidity import Rigidity

_FORMATS = (".png", ".svg", ".pdf")
#: The longest arrow of a free motion, relative to the size of the shape.
_ARROW = 0.35
#: Greatest number of free motions drawn in one picture; more would hide each other.
_DRAWN = 3


def graphs(mission: Mission, judged: Mapping[str, Rigidity | None]) -> Figure:
    """Graph of each formation with its rigidity; arrows show the first free motions, each in a tone of its own."""
    names = list(mission.formations)
    with st.settings():
        fig, rects = sketches.tiled_figure(len(names), 3.6, 0.4, (0.1, 0.2))
        for (x, y, width, height), name in zip(rects, names, strict=True):
            ax = fig.add_axes((x + 0.04 * width, y, 0.92 * width, 0.8 * height))
            _draw_formation(ax, mission, name, judged.get(name))
    return fig


def draw_graphs(mission: Mission, judged: Mapping[str, Rigidity | None], path: Path) -> None:
    """Write `graphs` to a file, completely or not at all.

    Raises
    ------
    ResultError
        The file's name does not end in .png, .svg or .pdf, or it cannot be written.
    """
    from rigidfleet.errors import ResultError
    from rigidfleet.plotting import encode_figure, write

    if path.suffix not in _FORMATS:
        known = ", ".join(_FORMATS)
        raise ResultError(
            f"{path}: the name has no figure format. Give a name that ends in {known}."
        )
    (drawn,) = encode_figure(graphs(mission, judged), [path.suffix[1:]]).values()
    write(path, drawn)


def _draw_formation(ax: Axes, mission: Mission, name: str, rigidity: Rigidity | None) -> None:
    p, placed = sketches.sketch_places(mission, name)
    p = p - p.mean(axis=0)
    edges, lengths = mission.formation_edges(name), mission.formation_distances(name)
    extent = float(np.ptp(p)) or 1.0
    flat = distance_geometry.dimension(p, 1e-3) < 3 and float(np.ptp(p[:, 2])) < 1e-3 * extent
    sideways = flat and rigidity is not None and any(f.motion[:, 2].any() for f in rigidity.flexes)
    R = np.eye(3) if flat and not sideways else space.camera(-70.0, 30.0 if flat else 16.0)
    lit = mission.formation_colours(name)
    R = R if lit is None else space.camera(*np.degrees(seen_from(p)))
    redundant = set() if rigidity is None else set(rigidity.redundant.tolist())
    colours = [st.FLOWN if k in redundant else st.GREY for k in range(len(edges))]
    dashed = [k in redundant for k in range(len(edges))]
    few = len(edges) <= 12
    sketches.draw_graph(
        ax, p @ R.T, edges, colours, lengths if few else None, dashed=dashed, lights=lit
    )
    caption = f"{len(edges)} edges" + ("" if placed else "; their distances fix no positions")
    if rigidity is not None:
        caption = f"{rigidity.rigidity_class}, rank {rigidity.rank} of {rigidity.needed}, {caption}"
        caption += f", {len(redundant)} redundant" if redundant else ""
        _draw_free_motions(ax, p, R, rigidity)
    ax.set_title(f"{st.clean_name(name)}\n", fontweight="bold", parse_math=False)
    ax.text(
        0.5,
        1.02,
        caption,
        transform=ax.transAxes,
        ha="center",
        va="bottom",
        fontsize=7,
        color=st.GREY,
    )


def _draw_free_motions(ax: Axes, p: Any, R: Any, rigidity: Rigidity) -> None:
    """Draw free motions, seen along the last row of R (3, 3)."""
    size = float(np.linalg.norm(p, axis=1).max()) or 1.0
    tones = (st.ALERT, st.PALETTE[0], st.PALETTE[2])
    for n, flex in enumerate(rigidity.flexes[:_DRAWN]):
        step = flex.motion * (_ARROW * size / np.linalg.norm(flex.motion, axis=1).max())
        begin, end = p @ R.T, (p + step) @ R.T
        for i in flex.agents:
            if np.linalg.norm((end - begin)[i, :2]) < 0.1 * size:
                continue
            arrow = {
                "arrowstyle": "-|>", "color": tones[n], "linewidth": 1.4, "shrinkA": 0,
                "gid": f"flex-{n + 1}-{i + 1}",
            }  # fmt: skip
            ax.annotate(
                "", end[i, :2], begin[i, :2], arrowprops=arrow, zorder=4, annotation_clip=False
            )
