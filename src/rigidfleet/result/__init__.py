"""The record of a flight: states, references and forces over time. It can be saved, loaded and exported.

A `Result` contains NumPy arrays (radians, scalar-first quaternions, agents counted from 0). It is saved as one
netCDF-4 file, in which each variable has its unit and its meaning. The file also contains the mission, so that the
flight can be repeated from its result. NaN means "not active".
"""

from rigidfleet._common.waypoints import PAD
from rigidfleet.result.netcdf import LABELS, Variable
from rigidfleet.result.phases import Extremum, PhaseRecord
from rigidfleet.result.result import (
    CLOSE,
    LATER,
    RECORDED,
    SEEN,
    VARIABLES,
    Result,
    as_result,
    presence,
)

__all__ = [
    "CLOSE",
    "LABELS",
    "LATER",
    "PAD",
    "RECORDED",
    "SEEN",
    "VARIABLES",
    "Extremum",
    "PhaseRecord",
    "Result",
    "Variable",
    "as_result",
    "presence",
]
