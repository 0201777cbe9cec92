"""Types that many modules name: arrays, whose shapes and units are in docstrings, and names of input laws."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
#: Edges (m, 2) as the kernel takes them: unsigned, which makes an index cheaper.
Edges = NDArray[np.uint32]
#: Input laws of phases; `kernel.problem.LAWS` has the same.
InputLaw = Literal["open", "tracking", "body"]
