from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from visloc.matching import compiled, products
from visloc.matching.correspondences import (
    Pairs,
    match_landmarks,
    mutual_nearest_neighbours,
    settled,
)
from visloc.matching.products import EightBitRows, round_descriptors


def unit_rows(rng: np.random.Generator, n: int, dim: int = 16) -> NDArray[np.float32]:
    rows = rng.normal(size=(n, dim))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def whole(rows: list[list[int]] | NDArray[np.integer]) -> EightBitRows:
    return EightBitRows(np.array(rows, dtype=np.int8), 1.0)


@pytest.fixture(params=["compiled", "torch, 8 bits", "torch, floats"])
def computed(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute products in each of the ways that a machine may have."""
    if request.param == "compiled" and compiled.level() == 0:
        pytest.skip("there is no compiled code for this machine")
    if request.param != "compiled":
        monkeypatch.setattr(compiled, "level", lambda: 0)
    if request.param == "torch, floats":
        monkeypatch.setattr(products, "_has_integer_products", lambda: False)


def test_a_permuted_copy_is_matched_row_by_row() -> None:
    rng = np.random.default_rng(0)
    a = unit_rows(rng, 50)
    order = rng.permutation(50)
    i, j, similarity = mutual_nearest_neighbours(round_descriptors(a), round_descriptors(a[order]))
    assert i.tolist() == list(range(50))
    assert order[j].tolist() == i.tolist()
    assert similarity.dtype == np.float32
    assert similarity == pytest.approx(1.0, abs=0.02)


def test_the_nearest_neighbour_must_be_mutual() -> None:
    # b0 is nearest to both a0 and a1, but prefers a0
    i, j, similarity = mutual_nearest_neighbours(whole([[10, 0], [8, 6]]), whole([[10, 0]]))
    assert (i.tolist(), j.tolist(), similarity.tolist()) == ([0], [0], [100.0])


def test_duplicate_descriptors_give_one_pair_each() -> None:
    i, j, _ = mutual_nearest_neighbours(whole([[1, 0]] * 3), whole([[1, 0]] * 2))
    assert (i.tolist(), j.tolist()) == ([0], [0])


@pytest.mark.parametrize(("n", "m"), [(0, 5), (5, 0), (0, 0)])
def test_nothing_matches_nothing(n: int, m: int) -> None:
    i, j, similarity = mutual_nearest_neighbours(
        whole(np.zeros((n, 4), np.int8)), whole(np.zeros((m, 4), np.int8))
    )
    assert len(i) == len(j) == len(similarity) == 0


@pytest.mark.usefixtures("computed")
@pytest.mark.parametrize("dim", [1, 2, 3, 64, 128, 1024, 1041])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 30), (255, 3), (257, 40), (600, 520)])
def test_pairs_are_those_of_the_definition(n: int, m: int, dim: int) -> None:
    # Small numbers, so that many similarities are equal; one row of the largest, for overflows.
    rng = np.random.default_rng(n + m + dim)
    a, b = (rng.integers(-2, 3, (count, dim)).astype(np.int8) for count in (n, m))
    a[-1], b[-1] = -128, -128
    i, j, similarity = mutual_nearest_neighbours(EightBitRows(a, 0.5), EightBitRows(b, 0.25))
    exact = a.astype(np.float64) @ b.T.astype(np.float64)
    expected: dict[int, int] = {}
    for row in range(n):
        column = int(np.argmax(exact[row]))
        if exact[row, column] == exact[:, column].max() and column not in expected.values():
            expected[row] = column
    assert dict(zip(i.tolist(), j.tolist(), strict=True)) == expected
    assert np.array_equal(similarity, (exact[i, j] / 8).astype(np.float32))


def at(*angles_deg: float) -> EightBitRows:
    """Unit vectors in the plane; a step of 1/127 is 0.45 degrees at most."""
    angles = np.radians(angles_deg)
    return round_descriptors(np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32))


@pytest.mark.parametrize(("second_deg", "clear"), [(40.0, True), (23.5, True), (21.0, False)])
def test_the_second_nearest_must_be_clearly_further(second_deg: float, *, clear: bool) -> None:
    # 20 degrees of turn are a distance of 0.347; 0.347 / 0.9 is one of 22.3 degrees
    i, j, similarity = mutual_nearest_neighbours(at(0), at(second_deg, -20), 0.9)
    assert (i.tolist(), j.tolist()) == (([0], [1]) if clear else ([], []))
    assert similarity == pytest.approx([np.cos(np.radians(20))] if clear else [], abs=0.01)


def test_of_equal_descriptors_none_is_clearly_nearest() -> None:
    assert len(mutual_nearest_neighbours(at(0), at(0, 0, 90), 0.9)[0]) == 0


def test_a_photo_with_one_landmark_has_no_second_nearest() -> None:
    assert len(mutual_nearest_neighbours(at(0), at(60), 0.9)[0]) == 1


@pytest.mark.usefixtures("computed")
@pytest.mark.parametrize(("n", "m", "dim"), [(600, 520, 8), (257, 2, 128), (30, 1, 3), (5, 9, 1)])
def test_pairs_under_a_ratio_are_those_of_the_definition(n: int, m: int, dim: int) -> None:
    rng = np.random.default_rng(n)
    a, b = round_descriptors(unit_rows(rng, n, dim)), round_descriptors(unit_rows(rng, m, dim))
    i, j, similarity = mutual_nearest_neighbours(a, b)
    cosines = a.rows[i].astype(np.float64) @ b.rows.T.astype(np.float64) * (a.scale * b.scale)
    distances = np.sqrt(2 - 2 * np.clip(cosines, -1, 1))
    nearest = distances[np.arange(len(i)), j]
    distances[np.arange(len(i)), j] = np.inf
    second = np.minimum(distances.min(axis=1), 2.0)
    clear = nearest < 0.9 * second
    found = mutual_nearest_neighbours(a, b, 0.9)
    assert np.array_equal(found[0], i[clear])
    assert np.array_equal(found[1], j[clear])
    assert np.array_equal(found[2], similarity[clear])


QUERY = np.array([[1.0, 0.0]], dtype=np.float32)
NEAR = np.array([[0.9, np.sqrt(1 - 0.81)]], dtype=np.float32)


def seen(landmark: int, descriptor: NDArray[np.float32]) -> tuple[NDArray[np.int64], EightBitRows]:
    return np.array([landmark]), round_descriptors(descriptor)


def test_the_photo_most_like_the_query_wins_over_another_one() -> None:
    pairs = match_landmarks(round_descriptors(QUERY), [seen(3, NEAR), seen(7, QUERY)])
    assert (pairs.landmarks.tolist(), pairs.support.tolist()) == ([3], [1.0])
    assert pairs.similarities == pytest.approx([0.9], abs=0.005)


def test_photos_that_agree_outvote_a_better_ranked_one() -> None:
    # 1 against 1/2 + 1/3 + 1/4
    others = [seen(7, NEAR), seen(7, NEAR), seen(7, QUERY)]
    pairs = match_landmarks(round_descriptors(QUERY), [seen(3, QUERY), *others])
    assert pairs.landmarks.tolist() == [7]
    assert pairs.support == pytest.approx([13 / 12])
    assert pairs.similarities == pytest.approx([1.0])


@pytest.fixture
def photos() -> list[tuple[NDArray[np.int64], EightBitRows]]:
    """Five photos that see noisy copies of QUERIES; two keypoints share each landmark."""
    rng = np.random.default_rng(2)
    images = []
    for _ in range(5):
        rows = rng.permutation(200)[:120]
        noisy = QUERIES[rows] + 0.2 * rng.normal(size=(120, 16)).astype(np.float32)
        noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
        images.append((rows // 2, round_descriptors(noisy)))
    return images


QUERIES = unit_rows(np.random.default_rng(1), 200)


def test_each_keypoint_and_each_landmark_is_used_once(
    photos: list[tuple[NDArray[np.int64], EightBitRows]],
) -> None:
    pairs = match_landmarks(round_descriptors(QUERIES), photos)
    assert len(set(pairs.keypoints.tolist())) == len(pairs)
    assert len(set(pairs.landmarks.tolist())) == len(pairs)
    assert (pairs.landmarks == pairs.keypoints // 2).mean() > 0.95


@pytest.mark.parametrize("num", [0, 1, 40, 400])
def test_pairs_are_taken_best_first_as_long_as_both_sides_are_free(num: int) -> None:
    rng = np.random.default_rng(num)
    keypoints, landmarks, ranks = (rng.integers(0, most, num) for most in (30, 25, 20))
    votes, similarities = 1.0 / (ranks + 1), rng.choice([0.5, 0.6, 0.7], num).astype(np.float32)

    support: dict[tuple[int, int], float] = defaultdict(float)
    alike: dict[tuple[int, int], float] = defaultdict(float)
    for keypoint, landmark, vote, similarity in zip(
        keypoints.tolist(), landmarks.tolist(), votes.tolist(), similarities.tolist(), strict=True
    ):
        support[keypoint, landmark] += vote
        alike[keypoint, landmark] = max(alike[keypoint, landmark], similarity)
    expected: list[tuple[int, int]] = []
    for pair in sorted(support, key=lambda each: (-support[each], -alike[each], each)):
        if all(pair[0] != taken[0] and pair[1] != taken[1] for taken in expected):
            expected.append(pair)

    found = settled(keypoints, landmarks, votes, similarities)
    pairs = list(zip(found.keypoints.tolist(), found.landmarks.tolist(), strict=True))
    assert pairs == expected
    assert found.support == pytest.approx([support[pair] for pair in expected])
    assert found.similarities.tolist() == [alike[pair] for pair in expected]


def test_the_number_of_threads_changes_nothing(
    photos: list[tuple[NDArray[np.int64], EightBitRows]],
) -> None:
    before, found = torch.get_num_threads(), []
    try:
        for num_threads in (1, 2, 3):
            torch.set_num_threads(num_threads)
            found.append(match_landmarks(round_descriptors(QUERIES), photos))
            assert torch.get_num_threads() == num_threads
    finally:
        torch.set_num_threads(before)
    for pairs in found[1:]:
        assert np.array_equal(pairs.keypoints, found[0].keypoints)
        assert np.array_equal(pairs.landmarks, found[0].landmarks)
        assert np.array_equal(pairs.support, found[0].support)
        assert np.array_equal(pairs.similarities, found[0].similarities)


def test_no_photos_give_no_pairs() -> None:
    assert len(match_landmarks(round_descriptors(np.ones((3, 4), np.float32)), [])) == 0


def test_the_photos_with_most_pairs_are_matched_again() -> None:
    # of five photos, the second, third and fourth have two pairs each, the others one
    one, two = (round_descriptors(QUERIES[:n]) for n in (1, 2))
    photos = [(np.arange(len(rows)), rows) for rows in (one, two, two, two, one)]
    asked: list[int] = []

    def rematch(photo: int) -> Pairs:
        asked.append(photo)
        return np.array([5]), np.array([9 + photo]), np.array([0.5], np.float32)

    pairs = match_landmarks(round_descriptors(QUERIES[:6]), photos, rematch=rematch)
    assert sorted(asked) == [1, 2, 3]
    # what was found before in those photos does not count any more; of three for one keypoint the
    # best ranked photo's wins
    found = list(zip(pairs.keypoints.tolist(), pairs.landmarks.tolist(), strict=True))
    assert found == [(0, 0), (5, 10)]
    assert pairs.support == pytest.approx([1 + 1 / 5, 1 / 2])


def test_ambiguous_pairs_do_not_vote() -> None:
    double = round_descriptors(np.concatenate([QUERY, QUERY]))
    photos = [(np.array([3, 4]), double), (np.array([7]), round_descriptors(NEAR))]
    assert match_landmarks(round_descriptors(QUERY), photos).landmarks.tolist() == [3]
    assert match_landmarks(round_descriptors(QUERY), photos, 0.9).landmarks.tolist() == [7]
