"""Pictures of a flight, drawn with matplotlib from its `Result` alone.

`plot` writes figures to files, or returns them. Each function with the name of a figure returns it as a
matplotlib `Figure`, which can be changed, or shown by a notebook. An agent has the same colour in all figures
(`agent_colours`); the colours are distinct to colour-blind readers, too. Nothing here changes pyplot or the
user's matplotlib settings.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from rigidfleet._common.arguments import as_path
from rigidfleet._common.files import write_file
from rigidfleet.plotting.curves import (
    attitude,
    clearance,
    cm,
    constraint_error,
    constraint_force,
    distances,
    disturbance,
    inputs,
    motion,
)
from rigidfleet.plotting.logged import plan_and_flight
from rigidfleet.plotting.messages import messages
from rigidfleet.plotting.operation import operation
from rigidfleet.plotting.page import summary
from rigidfleet.plotting.quadrotors import rotors, vehicles
from rigidfleet.plotting.sketches import formations
from rigidfleet.plotting.space import trajectory
from rigidfleet.plotting.style import agent_colours, apply_style, figure_options
from rigidfleet.result import Result, as_result

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

__all__ = [
    "FORMATS",
    "Figures",
    "agent_colours",
    "attitude",
    "clearance",
    "cm",
    "constraint_error",
    "constraint_force",
    "distances",
    "disturbance",
    "figure_names",
    "formations",
    "inputs",
    "messages",
    "motion",
    "operation",
    "plan_and_flight",
    "plot",
    "rotors",
    "summary",
    "trajectory",
    "vehicles",
]

_FIGURES: dict[str, Callable[[Result], Figure]] = {
    draw.__name__: draw
    for draw in (
        summary, trajectory, distances, cm, attitude, inputs, constraint_force, constraint_error,
        clearance, formations, disturbance, rotors, vehicles, operation, motion,
        messages, plan_and_flight,
    )
}  # fmt: skip
#: File formats of figures.
FORMATS = ("png", "svg", "pdf")
#: How each is saved: without a date, so that the same flight gives the same file, and PNG compressed quickly.
_OPTIONS: dict[str, dict[str, Any]] = {
    "png": {"pil_kwargs": {"compress_level": 3}},
    "svg": {"metadata": {"Date": None}},
    "pdf": {"metadata": {"CreationDate": None}},
}
#: Least and greatest width of a figure [mm].
WIDTHS = (80.0, 400.0)
_MARGIN = 0.05  # [in] around a figure cropped to its content


def figure_names(result: Result | None = None) -> list[str]:
    """Names of all figures; the functions that draw them have the same names.

    With a result, only the figures in which it has something to show.
    """
    if result is None:
        return list(_FIGURES)
    return [name for name, draw in _FIGURES.items() if vars(draw)["there"](result)]


def caption(name: str) -> str:
    """What a figure shows, in the sentence with which the function that draws it begins."""
    return (_FIGURES[name].__doc__ or "").split("\n")[0]


class Figures(list["Figure"]):
    """Figures of a flight, which a notebook shows one below the other."""

    def _ipython_display_(self) -> None:
        from IPython.display import display  # IPython is there, as it makes this call

        for figure in self:
            display(figure)


@overload
def plot(
    result: Result | str | Path,
    folder: None = None,
    *,
    names: Iterable[str] | None = None,
    titles: bool = True,
    width: float | None = None,
) -> Figures: ...


@overload
def plot(
    result: Result | str | Path,
    folder: str | Path,
    *,
    formats: Iterable[str] = ("png", "svg"),
    names: Iterable[str] | None = None,
    titles: bool = True,
    width: float | None = None,
) -> list[Path]: ...


def plot(
    result: Result | str | Path,
    folder: str | Path | None = None,
    *,
    formats: Iterable[str] = ("png", "svg"),
    names: Iterable[str] | None = None,
    titles: bool = True,
    width: float | None = None,
) -> Figures | list[Path]:
    """Draw a flight, for a notebook or as files ``folder/NAME.FORMAT``; each file is written completely or not at all.

    Parameters
    ----------
    result : a flight, or the path of a saved one
    folder : created if it does not exist; existing files are replaced. Without a folder, nothing is written
    formats : of png, svg (text stays text) and pdf
    names : figures to draw, from `figure_names`; by default all in which there is something to draw
    titles : whether a title and the mission's name stand above each figure. Without them, the figure is cropped
        to its content, for a paper with its own captions; a note that the flight is incomplete is always shown
    width : width of the figures [mm], 80 to 400, such as 88 for one column of a paper; letters keep their size. Those
        of `summary` and `formations` have a width of their own

    Returns
    -------
    The files written; without a folder, the figures, which a notebook shows.

    Raises
    ------
    ValueError
        A format or a name is unknown, or the width is out of its range.
    ResultError
        A file cannot be written, or the result or the mission inside it cannot be read.
    TypeError
        ``result`` is neither a flight nor a path.
    """
    result = as_result(result)
    target = None if folder is None else as_path(folder)
    formats = _check_names("format", formats, FORMATS)
    names = _check_names("figure", figure_names(result) if names is None else names, _FIGURES)
    look: dict[str, Any] = {"titles": titles, "width": width}
    if target is None:
        return Figures(_draw_figure(result, name, **look) for name in names)
    paths = []
    for name in names:
        paths += write_files(target / name, render_figure(result, name, formats, **look))
    return paths


def _draw_figure(
    result: Result, name: str, *, titles: bool = True, width: float | None = None
) -> Figure:
    if width is not None and not WIDTHS[0] <= width <= WIDTHS[1]:
        raise ValueError(f"the width must be {WIDTHS[0]:g} to {WIDTHS[1]:g} mm, not {width:g}")
    with figure_options(titles=titles, width=width):
        return _FIGURES[name](result)


def render_figure(
    result: Result, name: str, formats: Iterable[str], **look: Any
) -> dict[str, bytes]:
    """Contents of a figure's files by format; parameters are those of `plot`."""
    figure = _draw_figure(result, name, **look)
    return encode_figure(figure, formats, close=not look.get("titles", True))


