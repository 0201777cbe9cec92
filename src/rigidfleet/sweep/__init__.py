"""Sweeps: fly a mission many times with variations, on all cores, and find what causes failures.

from rigidfleet.sweep import Sweep, fly, load

sweep = Sweep.of("narrow-passage", ["agents.mass.* *= normal(1, 0.05)"], runs=200, seed=1)
fly(sweep, "sweeps/masses")
data = load("sweeps/masses")  # a dataset of xarray
"""

from rigidfleet.sweep.dataset import load
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.metrics import METRICS
from rigidfleet.sweep.runner import SweepProgress, fly
from rigidfleet.sweep.shards import merge
from rigidfleet.sweep.store import Table, read

__all__ = ["METRICS", "Sweep", "SweepProgress", "Table", "fly", "load", "merge", "read"]
