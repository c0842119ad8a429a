from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from visloc.features.base import GlobalDescriptor
from visloc.features.descriptors.vlad import LocalVlad
from visloc.types import LocalFeatures

NO_PIXELS = np.zeros((1, 1, 3), np.uint8)


def features(seed: int, n: int, dim: int) -> LocalFeatures:
    random = np.random.default_rng(seed)
    descriptors = random.normal(size=(n, dim))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return LocalFeatures(
        keypoints=random.uniform(0, 100, (n, 2)).astype(np.float32),
        descriptors=descriptors.astype(np.float32),
        scores=np.ones(n, np.float32),
        scales=np.ones(n, np.float32),
    )


def test_satisfies_the_protocol() -> None:
    descriptor: GlobalDescriptor = LocalVlad()
    assert descriptor.fingerprint.name == "localvlad"
    assert descriptor.fingerprint == LocalVlad().fingerprint


@pytest.mark.parametrize("dim", [64, 128])
def test_a_photo_of_the_map_is_most_similar_to_itself(dim: int) -> None:
    localvlad = LocalVlad()
    photos = [features(seed, 1500, dim) for seed in range(6)]
    words = [localvlad.training_words(NO_PIXELS, photo, 0) for photo in photos]
    assert {sample.shape for sample in words} == {(1000, dim)}
    vocabulary = localvlad.learn_vocabulary(np.concatenate(words), 0)
    pooled = np.stack([localvlad.pool(NO_PIXELS, photo, vocabulary) for photo in photos])
    model = {**vocabulary, **localvlad.learn_projection(pooled)}
    rows = localvlad.project(pooled, model)
    seen_again = LocalFeatures(
        *(getattr(photos[3], name)[200:] for name in LocalFeatures.__slots__)
    )
    similarities = rows @ localvlad.describe(NO_PIXELS, seen_again, model)
    assert similarities.argmax() == 3
    assert similarities[3] > 0.8


def test_training_words_are_a_seeded_sample_of_the_descriptors() -> None:
    photo = features(0, 3000, 64)
    sample = LocalVlad().training_words(NO_PIXELS, photo, 7)
    assert {row.tobytes() for row in sample} <= {row.tobytes() for row in photo.descriptors}
    assert_array_equal(sample, LocalVlad().training_words(NO_PIXELS, photo, 7))
    assert not np.array_equal(sample, LocalVlad().training_words(NO_PIXELS, photo, 8))


def test_few_features_are_all_taken() -> None:
    photo = features(0, 5, 64)
    assert_array_equal(LocalVlad().training_words(NO_PIXELS, photo, 0), photo.descriptors)


def test_a_map_of_photos_without_features_has_a_model_and_gives_zero() -> None:
    localvlad = LocalVlad()
    empty = features(0, 0, 64)
    words = localvlad.training_words(NO_PIXELS, empty, 0)
    vocabulary = localvlad.learn_vocabulary(words, 0)
    pooled = np.stack([localvlad.pool(NO_PIXELS, empty, vocabulary)] * 2)
    model = {**vocabulary, **localvlad.learn_projection(pooled)}
    assert_array_equal(localvlad.describe(NO_PIXELS, empty, model), np.zeros(1))
    assert_array_equal(localvlad.describe(NO_PIXELS, features(1, 9, 64), model), np.zeros(1))


def test_a_photo_without_features_gets_the_zero_vector() -> None:
    localvlad = LocalVlad()
    photos = [features(seed, 300, 64) for seed in range(4)]
    vocabulary = localvlad.learn_vocabulary(np.concatenate([p.descriptors for p in photos]), 0)
    pooled = np.stack([localvlad.pool(NO_PIXELS, photo, vocabulary) for photo in photos])
    model = {**vocabulary, **localvlad.learn_projection(pooled)}
    assert_array_equal(localvlad.describe(NO_PIXELS, features(0, 0, 64), model), np.zeros(3))
