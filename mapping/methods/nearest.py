"""Mutual nearest neighbours of two photos' descriptors, in blocks that stay in the cache."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visloc.matching.products import row_products

# Products of some rows with all of the other photo, which are looked through twice: 1.2 MB of them.
# Those of four times as many rows leave the second cache, and take 1.8 times as long.
_MOST_PRODUCTS = 320_000


def mutual_rows(a: NDArray[np.int8], b: NDArray[np.int8]) -> NDArray[np.uint32]:
    """Pair the descriptors of a (n, D) and b (m, D) that are each other's most similar.

    The pairs are those of ``visloc.matching.correspondences.mutual_nearest_neighbours``, without
    their similarities.

    Returns:
        (k, 2) rows of a and of b, by the first. Ties go to the lower row of b, and of a.
    """
    if len(a) == 0 or len(b) == 0:
        return np.empty((0, 2), np.uint32)
    most = max(1, _MOST_PRODUCTS // len(b))
    products = row_products(a, b, most)
    best_b = np.empty(len(a), np.int64)
    best, best_of_b = np.empty(len(a)), np.full(len(b), -np.inf)
    for start in range(0, len(a), most):
        rows = slice(start, min(start + most, len(a)))
        block = products(rows)
        block.argmax(axis=1, out=best_b[rows])
        best[rows] = block[np.arange(len(block)), best_b[rows]]
        np.maximum(best_of_b, block.max(axis=0), out=best_of_b)
    mutual = np.flatnonzero(best == best_of_b[best_b])
    # Rows that are equally similar to one row of b: the first keeps it.
    _, first = np.unique(best_b[mutual], return_index=True)
    mutual = mutual[np.sort(first)]
    return np.column_stack([mutual, best_b[mutual]]).astype(np.uint32)
