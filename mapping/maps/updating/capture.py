"""The photos of a new capture, with the features that the map has of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapping.build.features import (
    LocalFeaturesSource,
    Progress,
    ReadyMadeFeatures,
    describe_with_model,
    find_local_features,
    local_features_source,
    open_descriptor,
    read_global_features,
)
from mapping.build.photos import MappingPhoto, collect_photos
from mapping.build.stages import WorkFolder
from mapping.cluster.executors import Executor
from mapping.maps.updating.localizing import Placed
from mapping.maps.updating.settings import UpdateSettings
from visloc.archive import Map
from visloc.archive.schema import photo_file
from visloc.errors import refuse
from visloc.features.local.readymade import is_ready_made, ready_made_type
from visloc.kapture import Dataset, open_features
from visloc.localization.fingerprints import check_fingerprint

# More names than a note needs.
_NAMED = 3


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Photos that are to join a map.

    Attributes:
        photos: n photos with known cameras.
        names: what they are called in the map.
        described: their global descriptors (n, D) by name, by the map's models.
    """

    photos: list[MappingPhoto]
    names: list[str]
    described: dict[str, NDArray[np.float32]]

    def take(self, rows: Sequence[int]) -> Capture:
        """Return some of them."""
        return Capture(
            [self.photos[row] for row in rows],
            [self.names[row] for row in rows],
            {name: described[rows] for name, described in self.described.items()},
        )


def collect_capture(
    settings: UpdateSettings,
    opened: Map,
    dataset: Dataset,
    features: LocalFeaturesSource,
    *,
    with_depth: bool,
    progress: Progress,
) -> tuple[Capture, list[str]]:
    """Gather the photos that can be used, not described yet, and notes on the others.

    Raises:
        Conflict: ``update.photos`` when the map has photos of these names.
        DatasetError: ``dataset.no_photos``, and what ``collect_photos`` raises.
    """
    ready_made = isinstance(features, ReadyMadeFeatures)
    shown = keeps_photos(opened) or opened.colors is not None
    photos, notes = collect_photos(
        dataset,
        posed=settings.poses != "localize",
        with_files=shown or not ready_made,
        has_features=features.has if isinstance(features, ReadyMadeFeatures) else None,
        with_depth=with_depth,
        depth_sensor=settings.depth_sensor,
        progress=partial(progress, "photos"),
    )
    unknown = [photo.name for photo in photos if not photo.camera_known]
    if unknown:
        notes.append(
            f"{len(unknown)} of {len(photos)} photos have a camera of unknown model: "
            f"{some(unknown)}"
        )
    photos = [photo for photo in photos if photo.camera_known]
    if not photos:
        raise refuse("dataset.no_photos", field=str(dataset.root / "sensors" / "sensors.txt"))
    names = [
        photo.name if settings.capture is None else f"{settings.capture}/{photo.name}"
        for photo in photos
    ]
    known = {image.name for image in opened.images}
    both = [name for name in names if name in known]
    if both:
        raise refuse("update.photos", field="--capture", got=f"{len(both)}: {some(both)}")
    return Capture(photos, names, {}), [*dataset.notes, *notes]


def keeps_photos(opened: Map) -> bool:
    """Tell whether a map keeps small pictures of its photos."""
    return photo_file(0) in opened.manifest.files


def open_map_features(
    settings: UpdateSettings, opened: Map, work: WorkFolder
) -> LocalFeaturesSource:
    """Open the map's kind of local features, of the dataset; check the global ones as well.

    Raises:
        Conflict: ``map.features`` when those at hand are others than those of the map.
        WeightsError, InvalidInput, DatasetError: what opening them raises.
    """
    local = opened.manifest.local_features
    features = local_features_source(
        work,
        settings.dataset,
        local.fingerprint.name,
        max_keypoints=local.max_keypoints,
        weights_dir=settings.weights_dir,
        inference=settings.inference,
        features_dir=settings.features_dir,
        pixel_origin=settings.pixel_origin,
    )
    check_fingerprint(local.fingerprint, features.fingerprint, opened.ref)
    for record in opened.manifest.global_features:
        if not is_ready_made(record.fingerprint.name):
            descriptor = open_descriptor(
                record.fingerprint.name, settings.weights_dir, settings.inference
            )
            check_fingerprint(record.fingerprint, descriptor.fingerprint, opened.ref)
    return features


def describe_capture(
    settings: UpdateSettings,
    opened: Map,
    dataset: Dataset,
    features: LocalFeaturesSource,
    capture: Capture,
    work: WorkFolder,
    workers: Executor,
    progress: Progress,
) -> Capture:
    """Find the local features of the photos, and describe them as the map describes its own.

    Raises:
        DatasetError: with the file that is wrong.
    """
    find_local_features(features, capture.photos, workers, progress)
    found = {}
    for record in opened.manifest.global_features:
        name = record.fingerprint.name
        if is_ready_made(name):
            files = open_features(
                dataset.root, "global_features", ready_made_type(name), settings.features_dir
            )
            found[name] = read_global_features(files, capture.photos).descriptors
        else:
            found[name] = describe_with_model(
                opened,
                work,
                capture.photos,
                features,
                name,
                settings.weights_dir,
                settings.inference,
                workers,
                progress,
            )
    return replace(capture, described=found)


def where_localized(capture: Capture, placed: Sequence[Placed]) -> tuple[Capture, list[str]]:
    """Return the photos that were localized, with these poses, and the names of the others."""
    rows = [row for row, one in enumerate(placed) if one.localized]
    found = capture.take(rows)
    photos = [
        replace(photo, cam_from_world=placed[row].cam_from_map)
        for photo, row in zip(found.photos, rows, strict=True)
    ]
    pairs = zip(capture.names, placed, strict=True)
    return replace(found, photos=photos), [name for name, one in pairs if not one.localized]


def some(names: Sequence[str]) -> str:
    """A few names, for a note."""
    return ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
