"""Inverted files of a few rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.retrieval.inverted import (
    InvertedFile,
    bytes_of,
    lists_are_good,
    make_centers,
    make_lists,
    num_lists,
)


def inverted(rows: NDArray[np.float32], path: Path) -> InvertedFile:
    """Make an inverted file of unit rows (n, D) and open it."""
    centers = make_centers(rows, num_lists(len(rows)))
    lists = make_lists(rows, centers)
    path.write_bytes(b"".join(bytes_of([lists])))
    assert lists_are_good(path, lists.sizes, rows.shape[1])
    return InvertedFile(centers, lists.sizes, path)
