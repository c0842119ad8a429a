"""The feature stages of a build: local features, then each global descriptor."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapping.build.photos import MappingPhoto
from mapping.build.stages import Item, WorkFolder, key_of
from mapping.cli.progress import one_step
from mapping.cluster.executors import Executor
from visloc.archive import FingerprintRecord, GlobalFeatures, Map
from visloc.errors import DatasetError, InvalidInput, refuse
from visloc.features import (
    GlobalDescriptor,
    LocalFeatureExtractor,
    make_global_descriptor,
    make_local_features,
)
from visloc.features.local.readymade import (
    MAX_READY_MADE_KEYPOINTS,
    is_ready_made,
    ready_made_fingerprint,
    ready_made_type,
    to_global_descriptor,
    to_local_features,
)
from visloc.geometry import PixelOrigin
from visloc.images import turn_of, upright
from visloc.kapture import FeatureSet, open_local_features, read_local
from visloc.photo_features import extract_features
from visloc.types import Fingerprint, Inference, LocalFeatures

T = TypeVar("T")
Progress = Callable[[str, int, int], None]
"""Told the stage, how much of it is done, and how much there is."""

# Vocabulary and projection of a global descriptor are learned from at most this many photos,
# evenly chosen.
_VOCABULARY_PHOTOS, _PROJECTION_PHOTOS = 200, 2048
# Raw vectors of this many photos are projected at a time: 64 MB of DenseVLAD.
_PROJECTED_TOGETHER = 1024
# What a descriptor is given that does not need them.
_NO_PIXELS = np.empty((0, 0, 3), np.uint8)
_NO_FEATURES = LocalFeatures(
    keypoints=np.empty((0, 2), np.float32),
    descriptors=np.empty((0, 1), np.float32),
    scores=np.empty(0, np.float32),
    scales=np.empty(0, np.float32),
)
# Name of an array beside those of the local features of a photo.
_TURN = "turn"
# Raised when the code of a stage here changes what comes out.
_REVISION = {
    **{"local_features": 2, "words": 2, "vocabulary": 1, "pooled": 2, "projection": 1},
    **{"model": 1, "described": 2},
}


class LocalFeaturesSource(Protocol):
    """Where the local features of the mapping photos come from. It travels to workers."""

    @property
    def fingerprint(self) -> Fingerprint:
        """Of the feature."""

    @property
    def descriptor_dim(self) -> int:
        """Length of a descriptor."""

    @property
    def computed_with(self) -> str | None:
        """What computes it here; None for features that were computed elsewhere."""

    @property
    def max_keypoints(self) -> int:
        """Most keypoints that a photo has."""

    def key(self, photo: MappingPhoto) -> str:
        """Name of a photo's features in the keys of what is made of them."""

    def prepare(self, photo: MappingPhoto) -> None:
        """Have the features of a photo, so that reading them is quick from now on."""

    def read(self, photo: MappingPhoto) -> LocalFeatures:
        """Return the features of a photo, found now if need be."""

    def turn(self, photo: MappingPhoto) -> int:
        """EXIF orientation by which the photo was turned before its features were found."""


@dataclass(frozen=True, slots=True)
class ExtractedFeatures:
    """Local features found in the photos, kept in the work folder.

    What is known of the extractor travels along, so that a worker that only reads features need
    not load a network.

    Attributes:
        work: where they are kept.
        name: of the extractor, in ``visloc.features.LOCAL_FEATURES``.
        weights_dir: folder with network weights.
        inference: how networks are computed.
        max_keypoints: strongest ones kept per photo.
        fingerprint: of the extractor.
        descriptor_dim: length of a descriptor.
        computed_with: what computes it here.
    """

    work: WorkFolder
    name: str
    weights_dir: Path | None
    inference: Inference
    max_keypoints: int
    fingerprint: Fingerprint
    descriptor_dim: int
    computed_with: str

    def key(self, photo: MappingPhoto) -> str:
        """Name of a photo's features in the work folder."""
        return _key(
            "local_features",
            photo=photo.sha256,
            size=[photo.camera.width, photo.camera.height],
            fingerprint=_json(self.fingerprint),
            computed_with=self.computed_with,
            max_keypoints=self.max_keypoints,
        )

    def prepare(self, photo: MappingPhoto) -> None:
        """Find the features of a photo unless that is done."""
        if not self.work.has(self.key(photo)):
            self.read(photo)

    def read(self, photo: MappingPhoto) -> LocalFeatures:
        """Return the features of a photo, found now if need be.

        Raises:
            VislocError: what ``MappingPhoto.read`` raises.
        """
        item = self._get(photo)
        return LocalFeatures(**{name: item[name] for name in item if name != _TURN})

    def turn(self, photo: MappingPhoto) -> int:
        """EXIF orientation by which the photo was turned before its features were found."""
        return int(self._get(photo)[_TURN])

    def _get(self, photo: MappingPhoto) -> Item:
        return self.work.get(self.key(photo), partial(self._extract, photo))

    def _extract(self, photo: MappingPhoto) -> Item:
        extractor = open_extractor(self.name, self.weights_dir, self.inference)
        _refuse_other_computing(self.name, self.computed_with, extractor.computed_with)
        pixels = photo.read()
        local, _ = extract_features(pixels, extractor, max_keypoints=self.max_keypoints)
        return asdict(local) | {_TURN: np.array(turn_of(pixels.exif_orientation))}


