"""Write the tables that are flown: errors and rotor forces, gusts, what damping changes, how near vectors are.

`python docs/flown.py` flies (two or three minutes) and rewrites them in place, each between `<!-- flown: NAME -->` and
`<!-- end -->`. tests/test_docs.py flies them again and compares the numbers.
"""

import re
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import rigidfleet as rf
from rigidfleet.simulation.together import simulate_together

HERE = Path(__file__).parent
PAGES = [HERE / name for name in ("vehicles.md", "theory.md", "paper.md", "performance.md")]
Table = tuple[tuple[str, ...], list[tuple[str, ...]]]

NO_DRAG = {"rotor_drag": 0.0, "rotor_inflow": 0.0, "body_drag": [0.0, 0.0, 0.0]}
UNCOMPENSATED = {"drag_feedforward": False}
LATE = {"noise": {"delay": 0.02, "rate": 100.0}}
NOISY = {"noise": LATE["noise"] | {"position": 0.01, "velocity": 0.02, "seed": 1}}
WIND = {"wind": [5.0, 0.0, 0.0]}
ERRORS: tuple[tuple[str, dict[str, Any], dict[str, Any]], ...] = (
    (
        'the regulator\'s way (`smoothness = "lqr"`), no drag',
        NO_DRAG,
        {"smoothness": "lqr", "tracking": UNCOMPENSATED},
    ),
    ("the smooth way: rotors and attitude lag alone", NO_DRAG, {"tracking": UNCOMPENSATED}),
    ("drag, which nobody feeds forward", {}, {"tracking": UNCOMPENSATED}),
    ("drag fed forward", {}, {}),
    (
        "states 20 ms late, compared with the reference of now",
        {},
        {"disturbances": LATE, "autopilot": {"delay_compensation": False}},
    ),
    ("states 20 ms late that carry their time", {}, {"disturbances": LATE}),
    ("noise of 1 cm and 2 cm/s besides", {}, {"disturbances": NOISY}),
    ("5 m/s of wind instead of noise and delay", {}, {"disturbances": WIND}),
    (
        "wind, with `tracking.integral = 1.0`",
        {},
        {"disturbances": WIND, "tracking": {"integral": 1.0}},
    ),
)
PAPER = (
    "single-waypoint", "narrow-passage", "cube-waypoint", "cube-passage", "establish-triangle",
    "establish-cube", "two-agents", "square", "pyramid", "hexagon", "windy-passage",
)  # fmt: skip


def errors() -> Table:
    """Greatest position and shape error of the passage, one thing after the other."""
    base, rows = rf.load_mission("passage-quadrotors").to_dict(), []
    for words, vehicle, changes in ERRORS:
        tables: dict[str, Any] = base | {"vehicles": {"quadrotor": {"model": "paper"} | vehicle}}
        for key, given in changes.items():
            tables[key] = tables.get(key, {}) | given if isinstance(given, dict) else given
        r = rf.simulate(rf.Mission.from_dict(tables))
        position = np.linalg.norm(r.position - r.slot_position, axis=2)
        i, j = np.triu_indices(r.n_agents, 1)
        apart, wanted = (
            np.linalg.norm(x[:, i] - x[:, j], axis=2) for x in (r.position, r.slot_position)
        )
        worst = (np.nanmax(position), np.nanmax(abs(apart - wanted)))
        rows.append((words, *(f"{x:.3f}" for x in worst)))
    return ("flown with", "position [m]", "shape, any pair [m]"), rows


def rotors() -> Table:
    """Rotor force and saturation of the paper's missions, flown by its vehicle."""
    rows = []
    for name in PAPER:
        row = [f"`{name}`"]
        for smoothness in ("lqr", "jerk"):
            tables: dict[str, Any] = rf.load_mission(name).to_dict()
            dropped = {"mass", "thrust_limit", "saturate"}
            agents = {key: x for key, x in tables["agents"].items() if key not in dropped}
            tables["agents"] = agents | {"vehicle": "quadrotor"}
            tables["vehicles"] = {"quadrotor": {"model": "paper"}}
            tables["tracking"] = tables.get("tracking", {}) | {"drag_feedforward": True}
            tables.get("disturbances", {}).pop("drag", None)
            result = rf.simulate(rf.Mission.from_dict(tables | {"smoothness": smoothness}))
            force, share = result.extreme("rotor_force"), result.extreme("saturation")
            row += [f"{force.value:.2f} N", f"{100 * share.value:.1f} %"]
        rows.append(tuple(row))
    return ("mission", "as the paper flies it", "", "smooth", ""), rows


