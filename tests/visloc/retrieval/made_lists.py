"""Inverted files of a few rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive.index_files import check_lists
from visloc.retrieval.inverted import (
    InvertedFile,
    bytes_of,
    make_centers,
    make_lists,
    num_lists,
)


def inverted(rows: NDArray[np.float32], path: Path) -> InvertedFile:
    """Make an inverted file of unit rows (n, D) and open it."""
    centers = make_centers(rows, num_lists(len(rows)))
    lists = make_lists(rows, centers)
    path.write_bytes(b"".join(bytes_of([lists])))
    opened = InvertedFile(centers, lists.sizes, path)
    check_lists(opened)
    return opened
