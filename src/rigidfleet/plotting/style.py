"""The common style of all figures: colours, fonts, phases along the time axis, lines, legends."""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.result import PhaseRecord, Result
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.text import Text

Draw = Callable[..., "Figure"]

#: Colours of the first twelve agents: those of Okabe and Ito's set that stand out on white, then colours as
#: distinct from these as possible, to normal and to colour-blind vision.
PALETTE = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9",
    "#882255", "#332288", "#999933", "#117733", "#8B0000", "#1A1A1A",
)  # fmt: skip
INK, GREY, FAINT = "#222222", "#6B6B6B", "#B5B5B5"
#: Colour of the formation as a whole, and of its three components, dark to light.
FLOWN = "#8FA3B8"
TONES = ("#1F2A36", "#66798D", "#A9B8C6")
BAND = "#F1F3F5"
DASHES = (0, (4, 2.5))
REFERENCE: dict[str, Any] = {"color": INK, "linewidth": 0.8, "linestyle": DASHES}
ALERT = "#B00020"
#: Background of lights.
NIGHT = "#0B0E16"

FIGURE_WIDTH = 9.0  # width of a figure over time [in]
_COLUMN = 5.5  # a figure that is narrower has one column of axes [in]
_PAD = 0.07  # margin around the content [in]
_DPI = 160  # resolution [pixels per inch]: also of measures, so that a text is measured once
_LETTERS = 19  # of words above an axes in an inch of its width
_LONGEST = 28  # greatest length of a phase name
#: Number of agents or edges beyond which the spread is drawn instead of each line.
MANY = 200
_ENTRIES = 12  # greatest number of entries of a legend
#: Least variation that is drawn; a smaller one is given in words, as rounding errors would fill the axes.
#: [m, m/s, deg, deg/s, N]
STILL = 1e-3
_ROUNDING = 1e-9  # smaller deviations are not mentioned

#: Whether figures have titles, and their width [mm]; None for the usual one.
_shape: ContextVar[tuple[bool, float | None]] = ContextVar("shape", default=(True, None))

#: What the style sheet leaves to this file.
_SHARED: dict[str, Any] = {
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor"), INK),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), GREY),
    **dict.fromkeys(("figure.dpi", "savefig.dpi"), _DPI),
    **dict.fromkeys(("figure.constrained_layout.w_pad", "figure.constrained_layout.h_pad"), _PAD),
}


@contextmanager
def apply_style() -> Generator[None]:
    """Apply matplotlib's defaults and our style, whatever the user has set; restored at the end."""
    import matplotlib as mpl

    # As `matplotlib.style` does, which loads all styles first
    sheet: Any = mpl.rc_params_from_file(Path(__file__).with_name("rigidfleet.mplstyle"))
    look: Any = {key: value for key, value in sheet.items() if key != "backend"} | _SHARED
    with mpl.rc_context(look), warnings.catch_warnings():
        # Letters that the font lacks show as boxes in a PNG, and correctly in an SVG.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def styled_figure(
    there: Callable[[Result], object] = bool, nothing: str = ""
) -> Callable[[Draw], Draw]:
    """Draw a figure in our style; where what it shows is not there, say that there is ``nothing``, if that is given."""

    def decorate(draw: Draw) -> Draw:
        @wraps(draw)
        def draw_in_style(result: Result, *more: Any, **named: Any) -> Figure:
            with apply_style():
                if there(result) or not nothing:
                    return draw(result, *more, **named)
                name = getattr(draw, "__name__", "").replace("_", " ")
                fig, axes = time_figure(result, name.capitalize(), 1)
                mark_empty(axes[0], nothing)
                return fig

        vars(draw_in_style)["there"] = there
        return draw_in_style

    return decorate


@contextmanager
def figure_options(*, titles: bool = True, width: float | None = None) -> Generator[None]:
    """Draw figures in this context with a title and the mission's name, or without both; of another width [mm]."""
    before = _shape.set((titles, width))
    try:
        yield
    finally:
        _shape.reset(before)


def figure_width(usual: float) -> float:
    """Width of a figure [in]: the one that is wanted, or the usual one."""
    wanted = _shape.get()[1]
    return usual if wanted is None else wanted / 25.4


def is_narrow() -> bool:
    """Whether figures are to fit one column of a page."""
    return figure_width(FIGURE_WIDTH) < _COLUMN


def agent_colours(n: int) -> list[str]:
    """Colour of each of n agents ("#rrggbb"), the same in all figures, distinct to colour-blind readers.

    Up to twelve agents have colours of their own; more agents have colours along viridis, by number.
    """
    return list(PALETTE[:n]) if n <= len(PALETTE) else colour_scale(n)


