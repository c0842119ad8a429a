"""An inverted file of very many rows, searched by faiss: which rows may be most like a query.

Rows are clustered (Sivic and Zisserman 2003). The list of a cluster holds a code of one bit per
dimension for each of its rows (RaBitQ, Gao and Long 2024), and the row's number. faiss maps the
lists from their file and searches them; it never parses a file. faiss's own readers would parse
untrusted bytes, so they are not used. ``visloc.archive.index_files`` checks the plain arrays when
an inverted file is opened (docs/decisions/0034-the-index-is-faiss.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

_ITERATIONS = 10
_SAMPLES_PER_LIST = 50
# Least length of a centre, even if all of its rows went to other centres.
_LEAST_ALIKE = 0.05
_BLOCK_ROWS = 4096
# Codes fill whole words of so many bits, so that the numbers after them are aligned.
_WORD_BITS = 64
ID_BYTES, FACTOR_BYTES = 8, 8
# Codes that are compared, for each row that is wanted, before those of other lists are bounded.
_FIRST_CODES = 10
# A query is rounded to so many bits before it is compared with codes.
_QUERY_BITS = 6
# Numbers converted to float32 at once: 1 MiB stays in the cache of a core, and is too small for
# BLAS to wake other threads, which costs more than the product.
_BLOCK_NUMBERS = 2**18


class Rows(Protocol):
    """Unit rows (n, D) that are read in parts: an array, or the stored rows of a map."""

    def __len__(self) -> int: ...

    def __getitem__(self, rows: Any, /) -> NDArray[np.float32]: ...


@dataclass(frozen=True, slots=True, eq=False)
class MadeLists:
    """The lists of an inverted file, to be written.

    Attributes:
        centers: (C, D') float32, one row for each list.
        sizes: (C,) int64 rows of each list.
        codes: (n, B) uint8, list by list.
        ids: (n,) int64 numbers of the rows, list by list.
    """

    centers: NDArray[np.float32]
    sizes: NDArray[np.int64]
    codes: NDArray[np.uint8]
    ids: NDArray[np.int64]


class InvertedFile:
    """An inverted file that is open for queries; its lists stay mapped from their file.

    Args:
        centers: (C, D') float32, one row for each list; D' is ``width_of(D)``.
        sizes: (C,) int64, rows of each list.
        lists: the file: for each list its codes, then the numbers of its rows as int64.

    Attributes:
        error: two standard deviations of a rough cosine, for a query that resembles no centre.
    """

    __slots__ = ("_index", "_lengths", "centers", "error", "num_rows", "path", "sizes")

    def __init__(self, centers: NDArray[np.float32], sizes: NDArray[np.int64], lists: Path) -> None:
        faiss = _faiss()
        count, width = centers.shape
        self.sizes, self.path = sizes, lists
        self.num_rows = int(sizes.sum())
        # faiss reads them where they are, which may be a file that processes share.
        self.centers = np.require(centers, np.float32, ["C", "A"])
        self._index = _index(self.centers)
        self._lengths = _lengths(self.centers)
        self.error = _error(self.centers, self._lengths, sizes)
        mapped = faiss.OnDiskInvertedLists()
        mapped.nlist, mapped.code_size = count, self._index.code_size
        mapped.totsize = self.num_rows * row_bytes(width)
        mapped.filename, mapped.read_only = str(lists), True
        mapped.prefetch_nthread = 0  # it would start threads
        mapped.lists.resize(count)
        counts = sizes.astype(np.uint64)  # kept until faiss has copied it
        mapped.set_all_lists_sizes(faiss.swig_ptr(counts))
        if self.num_rows:
            mapped.do_mmap()
        self._index.replace_invlists(mapped, False)
        self._index.referenced_objects += (mapped,)
        self._index.ntotal = self.num_rows

    def nearest_lists(
        self, query: NDArray[np.float32], count: int, among: NDArray[np.int64] | None = None
    ) -> NDArray[np.int64]:
        """The lists (k,) whose centres have the largest cosines to a query, best first.

        Args:
            query: unit vector (D,).
            count: how many lists at most, at least 1.
            among: (m,) the lists that are considered; None for all.
        """
        wide = _widened(query[None], self.centers.shape[1])[0]
        cosines = dot_products(self.centers, wide, among)
        cosines /= self._lengths if among is None else self._lengths[among]
        best = largest(cosines, count)
        best = best[np.argsort(-cosines[best])]
        return best if among is None else among[best]

    def most_alike(
        self,
        query: NDArray[np.float32],
        lists: NDArray[np.int64],
        count: int,
        allowed: NDArray[np.bool_] | None = None,
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The rows (k,) with the largest rough cosines, at most ``count``, and those cosines (k,).

        Both as ``rough_cosines`` returns them for all lists, but faster: what the first lists hold
        bounds what can count in the others.

        Args:
            query: unit vector (D,).
            count: at least 1.
            allowed: (n,) the rows that may come; None for all.
        """
        end = 1 + np.searchsorted(np.cumsum(self.sizes[lists]), _FIRST_CODES * count)
        rows, cosines = self.rough_cosines(query, lists[:end], allowed)
        if end < len(lists):
            best = largest(cosines, count)
            rows, cosines = rows[best], cosines[best]
            least = float(cosines.min()) if len(best) == count else -np.inf
            others, theirs = self.rough_cosines(query, lists[end:], allowed, least)
            rows, cosines = np.concatenate([rows, others]), np.concatenate([cosines, theirs])
        best = largest(cosines, count)
        return rows[best], cosines[best]

    def rough_cosines(
        self,
        query: NDArray[np.float32],
        lists: NDArray[np.int64],
        allowed: NDArray[np.bool_] | None = None,
        above: float = -np.inf,
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Compare a query with the codes of some lists; return rows (m,) and cosines (m,).

        They come in no order. Rows and cosines are in range whatever the file holds, but a row may
        come twice where the file says so.

        Args:
            query: unit vector (D,).
            allowed: (n,) the rows that may come; None for all.
            above: only rows with larger cosines are returned.
        """
        faiss = _faiss()
        chosen = faiss.IVFRaBitQSearchParameters()
        chosen.nprobe, chosen.qb = len(lists), _QUERY_BITS
        if allowed is not None:
            bits = np.packbits(allowed, bitorder="little")
            selector = faiss.IDSelectorBitmap(len(bits), faiss.swig_ptr(bits))
            chosen.sel = selector
        probed = np.ascontiguousarray(lists, np.int64)
        distances = np.zeros(len(probed), np.float32)  # RaBitQ reads the centres instead
        wide, found = _widened(query[None], self.centers.shape[1]), faiss.RangeSearchResult(1)
        arrays = map(faiss.swig_ptr, (probed, distances))
        self._index.range_search_preassigned_c(
            1, faiss.swig_ptr(wide), above, *arrays, found, False, chosen
        )
        num = int(faiss.rev_swig_ptr(found.lims, 2)[1])
        rows, cosines = (faiss.rev_swig_ptr(a, num) for a in (found.labels, found.distances))
        good = (rows >= 0) & (rows < self.num_rows)
        kept = slice(None) if good.all() else good
        # Copies, since faiss frees what it found.
        return rows[kept].copy(), np.clip(cosines[kept], -1, 1)


def largest(values: NDArray[np.floating], count: int) -> NDArray[np.int64]:
    """Return the positions of the largest values (n,), in no order, at most ``count``."""
    if count >= len(values):
        return np.arange(len(values))
    return np.argpartition(-values, count)[:count]


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
        wide = matrix[some if rows is None else rows[some]]
        if wide.dtype != np.float32:
            block[: len(wide)] = wide
            wide = block[: len(wide)]
        np.matmul(wide, vector, out=found[some])
    return found


def width_of(dim: int) -> int:
    """Dimensions of centres and codes of rows of ``dim`` dimensions; those added are zero."""
    return -(-dim // _WORD_BITS) * _WORD_BITS


def row_bytes(width: int) -> int:
    """Bytes of one row in the lists: a bit for each dimension, two float32, and its number."""
    return width // 8 + FACTOR_BYTES + ID_BYTES


def make_centers(rows: Rows, count: int, seed: int = 0) -> NDArray[np.float32]:
    """Cluster unit rows (n, D) by spherical k-means on a sample; return (C, D') centres.

    A centre is the mean of its rows, so its length is their average cosine to it. Codes describe
    the differences of rows from their centre, which the mean makes as small as possible.
    """
    faiss = _faiss()
    num = len(rows)
    random = np.random.default_rng(seed)
    chosen = np.sort(random.choice(num, min(num, _SAMPLES_PER_LIST * count), replace=False))
    sample = np.asarray(rows[chosen], np.float32)
    sample = _widened(sample, width_of(sample.shape[1]))
    means = faiss.Kmeans(
        sample.shape[1],
        min(num, count),
        niter=_ITERATIONS,
        seed=seed,
        spherical=True,
        min_points_per_centroid=1,
        max_points_per_centroid=_SAMPLES_PER_LIST,
    )
    means.train(sample)
    cosines, nearest = means.assign(sample)
    counts = np.bincount(nearest, minlength=means.k)
    alike = np.bincount(nearest, cosines, means.k) / np.maximum(counts, 1)
    return np.asarray(means.centroids * np.clip(alike, _LEAST_ALIKE, 1)[:, None], np.float32)


def make_lists(rows: Rows, centers: NDArray[np.float32]) -> MadeLists:
    """Put unit rows (n, D) into the lists of the centres (C, D') that they are most like."""
    coarse = _coarse(centers / _lengths(centers)[:, None])
    index = _index(centers)
    num, width = len(rows), centers.shape[1]
    nearest = np.empty(num, np.int64)
    codes = np.empty((num, index.code_size), np.uint8)
    faiss = _faiss()
    for start in range(0, num, _BLOCK_ROWS):
        block = slice(start, start + _BLOCK_ROWS)
        some = _widened(np.asarray(rows[block], np.float32), width)
        found = np.ascontiguousarray(coarse.assign(some, 1).ravel())
        index.encode_vectors(
            len(some), faiss.swig_ptr(some), faiss.swig_ptr(found), faiss.swig_ptr(codes[block])
        )
        nearest[block] = found
    order = np.argsort(nearest, kind="stable")
    sizes = np.bincount(nearest, minlength=len(centers)).astype(np.int64)
    return MadeLists(centers, sizes, codes[order], order.astype(np.int64))


def bytes_of(lists: Iterable[MadeLists]) -> Iterator[bytes]:
    """The content of the file of the lists; ids are numbered on from one part to the next."""
    before = 0
    for made in lists:
        ends = np.cumsum(made.sizes)
        for start, stop in zip((ends - made.sizes).tolist(), ends.tolist(), strict=True):
            yield made.codes[start:stop].tobytes()
            yield (made.ids[start:stop] + before).astype("<i8").tobytes()
        before += len(made.ids)


def num_lists(num_rows: int) -> int:
    """Return how many lists to make: comparing the centres takes as long as searching a few."""
    return min(num_rows, round(2.0 * math.sqrt(num_rows)))


def _widened(rows: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    wide = np.zeros((len(rows), width), np.float32)
    wide[:, : rows.shape[1]] = rows
    return wide


def _lengths(centers: NDArray[np.float32]) -> NDArray[np.float32]:
    # Without squares of all in memory.
    squared = np.einsum("ij,ij->i", centers, centers)
    return np.asarray(np.maximum(np.sqrt(squared), _LEAST_ALIKE))


def _error(
    centers: NDArray[np.float32], lengths: NDArray[np.float32], sizes: NDArray[np.int64]
) -> float:
    """Two standard deviations of a rough cosine; theorem 3.2 of Gao and Long 2024.

    Codes give the product of two differences: row minus centre, and query minus centre. Dimensions
    that were added for the width are zero in both, and do not count.
    """
    squared = float(np.clip(np.average(lengths**2, weights=sizes), 0, 1)) if sizes.any() else 0.0
    row, query = 1 - squared, 1 + squared
    dim = max(1, int(np.count_nonzero(centers.any(axis=0))))
    return 2.0 * math.sqrt((math.pi / 2 - 1) / dim * row * query)


def _coarse(centers: NDArray[np.float32]) -> Any:
    """A flat index that reads the centres where they are."""
    faiss = _faiss()
    coarse = faiss.IndexFlatIP(centers.shape[1])
    flat = centers.reshape(-1).view(np.uint8)
    # Owned by none: the array is.
    coarse.codes = coarse.codes.create_view(faiss.swig_ptr(flat), flat.size, coarse.codes.owner)
    coarse.ntotal, coarse.referenced_objects = len(centers), flat
    return coarse


def _index(centers: NDArray[np.float32]) -> Any:
    faiss, coarse = _faiss(), _coarse(centers)
    index = faiss.IndexIVFRaBitQ(coarse, coarse.d, coarse.ntotal, faiss.METRIC_INNER_PRODUCT, False)
    if index.code_size != row_bytes(coarse.d) - ID_BYTES:
        raise AssertionError(f"this faiss writes codes of {index.code_size} bytes")
    index.is_trained = True
    index.referenced_objects = (coarse,)
    return index


def _faiss() -> Any:
    """Load faiss, with one thread: builds must not depend on the number of processors."""
    import faiss  # maps without an inverted file do not need it

    faiss.omp_set_num_threads(1)
    return faiss
