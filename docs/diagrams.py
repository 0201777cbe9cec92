"""The drawings of the documents: the paper's diagrams redrawn, and what its law does, computed."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Rectangle

from rigidfleet import physics, simulate
from rigidfleet.formation.graphs import complete_graph
from rigidfleet.formation.shapes import slots
from rigidfleet.kernel.records import FROM_KNOTS, KNOTS, bernstein_basis
from rigidfleet.math import attitude, pid
from rigidfleet.math.constraint_jacobian import filter_factors
from rigidfleet.math.rigid_body import kabsch
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.abort import Aborts
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.timing import complete_times, legs_up_to
from rigidfleet.plotting.style import DASHES, FAINT, FLOWN, GREY, INK, PALETTE, TONES

BLUE, ORANGE, GREEN, RED = PALETTE[:4]
PALE = "#F4F7FA"


def canvas(width: float, height: float, unit: float = 0.62) -> tuple[Figure, Axes]:
    """Figure of a drawing whose axes count in units of `unit` inches."""
    fig = Figure(figsize=(unit * width, unit * height))
    ax = fig.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, width), ylim=(0, height))
    ax.set_aspect("equal")
    ax.axis("off")
    return fig, ax


def box(
    ax: Axes,
    x: float,
    y: float,
    text: str,
    *,
    w: float = 3.0,
    h: float = 1.3,
    colour: str = TONES[1],
) -> None:
    """A block about (x, y)."""
    ax.add_patch(
        FancyBboxPatch(
            (x - w / 2, y - h / 2), w, h, boxstyle="round,pad=0,rounding_size=0.14",
            facecolor=PALE, edgecolor=colour, linewidth=1.3, zorder=2,
        )
    )  # fmt: skip
    ax.text(x, y, text, ha="center", va="center", fontsize=9, zorder=3, linespacing=1.35)


def arrow(
    ax: Axes,
    *points: tuple[float, float],
    text: str = "",
    at: float = 0.5,
    above: float = 0.22,
    colour: str = INK,
) -> None:
    """A signal along points, with its name beside the first stretch."""
    for a, b in pairwise(points[:-1]):
        ax.plot(
            *zip(a, b, strict=True), color=colour, linewidth=1.1, zorder=1, solid_capstyle="round"
        )
    ax.add_patch(
        FancyArrowPatch(
            points[-2], points[-1], arrowstyle="-|>", mutation_scale=10, color=colour,
            linewidth=1.1, shrinkA=0, shrinkB=0, zorder=1,
        )
    )  # fmt: skip
    if text:
        (x0, y0), (x1, y1) = points[0], points[1]
        x, y = x0 + at * (x1 - x0), y0 + at * (y1 - y0)
        level = abs(y1 - y0) < 1e-9
        ax.text(
            x + (0 if level else above), y + (above if level else 0), text, fontsize=8.5, color=colour,
            ha="center" if level else "left", va="center",
        )  # fmt: skip


def sum_sign(ax: Axes, x: float, y: float) -> None:
    """Where signals are added."""
    ax.plot(x, y, "o", markersize=17, markerfacecolor="white", markeredgecolor=INK, zorder=2)
    ax.text(x, y, "+", ha="center", va="center", fontsize=11, zorder=3)


# -- the paper's diagrams ------------------------------------------------------------------------------


def edge() -> Figure:
    """Two agents and their edge (Fig. 1)."""
    fig, ax = canvas(11, 4.2)
    a, b = np.array([2.4, 1.2]), np.array([8.4, 2.6])
    u = (a - b) / np.linalg.norm(a - b)
    ax.plot(*zip(a, b, strict=True), color=FLOWN, linewidth=2.5, zorder=1)
    for p, name, side, colour in ((a, "i", -1, BLUE), (b, "j", 1, ORANGE)):
        ax.plot(*p, "o", markersize=24, color=colour, zorder=3)
        ax.text(*p, f"${name}$", ha="center", va="center", color="white", fontsize=12, zorder=4)
        arrow(ax, tuple(p), tuple(p + side * 2.0 * u), colour=RED)
    ax.text(*(a - 2.1 * u + [0.0, 0.42]), r"$\lambda_k u_k$", color=RED, fontsize=10, ha="center")
    ax.text(*(b + 2.1 * u + [0.1, 0.5]), r"$-\lambda_k u_k$", color=RED, fontsize=10, ha="center")
    middle = (a + b) / 2
    ax.text(*(middle + [0.1, -0.62]), r"$L_k=|r_i-r_j|$", fontsize=11, ha="left")
    ax.text(0.4, 3.72, r"error $c_k=L_k-d_k$", fontsize=10.5)
    ax.text(0.4, 3.22, r"unit vector $u_k=(r_i-r_j)/L_k$", fontsize=10.5)
    ax.text(
        10.6,
        0.42,
        r"too long: $\lambda_k<0$, the edge pulls, equally and oppositely",
        fontsize=9,
        ha="right",
        color=GREY,
    )
    return fig


def frame() -> Figure:
    """Agents, their centre of mass and a frame that goes with them (Fig. 2)."""
    fig, ax = canvas(11, 5.4)
    origin = np.array([1.0, 0.7])
    cm = np.array([6.3, 2.7])
    for v, name in (((1.6, 0), "$x$"), ((0, 1.6), "$z$")):
        arrow(ax, tuple(origin), tuple(origin + v))
        ax.text(*(origin + 1.18 * np.array(v)), name, ha="center", va="center", fontsize=10)
    ax.text(0.95, 0.3, "world (east, north, up)", fontsize=8.5, color=GREY)
    arrow(ax, tuple(origin), tuple(cm), colour=GREY)
    ax.text(3.3, 2.05, r"$r_{cm}$", fontsize=11, color=GREY)
    angle = np.deg2rad(24.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for v, name in (((1.9, 0), "$x_b$"), ((0, 1.9), "$z_b$")):
        tip = cm + turn @ v
        arrow(ax, tuple(cm), tuple(tip), colour=RED)
        ax.text(*(cm + 1.13 * (tip - cm)), name, ha="center", va="center", fontsize=10.5, color=RED)
    places = cm + (turn @ np.array([[-2.7, -0.7], [3.0, -1.4], [-1.5, 2.0]]).T).T * 0.95
    for k, p in enumerate(places):
        q = places[(k + 1) % 3]
        ax.plot([p[0], q[0]], [p[1], q[1]], color=FLOWN, linewidth=1.6, zorder=0)
        ax.plot(*p, "o", markersize=21, color=PALETTE[k], zorder=3)
        ax.text(*p, str(k + 1), ha="center", va="center", color="white", fontsize=10, zorder=4)
    arrow(ax, tuple(cm), tuple(cm + 0.86 * (places[1] - cm)))
    ax.text(
        *(cm + 0.55 * (places[1] - cm) + [0.0, -0.42]), r"$\delta r_2$", fontsize=11, ha="center"
    )
    ax.plot(*cm, "o", markersize=6, color=INK, zorder=4)
    return fig


def constraint_architecture() -> Figure:
    """Constraint forces alone (Fig. 4): control = "open"."""
    fig, ax = canvas(16, 5.0)
    box(ax, 2.0, 3.6, "desired distances\n" r"$d,\ \dot d,\ \ddot d$")
    box(ax, 6.4, 3.6, "constraint force\n" r"$f_C=J^T\lambda$  Eq. (12)", w=3.8, colour=RED)
    box(ax, 2.0, 1.3, "weight balance\n" r"$f_{u,i}=m_i g$")
    sum_sign(ax, 9.7, 3.6)
    box(ax, 13.0, 3.6, "agents\n" r"$m_i\ddot r_i=f_{E,i}+f_{u,i}+f_{C,i}$", w=4.4)
    arrow(ax, (3.5, 3.6), (4.5, 3.6))
    arrow(ax, (8.3, 3.6), (9.4, 3.6), text="$f_C$")
    arrow(ax, (10.0, 3.6), (10.8, 3.6))
    arrow(ax, (3.5, 1.3), (9.7, 1.3), (9.7, 3.28), text="$f_u$", at=0.85)
    arrow(ax, (13.0, 2.95), (13.0, 2.1), (6.4, 2.1), (6.4, 2.95), text="$r,\\ \\dot r$")
    return fig


def body_architecture() -> Figure:
    """A wrench on the virtual body (Fig. 6 and 12): architecture = "body"."""
    fig, ax = canvas(18.4, 6.6)
    box(ax, 1.9, 5.1, "waypoint\n" r"$r_{wp},v_{wp},q_{wp},\omega_{wp}$", w=3.2)
    box(ax, 6.0, 5.1, "LQR on the\nvirtual body", w=2.8, colour=BLUE)
    box(ax, 9.9, 5.1, "allocation\nEqs. (24)-(27)", w=2.8, colour=BLUE)
    sum_sign(ax, 12.4, 5.1)
    box(ax, 15.6, 5.1, "agents\n" r"$m_i\ddot r_i=f_{E,i}+f_{u,i}+f_{C,i}$", w=4.4)
    box(ax, 9.9, 2.9, "constraint force\n" r"$f_C=J^T\lambda$", w=2.8, colour=RED)
    box(ax, 6.0, 0.9, "virtual body\n" r"$r_{cm},v_{cm},q,\omega$", w=2.8)
    box(ax, 6.0, 2.9, "desired distances", w=2.8)
    arrow(ax, (3.5, 5.1), (4.6, 5.1))
    arrow(ax, (7.4, 5.1), (8.5, 5.1), text=r"$F,\ \tau$")
    arrow(ax, (11.3, 5.1), (12.1, 5.1), text="$f_u$")
    arrow(ax, (12.7, 5.1), (13.4, 5.1))
    arrow(ax, (7.4, 2.9), (8.5, 2.9), text="$d$")
    arrow(ax, (11.3, 2.9), (12.4, 2.9), (12.4, 4.78), text="$f_C$")
    arrow(ax, (15.6, 4.45), (15.6, 0.9), (7.4, 0.9), text=r"$r_i,\ \dot r_i$", at=0.55)
    arrow(ax, (9.9, 0.9), (9.9, 2.25))
    arrow(ax, (4.6, 0.9), (3.9, 0.9), (3.9, 4.3), (5.2, 4.3), (5.2, 4.45))
    return fig


def local_architecture() -> Figure:
    """Each agent tracks its slot (section V of the paper): architecture = "local", the default."""
    fig, ax = canvas(18.4, 5.8)
    box(ax, 1.9, 4.4, "waypoint\nand formation", w=3.0)
    box(
        ax,
        6.0,
        4.4,
        "virtual body's flight\n" r"$r_{cm}^*(t),\ T^*(t),\ p_i(t)$",
        w=3.6,
        colour=BLUE,
    )
    box(ax, 10.3, 4.4, "each agent tracks\n" r"$r_i^*=r_{cm}^*+T^{*T}p_i$", w=3.4, colour=BLUE)
    sum_sign(ax, 13.0, 4.4)
    box(ax, 16.1, 4.4, "agents\n" r"$m_i\ddot r_i=f_{E,i}+f_{u,i}+f_{C,i}$", w=4.2)
    box(ax, 10.3, 2.0, "constraint force\n" r"$f_C=J^T\lambda$", w=3.4, colour=RED)
    arrow(ax, (3.4, 4.4), (4.2, 4.4))
    arrow(ax, (7.8, 4.4), (8.6, 4.4))
    arrow(ax, (12.0, 4.4), (12.7, 4.4), text="$f_u$")
    arrow(ax, (13.3, 4.4), (14.0, 4.4))
    arrow(ax, (6.0, 3.75), (6.0, 2.0), (8.6, 2.0), text=r"$d_{ij}=|p_i-p_j|$", at=0.62)
    arrow(ax, (12.0, 2.0), (13.0, 2.0), (13.0, 4.08), text="$f_C$")
    arrow(
        ax, (16.1, 3.75), (16.1, 0.7), (10.3, 0.7), (10.3, 1.35), text=r"$r_i,\ \dot r_i$", at=0.6
    )
    arrow(ax, (8.2, 0.7), (8.2, 3.2), (9.4, 3.2), (9.4, 3.75))
    ax.plot([8.2, 10.3], [0.7, 0.7], color=INK, linewidth=1.1)
    return fig


# -- what the law does -----------------------------------------------------------------------------------


def singular_line() -> Figure:
    """Near a line, the same correction takes ever more force."""
    fig = Figure(figsize=(9.0, 3.2), layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=(1, 1.15))
    left.set_aspect("equal")
    left.axis("off")
    for h, alpha in ((1.6, 0.25), (0.8, 0.5), (0.3, 1.0)):
        x, y = (-4, 0, 4), (0, h, 0)
        left.plot(x, y, color=FLOWN, linewidth=2, alpha=alpha, zorder=1)
        left.plot(x, y, "o", color=BLUE, markersize=9, alpha=alpha, zorder=2)
    left.annotate("", (0, -1.4), (0, 0.2), arrowprops={"arrowstyle": "-|>", "color": RED})
    left.text(0.25, -1.0, "no edge points this way", color=RED, va="center")
    left.text(0.25, 1.25, "$h$", fontsize=11)
    left.set(xlim=(-4.6, 4.6), ylim=(-1.9, 2.3))
    h = np.geomspace(1e-3, 2.0, 80)
    edges, masses = complete_graph(3), np.ones(3)
    for solver, colour, name in (
        ("exact", RED, "the law as printed"),
        ("iterated", BLUE, "iterated (default)"),
    ):
        size = []
        for offset in h:
            r = np.array([[-4.0, 0, 0], [0, offset, 0], [4.0, 0, 0]])
            lengths = np.linalg.norm(r[edges[:, 0]] - r[edges[:, 1]], axis=1)
            out = physics.constraint_force(
                r, np.zeros((3, 3)), masses, edges, lengths, solver=solver, alpha=0, beta=0, gamma=0,
                d_ddot=[0.0, 1.0, 0.0],
            )  # fmt: skip
            size.append(np.abs(out.multiplier).max())
        right.loglog(h, size, color=colour, label=name, linewidth=2)
    right.loglog(h, 8 / 3 / h**2, color=INK, linewidth=0.9, linestyle=DASHES, label=r"$8/(3h^2)$")
    right.set(
        xlabel="offset $h$ of the middle agent [m]",
        ylabel=r"greatest tension $|\lambda|$ [N]",
        ylim=(0.3, 3e6),
    )
    right.set_title(r"to lengthen edge 1-3 by 1 m/s$^2$")
    right.legend(loc="upper right")
    return fig


def overshoot() -> Figure:
    """An integral has to return to zero, so the error has to pass zero."""
    fig = Figure(figsize=(9.0, 2.8), layout="constrained")
    left, right = fig.subplots(1, 2)
    t = np.linspace(0.0, 5.0, 400)
    for ax, gamma, name in (
        (left, 8.0, r"with an integral ($\gamma=8$)"),
        (right, 0.0, r"without ($\gamma=0$)"),
    ):
        c, _, integral = pid.error_response(3.0, np.sqrt(12.0), gamma, 1.0, 0.0, 0.0, t)
        ax.fill_between(t, c, 0, where=c > 0, color=BLUE, alpha=0.15, linewidth=0)
        ax.fill_between(t, c, 0, where=c < 0, color=RED, alpha=0.25, linewidth=0)
        ax.plot(t, c, color=BLUE, linewidth=2, label="error $c$")
        ax.plot(t, integral, color=ORANGE, linewidth=1.6, label="its integral $I$")
        ax.axhline(0, color=GREY, linewidth=0.7)
        ax.set(xlabel="time [s]", title=name, ylim=(-0.35, 1.05))
    left.annotate("overshoot 24.9 %", (1.5, -0.249), (2.4, -0.24), va="center", fontsize=8.5,
                  arrowprops={"arrowstyle": "-", "color": GREY})  # fmt: skip
    left.legend(loc="upper right")
    right.text(4.95, 0.4, "$I$ never returns, nor need it", ha="right", fontsize=8.5, color=GREY)
    return fig


def solvers() -> Figure:
    """How strongly each solve answers along an eigenvector of A."""
    fig = Figure(figsize=(9.0, 3.0), layout="constrained")
    ax = fig.subplots()
    w = np.geomspace(1e-4, 10.0, 500)
    ax.loglog(w, 1 / w, color=RED, linewidth=1.6, label="exact: $1/w$")
    ax.loglog(
        w,
        filter_factors(w, "iterated") / w,
        color=BLUE,
        linewidth=2.2,
        label=r"iterated: $\leq k/\mu$ = 100",
    )
    ax.loglog(
        w,
        filter_factors(w, "spectral") / w,
        color=GREEN,
        linewidth=2.2,
        label="spectral: exact from $s_0$ = 0.1 on",
    )
    # Where no curve runs through the words.
    marks = ((1.5, "triangle"), (0.259, "cube"), (0.05, "cuboid"), (8e-4, "line, 8 cm off"))
    for at, name in marks:
        ax.vlines(at, 0.5, 2e4, color=FAINT, linewidth=0.9, linestyle=":")
        ax.text(at, 1.5e4, f" {name}", fontsize=8, color=GREY, va="top")
    ax.set(
        xlabel=r"eigenvalue $w$ of $\bar m A$", ylabel=r"gain $\varphi(w)/\bar m$", ylim=(0.08, 2e4)
    )
    ax.legend(loc="lower left")
    return fig


def blend() -> Figure:
    """The septic from 0 to 1 and its derivatives, and a triangle on its way to a line."""
    fig = Figure(figsize=(9.0, 3.0), layout="constrained")
    left, right = fig.subplots(1, 2)
    tau = np.linspace(0, 1, 300)
    s = np.polynomial.Polynomial([0, 0, 0, 0, 35, -84, 70, -20])
    for k, (name, colour) in enumerate(
        (("$s$", BLUE), (r"$\dot s\,T_b$", ORANGE), (r"$\ddot s\,T_b^2$", GREEN))
    ):
        left.plot(tau, s.deriv(k)(tau) if k else s(tau), color=colour, linewidth=1.8, label=name)
    left.set(xlabel=r"$\tau$", title="the blend is smooth at both ends")
    left.legend(loc="upper right")
    before, after = slots("triangle", 4.0, 3), slots("line", 4.0, 3)
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        p = _on_the_way(before, after, share)
        ring = np.vstack([p, p[:1]])
        right.plot(ring[:, 0], ring[:, 1], color=TONES[2], linewidth=0.8 + share, zorder=1)
        for i, colour in enumerate(PALETTE[:3]):
            right.plot(p[i, 0], p[i, 1], "o", color=colour, markersize=4 + 5 * share, zorder=2)
    right.set_aspect("equal", adjustable="datalim")
    right.set(
        xlabel="$x_b$ [m]", ylabel="$y_b$ [m]", title="slots, small at the start, large at the end"
    )
    return fig


def _on_the_way(before: np.ndarray, after: np.ndarray, share: float) -> np.ndarray:
    """Slots (N, 3) [m] at a share of the way: straight in a frame that turns (theory.md, section 4)."""
    R = kabsch(before, after)
    turn = attitude.dcm_from_rotation_vector(share * attitude.rotation_vector_from_dcm(R))
    return (before + share * (after @ R.T - before)) @ turn


def no_inverse() -> Figure:
    """Forces m x push no one anywhere: H cannot tell them, so H^T H has no inverse."""
    fig = Figure(figsize=(9.0, 3.1), layout="constrained")
    axes = fig.subplots(1, 3)
    x = slots("triangle", 4.0, 3)[:, :2]
    asked = np.tile([0.0, 1.3], (3, 1))
    radial = 0.55 * x
    titles = ("lift", "and forces along $\\delta r_i$ ...", "... are the same wrench")
    for ax, f, title in zip(axes, (asked, radial, asked + radial), titles, strict=True):
        ring = np.vstack([x, x[:1]])
        ax.plot(*ring.T, color=FLOWN, linewidth=1.4, zorder=1)
        for p, v, colour in zip(x, f, PALETTE[:3], strict=True):
            ax.plot(*p, "o", color=colour, markersize=9, zorder=3)
            ax.annotate(
                "", p + v, p, arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.5}
            )
        ax.plot(0, 0, "+", color=GREY, markersize=9)
        ax.set_title(title)
        ax.set_aspect("equal")
        ax.set(xlim=(-3.2, 4.2), ylim=(-4.0, 4.9))
        ax.axis("off")
    words = ("$F$ = 3.9 N up, $\\tau$ = 0", "$F$ = 0, $\\tau$ = 0", "$F$ = 3.9 N up, $\\tau$ = 0")
    for ax, text in zip(axes, words, strict=True):
        ax.text(0.5, -3.9, text, ha="center", fontsize=9, color=GREY)
    return fig


def realisations() -> Figure:
    """Shapes that distances cannot tell apart."""
    fig = Figure(figsize=(9.0, 2.7), layout="constrained")
    axes = fig.subplots(1, 3)
    kite = np.array([[0, 0], [3, -1.5], [3, 1.5], [5, 0]], dtype=float)
    folded = kite.copy()
    folded[3] = [1, 0]
    mirrored = kite * [1, -1]
    edges = ((0, 1), (0, 2), (1, 2), (1, 3), (2, 3))
    names = ("what was meant", "folded: the same five lengths", "other side up: all six the same")
    for ax, p, name in zip(axes, (kite, folded, mirrored), names, strict=True):
        for i, j in edges:
            ax.plot(*zip(p[i], p[j], strict=True), color=FLOWN, linewidth=1.6, zorder=1)
        for k, q in enumerate(p):
            ax.plot(*q, "o", color=PALETTE[k], markersize=14, zorder=2)
            ax.text(*q, str(k + 1), ha="center", va="center", color="white", fontsize=8.5, zorder=3)
        ax.set_title(name)
        ax.set_aspect("equal")
        ax.set(xlim=(-0.8, 5.8), ylim=(-2.2, 2.2))
        ax.axis("off")
    return fig


def error_budget() -> Figure:
    """Errors of the passage with quadrotors, from the table of vehicles.md."""
    page = Path(__file__).with_name("vehicles.md").read_text(encoding="utf-8")
    section = page.split("## Where errors come from")[1].split("![")[0]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")]
    words = [row[0].replace("`", "").split(" (")[0] for row in rows[2:]]
    errors = np.array([[float(value) for value in row[1:]] for row in rows[2:]])
    fig = Figure(figsize=(7.6, 4.2), layout="constrained")
    ax = fig.add_subplot()
    at = np.arange(len(words))
    for k, (name, colour) in enumerate((("position", BLUE), ("shape, any pair", ORANGE))):
        bars = ax.barh(at + 0.2 * (2 * k - 1), errors[:, k], 0.36, color=colour, label=name)
        ax.bar_label(bars, fmt="{:.3g}", padding=3, color=INK, fontsize=8)
    ax.set(yticks=at, xscale="log", xlim=(1e-3, 4.0), xlabel="greatest error [m]")
    ax.set_yticklabels([textwrap.fill(word, 38) for word in words], fontsize=8)
    ax.invert_yaxis()
    ax.legend(loc="upper right", frameon=False)
    ax.spines[["top", "right"]].set_visible(False)
    return fig


def way_found() -> Figure:
    """The passage of narrow-passage-found from above, as it is found: formations at the ends of its phases."""
    mission = complete_times(load_mission("narrow-passage-found"))
    planned = [p for p in preview_phases(mission)[0] if p.phase.startswith("through the passage")]
    fig = Figure(figsize=(7.6, 3.6), layout="constrained")
    ax = fig.add_subplot()
    for thing in mission.obstacles:
        if thing.kind == "box" and "wall" in thing.name:
            low, high = np.array(thing.min), np.array(thing.max)
            ax.add_patch(Rectangle((low[1], low[0]), *(high - low)[[1, 0]], color=FAINT))
    for phase in planned:
        for i, colour in enumerate(PALETTE[:3]):
            ax.plot(*phase.position[:, i, [1, 0]].T, color=colour, linewidth=1.0, alpha=0.6)
    stops = [planned[0].position[0], *(p.position[-1] for p in planned)]
    along = planned[2].position[len(planned[2].position) // 2]
    for places in (*stops, along):
        ax.plot(*np.vstack([places, places[:1]])[:, [1, 0]].T, color=FLOWN, linewidth=1.2)
        for x, colour in zip(places, PALETTE[:3], strict=True):
            ax.plot(x[1], x[0], "o", color=colour, markersize=6)
    ax.set(xlim=(44, 96), ylim=(52, 38), xlabel="y [m]", ylabel="x [m]")
    ax.set_aspect("equal")
    ax.spines[["top", "right"]].set_visible(False)
    return fig


def moving_obstacles() -> Figure:
    """The flight of moving-obstacles from above: paths, and where vehicles and balls are at three moments."""
    mission = load_mission("moving-obstacles")
    result = simulate(mission)
    fig = Figure(figsize=(7.6, 3.6), layout="constrained")
    ax = fig.add_subplot()
    for i in range(8):
        ax.plot(*result.position[:, i, :2].T, color=PALETTE[0], linewidth=0.7, alpha=0.6)
    for moment, colour in zip((8.4, 11.0, 13.5), PALETTE[1:4], strict=True):
        k = int(np.searchsorted(result.time, moment))
        label = f"{result.time[k]:.1f} s"
        ax.plot(*result.position[k, :, :2].T, "o", color=colour, markersize=4, label=label)
        for thing in mission.obstacles:
            place = np.array(thing.centre) + result.time[k] * np.array(thing.velocity)
            ax.add_patch(Circle(place[:2], thing.radius, color=colour, alpha=0.35))
    ax.set(xlim=(-4, 36), ylim=(-9, 9), xlabel="x [m]", ylabel="y [m]")
    ax.set_aspect("equal")
    ax.legend(loc="upper left", frameon=False)
    ax.spines[["top", "right"]].set_visible(False)
    return fig


def way_home() -> Figure:
    """An abort of change-of-picture from the side: along the plan at a slowing clock, then home from rest."""
    fig = Figure(figsize=(9.0, 3.4), layout="constrained")
    for ax, to in zip(fig.subplots(1, 2, sharey=True), ("any", "own"), strict=True):
        data = load_mission("change-of-picture").to_dict() | {"abort": {"to": to}}
        mission = complete_times(Mission.from_dict(data))
        aborts = Aborts(mission, legs_up_to(mission, len(mission.phases)))
        abort = aborts.abort_at(19.0)
        before = aborts.plan.at(np.linspace(16.0, abort.begins, 20))
        t = abort.begins
        parts = [(before, FAINT, 1.0)]
        for k, step in enumerate(abort.steps):
            r = abort.positions_at(np.linspace(t, t + step.duration - 1e-9, 2 if k else 12))
            parts.append((r, ORANGE if k == 0 else BLUE, 2.0 if k == 0 else 1.0))
            t += step.duration
        for r, colour, width in parts:
            ax.plot(r[..., 0], r[..., 2], color=colour, linewidth=width)
        ax.plot(*abort.steps[0].end[:, [0, 2]].T, "o", color=ORANGE, markersize=4)
        ax.plot(*abort.steps[-1].end[:, [0, 2]].T, "o", color=INK, markersize=4)
        ax.set(xlabel="x [m]", title=abort.home.way)
        ax.set_aspect("equal")
        ax.spines[["top", "right"]].set_visible(False)
    fig.axes[0].set_ylabel("z [m]")
    return fig


def monitor() -> Figure:
    """The trail, from which the integrator's steps are searched, and the bound by which a step is passed over."""
    fig = Figure(figsize=(9.0, 3.1))
    ax = fig.add_axes((0.01, 0.0, 0.5, 1.0))
    ax.set(xlim=(-0.3, 10.3), ylim=(0.0, 7.2))
    ax.axis("off")
    colours = [PALE] * 3 + [ORANGE] + [BLUE] * 4 + [PALE] * 2
    for row, colour in enumerate(colours):
        alpha = 1.0 if colour == PALE else 0.35
        ax.add_patch(
            Rectangle((row, 3.0), 0.92, 1.3, facecolor=colour, alpha=alpha, linewidth=0, zorder=1)
        )
        ax.add_patch(Rectangle((row, 3.0), 0.92, 1.3, fill=False, edgecolor=GREY, linewidth=0.9))
    notes = (
        (1.4, 5.4, "searched:\nroom for others", GREY), (3.46, 1.5, "searched, stays:\nits end may be\na peak", ORANGE),
        (5.95, 5.4, "steps to search", BLUE), (8.46, 1.5, "the integrator\nwrites the next\nstep here", INK),
    )  # fmt: skip
    for x, y, text, colour in notes:
        up = y > 3.6
        ax.text(x, y, text, ha="center", va="bottom" if up else "top", fontsize=8.5, color=colour)
        start, end = (y - 0.1, 4.4) if up else (y + 0.1, 2.9)
        arrow(ax, (x, start), (x, end), colour=colour)
    back = (9.96, 3.65), (10.2, 3.65), (10.2, 6.9), (-0.2, 6.9), (-0.2, 3.65), (-0.02, 3.65)
    arrow(ax, *back, colour=FAINT)
    ax.text(
        5.0, 6.8, "the first row follows the last", ha="center", va="top", fontsize=8.5, color=GREY
    )
    ax = fig.add_axes((0.58, 0.17, 0.4, 0.73))
    points, x = np.array([3.1, 1.5, 1.1, 2.3, 2.6]), np.linspace(0.0, 1.0, 200)
    ax.plot(x, bernstein_basis(x) @ points, color=BLUE, linewidth=2, label="value over a step")
    for half, label in ((0.0, "control points of its halves"), (1.0, None)):
        part = FROM_KNOTS @ (bernstein_basis((KNOTS + half) / 2.0) @ points)
        ax.plot(
            (KNOTS + half) / 2.0,
            part,
            "o-",
            color=GREEN,
            linewidth=0.8,
            markersize=3.5,
            label=label,
        )
    ax.plot(KNOTS, points, "o--", color=FAINT, linewidth=0.9, markersize=4, label="control points")
    ax.axhline(1.35, color=RED, linewidth=1.2)
    ax.text(0.99, 1.3, "worst so far", color=RED, ha="right", va="top", fontsize=8.5)
    ax.set(xlabel="share of the step", ylim=(0.9, 3.6), xlim=(-0.02, 1.02))
    ax.legend(loc="upper right", fontsize=8)
    return fig