@dataclass(frozen=True, slots=True, eq=False)
class ReadyMadeFeatures:
    """Local features that the dataset brings along, read where they lie.

    Attributes:
        keypoints: the files with keypoints.
        descriptors: the files with their descriptors.
        origin: what the keypoints count from.
    """

    keypoints: FeatureSet
    descriptors: FeatureSet
    origin: PixelOrigin
    _keys: dict[str, str] = field(default_factory=dict, repr=False)

    @property
    def fingerprint(self) -> Fingerprint:
        """Of the type of features."""
        return ready_made_fingerprint(self.descriptors)

    @property
    def descriptor_dim(self) -> int:
        """Length of a descriptor."""
        return self.descriptors.dsize

    @property
    def computed_with(self) -> None:
        """Unknown."""

    @property
    def max_keypoints(self) -> int:
        """Most keypoints that a photo may have; all of them are taken."""
        return MAX_READY_MADE_KEYPOINTS

    def has(self, image_path: str) -> bool:
        """Tell whether a photo has features."""
        return self.keypoints.has(image_path) and self.descriptors.has(image_path)

    def key(self, photo: MappingPhoto) -> str:
        """Name of a photo's features: what they are."""
        if photo.name not in self._keys:
            digest = hashlib.sha256()
            for array in asdict(self.read(photo)).values():
                digest.update(array.tobytes())
            self._keys[photo.name] = f"ready_made/{digest.hexdigest()[:32]}"
        return self._keys[photo.name]

    def prepare(self, photo: MappingPhoto) -> None:
        """Check the features of a photo."""
        self.read(photo)

    def read(self, photo: MappingPhoto) -> LocalFeatures:
        """Return the features of a photo.

        Raises:
            DatasetError: with the file that is wrong.
        """
        count = self.descriptors.count(photo.name)
        if count > MAX_READY_MADE_KEYPOINTS:
            raise refuse(
                "features.too_many",
                "the photo has too many keypoints",
                field=self.descriptors.label(photo.name),
                expected=f"at most {MAX_READY_MADE_KEYPOINTS}",
                got=count,
                kind=DatasetError,
            )
        size = (photo.camera.width, photo.camera.height)
        rows = read_local(self.keypoints, self.descriptors, photo.name, size, self.origin)
        with _errors_in(self.descriptors, photo):
            return to_local_features(*rows)

    def turn(self, _photo: MappingPhoto) -> int:
        """Unknown; they are taken as found in the pixels as stored."""
        return 1


@cache
def open_extractor(
    name: str, weights_dir: Path | None, inference: Inference
) -> LocalFeatureExtractor:
    """Return the extractor of this process; it uses one thread, as all executors have it.

    Raises:
        WeightsError, InvalidInput: what ``make_local_features`` raises.
    """
    return make_local_features(name, weights_dir, inference, threads=1)


@cache
def open_descriptor(name: str, weights_dir: Path | None, inference: Inference) -> GlobalDescriptor:
    """Return the global descriptor of this process; it uses one thread, as all executors have it.

    Raises:
        WeightsError, InvalidInput: what ``make_global_descriptor`` raises.
    """
    return make_global_descriptor(name, weights_dir, inference, threads=1)


