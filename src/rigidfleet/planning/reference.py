"""Where a mission leads: poses of the virtual body, what a phase starts from and steers to.

The plan of a flight, and a check before it, are made from these. Nothing here flies or compiles.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from rigidfleet.formation import distance_geometry
from rigidfleet.math import attitude as att
from rigidfleet.math import rigid_body
from rigidfleet.math.rigid_body import about_cm, mean_axis_rates
from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.schema import Shaping
from rigidfleet.typing import Bools, Floats, Ints


@dataclass(frozen=True)
class ByEdge:
    """A number for each edge that has been in force: values (m,), by the edges' keys (m,) in ascending order."""

    keys: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    values: Floats = field(default_factory=lambda: np.zeros(0))

    def of(self, edges: Ints, other: Floats | float) -> Floats:
        """Values (m,) of edges (m, 2), i < j; ``other`` (m,) where an edge is new."""
        keys = self._keys(edges)
        at = np.searchsorted(self.keys, keys)
        known = np.append(self.keys, -1)[at] == keys
        return np.where(known, np.append(self.values, 0.0)[at], other)

    def updated(self, edges: Ints, values: Floats) -> ByEdge:
        """These and those of edges (m, 2), i < j, of which the latter count where there are both."""
        keys, first = np.unique(np.concatenate([self._keys(edges), self.keys]), return_index=True)
        return ByEdge(keys, np.concatenate([values, self.values])[first])

    @staticmethod
    def _keys(edges: Ints) -> Ints:
        return (edges[:, 0] << 32) + edges[:, 1]


@dataclass
class Pose:
    """Where the virtual body is, or is to be: CM [m], attitude T (world -> body), their rates."""

    r: Floats
    v: Floats
    T: Floats
    omega: Floats  # body axes [rad/s]
    named: bool = False  # whether a phase has asked for this attitude by name


@dataclass
class PhaseState:
    """The state at a switch, and what was commanded up to it."""

    t: float
    r: Floats  # (N, 3) [m]
    v: Floats  # (N, 3) [m/s]
    integral: ByEdge = field(default_factory=ByEdge)  # of c [m s]
    reference: ByEdge = field(default_factory=ByEdge)  # distances commanded last [m]
    frame: Floats | None = None  # attitude (3, 3) of the integrated mean-axis frame
    formation: str | None = None  # the one taken last
    slots: Floats | None = None  # (N, 3) commanded last, about the CM, body axes [m]
    pose: Pose | None = None  # commanded last; None where nothing was
    goal: Pose | None = None  # what to stay at
    lost: Bools | None = None  # (N,) vehicles that fly no more; None: none


def slots_about_cm(mission: Mission, name: str | None, masses: Floats) -> Floats | None:
    """Slots (N, 3) [m] of a formation about their centre of mass; None where there are none."""
    slots = mission.formation_slots(name) if name else None
    return None if slots is None else about_cm(slots, masses)


