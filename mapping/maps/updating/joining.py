"""What a new capture brings, as a part of the map that it joins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapping.build.features import LocalFeaturesSource
from mapping.build.landmarks import MadeLandmarks
from mapping.build.photos import MappingPhoto
from mapping.methods.sfm import known_rigs
from visloc.archive import ImageRecord, Landmarks, MapContent, pose_row
from visloc.geometry import Pose
from visloc.kapture import Dataset


def part_of_map(
    content: MapContent,
    dataset: Dataset,
    photos: Sequence[MappingPhoto],
    names: Sequence[str],
    features: LocalFeaturesSource,
    described: Mapping[str, NDArray[np.float32]],
    made: MadeLandmarks,
    notes: Sequence[str],
) -> MapContent:
    """Return the photos that found a place as content of the map's kind, in its frame.

    Args:
        content: the map.
        dataset: what the photos are of, with rigs in the map's unit.
        photos: those that ``made`` was made of.
        names: what they are called in the map.
        features: of the photos, of the map's kind.
        described: global descriptors (n, D) of the photos by name, by the map's models.
        made: in the map's frame.
        notes: on what was left out.
    """
    placed = [photos[row] for row in made.photos]

    def descriptors() -> Iterator[NDArray[np.float32]]:
        for photo, rows in zip(placed, made.rows, strict=True):
            yield features.read(photo).descriptors[rows]

    sensors = {photo.record.sensor_id for photo in placed}
    return replace(
        content,
        notes=(*notes, *made.notes),
        cameras={
            photo.record.sensor_id: view.camera
            for photo, view in zip(placed, made.views, strict=True)
        },
        rigs={
            rig: {sensor: pose_row(pose) for sensor, pose in members.items()}
            for rig, members in known_rigs(dataset, sensors).items()
        },
        images=tuple(
            ImageRecord(
                names[row],
                photos[row].record.sensor_id,
                photos[row].record.timestamp,
                features.turn(photos[row]),
            )
            for row in made.photos
        ),
        image_poses=np.array([pose_row(view.cam_from_world) for view in made.views]),
        landmarks=made.landmarks,
        descriptors=descriptors,
        global_features=tuple(
            replace(one, descriptors=described[one.fingerprint.name][made.photos])
            for one in content.global_features
        ),
    )


def scaled_rigs(dataset: Dataset, scale: float) -> Dataset:
    """Return the dataset with its rigs in another unit."""
    return replace(
        dataset,
        rigs={
            rig: {
                sensor: pose and Pose(pose.rotation, pose.translation * scale)
                for sensor, pose in members.items()
            }
            for rig, members in dataset.rigs.items()
        },
    )


def landmarks_in_same_voxel(
    old: Landmarks, new: Landmarks, origin: NDArray[np.float64], voxel_size: float
) -> NDArray[np.int64]:
    """Find for each new landmark (P,) the old one in its voxel, the nearest of several; else -1.

    Args:
        old: landmarks of the map.
        new: at most one in each voxel.
        origin: (3,) a corner of a voxel.
        voxel_size: edge of a voxel in the unit of the world.
    """
    shift = new.origin - origin
    cells = np.floor((new.points + shift) / voxel_size)
    low, size = cells.min(axis=0), np.ptp(cells, axis=0) + 1
    old_points = old.points + (old.origin - origin)
    old_cells = np.floor(old_points / voxel_size) - low
    near = np.flatnonzero(((old_cells >= 0) & (old_cells < size)).all(axis=1))
    codes, old_codes = _codes(cells - low, size), _codes(old_cells[near], size)
    order = np.argsort(codes, kind="stable")
    at = np.minimum(np.searchsorted(codes[order], old_codes), len(codes) - 1)
    same = codes[order][at] == old_codes
    found, rows = order[at[same]], near[same]
    apart = np.linalg.norm(old_points[rows] - (new.points[found] + shift), axis=1)
    # The nearest is written last, and of equally near ones the first.
    last = np.lexsort((-rows, -apart))
    result = np.full(len(new.points), -1, dtype=np.int64)
    result[found[last]] = rows[last]
    return result


def _codes(cells: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.int64]:
    """One number for each cell (n, 3) of a box."""
    # As merging has it, the box has fewer than 2**62 cells.
    x, y, z = cells.astype(np.int64).T
    return np.asarray((x * int(size[1]) + y) * int(size[2]) + z)
