from __future__ import annotations

import numpy as np
import pytest

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse import thinning
from mapping.methods.sparse.model import SfmPhoto
from mapping.methods.sparse.thinning import thin
from visloc.geometry import Camera

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
COUNT = 3 * thinning.MOST


@pytest.fixture(autouse=True)
def _of_many_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "ALL", 0)


def photo_of(number: int, keypoints: np.ndarray) -> SfmPhoto:
    return SfmPhoto(f"{number}.jpg", "cam", number, CAMERA, True, None, keypoints)


def all_of(first: int, second: int, rows: np.ndarray) -> Matches:
    return Matches(first, second, np.column_stack([rows, rows]).astype(np.uint32))


def test_few_keypoints_all_stay() -> None:
    keypoints = np.random.default_rng(0).uniform(0, 480, (50, 2)).astype(np.float32)
    (kept,) = thin([photo_of(0, keypoints), photo_of(1, keypoints)], [all_of(0, 1, np.arange(50))])
    np.testing.assert_array_equal(kept.rows, all_of(0, 1, np.arange(50)).rows)


def test_those_that_match_in_more_pairs_stay() -> None:
    # All in one cell, so that nothing but the number of pairs counts.
    keypoints = np.random.default_rng(0).uniform(1, 70, (COUNT, 2)).astype(np.float32)
    often = np.arange(COUNT - thinning.MOST, COUNT)
    matches = [all_of(0, 1, np.arange(COUNT)), all_of(0, 2, often), all_of(1, 2, often)]
    kept = thin([photo_of(number, keypoints) for number in range(3)], matches)
    for pair in kept:
        np.testing.assert_array_equal(pair.rows[:, 0], often)


def test_few_photos_keep_more_keypoints(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "ALL", 4 * thinning.MOST)
    keypoints = np.random.default_rng(0).uniform(0, 480, (COUNT, 2)).astype(np.float32)
    (kept,) = thin(
        [photo_of(0, keypoints), photo_of(1, keypoints)], [all_of(0, 1, np.arange(COUNT))]
    )
    assert len(kept.rows) == 2 * thinning.MOST


def test_they_are_spread_over_the_photo() -> None:
    random = np.random.default_rng(0)
    crowded = random.uniform([0, 0], [79, 79], (COUNT - 200, 2))
    others = random.uniform([100, 100], [640, 480], (200, 2))
    keypoints = np.concatenate([crowded, others]).astype(np.float32)
    (kept,) = thin(
        [photo_of(0, keypoints), photo_of(1, keypoints)], [all_of(0, 1, np.arange(COUNT))]
    )
    assert len(kept.rows) == thinning.MOST
    assert set(range(COUNT - 200, COUNT)) <= set(kept.rows[:, 0].tolist())


def test_a_photo_without_matches_is_no_harm() -> None:
    empty = np.empty((0, 2), np.float32)
    assert thin([photo_of(0, empty)], []) == []
