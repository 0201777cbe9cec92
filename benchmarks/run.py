"""How fast: ratios against SciPy and against a bare interpreter, all from one run.

``make bench`` runs it. Rounds are interleaved, so that a machine whose speed drifts slows both sides
alike, and the median of the rounds' ratios counts; single times on a shared machine mean little.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from functools import partial
from importlib.metadata import version
from pathlib import Path
from statistics import median

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy_peer import Literal, Peer, constant, squared

from rigidfleet.assessment import assess
from rigidfleet.formation import distance_geometry
from rigidfleet.formation.shapes import slots
from rigidfleet.interchange import FormatName, export
from rigidfleet.kernel import records
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.engine.tracer import Code, Trace
from rigidfleet.kernel.problem import workspace
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.legs import leg_of
from rigidfleet.planning.plan import plan_phase
from rigidfleet.planning.reference import PhaseState
from rigidfleet.preflight.check import check
from rigidfleet.result import Result
from rigidfleet.rigidity.design import design
from rigidfleet.simulation.ensemble import establish
from rigidfleet.simulation.flight import simulate
from rigidfleet.sweep import Sweep, fly
from rigidfleet.sweep.run import fly_runs

TOLERANCE = 1e-8
DURATION, SAMPLES = 20.0, 200
#: Ensembles: flights of a round, of which SciPy flies a few; tolerances; how far starts scatter [m].
FLIGHTS, SCIPYS = 1000, 5
RTOL, ATOL = 1e-6, 1e-8
SPREAD = 0.25
#: Missions whose runs of a sweep take long, with the time of one that is asked for [s], and the number of their rounds.
OTHER_MISSIONS = {
    "passage-quadrotors": 0.15,
    "cube-passage-quadrotors": 0.22,
    "moving-obstacles": 0.8,
    "narrow-passage-found": 0.012,
}
OTHER_ROUNDS = 3
#: Flights in wind of a round, and the number of these rounds; runs of a sweep in another one, whole groups of eight.
WINDY, WINDY_ROUNDS, RUNS = 10_000, 3, 96
#: Missions flown, and their agents.
FORMATIONS = {"establish-triangle": 3, "establish-cube": 8}
#: Peers fly the same law: their positions may differ by no more [m].
AGREEMENT = 1e-6


@dataclass
class Row:
    """One comparison: times [s] of each round, and the ratio that is asked for."""

    name: str
    ours: list[float]
    theirs: list[float]
    goal: float | None
    faster: bool  # ratio theirs/ours, at least the goal; else ours/theirs, at most the goal
    note: str = ""
    evaluations: float | None = None  # of the right-hand side in one of our flights

    @property
    def ratios(self) -> list[float]:
        pairs = zip(self.ours, self.theirs, strict=True)
        return [b / a if self.faster else a / b for a, b in pairs]

    @property
    def reached(self) -> bool | None:
        value = median(self.ratios)
        if self.goal is None:
            return None
        return bool(value >= self.goal if self.faster else value <= self.goal)


def establishment(source: str, *, default_law: bool) -> Mission:
    """A shipped establishment as one phase of 20 s: the paper's undamped steps, or the default law."""
    data = load_mission(source).to_dict()
    name = data["phases"][0]["formation"]
    reference = "squares" if default_law else "step"
    data["phases"] = [
        {"kind": "establish", "formation": name, "reference": reference, "control": "open",
         "input_force": [0.1, 0.1, 0.0], "duration": DURATION},
    ]  # fmt: skip
    data["formations"] = {name: data["formations"][name]}
    data["integrator"] = {"rtol": TOLERANCE, "atol": TOLERANCE}
    if not default_law:
        data["constraint"] = {"solver": "exact", "deformation_damping": 0.0}
    return Mission.from_dict(data)


