"""The stages of a global descriptor: learn its model on the photos, then describe them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mapping.progress import one_step
from mapping.stages.context import BuildContext
from mapping.stages.local_features import LocalFeaturesSource, errors_in
from mapping.stages.networks import Networks, refuse_other_computing
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc.archive import FingerprintRecord, GlobalFeatures, Map
from visloc.features import GlobalDescriptor
from visloc.features.local.readymade import (
    ready_made_fingerprint,
    ready_made_type,
    to_global_descriptor,
)
from visloc.features.resolution import resized
from visloc.kapture import Dataset, open_features
from visloc.photos.reading import turn_of, upright
from visloc.types import LocalFeatures

T = TypeVar("T")

# Vocabulary and projection of a global descriptor are learned from at most this many photos,
# evenly chosen.
_VOCABULARY_PHOTOS, _PROJECTION_PHOTOS = 200, 2048
# Raw vectors of this many photos are projected at a time: 64 MB of DenseVLAD.
_PROJECTED_TOGETHER = 1024
# Stand in for the inputs that a descriptor does not need.
_NO_PIXELS = np.empty((0, 0, 3), np.uint8)
_NO_FEATURES = LocalFeatures(
    keypoints=np.empty((0, 2), np.float32),
    descriptors=np.empty((0, 1), np.float32),
    scores=np.empty(0, np.float32),
    scales=np.empty(0, np.float32),
)
# Raised when the code of a stage here changes what comes out.
_REVISION = {
    **{"words": 2, "vocabulary": 1, "pooled": 2, "projection": 1},
    **{"model": 1, "described": 2},
}


def describe_photos(
    context: BuildContext, photos: Sequence[MappingPhoto], name: str
) -> GlobalFeatures:
    """Learn a global descriptor's model on the photos, and describe them with it."""
    work, descriptor = context.work, context.networks.descriptor(name)
    task = DescribeTask.of(context, name)
    vocabulary_key: str | None = None
    vocabulary: Item = {}
    if descriptor.needs_vocabulary:
        vocabulary_key, vocabulary = _learn_vocabulary(context, photos, task)
    context.run(name, partial(task.pool, vocabulary_key), photos)
    pooled_keys = [task.pooled_key(vocabulary_key, photo) for photo in photos]
    learned_from = _evenly(pooled_keys, _PROJECTION_PHOTOS)
    with one_step(context.progress, f"{name} projection"):
        projection = work.get(
            _key("projection", pooled=learned_from),
            lambda: descriptor.learn_projection(np.stack(_read_all(work, learned_from, "pooled"))),
        )
        model = {**vocabulary, **projection}
        blocks = [
            descriptor.project(
                np.stack(_read_all(work, pooled_keys[at : at + _PROJECTED_TOGETHER], "pooled")),
                model,
            )
            for at in range(0, len(photos), _PROJECTED_TOGETHER)
        ]
    return GlobalFeatures(
        FingerprintRecord.of(descriptor.fingerprint), np.concatenate(blocks), model
    )


def _learn_vocabulary(
    context: BuildContext, photos: Sequence[MappingPhoto], task: DescribeTask
) -> tuple[str, Item]:
    learned_from = _evenly(photos, _VOCABULARY_PHOTOS)
    context.run(f"{task.name} words", task.find_words, learned_from)
    word_keys = [task.words_key(photo) for photo in learned_from]
    key = _key("vocabulary", fingerprint=task.fingerprint, words=word_keys)

    def learn() -> Item:
        words = np.concatenate(_read_all(context.work, word_keys, "words"))
        return context.networks.descriptor(task.name).learn_vocabulary(words, seed=0)

    with one_step(context.progress, f"{task.name} vocabulary"):
        return key, context.work.get(key, learn)


def describe_with_model(
    context: BuildContext, opened: Map, photos: Sequence[MappingPhoto], name: str
) -> NDArray[np.float32]:
    """Describe photos (n, D) by a global descriptor of a map, with the model that it learned."""
    task = DescribeTask.of(context, name)
    stem = FingerprintRecord.of(context.networks.descriptor(name).fingerprint).file_stem
    file = opened.manifest.files[f"global/{stem}.model.npz"]
    model_key = _key("model", fingerprint=task.fingerprint, sha256=file.sha256)
    context.work.get(model_key, lambda: opened.global_models[name])  # where workers find it
    context.run(name, partial(task.describe, model_key), photos)
    keys = [task.described_key(model_key, photo) for photo in photos]
    return np.stack(_read_all(context.work, keys, "described"))


