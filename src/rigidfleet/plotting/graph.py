"""Graphs of a mission's formations before it flies: redundant edges dashed, free motions as arrows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import sketches
from rigidfleet.plotting import style as st

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rigidfleet.mission import Mission
    from rigidfleet.rigidity import Rigidity

#: Greatest number of edges with their lengths.
_FEW = 12
#: The longest arrow of a free motion, relative to the size of the shape.
_ARROW = 0.35
#: Greatest number of free motions drawn in one picture; more would hide each other.
_DRAWN = 3


def formation_graphs_figure(mission: Mission, judged: Mapping[str, Rigidity | None]) -> Figure:
    """Graph of each formation with its rigidity; arrows show the first free motions, each in a tone of its own."""
    names = list(mission.formations)
    with st.apply_style():
        fig, axes = sketches.tiled_figure(len(names), 0.0, 0.1)
        for ax, name in zip(axes, names, strict=True):
            _draw_formation(ax, mission, name, judged.get(name))
    return fig


def draw_graphs(mission: Mission, judged: Mapping[str, Rigidity | None], path: Path) -> None:
    """Write `formation_graphs_figure` to a file, completely or not at all.

    Raises
    ------
    ResultError
        The file's name does not end in .png, .svg or .pdf, or it cannot be written.
    """
    from rigidfleet._common.files import write_file
    from rigidfleet.errors import ResultError
    from rigidfleet.plotting import FORMATS, encode_figure

    if path.suffix[1:] not in FORMATS:
        known = ", ".join(f".{kind}" for kind in FORMATS)
        raise ResultError(
            f"{path}: the name has no figure format. Give a name that ends in {known}."
        )
    (drawn,) = encode_figure(formation_graphs_figure(mission, judged), [path.suffix[1:]]).values()
    write_file(path, drawn, parents=True)


def _draw_formation(ax: Axes, mission: Mission, name: str, rigidity: Rigidity | None) -> None:
    redundant = set() if rigidity is None else set(rigidity.redundant.tolist())
    dashed = [k in redundant for k in range(len(mission.formation_edges(name)))]
    colours = [st.FLOWN if dash else st.GREY for dash in dashed]
    words = f"{len(dashed)} edges"
    if rigidity is not None:
        words = f"{rigidity.rigidity_class}, rank {rigidity.rank} of {rigidity.needed}, {words}"
        words += f",\n{len(redundant)} redundant" if redundant else ""
    sideways = rigidity is not None and any(f.motion[:, 2].any() for f in rigidity.flexes)
    look: dict[str, Any] = {"most": _FEW, "dashed": dashed, "sideways": sideways}
    drawn = sketches.draw_formation_sketch(ax, mission, name, colours, words, **look)
    if rigidity is not None:
        _draw_free_motions(ax, drawn.p, drawn.turn, rigidity)


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
