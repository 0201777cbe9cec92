"""Check what vehicles can do on the planned paths: lag and delay of their laws."""

from __future__ import annotations

from rigidfleet.math.margins import Lag
from rigidfleet.mission import Mission


def vehicle_lags(mission: Mission) -> list[Lag]:
    """Lag and delay of each vehicle; empty for points that give any force at once."""
    models = mission.vehicle_models
    if models is None:
        return []
    d, autopilot = mission.disturbances, mission.autopilot
    noise = None if d is None else d.noise
    delay, rate = 0.0, autopilot.formation_rate
    if noise is not None:
        # Delays are whole ticks; a law that is quicker than its measurements acts at their rate.
        delay = round(noise.delay * autopilot.rate) / autopilot.rate
        rate = min(rate, noise.rate)
    return [
        Lag(delay=delay, rate=rate, point=True)
        if model.point
        else Lag(
            model.attitude_gains[0], model.attitude_gains[1], max(model.motor_time), delay, rate
        )
        for model in models
    ]
