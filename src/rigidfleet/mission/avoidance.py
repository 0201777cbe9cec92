"""Avoidance in flight: what vehicles can always brake with, what is guaranteed of whom, and rules of [avoidance]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rigidfleet.mission.disturbances import gust_intensity
from rigidfleet.mission.rules import Breach, Breaches, Draft
from rigidfleet.mission.schema import Avoidance, Disturbances, Noise
from rigidfleet.mission.vehicles import NOT_SAMPLED, VehicleModel, model_of_vehicle
from rigidfleet.typing import Floats

_TABLE = "avoidance"
#: Standard deviations of gusts and noise that are reckoned with.
_SIGMAS = 3.0
#: What tilts of 45 degrees, the bounds of rotors and drag make of the motion that quadrotors are expected to have [m].
_LEFT_OUT = 0.02


def available_accelerations(
    models: Sequence[VehicleModel], gravity: float, disturbances: Disturbances
) -> Floats:
    """Acceleration (N,) [m/s^2] that each vehicle has left in any direction, negative if none.

    A point has F/m - g - w: the admissible accelerations are the ball of radius F/m about gravity, and w is the share
    of wind and wrong masses. The thrust of a quadrotor tilts by no more than its limit, and does not pull down.
    """
    away = _disturbing_accelerations(models, gravity, disturbances)
    accelerations = []
    for model in models:
        b = model.thrust_limit / model.mass - gravity
        if not model.point:
            b = min(b, gravity * math.sin(math.radians(model.tilt_limit_deg)))
        accelerations.append(b)
    return np.array(accelerations) - away


def _disturbing_accelerations(
    models: Sequence[VehicleModel], gravity: float, disturbances: Disturbances
) -> Floats:
    """Acceleration (N,) [m/s^2] by wind, gusts of three standard deviations, and wrong masses."""
    wind = float(np.linalg.norm(disturbances.wind))
    if disturbances.gusts is not None:
        wind += _SIGMAS * float(np.linalg.norm(gust_intensity(disturbances.gusts, wind)))
    error = np.broadcast_to(np.array(disturbances.mass_error, dtype=float), len(models))
    by_wind = [
        (max(model.linear_drag) + max(model.body_drag) * wind) * wind / model.mass
        for model in models
    ]
    limit = np.array([model.thrust_limit / model.mass for model in models])
    return np.array(by_wind) + np.where(error > 0.0, limit, gravity) * np.abs(error)


def _noise_of(disturbances: Disturbances) -> Noise:
    """The noise of measurements, which may be none."""
    return disturbances.noise or Noise.model_construct()


def reaction_times(models: Sequence[VehicleModel], disturbances: Disturbances) -> Floats:
    """Time (N,) [s] until a commanded force acts: a measurement's delay; of quadrotors also motors and attitude.

    The attitude loop follows a ramp late by k_omega / k_R.
    """
    own = [
        0.0
        if model.point
        else max(model.motor_time) + model.attitude_gains[1] / model.attitude_gains[0]
        for model in models
    ]
    return _noise_of(disturbances).delay + np.array(own)


def lag_coefficients(
    models: Sequence[VehicleModel], disturbances: Disturbances, gravity: float
) -> Floats:
    """Lags (N, 3, 3) of `AvoidanceArrays.ahead`; 0 of points.

    Commands take the time in which the torques of hovering rotors turn the tilt from one limit to the other, so that
    attitude follows them linearly, and no thrust is lost to torques.
    """
    delay, lags = _noise_of(disturbances).delay, np.zeros((len(models), 3, 3))
    for i, model in enumerate(models):
        if not model.point:
            k_R, k_omega = model.attitude_gains
            motor, turn = max(model.motor_time), k_omega / k_R
            spin = model.mass * gravity * model.arm / math.sqrt(2.0) / max(model.inertia[:2])
            smooth = max(2.0 * motor, 2.0 * math.radians(model.tilt_limit_deg) / (spin * turn))
            lags[i, :2] = delay + turn, 1.0 / k_R, smooth
            lags[i, 2] = delay + motor, 0.0, smooth + turn - motor
    return lags


def avoidance_margins(
    table: Avoidance, models: Sequence[VehicleModel], disturbances: Disturbances
) -> Floats:
    """By how much each vehicle is taken to be larger (N,) [m]: by noise, and by what lags leave out."""
    if table.margin is not None:
        return np.full(len(models), table.margin)
    own = np.array([0.0 if model.point else _LEFT_OUT for model in models])
    return own + _SIGMAS * _noise_of(disturbances).position


def why_no_guarantee(
    models: Sequence[VehicleModel], d: Disturbances, obstacles: Sequence[Any] = ()
) -> str:
    """Why the guard's guarantee is no theorem for these vehicles and obstacles; empty if it is one."""
    if not all(model.point for model in models):
        return "quadrotors cannot brake at once"
    if any(thing.solid.moves for thing in obstacles):
        return "obstacles move"
    for applies, words in (
        (d.noise is not None, "states are measured with noise or late"),
        (any(d.wind) or d.gusts is not None, "the wind is not known"),
        (np.any(d.mass_error), "masses are not known"),
        (d.lost, "vehicles are lost"),
    ):
        if applies:
            return words
    return ""


def avoidance_rules(m: Draft) -> Breaches:
    """[avoidance] acts, knows what it needs to know, and leaves vehicles something to brake with."""
    a, d = m.avoidance, m.disturbances or Disturbances.model_construct()
    if a is None:
        return
    if not m.flies_vehicles:
        yield Breach(_TABLE, *NOT_SAMPLED, None)
        return
    if not (a.guard or a.barrier or a.reference == "flow"):
        problem = "has neither guard nor barrier nor flow"
        yield Breach(_TABLE, problem, "remove it, or set one of them")
    if a.sensing_noise and a.sensing_range is None:
        remedy = "add the range within which obstacles that move are seen, or remove the noise"
        yield Breach((_TABLE, "sensing_noise"), "has no effect without sensing_range", remedy)
    if m.network is not None:
        problem = "needs the states of all vehicles at once, which [network] does not give"
        yield Breach(_TABLE, problem, "remove one of the two", None)
    for k, thing in enumerate(m.obstacles):
        if thing.kind == "heights":
            problem = "is no obstacle that [avoidance] knows: it needs convex ones"
            remedy = "build it of boxes or hulls, or remove [avoidance]"
            yield Breach(("obstacles", k), problem, remedy, None)
    if m.agents is None or m.findings:
        return
    names = m.agents.vehicle
    models = [model_of_vehicle(m.vehicles[name]) for name in names]
    left = available_accelerations(models, m.gravity, d)
    for name in dict.fromkeys(names):
        i, where = names.index(name), ("vehicles", name, "thrust_limit")
        if math.isinf(left[i]):
            problem = "is missing: without a limit there is no braking to reckon with"
            yield Breach(where, problem, "add the greatest thrust [N]")
        elif left[i] <= 0.0:
            weight = models[i].thrust_limit - left[i] * models[i].mass
            problem = (
                f"leaves nothing to brake with: {models[i].thrust_limit:.4g} N, but weight and wind take up to"
                f" {weight:.4g} N"
            )
            remedy = "raise the thrust, lower mass, wind or mass_error, or remove [avoidance]"
            yield Breach(where, problem, remedy, None)
