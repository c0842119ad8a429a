"""The compiled search for nearest rows (native/nearest.c), where it was built for this machine.

It multiplies and looks for the largest in one pass, so that products never leave the processor's
registers (docs/decisions/0052-compiled-matching.md).
"""

from __future__ import annotations

import ctypes
import logging
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_LOGGER = logging.getLogger(__name__)
LIBRARY = Path(__file__).with_name("native") / "nearest.so"
_MOST_DIMENSIONS = 2**16 - 1  # sums fit 32 bits
# What ``visloc_nearest_level`` returns.
PROCESSORS = {1: "AVX2", 2: "AVX-512 VNNI"}


class NearestColumns(NamedTuple):
    """For each row of a (n,) the most similar row of b, and for each row of b (m,) how similar.

    Attributes:
        best: (n,) the largest product of each row of a.
        columns: (n,) the row of b that gives it, the first of equal ones.
        second: (n,) the second largest product; None if it was not asked for. Where b has one
            row, a number that is no larger than any product.
        column_best: (m,) the largest product of each row of b.
    """

    best: NDArray[Any]
    columns: NDArray[np.integer]
    second: NDArray[Any] | None
    column_best: NDArray[Any]


def can_compare(dim: int) -> bool:
    """Return whether there is compiled code for rows of so many numbers."""
    return 0 < dim <= _MOST_DIMENSIONS and level() > 0


def nearest_columns(
    a: NDArray[np.int8], b: NDArray[np.int8], with_second: bool, at_level: int | None = None
) -> NearestColumns:
    """Compare rows a (n, D) with rows b (m, D); neither n nor m is 0. Releases Python's lock.

    Args:
        with_second: whether the second largest products are wanted.
        at_level: the kind of processor to compute for, at most ``level()``; None for that.
    """
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    (n, dim), m = a.shape, len(b)
    if a.dtype != np.int8 or b.dtype != np.int8 or b.shape[1] != dim:  # C would read beyond b
        raise ValueError(f"rows of {a.shape[1]} {a.dtype} and {b.shape[1]} {b.dtype} do not match")
    best, columns = np.empty(n, np.int32), np.empty(n, np.int32)
    second = np.empty(n, np.int32) if with_second else None
    column_best = np.empty(m, np.int32)
    function = _library().visloc_nearest
    failed = function(
        level() if at_level is None else at_level,
        *(a.ctypes.data, n, b.ctypes.data, m, dim, best.ctypes.data, columns.ctypes.data),
        *(None if second is None else second.ctypes.data, column_best.ctypes.data),
    )
    if failed:
        raise MemoryError(f"no memory to compare {n} with {m} descriptors")
    return NearestColumns(best, columns, second, column_best)


@cache
def level() -> int:
    """Return which of ``PROCESSORS`` the library is used for; 0 if it is not used.

    The log says which. It is tried before it is used: a compiler may be wrong.
    """
    if not LIBRARY.exists():
        _LOGGER.info("descriptors are matched by torch, not by compiled code: it was not built")
        return 0
    try:
        highest = int(_library().visloc_nearest_level())
    except OSError as error:  # it was built for another system
        _LOGGER.warning("descriptors are matched by torch, not by compiled code: %s", error)
        return 0
    for each in range(highest, 0, -1):
        if _is_right(each):
            _LOGGER.info("descriptors are matched by compiled code for %s", PROCESSORS[each])
            return each
        _LOGGER.warning("compiled code for %s gives wrong matches", PROCESSORS[each])
    _LOGGER.info("descriptors are matched by torch: the processor has no AVX2")
    return 0


@cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(str(LIBRARY))
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    library.visloc_nearest.argtypes = [
        *(ctypes.c_int, pointer, size, pointer, size, size),
        *(pointer, pointer, pointer, pointer),
    ]
    return library


def _is_right(at_level: int) -> bool:
    """Try it on rows that fill no tile, with the largest numbers and with equal products."""
    numbers = np.arange(150 * 13, dtype=np.int64) ** 2 % 257
    rows = (numbers.reshape(150, 13) - 128).clip(-128, 127).astype(np.int8)
    a, b = np.concatenate([rows[:19], rows[:1]]), np.concatenate([rows, rows[:30]])
    exact = a.astype(np.int64) @ b.T.astype(np.int64)
    found = nearest_columns(a, b, with_second=True, at_level=at_level)
    assert found.second is not None
    sorted_products = np.sort(exact, axis=1)
    return bool(
        np.array_equal(found.best, sorted_products[:, -1])
        and np.array_equal(found.second, sorted_products[:, -2])
        and np.array_equal(found.columns, exact.argmax(axis=1))
        and np.array_equal(found.column_best, exact.max(axis=0))
    )
