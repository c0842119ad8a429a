"""Localizing the photos of a new capture in the map that they join."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.methods.matching.stages import camera_values
from mapping.stages.context import BuildContext
from mapping.stages.local_features import LocalFeaturesSource
from mapping.stages.networks import Networks
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc import __version__
from visloc.archive import Map, open_map
from visloc.geometry import Pose
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.types import Localized, QueryFeatures

# Raised when the code of the stage changes what comes out.
_REVISION = 1
# Only the strongest keypoints of a photo are used, as many as a query has.
_MAX_KEYPOINTS = 2500


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """The answer of the map to a photo.

    Attributes:
        reason: why the photo was not localized; "" if it was.
        cam_from_map: pose; the identity if the photo was not localized.
        pixels: (n, 2) float64 inlier keypoints.
        points: (n, 3) float64 their landmarks, in the map's frame.
    """

    reason: str
    cam_from_map: Pose
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]

    @property
    def localized(self) -> bool:
        return self.reason == ""


def localize_photos(
    context: BuildContext,
    opened: Map,
    photos: Sequence[MappingPhoto],
    described: Mapping[str, NDArray[np.float32]],
) -> list[Placed]:
    """Localize photos, like queries, from the features that were extracted for mapping.

    Args:
        context: with local features of the map's kind.
        described: global descriptors (n, D) by name, by the map's models.
    """
    task = _LocalizeTask(
        context.work,
        opened.path,
        opened.manifest.content_hash,
        context.features,
        context.networks,
    )
    queries = [
        _Query(photo, {name: rows[row] for name, rows in described.items()})
        for row, photo in enumerate(photos)
    ]
    context.run("localized", task.localize, queries)
    return [_placed(context.work.read(task.key(query))) for query in queries]


@dataclass(frozen=True, slots=True, eq=False)
class _Query:
    photo: MappingPhoto
    described: Mapping[str, NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class _LocalizeTask:
    """A worker's part: one photo."""

    work: WorkFolder
    folder: Path
    content_hash: str
    features: LocalFeaturesSource
    networks: Networks

    def key(self, query: _Query) -> str:
        return key_of(
            "localized",
            _REVISION,
            version=__version__,
            map=self.content_hash,
            local=self.features.key(query.photo),
            described={
                name: hashlib.sha256(row.tobytes()).hexdigest()
                for name, row in query.described.items()
            },
            camera=camera_values(query.photo.camera),
        )

    def localize(self, query: _Query) -> None:
        key = self.key(query)
        if not self.work.has(key):
            self.work.get(key, partial(self._compute, query))

    def _compute(self, query: _Query) -> Item:
        localizer = _open_localizer(self.folder, self.networks)
        found = self.features.read(query.photo)  # strongest first
        features = QueryFeatures(
            localizer.map.manifest.local_features.fingerprint.name,
            found.keypoints[:_MAX_KEYPOINTS],
            found.descriptors[:_MAX_KEYPOINTS],
            query.described,
        )
        answer = localizer.localize_features(features, query.photo.camera, LocalizeOptions())
        if not isinstance(answer, Localized):
            return _item(str(answer.reason), Pose.identity(), np.empty((0, 2)), np.empty((0, 3)))
        pixels = answer.inlier_keypoints.astype(np.float64)
        return _item("", answer.cam_from_world, pixels, answer.inlier_points)


def _item(
    reason: str, pose: Pose, pixels: NDArray[np.float64], points: NDArray[np.float64]
) -> Item:
    return {
        "reason": np.array(reason),
        "rotation": pose.rotation,
        "translation": pose.translation,
        "pixels": pixels,
        "points": points,
    }


def _placed(item: Item) -> Placed:
    pose = Pose(item["rotation"], item["translation"])
    return Placed(str(item["reason"]), pose, item["pixels"], item["points"])


@cache
def _open_localizer(folder: Path, networks: Networks) -> Localizer:
    """Return the localizer of this process; it takes features, so it needs no extractor."""
    return Localizer(open_map(folder), None, networks.descriptor)
