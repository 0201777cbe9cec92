"""Figures of a sweep: outcome, histograms, envelopes, drivers and a map over two varied numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet._common.quantities import QUANTITIES
from rigidfleet._common.text import agent_names
from rigidfleet.assessment import assess
from rigidfleet.errors import RigidfleetError
from rigidfleet.plotting import encode_figure, write_files
from rigidfleet.plotting import style as st
from rigidfleet.plotting.areas import draw_areas_from_above
from rigidfleet.sweep.dataset import unit_and_meaning
from rigidfleet.sweep.metrics import METRICS, readable_unit
from rigidfleet.sweep.record import reason_in_words
from rigidfleet.sweep.run import flight_with_fault
from rigidfleet.sweep.store import Table
from rigidfleet.sweep.summary import (
    Borne,
    correlations_by_strength,
    failure_counts,
    failure_rates,
    outcomes,
    varied_numbers,
    wilson_interval,
)
from rigidfleet.sweep.variation import Geomspace, LogUniform
from rigidfleet.typing import Floats, Ints

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


_PASS_COLOUR, _FAIL_COLOUR = "#56B4E9", "#D55E00"
#: Maximum number of columns of small axes.
_COLUMNS = 4
#: Number of bins of a histogram.
_BINS = 30
#: Maximum number of intervals of an envelope.
_ENVELOPE = 12
#: Greatest number of values along a side of a map that are all written.
_LABELS = 12
#: Number of cells along a side of a map of random numbers.
_CELLS = 10
#: Maximum number of distinct values with a cell each.
_VALUES = 20
#: Maximum number of varied numbers in the figure of drivers.
_ROWS = 14
#: How long before a failure the ways of those concerned are drawn [s], and the least half side of their map [m].
_WAY, _NEAR = 4.0, 3.0
_BOTH = np.array([-1.0, 1.0])
#: Ratio of the largest to the smallest value beyond which an axis is logarithmic.
_LOGARITHMIC = 100.0


def plot(
    table: Table,
    folder: str | Path,
    *,
    formats: Iterable[str] = ("png", "svg"),
    over: Sequence[str] = (),
    metric: str = "",
    titles: bool = True,
) -> list[Path]:
    """Draw the figures of a sweep to ``folder/NAME.FORMAT`` and return the paths of the files.

    Parameters
    ----------
    formats : any of png, svg and pdf
    over : the two paths on the axes of the map; default: the two with the strongest correlation
    metric : quantity of the map: success or one of `METRICS`; default: success if any run failed
    titles : True: a title and the name of the sweep above each figure; False: no titles and no margins

    Raises
    ------
    RigidfleetError
        The sweep has no such path or metric.
    ResultError
        A file cannot be written.
    """
    draw: dict[str, Callable[[Table], Figure | None]] = {
        "histograms": histograms,
        "envelopes": metrics_over_drivers,
        "outcome": success_over_runs,
        "drivers": correlations,
        "map": partial(map_over_two, over=over, metric=metric),
    }
    if table.sweep.drill is not None:
        draw = {"drill": drill_failure_figure, "worst": worst_runs_from_above}
    files = []
    for name, drawn in draw.items():
        with st.apply_style(), st.figure_options(titles=titles):
            figure = drawn(table)
        made = {} if figure is None else encode_figure(figure, formats, close=not titles)
        files += write_files(Path(folder, name), made)
    return files


def success_over_runs(table: Table) -> Figure | None:
    """Success rate over the number of runs, with its confidence interval, and the failures of each check."""
    if not len(table.run):
        return None
    reasons = failure_counts(table.reason)
    fig = _titled_figure(table, "Outcome", st.FIGURE_WIDTH, 2.9 + 0.14 * max(0, len(reasons) - 6))
    left, right = fig.subplots(1, 2, width_ratios=(3, 2))
    n = np.unique(np.geomspace(1, len(table.run), 200).astype(int))
    passed = np.cumsum(table.passed)[n - 1]
    low, high = wilson_interval(passed, n)
    left.fill_between(n, 100 * low, 100 * high, color=st.BAND, label="95 % interval")
    left.plot(n, 100 * passed / n, color=st.PALETTE[0])
    left.set(xlabel="runs", ylabel="passed [%]", ylim=(-3, 103))
    if len(table.run) > 1:
        left.set(xscale="log", xlim=(1, len(table.run)))
    left.set_title(
        f"{100 * passed[-1] / n[-1]:.3g} % passed, 95 % interval {100 * low[-1]:.3g} to {100 * high[-1]:.3g} %",
        loc="left",
    )
    right.set_title("failed checks", loc="left")
    if not reasons:
        st.mark_empty(right, "no run failed")
        right.grid(visible=False)
        right.tick_params(bottom=False, labelbottom=False)
        return fig
    names = [reason_in_words(reason) for reason in reasons]
    bars = right.barh(names, list(reasons.values()), color=_FAIL_COLOUR, height=0.65)
    right.bar_label(bars, padding=3, fontsize=8)
    right.grid(visible=False, axis="y")
    right.set(xlabel="runs")
    right.set_ylim(max(len(names), 4) - 0.5, -0.5)
    right.margins(x=0.15)
    return fig


def drill_failure_figure(table: Table) -> Figure | None:
    """Share of the runs of a drill that fail, over the magnitudes of each fault."""
    cases = failure_rates(table)
    if not cases:
        return None
    names = list(dict.fromkeys(case.fault for case in cases))
    fig, axes = _axes_for_metrics(table, "What the flight bears", names)
    for name, ax in zip(names, axes, strict=True):
        own = [case for case in cases if case.fault == name]
        failed = np.array([100.0 * case.failed.rate for case in own])
        labels = [f"{case.magnitude:g}\n{case.vehicles:,}" for case in own]
        x = range(len(own))
        ax.bar(x, failed, color=_FAIL_COLOUR, width=0.7)
        ax.bar(x, 100.0 - failed, bottom=failed, color=_PASS_COLOUR, width=0.7)
        ax.set_xticks(x, labels, fontsize=6.5)
        ax.set(xlim=(-0.6, max(len(own), 4) - 0.4), ylim=(0, 100))
        ax.grid(visible=False)
        unit = f" [{readable_unit(own[0].unit)}]" if own[0].unit else ""
        ax.set_title(f"{name}{unit}", loc="left", fontsize=8.5)
    for ax in axes[::_COLUMNS]:
        ax.set_ylabel("runs [%]")
    fig.supxlabel("magnitude, and to how many vehicles", fontsize=8)
    _draw_run_legend(fig, table)
    return fig


def worst_runs_from_above(table: Table) -> Figure | None:
    """Of each fault that fails, the worst run from above: whom it concerns when it fails, and their ways until then."""
    failed = [case for case in failure_rates(table) if case.worst]
    worst = {
        name: min((x for x in failed if x.fault == name), key=lambda x: x.separation or 0.0)
        for name in dict.fromkeys(case.fault for case in failed)
    }
    if not worst:
        return None
    fig, axes = _axes_for_metrics(
        table, "The worst of each fault from above [m]: ways into it", list(worst), 2.4
    )
    for case, ax in zip(worst.values(), axes, strict=True):
        _draw_worst_run(ax, table, case)
    return fig


def _draw_worst_run(ax: Axes, table: Table, case: Borne) -> None:
    """Draw the worst run of a fault: vehicles when it fails, those concerned with their ways until then."""
    assert case.worst is not None
    result, every = flight_with_fault(table.sweep, case.worst.run)
    failure = assess(result).failures[0]
    end = result.time[-1] if failure.when is None else failure.when
    now = int(np.searchsorted(result.time, end - 1e-9).clip(0, len(result.time) - 1))
    since = int(np.searchsorted(result.time, end - _WAY))
    who = [int(x) - 1 for x in re.findall(r"\d+", failure.who.partition(",")[0])]
    xy = result.position[..., :2]
    draw_areas_from_above(ax, table.sweep.mission)
    ax.plot(*xy[now].T, ".", color=_PASS_COLOUR, markersize=3)
    for i in who:
        ax.plot(*xy[since : now + 1, i].T, color=_FAIL_COLOUR, linewidth=1.0)
        ax.plot(*xy[now, i], "o", color=_FAIL_COLOUR, markersize=3.5)
    shown = xy[since : now + 1, who] if who else xy[now : now + 1]
    middle = shown[-1].mean(axis=0)
    half = max(_NEAR, 1.1 * float(np.abs(shown - middle).max()))
    ax.set(xlim=middle[0] + half * _BOTH, ylim=middle[1] + half * _BOTH, box_aspect=1.0)
    ax.set_title(
        f"{case.fault} {case.magnitude:g} {readable_unit(case.unit)}", loc="left", fontsize=8.5
    )
    names = agent_names(every[who].tolist()) if who else failure.name
    ax.set_xlabel(f"{names}, {end:.1f} s", fontsize=7.5)


def histograms(table: Table) -> Figure | None:
    """Histogram of every metric, for passed and failed runs, with its limit."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    names = [name for name in outcomes(table) if name != "success"]
    if not names:
        return None
    fig, axes = _axes_for_metrics(table, "Metrics of all runs", names)
    limits, shown = _fixed_metric_limits(table), False
    for name, ax in zip(names, axes, strict=True):
        x = table.metrics[name]
        finite = np.isfinite(x)
        scale = _axis_scale(x[finite])
        low, high = float(x[finite].min()), float(x[finite].max())
        edges = (np.geomspace if scale == "log" else np.linspace)(low, high, _BINS + 1)
        below = np.zeros(_BINS)
        for some, colour in ((table.passed, _PASS_COLOUR), (~table.passed, _FAIL_COLOUR)):
            top = below + np.histogram(x[finite & some], edges)[0]
            ax.stairs(top, edges, baseline=below, fill=True, color=colour, linewidth=0)
            below = top
        ax.set_xscale(scale)
        ax.set_xlim(low, high)
        ax.grid(visible=False, axis="x")
        if scale == "log":
            ax.minorticks_off()
        ax.xaxis.set_major_locator(LogLocator(numticks=4) if scale == "log" else MaxNLocator(3))
        ax.yaxis.set_major_locator(MaxNLocator(3, integer=True))
        ax.set_xlabel(_metric_label(name))
        if name in limits and low <= limits[name] <= high:
            ax.axvline(limits[name], color=st.ALERT, linewidth=1.0, linestyle=(0, (6, 2)))
            shown = True
    for ax in axes[::_COLUMNS]:
        ax.set_ylabel("runs")
    _draw_run_legend(fig, table, limit=shown)
    return fig


