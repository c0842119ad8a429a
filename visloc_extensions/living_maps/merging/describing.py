"""Global descriptors of the photos of several maps, of what the maps keep of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from visloc.archive import FingerprintRecord, GlobalFeatures, Map
from visloc.features import make_global_descriptor
from visloc.types import LocalFeatures

# Made of local features alone.
NAME = "localvlad"
# Photos that the vocabulary and the projection are learned from, evenly chosen, as by a build.
_VOCABULARY_PHOTOS, _PROJECTION_PHOTOS = 200, 2048
_PROJECTED_TOGETHER = 1024
_NO_PIXELS = np.empty((0, 0, 3), np.uint8)


def describe_together(maps: Sequence[Map]) -> GlobalFeatures:
    """Learn ``localvlad`` from what maps of the same local features keep; describe all photos.

    Returns:
        Rows for the photos of the first map, then of the next.
    """
    descriptor = make_global_descriptor(NAME)
    photos = [(opened, image) for opened in maps for image in range(len(opened.images))]
    words = [
        descriptor.training_words(_NO_PIXELS, _stored(*photos[row]), seed=0)
        for row in _evenly(len(photos), _VOCABULARY_PHOTOS)
    ]
    vocabulary = descriptor.learn_vocabulary(np.concatenate(words), seed=0)

    def pooled(rows: NDArray[np.int64]) -> NDArray[np.float32]:
        features = (_stored(*photos[row]) for row in rows)
        return np.stack([descriptor.pool(_NO_PIXELS, local, vocabulary) for local in features])

    taught_by = _evenly(len(photos), _PROJECTION_PHOTOS)
    model = {**vocabulary, **descriptor.learn_projection(pooled(taught_by))}
    blocks = [descriptor.project(pooled(rows), model) for rows in _blocks(len(photos))]
    record = FingerprintRecord.of(descriptor.fingerprint)
    return GlobalFeatures(record, np.concatenate(blocks), model)


def _stored(opened: Map, image: int) -> LocalFeatures:
    """Return a photo's features as the map keeps them, without scores and scales."""
    step = np.float32(opened.manifest.local_features.descriptor_scale)
    keypoints = opened.keypoints(image)
    unknown = np.zeros(len(keypoints), np.float32)
    descriptors = opened.observations(image)[1].astype(np.float32) * step
    return LocalFeatures(keypoints, descriptors, unknown, unknown)


def _evenly(num: int, count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, num - 1, min(num, count)).astype(np.int64))


def _blocks(num: int) -> Iterator[NDArray[np.int64]]:
    for start in range(0, num, _PROJECTED_TOGETHER):
        yield np.arange(start, min(start + _PROJECTED_TOGETHER, num))
