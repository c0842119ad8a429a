"""Poses of matrices and centres, and whether a camera has moved."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from visloc.geometry import Pose, rotation_angle

# A frame of a film counts when the camera has moved so far since the last one.
_STEP_M, _TURN_RAD = 0.25, np.radians(10.0)


def rotation_from_matrix(values: ArrayLike) -> NDArray[np.float64] | None:
    """Return the rotation nearest to a matrix of 9 numbers, None if it is not nearly one."""
    matrix = np.asarray(values, np.float64).reshape(3, 3)
    if not (np.abs(matrix) < 2).all():
        return None
    u, scales, vt = np.linalg.svd(matrix)
    rotation: NDArray[np.float64] = u @ vt
    # Text of four digits is off by 1e-4 or so; anything else is not a rotation.
    if np.abs(scales - 1).max() > 1e-3 or np.linalg.det(rotation) < 0:
        return None
    return rotation


def pose_from_center(rotation: NDArray[np.float64], center: NDArray[np.float64]) -> Pose:
    """Make ``cam_from_world`` of a rotation (3, 3) and the camera's position in the world (3,)."""
    return Pose(rotation, -rotation @ center)


def has_moved(before: Pose, after: Pose) -> bool:
    """Tell whether two ``cam_from_world`` in a world in metres are far enough apart to use both."""
    moved = float(np.linalg.norm(before.center - after.center))
    return moved >= _STEP_M or rotation_angle(before.rotation @ after.rotation.T) >= _TURN_RAD
