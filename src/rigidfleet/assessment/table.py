"""A verdict on the terminal: tables of phases, waypoints and checks, notes, and the verdict in words."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from rigidfleet.assessment.outcome import CheckResult, PhaseVerdict, value

_PHASE = ["phase\n", "end\n[s]", "|c| at end\n[m]", "worst |c|\n[m]", "shape off\n[m]", "apart\n[m]",
          "clear\n[m]", "thrust\n[N]"]  # fmt: skip
_WAYPOINT = ["waypoint\n", "at\n[s]", "off by\n[m]", "\n[m/s]", "\n[deg]", "\n[deg/s]"]
_CHECK = ["check", "worst", "limit", "at [s]", "who or where", ""]


def rendered(
    head: Text,
    phase_verdicts: Sequence[PhaseVerdict],
    checks: Sequence[CheckResult],
    last: Sequence[Text],
) -> RenderableType:
    """What rich prints of a verdict: its head, tables of phases, waypoints and checks, and its last lines."""
    phases, waypoints = [], []
    for p in phase_verdicts:
        worst = [p.worst.get(name) for name in ("constraint", "separation", "clearance", "thrust")]
        c, *rest = [None if e is None else e.value for e in worst]
        phases.append([p.name, f"{p.t_end:.2f}", *map(_number, (p.constraint, c, p.shape, *rest))])
        met = [] if p.waypoint is None else [(p.name, p.waypoint)]
        for name, w in [*((f"{p.name}, point {k}", w) for k, w in enumerate(p.through, 1)), *met]:
            misses = (w.position, w.velocity, w.attitude, w.rates)
            waypoints.append([name, f"{w.time:.2f}", *map(_number, misses)])
    shown: list[RenderableType] = [
        head,
        _table(_PHASE, phases),
    ]
    if any(row[2] for row in phases):
        shown.append(
            Text(
                "|c|: how far an edge's length is off the commanded one; the greatest of all edges.",
                "dim",
            )
        )
    if waypoints:
        shown.append(_table(_WAYPOINT, waypoints))
    shown.append(_table(_CHECK, [check_row(f) for f in checks], left=("who or where", "")))
    return Group(*shown, *last)


def _table(
    heads: Sequence[str], rows: Sequence[Sequence[str | Text]], left: Sequence[str] = ()
) -> Table:
    """A table whose first column is text, without its empty columns."""
    kept = [k for k in range(len(heads)) if any(row[k] for row in rows)]
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for k in kept:
        words = k == 0 or heads[k] in left
        table.add_column(Text(heads[k]), justify="left" if words else "right", no_wrap=not words)
    for row in rows:
        table.add_row(*(Text(x) if isinstance(x, str) else x for x in (row[k] for k in kept)))
    return table


def check_row(f: CheckResult) -> list[str | Text]:
    """A check as a row: name, worst, limit, when, who or where, and whether it holds."""
    mark = Text("ok", "green") if f.passed else Text("FAILED", "bold red")
    first = f.first  # what failed first is what the reader needs
    at, who = (f.when, f.who or f.phase) if first is None else (first.when, f"first {first.who}")
    when = "" if at is None else f"{at:.2f}"
    return [f.name, _number(f.worst, f.unit), _bound(f), when, who, mark if f.judged else ""]


def _bound(f: CheckResult) -> str:
    if f.limit is None:
        return ""
    sign = (">=" if f.limit else ">") if f.at_least else "<="
    return f"{sign} {value(f.limit, f.unit)}"


def _number(x: float | None, unit: str = "") -> str:
    return "" if x is None else value(x, unit)
