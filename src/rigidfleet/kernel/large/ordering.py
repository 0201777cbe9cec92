"""In which order agents are eliminated, and where the blocks of a sparse factor are."""

import numpy as np
from numpy.typing import NDArray

from rigidfleet.kernel.engine import native
from rigidfleet.kernel.records import Order, Pattern
from rigidfleet.typing import Ints


def order_of_steps(steps: Ints, edges: NDArray[np.integer]) -> Order:
    """Prepare an order from steps (N, 4), an agent and its edges (-1: none), and edges (m, 2)."""
    agent, edge = steps[:, 0], np.maximum(steps[:, 1:], 0)
    ends = edges[edge].astype(np.int64)
    first = ends[:, :, 0] == agent[:, None]
    narrow = lambda x: np.ascontiguousarray(x, dtype=np.uint32)  # noqa: E731
    other = np.where(first, ends[:, :, 1], ends[:, :, 0])
    return Order(narrow(agent), narrow(edge), narrow(other), np.where(first, 1, -1).astype(np.int8))


def symbolic_factorisation(n: int, edges: NDArray[np.integer], order: Ints, most: float) -> Pattern:
    """Pattern of L with agents eliminated in ``order`` (N,).

    If there are more than ``most`` blocks per agent, fill is omitted: the pattern is that of K.
    """
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    ends = np.unique(np.sort(place[edges], axis=1), axis=0)
    before = ends[np.lexsort((ends[:, 0], ends[:, 1]))]  # by rows
    first = np.searchsorted(before[:, 1], np.arange(n + 1)).astype(np.int64)
    left = np.ascontiguousarray(before[:, 0])
    parent, mark, count = (np.full(n, -1) for _ in range(3))
    native.call_large("elimination_tree", first, left, parent, mark)
    mark[:], count[:] = -1, 1
    fill = native.call_large("add_block_counts", first, left, parent, mark, count, int(most * n))
    if not fill:
        parent[:] = -1  # no fill is inherited
        mark[:], count[:] = -1, 1
        native.call_large("add_block_counts", first, left, parent, mark, count, 1 << 62)
    column = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    blocks = int(column[-1])
    blocks_of = Pattern(
        place, column, np.empty(blocks, np.int64), np.empty(n + 1, np.int64),
        np.empty(blocks - n, np.int64), np.empty(blocks - n, np.int64), np.empty(len(edges), np.int64),
    )  # fmt: skip
    mark[:] = -1
    next_ = column[:-1].copy()
    native.call_large("list_factor_blocks", first, left, parent, mark, next_, blocks_of)
    key = (
        np.repeat(np.arange(n), np.diff(column)) * n + blocks_of.row
    )  # sorted, as rows are in a column
    low, high = np.sort(place[edges], axis=1).T
    blocks_of.of_edge[:] = np.searchsorted(key, low * n + high)
    return blocks_of
