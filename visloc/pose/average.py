"""The weighted mean of poses, and how they scatter about it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.geometry import Pose


def average_pose(
    rotations: NDArray[np.float64], centers: NDArray[np.float64], weights: NDArray[np.float64]
) -> Pose:
    """Return the weighted mean of camera poses, ``cam_from_world``.

    The centre is ``sum(w_i c_i)``. The rotation is the eigenvector of the largest eigenvalue of
    ``sum(w_i q_i q_i^T)``, in which q and -q count the same (Markley et al., "Averaging
    Quaternions", 2007).

    Args:
        rotations: (k, 3, 3), camera from world.
        centers: (k, 3) camera centres in the world.
        weights: (k,) of sum 1; they may be negative.
    """
    quaternions = Rotation.from_matrix(rotations).as_quat()
    _, vectors = np.linalg.eigh((weights[:, None] * quaternions).T @ quaternions)
    rotation = Rotation.from_quat(vectors[:, -1]).as_matrix()
    return Pose(rotation, -rotation @ (weights @ centers))


def deviations(
    pose: Pose, rotations: NDArray[np.float64], centers: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how poses differ from one, in rotation and in position.

    Returns:
        (k, 3) rotation vectors w (rad) of ``Exp(w) R``, about the axes of the camera, and (k, 3)
        differences of the centres along the axes of the world.
    """
    turned = Rotation.from_matrix(rotations @ pose.rotation.T).as_rotvec()
    return turned, np.asarray(centers - pose.center)