def metrics_over_drivers(table: Table) -> Figure | None:
    """Every metric over the number with the strongest correlation: runs, median and the middle 90 %."""
    strongest: dict[str, str] = {}
    for d in correlations_by_strength(table):
        if d.outcome != "success":
            strongest.setdefault(d.outcome, d.varied)
    if not strongest:
        return None
    fig, axes = _axes_for_metrics(table, "Metrics over what drives them most", list(strongest))
    numbers = varied_numbers(table)
    for (name, over), ax in zip(strongest.items(), axes, strict=True):
        x, y = numbers[over], table.metrics[name]
        for passed, colour in ((True, _PASS_COLOUR), (False, _FAIL_COLOUR)):
            some = (table.passed == passed) & np.isfinite(y)
            ax.plot(x[some], y[some], ".", color=colour, markersize=2.5, alpha=0.5, rasterized=True)
        centres, low, middle, high = _running_percentiles(x[np.isfinite(y)], y[np.isfinite(y)])
        ax.fill_between(centres, low, high, color=st.INK, alpha=0.12, linewidth=0)
        ax.plot(centres, middle, color=st.INK)
        ax.set_yscale(_axis_scale(y[np.isfinite(y)]))
        if _scale_of_variation(table, over) == "log":
            ax.set_xscale("log")
            _set_log_ticks(ax.xaxis, x)
        ax.margins(x=0.02)
        ax.set_title(_metric_label(name), loc="left", fontsize=8.5)
        ax.set_xlabel(_axis_label(table, over).replace(", ", ",\n"), fontsize=7.5)
    _draw_run_legend(fig, table)
    return fig


