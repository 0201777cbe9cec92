"""References of a mission: poses of the virtual body, and the states that phases start from and lead to.

Both the plan of a flight and the check before it use them. Nothing here integrates or compiles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np

from rigidfleet._common.arrays import arrays_equal
from rigidfleet.formation import distance_geometry
from rigidfleet.kernel.problem import Motion, Reference
from rigidfleet.math import attitude as att
from rigidfleet.math import rigid_body, series
from rigidfleet.mission import Mission
from rigidfleet.mission.kinds import Shaping
from rigidfleet.planning.derivatives import body_taylor
from rigidfleet.typing import Bools, Floats, Ints


@dataclass(frozen=True)
class ByEdge:
    """A number for each edge that has been active: edges (m, 2), i < j, and values (m,)."""

    edges: Ints = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    values: Floats = field(default_factory=lambda: np.zeros(0))

    def values_of(self, edges: Ints, other: Callable[[], Floats | float]) -> Floats:
        """Values (m,) of edges (m, 2), i < j; for new edges ``other``, (m,) or of so many flights (B, m)."""
        if arrays_equal(edges, self.edges):  # most phases have those of the phase before
            return self.values.copy()
        keys, own = _edge_codes(edges), _edge_codes(self.edges)
        order = np.argsort(own)
        at = np.append(order, len(order))[np.searchsorted(own, keys, sorter=order)]
        known = np.append(own, -1)[at] == keys
        return np.where(known, np.append(self.values, 0.0)[at], other())

    def with_values(self, edges: Ints, values: Floats) -> ByEdge:
        """These values, updated with the ``values`` of edges (m, 2), i < j."""
        if arrays_equal(edges, self.edges):
            return ByEdge(self.edges, values.copy())
        edges = np.concatenate([edges, self.edges])
        first = np.unique(_edge_codes(edges), return_index=True)[1]
        return ByEdge(edges[first], np.concatenate([values, self.values])[first])


def _edge_codes(edges: Ints) -> Ints:
    return (edges[:, 0] << 32) + edges[:, 1]


State = TypeVar("State")

#: The rates of a pose that has none, which all such poses share.
_ZERO = np.zeros(3)
_ZERO.flags.writeable = False


def copy_with(state: State, **fields: Any) -> State:
    """A shallow copy of a pose, a state or a plan with other fields; `dataclasses.replace` takes five times as long."""
    return copy_as(type(state), state, **fields)


def copy_as(kind: type[State], state: Any, **fields: Any) -> State:
    """A pose, state or plan of a kind, with the fields of another one and further ones."""
    new = object.__new__(kind)
    new.__dict__.update(state.__dict__, **fields)
    return new


@dataclass(frozen=True)
class Pose:
    """Pose of the virtual body, actual or desired: CM [m], attitude T (world -> body) and their rates.

    Acceleration and jerk are those of a smooth mission's reference; nothing else needs them.
    """

    r: Floats
    v: Floats
    T: Floats
    omega: Floats  # body axes [rad/s]
    named: bool = False  # whether a phase specifies this attitude explicitly
    a: Floats = field(default_factory=lambda: _ZERO)  # [m/s^2]
    jerk: Floats = field(default_factory=lambda: _ZERO)  # [m/s^3]
    alpha: Floats = field(default_factory=lambda: _ZERO)  # of omega, body axes [rad/s^2]
    alpha_dot: Floats = field(default_factory=lambda: _ZERO)  # [rad/s^3]

    def in_axes(self, axes: Floats) -> Pose:
        """The same pose in new body axes; ``axes`` (3, 3) maps vectors from new to old ones."""
        rates = {key: axes.T @ getattr(self, key) for key in ("T", "omega", "alpha", "alpha_dot")}
        return copy_with(self, **rates)


def pose_at(motion: Motion, t: float) -> Pose:
    """The pose of a reference motion at a time [s], with its acceleration and jerk."""
    cm, axes = (x[..., 0] for x in body_taylor(motion, np.array([t])))
    r, v, a, jerk = series.taylor_derivatives(cm)[:4]
    omega, alpha, alpha_dot = series.taylor_derivatives(series.body_rates_series(axes))[:3]
    return Pose(r, v, axes[0].T, omega, a=a, jerk=jerk, alpha=alpha, alpha_dot=alpha_dot)


@dataclass(frozen=True)
class PhaseState:
    """The state at a switch between phases, and the last commands."""

    t: float
    r: Floats  # (N, 3) [m]
    v: Floats  # (N, 3) [m/s]
    integral: ByEdge = field(default_factory=ByEdge)  # of c [m s]
    reference: ByEdge = field(default_factory=ByEdge)  # distances last commanded [m]
    frame: Floats | None = None  # attitude (3, 3) of the integrated mean-axis frame
    formation: str | None = None  # the last one commanded
    slots: Floats | None = None  # (N, 3) last commanded, about the CM, body axes [m]
    pose: Pose | None = None  # last commanded; None if there was no command
    goal: Pose | None = None  # the pose to hold
    lost: Bools = field(init=False)  # (N,) lost vehicles; none at first
    blend: Reference | None = None  # change of shape under way, if a loss has ended its phase
    # Velocity, acceleration, jerk (3, N, 3) of the slots about the CM, body axes, if an abort has ended a phase, or
    # files have ended in motion.
    rates: Floats | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "lost", np.zeros(len(self.r), dtype=np.bool_))

    @property
    def pose_goal_and_slots(self) -> tuple[Pose, Pose, Floats]:
        """Pose, goal and slots of a state with the frame attached: no phase that moves, or tracks slots, lacks them."""
        assert self.pose is not None
        assert self.goal is not None
        assert self.slots is not None
        return self.pose, self.goal, self.slots


def reference_kind(
    mission: Mission, phase: Shaping, before: Floats, target: Floats | None
) -> Literal["shape", "squares", "step"]:
    """Kind of reference of a phase's distances: the phase's own, or a choice of two if it is "distances".

    Blended squared distances belong to points in space, but do not determine handedness. They lead to the slots if an
    affine map without reflection takes the agents there, because their blend is then the blend of the map. This
    holds for up to four agents of the intended handedness, and for any number in a stretched shape. Otherwise the
    slots are blended, if the formation defines slots with these distances. Slots computed from distances do not
    count, because their handedness is arbitrary.

    Parameters: agents or slots before, and desired slots (N, 3) [m], if there are any.
    """
    if phase.reference != "distances":
        return phase.reference
    if target is None or len(target) < 4 or not mission.formations[phase.formation].knows_slots:
        return "squares"  # three agents lie in a plane
    edges = mission.formation_edges(phase.formation)
    lengths = mission.formation_distances(phase.formation)
    if not np.allclose(distance_geometry.distances(target, edges), lengths, rtol=1e-3):
        return "squares"
    start, goal = rigid_body.centred(before), rigid_body.centred(target)
    if distance_geometry.dimension(np.hstack([start, goal])) > 3:
        return "shape"
    if distance_geometry.dimension(goal) < 3:
        return "squares"
    same_hand = distance_geometry.dimension(start) == 3 and np.linalg.det(start.T @ goal) > 0
    return "squares" if same_hand else "shape"


def shift_and_rotvec(
    before: Floats, after: Floats, masses: Floats, turn: Floats | None = None
) -> tuple[Floats, Floats]:
    """What a blend adds to the slots, and the rotation vector by which it turns them at the same time.

    The new slots are first rotated by ``turn`` (3, 3), or else onto the old ones (Kabsch, weighted by mass). The
    straight blend then has no angular momentum in its own frame, and moves the agents least. During the blend the
    slots rotate back, so that the body axes keep their meaning; distances are not affected.
    """
    R = rigid_body.kabsch(before, after, masses) if turn is None else turn
    return after @ R.T - before, att.rotation_vector_from_dcm(R)  # log of R^T