def colour_scale(n: int) -> list[str]:
    """n colours from dark to light, in an order that colour-blind readers can see."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(c) for c in colormaps["viridis"](np.linspace(0.0, 0.82, n))]


# -- figures over time -------------------------------------------------------------------------------


def blank_figure(wide: float, high: float, layout: Any = None) -> Figure:
    """An empty figure of a width and a height [in], which is drawn in our style."""
    from rigidfleet.plotting.figure import Figure

    fig = Figure(figsize=(wide, high), layout=layout)
    fig.settings = apply_style
    return fig


def time_figure(
    result: Result,
    title: str,
    rows: int,
    columns: int = 1,
    height: float = 2.1,
    shares: Sequence[float] | None = None,
) -> tuple[Figure, Any]:
    """Figure with axes that share time; `height` of a row [in], scaled by its share.

    The axes are an object array (rows,), or (rows, columns) if there are several columns.
    """
    shares = [1.0] * rows if shares is None else shares
    # The second column then stands below the first.
    stacked = (columns, rows) if is_narrow() else None
    if stacked:
        rows, columns, shares = rows * columns, 1, list(shares) * columns
    whole = 1.3 + height * sum(shares)
    fig = blank_figure(figure_width(FIGURE_WIDTH), whole, "constrained")
    # Nearly the heights that the axes will have, as the number of their ticks depends on it
    inside = whole - 1.2 - 2 * _PAD * (rows - 1)
    grid = {"bottom": 0.5 / whole, "top": 1 - 0.7 / whole, "hspace": 2 * _PAD * rows / inside}
    axes = fig.subplots(
        rows, columns, sharex=True, squeeze=False, height_ratios=shares, gridspec_kw=grid
    )
    draw_flight_heading(fig, result, title)
    for ax in axes.flat:
        draw_time_axis(ax, result)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    axes = axes.reshape(stacked).T if stacked else axes
    _name_phases(axes[0], result)
    return fig, axes if axes.shape[1] > 1 else axes[:, 0]


def phase_targets(result: Result) -> list[tuple[PhaseRecord, dict[str, Any]]]:
    """All that phases are to reach: points to pass on the way, and the target at the end."""
    reached = ((p, p.target) for p in result.phases if p.target is not None)
    return [(p, at) for p, target in reached for at in (*target.get("through", ()), target)]


def draw_flight_heading(fig: Figure, result: Result, title: str) -> None:
    """Title at the left; at the right, the mission and, if the flight is incomplete, when it stopped."""
    words, colour = result.mission.name, GREY
    if not result.complete:
        words, colour = f"{words}: incomplete, stopped at {result.phases[-1].t_end:.2f} s", ALERT
    draw_heading(fig, title, words, colour)


def draw_heading(fig: Figure, title: str, words: str, colour: str = GREY) -> None:
    """Title at the left, text at the right; without titles, only a warning text."""
    top, titles = 1 - _PAD / fig.get_figheight(), _shape.get()[0]
    look: dict[str, Any] = {"va": "top", "parse_math": False}
    beside: dict[str, Any] = look | {"ha": "right", "fontsize": 9, "color": colour}
    if titles:
        title = textwrap.fill(title, int(9 * fig.get_figwidth()))
        above = fig.suptitle(title, x=0.012, ha="left", fontsize=11, fontweight="bold", **look)
        if colour == ALERT or not is_narrow():
            fig.text(0.988, top, words, **beside)
    elif colour == ALERT:
        above = fig.suptitle(words, x=0.988, **beside)
    else:
        return
    if fig.get_layout_engine() is None:  # a layout engine places it itself, clear of the axes
        above.set_y(top)


def draw_time_axis(ax: Axes, result: Result) -> None:
    """Time axis with every second phase shaded."""
    t = result.time
    ax.set_xlim(t[0], t[-1] if t[-1] > t[0] else t[0] + 1.0)
    for phase in result.phases[1::2]:
        ax.axvspan(phase.t_start, phase.t_end, facecolor=BAND, linewidth=0, zorder=0)
    if not result.complete:
        ax.axvline(t[-1], color=ALERT, linewidth=0.8)


def legend_entry(label: str, **look: Any) -> Line2D:
    """What a legend has of a line that looks so."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **look)


def marker_look(
    colour: str, size: float, *, hollow: bool = False, marker: str = "o"
) -> dict[str, Any]:
    """Look of a marker of a size [points], filled or hollow."""
    return {
        "linestyle": "", "marker": marker, "markersize": size,
        "markerfacecolor": "white" if hollow else colour,
        "markeredgecolor": colour, "markeredgewidth": 1.2 if hollow else 0.0,
    }  # fmt: skip


def draw_reference(ax: Axes, t: Floats, y: Floats) -> None:
    """Draw a reference as a dashed line."""
    ax.plot(t, y, **REFERENCE, zorder=3)


