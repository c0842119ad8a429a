"""Dot products of one vector with many rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Numbers converted to float32 at once: 1 MiB stays in the cache of a core, and is too small for
# BLAS to wake other threads, which costs more than the product.
_BLOCK_NUMBERS = 2**18


def dot_products(
    matrix: NDArray[np.int8] | NDArray[np.float32],
    vector: NDArray[np.float32],
    rows: NDArray[np.int64] | None = None,
) -> NDArray[np.float32]:
    """Return the products (m,) of some rows (m,) of a matrix (n, D), or all, with a vector (D,).

    8-bit rows are converted block by block, which is faster than reading 32-bit rows from memory.
    The matrix may be mapped from a file.
    """
    num = len(matrix) if rows is None else len(rows)
    found = np.empty(num, np.float32)
    block_rows = max(1, _BLOCK_NUMBERS // matrix.shape[1])
    block = np.empty((min(num, block_rows), matrix.shape[1]), np.float32)
    for start in range(0, num, block_rows):
        some = slice(start, min(start + block_rows, num))
        wide = block[: some.stop - some.start]
        wide[...] = matrix[some if rows is None else rows[some]]
        np.matmul(wide, vector, out=found[some])
    return found
