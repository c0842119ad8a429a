"""Landmarks from depth: keypoints lifted to 3D and merged across photos in a voxel grid.

The mapping strategy for RGB-D data of Humenberger et al. 2020 (section 4.3), with a sub-pixel
depth lookup, and with landmarks at the mean of what fell into their cell instead of at the first
point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapping.depth import depth_at, photo_depth
from mapping.photos import MappingPhoto
from visloc.archive import Landmarks
from visloc.errors import InvalidInput
from visloc.kapture import Dataset
from visloc.pose.colmap import normalized_rays, project


@dataclass(frozen=True, slots=True, eq=False)
class LiftedKeypoints:
    """Keypoints of one photo that have a depth.

    Attributes:
        rows: (m,) int64 rows of the photo's features, strongest first.
        pixels: (m, 2) float32 where the photo sees them.
        points: (m, 3) float64 in the world.
    """

    rows: NDArray[np.int64]
    pixels: NDArray[np.float32]
    points: NDArray[np.float64]


def lift_keypoints(
    dataset: Dataset, photo: MappingPhoto, keypoints: NDArray[np.float32], depth_scale: float
) -> LiftedKeypoints:
    """Give keypoints (n, 2) of a photo their place in the world, where its depth map allows.

    Raises:
        DatasetError: when the depth map is not what its sensor says.
    """
    if photo.depth is None:
        rows = np.empty(0, dtype=np.int64)
        return LiftedKeypoints(rows, keypoints[rows], np.empty((0, 3)))
    depth, seen_by = photo_depth(dataset, photo.depth, photo.camera, depth_scale)
    rays = normalized_rays(photo.camera, keypoints)
    # Both cameras now share one centre and one orientation, not always size and focal length.
    distance = depth_at(depth, project(seen_by, rays)).astype(np.float64)
    rows = np.flatnonzero(np.isfinite(distance) & np.isfinite(rays).all(axis=1))
    points = photo.cam_from_world.inverse().apply(rays[rows] * distance[rows, None])
    return LiftedKeypoints(rows, keypoints[rows], points)


def merge_landmarks(
    photos: Sequence[MappingPhoto], lifted: Sequence[LiftedKeypoints], voxel_size: float
) -> tuple[Landmarks, list[NDArray[np.int64]]]:
    """Merge the lifted keypoints of all photos: one landmark per occupied voxel, at their mean.

    Of several keypoints of one photo in a voxel (a corner found at several scales) the strongest
    stays.

    Args:
        photos: n photos.
        lifted: of each photo, its lifted keypoints.
        voxel_size: edge of a voxel in the unit of the world.

    Returns:
        The landmarks, and of each photo the rows of its features that observe them.

    Raises:
        InvalidInput: ``rgbd.no_landmarks`` or ``rgbd.voxel_size``.
    """
    points = np.concatenate([one.points for one in lifted])
    if len(points) == 0:
        raise InvalidInput(
            "rgbd.no_landmarks",
            "no keypoint of any photo has a depth",
            field="dataset",
            expected="depth maps that go with the photos; see --depth-sensor and --depth-scale",
        )
    origin = _choose_origin(photos)
    points -= origin
    landmark, num_landmarks = _voxel_index(points, voxel_size)
    seen_in = np.repeat(np.arange(len(lifted)), [len(one.rows) for one in lifted])
    # np.unique gives the first row of each pair, which is the strongest keypoint.
    _, first = np.unique(landmark * len(photos) + seen_in, return_index=True)
    kept = np.sort(first)
    points, landmark, seen_in = points[kept], landmark[kept], seen_in[kept]
    pixels = np.concatenate([one.pixels for one in lifted])[kept]
    rows = np.concatenate([one.rows for one in lifted])[kept]

    tracks = np.bincount(landmark, minlength=num_landmarks)
    mean = np.column_stack(
        [np.bincount(landmark, points[:, axis], num_landmarks) / tracks for axis in range(3)]
    )
    by_photo = _rows_by_photo(seen_in, len(photos))
    errors = np.concatenate(
        [
            np.linalg.norm(
                project(photo.camera, photo.cam_from_world.apply(mean[landmark[own]] + origin))
                - pixels[own],
                axis=1,
            )
            for photo, own in zip(photos, by_photo, strict=True)
        ]
    )
    landmarks = Landmarks(
        origin=origin,
        points=mean.astype(np.float32),
        track_lengths=np.minimum(tracks, 65535).astype(np.uint16),
        errors_px=(np.bincount(landmark, errors, num_landmarks) / tracks).astype(np.float32),
        angles_deg=np.full(num_landmarks, np.nan, dtype=np.float32),
        offsets=np.array([0, *(own.stop for own in by_photo)], dtype=np.int64),
        observed=landmark.astype(np.uint32),
        keypoints=pixels,
    )
    return landmarks, [rows[own] for own in by_photo]


def _rows_by_photo(seen_in: NDArray[np.int64], num_photos: int) -> list[slice]:
    bounds = np.searchsorted(seen_in, np.arange(num_photos + 1))
    return [slice(int(a), int(b)) for a, b in pairwise(bounds)]


def _choose_origin(photos: Sequence[MappingPhoto]) -> NDArray[np.float64]:
    """Whole units near the photos when they are so far off that float32 would lose millimetres."""
    center = np.mean([photo.cam_from_world.center for photo in photos], axis=0)
    far_off = np.abs(center).max() > 1000.0
    return np.asarray(np.round(center) if far_off else np.zeros(3), dtype=np.float64)


def _voxel_index(points: NDArray[np.float64], voxel_size: float) -> tuple[NDArray[np.int64], int]:
    """Number the occupied voxels in the order of their cells; return (rows, how many)."""
    cells = np.floor(points / voxel_size)
    cells -= cells.min(axis=0)
    size = cells.max(axis=0) + 1.0
    if np.prod(size) >= 2**62:
        raise InvalidInput(
            "rgbd.voxel_size",
            "the voxel size is too small for the extent of the map",
            field="--voxel-size",
            expected=f"more for an extent of {', '.join(f'{s:g}' for s in size * voxel_size)}",
            got=voxel_size,
        )
    x, y, z = cells.astype(np.int64).T
    flat = (x * int(size[1]) + y) * int(size[2]) + z
    occupied, index = np.unique(flat, return_inverse=True)
    return index.astype(np.int64), len(occupied)
