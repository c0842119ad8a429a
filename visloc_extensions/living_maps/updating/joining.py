"""A new capture as a part of the map that it joins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapping.pipeline.content import photo_content
from mapping.stages.landmarks import MadeLandmarks
from mapping.stages.local_features import LocalFeaturesSource
from visloc.archive import Landmarks, MapContent
from visloc.geometry import Pose
from visloc.kapture import Dataset
from visloc_extensions.living_maps.updating.capture import Capture


def part_of_map(
    content: MapContent,
    dataset: Dataset,
    capture: Capture,
    features: LocalFeaturesSource,
    made: MadeLandmarks,
    notes: Sequence[str],
) -> MapContent:
    """Return the capture's photos that have a pose as content of the map's kind, in its frame.

    Args:
        dataset: of the capture, with rigs in the map's unit.
        made: from the capture, in the map's frame.
    """
    return replace(
        content,
        notes=(*notes, *made.notes),
        global_features=tuple(
            replace(one, descriptors=capture.described[one.fingerprint.name][made.photos])
            for one in content.global_features
        ),
        **photo_content(dataset, capture.photos, capture.names, features, made),
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
    """Find for each new landmark (P,) the nearest old one in its voxel; -1 without one.

    Args:
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
    """Number the cells (n, 3) of a box."""
    # As merging has it, the box has fewer than 2**62 cells.
    x, y, z = cells.astype(np.int64).T
    return np.asarray((x * int(size[1]) + y) * int(size[2]) + z)
