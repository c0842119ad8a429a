"""The patches of ``densevlad``: what NumPy and torch agree on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ORIENTATIONS = 8  # a power of two
CELLS_PER_SIDE = 4
# A cell is this wide in the photo shrunk for its scale; patches overlap by all but one cell.
CELL_PX = 4
# Grey levels between the neighbours of a pixel, averaged over a patch: below, it is mere noise.
MIN_CONTRAST = 1.0


def tent() -> NDArray[np.float32]:
    """Return the weights of a cell's pixels along one axis: twice as wide as the cell."""
    weights = np.convolve(np.ones(CELL_PX), np.ones(CELL_PX)) / CELL_PX**2
    return weights.astype(np.float32)
