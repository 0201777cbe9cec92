"""Margins of the linear loops: against closed forms, python-control, the kernel's law, and flights in time."""

import math
from unittest.mock import patch

import control
import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.formation.graphs import complete_graph
from rigidfleet.math.constraint_jacobian import filter_factors, jacobian
from rigidfleet.math.margins import (
    Lag,
    LoopGains,
    distinct_formation_loops,
    is_stable,
    largest_stable_pole,
    stability_margins,
    tracking_loops,
)
from rigidfleet.physics import constraint_force
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.vehicles import lags_by_vehicle
from rigidfleet.preflight.check import check
from rigidfleet.preflight.margins import loops_and_omission

TRIANGLE = 4 / math.sqrt(3) * np.array(
    [[math.cos(t), math.sin(t), 0.0] for t in np.deg2rad([90, 210, 330])]
)  # fmt: skip
LINE = np.array([[-4.0, 0, 0], [0, 0, 0], [4, 0, 0]])
CUBE = 2.0 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
# Upright and askew, so that horizontal and vertical lags act on the same motions.
UPRIGHT = TRIANGLE[:, [0, 2, 1]]
TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
LIGHT = Lag(k_R=544.0, k_omega=46.64, tau=0.02)
HEAVY = Lag(k_R=150.0, k_omega=25.0, tau=0.08)


def delayed(lag, delay, rate=math.inf):
    return Lag(lag.k_R, lag.k_omega, lag.tau, delay, rate, lag.point)


def weighted_share(r, edges, m, **solver):
    """S (3N, 3N): what the kernel's law takes away of each input, both weighted by the root of the mass."""
    root = np.repeat(np.sqrt(m), 3)
    d = np.linalg.norm(r[edges[:, 0]] - r[edges[:, 1]], axis=1)

    def taken(f):
        force = constraint_force(r, 0 * r, m, edges, d, f_E=f.reshape(r.shape), **solver).f_C
        return -force.ravel() / root

    return np.array([taken(root * axis) for axis in np.eye(r.size)]).T


@pytest.mark.parametrize(
    "solver",
    [
        {"solver": "iterated", "damping": 0.03, "iterations": 3},
        {"solver": "iterated", "damping": 0.5, "iterations": 1},
        {"solver": "spectral", "threshold": 1.2},
        {"solver": "pinv", "cutoff": 0.3},
    ],
)
@pytest.mark.parametrize("r", [TRIANGLE, LINE + [[0, 0, 0], [0, 0.3, 0], [0, 0, 0]], CUBE @ TURN])
def test_shares_are_those_of_the_law(r, solver):
    """The filter factors are the eigenvalues of what the kernel's law takes away of an input."""
    edges, m = complete_graph(len(r)), np.random.default_rng(1).uniform(0.5, 2.0, len(r))
    J = jacobian(r, edges) * np.repeat(np.sqrt(m.mean() / m), 3)
    w, V = np.linalg.eigh(J.T @ J)
    S = (V * filter_factors(np.maximum(w, 0), **solver)) @ V.T
    np.testing.assert_allclose(weighted_share(r, edges, m, **solver), S, atol=1e-9)


def test_exact_law_takes_all_that_it_sees():
    """The exact law's filter factor is 1; 0 where there is no constraint."""
    np.testing.assert_array_equal(filter_factors([0.0, 1e-6, 3.0], "exact"), [0, 1, 1])
    with pytest.raises(ValueError, match="unknown solver 'best'"):
        filter_factors([1.0], "best")


def test_tracking_of_a_delayed_point():
    """L = k e^(-s d) / s: gain margin pi / (2 k d), phase margin pi/2 - k d, delay margin pi / (2 k) - d."""
    k, d = 3.0, 0.1
    found = stability_margins(tracking_loops([Lag(point=True, delay=d)]), LoopGains(k1=0.0, k2=k))
    assert found.stable
    assert found.gain == (0.0, pytest.approx(math.pi / (2 * k * d), rel=1e-9))
    assert found.phase == pytest.approx(math.pi / 2 - k * d, rel=1e-9)
    assert found.delay == pytest.approx(math.pi / (2 * k) - d, rel=1e-9)


@pytest.mark.parametrize("tau", [0.03, 0.2, 1.0])
def test_triple_pole_with_a_lag(tau):
    """By Routh, a triple pole is stable behind a first-order lag tau for p < 8 / (9 tau)."""
    r = np.array([[0.0, 0, 1], [0, 0, -1]])
    law = LoopGains(solver="exact")
    loops = distinct_formation_loops(r, [[0, 1]], [1.0, 2.0], law, [Lag(1.0, 5.0, tau)] * 2)
    (held,) = [loop for loop in loops if loop.has_constraint_law]
    assert largest_stable_pole([held], law) == pytest.approx(8 / (9 * tau), rel=1e-3)


