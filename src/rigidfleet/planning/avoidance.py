"""Make what avoidance in flight reads, from a mission, and say what it keeps."""

from __future__ import annotations

import numpy as np

from rigidfleet.kernel import avoidance, fleet
from rigidfleet.mission import Mission
from rigidfleet.mission.avoidance import (
    available_accelerations,
    avoidance_margins,
    lag_coefficients,
    reaction_times,
)
from rigidfleet.planning.courses import ABOVE
from rigidfleet.solids.records import join_solids


def avoidance_in_flight(
    mission: Mission, flight: fleet.SampledFlight
) -> avoidance.AvoidanceArrays | None:
    """Avoidance at the ticks of the formation's law; None without [avoidance]."""
    settings, models = mission.avoidance, mission.vehicle_models
    if settings is None or models is None:
        return None
    mass, own = mission.fleet.mass, settings.separation
    limit = np.array([model.thrust_limit for model in models])
    solids = join_solids([thing.solid for thing in mission.obstacles])
    reach = np.inf if settings.sensing_range is None else settings.sensing_range
    drag = np.where([model.point for model in models], mission.drag / mass, 0.0)
    return avoidance.avoidance_arrays(
        period=flight.every * flight.steps * flight.h,
        b=available_accelerations(models, mission.gravity, mission.all_disturbances),
        lift=limit / mass,
        mass=mass,
        g=mission.gravity,
        radius=np.array(mission.agents.radius, dtype=float),
        solids=solids,
        seen=avoidance.initial_sight(
            solids, reach, settings.sensing_noise, settings.obstacle_acceleration, settings.seed
        ),
        separation=(mission.limits.separation or 0.0) if own is None else own,
        clearance=settings.clearance,
        drag=drag,
        lag=reaction_times(models, mission.all_disturbances),
        ahead=lag_coefficients(models, mission.all_disturbances, mission.gravity),
        tilt=np.array(
            [np.inf if model.point else np.radians(model.tilt_limit_deg) for model in models]
        ),
        spare=avoidance_margins(settings, models, mission.all_disturbances),
        rate=settings.rate,
        share=settings.share,
        release=settings.release,
        guarded=settings.guard,
        filtered=settings.barrier,
        flow=settings.reference == "flow",
    )


def kept_distances(mission: Mission) -> tuple[float, float]:
    """Separation and clearance [m] that avoidance keeps; without it, the limit of separation and 0."""
    settings, models = mission.avoidance, mission.vehicle_models
    limit = mission.limits.separation or 0.0
    if settings is None or models is None:
        return limit, 0.0
    spare = float(avoidance_margins(settings, models, mission.all_disturbances).max())
    separation = limit if settings.separation is None else settings.separation
    return max(limit, separation + 2.0 * spare), settings.clearance + spare


def why_no_landing(mission: Mission) -> str:
    """Why vehicles cannot land, as avoidance keeps them higher than landings end; "" if it lets them."""
    _, keeps = kept_distances(mission)
    words = f"[avoidance] keeps vehicles {keeps:.2g} m from the ground, and a landing ends {ABOVE:g} m above it"
    return f"{words}: lower its clearance or margin" if keeps > ABOVE else ""