def draw_limit(ax: Axes, value: float, label: str, colour: str = ALERT) -> None:
    """Draw a limit as a line with its name."""
    ax.axhline(value, color=colour, linewidth=1.0, linestyle=(0, (6, 2)), zorder=2.5, gid="limit")
    write_above(ax, label)


# -- words about what is drawn ------------------------------------------------------------------------


def write_above(ax: Axes, words: str, colour: str = INK) -> None:
    """Write words above an axes, where they cover nothing, behind those that stand there."""
    before = ax.get_title(loc="right").replace("\n", " ")
    whole = f"{before}  ·  {words}" if before else words
    letters = int(_LETTERS * ax.bbox.width / _DPI)
    over_phases = any(text.get_gid() == "phase" for text in ax.texts)
    ax.set_title(
        textwrap.fill(whole, letters, break_on_hyphens=False), loc="right", pad=17.0 if over_phases else 3.0,
        fontsize=7.5, color=colour, fontweight="normal", parse_math=False, gid="words",
    )  # fmt: skip


def note_if_constant(ax: Axes, values: Floats, unit: str) -> bool:
    """If values do not vary, write the value into the axes; return whether this is so."""
    known = values[np.isfinite(values)]
    if not len(known) or not is_constant(known):
        return False
    value = round(float(known.max() + known.min()) / 2, 3) + 0.0
    off = float(np.abs(known - value).max())
    caption = f"{value:.6g} {unit} throughout" + (f", within {off:.1g}" if off > _ROUNDING else "")
    ax.set_ylim(value - 1.0, value + 1.0)
    ax.set_yticks([value], [f"{value:.6g}"])
    ax.text(0.5, 0.7, caption, transform=ax.transAxes, ha="center", fontsize=7.5, color=GREY)
    return True


def is_constant(values: Floats) -> bool:
    """Whether all known values are the same, or none is known."""
    known = values[np.isfinite(values)]
    return not len(known) or float(np.ptp(known)) <= STILL


def mark_empty(ax: Axes, words: str) -> None:
    """Write text in an axes that has nothing to show."""
    ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center", color=GREY)
    ax.tick_params(left=False, labelleft=False)


def name_box(ax: Axes, box: Artist, x: float, y: float, name: str) -> None:
    """Write the name of a box above its lower edge, if it fits."""
    label = ax.text(
        x, y, clean_name(name, 20), fontsize=6.5, color=GREY, ha="center", va="bottom", zorder=1.5,
        parse_math=False, clip_on=True,
    )  # fmt: skip
    if label.get_window_extent().width > box.get_window_extent().width:
        label.remove()


def draw_spread(ax: Axes, t: Floats, values: Floats, colour: str) -> None:
    """Draw many values (K, n) as a band from least to greatest, a band of nine in ten, and their median."""
    known = np.isfinite(values).any(axis=1)
    if not known.any():
        return
    quantiles = np.full((5, len(t)), np.nan)
    quantiles[:, known] = np.nanquantile(values[known], [0.0, 0.05, 0.5, 0.95, 1.0], axis=1)
    least, low, middle, high, greatest = quantiles
    look: dict[str, Any] = {"color": colour, "linewidth": 0.0, "zorder": 2.0}
    ax.fill_between(t, least, greatest, alpha=0.25, **look, gid="spread")
    ax.fill_between(t, low, high, alpha=0.45, **look)
    ax.plot(t, middle, color=colour, linewidth=1.4, zorder=2.1)


def draw_agent_lines(ax: Axes, result: Result, values: Floats) -> None:
    """A line for each agent, values (K, N), in its colour; the first ones are widest, so that all are visible.

    For more than `MANY` agents, the spread is drawn.
    """
    n = result.n_agents
    if n > MANY:
        draw_spread(ax, result.time, values, FLOWN)
        return
    for i, colour in enumerate(agent_colours(n)):
        width = 1.0 + 1.6 * (n - 1 - i) / max(n - 1, 1)
        name = f"agent-{i + 1}"
        ax.plot(result.time, values[:, i], color=colour, linewidth=width, gid=name)


def agent_handles(n: int, **look: Any) -> list[Line2D]:
    """Legend entries of the agents: all of them, or some evenly spread ones."""
    colours, shown = agent_colours(n), spaced_indices(n, _ENTRIES if n <= MANY else 4)
    return [legend_entry(f"agent {i + 1}", color=colours[i], **look) for i in shown]


def draw_agents_legend(ax: Axes, n: int) -> None:
    """Legend of `draw_agent_lines`."""
    draw_legend(ax, agent_line_handles(n))


