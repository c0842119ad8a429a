"""Masks of what is fixed to the picture of a camera: the same in all its photos."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Camera

CameraMask = NDArray[np.bool_]
"""Cells (rows, columns) of a camera's picture."""
# Cells along the longer side of a picture.
_CELLS = 24
# What spans more of a side than this lies at neither of its ends.
_ALONG = 0.6


def are_masked(camera: Camera, mask: CameraMask, pixels: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Tell which pixels (n, 2) of a camera's photos lie in masked cells."""
    return np.asarray(mask[cells_of(camera, pixels)])


def where_in_picture(mask: CameraMask) -> str:
    """Say in words where the masked cells of a picture lie, as stored."""
    words = []
    ends = ("top", "bottom"), ("left", "right")
    for cells, length, (near, far) in zip(np.nonzero(mask), mask.shape, ends, strict=True):
        middle = (cells.mean() + 0.5) / length
        is_along = np.ptp(cells) + 1 > _ALONG * length
        words.append("" if is_along or 1 / 3 <= middle <= 2 / 3 else near if middle < 0.5 else far)
    if any(words):
        return f"at the {' '.join(filter(None, words))}"
    return "in the middle"


def shape_of(camera: Camera) -> tuple[int, int]:
    """Return how many rows and columns of cells a camera's picture has."""
    size = max(camera.width, camera.height) / _CELLS
    return max(1, round(camera.height / size)), max(1, round(camera.width / size))


def cells_of(
    camera: Camera, pixels: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows and columns (n,) of the cells in which pixels (n, 2) lie."""
    rows, columns = shape_of(camera)
    x, y = np.asarray(pixels, np.float64).T
    row = np.clip(y / camera.height * rows, 0, rows - 1)
    column = np.clip(x / camera.width * columns, 0, columns - 1)
    return row.astype(np.int64), column.astype(np.int64)
