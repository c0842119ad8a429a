from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.matching.correspondences import match_landmarks, mutual_nearest_neighbours


def unit_rows(rng: np.random.Generator, n: int, dim: int = 16) -> NDArray[np.float32]:
    rows = rng.normal(size=(n, dim))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def test_a_permuted_copy_is_matched_row_by_row() -> None:
    rng = np.random.default_rng(0)
    a = unit_rows(rng, 50)
    order = rng.permutation(50)
    i, j, similarity = mutual_nearest_neighbours(a, a[order])
    assert i.tolist() == list(range(50))
    assert order[j].tolist() == i.tolist()
    assert similarity == pytest.approx(1.0, abs=1e-6)


def test_the_nearest_neighbour_must_be_mutual() -> None:
    # b0 is nearest to both a0 and a1, but prefers a0
    a = np.array([[1.0, 0.0], [0.8, 0.6]], dtype=np.float32)
    b = np.array([[1.0, 0.0]], dtype=np.float32)
    i, j, _ = mutual_nearest_neighbours(a, b)
    assert (i.tolist(), j.tolist()) == ([0], [0])


def test_duplicate_descriptors_give_one_pair_each() -> None:
    same = np.tile(np.array([[1.0, 0.0]], dtype=np.float32), (3, 1))
    i, j, _ = mutual_nearest_neighbours(same, same[:2])
    assert (i.tolist(), j.tolist()) == ([0], [0])


@pytest.mark.parametrize(("n", "m"), [(0, 5), (5, 0), (0, 0)])
def test_nothing_matches_nothing(n: int, m: int) -> None:
    i, j, similarity = mutual_nearest_neighbours(
        np.zeros((n, 4), np.float32), np.zeros((m, 4), np.float32)
    )
    assert len(i) == len(j) == len(similarity) == 0


QUERY = np.array([[1.0, 0.0]], dtype=np.float32)
NEAR = np.array([[0.9, np.sqrt(1 - 0.81)]], dtype=np.float32)


def test_the_photo_most_like_the_query_wins_over_another_one() -> None:
    pairs = match_landmarks(QUERY, [(np.array([3]), NEAR), (np.array([7]), QUERY)])
    assert (pairs.landmarks.tolist(), pairs.support.tolist()) == ([3], [1.0])
    assert pairs.similarities == pytest.approx([0.9])


def test_photos_that_agree_outvote_a_better_ranked_one() -> None:
    # 1 against 1/2 + 1/3 + 1/4
    others = [(np.array([7]), NEAR), (np.array([7]), NEAR), (np.array([7]), QUERY)]
    pairs = match_landmarks(QUERY, [(np.array([3]), QUERY), *others])
    assert pairs.landmarks.tolist() == [7]
    assert pairs.support == pytest.approx([13 / 12])
    assert pairs.similarities == pytest.approx([1.0])


def test_each_keypoint_and_each_landmark_is_used_once() -> None:
    rng = np.random.default_rng(1)
    query = unit_rows(rng, 200)
    images = []
    for _ in range(5):
        rows = rng.permutation(200)[:120]
        noisy = query[rows] + 0.2 * rng.normal(size=(120, 16)).astype(np.float32)
        noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
        images.append((rows // 2, noisy))  # two keypoints share each landmark
    pairs = match_landmarks(query, images)
    assert len(set(pairs.keypoints.tolist())) == len(pairs)
    assert len(set(pairs.landmarks.tolist())) == len(pairs)
    assert (pairs.landmarks == pairs.keypoints // 2).mean() > 0.95


def test_no_photos_give_no_pairs() -> None:
    assert len(match_landmarks(np.ones((3, 4), np.float32), [])) == 0
