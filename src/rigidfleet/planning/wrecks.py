"""Lost vehicles, which fall from where they were by the plan, and then lie in the way of the others."""

from __future__ import annotations

import math

import numpy as np

from rigidfleet.math import falls
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission import Mission
from rigidfleet.mission.boundaries import Boundaries
from rigidfleet.mission.obstacles import Sphere
from rigidfleet.planning.steps import SHORTEST, tracking_allowance
from rigidfleet.typing import Bools, Floats

#: How far from its fall by the plan a lost vehicle may be [m], and over its acceleration by the wind [s^2], which blows
#: it on along the ground.
_ASTRAY, _BLOWN = 0.1, 0.5
#: Time between places of a fall, between which it is taken as straight [s].
_FALLING = 0.1


def fall_uncertainty(mission: Mission) -> Floats:
    """How far from its fall by the plan each vehicle (N,) may be that is lost [m]."""
    air = Boundaries(mission)
    blown = _BLOWN * air.k * float(np.linalg.norm(air.wind))
    return tracking_allowance(mission) + _ASTRAY + blown


def wrecks_of(mission: Mission, plan: Piecewise, lost: Bools) -> list[Sphere]:
    """The lost vehicles, (N,) ``lost``, wider by `fall_uncertainty`; none without gravity."""
    air, lost_at, radius = Boundaries(mission), mission.lost_at, mission.fleet.radius
    wrecks, uncertain = list[Sphere](), fall_uncertainty(mission)
    for i in np.flatnonzero(lost & (mission.gravity >= 1.0)).tolist():
        states = plan.states(lost_at[[i]], 2)
        (r, v), k = states[:, 0, i], air.k[[i]]
        height = r[2] - air.ends_of_falls(*states)[:, i, 2] - radius[i]
        tau = float(falls.fall_time(height, v[2:], k, air.wind[2], air.g)[0])
        time = np.linspace(0.0, max(tau, SHORTEST), 2 + math.ceil(tau / _FALLING))
        places = falls.fall_places(r, v, np.minimum(time, tau), float(k[0]), air.wind, air.g)
        moves = {"waypoints": places.tolist(), "times": (lost_at[i] + time).tolist()}
        size = float(radius[i] + uncertain[i])
        wrecks.append(Sphere(kind="sphere", name=f"lost agent {i + 1}", radius=size, **moves))
    return wrecks