def damping() -> Table:
    """Table 1 with the deformation damping of rigidfleet, with half of it, and without, as the paper's law is."""
    tables, rows, usual = rf.load_mission("establish-triangle").to_dict(), [], None
    for rate in (1.0, 0.5, 0.0):
        changed = tables | {"constraint": {"deformation_damping": rate}}
        result = rf.simulate(rf.Mission.from_dict(changed))
        usual = result.position[-1] if usual is None else usual
        peak = np.linalg.norm(result.constraint_force, axis=2).max()
        apart = np.linalg.norm(result.position[-1] - usual, axis=1)
        rows.append((f"{rate:g}", f"{peak:.2f}", ", ".join(f"{d:.1f}" for d in apart)))
    head = (
        "damping [1/s]",
        "peak of a constraint force [N]",
        "ends of agents 1 to 3 [m] from those at 1",
    )
    return head, rows


def gusts() -> Table:
    """The flights of examples/gusts.py."""
    flights = runpy.run_path(str(HERE.parent / "examples" / "gusts.py"))["main"]()
    words = {
        "calm": "calm air",
        "gusts": "the law is told the force of the gusts (`force=`)",
        "gusts, f_C on board": "$f_C$ on board at 100 Hz, not told",
        "gusts, tracking alone": "tracking alone (no edges)",
    }
    rows = [
        (text, f"{worst['f_C']:.2f}", f"{1e3 * worst['pair']:.2f}", f"{1e3 * worst['slot']:.0f}")
        for worst, text in ((flights[name], text) for name, text in words.items())
    ]
    return ("", "peak $f_C$ [N]", "worst error of a pair [mm]", "of a slot [mm]"), rows


def vectors() -> Table:
    """Eight flights of the windy passage side by side, and alone, beside flights at the tightest tolerances."""

    def varied(**integrator: float) -> list[rf.Mission]:
        missions = []
        for k in range(8):
            tables: dict[str, Any] = rf.load_mission("windy-passage").to_dict()
            tables["agents"]["mass"] = [1.0 + 0.02 * k, 1.0 - 0.01 * k, 1.0 + 0.003 * k]
            for name in ("gusts", "noise"):
                tables["disturbances"][name]["seed"] = 5 * k
            if integrator:
                tables["integrator"] = integrator
            missions.append(rf.Mission.from_dict(tables))
        return missions

    true = [rf.simulate(mission) for mission in varied(rtol=1e-12, atol=1e-12)]
    alone, rows = [rf.simulate(mission) for mission in varied()], []
    for words, flown in (("alone", alone), ("side by side", simulate_together(varied()))):
        worst = (
            max(
                float(np.linalg.norm(getattr(r, name) - getattr(t, name), axis=2).max())
                for r, t in zip(flown, true, strict=True)
            )
            for name in ("position", "velocity", "acceleration")
        )
        rows.append((words, *(f"{x:.0e}" for x in worst)))
    return ("", "position [m]", "velocity [m/s]", "acceleration [m/s²]"), rows


TABLES: dict[str, Callable[[], Table]] = {
    "errors": errors, "rotors": rotors, "damping": damping, "gusts": gusts, "vectors": vectors,
}  # fmt: skip


def render(page: str) -> str:
    """A page with its tables as they are flown now."""

    def table(match: re.Match[str]) -> str:
        head, rows = TABLES[match[1]]()
        lines = [head, ("---",) * len(head), *rows]
        text = "\n".join(f"| {' | '.join(row)} |" for row in lines)
        return f"<!-- flown: {match[1]} -->\n{text}\n<!-- end -->"

    return re.sub(r"<!-- flown: (\w+) -->\n.*?<!-- end -->", table, page, flags=re.DOTALL)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(render(path.read_text(encoding="utf-8")), encoding="utf-8")