def peer(mission: Mission, kind: type[Peer]) -> Peer:
    """The mission's law, programmed with NumPy."""
    agents, c = mission.agents, mission.constraint
    r0, m = np.array(agents.position), np.array(agents.mass)
    name = mission.phases[0].formation
    edges, d1 = mission.formation_edges(name), mission.formation_distances(name)
    B = np.zeros((len(edges), len(m)))
    rows = np.arange(len(edges))
    B[rows, edges[:, 0]], B[rows, edges[:, 1]] = 1.0, -1.0
    steps = mission.phases[0].reference == "step"
    d0 = distance_geometry.distances(r0, edges)
    return kind(
        r0=r0,
        m=m,
        B=B,
        gains=(c.alpha, c.beta, c.gamma),
        reference=constant(d1) if steps else squared(d0, d1, mission.phases[0].blend),
        f=np.tile(mission.phases[0].input_force, (len(m), 1)),
        mu=mission.damping(None) if c.solver == "iterated" else 0.0,
        iterations=c.iterations,
        k_def=c.deformation_damping,
    )


def compiled_flight(mission: Mission, tolerance: float = TOLERANCE) -> Callable[[], np.ndarray]:
    """The kernel alone: all that is known before the flight is prepared before the clock starts."""
    agents = mission.agents
    now = PhaseState(0.0, np.array(agents.position), np.array(agents.velocity))
    plan = plan_phase(mission, leg_of(mission, mission.phases[0], now))
    work = workspace(len(now.r), len(plan.edges), solver=plan.problem.law.solver)
    y = np.concatenate([now.r.ravel(), now.v.ravel(), np.zeros(len(plan.edges))])
    times = np.linspace(0.0, DURATION, SAMPLES)
    samples = np.empty((SAMPLES, len(y)))
    start = records.integrator(y, 0.0, rtol=tolerance, atol=np.full(len(y), tolerance))
    state = start._replace(y=y.copy(), clock=start.clock.copy(), count=start.count.copy())

    def fly() -> np.ndarray:
        state.y[:], state.clock[:], state.count[:] = start.y, start.clock, start.count
        native.Integration(plan.problem, work, state, DURATION, times, samples)(True, 1 << 40)
        return samples

    return fly


def seconds(job: Callable[[], object], at_least: float = 0.0) -> float:
    """Time [s] of one call, repeated for ``at_least`` so long and averaged."""
    start, calls = time.perf_counter(), 0
    while True:
        job()
        calls += 1
        passed = time.perf_counter() - start
        if passed >= at_least:
            return passed / calls


def with_records(result: Result) -> Result:
    """The result, with forces, frames and distances, which are computed when they are first asked for."""
    _ = result.thrust, result.separation
    return result


def in_kernel(job: Callable[[], object], at_least: float) -> tuple[float, float]:
    """Time [s] of one call, as `seconds`, and what of it is spent in the kernel's integrator and monitor."""
    inside = 0.0
    watch = native.Watch
    parts = (watch, watch.search_distances), (watch, watch.search_forces)
    whole = [(native.Integration, "__call__", native.Integration.__call__)]
    whole += [(kind, call.__name__, call) for kind, call in parts]

    def timed(call: Callable[..., int]) -> Callable[..., int]:
        def of(*arguments: object, **options: object) -> int:
            nonlocal inside
            begun = time.perf_counter()
            status = call(*arguments, **options)
            inside += time.perf_counter() - begun
            return status

        return of

    calls = 0

    def counted() -> None:
        nonlocal calls
        calls += 1
        job()

    try:
        for kind, name, call in whole:
            setattr(kind, name, timed(call))
        spent = seconds(counted, at_least)
    finally:
        for kind, name, call in whole:
            setattr(kind, name, call)
    return spent, inside / calls


