"""Features of a photo that several maps are asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from visloc.features import make_local_features
from visloc.localization.query.feature_cache import FeatureCache, find_features
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo


def test_a_masked_photo_has_the_same_features_whichever_map_asked_before() -> None:
    blocks = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    photo = Photo(np.kron(blocks, np.ones((8, 8, 1), np.uint8)), 1, None)
    left_half = np.zeros((240, 320), dtype=bool)
    left_half[:, :160] = True
    masked = replace(photo, mask=left_half)
    extractor = make_local_features("xfeat", threads=1)
    cache: FeatureCache = {}
    options = LocalizeOptions()
    many, _ = find_features(masked, extractor, 400, options, cache)
    few, _ = find_features(masked, extractor, 100, options, cache)
    alone, _ = find_features(masked, extractor, 100, options)
    assert 0 < len(alone.keypoints) < 100 < len(many.keypoints)
    assert (many.keypoints[:, 0] < 160).all()
    np.testing.assert_array_equal(few.keypoints, alone.keypoints)
    np.testing.assert_array_equal(few.descriptors, alone.descriptors)