def local_features_source(
    work: WorkFolder,
    dataset: Path,
    name: str,
    *,
    max_keypoints: int,
    weights_dir: Path | None,
    inference: Inference,
    features_dir: Path | None,
    pixel_origin: PixelOrigin,
) -> LocalFeaturesSource:
    """Return where the local features of a dataset's photos come from.

    Args:
        work: keeps those that are found here.
        dataset: kapture folder.
        name: of the extractor, or ``kapture:TYPE`` for features that the dataset brings along.
        max_keypoints: strongest ones kept per photo; of ready-made ones all are taken.
        weights_dir: folder with network weights.
        inference: how networks are computed.
        features_dir: where ready-made features lie, when not in the dataset.
        pixel_origin: what ready-made keypoints count from.

    Raises:
        WeightsError, InvalidInput, DatasetError: what opening them raises.
    """
    if is_ready_made(name):
        keypoints, descriptors = open_local_features(dataset, ready_made_type(name), features_dir)
        return ReadyMadeFeatures(keypoints, descriptors, pixel_origin)
    extractor = open_extractor(name, weights_dir, inference)
    return ExtractedFeatures(
        work,
        name,
        weights_dir,
        inference,
        max_keypoints,
        extractor.fingerprint,
        extractor.descriptor_dim,
        extractor.computed_with,
    )


def find_local_features(
    source: LocalFeaturesSource,
    photos: Sequence[MappingPhoto],
    workers: Executor,
    progress: Progress,
) -> None:
    """Have the features of all photos, so that reading them is quick from now on."""
    workers.run(source.prepare, photos, partial(progress, "local features"))


def describe_photos(
    work: WorkFolder,
    photos: Sequence[MappingPhoto],
    features: LocalFeaturesSource,
    name: str,
    weights_dir: Path | None,
    inference: Inference,
    workers: Executor,
    progress: Progress,
) -> GlobalFeatures:
    """Learn one global descriptor's model on the photos, and describe them with it.

    Raises:
        WeightsError, InvalidInput: what ``make_global_descriptor`` raises.
    """
    descriptor = open_descriptor(name, weights_dir, inference)
    task = _DescribeTask.of(work, features, name, weights_dir, inference)

    def read_all(entry: str, keys: Sequence[str]) -> list[NDArray[np.float32]]:
        return [work.read(key)[entry] for key in keys]

    vocabulary_key: str | None = None
    vocabulary: Item = {}
    if descriptor.needs_vocabulary:
        learned_from = _evenly(photos, _VOCABULARY_PHOTOS)
        workers.run(task.find_words, learned_from, partial(progress, f"{name} words"))
        word_keys = [task.words_key(photo) for photo in learned_from]
        vocabulary_key = _key("vocabulary", fingerprint=task.fingerprint, words=word_keys)
        with one_step(progress, f"{name} vocabulary"):
            vocabulary = work.get(
                vocabulary_key,
                lambda: descriptor.learn_vocabulary(
                    np.concatenate(read_all("words", word_keys)), seed=0
                ),
            )
    workers.run(partial(task.pool, vocabulary_key), photos, partial(progress, name))
    pooled_keys = [task.pooled_key(vocabulary_key, photo) for photo in photos]
    taught_by = _evenly(pooled_keys, _PROJECTION_PHOTOS)
    with one_step(progress, f"{name} projection"):
        projection = work.get(
            _key("projection", pooled=taught_by),
            lambda: descriptor.learn_projection(np.stack(read_all("pooled", taught_by))),
        )
        model = {**vocabulary, **projection}
        blocks = [
            descriptor.project(
                np.stack(read_all("pooled", pooled_keys[first : first + _PROJECTED_TOGETHER])),
                model,
            )
            for first in range(0, len(photos), _PROJECTED_TOGETHER)
        ]
    return GlobalFeatures(
        FingerprintRecord.of(descriptor.fingerprint), np.concatenate(blocks), model
    )