def correlations(table: Table) -> Figure | None:
    """Rank correlation of every varied number with success and every metric."""
    correlated = correlations_by_strength(table)
    if not correlated:
        return None
    rows = list(dict.fromkeys(d.varied for d in correlated))[:_ROWS]
    rows = [name for name in varied_numbers(table) if name in rows]
    columns = [name for name in outcomes(table) if any(d.outcome == name for d in correlated)]
    values = np.full((len(rows), len(columns)), np.nan)
    for d in correlated:
        if d.varied in rows:
            values[rows.index(d.varied), columns.index(d.outcome)] = d.correlation
    title = "What drives success and the metrics"
    fig = _titled_figure(table, title, st.FIGURE_WIDTH, 2.2 + 0.27 * len(rows))
    ax = fig.subplots()
    image = ax.imshow(values, cmap="PuOr", vmin=-1, vmax=1, aspect="auto")
    names = [c.replace("_", " ") for c in columns]
    slanting: dict[str, Any] = {"rotation": 38, "ha": "right", "rotation_mode": "anchor"}
    ax.set_xticks(range(len(columns)), names, **slanting)
    ax.set_yticks(range(len(rows)), rows)
    ax.tick_params(length=0)
    ax.grid(visible=False)
    ax.set_frame_on(False)
    for (i, j), value in np.ndenumerate(values):
        if math.isfinite(value):
            colour = "white" if abs(value) > 0.65 else st.INK
            look: dict[str, Any] = {"ha": "center", "va": "center", "color": colour}
            ax.text(j, i, f"{value:+.2f}", **look, fontsize=min(7.0, 110.0 / len(columns)))
    fig.colorbar(image, ax=ax, label="Spearman's rank\ncorrelation [-]", pad=0.01)
    return fig