@pytest.mark.parametrize("k", [0.5, 1.0])
def test_weak_shapes_without_tracking(k):
    """By Routh, a share sigma is stable for p (1 - 9 sigma) < 3 k_def (1 - sigma): weak motions need damping."""
    r = LINE + [[0, 0, 0], [0, 0.25, 0], [0, 0, 0]]
    law = LoopGains(control="open", k_def=k, damping=0.1, iterations=1)
    edges = complete_graph(3)
    w = np.linalg.eigvalsh(jacobian(r, edges) @ jacobian(r, edges).T)[0]
    sigma = w / (w + 0.1)
    assert 0.05 < sigma < 1 / 9
    loops = distinct_formation_loops(r, edges, np.ones(3), law, [Lag(point=True)] * 3)
    expected = 3 * k * (1 - sigma) / (1 - 9 * sigma)
    assert largest_stable_pole(loops, law) == pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize("lag", [LIGHT, HEAVY])
@pytest.mark.parametrize("delay", [0.0, 0.03])
@pytest.mark.parametrize("constrained", [False, True])
def test_margins_are_those_of_python_control(lag, delay, constrained):
    """Gain, phase and delay margin of scalar loops are those of python-control, delay as a Padé fraction."""
    law = LoopGains(solver="exact", ki=0.5)
    if constrained:
        # Side by side, a distance holds horizontal motion alone.
        r = np.array([[1.0, 0, 0], [-1, 0, 0]])
        loops = distinct_formation_loops(r, [[0, 1]], [1, 1], law, [delayed(lag, delay)] * 2)
        loops = [loop for loop in loops if loop.has_constraint_law]
        pid = [2 * law.alpha, law.beta**2, law.gamma]
    else:
        loops = [x for x in tracking_loops([delayed(lag, delay)]) if not x.channels[0][1]]
        pid = [law.k2, law.k1, law.ki]
    assert len(loops) == 1
    L = control.tf([lag.k_R], [lag.tau, 1, lag.k_omega, lag.k_R]) * control.tf(pid, [1, 0, 0, 0])
    if delay:
        L = L * control.tf(*control.pade(delay, 8))
    gains, phases, _, _, at, _ = control.stability_margins(L, returnall=True)
    found = stability_margins(loops, law)
    assert found.stable
    assert found.gain[0] == pytest.approx(max(gains[gains < 1]), rel=1e-4)
    assert found.gain[1] == pytest.approx(min(gains[gains > 1]), rel=1e-4)
    assert math.degrees(found.phase) == pytest.approx(np.abs(phases).min(), rel=1e-4)
    assert found.delay == pytest.approx(min(np.deg2rad(phases % 360) / at), rel=1e-4)


def test_a_heading_is_no_other_shape():
    """A cube that turns about the vertical for a quarter has the loops of one cube, not of each heading."""
    m = rf.load_mission("cube-by-neighbours")
    laws, _ = loops_and_omission(m, preview_phases(m)[0], lags_by_vehicle(m))
    assert [law.where for law in laws].count("'cube'") == 1


def test_parts_are_the_whole():
    """The loci of the parts are all loci of the whole loop, made of the kernel's own share."""
    m = np.random.default_rng(1).uniform(0.5, 2.0, 8)
    anyhow = np.random.default_rng(2).normal(0.0, 2.0, (8, 3))
    lags = [delayed(LIGHT, 0.02)] * 5 + [delayed(HEAVY, 0.05, 50.0)] * 3
    for r, some in (
        (CUBE, lags),
        (CUBE @ TURN, lags),
        (CUBE, lags[:1] * 8),
        (CUBE @ TURN, lags[:1] * 8),
        (anyhow, lags[:1] * 8),
    ):
        law, edges = LoopGains(), complete_graph(8)
        S = weighted_share(r, edges, m)
        for s in 0.3 + 1j * np.array([0.5, 3.0, 9.0]):
            k_c, k_u = 2 * law.alpha * s + law.beta**2 + law.gamma / s, law.k1 + law.k2 * s
            G = [lag.response(np.array([s]), vertical=a == 2)[0] for lag in some for a in range(3)]
            whole = np.linalg.eigvals(np.diag(G) @ (k_u * np.eye(24) + (k_c - k_u) * S) / s**2)
            loops = distinct_formation_loops(r, edges, m, law, some)
            parts = np.concatenate(
                [np.linalg.eigvals(x.gain(np.array([s]), law)[0]) for x in loops]
            )
            gap = np.abs(whole[:, None] - parts)
            # Filter factors that differ by 1e-4 are made equal.
            assert (gap.min(axis=0) < 3e-4 * np.abs(parts)).all()
            assert (gap.min(axis=1) < 3e-4 * np.abs(whole)).all()


