"""Where a map's photos were taken, without opening the map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive.checks import map_array, read_record
from visloc.archive.reader import MapOutline
from visloc.archive.schema import ImageRecord, ImagesFile
from visloc.errors import refuse


@dataclass(frozen=True, slots=True, eq=False)
class MappingPhotos:
    """The mapping photos.

    Attributes:
        images: n names and cameras.
        positions: (n, 3) float64, the camera centres in the world.
        orientations: (n, 4) float64, the rotations of world_from_cam as w, x, y, z with w >= 0.
    """

    images: tuple[ImageRecord, ...]
    positions: NDArray[np.float64]
    orientations: NDArray[np.float64]


def read_photos(folder: Path, outline: MapOutline) -> MappingPhotos:
    """Read the mapping photos of a map whose outline was read before.

    Raises:
        MapCorrupt: ``map.json``, ``map.images``, ``map.array``.
    """
    images = read_record(folder, "images.json", ImagesFile).images
    num = outline.manifest.counts.images
    if len(images) != num or any(image.camera not in outline.cameras for image in images):
        raise refuse("map.images", field=str(folder / "images.json"))
    poses = map_array(folder, "image_poses.npy", "<f8", (num, 7), load=True)
    conjugate = np.where(poses[:, :1] < 0, -1.0, 1.0) * poses[:, :4] * (1.0, -1.0, -1.0, -1.0)
    return MappingPhotos(images, -_rotated(conjugate, poses[:, 4:]), conjugate)


def _rotated(wxyz: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn vectors (n, 3) by unit quaternions (n, 4): v + 2w (u x v) + 2u x (u x v)."""
    u = wxyz[:, 1:]
    twice = 2 * np.cross(u, vectors)
    turned: NDArray[np.float64] = vectors + wxyz[:, :1] * twice + np.cross(u, twice)
    return turned
