"""Laws of your own for each vehicle, in ten lines each, beside the built-in one, over a network that loses messages.

A cube flies 60 m in gusts. One of its vehicles is weak: it can hardly accelerate, so the others
have to wait, and all that they know of each other are messages: fifty a second, a fiftieth of a
second late, three in ten of them lost. `rf.simulate(mission, agent=law)` calls the law of each
vehicle with what that vehicle knows, and sends its message.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import rigidfleet as rf

CUBE = 4.0 * np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)
EDGES = [
    [1, 2], [1, 4], [1, 5], [1, 6], [2, 3], [2, 4], [2, 6], [2, 7], [3, 4], [3, 7], [3, 8], [4, 5], [4, 8], [5, 6],
    [5, 8], [6, 7], [6, 8], [7, 8],
]  # fmt: skip
START, END = 4.0, 14.0  # [s] of the flight


def follow(me, off, off_rate, k_p, k_d):
    """Force (3,) [N] against being off by so much, with the slot's acceleration and the weight."""
    a = me.reference_acceleration - k_p * off - k_d * off_rate
    return me.mass * (a + [0.0, 0.0, me.gravity])


def alone(me):
    """Each vehicle follows its slot, and says nothing."""
    off, off_rate = me.position - me.reference_position, me.velocity - me.reference_velocity
    return follow(me, off, off_rate, 12.0, 5.0), None


def gradient(me):
    """Each edge is a spring and a damper; a vehicle says where it is, and follows its slot only weakly."""
    off, off_rate = me.position - me.reference_position, me.velocity - me.reference_velocity
    force = follow(me, off, off_rate, 1.0, 1.4)
    for j, ((r, v), age) in me.inbox.items():
        apart = me.position - (r + age * v)  # from where the neighbour is by now
        length = np.linalg.norm(apart)
        rate = apart @ (me.velocity - v) / length
        pull = 12.0 * (length - me.distance[j]) + 3.0 * (rate - me.distance_rate[j])
        force -= me.mass * pull * apart / length
    return force, (me.position, me.velocity)


def consensus(me):
    """Each vehicle holds a copy of the virtual structure: how far it is off the plan; it says that, and follows it.

    A copy is drawn to its vehicle (the feedback by which all wait), to the neighbours' copies and to the plan.
    """
    off, off_rate = me.position - me.reference_position, me.velocity - me.reference_velocity
    copy = me.memory.get("copy", np.zeros(3))
    others = sum((theirs - copy for theirs, _ in me.inbox.values()), np.zeros(3))
    copy_rate = 8.0 * (off - copy) + 5.0 * others - 0.2 * copy
    me.memory["copy"] = copy = copy + me.dt * copy_rate
    return follow(me, off - copy, off_rate - copy_rate, 12.0, 5.0), copy


LAWS = {"each alone": alone, "consensus": consensus, "gradient": gradient, "built-in": None}
COLOURS = {
    "each alone": "#8a8f98",
    "consensus": "#b5651d",
    "gradient": "#2a7f9e",
    "built-in": "#1f2a44",
}


def mission(loss):
    """Eight points of 1 kg; the first has a thrust of 10.5 N for a weight of 9.8 N."""
    strong = {"model": "point", "mass": 1.0, "thrust_limit": 25.0, "drag": 1e-3}
    weak = strong | {"thrust_limit": 10.5}
    gusts = {"model": "first-order", "intensity": 300.0, "time_scale": 2.0, "seed": 1}
    return rf.Mission.from_dict(
        {
            "schema_version": 1,
            "name": "weak",
            "agents": {"position": CUBE + [0, 0, 20], "vehicle": ["weak"] + 7 * ["strong"]},
            "vehicles": {"strong": strong, "weak": weak},
            "autopilot": {"rate": 50.0, "formation_rate": 50.0},
            "tracking": {"Q": [1.0, 0.0], "R": 1.0},
            "network": {"rate": 50.0, "delay": 0.02, "loss": loss},
            "disturbances": {"gusts": gusts},  # accelerations of 0.3 m/s^2
            "formations": {"cube": {"slots": CUBE, "edges": EDGES}},
            "phases": [
                {"kind": "establish", "formation": "cube", "until": START},
                {"kind": "fly", "position": [60.0, 2.0, 22.0], "until": END},
                {"kind": "hold", "duration": 8.0},
            ],
        }
    )


def shape_error(result):
    """Root mean square error (K,) [m] of the distances of all pairs."""
    i, j = np.triu_indices(len(CUBE), 1)
    flown = np.linalg.norm(result.position[:, i] - result.position[:, j], axis=2)
    return np.sqrt(((flown - np.linalg.norm(CUBE[i] - CUBE[j], axis=1)) ** 2).mean(axis=1))


def draw(errors, path):
    """Draw the error of the shape over time [s], of each law: ``errors`` has (time, error) by name."""
    fig = Figure(figsize=(7.2, 3.6), layout="constrained")
    ax = fig.subplots()
    ax.axvspan(START, END, color="#f1f2f4", lw=0)
    ax.text(0.5 * (START + END), 0.985, "flies 60 m", transform=ax.get_xaxis_transform(),
            ha="center", va="top", color="#6b7078")  # fmt: skip
    for name, (time, error) in errors.items():
        ax.plot(time, error, color=COLOURS[name], lw=2.2 if name == "built-in" else 1.5)
        k = int(error.argmax())
        ax.annotate(name, (time[k], error[k]), (0, 4), textcoords="offset points", ha="center",
                    color=COLOURS[name])  # fmt: skip
    ax.set(xlabel="time [s]", ylabel="error of the shape, rms [m]", xlim=(0.0, time[-1]))
    ax.set_ylim(0.0, 1.15 * max(error.max() for _, error in errors.values()))
    ax.spines[["top", "right"]].set_visible(False)
    fig.savefig(path, dpi=160)


def main(folder="."):
    """Fly each law without losses and with 30 %; draw the latter; return errors [m], root mean squares in flight."""
    numbers, drawn = {}, {}
    print(f"{'':>10}  no loss    30 % lost   numbers a message")
    for name, law in LAWS.items():
        for loss in (0.0, 0.3):
            result = rf.simulate(mission(loss), agent=law)
            error, flying = shape_error(result), result.time > START
            numbers[name, loss] = float(np.sqrt((error[flying] ** 2).mean()))
        drawn[name] = result.time, error
        said = result.statistics.get("message_numbers", "")
        print(f"{name:>10}  {numbers[name, 0.0]:.3f} m    {numbers[name, 0.3]:.3f} m     {said}")
    draw(drawn, Path(folder) / "own-laws.png")
    return numbers


if __name__ == "__main__":
    main(*sys.argv[1:])