def attach(
    mission: Mission, phase: Phase, now: PhaseState, masses: Floats, target: Floats | None
) -> tuple[Floats | None, PhaseState, Floats]:
    """Attach the body frame where a phase needs one, and say how the slots wanted lie in it meanwhile.

    Slots fitted to the agents (Kabsch) give the attitude, the matrix of Eq. (23). Where nothing is established yet,
    the agents themselves are the slots, in the axes in which formations are drawn. A formation that is established
    takes axes of its own: those in which it is to lie, or, if its attitude is free, those in which it lies nearest.
    Lost vehicles count in neither; the virtual body keeps their slots.

    Returns
    -------
    frame : the one to integrate, if any
    now : the situation, attached
    turn : (3, 3) rotation of the slots wanted, in which they are blended (`align_slots`): the one for which they
        were assigned, or else that which brings them nearest to the slots before
    """
    masses = masses if now.lost is None else np.where(now.lost, 0.0, masses)
    shaping, establishing = phase.shaping, phase.establishing
    frame, given = now.frame, None
    if shaping is not None:
        given = mission.assigned_turn(now.formation, shaping.formation)
    if phase.control == "open":
        if mission.formulation == "body" and frame is None:
            frame = np.eye(3)
        return frame, now, _turn(given, slots_before(mission, now, masses), target, masses)
    x = about_cm(now.r, masses)
    if phase.control == "tracking" and now.pose is not None:
        pose = now.pose  # the reference goes on from where it is
    else:
        fit = now.slots
        near = frame if frame is not None else now.pose.T if now.pose is not None else np.eye(3)
        if fit is not None:
            T = rigid_body.kabsch(x, fit, masses, near=near.T).T
        else:
            T = near if mission.body_frame is not None else mission.drawn_attitude
        pose = Pose(masses @ now.r / masses.sum(), masses @ now.v / masses.sum(), T, np.zeros(3))
        pose.omega = T @ mean_axis_rates(x[None], about_cm(now.v, masses)[None], masses)[0]
        if now.lost is not None and fit is not None:
            centre = masses @ fit / masses.sum()  # of those left, from the body's origin
            pose.r = pose.r - T.T @ centre
            pose.v = pose.v - T.T @ np.cross(pose.omega, centre)
            x = x + T.T @ centre
    slots = now.slots if now.slots is not None else x @ pose.T.T
    goal = now.goal or replace(pose, v=np.zeros(3), omega=np.zeros(3))
    turn = np.eye(3)
    if establishing is not None and target is not None:
        # New axes, in the old ones: `axes` takes vectors from new to old.
        free = mission.free_attitude(phase)
        if free:
            axes = _turn(given, slots, target, masses)
        else:
            asked = mission.establish_attitude(establishing, goal.T if goal.named else None)
            steady = now.pose is not None and goal.named and np.array_equal(goal.T, asked)
            axes = np.eye(3) if steady else pose.T @ asked.T
        slots = slots @ axes
        pose = replace(pose, T=axes.T @ pose.T, omega=axes.T @ pose.omega)
        goal = replace(goal, T=pose.T if free else asked, named=not free)
        given = None if given is None else axes.T @ given
    if shaping is not None:
        turn = _turn(given, slots, target, masses)
    if phase.control == "body" or (mission.formulation == "body" and frame is None):
        frame = pose.T
    return frame, replace(now, pose=pose, slots=slots, goal=goal), turn


def slots_before(mission: Mission, now: PhaseState, masses: Floats) -> Floats:
    """Slots (N, 3) [m] that a phase begins with; where there are none, the agents, as formations are drawn."""
    if now.slots is not None:
        return now.slots
    return about_cm(now.r, masses) @ mission.drawn_attitude.T


def _turn(given: Floats | None, before: Floats, after: Floats | None, masses: Floats) -> Floats:
    if after is None:
        return np.eye(3)
    return rigid_body.kabsch(before, after, masses) if given is None else given


def reference_kind(
    mission: Mission, phase: Shaping, before: Floats, target: Floats | None
) -> Literal["shape", "squares", "step"]:
    """What leads the distances of a phase: its reference, and which of two if that is "distances".

    Blended squares of distances are those of points in space, and know no hand. They lead to the slots if an
    affine map without reflection takes the agents there, as their blend then is that of the map: up to four
    agents of the right hand, and any number in a stretched shape. Elsewhere the slots are blended, if the
    formation is given by some, with these distances; slots from distances have a hand that nobody asked for.

    Parameters: agents or slots before, and slots wanted (N, 3) [m], if there are any.
    """
    if phase.reference != "distances":
        return phase.reference
    if target is None or not mission.formations[phase.formation].knows_slots:
        return "squares"
    edges = mission.formation_edges(phase.formation)
    asked = mission.formation_distances(phase.formation)
    if not np.allclose(distance_geometry.distances(target, edges), asked, rtol=1e-3):
        return "squares"
    start, goal = rigid_body.centred(before), rigid_body.centred(target)
    if distance_geometry.dimension(np.hstack([start, goal])) > 3:
        return "shape"
    if distance_geometry.dimension(goal) < 3:
        return "squares"
    same_hand = distance_geometry.dimension(start) == 3 and np.linalg.det(start.T @ goal) > 0
    return "squares" if same_hand else "shape"


def align_slots(
    before: Floats, after: Floats, masses: Floats, turn: Floats | None = None
) -> tuple[Floats, Floats]:
    """What a blend adds to the slots, and by which rotation vector it turns them meanwhile.

    The new slots are turned first, by ``turn`` (3, 3), or else onto the old ones (Kabsch, weighted by mass), in
    which the straight blend has no angular momentum in its own frame, and moves the agents least. A turn back
    meanwhile keeps what the body axes mean; distances know nothing of it.
    """
    R = rigid_body.kabsch(before, after, masses) if turn is None else turn
    return after @ R.T - before, att.rotation_vector_from_dcm(R)  # log of R^T
