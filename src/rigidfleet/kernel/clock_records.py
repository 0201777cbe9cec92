"""How vehicles' own clocks run, and how they stand: arrays that `clocks` reads and writes."""

import math
from typing import NamedTuple

import numpy as np

from rigidfleet.typing import Floats, Ints

#: Columns of `SampledState.tau`: tau - t [s]; dtau/dt; the pace s and ds/dt [1/s]; the greatest error known of any
#: vehicle [m], and the tick at which it was measured; the place that a stuck vehicle holds (3) [m], NaN for none;
#: position, velocity and acceleration of the slot (9).
OFF, RATE, PACE, SLOPE, WORST, SINCE, PLACE, SLOT = 0, 1, 2, 3, 4, 5, 6, 9
#: Greatest rate: what a plan has to spare is not known, and forces grow with its square.
FASTEST = 1.2


class VehicleClocks(NamedTuple):
    """How the clocks of N vehicles run."""

    own: bool  # whether each vehicle has one of its own
    late: Ints  # (N,) ticks by which it starts late
    drift: Floats  # (N,) of its rate
    gain: float  # of consensus g [1/s]
    wait: float  # distance from a slot at which the pace is zero [m]; it falls from half of it on
    stuck: Ints  # (M, 3) vehicles, and from and until which tick they are stuck


def shared_clock(n: int) -> VehicleClocks:
    """One clock for n vehicles."""
    none = np.zeros((0, 3), dtype=np.int64)
    return VehicleClocks(False, np.zeros(n, dtype=np.int64), np.zeros(n), 0.0, math.inf, none)


def clocks_at_start(n: int) -> Floats:
    """Clocks (N, 18) that are right, of vehicles that are not stuck."""
    tau = np.zeros((n, SLOT + 9))
    tau[:, [RATE, PACE]], tau[:, PLACE:SLOT] = 1.0, np.nan
    return tau