def flights(rounds: int) -> tuple[list[Row], bool]:
    """Kernel and `simulate` against SciPy; and whether all agree."""
    rows, agree = [], True
    times = np.linspace(0.0, DURATION, SAMPLES)
    for default_law, law, goals, whole in (
        (False, "undamped law", {3: 250.0, 8: 50.0}, {3: 100.0, 8: 35.0}),
        (True, "default law", {3: 150.0, 8: 30.0}, {3: 200.0, 8: 65.0}),
    ):
        for source, n in FORMATIONS.items():
            mission = establishment(source, default_law=default_law)
            ours = compiled_flight(mission)
            literal, tuned = peer(mission, Literal), peer(mission, Peer)
            off = max(
                float(np.abs(ours() - p.fly(times, TOLERANCE))[:, : 3 * n].max())
                for p in (literal, tuned)
            )
            agree &= off <= AGREEMENT
            evaluations = simulate(mission, times=times).statistics["evaluations"]
            jobs = {
                "literal": lambda p=literal: p.fly(times, TOLERANCE),
                "tuned": lambda p=tuned: p.fly(times, TOLERANCE),
                "kernel": ours,
                "simulate": lambda m=mission: simulate(m, times=times),
                "recorded": lambda m=mission: with_records(simulate(m, times=times)),
            }
            spent = {name: [] for name in (*jobs, "watched", "inside")}
            for _ in range(rounds):
                for name, job in jobs.items():
                    spent[name].append(seconds(job, 0.1))
                watched, inside = in_kernel(jobs["simulate"], 0.1)
                spent["watched"].append(watched)
                spent["inside"].append(inside)
            title = f"{n} agents, {law}"
            note = f"positions agree to {off:.0e} m"
            rows += [
                Row(title, spent["kernel"], spent["literal"], goals[n], True, note, evaluations),
                Row("  hand-tuned NumPy", spent["kernel"], spent["tuned"], None, True),
                Row("  all of simulate()", spent["simulate"], spent["literal"], whole[n], True),
                Row("  with all it records", spent["recorded"], spent["literal"], None, True),
                Row(
                    "  the kernel's share of simulate()",
                    spent["watched"],
                    spent["inside"],
                    0.4,
                    True,
                    "integrator and monitor",
                ),
            ]
    return rows, agree


def ensembles(rounds: int) -> list[Row]:
    """A thousand flights from random starts, on all cores, against SciPy in a loop."""
    rows = []
    for default_law, law, goals in (
        (False, "undamped law", {3: 6000.0, 8: 1200.0}),
        (True, "default law", {3: None, 8: None}),
    ):
        for source, n in FORMATIONS.items():
            data = establishment(source, default_law=default_law).to_dict()
            data["integrator"] = {"rtol": RTOL, "atol": ATOL}
            mission = Mission.from_dict(data)
            r = np.array(mission.agents.position)
            starts = r + np.random.default_rng(0).uniform(-SPREAD, SPREAD, (FLIGHTS, *r.shape))
            peers = []
            for start in starts[: SCIPYS * rounds]:
                data["agents"]["position"] = start.tolist()
                peers.append(peer(Mission.from_dict(data), Literal))
            end = np.array([DURATION])
            ours = establish(mission, starts, vectors=True)
            theirs = peers[0].fly(end, RTOL, ATOL)[-1, : 3 * n].reshape(n, 3)
            kept = Sweep.of(
                mission,
                [f"agents.position.*.* += uniform({-SPREAD}, {SPREAD})"],
                runs=FLIGHTS,
                evaluate="final",
            )
            alone, vectors, rows_kept, scipy = [], [], [], []
            for k in range(rounds):
                some = peers[SCIPYS * k : SCIPYS * (k + 1)]
                loop = [partial(p.fly, end, RTOL, ATOL) for p in some]
                scipy.append(sum(map(seconds, loop)) / len(loop))
                for times, choice in ((vectors, True), (alone, False)):
                    all_of_them = partial(establish, mission, starts, vectors=choice)
                    times.append(seconds(all_of_them, 0.1) / FLIGHTS)
                with tempfile.TemporaryDirectory() as folder:
                    rows_kept.append(seconds(partial(fly, kept, folder)) / FLIGHTS)
            title = f"{n} agents, {law}, {FLIGHTS:,} flights"
            evaluations = float(np.median(ours.evaluations))
            note = (
                f"median {evaluations:.0f} evaluations; positions agree to"
                f" {np.abs(ours.position[0] - theirs).max():.0e} m"
            )
            rows += [
                Row(title, vectors, scipy, goals[n], True, note, evaluations),
                Row("  each flight alone", alone, scipy, None, True),
                Row("  as a sweep by final states", rows_kept, scipy, None, True),
            ]
    return rows


