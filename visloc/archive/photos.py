"""Poses of a map's photos, without opening the map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive.checks import map_array
from visloc.archive.reader import MapOutline, read_images
from visloc.archive.schema import ImageRecord


@dataclass(frozen=True, slots=True, eq=False)
class MappingPhotos:
    """The mapping photos.

    Attributes:
        positions: (n, 3) float64, camera centres in the world.
        orientations: (n, 4) float64, rotations of world_from_cam as w, x, y, z with w >= 0.
    """

    images: tuple[ImageRecord, ...]
    positions: NDArray[np.float64]
    orientations: NDArray[np.float64]


def read_photos(folder: Path, outline: MapOutline) -> MappingPhotos:
    """Read the mapping photos of a map whose outline was read."""
    images = read_images(folder, outline)
    poses = map_array(folder, "image_poses.npy", "<f8", (len(images), 7), load=True)
    conjugate = np.where(poses[:, :1] < 0, -1.0, 1.0) * poses[:, :4] * (1.0, -1.0, -1.0, -1.0)
    return MappingPhotos(images, -_rotated(conjugate, poses[:, 4:]), conjugate)


def _rotated(wxyz: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn vectors (n, 3) by unit quaternions (n, 4): v + 2w (u x v) + 2u x (u x v)."""
    u = wxyz[:, 1:]
    twice = 2 * np.cross(u, vectors)
    turned: NDArray[np.float64] = vectors + wxyz[:, :1] * twice + np.cross(u, twice)
    return turned
