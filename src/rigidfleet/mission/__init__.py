"""Missions: vehicles, formations, obstacles and phases, read from TOML and checked. Data only.

A mission is checked as a whole. *All* its errors are raised in one `MissionError`, whose findings give the file, the
key, the value and the remedy. Everything that a user sees counts from 1, as in the paper: agents, edges, phases, and
the entries in a key such as `phases[3].until`. Arrays that `Mission` returns count agents from 0.
"""

from rigidfleet.mission.kinds import KINDS, Fly, Phase, Settle
from rigidfleet.mission.loading import as_mission, json_schema, load_mission
from rigidfleet.mission.model import Mission
from rigidfleet.mission.obstacles import Obstacle
from rigidfleet.mission.schema import Gusts, Regulator
from rigidfleet.mission.text import mission_names, mission_text

__all__ = [
    "KINDS",
    "Fly",
    "Gusts",
    "Mission",
    "Obstacle",
    "Phase",
    "Regulator",
    "Settle",
    "as_mission",
    "json_schema",
    "load_mission",
    "mission_names",
    "mission_text",
]
