"""The feature stages of a build: local features, then each global descriptor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapping.photos import MappingPhoto
from mapping.stages import Item, WorkFolder, key_of
from visloc.archive import FingerprintRecord, GlobalFeatures
from visloc.errors import DatasetError
from visloc.features import GlobalDescriptor, LocalFeatureExtractor
from visloc.images import read_photo_file
from visloc.types import Fingerprint, LocalFeatures

Progress = Callable[[str, int, int], None]
"""Told the stage, how much of it is done, and how much there is."""

# The vocabulary of a global descriptor is learned from at most this many photos, evenly chosen.
_VOCABULARY_PHOTOS = 200
# Raised when the code of a stage here changes what comes out.
_REVISION = {"local_features": 1, "words": 1, "vocabulary": 1, "pooled": 1, "projection": 1}


@dataclass(frozen=True, slots=True)
class LocalFeaturesStage:
    """Local features of mapping photos, kept in the work folder.

    Attributes:
        work: where they are kept.
        extractor: what finds them.
        max_keypoints: strongest ones kept per photo.
    """

    work: WorkFolder
    extractor: LocalFeatureExtractor
    max_keypoints: int

    def key(self, photo: MappingPhoto) -> str:
        """Name of a photo's features in the work folder."""
        return _key(
            "local_features",
            photo=photo.sha256,
            size=[photo.camera.width, photo.camera.height],
            fingerprint=_json(self.extractor.fingerprint),
            max_keypoints=self.max_keypoints,
        )

    def compute(self, photo: MappingPhoto) -> None:
        """Find the features of a photo unless that is done."""
        if not self.work.has(self.key(photo)):
            self.read(photo)

    def read(self, photo: MappingPhoto) -> LocalFeatures:
        """Return the features of a photo, found now if need be."""
        return LocalFeatures(**self.work.get(self.key(photo), partial(self._extract, photo)))

    def _extract(self, photo: MappingPhoto) -> Item:
        pixels = read_photo_file(photo.path)
        if (pixels.width, pixels.height) != (photo.camera.width, photo.camera.height):
            raise DatasetError(
                "dataset.photo_size",
                "the photo is not of the size of its camera",
                field=str(photo.path),
                expected=f"{photo.camera.width} x {photo.camera.height} as sensors.txt has "
                f"it for {photo.record.sensor_id}",
                got=f"{pixels.width} x {pixels.height}",
            )
        return asdict(self.extractor.extract(pixels.rgb, max_keypoints=self.max_keypoints))


def describe_photos(
    work: WorkFolder,
    photos: Sequence[MappingPhoto],
    features: LocalFeaturesStage,
    descriptor: GlobalDescriptor,
    progress: Progress,
) -> GlobalFeatures:
    """Learn one global descriptor's model on the photos, and describe them with it."""
    name = descriptor.fingerprint.name
    fingerprint = _json(descriptor.fingerprint)

    def training_words(photo: MappingPhoto) -> Item:
        rgb = read_photo_file(photo.path).rgb
        return {"words": descriptor.training_words(rgb, features.read(photo), seed=0)}

    def pool(photo: MappingPhoto) -> Item:
        rgb = read_photo_file(photo.path).rgb
        return {"pooled": descriptor.pool(rgb, features.read(photo), vocabulary)}

    def read_all(entry: str, keys: list[str]) -> list[NDArray[np.float32]]:
        return [work.read(key)[entry] for key in keys]

    chosen = np.unique(np.linspace(0, len(photos) - 1, _VOCABULARY_PHOTOS).astype(int)).tolist()
    word_keys = []
    for done, row in enumerate(chosen, 1):
        photo = photos[row]
        word_keys.append(_key("words", fingerprint=fingerprint, local=features.key(photo)))
        work.get(word_keys[-1], partial(training_words, photo))
        progress(f"{name} words", done, len(chosen))

    vocabulary_key = _key("vocabulary", fingerprint=fingerprint, words=word_keys)
    vocabulary = work.get(
        vocabulary_key,
        lambda: descriptor.learn_vocabulary(np.concatenate(read_all("words", word_keys)), seed=0),
    )
    pooled_keys = []
    for done, photo in enumerate(photos, 1):
        pooled_keys.append(_key("pooled", vocabulary=vocabulary_key, local=features.key(photo)))
        work.get(pooled_keys[-1], partial(pool, photo))
        progress(name, done, len(photos))

    pooled = np.stack(read_all("pooled", pooled_keys))
    projection = work.get(
        _key("projection", pooled=pooled_keys), lambda: descriptor.learn_projection(pooled)
    )
    model = {**vocabulary, **projection}
    return GlobalFeatures(
        FingerprintRecord.of(descriptor.fingerprint), descriptor.project(pooled, model), model
    )


def _key(stage: str, **inputs: object) -> str:
    return key_of(stage, _REVISION[stage], **inputs)


def _json(fingerprint: Fingerprint) -> Mapping[str, object]:
    return FingerprintRecord.of(fingerprint).model_dump()
