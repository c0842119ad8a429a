"""Our values as pycolmap's and back. The only place that knows pycolmap's conventions."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import PIL.Image  # noqa: F401  Pillow saves PNGs only when it was imported before pycolmap
import pycolmap
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose

_COMES_BACK_PX = 1.0  # far above what undistortion leaves, far below what is seen beyond 90 degrees


def colmap_camera(camera: Camera) -> pycolmap.Camera:
    """Return the same camera for pycolmap. Pixel conventions are the same."""
    return pycolmap.Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
    )


@lru_cache(maxsize=64)
def _kept_camera(camera: Camera) -> pycolmap.Camera:
    """Return the same as ``colmap_camera``, to be read only; a query asks dozens of times."""
    return colmap_camera(camera)


def pose_from_colmap(rigid: pycolmap.Rigid3d) -> Pose:
    """Return pycolmap's transform as ours, with a rotation that is a copy, not a view."""
    matrix = np.array(rigid.matrix(), dtype=np.float64)
    return Pose(matrix[:, :3], matrix[:, 3])


def normalized_rays(camera: Camera, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the points (N, 3) at depth 1 that pixels (N, 2) see, in the camera's frame.

    A pixel whose undistortion does not converge, or that sees what is beside or behind the camera,
    gives NaN.
    """
    if len(pixels) == 0:
        return np.empty((0, 3))
    plane = np.asarray(_kept_camera(camera).cam_from_img(np.asarray(pixels, dtype=np.float64)))
    rays = np.column_stack([plane, np.ones(len(plane))])
    # pycolmap has points in front of wide cameras for what lies beside them, too.
    rays[~(np.abs(project(camera, rays) - pixels).max(axis=1) < _COMES_BACK_PX)] = np.nan
    return rays


def project(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points (N, 3) in the camera's frame to pixels (N, 2); NaN behind the camera."""
    if len(points) == 0:
        return np.empty((0, 2))
    return np.asarray(_kept_camera(camera).img_from_cam(points))
