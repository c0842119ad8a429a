from __future__ import annotations

import numpy as np
import pytest

from mapping.methods import nearest
from mapping.methods.nearest import mutual_rows
from visloc.matching.correspondences import mutual_nearest_neighbours
from visloc.matching.products import EightBitRows


# One block, many, and blocks of one row; few values, so that many products are equal.
@pytest.mark.parametrize("most_products", [320_000, 1000, 1])
def test_pairs_are_those_of_queries(monkeypatch: pytest.MonkeyPatch, most_products: int) -> None:
    monkeypatch.setattr(nearest, "_MOST_PRODUCTS", most_products)
    random = np.random.default_rng(0)
    a, b = (random.integers(-2, 3, (count, 8), dtype=np.int8) for count in (150, 90))
    i, j, _ = mutual_nearest_neighbours(EightBitRows(a, 1.0), EightBitRows(b, 1.0))
    assert len(i) > 10
    assert mutual_rows(a, b).tolist() == np.column_stack([i, j]).tolist()


def test_a_photo_without_descriptors_has_no_pairs() -> None:
    some, none = np.ones((3, 8), np.int8), np.empty((0, 8), np.int8)
    assert mutual_rows(some, none).shape == mutual_rows(none, some).shape == (0, 2)