def check_map(numbers: list[str], over: Sequence[str], metric: str) -> None:
    """Check that a map can be drawn over two of the numbers that vary, or over those with the strongest correlation.

    Raises
    ------
    RigidfleetError
        The sweep has no such path or metric.
    """
    known = ["success", *METRICS]
    unknown = [(p, numbers) for p in over if p not in numbers]
    unknown += [(metric, known)] if metric not in known else []
    if unknown or len(over) not in (0, 2):
        word, words = unknown[0] if unknown else (" ".join(over), numbers)
        why = " (a seed has no order)" if word.endswith("seed") else ""
        raise RigidfleetError(
            f"map: '{word}' cannot be drawn{why}. Choose from: {', '.join(words)}."
        )


def map_over_two(table: Table, over: Sequence[str] = (), metric: str = "") -> Figure | None:
    """Map of the success rate, or of the median of a metric, over two varied numbers.

    Raises
    ------
    RigidfleetError
        The sweep has no such path or metric.
    """
    numbers, correlated = varied_numbers(table), correlations_by_strength(table)
    if not metric:
        judged = outcomes(table)
        strongest = [d.outcome for d in correlated]
        metric = "success" if "success" in judged or not strongest else strongest[0]
    if not over:
        ranked = [d.varied for d in correlated if d.outcome == metric]
        over = list(dict.fromkeys([*ranked, *numbers]))[:2]
        if len(over) < 2:
            return None
    check_map(list(numbers), over, metric)
    values = 100.0 * table.passed if metric == "success" else table.metrics[metric]
    (x, at_x), (y, at_y) = (_map_cells(numbers[p], _scale_of_variation(table, p)) for p in over)
    cells = np.full((len(y) - 1, len(x) - 1), np.nan)
    for i, j in np.ndindex(cells.shape):
        inside = values[(at_y == i) & (at_x == j)]
        inside = inside[np.isfinite(inside)]
        if len(inside):
            cells[i, j] = inside.mean() if metric == "success" else np.median(inside)
    title = "Success rate" if metric == "success" else f"Median: {metric.replace('_', ' ')}"
    fig = _titled_figure(table, title, 0.75 * st.FIGURE_WIDTH, 0.58 * st.FIGURE_WIDTH)
    ax = fig.subplots()
    wide = metric != "success" and _axis_scale(cells[np.isfinite(cells)]) == "log"
    look: dict[str, Any] = {"vmin": 0, "vmax": 100} if metric == "success" else {}
    look |= {"norm": "log"} if wide else {}
    image = ax.pcolormesh(x, y, cells, cmap="viridis", edgecolor="white", linewidth=0.4, **look)
    unit = "passed [%]" if metric == "success" else f"{METRICS[metric].text} [{_unit_of(metric)}]"
    fig.colorbar(image, ax=ax, label=unit, pad=0.02)
    ax.grid(visible=False)
    ax.set(xlabel=_axis_label(table, over[0]), ylabel=_axis_label(table, over[1]))
    for axis, key, name in zip((ax.xaxis, ax.yaxis), ("xscale", "yscale"), over, strict=True):
        distinct = np.unique(numbers[name])
        if len(distinct) <= _VALUES:
            every = 1 + (len(distinct) > _LABELS)
            axis.set_ticks(range(0, len(distinct), every), [f"{v:.3g}" for v in distinct[::every]])
        elif _scale_of_variation(table, name) == "log":
            ax.set(**{key: "log"})
            _set_log_ticks(axis, distinct)
    return fig


# -- parts -------------------------------------------------------------------------------------------


def _titled_figure(table: Table, title: str, wide: float, high: float) -> Figure:
    """A figure of a size [in], with its title and what the sweep is."""
    fig = st.blank_figure(wide, high, "constrained")
    of = "" if table.complete else f" of {table.sweep.runs}"
    words = f"{table.sweep.name}: {len(table.run)}{of} runs"
    st.draw_heading(fig, title, words, st.GREY if table.complete else st.ALERT)
    return fig