def by_messages() -> Figure:
    """What one vehicle knows of another: messages, late or lost, and where the other is taken to be in between."""
    fig = Figure(figsize=(9.0, 4.0))
    above = fig.add_axes((0.09, 0.66, 0.88, 0.31))
    below = fig.add_axes((0.09, 0.12, 0.88, 0.5), sharex=above)
    tick, late, end = 0.1, 0.14, 1.6
    sent, lost = np.arange(0.0, end, tick), {3, 7, 8, 9, 10}
    above.axis("off")
    for y, name in ((1.0, "it sends"), (0.0, "this one\nhears")):
        above.plot([0, end], [y, y], color=FAINT, linewidth=1.2)
        above.text(-0.02, y, name, ha="right", va="center", fontsize=9, color=INK)
    above.plot(sent, np.ones_like(sent), "|", color=INK, markersize=9)
    heard = []
    for k, t in enumerate(sent.tolist()):
        if k in lost:
            above.plot([t, t + 0.45 * late], [1.0, 0.55], color=RED, linewidth=1.0)
            above.plot(t + 0.45 * late, 0.55, "x", color=RED, markersize=5)
        elif t + late <= end:
            arrow(above, (t, 1.0), (t + late, 0.04), colour=BLUE)
            heard.append(t)
    above.set_ylim(-0.25, 1.25)
    x = np.linspace(0.0, end, 1601)
    slot, gust = 1.1 * x - 0.25 * np.sin(2.6 * x), 0.12 * np.sin(4.2 * x + 0.8) - 0.05
    below.plot(x, slot, color=FAINT, linewidth=1.4, label="its slot, as planned")
    below.plot(x, slot + gust, color=INK, linewidth=1.6, label="where it is")
    speed, pull = (np.gradient(gust, x), np.gradient(np.gradient(gust, x), x))
    for k, t in enumerate(heard):
        until = heard[k + 1] + late if k + 1 < len(heard) else end
        part, at = (x >= t + late) & (x <= until), round(t / x[1])
        age = x[part] - t
        taken = slot[part] + gust[at] + age * (speed[at] + 0.5 * age * pull[at])
        label = "where it is taken to be" if k == 0 else None
        below.plot(x[part], taken, color=BLUE, linewidth=2.0, label=label)
        below.plot(t, slot[at] + gust[at], "o", color=BLUE, markersize=4)
    below.set(xlim=(0, end), xlabel="time [s]", ylabel="along the path [m]")
    below.legend(loc="upper left", frameon=False)
    below.spines[["top", "right"]].set_visible(False)
    return fig


DIAGRAMS: Sequence[Callable[[], Figure]] = (
    edge, frame, constraint_architecture, body_architecture, local_architecture, singular_line,
    overshoot, solvers, blend, no_inverse, realisations, error_budget, way_found,
    moving_obstacles, monitor, by_messages, way_home,
)  # fmt: skip
