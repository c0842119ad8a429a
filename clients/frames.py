"""From the pose of a photo to the frame of an AR session or a robot (docs/ar-and-robots.md)."""

from __future__ import annotations

import warnings
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visloc.errors import refuse
from visloc.geometry import Pose
from visloc.sequences.filling import interpolate_pose
from visloc_api.words.poses import PoseEstimate


class Axes(StrEnum):
    """The axes of a camera, and of the frame that it is in.

    ``opencv`` is ours: x right, y down, z forward. ROS calls it an optical frame.
    ``opengl`` is ARKit's, ARCore's, WebXR's and three.js's: x right, y up, z backward.
    ``unity`` is left-handed: x right, y up, z forward. Unity's frames mirror right-handed ones, so
    a point (x, y, z) of the map is (x, y, -z) there.
    """

    OPENCV = "opencv"
    OPENGL = "opengl"
    UNITY = "unity"


_UNKNOWN_UNIT = (
    "the unit of this map has an unknown length, and that of the session is the metre: content is "
    "placed in the wrong size. mapping edit --scale gives the map its size"
)
_UPRIGHT = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes: opencv from opengl, and back
_MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0])  # Unity's frames from right-handed ones, and back


def camera_matrix(pose: PoseEstimate | Pose, axes: Axes = Axes.OPENCV) -> NDArray[np.float64]:
    """Return where the camera is in the map, as ``map_from_camera``.

    Args:
        pose: of an answer, or ``cam_from_world``.
        axes: of the camera; with ``unity`` also those of the map.

    Returns:
        A 4 x 4 matrix for column vectors. Unity, ARKit and three.js keep matrices by columns: give
        them ``matrix.T.ravel()``.
    """
    cam_from_world = pose.cam_from_world if isinstance(pose, PoseEstimate) else pose
    world_from_cam = cam_from_world.inverse()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = world_from_cam.rotation, world_from_cam.translation
    if axes is Axes.OPENCV:
        return matrix
    matrix = matrix @ _UPRIGHT
    return matrix if axes is Axes.OPENGL else _MIRRORED @ matrix @ _MIRRORED


def session_from_map(
    session_from_camera: ArrayLike, pose: PoseEstimate | Pose, axes: Axes
) -> NDArray[np.float64]:
    """Return where the map lies in the session: what moves content of the map to its place.

    Warns (``UserWarning``) of an answer whose unit has an unknown length: content that is placed by
    it has the wrong size and distance.

    Args:
        session_from_camera: the device's own pose **when the photo was taken**, a 4 x 4 matrix for
            column vectors. The answer comes later, and the device has moved on.
        pose: of the answer, in a metric map.
        axes: of the session and its camera.

    Returns:
        A 4 x 4 matrix.

    Raises:
        InvalidInput: ``frames.not_rigid``: ``session_from_camera`` is no rigid transform.
    """
    if isinstance(pose, PoseEstimate) and pose.metric is False:
        warnings.warn(_UNKNOWN_UNIT, stacklevel=2)
    device = np.asarray(session_from_camera, dtype=np.float64)
    _check_rigid(device)
    moved: NDArray[np.float64] = device @ np.linalg.inv(camera_matrix(pose, axes))
    return moved


def blended(old: ArrayLike, new: ArrayLike, share: float) -> NDArray[np.float64]:
    """Return a rigid transform between two: positions linearly, rotations along the shortest way.

    With ``share = old_variance / (old_variance + new_variance)`` this is the best estimate of a
    transform that does not change, such as ``session_from_map``.

    Args:
        old: a 4 x 4 matrix.
        new: a 4 x 4 matrix.
        share: of the new one, 0 to 1.

    Raises:
        InvalidInput: ``frames.not_rigid``: one of both is no rigid transform.
    """
    first, second = np.asarray(old, dtype=np.float64), np.asarray(new, dtype=np.float64)
    for each in (first, second):
        _check_rigid(each)
    start, end = (Pose(each[:3, :3], each[:3, 3]).inverse() for each in (first, second))
    between = interpolate_pose(start, end, share).inverse()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = between.rotation, between.translation
    return matrix


def _check_rigid(matrix: NDArray[np.float64]) -> None:
    if (
        matrix.shape != (4, 4)
        or not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6)
        or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-4)
        or np.linalg.det(matrix[:3, :3]) < 0
    ):
        raise refuse(
            "frames.not_rigid",
            got=np.array2string(matrix, precision=4),
        )