@dataclass(frozen=True)
class Goal:
    """A row against a fixed time: what is timed in round k [s], and the time [s] or the multiple of it to reach."""

    name: str
    spent: Callable[[int], float]
    time: float
    least: float | None = 1.0
    note: str = ""
    rounds: int | None = None  # at most so many, of one that takes long


def against(goals: Sequence[Goal], rounds: int) -> list[Row]:
    """Rows of goals, in interleaved rounds."""
    spent: dict[str, list[float]] = {goal.name: [] for goal in goals}
    for k in range(rounds):
        for goal in goals:
            if goal.rounds is None or k < goal.rounds:
                spent[goal.name].append(goal.spent(k))
    return [
        Row(g.name, (ours := spent[g.name]), [g.time] * len(ours), g.least, True, g.note)
        for g in goals
    ]


def missions(rounds: int) -> list[Row]:
    """Whole missions, their verdicts, and sweeps of them, against fixed times; another goal is another line here."""
    name, gain = "narrow-passage", "constraint.alpha=uniform(0.4,0.6)"
    sweep = Sweep.of(load_mission(name), vary=[gain], runs=RUNS * rounds, seed=1)
    fly_runs(sweep, range(8))
    windy(0, 8)
    flown = [simulate(Mission.from_dict(sweep.document_of_run(k))) for k in range(2)]
    lasts = flown[0].time[-1]

    def of_sweep(k: int) -> float:
        return seconds(lambda: fly_runs(sweep, range(RUNS * k, RUNS * (k + 1)))) / RUNS

    others = {
        other: Sweep.of(other, vary=[gain], runs=8 * (OTHER_ROUNDS + 1), seed=1)
        for other in OTHER_MISSIONS
    }

    def of_other(other: str, k: int) -> float:
        if k == 0:
            fly_runs(others[other], range(8 * OTHER_ROUNDS, 8 * (OTHER_ROUNDS + 1)))
        return seconds(lambda: fly_runs(others[other], range(8 * k, 8 * k + 8))) / 8

    large, sphere = simulate("show-1000"), slots("sphere", [4.0], 30)

    def of_export(kind: FormatName, k: int) -> float:
        with tempfile.TemporaryDirectory() as folder:
            return seconds(lambda: export(large, Path(folder, "show"), kind))

    def judged(results: list[Result]) -> float:
        return seconds(lambda: [assess(result) for result in results], 0.1) / len(results)

    return against(
        [
            Goal(
                f"{name}, {lasts:.0f} s, a run of a sweep", of_sweep, lasts, 10_000.0,
                "against the time that it lasts, on one core: plan, flight, record, verdict, metrics",
            ),
            *(
                Goal(f"{other}, a run of a sweep", partial(of_other, other), most, 1.0, rounds=OTHER_ROUNDS)
                for other, most in OTHER_MISSIONS.items()
            ),
            Goal(f"simulate() of {name}", lambda k: seconds(lambda: simulate(name), 0.1), lasts, None),
            Goal(
                f"assess() of {name}", lambda k: judged(flown), 2e-3, 1.0,
                "two flights by turns, so that none takes over what was just computed of its own numbers",
            ),
            Goal("  right after its flight", lambda k: judged(flown[:1]), 2e-3, 1.0),
            Goal(
                "check of cube-passage-quadrotors",
                lambda k: seconds(lambda: check("cube-passage-quadrotors")), 1.0, 1.0,
            ),
            Goal("design of a sphere of 30", lambda k: seconds(lambda: design(sphere)), 1.5, 1.0),
            *(
                Goal(f"export of show-1000, {kind}", partial(of_export, kind), 5.0, 1.0, rounds=WINDY_ROUNDS)
                for kind in ("skyc", "polynomial")
            ),
            Goal(
                f"{WINDY:,} flights of windy-passage", windy, 60.0, 1.0,
                "seeds and masses varied, kept in the store, all cores; the whole command, from its process' start"
                f" to its summary and figures; at most {WINDY_ROUNDS} rounds",
                WINDY_ROUNDS,
            ),
        ],
        rounds,
    )  # fmt: skip


