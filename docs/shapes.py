"""The drawings of rigidity.md and robustness.md, computed by what they are about."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import rigidfleet as rf
from rigidfleet.formation.graphs import CUBE_EDGES
from rigidfleet.formation.shapes import slots
from rigidfleet.math import pid
from rigidfleet.math.constraint_jacobian import filter_factors
from rigidfleet.mission import Mission
from rigidfleet.plotting import sketches
from rigidfleet.plotting.graph import formation_graphs_figure
from rigidfleet.plotting.style import DASHES, FLOWN, GREY, INK, PALETTE
from rigidfleet.result.lights import camera_axes
from rigidfleet.rigidity import Kind, analyse, realisations
from rigidfleet.rigidity.design import design

BLUE, ORANGE, GREEN, RED = PALETTE[:4]


def _drawn(formations: dict[str, tuple[np.ndarray, Any]]) -> Figure:
    """What `rigidfleet check --figure` draws of formations (slots, edges from 0)."""
    some = {
        name: {"slots": p, "edges": np.asarray(edges) + 1}
        for name, (p, edges) in formations.items()
    }
    p = next(iter(formations.values()))[0]
    phase = {"kind": "establish", "formation": next(iter(formations)), "until": 10.0}
    mission = Mission.from_dict(
        {
            "schema_version": 1,
            "name": "graphs",
            "agents": {"mass": 1.0, "position": p},
            "formations": some,
            "phases": [phase],
        }
    )
    judged = {name: analyse(p, np.asarray(edges)) for name, (p, edges) in formations.items()}
    return formation_graphs_figure(mission, judged)


def flexes() -> Figure:
    """A square by four, five and six distances."""
    p = slots("square", 4.0, 4)
    sides = [(0, 1), (1, 2), (2, 3), (0, 3)]
    return _drawn(
        {
            "four sides": (p, sides),
            "and a diagonal": (p, [*sides, (0, 2)]),
            "and the other": (p, [*sides, (0, 2), (1, 3)]),
        }
    )


def eighteen_edges() -> Figure:
    """Three graphs of 3N - 6 = 18 edges or little more: not all are rigid."""
    banana = [(i, j) for i in range(5) for j in range(i) if (i, j) != (1, 0)]
    other = [(i + 3 if i > 1 else i, j + 3 if j > 1 else j) for i, j in banana]
    angle = 2 * np.pi * np.arange(3) / 3
    ring = 1.6 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    two = np.vstack(
        [[0, 0, 3.0], [0, 0, -3.0], ring + [2.4, 0, 0], ring * [-1, 1, 1] - [2.4, 0, 0]]
    )
    cube = slots("cube", 4.0, 8)
    return _drawn(
        {
            "double banana": (two, [tuple(sorted(e)) for e in banana + other]),
            "the paper's cube": (cube, CUBE_EDGES),
            "designed, 3 more": (cube, design(cube, extra=3)),
        }
    )


def folded_twin() -> Figure:
    """The cube by a designed graph, and another shape whose 18 lengths are the same."""
    cube = slots("cube", 4.0, 8)
    edges = design(cube)
    found = realisations(cube, edges, starts=200).shapes
    twin = max((r for r in found if r.kind is Kind.FOLDED), key=lambda r: r.closest)
    fig = Figure(figsize=(9.0, 3.4))
    R = camera_axes(*np.radians([-62.0, 18.0]))
    told = f"its folded twin: pairs up to {twin.deviation:.1f} m off"
    for k, (p, name) in enumerate(((cube, "a cube of 18 edges"), (twin.slots, told))):
        ax = fig.add_axes((0.02 + 0.5 * k, 0.02, 0.46, 0.84))
        colours = [FLOWN] * len(edges)
        sketches.draw_graph(ax, (p - p.mean(axis=0)) @ R.T, edges, colours, None)
        ax.set_title(name)
    return fig


def crossing() -> Figure:
    """Two tetrahedra on one face: the shape is to turn the upper one inside out."""
    base = 4.0 * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.75**0.5, 0.0]])
    top = base.mean(axis=0)
    wanted = np.vstack([base, top + [0, 0, 3.2], top - [0, 0, 3.2]])
    begin = np.vstack([base, top + [0.4, 0.3, 3.2], top + [5.0, 3.0, 1.0]])
    nine = [[i, j] for i in range(1, 4) for j in range(i + 1, 6)]
    fig = Figure(figsize=(9.0, 3.0), layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=(3, 2))
    ways = (
        ("9 edges", nine, "open", RED),
        ("all 10 edges", "complete", "open", GREEN),
        ("9 edges, slots tracked", nine, "tracking", BLUE),
    )
    ends = {}
    for name, edges, control, colour in ways:
        result = rf.simulate(
            Mission.from_dict(
                {
                    "schema_version": 1,
                    "name": "crossing",
                    "agents": {"mass": 1.0, "position": begin + [0, 0, 10.0]},
                    "formations": {"bipyramid": {"slots": wanted, "edges": edges}},
                    "phases": [
                        {
                            "kind": "establish",
                            "formation": "bipyramid",
                            "until": 10.0,
                            "control": control,
                        }
                    ],
                }
            )
        )
        r = result.position
        left.plot(
            result.time, _height(r), color=colour, linewidth=3.2 if control == "tracking" else 1.8,
            alpha=0.5 if control == "tracking" else 1.0, label=name,
        )  # fmt: skip
        ends[name] = r[-1]
    left.axhline(0, color=GREY, linewidth=0.8, linestyle=DASHES)
    left.annotate("J loses rank", (7.6, 0.12), fontsize=8.5, color=GREY)
    left.set(xlabel="time [s]", ylabel="agent 5 over the face 1-2-3 [m]")
    left.legend(loc="center right", bbox_to_anchor=(1.0, 0.76))
    flat = {"9 edges": RED, "all 10 edges": GREEN}
    for k, (name, colour) in enumerate(flat.items()):
        p = ends[name]
        frame = np.linalg.svd(p[:3] - p[:3].mean(axis=0))[2]
        frame[2] = np.cross(frame[0], frame[1])
        q = (p - p[:3].mean(axis=0)) @ frame.T
        q[:, 2] *= np.sign(q[3, 2])
        x = q[:, 0] + 0.35 * q[:, 1] + 6.5 * k
        z = q[:, 2] + 0.3 * q[:, 1]
        for i, j in np.array(nine) - 1:
            right.plot(x[[i, j]], z[[i, j]], color=FLOWN, linewidth=1.4, zorder=1)
        together = np.hypot(x[4] - x[3], z[4] - z[3]) < 0.5
        for i in range(4 if together else 5):
            right.plot(x[i], z[i], "o", color=PALETTE[i], markersize=13, zorder=2)
            right.text(x[i], z[i], str(i + 1), color="white", fontsize=8, ha="center", va="center")
        if together:
            right.text(x[4] + 0.65, z[4], "and 5", color=PALETTE[4], fontsize=8, va="center")
        right.text(6.5 * k, -4.6, f"ends, {name}", color=colour, fontsize=8.5, ha="center")
    right.set(xlim=(-3.4, 9.9), ylim=(-5.0, 4.2))
    right.set_aspect("equal")
    right.axis("off")
    return fig


def _height(r: np.ndarray) -> np.ndarray:
    """Height (K,) [m] of agent 5 over the plane of agents 1 to 3, on the side of agent 4."""
    a, b, top, x = (r[:, k] - r[:, 0] for k in (1, 2, 3, 4))
    n = np.cross(a, b)
    n *= np.sign(np.einsum("ka,ka->k", n, top))[:, None]
    return np.einsum("ka,ka->k", n, x) / np.linalg.norm(n, axis=1)


def slow_modes() -> Figure:
    """An error of 1 along an eigenvector of A, by its eigenvalue, under two dampings."""
    fig = Figure(figsize=(9.0, 2.8), layout="constrained")
    axes = fig.subplots(1, 2, sharey=True)
    t = np.linspace(0.0, 20.0, 600)
    for ax, tied, title in (
        (axes[0], False, r"$\mu$ = 0.03"),
        (axes[1], True, r"$\mu$ = $w$/4, at most 0.03"),
    ):
        for w, colour in ((1.5, INK), (0.05, BLUE), (0.005, GREEN), (5e-4, ORANGE), (5e-5, RED)):
            mu = min(0.03, w / 4) if tied else 0.03
            g = float(filter_factors(w, "iterated", damping=mu))
            alpha = 3.0 * g + 0.5 * (1 - g)  # the deformation damping, as far as it is not undone
            c = pid.error_response(alpha, np.sqrt(12 * g), 8 * g, 1.0, 0.0, 0.0, t)[0]
            ax.plot(t, c, color=colour, linewidth=1.8, label=f"$w$ = {w:g}")
        ax.axhline(0, color=GREY, linewidth=0.7)
        ax.set(xlabel="time [s]", title=title)
    axes[0].set_ylabel("error $c$")
    axes[0].legend(loc="upper right", ncols=2)
    return fig


SHAPES: Sequence[Callable[[], Figure]] = (
    flexes, eighteen_edges, folded_twin, crossing, slow_modes,
)  # fmt: skip