def agent_line_handles(n: int) -> list[Any]:
    """What a legend has of `draw_agent_lines`."""
    if n <= MANY:
        return agent_handles(n)
    from matplotlib.patches import Patch

    look: dict[str, Any] = {"color": FLOWN, "linewidth": 0}
    return [
        Patch(**look, alpha=0.25, label=f"all {n} agents"),
        Patch(**look, alpha=0.7, label="nine in ten"),
        legend_entry("median", color=FLOWN, linewidth=1.4),
    ]


def spaced_indices(n: int, most: int) -> list[int]:
    """Indices of n things, or of `most` evenly spread ones with both ends."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, most)).tolist()}) if n else []


def draw_legend(ax: Axes, handles: Sequence[Any], title: str = "") -> None:
    """Legend to the right of an axes, in a narrow figure below."""
    look: dict[str, Any] = {"bbox_to_anchor": (1.012, 1.0)}
    if is_narrow():  # clear of the numbers and the name of the time axis, which the last axes has
        last = (spec := ax.get_subplotspec()) is None or spec.is_last_row()
        look = {
            "bbox_to_anchor": (0, 0),
            "borderaxespad": 4.5 if last else 0.8,
            "ncols": legend_columns(handles),
        }
    ax.legend(
        handles=handles, loc="upper left", title=title or None, title_fontsize=8, alignment="left",
        labelspacing=0.3, **look,
    )  # fmt: skip


def legend_columns(handles: Sequence[Any]) -> int:
    """Number of columns of a legend below a figure over time, in which no entry is cut."""
    longest = max(len(str(h.get_label())) for h in handles)
    return max(int(16 * (figure_width(FIGURE_WIDTH) - 0.7)) // (longest + 7), 1)


# -- names of phases ---------------------------------------------------------------------------------


def clean_name(name: str, longest: int = _LONGEST) -> str:
    """A user's name as one printable line, shortened if it is long."""
    words = " ".join("".join(c if c.isprintable() else " " for c in name).split())
    return words if len(words) <= longest else words[: longest - 1].rstrip() + "…"


def _name_phases(axes: Sequence[Axes], result: Result) -> None:
    """Write the phases' names along the top of axes; if one is too long, their numbers, with a key below the figure.

    This comes before the layout, which makes room for the names: its width of the axes is estimated, with 20 % to spare
    for a legend beside them.
    """
    axes = axes[: 1 if is_narrow() else None]
    labels, over = [], 0.0
    for ax in axes:
        per_second = 0.8 * ax.bbox.width / float(np.diff(ax.get_xlim())[0])
        for name, start, end in _phase_spans_in_view(ax, result):
            labels.append(_label_phase(ax, clean_name(name, 60), start, end, fontsize=8))
            over = max(over, labels[-1].get_window_extent().width - per_second * (end - start))
    if not over:
        return
    for label in labels:
        label.remove()
    letters = int(14 * figure_width(FIGURE_WIDTH))
    key = textwrap.fill(number_phases(axes, result), letters, max_lines=5, placeholder=" …")
    axes[0].figure.supxlabel(key, fontsize=7.5, color=GREY, parse_math=False)


def _label_phase(ax: Axes, text: str, start: float, end: float, fontsize: float) -> Text:
    return ax.text(
        (start + end) / 2, 1.02, text, fontsize=fontsize, color=GREY, ha="center", va="bottom",
        transform=ax.get_xaxis_transform(), parse_math=False, gid="phase",
    )  # fmt: skip


def number_phases(axes: Iterable[Axes], result: Result) -> str:
    """Write the phases' numbers along the top of axes; return the key to them.

    A number that does not fit is left out.
    """
    for ax in axes:
        right = -math.inf
        for i, (_, start, end) in enumerate(_phase_spans_in_view(ax, result)):
            label = _label_phase(ax, str(i + 1), start, end, fontsize=6.5)
            box = label.get_window_extent()
            if box.x0 < right + 0.02 * _DPI:
                label.remove()
            else:
                right = box.x1
    # A line of the key breaks between names alone
    names = (f"{i + 1} {clean_name(name)}  ·" for i, name in enumerate(_short_phase_names(result)))
    return "Phases:  " + "  ".join(x.replace(" ", "\N{NO-BREAK SPACE}") for x in names)[:-3]


def _short_phase_names(result: Result) -> list[str]:
    """Names of the phases; a name by default, kind and number, without its number."""
    return [p.kind if p.name == f"{p.kind} {i}" else p.name for i, p in enumerate(result.phases, 1)]


def _phase_spans_in_view(ax: Axes, result: Result) -> list[tuple[str, float, float]]:
    """Name, start and end [s] of each phase that the axes show."""
    low, high = ax.get_xlim()
    return [
        (name, max(p.t_start, low), min(p.t_end, high))
        for name, p in zip(_short_phase_names(result), result.phases, strict=True)
        if p.t_start < high
    ]
