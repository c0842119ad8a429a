"""The photos whose pose is known, as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapping.pairing.scene import Scene
from visloc.errors import refuse


@dataclass(frozen=True, slots=True, eq=False)
class PosedPhotos:
    """The photos of a scene that a pairing by pose can use.

    Attributes:
        rows: (p,) int64 rows of the scene, ascending.
        centers: (p, 3) float64 camera positions in the world.
        rotations: (p, 3, 3) float64 of ``cam_from_world``.
    """

    rows: NDArray[np.int64]
    centers: NDArray[np.float64]
    rotations: NDArray[np.float64]


def posed_photos(scene: Scene, pairing: str, *, with_camera: bool = False) -> PosedPhotos:
    """Collect the photos with a pose and, on request, with intrinsics."""
    posed = {row: pose for row, pose in enumerate(scene.cam_from_world) if pose is not None}
    if len(posed) < 2:
        raise refuse("pairs.no_poses", field="--pairs", got=len(posed), pairing=pairing)
    if with_camera:
        posed = {row: pose for row, pose in posed.items() if scene.cameras[row] is not None}
        if len(posed) < 2:
            raise refuse("pairs.no_cameras", field="--pairs", got=len(posed), pairing=pairing)
    return PosedPhotos(
        rows=np.array(list(posed), dtype=np.int64),
        centers=np.stack([pose.center for pose in posed.values()]),
        rotations=np.stack([pose.rotation for pose in posed.values()]),
    )


def nearest(
    tree: cKDTree, points: NDArray[np.float64], count: int, *, within: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Find the nearest points of a tree: distances and rows, (b, count) each, nearest first.

    If fewer lie within the limit, distances are infinite and rows are not rows of the tree.
    """
    distances, rows = tree.query(points, k=count, distance_upper_bound=within)
    return np.asarray(distances), np.asarray(rows, dtype=np.int64)