def encode_figure(
    figure: Figure, formats: Iterable[str], *, close: bool = False
) -> dict[str, bytes]:
    """Contents of a figure's files by format; with ``close``, cropped to what is drawn."""
    files = {}
    with apply_style():
        box = _content_box(figure) if close else None
        for kind in formats:
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, bbox_inches=box, **_OPTIONS[kind])
            files[kind] = buffer.getvalue()
    return files


def _check_names(what: str, names: Iterable[str], known: Iterable[str]) -> list[str]:
    names = [names] if isinstance(names, str) else list(dict.fromkeys(names))
    for name in names:
        if name not in known:
            raise ValueError(f"there is no {what} {name!r}; known: {', '.join(known)}")
    return names


def _content_box(figure: Figure) -> Bbox:
    """Bounding box of the drawn content, with a margin [in]; matplotlib's own box includes empty axes."""
    from matplotlib.transforms import Bbox

    buffer = io.BytesIO()
    figure.savefig(buffer, format="rgba", dpi=figure.dpi)
    width, height = figure.canvas.get_width_height()
    colours = np.frombuffer(buffer.getvalue(), np.uint8).reshape(height, width, 4)
    drawn = colours.min(axis=2) < 255
    across, down = (np.flatnonzero(np.any(drawn, axis=axis)) for axis in (0, 1))
    ends = [[across[0], height - down[-1] - 1], [across[-1] + 1, height - down[0]]]
    return Bbox(np.array(ends) / figure.dpi).padded(_MARGIN)


def write_files(path: Path, drawn: Mapping[str, bytes]) -> list[Path]:
    """Write a figure's files, PATH.FORMAT, and return them; where nothing is drawn, remove those of an earlier figure.

    Raises
    ------
    ResultError
        A file cannot be written.
    """
    paths = {kind: path.with_name(f"{path.name}.{kind}") for kind in drawn or FORMATS}
    for kind, there in paths.items():
        if drawn:
            write_file(there, drawn[kind], parents=True)
        else:
            there.unlink(missing_ok=True)
    return list(paths.values()) if drawn else []
