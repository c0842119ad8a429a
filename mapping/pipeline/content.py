"""The content of a map, from the landmarks that a method made."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.methods.sfm import known_rigs
from mapping.options import Vector
from mapping.pipeline.settings import BuildSettings
from mapping.stages.landmarks import MadeLandmarks
from mapping.stages.local_features import LocalFeaturesSource
from mapping.stages.photos import MappingPhoto
from visloc.archive import (
    Anchor,
    FingerprintRecord,
    GlobalFeatures,
    ImageRecord,
    MapContent,
    pose_row,
)
from visloc.archive.gnss import Fixes, GnssFix
from visloc.kapture import Dataset

# Where the world's axes point east, north and up.
_GEODETIC_DOWN = (0.0, 0.0, -1.0)


def build_content(
    settings: BuildSettings,
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    features: LocalFeaturesSource,
    global_features: Sequence[GlobalFeatures],
    made: MadeLandmarks,
    notes: tuple[str, ...],
) -> MapContent:
    """Return the content of a new map, from n photos and their global descriptors (n, D)."""
    gravity, gravity_notes = _gravity(settings.gravity, made.anchor)
    return MapContent(
        metric=made.metric,
        method=settings.method,
        settings=made.settings,
        notes=(*notes, *made.notes, *gravity_notes),
        local_fingerprint=FingerprintRecord.of(features.fingerprint),
        computed_with=features.computed_with,
        max_keypoints=features.max_keypoints,
        descriptor_dim=features.descriptor_dim,
        global_features=tuple(
            GlobalFeatures(one.fingerprint, one.descriptors[made.photos], one.model)
            for one in global_features
        ),
        anchor=made.anchor,
        gravity=gravity,
        fusion=settings.late_fusion,
        index=settings.index,
        **photo_content(dataset, photos, [photo.name for photo in photos], features, made),
    )


def photo_content(
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    names: Sequence[str],
    features: LocalFeaturesSource,
    made: MadeLandmarks,
) -> dict[str, Any]:
    """Return the fields of ``MapContent`` about photos, cameras and landmarks."""
    placed = [photos[row] for row in made.photos]
    features = features.outside(made.fixed)

    def descriptors() -> Iterator[NDArray[np.float32]]:
        for photo, rows in zip(placed, made.rows, strict=True):
            yield features.read(photo).descriptors[rows]

    sensors = [photo.record.sensor_id for photo in placed]
    rigs = {} if made.rig_scale is None else known_rigs(dataset, set(sensors), made.rig_scale)
    return {
        "cameras": {sensor: view.camera for sensor, view in zip(sensors, made.views, strict=True)},
        "rigs": {
            rig: {sensor: pose_row(pose) for sensor, pose in members.items()}
            for rig, members in rigs.items()
        },
        "images": tuple(
            ImageRecord(
                name=names[row],
                camera=photo.record.sensor_id,
                timestamp=photo.record.timestamp,
                turn=features.turn(photo),
            )
            for row, photo in zip(made.photos.tolist(), placed, strict=True)
        ),
        "image_poses": np.array([pose_row(view.cam_from_world) for view in made.views]),
        "landmarks": made.landmarks,
        "fixes": _fixes(dataset),
        "descriptors": descriptors,
    }


def _fixes(dataset: Dataset) -> Fixes | None:
    """Return the GNSS fixes of a dataset, all of them, also where no photo was taken."""
    if not dataset.gnss:
        return None
    receivers = dict.fromkeys(record.sensor_id for record in dataset.gnss)
    return Fixes(
        receivers={name: dataset.sensors[name].params for name in receivers},
        fixes=tuple(
            GnssFix(
                timestamp=record.timestamp,
                receiver=record.sensor_id,
                **{name: getattr(record, name) for name in ("x", "y", "z", "utc", "dop")},
            )
            for record in dataset.gnss
        ),
    )


def _gravity(given: Vector | None, anchor: Anchor) -> tuple[Vector | None, tuple[str, ...]]:
    """Return the unit vector that points down in the world, if it is known, and notes."""
    if given is None:
        return (None if anchor.geodetic is None else _GEODETIC_DOWN), ()
    if anchor.kind == "none":
        return None, ("the frame is arbitrary, so --gravity says nothing of it and was left out",)
    length = math.hypot(*given)
    x, y, z = (value / length for value in given)
    return (x, y, z), ()
