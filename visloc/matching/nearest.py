"""For each row of one side the most similar row of another, exactly, on the processor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visloc.matching import compiled
from visloc.matching.products import LARGEST_PRODUCT, block_rows, row_products


class Nearest(NamedTuple):
    """For each row of one side (n,), the most similar row of a photo.

    Attributes:
        mutual: (k,) rows whose nearest row has no more similar one, ascending.
        rows: (n,) int64 rows of the photo; the first of equally similar ones.
        products: (n,) float64, whole numbers.
        seconds: (n,) float64 products with the second nearest rows, if they are wanted.
    """

    mutual: NDArray[np.intp]
    rows: NDArray[np.int64]
    products: NDArray[np.float64]
    seconds: NDArray[np.float64] | None


def nearest(a: NDArray[np.int8], b: NDArray[np.int8], *, with_second: bool) -> Nearest:
    """Compare rows a (n, D) with rows b (m, D); neither n nor m is 0.

    Products are exact, so compiled code and torch give the same answer.
    """
    find = compiled.nearest_columns if compiled.can_compare(a.shape[1]) else nearest_by_torch
    best, rows, second, column_best = find(a, b, with_second)
    # Equality with the column's maximum replaces a second, slower arg-max over the columns.
    mutual = np.flatnonzero(best == column_best[rows])
    return Nearest(
        mutual,
        rows.astype(np.int64),
        best.astype(np.float64),
        None if second is None else second.astype(np.float64),
    )


def nearest_by_torch(
    a: NDArray[np.int8], b: NDArray[np.int8], with_second: bool
) -> compiled.NearestColumns:
    """Make the products in blocks, and look through each twice while it is in a core's cache."""
    most_rows = block_rows(len(b))
    products = row_products(a, b, most_rows)
    best_b = np.empty(len(a), dtype=np.int64)
    best = np.empty(len(a), dtype=np.float64)
    second = np.empty(len(a), dtype=np.float64) if with_second else None
    lowest = -a.shape[1] * LARGEST_PRODUCT  # of all; the product where there is no second
    column_best, row_starts = None, np.arange(0, most_rows * len(b), len(b))
    for start in range(0, len(a), most_rows):
        rows = slice(start, min(start + most_rows, len(a)))
        block = products(rows)
        of_columns = block.amax(0).numpy()  # NumPy takes a quarter more time for this
        if column_best is None:
            column_best = of_columns
        else:
            np.maximum(column_best, of_columns, out=column_best)
        similarity = block.numpy()
        similarity.argmax(axis=1, out=best_b[rows])
        where = best_b[rows] + row_starts[: len(similarity)]
        best[rows] = similarity.take(where)
        if second is not None:
            similarity.put(where, lowest)
            similarity.max(axis=1, out=second[rows])
    assert column_best is not None  # there are rows
    return compiled.NearestColumns(best, best_b, second, column_best)
