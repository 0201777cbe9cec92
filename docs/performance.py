"""Write the tables of performance.md and many.md from what the benchmarks have measured.

    python benchmarks/run.py --json bench.json
    python benchmarks/compare.py --json peers.json --figure docs/images/work-precision.png
    python benchmarks/many.py --million --json many.json
    python benchmarks/vehicles.py --json vehicles.json
    python docs/performance.py bench.json peers.json many.json vehicles.json

rewrites them in place, each between `<!-- measured: NAME -->` and `<!-- end -->`; a file may be left out, and its
tables stay as they are. No number of theirs is written by hand.
"""

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

PAGES = [
    Path(__file__).with_name("performance.md"),
    Path(__file__).with_name("many.md"),
]
Data = dict[str, Any]


def render(page: str, data: Data) -> str:
    """A page with the tables that ``data`` (the benchmarks' files, as one) has the numbers of."""

    def table(match: re.Match[str]) -> str:
        name = match[1]
        needed, write = TABLES[name]
        text = write(data) if needed in data else match[2]
        return f"<!-- measured: {name} -->\n{text}\n<!-- end -->"

    return re.sub(r"<!-- measured: ([\w-]+) -->\n(.*?)\n<!-- end -->", table, page, flags=re.DOTALL)


def _machine(data: Data) -> str:
    """When and where `make bench` has run."""
    versions = ", ".join(f"{name} {version}" for name, version in data["versions"].items())
    return f"Measured on {data['date']}: {data['machine']}; {versions}."


def _ratios(name: str, theirs: str) -> Any:
    """A table of ratios against something else."""

    def write(data: Data) -> str:
        rows = [
            (
                row["name"].strip(),
                _time(row["ours"]),
                _time(row["theirs"]),
                _ratio(median(row["ratios"])),
                f"{_ratio(min(row['ratios']))} to {_ratio(max(row['ratios']))}",
                "" if row["goal"] is None else f"{'≥' if row['faster'] else '≤'} {row['goal']:,g}",
            )
            for row in data[name]
            if "share" not in row["name"]  # of a time of ours, not of a peer's
        ]
        return _markdown(("", "ours [ms]", f"{theirs} [ms]", "ratio", "rounds", "goal"), rows)

    return write


def _ratio(x: float) -> str:
    """Three digits, or all of a greater number."""
    return f"{x:.3g}" if x < 1000 else f"{x:,.0f}"


def _missions(data: Data) -> str:
    """Whole missions, against the time they last."""
    flown, *others = data["missions"]
    row = (
        flown["name"],
        _time(flown["ours"]),
        f"{median(flown['ratios']):,.0f}",
        f"≥ {flown['goal']:,.0f}",
    )
    table = _markdown(("", "ours [ms]", "simulated s in a second", "goal"), [row])
    judged = [
        f"{other['name'].strip()}: {_time(other['ours'])} ms"
        + (f" (goal: {1e3 * other['theirs'][0]:,.0f} ms)." if other["goal"] else ".")
        for other in others
    ]
    return "\n\n".join([table, *judged])


def _operations(data: Data) -> str:
    """Operations of an evaluation, and how near to the bound the vectors come."""
    counts = data["operations"]
    rows = [
        (part, *(f"{count[part]:,}" for count in counts.values()))
        for part in next(iter(counts.values()))
    ]
    total = [sum(count.values()) for count in counts.values()]
    rows.append(("together", *(f"{n:,}" for n in total)))
    straight = list(data["straight"].values())
    for name, title, cores, done in (
        ("flights", "a flight alone, one core", 1, total),
        ("ensembles", "eight to a vector, all cores", data["cores"], straight),
    ):
        found = [row for row in data[name] if row["evaluations"] and "undamped" in row["name"]]
        each = [median(row["ours"]) / row["evaluations"] for row in found]
        bound = data["bound"] * cores / data["cores"]
        shares = zip(done, each, strict=True)
        if done is straight:
            rows.append(("as straight-line code", *(f"{n:,}" for n in straight)))
        rows.append((f"{title}: ns an evaluation", *(f"{1e9 * s:,.0f}" for s in each)))
        rows.append(("share of the bound", *(f"{100 * n / s / bound:.2g} %" for n, s in shares)))
    text = _markdown(("", *(f"{n} agents" for n in counts)), rows)
    return f"{text}\n\nThe bound: {1e-9 * data['bound']:.3g} Gflop/s on {data['cores']} cores."


def _peers(data: Data) -> str:
    """All of the comparison."""
    rows = [
        (
            str(row["agents"]),
            row["peer"],
            f"{row['unit'].partition(' ')[0]} {row['effort']:g}",
            _ratio(row["rate"]),
            f"{median(row['ratios']):.3g}",
            f"{min(row['ratios']):.3g} to {max(row['ratios']):.3g}",
            f"{row['error']:.0e}",
            f"{row['from_ours']:.0e}",
            f"{row['distances']:.0e}",
        )
        for row in data["rows"]
    ]
    head = ("agents", "", "setting", "simulated s in a second", "time / ours", "rounds")
    text = _markdown((*head, "error [m]", "from ours [m]", "distances [m]"), rows)
    absent = "".join(f"\n\nAbsent: {name}." for name in data["absent"])
    return f"{text}\n\nMeasured on {data['date']}: {data['machine']}.{absent}"