def read_global_features(
    dataset: Dataset, name: str, features_dir: Path | None, photos: Sequence[MappingPhoto]
) -> GlobalFeatures:
    """Read the global descriptors ``kapture:TYPE`` that come with the dataset."""
    features = open_features(dataset.root, "global_features", ready_made_type(name), features_dir)
    rows = []
    for photo in photos:
        with errors_in(features, photo):
            rows.append(to_global_descriptor(features.read(photo.name)[0]))
    fingerprint = FingerprintRecord.of(ready_made_fingerprint(features))
    return GlobalFeatures(fingerprint, np.stack(rows), {})


@dataclass(frozen=True, slots=True)
class DescribeTask:
    """A worker's part in the stages of a global descriptor.

    The descriptor's properties are stored here, so that keys can be made without loading a network.
    """

    work: WorkFolder
    features: LocalFeaturesSource
    networks: Networks
    name: str
    fingerprint: Mapping[str, object]
    computed_with: str | None
    needs_image: bool
    needs_local_features: bool

    @staticmethod
    def of(context: BuildContext, name: str) -> DescribeTask:
        """Return the task for a descriptor of this name."""
        descriptor = context.networks.descriptor(name)
        return DescribeTask(
            context.work,
            context.features,
            context.networks,
            name,
            FingerprintRecord.of(descriptor.fingerprint).model_dump(),
            descriptor.computed_with,
            descriptor.needs_image,
            descriptor.needs_local_features,
        )

    def words_key(self, photo: MappingPhoto) -> str:
        return _key("words", **self._inputs(photo))

    def pooled_key(self, vocabulary_key: str | None, photo: MappingPhoto) -> str:
        return _key("pooled", vocabulary=vocabulary_key, **self._inputs(photo))

    def described_key(self, model_key: str, photo: MappingPhoto) -> str:
        return _key("described", model=model_key, **self._inputs(photo))

    def find_words(self, photo: MappingPhoto) -> None:
        def compute() -> Item:
            rgb, local = self._read(photo)
            return {"words": self._descriptor.training_words(rgb, local, seed=0)}

        self.work.get(self.words_key(photo), compute)

    def pool(self, vocabulary_key: str | None, photo: MappingPhoto) -> None:
        def compute() -> Item:
            vocabulary = {} if vocabulary_key is None else _learned(self.work, vocabulary_key)
            return {"pooled": self._descriptor.pool(*self._read(photo), vocabulary)}

        self.work.get(self.pooled_key(vocabulary_key, photo), compute)

    def describe(self, model_key: str, photo: MappingPhoto) -> None:
        def compute() -> Item:
            model = _learned(self.work, model_key)
            return {"described": self._descriptor.describe(*self._read(photo), model)}

        self.work.get(self.described_key(model_key, photo), compute)

    @property
    def _descriptor(self) -> GlobalDescriptor:
        descriptor = self.networks.descriptor(self.name)
        refuse_other_computing(self.name, self.computed_with, descriptor.computed_with)
        return descriptor

    def _inputs(self, photo: MappingPhoto) -> Mapping[str, object]:
        return {
            "fingerprint": self.fingerprint,
            "computed_with": self.computed_with,
            "photo": photo.sha256 if self.needs_image else None,
            "size": _described_size(photo) if self.needs_image else None,
            "local": self.features.key(photo) if self.needs_local_features else None,
        }

    def _read(self, photo: MappingPhoto) -> tuple[NDArray[np.uint8], LocalFeatures]:
        rgb = _upright_pixels(photo) if self.needs_image else _NO_PIXELS
        return rgb, self.features.read(photo) if self.needs_local_features else _NO_FEATURES


def _upright_pixels(photo: MappingPhoto) -> NDArray[np.uint8]:
    pixels = photo.read()
    return upright(resized(pixels.rgb, *_described_size(photo)), turn_of(pixels.exif_orientation))


def _described_size(photo: MappingPhoto) -> tuple[int, int]:
    return photo.feature_size or (photo.camera.width, photo.camera.height)


def _evenly(items: Sequence[T], count: int) -> list[T]:
    """Return at most ``count`` of the items, evenly chosen."""
    return [items[row] for row in np.unique(np.linspace(0, len(items) - 1, count).astype(int))]


def _read_all(work: WorkFolder, keys: Sequence[str], entry: str) -> list[NDArray[np.float32]]:
    return [work.read(key)[entry] for key in keys]


@cache
def _learned(work: WorkFolder, key: str) -> Item:
    return work.read(key)


def _key(stage: str, **inputs: object) -> str:
    return key_of(stage, _REVISION[stage], **inputs)
