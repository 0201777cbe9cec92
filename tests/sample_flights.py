"""Flights made up from formulas, for looking at: no simulation, any number of vehicles."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from rigidfleet.math import attitude as att
from rigidfleet.mission import Mission
from rigidfleet.result import LABELS, PhaseRecord, Result
from rigidfleet.simulation.flight import simulate

G = 9.81


def swarm(n: int, seconds: float, **changes) -> Result:
    """A square sheet of vehicles that circles, turns and waves; edges to the nearest neighbours."""
    side = int(np.ceil(np.sqrt(n)))
    index = np.arange(n)
    slots = 3.0 * np.stack([index % side, index // side, np.zeros(n)], axis=1).astype(float)
    slots -= slots.mean(axis=0)
    edges = _neighbours(slots)
    half = seconds / 2
    t = np.concatenate([np.arange(0, half, 0.05), [half, np.nextafter(half, 1e9)]])
    t = np.concatenate([t, np.arange(half + 0.05, seconds, 0.05), [seconds]])
    yaw = 0.1 * t
    q = np.stack([np.cos(yaw / 2), 0 * t, 0 * t, np.sin(yaw / 2)], axis=1)
    cm = np.stack([20 * np.sin(0.1 * t), 20 - 20 * np.cos(0.1 * t), 12 + 0 * t], axis=1)
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = slots[:, 0], slots[:, 1]
    wanted = cm[:, None] + np.stack([c * x - s * y, s * x + c * y, 0 * c * x], axis=2)
    r = wanted.copy()
    r[:, :, 2] += 0.6 * np.sin(1.2 * t[:, None] + 0.3 * x)
    v, a = np.gradient(r, 0.05, axis=0), np.gradient(np.gradient(r, 0.05, axis=0), 0.05, axis=0)
    force = np.clip(a, -3, 3) + [0, 0, G]
    k, m = len(t), len(edges)
    distance = np.linalg.norm(r[:, edges[:, 0]] - r[:, edges[:, 1]], axis=2)
    rest = np.linalg.norm(slots[edges[:, 0]] - slots[edges[:, 1]], axis=1)
    error = distance - rest
    empty3, empty4 = np.full((k, 3), np.nan), np.full((k, 4), np.nan)
    mission = {
        "schema_version": 1,
        "name": "swarm",
        "title": f"{n} vehicles, one sheet",
        "agents": {"mass": 1.0, "position": slots + [0, 0, 12.0], "thrust_limit": 14.0},
        "formations": {"sheet": {"slots": slots, "edges": edges + 1}},
        "obstacles": [
            {"kind": "ground"},
            {"kind": "box", "name": "hall", "min": [-8.0, 45.0, 0.0], "max": [8.0, 60.0, 9.0]},
        ],
        "limits": {"separation": 1.0},
        "phases": [
            {"kind": "establish", "formation": "sheet", "blend": half, "until": half},
            {"kind": "fly", "name": "<round> & \"round\"</script>", "position": cm[-1], "until": seconds},
        ],
    }  # fmt: skip
    target = {"time": seconds, "position": cm[-1].tolist()}
    arrays: dict[str, Any] = {
        "time": t, "phase": (t > half).astype(int), "position": r, "velocity": v,
        "acceleration": a, "slot_position": wanted, "input_force": force,
        "constraint_force": np.zeros_like(r), "external_force": np.zeros_like(r),
        "thrust": np.linalg.norm(force, axis=2), "cm": r.mean(axis=1), "cm_velocity": v.mean(axis=1),
        "cm_reference": cm, "cm_velocity_reference": np.gradient(cm, 0.05, axis=0), "attitude": q,
        "attitude_reference": q, "frame": empty4, "rates": empty3, "rates_reference": empty3,
        "wrench_asked": np.zeros((k, 6)), "wrench_achieved": np.zeros((k, 6)), "edges": edges,
        "distance": distance, "distance_reference": np.tile(rest, (k, 1)),
        "distance_rate_reference": np.zeros((k, m)), "constraint": error,
        "integral": np.zeros((k, m)), "multiplier": -8.0 * error, "singular_value": np.ones(k),
        "separation": distance.min(axis=1, initial=9.0) - 0.5, "separation_pair": np.zeros((k, 2), int),
        "clearance": r[:, :, 2].min(axis=1) - 0.25, "clearance_agent": np.zeros(k, int),
        "clearance_obstacle": np.zeros(k, int),
    }  # fmt: skip
    phases = [
        PhaseRecord("establish 1", "establish", "tracking", "sheet", 0.0, half),
        PhaseRecord("<round> & \"round\"</script>", "fly", "tracking", "sheet", half, seconds, None, target),
    ]  # fmt: skip
    text = Mission.from_dict(mission).text
    rest: dict[str, Any] = {"phases": phases, "mission_text": text}
    return Result(**(arrays | rest | changes))


def _neighbours(slots: np.ndarray) -> np.ndarray:
    """Pairs no further apart than the diagonal of a square of four."""
    pairs = KDTree(slots).query_pairs(4.5, output_type="ndarray")
    return pairs[np.lexsort(pairs.T[::-1])]


def drifting(n: int, who: int, since: float, until: float, far: float, doubt: float) -> Result:
    """The sheet for 60 s as a log: one vehicle is some way east of its slot for a time [s], all others in theirs.

    Places are in doubt [m]; forces are not known.
    """
    flight = swarm(n, 60.0)
    r, t = flight.slot_position.copy(), flight.time
    r[(t >= since) & (t <= until), who, 0] += far
    facts = {
        "names": [f"log{i + 1}" for i in range(n)],
        "doubt": {"vehicles": [{"mean_off_m": 0.0} for _ in range(n)]},
        "bands": {"time": [0.0, 60.0], "place": [[doubt] * n] * 2},
    }
    unknown = {
        name: np.full_like(getattr(flight, name), np.nan)
        for name in ("multiplier", "thrust", "input_force", "constraint_force")
    }
    return replace(flight, position=r, statistics=facts, **unknown)


#: Corners of a tent that nobody may fly through, and of a place with people, beside the sheet [m].
TENT, CROWD = [[-40, -10], [-25, -10], [-25, 10], [-40, 10]], [[25, 0], [40, 0], [40, 20], [25, 20]]


def fenced(flight: Result) -> Result:
    """The flight beside a tent with a roof, people, and a field without one."""
    data = flight.mission.to_dict()
    field = [[-60, -50], [60, -50], [60, 90], [-60, 90]]
    data["fences"] = [
        {"name": "tent", "kind": "exclusion", "polygon": TENT, "ceiling": 8.0},
        {"name": "field", "kind": "inclusion", "soft": True, "polygon": field},
    ]
    data["people"] = [{"name": "crowd", "polygon": CROWD}]
    return replace(flight, mission_text=Mission.from_dict(data).text)


def quadrotors(n: int, seconds: float) -> Result:
    """The sheet of vehicles flown by quadrotors of which each points its own way and leans by 20 deg.

    Rotors give half of their limit. From a quarter of the time to the middle, the front right one of the second
    vehicle is at its limit, and the vehicle is saturated. At the middle, quaternions change their signs.
    """
    points = swarm(n, seconds)
    data = points.mission.to_dict()
    data["vehicles"] = {"quadrotor": {"model": "px4-sih"}}
    data["agents"] = {"vehicle": "quadrotor", "position": data["agents"]["position"]}
    mission = Mission.from_dict(data)
    t = points.time
    yaw = 0.2 * t[:, None] + np.arange(n)
    euler = np.stack([0.0 * yaw, np.radians(20.0) + 0.0 * yaw, yaw], axis=2)
    q = att.quaternion_from_euler(euler.reshape(-1, 3)).reshape(len(t), n, 4)
    q *= np.where(t < seconds / 2, 1.0, -1.0)[:, None, None]
    force = np.full((len(t), n, 4), 2.5)
    busy = (t > seconds / 4) & (t < seconds / 2)
    force[busy, 1, LABELS["rotor"].index("front right")] = 5.0
    saturated = np.zeros((len(t), n), dtype=int)
    saturated[busy, 1] = 1
    return replace(
        points, mission_text=mission.text, vehicle_attitude=q, vehicle_rates=np.zeros((len(t), n, 3)),
        rotor_force=force, saturated=saturated,
    )  # fmt: skip


#: A word of 65 vehicles: a row of cells for each height, from above.
WORD = (
    "#####.#.....#...#...#...#.####.",
    "#.....#.....#...#...#...#.#...#",
    "#.....#......#.#....#...#.#...#",
    "####..#.......#.....#...#.####.",
    "#.....#.......#.....#...#.#....",
    "#.....#.......#.....#...#.#....",
    "#.....#####...#......###..#....",
)


def word(*, lit: bool = True) -> Result:
    """Vehicles that stand upright as `WORD`, read from the south; their lights fade from white to amber in a second."""
    cells = [(x, -z) for z, row in enumerate(WORD) for x, cell in enumerate(row) if cell == "#"]
    slots = 2.0 * np.array([[x, 0.0, z] for x, z in cells])
    slots -= slots.mean(axis=0)
    colour = 'colour = "#ffb000"\n' if lit else ""
    text = (
        'schema_version = 1\nname = "word"\nsmoothness = "jerk"\n'
        f"[agents]\nmass = 0.3\nradius = 0.15\nposition = {(slots + [0, 0, 20.0]).tolist()}\n"
        f"[formations.word]\nslots = {slots.tolist()}\nedges = []\n{colour}"
        '[[obstacles]]\nkind = "ground"\n'
        '[[phases]]\nkind = "establish"\nformation = "word"\nblend = 1.0\nduration = 3.0\n'
    )
    return simulate(Mission.from_toml(text))


def bitmap(bright: np.ndarray) -> tuple[str, ...]:
    """A picture (height, width) of `WORD`, reduced to its cells: those bright near their middle."""
    rows, columns = np.nonzero(bright)
    high, wide = len(WORD) - 1, len(WORD[0]) - 1
    # So many steps between the middles of cells, and half a dot at each side.
    step = (np.ptp(columns) - np.ptp(rows)) / (wide - high)
    edge, about = (np.ptp(columns) - wide * step) / 2, round(0.25 * step)

    def cell(x: int, y: int) -> str:
        place = [rows.min() + edge + y * step, columns.min() + edge + x * step]
        i, j = np.round(place).astype(int)
        near = bright[max(i - about, 0) : i + about + 1, max(j - about, 0) : j + about + 1]
        return "#" if near.any() else "."

    return tuple("".join(cell(x, y) for x in range(wide + 1)) for y in range(high + 1))