def test_heading_does_not_matter_but_attitude_does():
    """The largest p of a pair does not depend on its heading; stood on end, only the rotors lag."""
    law, lags = LoopGains(), [delayed(HEAVY, 0.03)] * 2
    heading = np.array([math.cos(0.7), math.sin(0.7), 0.0])
    along, turned, tilted, upright = (
        largest_stable_pole(
            distinct_formation_loops(np.array([axis, -axis]), [[0, 1]], np.ones(2), law, lags), law
        )
        for axis in (np.eye(3)[0], heading, (heading + np.eye(3)[2]) / math.sqrt(2), np.eye(3)[2])
    )
    assert turned == pytest.approx(along, rel=1e-9)
    assert 1.05 * along < tilted < upright / 1.05


class Flight:
    """A formation about rest, in time: the kernel's law, differentiated, at ticks, on delayed states."""

    def __init__(self, r, edges, m, law, lags, rate):
        self.r, self.law, self.lags, self.dt = r, law, lags, 1.0 / rate
        d = np.linalg.norm(r[edges[:, 0]] - r[edges[:, 1]], axis=1)
        options = {
            key: getattr(law, key) for key in ("alpha", "beta", "gamma", "damping", "iterations")
        }

        def command(x, v, z):
            f = np.zeros_like(r)
            if law.control == "tracking":
                f = -m[:, None] * (law.k1 * x + law.k2 * v)
            integral = jacobian(r, edges) @ z.ravel()
            held = constraint_force(
                r + x, v, m, edges, d, integral=integral, f_E=f, solver=law.solver, **options
            )
            return ((f + held.f_C) / m[:, None]).ravel()

        zero, h = np.zeros_like(r), 1e-6
        self.K = []
        for k in range(3):
            columns = []
            for axis in np.eye(r.size):
                at = [zero, zero, zero]
                ends = []
                for sign in (h, -h):
                    at[k] = sign * axis.reshape(r.shape)
                    ends.append(command(*at))
                columns.append((ends[0] - ends[1]) / (2 * h))
            self.K.append(np.array(columns).T)

    def grows(self, seconds=60.0):
        """Whether deviations of random directions grow over the last third."""
        n, dt = len(self.r), self.dt
        # Position, velocity, acceleration and its derivatives of each coordinate, held command.
        step, drive = np.zeros((3 * n, 5, 5)), np.zeros((3 * n, 5))
        for i, lag in enumerate(self.lags):
            for axis in range(3):
                A = np.zeros((6, 6))
                A[0, 1] = A[1, 2] = 1.0
                if axis < 2:
                    A[2, 3] = A[3, 4] = 1.0
                    A[4, 2:6] = np.array([-lag.k_R, -lag.k_omega, -1.0, lag.k_R]) / lag.tau
                else:
                    A[2, [2, 5]] = -1 / lag.tau, 1 / lag.tau
                E = exponential(A * dt)
                step[3 * i + axis], drive[3 * i + axis] = E[:5, :5], E[:5, 5]
        late = np.repeat([round(lag.delay / dt) for lag in self.lags], 3)
        K = np.hstack(self.K)
        count = round(seconds / dt)
        past = np.zeros((count + 1, 3, 3 * n))
        x = np.zeros((3 * n, 5))
        x[:, 0] = np.random.default_rng(5).normal(size=3 * n)
        z, column = np.zeros(3 * n), np.arange(3 * n)
        for k in range(count):
            z = z + dt * x[:, 0]
            past[k] = x[:, 0], x[:, 1], z - 0.5 * dt * x[:, 0]
            seen = past[np.maximum(k - late, 0), :, column].T.ravel()
            u = K @ seen
            x = np.einsum("iab,ib->ia", step, x) + drive * u[:, None]
            if not np.abs(x).max() < 1e9:
                return True
        size = np.abs(past[:, 0]).max(axis=1)
        third = count // 6
        return size[-third:].max() > size[-2 * third : -third].max()


def exponential(A):
    """e^A by scaling and squaring."""
    E = term = np.eye(len(A))
    for k in range(1, 20):
        term = term @ A / 2**10 / k
        E = E + term
    return np.linalg.matrix_power(E, 2**10)


