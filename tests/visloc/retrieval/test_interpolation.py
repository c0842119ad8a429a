from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from visloc.retrieval.interpolation import (
    MOST_EXTRAPOLATED,
    WEIGHTINGS,
    barycentric,
    cosine_similarity,
    joined,
)
from visloc.types import CoarseMethod


def unit(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(rows / np.linalg.norm(rows, axis=-1, keepdims=True))


def some(seed: int, num: int = 5, dim: int = 40) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    random = np.random.default_rng(seed)
    return unit(random.normal(size=dim)), unit(random.normal(size=(num, dim)))


@pytest.mark.parametrize("method", CoarseMethod)
@pytest.mark.parametrize("num", [1, 2, 20, 60])
def test_weights_sum_to_one(method: CoarseMethod, num: int) -> None:
    weights = WEIGHTINGS[method](*some(0, num))
    assert weights.shape == (num,)
    assert weights.sum() == pytest.approx(1.0)


def test_equal_weights_are_one_over_k() -> None:
    np.testing.assert_array_equal(WEIGHTINGS[CoarseMethod.EWB](*some(0, 4)), np.full(4, 0.25))


@pytest.mark.parametrize("seed", range(5))
def test_barycentric_weights_are_those_of_a_search(seed: int) -> None:
    query, photos = some(seed)

    found = minimize(
        lambda w: float(np.sum((w @ photos - query) ** 2)),
        np.full(5, 0.2),
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
        options={"ftol": 1e-14},
    )

    np.testing.assert_allclose(barycentric(query, photos), found.x, atol=1e-6)


def test_photos_that_are_almost_the_same_get_no_huge_weights() -> None:
    query, photos = some(2)
    photos[1] = photos[0] + 1e-6 * np.linspace(-1, 1, photos.shape[1])
    weights = barycentric(query, photos)
    assert weights.sum() == pytest.approx(1.0)
    assert np.abs(weights - 1 / len(photos)).sum() == pytest.approx(MOST_EXTRAPOLATED)


def test_a_query_made_of_photos_gets_their_weights() -> None:
    _, photos = some(1)
    weights = np.array([0.5, -0.3, 0.4, 0.1, 0.3])
    np.testing.assert_allclose(barycentric(weights @ photos, photos), weights, atol=1e-12)


def test_photos_that_are_the_same_share_their_weight() -> None:
    _, photos = some(1, 2)
    found = barycentric(photos[0], photos[[0, 0, 1]])
    np.testing.assert_allclose(found, [0.5, 0.5, 0.0], atol=1e-12)


def test_similarity_counts_with_its_eighth_power() -> None:
    query = np.array([1.0, 0.0])
    photos = np.array([[0.8, 0.6], [0.6, 0.8], [-0.8, 0.6]])

    expected = np.array([0.8**8, 0.6**8, 0.0]) / (0.8**8 + 0.6**8)
    np.testing.assert_allclose(cosine_similarity(query, photos), expected, atol=1e-15)
    np.testing.assert_array_equal(cosine_similarity(query, -np.array([query, query])), [0.5, 0.5])


def test_the_cosine_of_joined_descriptors_is_their_weighted_mean() -> None:
    a, rows_a = some(0)
    b, rows_b = some(1, dim=7)

    vector = joined({"a": a, "b": b}, {"a": 3.0, "b": 1.0})
    rows = joined({"a": rows_a, "b": rows_b}, {"a": 3.0, "b": 1.0})

    np.testing.assert_allclose(rows @ vector, 0.75 * rows_a @ a + 0.25 * rows_b @ b, atol=1e-15)
    assert np.linalg.norm(joined({"a": a, "b": b}, None)) == pytest.approx(1.0)
