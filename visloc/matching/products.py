"""Exact products of descriptors in 8 bits, the same on every machine, and nearest neighbours."""

from __future__ import annotations

import importlib
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from visloc.matching import compiled
from visloc.runtime.threads import count_of_threads, loaded_torch

if TYPE_CHECKING:
    import torch

_LARGEST = 127
# Whole numbers up to here are exact in single precision, as are sums of them that stay below.
_EXACT_IN_FLOAT32 = 2**24
LARGEST_PRODUCT = 128**2
_MOST_COLUMNS = (2**31 - 1) // LARGEST_PRODUCT  # sums fit 32 bits
# A block of products, 4 bytes each, stays in a core's own cache of 1 MB while its largest are
# looked for; products of fewer rows take longer each (docs/decisions/0046-blocks-in-cache.md).
_BLOCK_PRODUCTS, _ROWS_STEP = 3 * 2**16, 32

T = TypeVar("T")
S = TypeVar("S")


@dataclass(frozen=True, slots=True, eq=False)
class EightBitRows:
    """Descriptors in 8 bits.

    Attributes:
        rows: (n, D) int8.
        scale: of one step; ``rows * scale`` are unit rows except for rounding.
    """

    rows: NDArray[np.int8]
    scale: float

    def __len__(self) -> int:
        return len(self.rows)


def round_descriptors(descriptors: NDArray[np.float32]) -> EightBitRows:
    """Round unit descriptors (n, D) to 8 bits, with one scale so that rows stay comparable."""
    largest = float(max(descriptors.max(initial=0.0), -descriptors.min(initial=0.0)))
    if not np.isfinite(largest):
        raise ValueError("descriptors are not finite")
    scale = largest / _LARGEST or 1.0
    rows = descriptors / np.float32(scale)
    return EightBitRows(np.rint(rows, out=rows).astype(np.int8), scale)


def block_rows(num_columns: int) -> int:
    """Return how many rows of products with so many columns, at least one, are made at once."""
    return _ROWS_STEP * max(1, round(_BLOCK_PRODUCTS / (num_columns * _ROWS_STEP)))


class RowProducts(Protocol):
    """Gives the products of some rows of one side with all rows of the other."""

    def __call__(self, rows: slice) -> torch.Tensor:
        """Return whole numbers (k, m), contiguous, which the next call overwrites."""


def row_products(a: NDArray[np.int8], b: NDArray[np.int8], most_rows: int) -> RowProducts:
    """Multiply rows of a (n, D) with all rows of b (m, D), at most so many at once.

    The products are exact, hence equal, whether 8-bit instructions or floats compute them.
    """
    import torch  # takes a second to load, which not everything that imports this needs

    if 1 < a.shape[1] <= _MOST_COLUMNS and _has_integer_products():
        multiply, operand, result = torch._int_mm, torch.int8, torch.int32
    else:
        operand = result = exact_float(a.shape[1])
        multiply = torch.mm
    left, right = torch.tensor(a, dtype=operand), torch.tensor(b, dtype=operand).T
    buffer = torch.empty((most_rows, len(b)), dtype=result)

    def products(rows: slice) -> torch.Tensor:
        return multiply(left[rows], right, out=buffer[: rows.stop - rows.start])

    return products


def exact_float(dim: int) -> torch.dtype:
    """Return the floats whose products of 8-bit rows with so many columns are exact."""
    import torch

    return torch.float32 if dim * LARGEST_PRODUCT <= _EXACT_IN_FLOAT32 else torch.float64


@cache
def _has_integer_products() -> bool:
    """Whether torch's 8-bit product is there, fast and right on this processor.

    Its name and that of the question are private to torch: they may go. Without VNNI the product is
    no faster than that of floats, and sums may be cut off at 16 bits. (Of one column, D = 1, torch
    2.13 gives wrong products in any case.)
    """
    import torch

    has_vnni = getattr(torch.cpu, "_is_vnni_supported", None)
    if not hasattr(torch, "_int_mm") or has_vnni is None or not has_vnni():
        return False
    extreme = torch.full((32, 64), -128, dtype=torch.int8)
    return bool((torch._int_mm(extreme, extreme.T) == 64 * LARGEST_PRODUCT).all())


def in_threads(work: Callable[[S], T], items: Iterable[S]) -> list[T]:
    """Do the work for each item, in as many threads as this process uses; results in their order.

    Each thread computes its items alone. Threads that share one product wait for each other a
    hundred times per query, which costs ten times the work when other processes take turns.
    """
    threads = count_of_threads()
    if threads == 1:
        return [work(item) for item in items]
    turns = threading.Semaphore(threads)  # there may be more threads

    def work_in_turn(item: S) -> T:
        with turns:
            return work(item)

    return list(_single_threads(threads).map(work_in_turn, items))


def start_threads() -> None:
    """Start the threads of ``in_threads`` now rather than at its first call.

    To be called before other threads use torch: while these start, a thread that asks torch for the
    first time would be told to compute with one thread, and would do so for ever.
    """
    if (threads := count_of_threads()) > 1:
        _single_threads(threads)


# The number of threads changes from one task of the service to the next. So those of the largest
# number are kept for all: threads for each number would be hundreds on a machine of many cores.
# Threads that were started before torch was loaded would each compute with all of torch's.
_pool: tuple[int, bool, ThreadPoolExecutor] | None = None
_pool_lock = threading.Lock()


def _forget_threads() -> None:
    """A forked child has none of its parent's threads."""
    global _pool, _pool_lock
    _pool, _pool_lock = None, threading.Lock()


if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(after_in_child=_forget_threads)


def _single_threads(count: int) -> ThreadPoolExecutor:
    """Return at least so many threads."""
    global _pool
    torch = _torch_of_products()
    with _pool_lock:
        if _pool is None or _pool[0] < count or (torch is not None and not _pool[1]):
            _pool = count, torch is not None, _start_single_threads(count, torch)
        return _pool[2]


def _start_single_threads(count: int, torch: ModuleType | None) -> ThreadPoolExecutor:
    started = threading.Barrier(count + 1)

    def compute_alone() -> None:
        if torch is not None:
            torch.get_num_threads()  # a thread's first question would undo what was set before it
            torch.set_num_threads(1)
        started.wait()

    pool = ThreadPoolExecutor(count, "matching", compute_alone)
    try:
        for _ in range(count):
            pool.submit(int)  # a thread is started for each: none is idle before all are
        started.wait()
    except RuntimeError:  # no more threads can be started
        started.abort()
        raise
    finally:
        if torch is not None:
            # A count that one thread sets for itself is also the count of threads started later.
            torch.set_num_threads(count)
    return pool


def _torch_of_products() -> ModuleType | None:
    """Return torch if it computes products here, or if anything has loaded it."""
    if compiled.level() == 0:
        return importlib.import_module("torch")
    return loaded_torch()


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
