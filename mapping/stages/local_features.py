"""Local features of the mapping photos: extracted here, or read from the dataset."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from mapping.cluster.executors import Executor
from mapping.cluster.workers import THIS_PROCESS
from mapping.progress import not_told
from mapping.stages.camera_mask import CameraMask, are_masked
from mapping.stages.networks import Networks, refuse_other_computing
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc.archive import FingerprintRecord
from visloc.errors import DatasetError, InvalidInput, Unavailable, refuse
from visloc.features.framing import Framing
from visloc.features.local.readymade import (
    MAX_READY_MADE_KEYPOINTS,
    is_ready_made,
    ready_made_fingerprint,
    ready_made_type,
    to_local_features,
)
from visloc.features.resolution import extract_features
from visloc.geometry import PixelOrigin
from visloc.kapture import FeatureSet, open_local_features, read_local
from visloc.photos.reading import turn_of
from visloc.types import Fingerprint, LocalFeatures

# Raised when the code of the stage changes what comes out.
_REVISION = 2
# Name of an array beside those of the local features of a photo.
_TURN = "turn"
# Where something is fixed to the picture, so many times the keypoints are found, and those of them
# that lie on it are dropped: it may have most of the strongest.
_TIMES_FOUND = 2
# Photos whose features a process keeps: a photo is a partner of several that are matched one after
# the other. 5000 keypoints with 128 numbers are 2.6 MB. Where photos may have many more, none are
# kept.
_KEPT, _MOST_KEYPOINTS_KEPT = 32, 10_000


@dataclass(frozen=True, slots=True)
class ExtractedFeatures:
    """Local features extracted from the photos, and kept in the work folder.

    The extractor's properties are stored here, so that a worker that only reads features need not
    load a network.

    Attributes:
        fixed: masks of what is fixed to the picture, by sensor; no keypoint is taken there.
    """

    work: WorkFolder
    name: str
    networks: Networks
    max_keypoints: int
    fingerprint: Fingerprint
    descriptor_dim: int
    computed_with: str
    fixed: Mapping[str, CameraMask] = field(default_factory=dict)

    def outside(self, fixed: Mapping[str, CameraMask]) -> ExtractedFeatures:
        """Return the source of as many features outside masks, by sensor."""
        return replace(self, fixed=fixed)

    def key(self, photo: MappingPhoto) -> str:
        fixed = self.fixed.get(photo.record.sensor_id)
        return key_of(
            "local_features",
            _REVISION,
            photo=photo.sha256,
            size=[photo.camera.width, photo.camera.height],
            fingerprint=FingerprintRecord.of(self.fingerprint).model_dump(),
            computed_with=self.computed_with,
            max_keypoints=self.max_keypoints,
            **({} if photo.mask_sha256 is None else {"mask": photo.mask_sha256}),
            **({} if photo.feature_size is None else {"feature_size": photo.feature_size}),
            **({} if fixed is None else {"fixed": [_TIMES_FOUND, fixed.tolist()]}),
        )

    def prepare(self, photo: MappingPhoto) -> None:
        if not self.work.has(self.key(photo)):
            self.read(photo)

    def read(self, photo: MappingPhoto) -> LocalFeatures:
        """Return the features of a photo; extract them if necessary."""
        item = self._get(photo)
        return LocalFeatures(**{name: item[name] for name in item if name != _TURN})

    def turn(self, photo: MappingPhoto) -> int:
        """EXIF orientation by which the photo was turned before extraction."""
        return int(self._get(photo)[_TURN])

    def _get(self, photo: MappingPhoto) -> Item:
        key = self.key(photo)
        if self.max_keypoints <= _MOST_KEYPOINTS_KEPT:
            with suppress(Unavailable):  # it was not computed yet, or is damaged
                return _recent(self.work, key)
        return self.work.get(key, partial(self._extract, photo))

    def _extract(self, photo: MappingPhoto) -> Item:
        extractor = self.networks.extractor(self.name)
        refuse_other_computing(self.name, self.computed_with, extractor.computed_with)
        pixels = photo.read()
        most, framing = self.max_keypoints, Framing(photo.feature_size)
        if photo.record.sensor_id in self.fixed:
            most *= _TIMES_FOUND
        local, _ = extract_features(pixels, extractor, max_keypoints=most, framing=framing)
        local = _outside(local, photo, self.fixed).strongest(self.max_keypoints)
        return asdict(local) | {_TURN: np.array(turn_of(pixels.exif_orientation))}


@lru_cache(maxsize=_KEPT)
def _recent(work: WorkFolder, key: str) -> Item:
    """Read a finished item, or return it if this process read it lately; it cannot be changed."""
    item = work.read(key)
    for array in item.values():
        array.flags.writeable = False
    return item


@dataclass(frozen=True, slots=True, eq=False)
class ReadyMadeFeatures:
    """Local features that come with the dataset, read where they lie.

    Attributes:
        origin: of the keypoints' coordinates.
        fixed: masks of what is fixed to the picture, by sensor; features there are dropped.
    """

    keypoints: FeatureSet
    descriptors: FeatureSet
    origin: PixelOrigin
    fixed: Mapping[str, CameraMask] = field(default_factory=dict)
    _keys: dict[str, str] = field(default_factory=dict, repr=False)

    @property
    def fingerprint(self) -> Fingerprint:
        return ready_made_fingerprint(self.descriptors)

    @property
    def descriptor_dim(self) -> int:
        return self.descriptors.dsize

    @property
    def computed_with(self) -> None:
        """Unknown, unlike for extracted features."""

    @property
    def max_keypoints(self) -> int:
        """Most keypoints that a photo may have; all of them are taken."""
        return MAX_READY_MADE_KEYPOINTS

    def outside(self, fixed: Mapping[str, CameraMask]) -> ReadyMadeFeatures:
        """Return the source of the features outside masks, by sensor."""
        return ReadyMadeFeatures(self.keypoints, self.descriptors, self.origin, fixed)

    def has(self, image_path: str) -> bool:
        return self.keypoints.has(image_path) and self.descriptors.has(image_path)

    def key(self, photo: MappingPhoto) -> str:
        """Hash of a photo's features."""
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
        """Return the features of a photo."""
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
        with errors_in(self.descriptors, photo):
            return _outside(to_local_features(*rows), photo, self.fixed)

    def turn(self, _photo: MappingPhoto) -> int:
        """Unknown; the photo is assumed to be as stored."""
        return 1


