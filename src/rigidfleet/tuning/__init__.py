"""Tuning: gains of the constraint law and the tracking, chosen by an optimiser over flights of the mission."""

from rigidfleet.tuning.outcome import Tuned
from rigidfleet.tuning.study import OBJECTIVES, tune

__all__ = ["OBJECTIVES", "Tuned", "tune"]
