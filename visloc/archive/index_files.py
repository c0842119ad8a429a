"""The files of an inverted file: named, written, and opened after checks."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visloc.archive.checks import map_array
from visloc.errors import refuse
from visloc.retrieval.inverted import (
    FACTOR_BYTES,
    ID_BYTES,
    InvertedFile,
    row_bytes,
    width_of,
)

# Of a unit row's component, except for rounding.
_MOST = 1 + 1e-3


class IndexFiles(NamedTuple):
    """Names of the files of one inverted file below the folder of a map or a set."""

    centers: str
    sizes: str
    lists: str


def index_files(stem: str) -> IndexFiles:
    """Return the names that begin with a stem such as ``index/densevlad``."""
    return IndexFiles(f"{stem}.centers.npy", f"{stem}.sizes.npy", f"{stem}.lists")


def open_index(
    folder: Path, files: IndexFiles, *, dim: int, num_lists: int, num_rows: int
) -> InvertedFile:
    """Open an inverted file after checks of everything but the content of its lists."""
    width = width_of(dim)
    centers = map_array(folder, files.centers, "<f4", (num_lists, width))
    sizes = map_array(folder, files.sizes, "<i8", (num_lists,), load=True)
    for name, good in (
        (files.centers, centers_fit(centers)),
        (files.sizes, sizes_fit(sizes, num_rows)),
    ):
        if not good:
            raise refuse("map.range", field=str(folder / name))
    size, expected = (folder / files.lists).stat().st_size, num_rows * row_bytes(width)
    if size != expected:
        raise refuse(
            "map.array",
            "the lists of an index do not fit the map; restore or rebuild the map",
            field=str(folder / files.lists),
            expected=f"{expected} bytes",
            got=f"{size} bytes",
        )
    return InvertedFile(centers, sizes, folder / files.lists)


def centers_fit(centers: NDArray[np.float32]) -> bool:
    """Tell whether centres are no longer than unit rows, as means of them."""
    # NaN fails both comparisons.
    return bool(centers.min(initial=0) >= -_MOST and centers.max(initial=0) <= _MOST)


def sizes_fit(sizes: NDArray[np.int64], num_rows: int) -> bool:
    """Tell whether sizes of lists can be those of so many rows."""
    # One by one first: a sum of large numbers overflows.
    return bool(((sizes >= 0) & (sizes <= num_rows)).all()) and int(sizes.sum()) == num_rows


def check_lists(opened: InvertedFile) -> None:
    """Check that the lists number every row once and have finite codes."""
    content, start = np.memmap(opened.path, np.uint8, "r"), 0
    bytes_of_row = row_bytes(opened.centers.shape[1])
    seen = np.zeros(opened.num_rows, np.bool_)
    for size in opened.sizes.tolist():
        stop = start + size * bytes_of_row
        codes, ids = np.split(content[start:stop], [stop - start - size * ID_BYTES])
        numbers = ids.view("<i8")
        factors = codes.reshape(size, bytes_of_row - ID_BYTES)[:, -FACTOR_BYTES:]
        in_range = (numbers >= 0) & (numbers < opened.num_rows)
        if not in_range.all() or not np.isfinite(factors.copy().view("<f4")).all():
            raise refuse("map.range", field=str(opened.path))
        seen[numbers] = True
        start = stop
    if not seen.all():
        raise refuse("map.range", field=str(opened.path))