LocalFeaturesSource = ExtractedFeatures | ReadyMadeFeatures
"""Source of the local features of mapping photos; it is sent to workers.

``key`` identifies a photo's features in the keys of results that depend on them. ``prepare`` makes
reading them quick. ``outside`` leaves out what is fixed to the picture.
"""


def _outside(
    local: LocalFeatures, photo: MappingPhoto, fixed: Mapping[str, CameraMask]
) -> LocalFeatures:
    mask = fixed.get(photo.record.sensor_id)
    return local if mask is None else local.of(~are_masked(photo.camera, mask, local.keypoints))


def local_features_source(
    work: WorkFolder,
    dataset: Path,
    name: str,
    *,
    networks: Networks,
    max_keypoints: int,
    features_dir: Path | None,
    pixel_origin: PixelOrigin,
    workers: Executor = THIS_PROCESS,
) -> LocalFeaturesSource:
    """Return the source of local features that a name stands for.

    Args:
        name: an extractor, or ``kapture:TYPE`` for features that come with the dataset.
        max_keypoints: strongest ones kept per photo; of ready-made features all are taken.
        features_dir: folder of ready-made features, if not the dataset.
        pixel_origin: of the coordinates of ready-made keypoints.
        workers: where the extractor is opened, to learn its properties.
    """
    if is_ready_made(name):
        keypoints, descriptors = open_local_features(dataset, ready_made_type(name), features_dir)
        return ReadyMadeFeatures(keypoints, descriptors, pixel_origin)
    (extractor,) = workers.run_here(networks.properties, [name], not_told)
    return ExtractedFeatures(
        work,
        name,
        networks,
        max_keypoints,
        extractor.fingerprint,
        extractor.descriptor_dim,
        extractor.computed_with,
    )


@contextmanager
def errors_in(features: FeatureSet, photo: MappingPhoto) -> Iterator[None]:
    """Name the file in errors about its rows."""
    try:
        yield
    except InvalidInput as error:
        raise error.about(features.label(photo.name), DatasetError) from error
