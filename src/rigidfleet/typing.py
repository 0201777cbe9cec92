"""Array types, once: what shapes and units an array has, its docstring says."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
#: Edges (m, 2) as the kernel takes them: unsigned, which makes an index cheaper.
Edges = NDArray[np.uint32]
