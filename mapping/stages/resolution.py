"""The size at which the features of each mapping photo are found: the finest are reduced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mapping.stages.local_features import ExtractedFeatures, LocalFeaturesSource
from mapping.stages.photos import MappingPhoto
from visloc.archive import Map
from visloc.features.resolution import Resolution, WorkingResolution
from visloc.localization.map_view.constraints import MapGeometry


def at_one_resolution(
    photos: Sequence[MappingPhoto], features: LocalFeaturesSource
) -> list[MappingPhoto]:
    """Say at which size features are found in the photos of a new map.

    A few photos of 12 megapixels then match the frames of a film. Coarser photos stay as they are,
    and so do ready-made features.
    """
    if not isinstance(features, ExtractedFeatures) or not photos:
        return list(photos)
    each = [_of(photo) for photo in photos]
    return _at(photos, WorkingResolution.of(each, features.fingerprint.parameters))


def at_resolution_of(
    opened: Map, photos: Sequence[MappingPhoto], features: LocalFeaturesSource
) -> list[MappingPhoto]:
    """Say at which size features are found in photos that join a map."""
    if not isinstance(features, ExtractedFeatures):
        return list(photos)
    return _at(photos, MapGeometry(opened).resolution)


def _at(photos: Sequence[MappingPhoto], resolution: WorkingResolution) -> list[MappingPhoto]:
    return [
        replace(
            photo,
            feature_size=resolution.feature_size(
                _of(photo), photo.camera.width, photo.camera.height
            ),
        )
        for photo in photos
    ]


def _of(photo: MappingPhoto) -> Resolution:
    return Resolution.of(photo.camera, known=photo.camera_known)
