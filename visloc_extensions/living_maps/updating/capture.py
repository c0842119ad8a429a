"""The photos of a new capture, with features of the map's kinds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapping.stages.context import BuildContext
from mapping.stages.global_features import describe_with_model, read_global_features
from mapping.stages.local_features import (
    LocalFeaturesSource,
    ReadyMadeFeatures,
    local_features_source,
)
from mapping.stages.networks import Networks
from mapping.stages.photos import MappingPhoto, collect_photos, some
from mapping.stages.resolution import at_resolution_of
from mapping.stages.work_folder import WorkFolder
from visloc.archive import Map
from visloc.archive.schema import photo_file
from visloc.errors import refuse
from visloc.features.local.readymade import is_ready_made
from visloc.kapture import Dataset
from visloc.localization.query.fingerprints import check_fingerprint
from visloc_extensions.living_maps.updating.localizing import Placed
from visloc_extensions.living_maps.updating.settings import UpdateSettings


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Photos to join a map.

    Attributes:
        photos: n photos with known cameras.
        described: their global descriptors (n, D) by name, by the map's models.
    """

    photos: list[MappingPhoto]
    names: list[str]
    described: dict[str, NDArray[np.float32]]

    def take(self, rows: Sequence[int]) -> Capture:
        """Return the photos of some rows."""
        return Capture(
            [self.photos[row] for row in rows],
            [self.names[row] for row in rows],
            {name: described[rows] for name, described in self.described.items()},
        )


def collect_capture(
    context: BuildContext,
    settings: UpdateSettings,
    opened: Map,
    dataset: Dataset,
    *,
    with_depth: bool,
) -> tuple[Capture, list[str]]:
    """Collect the usable photos, not described yet, and notes on the others."""
    features = context.features
    ready_made = isinstance(features, ReadyMadeFeatures)
    shown = keeps_photos(opened) or opened.colors is not None
    photos, notes = collect_photos(
        dataset,
        posed=settings.poses != "localize",
        with_files=shown or not ready_made,
        has_features=features.has if isinstance(features, ReadyMadeFeatures) else None,
        with_depth=with_depth,
        depth_sensor=settings.depth_sensor,
        progress=partial(context.progress, "photos"),
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
    photos = at_resolution_of(opened, photos, features)
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
    settings: UpdateSettings, opened: Map, work: WorkFolder, networks: Networks
) -> LocalFeaturesSource:
    """Open the dataset's local features of the map's kind; check the global ones as well."""
    local = opened.manifest.local_features
    features = local_features_source(
        work,
        settings.dataset,
        local.fingerprint.name,
        networks=networks,
        max_keypoints=local.max_keypoints,
        features_dir=settings.features_dir,
        pixel_origin=settings.pixel_origin,
    )
    check_fingerprint(local.fingerprint, features.fingerprint, opened.ref)
    for record in opened.manifest.global_features:
        name = record.fingerprint.name
        if not is_ready_made(name):
            here = networks.descriptor(name).fingerprint
            check_fingerprint(record.fingerprint, here, opened.ref)
    return features


def describe_capture(
    context: BuildContext,
    settings: UpdateSettings,
    opened: Map,
    dataset: Dataset,
    capture: Capture,
) -> Capture:
    """Find the local features of the photos, and describe them by the map's models."""
    context.run("local features", context.features.prepare, capture.photos)
    described = {}
    for record in opened.manifest.global_features:
        name = record.fingerprint.name
        if is_ready_made(name):
            read = read_global_features(dataset, name, settings.features_dir, capture.photos)
            described[name] = read.descriptors
        else:
            described[name] = describe_with_model(context, opened, capture.photos, name)
    return replace(capture, described=described)


def where_localized(capture: Capture, placed: Sequence[Placed]) -> tuple[Capture, list[str]]:
    """Return the localized photos, with the poses that were found, and the names of the others."""
    rows = [row for row, one in enumerate(placed) if one.localized]
    found = capture.take(rows)
    photos = [
        replace(photo, cam_from_world=placed[row].cam_from_map)
        for photo, row in zip(found.photos, rows, strict=True)
    ]
    pairs = zip(capture.names, placed, strict=True)
    return replace(found, photos=photos), [name for name, one in pairs if not one.localized]
