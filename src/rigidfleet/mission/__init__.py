"""Missions: what the user asked for, read from TOML and checked on entry. Data only.

A mission is checked as a whole, and *all* its errors are raised at once in one `MissionError` whose
findings name the file, the key, the value and the remedy. What a user sees counts from 1, as in the
paper: agents, edges, phases, and so the places in a key such as `phases[3].until`. Arrays that
`Mission` hands to code count agents from 0.
"""

from rigidfleet.mission.describe import counted, ending, goal
from rigidfleet.mission.model import (
    Mission,
    as_mission,
    json_schema,
    load_mission,
    mission_names,
    mission_text,
)
from rigidfleet.mission.schema import (
    KINDS,
    Box,
    Disturbances,
    Establish,
    Fly,
    Formation,
    Geofence,
    Ground,
    Gusts,
    Hold,
    Limits,
    Lqr,
    Obstacle,
    Phase,
    Regulator,
    Reshape,
    Settle,
    Turn,
)

__all__ = [
    "KINDS",
    "Box",
    "Disturbances",
    "Establish",
    "Fly",
    "Formation",
    "Geofence",
    "Ground",
    "Gusts",
    "Hold",
    "Limits",
    "Lqr",
    "Mission",
    "Obstacle",
    "Phase",
    "Regulator",
    "Reshape",
    "Settle",
    "Turn",
    "as_mission",
    "counted",
    "ending",
    "goal",
    "json_schema",
    "load_mission",
    "mission_names",
    "mission_text",
]