def describe_with_model(
    opened: Map,
    work: WorkFolder,
    photos: Sequence[MappingPhoto],
    features: LocalFeaturesSource,
    name: str,
    weights_dir: Path | None,
    inference: Inference,
    workers: Executor,
    progress: Progress,
) -> NDArray[np.float32]:
    """Describe photos (n, D) by a global descriptor of a map, with the model that it learned.

    Raises:
        WeightsError, InvalidInput: what ``make_global_descriptor`` raises.
    """
    task = _DescribeTask.of(work, features, name, weights_dir, inference)
    stem = FingerprintRecord.of(open_descriptor(name, weights_dir, inference).fingerprint).file_stem
    file = opened.manifest.files[f"global/{stem}.model.npz"]
    model_key = _key("model", fingerprint=task.fingerprint, sha256=file.sha256)
    work.get(model_key, lambda: opened.global_models[name])  # where workers find it
    workers.run(partial(task.describe, model_key), photos, partial(progress, name))
    return np.stack([work.read(task.described_key(model_key, p))["described"] for p in photos])


def _evenly(items: Sequence[T], count: int) -> list[T]:
    """Return at most ``count`` of the items, evenly chosen."""
    return [items[row] for row in np.unique(np.linspace(0, len(items) - 1, count).astype(int))]


def read_global_features(features: FeatureSet, photos: Sequence[MappingPhoto]) -> GlobalFeatures:
    """Take the global descriptors that the dataset brings along.

    Raises:
        DatasetError: with the file that is wrong or missing.
    """
    rows = []
    for photo in photos:
        with _errors_in(features, photo):
            rows.append(to_global_descriptor(features.read(photo.name)[0]))
    fingerprint = FingerprintRecord.of(ready_made_fingerprint(features))
    return GlobalFeatures(fingerprint, np.stack(rows), {})


@contextmanager
def _errors_in(features: FeatureSet, photo: MappingPhoto) -> Iterator[None]:
    """Name the file in what is wrong with rows that do not know where they are from."""
    try:
        yield
    except InvalidInput as error:
        raise error.about(features.label(photo.name), DatasetError) from error


@dataclass(frozen=True, slots=True)
class _DescribeTask:
    """What workers do for one global descriptor.

    What is known of it travels along, so that who only wants keys need not load a network.
    """

    work: WorkFolder
    features: LocalFeaturesSource
    name: str
    weights_dir: Path | None
    inference: Inference
    fingerprint: Mapping[str, object]
    computed_with: str | None
    needs_image: bool
    needs_local_features: bool

    @staticmethod
    def of(
        work: WorkFolder,
        features: LocalFeaturesSource,
        name: str,
        weights_dir: Path | None,
        inference: Inference,
    ) -> _DescribeTask:
        descriptor = open_descriptor(name, weights_dir, inference)
        return _DescribeTask(
            work,
            features,
            name,
            weights_dir,
            inference,
            _json(descriptor.fingerprint),
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
        descriptor = open_descriptor(self.name, self.weights_dir, self.inference)
        _refuse_other_computing(self.name, self.computed_with, descriptor.computed_with)
        return descriptor

    def _inputs(self, photo: MappingPhoto) -> Mapping[str, object]:
        return {
            "fingerprint": self.fingerprint,
            "computed_with": self.computed_with,
            "photo": photo.sha256 if self.needs_image else None,
            "size": [photo.camera.width, photo.camera.height] if self.needs_image else None,
            "local": self.features.key(photo) if self.needs_local_features else None,
        }

    def _read(self, photo: MappingPhoto) -> tuple[NDArray[np.uint8], LocalFeatures]:
        rgb = _upright_pixels(photo) if self.needs_image else _NO_PIXELS
        return rgb, self.features.read(photo) if self.needs_local_features else _NO_FEATURES


def _upright_pixels(photo: MappingPhoto) -> NDArray[np.uint8]:
    pixels = photo.read()
    return upright(pixels.rgb, turn_of(pixels.exif_orientation))


def _refuse_other_computing(name: str, expected: str | None, here: str | None) -> None:
    """Refuse what would not be what the command itself computes, whose name all items have."""
    if here != expected:
        raise refuse(
            "build.other_computing", field="--inference", expected=expected, got=here, name=name
        )


@cache
def _learned(work: WorkFolder, key: str) -> Item:
    return work.read(key)


def _key(stage: str, **inputs: object) -> str:
    return key_of(stage, _REVISION[stage], **inputs)


def _json(fingerprint: Fingerprint) -> Mapping[str, object]:
    return FingerprintRecord.of(fingerprint).model_dump()
