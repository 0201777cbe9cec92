"""Products of matrices that wake no threads of BLAS."""

from __future__ import annotations

import numpy as np

from rigidfleet.typing import Floats

#: Multiplications up to which OpenBLAS takes a product by the calling thread alone.
_ALONE = 1 << 18


def product_in_blocks(a: Floats, b: Floats) -> Floats:
    """The product (n, m) of matrices (n, k) and (k, m), by the calling thread alone.

    Threads of BLAS wait actively: where other processes run, they take up to 100 times the processor time of a product
    that lasts a millisecond. In blocks so small, OpenBLAS starts none; a result may differ from `a @ b` by rounding.
    """
    if len(a) > b.shape[1]:
        return product_in_blocks(b.T, a.T).T
    product = np.empty((len(a), b.shape[1]))
    step = max(1, _ALONE // max(1, a.size))
    for k in range(0, b.shape[1], step):
        np.matmul(a, b[:, k : k + step], out=product[:, k : k + step])
    return product
