from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from visloc.features.descriptors import vlad


def unit_rows(seed: int, n: int, d: int) -> NDArray[np.float32]:
    rows = np.random.default_rng(seed).normal(size=(n, d))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return rows.astype(np.float32)


def test_aggregate_of_an_example_done_by_hand() -> None:
    centres = np.array([[0, 0], [10, 0], [0, 10]], np.float32)
    words = np.array([[1, 0], [0, 1], [10, 2], [10, -1]], np.float32)
    # Differences: (1, 0) + (0, 1) at the first centre, (0, 2) + (0, -1) at the second, none at
    # the third. Each sum to unit length, then the whole: two blocks share the length equally.
    expected = np.array([0.5, 0.5, 0, np.sqrt(0.5), 0, 0])
    assert_allclose(vlad.aggregate(words, centres), expected, atol=1e-7)


def test_the_size_of_a_block_does_not_matter_after_intra_normalization() -> None:
    centres = np.array([[0, 0], [10, 0]], np.float32)
    words = np.array([[0, 1], [10, 1]], np.float32)
    repeated = np.concatenate([words, np.repeat(words[:1], 50, axis=0)])
    assert_allclose(
        vlad.aggregate(repeated, centres), vlad.aggregate(words, centres), atol=1e-6, rtol=0
    )


@given(st.integers(0, 1000), st.integers(1, 40))
@settings(max_examples=30, deadline=None)
def test_the_order_of_words_does_not_matter(seed: int, n: int) -> None:
    words, centres = unit_rows(seed, n, 8), unit_rows(seed + 1, 5, 8)
    shuffled = np.random.default_rng(seed).permutation(words)
    assert_allclose(
        vlad.aggregate(shuffled, centres), vlad.aggregate(words, centres), atol=1e-5, rtol=0
    )


@given(st.integers(0, 1000), st.integers(1, 40))
@settings(max_examples=30, deadline=None)
def test_aggregates_have_unit_length(seed: int, n: int) -> None:
    vector = vlad.aggregate(unit_rows(seed, n, 8), unit_rows(seed + 1, 5, 8))
    assert vector.shape == (40,)
    assert vector.dtype == np.float32
    assert np.linalg.norm(vector) == pytest.approx(1.0, abs=1e-6)


def test_no_words_give_the_zero_vector() -> None:
    assert_array_equal(
        vlad.aggregate(np.zeros((0, 8), np.float32), unit_rows(0, 5, 8)), np.zeros(40)
    )


def test_no_vocabulary_gives_an_empty_vector() -> None:
    assert vlad.aggregate(unit_rows(0, 5, 8), np.zeros((0, 8), np.float32)).shape == (0,)


def test_words_right_at_their_centres_give_zero_not_amplified_rounding() -> None:
    centres = unit_rows(0, 5, 8)
    words = np.repeat(centres, 7, axis=0)
    assert_array_equal(vlad.aggregate(words, centres), np.zeros(40))


def test_learn_words_finds_separated_clusters() -> None:
    truth = np.array([[0, 0], [100, 50]], np.float32)
    words = np.repeat(truth, 40, axis=0)
    words += np.random.default_rng(0).normal(size=words.shape).astype(np.float32)
    centres = vlad.learn_words(words, 2, seed=0)
    assert_allclose(centres[np.argsort(centres[:, 0])], truth, atol=1.0)


def test_learn_words_ends_where_every_centre_is_the_mean_of_its_words() -> None:
    words = unit_rows(0, 200, 2)
    centres = vlad.learn_words(words, 4, seed=1)
    nearest = np.linalg.norm(words[:, None] - centres, axis=2).argmin(axis=1)
    means = np.stack([words[nearest == k].mean(axis=0) for k in range(4)])
    assert_allclose(centres, means, atol=1e-5)


def test_learn_words_repeats_for_a_seed_and_differs_between_seeds() -> None:
    words = unit_rows(0, 500, 8)
    first = vlad.learn_words(words, 16, seed=3)
    assert_array_equal(first, vlad.learn_words(words, 16, seed=3))
    assert not np.array_equal(first, vlad.learn_words(words, 16, seed=4))


def test_learn_words_takes_fewer_centres_from_fewer_words() -> None:
    words = unit_rows(0, 3, 8)
    assert_allclose(vlad.learn_words(words, 128, seed=0), words, atol=1e-6)
    assert vlad.learn_words(words[:0], 128, seed=0).shape == (0, 8)


def test_learn_words_survives_identical_words() -> None:
    centres = vlad.learn_words(np.ones((50, 4), np.float32), 8, seed=0)
    assert_allclose(centres, np.ones((8, 4)))


def test_learn_words_samples_when_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vlad, "KMEANS_MAX_WORDS", 100)
    words = unit_rows(0, 1000, 8)
    centres = vlad.learn_words(words, 16, seed=0)
    assert centres.shape == (16, 8)
    assert_array_equal(centres, vlad.learn_words(words, 16, seed=0))