@pytest.mark.parametrize(
    ("r", "masses", "lags", "law"),
    [
        pytest.param(TRIANGLE, None, [LIGHT], {}, id="triangle"),
        pytest.param(UPRIGHT, None, [HEAVY], {}, id="upright"),
        pytest.param(LINE, None, [HEAVY], {}, id="line"),
        pytest.param(
            LINE + [[0, 0, 0], [0, 0.3, 0], [0, 0, 0]], None, [LIGHT], {"damping": 0.3}, id="bent"
        ),
        pytest.param(CUBE, None, [LIGHT], {}, id="cube"),
        pytest.param(CUBE @ TURN, [1, 1, 1, 1, 2, 1, 0.5, 1], [LIGHT, HEAVY], {}, id="mixed"),
    ],
)
def test_flights_are_stable_up_to_the_computed_pole(r, masses, lags, law):
    """Flown in time with delay, formations decay at 0.97 of the computed largest p and grow at 1.03 of it."""
    n, rate = len(r), 200.0
    m, edges = np.array([1.0] * n if masses is None else masses), complete_graph(n)
    fleet = [delayed(lags[i % len(lags)], 0.02 + 0.01 * (i % len(lags)), rate) for i in range(n)]
    law = LoopGains(**law)
    loops = distinct_formation_loops(r, edges, m, law, fleet)
    p = largest_stable_pole(loops, law)
    for share in (0.97, 1.03):
        some = law.with_triple_pole(share * p)
        assert is_stable(loops, some) == (share < 1)
        assert Flight(r, edges, m, some, fleet, rate).grows() == (share > 1)


def test_delay_margin_is_the_delay_that_flies():
    """A triangle flies with 0.9 of the computed delay margin added, and no longer with 1.1 of it."""
    rate, law, m = 200.0, LoopGains(), np.ones(3)
    edges = complete_graph(3)
    more = stability_margins(
        distinct_formation_loops(TRIANGLE, edges, m, law, [delayed(LIGHT, 0.02, rate)] * 3), law
    ).delay
    for share in (0.9, 1.1):
        fleet = [delayed(LIGHT, 0.02 + share * more, rate)] * 3
        assert Flight(TRIANGLE, edges, m, law, fleet, rate).grows() == (share > 1)


def test_an_attitude_that_is_unstable_by_itself():
    """Where k_omega < tau k_R the attitude itself is unstable, and so is every loop."""
    lag = Lag(k_R=500.0, k_omega=20.0, tau=0.05)
    assert not lag.stable
    assert not stability_margins(tracking_loops([lag]), LoopGains()).stable
    assert largest_stable_pole(tracking_loops([lag]), LoopGains()) == 0.0


def told(mission, lag):
    with patch("rigidfleet.preflight.check.lags_by_vehicle", lambda _: [lag] * mission.n_agents):
        found = check(mission, search=False)
    return found, [r for r in found.remarks if r.topic == "margins"]


def test_check_tells_margins():
    """check says margins of the tracking and of every formation on the way, if it is given lags; else nothing."""
    mission = rf.load_mission("narrow-passage")
    assert check(mission, search=False).margins is None
    found, remarks = told(mission, delayed(LIGHT, 0.02, 500.0))
    assert found.passed
    assert not remarks
    words = dict(found.describe())
    assert words["tracking"].startswith("stable, more delay ")
    assert words["'triangle' to 'line'"].startswith("stable, more delay ")
    law, slots = LoopGains(damping=0.03), mission.formation_slots("line")
    assert slots is not None
    alone = distinct_formation_loops(
        slots, mission.formation_edges("line"), np.ones(3), law,
        [delayed(LIGHT, 0.02, 500.0)] * 3,
    )  # fmt: skip
    assert found.margins is not None
    line = found.margins.formations["'line'"]
    assert line.margins.phase == pytest.approx(stability_margins(alone, law).phase, rel=1e-3)
    assert found.data()["margins"]["formations"]["'line'"]["largest_p"] == line.largest_pole


def test_check_fails_what_delay_makes_unstable():
    """A delay that the law does not bear fails the check, which names a p that is stable; small margins are a note."""
    mission = rf.load_mission("narrow-passage")
    found, remarks = told(mission, delayed(LIGHT, 0.15, 500.0))
    assert not found.passed
    (remark,) = (r for r in remarks if r.level == "fails")
    assert "constraint law ('triangle'" in remark.text
    assert "unstable with the vehicles' lag and delay" in remark.text
    found, (remark,) = told(mission, delayed(LIGHT, 0.06, 500.0))
    assert found.passed
    assert remark.level == "note"
    _, (remark,) = told(mission, delayed(LIGHT, 0.5, 500.0))
    assert remark.text.startswith("tracking: unstable")


def test_check_of_weak_ways_counts_growth_within_the_phase():
    """Where a way leads through a shape whose slow growth ends with it, the check does not fail."""
    mission = rf.load_mission("hexagon")
    found, _ = told(mission, Lag(point=True))
    assert found.margins is not None
    assert all(f.margins.stable for f in found.margins.formations.values())