def _axes_for_metrics(
    table: Table, title: str, names: Sequence[str], high: float = 1.75
) -> tuple[Figure, list[Axes]]:
    """Figure with small axes, one for each metric, in rows of a height [in]."""
    columns = min(_COLUMNS, max(2, len(names)))
    rows = -(-len(names) // columns)
    fig = _titled_figure(table, title, st.FIGURE_WIDTH, 0.9 + high * rows)
    axes = fig.subplots(rows, columns, squeeze=False).ravel().tolist()
    for ax in axes[len(names) :]:
        ax.set_visible(False)
    return fig, axes[: len(names)]


def _draw_run_legend(fig: Figure, table: Table, *, limit: bool = False) -> None:
    from matplotlib.patches import Patch

    handles: list[Any] = [Patch(color=_PASS_COLOUR, label=f"{int(table.passed.sum())} passed")]
    if not table.passed.all():
        handles.append(Patch(color=_FAIL_COLOUR, label=f"{int((~table.passed).sum())} failed"))
    if limit:
        handles.append(st.legend_entry("limit", color=st.ALERT, linestyle=(0, (6, 2))))
    fig.legend(handles=handles, loc="outside lower left", ncols=len(handles), fontsize=8)


def _metric_label(metric: str) -> str:
    return f"{metric.replace('_', ' ')} [{_unit_of(metric)}]"


def _unit_of(metric: str) -> str:
    return readable_unit(METRICS[metric].unit)


def _axis_label(table: Table, name: str) -> str:
    column = next(c for c in table.sweep.columns if c.name == name)
    unit, _ = unit_and_meaning(table.sweep, column)
    how = {"set": "", "add": ", added", "scale": ", factor"}[column.variation.change]
    return f"{name}{how} [{readable_unit(unit)}]"


def _fixed_metric_limits(table: Table) -> dict[str, float]:
    """Limits of the mission for metrics, unless they vary."""
    moved = {key for column in table.sweep.columns for key in column.keys[:2]}
    limits = {q.name: q.limit_of(table.sweep.mission) for q in QUANTITIES.values() if q.checked}
    return {
        name: float(np.min(limit)) / (100.0 if QUANTITIES[name].unit == "%" else 1.0)
        for name, limit in limits.items()
        if limit is not None
        and np.isfinite(limit).any()
        and not moved & {name, QUANTITIES[name].key.rpartition(".")[2]}
    }


def _axis_scale(x: Floats) -> str:
    wide = len(x) and x.min() > 0 and x.max() > _LOGARITHMIC * x.min()
    return "log" if wide else "linear"


def _scale_of_variation(table: Table, name: str) -> str:
    """Scale on which the varied number is evenly distributed."""
    column = next(c for c in table.sweep.columns if c.name == name)
    return "log" if isinstance(column.variation, LogUniform | Geomspace) else "linear"


def _set_log_ticks(axis: Axis, x: Floats) -> None:
    """Plain tick labels for a logarithmic axis that may span less than a decade."""
    if x.max() > _LOGARITHMIC * x.min():
        return
    ticks = np.geomspace(x.min(), x.max(), 3)
    axis.set_ticks(ticks, [f"{v:.2g}" for v in ticks])
    axis.set_ticks([], minor=True)


def _map_cells(x: Floats, scale: str) -> tuple[Floats, Ints]:
    """Edges of cells along an axis, and the cell of each run. Few distinct values have a cell each."""
    distinct = np.unique(x)
    if len(distinct) <= _VALUES:
        return np.arange(len(distinct) + 1.0) - 0.5, np.searchsorted(distinct, x)
    space = np.geomspace if scale == "log" else np.linspace
    edges = space(distinct[0], distinct[-1], _CELLS + 1)
    return edges, np.clip(np.searchsorted(edges, x, side="right") - 1, 0, _CELLS - 1)


def _running_percentiles(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Centres in x, and 5th percentile, median and 95th percentile of y there.

    The centres are the values of x, or if there are many, intervals with equal numbers of runs.
    """
    distinct = np.unique(x)
    if len(distinct) <= _ENVELOPE:
        parts = [y[x == v] for v in distinct]
        centres = distinct
    else:
        stretches = np.array_split(np.argsort(x), min(_ENVELOPE, max(1, len(x) // 5)))
        parts = [y[s] for s in stretches]
        centres = np.array([np.median(x[s]) for s in stretches])
    low, middle, high = np.array([np.percentile(part, (5, 50, 95)) for part in parts]).T
    return centres, low, middle, high
