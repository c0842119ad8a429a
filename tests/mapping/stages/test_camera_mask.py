from __future__ import annotations

import numpy as np
import pytest

from mapping.stages.camera_mask import where_in_picture


@pytest.mark.parametrize(
    ("rows", "columns", "where"),
    [
        (slice(15, 18), slice(0, 24), "at the bottom"),
        (slice(0, 3), slice(0, 24), "at the top"),
        (slice(0, 18), slice(20, 24), "at the right"),
        (slice(0, 4), slice(0, 6), "at the top left"),
        (slice(14, 18), slice(18, 24), "at the bottom right"),
        (slice(7, 11), slice(10, 14), "in the middle"),
        (slice(0, 18), slice(0, 24), "in the middle"),
    ],
)
def test_where_masked_cells_lie(rows: slice, columns: slice, where: str) -> None:
    mask = np.zeros((18, 24), dtype=np.bool_)
    mask[rows, columns] = True
    assert where_in_picture(mask) == where