def windy(k: int, runs: int = WINDY) -> float:
    """Time [s] of the command that flies in wind, seeds and masses varied, keeps all runs and draws their figures."""
    seeds = ", ".join(map(str, range(1000)))
    asked = ["sweep", "windy-passage", "--runs", str(runs), "--seed", str(k)]
    for line in (
        "agents.mass.* *= normal(1, 0.02)",
        f"disturbances.gusts.seed = choice({seeds})",
        f"disturbances.noise.seed = choice({seeds})",
    ):
        asked += ["--vary", line]
    with tempfile.TemporaryDirectory() as folder:
        return seconds(lambda: python("-m", "rigidfleet", *asked, "--out", folder))


def python(*arguments: str) -> None:
    """Run Python as a process of its own."""
    # Bytecode is cached, as it is wherever packages are installed.
    env = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True, env=env)


def operations(mission: Mission) -> dict[str, int]:
    """Floating-point operations of an evaluation of the undamped law, by part; a root or quotient counts one.

    What its equations ask for, each common part once and A by its lower triangle: less than a compiler's code does.
    """
    edges = mission.formation_edges(mission.phases[0].formation)
    n, m = mission.n_agents, len(edges)
    degree = np.bincount(edges.ravel(), minlength=n)
    # A pair of edges that share an agent: u_k . u_l over its mass; an edge with itself: the masses alone.
    pairs = int((degree * (degree - 1) // 2).sum())
    return {
        "edges: lengths, directions, rates, b": 45 * m,
        "A": 6 * pairs + m,
        "Cholesky factor and two solves": (2 * m**3 + 3 * m**2 + m) // 6 + 2 * m**2,
        "forces and accelerations": 9 * m + 6 * n,
        "its share of a step": share_of_a_step(mission),
    }


def share_of_a_step(mission: Mission, stages: int = 6, weights: int = 26) -> int:
    """Operations of an evaluation's part in a step, of Dormand and Prince by default.

    A step sums ``weights`` terms for each state, in its stages and in its error: 1 + 2 + 3 + 4 + 5 + 5 + 6.
    """
    edges = mission.formation_edges(mission.phases[0].formation)
    return (6 * mission.n_agents + len(edges)) * 2 * weights // stages


def straight_line(mission: Mission) -> int:
    """Operations of an evaluation as straight-line code does them, and its share of a step of `lane_steps`."""
    r = np.array(mission.agents.position)
    now = PhaseState(0.0, r, np.zeros_like(r))
    code = Code(Trace(plan_phase(mission, leg_of(mission, mission.phases[0], now)).problem))
    # The last two of eight stages are at the same moment.
    return (
        len(code.moment) * 7 // 8 + len(code.lines) + share_of_a_step(mission, stages=8, weights=36)
    )


def bound() -> float:
    """What all cores reach in a product of large matrices [operations/s]: near the machine's peak."""
    n = 1500
    a = np.random.default_rng(0).uniform(size=(n, n))
    return 2.0 * n**3 / min(seconds(lambda: a @ a) for _ in range(5))


def processes(rounds: int) -> list[Row]:
    """Whole processes with a warm cache against a bare interpreter."""
    with tempfile.TemporaryDirectory() as folder:
        flight = ["run", "narrow-passage", "--no-figures", "--force", "--out", folder]
        commands = {
            "numpy": ["-c", "import numpy"],
            "imports": ["-c", "import numpy, scipy.linalg, numba"],
            "help": ["-m", "rigidfleet", "--help"],
            "check": ["-m", "rigidfleet", "check", "narrow-passage"],
            "run": ["-m", "rigidfleet", *flight],
            "figures": ["-m", "rigidfleet", *(x for x in flight if x != "--no-figures")],
        }

        for command in commands.values():
            python(*command)
        spent = {name: [] for name in commands}
        for _ in range(rounds):
            for name, times in spent.items():
                times.append(seconds(partial(python, *commands[name])))
    bare = "whole process, against a bare interpreter that imports NumPy"
    return [
        Row("--help", spent["help"], spent["numpy"], 3.0, False, bare),
        Row("check narrow-passage", spent["check"], spent["numpy"], 8.0, False, bare),
        Row("run narrow-passage", spent["run"], spent["numpy"], 12.0, False, bare),
        Row("  against its imports", spent["run"], spent["imports"], 4.0, False),
        Row(
            "  with its figures",
            spent["figures"],
            spent["run"],
            2.5,
            False,
            "against the same without",
        ),
    ]


def show(console: Console, rows: list[Row]) -> None:
    """The table."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("", "ours [ms]", "theirs [ms]", "ratio", "spread", "goal", "reached"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for row in rows:
        ratios, sign = row.ratios, ">=" if row.faster else "<="
        table.add_row(
            row.name,
            f"{1e3 * median(row.ours):.3g}",
            f"{1e3 * median(row.theirs):.3g}",
            f"{median(ratios):.3g}",
            f"{min(ratios):.3g}..{max(ratios):.3g}",
            "" if row.goal is None else f"{sign} {row.goal:g}",
            {None: "", True: "yes", False: "NO"}[row.reached],
        )
    console.print(table)
    for row in rows:
        if row.note:
            console.print(f"{row.name}: {row.note}", highlight=False)


def main() -> int:
    """Measure, print, and say whether the peers agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="rounds, of which the median counts")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    versions = {p: version(p) for p in ("rigidfleet", "numba", "numpy", "scipy")}
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(f"{date.today()}; {machine}; {versions}", highlight=False)
    console.print(
        f"{DURATION:g} s of flight, tolerance {TOLERANCE:g}, {SAMPLES} outputs; SciPy: RK45"
    )
    alone, agree = flights(arguments.rounds)
    tables = {
        "flights": alone,
        "ensembles": ensembles(arguments.rounds),
        "missions": missions(arguments.rounds),
        "processes": processes(arguments.rounds),
    }
    show(console, [row for rows in tables.values() for row in rows])
    most, counts, straight = bound(), {}, {}
    for row, (source, n) in zip(
        (r for r in tables["ensembles"] if "undamped" in r.name), FORMATIONS.items(), strict=True
    ):
        mission = establishment(source, default_law=False)
        counts[str(n)], straight[str(n)] = operations(mission), straight_line(mission)
        rate = straight[str(n)] * (row.evaluations or 0.0) / median(row.ours)
        console.print(
            f"{row.name}: {straight[str(n)]} operations an evaluation, {1e-9 * rate:.3g} Gflop/s on all cores"
            f" of {1e-9 * most:.3g} in a product of matrices",
            highlight=False,
        )
    if arguments.json:
        data = {
            name: [asdict(r) | {"ratios": r.ratios, "reached": r.reached} for r in rows]
            for name, rows in tables.items()
        }
        head = {"date": str(date.today()), "machine": machine, "versions": versions}
        head |= {"cores": os.cpu_count(), "bound": most, "operations": counts, "straight": straight}
        arguments.json.write_text(json.dumps(head | data, indent=1))
    if not agree:
        console.print(f"The peers do not agree to {AGREEMENT:g} m: they do not fly the same law.")
    return 0 if agree else 1


if __name__ == "__main__":
    sys.exit(main())
