from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from visloc.features.descriptors import whitening


def unit_rows(seed: int, n: int, d: int) -> NDArray[np.float32]:
    rows = np.random.default_rng(seed).normal(size=(n, d))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return rows.astype(np.float32)


def test_full_whitening_makes_projections_uncorrelated_and_of_equal_variance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(whitening, "WHITENING_EXPONENT", 1.0)
    pooled = unit_rows(0, 50, 10) * np.linspace(1, 5, 10, dtype=np.float32)
    mean, axes = whitening.learn_whitening(pooled)
    projected = (pooled - mean) @ axes
    assert_allclose(projected.T @ projected / 50, np.eye(10), atol=1e-4)


def test_partial_whitening_decorrelates_and_raises_variances_to_the_rest_of_the_exponent() -> None:
    pooled = unit_rows(0, 50, 10) * np.linspace(1, 5, 10, dtype=np.float32)
    mean, axes = whitening.learn_whitening(pooled)
    projected = (pooled - mean) @ axes
    covariance = np.cov(pooled.T, bias=True)
    variances = np.linalg.eigvalsh(covariance)[::-1]
    expected = np.diag(variances ** (1.0 - whitening.WHITENING_EXPONENT))
    assert_allclose(projected.T @ projected / 50, expected, atol=1e-4)


@pytest.mark.parametrize("n", [2, 3, 10])
def test_whitening_has_at_most_one_axis_less_than_photos(n: int) -> None:
    mean, axes = whitening.learn_whitening(unit_rows(0, n, 64))
    assert mean.shape == (64,)
    assert axes.shape == (64, n - 1)


def test_whitening_keeps_at_most_the_greatest_dims(monkeypatch: pytest.MonkeyPatch) -> None:
    pooled = unit_rows(0, 20, 64)
    all_axes = whitening.learn_whitening(pooled)[1]
    monkeypatch.setattr(whitening, "WHITENING_MAX_DIMS", 7)
    assert_array_equal(whitening.learn_whitening(pooled)[1], all_axes[:, :7])


def test_whitening_learns_from_evenly_spaced_photos_of_a_large_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(whitening, "WHITENING_MAX_PHOTOS", 5)
    pooled = unit_rows(0, 9, 16)
    expected = pooled[[0, 2, 4, 6, 8]].mean(axis=0)
    assert_allclose(whitening.learn_whitening(pooled)[0], expected, atol=1e-7)


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_photos_that_do_not_differ_are_alike_after_whitening(n: int) -> None:
    pooled = np.repeat(unit_rows(0, 1, 64), n, axis=0)
    mean, axes = whitening.learn_whitening(pooled)
    assert_allclose(whitening.whiten(pooled, mean, axes), np.ones((n, 1)))


def test_duplicates_among_photos_add_no_axis() -> None:
    pooled = unit_rows(0, 4, 64)
    axes = whitening.learn_whitening(np.concatenate([pooled, pooled, pooled]))[1]
    assert axes.shape == (64, 3)
    assert np.isfinite(axes).all()
    # Nothing is blown up by a tiny variance: the longest axis stays of the order of one.
    assert np.linalg.norm(axes, axis=0).max() < 10


def test_nearly_equal_photos_do_not_blow_up() -> None:
    noise = 1e-6 * np.random.default_rng(0).normal(size=(4, 64)).astype(np.float32)
    mean, axes = whitening.learn_whitening(np.repeat(unit_rows(0, 1, 64), 4, axis=0) + noise)
    assert np.isfinite(mean).all()
    assert np.isfinite(axes).all()
    assert np.linalg.norm(axes, axis=0).max() < 10


def test_blank_photos_teach_nothing_and_stay_zero() -> None:
    pooled = unit_rows(0, 5, 64)
    with_blank = np.concatenate([pooled[:2], np.zeros((3, 64), np.float32), pooled[2:]])
    mean, axes = whitening.learn_whitening(with_blank)
    expected_mean, expected_axes = whitening.learn_whitening(pooled)
    assert_array_equal(mean, expected_mean)
    assert_array_equal(axes, expected_axes)
    rows = whitening.whiten(with_blank, mean, axes)
    assert_array_equal(rows[2:5], np.zeros((3, 4)))
    assert_allclose(np.linalg.norm(rows[[0, 1, 5, 6, 7]], axis=1), np.ones(5), atol=1e-6)


def test_a_map_of_blank_photos_projects_everything_to_zero() -> None:
    mean, axes = whitening.learn_whitening(np.zeros((3, 64), np.float32))
    assert_array_equal(whitening.whiten(unit_rows(0, 2, 64), mean, axes), np.zeros((2, 1)))


def test_a_map_without_any_word_still_has_a_projection() -> None:
    mean, axes = whitening.learn_whitening(np.zeros((3, 0), np.float32))
    assert_array_equal(whitening.whiten(np.zeros((3, 0), np.float32), mean, axes), np.zeros((3, 1)))


def test_whiten_gives_the_same_for_one_vector_as_for_rows() -> None:
    pooled = unit_rows(0, 6, 64)
    mean, axes = whitening.learn_whitening(pooled)
    rows = whitening.whiten(pooled, mean, axes)
    assert rows.dtype == np.float32
    assert_allclose(whitening.whiten(pooled[2], mean, axes), rows[2], atol=1e-6)
    assert_array_equal(whitening.whiten(np.zeros(64, np.float32), mean, axes), np.zeros(5))


def test_whitening_is_the_same_every_time() -> None:
    pooled = unit_rows(0, 30, 256)
    for first, again in zip(
        whitening.learn_whitening(pooled), whitening.learn_whitening(pooled), strict=True
    ):
        assert_array_equal(first, again)