def _models(data: Data) -> str:
    """In what the peers' models differ."""
    texts = {f"{row['peer']} {row['version']}": row["model"] for row in data["rows"]}
    return "\n".join(f"- *{name}*: {text}." for name, text in texts.items())


def _summary(data: Data) -> str:
    """Simulated seconds in a second: a row for each program, a column for each number of agents."""
    agents = list(dict.fromkeys(row["agents"] for row in data["rows"]))
    rates = {(row["peer"], row["agents"]): row["rate"] for row in data["rows"]}
    names = {row["peer"]: f"{row['peer']} {row['version']}" for row in data["rows"]}
    rows = [
        (text, *(f"{float(f'{rates[peer, n]:.2g}'):,.10g}" for n in agents))
        for peer, text in names.items()
    ]
    text = _markdown(("", *(f"{n} agents" for n in agents)), rows)
    return f"{text}\n\nMeasured on {data['date']}: {data['machine']}."


def _many(data: Data) -> str:
    """Flights of large formations."""
    found, rows = data["many"], []
    for row in found["formations"]:
        rates = [found["duration"] / row[clock] for clock in ("wall", "processor")]
        flat = "" if row["flat"] is None else f", flat to {1e3 * row['flat']:.2g} mm"
        rows.append(
            (
                row["kind"],
                f"{row['agents']:,}",
                f"{row['edges']:,}",
                row["solve"],
                str(row["steps"]),
                f"{row['wall']:.2g}" if row["wall"] < 10 else f"{row['wall']:.0f}",
                " / ".join(f"{rate:.2g}" if rate < 10 else f"{rate:.0f}" for rate in rates),
                f"{row['memory']:.2g}",
                f"{row['error']:.0e}",
                f"{row['shape']:.0e}{flat}",
            )
        )
    head = ("formation", "agents", "edges", "solve", "steps", "wall [s]")
    head = (
        *head,
        "times real time, wall / processor",
        "memory [GB]",
        "worst edge at the end [m]",
        "worst pair [m]",
    )
    goals = [
        (
            goal["name"],
            f"{'≥' if goal['least'] else '≤'} {goal['goal']:g}",
            f"{goal['value']:.3g}",
            "yes" if goal["reached"] else "no",
        )
        for goal in found["goals"]
    ]
    judged = _markdown(("", "goal", "measured", "reached"), goals)
    load = f"Other programs' load when it began: {found['load']:.1f}."
    return f"{_markdown(head, rows)}\n\n{judged}\n\n{_machine(found)} {load}"


def _graphs(data: Data) -> str:
    """How well graphs hold shapes of many."""
    rows = [
        (
            f"{row['shape']}, {row['agents']:,}",
            f'`"{row["graph"]}"`' + (f", `reach = {row['reach']}`" if row["reach"] else ""),
            f"{row['edges']:,}",
            f"{row['longest']:.2g}",
            f"{row['index']:.2g}" if row["condition"] else "0",
            f"{row['condition']:.2g}" if row["condition"] else "flexible",
        )
        for row in data["many"]["graphs"]
    ]
    head = ("shape", "edges", "how many", "longest [2 m]", "index", "condition of $A$")
    return _markdown(head, rows)


def _vehicles(data: Data) -> str:
    """Flights of quadrotors against the time they last, and vehicle-steps per second."""
    found = data["vehicles"]
    flights = [
        (
            row["name"],
            f"{1e3 * row['step']:g}",
            "" if row["error"] is None else f"{row['error']:.0e}",
            _ratio(median(row["ratios"])),
            f"{_ratio(min(row['ratios']))} to {_ratio(max(row['ratios']))}",
            "" if row["goal"] is None else f"≥ {row['goal']:g}",
        )
        for row in found["flights"]
    ]
    rates = [
        (
            row["name"],
            str(row["vehicles"]),
            "" if row["step"] is None else f"{1e3 * row['step']:g}",
            f"{float(format(median(row['rates']), '.2g')):,.10g}",
        )
        for row in found["rates"]
    ]
    head = ("90 s of flight", "step [ms]", "error [m]", "times real time", "rounds", "goal")
    text = _markdown(head, flights)
    hover = _markdown(("hover", "vehicles", "step [ms]", "vehicle-steps in a second"), rates)
    return f"{text}\n\n{hover}\n\nMeasured on {found['date']}: {found['machine']}; rigidfleet {found['version']}."


def _time(seconds: list[float]) -> str:
    value = 1e3 * median(seconds)
    return f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def _markdown(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    rule = ("---", *("--:" for _ in head[1:]))
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, rule, *rows))


#: Each table's key in the files without which it cannot be written, and what writes it.
TABLES: dict[str, tuple[str, Any]] = {
    "machine": ("versions", _machine),
    "flights": ("flights", _ratios("flights", "SciPy")),
    "ensembles": ("ensembles", _ratios("ensembles", "SciPy")),
    "missions": ("missions", _missions),
    "operations": ("operations", _operations),
    "processes": ("processes", _ratios("processes", "interpreter")),
    "peers": ("rows", _peers),
    "models": ("rows", _models),
    "summary": ("rows", _summary),
    "many": ("many", _many),
    "graphs": ("many", _graphs),
    "vehicles": ("vehicles", _vehicles),
}


if __name__ == "__main__":
    files = [json.loads(Path(name).read_text(encoding="utf-8")) for name in sys.argv[1:]]
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        for found in files:
            text = render(text, found)
        path.write_text(text, encoding="utf-8")
